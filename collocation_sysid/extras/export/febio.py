"""FEBio: a model file of format 4.0 of the body under gravity, in its grasp and in contact with
obstacles.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ...common.array_types import Index
from ...fem.laws.constants import MOST_TERMS
from .export_target import ExportedFiles, TargetCapabilities, comment_lines, values_as_text
from .identified import IdentifiedBody, IdentifiedRegion
from .obstacle_shapes import FacetedObstacle, faceted_obstacles

MODEL = "body.feb"
# Number of the volumetric energy ½ κ (J − 1)² among those of an uncoupled material.
QUADRATIC_PRESSURE_MODEL = 2
CAPABILITIES = TargetCapabilities(
    {
        "mooney-rivlin": "Mooney-Rivlin",
        **{f"ogden-{terms}": "Ogden" for terms in range(1, MOST_TERMS + 1)},
        "neo-hookean": "neo-Hookean",
        "st-venant-kirchhoff": "St.Venant-Kirchhoff",
        "linear": "isotropic elastic",
    },
    stiffness_damping="γ_r = {gamma_r_s:.4g} s is not exported, since the step is static; in a "
    'dynamic step, a solid mixture with a "Newtonian viscous solid" of mu = γ_r μ and kappa = '
    "γ_r (λ + 2/3 μ) equals kelvin-voigt up to a factor J",
    mass_damping="γ_m = {gamma_m_1_s:.4g} 1/s is not exported; in a dynamic step, a body load "
    '"mass damping" represents it',
    has_viscoelasticity=True,
    point_masses="point masses on nodes are not exported",
    has_quadratic_elements=True,
    is_tested=False,
)


class ElasticLaw(NamedTuple):
    """Elastic law of a region in FEBio.

    Attributes
    ----------
    kind : str
        Type of the material in the file.
    constants : dict of str to float
        Constants by the name of their element.
    is_uncoupled : bool
        Whether the energy is a sum of a part for the shape and one for the volume, which then needs
        the bulk modulus.
    """

    kind: str
    constants: dict[str, float]
    is_uncoupled: bool


def export(body: IdentifiedBody) -> ExportedFiles:
    """Return the model file, one text file, and what FEBio cannot express; nothing is written.

    The model is a static step with growing loads, at the first sample; damping and motion are not
    exported. A material that FEBio does not have becomes a neo-Hookean one, with a sentence on
    that.
    """
    limits = CAPABILITIES.limitations(body)
    materials = "".join(
        _material_xml(k, region, limits=limits) for k, region in enumerate(body.regions, 1)
    )
    xml = '<?xml version="1.0" encoding="UTF-8"?>\n' + comment_lines(
        body, limits, start="<!-- ", end=" -->"
    )
    xml += '<febio_spec version="4.0">\n<Module type="solid"/>\n'
    xml += (
        "<Control><analysis>STATIC</analysis><time_steps>10</time_steps>"
        "<step_size>0.1</step_size></Control>\n"
    )
    obstacles = faceted_obstacles(body)
    for wall in range(len(obstacles)):
        materials += (
            f'<material id="{len(body.regions) + wall + 1}" name="wall_{wall}" type="rigid body">'
            "<density>1</density></material>\n"
        )
    xml += f"<Material>\n{materials}</Material>\n"
    xml += f"{_mesh_xml(body, obstacles)}{_prescribed_displacement_xml(body)}"
    xml += _contact_xml(obstacles)
    # A body load pushes against the vector that it is given.
    against = values_as_text(-body.experiment.gravity_m_s2, ",")
    xml += (
        f'<Loads><body_load type="body force"><force lc="1">{against}</force></body_load></Loads>\n'
        '<LoadData><load_controller id="1" type="loadcurve"><interpolate>LINEAR</interpolate>'
        "<points><pt>0,0</pt><pt>1,1</pt></points></load_controller></LoadData>\n"
        '<Output><plotfile type="febio"><var type="displacement"/></plotfile></Output>\n'
    )
    return ExportedFiles({MODEL: f"{xml}</febio_spec>\n"}, tuple(limits))


def _material_xml(number: int, region: IdentifiedRegion, limits: list[str]) -> str:
    """Return the XML of the material of a region, with its viscoelastic branches."""
    kind, values, uncoupled = _elastic_law(region, limits)
    inner = "".join(f"<{tag}>{value!r}</{tag}>" for tag, value in values.items())
    if uncoupled:
        inner += (
            f"<k>{region.kappa_pa!r}</k><pressure_model>{QUADRATIC_PRESSURE_MODEL}</pressure_model>"
        )
    density = f"<density>{region.density_kg_m3!r}</density>"
    name = f'name="{region.name}"'
    if not region.branches:
        return f'<material id="{number}" {name} type="{kind}">{density}{inner}</material>\n'
    branches = "".join(
        f"<g{i}>{branch.share!r}</g{i}><t{i}>{branch.tau_s!r}</t{i}>"
        for i, branch in enumerate(region.branches, 1)
    )
    if uncoupled:
        limits.append(
            f"{region.name}: the uncoupled viscoelastic material of FEBio relaxes deviatoric "
            "stress only, that of this program also the pressure"
        )
    return (
        f'<material id="{number}" {name} type="{"uncoupled " * uncoupled}viscoelastic">{density}'
        f'{branches}<elastic type="{kind}">{density}{inner}</elastic></material>\n'
    )


def _elastic_law(region: IdentifiedRegion, limits: list[str]) -> ElasticLaw:
    """Return the elastic law of a region in FEBio. One that FEBio does not have becomes the
    neo-Hookean law of the same E and ν at small strain.

    For the linear material a sentence on the difference is appended to `limits`, in place; the
    sentence on a material that FEBio does not have is one of `TargetCapabilities.limitations`.
    """
    c = region.constants
    if region.material == "mooney-rivlin":
        return ElasticLaw(
            CAPABILITIES.materials[region.material],
            {"c1": c["c10_pa"], "c2": c["c01_pa"]},
            is_uncoupled=True,
        )
    if region.material in CAPABILITIES.materials and region.list_power_terms():
        # The energy of a term is c/m² (Σ λ̄^m − 3).
        values = {}
        for number, term in enumerate(region.list_power_terms(), start=1):
            values |= {f"c{number}": term.mu_pa * term.alpha, f"m{number}": term.alpha}
        return ElasticLaw(CAPABILITIES.materials[region.material], values, is_uncoupled=True)
    moduli = {"E": region.young_pa, "v": region.poisson}
    if region.material == "linear":
        limits.append(
            f"{region.name}: the linear material of FEBio rotates with the body, that "
            "of this program does not"
        )
    return ElasticLaw(
        CAPABILITIES.materials.get(region.material, "neo-Hookean"), moduli, is_uncoupled=False
    )


def _mesh_xml(body: IdentifiedBody, obstacles: Sequence[FacetedObstacle]) -> str:
    """Return the XML of nodes, elements, node sets of prescribed axes, domains and prescribed
    displacements, also of obstacles; indices in the file count from 1.
    """
    solids, facets = _obstacle_mesh_xml(body, obstacles)
    xml = '<Mesh>\n<Nodes name="nodes">\n'
    for k, point in enumerate(body.nodes_m, 1):
        xml += f'<node id="{k}">{values_as_text(point, ",")}</node>\n'
    xml += f"</Nodes>\n{solids}"
    for region in body.regions:
        kind = "tet10" if body.is_quadratic else "tet4"
        xml += f'<Elements type="{kind}" name="cells_{region.name}">\n'
        for cell, nodes in zip(region.cells, body.body.cells[region.cells] + 1, strict=True):
            xml += f'<elem id="{cell + 1}">{",".join(map(str, nodes))}</elem>\n'
        xml += "</Elements>\n"
    for axis, is_prescribed in zip("xyz", body.is_prescribed.T, strict=True):
        if is_prescribed.any():
            nodes = ",".join(map(str, np.flatnonzero(is_prescribed) + 1))
            xml += f'<NodeSet name="held_{axis}">{nodes}</NodeSet>\n'
    xml += facets
    domains = "".join(
        f'<SolidDomain name="cells_{name}" mat="{name}"/>\n'
        for name in [r.name for r in body.regions] + [f"wall_{k}" for k in range(len(obstacles))]
    )
    maps = ""
    for axis, is_prescribed, displacement in zip(
        "xyz", body.is_prescribed.T, body.prescribed_displacements_m.T, strict=True
    ):
        if displacement.any():
            rows = "".join(
                f'<node lid="{i}">{float(v)!r}</node>'
                for i, v in enumerate(displacement[is_prescribed], 1)
            )
            maps += f'<NodeData name="moved_{axis}" node_set="held_{axis}">{rows}</NodeData>\n'
    data = f"<MeshData>\n{maps}</MeshData>\n" if maps else ""
    return f"{xml}</Mesh>\n<MeshDomains>\n{domains}</MeshDomains>\n{data}"


def _prescribed_displacement_xml(body: IdentifiedBody) -> str:
    """Return the XML of the prescribed displacements along each axis that has any, which grow with
    the load curve: zero, or the displacement to where a second grasp holds the nodes. It refers to
    node sets and data of `_mesh_xml`.
    """
    conditions = ""
    for axis, is_prescribed, displacement in zip(
        "xyz", body.is_prescribed.T, body.prescribed_displacements_m.T, strict=True
    ):
        where = f'name="hold_{axis}" node_set="held_{axis}"'
        if displacement.any():
            conditions += (
                f'<bc {where} type="prescribed displacement"><dof>{axis}</dof>'
                f'<value lc="1" type="map">moved_{axis}</value></bc>\n'
            )
        elif is_prescribed.any():
            conditions += f'<bc {where} type="zero displacement"><{axis}_dof>1</{axis}_dof></bc>\n'
    return f"<Boundary>\n{conditions}</Boundary>\n"


def _obstacle_mesh_xml(
    body: IdentifiedBody, obstacles: Sequence[FacetedObstacle]
) -> tuple[str, str]:
    """Return the XML of the obstacles' nodes and elements, and that of the contact surfaces of body
    and obstacles; two empty texts without obstacles.

    Each obstacle has a tetrahedron under each facet.
    """
    solids = ""
    facets = ""
    corners = body.body.mesh.surface
    for k, wall in enumerate(obstacles):
        nodes = "".join(
            f'<node id="{i}">{values_as_text(point, ",")}</node>\n'
            for i, point in enumerate(wall.start_points_m, wall.first_node + 1)
        )
        cells = _numbered_elements("elem", wall.build_tetrahedra() + 1, offset=wall.first_cell)
        solids += f'<Nodes name="nodes_wall_{k}">\n{nodes}</Nodes>\n'
        solids += f'<Elements type="tet4" name="cells_wall_{k}">\n{cells}</Elements>\n'
        touching = body.body.nodes.nodes_of_faces(corners[wall.faces]) + 1
        for name, sides in (("body", touching), ("wall", wall.build_triangles() + 1)):
            rows = _numbered_elements(f"tri{sides.shape[1]}", sides)
            facets += f'<Surface name="{name}_side_{k}">\n{rows}</Surface>\n'
        facets += (
            f'<SurfacePair name="pair_{k}"><primary>body_side_{k}</primary>'
            f"<secondary>wall_side_{k}</secondary></SurfacePair>\n"
        )
    return solids, facets


def _numbered_elements(tag: str, rows: Index, offset: int = 0) -> str:
    """Return XML elements called `tag`, one line for each row, with the numbers of the row (k, m)
    as text, separated by commas; their attribute "id" counts from `offset` + 1.
    """
    return "".join(
        f'<{tag} id="{k}">{",".join(map(str, row))}</{tag}>\n'
        for k, row in enumerate(rows.tolist(), offset + 1)
    )


def _contact_xml(obstacles: Sequence[FacetedObstacle]) -> str:
    """Return the XML of the obstacles' motion and contact; "" without obstacles.

    An obstacle begins where it does not touch the body and moves to its place. Its pressure is
    proportional to the penetration.
    """
    driven = ""
    contacts = ""
    for k, wall in enumerate(obstacles):
        fixed = "".join(f"<{dof}_dof>1</{dof}_dof>" for dof in ("Ru", "Rv", "Rw"))
        driven += f'<rigid_bc type="rigid_fixed"><rb>wall_{k}</rb>{fixed}</rigid_bc>\n'
        for axis, way in zip("xyz", -wall.retraction_m, strict=True):
            driven += (
                f'<rigid_bc type="rigid_displacement"><rb>wall_{k}</rb><dof>{axis}</dof>'
                f'<value lc="1">{float(way)!r}</value><relative>0</relative></rigid_bc>\n'
            )
        contacts += (
            f'<contact type="sliding-elastic" name="touch_{k}" surface_pair="pair_{k}">'
            f"<laugon>PENALTY</laugon><penalty>{wall.stiffness_pa_m!r}</penalty>"
            "<auto_penalty>0</auto_penalty><symmetric_stiffness>0</symmetric_stiffness>"
            f"<fric_coeff>{float(wall.obstacle.friction)!r}</fric_coeff></contact>\n"
        )
    return f"<Rigid>\n{driven}</Rigid>\n<Contact>\n{contacts}</Contact>\n" if obstacles else ""
