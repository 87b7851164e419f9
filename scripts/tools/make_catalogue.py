"""Write docs/catalogue.json and docs/catalogue.md from solves of the shipped problems.

Each problem is solved by the command line in a process of its own, one after the other, with its
run folder in runs/catalogue. Problems whose measured data are missing (see scripts/data/get_*.py), that
fail or that exceed the time limit are listed as omitted.

    python scripts make_catalogue                    # solves all
    python scripts make_catalogue --reuse            # solves what has no run folder yet
    python scripts make_catalogue --reuse --long     # also those of more than ten minutes
    python scripts make_catalogue --only isoprene_rubber   # solves this one, and keeps the others
"""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path

import numpy as np
from catalogue import (
    Catalogue,
    CatalogueEntry,
    IdentifiedConstant,
    Omission,
    QuantileRange,
    catalogue_page,
)
from catalogue_sources import ROOT, SOURCES, CatalogueSource
from script_arguments import make_parser

import collocation_sysid as cs
from collocation_sysid.common.array_types import Array
from collocation_sysid.common.files import RESULT_FILE, write_text_file
from collocation_sysid.common.serialisation import as_json, read
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.laws.constants import is_damping, unit_of
from collocation_sysid.fem.regions import BodyPart
from collocation_sysid.result.replay import MotionRecord, read_run
from collocation_sysid.runs.result_content import Result

JSON_FILE = ROOT / "docs" / "catalogue.json"
PAGE_FILE = ROOT / "docs" / "catalogue.md"
RUNS = ROOT / "runs" / "catalogue"
# Quantiles of the ranges.
LOW = 0.05
HIGH = 0.95
# Time limit of a solve [s]: 25 minutes on a busy machine.
TIME_LIMIT_S = 1500.0


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--reuse", action="store_true", help="use the run folders that exist")
    parser.add_argument("--long", action="store_true", help="solve long problems too")
    parser.add_argument("--only", nargs="+", default=(), help="names; other entries are kept")
    options = parser.parse_args()
    entries = []
    omitted = []
    kept = read_catalogue() if options.only else Catalogue(cs.__version__, (), ())
    earlier = {each.name: each for each in (*kept.entries, *kept.omitted)}
    for source in SOURCES:
        if options.only and source.name not in options.only:
            outcome = earlier[source.name]
            (omitted if isinstance(outcome, Omission) else entries).append(outcome)
            continue
        outcome = make_entry(source, reuse=options.reuse, with_long=options.long)
        print(source.name, outcome.reason if isinstance(outcome, Omission) else outcome.verdict)
        (omitted if isinstance(outcome, Omission) else entries).append(outcome)
    catalogue = Catalogue(cs.__version__, tuple(entries), tuple(omitted))
    write_text_file(JSON_FILE, as_json(catalogue) + "\n")
    write_text_file(PAGE_FILE, catalogue_page(catalogue))


def read_catalogue() -> Catalogue:
    """Return the catalogue in docs/catalogue.json."""
    return read(Catalogue, json.loads(JSON_FILE.read_text(encoding="utf-8")))


def make_entry(
    source: CatalogueSource,
    *,
    reuse: bool,
    time_limit_s: float = TIME_LIMIT_S,
    with_long: bool = False,
) -> CatalogueEntry | Omission:
    """Return the entry of a problem, solved in its run folder, or why there is none."""
    folder = RUNS / source.name
    is_solved = reuse and _is_current(folder, source)
    if source.is_long and not (is_solved or with_long):
        return _omission(source, "the solve takes longer than ten minutes (option --long)")
    try:
        problem = cs.Problem.read(source.problem_file)
    except cs.InputError as error:
        return _omission(source, f"not read: {error.message}")
    if not is_solved:
        command = [sys.executable, "-m", "collocation_sysid", "solve", str(source.problem_file)]
        command += ["--out", str(folder), "--no-pictures", "--quiet"]
        try:
            solve = subprocess.run(command, capture_output=True, timeout=time_limit_s, cwd=ROOT)
        except subprocess.TimeoutExpired:
            return _omission(source, f"not solved within {time_limit_s / 60:.0f} minutes")
        if solve.returncode != 0:
            return _omission(source, f"the solve ended with exit code {solve.returncode}")
    result, records = read_run(folder)
    return entry_of(source, problem, result, records)


def _omission(source: CatalogueSource, reason: str) -> Omission:
    return Omission(source.name, source.problem, reason)


def _is_current(folder: Path, source: CatalogueSource) -> bool:
    """Return whether a run folder has a converged result of the problem file as it is now."""
    if not (folder / RESULT_FILE).is_file():
        return False
    result = Result.read(folder)
    return result.converged and result.provenance.problem_sha256 == _checksum(source.problem_file)


