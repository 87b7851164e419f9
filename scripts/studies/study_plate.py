"""A plate with a hole identified from displacements and two reactions, with known truth.

The data are simulated by FEniCSx in plane strain by the authors of "Material Fingerprinting" (MIT
licence). FOLDER has their `plate.msh` and `experiment_unsupervised11_LAW_noiseNOISE.npz`. The
triangles are extruded by one layer of tetrahedra with z held. Measured are the displacements of 11
nodes on the arc of the hole and the reactions of the left and of the lower side, in 11 equilibria.

    python scripts study_plate FOLDER
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Mapping
from itertools import product
from pathlib import Path

import casadi as ca
import meshio
import numpy as np
from numpy.typing import NDArray
from studies import markdown

import collocation_sysid as cs
from collocation_sysid.common.array_types import Array
from collocation_sysid.fem.meshes.mesh import TetMesh
from collocation_sysid.recording.grasp import Axes
from collocation_sysid.statistics.uncertainty import uncertainty_at

# Hole of this radius about (1, 1) in a unit plate; its thickness is that of one layer.
RADIUS = 0.3
THICKNESS = 0.05
STEPS = 11
NOISES = (0.0, 0.01)
# Initial guess of every constant.
GUESS_PA = 20.0
HEADS = [
    "law, noise",
    "constant",
    "truth",
    "estimate (95 %)",
    "error",
    "contains it",
    "sweeps",
    "CPU s",
]
# Law of this package, true constants and initial guesses, by the name in the file.
LAWS: dict[str, tuple[str, Mapping[str, float], Mapping[str, float]]] = {
    "NeoHooke": ("yeoh", {"kappa_pa": 40.0, "c10_pa": 10.0}, {"c20_pa": 0.0, "c30_pa": 0.0}),
    "MooneyRivlin": ("mooney-rivlin", {"kappa_pa": 40.0, "c10_pa": 10.0, "c01_pa": 40.0}, {}),
}


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
    mesh: TetMesh, law: str, data: Mapping[str, Array], noise: float
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
    relative = max(noise, 1e-3)
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


def main() -> None:
    """Run the study and print its table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    arguments = parser.parse_args()
    mesh = plate_mesh(arguments.folder / "plate.msh")
    rows = []
    for kind, noise in product(LAWS, NOISES):
        law, truth, fixed = LAWS[kind]
        path = arguments.folder / f"experiment_unsupervised11_{kind}_noise{noise}.npz"
        experiment = plate_experiment(mesh, law, dict(np.load(path)), noise)
        unknown = {name: cs.Unknown(GUESS_PA) for name in truth}
        undamped = {"gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
        problem = cs.Problem([experiment], {**unknown, **fixed, **undamped})
        begun_s = time.process_time()
        solution = problem.solver()(problem.collocation())
        bars = uncertainty_at(solution.collocation, solution.z)
        used_s = time.process_time() - begun_s
        for name, value in truth.items():
            found = solution.parameters[name]
            low, high = bars.estimates[name].statistical95 or (0.0, np.inf)
            rows.append(
                [
                    f"{kind}, {100 * noise:g} %",
                    name,
                    f"{value:g}",
                    f"{found:.4g} ({low:.4g} … {high:.4g})",
                    f"{100 * abs(found / value - 1):.2g} %",
                    "yes" if low <= value <= high else "no",
                    f"{solution.iterations}",
                    f"{used_s:.0f}",
                ]
            )
        print(rows[-len(truth) :], solution.status, file=sys.stderr, flush=True)
    print(markdown(HEADS, rows))


if __name__ == "__main__":
    main()
