"""Problem files of a plan's folder: one compares a recorded execution with the plan, the other
identifies the constants again.
"""

from __future__ import annotations

import os
import tomllib
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from ...common.array_types import Array
from ...common.files import safe_name
from ...problem.recording_schema import MovedSection
from ...problem.schema import with_experiment_defaults
from ...recording import write_markers_csv, write_poses_csv
from ...recording.writers import write_columns_csv
from .motion_plan import MotionPlan
from .signals import standing_value

NAME = "execution"
POSES_FILE = "poses.csv"
MARKERS_FILE = "predicted_markers.csv"
CHECK_FILE, IDENTIFY_FILE = "check.toml", "identify.toml"
# Keys of a grasp that describe the file of its poses: files of a plan have the package's format.
OF_POSES = MovedSection.model_fields.keys() - {"gripper_to_body"}
# Keys of markers that describe their file.
OF_MARKERS = ("names", "labels", "length_unit", "rate_hz", "template_m", "template_window_s")
# Keys whose texts are names of files, in any table.
OF_FILES = ("mesh", "surface", "file", "poses", "displacement", "tension", "pressure")
# Keys of an experiment that select samples, or exclude it from the fit.
OF_TIME = ("window_s", "resample_hz", "every", "validation")
# Keys of an experiment that describe its start, and sensors beside the markers.
OF_RECORDING = (
    *("start", "start_velocity_m_s", "start_spin_rad_s", "start_rule", "loaded_since_s"),
    *("file", "reading", "depth", "image_tracks", "outlines"),
)
HEAD = """\
# {purpose}
# Execute the plan, and replace poses.csv and predicted_markers.csv with the recorded files; their
# times begin when the motion begins. Then run: collocation-sysid solve {file}
"""
PURPOSES = {
    CHECK_FILE: "The execution of a plan, predicted with the constants of the plan: the verdict says\n"
    "# whether the body did what was planned.",
    IDENTIFY_FILE: "The recordings of the original problem and the execution of a plan: the constants\n"
    "# are identified from both.",
}


def command_file(name: str) -> str:
    """Return the name of the file with the planned tension or pressure of an actuator."""
    return f"command_{safe_name(name)}.csv"


def execution_problems(plan: MotionPlan, place: Path, target: Path) -> dict[str, dict[str, Any]]:
    """Write the files that the problems of an execution read beside those of the plan into `place`,
    and return the content of these problems by the name of their files, with paths relative to the
    folder `target`.

    Without a problem file, markers, or with fields of constants, there are no such problems.
    """
    body = plan.program.body
    origin, home = body.problem.origin, body.home
    free = body.problem.parameters.free
    if origin is None or home is None or len(free) > len(body.problem.parameters.free_scalars):
        return {}
    content = with_experiment_defaults(tomllib.loads(origin.text))
    content.pop("experiment_defaults", None)
    tables = content["experiment"]
    names = [each.get("name", f"experiment_{k}") for k, each in enumerate(tables, 1)]
    if body.template.name not in names:
        return {}
    own = tables[names.index(body.template.name)]
    if "markers" not in own:
        return {}
    for key in ("object", "experiment"):
        content[key] = _relative_to(content[key], home.resolve(), new=target)
    executed = deepcopy(content["experiment"][names.index(body.template.name)])
    executed = _executed_table(executed, plan, place)
    executed["name"] = next(
        name for name in (NAME, *(f"{NAME}_{k}" for k in range(2, 99))) if name not in names
    )
    write_markers_csv(
        place / MARKERS_FILE, plan.t_s, names=body.template.markers.names,
        positions_m=_predicted_markers(plan),
    )  # fmt: skip
    values = body.problem.parameters.values(body.q)
    stated = content["parameters"]
    known = {item.name: float(values[item.name]) for item in free}
    guesses = {
        name: (stated[name] if isinstance(stated.get(name), dict) else {}) | {"guess": value}
        for name, value in known.items()
    }
    return {
        CHECK_FILE: content | {"parameters": stated | known, "experiment": [executed]},
        IDENTIFY_FILE: content
        | {"parameters": stated | guesses, "experiment": [*content["experiment"], executed]},
    }


