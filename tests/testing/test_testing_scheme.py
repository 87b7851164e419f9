"""`check_scheme`: every scheme passes, and each fault is one sentence."""

from __future__ import annotations

from dataclasses import replace

import pytest
from kit.scheme_check import check_scheme

from collocation_sysid.fem.schemes import SCHEMES, Scheme, Stencil

MIDPOINT = SCHEMES["midpoint"]
BDF2 = SCHEMES["bdf2"]
# The weights of Störmer's method: forces at the last position but one, at the last midpoint here.
EXPLICIT = replace(BDF2.regular, s=(2.0, -5.0, 4.0, -1.0))


@pytest.mark.parametrize("name", SCHEMES)
def test_every_scheme_passes(name: str):
    check_scheme(name)


def test_a_scheme_of_a_user_passes():
    """Backward Euler whose first rows are those of a body that is pushed for two steps."""
    euler = SCHEMES["backward-euler"]
    check_scheme(Scheme("mine", 1, euler.regular, (*euler.start, euler.regular)))


@pytest.mark.parametrize(
    ("scheme", "sentence"),
    [
        (
            replace(MIDPOINT, order=1),
            "'midpoint': the error of an oscillator has another order than stated; found (2|1.99)",
        ),
        (
            replace(MIDPOINT, regular=replace(MIDPOINT.regular, w=(0.5, 0.4))),
            r"the sum of the weights of forces \(Σ w\) in the regular stencil is wrong; found 0.9",
        ),
        (
            replace(MIDPOINT, start=(replace(MIDPOINT.start[0], r=0.0),)),
            "the acceleration at constant velocity in the stencil of row 1 is wrong; found 1, expe",
        ),
        (
            replace(BDF2, start=(BDF2.regular,)),
            "the stencil of row 1 uses points before the start; found 5 points, expected at most 2",
        ),
        (
            replace(MIDPOINT, regular=Stencil((0.5, 0.5), (1.0, -1.0), (0.0, 1.0), (1, -2, 1))),
            "it adds energy: per step, an undamped oscillation with ωΔt = .* grows by; found 1",
        ),
    ],
)
def test_a_fault_is_one_sentence(scheme: Scheme, sentence: str):
    with pytest.raises(AssertionError, match=sentence):
        check_scheme(scheme)
