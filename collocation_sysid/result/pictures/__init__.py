"""Pictures of a run, one kind per module; each function takes arrays and returns a Figure.

Over time: `over_time` (markers and their spectrum, sensors). In space: `shapes` (body
and markers at several times), `meshes`, `field_intervals` (a spatially varying constant),
`cameras` (images of cameras) and `instability` (a buckling mode). Of
specimens: `stress_strain`. Statistics and method: `confidence`, `search` (with the structure of
the program). `album` collects all pictures of a run and writes them; `scene` draws bodies in space
for the others.

Positions are in metres and drawn in millimetres; colours and type sizes are those of
`result.figure_style`.
"""

from .album import all_pictures, save_pictures
from .confidence import Confidence, confidence_ellipses, correlation_matrix
from .meshes import elements_picture, mesh_picture
from .over_time import marker_errors, marker_tracks, spectrum_picture
from .search import convergence, jacobian_sparsity, scan_picture
from .shapes import shapes_picture

__all__ = [
    "Confidence",
    "all_pictures",
    "confidence_ellipses",
    "convergence",
    "correlation_matrix",
    "elements_picture",
    "jacobian_sparsity",
    "marker_errors",
    "marker_tracks",
    "mesh_picture",
    "save_pictures",
    "scan_picture",
    "shapes_picture",
    "spectrum_picture",
]
