"""Transcription of one experiment with its measurements at one association.

A `Transcription` is a `MotionTranscription` with the measurement models, which depend on the
association of the measurements with the body. `Collocation` concatenates the transcriptions of all
experiments; use a `Transcription` where one experiment is treated alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from typing import Any, TypeVar

import numpy as np

from ..common.array_types import Array, Index
from ..fem.pattern import unique_codes
from ..model.equations_at_parameters import EquationsAtParameters
from ..recording.nuisance import TIME
from .association import Association
from .correspondences import CorrespondenceResidual
from .markers.residual import MarkerModel, MarkerResidual
from .measurement_model import CorrespondenceModel
from .measurement_residual import MeasurementResidual
from .motion_transcription import MotionTranscription, RowWeights, WeightedHistory
from .observables import PointPositions, SparseEntries

R = TypeVar("R", bound=MeasurementResidual)


@dataclass(frozen=True, eq=False)
class Transcription(MotionTranscription):
    """Variables, constraints and measurements of one experiment.

    Attributes
    ----------
    association : Association
        Elements, clock samples and correspondences at which the measurements are evaluated.
    """

    association: Association

    @cached_property
    def _residuals_by_measurement(self) -> list[Sequence[MeasurementResidual]]:
        correspondences = iter(self.association.correspondences)
        return [
            model.residuals(
                self.association,
                next(correspondences) if isinstance(model, CorrespondenceModel) else None,
            )
            for model in self.measurement_models
        ]

    @cached_property
    def residuals(self) -> tuple[MeasurementResidual, ...]:
        """Measurement residuals: the first one of each measurement in the order of
        `Experiment.measurements`, then other ones, such as outlines.
        """
        by_measurement = self._residuals_by_measurement
        return (
            *(first for first, *_ in by_measurement),
            *chain.from_iterable(others for _, *others in by_measurement),
        )

    @property
    def main_residuals(self) -> tuple[MeasurementResidual, ...]:
        """The first residual of each of `Experiment.measurements`, which predicts it."""
        return self.residuals[: len(self.measurement_models)]

    def residuals_of(self, kind: type[R]) -> tuple[R, ...]:
        """Return the residuals of one class, in the order of `residuals`."""
        return tuple(each for each in self.residuals if isinstance(each, kind))

    @cached_property
    def markers(self) -> MarkerResidual:
        """Residual of the markers; an empty one, which is not among `residuals`, without any."""
        own = self.residuals_of(MarkerResidual)
        of_none = MarkerModel(self.experiment.markers, 0, self.measurement_grid)
        return own[0] if own else of_none.residuals(self.association, None)[0]

    @property
    def reassociable(self) -> tuple[CorrespondenceResidual, ...]:
        """The first residual of each measurement with correspondences, in the order of the
        association's.
        """
        firsts = self.main_residuals
        return tuple(each for each in firsts if isinstance(each, CorrespondenceResidual))

    @cached_property
    def local_loss(self) -> LocalLoss:
        """Second derivatives of the loss by x and φ of those measurements that depend on few
        positions (`local` observables with at least one point); resultants of reactions are not
        among them.
        """
        pairs = ((residual, residual.observable.local) for residual in self.residuals)
        local = tuple(
            (residual, points) for residual, points in pairs if points and points.vector_count
        )
        return LocalLoss(
            local, self.variable_count, nuisance_count=self.nuisance.size, dof_count=self.dof_count
        )

    @cached_property
    def _loss_scale(self) -> Array:
        """Factor from SI units to scaled variables of each entry of the loss's Hessian."""
        rows, columns = self.local_loss.structure
        powers = (rows < self.variable_count).astype(float) + (columns < self.variable_count)
        return self.length_m**powers

    # The association of the measurements ----------------------------------------------------

    def with_association(self, association: Association) -> Transcription:
        """Return a copy with another association: elements, clock samples and correspondences of
        its measurements.

        Cached values of the motion, which do not depend on the association, are shared with the
        copy.
        """
        other = replace(self, association=association)
        vars(other).update(cached_values(self, MotionTranscription))
        return other

    def follow_estimates(self, phi: Array, x: Array) -> tuple[Association, Array]:
        """Return the association that belongs to the estimates, and φ relative to it.

        Markers get the elements that contain their estimated places, clocks the nearest samples,
        and unlabelled points the correspondences in the current shapes. Neither self nor φ is
        modified.

        Parameters
        ----------
        phi : (k,) array
            Nuisance parameters in units of their priors, relative to the present association.
        x : (rows, 3n) array
            First rows of the motion [m], at least `rows_to_follow`; it may have no rows if
            there are no unlabelled points.

        Returns
        -------
        (Association, (k,) array)
            The association, which is the present object if nothing has changed, and a copy of φ in
            which the coordinates of estimated marker places refer to it.
        """
        nuisance = self.nuisance
        places = self.markers.observable.coordinate_parameters
        shifts_s = (
            phi[nuisance.indices_of_rows(TIME)] * nuisance.scales[nuisance.indices_of_rows(TIME)]
        )
        markers, place_coordinates = self.association.markers.follow_estimates(
            np.append(phi, 0.0)[places]
        )
        correspondences = []
        continued = phi
        for residual, present in zip(
            self.reassociable, self.association.correspondences, strict=True
        ):
            updated = residual.reassociated(x, phi)
            # The measurement model has a copy, with its own model of the sensor.
            is_same = updated is residual.correspondences
            correspondences.append(present if is_same else updated)
            continued = updated.continued(continued, residual.correspondences)
        association = self.association.updated(
            markers, float(shifts_s.sum()) / self.experiment.timestep_s, correspondences
        )
        return association, self._with_marker_places(continued, place_coordinates)

    def place_unknown_markers(
        self, phi: Array, x: Array, only_poses: bool = False
    ) -> tuple[Association, Array]:
        """Return the association and φ with unknown marker places and poses of sensors initialised
        from the first rows of a motion.

        A marker without a stated place is put where its first sample lies on the body; it keeps its
        place if it has no sample or its first one is later than the rows. Sensors of unlabelled
        points are aligned with the first shape that they measure, and the parameters of their poses
        are set accordingly.

        Parameters
        ----------
        phi : (k,) array
            Nuisance parameters; they are not modified.
        x : (rows, 3n) array
            First rows of the motion [m], at least `rows_to_place`.
        only_poses : bool
            Whether to keep the correspondences of unlabelled points and align the poses of their
            sensors alone.

        Returns
        -------
        (Association, (k,) array)
            The association, which is the present object if there is nothing to initialise, and φ in
            it.
        """
        phi = phi.copy()
        aligned = tuple(
            each.aligned_correspondences(x, phi, only_pose=only_poses) for each in self.reassociable
        )
        for correspondences in aligned:
            phi = correspondences.with_start_values(phi)
        association, phi = self._place_markers(phi, x)
        return (replace(association, correspondences=aligned) if aligned else association), phi

    def _place_markers(self, phi: Array, x: Array) -> tuple[Association, Array]:
        """Return the association and φ (k,) with unknown marker places from rows x [m]."""
        markers = self.experiment.markers
        rows = self.sample_rows
        if markers.located.all():
            return self.association, phi
        points_m, _ = markers.first_samples
        first = rows[markers.is_complete.argmax(axis=0)]
        places_m = self.marker_places_m(phi)
        unknown = ~markers.located & (first < len(x)) & markers.is_complete.any(axis=0)
        for row in np.unique(first[unknown]):
            starting = np.flatnonzero(unknown & (first == row))
            places_m[starting] = self.association.markers.places_of_points(
                x[row].reshape(-1, 3), points_m[starting]
            )
        if not unknown.any():
            return self.association, phi
        association = self.association.centred_at(places_m)
        return association, self._with_marker_places(phi, association.markers.centre_coordinates)

    @property
    def rows_to_place(self) -> int:
        """Number of rows of x that `place_unknown_markers` needs; 0 if all places are
        stated and there are no unlabelled points.
        """
        unknown = ~self.experiment.markers.located
        first = self.experiment.markers.is_complete[:, unknown].argmax(axis=0)
        rows = [int(self.sample_rows[first].max())] if len(first) else []
        return 1 + max(rows + [each.first_row for each in self.reassociable], default=-1)

    @property
    def rows_to_follow(self) -> int:
        """Number of rows of x that `follow_estimates` needs: all grid times, or 0
        without unlabelled points.
        """
        return self.grid_times if self.reassociable else 0

    def marker_places_m(self, phi: Array) -> Array:
        """Return the places (M, 3) of the markers on the undeformed body at φ (k,) [m]."""
        return self.association.markers.places_m(
            np.append(phi, 0.0)[self.markers.observable.coordinate_parameters]
        )

    @property
    def guess_phi(self) -> Array:
        """Nuisance parameters φ (k,) at the start of a solve: zero, except for the clock
        and the poses of sensors in the association.
        """
        phi = np.zeros(self.nuisance.size)
        time_shifts = self.nuisance.indices_of_rows(TIME)
        phi[time_shifts] = (
            self.association.clock_samples
            * self.experiment.timestep_s
            / self.nuisance.scales[time_shifts]
        )
        for each in self.reassociable:
            phi = each.correspondences.with_start_values(phi)
        return self._with_marker_places(phi, self.association.markers.centre_coordinates)

    def _with_marker_places(self, phi: Array, place_coordinates: Array) -> Array:
        """Return φ (k,) with other coordinates of estimated places."""
        updated = phi.copy()
        estimated = self.association.markers.estimated
        updated[self.markers.observable.coordinate_parameters[estimated]] = place_coordinates[
            estimated
        ]
        return updated

    # Second derivatives -----------------------------------------------------------------------

    def hessian_values(
        self,
        x: Array,
        phi: Array,
        equations: EquationsAtParameters,
        weights: RowWeights,
        loss_weight: float,
        values: Array,
        lifted_histories: Sequence[WeightedHistory] = (),
        has_observation_curvature: bool = True,
    ) -> tuple[Array, list[Array]]:
        """Second derivatives of loss_weight · loss + multipliers · c of this transcription, in
        scaled variables.

        The priors of φ are included for those φ that no earlier experiment has, and the priors of q
        are not.

        Parameters
        ----------
        x : (N, 3n) array
            Positions [m].
        phi : (k,) array
            Nuisance parameters in units of their priors.
        weights : RowWeights
            Weights of the constraints, see `lagrangian_weights`.
        loss_weight : float
            Factor of the loss.
        values : (hessian.nnz,) array
            Derivatives of the constraints in the columns of x, in the order of `hessian`;
            overwritten. Those of the loss are in the second result.
        lifted_histories : sequence of (history, array)
            History variables that are lifted, each with the weights μ_k of its values h_k in the
            Lagrangian, Σ μ_k h_k.
        has_observation_curvature : bool
            If false, neglect the curvature of the observations (Gauss–Newton), see
            `LocalLoss.hessian`.

        Returns
        -------
        ((nq, nq) array, list of arrays)
            Second derivatives by q, and the values of `additional_hessian_entries`.
        """
        by_q, of_constraints = self.constraint_hessian_values(
            x,
            phi,
            equations=equations,
            weights=weights,
            loss_weight=loss_weight,
            values=values,
            lifted_histories=lifted_histories,
        )
        of_loss = (
            loss_weight
            * self._loss_scale
            * self.local_loss.hessian(x, phi, has_observation_curvature=has_observation_curvature)
        )
        return by_q, [of_loss, *of_constraints]

    def additional_hessian_entries(self, first_phi: int) -> list[tuple[Index, Index]]:
        """Return rows and columns in z of the Hessian's entries besides those of `hessian` and of q
        with q, upper triangle.

        The list has four groups: the loss by x and φ; the motion by q and φ; the motion by x and φ;
        φ by φ. An entry may occur in several groups; the values of all are summed.

        Parameters
        ----------
        first_phi : int
            Index in z where the nuisance parameters of all experiments begin.
        """
        of_x = self.offsets.variable + np.arange(self.variable_count)
        of_phi = first_phi - self.nq + self.nuisance_indices.indices
        in_z = np.concatenate([of_x, of_phi])
        rows, columns = self.local_loss.structure
        first = in_z[rows]
        second = in_z[columns]
        return [
            (np.minimum(first, second), np.maximum(first, second)),
            *self.constraint_hessian_entries(first_phi),
        ]


