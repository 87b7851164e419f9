"""Pictures of a run, one kind per module; each function takes arrays and returns a Figure.

Over time: `over_time` (markers, wrenches, custom sensors) and `spectrum`. In space: `shapes` (body
and
markers at several times), `mesh`, `field` (a spatially varying constant), `depth` (images of depth
cameras) and `instability` (a buckling mode). Statistics and method: `confidence`, `minimise` and
`jacobian`. `album` collects all pictures of a run and writes them; `camera` and `scene` draw bodies
in
space for the others.

Positions are in metres and drawn in millimetres; colours and type sizes are those of
`result.style`.
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
