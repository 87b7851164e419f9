"""Observables of a moving body: quantities that measurements are functions of, with their
derivatives.

An observable has values c (n, e, 3) at n of the grid times: positions of e points of the body
(`Points`, here), or force and torque of a grasp (`wrench_channel.GraspWrench`). `reading` turns
them into residuals. An observable is `local` if it depends on few positions at each time; then it
provides derivatives by these positions. Other observables can be lifted to variables of the
program, see `carried`.
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
    """Reaction forces on the sensed dofs at the first grid times.

    Attributes
    ----------
    reaction : (N, g) array
        Reaction forces R [N].
    position_m : (N, g) array
        Positions of the dofs [m].
    reaction_by, position_by : (N, g, c) arrays or None
        Their changes with c columns; None where they are not needed.
    """

    reaction: Array
    position_m: Array
    reaction_by: Array | None = None
    position_by: Array | None = None


@dataclass(frozen=True, eq=False)
class Motion:
    """A motion as observables use it.

    Attributes
    ----------
    x : (rows, 3n) array
        Positions of the first grid times [m].
    forces : callable
        Returns the reaction forces; called at most once.
    by : (R, p, c) array or None
        Changes with c columns of the observable's operator applied to x; None means no change.
    """

    x: Array
    forces: Callable[[], Forced]
    by: Array | None = None

    @cached_property
    def forced(self) -> Forced:
        """Reaction forces, computed on first use."""
        return self.forces()


class Slopes(NamedTuple):
    """Derivatives of the values c (n, e, 3) of an observable.

    Attributes
    ----------
    columns : (c,) array
        Indices of the common parameters.
    by : (n, e, 3, c) array
        Derivatives by the common parameters.
    entities : (E,) array
        Indices of points that have parameters of their own.
    places : (E, k) array
        Indices in φ of these parameters.
    own : (n, E, 3, k) array
        Derivatives of these points by them.
    """

    columns: Index
    by: Array
    entities: Index
    places: Index
    own: Array

    @classmethod
    def along(cls, columns: Index, by: Array) -> Slopes:
        """Build derivatives (n, e, 3, c) by the parameters at `columns` (c,) alone."""
        none = np.zeros(0, dtype=np.int64)
        return cls(columns, by, none, none.reshape(0, 0), by[:, :0, :, :0])


class Pulled(NamedTuple):
    """Derivatives of a scalar by positions, reaction forces and nuisance parameters.

    Attributes
    ----------
    by_x : (N, 3n) array
        Derivatives by the positions [1/m].
    by_reaction : (N, g) array or None
        Derivatives by the reaction forces [1/N]; None if it does not depend on them.
    by_phi : (k,) array
        Derivatives by φ.
    """

    by_x: Array
    by_reaction: Array | None
    by_phi: Array


class Entries(NamedTuple):
    """Entries of a sparse matrix; values with the same row and column are summed."""

    rows: Index
    columns: Index
    values: Array


@dataclass(frozen=True, eq=False)
class Points:
    """Positions of points X of the body, h(x_t) = Σ_a N_a(X) x_{t,a}, as an observable.

    Attributes
    ----------
    rows : (T,) array
        Grid times.
    chart : Chart
        Elements of the points.
    places : (e, k) array
        Indices in φ of the estimated coordinates of X; −1 for points that are exact.
    late : int
        Number of grid times after which a value is known; 0.
    """

    rows: Index
    chart: Chart
    places: Index

    late: ClassVar[int] = 0

    @property
    def local(self) -> Points:
        """The observable itself, because it depends on few positions (None for observables
        that do not).
        """
        return self

    @property
    def is_linear(self) -> bool:
        """Whether its derivatives are constant."""
        return not len(self.chart.estimated)

    @property
    def count(self) -> int:
        """Number of times."""
        return len(self.rows)

    @property
    def each(self) -> int:
        """Number of points."""
        return len(self.chart.given_m)

    @property
    def node_count(self) -> int:
        """Number of nodes of the body."""
        return len(self.chart.body.nodes_m)

    def shape(self, phi: Array) -> tuple[Index, ShapeFunctions]:
        """Return the nodes (e, npe) of each point and their shape functions at φ (k,)."""
        return self.chart.reading(np.append(phi, 0.0)[self.places])

    def operator(self, phi: Array) -> sp.csr_array:
        """Return the matrix H (3e, 3n) from positions to points at φ (k,); row 3 m + axis,
        column 3 node + axis.
        """
        nodes, shape = self.shape(phi)
        return operator_of(nodes, shape.weights, self.node_count)

    def _combined(self, x: Array, nodes: Index, weights: Array) -> Array:
        """Return Σ_a weights[m, a, …] x_a for the known grid times, (R, m, 3, …)."""
        rows = self.rows[self.rows < len(x)]
        at = x[rows].reshape(len(rows), -1, 3)[:, nodes]
        return np.einsum("ma...,tmai->tmi...", weights, at)

    def _by_place(self, x: Array, shape: tuple[Index, ShapeFunctions]) -> Array:
        """Return the derivatives (R, estimated, 3, k) of estimated points by their own
        coordinates.
        """
        nodes, functions = shape
        estimated = self.chart.estimated
        if not len(estimated):
            return np.zeros((len(self.rows), 0, 3, self.places.shape[1]))
        return self._combined(x, nodes[estimated], functions.slopes[estimated])

    def values(self, motion: Motion, phi: Array) -> Array:
        """Return the positions (R, e, 3) of the points in a motion [m], at those times that
        the motion covers.
        """
        return self.of(motion.x, phi)

    def of(self, x: Array, phi: Array) -> Array:
        """Return the positions (R, e, 3) of the points [m] for the first rows x (rows, 3n)."""
        nodes, shape = self.shape(phi)
        return self._combined(x, nodes, shape.weights)

    def linearised(
        self, motion: Motion, phi: Array, columns: Index, size: int
    ) -> tuple[Array, Slopes]:
        """Return the values (R, e, 3) and their derivatives.

        Parameters
        ----------
        motion : Motion
            The motion, with its changes `by` (R, 3e, c).
        phi : (k,) array
            Nuisance parameters.
        columns : (c,) array
            Indices of the parameters of the changes among all parameters.
        size : int
            Number of all parameters; not used here.
        """
        values = self.values(motion, phi)
        by = np.zeros((len(values), 3 * self.each, 0)) if motion.by is None else motion.by
        return values, self.slopes_of(motion.x, self.shape(phi), columns, by)

    def slopes_of(
        self, x: Array, shape: tuple[Index, ShapeFunctions], columns: Index, by: Array
    ) -> Slopes:
        """Return the derivatives of the values if H x changes by (R, 3e, c) with the
        parameters at `columns`.
        """
        estimated = self.chart.estimated
        by = by.reshape(len(by), self.each, 3, by.shape[2])
        return Slopes(columns, by, estimated, self.places[estimated], self._by_place(x, shape))

    def pulled(self, motion: Motion, phi: Array, by_values: Array) -> Pulled:
        """Vector–Jacobian product: derivatives of a scalar from those by the values.

        Parameters
        ----------
        motion : Motion
            The motion, over all grid times.
        phi : (k,) array
            Nuisance parameters.
        by_values : (R, e, 3) array
            Derivatives of the scalar by the values.
        """
        by_x = np.zeros_like(motion.x)
        by_phi = np.zeros(len(phi))
        here = self.chart.estimated
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
        """Return the changes of the values due to sensor frames moved by pose errors: 0 for points
        of the body.

        The signature is that of `GraspWrench.carried`.
        """
        return 0.0

    # By (x, φ) --------------------------------------------------------------------------------

    @cached_property
    def _corners(self) -> tuple[Index, Index]:
        """Point and corner of its element, both (w,), for each node that a value can depend on."""
        reads = self.chart.weights != 0
        reads[self.chart.estimated] = True
        marker, corner = np.nonzero(reads)
        return marker, corner

    def _slope_entries(self, variables: int, size: int) -> tuple[Index, Index]:
        """Return rows and columns of ∂(c, φ)/∂(x, φ) in the order of `slopes`; all x
        precede all φ.
        """
        nodes, _ = self.shape(np.zeros(size))
        marker, corner = self._corners
        axes = np.arange(3)
        dofs = 3 * self.node_count
        first = 3 * self.each * np.arange(self.count)[:, None, None]
        estimated = self.chart.estimated
        row_place = np.broadcast_to(
            first[..., None] + 3 * estimated[:, None, None] + axes[:, None],
            (self.count, len(estimated), 3, self.places.shape[1]),
        )
        pairs = (
            (
                first + 3 * marker[:, None] + axes,
                (self.rows * dofs)[:, None, None] + 3 * nodes[marker, corner][:, None] + axes,
            ),
            (
                row_place,
                np.broadcast_to(variables + self.places[estimated][:, None], row_place.shape),
            ),
            (3 * self.each * self.count + np.arange(size), variables + np.arange(size)),
        )
        rows = np.concatenate([row.ravel() for row, _ in pairs])
        return rows, np.concatenate([column.ravel() for _, column in pairs])

    def slopes(self, x: Array | None, phi: Array, variables: int) -> sp.csr_array:
        """Return the sparse matrix ∂(c, φ)/∂(x, φ).

        Parameters
        ----------
        x : (N, 3n) array or None
            Positions [m]; None gives the structure, with ones.
        phi : (k,) array
            Nuisance parameters.
        variables : int
            Number of positions N · 3n.
        """
        size = len(phi)
        entries = self._slope_entries(variables, len(phi))
        if x is None:
            values = np.ones(len(entries[0]))
        else:
            nodes, shape = self.shape(phi)
            weights = shape.weights[self._corners][:, None]
            of_x = np.broadcast_to(weights, (self.count, len(weights), 3))
            own = self._by_place(x, (nodes, shape))
            values = np.concatenate([of_x.ravel(), own.ravel(), np.ones(size)])
        row_count = 3 * self.each * self.count + size
        return sp.csr_array((values, entries), shape=(row_count, variables + size))

    def curvature(self, x: Array, phi: Array, by_values: Array, variables: int) -> Entries:
        """Return Σ by_values · ∂²c/∂(x, φ)², upper triangle; non-zero for estimated points only.

        Parameters
        ----------
        x : (N, 3n) array
            Positions [m].
        phi : (k,) array
            Nuisance parameters.
        by_values : (T, e, 3) array
            Weights.
        variables : int
            Number of positions N · 3n.
        """
        estimated = self.chart.estimated
        nodes, shape = self.shape(phi)
        weights = by_values[:, estimated]
        dofs = 3 * self.node_count
        dof = 3 * nodes[estimated][:, :, None] + np.arange(3)  # (m, a, axis)
        row = self.rows[:, None, None, None, None] * dofs + dof[..., None]
        column = variables + self.places[estimated]
        value = np.einsum("tmi,mak->tmaik", weights, shape.slopes[estimated])
        rows, columns = np.broadcast_arrays(row, column[:, None, None])
        by_coordinates = self._combined(x, nodes[estimated], shape.curvatures[estimated])
        by_coordinates = np.einsum("tmi,tmikl->mkl", weights, by_coordinates)
        upper = np.nonzero(
            np.broadcast_to(np.triu(np.ones(by_coordinates.shape[1:])), by_coordinates.shape)
        )
        return Entries(
            np.concatenate([rows.ravel(), column[upper[0], upper[1]]]),
            np.concatenate([columns.ravel(), column[upper[0], upper[2]]]),
            np.concatenate([value.ravel(), by_coordinates[upper]]),
        )


def operator_of(nodes: Index, weights: Array, node_count: int) -> sp.csr_array:
    """Return the matrix (3M, 3n) of Σ_a weights[m, a] x_a; row 3 m + axis, column 3 node + axis."""
    marker = np.repeat(np.arange(len(nodes)), nodes.shape[1])
    per_node = sp.csr_array(
        (weights.ravel(), (marker, nodes.ravel())), shape=(len(nodes), node_count)
    )
    per_node.eliminate_zeros()
    return sp.csr_array(sp.kron(per_node, sp.eye_array(3), format="csr"))
