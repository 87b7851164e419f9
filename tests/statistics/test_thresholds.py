"""The table of the thresholds of all tests."""

from __future__ import annotations

from pathlib import Path

import pytest

from collocation_sysid.statistics.thresholds import THRESHOLDS

STUDIES = Path(__file__).parents[2] / "docs" / "studies"


@pytest.mark.parametrize("name", THRESHOLDS)
def test_a_threshold_has_a_reason_and_an_existing_study(name):
    threshold = THRESHOLDS[name]
    assert threshold.reason.endswith(".")
    assert not threshold.study or (STUDIES / f"{threshold.study}.md").is_file()
