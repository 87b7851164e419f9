"""Mean stresses of the elements as unknowns of the time steps of nearly incompressible bodies."""

from __future__ import annotations

import numpy as np
import pytest
from kit.problems import nodes_where
from kit.rods import cable, ends, straight

from collocation_sysid import (
    Body,
    Experiment,
    Grasp,
    Markers,
    Nuisance,
    PoseSequence,
    box_mesh,
    simulate,
)
from collocation_sysid.kinds.rod.element import CrossSection
from collocation_sysid.model.parameters import Parameters
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.program.forward.newton_linearisation import LaggedStress
from collocation_sysid.program.linear_algebra.factorisation import Factoriser
from collocation_sysid.program.modes.stability import find_instabilities

SIZE_M = (0.03, 0.03, 0.09)
MODULI = {"gamma_r_s": 5e-3, "gamma_m_1_s": 0.1}


def bar(element: str = "tet10-p0", damping: str = "rayleigh") -> Body:
    mesh = box_mesh(SIZE_M, (1, 1, 2))
    return Body(mesh, density_kg_m3=1000.0, element=element, damping=damping)


def deformed(body: Body) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    x = body.nodes_m.ravel() + 5e-4 * rng.normal(size=body.nodes_m.size)
    return x, 0.1 * rng.normal(size=x.size)


def volume_slopes(body: Body, x: np.ndarray, stress_pa: np.ndarray) -> np.ndarray:
    """Derivative of Σ σ_e v_e by the positions, by central differences."""

    def total(state: np.ndarray) -> float:
        return stress_pa @ (body.volume_ratios(state)[0] * body.geometry[..., -1]).sum(axis=1)

    steps = 1e-7 * np.eye(x.size)
    return np.array([(total(x + step) - total(x - step)) / 2e-7 for step in steps])


@pytest.mark.parametrize("element", ["tet4", "tet10-p0"])
def test_the_volume_stiffness_is_the_derivative_of_the_slopes_of_the_volumes(element):
    body = bar(element)
    x, direction = deformed(body)
    stress_pa = np.random.default_rng(1).normal(size=len(body.cells))
    stiffness = body.pattern.matrix(body.volume_stiffness(x, stress_pa))
    slopes = [volume_slopes(body, x + h * direction, stress_pa) for h in (1e-4, -1e-4)]
    expected = (slopes[0] - slopes[1]) / 2e-4
    np.testing.assert_allclose(stiffness @ direction, expected, atol=1e-5 * abs(expected).max())


@pytest.mark.parametrize("element", ["tet4", "tet10-p0"])
def test_a_larger_bulk_modulus_adds_the_forces_of_the_mean_stresses(element):
    body = bar(element)
    x, _ = deformed(body)
    still = np.zeros_like(x)
    thetas = [
        body.theta_from_values(MODULI | {"mu_pa": 1e4, "lambda_pa": value}) for value in (3e5, 4e5)
    ]
    stresses = [body.mean_stresses(x[None], still[None], theta) for theta in thetas]
    forces = [body.force(x, still, theta)[0] for theta in thetas]
    added = -volume_slopes(body, x, stresses[1] - stresses[0])
    np.testing.assert_allclose(forces[1] - forces[0], added, atol=1e-6 * abs(added).max())


def swayed(damping: str) -> Experiment:
    body = bar(damping=damping)
    t_s = np.arange(5) / 120
    sway_m = np.outer(0.03 * (1 - np.cos(20 * t_s)), [1.0, 0.5, 0.3])
    poses = PoseSequence(t_s, sway_m, np.tile([0.0, 0.0, 0.0, 1.0], (len(t_s), 1)))
    markers = Markers(t_s, np.zeros((len(t_s), 1, 3)), 1e-3, places_m=[body.nodes_m[0]])
    grasp = Grasp(nodes_where(body, 2, SIZE_M[2]), poses)
    return Experiment(body, t_s, [grasp], markers, nuisance=Nuisance.none())


def moved(damping: str, poisson: float) -> np.ndarray:
    truth = MODULI | {"young_pa": 2e4, "poisson": poisson}
    return simulate(swayed(damping), truth, "bdf2", substeps=1).positions_m


@pytest.mark.parametrize(
    ("damping", "poisson", "most"), [("rayleigh", 0.499, 50), ("kelvin-voigt", 0.4999, 100)]
)
def test_steps_of_a_nearly_incompressible_body_take_few_factorisations(
    damping, poisson, most, monkeypatch
):
    factorised = []
    factorise = Factoriser.factorise

    def counting(self, *matrix, **options):
        factorised.append(self)
        return factorise(self, *matrix, **options)

    monkeypatch.setattr(Factoriser, "factorise", counting)
    moved(damping, poisson)
    assert len(factorised) <= most  # 127 and 329 with the stresses of the iterates


def test_the_stresses_change_the_way_to_a_solution_and_not_the_solution(monkeypatch):
    with_stresses_m = moved("rayleigh", 0.49)
    monkeypatch.setattr(LaggedStress, "replace_stress", lambda self, at, x, stress_pa: at)
    np.testing.assert_allclose(moved("rayleigh", 0.49), with_stresses_m, atol=1e-9)


