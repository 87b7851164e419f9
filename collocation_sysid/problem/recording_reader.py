"""Reading of one experiment: its table and files are converted to an `Experiment` on one
time grid.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ..common.array_types import Array
from ..common.checked_arrays import point_text
from ..common.declarations import keys_of
from ..common.schema_tables import declared_in
from ..errors import ImplausibleMarkersError, InputError, hint_at, listed, located
from ..fem.body import Body
from ..methods.starts.stiffness_scan import typical_constants
from ..model.parameters import Parameters
from ..recording import (
    Experiment,
    Gauge,
    Grasp,
    Markers,
    MarkerTable,
    Obstacle,
    PoseSequence,
    Wrench,
    align,
    displaced_axes,
    prescribed_dofs,
    read_displacement,
    read_poses,
    read_wrench,
)
from ..recording.alignment import AlignedRecording
from ..recording.experiment import require_no_surface
from ..recording.gap_interpolation import interpolation_error
from ..recording.measured_faces import face_note, read_face
from ..recording.poses import require_determined_motion
from ..recording.sample_times import TIME_TOLERANCE_S
from ..recording.sources.columns import name_and_unit
from ..recording.sources.logs import stored_files
from ..recording.sources.units import UNITS, si_factor
from ..recording.time_tables import is_within_experiment
from .bench_files import strain_length_m
from .code_loader import CodeLoader
from .measurement_section import RecordingFolder, existing_file
from .nuisance_schema import nuisance_from_section
from .recording_frames import (
    RecordingFrames,
    gripper_markers,
    poses_from_markers,
    read_marker_tracks,
    transform_to_body_frame,
)
from .recording_schema import (
    LOADS,
    MEASUREMENT_TABLES,
    ExperimentSection,
    ForceSensorSection,
    GraspSection,
    ObstacleSection,
    ReadingSection,
    TableSection,
)
from .size import MOST_SAMPLES, Say, Size, require_feasible

Moved = GraspSection | ObstacleSection

# Smallest span of the markers over the body's size: a wrong unit is a factor of 1000.
LEAST_SPAN = 0.005
# Largest span of the markers over the body's size.
LARGEST_SPAN = 10.0
# Largest distance of a marker from its rigidly moved position, over the body's size.
LARGEST_MISS = 3.0
# Estimated error of interpolated markers, in their sigma_m, from which on it is noted: residuals
# are 4 % larger.
LARGEST_INTERPOLATION_SIGMAS = 0.3


@dataclass
class RecordingReader:
    """Reader of one experiment's files."""

    section: ExperimentSection  # table of the experiment
    folder: Path  # folder that contains the files
    body: Body  # body of the experiment
    parameters: Parameters  # parameters, from which markers' plausibility is judged
    simulation: bool  # whether files of measurements may be missing
    code: CodeLoader  # loader of Python files
    air_density_kg_m3: float | Literal["none"]
    # Assumptions that were made; reading adds to them.
    notes: list[str] = field(default_factory=list)
    size: Size | None = None  # size of the problem with one sample; None skips the check of memory
    say: Say | None = None  # function that is called with a sentence before long work

    def read(self) -> Experiment:
        """Read all files of the experiment and return it; notes are added to `notes`.

        Unless the problem is simulated, markers that cannot belong to the body are refused, see
        `require_plausible_markers`.

        Raises
        ------
        InputError
            Names the file and line, or the key within the experiment's table. Also if all nodes are
            grasped, or if the problem exceeds this machine's memory.
        """
        if not self.body.is_solid:
            of_surface = [
                key for key in ("obstacle", "tendon", "pressure") if getattr(self.section, key)
            ]
            cameras = [
                key for key in ("depth", "outlines") if key in self.section.measurement_tables
            ]
            require_no_surface([*of_surface, *cameras])
        markers = self.section.markers
        if markers.s_m:
            known = self._recording_folder.places_on_rod(markers.s_m, "markers.s_m")
            markers = markers.model_copy(update={"reference_m": {**known, **markers.reference_m}})
            self.section = self.section.model_copy(update={"markers": markers})
        section = self.section
        aligned = self._align([*map(self._poses, range(len(section.moved_sections)))])
        t_s = aligned.t_s
        grasps = [self._grasp(k, sequence, t_s=t_s) for k, sequence in enumerate(aligned.poses)]
        if len(prescribed_dofs(grasps)) == 3 * (n := len(self.body.nodes_m)):
            message = (
                f"all {n} nodes of the body are selected, so that nothing can move; select fewer, "
                "and check length_unit of the object"
            )
            raise InputError(message, where="grasp")
        loads: dict[str, Any] = {
            name: [self._from_table(word, k=k) for k in range(len(getattr(section, word)))]
            for name, word in LOADS.items()
        }
        declared = declared_in(section, where="")
        declared["gravity_m_s2"] = self._frames.gravity_m_s2()
        self._add_notes(*self._frames.gravity_notes())
        experiment = Experiment(
            name=section.name,
            body=self.body,
            t_s=t_s,
            grasps=grasps,
            **self._measurements(t_s),
            markers=self._markers(t_s, aligned.table),
            nuisance=nuisance_from_section(section.nuisance, self.code.nuisance_row),
            air_density_kg_m3=self.air_density_kg_m3,
            **declared,
            **loads,
        )
        for before, after in zip(grasps, experiment.grasps, strict=False):
            if before.wrench is not None and after.wrench is not None:
                kept = after.wrench.component_names
                left = [n for n in before.wrench.component_names if n not in kept]
                if left and not self.simulation:
                    self._add_notes(
                        f"{listed(left)} of the sensor are not used: by symmetry, they vanish on the "
                        "complete specimen"
                    )
        if section.has_markers and not self.simulation:
            frames_fault = self._frames.markers_fault()
            require_plausible_markers(
                experiment, typical_constants(self.parameters), frames_fault=frames_fault
            )
            if frames_fault:
                self._add_notes(frames_fault)
                experiment = replace(experiment, frames_fault=frames_fault)
        return experiment

    @cached_property
    def _frames(self) -> RecordingFrames:
        return RecordingFrames(self.section, self.folder)

    @property
    def _is_static(self) -> bool:
        """Whether the samples are equilibria (kind "static")."""
        return self.section.kind == "static"

    def _add_notes(self, *notes: str) -> None:
        self.notes += [f"experiment '{self.section.name}': {note}" for note in notes]

    # Files ----------------------------------------------------------------------------------------

    def _table_file(self, table: TableSection, key: str) -> Path:
        key = "file" if table.file is None and self.section.file else key
        return self._recording_folder.require_existing(
            self.section.file_of(table), key, what="a file here, or a file of the experiment"
        )

    @property
    def _requires_times(self) -> bool:
        """Motions, and equilibria of bodies with memory, need times."""
        return not self._is_static or self.body.has_memory

    # Grasps ---------------------------------------------------------------------------------------

    def _grasp_key(self, k: int, key: str = "") -> str:
        """Indices are those of grasps, then of obstacles; a single grasp has none."""
        grasps = len(self.section.grasp_list)
        one = f"grasp.{k}" if grasps > 1 else "grasp"
        one = one if k < grasps else f"obstacle.{k - grasps}"
        return f"{one}.{key}" if key else one

    def _poses(self, k: int) -> PoseSequence:
        """Return the poses of the grasp or obstacle with index k (grasps first), at their own
        times.

        They come from its markers, its displacement table or its file; without any of these they
        are constant. `gripper_to_body` and the interpolation of the section are applied.
        """
        grasp = self.section.moved_sections[k]
        if grasp.cluster:
            key = self._grasp_key(k, "two_points" if grasp.two_points else "markers")
            return self._poses_from_markers(grasp, key)
        if isinstance(grasp, GraspSection) and grasp.displacements is not None:
            key = self._grasp_key(k, "displacements")
            file = existing_file(self.folder, grasp.displacements, key=key)
            poses = read_face(file, self.body.nodes_m, axes=grasp.axes)
            self._add_notes(f"{grasp.displacements}: {face_note(poses)}")
        elif grasp.displacement is not None:
            file = self._table_file(grasp.displacement, self._grasp_key(k, "displacement"))
            layout = grasp.displacement.dump_layout()
            layout |= {"length_m": strain_length_m(grasp.displacement, self.body)}
            layout["other_columns"] = self.section.noise_columns_of(grasp.displacement)
            notes: list[str] = []
            layout |= {"point_m": grasp.displacement.point_m, "timed": self._requires_times}
            poses = read_displacement(file, **layout, notes=notes)
            self._add_notes(*(f"{self.section.file_of(grasp.displacement)}: {n}" for n in notes))
        elif grasp.poses is None:
            return PoseSequence.fixed()
        else:
            file = existing_file(self.folder, grasp.poses, key=self._grasp_key(k, "poses"))
            poses = read_poses(file, grasp.quaternion, length_unit=grasp.length_unit)
        if (transform := grasp.gripper_to_body) is not None:
            with located(where=self._grasp_key(k, "gripper_to_body")):
                transform_pose = PoseSequence(
                    [0.0], [transform.position_m], quaternions_xyzw=[transform.quaternion_xyzw]
                )
                poses = poses.after(transform_pose)
        return replace(poses, interpolation=grasp.interpolation)

    def _poses_from_markers(self, grasp: Moved, key: str) -> PoseSequence:
        if self._marker_tracks is None:
            message = (
                "the poses are to be fitted to markers, but there are no marker tracks; expected "
                "markers.file, or poses"
            )
            raise InputError(message, where=key)
        _require_known_markers(grasp.cluster, self._marker_tracks.names, key=key)
        with located(where=key):
            poses, notes = poses_from_markers(
                grasp, self._marker_tracks, window_s=self.section.window_s
            )
        self._add_notes(*(f"{key}: {note}" for note in notes))
        return poses

    def _grasp(self, k: int, poses: PoseSequence, t_s: Array) -> Grasp:
        """Index k counts grasps, then obstacles; obstacles without a name are numbered from 1."""
        section = self.section.moved_sections[k]
        zero = ""
        if (table := section.displacement) is not None:
            file = self._table_file(table, self._grasp_key(k, "displacement"))
            rest_m = strain_length_m(table, self.body)
            others = self.section.noise_columns_of(table)
            zero = displaced_axes(
                file, table.columns, table.axis, rest_m, others, header_line=table.header_line
            )
        is_obstacle = isinstance(section, ObstacleSection)
        kind, word = (Obstacle, "force") if is_obstacle else (Grasp, "wrench")
        number = k + 1 - len(self.section.grasp_list)
        defaults = {"name": f"obstacle {number}"} if is_obstacle else {}
        arguments: dict[str, Any] = defaults | declared_in(section, where=self._grasp_key(k))
        wrench = section.sensor and self._wrench(
            section.sensor, self._grasp_key(k, word), k=k, t_s=t_s
        )
        with located(where=self._grasp_key(k)):
            grasp = kind(
                **arguments,
                poses=poses,
                zero=zero,
                wrench=wrench,
                displacement_scale=1.0 if table is None else table.scale,
            )
        if is_obstacle:
            return grasp
        with located(where=self._grasp_key(k, "nodes")):
            return grasp.on_body(self.body, t_s)

    # What is measured, and what acts --------------------------------------------------------------

    def _read_wrench(
        self, section: ForceSensorSection, key: str, notes: list[str] | None = None
    ) -> tuple[Array, Array, dict[str, Array]]:
        """Return times (S,) [s], values (S, 6) [N, N m] and columns (S,) of σ by their keys of a
        wrench's file, divided by the section's `symmetry`; `key` is that of the section, for
        messages, and `notes` are added to.
        """
        file = self._table_file(section, f"{key}.file")
        layout = section.dump_layout()
        layout["noise_columns"] = section.noise_columns
        layout["other_columns"] = self.section.noise_columns_of(section)
        timed = self._requires_times
        return read_wrench(file, **layout, symmetry=section.symmetry, timed=timed, notes=notes)

    def _wrench(self, section: ForceSensorSection, key: str, k: int, t_s: Array) -> Wrench:
        """Return the measured wrench within the times t_s of the experiment, and note how many
        samples are used.

        Unless the section states frame or point_m, the transforms of a log express it in the axes
        of the body or of the world, see `RecordingFrames.sensor_mounting`, with a note.
        If a simulation has no file, the wrench is zero at t_s, with a `sigma_nm` of 1 unless
        stated. Of equilibria without markers, only measurements at the times t_s are used, if there
        are any. Stated sigmas are divided by the section's `symmetry`.
        """
        name = self.section.file_of(section)
        arguments: dict[str, Any] = declared_in(section, where=key)
        for sigma in {"sigma_n", "sigma_nm"} & arguments.keys() - section.noise_columns.keys():
            arguments[sigma] /= section.symmetry
        with located(where=key):
            if not self._recording_folder.must_read(name):
                for sigma, column in section.noise_columns.items():
                    message = f"found the column {column!r} without a file; expected a number"
                    raise InputError(message, where=sigma)
                zeros = np.zeros((len(t_s), 6))
                zeros[:, :3] = np.nan if arguments.get("sigma_n") is None else 0.0
                return Wrench(t_s, zeros, **{"sigma_nm": 1.0, **arguments})
            notes: list[str] = []
            at_s, values, sigmas = self._read_wrench(section, key, notes)
            self._add_notes(*(f"{name}: {note}" for note in notes))
            displacement = self.section.moved_sections[k].displacement
            if displacement is not None and displacement.point_m and not section.states_axes:
                # Torques of a machine are about the axis of its rotation.
                arguments["point_m"] = displacement.point_m
            mounting = self._frames.sensor_mounting(section, key, k=k)
            if note := self._frames.sensor_note(section, mounting):
                self._add_notes(note)
            if mounting is not None and not section.states_axes:
                values = mounting.rotate(values)
                arguments["frame"] = mounting.frame
                arguments["point_m"] = mounting.point_m
            is_used = is_within_experiment(at_s, t_s, name=str(name), is_static=self._is_static)
            if self._is_static and not self.section.has_markers:
                # Between equilibria it would be read off their chord, unless all of it is.
                is_at_sample = np.abs(at_s[:, None] - t_s).min(axis=1) <= TIME_TOLERANCE_S
                is_used &= is_at_sample if is_at_sample.any() else True
            self._add_notes(f"{name}: {is_used.sum()} of {len(at_s)} samples are used")
            arguments |= {sigma: column[is_used] for sigma, column in sigmas.items()}
            return Wrench(at_s[is_used], values[is_used], **arguments)

    def _custom_sensor(self, k: int, section: ReadingSection, t_s: Array) -> Gauge:
        """In a simulation without a file, the values are None and the times are t_s."""
        key = f"reading.{k}"
        arguments: dict[str, Any] = {"name": section.name, **declared_in(section, where=key)}
        _, arguments["expression"] = self.code.function(
            section.code, section.function, key=f"{key}.code"
        )
        if section.grasp and section.grasp > (count := len(self.section.grasp_list)):
            message = f"found {section.grasp}; expected the number of a grasp, 1 to {count}"
            raise InputError(message, where=f"{key}.grasp")
        with located(where=key):
            noise = [section.sigma] if isinstance(section.sigma, str) else []
            sought = [*section.columns, *noise] if section.columns else []
            at_s, values, columns = self._recording_folder.read_samples(
                section.file, key, t_s=t_s, columns=sought
            )
            for column in noise:
                if values is None or column not in columns:
                    message = f"found {column!r}; expected a number, or one of the file's columns"
                    raise InputError(message, where="sigma")
                place = columns.index(column)
                arguments["sigma"] = values[:, place]
                values = np.delete(values, place, axis=1)
                columns = [name for name in columns if name != column]
            arguments["columns"] = columns
            self._compare_units(columns, section.unit)
            return Gauge(t_s=at_s, values=values, **arguments)

    def _compare_units(self, columns: Iterable[str], unit: str) -> None:
        """Refuse columns of a custom sensor in another unit than the stated one, and note units that
        are not used.
        """
        for column in columns:
            own = (name_and_unit(column)[1] if column.endswith((")", "]")) else None) or ""
            factors = [si_factor(own, each) for each in UNITS if si_factor(own, each)]
            if not factors or own == unit:
                continue
            if any(si_factor(unit, each) in factors for each in UNITS):
                continue
            if unit:
                message = f"column {column} has the unit {own}; expected {unit}: convert its values"
                raise InputError(message, where="file")
            self._add_notes(f"column {column} is used in its own unit, {own}")

    @property
    def _recording_folder(self) -> RecordingFolder:
        """Folder of the files, for tables that read themselves."""
        return RecordingFolder(
            self.folder,
            self.body,
            is_static=self._is_static,
            is_simulation=self.simulation,
            add_note=self._add_notes,
        )

    def _measurements(self, t_s: Array) -> dict[str, list[Any]]:
        section = self.section
        fields: dict[str, list[Any]] = {
            "readings": [
                self._custom_sensor(k, each, t_s=t_s) for k, each in enumerate(section.reading)
            ]
        }
        for key, tables in section.measurement_tables.items():
            fields.setdefault(MEASUREMENT_TABLES.get(key, "readings"), []).extend(
                table.read(self._recording_folder, f"{key}.{k}", t_s=t_s)
                for k, table in enumerate(tables)
            )
        return fields

    def _from_table(self, list_key: str, k: int) -> Any:
        """Return the object of a table in a list; without a name it is called such as tendon_1."""
        table = getattr(self.section, list_key)[k]
        where = f"{list_key}.{k}"
        defaults = {"name": f"{list_key}_{k + 1}"} if "name" in type(table).model_fields else {}
        arguments = defaults | declared_in(table, where=where)
        for name, key in keys_of(table.of):
            if key.constant and key.read and (file_name := getattr(table, key.name)):
                file = existing_file(self.folder, file_name, key=f"{where}.{key.name}")
                notes: list[str] = []
                arguments[name], arguments[key.constant] = key.read(file, notes)
                self._add_notes(*(f"{file_name}: {note}" for note in notes))
        with located(where=f"{where}.nodes" if "nodes" in arguments else where):
            return table.of(**arguments).on_body(self.body)

    # Markers --------------------------------------------------------------------------------------

    @cached_property
    def _marker_tracks(self) -> MarkerTable | None:
        """Tracks of all markers that the experiment uses, gripper included, in the body's frame.

        None if the experiment has no markers, or if a simulation has no file. The first access
        reads the file and adds notes.
        """
        markers = self.section.markers
        if not self.section.has_markers or not self._recording_folder.must_read(markers.file):
            return None
        file = self._recording_folder.require_existing(
            markers.file, "markers.file", what="a file of marker tracks"
        )
        table = read_marker_tracks(self.section, file)
        self._add_notes(*(f"{markers.file}: {note}" for note in table.notes))
        _require_known_markers(markers.template_m or (), table.names, key="markers.template_m")
        with located(where="markers.template_m"):
            table, notes = transform_to_body_frame(markers, table)
        self._add_notes(*notes)
        return table

    def _fitted_tracks(self, poses: Sequence[PoseSequence]) -> MarkerTable:
        """Tracks have no columns without markers, and are zero if a simulation has no file."""
        if not self.section.has_markers:
            times = self._sample_times(poses)
            return MarkerTable(times, (), positions_m=np.zeros((len(times), 0, 3)))
        if self._marker_tracks is not None:
            return self._select_tracks(self._marker_tracks)
        markers = self.section.markers
        names = tuple(markers.names or markers.reference_m)
        names_without_position = [name for name in names if name not in markers.reference_m]
        if names_without_position or not names:
            message = (
                f"there is no {markers.file or 'file'} yet and no position of "
                f"{names_without_position[0] if names_without_position else 'any marker'}; to "
                "simulate, expected an entry name = [x, y, z] for each marker"
            )
            raise InputError(message, where="markers.reference_m")
        times = self._sample_times(poses)
        return self._select_tracks(
            MarkerTable(times, names, positions_m=np.zeros((len(times), len(names), 3)))
        )

    def _sample_times(self, poses: Sequence[PoseSequence]) -> Array:
        """Return the sample times [s] where no marker file gives them.

        They are those of the first existing wrench file if there are no markers, else for
        equilibria without moving grasps those of all sensors that have times of their own, else
        those of the longest sequence of poses.
        """
        section = self.section
        wrench_sections = [
            (k, grasp.sensor) for k, grasp in enumerate(section.moved_sections) if grasp.sensor
        ]
        if not (
            wrench_sections or section.has_markers or section.reading or section.measurement_tables
        ):
            message = (
                "nothing is measured: expected markers, a wrench, a reading, or "
                f"{' or '.join(MEASUREMENT_TABLES)}"
            )
            raise InputError(message, where="markers")
        existing_wrenches = [
            s for s in wrench_sections if stored_files(self.folder / str(section.file_of(s[1])))
        ]
        if existing_wrenches and not section.has_markers:
            k, sensor = existing_wrenches[0]
            return self._read_wrench(sensor, self._grasp_key(k, "wrench"))[0]
        if (
            self._is_static
            and section.measurement_tables
            and max(len(each.t_s) for each in poses) < 2
        ):
            times_s = [
                table.read_times_s(self._recording_folder, f"{key}.{k}")
                for key, tables in section.measurement_tables.items()
                for k, table in enumerate(tables)
            ]
            return np.unique(np.concatenate(times_s))
        times = max((sequence.t_s for sequence in poses), key=len, default=np.zeros(0))
        fewest = 1 if self._is_static else 3
        if len(times) < fewest:
            message = (
                f"there is neither a markers.file nor a poses file with {fewest} or more times; "
                "expected one of them, whose times the simulation uses"
            )
            raise InputError(message, where="grasp")
        return times

    def _select_tracks(self, table: MarkerTable) -> MarkerTable:
        """Return the tracks to fit; markers of a weight of 0 are noted."""
        markers = self.section.markers
        for key in ("s_m", "reference_m", "reference_sigma_m", "sigma_m", "weights"):
            if isinstance(by_name := getattr(markers, key), dict):
                _require_known_markers(by_name, table.names, key=f"markers.{key}")
        unweighted = [name for name in table.names if markers.weights.get(name) == 0]
        if unweighted:
            self._add_notes(f"markers excluded by a weight of 0: {', '.join(unweighted)}")
        # Markers that only the gripper or the template needs are read, and not fitted.
        fitted_names = set(markers.names or set(table.names) - gripper_markers(self.section))
        indices = [
            k for k, n in enumerate(table.names) if n in fitted_names and n not in unweighted
        ]
        if not indices:
            message = (
                f"no marker remains of {', '.join(table.names)}: all are on the gripper or have "
                "the weight 0; expected at least one on the body"
            )
            raise InputError(message, where="markers")
        names = tuple(table.names[k] for k in indices)
        sigma_m = None if table.sigma_m is None else table.sigma_m[:, indices]
        return MarkerTable(
            table.t_s, names, positions_m=table.positions_m[:, indices], sigma_m=sigma_m
        )

    def _align(self, poses: list[PoseSequence]) -> AlignedRecording:
        """Return times, poses and tracks on one clock and time grid, and add notes.

        The window, `resample_hz` and `every` are applied (not `every` in a simulation, whose files
        have been thinned already).
        """
        section = self.section
        table = self._fitted_tracks(poses)
        static = self._is_static
        intervals = [
            each.model_dump(include={"from_s", "until_s"}) for each in section.moved_sections
        ]
        grasp_intervals_s = [
            (-np.inf if first is None else first, np.inf if last is None else last)
            for first, last in (each.values() for each in intervals)
        ]
        pose_files = [section.motion_file(grasp) for grasp in section.moved_sections]
        first_s, last_s = section.window_s or (-np.inf, np.inf)
        t_s = table.t_s[table.t_s >= first_s - TIME_TOLERANCE_S]
        t_s = t_s[t_s <= last_s + TIME_TOLERANCE_S]
        if len(t_s) and np.isfinite(last_s):
            interval_s = (table.t_s[-1] - table.t_s[0]) / max(len(table.t_s) - 1, 1)
            if last_s > table.t_s[-1] + interval_s or first_s < table.t_s[0] - interval_s:
                self._add_notes(
                    f"window_s = [{first_s:g}, {last_s:g}] exceeds the recording, which has samples "
                    f"from {table.t_s[0]:g} s to {table.t_s[-1]:g} s"
                )
        for name, sequence, interval_s in zip(pose_files, poses, grasp_intervals_s, strict=True):
            if name is not None and len(t_s) and not static:
                require_determined_motion(
                    sequence, t_s, interval_s=interval_s, file=self.folder / name
                )
        rate_hz = section.resample_hz
        # The files that a simulation writes are thinned when they are read.
        every = 1 if self.simulation else section.every
        if self.size is not None and len(t_s):
            samples = len(t_s) // every
            if rate_hz and not static:
                samples = int(min((t_s[-1] - t_s[0]) * rate_hz, MOST_SAMPLES)) + 1
            places = section.markers.reference_m
            size = replace(
                self.size,
                samples=samples,
                markers=len(table.names),
                unplaced_markers=sum(name not in places for name in table.names),
            )
            require_feasible(size, self.say)
        try:
            aligned = align(
                poses,
                table,
                window_s=section.window_s,
                resample_hz=rate_hz,
                every=every,
                grasp_intervals_s=grasp_intervals_s,
                static=static,
            )
        except InputError as error:
            files = dict.fromkeys(name for name in (*pose_files, section.markers.file) if name)
            raise InputError(error.message, where=" and ".join(files)) from error
        self._add_notes(*aligned.notes)
        if rate_hz and not static and self._marker_tracks is not None:
            note = self._resampling_note(aligned.t_s, table)
            self._add_notes(*([note] if note else []))
        if rate_hz and rate_hz > 1.01 / np.median(np.diff(table.t_s)):
            self._add_notes(
                "resample_hz is above the markers' own rate; interpolated samples are treated as "
                "measured, so that error bars are too small"
            )
        return aligned

    def _markers(self, t_s: Array, table: MarkerTable) -> Markers:
        """Return the markers at the times t_s; positions on the body are NaN where they are to be
        estimated.

        The standard deviation of a marker is its sigma_m over the square root of its weight, which
        is 1 unless stated; a column of σ of the file precedes sigma_m. If the experiment has no
        markers, the result has none.
        """
        if not self.section.has_markers:
            return Markers.none(t_s)
        section = self.section.markers
        names = table.names
        sigma_m = by_marker(section.sigma_m, names, default=np.nan)
        known_m = section.reference_sigma_m
        if np.isnan(sigma_m).any():
            missing_name = names[int(np.isnan(sigma_m).argmax())]
            message = (
                f"found no value for the marker {missing_name!r}; expected one for every marker"
            )
            raise InputError(message, where="markers.sigma_m")
        if table.sigma_m is not None:
            is_stated = np.isnan(table.sigma_m).all(axis=0)
            sigma_m = np.where(is_stated, sigma_m, table.sigma_m)
        arguments: dict[str, Any] = declared_in(section, where="markers")
        return Markers(
            t_s,
            table.positions_m,
            sigma_m=sigma_m / np.sqrt(by_marker(section.weights, names, default=1.0)),
            names=names,
            places_m=np.array([section.reference_m.get(name, [np.nan] * 3) for name in names]),
            places_sigma_m=None if known_m is None else by_marker(known_m, names, default=np.nan),
            offsets_s=table.offsets_s,
            **arguments,
        )

    def _resampling_note(self, t_s: Array, table: MarkerTable) -> str:
        """Return a note on markers whose error of interpolation to the times `t_s` (T,) [s] is
        above `LARGEST_INTERPOLATION_SIGMAS`, estimated from their curved tracks; else "".
        """
        stated = self.section.markers.sigma_m
        sigma_m = by_marker(stated, table.names, default=np.nan)
        error_m = interpolation_error(t_s, table.t_s, table.positions_m)
        errors = np.nan_to_num(error_m / sigma_m)
        if not errors.size or errors.max() < LARGEST_INTERPOLATION_SIGMAS:
            return ""
        k = int(errors.argmax())
        return (
            f"resample_hz = {self.section.resample_hz:g} interpolates the markers between frames: "
            f"the estimated error of {table.names[k]} is {1e3 * error_m[k]:.2g} mm RMS, "
            f"{errors[k]:.2g} sigma_m, and enters the residuals; without resample_hz the model is "
            "evaluated at the time of each frame, also of lost or uneven ones"
        )


