"""Ogden's law and compressible foam: closed forms, limits, equal stretches and kernels."""

from __future__ import annotations

from functools import cache
from itertools import product

import casadi as ca
import numpy as np
import pytest
from kit.checks import relative_error
from kit.materials import CONSTANTS, HYPERFOAM, KAPPA_PA, OGDEN
from kit.rest_shapes import as_scanned
from scipy.spatial.transform import Rotation

from collocation_sysid.fem.body import Body
from collocation_sysid.fem.laws.materials import MATERIALS, Material
from collocation_sysid.fem.laws.moduli import engineering_constants
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.fem.spatial_field import Field

POWER_LAWS = [name for name in MATERIALS if name.startswith(("ogden", "hyperfoam"))]


@cache
def energy_function(name: str) -> ca.Function:
    """Energy and derivatives by the chain rule."""
    material = MATERIALS[name]
    F = ca.SX.sym("F", 9)
    values = ca.SX.sym("values", len(material.constants))
    gradient = ca.reshape(F, 3, 3)
    rule = material.chain_rule(gradient, values)
    psi = material.psi_in(rule, gradient, values)
    stress = rule.gradient(psi, F)
    outputs = [psi, stress, rule.jacobian(stress, F), rule.jacobian(stress, values)]
    return ca.Function("law", [F, values], rule.eliminate(outputs))


class Law:
    """Energy density, first Piola–Kirchhoff stress and tangent of a material, as the kernels have
    them: differentiated by the chain rule.
    """

    def __init__(self, name: str, **changes: float) -> None:
        self.constants = {**CONSTANTS[name], **changes}
        self._function = energy_function(name)

    def evaluate(self, F: np.ndarray) -> list[np.ndarray]:
        """ψ, P (9,), ∂P/∂F (9, 9) and ∂P/∂θ."""
        return [
            each.full()
            for each in self._function.call([F.ravel(order="F"), [*self.constants.values()]])
        ]

    def piola(self, F: np.ndarray) -> np.ndarray:
        return self.evaluate(F)[1].reshape(3, 3, order="F")

    def cauchy(self, F: np.ndarray) -> np.ndarray:
        return self.piola(F) @ F.T / np.linalg.det(F)


def kirchhoff_of_ogden(stretches: np.ndarray, terms) -> np.ndarray:
    """Principal Kirchhoff stresses Σ μ (λ̄ᵢ^α − ⅓ Σ λ̄^α) + κ J (J − 1) (Ogden 1972)."""
    ratio = stretches.prod()
    isochoric = stretches / np.cbrt(ratio)
    shape = sum(mu * (isochoric**a - np.mean(isochoric**a)) for mu, a in terms)
    return shape + KAPPA_PA * ratio * (ratio - 1)


def kirchhoff_of_foam(stretches: np.ndarray, terms) -> np.ndarray:
    """Principal Kirchhoff stresses Σ 2μ/α (λᵢ^α − J^(−αβ)) (Hill 1978)."""
    ratio = stretches.prod()
    return sum(2 * mu / a * (stretches**a - ratio ** (-a * b)) for mu, a, b in terms)


def expected_kirchhoff(name: str, stretches: np.ndarray) -> np.ndarray:
    kind, count = name.split("-")
    if kind == "ogden":
        return kirchhoff_of_ogden(stretches, OGDEN[int(count)])
    return kirchhoff_of_foam(stretches, HYPERFOAM[int(count)])


LOADS = {
    "uniaxial": lambda s: np.array([s, s**-0.5, s**-0.5]),
    "uniaxial, compressible": lambda s: np.array([s, s**-0.2, s**-0.2]),
    "equibiaxial": lambda s: np.array([s, s, s**-2.0]),
    "planar": lambda s: np.array([s, 1.0, 1 / s]),
    "volumetric": lambda s: np.array([s, s, s]),
    "three different": lambda s: np.array([s, 1.1, s**-0.6]),
}


@pytest.mark.parametrize("name", POWER_LAWS)
def test_stresses_are_the_closed_forms(name):
    law = Law(name)
    for load, stretch in product(LOADS, (0.5, 0.8, 0.97, 1.0, 1.001, 1.3, 2.0, 2.8)):
        stretches = LOADS[load](stretch)
        found = np.diag(law.piola(np.diag(stretches))) * stretches
        expected = expected_kirchhoff(name, stretches)
        scale = max(np.abs(expected).max(), 1.0)
        np.testing.assert_allclose(found, expected, atol=1e-9 * scale)


