"""User-defined sensors: an accelerometer in the body, a strain gauge between two points."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from kit.problem_files import AT_TRUTH, replace_text, run_command, settings, write
from kit.problem_files import TRUTH as TINY_TRUTH
from kit.problems import GUESS, IDEAL, TRUTH, hung_cube
from kit.sensors import CLAMPED, accelerometer, instrumented, noisy, strain_gauge
from kit.static import HANGING, block

from collocation_sysid.errors import InputError
from collocation_sysid.methods.interior_point import InteriorPoint
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.pipeline import run
from collocation_sysid.problem import Problem
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.program.simulation import simulate, with_readings
from collocation_sysid.recording import (
    Experiment,
    Gauge,
    GraspQuantities,
    Markers,
    PointQuantities,
    Wrench,
)
from collocation_sysid.result.pictures.album import experiment_pictures as album_pictures
from collocation_sysid.result.pictures.over_time import sensor_picture
from collocation_sysid.result.replay import read_run
from collocation_sysid.runs.solving import solve


def pull(at: GraspQuantities, gain):
    """One axis of a load cell between the clamp and the robot, its gain not known."""
    return (1 + gain) * at.force_n[2]


def speed(at: PointQuantities):
    return ca.norm_2(at.velocity_m_s)


def swung(steps: int = 24) -> Experiment:
    """The cube in a hand, with an accelerometer of its own clock and a foil; no marker sees it."""
    cube = replace(hung_cube(steps), nuisance=IDEAL)
    inner = np.linspace(cube.t_s[2], cube.t_s[-3], 2 * steps)
    gauges = accelerometer(inner), strain_gauge(cube.t_s[::2])
    made = replace(cube, markers=Markers.none(cube.t_s), readings=gauges)
    accelerations, strains = simulate(made, TRUTH, "midpoint", substeps=1).custom_sensor_values
    return with_readings(made, [accelerations + np.array([0, 0, 0.3]), 1.04 * strains])


def test_an_accelerometer_at_rest_reads_gravity_and_follows_a_carried_body():
    cube = replace(hung_cube(20), nuisance=IDEAL)
    top = cube.grasps[0].nodes[0]
    at_top = accelerometer(cube.t_s, points_m=cube.body.nodes_m[[top]])
    (found,) = simulate(
        instrumented(cube, at_top), TRUTH, "midpoint", substeps=1
    ).custom_sensor_values
    carried = cube.grasps[0].positions_at(cube.body.nodes_m, np.linspace(0, cube.t_s[-1], 2001))[
        :, 0
    ]
    expected = np.gradient(np.gradient(carried, axis=0), axis=0)[::100] / (cube.t_s[-1] / 2000) ** 2
    inside = slice(3, -3)
    error = np.abs(found - expected - [0, 0, 9.81])[inside].max()
    assert error < 0.05 * np.abs(expected[inside]).max()


@pytest.mark.parametrize("method", [ReducedSpace(), InteriorPoint()], ids=lambda m: m.name)
def test_the_truth_is_found_from_an_accelerometer_and_a_foil_alone(method):
    solution = method(Collocation([swung()], GUESS))
    (part,) = solution.collocation.iterates(solution.z)
    found = part.phi * part.transcription.nuisance.scales
    np.testing.assert_allclose(found, [0.3, 0.04], atol=0.02)
    full = part.transcription.nuisance.names[0]
    for name in ("bias_m_s2", full, full.partition(": ")[2], "bias of accelerometer"):
        assert solution.nuisance(name) == found[0]
    assert solution.nuisance("scale") == found[1]
    with pytest.raises(InputError, match="'reading' is ambiguous; expected one of"):
        solution.nuisance("reading")
    with pytest.raises(InputError, match="no nuisance parameter 'gain'; expected one of"):
        solution.nuisance("gain")
    for name in ("lambda_pa", "mu_pa"):
        assert solution.parameters[name] == pytest.approx(TRUTH[name], rel=0.05)


def test_a_static_experiment_is_read_too():
    static = replace(block("xyz", gravity_m_s2=HANGING), nuisance=IDEAL)
    low, high = static.body.nodes_m.min(axis=0), static.body.nodes_m.max(axis=0)
    ends = [(low + high) / 2, [*((low + high) / 2)[:2], high[2]]]
    foil = replace(strain_gauge(static.t_s), points_m=ends)
    (found,) = simulate(instrumented(static, foil), TRUTH).custom_sensor_values
    positions = simulate(static, TRUTH).positions_m
    assert np.ptp(found) > 0
    assert len(found) == len(positions)


@pytest.mark.long
def test_error_bars_and_verdict_contain_unknowns_of_sensors():
    made = noisy(swung())
    finished = run(Problem([made], GUESS), seek_causes=False)
    assert finished.uncertainty is not None
    names = list(finished.uncertainty.nuisance)
    assert names == [
        f"{made.name}: bias of accelerometer [m/s²]",
        f"{made.name}: scale of foil [1]",
    ]
    assert 0 < finished.uncertainty.nuisance[names[0]] < 1
    assert finished.trust is not None


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"sigma": 0.0}, "sigma of the reading 'accelerometer' is 0; expected a number above 0"),
        ({"unknowns": {"bias_m_s2": -1.0}}, "bias_m_s2 of the reading 'accelerometer' is -1"),
        ({"points_m": [[0.0, 0.0]]}, "points_m of the reading 'accelerometer'"),
        ({"points_m": [[0.0], [1.0, 2.0]]}, "points_m of the reading .* must hold numbers"),
        ({"values": np.full((9, 3), np.nan)}, "all values of the reading .* are missing"),
        ({"t_s": np.zeros(9)}, "of the reading 'accelerometer'"),
        ({"values": np.zeros((9, 2))}, "gives 3 numbers; expected 2"),
        ({"expression": lambda at: at.position_m}, "cannot be evaluated .*bias_m_s2"),
        (
            {"expression": pull, "unknowns": {"gain": 1.0}},
            "with the attributes t_s, position_m, velocity_m_s",
        ),
        ({"expression": speed, "unknowns": {}, "values": np.zeros(9)}, "not finite for .* at rest"),
        ({"grasp": 0}, "has both points_m and grasp"),
        ({"expression": lambda at, bias_m_s2: None}, "the function returns None"),
        ({"unknowns": {}}, r"of its unknowns \(none\)"),
        ({"points_m": ()}, "has neither points_m nor grasp"),
        ({"sigma": "1e-3"}, "sigma of the reading 'accelerometer' is '1e-3'; expected a number"),
        ({"frame": "hand"}, "frame of the reading 'accelerometer' is 'hand'; expected 'world'"),
    ],
)
def test_missing_keys_of_a_custom_sensor_are_named(changes: dict, words: str):
    good = accelerometer(0.01 * np.arange(9))
    with pytest.raises(InputError, match=words):
        replace(good, **changes)


def test_a_grasp_has_a_number_from_one_on():
    cube = hung_cube(9)
    last = replace(accelerometer(cube.t_s), points_m=(), grasp=1, **CLAMPED)
    assert instrumented(cube, last).instrumented_grasps == (0,)
    with pytest.raises(
        InputError, match="refers to grasp 0; expected the number of a grasp, 1 to 1"
    ):
        instrumented(cube, replace(last, grasp=0))


def test_a_reading_of_another_time_or_place_is_refused():
    cube = hung_cube(9)
    with pytest.raises(InputError, match="accelerometer"):
        instrumented(cube, accelerometer(cube.t_s + 100))
    nobody = replace(accelerometer(cube.t_s), points_m=(), grasp=2, **CLAMPED)
    with pytest.raises(
        InputError, match="refers to grasp 2; expected the number of a grasp, 1 to 1"
    ):
        instrumented(cube, nobody)
    far = instrumented(cube, accelerometer(cube.t_s, points_m=[[1.0, 0, 0]]))
    with pytest.raises(
        InputError, match=r"point 1 of the reading 'accelerometer' at .*expected points_m on"
    ):
        simulate(far, TRUTH, "midpoint", substeps=1)


def test_a_sensor_without_values_is_simulated_but_not_fitted():
    cube = replace(hung_cube(9), nuisance=IDEAL)
    empty = replace(accelerometer(cube.t_s), values=None)
    assert empty.values is None
    assert replace(empty, sigma=0.1).values is None
    made = instrumented(cube, empty)
    (read,) = simulate(made, TRUTH, "midpoint", substeps=1).custom_sensor_values
    assert read.shape == (len(cube.t_s), 3)
    assert np.isfinite(read).all()
    words = "the reading 'accelerometer' of experiment .* has no values"
    with pytest.raises(InputError, match=words):
        solve(Problem([made], GUESS))
    with pytest.raises(InputError, match=words):
        run(Problem([made], GUESS))
    assert with_readings(made, [read]).readings[0].values is not None


def test_the_number_of_values_is_that_of_the_sensors():
    cube = hung_cube(9)
    made = instrumented(cube, accelerometer(cube.t_s))
    with pytest.raises(InputError, match=r"are 9 arrays; expected a list .*: accelerometer"):
        with_readings(made, np.zeros((9, 3)))


# At a grasp ---------------------------------------------------------------------------------------


def clamped(steps: int = 16) -> Experiment:
    """The cube in a hand, a load cell of one axis in it and a foil on the cube; nothing sees it."""
    cube = replace(hung_cube(steps), nuisance=IDEAL)
    inner = np.linspace(cube.t_s[2], cube.t_s[-3], 2 * steps)
    cell = Gauge("cell", pull, inner, np.zeros(len(inner)), 1e-3, unknowns={"gain": 0.1}, grasp=1)
    made = replace(cube, markers=Markers.none(cube.t_s), readings=[cell, strain_gauge(cube.t_s)])
    felt, strains = simulate(made, TRUTH, "midpoint", substeps=1).custom_sensor_values
    return with_readings(made, [1.05 * felt, 1.04 * strains])


def test_a_load_cell_in_the_clamp_equals_a_sensor_there():
    cube = replace(hung_cube(20), nuisance=IDEAL)
    for frame in ("grasp", "world"):
        wrench = Wrench(cube.t_s, np.zeros((len(cube.t_s), 6)), 1.0, 1.0, frame)
        (grasp,) = cube.grasps
        both = Gauge(
            "both",
            lambda at: ca.vertcat(at.force_n, at.torque_nm),
            cube.t_s,
            np.zeros((len(cube.t_s), 6)),
            1.0,
            grasp=1,
            frame=frame,
        )
        made = replace(cube, grasps=[replace(grasp, wrench=wrench)], readings=[both])
        found = simulate(made, TRUTH, "midpoint", substeps=20)
        there = np.isfinite(found.wrenches[0]) & np.isfinite(found.custom_sensor_values[0])
        assert there.any(axis=0).all()
        size = np.nanmax(np.abs(found.wrenches[0]))
        assert np.abs(found.wrenches[0] - found.custom_sensor_values[0])[there].max() < 1e-4 * size


@pytest.mark.parametrize("method", [ReducedSpace(), InteriorPoint()], ids=lambda m: m.name)
def test_the_truth_is_found_from_a_load_cell_and_a_foil_alone(method):
    solution = method(Collocation([clamped()], GUESS))
    (part,) = solution.collocation.iterates(solution.z)
    found = part.phi * part.transcription.nuisance.scales
    np.testing.assert_allclose(found, [0.05, 0.04], atol=2e-3)
    for name in ("lambda_pa", "mu_pa"):
        assert solution.parameters[name] == pytest.approx(TRUTH[name], rel=0.02)


# In a file ----------------------------------------------------------------------------------------

MINE = """
import casadi as ca

