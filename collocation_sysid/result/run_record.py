"""Writing of a run folder: result.json, arrays, ParaView frames and pictures.

`write_run` writes the folder of a finished run; `draw_run` adds the pictures afterwards; `replays`
gives the arrays of each experiment to pictures and films without a folder.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np

from ..common.array_types import Array
from ..common.files import RESULT_FILE, write_text_file
from ..common.serialisation import as_json
from ..common.written_files import listed_hashes
from ..errors import InputError
from ..features.measurements import recorded_series
from ..fem.body import Body
from ..kinds.contact.concerns import contact_fields
from ..kinds.image_tracks.residual import ImageTrackResidual
from ..kinds.outlines.outlines import edge_pixels
from ..kinds.outlines.residual import OutlinesResidual
from ..methods.reduced_space import ReducedSpace
from ..recording.experiment import Experiment
from ..runs.forward_simulation import ForwardSimulation
from ..runs.result_content import Result
from ..runs.solved_problem import SolvedProblem
from .element_fields import ElementFields
from .replay import MotionRecord, first_and_worst_images
from .run_writers import replaced_folder, write_frames

REFINEMENT_FILE = "refinement.json"
# Number of images of a camera whose masks are drawn.
MAX_OUTLINED_IMAGES = 4


def write_run(
    solved: SolvedProblem,
    result: Result,
    folder: str | Path,
    *,
    frames: bool = True,
    pictures: bool = True,
    replaced: str | None = None,
) -> Path:
    """Write the folder of a run completely or not at all, then its pictures, and return the folder.

    The folder gets ``result.json``, ``problem.toml`` as it was run if the problem has a file,
    ``refinement.json`` if the discretisation error was measured, ``trajectory.npz``, and
    ``frames/`` with ``trajectory.pvd`` for ParaView. With several fitted experiments, the name of
    the experiment precedes the names of its arrays, and each has a subfolder with its frames;
    arrays of an experiment for validation always have its name. `draw_run` adds the pictures after
    the folder is in its place, so that an error while drawing does not lose the result.

    If the disk is full or fails, or another process wrote to the folder meanwhile, the run is kept in
    a folder for temporary files, or as much of it as that has room for; the message names it.

    Parameters
    ----------
    result : Result
        Content of ``result.json``, see `build_result`.
    folder : str or Path
        Made with its parents if missing; an earlier, unchanged run at this place is replaced.
    frames, pictures : bool
        Whether to write ParaView frames, and pictures.
    replaced : str, optional
        Hash of the result that may be replaced, see `listed_result`; by default that of any run.

    Raises
    ------
    InputError
        If the folder holds anything but an earlier run, see `replaced_folder`, or a file or
        picture cannot be written.
    """
    try:
        _write_folder(solved, result, Path(folder), frames=frames, replaced=replaced)
    except OSError as error:
        full = InputError(f"this cannot be written: {error.strerror or error}", folder)
        raise _kept_elsewhere(solved, result, full, frames=frames) from error
    except InputError as error:
        if replaced is not None or isinstance(error.__cause__, OSError):
            raise _kept_elsewhere(solved, result, error, frames=frames) from error
        raise
    if pictures:
        draw_run(solved, result, Path(folder))
    return Path(folder)


def _kept_elsewhere(
    solved: SolvedProblem, result: Result, error: InputError, frames: bool
) -> InputError:
    """Return the error unchanged if the temporary folder cannot be written, either."""
    for content in (partial(_write_folder, frames=frames), _write_answer):
        with suppress(InputError, OSError):
            folder = Path(mkdtemp(prefix="collocation-sysid-run-"))
            try:
                content(solved, result, folder)
            except (InputError, OSError):
                shutil.rmtree(folder, ignore_errors=True)
                raise
            what = "the run" if content is not _write_answer else f"its {RESULT_FILE} alone"
            message = f"{error.message}; {what} is kept in {folder}: move it to another place"
            return InputError(message, error.source, where=error.where)
    return error


def _write_answer(solved: SolvedProblem, result: Result, place: Path) -> None:
    (place / RESULT_FILE).write_text(_result_text(result), encoding="utf-8")
    origin = solved.problem.origin
    if origin is not None:
        (place / "problem.toml").write_text(origin.text, encoding="utf-8")


def listed_result(folder: Path) -> str:
    """Return the hash of the result in a folder by its list of files; empty if it has none."""
    return listed_hashes(folder).get(RESULT_FILE, "")


def _write_folder(
    solved: SolvedProblem, result: Result, folder: Path, frames: bool, replaced: str | None = None
) -> None:
    with replaced_folder(folder) as place:
        _write_answer(solved, result, place)
        if solved.refinement is not None and solved.refinement.levels:
            text = as_json(solved.refinement)
            (place / REFINEMENT_FILE).write_text(text + "\n", encoding="utf-8")
        arrays = _trajectory_arrays(replays(solved))
        np.savez_compressed(place / "trajectory.npz", allow_pickle=False, **arrays)
        if frames:
            write_all_frames(solved, place)
        if replaced not in (None, listed_result(folder)):
            raise InputError("another run was written to this folder meanwhile", folder)


def draw_run(
    solved: SolvedProblem, result: Result, folder: Path, report: Callable[[str], None] | None = None
) -> Result:
    """Draw the pictures of a run into its folder, and store in ``result.json`` how long that took.

    Parameters
    ----------
    result : Result
        Content of its ``result.json``, see `build_result`.
    folder : Path
        The folder that `write_run` wrote for this solved problem.
    report : callable, optional
        Called with a sentence about each picture before it is drawn.

    Returns
    -------
    Result
        The content of ``result.json`` afterwards.

    Raises
    ------
    InputError
        If the folder holds another result, also that of an earlier call, or no result; its
        pictures are replaced already then. If the folder cannot be written to.
    """
    began_s = time.perf_counter()
    file = folder / RESULT_FILE
    write_pictures(solved, result, folder=folder, say=report or (lambda _: None))
    if not file.is_file() or file.read_text(encoding="utf-8") != _result_text(result):
        raise InputError(
            f"{RESULT_FILE} was changed while the pictures were drawn; draw them again with: "
            f"collocation-sysid plot {folder}",
            folder,
        )
    pictures_s = time.perf_counter() - began_s
    result = replace(result, elapsed_s=replace(result.elapsed_s, pictures=pictures_s))
    write_text_file(file, _result_text(result))
    return result


def _result_text(result: Result) -> str:
    return as_json(result) + "\n"


def write_pictures(
    finished: SolvedProblem, result: Result, folder: Path, say: Callable[[str], None]
) -> None:
    """Draw all pictures of a run, including the structure of the Jacobian if the method of a body is not
    reduced space, and write them into its folder as PNG files; existing ones are replaced.

    Parameters
    ----------
    result : Result
        Content of its ``result.json``.
    folder : Path
        The run folder, which is made if missing.
    say : callable
        Called with a sentence about what is being drawn, at the beginning and before each picture
        is written.

    Raises
    ------
    InputError
        If a picture cannot be written.
    """
    say("drawing the pictures")
    # matplotlib takes a while to import, and nothing else needs it.
    from .pictures import all_pictures, jacobian_sparsity, save_pictures

    solution = finished.solution
    pictures = all_pictures(replays(finished), result)
    has_body = solution.collocation.transcriptions[0].experiment.specimen is None
    if has_body and solution.method != ReducedSpace.name:
        pictures["jacobian"] = jacobian_sparsity(solution.collocation, solution.z)
    save_pictures(folder, pictures, say=say)


def _constant_cell_data(finished: SolvedProblem, body: Body) -> dict[str, Any]:
    data: dict[str, Any] = {"region": body.part_of_place_cells} if len(body.parts) > 1 else {}
    for name, values in _field_estimates(finished, body).items():
        heads = (name, f"{name}_lower", f"{name}_upper", f"{name}_over_prior")
        data |= dict(zip(heads, values.T, strict=True))
    return data


def write_all_frames(finished: SolvedProblem, place: Path) -> None:
    """Write the ParaView frames of every fitted experiment with a mesh, see `write_frames`; existing
    ones are replaced.

    With several fitted experiments each has a subfolder of its name, which is made if missing.
    Besides the data of `write_frames` and `_constant_cell_data`, the frames have the residuals of
    the equations of motion, "residual_force_n" [N], which are zero at prescribed dofs.

    Parameters
    ----------
    place : Path
        Existing folder to write into.

    Raises
    ------
    OSError
        If a file cannot be written.
    """
    for part in finished.solution.parts:
        transcription = part.transcription
        if transcription.experiment.specimen is not None:
            continue
        positions = part.x.reshape(len(part.x), -1, 3)
        here = place if len(finished.solution.parts) == 1 else place / transcription.experiment.name
        here.mkdir(exist_ok=True)
        body = transcription.body
        residual = np.zeros((len(positions), transcription.dof_count))
        residual[:, transcription.free_dofs] = part.compute_residual_n()
        write_frames(
            here,
            transcription.dynamics.t_s,
            positions_m=positions,
            cells=body.place_cells,
            element=body.place_element,
            undeformed_m=body.nodes_m,
            point_series={"residual_force_n": residual.reshape(positions.shape)},
            fields=ElementFields.from_body(
                body, body.theta_from_values(finished.solution.parameters)
            ),
            cell_data=_constant_cell_data(finished, body),
        )


def replays(finished: SolvedProblem) -> list[MotionRecord]:
    """Return each experiment with its measured, fitted and simulated motion, for pictures and
    files.

    The fitted experiments come first, then those for validation; specimens are included. A
    validation experiment whose forward simulation failed is left out; a fitted one whose forward
    simulation failed has no simulated motion.
    """
    fitted = {}
    collected = []
    for part, readings in zip(finished.solution.parts, finished.solution.readings_m, strict=True):
        x = part.x[part.transcription.sample_rows]
        fitted[part.transcription.experiment.name] = (x.reshape(len(x), -1, 3), readings)
    for experiment in sorted(finished.problem.experiments, key=lambda each: each.validation):
        rollout = finished.rollouts[experiment.name]
        rolled_out = None
        predicted = None
        if isinstance(rollout, ForwardSimulation):
            predicted = rollout.trajectory.predicted
            rolled_out = (rollout.trajectory.positions_m, rollout.trajectory.markers_m)
        fit = fitted.get(experiment.name)
        if (shown := fit or rolled_out) is not None:
            motion = finished.modes_by_experiment.get(experiment.name)
            natural = motion and np.array([mode.frequency_hz for mode in motion.modes])
            places_m = _marker_places_m(finished, experiment.name)
            contact = {}
            if experiment.obstacles:
                contact = contact_fields(experiment, finished.solution, shown[0])
            replay = MotionRecord.from_experiment(
                experiment,
                fit,
                simulated=rolled_out,
                natural_hz=natural,
                places_m=places_m,
                recorded=recorded_series(
                    experiment, finished.solution.fitted_values.get(experiment.name), predicted
                )
                | contact,
            )
            of_cells = _field_estimates(finished, experiment.body)
            of_cameras = _visible_points(finished, experiment)
            contours = _outlines(finished, experiment.name)
            contours |= _contours_of_tracks(finished, experiment.name, replay)
            collected.append(
                replace(replay, fields=of_cells, visible_points=of_cameras, outlines=contours)
            )
    return collected


def _visible_points(finished: SolvedProblem, experiment: Experiment) -> dict[str, Array]:
    """Return each camera's points on the fitted, else the simulated surface."""
    if not experiment.camera_names:
        return {}
    from .camera_overlays import visible_points  # which needs matplotlib

    return visible_points(finished, experiment)


