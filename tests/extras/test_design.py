"""Designed motions: limits, criteria and files."""

from __future__ import annotations

import io
import json
import shutil
import time
from dataclasses import replace

import numpy as np
import pytest
from kit.problem_files import AT_TRUTH, run_command, settings, write_problem
from kit.problems import GUESS, IDEAL, TRUTH, bar_in_two_hands, cube_with_nuisance, hung_cube
from kit.wrenches import wristed_cube
from rich.console import Console
from scipy.spatial.transform import Rotation

from collocation_sysid.errors import InputError
from collocation_sysid.extras.design import DesignCriterion, DesignOptions, HandMotion, Limits
from collocation_sysid.extras.design import motion as motion_design
from collocation_sysid.extras.design.evolution_search import minimise
from collocation_sysid.extras.design.folder import PROBLEM_FILE, write_design
from collocation_sysid.extras.design.hand_motion import angular_motion
from collocation_sysid.extras.design.motion import MotionObjective, design_motion
from collocation_sysid.extras.design.predicted_information import (
    FutureRecording,
    LinearRecording,
    PredictedErrors,
    prior_draws,
    shared_information,
    symmetric_draws,
)
from collocation_sysid.extras.studies.progress import DesignProgress
from collocation_sysid.model.parameters import Parameter, Parameters, ThetaMap
from collocation_sysid.problem import Problem
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.program.forward.scheme_simulation import simulate_scheme
from collocation_sysid.program.simulation import simulate, with_markers
from collocation_sysid.recording import Grasp, PoseSequence
from collocation_sysid.statistics.linearised import linearise_fit
from collocation_sysid.statistics.uncertainty import ErrorModel, uncertainty_from_fit

AT = GUESS.with_guess(TRUTH)
LIMITS = Limits.model_validate(
    {
        "workspace_m": ((-0.1, -0.05, 0.0), (0.2, 0.2, 0.2)),
        "speed_m_s": 0.8,
        "acceleration_m_s2": 12.0,
        "rotation_deg": 25.0,
        "angular_speed_deg_s": 400.0,
        "angular_acceleration_deg_s2": 6000.0,
    }
)
TEXT = """\
workspace_m = [[-0.1, -0.1, 0.0], [0.2, 0.2, 0.2]]
speed_m_s = 1.0
acceleration_m_s2 = 10.0
rotation_deg = 30.0
angular_speed_deg_s = 300.0
angular_acceleration_deg_s2 = 3000.0
"""


def drawn_motions(count: int = 12, waves: int = 1) -> list[HandMotion]:
    """Motions of coefficients up to far beyond the usual, within the limits."""
    bounds, rng = (LIMITS.bounds_from(np.array([0.05, 0.05, 0.1])), np.random.default_rng(0))
    size = HandMotion.coefficient_count(waves)
    drawn = [rng.normal(size=size) * rng.choice([1.0, 5.0]) for _ in range(count)]
    return [
        bounds.scale_to_limits(HandMotion.from_coefficients(u, 0.3, 10.0, bounds.reach))
        for u in drawn
    ]


def problem(**changes) -> Problem:
    return Problem([hung_cube(8, **changes)], AT)


# Motions ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("waves", [1, 3])
def test_a_motion_begins_and_ends_at_rest_where_it_began(waves):
    for motion in drawn_motions(waves=waves):
        position, velocity, acceleration = motion.derivatives([0.0, motion.duration_s])
        fastest = np.abs(motion.derivatives(motion.grid_s).second).max()
        assert np.abs(position).max() < 1e-12
        assert np.abs(velocity).max() < 1e-10
        assert np.abs(acceleration).max() < 1e-9 * fastest


