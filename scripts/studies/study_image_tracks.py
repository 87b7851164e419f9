"""Coverage and accuracy of constants from image tracks of one, two and three cameras, for twins.

A bar of 120 x 30 x 20 mm is swung at one end for 0.4 s and filmed at 100 Hz. Seven points are
tracked with 0.5 pixels of noise. Poses, focal lengths, principal points and clocks of the cameras,
and the places of the points, have errors that are drawn from their priors. The last row is motion
capture of the same points with 0.5 mm of noise and places of the same accuracy. Pixels are
projected here, without the package's model of tracks.

With `--judged` the bar is simulated by `hexahedral_bar`, described with quadratic elements, and
judged by a complete run: the tables have the verdicts and the combined intervals. With `--below` the
first camera is below the bar and sees points of its lower face.

    python scripts study_image_tracks [--twins 24] [--first 0] [--places known|unknown]
        [--turn-deg 1] [--shift-m 0.005] [--focal 0.005] [--centre-px 2] [--outliers 0]
        [--rate-hz 100] [--cameras 1,2,3,0] [--constants young_pa,gamma_r_s]
    python scripts study_image_tracks --judged --twins 20 --cameras 1 --places unknown
        --focal 0.01 --turn-deg 2 [--below]
"""

from __future__ import annotations

import argparse
import time
from functools import cache, partial

import hexahedral_bar
import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation
from script_arguments import make_parser
from study_independent_twins import compare, line, table

import collocation_sysid as cs
from collocation_sysid.statistics.pose_noise import uncertainty_at

TRUTH = {"young_pa": 1.5e5, "poisson": 0.45, "gamma_r_s": 2e-3, "gamma_m_1_s": 0.1}
GUESSES = {"young_pa": 1e5, "poisson": 0.4, "gamma_r_s": 4e-3, "gamma_m_1_s": 0.2}
MATRIX = np.array([[900.0, 0.0, 640.0], [0.0, 905.0, 360.0], [0.0, 0.0, 1.0]])
DISTORTION = [-0.1, 0.02, 1e-3, -5e-4, 0.0]
# Cameras, in the order in which they are added [m], and the point at which they look.
EYES_M = {"front": (0.06, -0.45, 0.1), "side": (0.5, -0.15, 0.15), "top": (0.05, 0.1, 0.55)}
MIDDLE_M = np.array([0.06, 0.015, 0.0])
# Normals of the faces of the bar that cameras see, and points on them.
FRONT, END, TOP = (0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)
PLACES_M = {
    "tip_front": ((0.115, 0.0, 0.012), FRONT),
    "tip_end": ((0.12, 0.016, 0.008), END),
    "tip_top": ((0.108, 0.012, 0.02), TOP),
    "middle_front": ((0.07, 0.0, 0.006), FRONT),
    "middle_top": ((0.066, 0.02, 0.02), TOP),
    "near_front": ((0.035, 0.0, 0.014), FRONT),
    "near_top": ((0.04, 0.01, 0.02), TOP),
}
NAMES = tuple(PLACES_M)
STATED_M = np.array([place for place, _ in PLACES_M.values()])
NORMALS = np.array([normal for _, normal in PLACES_M.values()])
T_S = 0.01 * np.arange(41)
# The true motion begins before and ends after the images, for delays.
LONG_S = 0.01 * np.arange(-3, 45)
NOISE_PX = 0.5
NOISE_M = 5e-4
PLACE_M = 1e-3
DELAY_S = 5e-3
OUTLIER_PX = 30.0

DENSITY_KG_M3 = 1070.0
BODY = cs.Body(cs.box_mesh((0.12, 0.03, 0.02), (4, 1, 1)), density_kg_m3=DENSITY_KG_M3)
BELOW_M = (0.05, -0.1, -0.5)
# Boxes along x, y and z of the quadratic elements of a description, time step [s] and elements along
# the sides of the independent simulation, whose bar lies along z.
JUDGED_DIVISIONS = (6, 1, 1)
SIMULATED_STEP_S = 0.0025
COARSE_DIVISIONS, FINE_DIVISIONS = (2, 2, 16), (3, 3, 24)


