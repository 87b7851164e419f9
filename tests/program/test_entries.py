"""Groups of entries in compressed sparse columns."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp

from collocation_sysid.program.linear_algebra.sparse_assembly import SparseAssembly

SHAPE = (5, 7)


def group(rng, columns: range, count: int) -> tuple[np.ndarray, np.ndarray]:
    """So many different entries of some columns, in no order."""
    chosen = rng.choice(SHAPE[0] * len(columns), count, replace=False)
    return chosen % SHAPE[0], columns.start + chosen // SHAPE[0]


@pytest.mark.parametrize(
    "columns", [range(4, 7), range(7), range(4)], ids=["after", "all", "among"]
)
def test_values_of_all_groups_add_up_where_their_entries_are(rng, columns):
    smaller = sp.csc_array(sp.random_array((5, 4), density=0.5, rng=rng))
    smaller.sort_indices()
    groups = [group(rng, columns, 6), group(rng, columns, 9), group(rng, columns, 0)]
    found = SparseAssembly.from_groups((smaller.indptr, smaller.indices), SHAPE, groups)
    values, own = found.allocate(np.full(len(found.indices), np.nan), smaller.nnz)
    own[:] = smaller.data
    further = [rng.normal(size=len(rows)) for rows, _ in groups]
    found.assemble(values, own, further)
    whole = sp.csc_array((values, found.indices, found.indptr), shape=SHAPE)
    assert whole.has_canonical_format
    expected = np.zeros(SHAPE)
    expected[:, :4] = smaller.toarray()
    for (rows, places), more in zip(groups, further, strict=True):
        expected[rows, places] += more
    np.testing.assert_array_equal(whole.toarray(), expected)
    untouched = SparseAssembly.from_groups((smaller.indptr, smaller.indices), SHAPE, [])
    np.testing.assert_array_equal(untouched.indices, smaller.indices)


def test_the_values_of_a_matrix_are_written_in_place_where_nothing_comes_between(rng):
    smaller = sp.csc_array(np.triu(np.ones((4, 4))))
    after = SparseAssembly.from_groups(
        (smaller.indptr, smaller.indices), SHAPE, [group(rng, range(4, 7), 5)]
    )
    between = SparseAssembly.from_groups(
        (smaller.indptr, smaller.indices), SHAPE, [(np.array([4]), np.array([0]))]
    )
    for entries, in_place in ((after, True), (between, False)):
        values, own = entries.allocate(None, smaller.nnz)
        assert np.shares_memory(values, own) == in_place
        np.testing.assert_array_equal(
            entries.indices[entries.positions_of(np.arange(smaller.nnz))], smaller.indices
        )
