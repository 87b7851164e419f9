"""Scatter of estimates from repeated measurements, compared with their intervals.

Each repeat is identified separately: the trials of problems/srl_beam, the five runs of each
silicone of problems/phantom_compression, and pairs of recordings of problems/soft_tentacle with
equal tension in either tendon, which determine both parameters. The data are downloaded by
scripts/data/get_*.py. The table counts the intervals that contain the mean of all repeats. Errors that
all repeats have in common, such as the size of the mesh, do not scatter; the combined intervals,
which include these errors, are therefore wider than the scatter.
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

PROBLEMS = Path(__file__).parents[2] / "problems"
SILICONES = ("EF10", "EF30", "EF50")
TENSIONS = ("u01", "u015", "u02", "u025")
# Parameters that mean the same in all problems.
NAMES = ("young_pa", "gamma_r_s", "gamma_m_1_s", "density_kg_m3")


@dataclass(frozen=True)
class RepeatedMeasurement:
    """Repeated measurement of one body: the problem, and the names of the recordings of each
    repeat.
    """

    name: str
    problem: Problem
    groups: Mapping[str, Sequence[str]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="*", choices=("beam", "cylinders", "tentacle"))
    only = parser.parse_args().only or ("beam", "cylinders", "tentacle")
    print(
        "| measurement | parameter | estimates | standard deviation, % | statistical interval, ± % "
        "| combined interval, ± % | statistical intervals with the mean "
        "| combined intervals with the mean |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for repeats in _measurements(only):
        values: dict[str, list[ReportedEstimate]] = {}
        for names in repeats.groups.values():
            for name, estimate in _estimates_from(repeats.problem, names).items():
                values.setdefault(name, []).append(estimate)
        for name, estimates in values.items():
            print(_line(repeats.name, name, estimates), flush=True)


def _measurements(only: Sequence[str]) -> Iterator[RepeatedMeasurement]:
    if "beam" in only:
        beam = Problem.read(PROBLEMS / "srl_beam" / "problem.toml")
        yield RepeatedMeasurement(
            "beam, three loads", beam, {e.name: [e.name] for e in beam.experiments}
        )
    if "cylinders" in only:
        for silicone in SILICONES:
            runs = _cylinders(silicone)
            yield RepeatedMeasurement(
                f"cylinders {silicone}", runs, {e.name: [e.name] for e in runs.experiments}
            )
    if "tentacle" in only:
        tentacle = Problem.read(PROBLEMS / "soft_tentacle" / "problem.toml")
        groups = {tension: [f"m{k}_{tension}" for k in (1, 2)] for tension in TENSIONS}
        yield RepeatedMeasurement("tentacle, by tension", tentacle, groups)


def _cylinders(silicone: str) -> Problem:
    """Return the problem with the runs of another silicone."""
    source = PROBLEMS / "phantom_compression"
    with tempfile.TemporaryDirectory() as folder:
        for file in source.glob(f"{silicone}_*.csv"):
            shutil.copyfile(file, Path(folder) / file.name)
        text = (source / "problem.toml").read_text().replace("EF30_0T", f"{silicone}_0T")
        problem = Path(folder) / "problem.toml"
        problem.write_text(text)
        return Problem.read(problem)


def _estimates_from(problem: Problem, names: Sequence[str]) -> dict[str, ReportedEstimate]:
    """Return the estimates from the named recordings alone; empty if they cannot be solved."""
    recordings = [replace(e, validation=False) for e in problem.experiments if e.name in names]
    try:
        answer = run(replace(problem, experiments=recordings), seek_causes=False)
    except InputError:
        return {}
    estimates = answer.estimates
    return {n: estimates[n] for n in NAMES if n in estimates and estimates[n].statistical_std_error}


def _line(repeats: str, name: str, estimates: Sequence[ReportedEstimate]) -> str:
    # Centres of the intervals, which include the common correction for the time step.
    logs = np.array([np.log(e.statistical95 or (e.value, e.value)).mean() for e in estimates])
    mean = logs.mean()
    count = len(logs)
    deviation = 100 * float(logs.std(ddof=1)) if count > 1 else np.nan
    half_widths = []
    coverages = []
    for ends_of_kind in ([e.statistical95 for e in estimates], [e.combined95 for e in estimates]):
        ends = [np.log(np.maximum(interval, 1e-12)) for interval in ends_of_kind if interval]
        half_widths.append(100 * float(np.median([(high - low) / 2 for low, high in ends])))
        coverages.append(f"{sum(low <= mean <= high for low, high in ends)} of {len(ends)}")
    values = ", ".join(f"{e.value:.4g}" for e in estimates)
    cells = [
        repeats,
        symbol_of(name),
        values,
        f"{deviation:.2g}",
        *(f"{h:.2g}" for h in half_widths),
        *coverages,
    ]
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    main()
