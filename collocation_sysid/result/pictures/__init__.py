"""Pictures of a run, one kind a module; each a function of plain arrays that returns a Figure.

Positions are in metres, drawn in millimetres; names and sizes of type are of `result.style`.
"""

from .album import album, save_pictures
from .confidence import Confidence, confidence_ellipses, correlation_matrix
from .convergence import convergence
from .elements import elements_picture
from .errors import error_over_time
from .jacobian import jacobian_sparsity
from .mesh import mesh_picture
from .scan import scan_picture
from .shapes import shapes
from .spectrum import spectrum
from .tracks import tracks

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
