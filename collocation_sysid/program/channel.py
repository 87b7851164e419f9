"""What can be looked at of a moving body, and how it follows positions and parameters.

A channel has values c (n, e, 3) at the first n of its times: places on the body, here, or the force
and torque that a grasp gives, see `wrench_channel`. Between them and a residual stand a few lines,
see `reading`. What is `local` depends on few positions at each time, and tells its slopes and
curvature by them; of others programs have the values among their variables.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np
import scipy.sparse as sp

from ..arrays import Array, Index
from ..recording.grasp import Grasp
from .charts import Chart, ShapeFunctions


@dataclass(frozen=True, eq=False)
class Forced:
    """The reactions on the sensed dofs of the first grid rows.

    Attributes
    ----------
    reaction : (N, g) R of each row [N]
    position_m : (N, g) where the dofs are
    reaction_by, position_by : (N, g, c) their changes, where these are wanted
    """

    reaction: Array
    position_m: Array
    reaction_by: Array | None = None
    position_by: Array | None = None


@dataclass(frozen=True, eq=False)
class Motion:
    """A motion as channels look at it.

    Attributes
    ----------
    x : (rows, 3n) positions, of the first rows of the grid
    forces : callable
        Tells the reactions there.
    by : (R, p, c), optional
        How what the channel's operator takes of x changes; by nothing, where it is left out.
    """

    x: Array
    forces: Callable[[], Forced]
    by: Array | None = None

    @cached_property
    def forced(self) -> Forced:
        """The reactions."""
        return self.forces()


class Slopes(NamedTuple):
    """How the values of a channel change.

    by : (n, e, 3, c) by the parameters at `columns` (c,)
    own : (n, E, 3, k) of some `entities` (E,) by the φ at `places` (E, k), which only they have
    """

    columns: Index
    by: Array
    entities: Index
    places: Index
    own: Array

    @classmethod
    def along(cls, columns: Index, by: Array) -> Slopes:
        """Those without φ of their own."""
        none = np.zeros(0, dtype=np.int64)
        return cls(columns, by, none, none.reshape(0, 0), by[:, :0, :, :0])


class Pulled(NamedTuple):
    """Slopes of a scalar by x (N, 3n), by the reactions (N, g) if any, and by φ (k,)."""

    by_x: Array
    by_reaction: Array | None
    by_phi: Array


class Entries(NamedTuple):
    """Entries of a sparse matrix; those at the same place are summed."""

    rows: Index
    columns: Index
    values: Array


@dataclass(frozen=True, eq=False)
class Points:
    """Places X on the body, h(x_t) = Σ_a N_a(X) x_{t,a}.

    Attributes
    ----------
    rows : (T,) grid rows
    chart : Chart
        Where they are.
    places : (e, k) positions in φ of those that are estimated; −1 of exact ones
    """

    rows: Index
    chart: Chart
    places: Index

    late: ClassVar[int] = 0

    @property
    def local(self) -> Points:
        """Itself."""
        return self

    @property
    def is_linear(self) -> bool:
        """Whether its slopes are always the same."""
        return not len(self.chart.estimated)

    @property
    def count(self) -> int:
        """Number of times."""
        return len(self.rows)

    @property
    def each(self) -> int:
        """Number of places."""
        return len(self.chart.given_m)

    @property
    def node_count(self) -> int:
        """Of the body."""
        return len(self.chart.body.nodes_m)

    def shape(self, phi: Array) -> tuple[Index, ShapeFunctions]:
        """Nodes (e, npe), and with what weights they count, at φ."""
        return self.chart.reading(np.append(phi, 0.0)[self.places])

    def operator(self, phi: Array) -> sp.csr_array:
        """H as a (3e, 3n) matrix at φ; row 3 m + axis, column 3 node + axis."""
        nodes, shape = self.shape(phi)
        return operator_of(nodes, shape.weights, self.node_count)

    def _combined(self, x: Array, nodes: Index, weights: Array) -> Array:
        """Σ_a weights[m, a, …] x_a at the rows that are there, (R, m, 3, …)."""
        rows = self.rows[self.rows < len(x)]
        at = x[rows].reshape(len(rows), -1, 3)[:, nodes]
        return np.einsum("ma...,tmai->tmi...", weights, at)

    def _by_place(self, x: Array, shape: tuple[Index, ShapeFunctions]) -> Array:
        """(R, estimated, 3, k) slopes by their own places."""
        (nodes, functions), here = shape, self.chart.estimated
        if not len(here):
            return np.zeros((len(self.rows), 0, 3, self.places.shape[1]))
        return self._combined(x, nodes[here], functions.slopes[here])

    def values(self, motion: Motion, phi: Array) -> Array:
        """(R, e, 3) [m]."""
        return self.of(motion.x, phi)

    def of(self, x: Array, phi: Array) -> Array:
        """The same of the first rows x (rows, 3n)."""
        nodes, shape = self.shape(phi)
        return self._combined(x, nodes, shape.weights)

    def linearised(
        self, motion: Motion, phi: Array, columns: Index, size: int
    ) -> tuple[Array, Slopes]:
        """The same with slopes."""
        values = self.values(motion, phi)
        by = np.zeros((len(values), 3 * self.each, 0)) if motion.by is None else motion.by
        return values, self.slopes_of(motion.x, self.shape(phi), columns, by)

    def slopes_of(
        self, x: Array, shape: tuple[Index, ShapeFunctions], columns: Index, by: Array
    ) -> Slopes:
        """Slopes of the values, H x changing by (R, 3e, c) with the parameters at `columns`."""
        here, by = self.chart.estimated, by.reshape(len(by), self.each, 3, by.shape[2])
        return Slopes(columns, by, here, self.places[here], self._by_place(x, shape))

    def pulled(self, motion: Motion, phi: Array, by_values: Array) -> Pulled:
        """Slopes of a scalar from those by the values."""
        by_x, by_phi, here = np.zeros_like(motion.x), np.zeros(len(phi)), self.chart.estimated
        flat = by_values.reshape(len(by_values), -1)
        by_x[self.rows] = (self.operator(phi).T @ flat.T).T
        if len(here):
            own = np.einsum(
                "tmi,tmik->mk", by_values[:, here], self._by_place(motion.x, self.shape(phi))
            )
            by_phi[self.places[here]] = own
        return Pulled(by_x, None, by_phi)

    def carried(
        self, grasp: Grasp, motion: Motion, phi: Array, shifts: Array, turns: Array
    ) -> Array | float:
        """Nothing: places are those of the body."""
        return 0.0

    # By (x, φ) --------------------------------------------------------------------------------

    @cached_property
    def _corners(self) -> tuple[Index, Index]:
        """Places, and corners of their elements, that a value can depend on, both (w,)."""
        reads = self.chart.weights != 0
        reads[self.chart.estimated] = True
        marker, corner = np.nonzero(reads)
        return marker, corner

    def _slope_entries(self, variables: int, size: int) -> tuple[Index, Index]:
        """Rows and columns of ∂(c, φ)/∂(x, φ), in the order of `slopes`; all x before all φ."""
        nodes, _ = self.shape(np.zeros(size))
        (marker, corner), axes, dofs = self._corners, np.arange(3), 3 * self.node_count
        first = 3 * self.each * np.arange(self.count)[:, None, None]
        here = self.chart.estimated
        row_place = np.broadcast_to(
            first[..., None] + 3 * here[:, None, None] + axes[:, None],
            (self.count, len(here), 3, self.places.shape[1]),
        )
        pairs = (
            (
                first + 3 * marker[:, None] + axes,
                (self.rows * dofs)[:, None, None] + 3 * nodes[marker, corner][:, None] + axes,
            ),
            (row_place, np.broadcast_to(variables + self.places[here][:, None], row_place.shape)),
            (3 * self.each * self.count + np.arange(size), variables + np.arange(size)),
        )
        rows, columns = zip(*pairs, strict=True)
        return np.concatenate([r.ravel() for r in rows]), np.concatenate(
            [c.ravel() for c in columns]
        )

    def slopes(self, x: Array | None, phi: Array, variables: int) -> sp.csr_array:
        """∂(c, φ)/∂(x, φ), x (N, 3n) being so many variables; its structure without x."""
        size, here = len(phi), self._slope_entries(variables, len(phi))
        if x is None:
            values = np.ones(len(here[0]))
        else:
            nodes, shape = self.shape(phi)
            weights = shape.weights[self._corners][:, None]
            of_x = np.broadcast_to(weights, (self.count, len(weights), 3))
            own = self._by_place(x, (nodes, shape))
            values = np.concatenate([of_x.ravel(), own.ravel(), np.ones(size)])
        whole = 3 * self.each * self.count + size
        return sp.csr_array((values, here), shape=(whole, variables + size))

    def curvature(self, x: Array, phi: Array, by_values: Array, variables: int) -> Entries:
        """Σ by_values · ∂²c/∂(x, φ)², upper triangle: it bends by places that are estimated."""
        here, (nodes, shape) = self.chart.estimated, self.shape(phi)
        weights, dofs = by_values[:, here], 3 * self.node_count
        dof = 3 * nodes[here][:, :, None] + np.arange(3)  # (m, a, axis)
        row = self.rows[:, None, None, None, None] * dofs + dof[..., None]
        column = variables + self.places[here]
        value = np.einsum("tmi,mak->tmaik", weights, shape.slopes[here])
        rows, columns = np.broadcast_arrays(row, column[:, None, None])
        bent = self._combined(x, nodes[here], shape.curvatures[here])
        bent = np.einsum("tmi,tmikl->mkl", weights, bent)
        kept = np.nonzero(np.broadcast_to(np.triu(np.ones(bent.shape[1:])), bent.shape))
        return Entries(
            np.concatenate([rows.ravel(), column[kept[0], kept[1]]]),
            np.concatenate([columns.ravel(), column[kept[0], kept[2]]]),
            np.concatenate([value.ravel(), bent[kept]]),
        )


def operator_of(nodes: Index, weights: Array, node_count: int) -> sp.csr_array:
    """Readings Σ_a weights[m, a] x_a as a (3M, 3n) matrix; row 3 m + axis, column 3 node + axis."""
    marker = np.repeat(np.arange(len(nodes)), nodes.shape[1])
    per_node = sp.csr_array(
        (weights.ravel(), (marker, nodes.ravel())), shape=(len(nodes), node_count)
    )
    per_node.eliminate_zeros()
    return sp.csr_array(sp.kron(per_node, sp.eye_array(3), format="csr"))
