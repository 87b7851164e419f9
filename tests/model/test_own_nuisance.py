"""User-defined nuisance parameters of marker positions and times."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from kit.nuisances import seen_with
from kit.own_nuisances import ROWS, SAG, SCALE
from kit.problem_files import replace_text, run_command, write
from kit.problems import GUESS, TRUTH, cube_with_gaps, hung_cube

import collocation_sysid as cs
from collocation_sysid.common.display import plain_text
from collocation_sysid.errors import InputError
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.model.nuisance_map import NuisanceMap
from collocation_sysid.pipeline import run, solve
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.result.run_summary import run_summary


def only(*rows: cs.Deviation, **others) -> cs.Nuisance:
    return cs.Nuisance.none(own=rows, **others)


def known_to(experiment: cs.Experiment, sigma_m: float) -> cs.Experiment:
    sigmas = np.full(len(experiment.markers.names), sigma_m)
    return replace(experiment, markers=replace(experiment.markers, sigma_m=sigmas))


def test_a_nuisance_parameter_changes_sensor_values_as_declared():
    cube = replace(hung_cube(), nuisance=only(SCALE, SAG))
    phi = np.zeros(NuisanceMap.from_experiment(cube).size)
    plain = seen_with(cube, phi).markers.positions_m
    phi[0], phi[4:7] = 0.5, (1.0, 0.0, -2.0)
    scaled = seen_with(cube, phi).markers.positions_m
    since = 1 - np.exp(-cube.t_s / cube.duration_s)
    np.testing.assert_allclose(scaled[:, 0], 1.01 * plain[:, 0], atol=1e-14)
    sag = 0.003 * np.outer(since, [1.0, 0.0, -2.0])
    np.testing.assert_allclose(scaled[:, 1], 1.01 * plain[:, 1] + sag, atol=1e-14)


# Every one by one method; by the others one of them.
FOUND_BY = [
    *((name, "reduced-space") for name in ROWS),
    ("camera_scale", "shooting"),
    ("clock_drift", "interior-point"),
]


@pytest.mark.parametrize(("name", "method"), FOUND_BY)
def test_a_nuisance_parameter_of_a_user_is_found_beside_the_material(name: str, method: str, rng):
    steps, sigma_m = (14, 1e-7) if method == "reduced-space" else (9, 1e-5)
    cube = known_to(replace(cube_with_gaps(steps), nuisance=only(ROWS[name])), sigma_m)
    phi = rng.uniform(-1, 1, NuisanceMap.from_experiment(cube).size)
    solution = solve(cs.Problem([seen_with(cube, phi)], GUESS), method)
    assert solution.status.converged
    (part,) = solution.collocation.iterates(solution.z)
    np.testing.assert_allclose(part.phi, phi, atol=1e-3)
    np.testing.assert_allclose(solution.theta, list(TRUTH.values()), rtol=1e-3)


def test_a_run_reports_the_users_parameter_and_the_verdict_judges_it():
    cube = known_to(replace(hung_cube(14), nuisance=only(SCALE)), 1e-4)
    far = 5.0  # deviations of its prior
    seen = seen_with(cube, np.array([far]))
    noise = 1e-4 * np.random.default_rng(2).normal(size=seen.markers.positions_m.shape)
    noisy = cs.with_markers(seen, seen.markers.positions_m + noise)
    finished = run(cs.Problem([noisy], GUESS, substeps=1), seek_causes=False)
    (told,) = finished.result.nuisance["hung cube"].items()
    assert told[0] == "camera scale [1]"
    assert told[1].prior == 0.02
    assert abs(told[1].value - far * 0.02) < 3.5 * told[1].std_error < 0.01
    assert any("camera scale" in reason for reason in finished.trust.reasons)
    said = " ".join(plain_text(run_summary(finished.result, Path("run"), details=True)).split())
    assert re.search(r"camera scale (9\.\d|10) % \(prior ±2 %\)", said)


def test_an_omitted_nuisance_parameter_spoils_the_answer():
    """What the parameter is for: stiffness takes the blame for the scale."""
    cube = known_to(replace(hung_cube(14), nuisance=only(SCALE)), 1e-5)
    seen = seen_with(cube, np.array([-2.0]))
    blind = replace(seen, nuisance=cs.Nuisance.none())
    errors = [
        np.abs(np.log(ReducedSpace()(Collocation([each], GUESS)).theta / list(TRUTH.values())))
        for each in (seen, blind)
    ]
    assert errors[0].max() < 0.05 < errors[1].max()


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ({"reading": None}, "'extra' has no effect; expected exactly one"),
        ({"sigma": None}, "'extra' has no sigma; expected the standard deviation of its prior"),
        ({"sigma": 0.0}, "'extra': sigma is 0; expected a number above 0"),
        ({"name": "tare"}, "two nuisance parameters are named 'tare'"),
        ({"of": "load"}, "'extra' has of = 'load'; expected 'recording' or 'marker'"),
        ({"reading": lambda y, v, t_s, data: y[:2]}, r"has the shape \(2, 1\); expected \(3, 1\)"),
        (
            {"reading": lambda y, v, t_s, data: y + v.nothing},
            "the reading of the nuisance parameter 'extra' failed",
        ),
        (
            {"reading": lambda y, v, t_s, data: y + ca.sqrt(v)},
            "the reading of the nuisance parameter 'extra', or its derivative .* is not finite",
        ),
        (
            {"reading": None, "clock": lambda v, t_s, data: ca.vertcat(v, v)},
            r"the clock of the nuisance parameter 'extra' has the shape \(2, 1\); expected \(1, 1\)",
        ),
    ],
)
def test_a_row_that_cannot_be_is_refused(row, message: str):
    given = {"name": "extra", "unit": "1", "sigma": 0.1, "reading": lambda y, v, t, d: y + v} | row
    with pytest.raises(InputError, match=message):
        cs.Problem([replace(hung_cube(4), nuisance=only(cs.Deviation(**given)))], GUESS)


# Problem files

ALLOWED = ("--allow-code",)
CAMERAS = """
from collocation_sysid import Deviation

