"""Misspecification hypotheses for a fit that misses its data: refits without a mistake, ranked by
misfit.

The tests of `modes` cost little. The others change the experiment that fits
worst: it is fitted again with each mistake corrected, and the factor by which its misfit decreases
is the strength of the hypothesis. Of the directions of gravity, the natural modes choose the one
that is refitted.

Hypotheses about sensors and obstacles are in modules of their own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..common.array_types import Array
from ..common.time_dependence import at_times
from ..errors import InputError, SimulationError
from ..methods.reduced_search import UNLIMITED
from ..methods.reduced_space import ReducedSpace
from ..methods.solution import Solution, Status
from ..methods.starts.continuation import first_samples
from ..methods.starts.initial_trajectories import associated_at_guess
from ..program.collocation import Collocation, ExperimentIterate
from ..program.modes.modal_prediction import DeclaredMotion
from ..recording.experiment import Experiment
from ..recording.grasp import Grasp
from ..recording.hysteresis import branch_differences, loading_branch, unloading_difference
from ..recording.measurement_selection import measured_count
from ..recording.nuisance import GRASP_SHIFT, GRASP_TURN, TILT, TIME
from ..recording.poses import PoseSequence
from ..statistics.distributions import normal_isf
from ..statistics.hypothesis import NO_CAUSE, Hypothesis, rank
from ..statistics.thresholds import (
    BETTER,
    CERTAIN,
    ESTIMATED_LAGS,
    FAR,
    FURTHER,
    INDISTINGUISHABLE,
    LINEAR,
    MIRRORED,
    NOISE,
    PARTIAL,
    PARTLY,
    RARE,
    REPRODUCED,
    SLIP,
)
from .bodies import LinearCorrection, coarse_mesh_hypotheses, mirrored_meshes, screened_bodies
from .doubt import Correction, Doubt, HypothesisTest, clock_hypothesis, corrected_hypotheses
from .modes import ModalComparison, find_misspecifications_by_modes, gravity_hypotheses
from .registry import SOURCES
from .sensors import sensor_hypotheses, sensor_misfits
from .tracks import exchanged_places, filtered_signals, same_tracks

# Largest number of samples of a refit.
MOST_SAMPLES = 100
# Largest number of refits for the lag of a clock.
CLOCK_REFITS = 4
# Fewest sweeps of one refit.
FEWEST_SWEEPS = 15
# Most sweeps of one refit; within these limits, as many as the fit took iterations.
MOST_SWEEPS = 40
# Work of all refits over that of the fit.
EFFORT = 5
# Most sweeps of all refits.
BUDGET = 200
# Length of the last step of a parameter's logarithm.
TOLERANCE = 1e-2
# Predicted relative decrease of the loss by a change of one logarithm by 1 that ends a refit: far
# below that of a correction that counts.
LEAST_DECREASE = 1e-2
# Loss of a part of the samples over that of all samples without a correction, above which a
# correction is refuted: more samples have no smaller loss.
REFUTED = 10.0
# Change of the lag that ends the search [s].
SAME_LAG_S = 5e-4
# Nuisance parameters of the body in its grasp, which turn and shift it to hide other mistakes.
BODY_ROWS = (TILT, GRASP_TURN, GRASP_SHIFT)
# Fewest samples before and after a slip.
SHORTEST = 4


def motion_misspecifications(solution: Solution, known: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Return hypotheses about the motion and the sensors of the experiment with the largest misfit,
    by natural modes and refits; empty if its measurements miss by at most `NOISE` σ.

    Parameters
    ----------
    known : sequence of Hypothesis
        Other hypotheses; nothing is fitted again if one of these, or of the natural modes, is
        nearly certain (`CERTAIN`).
    """
    fitted = [transcription.experiment for transcription in solution.collocation.transcriptions]
    hypotheses = [each for experiment in fitted for each in same_tracks(experiment)]
    hypotheses += [
        each
        for experiment in fitted
        for each in filtered_signals(experiment, solution.fitted_values[experiment.name])
    ]
    hypotheses += [each for part in solution.parts for each in exchanged_places(part)]
    discrepancies = [_discrepancy(solution, k) for k in range(len(fitted))]
    if max(discrepancies) <= 1.0 or hypotheses:
        return hypotheses
    worst = fitted[number := int(np.argmax(discrepancies))]
    by_modes = find_misspecifications_by_modes(
        worst, solution.parameters, huber=solution.collocation.huber
    )
    rms_m = solution.rms_by_experiment_m.get(worst.name, np.inf)
    residual_m = _residual(worst, solution.readings_m[number])
    # The fit moved the body, not only its natural modes: what leaves more than the fit is refuted.
    hypotheses += [
        h
        for h in by_modes
        if (h.remaining is None or h.remaining < rms_m) and not _is_reproduced(h, worst, residual_m)
    ]
    certainty = max((each.strength for each in (*known, *hypotheses)), default=0.0)
    if certainty < CERTAIN:
        hypotheses += _refit_hypotheses(solution, worst, discrepancy=discrepancies[number])
    return hypotheses


