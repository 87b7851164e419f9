"""Benchmark folders: files of the bodies that users of any simulator read without this package."""

from __future__ import annotations

import csv
import io
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...common.array_types import Array
from ...common.files import SCHEMA, safe_name, write_text_file
from ...common.serialisation import as_json
from ...errors import InputError, listed
from ...fem.meshes.mesh import TetMesh
from ...fem.meshes.structured import box_mesh
from ...problem import Problem
from ...program.simulation import simulate
from ...recording import Experiment
from ...recording.homogeneous_deformation import AXES, CELL_SIZE_M
from ...recording.placement import LocatedBody
from ...recording.specimen_files import specimen_strains
from ...recording.writers import write_columns_csv, write_poses_csv
from ...result.run_writers import replaced_folder
from .bodies import BenchmarkBody
from .body_description import DAMPING_LAWS, FOLDER_README, LAWS, body_readme
from .scores import BODY_FILE, CONTENT_FILE
from .signals import SAMPLE_KEY, RecordingSignals

README_FILE = "README.md"
LICENCE_FILE = "LICENSE.md"
# Divisions of the cube that stands for a body without a mesh: any mesh has the same stresses.
CUBE_DIVISIONS = (1, 1, 1)


def write_benchmark(
    bodies: Sequence[BenchmarkBody],
    folder: str | Path,
    progress: Callable[[float], None] | None = None,
) -> Path:
    """Write a folder with all that a simulator needs to predict the recordings of the bodies.

    The folder of each body has its mesh, the motion of its grasps, the times and points to be
    predicted, the constants with combined 95 % intervals, the measurements, a simulation by this
    package, and a README with the format of the predictions.

    Parameters
    ----------
    bodies : sequence of BenchmarkBody
        At least one.
    folder : str or Path
        An earlier benchmark folder is replaced, if nothing was added to it or changed in it.
    progress : callable, optional
        Called with the completed share of each simulation, from 0 to 1.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    InputError
        If there are no bodies, the data of a body or the value of a parameter are missing, or the
        folder has other files; nothing is written then.
    SimulationError
        If a simulation fails; nothing is written then.
    """
    if not bodies:
        raise InputError("found no body whose data are on this computer; install the package again")
    with replaced_folder(folder, marker_file=CONTENT_FILE, content_word="benchmark") as draft:
        for body in bodies:
            _write_body(body, draft / body.name, progress)
        content = {"schema": SCHEMA, "bodies": [body.name for body in bodies]}
        write_text_file(draft / CONTENT_FILE, as_json(content) + "\n")
        write_text_file(draft / README_FILE, FOLDER_README)
    return Path(folder)


def _parameter_values(problem: Problem, entry: Mapping[str, Any]) -> dict[str, float]:
    """Return the values of all parameters of a problem by name, in the units of the problem file."""
    identified = {each["name"]: each["value"] for each in entry["constants"]}
    values = {}
    for item in problem.parameters.components:
        value = identified.get(item.name, item.guess if item.is_fixed else None)
        if value is None:
            raise InputError(
                "this parameter is neither fixed nor among the constants of the body's catalogue "
                f"entry; expected a fixed value, or one of {listed(identified)}",
                problem.path,
                where=f"parameters.{item.name}",
            )
        values[item.name] = value
    return values


def _write_body(
    body: BenchmarkBody, folder: Path, progress: Callable[[float], None] | None
) -> None:
    """Simulate the recordings of a body, and write its files to a new folder."""
    problem = body.read_problem()
    entry = body.catalogue_entry()
    values = _parameter_values(problem, entry)
    experiments = [each for each in problem.experiments if each.name in body.recordings]
    mesh = _mesh(experiments[0])
    folder.mkdir()
    if (licence := body.find_licence_file()) is not None:
        shutil.copyfile(licence, folder / LICENCE_FILE)
    mesh.write(folder / "mesh.vtu")
    write_columns_csv(
        folder / "nodes.csv", dict(zip(("x_m", "y_m", "z_m"), mesh.points_m.T, strict=True))
    )
    corners = (f"node_{k}" for k in range(1, 5))
    write_columns_csv(folder / "tetrahedra.csv", dict(zip(corners, mesh.tetrahedra.T, strict=True)))
    content = _body_content(body, entry, experiments[0], values)
    content["recordings"] = []
    for experiment in experiments:
        theta = experiment.body.theta_from_values(values)
        trajectory = simulate(
            experiment, theta, timestep_s=problem.rollout.timestep_s, progress=progress
        )
        signals = RecordingSignals.from_trajectory(experiment, trajectory)
        recording = _write_recording(experiment, signals, body.are_held_out, folder)
        content["recordings"].append(recording)
    write_text_file(folder / BODY_FILE, as_json(content) + "\n")
    write_text_file(folder / README_FILE, body_readme(content))


def _mesh(experiment: Experiment) -> TetMesh:
    """Return the body's mesh; a cube for a material test without one."""
    if experiment.specimen is None:
        return experiment.body.mesh
    return box_mesh((CELL_SIZE_M,) * 3, CUBE_DIVISIONS, origin_m=(0.0, 0.0, 0.0))


