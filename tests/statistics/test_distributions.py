"""Quantiles and tail probabilities of distributions, compared with SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from collocation_sysid.statistics import distributions

TAILS = np.array([1e-6, 1e-3, 0.05, 0.3, 0.975])
FREEDOM = np.array([1.0, 2.5, 7.0, 300.0, 1e5])
VALUES = np.array([0.0, 1e-3, 2.0, 40.0, 1e3])


@pytest.mark.parametrize(
    ("found", "expected"),
    [
        (distributions.normal_isf(TAILS), stats.norm.isf(TAILS)),
        (distributions.chi2_isf(TAILS, FREEDOM), stats.chi2.isf(TAILS, FREEDOM)),
        (distributions.chi2_sf(VALUES, FREEDOM), stats.chi2.sf(VALUES, FREEDOM)),
        (distributions.chi2_cdf(VALUES, FREEDOM), stats.chi2.cdf(VALUES, FREEDOM)),
        (distributions.student_95(FREEDOM), stats.t.ppf(0.975, FREEDOM)),
        (distributions.student_95(np.inf), stats.norm.ppf(0.975)),
        (distributions.f_sf(VALUES, 3, freedom=FREEDOM), stats.f.sf(VALUES, 3, FREEDOM)),
        (distributions.chi2_sf(np.nan, 3), np.nan),
    ],
)
def test_quantiles_and_tails_are_those_of_scipys_distributions(found, expected):
    np.testing.assert_allclose(found, expected, rtol=1e-9)
