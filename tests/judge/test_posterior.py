"""The posterior of an answer against Bayes' formula, and what it says of single effects."""

from __future__ import annotations

import numpy as np
import pytest

import collocation_sysid as cs
from collocation_sysid.judge.posterior import NOISE, NUISANCES, Effects, Posterior
from collocation_sysid.model.parameters import Parameters
from collocation_sysid.statistics.budget.effect_estimates import EFFECT, EffectEstimate
from collocation_sysid.statistics.budget.systematic_effects import DEVIATIONS
from collocation_sysid.statistics.linearised import LinearisedFit, ResidualBlock
from collocation_sysid.statistics.uncertainty import ErrorModel

GIVEN = ErrorModel("given", "independent")
PARAMETERS = Parameters.from_mapping(
    {"young_pa": cs.Unknown(1e4), "gamma_r_s": cs.Unknown(1e-2), "gamma_m_1_s": cs.Unknown(0.5)}
)
NAMES = (*(item.name for item in PARAMETERS.free), "swing: time shift [s]")
SHARED = len(PARAMETERS.free)
Q = PARAMETERS.guess_q
SAMPLES, MARKERS = 12, 2
LAWS = ("damping_law material", "damping_law kelvin-voigt")


def linear_fit(slopes: np.ndarray, residual: np.ndarray) -> LinearisedFit:
    """A fit of residuals (n,) with derivatives (n, 4) by three constants and a time shift, whose
    prior has the standard deviation one.
    """
    shape = (SAMPLES, MARKERS, 3)
    measured = ResidualBlock(
        "swing",
        0.01 * np.arange(SAMPLES),
        tuple(f"m{k}" for k in range(MARKERS)),
        np.ones(shape[:2], dtype=bool),
        residual.reshape(shape),
        slopes.reshape(*shape, -1),
        np.ones(MARKERS),
    )
    prior = np.array([0.0, 0.0, 0.0, 1.0])
    return LinearisedFit((measured,), NAMES, SHARED, 0 * prior, prior, np.zeros(4, dtype=bool))


def effects(columns: np.ndarray, *names: str, means: float | np.ndarray = 0.0) -> Effects:
    """Effects with columns (n, a), in standard deviations of their priors."""
    deviations = np.array([DEVIATIONS[name.partition(" ")[0]].considered for name in names])
    blocks = (columns.reshape(SAMPLES, MARKERS, 3, -1),)
    return Effects(names, blocks, np.broadcast_to(means, len(names)).astype(float), deviations)


def posterior(fit: LinearisedFit, columns: np.ndarray, *names: str, means=0.0) -> Posterior:
    return Posterior.from_fit(fit, effects(columns, *names, means=means), PARAMETERS, Q, GIVEN)


def slopes(rng: np.random.Generator, count: int) -> np.ndarray:
    """Correlated columns, as those of the constants of a body are."""
    size = SAMPLES * MARKERS * 3
    return 3 * rng.normal(size=(size, count)) + 2 * rng.normal(size=(size, 1))


