"""The first reason of a verdict names what is wrong, or at least nothing that is right.

Each problem has one mistake in its description, or an effect that its laws lack (`kit.misdescribed`).
"""

from __future__ import annotations

import re
from collections.abc import Callable

import pytest
from kit import misdescribed as wrong

import collocation_sysid as cs

Made = Callable[[], cs.Problem]
# Problem; expression of which the first reason must contain a match; expression that no reason may
# contain.
REASONS: dict[str, tuple[Made, str, str]] = {
    "simple shear read as planar, Yeoh": (
        lambda: wrong.sheared_as_planar("yeoh"),
        "with the same law, as simple-shear",
        "First compare laws",
    ),
    "simple shear read as planar, Ogden": (
        lambda: wrong.sheared_as_planar("ogden-1"),
        "with the same law, as simple-shear",
        "First compare laws",
    ),
    "toe": (wrong.with_toe, "window_s", "compare laws|compare-models"),
    "toe, Mooney-Rivlin": (
        lambda: wrong.with_toe("mooney-rivlin"),
        "window_s",
        "compare laws|compare-models|ended at a bound",
    ),
    "slack of a strip": (
        lambda: wrong.with_toe("mooney-rivlin", sign=1),
        "window_s",
        "compare laws|compare-models|ended at a bound",
    ),
    "slack of a lap joint": (
        lambda: wrong.with_toe("mooney-rivlin", "simple-shear", sign=1),
        "window_s",
        "compare laws|compare-models|ended at a bound",
    ),
    "slack of a strip to a strain of 20 %": (
        wrong.rubber_with_slack,
        "window_s",
        "compare laws|compare-models",
    ),
    "strip cut at another angle": (
        wrong.cut_at_another_angle,
        "^turned.* .cut_angle_deg",
        "temperature or clamping|First compare laws|widen its prior",
    ),
    "fibres in compression": (
        lambda: wrong.fibres_in_compression(False),
        "do not determine fibre_pa",
        "time step|widen the bound",
    ),
    "fibres in compression, two strips": (
        lambda: wrong.fibres_in_compression(True),
        "do not determine fibre_pa",
        "time step|widen the bound",
    ),
    "few branches": (
        lambda: wrong.with_few_branches(False),
        r"branches of the memory \(1\) may be too few",
        "clamping|temperature|compare laws|compare-models",
    ),
    "few branches, two temperatures": (
        lambda: wrong.with_few_branches(True),
        r"branches of the memory \(1\) may be too few",
        "clamping|compare laws|compare-models",
    ),
    "slow motion": (
        lambda: wrong.ring_down(4.0),
        "times of the markers.* 4 times too long",
        "none explains it",
    ),
    "slow motion, 240 Hz": (
        lambda: wrong.ring_down(8.0),
        "times of the markers.* 8 times too long",
        "none explains it",
    ),
    "slow motion, release seen in the film": (
        lambda: wrong.ring_down(4.0, left_s=0.8),
        "times of the markers.* 4 times too long",
        "none explains it",
    ),
    "rolling shutter": (lambda: wrong.rolling_shutter(0.0), "line[_ ]delay", "none explains it"),
    "mirrored mesh": (lambda: wrong.mirrored_mesh(True), "mirror image", "First compare laws"),
    "round rod meshed square": (
        lambda: wrong.round_rod("square"),
        "section of the body is round",
        "compare the laws first",
    ),
    "round rod meshed square, stiffer and heavier": (
        lambda: wrong.round_rod("square", 4e5, 1400.0),
        "section of the body is round",
        "compare the laws first",
    ),
    "marker of a cable elsewhere": (
        lambda: wrong.cable_with_marker_at(0.33),
        "place of middle",
        "marker mass",
    ),
}


@pytest.mark.parametrize("name", REASONS)
def test_the_first_reason_is_right(name: str):
    made, expected, forbidden = REASONS[name]
    run = cs.run(made())
    assert run.trust.verdict != "good"
    first, *_ = run.trust.reasons
    assert re.search(expected, first), first
    wrong_reasons = [each for each in run.trust.reasons if re.search(forbidden, each)]
    assert not wrong_reasons


@pytest.mark.parametrize(
    "made",
    [
        lambda: wrong.rubber_with_slack(left_out=0.03),
        lambda: wrong.ring_down(1.0),
        lambda: wrong.rolling_shutter(2e-5),
        lambda: wrong.mirrored_mesh(False),
        lambda: wrong.round_rod("round"),
        lambda: wrong.cable_with_marker_at(0.3),
    ],
)
def test_the_right_description_is_good(made: Made):
    assert cs.run(made()).trust.verdict == "good"
