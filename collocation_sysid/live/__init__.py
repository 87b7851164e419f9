"""Live estimation: parameters after each frame, while the recording is being made.

Use `LiveEstimator`: `LiveEstimator.update` takes one frame and returns estimates and verdict, and
`LiveEstimator.finish` gives the final result. See docs/howto/live.md.

- `estimator`: the estimator, its options and its output.
- `frames`: frames as Python values, JSON lines or rows of a table; `sources`: streams of frames.
- `intake`: buffer that turns frames into time steps with interpolated poses.
- `model`: the problem, prepared for streaming; `sweep`: time marching with sensitivities;
  `track`: the window of recent time steps, with its information and prior.
- `felt`: reaction forces of grasps with a sensor.
- `budget`: computing time per frame; `minimise`: initial values without a guess.
- `trust`: verdict of a live estimate; `full_matrix`: batch solution at the end; `view`: terminal
  and
film.
"""

from .estimator import LiveEstimator, LiveOptions, LiveUpdate
from .frames import Frame, FrameReader
from .sources import without_garbage_of_startup

__all__ = [
    "Frame",
    "FrameReader",
    "LiveEstimator",
    "LiveOptions",
    "LiveUpdate",
    "without_garbage_of_startup",
]
