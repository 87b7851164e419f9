"""Loading and unloading branch of a test, and the difference of their stresses or forces.

Rubber and tissue unload below their loading curve. An elastic law fits a curve between both
branches, and a stiffness that drifts during the recording fits them better, so that hysteresis
resembles a drift.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from ..common.array_types import Array
from ..common.time_dependence import at_times
from ..errors import listed
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
# Part of its way by which a bench may leave the line along which it moves.
LINE_TOLERANCE = 1e-3


def loading_rows(strain: Array) -> slice:
    """Return the rows of the last loading cycle in which the magnitude of the strain (T,)
    increases, as a slice: from the first row of the cycle to its peak; see `cycle_starts`.
    """
    start = cycle_starts(strain)[-1]
    peak = start + int(np.argmax(np.abs(strain[start:])))
    return slice(start, peak + 1)


def unloading_difference(experiment: Experiment) -> float | None:
    """Return the mean difference of the stresses or forces of the unloading and the loading branch
    at equal strains or displacements, over the mean of the loading branch there; negative if
    unloading is softer.

    Compared are the branches of the last cycle of the test, at the strains of the unloading branch
    that the loading branch has too.

    Returns
    -------
    float or None
        None if it is no test of a specimen or on a bench, a branch has fewer than `FEWEST_SAMPLES`
        such samples, or the difference is not clear: up to `CLEAR_SHARE`, or up to `CLEAR_ERRORS`
        standard errors of the noise.
    """
    curve = _specimen_curve(experiment) if experiment.specimen else _bench_curve(experiment)
    if curve is None:
        return None
    strain, load, sigma = curve
    is_measured = np.isfinite(load)
    strain = strain[is_measured]
    load = load[is_measured]
    if len(strain) < 2 * FEWEST_SAMPLES:
        return None
    rows = loading_rows(strain)
    order = rows.start + np.argsort(strain[rows], kind="stable")
    unloading = np.arange(rows.stop, len(strain))
    unloading = unloading[strain[unloading] >= strain[order[0]]]
    if min(len(order), len(unloading)) < FEWEST_SAMPLES:
        return None
    loading = np.interp(strain[unloading], strain[order], load[order])
    difference = float(np.mean(load[unloading] - loading))
    mean = float(np.mean(loading))
    error = sigma * np.sqrt(2 / len(unloading))
    if abs(difference) <= max(CLEAR_SHARE * abs(mean), CLEAR_ERRORS * error):
        return None
    return difference / mean if mean else None


def loading_branch(experiment: Experiment, most_samples: int) -> Experiment | None:
    """Return a test on a bench with the samples of the loading branch of its last cycle alone, every
    k-th of them if there are more than `most_samples`.

    None for any other experiment, and if the branch has fewer than `FEWEST_SAMPLES` samples.
    """
    travel_m = bench_travel(experiment) if experiment.is_static else None
    if travel_m is None:
        return None
    axis = int(np.argmax(np.ptp(travel_m, axis=0)))
    branch = loading_rows(np.abs(travel_m[:, axis] - travel_m[0, axis]))
    every = -(-(branch.stop - branch.start) // most_samples)
    rows = np.arange(branch.stop - 1, branch.start - 1, -every)[::-1]  # the peak is kept
    if len(rows) < FEWEST_SAMPLES:
        return None
    is_kept = np.isin(np.arange(len(experiment.t_s)), rows)
    return replace(
        experiment, t_s=experiment.t_s[rows], markers=at_times(experiment.markers, is_kept)
    )


def branch_differences(experiments: Iterable[Experiment]) -> str:
    """Return the clear differences of unloading and loading as text, such as "-12 % in 'press'"; ""
    if there are none.
    """
    differences = {each.name: unloading_difference(each) for each in experiments}
    return listed(
        [f"{100 * d:+.2g} % in '{name}'" for name, d in differences.items() if d is not None]
    )


def _specimen_curve(experiment: Experiment) -> tuple[Array, Array, float] | None:
    """Return size of the strain (T,), stress (T,) [Pa] and its σ; None without a stress of each."""
    sensors = [each for each in experiment.readings if each.name == STRESS_NAME]
    strain = np.abs(specimen_strains(experiment)[0])
    if not sensors or len(sensors[0].measured_values) != len(strain):
        return None
    return strain, sensors[0].measured_values[:, 0], float(np.max(sensors[0].sigma))


def _bench_curve(experiment: Experiment) -> tuple[Array, Array, float] | None:
    """Return displacement (S,) [m], force along it (S,) [N] and its σ."""
    # Both are taken from their first values on, because a force may contain a weight.
    travel_m = bench_travel(experiment) if experiment.is_static else None
    if travel_m is None:
        return None
    axis = int(np.argmax(np.ptp(travel_m, axis=0)))
    sensors = [w for w in experiment.wrenches if w.measured_components[axis]]
    if not sensors:
        return None
    moved_m = np.abs(travel_m[:, axis] - travel_m[0, axis])
    at_sensor_m = np.interp(sensors[0].t_s, experiment.t_s, moved_m)
    load_n = sensors[0].values[:, axis]
    measured_n = load_n[np.isfinite(load_n)]
    return at_sensor_m, load_n - measured_n[:1].sum(), float(sensors[0].value_sigmas[axis])


def bench_travel(experiment: Experiment) -> Array | None:
    """Return the displacement (T, 3) [m] of the grasp or obstacle that moves farthest, of the whole
    specimen; None if no force is measured, anything turns, or the displacement is on no line.
    """
    if experiment.specimen or not experiment.wrenches:
        return None
    travels = [np.zeros((len(experiment.t_s), 3))]
    for grasp in experiment.grasps:
        rotations, shifts = grasp.poses.at(experiment.t_s)
        if not np.allclose(rotations, np.eye(3), atol=1e-6):
            return None
        travels.append(shifts / grasp.displacement_scale)
    farthest = max(travels, key=lambda travel: float(np.ptp(travel, axis=0).max()))
    for travel in (farthest, farthest - farthest[0]):
        sizes = np.linalg.svd(travel, compute_uv=False)
        if len(sizes) == 1 or sizes[1] <= LINE_TOLERANCE * sizes[0]:
            return travel if np.ptp(travel, axis=0).max() > 0 else None
    return None
