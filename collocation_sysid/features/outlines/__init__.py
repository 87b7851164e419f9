"""Outlines of the body in the images of ordinary cameras, as a measurement.

- `outlines`: `Outlines`, the masks with their camera.
- `outline_residual`: distances of the outline of the body from the edges of the masks.
- `masks`, `outlines_table`: files of masks, and the table of a problem file.
- `outline_feature`: likely errors and notes.
"""

from ...program.measurement_models import MODELS
from .outline_residual import OutlinesModel
from .outlines import Outlines as Outlines

MODELS[Outlines] = OutlinesModel
