"""Check of a method that solves a `Collocation`: `check_method`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..common.array_types import Array
from ..common.validated_classes import validated
from ..fem.body import Body
from ..fem.meshes.structured import box_mesh
from ..methods.solution import Iteration, Method, Solution
from ..model.parameters import Parameters, Unknown
from ..program.collocation import Collocation
from ..program.simulation import simulate, with_markers
from .property_check import PropertyCheck
from .small_problems import DENSITY_KG_M3, swung_experiment

# Difference of two losses, sums of squares over variances, that rounding explains [1].
LOSS_ROUNDING = 1e-12
# Parameters of the simulated recording, and the guesses of those that are estimated.
TRUTH = {"young_pa": 800.0, "poisson": 0.25, "gamma_r_s": 5e-3, "gamma_m_1_s": 0.3}
GUESSES = {"young_pa": 1200.0, "gamma_r_s": 8e-3}
# Largest relative error of an estimate: markers without noise determine the parameters exactly.
LARGEST_ERROR = 1e-3
# Largest residual of the equations of motion, relative to the largest force.
LARGEST_VIOLATION = 1e-5


@validated
def check_method(
    method: Method, *, is_exact: bool = True, largest_error: float = LARGEST_ERROR
) -> None:
    """Check a method on a small recording: answer, history and restart.

    The method converges to the parameters of the simulation, within the bounds, with the
    equations of motion satisfied. It passes every line of the history to `watch`, ends with a
    lower loss than it begins with, does not change the `Collocation`, and finds the same answer
    from its own answer.

    Parameters
    ----------
    method : Method
        Method with the options to check.
    is_exact : bool
        Whether the equations of motion hold at the answer; false for penalty methods, which leave
        a slack.
    largest_error : float
        Largest relative error of an estimated parameter.

    Raises
    ------
    AssertionError
        For the first property that fails: which one, where, found and expected value.

    Notes
    -----
    The method is called twice: with `watch`, and with its own answer as `start`. What it changes in
    the program is seen by its guess, bounds and values at one point. A method that raises an error
    lets the check raise it.
    """
    name = getattr(method, "name", None) or getattr(method, "__name__", type(method).__name__)
    check = PropertyCheck(f"method {name!r}")
    collocation = small_recording()
    lines: list[Iteration] = []
    before = _fingerprint(collocation)
    solution = method(collocation, watch=lines.append)
    _check_answer(check, solution, is_exact=is_exact, largest_error=largest_error)
    _check_history(check, solution, lines=lines)
    check.require_equal(
        _fingerprint(collocation), before, statement="it changes the collocation that it solves"
    )
    again = method(collocation, start=solution.z)
    _check_answer(
        check, again, is_exact=is_exact, largest_error=largest_error, where=" from its own answer"
    )


def small_recording() -> Collocation:
    """Return the program of a simulated swing of a foam block without noise, with the constants of
    `GUESSES` to be estimated and all others at their values in `TRUTH`.
    """
    body = Body(box_mesh((0.05, 0.05, 0.1), (1, 1, 2)), density_kg_m3=DENSITY_KG_M3)
    experiment = swung_experiment(body)
    recorded = with_markers(
        experiment, simulate(experiment, TRUTH, "midpoint", substeps=1).markers_m
    )
    unknowns: Mapping[str, Any] = TRUTH | {name: Unknown(value) for name, value in GUESSES.items()}
    return Collocation([recorded], Parameters.from_mapping(unknowns))


def _fingerprint(collocation: Collocation) -> Array:
    """Return numbers that change if a method changes the program in place: guess, objective,
    constraints, gradient and bounds at a rigid motion; infinite ones count as zero.
    """
    p = collocation.guess_p
    rigid = [s.experiment.rigid_positions(s.dynamics.t_s) for s in collocation.transcriptions]
    z = collocation.pack(p, [x.reshape(len(x), -1) for x in rigid])
    values = [collocation.constraint_values(z), collocation.gradient(z), *collocation.bounds()]
    numbers = np.concatenate([p, [collocation.objective(z)], *values])
    return np.where(np.isfinite(numbers), numbers, 0.0)


def _check_answer(
    check: PropertyCheck,
    solution: Solution,
    *,
    is_exact: bool,
    largest_error: float,
    where: str = "",
) -> None:
    """Require convergence to the truth, within the bounds, with the equations satisfied."""
    if not isinstance(solution, Solution):
        check.fail("it does not return a Solution", type(solution).__name__, expected="Solution")
    if not solution.status.converged:
        check.fail(f"it does not converge{where}", solution.status.value, expected="converged")
    for name in GUESSES:
        value = solution.parameters[name]
        if not abs(value / TRUTH[name] - 1) <= largest_error:
            check.fail(f"the estimate of {name} is wrong{where}", value, expected=TRUTH[name])
    low, high = solution.collocation.bounds()
    excess = float(np.maximum(low - solution.z, solution.z - high).max(initial=0.0))
    if not excess <= 1e-9:
        check.fail(f"a variable is outside its bounds{where}", excess, expected="0")
    violation = solution.max_violation_relative
    if is_exact and not violation <= LARGEST_VIOLATION:
        check.fail(
            f"the equations of motion do not hold{where}: residual over the largest force",
            violation,
            expected=f"at most {LARGEST_VIOLATION:g}",
        )


def _check_history(check: PropertyCheck, solution: Solution, lines: list[Iteration]) -> None:
    """Require a watched history with losses that decrease, and a finite loss."""
    if not solution.history:
        check.fail("the history of the solve is empty", 0, expected="at least one line")
    if lines != list(solution.history):
        check.fail(
            "watch did not get every line of the history",
            len(lines),
            expected=len(solution.history),
        )
    complete = [line.loss for line in solution.history if line.share >= 1.0]
    if not complete:
        check.fail(
            "no line of the history is about the complete recording",
            solution.history[-1].share,
            expected=1.0,
        )
    if not complete[-1] <= complete[0] + LOSS_ROUNDING:
        check.fail(
            "the loss of the last line of the history is above that of the first",
            complete[-1],
            expected=complete[0],
        )
    expected = solution.collocation.objective(solution.z) / solution.collocation.loss_scale
    if not np.isfinite(expected):
        check.fail("the loss of the answer is not finite", expected, expected="a finite loss")
