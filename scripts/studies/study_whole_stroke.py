"""Complete stroke of problems/phantom_compression: each specimen with Yeoh's law.

    python scripts study_whole_stroke

The data are downloaded by scripts/data/get_phantom_compression.py. Each row takes half a minute of
processor time.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from script_arguments import make_parser

from collocation_sysid import Problem, run
from collocation_sysid.errors import InputError, SimulationError
from collocation_sysid.methods.solution import pooled_wrench_rms
from collocation_sysid.runs.result_content import ReportedEstimate

FILE = Path(__file__).parents[2] / "problems" / "phantom_compression" / "whole_stroke.toml"


def main() -> None:
    make_parser(__doc__).parse_args()
    print(
        "| specimen | E, kPa | statistical interval of E | combined interval of E "
        "| friction coefficient | its statistical interval | its combined interval "
        "| RMS residual of the load, N | % of the largest load |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for k in range(1, 6):
        print(_line(f"A{k}"), flush=True)


def _line(specimen: str) -> str:
    problem = Problem.read(FILE)
    (experiment,) = (each for each in problem.experiments if each.name == specimen)
    try:
        answer = run(replace(problem, experiments=[experiment]), seek_causes=False)
    except (InputError, SimulationError) as error:
        return f"| {specimen} | {error} | | | | | | | |"
    (wrench,) = (each.wrench for each in experiment.obstacles if each.wrench is not None)
    largest_n = wrench.symmetry * np.nanmax(np.abs(wrench.values))
    misfit_n = pooled_wrench_rms(answer.solution)[0]
    assert misfit_n is not None
    young = _value_and_intervals(answer.estimates["young_pa"], 1e-3, "{:.1f}")
    friction = _value_and_intervals(answer.estimates["platen_friction"], 1.0, "{:.2f}")
    misfit = f"{misfit_n:.2f} | {100 * misfit_n / largest_n:.2f}"
    return f"| {specimen} | {young} | {friction} | {misfit} |"


def _value_and_intervals(estimate: ReportedEstimate, factor: float, form: str) -> str:
    """Return three cells: value, statistical interval and combined interval, times a factor."""
    cells = [form.format(factor * estimate.value)]
    for interval in (estimate.statistical95, estimate.combined95):
        ends = (form.format(factor * end) for end in interval or ())
        cells.append(" to ".join(ends) or "—")
    return " | ".join(cells)


if __name__ == "__main__":
    main()
