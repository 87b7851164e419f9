"""Newton's method for the static problem and for one implicit time step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ...common.array_types import Array
from ...common.limits import require_time
from ...errors import InputError, SimulationError
from ...recording.experiment import Experiment
from ..linear_algebra.factorisation import Factor, Factoriser
from ..linear_algebra.reused_factor import (
    FactorSequence,
    Matrix,
    NodeRotation,
    ReusedFactor,
    relative_cost,
)
from ..stopwatch import Stopwatch
from .condensed_steps import Compliance, CondensationError, CondensedSteps, StepEquations
from .newton_linearisation import LaggedStress, NewtonLinearisation
from .retraction import Retraction, add_increment

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
# Largest ratio of successive chord steps towards an equilibrium: a factorisation costs as much as
# about ten of them, which reduce the error a thousandfold at this ratio.
SLOWEST_CHORD_RATE = 0.5
# Largest number of chord steps towards an equilibrium with one factor.
LARGEST_STATIC_CHORD_STEP_COUNT = 20
# Cost of a factorisation, in solutions, above which a factor is reused for the matrices of later
# time steps: some 3,000 nodes. Smaller bodies would gain a few percent.
LEAST_COST_OF_FACTOR = 6.0
# Relative accuracy of chord steps with such a factor: they shrink about as fast as with an exact
# one.
CHORD_ACCURACY = 1e-3
# Chord steps towards an equilibrium end at this expected error, over the tolerance.
STATIC_CHORD_SHARE = 1e-4
# The same over the body's size, where rounding limits it.
STATIC_CHORD_ROUNDING = 1e-13


# Residual (3n,) of a state (3n,).
Residual = Callable[[Array], Array]
Linearise = Callable[[Array], NewtonLinearisation]


class _Iterate(NamedTuple):
    x: Array  # (3n,): state [m]
    # Factor with which the step was computed; that of the previous iterate for a last step.
    factor: Factor
    step: Array  # (free,): Newton step from x [m]


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
        Largest number of halvings of a time step (Newmark) or of the increment of forces and grasps
        in it (schemes).
    may_begin_small : bool
        Whether the first load on the way to an equilibrium may be small, see `SolutionPath`.
    checks_stability : bool
        Whether the stiffness of an equilibrium is factorised at the equilibrium itself. If false,
        it may be known to be positive definite only at a near state, from which chord steps led
        there, and the caller checks it.
    """

    tolerance: float = 1e-10
    max_iterations: int = 30
    max_backtracks: int = 25
    max_halvings: int = 8
    may_begin_small: bool = True
    checks_stability: bool = True


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

    The factor of the last solution is stored and reused by the next call.

    Attributes
    ----------
    free, is_prescribed : arrays
        Indices of free and of prescribed dofs.
    size_m : float
        Length of the diagonal of the box that contains the body.
    last_factor : Factor or None
        Factor of the last solution of complete equations, with which the next one begins.
    compliance : Compliance or None
        Inverse of the matrix of the body without local forces, of the last step with such forces.
    definite_factor : Factor or None
        Last positive definite factor on the way to an equilibrium, with which the next search for
        one begins.

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

    Raises
    ------
    InputError
        If all coordinates are prescribed.
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
        self._has_no_obstacle = not experiment.obstacles
        self.options = options or NewtonOptions()
        at_start = experiment.is_prescribed(experiment.t_s[:1])[0]
        holding = at_start if prescribed is None else prescribed
        self.free = np.flatnonzero(~holding)
        if not self.free.size:
            raise InputError(
                f"{experiment.description}: its grasps hold all {len(self.body.nodes_m)} nodes, so that "
                "nothing can move; expected fewer nodes"
            )
        self.is_prescribed = np.flatnonzero(holding)
        self.pattern = experiment.sparsity
        self.factoriser = Factoriser.cached(self.pattern, self.free)
        self.size_m = float(np.linalg.norm(np.ptp(self.body.nodes_m, axis=0)))
        self.last_factor: Factor | None = None
        self.compliance: Compliance | None = None
        self.definite_factor: Factor | None = None
        # Number of time steps until chord steps with the factor of the one before are tried again, and
        # by how many they were postponed when they failed last: as many more each time.
        self._wait = self._pause = 0
        # Mean stresses of the elements in the last time step, and its solution (3n,) [m].
        self._last_step: tuple[LaggedStress, Array] | None = None

    def solve_equilibrium(
        self, x: Array, residual: Residual, linearise: Linearise, prescribed_m: Array | None = None
    ) -> Array:
        """Solve residual(x) = 0 for a stable equilibrium of the free dofs.

        States are accepted only while −∂residual/∂x is positive definite wherever it is
        factorised, which includes the solution unless `checks_stability` of the options is false.
        Equilibria may be far from x: without obstacles the steps are applied as rotations and
        strains, see `Retraction`. The factor of the previous equilibrium is used first, and chord
        steps replace those of Newton where they shrink fast.

        Parameters
        ----------
        x : (3n,) array
            First guess [m]; not modified. Prescribed dofs keep their values unless `prescribed_m`
            is given.
        residual : callable
            Residual (3n,) of x.
        linearise : callable
            `NewtonLinearisation` at x.
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
            If the method does not converge, a matrix is singular or not positive definite, or an
            element is inverted at the start.
        """
        require_time()
        x = (
            x.copy()
            if prescribed_m is None
            else self._with_prescribed(x, prescribed_m, linearise=linearise)
        )
        self._require_upright(x)
        x, done = self._with_known_factor(x, residual)
        if done and not self.options.checks_stability:
            return x
        iterate = self._iterate_at(x, linearise, keep_definite=True)
        for _ in range(self.options.max_iterations):
            if self._is_last(iterate.step):
                self.last_factor = iterate.factor
                iterate.x[self.free] += iterate.step
                return iterate.x
            self.definite_factor = iterate.factor
            chords = self._static_chords(iterate, residual)
            if chords is not None:
                x, converged = chords
                if converged and not self.options.checks_stability:
                    return x
                try:
                    iterate = self._iterate_at(x, linearise, keep_definite=True)
                    continue
                except NewtonFailure:
                    pass
            iterate = self._backtrack(iterate, residual, linearise=linearise, keep_definite=True)
        raise self._iteration_failure(iterate)

    def solve_step(self, x: Array, equations: StepEquations) -> Array:
        """Solve one implicit time step for the free dofs.

        Local forces are condensed to the dofs on which they act, with the factor of the body
        without them of earlier steps. Where that does not converge, the complete equations are
        solved, first with the factor of the previous solution as long as steps shrink fast. Newton's
        method then takes the mean stresses of the elements from the step before and from its own
        last iterate, see `newton_linearisation`.

        Parameters
        ----------
        x : (3n,) array
            First guess [m]; not modified. Prescribed dofs keep their values. Those of B bodies
            without local forces are (B, 3n).

        Returns
        -------
        (3n,) array
            Solution [m].

        Raises
        ------
        NewtonFailure
            If no method converges, or an element is inverted at the start.
        """
        require_time()
        solution = (self._solve_step if x.ndim == 1 else self._solve_each)(x, equations)
        self._last_step = equations.stress, solution
        return solution

    def _solve_step(self, x: Array, equations: StepEquations) -> Array:
        if equations.local.parts and self.has_no_inverted_element(x):
            improved, done = self._simplified_newton(x, _CondensedIteration(self, equations))
            if done:
                return improved
        self._require_upright(x)
        # If they do not converge, the search begins at x: their last state may be far off.
        if not self._wait:
            improved, done = self._simplified_newton(x, _CompleteIteration(self, equations))
            if done:
                self._pause = 0
                return improved
            self._wait = self._pause = 2 * self._pause + 1
        self._wait -= 1
        linearise = self.with_last_stress(equations)
        iterate = self._iterate_at(x.copy(), linearise, keep_definite=False)
        for _ in range(self.options.max_iterations):
            if self._is_last(iterate.step):
                self.last_factor = iterate.factor
                iterate.x[self.free] += iterate.step
                return iterate.x
            iterate = self._backtrack(
                iterate,
                equations.residual,
                linearise=equations.linearise,
                keep_definite=False,
                stress=equations.stress,
            )
        raise self._iteration_failure(iterate)

    def with_last_stress(self, equations: StepEquations) -> Linearise:
        """Return `linearise` of the equations with the mean stresses of the step before, if any."""
        if self._last_step is None:
            return equations.linearise
        stress, before = self._last_step
        return equations.stress.expecting(stress.at(before), equations.linearise)

    def _solve_each(self, x: Array, equations: StepEquations) -> Array:
        """Solve one implicit time step of B bodies (B, 3n) without local forces by chord steps with
        the factor of the block-diagonal matrix of all.

        Raises
        ------
        NewtonFailure
            If the steps of a body do not shrink, or an element is inverted.
        """
        self._require_upright(x)
        x = x.copy()
        factoriser = Factoriser.cached(self.pattern, self.free, bodies=len(x))
        tolerance_m = self.options.tolerance * self.size_m
        done = np.zeros((len(x), 1), dtype=bool)
        factor, before, own_before = None, None, np.inf
        # As in `_CompleteIteration`.
        linearise = equations.linearise if self.body.is_solid else self.with_last_stress(equations)
        for _ in range(self.options.max_iterations):
            is_own = factor is None
            if factor is None:
                residual, matrix, skew = linearise(x)
                try:
                    factor = factoriser.factorise(matrix.ravel(), skew.ravel(), is_single=True)
                except np.linalg.LinAlgError:
                    break
            else:
                residual = equations.residual(x)
            steps = factor.solve(residual[:, self.free].ravel()).reshape(len(x), -1)
            steps[done[:, 0]] = 0.0
            x[:, self.free] += steps
            largest = np.abs(steps).max(axis=1, keepdims=True)
            rate = np.ones_like(largest) if before is None else largest / before
            done |= rate * largest <= LEAST_RESIDUAL_SHARE * tolerance_m
            done |= is_own & (largest <= tolerance_m)
            if done.all():
                self._require_upright(x)
                return x
            before = np.maximum(largest, 1e-300)
            if is_own:
                if not (done | (largest <= own_before)).all():
                    break
                own_before = largest
            elif (~done & (rate > FAST)).any():
                factor = None
        raise NewtonFailure(x, "the steps of many bodies do not shrink")

    def _iteration_failure(self, iterate: _Iterate) -> NewtonFailure:
        return NewtonFailure(
            iterate.x, f"Newton's method took more than {self.options.max_iterations} iterations"
        )

    def _iterate_at(self, x: Array, linearise: Linearise, keep_definite: bool) -> _Iterate:
        """Return the iterate at x (3n,) [m], with its own factor and the step of Newton's method."""
        with self.stopwatch.evaluating():
            at = linearise(x)
        factor = self.factorise(at, x, keep_definite=keep_definite)
        return _Iterate(x, factor, step=self.step(factor, at.residual))

    def _with_known_factor(self, x: Array, residual: Residual) -> tuple[Array, bool]:
        """Return x after chord steps with `definite_factor`, and whether it is the equilibrium."""
        factor = self.definite_factor
        if factor is None:
            return x, False
        with self.stopwatch.evaluating():
            value = residual(x)
        step = self.step(factor, value)
        chords = self._static_chords(_Iterate(x, factor, step=step), residual)
        return (x, False) if chords is None else chords

    def _static_chords(self, iterate: _Iterate, residual: Residual) -> tuple[Array, bool] | None:
        """Return x after chord steps, and whether its error is negligible; None if they fail."""
        goal_m = self.size_m * max(
            STATIC_CHORD_SHARE * self.options.tolerance, STATIC_CHORD_ROUNDING
        )
        x = iterate.x
        step = iterate.step
        has_moved = False
        for _ in range(LARGEST_STATIC_CHORD_STEP_COUNT):
            trial = x.copy()
            trial[self.free] += step
            if not self.has_no_inverted_element(trial):
                break
            with self.stopwatch.evaluating():
                value = residual(trial)
            following = self.step(iterate.factor, value)
            length = _length(step)
            rate = _length(following) / max(length, 1e-300)
            # Rounding ends the contraction of the smallest steps.
            is_rounding = self._is_last(following, OLD_FACTOR_SHARE)
            if not (rate <= SLOWEST_CHORD_RATE or is_rounding):
                break
            has_moved = True
            x = trial
            step = following
            error_m = rate / (1 - min(rate, 0.9)) * np.abs(step).max(initial=0)
            if error_m <= goal_m or is_rounding:
                x[self.free] += step
                return x, True
        return (x, False) if has_moved else None

    def _simplified_newton(self, x: Array, iteration: ChordIteration) -> tuple[Array, bool]:
        """Iterate with few factorisations (simplified Newton method); the last factor is stored."""
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

    def _chord_steps(self, x: Array, iteration: ChordIteration) -> tuple[Array, bool]:
        """Iterate with a given factor while steps shrink fast; x is not modified."""
        improved = x.copy()
        before = None
        done = False
        for _ in range(LARGEST_CHORD_STEP_COUNT):
            step = iteration.step_from(improved)
            length = _length(step)
            rate = length / before if before else 1.0
            if not rate <= 1.0:
                return x, False
            improved[self.free] += step
            done = self._is_last(rate * step, LEAST_RESIDUAL_SHARE)
            if done or (before and rate > FAST):
                break
            before = length
        return (improved, done) if self.has_no_inverted_element(improved) else (x, False)

    def _with_prescribed(self, x: Array, goal: Array, linearise: Linearise) -> Array:
        """Return x with prescribed dofs at `goal`, and free ones in equilibrium to first order."""
        state = x.copy()
        way = np.zeros_like(x)
        way[self.is_prescribed] = goal - x[self.is_prescribed]
        state[self.is_prescribed] = goal
        if not self._is_last(way):
            self._require_upright(x)
            with self.stopwatch.evaluating():
                at = linearise(x)
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
        stress: LaggedStress | None = None,
    ) -> _Iterate:
        """Return the next iterate, with the first of the halved steps that is acceptable.

        A step is acceptable when the next one, computed with the same factor, is shorter
        (Deuflhard's natural monotonicity test), and no element is inverted. With mean stresses
        `stress` a whole step is also acceptable if the next one with its own factor is as much
        shorter: the volumes of a nearly incompressible body are wrong after a long step, and only
        that factor removes the errors without further displacements.
        """
        x = iterate.x
        factor = iterate.factor
        length = _length(iterate.step)
        share = 1.0
        update = self.retraction if keep_definite and self._has_no_obstacle else add_increment
        for _ in range(self.options.max_backtracks):
            increment = np.zeros_like(x)
            increment[self.free] = share * iterate.step
            trial = update(x, increment)
            if self.has_no_inverted_element(trial):
                # A whole step is mostly taken: it is evaluated with its derivatives at once.
                with self.stopwatch.evaluating():
                    at = linearise(trial) if share == 1 else None
                    value = residual(trial) if at is None else at.residual
                next_step = self.step(factor, value)
                longest = (1 - share / 4) * length
                is_shorter = _length(next_step) <= longest
                if is_shorter and not keep_definite and self._is_last(next_step, OLD_FACTOR_SHARE):
                    return _Iterate(trial, factor, step=next_step)
                if is_shorter or (stress is not None and share == 1):
                    with self.stopwatch.evaluating():
                        at = linearise(trial) if at is None else at
                        if stress is not None:
                            at = stress.replace_stress(at, trial, stress.after(x, increment))
                    try:
                        own = self.factorise(at, trial, keep_definite=keep_definite)
                        own_step = self.step(own, at.residual)
                        if is_shorter or _length(own_step) <= longest:
                            return _Iterate(trial, own, step=own_step)
                    except NewtonFailure:
                        pass
            share /= 2
        raise NewtonFailure(x, "no step along the Newton direction decreases the residual")

    @cached_property
    def retraction(self) -> Retraction:
        """Retraction that applies increments towards an equilibrium and displaces the prescribed
        dofs exactly; computed on first use.
        """
        prescribed = np.zeros(self.pattern.size, dtype=bool)
        prescribed[self.is_prescribed] = True
        return Retraction(self.body, prescribed.reshape(-1, 3))

    def _is_last(self, step: Array, share: float = 1.0) -> bool:
        """Whether the largest entry of a step [m] is at most `share` times the tolerance."""
        tolerance = share * self.options.tolerance * self.size_m
        return bool(np.abs(step).max(initial=0.0) <= tolerance)

    def factorise(self, at: NewtonLinearisation, x: Array, keep_definite: bool) -> Factor:
        """Return the factor of −∂residual/∂x on the free dofs.

        Parameters
        ----------
        at : NewtonLinearisation
            Derivative at x.
        x : (3n,) array
            State, for the failure.
        keep_definite : bool
            Whether a matrix that is not positive definite is a failure; its factor is then
            computed in double precision.

        Raises
        ------
        NewtonFailure
            If the matrix is singular or, with `keep_definite`, not positive definite.
        """
        try:
            with self.stopwatch.solving():
                factor = (
                    self.factoriser.factorise_definite(at.symmetric)
                    if keep_definite and not at.skew.any()
                    else self.factoriser.factorise(
                        at.symmetric, at.skew, is_single=not keep_definite
                    )
                )
        except np.linalg.LinAlgError as error:
            raise NewtonFailure(x, f"the equations are singular: {error}") from error
        if factor is None or (keep_definite and not factor.positive_definite):
            raise NewtonFailure(x, "the stiffness is not positive definite")
        return factor

    @cached_property
    def factor_sequence(self) -> FactorSequence | None:
        """Solver of the systems of time steps with few factorisations, for large bodies in motion;
        None for others.
        """
        if not self.factoriser.has_single_precision:
            return None
        if relative_cost(self.factoriser, columns=1) < LEAST_COST_OF_FACTOR:
            return None
        return FactorSequence(
            self.factoriser,
            NodeRotation(self.free, self.pattern.size // 3),
            accuracy=CHORD_ACCURACY,
        )

    def step(self, factor: Factor, residual: Array) -> Array:
        """Return the Newton step (free,) [m] of the free dofs for a residual (3n,)."""
        with self.stopwatch.solving():
            return factor.solve(residual[self.free])

    def has_no_inverted_element(self, x: Array) -> bool:
        """Return whether det F is positive at all quadrature points at x (3n,) [m]."""
        return bool(self.body.volume_ratios(x).min() > 0)

    def _require_upright(self, x: Array) -> None:
        if not self.has_no_inverted_element(x):
            raise NewtonFailure(x, "an element is inverted before the first iteration")

    def worst_element(self, x: Array) -> int:
        """Return the index of the element with the smallest det F at any of its quadrature points
        at x (3n,) [m].
        """
        return int(self.body.volume_ratios(x)[0].min(axis=1).argmin())


def _length(step: Array) -> float:
    """Return the length of a step; infinite if its square overflows, as that of a body that fails."""
    with np.errstate(over="ignore"):
        return float(np.linalg.norm(step))


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


@dataclass(eq=False)
class _CompleteIteration:
    """Steps with the factor of the complete matrix.

    Attributes
    ----------
    has_factor : bool
        Whether there is a factor of an earlier state. Where factors are reused for several
        matrices, that of another time step does not count: a new matrix costs less than steps that
        shrink more slowly. Nor does it unless the body is a solid: other matrices cost little and
        contain the resultants of the step before.
    """

    solver: NewtonSolver  # stores the factor
    equations: StepEquations
    _residual: Array | None = None  # at the state of the factor, before the first step

    def __post_init__(self) -> None:
        solver = self.solver
        is_solid = solver.body.is_solid
        self.has_factor = (
            solver.last_factor is not None and solver.factor_sequence is None and is_solid
        )
        equations = self.equations
        self._linearise = equations.linearise if is_solid else solver.with_last_stress(equations)

    def factorise_at(self, x: Array) -> None:
        solver = self.solver
        with solver.stopwatch.evaluating():
            at = self._linearise(x)
        self._residual = at.residual
        solver.last_factor = (
            solver.factorise(at, x, keep_definite=False)
            if solver.factor_sequence is None
            else ReusedFactor(
                solver.factor_sequence, Matrix(at.symmetric, at.skew), points_m=x.reshape(-1, 3)
            )
        )
        self.has_factor = True

    def step_from(self, x: Array) -> Array:
        solver = self.solver
        assert solver.last_factor is not None
        residual, self._residual = self._residual, None
        if residual is None:
            with solver.stopwatch.evaluating():
                residual = self.equations.residual(x)
        try:
            return solver.step(solver.last_factor, residual)
        except np.linalg.LinAlgError as error:  # a factor that is reused
            raise NewtonFailure(x, f"the equations are singular: {error}") from error


class _CondensedIteration:
    """Steps with the factor of the body without local forces, which are condensed."""

    def __init__(self, solver: NewtonSolver, equations: StepEquations) -> None:
        self._solver = solver
        self._equations = equations
        self._use_compliance()

    @property
    def has_factor(self) -> bool:
        return self._steps is not None

    def factorise_at(self, x: Array) -> None:
        solver = self._solver
        with solver.stopwatch.evaluating():
            at = self._equations.linearise_without_local(x)
        symmetric = at._replace(skew=NO_SKEW_PART)
        factor = solver.factorise(symmetric, x, keep_definite=False)
        solver.compliance = Compliance(factor, solver.free, dof_count=solver.pattern.size)
        self._use_compliance()

    def step_from(self, x: Array) -> Array:
        assert self._steps is not None
        with self._solver.stopwatch.evaluating():
            return self._steps.step_from(x)

    def _use_compliance(self) -> None:
        compliance = self._solver.compliance
        self._steps = (
            None
            if compliance is None
            else CondensedSteps(
                self._equations, compliance, free=self._solver.free, size_m=self._solver.size_m
            )
        )


class SolutionPath:
    """Solution x(s) of equations that depend on a share s of the loads, followed from x(0) to x(1)
    in increments that shrink on failure and grow after two successes.

    The caller solves the equations: `next_guess` states where, and the result is given to `accept`,
    or a failure to `shorten`.

    Attributes
    ----------
    x : (3n,) array
        Solution at `share` [m].
    share : float
        The s that has been reached; 1 at the end of the path.

    Parameters
    ----------
    x : (3n,) array
        x(0) [m]; not modified.
    halvings : int
        The smallest increment is 0.5 to this power.
    may_begin_small : bool
        Whether the smallest increment is relative to the share that has been reached, and the first
        one its square: a rope turns by a right angle under a thousandth of its weight. What grasps
        compress may buckle to any side after such increments.
    guess : (3n,) array, optional
        Guess of x(1), which is tried first; the path begins at x(0) if it fails, unless `halvings`
        is 0. By default the path begins at x(0).
    """

    def __init__(
        self, x: Array, halvings: int, guess: Array | None = None, may_begin_small: bool = False
    ) -> None:
        self.x = x
        self.share = 0.0
        self._halvings = halvings
        self._may_begin_small = may_begin_small
        self._guess = guess
        self._rate = np.zeros_like(x)
        self._longest_step = 1.0
        self._step = 1.0
        self._last_succeeded = False

    def next_guess(self) -> tuple[Array, float]:
        """Return a guess (3n,) [m] of the next solution, and its share s."""
        if self._guess is not None:
            return self._guess, 1.0
        self._step = min(self._longest_step, 1.0 - self.share)
        return self.x + self._step * self._rate, self.share + self._step

    def accept(self, solution: Array) -> None:
        """Continue the path from the solution (3n,) [m] at the share of the last guess."""
        self._rate = (solution - self.x) / self._step
        self.x = solution
        self.share += self._step
        # One step as long as that which failed would fail again.
        self._longest_step = (2 if self._last_succeeded else 1) * self._step
        self._last_succeeded = True

    def shorten(self) -> bool:
        """Shorten the next increment, because no solution was found at the last guess, and return
        whether it is not too short.
        """
        if self._guess is not None:
            self._guess = None
            return self._halvings > 0
        # What fails costs many times what succeeds: better short steps that grow.
        self._longest_step = self._step / 4
        self._last_succeeded = False
        least = 0.5**self._halvings
        return self._longest_step >= least * (
            max(self.share, least) if self._may_begin_small else 1
        )


class NewtonSolvers:
    """Solvers of an experiment, one for each set of prescribed dofs; created on demand.

    Parameters
    ----------
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
    solver: NewtonSolver, failure: NewtonFailure, time_s: float, what: str, *, static: bool = False
) -> SimulationError:
    """Return the error for the user: what failed, when, at which element, and what to change.

    Parameters
    ----------
    solver : NewtonSolver
        The solver that failed.
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
    remedy = "smaller loads" if static else "a smaller time step"
    return SimulationError(
        f"{what} failed: {failure.reason}; the most deformed element has the volume ratio "
        f"det F = {ratio:.3g}. Stiffer parameters, {remedy} or smaller elements may help",
        time_s,
        element=element,
        state_m=failure.x if static else None,
    )
