"""Studies of many runs, and comparison of models.

Studies: `arguments` parses command-line arguments,
`planning` plans the runs, `run_execution` executes them (each in its own process, see
`run_worker`) and stores their records, `rows` converts records to rows of numbers, and `tables`
and `plots` present them. `progress` shows progress in the terminal.

Model comparison: `model_variants` derives models from a problem file, `model_choice` compares their
predictions, `model_comparison` does so in Python, and `law_disagreements` evaluates how much an
estimate depends on the model.
"""

from .planning import PlannedRun, Starts, plan_comparison, plan_models
from .run_execution import RunOptions, RunStore, run_all

__all__ = [
    "PlannedRun",
    "RunOptions",
    "RunStore",
    "Starts",
    "plan_comparison",
    "plan_models",
    "run_all",
]
