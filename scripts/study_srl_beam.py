"""Results for the measured beam: joint fit, refinement, cross-validation, and Poisson's ratio.

The problem is one of problems/srl_beam. Every part changes a few of its keys and solves it again by
reduced space.

    python scripts/study_srl_beam.py --from FOLDER              # all: a quarter of an hour
    python scripts/study_srl_beam.py --from FOLDER --problem memory.toml --parts joint validation
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from get_srl_beam import FOLDER, ORIGIN_M, SIZE_M
from numpy.typing import NDArray

from collocation_sysid import Problem, Solution, solve
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.model.parameters import FieldCoefficients
from collocation_sysid.program.collocation import ExperimentIterate
from collocation_sysid.statistics.estimates import Estimate
from collocation_sysid.statistics.identifiability import (
    identifiability_sentences,
)
from collocation_sysid.statistics.linearised import LinearisedFit, linearise_fit
from collocation_sysid.statistics.residuals.residual_diagnostics import (
    diagnose_markers,
)
from collocation_sysid.statistics.uncertainty import (
    Uncertainty,
    uncertainty_from_fit,
)

TRIALS = ("gravity", "load52", "load101")
# Element and bricks along x, y and z.
MESHES = (
    ("tet4", (5, 2, 2)),
    ("tet4", (10, 4, 4)),
    ("tet10", (3, 1, 1)),
    ("tet10", (5, 2, 2)),
    ("tet10", (8, 3, 3)),
)
SUBSTEPS = (1, 2, 4)
SCHEMES = ("midpoint", "bdf2", "backward-euler")


@dataclass(frozen=True)
class Beam:
    """A problem file of the beam, and the folder with its recordings."""

    file: str
    recordings: Path

    def load(self, *overrides: str) -> Problem:
        """The problem with these recordings, and other values for some keys."""
        markers = (
            self.recordings / f"beam_{trial}_V2_a.c3d" for trial in TRIALS
        )
        files = [
            f"experiment.{trial}.markers.file={file}"
            for trial, file in zip(TRIALS, markers, strict=True)
        ]
        return Problem.read(FOLDER / self.file, [*files, *overrides])


@dataclass(frozen=True, eq=False)
class Fit:
    """A solved problem with its error bars."""

    solution: Solution
    linearised: LinearisedFit
    uncertainty: Uncertainty


def main() -> None:
    parts = {
        "joint": joint,
        "refinement": refinement,
        "validation": validation,
        "poisson": poisson,
    }
    parser = argparse.ArgumentParser(
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--from",
        dest="source",
        type=Path,
        default=FOLDER,
        help="the recordings",
    )
    parser.add_argument(
        "--problem", default="problem.toml", help="a file of problems/srl_beam"
    )
    parser.add_argument(
        "--parts", nargs="+", choices=parts, default=list(parts)
    )
    arguments = parser.parse_args()
    for part in arguments.parts:
        print(f"\n== {part} ==\n", flush=True)
        parts[part](Beam(arguments.problem, arguments.source.resolve()))


@cache
def shipped(beam: Beam) -> Solution:
    """The problem as it is shipped, solved from its own guess."""
    return solve(beam.load())


def fit(problem: Problem, solution: Solution | None = None) -> Fit:
    """Solve a problem, where that is not done yet, and find the error bars."""
    solution = solution or solve(problem)
    if not solution.status.converged:
        print(f"NOT CONVERGED: {solution.message}")
    linearised = linearise_fit(solution.collocation, solution.z)
    return Fit(
        solution,
        linearised,
        uncertainty_from_fit(linearised, problem.parameters, solution.q),
    )


# Parts ----------------------------------------------------------------------------------------


def joint(beam: Beam) -> None:
    """One material for the three trials, and everything the report has to say of it."""
    found = fit(beam.load(), shipped(beam))
    solution = found.solution
    uncertainty = found.uncertainty
    print(
        f"{solution.message} {solution.iterations} sweeps, {solution.timing.total:.0f} s"
    )
    print(
        f"\n{'parameter':14}{'value':>12}   95 % interval ({uncertainty.errors} errors)"
    )
    for name, estimate in uncertainty.estimates.items():
        print(f"{name:14}{estimate.value:12.5g}   {interval(estimate)}")
    print(
        "\ncorrelations\n" + matrix(uncertainty.names, uncertainty.correlation)
    )
    print("\nnuisance parameters, and their standard deviations")
    for part in solution.collocation.iterates(solution.z):
        nuisance = part.segment.nuisance
        for name, value, scale in zip(
            nuisance.names, part.phi, nuisance.scales, strict=True
        ):
            deviation = uncertainty.nuisance[name] * scale
            print(
                f"  {name:45}{1e3 * value * scale:8.2f} ±{1e3 * deviation:6.2f} 1e-3"
            )
    print(f"\nRMS distance [mm]: {rms_line(solution)}")
    said = dict.fromkeys(
        (
            *solution.notes,
            *uncertainty.notes,
            *identifiability_sentences(uncertainty),
        )
    )
    sentences = [
        diagnosis.sentence for diagnosis in diagnose_markers(found.linearised)
    ]
    print("\n" + "\n".join(f"- {sentence}" for sentence in (*said, *sentences)))


def refinement(beam: Beam) -> None:
    """Print the joint fit on other meshes, with other time steps, and with other schemes."""
    print(
        f"{'':34}{'E [kPa]':>8}  95 % interval    γ_r [ms]  γ_m [1/s]  RMS [mm]"
    )
    near = shipped(beam)
    for substeps in SUBSTEPS:
        for scheme in SCHEMES:
            steps = f"transcription.substeps={substeps}"
            here = started(
                beam.load(f"transcription.scheme={scheme}", steps), near
            )
            report(f"{scheme}, {10 / substeps:g} ms", fit(here))
    with tempfile.TemporaryDirectory() as folder:
        for element, divisions in MESHES:
            mesh = Path(folder) / "beam.vtu"
            box_mesh(SIZE_M, divisions, ORIGIN_M).write(mesh)
            here = started(
                beam.load(f"object.mesh={mesh}", f"object.element={element}"),
                near,
            )
            bricks = " x ".join(map(str, divisions))
            report(
                f"{element} {bricks}, {len(here.bodies[0].nodes_m)} nodes",
                fit(here),
            )


def validation(beam: Beam) -> None:
    """Each trial predicted with the material of the other two."""
    together = shipped(beam)
    free = [item.name for item in together.collocation.parameters.free]
    print(f"{'predicted':12}" + "".join(f"{name:>15}" for name in free), end="")
    print(f"{'RMS [mm] with its nuisance':>30}{'without':>10}{'fitted':>9}")
    all_three = dict(zip(TRIALS, rms_mm(together), strict=True))
    for trial in TRIALS:
        problem = started(
            beam.load(f"experiment.{trial}.validation=true"), together
        )
        solution = solve(problem)
        with_own, without = predicted_rms_mm(problem, trial, solution)
        values = "".join(f"{solution.parameters[name]:15.5g}" for name in free)
        print(f"{trial:12}{values}", end="")
        print(
            f"{with_own:30.3f}{without:10.3f}{all_three[trial]:9.3f}",
            flush=True,
        )


def poisson(beam: Beam) -> None:
    """Poisson's ratio estimated too, and fixed at other values."""
    near = shipped(beam)
    free = "parameters.poisson={ guess = 0.45, lower = 0.05, upper = 0.495 }"
    found = fit(started(beam.load(free), near))
    report("estimated", found)
    ratio = found.uncertainty.estimates["poisson"]
    print(f"ν = {ratio.value:.3f}, {interval(ratio)}")
    said = dict.fromkeys(
        (
            *found.uncertainty.notes,
            *identifiability_sentences(found.uncertainty),
        )
    )
    print("\n".join(f"- {sentence}" for sentence in said))
    for value in (0.3, 0.4, 0.45, 0.48, 0.49):
        here = started(
            beam.load(f"parameters.poisson={{ fixed = {value} }}"), near
        )
        report(f"fixed at {value}", fit(here))


