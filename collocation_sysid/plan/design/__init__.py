"""Motions of the grasp that make the error bars of the next recording small."""

from .designing import Design, DesignOptions, design
from .information import Criterion
from .limits import Limits
from .motion import HandMotion

__all__ = ["Criterion", "Design", "DesignOptions", "HandMotion", "Limits", "design"]
