"""Pressed specimens whose platens may be dry: a row of the budget of specimens without a mesh."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import collocation_sysid as cs
from collocation_sysid.recording.homogeneous_deformation import shape_factor

YOUNG_PA = 1.7e6
CONSTANTS = {"poisson": 0.495, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
RADIUS_M, LENGTH_M = 0.012, 0.008
AREA_M2 = np.pi * RADIUS_M**2
STRAIN = -np.linspace(0.005, 0.05, 6)
STATED = {"length_m": LENGTH_M, "area_m2": AREA_M2}


@cache
def load_n() -> np.ndarray:
    """Loads (T,) of a disc of a finite-element mesh, three times as wide as high, whose faces stick
    to the platens.
    """
    mesh = cs.cylinder_mesh(RADIUS_M, LENGTH_M, rings=3, layers=2)
    body = cs.Body(mesh, element="tet10-p0", density_kg_m3=1000.0)
    t_s = np.arange(1.0 + len(STRAIN))
    crosshead = np.tile(np.eye(4), (len(t_s), 1, 1))
    crosshead[1:, 2, 3] = LENGTH_M * STRAIN
    places = body.nodes_m[:, 2]
    loads = np.full((len(t_s), 6), np.nan)
    loads[:, 2] = 0.0
    wrench = cs.Wrench(t_s, loads, sigma_n=0.01)
    lower = cs.Grasp(np.flatnonzero(places < 1e-6), cs.PoseSequence.fixed())
    upper = cs.Grasp(np.flatnonzero(places > LENGTH_M - 1e-6), crosshead, wrench=wrench)
    press = cs.Experiment(
        body, t_s, [lower, upper], kind="static", gravity_m_s2=(0, 0, 0), air_density_kg_m3="none"
    )
    found = cs.simulate(press, {**CONSTANTS, "young_pa": YOUNG_PA})
    return found.wrenches[0][1:, 2]


def solved(stress_pa: np.ndarray, poisson: float = 0.495, stated=None, **sizes) -> cs.Run:
    """Run of a test in which a specimen is pressed, with stated assumptions."""
    own = {"strain_zero": 0.0, "area_error": 0.0, "sigma_pa": 500.0} | sizes
    press = cs.Specimen("uniaxial", STRAIN, stress_pa, **own).experiment("neo-hookean", "press")
    problem = cs.Problem([press], {"young_pa": cs.Unknown(), "poisson": poisson})
    assumptions = cs.Assumptions(machine_compliance_m_n="none", **(stated or {}))
    options = replace(problem.uncertainty, assumptions=assumptions)
    return cs.run(replace(problem, uncertainty=options), seek_causes=False)


@pytest.mark.parametrize("sizes", [STATED, {}])
def test_the_interval_of_a_disc_on_dry_platens_contains_the_modulus(sizes):
    run = solved(load_n() / AREA_M2, **sizes)
    young = run.estimates["young_pa"]
    assert young.value > 1.7 * YOUNG_PA
    assert young.combined95[0] < YOUNG_PA < young.combined95[1]
    assert run.result.budget["young_pa"]["specimen_sticking"] > 0.9
    lubricated = solved(load_n() / AREA_M2, stated={"specimen_sticking": "none"}, **sizes)
    assert lubricated.estimates["young_pa"].combined95[0] > YOUNG_PA


def test_a_disc_that_is_known_to_stick_is_corrected():
    known = {"specimen_sticking": {"mean": 1.0, "deviation": 0.1}}
    young = solved(load_n() / AREA_M2, stated=known, **STATED).estimates["young_pa"]
    assert young.value == pytest.approx(YOUNG_PA, rel=0.1)


def test_a_high_specimen_and_a_foam_depend_little_on_the_platens():
    def half_width(run: cs.Run) -> float:
        low, high = run.estimates["young_pa"].combined95
        return float(np.log(high / low) / 2)

    exact = {"specimen_sticking": "none"}
    high = {"length_m": 0.05, "area_m2": AREA_M2}
    # The shape factor is 0.12: faces that stick make it 1 + 2 S², or 3 %, stiffer.
    alone = half_width(solved(1e6 * STRAIN, stated=exact, **high))
    assert half_width(solved(1e6 * STRAIN, **high)) < np.hypot(alone, 1.96 * 0.03)
    assert half_width(solved(1e6 * STRAIN, poisson=0.0)) == pytest.approx(
        half_width(solved(1e6 * STRAIN, poisson=0.0, stated=exact))
    )


def test_a_pulled_specimen_has_no_platens():
    pull = cs.Specimen("uniaxial", -STRAIN, -1e6 * STRAIN, 500.0).experiment("neo-hookean", "pull")
    problem = cs.Problem([pull], {"young_pa": cs.Unknown(), "poisson": 0.495})
    budget = cs.run(problem, seek_causes=False).result.budget["young_pa"]
    assert "specimen_sticking" not in budget


PROBLEM = """
[object]
material = "neo-hookean"

[parameters]
young_pa = {}
poisson = 0.495

[[experiment]]
name = "press"
kind = "specimen"
test = "uniaxial"
file = "press.csv"
sigma_pa = 500.0
length_m = 0.008
area_m2 = 4.5e-4
"""


def test_the_size_counts_beside_a_column_of_strains(tmp_path):
    rows = np.column_stack([STRAIN, 1e6 * STRAIN])
    np.savetxt(
        tmp_path / "press.csv", rows, delimiter=",", header="strain (-),stress (Pa)", comments=""
    )
    (tmp_path / "problem.toml").write_text(PROBLEM)
    (press,) = cs.Problem.read(tmp_path / "problem.toml").experiments
    assert press.specimen.area_over_length_m == pytest.approx(4.5e-4 / 0.008)
    assert press.specimen.shape_factor == pytest.approx(shape_factor(0.008, 4.5e-4))
    assert shape_factor(LENGTH_M, AREA_M2) == pytest.approx(RADIUS_M / (2 * LENGTH_M))
