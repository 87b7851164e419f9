"""Folder of a design: the poses, their predicted measurements, and a problem file for the
recording.
"""

from __future__ import annotations

import os
import tomllib
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from scipy.spatial.transform import RigidTransform

from ...common.serialisation import as_json, content
from ...problem.gripper_transforms import gripper_transforms
from ...problem.recording_schema import MovedSection
from ...problem.schema import with_experiment_defaults
from ...recording import PoseSequence, write_markers_csv, write_poses_csv, write_wrench_csv
from ...result.animation import film
from ...result.pictures.album import save_pictures
from ...result.replay import MotionRecord
from ...result.run_writers import replaced_folder
from .motion import Design, ErrorBars
from .page import design_figures

DESIGN_FILE = "design.json"
POSES_FILE = "poses.csv"
MARKERS_FILE = "predicted_markers.csv"
WRENCH_FILE = "predicted_wrench.csv"
PROBLEM_FILE = "problem.toml"
FILM_FILE = "motion.gif"
NAME = "designed"
# Form of design.json.
SCHEMA = 1
# Frame rate of the film [1/s], as of cinema.
FRAMES_PER_SECOND = 25.0
# Keys of a grasp that describe the file of its poses: files of a design have the package's format.
OF_POSES = MovedSection.model_fields.keys() - {"gripper_to_body"}
# Keys of markers and of a wrench that describe their files.
OF_MARKERS = (
    "names",
    "labels",
    "length_unit",
    "rate_hz",
    "template_m",
    "template_window_s",
    "max_template_residual_m",
)
OF_WRENCH = ("columns", "axis", "sign", "area_m2", "symmetry")
# Keys whose texts are names of files, in any table.
OF_FILES = ("mesh", "surface", "file", "poses", "displacement", "tension", "pressure")
# Keys of an experiment that select samples, or exclude it from the fit.
OF_TIME = ("window_s", "resample_hz", "every", "validation")
HEAD = """\
# A designed motion, poses.csv, and the marker tracks that are predicted at the parameters' guesses.
# Record the motion, and replace poses.csv and predicted_markers.csv with the recorded files.

"""


def write_design(
    design: Design, folder: str | Path, with_film: bool = True, say: Callable[[str], None] = print
) -> Path:
    """Write the folder of a design atomically, and return its path.

    It contains the poses (poses.csv), the predicted markers and wrench, pictures,
    design.json, with `with_film` motion.gif, and, if the problem was read from a file, problem.toml
    for the recording.

    Parameters
    ----------
    design : Design
        Design to write; its experiment has one grasp, with at most one sensor.
    folder : str or Path
        Folder, which may contain an earlier design; that is replaced.
    with_film : bool
        Whether to render the motion as a film.
    say : callable
        Function that is called with the present activity, a text; by default it is printed.

    Raises
    ------
    InputError
        If the folder contains anything but an earlier design, or cannot be written.
    """
    target = Path(folder)
    with replaced_folder(target, marker_file=DESIGN_FILE, content_word="design") as place:
        write_poses_csv(place / POSES_FILE, _gripper_poses(design))
        experiment = design.experiment
        markers = experiment.markers
        write_markers_csv(
            place / MARKERS_FILE,
            markers.t_s,
            names=markers.names,
            positions_m=design.predicted.markers_m,
        )
        for sensor, wrench in zip(experiment.wrenches, design.predicted.wrenches, strict=True):
            write_wrench_csv(place / WRENCH_FILE, sensor.t_s, values=wrench)
        if design.recording.problem.origin is not None:
            text = HEAD + tomli_w.dumps(_problem_content(design, target.resolve()))
            (place / PROBLEM_FILE).write_text(text, encoding="utf-8")
        save_pictures(place, design_figures(design))
        if with_film:
            say("rendering the film of the motion")
            shapes_m = design.predicted.positions_m
            replay = MotionRecord.from_experiment(experiment, (shapes_m, markers.positions_m))
            film(replay, place / FILM_FILE, fps=FRAMES_PER_SECOND, names=("predicted", ""))
        (place / DESIGN_FILE).write_text(as_json(design_json(design)), encoding="utf-8")
    return target


def design_json(design: Design) -> dict[str, Any]:
    """Return the content of design.json, in types that JSON has.

    The keys are "schema", "experiment", "duration_s", "samples", "criterion", "recordings_count",
    "before" and "after" (error bars; "before" may be None, see `Design`), "limits" (each with the
    share that the motion uses), "limits_reached", "search" and "motion".
    """
    search = design.best
    limits = design.limits
    return {
        "schema": SCHEMA,
        "experiment": design.recording.template.name,
        "duration_s": design.experiment.duration_s,
        "samples": len(design.experiment.t_s),
        "criterion": {
            "kind": design.criterion.kind,
            "for": list(design.criterion.names),
            "over": design.criterion.over,
            "draws": design.draws,
            "relative_error": design.minimised_error,
        },
        "recordings_count": design.added,
        "before": None if design.before is None else _error_bars_json(design.before),
        "after": _error_bars_json(design.after),
        "limits": {
            name: {"limit": getattr(limits, name), "share_used": share}
            for name, share in design.shares.items()
        },
        "limits_reached": design.active_limits,
        "search": {
            "evaluations": len(search.history),
            "interrupted": search.is_interrupted,
            "history": [float(np.exp(min(value, 100.0))) for value in search.history],
        },
        "motion": content(design.motion),
    }


