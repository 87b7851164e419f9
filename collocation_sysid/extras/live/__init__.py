"""Live estimation: the parameters while the recording is being made.

`LiveEstimator` collects frames; `LiveEstimator.solve` solves the recording so far, and
`LiveEstimator.finish` gives the final result. See docs/howto/live.md.

- `frames`: frames as Python values, JSON lines or rows of a table.
- `estimator`: the estimator and its answers.
- `sources`: streams of frames, and updates as text.
"""

from .estimator import LiveEstimator, LiveUpdate
from .frames import Frame, FrameReader

__all__ = ["Frame", "FrameReader", "LiveEstimator", "LiveUpdate"]
