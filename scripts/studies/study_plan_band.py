"""Bands of plans for twins in which all effects of the budget are drawn at once.

A bar or a cable hangs from a gripper and is recorded once. The assumptions and the nuisance
parameters of the recording are wrong by random numbers with their default deviations; only the
damping law is the stated one. The body is identified, the circle of a tip is planned, and the poses
of the plan are executed by the same true body after a new grip, or in the same one, which the
description then shares between recordings. Truths of bars have twice as many elements along each
edge, and all truths have twice as many elements along the body and time steps as the description. A
band that holds 95 % of the deviations would be narrower by the factor of the table.

    python scripts study_plan_band [--bodies bar cable] [--grips new same] [--twins 10] [--first 0]
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import cable_twins
import numpy as np
from assumed_twins import with_wrong_assumptions
from effect_twins import DRAWN, at_places, displaced, drawn_errors, tilted_gravity
from numpy.typing import NDArray
from script_arguments import make_parser
from studies import markdown, number

import collocation_sysid as cs
from collocation_sysid.errors import SimulationError

Array = NDArray[np.float64]
SIZE_M, DIVISIONS = (0.02, 0.02, 0.12), (1, 1, 4)
POISSON = 0.4
NOISE_M, SAMPLE_S, SAMPLES = 3e-4, 0.01, 80
PLACES_M = 1e-3 * np.array(
    [[10, 10, 0], [20, 10, 20], [10, 0, 40], [0, 10, 60], [10, 20, 80], [20, 10, 100]]
)
RADIUS_M, DURATION_S, PLAN_SAMPLE_S = 0.04, 0.9, 0.015
LIMITS = cs.Limits.model_validate(
    {
        "workspace_m": [(-0.3, -0.3, -0.3), (0.3, 0.3, 0.4)],
        "speed_m_s": 1.5,
        "acceleration_m_s2": 15.0,
        "rotation_deg": 60.0,
        "angular_speed_deg_s": 360.0,
        "angular_acceleration_deg_s2": 3000.0,
    }
)


class Twin(NamedTuple):
    """Description of a recording, and the truth that executes motions."""

    described: cs.Experiment
    parameters: dict[str, Any]
    # Tip (T, 3) [m] at times, for poses of the gripper, and the number of the grip.
    execute: Callable[[Array, cs.PoseSequence, int], Array]


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--bodies", nargs="+", choices=list(TWINS), default=list(TWINS))
    parser.add_argument("--grips", nargs="+", choices=("new", "same"), default=("new", "same"))
    parser.add_argument("--twins", type=int, default=10)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--file", type=Path, default=Path("plan_band.jsonl"))
    arguments = parser.parse_args()
    lines = arguments.file.read_text().splitlines() if arguments.file.is_file() else []
    answers = {(each["body"], each["grip"], each["seed"]): each for each in map(json.loads, lines)}
    for seed in range(arguments.first, arguments.first + arguments.twins):
        for case in ((body, grip, seed) for body in arguments.bodies for grip in arguments.grips):
            if case not in answers:
                answers[case] = answer(*case)
                with arguments.file.open("a") as file:
                    file.write(json.dumps(answers[case]) + "\n")
                print(answers[case] | {"shares": None}, flush=True)
    print(table([*answers.values()]))


def answer(body: str, grip: str, seed: int) -> dict[str, Any]:
    """Draw a twin, identify it, plan and execute; lengths are in millimetres."""
    known = {"body": body, "grip": grip, "seed": seed}
    described, parameters, execute = TWINS[body](seed)
    if grip == "same":
        scope = {"hand_eye_rad": "shared", "hand_eye_m": "shared"}
        described = replace(described, nuisance=replace(described.nuisance, scope=scope))
    run = cs.run(cs.Problem([described], parameters, substeps=1))
    known["verdict"] = run.trust.verdict
    if run.uncertainty is None:
        return known
    plan = cs.plan_motion(run, circle(), LIMITS)
    tip_m = execute(plan.t_s, plan.poses(fine(plan.t_s, 4)), int(grip == "new"))
    off_m = tip_m - plan.expected_m["tip"]
    assert plan.half_widths_m is not None
    half_m = plan.half_widths_m["tip"]
    shares = np.abs(off_m) / half_m
    return known | {
        "inside": float((shares <= 1).mean()),
        "rms": 1e3 * float(np.sqrt(np.mean(off_m**2))),
        "half": 1e3 * float(np.sqrt(np.mean(half_m**2))),
        "largest_half": 1e3 * float(half_m.max()),
        "rms_from_prediction": 1e3 * float(np.sqrt(np.mean((tip_m - plan.points_m["tip"]) ** 2))),
        "sources": {each.source: round(each.share, 3) for each in plan.band_contributions[:4]},
        "shares": shares.ravel().round(4).tolist(),
    }


# Bars ---------------------------------------------------------------------------------------------


def bar_twin(seed: int) -> Twin:
    """Return a bar with all effects of the budget and six markers."""
    rng = np.random.default_rng(seed)
    truth = {
        "young_pa": 2e4 * float(np.exp(0.3 * rng.normal())),
        "gamma_r_s": 0.01 * float(np.exp(0.3 * rng.normal())),
        "gamma_m_1_s": 0.3,
        "poisson": POISSON,
    }
    swing_s = np.asarray(SAMPLE_S * np.arange(SAMPLES), dtype=np.float64)
    stated = hung(swing_s, swing(swing_s), 1)

    def executed_m(t_s: Array, poses: cs.PoseSequence, grip: int) -> Array:
        return bar_tracks_m(t_s, poses, truth, errors, gravity_m_s2, (seed, grip))

    recorded: Array | None = None
    while recorded is None:
        with suppress(SimulationError):
            errors = drawn_errors((*DRAWN, "poisson"), bar(DIVISIONS), rng)
            gravity_m_s2 = tilted_gravity(stated, rng).gravity_m_s2
            recorded = executed_m(swing_s, swing(swing_s), 0)
    stated = cs.with_markers(stated, recorded + NOISE_M * rng.normal(size=recorded.shape))
    described = at_places(stated, PLACES_M + place_errors_m(stated, rng))
    free = {name: cs.Unknown() for name in truth if name != "poisson"}
    return Twin(described, {**free, "poisson": POISSON}, lambda *a: executed_m(*a)[:, 0])


def bar(divisions: tuple[int, int, int]) -> cs.Body:
    """Return the bar as it is described, with a mesh of so many boxes."""
    mesh = cs.box_mesh(SIZE_M, divisions)
    return cs.Body(mesh, density_kg_m3=800.0, element="tet10", rest_shape="stress_free")


def hung(t_s: Array, poses: cs.PoseSequence, refinement: int) -> cs.Experiment:
    """Return the experiment of the bar as it is described; elements are smaller by a factor."""
    across, deep, along = DIVISIONS
    body = bar((refinement * across, refinement * deep, refinement * along))
    held = np.flatnonzero(body.nodes_m[:, 2] > SIZE_M[2] - 1e-9)
    names = ["tip", *(f"side_{k}" for k in range(1, len(PLACES_M)))]
    tracks_m = np.zeros((len(t_s), len(names), 3))
    markers = cs.Markers(t_s, tracks_m, NOISE_M, names, places_m=PLACES_M)
    return cs.Experiment(body, t_s, [cs.Grasp(held, poses)], markers, name="swing")


def bar_tracks_m(
    t_s: Array,
    poses: cs.PoseSequence,
    truth: Mapping[str, float],
    errors: Mapping[str, float],
    gravity_m_s2: Array,
    grip: tuple[int, int],
) -> Array:
    """Return the true positions (T, M, 3) [m] of the markers in the grip with a seed."""
    fine_s = fine(t_s, 2)
    held = replace(hung(fine_s, poses, 2), gravity_m_s2=gravity_m_s2)
    nuisance, rng = held.nuisance, np.random.default_rng(grip)
    held = displaced(held, nuisance.hand_eye_m or 0.0, nuisance.hand_eye_rad or 0.0, rng)
    return with_wrong_assumptions(held, truth, errors).markers.positions_m[::2]


def swing(t_s: Array) -> cs.PoseSequence:
    """Return the poses of the recording, which begins at rest."""
    at_s = fine(t_s, 4)
    begins = np.minimum(1, at_s / 0.2) ** 3
    waves = np.sin(np.outer(at_s, [14.0, 11.0, 17.0, 9.0]))
    shift_m = begins[:, None] * waves[:, :3] * [0.02, 0.015, 0.01]
    angle = 0.15 * begins * waves[:, 3]
    zero = np.zeros_like(angle)
    rotations = np.column_stack([zero, np.sin(angle / 2), zero, np.cos(angle / 2)])
    return cs.PoseSequence(at_s, shift_m, rotations)


# Cables -------------------------------------------------------------------------------------------


def cable_twin(seed: int) -> Twin:
    """Return the example of a cable with the effects of `cable_twins`, and errors of places."""
    with TemporaryDirectory() as folder:
        true, first_grip = cable_twins.write_twin(Path(folder), seed)
        (stated,) = cs.Problem.read(Path(folder) / "problem.toml").experiments
    rng = np.random.default_rng((seed, 2))
    places_m = stated.markers.predict_positions(stated.body.nodes_m[None])[0]
    described = at_places(stated, places_m + place_errors_m(stated, rng))
    grips = first_grip, cable_twins.drawn_grip(rng)

    def executed_m(t_s: Array, poses: cs.PoseSequence, grip: int) -> Array:
        fine_s = fine(t_s, 2)
        tracks_m = np.zeros((len(fine_s), 2, 3))
        seen = replace(true.markers, t_s=fine_s, positions_m=tracks_m, located=None)
        grasps = [replace(each, wrench=None) for each in true.grasps]
        moved = replace(true, t_s=fine_s, markers=seen, grasps=grasps)
        held = cable_twins.gripped(moved, poses, grips[grip])
        truth = cable_twins.TRUTH | cable_twins.STATED
        return cs.simulate(held, truth, substeps=1).markers_m[::2, -1]

    free = {name: cs.Unknown() for name in cable_twins.TRUTH}
    return Twin(described, {**free, **cable_twins.STATED}, executed_m)


TWINS = {"bar": bar_twin, "cable": cable_twin}


# Both ---------------------------------------------------------------------------------------------


def place_errors_m(experiment: cs.Experiment, rng: np.random.Generator) -> Array:
    """Draw errors (M, 3) [m] of the stated places of the markers."""
    sigma_m = experiment.nuisance.marker_offset_m or 0.0
    return sigma_m * rng.normal(size=(len(experiment.markers.names), 3))


def fine(t_s: Array, count: int) -> Array:
    """Return `count` times for each of equally spaced ones."""
    return np.linspace(t_s[0], t_s[-1], count * (len(t_s) - 1) + 1)


def circle() -> cs.Task:
    """Return the task: the tip moves along a circle, and rests."""
    share = np.linspace(0, 1, 91)
    angle = 2 * np.pi * share**4 * (35 - 84 * share + 70 * share**2 - 20 * share**3)
    places = RADIUS_M * np.column_stack([1 - np.cos(angle), np.sin(angle), 0 * angle])
    reference = {
        "point": "tip",
        "t_s": (DURATION_S * share).tolist(),
        "position_m": places.tolist(),
        "relative": True,
    }
    return cs.Task.model_validate(
        {"duration_s": DURATION_S, "sample_s": PLAN_SAMPLE_S, "reference": [reference]}
    )


def table(answers: list[dict[str, Any]]) -> str:
    """Return the table of all twins; lengths are medians."""
    heads = "", "twins", "inside", "in single plans", "off, RMS mm", "half width mm", "factor"
    rows = []
    for case in dict.fromkeys((each["body"], each["grip"]) for each in answers):
        known = [e for e in answers if (e["body"], e["grip"]) == case and "shares" in e]
        inside = [100 * each["inside"] for each in known]
        shares = np.concatenate([each["shares"] for each in known])
        rms, half = (float(np.median([each[key] for each in known])) for key in ("rms", "half"))
        rows.append(
            (
                "{}, {} grip".format(*case),
                f"{len(known)}",
                f"{100 * (shares <= 1).mean():.1f} %",
                f"{min(inside):.0f} to {max(inside):.0f} %",
                number(rms),
                number(half),
                number(1 / float(np.quantile(shares, 0.95))),
            )
        )
    return markdown(heads, rows)


if __name__ == "__main__":
    main()
