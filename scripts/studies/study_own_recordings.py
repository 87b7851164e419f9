"""Starts of searches for recordings as users make them: rest first and last, errors of pose and clock.

A hanging bar of 110 x 20 x 20 mm rests for 0.4 s, is shaken for 0.5 s, swings out and rests again. It
is simulated on a finer mesh than that of the fit. The stated pose of each camera is off by 1° and
5 mm, the frame of the markers by 1°, and clocks by 20 ms. Bodies differ by a factor of 1,000 in
stiffness; guesses are near, far, none, or bounds alone.

    python scripts study_own_recordings [--only finger soft-cast] [--keep FOLDER]

`--keep` stores the simulated recordings in a folder, and uses those that are there. With `--starts N`,
each case is solved from N random guesses of the stiffness, 0.03 to 30 times the truth, instead; a start
succeeds within 1 % or half a standard error of the answer from the truth.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from depth_twins import MATRIX as DEPTH_MATRIX
from depth_twins import SHAPE_PX, upright_pose
from filmed_twins import DISTORTION, MATRIX, SIZE_PX
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation
from script_arguments import make_parser

import collocation_sysid as cs
from collocation_sysid.common.array_types import Array
from collocation_sysid.program.depth.visible_surface import VisibleSurface
from collocation_sysid.recording import Depth, DepthCamera
from collocation_sysid.recording.depth_camera import depth_image
from collocation_sysid.statistics.pose_noise import uncertainty_at

SIZE_M = (0.02, 0.02, 0.11)
FIT, SIMULATED = (2, 2, 4), (4, 4, 8)
END_S, REST_S, SHAKEN_S, LATE_S = 1.3, 0.4, 0.5, 0.02
NOISE_PX, NOISE_M, DEPTH_NOISE_M = 0.3, 2e-4, 5e-4
HANGING = Rotation.from_euler("x", 180, degrees=True)
EYES_M = {"front": np.array([0.02, -0.42, -0.04]), "side": np.array([0.40, -0.08, -0.02])}
HEIGHTS_M = (0.015, 0.04, 0.06, 0.08, 0.1)
PLACES_M = {
    "front": [(x, 0.02, z) for x in (0.004, 0.015) for z in HEIGHTS_M],
    "side": [(0.02, y, z) for y in (0.004, 0.015) for z in HEIGHTS_M],
}


@dataclass(frozen=True)
class Case:
    """One recording, and what is stated of the stiffness."""

    young_pa: float
    made: Literal["cast", "foam"]
    rate_hz: float
    stated: cs.Unknown
    seen_by: str = "front"  # cameras, "markers" or "depth"
    density_kg_m3: float = 1070.0
    log_hz: float = 160.0

    @property
    def truth(self) -> dict[str, float]:
        """Return the true constants."""
        damping_s = 2e-3 * (1.5e5 / self.young_pa) ** 0.5
        poisson = 0.45 if self.made == "cast" else 0.3
        return {
            "young_pa": self.young_pa,
            "poisson": poisson,
            "gamma_r_s": damping_s,
            "gamma_m_1_s": 0.0,
        }


CASES = {
    "soft-cast": Case(5e3, "cast", 30, cs.Unknown(8e3), log_hz=80.0),
    "soft-unguessed": Case(1.5e4, "cast", 60, cs.Unknown(), "front side"),
    "finger": Case(1.5e5, "cast", 60, cs.Unknown(2e5)),
    "finger-unguessed": Case(1.5e5, "cast", 60, cs.Unknown()),
    "finger-bounds": Case(1.5e5, "cast", 30, cs.Unknown(lower=5e4, upper=1e6), "front side"),
    "far-guess": Case(3e5, "cast", 120, cs.Unknown(1e4)),
    "stiff-cast": Case(5e6, "cast", 120, cs.Unknown(), "front side", log_hz=240.0),
    "light-foam": Case(2e4, "foam", 30, cs.Unknown(), density_kg_m3=80.0),
    "stiff-foam": Case(2e5, "foam", 120, cs.Unknown(1e6), density_kg_m3=200.0),
    "markers": Case(5e5, "cast", 120, cs.Unknown(), "markers", log_hz=120.0),
    "depth": Case(8e4, "cast", 30, cs.Unknown(), "depth"),
}


# Recordings ---------------------------------------------------------------------------------------


def bar(case: Case, divisions: tuple[int, int, int]) -> cs.Body:
    """Return the bar with so many elements along its edges."""
    mesh, density = cs.box_mesh(SIZE_M, divisions), case.density_kg_m3
    return cs.Body(mesh, density_kg_m3=density, element="tet10-p0", made=case.made, mesh_from="cad")


def times(step_s: float) -> Array:
    """Return the times of the robot's log [s]."""
    return np.arange(0.0, END_S + LATE_S + step_s, step_s)


