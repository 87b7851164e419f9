"""Notes on material tests: tests of one kind do not test the law that is fitted to them, and constant
offsets of the stresses may explain residuals above the noise.

The zero of a load cell is not estimated by default (`stress_zero_pa = "none"`). Offsets join the
linearised fit as one more column for each specimen, and an F test compares the residuals.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ...common.display import short
from ...errors import listed
from ...fem.laws.constants import without_region
from ...model.parameters import Parameters
from ...recording.experiment import Experiment
from ...recording.specimen import STRESS_NAME
from ...statistics.distributions import f_sf
from ...statistics.linearised import (
    LinearisedFit,
    gauss_newton_step,
    least_squares_of_fit,
    remaining_squares,
)
from ...statistics.thresholds import GROSS_MISFIT, NAMED_ERRORS, NOTEWORTHY, OFFSET_FALSE_ALARMS

# Moduli of small strain, whose meaning does not depend on the law.
MODULI = frozenset({"young_pa", "poisson", "lambda_pa", "mu_pa", "kappa_pa"})
# Kinds of test in which two stretches differ independently.
GENERAL_TESTS = frozenset({"biaxial", "biaxial-difference"})
# Fewest estimated constants with which different laws fit one curve equally well.
FEWEST_CONSTANTS = 2


def one_kind_notes(experiments: Sequence[Experiment], parameters: Parameters) -> Iterator[str]:
    """Yield one note if a law with several constants is fitted to specimens of one kind of test.

    Nothing is yielded if another kind of test is predicted, for biaxial tests, or unless at least
    `FEWEST_CONSTANTS` elastic constants are estimated, of which one belongs to the law and is no
    usual modulus (`MODULI`).
    """
    tests = {each.specimen.test for each in experiments if each.specimen is not None}
    if len(tests) != 1 or tests & GENERAL_TESTS:
        return
    materials = [part.material for part in experiments[0].body.parts]
    own = {constant.name for material in materials for constant in material.constants}
    free = {without_region(item.name) for item in parameters.free} & (own | MODULI)
    if len(free) < FEWEST_CONSTANTS or free <= MODULI:
        return
    (test,) = tests
    laws = ", ".join(dict.fromkeys(material.name for material in materials))
    yield (
        f"all specimens are {test} tests: the intervals assume that the law {laws} is right, which "
        "one kind of test cannot show, and predictions of other deformations may be far off; add "
        "another kind of test, fitted or with validation = true"
    )


# Standard deviation of the prior of an offset, over sigma of the stress: without a prior, errors of
# the law appear as offsets that no load cell has.
PRIOR_SIGMAS = 10.0


def stress_offset_notes(fit: LinearisedFit) -> list[str]:
    """Return one note, as a list, if constant offsets of the stresses explain residuals above the
    noise; else empty.

    Empty if the offset of each stress is estimated already, the residuals are up to `NOTEWORTHY` or
    above `GROSS_MISFIT` times sigma, or the F test has a
    probability above `OFFSET_FALSE_ALARMS`.

    Parameters
    ----------
    fit : LinearisedFit
        Fit of specimens, linearised at its answer.
    """
    offsets = [
        k
        for k, block in enumerate(fit.blocks)
        if block.marker_names == (STRESS_NAME,)
        and block.measurement_count
        and not any(
            name.startswith(f"{block.name}: stress_zero of {STRESS_NAME}") for name in fit.names
        )
    ]
    measured = sum(block.measurement_count for block in fit.blocks)
    level = np.sqrt(fit.chi_squared / max(1, measured))
    count = len(offsets)
    free = measured + int(np.count_nonzero(fit.prior_jacobian)) - int(np.sum(~fit.at_bound))
    if not count or free < 1 or not NOTEWORTHY < level <= GROSS_MISFIT:
        return []
    changes = [np.zeros((*block.residual.shape, count)) for block in fit.blocks]
    for column, k in enumerate(offsets):
        changes[k][..., column] = PRIOR_SIGMAS / np.asarray(fit.blocks[k].sigma_ratios)
    complete = fit.with_columns([""] * count, changes, np.zeros(count))
    before, after = remaining_squares(fit), remaining_squares(complete)
    statistic = (before - after) / count / max(after / free, 1e-300)
    if f_sf(statistic, count, freedom=free) > OFFSET_FALSE_ALARMS:
        return []
    priors_pa = np.array([PRIOR_SIGMAS * fit.blocks[k].sigma_m[0] for k in offsets])
    estimates = priors_pa * gauss_newton_step(complete)[-count:]
    squares = least_squares_of_fit(complete.only(np.flatnonzero(~complete.at_bound).tolist()))
    errors = priors_pa * squares.standard_errors[-count:] * np.sqrt(after / free)
    named = [k for k in range(count) if abs(estimates[k]) > NAMED_ERRORS * errors[k]] or [
        int(np.argmax(np.abs(estimates) / errors))
    ]
    sizes = [
        f"{short(estimates[k])} ± {short(errors[k])} Pa in '{fit.blocks[offsets[k]].name}'"
        for k in named
    ]
    prior_pa = float(f"{np.abs(estimates[named]).max():.1g}")
    return [
        f"a constant offset of the stress explains part of the residuals: {listed(sizes)}, and χ² "
        f"decreases from {before:.3g} to {after:.3g}. If the zero of the load cell is not known "
        f"better, estimate it: stress_zero_pa = {prior_pa:g} in the [[experiment]]; a law that does "
        "not fit has a similar effect"
    ]