@cache
def judged_body() -> cs.Body:
    """Return the body of a description with `--judged`."""
    mesh = cs.box_mesh((0.12, 0.03, 0.02), JUDGED_DIVISIONS)
    return cs.Body(mesh, density_kg_m3=DENSITY_KG_M3, element="tet10", rest_shape="stress_free")


@cache
def independent_motion(divisions: tuple[int, int, int]) -> tuple[hexahedral_bar.Bar, CubicSpline]:
    """Return the bar of the other program and the positions (n, 3) [m] of its nodes over time."""
    truth = {**TRUTH, "density_kg_m3": DENSITY_KG_M3}
    bar = hexahedral_bar.Bar(0.12, (0.03, 0.02), truth, divisions)
    turn = Rotation.from_matrix([[0, 0, 1], [1, 0, 0], [0, 1, 0]])

    def hand(t_s: np.ndarray) -> tuple[Rotation, np.ndarray]:
        places_m = hand_poses(t_s)[:, :3, 3] + [0.0, 0.015, 0.01]
        return Rotation.from_quat(np.tile(turn.as_quat(), (len(t_s), 1))), places_m

    count = round((LONG_S[-1] - LONG_S[0]) / SIMULATED_STEP_S) + 1
    t_s = LONG_S[0] + SIMULATED_STEP_S * np.arange(count)
    gravity = np.array([0.0, 0.0, -9.81])
    positions_m = bar.simulate(t_s, hand, gravity, np.eye(len(bar.nodes_m)))
    return bar, CubicSpline(t_s, positions_m)


def independent_tracks_m(places_m: np.ndarray) -> np.ndarray:
    """Return the tracks (T, N, 3) [m] at `LONG_S` of places on the bar of the other program.

    They are extrapolated to infinitely small elements: the tip is 0.8 mm off with two elements
    across and 0.3 mm with three.
    """
    x, y, z = places_m.T
    unit = np.column_stack([y / 0.015 - 1, z / 0.01 - 1, x / 0.12])
    tracks_m = []
    for divisions in (COARSE_DIVISIONS, FINE_DIVISIONS):
        bar, motion = independent_motion(divisions)
        tracks_m.append(np.asarray(bar.interpolation(unit.tolist()) @ motion(LONG_S)))
    coarse_m, fine_m = tracks_m
    return fine_m + (fine_m - coarse_m) / (1.5**2 - 1)


def hand_poses(t_s: np.ndarray) -> np.ndarray:
    """Return the poses (T, 4, 4) of the held end."""
    share = 0.5 * (1 - np.cos(np.pi * np.clip(t_s / 0.12, 0, 1)))
    poses = np.tile(np.eye(4), (len(t_s), 1, 1))
    poses[:, 1, 3], poses[:, 2, 3] = 0.015 * share, 0.01 * share
    return poses


def experiment(
    t_s: np.ndarray, places_m: np.ndarray, body: cs.Body = BODY, **measured
) -> cs.Experiment:
    """Return the recording of the swung bar; with markers at the places unless something else is
    measured.
    """
    held = cs.Grasp(np.flatnonzero(body.nodes_m[:, 0] < 1e-9), hand_poses(t_s))
    if not measured:
        tracks = np.zeros((len(t_s), len(NAMES), 3))
        measured["markers"] = cs.Markers(t_s, tracks, 1e-3, names=NAMES, places_m=places_m)
    return cs.Experiment(body, t_s, [held], nuisance=cs.Nuisance.none(), **measured)


