"""The folder of a design: the poses, what they are predicted to tell, and a problem to record."""

from __future__ import annotations

import os
import tomllib
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from ..arrays import Array
from ..experiment import (
    PoseSequence,
    write_markers_csv,
    write_poses_csv,
    write_wrench_csv,
)
from ..output.animation import film
from ..output.pictures.album import save_pictures
from ..output.replay import Replay
from ..output.writers import run_folder
from ..problem import Problem
from ..problem.schema import ProblemFile, completed
from ..tree import as_json
from .designing import Bars, Design
from .pictures import pictures

DESIGN_FILE, POSES_FILE, MARKERS_FILE = "design.json", "poses.csv", "predicted_markers.csv"
WRENCH_FILE, PROBLEM_FILE, FILM_FILE = "predicted_wrench.csv", "problem.toml", "motion.gif"
NAME = "designed"
SCHEMA = 1
FRAMES_PER_SECOND = 25.0
# What says how the files of a recording are read; those of a design are in the package's own form.
OF_POSES = (
    "poses",
    "displacement",
    "markers",
    "weights",
    "max_residual_m",
    "quaternion",
    "length_unit",
    "interpolation",
)
OF_MARKERS = (
    "names",
    "labels",
    "length_unit",
    "rate_hz",
    "template_m",
    "template_window_s",
    "max_template_residual_m",
)
OF_TABLE = ("columns", "axis", "sign", "area_m2", "symmetry")
OF_TIME = ("window_s", "resample_hz", "every", "validation")
HEAD = """\
# A designed motion, poses.csv, and what is predicted to be seen of it at the parameters' guesses.
# Record it, and put the recorded files in the place of poses.csv and predicted_markers.csv.

"""


def write_design(
    found: Design, folder: str | Path, with_film: bool = True, say: Callable[[str], None] = print
) -> Path:
    """Write the folder, whole or not at all, and return it.

    Raises
    ------
    InputError
        If there is anything but an earlier design.
    """
    target = Path(folder)
    with run_folder(target, mark=DESIGN_FILE, what="design") as place:
        write_poses_csv(place / POSES_FILE, _of_gripper(found))
        experiment = found.experiment
        markers = experiment.markers
        write_markers_csv(place / MARKERS_FILE, markers.t_s, markers.names, markers.positions_m)
        for sensor, wrench in zip(_sensors(found), found.predicted.wrenches, strict=True):
            write_wrench_csv(place / WRENCH_FILE, sensor.t_s, wrench)
        if found.recording.problem.origin is not None:
            text = HEAD + tomli_w.dumps(_content(found, target.resolve()))
            (place / PROBLEM_FILE).write_text(text, encoding="utf-8")
        save_pictures(place, pictures(found))
        if with_film:
            say("filming the motion")
            shapes_m = found.predicted.positions_m
            replay = Replay.of(experiment, (shapes_m, markers.positions_m))
            film(replay, place / FILM_FILE, FRAMES_PER_SECOND, names=("predicted", ""))
        (place / DESIGN_FILE).write_text(as_json(as_dict(found)), encoding="utf-8")
    return target


def as_dict(found: Design) -> dict[str, Any]:
    """What design.json holds."""
    motion, search, given = found.motion, found.found, found.limits
    return {
        "schema": SCHEMA,
        "experiment": found.recording.template.name,
        "duration_s": found.experiment.duration_s,
        "samples": len(found.experiment.t_s),
        "criterion": {
            "kind": found.criterion.kind,
            "for": list(found.criterion.names),
            "over": found.criterion.over,
            "draws": found.draws,
            "relative_error": found.size,
        },
        "recordings_count": found.added,
        "before": None if found.before is None else _bars(found.before),
        "after": _bars(found.after),
        "limits": {
            name: {"limit": getattr(given, name), "share_used": share}
            for name, share in found.shares.items()
        },
        "limits_reached": found.reached,
        "search": {
            "evaluations": len(search.history),
            "interrupted": search.interrupted,
            "history": [float(np.exp(min(value, 100.0))) for value in search.history],
        },
        "motion": {
            "active_s": motion.active_s,
            "rise_s": motion.rise_s,
            "amplitude": motion.amplitude.tolist(),
            "first_hz": motion.first_hz.tolist(),
            "last_hz": motion.last_hz.tolist(),
            "phase_rad": motion.phase_rad.tolist(),
        },
    }


def _bars(bars: Bars) -> dict[str, Any]:
    return {
        name: {
            "value": value,
            "std_error": abs(value) * bars.relative[name],
            "relative_error": bars.relative[name],
            "over_draws": [bars.lowest[name], bars.highest[name]],
        }
        for name, value in bars.values.items()
    }


