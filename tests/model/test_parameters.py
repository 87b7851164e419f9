"""Parameters: guesses, bounds, priors, ties and transformations."""

from __future__ import annotations

import numpy as np
import pytest
from kit.checks import assert_derivative
from kit.materials import CONSTANTS, KAPPA_PA, LAME
from kit.problems import box

from collocation_sysid.errors import InputError
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.laws.moduli import engineering_constants
from collocation_sysid.fem.meshes.selection import Box
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.fem.regions import Region
from collocation_sysid.model.parameters import (
    Parameter,
    Parameters,
    ThetaMap,
    Tied,
    Unknown,
    resolve_theta,
)

DAMPING = (Parameter("gamma_r_s", 0.02, 1e-5, 1.0), Parameter("gamma_m_1_s", 0.5, 1e-3, 100.0))
IN_LAME = Parameters(
    (Parameter("lambda_pa", 400.0, 10.0, 1e5), Parameter("mu_pa", 150.0, 10.0, 1e5), *DAMPING)
)
IN_ENGINEERING = Parameters(
    (Parameter("young_pa", 700.0, 10.0, 1e5), Parameter("poisson", 0.2, 0.01, 0.49), *DAMPING)
)
MIXED = Parameters(
    (
        Parameter("young_pa", 700.0, 10.0, 1e5),
        Parameter("poisson", 0.2, is_fixed=True),
        DAMPING[0],
        Parameter("gamma_m_1_s", 0.0, is_fixed=True),
    )
)
ALL_FIXED = Parameters(
    tuple(Parameter(item.name, item.guess, is_fixed=True) for item in IN_LAME.items)
)
DAMPED = {"gamma_r_s": Unknown(0.02), "gamma_m_1_s": Unknown(0.5)}

YOUNG_PA, POISSON = engineering_constants(*LAME)
# The same stiffness in every pair of moduli.
PAIRS = {
    "lambda and mu": {"lambda_pa": LAME[0], "mu_pa": LAME[1]},
    "young and poisson": {"young_pa": YOUNG_PA, "poisson": POISSON},
    "kappa and mu": {"kappa_pa": KAPPA_PA, "mu_pa": LAME[1]},
    "mu and poisson": {"mu_pa": LAME[1], "poisson": POISSON},
}
OWN = {name: CONSTANTS["mooney-rivlin"][name] for name in ("c10_pa", "c01_pa")}
BESIDE_SHEAR = {
    "kappa": {**OWN, "kappa_pa": KAPPA_PA},
    "lambda": {**OWN, "lambda_pa": LAME[0]},
    "poisson": {**OWN, "poisson": POISSON},
}


def body_of(material: str = "neo-hookean", regions: tuple[Region, ...] = ()) -> Body:
    mesh = box_mesh((0.1, 0.1, 0.1), (2, 1, 1))
    return Body(mesh, material, density_kg_m3=30.0, regions=regions)


def two_regions(material: str | None = None) -> Body:
    """A body with a core of its own, neo-Hookean otherwise."""
    return body_of(regions=(Region("core", Box([-1, -1, -1], [0.05, 1, 1]), material),))


def unknowns(values: dict[str, float]) -> Parameters:
    """All of them estimated, with the damping."""
    return Parameters.from_mapping(
        {**{name: Unknown(value) for name, value in values.items()}, **DAMPED}
    )


def assert_derivatives(parameters: Parameters, body: Body, rng: np.random.Generator) -> None:
    """Of constants and derived moduli by q, around the guess."""
    constants, q = ThetaMap(parameters, body), parameters.guess_q
    scale, size = 0.3, len(body.constants)
    first = constants.jacobian(q)
    assert first.shape == (size, len(q))
    for k in range(size):
        assert_derivative(
            lambda q, k=k: constants.theta(q)[k], lambda d, k=k: first[k] @ d, q, rng, scale=scale
        ) if first[k].any() else None
    _, slopes = constants.derived_moduli(q)
    if len(slopes):
        assert_derivative(
            lambda q: constants.derived_moduli(q)[0], lambda d: slopes @ d, q, rng, scale=scale
        )


# From solver coordinates to constants -----------------------------------------------------------


