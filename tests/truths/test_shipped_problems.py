"""The problems of the project, solved as users solve them."""

from __future__ import annotations

import json
import os
import re
import tomllib
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from kit.wrenches import without_grasp_sensors

from collocation_sysid import Assumptions, Problem, run, simulate, solve
from collocation_sysid.methods.solution import Solution, pooled_wrench_rms
from collocation_sysid.pipeline import Run
from collocation_sysid.recording import Nuisance
from collocation_sysid.runs.check import check_problem
from collocation_sysid.statistics.pose_noise import uncertainty_at
from collocation_sysid.statistics.uncertainty import ErrorModel, Uncertainty

PROBLEMS = Path(__file__).parents[2] / "problems"
# A folder with the C3D files of scripts/data/get_srl_beam.py.
RECORDINGS = Path(os.environ.get("SRL_BEAM_DATA", PROBLEMS / "srl_beam")).resolve()
FOAM = {"lambda_pa": 800.0, "mu_pa": 600.0, "gamma_r_s": 0.006, "gamma_m_1_s": 1.5}
TABLE1 = {"lambda_pa": 200.0, "mu_pa": 300.0, "gamma_r_s": 0.009, "gamma_m_1_s": 1.0}
PAPER_TIP_ERROR_M = 0.15
NOISY = {"lambda_pa": 2500.0, "mu_pa": 1500.0, "gamma_r_s": 0.005, "gamma_m_1_s": 1.5}
MISPLACED, GLUED_M = "tip_2", (0.006, 0.02598, 0.155)
SWAPPED = {"low_1", "mid_1", "tip_1", "tip_3"}


def solved(path: Path, folder: Path, method: str) -> dict:
    """The content of result.json."""
    finished = run(Problem.read(path), method)
    return json.loads((finished.save(folder, frames=False) / "result.json").read_text())


def relative_errors(result: dict, truth: dict) -> np.ndarray:
    return np.array([result["parameters"][name]["value"] / truth[name] - 1 for name in truth])


@pytest.mark.parametrize(
    "method", ["reduced-space", pytest.param("interior-point", marks=pytest.mark.slow)]
)
def test_foam_cylinder_errors_are_consistent_with_the_noise(method: str, tmp_path: Path):
    result = solved(PROBLEMS / "foam_cylinder" / "problem.toml", tmp_path / "run", method)
    assert result["status"] == "converged"
    deviations = np.array([result["parameters"][name]["statistical_std_error"] for name in FOAM])
    errors = relative_errors(result, FOAM) * list(FOAM.values())
    assert np.abs(errors / deviations).max() < 3.5
    # 0.5 mm a coordinate, three coordinates
    assert result["fit"]["rms_m"] == pytest.approx(0.0005 * np.sqrt(3), rel=0.06)
    assert result["rollout"]["rms_m"] < 1.1 * result["fit"]["rms_m"]
    assert result["dynamics"]["max_violation_relative"] < 1e-8


@pytest.mark.parametrize(
    "method", ["reduced-space", pytest.param("interior-point", marks=pytest.mark.slow)]
)
@pytest.mark.parametrize(
    ("file", "within"),
    [("problem_scheme", 1e-4), pytest.param("problem", 1e-2, marks=pytest.mark.long)],
)
def test_table1_recovers_the_truth(file: str, within: float, method: str, tmp_path: Path):
    result = solved(PROBLEMS / "table1" / f"{file}.toml", tmp_path / "run", method)
    assert result["status"] == "converged"
    assert np.abs(relative_errors(result, TABLE1)).max() < within
    assert result["rollout"]["max_m"] < 0.001 < PAPER_TIP_ERROR_M


WRIST = {"young_pa": 2.5e4, "density_kg_m3": 120.0}