def cached_values(instance: object, cls: type) -> dict[str, Any]:
    """Return the values of the cached properties that a class defines, as far as an instance has
    computed them, by name.

    A copy of the instance may share them if the class knows nothing of what differs in the copy:
    declare what depends on more than a base class in a subclass.

    Parameters
    ----------
    instance : object
        Instance of `cls` or of a subclass of it.
    cls : type
        Class whose own cached properties are returned; those of its subclasses and bases are not.
    """
    return {
        name: value
        for name, value in vars(instance).items()
        if isinstance(vars(cls).get(name), cached_property)
    }


@dataclass(frozen=True, eq=False)
class LocalLoss:
    """Hessian of the loss of the local measurements of one experiment."""

    # tuple of (MeasurementResidual, PointPositions): measurements with their local observables.
    residuals: tuple[tuple[MeasurementResidual, PointPositions], ...]
    position_count: int  # number of position variables, all of which precede φ
    nuisance_count: int  # number of nuisance parameters φ
    dof_count: int  # number of dofs of the body

    @cached_property
    def structure(self) -> tuple[Index, Index]:
        """Rows and columns among (x, φ) of the possible entries, upper triangle, sorted by column,
        each once.
        """
        none = np.zeros(self.nuisance_count)
        codes = []
        for residual, points in self.residuals:
            slopes = points.derivative_matrix(None, none, position_count=self.position_count)
            codes.append(self._codes(*residual.hessian_structure(slopes)))
        columns, rows = np.divmod(unique_codes(codes), self.position_count + self.nuisance_count)
        return rows, columns

    def _codes(self, rows: Index, columns: Index) -> Index:
        """Return one number for each entry, ascending in the order of `structure`."""
        return columns * (self.position_count + self.nuisance_count) + rows

    def hessian(self, x: Array, phi: Array, has_observation_curvature: bool = True) -> Array:
        """Return the values of the entries of `structure`, in SI units.

        A loss that is quadratic is evaluated once; its Hessian contains the observation curvature,
        which is zero.

        Parameters
        ----------
        x : (N, 3n) array
            Positions [m].
        phi : (k,) array
            Nuisance parameters.
        has_observation_curvature : bool
            If false, neglect the curvature of the observations (Gauss–Newton): the derivatives of
            the loss through second derivatives of the residuals.
        """
        return (
            self._constant
            if self._is_quadratic()
            else self._evaluate_at(x, phi, has_observation_curvature=has_observation_curvature)
        )

    def _is_quadratic(self) -> bool:
        """Return whether the values do not depend on x and φ."""
        return all(
            residual.is_quadratic and points.is_linear for residual, points in self.residuals
        )

    @cached_property
    def _constant(self) -> Array:
        """Values at zero positions and parameters; valid everywhere if `_is_quadratic`."""
        rows = max((points.rows[-1] + 1 for _, points in self.residuals), default=1)
        return self._evaluate_at(
            np.zeros((rows, self.dof_count)),
            np.zeros(self.nuisance_count),
            has_observation_curvature=True,
        )

    def _evaluate_at(self, x: Array, phi: Array, has_observation_curvature: bool) -> Array:
        """Return the values of the entries of `structure` at x (N, 3n) and φ (k,)."""
        codes = self._codes(*self.structure)
        values = np.zeros(len(codes))
        for entries in self._entries(x, phi, has_observation_curvature):
            np.add.at(values, np.searchsorted(codes, self._codes(*entries[:2])), entries.values)
        return values

    def _entries(
        self, x: Array, phi: Array, has_observation_curvature: bool
    ) -> Iterator[SparseEntries]:
        for residual, points in self.residuals:
            values = points.evaluate_positions(x, phi)
            yield residual.hessian(
                values,
                phi,
                derivatives=points.derivative_matrix(x, phi, position_count=self.position_count),
                has_observation_curvature=has_observation_curvature,
            )
            if has_observation_curvature and not points.is_linear:
                by_values, _ = residual.loss_gradient(values, phi)
                yield points.curvature(
                    x, phi, by_values=by_values, position_count=self.position_count
                )