def test_positive_constants_are_the_exponentials_of_q():
    found = ThetaMap(IN_LAME, box()).theta(np.log([1, 2, 3, 4]))
    np.testing.assert_allclose(found, [1, 2, 3, 4])


@pytest.mark.parametrize("pair", PAIRS)
def test_every_pair_of_moduli_gives_the_same_constants(pair):
    parameters = unknowns(PAIRS[pair])
    found = ThetaMap(parameters, box()).theta(parameters.guess_q)
    np.testing.assert_allclose(found, [*LAME, 0.02, 0.5], rtol=1e-12)


@pytest.mark.parametrize("pair", PAIRS)
def test_materials_in_kappa_take_every_pair_too(pair):
    parameters = unknowns({**PAIRS[pair], "gent_limit": 8.0})
    found = ThetaMap(parameters, body_of("gent")).theta(parameters.guess_q)
    np.testing.assert_allclose(found, [LAME[1], 8.0, KAPPA_PA, 0.02, 0.5], rtol=1e-12)


@pytest.mark.parametrize("beside", BESIDE_SHEAR)
def test_a_shear_modulus_that_follows_takes_kappa_lambda_or_poisson_beside(beside):
    parameters = unknowns(BESIDE_SHEAR[beside])
    found = ThetaMap(parameters, body_of("mooney-rivlin")).theta(parameters.guess_q)
    np.testing.assert_allclose(found, [110.0, 40.0, KAPPA_PA, 0.02, 0.5], rtol=1e-12)


def test_fixed_parameters_are_not_among_the_unknowns():
    assert [item.name for item in MIXED.free] == ["young_pa", "gamma_r_s"]
    theta = ThetaMap(MIXED, box()).theta(np.log([1200.0, 0.03]))
    np.testing.assert_allclose(theta, [1000 / 3, 500.0, 0.03, 0.0])


def test_with_everything_fixed_the_constants_are_the_guess():
    assert ALL_FIXED.guess_q.shape == (0,)
    constants = ThetaMap(ALL_FIXED, box())
    np.testing.assert_allclose(constants.theta([]), [400.0, 150.0, 0.02, 0.5])
    assert constants.jacobian(np.zeros(0)).shape == (4, 0)
    values, slopes = constants.derived_moduli(np.zeros(0))
    np.testing.assert_allclose(values, engineering_constants(400.0, 150.0))
    assert slopes.shape == (2, 0)


@pytest.mark.parametrize("pair", PAIRS)
def test_derivatives_by_every_pair_of_moduli(pair, rng):
    assert_derivatives(unknowns(PAIRS[pair]), box(), rng)


@pytest.mark.parametrize("beside", BESIDE_SHEAR)
def test_derivatives_where_the_shear_modulus_follows(beside, rng):
    assert_derivatives(unknowns(BESIDE_SHEAR[beside]), body_of("mooney-rivlin"), rng)


@pytest.mark.parametrize("parameters", [IN_ENGINEERING, MIXED], ids=["logarithms", "mixed"])
def test_derivatives_with_a_logarithm_of_poisson_and_with_fixed_values(parameters, rng):
    assert_derivatives(parameters, box(), rng)


def test_values_have_the_users_names():
    values = MIXED.values(np.log([900.0, 0.03]))
    expected = {"young_pa": 900.0, "poisson": 0.2, "gamma_r_s": 0.03, "gamma_m_1_s": 0.0}
    assert values == pytest.approx(expected)


def test_bounds_and_guesses_are_logarithms():
    lower, upper = IN_LAME.bounds_q
    np.testing.assert_allclose(np.exp(lower), [10, 10, 1e-5, 1e-3])
    np.testing.assert_allclose(np.exp(upper), [1e5, 1e5, 1, 100])
    np.testing.assert_allclose(np.exp(IN_LAME.guess_q), [400, 150, 0.02, 0.5])


def test_a_prior_pulls_on_the_logarithm():
    drawn = Parameter("mu_pa", 150.0, 10.0, 1e5, prior=(300.0, 0.1))
    parameters = Parameters((IN_LAME.items[0], drawn, *DAMPING))
    residuals, slopes = parameters.prior_residuals(np.log([400.0, 330.0, 0.02, 0.5]))
    np.testing.assert_allclose(residuals, [0, np.log(1.1) / 0.1, 0, 0])
    np.testing.assert_allclose(slopes, [0, 10, 0, 0])


