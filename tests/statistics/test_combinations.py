"""Combinations of constants that are determined where a constant alone is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import collocation_sysid as cs
from collocation_sysid.common.array_types import Array
from collocation_sysid.methods.starts.initial_trajectories import initial_variables
from collocation_sysid.result.pictures.confidence import combinations_picture
from collocation_sysid.runs.expected_precision import (
    added_measurements,
    expected_precision,
    with_measurements,
)
from collocation_sysid.statistics.combinations import (
    Direction,
    find_combinations,
    precision_text,
    principal_directions,
    undetermined_names,
)
from collocation_sysid.statistics.estimates import UNDETERMINED

Z95 = 1.96
MODULI = ("lambda_pa", "mu_pa")


def pair(determined: Array, deviation: float, open_deviation: float) -> Array:
    """Covariance of two logarithms: the combination with these weights, over its largest one, has
    one deviation, and the one across it, over its largest weight, another.
    """
    across = np.array([-determined[1], determined[0]])
    parts = ((determined, deviation), (across, open_deviation))
    unit = [(w / np.abs(w).max(), s) for w, s in parts]
    return np.sum([s**2 * np.outer(w, w) / (w @ w) ** 2 for w, s in unit], axis=0)


def combinations(covariance: Array, names=MODULI, values=(1.0, 1.0), **known):
    vague = undetermined_names(names, covariance)
    return find_combinations(names, np.array(values), covariance, vague, **known)


def test_a_sum_of_moduli_is_determined_to_a_percent_and_their_ratio_to_a_factor():
    """Measurements of λ + 0.9 μ, whose logarithm changes by (1, 0.9) / 1.9 per logarithm."""
    weights = np.array([1.0, 0.9])
    deviation = 1.9 * np.log(1.01) / Z95  # of the product, which has the largest weight 1
    covariance = pair(weights, deviation, np.log(4.0) / Z95)
    (found,) = combinations(covariance)
    assert found.sentence() == (
        "the data determine λ + 0.9 μ to ±1 %, and μ / λ^0.9 only to within a factor of 4"
    )
    assert found.determined.form == "sum"
    assert found.determined.factor == pytest.approx(1.01, abs=1e-4)


def test_the_factors_of_a_sum_follow_from_the_values():
    """d ln(λ + 0.5 μ) = (λ d ln λ + 0.5 μ d ln μ) / (λ + 0.5 μ)."""
    values = (2000.0, 300.0)
    weights = np.array([2000.0, 150.0]) / 2150.0
    (found,) = combinations(pair(weights, 1e-3, 1.0), values=values)
    assert found.determined.names == MODULI
    assert found.determined.powers == pytest.approx((1.0, 0.5), rel=1e-3)
    assert np.log(found.determined.factor) == pytest.approx(
        Z95 * 1e-3 * np.abs(weights).max(), rel=1e-2
    )


def test_constants_of_different_units_form_a_product():
    covariance = pair(np.array([1.0, -0.22]), 5e-4, 1.0)
    (found,) = combinations(covariance, ("young_pa", "density_kg_m3"), (3e4, 40.0))
    assert found.determined.formula() == "E / ρ^0.22"
    assert found.loosest.formula() == "ρ · E^0.22"
    assert found.determined.powers == pytest.approx((1.0, -0.22), rel=1e-3)


def test_combinations_with_constants_that_are_no_moduli_are_not_stated():
    covariance = pair(np.array([1.0, 0.51]), 5e-4, 1.0)
    assert not combinations(covariance, ("gamma_r_s", "gamma_m_1_s"))
    assert not combinations(covariance, ("young_pa", "poisson"))


def test_a_ratio_of_moduli_is_not_called_by_the_name_of_a_poisson_ratio():
    covariance = pair(np.array([1.0, -0.9]), 1e-2, 1.0)
    (found,) = combinations(covariance, moduli={"poisson": np.array([1.0, -0.9])})
    assert found.modulus is None


def test_a_direction_without_information_is_not_determined_at_all():
    (found,) = combinations(pair(np.array([1.0, 1.0]), 1e-3, UNDETERMINED))
    assert found.sentence().endswith("and λ / μ not at all") or found.sentence().endswith(
        "and μ / λ not at all"
    )


def test_constants_that_are_determined_alone_need_no_combination():
    assert combinations(pair(np.array([1.0, 0.9]), 1e-4, 0.1)) == ()


def test_a_constant_that_is_confounded_with_none_is_in_no_combination():
    assert combinations(np.diag([1e-4, 4.0])) == ()


def test_three_constants_can_be_confounded_without_any_two_being_so():
    basis = np.array([[1.0, 0, 0], [0, 1.0, 0], [1, 1, 0.1]])
    names = (*MODULI, "kappa_pa")
    (found,) = combinations(0.5**2 * basis @ basis.T, names, (1.0, 1.0, 1.0))
    assert set(found.determined.names) == set(names)
    powers = dict(zip(found.determined.names, found.determined.powers, strict=True))
    assert powers["kappa_pa"] / powers["mu_pa"] == pytest.approx(-1.0, abs=0.01)


def test_a_third_with_a_fifth_of_the_others_share_belongs_to_the_combination():
    basis = np.array([[1.0, 0, 0], [-1.0, -0.35, 0.05], [0, 1.0, 0]])
    names = (*MODULI, "kappa_pa")
    found = combinations(basis @ basis.T, names, (1.0, 1.0, 1.0))
    powers = dict(zip(found[0].determined.names, found[0].determined.powers, strict=True))
    assert powers["kappa_pa"] / powers["mu_pa"] == pytest.approx(0.35, abs=0.01)


def test_values_that_are_not_positive_have_no_powers():
    (found,) = combinations(pair(np.array([1.0, 1.0]), 1e-3, 1.0), values=(1.0, -1.0))
    assert found.sentence() == "the data determine a combination of λ, μ better than each of them"


def test_a_table_has_the_beginning_of_a_long_combination():
    names = tuple(f"prony_{part}_{k}" for k in (1, 2, 3) for part in ("share", "time_s"))
    long = Direction(names, (1.0, -0.8, 0.7, -0.6, 0.5, -0.4), "product", 1.1)
    assert len(long.label) <= 27 < len(long.formula())
    assert long.formula().startswith(long.label.removesuffix(" …"))
    short = Direction(MODULI, (1.0, 0.9), "sum", 1.1)
    assert short.label == short.formula() == "λ + 0.9 μ"


def test_a_modulus_that_is_known_as_well_names_the_combination():
    weights = np.array([1.0, 0.9]) / 1.9
    moduli = {"young_pa": weights, "poisson": np.array([1.0, -1.0])}
    (found,) = combinations(pair(weights, 1e-2, 1.0), moduli=moduli)
    assert found.modulus == "young_pa"
    assert found.sentence().startswith("the data determine E (about λ + 0.9 μ) to ±")


def test_a_known_value_conditions_the_others():
    """With λ · μ exact, the interval of one constant is that of the other."""
    covariance = pair(np.array([1.0, 1.0]), 1e-6, 1.0)
    (found,) = combinations(covariance)
    (fix,) = found.with_known_value(MODULI, covariance).fixes
    assert fix.what == ("μ known to 5%" if fix.name == "lambda_pa" else "λ known to 5%")
    assert np.log(fix.factor) == pytest.approx(Z95 * 0.05, rel=0.01)


def test_principal_directions_are_independent():
    covariance = pair(np.array([1.0, 0.5]), 1e-2, 1.0)
    best, worst = principal_directions(MODULI, np.ones(2), covariance)
    assert best.formula() == "λ + 0.5 μ"
    assert worst.formula() == "μ / λ^0.5"
    assert np.log(worst.factor) == pytest.approx(Z95, rel=1e-3)


def test_the_picture_has_a_bar_for_each_constant_and_combination():
    directions = [
        Direction(MODULI, (1.0, 0.9), "sum", 1.01),
        Direction(("mu_pa", "lambda_pa"), (1.0, -0.9), "product", 1e6),
    ]
    (axes,) = combinations_picture({"lambda_pa": 3.0, "mu_pa": 4.0}, directions).axes
    assert [each.get_text() for each in axes.get_yticklabels()] == [
        "λ", "μ", "λ +\u00a00.9\u00a0μ", "μ /\u00a0λ^0.9",
    ]  # fmt: skip
    lengths = [bar.get_x() + bar.get_width() for bar in axes.patches]
    assert lengths[:3] == pytest.approx(np.log([3.0, 4.0, 1.01]))


# Of specimens -------------------------------------------------------------------------------------


def specimen_program(test, material, truth, free, strain):
    """Program of a simulated specimen at the truth, and its variables."""
    strains = np.linspace(strain / 9, strain, 9)
    blank = cs.Specimen(test, strains, 0 * strains, 1.0)
    (stress_pa,) = cs.simulate(blank.experiment(material), truth).custom_sensor_values
    measured = replace(blank, stress_pa=stress_pa[:, 0], sigma_pa=1e-3 * np.abs(stress_pa).max())
    unknown = {name: cs.Unknown(truth[name]) for name in free}
    problem = cs.Problem([measured.experiment(material)], truth | unknown)
    collocation = problem.collocation()
    z, failures = initial_variables(collocation)
    assert not failures
    return problem, collocation, z


@pytest.mark.long
def test_a_tension_test_determines_young_modulus_of_two_moduli():
    """E = μ (3 λ + 2 μ) / (λ + μ): at λ = μ, ∂E/∂λ = 1/4 and ∂E/∂μ = 9/4."""
    truth = {"lambda_pa": 1e5, "mu_pa": 1e5}
    problem, collocation, z = specimen_program("uniaxial", "neo-hookean", truth, MODULI, 2e-3)
    expected = expected_precision(collocation, z, problem.assumed_deviations)
    (found,) = expected.combinations()
    assert found.modulus == "young_pa"
    assert found.determined.names == ("mu_pa", "lambda_pa")
    assert found.determined.powers == pytest.approx((1.0, 1 / 9), rel=0.02)
    assert found.loosest.factor > 100.0


def test_a_confined_test_determines_the_modulus_of_plane_waves():
    truth = {"lambda_pa": 1.5e5, "mu_pa": 1e5}
    problem, collocation, z = specimen_program("confined", "neo-hookean", truth, MODULI, 2e-3)
    expected = expected_precision(collocation, z, problem.assumed_deviations)
    (found,) = expected.combinations()
    powers = dict(zip(found.determined.names, found.determined.powers, strict=True))
    assert found.determined.form == "sum"
    assert powers["mu_pa"] / powers["lambda_pa"] == pytest.approx(2.0, rel=0.01)


@pytest.mark.long
def test_another_test_is_named_that_would_determine_both_constants():
    truth = {"lambda_pa": 1e5, "mu_pa": 1e5}
    problem, collocation, z = specimen_program("uniaxial", "neo-hookean", truth, MODULI, 0.02)
    deviations = problem.assumed_deviations
    found = expected_precision(collocation, z, deviations).combinations()
    (each,) = with_measurements(found, collocation, z, deviations)
    added, known = each.fixes
    assert added.what == "an equibiaxial test up to the same strain"
    assert known.what == "λ known to 5%"
    # As predicted with both tests in one problem.
    second = specimen_program("equibiaxial", "neo-hookean", truth, MODULI, 0.02)[0].experiments[0]
    both = replace(problem, experiments=[*problem.experiments, replace(second, name="second")])
    program = both.collocation()
    z, _ = initial_variables(program)
    expected = expected_precision(program, z, deviations)
    k = expected.names.index(added.name)
    reach = Z95 * np.sqrt(expected.covariance[k, k])
    assert np.log(added.factor) == pytest.approx(reach, rel=0.05)


def test_the_other_test_of_a_material_with_memory_has_its_memory_and_times():
    times_s = np.linspace(0.0, 3.0, 7)
    pull = cs.Specimen("uniaxial", 0.01 * times_s, 1e3 * times_s, 10.0, t_s=times_s)
    unknown = {"young_pa": cs.Unknown(1e5), "b.share": cs.Unknown(0.5), "b.tau_s": cs.Unknown(1.0)}
    fixed = {"poisson": 0.49, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
    problem = cs.Problem([pull.experiment(prony=("b",))], unknown | fixed)
    collocation = problem.collocation()
    variables, _ = initial_variables(collocation)
    for _, experiments in added_measurements(collocation, variables):
        *_, added = experiments
        np.testing.assert_array_equal(added.t_s, times_s)
        assert added.body.parts[0].prony == experiments[0].body.parts[0].prony


def test_a_test_that_the_law_cannot_be_evaluated_in_is_not_proposed():
    """Equibiaxial tension to a stretch of 7.6 makes a sheet 58 times thinner."""
    strain = np.linspace(0.1, 6.6, 12)
    pull = cs.Specimen("uniaxial", strain, 1e5 * strain, 1e4)
    constants = {"mu_1_pa": cs.Unknown(4e5), "alpha_1": cs.Unknown(1.5), "kappa_pa": 1e9}
    collocation = cs.Problem([pull.experiment("ogden-1")], constants).collocation()
    variables, _ = initial_variables(collocation)
    proposed = [what for what, _ in added_measurements(collocation, variables)]
    assert proposed
    assert not any("equibiaxial" in what for what in proposed)


# Of a body with a mesh ----------------------------------------------------------------------------


@pytest.mark.long
def test_without_a_force_a_hanging_body_determines_stiffness_over_density():
    """In vacuum, displacements under weight depend on E/ρ; a force sensor determines both."""
    body = cs.Body(cs.box_mesh((0.02, 0.02, 0.1), (1, 1, 3)), density_kg_m3=1000.0)
    body = body.with_free_densities([""])
    held = cs.Grasp(np.flatnonzero(body.nodes_m[:, 2] > 0.099), cs.PoseSequence.fixed())
    places_m = body.nodes_m[body.nodes_m[:, 2] < 0.001]
    markers = cs.Markers(np.zeros(1), np.zeros((1, len(places_m), 3)), 1e-6, places_m=places_m)
    hanging = cs.Experiment(
        body, np.zeros(1), [held], markers, nuisance=cs.Nuisance.none(), kind="static",
        air_density_kg_m3="none",
    )  # fmt: skip
    truth = {"poisson": 0.4, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
    unknown = {"young_pa": cs.Unknown(2e4), "density_kg_m3": cs.Unknown(1000.0)}
    collocation = cs.Problem([hanging], truth | unknown).collocation()
    z, failures = initial_variables(collocation)
    assert not failures
    exact = dict.fromkeys(cs.Problem([hanging], truth | unknown).assumed_deviations)
    found = expected_precision(collocation, z, exact).combinations()
    (each,) = with_measurements(found, collocation, z, exact)
    assert each.determined.formula() in ("E / ρ", "ρ / E")
    assert each.determined.powers == pytest.approx((1.0, -1.0), rel=1e-3)
    assert each.loosest.factor > 1e4
    sensor, _ = each.fixes
    assert sensor.what == "a force sensor at the grasp (noise 1% of the largest force)"
    # The force is the weight: the logarithm of ρ, and with it that of E, has the deviation 1 %.
    assert np.log(sensor.factor) == pytest.approx(Z95 * 0.01, rel=0.2)


@pytest.mark.parametrize(
    ("factor", "said"),
    [
        (1 + 3.2e-13, "to better than ±0.01 %"),
        (1.0, "to better than ±0.01 %"),
        (1.032, "to ±3.2 %"),
        (4.0, "to within a factor of 4"),
    ],
)
def test_no_precision_below_that_of_any_experiment_is_stated(factor: float, said: str):
    assert precision_text(factor) == said
