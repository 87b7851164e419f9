"""Obstacles that contradict their measured loads are named before anything is solved."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from contact_twins import DRAGGED_NOISE_N, poked_twin, sheared_twin
from wrong_obstacles import PLATE_FAULTS, POKING_FAULTS
from wrong_twins import wrench_times

from collocation_sysid.kinds.contact.doubts import obstacle_hypotheses
from collocation_sysid.problem import Problem
from collocation_sysid.recording import Nuisance, Plane
from collocation_sysid.runs.check import misspecification_hypotheses

NAMED = {
    name: (twin, fault)
    for twin, faults in ((poked_twin, POKING_FAULTS), (sheared_twin, PLATE_FAULTS))
    for name, fault in faults.items()
    if fault.causes
}
SILENT = [name for name, fault in POKING_FAULTS.items() if not fault.causes]


@pytest.mark.parametrize("twin", [poked_twin, sheared_twin])
@pytest.mark.parametrize("seed", range(1, 9))
def test_a_right_obstacle_is_not_doubted(twin: Callable[[int], Problem], seed: int):
    assert misspecification_hypotheses(twin(seed)) == ()


@pytest.mark.parametrize("name", NAMED)
def test_a_mistake_is_the_likeliest_cause(name: str):
    twin, fault = NAMED[name]
    causes = misspecification_hypotheses(fault(twin(1), np.random.default_rng(0)))
    assert causes[0].cause in fault.causes
    assert "{" not in causes[0].message


@pytest.mark.parametrize("name", SILENT)
def test_a_misfit_that_another_stiffness_explains_is_no_concern(name: str):
    wrong = POKING_FAULTS[name](poked_twin(1), np.random.default_rng(0))
    assert misspecification_hypotheses(wrong) == ()


def test_a_load_in_the_frame_of_a_turned_plate_is_not_doubted():
    """Normal and load turn with the plate."""
    turned = np.diag([1.0, -1.0, -1.0])
    half_turn_xyzw = [1.0, 0.0, 0.0, 0.0]
    right = sheared_twin(1)
    (experiment,) = right.experiments
    (plate,) = experiment.obstacles
    assert plate.wrench is not None
    poses = plate.poses
    same = replace(
        plate,
        poses=replace(poses, quaternions_xyzw=np.tile(half_turn_xyzw, (len(poses.t_s), 1))),
        shape=Plane(turned @ plate.shape.normal, turned @ plate.shape.point_m),
        wrench=replace(plate.wrench, values=plate.wrench.values[:, :3] @ turned, frame="grasp"),
    )
    given = experiment.with_obstacles([same])
    assert [*obstacle_hypotheses(given)] == []
    wrong = replace(same, wrench=replace(same.wrench, frame="world"))
    causes = {each.cause for each in obstacle_hypotheses(experiment.with_obstacles([wrong]))}
    assert "obstacle-pull" in causes


def test_a_pull_within_the_tare_is_not_doubted():
    wrong = wrench_times(-0.01, 1)
    (experiment,) = poked_twin(1).experiments
    small = wrong(experiment, np.random.default_rng(0))
    assert [*obstacle_hypotheses(small)] == []
    (plate,) = sheared_twin(1).experiments
    tared = replace(plate, nuisance=replace(Nuisance.none(), tare=4 / DRAGGED_NOISE_N))
    pulled = wrench_times(-1, 1)(tared, np.random.default_rng(0))
    assert "obstacle-pull" not in {each.cause for each in obstacle_hypotheses(pulled)}