def specific_force(at, bias_m_s2):
    return at.acceleration_m_s2[:, 0] + ca.vertcat(bias_m_s2, 0, 9.81)

def pull(at):
    return at.force_n[0]
"""
READINGS = """
[[experiment.reading]]
name = "chip"
code = "mine.py"
function = "specific_force"
file = "data/swing_reading_chip.csv"
sigma = 0.02
unit = "m/s²"
points_m = [[0.03, 0.02, 0.03]]
unknowns = { bias_m_s2 = 0.5 }

[[experiment.reading]]
name = "cell"
code = "mine.py"
function = "pull"
file = "data/swing_reading_cell.csv"
columns = ["pull_n"]
sigma = 1e-3
grasp = 1
"""
ALLOWED = ("problem.toml", "--allow-code", "--quiet")


@pytest.fixture
def worn(tiny: Path) -> Path:
    """The tiny bar with a chip in it and a load cell in its clamp, without markers."""
    write("mine.py", MINE)(tiny)
    text = (tiny / "problem.toml").read_text()
    (tiny / "problem.toml").write_text(text.partition("\n[experiment.markers]")[0] + READINGS)
    truth = settings(*AT_TRUTH, "transcription.substeps=1")  # the step that it is solved with
    done = run_command("simulate", *ALLOWED, *truth, "--integrator", "midpoint", "--out", "data")
    assert done.code == 0, done.err
    return tiny


def test_readings_in_a_file_are_simulated_and_identified_from(worn: Path):
    head = (worn / "data" / "swing_reading_cell.csv").read_text().splitlines()[0]
    assert head == "t_s,pull_n"
    done = run_command(
        "solve", *ALLOWED, "--out", "found", "--method", "reduced-space", "--details"
    )
    assert done.code == 0, done.err
    result = json.loads((worn / "found" / "result.json").read_text())
    for name, value in TINY_TRUTH.items():
        assert result["parameters"][name]["value"] == pytest.approx(value, rel=0.05)
    assert abs(result["nuisance"]["swing"]["bias of chip [m/s²]"]["value"]) < 0.02
    sizes = result["fit"]["experiments"]["swing"]["reading_rms"]
    assert sizes.keys() == {"chip", "cell"}
    assert f"chip of 'swing': {sizes['chip']:.2g} m/s² RMS (sigma 0.02 m/s²)" in done.out
    assert f"cell of 'swing': {sizes['cell']:.2g} RMS (sigma 0.001)" in done.out
    assert "bias of chip" not in done.out  # zero up to rounding
    with np.load(worn / "found" / "trajectory.npz") as arrays:
        drawn = (
            sensor_picture(arrays["reading_chip"], "xyz"),
            sensor_picture(arrays["reading_cell"], ["cell"]),
        )
    _, (replay,) = read_run(worn / "found")
    assert replay.reading_units == {"chip": "m/s²"}
    pictures = dict(album_pictures(replay))
    assert pictures["reading_swing_chip"].axes[0].get_ylabel() == "[m/s²]"
    assert pictures["reading_swing_cell"].axes[0].get_ylabel() == ""
    shown = [[len(axes.lines) for axes in figure.axes] for figure in drawn]
    assert shown == [[3, 3, 3], [3]]  # measured, fitted, simulated


def blank_cell(folder: Path) -> None:
    file = folder / "data" / "swing_reading_cell.csv"
    head, *rows = file.read_text().splitlines()
    file.write_text("\n".join([head, rows[0] + "x", *rows[1:]]))


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (
            replace_text('"pull"', '"pul"'),
            "no function 'pul'; expected one of specific_force, pull",
        ),
        (replace_text("bias_m_s2 = 0.5", "bias = 0.5"), "reading.0: the reading 'chip' cannot be"),
        (replace_text("at.force_n[0]", "at.force_n", "mine.py"), "gives 3 numbers; expected 1"),
        (
            replace_text("grasp = 1", "grasp = 2"),
            "reading.1.grasp: found 2; expected the number of a grasp, 1 to 1",
        ),
        (replace_text("grasp = 1\n", ""), "has neither points_m nor grasp"),
        (replace_text('"cell"', '"chip"'), "two readings are called 'chip'"),
        (replace_text('"pull_n"', '"pull"'), "swing_reading_cell.csv: line 1: there is no column"),
        (replace_text("ing_cell.csv", "ing_sell.csv"), "reading.1.file: "),
        (replace_text("points_m = [[0.03,", "points_m = [[0.9,"), "point 1 of the reading 'chip'"),
        (blank_cell, "swing_reading_cell.csv: line 2: column pull_n holds"),
    ],
)
def test_an_invalid_custom_sensor_in_a_file_is_one_message(worn: Path, edit, words: str):
    edit(worn)
    done = run_command("check", *ALLOWED)
    assert done.code == 2
    assert words in " ".join(done.err.split())


def test_code_of_a_reading_is_run_only_where_allowed(worn: Path):
    write("mine.py", "raise SystemExit")(worn)
    done = run_command("solve", "problem.toml")
    assert done.code == 2
    assert "reading.0: found the file mine.py, which would be run" in done.err
