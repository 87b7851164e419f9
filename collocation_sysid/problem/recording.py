"""From an experiment's table and its files to an `Experiment` on one time grid."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ..arrays import Array
from ..errors import InputError, hint_at, located
from ..fem.body import Body
from ..methods.scan import usual_constants
from ..model.parameters import Parameters
from ..recording import (
    Depth,
    DepthCamera,
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
    held_dofs,
    read_displacement,
    read_poses,
    read_wrench,
)
from ..recording.arrays import triple
from ..recording.clock import TIME_TOLERANCE_S
from ..recording.depth import outlined_samples, points_of
from ..recording.formats.depth_files import DepthFile, read_depth
from ..recording.formats.logs import stored_files
from ..recording.formats.units import METRES_PER_UNIT
from ..recording.poses import refuse_untold
from ..recording.tables import read_gauge, within
from ..section import stated_in
from ..stated import keys_of, tables_of
from ..statistics.modal import doubts
from .bench_files import length_m
from .code import Code, existing_file
from .nuisance_schema import nuisance_of
from .recording_schema import (
    ExperimentSection,
    GraspSection,
    ObstacleSection,
    ReadingSection,
    TableSection,
    WrenchSection,
)
from .size import MOST_SAMPLES, Say, Size, require_feasible
from .tracking import gripper_markers, into_body_frame, poses_from_markers, read_recorded

Moved = GraspSection | ObstacleSection

# Markers span about the body's own size and stay near it; a unit mistaken is a factor of 1000.
LEAST_SPAN, LARGEST_SPAN, LARGEST_MISS = 0.005, 10.0, 3.0


@dataclass
class RecordingReader:
    """Reads one experiment's files; `notes` tells what was assumed."""

    section: ExperimentSection
    folder: Path
    body: Body
    parameters: Parameters
    simulation: bool
    code: Code
    air_density_kg_m3: float | Literal["none"]
    notes: list[str] = field(default_factory=list)
    size: Size | None = None
    say: Say | None = None

    def read(self) -> Experiment:
        """Return the experiment.

        Raises
        ------
        InputError
            Naming the file and line, or the key within the experiment's table.
        """
        section = self.section
        t_s, poses, table = self._align([*map(self._poses, range(len(section.moved)))])
        grasps = [self._grasp(k, sequence, t_s) for k, sequence in enumerate(poses)]
        if len(held_dofs(grasps)) == 3 * (n := len(self.body.nodes_m)):
            message = (
                f"the selected nodes are all {n} there are, so nothing can move; select fewer, and "
                "check length_unit of the object"
            )
            raise InputError(message, where="grasp")
        loads: dict[str, Any] = {
            name: [self._made(kind, word, k) for k in range(len(getattr(section, word)))]
            for name, word, kind in tables_of(Experiment)
        }
        experiment = Experiment(
            name=section.name,
            body=self.body,
            t_s=t_s,
            grasps=grasps,
            readings=[self._reading(k, each, t_s) for k, each in enumerate(section.reading)],
            depths=[self._depth(k, t_s) for k in range(len(section.depth))],
            markers=self._markers(t_s, table),
            nuisance=nuisance_of(section.nuisance, self.code.row),
            air_density_kg_m3=self.air_density_kg_m3,
            **stated_in(section, Experiment, ""),
            **loads,
        )
        if section.marked and not self.simulation:
            refuse_other_scale(experiment, usual_constants(self.parameters))
        return experiment

    @property
    def _static(self) -> bool:
        return self.section.kind == "static"

    def _note(self, *notes: str) -> None:
        self.notes += [f"experiment '{self.section.name}': {note}" for note in notes]

    # Files ----------------------------------------------------------------------------------------

    def _is_there(self, name: str | None) -> bool:
        """Whether a file is to be read; a simulation does without where there is none."""
        return not self.simulation or bool(name and stored_files(self.folder / name))

    def _existing(self, name: str | None, key: str, what: str = "a file") -> Path:
        if name is None:
            raise InputError(f"missing; expected {what}", where=key)
        return existing_file(self.folder, name, key)

    def _file(self, table: TableSection, key: str) -> Path:
        """The file of a displacement or a wrench."""
        key = "file" if table.file is None and self.section.file else key
        return self._existing(self.section.file_of(table), key, "a file here, or of the experiment")

    @property
    def _timed(self) -> bool:
        """Whether files must tell times: of equilibria without memory rows are enough."""
        return not self._static or self.body.remembers

    # Grasps ---------------------------------------------------------------------------------------

    def _grasp_key(self, k: int, key: str = "") -> str:
        grasps = len(self.section.grasps)
        one = f"grasp.{k}" if grasps > 1 else "grasp"
        one = one if k < grasps else f"obstacle.{k - grasps}"
        return f"{one}.{key}" if key else one

    def _poses(self, k: int) -> PoseSequence:
        grasp = self.section.moved[k]
        if grasp.markers is not None:
            return self._poses_from_markers(grasp, self._grasp_key(k, "markers"))
        if grasp.displacement is not None:
            file = self._file(grasp.displacement, self._grasp_key(k, "displacement"))
            layout = grasp.displacement.layout
            layout |= {"length_m": length_m(grasp.displacement, self.body)}
            poses = read_displacement(file, **layout, timed=self._timed)
        elif grasp.poses is None:
            return PoseSequence.fixed()
        else:
            file = existing_file(self.folder, grasp.poses, self._grasp_key(k, "poses"))
            poses = read_poses(file, grasp.quaternion, grasp.length_unit)
        if (moved := grasp.gripper_to_body) is not None:
            with located(where=self._grasp_key(k, "gripper_to_body")):
                first = PoseSequence([0.0], [moved.position_m], [moved.quaternion_xyzw])
                poses = poses.after(first)
        return replace(poses, interpolation=grasp.interpolation)

    def _poses_from_markers(self, grasp: Moved, key: str) -> PoseSequence:
        if self._recorded is None:
            message = "there are no tracks to fit the poses to; expected markers.file, or poses"
            raise InputError(message, where=key)
        _refuse_unknown(grasp.markers or (), self._recorded.names, key)
        with located(where=key):
            poses, notes = poses_from_markers(grasp, self._recorded, self.section.window_s)
        self._note(*(f"{key}: {note}" for note in notes))
        return poses

    def _grasp(self, k: int, poses: PoseSequence, t_s: Array) -> Grasp:
        section, zero = self.section.moved[k], ""
        if (table := section.displacement) is not None:
            file = self._file(table, self._grasp_key(k, "displacement"))
            rest_m = length_m(table, self.body)
            zero = displaced_axes(file, table.columns, table.axis, rest_m)
        is_obstacle = isinstance(section, ObstacleSection)
        kind, word = (Obstacle, "force") if is_obstacle else (Grasp, "wrench")
        number = k + 1 - len(self.section.grasps)
        usual = {"name": f"obstacle {number}"} if is_obstacle else {}
        said: dict[str, Any] = usual | stated_in(section, kind, self._grasp_key(k))
        wrench = section.wrench and self._wrench(section.wrench, self._grasp_key(k, word), t_s)
        with located(where=self._grasp_key(k)):
            made = kind(**said, poses=poses, zero=zero, wrench=wrench)
        if is_obstacle:
            return made
        with located(where=self._grasp_key(k, "nodes")):
            return made.on(self.body, t_s)

    # What is measured, and what acts --------------------------------------------------------------

    def _read_wrench(self, section: WrenchSection, key: str) -> tuple[Array, Array]:
        file, layout = self._file(section, f"{key}.file"), section.layout
        return read_wrench(file, **layout, symmetry=section.symmetry, timed=self._timed)

    def _wrench(self, section: WrenchSection, key: str, t_s: Array) -> Wrench:
        """What is measured within the experiment's time; zeros to simulate without a file."""
        name = self.section.file_of(section)
        said: dict[str, Any] = stated_in(section, Wrench, key)
        for sigma in {"sigma_n", "sigma_nm"} & said.keys():
            said[sigma] /= section.symmetry
        with located(where=key):
            if not self._is_there(name):
                return Wrench(t_s, np.zeros((len(t_s), 6)), **{"sigma_nm": 1.0, **said})
            at_s, values = self._read_wrench(section, key)
            inside = within(at_s, t_s, str(name), self._static)
            if self._static and not self.section.marked:
                # Between equilibria it would be read off their chord, unless all of it is.
                near = np.abs(at_s[:, None] - t_s).min(axis=1) <= TIME_TOLERANCE_S
                inside &= near if near.any() else True
            self._note(f"{name}: {inside.sum()} of {len(at_s)} samples are used")
            return Wrench(at_s[inside], values[inside], **said)

    def _reading(self, k: int, section: ReadingSection, t_s: Array) -> Gauge:
        """What is measured within the experiment's time; to be simulated without a file."""
        key = f"reading.{k}"
        told: dict[str, Any] = {"name": section.name, **stated_in(section, Gauge, key)}
        _, told["expression"] = self.code.function(section.code, section.function, f"{key}.code")
        if section.grasp and section.grasp > (count := len(self.section.grasps)):
            message = f"found {section.grasp}; expected the number of a grasp, 1 to {count}"
            raise InputError(message, where=f"{key}.grasp")
        with located(where=key):
            if not self._is_there(section.file):
                return Gauge(t_s=t_s, values=None, **told)
            file = self._existing(section.file, f"{key}.file")
            at_s, values, told["columns"] = read_gauge(file, section.columns)
            inside = within(at_s, t_s, str(section.file), self._static)
            self._note(f"{section.file}: {inside.sum()} of {len(at_s)} samples are used")
            return Gauge(t_s=at_s[inside], values=values[inside], **told)

    def _seen(self, k: int) -> tuple[DepthFile, Array]:
        """What a depth camera saw, and when."""
        section = self.section.depth[k]
        file = self.folder / section.file
        if not file.is_dir():
            file = existing_file(self.folder, section.file, f"depth.{k}.file")
        unit_m, known = METRES_PER_UNIT[section.length_unit], section.camera.model_fields_set
        seen = read_depth(file, section.count_m, unit_m, known)
        count = len(seen.images_m) or len(seen.clouds_m)
        t_s = section.t_s if section.t_s is not None else seen.t_s
        if t_s is None and count > 1 and not self._static:
            message = f"{section.file} says no times of its {count} images; expected them here"
            raise InputError(message, where=f"depth.{k}.t_s")
        times = np.arange(float(count)) if t_s is None else np.array(t_s, dtype=float).ravel()
        if len(times) != count:
            message = f"found {len(times)} times for {count} images or clouds; expected as many"
            raise InputError(message, where=f"depth.{k}.t_s")
        return seen, times

    def _depth(self, k: int, t_s: Array) -> Depth:
        """What was seen within the experiment's time."""
        section, where = self.section.depth[k], f"depth.{k}"
        seen, at_s = self._seen(k)
        names = ("matrix", "pose", "distortion")
        known: dict[str, Any] = {name: getattr(seen, name) for name in names}
        known |= stated_in(section.camera, DepthCamera, f"{where}.camera")
        if section.camera.poses is not None:
            file = existing_file(self.folder, section.camera.poses, f"{where}.camera.poses")
            known["poses"] = read_poses(file)
        with located(where=f"{where}.camera"):
            camera = DepthCamera(
                **{name: value for name, value in known.items() if value is not None}
            )
        with located(where=where):
            inside = within(at_s, t_s, section.file, self._static)
            used = np.flatnonzero(inside).tolist()
            clouds = [seen.clouds_m[k] for k in used] if seen.clouds_m else []
            images, outlined = [], outlined_samples(len(used))
            for number, sample in enumerate(used if len(seen.images_m) else ()):
                image = seen.images_m[sample]
                clouds.append(points_of(image, camera))
                images.append(image if number in outlined else None)
            told = {"name": section.name, **stated_in(section, Depth, where)}
            depth = Depth(t_s=at_s[inside], clouds=clouds, camera=camera, images_m=images, **told)
        self._note(f"{section.file}: {len(clouds)} of {len(at_s)} images are used")
        return depth

    def _made(self, kind: type, word: str, k: int) -> Any:
        """What a table of a list states, on the body."""
        table, where = getattr(self.section, word)[k], f"{word}.{k}"
        usual = {"name": f"{word}_{k + 1}"} if "name" in type(table).model_fields else {}
        said = usual | stated_in(table, kind, where)
        for name, key in keys_of(kind):
            if key.constant and key.read and (named := getattr(table, key.name)):
                file = existing_file(self.folder, named, f"{where}.{key.name}")
                said[name], said[key.constant] = key.read(file)
        with located(where=f"{where}.nodes" if "nodes" in said else where):
            return kind(**said).on(self.body)

    # Markers --------------------------------------------------------------------------------------

    @cached_property
    def _recorded(self) -> MarkerTable | None:
        """All measured tracks that are used, in the body's frame; None to simulate without."""
        markers = self.section.markers
        if not self.section.marked or not self._is_there(markers.file):
            return None
        file = self._existing(markers.file, "markers.file", "a file of marker tracks")
        table = read_recorded(self.section, file)
        self._note(*(f"{markers.file}: {note}" for note in table.notes))
        _refuse_unknown(markers.template_m or (), table.names, "markers.template_m")
        with located(where="markers.template_m"):
            table, notes = into_body_frame(markers, table)
        self._note(*notes)
        return table

    def _table(self, poses: Sequence[PoseSequence]) -> MarkerTable:
        """The measured tracks; to simulate without them, zeros at the poses' times."""
        if not self.section.marked:
            times = self._times(poses)
            return MarkerTable(times, (), np.zeros((len(times), 0, 3)))
        if self._recorded is not None:
            return self._fitted(self._recorded)
        markers = self.section.markers
        names = tuple(markers.names or markers.reference_m)
        lacking = [name for name in names if name not in markers.reference_m]
        if lacking or not names:
            message = (
                f"there is no {markers.file or 'file'} yet and no place for "
                f"{lacking[0] if lacking else 'any marker'}; to simulate, expected an entry "
                "name = [x, y, z] for each marker"
            )
            raise InputError(message, where="markers.reference_m")
        times = self._times(poses)
        return self._fitted(MarkerTable(times, names, np.zeros((len(times), len(names), 3))))

    def _times(self, poses: Sequence[PoseSequence]) -> Array:
        """Those of the wrench where there are no markers, else of the poses."""
        section = self.section
        sensed = [(k, grasp.wrench) for k, grasp in enumerate(section.moved) if grasp.wrench]
        if not (sensed or section.marked or section.reading or section.depth):
            message = "nothing is measured: expected markers, a wrench, a reading, or depth"
            raise InputError(message, where="markers")
        there = [s for s in sensed if stored_files(self.folder / str(section.file_of(s[1])))]
        if there and not section.marked:
            k, sensor = there[0]
            return self._read_wrench(sensor, self._grasp_key(k, "wrench"))[0]
        if self._static and section.depth and max(len(each.t_s) for each in poses) < 2:
            return np.unique(np.concatenate([self._seen(k)[1] for k in range(len(section.depth))]))
        times = max((sequence.t_s for sequence in poses), key=len, default=np.zeros(0))
        fewest = 1 if self._static else 3
        if len(times) < fewest:
            message = (
                f"neither markers.file nor poses with at least {fewest} times are there; "
                "expected one of them, to simulate at its times"
            )
            raise InputError(message, where="grasp")
        return times

    def _fitted(self, table: MarkerTable) -> MarkerTable:
        """The tracks asked for, without the gripper's markers and those of weight 0."""
        markers = self.section.markers
        for key in ("reference_m", "reference_sigma_m", "sigma_m", "weights"):
            if isinstance(by_name := getattr(markers, key), dict):
                _refuse_unknown(by_name, table.names, f"markers.{key}")
        unweighted = [name for name in table.names if markers.weights.get(name) == 0]
        if unweighted:
            self._note(f"left out, with the weight 0: {', '.join(unweighted)}")
        # Markers that only the gripper or the template needs are read, and not fitted.
        wanted = set(markers.names or set(table.names) - gripper_markers(self.section))
        kept = [k for k, n in enumerate(table.names) if n in wanted and n not in unweighted]
        if not kept:
            message = (
                f"none is left of {', '.join(table.names)}: all are the gripper's or have the "
                "weight 0; expected at least one that the body's motion is compared with"
            )
            raise InputError(message, where="markers")
        names = tuple(table.names[k] for k in kept)
        return MarkerTable(table.t_s, names, table.positions_m[:, kept])

    def _align(
        self, poses: list[PoseSequence]
    ) -> tuple[Array, tuple[PoseSequence, ...], MarkerTable]:
        """Times, poses and tracks on one clock."""
        section, table, static = self.section, self._table(poses), self._static
        said = [each.model_dump(include={"from_s", "until_s"}) for each in section.moved]
        held_s = [
            (-np.inf if first is None else first, np.inf if last is None else last)
            for first, last in (each.values() for each in said)
        ]
        moved = [grasp.poses or section.file_of(grasp.displacement) for grasp in section.moved]
        first_s, last_s = section.window_s or (-np.inf, np.inf)
        t_s = table.t_s[table.t_s >= first_s - TIME_TOLERANCE_S]
        t_s = t_s[t_s <= last_s + TIME_TOLERANCE_S]
        for name, sequence, held in zip(moved, poses, held_s, strict=True):
            if name is not None and len(t_s) and not static:
                refuse_untold(sequence, t_s, held, self.folder / name)
        rate_hz = section.resample_hz
        # The files that a simulation writes are thinned when they are read.
        every = 1 if self.simulation else section.every
        if self.size is not None and len(t_s):
            samples = len(t_s) // every
            if rate_hz and not static:
                samples = int(min((t_s[-1] - t_s[0]) * rate_hz, MOST_SAMPLES)) + 1
            require_feasible(replace(self.size, samples=samples), self.say)
        try:
            aligned = align(poses, table, section.window_s, rate_hz, every, held_s, static)
        except InputError as error:
            files = dict.fromkeys(name for name in (*moved, section.markers.file) if name)
            raise InputError(error.message, where=" and ".join(files)) from error
        self._note(*aligned.notes)
        if rate_hz and rate_hz > 1.01 / np.median(np.diff(table.t_s)):
            self._note(
                "resample_hz is above the markers' own rate; interpolated samples count as "
                "measured, so error bars come out too small"
            )
        return aligned.t_s, aligned.poses, aligned.table

    def _markers(self, t_s: Array, table: MarkerTable) -> Markers:
        """Attached where references are given; the others' places are unknown."""
        if not self.section.marked:
            return Markers.none(t_s)
        section, names = self.section.markers, table.names
        sigma_m, known_m = _each(section.sigma_m, names, np.nan), section.reference_sigma_m
        if np.isnan(sigma_m).any():
            lacking = names[int(np.isnan(sigma_m).argmax())]
            message = f"no value for {lacking!r}; expected one for every marker"
            raise InputError(message, where="markers.sigma_m")
        said: dict[str, Any] = stated_in(section, Markers, "markers")
        return Markers(
            t_s,
            table.positions_m,
            sigma_m / np.sqrt(_each(section.weights, names, 1.0)),
            names,
            places_m=np.array([section.reference_m.get(name, [np.nan] * 3) for name in names]),
            places_sigma_m=None if known_m is None else _each(known_m, names, np.nan),
            **said,
        )


