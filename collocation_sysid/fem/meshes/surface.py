"""Tetrahedral meshes of closed surfaces by fTetWild (package pytetwild)."""

from __future__ import annotations

import hashlib
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from ...common.files import replaced_file
from ...common.isolated_process import Failed, run_isolated
from ...errors import InputError
from .checks import boundary_of, clean_mesh, orient_elements, signed_volumes
from .files import read_tetrahedra, write_tetrahedra

# Edge length passed to fTetWild, as a fraction of the desired one. fTetWild stops as soon as its
# elements are well shaped, however small; coarsening then merges edges up to about the length
# passed, which gives a mean length about a quarter above it.
ASKED_LENGTH = 0.8
# Largest distance of the new surface from the old one, in edge lengths: that of a chord of such a
# length from an arc with a radius of as much.
TOLERANCE = 0.13
_RECIPE = f"coarsen, length {ASKED_LENGTH}, tolerance {TOLERANCE}, volume by columns"

# Largest accepted number of tetrahedra; more suggest a wrong edge length or length unit.
MOST_ELEMENTS = 2_000_000

# Number of triangles from which the surface is divided no further where distances from it are measured.
MOST_SAMPLES = 200_000

# Largest ratio of the way of a node to the mean distance of its faces from the surface: it is 1.5 on a
# cylinder.
LARGEST_FACTOR = 3.0

# Least cosine of the angle between a face and the surface for which the column between them is as
# high as their distance over the cosine: at an edge of the body, the nearest surface is another side.
STEEPEST = 0.5

# Program of a separate process: fTetWild writes a file to its working directory and cannot be
# interrupted.
WORKER = """
import pytetwild
points, tetrahedra = pytetwild.tetrahedralize(
    given["points_m"], given["triangles"], edge_length_abs=float(sys.argv[1]),
    epsilon=float(sys.argv[2]), coarsen=True, vtk_ordering=True, quiet=True,
)
found = {"points_m": points, "tetrahedra": tetrahedra}
"""


def tetrahedralize_surface(
    points_m: ArrayLike,
    triangles: ArrayLike,
    edge_length_m: float,
    cache_dir: str | Path | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Fill a closed surface with tetrahedra.

    fTetWild keeps neither the vertices nor the triangles of the surface: the new surface stays
    within 13 % of `edge_length_m` of the old one and encloses the same volume. So give a selection
    by coordinates that margin. fTetWild is not deterministic either: keep the mesh, by `cache_dir`
    or `TetMesh.write`, to reproduce a result.

    Parameters
    ----------
    points_m : (p, 3) array
        Vertices in metres; coincident ones are merged.
    triangles : (F, 3) integer array
        Vertices of each triangle, counted from 0, in any orientation.
    edge_length_m : float
        Desired edge length; the mean of the result is within some tens of percent of it.
    cache_dir : str or Path, optional
        Folder in which the mesh is kept as .vtu under a hash of the surface, the edge length and
        the version of pytetwild. A mesh found there is returned instead of a new one.

    Returns
    -------
    points_m : (n, 3) array
    tetrahedra : (E, 4) array

    Raises
    ------
    InputError
        If the surface is not closed, the edge length does not suit it, or pytetwild is missing.
    """
    points, faces = merge_coincident(*_checked_surface(points_m, triangles))
    _require_closed(faces)
    _require_suitable_edge_length(points, faces, edge_length_m=edge_length_m)
    mesher = _pytetwild_version()
    if cache_dir is None:
        return run_ftetwild(points, faces, edge_length_m=edge_length_m)
    digest = hashlib.sha256(f"{mesher} {_RECIPE} {float(edge_length_m)!r} {points.shape}".encode())
    digest.update(points.astype("<f8").tobytes() + faces.astype("<i8").tobytes())
    cached = Path(cache_dir) / f"mesh-{digest.hexdigest()[:16]}.vtu"
    if not cached.exists():
        with replaced_file(cached) as draft:
            # A mesh that is refused must not be kept.
            made = run_ftetwild(points, faces, edge_length_m=edge_length_m)
            write_tetrahedra(draft, *clean_mesh(*made)[:2])
    content = read_tetrahedra(cached)
    return content.points_m, content.tetrahedra


def merge_coincident(points: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (p', 3) and triangles (F', 3) with vertices merged that coincide in single
    precision (10⁻⁶ of the diagonal), and without the triangles that become degenerate.

    Vertices that are linked by a chain of such pairs become one, at the first of them. Unused
    vertices stay.
    """
    tolerance = 1e-6 * np.linalg.norm(np.ptp(points, axis=0))
    pairs = KDTree(points).query_pairs(tolerance, output_type="ndarray")
    links = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(points), len(points)))
    label = connected_components(links, directed=False)[1]
    _, first = np.unique(label, return_index=True)
    merged = label[triangles].astype(np.int64)
    is_degenerate = (merged == np.roll(merged, 1, axis=1)).any(axis=1)
    return points[first], merged[~is_degenerate]


