"""How the trajectory follows the parameters: Z = dx/dp with the equations of motion kept.

From the linearised constraints c_x Z + c_p = 0, solved forward in time by `program.sweep`; p are
the shared parameters q and those φ of an experiment that move its body, see `Segment.moving`.
"""

from __future__ import annotations

import numpy as np

from ..arrays import Array
from ..fem.kernels import side_by_side
from ..program.collocation import Collocation, Part
from ..program.lapack import one_blas_thread
from ..program.reaction import HeldForces
from ..program.sensing import Response
from ..program.sweep import Sweep


def sensitivities(collocation: Collocation, z: Array) -> list[Array]:
    """dx/dp of each experiment, (N, 3n, m) in metres per unit of p.

    Held dofs have zeros, and so has x_0 unless it is found in equilibrium.

    Raises
    ------
    SimulationError
        Where the equations of a step are singular.
    """
    return [
        np.stack(list(Sweep(part.segment).sensitivities(part.x, part.setting)))
        for part in collocation.parts(z)
    ]


@one_blas_thread()
def responses(collocation: Collocation, z: Array) -> list[Response]:
    """The response of each experiment; needs no more memory than the result.

    Raises
    ------
    SimulationError
        Where the equations of a step are singular.
    """

    def of(part: Part) -> Response:
        segment = part.segment
        held = HeldForces.nothing(len(part.x), len(segment.sensed_dofs), len(segment.moving))
        rows = Sweep(segment).sensitivities(part.x, part.setting, held)
        return part.sensing.read_along(rows, held)

    return side_by_side(of, collocation.parts(z), collocation.threads)


def marker_sensitivities(collocation: Collocation, z: Array) -> list[Array]:
    """d(markers)/dp of each experiment at its samples, (T, 3M, m), see `Response`."""
    return [response.looked[0] for response in responses(collocation, z)]
