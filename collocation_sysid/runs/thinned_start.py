"""Start of a search with many unlabelled points: the same problem is solved with thinned clouds
first.

Every search of correspondences and every residual costs time for each point, but a few points per
face determine the shape almost as well as all. So the scan of the stiffness, the alignment of the
camera and all searches from several starts use thinned clouds, and the search with all points
begins at their solution.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from ..fem.laws.constants import symbol_of
from ..methods.reduced_space import ReducedSpace
from ..methods.solution import Solution
from ..methods.starts.start import Start
from ..problem import Problem
from ..program.collocation import Collocation
from ..program.measurement_models import with_correspondences
from ..recording.measurement_selection import thinned_experiment
from .smaller_problem import NoStartError, SmallerProblem, undetermined_names

# Largest number of points of a thinned cloud: then other parts of a search take as long as the
# points.
THINNED_POINTS = 1500
# Number of points of a cloud above which a thinned start saves time: the search with all points
# takes a few sweeps more.
MANY_POINTS = 4000


@dataclass(frozen=True, eq=False)
class ThinnedStart(SmallerProblem):
    """Problem with thinned clouds, which determines the same parameters as the given one."""

    missing = "the search was not started with fewer points"
    has_second_start = False

    @classmethod
    def of(cls, problem: Problem, method: ReducedSpace) -> ThinnedStart | None:
        """Keep `THINNED_POINTS` of each sample; None if no sample has more than `MANY_POINTS`."""
        experiments = [
            each
            if each.validation
            else thinned_experiment(each, many=MANY_POINTS, most=THINNED_POINTS)
            for each in problem.experiments
        ]
        pairs = zip(experiments, problem.experiments, strict=True)
        if all(thinned is given for thinned, given in pairs):
            return None
        return cls(replace(problem, experiments=experiments, notes=()))

    @property
    def activity(self) -> str:
        return "search with fewer points"

    @property
    def search(self) -> tuple[str, str]:
        return "search", f"with {point_counts(self.problem.collocation())}"

    def given_collocation(self, problem: Problem, solution: Solution) -> Collocation:
        """Return the program of a problem with the parameters, places and clocks of a solution with
        thinned clouds, and the correspondences of all points with its shapes.

        Its variables are those of the solution, which has the same parameters.

        Raises
        ------
        NoStartError
            If the solution does not determine a parameter: all points may have the optimum
            elsewhere.
        """
        for name in undetermined_names(solution):
            raise NoStartError(
                f"{point_counts(solution.collocation)} do not determine {symbol_of(name)}"
            )
        return collocation_with_all_points(problem, solution)

    def start(self, collocation: Collocation, solution: Solution) -> Start:
        return Start(collocation, solution.z)

    def interrupted_start(self, problem: Problem, solution: Solution) -> Start:
        note = (
            f"interrupted during the search with {point_counts(solution.collocation)}: the values "
            "do not fit all points best"
        )
        return Start(collocation_with_all_points(problem, solution), solution.z, note=note)

    def notes(self, first: Solution, given: Solution, replaced: Sequence[str]) -> list[str]:
        return [
            f"searched with {point_counts(first.collocation)} first, then with "
            f"{point_counts(given.collocation)} in {given.iterations} sweeps",
            *(note for note in first.notes if note not in (*given.notes, *replaced)),
        ]


def collocation_with_all_points(problem: Problem, thinned: Solution) -> Collocation:
    """Return the program of a problem with the parameters, places and clocks of a solution with
    thinned clouds, and the correspondences of all points with its shapes.

    Its variables are those of `thinned.z`, which has the same parameters.

    Parameters
    ----------
    thinned : Solution
        Solution of a `ThinnedStart`'s problem.
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