def _checked_surface(points_m: ArrayLike, triangles: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    points = np.asarray(points_m, dtype=float)
    faces = np.asarray(triangles)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        fault = (
            f"are an array {points.shape}"
            if points.ndim != 2 or points.shape[1] != 3
            else "contain values that are not finite"
        )
        raise InputError(
            f"the vertices of the surface {fault}; expected finite coordinates, an array (p, 3)"
        )
    if faces.ndim != 2 or faces.shape[1] != 3 or not len(faces) or faces.dtype.kind not in "iu":
        raise InputError(
            f"the triangles are an array {faces.shape} of {faces.dtype}; expected indices of "
            "vertices, an integer array (F, 3) with F > 0"
        )
    if faces.min() < 0 or faces.max() >= len(points):
        raise InputError(
            f"the triangles have vertex indices from {faces.min()} to {faces.max()}; expected "
            f"indices from 0 to {len(points) - 1} of the {len(points)} vertices"
        )
    return points, faces


def _require_closed(triangles: np.ndarray) -> None:
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    open_edges = int((count == 1).sum())
    crowded = int((count > 2).sum())
    if not len(count) or open_edges or crowded:
        raise InputError(
            f"the surface is not closed: {open_edges} open edges belong to one triangle only and "
            f"{crowded} to more than two, of {len(count)}; every edge must be shared by exactly "
            "two. Fill its holes and remove inner or doubled faces in a mesh editor"
        )


def _require_suitable_edge_length(
    points: np.ndarray, triangles: np.ndarray, edge_length_m: float
) -> None:
    if not 0 < edge_length_m < np.inf:
        raise InputError(
            f"edge_length_m is {edge_length_m!r}; expected a positive number of metres"
        )
    extent = " × ".join(f"{length:.4g}" for length in np.ptp(points, axis=0))
    remedy = f"the surface measures {extent} m: check the edge length and the length unit"
    # fTetWild takes minutes, or forever, over edges longer than the body.
    if edge_length_m > np.linalg.norm(np.ptp(points, axis=0)) / 2:
        raise InputError(
            f"the edge length {edge_length_m:g} m is more than half the diagonal of the surface; "
            f"{remedy}"
        )
    volume = abs(np.linalg.det(points[triangles] - points.mean(axis=0)).sum()) / 6
    elements = 6 * np.sqrt(2) * volume / edge_length_m**3
    if elements > MOST_ELEMENTS:
        raise InputError(
            f"the edge length {edge_length_m:g} m would give about {elements:.1g} tetrahedra; "
            f"expected at most {MOST_ELEMENTS:.1g}; {remedy}"
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


def run_ftetwild(
    points: np.ndarray, triangles: np.ndarray, edge_length_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes (n, 3) [m] and tetrahedra (E, 4) of fTetWild, run in a separate process.

    Raises
    ------
    InputError
        If it fails or is not installed.
    """
    diagonal = np.linalg.norm(np.ptp(points, axis=0))
    lengths = (ASKED_LENGTH * edge_length_m, TOLERANCE * edge_length_m / diagonal)
    words = [repr(float(length)) for length in lengths]
    try:
        mesh = run_isolated(WORKER, *words, points_m=points, triangles=triangles.astype("i4"))
    except Failed as error:
        raise InputError(
            f"pytetwild could not fill the surface ({error}); repair the surface in a mesh editor, "
            "try another edge_length_m, or give a tetrahedral mesh"
        ) from error
    if not len(mesh["tetrahedra"]):
        raise InputError(
            "pytetwild found no interior: the surface encloses no volume; expected triangles that "
            "close around the body: check the surface in a mesh editor"
        )
    tetrahedra = mesh["tetrahedra"].astype(np.int64)
    return with_volume_of(points, triangles, mesh["points_m"], tetrahedra), tetrahedra


def with_volume_of(
    scan_m: np.ndarray, scan: np.ndarray, points_m: np.ndarray, tetrahedra: np.ndarray
) -> np.ndarray:
    """Return the nodes (n, 3) with those of the surface moved so that it encloses the volume of the
    scan: chords of a round body lie within it, which is then too slender.

    A node moves with the mean distance of its faces from the scan, each along its normal, so that
    nodes of plane faces stay in their plane.
    """
    tetrahedra, _ = orient_elements(points_m, tetrahedra)
    faces, _ = boundary_of(tetrahedra)
    corners = points_m[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    areas = np.linalg.norm(normals, axis=1)
    normals /= areas[:, None]
    parts = _quarters_of(_quarters_of(corners)).mean(axis=1).reshape(-1, *faces.shape)
    samples, planes = _samples_of(scan_m[scan], np.sqrt(np.median(areas)) / 4)
    nearest = KDTree(samples).query(parts)[1]
    heights = np.einsum("kfi,kfi->kf", samples[nearest] - parts, planes[nearest])
    cosines = np.einsum("kfi,fi->kf", planes[nearest], normals)
    gaps = (heights * np.where(np.abs(cosines) > STEEPEST, 1 / cosines, cosines)).mean(axis=0)
    missing_m3 = (areas * gaps).sum()
    move = np.zeros_like(points_m)
    weight = np.zeros(len(points_m))
    for corner in faces.T:
        np.add.at(move, corner, (areas * gaps)[:, None] * normals)
        np.add.at(weight, corner, areas)
    move[weight > 0] /= weight[weight > 0, None]
    volumes = signed_volumes(points_m, tetrahedra)
    for _ in range(3):  # the volume is nearly linear in the distance
        gained_m3 = (signed_volumes(points_m + move, tetrahedra) - volumes).sum()
        if not missing_m3 * gained_m3 > 0:
            return points_m
        move *= min(missing_m3 / gained_m3, LARGEST_FACTOR)
    while (signed_volumes(points_m + move, tetrahedra)[volumes > 0] <= 0).any():
        move /= 2
    return points_m + move


def _samples_of(triangles_m: np.ndarray, spacing_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Return points (m, 3) of triangles (F, 3, 3), with about a spacing, and their normals (m, 3)."""
    while len(triangles_m) < MOST_SAMPLES:
        ends = np.roll(triangles_m, -1, axis=1)
        is_long = np.linalg.norm(ends - triangles_m, axis=2).max(axis=1) > spacing_m
        if not is_long.any():
            break
        triangles_m = np.concatenate([triangles_m[~is_long], _quarters_of(triangles_m[is_long])])
    a, b, c = triangles_m.swapaxes(0, 1)
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-300)[:, None]
    return triangles_m.mean(axis=1), normals


def _quarters_of(triangles_m: np.ndarray) -> np.ndarray:
    """Return the triangles (4 F, 3, 3) at the corners and in the middle of triangles (F, 3, 3)."""
    a, b, c = triangles_m.swapaxes(0, 1)
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    quarters = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
    return np.concatenate([np.stack(each, axis=1) for each in quarters])
