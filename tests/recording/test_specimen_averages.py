"""Means of neighbouring rows of dense tables of material tests."""

from __future__ import annotations

import numpy as np
import pytest

import collocation_sysid as cs
from collocation_sysid.recording.specimen_averages import with_averaged_rows

ROWS = 1200
STRAIN = np.linspace(0.0, 0.6, ROWS)
PER_MEAN = 12
STRESS_PA = 8e4 * (1 + STRAIN - (1 + STRAIN) ** -2.0)
SIGMA_PA = 500.0
NOISE_PA = SIGMA_PA * np.random.default_rng(0).standard_normal(ROWS)


def test_means_of_white_noise_keep_the_information_of_all_rows():
    averaged = with_averaged_rows(
        cs.Specimen("uniaxial", STRAIN, STRESS_PA + NOISE_PA, sigma_pa=SIGMA_PA)
    )
    assert 95 <= len(averaged.strain) <= 101
    assert np.sum(averaged.sigma_pa**-2.0) == pytest.approx(ROWS / SIGMA_PA**2, rel=1e-9)
    exact = np.interp(averaged.strain, STRAIN, STRESS_PA)
    assert np.std((averaged.stress_pa - exact) / averaged.sigma_pa) == pytest.approx(1.0, abs=0.25)


def test_what_neighbouring_rows_have_in_common_remains_in_their_mean():
    slow_pa = SIGMA_PA * np.sin(5 * STRAIN)
    averaged = with_averaged_rows(
        cs.Specimen("uniaxial", STRAIN, STRESS_PA + slow_pa + 0.1 * NOISE_PA, sigma_pa=SIGMA_PA)
    )
    expected = SIGMA_PA * np.sqrt(0.01 / PER_MEAN + 0.99)
    np.testing.assert_allclose(averaged.sigma_pa, expected, rtol=0.01)


def test_rows_with_less_noise_have_more_weight():
    sigma_pa = np.where(np.arange(ROWS) % 2, SIGMA_PA, 1e3 * SIGMA_PA)
    noisy = STRESS_PA + NOISE_PA * sigma_pa / SIGMA_PA
    averaged = with_averaged_rows(cs.Specimen("uniaxial", STRAIN, noisy, sigma_pa=sigma_pa))
    assert np.sum(averaged.sigma_pa**-2.0) == pytest.approx(np.sum(sigma_pa**-2.0), rel=1e-9)
    exact = np.interp(averaged.strain, STRAIN, STRESS_PA)
    assert np.abs(averaged.stress_pa - exact).max() < 5 * SIGMA_PA


def test_short_tables_and_large_steps_of_the_strain_keep_their_rows():
    few = cs.Specimen("uniaxial", STRAIN[::10], STRESS_PA[::10], sigma_pa=SIGMA_PA)
    assert with_averaged_rows(few) is few
    turned = np.random.default_rng(1).permutation(ROWS)
    mixed = cs.Specimen("uniaxial", STRAIN[turned], STRESS_PA[turned], sigma_pa=SIGMA_PA)
    assert with_averaged_rows(mixed) is mixed


def test_rows_without_a_lateral_stretch_are_not_averaged_with_others():
    lateral = np.where(np.arange(ROWS) < ROWS // 2, np.nan, (1 + STRAIN) ** -0.5)
    averaged = with_averaged_rows(
        cs.Specimen("uniaxial", STRAIN, STRESS_PA, sigma_pa=SIGMA_PA, lateral_stretch=lateral)
    )
    assert averaged.lateral_stretch is not None
    is_missing = np.isnan(averaged.lateral_stretch)
    assert (
        averaged.strain[is_missing].max() < STRAIN[ROWS // 2] <= averaged.strain[~is_missing].min()
    )


def test_a_problem_with_a_dense_table_says_how_many_rows_are_averaged(tmp_path):
    np.savetxt(
        tmp_path / "pull.csv",
        np.column_stack([STRAIN, STRESS_PA + NOISE_PA]),
        delimiter=",",
        header="strain (-),stress (Pa)",
        comments="",
    )
    (tmp_path / "problem.toml").write_text(
        "[object]\n[parameters]\nyoung_pa = {}\npoisson = 0.499\n"
        '[[experiment]]\nname = "pull"\nkind = "specimen"\ntest = "uniaxial"\nfile = "pull.csv"\n'
        f"sigma_pa = {SIGMA_PA}\n"
    )
    problem = cs.Problem.read(tmp_path / "problem.toml")
    assert len(problem.experiments[0].t_s) < 110
    assert any("1200 rows are averaged to" in note for note in problem.notes)
