"""Complete stroke of problems/phantom_compression: each specimen, and the influence of assumptions.

    python scripts study_whole_stroke [--only specimens assumed meshes]

The specimens A1 to A5 are identified with Yeoh's law, A1 also with other compressibilities,
contacts, frictions and meshes. The data are downloaded by scripts/data/get_phantom_compression.py. Each
row takes half a minute of processor time, that of the fine mesh several minutes.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from make_phantom_mesh import SECTIONS_MM, quarter_revolution
from script_arguments import make_parser

from collocation_sysid import Problem, run
from collocation_sysid.errors import InputError, SimulationError
from collocation_sysid.methods.solution import pooled_wrench_rms
from collocation_sysid.runs.result_content import ReportedEstimate

FILE = Path(__file__).parents[2] / "problems" / "phantom_compression" / "whole_stroke.toml"
PLATEN = "experiment.A1.obstacle.platen"
# Keys of the problem file that differ in each row.
ASSUMPTIONS = {
    "as shipped": (),
    "half the bulk modulus": ("parameters.kappa_pa.fixed=2e6",),
    "2.5 times the bulk modulus": ("parameters.kappa_pa.fixed=1e7",),
    "a tenth of κ": (f"{PLATEN}.stiffness_pa_m=1e10",),
    "five times the slip": (f"{PLATEN}.slip=1e-4",),
    "no friction": ("parameters.platen_friction={ fixed = 0.0 }",),
    "hardly any slip": ("parameters.platen_friction={ fixed = 1.0 }",),
}


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--only", nargs="*", choices=("specimens", "assumed", "meshes"))
    only = parser.parse_args().only or ("specimens", "assumed", "meshes")
    print(
        "| specimen or assumption | E, kPa | statistical interval of E | combined interval of E "
        "| friction coefficient | its statistical interval | its combined interval "
        "| RMS residual of the load, N | % of the largest load |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for name, specimen, changes in _variants(only, Path(folder)):
            print(_line(name, specimen, changes), flush=True)


def _variants(only: Sequence[str], folder: Path) -> Iterator[tuple[str, str, Sequence[str]]]:
    if "specimens" in only:
        for k in range(1, 6):
            yield f"A{k}", f"A{k}", ()
    if "assumed" in only:
        for name, changes in ASSUMPTIONS.items():
            yield name, "A1", changes
    if "meshes" in only:
        for name, section in SECTIONS_MM.items():
            quarter_revolution(*section).write(folder / f"{name}.vtu")
            yield f"{name} mesh", "A1", (f"object.mesh={folder / name}.vtu",)


def _line(name: str, specimen: str, changes: Sequence[str]) -> str:
    problem = Problem.read(FILE, list(changes))
    (experiment,) = (each for each in problem.experiments if each.name == specimen)
    try:
        answer = run(replace(problem, experiments=[experiment]), seek_causes=False)
    except (InputError, SimulationError) as error:
        return f"| {name} | {error} | | | | | | | |"
    (wrench,) = (each.wrench for each in experiment.obstacles if each.wrench is not None)
    largest_n = wrench.symmetry * np.nanmax(np.abs(wrench.values))
    misfit_n = pooled_wrench_rms(answer.solution)[0]
    assert misfit_n is not None
    young = _value_and_intervals(answer.estimates["young_pa"], 1e-3, "{:.1f}")
    friction = _value_and_intervals(answer.estimates["platen_friction"], 1.0, "{:.2f}")
    misfit = f"{misfit_n:.2f} | {100 * misfit_n / largest_n:.2f}"
    return f"| {name} | {young} | {friction} | {misfit} |"


def _value_and_intervals(estimate: ReportedEstimate, factor: float, form: str) -> str:
    """Return three cells: value, statistical interval and combined interval, times a factor."""
    cells = [form.format(factor * estimate.value)]
    for interval in (estimate.statistical95, estimate.combined95):
        ends = (form.format(factor * end) for end in interval or ())
        cells.append(" to ".join(ends) or "—")
    return " | ".join(cells)


if __name__ == "__main__":
    main()
