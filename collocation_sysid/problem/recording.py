"""From an experiment's table and its files to an `Experiment` on one time grid."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..errors import InputError, SimulationError, hint_at
from ..experiment import (
    Experiment,
    Force,
    Grasp,
    Markers,
    MarkerTable,
    Nuisance,
    Placement,
    PointMass,
    PoseSequence,
    align,
    held_nodes,
    place_markers,
    read_forces,
    read_poses,
)
from ..fem.body import Body
from ..fem.selection import Ball, Box, Indices, Named, Selection
from ..nlp.newton import Solver
from ..nlp.parameters import Parameters, theta_of
from ..nlp.rest import start_state
from .recording_schema import (
    ExperimentSection,
    ForceSection,
    GraspSection,
    MarkersSection,
    MassSection,
    NodesSection,
    NuisanceSection,
    PosePrior,
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
    if not file.is_file():
        found = "is a folder" if file.is_dir() else "does not exist"
        hint = folder / "README.md"
        see = f"; see {hint} for how to get it" if hint.is_file() else ""
        raise InputError(
            f"{file} {found}; expected a file, named from the problem file's folder{see}", None, key
        )
    return file


def selection(section: NodesSection | str) -> Selection:
    """The node selection that a table, or the name of a point array, describes."""
    if isinstance(section, str):
        return Named(section)
    if section.box_m is not None:
        return Box(*section.box_m)
    if section.ball_m is not None:
        return Ball(*section.ball_m)
    if section.indices is not None:
        return Indices(section.indices)
    assert section.name is not None  # by the schema
    return Named(section.name)


class RecordingReader:
    """Reads one experiment's files; `notes` tells what was assumed."""

    def __init__(
        self,
        section: ExperimentSection,
        folder: Path,
        body: Body,
        parameters: Parameters,
        simulation: bool,
    ) -> None:
        self.section = section
        self.folder = folder
        self.body = body
        self.parameters = parameters
        self.simulation = simulation
        self.notes: list[str] = []

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
            self._grasp(k, grasp, sequence)
            for k, (grasp, sequence) in enumerate(zip(section.grasps, poses, strict=True))
        )
        masses = tuple(self._mass(k, mass) for k, mass in enumerate(section.mass))
        forces = tuple(self._force(k, force) for k, force in enumerate(section.force))

        def build(markers: Markers) -> Experiment:
            return Experiment(
                name=section.name,
                body=self.body,
                t_s=t_s,
                grasps=grasps,
                markers=markers,
                gravity_m_s2=np.array(section.gravity_m_s2),
                start=section.start,
                start_rule=section.start_rule,
                validation=section.validation,
                masses=masses,
                forces=forces,
                nuisance=_nuisance(section.nuisance),
            )

        n = len(self.body.nodes_m)
        if len(held_nodes(grasps)) == n:
            raise InputError(
                f"the selected nodes are all {n} there are, so nothing can move; select fewer, and "
                "check length_unit of the object",
                None,
                "grasp",
            )
        return self._place(t_s, table, build)

    def _grasp_key(self, k: int, key: str) -> str:
        return f"grasp.{k}.{key}" if len(self.section.grasps) > 1 else f"grasp.{key}"

    def _poses(self, k: int, grasp: GraspSection) -> PoseSequence:
        if grasp.markers is not None:
            return self._poses_from_markers(grasp, self._grasp_key(k, "markers"))
        if grasp.poses is None:
            return PoseSequence.fixed()
        file = existing_file(self.folder, grasp.poses, self._grasp_key(k, "poses"))
        poses = read_poses(file, grasp.quaternion, grasp.length_unit)
        return replace(poses, interpolation=grasp.interpolation)

    def _poses_from_markers(self, grasp: GraspSection, key: str) -> PoseSequence:
        if self._recorded is None:
            raise InputError(
                "there are no tracks to fit the poses to; expected markers.file, or poses",
                None,
                key,
            )
        _refuse_unknown(grasp.markers or (), self._recorded.names, key)
        try:
            poses, notes = poses_from_markers(grasp, self._recorded, self.section.window_s)
        except InputError as error:
            raise error.located(None, key) from error
        self._note(*(f"{key}: {note}" for note in notes))
        return poses

    @cached_property
    def _recorded(self) -> MarkerTable | None:
        """All measured tracks that are used, in the body's frame; None to simulate without."""
        markers = self.section.markers
        if markers.file is None and not self.simulation:
            raise InputError("missing; expected a file of marker tracks", None, "markers.file")
        if not markers.file or (self.simulation and not (self.folder / markers.file).exists()):
            return None
        file = existing_file(self.folder, markers.file, "markers.file")
        table = read_recorded(self.section, file)
        self._note(*(f"{markers.file}: {note}" for note in table.notes))
        _refuse_unknown(markers.template_m or (), table.names, "markers.template_m")
        try:
            table, notes = into_body_frame(markers, table)
        except InputError as error:
            raise error.located(None, "markers.template_m") from error
        self._note(*notes)
        return table

    def _note(self, *notes: str) -> None:
        self.notes += [f"experiment '{self.section.name}': {note}" for note in notes]

    def _grasp(self, k: int, grasp: GraspSection, poses: PoseSequence) -> Grasp:
        nodes = self._nodes(grasp.nodes, self._grasp_key(k, "nodes"))
        return Grasp(
            nodes, poses, **grasp.model_dump(include={"from_s", "until_s"}, exclude_none=True)
        )

    def _mass(self, k: int, mass: MassSection) -> PointMass:
        nodes = self._nodes(mass.nodes, f"mass.{k}.nodes")
        return PointMass(nodes, **mass.model_dump(include={"mass_kg", "from_s"}, exclude_none=True))

    def _force(self, k: int, force: ForceSection) -> Force:
        nodes = self._nodes(force.nodes, f"force.{k}.nodes")
        if force.force_n is not None:
            return Force(nodes, np.array(force.force_n))
        assert force.file is not None  # by the schema
        t_s, force_n = read_forces(existing_file(self.folder, force.file, f"force.{k}.file"))
        return Force(nodes, force_n, t_s)

    def _nodes(self, nodes: NodesSection | str, key: str) -> NDArray[np.int64]:
        try:
            return self.body.select(selection(nodes))
        except InputError as error:
            raise InputError(error.message, None, key) from error

    def _table(self, poses: list[PoseSequence]) -> MarkerTable:
        """The measured tracks; to simulate without them, zeros at the poses' times."""
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
        times = max((sequence.t_s for sequence in poses), key=len, default=np.zeros(0))
        if len(times) < 3:
            raise InputError(
                "neither markers.file nor poses with at least 3 times are there; "
                "expected one of them, to simulate at its times",
                None,
                "grasp",
            )
        return self._fitted(MarkerTable(times, names, np.zeros((len(times), len(names), 3))))

    def _fitted(self, table: MarkerTable) -> MarkerTable:
        """The tracks asked for, without the gripper's markers and those of weight 0."""
        markers = self.section.markers
        for key in ("reference_m", "sigma_m", "weights"):
            given = getattr(markers, key)
            _refuse_unknown(given if isinstance(given, dict) else (), table.names, f"markers.{key}")
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
    ) -> tuple[Array, list[PoseSequence], MarkerTable]:
        section = self.section
        files = [grasp.poses for grasp in section.grasps] or [None]
        aligned = []
        t_s, grid = table.t_s, table
        for sequence, file in zip(poses or [PoseSequence.fixed()], files, strict=True):
            try:
                t_s, moved, grid = align(
                    sequence, table, section.window_s, section.resample_hz, section.every
                )
            except InputError as error:
                named = " and ".join(name for name in (file, section.markers.file) if name)
                raise InputError(error.message, None, named) from error
            aligned.append(moved)
        if section.resample_hz and section.resample_hz > 1.01 / np.median(np.diff(table.t_s)):
            self.notes.append(
                f"experiment '{section.name}': resample_hz is above the markers' own rate; "
                "interpolated samples count as measured, so error bars come out too small"
            )
        return t_s, aligned[: len(poses)], grid

    def _place(self, t_s: Array, table: MarkerTable, build: Build) -> Experiment:
        """Attach the markers: by reference where given, else by their first sample."""
        spec, names, nodes_m = self.section.markers, table.names, self.body.nodes_m
        sigma_m = _sigma(spec, names)
        known = [k for k, name in enumerate(names) if name in spec.reference_m]
        others = [k for k, name in enumerate(names) if name not in spec.reference_m]

        def place(chosen: list[int], points_m: Array, shape_m: Array) -> Placement:
            labels = [names[k] for k in chosen]
            return place_markers(
                points_m, shape_m, self.body, spec.attach, spec.max_distance_m, labels
            )

        def with_placement(placement: Placement) -> Experiment:
            return build(Markers(t_s, table.positions_m, sigma_m, names, placement=placement))

        parts = []
        if known:
            references = np.array([spec.reference_m[names[k]] for k in known])
            parts.append(place(known, references, nodes_m))
        if others:
            anywhere = np.repeat(nodes_m[:1], len(names), axis=0)
            provisional = place_markers(anywhere, nodes_m, self.body, "vertex")
            start_m = self._start_shape(with_placement(provisional))
            parts.append(place(others, _first_samples(table)[others], start_m))
        order = np.argsort(known + others)
        experiment = with_placement(
            Placement(
                np.concatenate([part.nodes for part in parts])[order],
                np.concatenate([part.weights for part in parts])[order],
                np.concatenate([part.distance_m for part in parts])[order],
                len(nodes_m),
            )
        )
        if not self.simulation:
            _refuse_other_scale(experiment)
        return experiment

    def _start_shape(self, experiment: Experiment) -> Array:
        theta = theta_of(self.body, self.parameters)
        try:
            x, _ = start_state(experiment, theta, Solver(experiment))
        except SimulationError:
            self.notes.append(
                f"experiment '{self.section.name}': no rest state at the guess; markers without "
                "reference_m were placed on the undeformed shape"
            )
            x = experiment.rigid_positions(experiment.t_s[:1]).ravel()
        return x.reshape(-1, 3)


