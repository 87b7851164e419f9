"""Reading of a problem file, and its conversion to the arguments of `Problem`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tomli_w
from pydantic import ValidationError

from ..common.declarations import keys_of
from ..common.schema_tables import Section, declared_in
from ..common.step_counting import StepUnit, complete_steps, counted_phase
from ..common.text_files import HAND_WRITTEN_BYTES, parse_toml, read_text
from ..errors import InputError, located
from ..fem.body import Body
from ..fem.laws.constants import (
    DENSITY,
    FRICTION,
    FRICTION_MOMENT,
    MASS,
    NATURAL_ENDS,
    NATURAL_STRAINS,
    Constant,
    NaturalCurvature,
    constant_named,
    is_density,
    with_undamped,
    without_region,
)
from ..fem.laws.fibres import Fibres
from ..fem.meshes.files import length_in_metres
from ..fem.meshes.mesh import TetMesh
from ..fem.meshes.structured import (
    box_of_edge,
    count_box_elements,
    count_cylinder_elements,
    cylinder_of_edge,
)
from ..fem.node_force import NodeForce
from ..fem.regions import Region
from ..fem.rest_shape import UnderGravity
from ..fem.spatial_field import Field
from ..kinds.rod.element import ROD_CURVATURE, CrossSection, RodMesh, rod_mesh
from ..kinds.rod.friction import bending_friction
from ..model.parameters import Parameters, Tied, Unknown
from ..recording import Specimen
from ..recording.homogeneous_deformation import DEFORMATIONS
from ..recording.node_selection import NodesSection, selection_from_section
from ..recording.specimen import cell_body, conditioned
from ..recording.specimen_checks import require_equal_units
from ..recording.time_tables import read_points
from ..statistics.plausibility import SIZES_M, size_and_density_hypotheses
from .code_loader import CodeLoader
from .measurement_section import existing_file
from .options import Origin, RolloutOptions, UncertaintyOptions
from .overrides import apply_override
from .recording_reader import RecordingReader
from .recording_schema import LOADS
from .schema import (
    CodeSection,
    ObjectSection,
    ParameterSection,
    PriorSection,
    ProblemFile,
    RegionSection,
)
from .size import Say, Size, announce_reading, require_feasible
from .specimen_reader import SpecimenReader
from .specimen_schema import SpecimenSection
from .validation_messages import explain_validation_error

# The key of `Experiment` that stands in a table of its own, of all experiments.
AIR_KEY = "air_density_kg_m3"


def read_problem_file(path: str | Path, overrides: Sequence[str] = ()) -> tuple[ProblemFile, str]:
    """Read and validate a problem file.

    Parameters
    ----------
    overrides : sequence of str
        Overrides "dotted.key=value", with values in TOML syntax. Words without quotes are strings.
        Items of a list are selected by index, counted from 0, and tables of a list also by name.

    Returns
    -------
    tuple of ProblemFile and str
        Validated content, and the text of the problem: that of the file, or, with overrides, the
        overridden content written as TOML, without comments.

    Raises
    ------
    InputError
        Names the file, the key or line, what was found and what was expected.
    """
    path = Path(path)
    text = read_text(path, "a problem file (TOML)", HAND_WRITTEN_BYTES)
    content = parse_toml(text, path)
    with located("--set"):
        for override in overrides:
            apply_override(content, override)
    if overrides:
        text = tomli_w.dumps(content)
    try:
        return ProblemFile.model_validate(content), text
    except ValidationError as error:
        raise explain_validation_error(error, content, path=path) from error


def problem_arguments(
    path: Path,
    overrides: Sequence[str],
    allow_code: bool,
    simulation: bool,
    folder: str | Path | None = None,
    say: Say | None = None,
) -> dict[str, Any]:
    """Return the arguments of `Problem` by name, from a problem file and the files it names.

    See `Problem.read` for the parameters. If `folder` is None, it is the folder of the problem
    file; if `say` is None, nothing is announced. Unless the problem is simulated, at least one
    experiment must not be for validation.

    Raises
    ------
    InputError
        For the first mistake, with file and key; see `Problem.read`.
    """
    file, text = read_problem_file(path, overrides)
    if not simulation and all(section.validation for section in file.experiment):
        raise InputError(
            "every experiment has validation = true; expected at least one to fit", path
        )
    folder = path.parent if folder is None else Path(folder)
    unknowns: Sections = file.parameters
    code = CodeLoader(folder, allow_code)
    with located(path):
        for name, method in file.solver.methods.items():
            code.require_harmless(name, method)
    if say is not None:
        announce_reading({*_named_files(file, folder)}, say)
    size = None
    mesh_warnings: list[str] = []
    with _locate_in_table(path, "object"):
        cells = SpecimenCells(file.object, code)
        if file.recordings:
            body, size = _load_object(file, folder, code=code, simulation=simulation, say=say)
            unknowns = _with_natural_strains(unknowns, body)
            mesh_warnings = [oddity.message for oddity in size_and_density_hypotheses(body)]
        else:
            first = file.specimens[0]
            body = cells.body_for(first)
            unknowns = with_undamped(unknowns, body.constants)
    with _locate_in_table(path, "parameters"):
        body_with_friction = body.with_frames(0, frictions=_frictions(file))
        sections = with_declared_densities(unknowns, body_with_friction)
        parameters = Parameters.from_mapping(
            {name: _as_parameter(name, each) for name, each in sections.items()}
        )
        parameters.require_constants_of([body_with_friction, *map(cells.body_for, file.specimens)])
    experiments = []
    notes = []
    specimens: dict[str, Specimen] = {}
    with counted_phase(StepUnit.RECORDING, len(file.experiment)):
        for section in file.experiment:
            where = f"experiment '{section.name}'"
            if isinstance(section, SpecimenSection):
                specimen_reader = SpecimenReader(
                    section, folder, cells.body_for(section), simulation
                )
                with _locate_in_table(path, where):
                    specimens[section.name], experiment = specimen_reader.read()
                notes += specimen_reader.notes
            else:
                reader = RecordingReader(
                    section,
                    folder,
                    body=body,
                    parameters=parameters,
                    simulation=simulation,
                    code=code,
                    air_density_kg_m3=file.environment.air_density_kg_m3,
                    size=size,
                    say=say,
                )
                with _locate_in_table(path, where, odd=mesh_warnings):
                    experiment = reader.read()
                notes += reader.notes
            experiments.append(experiment)
            complete_steps(StepUnit.RECORDING)
    if specimens:
        with located(path):
            require_equal_units(specimens)
    return {
        "experiments": experiments,
        "parameters": parameters,
        **file.transcription.model_dump(),
        "huber": file.solver.huber,
        "method": file.solver.method,
        "methods": file.solver.methods,
        "rollout": RolloutOptions(**file.rollout.model_dump()),
        "uncertainty": UncertaintyOptions(**file.uncertainty.model_dump()),
        "title": file.title,
        "notes": notes,
        "origin": Origin(path, text, files=_named_files(file, folder)),
    }


def _load_object(
    file: ProblemFile, folder: Path, code: CodeLoader, simulation: bool, say: Say | None
) -> tuple[Body, Size]:
    """Return the body, free densities marked, and the size with one sample."""
    with _lengths_checked(file.object):
        generated = _generated_counts(file.object)
        if generated:
            corners, elements = generated
            size = _smallest_size(file, corners=corners, elements=elements, simulation=simulation)
            require_feasible(replace(size, substeps=1))
        mesh = _load_mesh(file, folder)
    size = _smallest_size(
        file, corners=len(mesh.points_m), elements=len(mesh.tetrahedra), simulation=simulation
    )
    require_feasible(replace(size, substeps=1))
    section = file.object
    if isinstance(mesh, RodMesh) and section.mass_per_length_kg_m is not None:
        mass_kg = section.mass_per_length_kg_m * float(mesh.s_m[-1])
        section = section.model_copy(update={"mass_kg": mass_kg})
    body = _load_body(
        with_guessed_densities(section, file.parameters),
        mesh,
        code=code,
        natural_curvature=isinstance(mesh, RodMesh)
        and _natural_curvature(section, file.parameters),
        frictions=[bending_friction()] * (FRICTION_MOMENT.name in file.parameters),
    )
    size = replace(size, nodes=len(body.nodes.points_m))
    require_feasible(replace(size, substeps=1), say)
    return body.with_free_densities(body.parts_with_free_density(file.parameters)), size


class SpecimenCells:
    """Homogeneous cells of specimens of the object's material, each made once.

    Tests that need an inner node have another cell than those that do not, and so have specimens of
    a material with fibres that were cut at different angles.

    Parameters
    ----------
    section : ObjectSection
        Table of the object.
    code : CodeLoader
        Loader of Python files.
    """

    def __init__(self, section: ObjectSection, code: CodeLoader) -> None:
        self._section = section
        self._code = code
        self._bodies: dict[tuple[object, ...], Body] = {}

    def body_for(self, specimen: SpecimenSection) -> Body:
        """Return the cell of a specimen; the same object for all tests with the same kind of cell.

        Raises
        ------
        InputError
            If the material is a Python file that may not be run or is invalid, or has no memory
            although a test is harmonic or has another temperature.
        """
        fibres = fibres_of(self._section, "fibres")
        test, angle_deg = specimen.deformation, specimen.cut_angle_deg
        condition = (
            specimen.modulus == "harmonic",
            specimen.shift,
            specimen.temperature_difference_k,
        )
        cell = (not DEFORMATIONS[test].free, 0.0 if fibres is None else angle_deg, *condition)
        if cell not in self._bodies:
            law = self._section.material
            is_code = isinstance(law, CodeSection)
            material = self._code.material(law, "material") if is_code else law
            body = cell_body(
                test,
                material,
                fibres=fibres,
                cut_angle_deg=angle_deg,
                prony=tuple(b.name for b in self._section.prony if b.region is None),
                damping=self._section.damping,
                made=self._section.made,
            )
            self._bodies[cell] = conditioned(body, *condition)
        return self._bodies[cell]


def _generated_counts(section: ObjectSection) -> tuple[int, int] | None:
    """Return corner nodes and elements of a generated mesh; None from files."""
    if section.is_rod:
        return 3 * section.sections, 3 * section.sections
    length_m = section.edge_length_m
    if length_m is None:
        return None
    if section.box_m is not None:
        return count_box_elements(section.box_m, length_m)
    if (shape := section.cylinder) is not None:
        return count_cylinder_elements(
            shape.diameter_m, shape.height_m, edge_length_m=length_m, quarter=shape.quarter
        )
    return None


def _smallest_size(file: ProblemFile, corners: int, elements: int, *, simulation: bool) -> Size:
    """Return the size of the problem with one sample, before a mesh exists."""
    # A quadratic element has a node on every edge; a mesh has about 7 edges per corner.
    nodes = corners if file.object.element == "tet4" else 8 * corners
    substeps = file.transcription.substeps
    estimated = [
        section
        for section in file.parameters.values()
        if isinstance(section, ParameterSection) and section.fixed is None
    ]
    return Size(
        nodes=nodes,
        elements=elements,
        samples=1,
        substeps=substeps if isinstance(substeps, int) else 1,
        unknowns=0 if simulation else max(1, len(estimated)),
    )


def _named_files(file: ProblemFile, folder: Path) -> tuple[Path, ...]:
    """Return the data files that a problem names, existing or not."""
    names = [file.object.mesh, file.object.surface, file.object.centreline]
    names += [section.file for section in file.specimens]
    for section in file.recordings:
        names += section.list_measurement_files()
        for table in (each for word in LOADS.values() for each in getattr(section, word)):
            keys = [key.name for _, key in keys_of(table.of) if key.constant is not None]
            names += [getattr(table, key) for key in keys]
    return tuple(folder / name for name in names if name is not None)


@contextmanager
def _locate_in_table(path: Path, table: str, odd: Sequence[str] = ()) -> Iterator[None]:
    """Add file and table to errors that have no file; the air's density is in [environment]."""
    try:
        yield
    except InputError as error:
        source = error.source
        where = error.where
        if where == AIR_KEY:
            source = path
            where = f"environment.{AIR_KEY}"
        elif source is None:  # else it speaks of a file of its own
            inner = where if where != table else None
            separator = ": " if " " in table else "."
            source = path
            where = separator.join(part for part in (table, inner) if part)
        raise InputError("; ".join([*odd, error.message]), source, where=where) from error


