"""Output of the solve of a material test: each statement on a parameter once."""

from __future__ import annotations

import numpy as np
import pytest
from kit.problem_files import pictures_drawn, run_command

PROBLEM = """[object]
material = "ogden-2"
[parameters]
mu_1_pa = {}
alpha_1 = {}
mu_2_pa = { guess = 1e3, typical = 1e3 }
alpha_2 = { guess = 5.0 }
kappa_pa = 1e9
[[experiment]]
name = "pull"
kind = "specimen"
test = "uniaxial"
file = "pull.csv"
sigma_pa = 700.0
"""


@pytest.fixture
def folder(tmp_path):
    """Problem of a curve that does not determine one of four constants."""
    rng = np.random.default_rng(5)
    stretch = np.linspace(1.05, 3.5, 40)
    stress_pa = sum(
        2 * mu / alpha * (stretch ** (alpha - 1) - stretch ** (-alpha / 2 - 1))
        for mu, alpha in ((1.5e5, 1.6), (3e3, 4.6))
    ) + 700.0 * rng.normal(size=len(stretch))
    rows = [f"{a},{b}" for a, b in zip(stretch, stress_pa, strict=True)]
    (tmp_path / "pull.csv").write_text("\n".join(["stretch,stress (Pa)", *rows]) + "\n")
    (tmp_path / "problem.toml").write_text(PROBLEM)
    return tmp_path


@pytest.mark.long
def test_an_undetermined_parameter_is_stated_once(folder):
    outcome = run_command("solve", folder / "problem.toml", "--out", folder / "run")
    lines = outcome.out.splitlines()
    assert lines[0] == "Verdict: good"  # an undetermined constant contradicts nothing
    (table_row,) = [line for line in lines if line.startswith("μ₂ Pa") or "μ₂ kPa" in line]
    assert "not identifiable" in table_row
    (limit,) = (line for line in lines if "μ₂" in line and line != table_row)
    assert limit.startswith("the data determine μ₂ only to within a factor of ")
    assert "an equibiaxial test up to the same strain would determine μ₂" in limit
    assert "mu_2_pa" not in outcome.out


@pytest.mark.long
def test_a_homogeneous_specimen_has_no_frames_and_no_jacobian(folder):
    text = PROBLEM.replace("ogden-2", "neo-hookean").split("[parameters]")[0]
    text += "[parameters]\nmu_pa = {}\nkappa_pa = 1e9\n[[experiment]]" + PROBLEM.split("ment]]")[1]
    (folder / "problem.toml").write_text(text)
    with pictures_drawn():
        run_command("solve", folder / "problem.toml", "--out", folder / "run")
    names = {file.name for file in (folder / "run").rglob("*")}
    assert {name for name in names if name.endswith(".png")} <= {"budget.png", "stress_pull.png"}
    assert "stress_pull.png" in names
    assert not names & {"frames", "trajectory.pvd"}
