"""From an experiment's table and its files to an `Experiment` on one time grid."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..errors import InputError, hint_at, located
from ..fem.body import Body
from ..files import require_regular
from ..methods.scan import usual_constants
from ..model.parameters import Parameters
from ..recording import (
    Experiment,
    Gauge,
    Grasp,
    Markers,
    MarkerTable,
    PoseSequence,
    Wrench,
    align,
    displaced_axes,
    held_dofs,
    read_displacement,
    read_poses,
    read_wrench,
)
from ..recording.clock import TIME_TOLERANCE_S
from ..recording.nuisance import NuisanceRow
from ..recording.poses import refuse_untold
from ..recording.tables import read_gauge, within
from ..section import Section, stated_in
from ..stated import keys_of, tables_of
from ..statistics.modal import doubts
from .nuisance_schema import OwnRow, nuisance_of
from .recording_schema import (
    ExperimentSection,
    GraspSection,
    MarkersSection,
    ReadingSection,
    TableSection,
    WrenchSection,
)
from .tracking import gripper_markers, into_body_frame, poses_from_markers, read_recorded

Build = Callable[[Markers], Experiment]

# Markers span about the body's own size and stay near it; a unit mistaken is a factor of 1000.
LEAST_SPAN, LARGEST_SPAN, LARGEST_MISS = 0.005, 10.0, 3.0


def existing_file(folder: Path, name: str, key: str) -> Path:
    """The file that a key of the problem file names.

    Raises
    ------
    InputError
        If there is none.
    """
    file = folder / name
    require_regular(file, key)
    if not file.is_file():
        found = "is a folder" if file.is_dir() else "does not exist"
        hint = folder / "README.md"
        see = f"; see {hint} for how to get it" if hint.is_file() else ""
        raise InputError(
            f"{file} {found}; expected a file, named from the problem file's folder{see}", None, key
        )
    return file


@dataclass
class RecordingReader:
    """Reads one experiment's files; `notes` tells what was assumed."""

    section: ExperimentSection
    folder: Path
    body: Body
    parameters: Parameters
    simulation: bool
    row_of: Callable[[OwnRow], NuisanceRow]
    expression_of: Callable[[ReadingSection, str], Callable[..., Any]]
    notes: list[str] = field(default_factory=list)

    def read(self) -> Experiment:
        """Return the experiment.

        Raises
        ------
        InputError
            Naming the file and line, or the key within the experiment's table.
        """
        section = self.section
        poses = [self._poses(k, grasp) for k, grasp in enumerate(section.grasps)]
        table = self._table(poses)
        t_s, poses, table = self._align(poses, table)
        grasps = tuple(
            self._grasp(k, grasp, sequence, t_s)
            for k, (grasp, sequence) in enumerate(zip(section.grasps, poses, strict=True))
        )
        loads: dict[str, Any] = {
            name: self._made(word, kind) for name, word, kind in tables_of(Experiment)
        }
        readings = [self._reading(k, each, t_s) for k, each in enumerate(section.reading)]

        def build(markers: Markers) -> Experiment:
            return Experiment(
                name=section.name,
                body=self.body,
                t_s=t_s,
                grasps=grasps,
                markers=markers,
                readings=readings,
                nuisance=nuisance_of(section.nuisance, self.row_of),
                **stated_in(section, Experiment, ""),
                **loads,
            )

        n = len(self.body.nodes_m)
        if len(held_dofs(grasps)) == 3 * n:
            raise InputError(
                f"the selected nodes are all {n} there are, so nothing can move; select fewer, and "
                "check length_unit of the object",
                None,
                "grasp",
            )
        return self._place(t_s, table, build)

    def _grasp_key(self, k: int, key: str = "") -> str:
        one = f"grasp.{k}" if len(self.section.grasps) > 1 else "grasp"
        return f"{one}.{key}" if key else one

    def _poses(self, k: int, grasp: GraspSection) -> PoseSequence:
        if grasp.markers is not None:
            return self._poses_from_markers(grasp, self._grasp_key(k, "markers"))
        if grasp.displacement is not None:
            file = self._file(grasp.displacement, self._grasp_key(k, "displacement"))
            moved = read_displacement(file, **grasp.displacement.layout, timed=self._timed)
            return replace(moved, interpolation=grasp.interpolation)
        if grasp.poses is None:
            return PoseSequence.fixed()
        file = existing_file(self.folder, grasp.poses, self._grasp_key(k, "poses"))
        poses = read_poses(file, grasp.quaternion, grasp.length_unit)
        if grasp.gripper_to_body is not None:
            poses = poses.after(grasp.gripper_to_body.matrix)
        return replace(poses, interpolation=grasp.interpolation)

    def _poses_from_markers(self, grasp: GraspSection, key: str) -> PoseSequence:
        if self._recorded is None:
            raise InputError(
                "there are no tracks to fit the poses to; expected markers.file, or poses",
                None,
                key,
            )
        _refuse_unknown(grasp.markers or (), self._recorded.names, key)
        with located(where=key):
            poses, notes = poses_from_markers(grasp, self._recorded, self.section.window_s)
        self._note(*(f"{key}: {note}" for note in notes))
        return poses

    @cached_property
    def _recorded(self) -> MarkerTable | None:
        """All measured tracks that are used, in the body's frame; None to simulate without."""
        markers = self.section.markers
        if not self.section.marked:
            return None
        if markers.file is None and not self.simulation:
            raise InputError("missing; expected a file of marker tracks", None, "markers.file")
        if not markers.file or (self.simulation and not (self.folder / markers.file).exists()):
            return None
        file = existing_file(self.folder, markers.file, "markers.file")
        table = read_recorded(self.section, file)
        self._note(*(f"{markers.file}: {note}" for note in table.notes))
        _refuse_unknown(markers.template_m or (), table.names, "markers.template_m")
        with located(where="markers.template_m"):
            table, notes = into_body_frame(markers, table)
        self._note(*notes)
        return table

    def _note(self, *notes: str) -> None:
        self.notes += [f"experiment '{self.section.name}': {note}" for note in notes]

    def _grasp(self, k: int, grasp: GraspSection, poses: PoseSequence, t_s: Array) -> Grasp:
        where = self._grasp_key(k, "wrench")
        made = Grasp(
            **stated_in(grasp, Grasp, self._grasp_key(k)),
            poses=poses,
            zero=self._zero(k, grasp),
            wrench=grasp.wrench and self._wrench(grasp.wrench, where, t_s),
        )
        with located(where=self._grasp_key(k, "nodes")):
            return made.on(self.body, t_s)

    def _zero(self, k: int, grasp: GraspSection) -> str:
        """The axes of its displacement."""
        if (table := grasp.displacement) is None:
            return ""
        file = self._file(table, self._grasp_key(k, "displacement"))
        return displaced_axes(file, table.columns, table.axis, table.length_m)

    def _file(self, table: TableSection, key: str) -> Path:
        """The file of a displacement or a wrench."""
        name = self.section.file_of(table)
        if name is None:
            raise InputError("missing; expected a file here, or of the experiment", None, key)
        return existing_file(self.folder, name, key if table.file else "file")

    @property
    def _timed(self) -> bool:
        """Whether files must tell times: of equilibria without memory rows are enough."""
        return self.section.kind != "static" or self.body.remembers

    def _read_wrench(self, section: WrenchSection, key: str) -> tuple[Array, Array]:
        file, layout = self._file(section, f"{key}.file"), section.layout
        return read_wrench(file, **layout, symmetry=section.symmetry, timed=self._timed)

    def _wrench(self, section: WrenchSection, key: str, t_s: Array) -> Wrench:
        """What is measured within the experiment's time; zeros to simulate without a file."""
        name = str(self.section.file_of(section))
        said: dict[str, Any] = stated_in(section, Wrench, key)
        for sigma in ("sigma_n", "sigma_nm"):
            if sigma in said:
                said[sigma] /= section.symmetry
        with located(where=key):
            if self.simulation and not (self.folder / name).exists():
                said.setdefault("sigma_nm", 1.0)
                return Wrench(t_s, np.zeros((len(t_s), 6)), **said)
            at_s, values = self._read_wrench(section, key)
            static = self.section.kind == "static"
            inside = within(at_s, t_s, name, static)
            if static and not self.section.marked:
                inside &= _among(at_s, t_s)
            self._note(f"{name}: {inside.sum()} of {len(at_s)} samples are used")
            return Wrench(at_s[inside], values[inside], **said)

    def _reading(self, k: int, section: ReadingSection, t_s: Array) -> Gauge:
        """What is measured within the experiment's time; to be simulated without a file."""
        key = f"reading.{k}"
        told: dict[str, Any] = {"name": section.name, **stated_in(section, Gauge, key)}
        told["expression"] = self.expression_of(section, key)
        if (told.get("grasp") or 0) >= (count := len(self.section.grasps)):
            message = f"found {section.grasp}; expected the number of a grasp, 1 to {count}"
            raise InputError(message, None, f"{key}.grasp")
        with located(where=key):
            if self.simulation and not (section.file and (self.folder / section.file).exists()):
                return Gauge(t_s=t_s, values=None, **told)
            if section.file is None:
                raise InputError("missing; expected a file", None, f"{key}.file")
            file = existing_file(self.folder, section.file, f"{key}.file")
            at_s, values, told["columns"] = read_gauge(file, section.columns)
            inside = within(at_s, t_s, section.file, self.section.kind == "static")
            self._note(f"{section.file}: {inside.sum()} of {len(at_s)} samples are used")
            return Gauge(t_s=at_s[inside], values=values[inside], **told)

    def _made(self, word: str, kind: type) -> tuple[Any, ...]:
        """What the tables of a word state, on the body."""
        return tuple(
            self._one_made(kind, table, f"{word}.{k}", f"{word}_{k + 1}")
            for k, table in enumerate(getattr(self.section, word))
        )

    def _one_made(self, kind: type, table: Section, where: str, name: str) -> Any:
        usual = {"name": name} if "name" in type(table).model_fields else {}
        said = usual | stated_in(table, kind, where)
        for name, key in keys_of(kind):
            if key.constant and key.read and (named := getattr(table, key.name)):
                file = existing_file(self.folder, named, f"{where}.{key.name}")
                said[name], said[key.constant] = key.read(file)
        with located(where=f"{where}.nodes" if "nodes" in said else where):
            return kind(**said).on(self.body)

    def _table(self, poses: list[PoseSequence]) -> MarkerTable:
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
            raise InputError(
                f"there is no {markers.file or 'file'} yet and no place for "
                f"{lacking[0] if lacking else 'any marker'}; to simulate, expected an entry "
                "name = [x, y, z] for each marker",
                None,
                "markers.reference_m",
            )
        times = self._times(poses)
        return self._fitted(MarkerTable(times, names, np.zeros((len(times), len(names), 3))))

    def _times(self, poses: list[PoseSequence]) -> Array:
        """Those of the wrench where there are no markers, else of the poses."""
        section = self.section
        sensed = [(k, grasp.wrench) for k, grasp in enumerate(section.grasps) if grasp.wrench]
        if not (sensed or section.marked or section.reading):
            raise InputError(
                "nothing is measured: expected markers, the wrench of a grasp, or a reading",
                None,
                "markers",
            )
        there = [s for s in sensed if (self.folder / str(section.file_of(s[1]))).exists()]
        if there and not section.marked:
            k, sensor = there[0]
            return self._read_wrench(sensor, self._grasp_key(k, "wrench"))[0]
        times = max((sequence.t_s for sequence in poses), key=len, default=np.zeros(0))
        fewest = 1 if self.section.kind == "static" else 3
        if len(times) < fewest:
            raise InputError(
                f"neither markers.file nor poses with at least {fewest} times are there; "
                "expected one of them, to simulate at its times",
                None,
                "grasp",
            )
        return times

    def _fitted(self, table: MarkerTable) -> MarkerTable:
        """The tracks asked for, without the gripper's markers and those of weight 0."""
        markers = self.section.markers
        for key in ("reference_m", "reference_sigma_m", "sigma_m", "weights"):
            by_name = getattr(markers, key)
            _refuse_unknown(
                by_name if isinstance(by_name, dict) else (), table.names, f"markers.{key}"
            )
        unweighted = [name for name in table.names if markers.weights.get(name) == 0]
        if unweighted:
            self._note(f"left out, with the weight 0: {', '.join(unweighted)}")
        # Markers that only the gripper or the template needs are read, and not fitted.
        wanted = set(markers.names or set(table.names) - gripper_markers(self.section))
        kept = [k for k, n in enumerate(table.names) if n in wanted and n not in unweighted]
        if not kept:
            raise InputError(
                f"none is left of {', '.join(table.names)}: all are the gripper's or have the "
                "weight 0; expected at least one that the body's motion is compared with",
                None,
                "markers",
            )
        names = tuple(table.names[k] for k in kept)
        return MarkerTable(table.t_s, names, table.positions_m[:, kept])

    def _align(
        self, poses: list[PoseSequence], table: MarkerTable
    ) -> tuple[Array, tuple[PoseSequence, ...], MarkerTable]:
        section = self.section
        held_s = [
            (-np.inf if g.from_s is None else g.from_s, np.inf if g.until_s is None else g.until_s)
            for g in section.grasps
        ]
        if section.kind != "static":
            self._refuse_untold(poses, table.t_s, held_s)
        try:
            aligned = align(
                poses,
                table,
                section.window_s,
                section.resample_hz,
                section.every,
                held_s,
                section.kind == "static",
            )
        except InputError as error:
            files = [*self._moved, section.markers.file]
            named = " and ".join(dict.fromkeys(name for name in files if name))
            raise InputError(error.message, None, named) from error
        self._note(*aligned.notes)
        if section.resample_hz and section.resample_hz > 1.01 / np.median(np.diff(table.t_s)):
            self._note(
                "resample_hz is above the markers' own rate; interpolated samples count as "
                "measured, so error bars come out too small"
            )
        return aligned.t_s, aligned.poses, aligned.table

    @property
    def _moved(self) -> list[str | None]:
        """The file of each grasp that tells how it moves, where it has one."""
        return [
            grasp.poses or self.section.file_of(grasp.displacement) for grasp in self.section.grasps
        ]

    def _refuse_untold(
        self, poses: list[PoseSequence], t_s: Array, held_s: Sequence[tuple[float, float]]
    ) -> None:
        """Refuse files of poses that do not tell the motion over the recording."""
        first_s, last_s = self.section.window_s or (-np.inf, np.inf)
        t_s = t_s[(t_s >= first_s - TIME_TOLERANCE_S) & (t_s <= last_s + TIME_TOLERANCE_S)]
        for name, sequence, held in zip(self._moved, poses, held_s, strict=True):
            if name is not None and len(t_s):
                refuse_untold(sequence, t_s, held, self.folder / name)

    def _place(self, t_s: Array, table: MarkerTable, build: Build) -> Experiment:
        """Attach the markers where references are given; the others' places are unknown."""
        if not self.section.marked:
            return build(Markers.none(t_s))
        spec, names = self.section.markers, table.names
        sigma_m = spec.reference_sigma_m
        markers = Markers(
            t_s,
            table.positions_m,
            _sigma(spec, names),
            names,
            places_m=np.array([spec.reference_m.get(name, [np.nan] * 3) for name in names]),
            places_sigma_m=None if sigma_m is None else _each(sigma_m, names, np.nan),
            on_surface=spec.places == "surface",
            attach=spec.attach,
            max_distance_m=spec.max_distance_m,
        )
        experiment = build(markers)
        if not self.simulation:
            refuse_other_scale(experiment, usual_constants(self.parameters))
        return experiment


