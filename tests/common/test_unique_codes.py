"""Sorted sets of codes of matrix entries."""

from __future__ import annotations

import numpy as np

from collocation_sysid.fem.pattern import unique_codes


def test_codes_of_all_groups_ascend_and_occur_once(rng):
    groups = [rng.integers(-50, 50, count) for count in (0, 1, 40, 200)]
    copies = [each.copy() for each in groups]
    expected = sorted({int(code) for each in groups for code in each})
    np.testing.assert_array_equal(unique_codes(groups), expected)
    np.testing.assert_array_equal(unique_codes(reversed(groups)), expected)
    for each, copy in zip(groups, copies, strict=True):
        np.testing.assert_array_equal(each, copy)


def test_without_codes_there_are_none():
    assert unique_codes([]).dtype == np.int64
    assert len(unique_codes([np.zeros(0, dtype=np.int64)])) == 0
