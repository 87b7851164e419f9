"""Discrete equations of motion of one experiment, row by row from the tables of a scheme.

With the time step included in the coefficients, row t is

    c_t = Σ_j w_j F_{t−j} − M (Σ_i s_i x_{t−i} + r v_0),
    F_t = f(Σ_i p_i x_{t−i}, Σ_i q_i x_{t−i}; θ) + f_ext,

so that with G = ∂F/∂ξ and C = ∂F/∂ν at evaluation t (see `schemes`)

    −∂c_t/∂x_t = s_0 M − w_0 (p_0 G + q_0 C).

Use `Dynamics.from_experiment` to discretise an experiment, `Dynamics.residual` and
`Dynamics.linearise` to evaluate all rows, and `StencilRow` for time-marching methods that need the
coefficients of one row.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..common.array_types import Array
from ..common.time_dependence import PARTS_OVER_TIME, at_times, over_time
from ..fem.body import Body, Linearisation
from ..fem.pattern import SymmetricPattern
from ..fem.schemes import QUASI_STATIC, SLIDING, Scheme, as_scheme
from ..recording.experiment import Experiment
from .force_internal_variables import ForceHistory
from .forces import Forces
from .internal_variables import AnyHistory, histories_of_trajectory
from .weight import DofMasses


@dataclass(frozen=True, eq=False)
class StencilTables:
    """Stencil coefficients of every row, padded with zeros to the largest lag of the scheme."""

    # (N, reach + 1): coefficients of each row by lag, see `schemes.Stencil`.
    p: Array = field(metadata=over_time())
    q: Array = field(metadata=over_time())
    w: Array = field(metadata=over_time())
    s: Array = field(metadata=over_time())
    r: Array = field(metadata=over_time())  # (N,): coefficient of the start velocity

    @classmethod
    def from_scheme(cls, scheme: Scheme, rows: int, first_row: int) -> StencilTables:
        """Return the tables of rows 0 … `rows` − 1; rows before `first_row` are zero. Row 0 has the
        stencil of statics.
        """
        p, q, w, s = (np.zeros((rows, scheme.largest_lag + 1)) for _ in range(4))
        r = np.zeros(rows)
        for row in range(first_row, rows):
            stencil = scheme.stencil(row)
            for table, values in ((p, stencil.p), (q, stencil.q), (w, stencil.w), (s, stencil.s)):
                table[row, : len(values)] = values
            r[row] = stencil.r
        return cls(p, q, w=w, s=s, r=r)


@dataclass(frozen=True, eq=False)
class Dynamics:
    """Residuals c_t(x; u) of the equations of motion, t = `first_row` … N − 1, for all 3n dofs.

    The grid of times is uniform. Row 0 is an equation only if the experiment starts in equilibrium;
    it is then the equation of statics. All rows of a static experiment are equations of statics,
    and its times need not be evenly spaced. Evaluation k is the state (ξ_k, ν_k) at which row k
    evaluates the forces.
    """

    body: Body
    tables: StencilTables = field(metadata=PARTS_OVER_TIME)  # stencil coefficients of every row
    t_s: Array = field(metadata=over_time())  # (N,): times of the grid
    first_row: int  # index of the first equation: 0 or 1
    # Mass of every dof in each row: the mean over the evaluations of the row.
    mass: DofMasses = field(metadata=PARTS_OVER_TIME)
    forces: Forces = field(metadata=PARTS_OVER_TIME)  # forces at the N evaluations
    # (N, 3n): prescribed positions; NaN where a dof is free.
    prescribed_m: Array = field(metadata=over_time())
    # (N, 3n) bool: true where a grasp holds a dof that is free at other times. The forces at such a
    # dof are balanced by the reaction force and omitted from all rows, so that a released dof
    # starts like the first step, from its velocity.
    is_temporarily_prescribed: NDArray[np.bool_] = field(metadata=over_time())
    evaluated_s: Array = field(metadata=over_time())  # (N,): times of the evaluations
    start_velocity_m_s: Array  # (3n,): start velocity v_0
    # Time for which the body has been in its start shape; infinite if its memory has relaxed.
    loaded_since_s: float = np.inf
    is_static: bool = False  # whether each row is an equilibrium

    @classmethod
    def from_experiment(
        cls, experiment: Experiment, scheme: str | Scheme, substeps: int = 1
    ) -> Dynamics:
        """Discretise an experiment in time.

        The constants of the body are NaN until `with_theta` or `with_inputs` sets them. Prescribed
        positions are those at φ = 0.

        Parameters
        ----------
        scheme : str or Scheme
            Scheme or its name; ignored for a static experiment.
        substeps : int
            Number of time steps between samples, at least 1; ignored for a static experiment.

        Raises
        ------
        InputError
            If the scheme is unknown or does not fit the start rule of the experiment.
        """
        if experiment.is_static:
            t_s = experiment.t_s
            table = SLIDING if any(o.has_friction for o in experiment.obstacles) else QUASI_STATIC
        else:
            rows = (len(experiment.t_s) - 1) * substeps + 1
            t_s = experiment.t_s[0] + np.arange(rows) * experiment.timestep_s / substeps
            table = as_scheme(scheme, experiment.start_rule)
        rows = len(t_s)
        first_row = 0 if experiment.is_balanced_at_start else 1
        tables = StencilTables.from_scheme(table, rows, first_row=first_row)
        velocity = experiment.initial_velocities_m_s
        dofs = experiment.body.pattern.size
        lags = tables.p @ np.arange(tables.p.shape[1])
        evaluated_s = t_s - lags * experiment.timestep_s / substeps
        averaged_s = 0.0
        if not experiment.is_static and table.is_midpoint():
            averaged_s = experiment.timestep_s / substeps
        forces = Forces.from_experiment(experiment, evaluated_s, step_s=averaged_s)
        goals = experiment.prescribed_displacements(t_s)[1].reshape(rows, -1)
        is_prescribed = ~np.isnan(goals)
        is_prescribed[:, experiment.prescribed_dofs] = False
        return cls(
            body=experiment.body,
            tables=tables,
            t_s=t_s,
            first_row=first_row,
            mass=_row_masses(tables, forces.mass),
            forces=forces,
            prescribed_m=goals,
            is_temporarily_prescribed=is_prescribed,
            evaluated_s=evaluated_s,
            start_velocity_m_s=np.zeros(dofs) if velocity is None else np.array(velocity).ravel(),
            loaded_since_s=experiment.loaded_since_s,
            is_static=experiment.is_static,
        )

    def with_inputs(self, u: Array) -> Dynamics:
        """Return these equations at inputs u (N, U), see `inputs`, with the masses that follow from
        them; self is unchanged.
        """
        return self._with_forces(self.forces.with_inputs(u))

    def with_theta(self, theta: Sequence[float] | Array) -> Dynamics:
        """Return these equations for a body with constants θ (k,), which are copied, with the
        masses that follow from them; self is unchanged.
        """
        return self._with_forces(self.forces.with_theta(theta))

    def _with_forces(self, forces: Forces) -> Dynamics:
        if forces.mass is self.forces.mass:
            return replace(self, forces=forces)
        return replace(self, forces=forces, mass=_row_masses(self.tables, forces.mass))

    def rows_to_evaluations(self, row_values: Array) -> Array:
        """Return quantities of the rows (N, …), distributed to the evaluations (N, …) by the
        transpose of `evaluations_to_rows`. A row without forces has its value at its own
        evaluation.
        """
        total = self.tables.w.sum(axis=1).reshape((-1,) + (1,) * (row_values.ndim - 1))
        shares = row_values / np.where(total == 0, 1.0, total)
        return np.where(total == 0, row_values, 0.0) + self.combine_transposed(
            self.tables.w, shares
        )

    def evaluations_to_rows(self, evaluation_values: Array) -> Array:
        """Return the mean over the evaluations of each row (N, …), weighted like the forces, of
        values (N, …) at the evaluations; a row without forces has the value of its own evaluation.
        If all values are equal, the argument itself is returned.
        """
        return _evaluation_mean(self.tables, evaluation_values)

    def truncated_to(self, rows: int) -> Dynamics:
        """Return these equations on the first grid times only, with views of the arrays; self if
        there are no more.

        Parameters
        ----------
        rows : int
            Number of grid times to keep.
        """
        if rows >= self.row_count:
            return self
        return at_times(self, slice(rows))

    @property
    def pattern(self) -> SymmetricPattern:
        """Sparsity pattern of the blocks ∂c_t/∂x_{t−i}."""
        return self.forces.pattern

    @property
    def row_count(self) -> int:
        """Number N of grid times."""
        return len(self.t_s)

    @property
    def step_s(self) -> float:
        """Time step Δt of the grid [s]; 1 s for a static experiment, which does not depend on Δt.

        Another experiment needs at least two grid times (IndexError otherwise).
        """
        return 1.0 if self.is_static else float(self.t_s[1] - self.t_s[0])

    @property
    def largest_lag(self) -> int:
        """Largest lag l with ∂c_t/∂x_{t−l} ≠ 0 of the scheme, in time steps."""
        return self.tables.p.shape[1] - 1

    def evaluation_states(self, x: Array) -> tuple[Array, Array]:
        """Return ξ_k and ν_k, each (N − first_row, 3n), of the rows from `first_row` on.

        Parameters
        ----------
        x : (N, 3n)
            Positions at all grid times [m].
        """
        xi = self.combine(self.tables.p, x)
        nu = self.combine(self.tables.q, x) / self.step_s
        return xi[self.first_row :], nu[self.first_row :]

    @property
    def state_weights(self) -> Array:
        """Weights (N, reach + 1) of x_{t−i} in ξ_t, where a given start counts as an
        evaluation.

        Rows before `first_row` have weight 1 at lag 0: internal variables begin with the start
        state.
        """
        weights = self.tables.p.copy()
        weights[: self.first_row, 0] = 1.0
        return weights

    @property
    def intervals_to_next_s(self) -> Array:
        """Time [s] from each evaluation to the next (N,).

        The last entry is one step; in a static experiment 1 s.
        """
        if self.is_static:
            return np.append(np.diff(self.t_s), 1.0)
        lags = self.tables.p @ np.arange(self.largest_lag + 1.0)
        return self.step_s * np.append(np.diff(np.arange(self.row_count) - lags), 1.0)

    @property
    def theta(self) -> Array:
        """Constants θ of the body (k,)."""
        return self.forces.theta

    def histories(
        self, x: Array, previous_states: Mapping[int, Array] | None = None
    ) -> tuple[AnyHistory, ...]:
        """Return the internal variables along a motion: of the memory, if the body has one, then of
        each force with internal variables; an empty tuple if there are none.

        Parameters
        ----------
        x : (N, 3n)
            Positions [m]; fewer rows for the beginning of the motion.
        previous_states : mapping, optional
            Given internal variables of the previous evaluation, by the index of the history in the
            result. Internal variables that are not given are computed from x.
        """
        if not (self.body.has_memory or self.forces.terms_with_internal_variables):
            return ()
        first_rows = slice(len(x))
        states = self.all_evaluation_states(x)
        return histories_of_trajectory(
            at_times(self.forces, first_rows),
            states,
            until_next_s=self.intervals_to_next_s[first_rows],
            loaded_s=self.loaded_since_s,
            previous_states=previous_states or {},
        )

    def forces_with_pressures(
        self, x: Array, scaled_pressures: Mapping[int, Array]
    ) -> tuple[AnyHistory, ...]:
        """Return the forces of obstacles at given pressures b, one object with the interface of
        `ForceHistory` for each entry.

        Parameters
        ----------
        x : (N, 3n)
            Positions [m].
        scaled_pressures : mapping
            Scaled pressure b (1, N, points) [m] by the index of the force in
            `Forces.external_terms`.
        """
        states = self.all_evaluation_states(x)
        since_s = np.zeros(len(x))
        return tuple(
            ForceHistory.from_states(self.forces, number, *states, since_s, b)
            for number, b in scaled_pressures.items()
        )

    def all_evaluation_states(self, x: Array) -> tuple[Array, Array]:
        """Return ξ and ν at all evaluations, including a given start.

        Parameters
        ----------
        x : (N, 3n)
            Positions [m]; fewer rows for the beginning of the motion.

        Returns
        -------
        xi, nu : (N, 3n)
            Positions [m] and velocities [m/s]; before `first_row`, ν is the start velocity.
        """
        xi = self.combine(self.state_weights[: len(x)], x)
        nu = self.combine(self.tables.q[: len(x)], x) / self.step_s
        nu[: self.first_row] = self.start_velocity_m_s
        return xi, nu

    def forces_with_histories(
        self, histories: Sequence[AnyHistory], rows: slice | None = None
    ) -> Forces:
        """Return the forces of some rows with the internal variables of the motion.

        Parameters
        ----------
        histories : sequence of histories
            Histories of the complete motion; without any, forces have no internal variables.
        rows : slice, optional
            Indices of the rows; by default all from `first_row` on.
        """
        rows = slice(self.first_row, self.row_count) if rows is None else rows
        forces = at_times(self.forces, rows)
        for history in histories:
            forces = history.insert_into(forces, rows)
        return forces

    def combine(self, table: Array, rows: Array) -> Array:
        """Return Σ_i table[t, i] rows[t − i] for every t, from coefficients (N, lags) and `rows`
        (N, …), in the shape of `rows`; terms before the start are omitted.
        """
        return _combine(table, rows)

    def combine_transposed(self, table: Array, rows: Array) -> Array:
        """Return Σ_i table[k + i, i] rows[k + i] for every k (N, …), from coefficients (N, lags)
        and `rows` (N, …): the transpose of `combine`. Terms after the end are omitted.
        """
        result = np.zeros_like(rows)
        shape = (-1,) + (1,) * (rows.ndim - 1)
        for lag in range(min(table.shape[1], len(rows))):
            column = table[lag:, lag].reshape(shape)
            if np.any(column):
                result[: len(rows) - lag] += column * rows[lag:]
        return result

    def residual(self, x: Array, histories: Sequence[AnyHistory] = ()) -> Array:
        """Return the residuals c (N, 3n) [N]; rows before `first_row` are zero.

        Parameters
        ----------
        x : (N, 3n)
            Positions [m].
        histories : sequence of histories
            Internal variables of the motion; computed from x where the sequence is empty.
        """
        return self.assemble_residual(x, self.force(x, histories))

    def select_evaluated_forces(self) -> Forces:
        """Return the forces of the rows from `first_row` on."""
        return at_times(self.forces, slice(self.first_row, self.row_count))

    def force(self, x: Array, histories: Sequence[AnyHistory] = ()) -> Array:
        """Return the forces F (N − first_row, 3n) [N] at the evaluation states of x (N, 3n).

        Parameters
        ----------
        x : (N, 3n)
            Positions [m].
        histories : sequence of histories
            Internal variables of the motion, see `histories`; computed from x where the sequence is
            empty.
        """
        return self.forces_with_histories(histories or self.histories(x)).total(
            *self.evaluation_states(x)
        )

    def assemble_residual(self, x: Array, force: Array) -> Array:
        """Return the residuals c (N, 3n) [N] from forces that have been evaluated.

        Forces on temporarily prescribed dofs and those before `first_row` count as zero.

        Parameters
        ----------
        x : (N, 3n)
            Positions [m].
        force : (N − first_row, 3n)
            Forces at the evaluation states [N].
        """
        total = np.zeros_like(x)
        total[self.first_row :] = force
        inertia = self.mass.inertia_kg * self.acceleration(x)
        return self.combine(self.tables.w, self.zero_prescribed_forces(total)) - inertia

    def zero_prescribed_forces(self, rows: Array) -> Array:
        """Set the forces at temporarily prescribed dofs to zero, in place, and return the array.

        Parameters
        ----------
        rows : (N, 3n, …)
            Forces at the evaluations, or their derivatives; modified.
        """
        rows[self.is_temporarily_prescribed] = 0
        return rows

    def acceleration(self, x: Array) -> Array:
        """Return the acceleration in every row (N, 3n) [m/s²] of positions x (N, 3n) [m]; zero in
        rows before `first_row` and in static experiments.
        """
        acceleration = self.combine(self.tables.s, x) / self.step_s**2
        acceleration += np.outer(self.tables.r / self.step_s, self.start_velocity_m_s)
        return acceleration

    def linearise(
        self, x: Array, out: Array | None = None, histories: Sequence[AnyHistory] = ()
    ) -> Linearisation:
        """Return forces and derivatives at the evaluation states of x, for the rows from
        `first_row` on: T = N − first_row in the shapes of `Linearisation`.

        Forces at temporarily prescribed dofs are included, see `zero_prescribed_forces`.

        Parameters
        ----------
        x : (N, 3n)
            Positions [m].
        out : array, optional
            Memory for the result, see `Forces.linearise`.
        histories : sequence of histories
            Internal variables of the motion; computed from x where the sequence is empty. They are
            constant in the derivatives.
        """
        forces = self.forces_with_histories(histories or self.histories(x))
        return forces.linearise(*self.evaluation_states(x), out)

    def block_terms(self, lag: int) -> Iterator[tuple[int, Array, Array]]:
        """Yield the force part of ∂c_t/∂x_{t−lag} as terms of Σ_j a_j[t] G_{t−j} + b_j[t] C_{t−j}.

        G and C are `by_position` and `by_velocity` at evaluation t − j.

        Yields
        ------
        j : int
            Lag of the evaluation.
        a, b : (N,)
            Coefficients; terms without any nonzero coefficient are skipped.
        """
        t = self.tables
        for j in range(min(lag + 1, self.row_count)):
            a = np.zeros(self.row_count)
            b = np.zeros(self.row_count)
            weights = t.w[j:, j]
            a[j:] = weights * t.p[: self.row_count - j, lag - j]
            b[j:] = weights * t.q[: self.row_count - j, lag - j] / self.step_s
            if a.any() or b.any():
                yield j, a, b

    def inertia_coefficient(self, lag: int) -> Array:
        """Return the factor (N,) of the mass in ∂c_t/∂x_{t−lag}: −s_lag / Δt²."""
        return -self.tables.s[:, lag] / self.step_s**2


def _combine(table: Array, rows: Array) -> Array:
    """Return Σ_i table[t, i] rows[t − i] for every t (N, …); terms before the start are omitted."""
    result = np.zeros_like(rows)
    shape = (-1,) + (1,) * (rows.ndim - 1)
    for lag in range(min(table.shape[1], len(rows))):
        column = table[lag:, lag].reshape(shape)
        if np.any(column):
            result[lag:] += column * rows[: len(rows) - lag]
    return result


def _row_masses(tables: StencilTables, at_evaluations: DofMasses) -> DofMasses:
    """Return the mass in each row: tied masses are averaged like forces, others are constant."""
    return replace(at_evaluations, tied_kg=_evaluation_mean(tables, at_evaluations.tied_kg))


def _evaluation_mean(tables: StencilTables, at_evaluations: Array) -> Array:
    # Weighted like the forces, so that gravity alone accelerates all masses equally, also a load
    # that is joining.
    """Return the mean of quantities over the evaluations of each row, weighted like the forces."""
    if (at_evaluations == at_evaluations[:1]).all():
        return at_evaluations
    total = tables.w.sum(axis=1).reshape((-1,) + (1,) * (at_evaluations.ndim - 1))
    mean = _combine(tables.w, at_evaluations) / np.where(total == 0, 1.0, total)
    return np.where(total == 0, at_evaluations, mean)


@dataclass(frozen=True, eq=False)
class StencilRow:
    """Coefficients of row t of the equations of motion, with the time step included."""

    # Coefficients by lag, q and s divided by Δt and Δt².
    p: tuple[float, ...]
    q: tuple[float, ...]
    w: tuple[float, ...]
    s: tuple[float, ...]
    r: float  # coefficient of the start velocity, divided by Δt
    mass_kg: Array  # (3n,): mass of every dof, including added mass of the air

    @classmethod
    def from_dynamics(cls, dynamics: Dynamics, t: int) -> StencilRow:
        """Return the coefficients and masses of the row with index t of equations of motion."""
        tables = dynamics.tables
        step_s = dynamics.step_s
        return cls(
            tuple(tables.p[t].tolist()),
            tuple((tables.q[t] / step_s).tolist()),
            w=tuple(tables.w[t].tolist()),
            s=tuple((tables.s[t] / step_s**2).tolist()),
            r=float(tables.r[t]) / step_s,
            mass_kg=dynamics.mass.inertia_at(t),
        )

    @cached_property
    def nonzero_lags(self) -> list[int]:
        """Lags i ≥ 1 at which p_i or q_i is not zero: the force evaluated in this row depends on
        x_{t−i}.
        """
        return [i for i in range(1, len(self.p)) if self.p[i] or self.q[i]]

    def block(self, by_position: Array, by_velocity: Array, pattern: SymmetricPattern) -> Array:
        """Return the lower triangle (m,) of −∂c_t/∂x_t, symmetric part.

        Parameters
        ----------
        by_position, by_velocity : (m,)
            Lower triangles of the symmetric parts of G and C.
        pattern : SymmetricPattern
            Positions of the diagonal in these triangles.
        """
        values = -self.w[0] * self.p[0] * by_position
        values -= self.w[0] * self.q[0] * by_velocity
        values[..., pattern.diagonal] += self.s[0] * self.mass_kg
        return values

    def skew_block(self, by_position_skew: Array, by_velocity_skew: Array) -> Array:
        """Return the lower triangle, (m,) or (0,), of the skew part of −∂c_t/∂x_t.

        Parameters
        ----------
        by_position_skew, by_velocity_skew : (m,) or (0,)
            Lower triangles of the skew parts of G and C; empty where there is no such part.
        """
        return -self.w[0] * self.skew(0, by_position_skew, by_velocity_skew=by_velocity_skew)

    def skew(self, lag: int, by_position_skew: Array, by_velocity_skew: Array) -> Array:
        """Return the skew part (m,) of p G + q C at a lag, from those of G (m,) and C (m,); that of
        C may be empty, which stands for zero.
        """
        skew_part = self.p[lag] * by_position_skew
        return skew_part + self.q[lag] * by_velocity_skew if by_velocity_skew.size else skew_part


def weighted_sum_of_past(
    coefficients: Sequence[float], past: Iterable[Array], shape: tuple[int, ...]
) -> Array:
    """Return Σ_i coefficients[i] past[i − 1] over the lags i from 1 on, as a new array; lags for
    which there is no past are omitted.

    Parameters
    ----------
    coefficients : sequence of float
        Coefficients by lag; that of lag 0 is not used.
    past : iterable of arrays
        Values at lags 1, 2, …, the latest first.
    shape : tuple of int
        Shape of the result where no coefficient is nonzero.
    """
    terms = [c * item for c, item in zip(coefficients[1:], past, strict=False) if c]
    if not terms:
        return np.zeros(shape)
    for term in terms[1:]:
        terms[0] += term
    return terms[0]
