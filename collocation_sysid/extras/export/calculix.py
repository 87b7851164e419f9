"""CalculiX: an input deck of the body at rest under gravity, in its grasp and in contact with
obstacles.

For a static recording the deck has one step for each sample, else one for the first sample.
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...common.array_types import Array
from ...errors import InputError
from ...fem.laws.constants import FIBRE_ANGLE, FIBRE_DISPERSION, FIBRE_EXPONENT, FIBRE_STIFFNESS
from ...fem.laws.fibres import FibreLaw, ReinforcedMaterial
from ...fem.regions import BodyPart
from .identified import IdentifiedBody, IdentifiedRegion
from .obstacle_shapes import FacetedObstacle, faceted_obstacles
from .target import (
    ExportedFiles,
    PredictionComparison,
    TargetCapabilities,
    comment_lines,
    equilibria,
    longest_displacement_m,
    require_known_laws,
)

DECK = "body.inp"
# Time after which a run of CalculiX is stopped.
TIME_LIMIT_S = 600.0
# Corners of the sides of a tetrahedron in the order of CalculiX.
TETRAHEDRON_SIDES = (0, 1, 2), (0, 1, 3), (1, 2, 3), (0, 2, 3)
# Constant D_i that removes a term of U = Σ (J − 1)^2i / D_i: zero would mean a very stiff term.
ABSENT_TERM = 1e20
CAPABILITIES = TargetCapabilities(mass_damping="", node_forces="", has_quadratic_elements=True)
# Coefficients C_i of the series of Arruda and Boyce.
_ARRUDA_BOYCE_COEFFICIENTS = (1 / 2, 1 / 20, 11 / 1050, 19 / 7000, 519 / 673750)
# Largest number of values on a line of a card, by the manual of CalculiX.
VALUES_PER_LINE = 8
# Abaqus divides by the exponent k₂ of fibres: that of the quadratic law, which changes the energy by
# k₂ e² / 2.
ABAQUS_QUADRATIC = 1e-6
FOAM_LIMITATION = (
    "CalculiX 2.20 finds no equilibrium of a HYPERFOAM of one term, or of two with a negative "
    "exponent; the card is that of Abaqus, too"
)


def export(body: IdentifiedBody) -> ExportedFiles:
    """Return the input deck, one text file, and what CalculiX cannot express; nothing is written.

    The deck has one step for each sample of a static recording, else one for the first sample
    alone. Damping is not exported.

    Raises
    ------
    InputError
        For a law that CalculiX does not have.
    """
    require_known_laws(body, "calculix")
    deck, limits = input_deck(body, for_abaqus=False)
    return ExportedFiles({DECK: deck}, limits)


def input_deck(body: IdentifiedBody, *, for_abaqus: bool) -> tuple[str, tuple[str, ...]]:
    """Return the input deck, with the fibres of CalculiX or of Abaqus, and what it cannot express."""
    static = body.experiment.is_static
    limits = replace(
        CAPABILITIES, has_moving_grasps=static, has_moving_obstacles=static
    ).limitations(body)
    linear = all(region.material == "linear" for region in body.regions)
    materials = ""
    for k, (region, part) in enumerate(zip(body.regions, body.body.parts, strict=True)):
        card, limitation = material_card(region)
        card += "".join(f"** Abaqus: {line}\n" for line in memory_card(region).splitlines())
        name = f"M{k}"
        sections = f"*SOLID SECTION,ELSET=E{k},MATERIAL={name}\n"
        if isinstance(part.material, ReinforcedMaterial):
            fibres = part.material.energy.fibres
            if for_abaqus:
                card, limitation = abaqus_fibre_card(region, fibres)
                directions = region.fibre_directions(fibres.families).tolist()
                sections = _fibre_sections(body, part, k, name, directions)
            else:
                name = f"ELASTIC_FIBER{k}"
                card, limitation = _fibre_card(region, fibres)
                sections = _fibre_sections(body, part, k, name)
        limits += [f"{region.name}: {limitation}"] if limitation else []
        materials += (
            f"*MATERIAL,NAME={name}\n{card}*DENSITY\n{format_values(region.density_kg_m3)}\n"
            f"{sections}"
        )
    limits.append("damping is not exported: an equilibrium has none")
    if body.is_quadratic:
        limits.append(
            f"{'Abaqus' if for_abaqus else 'CalculiX'} distributes the weight of an element with its "
            "shape functions, this program lumps it at the nodes"
        )
    nodes = (f"{k},{format_values(*point)}\n" for k, point in enumerate(body.nodes_m, start=1))
    mesh = f"*NODE,NSET=ALL\n{''.join(nodes)}"
    kind = "C3D10" if body.is_quadratic else "C3D4"
    for k, region in enumerate(body.regions):
        cells = body.body.cells[region.cells] + 1
        lines = (", ".join(map(str, (n + 1, *c))) for n, c in zip(region.cells, cells, strict=True))
        mesh += f"*ELEMENT,TYPE={kind},ELSET=E{k}\n" + "".join(f"{line}\n" for line in lines)
    mesh += "".join(f"*ELSET,ELSET=BODY\nE{k}\n" for k in range(len(body.regions)))
    head = comment_lines(body, limits, start="** ")
    obstacles = faceted_obstacles(body)
    steps = ""
    totals = "YES" if for_abaqus else "ONLY"
    times_s = _step_times_s(body)
    if body.experiment.specimen is not None and len(times_s) > 1:
        steps = _curve_cards(body, times_s, linear)
    else:
        for t_s in times_s:
            steps += _step_card(body, obstacles, t_s, linear, totals)
    deck = f"{head}{mesh}{materials}{_obstacle_cards(body, obstacles)}{steps}"
    return deck, tuple(limits)


def _step_times_s(body: IdentifiedBody) -> Array:
    """All static samples, else the first [s]."""
    return body.experiment.t_s[: None if body.experiment.is_static else 1]


def _obstacle_cards(body: IdentifiedBody, obstacles: Sequence[FacetedObstacle]) -> str:
    """Make a tetrahedron under each facet, and a contact pair for each obstacle."""
    deck = ""
    tetrahedra = body.body.mesh.tetrahedra
    element_numbers = np.arange(len(body.body.cells)) + 1
    faces = {
        tuple(sorted(corners)): f"{number},S{side}"
        for side, places in enumerate(TETRAHEDRON_SIDES, start=1)
        for corners, number in zip(tetrahedra[:, places].tolist(), element_numbers, strict=True)
    }
    for k, wall in enumerate(obstacles):
        deck += f"*NODE,NSET=W{k}\n"
        numbered = enumerate(wall.start_points_m, start=wall.first_node + 1)
        deck += "".join(f"{i},{format_values(*point)}\n" for i, point in numbered)
        deck += f"*ELEMENT,TYPE=C3D4,ELSET=W{k}\n"
        for i, nodes in enumerate(wall.build_tetrahedra() + 1, start=wall.first_cell + 1):
            deck += f"{i},{','.join(map(str, nodes))}\n"
        touching = body.body.mesh.surface[wall.faces].tolist()
        sides = "".join(f"{faces[tuple(sorted(face))]}\n" for face in touching)
        constants = format_values(float(wall.obstacle.friction), wall.stiffness_pa_m / 2)
        stick = f"*FRICTION\n{constants}\n"
        deck += (
            f"*SOLID SECTION,ELSET=W{k},MATERIAL=WALL\n*SURFACE,NAME=W{k}\nW{k},S1\n"
            f"*SURFACE,NAME=B{k}\n{sides}"
            f"*SURFACE INTERACTION,NAME=W{k}\n*SURFACE BEHAVIOR,PRESSURE-OVERCLOSURE=LINEAR\n"
            f"{format_values(wall.stiffness_pa_m)}\n{stick if wall.obstacle.has_friction else ''}"
            f"*CONTACT PAIR,INTERACTION=W{k},TYPE=SURFACE TO SURFACE\nB{k},W{k}\n"
        )
    material = f"*MATERIAL,NAME=WALL\n*ELASTIC\n{format_values(body.regions[0].young_pa, 0.3)}\n"
    return f"{material}*DENSITY\n1.\n{deck}" if obstacles else ""


def _curve_cards(body: IdentifiedBody, times_s: Array, is_linear: bool) -> str:
    """Return the curve of a specimen as one step, in which sample k is at the time k, from 1 on; the
    displacements follow amplitudes.
    """
    moved_m = body.experiment.prescribed_displacements(times_s)[1] - body.nodes_m
    cards, held, moving = "", "", ""
    for n, a in np.argwhere(np.isfinite(moved_m).all(axis=0)).tolist():
        own_m = moved_m[:, n, a]
        if not own_m.any():
            held += f"{n + 1},{a + 1},{a + 1}\n"
            continue
        rows = enumerate([0.0, *own_m.tolist()])
        lines = "".join(f"{format_values(k, value)}\n" for k, value in rows)
        cards += f"*AMPLITUDE,NAME=U{n + 1}_{a + 1}\n{lines}"
        moving += f"*BOUNDARY,AMPLITUDE=U{n + 1}_{a + 1}\n{n + 1},{a + 1},{a + 1},1.\n"
    return (
        f"{cards}*STEP,INC={1000 * len(times_s)}{'' if is_linear else ',NLGEOM'}\n"
        f"*STATIC\n1.,{len(times_s)}.,,1.\n*BOUNDARY\n{held}{moving}*NODE PRINT,NSET=ALL\nU\n"
        "*NODE FILE\nU\n*EL FILE\nS\n*END STEP\n"
    )


def _step_card(
    body: IdentifiedBody,
    obstacles: Sequence[FacetedObstacle],
    t_s: float,
    is_linear: bool,
    totals: str,
) -> str:
    """Node loads are those of the first sample; `totals` is the option of printed forces."""
    displacements_m = [body.experiment.prescribed_displacements([t_s])[1][0] - body.nodes_m]
    displacements_m += [wall.points_at_m(t_s) - wall.start_points_m for wall in obstacles]
    rows = np.concatenate(displacements_m)
    prescribed = np.argwhere(np.isfinite(rows))
    boundary = "".join(
        f"{n + 1},{a + 1},{a + 1},{format_values(float(rows[n, a]))}\n" for n, a in prescribed
    )
    prints = "".join(f"*NODE PRINT,NSET=W{k},TOTALS={totals}\nRF\n" for k in range(len(obstacles)))
    loaded = np.argwhere(body.node_loads_n)
    loads = "".join(
        f"{n + 1},{a + 1},{format_values(float(body.node_loads_n[n, a]))}\n" for n, a in loaded
    )
    pull = float(np.linalg.norm(body.experiment.gravity_m_s2))
    direction = body.experiment.gravity_m_s2 / pull if pull else np.zeros(3)
    weight = (
        f"*DLOAD\nBODY,GRAV,{format_values(pull)},{format_values(*direction)}\n" if pull else ""
    )
    return (
        f"*STEP,INC=1000{'' if is_linear else ',NLGEOM'}\n"
        f"*STATIC\n{'1.,1.' if is_linear else '0.1,1.'}\n"
        + (f"*BOUNDARY\n{boundary}" if boundary else "")
        + (f"*CLOAD\n{loads}" if loads else "")
        + f"{weight}*NODE PRINT,NSET=ALL\nU\n{prints}*NODE FILE\nU\n*EL FILE\nS\n*END STEP\n"
    )


def format_values(*values: float) -> str:
    """CalculiX cuts off a number after 20 characters, even within its exponent: 12 digits."""
    return ",".join(f"{float(value):.12g}" for value in values)


def memory_card(region: IdentifiedRegion) -> str:
    """Return the card of the memory in Abaqus, empty without any: shares of the instantaneous shear and
    bulk modulus, and relaxation times. The constants of a law are those at rest, the long-term ones,
    which is the default of Abaqus.
    """
    at_once = 1 + sum(branch["share"] for branch in region.branches)
    lines = (
        format_values(branch["share"] / at_once, branch["share"] / at_once, branch["tau_s"])
        for branch in region.branches
    )
    card = "".join(f"{line}\n" for line in lines)
    return f"*VISCOELASTIC,TIME=PRONY\n{card}" if card else ""


def material_card(region: IdentifiedRegion) -> tuple[str, str]:
    """Return the card of a law, and a sentence on what it does not express; that of the matrix of
    fibres is not used.
    """
    c: Mapping[str, float] = region.constants
    volume = 2 / region.kappa_pa
    if region.material in ("st-venant-kirchhoff", "linear"):
        return f"*ELASTIC\n{format_values(region.young_pa, region.poisson)}\n", ""
    if region.material == "mooney-rivlin":
        constants = format_values(c["c10_pa"], c["c01_pa"], volume)
        return f"*HYPERELASTIC,MOONEY-RIVLIN\n{constants}\n", ""
    if region.material == "yeoh":
        factors = (c["c10_pa"], c["c20_pa"], c["c30_pa"])
        constants = format_values(*factors, volume, ABSENT_TERM, ABSENT_TERM)
        return f"*HYPERELASTIC,YEOH\n{constants}\n", ""
    if region.material == "arruda-boyce":
        stretch = c["chain_stretch"]
        slope = sum(
            2 * a / stretch ** (2 * i - 2) * i * 3 ** (i - 1)
            for i, a in enumerate(_ARRUDA_BOYCE_COEFFICIENTS, 1)
        )
        constants = format_values(c["mu_pa"] / slope, stretch, volume)
        return f"*HYPERELASTIC,ARRUDA-BOYCE\n{constants}\n", (
            "its volumetric energy is ½ κ ((J² − 1)/2 − ln J) instead of ½ κ (J − 1)²: both "
            "agree for small changes of volume"
        )
    if region.power_terms:
        is_foam = region.material.startswith("hyperfoam")
        return _power_law_card(region, volume), FOAM_LIMITATION if is_foam else ""
    constants = format_values(region.mu_pa / 2, volume)
    return f"*HYPERELASTIC,NEO HOOKE\n{constants}\n", (
        "its neo-Hookean energy is that of Ī₁ with ½ κ (J − 1)²: both agree for small changes of "
        "volume"
    )


def _fibre_card(region: IdentifiedRegion, fibres: FibreLaw) -> tuple[str, str]:
    """Return the card of CalculiX's own law of fibres in the axes of `_fibre_sections`, and a
    sentence on what it does not express.

    Its energy is that of Holzapfel, Gasser & Ogden (2000), k₁/(2 k₂) (exp(k₂ (Ī₄ − 1)²) − 1) of each
    family for Ī₄ > 1, beside the neo-Hookean one; with k₂ = 0 it is quadratic.
    """
    c = region.constants
    sine = np.sin(c.get(FIBRE_ANGLE.name, 0.0))
    own = (c[FIBRE_STIFFNESS.name] / 4, c.get(FIBRE_EXPONENT.name, 0.0))
    values = [region.mu_pa / 2, 2 / region.kappa_pa]
    for side in (1, -1)[: fibres.families]:
        values += [0.0, -side * sine, *own]
    lines = (values[k : k + VALUES_PER_LINE] for k in range(0, len(values), VALUES_PER_LINE))
    card = "".join(f"{format_values(*line)}\n" for line in lines)
    limitation = (
        "its neo-Hookean energy is that of Ī₁ with ½ κ (J − 1)², and fibres resist their stretch "
        "without the change of volume"
    )
    return f"*USER MATERIAL,CONSTANTS={len(values)}\n{card}", limitation


def abaqus_fibre_card(region: IdentifiedRegion, fibres: FibreLaw) -> tuple[str, str]:
    """Return the card of the law of Gasser, Ogden & Holzapfel (2006) in Abaqus, and a sentence on
    what it does not express.

    Its energy is C₁₀ (Ī₁ − 3) + ((J² − 1)/2 − ln J)/D + k₁/(2 k₂) (exp(k₂ ⟨e⟩²) − 1) of each family,
    with e = κ (Ī₁ − 3) + (1 − 3 κ)(Ī₄ − 1).
    """
    c = region.constants
    values = (
        region.mu_pa / 2,
        2 / region.kappa_pa,
        c[FIBRE_STIFFNESS.name] / 4,
        c.get(FIBRE_EXPONENT.name, ABAQUS_QUADRATIC),
        c.get(FIBRE_DISPERSION.name, 0.0),
    )
    limitation = (
        "its neo-Hookean energy is that of Ī₁ with ½ κ ((J² − 1)/2 − ln J), and fibres resist their "
        "stretch without the change of volume"
    )
    keyword = f"*ANISOTROPIC HYPERELASTIC,HOLZAPFEL,LOCAL DIRECTIONS={fibres.families}"
    return f"{keyword}\n{format_values(*values)}\n", limitation


def _fibre_sections(
    body: IdentifiedBody,
    part: BodyPart,
    number: int,
    name: str,
    directions: Sequence[Sequence[float]] = (),
) -> str:
    """CalculiX has the normal, across and against the fibres; Abaqus the axes of the fibres."""
    cards = ""
    keyword = "SYSTEM=RECTANGULAR"
    tail = ""
    if directions:
        keyword += f",LOCAL DIRECTIONS={len(directions)}"
        tail = "".join(f"{format_values(*each)}\n" for each in ((3, 0.0), *directions))
    for k, (cells, own) in enumerate(body.fibre_axes(part)):
        label = f"F{number}_{k}"
        first, second = (own[:, 0], own[:, 1]) if directions else (own[:, 2], own[:, 1])
        cards += (
            f"*ORIENTATION,NAME={label},{keyword}\n"
            f"{format_values(*first, *second)}\n{tail}"
            f"*ELSET,ELSET={label}\n"
            + "".join(f"{cell}\n" for cell in cells + 1)
            + f"*SOLID SECTION,ELSET={label},MATERIAL={name},ORIENTATION={label}\n"
        )
    return cards


def _power_law_card(region: IdentifiedRegion, volume: float) -> str:
    """The energy of a term is 2μ/α² (Σ λ^α − 3): μ is ½ μ_p α_p of Ogden's law."""
    terms = region.power_terms
    if region.material.startswith("ogden"):
        keyword = "HYPERELASTIC,OGDEN"
        values = [value for mu, alpha, _ in terms for value in (mu * alpha / 2, alpha)]
        values += [volume] + [ABSENT_TERM] * (len(terms) - 1)
    else:
        keyword = "HYPERFOAM"
        values = [value for mu, alpha, _ in terms for value in (mu, alpha)]
        values += [beta / (1 + 2 * beta) for _, _, beta in terms]
    lines = [
        format_values(*values[k : k + VALUES_PER_LINE])
        for k in range(0, len(values), VALUES_PER_LINE)
    ]
    return f"*{keyword},N={len(terms)}\n" + "".join(f"{line}\n" for line in lines)


