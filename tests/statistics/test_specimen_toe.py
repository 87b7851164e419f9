"""A toe of a specimen's curve is an effect of the budget, which the data correct where they show it."""

from collections.abc import Sequence

import numpy as np
import pytest

import collocation_sysid as cs

YOUNG_PA = 2.7e6
FIXED = {"kappa_pa": 1e9, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
YEOH = ("c10_pa", "c20_pa", "c30_pa")


def run_of_lap_joint(
    slack: float, largest: float, noise: float, seed: int, names: Sequence[str] = YEOH
) -> cs.Run:
    """Simple shear of a joint whose slack closes gradually; noise relative to the largest stress."""
    strain = np.linspace(0, largest, 31)
    held = strain - slack * (1 - np.exp(-strain / (slack or 1.0)))
    sigma_pa = noise * YOUNG_PA / 3 * held.max()
    stress_pa = YOUNG_PA / 3 * held + sigma_pa * np.random.default_rng(seed).normal(size=31)
    test = cs.Specimen("simple-shear", strain, stress_pa, sigma_pa)
    law = "yeoh" if names == YEOH else "neo-hookean"
    unknown = {name: cs.Unknown() for name in names}
    return cs.run(cs.Problem([test.experiment(law, "lap")], unknown | FIXED))


def interval_pa(run: cs.Run) -> tuple[float, float]:
    interval = run.estimates["young_pa"].combined95
    assert interval is not None
    return interval


@pytest.mark.long
@pytest.mark.parametrize("noise", [0.01, 0.02])
@pytest.mark.parametrize("seed", [1, 3])
def test_the_interval_of_a_law_that_reproduces_a_slack_contains_the_truth(noise, seed):
    low_pa, high_pa = interval_pa(run_of_lap_joint(0.006, 0.03, noise, seed))
    assert low_pa < YOUNG_PA < high_pa


def test_a_toe_that_the_data_show_is_the_first_reason():
    run = run_of_lap_joint(0.006, 0.1, 0.005, 0)
    assert "need a specimen toe" in run.trust.reasons[0]
    assert "window_s" in run.trust.reasons[0]


def test_a_clean_curve_of_rubber_is_good_and_hardly_less_accurate():
    run = run_of_lap_joint(0.0, 0.5, 0.005, 0, ("mu_pa",))
    low_pa, high_pa = interval_pa(run)
    assert run.trust.verdict == "good"
    assert low_pa < YOUNG_PA < high_pa
    share = run.budget["young_pa"].shares.get("specimen_toe", 0.0)
    assert 0 < share < 0.1


def test_exact_strains_have_no_toe():
    strain = np.linspace(0, 0.03, 31)
    test = cs.Specimen("simple-shear", strain, YOUNG_PA / 3 * strain, 100.0, strain_zero=0.0)
    run = cs.run(cs.Problem([test.experiment(name="lap")], {"mu_pa": cs.Unknown()} | FIXED))
    assert "specimen_toe" not in run.budget["young_pa"].shares
