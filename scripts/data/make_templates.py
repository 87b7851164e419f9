"""Make the simulated, noisy recordings of the templates of `collocation-sysid new --kind`.

Poses and forces come from midpoint simulations and equilibria at `YOUNG_PA` or `SWUNG`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from script_arguments import require_no_arguments

from collocation_sysid.common.array_types import Array
from collocation_sysid.common.files import write_text_file
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.meshes.selection import Box
from collocation_sysid.fem.meshes.structured import cylinder_of_edge
from collocation_sysid.problem import Problem
from collocation_sysid.problem.new import TEMPLATES
from collocation_sysid.program.simulation import simulate
from collocation_sysid.recording import (
    Experiment,
    Grasp,
    Markers,
    PoseSequence,
    write_markers_csv,
    write_poses_csv,
)
from collocation_sysid.recording.writers import write_columns_csv

# True Young's modulus of the bench tests, and shear modulus of the specimen [Pa].
YOUNG_PA = 8e4
SHEAR_MODULUS_PA = 1e5
# Standard deviation of the stress of the specimen [Pa]: one percent of the largest stress.
STRESS_NOISE_PA = 1e3
# True constants of the swung cylinder.
SWUNG = {"young_pa": 8000.0, "poisson": 0.3, "gamma_r_s": 0.005, "gamma_m_1_s": 1.0}
# True constants of the cable, and the seed of its noise.
CABLE = {"bending_n_m2": 1e-3, "gamma_r_s": 2e-3, "gamma_m_1_s": 0.3}
CABLE_SEED = 1
# Seeds of the noise. With seed 1, an estimate of the swing is 2.6 standard errors from the truth,
# which is rare. With ten other seeds, the root mean square of errors over standard errors is 0.85
# to 1.1, and the combined intervals contain the truth. The example for new users is one of these
# ten, with the verdict "good".
SWING_SEED = 109
BENCH_SEED = 1
# Rendered video: images, their rate, tracked points, and seed of the errors of the camera.
VIDEO_IMAGES, VIDEO_HZ, VIDEO_POINTS, VIDEO_SEED = 84, 60, 16, 5
# Noise that is added to the tracked pixels, because rendered images are tracked more precisely than
# those of cameras.
VIDEO_NOISE_PX = 0.1


def swing(folder: Path) -> None:
    """Write the recording of a foam cylinder that hangs from a gripper and is moved to and fro."""
    mesh = cylinder_of_edge(0.05, 0.15, 0.025)
    body = Body(mesh, mass_kg=0.1)
    t_s = np.arange(81) * np.float64(0.01)
    hanging_quaternion = Rotation.from_euler("x", 180, degrees=True).as_quat()
    shift_m = 0.03 * np.outer(1 - np.cos(7 * t_s), [1, 0, 0]) + 0.02 * np.outer(
        np.sin(11 * t_s) ** 2, [0, 1, 0]
    )
    poses = PoseSequence(t_s, shift_m, np.tile(hanging_quaternion, (len(t_s), 1)))
    places_m = np.array([[25, 0, 60], [0, 25, 105], [25, 0, 150], [-25, 0, 150]]) / 1000
    markers = Markers(t_s, np.zeros((len(t_s), 4, 3)), 1e-3, places_m=places_m)
    grasp = Grasp(Box((-1, -1, -1e-3), (1, 1, 1e-3)), poses)
    experiment = Experiment(body, t_s, [grasp], markers, air_density_kg_m3="none")
    tracks_m = simulate(experiment, SWUNG).markers_m
    tracks_m = tracks_m + np.random.default_rng(SWING_SEED).normal(scale=1e-3, size=tracks_m.shape)
    mesh.write(folder / "body.vtu")
    write_poses_csv(folder / "poses.csv", poses)
    write_markers_csv(folder / "markers.csv", t_s, ["low", "middle", "end_1", "end_2"], tracks_m)


def compression(folder: Path) -> None:
    """Write the table of a cylinder that a machine compresses by 20 %; compression is positive."""
    t_s = np.arange(0.0, 60.5, 0.5)
    header = "Time (s),Displacement (mm),Force (N)"
    write_bench_table(folder, header, t_s, 0.1 * t_s, noise=0.1, scale=-4.0)


def tension(folder: Path) -> None:
    """Write the table of a bar that is extended by 30 %, in strain and stress."""
    t_s = np.arange(0.0, 60.5, 0.5)
    header = "Time (s),Strain (%),Stress (kPa)"
    area_m2 = 2.56e-4
    write_bench_table(folder, header, t_s, 0.5 * t_s, noise=0.02e-3 / area_m2, scale=4e-3 / area_m2)


def write_bench_table(
    folder: Path, header: str, t_s: Array, displacement_column: Array, noise: float, scale: float
) -> None:
    """Write the table of a test bench, with simulated forces or stresses."""
    file = folder / "run_1.csv"

    def write(measured: Array) -> None:
        rows = [
            f"{t:.1f},{m:.4f},{f:.4f}"
            for t, m, f in zip(t_s, displacement_column, measured, strict=True)
        ]
        write_text_file(file, "\n".join([header, *rows, ""]))

    write(np.zeros(len(t_s)))
    truth_override = [f"parameters.young_pa.guess={YOUNG_PA}"]
    problem = Problem.read(folder / "problem.toml", truth_override, simulation=True)
    (experiment,) = problem.experiments
    (reaction,) = simulate(experiment, problem.parameters).wrenches
    write(
        scale * reaction[:, 2]
        + np.random.default_rng(BENCH_SEED).normal(scale=noise, size=len(t_s))
    )


def specimen(folder: Path) -> None:
    """Write the table of a rubber strip at stretches up to 1.5: stretch and engineering stress."""
    stretch = np.linspace(1.02, 1.5, 25)
    # Stress of an incompressible neo-Hookean material.
    stress_pa = SHEAR_MODULUS_PA * (stretch - stretch**-2)
    stress_pa += np.random.default_rng(BENCH_SEED).normal(scale=STRESS_NOISE_PA, size=len(stretch))
    rows = [
        f"{each:.3f},{1e-3 * stress:.4f}" for each, stress in zip(stretch, stress_pa, strict=True)
    ]
    write_text_file(folder / "pull.csv", "\n".join(["stretch,stress (kPa)", *rows, ""]))


def video(folder: Path) -> None:
    """Write the tracks of a rendered video of a foam bar, its calibration, and the stated pose of
    the camera.
    """
    import rendered_video

    rendered_video.mesh(rendered_video.COARSE).write(folder / "body.vtu")
    write_poses_csv(folder / "poses.csv", rendered_video.poses(np.arange(-3.0, 156.0) * 0.01))
    shape = rendered_video.motion(rendered_video.surface()[0])
    t_s = np.arange(VIDEO_IMAGES) / VIDEO_HZ
    described = rendered_video.film(folder, "front", shape, t_s, VIDEO_SEED, VIDEO_POINTS)
    add_noise(folder / "front.csv")
    for name in ("front.mp4", "mask.png"):
        (folder / name).unlink()
    file = folder / "problem.toml"
    lines = file.read_text(encoding="utf-8").splitlines()
    k = next(k for k, line in enumerate(lines) if line.startswith("pose = "))
    _, _, comment = lines[k].partition("#")
    lines[k] = f"pose = {rendered_video.pose_text(described.pose)}   #{comment}"
    write_text_file(file, "\n".join([*lines, ""]))


def add_noise(file: Path) -> None:
    """Add noise to the pixels of a table of tracks."""
    rng = np.random.default_rng(VIDEO_SEED)
    head, *rows = (line.split(",") for line in file.read_text(encoding="utf-8").splitlines())
    for row in rows:
        for k, name in enumerate(head):
            if name.endswith(("_u", "_v")):
                row[k] = f"{float(row[k]) + VIDEO_NOISE_PX * rng.normal():.3f}"
    write_text_file(file, "\n".join([*map(",".join, [head, *rows]), ""]))


def cable(folder: Path) -> None:
    """Write the recording of a cable that hangs from a gripper and is moved to and fro."""
    t_s = np.arange(151) * np.float64(0.01)
    grown = np.minimum(1.0, t_s / 0.5)
    shift_m = np.outer(0.1 * grown * (1 - np.cos(7 * t_s)), [0, 0, 1])
    shift_m += np.outer(0.06 * grown * np.sin(5 * t_s), [0, 1, 0])
    poses = PoseSequence(t_s, shift_m, np.tile([0.0, 0, 0, 1], (len(t_s), 1)))
    write_poses_csv(folder / "poses.csv", poses)
    stated = {**CABLE, "torsion_n_m2": 3e-4, "axial_n": 200.0}
    finer = ["object.sections=81"]  # the data of a real cable have no error of a mesh
    problem = Problem.read(folder / "problem.toml", finer, simulation=True)
    motion = simulate(problem.experiments[0], stated)
    rng = np.random.default_rng(CABLE_SEED)
    tracks_m = motion.markers_m + rng.normal(scale=5e-4, size=motion.markers_m.shape)
    write_markers_csv(folder / "markers.csv", t_s, ["middle", "tip"], tracks_m)
    (wrench,) = motion.wrenches
    noise = np.repeat([0.01, 0.001], 3) * rng.normal(size=(len(t_s), 6))
    names = ("fx_n", "fy_n", "fz_n", "tx_nm", "ty_nm", "tz_nm")
    columns = dict(zip(names, (wrench + noise).T, strict=True))
    write_columns_csv(folder / "wrench.csv", {"t_s": t_s, **columns})


KINDS = {"swing": swing, "compression": compression, "tension": tension, "specimen": specimen}

if __name__ == "__main__":
    require_no_arguments(__doc__)
    for kind, write in (KINDS | {"video": video, "cable": cable}).items():
        write(TEMPLATES / kind)