def test_derivatives_of_a_motion_are_those_of_its_course():
    motion = drawn_motions(1, waves=2)[0]
    t, h = np.linspace(0.01, 0.29, 57), 1e-5
    before, at, after = (motion.derivatives(t + shift) for shift in (-h, 0, h))
    for order in (0, 1):
        slope = (after[order] - before[order]) / (2 * h)
        assert np.allclose(slope, at[order + 1], atol=1e-5 * np.abs(at[order + 1]).max())


def test_angular_velocity_and_acceleration_are_those_of_the_rotation():
    motion = drawn_motions(1)[0].scaled(rotation=4.0)  # up to 100°, where the formula matters
    t, h = np.linspace(0.02, 0.28, 41), 1e-4

    def velocity(t):
        before, after = (
            Rotation.from_rotvec(motion.derivatives(t + s).value[:, 3:]) for s in (-h, h)
        )
        return (after * before.inv()).as_rotvec() / (2 * h)

    found = angular_motion(*(each[:, 3:] for each in motion.derivatives(t)))
    by_differences = velocity(t), (velocity(t + h) - velocity(t - h)) / (2 * h)
    for each, other in zip(found, by_differences, strict=True):
        assert np.abs(each - other).max() < 2e-4 * np.abs(other).max()


def test_small_turns_have_the_series_of_the_same_formula():
    rate, curvature = np.array([[1.0, 2.0, 3.0]]), np.array([[-3.0, 1.0, 2.0]])
    near = [
        angular_motion(np.array([[0.6, 0.8, 0]]) * s, rate, curvature) for s in (0.00999, 0.01001)
    ]
    for below, above in zip(*near, strict=True):
        assert np.allclose(below, above, rtol=1e-4)


# Limits -------------------------------------------------------------------------------------------


def peaks(motion: HandMotion) -> dict[str, float]:
    """Largest values over the limits on a grid five times finer, by the limits' names."""
    fine = np.linspace(0, motion.duration_s, 5 * len(motion.grid_s))
    position, velocity, acceleration = motion.derivatives(fine)
    angular = angular_motion(*(each[:, 3:] for each in (position, velocity, acceleration)))
    low, high = (np.array(corner) - [0.05, 0.05, 0.1] for corner in LIMITS.workspace_m)

    def largest(vectors):
        return np.linalg.norm(vectors, axis=1).max()

    return {
        "workspace_m": np.maximum(position[:, :3] / low, position[:, :3] / high).max(),
        "speed_m_s": largest(velocity[:, :3]) / 0.8,
        "acceleration_m_s2": largest(acceleration[:, :3]) / 12.0,
        "rotation_deg": np.degrees(largest(position[:, 3:])) / 25.0,
        "angular_speed_deg_s": np.degrees(largest(angular[0])) / 400.0,
        "angular_acceleration_deg_s2": np.degrees(largest(angular[1])) / 6000.0,
    }


@pytest.mark.parametrize("waves", [1, 3])
def test_no_motion_exceeds_a_limit_and_some_reach_it(waves):
    found = [peaks(motion) for motion in drawn_motions(40, waves)]
    assert max(max(each.values()) for each in found) <= 1.0
    assert np.mean([max(each.values()) > 0.95 for each in found]) > 0.3


def test_a_motion_within_the_limits_is_left_as_it_is():
    bounds = LIMITS.bounds_from(np.array([0.05, 0.05, 0.1]))
    motion = drawn_motions(1)[0].scaled(0.5, 0.5)
    assert np.array_equal(bounds.scale_to_limits(motion).amplitude, motion.amplitude)
    assert bounds.shares(motion) == pytest.approx(peaks(motion), rel=2e-3)


