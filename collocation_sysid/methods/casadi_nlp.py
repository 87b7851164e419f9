"""Other NLP solvers that come with CasADi, by the name of their plugin: "casadi:sqpmethod" …

They get the same NLP and the same derivatives as interior point. A plugin asks for its functions
by names of its own, of which only some are options: all are put into its cache of functions, where
it looks before it derives them, which it could not from callbacks.

============  ==================================================================================
sqpmethod     SQP; its QPs by PIQP, an interior-point solver for sparse convex QPs
sleqp         trust-region SLP-EQP: an LP finds the active set, then conjugate gradients; its runs
              differ, and some end a little short of the tolerance
============  ==================================================================================

Neither knows of the band structure in time: for problems of a few thousand variables, to compare.
Those in `REFUSED` do not work on this NLP, or need a library that CasADi does not bring.
"""

from __future__ import annotations

import difflib
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal, get_args

import casadi as ca
import numpy as np

from ..arrays import Array
from ..errors import InputError
from ..nlp.collocation import Collocation
from .callbacks import HessianValues, Monitor, NlpFunctions, Watch
from .method import Method
from .nlpsol import build, interruptible, timing
from .solution import Solution, Status
from .start import initial_variables

Hessian = Literal["gauss-newton", "exact"]

PREFIX = "casadi:"
# Largest constraint of an answer that a solver calls one, and largest violation of the optimality
# conditions of the best iterate where it could not get on; in the scaling of the NLP.
FEASIBLE, ACCEPTABLE = 1e-6, 1e-5


@dataclass(frozen=True)
class CasadiOptions:
    """Options of CasADi's other solvers.

    Attributes
    ----------
    hessian : {"gauss-newton", "exact"}, optional
        Second derivatives: the loss's only, which are convex, or all of the Lagrangian's. By
        default gauss-newton for sqpmethod, whose QPs have to be convex, and exact for sleqp.
    tolerance : float
        The solver's own, on feasibility and optimality in the scaling of the NLP.
    max_iterations : int
    max_time_s : float
        Looked at once an iteration.
    casadi : mapping
        Further options of the plugin by name; they win over the ones above.
    """

    hessian: Hessian | None = None
    tolerance: float = 1e-8
    max_iterations: int = 200
    max_time_s: float = 1e6
    casadi: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Plugin:
    """What a plugin asks for and says.

    Attributes
    ----------
    functions : mapping
        Outputs, as `NlpFunctions` names them, of the functions by the plugin's names.
    settings : callable
        Its options from ours.
    statuses : mapping
        Its return status in our words; a failure where it is not among them.
    hessian : {"gauss-newton", "exact"}
        What suits it.
    """

    functions: Mapping[str, str]
    settings: Callable[[CasadiOptions], dict[str, Any]]
    statuses: Mapping[str, Status]
    hessian: Hessian


def _sqpmethod(options: CasadiOptions) -> dict[str, Any]:
    return {
        "qpsol": "piqp",
        "qpsol_options": {"error_on_fail": False},
        "tol_pr": options.tolerance,
        "tol_du": options.tolerance,
        "max_iter": options.max_iterations,
        "print_header": False,
        "print_iteration": False,
        "print_status": False,
    }


def _sleqp(options: CasadiOptions) -> dict[str, Any]:
    return {
        "max_iter": options.max_iterations,
        "max_wall_time": options.max_time_s,
        "print_level": 0,
        "sleqp": {"feas_tol": options.tolerance, "stat_tol": options.tolerance},
    }


