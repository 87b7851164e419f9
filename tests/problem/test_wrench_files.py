"""Wrenches in files and in problem files, and messages about wrong ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from kit.problem_files import run_command

from collocation_sysid.errors import InputError
from collocation_sysid.problem import Problem
from collocation_sysid.recording import Wrench, read_wrench, write_wrench_csv
from collocation_sysid.result.synthesis import Recipe, write_data

SENSOR = 'wrench = { file = "force.csv", sigma_n = 0.001, sigma_nm = 0.0001 }'
HEADER = "t_s,fx_n,fy_n,fz_n,tx_nm,ty_nm,tz_nm"
ROWS = [f"{0.01 * k:.2f},0,0,0.1,0,0,0" for k in range(9)]


def lines(header: str = HEADER, rows: list[str] | None = None) -> str:
    return "\n".join([header, *(ROWS if rows is None else rows)]) + "\n"


def with_sensor(folder: Path, text: str | None = None, sensor: str = SENSOR) -> Path:
    """The tiny problem with a sensor at its grasp."""
    file = folder / "problem.toml"
    file.write_text(file.read_text().replace("poses =", f"{sensor}, poses =", 1))
    if text is not None:
        (folder / "force.csv").write_text(text)
    return file


def test_written_wrenches_are_read_again(tmp_path: Path, rng: np.random.Generator):
    t_s, values = np.arange(5) / 3, rng.normal(size=(5, 6))
    values[2, 1] = np.nan
    write_wrench_csv(tmp_path / "w.csv", t_s, values)
    read_s, found, _ = read_wrench(tmp_path / "w.csv")
    np.testing.assert_allclose(read_s, t_s, rtol=1e-11)
    np.testing.assert_allclose(found, values, rtol=1e-11)


def test_components_that_are_not_measured_are_left_out(tmp_path: Path):
    (tmp_path / "w.csv").write_text("fz_n,t_s\n1.5,0.0\n,0.1\n2.5,0.2\n")
    t_s, found, _ = read_wrench(tmp_path / "w.csv")
    np.testing.assert_array_equal(found[:, 2], [1.5, np.nan, 2.5])
    wrench = Wrench(t_s, found, 0.1)
    assert wrench.component_names == ("fz",)
    assert wrench.is_measured.sum() == 2


BAD = {
    "no unit": (
        lines("t_s,fx,fy_n,fz_n,tx_nm,ty_nm,tz_nm"),
        ["fx names no unit", "for example fx (N)"],
    ),
    "a mass": (
        lines("t_s,fx_kg,fy_n,fz_n,tx_nm,ty_nm,tz_nm"),
        ["fx_kg has the unit kg", "a unit of force", "kgf", "fx_n"],
    ),
    "a length": (lines("t_s,fx_n,fy_n,fz_n,tx_mm,ty_nm,tz_nm"), ["tx_mm has the unit mm", "tx_nm"]),
    "unknown column": (
        lines("t_s,fx_n,fy_n,fz_n,mx_nm,ty_nm,tz_nm"),
        ["mx_nm is not among them", "did you mean 'tx_nm'"],
    ),
    "twice": (
        lines("t_s,fx_n,fx_n,fz_n,tx_nm,ty_nm,tz_nm"),
        ["the columns fx_n, fx_n could all be fx"],
    ),
    "no time": (
        lines("time,fx_n,fy_n,fz_n,tx_nm,ty_nm,tz_nm"),
        ["column time names no unit", "for example time (s)"],
    ),
    "only times": ("t_s\n0\n1\n", ["the columns are t_s; expected t_s and any of"]),
    "text": (lines(rows=[*ROWS[:3], "0.03,0,0,much,0,0,0"]), ["line 5", "fz_n holds 'much'"]),
    "time stands still": (
        lines(rows=[*ROWS[:3], "0.02,0,0,0,0,0,0"]),
        ["line 5", "time must increase"],
    ),
    "short row": (lines(rows=[*ROWS[:3], "0.03,0"]), ["line 5", "2 cells"]),
    "empty": ("", ["is empty"]),
}


@pytest.mark.parametrize(("text", "words"), BAD.values(), ids=BAD)
def test_a_file_that_cannot_be_read_gives_the_reason(tmp_path: Path, text: str, words: list[str]):
    file = tmp_path / "force.csv"
    file.write_text(text)
    with pytest.raises(InputError) as caught:
        read_wrench(file)
    assert str(file) in str(caught.value)
    for word in words:
        assert word in str(caught.value)


SLIPS = {
    "another clock": (
        lines(rows=[f"{1e9 + k},0,0,0,0,0,0" for k in range(9)]),
        SENSOR,
        ["force.csv runs from 1e+09 s", "the same clock"],
    ),
    "milliseconds": (
        lines(rows=[f"{10 * k + 5},0,0,0,0,0,0" for k in range(9)]),
        SENSOR,
        ["seems to be in milliseconds"],
    ),
    "no sigma of torques": (
        lines(),
        'wrench = { file = "force.csv", sigma_n = 0.001 }',
        ["grasp.wrench", "sigma_nm is missing"],
    ),
    "no sigma": (lines(), 'wrench = { file = "force.csv" }', ["grasp.wrench", "found no sigma_n"]),
    "no sense in sigma": (
        lines(),
        'wrench = { file = "force.csv", sigma_n = 0.0 }',
        ["grasp.wrench.sigma_n", "0"],
    ),
    "no file": (None, SENSOR, ["force.csv", "does not exist", "grasp.wrench.file"]),
    "another frame": (
        lines(),
        SENSOR.replace(" }", ', frame = "tool" }'),
        ["grasp.wrench.frame", "'tool'"],
    ),
    "misspelt": (lines(), SENSOR.replace("sigma_nm", "sigma_mn"), ["sigma_mn"]),
}


@pytest.mark.parametrize(("text", "sensor", "words"), SLIPS.values(), ids=SLIPS)
def test_a_slip_in_the_problem_is_named(tiny: Path, text: str, sensor: str, words: list[str]):
    file = with_sensor(tiny, text, sensor)
    with pytest.raises(InputError) as caught:
        Problem.read(file)
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"values": np.zeros((3, 4))}, "shape"),
        ({"t_s": [0.0, 0.2, 0.1]}, "time must increase"),
        ({"values": np.full((3, 6), np.nan)}, "all values of the measured wrench are missing"),
        ({"sigma_nm": None}, "sigma_nm is missing"),
        ({"sigma_n": -1.0}, "sigma_n of a wrench is -1"),
        ({"frame": "hand"}, "expected 'world' or 'grasp'"),
        ({"point_m": [0.0, 1.0]}, "point_m"),
        ({"values": np.full((3, 6), np.inf)}, "infinite"),
    ],
)
def test_a_wrench_is_checked(changes: dict, words: str):
    given = {"t_s": [0.0, 0.1, 0.2], "values": np.zeros((3, 6)), "sigma_n": 1.0, "sigma_nm": 1.0}
    with pytest.raises(InputError, match=words):
        Wrench(**(given | changes))


def test_simulate_writes_wrenches_that_the_problem_reads(tiny: Path):
    file = with_sensor(tiny)
    problem = Problem.read(file, simulation=True)
    written = write_data(problem, tiny / "data", Recipe(noise_n=1e-3))
    assert tiny / "data" / "swing_wrench.csv" in written
    t_s, values, _ = read_wrench(tiny / "data" / "swing_wrench.csv")
    (experiment,) = problem.experiments
    np.testing.assert_allclose(t_s, experiment.t_s)
    # The body starts at rest: the grasp carries its weight.
    assert values[0, 2] == pytest.approx(9.81 * experiment.body.mass_kg, abs=0.01)
    (tiny / "data" / "swing_wrench.csv").rename(tiny / "force.csv")
    (grasp,) = Problem.read(file).experiments[0].grasps
    assert grasp.wrench is not None
    np.testing.assert_array_equal(grasp.wrench.values, values)


def test_the_command_line_takes_the_noise_of_wrenches(tiny: Path):
    with_sensor(tiny)
    command = ["simulate", "problem.toml", "--out", "data", "--noise-n", "-1"]
    result = run_command(*command)
    assert result.code == 2
    assert "--noise-n" in result.err
