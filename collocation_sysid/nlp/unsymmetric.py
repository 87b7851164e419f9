"""Matrices on the mesh graph that are not symmetric: a symmetric part and a skew one.

Both are given by lower triangles, (m,) each; the skew part's is empty where there is none.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from ..arrays import Array
from ..fem.pattern import SymmetricPattern


def skew_values(pattern: SymmetricPattern, skew: Array) -> Array:
    """Entries (…, nnz) of the whole skew matrix in the order of `pattern.full`."""
    rows, columns, source = pattern.full
    return np.sign(rows - columns) * skew[..., source]


def whole(pattern: SymmetricPattern, lower: Array, skew: Array) -> sp.csc_array:
    """The matrix (3n, 3n) of symmetric part `lower` (m,) and skew part `skew`, (m,) or (0,)."""
    matrix = pattern.matrix(lower)
    if skew.size:
        matrix.data += skew_values(pattern, skew)
    return matrix
