"""Fields of the ParaView frames of a run, on the triangles of the boundary."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import meshio
import numpy as np
from numpy.typing import NDArray

from ..common.array_types import Array
from ..common.files import damage_refused, is_own
from ..errors import InputError, require_among
from .replay import MotionRecord
from .run_writers import FRAMES_FILE


def field_on_faces(run: str | Path, replay: MotionRecord, field: str) -> Array:
    """Return a field (T, F) on the boundary triangles, at each sample that of the nearest frame.

    Point data are averaged over the corners of a triangle; of vectors the norm is taken.

    Parameters
    ----------
    replay : MotionRecord
        Experiment of this run.
    field : str
        Point or cell data of the frames.

    Raises
    ------
    InputError
        If the frames have no such field, are damaged, or there are none.
    """
    frames = _frames_of_fit(run, replay)
    cells = cells_below_faces(replay.tetrahedra, replay.surface)
    with _damaged_frames_refused(Path(run)):
        shown = []
        for _, file in frames:
            frame = meshio.read(file)
            points = frame.point_data
            in_cells = frame.cell_data
            require_among(field, [*in_cells, *points], where="field")
            if field in in_cells:
                values = in_cells[field][0][cells]
            else:
                values = points[field][replay.surface].mean(axis=1)
            shown.append(np.linalg.norm(values, axis=1) if values.ndim == 2 else values)
        times = np.array([time for time, _ in frames])
        nearest = np.abs(replay.t_s[:, None] - times).argmin(axis=1)
        return np.array(shown)[nearest]


def frame_files(run: Path, experiment: str) -> list[tuple[float, Path]]:
    """Return times [s] and files of an experiment's frames, in their order in the list of frames.

    If the experiment has no folder of frames, those of the run folder itself are returned, which
    belong to its only fitted experiment.

    Raises
    ------
    InputError
        If the run folder has no frames of that experiment, or a damaged list of frames.
    """
    listings = (run / experiment / FRAMES_FILE, run / FRAMES_FILE)
    listing = next((each for each in listings if each.is_file()), None)
    if listing is None:
        raise _missing_frames(run, experiment)
    with _damaged_frames_refused(run):
        sets = ElementTree.parse(listing).getroot().iter("DataSet")
        frames = [(float(s.attrib["timestep"]), listing.parent / s.attrib["file"]) for s in sets]
        if not frames or not all(is_own(run, file) for _, file in (*frames, (0.0, listing))):
            raise ValueError(
                "it lists no frames, or frames that are missing or outside the run folder"
            )
        return frames


def cells_below_faces(tetrahedra: NDArray[Any], faces: NDArray[Any]) -> NDArray[np.int64]:
    """Return the index (F,) of the tetrahedron that each boundary triangle is a side of.

    Parameters
    ----------
    tetrahedra : (E, 4)
        Corner nodes of the tetrahedra.
    faces : (F, 3)
        Corner nodes of the triangles, in any order.

    Raises
    ------
    KeyError
        If a triangle is no side of any tetrahedron.
    """
    sides = np.sort(tetrahedra[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]], axis=2)
    known = {tuple(side): k // 4 for k, side in enumerate(sides.reshape(-1, 3).tolist())}
    return np.array([known[tuple(face)] for face in np.sort(faces, axis=1).tolist()])


def _missing_frames(run: str | Path, experiment: str) -> InputError:
    return InputError(
        f"experiment '{experiment}' of this run has no {FRAMES_FILE}: only fitted experiments "
        "have frames",
        run,
    )


def _frames_of_fit(run: str | Path, replay: MotionRecord) -> list[tuple[float, Path]]:
    """Return times [s] and files of the frames of an experiment that was fitted, see `frame_files`."""
    if replay.positions_m is None:
        raise _missing_frames(run, replay.name)
    return frame_files(Path(run), replay.name)


def _damaged_frames_refused(run: Path) -> AbstractContextManager[None]:
    return damage_refused(
        run, f"{FRAMES_FILE} or one of its frames", remedy="solve the problem again"
    )
