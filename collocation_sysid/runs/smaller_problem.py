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
from ..statistics.linearised import AT_BOUND, parameter_values
from .warm_start import WarmStart


class NoStartError(Exception):
    """Reason why a smaller problem gives no start, as a part of a sentence."""


@dataclass(frozen=True, eq=False)
class SmallerProblem(ABC):
    """A smaller problem, with the parameters of the given one, and its relation to that."""

    problem: Problem

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
    def size(self) -> str:
        """Size of the problem, with its preposition, for messages and progress."""

    @abstractmethod
    def start(self, problem: Problem, solution: Solution) -> Start:
        """Return the start of the given problem from a converged solution, with all variables.

        Raises
        ------
        NoStartError
            If the solution does not determine parameters that it should.
        """

    @abstractmethod
    def interrupted_start(self, problem: Problem, solution: Solution) -> Start:
        """Return the present point of an interrupted search, with a note."""

    @abstractmethod
    def notes(self, first: Solution, given: Solution) -> list[str]:
        """Return notes on the solutions of the smaller and of the given problem."""

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

    They are those within `AT_BOUND` of a bound, and those with a statistical standard error
    above 1 or not finite, both in the coordinates q of the solver, as a rule
    logarithms. On a mesh that is too coarse, weakly determined parameters compensate its error: a
    search from such values would take many steps. One sweep is needed; where it fails, only bounds
    count.
    """
    collocation = solution.collocation
    q = solution.q
    lower, upper = collocation.parameters.bounds_q
    is_excluded = (q - lower < AT_BOUND) | (upper - q < AT_BOUND)
    p, positions = collocation.unpack(solution.z)
    rows = [transcription.grid_times for transcription in collocation.transcriptions]
    try:
        fit = Horizon(collocation, rows).evaluate(p, positions).fit
    except SimulationError:
        pass
    else:
        errors = fit.standard_errors[: len(q)]
        is_excluded |= ~(errors <= 1.0)
    names = zip(collocation.parameters.free, is_excluded, strict=True)
    return tuple(item.name for item, excluded in names if excluded)


# Nodes of the given mesh over those of the coarse one: edges are then about twice as long, and a
# coarse sweep costs a tenth to a thirtieth.
NODE_RATIO = 8

# Fewest samples of a search that starts with some of them: with fewer, most of the time passes after
# the search.
FEWEST_SAMPLES = 250
# Deviation from a straight line between these samples, over the standard deviation of the tracks:
# that of a swing with 12 samples a period.
SMOOTH_SHARE = 0.03


@dataclass(frozen=True, eq=False)
class CoarseStart(SmallerProblem):
    """Problem on coarser meshes, or with fewer samples."""

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

    @property
    def size(self) -> str:
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
        return f"on {' and '.join(parts)}"

    @property
    def edge_ratio(self) -> float:
        """Mean edge length of the coarse mesh over that of the given one, the smallest
        of all coarsened bodies; mostly above 1.
        """
        return min(
            each.coarse.mesh.quality().edge_mean_m / each.body.mesh.quality().edge_mean_m
            for each in self.relations.values()
        )

    def start(self, problem: Problem, solution: Solution) -> Start:
        """A modulus that the coarse mesh does not determine gives no start. From interpolated samples
        a search needs several times as long to find a motion: it is simulated.
        """
        undetermined = undetermined_names(solution)
        for name in filter(is_modulus, undetermined):
            raise NoStartError(f"the coarse mesh does not determine {symbol_of(name)}")
        collocation = self._with_estimates(problem, solution, undetermined)
        start = self._interpolated_start(associated_at_guess(collocation), solution)
        if self.relations or start.variables is None:
            return start
        p, _ = start.collocation.unpack(start.variables)
        positions, failure = simulate_trajectories(start.collocation, p)
        if failure is not None:
            return start
        return replace(start, variables=start.collocation.pack(p, positions))

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
            f"interrupted during the search {self.size}: the motion is interpolated and does not "
            "satisfy the equations of motion of the given problem"
        )
        return replace(self._interpolated_start(collocation, solution), note=note)

    def notes(self, first: Solution, given: Solution) -> list[str]:
        where = "on the coarse mesh" if self.relations else "with some samples"
        notes = [
            f"coarse start: solved {self.size} first, with {first.iterations} sweeps in "
            f"{first.timing.total:.2g} s, then as given with {given.iterations} sweeps in "
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
    removed = count - len(relation.coarse.nodes.points_m)
    if removed < count / 2:  # the solve would take as long as that on the given mesh
        raise NoStartError(f"only {removed:,} of {count:,} nodes could be removed")
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
    def size(self) -> str:
        return f"with {point_counts(self.problem.collocation())}"

    def start(self, problem: Problem, solution: Solution) -> Start:
        """If the solution does not determine a parameter, all points may have the optimum elsewhere."""
        for name in undetermined_names(solution):
            points = point_counts(solution.collocation)
            raise NoStartError(f"{points} do not determine {symbol_of(name)}")
        return Start(collocation_with_all_points(problem, solution), solution.z)

    def interrupted_start(self, problem: Problem, solution: Solution) -> Start:
        note = f"interrupted during the search {self.size}: the values do not fit all points best"
        return Start(collocation_with_all_points(problem, solution), solution.z, note=note)

    def notes(self, first: Solution, given: Solution) -> list[str]:
        return [
            f"searched with {point_counts(first.collocation)} first, then with "
            f"{point_counts(given.collocation)} in {given.iterations} sweeps",
            *first.notes,
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