# Slender bodies ----------------------------------------------------------------------------------


def whip(step_s: float = 0.01) -> Experiment:
    """A cable of 0.6 m that hardly stretches, moved to and fro by a hand."""
    mesh = straight(0.6, CrossSection.round(0.006), 16, (0, 0, -1))
    body = cable(mesh)
    t_s = np.arange(0, 0.4 + step_s / 2, step_s)
    sway_m = np.outer(0.08 * (1 - np.cos(12 * t_s)), [1.0, 0.5, 0.3])
    poses = PoseSequence(t_s, sway_m, np.tile([0.0, 0.0, 0.0, 1.0], (len(t_s), 1)))
    return Experiment(
        body,
        t_s,
        [Grasp(ends(body)[0], poses)],
        Markers(t_s, np.zeros((len(t_s), 1, 3)), 1e-3, places_m=[mesh.place_m(0.6)]),
        nuisance=Nuisance.none(),
        air_density_kg_m3="none",
    )


STIFF = {"bending_n_m2": 1e-3, "torsion_n_m2": 3e-4, "axial_n": 5e4} | {
    "gamma_r_s": 2e-3,
    "gamma_m_1_s": 0.3,
}


def test_steps_of_a_cable_that_hardly_stretches_take_few_factorisations(monkeypatch):
    solutions = []
    factorised = []
    factorise = Factoriser.factorise
    monkeypatch.setattr(
        Factoriser, "factorise", lambda *a, **k: factorised.append(a) or factorise(*a, **k)
    )
    solutions.append(simulate(whip(), STIFF, "midpoint", substeps=1).positions_m)
    assert len(factorised) <= 4 * 40
    few = len(factorised)
    monkeypatch.setattr(LaggedStress, "replace_stress", lambda self, at, x, stress_pa: at)
    solutions.append(simulate(whip(), STIFF, "midpoint", substeps=1).positions_m)
    assert len(factorised) > 3 * few
    np.testing.assert_allclose(*solutions, atol=1e-8)


def test_a_free_cable_that_hardly_stretches_tumbles():
    """About two axes, by 0.06 rad a step, with the steps of a solve."""
    mesh = straight(1.0, CrossSection.round(0.004), 11)
    body = cable(mesh)
    t_s = np.arange(0, 1.005, 0.01)
    thrown = Experiment(
        body,
        t_s,
        [],
        Markers(t_s, np.zeros((len(t_s), 1, 3)), 1e-3, places_m=[mesh.place_m(0.0)]),
        gravity_m_s2=(0.0, 0.0, 0.0),
        start="undeformed",
        start_spin_rad_s=(3.0, 5.0, 10.0),
        start_velocity_m_s=(1.0, 0.3, 0.0),
        air_density_kg_m3="none",
        nuisance=Nuisance.none(),
    )
    values = STIFF | {"bending_n_m2": 0.02, "gamma_r_s": 5e-4, "gamma_m_1_s": 0.0}
    x = simulate(thrown, values, "midpoint", substeps=2).positions_m
    middle, rate = (x[1:] + x[:-1]) / 2, np.diff(x, axis=0) / 0.01
    mass_kg = body.node_mass[:, None]
    momentum = (mass_kg * rate).sum(axis=1)
    np.testing.assert_allclose(momentum, momentum[:1].repeat(len(rate), axis=0), atol=1e-9)
    centre_m = (mass_kg * middle).sum(axis=1, keepdims=True) / mass_kg.sum()
    spin = (mass_kg * np.cross(middle - centre_m, rate)).sum(axis=1)
    assert np.abs(spin - spin[0]).max() < 2e-3 * np.linalg.norm(spin[0])
    energy_j = (mass_kg * rate**2).sum(axis=(1, 2)) / 2
    np.testing.assert_allclose(energy_j, energy_j[0], rtol=0.01)


def test_elastic_and_viscous_stresses_that_cancel_are_no_instability():
    """At the ends of coarse steps the volumes of a turning body are off, and between them the
    elastic mean stresses: K is not positive definite there without the viscous ones.
    """
    body = bar(damping="kelvin-voigt")
    t_s = np.arange(7) / 60
    sway_m = np.outer(0.03 * (1 - np.cos(20 * t_s)), [1.0, 0.5, 0.3])
    poses = PoseSequence(t_s, sway_m, np.tile([0.0, 0.0, 0.0, 1.0], (len(t_s), 1)))
    markers = Markers(t_s, np.zeros((len(t_s), 1, 3)), 1e-3, places_m=[body.nodes_m[0]])
    grasp = Grasp(nodes_where(body, 2, SIZE_M[2]), poses)
    experiment = Experiment(body, t_s, [grasp], markers, nuisance=Nuisance.none())
    values = MODULI | {"young_pa": 2e4, "poisson": 0.4999}
    x = simulate(experiment, values, "midpoint", substeps=1).positions_m
    collocation = Collocation([experiment], Parameters.from_mapping(values))
    assert (
        find_instabilities(collocation, collocation.pack(np.zeros(0), [x.reshape(len(x), -1)]))
        == ()
    )
