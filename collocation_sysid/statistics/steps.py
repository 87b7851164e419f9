"""Sudden lasting steps: of a pose that the markers do not follow, or of one marker alone.

A step of h between two samples shows in the second differences as h followed by −h; a motion that
starts or stops suddenly shows one of them only.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..arrays import Array
from ..program.any_stiffness import carrying
from ..recording.experiment import Experiment
from .hypothesis import Hypothesis

# A step is so many times what else happens between samples.
SUDDEN = 4.0
# Of all samples, the liveliest tenth tells what else happens.
LIVELY = 0.9
FEWEST = 8


def steps(experiment: Experiment) -> Iterator[Hypothesis]:
    """Poses that jump and markers that slip."""
    if len(experiment.markers.positions_m) < FEWEST:
        return
    if (grasp := carrying(experiment)) is not None:
        yield from _jump(experiment, grasp.poses.carry(_corners(experiment), experiment.t_s))
    yield from _slips(experiment)


def _corners(experiment: Experiment) -> Array:
    """Corners of the markers' places on the undeformed body, which poses carry."""
    places = experiment.markers.observe(experiment.body.nodes_m)
    return np.vstack([places.min(axis=0), places.max(axis=0)])


def step_sizes(x: Array) -> Array:
    """(T − 3, M) size of a step between samples k + 1 and k + 2 of x (T, M, 3); NaN in gaps."""
    second = x[2:] - 2 * x[1:-1] + x[:-2]
    opposite = -np.sum(second[:-1] * second[1:], axis=2)
    return np.sqrt(np.maximum(opposite, 0.0))


def _jump(experiment: Experiment, carried: Array) -> Iterator[Hypothesis]:
    sizes = step_sizes(carried).max(axis=1)
    k = int(sizes.argmax())
    markers = step_sizes(experiment.markers.positions_m)[k]
    moved = np.linalg.norm(np.diff(carried, 2, axis=0), axis=2).max(axis=1)
    sigma_m = float(np.median(experiment.markers.sigma_m))
    if np.isfinite(markers).any():
        usual_m = max(_lively(moved), float(np.nanmedian(markers)), 2 * sigma_m)
        yield from _sudden("pose-jump", experiment, k, float(sizes[k]), usual_m)


def _slips(experiment: Experiment) -> Iterator[Hypothesis]:
    markers = experiment.markers
    sizes = step_sizes(markers.positions_m)
    for m, name in enumerate(markers.names):
        if not np.isfinite(sizes[:, m]).any():
            continue
        k = int(np.nanargmax(sizes[:, m]))
        others, size_m = np.delete(sizes[k], m), float(sizes[k, m])
        most_m = float(others[np.isfinite(others)].max(initial=0.0))
        usual_m = max(_lively(sizes[:, m]), most_m, 2 * float(markers.sigma_m[m]))
        if _lasts(markers.positions_m, m, k + 2, size_m):
            yield from _sudden("marker-slip/alone", experiment, k, size_m, usual_m, name)


def _sudden(
    code: str, experiment: Experiment, k: int, size_m: float, usual_m: float, marker: str = ""
) -> Iterator[Hypothesis]:
    """A step between samples k + 1 and k + 2, if it is far larger than what is usual."""
    data = {"marker": marker, "by_mm": 1e3 * size_m, "t_s": experiment.t_s[k + 2]}
    if size_m >= SUDDEN * usual_m:
        yield Hypothesis(code, f"'{experiment.name}'", data, strength=size_m / usual_m)


def _lasts(tracks: Array, marker: int, sample: int, step_m: float) -> bool:
    """Whether the marker's distances from the others stay changed."""
    to_others = np.linalg.norm(tracks - tracks[:, marker : marker + 1], axis=2)
    others = np.delete(to_others, marker, axis=1)
    if not others.shape[1]:
        return True
    change = np.nanmedian(others[sample:], axis=0) - np.nanmedian(others[:sample], axis=0)
    return bool(np.nanmax(np.abs(change)) > 0.3 * step_m)


def _lively(sizes: Array) -> float:
    """What else happens: the liveliest tenth of all samples but the largest three."""
    rest = np.sort(sizes[np.isfinite(sizes)])[:-3]
    return float(np.quantile(rest, LIVELY)) if len(rest) else 0.0
