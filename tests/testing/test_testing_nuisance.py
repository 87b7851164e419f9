"""`check_nuisance`: every nuisance parameter passes, and each fault is one sentence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from kit.nuisance_check import check_nuisance
from kit.problems import bar_loaded, bar_with_nuisance, driven_bar, hung_cube, pressed_cube
from kit.wrenches import wristed_cube

import collocation_sysid as cs
from collocation_sysid.recording.nuisance import (
    CLAMP_TURN,
    DEPTH_EDGE,
    KINDS,
    START_ACCELERATION,
    START_VELOCITY,
    STRAIN_ZERO,
    TEMPERATURE,
    TOOL_CENTRE,
)


def cube_with_camera() -> cs.Experiment:
    """A cube that a depth camera sees between its samples."""
    cube = hung_cube(5, (1, 1, 2))
    pose = np.array([[1, 0, 0, 0.05], [0, 0, 1, -0.4], [0, -1, 0, 0.05], [0, 0, 0, 1.0]])
    camera = cs.DepthCamera([[100, 0, 0], [0, 100, 0], [0, 0, 1]], pose=pose)
    places = np.random.default_rng(0).uniform([-0.04, -0.04, 0.395], [0.04, 0.04, 0.405], (9, 3))
    depth = cs.Depth("front", cube.t_s[1:4] + 0.003, [places] * 3, 0.05, camera, gate_m=0.1)
    return replace(cube, depths=[depth])


def cube_with_a_displacement() -> cs.Experiment:
    """A cube whose grasp has a displacement of unknown zero."""
    cube = hung_cube(5, (1, 1, 2))
    return replace(cube, grasps=[replace(cube.grasps[0], zero="xyz")])


def cube_with_sensor() -> cs.Experiment:
    return replace(wristed_cube(5), nuisance=cs.Nuisance.none())


def bar_with_loads() -> cs.Experiment:
    return replace(bar_loaded(5), nuisance=cs.Nuisance.none())


def pulled_specimen() -> cs.Experiment:
    """A specimen without a mesh, whose strain has an unknown zero."""
    strain = np.linspace(0.0, 0.2, 5)
    return cs.Specimen("uniaxial", strain, 1e3 * strain, 10.0).experiment(name="pull")


# Recordings that have the parameters of a component; the others are those of every recording.
RECORDINGS: dict[str, Callable[[], cs.Experiment]] = {
    "grasp": cube_with_a_displacement,
    "obstacle": lambda: pressed_cube(3),
    "tendon": lambda: replace(driven_bar(4), nuisance=cs.Nuisance.none()),
    "pressure": lambda: replace(driven_bar(4), nuisance=cs.Nuisance.none()),
    "load": bar_with_loads,
    "sensor": cube_with_sensor,
    "camera": cube_with_camera,
}
# Edges need images (`test_depth_outline`), the stiffness a temperature (`test_temperature`), and errors
# of ordinary cameras their images (`test_camera_deviations`).
CHECKED = [row for row in KINDS if row not in (DEPTH_EDGE, TEMPERATURE) and row.of != "images"]


@pytest.mark.parametrize("row", CHECKED, ids=lambda row: row.name)
def test_every_parameter_of_the_package_passes(row: cs.Deviation):
    experiment = RECORDINGS[row.of]() if row.of in RECORDINGS else None
    if row == STRAIN_ZERO:
        experiment = replace(pulled_specimen(), nuisance=cs.Nuisance.none())
    if row == CLAMP_TURN:  # only several clamps have turns of their own
        experiment = replace(bar_with_nuisance(), nuisance=cs.Nuisance.none())
    if row in (START_ACCELERATION, START_VELOCITY):
        experiment = hung_cube(4, start="moving")
    if row == TOOL_CENTRE:  # there is none without the mass of a tool
        assert experiment is not None
        experiment = replace(experiment, nuisance=cs.Nuisance.none(tool_kg=0.01))
    check_nuisance(row, experiment=experiment)


def scaled(y, values, t_s, data):
    return (1 + values) * y


ROWS = {
    "scale": cs.Deviation("camera_scale", "1", 0.02, reading=scaled),
    "drift": cs.Deviation("drift", "1", 0.05, clock=lambda values, t_s, data: values * t_s),
    "sag": cs.Deviation(
        "sag",
        "m",
        0.003,
        of="marker",
        axes="x y z",
        reading=lambda y, values, t_s, data: y + values * (1 - ca.exp(-t_s / data.duration_s)),
    ),
}


@pytest.mark.parametrize("name", ROWS)
def test_parameters_of_a_user_pass(name: str):
    check_nuisance(ROWS[name])


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (
            {"reading": lambda y, values, t_s, data: 1.01 * y + values},
            r"'mine': the value zero changes the reading of a marker, entry \(\d,\); found .*, expected",
        ),
        (
            {"reading": lambda y, values, t_s, data: y + values + ca.floor(1e4 * y) / 1e2},
            "zero changes the reading of a marker|the first derivative of the reading is wrong",
        ),
        (
            {"reading": None, "clock": lambda values, t_s, data: values + 1e-3},
            r"'mine': the value zero changes the clock, entry \(0,\); found 0.001, expected 0",
        ),
        (
            {"applies": lambda experiment: False},
            "the recording 'check' has no value of this parameter; found no",
        ),
    ],
)
def test_a_fault_is_one_sentence(change: dict, sentence: str):
    row = replace(cs.Deviation("mine", "m", 0.01, reading=scaled), **change)
    with pytest.raises(AssertionError, match=sentence):
        check_nuisance(row)
