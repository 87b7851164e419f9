"""Parameters while the recording is being made."""

from .estimator import Estimator, LiveOptions, Update
from .frames import Frame, FrameReader
from .sources import collected_before

__all__ = ["Estimator", "Frame", "FrameReader", "LiveOptions", "Update", "collected_before"]
