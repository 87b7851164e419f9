"""Motions of a problem file that starts with a velocity, against closed forms."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import collocation_sysid as cs

T_S = 0.004 * np.arange(41)
VELOCITY_M_S = np.array([0.2, -0.1, 1.5])
UNDAMPED = {"gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
HEAD = """
[object]
box_m = [0.01, 0.01, 0.1]
edge_length_m = 0.05
material = "linear"
density_kg_m3 = {density}
rest_shape = "stress_free"
[parameters]
young_pa = {{ guess = 5e4 }}
poisson = 0.0
gamma_r_s = 0.0
gamma_m_1_s = 0.0
[environment]
air_density_kg_m3 = "none"
[[experiment]]
name = "start"
start = "undeformed"
start_velocity_m_s = {velocity}
gravity_m_s2 = {gravity}
nuisance = "none"
"""
MARKERS = """
[experiment.markers]
file = "tracks.csv"
sigma_m = 1e-5
reference_m = {{ low = {low}, other = {other} }}
"""


def read(folder: Path, text: str, tracks_m: np.ndarray, places: np.ndarray) -> cs.Problem:
    """Problem with the tracks (T, 2, 3) of two markers at places (2, 3)."""
    low, other = places.tolist()
    (folder / "problem.toml").write_text(text + MARKERS.format(low=low, other=other))
    header = "t_s," + ",".join(f"{name}_{axis}" for name in ("low", "other") for axis in "xyz")
    table = np.column_stack([T_S, tracks_m.reshape(len(T_S), 6)])
    np.savetxt(folder / "tracks.csv", table, delimiter=",", header=header, comments="")
    return cs.Problem.read(folder / "problem.toml")


def test_a_thrown_body_of_a_file_flies_along_the_parabola(tmp_path: Path):
    text = HEAD.format(density=1000.0, velocity=VELOCITY_M_S.tolist(), gravity=[0, 0, -9.81])
    places = np.array([[0.0, 0.0, 0.0], [0.01, 0.01, 0.1]])
    fall_m = np.outer(T_S**2 / 2, [0, 0, -9.81])
    flight_m = places + (np.outer(T_S, VELOCITY_M_S) + fall_m)[:, None]
    (experiment,) = read(tmp_path, text, flight_m, places).experiments
    motion = cs.simulate(experiment, UNDAMPED | {"young_pa": 1e5, "poisson": 0.0}, "midpoint")
    np.testing.assert_allclose(motion.markers_m, flight_m, atol=1e-8)


def test_a_light_bar_with_a_heavy_end_is_a_spring(tmp_path: Path):
    """x = v/ω sin ωt with ω² = E A/(L m), and half of it in the middle of the bar."""
    young_pa, mass_kg, speed_m_s = 1e5, 0.05, 0.05
    omega = np.sqrt(young_pa * 1e-4 / 0.1 / mass_kg)
    text = HEAD.format(density=1.0, velocity=[0.0, 0.0, -speed_m_s], gravity=[0, 0, 0])
    text += (
        "[experiment.grasp]\nnodes = { box_m = [[-1, -1, 0.0999], [1, 1, 1]] }\n"
        f"[[experiment.mass]]\nnodes = {{ box_m = [[-1, -1, -1], [1, 1, 1e-6]] }}\nmass_kg = {mass_kg}\n"
    )
    places = np.array([[0.005, 0.005, 0.0], [0.005, 0.005, 0.05]])
    down_m = -speed_m_s / omega * np.sin(omega * T_S)
    tracks_m = places + down_m[:, None, None] * np.array([[0, 0, 1.0], [0, 0, 0.5]])
    problem = read(tmp_path, text, tracks_m, places)
    (experiment,) = problem.experiments
    motion = cs.simulate(
        experiment, UNDAMPED | {"young_pa": young_pa, "poisson": 0.0}, "midpoint", substeps=8
    )
    amplitude_m = speed_m_s / omega
    np.testing.assert_allclose(motion.markers_m, tracks_m, atol=0.01 * amplitude_m)
    assert cs.solve(problem).parameters["young_pa"] == pytest.approx(young_pa, rel=0.01)