def _is_reproduced(hypothesis: Hypothesis, experiment: Experiment, residual_m: Array) -> bool:
    """Return whether all residuals (T, M, 3) [m] are below `REPRODUCED` times the step."""
    if hypothesis.cause not in ("marker-slip", "markers-jump") or "by_mm" not in hypothesis.data:
        return False
    names = experiment.markers.names
    name = hypothesis.data.get("marker", "")
    own_m = residual_m[:, [names.index(name)]] if name in names else residual_m
    distances_m = np.linalg.norm(own_m, axis=2)
    largest_m = np.max(distances_m, initial=0.0, where=np.isfinite(distances_m))
    return bool(largest_m < REPRODUCED * 1e-3 * hypothesis.data["by_mm"])


def measurements_miss(solution: Solution) -> bool:
    """Return whether a measurement of an experiment misses by more than noise, or its body is
    turned or shifted in its grasp more than such errors are.
    """
    return max(_discrepancy(solution, k) for k in range(len(solution.parts))) > 1.0


def _discrepancy(solution: Solution, number: int = 0) -> float:
    """Return the discrepancy of an experiment (index) of a fit, 1 or less for noise: the largest
    RMS residual of its measurements over `NOISE` σ, or the largest error of gravity or of the pose
    in the grasp over the largest one that a faultless recording has, if that is larger. Specimens,
    which have hypotheses of their own, and depth images do not count.
    """
    part = solution.parts[number]
    misfits = sensor_misfits(solution, number)
    if part.transcription.experiment.specimen is not None or not misfits:
        return 0.0
    limit = float(normal_isf(RARE / 2 / max(1, len(part.phi))))
    largest = _pose_deviation(part) / limit
    return max(max(misfits.values()) / NOISE, largest)


def _pose_deviation(part: ExperimentIterate) -> float:
    """Return the largest error of gravity or of the pose in the grasp, in standard deviations."""
    rows = part.transcription.nuisance.indices_of_rows(*BODY_ROWS)
    return float(np.abs(part.phi[rows]).max(initial=0.0))


