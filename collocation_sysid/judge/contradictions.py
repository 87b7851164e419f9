"""Contradictions in a description that need no simulation.

- Deforming a body takes work: loads that fall as their grasp advances have a wrong sign.
- Sudden lasting steps of a pose that the markers do not follow, or of one marker alone. A step of h
between two samples shows in the second differences as h followed by −h; a motion that starts or
stops suddenly shows one of them only.
- Markers that exchange names at some sample, as trackers do after an occlusion. In the frame of the
grasp a marker hardly moves from one sample to the next; if names fit far better in another order,
they have been exchanged. The first order is assumed right, unless another lasts more than twice as
long.
"""

from __future__ import annotations

from collections.abc import Container, Iterator

import numpy as np
from scipy.optimize import linear_sum_assignment

from ..common.array_types import Array, Index
from ..program.modes.modal_prediction import carrying_grasp
from ..recording.experiment import Experiment
from ..recording.grasp import Grasp
from ..recording.lost_points import STILL_SIGMAS, held_tracks
from ..recording.obstacle import Obstacle
from ..recording.poses import Frame
from ..statistics.hypothesis import Hypothesis
from ..statistics.thresholds import AGAINST, CLEARLY, SUDDEN, TAMED
from .doubt import exchanged_names

# Fewest samples for this correlation.
FEWEST_SAMPLES = 3
# Loads of an obstacle below this share of the largest may be those before it touches the body.
TOUCHING = 0.05


def load_sign_hypotheses(experiment: Experiment) -> Iterator[Hypothesis]:
    """Yield a hypothesis of a wrong sign for each grasp and axis of a static experiment where
    displacement and measured force are anticorrelated, below `AGAINST`.

    Tested are axes along which a grasp is displaced by a test bench, or along which an obstacle
    moves most. Dynamic experiments are not tested, because of inertia.
    """
    for k, grasp in enumerate(experiment.grasps if experiment.is_static else (), start=1):
        sensor = experiment.sensors_by_grasp.get(k)
        if sensor is None:
            continue
        shifts_m = grasp.poses.at(sensor.t_s)[1]
        for axis in grasp.zero or _pushing_axis(grasp, shifts_m, frame=sensor.frame):
            axis_index = "xyz".index(axis)
            displacement_m = shifts_m[:, axis_index]
            load_n = sensor.values[:, axis_index]
            is_measured = np.isfinite(load_n)
            if isinstance(grasp, Obstacle):
                # Before the obstacle touches the body, the load is noise.
                is_measured &= np.abs(load_n) > TOUCHING * np.nanmax(np.abs(load_n), initial=0.0)
            if is_measured.sum() < FEWEST_SAMPLES or not (
                np.ptp(displacement_m[is_measured]) and np.ptp(load_n[is_measured])
            ):
                continue
            correlation = float(np.corrcoef(displacement_m[is_measured], load_n[is_measured])[0, 1])
            if correlation < AGAINST:
                data = {"axis": axis, "grasp": k, "correlation": correlation}
                strength = 1 / (1 + correlation + 1e-3)
                yield Hypothesis("sign", f"'{experiment.name}'", data=data, strength=strength)


def _pushing_axis(grasp: Grasp, shifts_m: Array, frame: Frame) -> str:
    """Return the world axis along which an obstacle moves most; "" for others."""
    moved_m = np.ptp(shifts_m, axis=0)
    if not isinstance(grasp, Obstacle):
        return ""
    if not moved_m.any() or frame != "world":
        return ""
    return "xyz"[int(moved_m.argmax())]


# Quantile of the changes that counts as usual.
LIVELY = 0.9
# Share of the usual second difference of a motion that is no step: in fast motions with few samples,
# successive second differences are large and may have opposite directions.
WITHIN_MOTION = 0.5
# Fewest samples in which steps are searched.
FEWEST = 8


def step_hypotheses(experiment: Experiment) -> Iterator[Hypothesis]:
    """Yield hypotheses of poses that jump, of all markers that jump, and of single markers that
    are held at one place, or slip; nothing for fewer than `FEWEST` samples. Poses are tested only if
    a single grasp carries the body.
    """
    if len(experiment.markers.positions_m) < FEWEST:
        return
    if (grasp := carrying_grasp(experiment)) is not None:
        moved_m = grasp.poses.moved_positions(_marker_box_m(experiment), experiment.t_s)
        yield from _pose_jump_hypotheses(experiment, moved_m)
        yield from _common_jump(experiment, moved_m)
    held = [*_held_hypotheses(experiment)]
    yield from held
    yield from _slip_hypotheses(experiment, {each.data["marker"] for each in held})


