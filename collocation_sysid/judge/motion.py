"""Rows of likely mistakes about a motion: clock, grasp, gravity, and the mesh and laws of the
body.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from ..common.array_types import Array
from ..common.time_dependence import at_times
from ..errors import InputError
from ..recording.experiment import Experiment
from ..recording.grasp import Grasp
from ..recording.nuisance import GRASP_SHIFT, GRASP_TURN, TILT, TIME
from ..recording.poses import PoseSequence
from ..statistics.hypothesis import Hypothesis
from ..statistics.thresholds import ESTIMATED_LAGS, FAR
from .bodies import body_rows, mirrored_meshes
from .doubt import Correction, Doubt, clock_data
from .fit import Candidate, TestedFit
from .modes import ModalComparison, other_gravity
from .sensors import sensor_candidates, unknown_tools

# Deviation of a clock in the linear step [s].
WIDE_LAG_S = 0.1
# Deviation of the thickness of a layer in the linear step, over the extent of the body.
WIDE_LAYER = 0.5
# Nuisance parameters of the body in its grasp, which turn and shift it to hide other mistakes.
BODY_ROWS = (TILT, GRASP_TURN, GRASP_SHIFT)
# Factors by which films of phones are slower than the motion.
SLOW_MOTIONS = (4.0, 8.0)
# Change of a marker, in standard deviations of its noise, from which on it moves.
BEYOND_NOISE = 10.0
# Share of χ² that remains of which linear steps come before mistakes that have none.
UNMEASURED = 0.9


def motion_rows(fit: TestedFit) -> Iterator[Doubt]:
    """Yield the rows of a motion that have a linear step."""
    if not fit.experiment.is_static:
        yield from _clock(fit)
    yield from _layers(fit)
    yield from unknown_tools(fit)
    yield from body_rows(fit.part)


def motion_candidates(fit: TestedFit) -> Iterator[Candidate]:
    """Yield the likely mistakes of a motion without a linear step, by a criterion of their own:
    sensors, mirrored meshes, films in slow motion, gravity of the other sign, and any other direction
    of gravity if the fit moved the body far from its stated pose.
    """
    experiment = fit.experiment
    yield from sensor_candidates(fit)
    for row in (*_slow_motions(experiment), *mirrored_meshes(experiment)):
        if found := row.hypothesis(experiment):
            yield UNMEASURED, found
    others = []
    for other_m_s2, data in other_gravity(experiment.gravity_m_s2):
        without = replace(experiment, gravity_m_s2=other_m_s2)
        others.append(Hypothesis("gravity", f"'{experiment.name}'", data=data, corrected=without))
        # Modes do not contain what gravity along the body does.
        if np.allclose(other_m_s2, -experiment.gravity_m_s2):
            yield UNMEASURED, others[-1]
    rows = fit.part.transcription.nuisance.indices_of_rows(*BODY_ROWS)
    if np.abs(fit.part.phi[rows]).max(initial=0.0) < FAR:
        return
    stated = ModalComparison.from_experiment(experiment, fit.whole.parameters)
    if stated is not None and others:
        motion = stated.declared
        misfits_m = [
            stated.misfit_m(replace(motion, gravity_m_s2=each.corrected.gravity_m_s2))
            for each in others
        ]
        share = (min(misfits_m) / stated.misfit_m(motion)) ** 2
        yield share, others[int(np.argmin(misfits_m))]


def _clock(fit: TestedFit) -> Iterator[Doubt]:
    """Yield the row of poses that are late or early; its column is the rate of all predictions."""
    prior_s = fit.experiment.nuisance.sigma(TIME) or 0.0
    rows = fit.part.transcription.nuisance.indices_of_rows(TIME)
    estimated_s = prior_s * float(fit.part.phi[rows].sum())
    rates = {
        each: np.gradient(values, each.sample_times_s, axis=0) / each.sample_sigmas
        for each, values in fit.predictions.items()
        if len(values) > 1
    }

    def correct(experiment: Experiment, size: Array) -> Correction:
        # A fit that has followed the lag knows it better than a linear step.
        is_followed = abs(estimated_s) > ESTIMATED_LAGS * prior_s
        lag_s = -(estimated_s if is_followed else float(size[0]))
        if abs(lag_s) <= ESTIMATED_LAGS * prior_s:
            return None
        other = with_pose_lag(experiment, lag_s)
        return other and (other, clock_data(lag_s))

    changes = fit.blocks_of(rates)
    yield Doubt("clock", "s", correct, changes=changes, mean=0.0, wide=WIDE_LAG_S)


def _slow_motions(experiment: Experiment) -> Iterator[Doubt]:
    """Yield the rows of markers with the times of a film that is slower than the motion, where no
    moving grasp and no table of forces contradicts these times. The times at which grasps, masses and
    forces begin and end were read from the film if the markers begin to move then.
    """
    moves = any(np.ptp(each.poses.positions_m, axis=0).any() for each in experiment.grasps)
    moves |= any(each.t_s is not None for each in experiment.forces)
    if experiment.is_static or moves or not experiment.markers.sample_count:
        return
    for factor in SLOW_MOTIONS:

        def correct(experiment: Experiment, _: Array, factor: float = factor) -> Correction:
            first_s, markers = experiment.t_s[0], experiment.markers

            def real(t_s: Any) -> Any:
                return first_s + (t_s - first_s) / factor

            tracks_m, far_m = markers.positions_m, BEYOND_NOISE * markers.sigma_m[:, None]
            moves = (np.nan_to_num(np.abs(tracks_m - tracks_m[0])) > far_m).any(axis=(1, 2))
            onset_s = markers.t_s[np.argmax(moves)]

            def in_real_time(each: Any) -> Any:
                ends = {name: getattr(each, name) for name in ("from_s", "until_s")}
                read_from_film = {
                    name: real(v)
                    for name, v in ends.items()
                    if abs(v - onset_s) < abs(first_s + factor * (v - first_s) - onset_s)
                }
                return replace(each, **read_from_film)

            windows = {
                kind: [in_real_time(each) for each in getattr(experiment, kind)]
                for kind in ("grasps", "masses", "forces")
            }
            seen = replace(markers, t_s=real(markers.t_s))
            try:
                other = replace(experiment, t_s=real(experiment.t_s), markers=seen, **windows)
            except InputError:
                return None
            return other, {"factor": factor}

        yield Doubt("clock/slow", "1", correct)


def _layers(fit: TestedFit) -> Iterator[Doubt]:
    """Yield the row of grasps that hold one layer more or less, by the effect of their edge."""
    size_m = float(np.ptp(fit.experiment.body.nodes_m, axis=0).max())

    def correct(experiment: Experiment, size: Array) -> Correction:
        return _other_layer(experiment, deeper=bool(size[0] < 0))

    yield Doubt(
        "grasp-layer",
        "m",
        correct,
        effect=lambda at, _: at.effect_of_grips,
        mean=0.0,
        wide=WIDE_LAYER * size_m,
    )


def _other_layer(experiment: Experiment, deeper: bool) -> Correction:
    """Return None for grasps of less than three nodes, or of all."""
    cells = experiment.body.cells
    n = len(experiment.body.nodes_m)
    grasps = []
    for grasp in experiment.grasps:
        is_grasped = np.isin(np.arange(n), grasp.nodes)
        # The layer that touches what is held, or of what is held that which touches the rest.
        is_shifted = is_grasped if deeper else ~is_grasped
        grown = np.zeros(n, dtype=bool)
        grown[cells[is_shifted[cells].any(axis=1)]] = True
        nodes = np.flatnonzero(grown if deeper else is_grasped & ~grown)
        if len(nodes) < 3 or len(nodes) > n - 1:
            return None
        grasps.append(replace(grasp, nodes=nodes))
    try:
        other = replace(experiment, grasps=grasps)
    except InputError:
        return None
    return other, {"deep": "more" if deeper else "fewer"}


def with_pose_lag(experiment: Experiment, lag_s: float) -> Experiment | None:
    """Return the experiment with its poses `lag_s` [s] later (negative: earlier); None if fewer
    than three samples remain, or the result is no valid experiment. Samples after the last delayed
    pose are left out.
    """
    t_s = experiment.t_s
    is_covered = t_s <= t_s[-1] + min(lag_s, 0.0) + 1e-9
    if is_covered.sum() < 3:
        return None
    markers = experiment.markers
    try:
        return replace(
            experiment,
            t_s=t_s[is_covered],
            grasps=[
                replace(g, poses=_delayed_poses(g, t_s, lag_s=lag_s)) for g in experiment.grasps
            ],
            markers=at_times(markers, is_covered),
        )
    except InputError:
        return None


def _delayed_poses(grasp: Grasp, t_s: Array, lag_s: float) -> PoseSequence:
    """Return the poses of a grasp, `lag_s` later [s]; a single pose is unchanged.

    If they are later, the first pose is repeated at the first of the times `t_s` (or its own), so
    that the grasp rests until it begins to move.
    """
    poses = grasp.poses
    if len(poses.t_s) < 2:
        return poses
    times = poses.t_s + lag_s
    first = slice(0, 1)
    if lag_s <= 0:
        return replace(poses, t_s=times)
    # Before its first pose the grasp rests there.
    return replace(
        poses,
        t_s=np.r_[min(t_s[0], poses.t_s[0]), times],
        positions_m=np.concatenate([poses.positions_m[first], poses.positions_m]),
        quaternions_xyzw=np.concatenate([poses.quaternions_xyzw[first], poses.quaternions_xyzw]),
    )
