"""Bodies of several materials and regions, with true values and guesses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import casadi as ca

from collocation_sysid.fem.body import Body
from collocation_sysid.fem.meshes.selection import Box
from collocation_sysid.fem.regions import Region
from collocation_sysid.model.parameters import Parameters, Unknown
from collocation_sysid.recording import Experiment
from kit.problems import bar_in_two_hands

LEFT_HALF = Box((-1, -1, -1), (0.075, 1, 1))


DAMPING = {"gamma_r_s": 0.009, "gamma_m_1_s": 1.0}


def waved_bar(steps: int = 12, **body) -> Experiment:
    """A bar waved by its right end."""
    bar = bar_in_two_hands(steps)
    other = Body(bar.body.mesh, density_kg_m3=30.0, **body)
    return replace(bar, name="waved bar", body=other, grasps=bar.grasps[1:])


def stiffening(F: ca.SX, shear_pa: ca.SX, bulk_pa: ca.SX, stiffening: ca.SX) -> ca.SX:
    """A user's own material of three constants, nearly linear at first."""
    log_j = ca.log(ca.det(F))
    strain = ca.sumsqr(F) * ca.exp(-2 / 3 * log_j) - 3
    shear = 0.5 * shear_pa * strain * (1 + stiffening * strain)
    return shear + 0.5 * bulk_pa * log_j**2


# What is identified: the model, its truth, and what is known of it.
MODELS = {
    "two stiffnesses": (
        {"regions": [Region("stiff", LEFT_HALF)]},
        {"lambda_pa": 200.0, "mu_pa": 300.0, "stiff.mu_pa": 900.0, **DAMPING},
        {"mu_pa": 450.0, "stiff.mu_pa": 600.0, "gamma_r_s": 0.006},
    ),
    "two materials": (
        {"regions": [Region("stiff", LEFT_HALF, material="st-venant-kirchhoff")]},
        {
            "young_pa": 720.0,
            "poisson": 0.2,
            "stiff.young_pa": 2000.0,
            "stiff.poisson": 0.3,
            **DAMPING,
        },
        {"young_pa": 1000.0, "poisson": 0.3, "stiff.young_pa": 1400.0},
    ),
    "three constants": (
        {"material": "yeoh"},
        {"c10_pa": 150.0, "c20_pa": 60.0, "c30_pa": 0.0, "kappa_pa": 400.0, **DAMPING},
        {"c10_pa": 220.0, "c20_pa": 20.0, "kappa_pa": 600.0, "gamma_r_s": 0.006},
    ),
    "an exponent": (
        {"material": "ogden-1"},
        {"mu_1_pa": 150.0, "alpha_1": 4.0, "kappa_pa": 400.0, **DAMPING},
        {"mu_1_pa": 250.0, "alpha_1": 3.0, "gamma_r_s": 0.006},
    ),
    "a foam": (
        {"material": "hyperfoam-1"},
        {"mu_1_pa": 300.0, "alpha_1": 6.0, "beta_1": 0.3, **DAMPING},
        {"mu_1_pa": 400.0, "alpha_1": 3.0, "beta_1": 0.6, "gamma_r_s": 0.006},
    ),
    "a user's own": (
        {"material": stiffening},
        {"shear_pa": 300.0, "bulk_pa": 400.0, "stiffening": 0.3, **DAMPING},
        {"shear_pa": 450.0, "bulk_pa": 600.0, "stiffening": 0.15},
    ),
}


def parameters(truth: Mapping[str, float], guesses: Mapping[str, float]) -> Parameters:
    """Estimated where there is a guess, fixed at the truth elsewhere."""
    stated = {
        name: Unknown(guesses[name]) if name in guesses else value for name, value in truth.items()
    }
    return Parameters.from_mapping(stated)
