"""Why a fit misses its data: what is tried, refitted, and fits far better is the likely cause.

Doubts about the description (`modal`) come for little. The others are changes of one experiment,
the one that fits worst: it is fitted again without each mistake, and the factor by which its misfit
falls is the cause's strength. Of gravity's directions the body's modes choose the one that is
tried.

Measured wrenches have causes of their own, see `wrench_causes`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ..arrays import Array, root_mean
from ..errors import InputError, SimulationError
from ..methods.continuation import first_samples
from ..methods.reduced_space import ReducedSpace
from ..methods.solution import Solution, Status
from ..program.any_stiffness import Described
from ..recording.experiment import Experiment
from ..recording.grasp import Grasp
from ..recording.poses import PoseSequence
from .hypothesis import Hypothesis, Trial, clock, ranked
from .modal import ModalComparison, doubts, gravity_mistakes
from .plausible import against_the_load
from .wrench_causes import wrench_causes

# Residuals up to so many standard deviations are noise: they need no cause.
NOISE = 1.15
# A refit is far better if its misfit is smaller by this factor, or if it leaves noise only.
BETTER = 1.5
# A marker slips if two means, before and after, explain its residuals so much better than one.
SLIP = 2.0
MOST_SAMPLES, CLOCK_REFITS = 100, 4
# A refit may take as many sweeps as the fit took iterations, within these, and all refits together
# so many times the work of the fit; its last step of a parameter's logarithm may be so long.
FEWEST_SWEEPS, MOST_SWEEPS, EFFORT = 15, 40, 3
BUDGET, TOLERANCE = 150, 1e-2
# A cause without which the misfit falls so much is certain: no other is looked for.
CERTAIN = 4.0
SAME_LAG_S = 5e-4
# Samples before and after a slip at least.
SHORTEST = 4


def likely_causes(solution: Solution, budget: int | None = None) -> tuple[Hypothesis, ...]:
    """What is likely described wrongly, likeliest first; empty where the residuals are noise.

    Parameters
    ----------
    solution : Solution
    budget : int, optional
        Sweeps over the recording's first samples that all refits together may take; by default
        three times the work of the fit, 150 at most.

    Returns
    -------
    tuple of Hypothesis
        Their `strength` is the factor by which the misfit falls without the mistake.
    """
    fitted = [segment.experiment for segment in solution.collocation.segments]
    misfits = [_misfit(e, read) for e, read in zip(fitted, solution.readings_m, strict=True)]
    found = [*wrench_causes(solution), *(cause for e in fitted for cause in against_the_load(e))]
    if max(misfits) > NOISE:
        worst = fitted[int(np.argmax(misfits))]
        found += doubts(worst, solution.parameters, solution.collocation.huber)
        if max((each.strength for each in found), default=0.0) < CERTAIN:
            found += _refitted(solution, worst, budget)
    return ranked(found)


def _refitted(solution: Solution, experiment: Experiment, budget: int | None) -> list[Hypothesis]:
    """What the experiment fits far better without."""
    given = first_samples(experiment, MOST_SAMPLES)
    alone = _Alone(solution, given, budget)
    read = alone.fit(given)
    if read is None:
        return []
    trial = Trial(_misfit(given, read), alone.left, BETTER, least=1.0, noise=NOISE)
    of = f"'{experiment.name}'"
    lags = [] if given.static else _best_lag(alone, given, read, of)
    comparison = ModalComparison.of(given, solution.parameters)
    turned = [] if comparison is None else _other_gravity(given, comparison)
    return [*trial.of([*lags, *_slip(given, read, of), *turned, *_other_layers(given, of)])]


def _other_gravity(given: Experiment, comparison: ModalComparison) -> Iterator[Hypothesis]:
    """Of gravity's directions the one that suits the body's modes best."""
    others = gravity_mistakes(comparison.given)
    nearest = min(others, key=lambda each: comparison.misfit_m(each.without), default=None)
    if nearest is not None:
        gravity_m_s2 = nearest.without.gravity_m_s2
        yield replace(nearest, without=replace(given, gravity_m_s2=gravity_m_s2))


def _other_layers(given: Experiment, of: str) -> Iterator[Hypothesis]:
    for deeper, deep in ((True, "deeper"), (False, "less deep")):
        if (layered := _one_layer(given, deeper)) is not None:
            yield Hypothesis("grasp-layer", of, {"deep": deep}, layered)


def _slip(given: Experiment, read: Array, of: str) -> Iterator[Hypothesis]:
    """The experiment without the marker whose residuals step most, if one does."""
    residual = _residual(given, read)
    described = Described.of(given)
    if described is not None:
        residual = np.einsum("tji,tmj->tmi", described.rotations, residual[: len(described.t_s)])
    clearest = [_step(residual[:, m]) for m in range(residual.shape[1])]
    m = int(np.argmax([ratio for ratio, _ in clearest]))
    if clearest[m][0] < SLIP or residual.shape[1] < 2:
        return
    tracks = np.array(given.markers.positions_m)
    tracks[:, m] = np.nan
    data = {"marker": given.markers.names[m], "t_s": given.t_s[clearest[m][1]]}
    without = replace(given, markers=replace(given.markers, positions_m=tracks))
    yield Hypothesis("marker-slip", of, data, without)


def _step(residual: Array) -> tuple[float, int]:
    """How much better two means explain residuals (T, 3) than one, and from which sample on."""
    there = np.flatnonzero(np.isfinite(residual[:, 0]))
    if len(there) < 2 * SHORTEST:
        return 1.0, 0
    x = residual[there]
    total, count = np.cumsum(x, axis=0)[:-1], np.arange(1, len(x))[:, None]
    before, after = total / count, (x.sum(axis=0) - total) / (len(x) - count)
    gain = np.sum(count * before**2 + (len(x) - count) * after**2, axis=1)
    k = SHORTEST - 1 + int(np.argmax(gain[SHORTEST - 1 : len(x) - SHORTEST]))
    one, two = np.sum((x - x.mean(axis=0)) ** 2), np.sum(x**2) - gain[k]
    return float(np.sqrt(one / max(two, 1e-30))), int(there[k + 1])


class _Alone:
    """Fits of one experiment at a time, from the problem's guess, as long as sweeps are left.

    What the fit itself took bounds them: a mistake undone is no harder to fit than made.
    """

    def __init__(self, solution: Solution, given: Experiment, sweeps: int | None) -> None:
        self.collocation = solution.collocation
        fitted = [segment.experiment for segment in self.collocation.segments]
        rows = sum(len(experiment.t_s) for experiment in fitted)
        self.each = min(MOST_SWEEPS, max(FEWEST_SWEEPS, solution.iterations))
        work = EFFORT * self.each * rows // len(given.t_s)
        self.sweeps = min(BUDGET, work) if sweeps is None else sweeps
        self.known: dict[Experiment, Array | None] = {}
        if len(fitted) == 1 and len(given.t_s) == rows:
            self.known[given] = solution.readings_m[0]

    def fit(self, experiment: Experiment) -> Array | None:
        """Fitted markers (T, M, 3); None where there is no fit."""
        if experiment not in self.known:
            self.known[experiment] = self._fit(experiment)
        return self.known[experiment]

    def left(self, experiment: Experiment) -> float | None:
        """Misfit of the fit; None where there is none."""
        read = self.fit(experiment)
        return None if read is None else _misfit(experiment, read)

    def _fit(self, experiment: Experiment) -> Array | None:
        if self.sweeps <= 0:
            return None
        method = ReducedSpace(max_iterations=min(self.each, self.sweeps), tolerance=TOLERANCE)
        try:
            found = method(replace(self.collocation, experiments=(experiment,)))
        except (InputError, SimulationError):
            return None
        self.sweeps -= found.iterations
        found.unless_interrupted()
        ended = found.status.converged or found.status is Status.ITERATION_LIMIT
        return found.readings_m[0] if ended else None


def _best_lag(alone: _Alone, given: Experiment, read: Array, of: str) -> Iterator[Hypothesis]:
    """The lag by which residuals and velocities agree, refitted a few times."""
    least, lag_s, shifted = _misfit(given, read), 0.0, given
    best = None
    for _ in range(CLOCK_REFITS):
        more_s = _lag_s(shifted, read)
        lag_s += more_s
        if abs(more_s) < SAME_LAG_S:
            break
        later = with_lag(given, lag_s)
        fitted = None if later is None else alone.fit(later)
        if later is None or fitted is None:
            break
        shifted, read = later, fitted
        if (now := _misfit(shifted, read)) < least:
            best, least = clock(of, lag_s, shifted), now
    if best is not None:
        yield best


def with_lag(experiment: Experiment, lag_s: float) -> Experiment | None:
    """The experiment with its poses `lag_s` later; None if too little is left of it."""
    t_s = experiment.t_s
    kept = t_s <= t_s[-1] + min(lag_s, 0.0) + 1e-9
    if kept.sum() < 3:
        return None
    markers = experiment.markers
    try:
        return replace(
            experiment,
            t_s=t_s[kept],
            grasps=[replace(g, poses=_later(g, t_s, lag_s)) for g in experiment.grasps],
            markers=replace(markers, t_s=t_s[kept], positions_m=markers.positions_m[kept]),
        )
    except InputError:
        return None


def _later(grasp: Grasp, t_s: Array, lag_s: float) -> PoseSequence:
    poses = grasp.poses
    if len(poses.t_s) < 2:
        return poses
    times, first = poses.t_s + lag_s, slice(0, 1)
    if lag_s <= 0:
        return replace(poses, t_s=times)
    # Before its first pose the grasp rests there.
    return replace(
        poses,
        t_s=np.r_[min(t_s[0], poses.t_s[0]), times],
        positions_m=np.concatenate([poses.positions_m[first], poses.positions_m]),
        quaternions_xyzw=np.concatenate([poses.quaternions_xyzw[first], poses.quaternions_xyzw]),
    )


def _lag_s(experiment: Experiment, read: Array) -> float:
    """By how much the markers lag behind the fit: Σ r·v / Σ v·v of residuals and velocities."""
    v = np.gradient(read, experiment.timestep_s, axis=0)
    residual = np.where(
        np.isfinite(experiment.markers.positions_m), _residual(experiment, read), 0.0
    )
    moving = np.where(experiment.markers.present[..., None], v, 0.0)
    return float(np.sum(residual * moving) / max(np.sum(moving**2), 1e-300))


def _one_layer(experiment: Experiment, deeper: bool) -> Experiment | None:
    """With every grasp one layer of elements deeper or less deep; None where that is none."""
    cells, n = experiment.body.cells, len(experiment.body.nodes_m)
    grasps = []
    for grasp in experiment.grasps:
        held = np.isin(np.arange(n), grasp.nodes)
        # The layer that touches what is held, or of what is held that which touches the rest.
        touched = held if deeper else ~held
        grown = np.zeros(n, dtype=bool)
        grown[cells[touched[cells].any(axis=1)]] = True
        nodes = np.flatnonzero(grown if deeper else held & ~grown)
        if len(nodes) < 3 or len(nodes) > n - 1:
            return None
        grasps.append(replace(grasp, nodes=nodes))
    try:
        return replace(experiment, grasps=grasps)
    except InputError:
        return None


def _residual(experiment: Experiment, read: Array) -> Array:
    return np.where(
        experiment.markers.present[..., None], read - experiment.markers.positions_m, np.nan
    )


def _misfit(experiment: Experiment, read: Array) -> float:
    """Root mean square of the residuals in standard deviations."""
    scaled = _residual(experiment, read) / experiment.markers.sigma_m[:, None]
    return root_mean(scaled[experiment.markers.present] ** 2)
