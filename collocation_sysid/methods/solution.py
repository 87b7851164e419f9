"""Result of a solve, and the protocol of methods that solve a `Collocation`.

`Method` is the protocol, `Solution` the result with everything that is derived from it (positions,
residuals, multipliers, optimality), `Status` the reason why the solve ended.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, field, replace
from enum import Enum
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from ..common.array_types import Array
from ..common.validated_classes import validated
from ..errors import InputError, SimulationError, hint_at
from ..fem.kernels import map_experiments
from ..program.collocation import Collocation, ExperimentIterate, Violation
from ..program.measured_motion import SurfaceComparison, fitted_values
from ..program.stopwatch import Stopwatch
from ..program.sweep import Sweep
from ..recording.custom_sensor import CustomSensor
from ..recording.experiment import Experiment
from ..recording.measured_wrench import Wrench
from ..recording.measurement import root_mean
from .starts.start import Scan


class Status(Enum):
    """Reason why a solve ended; the value is the name in files."""

    CONVERGED = "converged"
    ACCEPTABLE = "acceptable"
    ITERATION_LIMIT = "iteration-limit"
    TIME_LIMIT = "time-limit"
    INFEASIBLE = "infeasible"
    STALLED = "stalled"
    DIVERGED = "diverged"
    NUMERICAL_FAILURE = "numerical-failure"
    INTERRUPTED = "interrupted"
    CLUSTER_DISCONNECTED = "cluster-lost"
    REFUSED = "refused"
    NOT_SIMULABLE = "not-simulable"

    @property
    def converged(self) -> bool:
        """Whether the solution satisfies the tolerances of the solver, at least the
        acceptable ones.
        """
        return self in (Status.CONVERGED, Status.ACCEPTABLE)

    @property
    def sentence(self) -> str:
        """Explanation of the status for the user, one sentence with advice."""
        return _SENTENCES[self]

    def explain(self, method: str, max_iterations: int | None) -> str:
        """Return `sentence`; at the iteration limit, with the complete option that doubles it.

        Parameters
        ----------
        method : str
            Name of the method, such as "reduced-space".
        max_iterations : int or None
            Limit of the method that ended; None if it is unknown, with which the result is
            `sentence`.
        """
        if self is not Status.ITERATION_LIMIT or max_iterations is None:
            return self.sentence
        key = f"solver.{method}.max_iterations"
        return (
            f"Stopped at the iteration limit of {max_iterations}; raise it "
            f"(--set {key}={2 * max_iterations}) or start from a better guess."
        )


_SENTENCES = {
    Status.CONVERGED: "Converged: the optimality conditions hold to the tolerance.",
    Status.ACCEPTABLE: "Converged to the acceptable tolerance only; the desired tolerance was "
    "not reached.",
    Status.ITERATION_LIMIT: "Stopped at the iteration limit; raise max_iterations or start from a "
    "better guess.",
    Status.TIME_LIMIT: (
        "Stopped at the time limit before the tolerances were reached; raise max_time_s or "
        "start from a better guess."
    ),
    Status.INFEASIBLE: "The equations of motion could not be satisfied from this start; check "
    "grasp, mass and units, or start from another guess.",
    Status.STALLED: (
        "The steps became too small to make progress before the tolerances were reached; "
        "check the guess, if one is given, and the likely causes of the misfit that the "
        "report lists."
    ),
    Status.DIVERGED: "The iterates grew without bound; check units and bounds.",
    Status.NUMERICAL_FAILURE: "A step could not be computed or a function was not finite; another "
    "guess or linear solver may help.",
    Status.INTERRUPTED: "Interrupted; this is the best iterate so far.",
    Status.CLUSTER_DISCONNECTED: "The cluster was lost; this is the best iterate so far, "
    "simulated on this machine. Continue from it with --start.",
    Status.NOT_SIMULABLE: "The body cannot be simulated at the values where the search began; "
    "give stiffer or less damped ones, omit the guess, if one is given, or use interior-point, "
    "which needs no simulation.",
    Status.REFUSED: "The solver refused the problem or one of its options.",
}


@dataclass(frozen=True)
class Iteration:
    """One line of the history of a solve.

    Where a method solves growing parts of the recordings, `loss` is that of the part and increases
    when the next part begins.

    Attributes
    ----------
    number : int
        Number of the iteration, from 0.
    loss : float
        Loss L of the measurements and priors, without the scaling of the NLP.
    misfit : float
        Root mean square of the residuals of all measurements and priors per measured number, in
        standard deviations.
    violation_n : float
        Largest residual of the equations of motion [N].
    parameters : dict of str to float
        Physical values by parameter name.
    time_s : float
        Time since the solve began [s].
    share : float
        Share of the time steps that are solved, at most 1.
    trust : float
        Trust region of the last trial of reduced space, as in `SearchOptions.trust`; NaN for methods
        without one.
    noise : float
        Noise of the loss: actual less predicted decrease of the trial that was rejected last; 0 before.
    """

    number: int
    loss: float
    misfit: float
    violation_n: float
    parameters: dict[str, float]
    time_s: float
    share: float = 1.0
    trust: float = field(default=np.nan, repr=False)
    noise: float = field(default=np.nan, repr=False)


@dataclass(frozen=True)
class Timing:
    """Computing times of a solve [s]."""

    build: float = 0.0  # time to set up the program
    evaluations: float = 0.0  # time to evaluate residuals and derivatives
    linear_algebra: float = 0.0  # time to factorise and solve
    total: float = 0.0  # total time, which includes what the other three do not count

    def __add__(self, other: Timing) -> Timing:
        pairs = zip(astuple(self), astuple(other), strict=True)
        return Timing(*(mine + its for mine, its in pairs))

    @classmethod
    def since(cls, watch: Stopwatch, start_s: float) -> Timing:
        """Return the times that a stopwatch has measured, and the total time from a start until
        now.

        Parameters
        ----------
        start_s : float
            `time.perf_counter()` at the start of the solve [s], for the total.
        """
        total = time.perf_counter() - start_s
        return cls(watch.build, watch.evaluations, linear_algebra=watch.linear_algebra, total=total)


@dataclass(frozen=True, eq=False)
class Solution:
    """Parameters and trajectories computed by a method, whether or not it converged.

    Attributes
    ----------
    status : Status
        Reason why the solve ended.
    message : str
        Sentence for the user, which includes the message of the solver.
    method : str
        Name of the method.
    collocation : Collocation
        Problem that was solved.
    z : (variables,) array
        Final variables, see `program.collocation`.
    initial_multipliers : (constraints,) array or None
        Multipliers of the constraints g in the scaling of the NLP; None if the method computes
        none, see `multipliers`.
    iterations : int
        Iterations of the method itself; the history may also contain those of the search for its
        start.
    history : sequence of Iteration
        One entry per iteration.
    timing : Timing
        Computing times.
    notes : sequence of str
        Remarks for the user, for example how the solve was started.
    evaluations : int
        Number of evaluations of residuals or derivatives of whole trajectories; a sweep and a
        simulation count as one each.
    scan : Scan or None
        Scan of the stiffness that the solve started from; None if there was none.
    """

    status: Status
    message: str
    method: str
    collocation: Collocation
    z: Array
    initial_multipliers: Array | None
    iterations: int
    history: Sequence[Iteration]
    timing: Timing
    notes: Sequence[str] = field(default=())
    evaluations: int = 0
    scan: Scan | None = None

    def __repr__(self) -> str:
        free = [item.name for item in self.collocation.parameters.free_scalars]
        values = ", ".join(f"{name} = {self.parameters[name]:.5g}" for name in free)
        loss = f"loss {self.history[-1].loss:.5g}, " if self.history else ""
        work = f"{loss}{self.iterations} iterations in {self.timing.total:.2g} s"
        return f"Solution({self.method}, {self.status.value}: {values}; {work})"

    def unless_interrupted(self) -> Solution:
        """Return the solution, or raise `KeyboardInterrupt` if the user interrupted the solve.

        Use this where the solve is one step of a longer computation that should end as well.

        Raises
        ------
        KeyboardInterrupt
            If the status is `Status.INTERRUPTED`.
        """
        if self.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        return self

    def after(self, first: Solution, why: str) -> Solution:
        """Return a copy that also counts a previous solve.

        Iterations, evaluations and times are added; the history follows that of the first solve,
        with its numbers and times continued; `scan` is that of the first solve.

        Parameters
        ----------
        first : Solution
            Solve that ended before this one began.
        why : str
            Reason for the second solve; it is inserted between the notes of both, also if it is
            empty.
        """
        previous_iterations = max([first.iterations, *(line.number for line in first.history[-1:])])
        previous_s = first.timing.total
        shifted_history = [
            replace(each, number=each.number + previous_iterations, time_s=each.time_s + previous_s)
            for each in self.history
        ]
        return replace(
            self,
            iterations=self.iterations + first.iterations,
            evaluations=self.evaluations + first.evaluations,
            history=(*first.history, *shifted_history),
            timing=self.timing + first.timing,
            notes=(*first.notes, why, *self.notes),
            scan=first.scan,
        )

    @cached_property
    def multipliers(self) -> Array:
        """Multipliers (constraints,) of the constraints, in the scaling of the NLP.

        They are those of the method or, if it computes none, those that make the Lagrangian
        stationary in the positions (one backward sweep); zeros if the equations of a time step are
        singular.
        """
        if self.initial_multipliers is not None:
            return self.initial_multipliers
        return multipliers_at(self.collocation, self.z)

    @property
    def q(self) -> Array:
        """Estimated shared parameters (nq,) in the transformed coordinates of the solver, a view of
        `z`.
        """
        return self.z[: self.collocation.nq]

    @property
    def theta(self) -> Array:
        """Constants (k,) of the first experiment's body, see `Body.constants`."""
        return self.collocation.transcriptions[0].body.theta_from_values(self.parameters)

    @property
    def parameters(self) -> dict[str, float]:
        """Physical values by parameter name, fixed and tied parameters included."""
        return self.collocation.parameters.values(self.q)

    @cached_property
    def parts(self) -> list[ExperimentIterate]:
        """Fitted experiments at the solution, in the order of `collocation.transcriptions`."""
        return self.collocation.iterates(self.z)

    @validated
    def nuisance(self, name: str) -> float:
        """Return the value of a nuisance parameter of a recording in its unit.

        Parameters
        ----------
        name : str
            As in `result.json` and the report, "swing: time shift [s]"; without experiment or unit,
            "time shift"; or the name of a row of your own or of an unknown of a `Gauge`.

        Raises
        ------
        InputError
            If none or several are called so, even if their values are equal, as "time shift" if two
            recordings have one: then add the experiment.
        """
        estimates: dict[str, float] = {}
        known: list[str] = []
        for part in self.parts:
            nuisance = part.transcription.nuisance
            readings = part.transcription.experiment.readings
            values = (part.phi * nuisance.scales).tolist()
            for entry, full, value in zip(nuisance.entries, nuisance.names, values, strict=True):
                known.append(full)
                names = {full, entry.label, entry.label.rpartition(" [")[0], entry.row.name}
                if entry.row.of in ("gauge", "images"):
                    sensor = readings[entry.number]
                    own = {sensor.unknown_label(each): each for each in sensor.unknowns}
                    names.add(own.get(entry.label, full))
                if name in names:
                    estimates[full] = value
        if len(estimates) == 1:
            return next(iter(estimates.values()))
        which = f"{name!r} is ambiguous" if estimates else f"no nuisance parameter {name!r}"
        expected = ", ".join(map(repr, estimates or dict.fromkeys(known)))
        raise InputError(f"{which}; expected one of {expected or '(none)'}{hint_at(name, known)}")

    def part_of(self, experiment: str) -> ExperimentIterate | None:
        """Return the iterate of one experiment at the solution, by the experiment's name; None if
        it was not fitted.
        """
        named = {part.transcription.experiment.name: part for part in self.parts}
        return named.get(experiment)

    @property
    def positions_m(self) -> list[Array]:
        """Node positions (N, n, 3) on the collocation grid of each fitted experiment [m]."""
        _, positions = self.collocation.unpack(self.z)
        return [x.reshape(len(x), -1, 3) for x in positions]

    @cached_property
    def fitted_values(self) -> dict[str, tuple[Array | SurfaceComparison, ...]]:
        """Prediction of each of `Experiment.measurements` by name of the fitted experiment: numbers
        (S, m), NaN where a sample was not predicted; of a depth camera the comparison of its points
        with the surface.
        """
        return {part.transcription.experiment.name: fitted_values(part) for part in self.parts}

    def _fitted_by_kind(self, part: ExperimentIterate, kind: type) -> list[tuple[Any, Any]]:
        experiment = part.transcription.experiment
        pairs = zip(experiment.measurements, self.fitted_values[experiment.name], strict=True)
        return [(each, values) for each, values in pairs if isinstance(each, kind)]

    @cached_property
    def readings_m(self) -> list[Array]:
        """Predicted marker positions (T, M, 3) of each fitted experiment [m], at its
        estimated nuisance parameters φ.
        """
        return [
            part.transcription.markers.predict_positions(part.x, part.phi) for part in self.parts
        ]

    @property
    def wrenches(self) -> dict[str, list[Array]]:
        """Predicted force and torque (S, 6) [N, N m] of each sensor, by name of the fitted
        experiment; NaN where not predicted. Experiments without a sensor are left out.
        """
        return {
            part.transcription.experiment.name: [values for _, values in found]
            for part in self.parts
            if (found := self._fitted_by_kind(part, Wrench))
        }

    @property
    def readings(self) -> dict[str, dict[str, Array]]:
        """Predicted values (S, m) of custom sensors, by name of the fitted experiment and of the
        sensor; experiments without custom sensors have empty mappings.
        """
        return {
            part.transcription.experiment.name: {
                gauge.name: values for gauge, values in self._fitted_by_kind(part, CustomSensor)
            }
            for part in self.parts
        }

    @cached_property
    def rms_m(self) -> float:
        """Root mean square distance of all markers from their measurements [m];
        0 without samples.
        """
        return self.collocation.rms_marker_distance_m(self.z)

    @cached_property
    def rms_by_experiment_m(self) -> dict[str, float]:
        """Root mean square distance of markers from their measurements [m], by experiment name; 0
        without samples.
        """
        rms_by_experiment = {}
        for transcription, readings in zip(
            self.collocation.transcriptions, self.readings_m, strict=True
        ):
            markers = transcription.experiment.markers
            squares = markers.squared_distances_m2(readings)[markers.is_present]
            rms_by_experiment[transcription.experiment.name] = root_mean(squares)
        return rms_by_experiment

    @cached_property
    def max_violation_n(self) -> float:
        """Largest residual of the equations of motion [N], computed from `z`."""
        violations = self.collocation.residuals_n(self.z)
        return float(max(np.abs(residual).max(initial=0.0) for residual in violations))

    @cached_property
    def max_violation_relative(self) -> float:
        """Largest residual of the equations of motion over the largest force in the equations."""
        return self.max_violation_n / max(self.collocation.largest_force_n(self.z), 1e-300)

    @cached_property
    def kkt_residual(self) -> float:
        """Largest violation of the NLP's first-order optimality conditions at `multipliers`, see
        `Collocation.kkt_residual`.
        """
        return self.collocation.kkt_residual(self.z, self.multipliers)

    @property
    def largest_violations(self) -> list[Violation]:
        """Equations of motion with the largest residuals, in descending order."""
        return self.collocation.largest_violations(self.z)


