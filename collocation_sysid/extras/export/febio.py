"""FEBio: a model of the body at rest under gravity, in its grasp at the first sample.

The file has the format 4.0. FEBio's fibres of the type "fiber-exp-pow" and its law "HGO
unconstrained" have the energies of `Fibres`, with the change of volume. Laws of isochoric invariants
or stretches have the energy ½ κ (J − 1)² of the change of volume (pressure model 2). The stress of a
memory is that of the law at rest times 1 + Σ g_k exp(−t/τ_k).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from ...common.array_types import Array, Index
from ...errors import InputError
from ...fem.laws.constants import FIBRE_DISPERSION, FIBRE_EXPONENT, FIBRE_STIFFNESS
from ...fem.laws.fibres import FibreLaw, ReinforcedMaterial
from .identified import IdentifiedBody, IdentifiedRegion
from .target import (
    ExportedFiles,
    TargetCapabilities,
    comment_lines,
    require_known_laws,
    values_as_text,
)

MODEL = "body.feb"
# Law of FEBio with the energy of a material.
LAWS = {
    "neo-hookean": "neo-Hookean",
    "st-venant-kirchhoff": "isotropic elastic",
    "mooney-rivlin": "Mooney-Rivlin",
    "yeoh": "Yeoh",
    **{f"ogden-{terms}": "Ogden" for terms in range(1, 5)},
}
# Most branches of a memory.
MOST_BRANCHES = 6
CAPABILITIES = TargetCapabilities(
    mass_damping="", node_forces="", has_quadratic_elements=True, has_memory=True
)
# Energy ½ κ (J − 1)² of the change of volume.
ABAQUS_VOLUME = 2
# A matrix without stiffness beside another one, and the exponent of the quadratic law, relative to
# ones that count: FEBio's law of dispersed fibres accepts no zeros.
NOTHING = 1e-9
HEAD = """\
  <Module type="solid"/>
  <Control>
    <analysis>STATIC</analysis>
    <time_steps>10</time_steps>
    <step_size>0.1</step_size>
    <time_stepper type="default"/>
    <solver type="solid"/>
  </Control>
"""
RAMP = """\
  <LoadData>
    <load_controller id="1" type="loadcurve">
      <interpolate>LINEAR</interpolate>
      <points>
        <pt>0,0</pt>
        <pt>1,1</pt>
      </points>
    </load_controller>
  </LoadData>
"""
OUTPUT = """\
  <Output>
    <logfile>
      <node_data data="ux;uy;uz" file="displacements.csv" delim=","/>
    </logfile>
    <plotfile type="febio">
      <var type="displacement"/>
      <var type="stress"/>
    </plotfile>
  </Output>