def _natural_curvature(section: ObjectSection, parameters: Sections) -> NaturalCurvature:
    """Return which natural curvatures a rod has, by the parameters that are stated."""
    stated = {without_region(name) for name in parameters}
    if any(constant.name in stated for constant in NATURAL_ENDS):
        return "affine"
    return section.rest_shape is None or any(each.name in stated for each in NATURAL_STRAINS)


def _with_natural_strains(parameters: Sections, body: Body) -> Sections:
    """Return parameters with all natural curvatures and twists of a rod: zero beside a stated one,
    at the end as at the beginning, and estimated with a prior where neither they nor the rest shape
    are stated.
    """
    names = [[*body.constants][k] for k in body.natural_strain_indices]
    if not names:
        return parameters
    missing: ParameterSection | float = 0.0
    if not any(name in parameters or without_region(name) in parameters for name in names):
        assert isinstance(body.mesh, RodMesh)
        deviation = ROD_CURVATURE / float(body.mesh.s_m[-1])
        prior = {"mean": 0.0, "deviation": deviation}
        missing = ParameterSection.model_validate({"guess": 0.0, "prior": prior})
    complete = dict(parameters)
    for name in names:
        if name not in complete and without_region(name) not in parameters:
            start = name.replace("_end_1_m", "_1_m")
            start = start if start in complete else without_region(start)
            given = complete.get(start, missing)
            if start in complete and isinstance(given, ParameterSection) and given.fixed is None:
                given = ParameterSection.model_validate({"tied_to": start})
            complete[name] = given
    return complete


