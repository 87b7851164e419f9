"""Outlines of the body in the images of ordinary cameras, as a measurement.

- `outlines`: `Outlines`, the masks with their camera.
- `residual`: distances of the outline of the body from the edges of the masks.
- `masks`, `table`: files of masks, and the table of a problem file.
- `feature`: likely errors and notes.
"""

from ...program.measurement_models import MODELS
from .outlines import Outlines as Outlines
from .residual import OutlinesModel

MODELS[Outlines] = OutlinesModel
