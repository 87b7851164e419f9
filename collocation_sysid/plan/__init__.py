"""Many runs side by side: methods and starts compared, keys of the problem file swept."""

from .scheduler import Limits, run_all
from .store import RunStore
from .study import PlannedRun, Starts, plan_comparison, plan_models, plan_sweep

__all__ = [
    "Limits",
    "PlannedRun",
    "RunStore",
    "Starts",
    "plan_comparison",
    "plan_models",
    "plan_sweep",
    "run_all",
]
