"""Prescribed displacements of grasped nodes, as a function of the nuisance parameters φ.

A grasped node is at U_t H(φ) C(φ) X, along the held axes, with the pose U_t of the gripper, the
motion H of the body in its grasp, and the turn C of a clamp (see `nuisance_map`). A node of an
obstacle's frame is at U_t X, displaced to first order by the nuisance parameters of the obstacle.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..common.array_types import Array, Index
from ..recording.deviation import Deviation
from ..recording.experiment import Experiment
from ..recording.grasp import prescribed_dofs
from ..recording.nuisance import OBSTACLE_TILT, OBSTACLE_TIME
from ..recording.obstacle import Obstacle
from .nuisance_map import NuisanceMap


@dataclass(frozen=True, eq=False)
class PrescribedDisplacements:
    """Prescribed positions of the dofs that are grasped at some time, on the time grid."""

    dofs: Index  # (g,): indices of these dofs, ascending
    positions_m: Array  # (N, g): prescribed positions; NaN while a dof is free
    # (N, g, m): derivatives by the m nuisance parameters that affect the motion, zero while a dof
    # is free; m = 0 if none of them affects the grasps.
    by_phi: Array

    @property
    def depends_on_phi(self) -> bool:
        """Whether the prescribed positions depend on φ."""
        return self.by_phi.shape[2] > 0


@dataclass(frozen=True, eq=False)
class GraspConstraint:
    """Grasps of an experiment on its time grid."""

    experiment: Experiment
    nuisance: NuisanceMap
    t_s: Array  # (N,): times of the grid

    @cached_property
    def dofs(self) -> Index:
        """Indices (g,) of the dofs that are grasped at some time, ascending."""
        return prescribed_dofs(self.experiment.grasps)

    def evaluate_at(self, phi: Array) -> PrescribedDisplacements:
        """Return the prescribed positions at all nuisance parameters φ of the experiment, with
        derivatives by the m φ of the motion; positions are NaN and derivatives zero while a dof is
        free.

        φ (k,) is in prior standard deviations. If no φ affects the grasps, the result is the same
        object for all φ, without derivatives (m = 0).
        """
        if not self.nuisance.affects_grasps:
            return self._constant_positions
        places, slopes = self.displaced_nodes(phi)
        rotations, shifts = self.pose_rows
        by_phi = self._direct_derivatives + np.einsum("tgj,gjk->tgk", rotations, slopes)
        positions = np.einsum("tgj,gj->tg", rotations, places) + shifts
        positions += self._direct_derivatives @ phi[self.nuisance.motion_indices]
        by_phi[np.isnan(positions)] = 0.0
        return PrescribedDisplacements(self.dofs, positions, by_phi=by_phi)

    def displaced_nodes(self, phi: Array) -> tuple[Array, Array]:
        """Return for each grasped dof the displaced place of its node (g, 3) [m], in the frame of
        its grasp, and the derivatives (g, 3, m) by the m φ of the motion.

        It is H C X with the hand–eye transform H and the turn C of its grasp for a node of the body.
        A node of an obstacle's frame is at X, displaced to first order by offset and tilt of the
        obstacle; the delay of an obstacle and the zeros of displacements are not included.
        """
        places, by_own = self.nuisance.grasp_motion.evaluate_with_jacobian(
            self._phi_of_grasps(phi), self._motion_data
        )
        places[:, ~self._is_body_node] = self._find_points()[:, ~self._is_body_node]
        by_own[..., ~self._is_body_node] = 0
        slopes = np.zeros((3, len(self.nuisance.motion_indices), places.shape[1]))
        slopes[:, self._find_columns()] = by_own
        places = places.T[self._nodes[1]]
        slopes = np.moveaxis(slopes, 2, 0)[self._nodes[1]]
        for columns, obstacle, row, axis, place in self._iterate_obstacle_parameters():
            if row != OBSTACLE_TIME:
                column = np.flatnonzero(self.nuisance.motion_indices == place)[0]
                frame_m = self.experiment.body.nodes_m[obstacle.nodes]
                directions = np.broadcast_to(obstacle.offset_direction, frame_m.shape)
                if row == OBSTACLE_TILT:
                    directions = np.cross(
                        obstacle.tilt_axes[axis], frame_m - obstacle.shape.tilt_centre_m
                    )
                displacement = self.nuisance.scales[place] * np.repeat(directions, 3, axis=0)
                slopes[columns, :, column] = displacement
                places[columns] += phi[place] * displacement
        return places, slopes

    def weighted_hessian(self, phi: Array, weights: Array) -> Array:
        """Return Σ weights[t, g] ∂²position/∂φ² (m, m) by the φ of the motion, for weights (N, g)
        that are zero while a dof is free.
        """
        point_weights = np.einsum("tgj,tg->gj", np.nan_to_num(self.pose_rows[0]), weights)
        node_weights = np.zeros_like(self._find_points().T)
        np.add.at(node_weights, self._nodes[1], point_weights)
        node_weights[~self._is_body_node] = 0.0
        hessian = np.zeros((len(self.nuisance.motion_indices),) * 2)
        second = self.nuisance.grasp_motion.weighted_hessian(
            self._phi_of_grasps(phi), self._motion_data, weights=node_weights.T
        )
        hessian[np.ix_(self._find_columns(), self._find_columns())] = second.sum(axis=2)
        return hessian

    def _phi_of_grasps(self, phi: Array) -> Array:
        """Return the nuisance parameters of the hand–eye transform H, from all φ."""
        return phi[self.nuisance.grasp_indices]

    def _find_points(self) -> Array:
        """Return the undeformed positions X (3, nodes) of the grasped nodes [m]."""
        return self.experiment.body.nodes_m[self._nodes[0]].T

    @cached_property
    def _motion_data(self) -> Array:
        """Data (3 + G, nodes) of the motion of the grasped nodes, each of the first grasp with it."""
        data = self.nuisance.grasp_motion_data(self._find_points())
        is_other = np.ones(data.shape[1], dtype=bool)
        for number, grasp in enumerate(self.experiment.body_grasps):
            own = np.isin(self._nodes[0], grasp.nodes) & is_other
            data[3 + number, own] = 1.0
            is_other &= ~own
        return data

    @cached_property
    def _direct_derivatives(self) -> Array:
        """∂positions (N, g, m) by zeros, strain and delays, which enter to first order."""
        derivatives = np.zeros((len(self.t_s), len(self.dofs), len(self.nuisance.motion_indices)))
        for number, grasp in enumerate(self.experiment.body_grasps):
            rows = np.flatnonzero(grasp.is_active(self.t_s))
            for axis, place in zip(
                grasp.zero, self.nuisance.displacement_zero_indices(number), strict=False
            ):
                columns = np.searchsorted(self.dofs, 3 * grasp.nodes + "xyz".index(axis))
                column = np.flatnonzero(self.nuisance.motion_indices == place)
                derivatives[np.ix_(rows, columns, column)] = self.nuisance.scales[place]
            for place in self.nuisance.strain_zero_indices:
                columns = np.searchsorted(self.dofs, grasp.prescribed_dofs)
                column = np.flatnonzero(self.nuisance.motion_indices == place)
                shifts_m = np.tile(self.nuisance.strain_shifts_m[number], len(grasp.nodes))
                own_m = shifts_m.reshape(-1, 3)[:, grasp.axis_indices].ravel()
                derivatives[np.ix_(rows, columns, column)] = (
                    self.nuisance.scales[place] * own_m[None, :, None]
                )
        half_interval_s = 0.5e-3 * self.experiment.timestep_s
        for columns, obstacle, row, _, place in self._iterate_obstacle_parameters():
            if row == OBSTACLE_TIME:
                places_m = self.experiment.body.nodes_m[obstacle.nodes]
                after, before = (
                    obstacle.poses.moved_positions(places_m, self.t_s + s)
                    for s in (half_interval_s, -half_interval_s)
                )
                rate = (before - after).reshape(len(self.t_s), -1) / (2 * half_interval_s)
                column = np.flatnonzero(self.nuisance.motion_indices == place)
                derivatives[:, columns, column] = self.nuisance.scales[place] * rate
        return derivatives

    def _iterate_obstacle_parameters(self) -> Iterator[tuple[Index, Obstacle, Deviation, int, int]]:
        """Yield dofs, obstacle, row, axis and index in φ of each parameter."""
        for number, obstacle in enumerate(
            self.experiment.obstacles, len(self.experiment.body_grasps)
        ):
            columns = np.searchsorted(self.dofs, obstacle.prescribed_dofs)
            for row, axis, place in self.nuisance.obstacle_parameters(number):
                yield columns, obstacle, row, axis, place

    @cached_property
    def _is_body_node(self) -> NDArray[np.bool_]:
        """Mask of the grasped nodes that belong to the body, not to an obstacle's frame."""
        return ~np.isin(self._nodes[0], self.experiment.body.frames)

    @cached_property
    def _nodes(self) -> tuple[Index, Index]:
        """Nodes grasped at some time, and the index of its node for each grasped dof."""
        nodes, places = np.unique(self.dofs // 3, return_inverse=True)
        return nodes, places

    def _find_columns(self) -> Index:
        """Return the positions of the parameters of H among those that affect the motion."""
        return np.flatnonzero(np.isin(self.nuisance.motion_indices, self.nuisance.grasp_indices))

    @cached_property
    def _constant_positions(self) -> PrescribedDisplacements:
        """Prescribed positions where they do not depend on φ, with derivatives (N, g, 0)."""
        goals_m = self.experiment.prescribed_displacements(self.t_s)[1].reshape(len(self.t_s), -1)
        return PrescribedDisplacements(
            self.dofs, goals_m[:, self.dofs], by_phi=np.zeros((len(goals_m), len(self.dofs), 0))
        )

    @cached_property
    def pose_rows(self) -> tuple[Array, Array]:
        """Row of the pose U_t for each of the g grasped dofs: rotation (N, g, 3) and shift (N, g)
        [m], so that the position is rotation · H C X + shift; NaN while the dof is free.
        """
        rotations, shifts_m = (
            np.full((len(self.t_s), len(self.dofs), *s), np.nan) for s in ((3,), ())
        )
        for grasp in self.experiment.grasps:
            times = np.flatnonzero(grasp.is_active(self.t_s))
            place = np.searchsorted(self.dofs, grasp.prescribed_dofs)
            axis = grasp.prescribed_dofs % 3
            pose_rotations, pose_shifts = grasp.poses.at(self.t_s[times])
            rotations[np.ix_(times, place)] = pose_rotations[:, axis]
            nodes_m = self.experiment.body.nodes_m[grasp.nodes]
            moved_m = grasp.poses.deformation_at(nodes_m, self.t_s[times])[..., grasp.axis_indices]
            shifts_m[np.ix_(times, place)] = pose_shifts[:, axis] + moved_m.reshape(len(times), -1)
        return rotations, shifts_m
