"""The measured pneumatic arm: mesh, recordings and the effect of its reinforcement."""

from __future__ import annotations

import runpy
import tomllib
from dataclasses import replace

import casadi as ca
import get_pneumatic_arm as arm
import numpy as np
import pytest
import study_pneumatic_arm as study

from collocation_sysid import Problem, solve
from collocation_sysid.errors import SimulationError
from collocation_sysid.fem.laws.fibres import FibreLaw, reinforced
from collocation_sysid.fem.laws.materials import MATERIALS
from collocation_sysid.fem.meshes.mesh import TetMesh

FILE = arm.FOLDER / "problem.toml"


def measured_problem() -> Problem:
    """Return the shipped problem, or skip the test if its recordings have not been fetched."""
    require_recordings()
    return Problem.read(FILE, allow_code=True)


def require_recordings() -> None:
    """Skip the test if the recordings have not been fetched."""
    if not (arm.FOLDER / "100mbar.csv").is_file():
        pytest.skip("needs the measured data: python scripts get_pneumatic_arm")


def test_the_shipped_mesh_and_fibres_are_those_of_the_script():
    shape = arm.ArmShape()
    written = TetMesh.read(arm.FOLDER / "arm.vtu")
    made = arm.arm_mesh(shape)
    np.testing.assert_allclose(written.points_m, made.points_m, atol=1e-12)
    np.testing.assert_array_equal(written.tetrahedra, made.tetrahedra)
    stated = tomllib.loads(FILE.read_text())["parameters"]
    angles = [stated[f"ring_{k}.fibre_angle_rad"]["fixed"] for k in range(1, 8)]
    np.testing.assert_allclose(angles, arm.fibre_angles(shape), atol=1e-4)


def test_the_energy_of_the_wall_is_that_of_quadratic_fibres():
    function = runpy.run_path(str(arm.FOLDER / "reinforced.py"))["reinforced"]
    fibres = FibreLaw(is_turned=True, tension_only=False)
    other = reinforced(MATERIALS["neo-hookean"], fibres).energy
    F = ca.SX(ca.DM(np.array([[1.1, 0.05, -0.02], [0.03, 0.9, 0.04], [-0.01, 0.06, 1.02]])))
    constants = {"lambda_pa": 8e5, "mu_pa": 9e4, "fibre_pa": 8.5e5, "fibre_angle_rad": 2.0704}
    energies = [float(ca.DM(ca.evalf(law(F, **constants)))) for law in (function, other)]
    assert energies[0] == pytest.approx(energies[1], rel=1e-12)


def test_the_mesh_fills_half_of_the_arm_without_its_chambers():
    shape = arm.ArmShape()
    inner_m = shape.radius_m - shape.wall_m
    ring_m2 = np.pi / 2 * (shape.radius_m**2 - inner_m**2)
    cross_m2 = 2 * shape.cross_m * inner_m - shape.cross_m**2 / 2
    walls_m3 = (ring_m2 + cross_m2) * (shape.length_m - shape.cap_m)
    expected_m3 = walls_m3 + np.pi / 2 * shape.radius_m**2 * shape.cap_m
    # Chords of seven sectors instead of arcs.
    assert arm.arm_mesh(shape).volume_m3 == pytest.approx(expected_m3, rel=0.07)


def test_every_sector_of_the_outer_wall_has_one_region():
    mesh = arm.arm_mesh(arm.ArmShape())
    rings = np.array([mesh.cell_arrays[f"ring_{k}"] for k in range(1, 8)])
    assert set(rings.sum(axis=0)) == {0.0, 1.0}
    x, y, z = mesh.centres_m[rings.any(axis=0)].T
    assert (np.hypot(x, y) > 0.9 * 0.0185).all()
    assert (z > arm.ArmShape().cap_m).all()


def test_tracks_begin_at_stated_positions_and_the_stated_onset():
    require_recordings()
    for mbar in arm.PRESSURES_MBAR:
        rows = np.loadtxt(arm.FOLDER / f"{mbar}mbar.csv", delimiter=",", skiprows=1)
        positions_m = rows[:, 1:].reshape(len(rows), 3, 3)
        stated_m = np.abs(arm.TIP_M) * [-1, 1, 1]
        np.testing.assert_allclose(positions_m[0], stated_m, atol=1e-3)
        moved_m = np.linalg.norm((positions_m - positions_m[0]).mean(axis=1), axis=1)
        assert moved_m[: arm.SAMPLES_BEFORE].max() < 1.2 * arm.ONSET_M
        assert moved_m[arm.SAMPLES_BEFORE + 2] > arm.ONSET_M


def test_a_rigid_transform_is_recovered(rng):
    points_m = rng.normal(size=(4, 3))
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    rotation *= np.sign(np.linalg.det(rotation))
    found, shift_m = arm.rigid_transform(points_m, points_m @ rotation.T + [1.0, 2.0, 3.0])
    np.testing.assert_allclose(found, rotation, atol=1e-12)
    np.testing.assert_allclose(shift_m, [1.0, 2.0, 3.0], atol=1e-12)


def test_the_polynomial_passes_through_the_recordings_that_it_knows():
    experiments = measured_problem().experiments[:3]
    for each in experiments:
        known_m = study.final_position(study.measured_tip(each))
        found_m = study.polynomial_position(experiments, study.pressure_mbar(each))
        np.testing.assert_allclose(found_m, known_m, atol=1e-9)


def test_the_reinforced_arm_bends_as_far_as_measured_with_the_stated_modulus():
    problem = measured_problem()
    measured_m = study.final_travel(study.measured_tip(problem.experiments[0]))
    assert study.static_travel_m(problem, 1e6, 100) == pytest.approx(measured_m, rel=0.2)


def test_without_threads_the_chamber_balloons_and_the_arm_hardly_bends():
    problem = measured_problem()
    reinforced_m = study.static_travel_m(problem, 1e6, 100)
    assert study.static_travel_m(problem, study.NO_THREADS_PA, 100) < 0.6 * reinforced_m
    with pytest.raises(SimulationError):
        study.static_travel_m(problem, study.NO_THREADS_PA, 450)


@pytest.mark.slow
def test_two_pressures_are_predicted_from_three():
    problem = measured_problem()
    fitted = [each for each in problem.experiments if not each.validation]
    solution = solve(replace(problem, experiments=fitted))
    assert solution.status.converged
    assert 1.9e5 < solution.parameters["young_pa"] < 2.7e5
    assert max(solution.rms_by_experiment_m.values()) < 0.001
    delays_s, log_lags = study.pressure_timing(solution)
    for experiment in problem.experiments:
        if experiment.name in ("150mbar", "350mbar"):
            error = study.travel_error(experiment, solution, delays_s.mean(), log_lags.mean())
            assert error.final_m < 0.1 * error.measured_m, experiment.name
