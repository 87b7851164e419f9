"""Coordinates and samples that are missing: what is present is used, and losses are reported."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from kit.problems import GUESS, TRUTH, hung_cube, measured

import collocation_sysid as cs
from collocation_sysid.errors import InputError
from collocation_sysid.features.measurements import lost_samples
from collocation_sysid.statistics.linearised import linearise_fit


@pytest.fixture(scope="module")
def seen_from_the_side():
    """The hung cube, of whose markers a camera sees x and z."""
    cube = measured(hung_cube())
    tracks_m = np.array(cube.markers.positions_m)
    tracks_m[..., 1] = np.nan
    return replace(cube, markers=replace(cube.markers, positions_m=tracks_m))


@pytest.mark.long
def test_two_coordinates_of_each_marker_identify_the_body(seen_from_the_side):
    problem = cs.Problem([seen_from_the_side], GUESS, scheme="midpoint")
    solution = cs.solve(problem)
    for name, value in TRUTH.items():
        assert solution.parameters[name] == pytest.approx(value, rel=2e-2)
    count = 2 * seen_from_the_side.markers.is_present.sum()
    assert solution.collocation.measurement_count == count
    fit = linearise_fit(solution.collocation, solution.z)
    assert fit.blocks[0].measurement_count == count
    (note,) = (note for note in solution.notes if "present in less than half" in note)
    assert "y (0%)" in note
    assert "hung cube" in note


def test_complete_tracks_have_no_note():
    assert lost_samples(measured(hung_cube())) == []


def test_markers_without_any_sample_are_refused_beside_another_sensor():
    cube = measured(hung_cube())
    nothing = np.full_like(cube.markers.positions_m, np.nan)
    heights_m = np.zeros((len(cube.t_s), 1))
    gauge = cs.Gauge(
        "height", lambda at: at.position_m[2, 0], cube.t_s, heights_m, 1e-3, [[0, 0, 0]]
    )
    blind = replace(cube, markers=replace(cube.markers, positions_m=nothing), readings=[gauge])
    with pytest.raises(InputError, match="nothing of the markers of 'hung cube' is measured"):
        cs.solve(cs.Problem([blind], GUESS, scheme="midpoint"))


def test_few_values_of_a_sensor_have_a_note():
    cube = measured(hung_cube())
    heights_m = np.full((len(cube.t_s), 1), np.nan)
    heights_m[:3] = 0.0
    gauge = cs.Gauge(
        "height", lambda at: at.position_m[2, 0], cube.t_s, heights_m, 1e-3, [[0, 0, 0]]
    )
    (note,) = lost_samples(replace(cube, readings=[gauge]))
    assert "of 'height', 1 of 1 columns" in note
    assert "height 1 (27%)" in note
