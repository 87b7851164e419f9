"""What a method is, anything that solves a `Collocation`, and what it returns."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import astuple, dataclass, field, replace
from enum import Enum
from functools import cached_property
from typing import Protocol

import numpy as np

from ..arrays import Array, root_mean
from ..errors import SimulationError
from ..fem.kernels import side_by_side
from ..program.collocation import Collocation, Part, Violation
from ..program.stopwatch import Stopwatch
from ..program.sweep import Sweep
from ..recording.experiment import Experiment
from .scan import Scan


class Status(Enum):
    """How a solve ended; the value is the name in files, `sentence` is for people."""

    CONVERGED = "converged"
    ACCEPTABLE = "acceptable"
    ITERATION_LIMIT = "iteration-limit"
    TIME_LIMIT = "time-limit"
    INFEASIBLE = "infeasible"
    STALLED = "stalled"
    DIVERGED = "diverged"
    NUMERICAL_FAILURE = "numerical-failure"
    INTERRUPTED = "interrupted"
    CLUSTER_LOST = "cluster-lost"
    REFUSED = "refused"
    NOT_SIMULABLE = "not-simulable"

    @property
    def converged(self) -> bool:
        """Whether the answer satisfies the solver's tolerances."""
        return self in (Status.CONVERGED, Status.ACCEPTABLE)

    @property
    def sentence(self) -> str:
        """One sentence for people."""
        return _SENTENCES[self]


_SENTENCES = {
    Status.CONVERGED: "Converged: the optimality conditions hold to the tolerance.",
    Status.ACCEPTABLE: "Converged to the acceptable tolerance only; progress ended before the "
    "desired one.",
    Status.ITERATION_LIMIT: "Stopped at the iteration limit; raise max_iterations or start from a "
    "better guess.",
    Status.TIME_LIMIT: "Stopped at the time limit.",
    Status.INFEASIBLE: "The equations of motion could not be satisfied from this start; check "
    "grasp, mass and units, or start from another guess.",
    Status.STALLED: "The steps became too small to make progress; look at the likely causes, "
    "and at the guess where one is given.",
    Status.DIVERGED: "The iterates grew without bound; check units and bounds.",
    Status.NUMERICAL_FAILURE: "A step could not be computed or a function was not finite; another "
    "guess or linear solver may help.",
    Status.INTERRUPTED: "Interrupted; this is the best iterate so far.",
    Status.CLUSTER_LOST: "The cluster was lost; this is the best iterate so far, simulated here, "
    "from which --start goes on.",
    Status.NOT_SIMULABLE: "The body cannot be simulated at the guess; start from stiffer or less "
    "damped parameters or without a guess, or use interior-point, which needs no simulation.",
    Status.REFUSED: "The solver refused the problem or one of its options.",
}


@dataclass(frozen=True)
class Iteration:
    """One line of the history; the parameters by the user's names.

    The loss is that of the first `share` of the timesteps where a method takes them one part after
    the other: it rises where the next part comes in.
    """

    number: int
    loss: float
    rms_m: float
    violation_n: float
    parameters: dict[str, float]
    time_s: float
    share: float = 1.0


@dataclass(frozen=True)
class Timing:
    """Where the time went [s]."""

    build: float = 0.0
    evaluations: float = 0.0
    linear_algebra: float = 0.0
    total: float = 0.0

    def __add__(self, other: Timing) -> Timing:
        both = zip(astuple(self), astuple(other), strict=True)
        return Timing(*(mine + its for mine, its in both))

    @classmethod
    def of(cls, watch: Stopwatch, began: float) -> Timing:
        """What a stopwatch has added up since `began`, a `time.perf_counter`."""
        total = time.perf_counter() - began
        return cls(watch.build, watch.evaluations, watch.linear_algebra, total)


