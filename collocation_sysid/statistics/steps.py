"""Sudden lasting steps: of a pose that the markers do not follow, or of one marker alone.

A step of h between two samples shows in the second differences as h followed by −h; a motion that
starts or stops suddenly shows one of them only.
"""

from __future__ import annotations

import numpy as np

from ..arrays import Array
from ..experiment.experiment import Experiment
from ..nlp.any_stiffness import carrying
from .cause import Cause

# A step is so many times what else happens between samples.
SUDDEN = 4.0
# Of all samples, the liveliest tenth tells what else happens.
LIVELY = 0.9
FEWEST = 8


def steps(experiment: Experiment) -> tuple[Cause, ...]:
    """Poses that jump and markers that slip, the clearest first."""
    tracks = experiment.markers.positions_m
    if len(tracks) < FEWEST:
        return ()
    grasp = carrying(experiment)
    found = []
    poses = None
    if grasp is not None:
        poses = grasp.poses.carry(_corners(experiment), experiment.t_s)
        found += _jump(experiment, poses)
    return tuple(sorted([*found, *_slips(experiment, poses)], key=lambda c: -c.strength))


def _corners(experiment: Experiment) -> Array:
    """Corners of the markers' places on the undeformed body, which poses carry."""
    places = experiment.markers.observe(experiment.body.nodes_m)
    return np.vstack([places.min(axis=0), places.max(axis=0)])


def step_sizes(x: Array) -> Array:
    """(T − 3, M) size of a step between samples k + 1 and k + 2 of x (T, M, 3); NaN in gaps."""
    second = x[2:] - 2 * x[1:-1] + x[:-2]
    opposite = -np.sum(second[:-1] * second[1:], axis=2)
    return np.sqrt(np.maximum(opposite, 0.0))


def _jump(experiment: Experiment, carried: Array) -> list[Cause]:
    poses = step_sizes(carried).max(axis=1)
    k = int(poses.argmax())
    markers = step_sizes(experiment.markers.positions_m)
    here = markers[k][np.isfinite(markers[k])]
    if not len(here):
        return []
    sigma_m = float(np.median(experiment.markers.sigma_m))
    moved = np.linalg.norm(np.diff(carried, 2, axis=0), axis=2).max(axis=1)
    else_m = max(_lively(moved), float(np.median(here)), 2 * sigma_m)
    strength = float(poses[k]) / else_m
    if strength < SUDDEN:
        return []
    sentence = (
        f"'{experiment.name}': the poses jump by {1e3 * poses[k]:.2g} mm at "
        f"t = {experiment.t_s[k + 2]:.4g} s and the markers do not: repair the poses there, or end "
        "window_s before"
    )
    return [Cause("pose-jump", sentence, strength)]


def _slips(experiment: Experiment, poses: Array | None) -> list[Cause]:
    tracks, names = experiment.markers.positions_m, experiment.markers.names
    sizes = step_sizes(tracks)
    found = []
    for m, name in enumerate(names):
        if not np.isfinite(sizes[:, m]).any():
            continue
        k = int(np.nanargmax(sizes[:, m]))
        others = np.delete(sizes[k], m)
        others = others[np.isfinite(others)]
        else_m = max(
            _lively(sizes[:, m]),
            float(others.max(initial=0.0)),
            2 * float(experiment.markers.sigma_m[m]),
        )
        strength = float(sizes[k, m]) / else_m
        if strength > SUDDEN and _lasts(tracks, m, k + 2, float(sizes[k, m])):
            sentence = (
                f"'{experiment.name}': marker {name} slips by {1e3 * sizes[k, m]:.2g} mm at "
                f"t = {experiment.t_s[k + 2]:.4g} s, the others do not: give it markers.weights = "
                "0, or end window_s before"
            )
            found.append(Cause("marker-slip", sentence, strength))
    return found


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
