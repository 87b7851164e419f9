"""Marked fields of dataclasses: selection of times, interpolation and scaling of loads."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest

from collocation_sysid.common.time_dependence import (
    LOAD,
    PARTS_OVER_TIME,
    at_times,
    interpolate_in_time,
    over_time,
    scale_loads,
    values_over_time,
)


@dataclass(frozen=True, eq=False)
class Tide:
    height_m: np.ndarray = field(metadata=over_time())
    name: str = ""


@dataclass(frozen=True, eq=False)
class Storm:
    wind_n: np.ndarray = field(metadata=over_time(axis=1, is_load=True))
    weight_n: float = field(metadata=LOAD)
    tides: tuple[Tide, ...] = field(metadata=PARTS_OVER_TIME)
    main: Tide = field(metadata=PARTS_OVER_TIME)
    rain: np.ndarray | None = field(default=None, metadata=over_time())


def storm(start: float, name: str) -> Storm:
    heights = start + np.arange(4.0)
    tides = (Tide(heights, name), Tide(2 * heights, name))
    return Storm(start + np.arange(8.0).reshape(2, 4), weight_n=start, tides=tides, main=tides[0])


@pytest.mark.parametrize(
    "rows", [slice(1, 3), np.array([1, 2]), np.array([False, True, True, False])]
)
def test_times_are_selected_along_the_marked_axis_of_all_parts(rows):
    whole = storm(1.0, "a")
    part = at_times(whole, rows)
    np.testing.assert_array_equal(part.wind_n, whole.wind_n[:, 1:3])
    np.testing.assert_array_equal(part.main.height_m, [2.0, 3.0])
    np.testing.assert_array_equal(part.tides[1].height_m, [4.0, 6.0])
    assert part.weight_n == 1.0
    assert part.rain is None
    assert part.tides[1].name == "a"
    assert len(whole.main.height_m) == 4


def test_loads_are_scaled_and_all_else_stays():
    whole = storm(1.0, "a")
    half = scale_loads(whole, 0.5)
    np.testing.assert_array_equal(half.wind_n, 0.5 * whole.wind_n)
    assert half.weight_n == 0.5
    assert half.tides is whole.tides
    assert scale_loads(whole.main, 0.5) is whole.main


def test_arrays_are_interpolated_and_all_else_is_that_of_the_later_one():
    before = storm(0.0, "a")
    after = storm(4.0, "b")
    between = interpolate_in_time(before, after, share=0.25)
    np.testing.assert_allclose(between.wind_n, before.wind_n + 1.0)
    np.testing.assert_allclose(between.tides[1].height_m, before.tides[1].height_m + 2.0)
    assert between.weight_n == 4.0
    assert between.tides[1].name == "b"


def test_constants_are_returned_unchanged():
    @dataclass(frozen=True)
    class Coast:
        length_m: float

    coast = Coast(3.0)
    assert at_times(coast, slice(1)) is coast
    assert interpolate_in_time(coast, coast, share=0.5) is coast


def test_the_values_over_time_are_named_as_their_fields():
    values = values_over_time(storm(0.0, "a"))
    assert list(values) == ["wind_n", "rain"]
    assert values["rain"] is None
