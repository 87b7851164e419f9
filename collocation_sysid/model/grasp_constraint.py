"""Where the grasps hold a body's dofs, as a function of how it is off in them.

A grasped node is at U_t H(φ) X, see `nuisance`, along the axes that are held. A node of an
obstacle's frame is at U_t X, and off by what is not known of the obstacle, to first order.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array, Index
from ..recording.experiment import Experiment
from ..recording.grasp import held_dofs
from ..recording.nuisance import OBSTACLE_TILT, OBSTACLE_TIME, NuisanceRow
from ..recording.obstacle import Obstacle
from .nuisance import NuisanceMap


@dataclass(frozen=True, eq=False)
class Held:
    """Goals of the dofs that are grasped at some time, on the time grid.

    Attributes
    ----------
    dofs : (g,) ascending
    positions_m : (N, g) NaN while free
    by_phi : (N, g, m) derivatives by the φ that move the body, zero while free; m = 0 where none
        of them moves the grasps
    """

    dofs: Index
    positions_m: Array
    by_phi: Array

    @property
    def moves(self) -> bool:
        """Whether the goals depend on φ."""
        return self.by_phi.shape[2] > 0


@dataclass(frozen=True, eq=False)
class Grasping:
    """The grasps of an experiment on its time grid.

    Attributes
    ----------
    experiment : Experiment
    nuisance : NuisanceMap
    t_s : (N,)
    """

    experiment: Experiment
    nuisance: NuisanceMap
    t_s: Array

    @cached_property
    def dofs(self) -> Index:
        """(g,) dofs that are grasped at some time."""
        return held_dofs(self.experiment.grasps)

    def at(self, phi: Array) -> Held:
        """The goals at φ."""
        if not self.nuisance.moves_grasps:
            return self._fixed
        places, slopes = self.places(phi)
        turns, shifts = self.poses
        by_phi = self._zeros + np.einsum("tgj,gjk->tgk", turns, slopes)
        positions = np.einsum("tgj,gj->tg", turns, places) + shifts
        positions += self._zeros @ phi[self.nuisance.moving]
        by_phi[np.isnan(positions)] = 0.0
        return Held(self.dofs, positions, by_phi)

    def places(self, phi: Array) -> tuple[Array, Array]:
        """H X (g, 3) of the node of each grasped dof, and its slopes (g, 3, m)."""
        places, by_own = self.nuisance.in_grasps.slopes(self._own(phi), self._points)
        places[:, ~self._gripped], by_own[..., ~self._gripped] = self._points[:, ~self._gripped], 0
        slopes = np.zeros((3, len(self.nuisance.moving), places.shape[1]))
        slopes[:, self._columns] = by_own
        places, slopes = places.T[self._node], np.moveaxis(slopes, 2, 0)[self._node]
        for along, obstacle, row, axis, place in self._of_obstacles:
            if row != OBSTACLE_TIME:
                column = np.flatnonzero(self.nuisance.moving == place)[0]
                frame_m = self.experiment.body.nodes_m[obstacle.nodes]
                moved = np.broadcast_to(obstacle.direction, frame_m.shape)
                if row == OBSTACLE_TILT:
                    moved = np.cross(obstacle.across[axis], frame_m - obstacle.shape.middle_m)
                off = self.nuisance.scales[place] * np.repeat(moved, 3, axis=0)
                slopes[along, :, column] = off
                places[along] += phi[place] * off
        return places, slopes

    def curvature(self, phi: Array, weights: Array) -> Array:
        """Σ weights[t, g] ∂²goal/∂φ² (m, m), for weights (N, g) that are zero while free."""
        pulled = np.einsum("tgj,tg->gj", np.nan_to_num(self.poses[0]), weights)
        of_nodes = np.zeros_like(self._points.T)
        np.add.at(of_nodes, self._node, pulled)
        of_nodes[~self._gripped] = 0.0
        found = np.zeros((len(self.nuisance.moving),) * 2)
        second = self.nuisance.in_grasps.curvature(self._own(phi), self._points, of_nodes.T)
        found[np.ix_(self._columns, self._columns)] = second.sum(axis=2)
        return found

    def _own(self, phi: Array) -> Array:
        """The φ of the grasps."""
        return phi[self.nuisance.of_grasps]

    @property
    def _points(self) -> Array:
        """(3, nodes) X of the grasped nodes."""
        return self.experiment.body.nodes_m[self._nodes[0]].T

    @cached_property
    def _zeros(self) -> Array:
        """(N, g, m) by how much goals move with zeros of displacements and delays of obstacles."""
        found = np.zeros((len(self.t_s), len(self.dofs), len(self.nuisance.moving)))
        for number, grasp in enumerate(self.experiment.gripping):
            rows = np.flatnonzero(grasp.holds(self.t_s))
            for axis, place in zip(grasp.zero, self.nuisance.zero(number), strict=False):
                along = np.searchsorted(self.dofs, 3 * grasp.nodes + "xyz".index(axis))
                column = np.flatnonzero(self.nuisance.moving == place)
                found[np.ix_(rows, along, column)] = self.nuisance.scales[place]
        beside_s = 0.5e-3 * self.experiment.timestep_s
        for along, obstacle, row, _, place in self._of_obstacles:
            if row == OBSTACLE_TIME:
                places_m = self.experiment.body.nodes_m[obstacle.nodes]
                after, before = (
                    obstacle.poses.carry(places_m, self.t_s + s) for s in (beside_s, -beside_s)
                )
                rate = (before - after).reshape(len(self.t_s), -1) / (2 * beside_s)
                column = np.flatnonzero(self.nuisance.moving == place)
                found[:, along, column] = self.nuisance.scales[place] * rate
        return found

    @property
    def _of_obstacles(self) -> Iterator[tuple[Index, Obstacle, NuisanceRow, int, int]]:
        """What is not known of obstacles: dofs, row, axis, and position in φ."""
        for number, obstacle in enumerate(self.experiment.obstacles, len(self.experiment.gripping)):
            along = np.searchsorted(self.dofs, obstacle.dofs)
            for row, axis, place in self.nuisance.of_obstacle(number):
                yield along, obstacle, row, axis, place

    @cached_property
    def _gripped(self) -> NDArray[np.bool_]:
        """Which of the nodes that are grasped are the body's."""
        return ~np.isin(self._nodes[0], self.experiment.body.frames)

    @cached_property
    def _nodes(self) -> tuple[Index, Index]:
        """Nodes that are grasped at some time, and of each dof the place of its node in them."""
        nodes, places = np.unique(self.dofs // 3, return_inverse=True)
        return nodes, places

    @property
    def _node(self) -> Index:
        return self._nodes[1]

    @property
    def _columns(self) -> Index:
        """Among the φ that move the body, those that move it in its grasps."""
        return np.flatnonzero(np.isin(self.nuisance.moving, self.nuisance.of_grasps))

    @cached_property
    def _fixed(self) -> Held:
        held = self.experiment.grasped(self.t_s)[1].reshape(len(self.t_s), -1)
        return Held(self.dofs, held[:, self.dofs], np.zeros((len(held), len(self.dofs), 0)))

    @cached_property
    def poses(self) -> tuple[Array, Array]:
        """Of each dof its row of U_t, (N, g, 3) and (N, g), NaN while free."""
        turns, shifts = (np.full((len(self.t_s), len(self.dofs), *s), np.nan) for s in ((3,), ()))
        for grasp in self.experiment.grasps:
            here = np.flatnonzero(grasp.holds(self.t_s))
            place, axis = np.searchsorted(self.dofs, grasp.dofs), grasp.dofs % 3
            turned, moved = grasp.poses.at(self.t_s[here])
            turns[np.ix_(here, place)] = turned[:, axis]
            shifts[np.ix_(here, place)] = moved[:, axis]
        return turns, shifts
