"""Invariants of the deformation gradient."""

from __future__ import annotations

import casadi as ca


def isochoric_invariants(F: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Return Ī₁ = J^(−2/3) I₁ and Ī₂ = J^(−4/3) I₂ of a deformation gradient (3, 3), J > 0; NaN
    otherwise.
    """
    C = F.T @ F
    first = ca.trace(C)
    second = 0.5 * (first**2 - ca.sumsqr(C))
    shrink = ca.exp(ca.log(ca.det(F)) * (-2.0 / 3.0))
    return shrink * first, shrink**2 * second


def reduced_invariants(F: ca.SX) -> ca.SX:
    """Return Ī₁ − 3, Ī₂ − 3 and J of a deformation gradient (3, 3), stacked (3,)."""
    first, second = isochoric_invariants(F)
    return ca.vertcat(first - 3, second - 3, ca.det(F))
