"""An error of the length to which the strains of a specimen refer, and its row of the budget."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from kit.problems import hung_cube

import collocation_sysid as cs
from collocation_sysid.program.simulation import with_readings

YOUNG_PA = 5e5
CONSTANTS = {"poisson": 0.4, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
# Share by which the true gauge length is longer than the stated one.
LONGER = 0.02
STRAIN = np.linspace(0.02, 0.2, 12)
KEYS = {"sigma_pa": 10.0, "strain_zero": 0.0, "area_error": 0.0}


def solved(test: str, **assumptions) -> cs.Run:
    """Run of a test whose strains were computed with a gauge length that is too short; other
    assumptions than those stated are exact.
    """
    true = cs.Specimen(test, STRAIN / (1 + LONGER), 0 * STRAIN, **KEYS).experiment(name=test)
    (stress_pa,) = cs.simulate(true, {**CONSTANTS, "young_pa": YOUNG_PA}).custom_sensor_values
    stated = cs.Specimen(test, STRAIN, stress_pa[:, 0], **KEYS)
    problem = cs.Problem(
        [with_readings(stated.experiment(name=test), [stress_pa])],
        {**CONSTANTS, "young_pa": cs.Unknown()},
    )
    options = replace(
        problem.uncertainty, assumptions=replace(cs.Assumptions.exact(), **assumptions)
    )
    return cs.run(replace(problem, uncertainty=options), seek_causes=False)


@pytest.mark.parametrize("test", ["uniaxial", "equibiaxial", "simple-shear"])
def test_the_combined_interval_contains_the_modulus_of_a_wrong_length(test):
    run = solved(test, gauge_length=LONGER)
    young = run.estimates["young_pa"]
    bias = young.value / YOUNG_PA - 1
    assert -1.5 * LONGER < bias < -0.4 * LONGER
    low, high = young.combined95
    assert low <= YOUNG_PA <= high
    # One standard deviation is the bias itself, to first order.
    share = run.result.budget["young_pa"]["gauge_length"]
    deviation = np.log(high / low) / 2 / 1.96 * np.sqrt(share)
    assert deviation == pytest.approx(abs(bias), rel=0.06)
    without = solved(test).estimates["young_pa"].combined95
    assert without[1] / without[0] < high / low


@pytest.mark.parametrize(("sign", "is_counted"), [(1.0, True), (-1.0, False)])
def test_the_length_between_grips_that_pull_may_be_too_long(sign, is_counted):
    """A dogbone whose effective length is 9 % shorter than the distance of its grips."""
    strain = sign * STRAIN
    true = cs.Specimen("uniaxial", 1.09 * strain, 0 * strain, **KEYS).experiment(name="pull")
    (stress_pa,) = cs.simulate(true, {**CONSTANTS, "young_pa": YOUNG_PA}).custom_sensor_values
    stated = cs.Specimen(
        "uniaxial", strain, stress_pa[:, 0], **KEYS, length_m=0.1, area_m2=4e-5
    ).experiment(name="pull")
    problem = cs.Problem([stated], {**CONSTANTS, "young_pa": cs.Unknown()})
    run = cs.run(problem, seek_causes=False)
    assert ("effective_length" in run.result.budget["young_pa"]) == is_counted
    low, high = run.estimates["young_pa"].combined95
    assert (low <= YOUNG_PA <= high) == is_counted


def test_the_row_belongs_to_specimens_by_default_and_not_to_bodies():
    assert cs.Assumptions().gauge_length == 0.01
    swung = hung_cube()
    values = {"young_pa": 600.0, "poisson": 0.3, "gamma_r_s": 0.01, "gamma_m_1_s": 1.0}
    tracks_m = cs.simulate(swung, values, "midpoint", substeps=1).markers_m
    problem = cs.Problem(
        [cs.with_markers(swung, tracks_m)], {**values, "young_pa": cs.Unknown(600.0)}
    )
    budget = cs.run(problem, seek_causes=False).result.budget["young_pa"]
    assert "gauge_length" not in budget
    assert "body_scale" in budget


@pytest.mark.parametrize(
    ("stated", "is_counted"), [("length_m = 0.03\narea_m2 = 1e-4\n", True), ("", False)]
)
def test_strains_beside_a_length_and_an_area_may_be_those_of_the_grips(
    tmp_path, stated, is_counted
):
    """A dogbone of which 24 of the 30 mm between the grips take part, with a column of strains."""
    strain = np.linspace(0.01, 0.3, 12)
    true = cs.Specimen("uniaxial", strain / 0.8, 0 * strain, **KEYS).experiment(name="pull")
    (stress_pa,) = cs.simulate(true, {**CONSTANTS, "young_pa": YOUNG_PA}).custom_sensor_values
    rows = np.column_stack([strain, stress_pa[:, 0]])
    np.savetxt(
        tmp_path / "pull.csv", rows, delimiter=",", header="strain (1),stress (Pa)", comments=""
    )
    (tmp_path / "problem.toml").write_text(
        "[object]\nmaterial = 'neo-hookean'\n[parameters]\nyoung_pa = {}\n"
        f"poisson = {CONSTANTS['poisson']}\n[[experiment]]\n"
        'name = "pull"\nkind = "specimen"\ntest = "uniaxial"\nfile = "pull.csv"\n'
        f"sigma_pa = 100.0\n{stated}"
    )
    run = cs.run(cs.Problem.read(tmp_path / "problem.toml"), seek_causes=False)
    assert ("effective_length" in run.result.budget["young_pa"]) == is_counted
    low, high = run.estimates["young_pa"].combined95
    assert (low <= YOUNG_PA <= high) == is_counted