PLUGINS: dict[str, Plugin] = {
    "sqpmethod": Plugin(
        {"nlp_fg": "f g", "nlp_jac_fg": "f grad_f g jac_g", "nlp_hess_l": "hess"},
        _sqpmethod,
        {
            "Solve_Succeeded": Status.CONVERGED,
            "Maximum_Iterations_Exceeded": Status.ITERATION_LIMIT,
            "Infeasible_Problem_Detected": Status.INFEASIBLE,
            "Search_Direction_Becomes_Too_Small": Status.STALLED,
            "User_Requested_Stop": Status.INTERRUPTED,
        },
        "gauss-newton",
    ),
    "sleqp": Plugin(
        {
            "nlp_f": "f",
            "nlp_g": "g",
            "nlp_grad_f": "f grad_f",
            "nlp_jac_g": "g jac_g",
            "nlp_grad_l": "grad_l",
        },
        _sleqp,
        {
            "optimal": Status.CONVERGED,
            "iteration limit": Status.ITERATION_LIMIT,
            "time limit": Status.TIME_LIMIT,
            "infeasible": Status.INFEASIBLE,
            "unbounded": Status.DIVERGED,
            "deadpoint": Status.STALLED,
            "manual abort": Status.INTERRUPTED,
        },
        "exact",
    ),
}

_LIBRARY = "it needs a library, and mostly a licence, that CasADi does not bring"
REFUSED: dict[str, str] = {
    "ipopt": 'its own method is "interior-point"',
    "alpaqa": "it derives an augmented Lagrangian from expressions, and the NLP has only callbacks",
    "blocksqp": "it derives its Hessian's structure from expressions, and the NLP has only "
    "callbacks; its QP solver wants MA27",
    "fatrop": "it factorises densely what is not an optimal-control problem in stages, and goes "
    "on where an evaluation fails or is to be stopped",
    "feasiblesqpmethod": "its feasible start within bounds does not exist for this NLP",
    "qrsqp": "its QP solver cycles on this NLP",
    "scpgen": "it derives the NLP from expressions, and this one has only callbacks",
    "uno": "the plugin in CasADi's wheel corrupts memory on this NLP and aborts the process",
    "bonmin": 'without integers it is IPOPT, whose method is "interior-point"; it can neither be '
    "followed nor stopped",
    "ampl": "it starts an AMPL solver outside, which has no callbacks",
    **dict.fromkeys(("ccopt", "conopt", "knitro", "madnlp", "snopt", "worhp"), _LIBRARY),
}


def methods() -> dict[str, Method]:
    """The plugins that work, as methods by name."""
    return {PREFIX + name: Method(partial(solve, plugin=name), CasadiOptions) for name in PLUGINS}


def why_not(name: str) -> str | None:
    """Why there is no method of this name, if it is "casadi:" with a plugin that is not offered."""
    if not name.startswith(PREFIX) or name.removeprefix(PREFIX) in PLUGINS:
        return None
    plugin, offered = name.removeprefix(PREFIX), ", ".join(PREFIX + known for known in PLUGINS)
    if plugin in REFUSED:
        return f"found {name!r}, which is not offered: {REFUSED[plugin]}. Expected one of {offered}"
    close = difflib.get_close_matches(plugin, PLUGINS, n=1)
    hint = f"did you mean {PREFIX + close[0]!r}? " if close else ""
    return f"found {name!r}, which CasADi does not have; {hint}expected one of {offered}"


