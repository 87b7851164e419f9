"""User-defined damping laws: refused laws, and constants with bounds, scale and usual value of
their own.
"""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

import collocation_sysid as cs
from collocation_sysid.errors import InputError

ETA = cs.Constant("eta_pa_s", "η", "viscosity", bounds=(0.5, 50.0), usual=4.0)
BETA = cs.Constant("growth", "β", bounds=(-2.0, 3.0), scale="linear", typical=0.1, at_least=-2)


def viscous(F: ca.SX, rate: ca.SX, eta: ca.SX) -> ca.SX:
    """Return the stress 2η F Ė (3, 3) of F and its rate, both (9,)."""
    gradient = ca.reshape(F, 3, 3)
    velocity = ca.reshape(rate, 3, 3)
    return eta * gradient @ (velocity.T @ gradient + gradient.T @ velocity)


def linear(psi, F, rate, eta_pa_s):
    stress = ca.vec(viscous(F, rate, eta_pa_s))
    return stress, ca.jacobian(stress, F)


def growing(psi, F, rate, eta_pa_s, growth):
    stress = ca.vec(viscous(F, rate, eta_pa_s * (1 + growth * ca.det(ca.reshape(F, 3, 3)))))
    return stress, ca.jacobian(stress, F)


def thickening(psi, F, rate, eta_pa_s):
    size = ca.sqrt(ca.sumsqr(rate) + 1e-12)
    stress = ca.vec(viscous(F, rate, eta_pa_s)) * (1 + 1e-3 * size)
    return stress, ca.jacobian(stress, F)


def constant_force(psi, F, rate, eta_pa_s):
    stress = ca.vec(viscous(F, rate, eta_pa_s)) + F
    return stress, ca.jacobian(stress, F)


def lone_stress(psi, F, rate, eta_pa_s):
    return linear(psi, F, rate, eta_pa_s)[0]


def matrix_stress(psi, F, rate, eta_pa_s):
    stress = viscous(F, rate, eta_pa_s)
    return stress, ca.jacobian(ca.vec(stress), F)


def misspelt(psi, F, rate, eta):
    return linear(psi, F, rate, eta)


def quadratic_potential(psi, F, rate, eta_pa_s):
    return eta_pa_s * ca.jtimes(psi, F, rate) ** 2


def vector_potential(psi, F, rate, eta_pa_s):
    return eta_pa_s * rate


def body_with(law: cs.DampingLaw) -> cs.Body:
    """Return a small box that obeys a damping law."""
    mesh = cs.box_mesh((0.04, 0.04, 0.08), (1, 1, 2))
    return cs.Body(mesh, density_kg_m3=1000.0, damping=law)


@pytest.mark.parametrize(
    ("functions", "words"),
    [
        ({"stress": thickening}, "is not linear in the rate: .* 0.0"),
        ({"stress": constant_force}, "is not linear in the rate"),
        ({"potential": quadratic_potential}, "is not linear in the rate"),
        (
            {"stress": lone_stress},
            r"returns 1 expressions of the shapes \[\(9, 1\)\]; expected two",
        ),
        ({"stress": matrix_stress}, r"returns 2 .*\[\(3, 3\), \(9, 9\)\]"),
        ({"stress": misspelt}, r"'eta_pa_s'\); expected a function \(psi, F, rate, eta_pa_s\)"),
        ({"potential": misspelt}, "the potential of .* cannot be evaluated"),
        ({"potential": vector_potential}, r"an expression of the shape \(9, 1\)"),
    ],
)
def test_a_body_refuses_a_law(functions: dict, words: str):
    with pytest.raises(InputError, match=f"damping law 'own'.*{words}|{words}"):
        body_with(cs.DampingLaw("own", (ETA,), **functions))


@pytest.mark.parametrize("names", [("mu_pa",), ("young_pa",), ("gamma_m_1_s",), ("growth",) * 2])
def test_a_constant_needs_a_name_of_its_own(names: tuple[str, ...]):
    constants = tuple(cs.Constant(name) for name in names)
    law = cs.DampingLaw("own", constants, stress=linear)
    with pytest.raises(InputError, match=f"'{names[0]}', but another constant of the body"):
        body_with(law)


def test_an_admissible_law_is_accepted_in_a_body_and_in_a_region():
    law = cs.DampingLaw("own", (ETA,), stress=linear)
    assert "eta_pa_s" in body_with(law).constants
    mesh = cs.box_mesh((0.04, 0.04, 0.08), (1, 1, 2))
    cells = np.arange(len(mesh.tetrahedra)) < 6
    half = cs.Region("core", cells, damping=law)
    body = cs.Body(mesh, density_kg_m3=1000.0, regions=[half])
    assert "core.eta_pa_s" in body.constants
    fast = cs.DampingLaw("fast", (ETA,), stress=thickening)
    with pytest.raises(InputError, match=r"fast.*not linear"):
        cs.Body(mesh, density_kg_m3=1000.0, regions=[cs.Region("core", cells, damping=fast)])