def _among(at_s: Array, t_s: Array) -> NDArray[np.bool_]:
    """Which samples are at equilibria: between two, a wrench would be read off their chord.

    All of a sensor that was read at other times.
    """
    apart_s = np.abs(at_s[:, None] - t_s).min(axis=1)
    near = apart_s <= TIME_TOLERANCE_S
    return near if near.any() else np.ones(len(at_s), dtype=bool)


def _each(values: Mapping[str, float] | float, names: Sequence[str], usual: float) -> Array:
    """(M,) values of the markers, given for all or by name."""
    by_name = values if isinstance(values, Mapping) else dict.fromkeys(names, values)
    return np.array([by_name.get(name, usual) for name in names])


def _refuse_unknown(asked: Iterable[str], names: Sequence[str], key: str) -> None:
    for name in asked:
        if name not in names:
            hint = hint_at(name, names)
            raise InputError(
                f"found {name!r}; expected names of the markers {', '.join(names)}{hint}", None, key
            )


def _sigma(spec: MarkersSection, names: Sequence[str]) -> Array:
    """Standard deviations (M,) that give each marker its weight: σ/√w."""
    sigma_m = _each(spec.sigma_m, names, np.nan)
    if np.isnan(sigma_m).any():
        lacking = names[int(np.isnan(sigma_m).argmax())]
        message = f"no value for {lacking!r}; expected one for every marker"
        raise InputError(message, None, "markers.sigma_m")
    return sigma_m / np.sqrt(_each(spec.weights, names, 1.0))


