"""How the trajectory follows the parameters: Z = dx/dp with the equations of motion kept.

From the linearised constraints c_x Z + c_p = 0, solved forward in time by `nlp.tangent`; p are the
shared parameters q and those φ of an experiment that move its body, see `Segment.moving`.
"""

from __future__ import annotations

import numpy as np

from ..arrays import Array
from ..nlp.collocation import Collocation
from ..nlp.lapack import one_blas_thread
from ..nlp.tangent import BlockSolver


def sensitivities(collocation: Collocation, z: Array) -> list[Array]:
    """dx/dp of each experiment, (N, 3n, m) in metres per unit of p.

    Held dofs have zeros, and so has x_0 unless it is found in equilibrium.

    Raises
    ------
    SimulationError
        Where the equations of a step are singular.
    """
    return [
        np.stack(list(BlockSolver(part.segment).sensitivities(part.x, part.setting)))
        for part in collocation.parts(z)
    ]


@one_blas_thread()
def marker_sensitivities(collocation: Collocation, z: Array) -> list[Array]:
    """d(markers)/dp of each experiment at its samples, (T, 3M, m); column 3 m + axis.

    Of the plain markers, h(x), by the parameters that move the body. Needs no more memory than the
    result.

    Raises
    ------
    SimulationError
        Where the equations of a step are singular.
    """
    found = []
    for part in collocation.parts(z):
        rows = BlockSolver(part.segment).sensitivities(part.x, part.setting)
        sampled = set(part.segment.observation.grid_rows.tolist())
        operator = part.segment.observation.operator(part.phi)
        found.append(np.stack([operator @ row for t, row in enumerate(rows) if t in sampled]))
    return found