@pytest.mark.parametrize("name", POWER_LAWS)
def test_principal_axes_are_those_of_the_deformation(name, rng):
    stretches = np.array([1.6, 0.9, 0.7])
    first, second = Rotation.from_quat(rng.standard_normal((2, 4))).as_matrix()
    law = Law(name)
    found = law.cauchy(first @ np.diag(stretches) @ second.T)
    expected = first @ np.diag(expected_kirchhoff(name, stretches)) @ first.T / stretches.prod()
    assert relative_error(found, expected) < 1e-10


@pytest.mark.parametrize("load", ["uniaxial", "equibiaxial", "volumetric"])
@pytest.mark.parametrize("name", POWER_LAWS)
def test_coincident_stretches_have_exact_stress_and_second_derivatives(name, load):
    """The tangent at coincident stretches is compared with complex-step-free differences of the
    closed form, along shears that separate the stretches.
    """
    law = Law(name)
    F = np.diag(LOADS[load](1.4))
    direction = np.array([[0.3, 0.5, -0.2], [0.1, -0.4, 0.6], [0.2, 0.3, 0.1]])

    def exact_piola(h: float) -> np.ndarray:
        left, stretches, right = np.linalg.svd(F + h * direction)
        tau = expected_kirchhoff(name, stretches)
        return left @ np.diag(tau / stretches) @ right

    scale = np.abs(exact_piola(0.0)).max()
    np.testing.assert_allclose(law.piola(F), exact_piola(0.0), atol=1e-9 * scale)
    h = 1e-3
    # Differences of the fourth order of the exact stress.
    slope = 8 * (exact_piola(h) - exact_piola(-h)) - (exact_piola(2 * h) - exact_piola(-2 * h))
    slope /= 12 * h
    tangent = law.evaluate(F)[2] @ direction.ravel(order="F")
    assert relative_error(tangent.reshape(3, 3, order="F"), slope) < 1e-6


@pytest.mark.parametrize("name", POWER_LAWS)
def test_second_derivatives_are_continuous_where_stretches_coincide(name):
    law = Law(name)
    exactly = law.evaluate(np.diag([1.5, 1.5, 0.6]))[2]
    nearly = law.evaluate(np.diag([1.5, 1.5 * (1 + 1e-9), 0.6]))[2]
    assert relative_error(nearly, exactly) < 1e-6


# Limits ----------------------------------------------------------------------------------------


def test_an_exponent_of_two_is_neo_hookean(rng):
    """μ/2 (Ī₁ − 3) + U, which Mooney–Rivlin with C₀₁ = 0 is."""
    law = Law("ogden-1", mu_1_pa=300.0, alpha_1=2.0)
    for F in np.eye(3) + rng.uniform(-0.3, 0.3, (5, 3, 3)):
        compare_with_mooney_rivlin(law, F, c10_pa=150.0, c01_pa=0.0)


def test_exponents_of_plus_and_minus_two_are_mooney_rivlin(rng):
    law = Law("ogden-2", mu_1_pa=220.0, alpha_1=2.0, mu_2_pa=-80.0, alpha_2=-2.0)
    for F in np.eye(3) + rng.uniform(-0.3, 0.3, (5, 3, 3)):
        compare_with_mooney_rivlin(law, F, c10_pa=110.0, c01_pa=40.0)


def compare_with_mooney_rivlin(law: Law, F: np.ndarray, **constants: float) -> None:
    """Compare energy, stress and tangent with those of Mooney and Rivlin's law."""
    symbol = ca.SX.sym("F", 9)
    values = ca.SX(ca.DM([*constants.values(), KAPPA_PA]))
    psi = MATERIALS["mooney-rivlin"].psi(ca.reshape(symbol, 3, 3), values)
    tangent, stress = ca.hessian(psi, symbol)
    expected = ca.Function("law", [symbol], [psi, stress, tangent]).call([F.ravel(order="F")])
    for one, other, tolerance in zip(law.evaluate(F), expected, (1e-9, 1e-9, 1e-8), strict=False):
        assert relative_error(one, other.full()) < tolerance


