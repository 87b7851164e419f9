"""Experiment design: motions of the gripper that make the uncertainty of the next recording small.

`motion` searches for the best motion (function `design_motion`), `predicted_information`
predicts the uncertainty of a motion, `hand_motion` parametrises motions, `hand_limits` describes
what the robot may do, `evolution_search` is the optimiser, and `folder` and `page`
write and show the result.
"""

from .hand_limits import Limits
from .hand_motion import HandMotion
from .motion import Design, DesignOptions, design_motion
from .predicted_information import DesignCriterion

__all__ = ["Design", "DesignCriterion", "DesignOptions", "HandMotion", "Limits", "design_motion"]
