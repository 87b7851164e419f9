"""Ogden's law and foam in a problem file: identification, messages and `check`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from kit.problem_files import EXPERIMENT, PROBLEM, run_command
from kit.problems import smooth_poses, times

from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.problem import Problem
from collocation_sysid.recording import write_poses_csv
from collocation_sysid.result.synthesis import Recipe, write_data

DAMPING = "gamma_r_s = 0.009\ngamma_m_1_s = 1.0\n"
LAWS = {
    "ogden-1": {"mu_1_pa": 40.0, "alpha_1": 5.0, "kappa_pa": 190.0},
    "hyperfoam-1": {"mu_1_pa": 90.0, "alpha_1": 6.0, "beta_1": 0.4},
}


def soft_bar(folder: Path, material: str, stiffness: float = 1.0, **changes: str) -> Path:
    """A recording of a bar so soft that it strains much, with 0.2 mm of noise.

    The constants are without guess, except those in `changes`. Moduli are those of `LAWS` times
    `stiffness`.
    """
    folder.mkdir(exist_ok=True)
    box_mesh((0.06, 0.06, 0.12), (2, 2, 4)).write(folder / "body.vtu")
    write_poses_csv(
        folder / "swing_motion.csv",
        smooth_poses(times(40), (0.02, 0.02, 0.03), (0.2, -0.1, 0.1), 12),
    )
    constants = {**dict.fromkeys(LAWS[material], "{}"), **changes}
    start, stop = PROBLEM.index("lambda_pa"), PROBLEM.index("\n[solver]")
    text = PROBLEM[:start] + "".join(f"{name} = {value}\n" for name, value in constants.items())
    text += DAMPING + PROBLEM[stop:]
    text = text.replace("interior-point", "reduced-space")
    text = text.replace('mesh = "body.vtu"', f'mesh = "body.vtu"\nmaterial = "{material}"')
    text += EXPERIMENT.replace("0.089", "0.119")
    text += '\n[environment]\nair_density_kg_m3 = "none"\n'
    file = folder / "problem.toml"
    file.write_text(text)
    truth = [
        f"parameters.{name}={value * (stiffness if name.endswith('_pa') else 1.0)}"
        for name, value in LAWS[material].items()
    ]
    write_data(
        Problem.read(file, truth, simulation=True), folder, Recipe("midpoint", noise_m=2e-4, seed=1)
    )
    return file


@pytest.mark.long
@pytest.mark.parametrize("material", LAWS)
def test_a_file_without_guesses_recovers_the_constants_of_a_twin(material, tmp_path):
    """mu_1 and alpha_1 are estimated together; the third constant is known."""
    third = list(LAWS[material])[2]
    file = soft_bar(tmp_path, material, **{third: str(LAWS[material][third])})
    outcome = run_command("solve", file, "--out", tmp_path / "run", "--quiet", "--no-pictures")
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    assert outcome.code in (0, 1), outcome.err
    for name in ("mu_1_pa", "alpha_1"):
        found = result["parameters"][name]
        error = found["statistical_std_error"]
        assert abs(found["value"] - LAWS[material][name]) < 4 * error
        assert error < 0.2 * LAWS[material][name]
    # What strains determine best is the stiffness: errors of μ and α compensate each other.
    shear_pa = 100.0 if material == "ogden-1" else 90.0
    poisson = 0.276596 if material == "ogden-1" else 0.4 / 1.8
    young = result["derived"]["young_pa"]["value"]
    assert young == pytest.approx(2 * (1 + poisson) * shear_pa, rel=0.05)


@pytest.mark.long
def test_the_exponent_is_not_determined_by_small_strains(tmp_path):
    """At small strains only G = ½ μ α matters, and the output says so."""
    file = soft_bar(tmp_path, "ogden-1", stiffness=1e3, kappa_pa="19e4")
    outcome = run_command("solve", file, "--out", tmp_path / "run", "--no-pictures")
    assert outcome.code in (0, 1), outcome.err
    assert "Verdict: good" not in outcome.out
    found = json.loads((tmp_path / "run" / "result.json").read_text())["parameters"]["alpha_1"]
    low, high = found["combined95"] or (-np.inf, np.inf)
    assert found["at_bound"] or high - low > abs(found["value"])


@pytest.mark.long
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"alpha_1": "80.0"}, "alpha_1: fixed = 80, expected less than 60"),
        ({"alpha_1": "-80.0"}, "alpha_1: fixed = -80, expected a number >= -60"),
        # It is possible with a negative exponent, but not with the usual one.
        ({"mu_1_pa": "-5.0"}, "the body cannot be simulated"),
        ({"alpha_1": "{ lower = -80.0 }"}, "expected -60 <= lower < upper"),
        ({"alpha_2": "2.0"}, "alpha_2"),
    ],
)
def test_impossible_constants_are_refused(changes, message, tmp_path):
    file = soft_bar(tmp_path, "ogden-1")
    text = file.read_text()
    for name, value in changes.items():
        line = f"{name} = {value}\n"
        old = f"{name} = {{}}\n"
        text = text.replace(old, line) if old in text else text.replace(DAMPING, line + DAMPING)
    file.write_text(text)
    outcome = run_command("check", file)
    assert outcome.code == 2
    assert message in outcome.err
    assert outcome.err.count("\n") == 1


@pytest.mark.long
def test_a_missing_exponent_is_named(tmp_path):
    file = soft_bar(tmp_path, "ogden-1")
    file.write_text(file.read_text().replace("alpha_1 = {}\n", ""))
    outcome = run_command("check", file)
    assert outcome.code == 2
    assert "alpha_1 is missing: the material ogden-1 of the body" in outcome.err


@pytest.mark.long
def test_check_warns_of_a_negative_shear_modulus(tmp_path):
    file = soft_bar(tmp_path, "ogden-1", mu_1_pa="40.0", kappa_pa="190.0")
    file.write_text(file.read_text().replace("alpha_1 = {}", "alpha_1 = -2.0"))
    outcome = run_command("check", file)
    assert "unstable without any strain" in outcome.out + outcome.err


@pytest.mark.long
def test_terms_beyond_four_are_refused(tmp_path):
    file = soft_bar(tmp_path, "ogden-1")
    file.write_text(file.read_text().replace('"ogden-1"', '"ogden-5"'))
    outcome = run_command("check", file)
    assert outcome.code == 2
    assert "did you mean 'ogden-" in outcome.err


def test_unstated_constants_have_distinct_starts():
    """Equal terms would have equal derivatives, and none could be told from another."""
    from collocation_sysid.fem.laws.constants import ALPHA_TERMS, MU_TERMS, usual_value

    exponents = [constant.usual for constant in ALPHA_TERMS]
    assert len(set(exponents)) == len(exponents)
    shears = [usual_value(constant.name, 2.6e4) for constant in MU_TERMS]
    products = np.array(shears) * np.array(exponents)
    assert (products > 0).all()
    assert products[0] > products[1:].sum()
