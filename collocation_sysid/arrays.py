"""The array types that signatures name; shapes and units stand in the docstrings."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]


def root_mean(squares: Array) -> float:
    """The root of the mean of squares, zero of none."""
    return float(np.sqrt(squares.mean())) if squares.size else 0.0
