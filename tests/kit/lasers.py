"""A kind of measurement as another package would add it: the distance along a fixed laser beam."""

from __future__ import annotations

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from collocation_sysid import Body, Experiment, FollowingSensor

from .problems import hung_cube


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class LaserDistance(FollowingSensor):
    """Distance from a fixed origin to the surface of the body along a beam."""

    name: str
    t_s: np.ndarray
    values: np.ndarray | None
    sigma: float
    origin_m: tuple[float, float, float]
    direction: tuple[float, float, float]
    points_m: tuple[tuple[float, float, float], ...] = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
    unit: str = "m"

    def predict(self, at):
        """Return the distance to the plane of three nodes [m]."""
        a, b, c = ca.horzsplit(at.position_m)
        normal = ca.cross(b - a, c - a)
        return ca.dot(normal, a - ca.DM(self.origin_m)) / ca.dot(normal, ca.DM(self.direction))

    def nodes_of_samples(self, body: Body, positions_m: np.ndarray) -> np.ndarray:
        """Return the nodes (s, 3) of the nearest face that the beam hits; if it misses the body,
        those of the face whose plane it passes nearest to that face.
        """
        faces = body.mesh.surface
        return np.array([faces[self.hit(nodes_m[faces])[0]] for nodes_m in positions_m])

    def hit(self, corners_m: np.ndarray) -> tuple[int, float]:
        """Return index and distance [m] of the nearest face (F, 3, 3) that the beam hits."""
        edges = corners_m[:, 1:] - corners_m[:, :1]
        beam = np.broadcast_to(-np.array(self.direction, float), (len(edges), 3))
        matrices = np.stack([edges[:, 0], edges[:, 1], beam], axis=2)
        matrices[np.abs(np.linalg.det(matrices)) < 1e-12] = np.nan
        u, v, distance_m = np.linalg.solve(
            matrices, (np.array(self.origin_m) - corners_m[:, 0])[..., None]
        )[..., 0].T
        outside = np.nan_to_num(np.maximum(0, np.max([-u, -v, u + v - 1], axis=0)), nan=np.inf)
        face = int(np.lexsort([np.nan_to_num(distance_m, nan=np.inf), outside])[0])
        return face, float(distance_m[face])


def lit_cube(measured: bool = False) -> Experiment:
    """A hung cube without markers under two beams beside a diagonal of its face, which it crosses;
    the samples are between the grid times, and the last one is beyond the recording.
    """
    cube = hung_cube(16, (1, 1, 2))
    middle_m = cube.body.nodes_m.mean(axis=0)
    at_s = np.append(cube.t_s[:-1] + 0.3 * cube.timestep_s, cube.t_s[-1] + 1.0)
    lasers = [
        LaserDistance(
            name=name,
            t_s=at_s,
            values=np.full(len(at_s), 0.37) if measured else None,
            sigma=1e-4,
            origin_m=tuple(middle_m + np.array(way_m) - [0, 0.4, 0]),
            direction=(0.0, 1.0, 0.0),
        )
        for name, way_m in (("middle", (0, 0, 0)), ("side", (0.01, 0, 0.013)))
    ]
    return replace(cube, readings=lasers, markers=None)
