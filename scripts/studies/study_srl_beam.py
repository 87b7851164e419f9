"""Predictions of each of the three trials of the measured beam from a fit to the others.

The problem is one of problems/srl_beam, solved by reduced space.

    python scripts study_srl_beam --problem memory.toml
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from get_srl_beam import FOLDER
from script_arguments import make_parser

from collocation_sysid import Problem, Solution, solve
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.model.parameters import FieldCoefficients
from collocation_sysid.program.collocation import ExperimentIterate

TRIALS = ("gravity", "load52", "load101")


def main() -> None:
    """Print the prediction of each trial with the material of the other two."""
    parser = make_parser(__doc__)
    parser.add_argument("--problem", default="problem.toml", help="a file of problems/srl_beam")
    file = FOLDER / parser.parse_args().problem
    joint = solve(Problem.read(file))
    free = [item.name for item in joint.collocation.parameters.free]
    print(f"{'predicted':12}" + "".join(f"{name:>15}" for name in free), end="")
    print(f"{'RMS [mm] with its nuisance':>30}{'without':>10}{'in joint fit':>14}")
    parts = joint.collocation.iterates(joint.z)
    for trial, part in zip(TRIALS, parts, strict=True):
        held_out = Problem.read(file, [f"experiment.{trial}.validation=true"])
        problem = with_guesses_from(held_out, joint)
        solution = solve(problem)
        with_nuisance, without = predicted_rms_mm(problem, trial, solution)
        values = "".join(f"{solution.parameters[name]:15.5g}" for name in free)
        print(f"{trial:12}{values}", end="")
        print(f"{with_nuisance:30.3f}{without:10.3f}{rms_of(part):14.3f}", flush=True)


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


def rms_of(part: ExperimentIterate) -> float:
    """Return the RMS marker distance of one experiment [mm]."""
    squares = part.transcription.markers.squared_distances_m2(part.x, part.phi)
    return 1e3 * float(np.sqrt(squares.mean()))


if __name__ == "__main__":
    main()
