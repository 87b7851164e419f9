"""Planned motions: the hand moves so that points of the identified body follow references.

`task` reads what is wanted, `planned_body` the body and its constants, `spline_motion` describes
the hand and its limits, `planned_program` the optimal-control problem, `reduced_solver` and
`full_program` solve it, `motion_plan` has the function `plan_motion`, and `folder` and
`pictures` write the result.
"""

from .motion_plan import MotionPlan, plan_motion
from .task import Task

__all__ = ["MotionPlan", "Task", "plan_motion"]
