"""Fits with measured wrenches: methods, error bars and run folders."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from kit.problems import GUESS, TRUTH, relative_errors
from kit.static import HANGING, block
from kit.wrench_fits import UNKNOWN, swung
from kit.wrenches import SIGMA_N, SIGMA_NM, sensing

import collocation_sysid as cs
from collocation_sysid.methods.comparison.shooting import Shooting
from collocation_sysid.methods.horizon import Horizon
from collocation_sysid.methods.interior_point import InteriorPoint
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.problem import Problem
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.program.lifted.collocation import with_lifted_variables
from collocation_sysid.program.simulation import simulate, with_markers, with_wrenches
from collocation_sysid.program.wrench_residual import WrenchResidual
from collocation_sysid.recording import Experiment, Nuisance
from collocation_sysid.runs.check import check_problem
from collocation_sysid.runs.derivatives import ORDERS
from collocation_sysid.statistics.linearised import linearise_fit
from collocation_sysid.statistics.pose_noise import uncertainty_at
from collocation_sysid.statistics.uncertainty import ErrorModel, uncertainty_from_fit
from collocation_sysid.testing import check_program


def blind(experiment: Experiment) -> Experiment:
    """The experiment without its sensors."""
    return replace(experiment, grasps=[replace(g, wrench=None) for g in experiment.grasps])


@pytest.mark.long
def test_methods_find_the_same_optimum():
    collocation = Collocation([swung(steps=20)], GUESS)
    reduced = ReducedSpace()(collocation)
    assert np.abs(relative_errors(reduced)).max() < 0.5
    for gradient in ("forward", "adjoint"):
        shot = Shooting(gradient=gradient)(collocation)
        assert shot.status.converged
        np.testing.assert_allclose(shot.q, reduced.q, atol=2e-5)
    assert reduced.kkt_residual < 1e-6


def test_a_sensor_narrows_the_interval_of_the_stiffness():
    """Of a body whose density is known."""
    deviations = {}
    for name, experiment in (("felt", swung()), ("only seen", blind(swung()))):
        collocation = Collocation([experiment], GUESS)
        solution = ReducedSpace()(collocation)
        found = uncertainty_at(collocation, solution.z)
        (young,) = (found.derived[n] for n in found.derived if n.startswith("young"))
        deviations[name] = young.statistical_std_error
    assert deviations["felt"] < 0.8 * deviations["only seen"]


def test_error_bars_are_those_of_the_slopes():
    collocation = Collocation([swung()], GUESS)
    solution = ReducedSpace()(collocation)
    markers, sensor = linearise_fit(collocation, solution.z).blocks
    assert (sensor.sigma_key, markers.sigma_key) == ("sigma_n", "sigma_m")
    assert sensor.measurement_count == int(
        collocation.transcriptions[0]
        .residuals_of(WrenchResidual)[0]
        .is_compared.reshape(-1, 6)
        .sum()
    )
    rows = [b.jacobian.reshape(-1, 4)[b.is_measured.ravel()] for b in (markers, sensor)]
    of_both = np.linalg.inv(sum(r.T @ r for r in rows))
    found = uncertainty_at(collocation, solution.z, ErrorModel(noise="given", errors="independent"))
    np.testing.assert_allclose(found.covariance, of_both, rtol=1e-6)
    assert {"hung cube/force", "hung cube/torque"} <= set(found.level.names)


def test_the_noise_of_a_sensor_is_judged_by_itself():
    """Its sigma is scaled where it is wrong, and the markers' is not."""
    loud = swung()
    (grasp,) = loud.grasps
    assert grasp.wrench is not None
    quiet = replace(grasp.wrench, sigma_n=grasp.wrench.sigma_n / 4)
    collocation = Collocation([replace(loud, grasps=[replace(grasp, wrench=quiet)])], GUESS)
    found = uncertainty_at(collocation, ReducedSpace()(collocation).z)
    assert found.noise == "by-marker"
    assert found.level.factors["hung cube/force"] == pytest.approx(4, rel=0.15)
    assert found.level.factors["hung cube/torque"] == pytest.approx(1, rel=0.15)
    assert found.level.factors["hung cube/m3"] == pytest.approx(1, rel=0.2)


def test_tare_clock_lag_and_tool_are_found():
    wanted = Nuisance.none(
        tare=20.0, sensor_time_s=0.004, sensor_lag_s=0.01, tool_kg=0.02, tool_m=0.02
    )
    collocation = Collocation([swung(0, wanted, 60)], GUESS)
    (transcription,) = collocation.transcriptions
    names, scales = transcription.nuisance.names, transcription.nuisance.scales
    true = np.zeros(len(names))
    for part, value in (("tare", 0.005), ("shift of the sensor", 0.003), ("lag", 0.008)):
        true[[part in name for name in names]] = value
    true[["mass of the tool" in name for name in names]] = 0.012
    true[["centre of the tool" in name for name in names]] = (0.0, 0.01, -0.005)
    phi = true / scales
    made = simulate(swung(0, wanted, 60), TRUTH, "midpoint", substeps=1)
    (sensor,) = transcription.residuals_of(WrenchResidual)
    read = sensor.numbers(sensor.predict_samples(made.sampled, phi))
    measured = with_wrenches(swung(0, wanted, 60), [read])
    collocation = Collocation([with_markers(measured, made.markers_m)], GUESS)
    solution = ReducedSpace()(collocation)
    found = collocation.parameters_from(solution.z)[4:] * scales
    assert solution.status.converged
    # Priors around zero pull a little.
    np.testing.assert_allclose(found, true, atol=0.1 * scales.max(), rtol=0.1)
    np.testing.assert_allclose(relative_errors(solution), 0, atol=0.01)


