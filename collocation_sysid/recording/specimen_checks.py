"""Mistakes in the tables of material tests that show without a fit.

Percent taken for a ratio, a stretch taken for a strain, wrong signs, stresses in another unit,
and rows that are not in the order of time.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from ..common.array_types import Array
from ..errors import InputError
from .homogeneous_deformation import DEFORMATIONS
from .specimen import Specimen

# Strain beyond which even rubber breaks: natural rubber reaches about 8.
LARGEST_STRAIN = 12.0
# Correlation of strain and stress below which one has the wrong sign; hysteresis leaves it
# positive.
AGAINST = -0.8
FEWEST_SAMPLES = 3
# Smallest strain from which on a column of strains looks like one of stretches, which begin at 1.
STRETCH_LIKE = 0.9
# Stress at the smallest strain, over the largest, that counts as none.
UNLOADED = 0.05
# Young's moduli of soft solids [Pa]: from weak gels to hard plastics.
YOUNG_PA = (10.0, 1e10)
# Larger moduli, up to this one, are those of metals and glass, which break or yield beyond this strain.
STIFFEST_METAL_PA, LARGEST_METAL_STRAIN = 5e11, 0.02
# Factor between the stiffnesses of two tests of one material that only a wrong unit explains.
UNIT_FACTOR = 300.0
# Share of the largest strain below which samples determine the initial slope.
INITIAL_SHARE = 0.35
# Fewest samples of which an order is expected.
FEWEST_ORDERED = 10
# Change of the strain between two rows, over its range, that is a jump ...
JUMP = 0.4
# ... if half of all changes are below this share.
STEADY = 0.1
# Share of the reversals of the stress in rows sorted by strain from which on branches are mixed.
MIXED = 0.3
# Reversals of the stress below this many standard deviations are noise.
NOISE_SIGMAS = 4.0


def require_plausible_specimen(specimen: Specimen, *, is_stretch: bool = False) -> None:
    """Raise an `InputError` if strains or stresses of a specimen are impossible as described.

    Refused are strains above `LARGEST_STRAIN`, strains that look like stretches, a correlation of
    strain and stress below `AGAINST`, and "confined" or "volumetric" tests whose largest strain is
    positive; and stresses that are all zero. Signs are not checked with fewer than `FEWEST_SAMPLES`
    stresses, or if strain or stress is constant. No sign acts on the stretches of a file that has
    them (`is_stretch`).
    """
    strain = specimen.strain
    stress_pa = specimen.stress_pa
    largest = float(np.abs(strain).max())
    if largest > LARGEST_STRAIN:
        raise InputError(
            f"found strains up to {largest:.4g}, which is {100 * largest:.4g} %; expected at most "
            f'{LARGEST_STRAIN:g}. If these are percent, call the column "strain (%)", or '
            '"stretch (%)"'
        )
    _require_strains(specimen)
    is_measured = np.isfinite(stress_pa)
    if is_measured.sum() < FEWEST_SAMPLES or not np.ptp(strain[is_measured]):
        return
    if not np.ptp(stress_pa[is_measured]):
        if not stress_pa[is_measured].any():
            raise InputError(
                f"all {is_measured.sum()} stresses are 0, although the strain reaches {largest:.4g}; "
                "expected the measured stress: is this column a placeholder?"
            )
        return
    correlation = float(np.corrcoef(strain[is_measured], stress_pa[is_measured])[0, 1])
    if correlation < AGAINST:
        raise InputError(
            f"strain and stress have opposite signs (correlation {correlation:.2f}); expected "
            "both positive in tension and negative in compression: "
            + (
                "stretches below 1 in compression, and stress_sign = -1 if the stress is positive "
                "in it"
                if is_stretch
                else "strain_sign = -1 or stress_sign = -1 for the column in which compression is "
                "positive"
            )
        )
    mostly_positive = strain[int(np.abs(strain).argmax())] > 0
    if specimen.test in ("confined", "volumetric") and mostly_positive:
        raise InputError(
            f"a {specimen.test} test compresses, but the strains reach +{strain.max():.4g}; "
            "expected negative strains and stresses in compression: "
            + (
                "stretches or volume ratios below 1, and stress_sign = -1 if the stress is positive"
                if is_stretch
                else "strain_sign = -1 and stress_sign = -1 where compression is positive"
            )
        )


def _require_strains(specimen: Specimen) -> None:
    """Refuse strains that look like stretches, which are 1 without load."""
    stress_pa = np.abs(np.nan_to_num(specimen.stress_pa, nan=np.inf))
    first = int(np.argmin(specimen.strain))
    finite = stress_pa[np.isfinite(stress_pa)]
    if (
        specimen.strain.min() > STRETCH_LIKE
        and finite.size >= FEWEST_SAMPLES
        and stress_pa[first] <= UNLOADED * finite.max()
    ):
        raise InputError(
            f"the smallest strain is {specimen.strain.min():.4g}, where the stress vanishes; "
            "expected strains that begin at 0. If these are stretches, call the column stretch"
        )


def initial_young_pa(specimen: Specimen) -> float:
    """Return Young's modulus [Pa] of an incompressible material with the initial slope of the
    stress.

    The slope is that of a line through the origin, fitted to the measured stresses up to
    `INITIAL_SHARE` of the largest strain. NaN if the test does not determine the modulus, or there
    is no such sample with a strain.
    """
    ratio = DEFORMATIONS[specimen.test].young_ratio
    strain = specimen.strain
    is_small = np.isfinite(specimen.stress_pa) & (
        np.abs(strain) <= INITIAL_SHARE * np.abs(strain).max()
    )
    square = float(np.sum(strain[is_small] ** 2))
    if not np.isfinite(ratio) or not square:
        return np.nan
    slope = float(np.sum(strain[is_small] * specimen.stress_pa[is_small])) / square
    return slope / ratio


def require_equal_units(specimens: Mapping[str, Specimen]) -> None:
    """Raise an `InputError` if the initial slope of a specimen is not that of a soft solid
    (`YOUNG_PA`), or the slopes of specimens of one material differ by more than `UNIT_FACTOR`;
    slopes that are NaN or not positive are ignored.

    Parameters
    ----------
    specimens : mapping of str to Specimen
        Specimens of the same material by the name of their experiment.
    """
    # A harmonic test may have any stiffness between the long-term and the instantaneous one.
    moduli = {
        name: initial_young_pa(each) for name, each in specimens.items() if not each.oscillates
    }
    known = {name: young for name, young in moduli.items() if young > 0}
    for name, young in known.items():
        softest_pa, stiffest_pa = YOUNG_PA
        if np.abs(specimens[name].strain).max() <= LARGEST_METAL_STRAIN:
            stiffest_pa = STIFFEST_METAL_PA
        if not softest_pa <= young <= stiffest_pa:
            raise InputError(
                f"the initial slope of the stress corresponds to E = {young:.3g} Pa; expected "
                f"{softest_pa:g} to {stiffest_pa:g} Pa. Check the unit of the stress, "
                "or of the force and area_m2, which is in square metres (24 mm² are 24e-6)",
                where=f"experiment '{name}'",
            )
    if len(known) < 2:
        return
    stiffest = max(known, key=known.__getitem__)
    softest = min(known, key=known.__getitem__)
    factor = known[stiffest] / known[softest]
    if factor > UNIT_FACTOR:
        raise InputError(
            f"the initial slope of the stress corresponds to E = {known[stiffest]:.3g} Pa in "
            f"'{stiffest}' and to {known[softest]:.3g} Pa in '{softest}', {factor:.3g} times less; "
            "expected about the same of one material. Check the units of the stresses: kPa or MPa",
            where=f"experiment '{softest}'",
        )


def order_warnings(specimen: Specimen) -> Iterator[str]:
    """Yield warnings about rows that are not in the order of time: a jump of the strain where most
    changes are small, or sorted strains with a stress that jumps up and down; and about a table
    without loading. Tables of fewer than `FEWEST_ORDERED` rows yield none.
    """
    strain = specimen.strain
    span = float(np.ptp(strain))
    if len(strain) < FEWEST_ORDERED or not span:
        return
    steps = np.abs(np.diff(strain)) / span
    if steps.max() > JUMP and np.median(steps) < STEADY:
        row = int(steps.argmax())
        yield (
            f"the strain jumps from {strain[row]:.4g} to {strain[row + 1]:.4g} after row "
            f"{row + 1}: rows of several cycles or branches may not be in the order of time"
        )
    if (np.diff(strain) >= 0).all() and _reversal_share(specimen) > MIXED:
        yield (
            "the strains are sorted, but the stress jumps up and down between neighbouring rows: "
            "loading and unloading, or several cycles, are mixed; expected rows in the order of "
            "time"
        )
    if is_unloading(strain):
        yield (
            "the strain decreases from the first row to the last: in the order of time, the table "
            "contains only unloading, in which the stress is smaller than in loading (hysteresis); "
            "fit the loading branch"
        )


def _reversal_share(specimen: Specimen) -> float:
    """Return the share of changes with opposite signs, both larger than `NOISE_SIGMAS` σ."""
    changes = np.diff(specimen.stress_pa)
    sigma_pa = np.broadcast_to(np.nan_to_num(specimen.sigma_pa, nan=np.inf), len(changes) + 1)
    limit = NOISE_SIGMAS * np.lib.stride_tricks.sliding_window_view(sigma_pa, 3).max(axis=1)
    reverses = (changes[1:] * changes[:-1] < 0) & (
        np.minimum(np.abs(changes[1:]), np.abs(changes[:-1])) > limit
    )
    return float(reverses.mean()) if reverses.size else 0.0


# Share of the range of the strain that a reversal must exceed to end a cycle.
HYSTERESIS = 0.1


def is_unloading(strain: Array) -> bool:
    """Return whether the magnitude of the strain (T,) never increases from one row to the next."""
    return bool((np.diff(np.abs(strain)) <= 0).all())


def cycle_starts(strain: Array) -> list[int]:
    """Return the indices, from 0, of the rows at which loading cycles begin: of the smallest
    magnitude of the strain between two of its peaks; the first is 0.

    Changes below `HYSTERESIS` times the range of the magnitude do not end a cycle.
    """
    size = np.abs(strain)
    limit = HYSTERESIS * float(np.ptp(size))
    starts = [0]
    lowest = 0
    highest = 0
    is_loading = True
    for row, value in enumerate(size):
        if is_loading:
            highest = row if value > size[highest] else highest
            if value < size[highest] - limit:
                is_loading = False
                lowest = row
        else:
            lowest = row if value < size[lowest] else lowest
            if value > size[lowest] + limit:
                is_loading = True
                starts.append(lowest)
                highest = row
    return starts


def loading_rows(strain: Array) -> slice:
    """Return the rows of the last loading cycle in which the magnitude of the strain (T,)
    increases, as a slice: from the first row of the cycle to its peak; see `cycle_starts`.
    """
    start = cycle_starts(strain)[-1]
    peak = start + int(np.argmax(np.abs(strain[start:])))
    return slice(start, peak + 1)


def rows_after_cycles(strain: Array, count: int) -> slice:
    """Return the rows after the first `count` loading cycles as a slice; all rows for 0.

    Raises
    ------
    InputError
        If there are not more cycles than `count`.
    """
    starts = cycle_starts(strain)
    if count >= len(starts):
        raise InputError(
            f"found {count}, but the strain has {len(starts)} loading cycles, of which one at "
            "least has to remain; expected rows in the order of time, and a smaller number",
            where="skip_cycles",
        )
    return slice(starts[count], None)