def _error_bars_json(bars: ErrorBars) -> dict[str, Any]:
    """Return the error bars by parameter or modulus, for JSON: "value", "std_error" (in the unit of
    the value), "relative_error", and "over_draws", its lowest and highest value over the draws.
    """
    return {
        name: {
            "value": value,
            "std_error": abs(value) * bars.relative[name],
            "relative_error": bars.relative[name],
            "over_draws": [bars.lowest[name], bars.highest[name]],
        }
        for name, value in bars.values.items()
    }


# The problem --------------------------------------------------------------------------------------


def _gripper_poses(design: Design) -> PoseSequence:
    """Return the designed poses over time, in the world, for the file of poses: those of the
    gripper if the problem states `gripper_to_body` for the first grasp, else those of the body in
    the grasp, `Design.poses`.
    """
    recording = design.recording
    (body_in_gripper,) = gripper_transforms(recording.problem, recording.template.name, grasps=[0])
    if body_in_gripper is None:
        return design.poses
    gripper_in_body = RigidTransform.from_matrix(body_in_gripper).inv()
    return design.poses.after(gripper_in_body.as_matrix())


def _problem_content(design: Design, folder: Path) -> dict[str, Any]:
    """Return the content of a problem file in `folder` for the designed recording, as nested
    dictionaries and lists for TOML; nothing is written.

    It is the content of the problem's own file with its overrides (`Origin.text`), and with the
    defaults of experiments in the table of each experiment. Estimated parameters get guesses at the
    middle draw, coefficients of fields none. Existing recordings are kept only if they are used
    (`Design.added`).
    """
    origin = design.recording.problem.origin
    recording = design.recording
    assert origin is not None
    problem_table = with_experiment_defaults(tomllib.loads(origin.text))
    problem_table.pop("experiment_defaults", None)
    old_folder = origin.path.resolve().parent
    for key in ("object", "experiment"):
        problem_table[key] = relative_to(problem_table[key], old_folder, new=folder)
    tables = problem_table["experiment"]
    names = [each.get("name") for each in tables]
    new = deepcopy(tables[names.index(recording.template.name)])
    used_names = {*names} if design.added else set()
    candidate_names = (f"{NAME}_{k}" if k > 1 else NAME for k in range(1, len(names) + 2))
    new["name"] = next(name for name in candidate_names if name not in used_names)
    problem_table["experiment"] = [*(tables if design.added else []), _designed_table(new)]
    for item in recording.problem.parameters.free_scalars:
        section = problem_table["parameters"].get(item.name)
        guess = {"guess": design.after.values[item.name]}
        problem_table["parameters"][item.name] = (
            section if isinstance(section, dict) else {}
        ) | guess
    return problem_table


def _designed_table(table: dict[str, Any]) -> dict[str, Any]:
    """Return the table of an experiment, modified in place, so that it reads poses and measurements
    from the files of the design beside the problem file.

    Keys that select samples are removed (`OF_TIME`), and so are keys that describe the original
    file of poses in the table of the first grasp (`OF_POSES`). Tables of markers and of the wrench
    of that grasp lose the keys that describe their files (`OF_MARKERS`, `OF_WRENCH`); the wrench is
    in newtons and for the modelled part of the body, so that its sigmas are divided by "symmetry".
    """
    for key in OF_TIME:
        table.pop(key, None)
    grasp = table["grasp"][0] if isinstance(table["grasp"], list) else table["grasp"]
    for key in OF_POSES:
        grasp.pop(key, None)
    grasp["poses"] = POSES_FILE
    if "markers" in table:
        for key in OF_MARKERS:
            table["markers"].pop(key, None)
        table["markers"]["file"] = MARKERS_FILE
    if "wrench" in grasp:
        wrench = grasp["wrench"]
        parts = wrench.get("symmetry", 1)
        sigmas = {key: wrench[key] / parts for key in ("sigma_n", "sigma_nm") if key in wrench}
        remaining = {key: value for key, value in wrench.items() if key not in OF_WRENCH}
        grasp["wrench"] = remaining | sigmas | {"file": WRENCH_FILE}
    return table


def relative_to(value: Any, old: Path, new: Path) -> Any:
    """Return nested content of a problem with file names relative to the folder `new` instead of
    `old`, in new lists and dictionaries; whether the files exist does not matter.
    """
    if isinstance(value, list):
        return [relative_to(each, old, new=new) for each in value]
    if not isinstance(value, dict):
        return value
    return {
        key: Path(os.path.relpath(old / each, new)).as_posix()
        if key in OF_FILES and isinstance(each, str)
        else (each if key == "columns" else relative_to(each, old, new=new))
        for key, each in value.items()
    }