def _body_content(
    body: BenchmarkBody, entry: Mapping[str, Any], experiment: Experiment, values: dict[str, float]
) -> dict[str, Any]:
    """Return the content of body.json without its "recordings"."""
    modelled = experiment.body
    (part,) = modelled.parts
    (density,) = modelled.densities(modelled.theta_from_values(values))
    is_motion = not experiment.is_static
    return {
        "schema": SCHEMA,
        "body": body.name,
        "catalogue_entry": body.entry,
        **{key: entry[key] for key in ("specimen", "source", "licence", "is_measured")},
        "note": body.note,
        "identified_from": entry["recordings"],
        "law": part.material.name,
        "energy": LAWS[part.material.name],
        "damping": part.damping.name if is_motion else None,
        "damping_force": DAMPING_LAWS[part.damping.name] if is_motion else None,
        "element": modelled.element.name if experiment.specimen is None else None,
        "density_kg_m3": density if experiment.specimen is None else None,
        "constants": entry["constants"],
    }


def _write_recording(
    experiment: Experiment, signals: RecordingSignals, is_held_out: bool, folder: Path
) -> dict[str, Any]:
    """Write the tables of a recording, and return its entry in body.json."""
    measured = signals.measured
    name = safe_name(experiment.name)
    files = {
        role: f"{name}_{role}.csv" for role in ("times", "measured", "simulated", "undeformed")
    }
    write_columns_csv(folder / files["times"], {measured.key: measured.keys})
    for role in ("measured", "simulated", "undeformed"):
        write_columns_csv(folder / files[role], getattr(signals, role).table)
    content = {
        "name": experiment.name,
        "file_name": name,
        "is_held_out": is_held_out,
        "kind": experiment.kind,
        "start": None if experiment.is_static else experiment.start,
        "gravity_m_s2": experiment.gravity_m_s2,
        "air_density_kg_m3": experiment.air_density_kg_m3,
        "quantity": measured.quantity,
        "key": measured.key,
        "columns": measured.columns,
        "sigma": signals.sigma,
        "files": files,
    }
    if experiment.specimen is not None:
        files["stretches"] = f"{name}_stretches.csv"
        write_columns_csv(folder / files["stretches"], _stretches(experiment))
        return content
    if measured.quantity == "markers":
        files["markers"] = f"{name}_markers.csv"
        write_text_file(folder / files["markers"], _marker_table(experiment))
    else:
        content["symmetry"] = experiment.symmetry
    content["grasps"] = _write_grasps(experiment, folder=folder, name=name)
    return content


def _write_grasps(experiment: Experiment, folder: Path, name: str) -> list[dict[str, Any]]:
    """Write the nodes and poses of the grasps, and return what is written about them as JSON: for
    each grasp its "axes" and the file names "nodes" and "poses", None for a grasp at rest.
    """
    grasps = []
    corner_count = len(experiment.body.mesh.points_m)
    for number, grasp in enumerate(experiment.grasps, start=1):
        nodes_file = f"{name}_grasp_{number}_nodes.csv"
        nodes = grasp.nodes[grasp.nodes < corner_count]
        write_columns_csv(folder / nodes_file, {"node": nodes})
        is_moving = len(grasp.poses.t_s) > 1
        poses_file = f"{name}_grasp_{number}_poses.csv" if is_moving else None
        if poses_file is not None:
            write_poses_csv(folder / poses_file, grasp.poses)
        grasps.append({"nodes": nodes_file, "axes": grasp.axes, "poses": poses_file})
    return grasps


def _marker_table(experiment: Experiment) -> str:
    """Return a CSV table of the markers, with a header: place on the undeformed body [m], index of
    the nearest tetrahedron from 0, and weights of its corners, which may be negative for places
    outside.
    """
    body = experiment.body
    places_m = experiment.markers.predict_positions(body.nodes_m)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    weights = [f"weight_{k}" for k in range(1, 5)]
    writer.writerow(["marker", "x_m", "y_m", "z_m", "tetrahedron", *weights])
    located = LocatedBody(body.nodes_m, body)
    for name, place_m in zip(experiment.markers.names, places_m, strict=True):
        cell, _ = located.nearest_cell(place_m)
        (shares,) = located.barycentric(place_m, np.array([cell]))
        numbers = [f"{value:.12g}" for value in (*place_m, cell, *shares)]
        writer.writerow([name, *numbers])
    return text.getvalue()


def _stretches(experiment: Experiment) -> dict[str, Array]:
    """Return the columns of a table of a material test: "sample", numbers from 1, and "stretch_x",
    "stretch_y" and "stretch_z" (T,), which are NaN along axes whose stretch is free and whose
    stress vanishes. The experiment must be a specimen without a mesh and without shear.
    """
    deformation = experiment.specimen
    assert deformation is not None
    assert deformation.test not in ("simple-shear", "biaxial-difference")
    first, second = specimen_strains(experiment)
    samples = np.arange(1.0, len(first) + 1)
    table = {SAMPLE_KEY: samples}
    for axis in AXES:
        stretch = np.ones(len(first))
        stretch += first * (axis * 2 in deformation.first)
        stretch += second * (axis * 2 in deformation.second)
        if axis in deformation.free:
            stretch = np.full(len(first), np.nan)
        table[f"stretch_{axis}"] = stretch
    return table
