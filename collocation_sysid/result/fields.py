"""What the material feels, element by element: det F, energy density, and von Mises stress.

Each is the mean over the element, that is over its quadrature points by their volumes. The stress
is Cauchy's, elastic without the damping's part: with P = ∂ψ/∂F,

    σ = P Fᵀ / J,   s = σ − ⅓ (tr σ) I,   von Mises: √(3/2 s:s)

(Holzapfel 2000, eqs. 3.9 and 6.4); uniaxial stress is its own von Mises stress. F is the one that
the material feels: where an element averages the dilatation, J is its volume's ratio everywhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Array
from ..fem.body import Body
from ..fem.elements import Element
from ..fem.expressions import kernel_of
from ..fem.kernel import Derivative, PointKernel, QuadraturePoint
from ..fem.kernels import Batch, Evaluator
from ..fem.materials import Material

NAMES = ("det_f", "energy_density_j_m3", "von_mises_pa")


@dataclass(frozen=True, eq=False)
class ElementFields:
    """Evaluates the fields of a body at any states.

    Attributes
    ----------
    body : Body
    theta : (k,) its constants
    """

    body: Body
    theta: Array
    _evaluators: Sequence[Evaluator]
    _volumes: Array

    @classmethod
    def of(cls, body: Body, theta: Array) -> ElementFields:
        """Compile the fields of a body's materials."""
        evaluators = []
        for part in body.parts:
            kernel = field_kernel(body.element, part.material)
            # Every element has a place of its own, where its points add up.
            places = len(NAMES) * part.cells[:, None] + np.arange(len(NAMES))
            width = len(NAMES) * len(body.cells)
            batch = Batch(kernel, body.cells[part.cells], body.geometry[part.cells], places, width)
            evaluators.append(body.make_evaluator(batch))
        volumes = body.geometry[:, :, -1].sum(axis=1)
        return cls(body, theta, evaluators, volumes)

    def at(self, positions_m: ArrayLike) -> dict[str, Array]:
        """The fields by `NAMES`, (T, E) each, at positions (T, n, 3).

        An inverted element has no logarithm of its J: what needs one is NaN there.
        """
        body = self.body
        x = np.ascontiguousarray(positions_m, dtype=float).reshape(-1, body.nodes_m.size)
        sums = np.empty((len(x), len(NAMES) * len(self._volumes)))
        shares = body.split(self.theta)
        for k, (part, evaluate) in enumerate(zip(body.parts, self._evaluators, strict=True)):
            constants = np.array(shares[k][: len(part.material.constants)], dtype=float)
            evaluate([x], constants, sums, body.threads, add=k > 0)
        means = sums.reshape(len(x), -1, len(NAMES)) / self._volumes[:, None]
        return {name: means[:, :, k] for k, name in enumerate(NAMES)}


def field_kernel(element: Element, material: Material) -> PointKernel:
    """The fields at a quadrature point times its volume, see `expressions` for the inputs."""
    point = QuadraturePoint.of(element, len(material.constants), "x")
    fields = ca.vertcat(*_point_fields(material, point.theta))
    felt = ca.substitute(fields, _F, ca.vec(point.felt))
    return kernel_of("fields", point, {"fields": (Derivative(point.volume * felt, ()),)})


_F = ca.SX.sym("F", 9)


def _point_fields(material: Material, theta: ca.SX) -> tuple[ca.SX, ...]:
    """J, ψ and the von Mises stress at the deformation gradient `_F`, column after column."""
    f = ca.reshape(_F, 3, 3)
    j = ca.det(f)
    psi = material.psi(f, theta)
    cauchy = ca.reshape(ca.gradient(psi, _F), 3, 3) @ f.T / j
    deviator = cauchy - ca.trace(cauchy) / 3 * ca.SX.eye(3)
    return j, psi, ca.sqrt(1.5 * ca.sumsqr(deviator))
