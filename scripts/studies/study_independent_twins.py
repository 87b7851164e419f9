"""Verdicts and combined intervals for recordings that an independent program simulated.

The simulator in `hexahedral_bar.py` shares no code with the package. Every twin is a tapered bar of
120 mm with constants, density, cross-section, motion and six to ten marker places of its own. Size,
mass, clock, gravity, grip, gradients and stiffness deviate from the description by random numbers
with the default standard deviations of the package (`DEVIATIONS`). A twin is saved as a problem folder
and solved with tet10 elements, two across the thickness (275 nodes), without guesses and without
marker places.

Answers are appended to a file with one line of JSON per twin; twins that the file has are not solved
again.
"""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hexahedral_bar
import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation
from script_arguments import make_parser

import collocation_sysid as cs

LENGTH_M = 0.12
SAMPLE_S = 0.0125
DURATION_S = 0.5
POSE_STEP_S = 0.00625
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


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--twins", type=int, default=100)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--folder", type=Path, default=Path("independent_twins"))
    parser.add_argument("--exact", action="store_true", help="no errors of the description")
    parser.add_argument("--across", type=int, default=2, help="tet10 elements across the thickness")
    parser.add_argument("--poisson", type=float, help="true Poisson's ratio of all twins")
    arguments = parser.parse_args()

    def answer(seed: int) -> dict[str, Any]:
        folder = arguments.folder / f"{seed:03d}"
        if not (folder / "problem.toml").exists():
            twin = draw(seed, arguments.exact, arguments.poisson)
            write_problem(twin, folder, seed, arguments.across)
        return solve(folder, seed)

    seeds = range(arguments.first, arguments.first + arguments.twins)
    answer_all(arguments.folder / "answers.jsonl", seeds, answer)


def answer_all(
    path: Path, seeds: Sequence[int], answer: Callable[[int], dict[str, Any]]
) -> list[dict[str, Any]]:
    """Return the answers to the twins of all seeds: those of a file, and new ones, which are printed
    and appended to the file. The table of all is printed last.
    """
    known = read_answers(path)
    for seed in seeds:
        if seed in known:
            continue
        known[seed] = answer(seed)
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(known[seed]) + "\n")
        print(line(known[seed]), flush=True)
    answers = [known[seed] for seed in seeds]
    print(table(answers))
    return answers


def read_answers(path: Path) -> dict[int, dict[str, Any]]:
    """Return the answers of a file, by seed; empty without a file."""
    if not path.exists():
        return {}
    answers = map(json.loads, path.read_text(encoding="utf-8").splitlines())
    return {answer["seed"]: answer for answer in answers}


# One twin -----------------------------------------------------------------------------------------


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


def write_problem(twin: Twin, folder: Path, seed: int, across: int = 2) -> None:
    """Simulate a twin, and write its problem folder and its truth."""
    began = time.process_time()
    fine_s, exact_m = simulate(twin)
    folder.mkdir(parents=True, exist_ok=True)
    t_s = SAMPLE_S * np.arange(round(DURATION_S / SAMPLE_S) + 1)
    shift = twin.errors["time_shift_s"][0]
    rate = twin.errors["clock_rate"][0]
    seen_s = np.clip(t_s * (1 + rate) - shift, 0.0, fine_s[-1])
    tracks = CubicSpline(fine_s, exact_m)(seen_s)
    rng = np.random.default_rng((seed, 1))
    tracks = tracks + twin.noise_m * rng.standard_normal(tracks.shape)
    names = [f"m{k + 1}" for k in range(len(twin.marker_places))]
    heads = ["t_s", *(f"{name}_{axis}" for name in names for axis in "xyz")]
    _write_csv(folder / "markers.csv", heads, np.column_stack([t_s, tracks.reshape(len(t_s), -1)]))
    pose_s = POSE_STEP_S * np.arange(round(DURATION_S / POSE_STEP_S) + 1)
    rotations, positions_m = hand(twin, pose_s)
    heads = ["t_s", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"]
    _write_csv(
        folder / "poses.csv", heads, np.column_stack([pose_s, positions_m, rotations.as_quat()])
    )
    mesh = mesh_of(twin, (across, across, 5))
    mesh.write(folder / "bar.vtu")
    true_kg = twin.truth["density_kg_m3"] * mesh.volume_m3 * (1 + twin.errors["size"][0]) ** 3
    stated_kg = true_kg / (1 + twin.errors["mass"][0])
    (folder / "problem.toml").write_text(
        f"""title = "Independent twin {seed}"

[object]
mesh = "bar.vtu"
element = "tet10"
mass_kg = {stated_kg:.6g}
rest_shape = "stress_free"

[parameters]
young_pa = {{}}
poisson = {{}}
gamma_r_s = {{}}
gamma_m_1_s = {{}}

[environment]
air_density_kg_m3 = "none"

[[experiment]]
name = "swing"
grasp = {{ nodes = {{ box_m = [[-1, -1, -1e-6], [1, 1, 1e-6]] }}, poses = "poses.csv" }}
start = "equilibrium"

[experiment.markers]
file = "markers.csv"
sigma_m = {twin.noise_m:g}
""",
        encoding="utf-8",
    )
    record = {**vars(twin), "simulation_cpu_s": time.process_time() - began}
    (folder / "truth.json").write_text(json.dumps(record, indent=1), encoding="utf-8")


def _write_csv(path: Path, heads: Sequence[str], rows: np.ndarray) -> None:
    np.savetxt(path, rows, fmt="%.9g", delimiter=",", header=",".join(heads), comments="")


def solve(folder: Path, seed: int) -> dict[str, Any]:
    """Solve a saved twin, and compare the answer with the truth."""
    truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))["truth"]
    return compare(lambda: cs.Problem.read(folder / "problem.toml"), truth, seed)


