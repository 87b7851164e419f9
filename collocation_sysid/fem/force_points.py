"""Where forces act that are laws of a few vectors: of nodes, or of points between them.

An instance has L vectors y_l = Σ_a m[l, a] x_a of its K nodes: the nodes themselves, or a point of
a face with what it meets. Forces on the vectors act on the nodes with the same weights.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp

from ..arrays import Array, Index
from .pattern import SymmetricPattern, dofs_of

# Matrices that are kept: of the last eight choices of instances an operator, its transpose, and
# those that add the symmetric and the skew part of the slopes.
MOST_KEPT = 32


@dataclass(frozen=True, eq=False)
class ForcePoints:
    """Instances of a law on a body.

    Attributes
    ----------
    nodes : (i, K) of each
    mix : (i, L, K) m
    node_count : int
        Of the body.
    """

    nodes: Index
    mix: Array
    node_count: int

    @classmethod
    def of_nodes(cls, nodes: Index, node_count: int) -> ForcePoints:
        """Instances (i, K) that take nodes as they are."""
        count = nodes.shape[1]
        return cls(nodes, np.broadcast_to(np.eye(count), (len(nodes), count, count)), node_count)

    @property
    def count(self) -> int:
        """Number i of instances."""
        return len(self.nodes)

    @property
    def dofs(self) -> int:
        """Numbers 3L that a law takes."""
        return 3 * self.mix.shape[1]

    @cached_property
    def couplings(self) -> SymmetricPattern:
        """What the nodes of each join."""
        return SymmetricPattern.of_cells(self.nodes, self.node_count)

    def vectors(self, x: Array, chosen: Index | None = None) -> Array:
        """Y (3L, T, i) of x (T, 3n), of all instances or of chosen ones."""
        found = self._some("operator", chosen) @ x.T
        return found.reshape(len(found) // self.dofs, self.dofs, len(x)).transpose(1, 2, 0)

    def summed(self, forces: Array, chosen: Index | None = None) -> Array:
        """(T, 3n) from the forces (3L, T, i) on the vectors."""
        flat = forces.transpose(2, 0, 1).reshape(len(forces) * forces.shape[2], forces.shape[1])
        return (self._some("transposed operator", chosen) @ flat).T

    def add_entries(
        self,
        to: Array,
        places: Index,
        blocks: Array,
        chosen: Index | None = None,
        skew: bool = False,
    ) -> None:
        """Add to (T, any) at places (m,) lower triangles on the couplings, from (3L, 3L, T, i).

        Half of the sum of each block with its transpose, or with `skew` of the difference.
        """
        columns, rows = np.triu_indices(len(blocks))
        values = blocks[rows, columns] + (-1 if skew else 1) * blocks[columns, rows]
        onto, touched = self._some("skew" if skew else "couplings", chosen)
        values = np.moveaxis(values, 0, 2).reshape(values.shape[1], onto.shape[1])
        to[:, places[touched]] += (onto @ values.T).T / 2

    def _some(self, what: str, chosen: Index | None) -> Any:
        """Of a matrix what belongs to chosen instances; that of the last few choices is kept."""
        key = what, None if chosen is None else chosen.tobytes()
        if key not in self._kept:
            if len(self._kept) >= MOST_KEPT:
                self._kept.pop(next(iter(self._kept)), None)
            if what == "operator":
                rows = slice(None) if chosen is None else _each(chosen, self.dofs)
                self._kept[key] = self._operator[rows]
            elif what == "transposed operator":
                self._kept[key] = self._some("operator", chosen).T
            else:
                whole: Any = self._onto_skew if what == "skew" else self._onto_couplings
                if chosen is not None:
                    whole = whole[:, _each(chosen, self.dofs * (self.dofs + 1) // 2)]
                # Of few instances most rows are empty.
                is_touched = np.bincount(whole.indices, minlength=whole.shape[0]) > 0
                number, touched = np.cumsum(is_touched) - 1, np.flatnonzero(is_touched)
                parts = whole.data, number[whole.indices], whole.indptr
                shape = len(touched), whole.shape[1]
                self._kept[key] = sp.csc_array(parts, shape=shape), touched
        return self._kept[key]

    @cached_property
    def _kept(self) -> dict[tuple[str, bytes | None], Any]:
        return {}

    @cached_property
    def _operator(self) -> sp.csr_array:
        """(i · 3L, 3n)."""
        instance, local, node, weight = self.pairs
        shape = self.count * self.dofs, 3 * self.node_count
        return sp.csr_array((weight, (instance * self.dofs + local, node)), shape=shape)

    @cached_property
    def pairs(self) -> tuple[Index, Index, Index, Array]:
        """(P,) instance, number among 3L, dof, and weight, of all that are not zero."""
        instance, vector, place = np.nonzero(self.mix)
        weight = self.mix[instance, vector, place]
        axes = np.arange(3)
        dofs = dofs_of(self.nodes[instance, place][:, None]).ravel()
        locals_ = (3 * vector[:, None] + axes).ravel()
        return np.repeat(instance, 3), locals_, dofs, np.repeat(weight, 3)

    @cached_property
    def _onto_couplings(self) -> sp.csc_array:
        return self._onto(skew=False)

    @cached_property
    def _onto_skew(self) -> sp.csc_array:
        return self._onto(skew=True)

    def _onto(self, skew: bool) -> sp.csc_array:
        """What sums lower triangles (i, d(d + 1)/2), column after column, into the entries."""
        instance, local, dof, weight = self.pairs
        order = np.argsort(instance, kind="stable")
        instance, local, dof = instance[order], local[order], dof[order]
        weight = weight[order]
        starts = np.searchsorted(instance, np.arange(self.count + 1))
        sizes, found = np.diff(starts), []
        for size in np.unique(sizes):
            # (k, size) pairs of each instance that has so many.
            here = np.flatnonzero(sizes == size)
            at = starts[here][:, None] + np.arange(size)
            a, b = np.repeat(np.arange(size), size), np.tile(np.arange(size), size)
            row: Index = dof[at[:, a]]
            column: Index = dof[at[:, b]]
            kept = np.nonzero(row >= column)
            first, second = at[:, a][kept], at[:, b][kept]
            r, s = local[first], local[second]
            value = weight[first] * weight[second]
            if skew:
                value = np.where(r < s, -value, value)
            d, low, high = self.dofs, np.minimum(r, s), np.maximum(r, s)
            lower = low * d - low * (low - 1) // 2 + high - low
            place = self.couplings.position(row[kept], column[kept])
            found.append((place, instance[first] * (d * (d + 1) // 2) + lower, value))
        places, sources, values = map(np.concatenate, zip(*found, strict=True))
        shape = self.couplings.entries, self.count * self.dofs * (self.dofs + 1) // 2
        return sp.csc_array((values, (places, sources)), shape=shape)


def _each(chosen: Index, size: int) -> Index:
    """Numbers of all that belongs to chosen instances."""
    return (chosen[:, None] * size + np.arange(size)).ravel()