def wrench_rms(
    experiment: Experiment, predicted: Sequence[Array]
) -> tuple[float | None, float | None]:
    """Return the RMS residuals of force [N] and torque [N m], over all wrench sensors of an
    experiment.

    Parameters
    ----------
    experiment : Experiment
        Experiment with the measured wrenches.
    predicted : sequence of (S, 6) array
        Predicted wrenches of each sensor; NaN entries are ignored.

    Returns
    -------
    tuple of two floats or None
        RMS of one component of the force and of the torque. If the body is a symmetric part of the
        specimen, the values refer to the whole specimen, see `Wrench.symmetry`. None means that no
        component was measured.
    """
    pairs = zip(predicted, experiment.wrenches, strict=True)
    residuals = [sensor.symmetry * (read - sensor.values) for read, sensor in pairs]
    components = np.concatenate(residuals) if residuals else np.zeros((0, 6))
    force, torque = (
        float(np.sqrt(np.nanmean(each**2))) if np.isfinite(each).any() else None
        for each in (components[:, :3], components[:, 3:])
    )
    return force, torque


def pooled_wrench_rms(solution: Solution) -> tuple[float | None, float | None]:
    """Return the RMS residuals of force [N] and torque [N m] over all fitted experiments of a
    solution.

    All experiments have equal weight. None means that no experiment measured the component.
    """
    squares = np.zeros(2)
    counts = np.zeros(2)
    for transcription in solution.collocation.transcriptions:
        experiment = transcription.experiment
        predicted = solution.wrenches.get(experiment.name, [])
        for k, value in enumerate(wrench_rms(experiment, predicted)):
            if value is not None:
                squares[k] = squares[k] + value**2
                counts[k] = counts[k] + 1
    force, torque = (
        float(np.sqrt(square / count)) if count else None
        for square, count in zip(squares, counts, strict=True)
    )
    return force, torque


