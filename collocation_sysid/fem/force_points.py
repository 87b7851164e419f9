"""Instances at which laws of a few vectors act: nodes, or points between nodes.

An instance has L vectors y_l = Σ_a m[l, a] x_a of its K nodes: the nodes themselves, or a point of
a face and what it touches. Forces on the vectors act on the nodes with the same weights. Use
`ForcePoints` to gather vectors from node positions and to assemble forces and matrices.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp

from ..common.array_types import Array, Index
from .pattern import SymmetricPattern, dofs_of


@dataclass(frozen=True, eq=False)
class ForcePoints:
    """Instances of a law on a body."""

    nodes: Index  # (i, K): node indices of each instance
    node_weights: Array  # (i, L, K): weights m of the nodes in each vector
    node_count: int  # number of nodes of the body

    @classmethod
    def at_nodes(cls, nodes: Index, node_count: int) -> ForcePoints:
        """Return instances whose vectors are the positions of their nodes, L = K, from node indices
        (i, K) of a body with `node_count` nodes.
        """
        count = nodes.shape[1]
        return cls(
            nodes, np.broadcast_to(np.eye(count), (len(nodes), count, count)), node_count=node_count
        )

    @property
    def count(self) -> int:
        """Number i of all instances."""
        return len(self.nodes)

    @property
    def dofs(self) -> int:
        """Number 3L of coordinates of the vectors of an instance."""
        return 3 * self.node_weights.shape[1]

    @cached_property
    def couplings(self) -> SymmetricPattern:
        """Pairs of dofs coupled by the nodes of an instance, and the diagonal of the whole body."""
        return SymmetricPattern.from_cells(self.nodes, self.node_count)

    def vectors(self, x: Array, chosen: Index | None = None) -> Array:
        """Return the vectors y (3L, T, i) of node positions x (T, 3n).

        Parameters
        ----------
        x : (T, 3n)
            Positions, or velocities for ẏ.
        chosen : array of int, optional
            Indices of the instances, in whose order the result is; None for all.
        """
        if self._own_nodes is not None:
            nodes = self._own_nodes if chosen is None else self._own_nodes[chosen]
            return x.reshape(len(x), -1, 3)[:, nodes].transpose(2, 0, 1)
        stacked = self._operator_for("operator", chosen) @ x.T
        return stacked.reshape(len(stacked) // self.dofs, self.dofs, len(x)).transpose(1, 2, 0)

    def assemble(self, forces: Array, chosen: Index | None = None) -> Array:
        """Return the nodal forces (T, 3n) of forces (3L, T, i) on the vectors: forces on a node add
        up.

        Parameters
        ----------
        forces : (3L, T, i)
        chosen : array of int, optional
            Indices of the instances to which `forces` belong; None for all.
        """
        if self._own_nodes is not None:
            nodes = self._own_nodes if chosen is None else self._own_nodes[chosen]
            nodal = np.zeros((forces.shape[1], self.node_count, 3))
            nodal[:, nodes] = forces.transpose(1, 2, 0)
            return nodal.reshape(len(nodal), -1)
        force_rows = forces.transpose(2, 0, 1).reshape(
            len(forces) * forces.shape[2], forces.shape[1]
        )
        return (self._operator_for("transposed operator", chosen) @ force_rows).T

    def add_matrices(
        self,
        to: Array,
        places: Index,
        blocks: Array,
        chosen: Index | None = None,
        skew: bool = False,
    ) -> None:
        """Add matrices of the instances to lower triangles on the couplings, in place.

        The symmetric part of each block is added, i.e. half of its sum with its transpose, or with
        `skew` the skew part, half of the difference.

        Parameters
        ----------
        to : (T, any)
            Shared array; modified.
        places : (m,) int
            Columns of `to` of the entries of `couplings`.
        blocks : (3L, 3L, T, i)
            Matrices of the instances.
        chosen : array of int, optional
            Indices of the instances; all by default.
        """
        columns, rows = np.triu_indices(len(blocks))
        values = blocks[rows, columns] + (-1 if skew else 1) * blocks[columns, rows]
        assembly, nonempty = self._operator_for("skew" if skew else "couplings", chosen)
        values = np.moveaxis(values, 0, 2).reshape(values.shape[1], assembly.shape[1])
        to[:, places[nonempty]] += (assembly @ values.T).T / 2

    @cached_property
    def _own_nodes(self) -> Index | None:
        """Node (i,) of each instance if it is its only vector and of no other; else None."""
        # Indexing takes a tenth of the time of a sparse product.
        nodes = self.nodes[:, 0]
        is_single = self.node_weights.shape[1:] == (1, 1) and bool((self.node_weights == 1).all())
        return nodes if is_single and len(np.unique(nodes)) == len(nodes) else None

    def _operator_for(self, what: str, chosen: Index | None) -> Any:
        key = what, None if chosen is None else chosen.tobytes()
        if key not in self._operators:
            # Operator, transpose, symmetric and skew assembly of the latest eight choices of instances.
            if len(self._operators) >= 32:
                self._operators.pop(next(iter(self._operators)), None)
            if what == "operator":
                rows = slice(None) if chosen is None else _expanded_indices(chosen, self.dofs)
                self._operators[key] = self._operator[rows]
            elif what == "transposed operator":
                self._operators[key] = self._operator_for("operator", chosen).T
            else:
                matrix: Any = self._onto_skew if what == "skew" else self._onto_couplings
                if chosen is not None:
                    matrix = matrix[:, _expanded_indices(chosen, self.dofs * (self.dofs + 1) // 2)]
                # Of few instances most rows are empty.
                is_nonempty = np.bincount(matrix.indices, minlength=matrix.shape[0]) > 0
                number = np.cumsum(is_nonempty) - 1
                nonempty = np.flatnonzero(is_nonempty)
                parts = matrix.data, number[matrix.indices], matrix.indptr
                shape = len(nonempty), matrix.shape[1]
                self._operators[key] = (sp.csc_array(parts, shape=shape), nonempty)
        return self._operators[key]

    @cached_property
    def _operators(self) -> dict[tuple[str, bytes | None], Any]:
        return {}

    @cached_property
    def _operator(self) -> sp.csr_array:
        """Sparse matrix (i · 3L, 3n) from node positions to vectors."""
        instance, coordinate, dof, weight = self.nonzero_weights
        rows = instance * self.dofs + coordinate
        shape = self.count * self.dofs, 3 * self.node_count
        return sp.csr_array((weight, (rows, dof)), shape=shape)

    @cached_property
    def nonzero_weights(self) -> tuple[Index, Index, Index, Array]:
        """Instances, coordinates, dofs and values of all nonzero weights, by instance, then vector,
        node and axis.
        """
        instance, vector, place = np.nonzero(self.node_weights)
        weight = self.node_weights[instance, vector, place]
        axes = np.arange(3)
        dofs = dofs_of(self.nodes[instance, place][:, None]).ravel()
        coordinates = (3 * vector[:, None] + axes).ravel()
        return np.repeat(instance, 3), coordinates, dofs, np.repeat(weight, 3)

    @cached_property
    def _onto_couplings(self) -> sp.csc_array:
        """Matrix that sums symmetric parts of instances into the couplings."""
        return self._assembly_matrix(skew=False)

    @cached_property
    def _onto_skew(self) -> sp.csc_array:
        """Matrix that sums skew parts of instances into the couplings."""
        return self._assembly_matrix(skew=True)

    def _assembly_matrix(self, skew: bool) -> sp.csc_array:
        """Return the matrix that sums lower triangles (i, d(d + 1)/2) into the couplings."""
        instance, local, dof, weight = self.nonzero_weights
        order = np.argsort(instance, kind="stable")
        instance, local, dof, weight = instance[order], local[order], dof[order], weight[order]
        starts = np.searchsorted(instance, np.arange(self.count + 1))
        sizes = np.diff(starts)
        parts = []
        for size in np.unique(sizes):
            # (k, size) pairs of each instance that has so many.
            instances_of_size = np.flatnonzero(sizes == size)
            pairs = starts[instances_of_size][:, None] + np.arange(size)
            a = np.repeat(np.arange(size), size)
            b = np.tile(np.arange(size), size)
            row: Index = dof[pairs[:, a]]
            column: Index = dof[pairs[:, b]]
            lower_pairs = np.nonzero(row >= column)
            first = pairs[:, a][lower_pairs]
            second = pairs[:, b][lower_pairs]
            r = local[first]
            s = local[second]
            value = weight[first] * weight[second]
            if skew:
                value = np.where(r < s, -value, value)
            d = self.dofs
            low = np.minimum(r, s)
            high = np.maximum(r, s)
            lower = low * d - low * (low - 1) // 2 + high - low
            place = self.couplings.positions_of(row[lower_pairs], column[lower_pairs])
            parts.append((place, instance[first] * (d * (d + 1) // 2) + lower, value))
        places, sources, values = map(np.concatenate, zip(*parts, strict=True))
        shape = (self.couplings.entry_count, self.count * self.dofs * (self.dofs + 1) // 2)
        return sp.csc_array((values, (places, sources)), shape=shape)


def _expanded_indices(chosen: Index, size: int) -> Index:
    return (chosen[:, None] * size + np.arange(size)).ravel()
