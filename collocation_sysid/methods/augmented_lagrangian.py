"""Augmented Lagrangian: the penalty method with multipliers, so that ρ need not become large.

    minimise   L(z) + yᵀ g(z) + ρ/2 ‖g(z)‖²,   then   y ← y + ρ g

and again from there, with a larger ρ where the slack ‖g‖ did not fall well. Inner problems are
solved to tolerances that tighten with the slack (J. Nocedal and S. Wright, Numerical
Optimization, 2nd ed., framework 17.3 and algorithm 17.4; the rule for ρ is that of ALGENCAN,
R. Andreani et al., SIAM J. Optim. 18, 2007: the fixed sequence of LANCELOT expects rows of order
one, and would make ρ larger than the multipliers need). Converges to the optimum of interior
point and of the reduced space.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..arrays import Array
from ..errors import InputError
from ..nlp.collocation import Collocation
from .inner import Inner
from .solution import Solution, Status
from .stages import OutOfBudget, Stages, Watch, check_positive

# ρ rises where a stage leaves more than this share of the slack, and the solve ends where not even
# the largest ρ leaves less than the second.
FALL, STUCK = 0.25, 0.9
# Gradient wanted of the first stage, and of a later one over that of the one before.
FIRST_GRADIENT, TIGHTER = 1e-3, 0.1


@dataclass(frozen=True)
class AugmentedLagrangianOptions:
    """Options of the augmented-Lagrangian method.

    Attributes
    ----------
    inner : {"levenberg-marquardt", "cg-descent", "scipy-cg", "l-bfgs-b"}
        What minimises the merit function, see `PenaltyOptions`.
    rho : float
        First ρ; loss and rows are in the scaling of the NLP, both of order one.
    rho_max : float
        Largest ρ.
    rho_factor : float
        ρ rises by it where a stage leaves too much slack to trust its multipliers.
    inner_iterations : int
        Most iterations of a stage.
    tolerance : float
        Largest entry of the Lagrangian's gradient at the end, in the scaling of the NLP, or
        1e-14 of ρ plus the loss's largest curvature: rounding hides less.
    violation : float
        Slack that the answer may leave, over the largest force in the balance.
    max_iterations : int
        Iterations of all stages together.
    max_time_s : float
    """

    inner: Inner = "levenberg-marquardt"
    rho: float = 1e5
    rho_max: float = 1e9
    rho_factor: float = 10.0
    inner_iterations: int = 1000
    tolerance: float = 1e-6
    violation: float = 1e-7
    max_iterations: int = 10_000
    max_time_s: float = 1e6


def solve(
    collocation: Collocation,
    options: AugmentedLagrangianOptions | None = None,
    watch: Watch | None = None,
    start: Array | None = None,
) -> Solution:
    """Solve the NLP by the method of multipliers.

    Parameters
    ----------
    collocation : Collocation
    options : AugmentedLagrangianOptions, optional
    watch : callable, optional
        Called with every line of the history; its number counts inner iterations.
    start : (variables,) ndarray, optional
        Initial variables; a simulation at the guess by default.

    Returns
    -------
    Solution
        Also when it did not converge, or was interrupted (Ctrl-C): then the last iterate.

    Raises
    ------
    InputError
        For an unknown name or a number out of range among the options.
    """
    options = options or AugmentedLagrangianOptions()
    check_positive(options, "rho", "tolerance", "violation", "inner_iterations", "max_time_s")
    if not options.rho_factor > 1:
        raise InputError(f"rho_factor = {options.rho_factor:g}; expected above 1", None, "solver")
    if not options.rho_max >= options.rho:
        found = f"rho_max = {options.rho_max:g} with rho = {options.rho:g}"
        raise InputError(f"{found}; expected rho_max to be no less", None, "solver")
    stages = Stages(
        collocation, options.inner, options.max_iterations, options.max_time_s, watch, start
    )
    try:
        status, why = _climb(stages, options)
    except OutOfBudget as end:
        status, why = end.status, end.status.sentence
    except KeyboardInterrupt:
        status, why = Status.INTERRUPTED, Status.INTERRUPTED.sentence
    slack, rho = stages.slack(), stages.merit.rho
    message = f"{why} At ρ = {rho:.3g} {slack} is left."
    return stages.solution("augmented-lagrangian", status, message)


def _climb(stages: Stages, options: AugmentedLagrangianOptions) -> tuple[Status, str]:
    """Stage after stage."""
    merit = replace(stages.merit, rho=options.rho)
    gradient, before = max(FIRST_GRADIENT, options.tolerance), np.inf
    while True:
        reached = stages.minimise(merit, gradient, options.inner_iterations)
        slack = stages.slack()
        within = slack.relative <= options.violation
        if reached and within and gradient <= options.tolerance:
            return Status.CONVERGED, Status.CONVERGED.sentence
        fell = slack.scaled <= FALL * before
        last = merit.rho >= options.rho_max or within
        if last and gradient <= options.tolerance and slack.scaled > STUCK * before:
            if reached:
                return Status.STALLED, "rho_max does not make the dynamics hold."
            return Status.STALLED, (
                f"The last stage ended with a gradient of {stages.gradient:.2g}, short of its "
                f"tolerance {gradient:.2g}; another inner solver may get farther."
            )
        rho = merit.rho if fell or within else min(options.rho_factor * merit.rho, options.rho_max)
        rows = stages.problem.constraint_values(stages.z)
        merit = replace(merit, rho=rho, multipliers=merit.estimate(rows))
        tighter = 0.0 if within else TIGHTER * gradient
        gradient, before = max(tighter, options.tolerance), slack.scaled
