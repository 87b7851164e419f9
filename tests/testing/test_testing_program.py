"""`check_program`: right programs pass, and the term with a wrong derivative is named."""

from __future__ import annotations

from dataclasses import replace

import pytest
from kit.problems import (
    GUESS,
    bar_loaded,
    bar_with_nuisance,
    hung_cube,
    measured,
    pressed_cube,
    with_papers_damping,
)
from kit.sensors import accelerometer, instrumented, strain_gauge
from kit.static import HANGING, block

import collocation_sysid as cs
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.laws.constants import GAMMA_R
from collocation_sysid.fem.laws.materials import material_form
from collocation_sysid.model.contact.force import Contact
from collocation_sysid.model.point_forces import CustomForce
from collocation_sysid.program.custom_sensor_residual import CustomSensorResidual
from collocation_sysid.recording import Experiment
from collocation_sysid.runs.derivatives import ORDERS, RATE_TOLERANCE
from collocation_sysid.testing import check_program

SMALL = {
    "hung": lambda: hung_cube(5, (1, 1, 2)),
    "static": lambda: block("xyz", gravity_m_s2=HANGING),
    "contact": lambda: pressed_cube(friction=0.5),
    "loads": lambda: bar_loaded(6),
    "paper's damping": lambda: with_papers_damping(hung_cube(5, (1, 1, 2))),
    "nuisance": lambda: bar_with_nuisance(5),
}


@pytest.mark.parametrize("name", SMALL)
@pytest.mark.parametrize("huber", [None, 1.0])
def test_right_problems_pass_with_the_rate_of_each_derivative(name: str, huber: float | None):
    rates = check_program(cs.Problem([SMALL[name]()], GUESS, huber=huber))
    assert set(rates) == set(ORDERS)
    assert all(rate > ORDERS[each] - RATE_TOLERANCE for each, rate in rates.items())


def stated_wrongly(psi, F, rate, gamma_r_s):
    stress, slope = material_form(psi, F, rate, gamma_r_s)
    return stress, 1.01 * slope


def with_wrong_damping(monkeypatch) -> Experiment:
    law = cs.DampingLaw("mine", (GAMMA_R,), stress=stated_wrongly)
    swung = hung_cube(5, (1, 1, 2))
    return replace(swung, body=cs.Body(swung.body.mesh, density_kg_m3=30.0, damping=law))


def scale_slopes(monkeypatch, kind: type, method: str = "add_derivatives") -> None:
    """Multiply by 1.01 what a force adds to the derivatives by the positions."""
    right = getattr(kind, method)

    def wrong(self, linearisation, *args, **settings):
        before = linearisation.by_position.copy()
        right(self, linearisation, *args, **settings)
        linearisation.by_position[:] += 0.01 * (linearisation.by_position - before)

    monkeypatch.setattr(kind, method, wrong)


def with_wrong_material(monkeypatch) -> Experiment:
    right = Body.linearise

    def wrong(self, *args, **settings):
        found = right(self, *args, **settings)
        found.by_position[:] *= 1.01
        return found

    monkeypatch.setattr(Body, "linearise", wrong)
    return hung_cube(5, (1, 1, 2))


def with_wrong_force(monkeypatch) -> Experiment:
    scale_slopes(monkeypatch, CustomForce)
    stiff = cs.NodeForce.from_law(lambda x, v, at: -50.0 * at.volume_m3 * x, name="strut")
    swung = hung_cube(5, (1, 1, 2))
    return replace(swung, body=cs.Body(swung.body.mesh, density_kg_m3=30.0, forces=[stiff]))


def with_wrong_obstacle(monkeypatch) -> Experiment:
    scale_slopes(monkeypatch, Contact)
    return pressed_cube()


def with_wrong_sensor(monkeypatch) -> Experiment:
    right = CustomSensorResidual.loss_gradient

    def wrong(self, *args):
        by_observables, by_phi = right(self, *args)
        return 1.01 * by_observables, by_phi

    monkeypatch.setattr(CustomSensorResidual, "loss_gradient", wrong)
    swung = measured(hung_cube(8, (1, 1, 2)))
    return instrumented(swung, strain_gauge(swung.t_s), accelerometer(swung.t_s[2:-2]))


WRONG = {
    "constraints is wrong in the material 'neo-hookean' of exp": with_wrong_material,
    "constraints is wrong in the damping law 'mine' of experiment": with_wrong_damping,
    "constraints is wrong in the force 'strut' of experiment": with_wrong_force,
    "constraints is wrong in the obstacle 'ball' of experiment": with_wrong_obstacle,
    "loss is wrong in the measurement 'foil' of experiment": with_wrong_sensor,
}


@pytest.mark.parametrize("sentence", WRONG)
def test_the_term_with_a_wrong_derivative_is_named(sentence: str, monkeypatch):
    experiment = WRONG[sentence](monkeypatch)
    expected = (
        rf"The first derivative of the {sentence}.* of order (0\.[5-9]|1\.[0-4])\d in the step"
    )
    with pytest.raises(AssertionError, match=expected):
        check_program(cs.Problem([experiment], GUESS))