@dataclass(frozen=True, eq=False)
class Solution:
    """Parameters and trajectory found by a method, converged or not.

    Attributes
    ----------
    status : Status
    message : str
        A sentence for people, with what the solver said.
    method : str
    collocation : Collocation
        The problem that was solved.
    z : (variables,) the final variables, see `program.collocation`
    given_multipliers : (constraints,) of g, in the scaling of the NLP, or None
    iterations : int
        Those of the method itself; the history may also have lines of a search for its start.
    history : sequence of Iteration
    timing : Timing
    notes : sequence of str
        What the user should know, such as how the solve was started.
    evaluations : int
        How often the method asked for residuals or derivatives of whole trajectories; a sweep
        and a simulation count as one.
    scan : Scan or None
        The scan of the stiffness that it started from, if there was one.
    """

    status: Status
    message: str
    method: str
    collocation: Collocation
    z: Array
    given_multipliers: Array | None
    iterations: int
    history: Sequence[Iteration]
    timing: Timing
    notes: Sequence[str] = field(default=())
    evaluations: int = 0
    scan: Scan | None = None

    def unless_interrupted(self) -> Solution:
        """The solution of a part of some work, which ends by Ctrl-C as that does.

        Raises
        ------
        KeyboardInterrupt
            If it was interrupted.
        """
        if self.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        return self

    def after(self, first: Solution, why: str) -> Solution:
        """The answer with what the solve took that it started from, and why there was another."""
        done = max([first.iterations, *(line.number for line in first.history[-1:])])
        began_s = first.timing.total
        own = [
            replace(each, number=each.number + done, time_s=each.time_s + began_s)
            for each in self.history
        ]
        return replace(
            self,
            iterations=self.iterations + first.iterations,
            evaluations=self.evaluations + first.evaluations,
            history=(*first.history, *own),
            timing=self.timing + first.timing,
            notes=(*first.notes, why, *self.notes),
            scan=first.scan,
        )

    @cached_property
    def multipliers(self) -> Array:
        """(constraints,) the method's own, or those that one sweep finds; zeros where it fails."""
        if self.given_multipliers is not None:
            return self.given_multipliers
        try:
            return constraint_multipliers(self.collocation, self.z)
        except SimulationError:
            return np.zeros(self.collocation.constraints)

    @property
    def q(self) -> Array:
        """(nq,) the estimated parameters in the solver's coordinates."""
        return self.z[: self.collocation.nq]

    @property
    def theta(self) -> Array:
        """(k,) constants of the first experiment's body, see `Body.constants`."""
        return self.collocation.segments[0].body.theta(self.parameters)

    @property
    def parameters(self) -> dict[str, float]:
        """Values by the user's names."""
        return self.collocation.parameters.values(self.q)

    @cached_property
    def parts(self) -> list[Part]:
        """Every fitted experiment at the solution."""
        return self.collocation.parts(self.z)

    def part_of(self, experiment: str) -> Part | None:
        """That of one experiment, by name; None where it was not fitted."""
        named = {part.segment.experiment.name: part for part in self.parts}
        return named.get(experiment)

    @property
    def positions_m(self) -> list[Array]:
        """Node positions (N, n, 3) on the collocation grid of each fitted experiment."""
        _, positions = self.collocation.unpack(self.z)
        return [x.reshape(len(x), -1, 3) for x in positions]

    @cached_property
    def readings_m(self) -> list[Array]:
        """Fitted markers (T, M, 3) of each experiment, with its φ."""
        return [part.segment.markers.of_positions(part.x, part.phi) for part in self.parts]

    @cached_property
    def wrenches(self) -> dict[str, list[Array]]:
        """What the sensors of each fitted experiment should read, (S, 6), NaN where not known."""
        parts = [part for part in self.parts if part.segment.sensors]
        return {part.segment.experiment.name: part.sensing.wrenches(part.x) for part in parts}

    @cached_property
    def wrench_rms(self) -> dict[str, tuple[float | None, float | None]]:
        """RMS of force [N] and torque [N m] of the sensors of each fitted experiment."""
        found = {}
        for segment in self.collocation.segments:
            if segment.sensors:
                readings = self.wrenches[segment.experiment.name]
                found[segment.experiment.name] = wrench_rms(segment.experiment, readings)
        return found

    @cached_property
    def readings(self) -> dict[str, dict[str, Array]]:
        """What the readings of one's own of each fitted experiment should say, (S, m) by name."""
        return {
            part.segment.experiment.name: {
                gauge.gauge.name: gauge.said(gauge.of_motion(part.motion, part.phi))
                for gauge in part.segment.gauges
            }
            for part in self.parts
        }

    @cached_property
    def rms_m(self) -> float:
        """Root mean square distance of markers from their measurements."""
        return self.collocation.rms_m(self.z)

    @cached_property
    def rms_by_experiment_m(self) -> dict[str, float]:
        """The same of each fitted experiment."""
        found = {}
        for segment, readings in zip(self.collocation.segments, self.readings_m, strict=True):
            markers = segment.experiment.markers
            squares = np.sum((readings - markers.positions_m) ** 2, axis=2)[markers.present]
            found[segment.experiment.name] = root_mean(squares)
        return found

    @cached_property
    def max_violation_n(self) -> float:
        """Largest residual of the equations of motion [N], evaluated afresh."""
        violations = self.collocation.violations_n(self.z)
        return float(max(np.abs(residual).max(initial=0.0) for residual in violations))

    @cached_property
    def max_violation_relative(self) -> float:
        """The same over the largest force in the balance."""
        return self.max_violation_n / max(self.collocation.largest_force_n(self.z), 1e-300)

    @cached_property
    def kkt_residual(self) -> float:
        """Largest violation of the NLP's first-order conditions, see `Collocation`."""
        return self.collocation.kkt_residual(self.z, self.multipliers)

    @property
    def largest_violations(self) -> list[Violation]:
        """The worst equations of motion."""
        return self.collocation.largest_violations(self.z)


