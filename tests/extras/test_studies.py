"""Study scripts run on very small problems."""

from __future__ import annotations

import numpy as np
import pytest
import study_faults
from assumed_twins import _body
from studies import markdown

from collocation_sysid.statistics.budget.shape_error import thickness_m

pytestmark = pytest.mark.long


def test_tables_are_markdown():
    assert markdown(("a", "λ"), [("x", "1")]) == "| a | λ |\n| --- | ---: |\n| x | 1 |"


# Faults -------------------------------------------------------------------------------------------


def test_a_twin_with_noisy_poses_is_identified_and_listed():
    found = study_faults.run("poses 0.5 mm, 0.3°, estimated", (0, 1))
    assert found.converged
    assert found.contains_truth.sum() >= 3
    line = study_faults.table_row("poses", [found])
    assert len(line) == len(study_faults.HEADS)
    assert line[0] == "poses"
    assert float(line[7]) == pytest.approx(100 * found.relative[0], rel=0.05)
    assert line[-1] == "0"


def test_errors_of_surface_and_grip_move_the_nodes_by_their_size():
    experiment = study_faults.exact_recording()
    (grasp,), body = experiment.grasps, experiment.body
    moved = _body(experiment, {"grasp_edge_m": 2e-3})
    shifts_m = moved.nodes_m - body.nodes_m
    assert np.linalg.norm(shifts_m[grasp.nodes], axis=1) == pytest.approx(2e-3)
    assert np.delete(shifts_m, grasp.nodes, axis=0) == pytest.approx(0)
    swollen = _body(experiment, {"surface 1": 0.01})
    largest_m = np.linalg.norm(swollen.nodes_m - body.nodes_m, axis=1).max()
    assert 0.1 < largest_m / (0.01 * thickness_m(body)) < 5


def test_faults_have_the_size_in_their_name():
    rng, measured = np.random.default_rng(0), study_faults.exact_recording()
    before = measured.markers.positions_m
    late, stated = study_faults.FAULTS["clock 2 ms late"](measured, rng)
    speed = np.gradient(before, measured.timestep_s, axis=0)
    change = late.markers.positions_m - stated.markers.positions_m
    assert np.abs(change + 0.002 * speed).max() < 0.1 * np.abs(change).max()
    actual, noisy = study_faults.FAULTS["poses 0.5 mm, 0.3°, given"](measured, rng)
    shaken, smooth = noisy.grasps[0].poses, actual.grasps[0].poses
    assert (shaken.positions_m - smooth.positions_m).std() == pytest.approx(5e-4, rel=0.2)
    assert noisy.grasps[0].sigma_rad == pytest.approx(np.radians(0.3))
    moved, _ = study_faults.FAULTS["marker positions 1 mm"](measured, rng)
    offsets = moved.markers.positions_m - before
    assert np.linalg.norm(offsets, axis=2).mean() == pytest.approx(1.6e-3, rel=0.4)
