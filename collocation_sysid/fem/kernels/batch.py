"""What is evaluated over all timesteps and elements, independent of how."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ...arrays import Array
from ...errors import InputError
from ..kernel import PointKernel


@dataclass(frozen=True, eq=False)
class Batch:
    """A kernel on a mesh, and where its outputs are added up.

    Attributes
    ----------
    kernel : PointKernel
    cells : ndarray
        (E, nodes) node numbers.
    geometry : ndarray
        (E, q, 3·nodes + 1), see `elements.reference_geometry`.
    destinations : ndarray
        (E, outputs) position of every output entry in the result row of its timestep.
    width : int
        Length of that row.
    carried : ndarray, optional
        (E, q, m) where in a timestep's row of what points carry the numbers of each point are.
    """

    kernel: PointKernel
    cells: NDArray[np.int64]
    geometry: Array
    destinations: NDArray[np.int64]
    width: int
    carried: NDArray[np.int64] | None = None


class Evaluator(Protocol):
    """Sums a batch's kernel over elements and quadrature points, for each timestep."""

    def __call__(
        self,
        fields: Sequence[Array],
        theta: Array,
        out: Array,
        threads: int,
        add: bool = False,
        carried: Array | None = None,
    ) -> None:
        """Overwrite `out` (T, width), or add to it.

        From `fields`, each (T, 3n), θ (k,) and, for points with a memory, `carried` (T, any).
        """
        ...


class VectorCodeError(InputError):
    """A kernel that cannot be compiled to vector code."""
