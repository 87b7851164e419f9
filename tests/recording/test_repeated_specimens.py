"""Several tests of several specimens of one material."""

from __future__ import annotations

import numpy as np
import pytest

import collocation_sysid as cs

YOUNG_PA, SIGMA_PA, STRAIN = 1e5, 100.0, np.linspace(0.01, 0.3, 15)
# How much stiffer each specimen is than the material.
SPECIMENS = {"A": 0.05, "B": -0.03}
PARAMETERS = {"young_pa": cs.Unknown(), "poisson": 0.4999}


def recordings_of(name, named=True):
    """Three tests of a specimen, with noise."""
    random = np.random.default_rng(ord(name))
    stretch = 1 + STRAIN
    exact_pa = YOUNG_PA / 3 * (1 + SPECIMENS[name]) * (stretch - stretch**-2.0)
    experiments = []
    for k in range(3):
        noise_pa = SIGMA_PA * random.standard_normal(len(STRAIN))
        specimen = cs.Specimen(
            "uniaxial", STRAIN, exact_pa + noise_pa, SIGMA_PA, specimen=name if named else ""
        )
        experiments.append(specimen.experiment(name=f"{name}{k}"))
    return experiments


def test_recordings_of_one_specimen_share_its_stiffness():
    program = cs.Problem([*recordings_of("A"), *recordings_of("B")], PARAMETERS).collocation()
    shared = [name for name in program.parameter_names if "specimen_stiffness" in name]
    assert shared == [f"shared {k}: specimen_stiffness of stress [1]" for k in "AB"]


@pytest.mark.long
def test_the_interval_is_that_of_the_material():
    both = cs.run(cs.Problem([*recordings_of("A"), *recordings_of("B")], PARAMETERS))
    alone = {k: cs.run(cs.Problem(recordings_of(k), PARAMETERS)) for k in SPECIMENS}
    widths = {}
    for name, answer in {"both": both, **alone}.items():
        assert answer.trust.verdict == "good"
        low, high = answer.interval("young_pa")
        assert low < YOUNG_PA < high
        widths[name] = (high - low) / 2 / YOUNG_PA
    assert widths["A"] == pytest.approx(0.1, rel=0.15)
    assert widths["both"] == pytest.approx(0.1 / np.sqrt(2), rel=0.15)
    unnamed = cs.run(cs.Problem(recordings_of("A", named=False), PARAMETERS))
    assert unnamed.interval("young_pa")[0] > YOUNG_PA


def test_a_name_with_blanks_is_refused(tmp_path):
    (tmp_path / "pull.csv").write_text("strain (-),stress (Pa)\n0.1,1e4\n0.2,2e4\n")
    (tmp_path / "problem.toml").write_text(
        "[object]\n[parameters]\nyoung_pa = {}\npoisson = 0.499\n"
        '[[experiment]]\nname = "a"\nkind = "specimen"\ntest = "uniaxial"\nfile = "pull.csv"\n'
        'sigma_pa = 100.0\nspecimen = "A 1"\n'
    )
    with pytest.raises(cs.InputError, match="specimen"):
        cs.Problem.read(tmp_path / "problem.toml")
