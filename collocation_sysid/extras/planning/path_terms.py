"""Costs and limits of a plan that a user states as functions of the motion, in Python.

All functions of a kind are one expression of the positions, velocities and accelerations of points
and of the hand at a sample. These are linear in the positions of the nodes at the grid times, so that
derivatives of any order are those of the expression between two sparse products.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
import scipy.sparse as sp

from ...common.array_types import Array, Index
from ...common.files import reason
from ...common.schema_tables import Vector
from ...common.validated_classes import validated
from ...common.validated_types import Boundless, Positive
from ...errors import InputError
from ...fem.body import Body
from ...model.generated_functions import GeneratedFunction
from ...recording.custom_sensor import PointQuantities, SensorValues, stack_values
from ...recording.placement import place_markers
from .hand_limits import WITHIN


@dataclass(frozen=True)
class PathQuantities(PointQuantities):
    """Motion of points and of the hand at a sample of a plan, as CasADi expressions.

    The time `t_s` is since the start. Velocities and accelerations are central differences over the
    time steps of the plan.

    Attributes
    ----------
    hand_m, hand_velocity_m_s, hand_acceleration_m_s2 : (3,) expressions
        Motion of the hand, the middle of the grasped nodes, in the world.
    """

    hand_m: ca.SX
    hand_velocity_m_s: ca.SX
    hand_acceleration_m_s2: ca.SX


@validated
class PathCost:
    """Cost of a plan: the mean over the samples of Σ (value / sigma)².

    Attributes
    ----------
    function : callable
        ``function(at) -> numbers``, of `PathQuantities` in CasADi operations; it must be smooth.
    sigma : float
        Acceptable value, in the unit of the values.
    points_m : (P, 3) list
        Places of the points on the undeformed body; by default the points of the references, in their
        order.
    """

    function: Callable[[PathQuantities], SensorValues]
    sigma: Positive = 1.0
    points_m: tuple[Vector, ...] = ()


@validated
class PathLimit:
    """Limit of a plan: ``lower <= value <= upper`` at all samples.

    Attributes
    ----------
    function, points_m
        See `PathCost`.
    lower, upper : float
        Limits of every value; none by default.
    scale : float, optional
        Unit of the values, 0.6 % of which are kept as a distance from the limits; by default half the
        distance of both limits, or the magnitude of the only one.
    """

    function: Callable[[PathQuantities], SensorValues]
    lower: Boundless = -np.inf
    upper: Boundless = np.inf
    scale: Positive | None = None
    points_m: tuple[Vector, ...] = ()

    def __post_init__(self) -> None:
        if not self.lower < self.upper or not np.isfinite([self.lower, self.upper]).any():
            raise InputError(
                f"found the limits {self.lower:g} and {self.upper:g}; expected lower or upper, and a "
                "lower one that is smaller",
                where="lower",
            )
        if not self.unit:
            raise InputError(
                "the only limit is 0, which has no unit; expected the scale of the values",
                where="scale",
            )

    @property
    def unit(self) -> float:
        """Scale of the values."""
        ends = np.array([self.lower, self.upper])
        usual = np.ptp(ends) / 2 if np.isfinite(ends).all() else np.abs(ends).min()
        return self.scale or float(usual)

    def excess(self, values: ca.SX) -> ca.SX:
        """Return values that must not be positive, relative to the scale."""
        margin = 1 / WITHIN - 1
        sides = []
        if np.isfinite(self.upper):
            sides.append((values - self.upper) / self.unit + margin)
        if np.isfinite(self.lower):
            sides.append((self.lower - values) / self.unit + margin)
        return ca.vertcat(*sides)


@dataclass(frozen=True, eq=False)
class PathValues:
    """Values y (m, T) at the T samples of a plan, as a function of the motion x (N, 3n)."""

    function: GeneratedFunction  # values of the inputs and of the time, at one sample
    t_s: Array  # (1, T): times since the start [s]
    matrix: sp.csr_array  # (k · T, N · 3n): the k inputs of the function, by input, then by sample

    @classmethod
    def from_terms(
        cls,
        terms: Sequence[PathCost | PathLimit],
        usual_m: Sequence[Array],
        body: Body,
        hand: Index,
        start: Array,
        grid_since_s: Array,
        rows: Index,
    ) -> PathValues | None:
        """Return the values of all terms together: residuals of costs, or values of limits that must
        not be positive; None without terms.

        Parameters
        ----------
        usual_m : sequence of (3,) arrays
            Places of the points of terms that state none.
        hand : array of int
            Nodes of the hand.
        start : (3n,) array
            Positions before the motion [m].
        grid_since_s, rows : (N,) and (T,) arrays
            Grid times since the start [s], and those of them that are samples.

        Raises
        ------
        InputError
            If a function cannot be evaluated, or is not smooth before the motion.
        """
        if not terms:
            return None
        points = [np.array(each.points_m or usual_m).reshape(-1, 3) for each in terms]
        ends = np.cumsum([0, *map(len, points)])
        count = int(ends[-1]) + 1  # the hand is the last point
        u, t_s = ca.SX.sym("u", 9 * count), ca.SX.sym("t_s")
        motion = [ca.reshape(each, 3, count) for each in ca.vertsplit(u, 3 * count)]
        found = []
        for number, term in enumerate(terms):
            own = slice(int(ends[number]), int(ends[number + 1]))
            at = PathQuantities(t_s, *(x[:, own] for x in motion), *(x[:, -1] for x in motion))
            value = _evaluated(term, at, f"{_name(term)}[{number}]")
            if not ca.depends_on(value, u):
                raise InputError(
                    "the function ignores the motion; expected a function of `at` in CasADi "
                    "operations",
                    where=f"{_name(term)}[{number}]",
                )
            found.append(
                term.excess(value)
                if isinstance(term, PathLimit)
                else value / (term.sigma * np.sqrt(len(rows)))
            )
        values = ca.vertcat(*found)
        used = np.flatnonzero(ca.which_depends(values, u))

        def of_used(inputs: ca.SX, time_s: ca.SX) -> ca.SX:
            complete = ca.SX.zeros(9 * count)
            complete[used.tolist()] = inputs
            return ca.substitute(values, ca.vertcat(u, t_s), ca.vertcat(complete, time_s))

        matrix = _inputs(body, np.concatenate(points), hand, used, grid_since_s, rows)
        function = GeneratedFunction(of_used, len(used), 1)
        built = cls(function, grid_since_s[rows][None], matrix)
        standing = np.tile(start, (len(grid_since_s), 1))
        finite = [np.isfinite(each).all() for each in built.evaluate_with_slopes(standing)]
        if not all(finite):
            raise InputError(
                "a value or its derivative is not finite before the motion; expected smooth functions, "
                "such as sqrt(v·v + 1e-12) in place of |v|",
                where=_name(terms[0]),
            )
        return built

    def _inputs_at(self, x: Array) -> Array:
        return (self.matrix @ x.ravel()).reshape(-1, self.t_s.shape[1])

    def evaluate(self, x: Array) -> Array:
        """Return the values (m, T)."""
        return self.function.evaluate(self._inputs_at(x), self.t_s)

    def evaluate_with_slopes(self, x: Array) -> tuple[Array, Array]:
        """Return the values (m, T), and their derivatives (m, k, T) by the inputs."""
        return self.function.evaluate_with_jacobian(self._inputs_at(x), self.t_s)

    def linearise(self, x: Array) -> tuple[Array, sp.csr_array]:
        """Return the values (m, T), and their derivatives (m · T, N · 3n) by the motion."""
        values, slopes = self.evaluate_with_slopes(x)
        return values, sp.csr_array(_at_each_sample(slopes) @ self.matrix)

    def weighted_hessian(self, x: Array, weights: Array) -> sp.csr_array:
        """Return the second derivatives (N · 3n, N · 3n) of Σ weights · y for weights (m, T)."""
        curvature = self.function.weighted_hessian(self._inputs_at(x), self.t_s, weights)
        return sp.csr_array(self.matrix.T @ _at_each_sample(curvature) @ self.matrix)

    def convex_rows(self, x: Array, weights: Array) -> sp.csr_array:
        """Return a matrix Q (rows, N · 3n): Qᵀ Q is the part with positive eigenvalues, of each
        sample, of `weighted_hessian`.
        """
        curvature = self.function.weighted_hessian(self._inputs_at(x), self.t_s, weights)
        values, vectors = np.linalg.eigh(np.moveaxis(curvature, -1, 0))
        roots = np.sqrt(np.maximum(values, 0.0))[..., None] * np.swapaxes(vectors, -1, -2)
        return sp.csr_array(_at_each_sample(np.moveaxis(roots, 0, -1)) @ self.matrix)

    @property
    def value_count(self) -> int:
        """Number m · T of the values."""
        return self.function.jacobian_pattern.shape[0] * self.t_s.shape[1]

    @cached_property
    def patterns(self) -> tuple[sp.csr_array, sp.csr_array]:
        """Positive entries where the derivatives of `linearise` and `weighted_hessian` may differ from
        zero.
        """
        times, sizes = self.t_s.shape[1], abs(self.matrix)
        by_inputs, twice = (
            _at_each_sample(np.repeat(each[..., None], times, axis=2).astype(np.float64))
            for each in (self.function.jacobian_pattern, self.function.hessian_pattern)
        )
        return sp.csr_array(by_inputs @ sizes), sp.csr_array(sizes.T @ twice @ sizes)


@dataclass(frozen=True, eq=False)
class AugmentedCosts:
    """Residuals of costs, and of limits g ≤ 0 in an augmented Lagrangian, √w max(0, g + λ / w).

    `evaluate` and `linearise` are those of `PathValues`. The convex part of the limits' curvature
    enters as rows whose values are zero.
    """

    costs: PathValues | None
    limits: PathValues
    multipliers: Array  # (m, T): λ
    weight: float  # w

    def evaluate(self, x: Array) -> Array:
        """Return the residuals (k,)."""
        return self._stacked(x, self._violations(self.limits.evaluate(x)))

    def linearise(self, x: Array) -> tuple[Array, sp.csr_array]:
        """Return the residuals (k,), and their derivatives (k, N · 3n) by the motion."""
        values, by_x = self.limits.linearise(x)
        violations = self._violations(values)
        active = sp.diags_array(np.sqrt(self.weight) * (violations.ravel() > 0))
        convex = self.limits.convex_rows(x, self.weight * violations)
        parts = [active @ by_x, convex]
        if self.costs is not None:
            parts.insert(0, self.costs.linearise(x)[1])
        curved = np.zeros(convex.indptr.size - 1)
        return (
            np.concatenate([self._stacked(x, violations), curved]),
            sp.csr_array(sp.vstack(parts)),
        )

    def updated(self, x: Array) -> Array:
        """Return the multipliers (m, T) after a search that ended with the motion x (N, 3n)."""
        return self.weight * self._violations(self.limits.evaluate(x))

    def _violations(self, values: Array) -> Array:
        return np.maximum(0.0, values + self.multipliers / self.weight)

    def _stacked(self, x: Array, violations: Array) -> Array:
        costs = np.zeros(0) if self.costs is None else self.costs.evaluate(x).ravel()
        return np.concatenate([costs, np.sqrt(self.weight) * violations.ravel()])


def keyed_entries(matrix: Any) -> tuple[Index, Array]:
    """Return the key of each entry, column · rows + row, and its value."""
    entries = sp.coo_array(matrix)
    row, column = (each.astype(np.int64) for each in entries.coords)
    return column * matrix.shape[0] + row, np.asarray(entries.data, dtype=np.float64)


def _name(term: PathCost | PathLimit) -> str:
    return "limits" if isinstance(term, PathLimit) else "costs"


def _evaluated(term: PathCost | PathLimit, at: PathQuantities, where: str) -> ca.SX:
    try:
        found = term.function(at)
        if found is None:
            raise TypeError("the function returns None")
        values = stack_values(found)
    except (Exception, SystemExit) as error:
        raise InputError(
            f"the function cannot be evaluated ({reason(error)}); expected a function of an argument "
            f"`at` with the attributes {', '.join(each.name for each in fields(at))}, in CasADi "
            f"operations, for {at.position_m.shape[1]} points",
            where=where,
        ) from error
    if not values.numel():
        raise InputError("the function returns no number; expected one or several", where=where)
    return values


def _inputs(
    body: Body, points_m: Array, hand: Index, used: Index, grid_since_s: Array, rows: Index
) -> sp.csr_array:
    """Return the matrix of the `used` inputs: positions, velocities and accelerations of points on the
    undeformed body, and last of the hand.
    """
    placed = place_markers(points_m, body.nodes.points_m, body, sensor="path")
    nodes = [*placed.nodes, hand]
    weights = [*placed.weights, np.full(len(hand), 1 / len(hand))]
    # Differences need neighbours in time; the first and the last sample have those of the next one.
    last = len(grid_since_s) - 1
    middle = np.clip(rows, 1, last - 1)
    step_s = grid_since_s[1]
    before, at, after, own = (
        sp.csr_array((np.ones(len(rows)), (np.arange(len(rows)), each)), (len(rows), last + 1))
        for each in (middle - 1, middle, middle + 1, rows)
    )
    kinds = (own, (after - before) / (2 * step_s), (after - 2 * at + before) / step_s**2)
    blocks = []
    for index in used.tolist():
        kind, place = divmod(index, 3 * len(nodes))
        point, axis = divmod(place, 3)
        of_dofs = np.zeros(3 * len(body.nodes_m))
        np.add.at(of_dofs, 3 * np.asarray(nodes[point]) + axis, weights[point])
        blocks.append(sp.kron(kinds[kind], sp.csr_array(of_dofs[None])))
    return sp.csr_array(sp.vstack(blocks))


def _at_each_sample(values: Array) -> sp.csr_array:
    """Return values (a, b, T) as a matrix (a · T, b · T) whose blocks are diagonal."""
    rows, columns, times = values.shape
    row, column, time = np.nonzero(values)
    entries = (values[row, column, time], (row * times + time, column * times + time))
    return sp.csr_array(entries, shape=(rows * times, columns * times))
