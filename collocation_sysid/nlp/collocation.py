"""The collocation NLP: all node positions at all timesteps beside the parameters.

    minimise   L(q, x) = Σ ‖(ŷ − h(x)) / σ‖² + priors(q)
    subject to c_{e,t,i}(x, θ(q)) = 0 for free dofs, and x_{e,t,i} = u_t x̄_i for grasped ones.

Variables z, in this order:

=================  =========================================================================
q                  ln of each estimated parameter, in the order of `Parameters.free`
x_{e,t,i} / ℓ_e    positions: experiment e, grid time t, dof i = 3·node + axis, the last
                   index fastest; ℓ_e is the mean edge length
=================  =========================================================================

Constraints g, in this order:

=================  =========================================================================
c_{e,t,i} / f_e    equations of motion: experiment e, grid time t from 0 (start in
                   equilibrium) or 1, free dofs i ascending; f_e is the mean of
                   |∂c_t/∂x_t| ℓ_e at the guess
(x − u x̄) / ℓ_e    only with explicit grasps: then every dof has a row, and the grasped
                   ones have this
=================  =========================================================================
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from ..errors import InputError
from ..experiment.experiment import Experiment
from .parameters import Parameters, Theta
from .segment import Segment

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True)
class Violation:
    """One unsatisfied equation of motion."""

    experiment: str
    time_s: float
    node: int
    axis: str
    newtons: float

    def __str__(self) -> str:
        return (
            f"{self.experiment}: t = {self.time_s:.4g} s, node {self.node}, {self.axis}: "
            f"{self.newtons:+.3g} N"
        )


class Collocation:
    """Values and derivatives of the collocation NLP of one or several experiments.

    Parameters
    ----------
    experiments : sequence of Experiment
        They share the parameters; those for validation are left out.
    parameters : Parameters
    scheme : str, default "midpoint"
    substeps : int, default 1
        Grid steps between samples.
    explicit_grasps : bool, default False
        Grasped nodes as constraint rows instead of bounds.

    Raises
    ------
    InputError
        If nothing is to be fitted.
    """

    def __init__(
        self,
        experiments: Sequence[Experiment],
        parameters: Parameters,
        scheme: str = "midpoint",
        substeps: int = 1,
        explicit_grasps: bool = False,
    ) -> None:
        fitted = [experiment for experiment in experiments if not experiment.validation]
        if not fitted:
            raise InputError("every experiment is for validation: there is nothing to fit")
        if substeps < 1:
            raise InputError(f"substeps = {substeps}, expected at least 1")
        self.parameters = parameters
        self.scheme = scheme
        self.substeps = substeps
        self.nq = len(parameters.free)
        theta = parameters.theta(parameters.guess_q)
        self.segments = [
            Segment(experiment, scheme, substeps, theta, self.nq, explicit_grasps)
            for experiment in fitted
        ]
        sizes = [segment.variables for segment in self.segments]
        self._x_starts = self.nq + np.concatenate([[0], np.cumsum(sizes)])
        rows = [segment.constraints for segment in self.segments]
        self._row_starts = np.concatenate([[0], np.cumsum(rows)])
        self.loss_scale = 1.0 / max(1, self.measurements)

    # Sizes and layout -------------------------------------------------------------------------

    @property
    def variables(self) -> int:
        """Length of z."""
        return int(self._x_starts[-1])

    @property
    def constraints(self) -> int:
        """Length of g."""
        return int(self._row_starts[-1])

    @property
    def measurements(self) -> int:
        """Scalar measurements that are present."""
        return sum(segment.observation.count for segment in self.segments)

    def pack(self, q: Array, positions: Sequence[Array]) -> Array:
        """Variables z from q (nq,) and positions (N, 3n) [m] of each experiment."""
        scaled = [
            np.ravel(x) / segment.length_m
            for x, segment in zip(positions, self.segments, strict=True)
        ]
        return np.concatenate([q, *scaled])

    def unpack(self, z: Array) -> tuple[Array, list[Array]]:
        """Inverse of `pack`."""
        positions = [
            z[a:b].reshape(segment.grid_rows, segment.dofs) * segment.length_m
            for segment, a, b in self._spans()
        ]
        return z[: self.nq], positions

    def _spans(self) -> list[tuple[Segment, int, int]]:
        return list(zip(self.segments, self._x_starts[:-1], self._x_starts[1:], strict=True))

    def _row_spans(self) -> list[tuple[int, int]]:
        return list(zip(self._row_starts[:-1], self._row_starts[1:], strict=True))

    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of z; equal for what is given."""
        lower, upper = self.parameters.bounds_q
        lows, highs = zip(*(segment.bounds() for segment in self.segments), strict=True)
        return self.pack(lower, lows), self.pack(upper, highs)

    # Objective --------------------------------------------------------------------------------

    def objective(self, z: Array) -> float:
        """L divided by the number of measurements."""
        q, positions = self.unpack(z)
        loss = sum(
            segment.observation.loss(x) for segment, x in zip(self.segments, positions, strict=True)
        )
        residuals, _ = self.parameters.prior(q)
        return self.loss_scale * (loss + float(residuals @ residuals))

    def gradient(self, z: Array) -> Array:
        """∂objective/∂z."""
        q, positions = self.unpack(z)
        residuals, slopes = self.parameters.prior(q)
        parts = [
            np.ravel(segment.observation.gradient(x)) * segment.length_m
            for segment, x in zip(self.segments, positions, strict=True)
        ]
        return self.loss_scale * np.concatenate([2 * residuals * slopes, *parts])

    # Constraints ------------------------------------------------------------------------------

    def constraint_values(self, z: Array) -> Array:
        """g, scaled."""
        q, positions = self.unpack(z)
        theta = self.parameters.theta(q)
        return np.concatenate(
            [
                segment.constraint_values(x, theta)
                for segment, x in zip(self.segments, positions, strict=True)
            ]
        )

    @cached_property
    def jacobian_structure(self) -> tuple[Index, Index]:
        """Column pointers and row indices of ∂g/∂z by compressed columns."""
        dense = np.arange(self.nq + 1) * self.constraints
        indptr, indices = [dense], [np.tile(np.arange(self.constraints), self.nq)]
        used = int(dense[-1])
        for segment, first_row in zip(self.segments, self._row_starts[:-1], strict=True):
            indptr.append(used + segment.jacobian.indptr[1:])
            indices.append(first_row + segment.jacobian.indices)
            used += segment.jacobian.nnz
        return np.concatenate(indptr), np.concatenate(indices)

    def jacobian_values(self, z: Array, out: Array | None = None) -> Array:
        """Values of ∂g/∂z in the order of `jacobian_structure`."""
        return self.constraints_and_jacobian(z, out)[1]

    def constraints_and_jacobian(self, z: Array, out: Array | None = None) -> tuple[Array, Array]:
        """G and the values of ∂g/∂z, from one evaluation of the elements."""
        q, positions = self.unpack(z)
        theta = self.parameters.theta(q)
        theta_q, _ = self.parameters.theta_derivatives(q)
        values = np.empty(len(self.jacobian_structure[1])) if out is None else out
        columns = values[: self.nq * self.constraints].reshape(self.nq, self.constraints)
        rows = np.empty(self.constraints)
        used = columns.size
        for segment, x, (a, b) in zip(self.segments, positions, self._row_spans(), strict=True):
            here = values[used : used + segment.jacobian.nnz]
            rows[a:b], by_q = segment.constraints_and_jacobian(x, theta, theta_q, here)
            columns[:, a:b] = by_q.T
            used += segment.jacobian.nnz
        return rows, values

    def jacobian(self, z: Array) -> sp.csc_array:
        """∂g/∂z as a sparse matrix."""
        indptr, indices = self.jacobian_structure
        shape = (self.constraints, self.variables)
        return sp.csc_array((self.jacobian_values(z), indices, indptr), shape=shape)

    # Lagrangian -------------------------------------------------------------------------------

    @cached_property
    def hessian_structure(self) -> tuple[Index, Index]:
        """The same of the upper triangle of ∇²_z (w L + yᵀ g)."""
        counts = np.arange(self.nq + 1)
        indptr = [counts * (counts + 1) // 2]
        indices = [np.concatenate([np.arange(k) for k in counts])]
        used = int(indptr[0][-1])
        for segment, start, _ in self._spans():
            band = segment.hessian
            indptr.append(used + band.indptr[1:])
            shift = np.where(band.indices < self.nq, 0, start - self.nq)
            indices.append(band.indices + shift)
            used += band.nnz
        return np.concatenate(indptr), np.concatenate(indices)

    @cached_property
    def hessian_diagonals(self) -> tuple[Index, Index]:
        """Positions of the diagonal entries of q, and of x, in the values of the Hessian."""
        used = self.nq * (self.nq + 1) // 2
        of_x = []
        for segment in self.segments:
            of_x.append(used + segment.hessian_diagonal)
            used += segment.hessian.nnz
        return np.cumsum(np.arange(1, self.nq + 1)) - 1, np.concatenate(of_x)

    def hessian_values(
        self, z: Array, loss_weight: float, multipliers: Array, out: Array | None = None
    ) -> Array:
        """Values of ∇²_z (loss_weight · objective + multipliers · g), upper triangle."""
        q, positions = self.unpack(z)
        theta = self.parameters.theta(q)
        theta_q, theta_qq = self.parameters.theta_derivatives(q)
        values = np.empty(len(self.hessian_structure[1])) if out is None else out
        used = self.nq * (self.nq + 1) // 2
        theta_theta, first = np.zeros((4, 4)), np.zeros(4)
        for segment, x, (a, b) in zip(self.segments, positions, self._row_spans(), strict=True):
            here = values[used : used + segment.hessian.nnz]
            second_here, first_here = segment.hessian_values(
                x, theta, theta_q, multipliers[a:b], loss_weight * self.loss_scale, here
            )
            theta_theta += second_here
            first += first_here
            used += segment.hessian.nnz
        _, slopes = self.parameters.prior(q)
        by_q = theta_q.T @ theta_theta @ theta_q + np.einsum("k,kab->ab", first, theta_qq)
        by_q += np.diag(2 * loss_weight * self.loss_scale * slopes**2)
        rows, columns = np.triu_indices(self.nq)
        order = np.lexsort((rows, columns))
        values[: len(rows)] = by_q[rows[order], columns[order]]
        return values

    def kkt_residual(self, z: Array, multipliers: Array) -> float:
        """Largest violation of the first-order conditions of the whole NLP, in its scaling.

        Stationarity of objective + multipliers · g in every variable that is not given; a
        parameter at a bound may only push against it. And feasibility.
        """
        rows, values = self.constraints_and_jacobian(z)
        indptr, indices = self.jacobian_structure
        jacobian = sp.csc_array((values, indices, indptr), shape=(len(rows), len(z)))
        slope = self.gradient(z) + jacobian.T @ multipliers
        lower, upper = self.bounds()
        slope[lower == upper] = 0
        near, of_q, by_q = 1e-6, slice(self.nq), slope[: self.nq]
        at_lower, at_upper = (z - lower)[of_q] < near, (upper - z)[of_q] < near
        by_q[at_lower] = np.minimum(by_q[at_lower], 0)
        by_q[at_upper] = np.maximum(by_q[at_upper], 0)
        return float(max(np.abs(slope).max(initial=0.0), np.abs(rows).max(initial=0.0)))

    def hessian(self, z: Array, loss_weight: float, multipliers: Array) -> sp.csc_array:
        """∇²_z (loss_weight · objective + multipliers · g), both triangles, as a sparse matrix."""
        indptr, indices = self.hessian_structure
        values = self.hessian_values(z, loss_weight, multipliers)
        upper = sp.csc_array((values, indices, indptr), shape=(len(z), len(z)))
        return sp.csc_array(upper + sp.triu(upper, 1).T)

    # Reading a point --------------------------------------------------------------------------

    def violations_n(self, z: Array) -> list[Array]:
        """(N, free dofs) residual of the equations of motion of each experiment [N]."""
        q, positions = self.unpack(z)
        theta = self.parameters.theta(q)
        return [s.residual_n(x, theta) for s, x in zip(self.segments, positions, strict=True)]

    def largest_force_n(self, z: Array) -> float:
        """Largest internal or external force on a free dof [N], the yardstick of violations."""
        q, positions = self.unpack(z)
        theta = self.parameters.theta(q)
        largest = 0.0
        for segment, x in zip(self.segments, positions, strict=True):
            dynamics = segment.dynamics
            internal = dynamics.body.force(*dynamics.evaluation_states(x), theta)
            for force in (internal, dynamics.external_force_n[None]):
                largest = max(largest, float(np.abs(force[:, segment.free_dofs]).max()))
        return largest

    def largest_violations(self, z: Array, count: int = 5) -> list[Violation]:
        """The worst equations of motion in newtons, largest first."""
        found = []
        for segment, residual in zip(self.segments, self.violations_n(z), strict=True):
            flat = np.argsort(-np.abs(residual), axis=None)[:count]
            for t, place in zip(*np.unravel_index(flat, residual.shape), strict=True):
                node, axis = divmod(int(segment.free_dofs[place]), 3)
                found.append(
                    Violation(
                        segment.experiment.name,
                        float(segment.dynamics.t_s[t]),
                        node,
                        "xyz"[axis],
                        float(residual[t, place]),
                    )
                )
        return sorted(found, key=lambda violation: -abs(violation.newtons))[:count]

    def rms_m(self, z: Array) -> float:
        """Root mean square distance of markers from their measurements."""
        _, positions = self.unpack(z)
        squares = samples = 0.0
        for segment, x in zip(self.segments, positions, strict=True):
            squares += float(segment.observation.squared_distances_m2(x).sum())
            samples += segment.experiment.markers.samples
        return float(np.sqrt(squares / max(1.0, samples)))

    def theta(self, z: Array) -> Theta:
        """Physical parameters of z."""
        return self.parameters.theta(z[: self.nq])
