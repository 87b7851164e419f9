"""Identification from the force of a ball that pokes a block, and wrong descriptions of it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from kit.pokes import DEPTHS_M, FLAT, SIGMA_N, SMALL, TRUTH, poked
from kit.problems import GUESS, measured, prescribed_positions, pressed_cube

import collocation_sysid as cs
from collocation_sysid.common.display import plain_text
from collocation_sysid.kinds.contact.concerns import contact_concerns
from collocation_sysid.model.contact.summary import ContactSummary, contact_summaries
from collocation_sysid.recording import Experiment
from collocation_sysid.result.run_summary import run_summary
from collocation_sysid.runs.check import check_problem
from collocation_sysid.runs.result_content import Result

THERE_AND_BACK_M = np.concatenate([DEPTHS_M[:7], DEPTHS_M[:7][::-1]])


@cache
def forces_n(seed: int) -> np.ndarray:
    """What the ball measures where it is as stated, with noise."""
    exact = cs.simulate(poked(), TRUTH).wrenches[0][:, :3]
    return exact + SIGMA_N * np.random.default_rng(seed).normal(size=exact.shape)


def measured_once(experiment: Experiment, seed: int = 0, **unknown) -> cs.Problem:
    """To find E and the place of the ball."""
    held, ball = experiment.grasps
    read = replace(ball, wrench=replace(ball.wrench, values=forces_n(seed)))
    known = cs.Parameters.from_mapping({**TRUTH, "young_pa": cs.Unknown(1e4), **unknown})
    return cs.Problem([replace(experiment, grasps=[held, read])], known)


def answer(experiment: Experiment, seed: int = 0, **unknown) -> cs.Run:
    """Of E and the place of the ball."""
    return cs.run(measured_once(experiment, seed, **unknown), seek_causes=False)


def touch_of(experiment: Experiment) -> ContactSummary:
    """How the ball touches the block."""
    x = cs.simulate(experiment, TRUTH).positions_m.reshape(len(experiment.t_s), -1)
    (touch,) = contact_summaries(experiment, x, experiment.t_s)
    return touch


def told(run: cs.Run) -> set[str]:
    assert run.trust is not None
    return {concern.code for concern in run.trust.concerns}


def test_a_ball_that_rubs_may_come_deep_into_a_block_from_one_sample_to_the_next():
    at_once, slowly = (
        cs.simulate(poked(depths_m=depths_m, friction=friction), TRUTH).wrenches[0][-1, 2]
        for depths_m, friction in ((np.array([0.0, 4e-3]), 0.5), (np.linspace(0, 4e-3, 9), 0.0))
    )
    assert at_once == pytest.approx(slowly, rel=0.1)


@pytest.mark.parametrize("off_m", [pytest.param(0.0, marks=pytest.mark.long), 3e-4])
def test_stiffness_is_found_with_an_unknown_place_of_the_surface(off_m: float):
    finished = answer(poked(off_m))
    low, high = finished.result.parameters["young_pa"].statistical95
    assert low < TRUTH["young_pa"] < high
    assert high - low < 0.1 * TRUTH["young_pa"]
    lowest, highest = finished.estimates["young_pa"].combined95
    assert lowest < TRUTH["young_pa"] < highest
    assert highest - lowest < 0.5 * TRUTH["young_pa"]
    part = finished.solution.collocation.iterates(finished.solution.z)[0]
    place_m = float((part.phi * part.transcription.nuisance.scales)[0])
    assert place_m == pytest.approx(-off_m, abs=1e-4)


@pytest.mark.slow
def test_intervals_contain_the_truth_at_their_nominal_rate():
    held = 0
    for seed in range(20):
        run = answer(poked(), seed)
        low, high = run.result.parameters["young_pa"].statistical95
        held += low < TRUTH["young_pa"] < high
    assert held >= 17


@pytest.mark.parametrize(
    ("off_m", "prior_m", "verdict"),
    [
        pytest.param(1.6e-3, 5e-4, "check", marks=pytest.mark.long),
        pytest.param(2.5e-3, 5e-4, "doubtful", marks=pytest.mark.long),
        (1e-3, 1e-4, "doubtful"),
    ],
)
def test_an_obstacle_far_from_its_stated_place_is_reported(
    off_m: float, prior_m: float, verdict: str
):
    run = answer(poked(off_m, prior_m))
    assert "nuisance/sized" in told(run)
    assert run.trust is not None
    assert run.trust.verdict == verdict


@pytest.mark.parametrize("factor", [pytest.param(30.0, marks=pytest.mark.long), 1 / 30.0])
def test_a_compressed_block_is_found_from_thirty_times_its_stiffness_and_a_thirtieth(factor: float):
    pressed = poked(shape=FLAT)
    held, plate = pressed.grasps
    exact_n = cs.simulate(pressed, TRUTH).wrenches[0][:, :3]
    measured = replace(plate, wrench=replace(plate.wrench, values=exact_n))
    known = cs.Parameters.from_mapping(
        {**TRUTH, "young_pa": cs.Unknown(factor * TRUTH["young_pa"])}
    )
    solution = cs.solve(cs.Problem([replace(pressed, grasps=[held, measured])], known))
    assert solution.status.converged
    assert solution.parameters["young_pa"] == pytest.approx(TRUTH["young_pa"], rel=1e-4)


FORGOTTEN = {
    "lid": cs.Obstacle(
        shape=cs.Plane((0, 0, -1), (0, 0, 0.029)),
        faces=cs.Box((-1, -1, 0.0299), (0.016, 1, 1)),
        name="lid",
    ),
    "wall": cs.Obstacle(shape=cs.Plane((1, 0, 0), (0.003, 0, 0)), name="wall"),
}


@pytest.mark.long
@pytest.mark.parametrize("fault", ["friction", *FORGOTTEN])
def test_wrong_friction_and_a_forgotten_obstacle_are_reported(fault: str):
    stated = poked()
    others = [FORGOTTEN[fault]] if fault in FORGOTTEN else []
    actual = poked(friction=0.0 if others else 0.5)
    actual = replace(actual, grasps=[*actual.grasps, *others])
    exact_n = cs.simulate(actual, TRUTH).wrenches[0][:, :3]
    read_n = exact_n + SIGMA_N * np.random.default_rng(0).normal(size=exact_n.shape)
    held, ball = stated.grasps
    measured = replace(ball, wrench=replace(ball.wrench, values=read_n))
    known = cs.Parameters.from_mapping({**TRUTH, "young_pa": cs.Unknown(1e4)})
    problem = cs.Problem([replace(stated, grasps=[held, measured])], known)
    run = cs.run(problem, seek_causes=False)
    low, high = run.result.parameters["young_pa"].combined95
    assert low < TRUTH["young_pa"] < high
    assert run.trust is not None
    assert run.trust.verdict == "doubtful"
    assert "noise/larger" in told(run)


def test_an_obstacle_that_is_never_touched_is_reported():
    assert "contact/never" in told(answer(poked(0.05, place_sigma_m=None)))


def test_a_contact_of_few_faces_is_reported():
    fine = poked(shape=SMALL)
    touch, wide = (touch_of(each) for each in (fine, poked()))
    assert 0 < touch.face_count < 4
    assert wide.face_count > touch.face_count
    assert wide.gap_m < 1e-4
    assert touch.face_mm == pytest.approx(1e3 * np.sqrt(2 / np.sqrt(3)) * 0.015)


def test_check_compares_derivatives_within_the_gap_and_looks_at_no_grasp_of_an_obstacle():
    findings = check_problem(measured_once(poked(shape=FLAT)))
    assert not findings.derivative_fault
    assert [hold.nodes for hold in findings.holds] == [25]
    assert findings.bodies[0].nodes == 75


@pytest.mark.parametrize(
    ("changes", "codes"),
    [
        ({"shape": FLAT}, set()),
        ({"shape": FLAT, "higher_m": 0.05, "place_sigma_m": None}, {"never"}),
        ({}, {"coarse"}),
        ({"shape": FLAT, "higher_m": -0.002}, {"pressed"}),
        ({"shape": FLAT, "depths_m": THERE_AND_BACK_M}, {"lost"}),
    ],
)
def test_check_warns_of_contact_at_the_guess(changes: dict, codes: set[str]):
    concerns = check_problem(measured_once(poked(**changes)), full=True).concerns
    of_contact = [each for each in concerns if each.topic == "contact"]
    assert {each.code for each in of_contact} == {f"contact/{code}" for code in codes}
    assert all("ball" in each.message for each in of_contact)
    assert all("at the guess" in each.message for each in of_contact)


def test_check_does_not_judge_contact_before_a_simulation(monkeypatch):
    monkeypatch.setattr("collocation_sysid.runs.check.LONGEST_SIMULATION_S", 0.0)
    for changes in ({"higher_m": 0.05, "place_sigma_m": None}, {"shape": SMALL}):
        concerns = check_problem(measured_once(poked(**changes))).concerns
        assert not any(each.topic == "contact" for each in concerns)


def test_notes_shared_by_several_recordings_are_printed_once():
    touch = touch_of(poked(shape=SMALL))
    often = [replace(touch, experiment=name) for name in ("a", "b", "c")]
    (one,) = contact_concerns(often)
    assert "'a' and 2 more" in one.message


@pytest.mark.long
def test_friction_is_reported_in_a_line_and_stored_in_the_result(tmp_path):
    run = answer(poked(friction=0.3, place_sigma_m=None))
    said = " ".join(
        plain_text(
            run_summary(run.result, run.save(tmp_path / "run", frames=False), details=True)
        ).split()
    )
    assert said.count("friction of ball in 'poke': at most") == 1
    (rubbed,) = run.result.fit.experiments["poke"].friction.values()
    assert 0 < rubbed.used <= 1
    assert 0 < rubbed.slipping < 1
    assert rubbed.dissipated_j > 0
    assert Result.read(tmp_path / "run").fit == run.result.fit


@pytest.mark.long
def test_intervals_do_not_claim_the_step_where_something_is_touched_in_motion():
    seen = measured(pressed_cube(6))
    run = cs.run(cs.Problem([seen], GUESS), seek_causes=False)
    assert not any("time_step" in line.shares for line in run.budget.values())
    free = measured(replace(pressed_cube(6), grasps=pressed_cube(6).body_grasps))
    budget = cs.run(cs.Problem([free], GUESS), seek_causes=False).budget
    assert any("time_step" in line.shares for line in budget.values())


@pytest.mark.parametrize(
    ("unknown", "zero"),
    [
        ("obstacle_offset_m", ""),
        ("obstacle_offset_m", "y"),
        ("obstacle_tilt_rad", ""),
        ("obstacle_time_s", "y"),
    ],
)
def test_a_forward_simulation_uses_the_estimated_place_of_an_obstacle(unknown, zero):
    pressed = pressed_cube(8, nuisance=cs.Nuisance.none(**{unknown: 1e-4}))
    displaced = [replace(obstacle, zero=zero) for obstacle in pressed.obstacles]
    (transcription,) = (
        cs.Problem([pressed.with_obstacles(displaced)], GUESS).collocation().transcriptions
    )
    as_stated = transcription.prescribed_motion.evaluate_at(np.zeros(transcription.nuisance.size))
    for phi in np.eye(transcription.nuisance.size):
        change_m = (
            transcription.prescribed_motion.evaluate_at(phi).positions_m - as_stated.positions_m
        )
        simulated_m = prescribed_positions(
            transcription.corrected_experiment(phi), transcription.dynamics.t_s
        )
        assert np.abs(change_m).max() > 1e-6
        np.testing.assert_allclose(
            simulated_m - as_stated.positions_m, change_m, atol=0.01 * np.abs(change_m).max()
        )


def test_a_place_is_off_along_the_displacement_or_else_along_the_normal():
    ball, plate = pressed_cube().obstacles
    assert replace(ball, zero="y").offset_direction.tolist() == [0.0, 1.0, 0.0]
    np.testing.assert_array_equal(plate.offset_direction, plate.shape.offset_direction)