def by_marker(values: Mapping[str, float] | float, names: Sequence[str], default: float) -> Array:
    """Return the values (M,) of the markers with these names: one number for all, or the number of
    each name, `default` where the mapping has none; entries of other names are ignored.
    """
    by_name = values if isinstance(values, Mapping) else dict.fromkeys(names, values)
    return np.array([by_name.get(name, default) for name in names])


def _require_known_markers(requested: Iterable[str], names: Sequence[str], key: str) -> None:
    present = set(names)
    for name in requested:
        if name not in present:
            known = f"{', '.join(names)}{hint_at(name, names)}"
            raise InputError(f"found {name!r}; expected names of the markers {known}", where=key)


def require_plausible_markers(
    experiment: Experiment, constants: Mapping[str, float], frames_fault: str = ""
) -> None:
    """Raise `InputError` if the tracks cannot belong to this body, because of a wrong unit or
    frame; see `_implausible_markers`.

    Parameters
    ----------
    constants : mapping of str to float
        Physical values by name, for a search of the likely cause.
    frames_fault : str
        Known fault of the frames of poses and markers, which the message begins with; then no other
        cause is sought.
    """
    if (message := _implausible_markers(experiment)) is None:
        return
    if frames_fault:
        raise InputError(f"{frames_fault}; {message}", where="markers")
    raise ImplausibleMarkersError(message, experiment, constants)