def test_markers_are_in_view_where_enough_cameras_see_them():
    cameras = [
        {"position_m": [1.0, 0, 0], "looks_at_m": [0, 0, 0], "field_of_view_deg": 20.0},
        {"position_m": [0, 1.0, 0], "looks_at_m": [0, 0, 0], "field_of_view_deg": 40.0},
    ]
    both = Limits.model_validate(LIMITS.model_dump() | {"camera": cameras})
    one = Limits.model_validate(both.model_dump() | {"cameras_per_marker": 1})
    middle, aside = np.zeros((1, 1, 3)), np.array([[[0.0, 0.0, 0.3]]])
    assert both.out_of_view(middle) == 0
    assert both.out_of_view(aside) == pytest.approx(np.arctan(0.3) - np.radians(10))
    assert one.out_of_view(aside) == 0
    assert one.out_of_view(aside * 10) == pytest.approx(np.arctan(3.0) - np.radians(20))


def test_markers_beyond_their_box_are_out_of_view_by_how_far():
    box = Limits.model_validate(
        LIMITS.model_dump() | {"markers_box_m": ((0.0, 0.0, 0.0), (3.0, 4.0, 12.0))}
    )
    assert box.out_of_view(np.ones((2, 2, 3))) == 0
    assert box.out_of_view(np.array([[[1.0, 5.3, 1.0]]])) == pytest.approx(0.1)


BAD_LIMITS = {
    "missing key": ("speed_m_s = 1.0\n", "", "speed_m_s: missing; expected largest speed"),
    "unknown key": ("speed_m_s", "spede_m_s", "did you mean 'speed_m_s'"),
    "text": ("= 30.0", '= "30"', "rotation_deg: found '30'; expected a number"),
    "negative": ("= 10.0", "= -10.0", "acceleration_m_s2: found -10.0; expected a number above 0"),
    "two corners": ("[0.2, 0.2, 0.2]]", "[0.2, 0.2]]", "workspace_m: found"),
    "corners exchanged": ("[-0.1, -0.1, 0.0]", "[0.3, -0.1, 0.0]", "expected the lower one first"),
    "half a turn": ("= 30.0", "= 180.0", "rotation_deg: found 180.0"),
    "start outside": ("[-0.1, -0.1, 0.0]", "[0.1, -0.1, 0.0]", "workspace_m: the hand starts at"),
    "too fast": (
        "speed_m_s = 1.0",
        "frequency_hz = 51.0\nspeed_m_s = 1.0",
        "at most 50 Hz, half the",
    ),
    "no toml": ("speed_m_s =", "speed_m_s", "line 2: the file is not valid TOML"),
}


@pytest.mark.parametrize("name", BAD_LIMITS)
def test_a_bad_limits_file_gets_one_clear_message(tiny, name, tmp_path):
    old, new, message = BAD_LIMITS[name]
    assert old in TEXT
    (tmp_path / "limits.toml").write_text(TEXT.replace(old, new))
    out = tmp_path / "out"
    words = ["design", tiny, "--duration", "0.1", "--limits", tmp_path / "limits.toml"]
    done = run_command(*map(str, words), "--out", str(out))
    assert done.code == 2
    assert "limits.toml" in done.err
    assert message in done.err
    assert len(done.err.strip().splitlines()) == 1
    assert not out.exists()


def test_more_cameras_per_marker_than_there_are_is_refused():
    with pytest.raises(ValueError, match="there are 1 cameras; expected at most that many"):
        Limits.model_validate(
            LIMITS.model_dump()
            | {"camera": [{"position_m": [1.0, 0, 0], "looks_at_m": [0, 0, 0.0],
                           "field_of_view_deg": 20.0}]}
        )  # fmt: skip


# Information and criterion ------------------------------------------------------------------------


def at_answer(experiments) -> tuple[Collocation, np.ndarray]:
    """The experiments with exact tracks of the scheme, and their optimum."""
    exact = [
        with_markers(e, simulate(e, TRUTH, "midpoint", substeps=1).markers_m) for e in experiments
    ]
    found = Collocation(exact, AT)
    rows = [
        simulate_scheme(s.experiment, s.dynamics.with_theta(s.constants.theta(AT.guess_q)))
        for s in found.transcriptions
    ]
    phi = [s.guess_phi for s in found.transcriptions]
    return found, found.pack(np.concatenate([AT.guess_q, *phi]), rows)


