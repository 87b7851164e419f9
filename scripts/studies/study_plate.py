"""A plate with a hole identified from displacements and two reactions, with known truth.

The data are simulated by FEniCSx in plane strain by the authors of "Material Fingerprinting" (MIT
licence): `plate.msh` and `experiment_unsupervised11_LAW_noiseNOISE.npz`. The triangles are extruded
by one layer of tetrahedra with z held. Measured are the displacements of 11 nodes on the arc of the
hole and the reactions of the left and of the lower side, in 11 equilibria. Noise is drawn as the
authors draw it, σ relative to the largest displacement and the largest reaction; the first draw of
1 % is the authors' own file.

The laws are solved with their own constants, and, as if only the family were known, with all
constants of the Mooney–Rivlin law. Where the data of a law are not in the folder (Demiray), they
are simulated with the authors' elements (`plate_triangles`, equal to their data to rounding). The
error of an energy is the measure of the authors: the integral of |W − W_true| over the principal
stretches from 0.75 to 1.25, relative to that of W_true.

    python scripts study_plate [FOLDER]

Without FOLDER, the data set `plate_fingerprint` is fetched.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Mapping
from functools import cache
from itertools import product
from pathlib import Path

import casadi as ca
import meshio
import numpy as np
from numpy.typing import NDArray
from plate_triangles import RADIUS, STEPS, Plate, energy, energy_error
from studies import markdown

import collocation_sysid as cs
from collocation_sysid.common.array_types import Array
from collocation_sysid.fem.meshes.mesh import TetMesh
from collocation_sysid.recording.grasp import Axes
from collocation_sysid.statistics.curved_intervals import uncertainty_at

# Thickness of one layer of tetrahedra.
THICKNESS = 0.05
NOISES = (0.0, 0.01, 0.02, 0.05)
DRAWS = 5
# The elements differ from those of FEniCSx, which changes reactions by this share at most.
ELEMENTS = 1e-3
# Initial guess of every constant.
GUESS_PA = 20.0
HEADS = [
    "law, noise",
    "constant",
    "truth",
    "median (range) of the estimates",
    "median half width of the 95 % interval",
    "contains the truth",
]
ENERGY_HEADS = ["law, noise", "median (largest) error of the energy", "CPU s per solve"]
# True constants by the law's name in the file.
TRUTHS: dict[str, dict[str, float]] = {
    "NeoHooke": {"kappa_pa": 40.0, "c10_pa": 10.0, "c01_pa": 0.0},
    "MooneyRivlin": {"kappa_pa": 40.0, "c10_pa": 10.0, "c01_pa": 40.0},
    "Blatz": {"kappa_pa": 10.0, "c10_pa": 0.0, "c01_pa": 50.0},
    "Demiray": {"kappa_pa": 10.0, "demiray_pa": 10.0, "demiray": 8.0},
}


def demiray_energy(F: ca.SX, kappa_pa: ca.SX, demiray_pa: ca.SX, demiray: ca.SX) -> ca.SX:
    """Return W = κ/2 (J − 1)² + a (exp(b (Ī₁ − 3)) − 1)."""
    volume = ca.det(F)
    first = volume ** (-2 / 3) * ca.sumsqr(F)
    values = {"kappa_pa": kappa_pa, "demiray_pa": demiray_pa, "demiray": demiray}
    return energy(first, 3.0, volume, values, ca)


def plate_mesh(path: Path) -> TetMesh:
    """Return the triangles of the file extruded by one layer: prisms of three tetrahedra."""
    flat = meshio.read(path)
    triangles = np.sort(np.concatenate([b.data for b in flat.cells if b.type == "triangle"]), 1)
    used, inverse = np.unique(triangles, return_inverse=True)
    triangles = inverse.reshape(triangles.shape)
    points = np.asarray(flat.points)[used, :2]
    count = len(points)
    layers = [np.column_stack([points, np.full(count, z)]) for z in (0.0, THICKNESS)]
    a, b, c = triangles.T
    # Cut by ascending numbers, the faces of neighbouring prisms agree.
    cells = [
        (a, b, c, c + count),
        (a, b, b + count, c + count),
        (a, a + count, b + count, c + count),
    ]
    tetrahedra = np.concatenate([np.column_stack(each) for each in cells])
    return TetMesh(np.vstack(layers), tetrahedra)


def plate_experiment(
    mesh: TetMesh, law: str | Callable[..., ca.SX], data: Mapping[str, Array], noise: float
) -> cs.Experiment:
    """Return the equilibria of the plate with the measurements of a file."""
    t_s = np.arange(float(STEPS))
    points = mesh.points_m
    shift = -0.3 * t_s / (STEPS - 1)

    def held(inside: NDArray[np.bool_], axes: Axes, moved: Array | float = 0.0) -> cs.Grasp:
        positions = np.zeros((STEPS, 3))
        positions[:, "xyz".index(axes)] = moved
        still = np.tile([0.0, 0.0, 0.0, 1.0], (STEPS, 1))
        poses = cs.PoseSequence(t_s, positions, still)
        return cs.Grasp(np.flatnonzero(inside), poses, axes=axes)

    close = 1e-6
    grasps = [
        held(points[:, 0] < close, "x", 0.5 * shift),
        held(points[:, 1] < close, "y", shift),
        held(points[:, 0] > 1 - close, "x"),
        held(points[:, 1] > 1 - close, "y"),
        held(points[:, 2] > -1, "z"),
    ]
    radius = np.hypot(points[:, 0] - 1, points[:, 1] - 1)
    arc = points[(np.abs(radius - RADIUS) < close) & (points[:, 2] < close)]
    arc = arc[np.argsort(-arc[:, 1])]
    # The file has u_x of all nodes, then u_y, each over the steps.
    moved = data["f_u"].reshape(2, len(arc), STEPS).transpose(2, 1, 0).reshape(STEPS, -1)
    pulls = data["f_reaction"].reshape(2, STEPS).T
    relative = float(np.hypot(noise, ELEMENTS))
    sensors = [
        cs.Gauge("arc", lambda at: ca.vec(at.position_m[:2, :] - ca.DM(arc[:, :2].T)), t_s, moved,
                 relative * np.abs(moved).max(), arc, unit="m"),
        *(
            cs.Gauge(name, lambda at, k=k: at.force_n[k] / THICKNESS, t_s, pulls[:, k],
                     relative * np.abs(pulls).max(), grasp=1 + k, frame="world", unit="N/m")
            for k, name in enumerate(("left", "bottom"))
        ),
    ]  # fmt: skip
    body = cs.Body(mesh, law, density_kg_m3=1.0)
    return cs.Experiment(
        body,
        t_s,
        grasps,
        readings=sensors,
        nuisance=cs.Nuisance.none(),
        kind="static",
        gravity_m_s2=(0.0, 0.0, 0.0),
        air_density_kg_m3="none",
    )


@cache
def plate_of(folder: Path) -> Plate:
    """Return the authors' plate."""
    return Plate(next(folder.glob("*plate*.msh")))


