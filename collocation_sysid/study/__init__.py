"""Many runs side by side: methods and starts compared, keys of the problem file swept."""

from .plan import PlannedRun, Starts, plan_comparison, plan_models, plan_sweep
from .scheduler import Limits, run_all
from .store import RunStore

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
