"""Wrong poses and units of depth cameras are named before a solve."""

from __future__ import annotations

import numpy as np
import pytest
from depth_twins import TRUTH, hanging_twin
from wrong_cameras import DEPTH_FAULTS

import collocation_sysid as cs
from collocation_sysid.problem import Problem
from collocation_sysid.runs.check import misspecification_hypotheses

OF_POSE = {
    "depth: pose of an OpenGL frame": "x to the right, y up, z backwards",
    "depth: pose of a frame with x forward": "x forward, y to the left, z up",
    "depth: rotation transposed": "transposed rotation",
    "depth: pose inverted": "inverted",
}


def hanging(fault: str | None, seed: int = 1) -> Problem:
    """Return the problem of one image, with a mistake or without."""
    right = hanging_twin(seed)
    if fault is None:
        return right
    return DEPTH_FAULTS[fault](right, np.random.default_rng(0))


@pytest.mark.parametrize("seed", range(1, 9))
def test_a_right_image_is_not_doubted(seed: int):
    assert misspecification_hypotheses(hanging(None, seed)) == ()


def test_a_wall_behind_the_body_is_no_mistake():
    assert misspecification_hypotheses(hanging("depth: background not removed")) == ()


@pytest.mark.parametrize(
    "fault", ["depth: principal point mirrored", "depth: camera beside the body"]
)
def test_a_camera_that_does_not_see_the_body_is_named(fault: str):
    (cause,) = misspecification_hypotheses(hanging(fault))
    assert cause.code == "camera"


@pytest.mark.parametrize("fault", OF_POSE)
def test_a_wrong_frame_is_among_the_likely_mistakes(fault: str):
    (cause,) = misspecification_hypotheses(hanging(fault))
    assert cause.code == "camera/likely"
    assert OF_POSE[fault] in cause.data["mistakes"]


@pytest.mark.long
@pytest.mark.parametrize("seed", [9, 19])
def test_a_search_that_correspondences_end_near_the_minimum_is_good(seed):
    run = cs.run(hanging_twin(seed))
    assert run.trust.verdict == "good"
    low, high = run.interval("young_pa")
    assert low < TRUTH["young_pa"] < high
