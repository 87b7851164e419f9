"""Where the points that a depth camera sees lie on the surface of the body.

Nothing is labelled. A point belongs to the nearest of the surface, in the shape and with the pose
of the camera that are known so far; a `Sighting` says which for every sample. As estimates move on
it follows, as charts of markers' places do. Between, residuals along the normals there are smooth.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from ..arrays import Array, Index
from ..fem.body import Body
from ..fem.touching import on_faces
from ..model.generated import Generated
from ..model.nuisance import NuisanceMap
from ..recording.depth import Depth
from ..recording.experiment import Experiment
from ..recording.nuisance import (
    DEPTH_BIAS,
    DEPTH_SCALE,
    DEPTH_SHIFT,
    DEPTH_TIME,
    DEPTH_TURN,
    NuisanceRow,
    rotation,
)
from ..recording.placement import nearest_on

OF_CAMERA = (DEPTH_TURN, DEPTH_SHIFT, DEPTH_BIAS, DEPTH_SCALE, DEPTH_TIME)
# Triangles, by their middles, of which the nearest point is taken.
NEARBY = 10
# Steps to it on a curved face, and shorter ones that end them.
SETTLING, STILL = 3, 1e-6
# Below this cosine between normal and view a point is seen at a grazing angle; measured normals
# may be off by as much.
GRAZING = 0.3
# Off an edge the way to the nearest point leaves the normal by more than this share of itself.
BESIDE = 0.5
# Share of the body's size that points may be off by before anything is fitted; later so many
# times the median, where that narrows the gate by a share.
WIDE, SPREAD, NARROWER = 0.25, 6.0, 0.8
# What moved by less than this share of sigma is where it was.
SAME = 0.2
# Of an alignment: points of the surface, iterations, the share of a body's size that it may be off
# at first, and the weight of how far points are beside those of how far they are along normals.
# They count as so many independent ones beside the prior.
SAMPLES, ITERATIONS, REACH, SLIDING, INDEPENDENT = 250, 25, 0.35, 0.2, 10000
# Turns [rad] that it is begun from besides none, and how many are followed to the end.
TURNED, KEPT, EXACT = 0.2, 2, 1e6
# More points of a cloud only make it slower.
ENOUGH = 2000
# An alignment farther than this many deviations of its prior is of something else.
FARTHEST = 4.0

# Flat triangles that stand for a face of three nodes, or of six with those on ab, bc, ca.
CORNERS = np.vstack([np.eye(3), [[0.5, 0.5, 0], [0, 0.5, 0.5], [0.5, 0, 0.5]]])
FLAT = {3: np.array([[0, 1, 2]]), 6: np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]])}
LEFT_OUT = ("far", "grazing", "turned away", "not chosen", "hidden")
# What is in front by less than this share of the spacing of points is beside it, and a shape that
# moves by less has settled.
FRONT = 0.5


@dataclass(frozen=True, eq=False)
class Skin:
    """The faces of a body, each of them some flat triangles.

    Attributes
    ----------
    nodes : (n,) of the body
    faces : (F, 3) or (F, 6) which of these each has
    chosen : (F,) those that may be seen
    """

    nodes: Index
    faces: Index
    chosen: NDArray[np.bool_]

    @classmethod
    def of(cls, body: Body, depth: Depth) -> Skin:
        """That of a body, and what of it a camera may see."""
        triangles = body.mesh.surface
        chosen = np.ones(len(triangles), dtype=bool)
        if depth.faces is not None:
            chosen[:] = False
            chosen[depth.faces.resolve_faces(body.mesh)] = True
        nodes, faces = np.unique(body.nodes.on_faces(triangles), return_inverse=True)
        return cls(nodes, faces.reshape(len(triangles), -1), chosen)

    @property
    def flat(self) -> Index:
        """(F·k, 3) flat triangles, those of a face after each other."""
        return self.faces[:, FLAT[self.faces.shape[1]]].reshape(-1, 3)

    def at(self, triangles: Index, shares: Array) -> tuple[Index, Array]:
        """Faces (P,), and places (P, 3) on them, of places on flat triangles (P,)."""
        parts = FLAT[self.faces.shape[1]]
        corners = CORNERS[parts[triangles % len(parts)]]
        return triangles // len(parts), np.einsum("pc,pci->pi", shares, corners)

    def points(self, x: Array, faces: Index, places: Array) -> tuple[Array, Array, Array]:
        """Weights (P, v) of the nodes, points (P, 3) and outward normals of a shape x (n, 3)."""
        weights, points, along = self._along(x, faces, places)
        normals = np.cross(along[:, 0], along[:, 1])
        normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-300)[:, None]
        return weights, points, normals

    def _along(self, x: Array, faces: Index, places: Array) -> tuple[Array, Array, Array]:
        """Weights, points, and slopes (P, 2, 3) of these along the faces."""
        weights, slopes = on_faces(places, self.faces.shape[1])
        corners = x[self.faces[faces]]
        along = np.einsum("pak,pai->pki", slopes[:, :, :2] - slopes[:, :, 2:], corners)
        return weights, np.einsum("pa,pai->pi", weights, corners), along

    def triangles(self, x: Array, parts: int = 4) -> Array:
        """(F·parts², 3, 3) of a shape x (n, 3), faces divided along each side into so many."""
        i, j = np.indices((parts, parts)).reshape(2, -1)
        up, down = i + j < parts, i + j < parts - 1
        upward = np.stack([[i, j], [i + 1, j], [i, j + 1]])[..., up]
        downward = np.stack([[i + 1, j], [i + 1, j + 1], [i, j + 1]])[..., down]
        of_b, of_c = np.concatenate([upward, downward], axis=2).transpose(1, 2, 0) / parts
        places = np.stack([1 - of_b - of_c, of_b, of_c], axis=-1).reshape(-1, 3)
        faces = np.repeat(np.arange(len(self.faces)), len(places))
        points = self.points(x, faces, np.tile(places, (len(self.faces), 1)))[1]
        return points.reshape(-1, 3, 3)

    def facing(self, x: Array, eye_m: Array | None, least: float = 0.0) -> NDArray[np.bool_]:
        """(F·k,) flat triangles whose cosine to the way to a camera is larger; all of a cloud."""
        if eye_m is None:
            return np.ones(len(self.flat), dtype=bool)
        a, b, c = x[self.flat].transpose(1, 0, 2)
        normal, way = np.cross(b - a, c - a), eye_m - (a + b + c) / 3
        sizes = np.linalg.norm(normal, axis=1) * np.linalg.norm(way, axis=1)
        return np.sum(normal * way, axis=1) > least * sizes

    def hidden(
        self, x: Array, eye_m: Array | None, points_m: Array, front_m: float
    ) -> NDArray[np.bool_]:
        """(P,) whether another part is in front of points (P, 3), seen by a camera, by so much."""
        behind = np.zeros(len(points_m), dtype=bool)
        if eye_m is None or not len(points_m):
            return behind
        # Seen from there in the plane at distance one.
        ahead, *across = np.linalg.svd((x.mean(axis=0) - eye_m)[None])[2]
        ahead *= np.sign(ahead @ (x.mean(axis=0) - eye_m))
        depths, away = (x - eye_m) @ ahead, (points_m - eye_m) @ ahead
        corners = self.flat[self.facing(x, eye_m, 0.0)]
        corners = corners[(depths[corners] > 0).all(axis=1)]
        places = ((x - eye_m) @ np.transpose(across) / depths[:, None])[corners]
        seen = (points_m - eye_m) @ np.transpose(across) / away[:, None]
        middles = places.mean(axis=1)
        reach = np.linalg.norm(places - middles[:, None], axis=2).max(initial=0.0)
        near = KDTree(middles).query_ball_point(seen, reach)
        point = np.repeat(np.arange(len(seen)), [len(each) for each in near])
        triangle = np.concatenate([*near, []]).astype(int)
        first = depths[corners[triangle]].min(axis=1) < away[point] - front_m
        point, triangle = point[first], triangle[first]
        a, b, c = places[triangle].transpose(1, 0, 2)
        way, whole = seen[point] - a, _cross(b - a, c - a)
        of_b, of_c = _cross(way, c - a) / whole, _cross(b - a, way) / whole
        shares = np.column_stack([1 - of_b - of_c, of_b, of_c])
        # What is linear on a triangle is one over the depth in the plane.
        hit = 1 / np.sum(shares / depths[corners[triangle]], axis=1) < away[point] - front_m
        behind[point[(shares >= 0).all(axis=1) & hit]] = True
        return behind

    def nearest(self, x: Array, points: Array, among: Index) -> tuple[Index, Array]:
        """Faces (P,), and places (P, 3) on them, nearest to points (P, 3), of some triangles."""
        corners = x[self.flat[among]]
        middles = corners.mean(axis=1)
        sizes = np.linalg.norm(corners - middles[:, None], axis=2).max(axis=1)
        found = KDTree(middles).query(points, min(NEARBY, len(corners)))
        away, near = (np.reshape(each, (len(points), -1)) for each in found)
        # Triangles whose middles are farther than this by their own size cannot be nearer.
        triangles, least = near[:, 0].copy(), np.full(len(points), np.inf)
        feet = np.zeros_like(points)
        for rank, own in enumerate(near.T):
            here = np.flatnonzero(away[:, rank] - sizes[own] < least)
            on = nearest_on(points[here], corners[own[here]])
            apart = np.linalg.norm(on - points[here], axis=1)
            nearer = apart < least[here]
            here, on, apart = here[nearer], on[nearer], apart[nearer]
            triangles[here], feet[here], least[here] = own[here], on, apart
        a, b, c = corners[triangles].transpose(1, 0, 2)
        normal = np.cross(b - a, c - a)
        squares = np.sum(normal**2, axis=1)
        of_b = np.sum(np.cross(feet - a, c - a) * normal, axis=1) / squares
        of_c = np.sum(np.cross(b - a, feet - a) * normal, axis=1) / squares
        faces, places = self.at(among[triangles], np.column_stack([1 - of_b - of_c, of_b, of_c]))
        moving = np.arange(len(points) if self.faces.shape[1] > 3 else 0)
        for _ in range(SETTLING):
            # Faces are curved: what is nearest on the flat triangle is beside what is on them.
            _, feet, along = self._along(x, faces[moving], places[moving])
            by_a, by_b = along.transpose(1, 0, 2)
            aa, ab, bb = (
                np.sum(u * v, axis=1) for u, v in ((by_a, by_a), (by_a, by_b), (by_b, by_b))
            )
            to_a, to_b = (np.sum(u * (points[moving] - feet), axis=1) for u in (by_a, by_b))
            step = np.column_stack([bb * to_a - ab * to_b, aa * to_b - ab * to_a])
            step /= (aa * bb - ab**2)[:, None]
            settled = np.clip(places[moving] + np.column_stack([step, -step.sum(axis=1)]), 0.0, 1.0)
            settled /= settled.sum(axis=1, keepdims=True)
            far = np.abs(settled - places[moving]).max(axis=1) > STILL
            places[moving] = settled
            moving = moving[far]
        return faces, places


@dataclass(frozen=True, eq=False)
class View:
    """A depth camera: what it is off by, and where it stands.

    Attributes
    ----------
    depth : Depth
    number : int
        Among those of the experiment.
    nuisance : NuisanceMap
    pivot_m : (3,) in its frame: its turn is about the middle of the body
    """

    depth: Depth
    number: int
    nuisance: NuisanceMap
    pivot_m: Array

    @classmethod
    def of(cls, experiment: Experiment, number: int, nuisance: NuisanceMap) -> View:
        """That of an experiment's camera."""
        depth = experiment.depths[number]
        rotations, translations = depth.camera.motion(depth.times[:1])
        pivot_m = (experiment.body.nodes_m.mean(axis=0) - translations[0]) @ rotations[0]
        return cls(depth, number, nuisance, pivot_m)

    @cached_property
    def instruments(self) -> dict[tuple[int, int], Any]:
        """Of its readings, whose derivatives are generated once."""
        return {}

    @cached_property
    def own(self) -> Index:
        """Positions in φ of what is not known of it."""
        return self.nuisance.places(*OF_CAMERA, of=self.number)

    @cached_property
    def motion(self) -> tuple[Array, Array]:
        """Rotations (S, 3, 3) and translations (S, 3) from its frame to the world."""
        return self.depth.camera.motion(self.depth.times)

    @cached_property
    def rays(self) -> list[Array]:
        """(P, 3) that points of each sample move along as their depths grow; zeros of clouds."""
        seen, pinhole = self.depth.points_m, self.depth.camera.matrix is not None
        return [p / p[:, 2:] if pinhole else np.zeros_like(p) for p in seen]

    def corrected(self, point: ca.SX, ray: ca.SX, values: Mapping[NuisanceRow, ca.SX]) -> ca.SX:
        """Where a point is in the frame as stated, by what the camera is off by."""
        point = (1 + values.get(DEPTH_SCALE, 0)) * point + values.get(DEPTH_BIAS, 0) * ray
        if DEPTH_TURN in values:
            pivot = ca.DM(self.pivot_m)
            point = rotation(values[DEPTH_TURN]) @ (point - pivot) + pivot
        return point + values.get(DEPTH_SHIFT, 0)

    @cached_property
    def _corrected(self) -> Generated:
        def expression(own: ca.SX, data: ca.SX) -> ca.SX:
            values = self.nuisance.by_row(own, self.own)
            return self.corrected(data[:3], data[3:], values)

        return Generated(expression, len(self.own), 6)

    def world(self, phi: Array, sample: int) -> Array:
        """(P, 3) the points of a sample in the world, at φ (k,)."""
        return self.corrected_at(phi, self.depth.points_m[sample], self.rays[sample], sample)

    def corrected_at(self, phi: Array, points: Array, rays: Array, sample: int) -> Array:
        """The same of some points (P, 3) of its frame, that move along rays (P, 3)."""
        seen = self._corrected.value(phi[self.own], np.vstack([points.T, rays.T])).T
        rotations, translations = self.motion
        return seen @ rotations[sample].T + translations[sample]

    def own_m(self, phi: Array, points_m: Array, sample: int) -> Array:
        """(P, 3) points (P, 3) of the world in its frame: what `world` says of it, but for bias."""
        basis = np.vstack([np.zeros(3), np.eye(3)])
        corner, *along = self.corrected_at(phi, basis, np.zeros((4, 3)), sample)
        return np.linalg.solve((along - corner).T, (points_m - corner).T).T

    def told(self, phi: Array) -> dict[str, float]:
        """What φ (k,) says of it, by label."""
        entries, values = self.nuisance.entries, phi * self.nuisance.scales
        return {entries[k].label: float(values[k]) for k in self.own}

    def phi(self, told: Mapping[str, float]) -> Array:
        """Φ (k,) with this, zero else."""
        values = [told.get(entry.label, 0.0) for entry in self.nuisance.entries]
        return np.array(values) / self.nuisance.scales

    def eye_m(self, phi: Array, sample: int) -> Array | None:
        """(3,) where the camera is, at φ (k,); None of a cloud."""
        if self.depth.camera.matrix is None:
            return None
        return self.corrected_at(phi, np.zeros((1, 3)), np.zeros((1, 3)), sample)[0]

    def prior(self, row: NuisanceRow) -> Array:
        """(3,) over the deviations of its turn, or shift; so good as infinite of what is exact."""
        places = self.nuisance.places(row, of=self.number)
        return 1 / self.nuisance.scales[places] if len(places) else np.full(3, EXACT)

    def late_s(self, phi: Array) -> float:
        """How much later than its times say it sees."""
        places = self.nuisance.places(DEPTH_TIME, of=self.number)
        return float((phi * self.nuisance.scales)[places].sum())

    def with_pose(self, phi: Array, turn: Array, shift_m: Array) -> Array:
        """Φ with another turn (rotation vector) and shift, as far as these are estimated."""
        moved, angle = phi.copy(), np.linalg.norm(turn)
        cayley = turn * (2 * np.tan(angle / 2) / angle if angle else 1.0)
        for row, values in ((DEPTH_TURN, cayley), (DEPTH_SHIFT, shift_m)):
            places = self.nuisance.places(row, of=self.number)
            moved[places] = values[: len(places)] / self.nuisance.scales[places]
        return moved


