"""Constants for every material, all of one small-strain stiffness."""

from __future__ import annotations

import numpy as np

from collocation_sysid.fem.body import Body

LAME = (200.0, 300.0)
ELASTIC = {"lambda_pa": LAME[0], "mu_pa": LAME[1]}
KAPPA_PA = LAME[0] + 2 / 3 * LAME[1]
CONSTANTS = {
    "mooney-rivlin": {"c10_pa": 110.0, "c01_pa": 40.0, "kappa_pa": KAPPA_PA},
    "yeoh": {"c10_pa": 150.0, "c20_pa": 40.0, "c30_pa": -5.0, "kappa_pa": KAPPA_PA},
    "gent": {"mu_pa": 300.0, "gent_limit": 8.0, "kappa_pa": KAPPA_PA},
    "arruda-boyce": {"mu_pa": 300.0, "chain_stretch": 1.6, "kappa_pa": KAPPA_PA},
}


def elastic(body: Body) -> dict[str, float]:
    """Constants of the material of a body of one region."""
    return CONSTANTS.get(body.parts[0].material.name, ELASTIC)


def theta_for(body: Body, gamma_r_s: float = 0.009, gamma_m_1_s: float = 1.0) -> np.ndarray:
    """All constants of it."""
    return np.array([*elastic(body).values(), gamma_r_s, gamma_m_1_s])
