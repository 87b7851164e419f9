"""Constants that are not determined and confounded with none: what would determine them."""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from kit.problems import smooth_poses, times

import collocation_sysid as cs
from collocation_sysid.methods.starts.initial_trajectories import initial_variables
from collocation_sysid.program.forward.scheme_simulation import simulate_scheme
from collocation_sysid.result.run_summary import effect_of_remedy
from collocation_sysid.runs import expected_precision
from collocation_sysid.runs.expected_precision import added_measurements
from collocation_sysid.runs.result_builder import build_result
from collocation_sysid.runs.result_content import Limit
from collocation_sysid.statistics.combinations import find_combinations, lone_constants

TRUTH = {"young_pa": 800.0, "poisson": 0.33, "gamma_r_s": 0.009, "gamma_m_1_s": 1.0}
SIGMA_M = 4e-4
UNKNOWN = {"young_pa": cs.Unknown(700.0), "gamma_m_1_s": cs.Unknown(0.7)}
NAMES, VALUES = ("mu_pa", "gamma_m_1_s"), np.array([3e3, 1.0])


def test_a_constant_that_is_confounded_with_none_is_stated_alone():
    covariance = np.diag([0.01, 0.8]) ** 2
    assert not find_combinations(NAMES, VALUES, covariance, {"gamma_m_1_s"})
    (found,) = lone_constants(NAMES, VALUES, covariance, covariance, {"gamma_m_1_s"}, ())
    assert found.is_lone
    assert found.sentence() == "the data determine γ_m only to within a factor of 4.8"
    hopeless = np.diag([1e-4, 1e3])
    (wide,) = lone_constants(NAMES, VALUES, hopeless, hopeless, {"gamma_m_1_s"}, ())
    assert wide.sentence() == "the data do not determine γ_m"
    # What an assumption leaves undetermined, no other measurement determines.
    assert not lone_constants(NAMES, VALUES, hopeless, 0.1 * hopeless, {"gamma_m_1_s"}, ())


def test_repetitions_reduce_noise_and_known_values_their_share():
    covariance = np.array([[0.09, 0.1], [0.1, 0.16]])
    noise = 0.9 * covariance
    (found,) = lone_constants(NAMES, VALUES, covariance, noise, {"gamma_m_1_s"}, ())
    (repeated,) = found.with_repetitions(NAMES, covariance, noise).fixes
    assert repeated.what == "4 times as many such recordings"
    left = 0.16 * (1 - 0.9 * 0.75)
    assert np.log(repeated.factor) == pytest.approx(1.96 * np.sqrt(left), rel=1e-3)
    (known,) = found.with_known_value(NAMES, covariance).fixes
    assert known.what == "μ known to 5%"
    left = 0.16 - 0.1**2 / (0.09 + 0.05**2)
    assert np.log(known.factor) == pytest.approx(1.96 * np.sqrt(left), rel=1e-3)


def short_swing(name, rng, count=12, force=False):
    """A swing that is too short for the damping by mass, with the noise of its sensors."""
    body = cs.Body(cs.box_mesh((0.06, 0.06, 0.09), (1, 1, 3)), density_kg_m3=30.0)
    top, t_s = np.flatnonzero(body.nodes_m[:, 2] > 0.089), times(count)
    places_m = body.nodes_m[body.nodes_m[:, 2] < 0.001]
    blank = np.zeros((len(t_s), len(places_m), 3))
    markers = cs.Markers(t_s, blank, SIGMA_M, places_m=places_m)
    grasp = cs.Grasp(top, smooth_poses(t_s, turn_rad=(0.2, -0.15, 0.3)))
    wrench = cs.Wrench(t_s, np.zeros((len(t_s), 3)), 1.0)
    swing = cs.Experiment(
        body, t_s, [replace(grasp, wrench=wrench)], markers, name=name,
        nuisance=cs.Nuisance.none(), air_density_kg_m3="none",
    )  # fmt: skip
    motion = cs.simulate(swing, TRUTH)
    seen_m = motion.markers_m + SIGMA_M * rng.normal(size=blank.shape)
    if force:
        forces_n = motion.wrenches[0][:, :3]
        sigma_n = 0.01 * np.abs(forces_n).max()
        noise_n = sigma_n * rng.normal(size=forces_n.shape)
        grasp = replace(grasp, wrench=cs.Wrench(t_s, forces_n + noise_n, sigma_n))
    return replace(swing, grasps=[grasp], markers=replace(markers, positions_m=seen_m))


def half_width(run, name="gamma_m_1_s"):
    lower, upper = run.estimates[name].combined95
    return np.log(upper / lower) / 2


def run_of(experiments):
    uncertainty = cs.UncertaintyOptions(noise="given", assumptions=cs.Assumptions.exact())
    return cs.run(cs.Problem(experiments, TRUTH | UNKNOWN, uncertainty=uncertainty))