def refuse_other_scale(experiment: Experiment, constants: Mapping[str, float]) -> None:
    """Refuse tracks that cannot be of this body: a unit or a frame is mistaken."""
    if (message := _other_scale(experiment)) is None:
        return
    likeliest = "".join(f"; likely {cause.sentence}" for cause in doubts(experiment, constants)[:1])
    raise InputError(message + likeliest, None, "markers")


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
    if not experiment.grasps:
        return None
    carried = markers.observe(experiment.rigid_positions(experiment.t_s[[k]]))[0, seen]
    miss_m = np.linalg.norm(measured - carried, axis=1)
    worst = int(miss_m.argmax())
    if miss_m[worst] > LARGEST_MISS * body_m:
        name = markers.names[np.flatnonzero(seen)[worst]]
        return (
            f"at t = {experiment.t_s[k]:.6g} s marker {name!r} is measured at "
            f"{_triple(measured[worst])} m, {miss_m[worst]:.3g} m from where the grasp carries its "
            f"place on the body, {_triple(carried[worst])} m; check length_unit, the marker's "
            "reference_m, that poses and markers share frame and clock, and that the poses map "
            "undeformed to current positions"
        )
    return None


def _diagonal(points_m: Array) -> float:
    return float(np.linalg.norm(np.ptp(points_m, axis=0)))


def _triple(point: Array) -> str:
    return f"({', '.join(f'{x:.4g}' for x in point)})"
