"""Outline of a body in a depth image, compared with the edge of what the image shows of the body.

Distances along the normals of the surface do not tell how far the surface reaches: a body may
extend beyond everything that was measured without any point being off its surface. Here points of
the body's outline, as the camera sees it, are compared with the edge of what the image shows of it.

A pixel is evidence that the body is not there where it shows something farther away than the body,
or nothing at all in images whose background gives no depth (see `Depth.background`). It is no
evidence where something nearer hides the body, or where a depth is missing for unknown reasons. The
edge is looked for along the normal of the outline (Harris & Stennett 1990); where the body reaches
farther into pixels that show nothing than that search, the nearest other pixel counts.

Each pair of an outline point and an edge is a plane through the camera: its distance from the
outline point, in pixels, is the residual (see `outlines.residual`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ...common.array_types import Array, Index
from ...fem.body import Body
from ...recording.camera import Camera
from ...recording.depth_camera import DepthCamera
from .camera_model import DepthCameraModel
from .visible_surface import VisibleSurface

# Distance to either side of the outline within which the edge is searched [pixels]; farther away it
# may belong to another part of the body.
SEARCH_PX = 6.0
# Step of this search [pixels].
STEP_PX = 0.25
# Offsets along the outline of parallel lines of this search, over which the edge is averaged
# [pixels]. A single line finds the border of a pixel, up to half a pixel off; an edge that is not
# along rows or columns crosses other pixels on the other lines, and the errors cancel in part.
LINES_PX = np.linspace(-2.0, 2.0, 9)
# Largest distance from the edge on the middle line at which other lines find the same edge
# [pixels].
SAME_EDGE_PX = 1.5
# Distance outside an outline at which the body itself must not cover the image [pixels].
OUTSIDE_PX = 1.5
# If at least this many pixels show background per pixel without depth, the sensor measures its
# background, and missing depths are failures.
LEAST_BACKGROUND_SHARE = 0.1
# Class of a pixel, compared with a point of the outline: it shows the body.
BODY = 0
# Class of a pixel that is no evidence whether the body is there.
UNKNOWN = 1
# Class of a pixel that shows that the body is not there.
EMPTY = 2


@dataclass(frozen=True, eq=False)
class Outline:
    """Points of a body's outline and planes through the camera that they should lie in.

    Arrays have S samples of E points at most, of which those that do not exist are zero and not
    `is_compared`.
    """

    # (S, E, v): indices of the v surface nodes of each outline point's face, and their shape
    # functions.
    nodes: Index
    weights: Array
    normals: Array  # (S, E, 3): unit normals of the planes in the world, outwards from the body
    # (S, E, 3): a point of each plane in the camera's frame [m], and zeros.
    points: Array
    rays: Array
    pixel_m: Array  # (S, E): width of a pixel at the outline point, along the plane's normal [m]
    places_m: Array  # (S, E, 3): outline points on the undeformed body [m]
    is_compared: NDArray[np.bool_]  # (S, E) of bool: outline points whose edge is known

    @classmethod
    def from_shapes(
        cls,
        camera: DepthCameraModel,
        surface: VisibleSurface,
        body: Body,
        *,
        shapes_m: Array,
        phi: Array,
        gate_m: float,
    ) -> Outline:
        """Associate the outlines of shapes with the edges in the images of a camera.

        A camera without images gives an outline without compared points.

        Parameters
        ----------
        surface : VisibleSurface
            Surface of the body.
        shapes_m : (S, n, 3) array
            Positions of the surface's nodes at the times of the images [m].
        phi : (k,) array
            Nuisance parameters, with the pose of the camera.
        gate_m : float
            Pixels whose depth differs by at most this from that of the outline point may show the
            body [m].
        """
        corners = surface.faces.shape[1]
        edges = []
        for sample, shape_m in enumerate(shapes_m):
            image_m = camera.depth.images_m[sample] if len(camera.depth.images_m) else None
            eye_m = camera.eye_m(phi, sample)
            points = None
            if image_m is not None and eye_m is not None:
                view = OutlineView(
                    camera.depth.camera,
                    eye_m,
                    partial(camera.to_camera_m, phi, sample=sample),
                    camera.depth.spacing_m,
                )
                points = outline_points(view, surface, shape_m)
            if image_m is None or points is None:
                edges.append(_no_edges(corners))
                continue
            edges.append(
                _edges(camera, points, image_m=image_m, phi=phi, gate_m=gate_m, sample=sample)
            )
        most = max(1, *(len(each["is_compared"]) for each in edges))

        def together(name: str) -> NDArray:
            return np.stack([_padded(each[name], most) for each in edges])

        of_points = {name: together(name) for name in edges[0] if name not in ("faces",)}
        faces = together("faces")
        nodes = surface.faces[faces]
        rest_m = body.nodes_m[surface.nodes][nodes]
        return cls(
            nodes=nodes,
            places_m=np.einsum("sea,seai->sei", of_points["weights"], rest_m),
            rays=np.zeros_like(of_points["points"]),
            **of_points,
        )


class OutlineView(NamedTuple):
    """View of a camera at one image."""

    camera: Camera  # camera with a matrix
    eye_m: Array  # (3,): its position in the world [m]
    # Points (P, 3) of the world in the frame of the camera [m].
    to_camera_m: Callable[[Array], Array]
    spacing_m: float  # distance of the points of an outline [m]


@dataclass(frozen=True, eq=False)
class OutlinePoints:
    """Points (P) where the body ends in the view of a camera."""

    faces: Index  # (P,): indices of the surface's faces
    weights: Array  # (P, v): shape functions of the faces' nodes
    depth_m: Array  # (P,): depths along the optical axis [m]
    pixels: Array  # (P, 2): pixels u and v
    outwards: Array  # (P, 2): unit normals of the outline in the image, away from the body


def _padded(values: NDArray, count: int) -> NDArray:
    """Return values (k, …) padded with zeros to a length of `count`."""
    return np.pad(values, [(0, count - len(values)), *[(0, 0)] * (values.ndim - 1)])


def _no_edges(corners: int) -> dict[str, NDArray]:
    return {
        "faces": np.zeros(0, dtype=np.int64),
        "weights": np.zeros((0, corners)),
        "normals": np.zeros((0, 3)),
        "points": np.zeros((0, 3)),
        "pixel_m": np.zeros(0),
        "is_compared": np.zeros(0, dtype=bool),
    }


def no_depth_is_empty(
    camera: DepthCameraModel, image_m: Array, *, sample: int, size_m: float
) -> bool:
    """Return whether pixels without depth show that nothing is there.

    It is as the problem states (`Depth.background`); for "auto", whether fewer than the share
    `LEAST_BACKGROUND_SHARE` of the number of pixels without depth show a background behind the
    body.

    Parameters
    ----------
    image_m : (rows, columns) array
        Depths [m], NaN where missing.
    sample : int
        Index of the image.
    size_m : float
        Diagonal of the body [m]; pixels that are farther behind its middle show background.
    """
    if camera.depth.background != "auto":
        return camera.depth.background == "empty"
    # The middle of the body as stated, which may move with the camera: a coarse measure suffices.
    middle_m = float(camera.body_middle_m(sample)[2])
    background = np.count_nonzero(image_m > middle_m + size_m)
    return bool(background < LEAST_BACKGROUND_SHARE * np.count_nonzero(np.isnan(image_m)))


def outline_points(
    view: OutlineView, surface: VisibleSurface, shape_m: Array
) -> OutlinePoints | None:
    """Return the points where a shape (n, 3) [m] of the surface ends in a view; None if there are
    none, or if the body is partly behind the camera.

    They lie `spacing_m` apart on edges between a flat triangle that faces the camera and one that
    does not, and are not in front of or behind another part of the body.
    """
    camera, eye_m, to_camera_m, spacing_m = view
    own_m = to_camera_m(shape_m)
    if (own_m[:, 2] <= 0).any():
        return None
    facing = surface.is_facing(shape_m, eye_m)
    ends, faces_of_edges = surface.edges
    is_front = facing[faces_of_edges]
    first, second = faces_of_edges.T
    front_triangle = np.where(is_front[:, 0], first, second)
    parts = len(surface.plane_triangles) // len(surface.faces)
    outline_edges = np.flatnonzero(
        (is_front[:, 0] != is_front[:, 1]) & surface.is_selected[front_triangle // parts]
    )
    if not len(outline_edges):
        return None
    ends = ends[outline_edges]
    front_triangle = front_triangle[outline_edges]
    corners = surface.plane_triangles[front_triangle]
    lengths_m = np.linalg.norm(np.diff(shape_m[ends], axis=1)[:, 0], axis=1)
    counts = np.maximum(1, np.ceil(lengths_m / spacing_m).astype(int))
    edge = np.repeat(np.arange(len(outline_edges)), counts)
    number = np.arange(len(edge)) - np.repeat(np.cumsum(counts) - counts, counts)
    share = (number + 0.5) / counts[edge]
    # Barycentric coordinates in the triangle that faces the camera.
    at_first = corners[edge] == ends[edge, :1]
    at_second = corners[edge] == ends[edge, 1:]
    shares = at_first * (1 - share)[:, None] + at_second * share[:, None]
    faces, places = surface.to_faces(front_triangle[edge], shares)
    weights, points_m, _ = surface.evaluate(shape_m, faces, barycentric=places)
    pixels = camera.distorted_pixels(own_m)
    tangents_px = pixels[ends[edge, 1]] - pixels[ends[edge, 0]]
    length_px = np.linalg.norm(tangents_px, axis=1)
    normals = (
        np.column_stack([-tangents_px[:, 1], tangents_px[:, 0]])
        / np.maximum(length_px, 1e-9)[:, None]
    )
    centres = pixels[corners[edge]].mean(axis=1)
    at_m = to_camera_m(points_m)
    places_px = camera.distorted_pixels(at_m)
    inwards = np.sum(normals * (places_px - centres), axis=1) < 0
    outwards = np.where(inwards[:, None], -normals, normals)
    separate = _first_of_each_cube(points_m, spacing_m)
    separate = separate[length_px[separate] > 1e-6]
    is_covered = _covered(
        places_px[separate] + OUTSIDE_PX * outwards[separate],
        pixels[surface.plane_triangles[facing]],
    )
    selected = separate[~is_covered]
    if not len(selected):
        return None
    return OutlinePoints(
        faces=faces[selected],
        weights=weights[selected],
        depth_m=at_m[selected, 2],
        pixels=places_px[selected],
        outwards=outwards[selected],
    )


def _first_of_each_cube(points_m: Array, edge_m: float) -> Index:
    """Return the first point (P, 3) in each cube of a grid, ascending."""
    _, first = np.unique(np.floor(points_m / edge_m).astype(np.int64), axis=0, return_index=True)
    return np.sort(first)


def _covered(points: Array, triangles: Array) -> NDArray[np.bool_]:
    """Return which points (P, 2) lie in or on any of their triangles (T, 3, 2)."""
    covered = np.zeros(len(points), dtype=bool)
    if not len(triangles):
        return covered
    middles = triangles.mean(axis=1)
    reach = np.linalg.norm(triangles - middles[:, None], axis=2).max()
    candidates = KDTree(middles).query_ball_point(points, reach)
    point = np.repeat(np.arange(len(points)), [len(each) for each in candidates])
    a, b, c = triangles[np.concatenate([*candidates, []]).astype(int)].transpose(1, 0, 2)

    def side(start: Array, end: Array) -> Array:
        way = end - start
        to = points[point] - start
        return way[:, 0] * to[:, 1] - way[:, 1] * to[:, 0]

    sides = np.stack([side(a, b), side(b, c), side(c, a)])
    covered[point[(sides >= 0).all(axis=0) | (sides <= 0).all(axis=0)]] = True
    return covered


def _edges(
    camera_in: DepthCameraModel,
    points: OutlinePoints,
    image_m: Array,
    *,
    phi: Array,
    gate_m: float,
    sample: int,
) -> dict[str, NDArray]:
    """Return planes through the edges that belong to points of an outline, by attribute."""
    camera = camera_in.depth.camera
    empty = no_depth_is_empty(camera_in, image_m, sample=sample, size_m=camera_in.size_m)

    def shown_at(pixels: Array) -> NDArray[np.int64]:
        return _classify_pixels(
            image_m, pixels, depth_m=points.depth_m, gate_m=gate_m, is_missing_empty=empty
        )

    def is_nothing() -> NDArray[np.bool_]:
        return (image_m > points.depth_m.max() + gate_m) | (np.isnan(image_m) & empty)

    edges, outwards, is_compared = image_edges(points, shown_at, is_nothing)
    return {
        "faces": points.faces,
        "weights": points.weights,
        "is_compared": is_compared,
        **_planes(
            camera_in,
            camera,
            edges=edges,
            outwards=outwards,
            depth_m=points.depth_m,
            phi=phi,
            sample=sample,
        ),
    }


def image_edges(
    points: OutlinePoints,
    shown_at: Callable[[Array], NDArray[np.int64]],
    is_nothing: Callable[[], NDArray[np.bool_]],
    search_px: float = SEARCH_PX,
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return the edges (P, 2) in an image that belong to points of an outline, their normals (P, 2)
    away from the body, and whether there is an edge (P,) [pixels].

    Parameters
    ----------
    shown_at : callable
        Classes (…, P) of pixels (…, P, 2) beside the points.
    is_nothing : callable
        Mask (rows, columns) of the pixels that show nothing, called where the body reaches into
        these.
    search_px : float
        Distance to either side of the outline within which the edge is searched.
    """
    offsets = np.arange(-search_px, search_px + STEP_PX / 2, STEP_PX)
    middle = _nearest_ends(points, offsets, along_px=0.0, shown_at=shown_at)
    has_edge = np.isfinite(middle)
    on_lines = np.array(
        [
            _nearest_ends(
                points,
                offsets,
                along_px=along_px,
                shown_at=shown_at,
                expected=np.where(has_edge, middle, 0.0),
            )
            for along_px in LINES_PX
        ]
    )
    is_same = np.abs(on_lines - middle) <= SAME_EDGE_PX
    # Lines in pairs on both sides, so that their mean is at the point of a straight edge.
    is_same &= is_same[::-1]
    counts = np.maximum(is_same.sum(axis=0), 1)
    mean_offsets = np.where(is_same, on_lines, 0.0).sum(axis=0) / counts
    outwards = points.outwards.copy()
    edges = points.pixels + mean_offsets[:, None] * outwards
    is_beyond = ~has_edge & (shown_at(points.pixels) == EMPTY)
    if is_beyond.any():
        nearest, ways, exists = _nearest_edges(is_nothing(), points.pixels[is_beyond])
        edges[is_beyond] = nearest
        outwards[is_beyond] = ways
        is_beyond[is_beyond] = exists
    return edges, outwards, has_edge | is_beyond


