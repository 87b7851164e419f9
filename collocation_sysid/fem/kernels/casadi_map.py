"""The reference evaluator: `casadi.Function.map` over the elements, one timestep at a time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.sparse as sp

from ..pattern import dofs_of
from .batch import Array, Batch


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
                own = [carried[t][self._carried]]
            else:
                own = []
            outputs = self._mapped.call([*inputs, self._geometry, theta, *own])
            stacked = np.concatenate([value.full() for value in outputs])
            total = self._sum @ stacked.ravel(order="F")
            out[t] = out[t] + total if add else total
