"""Newton's method for the static problem and for one implicit time step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from ...common.array_types import Array
from ...errors import SimulationError
from ...recording.experiment import Experiment
from ..contact.condensed_contact import (
    Compliance,
    CondensationError,
    CondensedSteps,
    ContactEquations,
)
from ..linear_algebra.factorisation import Factor, Factoriser
from ..stopwatch import Stopwatch
from .newton_linearisation import NewtonLinearisation
from .retraction import Retraction, add_increment

T = TypeVar("T")

# Skew part of a matrix that is approximated by its symmetric part.
NO_SKEW_PART = np.zeros(0)
# Share of the tolerance below which a step that was computed with the factor of the previous
# iterate is the last one.
OLD_FACTOR_SHARE = 0.01
# Chord steps are continued while each is shorter than the last by this factor.
FAST = 0.1
# Largest number of chord steps with one factor.
LARGEST_CHORD_STEP_COUNT = 8
# Chord steps end when the expected remaining error is this share of the tolerance.
LEAST_RESIDUAL_SHARE = 1e-5


# Residual (3n,) of a state (3n,).
Residual = Callable[[Array], Array]
Linearise = Callable[[Array], NewtonLinearisation]


class _Iterate(NamedTuple):
    """Iterate of Newton's method.

    Attributes
    ----------
    x : (3n,) array
        State [m].
    factor : Factor
        Factor with which the step was computed; that of the previous iterate for a last step.
    step : (free,) array
        Newton step from x [m].
    """

    x: Array
    factor: Factor
    step: Array


@dataclass(frozen=True)
class NewtonOptions:
    """Options of Newton's method for one implicit step or an equilibrium.

    Attributes
    ----------
    tolerance : float
        Length of the last Newton step over the body's size.
    max_iterations : int
        Largest number of iterations.
    max_backtracks : int
        Largest number of halvings of a Newton step.
    max_halvings : int
        Largest number of halvings of a time step (Newmark) or of the increment of the grasps in it
        (schemes).
    """

    tolerance: float = 1e-10
    max_iterations: int = 30
    max_backtracks: int = 25
    max_halvings: int = 8


class NewtonFailure(Exception):
    """Newton's method did not converge; its text is the reason.

    Parameters
    ----------
    x : (3n,) array
        Last state [m], for the error message.
    reason : str
        Cause.
    """

    def __init__(self, x: Array, reason: str) -> None:
        self.x = x
        self.reason = reason
        super().__init__(x, reason)

    def __str__(self) -> str:
        return self.reason


class NewtonSolver:
    """Newton's method with backtracking on the free dofs of a body, for one set of prescribed dofs.

    The factor of the last solution is stored and reused by the next call of `solve`.

    Attributes
    ----------
    free, is_prescribed : arrays
        Indices of free and of prescribed dofs.
    size_m : float
        Length of the diagonal of the box that contains the body.
    last_factor : Factor or None
        Factor of the last solution of complete equations, with which the next one begins.
    compliance : Compliance or None
        Inverse of the matrix of the body without contact, of the last step with contact.

    Parameters
    ----------
    experiment : Experiment
        Its body, obstacles and grasps.
    options : NewtonOptions, optional
        Options; defaults otherwise.
    stopwatch : Stopwatch, optional
        Accumulates the time spent.
    prescribed : (n, 3) or (3n,) array of bool, optional
        Prescribed coordinates; by default those at the experiment's first time.
    """

    def __init__(
        self,
        experiment: Experiment,
        options: NewtonOptions | None = None,
        stopwatch: Stopwatch | None = None,
        prescribed: NDArray[np.bool_] | None = None,
    ) -> None:
        self.stopwatch = stopwatch or Stopwatch()
        self.body = experiment.body
        # A retraction moves surfaces off the obstacles that hold them.
        self._is_free_of_contact = not experiment.obstacles
        self.options = options or NewtonOptions()
        at_start = experiment.is_prescribed(experiment.t_s[:1])[0]
        holding = at_start if prescribed is None else prescribed
        self.free = np.flatnonzero(~holding)
        self.is_prescribed = np.flatnonzero(holding)
        self.pattern = experiment.sparsity
        self.factoriser = Factoriser.cached(self.pattern, self.free)
        self.size_m = float(np.linalg.norm(np.ptp(self.body.nodes_m, axis=0)))
        self.last_factor: Factor | None = None
        self.compliance: Compliance | None = None

    def solve(
        self,
        x: Array,
        residual: Residual,
        linearise: Linearise,
        keep_definite: bool = False,
        prescribed_m: Array | None = None,
    ) -> Array:
        """Solve residual(x) = 0 for the free dofs.

        A step is accepted when the next one, computed with the same factor, is shorter (Deuflhard's
        natural monotonicity test), and no element is inverted. Equilibria may be far from x:
        without obstacles their steps are applied as rotations and strains, see `Retraction`. Time
        steps first reuse the factor of the previous solution as long as steps shrink fast.

        Parameters
        ----------
        x : (3n,) array
            First guess [m]; not modified. Prescribed dofs keep their values unless `prescribed_m`
            is given.
        residual : callable
            Residual (3n,) of x.
        linearise : callable
            `NewtonLinearisation` at x.
        keep_definite : bool
            If true, solve for a stable equilibrium: accept states only while −∂residual/∂x is
            positive definite, and factorise at every iterate.
        prescribed_m : (prescribed,) array, optional
            Positions of the prescribed dofs [m]. The free dofs first follow to first order, because
            moving prescribed dofs alone would crush adjacent elements.

        Returns
        -------
        (3n,) array
            Solution [m].

        Raises
        ------
        NewtonFailure
            If the method does not converge, a matrix is singular, or an element is inverted at the
            start.
        """
        x = (
            x.copy()
            if prescribed_m is None
            else self._with_prescribed(x, prescribed_m, linearise=linearise)
        )
        self._require_upright(x)
        if not keep_definite:
            # If they do not converge, the search begins at x: their last state may be far off.
            improved, done = self._simplified_newton(
                x, _CompleteIteration(self, residual, linearise=linearise)
            )
            if done:
                return improved
        at = self.timed(linearise, x)
        factor = self.factorise(at, x, keep_definite=keep_definite)
        iterate = _Iterate(x, factor, step=self.step(factor, at.residual))
        for _ in range(self.options.max_iterations):
            if self._is_last(iterate.step):
                self.last_factor = iterate.factor
                iterate.x[self.free] += iterate.step
                return iterate.x
            iterate = self._backtrack(
                iterate,
                residual,
                linearise=linearise,
                keep_definite=keep_definite,
            )
        raise NewtonFailure(
            iterate.x,
            f"Newton's method took more than {self.options.max_iterations} iterations",
        )

    def solve_in_contact(self, x: Array, equations: ContactEquations) -> Array:
        """Solve one time step, with contact or without, for the free dofs.

        Contact is condensed to the dofs that touch, with the factor of the body without contact of
        earlier steps. Where that does not converge, `solve` treats the complete equations.

        Parameters
        ----------
        x : (3n,) array
            First guess [m]; not modified. Prescribed dofs keep their values.
        equations : ContactEquations
            Equations of the step.

        Returns
        -------
        (3n,) array
            Solution [m].

        Raises
        ------
        NewtonFailure
            If no method converges.
        """
        if equations.contact.acts and self.has_no_inverted_element(x):
            improved, done = self._simplified_newton(
                x, _CondensedIteration(self, equations)
            )
            if done:
                return improved
        return self.solve(x, equations.residual, linearise=equations.linearise)

    def _simplified_newton(
        self, x: Array, iteration: ChordIteration
    ) -> tuple[Array, bool]:
        """Iterate with few factorisations (simplified Newton method); the last factor is stored,
        and x is not modified.

        It ends without a solution when a new factor does not improve the state, or cannot be
        computed.

        Returns
        -------
        ((3n,) array, bool)
            Last state, and whether it is the solution.
        """
        is_own = False
        for _ in range(self.options.max_iterations):
            try:
                if iteration.has_factor:
                    improved, done = self._chord_steps(x, iteration)
                    if done:
                        return improved, True
                    if improved is x and is_own:
                        break
                    x = improved
                iteration.factorise_at(x)
                is_own = True
            except (NewtonFailure, CondensationError):
                break
        return x, False

    def _chord_steps(
        self, x: Array, iteration: ChordIteration
    ) -> tuple[Array, bool]:
        """Iterate with a given factor while steps shrink fast; x is not modified.

        Returns
        -------
        ((3n,) array, bool)
            Last state, which is x itself if steps grow or invert an element; and whether it is the
            solution.
        """
        improved = x.copy()
        before = None
        done = False
        for _ in range(LARGEST_CHORD_STEP_COUNT):
            step = iteration.step_from(improved)
            length = float(np.linalg.norm(step))
            rate = length / before if before else 1.0
            if not rate <= 1.0:
                return x, False
            improved[self.free] += step
            done = self._is_last(rate * step, LEAST_RESIDUAL_SHARE)
            if done or (before and rate > FAST):
                break
            before = length
        return (
            (improved, done)
            if self.has_no_inverted_element(improved)
            else (x, False)
        )

    def _with_prescribed(
        self, x: Array, goal: Array, linearise: Linearise
    ) -> Array:
        """Return the state x (3n,) [m] with the prescribed dofs at `goal` (prescribed,), and the
        free dofs in equilibrium to first order; only the prescribed dofs change if they are there
        already, up to the tolerance.

        Raises
        ------
        NewtonFailure
            If the matrix at x is singular, or an element of x is inverted.
        """
        state = x.copy()
        way = np.zeros_like(x)
        way[self.is_prescribed] = goal - x[self.is_prescribed]
        state[self.is_prescribed] = goal
        if not self._is_last(way):
            self._require_upright(x)
            at = self.timed(linearise, x)
            coupling = self.pattern.products(at.symmetric[None], way[None])[0]
            factor = self.factorise(at, x, keep_definite=False)
            state[self.free] += self.step(factor, at.residual - coupling)
        return state

    def _backtrack(
        self,
        iterate: _Iterate,
        residual: Residual,
        linearise: Linearise,
        keep_definite: bool,
    ) -> _Iterate:
        """Return the next iterate, with the first of the halved steps that is acceptable.

        Parameters
        ----------
        iterate : _Iterate
            Present iterate; not modified.
        residual, linearise : callable
            Functions of the state, see `solve`.
        keep_definite : bool
            Whether the matrix must be positive definite.

        Raises
        ------
        NewtonFailure
            If no step is acceptable.
        """
        x = iterate.x
        factor = iterate.factor
        length = np.linalg.norm(iterate.step)
        share = 1.0
        update = (
            self._retraction
            if keep_definite and self._is_free_of_contact
            else add_increment
        )
        for _ in range(self.options.max_backtracks):
            increment = np.zeros_like(x)
            increment[self.free] = share * iterate.step
            trial = update(x, increment)
            if self.has_no_inverted_element(trial):
                # A whole step is mostly taken: it is evaluated with its derivatives at once.
                at = self.timed(linearise, trial) if share == 1 else None
                value = (
                    self.timed(residual, trial) if at is None else at.residual
                )
                next_step = self.step(factor, value)
                if np.linalg.norm(next_step) <= (1 - share / 4) * length:
                    is_last = self._is_last(next_step, OLD_FACTOR_SHARE)
                    if is_last and not keep_definite:
                        return _Iterate(trial, factor, step=next_step)
                    if at is None:
                        at = self.timed(linearise, trial)
                    try:
                        own = self.factorise(
                            at, trial, keep_definite=keep_definite
                        )
                        return _Iterate(
                            trial, own, step=self.step(own, at.residual)
                        )
                    except NewtonFailure:
                        pass
            share /= 2
        raise NewtonFailure(
            x, "no step along the Newton direction decreases the residual"
        )

    @cached_property
    def _retraction(self) -> Retraction:
        """Retraction that applies increments towards an equilibrium and displaces the prescribed
        dofs exactly; computed on first use.
        """
        prescribed = np.zeros(self.pattern.size, dtype=bool)
        prescribed[self.is_prescribed] = True
        return Retraction(self.body, prescribed.reshape(-1, 3))

    def _is_last(self, step: Array, share: float = 1.0) -> bool:
        """Whether the largest entry of a step (free or 3n,) [m] is at most `share` times the
        tolerance.
        """
        tolerance = share * self.options.tolerance * self.size_m
        return bool(np.abs(step).max(initial=0.0) <= tolerance)

    def factorise(
        self, at: NewtonLinearisation, x: Array, keep_definite: bool
    ) -> Factor:
        """Return the factor of −∂residual/∂x on the free dofs.

        Parameters
        ----------
        at : NewtonLinearisation
            Derivative at x.
        x : (3n,) array
            State, for the failure.
        keep_definite : bool
            Whether a matrix that is not positive definite is a failure.

        Raises
        ------
        NewtonFailure
            If the matrix is singular or, with `keep_definite`, not positive definite.
        """
        try:
            with self.stopwatch.solving():
                factor = self.factoriser.factorise(at.symmetric, at.skew)
        except np.linalg.LinAlgError as error:
            raise NewtonFailure(
                x, f"the equations are singular: {error}"
            ) from error
        if keep_definite and not factor.positive_definite:
            raise NewtonFailure(x, "the stiffness is not positive definite")
        return factor

    def step(self, factor: Factor, residual: Array) -> Array:
        """Return the Newton step (free,) [m] of the free dofs for a residual (3n,)."""
        with self.stopwatch.solving():
            return factor.solve(residual[self.free])

    def timed(self, function: Callable[[Array], T], x: Array) -> T:
        """Return `function(x)`; its time is added to the evaluations of the stopwatch."""
        with self.stopwatch.evaluating():
            return function(x)

    def has_no_inverted_element(self, x: Array) -> bool:
        """Return whether det F is positive at all quadrature points at x (3n,) [m]."""
        return bool(self.body.volume_ratios(x).min() > 0)

    def _require_upright(self, x: Array) -> None:
        """Raise NewtonFailure if an element is inverted (det F ≤ 0 at a quadrature point) at x
        (3n,) [m].
        """
        if not self.has_no_inverted_element(x):
            raise NewtonFailure(
                x, "an element is inverted before the first iteration"
            )

    def worst_element(self, x: Array) -> int:
        """Return the index of the element with the smallest det F at any of its quadrature points
        at x (3n,) [m].
        """
        return int(self.body.volume_ratios(x)[0].min(axis=1).argmin())


class ChordIteration(Protocol):
    """Steps with a factor that is kept for several of them."""

    @property
    def has_factor(self) -> bool:
        """Whether there is a factor of an earlier state."""
        ...

    def factorise_at(self, x: Array) -> None:
        """Replace the factor by that at x (3n,) [m]; raises NewtonFailure if it is singular."""
        ...

    def step_from(self, x: Array) -> Array:
        """Return the step (free,) [m] from x (3n,) [m] with the present factor."""
        ...


@dataclass(frozen=True, eq=False)
class _CompleteIteration:
    """Steps with the factor of the complete matrix.

    Attributes
    ----------
    solver : NewtonSolver
        Stores the factor.
    residual, linearise : callable
        Functions of the state, see `NewtonSolver.solve`.
    """

    solver: NewtonSolver
    residual: Residual
    linearise: Linearise

    @property
    def has_factor(self) -> bool:
        return self.solver.last_factor is not None

    def factorise_at(self, x: Array) -> None:
        solver = self.solver
        at = solver.timed(self.linearise, x)
        solver.last_factor = solver.factorise(at, x, keep_definite=False)

    def step_from(self, x: Array) -> Array:
        solver = self.solver
        assert solver.last_factor is not None
        return solver.step(solver.last_factor, solver.timed(self.residual, x))


class _CondensedIteration:
    """Steps with the factor of the body without contact, and contact condensed.

    Parameters
    ----------
    solver : NewtonSolver
        Stores the factor and its compliance.
    equations : ContactEquations
        Equations of the step.
    """

    def __init__(
        self, solver: NewtonSolver, equations: ContactEquations
    ) -> None:
        self._solver = solver
        self._equations = equations
        self._use_compliance()

    @property
    def has_factor(self) -> bool:
        return self._steps is not None

    def factorise_at(self, x: Array) -> None:
        solver = self._solver
        at = solver.timed(self._equations.linearise_without_contact, x)
        symmetric = at._replace(skew=NO_SKEW_PART)
        factor = solver.factorise(symmetric, x, keep_definite=False)
        solver.compliance = Compliance(factor, len(solver.free))
        self._use_compliance()

    def step_from(self, x: Array) -> Array:
        assert self._steps is not None
        return self._solver.timed(self._steps.step_from, x)

    def _use_compliance(self) -> None:
        """Prepare steps with the compliance of the solver, if there is one."""
        compliance = self._solver.compliance
        self._steps = (
            None
            if compliance is None
            else CondensedSteps(
                self._equations,
                compliance,
                free=self._solver.free,
                size_m=self._solver.size_m,
            )
        )


def follow_path(
    solve: Callable[[Array, float], Array],
    x: Array,
    halvings: int,
    guess: Array | None = None,
) -> Array:
    """Follow the solution x(s) from x(0) to x(1) in increments that shrink on failure, and grow
    after two successes.

    Parameters
    ----------
    solve : callable
        Returns x(s) from a first guess and s; raises NewtonFailure.
    x : (3n,) array
        x(0) [m]; not modified.
    halvings : int
        The smallest increment is 0.5 to this power.
    guess : (3n,) array, optional
        Guess of x(1), which is tried first; if it fails and `halvings` is 0, the failure is raised.
        Without it, or if it fails, the path begins at x(0).

    Returns
    -------
    (3n,) array
        x(1).

    Raises
    ------
    NewtonFailure
        If an increment of the smallest size fails.
    """
    if guess is not None:
        try:
            return solve(guess, 1.0)
        except NewtonFailure:
            if not halvings:
                raise
    rate = np.zeros_like(x)
    reached = 0.0
    increment = 1.0
    easy = False
    while reached < 1.0:
        step = min(increment, 1.0 - reached)
        try:
            solution = solve(x + step * rate, reached + step)
        except NewtonFailure:
            # What fails costs many times what succeeds: better short steps that grow.
            increment = step / 4
            easy = False
            if increment < 0.5**halvings:
                raise
        else:
            rate = (solution - x) / step
            x = solution
            reached = reached + step
            # One step as long as that which failed would fail again.
            increment = 2 * step if easy else step
            easy = True
    return x


class NewtonSolvers:
    """Solvers of an experiment, one for each set of prescribed dofs; created on demand.

    Parameters
    ----------
    experiment : Experiment
        The experiment.
    options : NewtonOptions, optional
        Options of Newton's method.
    stopwatch : Stopwatch, optional
        Accumulates the time spent.
    """

    def __init__(
        self,
        experiment: Experiment,
        options: NewtonOptions | None = None,
        stopwatch: Stopwatch | None = None,
    ) -> None:
        self._arguments = (experiment, options, stopwatch)
        self._known: dict[bytes, NewtonSolver] = {}

    def for_prescribed(self, is_prescribed: NDArray[np.bool_]) -> NewtonSolver:
        """Return the solver for a set of prescribed coordinates (n, 3) or (3n,) bool; it is created
        on the first call and stored.
        """
        key = is_prescribed.tobytes()
        if key not in self._known:
            self._known[key] = NewtonSolver(*self._arguments, is_prescribed)
        return self._known[key]


def simulation_error(
    solver: NewtonSolver,
    failure: NewtonFailure,
    time_s: float,
    what: str,
    *,
    static: bool = False,
) -> SimulationError:
    """Return the error for the user: what failed, when, at which element, and what to change.

    Parameters
    ----------
    solver : NewtonSolver
        The solver that failed.
    failure : NewtonFailure
        The failure.
    time_s : float
        Time of the step [s].
    what : str
        Description of the step, as the subject of a sentence.
    static : bool
        If true, the error contains the state where the path of equilibria ended, see
        `stability_loss.explain_failure`.
    """
    element = solver.worst_element(failure.x)
    ratio = float(solver.body.volume_ratios(failure.x)[0, element].min())
    return SimulationError(
        f"{what} failed: {failure.reason}; the worst element has det F = {ratio:.3g}. "
        "Stiffer parameters, a smaller timestep or a finer mesh may help",
        time_s,
        element=element,
        state_m=failure.x if static else None,
    )
