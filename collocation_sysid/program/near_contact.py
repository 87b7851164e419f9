"""Contact within a timestep, at the points that may touch in it.

All other points of a surface add nothing, and obstacles stay where they are while the step is
solved. So points are looked for once a step, with a margin, and of each force only what it does to
the nodes of its own face is evaluated: that is what Newton's method asks for, with exact slopes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ..arrays import Array, Index
from ..fem.pattern import SymmetricPattern, dofs_of
from ..fem.touching import VECTORS
from ..model.contact import Contact, ContactLaw

# Points so many edges away may come to touch, until a coordinate has changed by a third of that.
MARGIN, CHANGE = 0.25, 1 / 3


@dataclass(frozen=True, eq=False)
class NearPoints:
    """Points that an obstacle may touch.

    Attributes
    ----------
    law : ContactLaw
    chosen : (i,) indices of the points
    nodes : (i, k) of the face at each
    weights : (i, k) of these
    dofs : (i, 3k) of these
    entries : (i, 3k, 3k) of these, in a pattern
    symmetric, skew : (i, 3k, 3k) what they count in the two parts of a matrix
    """

    law: ContactLaw
    chosen: Index
    nodes: Index
    weights: Array
    dofs: Index
    entries: Index
    symmetric: Array
    skew: Array

    @staticmethod
    @lru_cache(maxsize=64)
    def of(law: ContactLaw, pattern: SymmetricPattern, chosen: bytes) -> NearPoints:
        """Some of an obstacle; those of the last few choices are kept, as steps are alike."""
        some, points = np.frombuffer(chosen, dtype=np.int64), law.surface.points
        nodes = points.nodes[some, :-VECTORS]
        dofs = dofs_of(nodes)
        row, column = np.broadcast_arrays(dofs[:, :, None], dofs[:, None])
        return NearPoints(
            law,
            some,
            nodes,
            points.mix[some, 0, :-VECTORS],
            dofs,
            pattern.position(row, column),
            (1 + (row == column)) / 2,
            np.sign(row - column) / 2,
        )

    def inputs(self, contact: Contact, xi: Array, nu: Array, theta: Array) -> tuple[Array, Array]:
        """Return the inputs of the push of a contact with this law, and its data, at ξ, ν (3n,)."""
        frame = self.law.obstacle.nodes
        moving = [each.reshape(-1, 3) for each in (xi, nu)[: 1 + self.law.by_velocity]]
        own = [np.einsum("ik,ikj->ji", self.weights, x[self.nodes] - x[frame[0]]) for x in moving]
        ends = [(x[frame[1:]] - x[frame[0]]).ravel() for x in moving]
        same = np.concatenate([*ends, theta[self.law.columns]])
        data = np.broadcast_to(same[:, None], (len(same), len(self.nodes)))
        return np.concatenate(own), np.concatenate([data, contact.data_of(self.chosen)])

    def summed(self, push: Array, size: int) -> Array:
        """(size,) on the dofs of a body, of forces (3, i) on the points."""
        on_nodes = self.weights[:, :, None] * push.T[:, None]
        summed = np.bincount(self.dofs.ravel(), weights=on_nodes.ravel(), minlength=size)
        return np.asarray(summed, dtype=float)


class NearContact:
    """Contact in a timestep of a body with constants θ (k,), with slopes on a pattern."""

    def __init__(
        self, contacts: Sequence[Contact], theta: Array, pattern: SymmetricPattern
    ) -> None:
        self._contacts, self._theta, self._pattern = contacts, theta, pattern
        self._from, self._near = np.full((2, 1), np.nan), list[tuple[Contact, NearPoints]]()
        edges_m = [each.contact.surface.edge_m for each in contacts]
        self.acts, self._margin_m = bool(contacts), MARGIN * min(edges_m, default=0.0)
        # A pressure that is averaged over a step depends on the states at both ends.
        self._half_s = max((each.step_s for each in contacts), default=0.0) / 2

    def force(self, xi: Array, nu: Array) -> Array:
        """(3n,) at ξ and ν, (1, 3n) each."""
        force = np.zeros(xi.size)
        for near, u, data in self._at(xi[0], nu[0]):
            force += near.summed(near.law.push.value(u, data), xi.size)
        return force

    def linearise(
        self, xi: Array, nu: Array, rates: tuple[float, float]
    ) -> tuple[Array, Array, Array]:
        """The same, and lower triangles of the symmetric and the skew part of its slope.

        That is by what moves ξ and ν at these rates; there is a skew one (m,), not (0,), where
        something rubs.
        """
        force = np.zeros(xi.size)
        rubs = any(each.contact.by_velocity for each in self._contacts)
        parts = np.zeros(self._pattern.entries), np.zeros(self._pattern.entries * rubs)
        for near, u, data in self._at(xi[0], nu[0]):
            push, slopes = near.law.push.slopes(u, data)
            force += near.summed(push, xi.size)
            (touch,) = np.nonzero(push.any(axis=0))
            by_way = rates[0] * slopes[:, :3, touch]
            if near.law.by_velocity:
                by_way += rates[1] * slopes[:, 3:, touch]
            weights, here = near.weights[touch], near.entries[touch].ravel()
            blocks = np.einsum("pa,ijp,pb->paibj", weights, by_way, weights)
            blocks = blocks.reshape(near.entries[touch].shape)
            counted = (near.symmetric, near.skew)[: 1 + near.law.by_velocity]
            for part, counts in zip(parts, counted, strict=False):
                part += np.bincount(
                    here, weights=(counts[touch] * blocks).ravel(), minlength=len(part)
                )
        return force, *parts

    def _at(self, xi: Array, nu: Array) -> Iterator[tuple[NearPoints, Array, Array]]:
        """What is near, with inputs and data of its law."""
        ends = np.array([xi - self._half_s * nu, xi + self._half_s * nu])
        if not np.abs(ends - self._from).max() <= CHANGE * self._margin_m:
            self._from, self._near = ends, []
            for each in self._contacts:
                gaps = each.contact.gaps(each.points.vectors(ends)).min(axis=0)
                (chosen,) = np.nonzero(gaps < each.contact.widths_m + self._margin_m)
                if len(chosen):
                    near = NearPoints.of(each.contact, self._pattern, chosen.tobytes())
                    self._near.append((each, near))
        for contact, near in self._near:
            yield near, *near.inputs(contact, xi, nu, self._theta)