def test_the_information_is_that_of_all_parameters_with_nuisances_eliminated():
    fit = linearise_fit(*at_answer([cube_with_nuisance(6)]))
    slopes = np.vstack([b.jacobian.reshape(-1, len(fit.names)) for b in fit.blocks])
    whole = np.linalg.inv(slopes.T @ slopes + np.diag(fit.prior_jacobian**2))
    assert fit.shared_count < len(fit.names)
    found = np.linalg.inv(shared_information(fit))
    assert np.allclose(found, whole[: fit.shared_count, : fit.shared_count], rtol=1e-6)


def test_information_of_recordings_adds_up_to_that_of_the_joint_fit():
    first, second = cube_with_nuisance(6), replace(hung_cube(9), name="other")
    alone = [shared_information(linearise_fit(*at_answer([e]))) for e in (first, second)]
    joint = shared_information(linearise_fit(*at_answer([first, second])))
    assert np.allclose(sum(alone), joint, rtol=1e-8, atol=1e-8 * np.abs(joint).max())


def errors_at(collocation, z) -> PredictedErrors:
    information = shared_information(linearise_fit(collocation, z))
    body = collocation.experiments[0].body
    return PredictedErrors.from_information(information, AT, ThetaMap(AT, body), AT.guess_q)


def test_error_bars_are_those_of_the_linearised_fit_of_a_run():
    collocation, z = at_answer([hung_cube(8)])
    given = ErrorModel("given", "independent")
    run = uncertainty_from_fit(linearise_fit(collocation, z), AT, AT.guess_q, given)
    found = errors_at(collocation, z)
    known = {
        n: e
        for n, e in {**run.estimates, **run.derived}.items()
        if e.statistical_std_error is not None
    }
    assert {"lambda_pa", "mu_pa", "young_pa", "poisson"} <= known.keys()
    for name, estimate in known.items():
        assert estimate.statistical_std_error is not None
        assert found.relative[name] == pytest.approx(
            estimate.statistical_std_error / estimate.value, rel=1e-3
        )


def test_criteria_agree_with_the_covariance():
    found = errors_at(*at_answer([hung_cube(8)]))
    variances = np.diag(found.covariance)
    size = {kind: np.exp(DesignCriterion(kind).log_size(found)) for kind in ("worst", "A", "D")}
    assert size["worst"] == pytest.approx(np.sqrt(variances.max()))
    assert size["A"] == pytest.approx(np.sqrt(variances.mean()))
    assert size["D"] == pytest.approx(np.linalg.det(found.covariance) ** (1 / 8))
    alone = DesignCriterion("D", ("poisson",)).log_size(found)
    assert np.exp(alone) == pytest.approx(found.relative["poisson"])
    assert DesignCriterion(over="mean").combine_draws([1.0, 4.0]) == 2.5
    assert DesignCriterion(over="worst").combine_draws([1.0, 4.0]) == 4.0


def test_designs_without_information_still_compare():
    found = PredictedErrors.from_information(
        np.zeros((4, 4)), AT, ThetaMap(AT, hung_cube(3).body), AT.guess_q
    )
    assert list(found.relative.values())[:4] == pytest.approx([100.0] * 4)


@pytest.mark.parametrize(
    ("criterion", "message"),
    [
        (("E", (), "mean"), "--criterion: found 'E'; expected one of worst, A, D"),
        (("A", (), "least"), "--over: found 'least'"),
        (("A", ("poison",), "mean"), "did you mean 'poisson'"),
        (("D", ("lambda_pa", "mu_pa", "poisson"), "mean"), "follows from the others"),
    ],
)
def test_a_criterion_that_cannot_be_is_refused(criterion, message):
    with pytest.raises(InputError, match=message):
        design_motion(problem(), LIMITS, 0.1, DesignCriterion(*criterion))


