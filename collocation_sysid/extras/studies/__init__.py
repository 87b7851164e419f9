"""Studies of many runs, and comparison of models.

Studies: `arguments` parses command-line arguments,
`planning` plans the runs, `run_execution` executes them (each in its own process, see
`run_worker`), `rows` converts records to rows of numbers, and `tables`
and `plots` present them. `progress` shows progress in the terminal.

Model comparison: `model_variants` derives models from a problem file, `model_choice` compares their
predictions, and `model_comparison` does so in Python.
"""

from .planning import PlannedRun, Starts, plan_comparison, plan_models
from .run_execution import RunOptions, run_all

__all__ = ["PlannedRun", "RunOptions", "Starts", "plan_comparison", "plan_models", "run_all"]