def problem_text(file: str, content: dict[str, Any]) -> str:
    """Return the text of a problem file with its purpose in front."""
    return HEAD.format(purpose=PURPOSES[file], file=file) + tomli_w.dumps(content)


def _executed_table(table: dict[str, Any], plan: MotionPlan, place: Path) -> dict[str, Any]:
    """Return the table of the recording, modified in place, so that it reads the files of the plan;
    grasps and obstacles that are not planned stay where they are before the motion.
    """
    body = plan.program.body
    for key in (*OF_TIME, *OF_RECORDING):
        table.pop(key, None)
    table["start"] = "equilibrium"
    grasps = table.get("grasp", [])
    moved = [*(grasps if isinstance(grasps, list) else [grasps]), *table.get("obstacle", [])]
    for number, each in enumerate(moved):
        each.pop("wrench", None)
        if number == body.grasp_number:
            _without(each, OF_POSES)
            each["poses"] = POSES_FILE
        elif "poses" in each or "displacement" in each:
            standing = plan.fine.experiment.grasps[number].poses
            _without(each, OF_POSES | {"gripper_to_body"})
            each["poses"] = f"standing_{number + 1}.csv"
            write_poses_csv(place / each["poses"], standing)
    planned = {each.name for each in plan.program.signals}
    template = body.template
    for kind, of_file, of_value, actuators in (
        ("tendon", "tension", "tension_n", template.tendons),
        ("pressure", "pressure", "pressure_pa", template.pressures),
    ):
        # Names of the tables are optional.
        for each, actuator in zip(table.get(kind, []), actuators, strict=True):
            _without(each, {of_file, of_value})
            if actuator.name in planned:
                each[of_file] = command_file(actuator.name)
            else:
                each.pop("lag_s", None)
                each[of_value] = standing_value(actuator, template.t_s[0])
    _without(table["markers"], set(OF_MARKERS))
    table["markers"]["file"] = MARKERS_FILE
    return table


def _without(table: dict[str, Any], keys: Any) -> None:
    for key in keys:
        table.pop(key, None)


def _predicted_markers(plan: MotionPlan) -> Array:
    """Return the predicted positions (T, M, 3) of the markers of the recording; NaN where the place
    of a marker is not known.
    """
    body = plan.program.body
    known = {n: place for n, place in body.marker_places_m.items() if np.isfinite(place).all()}
    names = body.template.markers.names
    positions = np.full((len(plan.t_s), len(names), 3), np.nan)
    if known:
        markers = body.experiment(None, plan.program.experiment.t_s, known).markers
        found = markers.predict_positions(plan.fine.positions_m)
        positions[:, [names.index(name) for name in known]] = found
    return positions


def write_commands(plan: MotionPlan, place: Path, t_s: Array) -> None:
    """Write the planned tensions and pressures at times since the start, in the format of the
    problem.
    """
    for each, values in zip(plan.program.signals, plan.commands(t_s).values(), strict=True):
        columns = {"t_s": t_s, each.section.range_key: values}
        write_columns_csv(place / command_file(each.name), columns)


def _relative_to(value: Any, old: Path, new: Path) -> Any:
    """Return nested content of a problem with file names relative to the folder `new` instead of
    `old`, in new lists and dictionaries; whether the files exist does not matter.
    """
    if isinstance(value, list):
        return [_relative_to(each, old, new=new) for each in value]
    if not isinstance(value, dict):
        return value
    return {
        key: Path(os.path.relpath(old / each, new)).as_posix()
        if key in OF_FILES and isinstance(each, str)
        else (each if key == "columns" else _relative_to(each, old, new=new))
        for key, each in value.items()
    }
