"""Stability of materials at given strains, by Drucker's criterion.

A material is stable if a further strain does positive work on the change of stress that it causes.
For an isotropic material this is the positive definiteness of the Hessian of the energy density ψ
by the logarithms of the principal stretches, ∂²ψ/∂εᵢ∂εⱼ, whose gradient is the Kirchhoff stress.
A law identified from small strains may violate it at larger ones, and then predicts a collapse that
the object does not have.
"""

from __future__ import annotations

from functools import lru_cache

import casadi as ca
import numpy as np

from ...common.array_types import Array
from ..body import Body
from .materials import MATERIALS, Material

# Linear elasticity depends on the rotation of the body; energies of users may be anisotropic.
EXAMINED = tuple(material for name, material in MATERIALS.items() if name != "linear")


def is_examined(material: Material) -> bool:
    """Return whether the criterion applies to a material: the built-in ones except linear
    elasticity. Energies of users could be anisotropic. Of a material with fibres the matrix alone
    is examined.
    """
    return material.matrix in EXAMINED


def stability_margins(material: Material, constants: Array, stretches: Array) -> Array:
    """Return the smallest eigenvalue of ∂²ψ/∂ε∂ε [Pa] at principal stretches; negative if unstable.

    Parameters
    ----------
    material : Material
        Isotropic material, see `is_examined`, or one with fibres.
    constants : (c,)
        Constants of the material; those of fibres are not used.
    stretches : (n, 3)
        Principal stretches.

    Returns
    -------
    (n,) array
        NaN where the energy is not defined, such as beyond the limit of Gent's material.
    """
    if not len(stretches):
        return np.zeros(0)
    matrix = material.matrix
    hessian = _log_strain_hessian(matrix).map(len(stretches))
    own = np.asarray(constants)[: len(matrix.constants)]
    values = np.repeat(own[:, None], len(stretches), axis=1)
    entries = hessian(np.log(stretches).T, values).full()
    matrices = entries.T.reshape(-1, 3, 3)
    margins = np.full(len(stretches), np.nan)
    finite = np.isfinite(matrices).all(axis=(1, 2))
    margins[finite] = np.linalg.eigvalsh(matrices[finite])[:, 0]
    return margins


def principal_stretches(body: Body, positions: Array, theta: Array) -> Array:
    """Return the principal stretches at which the material is evaluated (T, E, q, 3), ascending.

    They are relative to the stress-free shape, with the averaged dilatation of elements that
    average it. Stretches are square roots of the eigenvalues of FᵀF, so that they do not show an
    inversion, except with averaged dilatation: there they are negative if det F has another sign
    than its mean.

    Parameters
    ----------
    positions : (T, 3n)
        Node positions [m].
    theta : (k,)
        Constants of the body.

    Raises
    ------
    RestShapeError
        If there is no stress-free shape at θ.
    """
    geometry = body.stress_free_geometry(theta)
    cells, points = geometry.shape[:2]
    gradients = geometry[..., :-1].reshape(cells, points, body.element.nodes, 3)
    nodes = positions.reshape(len(positions), -1, 3)[:, body.cells]
    F = np.einsum("teai,eqaj->teqij", nodes, gradients, optimize=True)
    squares = np.linalg.eigvalsh(np.swapaxes(F, -1, -2) @ F)
    stretches = np.sqrt(np.maximum(squares, 0.0))
    if body.element.mean_dilatation:
        ratios = np.linalg.det(F)
        volumes = geometry[..., -1]
        means = (ratios * volumes).sum(axis=-1) / volumes.sum(axis=-1)
        stretches *= np.cbrt(means[..., None] / ratios)[..., None]
    return stretches


@lru_cache(32)
def _log_strain_hessian(material: Material) -> ca.Function:
    """Return the function from (ε, constants) to ∂²ψ/∂ε∂ε (9,)."""
    strain = ca.SX.sym("strain", 3)
    values = ca.SX.sym("values", len(material.constants))
    psi = material.psi(ca.diag(ca.exp(strain)), values)
    hessian, _ = ca.hessian(psi, strain)
    return ca.Function("hessian", [strain, values], [ca.densify(ca.vec(hessian))], {"cse": True})
