"""The page about one run, made from its folder alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ...experiment.nuisance import in_unit_for_people
from ...fem.constants import symbol_of, unit_of
from ...files import is_own
from ...result import Result
from ...statistics.places import Place
from ...tree import content
from ..remedies import remedies_for
from ..replay import LARGEST, read_arrays, reading_run
from .page import millimetres, number, own_pictures, picture, rendered

MEANINGS = {
    "good": "nothing speaks against the answer and its error bars",
    "check": "usable after a look at the reasons",
    "doubtful": "something is wrong with the data, the model or the solve",
}
# What tells stiffness first, where there are several.
FOREMOST = ("young_pa", "mu_pa", "kappa_pa", "lambda_pa")
# Largest errors shown, and how far apart in samples they are at least: neighbours tell the same.
WORST, APART = 8, 5

CAPTIONS = {
    "shapes": "The body at times of the recording; orange: measured markers.",
    "mesh": "The mesh, its grasped nodes and the markers' places as found.",
    "tracks": "Measured, fitted and rolled-out markers, the residual below.",
    "wrench": "Wrench of a grasp: measured, fitted and rolled out.",
    "error": "Distance of the markers from their measurements over time.",
    "spectrum": "Spectrum of the motion against the body's first natural frequencies.",
    "confidence": "95 % confidence ellipses of pairs of parameters, for the noise.",
    "correlation": "Correlation of the estimates.",
    "convergence": "Loss, violation of the dynamics and parameters over the iterations.",
    "scan": "Scan of the stiffness for a start: misfit of the first part of the recordings.",
    "elements": "Size and quality of the elements.",
    "jacobian": "Structure of the constraints' Jacobian.",
}


def run_page(run: str | Path) -> str:
    """The page of a run folder.

    Raises
    ------
    InputError
        If it is not a run folder, or damaged.
    """
    run = Path(run)
    result = Result.read(run)
    with reading_run(run):
        parameters = _parameters(result)
        return rendered(
            "run.html",
            result=result,
            trust=result.trust,
            meaning=MEANINGS[result.trust.verdict],
            remedies=remedies_for(result.trust.concerns),
            numbers=_numbers(result),
            verdict=verdict(result),
            notes=_notes(result),
            parameters=parameters,
            holds=max((row["holds"] for row in parameters), key=len, default=[]),
            places=_places(result),
            nuisance=_nuisance(result),
            worst=_worst_errors(run),
            pictures=_pictures(run),
            problem=_problem(run),
            size=content(result.problem),
            provenance=content(result.provenance),
        )


def verdict(result: Result) -> list[str]:
    """The run in a few sentences."""
    said = [result.message]
    if result.converged:
        said += _weakest(result)
    fit, rolled = result.fit, result.rollout
    sentence = f"The fitted markers are {millimetres(fit.rms_m)} off (RMS)"
    if rolled.rms_m is not None:
        sentence += (
            f"; the roll-out misses by {millimetres(rolled.rms_m)}, at most "
            f"{millimetres(rolled.max_m)}"
        )
    said.append(f"{sentence}.")
    for name, found in rolled.experiments.items():
        if found.failed is not None:
            said.append(f"The roll-out of '{name}' failed: {found.failed}.")
        elif not found.fitted:
            said.append(f"'{name}' was predicted, not fitted: {millimetres(found.rms_m)} RMS.")
    return said


def _numbers(result: Result) -> list[dict[str, str]]:
    """The three numbers that matter: stiffness, misfit, and how well the answer repeats it."""
    found = result.values
    name = next((key for key in FOREMOST if key in found), next(iter(found)))
    low, high = found[name].ci95 or (None, None)
    interval = "no error bar" if low is None else f"{number(low, 4)} to {number(high, 4)} (95 %)"
    fit, rolled = result.fit, result.rollout
    return [
        {
            "what": symbol_of(name),
            "value": f"{number(found[name].value, 4)} {unit_of(name)}".strip(),
            "beside": interval,
        },
        {
            "what": "markers, fitted",
            "value": millimetres(fit.rms_m),
            "beside": f"RMS; noise alone leaves {millimetres(fit.noise_rms_m)}",
        },
        {
            "what": "markers, re-simulated",
            "value": millimetres(rolled.rms_m),
            "beside": f"RMS; {millimetres(rolled.max_m)} at most",
        },
    ]


def _notes(result: Result) -> list[str]:
    """Notes that the page does not hold elsewhere."""
    found = result.uncertainty
    said = {*found.verdicts, *(p.sentence for p in found.profiles.values())} if found else ()
    return [note for note in result.notes if note not in said]


def _weakest(result: Result) -> list[str]:
    free = {name: p for name, p in result.parameters.items() if not p.fixed}
    unknown = [symbol_of(name) for name, p in free.items() if p.std_error is None]
    said = [f"No error bar for {', '.join(unknown)}: see the notes."] if unknown else []
    known = {name: p.std_error / p.value for name, p in free.items() if p.std_error}
    if known:
        name = max(known, key=lambda key: known[key])
        how = "weakly" if known[name] > 0.1 else "least well, but well"
        said.append(f"{symbol_of(name)} is {how} identified: ±{number(196 * known[name], 2)} %.")
    return said


def _parameters(result: Result) -> list[dict[str, Any]]:
    rows = []
    for name, found in result.values.items():
        low, high = found.ci95 or (None, None)
        rows.append(
            {
                "symbol": symbol_of(name),
                "unit": unit_of(name),
                "value": found.value,
                "std_error": found.std_error,
                "low": low,
                "high": high,
                "reason": "fixed" if found.fixed else found.reason,
                "guess": found.guess,
                "derived": found.fixed is None,
                "numerical": found.numerical_error,
                "holds": found.ci95_holds,
            }
        )
    return rows


def _places(result: Result) -> dict[str, list[dict[str, Any]]]:
    """By experiment the places of the markers in millimetres."""
    return {
        experiment: [
            {
                "marker": marker,
                "coordinates": _coordinates(place),
                "prior": "exact" if place.prior_m == 0 else _size(place.prior_m, "m"),
                "given": place.given,
            }
            for marker, place in places.items()
        ]
        for experiment, places in result.places.items()
    }


def _coordinates(place: Place) -> list[tuple[str, str]]:
    """Each coordinate with its error, in millimetres."""
    errors_m = [None] * 3 if place.std_error_m is None else place.std_error_m
    return [
        (f"{1e3 * x:.2f}", "–" if error is None else number(1e3 * error, 2))
        for x, error in zip(place.position_m, errors_m, strict=True)
    ]


def _nuisance(result: Result) -> dict[str, list[dict[str, Any]]]:
    """By experiment its other nuisance parameters in units for people."""
    tables = {}
    for experiment, named in result.nuisance.items():
        tables[experiment] = []
        for label, found in named.items():
            words, _, unit = label.rstrip("]").rpartition(" [")
            cells = {
                key: _size(getattr(found, key), unit) for key in ("value", "std_error", "prior")
            }
            tables[experiment].append({"label": words, **cells})
    return tables


def _size(value: float | None, unit: str) -> str:
    """A number in the unit that suits it: millimetres, milliseconds or degrees."""
    factor, shown = in_unit_for_people(1.0, unit)
    # No powers of ten for the sizes of bodies.
    digits = 2 if value is None or abs(factor * value) < 99.5 else 4
    return "–" if value is None else f"{number(factor * value, digits)}{shown}"


def _worst_errors(run: Path) -> list[dict[str, Any]]:
    """The largest residuals, with time and marker."""
    arrays, found = read_arrays(run), []
    for key in (key for key in arrays if key.rpartition("/")[2] == "residuals_m"):
        prefix = key.removesuffix("residuals_m")
        t_s, markers = arrays[f"{prefix}t_s"], arrays[f"{prefix}marker_names"]
        shape, residuals_m = (len(t_s), len(markers), 3), arrays[key]
        largest = float(np.nanmax(np.abs(residuals_m), initial=0.0))
        if residuals_m.shape != shape or largest > LARGEST:
            raise ValueError(f"{key} does not go with its times and markers")
        errors = np.nan_to_num(np.linalg.norm(residuals_m, axis=2))
        found += _peaks(prefix.rstrip("/"), errors, t_s, markers)
    return sorted(found, key=lambda item: -item["error_m"])[:WORST]


def _peaks(
    experiment: str, errors: np.ndarray, t_s: np.ndarray, markers: np.ndarray
) -> list[dict[str, Any]]:
    errors, found = errors.copy(), []
    for _ in range(WORST if errors.size else 0):
        t, m = np.unravel_index(int(errors.argmax()), errors.shape)
        if not errors[t, m] > 0:
            break
        found.append(
            {
                "experiment": experiment,
                "t_s": float(t_s[t]),
                "marker": str(markers[m]),
                "error_m": float(errors[t, m]),
            }
        )
        errors[max(0, t - APART) : t + APART + 1, m] = 0
    return found


def _pictures(run: Path) -> list[dict[str, Any]]:
    """Every PNG of the folder, those known here first."""
    order = list(CAPTIONS)

    def kind(file: Path) -> str:
        return next((k for k in order if file.stem.startswith(k)), "")

    files = sorted(
        own_pictures(run),
        key=lambda f: (order.index(kind(f)) if kind(f) else len(order), f.name),
    )
    found = []
    for file in files:
        about = file.stem.removeprefix(kind(file)).strip("_")
        caption = CAPTIONS.get(kind(file), file.stem)
        title = f"{about}: {caption}" if about and kind(file) else caption
        found.append(picture(file, title))
    return found


def _problem(run: Path) -> str:
    file = run / "problem.toml"
    return file.read_text(encoding="utf-8") if is_own(run, file) else ""
