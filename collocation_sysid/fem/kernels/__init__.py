"""Evaluate an element kernel over [timestep × element]: two evaluators, one interface.

An `EvaluatorChoice` takes the SIMD evaluator where llvmlite can be imported and knows all of a
material's operations, and CasADi's ``Function.map`` otherwise; ``COLLOCATION_SYSID_EVALUATOR`` or
the argument forces either.
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import TYPE_CHECKING

from .batch import Batch, Evaluator, VectorCodeError
from .choice import EVALUATORS, EvaluatorChoice, choose_evaluator, make_evaluator
from .combine import Combiner, Plan, combine_natively, combine_with_numpy
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
    "VectorCodeError",
    "alone",
    "at_once",
    "available_threads",
    "choose_evaluator",
    "in_slices",
    "make_combiner",
    "make_evaluator",
    "make_skyline",
    "side_by_side",
]


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
