"""Live estimation: parameters after each frame, while the recording is being made.

Use `LiveEstimator`: `LiveEstimator.update` takes one frame and returns estimates and verdict, and
`LiveEstimator.finish` gives the final result. See docs/howto/live.md.

- `estimator`: the estimator, its options and its output.
- `frames`: frames as Python values, JSON lines or rows of a table; `sources`: streams of frames.
- `frame_buffer`: buffer that turns frames into time steps with interpolated poses; `initial_rest`:
  the end of a rest before the motion.
- `model`: the model of a problem's recording, and the batch solution at the end;
  `window_pass`: the window of recent time steps, with its information and prior. Time marching with
  sensitivities is `program.streaming`.
- `time_budget`: computing time per frame; `stiffness_search`: initial values without a guess.
- `trust`: verdict of a live estimate; `display`: terminal and film; `recording`: file
  for the Rerun viewer.
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