def _nuisance(section: NuisanceSection | None) -> Nuisance:
    if section is None:
        return Nuisance()
    pose = section.pose or PosePrior.model_construct()
    return Nuisance(
        marker_offset_m=section.marker_offsets and section.marker_offsets.prior_m,
        time_shift_s=section.time_shift and section.time_shift.prior_s,
        pose_turn_rad=pose.prior_rad,
        pose_shift_m=pose.prior_m,
        gravity_rad=section.gravity and section.gravity.prior_rad,
    )


def _refuse_unknown(given: Iterable[str], names: Sequence[str], key: str) -> None:
    for name in given:
        if name not in names:
            hint = hint_at(name, names)
            raise InputError(
                f"found {name!r}; expected names of the markers {', '.join(names)}{hint}", None, key
            )


def _sigma(spec: MarkersSection, names: Sequence[str]) -> Array:
    """Standard deviations (M,) that give each marker its weight: σ/√w."""
    weight = np.array([spec.weights.get(name, 1.0) for name in names])
    if not isinstance(spec.sigma_m, dict):
        return spec.sigma_m / np.sqrt(weight)
    lacking = [name for name in names if name not in spec.sigma_m]
    if lacking:
        raise InputError(
            f"no value for {lacking[0]!r}; expected one for every marker", None, "markers.sigma_m"
        )
    return np.array([spec.sigma_m[name] for name in names]) / np.sqrt(weight)


