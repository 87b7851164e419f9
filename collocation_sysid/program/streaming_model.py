"""Program of a recording that arrives frame by frame, for time marching without an end.

A short still recording with the same body, grasps and markers represents recordings of any length:
its first rows have the stencils of the start, and its last row has those of all later rows.
`StreamingModel` holds this recording and everything that does not depend on the parameters.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np

from ..common.array_types import Array, Index
from ..fem.laws.constants import GAMMA_M, without_region
from ..model.dynamics import StencilRow
from ..recording.experiment import Experiment
from ..recording.measurement import Measurement
from ..recording.poses import Poses, PoseSequence
from .collocation import Collocation
from .custom_sensor_residual import NEIGHBOURS as GAUGE_NEIGHBOURS
from .custom_sensor_residual import CustomSensorResidual
from .forward.newton_solver import NewtonOptions, NewtonSolver
from .least_squares import SquareRootInformation
from .markers.residual import NEIGHBOURS, MarkerResidual
from .measurement_residual import MeasurementResidual
from .observables import PointPositions
from .reactions.grasps import DELAY_STEPS, Sensor
from .reactions.resultant import TIMES_PER_SAMPLE, ReactionResultant
from .sweep import Sweep
from .transcription import Transcription
from .wrench_residual import WrenchResidual

if TYPE_CHECKING:
    from ..fem.kernels.skyline import FactorMemory

# Largest number of rows that are linearised together; limits memory.
ROWS_PER_CHUNK = 8
# Standard deviation of a weak prior on the logarithm of each parameter, a factor of 10: it keeps
# parameters finite that the first frames do not determine, and is negligible later.
WEAK_PRIOR_DEVIATION = 2.3
# Accuracy of rows whose grasp displacement has to be applied in parts.
CAREFUL_OPTIONS = NewtonOptions(tolerance=1e-6)
# Largest distance of a sample from a row, in rows, at which no interpolation is needed.
ROW_TOLERANCE = 1e-3


class StreamStencil(NamedTuple):
    """Rows that samples of an instrument need, in a recording that continues."""

    neighbours: int  # number of rows around a sample if its clock is right
    clock_error: float = 0.0  # largest error of its clock, in rows
    first: int = 0  # index of the first row at which the observed quantity exists
    delay: int = 0  # number of rows after which it is available

    def rows_of_sample(self, at: float) -> range:
        """Return the rows that a sample at a position `at`, in rows and not necessarily a whole
        number, needs for every clock error; none before `first`.
        """
        begins, ends = (
            max(int(np.floor(at + off + ROW_TOLERANCE)) - (self.neighbours - 1) // 2, self.first)
            for off in (-self.clock_error, self.clock_error)
        )
        return range(begins, ends + self.neighbours)


class StreamInstrument(NamedTuple):
    """Instrument whose samples come with frames: a custom sensor, or the sensor of a grasp."""

    residual: MeasurementResidual  # sensor model
    stencil: StreamStencil  # rows that its samples need
    # Slice of its points among all observed points, those of the markers first; or the index of the
    # resultant in `StreamingModel.reaction_sensors`.
    observable: slice | int


@dataclass(frozen=True, eq=False)
class StreamingModel:
    """Program whose recording arrives frame by frame.

    Its cached buffers are shared by all sweeps with this model, so that only one may run at a time.
    """

    # Largest number of rows that are linearised together.
    rows_per_chunk: ClassVar[int] = ROWS_PER_CHUNK

    experiment: Experiment  # fitted experiment, as declared in the problem
    collocation: Collocation  # program of the still recording, the template of all rows

    @classmethod
    def from_collocation(cls, experiment: Experiment, collocation: Collocation) -> StreamingModel:
        """Return the model of an experiment that is fitted by a program.

        Parameters
        ----------
        experiment : Experiment
            Fitted experiment. Its grasps hold throughout, and its loads are constant (not checked
            here).
        collocation : Collocation
            Program of this experiment, in which every parameter has a guess; its options are used.
        """
        still = replace(collocation, experiments=[_still_experiment(experiment, collocation)])
        return cls(experiment, still)

    def at_start(self, poses: Poses) -> Experiment:
        """Return the still recording with its grasps at these poses, one (rotation, position) for
        each grasp.
        """
        still = self.transcription.experiment
        return replace(still, grasps=_grasps_at(still, poses))

    def with_first_frame(
        self, tracks_m: Array, values: Mapping[int, Array], x: Array
    ) -> StreamingModel:
        """Return the model with unknown places of markers and of points in images, and poses of
        cameras, found from the first frame; self if there are none.

        Parameters
        ----------
        tracks_m : (M, 3)
            Marker positions of the first frame [m], NaN where missing.
        values : mapping of int to (m,) array
            Samples of custom sensors in the first frame, by the number of the instrument, from 1.
        x : (3n,)
            Node positions of the start [m].

        Raises
        ------
        InputError
            If the first frame does not determine the pose of a camera.
        """
        collocation = self.collocation
        still = self.transcription.experiment
        if self.transcription.reassociable:
            t_s = still.t_s
            sampled: dict[Measurement, Measurement] = {
                each: each.with_samples(t_s, np.tile(values[number], (len(t_s), 1)))
                for number, each in enumerate(still.readings, 1)
                if number in values and np.isfinite(values[number]).any()
            }
            seen = still.with_measurements([sampled.get(m, m) for m in still.measurements])
            collocation = replace(collocation, experiments=[seen])
            rows = np.tile(x, (collocation.transcriptions[0].rows_to_place, 1))
            collocation, _ = collocation.place_unknown_markers(collocation.guess_p, [rows])
        unknown = ~still.markers.located & np.isfinite(tracks_m).all(axis=1)
        if unknown.any():
            transcription = collocation.transcriptions[0]
            places_m = transcription.marker_places_m(transcription.guess_phi)
            places_m[unknown] = transcription.association.markers.places_of_points(
                x.reshape(-1, 3), tracks_m[unknown]
            )
            collocation = collocation.with_marker_places([places_m])
        if collocation is self.collocation:
            return self
        for old, new in zip(
            self.transcription.reassociable, collocation.transcriptions[0].reassociable, strict=True
        ):
            # Generated functions are the same for all places.
            vars(new)["_expressions"] = old._expressions
        return replace(self, collocation=collocation)

    @cached_property
    def transcription(self) -> Transcription:
        """Transcription of the still recording."""
        return self.collocation.transcriptions[0]

    @cached_property
    def solver(self) -> Sweep:
        """Solver of the rows of the template."""
        return Sweep(self.transcription, self.template_rows)

    @cached_property
    def newton(self) -> NewtonSolver:
        """Newton solver for the start, and for rows whose grasp displacement is applied in
        parts.
        """
        return NewtonSolver(self.transcription.experiment, CAREFUL_OPTIONS)

    @cached_property
    def template_rows(self) -> int:
        """Number of rows of the template: those of the start, and those that are linearised
        together.
        """
        return 2 * self.transcription.dynamics.largest_lag + 2 + ROWS_PER_CHUNK

    @cached_property
    def parameter_count(self) -> int:
        """Number P of parameters p."""
        return self.collocation.nq + self.collocation.nphi

    @cached_property
    def _mass_damping(self) -> tuple[Index, Array]:
        """Indices in p of γ_m, and their coordinates at the guess."""
        free = self.collocation.parameters.free
        places = np.flatnonzero([without_region(item.name) == GAMMA_M.name for item in free])
        return places, self.collocation.guess_p[places]

    def transformed(self, p: Array) -> Array:
        """Return the variables (P,) in which residuals are nearly linear, for parameters p (P,),
        which are not modified.

        For mass-proportional damping γ_m this is its value divided by the guess, otherwise p
        itself.
        """
        places, guesses = self._mass_damping
        transformed_values = p.copy()
        transformed_values[places] = np.exp(p[places] - guesses)
        return transformed_values

    def physical(self, transformed: Array) -> Array:
        """Return the parameters p (P,) of transformed variables (P,), which must be positive for
        γ_m: the inverse of `transformed`.
        """
        places, guesses = self._mass_damping
        p = transformed.copy()
        p[places] = guesses + np.log(transformed[places])
        return p

    def transformation_derivatives(self, transformed: Array) -> Array:
        """Return the derivatives (P,) of the transformed variables with respect to p, one per entry
        because each depends on its own parameter only, at `transformed` (P,).
        """
        places, _ = self._mass_damping
        rates = np.ones(len(transformed))
        rates[places] = transformed[places]
        return rates

    def prior_information(self, p: Array) -> SquareRootInformation:
        """Return the information before the first frame in the transformed parameters, linearised
        about p (P,): the stated priors, and a weak prior of deviation `WEAK_PRIOR_DEVIATION` about
        the guess of each shared parameter.
        """
        residual, slopes = self.collocation.prior_residuals(p)
        nq = self.collocation.nq
        transformed_values = self.transformed(p)
        from_guess = (p[:nq] - self.collocation.parameters.guess_q) / WEAK_PRIOR_DEVIATION
        rows = np.vstack(
            [np.diag(slopes), np.eye(nq, self.parameter_count) / WEAK_PRIOR_DEVIATION]
        ) / self.transformation_derivatives(transformed_values)
        empty = SquareRootInformation.empty(self.parameter_count)
        return empty.with_rows(
            np.concatenate([residual, from_guess]), rows, parameters=transformed_values
        )

    @cached_property
    def neighbouring_samples(self) -> int:
        """Number of samples before, and after, one marker sample that its evaluation needs; 0 if no
        clock is estimated.
        """
        return NEIGHBOURS // 2 if len(self.transcription.nuisance.clock_indices) else 0

    @cached_property
    def marker_model(self) -> MarkerResidual:
        """Sensor model of one marker sample, in the middle of its neighbouring samples, measured at
        the origin, with a quadratic loss.
        """
        neighbours = self.neighbouring_samples
        markers = self.transcription.experiment.markers
        origin = markers.with_samples(markers.t_s[:1], np.zeros((1, len(markers.names), 3)))
        rows = np.arange(2 * neighbours + 1)
        transcription = self.transcription
        return MarkerResidual.from_markers(
            origin,
            rows,
            nuisance=transcription.nuisance,
            association=transcription.association.markers,
            clock_samples=transcription.association.clock_samples,
            preceding_times=neighbours,
        )

    @cached_property
    def instruments(self) -> tuple[StreamInstrument, ...]:
        """Custom sensors, then the sensors of grasps, each in its order; their samples are those of
        the still recording.
        """
        instruments = []
        place = len(self.experiment.markers.names)
        step_s = self.transcription.dynamics.step_s
        sensors = self.transcription.residuals_of(CustomSensorResidual)
        for residual in (*sensors, *self.transcription.residuals_of(WrenchResidual)):
            channel = residual.observable
            is_custom = isinstance(residual, CustomSensorResidual)
            stencil = StreamStencil(GAUGE_NEIGHBOURS)
            if isinstance(channel, ReactionResultant):
                observable = [other for other, _ in self.reaction_sensors].index(channel)
                stencil = stencil._replace(first=int(channel.known_rows[0]), delay=DELAY_STEPS)
                if not is_custom:
                    clock_error = channel.clock_limit_s / step_s
                    stencil = stencil._replace(neighbours=TIMES_PER_SAMPLE, clock_error=clock_error)
            else:
                observable = slice(place, place + channel.vector_count)
                place += channel.vector_count
            instruments.append(StreamInstrument(residual, stencil, observable=observable))
        return tuple(instruments)

    def huber_of(self, instrument: int) -> float | None:
        """Return the threshold of Huber's loss of an instrument, 0 for the markers."""
        if not instrument:
            return self.collocation.huber
        return self.instruments[instrument - 1].residual.huber

    @cached_property
    def judged_instruments(self) -> Sequence[int]:
        """Numbers of the instruments whose residuals are judged: the markers (0) if there are any,
        else all others.
        """
        return [0] if self.experiment.markers.names else range(1, 1 + len(self.instruments))

    @property
    def judged_residuals(self) -> Sequence[MeasurementResidual]:
        """Sensor models of `judged_instruments`."""
        each = (
            self.instruments[k - 1].residual if k else self.marker_model
            for k in self.judged_instruments
        )
        return tuple(each)

    @cached_property
    def largest_delay_rows(self) -> int:
        """Largest number of rows that instruments need in addition to those of the markers; 0
        without instruments.
        """
        spans = (2 * each.stencil.clock_error + each.stencil.delay for each in self.instruments)
        return int(np.ceil(max(spans, default=0.0)))

    @cached_property
    def observed_points(self) -> tuple[PointPositions, ...]:
        """Points that custom sensors observe, one entry for each custom sensor of points; those of
        grasps have none.
        """
        channels = (
            each.observable for each in self.transcription.residuals_of(CustomSensorResidual)
        )
        return tuple(each for each in channels if isinstance(each, PointPositions))

    @cached_property
    def reaction_sensors(self) -> tuple[Sensor, ...]:
        """Resultants of reactions that sensors observe, each with the index of its grasp, from 0:
        those of force–torque sensors, then of custom sensors.
        """
        channels = [residual.observable for residual in self.transcription.residuals]
        grasps = [id(grasp) for grasp in self.transcription.experiment.grasps]
        resultants = (channel for channel in channels if isinstance(channel, ReactionResultant))
        return tuple((channel, grasps.index(id(channel.grasp))) for channel in resultants)

    @cached_property
    def moving_grasps(self) -> Index:
        """Indices, from 0, of the grasps whose poses come with the frames; others never move."""
        grasps = self.experiment.grasps
        return np.flatnonzero([len(grasp.poses.t_s) > 1 for grasp in grasps])

    @cached_property
    def first_poses(self) -> Poses:
        """Poses of all grasps at the start of the problem's
        recording, (rotation, position) each.
        """
        return _first_poses(self.experiment)

    def all_poses(self, moved: Poses) -> Poses:
        """Return the poses of all grasps from those of the moving ones, in the order of
        `moving_grasps`; the others are at their first poses.

        Raises
        ------
        ValueError
            If the number of poses is not that of the moving grasps.
        """
        still = list(self.first_poses)
        for number, pose in zip(self.moving_grasps, moved, strict=True):
            still[number] = pose
        return tuple(still)

    @cached_property
    def cached_rows(self) -> dict[int, StencilRow]:
        """Cached coefficients of rows with constant masses, by index; filled on demand."""
        return {}

    @cached_property
    def factor_memory(self) -> FactorMemory | None:
        """Memory for the factor of a row, shared by all passes; None where factors allocate their
        own.
        """
        return self.solver.factoriser.allocate(1 + self.transcription.body.is_unsymmetric)

    @cached_property
    def linearisation_memory(self) -> Array:
        """Memory for rows that are linearised together, (ROWS_PER_CHUNK, width); overwritten by
        each linearisation.
        """
        return np.empty(
            (ROWS_PER_CHUNK, self.transcription.dynamics.forces.body.linearisation_width)
        )

    @cached_property
    def body_size_m(self) -> float:
        """Diagonal of the bounding box of the undeformed body [m]."""
        return float(np.linalg.norm(np.ptp(self.transcription.body.nodes_m, axis=0)))

    def displaced_nodes(self, phi: Array) -> tuple[Array, Array]:
        """Return the undeformed positions H X (g, 3) [m] of the node of each of the g grasped dofs,
        H being the body's pose in the gripper, and their derivatives (g, 3, m) with respect to the
        nuisance parameters φ.
        """
        return self.transcription.prescribed_motion.displaced_nodes(phi)

    def prescribed_positions(
        self, displaced_nodes: tuple[Array, Array], poses: Sequence[Poses]
    ) -> tuple[Array, Array]:
        """Return the prescribed positions (K, g) [m] of the g grasped dofs at K times, and their
        derivatives by φ (K, g, m).

        Parameters
        ----------
        displaced_nodes : tuple
            Result of `displaced_nodes`.
        poses : sequence of Poses
            For each of the K times, the poses of all grasps.
        """
        rotations = np.array([[turn for turn, _ in each] for each in poses])[:, *self._axes]
        shifts = np.array([[shift for _, shift in each] for each in poses])[:, *self._axes]
        goal = np.einsum("kgj,gj->kg", rotations, displaced_nodes[0]) + shifts
        return goal, np.einsum("kgj,gjm->kgm", rotations, displaced_nodes[1])

    @cached_property
    def _axes(self) -> tuple[Index, Index]:
        """Index of the grasp and axis of each grasped dof, (g,) each."""
        dofs = self.transcription.prescribed_motion.dofs
        grasp = np.zeros_like(dofs)
        for k, each in enumerate(self.experiment.grasps):
            grasp[np.searchsorted(dofs, each.prescribed_dofs)] = k
        return grasp, dofs % 3

    @cached_property
    def stencils(self) -> tuple[Array, Array, Array, Array]:
        """Stencil coefficients p, q, w and s of the template as matrices (rows, rows), with those of
        row t and time t − i at [t, t − i], see `model.schemes`; q and s include the time step.
        """
        dynamics = self.transcription.dynamics.truncated_to(self.template_rows)
        tables = dynamics.tables
        step_s = dynamics.step_s
        p, q, w, s = map(_banded_matrix, (tables.p, tables.q, tables.w, tables.s))
        return p, q / step_s, w, s / step_s**2


