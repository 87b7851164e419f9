"""Compliance of a machine whose displacement gives the strain of a specimen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import collocation_sysid as cs
from collocation_sysid.program.simulation import with_readings

LENGTH_M = 0.02
AREA_M2 = 4e-4
YOUNG_PA = 5e5
COMPLIANCE_M_N = 5e-6
CONSTANTS = {"poisson": 0.4, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
# Systematic effects of specimens apart from the compliance.
OTHERS = dict.fromkeys(
    ("anisotropy", "load_drift", "poisson", "gauge_length", "effective_length"), "none"
)
STRAIN = np.linspace(0.02, 0.4, 12)
KEYS = {"sigma_pa": 100.0, "strain_zero": 0.0, "area_error": 0.0}


def measured(test, **keys):
    """Experiment of a test whose strain contains the displacement of the bench under load."""
    true = cs.Specimen(test, STRAIN, 0 * STRAIN, **KEYS).experiment(name=test)
    (stress_pa,) = cs.simulate(true, {**CONSTANTS, "young_pa": YOUNG_PA}).custom_sensor_values
    bench = COMPLIANCE_M_N * AREA_M2 * stress_pa[:, 0] / LENGTH_M
    twin = cs.Specimen(test, STRAIN + bench, stress_pa[:, 0], **KEYS, **keys)
    return with_readings(twin.experiment(name=test), [stress_pa])


def estimate(test, assumptions, **keys):
    """Estimate of E from a test with assumptions about systematic effects."""
    problem = cs.Problem([measured(test, **keys)], {**CONSTANTS, "young_pa": cs.Unknown()})
    stated = cs.Assumptions(**{**OTHERS, **assumptions})
    options = replace(problem.uncertainty, assumptions=stated)
    run = cs.run(replace(problem, uncertainty=options), seek_causes=False)
    return run.estimates["young_pa"]


SIZE = {"length_m": LENGTH_M, "area_m2": AREA_M2}


@pytest.mark.parametrize("test", ["uniaxial", "equibiaxial", "planar", "simple-shear", "confined"])
def test_a_known_compliance_corrects_the_stiffness(test):
    uncorrected = estimate(test, {"machine_compliance_m_n": "none"}, **SIZE)
    known = {"machine_compliance_m_n": {"mean": COMPLIANCE_M_N, "deviation": 1e-8}}
    corrected = estimate(test, known, **SIZE)
    bias = uncorrected.value / YOUNG_PA - 1
    assert bias < -0.01
    assert abs(corrected.value / YOUNG_PA - 1) < 0.2 * abs(bias)


def test_an_unknown_compliance_widens_the_interval_to_the_truth():
    exact = estimate("simple-shear", {"machine_compliance_m_n": "none"}, **SIZE)
    assert exact.combined95[1] < YOUNG_PA
    widened = estimate("simple-shear", {"machine_compliance_m_n": COMPLIANCE_M_N}, **SIZE)
    assert widened.combined95[0] < YOUNG_PA < widened.combined95[1]


def test_strain_that_was_measured_on_the_specimen_has_no_compliance():
    exact = estimate("uniaxial", {"machine_compliance_m_n": "none"})
    other = estimate("uniaxial", {"machine_compliance_m_n": COMPLIANCE_M_N})
    assert other.combined95 == pytest.approx(exact.combined95, rel=1e-9)


def test_a_length_needs_an_area():
    with pytest.raises(cs.InputError, match="length_m and area_m2"):
        cs.Specimen("uniaxial", STRAIN, STRAIN, **KEYS, length_m=0.02)


PROBLEM = """
[object]
material = "neo-hookean"

[parameters]
young_pa = {}
poisson = 0.4

[[experiment]]
name = "pull"
kind = "specimen"
test = "uniaxial"
file = "pull.csv"
sigma_pa = 100.0
length_m = 0.02
"""


@pytest.mark.parametrize("has_area", [True, False])
def test_the_displacement_of_a_bench_is_distinguished_from_a_strain(tmp_path, has_area):
    (gauge,) = measured("uniaxial").readings
    force_n = AREA_M2 * gauge.measured_values[:, 0]
    rows = np.column_stack([1e3 * LENGTH_M * STRAIN, force_n if has_area else force_n / AREA_M2])
    header = "extension (mm),force (N)" if has_area else "extension (mm),stress (Pa)"
    np.savetxt(tmp_path / "pull.csv", rows, delimiter=",", header=header, comments="")
    area = f"area_m2 = {AREA_M2}\n" if has_area else ""
    (tmp_path / "problem.toml").write_text(PROBLEM + area)
    problem = cs.Problem.read(tmp_path / "problem.toml")
    (experiment,) = problem.experiments
    assert experiment.specimen.area_over_length_m == pytest.approx(0.02 if has_area else 0.0)
    notes = [note for note in problem.notes if "compliance of the test bench" in note]
    assert len(notes) == (0 if has_area else 1)
