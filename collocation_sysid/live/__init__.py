"""Parameters while the recording is being made."""

from .estimator import Estimator, LiveOptions, Update
from .frames import Frame, FrameReader

__all__ = ["Estimator", "Frame", "FrameReader", "LiveOptions", "Update"]
