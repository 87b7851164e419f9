"""Making meshes: a closed surface filled by fTetWild, structured boxes and cylinders."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import tempfile
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from ..errors import InputError
from .mesh import TetMesh, cell_counts, length_in_metres, orient, read_meshio

# fTetWild stops as soon as its elements are well shaped, however small they are. Coarsening
# afterwards merges edges up to about the length it is asked for, which leaves a mean about a
# quarter above it; and only edges that a straight one may replace within the tolerance.
ASKED_LENGTH = 0.8
TOLERANCE = 0.02
_RECIPE = f"coarsen, length {ASKED_LENGTH}, tolerance {TOLERANCE}"

MOST_ELEMENTS = 2_000_000

# A process of its own: fTetWild leaves a file in its working directory and cannot be interrupted.
_WORKER = """
import sys, numpy, pytetwild
surface = numpy.load("surface.npz")
points, tetrahedra = pytetwild.tetrahedralize(
    surface["points_m"], surface["triangles"], edge_length_abs=float(sys.argv[1]),
    epsilon=float(sys.argv[2]), coarsen=True, vtk_ordering=True, quiet=True,
)
numpy.savez("mesh.npz", points_m=points, tetrahedra=tetrahedra)
"""


def mesh_surface_file(
    path: str | Path,
    edge_length_m: float,
    length_unit: str = "m",
    cache_dir: str | Path | None = None,
) -> TetMesh:
    """Tetrahedralise the closed surface in an STL, OBJ or PLY file.

    Parameters
    ----------
    path : str or Path
    edge_length_m : float
        Wanted edge length in metres, whatever the file's unit; see `tetrahedralize_surface`.
    length_unit : {"m", "cm", "mm", "um", "in"}
        The unit of the file's coordinates.
    cache_dir : str or Path, optional
        See `tetrahedralize_surface`.

    Raises
    ------
    InputError
        If the file cannot be read or its surface is refused.
    """
    metres = length_in_metres(length_unit)
    points, triangles = read_surface(path)
    try:
        return tetrahedralize_surface(points * metres, triangles, edge_length_m, cache_dir)
    except InputError as error:
        raise error.located(path) from error.__cause__


def tetrahedralize_surface(
    points_m: ArrayLike,
    triangles: ArrayLike,
    edge_length_m: float,
    cache_dir: str | Path | None = None,
) -> TetMesh:
    """Fill a closed surface with tetrahedra by fTetWild (package pytetwild).

    fTetWild keeps neither the surface's vertices nor its triangles: the new surface stays within
    2 % of `edge_length_m` of the old one, which takes shorter edges where that is curved. So give
    a selection by coordinates that margin. fTetWild is not deterministic either: keep the mesh, by
    `cache_dir` or `TetMesh.write`, to repeat a result.

    Parameters
    ----------
    points_m : (p, 3) array
        Vertices in metres; those that coincide are merged.
    triangles : (F, 3) integer array
        Vertices of each triangle, counted from 0, in any orientation.
    edge_length_m : float
        Wanted edge length; the mean comes out within some tens of percent of it.
    cache_dir : str or Path, optional
        Folder that keeps the mesh as .vtu under a hash of the surface, the edge length and the
        version of pytetwild. A mesh found there is returned instead of a new one.

    Raises
    ------
    InputError
        If the surface is not closed, the edge length does not suit it, or pytetwild is missing.
    """
    points, faces = merge_coincident(*_checked_surface(points_m, triangles))
    _refuse_open(faces)
    _refuse_edge_length(points, faces, edge_length_m)
    mesher = _pytetwild_version()
    if cache_dir is None:
        return TetMesh(*_run_ftetwild(points, faces, edge_length_m))
    digest = hashlib.sha256(f"{mesher} {_RECIPE} {float(edge_length_m)!r} {points.shape}".encode())
    digest.update(points.astype("<f8").tobytes() + faces.astype("<i8").tobytes())
    cached = Path(cache_dir) / f"mesh-{digest.hexdigest()[:16]}.vtu"
    if not cached.exists():
        try:
            cached.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"the folder to keep meshes in cannot be made ({error})") from error
        mesh = TetMesh(*_run_ftetwild(points, faces, edge_length_m))
        unfinished = cached.with_name(f"{cached.stem}.{os.getpid()}.vtu")
        mesh.write(unfinished)
        unfinished.replace(cached)
    return TetMesh.read(cached)


def read_surface(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Read the vertices (p, 3), in the file's unit, and triangles (F, 3) of a surface file.

    Quadrilaterals and polygons are split into triangles.
    """
    data = read_meshio(path)
    fans = [
        _fan(np.asarray(block.data, dtype=np.int64))
        for block in data.cells
        if block.type in ("triangle", "quad", "polygon") and len(block.data)
    ]
    if not fans:
        found = ", ".join(f"{count} {name}" for name, count in cell_counts(data).items())
        raise InputError(f"no triangles in this file, found {found or 'no cells at all'}", path)
    # An OBJ vertex may carry a colour after its coordinates.
    return np.asarray(data.points, dtype=float)[:, :3], np.concatenate(fans)


