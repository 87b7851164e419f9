"""Modules that studies share, on very small problems."""

from __future__ import annotations

import hidden_twins
import numpy as np
import pytest
from assumed_twins import _body
from studies import markdown

from collocation_sysid.statistics.budget.shape_error import thickness_m


def test_tables_are_markdown():
    assert markdown(("a", "λ"), [("x", "1")]) == "| a | λ |\n| --- | ---: |\n| x | 1 |"


def test_errors_of_surface_and_grip_move_the_nodes_by_their_size():
    experiment = hidden_twins.recording(hidden_twins.block(), 0)
    (grasp,), body = experiment.grasps, experiment.body
    moved = _body(experiment, {"grasp_edge_m": 2e-3})
    shifts_m = moved.nodes_m - body.nodes_m
    assert np.linalg.norm(shifts_m[grasp.nodes], axis=1) == pytest.approx(2e-3)
    assert np.delete(shifts_m, grasp.nodes, axis=0) == pytest.approx(0)
    swollen = _body(experiment, {"surface 1": 0.01})
    largest_m = np.linalg.norm(swollen.nodes_m - body.nodes_m, axis=1).max()
    assert 0.1 < largest_m / (0.01 * thickness_m(body)) < 5