@pytest.mark.long
@pytest.mark.parametrize("felt", [True, False], ids=["with the sensor", "without"])
def test_a_wrist_sensor_separates_stiffness_and_density(felt: bool):
    # What the steps are off by shows beside error bars as small as those with the sensor.
    steps = f"transcription.substeps={3 if felt else 1}"
    shorter = [steps, "experiment.swing.window_s=[0.0, 0.5]"]
    problem = Problem.read(PROBLEMS / "wrist_sensor" / "problem.toml", shorter)
    if not felt:
        problem = replace(
            problem, experiments=tuple(map(without_grasp_sensors, problem.experiments))
        )
    finished = run(problem, seek_causes=False)
    assert finished.solution.status.converged
    estimates = finished.uncertainty.estimates
    if felt:
        options = replace(problem.uncertainty, assumptions=Assumptions.exact())
        exact = run(replace(problem, uncertainty=options), seek_causes=False).uncertainty.estimates
        for name, true in WRIST.items():
            found = exact[name]
            assert abs(found.value - true) < 2.6 * found.statistical_std_error < 0.02 * true, name
            low, high = finished.interval(name)
            assert low < true < high < 1.15 * low, name
        return
    assert {estimates[name].statistical_std_error for name in WRIST} == {None}
    ratio = estimates["young_pa"].value / estimates["density_kg_m3"].value
    assert ratio == pytest.approx(WRIST["young_pa"] / WRIST["density_kg_m3"], rel=0.03)
    assert finished.trust.verdict == "doubtful"
    assert any("are identifiable (E/ρ)" in reason for reason in finished.trust.reasons)


@pytest.mark.long
def test_a_poked_block_of_unknown_place_determines_its_stiffness():
    problem = Problem.read(
        PROBLEMS / "poked_block" / "problem.toml", ["parameters.young_pa.guess=1.7e4"]
    )
    finished = run(problem, seek_causes=False)
    assert finished.solution.status.converged
    assert {each.code for each in finished.trust.concerns} == {"contact/coarse"}
    low, high = finished.result.parameters["young_pa"].statistical95
    assert low < 2e4 < high
    assert high - low < 0.05 * 2e4 / np.sqrt(12)  # of one place 5 %


# The measured beam -----------------------------------------------------------------------------