def verify(body: IdentifiedBody, folder: Path) -> list[PredictionComparison]:
    """Run CalculiX (the program ``ccx``), and compare the largest displacement at rest and the
    force of each obstacle, all in the last step of the deck.

    Parameters
    ----------
    body : IdentifiedBody
        Body that was exported.
    folder : Path
        Folder with the deck, into which CalculiX writes its files.

    Raises
    ------
    InputError
        If it is not installed, fails, or takes longer than `TIME_LIMIT_S`.
    SimulationError
        If an equilibrium of this package cannot be computed.
    """
    program = shutil.which("ccx")
    if program is None:
        raise InputError("the program ccx was not found: install CalculiX to verify the export")
    try:
        job = [program, "-i", DECK.removesuffix(".inp")]
        ended = subprocess.run(
            job, cwd=folder, capture_output=True, text=True, timeout=TIME_LIMIT_S, check=False
        )
    except subprocess.TimeoutExpired:
        raise InputError(
            f"CalculiX took more than {TIME_LIMIT_S:g} s and was stopped; verify with a coarser "
            "mesh or fewer samples",
            folder / DECK,
        ) from None
    times = _step_times_s(body)
    theirs, their_forces = _read_final_state(
        folder / "body.dat", len(body.nodes_m), steps=len(times)
    )
    if theirs is None:
        messages = [x for x in ended.stdout.splitlines() if "ERROR" in x] or [
            "no displacements written"
        ]
        raise InputError(
            f"CalculiX could not compute the exported model ({messages[0].strip()}); run ccx on "
            "this deck to see its output",
            folder / DECK,
        )
    (*_, ours), (*_, forces) = equilibria(body, len(times))
    sag_m = longest_displacement_m(ours)
    difference_m = longest_displacement_m(theirs - ours)
    share = f" ({difference_m / sag_m:.2%} of the displacement)" if sag_m else ""
    remark = f"node positions differ by at most {difference_m:.3g} m{share}"
    what = "at rest" if len(times) == 1 else f"at {times[-1]:g} s"
    comparisons = [
        PredictionComparison(
            f"largest displacement {what}",
            longest_displacement_m(theirs),
            ours=sag_m,
            unit="m",
            remark=remark,
        )
    ]
    for each, push, force in zip(body.obstacles, their_forces, forces, strict=True):
        their_n = float(np.linalg.norm(push))
        our_n = float(np.linalg.norm(force))
        comparisons.append(
            PredictionComparison(f"force of {each.name} {what}", their_n, ours=our_n, unit="N")
        )
    return comparisons


def _read_final_state(file: Path, count: int, steps: int) -> tuple[Array | None, Array]:
    """Return displacements (n, 3) and obstacle forces (o, 3) of the last step."""
    if not file.is_file():
        return None, np.zeros((0, 3))
    table = np.full((count, 3), np.nan)
    forces = []
    time = 0.0
    for line in file.read_text().splitlines():
        words = line.split()
        if "time" in words:
            if float(words[-1]) > time:
                time = float(words[-1])
                forces = []
        elif len(words) == 3:
            forces.append([float(word) for word in words])
        elif len(words) == 4 and words[0].isdigit():
            table[int(words[0]) - 1] = [float(word) for word in words[1:]]
    done = time >= steps * (1.0 - 1e-6) and np.isfinite(table).all()
    return table if done else None, np.array(forces).reshape(-1, 3)
