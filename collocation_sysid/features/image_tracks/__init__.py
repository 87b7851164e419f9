"""Tracks of points in the images of ordinary cameras, as a measurement.

- `tracks`: `ImageTracks`, the pixels with their camera and what is uncertain about it.
- `track_residual`: the prediction y = π(T⁻¹ h(x)) and its residual.
- `tracked_places`: places of the points on the surface, and which points are visible.
- `rays`: intersections of rays with the surface, and poses of cameras from known points.
- `track_files`, `tracks_table`: files of trackers, and the table of a problem file.
- `track_feature`: likely errors, concerns and notes.
"""

from ...program.measurement_models import MODELS
from .track_residual import ImageTracksModel
from .tracks import ImageTracks as ImageTracks

MODELS[ImageTracks] = ImageTracksModel
