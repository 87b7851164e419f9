"""What is evaluated over all timesteps and elements, and by CasADi's own machine, the reference."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from ...arrays import Array
from ...errors import InputError
from ..kernel import PointKernel
from ..pattern import dofs_of


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

        From `fields`, each (T, 3n), θ (k,) and, for points that carry something, `carried`
        (T, any), or (1, any) where it is the same at all times.
        """
        ...


class VectorCodeError(InputError):
    """A kernel that cannot be compiled to vector code."""


class CasadiEvaluator:
    """Evaluate a `Batch` by CasADi's own virtual machine; slower, available everywhere."""

    def __init__(self, batch: Batch) -> None:
        count, points, size = batch.geometry.shape
        kernel = batch.kernel
        self._mapped = kernel.element_function(points).map(
            "element_map", "serial", count, [len(kernel.fields) + 1], []
        )
        self._geometry = np.asfortranarray(batch.geometry.reshape(count * points, size).T)
        self._dofs = dofs_of(batch.cells).T
        self._carried = None
        if batch.carried is not None:
            self._carried = batch.carried.reshape(count * points, -1).T
        destinations = batch.destinations.ravel()
        self._sum = sp.csr_array(
            (np.ones(len(destinations)), (destinations, np.arange(len(destinations)))),
            shape=(batch.width, len(destinations)),
        )

    def __call__(
        self,
        fields: Sequence[Array],
        theta: Array,
        out: Array,
        threads: int,
        add: bool = False,
        carried: Array | None = None,
    ) -> None:
        """Add up the kernel over elements and points into `out` (T, width); see `Evaluator`."""
        for t in range(len(out)):
            inputs = [field[t][self._dofs] for field in fields]
            if self._carried is not None and carried is not None:
                own = [carried[t if len(carried) > 1 else 0][self._carried]]
            else:
                own = []
            outputs = self._mapped.call([*inputs, self._geometry, theta, *own])
            stacked = np.concatenate([value.full() for value in outputs])
            total = self._sum @ stacked.ravel(order="F")
            out[t] = out[t] + total if add else total