# Linear parameters ------------------------------------------------------------------------------


def test_poisson_is_estimated_on_a_linear_scale_by_tenths():
    (young, poisson, *_) = Parameters.from_mapping(
        {"young_pa": Unknown(700.0), "poisson": Unknown(0.2, 0.05, 0.45), **DAMPED}
    ).items
    assert (young.scale, poisson.scale, poisson.unit) == ("log", "linear", 0.1)
    assert poisson.to_coordinate(0.2) == pytest.approx(2.0)
    assert poisson.from_coordinate(3.0) == pytest.approx(0.3)
    assert poisson.value_derivative(0.2) == 0.1
    assert (poisson.lower, poisson.upper) == (0.05, 0.45)


def test_the_scale_may_be_stated():
    given = {"young_pa": Unknown(700.0), "poisson": Unknown(0.2, scale="log"), **DAMPED}
    logarithm = Parameters.from_mapping(given)
    assert logarithm.guess_q[1] == pytest.approx(np.log(0.2))
    any_sign = Parameters.from_mapping({"mu_pa": Unknown(20.0, scale="linear")}).items[0]
    assert any_sign.lower < 0
    assert any_sign.unit == 20.0  # its guess tells its size
    assert (
        Parameters.from_mapping({"mu_pa": Unknown(20.0, scale="linear", typical=5.0)}).guess_q[0]
        == 4.0
    )


def test_a_linear_parameter_may_be_negative_or_zero():
    given = {"c10_pa": 150.0, "c20_pa": Unknown(-40.0, -100.0, 50.0), "c30_pa": 0.0}
    parameters = Parameters.from_mapping(
        {**given, "kappa_pa": KAPPA_PA, "gamma_r_s": 0.0, "gamma_m_1_s": 0}
    )
    np.testing.assert_allclose(parameters.guess_q, [-1.0])
    lower, upper = parameters.bounds_q
    np.testing.assert_allclose([lower[0], upper[0]], [-2.5, 1.25])
    theta = ThetaMap(parameters, body_of("yeoh")).theta([0.5])
    np.testing.assert_allclose(theta, [150.0, 20.0, 0.0, KAPPA_PA, 0.0, 0.0])


def test_a_linear_parameter_of_no_size_is_refused():
    with pytest.raises(InputError, match=r"c20_pa: .*guess = 0 .*expected typical"):
        Parameters.from_mapping({"c20_pa": Unknown(0.0)})
    assert Parameters.from_mapping({"c20_pa": Unknown(0.0, typical=10.0)}).items[0].unit == 10.0


def test_a_prior_of_a_linear_parameter_pulls_on_its_value():
    poisson = Unknown(0.2, prior=(0.3, 0.02))
    parameters = Parameters.from_mapping({"young_pa": Unknown(700.0), "poisson": poisson, **DAMPED})
    q = parameters.guess_q
    q[1] = 0.35 / 0.1
    residuals, slopes = parameters.prior_residuals(q)
    np.testing.assert_allclose(residuals, [0, 0.05 / 0.02, 0, 0])
    np.testing.assert_allclose(slopes, [0, 0.1 / 0.02, 0, 0])


# Ties -------------------------------------------------------------------------------------------


def test_a_tied_parameter_is_a_multiple_of_another(rng):
    given = {"mu_pa": Unknown(300.0), "lambda_pa": Tied("mu_pa", 2.0), **DAMPED}
    parameters = Parameters.from_mapping(given)
    assert [item.name for item in parameters.free] == ["mu_pa", "gamma_r_s", "gamma_m_1_s"]
    assert parameters.guesses == pytest.approx(
        {"mu_pa": 300.0, "lambda_pa": 600.0, "gamma_r_s": 0.02, "gamma_m_1_s": 0.5}
    )
    found = ThetaMap(parameters, box()).theta(np.log([100.0, 0.01, 1.0]))
    np.testing.assert_allclose(found, [200.0, 100.0, 0.01, 1.0])
    assert_derivatives(parameters, box(), rng)


