"""The problems that ship with the project, solved as a user solves them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from collocation_sysid import load_problem, run, write_run

PROBLEMS = Path(__file__).parents[1] / "problems"
FOAM = {"lambda_pa": 800.0, "mu_pa": 600.0, "gamma_r_s": 0.006, "gamma_m_1_s": 1.5}
TABLE1 = {"lambda_pa": 200.0, "mu_pa": 300.0, "gamma_r_s": 0.009, "gamma_m_1_s": 1.0}
PAPER_TIP_ERROR_M = 0.15


def solved(path: Path, folder: Path, method: str) -> dict:
    """The content of result.json."""
    finished = run(load_problem(path), method)
    return json.loads((write_run(finished, folder, frames=False) / "result.json").read_text())


def relative_errors(result: dict, truth: dict) -> np.ndarray:
    return np.array([result["parameters"][name]["value"] / truth[name] - 1 for name in truth])


@pytest.mark.parametrize("method", ["reduced-space", "interior-point"])
def test_foam_cylinder_errors_are_consistent_with_the_noise(method: str, tmp_path: Path):
    result = solved(PROBLEMS / "foam_cylinder" / "problem.toml", tmp_path / "run", method)
    assert result["status"] == "converged"
    deviations = np.array([result["parameters"][name]["std_error"] for name in FOAM])
    errors = relative_errors(result, FOAM) * list(FOAM.values())
    assert np.abs(errors / deviations).max() < 3.5
    # 0.5 mm a coordinate, three coordinates
    assert result["fit"]["rms_m"] == pytest.approx(0.0005 * np.sqrt(3), rel=0.06)
    assert result["rollout"]["rms_m"] < 1.1 * result["fit"]["rms_m"]
    assert result["dynamics"]["max_violation_relative"] < 1e-8


@pytest.mark.parametrize(
    "method", ["reduced-space", pytest.param("interior-point", marks=pytest.mark.slow)]
)
@pytest.mark.parametrize(("file", "within"), [("problem_scheme", 1e-4), ("problem", 1e-2)])
def test_table1_recovers_the_truth(file: str, within: float, method: str, tmp_path: Path):
    result = solved(PROBLEMS / "table1" / f"{file}.toml", tmp_path / "run", method)
    assert result["status"] == "converged"
    assert np.abs(relative_errors(result, TABLE1)).max() < within
    assert result["rollout"]["max_m"] < 0.001 < PAPER_TIP_ERROR_M


@pytest.mark.slow
def test_the_measured_beam_converges(tmp_path: Path):
    path = PROBLEMS / "srl_beam" / "problem.toml"
    if not (path.parent / "gravity_markers.csv").is_file():
        pytest.skip("needs the measured data: python scripts/get_srl_beam.py")
    result = solved(path, tmp_path / "run", "interior-point")
    assert result["status"] == "converged"
    assert 5e4 < result["parameters"]["young_pa"]["value"] < 3e5
    assert result["fit"]["rms_m"] < 0.003
