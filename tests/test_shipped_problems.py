"""The problems that ship with the project, solved as a user solves them."""

from __future__ import annotations

import json
import os
import tomllib
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from collocation_sysid import Problem, load_problem, run, solve, write_run
from collocation_sysid.experiment import Nuisance, place_markers
from collocation_sysid.methods import METHODS
from collocation_sysid.nlp.collocation import Collocation
from collocation_sysid.results.solution import Solution
from collocation_sysid.results.uncertainty import Uncertainty, covariance
from collocation_sysid.run import Run

PROBLEMS = Path(__file__).parents[1] / "problems"
# A folder with the C3D files of scripts/get_srl_beam.py.
RECORDINGS = Path(os.environ.get("SRL_BEAM_DATA", PROBLEMS / "srl_beam")).resolve()
FOAM = {"lambda_pa": 800.0, "mu_pa": 600.0, "gamma_r_s": 0.006, "gamma_m_1_s": 1.5}
TABLE1 = {"lambda_pa": 200.0, "mu_pa": 300.0, "gamma_r_s": 0.009, "gamma_m_1_s": 1.0}
PAPER_TIP_ERROR_M = 0.15
NOISY = {"lambda_pa": 2500.0, "mu_pa": 1500.0, "gamma_r_s": 0.005, "gamma_m_1_s": 1.5}
MISPLACED, GLUED_M = "tip_2", (0.006, 0.02598, 0.155)
SWAPPED = {"low_1", "mid_1", "tip_1", "tip_3"}


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


# The measured beam -----------------------------------------------------------------------------


def measured_beam(file: str) -> Problem:
    """A problem of the measured beam with the recordings of SRL_BEAM_DATA, or skip."""
    pytest.importorskip("ezc3d")
    path = PROBLEMS / "srl_beam" / file
    files = {}
    for table in tomllib.loads(path.read_text())["experiment"]:
        files[table["name"]] = RECORDINGS / table["markers"]["file"]
    if not all(recording.is_file() for recording in files.values()):
        pytest.skip("needs the measured data: python scripts/get_srl_beam.py")
    return load_problem(
        path, [f"experiment.{name}.markers.file={file}" for name, file in files.items()]
    )


def test_the_measured_beam_swings_as_an_elastic_one_would():
    finished = run(measured_beam("gravity.toml"), "reduced-space")
    assert finished.solution.status.converged
    assert finished.solution.rms_m < 0.0003
    # Without a load, beam theory puts E at 277 kPa; this mesh is somewhat too stiff.
    assert 2.5e5 < finished.solution.parameters["young_pa"] < 2.8e5
    assert 1e-3 < finished.solution.parameters["gamma_r_s"] < 3e-3


@pytest.mark.slow
def test_interior_point_agrees_on_the_noisy_cylinder():
    # From the file's guess, a factor of three off, IPOPT loses its way in Huber's flat slopes.
    near = [f"parameters.{name}.guess={value}" for name, value in NOISY.items()]
    problem = load_problem(PROBLEMS / "noisy_cylinder" / "problem.toml", near)
    reduced, interior = noisy_fit(huber=True, offsets=True), run(problem, "interior-point").solution
    assert interior.status.converged
    found, expected = (s.collocation.parameters_of(s.z) for s in (interior, reduced))
    np.testing.assert_allclose(found, expected, atol=1e-3)
