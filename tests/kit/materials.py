"""Constants for every material, all of one small-strain stiffness."""

from __future__ import annotations

import numpy as np

from collocation_sysid.fem.body import Body
from collocation_sysid.fem.laws.materials import MATERIALS

LAME = (200.0, 300.0)
ELASTIC = {"lambda_pa": LAME[0], "mu_pa": LAME[1]}
KAPPA_PA = LAME[0] + 2 / 3 * LAME[1]
CONSTANTS = {
    "mooney-rivlin": {"c10_pa": 110.0, "c01_pa": 40.0, "kappa_pa": KAPPA_PA},
    "yeoh": {"c10_pa": 150.0, "c20_pa": 40.0, "c30_pa": -5.0, "kappa_pa": KAPPA_PA},
    "gent": {"mu_pa": 300.0, "gent_limit": 8.0, "kappa_pa": KAPPA_PA},
    "arruda-boyce": {"mu_pa": 300.0, "chain_stretch": 1.6, "kappa_pa": KAPPA_PA},
}
# Laws with the volumetric term ½ κ (J − 1)² and a part in isochoric invariants.
ISOCHORIC = tuple(CONSTANTS)
# Terms (μ, α) of Ogden's law and (μ, α, β) of the foam.
OGDEN = {
    1: ((200.0, 3.0),),
    2: ((160.0, 2.5), (-100.0, -2.0)),
    3: ((300.0, 1.3), (18.0, 5.0), (-60.0, -2.0)),
    4: ((300.0, 1.3), (18.0, 5.0), (-40.0, -2.0), (5.0, 8.0)),
}
HYPERFOAM = {
    1: ((300.0, 4.0, 1 / 3),),
    2: ((200.0, 4.0, 0.2), (100.0, -2.0, 0.6)),
    3: ((150.0, 4.0, 0.2), (100.0, -2.0, 0.5), (50.0, 8.0, 0.4)),
    4: ((150.0, 4.0, 0.2), (100.0, -2.0, 0.5), (25.0, 8.0, 0.4), (25.0, 1.5, 0.4)),
}


def term_constants(terms: tuple[tuple[float, ...], ...]) -> dict[str, float]:
    """Constants by name of terms (μ, α) or (μ, α, β)."""
    kinds = ("mu_{}_pa", "alpha_{}", "beta_{}")
    return {
        kind.format(p): value
        for p, term in enumerate(terms, start=1)
        for kind, value in zip(kinds, term, strict=False)
    }


CONSTANTS |= {
    f"ogden-{count}": {**term_constants(terms), "kappa_pa": KAPPA_PA}
    for count, terms in OGDEN.items()
}
CONSTANTS |= {f"hyperfoam-{count}": term_constants(terms) for count, terms in HYPERFOAM.items()}
# Materials of which kernels are compiled: of the laws of several terms one or two terms each.
COMPILED = [
    name for name in MATERIALS if name[-1] not in "1234" or name in ("ogden-2", "hyperfoam-1")
]


def rounding(material: object) -> float:
    """Relative error of stiffness: rounding, or of sums over nodes in powers of the stretches."""
    return 1e-10 if str(material).startswith(("ogden", "hyperfoam")) else 1e-12


def elastic(body: Body) -> dict[str, float]:
    """Constants of the material of a body of one region."""
    return CONSTANTS.get(body.parts[0].material.name, ELASTIC)


def theta_for(body: Body, gamma_r_s: float = 0.009, gamma_m_1_s: float = 1.0) -> np.ndarray:
    """All constants of it."""
    return np.array([*elastic(body).values(), gamma_r_s, gamma_m_1_s])