def experiment(body: cs.Body, step_s: float, **seen) -> cs.Experiment:
    """Return the recording of a body with instruments `seen`, at the times of the robot's log."""
    t_s = times(step_s)
    share = np.sin(np.pi * np.clip((t_s - REST_S) / SHAKEN_S, 0, 1)) ** 2
    angle = 6 * np.pi * (t_s - REST_S)
    turns = Rotation.from_rotvec(np.outer(share * np.sin(angle), [0.15, 0.1, 0.2])) * HANGING
    shifts = np.column_stack([np.sin(angle), 0.6 * np.sin(1.3 * angle), 0.3 * np.sin(angle)])
    poses = cs.PoseSequence(t_s, 0.02 * share[:, None] * shifts, turns.as_quat())
    held = np.flatnonzero(body.nodes_m[:, 2] < 1e-9)
    return cs.Experiment(body, t_s, [cs.Grasp(held, poses)], **seen)


def pose_of(name: str) -> Array:
    """Return the true pose (4, 4) of a camera."""
    ahead = np.array([0.01, -0.01, -0.055]) - EYES_M[name]
    return upright_pose(EYES_M[name], ahead / np.linalg.norm(ahead))


def wrong(pose: Array, rng: np.random.Generator) -> Array:
    """Return a pose (4, 4) with an error of 1° and 5 mm in random directions."""
    turn, shift = (axis / np.linalg.norm(axis) for axis in rng.normal(size=(2, 3)))
    turned = pose.copy()
    turned[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(np.deg2rad(1.0) * turn).as_matrix()
    turned[:3, 3] += 5e-3 * shift
    return turned


def tracks(
    case: Case, name: str, late_s: float, pixels: Array | None, pose: Array
) -> cs.ImageTracks:
    """Return the tracks of a camera, without places if they have pixels."""
    points = [f"{name}_{k}" for k in range(len(PLACES_M[name]))]
    return cs.ImageTracks(
        name,
        cs.Camera(MATRIX, DISTORTION, pose, size_px=SIZE_PX),
        late_s + np.arange(0.0, END_S, 1 / case.rate_hz),
        pixels,
        points,
        places_m=PLACES_M[name] if pixels is None else None,
        sigma_px=NOISE_PX,
        clock_sigma_s=LATE_S,
    )


def markers(step_s: float, positions_m: Array | None = None) -> cs.Markers:
    """Return markers on the front, at the times of the robot's log."""
    t_s = times(step_s)
    positions_m = np.zeros((len(t_s), 10, 3)) if positions_m is None else positions_m
    return cs.Markers(t_s, positions_m, NOISE_M, places_m=PLACES_M["front"])


def images(case: Case, body: cs.Body, positions_m: Array, t_s: Array) -> tuple[Array, Array]:
    """Return depth images (S, rows, columns) [m] without noise, and the indices of their samples."""
    samples = np.searchsorted(t_s, LATE_S + np.arange(0.0, END_S, 3 / case.rate_hz))
    pose = pose_of("front")
    blank = Depth("none", t_s[samples], [np.zeros((1, 3))] * len(samples), DEPTH_NOISE_M)
    surface = VisibleSurface.from_body(body, blank)
    shapes = [surface.subdivided_triangles(positions_m[k][surface.nodes]) for k in samples]
    camera = DepthCamera(DEPTH_MATRIX, pose=pose)
    in_camera = [(each - pose[:3, 3]) @ pose[:3, :3] for each in shapes]
    return np.array([depth_image(camera, SHAPE_PX, each) for each in in_camera]), t_s[samples]


def simulated(name: str, keep: Path | None) -> list[Array]:
    """Return what the instruments of a case measure without noise."""
    case = CASES[name]
    file = keep and keep / f"{name}.npz"
    if file and file.exists():
        return [*np.load(file).values()]
    body = bar(case, SIMULATED)
    cameras = [each for each in case.seen_by.split() if each in EYES_M]
    readings = [tracks(case, each, LATE_S, None, pose_of(each)) for each in cameras]
    step_s = 1 / 240
    t_s = times(step_s)
    nothing = Depth("none", t_s, [np.zeros((1, 3))] * len(t_s), DEPTH_NOISE_M)
    without = {"markers": {"markers": markers(step_s)}, "depth": {"depths": [nothing]}}
    made = experiment(body, step_s, readings=readings, **without.get(case.seen_by, {}))
    run = cs.simulate(made, case.truth, "midpoint", substeps=1)
    if cameras:
        numbers = [each.reshape(len(each), -1, 2) for each in run.custom_sensor_values]
    elif case.seen_by == "markers":
        late = CubicSpline(t_s, run.markers_m, extrapolate=False)
        numbers = [late(LATE_S + times(1 / case.log_hz))]
    else:
        numbers = [*images(case, body, run.positions_m, t_s)]
    if file:
        np.savez(file, *numbers)
    return numbers


def problem(name: str, keep: Path | None = None) -> cs.Problem:
    """Return the problem of a case, with noise and the errors of poses and clocks."""
    case = CASES[name]
    rng = np.random.default_rng(1 + [*CASES].index(name))
    numbers = simulated(name, keep)
    unknown = {**case.truth, "young_pa": case.stated, "gamma_r_s": cs.Unknown()}
    body = bar(case, FIT)
    if case.seen_by == "markers":
        turned = wrong(np.eye(4), rng)[:3, :3]
        positions_m = (numbers[0] + NOISE_M * rng.normal(size=numbers[0].shape)) @ turned.T
        nuisance = cs.Nuisance(time_shift_s=LATE_S)
        seen = {"markers": markers(1 / case.log_hz, positions_m), "nuisance": nuisance}
    elif case.seen_by == "depth":
        noisy_m = numbers[0] + DEPTH_NOISE_M * rng.normal(size=numbers[0].shape)
        camera = DepthCamera(DEPTH_MATRIX, pose=wrong(pose_of("front"), rng))
        depth = Depth.of_images("front", noisy_m, camera, DEPTH_NOISE_M, numbers[1] - LATE_S)
        nuisance = cs.Nuisance(depth_time_s=LATE_S, depth_turn_rad=0.02, depth_shift_m=5e-3)
        seen = {"depths": [depth], "nuisance": nuisance}
    else:
        names = case.seen_by.split()
        noisy = [each + NOISE_PX * rng.normal(size=each.shape) for each in numbers]
        poses = [wrong(pose_of(each), rng) for each in names]
        pairs = zip(names, noisy, poses, strict=True)
        seen = {"readings": [tracks(case, each, 0.0, px, pose) for each, px, pose in pairs]}
    return cs.Problem([experiment(body, 1 / case.log_hz, **seen)], unknown)


# Studies ------------------------------------------------------------------------------------------


def answer_of(name: str, keep: Path | None) -> str:
    """Return value, interval and verdict of one case as a row of a table."""
    described, true_pa = problem(name, keep), CASES[name].young_pa
    began = time.process_time()
    run = cs.run(described, seek_causes=False)
    spent_s = time.process_time() - began
    value, (low, high) = run.estimates["young_pa"].value, run.interval("young_pa")
    inside = "yes" if low <= true_pa <= high else "no"
    cells = [f"{true_pa:.3g}", f"{value:.4g}", f"{low:.3g} to {high:.3g}", inside]
    notes = "; ".join(run.trust.reasons[:2])[:160]
    return f"| {name} | {' | '.join(cells)} | {run.trust.verdict} | {spent_s:.0f} | {notes}"


def from_random_starts(name: str, count: int, keep: Path | None) -> str:
    """Return how many searches from random guesses of the stiffness find the answer from the truth."""
    described, case = problem(name, keep), CASES[name]

    def solved(young_pa: float) -> cs.Solution:
        guessed = described.parameters.with_guess({"young_pa": young_pa})
        return cs.solve(replace(described, parameters=guessed))

    best = solved(case.young_pa)
    interval = uncertainty_at(best.collocation, best.z).estimates["young_pa"].statistical95
    allowed = 0.01 if interval is None else max(0.01, np.log(interval[1] / interval[0]) / 8)
    factors = 30.0 ** np.random.default_rng(0).uniform(-1, 1, count)
    failures, began = [], time.process_time()
    for factor in factors:
        found = solved(factor * case.young_pa)
        ratio = found.parameters["young_pa"] / best.parameters["young_pa"]
        is_better = found.history[-1].loss < best.history[-1].loss
        if not (found.status.converged and (abs(np.log(ratio)) < allowed or is_better)):
            failures.append(f"{factor:.3g} -> {ratio:.3g} ({found.status.value})")
    each_s = (time.process_time() - began) / count
    missed = f"; missed: {', '.join(failures)}" if failures else ""
    return f"{name}: {count - len(failures)} of {count}, {each_s:.1f} CPU s each{missed}"


def main() -> None:
    """Print one line for each case."""
    parser = make_parser(__doc__)
    parser.add_argument("--only", nargs="*", default=list(CASES), choices=list(CASES))
    parser.add_argument("--starts", type=int, default=0)
    parser.add_argument("--keep", type=Path)
    options = parser.parse_args()
    for name in options.only:
        if options.starts:
            print(from_random_starts(name, options.starts, options.keep), flush=True)
            continue
        print(answer_of(name, options.keep), flush=True)


if __name__ == "__main__":
    main()
