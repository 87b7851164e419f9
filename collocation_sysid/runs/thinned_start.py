"""Start of a search with many unlabelled points: the same problem is solved with thinned clouds
first.

Every search of correspondences and every residual costs time for each point, but a few points per
face determine the shape almost as well as all. So the scan of the stiffness, the alignment of the
camera and all searches from several starts use thinned clouds, and the search with all points
begins at their solution. Its criterion of convergence is the same as without a thinned start.
"""

from __future__ import annotations

from dataclasses import replace

from ..fem.laws.constants import symbol_of
from ..methods.reduced_space import ReducedSpace
from ..methods.solution import Solution, Status
from ..methods.solve_recorder import Recorder
from ..problem import Problem
from ..program.collocation import Collocation
from ..program.measurement_models import with_correspondences
from ..recording.measurement_selection import thinned_experiment
from .coarse_start import undetermined_names

# Largest number of points of a thinned cloud: then other parts of a search take as long as the
# points.
THINNED_POINTS = 1500
# Number of points of a cloud above which a thinned start saves time: the search with all points
# takes a few sweeps more.
MANY_POINTS = 4000


class NoThinnedStartError(Exception):
    """Reason why a problem is not started from thinned clouds, as a part of a sentence."""


def thinned_problem(problem: Problem) -> Problem | None:
    """Return the problem with at most `THINNED_POINTS` unlabelled points in each sample of its
    sensors, without notes; None if none of the fitted experiments has more than `MANY_POINTS` in
    one. The problem is not modified.
    """
    experiments = [
        each if each.validation else thinned_experiment(each, many=MANY_POINTS, most=THINNED_POINTS)
        for each in problem.experiments
    ]
    pairs = zip(experiments, problem.experiments, strict=True)
    if all(thinned is given for thinned, given in pairs):
        return None
    return replace(problem, experiments=experiments, notes=())


def require_determined(thinned: Solution) -> None:
    """Raise `NoThinnedStartError` if a solution with thinned clouds did not converge, or does not
    determine an estimated parameter, see `undetermined_names`: all points may have the optimum
    elsewhere. Nothing is returned.
    """
    if not thinned.status.converged:
        raise NoThinnedStartError(
            f"the search with {point_counts(thinned.collocation)} ended with: {thinned.message}"
        )
    for name in undetermined_names(thinned):
        raise NoThinnedStartError(
            f"{point_counts(thinned.collocation)} do not determine {symbol_of(name)}"
        )


def collocation_with_all_points(problem: Problem, thinned: Solution) -> Collocation:
    """Return the program of a problem with the parameters, places and clocks of a solution with
    thinned clouds, and the correspondences of all points with its shapes.

    Its variables are those of `thinned.z`, which has the same parameters.

    Parameters
    ----------
    problem : Problem
        Given problem.
    thinned : Solution
        Solution of `thinned_problem`.
    """
    program = thinned.collocation
    given = {each.name: each for each in problem.experiments}
    associations = {}
    for iterate in program.iterates(thinned.z):
        transcription = iterate.transcription
        name = transcription.experiment.name
        correspondences = tuple(
            residual.correspondences_of(measured, iterate.x, phi=iterate.phi)
            for residual, measured in zip(
                transcription.reassociable, with_correspondences(given[name]), strict=True
            )
        )
        associations[name] = replace(transcription.association, correspondences=correspondences)
    return replace(program, experiments=problem.experiments, associations=associations)


def interrupted_with_all_points(problem: Problem, thinned: Solution) -> Solution:
    """Return the present point of an interrupted search with thinned clouds as an interrupted
    solution of the given problem; its history has one entry, the evaluation at that point.

    Parameters
    ----------
    problem : Problem
        Given problem; not modified.
    thinned : Solution
        Solution of `thinned_problem`, interrupted.
    """
    collocation = collocation_with_all_points(problem, thinned)
    recorder = Recorder(ReducedSpace.name, collocation)
    recorder.add_variables(0, thinned.z, collocation.objective(thinned.z))
    solution = recorder.solution(
        Status.INTERRUPTED,
        Status.INTERRUPTED.sentence,
        z=thinned.z,
        multipliers=thinned.initial_multipliers,
        iterations=0,
        evaluations=0,
    )
    note = (
        f"interrupted during the search with {point_counts(thinned.collocation)}: the values do "
        "not fit all points best"
    )
    return replace(
        solution, notes=(note,), scan=thinned.scan, timing=solution.timing + thinned.timing
    )


def point_counts(collocation: Collocation) -> str:
    """Return the number of unlabelled points of all fitted experiments, in words."""
    sensors = [
        sensor
        for transcription in collocation.transcriptions
        for sensor in transcription.experiment.separate_sensors
        if sensor.point_counts
    ]
    count = sum(sum(sensor.point_counts) for sensor in sensors)
    names = dict.fromkeys(sensor.points_name for sensor in sensors)
    return f"{count:,} {' and '.join(names)}"


def thinned_start_note(thinned: Solution, solution: Solution) -> str:
    """Return a note on the numbers of points of a search with thinned clouds and of the search with
    all points from there, and on the sweeps of the latter.
    """
    return (
        f"searched with {point_counts(thinned.collocation)} first, then with "
        f"{point_counts(solution.collocation)} in {solution.iterations} sweeps"
    )
