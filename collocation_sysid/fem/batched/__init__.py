"""Evaluate an element kernel over [timestep × element]: two evaluators, one interface.

``make_evaluator(batch)`` takes the SIMD evaluator where llvmlite can be imported and CasADi's
``Function.map`` otherwise; ``COLLOCATION_SYSID_EVALUATOR`` or the argument forces either.
"""

from __future__ import annotations

import os
from importlib.util import find_spec

from ...errors import InputError
from .batch import Batch, Evaluator
from .combine import Combiner, Plan, combine_natively, combine_with_numpy
from .threads import available_threads, in_slices

EVALUATORS = ("auto", "simd", "casadi")

__all__ = [
    "EVALUATORS",
    "Batch",
    "Evaluator",
    "available_threads",
    "choose_evaluator",
    "in_slices",
    "make_combiner",
    "make_evaluator",
]


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
    if choice == "auto":
        choice = os.environ.get("COLLOCATION_SYSID_EVALUATOR", "auto")
    if choice not in EVALUATORS:
        raise InputError(f"no evaluator {choice!r}; available: {', '.join(EVALUATORS)}")
    has_llvm = find_spec("llvmlite") is not None
    if choice == "simd" and not has_llvm:
        raise InputError("evaluator 'simd' needs llvmlite: pip install llvmlite, or use 'casadi'")
    return "casadi" if choice == "casadi" or not has_llvm else "simd"


def make_evaluator(batch: Batch, choice: str = "auto") -> Evaluator:
    """Build the evaluator of a batch, see `choose_evaluator`."""
    if choose_evaluator(choice) == "casadi":
        from .casadi_map import CasadiEvaluator

        return CasadiEvaluator(batch)
    from .simd import SimdEvaluator

    return SimdEvaluator(batch)


def make_combiner(plan: Plan) -> Combiner:
    """The loop that fills sparse values from a plan, compiled where llvmlite is there."""
    return combine_natively(plan) if find_spec("llvmlite") else combine_with_numpy(plan)
