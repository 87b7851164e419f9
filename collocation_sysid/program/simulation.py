"""Forward simulation of an experiment by Newmark's method or any collocation scheme.

By default the steps are refined until the motion at the samples no longer depends on them. A run
with automatic substeps solves with fine steps too, so that it recovers the parameters of data
simulated by default. Data simulated with one step a sample correspond to other parameters: the
midpoint rule lowers the frequencies of fast modes, and a run that resolves these modes finds moduli
that are too small.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from ..common.array_types import Array
from ..common.checked_arrays import float_array
from ..common.validated_classes import validated
from ..common.validated_types import Positive, Substeps
from ..errors import InputError, SimulationError
from ..fem.laws.constants import with_undamped
from ..fem.schemes import MOST_STEPS, Scheme, as_scheme
from ..model.dynamics import Dynamics
from ..model.parameters import Parameters, resolve_theta
from ..recording.custom_sensor import CustomSensor
from ..recording.experiment import Experiment
from ..recording.markers import Markers
from ..recording.measured_wrench import Wrench
from ..recording.measurement import Measurement
from ..recording.nuisance import Nuisance
from .association import Association
from .forward.loss_of_stability import explain_failure
from .forward.newmark import simulate_newmark
from .forward.newton_solver import NewtonOptions
from .forward.scheme_simulation import Progress, simulate_scheme
from .forward.stable_path import BranchChange, find_branch_change
from .markers.association import MarkerAssociation
from .measurement_model import CorrespondenceModel, MotionGrid
from .measurement_models import measurement_models
from .measurement_residual import SampledMotion
from .observables import ObservedMotion, ReactionForces
from .reactions.forces import reactions_at
from .reactions.resultant import ReactionGrid, sensed_dofs

# Name of the integrator that is no collocation scheme.
NEWMARK = "newmark"
# Order of accuracy of Newmark's method with the trapezoidal rule.
NEWMARK_ORDER = 2
# Steps a sample that automatic refinement begins with.
FIRST_NEWMARK_STEPS = 4
# The same of a collocation scheme: the grid of a solve with one step.
FIRST_SCHEME_STEPS = 1
# Largest number of steps a sample that automatic refinement takes: the cost of all refinements
# together is then 63 times that of one step a sample.
MOST_AUTOMATIC_STEPS = 32
# Number of dofs that are simulated together: their factors fit the cache.
DOFS_TOGETHER = 10_000
# Share of the first pass in a simulation with automatic steps: half of the second one, which is
# the last one at the earliest.
FIRST_PASS_SHARE = 1 / 3
# Largest error of node positions at the samples, relative to the way of the node that moves
# farthest, that automatic refinement accepts. For a swung block it changes E by 0.4 %
# (`tests/program/test_substeps.py`), which a run's interval for its own step covers.
STEP_TOLERANCE = 1e-4
# Error relative to the size of the body that is rounding of Newton's method.
ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Simulated motion of an experiment, with the predictions of its measurements without noise.

    Attributes
    ----------
    experiment : Experiment
        The experiment.
    positions_m : (T, n, 3) array
        Node positions [m].
    velocities_m_s : (T, n, 3) array
        Node velocities [m/s]; zero in a static experiment.
    reactions : (ReactionGrid, ReactionForces)
        Reaction forces on the dofs of instrumented grasps at the times of the time steps, and these
        times.
    predicted : tuple
        Prediction of each of `Experiment.measurements`, in their order: its numbers (S, m), NaN
        outside the known times. Those of a depth camera are none, m = 0, as `simulate` predicts
        them; in the forward simulation of a run its points are compared with the surface.
    steps_per_sample : int
        Time steps between samples; 1 in a static experiment.
    step_error_m : float or None
        Largest error of node positions at the samples due to the time step [m], estimated by
        halving the step; None where the step was stated, the experiment is static, or only the
        finest steps could be simulated.
    equilibria : Dynamics or None
        Equations of a static experiment at the parameters; None for a motion.
    """

    experiment: Experiment
    positions_m: Array = field(repr=False)
    velocities_m_s: Array = field(repr=False)
    reactions: tuple[ReactionGrid, ReactionForces] = field(repr=False)
    predicted: tuple[Any, ...] = field(default=(), repr=False)
    steps_per_sample: int = 1
    step_error_m: float | None = None
    equilibria: Dynamics | None = field(default=None, repr=False)

    @property
    def t_s(self) -> Array:
        """Times (T,) of the samples [s]."""
        return self.experiment.t_s

    @property
    def sampled(self) -> SampledMotion:
        """Motion at the samples with reaction forces, of which measurements are functions."""
        x = self.positions_m.reshape(len(self.t_s), -1)
        return SampledMotion(self.t_s, self.reactions[0], ObservedMotion(x, self.reactions[1]))

    @property
    def markers_m(self) -> Array:
        """Predicted markers (T, M, 3) [m]."""
        tracks = self._predicted_of(Markers)
        return (
            tracks[0].reshape(len(self.t_s), -1, 3) if tracks else np.zeros((len(self.t_s), 0, 3))
        )

    @property
    def wrenches(self) -> tuple[Array, ...]:
        """Predictions (S, 6) of the force–torque sensors [N] and [N m]."""
        return self._predicted_of(Wrench)

    @property
    def custom_sensor_values(self) -> tuple[Array, ...]:
        """Predictions (S, m) of the custom sensors."""
        return self._predicted_of(CustomSensor)

    def _predicted_of(self, kind: type[Measurement]) -> tuple[Array, ...]:
        pairs = zip(self.experiment.measurements, self.predicted, strict=True)
        return tuple(values for measurement, values in pairs if isinstance(measurement, kind))

    @cached_property
    def branch_change(self) -> BranchChange | None:
        """First sample of a static experiment that is not on the path of stable equilibria to which
        its loads lead, see `program.find_branch_change`; None if there is none.
        """
        if self.equilibria is None:
            return None
        return find_branch_change(self.experiment, self.equilibria, self.sampled.observed.x)


