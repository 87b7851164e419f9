"""Where the points that a depth camera sees lie on the surface of the body.

Nothing is labelled. A point belongs to the nearest of the surface, in the shape and with the pose
of the camera that are known so far; a `Sighting` says which for every sample. As estimates move on
it follows, as charts of markers' places do. Between, residuals along the normals there are smooth.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ..arrays import Array, Index
from ..fem.body import Body
from ..model.nuisance import NuisanceMap
from ..recording.experiment import Experiment
from .camera_alignment import alignment, thinned
from .skin import GRAZING, Skin
from .view import View

# Off an edge the way to the nearest point leaves the normal by more than this share of itself.
BESIDE = 0.5
# Share of the body's size that points may be off by before anything is fitted; later so many
# times the median, where that narrows the gate by a share.
WIDE, SPREAD, NARROWER = 0.25, 6.0, 0.8
# What moved by less than this share of sigma is where it was.
SAME = 0.2
# An alignment farther than this many deviations of its prior is of something else.
FARTHEST = 4.0
LEFT_OUT = ("far", "grazing", "turned away", "not chosen", "hidden")
# What is in front by less than this share of the spacing of points is beside it, and a shape that
# moves by less has settled.
FRONT = 0.5


def wide_m(shape_m: Array) -> float:
    """How far points of a body of this shape (n, 3) may be off before anything is fitted."""
    return WIDE * float(np.linalg.norm(np.ptp(shape_m, axis=0)))


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
        gate_m = max(wide_m(body.nodes_m), view.depth.gate_m)
        phi = phi if far else moved
        some = tuple(map(thinned, view.depth.clouds))
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
        apart_m, _ = KDTree(view.world(phi, 0)).query(middles)
        return np.minimum(apart_m, wide_m(self.body.nodes_m))

    def next_gate_m(self, shapes_m: Array, phi: Array) -> float:
        """A narrower gate, where points are near enough to the surface for one; else its own."""
        gate_m = max(self._scatter_m(shapes_m, phi), self.view.depth.gate_m)
        return gate_m if gate_m <= NARROWER * self.gate_m else self.gate_m

    def _scatter_m(self, shapes_m: Array, phi: Array) -> float:
        """How far points of the body may be from the surface, by how far half of them are."""
        apart_m = self.apart_m(shapes_m, phi)
        all_of_them = np.abs(apart_m[np.isfinite(apart_m)])
        return SPREAD * float(np.median(all_of_them)) if len(all_of_them) else np.inf

    def apart_m(self, shapes_m: Array, phi: Array) -> Array:
        """Return how far points (S, E) are behind shapes (S, n, 3), along the normals.

        NaN where a point does not count.
        """
        apart_m = np.full(self.used.shape, np.nan)
        for k, x in enumerate(shapes_m):
            surface = np.einsum("ea,eai->ei", self.weights[k], x[self.nodes[k]])
            seen = self.view.corrected_at(phi, self.points[k], self.rays[k], k)
            behind_m = np.sum(self.normals[k] * (surface - seen), axis=1)
            apart_m[k] = np.where(self.used[k], behind_m, np.nan)
        return apart_m


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
    world, eye_m = view.world(phi, sample), view.eye_m(phi, sample)
    near, faces, places = _near(world, skin, x, eye_m, gate_m)
    weights, feet, normals = skin.points(x, faces, places)
    ways = normals if eye_m is None else eye_m - feet
    seen = np.sum(normals * ways, axis=1) >= GRAZING * np.linalg.norm(ways, axis=1)
    away = world[near] - feet
    distance = np.linalg.norm(away, axis=1)
    across = np.linalg.norm(away - np.sum(away * normals, axis=1)[:, None] * normals, axis=1)
    # A point beyond an edge of what the camera sees pulls that along the way to it.
    beyond = across > BESIDE * distance + depth.sigma_m
    normals[beyond] = away[beyond] / distance[beyond, None]
    alike = open_to = everywhere = np.ones(len(near), dtype=bool)
    if cloud.shape[1] == 6:
        measured = cloud[near, 3:] @ view.motion[0][sample].T
        alike = np.sum(normals * measured, axis=1) >= GRAZING
    if settled:
        open_to = ~skin.hidden(x, eye_m, feet, FRONT * depth.spacing_m)
    kept = distance <= gate_m
    left = np.cumprod([everywhere, kept, seen, alike, skin.chosen[faces], open_to], axis=0)
    reasons = -np.diff(left.sum(axis=1))
    reasons[0] += len(cloud) - len(near)
    rest_m = np.einsum("pa,pai->pi", weights, body.nodes_m[skin.nodes][skin.faces[faces]])
    of_points = {
        "nodes": skin.faces[faces],
        "weights": weights,
        "normals": normals,
        "points": cloud[near, :3],
        "rays": view.rays[sample][near],
        "places_m": rest_m,
        "used": left[-1].astype(bool),
    }
    return {name: each[kept] for name, each in of_points.items()} | {"reasons": reasons}


def _near(
    world: Array, skin: Skin, x: Array, eye_m: Array | None, gate_m: float
) -> tuple[Index, Index, Array]:
    """Points about a shape, and the nearest of what faces the camera: faces and places on them."""
    low, high = x.min(axis=0) - gate_m, x.max(axis=0) + gate_m
    near = np.flatnonzero(((world >= low) & (world <= high)).all(axis=1))
    turned = np.flatnonzero(skin.facing(x, eye_m))
    if not len(turned) or not len(near):
        return near[:0], near[:0], np.zeros((0, 3))
    return near, *skin.nearest(x, world[near], turned)


def sightings_of(experiment: Experiment) -> tuple[Sighting, ...]:
    """Those of an experiment's depth cameras, on the undeformed body as its grasp carries it."""
    if not experiment.depths:
        return ()
    nuisance, sightings = NuisanceMap.of(experiment), []
    for number, depth in enumerate(experiment.depths):
        view = View.of(experiment, number, nuisance)
        nodes = Skin.of(experiment.body, depth).nodes
        shapes_m = experiment.rigid_positions(depth.times)[:, nodes]
        nothing = np.zeros(nuisance.size)
        sightings.append(Sighting.aligned(view, experiment.body, shapes_m, nothing))
    return tuple(sightings)
