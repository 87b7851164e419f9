"""Outlines of the body in the images of ordinary cameras, as a measurement.

- `outlines`: `Outlines`, the masks with their camera.
- `residual`: distances of the outline of the body from the edges of the masks.
- `masks`, `table`: files of masks, and the table of a problem file.
- `feature`: likely errors and notes.
"""

from __future__ import annotations

from ..kind import Kind, lazy


class OutlinesInImages(Kind):
    """Masks of the body in images."""

    name = "outlines"
    declares = "Outlines"
    table = lazy(".table", "OutlinesSection")
    model = lazy(".residual", "OutlinesModel")
    notes = lazy(".notes", "notes")


KIND = OutlinesInImages()
