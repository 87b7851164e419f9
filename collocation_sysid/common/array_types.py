"""Array types for annotations; shapes and units are stated in the docstrings."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]


def root_mean(squares: Array) -> float:
    """Return the square root of the mean of `squares`; 0 for an empty array."""
    return float(np.sqrt(squares.mean())) if squares.size else 0.0
