"""Time steps of a body with local forces, which are condensed to the dofs on which they act.

The stiffness of local forces changes with every point at which they begin or cease to act, whereas
the matrix A of the body without them hardly changes from one step to the next. Here only A is
factorised. With the residual c of the body and the local forces f, the step d from the state x
satisfies

    d = A⁻¹ (c(x) + f(x + d)),

in which f depends on the few active dofs. Columns of A⁻¹ at these dofs, their compliance, are
computed once for each factor of A. The equation is solved for the step of these dofs by Newton's
method with small dense matrices, so that it contains any change of the active points, and the
iteration over x converges as fast as that of a body without local forces.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import get_lapack_funcs

from ...common.array_types import Array, Index
from ...model.local_force import ActivePoints, LocalForces
from ..linear_algebra.factorisation import Factor
from .newton_linearisation import LaggedStress, NewtonLinearisation

# Largest number of active dofs: dense matrices of this size take as long as the factor of a body of
# some thousand nodes.
MAX_ACTIVE_DOFS = 900
# Largest number of Newton iterations for the active dofs; usually 1 to 5.
MAX_LOCAL_ITERATIONS = 20
# Largest remaining error of the step of these dofs, as a share of the longest step: the iteration
# over the state of the body reduces the error by a similar factor.
LOCAL_ACCURACY = 0.05
# Remaining error that is due to rounding, as a share of the size of the body.
ROUND_OFF = 1e-13
# Largest number of entries of all columns that are stored, 240 MB.
MAX_COLUMN_ENTRIES = 30_000_000
# Number of columns for which memory is allocated at a time.
COLUMN_BATCH = 64
# Number of sets of active points whose dofs are cached with a factor.
MAX_CACHED_POINT_SETS = 16

_getrf, _getrs = get_lapack_funcs(("getrf", "getrs"), dtype=np.float64)


class CondensationError(Exception):
    """The local forces of a step cannot be condensed: too many dofs are active, or the iteration
    for them does not converge.
    """


class StepEquations(ABC):
    """Equations of motion of one time step as functions of the positions at its end.

    Derived classes state the equations without local forces; the complete ones contain these.

    Attributes
    ----------
    local : LocalForces
        Local forces in the step.
    rates : (float, float)
        Derivatives of the state ξ and of the velocity ν of the local forces by the positions.
    local_weight : float
        Factor of the local forces in the residual.
    stress : LaggedStress
        Mean stresses of the elements.

    Parameters
    ----------
    local, rates, local_weight, stress
        See the attributes.
    """

    def __init__(
        self,
        local: LocalForces,
        rates: tuple[float, float],
        local_weight: float,
        stress: LaggedStress,
    ) -> None:
        self.stress = stress
        self.local = local
        self.rates = rates
        self.local_weight = local_weight

    @abstractmethod
    def states(self, x: Array) -> tuple[Array, Array]:
        """Return the state ξ [m] and velocity ν [m/s], (1, 3n) each, at which local forces act if
        the step ends at x (3n,) [m].
        """

    @abstractmethod
    def residual_without_local(self, x: Array) -> Array:
        """Return the residual (3n,) [N] without local forces at positions x (3n,) [m]."""

    @abstractmethod
    def linearise_without_local(self, x: Array) -> NewtonLinearisation:
        """Return the residual (3n,) [N] without local forces at positions x (3n,) [m], and its
        derivative by x.
        """

    def residual(self, x: Array) -> Array:
        """Return the complete residual (3n,) [N] at positions x (3n,) [m]."""
        residual = self.residual_without_local(x)
        if not self.local.parts:
            return residual
        return residual + self.local_weight * self.local.force(*self.states(x))

    def linearise(self, x: Array) -> NewtonLinearisation:
        """Return the complete residual (3n,) [N] at positions x (3n,) [m], and its derivative by
        x.
        """
        at = self.linearise_without_local(x)
        if not self.local.parts:
            return at
        force_n, symmetric, local_skew = self.local.linearise(*self.states(x), self.rates)
        skew = at.skew
        if local_skew.size:
            skew = skew - self.local_weight * local_skew
        return NewtonLinearisation(
            at.residual + self.local_weight * force_n,
            at.symmetric - self.local_weight * symmetric,
            skew=skew,
        )

    def active_points(self, x: Array) -> list[ActivePoints]:
        """Return the points on which local forces act at positions x (3n,) [m]."""
        return self.local.active_points(*self.states(x), self.rates)


class ActiveCompliance(NamedTuple):
    """Compliance of a body at active dofs."""

    dofs: Index  # (s,): sorted indices of the dofs among the free ones
    # (s, k): columns of the inverse of the matrix of the body at these dofs, transposed.
    columns: Array
    matrix: Array  # (s, s): C, the entries of these columns at the dofs [m/N]


class Compliance:
    """Columns of the inverse of a factorised matrix on the free dofs, computed on demand.

    Attributes
    ----------
    factor : Factor
        Factor of the matrix of the body without local forces.

    Parameters
    ----------
    factor : Factor
        See the attributes.
    free : (k,) array
        Indices of the free dofs.
    dof_count : int
        Number 3n of all dofs.
    """

    def __init__(self, factor: Factor, free: Index, dof_count: int) -> None:
        self.factor = factor
        self._number = np.full(dof_count, -1)
        self._number[free] = np.arange(len(free))
        self._column_of_dof = np.full(len(free), -1)
        self._count = 0
        self._columns = np.zeros((0, len(free)))
        self._last: ActiveCompliance | None = None
        self._active_dofs: dict[tuple[Hashable, ...], ActiveDofs] = {}

    def active_dofs(self, points: Sequence[ActivePoints]) -> ActiveDofs:
        """Return the free dofs on which active points act; those of the same points are cached."""
        key = tuple(each.key for each in points)
        active = self._active_dofs.get(key)
        if active is None:
            if len(self._active_dofs) >= MAX_CACHED_POINT_SETS:
                self._active_dofs.clear()
            active = ActiveDofs.from_points(points, self._number)
            self._active_dofs[key] = active
        return active

    def at_dofs(self, dofs: Index) -> ActiveCompliance:
        """Return the compliance at sorted free dofs, given as indices (s,); the last one is cached.

        Raises
        ------
        CondensationError
            If the columns at these dofs need too much memory.
        """
        if self._last is None or not np.array_equal(self._last.dofs, dofs):
            columns = self.columns_at(dofs)
            matrix = np.asfortranarray(columns[:, dofs].T)
            self._last = ActiveCompliance(dofs, columns, matrix=matrix)
        return self._last

    def columns_at(self, dofs: Index) -> Array:
        """Return the rows (s, k) of the transposed inverse at free dofs, given as indices (s,).

        Columns that are not known yet are computed and stored, in place of all others if these
        would need more than `MAX_COLUMN_ENTRIES`.

        Raises
        ------
        CondensationError
            If the columns at these dofs need more.
        """
        size = len(self._column_of_dof)
        if len(dofs) * size > MAX_COLUMN_ENTRIES:
            raise CondensationError
        missing = dofs[self._column_of_dof[dofs] < 0]
        if (self._count + len(missing)) * size > MAX_COLUMN_ENTRIES:
            self._column_of_dof[:] = -1
            self._count = 0
            missing = dofs
        if len(missing):
            self._append(missing)
        chosen = self._column_of_dof[dofs]
        if len(chosen) == self._count and (np.diff(chosen) == 1).all():
            return self._columns[: self._count]
        return self._columns[chosen]

    def _append(self, dofs: Index) -> None:
        """Compute and store the columns of free dofs (s,) that are not known yet."""
        size = len(self._column_of_dof)
        unit_forces = np.zeros((size, len(dofs)))
        unit_forces[dofs, np.arange(len(dofs))] = 1.0
        count = self._count + len(dofs)
        if count > len(self._columns):
            allocated = -(-count // COLUMN_BATCH) * COLUMN_BATCH
            columns = np.empty((allocated, size))
            columns[: self._count] = self._columns[: self._count]
            self._columns = columns
        self._columns[self._count : count] = self.factor.solve(unit_forces).T
        self._column_of_dof[dofs] = np.arange(self._count, count)
        self._count = count


@dataclass(frozen=True, eq=False)
class _PointAssembly:
    """Assembly of the forces on t active points of one local force."""

    # (t · 3v,): index among the active dofs of each dof of each point, point by point; s for dofs
    # that are prescribed, or along axes without a force.
    places: Index
    # (t · 9v²,): index among the pairs of active dofs, of which there are (s + 1)², of each pair of
    # dofs of each point.
    pair_places: Index
    weights: Array  # (t, v): shape functions of the nodes of each point
    pair_weights: Array  # (t, v, 1, v, 1): products of two of these weights

    @classmethod
    def from_places(cls, places: Index, weights: Array, size: int) -> _PointAssembly:
        """Return the assembly of points with weights (t, v) at places (t, 3v) onto `size` dofs."""
        pair_places = places[:, :, None] * (size + 1) + places[:, None]
        return cls(
            places.ravel(),
            pair_places.ravel(),
            weights=weights,
            pair_weights=weights[:, :, None, None, None] * weights[:, None, None, :, None],
        )


@dataclass(frozen=True, eq=False)
class ActiveDofs:
    """Free dofs of the nodes of active points along the axes of their forces, and the assembly of
    forces on them.
    """

    dofs: Index  # (s,): sorted indices among the free dofs
    parts: Sequence[_PointAssembly]  # assembly of the points of each local force

    @classmethod
    def from_points(cls, points: Sequence[ActivePoints], number: Index) -> ActiveDofs:
        """Return the dofs of active points.

        Parameters
        ----------
        points : sequence of ActivePoints
            Points of each local force.
        number : (3n,) array
            Index of each dof among the free ones; −1 for prescribed dofs.
        """
        numbers = [
            np.where(
                np.tile(each.axes, each.candidates.nodes.shape[1]),
                number[each.candidates.dofs[each.indices]],
                -1,
            )
            for each in points
        ]
        is_active = np.zeros(len(number) + 1, dtype=bool)
        for each in numbers:
            is_active[each] = True
        is_active[-1] = False
        (dofs,) = is_active.nonzero()
        place_of_dof = np.full(len(is_active), len(dofs))
        place_of_dof[dofs] = np.arange(len(dofs))
        parts = [
            _PointAssembly.from_places(
                place_of_dof[numbers_of_points],
                each.candidates.weights[each.indices],
                size=len(dofs),
            )
            for each, numbers_of_points in zip(points, numbers, strict=True)
        ]
        return cls(dofs, parts)

    def assemble_force(self, points: Sequence[ActivePoints]) -> Array:
        """Return the forces (s,) [N] on the dofs."""
        count = len(self.dofs) + 1
        total = np.zeros(count)
        for each, part in zip(points, self.parts, strict=True):
            on_nodes = part.weights[:, :, None] * each.force.T[:, None]
            total += np.bincount(part.places, weights=on_nodes.ravel(), minlength=count)
        return total[:-1]

    def assemble_stiffness(self, points: Sequence[ActivePoints]) -> Array:
        """Return the negative derivative (s, s) of the forces on the dofs by their positions
        [N/m].
        """
        count = len(self.dofs) + 1
        total = np.zeros(count * count)
        for each, part in zip(points, self.parts, strict=True):
            slope = each.slope.transpose(2, 0, 1)[:, None, :, None, :]
            total -= np.bincount(
                part.pair_places,
                weights=(part.pair_weights * slope).ravel(),
                minlength=count * count,
            )
        return total.reshape(count, count)[:-1, :-1]


@dataclass(frozen=True, eq=False)
class ForcesOnActiveDofs:
    """Local forces of a state on the active dofs."""

    x: Array  # (3n,): positions [m]
    points: Sequence[ActivePoints]  # active points of each local force
    active: ActiveDofs
    # (s,): forces on these dofs, multiplied by the weight of local forces in the equations [N].
    force: Array

    @property
    def dofs(self) -> Index:
        """Sorted indices (s,) among the free dofs."""
        return self.active.dofs


@dataclass(frozen=True, eq=False)
class CondensedStiffness:
    """Stiffness K of local forces and compliance C of the body at active dofs, with the factor of
    1 + C K.
    """

    compliance: ActiveCompliance  # compliance of the body
    stiffness: Array  # (s, s): K, the negative derivative of the local forces [N/m]
    factor: tuple[Array, Index]  # LU factorisation of 1 + C K

    @classmethod
    def from_matrices(cls, compliance: ActiveCompliance, stiffness: Array) -> CondensedStiffness:
        """Return the condensed matrices of a compliance and a stiffness (s, s) of local forces.

        Raises
        ------
        CondensationError
            If the matrix is singular.
        """
        matrix = compliance.matrix @ stiffness
        matrix.flat[:: len(matrix) + 1] += 1.0
        lu, pivots, info = _getrf(matrix)
        if info:
            raise CondensationError
        return cls(compliance, stiffness, factor=(lu, pivots))

    def solve(self, right: Array) -> Array:
        """Return (1 + C K)⁻¹ b for b = `right` (s,)."""
        return _getrs(*self.factor, right)[0]


class CondensedSteps:
    """Steps of the free dofs towards the solution of a time step with local forces.

    Parameters
    ----------
    equations : StepEquations
        Equations of the time step.
    compliance : Compliance
        Inverse of the matrix of the body without local forces.
    free : (k,) array
        Indices of the free dofs.
    size_m : float
        Size of the body, of which errors by rounding are a share.
    """

    def __init__(
        self, equations: StepEquations, compliance: Compliance, free: Index, size_m: float
    ) -> None:
        self._equations = equations
        self._size_m = size_m
        self._compliance = compliance
        self._free = free
        self._last: ForcesOnActiveDofs | None = None
        self._condensed: CondensedStiffness | None = None

    def step_from(self, x: Array) -> Array:
        """Return the step (k,) [m] from positions x (3n,) [m].

        Raises
        ------
        CondensationError
            If too many dofs are active, or if the iteration for them does not converge.
        """
        start = self._last
        if start is None or not np.array_equal(start.x, x):
            # A copy, because the caller may change x in place.
            start = self._forces_at(x.copy())
        residual = self._equations.residual_without_local(x)[self._free]
        residual[start.dofs] += start.force
        without_change = self._compliance.factor.solve(residual)
        now = start
        step = np.zeros_like(without_change)
        if not len(start.dofs):
            # Before any point is active, the step is that of the body.
            step = without_change
            now = self._forces_at(self._advanced(x, step))
            if not len(now.dofs):
                self._last = now
                return step
        condensed = self._condensed
        if (
            condensed is None
            or now is not start
            or not np.array_equal(condensed.compliance.dofs, start.dofs)
        ):
            condensed = self._condensed_at(start, now)
        for _ in range(MAX_LOCAL_ITERATIONS):
            dofs = condensed.compliance.dofs
            change = _spread(now, dofs) - _spread(start, dofs)
            known = change + condensed.stiffness @ step[dofs]
            step_of_dofs = condensed.solve(
                without_change[dofs] + condensed.compliance.matrix @ known
            )
            forces = known - condensed.stiffness @ step_of_dofs
            step = without_change + forces @ condensed.compliance.columns
            now = self._forces_at(self._advanced(x, step))
            if self._is_converged(step, start, now=now, forces=forces, condensed=condensed):
                self._condensed = condensed
                self._last = now
                return step
            self._condensed = condensed
            condensed = self._condensed_at(start, now)
        raise CondensationError

    def _is_converged(
        self,
        step: Array,
        start: ForcesOnActiveDofs,
        now: ForcesOnActiveDofs,
        forces: Array,
        condensed: CondensedStiffness,
    ) -> bool:
        """Whether the local forces at the end of a step are those of the step."""
        dofs = condensed.compliance.dofs
        if now.active is not start.active and not (np.isin(now.dofs, dofs).all()):
            return False
        change = _spread(now, dofs) - _spread(start, dofs)
        error_m = condensed.compliance.matrix @ (change - forces)
        limit_m = max(LOCAL_ACCURACY * float(np.abs(step).max()), ROUND_OFF * self._size_m)
        return bool(np.abs(error_m).max() <= limit_m)

    def _condensed_at(
        self, start: ForcesOnActiveDofs, now: ForcesOnActiveDofs
    ) -> CondensedStiffness:
        """Return matrices at dofs active at the start or now."""
        dofs = (
            start.dofs if np.array_equal(now.dofs, start.dofs) else np.union1d(start.dofs, now.dofs)
        )
        # Without any, contact is made by the step without contact, and undone by that with it.
        if not 0 < len(dofs) <= MAX_ACTIVE_DOFS:
            raise CondensationError
        present = self._equations.local_weight * now.active.assemble_stiffness(now.points)
        stiffness = present
        if len(dofs) > len(now.dofs):
            stiffness = np.zeros((len(dofs), len(dofs)))
            places = np.searchsorted(dofs, now.dofs)
            stiffness[np.ix_(places, places)] = present
        return CondensedStiffness.from_matrices(self._compliance.at_dofs(dofs), stiffness)

    def _advanced(self, x: Array, step: Array) -> Array:
        """Return positions x (3n,) after a step (k,) of the free dofs."""
        advanced = x.copy()
        advanced[self._free] += step
        return advanced

    def _forces_at(self, x: Array) -> ForcesOnActiveDofs:
        """Return the local forces on free dofs at positions x (3n,), which are not copied."""
        points = self._equations.active_points(x)
        active = self._compliance.active_dofs(points)
        return ForcesOnActiveDofs(
            x,
            points,
            active=active,
            force=self._equations.local_weight * active.assemble_force(points),
        )


def _spread(forces: ForcesOnActiveDofs, dofs: Index) -> Array:
    """Return forces at sorted dofs (s,), which contain those of the forces."""
    if len(dofs) == len(forces.dofs):
        return forces.force
    at_dofs = np.zeros(len(dofs))
    at_dofs[np.searchsorted(dofs, forces.dofs)] = forces.force
    return at_dofs
