"""The discrete equations of motion of one experiment, row by row from a scheme's table.

    c_t = Σ_j w_j F_{t−j} − M (Σ_i s_i x_{t−i} + r v_0),
    F_t = f(Σ_i p_i x_{t−i}, Σ_i q_i x_{t−i}; θ) + f_ext,

with the time step put in, so that with G = ∂F/∂ξ and C = ∂F/∂ν at evaluation t (see `schemes`)

    −∂c_t/∂x_t = s_0 M − w_0 (p_0 G + q_0 C).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..fem.body import Body, Linearisation
from ..fem.pattern import SymmetricPattern
from ..recording.experiment import Experiment
from .force_history import ForceHistory
from .forces import Forces
from .histories import AnyHistory, histories, onto
from .schemes import QUASI_STATIC, SLIDING, Scheme, as_scheme
from .weight import Mass


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
    """c_t(x; u) for rows t = `first_row` … N − 1 of a uniform grid, all dofs included.

    Row 0 exists when the experiment starts in equilibrium and is the static problem; so are all
    rows of a static experiment, whose times need not be evenly spaced.

    Attributes
    ----------
    body : Body
    tables : Tables
    t_s : (N,) grid times
    first_row : int
    mass : Mass of every dof in each row: the mean over its evaluations
    forces : Forces at each row's evaluation
    goals_m : (N, 3n) where dofs are held, NaN while free
    taken : (N, 3n) bool
        Held dofs that are free at other times: while one is held, the grasp takes what force
        there is on it. Nothing of it reaches later rows, so that a dof let go starts like the
        first step, from the velocity it has.
    evaluated_s : (N,) times of the evaluations
    start_velocity_m_s : (3n,)
    loaded_since_s : float
        How long the body has been in its start shape; infinite where its memory has relaxed.
    static : bool
        Whether each row is an equilibrium of its own.
    """

    body: Body
    tables: Tables
    t_s: Array
    first_row: int
    mass: Mass
    forces: Forces
    goals_m: Array
    taken: NDArray[np.bool_]
    evaluated_s: Array
    start_velocity_m_s: Array
    loaded_since_s: float = np.inf
    static: bool = False

    @classmethod
    def of(cls, experiment: Experiment, scheme: str | Scheme, substeps: int = 1) -> Dynamics:
        """Discretise an experiment with `substeps` steps between samples; a static one has none."""
        if experiment.static:
            t_s = experiment.t_s
            table = SLIDING if any(o.rubs for o in experiment.obstacles) else QUASI_STATIC
        else:
            rows = (len(experiment.t_s) - 1) * substeps + 1
            t_s = experiment.t_s[0] + np.arange(rows) * experiment.timestep_s / substeps
            table = as_scheme(scheme, experiment.start_rule)
        rows, first_row = len(t_s), 0 if experiment.start == "equilibrium" else 1
        tables = Tables.of(table, rows, first_row)
        velocity = experiment.start_velocities_m_s
        dofs = experiment.body.pattern.size
        lags = tables.p @ np.arange(tables.p.shape[1])
        evaluated_s = t_s - lags * experiment.timestep_s / substeps
        averaged_s = 0.0
        if not experiment.static and table.is_midpoint:
            averaged_s = experiment.timestep_s / substeps
        forces = Forces.of(experiment, evaluated_s, step_s=averaged_s)
        goals = experiment.grasped(t_s)[1].reshape(rows, -1)
        taken = ~np.isnan(goals)
        taken[:, experiment.held_dofs] = False
        return cls(
            body=experiment.body,
            tables=tables,
            t_s=t_s,
            first_row=first_row,
            mass=_of_rows(tables, forces.mass),
            forces=forces,
            goals_m=goals,
            taken=taken,
            evaluated_s=evaluated_s,
            start_velocity_m_s=np.zeros(dofs) if velocity is None else np.array(velocity).ravel(),
            loaded_since_s=experiment.loaded_since_s,
            static=experiment.static,
        )

    def at(self, u: Array) -> Dynamics:
        """The same at inputs (N, U), see `inputs`."""
        return self._under(self.forces.at(u))

    def with_theta(self, theta: Sequence[float] | Array) -> Dynamics:
        """The same with a body of these constants (k,)."""
        return self._under(self.forces.with_theta(theta))

    def _under(self, forces: Forces) -> Dynamics:
        if forces.mass is self.forces.mass:
            return replace(self, forces=forces)
        return replace(self, forces=forces, mass=_of_rows(self.tables, forces.mass))

    def to_evaluations(self, of_rows: Array) -> Array:
        """The transpose of `of_rows`, of weights (N, …)."""
        total = self.tables.w.sum(axis=1).reshape((-1,) + (1,) * (of_rows.ndim - 1))
        shares = of_rows / np.where(total == 0, 1.0, total)
        return np.where(total == 0, of_rows, 0.0) + self.combine_transposed(self.tables.w, shares)

    def of_rows(self, at_evaluations: Array) -> Array:
        """What a row has of mass (N, …) that is there at the evaluations."""
        return _mean(self.tables, at_evaluations)

    def first_rows(self, rows: int) -> Dynamics:
        """The same on the first grid times only."""
        if rows >= self.rows:
            return self
        t = self.tables
        return replace(
            self,
            tables=Tables(t.p[:rows], t.q[:rows], t.w[:rows], t.s[:rows], t.r[:rows]),
            t_s=self.t_s[:rows],
            mass=self.mass.rows(slice(rows)),
            forces=self.forces.rows(slice(rows)),
            goals_m=self.goals_m[:rows],
            taken=self.taken[:rows],
            evaluated_s=self.evaluated_s[:rows],
        )

    @property
    def pattern(self) -> SymmetricPattern:
        """Sparsity of the blocks."""
        return self.forces.pattern

    @property
    def rows(self) -> int:
        """N, the number of grid points."""
        return len(self.t_s)

    @property
    def step_s(self) -> float:
        """Δt of the grid; of a static experiment, where nothing depends on it, a second."""
        return 1.0 if self.static else float(self.t_s[1] - self.t_s[0])

    @property
    def reach(self) -> int:
        """Largest lag of the scheme."""
        return self.tables.p.shape[1] - 1

    def evaluation_states(self, x: Array) -> tuple[Array, Array]:
        """ξ_k and ν_k of rows `first_row`…, each (N − first_row, 3n), from x (N, 3n)."""
        xi = self.combine(self.tables.p, x)
        nu = self.combine(self.tables.q, x) / self.step_s
        return xi[self.first_row :], nu[self.first_row :]

    @property
    def state_weights(self) -> Array:
        """(N, reach + 1) p, and that of a given start, where only a stress is evaluated."""
        weights = self.tables.p.copy()
        weights[: self.first_row, 0] = 1.0
        return weights

    @property
    def until_next_s(self) -> Array:
        """(N,) time from each evaluation to the next."""
        if self.static:
            return np.append(np.diff(self.t_s), 1.0)
        lags = self.tables.p @ np.arange(self.reach + 1.0)
        return self.step_s * np.append(np.diff(np.arange(self.rows) - lags), 1.0)

    @property
    def theta(self) -> Array:
        """(k,) constants of the body."""
        return self.forces.theta

    def histories(
        self, x: Array, brought: Mapping[int, Array] | None = None
    ) -> tuple[AnyHistory, ...]:
        """What the evaluations of x (N, 3n), or its first rows, went through; empty if nothing.

        What they bring from the past follows from x where it is not given, by number.
        """
        if not (self.body.remembers or self.forces.carrying):
            return ()
        here = slice(len(x))
        states = self.evaluated_at(x)
        known = self.until_next_s[here], self.loaded_since_s, brought or {}
        return histories(self.forces.rows(here), states, *known)

    def pressed(self, x: Array, pressed: Mapping[int, Array]) -> tuple[AnyHistory, ...]:
        """Contact at b (1, N, i) that is given, by the number of the force, as histories are."""
        states, since_s = self.evaluated_at(x), np.zeros(len(x))
        return tuple(
            ForceHistory.of(self.forces, number, *states, since_s, b)
            for number, b in pressed.items()
        )

    def evaluated_at(self, x: Array) -> tuple[Array, Array]:
        """ξ and ν at all evaluations of x (N, 3n), or its first rows, a given start included."""
        xi = self.combine(self.state_weights[: len(x)], x)
        nu = self.combine(self.tables.q[: len(x)], x) / self.step_s
        nu[: self.first_row] = self.start_velocity_m_s
        return xi, nu

    def forces_along(self, along: Sequence[AnyHistory], rows: slice | None = None) -> Forces:
        """The forces of rows `first_row`…, or some, with what they bring."""
        rows = slice(self.first_row, self.rows) if rows is None else rows
        return onto(self.forces.rows(rows), along, rows)

    def combine(self, table: Array, rows: Array) -> Array:
        """Σ_i table[t, i] rows[t − i] for every t; `rows` is (N, …)."""
        return _combine(table, rows)

    def combine_transposed(self, table: Array, rows: Array) -> Array:
        """Σ_i table[k + i, i] rows[k + i] for every k, the transpose of `combine`."""
        result = np.zeros_like(rows)
        shape = (-1,) + (1,) * (rows.ndim - 1)
        for lag in range(min(table.shape[1], len(rows))):
            column = table[lag:, lag].reshape(shape)
            if np.any(column):
                result[: len(rows) - lag] += column * rows[lag:]
        return result

    def residual(self, x: Array, along: Sequence[AnyHistory] = ()) -> Array:
        """Residuals c (N, 3n) [N] at positions x (N, 3n); rows before `first_row` are zero.

        Here and below what is carried is what follows from x, unless other histories are given.
        """
        return self.assemble_residual(x, self.force(x, along))

    @property
    def evaluated(self) -> Forces:
        """The forces of rows `first_row`…."""
        return self.forces.rows(slice(self.first_row, self.rows))

    def force(self, x: Array, along: Sequence[AnyHistory] = ()) -> Array:
        """Forces F (N − first_row, 3n) [N] at the evaluation states of x (N, 3n)."""
        return self.forces_along(along or self.histories(x)).total(*self.evaluation_states(x))

    def assemble_residual(self, x: Array, force: Array) -> Array:
        """The same from the forces (N − first_row, 3n) at the evaluation states."""
        total = np.zeros_like(x)
        total[self.first_row :] = force
        inertia = self.mass.kg * self.acceleration(x)
        return self.combine(self.tables.w, self.without_taken(total)) - inertia

    def without_taken(self, rows: Array) -> Array:
        """Forces (N, 3n, …) with those that a passing grasp takes set to zero, in place."""
        rows[self.taken] = 0
        return rows

    def acceleration(self, x: Array) -> Array:
        """Acceleration of every row, (N, 3n) [m/s²]."""
        acceleration = self.combine(self.tables.s, x) / self.step_s**2
        acceleration += np.outer(self.tables.r / self.step_s, self.start_velocity_m_s)
        return acceleration

    def linearise(
        self, x: Array, out: Array | None = None, along: Sequence[AnyHistory] = ()
    ) -> Linearisation:
        """Forces and derivatives, at what is brought, at the evaluation states of x (N, 3n)."""
        forces = self.forces_along(along or self.histories(x))
        return forces.linearise(*self.evaluation_states(x), out)

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


def _combine(table: Array, rows: Array) -> Array:
    result = np.zeros_like(rows)
    shape = (-1,) + (1,) * (rows.ndim - 1)
    for lag in range(min(table.shape[1], len(rows))):
        column = table[lag:, lag].reshape(shape)
        if np.any(column):
            result[lag:] += column * rows[: len(rows) - lag]
    return result


def _of_rows(tables: Tables, at_evaluations: Mass) -> Mass:
    """The mass of the rows from that at the evaluations."""
    return replace(at_evaluations, tied_kg=_mean(tables, at_evaluations.tied_kg))


def _mean(tables: Tables, at_evaluations: Array) -> Array:
    # As a row weighs forces: then gravity alone accelerates all mass alike, also what just joins.
    if (at_evaluations == at_evaluations[:1]).all():
        return at_evaluations
    total = tables.w.sum(axis=1).reshape((-1,) + (1,) * (at_evaluations.ndim - 1))
    mean = _combine(tables.w, at_evaluations) / np.where(total == 0, 1.0, total)
    return np.where(total == 0, at_evaluations, mean)


@dataclass(frozen=True, eq=False)
class StencilRow:
    """Row t of an experiment's equations of motion: its coefficients, and its block.

    Attributes
    ----------
    p, q, w, s : floats of the stencil, by lag
    r : float
    mass_kg : (3n,) of every dof
    """

    p: tuple[float, ...]
    q: tuple[float, ...]
    w: tuple[float, ...]
    s: tuple[float, ...]
    r: float
    mass_kg: Array

    @classmethod
    def of(cls, dynamics: Dynamics, t: int) -> StencilRow:
        """Row t of the tables, with its mass."""
        tables, step_s = dynamics.tables, dynamics.step_s
        return cls(
            tuple(tables.p[t].tolist()),
            tuple((tables.q[t] / step_s).tolist()),
            tuple(tables.w[t].tolist()),
            tuple((tables.s[t] / step_s**2).tolist()),
            float(tables.r[t]) / step_s,
            dynamics.mass.row_kg(t),
        )

    @cached_property
    def lags(self) -> list[int]:
        """Lags from one on that the evaluation of the force depends on."""
        return [i for i in range(1, len(self.p)) if self.p[i] or self.q[i]]

    def block(self, by_position: Array, by_velocity: Array, pattern: SymmetricPattern) -> Array:
        """Lower triangle (m,) of −∂c_t/∂x_t from those of G and C."""
        values = -self.w[0] * self.p[0] * by_position
        values -= self.w[0] * self.q[0] * by_velocity
        values[pattern.diagonal] += self.s[0] * self.mass_kg
        return values

    def skew_block(self, by_position_skew: Array, by_velocity_skew: Array) -> Array:
        """Lower triangle, (m,) or (0,), of the skew part of −∂c_t/∂x_t from those of G and C."""
        return -self.w[0] * self.skew(0, by_position_skew, by_velocity_skew)

    def skew(self, lag: int, by_position_skew: Array, by_velocity_skew: Array) -> Array:
        """That of p G + q C of a lag."""
        found = self.p[lag] * by_position_skew
        return found + self.q[lag] * by_velocity_skew if by_velocity_skew.size else found


def weighted(coefficients: Sequence[float], past: Iterable[Array], shape: tuple[int, ...]) -> Array:
    """Σ_i coefficients[i] past[i] over the lags from one on; past holds the latest first."""
    terms = [c * item for c, item in zip(coefficients[1:], past, strict=False) if c]
    if not terms:
        return np.zeros(shape)
    for term in terms[1:]:
        terms[0] += term
    return terms[0]