def test_draws_follow_priors_and_lie_on_both_sides_within_bounds():
    items = [replace(AT.items[0], prior=(500.0, 0.1)), *AT.items[1:]]
    tight = Parameters((items[0], replace(items[1], upper=310.0), *items[2:]))
    middle, above, below = prior_draws(tight, 1.5, 1, seed=3)
    assert np.exp(middle[0]) == pytest.approx(500.0)
    assert np.allclose(above[[0, 2, 3]] + below[[0, 2, 3]], 2 * middle[[0, 2, 3]])
    assert max(above[1], below[1]) < np.log(310.0)
    many = symmetric_draws(AT, AT.guess_q, 0.2 * np.eye(4), 400, seed=0)
    assert np.std(many, axis=0) == pytest.approx(0.2, rel=0.1)


# Recordings ---------------------------------------------------------------------------------------


def test_unsupported_designs_are_refused():
    cases = (
        (bar_in_two_hands(4), "has 2 grasps; expected one"),
        (replace(hung_cube(4), grasps=[replace(hung_cube(4).grasps[0], until_s=0.02)],
                 start="undeformed"), "a part of the time"),
    )  # fmt: skip
    for experiment, message in cases:
        with pytest.raises(InputError, match=message):
            FutureRecording(Problem([experiment], AT), experiment, 0.1)
    static = replace(hung_cube(4), kind="static")
    with pytest.raises(InputError, match="every experiment is static"):
        design_motion(Problem([static], AT), LIMITS, 0.1)
    with pytest.raises(InputError, match="--duration"):
        design_motion(problem(), LIMITS, 0.001)
    unguessed = Parameters((Parameter("lambda_pa", None, 10.0, 1e5), *AT.items[1:]))
    with pytest.raises(InputError, match="lambda_pa: this parameter has no guess"):
        design_motion(Problem([hung_cube(4)], unguessed), LIMITS, 0.1)


def test_the_poses_turn_the_body_about_its_hand():
    recording = FutureRecording(problem(), hung_cube(8), 0.2)
    coordinates = np.zeros((len(recording.pose_times_s), 6))
    coordinates[:, 4] = np.linspace(0, 1, len(coordinates))
    poses = recording.poses_from_coordinates(coordinates)
    assert np.allclose(
        poses.moved_positions(recording.hand_m[None], poses.t_s)[:, 0], recording.hand_m
    )


def test_a_small_motion_reports_its_first_order_effect():
    recording = FutureRecording(problem(), hung_cube(8), 0.25)
    motion = replace(drawn_motions(1)[0], duration_s=0.25, active_s=0.22, rise_s=0.08)
    small = motion.scaled(0.1, 0.1)
    linear = LinearRecording.from_simulations(recording, AT.guess_q).information(small)
    exact, still = (
        recording.simulate_motion(recording.experiment(recording.poses(each)), AT.guess_q)[0]
        for each in (small, motion.scaled(0, 0))
    )
    gained = np.sqrt(np.diag(exact)) - np.sqrt(np.diag(still))
    assert (gained[2:] > 0.5 * np.sqrt(np.diag(exact))[2:]).all()  # it is not the rest that tells
    assert np.allclose(np.sqrt(np.diag(linear)), np.sqrt(np.diag(exact)), rtol=0.05)


def test_a_sensor_measures_at_its_own_rate_over_the_new_time():
    sensing = wristed_cube(8)
    recording = FutureRecording(Problem([sensing], AT), sensing, 0.2)
    (before,), (grasp,) = (sensing.grasps, recording.experiment(still_poses(recording)).grasps)
    assert before.wrench is not None
    assert grasp.wrench is not None
    assert np.ptp(grasp.wrench.t_s) == pytest.approx(0.2, abs=0.02)
    assert np.diff(grasp.wrench.t_s) == pytest.approx(np.diff(before.wrench.t_s).mean())
    assert grasp.wrench.component_names == before.wrench.component_names


