"""Synthetic recordings: simulation of a problem's experiments, written as a laboratory would.

`write_data` is for testing a setup before a measurement, and for studies with known parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from ..common.files import replaced_file
from ..common.text_files import parse_toml
from ..common.validated_classes import validated
from ..common.validated_types import Count, NotNegative, Positive
from ..common.written_files import (
    LIST_FILE,
    hashes_of,
    is_written_here,
    list_as_text,
    listed_hashes,
)
from ..errors import InputError, require_among
from ..fem.schemes import SCHEMES
from ..problem import Problem
from ..problem.bench_files import (
    BenchTable,
    add_loads,
    add_noises,
    bench_tables,
    has_displacement_table,
    table_name,
)
from ..problem.recording_reader import by_marker
from ..problem.recording_schema import ExperimentSection, ForceSensorSection
from ..problem.schema import ProblemFile
from ..problem.specimen_reader import layout_from_section
from ..problem.specimen_schema import SpecimenSection
from ..program.simulation import NEWMARK, Trajectory, simulate
from ..recording import Experiment, write_gauge_csv, write_markers_csv, write_poses_csv
from ..recording.measured_faces import face_columns
from ..recording.specimen_files import SpecimenLayout, specimen_columns
from ..recording.writers import write_columns_csv
from ..statistics.stability_concerns import branch_concern
from .run_writers import (
    FRAMES_FILE,
    replaced_folder,
    require_no_link,
    require_only_written,
    require_replaceable,
    write_frames,
)

# Key of the file of markers, see `_table_names`.
_MARKERS_KEY = "markers"
# Key of the table of a specimen.
_SPECIMEN_KEY = "specimen"


@validated
class Recipe:
    """Options of a simulation that makes synthetic data.

    Attributes
    ----------
    integrator : str
        newmark, or a scheme: midpoint, backward-euler, bdf2.
    timestep_s : float
        Time step of newmark [s]; by default so small that the motion does not depend on it.
    noise_m : float
        Standard deviation of the noise of each coordinate of a marker [m]; if the markers have a σ
        of each sample, that of samples with the median σ.
    noise_n : float
        Standard deviation of the noise of measured forces [N]. If a quarter of the specimen is
        modelled (``symmetry = 4``), the noise is that of the force on the complete specimen.
    noise_nm : float
        Standard deviation of the noise of measured torques [N m]; with ``symmetry``, of the torque
        on the whole specimen.
    noise_own : float
        Standard deviation of the noise of custom sensors, in multiples of their sigma.
    seed : int
        Seed of the noise.
    frames : --frames/--no-frames
        Also write frames for ParaView.

    Raises
    ------
    InputError
        For an unknown integrator, and for a timestep, noise or seed out of range.
    """

    integrator: str = NEWMARK
    timestep_s: Positive | None = None
    noise_m: NotNegative = 0.0
    noise_n: NotNegative = 0.0
    noise_nm: NotNegative = 0.0
    noise_own: NotNegative = 0.0
    seed: Count = 0
    frames: bool = False

    def __post_init__(self) -> None:
        require_among(self.integrator, (NEWMARK, *SCHEMES), where="integrator")


def _share_of_experiment(
    progress: Callable[[float], None] | None, index: int, count: int
) -> Callable[[float], None] | None:
    if progress is None:
        return None
    return lambda share: progress((index + share) / count)


def write_data(
    problem: Problem,
    folder: str | Path,
    recipe: Recipe | None = None,
    progress: Callable[[float], None] | None = None,
    report: Callable[[str], None] | None = None,
) -> list[Path]:
    """Simulate every experiment at the parameters' guesses and write tables of its measurements,
    with noise, and of its poses.

    Images of cameras are not written.

    Parameters
    ----------
    problem : Problem
        Problem with a guess of every parameter.
    folder : str or Path
        Created if missing; gets ``<experiment>_markers.csv`` if there are markers,
        ``<experiment>_poses.csv`` (``_poses_2`` … by the number of the grasp) for grasps whose
        poses the problem reads, ``<experiment>_face.csv`` for grasps that follow measured
        displacements, ``<experiment>_wrench.csv`` (``_wrench_2`` …) for grasps with a
        force sensor, ``<experiment>_reading_<name>.csv`` for custom sensors, and ``<experiment>/``
        with frames if requested. An experiment whose displacements come from a table, as on a test
        bench, gets its tables of displacement and load under their names in the problem file, in
        place of poses and wrenches. A specimen gets one table, of its stresses, under its name in
        the problem file, or ``<experiment>.csv`` for a problem without a file. Earlier files of
        these names that this program wrote are replaced. The list of written files `LIST_FILE` in
        the folder is made or extended.
    recipe : Recipe, optional
        Integrator, noise and seed; without noise by default.
    progress : callable, optional
        Called with the completed share of all simulations, ascending from 0 to 1.
    report : callable, optional
        Called with a sentence for each experiment whose equilibria leave their stable path.

    Returns
    -------
    list of Path
        The files written, in the order of the experiments, without the list of files; for frames
        only the file `FRAMES_FILE` of each folder.

    Raises
    ------
    InputError
        Before anything is written: for a parameter without a guess, if the folder has files of
        others, or if a file would be overwritten that the problem reads or that this program did
        not write. The problem's own folder may have other files.
    SimulationError
        If a simulation fails, before anything is written.
    """
    place = Path(folder)
    recipe = recipe or Recipe()
    problem.require_guesses("and a simulation needs a value")
    sections = _experiment_sections(problem)
    names = [_table_names(each, sections.get(each.name)) for each in problem.experiments]
    _require_separate_files(problem, names)
    files = [place / name for named in names for name in named.values()]
    _refuse_foreign(problem, place, files=files)
    for experiment in problem.experiments if recipe.frames else ():
        require_replaceable(
            place / experiment.name, marker_file=FRAMES_FILE, content_word="simulation"
        )
    rng = np.random.default_rng(recipe.seed)
    simulated = [
        simulate(
            experiment,
            problem.parameters,
            integrator=recipe.integrator,
            timestep_s=recipe.timestep_s,
            # The grid of the problem is that of schemes; Newmark's step is stated in the recipe.
            substeps="auto" if recipe.integrator == NEWMARK else problem.substeps,
            progress=_share_of_experiment(progress, number, count=len(problem.experiments)),
        )
        for number, experiment in enumerate(problem.experiments)
    ]
    if progress is not None:
        progress(1.0)
    for experiment, trajectory in zip(problem.experiments, simulated, strict=True):
        change = trajectory.branch_change
        if report is not None and change is not None:
            report(branch_concern(experiment.name, change).message)
    written: list[Path] = []
    drafts_of: dict[Path, Path] = {}
    with ExitStack() as stack:  # all files appear at its end, or none
        for experiment, trajectory, named in zip(
            problem.experiments, simulated, names, strict=True
        ):
            section = sections.get(experiment.name)
            files = [place / n for n in named.values()]
            drafts = [stack.enter_context(replaced_file(file)) for file in files]
            drafts_of |= dict(zip(files, drafts, strict=True))
            by_key = dict(zip(named, drafts, strict=True))
            _write_tables(
                experiment, section, trajectory=trajectory, files=by_key, rng=rng, recipe=recipe
            )
            written += files
            if recipe.frames:
                folder = place / experiment.name
                body = experiment.body
                subfolder = replaced_folder(
                    folder, marker_file=FRAMES_FILE, content_word="simulation"
                )
                write_frames(
                    stack.enter_context(subfolder),
                    trajectory.t_s,
                    positions_m=trajectory.positions_m,
                    cells=body.place_cells,
                    element=body.place_element,
                    undeformed_m=body.nodes_m,
                )
                written.append(folder / FRAMES_FILE)
        by_name = {file.name: draft for file, draft in drafts_of.items()}
        listing = stack.enter_context(replaced_file(place / LIST_FILE))
        hashes = listed_hashes(place) | hashes_of(by_name)
        listing.write_text(list_as_text(hashes), encoding="utf-8")
    return written


def _write_tables(
    experiment: Experiment,
    section: ExperimentSection | SpecimenSection | None,
    trajectory: Trajectory,
    files: Mapping[str, Path],
    rng: np.random.Generator,
    recipe: Recipe,
) -> None:
    """Benches have tables of displacement and load; images of cameras are not written."""
    if experiment.specimen is not None or isinstance(section, SpecimenSection):
        stated = section if isinstance(section, SpecimenSection) else None
        _write_specimen(
            experiment,
            stated,
            trajectory=trajectory,
            file=files[_SPECIMEN_KEY],
            rng=rng,
            recipe=recipe,
        )
        return
    markers = experiment.markers
    tracks = trajectory.markers_m + recipe.noise_m * rng.normal(size=trajectory.markers_m.shape)
    sigma_m = None
    if markers.sigma_ratios is not None:
        noise = markers.sigma_ratios.reshape(tracks.shape)
        tracks = trajectory.markers_m + noise * (tracks - trajectory.markers_m)
        # A file has σ before it is divided by the root of the marker's weight.
        weights = {} if section is None else section.markers.weights
        sigma_m = markers.sigma_m * noise[..., 0] * np.sqrt(by_marker(weights, markers.names, 1.0))
    if _MARKERS_KEY in files:
        write_markers_csv(files[_MARKERS_KEY], experiment.t_s, markers.names, tracks, sigma_m)
    for k, grasp in enumerate(experiment.grasps):
        if (key := _numbered_key("poses", k)) in files:
            write_poses_csv(files[key], grasp.poses)
        if (key := _numbered_key("face", k)) in files:
            write_columns_csv(files[key], face_columns(grasp.poses))
    layouts = _wrench_layouts(section) or [ForceSensorSection.model_construct()] * len(
        experiment.wrenches
    )
    wrenches = []
    for sensor, wrench, layout in zip(
        experiment.wrenches, trajectory.wrenches, layouts, strict=True
    ):
        measured = np.where(sensor.measured_components, wrench, np.nan)
        # The load cell's noise: that of the modelled part is as much smaller as its load.
        sigmas = np.repeat([recipe.noise_n, recipe.noise_nm], 3) / layout.symmetry
        wrenches.append(measured + sigmas * rng.normal(size=wrench.shape))
    if section is not None and has_displacement_table(section):
        for name, table in bench_tables(section, experiment, loads=wrenches).items():
            write_columns_csv(files[name], table.columns)
    else:
        for k, (sensor, layout) in enumerate(zip(experiment.wrenches, layouts, strict=True)):
            table = BenchTable(sensor.t_s)
            add_loads(table, layout, at_s=sensor.t_s, loads=wrenches[k])
            add_noises(table, layout, sensor)
            write_columns_csv(files[_numbered_key("wrench", k)], table.columns)
    readings = [] if section is None else section.reading
    noise_columns = {each.name: each.sigma for each in readings if isinstance(each.sigma, str)}
    for gauge, read in zip(experiment.readings, trajectory.custom_sensor_values, strict=True):
        noise = recipe.noise_own * gauge.sample_sigmas * rng.normal(size=read.shape)
        key = f"reading_{gauge.name}"
        text = gauge.simulated_text(experiment, trajectory.positions_m)
        if text is not None:
            files[key].write_text(text, encoding="utf-8")
            continue
        names, columns = [*gauge.columns], read + noise
        if column := noise_columns.get(gauge.name):
            names.append(column)
            sigma = np.broadcast_to(gauge.sample_sigmas[:, :1], (len(read), 1))
            columns = np.hstack([columns, sigma])
        write_gauge_csv(files[key], gauge.sample_times_s, names=names, values=columns)


def _write_specimen(
    experiment: Experiment,
    section: SpecimenSection | None,
    trajectory: Trajectory,
    file: Path,
    rng: np.random.Generator,
    recipe: Recipe,
) -> None:
    assert experiment.specimen is not None
    values = {}
    for gauge, read in zip(experiment.readings, trajectory.custom_sensor_values, strict=True):
        noise = recipe.noise_own * gauge.sample_sigmas * rng.normal(size=read.shape)
        values[gauge.name] = (read + noise)[:, 0]
    layout = SpecimenLayout(test=experiment.specimen.test, columns={})
    if section is not None:
        layout = layout_from_section(section)
    write_columns_csv(file, specimen_columns(experiment, values, layout=layout))


def _wrench_layouts(section: ExperimentSection | None) -> list[ForceSensorSection]:
    """Grasps precede obstacles."""
    moved = section.moved_sections if section is not None else []
    return [each.sensor for each in moved if each.sensor is not None]


def _refuse_foreign(problem: Problem, place: Path, files: Iterable[Path]) -> None:
    """Refuse to write into a folder with files of others, or over a file that the problem reads."""
    require_no_link(place)
    read = {file.resolve() for file in problem.origin.files} if problem.origin else set()
    for file in files:
        if file.exists() and file.resolve() in read:
            raise InputError(
                f"{problem.path} reads this file, so it is not overwritten; choose another "
                "folder, or move the file",
                file,
            )
        if (file.exists() or file.is_symlink()) and not is_written_here(file):
            raise InputError(
                "this file exists and was not written by this program, or was changed since, so "
                "it is not overwritten; choose another folder, or move the file",
                file,
            )
    at_home = problem.path is not None and problem.path.resolve().parent == place.resolve()
    if place.is_dir() and not at_home:
        require_only_written(place)


def _experiment_sections(problem: Problem) -> dict[str, ExperimentSection | SpecimenSection]:
    if (origin := problem.origin) is None:
        return {}
    file = ProblemFile.model_validate(parse_toml(origin.text, origin.path))
    return {section.name: section for section in file.experiment}


def _table_names(
    experiment: Experiment, section: ExperimentSection | SpecimenSection | None
) -> dict[str, str]:
    """Return the names of the files of an experiment, by their content."""
    if experiment.specimen is not None or isinstance(section, SpecimenSection):
        if isinstance(section, SpecimenSection):
            return {_SPECIMEN_KEY: Path(str(section.file)).name}
        return {_SPECIMEN_KEY: f"{experiment.name}.csv"}
    keys = [_MARKERS_KEY] * bool(experiment.markers.names)
    for k in range(len(experiment.grasps)):
        moved = section and section.moved_sections[k]
        if experiment.grasps[k].poses.deformation is not None:
            keys.append(_numbered_key("face", k))
        elif moved is None or moved.poses is not None or moved.cluster:
            keys.append(_numbered_key("poses", k))
    bench: list[str] = []
    if section is not None and has_displacement_table(section):
        tables = [
            t for each in section.moved_sections for t in (each.displacement, each.sensor) if t
        ]
        bench = [table_name(section, table) for table in tables]
    else:
        keys += [_numbered_key("wrench", k) for k in range(len(experiment.wrenches))]
    names = {key: f"{experiment.name}_{key}.csv" for key in keys}
    for gauge in experiment.readings:
        names[f"reading_{gauge.name}"] = f"{experiment.name}_reading_{gauge.name}{gauge.suffix}"
    return names | {name: name for name in bench}


def _numbered_key(kind: str, index: int) -> str:
    """Return the key of the grasp with this index: poses, poses_2, …"""
    return f"{kind}_{index + 1}" if index else kind


def _require_separate_files(problem: Problem, names: Sequence[Mapping[str, str]]) -> None:
    """A simulation writes one file for each experiment."""
    owners: dict[str, str] = {}
    for experiment, files in zip(problem.experiments, names, strict=True):
        for name in files.values():
            if name in owners:
                raise InputError(
                    f"the file {name} is read by '{owners[name]}' too, but a simulation writes a file for "
                    "each experiment; expected different files",
                    problem.path,
                    where=f"experiment '{experiment.name}': file",
                )
            owners[name] = experiment.name
