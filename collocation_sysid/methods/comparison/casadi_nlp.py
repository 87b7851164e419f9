"""Further NLP solvers of CasADi, by the name of their plugin: "casadi:sqpmethod" and
"casadi:sleqp".

They get the same NLP and the same derivatives as interior point.

============  ==================================================================================
sqpmethod     SQP; its QPs by PIQP, an interior-point solver for sparse convex QPs
sleqp         trust-region SLP-EQP: an LP finds the active set, then conjugate gradients; its runs
              differ, and some end a little short of the tolerance
============  ==================================================================================

Neither uses the band structure in time: use them for problems of a few thousand variables, to
compare. `REFUSED` lists solvers that do not work on this NLP or need a library that CasADi does not
contain.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import field
from functools import partial
from typing import Any, ClassVar

import numpy as np

from ...common.array_types import Array
from ...common.validated_classes import validated
from ...common.validated_types import Count, Positive
from ...program.casadi_functions import Hessian, NlpFunctions, hessian_values
from ...program.collocation import Collocation
from ...program.lifted.collocation import with_lifted_variables
from .. import nlpsol
from ..options import MethodOptions
from ..solution import Solution, Status, Watch
from ..solve_recorder import Recorder

PREFIX = "casadi:"
# Largest constraint of a solution, in the scaling of the NLP.
FEASIBLE = 1e-6
# Largest violation of the optimality conditions with which a stalled solve is acceptable.
ACCEPTABLE = 1e-5


@validated
class CasadiSolver(MethodOptions):
    """Base class of CasADi's solvers; subclasses define the functions and statuses of their plugin.

    Attributes
    ----------
    statuses : mapping
        `Status` by the plugin's return status.
    hessian : {"gauss-newton", "exact"}
        Second derivatives: those of the loss only, which are convex, or all of the Lagrangian's.
        The QPs of sqpmethod must be convex.
    tolerance : float
        The solver's tolerance of feasibility and optimality, in the scaling of the NLP.
    max_iterations : int
        Largest number of iterations.
    max_time_s : float
        Largest computing time in seconds; checked once per iteration.
    casadi : mapping
        Further options of the plugin by name; they override the ones above.
    """

    statuses: ClassVar[Mapping[str, Status]]

    hessian: Hessian = "exact"
    tolerance: Positive = 1e-8
    max_iterations: Count = 200
    max_time_s: Positive = 1e6
    casadi: Mapping[str, object] = field(default_factory=dict)

    def __call__(
        self, collocation: Collocation, watch: Watch | None = None, start: Array | None = None
    ) -> Solution:
        """Solve the NLP from `start`, by default from a simulation at the guess; `watch` is called
        with every entry of the history. See `Method`.
        """
        recorder = Recorder(self.name, collocation, watch=watch, max_time_s=self.max_time_s)
        plugin = self.name.removeprefix(PREFIX)
        with recorder.stopwatch.building():
            program = with_lifted_variables(collocation)
        return nlpsol.solve(
            recorder,
            program,
            start=start,
            plugin=plugin,
            hessian=hessian_values(program, self.hessian),
            settings=self._settings,
            statuses=self.statuses,
            judge=partial(_judge, collocation),
        )

    def _settings(self, functions: NlpFunctions) -> dict[str, Any]:
        """Return the options of the plugin with its cache of functions; options of the user
        (`casadi`) replace those of the method, and mappings are merged. The functions of the cache
        are new, and are added to `functions`.
        """
        plugin = self.name.removeprefix(PREFIX)
        settings = {**functions.derivatives(plugin), **self._plugin_settings()}
        for name, value in self.casadi.items():
            are_mappings = isinstance(value, Mapping) and isinstance(settings.get(name), Mapping)
            settings[name] = settings[name] | value if are_mappings else value
        return settings

    def _plugin_settings(self) -> dict[str, Any]:
        """Return the plugin's options that follow from the method's."""
        raise NotImplementedError


@validated
class SqpMethod(CasadiSolver):
    """Sequential quadratic programming (SQP) with convex quadratic programs."""

    name: ClassVar[str] = "casadi:sqpmethod"
    statuses: ClassVar[Mapping[str, Status]] = {
        "Solve_Succeeded": Status.CONVERGED,
        "Maximum_Iterations_Exceeded": Status.ITERATION_LIMIT,
        "Infeasible_Problem_Detected": Status.INFEASIBLE,
        "Search_Direction_Becomes_Too_Small": Status.STALLED,
        "User_Requested_Stop": Status.INTERRUPTED,
    }

    hessian: Hessian = "gauss-newton"

    def _plugin_settings(self) -> dict[str, Any]:
        """Return the tolerances and the limit of iterations, with PIQP as silent QP solver."""
        return {
            "qpsol": "piqp",
            "qpsol_options": {"error_on_fail": False},
            "tol_pr": self.tolerance,
            "tol_du": self.tolerance,
            "max_iter": self.max_iterations,
            "print_header": False,
            "print_iteration": False,
            "print_status": False,
        }


@validated
class Sleqp(CasadiSolver):
    """SLP-EQP in a trust region: steps of QPs with the active constraints of linear programs."""

    name: ClassVar[str] = "casadi:sleqp"
    statuses: ClassVar[Mapping[str, Status]] = {
        "optimal": Status.CONVERGED,
        "iteration limit": Status.ITERATION_LIMIT,
        "time limit": Status.TIME_LIMIT,
        "infeasible": Status.INFEASIBLE,
        "unbounded": Status.DIVERGED,
        "deadpoint": Status.STALLED,
        "manual abort": Status.INTERRUPTED,
    }

    def _plugin_settings(self) -> dict[str, Any]:
        """Return the tolerances and the limits of iterations and time, without printing."""
        return {
            "max_iter": self.max_iterations,
            "max_wall_time": self.max_time_s,
            "print_level": 0,
            "sleqp": {"feas_tol": self.tolerance, "stat_tol": self.tolerance},
        }


PLUGINS = {kind.name.removeprefix(PREFIX): kind for kind in (SqpMethod, Sleqp)}

_LIBRARY = "it needs a library, and usually a licence, that are not part of CasADi"
REFUSED: dict[str, str] = {
    "ipopt": 'IPOPT is available as the method "interior-point"',
    "alpaqa": "it derives an augmented Lagrangian from expressions, and the NLP has only callbacks",
    "blocksqp": "it derives its Hessian's structure from expressions, and the NLP has only "
    "callbacks; its QP solver needs MA27",
    "fatrop": "it uses dense factorisations unless the problem consists of stages, and continues "
    "although an evaluation failed or the user interrupted it",
    "feasiblesqpmethod": "its feasible start within bounds does not exist for this NLP",
    "qrsqp": "its QP solver cycles on this NLP",
    "scpgen": "it derives the NLP from expressions, and this one has only callbacks",
    "uno": "the plugin in CasADi's wheel corrupts memory on this NLP and aborts the process",
    "bonmin": 'without integers it is IPOPT, whose method is "interior-point"; its progress '
    "cannot be shown, and it cannot be interrupted",
    "ampl": "it starts an external AMPL solver, which does not support callbacks",
    **dict.fromkeys(("ccopt", "conopt", "knitro", "madnlp", "snopt", "worhp"), _LIBRARY),
}


def refusal_reason(name: str) -> str | None:
    """Return the reason why a solver of CasADi is not offered, with those that are.

    None for names that do not begin with "casadi:" and for solvers that are offered. For an unknown
    solver the reason contains the most similar name.
    """
    if not name.startswith(PREFIX) or name.removeprefix(PREFIX) in PLUGINS:
        return None
    plugin = name.removeprefix(PREFIX)
    offered = ", ".join(PREFIX + known for known in PLUGINS)
    if plugin in REFUSED:
        return f"found {name!r}, which is not offered: {REFUSED[plugin]}. Expected one of {offered}"
    close = difflib.get_close_matches(plugin, PLUGINS, n=1)
    hint = f"did you mean {PREFIX + close[0]!r}? " if close else ""
    return f"found {name!r}, which CasADi does not have; {hint}expected one of {offered}"


def _judge(collocation: Collocation, status: Status, z: Array, multipliers: Array) -> Status:
    """Return the status of a solution after a check of its constraints and optimality at z.

    A converged one that violates constraints by more than `FEASIBLE` is infeasible; one that
    stalled or failed numerically is acceptable if the optimality conditions hold within
    `ACCEPTABLE`; other statuses are returned unchanged.
    """
    if status.converged:
        violation = np.abs(collocation.constraint_values(z)).max(initial=0.0)
        return status if violation <= FEASIBLE else Status.INFEASIBLE
    is_stalled = status in (Status.STALLED, Status.NUMERICAL_FAILURE)
    if is_stalled and collocation.kkt_residual(z, multipliers) <= ACCEPTABLE:
        return Status.ACCEPTABLE
    return status