def _refit_hypotheses(
    solution: Solution, experiment: Experiment, discrepancy: float
) -> list[Hypothesis]:
    """Return the hypothesis whose correction lets the first samples of an experiment fit as well as
    noise allows; several as one hypothesis if the fits do not tell them apart, or if none of
    them suffices. Empty if nothing decreases the discrepancy clearly, or these samples cannot be
    fitted.
    """
    first = first_samples(experiment, MOST_SAMPLES)
    alone = _Refitter(solution, first)
    alone.near_answer.add(first)
    stated = alone.fit(first)
    if stated is None:
        return []
    fitted_m = stated.readings_m[0]
    trial = HypothesisTest(
        _discrepancy(stated),
        alone.discrepancy_after_refit,
        required_factor=BETTER,
        smallest_misfit=1 / NOISE,
        noise_level=1.0,
    )
    partly = replace(trial, required_factor=PARTLY)
    sensors = [
        better
        for each in partly.accepted(sensor_hypotheses(stated, NOISE))
        for better in trial.accepted(_corrected_again(each, alone, partly))
    ]
    if any(each.strength > CERTAIN and (each.remaining or 0.0) <= 1.0 for each in sensors):
        return _named_alone_or_together(sensors, alone.loss_after_refit)
    of = f"'{experiment.name}'"
    lags = [] if first.is_static else _clock_hypotheses(alone, first, stated=stated, of=of)
    comparison = ModalComparison.from_experiment(first, solution.parameters)
    turned = [] if comparison is None else [*_gravity_hypotheses(first, comparison)]
    images = mirrored_meshes(first) if discrepancy > MIRRORED else ()
    mirrored = [*corrected_hypotheses(images, first)]
    is_far = max(map(_pose_deviation, solution.parts)) > FAR
    if is_far:  # these come first, and leave the others their sweeps
        alone.sweeps += alone.each * (len(mirrored) + len(turned))
        alone.longer.update(each.corrected for each in turned)
    bodies = [*screened_bodies(solution, first, is_far=is_far)]
    alone.near_answer.update(each.corrected for each in bodies)
    # The first samples may end before the unloading: the complete fit is what must improve. The
    # message is about all experiments.
    whole = replace(trial, misfit=discrepancy)
    unloading = corrected_hypotheses([_unloading(solution)], experiment)
    tested = [
        *sensors,
        *whole.accepted(replace(each, subject="") for each in unloading),
        *trial.accepted(
            [
                # A body far from its stated pose: mirror images, before others use up the sweeps.
                *(mirrored if is_far else ()),
                *lags,
                # Few, before others use up the sweeps.
                *corrected_hypotheses([_slip(fitted_m), *GRASP_LAYERS], first),
                *turned,
                *bodies,
                *(() if is_far else mirrored),
            ]
        ),
        *partly.accepted(coarse_mesh_hypotheses(solution, of)),
    ]
    return _named_alone_or_together(tested, alone.loss_after_refit)


def _corrected_again(
    hypothesis: Hypothesis, alone: _Refitter, trial: HypothesisTest
) -> Iterator[Hypothesis]:
    refitted = alone.fit(hypothesis.corrected)
    if refitted is not None and (hypothesis.remaining or 0.0) > 1.0:
        again = sensor_hypotheses(refitted, NOISE, declared=alone.declared)
        same = [e for e in again if (e.code, e.subject) == (hypothesis.code, hypothesis.subject)]
        hypothesis = next(trial.accepted(same), hypothesis)
    yield hypothesis


def _named_alone_or_together(
    tested: Sequence[Hypothesis], loss_of: Callable[[Any], float]
) -> list[Hypothesis]:
    """Return the hypothesis that brings the residuals to the noise; as one of several if others do
    so with a loss that is larger by at most `INDISTINGUISHABLE`, of one cause the one that changes
    less; if none does, those that reduce them most, as one hypothesis.

    A linear correction, such as a finer mesh, is of an error that is known, beside which other
    corrections say little: it is named alone if it explains the residuals as far as a linear
    correction can (`LINEAR`), or if nothing else brings them to the noise or decreases them far more
    (`FURTHER`), else before the others.
    """
    linear = [each for each in tested if isinstance(each.corrected, LinearCorrection)]
    if any(each.strength >= LINEAR for each in linear):
        return [each for each in linear if each.strength >= LINEAR]
    sufficient = [
        each
        for each in tested
        if each not in linear and each.remaining is not None and each.remaining <= 1.0
    ]
    if not sufficient:
        least = max((FURTHER * each.strength for each in linear), default=0.0)
        partial = [each for each in tested if each in linear or each.strength > least]
        partial.sort(key=lambda each: -each.strength)
        partial = [each for each in partial if each.strength > PARTIAL * partial[0].strength]
        return _together("insufficient", partial)
    losses = [loss_of(each.corrected) for each in sufficient]
    likely = [
        each
        for each, loss in zip(sufficient, losses, strict=True)
        if loss <= min(losses) + INDISTINGUISHABLE
    ]
    simplest: dict[str, Hypothesis] = {}
    for each in sorted(likely, key=lambda each: each.code.endswith("/both")):
        simplest.setdefault(each.cause, each)
    likely = [*linear, *rank(simplest.values())]
    return likely if len(likely) == 1 else _together("several", likely)


