"""Loading and unloading branch of a material test, and the difference of their stresses.

Rubber and tissue unload below their loading curve. An elastic law fits a curve between both
branches, and a stiffness that drifts during the recording fits them better, so that hysteresis
resembles a drift.
"""

from __future__ import annotations

import numpy as np

from ..common.array_types import Array
from .experiment import Experiment
from .specimen import STRESS_NAME
from .specimen_checks import cycle_starts
from .specimen_files import specimen_strains

# Fewest samples of a branch whose stresses are compared.
FEWEST_SAMPLES = 3
# Difference of the branches, over the mean stress, above which it is more than an error of strain.
CLEAR_SHARE = 0.02
# The same in standard errors of the noise.
CLEAR_ERRORS = 4.0


def loading_rows(strain: Array) -> slice:
    """Return the rows of the last loading cycle in which the magnitude of the strain (T,)
    increases, as a slice: from the first row of the cycle to its peak; see `cycle_starts`.
    """
    start = cycle_starts(strain)[-1]
    peak = start + int(np.argmax(np.abs(strain[start:])))
    return slice(start, peak + 1)


def unloading_difference(experiment: Experiment) -> float | None:
    """Return the mean difference of the stresses of the unloading and the loading branch at equal
    strains, over the mean stress of the loading branch there; negative if unloading is softer.

    Compared are the branches of the last cycle of the test, at the strains of the unloading branch
    that the loading branch has too.

    Parameters
    ----------
    experiment : Experiment
        Any experiment.

    Returns
    -------
    float or None
        None if it is no test of a specimen, a branch has fewer than `FEWEST_SAMPLES` such samples,
        or the difference is not clear: up to `CLEAR_SHARE`, or up to `CLEAR_ERRORS` standard errors
        of the noise.
    """
    sensors = [each for each in experiment.readings if each.name == STRESS_NAME]
    if experiment.specimen is None or not sensors:
        return None
    stress_pa = sensors[0].measured_values[:, 0]
    strain = np.abs(specimen_strains(experiment)[0])
    if len(stress_pa) != len(strain):
        return None
    is_measured = np.isfinite(stress_pa)
    strain = strain[is_measured]
    stress_pa = stress_pa[is_measured]
    if len(strain) < 2 * FEWEST_SAMPLES:
        return None
    rows = loading_rows(strain)
    order = rows.start + np.argsort(strain[rows], kind="stable")
    unloading = np.arange(rows.stop, len(strain))
    unloading = unloading[strain[unloading] >= strain[order[0]]]
    if min(len(order), len(unloading)) < FEWEST_SAMPLES:
        return None
    loading_pa = np.interp(strain[unloading], strain[order], stress_pa[order])
    difference_pa = float(np.mean(stress_pa[unloading] - loading_pa))
    mean_pa = float(np.mean(loading_pa))
    error_pa = float(np.max(sensors[0].sigma)) * np.sqrt(2 / len(unloading))
    if abs(difference_pa) <= max(CLEAR_SHARE * abs(mean_pa), CLEAR_ERRORS * error_pa):
        return None
    return difference_pa / mean_pa if mean_pa else None
