"""Does the description of a recording fit its tracks? Told before solving, for any stiffness.

The markers of bodies of many stiffnesses (`nlp.any_stiffness`) are compared with the tracks: for
the description as given, and without each of the mistakes that people make. What fits far better
is named.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse.linalg import ArpackError
from scipy.spatial.transform import Rotation

from ..arrays import Array, Index
from ..errors import SimulationError
from ..experiment.experiment import Experiment
from ..nlp.any_stiffness import Described, Sway
from .cause import Cause, ranked
from .exchanges import exchanges
from .mistakes import mistakes
from .steps import steps
from .work import against_the_load

# The misfit falls by this factor at least before a cause is named.
FAR_BETTER = 2.0
# What has numbers to fit has to fit better still than what has none.
FITTED = 1.5
# Small strains and a few modes predict no better than to this part of the body's size.
ROUGHLY = 0.005
# Samples beyond this share may be anything: exchanged labels, reflections.
USED = 0.9
LAGS_S = np.concatenate([-np.arange(15, 0, -1), np.arange(1, 16)]) * 0.01
# Of the recording: a lag leaves most of it.
LONGEST_LAG = 0.3
REFITS = 3


@dataclass(frozen=True, eq=False)
class Doubt:
    """Something tried in place of what is given, and the misfit it leaves."""

    cause: str
    said: str
    misfit_m: float
    handicap: float = 1.0


def doubts(
    experiment: Experiment, constants: Mapping[str, float], huber: float | None = None
) -> tuple[Cause, ...]:
    """What is likely wrong with a recording's description, likeliest first; mostly nothing.

    Parameters
    ----------
    experiment : Experiment
    constants : mapping of name to value
        Of the body, any that keep the ratios of stiffness within it.
    huber : float, optional
        Of the loss, where it is Huber's.
    """
    if experiment.static or not experiment.markers.names:
        return ranked(against_the_load(experiment))
    sudden = (*exchanges(experiment, huber), *steps(experiment))
    comparison = Comparison.of(experiment, constants)
    if comparison is None:
        return sudden
    base = comparison.misfit_m(comparison.given)
    found = []
    for doubt in comparison.doubts():
        strength = base / doubt.misfit_m / doubt.handicap
        if strength > FAR_BETTER:
            sentence = f"'{experiment.name}': {doubt.said} ({strength:.2g} times nearer)"
            found.append(Cause(doubt.cause, sentence, strength))
    return ranked([*found, *sudden])


class Comparison:
    """Descriptions of one experiment against its tracks."""

    def __init__(self, experiment: Experiment, given: Described, sway: Sway) -> None:
        self.given = given
        self.names = experiment.markers.names
        self.sway = sway
        sigma_m = float(np.median(experiment.markers.sigma_m))
        self.floor_m = float(np.hypot(np.sqrt(3) * sigma_m, ROUGHLY * sway.size_m))

    @classmethod
    def of(cls, experiment: Experiment, constants: Mapping[str, float]) -> Comparison | None:
        """That of an experiment, see `doubts`; None where the body has no modes to tell by.

        Nor where tendons or pressures drive it, which is beyond a sway under gravity.
        """
        given = None if experiment.actuators else Described.of(experiment)
        if given is None or np.isfinite(given.tracks_m[..., 0]).sum() < 3:
            return None
        try:
            return cls(experiment, given, Sway.of(experiment, constants))
        except (SimulationError, np.linalg.LinAlgError, ArpackError):
            return None

    def misfit_m(self, described: Described) -> float:
        """Misfit of the stiffness that suits best."""
        return float(self._misfits_m(described, self.sway.predicted(described)).min())

    def best(self, described: Described) -> Array:
        """(T, M, 3) markers for the stiffness that suits best."""
        predicted = self.sway.predicted(described)
        return predicted[int(self._misfits_m(described, predicted).argmin())]

    def doubts(self) -> Iterator[Doubt]:
        """All that is tried in place of what is given."""
        given = self.given
        for mistake in mistakes(given):
            yield Doubt(mistake.cause, mistake.said, self.misfit_m(mistake.without))
        yield from self._other_frames(given)
        yield from self._other_clock(given)
        yield from self._other_names(given)

    def _misfits_m(self, described: Described, predicted: Array) -> Array:
        """(S,) root mean square distance of most samples, and what is to be expected at least."""
        present = np.isfinite(described.tracks_m[..., 0]) & np.isfinite(predicted[0, ..., 0])
        distance = np.linalg.norm(predicted - described.tracks_m, axis=3)[:, present]
        squares = np.sort(distance**2, axis=1)
        used = max(1, int(np.ceil(USED * squares.shape[1])))
        return np.sqrt(squares[:, :used].mean(axis=1) + self.floor_m**2)

    def _other_frames(self, given: Described) -> Iterator[Doubt]:
        if not _fixes_rotation(self.sway.places_m):
            return
        yield Doubt(
            "gripper-frame",
            "the markers move with the poses, but the body is elsewhere in them: the poses are of "
            "the gripper's own frame, or the mesh is in another one; multiply every pose on the "
            "right by the transform from the mesh's frame to the gripper's, or fit the poses by "
            "grasp.markers",
            self._without_own_frame(given),
            FITTED,
        )
        yield Doubt(
            "camera-frame",
            "the markers fit if all are moved rigidly: cameras and robot have different frames; "
            "set markers.template_m and template_window_s",
            self._without_camera_frame(given),
            FITTED,
        )

    def _without_own_frame(self, given: Described) -> float:
        """Misfit with the rigid motion before the poses that suits best."""
        fitted = given
        places = np.broadcast_to(self.sway.places_m, given.tracks_m.shape)
        for k in range(REFITS):
            wanted = fitted.pulled_back(fitted.tracks_m)
            from_m = fitted.pulled_back(self.best(fitted)) if k else places
            fitted = fitted.after(*_rigid(from_m, wanted))
        return self.misfit_m(fitted)

    def _without_camera_frame(self, given: Described) -> float:
        """Misfit with the tracks moved rigidly so that they suit best."""
        fitted = given
        for _ in range(REFITS):
            turn, shift_m = _rigid(fitted.tracks_m, self.best(fitted))
            fitted = replace(fitted, tracks_m=fitted.tracks_m @ turn.T + shift_m)
        return self.misfit_m(fitted)

    def _other_clock(self, given: Described) -> Iterator[Doubt]:
        predicted = self.sway.predicted(given)
        allowed = LAGS_S[np.abs(LAGS_S) < LONGEST_LAG * np.ptp(given.t_s)]
        misfits = [
            self._misfits_m(given, _shifted(predicted, given.t_s, lag)).min() for lag in allowed
        ]
        if not misfits:
            return
        lag_ms = 1e3 * float(allowed[int(np.argmin(misfits))])
        yield Doubt(
            "clock",
            f"the markers' clock is {'late' if lag_ms > 0 else 'early'} by about "
            f"{abs(lag_ms):.0f} ms against the poses': {'add' if lag_ms > 0 else 'subtract'} that "
            "to t_s of the poses, or estimate it with nuisance.time_shift",
            float(min(misfits)),
            FITTED,
        )

    def _other_names(self, given: Described) -> Iterator[Doubt]:
        """Markers that have each other's name."""
        predicted = self.best(given)
        squares = np.sum((given.tracks_m[:, :, None] - predicted[:, None]) ** 2, axis=3)
        there = np.isfinite(squares).any(axis=0).all()
        if not there or len(self.names) < 2:
            return
        cost = np.nanmean(squares, axis=0)
        _, chosen = linear_sum_assignment(cost)
        moved = np.flatnonzero(chosen != np.arange(len(chosen)))
        if not len(moved):
            return
        renamed = replace(given, tracks_m=given.tracks_m[:, np.argsort(chosen)])
        listed = ", ".join(f"{self.names[k]} is {self.names[chosen[k]]}" for k in moved)
        yield Doubt(
            "markers-exchanged",
            f"markers have each other's names: {listed}; correct markers.labels or reference_m",
            self._misfit_among(renamed, moved, given),
        )

    def _misfit_among(self, renamed: Described, moved: Index, given: Described) -> float:
        """What is left of the whole misfit, as if all markers were as much better as those."""

        def misfit(described: Described) -> float:
            few = replace(described, tracks_m=np.full_like(described.tracks_m, np.nan))
            few.tracks_m[:, moved] = described.tracks_m[:, moved]
            return self.misfit_m(few)

        return self.misfit_m(given) * misfit(renamed) / misfit(given)


