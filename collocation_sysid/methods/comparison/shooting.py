"""Single shooting: simulate at the parameters, compare with the measurements, improve the
parameters.

This is the usual method in the literature, as a baseline: the only variables are the parameters p =
(q, φ), and every evaluation of the loss is a simulation with the collocation scheme, so that the
optimum is that of the other methods. The gradient is computed

- "forward": from the sensitivities Z = dx/dp, solved with the trajectory, for Gauss–Newton steps in
a trust region (SciPy's `least_squares`, "dogbox": steps of at most one in each parameter's
logarithm at first);
- "adjoint": from one sweep backward in time for the multipliers y of c_xᵀ y = −∂L/∂x, as dL/dp =
∂L/∂p + yᵀ ∂c/∂p for any number of parameters, for SciPy's L-BFGS-B.

If a trial cannot be simulated, its loss is infinite: the trust region shrinks to a quarter of the
step, and the line search returns to a quarter. A failure at the guess ends the solve.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
import scipy

from ...common.array_types import Array
from ...common.validated_classes import validated
from ...common.validated_types import Count, Positive
from ...errors import SimulationError
from ...program.collocation import Collocation
from ...program.stopwatch import Stopwatch
from ..horizon import Horizon
from ..options import MethodOptions
from ..solution import Solution, Status, Watch, constraint_multipliers
from ..solve_recorder import SEARCH_ENDS, Recorder, SearchEnded, status_of_end
from ..starts.initial_trajectories import complete_variables, simulate_trajectories

# Relative decrease of the loss, or of one of a standard deviation, that is rounding.
ROUNDING = 1e-14
# A line search that ends in rounding has found the optimum where no slope of the loss is larger.
LEAST_GRADIENT_TOLERANCE = 1e-5


@validated
class Shooting(MethodOptions):
    """Single shooting: simulate with trial parameters, and improve them.

    Attributes
    ----------
    gradient : {"forward", "adjoint"}
        Forward sensitivities and Gauss–Newton, or adjoint gradients and L-BFGS-B.
    tolerance : float
        Largest derivative by a parameter's logarithm: of half the squared residuals in standard
        deviations (forward), of their mean (adjoint). Forward also ends at a step this small
        relative to the distance from the guess.
    max_iterations : int
        Largest number of simulations; those that fail count.
    max_time_s : float
        No simulation begins after this time, in seconds.
    """

    name: ClassVar[str] = "shooting"
    needs_complete_start: ClassVar[bool] = True

    gradient: Literal["forward", "adjoint"] = "forward"
    tolerance: Positive = 1e-8
    max_iterations: Count = 200
    max_time_s: Positive = 1e6

    def __call__(
        self, collocation: Collocation, watch: Watch | None = None, start: Array | None = None
    ) -> Solution:
        """Solve the NLP, see `Method`; entries of the history, with which `watch` is called, are
        simulations better than all before.

        Only the parameters of `start` are used, by default the guess. If their simulation fails,
        the status says so and the positions are those of a rigid motion with the grasp.
        """
        recorder = Recorder(self.name, collocation, watch=watch, max_time_s=self.max_time_s)
        search = _ShootingSearch(self, recorder, start=start)
        try:
            status, message = search.run()
        except SEARCH_ENDS as end:
            status, message = status_of_end(end)
        best = search.best
        shots = search.simulations
        if best is None:
            z = complete_variables(collocation, search.first)
            multipliers = np.zeros(collocation.constraint_count)
        else:
            z = best.z
            multipliers = None
        if best is not None and search.failures:
            failed = f"{search.failures} of {shots} simulations failed"
            recorder.notes.append(f"{failed}; each time the search continued with a shorter step")
        return recorder.solution(
            status, message, z=z, multipliers=multipliers, iterations=shots, evaluations=shots
        )


def simulate_variables(
    collocation: Collocation, p: Array, stopwatch: Stopwatch | None = None
) -> Array:
    """Return variables z (variables,) at the parameters p = (q, φ), with simulated positions.

    Parameters
    ----------
    collocation : Collocation
        Problem.
    p : (np,) array
        Shared and nuisance parameters (q, φ).
    stopwatch : Stopwatch, optional
        Measures the simulations.

    Raises
    ------
    SimulationError
        If a simulation fails; it names the time step.
    """
    positions, failure = simulate_trajectories(collocation, p, stopwatch=stopwatch)
    if failure is not None:
        raise failure
    return collocation.pack(p, positions)


def adjoint_gradient(
    collocation: Collocation, z: Array, stopwatch: Stopwatch | None = None
) -> Array:
    """Return the total derivative (np,) of the objective, in the scaling of the NLP, by p along the
    equations of motion.

    Parameters
    ----------
    collocation : Collocation
        Problem.
    z : (variables,) array
        Variables with simulated positions.
    stopwatch : Stopwatch, optional
        Stopwatch that measures the sweep.

    Raises
    ------
    SimulationError
        If the equations of a time step are singular.
    """
    multipliers = constraint_multipliers(collocation, z, stopwatch=stopwatch)
    slope = collocation.gradient(z) + collocation.jacobian_vjp(z, multipliers)
    return collocation.parameters_from(slope)


@dataclass(frozen=True, eq=False)
class _SimulatedPoint:
    """Simulation at parameters p: variables z, objective, and derivatives."""

    p: Array  # (np,): parameters (q, φ)
    z: Array  # (variables,): variables with the simulated positions
    objective: float  # loss L in the scaling of the NLP
    residual: Array  # (m,): residuals in standard deviations; empty with adjoint gradients
    # Derivatives (m, np) of the residuals or, with adjoint gradients, (np,) of the objective.
    slope: Array


class _ShootingSearch:
    """Search by SciPy's optimisers, which counts and records simulations.

    Parameters
    ----------
    options : Shooting
        Options of the method.
    recorder : Recorder
        Record of the solve, with the problem.
    start : (variables,) array or None
        Variables whose parameters, clipped to their bounds, are the first; None for the guess.

    Attributes
    ----------
    first : (np,) array
        Parameters of the first simulation, within their bounds.
    simulations, failures : int
        Numbers of all and of failed simulations.
    last, best : _SimulatedPoint or None
        Last and best simulation that succeeded; None before the first.
    horizon : Horizon or None
        Linearised problem; None with adjoint gradients.
    """

    def __init__(self, options: Shooting, recorder: Recorder, start: Array | None) -> None:
        self.options = options
        self.recorder = recorder
        self.collocation = collocation = recorder.collocation
        self.lower, self.upper = collocation.parameter_bounds
        first = collocation.guess_p if start is None else collocation.parameters_from(start)
        self.first = np.clip(first, self.lower, self.upper)
        self.simulations = self.failures = 0
        self.last: _SimulatedPoint | None = None
        self.best: _SimulatedPoint | None = None
        self.horizon = None
        if options.gradient == "forward":
            rows = [transcription.grid_times for transcription in collocation.transcriptions]
            self.horizon = Horizon(collocation, rows, stopwatch=recorder.stopwatch)

    def run(self) -> tuple[Status, str]:
        """Search, and return the status and a sentence with SciPy's message; the result is `best`.

        Without parameters there is only one simulation, and the status is that of convergence.

        Raises
        ------
        SimulationError
            If the first simulation fails.
        SearchEnded
            If a limit of simulations or time is reached, or failed simulations stop the search.
        """
        self.last = self._simulate(self.first)
        if not len(self.first):
            return Status.CONVERGED, Status.CONVERGED.sentence
        return self._gauss_newton() if self.horizon else self._quasi_newton()

    # Optimisers -------------------------------------------------------------------------------

    def _gauss_newton(self) -> tuple[Status, str]:
        """Minimise by SciPy's `least_squares`, from the first parameters; return the status and a
        sentence with SciPy's message. `_try` updates `best`, and states the exceptions.
        """
        result = scipy.optimize.least_squares(
            self._residual,
            np.zeros(len(self.first)),  # then the trust region starts at one
            self._residual_slope,  # pyright: ignore[reportArgumentType]
            (self.lower - self.first, self.upper - self.first),
            method="dogbox",
            x_scale=self.collocation.reach_p,
            xtol=self.options.tolerance,
            ftol=ROUNDING,
            gtol=self.options.tolerance,
        )
        status = Status.ITERATION_LIMIT if result.status == 0 else Status.CONVERGED
        return status, f"{status.sentence} (SciPy: {result.message})"

    def _residual(self, step: Array) -> Array:
        """Return the residuals (m,) after a step (np,) from the first parameters; infinite if the
        simulation fails. See `_try` for the exceptions.
        """
        shot = self._try(self.first + step)
        assert self.best is not None
        return np.full(len(self.best.residual), np.inf) if shot is None else shot.residual

    def _residual_slope(self, step: Array) -> Array:
        """Return the derivatives (m, np) of the residuals after a step (np,) from the first
        parameters, at which the simulation must succeed. See `_try` for the exceptions.
        """
        shot = self._try(self.first + step)
        assert shot is not None  # SciPy asks where the residuals were finite
        return shot.slope

    def _quasi_newton(self) -> tuple[Status, str]:
        """Minimise by SciPy's L-BFGS-B, from the first parameters; return the status and a sentence
        with SciPy's message. `_try` updates `best`, and states the exceptions.

        Without success by SciPy's criteria the status is acceptable if the projected gradient is
        within `LEAST_GRADIENT_TOLERANCE`, and stalled otherwise.
        """
        result = scipy.optimize.minimize(
            self._objective,
            self.first,
            method="L-BFGS-B",
            jac=True,
            bounds=np.column_stack([self.lower, self.upper]),
            options={
                "gtol": self.options.tolerance,
                "ftol": ROUNDING,
                "maxiter": 10 * self.options.max_iterations + 10,  # shots are counted here
                "maxfun": 10 * self.options.max_iterations + 10,
            },
        )
        assert self.best is not None
        p = self.best.p
        slope = self.best.slope
        projected = np.clip(p - slope, self.lower, self.upper) - p
        is_stationary = np.abs(projected).max() <= max(
            LEAST_GRADIENT_TOLERANCE, self.options.tolerance
        )
        status = Status.ACCEPTABLE if is_stationary else Status.STALLED
        if result.success:
            status = Status.CONVERGED
        return status, f"{status.sentence} (SciPy: {result.message})"

    def _objective(self, p: Array) -> tuple[float, Array]:
        """Return the objective and its gradient (np,) at p.

        If the simulation fails they are those of a parabola along the step from the best
        simulation, above the best objective and with its minimum at a quarter of the step, so that
        the line search returns there. See `_try` for the exceptions.
        """
        shot = self._try(p)
        if shot is not None:
            return shot.objective, shot.slope
        # A parabola over the step from the best simulation, with its slope there and the minimum
        # at a quarter of the step, where every interpolation will then go.
        assert self.best is not None
        step = p - self.best.p
        fall = abs(float(self.best.slope @ step)) or 1.0
        return self.best.objective + fall, 3 * fall * step / (step @ step)

    # Simulations ------------------------------------------------------------------------------

    def _try(self, p: Array) -> _SimulatedPoint | None:
        """Return the simulation at p (np,), which is not repeated if it is the last; None if it
        fails or its objective is not finite.

        `last`, `best`, `simulations` and `failures` are updated.
        """
        if self.last is not None and np.array_equal(p, self.last.p):
            return self.last
        try:
            shot = self._simulate(p)
        except SimulationError:
            shot = None
        if shot is None or not np.isfinite(shot.objective):
            self.failures += 1
            assert self.best is not None
            if np.abs(p - self.best.p).max() <= self.options.tolerance:
                raise SearchEnded(Status.STALLED)
            return None
        self.last = shot
        return shot

    def _simulate(self, p: Array) -> _SimulatedPoint:
        """Return the simulation at p (np,) with derivatives, and count it, also if it fails. If its
        objective is the smallest, it becomes the best one and part of the history; exceptions of
        the recorder's `watch` are not caught.
        """
        if self.simulations and self.simulations >= self.options.max_iterations:
            raise SearchEnded(Status.ITERATION_LIMIT)
        if self.simulations and self.recorder.is_late():
            raise SearchEnded(Status.TIME_LIMIT)
        self.simulations += 1
        collocation = self.collocation
        z = simulate_variables(collocation, p, stopwatch=self.recorder.stopwatch)
        if self.horizon is not None:
            point = self.horizon.evaluate(p, collocation.unpack(z)[1])
            value = point.loss * collocation.loss_scale
            shot = _SimulatedPoint(
                p.copy(), z, objective=value, residual=point.fit.residual, slope=point.fit.jacobian
            )
        else:
            slope = adjoint_gradient(collocation, z, stopwatch=self.recorder.stopwatch)
            shot = _SimulatedPoint(
                p.copy(), z, objective=collocation.objective(z), residual=np.zeros(0), slope=slope
            )
        if self.best is None or shot.objective < self.best.objective:
            self.best = shot
            self.recorder.add_variables(
                self.simulations, z, loss=shot.objective / collocation.loss_scale
            )
        return shot
