"""FEBio: a model file of the 4.0 format, the body loaded by gravity in its grasp."""

from __future__ import annotations

import numpy as np

from .identified import Identified, IdentifiedRegion
from .target import Exported, Holds, heading, numbers

MODEL = "body.feb"
# Number of the volumetric energy ½ κ (J − 1)² among those of an uncoupled material.
SQUARE = 2
HOLDS = Holds(
    {
        "mooney-rivlin": "Mooney-Rivlin",
        "neo-hookean": "neo-Hookean",
        "st-venant-kirchhoff": "St.Venant-Kirchhoff",
        "linear": "isotropic elastic",
    },
    stiffness_damping="γ_r = {gamma_r_s:.4g} s is not exported",
    mass_damping="γ_m = {gamma_m_1_s:.4g} 1/s is not exported; in a dynamic step a body load "
    '"mass damping" is it',
    memory=True,
    forces="",
    quadratic=True,
    tried=False,
)


def export(body: Identified) -> Exported:
    """A static step, over which the weight grows."""
    limits = HOLDS.lost(body)
    materials = "".join(_material(k, region, limits) for k, region in enumerate(body.regions, 1))
    if body.loads_n.any():
        limits.append("point masses and forces on nodes are left out")
    xml = '<?xml version="1.0" encoding="UTF-8"?>\n' + heading(body, limits, "<!-- ", " -->")
    xml += '<febio_spec version="4.0">\n<Module type="solid"/>\n'
    xml += (
        "<Control><analysis>STATIC</analysis><time_steps>10</time_steps>"
        "<step_size>0.1</step_size></Control>\n"
    )
    xml += f"<Material>\n{materials}</Material>\n{_mesh(body)}{_boundary(body)}"
    # A body load pushes against the vector that it is given.
    against = numbers(-body.experiment.gravity_m_s2, ",")
    xml += (
        f'<Loads><body_load type="body force"><force lc="1">{against}</force></body_load></Loads>\n'
        '<LoadData><load_controller id="1" type="loadcurve"><interpolate>LINEAR</interpolate>'
        "<points><pt>0,0</pt><pt>1,1</pt></points></load_controller></LoadData>\n"
        '<Output><plotfile type="febio"><var type="displacement"/></plotfile></Output>\n'
    )
    return Exported({MODEL: f"{xml}</febio_spec>\n"}, tuple(limits))


def _material(number: int, region: IdentifiedRegion, limits: list[str]) -> str:
    kind, values, uncoupled = _law(region, limits)
    inner = "".join(f"<{tag}>{value!r}</{tag}>" for tag, value in values.items())
    if uncoupled:
        inner += f"<k>{region.kappa_pa!r}</k><pressure_model>{SQUARE}</pressure_model>"
    density, name = f"<density>{region.density_kg_m3!r}</density>", f'name="{region.name}"'
    if not region.branches:
        return f'<material id="{number}" {name} type="{kind}">{density}{inner}</material>\n'
    branches = "".join(
        f"<g{i}>{branch.share!r}</g{i}><t{i}>{branch.tau_s!r}</t{i}>"
        for i, branch in enumerate(region.branches, 1)
    )
    if uncoupled:
        limits.append(
            f"{region.name}: an uncoupled viscoelastic material relaxes its shape only, ours its "
            "volume too"
        )
    return (
        f'<material id="{number}" {name} type="{"uncoupled " * uncoupled}viscoelastic">{density}'
        f'{branches}<elastic type="{kind}">{density}{inner}</elastic></material>\n'
    )


def _law(region: IdentifiedRegion, limits: list[str]) -> tuple[str, dict[str, float], bool]:
    """Type of the material, its constants, and whether it is split in shape and volume."""
    c = region.constants
    if region.material == "mooney-rivlin":
        return HOLDS.materials[region.material], {"c1": c["c10_pa"], "c2": c["c01_pa"]}, True
    moduli = {"E": region.young_pa, "v": region.poisson}
    if region.material == "linear":
        limits.append(f"{region.name}: a linear material turns with the body there, ours does not")
    return HOLDS.materials.get(region.material, "neo-Hookean"), moduli, False


def _mesh(body: Identified) -> str:
    xml = '<Mesh>\n<Nodes name="nodes">\n'
    for k, point in enumerate(body.nodes_m, 1):
        xml += f'<node id="{k}">{numbers(point, ",")}</node>\n'
    xml += "</Nodes>\n"
    for region in body.regions:
        kind = "tet10" if body.quadratic else "tet4"
        xml += f'<Elements type="{kind}" name="cells_{region.name}">\n'
        for cell, nodes in zip(region.cells, body.body.cells[region.cells] + 1, strict=True):
            xml += f'<elem id="{cell + 1}">{",".join(map(str, nodes))}</elem>\n'
        xml += "</Elements>\n"
    for axis, held in zip("xyz", body.held.T, strict=True):
        if held.any():
            nodes = ",".join(map(str, np.flatnonzero(held) + 1))
            xml += f'<NodeSet name="held_{axis}">{nodes}</NodeSet>\n'
    domains = "".join(
        f'<SolidDomain name="cells_{region.name}" mat="{region.name}"/>\n'
        for region in body.regions
    )
    maps = ""
    for axis, held, way in zip("xyz", body.held.T, body.moved_m.T, strict=True):
        if way.any():
            rows = "".join(
                f'<node lid="{i}">{float(v)!r}</node>' for i, v in enumerate(way[held], 1)
            )
            maps += f'<NodeData name="moved_{axis}" node_set="held_{axis}">{rows}</NodeData>\n'
    data = f"<MeshData>\n{maps}</MeshData>\n" if maps else ""
    return f"{xml}</Mesh>\n<MeshDomains>\n{domains}</MeshDomains>\n{data}"


def _boundary(body: Identified) -> str:
    """Held where they are, or moved to where another grasp holds them."""
    conditions = ""
    for axis, held, way in zip("xyz", body.held.T, body.moved_m.T, strict=True):
        where = f'name="hold_{axis}" node_set="held_{axis}"'
        if way.any():
            conditions += (
                f'<bc {where} type="prescribed displacement"><dof>{axis}</dof>'
                f'<value lc="1" type="map">moved_{axis}</value></bc>\n'
            )
        elif held.any():
            conditions += f'<bc {where} type="zero displacement"><{axis}_dof>1</{axis}_dof></bc>\n'
    return f"<Boundary>\n{conditions}</Boundary>\n"
