"""Penalty: the dynamics are not imposed but paid for, as in the paper.

    minimise   L(z) + ρ/2 ‖g(z)‖²

for one ρ or a rising sequence of them, each started from the last answer. A finite ρ always
leaves some slack: forces −g that no robot applied, which fall as 1/ρ and bias the parameters
while they last. The answer counts as converged where the merit's gradient is within `tolerance`
and the slack within `violation`; else the message says how much of it is left.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from ..arrays import Array
from ..errors import InputError
from ..nlp.collocation import Collocation
from .inner import Inner
from .solution import Solution, Status
from .stages import OutOfBudget, Stages, Watch, check_positive

Schedule = Literal["constant", "geometric", "progress"]

# With the "progress" schedule ρ rises where a stage leaves more than this share of the slack.
FALL = 0.25


@dataclass(frozen=True)
class PenaltyOptions:
    """Options of the penalty method.

    Attributes
    ----------
    inner : {"cg-descent", "scipy-cg", "l-bfgs-b", "levenberg-marquardt"}
        What minimises the merit function: Hager and Zhang's conjugate gradients as in the paper,
        SciPy's, a quasi-Newton method, or damped Newton steps with a sparse factorisation, which
        alone get anywhere near a minimum at large ρ.
    schedule : {"geometric", "progress", "constant"}
        How ρ goes from `rho` to `rho_max`: by `rho_factor` after every stage, or only after those
        that left more than a quarter of the slack, or not at all.
    rho : float
        First ρ; loss and rows are in the scaling of the NLP, where both are of order one.
    rho_max : float
        Last ρ.
    rho_factor : float
    inner_iterations : int
        Most iterations of a stage.
    tolerance : float
        Largest entry of the merit's gradient at the end of a stage, in the scaling of the NLP, or
        1e-14 of ρ plus the loss's largest curvature: rounding hides less.
    violation : float
        Slack that an answer may leave, over the largest force in the balance. A stage that
        ends within it ends the solve.
    max_iterations : int
        Iterations of all stages together.
    max_time_s : float
    """

    inner: Inner = "cg-descent"
    schedule: Schedule = "geometric"
    rho: float = 1e2
    rho_max: float = 1e8
    rho_factor: float = 10.0
    inner_iterations: int = 1000
    tolerance: float = 1e-6
    violation: float = 1e-3
    max_iterations: int = 10_000
    max_time_s: float = 1e6


def solve(
    collocation: Collocation,
    options: PenaltyOptions | None = None,
    watch: Watch | None = None,
    start: Array | None = None,
) -> Solution:
    """Solve the NLP by a penalty on its constraints.

    Parameters
    ----------
    collocation : Collocation
    options : PenaltyOptions, optional
    watch : callable, optional
        Called with every line of the history; its number counts inner iterations.
    start : (variables,) ndarray, optional
        Initial variables; a simulation at the guess by default.

    Returns
    -------
    Solution
        With ρ g as multipliers. Also when it did not converge, or was interrupted (Ctrl-C): then
        the last iterate. Held nodes are put where their grasps are, and the slack counted there.

    Raises
    ------
    InputError
        For an unknown name or a number out of range among the options.
    """
    options = options or PenaltyOptions()
    _check(options)
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
    return stages.solution("penalty", status, f"{why} At ρ = {rho:.3g} {slack} is left.")


def _climb(stages: Stages, options: PenaltyOptions) -> tuple[Status, str]:
    """Stage after stage."""
    last = options.rho if options.schedule == "constant" else options.rho_max
    merit = replace(stages.merit, rho=options.rho)
    before = np.inf
    while True:
        reached = stages.minimise(merit, options.tolerance, options.inner_iterations)
        slack = stages.slack().relative
        if reached and slack <= options.violation:
            return Status.CONVERGED, "Converged: gradient and slack are within their tolerances."
        stuck = options.schedule != "progress" or slack > FALL * before
        if stuck and merit.rho >= last:
            break
        if stuck or reached:
            merit = replace(merit, rho=min(options.rho_factor * merit.rho, last))
        before = slack
    if reached:
        return Status.STALLED, (
            "The merit is at its minimum but the dynamics do not hold; raise rho_max."
        )
    return Status.ITERATION_LIMIT, (
        f"The last stage ended before its minimum, with a gradient of {stages.gradient:.2g}; "
        "raise inner_iterations or choose another inner solver."
    )


def _check(options: PenaltyOptions) -> None:
    if options.schedule not in get_args(Schedule):
        known = ", ".join(get_args(Schedule))
        found = options.schedule
        raise InputError(f"schedule = {found!r}; expected one of {known}", None, "solver")
    check_positive(options, "rho", "tolerance", "violation", "inner_iterations", "max_time_s")
    if options.schedule == "constant":
        return
    if not options.rho_factor > 1:
        raise InputError(f"rho_factor = {options.rho_factor:g}; expected above 1", None, "solver")
    if not options.rho_max >= options.rho:
        found = f"rho_max = {options.rho_max:g} with rho = {options.rho:g}"
        raise InputError(f"{found}; expected rho_max to be no less", None, "solver")
