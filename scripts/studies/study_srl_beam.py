"""Results for the measured beam: joint fit of three trials, and prediction of each from the others.

The problem is one of problems/srl_beam, solved by reduced space.

    python scripts study_srl_beam --from FOLDER --problem memory.toml --parts joint validation
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from get_srl_beam import FOLDER
from script_arguments import make_parser

from collocation_sysid import Problem, Solution, solve
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.model.parameters import FieldCoefficients
from collocation_sysid.program.collocation import ExperimentIterate
from collocation_sysid.statistics.estimates import Estimate
from collocation_sysid.statistics.identifiability import identifiability_sentences
from collocation_sysid.statistics.linearised import linearise_fit
from collocation_sysid.statistics.residuals.diagnostics import diagnose_markers
from collocation_sysid.statistics.uncertainty import uncertainty_from_fit

TRIALS = ("gravity", "load52", "load101")


@dataclass(frozen=True)
class Beam:
    """A problem file of the beam, and the folder with its recordings."""

    file: str
    recordings: Path

    def load(self, *overrides: str) -> Problem:
        """Return the problem with these recordings, and with other values of some keys."""
        markers = (self.recordings / f"beam_{trial}_V2_a.c3d" for trial in TRIALS)
        files = [
            f"experiment.{trial}.markers.file={file}"
            for trial, file in zip(TRIALS, markers, strict=True)
        ]
        return Problem.read(FOLDER / self.file, [*files, *overrides])


def main() -> None:
    parts = {"joint": print_joint_fit, "validation": print_validation}
    parser = make_parser(__doc__)
    parser.add_argument("--from", dest="source", type=Path, default=FOLDER, help="the recordings")
    parser.add_argument("--problem", default="problem.toml", help="a file of problems/srl_beam")
    parser.add_argument("--parts", nargs="+", choices=parts, default=list(parts))
    arguments = parser.parse_args()
    for part in arguments.parts:
        print(f"\n== {part} ==\n", flush=True)
        parts[part](Beam(arguments.problem, arguments.source.resolve()))


@cache
def shipped(beam: Beam) -> Solution:
    """Return the solution of the shipped problem from its own guess; cached."""
    return solve(beam.load())


# Parts ----------------------------------------------------------------------------------------


def print_joint_fit(beam: Beam) -> None:
    """Print the fit of one material to the three trials: parameters, nuisance parameters and notes."""
    problem, solution = beam.load(), shipped(beam)
    linearised = linearise_fit(solution.collocation, solution.z)
    uncertainty = uncertainty_from_fit(linearised, problem.parameters, solution.q)
    print(f"{solution.message} {solution.iterations} sweeps, {solution.timing.total:.0f} s")
    print(f"\n{'parameter':14}{'value':>12}   95 % interval ({uncertainty.errors} errors)")
    for name, estimate in uncertainty.estimates.items():
        print(f"{name:14}{estimate.value:12.5g}   {interval(estimate)}")
    print("\nnuisance parameters, and their standard deviations")
    for part in solution.collocation.iterates(solution.z):
        nuisance = part.transcription.nuisance
        for name, value, scale in zip(nuisance.names, part.phi, nuisance.scales, strict=True):
            deviation = uncertainty.nuisance[name] * scale
            print(f"  {name:45}{1e3 * value * scale:8.2f} ±{1e3 * deviation:6.2f} 1e-3")
    print(f"\nRMS distance [mm]: {rms_line(solution)}")
    notes = dict.fromkeys(
        (*solution.notes, *uncertainty.notes, *identifiability_sentences(uncertainty))
    )
    sentences = [diagnosis.sentence for diagnosis in diagnose_markers(linearised)]
    print("\n" + "\n".join(f"- {sentence}" for sentence in (*notes, *sentences)))


def print_validation(beam: Beam) -> None:
    """Print the prediction of each trial with the material of the other two."""
    joint_answer = shipped(beam)
    free = [item.name for item in joint_answer.collocation.parameters.free]
    print(f"{'predicted':12}" + "".join(f"{name:>15}" for name in free), end="")
    print(f"{'RMS [mm] with its nuisance':>30}{'without':>10}{'in joint fit':>14}")
    joint_rms_mm = dict(zip(TRIALS, rms_mm(joint_answer), strict=True))
    for trial in TRIALS:
        problem = with_guesses_from(beam.load(f"experiment.{trial}.validation=true"), joint_answer)
        solution = solve(problem)
        with_nuisance, without = predicted_rms_mm(problem, trial, solution)
        values = "".join(f"{solution.parameters[name]:15.5g}" for name in free)
        print(f"{trial:12}{values}", end="")
        print(f"{with_nuisance:30.3f}{without:10.3f}{joint_rms_mm[trial]:14.3f}", flush=True)


def predicted_rms_mm(problem: Problem, trial: str, solution: Solution) -> tuple[float, float]:
    """Return the RMS distances [mm] of a trial at the material of a solution.

    The first is with fitted nuisance parameters of the trial, the second with all of them zero.
    """
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


def interval(estimate: Estimate) -> str:
    """Return the statistical interval as text, or the reason why there is none."""
    if estimate.statistical95 is None:
        return estimate.reason or "fixed"
    low, high = estimate.statistical95
    reason = f" ({estimate.reason})" if estimate.reason else ""
    return f"{low:.4g} to {high:.4g}{reason}"


def with_guesses_from(problem: Problem, solution: Solution) -> Problem:
    """Return the problem with the estimates of a solution as guesses of its free parameters."""
    values = solution.parameters
    items = tuple(
        item
        if isinstance(item, FieldCoefficients) or item.is_fixed or item.name not in values
        else replace(item, guess=values[item.name])
        for item in problem.parameters.items
    )
    return replace(problem, parameters=replace(problem.parameters, items=items))


def rms_mm(solution: Solution) -> list[float]:
    """Return the RMS marker distance of each experiment [mm]."""
    return [rms_of(part) for part in solution.collocation.iterates(solution.z)]


def rms_of(part: ExperimentIterate) -> float:
    """Return the RMS marker distance of one experiment [mm]."""
    squares = part.transcription.markers.squared_distances_m2(part.x, part.phi)
    return 1e3 * float(np.sqrt(squares.mean()))


def rms_line(solution: Solution) -> str:
    """Return the RMS marker distances of all experiments as text."""
    return " / ".join(f"{rms:.3f}" for rms in rms_mm(solution))


if __name__ == "__main__":
    main()