def _shifted(predicted: Array, t_s: Array, lag_s: float) -> Array:
    """Predictions (S, T, M, 3) seen `lag_s` later, NaN where they end."""
    step_s = t_s[1] - t_s[0]
    at = np.arange(len(t_s)) - lag_s / step_s
    low = np.clip(np.floor(at).astype(int), 0, len(t_s) - 2)
    share = (at - low)[:, None, None]
    seen = (1 - share) * predicted[:, low] + share * predicted[:, low + 1]
    seen[:, (at < 0) | (at > len(t_s) - 1)] = np.nan
    return seen


def _rigid(from_m: Array, to_m: Array) -> tuple[Array, Array]:
    """Rotation (3, 3) and translation (3,) that bring points to others, both (T, M, 3)."""
    both = np.isfinite(from_m[..., 0]) & np.isfinite(to_m[..., 0])
    a, b = from_m[both], to_m[both]
    rotation = Rotation.align_vectors(b - b.mean(axis=0), a - a.mean(axis=0))[0].as_matrix()
    return rotation, b.mean(axis=0) - rotation @ a.mean(axis=0)


def _fixes_rotation(places_m: Array) -> bool:
    if len(places_m) < 3:
        return False
    extents = np.linalg.svd(places_m - places_m.mean(axis=0), compute_uv=False)
    return bool(extents[1] > 0.1 * extents[0])
