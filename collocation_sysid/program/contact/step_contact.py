"""Contact within one time step, restricted to the points that may touch.

Other points of the surface contribute nothing, and obstacles do not move while the step is solved.
Candidate points are therefore searched once a step, with a margin, and only the forces on the nodes
of their faces are evaluated, with exact derivatives for Newton's method.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np

from ...common.array_types import Array, Index
from ...fem.contact_surface import VECTORS_PER_POINT
from ...fem.pattern import SymmetricPattern, dofs_of
from ...model.contact import POINT_BATCH, Contact, ContactLaw

# Distance within which points are candidates, in edges of the surface.
MARGIN = 0.25
# Share of this distance by which a coordinate may change before candidates are searched again.
CHANGE = 1 / 3


@dataclass(frozen=True, eq=False)
class ContactCandidates:
    """Contact points that an obstacle may touch in a time step.

    Attributes
    ----------
    law : ContactLaw
        Contact law of the obstacle.
    point_indices : (i,) array
        Indices of the points among all contact points.
    nodes : (i, k) array
        Nodes of the face of each point.
    weights : (i, k) array
        Shape functions of these nodes.
    dofs : (i, 3k) array
        Dofs of these nodes.
    entries : (i, 3k, 3k) array
        Positions of the pairs of dofs in the pattern.
    symmetric_factors, skew_factors : (i, 3k, 3k) arrays
        Factors of the entries in the symmetric and the skew part of a matrix.
    """

    law: ContactLaw
    point_indices: Index
    nodes: Index
    weights: Array
    dofs: Index
    entries: Index
    symmetric_factors: Array
    skew_factors: Array

    @cached_property
    def _last_data(self) -> dict[tuple[float, bytes], Array]:
        """Data of the law at the last evaluation, by the length of the step and the frame."""
        return {}

    @staticmethod
    @lru_cache(maxsize=64)
    def from_indices(
        law: ContactLaw, pattern: SymmetricPattern, chosen: bytes
    ) -> ContactCandidates:
        """Build the candidates of an obstacle; the last 64 are cached by their arguments, because
        successive steps are similar.

        Parameters
        ----------
        law : ContactLaw
            Contact law of the obstacle.
        pattern : SymmetricPattern
            Pattern of the matrices.
        chosen : bytes
            Indices of the points among all contact points, an array of int64 as bytes.
        """
        some = np.frombuffer(chosen, dtype=np.int64)
        points = law.surface.points
        nodes = points.nodes[some, :-VECTORS_PER_POINT]
        dofs = dofs_of(nodes)
        row, column = np.broadcast_arrays(dofs[:, :, None], dofs[:, None])
        return ContactCandidates(
            law,
            some,
            nodes=nodes,
            weights=points.node_weights[some, 0, :-VECTORS_PER_POINT],
            dofs=dofs,
            entries=pattern.positions_of(row, column),
            symmetric_factors=(1 + (row == column)) / 2,
            skew_factors=np.sign(row - column) / 2,
        )

    def inputs(
        self, contact: Contact, xi: Array, nu: Array, theta: Array
    ) -> tuple[Array, Array]:
        """Return the inputs (3 or 6, i), positions and with velocity dependence velocities relative
        to the obstacle's frame, and the data (d, i) of the law's `point_force_function` at the i
        candidates.

        Parameters
        ----------
        contact : Contact
            Contact force with this law, which provides the data of the points.
        xi, nu : (3n,) arrays
            State [m] and velocity [m/s].
        theta : (k,) array
            Constants of the body.
        """
        frame = self.law.obstacle.nodes
        moving = [
            each.reshape(-1, 3)
            for each in (xi, nu)[: 1 + self.law.depends_on_velocity]
        ]
        own = [
            np.einsum("ik,ikj->ji", self.weights, x[self.nodes] - x[frame[0]])
            for x in moving
        ]
        ends = [(x[frame[1:]] - x[frame[0]]).ravel() for x in moving]
        same = np.concatenate([*ends, theta[self.law.constant_columns]])
        return own[0] if len(own) == 1 else np.concatenate(
            own
        ), self._data_with(contact, same)

    def _data_with(self, contact: Contact, same: Array) -> Array:
        """Return the data (d, i) of the law from those that are the same at all points (s,).

        The last data are stored, because the frame of the obstacle does not move within a step.
        """
        key = contact.step_s, same.tobytes()
        if key not in self._last_data:
            data = np.broadcast_to(same[:, None], (len(same), len(self.nodes)))
            self._last_data.clear()
            self._last_data[key] = np.concatenate(
                [data, contact.data_of(self.point_indices)]
            )
        return self._last_data[key]

    def assemble(self, push: Array, size: int) -> Array:
        """Return forces (size,) [N] on the dofs of a body from forces `push` (3, i) [N] on the i
        candidates; the reaction on the obstacle is left out.
        """
        on_nodes = self.weights[:, :, None] * push.T[:, None]
        summed = np.bincount(
            self.dofs.ravel(), weights=on_nodes.ravel(), minlength=size
        )
        return np.asarray(summed, dtype=float)


class LinearisedContact(NamedTuple):
    """Contact forces in a time step and their derivative by the unknown positions.

    Attributes
    ----------
    force : (3n,) array
        Forces [N].
    symmetric : (m,) array
        Lower triangle of the symmetric part of the derivative [N/m].
    skew : (m,) or (0,) array
        Lower triangle of its skew part [N/m]; empty without friction or other velocity dependence.
    """

    force: Array
    symmetric: Array
    skew: Array


@dataclass(frozen=True, eq=False)
class TouchingPoints:
    """Candidates of one obstacle with a contact force, and these forces.

    Attributes
    ----------
    candidates : ContactCandidates
        All candidates of the obstacle.
    indices : (t,) array
        Indices of the points among the candidates.
    force : (3, t) array
        Forces on the points [N].
    slopes : (3, 3, i) or (3, 6, i) array
        Derivatives of the forces on all candidates by their positions and, if the law depends on
        them, their velocities.
    rates : (float, float)
        Derivatives of ξ and of ν by the unknown positions.
    """

    candidates: ContactCandidates
    indices: Index
    force: Array
    slopes: Array
    rates: tuple[float, float]

    @cached_property
    def slope(self) -> Array:
        """Derivative (3, 3, t) of the force by the unknown position of the point [N/m]."""
        slope = self.rates[0] * self.slopes[:, :3, self.indices]
        if self.candidates.law.depends_on_velocity:
            slope += self.rates[1] * self.slopes[:, 3:, self.indices]
        return slope


class StepContact:
    """Contact in one time step of a body with constants θ (k,).

    Obstacles are treated as fixed in the derivatives. The candidates are stored, and searched again
    when the state has changed too much.

    Attributes
    ----------
    acts : bool
        Whether there are contact forces at all.
    dof_count : int
        Number 3n of dofs.

    Parameters
    ----------
    contacts : sequence of Contact
        Contact forces; may be empty.
    theta : (k,) array
        Constants of the body.
    pattern : SymmetricPattern
        Pattern of the matrices.
    """

    def __init__(
        self,
        contacts: Sequence[Contact],
        theta: Array,
        pattern: SymmetricPattern,
    ) -> None:
        self._contacts = contacts
        self._theta = theta
        self._pattern = pattern
        self._from = np.full((1, 1), np.nan)
        self._candidates_of_contacts = list[tuple[Contact, ContactCandidates]]()
        edges_m = [each.law_of_contact.surface.edge_m for each in contacts]
        self.acts = bool(contacts)
        self.dof_count = pattern.size
        self._margin_m = MARGIN * min(edges_m, default=0.0)
        # A pressure that is averaged over a step depends on the states at both ends.
        self._half_s = max((each.step_s for each in contacts), default=0.0) / 2

    def force(self, xi: Array, nu: Array) -> Array:
        """Return the contact forces (3n,) [N] at ξ [m] and ν [m/s], each (1, 3n); zero without
        contact.
        """
        force = np.zeros(xi.size)
        for candidates, u, data in self._candidates(xi[0], nu[0]):
            force += candidates.assemble(
                candidates.law.point_force_function.evaluate(u, data), xi.size
            )
        return force

    def linearise(
        self, xi: Array, nu: Array, rates: tuple[float, float]
    ) -> LinearisedContact:
        """Return the contact forces at ξ and ν, and their derivative by the unknown positions.

        Parameters
        ----------
        xi, nu : (1, 3n) arrays
            State [m] and velocity [m/s].
        rates : (float, float)
            Derivatives of ξ and of ν [1/s] by the unknown positions.
        """
        force = np.zeros(xi.size)
        has_friction = any(
            each.law_of_contact.depends_on_velocity for each in self._contacts
        )
        symmetric = np.zeros(self._pattern.entry_count)
        skew = np.zeros(self._pattern.entry_count * has_friction)
        for candidates, u, data in self._candidates(xi[0], nu[0]):
            push, slopes = (
                candidates.law.point_force_function.evaluate_with_jacobian(
                    u, data
                )
            )
            force += candidates.assemble(push, xi.size)
            (touch,) = np.nonzero(push.any(axis=0))
            by_way = rates[0] * slopes[:, :3, touch]
            if candidates.law.depends_on_velocity:
                by_way += rates[1] * slopes[:, 3:, touch]
            weights = candidates.weights[touch]
            here = candidates.entries[touch].ravel()
            blocks = np.einsum("pa,ijp,pb->paibj", weights, by_way, weights)
            blocks = blocks.reshape(candidates.entries[touch].shape)
            counted = (candidates.symmetric_factors, candidates.skew_factors)[
                : 1 + candidates.law.depends_on_velocity
            ]
            for part, counts in zip((symmetric, skew), counted, strict=False):
                part += np.bincount(
                    here,
                    weights=(counts[touch] * blocks).ravel(),
                    minlength=len(part),
                )
        return LinearisedContact(force, symmetric, skew=skew)

    def touching_points(
        self, xi: Array, nu: Array, rates: tuple[float, float]
    ) -> list[TouchingPoints]:
        """Return the points that touch at ξ and ν, (1, 3n) each, for each obstacle with candidates.

        Parameters
        ----------
        xi, nu : (1, 3n) arrays
            State [m] and velocity [m/s].
        rates : (float, float)
            Derivatives of ξ and of ν by the unknown positions.
        """
        touching = []
        for candidates, u, data in self._candidates(xi[0], nu[0]):
            law = candidates.law
            force, slopes = law.point_force_function.evaluate_with_jacobian(
                u, data
            )
            (touch,) = np.nonzero(force.any(axis=0))
            touching.append(
                TouchingPoints(
                    candidates,
                    touch,
                    force=force[:, touch],
                    slopes=slopes,
                    rates=rates,
                )
            )
        return touching

    def _candidates(
        self, xi: Array, nu: Array
    ) -> Iterator[tuple[ContactCandidates, Array, Array]]:
        """Yield for each contact its candidates, and the inputs and data of its law at ξ and ν,
        (3n,) each.

        The search for candidates is repeated if the state has changed by more than the margin
        allows.
        """
        ends = xi[None]
        if self._half_s:
            half_step = self._half_s * nu
            ends = np.array([xi - half_step, xi + half_step])
        if not np.abs(ends - self._from).max() <= CHANGE * self._margin_m:
            self._from = ends
            self._candidates_of_contacts = []
            for each in self._contacts:
                gaps = each.law_of_contact.gaps(each.points.vectors(ends)).min(
                    axis=0
                )
                is_near = gaps < each.law_of_contact.widths_m + self._margin_m
                # Others fill the last vector of the compiled law.
                (others,) = np.nonzero(~is_near)
                is_near[others[: -is_near.sum() % POINT_BATCH]] = True
                (chosen,) = np.nonzero(is_near)
                if len(chosen):
                    candidates = ContactCandidates.from_indices(
                        each.law_of_contact,
                        self._pattern,
                        chosen=chosen.tobytes(),
                    )
                    self._candidates_of_contacts.append((each, candidates))
        for contact, candidates in self._candidates_of_contacts:
            yield (
                candidates,
                *candidates.inputs(contact, xi, nu=nu, theta=self._theta),
            )