def _nearest_ends(
    points: OutlinePoints,
    offsets: Array,
    *,
    along_px: float,
    shown_at: Callable[[Array], NDArray[np.int64]],
    expected: Array | float = 0.0,
) -> Array:
    """Return offsets (P,) [pixels] at which the image of the body ends, or NaN."""
    tangents = np.column_stack([-points.outwards[:, 1], points.outwards[:, 0]])
    start = points.pixels + along_px * tangents
    shown = shown_at(start + offsets[:, None, None] * points.outwards)
    is_end = (shown[:-1] == BODY) & (shown[1:] == EMPTY)
    middles = (offsets[:-1] + offsets[1:]) / 2
    apart = np.where(is_end, np.abs(middles[:, None] - expected), np.inf)
    nearest = middles[apart.argmin(axis=0)]
    return np.where(is_end.any(axis=0), nearest, np.nan)


def _classify_pixels(
    image_m: Array, pixels: Array, depth_m: Array, *, gate_m: float, is_missing_empty: bool
) -> NDArray[np.int64]:
    """Classify pixels: within `gate_m` BODY, farther EMPTY, nearer or outside the image UNKNOWN."""
    column, row = np.moveaxis(np.round(pixels).astype(np.int64), -1, 0)
    inside = (column >= 0) & (column < image_m.shape[1]) & (row >= 0) & (row < image_m.shape[0])
    depths_m = image_m[np.where(inside, row, 0), np.where(inside, column, 0)]
    behind_m = depths_m - depth_m
    shown = np.full(depths_m.shape, UNKNOWN)
    shown[np.abs(behind_m) <= gate_m] = BODY
    shown[(behind_m > gate_m) | (np.isnan(depths_m) & is_missing_empty)] = EMPTY
    shown[~inside] = UNKNOWN
    return shown