def _stations_m(file: ProblemFile) -> list[float]:
    """Return the arc lengths that a problem names, where a rod must have sections."""
    stations: list[float] = []
    selections: list[object] = [region.cells for region in file.object.region]
    for experiment in file.recordings:
        stations += experiment.markers.s_m.values()
        placed = (*experiment.grasp_list, *experiment.mass, *experiment.force)
        selections += [getattr(each, "nodes", None) for each in placed]
    for selection in selections:
        if isinstance(selection, NodesSection) and selection.s_m is not None:
            stations += selection.s_m
    return stations


def _load_rod(section: ObjectSection, folder: Path, stations_m: Sequence[float]) -> RodMesh:
    shape = section.section
    assert shape is not None  # by the schema
    if shape.diameter_m is not None:
        with located(where="section"):
            cross = CrossSection.round(shape.diameter_m, shape.inner_m)
    else:
        cross = CrossSection.rectangle(shape.width_m or 0.0, shape.height_m or 0.0)
    if section.centreline is not None:
        points = read_points(existing_file(folder, section.centreline, key="centreline"))
        points = points * length_in_metres(section.length_unit)
    else:
        points = np.array([[0.0, 0.0, 0.0], [section.length_m or 0.0, 0.0, 0.0]])
    thickness_m = 2 * max(cross.extent_m)
    try:
        length_m = float(rod_mesh(points, cross, sections=section.sections).s_m[-1])
        if thickness_m > length_m / 2:
            raise InputError(
                f"found a thickness of {thickness_m:g} m; expected at most half of the length, "
                f"{length_m:g} m; likely {thickness_m / 1e3:g} m, if it was in mm",
                where="section",
            )
        return rod_mesh(
            points,
            cross,
            sections=section.sections,
            # Others are refused where they are read.
            stations_m=[s for s in stations_m if 0 <= s <= length_m],
            first_director=section.first_director,
            is_straight_at_rest=section.rest_shape == "straight",
        )
    except InputError as error:
        where, message = error.where, error.message
        if where == "centreline_m":
            where = "centreline"
        elif where is None:  # the mesh of such sections
            apart = np.linalg.norm(np.diff(points, axis=0), axis=1).sum() / section.sections
            where, message = (
                "sections",
                (
                    f"found {section.sections}, which are {apart:.3g} m apart, "
                    f"{apart / thickness_m:.0f} times the thickness; expected more sections, or a "
                    "length_unit if the centreline is not in m"
                ),
            )
        raise InputError(message, None, where=where) from error


