"""SOFA: a scene of the body in its grasp, with implicit Euler integration and Rayleigh damping."""

from __future__ import annotations

import numpy as np

from ...errors import InputError
from .export_target import ExportedFiles, TargetCapabilities, comment_lines, values_as_text
from .identified import IdentifiedBody, IdentifiedRegion
from .obstacle_shapes import Primitive, faceted_obstacles, offset_solid

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
NEO_HOOKEAN_VERSIONS = (
    "NeoHookean has the constants λ and μ (½ λ ln² J − μ ln J + ½ μ (I₁ − 3)) in versions of "
    "SOFA that also have StableNeoHookean; older versions use other constants"
)
OGDEN_VOLUME = (
    "the energy of the volume of Ogden is ½ κ ln² J, ours ½ κ (J − 1)²: the same at small changes "
    "of volume"
)
CAPABILITIES = TargetCapabilities(
    {
        "neo-hookean": "NeoHookean",
        "stable-neo-hookean": "StableNeoHookean",
        "st-venant-kirchhoff": "StVenantKirchhoff",
        "ogden-1": "Ogden",
        "linear": "linear",
    },
    stiffness_damping="SOFA uses Rayleigh damping instead of {damping}: both agree at small "
    "strain, but Rayleigh damping also damps the rotation of a stretched body",
    mass_damping="",
    damping_law="rayleigh",
    obstacle_shapes=("plane", "sphere"),
    has_face_selection=False,
    has_friction=False,
    is_tested=False,
)


def export(body: IdentifiedBody) -> ExportedFiles:
    """Return the scene as one text file, and what SOFA cannot express; obstacles and grasps are
    fixed at their positions of the first sample.

    Raises
    ------
    InputError
        For quadratic elements, several regions, or grasps of single axes.
    """
    if body.is_quadratic or len(body.regions) != 1:
        raise InputError(
            f"the body has {len(body.regions)} region(s) of {body.body.element.name}; the scene "
            "for SOFA supports one region of linear tetrahedra: export to calculix, febio or json"
        )
    if (body.is_prescribed.any(axis=1) != body.is_node_prescribed).any():
        raise InputError(
            "a grasp holds single axes, which the scene for SOFA does not support: export to "
            "calculix or json"
        )
    region = body.regions[0]
    limits = [*CAPABILITIES.limitations(body)]
    limits.append(OGDEN_VOLUME if region.material == "ogden-1" else NEO_HOOKEAN_VERSIONS)
    force = _elastic_law_xml(region)
    if (np.abs(body.prescribed_displacements_m) > 1e-9).any():
        limits.append(
            "all grasps but the first hold the nodes at their undeformed positions, "
            "not at those of the recording"
        )
    mass = values_as_text(body.total_node_mass_kg)
    grasped = " ".join(map(str, np.flatnonzero(body.is_node_prescribed)))
    cells = " ".join(map(str, body.body.cells.ravel()))
    x = '<?xml version="1.0"?>\n' + comment_lines(body, limits, start="<!-- ", end=" -->")
    x += f'<Node name="root" dt="{body.experiment.timestep_s / 4!r}" '
    x += f'gravity="{values_as_text(body.experiment.gravity_m_s2)}">\n'
    x += "".join(f'<RequiredPlugin name="Sofa.Component.{name}"/>\n' for name in PLUGINS)
    x += '<DefaultAnimationLoop/>\n<Node name="body">\n'
    x += f'<EulerImplicitSolver rayleighStiffness="{region.gamma_r_s!r}" '
    x += f'rayleighMass="{region.gamma_m_1_s!r}"/>\n'
    x += '<SparseLDLSolver template="CompressedRowSparseMatrixMat3x3d"/>\n'
    x += f'<TetrahedronSetTopologyContainer position="{values_as_text(body.nodes_m)}" '
    x += f'tetrahedra="{cells}"/>\n<TetrahedronSetGeometryAlgorithms template="Vec3d"/>\n'
    x += '<MechanicalObject template="Vec3d"/>\n'
    x += f'<DiagonalMass vertexMass="{mass}"/>\n{force}\n{_obstacle_xml(body)}'
    x += f'<FixedProjectiveConstraint indices="{grasped}"/>\n</Node>\n</Node>\n'
    return ExportedFiles({SCENE: x}, tuple(limits))


def _obstacle_xml(body: IdentifiedBody) -> str:
    """Return the XML of the forces of obstacles on the nodes, proportional to the penetration;
    empty without obstacles. Shapes other than planes and spheres are left out.

    Obstacles stay at their poses at the start of the recording. The surface of the obstacle is
    moved outwards by half the width δ of the pressure law, so that the force is about the same at a
    given gap.
    """
    lines = ""
    for wall in faceted_obstacles(body):
        shape = Primitive.from_solid(offset_solid(wall.obstacle.shape, wall.width_m / 2))
        place_m, turn = shape.pose_at(wall.obstacle, body.start_s)
        stiff = f'stiffness="{wall.node_stiffness_n_m!r}" damping="0"'
        if shape.kind == "plane":
            normal = turn.as_matrix()[:, 2]
            level = float(normal @ place_m)
            lines += f'<PlaneForceField normal="{values_as_text(normal)}" d="{level!r}" {stiff}/>\n'
        elif shape.kind == "sphere":
            ball = f'center="{values_as_text(place_m)}" radius="{float(shape.size_m[0])!r}"'
            lines += f"<SphereForceField {ball} {stiff}/>\n"
    return lines


def _elastic_law_xml(region: IdentifiedRegion) -> str:
    """Return the XML of the elastic material of a region; one that SOFA does not have becomes the
    neo-Hookean material of the same λ and μ, without a remark here.
    """
    if region.material == "linear":
        return (
            '<TetrahedronFEMForceField method="small" '
            f'youngModulus="{region.young_pa!r}" poissonRatio="{region.poisson!r}"/>'
        )
    name = CAPABILITIES.materials.get(region.material, "NeoHookean")
    moduli = values_as_text((region.mu_pa, region.lambda_pa))
    if region.material == "ogden-1":
        (term,) = region.list_power_terms()
        # The energy is μ/α² (Σ λ̄^α − 3) + ½ κ ln² J.
        moduli = values_as_text((term.mu_pa * term.alpha, term.alpha, region.kappa_pa))
    return (
        f'<TetrahedronHyperelasticityFEMForceField materialName="{name}" ParameterSet="{moduli}"/>'
    )
