"""Refusal of user-defined damping laws that cannot be evaluated or are not linear in the rate."""

from __future__ import annotations

from functools import lru_cache

import casadi as ca
import numpy as np

from ...common.files import reason
from ...errors import InputError
from .constants import DENSITY, GAMMA_M, MASS
from .materials import DampingLaw, Material, damped_psi
from .moduli import elastic_names

# Largest relative difference of two stresses that counts as rounding of some thousand operations.
ROUNDING = 1e-9
# Size of the random strains, at which usual materials are far from their limits.
STRAIN = 0.05


@lru_cache(64)
def require_admissible_damping(damping: DampingLaw, material: Material) -> None:
    """Check the names of the constants of a damping law, that it can be evaluated, and that it is
    linear in the rate Ḟ.

    Linearity is checked at one random deformation, with the
    usual values of the constants, or 1, within their bounds. If the stress is not finite there,
    linearity is not checked.

    Raises
    ------
    InputError
        If a constant has the name of another one, the law cannot be evaluated, its result has the
        wrong shape, or P_v is not linear in Ḟ.
    """
    _require_own_names(damping, material)
    F = ca.SX.sym("F", 9)
    rate = ca.SX.sym("rate", 9)
    constants = [*material.constants, *damping.constants]
    theta = ca.SX.sym("theta", len(constants))
    stress = viscous_stress(damping, material, F=F, rate=rate, theta=theta)
    function = ca.Function("stress", [rate, F, theta], [ca.densify(ca.vec(stress))])
    rng = np.random.default_rng(0)
    deformation = np.eye(3).ravel() + STRAIN * rng.uniform(-1, 1, 9)
    values = [constant.plausible for constant in constants]
    # Large rates [1/s], so that terms of higher order show.
    first, second = 100.0 * rng.uniform(-1, 1, (2, 9))
    stresses = [
        function(each, deformation, values).full().ravel()
        for each in (first, second, first + second)
    ]
    size = np.abs(stresses).max()
    difference = np.abs(stresses[0] + stresses[1] - stresses[2]).max()
    if np.isfinite(size) and difference > ROUNDING * size:
        raise InputError(
            f"the damping law {damping.name!r} is not linear in the rate: the stress P_v of a sum "
            f"of two rates Ḟ differs from the sum of their stresses by {difference / size:.2g} of "
            "its size; expected P_v linear in Ḟ with factors that depend on F and constants alone"
        )


def _require_own_names(damping: DampingLaw, material: Material) -> None:
    taken = {
        *(constant.name for constant in material.constants),
        *elastic_names(material),
        *(constant.name for constant in (GAMMA_M, DENSITY, MASS)),
    }
    for constant in damping.constants:
        if constant.name in taken:
            raise InputError(
                f"the damping law {damping.name!r} has the constant {constant.name!r}, but another "
                "constant of the body has the same name; expected another name"
            )
        taken.add(constant.name)


def viscous_stress(
    damping: DampingLaw, material: Material, F: ca.SX, rate: ca.SX, theta: ca.SX
) -> ca.SX:
    """Return the viscous stress P_v (9,) of a law from its stress, its potential, or both.

    Parameters
    ----------
    F, rate : (9,) SX
        Symbols of the deformation gradient and its rate, stacked column after column.
    theta : (k,) SX
        Constants of the material, then of the law.

    Raises
    ------
    InputError
        If a function of the law raises an error or its result has the wrong shape.
    """
    count = len(material.constants)
    psi = damped_psi(damping, material, ca.reshape(F, 3, 3), theta)
    values = {constant.name: theta[count + k] for k, constant in enumerate(damping.constants)}
    stress = ca.SX(9, 1)
    if damping.potential is not None:
        try:
            density = ca.SX(damping.potential(psi, F, rate, **values))
        except Exception as error:
            raise InputError(_failure(damping, "potential", error=error)) from error
        if density.shape != (1, 1):
            raise InputError(
                f"the potential of the damping law {damping.name!r} returns an expression of the shape "
                f"{density.shape}; expected one number, (1, 1)"
            )
        stress += ca.gradient(density, F)
    if damping.stress is not None:
        try:
            result = damping.stress(psi, F, rate, **values)
        except Exception as error:
            raise InputError(_failure(damping, "stress", error=error)) from error
        results = result if isinstance(result, tuple | list) else [result]
        shapes = [getattr(each, "shape", type(each)) for each in results]
        if shapes != [(9, 1), (9, 9)]:
            raise InputError(
                f"the stress of the damping law {damping.name!r} returns "
                f"{len(shapes)} expressions of the shapes {shapes}; expected two: P_v (9, 1), as by "
                "ca.vec(P), and ∂P_v/∂F (9, 9), as by ca.jacobian(P_v, F)"
            )
        stress += result[0]
    return stress


def _failure(damping: DampingLaw, kind: str, error: Exception) -> str:
    arguments = ["psi", "F", "rate", *(c.name for c in damping.constants)]
    return (
        f"the {kind} of the damping law {damping.name!r} cannot be evaluated ({reason(error)}); "
        f"expected a function ({', '.join(arguments)}) in CasADi operations"
    )