def exact_data(folder: Path, law: str) -> dict[str, Array]:
    """Return the published data without noise, or for want of them those of the same elements."""
    published = folder / f"experiment_unsupervised11_{law}_noise0.0.npz"
    if published.is_file():
        return dict(np.load(published))
    reactions, displacements, _ = plate_of(folder).equilibria(TRUTHS[law])
    return {"f_reaction": reactions, "f_u": displacements}


def data_with_noise(folder: Path, law: str, noise: float, draw: int) -> dict[str, Array]:
    """Return the published data of a law with noise, or those without noise and a draw of it."""
    published = folder / f"experiment_unsupervised11_{law}_noise{noise}.npz"
    if draw == 0 and published.is_file():
        return dict(np.load(published))
    data = exact_data(folder, law)
    random = np.random.default_rng([draw, round(1e4 * noise), [*TRUTHS].index(law)])
    for name in ("f_reaction", "f_u"):
        exact = data[name]
        data[name] = exact + random.normal(0.0, noise * np.abs(exact).max(), exact.shape)
    return data


def main() -> None:
    """Run the study and print its tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?")
    folder = parser.parse_args().folder or cs.datasets.fetch("plate_fingerprint")
    mesh = plate_mesh(next(folder.glob("*plate*.msh")))
    rows, energies = [], []
    for law, family_only, noise in product(TRUTHS, (False, True), NOISES):
        truth = TRUTHS[law]
        if family_only and all(truth.values()):
            continue
        estimated = [name for name, value in truth.items() if value or family_only]
        unknown = {name: cs.Unknown(GUESS_PA) if name in estimated else 0.0 for name in truth} | {
            "gamma_r_s": 0.0,
            "gamma_m_1_s": 0.0,
        }
        found: list[Mapping[str, float]] = []
        ends: list[dict[str, tuple[float, float]]] = []
        begun_s = time.process_time()
        for draw in range(DRAWS if noise else 1):
            data = data_with_noise(folder, law, noise, draw)
            material = demiray_energy if law == "Demiray" else "mooney-rivlin"
            problem = cs.Problem([plate_experiment(mesh, material, data, noise)], unknown)
            solution = problem.solver()(problem.collocation())
            bars = uncertainty_at(solution.collocation, solution.z).estimates
            found.append({name: solution.parameters[name] for name in truth})
            ends.append({n: bars[n].statistical95 or (-np.inf, np.inf) for n in estimated})
            print(law, family_only, noise, found[-1], ends[-1], solution.status, file=sys.stderr)
        used_s = (time.process_time() - begun_s) / len(found)
        case = f"{law}{' (family)' if family_only else ''}, {100 * noise:g} %"
        for name in estimated:
            values = [each[name] for each in found]
            halves = [(high - low) / 2 for low, high in (each[name] for each in ends)]
            inside = [each[name][0] <= truth[name] <= each[name][1] for each in ends]
            spread = f" ({min(values):.4g} … {max(values):.4g})" if noise else ""
            rows.append(
                [
                    case,
                    name,
                    f"{truth[name]:g}",
                    f"{np.median(values):.4g}{spread}",
                    f"{np.median(halves):.2g}",
                    f"{sum(inside)} of {len(inside)}",
                ]
            )
        errors = [energy_error(each, truth) for each in found]
        error = f"{100 * np.median(errors):.2g} % ({100 * max(errors):.2g} %)"
        energies.append([case, error, f"{used_s:.1f}"])
    print(markdown(HEADS, rows), markdown(ENERGY_HEADS, energies), sep="\n\n")


if __name__ == "__main__":
    main()
