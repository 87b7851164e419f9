"""Means of neighbouring rows of a dense table of a material test.

A law without memory does not distinguish rows between which the strain hardly changes. The stated
variance σ² of a row consists of what scatters from row to row, which the mean of n rows reduces to
1/n, and of the rest, which neighbouring rows have in common and their mean keeps.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..common.array_types import Array, Index
from .specimen import Specimen

# Change of a strain, over its range, up to which rows are averaged: the curvature of a law over it
# changes the mean of the stress by less than 10⁻⁴ of the stress.
RESOLUTION = 0.01
# Number of rows above which they are averaged.
MANY_ROWS = 200
# Standard deviations of the estimated scatter from row to row below σ² from which on σ contains
# more than this scatter.
CLEARLY_LESS = 4.0


def with_averaged_rows(specimen: Specimen) -> Specimen:
    """Return the specimen with the means of successive rows while its strains change by less than
    `RESOLUTION` of their ranges; itself with at most `MANY_ROWS` rows.

    A mean has the weights 1/σ² of the stresses and the standard deviation of its rows, see the
    module. Rows in which other quantities are measured are not averaged with each other.
    """
    rows = len(specimen.strain)
    if rows <= MANY_ROWS:
        return specimen
    starts = _first_rows(specimen)
    if len(starts) > rows / 2:
        return specimen
    is_measured = np.isfinite(specimen.stress_pa)
    sigma_pa = np.where(is_measured, specimen.sigma_pa, np.nanmedian(specimen.sigma_pa))
    weights = (sigma_pa.min() / sigma_pa) ** 2

    def mean(values: Array) -> Array:
        return np.add.reduceat(weights * values, starts) / np.add.reduceat(weights, starts)

    def mean_sigma(values: Array, sigma: float | Array) -> Array:
        own = np.broadcast_to(sigma, weights.shape)
        alone = np.sqrt(np.add.reduceat((weights * own) ** 2, starts))
        alone = alone / np.add.reduceat(weights, starts)
        share = _share_of_scatter(values, specimen.strain, own, starts)
        return np.sqrt(share * alone**2 + (1 - share) * mean(own) ** 2)

    averaged = {
        name: mean(values)
        for name in ("strain", "stress_pa", "t_s", "second_strain", "second_stress_pa")
        if (values := getattr(specimen, name)) is not None
    }
    averaged["sigma_pa"] = mean_sigma(specimen.stress_pa, specimen.sigma_pa)
    if (lateral := specimen.lateral_stretch) is not None:
        averaged["lateral_stretch"] = mean(lateral)
        averaged["lateral_sigma"] = mean_sigma(lateral, specimen.lateral_sigma)
    return replace(specimen, **averaged)


def _first_rows(specimen: Specimen) -> Index:
    """Return the index of the first row of each group."""
    strains = [each for each in (specimen.strain, specimen.second_strain) if each is not None]
    measured = [specimen.stress_pa, specimen.second_stress_pa, specimen.lateral_stretch]
    present = np.column_stack([np.isfinite(each) for each in measured if each is not None])
    ranges = [float(np.ptp(each)) or 1.0 for each in strains]
    places = np.column_stack([each / range_ for each, range_ in zip(strains, ranges, strict=True)])
    starts, first = [0], 0
    for row in range(1, len(places)):
        moved = np.abs(places[row] - places[first]).max() >= RESOLUTION
        if moved or (present[row] != present[first]).any():
            starts.append(row)
            first = row
    return np.array(starts)


def _share_of_scatter(values: Array, strain: Array, sigma: Array, starts: Index) -> float:
    """Return the share of the variances σ² that scatters about a line over the strain in each
    group; 1 unless it is clearly less.
    """
    squares, freedom = 0.0, 0
    for first, end in zip(starts, np.append(starts[1:], len(values)), strict=True):
        rows = slice(first, end)
        if end - first < 3 or not np.isfinite(values[first]):
            continue
        ratio = values[rows] / sigma[rows]
        shift = strain[rows] - strain[rows].mean()
        ratio = ratio - ratio.mean()
        if length := float(shift @ shift):
            ratio = ratio - shift * float(shift @ ratio) / length
        squares += float(ratio @ ratio)
        freedom += end - first - 2
    share = squares / max(freedom, 1)
    is_all = not freedom or share >= 1 - CLEARLY_LESS * np.sqrt(2 / freedom)
    return 1.0 if is_all else share