def _held_hypotheses(experiment: Experiment) -> Iterator[Hypothesis]:
    """Yield a hypothesis for each marker that is exactly at one place for some samples, as in a gap
    that was filled with the last position or with zeros, while another one moves.
    """
    markers = experiment.markers
    sigma_m = float(np.median(markers.sigma_m))
    for held in held_tracks(markers.positions_at_samples_m, sigma_m):
        data = {
            "marker": markers.names[held.track],
            "count": held.count,
            "t_s": experiment.t_s[held.longest[0]],
            "by_mm": 1e3 * held.moved * sigma_m,
        }
        strength = held.moved / STILL_SIGMAS
        yield Hypothesis("marker-held", f"'{experiment.name}'", data=data, strength=strength)


def _common_jump(experiment: Experiment, moved_m: Array) -> Iterator[Hypothesis]:
    """Yield the largest sudden step of all markers together that the poses do not have."""
    tracks_m = experiment.markers.positions_at_samples_m
    sigma_m = experiment.markers.sigma_m
    complete = np.isfinite(tracks_m).all(axis=(1, 2))
    # A gap hides a step: samples around it are taken as neighbours.
    rows = np.flatnonzero(complete)
    if len(rows) < FEWEST:
        return
    times_s = experiment.t_s[rows]
    sizes = step_sizes(tracks_m[rows], times_s).min(axis=1)
    k = int(sizes.argmax())
    grasp_step_m = step_sizes(moved_m[rows], times_s).max(axis=1)[k]
    swift_m = min(_median_second_difference(track_m) for track_m in tracks_m[rows].swapaxes(0, 1))
    usual_m = max(
        _usual_change(sizes),
        float(grasp_step_m),
        2 * float(np.median(sigma_m)),
        WITHIN_MOTION * swift_m,
    )
    yield from _step_hypothesis(
        "markers-jump", experiment, k=int(rows[k]), size_m=float(sizes[k]), usual_m=usual_m
    )


# Motion of markers that may be none, over the size of the body, beside that of noise.
STILL_OF_SIZE = 0.01


def undriven_motion(experiment: Experiment) -> Iterator[Hypothesis]:
    """Yield the hypothesis that poses are wrong, if markers move although the body starts at rest
    and neither grasps nor loads change.

    Nothing is yielded without grasps, with obstacles, tendons or pressures, if a grasp begins or
    ends within the recording, or if no marker has `FEWEST_SAMPLES` samples.
    """
    t_s = experiment.t_s
    grasps = experiment.grasps
    if experiment.start != "equilibrium" or experiment.actuators or experiment.obstacles:
        return
    is_grasped_throughout = (
        grasp.from_s <= t_s[0] and grasp.until_s >= t_s[-1] for grasp in grasps
    )
    motions = [part for grasp in grasps for part in grasp.poses.at(t_s)]
    loads = [experiment.declared_node_forces_n(t_s), experiment.point_mass_at_nodes_kg(t_s)]
    if (
        not grasps
        or not all(is_grasped_throughout)
        or any(_changes(each) for each in (*motions, *loads))
    ):
        return
    markers = experiment.markers
    size_m = float(np.ptp(experiment.body.nodes_m, axis=0).max())
    is_measured = markers.is_complete.sum(axis=0) >= FEWEST_SAMPLES
    if not is_measured.any():
        return
    tracks_m = markers.positions_m[:, is_measured]
    motion_m = np.sqrt(np.nanmean(np.nanvar(tracks_m, axis=0).sum(axis=1)))
    still_m = STILL_OF_SIZE * size_m + STILL_SIGMAS * float(np.median(markers.sigma_m))
    if motion_m > still_m:
        data = {"by_mm": 1e3 * motion_m}
        of = f"'{experiment.name}'"
        yield Hypothesis("poses-constant", of, data=data, strength=float(motion_m / still_m))


def _changes(values: Array) -> bool:
    """Whether values (T, …) change by more than rounding over their first axis."""
    return bool(np.ptp(values, axis=0).max(initial=0.0) > 1e-9)


def _marker_box_m(experiment: Experiment) -> Array:
    places = experiment.markers.predict_positions(experiment.body.nodes_m)
    return np.vstack([places.min(axis=0), places.max(axis=0)])