def _outlines(finished: SolvedProblem, experiment: str) -> dict[str, Array]:
    """Return edges of masks and fitted contours (k, 4) in `MAX_OUTLINED_IMAGES` images."""
    part = finished.solution.part_of(experiment)
    if part is None:
        return {}
    rows_by_camera = {}
    for residual in part.transcription.residuals_of(OutlinesResidual):
        contours = residual.contours_px(part.x, part.phi)
        masks = residual.sensor.all_masks[: len(contours)]
        shown = [(k, mask) for k, mask in enumerate(masks) if mask is not None]
        few = np.linspace(0, len(shown) - 1, MAX_OUTLINED_IMAGES).round().astype(int)
        rows = [np.zeros((0, 4))]
        for k, mask in (shown[n] for n in np.unique(few).tolist() if shown):
            for kind, pixels in enumerate((edge_pixels(mask), contours[k])):
                column = np.ones((len(pixels), 1))
                rows.append(np.hstack([residual.t_s[k] * column, kind * column, pixels]))
        rows_by_camera[residual.sensor.name] = np.vstack(rows)
    return rows_by_camera


def _contours_of_tracks(
    finished: SolvedProblem, experiment: str, replay: MotionRecord
) -> dict[str, Array]:
    """Return fitted contours (k, 4) in the first and in the worst image of tracks of each camera."""
    part = finished.solution.part_of(experiment)
    if part is None:
        return {}
    rows_by_camera = {}
    for residual in part.transcription.residuals_of(ImageTrackResidual):
        samples = replay.readings[residual.sensor.name]
        images = first_and_worst_images(samples)
        rows = [np.zeros((0, 4))]
        for k in images:
            pixels = residual.contour_px(k, part.x, part.phi)
            column = np.ones((len(pixels), 1))
            rows.append(np.hstack([samples[k, 0] * column, column, pixels]))
        rows_by_camera[residual.sensor.name] = np.vstack(rows)
    return rows_by_camera


