"""Draws of the parameters of a run, and its predictions and residuals as labelled arrays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import collocation_sysid as cs

pytestmark = pytest.mark.long
COUNT = 1000
TRUTH = {"c10_pa": 1e5, "c01_pa": 8e4, "kappa_pa": 1e8}


@pytest.fixture(scope="module")
def run():
    """Mooney–Rivlin's law in tension, which determines C₁₀ + C₀₁ only."""
    strain = np.linspace(0.005, 0.1, 20)
    blank = cs.Specimen("uniaxial", strain, 0 * strain, 1.0)
    (stress_pa,) = cs.simulate(blank.experiment("mooney-rivlin"), TRUTH).custom_sensor_values
    sigma_pa = 2e-3 * np.abs(stress_pa).max()
    noise_pa = np.random.default_rng(0).normal(0, sigma_pa, 20)
    measured = replace(blank, stress_pa=stress_pa[:, 0] + noise_pa, sigma_pa=sigma_pa)
    unknown = {name: cs.Unknown(5e4) for name in ("c10_pa", "c01_pa")}
    problem = cs.Problem([measured.experiment("mooney-rivlin", "pull")], TRUTH | unknown)
    return cs.run(problem, seek_causes=False)


def test_draws_of_a_determined_sum_have_its_interval(run):
    samples = run.samples(COUNT)
    (found,) = run.combinations
    assert found.determined.form == "sum"
    best = found.determined.names, found.determined.powers
    terms = [p * samples[n] for n, p in zip(*best, strict=True)]
    half = 1.96 * np.log(sum(terms)).std()
    assert half == pytest.approx(np.log(found.determined.factor), rel=0.1)
    low, high = run.interval("young_pa")
    inside = samples["young_pa"].between(low, high).mean()
    assert 0.92 < inside < 0.98


def test_draws_of_a_ratio_have_its_spread(run):
    samples = run.samples(COUNT)
    covariance = run.covariance()
    ratio = np.log(samples["c10_pa"] / samples["c01_pa"]).std()
    weights = np.array([1.0, -1.0])
    assert ratio == pytest.approx(np.sqrt(weights @ covariance @ weights), rel=0.1)


def test_draws_are_admissible_repeatable_and_have_units(run):
    samples = run.samples(50, seed=3)
    assert samples.equals(run.samples(50, seed=3))
    assert not samples.equals(run.samples(50, seed=4))
    assert samples.attrs["units"]["c10_pa"] == "Pa"
    assert (samples["kappa_pa"] == 1e8).all()
    assert ((samples["poisson"] > 0) & (samples["poisson"] < 0.5)).all()
    for count, expected in ((0, "at least 1"), (10**12, "at most 1e\\+06")):
        with pytest.raises(cs.InputError, match=f"expected a number of {expected}"):
            run.samples(count)


def test_residuals_and_predictions_sum_to_the_measurements(run):
    (title,) = run.residuals()
    assert title == "pull: stress"
    residual, predicted = run.residuals()[title], run.predicted()[title]
    (gauge,) = run.problem.experiments[0].readings
    np.testing.assert_allclose((residual + predicted).values, gauge.values)
    assert predicted.attrs["units"] == "Pa"
    assert residual.attrs["sigma"] == pytest.approx([gauge.sigma])
    assert predicted.sel(time=0.0).sizes == {"quantity": 1}


@pytest.mark.slow
def test_draws_contain_the_truth_at_the_stated_rate():
    """E of 40 twins with their own noise, in the middle 80 % of the draws of their runs."""
    strain = np.linspace(0.01, 0.2, 15)
    truth = {"young_pa": 1e5, "poisson": 0.45}
    blank = cs.Specimen("uniaxial", strain, 0 * strain, 1.0, strain_zero=0.0, area_error=0.0)
    (exact_pa,) = cs.simulate(blank.experiment(), truth).custom_sensor_values
    inside = []
    for seed in range(40):
        noise_pa = np.random.default_rng(seed).normal(0, 500.0, len(strain))
        twin = replace(blank, stress_pa=exact_pa[:, 0] + noise_pa, sigma_pa=500.0)
        unknown = {"young_pa": cs.Unknown(2e5), "poisson": 0.45}
        exact = cs.UncertaintyOptions(assumptions=cs.Assumptions.exact())
        problem = cs.Problem([twin.experiment()], unknown, uncertainty=exact)
        draws = cs.run(problem, seek_causes=False).samples(2000, seed=seed)["young_pa"]
        low, high = draws.quantile([0.1, 0.9])
        inside.append(low < truth["young_pa"] < high)
    assert 26 <= sum(inside) <= 38  # 32 expected; 99 % of such counts if the draws are right