def require_steps(experiment: Experiment, step_s: float) -> None:
    """Raise InputError if time steps of `step_s` [s] would be more than `MOST_STEPS` per sample of
    an experiment; a static one has none.
    """
    if not experiment.is_static and experiment.timestep_s > MOST_STEPS * step_s:
        raise InputError(
            f"found a time step of {step_s:g} s, which gives {experiment.timestep_s / step_s:.3g} "
            f"steps from sample to sample; expected at most {MOST_STEPS}: state a longer step"
        )


@validated
def simulate(
    experiment: Experiment,
    parameters: Parameters | Mapping[str, float] | Sequence[float] | Array,
    integrator: str | Scheme = NEWMARK,
    timestep_s: Positive | None = None,
    substeps: Substeps | Literal["auto"] = "auto",
    options: NewtonOptions | None = None,
    progress: Progress | None = None,
    is_measured: bool = True,
) -> Trajectory:
    """Simulate an experiment forward from its start; a static one from equilibrium to equilibrium.

    Parameters
    ----------
    experiment : Experiment
        The experiment; measurements are not used, nor are its nuisance parameters.
    parameters : Parameters, mapping or sequence of float
        Parameters (their guesses are used), values by name, or θ in the order of the body.
    integrator : str or Scheme
        "newmark", or a scheme on the collocation grid, by its name in `schemes.SCHEMES`. A static
        experiment is simulated in the same way with all.
    timestep_s : float, optional
        Newmark's step [s], rounded to divide the sample interval; ignored for schemes.
    substeps : int or "auto"
        Time steps between samples; ignored where `timestep_s` is given for Newmark. "auto" doubles
        them until the node positions at the samples are accurate to 0.01 % of the largest
        displacement, at most 32 (`Trajectory.steps_per_sample`, `Trajectory.step_error_m`). If 32
        do not suffice, the result with 32 is returned.
    options : NewtonOptions, optional
        Options of Newton's method.
    progress : callable, optional
        Called with the share done, ascending from 0 to 1. Automatic steps take several passes,
        whose number is not known before: each pass takes a part of what remains, and the share
        may end before 1.
    is_measured : bool
        Whether the measurements are predicted, too.

    Returns
    -------
    Trajectory
        The motion at the experiment's samples.

    Raises
    ------
    InputError
        For a step or substeps that are not positive, too many steps, an unknown scheme, a density
        that leaves a node without mass, or a stress-free shape that cannot be computed.
    SimulationError
        When a step fails even after halvings; names time and element, and where an equilibrium
        ceased to be stable the mode, see `program.find_stability_loss`.
    """
    body = experiment.body
    if experiment.specimen is not None and isinstance(parameters, Mapping):
        parameters = with_undamped(parameters, body.constants)
    theta = resolve_theta(body, parameters)
    steps = _steps_per_sample(experiment, integrator, timestep_s=timestep_s, substeps=substeps)
    if (massless := experiment.body.mass_problem(theta)) is not None:
        raise InputError(massless)
    if (unreachable := experiment.body.rest_shape_failure(theta)) is not None:
        raise InputError(unreachable)
    try:
        if steps == "auto":
            motion = _with_automatic_steps(
                experiment, theta, integrator=integrator, options=options, progress=progress
            )
        else:
            (motion,) = _with_steps(
                experiment,
                theta[None],
                integrator=integrator,
                steps=steps,
                options=options,
                progress=progress,
            )
    except SimulationError as error:
        if (reason := explain_failure(experiment, theta, error=error)) is error:
            raise
        raise reason from error
    return replace(motion, predicted=_ideal_predictions(motion)) if is_measured else motion


