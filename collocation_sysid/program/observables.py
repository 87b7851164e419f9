"""Observables of a moving body: quantities that measurements are functions of, with their
derivatives.

An observable has values c (n, e, 3) at n of the grid times: positions of e points of the body
(`PointPositions`, here), or force and torque of a grasp (`ReactionResultant`).
`measurement_residual` turns them into residuals. An observable is `local` if it depends on few
positions at each time; then it provides derivatives by these positions. Other observables can be
lifted to variables of the program, see `lifted_variables`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np
import scipy.sparse as sp

from ..common.array_types import Array, Index
from ..recording.grasp import Grasp
from .markers.association import MarkerAssociation, ShapeFunctions


@dataclass(frozen=True, eq=False)
class ReactionForces:
    """Reaction forces on the g sensed dofs at the first grid times."""

    reaction: Array  # (N, g): reaction forces R [N]
    position_m: Array  # (N, g): positions of the dofs [m]
    # (N, g, c) or None: their changes with c columns, such as derivatives by parameters; None where
    # they are not needed.
    reaction_by: Array | None = None
    position_by: Array | None = None


@dataclass(frozen=True, eq=False)
class ObservedMotion:
    """A motion with its changes, as one observable uses it."""

    x: Array  # (rows, 3n): positions of the first grid times [m]
    # Reaction forces on the sensed dofs; None for observables that do not measure them.
    reactions: ReactionForces | None = None
    # (R, p, c) or None: changes with c columns of the p values of an observable's operator applied
    # to the R rows of x at which it is observed; None means no change.
    changes: Array | None = None


class ObservableDerivatives(NamedTuple):
    """Derivatives of the values c (n, e, 3) of an observable."""

    columns: Index  # (c,): indices of the common parameters
    by_common: Array  # (n, e, 3, c): derivatives by the common parameters
    entities: Index  # (E,): indices of points that have parameters of their own
    own_parameters: Index  # (E, k): indices in φ of these parameters
    by_own: Array  # (n, E, 3, k): derivatives of these points by them

    @classmethod
    def without_own(cls, columns: Index, by: Array) -> ObservableDerivatives:
        """Return derivatives `by` (n, e, 3, c) by the parameters with indices `columns` (c,), of an
        observable whose points have no parameters of their own.
        """
        none = np.zeros(0, dtype=np.int64)
        return cls(
            columns, by, entities=none, own_parameters=none.reshape(0, 0), by_own=by[:, :0, :, :0]
        )


class SparseEntries(NamedTuple):
    """Entries of a sparse matrix, three arrays of equal length; values with the same row and column
    are summed.
    """

    rows: Index
    columns: Index
    values: Array


@dataclass(frozen=True, eq=False)
class PointPositions:
    """Positions of e points X of the body, h(x_t) = Σ_a N_a(X) x_{t,a}, as an observable.

    Attributes
    ----------
    rows : (T,) array
        Indices of the grid times at which they are observed, ascending.
    coordinate_parameters : (e, k) array
        Indices in φ of the estimated coordinates of X; −1 for points that are exact.
    delay_steps : int
        Number of grid times after which a value is known; 0.
    measures_reactions : bool
        Whether values depend on reaction forces; False.
    """

    rows: Index
    association: MarkerAssociation
    coordinate_parameters: Index

    delay_steps: ClassVar[int] = 0
    measures_reactions: ClassVar[bool] = False

    @property
    def local(self) -> PointPositions:
        """The observable itself, because it depends on few positions (None for observables
        that do not).
        """
        return self

    @property
    def is_linear(self) -> bool:
        """Whether the positions are a linear function of x that does not depend on φ: no place is
        estimated.
        """
        return not len(self.association.estimated)

    @property
    def count(self) -> int:
        """Number of grid times at which the points are observed."""
        return len(self.rows)

    @property
    def vector_count(self) -> int:
        """Number e of observed points, each of which gives one vector of three coordinates."""
        return len(self.association.prior_places_m)

    @property
    def node_count(self) -> int:
        """Number of nodes of the body."""
        return len(self.association.body.nodes_m)

    def shape_functions(self, phi: Array) -> tuple[Index, ShapeFunctions]:
        """Return the indices of the npe nodes of each point's element (e, npe), and the shape
        functions with their derivatives at the places estimated by φ (k,).
        """
        places = np.append(phi, 0.0)[self.coordinate_parameters]
        key = places.tobytes()
        if key not in self._last_shapes:
            self._last_shapes.clear()
            self._last_shapes[key] = self.association.shape_functions(places)
        return self._last_shapes[key]

    @cached_property
    def _last_shapes(self) -> dict[bytes, tuple[Index, ShapeFunctions]]:
        """Result of `shape_functions` at the last coordinates: motions are compared at equal ones."""
        return {}

    def operator(self, phi: Array) -> sp.csr_array:
        """Return the matrix H (3e, 3n) from positions to points at φ (k,); row 3 m + axis,
        column 3 node + axis.
        """
        if self.is_linear:
            return self._constant_operator
        return self._operator_at(phi)

    @cached_property
    def _constant_operator(self) -> sp.csr_array:
        """Matrix `operator` of points whose places are all stated."""
        size = self.coordinate_parameters.max(initial=-1) + 1
        return self._operator_at(np.zeros(size))

    def _operator_at(self, phi: Array) -> sp.csr_array:
        nodes, shape = self.shape_functions(phi)
        return interpolation_matrix(nodes, shape.weights, node_count=self.node_count)

    def _interpolate(self, x: Array, nodes: Index, weights: Array) -> Array:
        """Return Σ_a weights[m, a, …] x_a, (R, m, 3, …), at known rows."""
        rows = self.rows[self.rows < len(x)]
        at = x[rows].reshape(len(rows), -1, 3)[:, nodes]
        return np.einsum("ma...,tmai->tmi...", weights, at)

    def _coordinate_derivatives(self, x: Array, shape: tuple[Index, ShapeFunctions]) -> Array:
        """Return derivatives (R, estimated, 3, k) of the points by their own k coordinates."""
        nodes, functions = shape
        estimated = self.association.estimated
        if not len(estimated):
            return np.zeros((len(self.rows), 0, 3, self.coordinate_parameters.shape[1]))
        return self._interpolate(x, nodes[estimated], weights=functions.gradients[estimated])

    def evaluate(self, motion: ObservedMotion, phi: Array) -> Array:
        """Return the positions (R, e, 3) of the points in a motion [m] at φ (k,), at those R of the
        observable's times that the motion covers.
        """
        return self.evaluate_positions(motion.x, phi)

    def evaluate_positions(self, x: Array, phi: Array) -> Array:
        """Return the positions (R, e, 3) of the e points [m] at φ, at those of the observable's R
        rows that x (rows, 3n) [m] contains.
        """
        nodes, shape = self.shape_functions(phi)
        return self._interpolate(x, nodes, weights=shape.weights)

    def linearise(
        self, motion: ObservedMotion, phi: Array, columns: Index, size: int
    ) -> tuple[Array, ObservableDerivatives]:
        """Return the values (R, e, 3) [m] and their derivatives.

        Parameters
        ----------
        motion : ObservedMotion
            The motion, with its changes (R, 3e, c); without them, x does not change.
        phi : (k,) array
            Nuisance parameters.
        columns : (c,) array
            Indices of the parameters of the changes among all parameters.
        size : int
            Number of all parameters; not used here.
        """
        values = self.evaluate(motion, phi)
        by = (
            np.zeros((len(values), 3 * self.vector_count, 0))
            if motion.changes is None
            else motion.changes
        )
        return values, self.derivatives_from(
            motion.x, self.shape_functions(phi), columns=columns, changes=by
        )

    def derivatives_from(
        self,
        x: Array,
        shape_functions: tuple[Index, ShapeFunctions],
        columns: Index,
        changes: Array,
    ) -> ObservableDerivatives:
        """Return the derivatives of the values by parameters, those of the motion and the points'
        own coordinates.

        Parameters
        ----------
        x : (rows, 3n) array
            Positions [m].
        shape_functions : tuple
            Result of `shape_functions` at φ.
        columns : (c,) array of int
            Indices of the parameters of the changes.
        changes : (R, 3e, c) array
            Derivatives of the points by these parameters through the positions x.
        """
        estimated = self.association.estimated
        changes = changes.reshape(len(changes), self.vector_count, 3, changes.shape[2])
        return ObservableDerivatives(
            columns,
            changes,
            entities=estimated,
            own_parameters=self.coordinate_parameters[estimated],
            by_own=self._coordinate_derivatives(x, shape_functions),
        )

    def vjp(
        self, motion: ObservedMotion, phi: Array, by_values: Array
    ) -> tuple[Array, Array | None, Array]:
        """Vector–Jacobian product: derivatives of a scalar by x (N, 3n), by reaction forces, which is
        None, and by φ (k,), from those by the values.

        Parameters
        ----------
        phi : (k,) array
            Nuisance parameters.
        by_values : (R, e, 3) array
            Derivatives of the scalar by the values.
        """
        by_x = np.zeros_like(motion.x)
        by_phi = np.zeros(len(phi))
        here = self.association.estimated
        rows = by_values.reshape(len(by_values), -1)
        by_x[self.rows] = (self.operator(phi).T @ rows.T).T
        if len(here):
            own = np.einsum(
                "tmi,tmik->mk",
                by_values[:, here],
                self._coordinate_derivatives(motion.x, self.shape_functions(phi)),
            )
            by_phi[self.coordinate_parameters[here]] = own
        return by_x, None, by_phi

    def frame_changes(
        self, grasp: Grasp, motion: ObservedMotion, phi: Array, shifts: Array, rotations: Array
    ) -> Array | float:
        """Return the changes of the values due to sensor frames moved by pose errors: 0 for points
        of the body.

        The signature is that of `ReactionResultant.frame_changes`.
        """
        return 0.0

    # By (x, φ) --------------------------------------------------------------------------------

    @cached_property
    def _dependencies(self) -> tuple[Index, Index]:
        """Index of point and corner (w,) of each pair on which a position can depend."""
        _, shape = self.association.shape_functions(self.association.centre_coordinates)
        reads = shape.weights != 0
        reads[self.association.estimated] = True
        marker, corner = np.nonzero(reads)
        return marker, corner

    def _derivative_entries(self, variables: int, size: int) -> tuple[Index, Index]:
        """Rows and columns of `derivative_matrix`: x, then φ."""
        nodes, _ = self.shape_functions(np.zeros(size))
        marker, corner = self._dependencies
        axes = np.arange(3)
        dofs = 3 * self.node_count
        first = 3 * self.vector_count * np.arange(self.count)[:, None, None]
        estimated = self.association.estimated
        row_place = np.broadcast_to(
            first[..., None] + 3 * estimated[:, None, None] + axes[:, None],
            (self.count, len(estimated), 3, self.coordinate_parameters.shape[1]),
        )
        pairs = (
            (
                first + 3 * marker[:, None] + axes,
                (self.rows * dofs)[:, None, None] + 3 * nodes[marker, corner][:, None] + axes,
            ),
            (
                row_place,
                np.broadcast_to(
                    variables + self.coordinate_parameters[estimated][:, None], row_place.shape
                ),
            ),
            (3 * self.vector_count * self.count + np.arange(size), variables + np.arange(size)),
        )
        rows = np.concatenate([row.ravel() for row, _ in pairs])
        return rows, np.concatenate([column.ravel() for _, column in pairs])

    def derivative_matrix(self, x: Array | None, phi: Array, position_count: int) -> sp.csr_array:
        """Return the sparse derivative of the stacked positions c of all points at all rows, and of
        φ itself, by (x, φ).

        The rows are those of c (3 T e), one observed time after the other, then of φ; the columns
        those of x, then of φ.

        Parameters
        ----------
        x : (N, 3n) array or None
            Positions [m]; None gives the structure, with ones.
        phi : (k,) array
            Nuisance parameters.
        position_count : int
            Number of positions N · 3n.
        """
        size = len(phi)
        entries = self._derivative_entries(position_count, len(phi))
        if x is None:
            values = np.ones(len(entries[0]))
        else:
            nodes, shape = self.shape_functions(phi)
            weights = shape.weights[self._dependencies][:, None]
            of_x = np.broadcast_to(weights, (self.count, len(weights), 3))
            own = self._coordinate_derivatives(x, (nodes, shape))
            values = np.concatenate([of_x.ravel(), own.ravel(), np.ones(size)])
        row_count = 3 * self.vector_count * self.count + size
        return sp.csr_array((values, entries), shape=(row_count, position_count + size))

    def curvature(
        self, x: Array, phi: Array, by_values: Array, position_count: int
    ) -> SparseEntries:
        """Return Σ by_values · ∂²c/∂(x, φ)², upper triangle; there are entries for estimated places
        only.

        Parameters
        ----------
        x : (N, 3n) array
            Positions [m].
        phi : (k,) array
            Nuisance parameters.
        by_values : (T, e, 3) array
            Weights.
        position_count : int
            Number of positions N · 3n, all of which precede φ.
        """
        estimated = self.association.estimated
        nodes, shape = self.shape_functions(phi)
        weights = by_values[:, estimated]
        dofs = 3 * self.node_count
        dof = 3 * nodes[estimated][:, :, None] + np.arange(3)  # (m, a, axis)
        row = self.rows[:, None, None, None, None] * dofs + dof[..., None]
        column = position_count + self.coordinate_parameters[estimated]
        value = np.einsum("tmi,mak->tmaik", weights, shape.gradients[estimated])
        rows, columns = np.broadcast_arrays(row, column[:, None, None])
        by_coordinates = self._interpolate(x, nodes[estimated], weights=shape.hessians[estimated])
        by_coordinates = np.einsum("tmi,tmikl->mkl", weights, by_coordinates)
        upper = np.nonzero(
            np.broadcast_to(np.triu(np.ones(by_coordinates.shape[1:])), by_coordinates.shape)
        )
        return SparseEntries(
            np.concatenate([rows.ravel(), column[upper[0], upper[1]]]),
            np.concatenate([columns.ravel(), column[upper[0], upper[2]]]),
            values=np.concatenate([value.ravel(), by_coordinates[upper]]),
        )


def interpolation_matrix(nodes: Index, weights: Array, node_count: int) -> sp.csr_array:
    """Return the matrix (3M, 3n) of Σ_a weights[m, a] x_a for nodes (M, npe); row 3 m + axis,
    column 3 node + axis, without entries of zero weights.
    """
    marker = np.repeat(np.arange(len(nodes)), nodes.shape[1])
    per_node = sp.csr_array(
        (weights.ravel(), (marker, nodes.ravel())), shape=(len(nodes), node_count)
    )
    per_node.eliminate_zeros()
    return sp.csr_array(sp.kron(per_node, sp.eye_array(3), format="csr"))