def test_a_tie_to_a_fixed_value_is_fixed():
    given = {"mu_pa": 300.0, "lambda_pa": Tied("mu_pa"), "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
    parameters = Parameters.from_mapping(given)
    np.testing.assert_allclose(ThetaMap(parameters, box()).theta([]), [300.0, 300.0, 0.0, 0.0])


def test_a_parameter_that_only_another_is_tied_to_counts_as_used():
    body = two_regions()
    given = {
        "lambda_pa": Unknown(200.0),
        "mu_pa": Unknown(300.0),
        "core.lambda_pa": Tied("lambda_pa", 3.0),
        "core.mu_pa": Tied("mu_pa", 3.0),
        **DAMPED,
    }
    parameters = Parameters.from_mapping(given)
    parameters.require_constants_of([body])
    theta = ThetaMap(parameters, body).theta(parameters.guess_q)
    np.testing.assert_allclose(theta, [200, 300, 0.02, 0.5, 600, 900, 0.02, 0.5])


@pytest.mark.parametrize(
    ("tied", "message"),
    [
        (Tied("mu_p"), "lambda_pa: tied to 'mu_p', expected a parameter .*; did you mean 'mu_pa'"),
        (Tied("lambda_pa"), "lambda_pa: tied to 'lambda_pa'"),
        (Tied("gamma_r_s"), "lambda_pa: tied to 'gamma_r_s'"),
    ],
    ids=["nothing", "itself", "one that is tied"],
)
def test_ties_to_parameters_without_a_value_are_refused(tied, message):
    given = {"lambda_pa": tied, "mu_pa": 1.0, "gamma_r_s": Tied("mu_pa"), "gamma_m_1_s": 0.0}
    with pytest.raises(InputError, match=message):
        Parameters.from_mapping(given)


# Regions ----------------------------------------------------------------------------------------


def test_regions_share_names_without_a_region_and_have_their_own(rng):
    body = two_regions("mooney-rivlin")
    given = {
        "young_pa": Unknown(1000.0),
        "poisson": 0.25,
        "core.c10_pa": Unknown(300.0),
        "core.c01_pa": Unknown(200.0),
        "core.poisson": Tied("poisson"),
        "gamma_r_s": Unknown(0.01),
        "gamma_m_1_s": Unknown(1.0),
        "core.gamma_m_1_s": Unknown(2.0),
    }
    parameters = Parameters.from_mapping(given)
    parameters.require_constants_of([body])
    theta = ThetaMap(parameters, body).theta(parameters.guess_q)
    kappa = 1000.0 + 2 / 3 * 1000.0  # of the core, with ν = ¼ like the rest: λ = μ
    expected = [400.0, 400.0, 0.01, 1.0, 300.0, 200.0, kappa, 0.01, 2.0]
    np.testing.assert_allclose(theta, expected, rtol=1e-12)
    assert_derivatives(parameters, body, rng)


def test_a_region_takes_the_shared_moduli_that_its_material_needs():
    given = {"young_pa": 1.0, "poisson": 0.2, **GIVEN, "core.c10_pa": 1.0, "core.c01_pa": 2.0}
    body = two_regions("mooney-rivlin")
    Parameters.from_mapping(given).require_constants_of([body])
    lam, mu = body.lame(body.theta_from_values(given))["core"]
    assert mu == pytest.approx(6.0)
    assert lam / (2 * (lam + mu)) == pytest.approx(0.2)


def test_a_regions_own_modulus_goes_with_a_shared_one():
    body = two_regions()
    given = {"mu_pa": 300.0, "poisson": 0.25, "core.mu_pa": 500.0}
    theta = body.theta_from_values({**given, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0})
    np.testing.assert_allclose(theta, [300.0, 300.0, 0.0, 0.0, 500.0, 500.0, 0.0, 0.0])


def test_a_regions_own_pair_may_be_another_one():
    body = two_regions()
    given = {"lambda_pa": 300.0, "mu_pa": 300.0, "core.young_pa": 1000.0, "core.poisson": 0.25}
    theta = body.theta_from_values({**given, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0})
    np.testing.assert_allclose(theta, [300.0, 300.0, 0.0, 0.0, 400.0, 400.0, 0.0, 0.0])


def test_several_bodies_take_their_constants_from_the_same_parameters():
    one, two = box(), body_of("gent")
    parameters = unknowns({"mu_pa": LAME[1], "poisson": POISSON, "gent_limit": 8.0})
    parameters.require_constants_of([one, two])
    np.testing.assert_allclose(ThetaMap(parameters, one).theta(parameters.guess_q)[:2], LAME)
    found = ThetaMap(parameters, two).theta(parameters.guess_q)
    np.testing.assert_allclose(found, [LAME[1], 8.0, KAPPA_PA, 0.02, 0.5])


# Derived moduli ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("pair", "expected"),
    [
        ("lambda and mu", {"young_pa": YOUNG_PA, "poisson": POISSON}),
        ("young and poisson", {"lambda_pa": LAME[0], "mu_pa": LAME[1]}),
        ("kappa and mu", {"young_pa": YOUNG_PA, "poisson": POISSON}),
        ("mu and poisson", {"young_pa": YOUNG_PA}),
    ],
)
def test_moduli_that_were_not_given_are_derived(pair, expected):
    parameters = unknowns(PAIRS[pair])
    constants = ThetaMap(parameters, box())
    found = dict(
        zip(constants.derived_names, constants.derived_moduli(parameters.guess_q)[0], strict=True)
    )
    assert found == pytest.approx(expected)


