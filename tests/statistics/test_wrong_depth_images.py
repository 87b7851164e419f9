"""Depth images that are flipped, scaled, late or of another moment are named, before a solve and
after.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from depth_twins import TRUTH, hanging_twin, swinging_twin
from wrong_cameras import DEPTH_FAULTS, MOVING_FAULTS

import collocation_sysid as cs
from collocation_sysid.features.cameras.doubts import depth_image_hypotheses
from collocation_sysid.features.cameras.images import camera_image_hypotheses, equilibrium_shapes_m
from collocation_sysid.features.cameras.times import camera_clock_hypotheses
from collocation_sysid.judge.engine import find_misspecifications
from collocation_sysid.methods.starts.initial_trajectories import initial_variables
from collocation_sysid.problem import Problem
from collocation_sysid.runs.check import check_problem, misspecification_hypotheses
from collocation_sysid.runs.solving import solve
from collocation_sysid.statistics.hypothesis import Hypothesis, rank

# What the image of one moment shows, with the code that names it.
OF_SHAPE = {
    "depth: focal length doubled": "camera-matrix/focal",
    "depth: principal point mirrored": "camera-matrix/centre",
    "depth: image rows flipped": "camera-image",
    "depth: image mirrored left to right": "camera-image",
    "depth: camera turned by 15 deg": "camera-pose",
    "depth: distance along the ray": "camera-rays",
}
OF_POSE = {
    "depth: pose of an OpenGL frame": "x to the right, y up, z backwards",
    "depth: pose of a frame with x forward": "x forward, y to the left, z up",
    "depth: rotation transposed": "transposed rotation",
    "depth: pose inverted": "inverted",
}
OF_TIME = {
    "depth: camera 0.1 s late": "camera-clock",
    "depth: images in reverse order": "camera-order",
    "depth: image of the start throughout": "camera-constant",
}


def hanging(fault: str | None, seed: int = 1) -> Problem:
    """Return the problem of one image, with a mistake or without."""
    right = hanging_twin(seed)
    if fault is None:
        return right
    return DEPTH_FAULTS[fault](right, np.random.default_rng(0))


def from_shape(problem: Problem) -> tuple[Hypothesis, ...]:
    """Return the hypotheses of the first image."""
    (experiment,) = problem.experiments
    return rank(camera_image_hypotheses(experiment, TRUTH))


@cache
def from_motion(fault: str | None, seed: int = 1, guess_pa: float = 2e5) -> tuple[Hypothesis, ...]:
    """Return the hypotheses of a motion that is simulated at the guess."""
    problem = swinging_twin(seed)
    if fault is not None:
        problem = MOVING_FAULTS[fault](problem, np.random.default_rng(0))
    parameters = problem.parameters.with_guess({"young_pa": guess_pa})
    collocation = replace(problem, parameters=parameters).collocation()
    variables, _ = initial_variables(collocation)
    (part,) = collocation.iterates(variables)
    return rank(camera_clock_hypotheses(part))


@pytest.mark.parametrize("seed", range(1, 9))
def test_a_right_image_is_not_doubted(seed: int):
    assert misspecification_hypotheses(hanging(None, seed)) == ()
    assert from_shape(hanging(None, seed)) == ()


def test_a_wall_behind_the_body_is_no_mistake():
    walled = hanging("depth: background not removed")
    assert misspecification_hypotheses(walled) == ()
    assert from_shape(walled) == ()


@pytest.mark.parametrize("fault", OF_SHAPE)
def test_a_wrong_image_is_named(fault: str):
    first, *_ = from_shape(hanging(fault))
    assert first.code == OF_SHAPE[fault]
    assert "{" not in first.message


def test_a_flip_and_the_principal_point_are_stated():
    mirrored = from_shape(hanging("depth: image mirrored left to right"))
    assert "from right to left (mirrored)" in mirrored[0].message
    centre = from_shape(hanging("depth: principal point mirrored"))
    assert "[66.0, 70.0], counted from the opposite corner" in centre[0].message


@pytest.mark.parametrize("fault", OF_POSE)
def test_a_wrong_frame_is_among_the_likely_mistakes(fault: str):
    (cause,) = misspecification_hypotheses(hanging(fault))
    assert cause.code == "camera/likely"
    assert OF_POSE[fault] in cause.data["mistakes"]


def test_shapes_go_from_undeformed_to_soft_in_small_steps():
    (experiment,) = hanging(None).experiments
    shapes_m = equilibrium_shapes_m(experiment, TRUTH, time_s=0.0)
    np.testing.assert_allclose(shapes_m[0], experiment.body.nodes_m)
    lowest_m = [shape_m[:, 2].min() for shape_m in shapes_m]
    assert len(shapes_m) > 3
    assert (np.diff(lowest_m) < 0).all()
    size_m = np.linalg.norm(np.ptp(experiment.body.nodes_m, axis=0))
    steps_m = [np.linalg.norm(after - before, axis=1).max() for before, after in pairwise(shapes_m)]
    assert max(steps_m) < 0.17 * size_m


def test_large_bodies_are_left_to_a_full_check():
    problem = hanging("depth: image rows flipped")
    assert depth_image_hypotheses(problem, (), most_nodes=10) == ()
    assert depth_image_hypotheses(problem, (), most_nodes=None)


@pytest.mark.parametrize(("seed", "guess_pa"), [(1, 5e4), (2, 2e5), (1, 1e6)])
def test_times_that_are_right_are_not_doubted_far_from_the_truth(seed: int, guess_pa: float):
    assert from_motion(None, seed, guess_pa) == ()


@pytest.mark.parametrize("fault", OF_TIME)
def test_wrong_times_are_named(fault: str):
    first, *_ = from_motion(fault)
    assert first.code == OF_TIME[fault]
    assert "{" not in first.message


def test_a_late_clock_is_stated_with_its_lag():
    first, *_ = from_motion("depth: camera 0.1 s late")
    assert first.data["by_ms"] == pytest.approx(100.0)
    assert "late relative to that of the poses; subtract this" in first.message


@pytest.mark.long
def test_check_names_a_flipped_image():
    findings = check_problem(hanging("depth: image rows flipped"))
    assert findings.causes[0].code == "camera-image"
    assert "from the bottom to the top" in findings.warnings[0]


@pytest.mark.long
def test_solve_names_a_wrong_matrix():
    solution = solve(hanging("depth: focal length doubled"))
    first, *_ = find_misspecifications(solution)
    assert first.code == "camera-matrix/focal"


@pytest.mark.long
def test_solve_names_no_cause_of_a_right_image():
    assert find_misspecifications(solve(hanging(None))) == ()


@pytest.mark.long
@pytest.mark.parametrize("seed", [9, 19])
def test_a_search_that_correspondences_end_near_the_minimum_is_good(seed):
    run = cs.run(hanging_twin(seed))
    assert run.trust.verdict == "good"
    low, high = run.interval("young_pa")
    assert low < TRUTH["young_pa"] < high