def still_poses(recording: FutureRecording) -> PoseSequence:
    return recording.poses_from_coordinates(np.zeros((len(recording.pose_times_s), 6)))


# Designs ------------------------------------------------------------------------------------------

FEW = DesignOptions(evaluations=10, pairs=0)


def test_a_designed_motion_is_more_informative_than_a_poor_one():
    slow = PoseSequence(
        np.linspace(0, 0.08, 9),
        np.outer(np.linspace(0, 1e-3, 9), [1, 0, 0]),
        np.tile([0, 0, 0, 1.0], (9, 1)),
    )
    poor = replace(hung_cube(8), grasps=[Grasp(hung_cube(8).grasps[0].nodes, slow)])
    found = design_motion(Problem([poor], AT), LIMITS, 0.08, options=FEW)
    assert found.before is not None
    assert max(found.before.relative[n] for n in TRUTH) > 3 * found.minimised_error
    assert found.minimised_error == pytest.approx(max(found.after.relative[n] for n in TRUTH))
    assert max(found.shares.values()) <= 1


def test_a_wrench_counts_and_the_search_then_begins_at_random():
    sensing = replace(wristed_cube(8), nuisance=IDEAL)
    (grasp,) = sensing.grasps
    blind = replace(sensing, grasps=(replace(grasp, wrench=None),))
    q, told = AT.guess_q, []
    for experiment in (sensing, blind):
        recording = FutureRecording(Problem([experiment], AT), experiment, 0.08)
        told.append(recording.simulate_motion(recording.experiment(still_poses(recording)), q)[0])
    assert np.linalg.eigvalsh(told[0] - told[1]).min() > -1e-6 * np.trace(told[0])
    assert told[0][0, 0] > 1.01 * told[1][0, 0]
    found = design_motion(Problem([sensing], AT), LIMITS, 0.08, options=DesignOptions(1, pairs=0))
    assert np.isfinite(found.minimised_error)


def test_answers_that_need_too_much_memory_are_not_sought(monkeypatch):
    recording = FutureRecording(problem(), hung_cube(8), 0.08)
    judge = MotionObjective(recording, LIMITS, DesignCriterion(), [AT.guess_q], np.zeros((4, 4)))
    monkeypatch.setattr(motion_design, "MOST_GIGABYTES", 0.5 * LinearRecording.gigabytes(recording))
    assert judge.first_guess(FEW, print).coefficients is None


def test_a_motion_is_judged_over_all_draws():
    judge = MotionObjective(
        FutureRecording(problem(), hung_cube(8), 0.08),
        LIMITS,
        DesignCriterion(over="worst"),
        prior_draws(AT, 1.5, 1, 0),
        np.zeros((4, 4)),
    )
    at = np.random.default_rng(0).normal(size=HandMotion.coefficient_count(1))
    alone = [replace(judge, draws=[q]).value(at, np.inf) for q in judge.draws]
    assert judge.value(at, np.inf) == pytest.approx(max(alone))
    assert judge.value(at, alone[0] - 1) == pytest.approx(alone[0])  # beyond the bar at the first


def test_recordings_there_are_count_where_they_are_to_be_completed():
    experiment = hung_cube(8)
    tracks = simulate(experiment, TRUTH, "midpoint", substeps=1).markers_m
    recorded = Problem([with_markers(experiment, tracks)], AT)
    found = design_motion(recorded, LIMITS, 0.08, options=FEW, add=True)
    alone = shared_information(linearise_fit(*at_answer([experiment])))
    before = PredictedErrors.from_information(
        alone, AT, ThetaMap(AT, experiment.body), AT.guess_q
    ).relative
    assert found.before is not None
    for name in TRUTH:
        assert found.before.relative[name] == pytest.approx(before[name], rel=1e-3)
        assert found.after.relative[name] < found.before.relative[name]