def step_sizes(x: Array, t_s: Array | None = None) -> Array:
    """Return the size of a step between samples k + 1 and k + 2, from second differences of
    opposite directions; 0 for smooth motion, NaN in gaps.

    Parameters
    ----------
    x : (T, M, 3) array
        Tracks [m].
    t_s : (T,) array, optional
        Times of the samples [s]; without them the samples are evenly spaced. A step within a longer
        interval counts by the change in an interval of median length.

    Returns
    -------
    (T − 3, M) array
        Sizes [m].
    """
    changes = np.diff(x, axis=0)
    if t_s is not None:
        intervals_s = np.diff(t_s)
        changes *= (np.median(intervals_s) / intervals_s)[:, None, None]
    second = np.diff(changes, axis=0)
    opposite = -np.sum(second[:-1] * second[1:], axis=2)
    return np.sqrt(np.maximum(opposite, 0.0))


def _pose_jump_hypotheses(experiment: Experiment, moved_m: Array) -> Iterator[Hypothesis]:
    sizes = step_sizes(moved_m).max(axis=1)
    k = int(sizes.argmax())
    markers = step_sizes(experiment.markers.positions_at_samples_m)[k]
    moved = np.linalg.norm(np.diff(moved_m, 2, axis=0), axis=2).max(axis=1)
    sigma_m = float(np.median(experiment.markers.sigma_m))
    if np.isfinite(markers).any():
        usual_m = max(_usual_change(moved), float(np.nanmedian(markers)), 2 * sigma_m)
        yield from _step_hypothesis(
            "pose-jump", experiment, k=k, size_m=float(sizes[k]), usual_m=usual_m
        )


def _slip_hypotheses(experiment: Experiment, held: Container[str]) -> Iterator[Hypothesis]:
    markers = experiment.markers
    tracks_m = markers.positions_at_samples_m
    sizes = step_sizes(tracks_m)
    for m, name in enumerate(markers.names):
        if name in held or not np.isfinite(sizes[:, m]).any():
            continue
        k = int(np.nanargmax(sizes[:, m]))
        others = np.delete(sizes[k], m)
        size_m = float(sizes[k, m])
        most_m = float(others[np.isfinite(others)].max(initial=0.0))
        swift_m = WITHIN_MOTION * _median_second_difference(tracks_m[:, m])
        usual_m = max(_usual_change(sizes[:, m]), most_m, 2 * float(markers.sigma_m[m]), swift_m)
        if _is_lasting(tracks_m, m, sample=k + 2, step_m=size_m):
            yield from _step_hypothesis(
                "marker-slip/alone", experiment, k=k, size_m=size_m, usual_m=usual_m, marker=name
            )


def _step_hypothesis(
    code: str, experiment: Experiment, k: int, size_m: float, usual_m: float, marker: str = ""
) -> Iterator[Hypothesis]:
    """Yield a step between samples k + 1 and k + 2 if it is `SUDDEN` times the usual one."""
    data = {"marker": marker, "by_mm": 1e3 * size_m, "t_s": experiment.t_s[k + 2]}
    if size_m >= SUDDEN * usual_m:
        yield Hypothesis(code, f"'{experiment.name}'", data=data, strength=size_m / usual_m)


def _is_lasting(tracks: Array, marker: int, sample: int, step_m: float) -> bool:
    """Whether the distances of a marker (index) from the others in tracks (T, M, 3) remain changed
    from the index `sample` on, by more than 0.3 of the step `step_m` [m].

    Medians before and after are compared; one of the other markers suffices. True if there are no
    other markers.
    """
    to_others = np.linalg.norm(tracks - tracks[:, marker : marker + 1], axis=2)
    others = np.delete(to_others, marker, axis=1)
    if not others.shape[1]:
        return True
    before = others[:sample]
    after = others[sample:]
    both = np.isfinite(before).any(axis=0) & np.isfinite(after).any(axis=0)
    change = np.nanmedian(after[:, both], axis=0) - np.nanmedian(before[:, both], axis=0)
    return bool(np.abs(change).max(initial=0.0) > 0.3 * step_m)


def _usual_change(sizes: Array) -> float:
    """Return the 90 % quantile of changes without NaN and the largest three; 0 if too few."""
    rest = np.sort(sizes[np.isfinite(sizes)])[:-3]
    return float(np.quantile(rest, LIVELY)) if len(rest) else 0.0