def _banded_matrix(table: Array) -> Array:
    """Return the matrix with table[t, lag] at [t, t − lag], from (rows, lags)."""
    matrix = np.zeros((len(table), len(table)))
    for lag in range(table.shape[1]):
        matrix += np.diag(table[lag:, lag], -lag)
    return matrix


def _still_experiment(experiment: Experiment, collocation: Collocation) -> Experiment:
    """Return a few samples in which nothing moves, with first poses and markers."""
    reach = collocation.transcriptions[0].dynamics.largest_lag
    # The rows of the start, and room for a reading.
    count = max(2 * reach + 2 + ROWS_PER_CHUNK, NEIGHBOURS, 3)
    t_s = experiment.timestep_s * np.arange(count)
    markers = experiment.markers
    first, _ = markers.first_samples
    tracks = np.tile(np.nan_to_num(first), (count, 1, 1))
    still = [
        markers.with_samples(t_s, tracks) if each is markers else each.with_zeros_at(t_s)
        for each in experiment.measurements
    ]
    grasps = _grasps_at(experiment, _first_poses(experiment))
    return experiment.with_measurements(still, t_s=t_s, grasps=grasps)


def _first_poses(experiment: Experiment) -> Poses:
    """Return the first (rotation, position) of each grasp."""
    poses = (grasp.poses.at(grasp.poses.t_s[:1]) for grasp in experiment.grasps)
    return tuple((rotations[0], shifts[0]) for rotations, shifts in poses)


def _grasps_at(experiment: Experiment, poses: Poses) -> list:
    """Return the grasps of an experiment, at rest at given poses, (rotation, position) each."""
    grasps = []
    for grasp, (turn, shift) in zip(experiment.grasps, poses, strict=True):
        matrix = np.eye(4)
        matrix[:3, :3] = turn
        matrix[:3, 3] = shift
        grasps.append(replace(grasp, poses=PoseSequence.from_matrices([0.0], matrix[None])))
    return grasps
