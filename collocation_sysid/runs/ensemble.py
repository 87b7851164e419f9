"""Draws of the parameters of a run from their combined distribution.

The distribution is normal in the coordinates in which the intervals are symmetric: logarithms,
ln ν/(½ − ν) of a positive Poisson's ratio, or the values of parameters that may be negative. Where
only a sum of constants is determined (`Combination`), its logarithm is normal, and so are those of
the ratios of the constants: products of powers agree with the sum only close to the estimate. Draws
outside the bounds of a parameter, or with moduli that no stable material has, are replaced.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ..common.array_types import Array
from ..errors import InputError
from ..fem.laws.constants import without_region
from ..program.collocation import Collocation
from ..statistics.combinations import Combination
from ..statistics.estimates import IntervalCoordinate
from ..statistics.linearised import DerivedModuli

# Draws for each sample that is kept, after which no further ones are made.
MOST_DRAWS = 1000
# Moduli that are positive in a stable material.
POSITIVE_MODULI = frozenset({"young_pa", "mu_pa", "kappa_pa"})


def draw_samples(
    collocation: Collocation,
    estimates: Mapping[str, float],
    covariance: Array,
    combinations: Sequence[Combination],
    count: int,
    seed: int,
) -> dict[str, Array]:
    """Return draws (count,) of every parameter, also fixed and tied ones, and of the derived
    moduli, by name in SI units.

    Parameters
    ----------
    collocation : Collocation
        Program of the run.
    estimates : mapping of str to float
        Values of the estimated parameters.
    covariance : (k, k) array
        Finite covariance of the k estimated parameters [SI units].
    combinations : sequence of Combination
        Combinations of which only a sum is determined.
    count : int
        Number of draws, at least 1.
    seed : int
        Seed of the random numbers.

    Raises
    ------
    InputError
        If fewer than one draw in `MOST_DRAWS` is within the bounds and admissible.
    """
    free = collocation.parameters.free
    names = [item.name for item in free]
    values = np.array([estimates[name] for name in names])
    at = [
        IntervalCoordinate.for_estimate(item.name, [value], linear=item.scale == "linear")
        for item, value in zip(free, values.tolist(), strict=True)
    ]
    centre = np.array([c.from_value(v) for c, v in zip(at, values.tolist(), strict=True)])
    slopes = np.array([c.derivative(v) for c, v in zip(at, values.tolist(), strict=True)])
    covariance = covariance * np.outer(slopes, slopes)
    variances, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(variances, 0.0))
    sums = [
        (np.array([names.index(n) for n in each.determined.names]), each.determined.powers)
        for each in combinations
        if each.determined.form == "sum"
    ]
    sums = [(members, np.array(factors)) for members, factors in sums]
    rng = np.random.default_rng(seed)
    lower = np.array([item.lower for item in free])
    upper = np.array([item.upper for item in free])
    kept: list[dict[str, float]] = []
    for _ in range(MOST_DRAWS):
        away = rng.normal(size=(count, len(names))) @ root.T
        for row in away:
            x = centre + row
            drawn = np.array([c.to_value(float(each)) for c, each in zip(at, x, strict=True)])
            for members, factors in sums:
                terms = factors * values[members]
                wanted = terms.sum() * np.exp(terms @ row[members] / terms.sum())
                drawn[members] *= wanted / (factors @ drawn[members])
            if ((drawn < lower) | (drawn > upper)).any():
                continue
            every = _with_derived(collocation, drawn)
            if _is_admissible(every):
                kept.append(every)
            if len(kept) == count:
                return {name: np.array([each[name] for each in kept]) for name in kept[0]}
    raise InputError(
        f"fewer than one of {MOST_DRAWS} draws is within the bounds of the parameters and "
        "physically admissible; give the parameters that are not determined a prior, or fix them"
    )


def _with_derived(collocation: Collocation, drawn: Array) -> dict[str, float]:
    items = zip(collocation.parameters.free, drawn.tolist(), strict=True)
    q = np.array([item.to_coordinate(value) for item, value in items])
    constants = (each.constants for each in collocation.transcriptions)
    return collocation.parameters.values(q) | dict(DerivedModuli.from_bodies(constants, q).values)


def _is_admissible(values: Mapping[str, float]) -> bool:
    """Finite, with positive moduli, and Poisson's ratios of a stable material."""
    return all(
        np.isfinite(value)
        and (without_region(name) not in POSITIVE_MODULI or value > 0)
        and (without_region(name) != "poisson" or -1 < value < 0.5)
        for name, value in values.items()
    )
