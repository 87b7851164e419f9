"""Twins of tapered bars that an independent program simulates: 27-node hexahedra and the
generalized-α method (`hexahedral_bar`).

Constants, cross-section, motion and markers of each bar are drawn. Size, mass, clock, gravity, grip,
gradients and stiffness deviate from the description by random numbers with the default standard
deviations of the package. The recording has 0.5 s at 80 Hz with 0.3 mm of noise, and neither guesses
nor places of the markers. Simulations take minutes, so that their tracks are stored in `bars.npz`;
this command makes them anew:

    python scripts bar_twins
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hexahedral_bar
import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation
from script_arguments import require_no_arguments

import collocation_sysid as cs

LENGTH_M = 0.12
SAMPLE_S = 0.0125
DURATION_S = 0.5
POSE_STEP_S = 0.00625
T_S = SAMPLE_S * np.arange(round(DURATION_S / SAMPLE_S) + 1)
FILE = Path(__file__).with_name("bars.npz")
SEEDS = range(4)
# Time step of the simulation [s].
STEP_S = 0.003125
CONSTANTS = {"young_pa": "E", "poisson": "ν", "gamma_r_s": "γ_r", "gamma_m_1_s": "γ_m"}
DEGREE = np.pi / 180
# Standard deviations of the errors of the description: the defaults of the package.
DEVIATIONS = {
    "size": 0.01,
    "mass": 0.01,
    "time_shift_s": 5e-3,
    "clock_rate": 1e-4,
    "gravity_rad": DEGREE,
    "hand_eye_rad": 0.5 * DEGREE,
    "hand_eye_m": 1e-3,
    "grip_layer_m": 2e-4,
    "grasp_edge_m": 5e-4,
    "density_gradient": 0.05,
    "stiffness_gradient": 0.05,
    "stiffness_drift": 0.02,
}
COMPONENTS = {
    "gravity_rad": 2,
    "hand_eye_rad": 3,
    "hand_eye_m": 3,
    "density_gradient": 3,
    "stiffness_gradient": 3,
}


@dataclass(frozen=True)
class Twin:
    """True bar, motion and errors of a twin."""

    truth: dict[str, float]
    width_m: list[float]
    taper: list[float]
    errors: dict[str, Any]
    swing: dict[str, Any]
    marker_places: list[list[float]]
    noise_m: float


def draw(seed: int, exact: bool = False, poisson: float | None = None) -> Twin:
    """Draw a twin; `exact` makes all errors of the description zero."""
    rng = np.random.default_rng(seed)
    truth = {
        "young_pa": _log_uniform(rng, 5e3, 31e3),
        "poisson": float(rng.uniform(0.2, 0.45)),
        "gamma_r_s": _log_uniform(rng, 3e-3, 15e-3),
        "gamma_m_1_s": _log_uniform(rng, 0.3, 3.0),
        "density_kg_m3": _log_uniform(rng, 80.0, 400.0),
    }
    if poisson is not None:
        truth["poisson"] = poisson
    width_m = rng.uniform(0.024, 0.036, 2).tolist()
    taper = rng.uniform(0.0, 0.35, 2).tolist()
    errors = {
        name: (rng.standard_normal(COMPONENTS.get(name, 1)) * sigma * (not exact)).tolist()
        for name, sigma in DEVIATIONS.items()
    }
    swing = {
        "amplitude_m": rng.uniform(0.02, 0.05, 3).tolist(),
        "amplitude_rad": rng.uniform(0.15, 0.4, 3).tolist(),
        "frequency_hz": rng.uniform(1.0, 2.5, 6).tolist(),
        "phase": rng.uniform(0, 2 * np.pi, 6).tolist(),
        "tilt_rad": rng.uniform(-0.6, 0.6, 3).tolist(),
    }
    places = []
    for _ in range(rng.integers(6, 11)):
        place = [*rng.uniform(-1, 1, 2), rng.uniform(0.3, 1.0)]
        place[rng.integers(2)] = float(rng.choice([-1.0, 1.0]))
        places.append([float(value) for value in place])
    return Twin(truth, width_m, taper, errors, swing, places, 3e-4)


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def hand(twin: Twin, t_s: np.ndarray) -> tuple[Rotation, np.ndarray]:
    """Return rotations and positions (T, 3) [m] of the held end: a swing that begins smoothly."""
    t = np.maximum(t_s, 0.0)[:, None]
    rise = 1 - np.exp(-((t / 0.15) ** 3))
    swing = twin.swing
    waves = rise * np.sin(2 * np.pi * t * swing["frequency_hz"] + np.array(swing["phase"]))
    start = Rotation.from_rotvec(swing["tilt_rad"]) * Rotation.from_rotvec([np.pi, 0, 0])
    rotations = Rotation.from_rotvec(waves[:, 3:] * swing["amplitude_rad"]) * start
    return rotations, waves[:, :3] * swing["amplitude_m"]


def simulate(twin: Twin) -> tuple[np.ndarray, np.ndarray]:
    """Return the times and the marker positions (T, M, 3) of the true motion [m], extrapolated to
    infinitely small elements and time steps.

    With two elements across and eight along the bar its tracks are up to 4 mm off, more than the
    noise: the error decreases with the square of the length of the elements and of the time step.
    """
    t_s = STEP_S * np.arange(round((DURATION_S + 0.03) / STEP_S) + 1)
    between_s = np.sort(np.append(t_s, t_s[:-1] + STEP_S / 2))
    coarse_m = _simulated(twin, (3, 3, 16), t_s)
    fine_m = _simulated(twin, (3, 3, 24), t_s)
    few_steps_m = _simulated(twin, (2, 2, 12), t_s)
    many_steps_m = _simulated(twin, (2, 2, 12), between_s)
    by_elements_m = (fine_m - coarse_m) / ((24 / 16) ** 2 - 1)
    by_steps_m = (many_steps_m[::2] - few_steps_m) * 4 / 3
    return t_s, fine_m + by_elements_m + by_steps_m


def _simulated(twin: Twin, divisions: tuple[int, int, int], t_s: np.ndarray) -> np.ndarray:
    errors = {name: np.array(values) for name, values in twin.errors.items()}
    edge_m = errors["grasp_edge_m"][0] - abs(errors["grip_layer_m"][0])
    bar = hexahedral_bar.Bar(
        length_m=LENGTH_M,
        start_m=edge_m,
        width_m=twin.width_m,
        taper=twin.taper,
        scale=1 + errors["size"][0],
        divisions=divisions,
        truth=twin.truth,
        density_gradient=twin.errors["density_gradient"],
        stiffness_gradient=twin.errors["stiffness_gradient"],
        drift=errors["stiffness_drift"][0],
        drift_s=DURATION_S,
    )
    grip = Rotation.from_rotvec(errors["hand_eye_rad"])

    def motion(t_s):
        rotations, positions = hand(twin, t_s)
        return rotations * grip, positions + rotations.apply(errors["hand_eye_m"])

    tilt = Rotation.from_rotvec([*errors["gravity_rad"], 0.0])
    gravity = tilt.apply([0.0, 0.0, -9.81])
    places = bar.interpolation(twin.marker_places)
    return bar.simulate(t_s, motion, gravity, places)


def mesh_of(twin: Twin, divisions: tuple[int, int, int]) -> cs.TetMesh:
    """Return a mesh of the bar as its description states it, with so many boxes along the edges."""
    box = cs.box_mesh((1.0, 1.0, LENGTH_M), divisions, (-0.5, -0.5, 0.0))
    points_m = np.array(box.points_m)
    points_m[:, :2] *= section_m(twin, points_m[:, 2] / LENGTH_M)
    return cs.TetMesh(points_m, box.tetrahedra)


def section_m(twin: Twin, along: np.ndarray) -> np.ndarray:
    """Return the widths (n, 2) [m] of the cross-section at shares (n,) of the length."""
    return (1 - np.outer(along, twin.taper)) * twin.width_m


def recorded_m(twin: Twin) -> np.ndarray:
    """Return the tracks (T, M, 3) [m] that cameras with a late clock record, without noise."""
    fine_s, exact_m = simulate(twin)
    late_s, rate = twin.errors["time_shift_s"][0], twin.errors["clock_rate"][0]
    return CubicSpline(fine_s, exact_m)(np.clip(T_S * (1 + rate) - late_s, 0.0, fine_s[-1]))


def problem(seed: int, across: int = 2) -> cs.Problem:
    """Return the problem of a stored twin, with so many tet10 elements across the thickness."""
    twin = draw(seed)
    with np.load(FILE) as stored:
        tracks_m = stored[str(seed)].astype(float)
    rng = np.random.default_rng((seed, 1))
    markers = cs.Markers(T_S, tracks_m + twin.noise_m * rng.standard_normal(tracks_m.shape), 3e-4)
    mesh = mesh_of(twin, (across, across, 5))
    size, mass = 1 + twin.errors["size"][0], 1 + twin.errors["mass"][0]
    mass_kg = twin.truth["density_kg_m3"] * mesh.volume_m3 * size**3 / mass
    body = cs.Body(mesh, mass_kg=mass_kg, element="tet10", rest_shape="stress_free")
    pose_s = POSE_STEP_S * np.arange(round(DURATION_S / POSE_STEP_S) + 1)
    rotations, positions_m = hand(twin, pose_s)
    poses = cs.PoseSequence(pose_s, positions_m, rotations.as_quat())
    grasp = cs.Grasp(cs.Box((-1, -1, -1e-6), (1, 1, 1e-6)), poses)
    swing = cs.Experiment(body, T_S, [grasp], markers, name="swing", air_density_kg_m3="none")
    return cs.Problem([swing], {name: cs.Unknown() for name in CONSTANTS})


def main() -> None:
    require_no_arguments(__doc__)
    tracks: dict[str, Any] = {
        str(seed): recorded_m(draw(seed)).astype(np.float32) for seed in SEEDS
    }
    np.savez_compressed(FILE, **tracks)


if __name__ == "__main__":
    main()
