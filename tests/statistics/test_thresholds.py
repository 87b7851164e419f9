"""The table of the thresholds of all tests."""

from __future__ import annotations

from pathlib import Path

from collocation_sysid.statistics.thresholds import THRESHOLDS

STUDIES = Path(__file__).parents[2] / "docs" / "studies"


def test_studies_of_thresholds_exist():
    studies = {threshold.study for threshold in THRESHOLDS.values() if threshold.study}
    assert [name for name in studies if not (STUDIES / f"{name}.md").is_file()] == []
