"""Verdicts of predictions, and baselines of validation recordings."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from kit.problems import TRUTH, hung_cube
from scipy.interpolate import CubicSpline

import collocation_sysid as cs
from collocation_sysid.common.display import plain_text
from collocation_sysid.common.serialisation import as_json, read
from collocation_sysid.program.depth.surface_comparison import DepthError
from collocation_sysid.program.depth.visible_surface import VisibleSurface
from collocation_sysid.result.run_record import replays
from collocation_sysid.result.run_summary import run_summary
from collocation_sysid.runs.forward_simulation import CopyError, nearest_recording_error
from collocation_sysid.runs.result_content import Result
from collocation_sysid.statistics.assessment import prediction_concerns

NOISE_M = 1e-3


def shown(finished: cs.Run, details: bool = True) -> str:
    return plain_text(run_summary(finished.result, Path("runs"), details=details))


def stored(finished: cs.Run) -> dict:
    """What result.json holds of the recordings, fitted and simulated."""
    written = json.loads(as_json(finished.result))
    assert read(Result, written) is not None
    return {key: written[key]["experiments"] for key in ("fit", "rollout")}


# Nothing is estimated -----------------------------------------------------------------------------


@cache
def predicted(softer: float, is_exact: bool = False) -> cs.Run:
    """A swinging cube whose motion is predicted with stated parameters."""
    hung = hung_cube(30)
    tracks = cs.simulate(hung, TRUTH).markers_m
    tracks = tracks + NOISE_M * np.random.default_rng(0).standard_normal(tracks.shape)
    sigma_m = np.full(tracks.shape[1], NOISE_M)
    seen = replace(hung.markers, positions_m=tracks, sigma_m=sigma_m)
    stated = {n: v * softer if n.endswith("_pa") else v for n, v in TRUTH.items()}
    deviations = cs.Assumptions.exact() if is_exact else cs.Assumptions()
    problem = cs.Problem(
        [replace(hung, markers=seen)],
        stated,
        substeps=4,
        uncertainty=cs.UncertaintyOptions(assumptions=deviations),
    )
    return cs.run(problem, seek_causes=False)


@pytest.mark.long
@pytest.mark.parametrize(
    ("softer", "verdict"), [(1.0, "good"), (0.75, "doubtful"), (0.3, "doubtful")]
)
def test_a_prediction_is_judged_by_its_misfit_over_sigma(softer, verdict):
    finished = predicted(softer)
    assert finished.trust.verdict == verdict
    concerns = [c for c in finished.trust.concerns if c.topic == "prediction"]
    assert len(concerns) == (verdict != "good")
    for concern in concerns:
        rms_mm = 1e3 * finished.rollouts["hung cube"].rms_m
        assert concern.grade == verdict
        assert "deviates from the markers by" in concern.message
        assert f"{rms_mm:.3g} mm RMS" in concern.message
        assert concern.data["sigmas"] == pytest.approx(rms_mm / np.sqrt(3), rel=0.01)


@pytest.mark.long
def test_a_prediction_off_by_more_than_noise_and_description_explain_is_doubtful():
    assert predicted(1.0, is_exact=True).trust.verdict == "good"
    finished = predicted(1.14, is_exact=True)
    first, *_ = finished.trust.concerns
    assert (first.code, first.grade) == ("prediction/misses", "doubtful")
    assert first.data["sigmas"] < 1.2  # each marker is within its noise, all together are not


def test_few_numbers_that_are_off_by_chance_are_no_concern():
    def grades(sigmas: float, numbers: int, tame: float | None = None) -> list[str]:
        how = sigmas, tame or sigmas, numbers
        return [c.grade for c in prediction_concerns("a", "the markers", "sigma_m", *how)]

    assert grades(1.4, 1000) == []
    assert grades(2.0, 1000) == ["check"]
    assert grades(2.0, 3) == []
    assert grades(6.0, 1000) == ["doubtful"]
    assert grades(6.0, 1000, tame=1.2) == []  # a few wild points


def test_measurements_that_are_the_predicted_values_are_noticed():
    def codes(sigmas: float, numbers: int) -> list[str]:
        how = sigmas, sigmas, numbers
        return [c.code for c in prediction_concerns("a", "the markers", "sigma_m", *how)]

    assert codes(0.04, 1000) == ["prediction/closer"]
    assert codes(0.5, 1000) == []  # sigma is known to a factor of two at best
    assert codes(0.04, 2) == []  # two numbers may be so close by chance


# Depth --------------------------------------------------------------------------------------------

BAR_TRUTH = {"young_pa": 1.5e5, "poisson": 0.3, "gamma_r_s": 1e-3, "gamma_m_1_s": 0.1}
MATRIX, SHAPE = [[300.0, 0, 80], [0, 300.0, 60], [0, 0, 1]], (120, 160)
POSE = np.array(  # looks along y at a bar from 0.3 m away
    [[1, 0, 0, 0.06], [0, 0, 1, -0.3], [0, -1, 0, -0.01], [0, 0, 0, 1]], dtype=float
)
DEPTH_NOISE_M = 2e-4
NOTHING = cs.Depth("none", [0.0], [np.zeros((1, 3))], 1e-3)


@cache
def bar() -> cs.Body:
    mesh = cs.box_mesh((0.12, 0.03, 0.02), (4, 1, 1))
    return cs.Body(mesh, density_kg_m3=1070.0)


def hanging(gravity: tuple[float, float, float], depth: cs.Depth, **changes) -> cs.Experiment:
    """The bar held at one end, pulled towards the camera or away from it by gravity."""
    held = cs.Grasp(np.flatnonzero(bar().nodes_m[:, 0] < 1e-9), cs.PoseSequence.fixed())
    settings = {"kind": "static", "nuisance": cs.Nuisance.none(), "gravity_m_s2": gravity}
    return cs.Experiment(bar(), [0.0], [held], depths=[depth], **settings | changes)


@cache
def recorded(gravity: tuple[float, float, float], **changes) -> cs.Experiment:
    """The same with a depth image, taken at the truth."""
    x = cs.simulate(hanging(gravity, NOTHING), BAR_TRUTH).positions_m[0]
    skin, camera = (VisibleSurface.from_body(bar(), NOTHING), cs.DepthCamera(MATRIX, pose=POSE))
    shape_m = x[skin.nodes]
    image_m = cs.depth_image(
        camera, SHAPE, (skin.subdivided_triangles(shape_m) - POSE[:3, 3]) @ POSE[:3, :3]
    )
    image_m = image_m + DEPTH_NOISE_M * np.random.default_rng(0).normal(size=SHAPE)
    depth = cs.Depth.of_images("front", image_m, camera, DEPTH_NOISE_M, spacing_m=0.004)
    return hanging(gravity, depth, **changes)


ACROSS, ALONG = (0.0, 9.81, 0.0), (9.81, 0.0, 0.0)


@cache
def image_predicted(young_pa: float, is_exact: bool = False) -> cs.Run:
    deviations = cs.Assumptions.exact() if is_exact else cs.Assumptions()
    problem = cs.Problem(
        [recorded(ACROSS)],
        BAR_TRUTH | {"young_pa": young_pa},
        uncertainty=cs.UncertaintyOptions(assumptions=deviations),
    )
    return cs.run(problem, seek_causes=False)


@pytest.mark.long
def test_predicted_depth_is_compared_with_the_image_and_graded():
    right, wrong = image_predicted(1.5e5), image_predicted(0.3e5)
    good, bad = (each.rollouts["experiment"].depth["front"] for each in (right, wrong))
    assert right.trust.verdict == "good"
    assert image_predicted(1.5e5, is_exact=True).result.trust.verdict == "good"
    assert good.rms_m == pytest.approx(DEPTH_NOISE_M, rel=0.25)
    assert good.share_beyond_gate == 0.0
    assert wrong.trust.verdict == "doubtful"
    assert "deviates from the depth of front by" in wrong.trust.reasons[0]
    assert bad.rms_m > 0.008
    found = stored(wrong)
    assert found["rollout"]["experiment"]["depth"]["front"]["rms_m"] == bad.rms_m
    assert found["fit"]["experiment"]["depth"]["front"]["points"] > 100
    assert f"depth of front {1e3 * bad.rms_m:.3g} mm RMS of {bad.points} points" in shown(wrong)


def test_gate_and_rms_of_depth_belong_to_the_same_points():
    bad = image_predicted(0.3e5).rollouts["experiment"].depth["front"]
    assert bad.gate_m == 0.01 < bad.reach_m
    assert bad.rms_within_gate_m <= bad.gate_m
    assert 0.1 < bad.share_beyond_gate < 0.9
    beyond = bad.rms_m**2 - (1 - bad.share_beyond_gate) * bad.rms_within_gate_m**2
    assert bad.gate_m < np.sqrt(beyond / bad.share_beyond_gate) <= bad.reach_m
    assert f"{bad.share_beyond_gate:.0%} beyond the limit of 10 mm (gate_m)" in shown(
        image_predicted(0.3e5)
    )


def test_notes_of_a_depth_recording_do_not_speak_of_wrenches():
    notes = " ".join(image_predicted(0.3e5).result.notes)
    assert "wrench" not in notes
    assert "the residuals of the points of depth cameras are" in notes


def test_points_that_are_nowhere_near_the_prediction_are_doubtful():
    experiment = recorded(ACROSS)
    (depth,) = experiment.depths
    away = [cloud + np.array([0.0, 0.0, 0.2]) for cloud in depth.clouds]
    far = replace(experiment, depths=[replace(depth, clouds=away)])
    finished = cs.run(cs.Problem([far], BAR_TRUTH), seek_causes=False)
    assert finished.trust.verdict == "doubtful"
    assert "prediction/unseen" in [c.code for c in finished.trust.concerns]


@pytest.mark.long
def test_depth_of_a_validation_recording_is_compared_drawn_and_judged():
    fitted = recorded(ACROSS, name="fitted")
    away = recorded((0.0, -9.81, 0.0), name="away", validation=True)
    wrong = replace(away, gravity_m_s2=(0.0, 0.0, -9.81), name="wrong")
    unknown = BAR_TRUTH | {"young_pa": cs.Unknown(1.4e5)}
    finished = cs.run(cs.Problem([fitted, away, wrong], unknown), seek_causes=False)
    (predicted,) = finished.rollouts["away"].depth.values()
    assert isinstance(predicted, DepthError)
    assert predicted.rms_m == pytest.approx(DEPTH_NOISE_M, rel=0.3)
    drawn = {replay.name: replay.visible_points for replay in replays(finished)}["away"]["front"]
    assert np.isfinite(drawn[:, 4]).sum() == predicted.points
    assert "points of depth cameras cannot be compared" in shown(finished)
    (concern,) = (c for c in finished.trust.concerns if c.code == "roll-out/predicted")
    assert (concern.data["experiment"], concern.data["what"]) == ("wrong", "the depth of front")


# Yardsticks of a validation recording -------------------------------------------------------------


def swing(name: str, late_s: float, seed: int, steps: int = 16, **changes) -> cs.Experiment:
    """The cube, swung alike every time, seen by cameras that are late."""
    hung = hung_cube(steps, nuisance=cs.Nuisance.none(time_shift_s=5e-3), **changes)
    tracks = CubicSpline(hung.t_s, cs.simulate(hung, TRUTH).markers_m)
    seen = tracks(np.maximum(hung.t_s - late_s, 0.0))
    seen = seen + 2e-4 * np.random.default_rng(seed).standard_normal(seen.shape)
    sigma_m = np.full(seen.shape[1], 2e-4)
    markers = replace(hung.markers, positions_m=seen, sigma_m=sigma_m)
    return replace(hung, name=name, markers=markers)


@cache
def validated(late_s: float, prior_s: float = 5e-3) -> cs.Run:
    """A recording that is predicted from another, whose cameras are 4 ms late."""
    unknown = {**TRUTH, "mu_pa": cs.Unknown(290.0)}
    new = swing("new", late_s, 1)
    new = replace(new, validation=True, nuisance=cs.Nuisance.none(time_shift_s=prior_s))
    finished = cs.run(
        cs.Problem([swing("fitted", 4e-3, 0), new], unknown, substeps=3), seek_causes=False
    )
    return finished


@pytest.mark.long
def test_the_error_of_a_validation_recording_is_that_of_a_blind_prediction():
    alike, other = validated(4e-3), validated(-4e-3)
    assert alike.rollouts["new"].rms_m == pytest.approx(np.sqrt(3) * 2e-4, rel=0.2)
    rollout = other.rollouts["new"]
    assert rollout.rms_m > 3 * rollout.own.rms_m
    assert rollout.own.rms_m == pytest.approx(np.sqrt(3) * 2e-4, rel=0.2)
    assert rollout.nuisance["new: time shift [s]"] == pytest.approx(-4e-3, abs=3e-4)
    assert rollout.own_deviations["new: time shift [s]"] == pytest.approx(1.6, abs=0.1)
    found = stored(other)["rollout"]
    assert found["new"]["rms_m"] == rollout.rms_m
    assert found["new"]["own"]["rms_m"] == rollout.own.rms_m
    assert "own" not in found["fitted"]
    said = shown(other)
    assert f"validation 'new': {1e3 * rollout.rms_m:.3f} mm RMS" in said
    assert f"fitted to it: {1e3 * rollout.own.rms_m:.3f} mm RMS" in said
    # The prior of the clock allows for the difference, so that it is no contradiction.
    assert "roll-out/predicted" not in [concern.code for concern in other.trust.concerns]


@pytest.mark.long
def test_an_implausible_nuisance_parameter_does_not_excuse_a_prediction():
    finished = validated(-4e-3, prior_s=None)
    (concern,) = (c for c in finished.trust.concerns if c.code == "roll-out/predicted")
    assert concern.data["what"] == "the markers"
    assert finished.rollouts["new"].own is None


@pytest.mark.long
def test_a_clock_that_is_declared_as_unknown_is_estimated_and_its_size_reported():
    finished = validated(-4e-3, prior_s=1e-3)
    rollout = finished.rollouts["new"]
    assert rollout.rms_m == pytest.approx(np.sqrt(3) * 2e-4, rel=0.2)
    assert rollout.own_onsets["new: time shift [s]"] == pytest.approx(4.0, abs=0.3)
    assert "with 'new: time shift [s]' at +4" in shown(finished)
    (concern,) = (c for c in finished.trust.concerns if c.code == "roll-out/onset")
    assert concern.grade == "check"
    certain = validated(-4e-3, prior_s=6e-3)
    assert certain.rollouts["new"].own_onsets
    assert "roll-out/onset" not in [c.code for c in certain.trust.concerns]


# Specimens ----------------------------------------------------------------------------------------

STRETCHES = np.linspace(1.0, 1.6, 13)
MU_PA = 1e5
STRESSES_PA = {
    "uniaxial": MU_PA * (STRETCHES - STRETCHES**-2),
    "equibiaxial": MU_PA * (STRETCHES - STRETCHES**-5),
    "planar": MU_PA * (STRETCHES - STRETCHES**-3),
}


def pulled(test: str, factor: float = 1.0, **changes) -> cs.Experiment:
    """A neo-Hookean specimen with noise of 300 Pa, its stresses multiplied by a factor."""
    noise_pa = 300.0 * np.random.default_rng(len(test)).standard_normal(len(STRETCHES))
    stress_pa = factor * STRESSES_PA[test] + noise_pa
    specimen = cs.Specimen(test, STRETCHES - 1, stress_pa, sigma_pa=300.0)
    return replace(specimen.experiment("neo-hookean", test), **changes)


@cache
def stress_predicted(test: str, factor: float) -> cs.Run:
    experiments = [pulled("uniaxial"), pulled(test, factor, validation=True)]
    parameters = {"mu_pa": cs.Unknown(), "kappa_pa": 1e9, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
    return cs.run(cs.Problem(experiments, parameters), seek_causes=False)


@pytest.mark.long
@pytest.mark.parametrize("test", ["equibiaxial", "planar"])
@pytest.mark.parametrize(("factor", "grade"), [(1.0, None), (1.01, None), (20.0, "doubtful")])
def test_predicted_stresses_enter_the_verdict_and_are_not_absorbed(test, factor, grade):
    finished = stress_predicted(test, factor)
    rms_pa = np.sqrt(np.mean(((1 - factor) * STRESSES_PA[test]) ** 2 + 300.0**2))
    rollout = finished.rollouts[test]
    assert rollout.reading_rms["stress"] == pytest.approx(rms_pa, rel=0.05, abs=1e3)
    concerns = [c for c in finished.trust.concerns if c.topic == "roll-out"]
    assert [c.grade for c in concerns] == [grade] * (grade is not None)
    for concern in concerns:
        assert "area_error" in concern.message
        assert finished.trust.verdict == grade


def test_a_prediction_stands_beside_the_copy_of_a_fitted_recording():
    alike = validated(4e-3)
    copied = alike.rollouts["new"].copied
    assert isinstance(copied, CopyError)
    assert copied.copied == "fitted"
    assert copied.error.rms_m == pytest.approx(np.sqrt(6) * 2e-4, rel=0.1)  # the noise of both
    assert stored(alike)["rollout"]["new"]["copied"]["copied"] == "fitted"
    assert "(measurements of 'fitted' as the prediction: " in shown(alike, details=False)


@pytest.mark.long
def test_the_nearest_recording_is_copied_or_the_reason_is_given():
    new = swing("new", 0.0, 1)
    near, far = swing("near", 1e-3, 2), swing("far", 8e-3, 3)
    found = nearest_recording_error(new, [far, near])
    assert isinstance(found, CopyError)
    assert found.copied == "near"
    assert nearest_recording_error(new, [swing("long", 0.0, 2, steps=17)]) == (
        "no fitted recording has the same samples (long: 18 samples instead of 17)"
    )
    faster = replace(near, t_s=0.9 * near.t_s, markers=replace(near.markers, t_s=0.9 * near.t_s))
    assert "other times" in nearest_recording_error(new, [faster])
    renamed = replace(near.markers, names=[f"{name}'" for name in near.markers.names])
    assert "other markers" in nearest_recording_error(new, [replace(near, markers=renamed)])