def test_a_law_needs_a_function_and_constants():
    with pytest.raises(InputError, match="neither a stress nor a potential"):
        cs.DampingLaw("own", (ETA,))
    with pytest.raises(
        InputError, match=r"'own': constants\[0\] is 'eta_pa_s'; expected .*Constant"
    ):
        cs.DampingLaw("own", ("eta_pa_s",), stress=linear)  # type: ignore[arg-type]
    assert cs.DampingLaw("own", ETA, stress=linear).constants == (ETA,)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"bounds": (0.0, 1.0)}, "are 0 and 1; expected 0 < lower < upper"),
        ({"bounds": (3.0, 2.0)}, "are 3 and 2; expected 0 < lower < upper"),
        ({"bounds": (1.0, -1.0), "scale": "linear"}, "are 1 and -1; expected lower < upper$"),
        ({"scale": "lin"}, "is 'lin'; expected 'log' or 'linear'"),
    ],
)
def test_a_constant_refuses_bounds_and_scale(changes: dict, words: str):
    with pytest.raises(InputError, match=f"(?i)constant 'eta_pa_s'.*{words}"):
        cs.Constant("eta_pa_s", **changes)


def swung(law: cs.DampingLaw) -> cs.Experiment:
    """Return a swing of the box without measurements but markers at zero."""
    t_s = np.linspace(0.0, 0.2, 11)
    way_m = 0.02 * (1 - np.cos(20 * t_s))
    hand = cs.PoseSequence(t_s, np.outer(way_m, [1, 0, 0]), np.tile([0, 0, 0, 1.0], (len(t_s), 1)))
    body = body_with(law)
    low_m = body.nodes_m[body.nodes_m[:, 2] < 0.001]
    tracks = np.zeros((len(t_s), len(low_m), 3))
    return cs.Experiment(
        body,
        t_s,
        [cs.Grasp(np.flatnonzero(body.nodes_m[:, 2] > 0.079), hand)],
        cs.Markers(t_s, tracks, 1e-4, places_m=low_m),
        nuisance=cs.Nuisance.none(),
        air_density_kg_m3="none",
    )


KNOWN = {"young_pa": 2e4, "poisson": 0.4, "gamma_m_1_s": 0.1}
GROWING = cs.DampingLaw("growing", (ETA, BETA), stress=growing)


def test_omitted_bounds_scale_and_guess_are_those_of_the_constant():
    statements = {**KNOWN, "eta_pa_s": cs.Unknown(), "growth": cs.Unknown(0.3, upper=1.0)}
    problem = cs.Problem([swung(GROWING)], statements)
    items = {item.name: item for item in problem.parameters.scalars}
    eta = items["eta_pa_s"]
    assert (eta.guess, eta.lower, eta.upper, eta.scale) == (4.0, 0.5, 50, "log")
    growth = items["growth"]
    assert (growth.lower, growth.upper) == (-2.0, 1.0)
    assert (growth.scale, growth.unit) == ("linear", 0.1)
    made = cs.Parameters.from_mapping(statements, definitions=problem.bodies[0].constants)
    assert made.scalars == problem.parameters.scalars


def test_a_region_without_a_value_of_its_own_uses_the_same_definition():
    made = cs.Parameters.from_mapping(
        {"eta_pa_s": cs.Unknown(1.0), "core.eta_pa_s": cs.Unknown(2.0)},
        definitions={"core.eta_pa_s": ETA},
    )
    assert [item.upper for item in made.scalars] == [50.0, 50.0]


def test_a_prior_of_the_constant_replaces_a_guess():
    constant = cs.Constant("eta_pa_s", prior=(3.0, 0.1))
    (item,) = cs.Parameters.from_mapping(
        {"eta_pa_s": cs.Unknown()}, definitions={"eta_pa_s": constant}
    ).scalars
    assert item.prior == (3.0, 0.1)
    assert item.guess is None


@pytest.mark.parametrize("statement", [-2.5, cs.Unknown(0.1, lower=-3.0)], ids=["fixed", "lower"])
def test_values_that_a_constant_does_not_admit_are_refused(statement):
    with pytest.raises(InputError, match=r"growth: .*expected a number -2 <="):
        cs.Problem([swung(GROWING)], {**KNOWN, "eta_pa_s": 2.0, "growth": statement})


def test_a_linear_constant_may_be_negative_and_is_found():
    truth = {**KNOWN, "eta_pa_s": 20.0, "growth": -0.5}
    swing = swung(GROWING)
    motion = cs.simulate(swing, truth, "midpoint", substeps=1)
    seen = cs.with_markers(swing, motion.markers_m)
    guesses = {"growth": cs.Unknown(0.2)}
    solution = cs.solve(cs.Problem([seen], truth | guesses))
    assert solution.status.converged
    assert abs(solution.parameters["growth"] + 0.5) < 1e-3


def test_an_estimate_stops_at_the_bound_of_its_constant():
    truth = {**KNOWN, "eta_pa_s": 200.0}
    law = cs.DampingLaw("own", (ETA,), stress=linear)
    swing = swung(law)
    motion = cs.simulate(swing, truth, "midpoint", substeps=1)
    seen = cs.with_markers(swing, motion.markers_m)
    solution = cs.solve(cs.Problem([seen], truth | {"eta_pa_s": cs.Unknown(5.0)}))
    assert solution.parameters["eta_pa_s"] == pytest.approx(50.0)
