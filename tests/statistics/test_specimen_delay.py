"""A load of a specimen with memory that is late, and its row of the budget."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import collocation_sysid as cs
from collocation_sysid.program.simulation import with_readings

TRUTH = {"young_pa": 2e5, "poisson": 0.495, "a.share": 0.4, "a.tau_s": 0.3}
DELAY_S = 5e-3
SAMPLE_S = 0.05
TIMES = np.arange(0.0, 8.0, SAMPLE_S)


def strains(t_s):
    """Strains of an oscillation at 1 Hz that begins slowly."""
    share = np.minimum(t_s / 3, 1)
    return share * (0.05 + 0.03 * np.sin(2 * np.pi * t_s))


def test_the_interval_contains_the_relaxation_time_of_a_late_load():
    keys = {"t_s": TIMES, "sigma_pa": 100.0, "strain_zero": 0.0, "area_error": 0.0}

    def test_of(strain):
        return cs.Specimen("uniaxial", strain, 0 * strain, **keys).experiment(prony=("a",))

    constants = TRUTH | {"gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
    late = cs.simulate(test_of(strains(TIMES - DELAY_S)), constants).custom_sensor_values
    recorded = with_readings(test_of(strains(TIMES)), late)
    unknown = {name: cs.Unknown() for name in ("young_pa", "a.share", "a.tau_s")}
    problem = cs.Problem([recorded], constants | unknown)

    def interval(**assumptions) -> tuple[float, float]:
        exact = replace(cs.Assumptions.exact(), **assumptions)
        options = replace(problem.uncertainty, assumptions=exact)
        run = cs.run(replace(problem, uncertainty=options), seek_causes=False)
        return run.interval("a.tau_s")

    low, high = interval(specimen_delay_s=DELAY_S)
    assert low < TRUTH["a.tau_s"] < high
    assert interval()[0] > TRUTH["a.tau_s"]