Watch = Callable[[Iteration], None]


class Method(Protocol):
    """Callable that solves a `Collocation`.

    The classes of `METHODS` are methods: an instance contains the options and is called with the
    problem.
    """

    def __call__(
        self, collocation: Collocation, watch: Watch | None = None, start: Array | None = None
    ) -> Solution:
        """Solve the NLP."""
        ...


def constraint_multipliers(
    collocation: Collocation, z: Array, stopwatch: Stopwatch | None = None
) -> Array:
    """Return multipliers (constraints,) that make the Lagrangian stationary in the positions.

    They solve c_xᵀ y = −∂L/∂x by one backward sweep per experiment (adjoint method), in the scaling
    of the NLP.

    Parameters
    ----------
    z : (variables,) array
        Variables.

    Raises
    ------
    SimulationError
        If the equations of a time step are singular.
    """

    def of_experiment(iterate: ExperimentIterate) -> Array:
        transcription = iterate.transcription
        gradient = collocation.loss_scale * iterate.gradient()[0]
        solver = Sweep(transcription, stopwatch=stopwatch)
        y = transcription.force_n * solver.backward(iterate.x, iterate.equations, gradient=gradient)
        return transcription.select_rows(y)

    multipliers_by_experiment = map_experiments(
        of_experiment, collocation.iterates(z), threads=collocation.threads
    )
    multipliers = np.concatenate(multipliers_by_experiment)
    if any(transcription.is_grasp_constraint.any() for transcription in collocation.transcriptions):
        _set_grasp_multipliers(collocation, z, multipliers=multipliers)
    return multipliers


def multipliers_at(collocation: Collocation, z: Array) -> Array:
    """Return the `constraint_multipliers` at z; zeros if the equations of a step are singular."""
    try:
        return constraint_multipliers(collocation, z)
    except SimulationError:
        return np.zeros(collocation.constraint_count)


def _set_grasp_multipliers(collocation: Collocation, z: Array, multipliers: Array) -> None:
    """Set those of prescribed displacements, zero on entry, to minus the remaining gradient."""
    # The constraints of prescribed displacements have unit Jacobian rows.
    slope = collocation.gradient(z) + collocation.jacobian_vjp(z, multipliers)
    for part in collocation.iterates(slope):
        transcription = part.transcription
        grasped = part.transcription.is_grasp_constraint
        multipliers[transcription.rows][grasped] = (
            -transcription.select_rows(part.x)[grasped] / transcription.length_m
        )