def _field_estimates(finished: SolvedProblem, body: Body) -> dict[str, Array]:
    estimates = {}
    for part in body.parts:
        if part.field is not None:
            estimates[part.field_name] = np.full((len(body.cells), 4), np.nan)
            estimates[part.field_name][part.cells] = finished.fields[
                part.field_name
            ].stack_by_element()
    return estimates


def _marker_places_m(finished: SolvedProblem, experiment: str) -> Array | None:
    """Return places (M, 3) [m]; None for a validation experiment whose simulation failed."""
    if experiment in finished.places:
        places = [place.position_m for place in finished.places[experiment].values()]
        return np.array(places).reshape(-1, 3)
    rollout = finished.rollouts[experiment]
    if not isinstance(rollout, ForwardSimulation):
        return None
    return np.array([*(rollout.places_m or {}).values()]).reshape(-1, 3)


def _trajectory_arrays(replays: Sequence[MotionRecord]) -> dict[str, Array]:
    """Names have the experiment and a slash in front, unless it is the only fitted one."""
    alone = sum(replay.positions_m is not None for replay in replays) == 1
    arrays = {}
    for replay in replays:
        bare = alone and replay.positions_m is not None
        arrays |= replay.to_arrays("" if bare else f"{replay.name}/")
    return arrays