@dataclass(frozen=True, eq=False)
class Sighting:
    """Which points of the surface a camera sees, in samples (S) of as many points (E) at most.

    Attributes
    ----------
    view : View
    body : Body
    skin : Skin
    nodes, weights : (S, E, v) of the surface's nodes, in each point
    normals : (S, E, 3) of the surface, in the world
    points, rays : (S, E, 3) in the camera's frame
    places_m : (S, E, 3) on the undeformed body
    used : (S, E) points that count
    gate_m : float
        Farther from the surface points are of something else, for now.
    left_out : mapping of the reason to the number of points
    shapes_m : (S, n, 3) of the surface, and `seen_m` (S, E, 3) in the world, as they were then
    start : mapping of the label of what is not known of the camera to its value then
    settled : bool
        Whether shapes had hardly moved before: what these hide from the camera does not count. From
        shapes that are still sought too much would seem hidden, and all of the rest fit.
    """

    view: View
    body: Body
    skin: Skin
    nodes: Index
    weights: Array
    normals: Array
    points: Array
    rays: Array
    places_m: Array
    used: NDArray[np.bool_]
    gate_m: float
    left_out: Mapping[str, int]
    shapes_m: Array
    start: Mapping[str, float]
    settled: bool

    @classmethod
    def of(
        cls,
        view: View,
        body: Body,
        shapes_m: Array,
        phi: Array,
        gate_m: float,
        settled: bool = False,
    ) -> Sighting:
        """That in shapes (S, n, 3) of the surface."""
        skin = Skin.of(body, view.depth)
        how = phi, gate_m, settled
        seen = [_seen(view, skin, body, k, x, *how) for k, x in enumerate(shapes_m)]
        most = max(1, *(len(each["used"]) for each in seen))
        arrays: dict[str, Any] = {
            name: np.stack(
                [
                    np.pad(s[name], [(0, most - len(s[name])), *[(0, 0)] * (s[name].ndim - 1)])
                    for s in seen
                ]
            )
            for name in seen[0]
            if name != "reasons"
        }
        total = np.sum([each["reasons"] for each in seen], axis=0).tolist()
        own: dict[str, Any] = {"left_out": dict(zip(LEFT_OUT, total, strict=True))}
        own |= {"start": view.told(phi), "gate_m": gate_m, "shapes_m": shapes_m, "settled": settled}
        return cls(view, body, skin, **own, **arrays)

    @classmethod
    def aligned(cls, view: View, body: Body, shapes_m: Array, phi: Array) -> Sighting:
        """The same, with the pose of the camera aligned to these shapes first."""
        first = view.depth.first
        skin = Skin.of(body, view.depth)
        turn, shift_m = alignment(view, skin, shapes_m[first], first)
        moved = view.with_pose(phi, turn, shift_m)
        far = np.abs(moved[view.own]).max(initial=0.0) > FARTHEST
        gate_m = max(WIDE * float(np.linalg.norm(np.ptp(body.nodes_m, axis=0))), view.depth.gate_m)
        phi = phi if far else moved
        some = tuple(cloud[:: 1 + len(cloud) // ENOUGH] for cloud in view.depth.clouds)
        rough = View(replace(view.depth, clouds=some), view.number, view.nuisance, view.pivot_m)
        gate_m = cls.of(rough, body, shapes_m, phi, gate_m).next_gate_m(shapes_m, phi)
        return cls.of(view, body, shapes_m, phi, gate_m)

    def following(self, shapes_m: Array, phi: Array) -> Sighting:
        """That in the first shapes (s, n, 3), which are known; itself where nothing has moved."""
        known = len(shapes_m)
        whole = np.concatenate([shapes_m, self.shapes_m[known:]])
        depth, before = self.view.depth, self.view.phi(self.start)
        moved_m = np.abs(shapes_m - self.shapes_m[:known]).max(initial=0.0)
        for k in range(known if moved_m < FRONT * depth.spacing_m else 0):
            way = self.view.world(phi, k) - self.view.world(before, k)
            moved_m = max(moved_m, np.abs(way).max(initial=0.0))
        gate_m, settled = self.next_gate_m(whole, phi), moved_m < FRONT * depth.spacing_m
        if moved_m < SAME * depth.sigma_m and gate_m == self.gate_m and self.settled:
            return self
        return Sighting.of(self.view, self.body, whole, phi, gate_m, settled)

    def missed_m(self, x: Array, phi: Array) -> Array:
        """How far (P,) parts of a first shape x (n, 3) that face the camera are from its points."""
        view, turned = self.view, self.skin.facing(x, self.view.eye_m(phi, 0), GRAZING)
        middles = x[self.skin.flat[turned]].mean(axis=1)
        limit_m = WIDE * float(np.linalg.norm(np.ptp(self.body.nodes_m, axis=0)))
        return np.minimum(KDTree(view.world(phi, 0)).query(middles)[0], limit_m)

    def next_gate_m(self, shapes_m: Array, phi: Array) -> float:
        """A narrower gate, where points are near enough to the surface for one; else its own."""
        gate_m = max(self._scatter_m(shapes_m, phi), self.view.depth.gate_m)
        return gate_m if gate_m <= NARROWER * self.gate_m else self.gate_m

    def _scatter_m(self, shapes_m: Array, phi: Array) -> float:
        """How far points of the body may be from the surface, by how far half of them are."""
        apart = []
        for k, x in enumerate(shapes_m):
            surface = np.einsum("ea,eai->ei", self.weights[k], x[self.nodes[k]])
            seen = self.view.corrected_at(phi, self.points[k], self.rays[k], k)
            apart.append(np.sum(self.normals[k] * (surface - seen), axis=1)[self.used[k]])
        all_of_them = np.abs(np.concatenate(apart))
        return SPREAD * float(np.median(all_of_them)) if len(all_of_them) else np.inf


def _seen(
    view: View,
    skin: Skin,
    body: Body,
    sample: int,
    x: Array,
    phi: Array,
    gate_m: float,
    settled: bool,
) -> dict[str, NDArray]:
    """What one sample sees: of points within the gate, and the reasons for leaving others out."""
    depth, cloud = view.depth, view.depth.clouds[sample]
    world = view.world(phi, sample)
    low, high = x.min(axis=0) - gate_m, x.max(axis=0) + gate_m
    near = np.flatnonzero(((world >= low) & (world <= high)).all(axis=1))
    rotations, _ = view.motion
    eye_m = view.eye_m(phi, sample)
    turned = np.flatnonzero(skin.facing(x, eye_m))
    near = near if len(turned) else near[:0]
    faces, places = near, np.zeros((0, 3))
    if len(near):
        faces, places = skin.nearest(x, world[near], turned)
    weights, feet, normals = skin.points(x, faces, places)
    ways = normals if eye_m is None else eye_m - feet
    seen = np.sum(normals * ways, axis=1) >= GRAZING * np.linalg.norm(ways, axis=1)
    away = world[near] - feet
    distance = np.linalg.norm(away, axis=1)
    across = np.linalg.norm(away - np.sum(away * normals, axis=1)[:, None] * normals, axis=1)
    # A point beyond an edge of what the camera sees pulls that along the way to it.
    beyond = across > BESIDE * distance + depth.sigma_m
    normals[beyond] = away[beyond] / distance[beyond, None]
    alike = np.ones(len(near), dtype=bool)
    if cloud.shape[1] == 6:
        alike = np.sum(normals * (cloud[near, 3:] @ rotations[sample].T), axis=1) >= GRAZING
    open_to = np.ones(len(near), dtype=bool)
    if settled:
        open_to = ~skin.hidden(x, eye_m, feet, FRONT * depth.spacing_m)
    checks = [distance <= gate_m, seen, alike, skin.chosen[faces], open_to]
    left = np.cumprod([np.ones(len(near), dtype=bool), *checks], axis=0)
    reasons = -np.diff(left.sum(axis=1))
    reasons[0] += len(cloud) - len(near)
    kept = distance <= gate_m
    rest_m = np.einsum("pa,pai->pi", weights, body.nodes_m[skin.nodes][skin.faces[faces]])
    return {
        "nodes": skin.faces[faces][kept],
        "weights": weights[kept],
        "normals": normals[kept],
        "points": cloud[near, :3][kept],
        "rays": view.rays[sample][near][kept],
        "places_m": rest_m[kept],
        "used": left[-1].astype(bool)[kept],
        "reasons": reasons,
    }


def alignment(view: View, skin: Skin, x: Array, sample: int) -> tuple[Array, Array]:
    """Turn (3,) and shift (3,) of the camera that bring what it sees to a shape x (n, 3).

    From where the camera is stated to be, or with what it sees there brought to the middle of the
    shape, and turned from there both ways about each axis: the best of all. What is not of the body
    is nearest to nothing.
    """
    rotations, translations = view.motion
    corners = ((x - translations[sample]) @ rotations[sample])[skin.flat]
    sides = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(sides, axis=1)
    whole = area * np.repeat(skin.chosen, len(area) // len(skin.faces))
    rng = np.random.default_rng(0)
    chosen = rng.choice(len(area), SAMPLES, p=whole / whole.sum())
    places = np.einsum("pc,pci->pi", rng.dirichlet(np.ones(3), SAMPLES), corners[chosen])
    normals = sides[chosen] / area[chosen, None]
    cloud, size = view.depth.points_m[sample], float(np.linalg.norm(np.ptp(x, axis=0)))
    tree = KDTree(cloud[:: 1 + len(cloud) // ENOUGH])
    gates = np.geomspace(REACH * size, view.depth.gate_m, ITERATIONS)
    turns = np.vstack([np.zeros(3), TURNED * np.eye(3), -TURNED * np.eye(3)])
    seen = np.asarray(tree.data)[KDTree(places).query(tree.data)[0] < gates[0]]
    shifts = [np.zeros(3), places.mean(axis=0) - seen.mean(axis=0) if len(seen) else np.zeros(3)]
    tried = [(1.0, Rotation.from_rotvec(turn), shift) for turn in turns for shift in shifts]
    for some in np.array_split(gates, 2):
        tried = [_aligned(view, tree, places, normals, some, *start) for _, *start in tried]
        tried = sorted(tried, key=lambda each: each[0])[:KEPT]
    _, turn, shift = tried[0]
    return turn.as_rotvec(), shift


def _aligned(
    view: View,
    tree: KDTree,
    places: Array,
    normals: Array,
    gates: Array,
    turn: Rotation,
    shift: Array,
) -> tuple[float, Rotation, Array]:
    """How much of the surface at (P, 3) misses the cloud, turn and shift, from some on."""
    pivot = view.pivot_m
    prior = np.concatenate([view.prior(row) for row in (DEPTH_TURN, DEPTH_SHIFT)])
    missed = 1.0
    for gate in gates:
        # Cloud points p are at R (p − c) + c + d: the surface looks for them in their own frame.
        _, found = tree.query(turn.inv().apply(places - pivot - shift) + pivot)
        moved = turn.apply(np.asarray(tree.data)[found] - pivot) + pivot + shift
        away, turned = moved - places, np.ones(len(places), dtype=bool)
        if view.depth.camera.matrix is not None:
            ways = turn.apply(-pivot) + pivot + shift - places
            turned = np.sum(normals * ways, axis=1) > GRAZING * np.linalg.norm(ways, axis=1)
        squares = np.sum(away**2, axis=1)
        missed = float(np.minimum(squares / gate**2, 1.0)[turned].mean()) if turned.any() else 1.0
        weight = np.sqrt(INDEPENDENT / max(turned.sum(), 1)) * turned / gate
        weight /= 1 + squares / (gate / 2) ** 2
        by = np.concatenate(
            [-_skew(moved - pivot - shift), np.tile(np.eye(3), (len(places), 1, 1))], axis=2
        )
        along = np.einsum("pi,pij->pj", normals, by), np.sum(normals * away, axis=1)
        rows = [along[0] * weight[:, None], *(SLIDING * by * weight[:, None, None]).swapaxes(0, 1)]
        right = [along[1] * weight, *(SLIDING * away * weight[:, None]).T]
        off = prior * np.concatenate([turn.as_rotvec(), shift])
        step = np.linalg.lstsq(
            np.concatenate([*rows, np.diag(prior)]), -np.concatenate([*right, off])
        )[0]
        turn, shift = Rotation.from_rotvec(step[:3]) * turn, shift + step[3:]
    return missed, turn, shift


def _cross(a: Array, b: Array) -> Array:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _skew(vectors: Array) -> Array:
    """(P, 3, 3) matrices of cross products with vectors (P, 3)."""
    x, y, z = vectors.T
    none = np.zeros_like(x)
    return np.stack([[none, -z, y], [z, none, -x], [-y, x, none]]).transpose(2, 0, 1)


def sightings_of(experiment: Experiment) -> tuple[Sighting, ...]:
    """Those of an experiment's depth cameras, on the undeformed body as its grasp carries it."""
    if not experiment.depths:
        return ()
    nuisance, found = NuisanceMap.of(experiment), []
    for number, depth in enumerate(experiment.depths):
        view = View.of(experiment, number, nuisance)
        nodes = Skin.of(experiment.body, depth).nodes
        shapes_m = experiment.rigid_positions(depth.times)[:, nodes]
        nothing = np.zeros(nuisance.size)
        found.append(Sighting.aligned(view, experiment.body, shapes_m, nothing))
    return tuple(found)