SCALE = Deviation(
    "camera_scale", "1", 0.02, reading=lambda y, scale, t_s, data: (1 + scale) * y
)
"""
OWN = """[experiment.nuisance]
marker_offsets = "none"
hand_eye = "none"
[[experiment.nuisance.own]]
file = "cameras.py"
row = "SCALE"
[experiment.markers]"""


@pytest.fixture
def scaled(tiny: Path) -> Path:
    """A problem whose cameras see everything 3 % too large, and a file that allows for that."""
    replace_text('nuisance = "none"\n', "")(tiny)
    replace_text("[experiment.markers]", OWN)(tiny)
    replace_text('"interior-point"', '"reduced-space"')(tiny)
    write("cameras.py", CAMERAS)(tiny)
    head, *lines = (tiny / "swing_markers.csv").read_text().splitlines()
    cells = [[float(cell) for cell in line.split(",")] for line in lines]
    seen = [",".join(str(c if k == 0 else 1.03 * c) for k, c in enumerate(row)) for row in cells]
    write("swing_markers.csv", "\n".join([head, *seen]) + "\n")(tiny)
    return tiny


def test_a_file_gives_a_row_where_that_is_allowed(scaled: Path):
    done = run_command("solve", "problem.toml", "--allow-code", "--out", "run")
    assert done.code == 0, done.err
    found = json.loads((scaled / "run" / "result.json").read_text())
    scale = found["nuisance"]["swing"]["camera scale [1]"]
    assert abs(scale["value"] - 0.03) < 3.5 * scale["std_error"] < 0.03
    page = scaled / "page.html"
    assert run_command("report", "run", "--to", page).code == 0
    assert re.search(r"camera scale</td>\s*<td[^>]*>[23](\.\d)? %<", page.read_text())


@pytest.mark.parametrize(
    ("edit", "options", "message"),
    [
        (lambda folder: None, (), "nuisance.own: found the file cameras.py, which would be run"),
        (replace_text('"SCALE"', '"SCAL"'), ALLOWED, "no Deviation 'SCAL'; expected one of"),
        (write("cameras.py", "SCALE = 3"), ALLOWED, "expected one of none"),
        (write("cameras.py", CAMERAS.replace("* y", "* y[:1]")), ALLOWED, "has the shape (1, 1)"),
    ],
)
def test_a_file_that_gives_no_row_is_refused(scaled: Path, edit, options, message: str):
    edit(scaled)
    done = run_command("check", "problem.toml", *options)
    assert done.code == 2
    assert message in " ".join(done.err.split())
