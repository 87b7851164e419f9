"""Hyperelastic materials: one strain-energy density each, in CasADi SX.

A material is a function ``energy(F, lambda_pa, mu_pa) -> ψ`` [J/m³] of the 3 × 3 deformation
gradient. Every one here has ψ(I) = 0, no stress at F = I, and the small-strain stiffness of
linear elasticity with the same Lamé parameters, so λ and μ mean the same in all of them.
To add one, write the function and enter it in `MATERIALS`, or pass it to `Body` directly.
"""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca

from ..errors import InputError

Energy = Callable[[ca.SX, ca.SX, ca.SX], ca.SX]


def neo_hookean(F: ca.SX, lambda_pa: ca.SX, mu_pa: ca.SX) -> ca.SX:
    """ψ = ½ λ (ln J)² − μ ln J + ½ μ (tr C − 3) (Bonet & Wood 2008, eq. 6.27)."""
    log_j = ca.log(ca.det(F))
    return 0.5 * lambda_pa * log_j**2 - mu_pa * log_j + 0.5 * mu_pa * (ca.sumsqr(F) - 3)


def stable_neo_hookean(F: ca.SX, lambda_pa: ca.SX, mu_pa: ca.SX) -> ca.SX:
    """ψ = ½ μ (tr C − 3) − μ (J − 1) + ½ (λ + μ)(J − 1)², finite also for inverted elements.

    Smith, de Goes & Kim 2018, eq. 13, with λ + μ in place of λ so that the small-strain
    limit is linear elasticity with (λ, μ).
    """
    j = ca.det(F)
    return (
        0.5 * mu_pa * (ca.sumsqr(F) - 3)
        - mu_pa * (j - 1)
        + 0.5 * (lambda_pa + mu_pa) * (j - 1) ** 2
    )


def st_venant_kirchhoff(F: ca.SX, lambda_pa: ca.SX, mu_pa: ca.SX) -> ca.SX:
    """ψ = ½ λ (tr E)² + μ E:E with the Green strain E = ½ (C − I). Softens in compression."""
    strain = 0.5 * (F.T @ F - ca.SX.eye(3))
    return 0.5 * lambda_pa * ca.trace(strain) ** 2 + mu_pa * ca.sumsqr(strain)


def mooney_rivlin(
    F: ca.SX, lambda_pa: ca.SX, mu_pa: ca.SX, second_invariant_share: float = 0.25
) -> ca.SX:
    """ψ = C₁₀ (Ī₁ − 3) + C₀₁ (Ī₂ − 3) + ½ κ (J − 1)², compressible Mooney–Rivlin.

    Isochoric invariants Ī₁ = J^(−2/3) I₁, Ī₂ = J^(−4/3) I₂; C₁₀ + C₀₁ = μ/2, of which C₀₁ has
    `second_invariant_share`; κ = λ + ⅔ μ (Bonet & Wood 2008, sec. 6.5).
    """
    j = ca.det(F)
    C = F.T @ F
    first = ca.trace(C)
    second = 0.5 * (first**2 - ca.sumsqr(C))
    c01 = 0.5 * mu_pa * second_invariant_share
    c10 = 0.5 * mu_pa - c01
    bulk = lambda_pa + 2.0 / 3.0 * mu_pa
    shrink = ca.exp(ca.log(j) * (-2.0 / 3.0))
    return c10 * (shrink * first - 3) + c01 * (shrink**2 * second - 3) + 0.5 * bulk * (j - 1) ** 2


def linear_elastic(F: ca.SX, lambda_pa: ca.SX, mu_pa: ca.SX) -> ca.SX:
    """ψ = ½ λ (tr ε)² + μ ε:ε with ε = sym F − I. Small rotations only: it resists turning."""
    strain = 0.5 * (F + F.T) - ca.SX.eye(3)
    return 0.5 * lambda_pa * ca.trace(strain) ** 2 + mu_pa * ca.sumsqr(strain)


MATERIALS: dict[str, Energy] = {
    "neo-hookean": neo_hookean,
    "stable-neo-hookean": stable_neo_hookean,
    "st-venant-kirchhoff": st_venant_kirchhoff,
    "mooney-rivlin": mooney_rivlin,
    "linear": linear_elastic,
}


def material_named(name: str) -> Energy:
    """Look a material up in `MATERIALS`.

    Raises
    ------
    InputError
        If there is none of that name.
    """
    if name not in MATERIALS:
        raise InputError(f"no material {name!r}; available: {', '.join(MATERIALS)}")
    return MATERIALS[name]