def by_bayes(
    slopes: np.ndarray, residual: np.ndarray, columns: np.ndarray, means: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of all parameters and effects, whose priors are normal; those of the
    constants are flat.
    """
    rows = np.hstack([slopes, columns])
    precision = np.diag(np.repeat([0.0, 1.0], [SHARED, rows.shape[1] - SHARED]))
    mean = np.concatenate([np.zeros(slopes.shape[1]), means])
    covariance = np.linalg.inv(rows.T @ rows + precision)
    return covariance @ (precision @ mean - rows.T @ residual), covariance


def of_effect(found: Posterior, name: str) -> EffectEstimate:
    (own,) = (each for each in found.effect_estimates if each.name == name)
    return own


# Bayes' formula -----------------------------------------------------------------------------------


def test_step_covariance_and_budget_are_those_of_bayes_formula(rng):
    by_parameters, columns = slopes(rng, 4), 0.5 * slopes(rng, 3)
    residual = rng.normal(size=len(columns))
    means = np.array([0.0, 2.0, 0.0])
    names = ("mass", "grip_layer_m", "body_scale")
    found = posterior(linear_fit(by_parameters, residual), columns, *names, means=means)
    mean, covariance = by_bayes(by_parameters, residual, columns, means)
    np.testing.assert_allclose(found.step, mean, atol=1e-9)
    np.testing.assert_allclose(found.covariance, covariance, atol=1e-9)
    np.testing.assert_allclose(found.q, Q + mean[:SHARED], atol=1e-9)
    by_noise = covariance @ np.hstack([by_parameters, columns]).T
    for k, name in enumerate(PARAMETERS.names):
        line, variance = found.budget[name], covariance[k, k]
        expected = {NOISE: np.sum(by_noise[k] ** 2), NUISANCES: covariance[k, 3] ** 2}
        expected |= dict(zip(names, covariance[k, 4:] ** 2, strict=True))
        for source, part in expected.items():
            assert line.shares[source] == pytest.approx(part / variance, rel=1e-4), source
        assert np.log(line.value) == pytest.approx(Q[k] + mean[k])
        low, high = np.log(line.combined95)
        assert high - low == pytest.approx(2 * 1.96 * np.sqrt(variance), rel=1e-4)
        assert line.combined_std_error / line.value == pytest.approx(np.sqrt(variance), rel=1e-4)
    for k, name in enumerate(names, start=4):
        own, size = of_effect(found, name), DEVIATIONS[name].considered
        assert own.value == pytest.approx(mean[k] * size)
        assert own.std_error == pytest.approx(np.sqrt(covariance[k, k]) * size)
        assert (own.mean, own.deviation) == pytest.approx((means[k - 4] * size, size))


def test_what_acts_alike_in_two_motions_cancels_in_the_joint_posterior(rng):
    """Deviations of another motion from its prediction have the joint covariance, and the mean by the
    offset from the answer.
    """
    by_parameters = slopes(rng, 4)
    by_parameters[:, 3] = 0.0  # the time shift
    # The data hardly tell the effects from constants.
    columns = by_parameters[:, :3] @ rng.normal(size=(3, 2)) + 0.01 * slopes(rng, 2)
    names = ("mass", "body_scale")
    both = np.hstack([by_parameters[:, :3], columns])
    other = np.hstack([slopes(rng, 3), 0.5 * slopes(rng, 2)])[:1]
    scores = []
    for _ in range(200):
        truth = np.append(0.1 * rng.normal(size=3), rng.normal(size=2))
        residual = rng.normal(size=len(both)) - both @ truth
        joint = posterior(linear_fit(by_parameters, residual), columns, *names).joint(())
        variance = (other @ joint.covariance @ other.T)[0, 0]
        scores.append((other @ (truth - joint.offset))[0] / np.sqrt(variance))
    assert joint.names == (*NAMES[:3], *(EFFECT + name for name in names))
    assert np.mean(scores) == pytest.approx(0, abs=0.25)
    assert np.std(scores) == pytest.approx(1, abs=0.15)
    of_constants = both[:, :3] @ joint.covariance[:3, :3] @ both[:, :3].T
    alike = both @ joint.covariance @ both.T
    assert np.trace(alike) < 0.1 * np.trace(of_constants)
    assert joint.by_source[:3] == pytest.approx(joint.covariance[:3, 3:])


@pytest.mark.parametrize("is_learnt", [True, False])
def test_the_joint_posterior_has_the_constants_of_the_body(rng, is_learnt):
    """A law of damping that redefines γ_r, and effects that the data do not correct."""
    by_parameters, columns = slopes(rng, 4), 0.5 * slopes(rng, 2)
    by_parameters[:, 3] = 0.0
    fit = linear_fit(by_parameters, rng.normal(size=len(columns)))
    own = effects(columns, "mass", LAWS[0], means=np.array([2.0, 0.0]))
    found = Posterior.from_fit(fit, own, PARAMETERS, Q, GIVEN, is_learnt=is_learnt)
    joint = found.joint(())
    raw = np.hstack([by_parameters[:, :3], columns])
    if is_learnt:
        defined = found.fit.blocks[0].jacobian.reshape(len(raw), -1)
        assert np.abs(defined[:, 5] - columns[:, 1]).max() > 0.1
        covariance, step = found.covariance, found.step
    else:
        # The constants change with an effect such that the measurements do not.
        by_effect = -np.linalg.lstsq(by_parameters, columns, rcond=None)[0][:3]
        by_noise = np.linalg.inv(by_parameters[:, :3].T @ by_parameters[:, :3])
        np.testing.assert_allclose(joint.covariance[:3, 3:], by_effect, atol=1e-9)
        np.testing.assert_allclose(
            joint.covariance[:3, :3], by_noise + by_effect @ by_effect.T, atol=1e-9
        )
        np.testing.assert_allclose(joint.covariance[3:, 3:], np.eye(2), atol=1e-12)
        np.testing.assert_allclose(joint.offset[3:], [2.0, 0.0])
        return
    np.testing.assert_allclose(
        raw @ joint.covariance @ raw.T, defined @ covariance @ defined.T, atol=1e-9
    )
    np.testing.assert_allclose(raw @ joint.offset, defined @ step, atol=1e-9)


def test_effects_without_some_are_those_of_a_fit_without_them(rng):
    by_parameters, columns = slopes(rng, 4), 0.5 * slopes(rng, 3)
    fit = linear_fit(by_parameters, rng.normal(size=len(columns)))
    whole = posterior(fit, columns, "mass", "grip_layer_m", "body_scale")
    part = posterior(fit, columns[:, 1:], "grip_layer_m", "body_scale")
    np.testing.assert_allclose(whole.without(["mass"]).q, part.q, atol=1e-9)
    np.testing.assert_allclose(whole.without(["mass"]).covariance, part.covariance, atol=1e-9)


def test_the_interval_of_a_surprising_effect_contains_the_estimate_without_it(rng):
    """What looks like the reverse of an error of the mesh has another cause, which need not move
    the constants.
    """
    by_parameters, column = 30.0 * slopes(rng, 4), 10.0 * slopes(rng, 1)
    fit = linear_fit(by_parameters, 3.0 * 2.0 * column[:, 0])
    own = effects(column, "mesh", means=2.0)
    found, without = (
        Posterior.from_fit(fit, own, PARAMETERS, Q, GIVEN, is_learnt=each) for each in (True, False)
    )
    assert of_effect(found, "mesh").value == pytest.approx(-3.0, abs=0.01)
    moved = found.reported_q - without.reported_q
    for k, name in enumerate(PARAMETERS.names):
        deviation = np.diff(np.log(found.reported(name).combined95))[0] / 3.92
        assert abs(moved[k]) < deviation < 1.5 * abs(moved[k]), name


def test_a_row_with_a_surprise_counts_for_all_that_its_components_change(rng):
    by_parameters, columns = 3.0 * slopes(rng, 4), 3.0 * slopes(rng, 2)
    fit = linear_fit(by_parameters, -columns @ [2.0, 1.0])
    names = ("initial_slope excess", "initial_slope shape")
    found = posterior(fit, columns, *names)
    without = posterior(fit, columns[:, :0])
    assert [abs(of_effect(found, name).surprise) > 4 for name in names] == [True, False]
    labels, ways = found.sources
    assert labels == (*names, "initial_slope")
    np.testing.assert_allclose(ways[:4, 2], (found.step - np.append(without.step, [0, 0]))[:4])


def test_the_effect_of_the_time_step_is_not_learnt(rng):
    """Constants are corrected by its mean whatever the residuals are, which are judged without it."""
    by_parameters, column = slopes(rng, 4), 5.0 * slopes(rng, 1)
    noise = rng.normal(size=len(column))
    own = effects(column, "time_step", means=2.0)
    expected = posterior(linear_fit(by_parameters, noise), column[:, :0])
    for residual in (noise - 2.0 * column[:, 0], noise - 6.0 * column[:, 0]):
        found = Posterior.from_fit(linear_fit(by_parameters, residual), own, PARAMETERS, Q, GIVEN)
        known = linear_fit(by_parameters, residual + 2.0 * column[:, 0])
        corrected = posterior(known, column[:, :0])
        np.testing.assert_allclose(found.q, corrected.q, atol=1e-9)
        assert found.uncertainty.level.pooled == pytest.approx(corrected.uncertainty.level.pooled)
        assert all(line.shares["time_step"] > 0 for line in found.budget.values())
    assert not np.allclose(found.q, expected.q, atol=1e-3)


def test_no_other_effect_is_suspected_of_what_the_time_step_changes(rng):
    by_parameters = slopes(rng, 4)
    residual = rng.normal(size=len(by_parameters))
    own = effects(5 * rng.normal(size=(len(residual), 1)), "time_step", means=2.0)
    found = Posterior.from_fit(linear_fit(by_parameters, residual), own, PARAMETERS, Q, GIVEN)
    unseen = effects(1e-9 * rng.normal(size=(len(residual), 1)), "mass")
    assert all(each.surprise < 1e-3 for each in found.suspected(unseen, GIVEN))


def test_other_effects_are_learnt_beside_the_mean_of_one_that_a_refinement_measures(rng):
    """The refinement corrects the constants alone for the measured change of the residuals."""
    by_parameters, columns = slopes(rng, 4), 0.5 * slopes(rng, 3)
    residual, measured = rng.normal(size=len(columns)), 2.0 * columns[:, 0]
    means = np.array([2.0, 0.0, 0.0])
    names = ("mesh", "grip_layer_m", "body_scale")
    whole = posterior(linear_fit(by_parameters, residual), columns, *names, means=means)
    part = posterior(linear_fit(by_parameters, residual + measured), columns[:, 1:], *names[1:])
    refined = posterior(linear_fit(by_parameters, measured), columns[:, :0])
    besides = whole.without(["mesh"])
    np.testing.assert_allclose(besides.q + refined.q - Q, part.q, atol=1e-9)
    np.testing.assert_allclose(besides.covariance, part.covariance, atol=1e-9)


@pytest.mark.long
def test_intervals_hold_and_surprises_are_standard_normal_if_all_is_drawn_from_its_prior():
    rng = np.random.default_rng(11)
    by_parameters, columns = slopes(rng, 4), 0.7 * slopes(rng, 3)
    columns[:, 2] = by_parameters[:, 0] + 0.3 * rng.normal(size=len(columns))
    names, means, draws = ("mass", "body_scale", "air_drag"), np.array([0.0, 0.0, 1.0]), 600
    held, surprises = [], []
    for _ in range(draws):
        truth = np.concatenate([0.1 * rng.normal(size=SHARED), rng.normal(size=1)])
        residual = rng.normal(size=len(columns)) - by_parameters @ truth
        residual -= columns @ (means + rng.normal(size=3))
        found = posterior(linear_fit(by_parameters, residual), columns, *names, means=means)
        for k, name in enumerate(PARAMETERS.names):
            low, high = np.log(found.reported(name).combined95)
            held.append(low < Q[k] + truth[k] < high)
        surprises.append([of_effect(found, name).surprise for name in names])
    assert 0.93 < np.mean(held) < 0.97
    np.testing.assert_allclose(np.mean(surprises, axis=0), 0.0, atol=3 / np.sqrt(draws))
    np.testing.assert_allclose(np.var(surprises, axis=0), 1.0, atol=3 * np.sqrt(2 / draws))


# Single effects -----------------------------------------------------------------------------------


def test_an_effect_that_the_data_cannot_see_leaves_the_value_and_adds_its_prior(rng):
    by_parameters = slopes(rng, 4)
    fit = linear_fit(by_parameters, rng.normal(size=len(by_parameters)))
    without = posterior(fit, by_parameters[:, :0])
    # A mass that is too large by 10 % is as a modulus that is too large by 10 %.
    found = posterior(fit, 0.1 * by_parameters[:, :1], "mass")
    np.testing.assert_allclose(found.q, without.q, atol=1e-9)
    added = found.covariance[:SHARED, :SHARED] - without.covariance[:SHARED, :SHARED]
    np.testing.assert_allclose(added, np.diag([0.01, 0.0, 0.0]), atol=1e-9)
    assert found.systematic("young_pa") == pytest.approx(0.1)
    assert found.effect_estimates == ()


def test_an_effect_that_the_data_determine_corrects_the_value_and_adds_nothing(rng):
    by_parameters = slopes(rng, 4)
    noise = rng.normal(size=len(by_parameters))
    column = 1e3 * slopes(rng, 1)
    found = posterior(linear_fit(by_parameters, noise - 2 * column[:, 0]), column, "mass")
    # As a parameter without a prior.
    rows = np.hstack([by_parameters, column])
    bare = np.linalg.inv(rows.T @ rows + np.diag([0.0, 0.0, 0.0, 1.0, 0.0]))
    np.testing.assert_allclose(found.covariance, bare, rtol=1e-4, atol=1e-9)
    right = posterior(linear_fit(by_parameters, noise), column, "mass")
    np.testing.assert_allclose(found.q, right.q, atol=1e-5)
    assert found.systematic("young_pa") < 1e-3
    own = of_effect(found, "mass")
    assert own.value / own.deviation == pytest.approx(2.0, abs=1e-3)
    assert own.surprise == pytest.approx(2.0, abs=1e-3)


def test_a_surprise_is_relative_to_what_is_typical_of_right_descriptions(rng):
    """An initial slope has a wide prior, but is 0 ± 0.1 in right descriptions."""
    by_parameters, columns = slopes(rng, 4), 0.5 * slopes(rng, 3)
    residual = rng.normal(size=len(columns))
    names = ("initial_slope excess", "mass", "initial_slope shape")
    found = posterior(linear_fit(by_parameters, residual), columns, *names)
    rows = np.hstack([by_parameters, columns])
    mean, covariance = by_bayes(by_parameters, residual, columns, np.zeros(3))
    estimator = covariance @ rows.T
    of_truth = estimator @ rows @ np.diag([0, 0, 0, 1, 0.1 / 0.85, 1, 1])
    variances = np.sum(estimator**2, axis=1) + np.sum(of_truth**2, axis=1)
    for k, name in enumerate(names, start=4):
        own = of_effect(found, name)
        assert own.surprise == pytest.approx(mean[k] / np.sqrt(variances[k])), name
    assert of_effect(found, names[0]).deviation == pytest.approx(0.1)


def test_static_tests_correct_only_what_may_be_larger_than_is_typical(rng):
    columns = slopes(rng, 3)
    fit = linear_fit(slopes(rng, 4), rng.normal(size=len(columns)))
    own = effects(columns, "mass", "initial_slope excess", "initial_slope shape")
    found = Posterior.from_fit(fit, own, PARAMETERS, Q, GIVEN, is_learnt=False)
    assert found.effects.names == ("initial_slope excess", "initial_slope shape")
    assert found.considered.names == ("mass",)


def test_effects_that_look_alike_name_each_other(rng):
    by_parameters, columns = slopes(rng, 4), slopes(rng, 3)
    columns[:, 1] = -2 * columns[:, 0] + by_parameters @ [3.0, 0.0, 1.0, 0.0]
    fit = linear_fit(by_parameters, rng.normal(size=len(columns)))
    found = posterior(fit, columns, "mass", "body_scale", "air_drag")
    assert of_effect(found, "mass").alike == ("body_scale",)
    assert of_effect(found, "body_scale").alike == ("mass",)
    assert of_effect(found, "air_drag").alike == ()


@pytest.mark.parametrize("laws", [LAWS[:1], LAWS])
def test_a_constant_is_that_of_the_stated_damping_law(rng, laws):
    """Another law, one or two of them, and an effect that changes no definition."""
    by_parameters, columns = slopes(rng, 4), slopes(rng, 1 + len(laws))
    fit = linear_fit(by_parameters, 3 * rng.normal(size=len(columns)))
    stated = posterior(fit, columns[:, :1], "mass")
    found = posterior(fit, columns, "mass", *laws)
    np.testing.assert_allclose(found.q[1:], stated.q[1:], atol=1e-9)
    for name in ("gamma_r_s", "gamma_m_1_s"):
        line = found.budget[name]
        assert line.shares.get("damping_law", 0.0) < 1e-12
        assert line.combined95 == pytest.approx(stated.budget[name].combined95)
    assert found.budget["young_pa"].shares["damping_law"] > 0


@pytest.mark.parametrize(("cosine", "are_alike"), [(0.95, True), (0.85, False), (-0.95, True)])
def test_effects_are_alike_if_the_data_hardly_tell_them_apart(cosine, are_alike, rng):
    """By the angle of what remains of their columns beside all parameters."""
    by_parameters = slopes(rng, 4)
    orthogonal = np.linalg.qr(np.hstack([by_parameters, rng.normal(size=(len(by_parameters), 2))]))[
        0
    ]
    first, second = orthogonal[:, -2:].T
    other = cosine * first + np.sqrt(1 - cosine**2) * second
    columns = 50 * np.column_stack([first, other]) + by_parameters[:, :1]
    residual = rng.normal(size=len(columns))
    found = posterior(linear_fit(by_parameters, residual), columns, "mass", "body_scale")
    assert of_effect(found, "mass").alike == (("body_scale",) if are_alike else ())
