"""Markers that take each other's names at some sample, as trackers do after an occlusion.

Seen from the grasp a marker is, from one sample to the next, nearly where it was. Where the names
suit far better in another order, they have been exchanged; no model is needed to tell. The first
order is taken for right, unless another lasts more than twice as long.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

from ..arrays import Array, Index
from ..program.any_stiffness import carrying
from ..recording.experiment import Experiment
from .hypothesis import Hypothesis

# Another order of the names suits so many times better before it is believed.
CLEARLY = 2.5
# With Huber's loss fewer of a marker's samples than this share are no matter: they count as wild.
TAMED = 0.2


def exchanges(experiment: Experiment, huber: float | None = None) -> tuple[Hypothesis, ...]:
    """Markers whose names are exchanged for a part of the recording.

    Parameters
    ----------
    experiment : Experiment
    huber : float, optional
        Of the loss, where it is Huber's.
    """
    order, strength = _orders(experiment)
    kinds, counts = np.unique(order, axis=0, return_counts=True)
    right = kinds[int(np.argmax(np.where((kinds == order[0]).all(axis=1), 2, 1) * counts))]
    wrong = order != right
    share = float(wrong.mean(axis=0).max(initial=0.0))
    if not share or (huber is not None and share < TAMED):
        return ()
    at = np.flatnonzero(wrong.any(axis=1))
    first, t_s, names = int(at[0]), experiment.t_s, experiment.markers.names
    same = (order[first:] == order[first]).all(axis=1)
    end = first + (len(same) if same.all() else int(same.argmin()))
    when = f"from t = {t_s[first]:.4g} s " + (
        "on" if end == len(t_s) else f"to {t_s[end - 1]:.4g} s"
    )
    real = np.argsort(right)[order[first]]
    listed = ", ".join(f"{names[k]} is {names[real[k]]}" for k in np.flatnonzero(wrong[first]))
    also = ", and at other times" if at[-1] >= end else ""
    data = {"when": f"{when}{also}", "names": listed}
    return (Hypothesis("markers-exchanged/later", f"'{experiment.name}'", data, strength=strength),)


def _orders(experiment: Experiment) -> tuple[Index, float]:
    """(T, M) which marker of the first samples each one is, and how clearly it changes."""
    markers, grasp = experiment.markers, carrying(experiment)
    seen_m = np.array(markers.positions_m)
    if grasp is not None:
        rotations, translations_m = grasp.poses.at(experiment.t_s)
        seen_m = np.einsum("tji,tmj->tmi", rotations, seen_m - translations_m[:, None])
    order, strength = np.tile(np.arange(len(markers.names)), (len(seen_m), 1)), 0.0
    last_m = np.full(seen_m.shape[1:], np.nan)
    for k, now_m in enumerate(seen_m):
        there = np.isfinite(now_m[:, 0])
        known = np.flatnonzero(there & np.isfinite(last_m[:, 0]))
        chosen, clearly = _chosen(last_m[known], now_m[known], markers.sigma_m[known])
        if clearly > CLEARLY:
            order[k:, known] = order[k, known[chosen]]
            strength = max(strength, clearly)
        last_m[there] = now_m[there]
    return order, strength


def _chosen(before_m: Array, now_m: Array, sigma_m: Array) -> tuple[Index, float]:
    """Which of the markers before each one is now, and how many times nearer it is so."""
    same = np.arange(len(now_m))
    if len(now_m) < 2:
        return same, 1.0
    apart_m = (now_m - now_m.mean(axis=0))[:, None] - (before_m - before_m.mean(axis=0))
    cost = np.sum(apart_m**2, axis=2)
    if (cost.argmin(axis=1) == same).all():
        return same, 1.0
    _, chosen = linear_sum_assignment(cost)
    moved = np.flatnonzero(chosen != same)
    noise = 6 * float(np.sum(sigma_m[moved] ** 2))
    left = max(float(cost[moved, chosen[moved]].sum()), noise, 1e-300)
    return chosen, float(np.sqrt(cost[moved, moved].sum() / left))