def measured_beam(file: str) -> Problem:
    """A problem of the measured beam with the recordings of SRL_BEAM_DATA, or skip."""
    pytest.importorskip("ezc3d")
    path = PROBLEMS / "srl_beam" / file
    files = {}
    for table in tomllib.loads(path.read_text())["experiment"]:
        files[table["name"]] = RECORDINGS / table["markers"]["file"]
    if not all(recording.is_file() for recording in files.values()):
        pytest.skip("needs the measured data: python scripts get_srl_beam")
    return Problem.read(
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
def test_interior_point_agrees_on_the_measured_beam():
    problem = measured_beam("gravity.toml")
    reduced, interior = (solve(problem, "reduced-space"), solve(problem, "interior-point"))
    assert reduced.status.converged
    assert interior.status.converged
    found, expected = (s.collocation.parameters_from(s.z) for s in (interior, reduced))
    np.testing.assert_allclose(found, expected, atol=1e-4)


@pytest.mark.slow
def test_one_material_fits_the_measured_beam_under_three_loads():
    solution = solve(measured_beam("problem.toml"))
    assert solution.status.converged
    assert 2.7e5 < solution.parameters["young_pa"] < 3.1e5
    limits_m = {"gravity": 0.00030, "load52": 0.00075, "load101": 0.00115}
    for transcription, readings_m in zip(
        solution.collocation.transcriptions, solution.readings_m, strict=True
    ):
        measured_m = transcription.experiment.markers.positions_m
        rms_m = np.sqrt(np.mean(np.sum((readings_m - measured_m) ** 2, axis=2)))
        assert rms_m < limits_m[transcription.experiment.name]


@pytest.mark.slow
def test_memory_explains_the_creep_of_the_measured_beam():
    solution = solve(measured_beam("memory.toml"))
    assert solution.status.converged
    assert 2.5e5 < solution.parameters["young_pa"] < 2.75e5
    assert 0.08 < solution.parameters["prony_1.share"] < 0.15
    limits_m = {"gravity": 0.00016, "load52": 0.00036, "load101": 0.00071}
    for name, rms_m in solution.rms_by_experiment_m.items():
        assert rms_m < limits_m[name]


# Equilibria of measured bodies -----------------------------------------------------------------


def measured(
    name: str, variable: str, file: str = "problem.toml", changes: Sequence[str] = ()
) -> Problem:
    """A problem with the files that its script has written, next to it or where told, or skip."""
    path = PROBLEMS / name / file
    text, folder = (path.read_text(), Path(os.environ.get(variable, path.parent)).resolve())
    if not all((folder / each).is_file() for each in re.findall(r'"(\w+\.csv)"', text)):
        pytest.skip(f"needs the measured data: python scripts get_{name}")
    mesh = tomllib.loads(text)["object"].get("mesh")
    beside = [f"object.mesh={path.parent / mesh}"] if mesh else []
    return Problem.read(path, [*beside, *changes], folder=folder)


@pytest.mark.slow
def test_pressed_cylinders_are_predicted_within_their_repeatability():
    problem = measured("phantom_compression", "PHANTOM_DATA")
    found = run(problem, seek_causes=False)
    assert found.solution.status.converged
    assert 6.9e4 < found.derived["young_pa"] < 7.6e4
    loads_n = [4 * e.grasps[1].wrench.values[:, 2] for e in problem.experiments]
    floor_n = np.sqrt(np.mean(np.var(loads_n, axis=0, ddof=1)))
    missed_n = [found.rollouts[name].wrench_rms_n for name in ("A2", "A4")]
    assert np.sqrt(np.mean(np.square(missed_n))) < 1.2 * floor_n


STROKE = {"c10_pa": 1.2e4, "c20_pa": -250.0, "c30_pa": 35.0, "kappa_pa": 2e6}


def pressed_n(problem: Problem, friction: float) -> np.ndarray:
    """Loads of a whole specimen."""
    still = {"gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
    found = simulate(problem.experiments[0], {**STROKE, **still, "platen_friction": friction})
    return -4 * found.wrenches[0][:, 2]


@pytest.mark.long
def test_an_eighth_of_a_cylinder_stands_for_the_whole_and_its_friction_resists(tmp_path: Path):
    """Without friction the state is uniform, and what the load is can be written down."""
    compressed_mm = np.array([0.0, 3.0, 6.0])
    rows = [f"{6 * mm:g},{mm:g},0,{-mm / 30:.9f}" for mm in compressed_mm]
    head = "Time (s),Compression (mm),Load (N),Engineering Strain [-]"
    for name in ("A1", "A2", "A3", "A4", "A5"):
        (tmp_path / f"EF30_0T_{name}.csv").write_text("\n".join([head, *rows]) + "\n")
    folder = PROBLEMS / "phantom_compression"
    changes = ["experiment.A1.every=1", f"object.mesh={folder / 'eighth.vtu'}"]
    problem = Problem.read(folder / "whole_stroke.toml", changes, folder=tmp_path)
    stretch = 1 - compressed_mm / 30
    past = stretch**2 + 2 / stretch - 3
    slope_pa = STROKE["c10_pa"] + 2 * STROKE["c20_pa"] * past + 3 * STROKE["c30_pa"] * past**2
    uniform_n = 2 * (1 / stretch**2 - stretch) * slope_pa * np.pi * 0.025**2
    sliding_n, rubbing_n = pressed_n(problem, 0.0), pressed_n(problem, 0.4)
    # The mesh is 1.3 % too stiff.
    np.testing.assert_allclose(sliding_n[1:], uniform_n[1:], rtol=0.015)
    # Of a thin slab that slides all over, the mean pressure grows by about μ d/(3 h).
    slab = 0.4 * 50 / 30 / 3 / stretch**1.5
    more = rubbing_n[1:] / sliding_n[1:] - 1
    assert (0.5 * slab[1:] < more).all()
    assert (more < 1.5 * slab[1:]).all()


@pytest.mark.slow
def test_one_silicone_and_one_friction_press_to_a_third_of_the_height():
    problem = measured("phantom_compression", "PHANTOM_DATA", "whole_stroke.toml")
    assert not check_problem(problem).derivative_fault
    alone = solve(replace(problem, experiments=problem.experiments[:1]))
    assert alone.status.converged
    wrench = alone.collocation.transcriptions[0].experiment.obstacles[0].wrench
    largest_n = wrench.symmetry * np.abs(wrench.values).max()
    assert pooled_wrench_rms(alone)[0] < 0.002 * largest_n
    assert 6.8e4 < 6 * alone.parameters["c10_pa"] < 7.9e4
    assert 0.1 < alone.parameters["platen_friction"] < 0.35


@pytest.mark.slow
def test_a_neo_hookean_says_that_the_platens_stick():
    constants = "{ mu_pa = { guess = 1.2e4 }, poisson = 0.4988, gamma_r_s = 0, gamma_m_1_s = 0 }"
    changes = ("object.material=neo-hookean", f"parameters={constants}")
    sticking, sliding = (
        solve(measured("phantom_compression", "PHANTOM_DATA", file, changes))
        for file in ("problem.toml", "sliding.toml")
    )
    assert pooled_wrench_rms(sliding)[0] > 1.5 * pooled_wrench_rms(sticking)[0]
    assert sliding.parameters["mu_pa"] > 1.2 * sticking.parameters["mu_pa"]


@pytest.mark.slow
def test_a_tentacle_bent_by_tendons_is_fitted_to_a_few_millimetres():
    found = run(measured("soft_tentacle", "TENTACLE_DATA"), seek_causes=False)
    assert found.solution.status.converged
    assert 3.4e5 < found.parameters["young_pa"] < 4.1e5
    assert found.solution.rms_m < 0.007
    assert any("more than the error of cameras" in said for said in found.trust.reasons)


# What motion capture does to markers ----------------------------------------------------------


@cache
def noisy_run() -> Run:
    """The noisy cylinder as its problem file has it: both remedies, and all nuisances."""
    return run(Problem.read(PROBLEMS / "noisy_cylinder" / "problem.toml"), seek_causes=False)


@cache
def noisy_fit(huber: bool, offsets: bool) -> Solution:
    """The noisy cylinder with or without each of its two remedies, and nothing else allowed for."""
    problem = noisy_run().problem
    (experiment,) = problem.experiments
    allowed = experiment.nuisance.marker_offset_m if offsets else None
    alone = replace(experiment, nuisance=Nuisance.none(marker_offset_m=allowed))
    return solve(replace(problem, experiments=[alone], huber=problem.huber if huber else None))


@cache
def attainable() -> Uncertainty:
    """Error bars of the fit with both remedies for white noise of the sigma_m given."""
    solution = noisy_fit(huber=True, offsets=True)
    return uncertainty_at(solution.collocation, solution.z, ErrorModel(errors="independent"))


def standard_errors_off(solution: Solution) -> np.ndarray:
    """Errors of ln θ over the standard deviations that these data allow."""
    errors = np.log([solution.parameters[name] / NOISY[name] for name in NOISY])
    return np.abs(errors) / np.sqrt(np.diag(attainable().covariance))


@pytest.mark.long
@pytest.mark.parametrize("as_shipped", [True, False])
def test_huber_and_offsets_together_recover_the_truth_from_the_noisy_cylinder(as_shipped: bool):
    solution = noisy_run().solution if as_shipped else noisy_fit(huber=True, offsets=True)
    assert solution.status.converged
    assert solution.kkt_residual < 1e-6  # of the whole program, as interior point would leave it
    assert standard_errors_off(solution).max() < 3.0


@pytest.mark.long
@pytest.mark.parametrize(
    ("huber", "offsets"),
    [
        pytest.param(False, False, id="plain-least-squares", marks=pytest.mark.slow),
        pytest.param(True, False, id="huber-alone"),
        pytest.param(False, True, id="offsets-alone"),
    ],
)
def test_neither_remedy_is_enough_for_the_noisy_cylinder(huber: bool, offsets: bool):
    solution = noisy_fit(huber, offsets)
    assert solution.status.converged
    assert standard_errors_off(solution).max() > 4.5


@pytest.mark.long
def test_the_misplaced_marker_is_found_where_it_is_glued():
    places = dict(noisy_run().places["swing"])
    found = places.pop(MISPLACED)
    assert (np.abs(found.position_m - GLUED_M) / found.std_error_m).max() < 3.0
    assert found.displacement_m > 0.005
    assert max(place.displacement_m for place in places.values()) < 0.001


@pytest.mark.long
def test_the_noisy_cylinders_gaps_and_swaps_are_reported(tmp_path: Path):
    folder = noisy_run().save(tmp_path / "run", frames=False)
    result = json.loads((folder / "result.json").read_text())
    assert result["fit"]["experiments"]["swing"]["missing"] == 58
    assert any("tip_1: 20 of 81 samples missing" in note for note in result["notes"])
    distances_m = {line["marker"]: line["rms_m"] for line in result["residuals"]}
    worst = sorted(distances_m, key=lambda name: distances_m[name])[-len(SWAPPED) :]
    assert set(worst) == SWAPPED
