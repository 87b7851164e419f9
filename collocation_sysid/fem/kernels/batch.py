"""Batches of element kernels over time steps and elements, and their reference evaluator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from ...common.array_types import Array
from ...errors import InputError
from ..kernel import ElementKernel
from ..pattern import dofs_of


@dataclass(frozen=True, eq=False)
class KernelBatch:
    """Kernel on a mesh, and the positions at which its outputs are summed."""

    kernel: ElementKernel
    cells: NDArray[np.int64]  # (E, nodes): node indices
    # (E, q, 3·nodes + 1): shape gradients and volumes, see `elements.reference_geometry`.
    geometry: Array
    # (E, outputs): position of every output entry in the result row of its time step.
    destinations: NDArray[np.int64]
    width: int  # length of that row
    # (E, q, m): columns of the data of each point in the row of data of a time step.
    data_columns: NDArray[np.int64] | None = None


class Evaluator(Protocol):
    """Evaluator of a batch: sums the kernel over elements and quadrature points, for each time
    step, with the constants `theta` (c,) or those of each step (T, c).
    """

    def __call__(
        self,
        fields: Sequence[Array],
        theta: Array,
        out: Array,
        threads: int,
        add: bool = False,
        data_of_points: Array | None = None,
    ) -> None:
        """Sum the kernel over elements and quadrature points, for each time step."""
        ...


class VectorCodeError(InputError):
    """Error: a kernel cannot be compiled to vector code."""


class CasadiEvaluator:
    """Evaluator of a `KernelBatch` by CasADi's virtual machine: slower, but always available."""

    def __init__(self, batch: KernelBatch) -> None:
        count, points, size = batch.geometry.shape
        kernel = batch.kernel
        self._mapped = kernel.element_function(points).map(
            "element_map", "serial", count, [len(kernel.fields) + 1], []
        )
        self._geometry = np.asfortranarray(batch.geometry.reshape(count * points, size).T)
        self._dofs = dofs_of(batch.cells).T
        self._point_data_columns = None
        if batch.data_columns is not None:
            self._point_data_columns = batch.data_columns.reshape(count * points, -1).T
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
        data_of_points: Array | None = None,
    ) -> None:
        """Sum the kernel over elements and points into `out` (T, width); see `Evaluator`. One
        thread is used, whatever `threads` is.
        """
        for t in range(len(out)):
            inputs = [field[t][self._dofs] for field in fields]
            if self._point_data_columns is not None and data_of_points is not None:
                point_data = [
                    data_of_points[t if len(data_of_points) > 1 else 0][self._point_data_columns]
                ]
            else:
                point_data = []
            constants = theta[t] if theta.ndim > 1 else theta
            outputs = self._mapped.call([*inputs, self._geometry, constants, *point_data])
            stacked = np.concatenate([value.full() for value in outputs])
            total = self._sum @ stacked.ravel(order="F")
            out[t] = out[t] + total if add else total
