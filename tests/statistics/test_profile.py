"""Profile-likelihood intervals."""

from __future__ import annotations

import numpy as np
import pytest

from collocation_sysid.errors import InputError, SimulationError
from collocation_sysid.statistics.profile_likelihood import THRESHOLD, compute_profile

BOUNDS = (1.0, 1e6)
BEST = 1000.0


class Solver:
    """A loss along the logarithm of a parameter, that counts how often it is asked."""

    def __init__(self, loss) -> None:
        self.loss, self.asked = loss, []

    def __call__(self, parameter: str, value: float) -> float:
        assert parameter == "mu_pa"
        self.asked.append(value)
        return self.loss(np.log(value / BEST))


def parabola(deviation: float):
    return lambda u: 50.0 + (u / deviation) ** 2


@pytest.mark.parametrize("expected", [0.001, 0.02, 0.1, 0.5])
def test_a_parabola_gives_the_interval_of_the_standard_error(expected):
    solver = Solver(parabola(0.1))
    found = compute_profile(solver, "mu_pa", (BEST, 50.0), BOUNDS, deviation=expected)
    reach = 0.1 * np.sqrt(THRESHOLD)
    np.testing.assert_allclose(np.log(np.array(found.interval) / BEST), [-reach, reach], rtol=0.02)
    assert len(solver.asked) < 26
    assert "between" in found.sentence


def test_a_good_guess_of_the_deviation_costs_few_solves():
    solver = Solver(parabola(0.1))
    compute_profile(solver, "mu_pa", (BEST, 50.0), BOUNDS, deviation=0.1)
    assert len(solver.asked) <= 6


def test_values_and_rises_are_those_asked_for_and_the_best():
    solver = Solver(parabola(0.1))
    found = compute_profile(solver, "mu_pa", (BEST, 50.0), BOUNDS)
    assert (np.diff(found.values) > 0).all()
    assert set(found.values) == {*solver.asked, BEST}
    losses = np.array([solver.loss(np.log(v / BEST)) for v in found.values])
    np.testing.assert_allclose(found.rises, losses - losses.min())


def test_a_skewed_loss_gives_a_skewed_interval():
    def loss(u):
        return np.expm1(5 * u) ** 2 + 7.0

    found = compute_profile(Solver(loss), "mu_pa", (BEST, 7.0), BOUNDS, deviation=0.2)
    lower, upper = found.interval
    assert lower is None  # e^(5u) falls to 0: the loss rises by one only
    assert upper is not None
    assert np.log(upper / BEST) == pytest.approx(np.log1p(np.sqrt(THRESHOLD)) / 5, rel=0.03)
    assert "at most" in found.sentence
    assert "the data give no lower limit" in found.sentence


def test_a_flat_loss_is_called_not_identifiable():
    found = compute_profile(Solver(lambda u: 5.0), "mu_pa", (BEST, 5.0), BOUNDS)
    assert found.interval == (None, None)
    assert "not identifiable" in found.sentence
    assert (found.values.min(), found.values.max()) == pytest.approx(BOUNDS)


def test_noise_scales_the_threshold():
    found = compute_profile(
        Solver(parabola(0.1)), "mu_pa", (BEST, 50.0), BOUNDS, 0.1, noise_scale=9.0
    )
    assert found.threshold == pytest.approx(9 * THRESHOLD)
    assert np.log((found.interval[1] or 0) / BEST) == pytest.approx(0.3 * 1.96, rel=0.02)


def test_the_search_stays_within_the_bounds():
    solver = Solver(parabola(0.1))
    found = compute_profile(solver, "mu_pa", (BEST, 50.0), (BEST / 1.05, 1e6), deviation=0.1)
    assert min(solver.asked) >= BEST / 1.05 * (1 - 1e-12)
    assert found.interval[0] is None
    assert "at most" in found.sentence


def test_an_answer_at_its_bound_has_an_interval_on_the_other_side():
    found = compute_profile(Solver(parabola(0.1)), "mu_pa", (BEST, 50.0), (BEST, 1e6))
    assert found.interval[0] is None
    assert found.interval[1] == pytest.approx(BEST * np.exp(0.196), rel=0.01)


def test_values_without_a_solution_end_the_interval():
    def loss(u):
        if u > 0.15:
            raise SimulationError("the body turns inside out", 0.1)
        return parabola(0.1)(u)

    found = compute_profile(Solver(loss), "mu_pa", (BEST, 50.0), BOUNDS, deviation=0.1)
    assert np.log((found.interval[1] or 0) / BEST) == pytest.approx(0.15, rel=0.03)
    assert np.isinf(found.rises[-1])


def test_a_better_answer_on_the_way_is_pointed_out():
    found = compute_profile(
        Solver(lambda u: ((u - 0.1) / 0.1) ** 2), "mu_pa", (BEST, 1.0), BOUNDS, deviation=0.05
    )
    assert "lower than at the estimate" in found.sentence


def test_a_best_value_out_of_bounds_is_refused():
    with pytest.raises(InputError, match="not within its bounds"):
        compute_profile(Solver(parabola(0.1)), "mu_pa", (0.5, 50.0), BOUNDS)


@pytest.mark.parametrize("bounds", [(0.0, 1e4), (-1.0, 1e4), (2 * BEST, 1e4), (1.0, BEST / 2)])
def test_bounds_that_are_not_positive_or_without_the_best_value_are_refused(bounds):
    with pytest.raises(InputError, match="is not within its bounds"):
        compute_profile(Solver(parabola(0.1)), "mu_pa", (BEST, 50.0), bounds)


def test_a_linear_parameter_may_be_negative():
    asked = []

    def loss(name, value):
        asked.append(value)
        return 50.0 + ((value + 2.0) / 0.5) ** 2

    found = compute_profile(loss, "growth", (-2.0, 50.0), (-10.0, 10.0), 0.4, scale="linear")
    reach = 0.5 * np.sqrt(THRESHOLD)
    np.testing.assert_allclose(found.interval, [-2.0 - reach, -2.0 + reach], rtol=0.02)
    assert len(asked) < 20
