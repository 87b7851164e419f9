"""Start of a large search: the same problem is solved on a coarser mesh, or with fewer samples, first.

The parameters, the nuisance parameters and the interpolated motion of the coarse body are the start
on the given mesh, which replaces the scan of the stiffness, the simulations and the horizons of
increasing length there. The criterion of convergence on the given mesh is the same, and so is the
answer. Of a recording that is sampled much faster than the body moves, every n-th sample serves in
the same way. As both meshes see the same recordings, the difference of both answers also estimates the
error that the given mesh leaves, see `mesh_error_note`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import make_interp_spline

from ..common.array_types import Array
from ..errors import InputError, SimulationError
from ..fem.body import Body
from ..fem.coarse_body import CoarseBody, coarsen_body
from ..fem.laws.constants import is_modulus, symbol_of
from ..methods.horizon import Horizon
from ..methods.reduced_space import ReducedSpace
from ..methods.solution import Solution, Status
from ..methods.solve_recorder import Recorder
from ..methods.starts.initial_trajectories import simulate_trajectories
from ..problem import Problem
from ..program.collocation import Collocation
from ..recording.experiment import Experiment
from ..recording.experiment_coarsening import coarse_experiment, node_sets
from ..recording.measurement_selection import smooth_distance, with_some_samples
from ..statistics.budget.discretisation_error import MESH_ORDER
from ..statistics.estimates import IntervalCoordinate
from ..statistics.linearised import parameter_values
from .warm_start import WarmStart

# Nodes of the given mesh over those of the coarse one: edges are then about twice as long, and a
# coarse sweep costs a tenth to a thirtieth.
NODE_RATIO = 8
# Smallest reduction of the number of nodes for which a coarse start is worth its time.
LEAST_NODE_RATIO = 2.0
# Largest relative change of the volume: a coarser surface encloses less.
LARGEST_VOLUME_CHANGE = 0.2
# Largest standard error of a parameter's coordinate, a logarithm as a rule, with which the coarse
# mesh determines it.
LARGEST_STANDARD_ERROR = 1.0
# Distance of a coordinate from a bound below which the parameter is at the bound.
BOUND_DISTANCE = 1e-6


# Numbers of samples from which a search starts with some of them, and that those are at least: with
# fewer, most of the time passes after the search.
MANY_SAMPLES = 500
FEWEST_SAMPLES = 150
# Deviation from a straight line between these samples, over the standard deviation of the tracks:
# that of a swing with 12 samples a period.
SMOOTH_SHARE = 0.03


class NoCoarseStartError(Exception):
    """Reason why a problem has no coarse start, as a part of a sentence."""


@dataclass(frozen=True, eq=False)
class CoarseStart:
    """Problem on coarser meshes, or with fewer samples."""

    # Fitted experiments on coarse bodies, with the parameters of the given problem.
    problem: Problem
    # mapping of str to CoarseBody: relation of coarse and given body, by experiment name;
    # experiments whose body is small are left out.
    relations: Mapping[str, CoarseBody]
    # n of the experiments of which every n-th sample is used, by name; others are left out.
    distances: Mapping[str, int]
    # Number of samples of these experiments in the given problem.
    given_samples: int

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
    def edge_ratio(self) -> float:
        """Mean edge length of the coarse mesh over that of the given one, the smallest
        of all coarsened bodies; mostly above 1.
        """
        return min(
            each.coarse.mesh.quality().edge_mean_m / each.body.mesh.quality().edge_mean_m
            for each in self.relations.values()
        )

    def given_collocation(
        self, problem: Problem, solution: Solution, undetermined: Sequence[str]
    ) -> Collocation:
        """Return the program of the given problem with the parameters of a coarse solution as
        guesses, within their bounds; of those that the coarse mesh does not determine, the guess of
        the coarse solve.

        Parameters
        ----------
        solution : Solution
            Solution on the coarse meshes.
        undetermined : sequence of str
            Parameters that it does not determine, see `undetermined_names`.
        """
        parameters = solution.collocation.parameters
        estimates = solution.parameters
        values = {
            item.name: estimates[item.name]
            for item in parameters.free
            if item.name not in undetermined
        }
        return replace(problem.collocation(), parameters=parameters.with_estimates(values))

    def variables(self, collocation: Collocation, solution: Solution) -> Array:
        """Return variables z (variables,) of the given problem from a coarse solution.

        Nuisance parameters are limited to their bounds.

        Parameters
        ----------
        collocation : Collocation
            Program of the given problem, see `given_collocation`, with the places of markers of
            the coarse solution.
        solution : Solution
            Solution on the coarse meshes.
        """
        p, _ = WarmStart.of(solution).apply_to_nuisance(collocation)
        p = np.clip(p, *collocation.parameter_bounds)
        _, coarse_positions = solution.collocation.unpack(solution.z)
        rows = [each.grid_times for each in collocation.transcriptions]
        return collocation.pack(p, self.interpolated(coarse_positions, rows))

    def simulated_variables(self, collocation: Collocation, solution: Solution) -> Array:
        """Return variables z (variables,) as `variables`, with a simulated motion in place of one
        that is interpolated in time; the latter where the simulation fails, and on coarser meshes.

        The search needs several times as long to find a motion from interpolated samples.
        """
        z = self.variables(collocation, solution)
        if self.relations:
            return z
        p, _ = collocation.unpack(z)
        positions, failure = simulate_trajectories(collocation, p)
        return z if failure is not None else collocation.pack(p, positions)

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
        return make_interp_spline(distance * np.arange(len(x)), x)(np.arange(count))

    def _interpolated(self, experiment: str, x: Array) -> Array:
        """Return positions (N, 3n) of the given body from those of the coarse one (N, 3m); nodes of
        obstacle frames, which come last, are copied, and positions of an experiment whose body is
        not coarsened are returned themselves.
        """
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


def plan_coarse_start(problem: Problem, method: ReducedSpace) -> CoarseStart | None:
    """Return the fitted experiments of a problem on coarser meshes and with fewer samples, or None if
    the method's options, the sizes of the bodies and the numbers of samples do not call for a
    coarse start.

    Validation experiments and notes are left out, and small bodies keep their mesh; the problem is
    not modified.

    Raises
    ------
    NoCoarseStartError
        If a body is large enough, but the problem cannot be transferred to a coarser mesh.
    """
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
        relations = {each.name: coarse[id(each.body)] for each in fitted if id(each.body) in coarse}
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
        raise NoCoarseStartError(error.message) from error
    samples = sum(len(each.t_s) for each in fitted if each.name in distances)
    return CoarseStart(moved, relations, distances, samples)


def sample_distance(experiment: Experiment) -> int:
    """Return the distance of the samples of a recording with which the search starts."""
    most = len(experiment.t_s) // FEWEST_SAMPLES
    if len(experiment.t_s) < MANY_SAMPLES:
        return 1
    return smooth_distance(experiment, most=most, share=SMOOTH_SHARE)


def _coarse_body(body: Body, problem: Problem) -> CoarseBody:
    """Return a body of the problem on a coarser mesh, with the node sets of all experiments on the
    same mesh.
    """
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
        raise NoCoarseStartError(
            f"only {count - len(coarse.nodes.points_m):,} of {count:,} nodes could be removed"
        )
    change = coarse.mesh.volume_m3 / body.mesh.volume_m3 - 1
    if abs(change) > LARGEST_VOLUME_CHANGE:
        raise NoCoarseStartError(f"the volume of the coarser mesh differs by {change:+.0%}")
    return relation


def interrupted_solution(start: CoarseStart, problem: Problem, coarse: Solution) -> Solution:
    """Return the present point of an interrupted coarse solve as an interrupted solution of the
    given problem: parameters of the coarse solution and interpolated positions.

    Its history has one entry, the evaluation at that point; no iteration was done on the given
    mesh.

    Parameters
    ----------
    start : CoarseStart
        Relation of the coarse and the given problem.
    problem : Problem
        Given problem; not modified.
    coarse : Solution
        Solution of `start.problem`, interrupted.
    """
    collocation = start.given_collocation(problem, coarse, undetermined=())
    collocation = WarmStart.of(coarse).apply_to_places(collocation)
    z = start.variables(collocation, coarse)
    recorder = Recorder(ReducedSpace.name, collocation)
    recorder.add_variables(0, z, collocation.objective(z))
    solution = recorder.solution(
        Status.INTERRUPTED,
        Status.INTERRUPTED.sentence,
        z=z,
        multipliers=np.zeros(collocation.constraint_count),
        iterations=0,
        evaluations=0,
    )
    note = (
        f"interrupted during the coarse start ({start.describe_size()}): the motion is interpolated "
        f"and does not satisfy the equations of motion {start.describe_target()}"
    )
    return replace(
        solution, notes=(note,), scan=coarse.scan, timing=solution.timing + coarse.timing
    )


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


def require_determined_moduli(undetermined: Sequence[str]) -> None:
    """Raise `NoCoarseStartError` if a modulus is among the parameters that a coarse solution does
    not determine, see `undetermined_names`: the coarse mesh then does not describe the motion.
    `undetermined` contains names of parameters, with their regions; nothing is returned.
    """
    for name in undetermined:
        if is_modulus(name):
            raise NoCoarseStartError(f"the coarse mesh does not determine {symbol_of(name)}")


def start_note(start: CoarseStart, coarse: Solution, given: Solution) -> str:
    """Return a note on the coarse start `start` with its size, and the number of sweeps and the
    time [s] of the solutions on the coarse and on the given mesh.
    """
    return (
        f"coarse start: solved on {start.describe_size()} first, with {coarse.iterations} sweeps in "
        f"{coarse.timing.total:.2g} s, then {start.describe_target()} with {given.iterations} sweeps in "
        f"{given.timing.total:.2g} s"
    )


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
