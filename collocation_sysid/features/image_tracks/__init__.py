"""Tracks of points in the images of ordinary cameras, as a measurement.

- `tracks`: `ImageTracks`, the pixels with their camera and what is uncertain about it.
- `residual`: the prediction y = π(T⁻¹ h(x)) and its residual.
- `places`: places of the points on the surface, and which points are visible.
- `rays`: intersections of rays with the surface, and poses of cameras from known points.
- `files`, `table`: files of trackers, and the table of a problem file.
- `feature`: likely errors, concerns and notes.
"""

from ...program.measurement_models import MODELS
from .residual import ImageTracksModel
from .tracks import ImageTracks as ImageTracks

MODELS[ImageTracks] = ImageTracksModel
