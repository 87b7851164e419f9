"""Evaluation of element kernels over [time step × element]: two evaluators with one interface.

- `batch`: what is evaluated, the interface, and the reference evaluator, CasADi's ``Function.map``.
- `simd`: the fast evaluator, vector code compiled by LLVM; `instructions`: CasADi operations in
  LLVM.
- `jit`: compilation to native code, cached on disk.
- `instances`: functions of a few numbers at many instances.
- `combine`: linear combinations of rows into sparse values; `skyline`: factorisation of bands.
- `threads`: distribution of time steps and experiments over threads.

`EvaluatorChoice` selects the SIMD evaluator if llvmlite can be imported and supports all operations
of a material, otherwise CasADi's; the environment variable ``COLLOCATION_SYSID_EVALUATOR`` or the
argument forces one.

Kernels that are not in the cache are compiled at once, however small the body; for a body of fewer
than `simd.OPTIMISED_FROM_POINTS` quadrature points without optimisation: the kernels of 48
elements, with second derivatives, then take LLVM 0.5 s of processor time instead of 2.5 s. For
larger bodies optimisation is worthwhile: 1,296 elements at 20 states are linearised in 9 ms instead
of 16 ms.
"""

from __future__ import annotations

import os
from contextlib import suppress
from importlib.util import find_spec
from typing import TYPE_CHECKING

import casadi as ca

from ...errors import InputError
from .batch import CasadiEvaluator, Evaluator, KernelBatch, VectorCodeError
from .combine import CombinationPlan, Combiner, combine_with_numpy, compile_combiner
from .instances import Instances, compile_instance_evaluator, make_casadi_instance_evaluator
from .threads import (
    COMPILING,
    available_threads,
    concurrent_count,
    map_experiments,
    run_in_slices,
    run_single_threaded,
)

if TYPE_CHECKING:
    from ...common.array_types import Index
    from .skyline import SkylineFactorisation

__all__ = [
    "COMPILING",
    "EVALUATORS",
    "Evaluator",
    "EvaluatorChoice",
    "Instances",
    "KernelBatch",
    "VectorCodeError",
    "available_threads",
    "choose_evaluator",
    "concurrent_count",
    "make_combiner",
    "make_evaluator",
    "make_instance_evaluator",
    "make_skyline",
    "map_experiments",
    "run_in_slices",
    "run_single_threaded",
]


EVALUATORS = ("auto", "simd", "casadi")


def choose_evaluator(choice: str = "auto") -> str:
    """Return the evaluator to use, "simd" or "casadi".

    Parameters
    ----------
    choice : {"auto", "simd", "casadi"}
        "auto" uses the environment variable ``COLLOCATION_SYSID_EVALUATOR`` if it is set, otherwise
        "simd" if llvmlite is installed.

    Raises
    ------
    InputError
        For an unknown choice, or "simd" without llvmlite.
    """
    choice = _requested_evaluator(choice)
    has_llvm = find_spec("llvmlite") is not None
    if choice == "simd" and not has_llvm:
        raise InputError("evaluator 'simd' needs llvmlite: pip install llvmlite, or use 'casadi'")
    return "casadi" if choice == "casadi" or not has_llvm else "simd"


def _requested_evaluator(choice: str) -> str:
    """Return the choice; for "auto" that of the environment variable, if it is set."""
    origin = "evaluator"
    if choice == "auto":
        variable = "COLLOCATION_SYSID_EVALUATOR"
        choice = os.environ.get(variable, "auto")
        origin = f"the environment variable {variable}"
    if choice not in EVALUATORS:
        raise InputError(f"{origin} is {choice!r}; expected one of {', '.join(EVALUATORS)}")
    return choice


def make_evaluator(batch: KernelBatch, name: str) -> Evaluator:
    """Build the evaluator of a batch.

    Parameters
    ----------
    name : {"simd", "casadi"}

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
        raise VectorCodeError(
            f"LLVM cannot compile the {kernel} function of the material ({error})"
        ) from error


class EvaluatorChoice:
    """Choice of an evaluator that falls back to CasADi's unless "simd" was requested by name.

    Parameters
    ----------
    choice : {"auto", "simd", "casadi"}
        See `choose_evaluator`.

    Attributes
    ----------
    name : "simd" or "casadi"
        Evaluator in use; changes to "casadi" on a fallback.
    notes : tuple of str
        Reasons of a fallback.

    Raises
    ------
    InputError
        See `choose_evaluator`.
    """

    def __init__(self, choice: str = "auto") -> None:
        self.name = choose_evaluator(choice)
        self.notes: tuple[str, ...] = ()
        self._may_yield = _requested_evaluator(choice) == "auto"

    def check(self, function: ca.Function) -> None:
        """Check, without compiling, whether the evaluator supports all operations of a function.

        If not, fall back to CasADi's evaluator: `name` and `notes` change. CasADi's evaluator
        supports all.

        Raises
        ------
        VectorCodeError
            If an operation is not supported and "simd" was requested by name.
        """
        if self.name == "casadi":
            return
        from .instructions import require_supported_operations

        try:
            require_supported_operations(function)
        except VectorCodeError as error:
            self._fall_back_to_casadi(error)

    def make_evaluator(self, batch: KernelBatch) -> Evaluator:
        """Build the evaluator of a batch; fall back to CasADi's if the kernel cannot be compiled.

        Raises
        ------
        VectorCodeError
            If the kernel cannot be compiled and "simd" was requested by name.
        """
        try:
            return make_evaluator(batch, self.name)
        except VectorCodeError as error:
            self._fall_back_to_casadi(error)
            return make_evaluator(batch, self.name)

    def _fall_back_to_casadi(self, error: VectorCodeError) -> None:
        """Change to CasADi with a note; raise the error if "simd" was requested."""
        if not self._may_yield:
            message = f"{error.message}; choose evaluator = 'casadi' for this material"
            raise VectorCodeError(message) from error
        self.name = "casadi"
        self.notes += (
            f"The material is evaluated by CasADi's map, which is much slower: {error.message}.",
        )


def make_instance_evaluator(function: ca.Function, compiled: bool) -> Instances:
    """Return an evaluator of a function at many instances, see `instances`.

    Parameters
    ----------
    function : casadi.Function
        Function of dense inputs.
    compiled : bool
        Whether to compile the function; CasADi's evaluator is used, without a note, where that is
        not possible, or "casadi" is chosen by the environment variable.
    """
    if compiled and choose_evaluator() == "simd":
        # What llvmlite raises where it cannot compile, and what there is no instruction for.
        with suppress(RuntimeError, VectorCodeError):
            return compile_instance_evaluator(function)
    return make_casadi_instance_evaluator(function)


def make_combiner(plan: CombinationPlan) -> Combiner:
    """Return the loop that fills sparse values according to a plan, compiled if llvmlite can, else
    in NumPy; see `combine.combine_with_numpy` for its arguments.
    """
    if find_spec("llvmlite"):
        try:
            return compile_combiner(plan)
        except RuntimeError:  # what llvmlite raises where it cannot compile
            pass
    return combine_with_numpy(plan)


def make_skyline(
    size: int, rows: Index, columns: Index, source: Index
) -> SkylineFactorisation | None:
    """Return the compiled factorisation of a skyline; None if llvmlite cannot compile it.

    Parameters
    ----------
    size : int
        Number of rows.
    rows, columns, source : (e,) int
        See `skyline.SkylineFactorisation`.
    """
    if not find_spec("llvmlite"):
        return None
    from .skyline import SkylineFactorisation

    try:
        return SkylineFactorisation(size, rows, columns=columns, source=source)
    except RuntimeError:
        return None
