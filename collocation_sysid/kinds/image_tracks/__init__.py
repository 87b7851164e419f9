"""Tracks of points in the images of ordinary cameras, as a measurement.

- `tracks`: `ImageTracks`, the pixels with their camera and what is uncertain about it.
- `residual`: the prediction y = π(T⁻¹ h(x)) and its residual.
- `places`: places of the points on the surface, and which points are visible.
- `rays`: intersections of rays with the surface, and poses of cameras from known points.
- `files`, `table`: files of trackers, and the table of a problem file.
- `feature`: likely errors, concerns and notes.
"""

from __future__ import annotations

from ..kind import Kind, lazy


class TracksInImages(Kind):
    """Pixels of points of the body."""

    name = "image_tracks"
    declares = "ImageTracks"
    table = lazy(".table", "ImageTracksSection")
    model = lazy(".residual", "ImageTracksModel")
    notes = lazy(".notes", "notes")
    described = lazy(".stated_cameras", "hypotheses")
    fitted = lazy(".doubts", "fit_hypotheses")


KIND = TracksInImages()
