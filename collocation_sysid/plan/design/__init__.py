"""Experiment design: motions of the gripper that make the uncertainty of the next recording small.

`designing` searches for the best motion (`design`), `information` predicts the uncertainty of a
motion, `motion` parametrises motions, `limits` describes what the robot may do, `search` is the
optimiser, and `folder` and `page` write and show the result.
"""

from .designing import Design, DesignOptions, design
from .information import Criterion
from .limits import Limits
from .motion import HandMotion

__all__ = ["Criterion", "Design", "DesignOptions", "HandMotion", "Limits", "design"]
