"""How the trajectory follows the parameters: Z = dx/dp with the equations of motion kept.

From the linearised constraints c_x Z + c_p = 0, solved forward in time by `nlp.tangent`; p are the
shared parameters q and those φ of an experiment that move its body, see `Segment.moving`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ..arrays import Array
from ..fem.batched import side_by_side
from ..nlp.collocation import Collocation, Part
from ..nlp.lapack import one_blas_thread
from ..nlp.reaction import HeldForces
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


@dataclass(frozen=True, eq=False)
class Response:
    """How what is measured in one experiment follows the m parameters that move its body.

    Attributes
    ----------
    markers : (T, 3M, m) of the plain markers, h(x), at its samples; column 3 m + axis
    held : HeldForces
        On the dofs of grasps with a sensor.
    moved : (N, g, m) how these dofs move
    """

    markers: Array
    held: HeldForces
    moved: Array


@one_blas_thread()
def responses(collocation: Collocation, z: Array) -> list[Response]:
    """The response of each experiment; needs no more memory than the result.

    Raises
    ------
    SimulationError
        Where the equations of a step are singular.
    """

    def of(part: Part) -> Response:
        segment, dofs = part.segment, part.segment.sensed_dofs
        held = HeldForces.nothing(len(part.x), len(dofs), len(segment.moving))
        rows = BlockSolver(segment).sensitivities(part.x, part.setting, held)
        return read_along(part, rows, held)

    return side_by_side(of, collocation.parts(z), collocation.threads)


def read_along(part: Part, rows: Iterable[Array], held: HeldForces) -> Response:
    """What changes (3n, m) of row after row of x change of what is measured."""
    segment = part.segment
    sampled = set(segment.observation.grid_rows.tolist())
    operator = segment.observation.operator(part.phi)
    markers, moved = [], []
    for t, row in enumerate(rows):
        moved.append(row[segment.sensed_dofs])
        if t in sampled:
            markers.append(operator @ row)
    return Response(np.stack(markers), held, np.stack(moved))


def marker_sensitivities(collocation: Collocation, z: Array) -> list[Array]:
    """d(markers)/dp of each experiment at its samples, (T, 3M, m), see `Response`."""
    return [response.markers for response in responses(collocation, z)]