def test_a_swing_may_be_recorded_again_and_held_longer():
    first = short_swing("first", np.random.default_rng(0), count=4)
    problem = cs.Problem([first], TRUTH | UNKNOWN)
    collocation = problem.collocation()
    variables, _ = initial_variables(collocation)
    phrases = dict(added_measurements(collocation, variables))
    _, longer = phrases["another recording of 'first', held as long again at its end"]
    np.testing.assert_allclose(longer.t_s, 0.01 * np.arange(9))
    rotations, _ = longer.grasps[0].poses.at(longer.t_s)
    np.testing.assert_allclose(rotations[4:], np.broadcast_to(rotations[4], (5, 3, 3)))


@pytest.mark.parametrize("substeps", [1, 2])
def test_a_swing_that_is_held_longer_begins_with_the_fitted_motion(substeps):
    first = short_swing("first", np.random.default_rng(0), count=4)
    collocation = cs.Problem([first], TRUTH | UNKNOWN, substeps=substeps).collocation()
    variables, _ = initial_variables(collocation)
    phrases = dict(added_measurements(collocation, variables))
    both = phrases["another recording of 'first', held as long again at its end"]
    wide, at = expected_precision._extended(collocation, variables, both)
    _, (fitted, longer) = wide.unpack(at)
    assert np.array_equal(longer[: len(fitted)], fitted)
    whole = simulate_scheme(
        both[1],
        wide.transcriptions[1].dynamics.with_theta(
            wide.transcriptions[1].constants.theta(at[: wide.nq])
        ),
    )
    np.testing.assert_allclose(longer, whole, atol=1e-9)


@pytest.mark.long
def test_a_part_of_the_samples_of_a_smooth_motion_predicts_as_all(monkeypatch):
    swing = short_swing("swing", np.random.default_rng(0), count=4)
    t_s = np.linspace(0.0, 0.9, 240)
    grasp = cs.Grasp(swing.grasps[0].nodes, smooth_poses(t_s, turn_rad=(0.2, -0.15, 0.3)))
    markers = replace(swing.markers, t_s=t_s, positions_m=np.zeros((240, 4, 3)))
    fine = replace(swing, t_s=t_s, grasps=[grasp], markers=markers)
    exact = cs.UncertaintyOptions(assumptions=cs.Assumptions.exact())
    problem = cs.Problem([fine], TRUTH | UNKNOWN, uncertainty=exact)
    collocation = problem.collocation()
    variables, _ = initial_variables(collocation)
    covariance = np.diag([0.01, 0.8]) ** 2
    found = lone_constants(NAMES, VALUES, covariance, covariance, {"gamma_m_1_s"}, ())

    def promised(distance):
        monkeypatch.setattr(expected_precision, "sample_distance", lambda _: distance)
        arguments = (found, collocation, variables, problem.assumed_deviations)
        (each,) = expected_precision.with_measurements(*arguments)
        return np.log(each.fixes[0].factor)

    assert promised(4) == pytest.approx(promised(1), rel=0.02)


@pytest.mark.long
def test_a_longer_recording_determines_as_predicted(monkeypatch):
    rng = np.random.default_rng(2)
    run = run_of([short_swing("first", rng)])
    (found,), solution = run.combinations, run.solution
    (longer,) = (
        (what, each)
        for what, each in added_measurements(solution.collocation, solution.z)
        if what.endswith("held as long again at its end")
    )
    monkeypatch.setattr(expected_precision, "added_measurements", lambda *_: [longer])
    (promised,) = expected_precision.with_measurements(
        [replace(found, fixes=())], solution.collocation, solution.z, run.problem.assumed_deviations
    )
    *_, added = longer[1]
    seen_m = cs.simulate(added, TRUTH).markers_m
    seen_m = seen_m + SIGMA_M * rng.normal(size=seen_m.shape)
    recorded = replace(added, markers=replace(added.markers, positions_m=seen_m))
    followed = run_of([run.problem.experiments[0], recorded])
    assert half_width(followed) == pytest.approx(np.log(promised.fixes[0].factor), rel=0.3)
    assert half_width(followed) < 0.8 * half_width(run)


@pytest.mark.long
def test_a_known_value_determines_as_predicted():
    truth = {"lambda_pa": 1e5, "mu_pa": 1e5}
    strain = np.linspace(0.02, 0.2, 9)
    blank = cs.Specimen("uniaxial", strain, 0 * strain, 1.0, area_error=0.0, strain_zero=0.0)
    (stress_pa,) = cs.simulate(blank.experiment("neo-hookean"), truth).custom_sensor_values
    sigma_pa = 0.01 * np.abs(stress_pa).max()
    noise_pa = sigma_pa * np.random.default_rng(3).normal(size=len(strain))
    pulled = replace(blank, stress_pa=stress_pa[:, 0] + noise_pa, sigma_pa=sigma_pa)
    options = cs.UncertaintyOptions(noise="given", assumptions=cs.Assumptions.exact())

    def tested(**unknown):
        both = {name: cs.Unknown(value) for name, value in truth.items()} | unknown
        return cs.run(cs.Problem([pulled.experiment("neo-hookean")], both, uncertainty=options))

    run = tested()
    (found,) = run.combinations
    (fix,) = (each for each in found.fixes if each.what.endswith("known to 5%"))
    (known,) = {"lambda_pa", "mu_pa"} - {fix.name}
    value = run.solution.parameters[known]
    followed = tested(**{known: cs.Unknown(value, prior=(value, 0.05))})
    assert half_width(followed, fix.name) == pytest.approx(np.log(fix.factor), rel=0.1)