def _together(code: str, hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    if not hypotheses:
        return []
    texts = (replace(each, subject="", corrected=None).message for each in hypotheses)
    data = {"causes": "; or ".join(texts)}
    return [replace(rank(hypotheses)[0], code=code, data=data)]


def _gravity_hypotheses(declared: Experiment, comparison: ModalComparison) -> Iterator[Hypothesis]:
    others = gravity_hypotheses(comparison.declared)
    nearest = min(others, key=lambda each: comparison.misfit_m(each.corrected), default=None)
    if nearest is not None:
        gravity_m_s2 = nearest.corrected.gravity_m_s2
        yield replace(nearest, corrected=replace(declared, gravity_m_s2=gravity_m_s2))


def _unloading(solution: Solution) -> Doubt:
    """Return the row of a material that unloads below its loading curve on a bench; without it only
    the loading branch is fitted. The message has the differences of all fitted experiments.
    """

    def corrected(experiment: Experiment, _: Array) -> Correction:
        branch = loading_branch(experiment, MOST_SAMPLES)
        if branch is None or (unloading_difference(experiment) or 0.0) >= 0.0:
            return None
        fitted = [each.experiment for each in solution.collocation.transcriptions]
        return branch, {"sizes": branch_differences(each for each in fitted if not each.specimen)}

    return Doubt("hysteresis", "1", correct=corrected, is_whole=True)


def _slip(fitted_m: Array) -> Doubt:
    """Return an impossible row if two means explain no residuals `SLIP` times better than one."""

    def corrected(experiment: Experiment, _: Array) -> Correction:
        residual = _residual(experiment, fitted_m)
        described = DeclaredMotion.from_experiment(experiment)
        if described is not None:
            residual = np.einsum(
                "tji,tmj->tmi", described.rotations, residual[: len(described.t_s)]
            )
        if residual.shape[1] < 2:
            return None
        clearest = [_largest_step(residual[:, m]) for m in range(residual.shape[1])]
        m = int(np.argmax([ratio for ratio, _ in clearest]))
        if clearest[m][0] < SLIP:
            return None
        markers = experiment.markers
        tracks = np.array(markers.positions_m)
        tracks[:, m] = np.nan
        data = {"marker": markers.names[m], "t_s": experiment.t_s[clearest[m][1]]}
        return replace(experiment, markers=replace(markers, positions_m=tracks)), data

    return Doubt("marker-slip", "m", correct=corrected, is_whole=True)


def _largest_step(residual: Array) -> tuple[float, int]:
    """Return how much better two means explain residuals (T, 3) than one, and where they change."""
    present = np.flatnonzero(np.isfinite(residual[:, 0]))
    if len(present) < 2 * SHORTEST:
        return 1.0, 0
    x = residual[present]
    total = np.cumsum(x, axis=0)[:-1]
    count = np.arange(1, len(x))[:, None]
    before = total / count
    after = (x.sum(axis=0) - total) / (len(x) - count)
    gain = np.sum(count * before**2 + (len(x) - count) * after**2, axis=1)
    k = SHORTEST - 1 + int(np.argmax(gain[SHORTEST - 1 : len(x) - SHORTEST]))
    one = np.sum((x - x.mean(axis=0)) ** 2)
    two = np.sum(x**2) - gain[k]
    return float(np.sqrt(one / max(two, 1e-30))), int(present[k + 1])


class _Refitter:
    """Fits of one experiment at a time with a limited number of sweeps, from the problem's guess, or
    from the answer and its motion for experiments in `near_answer`.

    Parameters
    ----------
    solution : Solution
        Fit of the problem.
    declared : Experiment
        Experiment as stated; if the problem consists of it alone, its fit is known already.
    """

    def __init__(self, solution: Solution, declared: Experiment) -> None:
        self.collocation = solution.collocation
        fitted = [transcription.experiment for transcription in self.collocation.transcriptions]
        rows = sum(len(experiment.t_s) for experiment in fitted)
        self.each = min(MOST_SWEEPS, max(FEWEST_SWEEPS, solution.iterations))
        work = EFFORT * self.each * rows // len(declared.t_s)
        self.sweeps = min(BUDGET, work)  # that are left for all fits together
        self.near_answer: set[Experiment] = set()
        # Experiments whose fits may take twice the sweeps: that of another direction of gravity than
        # the one to which a fit turned the body begins far from its answer.
        self.longer: set[Experiment] = set()
        self.declared = declared
        self.parts = solution.parts
        parameters = solution.collocation.parameters
        values = parameters.values(solution.q)
        self.answer = {item.name: values[item.name] for item in parameters.free}
        self.known: dict[Experiment, Solution | None] = {}
        if len(fitted) == 1 and len(declared.t_s) == rows:
            self.known[declared] = solution

    def fit(self, experiment: Experiment) -> Solution | None:
        if experiment not in self.known:
            self.known[experiment] = self._fit(experiment)
        return self.known[experiment]

    def discrepancy_after_refit(self, corrected: Experiment | LinearCorrection) -> float | None:
        fitted, share = self._fit_and_share(corrected)
        return None if fitted is None else _discrepancy(fitted) * float(np.sqrt(share))

    def loss_after_refit(self, corrected: Experiment | LinearCorrection) -> float:
        """Return the loss with that expected of measurements left out; infinite without a fit."""
        fitted, share = self._fit_and_share(corrected)
        if fitted is None:
            return np.inf
        loss = fitted.history[-1].loss * share
        if isinstance(corrected, Experiment):  # what it leaves out counts as noise
            loss += measured_count(self.declared) - measured_count(corrected)
        return loss

    def _fit_and_share(
        self, corrected: Experiment | LinearCorrection
    ) -> tuple[Solution | None, float]:
        if isinstance(corrected, LinearCorrection):
            return self.fit(self.declared), corrected.share
        return self.fit(corrected), 1.0

    def _fit(self, experiment: Experiment) -> Solution | None:
        """Return None if no sweeps are left or the fit fails; one that reaches its limit counts."""
        if self.sweeps <= 0:
            return None
        is_far = experiment in self.longer
        stated = self.known.get(self.declared)
        loss = UNLIMITED if stated is None or is_far else REFUTED * stated.history[-1].loss
        method = ReducedSpace(
            max_iterations=min(self.each * (1 + is_far), self.sweeps),
            tolerance=TOLERANCE,
            least_decrease=LEAST_DECREASE,
            largest_loss=loss,
        )
        start = None
        try:
            changed = replace(self.collocation, experiments=(experiment,))
            if experiment in self.near_answer:
                changed = changed.with_parameters(changed.parameters.with_estimates(self.answer))
                start = self._answer_of(changed)
            solution = method(associated_at_guess(changed), start=start)
        except (InputError, SimulationError):
            return None
        self.sweeps -= solution.iterations
        solution.unless_interrupted()
        ended = solution.status.converged or solution.status is Status.ITERATION_LIMIT
        return solution if ended else None

    def _answer_of(self, changed: Collocation) -> Array | None:
        """Return variables with the motion and the nuisance parameters of the fit, for the first
        samples of a recording with the same nodes and the problem's parameters at the answer; None
        for other times or nodes.
        """
        (transcription,) = changed.transcriptions
        name = transcription.experiment.name
        part = next(p for p in self.parts if p.transcription.experiment.name == name)
        times_s = transcription.dynamics.t_s
        x = part.x[: len(times_s)]
        if x.shape != (len(times_s), transcription.dof_count) or not np.allclose(
            part.transcription.dynamics.t_s[: len(x)], times_s
        ):
            return None
        phi = dict(zip(part.transcription.nuisance.names, part.phi.tolist(), strict=True))
        return changed.pack(changed.with_values(phi, changed.guess_p), [x])


def _clock_hypotheses(
    alone: _Refitter, declared: Experiment, stated: Solution, of: str
) -> Iterator[Hypothesis]:
    """Yield the lag for which residuals and velocities agree best, after a few refits."""
    least = _discrepancy(stated)
    lag_s = 0.0
    shifted = declared
    fitted = stated
    best = None
    for _ in range(CLOCK_REFITS):
        more_s = _lag_s(fitted)
        lag_s += more_s
        if abs(more_s) < SAME_LAG_S:
            break
        later = with_pose_lag(declared, lag_s)
        refitted = None if later is None else alone.fit(later)
        if later is None or refitted is None:
            break
        shifted = later
        fitted = refitted
        if (now := _discrepancy(fitted)) < least:
            best = clock_hypothesis(of, lag_s, corrected=shifted)
            least = now
    if best is not None and abs(lag_s) > ESTIMATED_LAGS * (declared.nuisance.sigma(TIME) or 0.0):
        yield best


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


def _lag_s(fitted: Solution) -> float:
    """Return by how much the measurements of one fitted experiment lag behind their predictions, in
    seconds, to first order; negative if they are early. Markers are used, or without them all
    sensors with numbers.

    It is Σ r·v / Σ v·v of residuals r (predicted less measured) and rates v of the predictions,
    both over σ; 0 without motion. Missing values are ignored.
    """
    (part,) = fitted.parts
    experiment = part.transcription.experiment
    pairs = zip(experiment.measurements, fitted.fitted_values[experiment.name], strict=True)
    numbers = [
        (each, values)
        for each, values in pairs
        if isinstance(values, np.ndarray) and len(values) > 1
    ]
    if experiment.markers.sample_count:
        numbers = [pair for pair in numbers if pair[0] is experiment.markers]
    lagged = moved = 0.0
    for each, values in numbers:
        residual = (values - each.measured_values) / each.sample_sigmas
        rates = np.gradient(values, each.sample_times_s, axis=0) / each.sample_sigmas
        known = np.isfinite(residual) & np.isfinite(rates)
        lagged += float(np.sum((residual * rates)[known]))
        moved += float(np.sum(rates[known] ** 2))
    return lagged / max(moved, 1e-300)


def _other_layer(deeper: bool) -> Doubt:
    """Return the row of grasps of at least three nodes, and not of all."""

    def corrected(experiment: Experiment, _: Array) -> Correction:
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

    return Doubt("grasp-layer", "1", correct=corrected, is_whole=True)


GRASP_LAYERS = (_other_layer(deeper=True), _other_layer(deeper=False))


def _residual(experiment: Experiment, predicted_m: Array) -> Array:
    return np.where(
        experiment.markers.is_measured, predicted_m - experiment.markers.positions_m, np.nan
    )


# The same for tests on benches and for motions.
TESTED = {
    True: "hysteresis, layer of the grasp, sensors, the law of the material",
    False: "clock, slip in the grasp, gravity, layer of the grasp, sensors, the laws of the material",
}


def find_misspecifications(solution: Solution) -> tuple[Hypothesis, ...]:
    """Return hypotheses of what is described wrongly, likeliest first; empty where the residuals
    are noise.

    Those of the features are always tested; others only if a measurement of an experiment
    misses, see `motion_misspecifications`.

    Returns
    -------
    tuple of Hypothesis
        `strength` is the factor by which the misfit decreases without the mistake.
    """
    hypotheses = [hypothesis for source in SOURCES for hypothesis in source.fitted(solution)]
    hypotheses += motion_misspecifications(solution, hypotheses)
    return rank(hypotheses)


def cause_notes(solution: Solution, causes: Sequence[Hypothesis]) -> tuple[str, ...]:
    """Return notes on causes that the data do not show (`Hypothesis.is_open`), or else that refits
    found no cause of a misfit; empty if there is another cause, or if the measurements do not miss.
    """
    if causes:
        return tuple(each.message for each in causes if each.is_open)
    if not measurements_miss(solution):
        return ()
    is_static = all(each.experiment.is_static for each in solution.collocation.transcriptions)
    return (f"{NO_CAUSE} ({TESTED[is_static]})",)