@validated
def simulate_each(
    experiment: Experiment,
    parameters: Mapping[str, ArrayLike],
    integrator: str | Scheme = NEWMARK,
    substeps: Substeps = 1,
    progress: Progress | None = None,
    is_measured: bool = True,
) -> list[Trajectory]:
    """Simulate a motion with each of B values of the parameters, as B calls of `simulate` would,
    but many bodies together, step by step; those for which Newton's method does not converge at
    once are simulated by themselves.

    Parameters
    ----------
    parameters : mapping
        Values (B,) of each parameter, or one number for all.
    substeps : int
        Time steps between samples.
    experiment, integrator, progress, is_measured
        See `simulate`.

    Raises
    ------
    InputError
        For a static experiment, contact, or a body with memory, fields, custom forces or a shape
        under gravity; otherwise as `simulate`.
    SimulationError
        When a motion fails.
    """
    body = experiment.body
    if (
        experiment.is_static
        or experiment.obstacles
        or experiment.stiffness_deviations
        or body.has_memory
        or body.field_coefficient_names
        or body.forces
        or body.inverse_equilibrium
    ):
        raise InputError(
            f"{experiment.description}: found equilibria, contact, a stiffness deviation, or a body "
            "with memory, a field, custom forces or a shape under gravity; expected a motion without "
            "them: call `simulate` with each of the values"
        )
    given = [float_array(each, name, ((), (None,))) for name, each in parameters.items()]
    if len({len(each) for each in given if each.ndim}) != 1:
        raise InputError("found values of several lengths, or no array; expected B values")
    rows = zip(*np.broadcast_arrays(*given), strict=True)
    draws = (dict(zip(parameters, row, strict=True)) for row in rows)
    thetas = np.array([resolve_theta(body, draw) for draw in draws])
    for massless in filter(None, map(body.mass_problem, thetas)):
        raise InputError(massless)
    motions: list[Trajectory] = []
    together = max(1, DOFS_TOGETHER // body.pattern.size)
    for first in range(0, len(thetas), together):
        some = thetas[first : first + together]
        motions += _simulate_together(experiment, some, integrator, substeps)
        if progress:
            progress(len(motions) / len(thetas))
    if not is_measured:
        return motions
    return [replace(each, predicted=_ideal_predictions(each)) for each in motions]


def _simulate_together(
    experiment: Experiment, thetas: Array, integrator: str | Scheme, steps: int
) -> list[Trajectory]:
    try:
        return _with_steps(experiment, thetas, integrator, steps, None, None)
    except SimulationError:
        if len(thetas) == 1:
            raise
        return [
            motion
            for half in np.array_split(thetas, 2)
            for motion in _simulate_together(experiment, half, integrator, steps)
        ]


def _ideal_predictions(motion: Trajectory) -> tuple[Array, ...]:
    """Return the predictions without nuisance parameters; none of unlabelled points."""
    stated = motion.experiment
    known = [row for row in stated.nuisance.own if row.name in stated.known_deviations]
    experiment = replace(
        stated, nuisance=Nuisance.none(own=known), markers=replace(stated.markers, offsets_s=None)
    )
    grid = MotionGrid.at_samples(experiment, motion.reactions[0])
    association = Association(MarkerAssociation.from_experiment(experiment))
    predicted = []
    for model in measurement_models(grid):
        if model.measurement.point_counts:
            predicted.append(model.measurement.measured_values)
            continue
        has_correspondences = isinstance(model, CorrespondenceModel)
        correspondences = model.first_correspondences() if has_correspondences else None
        residual = model.residuals(association, correspondences)[0]
        predicted.append(residual.simulated(motion.sampled, np.zeros(grid.nuisance.size)))
    return tuple(predicted)


def _steps_per_sample(
    experiment: Experiment,
    integrator: str | Scheme,
    timestep_s: float | None,
    substeps: int | Literal["auto"],
) -> int | Literal["auto"]:
    if experiment.is_static:
        return 1
    if integrator != NEWMARK or timestep_s is None:
        return substeps
    require_steps(experiment, timestep_s)
    return max(1, round(experiment.timestep_s / timestep_s))


def _with_automatic_steps(
    experiment: Experiment,
    theta: Array,
    integrator: str | Scheme,
    options: NewtonOptions | None,
    progress: Progress | None,
) -> Trajectory:
    """Return a simulation whose steps are halved until accurate or `MOST_AUTOMATIC_STEPS`."""
    # A number of steps that cannot be simulated counts as inaccurate.
    is_newmark = integrator == NEWMARK
    order = NEWMARK_ORDER if is_newmark else as_scheme(integrator).order
    steps = FIRST_NEWMARK_STEPS if is_newmark else FIRST_SCHEME_STEPS
    coarser: Trajectory | None = None
    done = 0.0
    while True:
        # Each pass takes twice as long as the one before it; another one may follow.
        share = FIRST_PASS_SHARE if not done else (1.0 - done) / 2
        report = None if progress is None else _part(progress, done, share)
        done += share
        try:
            (finer,) = _with_steps(
                experiment,
                theta[None],
                integrator=integrator,
                steps=steps,
                options=options,
                progress=report,
            )
        except SimulationError:
            if steps >= MOST_AUTOMATIC_STEPS:
                raise
            finer = None
        if finer is not None and coarser is not None:
            change_m = np.linalg.norm(finer.positions_m - coarser.positions_m, axis=2).max()
            error_m = float(change_m) / (2**order - 1)
            finer = replace(finer, step_error_m=error_m)
            if error_m <= _accepted_error_m(finer):
                return finer
        if finer is not None and steps >= MOST_AUTOMATIC_STEPS:
            return finer
        coarser = finer
        steps *= 2


def _part(progress: Progress, done: float, share: float) -> Progress:
    def report(part: float) -> None:
        progress(done + share * part)

    return report


def _accepted_error_m(trajectory: Trajectory) -> float:
    """Return `STEP_TOLERANCE` times the largest distance [m], `ROUNDING` sizes if hardly moved."""
    positions = trajectory.positions_m
    farthest_m = np.linalg.norm(positions - positions[0], axis=2).max()
    size_m = np.ptp(positions[0], axis=0).max()
    return float(max(STEP_TOLERANCE * farthest_m, ROUNDING * size_m))


def _with_steps(
    experiment: Experiment,
    thetas: Array,
    integrator: str | Scheme,
    steps: int,
    options: NewtonOptions | None,
    progress: Progress | None,
) -> list[Trajectory]:
    """Return the motion of each θ (B, k). Velocities of a collocation scheme are central differences
    of its positions.
    """
    theta = thetas[0] if len(thetas) == 1 else thetas.T[..., None]

    def of_bodies(values: Array) -> Array:
        return values.reshape(len(values), len(thetas), -1).swapaxes(0, 1)

    sensed = sensed_dofs(experiment)
    equilibria = None
    if integrator == NEWMARK and not experiment.is_static:
        x, v, forced = simulate_newmark(
            experiment,
            theta,
            steps_per_sample=steps,
            options=options,
            progress=progress,
            sensed=sensed,
        )
        rows = (len(x) - 1) * steps + 1
        at = ReactionGrid.from_times(np.linspace(experiment.t_s[0], experiment.t_s[-1], rows))
        reactions = map(ReactionForces, of_bodies(forced.reaction), of_bodies(forced.position_m))
    else:
        equations = Dynamics.from_experiment(experiment, integrator, substeps=steps)
        dynamics = equations.with_theta(theta)
        grid = simulate_scheme(experiment, dynamics, options=options, progress=progress)
        x = grid[::steps]
        equilibria = dynamics if experiment.is_static else None
        zeros = np.zeros_like(grid)
        v = zeros if experiment.is_static else np.gradient(grid, dynamics.step_s, axis=0)[::steps]
        at = ReactionGrid.from_dynamics(dynamics)
        own = map(equations.with_theta, thetas)
        reactions = (reactions_at(d, g, sensed) for d, g in zip(own, of_bodies(grid), strict=True))
    shape = (len(x), -1, 3)
    return [
        Trajectory(
            experiment,
            x.reshape(shape),
            velocities_m_s=v.reshape(shape),
            reactions=(at, forced),
            steps_per_sample=steps,
            equilibria=equilibria,
        )
        for x, v, forced in zip(of_bodies(x), of_bodies(v), reactions, strict=True)
    ]


def _with_values(
    experiment: Experiment, kind: type[Measurement], values: Sequence[Any]
) -> Experiment:
    is_kind = [isinstance(each, kind) for each in experiment.measurements]
    if len(values) != sum(is_kind):
        names = ", ".join(each.title for each in experiment.measurements if isinstance(each, kind))
        raise InputError(
            f"the values of the {kind.measurement_text} are {len(values)} arrays; expected a list "
            f"with one array for each sensor: {names or 'none'}"
        )
    others = iter(values)
    return experiment.with_measurements(
        each.with_samples(each.sample_times_s, next(others)) if has_other else each
        for each, has_other in zip(experiment.measurements, is_kind, strict=True)
    )


@validated
def with_wrenches(experiment: Experiment, wrenches: Sequence[Array]) -> Experiment:
    """Return the experiment with other samples (S, 6) [N, N m] of its force–torque sensors, one
    array for each grasp that has one, in the order of the grasps.

    Raises
    ------
    InputError
        If the number of arrays is not that of the sensors.
    """
    return _with_values(experiment, Wrench, wrenches)


@validated
def with_readings(experiment: Experiment, values: Sequence[ArrayLike | None]) -> Experiment:
    """Return the experiment with other samples (S, m) of its custom sensors, one array for each, in
    their order.

    Raises
    ------
    InputError
        If the number of arrays is not that of the sensors, or an array has the wrong shape.
    """
    return _with_values(experiment, CustomSensor, values)


@validated
def with_markers(experiment: Experiment, positions_m: ArrayLike) -> Experiment:
    """Return the experiment with other marker tracks (T, M, 3) [m] at its samples; raise InputError
    for another shape.
    """
    markers = experiment.markers
    tracks = float_array(positions_m, "positions_m", markers.positions_m.shape, finite=False)
    return _with_values(experiment, Markers, [tracks] * bool(markers.names))
