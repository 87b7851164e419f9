"""Studies of many runs, model comparison, and design of the next recording.

Studies: `arguments` parses command-line arguments, `study` plans the runs, `process` executes them
(each in its own process, see `worker`) and stores their records, `topic_as_csv` converts records to
rows
of numbers, and `study_page` and `plots` present them. `progress` shows progress in the terminal.

Model comparison: `variants` derives models from a problem file, `choice` compares their
predictions, and `laws` evaluates how much an estimate depends on the model.

Experiment design: the package `design_motion` computes motions of a gripper that reduce the
uncertainty.
"""

from .process import RunOptions, RunStore, run_all
from .study import PlannedRun, Starts, plan_comparison, plan_models, plan_sweep

__all__ = [
    "PlannedRun",
    "RunOptions",
    "RunStore",
    "Starts",
    "plan_comparison",
    "plan_models",
    "plan_sweep",
    "run_all",
]
