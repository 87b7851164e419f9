"""Forces that act point by point, with generated derivatives: custom forces and air drag.

Derive a force from `Pointwise` if it is a sum over points of the body of a law L of few numbers. A
law may have internal variables h of each instance (point), such as the creep of a dashpot or the
anchor of friction:

    (F, h)_k = L(y_k, ẏ_k, c_k, h_{k−1}; data_k),

with the vectors y of the instance, their velocities ẏ and constants c. With h_{k−1} given, F and
its derivatives are those of any other force; `force_internal_variables` treats h along a motion.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import NamedTuple, Self

import numpy as np

from ..common.array_types import Array, Index
from ..common.time_dependence import LOAD, over_time
from ..fem.body import Linearisation, SecondDerivatives
from ..fem.force_points import ForcePoints
from ..fem.node_force import CONTEXT_SIZE, LocatedForce, NodeForce, unit_drag
from ..fem.pattern import SymmetricPattern
from .force_term import AssemblyIndices, ForceTerm, States
from .generated_functions import GeneratedFunction


class PreviousState(NamedTuple):
    """Internal variables of the previous evaluation, given at T evaluations."""

    before: Array  # (n, T, I): variables h_{k−1} of I instances
    # (T,): time since the previous evaluation; zero at the start, where there is none.
    since_s: Array


class Pointwise(ForceTerm):
    """Force given by a law at points of a body.

    Attributes
    ----------
    points : ForcePoints
        Points, and their vectors y (d numbers each).
    law : GeneratedFunction
        Forces (d,) on y as a function of (y, ẏ, c), or of (y, c) if nothing depends on ẏ, and of
        data. With n internal variables, h_{k−1} follows c in the inputs and h follows the forces in
        the values.
    factor : float
        Factor of the force; internal variables do not depend on it.
    previous_state : PreviousState, optional
        Internal variables of the previous evaluations; zero by default, as at the start.
    variable_weights : (n, T, I), optional
        Weights of h in second derivatives, beside those of the force; zero by default.
    """

    points: ForcePoints
    factor: float
    previous_state: PreviousState | None = None
    variable_weights: Array | None = None

    @property
    def has_skew_stiffness(self) -> bool:
        """Whether derivatives by positions may have a skew part."""
        return True

    @property
    @abstractmethod
    def law(self) -> GeneratedFunction:
        """Law F(y, ẏ, c), or (F, h)(y, ẏ, c, h_{k−1}), with derivatives."""

    @property
    def is_nonlinear_in_velocity(self) -> bool:  # type: ignore[override]
        return True

    def active_points(self, states: States) -> tuple[Index | None, Array]:
        """Return the indices of the instances that may have a force, None for all, and their y.

        Instances that are left out have neither a force nor internal variables.
        """
        return None, self.points.vectors(states.xi)

    @abstractmethod
    def constants(self, states: States) -> Array:
        """Return the constants c of the law, (c, T) or (c, 1)."""

    @abstractmethod
    def constant_columns(self, places: AssemblyIndices) -> Index:
        """Return the columns (c,) of the constants among all inputs u; `places` are those of this
        term.
        """

    @abstractmethod
    def data(self, chosen: Index | None) -> Array:
        """Return the data of the law, (D, T, i) or (D, 1, i).

        Parameters
        ----------
        chosen : array of int or None
            Indices of the instances; None for all.
        """

    @property
    def couplings(self) -> SymmetricPattern:  # type: ignore[override]
        """Pairs of dofs of the nodes at each point."""
        return self.points.couplings

    def with_previous_state(
        self, previous_state: PreviousState, variable_weights: Array | None = None
    ) -> Self:
        """Return this force with given internal variables of the previous evaluations, and with
        weights of h in second derivatives, (n, T, I), which are zero for None.
        """
        return replace(
            self,  # type: ignore[type-var]
            previous_state=previous_state,
            variable_weights=variable_weights,
        )

    def interval_and_start(self, times: int) -> tuple[Array, Array]:
        """Return the time since the previous evaluation (T,) [s], and 1 where it is zero, as at the
        start, else 0 (T,). Without `previous_state` all evaluations count as starts.

        Parameters
        ----------
        times : int
            Number T of evaluations.
        """
        since_s = np.zeros(times) if self.previous_state is None else self.previous_state.since_s
        return since_s, (since_s == 0).astype(float)

    def _inputs_at(self, states: States) -> _LawInputs:
        """Return u = (y, ẏ, c, h_{k−1}) (…, T, i) and data (d, T, i) at the points that can act."""
        chosen, y = self.active_points(states)
        constants = self.constants(states)
        constants_offset = len(y) * (2 if self.is_nonlinear_in_velocity else 1)
        variables_offset = constants_offset + len(constants)
        u = np.empty((variables_offset + self.internal_variable_count, *y.shape[1:]))
        u[: len(y)] = y
        if self.is_nonlinear_in_velocity:
            u[len(y) : constants_offset] = self.points.vectors(states.nu, chosen)
        u[constants_offset:variables_offset] = constants[..., None]
        u[variables_offset:] = 0.0
        if self.previous_state is not None:
            some = slice(None) if chosen is None else chosen
            u[variables_offset:] = self.previous_state.before[..., some]
        data = self.data(chosen)
        if data.shape[1:] != y.shape[1:]:
            data = np.broadcast_to(data, (len(data), *y.shape[1:]))
        return _LawInputs(
            chosen,
            u,
            data=data,
            velocity_offset=len(y),
            constants_offset=constants_offset,
            variables_offset=variables_offset,
        )

    def force(self, states: States) -> Array:
        at = self._inputs_at(states)
        value = self.law.evaluate(at.u, at.data)[at.y]
        return self.factor * self.points.assemble(value, at.chosen)

    def add_derivatives(
        self, linearisation: Linearisation, places: AssemblyIndices, states: States
    ) -> None:
        """Add the forces and their first derivatives by positions, velocities and the constants of
        the law to a linearisation, in place, at the entries and input columns `places`.

        Internal variables of the previous evaluations are constant. Skew parts are added where they
        can exist; those by positions only if the linearisation has room for them.
        """
        evaluated = self._inputs_at(states)
        points = self.points
        value, slopes = self.law.evaluate_with_jacobian(evaluated.u, evaluated.data)
        value = value[evaluated.y]
        slopes = self.factor * slopes[evaluated.y]
        linearisation.force[:] += self.factor * points.assemble(value, evaluated.chosen)
        by_x, by_v, by_c = (slopes[:, part] for part in (evaluated.y, evaluated.v, evaluated.c))
        entries = places.entries
        chosen = evaluated.chosen
        add = points.add_matrices
        depends_on_place = bool(self.law.dependent_inputs[evaluated.y].any())
        if depends_on_place:
            add(linearisation.by_position, entries, blocks=by_x, chosen=chosen)
        if depends_on_place and self.has_skew_stiffness and linearisation.by_position_skew.size:
            add(linearisation.by_position_skew, entries, blocks=by_x, chosen=chosen, skew=True)
        if self.is_nonlinear_in_velocity:
            add(linearisation.by_velocity, entries, blocks=by_v, chosen=chosen)
        if self.has_skew_damping:
            add(linearisation.by_velocity_skew, entries, blocks=by_v, chosen=chosen, skew=True)
        for k, column in enumerate(self.constant_columns(places)):
            linearisation.by_theta[:, :, column] += points.assemble(by_c[:, k], evaluated.chosen)

    def add_second_derivatives(
        self, curvature: SecondDerivatives, places: AssemblyIndices, states: States, weights: Array
    ) -> None:
        """Add also Σ `variable_weights` · h; those by h_{k−1} are in `mixed_second_derivatives`."""
        evaluated = self._inputs_at(states)
        points = self.points
        entries = places.entries
        w = self._weights(evaluated, weights)
        x = evaluated.y
        v = evaluated.v
        second = self.law.weighted_hessian(evaluated.u, evaluated.data, weights=w)
        add = points.add_matrices
        chosen = evaluated.chosen
        depends_on_place = bool(self.law.dependent_inputs[x].any())
        if depends_on_place:
            add(curvature.position_position, entries, blocks=second[x, x], chosen=chosen)
        if self.is_nonlinear_in_velocity and depends_on_place:
            add(curvature.position_velocity, entries, blocks=second[x, v], chosen=chosen)
            if curvature.position_velocity_skew.size:
                add(
                    curvature.position_velocity_skew,
                    entries,
                    blocks=second[x, v],
                    chosen=chosen,
                    skew=True,
                )
        if self.is_nonlinear_in_velocity:
            add(curvature.velocity_velocity, entries, blocks=second[v, v], chosen=chosen)
        _, slopes = self.law.evaluate_with_jacobian(evaluated.u, evaluated.data)
        columns = list(enumerate(self.constant_columns(places), evaluated.c.start))
        for k, column in columns:
            curvature.position_theta[:, :, column] += points.assemble(
                second[x, k], evaluated.chosen
            )
            if self.is_nonlinear_in_velocity:
                curvature.velocity_theta[:, :, column] += points.assemble(
                    second[v, k], evaluated.chosen
                )
            curvature.theta[:, column] += np.einsum("itk,itk->t", w, slopes[:, k])
            for other, place in columns:
                curvature.theta_theta[:, column, place] += second[k, other].sum(axis=1)

    def _weights(self, here: _LawInputs, weights: Array) -> Array:
        """Return the weights (d + n, T, i) of the forces on y, then of the n internal variables."""
        force_weights = self.factor * self.points.vectors(weights, here.chosen)
        if not self.internal_variable_count:
            return force_weights
        shape = self.internal_variable_count, *force_weights.shape[1:]
        some = slice(None) if here.chosen is None else here.chosen
        variable_weights = (
            np.zeros(shape) if self.variable_weights is None else self.variable_weights[..., some]
        )
        return np.concatenate([force_weights, variable_weights])

    # Of one that carries ----------------------------------------------------------------------

    def internal_variables(self, states: States) -> Array:
        """Return the internal variables h (n, T, I) of all instances after the evaluations; zero at
        instances that cannot act.
        """
        evaluated = self._inputs_at(states)
        return self._expanded(
            self.law.evaluate(evaluated.u, evaluated.data)[evaluated.y.stop :], evaluated
        )

    def derivatives(self, states: States) -> LawDerivatives:
        """Return the first derivatives of F and h at all I instances by y, ẏ, c and h_{k−1}, (d +
        n, …, T, I) each: first those of the d forces, with `factor`, then of the n internal
        variables.
        """
        evaluated = self._inputs_at(states)
        _, slopes = self.law.evaluate_with_jacobian(evaluated.u, evaluated.data)
        slopes[evaluated.y] *= self.factor
        return evaluated.split(self._expanded(slopes, evaluated), 1)

    def mixed_second_derivatives(self, states: States, weights: Array) -> LawDerivatives:
        """Return second derivatives of weights · F + Σ `variable_weights` · h by u and h_{k−1}.

        They are split along u = (y, ẏ, c, h_{k−1}), (…, n, T, I) each.

        Parameters
        ----------
        weights : (T, 3n)
            Weights of the forces.
        """
        evaluated = self._inputs_at(states)
        second = self.law.weighted_hessian(
            evaluated.u, evaluated.data, weights=self._weights(evaluated, weights)
        )
        return evaluated.split(self._expanded(second[:, evaluated.b], evaluated), 0)

    def _expanded(self, values: Array, here: _LawInputs) -> Array:
        """Return values (…, T, I) of all instances, zero at those that are not chosen."""
        if here.chosen is None:
            return values
        expanded = np.zeros((*values.shape[:-1], self.points.count))
        expanded[..., here.chosen] = values
        return expanded


class LawDerivatives(NamedTuple):
    """Derivatives by y, ẏ, c and h_{k−1} of a law."""

    y: Array  # by the vectors y of the instance
    v: Array  # by their velocities ẏ
    c: Array  # by the constants
    b: Array  # by the previous internal variables h_{k−1}


class ComplementarityForce(Pointwise):
    """Force of a pressure that may be given by a relaxed complementarity condition.

    Under the condition 0 ≤ b ⟂ g ≥ 0 all points have a pressure, in proportion to b [m]. Programs
    with b as variables give them to the force as its `previous_state`; its internal variables are
    then the residuals of the condition.

    Attributes
    ----------
    is_complementarity : bool
        Whether b follows from the condition; otherwise from an energy.
    pressure_unit_m : float
        Unit of b as a variable [m].
    """

    is_complementarity: bool
    pressure_unit_m: float

    @abstractmethod
    def scaled_pressures(self, xi: Array, nu: Array | None = None) -> Array:
        """Return b (1, T, i) [m] of all i points at positions ξ (T, 3n) [m] and velocities ν, which
        are zero for None.
        """


@dataclass(frozen=True, eq=False)
class _LawInputs:
    """Inputs u = (y, ẏ, c, h_{k−1}) and data of a law at some states."""

    chosen: Index | None  # (i,) or None: indices of the instances; None for all
    # (…, T, i): .
    u: Array
    data: Array
    # Offsets of ẏ, c and h_{k−1} in u.
    velocity_offset: int
    constants_offset: int
    variables_offset: int

    @property
    def y(self) -> slice:
        """Slice of the vectors y in the inputs u."""
        return slice(self.velocity_offset)

    @property
    def v(self) -> slice:
        """Slice of the velocities ẏ in u."""
        return slice(self.velocity_offset, self.constants_offset)

    @property
    def c(self) -> slice:
        """Slice of the constants in u."""
        return slice(self.constants_offset, self.variables_offset)

    @property
    def b(self) -> slice:
        """Slice of the previous internal variables h_{k−1} in u."""
        return slice(self.variables_offset, len(self.u))

    def split(self, values: Array, axis: int) -> LawDerivatives:
        """Return views of `values`, split along the axis of u into y, ẏ, c and h_{k−1}."""
        return LawDerivatives(
            *np.split(
                values,
                [self.velocity_offset, self.constants_offset, self.variables_offset],
                axis=axis,
            )
        )


@dataclass(frozen=True, eq=False)
class CustomForce(Pointwise):
    """Custom force, or the drag of the air, at T times."""

    placed: LocatedForce  # law and the points on which it acts
    t_s: Array = field(metadata=over_time())  # (T,): times
    factor: float = field(default=1.0, metadata=LOAD)
    # Internal variables of the previous evaluations, see `Pointwise`.
    previous_state: PreviousState | None = None
    # (n, T, I): weights of the internal variables in second derivatives.
    variable_weights: Array | None = None
    size = 0

    @property
    def has_skew_damping(self) -> bool:  # type: ignore[override]
        return self.placed.force.has_skew_damping

    @property
    def has_skew_stiffness(self) -> bool:
        return self.placed.force.has_skew_stiffness

    @property
    def internal_variable_count(self) -> int:  # type: ignore[override]
        return self.placed.force.internal_variable_count

    @property
    def is_air_drag(self) -> bool:
        """Whether this is the drag of the air around the body, not a custom force."""
        return self.placed.force is unit_drag()

    @property
    def points(self) -> ForcePoints:  # type: ignore[override]
        """Nodes or faces on which the law acts."""
        return self.placed.points

    @property
    def law(self) -> GeneratedFunction:
        return law_function(self.placed.force, self.points.dofs)

    def with_inputs(self, u: Array) -> Self:
        return self

    def constants(self, states: States) -> Array:
        constants = states.theta[self.placed.columns]
        return constants.reshape(len(constants), *constants.shape[1:2] or (1,))

    def constant_columns(self, places: AssemblyIndices) -> Index:
        return self.placed.columns

    def data(self, chosen: Index | None) -> Array:
        """All instances act; the order is that in which a `ForceContext` reads the data."""
        return self._data

    @cached_property
    def _data(self) -> Array:
        data = np.empty((CONTEXT_SIZE, len(self.t_s), self.points.count))
        data[0] = self.t_s[:, None]
        data[1:-2] = self.placed.data[:, None]
        data[-2:] = np.array(self.interval_and_start(len(self.t_s)))[..., None]
        return data


@lru_cache(maxsize=32)
def law_function(force: NodeForce, dofs: int) -> GeneratedFunction:
    """Return the law of a force with derivatives; the last 32 are cached.

    Parameters
    ----------
    dofs : int
        Number of dofs of one instance.
    """
    return GeneratedFunction(
        force.expression,
        force.input_size(dofs),
        data_size=CONTEXT_SIZE,
        is_compiled=force.is_compiled,
    )