def test_ctrl_c_keeps_the_best_motion():
    tried = []

    def interrupt(number, size):
        tried.append(size)
        if number == 4:
            raise KeyboardInterrupt

    found = design_motion(problem(), LIMITS, 0.08, options=FEW, watch=interrupt)
    assert found.best.is_interrupted
    assert len(found.best.history) == 4
    assert found.best.value == min(tried)


def test_no_motion_in_view_and_none_that_can_be_simulated_are_reported():
    nowhere = Limits.model_validate(
        LIMITS.model_dump() | {"markers_box_m": ((1.0, 1.0, 1.0), (2.0, 2.0, 2.0))}
    )
    with pytest.raises(InputError, match="keeps the markers in view"):
        design_motion(problem(), nowhere, 0.05, options=DesignOptions(evaluations=2, pairs=0))


def test_motions_that_break_a_rule_come_after_all_others():
    recording = FutureRecording(problem(), hung_cube(8), 0.05)
    at = np.random.default_rng(0).normal(size=HandMotion.coefficient_count(1))
    near, far = (
        Limits.model_validate(
            LIMITS.model_dump() | {"markers_box_m": ((-1.0, -1, 0.02), (1.0, 1, top))}
        )
        for top in (1.0, 0.03)
    )
    values = [
        MotionObjective(recording, limits, DesignCriterion(), [AT.guess_q], np.zeros((4, 4))).value(
            at, np.inf
        )
        for limits in (LIMITS, near, far)
    ]
    assert values[0] < 100 < motion_design.FORBIDDEN < values[1] < values[2]


def test_the_search_finds_a_minimum_in_a_few_hundred_evaluations():
    scales = np.geomspace(0.3, 3, 12)
    found = minimise(lambda u, _: float(np.sum((scales * (u - 0.5)) ** 2)), 12, 600, seed=1)
    assert found.value < 0.02
    assert found.history == sorted(found.history, reverse=True)
    assert len(found.history) == 600


def test_the_search_has_one_dimension_too():
    found = minimise(lambda u, _: float((u[0] - 0.5) ** 2), 1, 100, seed=1)
    assert found.value < 1e-3


# Command line -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    return write_problem(tmp_path_factory.mktemp("tiny"), {"swing": 8})


def words(tiny, folder, *more: str) -> list[str]:
    limits = folder / "limits.toml"
    limits.write_text(TEXT)
    options = ["--duration", "0.08", "--limits", str(limits), "--out", str(folder / "out")]
    return ["design", str(tiny), *options, "--evaluations", "3", "--pairs", "0", *more]


@pytest.mark.long
def test_the_folder_holds_a_problem_that_simulates_the_motion(tiny, tmp_path):
    done = run_command(*words(tiny, tmp_path, *settings(*AT_TRUTH)))
    assert done.code == 0, done.err
    folder = tmp_path / "out"
    there = {file.name for file in folder.iterdir()}
    assert there >= {"poses.csv", "design.json", "motion.png", "error_bars.png", "motion.gif"}
    designed = Problem.read(folder / PROBLEM_FILE)
    (experiment,) = designed.experiments
    assert experiment.duration_s == pytest.approx(0.08)
    again = simulate(experiment, designed.parameters, designed.scheme, substeps=1).markers_m
    assert np.abs(again - experiment.markers.positions_m).max() < 1e-6
    content = json.loads((folder / "design.json").read_text())
    assert content["after"]["lambda_pa"]["value"] == pytest.approx(TRUTH["lambda_pa"])
    assert 0 < content["criterion"]["relative_error"] < 100
    assert max(item["share_used"] for item in content["limits"].values()) <= 1
    simulated = run_command("simulate", str(folder / PROBLEM_FILE), "--out", str(tmp_path / "data"))
    assert simulated.code == 0, simulated.err


