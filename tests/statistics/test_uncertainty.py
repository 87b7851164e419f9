"""Statistical intervals: covariances, correlated errors and parameters at bounds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from kit.problems import (
    EXPERIMENTS_AND_SCHEMES,
    GUESS,
    SMALL_EXPERIMENTS,
    TRUTH,
    cube_with_gaps,
    hung_cube,
    measured,
    released_cube,
)
from scipy.stats import chi2

from collocation_sysid.errors import InputError
from collocation_sysid.fem.laws.moduli import engineering_constants
from collocation_sysid.fem.schemes import SCHEMES
from collocation_sysid.methods.loss_curvature import sensitivities
from collocation_sysid.model.parameters import Parameter, Parameters
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.program.forward.scheme_simulation import simulate_scheme
from collocation_sysid.program.simulation import with_markers
from collocation_sysid.program.transcription import Transcription
from collocation_sysid.recording import Experiment, Grasp, PoseSequence
from collocation_sysid.statistics.estimates import IntervalCoordinate
from collocation_sysid.statistics.linearised import linearise_fit, observable_responses
from collocation_sysid.statistics.pose_noise import uncertainty_at
from collocation_sysid.statistics.uncertainty import ErrorModel, uncertainty_from_fit

AT_TRUTH = GUESS.with_guess(TRUTH)
NAMES = tuple(TRUTH)


def positions(collocation: Collocation, q):
    return [
        simulate_scheme(s.experiment, s.dynamics.with_theta(s.constants.theta(q)))
        for s in collocation.transcriptions
    ]


def simulated(experiments, parameters=AT_TRUTH, **options) -> tuple[Collocation, np.ndarray]:
    """A problem, and variables that satisfy its equations of motion at the guess."""
    collocation = Collocation(experiments, parameters, **options)
    x = positions(collocation, parameters.guess_q)
    return collocation, collocation.pack(collocation.guess_p, x)


def with_sigma(experiment: Experiment, sigma_m: float) -> Experiment:
    sigma = np.full(len(experiment.markers.names), sigma_m)
    return replace(experiment, markers=replace(experiment.markers, sigma_m=sigma))


def noisy(experiment: Experiment, sigma_m: float, seed: int) -> Experiment:
    rng = np.random.default_rng(seed)
    tracks = experiment.markers.positions_m
    return with_sigma(
        with_markers(experiment, tracks + sigma_m * rng.normal(size=tracks.shape)), sigma_m
    )


def changed(parameters: Parameters, **changes: dict) -> Parameters:
    return Parameters(
        tuple(replace(item, **changes.get(item.name, {})) for item in parameters.items)
    )


def in_engineering_moduli() -> Parameters:
    """The truth by (E, ν)."""
    young_pa, poisson = engineering_constants(TRUTH["lambda_pa"], TRUTH["mu_pa"])
    elastic = (
        Parameter("young_pa", young_pa, 1e-6, 1e6),
        Parameter("poisson", poisson, 1e-6, 0.49),
    )
    return Parameters((*elastic, *AT_TRUTH.items[2:]))


# Sensitivities


@pytest.mark.parametrize(("name", "scheme"), EXPERIMENTS_AND_SCHEMES)
def test_sensitivities_keep_the_linearised_constraints(name, scheme):
    collocation, z = simulated([SMALL_EXPERIMENTS[name]()], scheme=scheme)
    assert_constraints_are_kept(collocation, z)


@pytest.mark.parametrize("options", [{"has_grasp_constraints": True}, {"substeps": 3}])
def test_sensitivities_fit_every_layout_and_several_experiments(options):
    collocation, z = simulated([hung_cube(4), released_cube(5)], **options)
    assert_constraints_are_kept(collocation, z)


def assert_constraints_are_kept(collocation, z):
    found = sensitivities(collocation, z)
    moving = [
        transcription.parameter_indices[transcription.dynamic_parameters]
        for transcription in collocation.transcriptions
    ]
    assert [b.shape for b in found] == [
        (s.grid_times, s.dof_count, len(m))
        for s, m in zip(collocation.transcriptions, moving, strict=True)
    ]
    jacobian = collocation.jacobian(z)
    for k in sorted(set(np.concatenate(moving))):
        p = np.eye(collocation.nq + collocation.nphi)[k]
        by_p = [
            b[..., list(m).index(k)] if k in m else 0 * b[..., 0]
            for b, m in zip(found, moving, strict=True)
        ]
        direct = jacobian @ collocation.pack(p, [0 * b for b in by_p])
        change = jacobian @ collocation.pack(p, by_p)
        assert np.abs(change).max() <= 1e-9 * np.abs(direct).max()


@pytest.mark.parametrize("scheme", SCHEMES)
def test_sensitivities_agree_with_simulations_at_other_parameters(scheme):
    collocation, z = simulated([hung_cube(6)], scheme=scheme)
    (by_q,) = sensitivities(collocation, z)
    step = 1e-4
    for k, direction in enumerate(step * np.eye(4)):
        q = AT_TRUTH.guess_q
        (ahead,), (behind,) = (positions(collocation, q + s * direction) for s in (1, -1))
        difference = (ahead - behind) / (2 * step)
        np.testing.assert_allclose(
            by_q[..., k], difference, rtol=0, atol=1e-5 * np.abs(difference).max()
        )


def test_given_motion_does_not_depend_on_the_parameters():
    collocation, z = simulated([released_cube(4)])
    (by_q,) = sensitivities(collocation, z)
    assert not by_q[0].any()
    assert not by_q[:, collocation.transcriptions[0].prescribed_dofs].any()
    assert by_q[1:].any(axis=(1, 2)).all()


def test_sensitivities_of_markers_are_those_of_the_nodes_at_the_samples():
    collocation, z = simulated([cube_with_gaps(4), released_cube(3)], substeps=2)
    nodes, markers = (sensitivities(collocation, z), observable_responses(collocation, z))
    for transcription, of_nodes, response in zip(
        collocation.transcriptions, nodes, markers, strict=True
    ):
        of_markers = response.observed_changes[0]
        observe = transcription.experiment.markers.predict_positions
        for k in range(collocation.nq):
            expected = observe(of_nodes[::2, :, k].reshape(-1, transcription.dof_count // 3, 3))
            np.testing.assert_allclose(
                of_markers[..., k], expected.reshape(len(expected), -1), atol=1e-15
            )


# Covariance


def residuals(transcription: Transcription, x: np.ndarray) -> np.ndarray:
    """Of its markers (T, M, 3), without nuisance parameters."""
    phi = np.zeros(0)
    return transcription.markers.residuals(
        transcription.markers.observable.evaluate_positions(x, phi), phi
    )


def test_covariance_is_that_of_the_weighted_least_squares_problem():
    experiments = [with_sigma(cube_with_gaps(5), 2e-3), hung_cube(4)]
    collocation, z = simulated(experiments)
    step, columns = 1e-4, []
    for direction in step * np.eye(4):
        ahead, behind = (
            np.concatenate(
                [
                    residuals(transcription, x).ravel()
                    for transcription, x in zip(
                        collocation.transcriptions,
                        positions(collocation, AT_TRUTH.guess_q + sign * direction),
                        strict=True,
                    )
                ]
            )
            for sign in (1, -1)
        )
        columns.append((ahead - behind) / (2 * step))
    matrix = np.stack(columns, axis=1)
    expected = np.linalg.inv(matrix.T @ matrix)
    found = uncertainty_at(collocation, z, ErrorModel("given", "independent")).covariance
    deviations = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(found / np.outer(deviations, deviations),
                               expected / np.outer(deviations, deviations), atol=1e-4)  # fmt: skip


@pytest.mark.long
def test_normalised_errors_of_noisy_twins_follow_their_distribution():
    sigma_m, twins = 1e-5, 20
    experiment = measured(hung_cube(8, divisions=(1, 1, 2)))
    squares, chi_squared = [], []
    for seed in range(twins):
        collocation = Collocation([noisy(experiment, sigma_m, seed)], AT_TRUTH)
        q = fitted(collocation, AT_TRUTH.guess_q)
        uncertainty = uncertainty_at(collocation, collocation.pack(q, positions(collocation, q)))
        error = q - AT_TRUTH.guess_q
        squares.append(error @ np.linalg.solve(uncertainty.covariance, error))
        chi_squared.append(uncertainty.reduced_chi_squared)
    low, high = chi2.ppf([0.001, 0.999], 4 * twins) / (4 * twins)
    assert low < np.mean(squares) / 4 < high
    freedom = twins * uncertainty.degrees_of_freedom
    low, high = chi2.ppf([0.001, 0.999], freedom) / freedom
    assert low < np.mean(chi_squared) < high


def fitted(collocation: Collocation, q, steps=2):
    """Gauss–Newton on the simulation."""
    (transcription,) = collocation.transcriptions
    weight = 1 / transcription.experiment.markers.sigma_m[0]
    for _ in range(steps):
        (x,) = positions(collocation, q)
        (response,) = observable_responses(collocation, collocation.pack(q, [x]))
        by_q = response.observed_changes[0]
        matrix = weight * by_q.reshape(-1, 4)
        q = q - np.linalg.lstsq(matrix, residuals(transcription, x).ravel())[0]
    return q


def test_error_bars_are_relative_in_the_logarithm():
    collocation, z = simulated([with_sigma(measured(hung_cube()), 1e-4)])
    uncertainty = uncertainty_at(collocation, z)
    assert uncertainty.names == NAMES
    for name, variance in zip(NAMES, np.diag(uncertainty.covariance), strict=True):
        estimate = uncertainty.estimates[name]
        assert estimate.value == pytest.approx(TRUTH[name])
        assert estimate.statistical_std_error == pytest.approx(TRUTH[name] * np.sqrt(variance))
        assert estimate.statistical95 is not None
        assert np.log(estimate.statistical95) - np.log(TRUTH[name]) == pytest.approx(
            1.96 * np.sqrt(variance) * np.array([-1, 1]), rel=1e-4
        )
    deviations = np.sqrt(np.diag(uncertainty.covariance))
    np.testing.assert_allclose(
        uncertainty.correlation * np.outer(deviations, deviations), uncertainty.covariance
    )
    np.testing.assert_allclose(np.diag(uncertainty.correlation), 1.0)
    assert uncertainty.errors == "independent"
    assert uncertainty.notes == ()


def test_noise_is_estimated_from_the_residuals():
    experiment = measured(hung_cube())
    for sigma_m in (1e-4, 1e-2):  # what is claimed; the noise has 1 mm
        collocation, z = simulated([with_sigma(noisy(experiment, 1e-3, seed=1), sigma_m)])
        truth, z_truth = simulated([with_sigma(experiment, 1e-3)])
        estimated = uncertainty_at(collocation, z, ErrorModel("estimated"))
        ratio = estimated.covariance / uncertainty_at(truth, z_truth).covariance
        np.testing.assert_allclose(ratio, ratio[0, 0])
        assert ratio[0, 0] == pytest.approx(1.0, abs=0.2)


def test_residuals_larger_than_sigma_are_pointed_out():
    experiment = with_sigma(noisy(measured(hung_cube()), 1e-4, seed=1), 1e-5)
    collocation, z = simulated([experiment])
    (note,) = uncertainty_at(collocation, z).notes
    assert "times as large as expected from sigma_m" in note
    assert uncertainty_at(collocation, z, ErrorModel("estimated")).notes == ()


def test_noise_needs_more_measurements_than_parameters():
    experiment = measured(hung_cube(3))
    tracks = np.full_like(experiment.markers.positions_m, np.nan)
    tracks[2, 0] = experiment.markers.positions_m[2, 0]
    collocation, z = simulated([with_markers(experiment, tracks)])
    with pytest.raises(
        InputError, match="from 3 measurements, which are not more than the parameters"
    ):
        uncertainty_at(collocation, z, ErrorModel("estimated"))


def test_unknown_noise_is_refused():
    collocation, z = simulated([hung_cube(3)])
    with pytest.raises(InputError, match="'given' or 'estimated'"):
        uncertainty_at(collocation, z, ErrorModel(noise="guessed"))  # type: ignore[arg-type]
    with pytest.raises(InputError, match="'independent' or 'autocorrelated'"):
        uncertainty_at(collocation, z, ErrorModel(errors="normal"))  # type: ignore[arg-type]


def test_a_prior_adds_its_information():
    prior = changed(AT_TRUTH, mu_pa={"prior": (300.0, 1e-3)})
    experiment = measured(hung_cube())
    without, with_prior = (
        uncertainty_at(
            *simulated([experiment], parameters), ErrorModel(errors="independent")
        ).covariance
        for parameters in (AT_TRUTH, prior)
    )
    difference = np.linalg.inv(with_prior) - np.linalg.inv(without)
    np.testing.assert_allclose(difference[1, 1], 1e6, rtol=1e-6)


# Bounds, and what the data do not say


def test_a_parameter_at_its_bound_has_no_error_bar_and_the_others_keep_theirs():
    experiment = measured(hung_cube())
    bound = changed(AT_TRUTH, lambda_pa={"upper": 200.0 * (1 + 1e-8)})
    uncertainty = uncertainty_at(*simulated([experiment], bound))
    expected = uncertainty_at(*simulated([experiment]))
    at_bound = uncertainty.estimates["lambda_pa"]
    assert at_bound.at_bound
    assert at_bound.statistical_std_error is None
    assert at_bound.statistical95 is None
    np.testing.assert_allclose(uncertainty.covariance[1:, 1:], expected.covariance[1:, 1:])
    assert np.isnan(uncertainty.covariance[0]).all()
    assert np.isnan(uncertainty.correlation[0]).all()
    assert not uncertainty.estimates["mu_pa"].at_bound
    assert uncertainty.degrees_of_freedom == expected.degrees_of_freedom
    assert uncertainty.derived["poisson"].at_bound
    assert uncertainty.derived["poisson"].statistical_std_error is None
    assert uncertainty.derived["poisson"].reason
    assert any("lambda_pa ended at its upper bound 200" in note for note in uncertainty.notes)


def test_fixed_parameters_have_no_error_bar():
    experiment = measured(hung_cube())
    fixed = changed(AT_TRUTH, gamma_m_1_s={"is_fixed": True})
    uncertainty = uncertainty_at(*simulated([experiment], fixed))
    assert uncertainty.names == NAMES[:3]
    assert uncertainty.estimates["gamma_m_1_s"].value == 1.0
    assert uncertainty.estimates["gamma_m_1_s"].statistical_std_error is None
    everything = changed(AT_TRUTH, **{name: {"is_fixed": True} for name in NAMES})
    known = uncertainty_at(*simulated([experiment], everything))
    assert known.derived["young_pa"].statistical_std_error is None
    assert known.derived["young_pa"].value == pytest.approx(720.0)


def test_damping_of_a_body_at_rest_is_reported_as_undetermined():
    moving = hung_cube(4)
    still = replace(moving, grasps=(Grasp(moving.grasps[0].nodes, PoseSequence.fixed()),))
    uncertainty = uncertainty_at(*simulated([measured(still)]))
    assert np.isinf(np.diag(uncertainty.covariance)).tolist() == [False, False, True, True]
    assert uncertainty.estimates["gamma_r_s"].statistical_std_error is None
    assert uncertainty.estimates["mu_pa"].statistical_std_error is not None
    assert uncertainty.derived["young_pa"].statistical_std_error is not None
    silent = [note for note in uncertainty.notes if "no information on damping" in note]
    assert [note.split()[0] for note in silent] == ["gamma_r_s", "gamma_m_1_s"]


# The other convention


def linear_uncertainty(collocation, z):
    """Return the uncertainty of the linearised fit, which z need not minimise."""
    fit = linearise_fit(collocation, z)
    return uncertainty_from_fit(fit, collocation.parameters, z[: collocation.nq])


def test_derived_error_bars_are_those_of_a_fit_in_the_other_convention():
    experiment = measured(hung_cube())
    lame = linear_uncertainty(*simulated([experiment]))
    young = linear_uncertainty(*simulated([experiment], in_engineering_moduli()))
    for derived, direct in ((lame, young), (young, lame)):
        for name, estimate in derived.derived.items():
            assert estimate.value == pytest.approx(direct.estimates[name].value)
            assert estimate.statistical_std_error == pytest.approx(
                direct.estimates[name].statistical_std_error, rel=1e-6
            )
    assert lame.derived["young_pa"].statistical95 == pytest.approx(
        young.estimates["young_pa"].statistical95
    )
    assert young.derived["mu_pa"].statistical95 == pytest.approx(
        lame.estimates["mu_pa"].statistical95
    )


def test_the_interval_of_poisson_stays_physical():
    collocation, z = simulated([with_sigma(measured(hung_cube()), 0.03)])
    low, high = uncertainty_at(collocation, z).derived["poisson"].statistical95 or (0.0, 0.0)
    assert 0 < low < 0.2 < high < 0.5


def test_an_interval_too_wide_to_be_of_use_has_no_standard_error():
    collocation, z = simulated([measured(hung_cube())])  # sigma of 1 mm: too much for γ_m
    uncertainty = uncertainty_at(collocation, z)
    estimate = uncertainty.estimates["gamma_m_1_s"]
    assert estimate.statistical_std_error is None
    assert estimate.statistical95 is not None
    assert estimate.statistical95[1] > 10 * estimate.statistical95[0]
    assert "factor of 10" in (estimate.reason or "")
    assert any(n.startswith("gamma_m_1_s is not identifiable") for n in uncertainty.notes)
    assert uncertainty.estimates["mu_pa"].statistical_std_error is not None


def test_the_ends_of_the_domain_of_poissons_ratio_have_infinite_coordinates():
    at = IntervalCoordinate.for_estimate("poisson", (0.3, 0.5), linear=False)
    assert at.from_value(0.5) == np.inf
    assert at.from_value(0.0) == -np.inf
    assert at.to_value(at.from_value(0.3)) == pytest.approx(0.3)


def test_a_ratio_of_one_half_is_its_own_coordinate():
    at = IntervalCoordinate.for_estimate("poisson", (0.5, 0.5, 0.5), linear=False)
    assert at.from_value(0.5) == 0.5
    assert at.derivative(0.5) == 1.0
    assert at.to_value(0.5) == 0.5
