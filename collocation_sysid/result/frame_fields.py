"""Stress in the ParaView frames of a run, on the triangles of the boundary."""

from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import meshio
import numpy as np
from numpy.typing import NDArray

from ..common.array_types import Array
from ..common.files import damage_refused, is_own
from ..common.text_files import parse_xml, read_text
from ..errors import InputError
from .replay import MotionRecord
from .run_writers import FRAMES_FILE


def stress_on_faces(run: str | Path, replay: MotionRecord) -> Array:
    """Return the von Mises stress (T, F) [Pa] on the boundary triangles, at each sample that of the
    nearest frame.

    Parameters
    ----------
    replay : MotionRecord
        Experiment of this run.

    Raises
    ------
    InputError
        If the frames are damaged, or there are none.
    """
    if replay.positions_m is None:
        raise _missing_frames(run, replay.name)
    frames = frame_files(Path(run), replay.name)
    cells = cells_below_faces(replay.tetrahedra, replay.surface)
    with _damaged_frames_refused(Path(run)):
        shown = [meshio.read(file).cell_data["von_mises_pa"][0][cells] for _, file in frames]
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
        sets = parse_xml(read_text(listing, "a list of frames")).iter("DataSet")
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


def _damaged_frames_refused(run: Path) -> AbstractContextManager[None]:
    return damage_refused(
        run, f"{FRAMES_FILE} or one of its frames", remedy="solve the problem again"
    )
