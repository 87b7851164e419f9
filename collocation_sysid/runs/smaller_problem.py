"""Starts from smaller problems, with fewer unknowns or measurements, which are solved first.

Their answer replaces the scan of the stiffness, the simulations and the horizons of increasing
length on the given problem. The criterion of convergence is that of the given problem, and so is the
answer.

- `CoarseStart`: on a coarser mesh. The parameters, the nuisance parameters and the interpolated motion
  of the coarse body are the start on the given mesh. Of a recording that is sampled much faster than
  the body moves, every n-th sample serves in the same way. As both meshes see the same recordings, the
  difference of both answers also estimates the error that the given mesh leaves.
- `ThinnedStart`: with thinned clouds of unlabelled points. Every search of correspondences and every
  residual costs time for each point, but a few points per face determine the shape almost as well as
  all.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import scipy

from ..common.array_types import Array
from ..errors import InputError, SimulationError
from ..fem.body import Body
from ..fem.coarse_body import CoarseBody, coarsen_body
from ..fem.laws.constants import is_modulus, symbol_of
from ..methods.horizon import Horizon
from ..methods.reduced_space import ReducedSpace
from ..methods.solution import Solution
from ..methods.solve_recorder import interrupted_solution
from ..methods.starts.initial_trajectories import associated_at_guess, simulate_trajectories
from ..methods.starts.start import Start
from ..problem import Problem
from ..program.collocation import Collocation
from ..program.measurement_models import with_correspondences
from ..recording.experiment import Experiment
from ..recording.experiment_coarsening import coarse_experiment, node_sets
from ..recording.measurement_selection import smooth_distance, thinned_experiment, with_some_samples
from ..statistics.budget.discretisation_error import MESH_ORDER
from ..statistics.estimates import IntervalCoordinate
from ..statistics.linearised import parameter_values
from .warm_start import WarmStart

# Largest standard error of a parameter's coordinate, a logarithm as a rule, with which a smaller
# problem determines it.
LARGEST_STANDARD_ERROR = 1.0
# Distance of a coordinate from a bound below which the parameter is at the bound.
BOUND_DISTANCE = 1e-6


class NoStartError(Exception):
    """Reason why a smaller problem gives no start, as a part of a sentence."""


@dataclass(frozen=True, eq=False)
class SmallerProblem(ABC):
    """A smaller problem and its relation to the given one.

    Attributes
    ----------
    missing : str
        Beginning of the note on a start that was not found.
    has_second_start : bool
        Whether there may be another optimum of the given problem.
    """

    missing: ClassVar[str]
    has_second_start: ClassVar[bool]

    problem: Problem  # the smaller problem, with the parameters of the given one

    @classmethod
    @abstractmethod
    def of(cls, problem: Problem, method: ReducedSpace) -> SmallerProblem | None:
        """Return the smaller problem of a given one; None if it would save no time.

        Raises
        ------
        NoStartError
            If it would, but cannot be made.
        """

    @property
    @abstractmethod
    def activity(self) -> str:
        """Name of the search, for progress."""

    @property
    @abstractmethod
    def search(self) -> tuple[str, str]:
        """Name of the search, and the size of the problem with its preposition, for messages."""

    def tolerance(self, method: ReducedSpace) -> float:
        """Return the tolerance of the search on the given problem."""
        return method.tolerance

    @abstractmethod
    def given_collocation(self, problem: Problem, solution: Solution) -> Collocation:
        """Return the program of the given problem with the estimates of a converged solution.

        Raises
        ------
        NoStartError
            If the solution does not determine parameters that it should.
        """

    @abstractmethod
    def start(self, collocation: Collocation, solution: Solution) -> Start:
        """Return the start from a solution, with all variables, in a program of
        `given_collocation`.
        """

    @abstractmethod
    def interrupted_start(self, problem: Problem, solution: Solution) -> Start:
        """Return the present point of an interrupted search, with a note."""

    @abstractmethod
    def notes(self, first: Solution, given: Solution, replaced: Sequence[str]) -> list[str]:
        """Return notes on the solutions of the smaller and of the given problem; `replaced` are
        notes of the first that others replace.
        """

    def interrupted(self, problem: Problem, first: Solution) -> Solution:
        """Return the present point of an interrupted search as an interrupted solution of the given
        problem.
        """
        start = self.interrupted_start(problem, first)
        assert start.variables is not None
        solution = interrupted_solution(ReducedSpace.name, start.collocation, start.variables)
        timing = solution.timing + first.timing
        return replace(solution, notes=(start.note,), scan=first.scan, timing=timing)


def undetermined_names(solution: Solution) -> tuple[str, ...]:
    """Return the names of the estimated parameters, coefficients of fields included, that a
    solution does not determine, in their order.

    They are those within `BOUND_DISTANCE` of a bound, and those with a statistical standard error
    above `LARGEST_STANDARD_ERROR` or not finite, both in the coordinates q of the solver, as a rule
    logarithms. On a mesh that is too coarse, weakly determined parameters compensate its error: a
    search from such values would take many steps. One sweep is needed; where it fails, only bounds
    count.
    """
    collocation = solution.collocation
    q = solution.q
    lower, upper = collocation.parameters.bounds_q
    is_excluded = (q - lower < BOUND_DISTANCE) | (upper - q < BOUND_DISTANCE)
    p, positions = collocation.unpack(solution.z)
    rows = [transcription.grid_times for transcription in collocation.transcriptions]
    try:
        fit = Horizon(collocation, rows).evaluate(p, positions).fit
    except SimulationError:
        pass
    else:
        errors = fit.standard_errors[: len(q)]
        is_excluded |= ~(errors <= LARGEST_STANDARD_ERROR)
    names = zip(collocation.parameters.free, is_excluded, strict=True)
    return tuple(item.name for item, excluded in names if excluded)


# Nodes of the given mesh over those of the coarse one: edges are then about twice as long, and a
# coarse sweep costs a tenth to a thirtieth.
NODE_RATIO = 8
# Smallest reduction of the number of nodes for which a coarse start is worth its time.
LEAST_NODE_RATIO = 2.0
# Largest relative change of the volume: a coarser surface encloses less.
LARGEST_VOLUME_CHANGE = 0.2

# Numbers of samples from which a search starts with some of them, and that those are at least: with
# fewer, most of the time passes after the search.
MANY_SAMPLES = 500
FEWEST_SAMPLES = 150
# Deviation from a straight line between these samples, over the standard deviation of the tracks:
# that of a swing with 12 samples a period.
SMOOTH_SHARE = 0.03


@dataclass(frozen=True, eq=False)
class CoarseStart(SmallerProblem):
    """Problem on coarser meshes, or with fewer samples."""

    missing = "the search had no coarse start"
    has_second_start = True

    # mapping of str to CoarseBody: relation of coarse and given body, by experiment name;
    # experiments whose body is small are left out.
    relations: Mapping[str, CoarseBody]
    # n of the experiments of which every n-th sample is used, by name; others are left out.
    distances: Mapping[str, int]
    # Number of samples of these experiments in the given problem.
    given_samples: int

    @classmethod
    def of(cls, problem: Problem, method: ReducedSpace) -> CoarseStart | None:
        """Validation experiments and notes are left out, and small bodies keep their mesh."""
        fitted = [each for each in problem.experiments if not each.validation]
        if method.coarse_start != "auto":
            return None
        large = {
            id(each.body): each.body
            for each in fitted
            if each.specimen is None and len(each.body.nodes.points_m) > method.coarse_start_nodes
        }
        distances = {each.name: n for each in fitted if (n := sample_distance(each)) > 1}
        if not large and not distances:
            return None
        try:
            coarse = {key: _coarse_body(body, problem) for key, body in large.items()}
            relations = {
                each.name: coarse[id(each.body)] for each in fitted if id(each.body) in coarse
            }
            experiments = [
                coarse_experiment(each, relations[each.name]) if each.name in relations else each
                for each in fitted
            ]
            experiments = [
                with_some_samples(each, distances[each.name]) if each.name in distances else each
                for each in experiments
            ]
            moved = replace(problem, experiments=experiments, notes=())
        except InputError as error:
            raise NoStartError(error.message) from error
        samples = sum(len(each.t_s) for each in fitted if each.name in distances)
        return cls(moved, relations, distances, samples)

    def describe_size(self) -> str:
        """Return the numbers of nodes of the coarse and the given bodies, and of samples, in words."""
        parts = []
        if self.relations:
            distinct = {id(r.coarse): r for r in self.relations.values()}.values()
            coarse = sum(len(each.coarse.nodes.points_m) for each in distinct)
            given = sum(len(each.body.nodes.points_m) for each in distinct)
            parts.append(f"{coarse:,} of {given:,} nodes")
        if self.distances:
            some = (e for e in self.problem.experiments if e.name in self.distances)
            count = sum(len(each.t_s) for each in some)
            parts.append(f"{count:,} of {self.given_samples:,} samples")
        return " and ".join(parts)

    def describe_target(self) -> str:
        """Return on what the search ends, as a phrase."""
        return "on the given mesh" if self.relations else "with all samples"

    @property
    def activity(self) -> str:
        return f"coarse start on {self.describe_size()}"

    @property
    def search(self) -> tuple[str, str]:
        return "solve", f"on {self.describe_size()}"

    def tolerance(self, method: ReducedSpace) -> float:
        return method.tolerance_after_coarse

    @property
    def edge_ratio(self) -> float:
        """Mean edge length of the coarse mesh over that of the given one, the smallest
        of all coarsened bodies; mostly above 1.
        """
        return min(
            each.coarse.mesh.quality().edge_mean_m / each.body.mesh.quality().edge_mean_m
            for each in self.relations.values()
        )

    def given_collocation(self, problem: Problem, solution: Solution) -> Collocation:
        """A modulus that the coarse mesh does not determine gives no start."""
        undetermined = undetermined_names(solution)
        for name in filter(is_modulus, undetermined):
            raise NoStartError(f"the coarse mesh does not determine {symbol_of(name)}")
        return self._with_estimates(problem, solution, undetermined)

    def _with_estimates(
        self, problem: Problem, solution: Solution, undetermined: Sequence[str]
    ) -> Collocation:
        parameters = solution.collocation.parameters
        estimates = solution.parameters
        values = {
            item.name: estimates[item.name]
            for item in parameters.free
            if item.name not in undetermined
        }
        return replace(problem.collocation(), parameters=parameters.with_estimates(values))

    def start(self, collocation: Collocation, solution: Solution) -> Start:
        """The search needs several times as long to find a motion from interpolated samples."""
        start = self._interpolated_start(associated_at_guess(collocation), solution)
        if self.relations or start.variables is None:
            return start
        p, _ = start.collocation.unpack(start.variables)
        positions, failure = simulate_trajectories(start.collocation, p)
        if failure is not None:
            return start
        return replace(start, variables=start.collocation.pack(p, positions))

    def _interpolated_start(self, collocation: Collocation, solution: Solution) -> Start:
        warm = WarmStart.of(solution)
        collocation = warm.apply_to_places(collocation)
        p, _ = warm.apply_to_nuisance(collocation)
        p = np.clip(p, *collocation.parameter_bounds)
        _, coarse_positions = solution.collocation.unpack(solution.z)
        rows = [each.grid_times for each in collocation.transcriptions]
        z = collocation.pack(p, self.interpolated(coarse_positions, rows))
        return Start(collocation, z)

    def interrupted_start(self, problem: Problem, solution: Solution) -> Start:
        collocation = self._with_estimates(problem, solution, undetermined=())
        note = (
            f"interrupted during the coarse start ({self.describe_size()}): the motion is "
            f"interpolated and does not satisfy the equations of motion {self.describe_target()}"
        )
        return replace(self._interpolated_start(collocation, solution), note=note)

    def notes(self, first: Solution, given: Solution, replaced: Sequence[str]) -> list[str]:
        where = "on the coarse mesh" if self.relations else "with some samples"
        size, target = self.describe_size(), self.describe_target()
        notes = [
            f"coarse start: solved on {size} first, with {first.iterations} sweeps in "
            f"{first.timing.total:.2g} s, then {target} with {given.iterations} sweeps in "
            f"{given.timing.total:.2g} s",
            *(f"{where}: {note}" for note in first.notes),
        ]
        error_note = mesh_error_note(self, first, given) if given.status.converged else None
        return [*notes, error_note] if error_note else notes

    def interpolated(self, coarse_positions: Sequence[Array], rows: Sequence[int]) -> list[Array]:
        """Return positions (N, 3n) [m] of each fitted experiment on the given bodies and at the
        given times from those of the coarse problem, (M, 3m).

        All lists, of which `rows` has the numbers of times N, are in the order of the experiments
        of `problem`; positions of experiments that are not coarser are returned themselves.
        """
        names = [each.name for each in self.problem.experiments]
        return [
            self._at_all_times(name, self._interpolated(name, x), count)
            for name, x, count in zip(names, coarse_positions, rows, strict=True)
        ]

    def _at_all_times(self, experiment: str, x: Array, count: int) -> Array:
        """Return positions at all times of an experiment from those with some of its samples."""
        distance = self.distances.get(experiment)
        if distance is None:
            return x
        return scipy.interpolate.make_interp_spline(distance * np.arange(len(x)), x)(
            np.arange(count)
        )

    def _interpolated(self, experiment: str, x: Array) -> Array:
        """Return (N, 3n) from (N, 3m); nodes of obstacle frames, which come last, are copied."""
        relation = self.relations.get(experiment)
        if relation is None:
            return x
        matrix = relation.interpolation
        points = x.reshape(len(x), -1, 3)
        own = len(relation.coarse.nodes.points_m)
        by_node = points[:, :own].transpose(1, 0, 2).reshape(own, -1)
        interpolated = np.asarray(matrix @ by_node).reshape(-1, len(x), 3)
        return np.concatenate([interpolated.transpose(1, 0, 2), points[:, own:]], axis=1).reshape(
            len(x), -1
        )


def sample_distance(experiment: Experiment) -> int:
    """Return the distance of the samples of a recording with which the search starts."""
    most = len(experiment.t_s) // FEWEST_SAMPLES
    if len(experiment.t_s) < MANY_SAMPLES:
        return 1
    return smooth_distance(experiment, most=most, share=SMOOTH_SHARE)


def _coarse_body(body: Body, problem: Problem) -> CoarseBody:
    sets = [
        nodes
        for experiment in problem.experiments
        if experiment.body.mesh is body.mesh
        for nodes in node_sets(experiment)
    ]
    count = len(body.nodes.points_m)
    relation = coarsen_body(body, count // NODE_RATIO, sets)
    coarse = relation.coarse
    if len(coarse.nodes.points_m) * LEAST_NODE_RATIO > count:
        raise NoStartError(
            f"only {count - len(coarse.nodes.points_m):,} of {count:,} nodes could be removed"
        )
    change = coarse.mesh.volume_m3 / body.mesh.volume_m3 - 1
    if abs(change) > LARGEST_VOLUME_CHANGE:
        raise NoStartError(f"the volume of the coarser mesh differs by {change:+.0%}")
    return relation


def mesh_error_note(start: CoarseStart, coarse: Solution, given: Solution) -> str | None:
    """Return a note with the estimated error of the given mesh [%] in each estimated scalar
    parameter; None if none is estimated, or every estimate is zero or has no finite error, and if
    the mesh was the same.

    With edge lengths in the ratio r, elements of order 2 leave the r² − 1-th part of the difference
    of both solutions (Richardson's extrapolation, as in `discretisation_error`), in the coordinate
    in which the interval of the parameter is symmetric. The difference includes that of the
    surfaces.

    Parameters
    ----------
    start : CoarseStart
        Relation of the coarse and the given problem, which has the ratio of the edges.
    coarse, given : Solution
        Converged solutions on the coarse and on the given mesh.
    """
    if not start.relations:
        return None
    before = parameter_values(coarse.collocation, coarse.q)
    after = parameter_values(given.collocation, given.q)
    share = 1.0 / (start.edge_ratio**MESH_ORDER - 1.0)
    linear = given.collocation.parameters.linear_names
    errors = []
    for item in given.collocation.parameters.free_scalars:
        name = item.name
        if after[name] == 0:
            continue
        at = IntervalCoordinate.for_estimate(
            name, (before[name], after[name]), linear=name in linear
        )
        x = at.from_value(after[name])
        limit = at.to_value(x + share * (x - at.from_value(before[name])))
        error = (after[name] - limit) / abs(after[name])
        if np.isfinite(error):
            errors.append(f"{symbol_of(name)} {100 * error:+.2g} %")
    if not errors:
        return None
    return (
        "estimated error of the mesh, from the difference of both meshes: "
        f"{', '.join(errors)}; it is not part of the intervals: `refine` measures it and corrects "
        "the values"
    )


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
