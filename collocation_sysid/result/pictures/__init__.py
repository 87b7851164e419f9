"""Pictures of a run, one kind a module; each a function of plain arrays that returns a Figure.

Positions are in metres, drawn in millimetres; names and sizes of type are of `result.style`.
"""

from .album import album, save_pictures
from .confidence import Confidence, confidence_ellipses, correlation_matrix
from .jacobian import jacobian_sparsity
from .mesh import elements_picture, mesh_picture
from .over_time import error_over_time, tracks
from .search import convergence, scan_picture
from .shapes import shapes
from .spectrum import spectrum

__all__ = [
    "Confidence",
    "album",
    "confidence_ellipses",
    "convergence",
    "correlation_matrix",
    "elements_picture",
    "error_over_time",
    "jacobian_sparsity",
    "mesh_picture",
    "save_pictures",
    "scan_picture",
    "shapes",
    "spectrum",
    "tracks",
]
