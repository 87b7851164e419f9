"""Fields in each element: det F, elastic energy density, and von Mises stress.

Each value is the mean over an element, weighted by the volumes of its quadrature points. The stress
is Cauchy's elastic stress, without the damping stress: with P = ∂ψ/∂F,

    σ = P Fᵀ / J,   s = σ − ⅓ (tr σ) I,   von Mises: √(3/2 s:s)

(Holzapfel 2000, eqs. 3.9 and 6.4); the von Mises stress of uniaxial stress is that stress itself. F
is the deformation gradient in the constitutive law: where an element averages the dilatation, J is
the ratio of its volumes at every point.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from ..common.array_types import Array
from ..fem.body import Body
from ..fem.elements import Element
from ..fem.expressions import PointLaw, kernel_from_outputs, quadrature_point
from ..fem.kernel import Derivative, ElementKernel
from ..fem.kernels import Evaluator, KernelBatch

FIELD_NAMES = ("det_f", "energy_density_j_m3", "von_mises_pa")


@dataclass(frozen=True, eq=False)
class ElementFields:
    """Evaluator of the fields of a body at any node positions."""

    body: Body  # body whose fields are evaluated
    theta: Array  # (k,): constants of the body
    _evaluators: Sequence[Evaluator]
    _volumes: Array

    @classmethod
    def from_body(cls, body: Body, theta: Array) -> ElementFields:
        """Return the evaluator of a body with the constants `theta` (k,); compiles its materials'
        kernels. A rod has none of these fields.
        """
        evaluators = []
        for number, part in enumerate(body.parts if body.is_solid else ()):
            kernel = field_kernel(body.element, body.law(number))
            # Every element has a place of its own, where its points add up.
            places = len(FIELD_NAMES) * part.cells[:, None] + np.arange(len(FIELD_NAMES))
            width = len(FIELD_NAMES) * len(body.cells)
            cells = body.cells[part.cells]
            geometry = body.material_geometry(part)
            histories = None
            if part.stress_field:
                logs = np.arange(len(cells))[:, None, None]
                histories = np.broadcast_to(logs, (*geometry.shape[:2], 1))
            elif body.inverse_equilibrium is not None:
                histories = body.inverse_equilibrium.point_data_columns(number)
            batch = KernelBatch(
                kernel,
                cells,
                geometry=geometry,
                destinations=places,
                width=width,
                data_columns=histories,
            )
            evaluators.append(body.make_evaluator(batch))
        volumes = body.stress_free_geometry(theta)[:, :, -1].sum(axis=1)
        return cls(body, theta, _evaluators=evaluators, _volumes=volumes)

    def evaluate_at(self, positions_m: ArrayLike) -> dict[str, Array]:
        """Return the fields at node positions, by `FIELD_NAMES`.

        Parameters
        ----------
        positions_m : (T, n, 3)
            Node positions [m]; (n, 3) for T = 1.

        Returns
        -------
        dict of str to (T, E)
            det F, elastic energy density [J/m³] and von Mises stress [Pa]. In an inverted element,
            where ln J does not exist, the values that need it are NaN.
        """
        body = self.body
        if not body.is_solid:
            return {}
        x = np.ascontiguousarray(positions_m, dtype=float).reshape(-1, body.nodes_m.size)
        sums = np.empty((len(x), len(FIELD_NAMES) * len(self._volumes)))
        shares = body.split_theta(self.theta)
        for k, (part, evaluate) in enumerate(zip(body.parts, self._evaluators, strict=True)):
            constants = np.array(shares[k][: part.law_constant_count], dtype=float)
            if body.inverse_equilibrium is not None:
                constants = body.point_constants(k, self.theta)
            evaluate(
                [x],
                constants,
                out=sums,
                threads=body.threads,
                add=k > 0,
                data_of_points=body.point_data(k, self.theta),
            )
        means = sums.reshape(len(x), -1, len(FIELD_NAMES)) / self._volumes[:, None]
        return {name: means[:, :, k] for k, name in enumerate(FIELD_NAMES)}


def field_kernel(element: Element, law: PointLaw) -> ElementKernel:
    """Return the compiled function "fields", the values of `FIELD_NAMES` in this order at a
    quadrature point times its undeformed volume; see `ElementKernel` for the inputs.

    Parameters
    ----------
    law : PointLaw
        Law with the energy density at a point, and its constants.
    """
    point = quadrature_point(element, law, "x")
    fields = ca.vertcat(*_point_fields(law, point.scale_constants()))
    evaluated = ca.substitute(
        fields, _DEFORMATION_GRADIENT, ca.vec(point.compute_material_gradient())
    )
    return kernel_from_outputs(
        "fields", point, outputs={"fields": (Derivative(point.compute_volume() * evaluated, ()),)}
    )


_DEFORMATION_GRADIENT = ca.SX.sym("F", 9)


def _point_fields(law: PointLaw, constants: ca.SX) -> tuple[ca.SX, ...]:
    """Return det F, the energy density and the von Mises stress as expressions."""
    f = ca.reshape(_DEFORMATION_GRADIENT, 3, 3)
    j = ca.det(f)
    psi = law.psi(f, constants)
    cauchy = ca.reshape(ca.gradient(psi, _DEFORMATION_GRADIENT), 3, 3) @ f.T / j
    deviator = cauchy - ca.trace(cauchy) / 3 * ca.SX.eye(3)
    return j, psi, ca.sqrt(1.5 * ca.sumsqr(deviator))