def test_moduli_are_derived_for_every_region():
    body = two_regions("mooney-rivlin")
    given = {"lambda_pa": LAME[0], "mu_pa": LAME[1]}
    core = {f"core.{name}": value for name, value in BESIDE_SHEAR["kappa"].items()}
    parameters = unknowns({**given, **core})
    constants = ThetaMap(parameters, body)
    assert set(constants.derived_names) == {
        *("young_pa", "poisson", "core.young_pa", "core.poisson")
    }
    found = dict(
        zip(constants.derived_names, constants.derived_moduli(parameters.guess_q)[0], strict=True)
    )
    for name in ("", "core."):
        assert found[f"{name}young_pa"] == pytest.approx(YOUNG_PA)
        assert found[f"{name}poisson"] == pytest.approx(POISSON)


# Ways to give constants -------------------------------------------------------------------------


def test_constants_from_guesses_a_mapping_or_numbers():
    expected = np.array([400.0, 400.0, 0.01, 2.0])
    by_name = {"gamma_m_1_s": 2.0, "gamma_r_s": 0.01, "young_pa": 1000.0, "poisson": 0.25}
    np.testing.assert_allclose(resolve_theta(box(), by_name), expected)
    np.testing.assert_array_equal(resolve_theta(box(), [400, 400, 0.01, 2]), expected)
    np.testing.assert_array_equal(resolve_theta(box(), expected), expected)
    np.testing.assert_allclose(resolve_theta(box(), IN_LAME), (400.0, 150.0, 0.02, 0.5))


def test_a_mapping_is_checked_like_a_problem():
    with pytest.raises(InputError, match="gamma_m_1_s is missing"):
        resolve_theta(box(), {"young_pa": 1000.0, "poisson": 0.2, "gamma_r_s": 0.01})
    with pytest.raises(InputError, match="gama_r_s: the model has no such parameter"):
        resolve_theta(box(), {"young_pa": 1000.0, "poisson": 0.2, "gama_r_s": 0.01})


def test_as_many_numbers_as_constants_are_taken():
    with pytest.raises(InputError, match="3 parameters given, expected 4: lambda_pa, mu_pa"):
        resolve_theta(box(), [400.0, 400.0, 0.01])


def test_with_guess_changes_only_the_named_parameters():
    other = MIXED.with_guess({"poisson": 0.3, "young_pa": 800.0})
    assert other.guesses == pytest.approx(
        {"young_pa": 800.0, "poisson": 0.3, "gamma_r_s": 0.02, "gamma_m_1_s": 0.0}
    )
    assert [item.is_fixed for item in other.items] == [item.is_fixed for item in MIXED.items]


