"""Effect of a wrong damping law on the estimates: bars swung at increasing speed, fitted with two
laws.

The tracks are simulated with the Kelvin–Voigt law and the midpoint rule, with noise. The same
recording is fitted with this law and with Rayleigh's, which also damps the rotation of a stretched
body. Errors are in standard errors of the fit; the verdict is that of the run.

    python scripts study_damping
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from collocation_sysid import run
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.model.parameters import Unknown
from collocation_sysid.problem import Problem
from collocation_sysid.program.simulation import simulate, with_markers
from collocation_sysid.recording import Experiment, Grasp, Markers, Nuisance, PoseSequence

# Edges [m], numbers of elements and density of the foam bar.
SIZE_M = (0.03, 0.03, 0.15)
DIVISIONS = (1, 1, 5)
DENSITY_KG_M3 = 100.0
TRUTH = {"lambda_pa": 16e3, "mu_pa": 12e3, "gamma_r_s": 0.006, "gamma_m_1_s": 0.5}
GUESS = {name: Unknown(guess=1.5 * value) for name, value in TRUTH.items()}
# Sampling interval and duration of the recording [s].
STEP_S = 0.005
TIME_S = 1.5
# Standard deviation of each marker coordinate [m].
NOISE_M = 3e-4
# Frequency of the rotation [Hz].
TURN_HZ = 1.5
LAWS = ("kelvin-voigt", "rayleigh")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--speeds", type=float, nargs="*", default=[2.0, 5.0, 14.0], help="rad/s")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    for speed in arguments.speeds:
        measured = swung_recording(speed, arguments.seed)
        for law in LAWS:
            print(f"{speed:4.1f} rad/s, fitted with {law}: {fit_report(measured, law)}", flush=True)


def swung_recording(speed_rad_s: float, seed: int) -> Experiment:
    """Return a noisy recording of a bar, clamped at one end and turned to and fro about two axes.

    `speed_rad_s` is the largest angular speed about the first axis.
    """
    t_s = STEP_S * np.arange(round(TIME_S / STEP_S) + 1, dtype=np.float64)
    angle = speed_rad_s / (2 * np.pi * TURN_HZ) * (1 - np.cos(2 * np.pi * TURN_HZ * t_s))
    tilt = 0.5 * np.sin(2 * np.pi * 1.1 * t_s) ** 2
    rotations = Rotation.from_rotvec(np.outer(angle, [1, 0, 0]) + np.outer(tilt, [0, 1, 0]))
    body = bar("kelvin-voigt")
    clamped_nodes = np.flatnonzero(body.nodes_m[:, 2] < 1e-9)
    places = body.nodes_m[body.nodes_m[:, 2] > 0.05][::3]
    markers = Markers(t_s, np.zeros((len(t_s), len(places), 3)), NOISE_M, places_m=places)
    poses = PoseSequence(t_s, np.zeros((len(t_s), 3)), rotations.as_quat())
    experiment = Experiment(
        body, t_s, [Grasp(clamped_nodes, poses)], markers, name="swing", nuisance=Nuisance.none()
    )
    tracks = simulate(experiment, TRUTH, "midpoint", substeps=1).markers_m
    noise = np.random.default_rng(seed).normal(scale=NOISE_M, size=tracks.shape)
    return with_markers(experiment, tracks + noise)


def bar(law: str) -> Body:
    """Return a foam bar with a damping law."""
    return Body(box_mesh(SIZE_M, DIVISIONS), density_kg_m3=DENSITY_KG_M3, damping=law)


def fit_report(measured: Experiment, law: str) -> str:
    """Fit a recording with a damping law, and return its errors in one line, then the verdict."""
    body = bar(law)
    markers = replace(measured.markers, placement=None)
    answer = run(Problem([replace(measured, body=body, markers=markers)], GUESS, substeps=1))
    errors = []
    for name, truth in TRUTH.items():
        estimate = answer.estimates[name]
        errors.append(f"{name} {100 * (estimate.value / truth - 1):+.1f} %")
        if estimate.statistical_std_error:
            errors[-1] += f" ({(estimate.value - truth) / estimate.statistical_std_error:+.1f} σ)"
    lines = [", ".join(errors), f"verdict {answer.trust.verdict}", *answer.trust.reasons]
    return "\n    ".join([*lines, *answer.all_notes])


if __name__ == "__main__":
    main()