def _refuse_other_scale(experiment: Experiment) -> None:
    """Refuse tracks that cannot be of this body: a unit or a frame is mistaken."""
    markers, body_m = experiment.markers, _diagonal(experiment.body.nodes_m)
    k = int(markers.present.sum(axis=1).argmax())
    seen = markers.present[k]
    measured = markers.positions_m[k, seen]
    span_m = _diagonal(measured)
    if len(measured) > 1 and not LEAST_SPAN * body_m <= span_m <= LARGEST_SPAN * body_m:
        raise InputError(
            f"at t = {experiment.t_s[k]:.6g} s the markers span {span_m:.3g} m, but the body "
            f"{body_m:.3g} m; check length_unit of the markers and of the object",
            None,
            "markers",
        )
    if not experiment.grasps:
        return
    carried = markers.observe(experiment.rigid_positions(experiment.t_s[[k]]))[0, seen]
    miss_m = np.linalg.norm(measured - carried, axis=1)
    worst = int(miss_m.argmax())
    if miss_m[worst] > LARGEST_MISS * body_m:
        name = markers.names[np.flatnonzero(seen)[worst]]
        raise InputError(
            f"at t = {experiment.t_s[k]:.6g} s marker {name!r} is measured at "
            f"{_triple(measured[worst])} m, {miss_m[worst]:.3g} m from where the grasp carries its "
            f"place on the body, {_triple(carried[worst])} m; check length_unit, the marker's "
            "reference_m, that poses and markers share frame and clock, and that the poses map "
            "undeformed to current positions",
            None,
            "markers",
        )


def _diagonal(points_m: Array) -> float:
    return float(np.linalg.norm(np.ptp(points_m, axis=0)))


def _triple(point: Array) -> str:
    return f"({', '.join(f'{x:.4g}' for x in point)})"


def _first_samples(table: MarkerTable) -> Array:
    """(M, 3) first present sample of every marker, NaN where there is none."""
    present = np.isfinite(table.positions_m[:, :, 0])
    return table.positions_m[present.argmax(axis=0), np.arange(len(table.names))]
