"""One experiment's share of the collocation NLP: its rows, columns, and derivative values.

In scaled quantities: variables x / `length_m`, dynamics rows c / `force_n`, grasp rows
(x − u x̄) / `length_m`.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..experiment.experiment import Experiment
from ..fem.pattern import dofs_of
from .block_band import Block, BlockBand, Term
from .dynamics import Dynamics
from .observation import Observation
from .parameters import Theta

Array = NDArray[np.float64]
Index = NDArray[np.int64]


class Segment:
    """The variables x_{t,i} and constraints of one experiment.

    Parameters
    ----------
    experiment : Experiment
    scheme : str
    substeps : int
    theta : Theta
        Where the constraints are scaled.
    nq : int
        Number of estimated parameters.
    explicit_grasps : bool
        Grasped nodes get rows of their own instead of bounds.

    Attributes
    ----------
    rows_per_time : int
        Constraint rows of a grid time: free dofs, or all dofs with explicit grasps.
    row_dofs : (rows_per_time,) the dof of each row
    """

    def __init__(
        self,
        experiment: Experiment,
        scheme: str,
        substeps: int,
        theta: Theta,
        nq: int,
        explicit_grasps: bool = False,
    ) -> None:
        self.experiment = experiment
        self.nq = nq
        self.body = experiment.body
        self.dynamics = Dynamics.of(experiment, scheme, substeps)
        grid = self.dynamics.t_s
        self.observation = Observation(
            experiment.markers, np.arange(len(experiment.t_s)) * substeps
        )
        self.explicit_grasps = explicit_grasps
        self.dofs = self.body.pattern.size
        self.free_dofs = dofs_of(experiment.free_nodes)
        self.held_dofs = dofs_of(experiment.held_nodes)
        self.held_positions = experiment.held_positions(grid).reshape(len(grid), -1)
        self.row_dofs = np.arange(self.dofs) if explicit_grasps else self.free_dofs
        self.rows_per_time = len(self.row_dofs)
        self.length_m = float(
            np.linalg.norm(np.diff(self.body.nodes_m[self.body.mesh.edges], axis=1), axis=2).mean()
        )
        self.force_n = self.length_m * self._typical_stiffness(theta)

    @property
    def grid_rows(self) -> int:
        """N, grid times."""
        return self.dynamics.rows

    @property
    def variables(self) -> int:
        """N · 3n."""
        return self.grid_rows * self.dofs

    @property
    def constraint_times(self) -> int:
        """Grid times that have rows."""
        return self.grid_rows - self.dynamics.first_row

    @property
    def constraints(self) -> int:
        """Number of rows."""
        return self.constraint_times * self.rows_per_time

    def start_positions(self) -> Array | None:
        """(3n,) the given x_0, or None when it is found as an equilibrium."""
        experiment = self.experiment
        if experiment.start == "equilibrium":
            return None
        if experiment.start_positions_m is not None:
            return experiment.start_positions_m.ravel()
        return experiment.rigid_positions(self.dynamics.t_s[:1]).ravel()

    def bounds(self) -> tuple[Array, Array]:
        """(N, 3n) lower and upper bounds in metres; equal where a value is given."""
        lower = np.full((self.grid_rows, self.dofs), -np.inf)
        upper = np.full((self.grid_rows, self.dofs), np.inf)
        if not self.explicit_grasps:
            lower[:, self.held_dofs] = upper[:, self.held_dofs] = self.held_positions
        start = self.start_positions()
        if start is not None:
            lower[0] = upper[0] = start
        return lower, upper

    # Values ---------------------------------------------------------------------------------

    def constraint_values(self, x: Array, theta: Theta) -> Array:
        """(constraints,) scaled rows at x (N, 3n) in metres."""
        return self._rows(x, self.dynamics.residual(x, theta))

    def _rows(self, x: Array, residual_n: Array) -> Array:
        rows = residual_n / self.force_n
        if self.explicit_grasps:
            rows[:, self.held_dofs] = (x[:, self.held_dofs] - self.held_positions) / self.length_m
        return rows[self.dynamics.first_row :, self.row_dofs].ravel()

    def residual_n(self, x: Array, theta: Theta) -> Array:
        """(N, free dofs) violation of the equations of motion in newtons."""
        return self.dynamics.residual(x, theta)[:, self.free_dofs]

    @cached_property
    def jacobian(self) -> BlockBand:
        """Structure of ∂c/∂x; row numbers count within the segment."""
        rows, columns, source = self.body.pattern.full
        row_place = np.full(self.dofs, -1)
        row_place[self.row_dofs] = np.arange(self.rows_per_time)
        free = np.zeros(self.dofs, dtype=bool)
        free[self.free_dofs] = True
        whole = free[rows]
        scale = self.length_m / self.force_n
        blocks = []
        for lag in range(self.dynamics.reach + 1):
            terms = [
                # Column time t has the block of row t + lag, whose coefficients are at t + lag.
                Term(
                    lag - j - self.dynamics.first_row,
                    scale * _ahead(a, lag),
                    scale * _ahead(b, lag),
                )
                for j, a, b in self.dynamics.block_terms(lag)
            ]
            kept = whole.copy() if terms else whole & (rows == columns)
            if lag == 0 and self.explicit_grasps:
                kept |= ~free[rows] & (rows == columns)
            # Grasp rows hold constants only: they are written after the terms.
            blocks.append(Block(lag, row_place[rows[kept]], columns[kept], source[kept], terms))
        return BlockBand(self.dofs, self._row_starts(), blocks)

    @cached_property
    def _jacobian_constants(self) -> tuple[Index, Array, Index]:
        """Positions and values of the inertia, and positions of the unit grasp entries."""
        first = self.dynamics.first_row
        row_place = np.searchsorted(self.row_dofs, self.free_dofs)
        mass = self.body.dof_mass[self.free_dofs] * self.length_m / self.force_n
        positions, values = [np.zeros(0, dtype=np.int64)], [np.zeros(0)]
        for lag in range(self.dynamics.reach + 1):
            coefficient = self.dynamics.inertia_coefficient(lag)
            rows = np.arange(max(first, lag), self.grid_rows)
            rows = rows[coefficient[rows] != 0]
            places = self.jacobian.positions(rows - lag, lag, row_place, self.free_dofs)
            positions.append(places.ravel())
            values.append(np.outer(coefficient[rows], mass).ravel())
        grasps = np.zeros(0, dtype=np.int64)
        if self.explicit_grasps:
            rows = np.arange(first, self.grid_rows)
            grasps = self.jacobian.positions(rows, 0, self.held_dofs, self.held_dofs).ravel()
        return np.concatenate(positions), np.concatenate(values), grasps

    def constraints_and_jacobian(
        self, x: Array, theta: Theta, theta_q: Array, values: Array
    ) -> tuple[Array, Array]:
        """Write ∂c/∂x into `values` (jacobian.nnz,).

        Parameters
        ----------
        x : (N, 3n) metres
        theta_q : (4, nq) ∂θ/∂q

        Returns
        -------
        rows : (constraints,) c
        by_q : (constraints, nq) ∂c/∂q
        """
        dynamics = self.dynamics
        forces = dynamics.linearise(x, theta, self.linearisation_rows)
        self.jacobian.fill(values, forces.by_position, forces.by_velocity, self.body.threads)
        positions, inertia, grasps = self._jacobian_constants
        values[positions] += inertia
        values[grasps] = 1.0
        by_theta = np.zeros((self.grid_rows, self.dofs, theta_q.shape[1]))
        by_theta[dynamics.first_row :] = forces.by_theta @ (theta_q / self.force_n)
        by_theta = dynamics.combine(dynamics.tables.w, by_theta)
        by_theta[:, self.held_dofs] = 0
        by_q = by_theta[dynamics.first_row :, self.row_dofs]
        rows = self._rows(x, dynamics.assemble_residual(x, forces.force))
        return rows, by_q.reshape(self.constraints, theta_q.shape[1])

    @cached_property
    def linearisation_rows(self) -> Array:
        """Work space of `constraints_and_jacobian`."""
        # Kept between calls: fresh pages would cost as much as the numbers in them.
        return np.zeros((self.constraint_times, self.body.linearisation_width))

    # Second derivatives -----------------------------------------------------------------------

    @cached_property
    def hessian(self) -> BlockBand:
        """Structure of the upper triangle of the Lagrangian's Hessian in the columns of x.

        The nq rows of q stand above the rows of x.
        """
        rows, columns, source = self.body.pattern.full
        blocks = []
        for distance in range(self.dynamics.reach + 1):
            terms = list(self._curvature_terms(distance))
            if distance > 0 and not terms:
                continue
            kept = rows <= columns if distance == 0 else np.ones(len(rows), dtype=bool)
            blocks.append(Block(-distance, rows[kept], columns[kept], source[kept], terms))
        starts = self.nq + np.arange(self.grid_rows) * self.dofs
        return BlockBand(self.dofs, starts, blocks, top=self.nq)

    def _curvature_terms(self, distance: int) -> Iterator[Term]:
        """Terms of ∂²φ/∂x_{t−distance}∂x_t, from evaluations k = t + i."""
        t = self.dynamics.tables
        first = self.dynamics.first_row
        scale = self.length_m**2
        step = self.dynamics.step_s
        for i in range(self.dynamics.reach + 1 - distance):
            other = i + distance
            xx = scale * t.p[:, i] * t.p[:, other]
            xv = scale * (t.p[:, i] * t.q[:, other] + t.q[:, i] * t.p[:, other]) / step
            if xx.any() or xv.any():
                yield Term(i - first, _ahead(xx, i), _ahead(xv, i))

    def hessian_values(
        self,
        x: Array,
        theta: Theta,
        theta_q: Array,
        multipliers: Array,
        loss_weight: float,
        values: Array,
    ) -> tuple[Array, Array]:
        """Write the columns of x of ∇²(loss_weight · L + multipliers · c) into `values`.

        Returns
        -------
        theta_theta : (4, 4) ∂²(multipliers · c)/∂θ²
        theta_gradient : (4,) ∂(multipliers · c)/∂θ
        """
        dynamics, band = self.dynamics, self.hessian
        first = dynamics.first_row
        row_weights = np.zeros((self.grid_rows, self.dofs))
        by_time = multipliers.reshape(self.constraint_times, self.rows_per_time)
        row_weights[first:, self.row_dofs] = by_time / self.force_n
        row_weights[:, self.held_dofs] = 0
        weights = dynamics.combine_transposed(dynamics.tables.w, row_weights)[first:]
        curvature = self.body.curvature(
            *dynamics.evaluation_states(x), weights, theta, self._curvature_rows
        )
        band.fill(
            values,
            curvature.position_position,
            curvature.position_velocity,
            self.body.threads,
        )
        places, loss = self._loss_positions
        values[places] += loss_weight * self.length_m**2 * loss
        mixed = np.zeros((2, self.grid_rows, self.dofs, self.nq))
        mixed[0, first:] = curvature.position_theta @ theta_q
        mixed[1, first:] = curvature.velocity_theta @ (theta_q / dynamics.step_s)
        by_theta = dynamics.combine_transposed(dynamics.tables.p, mixed[0])
        by_theta += dynamics.combine_transposed(dynamics.tables.q, mixed[1])
        values[band.top_positions] = self.length_m * by_theta.reshape(band.top_positions.shape)
        return curvature.theta_theta.sum(axis=0), curvature.theta.sum(axis=0)

    @cached_property
    def _curvature_rows(self) -> Array:
        return np.zeros((self.constraint_times, self.body.curvature_width))

    @cached_property
    def hessian_diagonal(self) -> Index:
        """Positions of the diagonal entries of x in the values of `hessian`."""
        dofs = np.arange(self.dofs)
        return self.hessian.positions(np.arange(self.grid_rows), 0, dofs, dofs).ravel()

    @cached_property
    def _loss_positions(self) -> tuple[Index, Array]:
        """Positions of the loss's Hessian in the values, and its values in metres⁻²."""
        pattern = self.body.pattern
        lower, values = self.observation.hessian(pattern)
        rows, columns = pattern.columns[lower], pattern.rows[lower]  # the upper triangle
        return self.hessian.positions(self.observation.grid_rows, 0, rows, columns), values

    # Structure --------------------------------------------------------------------------------

    def _row_starts(self) -> Index:
        starts = (np.arange(self.grid_rows) - self.dynamics.first_row) * self.rows_per_time
        return np.maximum(starts, -1) if self.dynamics.first_row else starts

    def _typical_stiffness(self, theta: Theta) -> float:
        """Mean of |∂c_t/∂x_t| on the diagonal, at the undeformed shape [N/m]."""
        at_rest = self.body.nodes_m[None]
        forces = self.body.linearise(at_rest, np.zeros_like(at_rest), theta)
        row = self.grid_rows - 1
        diagonal = self.body.pattern.diagonal
        value = self.dynamics.inertia_coefficient(0)[row] * self.body.dof_mass
        for j, a, b in self.dynamics.block_terms(0):
            if j == 0:
                value = value + a[row] * forces.by_position[0, diagonal]
                value = value + b[row] * forces.by_velocity[0, diagonal]
        return float(np.abs(value[self.free_dofs]).mean())


def _ahead(values: Array, steps: int) -> Array:
    """values[t + steps] at t, zero beyond the end."""
    shifted = np.zeros_like(values)
    shifted[: len(values) - steps] = values[steps:]
    return shifted
