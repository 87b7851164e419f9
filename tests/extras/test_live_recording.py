"""Recordings of live estimates for the Rerun viewer, read back with its own library."""

from __future__ import annotations

import io
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from kit.problem_files import run_command, write_problem
from kit.rerun_files import read_back, seconds

from collocation_sysid import Problem

pytest.importorskip("rerun")


@pytest.fixture(scope="module")
def problem_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_problem(tmp_path_factory.mktemp("live"), {"swing": 8})


@pytest.fixture(scope="module")
def lines(problem_file: Path) -> list[dict]:
    """Printed estimates of the frames, and at the end the final ones, with their recording."""
    file = problem_file.parent / "new" / "swing.rrd"
    # No time to pass frames again: results do not depend on the machine.
    words = ("--json", "--rate", "0", "--budget-ms", "1e-6", "--rerun", file)
    outcome = run_command("replay", problem_file, *words)
    assert outcome.code == 0, outcome.err
    return [json.loads(line) for line in outcome.out.splitlines()]


@pytest.fixture(scope="module")
def recorded(problem_file: Path, lines: list[dict]) -> dict:
    return read_back(problem_file.parent / "new" / "swing.rrd")


def numbers(entity: dict) -> np.ndarray:
    return np.array([values[0] for values in entity["scalars"]])


def test_estimates_and_intervals_are_those_that_are_printed(recorded, lines):
    for name, last in lines[-1]["parameters"].items():
        curve = recorded[f"parameters/{name}/value"]
        values = [line["parameters"][name]["value"] for line in lines]
        assert numbers(curve) == pytest.approx(np.array(values))
        times = [line["t_s"] for line in lines]
        assert seconds(curve["time"]) == pytest.approx(np.array(times))
        lower = numbers(recorded[f"parameters/{name}/lower"])
        assert lower[-1] == pytest.approx(last["statistical95"][0])


def test_the_surface_is_near_the_markers_at_the_estimate(recorded, lines, problem_file):
    """Residuals of markers on the surface are the distances of both entities."""
    (experiment,) = Problem.read(problem_file).experiments
    body = recorded["body"]
    positions_m = np.array(body["vertex_positions"])
    assert len(positions_m) == len(lines) - 1
    (triangles,) = body["static triangle_indices"]
    nodes = np.unique(experiment.body.mesh.surface)
    assert (nodes[np.array(triangles)] == experiment.body.mesh.surface).all()
    shapes_m = np.zeros((len(positions_m), len(experiment.body.nodes.points_m), 3))
    shapes_m[:, nodes] = positions_m
    predicted_m = experiment.markers.predict_positions(shapes_m)
    measured_m = np.array(recorded["markers"]["positions"])
    distances_mm = 1e3 * np.linalg.norm(predicted_m - measured_m, axis=2)
    placement = experiment.markers.placement
    is_drawn = [
        set(near[np.abs(weights) > 1e-9]) <= set(nodes)
        for near, weights in zip(placement.nodes, placement.weights, strict=True)
    ]
    assert any(is_drawn)
    last_mm = np.array(
        [numbers(recorded[f"residuals_mm/{name}"])[-1] for name in experiment.markers.names]
    )
    # Residuals are of the estimate before the last frame, the surface of that after it: 0.038 mm.
    assert distances_mm[-1][is_drawn] == pytest.approx(last_mm[is_drawn], abs=0.06)


def test_residuals_are_those_that_are_printed(recorded, lines, problem_file):
    (experiment,) = Problem.read(problem_file).experiments
    distances_mm = np.array(
        [numbers(recorded[f"residuals_mm/{name}"]) for name in experiment.markers.names]
    )
    rms_mm = np.sqrt((distances_mm**2).mean(axis=0))
    printed_mm = np.array([1e3 * line["marker_rms_m"] for line in lines[:-1]])
    assert rms_mm == pytest.approx(printed_mm)


def test_the_verdict_and_the_notes_are_texts(recorded, lines):
    texts = [values[0] for values in recorded["verdict"]["text"]]
    assert texts[-1].splitlines()[0] == lines[-1]["trust"]["verdict"]
    notes = [values[0] for values in recorded["notes"]["text"]]
    assert "final estimate after the last frame" in notes


def test_the_command_live_records_too(problem_file, lines, tmp_path, monkeypatch):
    """The file is complete although a frame was invalid."""
    (experiment,) = Problem.read(problem_file).experiments
    (rotations, translations) = experiment.grasps[0].poses.at(experiment.t_s)
    from scipy.spatial.transform import Rotation

    quaternions = Rotation.from_matrix(rotations).as_quat()
    frames = [
        json.dumps(
            {
                "t_s": float(t_s),
                "pose": {
                    "position_m": translations[k].tolist(),
                    "quaternion_xyzw": quaternions[k].tolist(),
                },
                "markers": dict(
                    zip(
                        experiment.markers.names,
                        experiment.markers.positions_m[k].tolist(),
                        strict=True,
                    )
                ),
            }
        )
        for k, t_s in enumerate(experiment.t_s)
    ]
    text = "\n".join(["no frame", *frames]) + "\n"
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(text.encode())))
    file = tmp_path / "live.rrd"
    outcome = run_command("live", problem_file, "--rerun", file)
    assert outcome.code == 2
    printed = [json.loads(line) for line in outcome.out.splitlines()]
    (name, *_) = printed[-1]["parameters"]
    curve = read_back(file)[f"parameters/{name}/value"]
    values = [line["parameters"][name]["value"] for line in printed]
    assert numbers(curve) == pytest.approx(np.array(values))


@pytest.mark.parametrize(
    ("name", "message"),
    [("swing.gif", "--rerun: found '.gif'; expected .rrd"), ("there.rrd", "not overwritten")],
)
def test_a_file_that_cannot_be_written_is_refused_before_the_first_frame(
    problem_file, tmp_path, name: str, message: str
):
    (tmp_path / "there.rrd").write_text("a recording")
    words = ("--rate", "0", "--rerun", tmp_path / name)
    outcome = run_command("replay", problem_file, *words)
    assert outcome.code == 2
    assert message in outcome.err
    assert (tmp_path / "there.rrd").read_text() == "a recording"
    assert [each.name for each in tmp_path.iterdir()] == ["there.rrd"]