def looking(eye_m: np.ndarray) -> np.ndarray:
    """Return the pose of an upright camera that looks at the middle of the bar."""
    ahead = (MIDDLE_M - eye_m) / np.linalg.norm(MIDDLE_M - eye_m)
    right = np.cross(ahead, [0, 0, 1])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.column_stack([right, np.cross(ahead, right), ahead, eye_m])
    return pose


def project(points_m: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Return the pixels (…, 2) of points (…, 3) in the frame of a camera."""
    x, y = np.moveaxis(points_m[..., :2] / points_m[..., 2:], -1, 0)
    k1, k2, p1, p2, k3 = DISTORTION
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.stack([u, v], axis=-1) @ matrix[:2, :2].T + matrix[:2, 2]


def seen_from(options: argparse.Namespace) -> tuple[dict[str, tuple], np.ndarray, np.ndarray]:
    """Return the cameras, the stated places (N, 3) [m] and the normals (N, 3) of the faces."""
    if not options.below:
        return EYES_M, STATED_M, NORMALS
    # The points of the upper face are on the lower one.
    lower_m = STATED_M * [1, 1, -1] + [0, 0, 0.02]
    return {**EYES_M, "front": BELOW_M}, lower_m, NORMALS * [1, 1, -1]


def true_places_m(
    stated_m: np.ndarray, normals: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Return places that differ from the stated ones along the surface."""
    off = PLACE_M * rng.normal(size=stated_m.shape)
    off *= normals == 0
    low, high = BODY.nodes_m.min(axis=0), BODY.nodes_m.max(axis=0)
    return np.clip(stated_m + off, low, high)


def film(
    name: str, motion: CubicSpline, rng: np.random.Generator, options: argparse.Namespace
) -> cs.ImageTracks:
    """Return what a camera with drawn errors records, as its description states it."""
    eyes_m, stated_m, normals = seen_from(options)
    pose = looking(np.array(eyes_m[name]))
    late_s = DELAY_S * rng.normal()
    taken_s = T_S if options.rate_hz is None else np.arange(0.0, T_S[-1], 1 / options.rate_hz)
    own = (motion(taken_s + late_s) - pose[:3, 3]) @ pose[:3, :3]
    turn = Rotation.from_rotvec(np.deg2rad(options.turn_deg) * rng.normal(size=3))
    own = turn.apply(own.reshape(-1, 3)).reshape(own.shape) + options.shift_m * rng.normal(size=3)
    matrix = MATRIX.copy()
    matrix[:2, :2] *= 1 + options.focal * rng.normal()
    matrix[:2, 2] += options.centre_px * rng.normal(size=2)
    pixels = project(own, matrix)
    pixels += NOISE_PX * rng.normal(size=pixels.shape)
    wild = rng.random(pixels.shape[:2]) < options.outliers
    pixels[wild] += OUTLIER_PX * rng.normal(size=(wild.sum(), 2))
    seen = np.flatnonzero(np.sum((pose[:3, 3] - stated_m) * normals, axis=1) > 0)
    return cs.ImageTracks(
        name,
        cs.Camera(MATRIX, DISTORTION, pose, size_px=(1280, 720)),
        taken_s,
        pixels[:, seen],
        [NAMES[k] for k in seen],
        places_m=stated_m[seen] if options.places == "known" else None,
        sigma_px=NOISE_PX,
        pose_sigma=cs.PoseSigma(turn_deg=options.turn_deg, shift_m=options.shift_m),
        focal_sigma=options.focal,
        centre_sigma_px=options.centre_px,
    )


def problem(cameras: int, number: int, options: argparse.Namespace) -> cs.Problem:
    """Return the problem of a twin."""
    rng = np.random.default_rng([number, cameras])
    _, stated_m, normals = seen_from(options)
    places_m = true_places_m(stated_m, normals, rng)
    if options.judged:
        true_m = independent_tracks_m(places_m)
    else:
        true_m = cs.simulate(experiment(LONG_S, places_m), TRUTH, "midpoint", substeps=1).markers_m
    motion = CubicSpline(LONG_S, true_m)
    body = judged_body() if options.judged else BODY
    if cameras:
        films = [film(name, motion, rng, options) for name in list(EYES_M)[:cameras]]
        seen = experiment(T_S, stated_m, body, readings=films)
    else:
        tracks_m = motion(T_S) + NOISE_M * rng.normal(size=(len(T_S), len(NAMES), 3))
        markers = cs.Markers(
            T_S, tracks_m, NOISE_M, names=NAMES, places_m=stated_m, places_sigma_m=PLACE_M
        )
        seen = experiment(T_S, stated_m, body, markers=markers)
    unknown = {name: cs.Unknown(GUESSES[name]) for name in options.constants.split(",")}
    return cs.Problem([seen], parameters=TRUTH | unknown)


def identify(cameras: int, number: int, options: argparse.Namespace) -> list[tuple[float, ...]]:
    """Return estimate and ends of the 95 % interval of each constant over the truth, for a twin."""
    solution = cs.solve(problem(cameras, number, options))
    estimates = uncertainty_at(solution.collocation, solution.z).estimates
    rows = []
    for name in options.constants.split(","):
        low, high = estimates[name].statistical95 or (0.0, np.inf)
        rows.append(tuple(np.array([solution.parameters[name], low, high]) / TRUTH[name]))
    return rows


def judge(cameras: int, options: argparse.Namespace) -> None:
    """Print the answers to twins, and the table of their verdicts and intervals."""
    answers = []
    for number in range(options.first, options.first + options.twins):
        make = partial(problem, cameras, number, options)
        answers.append(compare(make, TRUTH, number, options.constants.split(",")))
        print(line(answers[-1]), flush=True)
    print(table(answers))


def main() -> None:
    """Print a table with one row for each number of cameras."""
    parser = make_parser(__doc__)
    parser.add_argument("--twins", type=int, default=24)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--places", choices=("known", "unknown"), default="known")
    parser.add_argument("--turn-deg", type=float, default=1.0)
    parser.add_argument("--shift-m", type=float, default=5e-3)
    parser.add_argument("--focal", type=float, default=5e-3)
    parser.add_argument("--centre-px", type=float, default=2.0)
    parser.add_argument("--rate-hz", type=float)
    parser.add_argument("--outliers", type=float, default=0.0)
    parser.add_argument("--cameras", default="1,2,3,0")
    parser.add_argument("--constants", default="young_pa,gamma_r_s")
    parser.add_argument("--judged", action="store_true", help="verdicts, for another program's bar")
    parser.add_argument("--below", action="store_true", help="first camera below the bar")
    options = parser.parse_args()
    if options.judged:
        for count in map(int, options.cameras.split(",")):
            judge(count, options)
        return
    names = options.constants.split(",")
    columns = [
        f"{what} of {name}" for name in names for what in ("RMS error", "inside", "half width")
    ]
    print(f"| seen by | {' | '.join(columns)} |")
    print("|---" * (1 + len(columns)) + "|", flush=True)
    for count in map(int, options.cameras.split(",")):
        begin_s = time.process_time()
        numbers = range(options.first, options.first + options.twins)
        values = np.array([identify(count, number, options) for number in numbers])
        cells = [f"{count} camera{'s' * (count > 1)}" if count else "motion capture"]
        for found, low, high in np.moveaxis(values, 0, -1):
            inside = np.count_nonzero((low <= 1) & (high >= 1))
            error = np.sqrt(np.mean((found - 1) ** 2))
            width = np.median(high - low) / 2
            cells += [f"{error:.2%}", f"{inside} of {len(found)}", f"{width:.2%}"]
        print(f"| {' | '.join(cells)} |", flush=True)
        each_s = (time.process_time() - begin_s) / len(values)
        print(f"<!-- {each_s:.1f} CPU s each -->", flush=True)


if __name__ == "__main__":
    main()
