"""Sorted sets of integers that number the entries of a sparse matrix.

An entry has the code column · height + row, so that ascending codes are the order of compressed
columns.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from .array_types import Index


def unique_codes(groups: Iterable[Index]) -> Index:
    """Return all codes of some groups in ascending order, each once; empty without groups.

    Groups that consist of few ascending runs take linear time: they are merged. `numpy.unique`
    would insert every code into a hash table, which takes some hundred times as long for ten
    million codes.

    Parameters
    ----------
    groups : iterable of (n,) arrays of int
        Codes in any order; they are not modified.
    """
    codes = np.concatenate([np.zeros(0, dtype=np.int64), *groups])
    # The stable sort of integers finds ascending runs and merges them.
    codes.sort(kind="stable")
    is_first = np.ones(len(codes), dtype=bool)
    np.not_equal(codes[1:], codes[:-1], out=is_first[1:])
    return codes if is_first.all() else codes[is_first]
