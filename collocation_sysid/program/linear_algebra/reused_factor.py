"""Solution of a sequence of similar symmetric positive definite systems with few factorisations.

The matrices of successive time steps of a motion differ little, apart from the rotation of the
body: the stiffness rotates with it. The factor of an earlier time step, rotated with the body, is
therefore a good preconditioner, and one or two corrections replace a factorisation, which costs
several times as much for large bodies. The corrections are those of the method of generalised
conjugate residuals (GCR; Eisenstat, Elman and Schultz, 1983), which also allows a small skew part.
Where they become slow, the matrix of the present time step is factorised.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ...common.array_types import Array, Index
from .factorisation import ACCURACY, CONTRACTION, Factor, Factoriser

# Largest reduction of the residual by a correction with an earlier factor that is too slow: the
# matrix is then factorised.
SLOWEST_REDUCTION = 0.5
# Largest number of corrections with an earlier factor.
LARGEST_CORRECTION_COUNT = 12
# Expected error of a solution over the required one, because it is estimated from residuals.
SAFETY = 0.3
# A factorisation costs this number of solutions per mean number of entries of a column of a
# supernodal factor, for `MEASURED_COLUMNS` columns of the right-hand side (measured from 800 to
# 20,000 nodes, see `relative_cost`).
COST_PER_ENTRY = 0.01
# The same of a banded factor, which is solved in blocks (measured from 1,300 to 5,000 nodes).
BAND_COST_PER_ENTRY = 0.0065
# Part of the time of a solution that does not depend on the number of right-hand sides, in columns.
FIXED_COLUMNS = 2
# Columns of a right-hand side at which `COST_PER_ENTRY` was measured.
MEASURED_COLUMNS = 5


def relative_cost(factoriser: Factoriser, columns: int) -> float:
    """Return the estimated time of a factorisation in single precision over that of the solution
    for a number of right-hand sides.

    The estimate depends on sizes only, so that results can be reproduced.
    """
    entries = factoriser.estimate_factor_size() / max(1, factoriser.size)
    share = (FIXED_COLUMNS + columns) / (FIXED_COLUMNS + MEASURED_COLUMNS)
    each = BAND_COST_PER_ENTRY if factoriser.is_banded else COST_PER_ENTRY
    return each * entries / share


class Matrix(NamedTuple):
    """Matrix of one time step."""

    values: Array  # (m,): lower triangle of the symmetric part, see `Factoriser.factorise`
    skew: Array  # (m,) or (0,): lower triangle of the skew part; empty for a symmetric matrix


class NodeRotation:
    """Rotation of the free dofs of a body by one rotation of space.

    Parameters
    ----------
    free : (k,) array
        Free dofs, ascending; dof 3 i + j is the coordinate j of node i.
    """

    def __init__(self, free: Index, node_count: int) -> None:
        self._free = free
        self._count = node_count
        nodes = free.reshape(-1, 3) if len(free) % 3 == 0 else None
        self._is_by_node = (
            nodes is not None
            and bool((nodes[:, 0] % 3 == 0).all())
            and bool((np.diff(nodes, axis=1) == 1).all())
        )

    def apply(self, rotation: Array, columns: Array) -> Array:
        """Return columns (k, c) of the free dofs rotated by a matrix (3, 3), as a new array; dofs
        that are not free count as zero.
        """
        count = columns.shape[1]
        if self._is_by_node:
            by_node = columns.reshape(-1, 3, count)
            return np.matmul(rotation, by_node).reshape(-1, count)
        complete = np.zeros((3 * self._count, count))
        complete[self._free] = columns
        rotated = np.matmul(rotation, complete.reshape(-1, 3, count))
        return rotated.reshape(-1, count).take(self._free, axis=0)


def best_rotation(before_m: Array, after_m: Array) -> Array:
    """Return the rotation (3, 3) that maps points (n, 3) best to others, after the translation of
    their means, by least squares.
    """
    before = before_m - before_m.mean(axis=0)
    after = after_m - after_m.mean(axis=0)
    return Rotation.align_vectors(after, before)[0].as_matrix()


@dataclass(eq=False)
class FactorSequence:
    """Solver of the systems of successive time steps with the latest factor."""

    factoriser: Factoriser  # analysis of the sparsity pattern, with single precision
    rotation: NodeRotation  # rotation of the free dofs
    accuracy: float = ACCURACY  # relative accuracy of the solutions
    factorisation_count: int = 0  # number of factorisations so far
    _factor: Factor | None = None
    _points_m: Array = field(default_factory=lambda: np.zeros((0, 3)))
    # Cost of the factor and of all solutions with it, in solutions for all columns.
    _cost: float = 0.0
    _systems: int = 0
    _is_due: bool = False

    def factorise(self, matrix: Matrix, points_m: Array) -> bool:
        """Replace the factor by that of a matrix at positions (n, 3) [m] of the nodes, and return
        whether the symmetric part is positive definite in single precision; the sequence has no
        factor if it is not.
        """
        self._factor = None  # returns its memory before the next one is made
        self._factor = self.factoriser.factorise_rounded(matrix.values)
        self._points_m = points_m
        self._cost = 0.0
        self._systems = 0
        self._is_due = False
        self.factorisation_count += 1
        return self._factor is not None

    @property
    def is_due(self) -> bool:
        """Whether a factorisation is cheaper than further use of the present factor, or there is
        none.
        """
        return self._factor is None or self._is_due

    def count_cost(self, solutions: float, columns: int) -> None:
        """Record that one system needed a number of solutions of all its columns.

        A new factor is due when a system costs more than the mean so far, with the factorisation.
        """
        if not self._systems:
            self._cost = relative_cost(self.factoriser, columns)
        self._systems += 1
        self._cost += solutions
        self._is_due = solutions > self._cost / self._systems

    def preconditioned(self, residual: Array, points_m: Array) -> Array:
        """Return the solution (k, c) for right-hand sides (k, c) by the present factor, rotated to
        positions (n, 3) [m].
        """
        assert self._factor is not None
        # In single precision small numbers would become zero.
        size = np.abs(residual).max(axis=0, initial=0.0)
        size[size == 0] = 1.0
        scaled = residual / size
        if points_m is self._points_m:
            return size * np.asarray(self._factor.solve(scaled), dtype=float)
        turn = best_rotation(self._points_m, points_m)
        solution = self._factor.solve(self.rotation.apply(turn.T, scaled))
        return size * self.rotation.apply(turn, np.asarray(solution, dtype=float))


class _Columns:
    """Iterative solution of the columns of one system that are not yet accurate.

    Attributes
    ----------
    active : (a,) array
        Indices of these columns.
    solution : (k, c) array
        Present solution of all columns.
    residual : (k, a) array
        Residuals of the active columns.
    is_definite : bool
        Whether no direction so far has a negative curvature, which a positive definite matrix
        excludes.

    Parameters
    ----------
    product : callable
        Product of the matrix with columns.
    weight : (k, 1) array
        Weights of the squares of residuals: the inverse diagonal, so that soft and stiff parts of a
        body count equally.
    right : (k, c) array
        Right-hand sides; not modified.
    guess : (k, c) array or None
        Guess of the solution, which is multiplied by the best factor for each column.
    """

    def __init__(
        self, product: Callable[[Array], Array], weight: Array, right: Array, guess: Array | None
    ) -> None:
        self.product = product
        self.weight = weight
        self.solution = np.zeros_like(right)
        self.active = np.flatnonzero(right.any(axis=0))
        self.residual = right[:, self.active]
        self.is_definite = True
        self._directions: list[tuple[Array, Array, Array]] = []
        if guess is not None:
            self.correct(guess[:, self.active])
            self.forget_directions()
        self.keep(self.residual_size() > 0)

    def residual_size(self) -> Array:
        """Return the weighted square norms (active,) of the residuals."""
        return self._inner(self.residual, self.residual)

    def correct(self, direction: Array) -> None:
        """Add the multiple of a direction, made conjugate, that makes the residuals smallest."""
        image = self.product(direction)
        for previous, previous_image, size in self._directions:
            share = self._inner(image, previous_image) / size
            direction = direction - share * previous
            image = image - share * previous_image
        curvature = np.einsum("ij,ij->j", direction, image)
        self.is_definite &= bool((curvature >= 0).all())
        size = self._inner(image, image)
        size[size == 0] = 1.0
        length = self._inner(self.residual, image) / size
        self.solution[:, self.active] += length * direction
        self.residual = self.residual - length * image
        self._directions.append((direction, image, size))

    def keep(self, is_active: NDArray[np.bool_]) -> None:
        if is_active.all():
            return
        self.active = self.active[is_active]
        self.residual = self.residual[:, is_active]
        self._directions = [
            (d[:, is_active], q[:, is_active], size[is_active]) for d, q, size in self._directions
        ]

    def forget_directions(self) -> None:
        """Delete all directions: continue from the present solution with another preconditioner."""
        self._directions = []

    def _inner(self, first: Array, second: Array) -> Array:
        """Return the weighted products (c,) of the columns."""
        return np.einsum("ij,ij->j", first, self.weight * second)


@dataclass(eq=False)
class ReusedFactor:
    """System of one time step, solved with the latest factor of a sequence; the matrix is
    factorised only where that is too slow.
    """

    sequence: FactorSequence  # shared by all time steps, which are solved one after the other
    matrix: Matrix
    points_m: Array  # (n, 3): positions of the nodes at the evaluation of the matrix [m]
    _complete: Factor | None = None

    @property
    def positive_definite(self) -> bool:
        """Whether the symmetric part is positive definite, known after the first solution."""
        return self._complete is None or self._complete.positive_definite

    def solve(self, right: Array, transposed: bool = False, guess: Array | None = None) -> Array:
        """Return the solution for right-hand sides (k,) or (k, m), in the same shape, to the
        accuracy of the sequence.

        Parameters
        ----------
        right : (k,) or (k, m) array
            Right-hand sides; not modified.
        guess : array, optional
            Guess of the solution, in the shape of `right`.

        Raises
        ------
        numpy.linalg.LinAlgError
            If the matrix is singular or not finite.
        """
        columns = right.reshape(len(right), -1)
        start = None if guess is None else guess.reshape(columns.shape)
        solution = None
        if self._complete is None:
            solution = self._solve_iteratively(columns, transposed=transposed, guess=start)
        if solution is None:
            solution = self._complete_factor().solve(columns, transposed)
        return solution.reshape(right.shape)

    def _complete_factor(self) -> Factor:
        if self._complete is None:
            self._complete = self.sequence.factoriser.factorise(
                self.matrix.values, self.matrix.skew
            )
        return self._complete

    def _solve_iteratively(
        self, right: Array, transposed: bool, guess: Array | None
    ) -> Array | None:
        """None if even the factor of this matrix in single precision does not lead to it."""
        sequence = self.sequence
        matrix = sequence.factoriser.complete_matrix(self.matrix.values, self.matrix.skew)
        diagonal = np.asarray(matrix.diagonal(), dtype=float)
        if not (np.isfinite(matrix.data).all() and (diagonal > 0).all()):
            return None
        by_row = matrix.T if transposed else matrix
        columns = _Columns(
            lambda each: by_row @ each, weight=1.0 / diagonal[:, None], right=right, guess=guess
        )
        if not columns.is_definite:
            return None
        is_own = sequence.is_due
        if is_own and not sequence.factorise(self.matrix, self.points_m):
            return None
        solutions = 0.0
        for _ in range(LARGEST_CORRECTION_COUNT):
            if not len(columns.active):
                sequence.count_cost(solutions, columns=right.shape[1])
                return columns.solution
            correction = sequence.preconditioned(columns.residual, self.points_m)
            solutions += (FIXED_COLUMNS + len(columns.active)) / (FIXED_COLUMNS + right.shape[1])
            before = columns.residual_size()
            columns.correct(correction)
            if not columns.is_definite:
                return None
            reduction = np.sqrt(columns.residual_size() / before)
            length = np.abs(correction).max(axis=0, initial=0.0)
            size = np.abs(columns.solution[:, columns.active]).max(axis=0, initial=0.0)
            is_accurate = reduction * length <= SAFETY * sequence.accuracy * size
            slowest = float(np.max(reduction, where=~is_accurate, initial=0.0))
            if is_own and not slowest <= CONTRACTION:
                return None
            columns.keep(~is_accurate)
            if not is_own and not slowest <= SLOWEST_REDUCTION:
                is_own = True
                if not sequence.factorise(self.matrix, self.points_m):
                    return None
                solutions = 0.0
                columns.forget_directions()
        return None
