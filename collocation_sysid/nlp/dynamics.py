"""The discrete equations of motion of one experiment, row by row from a scheme's table."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..experiment.experiment import Experiment
from ..fem.body import Body, Linearisation
from .parameters import Theta
from .schemes import Scheme, scheme_named

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Tables:
    """Stencil coefficients of every row, padded to the scheme's reach: (N, reach + 1) each."""

    p: Array
    q: Array
    w: Array
    s: Array
    r: Array  # (N,)

    @classmethod
    def of(cls, scheme: Scheme, rows: int, first_row: int) -> Tables:
        """Tables of rows 0…`rows` − 1; those before `first_row` stay zero."""
        p, q, w, s = (np.zeros((rows, scheme.reach + 1)) for _ in range(4))
        r = np.zeros(rows)
        for row in range(first_row, rows):
            stencil = scheme.stencil(row)
            for table, values in ((p, stencil.p), (q, stencil.q), (w, stencil.w), (s, stencil.s)):
                table[row, : len(values)] = values
            r[row] = stencil.r
        return cls(p, q, w, s, r)


@dataclass(frozen=True, eq=False)
class Dynamics:
    """c_t(x; θ) for rows t = `first_row` … N − 1 of a uniform grid, all dofs included.

    Row 0 exists when the experiment starts in equilibrium and is the static problem.

    Attributes
    ----------
    body : Body
    tables : Tables
    t_s : (N,) grid times
    first_row : int
    external_force_n : (3n,) gravity and other constant forces
    start_velocity_m_s : (3n,)
    """

    body: Body
    tables: Tables
    t_s: Array
    first_row: int
    external_force_n: Array
    start_velocity_m_s: Array

    @classmethod
    def of(cls, experiment: Experiment, scheme_name: str, substeps: int = 1) -> Dynamics:
        """Discretise an experiment with `substeps` steps between samples."""
        body = experiment.body
        rows = (len(experiment.t_s) - 1) * substeps + 1
        t_s = experiment.t_s[0] + np.arange(rows) * experiment.timestep_s / substeps
        first_row = 0 if experiment.start == "equilibrium" else 1
        scheme = scheme_named(scheme_name, experiment.start_rule)
        velocity = experiment.start_velocities_m_s
        return cls(
            body,
            Tables.of(scheme, rows, first_row),
            t_s,
            first_row,
            external_force(experiment),
            np.zeros(body.pattern.size) if velocity is None else np.ravel(velocity).astype(float),
        )

    @property
    def rows(self) -> int:
        """N, the number of grid points."""
        return len(self.t_s)

    @property
    def step_s(self) -> float:
        """Δt of the grid."""
        return float(self.t_s[1] - self.t_s[0])

    @property
    def reach(self) -> int:
        """Largest lag of the scheme."""
        return self.tables.p.shape[1] - 1

    def evaluation_states(self, x: Array) -> tuple[Array, Array]:
        """ξ_k and ν_k of rows `first_row`…, each (N − first_row, 3n), from x (N, 3n)."""
        xi = self.combine(self.tables.p, x)
        nu = self.combine(self.tables.q, x) / self.step_s
        return xi[self.first_row :], nu[self.first_row :]

    def combine(self, table: Array, rows: Array) -> Array:
        """Σ_i table[t, i] rows[t − i] for every t; `rows` is (N, …)."""
        result = np.zeros_like(rows)
        shape = (-1,) + (1,) * (rows.ndim - 1)
        for lag in range(min(table.shape[1], len(rows))):
            column = table[lag:, lag].reshape(shape)
            if np.any(column):
                result[lag:] += column * rows[: len(rows) - lag]
        return result

    def combine_transposed(self, table: Array, rows: Array) -> Array:
        """Σ_i table[k + i, i] rows[k + i] for every k, the transpose of `combine`."""
        result = np.zeros_like(rows)
        shape = (-1,) + (1,) * (rows.ndim - 1)
        for lag in range(min(table.shape[1], len(rows))):
            column = table[lag:, lag].reshape(shape)
            if np.any(column):
                result[: len(rows) - lag] += column * rows[lag:]
        return result

    def residual(self, x: Array, theta: Theta) -> Array:
        """Residuals c (N, 3n) [N] at positions x (N, 3n); rows before `first_row` are zero."""
        return self.assemble_residual(x, self.body.force(*self.evaluation_states(x), theta))

    def assemble_residual(self, x: Array, force: Array) -> Array:
        """The same from the internal forces (N − first_row, 3n) at the evaluation states."""
        total = np.zeros_like(x)
        total[self.first_row :] = force + self.external_force_n
        return self.combine(self.tables.w, total) - self.inertia(x)

    def inertia(self, x: Array) -> Array:
        """Mass times acceleration of every row, (N, 3n) [N]."""
        acceleration = self.combine(self.tables.s, x) / self.step_s**2
        acceleration += np.outer(self.tables.r / self.step_s, self.start_velocity_m_s)
        return acceleration * self.body.dof_mass

    def linearise(self, x: Array, theta: Theta, out: Array | None = None) -> Linearisation:
        """Forces and derivatives at the evaluation states of x (N, 3n)."""
        return self.body.linearise(*self.evaluation_states(x), theta, out)

    def block_terms(self, lag: int) -> Iterator[tuple[int, Array, Array]]:
        """The force part of ∂c_t/∂x_{t−lag} as Σ_j a_j[t] G_{t−j} + b_j[t] C_{t−j}.

        G and C are `by_position` and `by_velocity` at evaluation t − j.

        Yields
        ------
        j, a, b : int, (N,) and (N,) arrays, where any is not zero
        """
        t = self.tables
        for j in range(min(lag + 1, self.rows)):
            a, b = np.zeros(self.rows), np.zeros(self.rows)
            weights = t.w[j:, j]
            a[j:] = weights * t.p[: self.rows - j, lag - j]
            b[j:] = weights * t.q[: self.rows - j, lag - j] / self.step_s
            if a.any() or b.any():
                yield j, a, b

    def inertia_coefficient(self, lag: int) -> Array:
        """(N,) factor of the mass in ∂c_t/∂x_{t−lag}: −s_lag / Δt²."""
        return -self.tables.s[:, lag] / self.step_s**2


def external_force(experiment: Experiment) -> Array:
    """Gravity and constant external forces of an experiment, (3n,) [N]."""
    body = experiment.body
    force = body.node_mass[:, None] * np.asarray(experiment.gravity_m_s2)
    if experiment.external_force_n is not None:
        force = force + experiment.external_force_n
    return force.ravel()