def _median_second_difference(track_m: Array) -> float:
    """Return the median norm of second differences (T, 3) [m] without gaps, or 0."""
    norms_m = np.linalg.norm(np.diff(track_m, 2, axis=0), axis=1)
    return float(np.median(norms_m[np.isfinite(norms_m)])) if np.isfinite(norms_m).any() else 0.0


def name_exchange_hypotheses(
    experiment: Experiment, huber: float | None = None
) -> tuple[Hypothesis, ...]:
    """Return one hypothesis that names of markers are exchanged for a part of the recording, or an
    empty tuple; the order that lasts longest is assumed right, see the module's documentation.

    Parameters
    ----------
    huber : float, optional
        Threshold of Huber's loss, which tolerates short exchanges; None means a quadratic loss.
    """
    order, strength = _marker_identities(experiment)
    kinds, counts = np.unique(order, axis=0, return_counts=True)
    right = kinds[int(np.argmax(np.where((kinds == order[0]).all(axis=1), 2, 1) * counts))]
    wrong = order != right
    share = float(wrong.mean(axis=0).max(initial=0.0))
    if not share or (huber is not None and share < TAMED):
        return ()
    affected = np.flatnonzero(wrong.any(axis=1))
    first = int(affected[0])
    t_s = experiment.t_s
    names = experiment.markers.names
    same = (order[first:] == order[first]).all(axis=1)
    end = first + (len(same) if same.all() else int(same.argmin()))
    when = f"from t = {t_s[first]:.4g} s " + (
        "on" if end == len(t_s) else f"to {t_s[end - 1]:.4g} s"
    )
    real = np.argsort(right)[order[first]]
    also = ", and at other times" if affected[-1] >= end else ""
    data = {"when": f"{when}{also}", "names": exchanged_names(names, real)}
    return (
        Hypothesis("markers-exchanged/later", f"'{experiment.name}'", data=data, strength=strength),
    )


def _marker_identities(experiment: Experiment) -> tuple[Index, float]:
    """Return each marker's identity in each sample, and how much better they fit."""
    markers = experiment.markers
    grasp = carrying_grasp(experiment)
    in_grasp_m = np.array(markers.positions_at_samples_m)
    if grasp is not None:
        rotations, translations_m = grasp.poses.at(experiment.t_s)
        in_grasp_m = np.einsum("tji,tmj->tmi", rotations, in_grasp_m - translations_m[:, None])
    order = np.tile(np.arange(len(markers.names)), (len(in_grasp_m), 1))
    strength = 0.0
    last_m = np.full(in_grasp_m.shape[1:], np.nan)
    for k, now_m in enumerate(in_grasp_m):
        is_present = np.isfinite(now_m[:, 0])
        known = np.flatnonzero(is_present & np.isfinite(last_m[:, 0]))
        chosen, clearly = _best_assignment(
            last_m[known], now_m[known], sigma_m=markers.sigma_m[known]
        )
        if clearly > CLEARLY:
            order[k:, known] = order[k, known[chosen]]
            strength = max(strength, clearly)
        last_m[is_present] = now_m[is_present]
    return order, strength


def _best_assignment(before_m: Array, now_m: Array, sigma_m: Array) -> tuple[Index, float]:
    """Return the assignment (M,) of markers to those of the sample before, and the factor by which
    it is nearer than no exchange.

    Element k of the assignment is the index in `before_m` of marker k of `now_m`. The factor is the
    ratio of root-sum-square distances of the exchanged markers, without and with the exchange; it
    is 1 if nothing is exchanged. Distances below the noise count as the noise.
    """
    same = np.arange(len(now_m))
    if len(now_m) < 2:
        return same, 1.0
    differences_m = (now_m - now_m.mean(axis=0))[:, None] - (before_m - before_m.mean(axis=0))
    cost = np.sum(differences_m**2, axis=2)
    if (cost.argmin(axis=1) == same).all():
        return same, 1.0
    _, chosen = linear_sum_assignment(cost)
    exchanged = np.flatnonzero(chosen != same)
    noise = 6 * float(np.sum(sigma_m[exchanged] ** 2))
    remaining = max(float(cost[exchanged, chosen[exchanged]].sum()), noise, 1e-300)
    return chosen, float(np.sqrt(cost[exchanged, exchanged].sum() / remaining))
