"""Bands of plans for twins in which all effects of the budget are drawn at once.

A bar hangs from a gripper and is recorded once with six markers. All default assumptions and all
nuisance parameters of the recording are wrong by random numbers with their default deviations; only
the damping law is the stated one. The bar is identified, the circle of a tip is planned, and the
poses of the plan are executed by the same true bar after a new grip. Truths have twice as many
elements along each edge and twice as many time steps as the description. The tip is compared with
the prediction at each sample; a band that holds contains all coordinates at all times.

    python scripts study_plan_band [--twins 20] [--first 0] [--file plan_band.jsonl]
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

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


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--twins", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--file", type=Path, default=Path("plan_band.jsonl"))
    arguments = parser.parse_args()
    lines = arguments.file.read_text().splitlines() if arguments.file.is_file() else []
    answers = {each["seed"]: each for each in map(json.loads, lines)}
    seeds = range(arguments.first, arguments.first + arguments.twins)
    for seed in seeds:
        if seed not in answers:
            answers[seed] = answer(seed)
            with arguments.file.open("a") as file:
                file.write(json.dumps(answers[seed]) + "\n")
            print(answers[seed], flush=True)
    print(table([answers[seed] for seed in seeds]))


def answer(seed: int) -> dict[str, Any]:
    """Draw a twin, identify it, plan and execute; lengths are in millimetres."""
    rng = np.random.default_rng(seed)
    truth = {
        "young_pa": 2e4 * float(np.exp(0.3 * rng.normal())),
        "gamma_r_s": 0.01 * float(np.exp(0.3 * rng.normal())),
        "gamma_m_1_s": 0.3,
        "poisson": POISSON,
    }
    swing_s = np.asarray(SAMPLE_S * np.arange(SAMPLES), dtype=np.float64)
    stated = hung(swing_s, swing(swing_s), 1)
    gravity_m_s2 = stated.gravity_m_s2
    recorded: Array | None = None
    while recorded is None:
        with suppress(SimulationError):
            errors = drawn_errors((*DRAWN, "poisson"), bar(DIVISIONS), rng)
            gravity_m_s2 = tilted_gravity(stated, rng).gravity_m_s2
            recorded = executed_m(swing_s, swing(swing_s), truth, errors, gravity_m_s2, rng)
    stated = cs.with_markers(stated, recorded + NOISE_M * rng.normal(size=recorded.shape))
    sigma_m = stated.nuisance.marker_offset_m or 0.0
    described = at_places(stated, PLACES_M + sigma_m * rng.normal(size=PLACES_M.shape))
    free = {name: cs.Unknown() for name in truth if name != "poisson"}
    run = cs.run(cs.Problem([described], {**free, "poisson": POISSON}, substeps=1))
    if run.uncertainty is None:
        return {"seed": seed, "verdict": run.trust.verdict}
    plan = cs.plan_motion(run, circle(), LIMITS)
    t_s = plan.t_s
    tips = executed_m(t_s, plan.poses(fine(t_s, 4)), truth, errors, gravity_m_s2, rng)[:, 0]
    off = 1e3 * np.abs(tips - plan.points_m["tip"])
    assert plan.half_widths_m is not None
    half = 1e3 * plan.half_widths_m["tip"]
    return {
        "seed": seed,
        "verdict": run.trust.verdict,
        "holds": bool((off <= half).all()),
        "inside": float((off <= half).mean()),
        "before": float(off[0].max()),
        "half_before": float(half[0].max()),
        "largest": float(off.max()),
        "half_largest": float(half.max()),
        "rms": float(np.sqrt(np.mean(off**2))),
        "half_rms": float(np.sqrt(np.mean(half**2))),
        "factor": plan.band_factor,
    }


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


def executed_m(
    t_s: Array,
    poses: cs.PoseSequence,
    truth: Mapping[str, float],
    errors: Mapping[str, float],
    gravity_m_s2: Array,
    rng: np.random.Generator,
) -> Array:
    """Return the true positions (T, M, 3) [m] of the markers after a new grip."""
    fine_s = fine(t_s, 2)
    held = replace(hung(fine_s, poses, 2), gravity_m_s2=gravity_m_s2)
    nuisance = held.nuisance
    held = displaced(held, nuisance.hand_eye_m or 0.0, nuisance.hand_eye_rad or 0.0, rng)
    return with_wrong_assumptions(held, truth, errors).markers.positions_m[::2]


def fine(t_s: Array, count: int) -> Array:
    """Return `count` times for each of equally spaced ones."""
    return np.linspace(t_s[0], t_s[-1], count * (len(t_s) - 1) + 1)


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
    """Return the table of all twins."""
    known = [each for each in answers if "holds" in each]
    middle = {
        key: float(np.median([e[key] for e in known])) for key in known[0] if key != "verdict"
    }
    holding = sum(each["holds"] for each in known)
    rows = [
        ("bands that hold", f"{holding} of {len(known)}"),
        ("coordinates inside", f"{100 * np.mean([each['inside'] for each in known]):.1f} %"),
        *(
            (f"{when}: off by {number(middle[key])} mm", f"± {number(middle[f'half_{key}'])} mm")
            for when, key in (("before the motion", "before"), ("at most", "largest"))
        ),
    ]
    return markdown(("medians", ""), rows)


if __name__ == "__main__":
    main()
