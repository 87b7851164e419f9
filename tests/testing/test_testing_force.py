"""`check_force`: forces of every kind pass, and each fault is one sentence."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import pytest
from kit.forces import breath, foundation
from kit.problems import uneven_box
from kit.program_derivatives import require_derivatives

import collocation_sysid as cs
from collocation_sysid.fem.node_force import unit_drag
from collocation_sysid.testing import check_force
from collocation_sysid.testing.property_check import PropertyCheck
from collocation_sysid.testing.small_problems import DENSITY_KG_M3, program_of, swung_experiment


def drag(x, v, at, drag_coefficient):
    return -0.6 * drag_coefficient * at.area_m2 * ca.sqrt(ca.sumsqr(v) + 1e-4) * v


def bed(x, v, at, bed_n_m3):
    return -bed_n_m3 * at.area_m2 * (x - at.rest_m)


def bed_energy(x, at, bed_n_m3):
    return bed_n_m3 * at.area_m2 * ca.sumsqr(x - at.rest_m) / 2


def lift(x, v, at, spin_n_s_m4):
    return spin_n_s_m4 * at.volume_m3 * ca.cross(v, ca.vertcat(0.5, 1.0, -0.3))


def suction(x, v, at, suction_pa):
    return suction_pa * ca.sin(20 * at.t_s) ** 2 * at.area_m2 * at.normal


def creeping(x, v, before, at, creep_n_m):
    share = 20 * at.interval_s / (1 + 20 * at.interval_s)
    after = before + (1 - at.is_start) * share * (x - at.rest_m - before)
    return -creep_n_m * at.volume_m3 * 1e4 * (x - at.rest_m - after), after


def quadratic_body() -> cs.Body:
    """A body with quadratic faces, on some of which a force acts."""
    force = cs.NodeForce.from_law(breath, nodes=cs.Box((-1, -1, -1), (1, 1, 0.051)), on="faces")
    mesh = cs.box_mesh((0.1, 0.1, 0.1), (1, 1, 2))
    return cs.Body(mesh, density_kg_m3=30.0, element="tet10", forces=[force])


FORCES = {
    "foundation": (foundation, {"constants": {"whirl_n_m3": 4e4}}),
    "breath": (cs.NodeForce.from_law(breath, on="faces"), {"is_dissipative": True}),
    "drag": (drag, {"is_dissipative": True, "is_zero_at_rest": True}),
    "bed": (bed, {"energy": bed_energy, "is_zero_at_rest": True, "is_dissipative": True}),
    "lift": (lift, {"is_dissipative": True, "is_zero_at_rest": True}),
    "suction": (cs.NodeForce.from_law(suction, on="faces"), {}),
    "air": (unit_drag(), {"is_dissipative": True, "is_zero_at_rest": True}),
    "creeping": (cs.NodeForce.from_law(creeping, carries=3), {"is_zero_at_rest": True}),
}


@pytest.mark.parametrize("name", FORCES)
def test_every_kind_of_force_passes(name: str):
    force, options = FORCES[name]
    check_force(force, **options)
    made = force if isinstance(force, cs.NodeForce) else cs.NodeForce.from_law(force)
    constants = options.get("constants", {})
    body = cs.Body(uneven_box(1), density_kg_m3=DENSITY_KG_M3, forces=[replace(made, nodes=None)])
    require_derivatives(PropertyCheck(name), program_of(swung_experiment(body), constants))


def test_programs_of_a_force_on_quadratic_faces_pass():
    require_derivatives(PropertyCheck("breath"), program_of(swung_experiment(quadratic_body()), {}))


def pushed(x, v, at, push_n_m):
    return -push_n_m * (x - at.rest_m) + 1e-3 * push_n_m * v


class WrongSign(cs.NodeForce):
    """A force that programs evaluate with another sign than its law."""

    def expression(self, u, data):
        return -super().expression(u, data)


@pytest.mark.parametrize(
    ("force", "options", "sentence"),
    [
        (
            bed,
            {"energy": lambda x, at, bed_n_m3: 2 * bed_energy(x, at, bed_n_m3)},
            r"'bed': the force is not −∂energy/∂x at random state 0, entry \(\d,\); found .*, exp",
        ),
        (pushed, {"is_dissipative": True}, r"'pushed': it adds energy .* expected at most 0 W"),
        (
            lambda x, v, at, push_n: ca.vertcat(push_n, 0, 0),
            {"is_zero_at_rest": True},
            r"the force at rest is not zero, entry \(0,\); found 1, expected 0",
        ),
        (WrongSign.from_law(bed), {}, r"'bed': the generated force is not the law at random state"),
    ],
)
def test_a_fault_is_one_sentence(force, options: dict, sentence: str):
    with pytest.raises(AssertionError, match=sentence):
        check_force(force, **options)


def test_an_energy_of_a_force_on_faces_is_refused():
    with pytest.raises(
        cs.InputError, match="'suction' is on faces, where an energy cannot be checked"
    ):
        check_force(cs.NodeForce.from_law(suction, on="faces"), energy=bed_energy)
