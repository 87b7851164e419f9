"""Do measured repeats scatter within their whole intervals? Each is identified alone.

Trials of problems/srl_beam, the five runs of each silicone of problems/phantom_compression, and
problems/soft_tentacle, of which a pair of recordings with one tension in either tendon tells both
parameters; get their data by scripts/get_*.py. Counted is how many of the intervals hold the mean
of all repeats, with which each errs by its share of the scatter too. What repeats have in common,
such as the size of the mesh, does not scatter: whole intervals may well be too wide for it.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from collocation_sysid import Problem, run
from collocation_sysid.errors import InputError
from collocation_sysid.fem.laws.constants import symbol_of
from collocation_sysid.runs.result_content import ReportedEstimate

PROBLEMS = Path(__file__).parents[1] / "problems"
SILICONES = ("EF10", "EF30", "EF50")
TENSIONS = ("u01", "u015", "u02", "u025")
# What means the same in all of them.
NAMES = ("young_pa", "gamma_r_s", "gamma_m_1_s", "density_kg_m3")


@dataclass(frozen=True)
class Repeats:
    """Repeated measurement of one body: the problem, and the names of the recordings of each repeat."""

    name: str
    problem: Problem
    groups: Mapping[str, Sequence[str]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--only", nargs="*", choices=("beam", "cylinders", "tentacle")
    )
    only = parser.parse_args().only or ("beam", "cylinders", "tentacle")
    print(
        "| repeats | number | values | scatter % | 95 % ± % | whole ± % | held | held by whole |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for repeats in _all(only):
        values: dict[str, list[ReportedEstimate]] = {}
        for names in repeats.groups.values():
            for name, estimate in _alone(repeats.problem, names).items():
                values.setdefault(name, []).append(estimate)
        for name, estimates in values.items():
            print(_line(repeats.name, name, estimates), flush=True)


def _all(only: Sequence[str]) -> Iterator[Repeats]:
    if "beam" in only:
        beam = Problem.read(PROBLEMS / "srl_beam" / "problem.toml")
        yield Repeats(
            "beam, three loads",
            beam,
            {e.name: [e.name] for e in beam.experiments},
        )
    if "cylinders" in only:
        for silicone in SILICONES:
            runs = _cylinders(silicone)
            yield Repeats(
                f"cylinders {silicone}",
                runs,
                {e.name: [e.name] for e in runs.experiments},
            )
    if "tentacle" in only:
        bent = Problem.read(PROBLEMS / "soft_tentacle" / "problem.toml")
        pairs = {
            tension: [f"m{k}_{tension}" for k in (1, 2)] for tension in TENSIONS
        }
        yield Repeats("tentacle, by tension", bent, pairs)


def _cylinders(silicone: str) -> Problem:
    """The problem with the runs of another silicone."""
    source = PROBLEMS / "phantom_compression"
    with tempfile.TemporaryDirectory() as folder:
        for file in source.glob(f"{silicone}_*.csv"):
            shutil.copyfile(file, Path(folder) / file.name)
        text = (
            (source / "problem.toml")
            .read_text()
            .replace("EF30_0T", f"{silicone}_0T")
        )
        problem = Path(folder) / "problem.toml"
        problem.write_text(text)
        return Problem.read(problem)


def _alone(
    problem: Problem, names: Sequence[str]
) -> dict[str, ReportedEstimate]:
    """Return the estimates from the named recordings alone; empty if they cannot be solved."""
    own = [
        replace(e, validation=False)
        for e in problem.experiments
        if e.name in names
    ]
    try:
        found = run(replace(problem, experiments=own), seek_causes=False)
    except InputError:
        return {}
    known = found.estimates
    return {
        n: known[n]
        for n in NAMES
        if n in known and known[n].statistical_std_error
    }


def _line(
    repeats: str, name: str, estimates: Sequence[ReportedEstimate]
) -> str:
    # Where intervals are, with what the step does to all repeats alike.
    logs = np.array(
        [
            np.log(e.statistical95 or (e.value, e.value)).mean()
            for e in estimates
        ]
    )
    mean = logs.mean()
    count = len(logs)
    scatter = 100 * float(logs.std(ddof=1)) if count > 1 else np.nan
    told = [(e.statistical95, e.combined95) for e in estimates]
    halves = []
    held = []
    for intervals in zip(*told, strict=True):
        ends = [
            np.log(np.maximum(interval, 1e-12))
            for interval in intervals
            if interval
        ]
        halves.append(
            100 * float(np.median([(high - low) / 2 for low, high in ends]))
        )
        held.append(
            f"{sum(low <= mean <= high for low, high in ends)} of {len(ends)}"
        )
    values = ", ".join(f"{e.value:.4g}" for e in estimates)
    cells = (
        repeats,
        symbol_of(name),
        values,
        f"{scatter:.2g}",
        *(f"{h:.2g}" for h in halves),
    )
    return f"| {' | '.join((*cells, *held))} |"


if __name__ == "__main__":
    main()
