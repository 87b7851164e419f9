"""Evaluate an element kernel over [timestep × element]: two evaluators, one interface.

An `EvaluatorChoice` takes the SIMD evaluator where llvmlite can be imported and knows all of a
material's operations, and CasADi's ``Function.map`` otherwise; ``COLLOCATION_SYSID_EVALUATOR`` or
the argument forces either.

What is not in the cache is compiled at once, however small the body; of a body of fewer than
`simd.REPAID` quadrature points as it is written: the kernels of 48 elements, with their curvature,
then take LLVM 0.5 s of processor time in place of 2.5 s. Of a larger body optimising repays itself:
1,296 elements at 20 states are linearised in 9 ms in place of 16 ms.
"""

from __future__ import annotations

import os
from contextlib import suppress
from importlib.util import find_spec
from typing import TYPE_CHECKING

import casadi as ca

from ...errors import InputError
from .batch import Batch, CasadiEvaluator, Evaluator, VectorCodeError
from .combine import Combiner, Plan, combine_natively, combine_with_numpy
from .instances import Instances, instances_by_casadi, instances_natively
from .threads import COMPILING, alone, at_once, available_threads, in_slices, side_by_side

if TYPE_CHECKING:
    from ...arrays import Index
    from .skyline import Skyline

__all__ = [
    "COMPILING",
    "EVALUATORS",
    "Batch",
    "Evaluator",
    "EvaluatorChoice",
    "Instances",
    "VectorCodeError",
    "alone",
    "at_once",
    "available_threads",
    "choose_evaluator",
    "in_slices",
    "make_combiner",
    "make_evaluator",
    "make_instances",
    "make_skyline",
    "side_by_side",
]


EVALUATORS = ("auto", "simd", "casadi")


def choose_evaluator(choice: str = "auto") -> str:
    """Settle on "simd" or "casadi".

    Parameters
    ----------
    choice : {"auto", "simd", "casadi"}
        "auto" yields to the environment variable ``COLLOCATION_SYSID_EVALUATOR``.

    Raises
    ------
    InputError
        For an unknown choice, or "simd" without llvmlite.
    """
    choice = _asked_for(choice)
    has_llvm = find_spec("llvmlite") is not None
    if choice == "simd" and not has_llvm:
        raise InputError("evaluator 'simd' needs llvmlite: pip install llvmlite, or use 'casadi'")
    return "casadi" if choice == "casadi" or not has_llvm else "simd"


def _asked_for(choice: str) -> str:
    if choice == "auto":
        choice = os.environ.get("COLLOCATION_SYSID_EVALUATOR", "auto")
    if choice not in EVALUATORS:
        raise InputError(f"no evaluator {choice!r}; available: {', '.join(EVALUATORS)}")
    return choice


def make_evaluator(batch: Batch, name: str) -> Evaluator:
    """Build a batch's evaluator, "simd" or "casadi".

    Raises
    ------
    VectorCodeError
        For "simd", if the kernel cannot be compiled.
    """
    if name == "casadi":
        return CasadiEvaluator(batch)
    from .simd import SimdEvaluator

    try:
        return SimdEvaluator(batch)
    except RuntimeError as error:  # what llvmlite raises
        kernel = batch.kernel.pieces.name()
        raise VectorCodeError(f"LLVM cannot compile the {kernel} kernel ({error})") from error


class EvaluatorChoice:
    """An evaluator by name, which yields to CasADi's map unless it was asked for.

    Parameters
    ----------
    choice : {"auto", "simd", "casadi"}
        See `choose_evaluator`.

    Attributes
    ----------
    name : "simd" or "casadi"
    notes : tuple of str
        Why vector code had to yield, if it had.
    """

    def __init__(self, choice: str = "auto") -> None:
        self.name = choose_evaluator(choice)
        self.notes: tuple[str, ...] = ()
        self._may_yield = _asked_for(choice) == "auto"

    def check(self, function: ca.Function) -> None:
        """Find out, without compiling it, whether the evaluator has a function's operations.

        Raises
        ------
        VectorCodeError
            If it has not, and was asked for by name.
        """
        if self.name == "casadi":
            return
        from .instructions import check_operations

        try:
            check_operations(function)
        except VectorCodeError as error:
            self._yield_to_casadi(error)

    def make(self, batch: Batch) -> Evaluator:
        """Build a batch's evaluator.

        Raises
        ------
        VectorCodeError
            If the kernel cannot be compiled, and vector code was asked for by name.
        """
        try:
            return make_evaluator(batch, self.name)
        except VectorCodeError as error:
            self._yield_to_casadi(error)
            return make_evaluator(batch, self.name)

    def _yield_to_casadi(self, error: VectorCodeError) -> None:
        if not self._may_yield:
            message = f"{error.message}; choose evaluator='casadi' for this material"
            raise VectorCodeError(message) from error
        self.name = "casadi"
        self.notes += (
            f"The material is evaluated by CasADi's map, which is many times slower: "
            f"{error.message}.",
        )


def make_instances(function: ca.Function, compiled: bool) -> Instances:
    """A function at many instances, compiled where that is asked for and can be."""
    if compiled and choose_evaluator() == "simd":
        # What llvmlite raises where it cannot compile, and what there is no instruction for.
        with suppress(RuntimeError, VectorCodeError):
            return instances_natively(function)
    return instances_by_casadi(function)


def make_combiner(plan: Plan) -> Combiner:
    """The loop that fills sparse values from a plan, compiled where llvmlite can."""
    if find_spec("llvmlite"):
        try:
            return combine_natively(plan)
        except RuntimeError:  # what llvmlite raises where it cannot compile
            pass
    return combine_with_numpy(plan)


def make_skyline(size: int, rows: Index, columns: Index, source: Index) -> Skyline | None:
    """The compiled factorisation of a skyline, where llvmlite can."""
    if not find_spec("llvmlite"):
        return None
    from .skyline import Skyline

    try:
        return Skyline(size, rows, columns, source)
    except RuntimeError:
        return None
