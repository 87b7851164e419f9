"""From a validated problem file to body, experiments and parameters."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, SimulationError
from ..experiment import (
    Experiment,
    Grasp,
    Markers,
    MarkerTable,
    Placement,
    PoseSequence,
    align,
    place_markers,
    read_markers_csv,
    read_poses_csv,
)
from ..fem.body import Body
from ..fem.mesh import TetMesh
from ..fem.selection import Ball, Box, Indices, Named
from ..nlp.parameters import DAMPING, ENGINEERING, LAME, Parameter, Parameters
from ..nlp.simulation import Solver, start_state
from .reading import read_problem_file
from .schema import (
    ExperimentSection,
    GraspSection,
    MarkersSection,
    NodesSection,
    ObjectSection,
    ParametersSection,
    ProblemFile,
)

Array = NDArray[np.float64]
T = TypeVar("T")
Build = Callable[[Markers], Experiment]

# Bounds of parameters that state none: wide enough for foams and rubbers alike.
DEFAULT_BOUNDS = {
    "lambda_pa": (1.0, 1e9),
    "mu_pa": (1.0, 1e9),
    "young_pa": (1.0, 1e9),
    "poisson": (1e-3, 0.495),
    "gamma_r_s": (1e-7, 10.0),
    "gamma_m_1_s": (1e-4, 1e4),
}


@dataclass(frozen=True, eq=False)
class Problem:
    """A loaded problem: everything a method needs.

    Attributes
    ----------
    path : Path of the problem file
    file : ProblemFile, validated
    text : str, the problem as run
    body : Body
    experiments : tuple of Experiment, those for validation included
    parameters : Parameters
    notes : tuple of str, what was cleaned or assumed on the way
    """

    path: Path
    file: ProblemFile
    text: str
    body: Body
    experiments: tuple[Experiment, ...]
    parameters: Parameters
    notes: tuple[str, ...]


def load_problem(
    path: str | Path, overrides: Sequence[str] = (), simulation: bool = False
) -> Problem:
    """Load a problem file and the files it names.

    Parameters
    ----------
    path : str or Path
    overrides : sequence of "dotted.key=value"
    simulation : bool
        Markers need no file then: those with a `reference_m` are sampled at the poses' times.

    Raises
    ------
    InputError
        One clear message for the first thing that is wrong.
    """
    path = Path(path)
    file, text = read_problem_file(path, overrides)
    folder = path.parent
    mesh = _load_mesh(file.object, folder, path)
    body = _at(
        path, "object",
        lambda: Body(
            mesh,
            material=file.object.material,
            density_kg_m3=file.object.density_kg_m3,
            mass_kg=file.object.mass_kg,
            element=file.object.element,
            evaluator=file.object.evaluator,
        ),
    )  # fmt: skip
    parameters = _at(path, "parameters", lambda: _load_parameters(file.parameters))
    experiments, notes = [], list(mesh.notes)
    for section in file.experiment:
        where = f"experiment '{section.name}'"
        reader = _ExperimentReader(section, folder, body, parameters, simulation)
        experiments.append(_at(path, where, reader.read))
        notes += reader.notes
    return Problem(path, file, text, body, tuple(experiments), parameters, tuple(notes))


def _at(path: Path, where: str, build: Callable[[], T]) -> T:
    """Run a step of loading; its errors get the file and key they lack."""
    try:
        return build()
    except InputError as error:
        if error.source is not None and error.where is None:
            raise  # it already speaks of a file of its own
        raise error.located(path, where) from error


def _load_mesh(section: ObjectSection, folder: Path, path: Path) -> TetMesh:
    if section.mesh is not None:
        return TetMesh.read(_existing(folder / section.mesh, path, "object.mesh"), section.length_unit)
    assert section.surface is not None and section.edge_length_m is not None  # schema
    surface = _existing(folder / section.surface, path, "object.surface")
    return TetMesh.from_surface(
        surface, section.edge_length_m, section.length_unit, cache=folder / ".meshes"
    )


def _existing(file: Path, path: Path, where: str) -> Path:
    if not file.is_file():
        raise InputError(f"there is no file {file}", path, where)
    return file


def _load_parameters(section: ParametersSection) -> Parameters:
    elastic = LAME if section.lambda_pa is not None else ENGINEERING
    items = []
    for name in elastic + DAMPING:
        item = getattr(section, name)
        if item.fixed is not None:
            items.append(Parameter(name, item.fixed, fixed=True))
            continue
        low, high = DEFAULT_BOUNDS[name]
        prior = None if item.prior is None else (item.prior.mean, item.prior.relative)
        items.append(
            Parameter(name, item.guess, item.lower or low, item.upper or high, prior=prior)
        )
    return Parameters(tuple(items))


def selection(section: NodesSection) -> Box | Ball | Indices | Named:
    """The node selection a table describes."""
    if section.box_m is not None:
        return Box(*section.box_m)
    if section.ball_m is not None:
        return Ball(*section.ball_m)
    if section.indices is not None:
        return Indices(section.indices)
    assert section.name is not None  # schema
    return Named(section.name)


class _ExperimentReader:
    """Reads one experiment's files and puts them on one time grid."""

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
        section = self.section
        poses = [self._poses(k, grasp) for k, grasp in enumerate(section.grasp)]
        table = self._table(poses)
        t_s, poses, table = self._align(poses, table)
        grasps = tuple(
            Grasp(self._nodes(k, grasp), sequence)
            for k, (grasp, sequence) in enumerate(zip(section.grasp, poses, strict=True))
        )

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
            )

        return self._place(t_s, table, build)

    def _file(self, name: str, key: str) -> Path:
        file = self.folder / name
        if not file.is_file():
            hint = self.folder / "README.md"
            see = f"; see {hint} for how to get it" if hint.is_file() else ""
            raise InputError(f"{key} names {file}, which does not exist{see}")
        return file

    def _poses(self, k: int, grasp: GraspSection) -> PoseSequence:
        if grasp.poses is None:
            return PoseSequence.fixed()
        poses = read_poses_csv(self._file(grasp.poses, f"grasp.{k}.poses"))
        return replace(poses, interpolation=grasp.interpolation)

    def _nodes(self, k: int, grasp: GraspSection) -> NDArray[np.int64]:
        try:
            return self.body.mesh.select(selection(grasp.nodes))
        except InputError as error:
            raise InputError(f"grasp.{k}.nodes: {error.message}") from error

    def _table(self, poses: list[PoseSequence]) -> MarkerTable:
        markers = self.section.markers
        if markers.file is not None and not self.simulation:
            return read_markers_csv(
                self._file(markers.file, "markers.file"), markers.names, markers.length_unit
            )
        if markers.file is not None and (self.folder / markers.file).is_file():
            return read_markers_csv(self.folder / markers.file, markers.names, markers.length_unit)
        if not self.simulation:
            raise InputError("markers.file is missing; expected a markers CSV")
        names = tuple(markers.names or markers.reference_m)
        if not names:
            raise InputError("markers has neither a file nor reference_m: nothing to simulate")
        times = max((sequence.t_s for sequence in poses), key=len, default=np.zeros(0))
        if len(times) < 3:
            raise InputError("without a markers file the poses must give at least 3 times")
        return MarkerTable(times, names, np.zeros((len(times), len(names), 3)))

    def _align(
        self, poses: list[PoseSequence], table: MarkerTable
    ) -> tuple[Array, list[PoseSequence], MarkerTable]:
        section = self.section
        files = [grasp.poses for grasp in section.grasp] or [None]
        aligned = []
        t_s, grid = table.t_s, table
        for sequence, file in zip(poses or [PoseSequence.fixed()], files, strict=True):
            try:
                t_s, moved, grid = align(sequence, table, section.window_s, section.resample_hz)
            except InputError as error:
                named = [name for name in (file, section.markers.file) if name]
                raise error.located(None, " against ".join(named)) from error
            aligned.append(moved)
        if section.resample_hz is not None and section.resample_hz > 1.01 / float(
            np.median(np.diff(table.t_s))
        ):
            self.notes.append(
                f"experiment '{section.name}': resample_hz is above the markers' own rate; "
                "interpolated samples count as measured, so error bars come out too small"
            )
        return t_s, aligned[: len(poses)], grid

    def _place(self, t_s: Array, table: MarkerTable, build: Build) -> Experiment:
        """Attach the markers: by reference where given, else by their first sample."""
        spec, names, nodes_m = self.section.markers, table.names, self.body.nodes_m
        for name in spec.reference_m:
            if name not in names:
                raise InputError(
                    f"markers.reference_m names {name!r}; the markers are {', '.join(names)}"
                )
        sigma_m = self._sigma(spec, names)
        known = [k for k, name in enumerate(names) if name in spec.reference_m]
        others = [k for k, name in enumerate(names) if name not in spec.reference_m]

        def place(chosen: list[int], points_m: Array, shape_m: Array) -> Placement:
            labels = [names[k] for k in chosen]
            return place_markers(
                points_m, shape_m, self.body, spec.attach, spec.max_distance_m, labels
            )

        def with_placement(placement: Placement) -> Experiment:
            return build(Markers(names, t_s, table.positions_m, sigma_m, placement))

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
        return with_placement(
            Placement(
                np.concatenate([part.nodes for part in parts])[order],
                np.concatenate([part.weights for part in parts])[order],
                np.concatenate([part.distance_m for part in parts])[order],
                len(nodes_m),
            )
        )

    def _start_shape(self, experiment: Experiment) -> Array:
        theta = self.parameters.theta(self.parameters.guess_q)
        try:
            x, _ = start_state(experiment, theta, Solver(experiment))
        except SimulationError:
            self.notes.append(
                f"experiment '{self.section.name}': no rest state at the guess; markers without "
                "reference_m were placed on the undeformed shape"
            )
            x = experiment.rigid_positions(experiment.t_s[:1]).ravel()
        return x.reshape(-1, 3)

    def _sigma(self, spec: MarkersSection, names: Sequence[str]) -> Array:
        if not isinstance(spec.sigma_m, dict):
            return np.full(len(names), spec.sigma_m)
        lacking = [name for name in names if name not in spec.sigma_m]
        if lacking:
            raise InputError(f"markers.sigma_m has no value for {lacking[0]!r}")
        return np.array([spec.sigma_m[name] for name in names])


def _first_samples(table: MarkerTable) -> Array:
    """(M, 3) first present sample of every marker, NaN where there is none."""
    present = np.isfinite(table.positions_m[:, :, 0])
    return table.positions_m[present.argmax(axis=0), np.arange(len(table.names))]