def solve(
    collocation: Collocation,
    options: CasadiOptions | None = None,
    watch: Watch | None = None,
    start: Array | None = None,
    *,
    plugin: str,
) -> Solution:
    """Solve the NLP with one of CasADi's plugins.

    Parameters
    ----------
    collocation : Collocation
    options : CasadiOptions, optional
    watch : callable, optional
        Called with every `Iteration`.
    start : (variables,) ndarray, optional
        Initial variables; a simulation at the guess by default.
    plugin : str
        A key of `PLUGINS`.

    Returns
    -------
    Solution
        Also when it did not converge or was interrupted (Ctrl-C): then the best iterate.

    Raises
    ------
    InputError
        For a plugin that is not offered, or an option it does not know.
    """
    if plugin not in PLUGINS:
        raise InputError(why_not(PREFIX + plugin) or "", None, "solver.method")
    options = options or CasadiOptions()
    hessian = options.hessian or PLUGINS[plugin].hessian
    if hessian not in get_args(Hessian):
        known = ", ".join(get_args(Hessian))
        raise InputError(f"no hessian {hessian!r}; available: {known}", None, "solver")
    began = time.perf_counter()
    notes: list[str] = []
    if start is None:
        start, notes = initial_variables(collocation)
    errors: list[BaseException] = []
    monitor = Monitor(collocation, watch, began, errors, options.max_time_s)
    functions = NlpFunctions(collocation, _curvature(collocation, hessian), errors)
    solver = build(plugin, functions, _settings(plugin, functions, monitor, options), plugin)
    built = time.perf_counter()
    z, multipliers, said, count = _run(solver, collocation, start, monitor)
    if errors:
        raise errors[0]
    status = PLUGINS[plugin].statuses.get(said, Status.NUMERICAL_FAILURE)
    if monitor.stop or (monitor.late and not status.converged):
        status = Status.INTERRUPTED if monitor.stop else Status.TIME_LIMIT
    if not (status.converged and np.isfinite(z).all()):
        z, multipliers = monitor.best or (start, np.zeros(collocation.constraints))
    status = _judged(status, collocation, z, multipliers)
    spent = timing(functions, monitor, began, built)
    return Solution(
        status=status,
        message=f"{status.sentence} ({plugin}: {said})",
        method=PREFIX + plugin,
        collocation=collocation,
        z=z,
        multipliers=multipliers,
        iterations=count or max(0, len(monitor.history) - 1),
        history=tuple(monitor.history),
        timing=spent,
        notes=tuple(notes),
        evaluations=functions.calls,
    )


def _judged(status: Status, collocation: Collocation, z: Array, multipliers: Array) -> Status:
    """What a solver says of its answer, after a look at the NLP's own functions there."""
    if status.converged:
        violation = np.abs(collocation.constraint_values(z)).max(initial=0.0)
        return status if violation <= FEASIBLE else Status.INFEASIBLE
    stuck = status in (Status.STALLED, Status.NUMERICAL_FAILURE)
    if stuck and collocation.kkt_residual(z, multipliers) <= ACCEPTABLE:
        return Status.ACCEPTABLE
    return status


def _curvature(collocation: Collocation, hessian: Hessian) -> HessianValues:
    """The Hessian's values as `NlpFunctions` wants them."""

    def values(z: Array, weight: float, multipliers: Array, out: Array) -> None:
        if hessian == "gauss-newton":
            multipliers = np.zeros_like(multipliers)
        collocation.hessian_values(z, weight, multipliers, out)

    return values


def _settings(
    plugin: str, functions: NlpFunctions, monitor: Monitor, options: CasadiOptions
) -> dict[str, Any]:
    chosen = PLUGINS[plugin]
    settings: dict[str, Any] = {
        "print_time": False,
        "error_on_fail": False,
        "show_eval_warnings": False,
        "no_nlp_grad": True,
        "iteration_callback": monitor,
        "cache": {
            name: functions.function(name, *outputs.split())
            for name, outputs in chosen.functions.items()
        },
    }
    settings |= chosen.settings(options)
    for name, value in options.casadi.items():
        both = isinstance(value, Mapping) and isinstance(settings.get(name), Mapping)
        settings[name] = settings[name] | value if both else value
    return settings


def _run(
    solver: ca.Function, collocation: Collocation, start: Array, monitor: Monitor
) -> tuple[Array, Array, str, int]:
    """Variables, multipliers, what the solver said, and its iterations."""
    lower, upper = collocation.bounds()
    try:
        with interruptible(monitor):
            answer = solver(x0=start, lbx=lower, ubx=upper, lbg=0, ubg=0)
        stats = solver.stats()
    except RuntimeError as error:  # of its own, or what a callback's failure makes of it
        said = str(error).strip().splitlines()[-1].split(": ", 1)[-1]
        return start, np.zeros(collocation.constraints), said, 0
    z, multipliers = answer["x"].full().ravel(), answer["lam_g"].full().ravel()
    return z, multipliers, str(stats["return_status"]), int(stats.get("iter_count") or 0)