def _grasp_planes_m(file: ProblemFile) -> dict[str, list[float]]:
    """Return the coordinates of the faces of all boxes that select grasped nodes, by axis."""
    grasps = [held for experiment in file.recordings for held in experiment.grasp_list]
    selections = [getattr(held, "nodes", None) for held in grasps]
    boxes = [each.box_m for each in selections if isinstance(each, NodesSection) and each.box_m]
    return {
        axis: sorted({box[k] for pair in boxes for box in pair}) for k, axis in enumerate("xyz")
    }


def _load_mesh(file: ProblemFile, folder: Path) -> TetMesh:
    """Return the mesh of [object]; meshes of surfaces are cached in ``.meshes``."""
    section = file.object
    if section.is_rod:
        return _load_rod(section, folder, _stations_m(file))
    if section.mesh is not None:
        mesh = existing_file(folder, section.mesh, key="mesh")
        return TetMesh.read(mesh, section.length_unit)
    assert section.edge_length_m is not None  # by the schema
    if section.surface is None:
        return _generate_mesh(section, section.edge_length_m)
    surface = existing_file(folder, section.surface, key="surface")
    return TetMesh.from_surface(
        surface,
        section.edge_length_m,
        length_unit=section.length_unit,
        cache=folder / ".meshes",
        planes_m=_grasp_planes_m(file),
    )