def _implausible_markers(experiment: Experiment) -> str | None:
    """Return why the tracks cannot belong to this body, with the remedy, as text; None if they can.

    The sample with most markers is tested: its extent relative to the body, and the distance of
    each marker from the position that follows from the poses of a rigid body. Without a grasp only
    the extent is tested.
    """
    markers = experiment.markers
    body_m = _diagonal(experiment.body.nodes_m)
    k = int(markers.is_complete.sum(axis=1).argmax())
    is_measured = markers.is_complete[k]
    if not is_measured.any():
        return None
    measured = markers.positions_m[k, is_measured]
    span_m = _diagonal(measured)
    if len(measured) > 1 and not LEAST_SPAN * body_m <= span_m <= LARGEST_SPAN * body_m:
        return (
            f"at t = {experiment.t_s[k]:.6g} s the markers span {span_m:.3g} m, but the body "
            f"{body_m:.3g} m; check length_unit of the markers and of the object"
        )
    if not experiment.body_grasps:
        return None
    rigid_positions = markers.predict_positions(experiment.rigid_positions(experiment.t_s[[k]]))[
        0, is_measured
    ]
    miss_m = np.linalg.norm(measured - rigid_positions, axis=1)
    worst = int(miss_m.argmax())
    if miss_m[worst] > LARGEST_MISS * body_m:
        name = markers.names[np.flatnonzero(is_measured)[worst]]
        return (
            f"at t = {experiment.t_s[k]:.6g} s marker {name!r} is measured at "
            f"{point_text(measured[worst])} m, {miss_m[worst]:.3g} m away from the position that "
            f"follows from the pose of the grasp, {point_text(rigid_positions[worst])} m; check "
            "length_unit, the marker's reference_m, that poses and markers share frame and "
            "clock, and that the poses map undeformed to current positions"
        )
    return None


def _diagonal(points_m: Array) -> float:
    return float(np.linalg.norm(np.ptp(points_m, axis=0)))
