"""CalculiX: an input deck of the body at rest in its grasp, under gravity."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ...arrays import Array
from ...errors import InputError
from .identified import Identified, IdentifiedRegion
from .target import Comparison, Exported, Holds, heading, longest, moved_at_rest

DECK = "body.inp"
LONGEST_S = 600.0
# Of U = Σ (J − 1)^2i / D_i beyond the first: a zero is taken for a very stiff term.
NO_TERM = 1e20
# C_i of Arruda and Boyce's series.
HOLDS = Holds({}, instead="", mass_damping="", forces="", quadratic=True)
_CHAINS = (1 / 2, 1 / 20, 11 / 1050, 19 / 7000, 519 / 673750)


def export(body: Identified) -> Exported:
    """The deck of one static step, as large as the loads are."""
    limits = HOLDS.lost(body)
    linear = all(region.material == "linear" for region in body.regions)
    materials = ""
    for k, region in enumerate(body.regions):
        card, lost = _material(region, linear)
        limits += [f"{region.name}: {lost}"] if lost else []
        materials += (
            f"*MATERIAL,NAME=M{k}\n{card}*DENSITY\n{_fields(region.density_kg_m3)}\n"
            f"*SOLID SECTION,ELSET=E{k},MATERIAL=M{k}\n"
        )
    limits.append("damping is not exported: an equilibrium has none")
    if body.quadratic:
        limits.append("the weight of an element is spread by its shape functions, ours is lumped")
    nodes = (f"{k},{_fields(*point)}\n" for k, point in enumerate(body.nodes_m, start=1))
    mesh = f"*NODE,NSET=ALL\n{''.join(nodes)}"
    kind = "C3D10" if body.quadratic else "C3D4"
    for k, region in enumerate(body.regions):
        cells = body.body.cells[region.cells] + 1
        lines = (", ".join(map(str, (n + 1, *c))) for n, c in zip(region.cells, cells, strict=True))
        mesh += f"*ELEMENT,TYPE={kind},ELSET=E{k}\n" + "".join(f"{line}\n" for line in lines)
    mesh += "".join(f"*ELSET,ELSET=BODY\nE{k}\n" for k in range(len(body.regions)))
    head = heading(body, limits, "** ")
    return Exported({DECK: f"{head}{mesh}{materials}{_step(body, linear)}"}, tuple(limits))


def _step(body: Identified, linear: bool) -> str:
    """Grasped nodes where they are held, gravity, and what else pulls."""
    held = np.argwhere(body.held)
    moved = body.moved_m
    boundary = "".join(f"{n + 1},{a + 1},{a + 1},{_fields(float(moved[n, a]))}\n" for n, a in held)
    pulled = np.argwhere(body.loads_n)
    loads = "".join(f"{n + 1},{a + 1},{_fields(float(body.loads_n[n, a]))}\n" for n, a in pulled)
    pull = float(np.linalg.norm(body.experiment.gravity_m_s2))
    way = body.experiment.gravity_m_s2 / pull if pull else np.zeros(3)
    weight = f"*DLOAD\nBODY,GRAV,{_fields(pull)},{_fields(*way)}\n" if pull else ""
    return (
        f"*STEP,INC=1000{'' if linear else ',NLGEOM'}\n*STATIC\n{'1.,1.' if linear else '0.1,1.'}\n"
        + (f"*BOUNDARY\n{boundary}" if boundary else "")
        + (f"*CLOAD\n{loads}" if loads else "")
        + f"{weight}*NODE PRINT,NSET=ALL\nU\n*NODE FILE\nU\n*EL FILE\nS\n*END STEP\n"
    )


def _fields(*values: float) -> str:
    """Numbers of a line: what is past 20 characters of one is cut off, and be it the exponent."""
    return ",".join(f"{float(value):.12g}" for value in values)


def _material(region: IdentifiedRegion, linear: bool) -> tuple[str, str]:
    """The card of a material, and what it does not say."""
    c: Mapping[str, float] = region.constants
    volume = 2 / region.kappa_pa
    if region.material in ("st-venant-kirchhoff", "linear"):
        lost = ""
        if region.material == "linear" and not linear:
            lost = "beside large strains the linear material becomes St. Venant and Kirchhoff's"
        return f"*ELASTIC\n{_fields(region.young_pa, region.poisson)}\n", lost
    if region.material == "mooney-rivlin":
        values = c["c10_pa"], c["c01_pa"], volume
        return f"*HYPERELASTIC,MOONEY-RIVLIN\n{_fields(*values)}\n", ""
    if region.material in ("yeoh", "gent"):
        if region.material == "yeoh":
            factors, lost = (c["c10_pa"], c["c20_pa"], c["c30_pa"]), ""
        else:
            mu, room = c["mu_pa"], c["gent_limit"]
            factors = mu / 2, mu / (4 * room), mu / (6 * room**2)
            lost = (
                f"Gent's energy is a series of three terms: right for Ī₁ − 3 well below {room:.4g}"
            )
        values = *factors, volume, NO_TERM, NO_TERM
        return f"*HYPERELASTIC,YEOH\n{_fields(*values)}\n", lost
    if region.material == "arruda-boyce":
        stretch = c["chain_stretch"]
        slope = sum(
            2 * a / stretch ** (2 * i - 2) * i * 3 ** (i - 1) for i, a in enumerate(_CHAINS, 1)
        )
        values = c["mu_pa"] / slope, stretch, volume
        return f"*HYPERELASTIC,ARRUDA-BOYCE\n{_fields(*values)}\n", (
            "its energy of the volume is ½ κ ((J² − 1)/2 − ln J), ours ½ κ (J − 1)²: the same at "
            "small changes of volume"
        )
    values = region.mu_pa / 2, volume
    return f"*HYPERELASTIC,NEO HOOKE\n{_fields(*values)}\n", (
        f"{region.material} becomes the neo-Hookean of Ī₁ with ½ κ (J − 1)²: the same λ and μ at "
        "small strain, another stress from the second order of the strain on"
    )


def verify(body: Identified, folder: Path) -> list[Comparison]:
    """The largest displacement at rest, from `ccx`.

    Raises
    ------
    InputError
        If it is not installed, fails, or takes too long.
    """
    program = shutil.which("ccx")
    if program is None:
        raise InputError("no program ccx is on the path: install CalculiX to verify the export")
    try:
        job = [program, "-i", DECK.removesuffix(".inp")]
        ended = subprocess.run(
            job, cwd=folder, capture_output=True, text=True, timeout=LONGEST_S, check=False
        )
    except subprocess.TimeoutExpired:
        raise InputError(f"CalculiX took more than {LONGEST_S:g} s", folder / DECK) from None
    theirs = _last_displacements(folder / "body.dat", len(body.nodes_m))
    if theirs is None:
        said = [x for x in ended.stdout.splitlines() if "ERROR" in x] or [
            "no displacements written"
        ]
        raise InputError(f"CalculiX failed: {said[0].strip()}", folder / DECK)
    ours = moved_at_rest(body)
    sag_m, apart_m = longest(ours), longest(theirs - ours)
    share = f" ({apart_m / sag_m:.2%} of it)" if sag_m else ""
    remark = f"no node is further than {apart_m:.3g} m apart{share}"
    return [Comparison("largest displacement at rest", longest(theirs), sag_m, "m", remark)]


def _last_displacements(file: Path, count: int) -> Array | None:
    """(n, 3) of the last increment; None where it did not get to the end."""
    if not file.is_file():
        return None
    table, complete = np.full((count, 3), np.nan), False
    for line in file.read_text().splitlines():
        words = line.split()
        if "time" in words:
            complete = float(words[-1]) >= 1.0 - 1e-9
        elif len(words) == 4 and words[0].isdigit():
            table[int(words[0]) - 1] = [float(word) for word in words[1:]]
    return table if complete and np.isfinite(table).all() else None
