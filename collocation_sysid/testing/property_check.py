"""Comparisons of a check; they fail with property, place, found and expected value."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NoReturn

import numpy as np
from numpy.typing import ArrayLike

from ..common.array_types import Array
from .finite_differences import STEP, directional_derivative

# Largest relative difference of two exact formulas of one quantity: rounding of some thousand
# operations.
EXACT = 1e-9
# Largest relative difference of a derivative from central differences of fourth order.
DIFFERENCES = 1e-6
# Smallest size of a derivative, relative to the value of its function: differences of smaller ones
# are rounding.
ROUNDING = 1e-6
# Steps of the differences, relative to the size of a large change. The step with the best
# agreement counts: a function that bends within the first step needs the last, where rounding is
# the larger error.
STEPS = (STEP, STEP / 30, STEP / 1000)


@dataclass(frozen=True)
class PropertyCheck:
    """Comparisons of one check, with its subject and its random numbers."""

    # Kind and name of what is checked, as a sentence begins with them: "material 'gel'".
    subject: str
    # Random numbers of the states, the same in every run.
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))

    def fail(self, statement: str, found: Any, expected: Any) -> NoReturn:
        """Raise the `AssertionError` of a property, always.

        Parameters
        ----------
        statement : str
            The failed property, and where it fails.
        found, expected : object
            Values for the sentence; floats are rounded to six digits.

        Raises
        ------
        AssertionError
            With the subject, the statement and both values.
        """
        raise AssertionError(
            f"{self.subject}: {statement}; found {_shown(found)}, expected {_shown(expected)}"
        )

    def require_equal(
        self,
        found: ArrayLike,
        expected: ArrayLike,
        *,
        statement: str,
        tolerance: float = EXACT,
        scale: float | None = None,
    ) -> None:
        """Compare two arrays, and name the entry with the largest difference.

        Parameters
        ----------
        found, expected : array
            Arrays of one shape.
        statement : str
            What it means if they differ, such as "P is not ∂ψ/∂F at F = …".
        tolerance : float
            Largest difference, relative to `scale`.
        scale : float, optional
            Size of the quantity; by default the largest absolute expected entry. With a size of
            zero the entries must be equal.

        Raises
        ------
        AssertionError
            If shapes or values differ, or an entry of either array is NaN. Empty arrays of one
            shape are equal.
        """
        values = np.asarray(found, dtype=float)
        references = np.asarray(expected, dtype=float)
        if values.shape != references.shape:
            self.fail(f"{statement} (shapes)", values.shape, expected=references.shape)
        if not values.size:
            return
        size = np.abs(references).max() if scale is None else scale
        errors = np.abs(values - references)
        worst = np.unravel_index(int(np.argmax(np.nan_to_num(errors, nan=np.inf))), errors.shape)
        if not errors[worst] <= tolerance * size:
            entry = f", entry {tuple(map(int, worst))}" if worst else ""
            self.fail(f"{statement}{entry}", values[worst], expected=references[worst])

    def require_derivative(
        self,
        function: Callable[[Array], ArrayLike],
        derivative: ArrayLike,
        point: Array,
        *,
        statement: str,
        scale: ArrayLike = 1.0,
    ) -> None:
        """Compare all columns of a derivative with central differences of the function.

        Parameters
        ----------
        function : callable
            Function of an array like `point`, which returns m numbers.
        derivative : (m, n) array
            Derivative by the n entries of `point`.
        point : (n,) array
        statement : str
            What it means if they differ.
        scale : (n,) array or float
            Size of a large change of each entry of `point`.

        Raises
        ------
        AssertionError
            If they differ.

        Notes
        -----
        The largest entry is not taken below `ROUNDING` times the largest value of the function. Of
        the differences with the `STEPS`, the closest to the derivative count. `derivative` may have
        any shape of m n entries.
        """
        steps = np.broadcast_to(np.asarray(scale, dtype=float), point.shape)
        found = np.asarray(derivative, dtype=float).reshape(-1, point.size) * steps

        def differences(step: float) -> Array:
            """Return the derivative by differences, times the scale."""
            columns = [
                directional_derivative(function, point, direction=direction, step=step)
                for direction in np.diag(steps)
            ]
            return np.stack([np.ravel(column) for column in columns], axis=1)

        size = derivative_size(found, function(point))
        self.require_equal(
            found,
            closest(found, differences, tolerance=DIFFERENCES * size),
            statement=f"{statement}, by central differences",
            tolerance=DIFFERENCES,
            scale=size,
        )


def closest(found: Array, differences: Callable[[float], Array], *, tolerance: float) -> Array:
    """Return, of the differences with each of the `STEPS`, those closest to a derivative."""
    candidates = []
    distances = []
    for step in STEPS:
        candidates.append(differences(step))
        has_shape = candidates[-1].shape == found.shape
        errors = np.abs(candidates[-1] - found) if has_shape else np.array(np.inf)
        distances.append(float(np.nan_to_num(errors, nan=np.inf).max(initial=0.0)))
        if distances[-1] <= tolerance:
            break
    return candidates[int(np.argmin(distances))]


def derivative_size(derivative: Array, value: ArrayLike) -> float:
    """Return the largest absolute entry of a derivative, but not less than `ROUNDING` times the
    largest absolute value of the function, nor less than the smallest positive float.
    """
    largest = float(np.abs(derivative).max(initial=0.0))
    return max(largest, ROUNDING * float(np.abs(value).max(initial=0.0)), np.finfo(float).tiny)


def _shown(value: Any) -> str:
    """Return a value as part of a sentence: floats with six digits, others as `str` shows them."""
    return f"{value:.6g}" if isinstance(value, float | np.floating) else str(value)