def compare(
    problem: Callable[[], cs.Problem],
    truth: Mapping[str, float],
    seed: int,
    names: Sequence[str] = tuple(CONSTANTS),
) -> dict[str, Any]:
    """Make and solve a problem, and return its verdict and its constants beside the truth.

    A description that is refused, or a solve that fails, is an answer of a study too.
    """
    answer: dict[str, Any] = {"seed": seed, "named": ()}
    try:
        described = problem()
        began = time.process_time()
        run = cs.run(described)
    except cs.InputError as error:
        return answer | {"verdict": "refused", "reasons": [str(error)], "constants": {}}
    except Exception as error:
        return answer | {"verdict": "failed", "reasons": [repr(error)], "constants": {}}
    answer |= {"verdict": run.trust.verdict, "reasons": list(run.trust.reasons)}
    answer["named"] = tuple(each.code for each in run.causes[:1])
    answer["constants"] = {name: _constant(run, name, truth[name]) for name in names}
    elapsed = run.elapsed_s
    answer |= {"search_s": elapsed.search, "checks_s": elapsed.checks}
    return answer | {"solve_cpu_s": time.process_time() - began}


def _constant(run: Any, name: str, true: float) -> dict[str, Any]:
    low, high = run.interval(name)
    return {
        "true": true,
        "value": float(run.estimates[name].value),
        "interval": [float(low), float(high)],
        "inside": bool(low <= true <= high),
        "half_width": float((high - low) / 2 / true),
    }


# Table --------------------------------------------------------------------------------------------


def line(answer: Mapping[str, Any]) -> str:
    """Return one twin as a line."""
    parts = [f"{answer['seed']:3d} {answer['verdict']:8s} {answer.get('solve_cpu_s', 0):.0f} s"]
    for name, symbol in CONSTANTS.items():
        if name in answer["constants"]:
            c = answer["constants"][name]
            parts.append(
                f"{symbol} {100 * (c['value'] / c['true'] - 1):+.1f} ± {100 * c['half_width']:.0f} %"
                + " OUTSIDE" * (not c["inside"])
            )
    return " | ".join(parts) + " | " + " // ".join(reason[:90] for reason in answer["reasons"])


def table(answers: Sequence[Mapping[str, Any]]) -> str:
    """Return verdicts, coverage, errors and half widths of each constant, and times, as Markdown."""
    verdicts = Counter(answer["verdict"] for answer in answers)
    rows = [
        f"{len(answers)} twins: " + ", ".join(f"{n} {v}" for v, n in verdicts.most_common()),
        "",
        "| constant | inside | mean error % | RMS error % | median half width % "
        "| 10 to 90 % of half widths |",
        "|---|---|---|---|---|---|",
    ]
    for name, symbol in CONSTANTS.items():
        found = [a["constants"][name] for a in answers if name in a["constants"]]
        if not found:
            continue
        inside = sum(c["inside"] for c in found)
        errors = 100 * np.array([c["value"] / c["true"] - 1 for c in found])
        widths = 100 * np.array([c["half_width"] for c in found])
        low, median, high = np.nanquantile(widths, [0.1, 0.5, 0.9])
        rows.append(
            f"| {symbol} | {inside} of {len(found)} | {np.mean(errors):+.1f} | "
            f"{np.sqrt(np.mean(errors**2)):.1f} | {median:.0f} | {low:.0f} to {high:.0f} |"
        )
    for key, text in (("search_s", "search"), ("checks_s", "checks"), ("solve_cpu_s", "CPU time")):
        if times := [a[key] for a in answers if key in a]:
            rows.append(f"\n{text}: median {np.median(times):.1f} s, largest {max(times):.1f} s")
    return "\n".join(rows)


if __name__ == "__main__":
    main()
