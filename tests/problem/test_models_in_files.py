"""Materials, regions and parameters by name in a problem file."""

from __future__ import annotations

import json
from pathlib import Path

import meshio
import numpy as np
import pytest
from kit.problem_files import both, contents, replace_text, run_command, settings, write
from kit.region_files import DENSITY, TWO_REGIONS

TRUTH = settings(
    "parameters.young_pa.guess=900",
    "parameters.stiff.c10_pa.guess=400",
    "parameters.stiff.c20_pa.guess=30",
    "parameters.gamma_r_s.guess=0.009",
    "parameters.gamma_m_1_s.guess=1.0",
)
CODE = 'density_kg_m3 = 30.0\nmaterial = { file = "mine.py", function = "energy" }\n'
MINE = """
import casadi as ca

def energy(F, lambda_pa, mu_pa):
    log_j = ca.log(ca.det(F))
    return 0.5 * lambda_pa * log_j**2 - mu_pa * log_j + 0.5 * mu_pa * (ca.sumsqr(F) - 3)

def stressed(F, mu_pa):
    return mu_pa * ca.det(F)
"""
OWN_MATERIAL = both(replace_text(DENSITY, CODE), write("mine.py", MINE))


def refusal(tiny: Path, *arguments: object) -> str:
    """The one line on stderr of a command that must not write anything."""
    before = contents(tiny)
    outcome = run_command("solve", "problem.toml", "--out", "run", "--quiet", *arguments)
    assert outcome.code == 2, outcome.err
    assert contents(tiny) == before
    assert outcome.err.count("\n") == 1
    return outcome.err


@pytest.mark.long
def test_a_body_of_two_regions_is_simulated_and_identified(tiny):
    TWO_REGIONS(tiny)
    simulated = run_command(
        "simulate",
        "problem.toml",
        "--integrator",
        "midpoint",
        "--out",
        "data",
        "--quiet",
        *TRUTH,
        *settings("transcription.substeps=1"),
    )
    assert simulated.code == 0, simulated.err
    tracks = 'file = "data/swing_markers.csv"'
    replace_text('file = "swing_markers.csv"', tracks)(tiny)
    outcome = run_command("solve", "problem.toml", "--out", "run", "--quiet", *settings(
        "solver.method=reduced-space"
    ))  # fmt: skip
    assert outcome.code == 0, outcome.err
    result = json.loads((tiny / "run/result.json").read_text())
    found = {name: each["optimum"] for name, each in result["parameters"].items()}
    assert list(found) == [
        "young_pa",
        "poisson",
        "stiff.c10_pa",
        "stiff.c20_pa",
        "stiff.c30_pa",
        "gamma_r_s",
        "gamma_m_1_s",
    ]
    assert found["young_pa"] == pytest.approx(900, rel=1e-3)
    assert found["stiff.c10_pa"] == pytest.approx(400, rel=1e-3)
    assert "stiff.young_pa" in result["derived"]
    frame = meshio.read(tiny / "run/frames/frame_0000.vtu")
    centres = frame.points[frame.cells[0].data].mean(axis=1)
    region = frame.cell_data["region"][0]
    assert set(region) == {0, 1}
    first = meshio.read(tiny / "body.vtu")
    undeformed = first.points[first.cells[0].data].mean(axis=1)
    np.testing.assert_array_equal(region == 1, undeformed[:, 2] >= 0.03)
    assert len(centres) == len(region)
    assert run_command("plot", "run", "--out", "again").code == 0
    assert run_command("report", "run").code == 0


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("young_pa =", "youngs_pa =", "did you mean 'young_pa'?"),
        ("young_pa =", "mu_pa = 300.0\nyoung_pa =", "mu_pa, young_pa, poisson"),
        ("stiff.c30_pa = 0.0\n", "", "c30_pa is missing: the material yeoh of region 'stiff'"),
        ("stiff.c30_pa = 0.0\n", "", "write stiff.c30_pa = {} to estimate it"),
        ("stiff.c30_pa", "stif.c30_pa", "did you mean 'stiff.c30_pa'?"),
        ("stiff.c30_pa", "stiff.c20_pa.lower = 0.0\nstiff.c30_pa", "problem.toml"),
        ('"stiff.c10_pa" =', 'stiff.c10_pa = 3.0\n"stiff.c10_pa" =', "given twice"),
        ("c30_pa = 0.0", 'c30_pa = { tied_to = "stiff.c1_pa" }', "did you mean 'stiff.c10_pa'?"),
        ("typical = 20.0", "typical = -1.0", "parameters.stiff.c20_pa.typical"),
        ("poisson = 0.25", "poisson = 0.5", "poisson: fixed = 0.5, expected less than 0.5"),
        ('"yeoh"', '"yeo"', "did you mean 'yeoh'?"),
        ("[[-1, -1, 0.03]", "[[-1, -1, 5.0]", "low corner"),
        ("[[-1, -1, 0.03], [1, 1, 0.09]]", "[[1, 1, 1], [2, 2, 2]]", "none of the"),
    ],
)
def test_a_slip_in_the_model_is_one_message(tiny, old: str, new: str, expected: str):
    TWO_REGIONS(tiny)
    replace_text(old, new)(tiny)
    assert expected in refusal(tiny)


