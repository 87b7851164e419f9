"""Live estimation: parameters after each frame, while the recording is being made.

Use `Estimator`: `Estimator.update` takes one frame and returns estimates and verdict, and
`Estimator.settle` gives the final result. See docs/howto/live.md.

- `estimator`: the estimator, its options and its output.
- `frames`: frames as Python values, JSON lines or rows of a table; `sources`: streams of frames.
- `intake`: buffer that turns frames into time steps with interpolated poses.
- `model`: the problem, prepared for streaming; `sweep`: time marching with sensitivities;
  `track`: the window of recent time steps, with its information and prior.
- `felt`: reaction forces of grasps with a sensor.
- `budget`: computing time per frame; `search`: initial values without a guess.
- `trust`: verdict of a live estimate; `whole`: batch solution at the end; `view`: terminal and
film.
"""

from .estimator import Estimator, LiveOptions, Update
from .frames import Frame, FrameReader
from .sources import collected_before

__all__ = ["Estimator", "Frame", "FrameReader", "LiveOptions", "Update", "collected_before"]
