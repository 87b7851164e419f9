"""The same program with all that follows as variables, for methods that want it as matrices.

What the points of a body with memory carry follows from positions and parameters, so that without
it ∂g/∂z would be filled below the diagonal; and a measured wrench is a function of what grasps
give, so that the loss would be one of all that moves around them. Here both stand in z behind what
the program has, and their equations in g after all other rows, see `overstress`, `reaction_rows`
and `wrench_rows`: ∂g/∂z and the Lagrangian's Hessian are sparse, and exact. Eliminating both leads
back to the program as it is given, with the same optimum and the same multipliers of its rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from functools import cached_property

import numpy as np

from ..arrays import Array, Index
from .addition import Addition, Places
from .collocation import Collocation, Part
from .entries import Entries
from .overstress import Overstress
from .reaction_rows import Reactions
from .segment import Segment, Weights
from .wrench_channel import GraspWrench
from .wrench_rows import WrenchRows


def made_explicit(collocation: Collocation) -> Collocation:
    """The program with memory and wrenches as variables; itself where it has neither."""
    if not (collocation.remembers or any(s.sensors for s in collocation.segments)):
        return collocation
    options = {f.name: getattr(collocation, f.name) for f in fields(collocation)}
    made = Explicit(**options)
    vars(made)["plain"] = collocation
    return made


def carried_over(z: Array, of: Collocation, to: Collocation) -> Array:
    """Variables of one of the two programs as the other has them."""
    return z if of.variables == to.variables else to.pack(*of.unpack(z))


class Explicit(Collocation):
    """A collocation NLP that has the memory of its bodies, and wrenches, among its variables."""

    @cached_property
    def plain(self) -> Collocation:
        """The program as it is given."""
        return Collocation(**{f.name: getattr(self, f.name) for f in fields(self)})

    @cached_property
    def segments(self) -> tuple[Segment, ...]:
        """One of each experiment that is fitted."""
        return self.plain.segments

    @cached_property
    def additions(self) -> tuple[Addition, ...]:
        """What is added, experiment by experiment."""
        found: list[Addition] = []
        places = Places(self.plain.variables, self.plain.constraints)
        for number, segment in enumerate(self.segments):
            reactions, here = None, (segment, number, self.of_phi.start)
            wrenches = [
                (k, reading, reading.channel)
                for k, reading in enumerate(segment.readings)
                if isinstance(reading.channel, GraspWrench) and reading.channel.count
            ]
            if wrenches:
                reactions = Reactions(*here, places)
                found.append(reactions)
                places = reactions.after
            if segment.body.remembers:
                found.append(Overstress(*here, places, reactions))
                places = found[-1].after
            for wrench in wrenches:
                assert reactions is not None
                found.append(WrenchRows(*here, places, *wrench, reactions))
                places = found[-1].after
        return tuple(found)

    def added(self, *kinds: type[Addition]) -> int:
        """Number of the variables of some kinds, and of their equations."""
        return sum(each.count for each in self.additions if isinstance(each, kinds))

    @property
    def further_nonzeros(self) -> tuple[int, int]:
        """Entries that Jacobian and Hessian have for all this."""
        both = [each.nonzeros for each in self.additions]
        return sum(each for each, _ in both), sum(each for _, each in both)

    @property
    def variables(self) -> int:
        """Length of z."""
        return self.plain.variables + self.added(Addition)

    @property
    def constraints(self) -> int:
        """Length of g."""
        return self.plain.constraints + self.added(Addition)

    @property
    def remembers(self) -> bool:
        """Nothing that is not in z."""
        return False

    def pack(self, p: Array, positions: Sequence[Array]) -> Array:
        """Variables z from parameters and positions, the others as they follow from them."""
        parts = self.plain.parts_at(p, positions)
        following = [each.following(parts[each.number]) for each in self.additions]
        return np.concatenate([self.plain.pack(p, positions), *following])

    def parts(self, z: Array) -> list[Part]:
        """Every experiment at z, with the memory and the wrenches there."""
        parts = super().parts(z)
        for each in self.additions:
            parts[each.number] = each.given(parts[each.number], z)
        return parts

    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of z; equal for what is given."""
        lower, upper = self.plain.bounds()
        free = np.full(self.added(Addition), np.inf)
        return np.concatenate([lower, -free]), np.concatenate([upper, free])

    def gradient(self, z: Array) -> Array:
        """∂objective/∂z."""
        parts = self.parts(z)
        further = [self.loss_scale * each.gradient(parts[each.number]) for each in self.additions]
        return np.concatenate([self.plain.gradient_of(parts, self.parameters_of(z)), *further])

    def constraint_values(self, z: Array) -> Array:
        """g, scaled."""
        parts = self.parts(z)
        found = [each.values(parts[each.number], z) for each in self.additions]
        return np.concatenate([super().constraint_values(z), *found])

    # Matrices -----------------------------------------------------------------------------------

    @cached_property
    def _jacobian(self) -> Entries:
        further = [each.jacobian_entries() for each in self.additions]
        shape = self.constraints, self.variables
        return Entries.of(self.plain.jacobian_structure, shape, further)

    @cached_property
    def _hessian(self) -> Entries:
        further = [each.hessian_entries() for each in self.additions]
        shape = self.variables, self.variables
        return Entries.of(self.plain.hessian_structure, shape, further)

    def constraints_and_jacobian(self, z: Array, out: Array | None = None) -> tuple[Array, Array]:
        """Constraints g and the values of ∂g/∂z, from one evaluation of the elements."""
        values, own = self._jacobian.values(out, len(self.plain.jacobian_structure[1]))
        parts = self.parts(z)
        rows, _ = self.plain.linearised(parts, own)
        found = [each.jacobian_values(parts[each.number], z) for each in self.additions]
        self._jacobian.fill(values, own, [further for _, further in found])
        return np.concatenate([rows, *(equations for equations, _ in found)]), values

    @cached_property
    def hessian_diagonals(self) -> tuple[Index, Index]:
        """Positions of the diagonal entries of q, and of x, in the values of the Hessian."""
        return self.plain.hessian_diagonals

    def hessian_values(
        self, z: Array, loss_weight: float, multipliers: Array | None, out: Array | None = None
    ) -> Array:
        """Values of ∇²_z (loss_weight · objective + multipliers · g), upper triangle."""
        parts, multipliers = self.bending(z, multipliers)
        weights = self._weights(multipliers)
        of_memory = {
            each.number: each.weights(multipliers)
            for each in self.additions
            if isinstance(each, Overstress)
        }
        values, own = self._hessian.values(out, len(self.plain.hessian_structure[1]))
        self.plain.curved(parts, loss_weight, weights, own, of_memory)
        scaled, further = loss_weight * self.loss_scale, []
        for each in self.additions:
            here = parts[each.number], z, scaled, multipliers
            further.append(each.hessian_values(*here, weights[each.number]))
            size = len(parts[each.number].phi)
            curvature = np.broadcast_to(each.phi_curvature(*here), (size, size))
            own[self.plain.hessian_phi(each.number)] += curvature[np.triu_indices(size)]
        self._hessian.fill(values, own, further)
        return values

    def _weights(self, multipliers: Array) -> list[Weights]:
        """Of the rows of each experiment, those of its reactions among them."""
        of_reactions = {
            each.number: each.weights(multipliers)
            for each in self.additions
            if isinstance(each, Reactions)
        }
        return [
            segment.weights(multipliers[segment.rows], of_reactions.get(number, 0.0))
            for number, segment in enumerate(self.segments)
        ]
