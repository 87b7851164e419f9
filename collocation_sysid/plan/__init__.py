"""Many runs side by side: methods and starts compared, keys of the problem file swept."""

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
