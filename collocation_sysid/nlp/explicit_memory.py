"""The same program with the memory of bodies as variables, for methods that want it as matrices.

What the points carry follows from positions and parameters, so that without it ∂g/∂z would be
filled below the diagonal. Here it stands in z between the positions and φ, and its recursion in g
after all other rows, see `overstress`: ∂g/∂z and the Lagrangian's Hessian are sparse. Eliminating
both leads back to the program as it is given, with the same optimum and the same multipliers of
its rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from functools import cached_property

import numpy as np

from ..arrays import Array, Index
from .collocation import Collocation, Part
from .overstress import Overstress, Places
from .segment import Segment
from .widened import Widened


def with_explicit_memory(collocation: Collocation) -> Collocation:
    """The program with its memory as variables; itself where no body has one."""
    if not collocation.remembers:
        return collocation
    options = {f.name: getattr(collocation, f.name) for f in fields(collocation)}
    made = ExplicitMemory(**options)
    vars(made)["plain"] = collocation
    return made


def carried_over(z: Array, of: Collocation, to: Collocation) -> Array:
    """Variables of one of the two programs as the other has them."""
    return z if of.variables == to.variables else to.pack(*of.unpack(z))


class ExplicitMemory(Collocation):
    """A collocation NLP whose bodies' memory is among its variables."""

    @cached_property
    def plain(self) -> Collocation:
        """The program as it is given."""
        return Collocation(**{f.name: getattr(self, f.name) for f in fields(self)})

    @cached_property
    def segments(self) -> tuple[Segment, ...]:
        """One of each experiment that is fitted."""
        return self.plain.segments

    @cached_property
    def memories(self) -> dict[int, Overstress]:
        """What the bodies with memory carry, by the number of their segment."""
        found: dict[int, Overstress] = {}
        places = Places(self.segments[-1].after.x, self.plain.constraints)
        for number, segment in enumerate(self.segments):
            if segment.body.remembers:
                found[number] = Overstress(segment, places)
                places = found[number].after
        return found

    @property
    def overstresses(self) -> int:
        """Number of the variables added, and of the equations."""
        return sum(memory.count for memory in self.memories.values())

    @property
    def further_nonzeros(self) -> tuple[int, int]:
        """Entries that Jacobian and Hessian have for it, without laying them out."""
        of_memories = [memory.nonzeros for memory in self.memories.values()]
        jacobian, hessian = (sum(each) for each in zip(*of_memories, strict=True))
        return jacobian, hessian

    @property
    def variables(self) -> int:
        """Length of z."""
        return self.plain.variables + self.overstresses

    @property
    def constraints(self) -> int:
        """Length of g."""
        return self.plain.constraints + self.overstresses

    @property
    def remembers(self) -> bool:
        """Nothing that is not in z."""
        return False

    @cached_property
    def _others(self) -> Index:
        """Where in z the variables are that the given program has."""
        first = self.segments[-1].after.x
        return np.concatenate([np.arange(first), np.arange(first, first + self.nphi)]) + (
            np.repeat([0, self.overstresses], [first, self.nphi])
        )

    def _widened(self, values: Array, fill: float = 0.0) -> Array:
        """Variables from those of the given program, with the others alike."""
        found = np.full(self.variables, fill)
        found[self._others] = values
        return found

    def pack(self, p: Array, positions: Sequence[Array]) -> Array:
        """Variables z from parameters and positions, the memory as it follows from them."""
        z = self._widened(self.plain.pack(p, positions))
        parts = self.plain.parts_at(p, positions)
        for number, memory in self.memories.items():
            part = parts[number]
            z[memory.variables] = memory.following(part.x, part.setting)
        return z

    def parts(self, z: Array) -> list[Part]:
        """Every experiment at z, with the memory there."""
        parts = super().parts(z)
        for number, memory in self.memories.items():
            parts[number] = replace(parts[number], brought=memory.brought(z))
        return parts

    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of z; equal for what is given."""
        lower, upper = self.plain.bounds()
        return self._widened(lower, -np.inf), self._widened(upper, np.inf)

    def gradient(self, z: Array) -> Array:
        """∂objective/∂z."""
        return self._widened(self.plain.gradient(z[self._others]))

    def constraint_values(self, z: Array) -> Array:
        """g, scaled."""
        parts, rows = self.parts(z), super().constraint_values(z)
        found = [m.values(parts[k].x, parts[k].setting) for k, m in self.memories.items()]
        return np.concatenate([rows, *found])

    # Matrices -----------------------------------------------------------------------------------

    @cached_property
    def _jacobian(self) -> Widened:
        entries = [memory.jacobian_entries() for memory in self.memories.values()]
        return self._with(self.plain.jacobian_structure, entries)

    @cached_property
    def _hessian(self) -> Widened:
        indptr, indices = self.plain.hessian_structure
        entries = [memory.hessian_entries() for memory in self.memories.values()]
        return self._with((indptr, self._others[indices]), entries)

    def _with(
        self, structure: tuple[Index, Index], entries: Sequence[tuple[Index, Index]]
    ) -> Widened:
        rows, columns = (np.concatenate(each) for each in zip(*entries, strict=True))
        return Widened.of(structure, self._others, self.variables, rows, columns)

    @cached_property
    def jacobian_structure(self) -> tuple[Index, Index]:
        """Column pointers and row indices of ∂g/∂z by compressed columns."""
        return self._jacobian.indptr, self._jacobian.indices

    def constraints_and_jacobian(self, z: Array, out: Array | None = None) -> tuple[Array, Array]:
        """Constraints g and the values of ∂g/∂z, from one evaluation of the elements."""
        values = np.empty(len(self._jacobian.indices)) if out is None else out
        parts = self.parts(z)
        rows, plain = self.plain.linearised(parts)
        found = [m.jacobian_values(parts[k].x, parts[k].setting) for k, m in self.memories.items()]
        self._jacobian.fill(values, plain, np.concatenate([further for _, further in found]))
        return np.concatenate([rows, *(own for own, _ in found)]), values

    @cached_property
    def hessian_structure(self) -> tuple[Index, Index]:
        """The same of the upper triangle of ∇²_z (w L + yᵀ g)."""
        return self._hessian.indptr, self._hessian.indices

    @cached_property
    def hessian_diagonals(self) -> tuple[Index, Index]:
        """Positions of the diagonal entries of q, and of x, in the values of the Hessian."""
        of_q, of_x = self.plain.hessian_diagonals
        return self._hessian.kept[of_q], self._hessian.kept[of_x]

    def hessian_values(
        self, z: Array, loss_weight: float, multipliers: Array, out: Array | None = None
    ) -> Array:
        """Values of ∇²_z (loss_weight · objective + multipliers · g), upper triangle."""
        values = np.empty(len(self._hessian.indices)) if out is None else out
        parts = self.parts(z)
        weights = {number: m.weights(multipliers) for number, m in self.memories.items()}
        plain = self.plain.curved(parts, loss_weight, multipliers, memory_weights=weights)
        found = [m.hessian_values(parts[k].setting, multipliers) for k, m in self.memories.items()]
        self._hessian.fill(values, plain, np.concatenate(found))
        return values