@pytest.mark.long
def test_a_run_reports_the_wrench(tmp_path: Path):
    experiment = swung(1, Nuisance.none(tare=10.0, sensor_time_s=0.002), 20)
    problem = Problem(
        [experiment],
        UNKNOWN,
        rollout=cs.RolloutOptions(integrator="scheme"),
        uncertainty=cs.UncertaintyOptions(assumptions=cs.Assumptions.exact()),
    )
    run = cs.run(problem, method="reduced-space", seek_causes=False)
    assert run.trust.verdict == "good", run.trust.reasons
    folder = run.save(tmp_path / "run", frames=False)
    result = json.loads((folder / "result.json").read_text())
    assert result["fit"]["wrench_rms_n"] == pytest.approx(SIGMA_N, rel=0.3)
    assert result["fit"]["wrench_rms_nm"] == pytest.approx(SIGMA_NM, rel=0.3)
    assert "tare of fx [N]" in result["nuisance"]["hung cube"]
    with np.load(folder / "trajectory.npz") as stored:
        assert stored["wrench_1"].shape == (21, 19)
    from collocation_sysid.common.display import plain_text
    from collocation_sysid.result.pictures.album import redraw_pictures
    from collocation_sysid.result.report import report_html
    from collocation_sysid.result.run_sections import run_report
    from collocation_sysid.result.run_summary import run_summary

    said = plain_text(run_summary(run.result, folder, details=True))
    assert "wrench of 'hung cube'" in said
    assert "tare: up to" in said
    assert "delay of the sensor:" in said
    assert folder / "wrench_hung_cube.png" in redraw_pictures(folder, folder)
    assert "Wrench of a grasp" in report_html(run_report(folder))


def test_methods_that_need_second_derivatives_in_the_parameters_refuse_wrenches():
    exact = ReducedSpace(hessian="exact")
    with pytest.raises(cs.InputError, match="not available for measured forces"):
        exact(Collocation([swung(steps=12)], GUESS))


def test_derivatives_of_wrenches_pass_a_taylor_test():
    rates = check_program(Problem([swung()], UNKNOWN))
    assert set(rates) == set(ORDERS)


def test_check_counts_the_variables_of_a_wrench():
    problem = Problem([swung(steps=12)], UNKNOWN)
    collocation = problem.collocation()
    findings, program = (check_problem(problem), with_lifted_variables(collocation))
    assert findings.wrenches == program.variable_count - collocation.variable_count > 0
    assert findings.hessian_nonzeros == len(program.hessian_structure[1])


def test_interior_point_finds_the_body_in_its_grasp_too():
    nuisance = Nuisance.none(tare=10.0, gravity_rad=0.02, hand_eye_m=1e-3, sensor_time_s=0.001)
    collocation = Collocation([swung(nuisance=nuisance, steps=12)], GUESS)
    reduced = ReducedSpace()(collocation)
    found = InteriorPoint()(collocation)
    assert found.status.converged
    np.testing.assert_allclose(found.q, reduced.q, atol=1e-5)


def test_a_sensor_separates_stiffness_and_density():
    """Without it only their ratio is told."""
    unknown = {**UNKNOWN, "density_kg_m3": cs.Unknown(45.0)}
    felt = Problem([swung()], unknown)
    collocation = felt.collocation()
    solution = ReducedSpace()(collocation)
    fit = linearise_fit(collocation, solution.z)
    found = uncertainty_from_fit(fit, felt.parameters, solution.q).estimates
    for name, true in {**TRUTH, "density_kg_m3": 30.0}.items():
        assert abs(found[name].value - true) < 4 * found[name].statistical_std_error, name
    # The error bars are those of the slopes that the search has.
    p, x = collocation.unpack(solution.z)
    point = Horizon(collocation, [len(x[0])]).evaluate(p, x)
    rows = np.concatenate([block.jacobian.reshape(-1, 5) for block in fit.blocks])
    np.testing.assert_allclose(rows.T @ rows, point.fit.information, rtol=1e-6)
    seen = Problem([blind(swung())], unknown)
    told = uncertainty_at(seen.collocation(), seen.collocation().pack(p, x)).estimates
    assert told["density_kg_m3"].statistical_std_error is None


def test_equilibria_under_gravity_determine_the_density_too():
    static = sensing(block("xyz", gravity_m_s2=HANGING))
    static = replace(static, body=static.body.with_free_densities([""]))
    made = simulate(static, TRUTH | {"density_kg_m3": 30.0})
    felt = with_wrenches(with_markers(static, made.markers_m), made.wrenches)
    free = {"lambda_pa": cs.Unknown(300.0), "mu_pa": cs.Unknown(400.0)}
    unknown = {**TRUTH, **free, "density_kg_m3": cs.Unknown(40.0)}
    found = ReducedSpace()(Problem([felt], unknown).collocation()).parameters
    for name, true in {"mu_pa": TRUTH["mu_pa"], "density_kg_m3": 30.0}.items():
        assert found[name] == pytest.approx(true, rel=1e-6)
    with pytest.raises(cs.InputError, match="density_kg_m3: this parameter has no guess"):
        cs.run(Problem([felt], unknown | {"density_kg_m3": cs.Unknown()}))
