"""Errors of a test over time look like memory; the intervals contain them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import collocation_sysid as cs
from collocation_sysid.program.simulation import with_readings

TRUTH = {"young_pa": 2e5, "poisson": 0.495, "a.share": 0.4, "a.tau_s": 0.3}
CONSTANTS = TRUTH | {"gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
TIMES = np.arange(0.0, 6.0, 0.05)
DELAY_S, DRIFT = 5e-3, 0.02


def strains(t_s):
    """Strains of an oscillation at 1 Hz that begins slowly."""
    share = np.minimum(t_s / 3, 1)
    return share * (0.05 + 0.03 * np.sin(2 * np.pi * t_s))


def specimen(strain, t_s=TIMES) -> cs.Experiment:
    keys = {"t_s": t_s, "sigma_pa": 20.0, "strain_zero": 0.0, "area_error": 0.0}
    return cs.Specimen("uniaxial", strain, 0 * strain, **keys).experiment(prony=("a",))


def interval(test: cs.Experiment, tau_s: float, **assumptions) -> tuple[float, float]:
    """95 % interval of the relaxation time; other assumptions than those stated are exact."""
    unknown = {name: cs.Unknown() for name in ("young_pa", "a.share", "a.tau_s")}
    problem = cs.Problem([test], CONSTANTS | {"a.tau_s": tau_s} | unknown)
    exact = replace(cs.Assumptions.exact(), **assumptions)
    options = replace(problem.uncertainty, assumptions=exact)
    return cs.run(replace(problem, uncertainty=options), seek_causes=False).interval("a.tau_s")


def test_the_interval_contains_the_relaxation_time_of_a_late_load():
    late = cs.simulate(specimen(strains(TIMES - DELAY_S)), CONSTANTS).custom_sensor_values
    recorded = with_readings(specimen(strains(TIMES)), late)
    low, high = interval(recorded, 0.3, specimen_delay_s=DELAY_S)
    assert low < 0.3 < high
    assert interval(recorded, 0.3)[0] > 0.3


def test_a_late_sensor_of_a_body_with_memory_is_estimated():
    body = cs.Body(cs.box_mesh((0.02,) * 3, (1, 1, 2)), density_kg_m3=1e3, prony=("a",))
    z_m = body.nodes_m[:, 2]

    def pressed(t_s, wrenches_n) -> cs.Experiment:
        poses = np.tile(np.eye(4), (len(t_s), 1, 1))
        poses[:, 2, 3] = -0.02 * strains(t_s)
        wrench = cs.Wrench(TIMES, wrenches_n, sigma_n=0.05, sigma_nm=1.0)
        held = cs.Grasp(np.flatnonzero(z_m < 1e-9), cs.PoseSequence.fixed())
        moved = cs.Grasp(
            np.flatnonzero(z_m > 0.02 - 1e-9), cs.PoseSequence.from_matrices(TIMES, poses)
        )
        grasps = [held, replace(moved, wrench=wrench)]
        return cs.Experiment(body, TIMES, grasps, kind="static", nuisance=cs.Nuisance.none())

    late = cs.simulate(pressed(TIMES - DELAY_S, np.zeros((len(TIMES), 6))), CONSTANTS).wrenches[0]
    recorded = pressed(TIMES, late)
    clock = cs.Nuisance.none(sensor_time_s=DELAY_S)
    low, high = interval(replace(recorded, nuisance=clock), 0.3)
    assert low < 0.3 < high
    assert interval(recorded, 0.3)[0] > 0.3


def test_the_interval_contains_the_relaxation_time_of_a_drifting_load():
    t_s = np.arange(0.0, 60.0, 0.4)
    held = specimen(0.05 * np.minimum(t_s / 2, 1), t_s)
    (stress_pa,) = cs.simulate(held, CONSTANTS | {"a.tau_s": 30.0}).custom_sensor_values
    drifting = stress_pa * (1 - DRIFT * t_s[:, None] / t_s[-1])
    recorded = with_readings(held, [drifting])
    low, high = interval(recorded, 30.0, load_drift=DRIFT)
    assert low < 30.0 < high
    assert interval(recorded, 30.0)[0] > 30.0


def test_tables_of_moduli_have_no_clock():
    t_s = np.geomspace(1e-3, 10.0, 30)
    modulus_pa = 2e5 * (1 + 0.4 * np.exp(-t_s / 0.3))
    table = cs.Specimen.relaxation(t_s, modulus_pa, 1e3).experiment(prony=("a",))
    exact = interval(table, 0.3)
    assert exact[0] < 0.3 < exact[1]
    assert interval(table, 0.3, specimen_delay_s=DELAY_S, load_drift=DRIFT) == exact


def test_a_single_sample_has_no_pace():
    unknown = CONSTANTS | {"young_pa": cs.Unknown()}
    test = with_readings(specimen(np.array([0.05]), np.zeros(1)), [np.array([[1e4]])])
    run = cs.run(cs.Problem([test], unknown), seek_causes=False)
    assert abs(run.parameters["young_pa"] / (1e4 / 0.05) - 1) < 0.1
