"""Loading and unloading branches of material tests."""

from __future__ import annotations

import json

import numpy as np
import pytest
from kit.problem_files import run_command

import collocation_sysid as cs
from collocation_sysid.recording.specimen_checks import loading_rows

LOADING = np.linspace(0.0, 0.8, 21)
CYCLE = np.concatenate([LOADING, LOADING[-2:0:-1]])
STRAIN = np.concatenate([np.tile(CYCLE, 3), [0.0]])
SIGMA_PA = 1000.0
PROBLEM = f"""[object]
material = "neo-hookean"
[parameters]
mu_pa = {{}}
kappa_pa = 1e9
[[experiment]]
name = "pull"
kind = "specimen"
test = "uniaxial"
file = "pull.csv"
sigma_pa = {SIGMA_PA}
"""


def stresses_pa(softening=0.0):
    """Stresses of a rubber that is softer by a share wherever it unloads."""
    rng = np.random.default_rng(1)
    stretch = 1 + STRAIN
    stress_pa = 1e5 * (stretch - stretch**-2)
    is_unloading = np.append(np.diff(STRAIN) < 0, True)
    is_unloading[1:] = np.diff(STRAIN) < 0
    noise_pa = SIGMA_PA * rng.normal(size=len(STRAIN))
    return stress_pa * np.where(is_unloading, 1 - softening, 1) + noise_pa


def written(folder, softening=0.0, keys="", strain=STRAIN):
    rows = [f"{a},{b}" for a, b in zip(strain, stresses_pa(softening), strict=True)]
    (folder / "pull.csv").write_text("\n".join(["strain (-),stress (Pa)", *rows]) + "\n")
    (folder / "problem.toml").write_text(PROBLEM + keys)
    return folder / "problem.toml"


def only_experiment(*arguments, **keys):
    (experiment,) = cs.Problem.read(written(*arguments, **keys)).experiments
    return experiment


@pytest.mark.parametrize("keys", ["", "skip_cycles = 2\n"])
def test_the_loading_branch_is_that_of_the_last_cycle(tmp_path, keys):
    complete = only_experiment(tmp_path, keys=keys)
    assert len(complete.t_s) == (41 if keys else len(STRAIN))
    loading = only_experiment(tmp_path, keys=keys + 'branch = "loading"\n')
    measured_pa = loading.readings[0].measured_values[:, 0]
    assert len(measured_pa) == len(LOADING)
    np.testing.assert_allclose(measured_pa, stresses_pa()[80:101])


def test_compression_is_loaded_towards_negative_strains():
    assert loading_rows(-0.5 * STRAIN) == slice(80, 101)


def test_an_unknown_branch_is_refused(tmp_path):
    file = written(tmp_path, keys='branch = "unloading"\n')
    with pytest.raises(cs.InputError, match=r"branch.*loading"):
        cs.Problem.read(file)


@pytest.mark.long
def test_a_solve_of_both_branches_is_doubtful_and_of_one_finds_the_modulus(tmp_path):
    file = written(tmp_path, softening=0.12, keys="skip_cycles = 2\n")
    head, table = file.read_text().split("[[experiment]]\n")
    tables = ["[[experiment]]\n" + table.replace('"pull"', f'"pull {k}"') for k in range(3)]
    file.write_text(head + "".join(tables))
    outcome = run_command("solve", file, "--out", tmp_path / "both")
    assert "Verdict: doubtful" in outcome.out
    keys = 'skip_cycles = 2\nbranch = "loading"\n'
    file.write_text(file.read_text().replace("skip_cycles = 2\n", keys))
    outcome = run_command("solve", file, "--out", tmp_path / "one")
    assert "Verdict: doubtful" not in outcome.out
    result = json.loads((tmp_path / "one" / "result.json").read_text())
    assert result["parameters"]["mu_pa"]["value"] == pytest.approx(1e5, rel=0.02)
