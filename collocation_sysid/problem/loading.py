"""From a validated problem file to body, experiments and parameters."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from ..errors import InputError
from ..experiment import Experiment
from ..fem.body import Body
from ..fem.mesh import TetMesh
from ..nlp.parameters import DAMPING, ENGINEERING, LAME, Parameter, Parameters
from .reading import read_problem_file
from .recording import RecordingReader, existing_file
from .schema import ObjectSection, ParameterSection, ParametersSection, ProblemFile

T = TypeVar("T")

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
        And every experiment may be for validation.

    Raises
    ------
    InputError
        One clear message for the first thing that is wrong.
    """
    path = Path(path)
    file, text = read_problem_file(path, overrides)
    if not simulation and all(section.validation for section in file.experiment):
        raise InputError(
            "every experiment has validation = true; expected at least one to fit", path
        )
    folder = path.parent
    mesh = _located(path, "object", lambda: _load_mesh(file.object, folder))
    body = _located(path, "object", lambda: _load_body(file.object, mesh))
    parameters = _located(path, "parameters", lambda: _load_parameters(file.parameters))
    experiments, notes = [], [*mesh.notes, *body.notes]
    for section in file.experiment:
        reader = RecordingReader(section, folder, body, parameters, simulation)
        experiments.append(_located(path, f"experiment '{section.name}'", reader.read))
        notes += reader.notes
    return Problem(path, file, text, body, tuple(experiments), parameters, tuple(notes))


def _located(path: Path, table: str, build: Callable[[], T]) -> T:
    """Run a step of loading; its errors get the file and the table they lack."""
    try:
        return build()
    except InputError as error:
        if error.source is not None:
            raise  # it speaks of a file of its own
        inner = error.where if error.where != table else None
        separator = ": " if " " in table else "."
        where = separator.join(part for part in (table, inner) if part)
        raise InputError(error.message, path, where) from error


def _load_mesh(section: ObjectSection, folder: Path) -> TetMesh:
    if section.mesh is not None:
        file = existing_file(folder, section.mesh, "mesh")
        return TetMesh.read(file, section.length_unit)
    assert section.surface is not None  # by the schema
    assert section.edge_length_m is not None
    surface = existing_file(folder, section.surface, "surface")
    cache = folder / ".meshes"
    return TetMesh.from_surface(surface, section.edge_length_m, section.length_unit, cache)


def _load_body(section: ObjectSection, mesh: TetMesh) -> Body:
    return Body(
        mesh,
        material=section.material,
        density_kg_m3=section.density_kg_m3,
        mass_kg=section.mass_kg,
        element=section.element,
        evaluator=section.evaluator,
    )


def _load_parameters(section: ParametersSection) -> Parameters:
    elastic = LAME if section.lambda_pa is not None else ENGINEERING
    return Parameters(
        tuple(_load_parameter(name, getattr(section, name)) for name in elastic + DAMPING)
    )


def _load_parameter(name: str, section: ParameterSection) -> Parameter:
    if section.fixed is not None:
        return Parameter(name, section.fixed, fixed=True)
    assert section.guess is not None  # by the schema
    low, high = DEFAULT_BOUNDS[name]
    prior = None if section.prior is None else (section.prior.mean, section.prior.relative)
    try:
        return Parameter(
            name, section.guess, section.lower or low, section.upper or high, prior=prior
        )
    except InputError as error:
        if section.lower is not None and section.upper is not None:
            raise
        message = f"{error.message}; where lower or upper is not given, these bounds are assumed"
        raise InputError(message, None, name) from error