def test_with_guess_refuses_unknown_names_and_values_out_of_bounds():
    with pytest.raises(InputError, match="no parameter 'lambda_pa'; there are young_pa"):
        MIXED.with_guess({"lambda_pa": 3.0})
    with pytest.raises(InputError, match=r"young_pa: guess = 1, expected .* \[10, 100000\]"):
        MIXED.with_guess({"young_pa": 1.0})


def test_estimates_beyond_the_bounds_start_at_the_bounds():
    below = 10.0 * (1 - 1e-15)
    start = MIXED.with_estimates({"young_pa": below})
    assert start.guesses["young_pa"] == pytest.approx(10.0, rel=1e-12)
    with pytest.raises(InputError, match="no parameter 'lambda_pa'"):
        MIXED.with_estimates({"lambda_pa": 3.0})


def test_with_fixed_fixes_the_named_parameters():
    other = IN_LAME.with_fixed({"mu_pa": 200.0})
    assert [item.name for item in other.free] == ["lambda_pa", "gamma_r_s", "gamma_m_1_s"]
    assert other.guesses == pytest.approx({**IN_LAME.guesses, "mu_pa": 200.0})


# Refusals ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"guess": 5.0}, r"mu_pa: guess = 5, expected a value within \[10, 1000\]"),
        ({"guess": np.nan}, "Parameter 'mu_pa': guess is nan; expected a number"),
        ({"lower": 0.0}, "mu_pa: lower = 0, upper = 1000, expected 0 < lower < upper"),
        ({"lower": 1000.0, "guess": 1000.0}, "expected 0 < lower < upper"),
        (
            {"prior": (300.0, 0.0)},
            "mu_pa: prior = .*, expected a positive mean and a positive standard deviation",
        ),
        (
            {"prior": (-300.0, 0.1)},
            "mu_pa: prior = .*, expected a positive mean and a positive standard deviation",
        ),
        ({"is_fixed": True, "guess": -1.0}, "mu_pa: fixed = -1, expected a number >= 0"),
        ({"is_fixed": True, "guess": np.inf}, "mu_pa: fixed = inf"),
        ({"scale": "linear", "lower": 1000.0}, "lower = 1000, upper = 1000, expected lower < u"),
    ],
)
def test_unusable_parameters_are_refused_by_name(changes: dict, message: str):
    fields = {"guess": 100.0, "lower": 10.0, "upper": 1000.0, **changes}
    with pytest.raises(InputError, match=message):
        Parameter("mu_pa", **fields)


@pytest.mark.parametrize("name", ["poisson", "core.poisson"])
@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"lower": 0.01, "upper": 0.5}, "poisson: upper = 0.5, expected less than 0.5"),
        ({"lower": 0.01}, "poisson: upper = inf, expected less than 0.5"),
        ({"guess": 0.5, "is_fixed": True}, "poisson: fixed = 0.5, expected less than 0.5"),
    ],
)
def test_incompressible_bodies_are_refused(name: str, fields: dict, message: str):
    with pytest.raises(InputError, match=f"{message}: an incompressible body"):
        Parameter(name, **{"guess": 0.3, **fields})


def test_ratios_of_poisson_that_no_solid_has_are_refused():
    with pytest.raises(InputError, match=r"poisson: fixed = -1, expected a number >= -0\.99"):
        Parameter("poisson", -1.0, is_fixed=True)
    with pytest.raises(InputError, match=r"lower = -3, upper = 0.3, expected -0\.99 <= lower"):
        Parameter("poisson", 0.1, lower=-3.0, upper=0.3, scale="linear")