def _nearest_edges(
    nothing: NDArray[np.bool_], pixels: Array
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return the nearest edges (P, 2), unit vectors to them (P, 2), and whether they exist."""
    if nothing.all():
        return pixels, np.ones_like(pixels), np.zeros(len(pixels), dtype=bool)
    places: Array = np.asarray(
        scipy.ndimage.distance_transform_edt(nothing, return_distances=False, return_indices=True)
    )
    column, row = np.round(pixels).astype(np.int64).T
    nearest = places[::-1, row, column].T.astype(float)
    way = pixels - nearest
    length = np.linalg.norm(way, axis=1)
    has_edge = length > 0
    way[has_edge] /= length[has_edge, None]
    way[~has_edge] = [1.0, 0.0]
    return nearest + 0.5 * way, way, has_edge


def _planes(
    camera_in: DepthCameraModel,
    camera: DepthCamera,
    edges: Array,
    outwards: Array,
    depth_m: Array,
    *,
    phi: Array,
    sample: int,
) -> dict[str, NDArray]:
    """Return planes through the camera and edges in its image, by attribute name of `Outline`."""
    tangents_px = np.column_stack([-outwards[:, 1], outwards[:, 0]])
    at, before, after, outside = _concatenated_rays(
        camera, [edges, edges - tangents_px, edges + tangents_px, edges + outwards]
    )
    normals = np.cross(before, after)
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    pixel = np.sum(normals * (outside - at), axis=1)
    normals *= np.sign(pixel)[:, None]
    corner = camera_in.to_world(phi, np.zeros((1, 3)), rays=np.zeros((1, 3)), image=sample)
    ways = camera_in.to_world(phi, normals, rays=np.zeros_like(normals), image=sample) - corner
    return {
        "normals": ways / np.linalg.norm(ways, axis=1)[:, None],
        "points": depth_m[:, None] * at,
        "pixel_m": np.abs(pixel) * depth_m,
    }


def _concatenated_rays(camera: DepthCamera, pixels: Sequence[Array]) -> list[Array]:
    return np.split(camera.points_at_unit_depth(np.concatenate(pixels)), len(pixels))