def _sensors(found: Design) -> list[Any]:
    return [grasp.wrench for grasp in found.experiment.grasps if grasp.wrench is not None]


# The problem --------------------------------------------------------------------------------------


def _of_gripper(found: Design) -> PoseSequence:
    """The poses as the robot has them: of its gripper, where the problem says how it holds."""
    matrix = _gripper_to_body(found.recording.problem, found.recording.template.name)
    return found.poses if matrix is None else found.poses.after(np.linalg.inv(matrix))


def _gripper_to_body(problem: Problem, name: str) -> Array | None:
    if problem.origin is None:
        return None
    sections = ProblemFile.model_validate(tomllib.loads(problem.origin.text)).experiment
    (section,) = (section for section in sections if section.name == name)
    transform = section.grasps[0].gripper_to_body
    return None if transform is None else transform.matrix


def _content(found: Design, folder: Path) -> dict[str, Any]:
    """The problem of the designed recording, and of those there are where they count."""
    origin, recording = found.recording.problem.origin, found.recording
    assert origin is not None
    content = completed(tomllib.loads(origin.text))
    content.pop("experiment_defaults", None)
    tables = content["experiment"]
    names = [each.get("name") for each in tables]
    chosen = deepcopy(tables[names.index(recording.template.name)])
    _named_from(content, origin.path.resolve().parent, folder)
    relocated = _relocated_experiment(chosen, origin.path.resolve().parent, folder)
    taken = {*names} if found.added else set()
    free = (f"{NAME}_{k}" if k > 1 else NAME for k in range(1, len(names) + 2))
    relocated["name"] = next(name for name in free if name not in taken)
    content["experiment"] = [*(tables if found.added else []), _designed(relocated)]
    for item in recording.problem.parameters.free:
        given = content["parameters"].get(item.name)
        guess = {"guess": found.after.values[item.name]}
        content["parameters"][item.name] = (given if isinstance(given, dict) else {}) | guess
    return content


def _designed(table: dict[str, Any]) -> dict[str, Any]:
    """An experiment's table with the files of the design."""
    for key in OF_TIME:
        table.pop(key, None)
    grasp = table["grasp"][0] if isinstance(table["grasp"], list) else table["grasp"]
    for key in OF_POSES:
        grasp.pop(key, None)
    grasp["poses"] = POSES_FILE
    if "wrench" in grasp:
        grasp["wrench"] = _of_design(grasp["wrench"])
    if "markers" in table:
        for key in OF_MARKERS:
            table["markers"].pop(key, None)
        table["markers"]["file"] = MARKERS_FILE
    return table


def _of_design(wrench: dict[str, Any]) -> dict[str, Any]:
    """A wrench's table with the file of the design, which is in newtons and of the mesh."""
    parts = wrench.get("symmetry", 1)
    sigmas = {key: wrench[key] / parts for key in ("sigma_n", "sigma_nm") if key in wrench}
    kept = {key: value for key, value in wrench.items() if key not in OF_TABLE}
    return kept | sigmas | {"file": WRENCH_FILE}


def _named_from(content: dict[str, Any], old: Path, new: Path) -> None:
    """Name the files of a problem from another folder, in place."""
    body = content["object"]
    _rename(body, ("mesh", "surface"), old, new)
    for table in (body, *body.get("region", [])):
        if isinstance(table.get("material"), dict):
            _rename(table["material"], ("file",), old, new)
    for table in content["experiment"]:
        _relocated_experiment(table, old, new)


def _relocated_experiment(table: dict[str, Any], old: Path, new: Path) -> dict[str, Any]:
    grasps = table.get("grasp", [])
    for grasp in grasps if isinstance(grasps, list) else [grasps]:
        _rename(grasp, ("poses", "displacement"), old, new)
        for table_of_columns in (grasp.get("displacement"), grasp.get("wrench")):
            if isinstance(table_of_columns, dict):
                _rename(table_of_columns, ("file",), old, new)
    _rename(table, ("file",), old, new)
    _rename(table.get("markers", {}), ("file",), old, new)
    for key, name in (("force", "file"), ("tendon", "tension"), ("pressure", "pressure")):
        for each in table.get(key, []):
            _rename(each, (name,), old, new)
    return table


def _rename(table: dict[str, Any], keys: tuple[str, ...], old: Path, new: Path) -> None:
    for key in keys:
        if isinstance(table.get(key), str):
            table[key] = Path(os.path.relpath(old / table[key], new)).as_posix()