def test_blatz_and_kos_foam_is_a_negative_exponent(rng):
    """ψ = ½ μ (I₂/I₃ + 2 J − 5) (Blatz & Ko 1962) is one term with α = −2 and β = ½."""
    law = Law("hyperfoam-1", mu_1_pa=300.0, alpha_1=-2.0, beta_1=0.5)
    for F in np.eye(3) + rng.uniform(-0.3, 0.3, (5, 3, 3)):
        C = F.T @ F
        second = (np.trace(C) ** 2 - np.trace(C @ C)) / 2
        ratio = np.linalg.det(F)
        expected = 150.0 * (second / ratio**2 + 2 * ratio - 5)
        assert law.evaluate(F)[0].item() == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("beta", [0.0, 1e-6, 1e-4, 2e-3, 0.02])
def test_foam_without_lateral_strain(beta):
    """At β = 0 a uniaxial stretch has no lateral stress, and small β is no exception."""
    law = Law("hyperfoam-1", mu_1_pa=300.0, alpha_1=4.0, beta_1=beta)
    for stretch in (0.5, 0.9, 1.0, 1.4):
        stretches = np.array([stretch, 1.0, 1.0])
        found = np.diag(law.piola(np.diag(stretches))) * stretches
        expected = kirchhoff_of_foam(stretches, ((300.0, 4.0, beta),))
        np.testing.assert_allclose(found, expected, atol=1e-8)
    slope = Law("hyperfoam-1", mu_1_pa=300.0, alpha_1=4.0, beta_1=beta).evaluate(
        np.diag([0.7, 1.0, 1.0])
    )[3]
    # ∂τ/∂β = 2μ ln J J^(−αβ)
    expected = 2 * 300.0 * np.log(0.7) * 0.7 ** (-4.0 * beta)
    assert slope[4, 2] == pytest.approx(expected, rel=1e-7)


def test_zero_exponents_are_finite():
    """Ogden's term vanishes at α = 0, Hill's becomes that of logarithmic strains."""
    assert Law("ogden-2", alpha_2=0.0).evaluate(np.diag([1.3, 0.9, 0.9]))[1] == pytest.approx(
        Law("ogden-2", mu_2_pa=0.0).evaluate(np.diag([1.3, 0.9, 0.9]))[1], rel=1e-9
    )
    stretches = np.array([1.3, 0.9, 0.8])
    stress = np.diag(Law("hyperfoam-1", alpha_1=0.0).piola(np.diag(stretches))) * stretches
    logs = np.log(stretches)
    # τ = 2μ (ln λᵢ + β ln J)
    np.testing.assert_allclose(stress, 600.0 * (logs + logs.sum() / 3), rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "shear", "bulk"),
    [
        *((f"ogden-{n}", sum(mu * a for mu, a in t) / 2, KAPPA_PA) for n, t in OGDEN.items()),
        *(
            (
                f"hyperfoam-{n}",
                sum(mu for mu, _, _ in t),
                sum(2 * mu * (1 / 3 + b) for mu, _, b in t),
            )
            for n, t in HYPERFOAM.items()
        ),
    ],
)
def test_moduli_at_small_strain(name, shear, bulk):
    lam, mu = MATERIALS[name].lame([*CONSTANTS[name].values()]).full().ravel()
    assert mu == pytest.approx(shear, rel=1e-11)
    assert lam + 2 / 3 * mu == pytest.approx(bulk, rel=1e-11)
    if name == "hyperfoam-1":  # the beta of one term is ν/(1 − 2ν)
        assert engineering_constants(lam, mu)[1] == pytest.approx((1 / 3) / (1 + 2 / 3), rel=1e-10)


# Kernels ---------------------------------------------------------------------------------------


def laws_with_and_without_the_chain_rule(name: str) -> tuple[Material, Material]:
    """A material, and the same energy as a user's function, which is differentiated by F."""
    material = MATERIALS[name]
    plain = Material("plain", lambda F, **c: material.energy(F, **c), material.constants)
    return material, plain


def assert_alike(found: object, expected: object) -> None:
    """Compare all arrays of two dataclasses."""
    for name, value in vars(expected).items():
        assert relative_error(np.asarray(getattr(found, name)), np.asarray(value)) < 1e-8, name