"""


def export(body: IdentifiedBody) -> ExportedFiles:
    """Return the model, one text file, and what FEBio cannot express; nothing is written.

    Raises
    ------
    InputError
        For a law or a memory that FEBio does not have.
    """
    require_known_laws(body, "febio")
    limits = CAPABILITIES.limitations(body)
    limits += [f"{each.name} is not exported" for each in body.obstacles]
    limits.append("damping is not exported: an equilibrium has none")
    materials, domains = "", []
    for region, part in zip(body.regions, body.body.parts, strict=True):
        limits += _memory_limitations(region)
        fibres = None
        groups: list[tuple[Index, Array]] = [(part.cells, np.eye(3))]
        if isinstance(part.material, ReinforcedMaterial):
            fibres = part.material.energy.fibres
            groups = body.fibre_axes(part)
        for cells, axes in groups:
            number = len(domains) + 1
            materials += _material(number, region, fibres, axes)
            domains.append(cells)
    sets, boundary = _prescribed(body)
    force_sets, loads = _loads(body)
    kind = "tet10" if body.is_quadratic else "tet4"
    elements = "".join(
        f'    <Elements type="{kind}" name="E{k}">\n'
        + _lines("elem", cells + 1, body.body.cells[cells] + 1)
        + "    </Elements>\n"
        for k, cells in enumerate(domains, start=1)
    )
    nodes = _lines("node", range(1, len(body.nodes_m) + 1), body.nodes_m)
    solids = "".join(
        f'    <SolidDomain name="E{k}" mat="M{k}"/>\n' for k in range(1, len(domains) + 1)
    )
    head = comment_lines(body, limits, start="  <!-- ", end=" -->")
    text = (
        f'<?xml version="1.0" encoding="UTF-8"?>\n<febio_spec version="4.0">\n{head}{HEAD}'
        f"  <Material>\n{materials}  </Material>\n"
        f'  <Mesh>\n    <Nodes name="body">\n{nodes}    </Nodes>\n{elements}{sets}{force_sets}  </Mesh>\n'
        f"  <MeshDomains>\n{solids}  </MeshDomains>\n{RAMP}"
        f"  <Loads>\n{loads}  </Loads>\n  <Boundary>\n{boundary}  </Boundary>\n{OUTPUT}</febio_spec>\n"
    )
    return ExportedFiles({MODEL: text}, tuple(limits))


def _memory_limitations(region: IdentifiedRegion) -> Iterable[str]:
    """Refuse a memory that FEBio does not have, and yield what it changes."""
    has_fibres = FIBRE_STIFFNESS.name in region.constants
    is_isochoric = "pressure_model" in _constants(region)
    if len(region.branches) > MOST_BRANCHES or (region.branches and has_fibres):
        raise InputError(
            f"FEBio has no memory of {len(region.branches)} branches with these constants; expected "
            f"at most {MOST_BRANCHES}, without fibres",
            where=f"region '{region.name}'",
        )
    if region.branches:
        yield f"{region.name}: the load is applied within 1 s, after which its stress relaxes"
    if region.branches and is_isochoric:
        yield (
            f"{region.name}: only the stress of the change of shape relaxes, while that of the volume "
            "does in the identified material, too"
        )


def _constants(region: IdentifiedRegion) -> dict[str, float]:
    """Return the constants of the law of FEBio."""
    c = region.constants
    constants = {"density": region.density_kg_m3}
    if region.material == "mooney-rivlin":
        constants |= {"c1": c["c10_pa"], "c2": c["c01_pa"]}
    elif region.material == "yeoh":
        constants |= {"c1": c["c10_pa"], "c2": c["c20_pa"], "c3": c["c30_pa"]}
    elif region.power_terms:  # of which FEBio's energy is c/m² (Σ λ^m − 3)
        for p, (mu, alpha, _) in enumerate(region.power_terms, start=1):
            constants |= {f"c{p}": mu * alpha, f"m{p}": alpha}
    else:
        return constants | {"E": region.young_pa, "v": region.poisson}
    return constants | {"k": region.kappa_pa, "pressure_model": ABAQUS_VOLUME}


def _material(number: int, region: IdentifiedRegion, fibres: FibreLaw | None, axes: Array) -> str:
    """Fibres have the axes (3, 3)."""
    names = f'id="{number}" name="M{number}" '
    if fibres is not None:
        constants = {"density": region.density_kg_m3, "E": region.young_pa, "v": region.poisson}
        solids = _law("solid", LAWS[region.material], constants)
        solids += "".join(_fibre_solids(region, fibres, axes))
        return f'    <material {names}type="solid mixture">\n{solids}    </material>\n'
    law, constants = LAWS[region.material], _constants(region)
    if region.branches:
        memory = {"density": constants.pop("density"), "g0": 1.0}
        for k, branch in enumerate(region.branches, start=1):
            memory |= {f"g{k}": branch["share"], f"t{k}": branch["tau_s"]}
        is_isochoric = "pressure_model" in constants
        memory |= {name: constants.pop(name) for name in ("k", "pressure_model") if is_isochoric}
        kind = "uncoupled viscoelastic" if is_isochoric else "viscoelastic"
        return _law("material", kind, memory, names, _law("elastic", law, constants).strip())
    return _law("material", law, constants, names)


def _fibre_solids(region: IdentifiedRegion, fibres: FibreLaw, axes: Array) -> Iterable[str]:
    """The density of a mixture is the sum of those of its parts, which is 1 by default."""
    c = region.constants
    directions = region.fibre_directions(fibres.families)
    along = directions @ axes.T
    k1 = c[FIBRE_STIFFNESS.name] / 4
    exponent = c.get(FIBRE_EXPONENT.name, 0.0)
    if not fibres.is_dispersed:
        for direction in along:
            constants = {"density": 0.0, "ksi": k1, "alpha": exponent, "beta": 2.0}
            fibre = f'<fiber type="vector">{values_as_text(direction, ",")}</fiber>'
            yield _law("solid", "fiber-exp-pow", constants, inside=fibre)
        return
    # This law has two families at ± gamma from the first axis: one family is half of each.
    single = len(along) == 1
    first, second = (along[0], np.cross(axes[:, 2], along[0])) if single else axes.T[:2]
    acute = np.arctan2(*np.abs(directions[0, 1::-1]))
    constants = {
        "density": 0.0,
        "c": NOTHING * region.mu_pa,
        "k1": k1 / 2 if single else k1,
        "k2": exponent or NOTHING,
        "gamma": 0.0 if single else float(np.degrees(acute)),
        "kappa": c[FIBRE_DISPERSION.name],
        "k": NOTHING * region.mu_pa,
    }
    inside = (
        f'<mat_axis type="vector"><a>{values_as_text(first, ",")}</a>'
        f"<d>{values_as_text(second, ',')}</d></mat_axis>"
    )
    yield _law("solid", "HGO unconstrained", constants, inside=inside)


def _law(tag: str, law: str, constants: dict[str, float], names: str = "", inside: str = "") -> str:
    lines = [
        f"<{name}>{value if isinstance(value, int) else repr(float(value))}</{name}>"
        for name, value in constants.items()
    ]
    body = "".join(f"      {line}\n" for line in [*lines, inside] if line)
    return f'    <{tag} {names}type="{law}">\n{body}    </{tag}>\n'


def _lines(tag: str, numbers: Iterable[int], rows: Array | Index) -> str:
    return "".join(
        f'      <{tag} id="{number}">{",".join(map(repr, row))}</{tag}>\n'
        for number, row in zip(numbers, rows.tolist(), strict=True)
    )


def _node_set(name: str, nodes: Sequence[int] | Index) -> str:
    numbers = ",".join(str(int(node) + 1) for node in nodes)
    return f'    <NodeSet name="{name}">{numbers}</NodeSet>\n'


def _prescribed(body: IdentifiedBody) -> tuple[str, str]:
    moved_m = np.round(body.prescribed_m - body.nodes_m, 12)
    sets, conditions = "", ""
    for axis, name in enumerate("xyz"):
        for k, value in enumerate(np.unique(moved_m[np.isfinite(moved_m[:, axis]), axis])):
            label = f"held_{name}{k}"
            sets += _node_set(label, np.flatnonzero(moved_m[:, axis] == value))
            conditions += (
                f'    <bc type="prescribed displacement" node_set="{label}">\n'
                f"      <dof>{name}</dof>\n"
                f'      <value lc="1">{float(value)!r}</value>\n    </bc>\n'
            )
    return sets, conditions


def _loads(body: IdentifiedBody) -> tuple[str, str]:
    """FEBio subtracts the weight."""
    sets, loads = "", ""
    for k, node in enumerate(np.flatnonzero(body.node_loads_n.any(axis=1))):
        sets += _node_set(f"loaded_{k}", [int(node)])
        loads += (
            f'    <nodal_load type="nodal_force" node_set="loaded_{k}">\n'
            f'      <value lc="1">{values_as_text(body.node_loads_n[node], ",")}</value>\n'
            "    </nodal_load>\n"
        )
    axes = "".join(
        f'      <{name} lc="1">{float(-value)!r}</{name}>\n'
        for name, value in zip("xyz", body.experiment.gravity_m_s2, strict=True)
    )
    return sets, f'{loads}    <body_load type="const">\n{axes}    </body_load>\n'