@pytest.mark.long
def test_an_assumption_that_is_known_has_the_stated_effect():
    swing = short_swing("first", np.random.default_rng(4), count=24)

    def run_with(**deviations):
        assumptions = replace(cs.Assumptions.exact(), **deviations)
        options = cs.UncertaintyOptions(noise="given", assumptions=assumptions)
        unknown = {"young_pa": cs.Unknown(700.0)}
        return cs.run(cs.Problem([swing], TRUTH | unknown, uncertainty=options))

    doubtful = run_with(mass=0.6, density_gradient=0.05)
    result = build_result(doubtful)
    assert not result.estimates["young_pa"].is_determined
    assert next(iter(result.budget["young_pa"])) == "mass"
    (stated,) = re.findall(r"±([\d.]+) %", effect_of_remedy(result, "young_pa"))
    followed = half_width(run_with(density_gradient=0.05), "young_pa")
    assert 100 * np.expm1(followed) == pytest.approx(float(stated), rel=0.2)


@pytest.mark.long
def test_a_predicted_remedy_determines_a_constant():
    rng = np.random.default_rng(1)
    first = short_swing("first", rng)
    run = run_of([first])
    (found,) = run.combinations
    assert found.determined.names == ("gamma_m_1_s",)
    by_words = {fix.what: fix for fix in found.fixes}
    followed = {
        "a force sensor": [short_swing("sensed", rng, force=True)],
        "4 times": [first, *(short_swing(f"again {k}", rng) for k in range(3))],
    }
    for words, experiments in followed.items():
        (fix,) = (each for what, each in by_words.items() if what.startswith(words))
        assert half_width(run_of(experiments)) == pytest.approx(np.log(fix.factor), rel=0.3)


def test_the_effect_of_a_remedy_is_stated_for_the_determined_constant():
    estimate = SimpleNamespace(is_determined=False, combined95=(1.0, 16.0))
    result: Any = SimpleNamespace(
        estimates={"lambda_pa": estimate}, limits={"lambda_pa": Limit(False, "scale", 0.9375, "")}
    )
    # Of the factor 4, with a sixteenth of the variance of its logarithm.
    assert effect_of_remedy(result, "lambda_pa") == ": λ would then be determined to ±41 %"
    estimate.is_determined = True
    assert not effect_of_remedy(result, "lambda_pa")
    result.limits["lambda_pa"] = Limit(False, "scale", 0.75, "")
    estimate.is_determined = False
    assert not effect_of_remedy(result, "lambda_pa")  # a factor of 2 does not determine it


def test_a_constant_that_is_open_for_another_reason_has_no_precision():
    """Its interval covers the whole range between its bounds, to which it is not known better."""
    strain = np.linspace(0.02, 0.2, 7)
    blank = cs.Specimen("uniaxial", strain, 0 * strain, 1.0, area_error=0.0, strain_zero=0.0)
    truth = {"young_pa": 1e5, "poisson": 0.45}
    (stress_pa,) = cs.simulate(blank.experiment(), truth).custom_sensor_values
    sigma_pa = 0.05 * np.abs(stress_pa).max()
    pulled = replace(blank, stress_pa=stress_pa[:, 0], sigma_pa=sigma_pa)
    options = cs.UncertaintyOptions(noise="given", assumptions=cs.Assumptions.exact())
    unknown = {"young_pa": cs.Unknown(1e5, lower=0.99e5, upper=1.01e5)}
    run = cs.run(cs.Problem([pulled.experiment()], truth | unknown, uncertainty=options))
    assert not run.estimates["young_pa"].is_determined
    assert not run.vague_constants


@pytest.mark.parametrize("sample_counts", [(9, 8, 7), (5, 9, 6, 8, 7), (3,) * 30 + (4, 4, 4, 4)])
def test_of_many_recordings_only_the_longest_are_tried_again(monkeypatch, sample_counts):
    recordings = [
        SimpleNamespace(specimen=None, wrenches=(), grasps=(1,), t_s=range(count), name=f"{k}")
        for k, count in enumerate(sample_counts)
    ]
    collocation = SimpleNamespace(
        transcriptions=[SimpleNamespace(experiment=each) for each in recordings],
        parameters=SimpleNamespace(values=lambda _: {}),
        nq=0,
    )
    tried = []
    monkeypatch.setattr(
        expected_precision, "_with_force_sensor", lambda *words: tried.append(words[2])
    )
    monkeypatch.setattr(expected_precision, "_held_longer", lambda _: None)
    assert not [*added_measurements(collocation, np.zeros(0))]
    longest = sorted(sample_counts, reverse=True)[: expected_precision.MOST_TRIED]
    assert sorted((sample_counts[k] for k in tried), reverse=True) == longest