def merge_coincident(points: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Merge vertices that coincide up to single precision, and drop triangles this flattens."""
    tolerance = 1e-6 * np.linalg.norm(np.ptp(points, axis=0))
    pairs = KDTree(points).query_pairs(tolerance, output_type="ndarray")
    links = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(points), len(points)))
    label = connected_components(links, directed=False)[1]
    _, first = np.unique(label, return_index=True)
    merged = label[triangles].astype(np.int64)
    flat = (merged == np.roll(merged, 1, axis=1)).any(axis=1)
    return points[first], merged[~flat]


def box_mesh(
    size_m: ArrayLike, divisions: ArrayLike, origin_m: ArrayLike = (0.0, 0.0, 0.0)
) -> TetMesh:
    """Mesh a box: each of its cells is split into the six tetrahedra around its main diagonal.

    Parameters
    ----------
    size_m : three numbers
        Lengths along x, y and z.
    divisions : three integers
        Cells along x, y and z.
    origin_m : three numbers
        The corner with the lowest coordinates.

    Returns
    -------
    TetMesh
        Nodes ordered with z fastest, then y, then x.
    """
    size, origin = np.asarray(size_m, dtype=float), np.asarray(origin_m, dtype=float)
    cells = np.asarray(divisions)
    if size.shape != (3,) or origin.shape != (3,) or not (size > 0).all():
        raise InputError(f"a box needs three positive lengths in metres, not {size_m!r}")
    if cells.shape != (3,) or cells.dtype.kind not in "iu" or not (cells > 0).all():
        raise InputError(f"a box needs three positive whole divisions, not {divisions!r}")
    ticks = [np.linspace(0, 1, n + 1) for n in cells]
    points = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 3) * size + origin

    stride = np.array([(cells[1] + 1) * (cells[2] + 1), cells[2] + 1, 1])
    corner = np.stack(np.meshgrid(*map(np.arange, cells), indexing="ij"), axis=-1) @ stride
    # A path along the cell's edges from its lowest to its highest corner, for each order of axes.
    orders = [(0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)]
    paths = np.array([[0, *np.cumsum(stride[list(order)])] for order in orders])
    tetrahedra = (corner.reshape(-1, 1, 1) + paths).reshape(-1, 4)
    return TetMesh(points, orient(points, tetrahedra)[0])


def cylinder_mesh(radius_m: float, height_m: float, rings: int, layers: int) -> TetMesh:
    """Mesh an upright cylinder: axis z, base at z = 0.

    Ring k of each cross-section has 6k nodes, so a mesh has (1 + 3 rings (rings + 1)) (layers + 1)
    nodes and 18 rings² layers elements. The outermost ring is a polygon inscribed in the circle:
    with one ring the volume is 17 % below the cylinder's, with two 4.5 %, with three 2 %.

    Parameters
    ----------
    radius_m, height_m : float
    rings, layers : int
        Elements along the radius and along the height.

    Returns
    -------
    TetMesh
        Nodes ordered by layer from z = 0 up; in each layer the centre, then ring by ring.
    """
    for name, value in (("radius_m", radius_m), ("height_m", height_m)):
        if not 0 < value < np.inf:
            raise InputError(f"a cylinder needs a positive {name}, not {value!r}")
    for name, value in (("rings", rings), ("layers", layers)):
        if not isinstance(value, (int, np.integer)) or value < 1:
            raise InputError(f"a cylinder needs a whole number of {name}, 1 or more, not {value!r}")
    disc, triangles = _disc(rings)
    points = np.concatenate(
        [
            np.column_stack([radius_m * disc, np.full(len(disc), z)])
            for z in np.linspace(0, height_m, layers + 1)
        ]
    )
    # In a prism over a, b, c each side's diagonal starts from its node that comes first, so that
    # neighbours agree. Alternating the order from layer to layer keeps the mesh from being twisted.
    up = np.sort(triangles, axis=1)
    tetrahedra = [
        np.concatenate([np.c_[a, b, c, c_], np.c_[a, b, b_, c_], np.c_[a, a_, b_, c_]])
        for layer in range(layers)
        for a, b, c in [(up if layer % 2 == 0 else up[:, ::-1]).T + layer * len(disc)]
        for a_, b_, c_ in [(a + len(disc), b + len(disc), c + len(disc))]
    ]
    return TetMesh(points, orient(points, np.concatenate(tetrahedra))[0])


def _disc(rings: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes (·, 2) and triangles (6 rings², 3) of the unit disc."""
    angles = [2 * np.pi * np.arange(6 * k) / (6 * k) for k in range(1, rings + 1)]
    circles = [
        k / rings * np.column_stack([np.cos(angle), np.sin(angle)])
        for k, angle in enumerate(angles, start=1)
    ]

    def node(ring: int, sector: int, step: int) -> int:
        return 1 + 3 * ring * (ring - 1) + (sector * ring + step) % (6 * ring) if ring else 0

    triangles = []
    for k in range(1, rings + 1):
        for s in range(6):
            for i in range(k):
                outer = node(k, s, i + 1)
                triangles.append((node(k - 1, s, i), node(k, s, i), outer))
                if i < k - 1:
                    triangles.append((node(k - 1, s, i), outer, node(k - 1, s, i + 1)))
    return np.concatenate([np.zeros((1, 2)), *circles]), np.array(triangles)


def _fan(polygons: np.ndarray) -> np.ndarray:
    corners = range(1, polygons.shape[1] - 1)
    return np.concatenate([polygons[:, [0, i, i + 1]] for i in corners])


def _checked_surface(points_m: ArrayLike, triangles: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    points, faces = np.asarray(points_m, dtype=float), np.asarray(triangles)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise InputError(f"a surface needs (p, 3) finite vertex coordinates, not {points.shape}")
    if faces.ndim != 2 or faces.shape[1] != 3 or not len(faces) or faces.dtype.kind not in "iu":
        raise InputError(f"a surface needs (F, 3) integer triangles, F > 0, not {faces.shape}")
    if faces.min() < 0 or faces.max() >= len(points):
        raise InputError(
            f"the triangles name vertices {faces.min()} to {faces.max()}, "
            f"but there are {len(points)}, counted from 0"
        )
    return points, faces


def _refuse_open(triangles: np.ndarray) -> None:
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    open_edges, crowded = int((count == 1).sum()), int((count > 2).sum())
    if not len(count) or open_edges or crowded:
        raise InputError(
            f"the surface is not closed: {open_edges} open edges belong to one triangle only and "
            f"{crowded} to more than two, of {len(count)}; every edge must be shared by exactly "
            "two. Fill its holes and remove inner or doubled faces in a mesh editor"
        )


def _refuse_edge_length(points: np.ndarray, triangles: np.ndarray, edge_length_m: float) -> None:
    if not 0 < edge_length_m < np.inf:
        raise InputError(f"the edge length must be a positive number of metres: {edge_length_m!r}")
    extent = " × ".join(f"{length:.4g}" for length in np.ptp(points, axis=0))
    remedy = f"the surface measures {extent} m: check the edge length and the length unit"
    # fTetWild takes minutes, or forever, over edges longer than the body.
    if edge_length_m > np.linalg.norm(np.ptp(points, axis=0)) / 2:
        raise InputError(
            f"the edge length {edge_length_m:g} m is over half the surface's diagonal; {remedy}"
        )
    volume = abs(np.linalg.det(points[triangles] - points.mean(axis=0)).sum()) / 6
    elements = 6 * np.sqrt(2) * volume / edge_length_m**3
    if elements > MOST_ELEMENTS:
        raise InputError(
            f"the edge length {edge_length_m:g} m would take about {elements:.1g} tetrahedra, more "
            f"than {MOST_ELEMENTS:.1g}; {remedy}"
        )


def _pytetwild_version() -> str:
    try:
        version("pyvista")  # pytetwild imports it without depending on it
        return version("pytetwild")
    except PackageNotFoundError as missing:
        raise InputError(
            f"filling a surface with tetrahedra needs the package {missing.name}, which is not "
            "installed: pip install 'collocation-sysid[surface]', or give a tetrahedral mesh"
        ) from missing


def _run_ftetwild(points: np.ndarray, triangles: np.ndarray, edge_length_m: float) -> Any:
    diagonal = np.linalg.norm(np.ptp(points, axis=0))
    lengths = (ASKED_LENGTH * edge_length_m, TOLERANCE * edge_length_m / diagonal)
    with tempfile.TemporaryDirectory() as folder:
        np.savez(Path(folder) / "surface.npz", points_m=points, triangles=triangles.astype("i4"))
        done = subprocess.run(
            [sys.executable, "-c", _WORKER, *(repr(float(length)) for length in lengths)],
            cwd=folder,
            capture_output=True,
            text=True,
        )
        if done.returncode:
            said = (done.stderr.strip().splitlines() or ["no message"])[-1]
            raise InputError(f"pytetwild could not fill the surface ({said})")
        with np.load(Path(folder) / "mesh.npz") as mesh:
            if not len(mesh["tetrahedra"]):
                raise InputError("pytetwild found no inside: the surface encloses no volume")
            return mesh["points_m"], mesh["tetrahedra"].astype(np.int64)