def test_poses_are_written_as_the_robot_has_them(tiny, tmp_path):
    shutil.copytree(tiny.parent, tmp_path / "held")
    file = tmp_path / "held" / "problem.toml"
    held = (
        "gripper_to_body = { position_m = [0.01, 0.0, 0.02], quaternion_xyzw = [0, 0.6, 0, 0.8] }"
    )
    file.write_text(file.read_text().replace('poses = "swing', f'{held}, poses = "swing'))
    loaded = Problem.read(file)
    wide = Limits.model_validate(LIMITS.model_dump() | {"workspace_m": ((-1.0,) * 3, (1.0,) * 3)})
    found = design_motion(loaded, wide, 0.05, options=DesignOptions(1, pairs=0))
    write_design(found, tmp_path / "out", with_film=False)
    read = Problem.read(tmp_path / "out" / PROBLEM_FILE).experiments[0].grasps[0].poses
    for mine, theirs in zip(read.at(read.t_s), found.poses.at(read.t_s), strict=True):
        assert np.allclose(mine, theirs, atol=1e-9)
    written = (tmp_path / "out" / "poses.csv").read_text().splitlines()[1].split(",")
    assert not np.allclose(np.array(written[1:4], float), found.poses.positions_m[0], atol=1e-3)


@pytest.mark.long
def test_a_design_knows_where_the_files_of_the_problem_are(tiny, tmp_path):
    shutil.copytree(tiny.parent, tmp_path / "own")
    file = tmp_path / "own" / "problem.toml"
    (file.parent / "drag.py").write_text("def drag(x, v, at):\n    return -1e-6 * v\n")
    force = 'density_kg_m3 = 30.0\n[[object.force]]\nfile = "drag.py"\nfunction = "drag"\n'
    file.write_text(file.read_text().replace("density_kg_m3 = 30.0\n", force))
    loaded = Problem.read(file, allow_code=True)
    designed = design_motion(loaded, LIMITS, 0.05, options=DesignOptions(1, pairs=0))
    write_design(designed, tmp_path / "out", with_film=False)
    again = Problem.read(tmp_path / "out" / PROBLEM_FILE, allow_code=True)
    assert [force.name for force in again.bodies[0].forces] == ["drag"]


def test_the_search_shows_its_remaining_time(monkeypatch):
    now_s = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now_s)
    with DesignProgress(Console(file=io.StringIO()), 40, quiet=True) as shown:
        shown.show_activity("searching for a motion")
        shown.show_best(1, np.log(0.5))
        now_s = 110.0
        shown.show_best(11, np.log(0.25))
        assert shown._activity_with_time() == (
            "searching for a motion (Ctrl-C stops and keeps the best): 28%, about 26 s left, "
            "11 of 40 motions evaluated, smallest error bar: 25 %"
        )


def test_an_interrupted_design_is_written_and_told(tiny, tmp_path, monkeypatch):
    def interrupt(self, number, size):
        raise KeyboardInterrupt

    monkeypatch.setattr(DesignProgress, "show_best", interrupt)
    done = run_command(*words(tiny, tmp_path, "--no-film"))
    assert done.code == 130
    assert "interrupted: the best of the 1 motions" in done.out
    assert json.loads((tmp_path / "out" / "design.json").read_text())["search"]["interrupted"]


@pytest.mark.long
def test_recordings_that_count_stay_in_the_problem(tiny, tmp_path):
    done = run_command(*words(tiny, tmp_path, "--no-film", "--add", "--json"))
    assert done.code == 0, done.err
    assert json.loads(done.out)["recordings_count"] is True
    designed = Problem.read(tmp_path / "out" / PROBLEM_FILE)
    assert [each.name for each in designed.experiments] == ["swing", "designed"]


def test_a_folder_that_is_no_design_is_left_alone(tiny, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.txt").write_text("all of it")
    done = run_command(*words(tiny, tmp_path))
    assert done.code == 2
    assert "has files but no design.json" in done.err