@pytest.mark.long
@pytest.mark.parametrize(
    "changes",
    [
        pytest.param({"field": Field(0.05, modes=2)}, id="field"),
        pytest.param({"prony": ["prony_1"]}, id="memory"),
    ],
)
@pytest.mark.parametrize("name", ["ogden-2", "hyperfoam-1"])
def test_kernels_with_the_chain_rule_agree_with_those_without(name, changes, rng):
    mesh = box_mesh((0.06, 0.06, 0.06), (1, 1, 2))
    ours, theirs = (
        Body(mesh, law, density_kg_m3=30.0, evaluator="casadi", **changes)
        for law in laws_with_and_without_the_chain_rule(name)
    )
    others = {"gamma_r_s": 0.009, "gamma_m_1_s": 1.0, "prony_1.share": 0.3, "prony_1.tau_s": 0.2}
    others |= {"field_1": 0.4, "field_2": -0.3}
    values = {**CONSTANTS[name], **{k: v for k, v in others.items() if k in ours.constants}}
    theta = ours.theta_from_values(values)
    x = ours.nodes_m + rng.uniform(-0.003, 0.003, ours.nodes_m.shape)
    v, w = rng.standard_normal((2, *x.shape))
    assert_alike(ours.linearise(x, v, theta), theirs.linearise(x, v, theta))
    assert_alike(ours.second_derivatives(x, v, w, theta), theirs.second_derivatives(x, v, w, theta))


@pytest.mark.long
@pytest.mark.parametrize("name", ["ogden-2", "hyperfoam-1"])
def test_stresses_of_a_memory_agree_with_those_without_the_chain_rule(name, rng):
    mesh = box_mesh((0.06, 0.06, 0.06), (1, 1, 2))
    ours, theirs = (
        Body(mesh, law, density_kg_m3=30.0, prony=["prony_1"], evaluator="casadi")
        for law in laws_with_and_without_the_chain_rule(name)
    )
    others = {"gamma_r_s": 0.009, "gamma_m_1_s": 1.0, "prony_1.share": 0.3, "prony_1.tau_s": 0.2}
    theta = ours.theta_from_values({**CONSTANTS[name], **others})
    x = (ours.nodes_m + rng.uniform(-0.003, 0.003, ours.nodes_m.shape)).reshape(1, -1)
    v = rng.standard_normal(x.shape)
    weights = rng.standard_normal((1, ours.stresses.width))
    directions = np.eye(len(theta))
    results = [
        (
            body.stresses.stress(x, theta),
            body.stresses.stress_jvp(x, v, theta),
            body.stresses.stress_vjp(x, weights, theta),
            body.stresses.stress_jacobian(x, theta),
            body.stresses.stress_theta_derivatives(x, theta, directions),
        )
        for body in (ours, theirs)
    ]
    for found, expected in zip(*results, strict=True):
        assert relative_error(found, expected) < 1e-8


@pytest.mark.long
@pytest.mark.parametrize("element", ["tet4", "tet10-p0"])
def test_a_stress_free_shape_agrees_with_that_without_the_chain_rule(element, rng):
    """The constants also act through the shape, which is solved for."""
    mesh = box_mesh((0.06, 0.03, 0.03), (3, 1, 1))
    constants = scaled(CONSTANTS["ogden-2"], 100.0)
    ours, theirs = (
        Body(
            mesh,
            law,
            density_kg_m3=300.0,
            element=element,
            evaluator="casadi",
            rest_shape=as_scanned(mesh),
        )
        for law in laws_with_and_without_the_chain_rule("ogden-2")
    )
    theta = ours.theta_from_values({**constants, "gamma_r_s": 0.009, "gamma_m_1_s": 1.0})
    x = ours.nodes_m + rng.uniform(-0.001, 0.001, ours.nodes_m.shape)
    v, w = rng.standard_normal((2, *x.shape))
    assert_alike(ours.linearise(x, v, theta), theirs.linearise(x, v, theta))
    assert_alike(ours.second_derivatives(x, v, w, theta), theirs.second_derivatives(x, v, w, theta))


def scaled(constants: dict[str, float], factor: float) -> dict[str, float]:
    """Constants with all moduli multiplied by a factor."""
    return {n: v * factor if n.endswith("_pa") else v for n, v in constants.items()}
