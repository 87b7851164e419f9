"""Misspecification hypotheses tested before any solve, by natural modes for many stiffnesses.

The markers of bodies of many stiffnesses (`program.modes.modal_prediction`) are compared with the
measured tracks, for the description as stated and with each common mistake corrected. A correction
that fits far better is reported.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy
from scipy.sparse.linalg import ArpackError
from scipy.spatial.transform import Rotation

from ..common.array_types import Array, Index
from ..errors import SimulationError
from ..program.modes.modal_prediction import DeclaredMotion, ModalResponse, delayed_tracks
from ..recording.experiment import Experiment
from ..recording.placement import LocatedBody, place_markers
from ..statistics.axes import with_other_axes
from ..statistics.hypothesis import Hypothesis, rank
from ..statistics.thresholds import FITTED, ONE_OF_MANY
from .contradictions import load_sign_hypotheses
from .doubt import Doubt, accepted, clock_data, exchanged_names

# Accuracy of small strains and a few modes, over the size of the body.
ROUGHLY = 0.005
# Extent of tracks over the size of the body, below which they are those of a point.
SMALLEST_EXTENT = 1e-6
# Share of the samples that are used, the best ones; others may be exchanged labels or reflections.
USED = 0.9
# Clock lags that are tried [s].
LAGS_S = np.concatenate([-np.arange(15, 0, -1), np.arange(1, 16)]) * 0.01
# Longest lag over the length of the recording.
LONGEST_LAG = 0.3
# Alternations between the best stiffness and the best rigid motion.
REFITS = 3
# Deformation of an equilibrium over the body's diagonal that needs no explanation.
DEFORMED = 0.1
# Hypotheses that fit better if the poses are in another frame than the markers.
FRAME_CAUSES = (
    "camera-frame",
    "gripper-frame",
    "gravity",
    "length-unit",
    "markers-axes",
    "poses-inverted",
    "quaternion-order",
)


def find_misspecifications_by_modes(
    experiment: Experiment, constants: Mapping[str, float]
) -> tuple[Hypothesis, ...]:
    """Return hypotheses about a recording's description, likeliest first; mostly empty.

    Parameters
    ----------
    constants : mapping of str to float
        Constants of the body; only ratios of stiffness within it matter.

    Notes
    -----
    Without markers, and of rods, only signs of loads are tested; in a static experiment, or where modes
    are of no use (`ModalComparison.from_experiment`), no modes are used.
    """
    if not (experiment.markers.names and experiment.body.is_solid):
        return rank(load_sign_hypotheses(experiment))
    if experiment.is_static:
        return rank([*load_sign_hypotheses(experiment), *_rigid_axes(experiment)])
    comparison = ModalComparison.from_experiment(experiment, constants)
    tried = _rigid_axes(experiment) if comparison is None else comparison.hypotheses()
    return rank(_with_stated_frames(experiment, [*tried]))


def _with_stated_frames(experiment: Experiment, hypotheses: list[Hypothesis]) -> list[Hypothesis]:
    """Return the hypotheses with those that another frame causes (`FRAME_CAUSES`) replaced by the
    contradiction of the frames that the files state, with the largest strength; the hypotheses
    unchanged if none is of these, or files do not contradict each other.
    """
    strengths = [each.strength for each in hypotheses if each.code in FRAME_CAUSES]
    if not experiment.frames_fault or not strengths:
        return hypotheses
    stated = Hypothesis(
        "frames",
        f"'{experiment.name}'",
        data={"fault": experiment.frames_fault},
        strength=max(strengths),
    )
    others = [each for each in hypotheses if each.code not in FRAME_CAUSES]
    return [stated, *others]


def _rigid_axes(experiment: Experiment) -> Iterator[Hypothesis]:
    """Yield axes of the tracks that bring them far nearer to the rigidly moved body."""
    markers = experiment.markers
    body = experiment.body
    places_m = markers.predict_positions(experiment.rigid_positions(experiment.t_s))
    size_m = float(np.linalg.norm(np.ptp(body.mesh.bounds_m, axis=0)))

    def remaining_misfit(tracks_m: Array) -> float:
        """Return the median distance [m] from the rigid positions, with a floor."""
        distances_m = np.linalg.norm(tracks_m - places_m, axis=2)
        return float(np.hypot(np.nanmedian(distances_m), DEFORMED * size_m))

    tracks_m = markers.positions_at_samples_m if markers.sample_count else np.empty((0, 0, 3))
    if np.isfinite(tracks_m).all(axis=2).any():  # not where one coordinate was never measured
        rows = _axes(f"'{experiment.name}'", tracks_m)
        yield from accepted(rows, tracks_m, remaining_misfit)


def _axes(name: str, tracks_m: Array) -> Iterator[Doubt]:
    """Yield the rows of tracks with their axes in another order and of either sign."""
    for axes, turned in with_other_axes(tracks_m):
        yield Doubt.whole("markers-axes", turned, name, handicap=ONE_OF_MANY, axes=axes)


@dataclass(frozen=True, eq=False)
class ModalComparison:
    """Comparison of descriptions of one experiment with its tracks."""

    experiment: Experiment  # the recording
    declared: DeclaredMotion  # description as stated
    response: ModalResponse  # natural modes at the markers
    floor_m: float  # smallest misfit that can be expected [m]

    @classmethod
    def from_experiment(
        cls, experiment: Experiment, constants: Mapping[str, float]
    ) -> ModalComparison | None:
        """Build the comparison for an experiment, see `hypotheses`.

        Returns
        -------
        ModalComparison or None
            None if the body has no modes, no single grasp carries it, there are fewer than three
            samples of markers, tendons or pressures drive it, or it is a rod, whose deflections are far
            from linear.
        """
        is_left_out = experiment.actuators or not experiment.body.is_solid
        declared = None if is_left_out else DeclaredMotion.from_experiment(experiment)
        if declared is None or np.isfinite(declared.tracks_m[..., 0]).sum() < 3:
            return None
        try:
            response = ModalResponse.from_experiment(experiment, constants)
        except (SimulationError, np.linalg.LinAlgError, ArpackError):
            return None
        noise_m = np.sqrt(3) * np.median(experiment.markers.sigma_m)
        return cls(
            experiment,
            declared,
            response=response,
            floor_m=float(np.hypot(noise_m, ROUGHLY * response.size_m)),
        )

    def misfit_m(self, declared: DeclaredMotion) -> float:
        """Return the misfit of a description with the stiffness and damping that fit best [m], at
        least `floor_m`.
        """
        return self._misfit_with(self.response, declared)

    def misfit_at_implied_places(self, declared: DeclaredMotion) -> float:
        """Return the misfit of a description over the extent of its tracks, with the markers at the
        places on the body that this description implies: tracks that shrink fit nothing better.

        A marker without a stated place is attached where its first sample is on the body as the
        grasp carries it; poses with a mistake attach it to a wrong place, and correct poses alone
        would not fit there.
        """
        misfit_m = self._misfit_with(self._response_at_implied_places(declared), declared)
        extent_m = float(np.sqrt(np.nanvar(declared.tracks_m, axis=(0, 1)).sum()))
        return misfit_m / max(extent_m, SMALLEST_EXTENT * self.response.size_m)

    def _misfit_with(self, response: ModalResponse, declared: DeclaredMotion) -> float:
        return float(self._misfits_m(declared, response.predict(declared)).min())

    def _response_at_implied_places(self, declared: DeclaredMotion) -> ModalResponse:
        """Return the response with the markers without a stated place attached to the point of the
        body that is nearest to their first sample in the frame of the grasp.

        The response is unchanged if all places are stated.
        """
        markers = self.experiment.markers
        if declared is self.declared or markers.located.all():
            return self.response
        body = self.experiment.body
        in_grasp_m = declared.to_grasp_frame(declared.tracks_m)
        first_rows = np.isfinite(in_grasp_m[..., 0]).argmax(axis=0)
        first_m = in_grasp_m[first_rows, np.arange(len(first_rows))]
        first_m[markers.located] = np.nan
        implied_m = self._located_body.places_of_points(first_m)
        places_m = np.where(np.isnan(implied_m), self.response.places_m, implied_m)
        placement = place_markers(
            places_m, body.nodes.points_m, body=body, attach=markers.attach, max_distance_m=np.inf
        )
        return self.response.with_markers(replace(markers, placement=placement), body)

    @cached_property
    def _located_body(self) -> LocatedBody:
        return LocatedBody(self.experiment.body.nodes_m, self.experiment.body)

    def best_prediction(self, declared: DeclaredMotion) -> Array:
        """Return the markers (T, M, 3) [m] as predicted from a description with the stiffness and
        damping that fit best.
        """
        predicted = self.response.predict(declared)
        return predicted[int(self._misfits_m(declared, predicted).argmin())]

    def hypotheses(self) -> Iterator[Hypothesis]:
        """Yield the hypotheses that fit far better than the description as stated, with their
        strength.
        """
        declared = self.declared
        at_places = self.misfit_at_implied_places
        yield from accepted(simple_rows(declared), declared, at_places)
        fitted = [*self._frame_rows(), *self._clock_rows()]
        yield from accepted(fitted, declared, self.misfit_m)
        yield from self._name_hypotheses()
        yield from self._other_axes()

    def _other_axes(self) -> Iterator[Hypothesis]:
        tracks_m = self.declared.tracks_m

        def remaining_misfit(turned_m: Array) -> float:
            is_stated = turned_m is tracks_m
            turned = self.declared if is_stated else replace(self.declared, tracks_m=turned_m)
            return self.misfit_at_implied_places(turned)

        yield from accepted(_axes(f"'{self.declared.name}'", tracks_m), tracks_m, remaining_misfit)

    def _misfits_m(self, declared: DeclaredMotion, predicted: Array) -> Array:
        """Return the misfit (S,) [m] of each prediction (S, T, M, 3): the root of the mean squared
        distance of the nearest 90 % of the samples plus the squared floor; samples that are NaN
        in either are ignored.
        """
        present = np.isfinite(declared.tracks_m[..., 0]) & np.isfinite(predicted[0, ..., 0])
        distance = np.linalg.norm(predicted - declared.tracks_m, axis=3)[:, present]
        squares = np.sort(distance**2, axis=1)
        used = max(1, int(np.ceil(USED * squares.shape[1])))
        return np.sqrt(squares[:, :used].mean(axis=1) + self.floor_m**2)

    def _frame_rows(self) -> Iterator[Doubt]:
        """Yield the rows of fitted rigid motions before the poses and of the tracks."""
        declared = self.declared
        places_m = self.response.places_m
        if not _determines_rotation(places_m):
            return
        moved_poses = moved_tracks = declared
        for k in range(REFITS):
            best = (
                moved_poses.to_grasp_frame(self.best_prediction(moved_poses))
                if k
                else np.broadcast_to(places_m, declared.tracks_m.shape)
            )
            moved_poses = moved_poses.with_prior_motion(
                *_fit_rigid_motion(best, moved_poses.to_grasp_frame(moved_poses.tracks_m))
            )
            turn, shift_m = _fit_rigid_motion(
                moved_tracks.tracks_m, self.best_prediction(moved_tracks)
            )
            moved_tracks = replace(moved_tracks, tracks_m=moved_tracks.tracks_m @ turn.T + shift_m)
        yield Doubt.whole("gripper-frame", moved_poses, handicap=FITTED)
        yield Doubt.whole("camera-frame", moved_tracks, handicap=FITTED)

    def _clock_rows(self) -> Iterator[Doubt]:
        """Yield the row of that of the `LAGS_S` that fits best."""
        declared = self.declared
        predicted = self.response.predict(declared)
        allowed = LAGS_S[np.abs(LAGS_S) < LONGEST_LAG * np.ptp(declared.t_s)].tolist()
        delayed = (delayed_tracks(predicted, declared.t_s, lag_s=lag_s) for lag_s in allowed)
        misfits = [self._misfits_m(declared, each).min() for each in delayed]
        if misfits:
            lag_s = allowed[int(np.argmin(misfits))]
            without = replace(declared, lag_s=lag_s)
            yield Doubt.whole("clock", without, handicap=FITTED, **clock_data(lag_s))

    def _name_hypotheses(self) -> Iterator[Hypothesis]:
        declared = self.declared
        names = self.experiment.markers.names
        squares = np.sum(
            (declared.tracks_m[:, :, None] - self.best_prediction(declared)[:, None]) ** 2, axis=3
        )
        is_complete = np.isfinite(squares).any(axis=0).all()
        if not is_complete or len(names) < 2:
            return
        _, chosen = scipy.optimize.linear_sum_assignment(np.nanmean(squares, axis=0))
        exchanged = np.flatnonzero(chosen != np.arange(len(chosen)))
        if not len(exchanged):
            return
        few, renamed = (
            _with_markers(declared, declared.tracks_m[:, order], markers=exchanged)
            for order in (np.arange(len(chosen)), np.argsort(chosen))
        )
        shown = exchanged_names(names, chosen)
        row = Doubt.whole("markers-exchanged", renamed, names=shown)
        yield from accepted([row], few, self.misfit_m)


def _with_markers(declared: DeclaredMotion, tracks_m: Array, markers: Index) -> DeclaredMotion:
    """Return a description in which only some markers (indices) have tracks, `tracks_m`."""
    few_m = np.full_like(tracks_m, np.nan)
    few_m[:, markers] = tracks_m[:, markers]
    return replace(declared, tracks_m=few_m)


def _fit_rigid_motion(from_m: Array, to_m: Array) -> tuple[Array, Array]:
    """Return R (3, 3) and t (3,) from points (T, M, 3) to others by least squares."""
    both = np.isfinite(from_m[..., 0]) & np.isfinite(to_m[..., 0])
    a = from_m[both]
    b = to_m[both]
    rotation = Rotation.align_vectors(b - b.mean(axis=0), a - a.mean(axis=0))[0].as_matrix()
    return rotation, b.mean(axis=0) - rotation @ a.mean(axis=0)


def _determines_rotation(places_m: Array) -> bool:
    """Whether three or more places (M, 3) are not nearly collinear."""
    if len(places_m) < 3:
        return False
    extents = np.linalg.svd(places_m - places_m.mean(axis=0), compute_uv=False)
    return bool(extents[1] > 0.1 * extents[0])


# Factors of lengths in a wrong unit, with the unit to state; empty where none is certain.
UNITS = {1e-3: "mm", 1e-2: "cm", 0.0254: "in", 1e3: "", 1e2: ""}
# Cosine of some 20 degrees, above which a direction is not another axis.
SAME_DIRECTION = 0.94


def simple_rows(declared: DeclaredMotion) -> Iterator[Doubt]:
    """Yield the rows without fitted numbers: poses (unless all are the identity), units of length and
    the direction of gravity.
    """
    moving = (
        np.ptp(declared.rotations, axis=0).any() or np.ptp(declared.translations_m, axis=0).any()
    )
    if moving or np.abs(declared.translations_m).any():
        yield from _pose_rows(declared)
        yield from _unit_rows(
            declared, "translations_m", who="the poses would fit if they", section="grasp"
        )
    yield from _unit_rows(
        declared, "tracks_m", who="the markers would fit if they", section="markers"
    )
    yield from _unit_rows(declared, "mesh_scale", who="the mesh would fit if it", section="object")
    for other_m_s2, data in other_gravity(declared.gravity_m_s2):
        yield Doubt.whole("gravity", replace(declared, gravity_m_s2=other_m_s2), **data)


def _pose_rows(declared: DeclaredMotion) -> Iterator[Doubt]:
    poses = declared.without_first_motion()
    inverse = poses.rotations.transpose(0, 2, 1)
    shift = -np.einsum("tij,tj->ti", inverse, poses.translations_m)
    inverted = replace(poses, rotations=inverse, translations_m=shift)
    yield Doubt.whole("poses-inverted", inverted.with_first_motion())
    quaternions = Rotation.from_matrix(poses.rotations).as_quat()
    # Signs are free; neighbours of one sign keep the reordered ones continuous.
    flips = np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0
    quaternions *= np.cumprod(np.r_[1.0, np.where(flips, -1.0, 1.0)])[:, None]
    for order, turn in (("wxyz", -1), ("xyzw", 1)):
        reordered = Rotation.from_quat(np.roll(quaternions, turn, axis=1)).as_matrix()
        without = replace(poses, rotations=reordered).with_first_motion()
        columns = ", ".join(f"q{axis}" for axis in order)
        yield Doubt.whole("quaternion-order", without, order=order, columns=columns)


def _unit_rows(declared: DeclaredMotion, what: str, who: str, section: str) -> Iterator[Doubt]:
    key = f"{section}.length_unit"
    for factor, unit in UNITS.items():
        remedy = f'set {key} = "{unit}"' if unit else f"check {key}"
        without = replace(declared, **{what: factor * getattr(declared, what)})
        yield Doubt.whole("length-unit", without, who=who, factor=factor, remedy=remedy)


def other_gravity(stated_m_s2: Array) -> Iterator[tuple[Array, dict[str, Any]]]:
    """Yield gravity along the axes, with either sign, and data of its message, except within some 20
    degrees of the stated direction; nothing without gravity.
    """
    size = float(np.linalg.norm(stated_m_s2))
    for axis, name in enumerate("xyz"):
        for sign, plus in ((1.0, "+"), (-1.0, "−")):
            other: Array = np.where(np.arange(3) == axis, sign * size, 0.0)
            if size and other @ stated_m_s2 <= SAME_DIRECTION * size**2:
                yield other, {"axis": plus + name, "vector": ", ".join(f"{x:g}" for x in other)}