def _checksum(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


def entry_of(
    source: CatalogueSource, problem: cs.Problem, result: Result, records: list[MotionRecord]
) -> CatalogueEntry:
    """Return the entry of a problem from the result and the motions of its run."""
    bodies = {each.name: each.body for each in problem.experiments}
    fitted = [each for each in records if each.positions_m is not None]
    parts = bodies[fitted[0].name].parts
    is_static = all(each.static for each in fitted)
    has_rate = source.static_times_are_recorded or not is_static
    return CatalogueEntry(
        name=source.name,
        problem=source.problem,
        specimen=source.specimen,
        source=source.source,
        licence=source.licence,
        is_measured=source.is_measured,
        law=tuple(_law_name(part) for part in parts),
        damping=() if is_static else tuple(part.damping.name for part in parts),
        constants=constants_of(result, _truth(source), is_static=is_static),
        stretch=stretch_range(bodies, fitted),
        strain_rate_1_s=rate_range(bodies, fitted) if has_rate else None,
        verdict=result.trust.verdict,
        reasons=result.trust.reasons,
        recordings=tuple(each.name for each in fitted),
        version=result.provenance.version,
        problem_sha256=str(result.provenance.problem_sha256),
    )


def _law_name(part: BodyPart) -> str:
    """Return the name of the law of a part, with its memory branches and its region."""
    memory = f" with {len(part.prony)} branch of memory" if part.prony else ""
    region = f" ({part.name})" if part.name else ""
    return f"{part.material.name}{memory}{region}"


def _truth(source: CatalogueSource) -> dict[str, float]:
    """Return the constants of a twin by name, with Young's modulus and Poisson's ratio."""
    if source.is_measured:
        return {}
    truth = dict(import_module(source.twin_script).TRUTH)
    if "lambda_pa" in truth:
        lam = truth["lambda_pa"]
        mu = truth["mu_pa"]
        truth["young_pa"] = mu * (3 * lam + 2 * mu) / (lam + mu)
        truth["poisson"] = lam / (2 * (lam + mu))
    else:
        young = truth["young_pa"]
        nu = truth["poisson"]
        truth["lambda_pa"] = young * nu / ((1 + nu) * (1 - 2 * nu))
        truth["mu_pa"] = young / (2 * (1 + nu))
    return truth


def constants_of(
    result: Result, truth: Mapping[str, float], *, is_static: bool
) -> tuple[IdentifiedConstant, ...]:
    """Return parameters and derived moduli; without the dampings of equilibria, which have none."""
    named = {n: e for n, e in result.estimates.items() if not (is_static and is_damping(n))}
    return tuple(
        IdentifiedConstant(
            name=name,
            unit=unit_of(name) or "1",
            value=estimate.value,
            combined95=estimate.combined95,
            is_stated=bool(estimate.fixed),
            is_derived=name in result.derived,
            reason=estimate.reason,
            true_value=truth.get(name),
        )
        for name, estimate in named.items()
    )


# Ranges -------------------------------------------------------------------------------------------


def deformation_gradients(body: Body, positions_m: Array) -> Array:
    """Return F (T, E q, 3, 3) at the quadrature points for node positions (T, n, 3) [m].

    The n nodes are those of the elements, without the frames of obstacles that follow them.
    """
    nodes = len(body.nodes.points_m)
    states = len(positions_m)
    if positions_m.shape[1] != nodes:
        raise ValueError(f"found positions of {positions_m.shape[1]} nodes; expected {nodes}")
    by_node = positions_m.transpose(1, 2, 0).reshape(nodes, 3 * states)
    derivatives = (body.shape_gradients[:, :nodes] @ by_node).reshape(3, -1, 3, states)
    return derivatives.transpose(3, 1, 2, 0)


def green_strains(body: Body, positions_m: Array) -> Array:
    """Return Green's strain ½ (FᵀF − I) (T, E q, 3, 3) for node positions (T, n, 3) [m]."""
    gradients = deformation_gradients(body, positions_m)
    return (gradients.swapaxes(-1, -2) @ gradients - np.eye(3)) / 2


def stretch_range(bodies: Mapping[str, Body], records: list[MotionRecord]) -> QuantileRange:
    """Return the range of the principal stretches over all points and samples of the recordings."""
    smallest = []
    largest = []
    weights = []
    for record in records:
        body = bodies[record.name]
        strains = green_strains(body, np.asarray(record.positions_m))
        stretches = np.sqrt(1 + 2 * np.linalg.eigvalsh(strains))
        smallest.append(stretches[..., 0].ravel())
        largest.append(stretches[..., -1].ravel())
        weights.append(_weights(body, len(strains)))
    return _range(np.concatenate(smallest), np.concatenate(largest), np.concatenate(weights))


def rate_range(bodies: Mapping[str, Body], records: list[MotionRecord]) -> QuantileRange:
    """Return the range of the largest magnitudes of the principal rates of Green's strain [1/s].

    The rates are differences between successive samples.
    """
    rates = []
    weights = []
    for record in records:
        body = bodies[record.name]
        changes = np.diff(green_strains(body, np.asarray(record.positions_m)), axis=0)
        tensors = changes / np.diff(record.t_s)[:, None, None, None]
        rates.append(np.abs(np.linalg.eigvalsh(tensors)).max(axis=-1).ravel())
        weights.append(_weights(body, len(tensors)))
    largest = np.concatenate(rates)
    return _range(largest, largest, np.concatenate(weights))


def _weights(body: Body, states: int) -> Array:
    """Return the volumes of the quadrature points [m³] for a number of states, (T E q,)."""
    return np.tile(body.geometry[..., -1].ravel(), states)


def _range(smallest: Array, largest: Array, weights: Array) -> QuantileRange:
    """Return quantiles and extremes of values (k,), weighted by (k,)."""
    weighted = {"weights": weights, "method": "inverted_cdf"}
    return QuantileRange(
        low=float(np.quantile(smallest, LOW, **weighted)),
        high=float(np.quantile(largest, HIGH, **weighted)),
        minimum=float(smallest.min()),
        maximum=float(largest.max()),
    )


if __name__ == "__main__":
    main()