def _generate_mesh(section: ObjectSection, edge_length_m: float) -> TetMesh:
    if (shape := section.cylinder) is not None:
        return cylinder_of_edge(
            shape.diameter_m, shape.height_m, edge_length_m=edge_length_m, quarter=shape.quarter
        )
    return box_of_edge(section.box_m or (0.0, 0.0, 0.0), edge_length_m)


@contextmanager
def _lengths_checked(section: ObjectSection) -> Iterator[None]:
    """Turn an `InputError` into one that names an implausible length."""
    if (shape := section.cylinder) is not None:
        lengths_m = {"cylinder.diameter_m": shape.diameter_m, "cylinder.height_m": shape.height_m}
    elif section.is_rod:
        lengths_m = {"length_m": section.length_m or 0.0}
    else:
        lengths_m = {"box_m": max(section.box_m or (0.0,))}
    try:
        yield
    except InputError as error:
        key, length_m = max(lengths_m.items(), key=lambda each: each[1])
        largest_m = SIZES_M[1]
        if length_m <= largest_m:
            raise
        likely = f"likely {length_m / 1e3:g}, if it was in mm"
        message = f"found {length_m:g} m; expected at most {largest_m:g} m, {likely}"
        raise InputError(message, None, where=key) from error


def fibres_of(section: ObjectSection | RegionSection, where: str) -> Fibres | None:
    """Return the fibres that a table states at the key `where`; None without any."""
    if section.fibres is None:
        return None
    with located(where=where):
        return Fibres(**declared_in(section.fibres, where=where))


def _load_body(
    section: ObjectSection,
    mesh: TetMesh,
    code: CodeLoader,
    natural_curvature: NaturalCurvature,
    frictions: Sequence[NodeForce],
) -> Body:
    """Return the body with its materials, regions, forces and fields."""

    def material(law: str | CodeSection | None, key: str) -> Any:
        return code.material(law, key) if isinstance(law, CodeSection) else law

    def branches(region: str | None) -> list[str]:
        return [branch.name for branch in section.prony if branch.region == region]

    def field(section: Section | None, where: str) -> Field | None:
        return None if section is None else Field(**declared_in(section, where=where))

    regions = [
        Region(
            region.name,
            selection_from_section(region.cells),
            material=material(region.material, f"region.{k}.material"),
            density_kg_m3=region.density_kg_m3,
            damping=region.damping,
            prony=branches(region.name) or None,
            field=field(region.field, f"region.{k}.field"),
            fibres=fibres_of(region, f"region.{k}.fibres"),
        )
        for k, region in enumerate(section.region)
    ]
    return Body(
        mesh,
        material=material(section.material, "material"),
        density_kg_m3=section.density_kg_m3,
        mass_kg=section.mass_kg,
        element=section.element,
        damping=section.damping,
        regions=regions,
        prony=branches(None),
        forces=[
            *frictions,
            *(code.force(force, f"force.{k}") for k, force in enumerate(section.force)),
        ],
        field=field(section.field, "field"),
        fibres=fibres_of(section, "fibres"),
        rest_shape=_rest_shape(section),
        made=section.made,
        mesh_from=section.mesh_from,
        material_density_kg_m3=section.material_density_kg_m3,
        natural_curvature=natural_curvature,
    )


def _rest_shape(section: ObjectSection) -> UnderGravity | Literal["stress_free"] | None:
    if section.scan is not None:
        return UnderGravity(selection_from_section(section.scan.nodes), section.scan.gravity_m_s2)
    return "stress_free" if section.rest_shape is not None else None


def _frictions(file: ProblemFile) -> tuple[Constant, ...]:
    """Return each named friction once, in the order of the file."""
    declared = (each.friction for section in file.recordings for each in section.obstacle)
    named = (one for one in declared if isinstance(one, str) and one.endswith(FRICTION.name))
    return tuple(dict.fromkeys(map(constant_named, named)))


