from __future__ import annotations

import numpy as np
import pytest
from checks import assert_derivative
from problems_small import as_theta

from collocation_sysid.errors import InputError
from collocation_sysid.nlp.parameters import Parameter, Parameters

DAMPING = (Parameter("gamma_r_s", 0.02, 1e-5, 1.0), Parameter("gamma_m_1_s", 0.5, 1e-3, 100.0))
LAME = Parameters(
    (Parameter("lambda_pa", 400.0, 10.0, 1e5), Parameter("mu_pa", 150.0, 10.0, 1e5), *DAMPING)
)
ENGINEERING = Parameters(
    (Parameter("young_pa", 700.0, 10.0, 1e5), Parameter("poisson", 0.2, 0.01, 0.49), *DAMPING)
)
MIXED = Parameters(
    (
        Parameter("young_pa", 700.0, 10.0, 1e5),
        Parameter("poisson", 0.2, fixed=True),
        DAMPING[0],
        Parameter("gamma_m_1_s", 0.0, fixed=True),
    )
)
ALL_FIXED = Parameters(tuple(Parameter(item.name, item.guess, fixed=True) for item in LAME.items))
SETS = {"lame": LAME, "engineering": ENGINEERING, "mixed": MIXED}


# From solver coordinates to physics


def test_lame_parameters_are_the_exponentials_of_q():
    np.testing.assert_allclose(LAME.theta(np.log([1, 2, 3, 4])), [1, 2, 3, 4])


def test_engineering_parameters_become_lame_parameters():
    theta = ENGINEERING.theta(np.log([1000.0, 0.25, 0.01, 2.0]))
    np.testing.assert_allclose(theta, [400.0, 400.0, 0.01, 2.0])
    assert theta.young_pa == pytest.approx(1000.0)
    assert theta.poisson == pytest.approx(0.25)


def test_fixed_parameters_are_not_among_the_unknowns():
    assert [item.name for item in MIXED.free] == ["young_pa", "gamma_r_s"]
    theta = MIXED.theta(np.log([1200.0, 0.03]))
    np.testing.assert_allclose(theta, [1000 / 3, 500.0, 0.03, 0.0])


def test_with_everything_fixed_theta_is_the_guess():
    assert ALL_FIXED.guess_q.shape == (0,)
    np.testing.assert_allclose(ALL_FIXED.theta([]), [400.0, 150.0, 0.02, 0.5])
    first, second = ALL_FIXED.theta_derivatives(np.zeros(0))
    assert first.shape == (4, 0)
    assert second.shape == (4, 0, 0)


@pytest.mark.parametrize("parameters", SETS.values(), ids=SETS)
def test_derivatives_of_theta(parameters: Parameters, rng):
    def first(q):
        return parameters.theta_derivatives(q)[0]

    def theta(q):
        return np.array(parameters.theta(q))

    q = parameters.guess_q
    assert_derivative(theta, lambda d: first(q) @ d, q, rng)
    assert_derivative(first, lambda d: parameters.theta_derivatives(q)[1] @ d, q, rng)


def test_values_have_the_users_names():
    values = MIXED.values(np.log([900.0, 0.03]))
    expected = {"young_pa": 900.0, "poisson": 0.2, "gamma_r_s": 0.03, "gamma_m_1_s": 0.0}
    assert values == pytest.approx(expected)


def test_bounds_and_guesses_are_logarithms():
    lower, upper = LAME.bounds_q
    np.testing.assert_allclose(np.exp(lower), [10, 10, 1e-5, 1e-3])
    np.testing.assert_allclose(np.exp(upper), [1e5, 1e5, 1, 100])
    np.testing.assert_allclose(np.exp(LAME.guess_q), [400, 150, 0.02, 0.5])


def test_a_prior_pulls_on_the_logarithm():
    drawn = Parameter("mu_pa", 150.0, 10.0, 1e5, prior=(300.0, 0.1))
    parameters = Parameters((LAME.items[0], drawn, *DAMPING))
    residuals, slopes = parameters.prior(np.log([400.0, 330.0, 0.02, 0.5]))
    np.testing.assert_allclose(residuals, [0, np.log(1.1) / 0.1, 0, 0])
    np.testing.assert_allclose(slopes, [0, 10, 0, 0])


