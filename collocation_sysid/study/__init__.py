"""Many runs side by side: methods and starts compared, keys of the problem file swept."""

from .plan import PlannedRun, plan_comparison, plan_models, plan_sweep
from .scheduler import Limits, run_all
from .store import RunStore

__all__ = [
    "Limits",
    "PlannedRun",
    "RunStore",
    "plan_comparison",
    "plan_models",
    "plan_sweep",
    "run_all",
]
