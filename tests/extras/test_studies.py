"""Study scripts run on very small problems."""

from __future__ import annotations

import numpy as np
import pytest
import study_faults
import study_table1
from assumed_twins import _body
from studies import PARAMETER_SYMBOLS, TRUTH, markdown, run_variants

from collocation_sysid.statistics.budget.shape_error import thickness_m

pytestmark = pytest.mark.long


def cells(table: str) -> list[list[str]]:
    """Rows of a Markdown table, without its head and rule."""
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table.split("\n")][2:]


def row(**changes) -> dict:
    """What a study knows of a run that found the truth."""
    found = {f"value_{name}": value for name, value in TRUTH.items()}
    errors = {f"error_{name}": 0.0 for name in TRUTH}
    numbers = dict.fromkeys(("rms_m", "violation_n", "violation_relative"), 0.0)
    rest = {"iterations": 8, "total_s": 1.0, "wall_s": 3.0, "converged": True}
    return {**found, **errors, **numbers, **rest, "status": "converged", **changes}


# Table I ------------------------------------------------------------------------------------------


def test_table_1_sets_every_method_beside_truth_and_paper():
    stopped = row(rms_m=None, total_s=None, status="timeout")
    lines = cells(study_table1.table({"one": row(), "other": stopped}))
    truth, paper, one, other = lines
    assert {len(line) for line in lines} == {11}
    assert one[1:5] == truth[1:5] == ["200", "300", "0.009", "1"]
    assert paper[1] == "734.3"
    assert (other[5], other[-1]) == ("–", "timeout")


def test_table_1_names_options_that_the_methods_have(monkeypatch):
    monkeypatch.setattr("studies.run_all", lambda *_, **__: None)
    rows = run_variants(study_table1.PROBLEM, study_table1.VARIANTS)
    assert list(rows) == [each.name for each in study_table1.VARIANTS]


def test_tables_are_markdown():
    assert (
        markdown(("a", *PARAMETER_SYMBOLS[:1]), [("x", "1")])
        == "| a | λ |\n| --- | ---: |\n| x | 1 |"
    )


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