GIVEN = dict.fromkeys(("gamma_r_s", "gamma_m_1_s"), 0.1)
SETS = {
    "none": ({}, "the elastic parameters of the body are none; .* expects lambda_pa and mu_pa, or"),
    "half a pair": ({"mu_pa": 1.0, **GIVEN}, "of the body are mu_pa; .* lambda_pa and mu_pa, or"),
    "two pairs mixed": (
        {"lambda_pa": 1.0, "poisson": 0.2, **GIVEN},
        "of the body are lambda_pa, poisson; the material neo-hookean of the body expects",
    ),
    "three moduli": (
        {"lambda_pa": 1.0, "mu_pa": 1.0, "poisson": 0.2, **GIVEN},
        "of the body are lambda_pa, mu_pa, poisson; .* or young_pa and poisson",
    ),
    "no damping": (
        {"lambda_pa": 1.0, "mu_pa": 1.0},
        "gamma_r_s, gamma_m_1_s are missing: the material neo-hookean of the body with its damping",
    ),
    "one missing": (
        {"lambda_pa": 1.0, "mu_pa": 1.0, "gamma_r_s": 0.1},
        "gamma_m_1_s is missing: .* expects gamma_r_s, gamma_m_1_s, and lambda_pa and mu_pa, or",
    ),
    "misspelt": (
        {"lambda_pa": 1.0, "mu_p": 1.0, **GIVEN},
        "mu_p: the model has no such parameter; .* lambda_pa, mu_pa, .*; did you mean 'mu_pa'",
    ),
    "of another material": (
        {"lambda_pa": 1.0, "mu_pa": 1.0, "gent_limit": 3.0, **GIVEN},
        "gent_limit: the model has no such parameter",
    ),
    "of no region": (
        {"lambda_pa": 1.0, "mu_pa": 1.0, "core.mu_pa": 3.0, **GIVEN},
        "core.mu_pa: the model has no such parameter; .*; did you mean 'mu_pa'",
    ),
}


@pytest.mark.parametrize("name", SETS)
def test_other_sets_of_parameters_are_refused_with_one_message(name: str):
    given, message = SETS[name]
    with pytest.raises(InputError, match=message) as caught:
        Parameters.from_mapping(given).require_constants_of([box()])
    assert "\n" not in str(caught.value)


OF_TWO = {"lambda_pa": 1.0, "mu_pa": 1.0, **GIVEN}
SETS_OF_TWO = {
    "misspelt region": ({**OF_TWO, "coer.mu_pa": 2.0}, "coer.mu_pa: .* mean 'core.mu_pa'"),
    "unused": (
        {**OF_TWO, **{f"{region}.gamma_m_1_s": 2.0 for region in ("core", "skin")}},
        "gamma_m_1_s: no part of the model uses this parameter, because every region has its own value",
    ),
    "mixed in a region": (
        {**OF_TWO, "core.young_pa": 2.0},
        "the elastic parameters of region 'core' are lambda_pa, mu_pa, core.young_pa; the material",
    ),
    "missing in a region": (
        {"skin.lambda_pa": 1.0, "skin.mu_pa": 1.0, **GIVEN},
        "the elastic parameters of region 'core' are none",
    ),
}


@pytest.mark.parametrize("name", SETS_OF_TWO)
def test_parameters_that_do_not_fit_the_regions_are_refused(name: str):
    given, message = SETS_OF_TWO[name]
    halves = (
        Region("core", Box([-1] * 3, [0.05, 1, 1])),
        Region("skin", Box([0.05, -1, -1], [1] * 3)),
    )
    with pytest.raises(InputError, match=message) as caught:
        Parameters.from_mapping(given).require_constants_of([body_of(regions=halves)])
    assert "\n" not in str(caught.value)


def test_a_name_given_twice_is_refused():
    with pytest.raises(
        InputError, match="mu_pa: this parameter is given twice, expected one value"
    ):
        Parameters((IN_LAME.items[1], *IN_LAME.items))


def test_a_negative_estimate_can_be_fixed():
    """So are the constants of a recording that is predicted only."""
    free = Parameters.from_mapping({"c10_pa": 1e4, "c01_pa": Unknown(-1e3, scale="linear")})
    fixed = free.only_fixed({"c01_pa": -1.4e3})
    assert (fixed.names, fixed.free) == (("c01_pa",), ())
    assert fixed.values(np.zeros(0)) == {"c01_pa": -1.4e3}
    assert Parameters.from_mapping({"c01_pa": -1.4e3}).values(np.zeros(0)) == {"c01_pa": -1.4e3}
    with pytest.raises(InputError, match=r"c10_pa.*fixed = -1400, expected a number >= 0"):
        Parameters.from_mapping({"c10_pa": -1.4e3})