def test_foreign_code_is_run_only_where_allowed(tiny):
    OWN_MATERIAL(tiny)
    (tiny / "mine.py").write_text(MINE + "\nopen('was_run', 'w')\n")
    assert "--allow-code" in refusal(tiny)
    assert not (tiny / "was_run").exists()


@pytest.mark.long
def test_a_material_of_the_users_own_is_identified_when_allowed(tiny):
    own, built_in = (tiny / "own", tiny / "built-in")
    reduced = settings("solver.method=reduced-space")
    assert run_command("solve", "problem.toml", "--quiet", "--out", built_in, *reduced).code == 0
    OWN_MATERIAL(tiny)
    arguments = ("solve", "problem.toml", "--quiet", "--allow-code", "--out", own, *reduced)
    outcome = run_command(*arguments)
    assert outcome.code == 0, outcome.err
    found, expected = (json.loads((r / "result.json").read_text()) for r in (own, built_in))
    for name, parameter in expected["parameters"].items():
        assert found["parameters"][name]["value"] == pytest.approx(parameter["value"], rel=1e-9)
    assert run_command("check", "problem.toml", "--allow-code").code == 0


@pytest.mark.parametrize(
    ("content", "function", "expected"),
    [
        (MINE, "enrgy", "did you mean 'energy'?"),
        (MINE, "stressed", "undeformed"),
        ("import nothing_like_it", "energy", "ModuleNotFoundError"),
        ("def energy(F):\n    return 0", "energy", "no constants"),
        ("def energy(F, mu_pa, lambda_pa):\n    exit(7)", "energy", "SystemExit: 7"),
        ("exit(7)", "energy", "SystemExit: 7"),
        ("def energy(F, mu_pa, lambda_pa):\n    return mu_pa * F", "energy", "only defined for"),
    ],
)
def test_a_file_that_gives_no_material_is_refused(tiny, content, function, expected):
    OWN_MATERIAL(tiny)
    replace_text('function = "energy"', f'function = "{function}"')(tiny)
    write("mine.py", content)(tiny)
    assert expected in refusal(tiny, "--allow-code")


@pytest.mark.long
def test_a_study_runs_allowed_code_in_its_workers(tiny):
    OWN_MATERIAL(tiny)
    command = ("compare-methods", "problem.toml", "--methods", "reduced-space", "--workers", "1")
    outcome = run_command(*command, "--allow-code", "--quiet", "--json", "--out", "study")
    assert outcome.code == 0, outcome.err
    assert [row["status"] for row in json.loads(outcome.out)["runs"]] == ["converged"]