def predicted_rms_mm(
    problem: Problem, trial: str, solution: Solution
) -> tuple[float, float]:
    """RMS distance of a trial at a solution's material: its nuisance fitted, and all zero."""
    experiment = next(e for e in problem.experiments if e.name == trial)
    fixed = tuple(
        replace(item, guess=solution.parameters[item.name], is_fixed=True)
        for item in problem.parameters.items
    )
    collocation = replace(
        solution.collocation,
        experiments=[replace(experiment, validation=False)],
        parameters=replace(problem.parameters, items=fixed),
    )
    (part,) = collocation.iterates(ReducedSpace()(collocation).z)
    return rms_of(part), rms_of(replace(part, phi=np.zeros_like(part.phi)))


# Tables ---------------------------------------------------------------------------------------


def report(label: str, found: Fit) -> None:
    young = found.uncertainty.estimates["young_pa"]
    low, high = young.statistical95 or (np.nan, np.nan)
    values = found.solution.parameters
    print(
        f"{label:34}{1e-3 * young.value:8.1f}  {1e-3 * low:.1f} to {1e-3 * high:.1f}"
        f"{1e3 * values['gamma_r_s']:12.2f}{values['gamma_m_1_s']:11.2f}"
        f"  {rms_line(found.solution)}",
        flush=True,
    )


def interval(estimate: Estimate) -> str:
    if estimate.statistical95 is None:
        return estimate.reason or "fixed"
    low, high = estimate.statistical95
    reason = f" ({estimate.reason})" if estimate.reason else ""
    return f"{low:.4g} to {high:.4g}{reason}"


def matrix(names: Sequence[str], values: NDArray[np.float64]) -> str:
    rows = (
        f"{name:14}" + "".join(f"{value:13.3f}" for value in row)
        for name, row in zip(names, values, strict=True)
    )
    return "\n".join(
        [" " * 14 + "".join(f"{name:>13}" for name in names), *rows]
    )


def started(problem: Problem, solution: Solution) -> Problem:
    """The problem with an answer's values as guesses of what both estimate."""
    found = solution.parameters
    items = tuple(
        item
        if isinstance(item, FieldCoefficients)
        or item.is_fixed
        or item.name not in found
        else replace(item, guess=found[item.name])
        for item in problem.parameters.items
    )
    return replace(problem, parameters=replace(problem.parameters, items=items))


def rms_mm(solution: Solution) -> list[float]:
    return [rms_of(part) for part in solution.collocation.iterates(solution.z)]


def rms_of(part: ExperimentIterate) -> float:
    squares = part.segment.markers.squared_distances_m2(part.x, part.phi)
    return 1e3 * float(np.sqrt(squares.mean()))


def rms_line(solution: Solution) -> str:
    return " / ".join(f"{rms:.3f}" for rms in rms_mm(solution))


if __name__ == "__main__":
    main()
