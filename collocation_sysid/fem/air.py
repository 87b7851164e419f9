"""Forces of the air around a body: buoyancy, added mass and drag.

Air of density ρ_a at rest exerts three forces on a body of volume V:

- buoyancy −ρ_a V g, exactly;
- the inertia of the air that moves with the body, c_m ρ_a V a, where c_m is ½ for a sphere;
- drag −½ ρ_a c_d A |v| v on each surface element, where A is the area that faces the motion. For a
  convex body A is a quarter of its surface on average over directions (Cauchy).

V is the volume of the undeformed body, lumped at its nodes like the mass. The coefficients c_m and
c_d depend on shape and motion; they are accurate to some 40 %, see
`statistics.budget.systematic_effects`. This module provides the constants and the drag force;
`model.weight` applies buoyancy and added mass.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np

from ..common.array_types import Array
from .meshes.mesh import ElementNodes
from .node_force import ForceContext, LocatedForce, NodeForce, surface_shares

# Air at 20 °C and sea level, half humid [kg/m³].
AIR_KG_M3 = 1.2
# Share of the displaced air that moves with a body: that of a sphere in an ideal fluid.
ADDED_MASS_SHARE = 0.5
# Drag coefficient c_d of a bluff body at Reynolds numbers of 10³ to 10⁵.
DRAG_COEFFICIENT = 1.0
# Share of the surface of a convex body that faces a direction, on average over directions.
FACING_SHARE = 0.25
# Below this speed [m/s] drag becomes linear in the velocity, so that it is smooth at rest. There it
# is less than 1e-8 of the weight of a foam cube of 0.1 m.
SMOOTH_BELOW_M_S = 1e-4


@cache
def unit_drag() -> NodeForce:
    """Return the drag on surface nodes in a fluid at rest of density 1 kg/m³, the same object at
    every call.

    The force on a node with the share A of the surface [m²] is −½ c_d ¼ A √(|v|² + v₀²) v, with v₀
    =
    `SMOOTH_BELOW_M_S`; the caller multiplies it by the density.
    """

    def air_drag(x: ca.SX, v: ca.SX, at: ForceContext) -> ca.SX:
        """Return the drag (3,) on a node, in a fluid of density 1 kg/m³."""
        speed = ca.sqrt(ca.sumsqr(v) + SMOOTH_BELOW_M_S**2)
        return -0.5 * DRAG_COEFFICIENT * FACING_SHARE * at.area_m2 * speed * v

    return replace(NodeForce.from_law(air_drag, name="air drag"), is_compiled=True)


def placed_unit_drag(nodes: ElementNodes, volume_m3: Array) -> LocatedForce:
    """Return `unit_drag` on the nodes of a body that have a share of its surface; it has no
    constants.

    Parameters
    ----------
    nodes : ElementNodes
        Nodes of the elements, without those of obstacle frames.
    volume_m3 : (n,)
        Lumped volume of every node of the body [m³], including nodes of obstacle frames.
    """
    on_surface = np.flatnonzero(surface_shares(nodes)[0] > 0)
    no_constants = np.zeros(0, dtype=np.int64)
    return LocatedForce.on_mesh(
        unit_drag(), nodes, chosen=on_surface, volume_m3=volume_m3, columns=no_constants
    )