# Ways to give theta


def test_theta_from_guesses_a_mapping_or_four_numbers():
    expected = np.array([400.0, 400.0, 0.01, 2.0])
    by_name = {"gamma_m_1_s": 2.0, "gamma_r_s": 0.01, "young_pa": 1000.0, "poisson": 0.25}
    assert as_theta(by_name) == pytest.approx(expected)
    assert as_theta([400, 400, 0.01, 2]) == expected
    assert as_theta(np.array(expected)) == expected
    assert as_theta(expected) == expected
    assert as_theta(LAME) == pytest.approx((400.0, 150.0, 0.02, 0.5))


def test_theta_from_a_mapping_names_what_is_missing():
    with pytest.raises(InputError, match="lack poisson, gamma_m_1_s"):
        as_theta({"young_pa": 1000.0, "gamma_r_s": 0.01})


def test_theta_takes_four_numbers():
    with pytest.raises(InputError, match="3 parameters given, expected four: lambda_pa"):
        as_theta([400.0, 400.0, 0.01])


def test_with_guess_changes_only_what_it_names():
    other = MIXED.with_guess({"poisson": 0.3, "young_pa": 800.0})
    assert other.values(other.guess_q) == pytest.approx(
        {"young_pa": 800.0, "poisson": 0.3, "gamma_r_s": 0.02, "gamma_m_1_s": 0.0}
    )
    assert [item.fixed for item in other.items] == [item.fixed for item in MIXED.items]


def test_with_guess_refuses_unknown_names_and_values_out_of_bounds():
    with pytest.raises(InputError, match="no parameter 'lambda_pa'; there are young_pa"):
        MIXED.with_guess({"lambda_pa": 3.0})
    with pytest.raises(InputError, match=r"young_pa: guess = 1, expected .* \[10, 100000\]"):
        MIXED.with_guess({"young_pa": 1.0})


# Refusals


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"guess": 5.0}, r"mu_pa: guess = 5, expected a value within \[10, 1000\]"),
        ({"guess": np.nan}, "mu_pa: guess = nan"),
        ({"lower": 0.0}, "mu_pa: lower = 0, upper = 1000, expected 0 < lower < upper"),
        ({"lower": 1000.0, "guess": 1000.0}, "expected 0 < lower < upper"),
        ({"prior": (300.0, 0.0)}, "mu_pa: prior = .*, expected positive mean and deviation"),
        ({"fixed": True, "guess": -1.0}, "mu_pa: fixed = -1, expected a number >= 0"),
        ({"fixed": True, "guess": np.inf}, "mu_pa: fixed = inf"),
    ],
)
def test_unusable_parameters_are_refused_by_name(changes: dict, message: str):
    fields = {"guess": 100.0, "lower": 10.0, "upper": 1000.0, **changes}
    with pytest.raises(InputError, match=message):
        Parameter("mu_pa", **fields)


@pytest.mark.parametrize(
    ("poisson", "message"),
    [
        (Parameter("poisson", 0.3, 0.01, 0.5), "poisson: upper = 0.5, expected less than 0.5"),
        (Parameter("poisson", 0.3, 0.01), "poisson: upper = inf, expected less than 0.5"),
        (Parameter("poisson", 0.5, fixed=True), "poisson: fixed = 0.5, expected less than 0.5"),
    ],
)
def test_incompressible_bodies_are_refused(poisson: Parameter, message: str):
    with pytest.raises(InputError, match=message):
        Parameters((ENGINEERING.items[0], poisson, *DAMPING))


@pytest.mark.parametrize(
    "items",
    [(), LAME.items[:3], (LAME.items[0], ENGINEERING.items[1], *DAMPING), LAME.items[::-1]],
    ids=["none", "missing", "mixed pairs", "another order"],
)
def test_other_sets_of_parameters_are_refused(items: tuple[Parameter, ...]):
    with pytest.raises(InputError, match="expected lambda_pa, mu_pa, gamma_r_s, gamma_m_1_s, or"):
        Parameters(items)
