"""Friction between the wires and layers of a cable, as forces with internal variables on its elements.

The moment of friction f of bending (about both directors together) and of torsion (by itself) follows
the curvature κ from one evaluation to the next as that of Dahl's law (Dahl 1976), which is exact where
κ changes at a constant rate,

    f_k = e m_c + (f_{k−1} − e m_c) exp(−S |Δκ| / m_c),   e = Δκ / |Δκ|,

with the moment of slip m_c and the stiffness before slip S. It adds to the elastic moment. At the
start there is none.
"""

from __future__ import annotations

from functools import cache

import casadi as ca

from ...fem.laws.constants import FRICTION_MOMENT, STICK
from ...fem.node_force import ForceContext, NodeForce
from .element import COLUMNS, strains_of

# Changes of curvature in a step over that of slip, m_c/S, below which |Δκ| is smoothed, such that a
# cable at rest does not creep.
SMOOTH = 1e-3


def _dahl(
    x: ca.SX, v: ca.SX, before: ca.SX, at: ForceContext, friction_n_m: ca.SX, stick_n_m2: ca.SX
) -> tuple[ca.SX, ca.SX]:
    """Return the force on the gradient of an element, whose length is `at.volume_m3`, and f with κ."""
    curvature = strains_of(ca.reshape(x, 3, COLUMNS))[3:]
    moment = before[:3]
    change = stick_n_m2 / friction_n_m * (curvature - before[3:])
    after = []
    for own in (slice(0, 2), slice(2, 3)):
        size = ca.sqrt(ca.sumsqr(change[own]) + SMOOTH**2)
        growth = friction_n_m * change[own] * -ca.expm1(-size) / size
        after.append(moment[own] * ca.exp(-ca.sumsqr(change[own]) / size) + growth)
    moment = (1 - at.is_start) * ca.vertcat(*after)
    force = -at.volume_m3 * ca.jtimes(curvature, x, moment, True)
    return force, ca.vertcat(moment, curvature)


@cache
def bending_friction() -> NodeForce:
    """Return the friction of bending and torsion of a cable, with the constants `friction_n_m` and
    `stick_n_m2`, as one of the forces of its `Body`; the same object at every call.
    """
    return NodeForce(
        "bending friction",
        _dahl,
        (FRICTION_MOMENT, STICK),
        on="elements",
        internal_variable_count=6,
    )
