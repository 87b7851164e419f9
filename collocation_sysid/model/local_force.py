"""Local forces: stiff forces in one time step on few points of a body, which change.

The stiffness of a local force changes with every point at which it begins or ceases to act, whereas
that of the rest of the body hardly changes from one step to the next. A time step is therefore
solved with local forces condensed to the dofs of these points, see
`program.forward.condensed_steps`. A term of the equations of motion declares that it is local, and
how it acts in a step, by `ForceTerm.is_local` and `ForceTerm.local_force`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..common.array_types import Array, Index
from ..fem.pattern import SymmetricPattern, dofs_of


@dataclass(frozen=True, eq=False)
class CandidatePoints:
    """Points of a body on which a local force may act in a time step."""

    point_indices: Index  # (i,): indices of the points among all points of the force
    nodes: Index  # (i, k): nodes of the face of each point
    weights: Array  # (i, k): shape functions of these nodes
    dofs: Index  # (i, 3k): dofs of these nodes
    entries: Index  # (i, 3k, 3k): positions of the pairs of dofs in the pattern
    # (i, 3k, 3k): factors of the entries in the symmetric and the skew part of a matrix.
    symmetric_factors: Array
    skew_factors: Array

    @classmethod
    def from_nodes(
        cls, point_indices: Index, nodes: Index, weights: Array, pattern: SymmetricPattern
    ) -> CandidatePoints:
        """Return candidate points with the given nodes and weights, see the attributes, and a
        pattern that contains the couplings of these nodes.
        """
        dofs = dofs_of(nodes)
        row, column = np.broadcast_arrays(dofs[:, :, None], dofs[:, None])
        return cls(
            point_indices,
            nodes,
            weights=weights,
            dofs=dofs,
            entries=pattern.positions_of(row, column),
            symmetric_factors=(1 + (row == column)) / 2,
            skew_factors=np.sign(row - column) / 2,
        )

    @cached_property
    def all_nodes(self) -> Index:
        """Nodes (m,) of the faces of all candidates, in ascending order."""
        return np.unique(self.nodes)

    def interpolate(self, at_nodes: Array) -> Array:
        """Return the values (d, i) at the candidates of quantities (m, d) at `all_nodes`."""
        return at_nodes.T @ self._interpolation

    @cached_property
    def _interpolation(self) -> Array:
        """Weights (m, i) of `all_nodes` at the candidates."""
        weights = np.zeros((len(self.all_nodes), len(self.nodes)))
        places = np.searchsorted(self.all_nodes, self.nodes)
        columns = np.arange(len(self.nodes))[:, None]
        np.add.at(weights, (places, columns), self.weights)
        return weights

    def assemble(self, push: Array, size: int) -> Array:
        """Return forces (size,) [N] on the dofs of a body from forces `push` (3, i) [N] on the i
        candidates.
        """
        on_nodes = self.weights[:, :, None] * push.T[:, None]
        summed = np.bincount(self.dofs.ravel(), weights=on_nodes.ravel(), minlength=size)
        return np.asarray(summed, dtype=float)


@dataclass(frozen=True, eq=False)
class ActivePoints:
    """Candidates on which a local force acts, and the force on them."""

    source: Hashable  # identifies the force and all of its points
    candidates: CandidatePoints  # all candidates of the force
    indices: Index  # (t,): indices of the points among the candidates
    force: Array  # (3, t): forces on the points [N]
    # (3, 3, i) or (3, 6, i): derivatives of the forces on all candidates by their positions and, if
    # the force depends on them, their velocities.
    slopes: Array
    rates: tuple[float, float]  # (float, float): derivatives of ξ and of ν by the unknown positions

    @property
    def key(self) -> tuple[Hashable, bytes, bytes]:
        """Key that is equal for the same points and axes of the same force."""
        return (
            self.source,
            self.candidates.point_indices[self.indices].tobytes(),
            self.axes.tobytes(),
        )

    @property
    def axes(self) -> NDArray[np.bool_]:
        """A mask (3,) of the axes along which any force on the points acts, or by whose
        coordinates it changes; one of them for a plane without friction that is perpendicular to an
        axis.
        """
        acts = np.any(self.force, axis=1)
        if np.all(acts):
            return acts
        changes = np.any(self.slopes, axis=2).reshape(3, -1, 3)
        return acts | np.any(changes, axis=(0, 1)) | np.any(changes, axis=(1, 2))

    def assemble(self, size: int) -> Array:
        """Return the forces (size,) [N] on the dofs of a body."""
        push = np.zeros((3, len(self.candidates.point_indices)))
        push[:, self.indices] = self.force
        return self.candidates.assemble(push, size)

    @cached_property
    def slope(self) -> Array:
        """Derivative (3, 3, t) of the force by the unknown position of the point [N/m]."""
        slope = self.rates[0] * self.slopes[:, :3, self.indices]
        if self.slopes.shape[1] > 3:
            slope += self.rates[1] * self.slopes[:, 3:, self.indices]
        return slope


class LocalForce(ABC):
    """Local force of one term in one time step.

    Attributes
    ----------
    depends_on_velocity : bool
        Whether the force depends on ν, so that its derivative may have a skew part.
    """

    depends_on_velocity: bool

    @abstractmethod
    def force(self, xi: Array, nu: Array) -> Array:
        """Return the forces (3n,) [N] at ξ [m] and ν [m/s], each (1, 3n)."""

    @abstractmethod
    def active_points(
        self, xi: Array, nu: Array, rates: tuple[float, float]
    ) -> ActivePoints | None:
        """Return the points on which the force acts; None if there are no candidates.

        Parameters
        ----------
        xi, nu : (1, 3n) arrays
            State [m] and velocity [m/s].
        rates : (float, float)
            Derivatives of ξ and of ν [1/s] by the unknown positions.
        """


@dataclass(frozen=True, eq=False)
class LocalForces:
    """Sum of the local forces in one time step."""

    parts: Sequence[LocalForce]  # the forces; may be empty
    pattern: SymmetricPattern  # pattern of the matrices

    @property
    def dof_count(self) -> int:
        """Number 3n of dofs."""
        return self.pattern.size

    def force(self, xi: Array, nu: Array) -> Array:
        """Return the sum of the forces (3n,) [N] at ξ [m] and ν [m/s], each (1, 3n)."""
        total = np.zeros(xi.size)
        for part in self.parts:
            total += part.force(xi, nu)
        return total

    def linearise(
        self, xi: Array, nu: Array, rates: tuple[float, float]
    ) -> tuple[Array, Array, Array]:
        """Return the sum of the forces (3n,) [N] at ξ and ν, and the lower triangles (m,) of the
        symmetric and of the skew part of its derivative by the unknown positions [N/m]; the last is
        empty if no force depends on velocities.

        Parameters
        ----------
        xi, nu : (1, 3n) arrays
            State [m] and velocity [m/s].
        rates : (float, float)
            Derivatives of ξ and of ν [1/s] by the unknown positions.
        """
        force = np.zeros(xi.size)
        has_skew_part = any(part.depends_on_velocity for part in self.parts)
        symmetric = np.zeros(self.pattern.entry_count)
        skew = np.zeros(self.pattern.entry_count * has_skew_part)
        for points in self.active_points(xi, nu, rates):
            candidates = points.candidates
            indices = points.indices
            force += points.assemble(xi.size)
            weights = candidates.weights[indices]
            entries = candidates.entries[indices]
            blocks = np.einsum("pa,ijp,pb->paibj", weights, points.slope, weights).reshape(
                entries.shape
            )
            symmetric += np.bincount(
                entries.ravel(),
                weights=(candidates.symmetric_factors[indices] * blocks).ravel(),
                minlength=len(symmetric),
            )
            if points.slopes.shape[1] > 3:
                skew += np.bincount(
                    entries.ravel(),
                    weights=(candidates.skew_factors[indices] * blocks).ravel(),
                    minlength=len(skew),
                )
        return force, symmetric, skew

    def active_points(self, xi: Array, nu: Array, rates: tuple[float, float]) -> list[ActivePoints]:
        """Return the points on which each force with candidates acts at ξ and ν, (1, 3n) each;
        `rates` are the derivatives of both by the unknown positions.
        """
        all_points = (part.active_points(xi, nu, rates) for part in self.parts)
        return [points for points in all_points if points is not None]
