"""Directions in parameter space that the data do not determine."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from kit.problems import box

from collocation_sysid.fem.laws.moduli import ENGINEERING, LAME
from collocation_sysid.model.parameters import Parameter, Parameters, ThetaMap
from collocation_sysid.statistics.combinations import find_combinations, identifiability_sentences
from collocation_sysid.statistics.estimates import UNDETERMINED
from collocation_sysid.statistics.linearised import DerivedModuli, LinearisedFit, ResidualBlock
from collocation_sysid.statistics.uncertainty import Uncertainty, uncertainty_from_fit

DAMPING = ("gamma_r_s", "gamma_m_1_s")
VALUES = {"lambda_pa": 2000.0, "mu_pa": 300.0, "young_pa": 800.0, "poisson": 0.4}
VALUES |= {"gamma_r_s": 0.01, "gamma_m_1_s": 1.0}
Z95 = 1.96


def parameters(elastic: tuple[str, str] = LAME, **changes) -> Parameters:
    items = [
        Parameter(name, VALUES[name], VALUES[name] / 1e4, 0.499 if name == "poisson" else 1e7)
        for name in elastic + DAMPING
    ]
    return Parameters(tuple(replace(item, **changes.get(item.name, {})) for item in items))


def uncertainty(covariance: np.ndarray, of: Parameters | None = None) -> Uncertainty:
    """As of a fit with this covariance of q, whose residuals are exactly zero."""
    values, vectors = np.linalg.eigh(covariance)
    return uncertainty_from_slope((vectors / np.sqrt(values)).T, of)


def uncertainty_from_slope(rows: np.ndarray, of: Parameters | None = None) -> Uncertainty:
    """As of a fit with these derivatives (n, k) of its residuals, which are exactly zero."""
    of = of or parameters()
    k = rows.shape[1]
    slope = np.zeros((4, 1, 3, k))
    slope.reshape(-1, k)[: len(rows)] = rows
    seen, residual = np.ones((4, 1), dtype=bool), np.zeros((4, 1, 3))
    block = ResidualBlock("swing", 0.01 * np.arange(4), ("tip",), seen, residual, slope, np.ones(1))
    names = tuple(item.name for item in of.free)
    derived = DerivedModuli.from_bodies([ThetaMap(of, box())], of.guess_q)
    nothing, free = np.zeros(k), np.zeros(k, dtype=bool)
    fit = LinearisedFit((block,), names, k, nothing, nothing, free, derived)
    return uncertainty_from_fit(fit, of, of.guess_q)


def spread(deviations, correlations: dict[tuple[int, int], float] | None = None) -> np.ndarray:
    correlation = np.eye(len(deviations))
    for (i, j), value in (correlations or {}).items():
        correlation[i, j] = correlation[j, i] = value
    return correlation * np.outer(deviations, deviations)


def test_well_and_badly_determined_combinations_are_reported_with_intervals():
    (sentence,) = identifiability_sentences(uncertainty(spread([0.2, 0.01, 0.02, 0.05])))
    assert sentence == (
        "noise alone leaves mu_pa ±2 %, gamma_r_s ±4 % and gamma_m_1_s ±10 %; "
        "lambda_pa only ±48 % (95 %, statistical, no systematic effects)"
    )


@pytest.mark.parametrize(
    ("deviation", "said"), [(0.2, "±48 %"), (0.23, "within a factor of 1.6"), (0.4, "of 2.2")]
)
def test_wide_intervals_are_reported_by_their_factor(deviation, said):
    sentence, *_ = identifiability_sentences(uncertainty(spread([deviation, 0.01, 0.02, 0.05])))
    assert "lambda_pa only " in sentence
    assert f"{said} (95 %, statistical, no" in sentence


def test_an_unidentifiable_parameter_is_called_so_and_has_no_standard_error():
    found = uncertainty(spread([0.9, 0.01, 0.02, 0.05]))
    assert found.estimates["lambda_pa"].statistical_std_error is None
    low, high = found.estimates["lambda_pa"].statistical95 or (0, 0)
    assert np.log(high / low) == pytest.approx(2 * Z95 * 0.9, rel=1e-3)
    (sentence,) = [s for s in identifiability_sentences(found) if "not identifiable" in s]
    assert sentence in found.notes
    assert sentence.startswith("lambda_pa is not identifiable from these data: its 95 % interval")
    assert "fix it" in sentence


def test_a_parameter_without_information_is_not_determined():
    found = uncertainty(spread([0.1, 0.01, 0.02, 1e4]))
    assert found.estimates["gamma_m_1_s"].statistical95 is None
    said = identifiability_sentences(found)
    assert "gamma_m_1_s" not in said[0]
    silent = "gamma_m_1_s is not determined: no information on damping in these data"
    assert any(sentence.startswith(silent) for sentence in said)


def test_confounded_parameters_have_one_note():
    of = parameters(ENGINEERING)
    found = uncertainty(spread([0.15, 0.15, 0.02, 0.02], {(0, 1): -0.99}), of)
    assert (
        "young_pa only ±34 % and poisson only ±40 % (95 %, statistical, no systematic effects)"
        in identifiability_sentences(found)[0]
    )
    for name in ENGINEERING:
        assert found.estimates[name].statistical_std_error is None
        assert "confounded with" in (found.estimates[name].reason or "")
    unidentifiable = [note for note in found.notes if "not identifiable" in note]
    assert len(unidentifiable) == 1  # of both
    assert unidentifiable[0].startswith(
        "young_pa and poisson are not identifiable from these data: confounded with each other "
        "(correlation -0.990); fix one of them"
    )


def test_combinations_are_stated_after_single_parameters():
    found = uncertainty(spread([0.15, 0.15, 0.02, 0.02], {(0, 1): -0.99}))
    values = np.array([found.estimates[name].value for name in found.names])
    (each,) = find_combinations(found.names, values, found.complete_covariance, ("mu_pa",))
    sentences = identifiability_sentences(found, (each,))
    assert sentences[1] == each.statement()
    assert any("other elastic constants" in sentence for sentence in sentences[2:])


def test_parameters_known_very_well_keep_their_error_though_confounded():
    found = uncertainty(spread([0.01, 0.01, 0.02, 0.02], {(0, 1): 0.99}))
    assert found.estimates["mu_pa"].statistical_std_error is not None


def test_a_direction_without_information_has_a_finite_deviation():
    """Two measurements of the sum of two logarithms, with deviations 0.02."""
    slope = np.array([[1.0, 1.0, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1.0]]) / 0.02
    found = uncertainty_from_slope(slope)
    assert found.covariance[0, 0] == np.inf
    assert np.isnan(found.covariance[0, 1])
    determined = np.array([1.0, 1.0, 0, 0])
    open_way = np.array([1.0, -1.0, 0, 0]) / np.sqrt(2)
    complete = found.complete_covariance
    assert determined @ complete @ determined == pytest.approx(0.02**2, rel=1e-6)
    assert open_way @ complete @ open_way == pytest.approx(UNDETERMINED**2)
    np.testing.assert_allclose(complete[2:, 2:], 0.02**2 * np.eye(2), atol=1e-12)


def test_the_better_determined_elastic_pair_is_reported():
    found = uncertainty(spread([0.7, 0.02, 0.02, 0.02]))
    (sentence,) = [s for s in identifiability_sentences(found) if "other elastic constants" in s]
    assert "young_pa ±" in sentence
    assert "poisson" in sentence


def test_poisson_that_can_be_anything_is_not_identifiable():
    of = parameters(ENGINEERING, poisson={"guess": 0.25})
    found = uncertainty(spread([0.01, 1.2, 0.02, 0.02]), of)
    estimate = found.estimates["poisson"]
    assert estimate.statistical_std_error is None
    low, high = estimate.statistical95 or (0.0, 1.0)
    assert 0 < low < 0.05
    assert 0.45 < high < 0.5
    assert "(0, 0.5)" in (estimate.reason or "")


def test_an_interval_beyond_both_bounds_is_no_estimate():
    of = parameters(mu_pa={"lower": 270.0, "upper": 330.0})
    estimate = uncertainty(spread([0.1, 0.1, 0.02, 0.02]), of).estimates["mu_pa"]
    assert estimate.statistical_std_error is None
    assert "between its bounds" in (estimate.reason or "")


def test_no_sentence_is_printed_twice():
    found = uncertainty(spread([0.9, 0.9, 0.02, 1e4], {(0, 1): -0.99}))
    said = identifiability_sentences(found)
    assert len(set(said)) == len(said)
    assert len(set(found.notes)) == len(found.notes)
