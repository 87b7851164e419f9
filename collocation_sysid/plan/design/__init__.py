"""Experiment design: motions of the gripper that make the uncertainty of the next recording small.

`designing` searches for the best motion (`design_motion`), `factorise_information` predicts the
uncertainty of a
motion, `motion` parametrises motions, `limits` describes what the robot may do, `minimise` is the
optimiser, and `folder` and `page` write and show the result.
"""

from .designing import Design, DesignOptions, design_motion
from .information import DesignCriterion
from .limits import Limits
from .motion import HandMotion

__all__ = ["Design", "DesignCriterion", "DesignOptions", "HandMotion", "Limits", "design_motion"]
