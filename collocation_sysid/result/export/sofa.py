"""SOFA: a scene of the body in its grasp, with implicit Euler integration and Rayleigh damping."""

from __future__ import annotations

import numpy as np

from ...errors import InputError
from .export_target import Exported, Holds, heading, numbers
from .identified import Identified, IdentifiedRegion
from .obstacle_shapes import Primitive, grown, walls

SCENE = "body.scn"
PLUGINS = (
    "Constraint.Projective",
    "LinearSolver.Direct",
    "Mass",
    "MechanicalLoad",
    "ODESolver.Backward",
    "SolidMechanics.FEM.Elastic",
    "SolidMechanics.FEM.HyperElastic",
    "StateContainer",
    "Topology.Container.Dynamic",
)
VERSIONS = (
    "NeoHookean is that of λ and μ (½ λ ln² J − μ ln J + ½ μ (I₁ − 3)) in the versions of SOFA "
    "that have StableNeoHookean too; older ones take other constants"
)
HOLDS = Holds(
    {
        "neo-hookean": "NeoHookean",
        "stable-neo-hookean": "StableNeoHookean",
        "st-venant-kirchhoff": "StVenantKirchhoff",
        "linear": "linear",
    },
    stiffness_damping="the damping is Rayleigh's, here {damping}: the same at small strain, but it "
    "brakes that a stretched body turns",
    mass_damping="",
    damping="rayleigh",
    shapes=("plane", "sphere"),
    faces=False,
    friction=False,
    tried=False,
)


def export(body: Identified) -> Exported:
    """Return the scene.

    Raises
    ------
    InputError
        For quadratic elements, several regions, or grasps of single axes.
    """
    if body.quadratic or len(body.regions) != 1:
        raise InputError(
            f"the body has {len(body.regions)} region(s) of {body.body.element.name}; the scene "
            "for SOFA takes one of linear tetrahedra: export to calculix, febio or json"
        )
    if (body.held.any(axis=1) != body.grasped).any():
        raise InputError("a grasp holds single axes, which the scene for SOFA does not take")
    region = body.regions[0]
    limits = [*HOLDS.lost(body), VERSIONS]
    force = _law(region)
    if (np.abs(body.moved_m) > 1e-9).any():
        limits.append("grasps beside the first hold the body undeformed, not where they hold it")
    mass = numbers(body.mass_kg)
    grasped = " ".join(map(str, np.flatnonzero(body.grasped)))
    cells = " ".join(map(str, body.body.cells.ravel()))
    x = '<?xml version="1.0"?>\n' + heading(body, limits, "<!-- ", " -->")
    x += f'<Node name="root" dt="{body.experiment.timestep_s / 4!r}" '
    x += f'gravity="{numbers(body.experiment.gravity_m_s2)}">\n'
    x += "".join(f'<RequiredPlugin name="Sofa.Component.{name}"/>\n' for name in PLUGINS)
    x += '<DefaultAnimationLoop/>\n<Node name="body">\n'
    x += f'<EulerImplicitSolver rayleighStiffness="{region.gamma_r_s!r}" '
    x += f'rayleighMass="{region.gamma_m_1_s!r}"/>\n'
    x += '<SparseLDLSolver template="CompressedRowSparseMatrixMat3x3d"/>\n'
    x += f'<TetrahedronSetTopologyContainer position="{numbers(body.nodes_m)}" '
    x += f'tetrahedra="{cells}"/>\n<TetrahedronSetGeometryAlgorithms template="Vec3d"/>\n'
    x += '<MechanicalObject template="Vec3d"/>\n'
    x += f'<DiagonalMass vertexMass="{mass}"/>\n{force}\n{_obstacles(body)}'
    x += f'<FixedProjectiveConstraint indices="{grasped}"/>\n</Node>\n</Node>\n'
    return Exported({SCENE: x}, tuple(limits))


def _obstacles(body: Identified) -> str:
    """Return the XML of contact penalties on the nodes, proportional to the penetration.

    The surface of the obstacle is moved outwards by half the width δ of the pressure law, so that
    the
    force is about the same at a given gap.
    """
    lines = ""
    for wall in walls(body):
        shape = Primitive.of(grown(wall.obstacle.shape, wall.width_m / 2))
        place_m, turn = shape.placed(wall.obstacle, body.start_s)
        stiff = f'stiffness="{wall.node_n_m!r}" damping="0"'
        if shape.kind == "plane":
            normal = turn.as_matrix()[:, 2]
            level = float(normal @ place_m)
            lines += f'<PlaneForceField normal="{numbers(normal)}" d="{level!r}" {stiff}/>\n'
        elif shape.kind == "sphere":
            ball = f'center="{numbers(place_m)}" radius="{float(shape.size_m[0])!r}"'
            lines += f"<SphereForceField {ball} {stiff}/>\n"
    return lines


def _law(region: IdentifiedRegion) -> str:
    """Return the XML of the elastic material."""
    if region.material == "linear":
        return (
            '<TetrahedronFEMForceField method="small" '
            f'youngModulus="{region.young_pa!r}" poissonRatio="{region.poisson!r}"/>'
        )
    name = HOLDS.materials.get(region.material, "NeoHookean")
    moduli = numbers((region.mu_pa, region.lambda_pa))
    return (
        f'<TetrahedronHyperelasticityFEMForceField materialName="{name}" ParameterSet="{moduli}"/>'
    )