def _as_parameter(name: str, section: ParameterSection | float) -> Unknown | Tied | float:
    """Return a fixed value, a `Tied` one (ratio 1 by default) or one to estimate."""
    if not isinstance(section, ParameterSection):
        return section
    if section.fixed is not None:
        return section.fixed
    if section.tied_to is not None:
        return Tied(section.tied_to, 1.0 if section.ratio is None else section.ratio)
    linear = (section.scale or constant_named(name).scale) == "linear"
    return Unknown(
        guess=section.guess,
        lower=section.lower,
        upper=section.upper,
        prior=section.prior and _prior(section.prior, linear),
        scale=section.scale,
        typical=section.typical,
    )


def _prior(section: PriorSection, linear: bool) -> tuple[float, float]:
    """The deviation is absolute for a linear parameter, and relative to the mean otherwise."""
    size = abs(section.mean)
    if linear:
        return section.mean, section.deviation or (section.relative or 0.0) * size
    return section.mean, section.relative or (section.deviation or 0.0) / max(size, 1e-300)


Sections = Mapping[str, ParameterSection | float]


def with_guessed_densities(section: ObjectSection, parameters: Sections) -> ObjectSection:
    """Return a copy of [object] in which missing densities of the body and of regions are guesses
    of parameters (or their prior means or fixed values).

    A region without a density of its own and without a parameter remains without. If the body has
    neither mass nor density, the mass or the density is taken from the parameters. The argument is
    not modified.

    Parameters
    ----------
    parameters : mapping of name to ParameterSection or float
        Table [parameters]; a number is a fixed value.

    Raises
    ------
    InputError
        If the body states neither mass nor density, and the parameters give none or both of them.
    """
    regions = [_with_guessed_density(region, parameters) for region in section.region]
    changes: dict[str, object] = {"region": regions}
    if section.mass_kg is None and section.density_kg_m3 is None:
        guesses = {name: _guess(parameters, name) for name in (DENSITY.name, MASS.name)}
        known = {name: guess for name, guess in guesses.items() if guess is not None}
        if len(known) != 1:
            names = " and ".join(known) or f"no {MASS.name} or {DENSITY.name}"
            of_rod = "mass_per_length_kg_m, " if section.is_rod else ""
            raise InputError(
                f"found {names}; expected exactly one of {of_rod}{MASS.name}, {DENSITY.name}, here "
                "or with a guess in [parameters]"
            )
        changes |= known
    return section.model_copy(update=changes)


def with_declared_densities(
    parameters: Sections, body: Body
) -> dict[str, ParameterSection | float]:
    """Return a copy of [parameters] in which a density or mass that is to be estimated without a
    guess or prior has the value that the body states as its guess; all others are unchanged.
    """
    return {
        name: section.model_copy(update={"guess": _declared_density(body, name)})
        if isinstance(section, ParameterSection)
        and is_density(name)
        and section.fixed is None
        and section.tied_to is None
        and _guess(parameters, name) is None
        else section
        for name, section in parameters.items()
    }


def _with_guessed_density(region: RegionSection, parameters: Sections) -> RegionSection:
    if region.density_kg_m3 is not None:
        return region
    guess = _guess(parameters, f"{region.name}.{DENSITY.name}")
    return region.model_copy(update={DENSITY.name: guess})


def _guess(parameters: Sections, name: str) -> float | None:
    """Return guess, prior mean or fixed value of a parameter; None without."""
    section = parameters.get(name)
    if not isinstance(section, ParameterSection):
        return section
    if section.guess is None and section.prior is not None:
        return section.prior.mean
    return section.fixed if section.guess is None else section.guess


def _declared_density(body: Body, name: str) -> float | None:
    """Return the value that the body states for a density or mass parameter called `name`; None if
    it has none.

    It is the total mass [kg] if that is the parameter, else the density [kg/m³] of the region that
    the name begins with, or, if no part has this name, of the first part without an own density.
    """
    if without_region(name) == MASS.name:
        return body.mass_kg
    region = name.rpartition(".")[0]
    fitting = [part.density_kg_m3 for part in body.parts if part.name == region]
    shared = [part.density_kg_m3 for part in body.parts if not part.has_own_density]
    return next(iter(fitting or shared), None)