def wrench_rms(
    experiment: Experiment, readings: Sequence[Array]
) -> tuple[float | None, float | None]:
    """RMS of each component of force [N] and torque [N m] between readings (S, 6) and measured.

    None of what is not measured.
    """
    pairs = zip(readings, experiment.wrenches, strict=True)
    apart = [read - sensor.values for read, sensor in pairs]
    both = np.concatenate(apart) if apart else np.zeros((0, 6))
    force, torque = (
        float(np.sqrt(np.nanmean(each**2))) if np.isfinite(each).any() else None
        for each in (both[:, :3], both[:, 3:])
    )
    return force, torque


def reading_rms(experiment: Experiment, readings: Mapping[str, Array]) -> dict[str, float]:
    """RMS between readings of one's own (S, m) and what was measured, by name."""
    apart = ((g.name, readings[g.name] - g.measured) for g in experiment.readings)
    return {name: float(np.sqrt(np.nanmean(each**2))) for name, each in apart}


def pooled_wrench_rms(solution: Solution) -> tuple[float | None, float | None]:
    """The same of all fitted experiments, which count alike."""
    squares, counts = np.zeros(2), np.zeros(2)
    for segment in solution.collocation.segments:
        found = solution.wrench_rms.get(segment.experiment.name, (None, None))
        for k, value in enumerate(found):
            if value is not None:
                squares[k], counts[k] = squares[k] + value**2, counts[k] + 1
    force, torque = (
        float(np.sqrt(square / count)) if count else None
        for square, count in zip(squares, counts, strict=True)
    )
    return force, torque


Watch = Callable[[Iteration], None]


class Method(Protocol):
    """A callable that solves a `Collocation`, as those of `METHODS` are with their options."""

    def __call__(
        self, collocation: Collocation, watch: Watch | None = None, start: Array | None = None
    ) -> Solution:
        """Solve the NLP.

        Parameters
        ----------
        collocation : Collocation
        watch : callable, optional
            Called with every line of the history, an `Iteration`.
        start : (variables,) ndarray, optional
            Initial variables; the method's own choice at the guess by default.

        Returns
        -------
        Solution
            Also when it did not converge or was interrupted (Ctrl-C): then the best iterate.
        """
        ...


def constraint_multipliers(
    collocation: Collocation, z: Array, stopwatch: Stopwatch | None = None
) -> Array:
    """Multipliers (constraints,) that make the Lagrangian stationary in the positions.

    From c_xᵀ y = −∂L/∂x, in the scaling of the NLP.

    Raises
    ------
    SimulationError
        Where a timestep's equations are singular.
    """

    def of(part: Part) -> Array:
        segment = part.segment
        gradient = collocation.loss_scale * part.gradient()[0]
        solver = Sweep(segment, stopwatch=stopwatch)
        y = segment.force_n * solver.backward(part.x, part.setting, gradient)
        return segment.of_rows(y)

    found = side_by_side(of, collocation.parts(z), collocation.threads)
    multipliers = np.concatenate(found)
    if any(segment.grasp_rows.any() for segment in collocation.segments):
        _add_grasps(collocation, z, multipliers)
    return multipliers


def _add_grasps(collocation: Collocation, z: Array, multipliers: Array) -> None:
    """Give the grasp rows, which are unit rows, what is left of the gradient."""
    slope = collocation.gradient(z) + collocation.pulled_back(z, multipliers)
    for part in collocation.parts(slope):
        segment, grasped = part.segment, part.segment.grasp_rows
        multipliers[segment.rows][grasped] = -segment.of_rows(part.x)[grasped] / segment.length_m