def _each(values: Mapping[str, float] | float, names: Sequence[str], usual: float) -> Array:
    """(M,) values of the markers, given for all or by name."""
    by_name = values if isinstance(values, Mapping) else dict.fromkeys(names, values)
    return np.array([by_name.get(name, usual) for name in names])


def _refuse_unknown(asked: Iterable[str], names: Sequence[str], key: str) -> None:
    present = set(names)
    for name in asked:
        if name not in present:
            known = f"{', '.join(names)}{hint_at(name, names)}"
            raise InputError(f"found {name!r}; expected names of the markers {known}", where=key)


def refuse_other_scale(experiment: Experiment, constants: Mapping[str, float]) -> None:
    """Refuse tracks that cannot be of this body: a unit or a frame is mistaken."""
    if (message := _other_scale(experiment)) is None:
        return
    likeliest = "".join(f"; likely {cause.sentence}" for cause in doubts(experiment, constants)[:1])
    raise InputError(message + likeliest, where="markers")


def _other_scale(experiment: Experiment) -> str | None:
    """Why tracks cannot be of this body; None if they can."""
    markers, body_m = experiment.markers, _diagonal(experiment.body.nodes_m)
    k = int(markers.present.sum(axis=1).argmax())
    seen = markers.present[k]
    measured = markers.positions_m[k, seen]
    span_m = _diagonal(measured)
    if len(measured) > 1 and not LEAST_SPAN * body_m <= span_m <= LARGEST_SPAN * body_m:
        return (
            f"at t = {experiment.t_s[k]:.6g} s the markers span {span_m:.3g} m, but the body "
            f"{body_m:.3g} m; check length_unit of the markers and of the object"
        )
    if not experiment.gripping:
        return None
    carried = markers.observe(experiment.rigid_positions(experiment.t_s[[k]]))[0, seen]
    miss_m = np.linalg.norm(measured - carried, axis=1)
    worst = int(miss_m.argmax())
    if miss_m[worst] > LARGEST_MISS * body_m:
        name = markers.names[np.flatnonzero(seen)[worst]]
        return (
            f"at t = {experiment.t_s[k]:.6g} s marker {name!r} is measured at "
            f"{triple(measured[worst])} m, {miss_m[worst]:.3g} m from where the grasp carries its "
            f"place on the body, {triple(carried[worst])} m; check length_unit, the marker's "
            "reference_m, that poses and markers share frame and clock, and that the poses map "
            "undeformed to current positions"
        )
    return None


def _diagonal(points_m: Array) -> float:
    return float(np.linalg.norm(np.ptp(points_m, axis=0)))
