"""Single shooting: simulate at the parameters, compare with the markers, improve the parameters.

The peers' way, as a baseline: the only variables are the parameters p = (q, φ), and every
evaluation of the loss is a simulation with the collocation scheme, so that the optimum is that of
the other methods. Its slope comes

- "forward": from the sensitivities Z = dx/dp, solved beside the trajectory, for Gauss–Newton
  steps in a trust region (SciPy's `least_squares`, "dogbox": steps of at most one in each
  parameter's logarithm at first);
- "adjoint": from one sweep backward in time for the multipliers y of c_xᵀ y = −∂L/∂x, as
  dL/dp = ∂L/∂p + yᵀ ∂c/∂p whatever the number of parameters, for SciPy's L-BFGS-B.

Where a trial cannot be simulated its loss is infinite: the trust region shrinks to a quarter of
the step, and the line search goes back to a quarter. At the guess there is nothing to go back to.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from scipy.optimize import least_squares, minimize

from ..arrays import Array
from ..errors import InputError, SimulationError
from ..nlp.collocation import Collocation
from ..nlp.marching import march_on
from ..nlp.stopwatch import Stopwatch
from .horizon import Horizon
from .multipliers import constraint_multipliers
from .solution import Iteration, Solution, Status, Timing
from .start import carried_rigidly

Watch = Callable[[Iteration], None]
Gradient = Literal["forward", "adjoint"]

# Relative decrease of the loss, or of one of a standard deviation, that is rounding.
ROUNDING = 1e-14
# A line search that ends in rounding has found the optimum where no slope of the loss is larger.
FLAT = 1e-5
# Pairs of steps and gradients that L-BFGS-B remembers.
MEMORY = 20


@dataclass(frozen=True)
class ShootingOptions:
    """Options of single shooting.

    Attributes
    ----------
    gradient : {"forward", "adjoint"}
        Forward sensitivities and Gauss–Newton, or adjoint gradients and L-BFGS-B.
    tolerance : float
        Largest slope by a parameter's logarithm: of half the squared residuals in standard
        deviations (forward), of their mean (adjoint). Forward also ends at a step this short
        against the way from the guess.
    max_iterations : int
        Simulations; those that fail count.
    max_time_s : float
        No simulation is begun after this time.
    """

    gradient: Gradient = "forward"
    tolerance: float = 1e-8
    max_iterations: int = 200
    max_time_s: float = 1e6


def solve(
    collocation: Collocation,
    options: ShootingOptions | None = None,
    watch: Watch | None = None,
    start: Array | None = None,
) -> Solution:
    """Solve by single shooting.

    Parameters
    ----------
    collocation : Collocation
    options : ShootingOptions, optional
    watch : callable, optional
        Called with every `Iteration`, which is a simulation better than all before.
    start : (variables,) ndarray, optional
        Variables whose parameters are the first; their positions do not matter. The guess by
        default.

    Returns
    -------
    Solution
        With a simulated trajectory and the multipliers of the whole NLP. Also when it did not
        converge or was interrupted: then the best simulation. Where that of the guess fails, the
        status says so and the positions are carried rigidly by the grasp.

    Raises
    ------
    InputError
        For an unknown gradient.
    """
    options = options or ShootingOptions()
    if options.gradient not in get_args(Gradient):
        known = ", ".join(get_args(Gradient))
        raise InputError(f"no gradient {options.gradient!r}; available: {known}", None, "solver")
    search = _Search(collocation, options, watch, start)
    try:
        status, why = search.run()
    except SimulationError as error:
        status, why = Status.NOT_SIMULABLE, f" {error}."
    except _Stop as stop:
        status, why = stop.status, ""
    except KeyboardInterrupt:
        status, why = Status.INTERRUPTED, ""
    z, multipliers = search.answer()
    return Solution(
        status=status,
        message=f"{status.sentence}{why}",
        method="shooting",
        collocation=collocation,
        z=z,
        multipliers=multipliers,
        iterations=search.shots,
        history=tuple(search.history),
        timing=Timing.of(search.stopwatch, search.began),
        notes=search.notes,
        evaluations=search.shots,
    )


def simulated(collocation: Collocation, p: Array, stopwatch: Stopwatch | None = None) -> Array:
    """Variables z at the parameters p = (q, φ), with simulated positions.

    Raises
    ------
    SimulationError
        Naming the step that failed.
    """
    q, own = collocation.split(p)
    positions = []
    for segment, setting, phi in zip(
        collocation.segments, collocation.settings(p), own, strict=True
    ):
        x, failure = march_on(
            segment.corrected(phi), setting.dynamics, setting.theta, stopwatch=stopwatch
        )
        if failure is not None:
            raise failure
        positions.append(x)
    return collocation.pack(q, positions, own)


def adjoint_gradient(
    collocation: Collocation, z: Array, stopwatch: Stopwatch | None = None
) -> Array:
    """Total derivative (np,) of the objective by p along the equations of motion, at simulated z.

    Raises
    ------
    SimulationError
        Where a timestep's equations are singular.
    """
    multipliers = constraint_multipliers(collocation, z, stopwatch)
    slope = collocation.gradient(z) + collocation.jacobian(z).T @ multipliers
    return collocation.parameters_of(slope)


class _Stop(Exception):
    """Ends the search from within an evaluation."""

    def __init__(self, status: Status) -> None:
        self.status = status


@dataclass(frozen=True, eq=False)
class _Shot:
    """A simulation: its objective, and residuals with slopes or the gradient of the objective."""

    p: Array
    z: Array
    objective: float
    residual: Array
    slope: Array


class _Search:
    """Counts, remembers and reports simulations for SciPy's optimisers."""

    def __init__(
        self,
        collocation: Collocation,
        options: ShootingOptions,
        watch: Watch | None,
        start: Array | None,
    ) -> None:
        self.collocation, self.options, self.watch = collocation, options, watch
        self.began = time.perf_counter()
        self.stopwatch = Stopwatch()
        self.lower, self.upper = collocation.bounds_p
        guess = np.concatenate([collocation.parameters.guess_q, np.zeros(collocation.own)])
        first = guess if start is None else collocation.parameters_of(start)
        self.first = np.clip(first, self.lower, self.upper)
        self.shots = self.failed = 0
        self.last: _Shot | None = None
        self.best: _Shot | None = None
        self.history: list[Iteration] = []
        self.horizon = None
        if options.gradient == "forward":
            rows = [segment.grid_rows for segment in collocation.segments]
            self.horizon = Horizon(collocation, rows, stopwatch=self.stopwatch)

    def run(self) -> tuple[Status, str]:
        """Search; the status, and what SciPy said.

        Raises
        ------
        SimulationError
            If the first simulation fails.
        """
        self.last = self._shoot(self.first)
        if not len(self.first):
            return Status.CONVERGED, ""
        return self._gauss_newton() if self.horizon else self._quasi_newton()

    def answer(self) -> tuple[Array, Array]:
        """Variables and multipliers of the best simulation."""
        collocation = self.collocation
        if self.best is None:
            q, own = collocation.split(self.first)
            x = [carried_rigidly(s, s.constants.theta(q)) for s in collocation.segments]
            return collocation.pack(q, x, own), np.zeros(collocation.constraints)
        try:
            return self.best.z, constraint_multipliers(collocation, self.best.z, self.stopwatch)
        except SimulationError:
            return self.best.z, np.zeros(collocation.constraints)

    @property
    def notes(self) -> tuple[str, ...]:
        """How many simulations failed."""
        if not self.failed or self.best is None:
            return ()
        return (
            f"{self.failed} of {self.shots} simulations failed; the search went back each time",
        )

    # Optimisers -------------------------------------------------------------------------------

    def _gauss_newton(self) -> tuple[Status, str]:
        reach = [np.ones(self.collocation.nq), *(s.local.reach for s in self.collocation.segments)]
        found = least_squares(
            self._residual,
            np.zeros(len(self.first)),  # then the trust region starts at one
            self._slope,  # pyright: ignore[reportArgumentType]
            (self.lower - self.first, self.upper - self.first),
            method="dogbox",
            x_scale=np.concatenate(reach),
            xtol=self.options.tolerance,
            ftol=ROUNDING,
            gtol=self.options.tolerance,
        )
        status = Status.ITERATION_LIMIT if found.status == 0 else Status.CONVERGED
        return status, f" (SciPy: {found.message})"

    def _residual(self, step: Array) -> Array:
        shot = self._try(self.first + step)
        assert self.best is not None
        return np.full(len(self.best.residual), np.inf) if shot is None else shot.residual

    def _slope(self, step: Array) -> Array:
        shot = self._try(self.first + step)
        assert shot is not None  # SciPy asks where the residuals were finite
        return shot.slope

    def _quasi_newton(self) -> tuple[Status, str]:
        found = minimize(
            self._objective,
            self.first,
            method="L-BFGS-B",
            jac=True,
            bounds=np.column_stack([self.lower, self.upper]),
            options={
                "gtol": self.options.tolerance,
                "ftol": ROUNDING,
                "maxcor": MEMORY,
                "maxiter": 10 * self.options.max_iterations + 10,  # shots are counted here
                "maxfun": 10 * self.options.max_iterations + 10,
            },
        )
        if found.success:
            return Status.CONVERGED, f" (SciPy: {found.message})"
        assert self.best is not None
        p, slope = self.best.p, self.best.slope
        projected = np.clip(p - slope, self.lower, self.upper) - p
        flat = np.abs(projected).max() <= max(FLAT, self.options.tolerance)
        return Status.ACCEPTABLE if flat else Status.STALLED, f" (SciPy: {found.message})"

    def _objective(self, p: Array) -> tuple[float, Array]:
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

    def _try(self, p: Array) -> _Shot | None:
        """The shot at p, simulated unless it is the last; None where it fails."""
        if self.last is not None and np.array_equal(p, self.last.p):
            return self.last
        try:
            shot = self._shoot(p)
        except SimulationError:
            shot = None
        if shot is None or not np.isfinite(shot.objective):
            self.failed += 1
            assert self.best is not None
            if np.abs(p - self.best.p).max() <= self.options.tolerance:
                raise _Stop(Status.STALLED)
            return None
        self.last = shot
        return shot

    def _shoot(self, p: Array) -> _Shot:
        if self.shots and self.shots >= self.options.max_iterations:
            raise _Stop(Status.ITERATION_LIMIT)
        if self.shots and time.perf_counter() - self.began > self.options.max_time_s:
            raise _Stop(Status.TIME_LIMIT)
        self.shots += 1
        collocation = self.collocation
        z = simulated(collocation, p, self.stopwatch)
        if self.horizon is not None:
            point = self.horizon.evaluate(p, collocation.unpack(z)[1])
            value = point.loss * collocation.loss_scale
            shot = _Shot(p.copy(), z, value, point.residual, point.slope)
        else:
            slope = adjoint_gradient(collocation, z, self.stopwatch)
            shot = _Shot(p.copy(), z, collocation.objective(z), np.zeros(0), slope)
        if self.best is None or shot.objective < self.best.objective:
            self._record(shot)
        return shot

    def _record(self, shot: _Shot) -> None:
        self.best = shot
        violations = self.collocation.violations_n(shot.z)
        line = Iteration(
            number=self.shots,
            loss=shot.objective / self.collocation.loss_scale,
            rms_m=self.collocation.rms_m(shot.z),
            violation_n=max(float(np.abs(r).max(initial=0.0)) for r in violations),
            parameters=self.collocation.values(shot.z),
            time_s=time.perf_counter() - self.began,
        )
        self.history.append(line)
        if self.watch is not None:
            self.watch(line)
