"""ParaView frames, and safe replacement of run folders.

`write_frames` writes a trajectory for ParaView. `replaced_folder` is the context in which a run
folder is written: it appears at the end, complete or not at all, and never replaces files of
others.
"""

from __future__ import annotations

import glob
import html
import os
import platform
import re
import secrets
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..common.files import RESULT_FILE, naming
from ..common.written_files import LIST_FILE, foreign_files, list_files
from ..errors import InputError
from ..fem.elements import Element
from .element_fields import ElementFields

VTK_CELL_TYPES = ("tetra", "tetra10")  # by meshio's names
# Largest number of frames; more take disk space and add little to an animation.
MAX_PARAVIEW_FRAMES = 200
FRAMES_FILE = "trajectory.pvd"


# Frames ---------------------------------------------------------------------------------------


def write_vtu(
    path: str | Path,
    points_m: ArrayLike,
    cells: ArrayLike,
    meshio_type: str,
    point_data: Mapping[str, ArrayLike] | None = None,
    cell_data: Mapping[str, ArrayLike] | None = None,
) -> None:
    """Write an unstructured grid of one cell type as a .vtu file, VTK XML with base64 data.

    Parameters
    ----------
    path : str or Path
        File to write; an existing one is replaced.
    points_m : (n, 3)
        Positions of the points [m].
    cells : (E, nodes per cell)
        Point indices of each cell, in the order of meshio for this type.
    point_data : mapping of name to (n,) or (n, k), optional
        Data at the points.
    cell_data : mapping of name to (E,) or (E, k), optional
        Data of the cells.

    Raises
    ------
    InputError
        For an unknown cell type, or data of another length.
    OSError
        If the file cannot be written, as without its folder.
    """
    import meshio  # which takes a while to import

    if meshio_type not in VTK_CELL_TYPES:
        raise InputError(
            f"no cell type {meshio_type!r}; available: {', '.join(VTK_CELL_TYPES)}", path
        )
    points = np.asarray(points_m, dtype=float)
    nodes = np.asarray(cells, dtype=np.int64)
    at_points = _checked_arrays("point", point_data or {}, count=len(points), path=path)
    in_cells = _checked_arrays("cell", cell_data or {}, count=len(nodes), path=path)
    by_block: dict[str, Any] = {name: [array] for name, array in in_cells.items()}
    mesh = meshio.Mesh(points, [(meshio_type, nodes)], {**at_points}, by_block)
    meshio.vtu.write(path, mesh, compression="")


def _checked_arrays(
    kind: str, data: Mapping[str, ArrayLike], count: int, path: str | Path
) -> dict[str, NDArray]:
    """VTK has no booleans, which become integers of 8 bits."""
    arrays = {name: np.asarray(values) for name, values in data.items()}
    for name, array in arrays.items():
        if array.ndim not in (1, 2) or len(array) != count:
            raise InputError(
                f"{kind} data '{name}' has shape {array.shape}, expected one row for each of "
                f"{count} {kind}s",
                path,
            )
        if array.dtype.kind == "b":
            arrays[name] = array.astype(np.int8)
    return {html.escape(name): array for name, array in arrays.items()}


def write_pvd(path: str | Path, frames: Sequence[tuple[float, str | Path]]) -> None:
    """Write the list of frames that ParaView opens as one animation; an existing file is replaced.

    Parameters
    ----------
    frames : sequence of (float, str or Path)
        Time [s] and file of each frame; files are stored relative to the folder of `path`, and
        need not exist yet.

    Raises
    ------
    OSError
        If the file cannot be written, as without its folder.
    """
    folder = Path(path).parent.resolve()
    lines = []
    for t_s, file in frames:
        name = Path(os.path.relpath(Path(file).resolve(), folder)).as_posix()
        lines.append(f'<DataSet timestep="{t_s:.9g}" part="0" file="{html.escape(name)}"/>\n')
    Path(path).write_text(
        '<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1">\n<Collection>\n'
        f"{''.join(lines)}</Collection>\n</VTKFile>\n",
        encoding="utf-8",
    )


def write_frames(
    folder: str | Path,
    t_s: ArrayLike,
    positions_m: ArrayLike,
    cells: ArrayLike,
    element: Element,
    undeformed_m: ArrayLike,
    point_series: Mapping[str, ArrayLike] | None = None,
    fields: ElementFields | None = None,
    cell_data: Mapping[str, ArrayLike] | None = None,
) -> Path:
    """Write a trajectory as frames/frame_0000.vtu, … and trajectory.pvd, and return the latter;
    existing files of these names are replaced, and frames with higher numbers stay.

    Every frame has `displacement_m` and `velocity_m_s` (finite differences; zero if there is only
    one sample) at the points, and the `fields` in the cells. Of more than `MAX_PARAVIEW_FRAMES` samples
    every second, third, … is written.

    Parameters
    ----------
    folder : str or Path
        An existing folder.
    t_s : (T,)
        Ascending times [s], at least one.
    positions_m : (T, n, 3)
        Positions of the nodes [m].
    cells : (E, nodes per element)
        Node indices of each element.
    element : Element
        Kind of the elements.
    undeformed_m : (n, 3)
        Nodes of the undeformed body [m].
    point_series : mapping of name to (T, n) or (T, n, k), optional
        Further data at the points.
    fields : ElementFields, optional
        Evaluator of von Mises stress [Pa], energy density [J/m³] and det F of each element; none
        of these by default.
    cell_data : mapping of name to (E,) or (E, k), optional
        Further data of the cells, the same in every frame.

    Raises
    ------
    InputError
        For point or cell data of another length.
    OSError
        If `folder` does not exist, or a file cannot be written.
    """
    times = np.asarray(t_s, dtype=float)
    positions = np.asarray(positions_m, dtype=float)
    alone = len(times) == 1
    velocities = np.zeros_like(positions) if alone else np.gradient(positions, times, axis=0)
    series = {name: np.asarray(values) for name, values in (point_series or {}).items()}
    frames = Path(folder) / "frames"
    frames.mkdir(exist_ok=True)
    written = []
    for number, k in enumerate(range(0, len(times), -(-len(times) // MAX_PARAVIEW_FRAMES))):
        file = frames / f"frame_{number:04d}.vtu"
        data = {
            "displacement_m": positions[k] - undeformed_m,
            "velocity_m_s": velocities[k],
            **{name: values[k] for name, values in series.items()},
        }
        in_cells = dict(cell_data or {})
        if fields is not None:
            in_cells |= {
                name: values[0] for name, values in fields.evaluate_at(positions[k]).items()
            }
        write_vtu(
            file,
            positions[k],
            cells=cells,
            meshio_type=element.meshio_type,
            point_data=data,
            cell_data=in_cells,
        )
        written.append((float(times[k]), file))
    listing = Path(folder) / FRAMES_FILE
    write_pvd(listing, written)
    return listing


# Folder ---------------------------------------------------------------------------------------


@contextmanager
def replaced_folder(
    path: str | Path, marker_file: str = RESULT_FILE, content_word: str = "run"
) -> Iterator[Path]:
    """Context with a temporary folder to write into, which is renamed to `path` at the end.

    An earlier run at `path` is replaced completely, at the end, if this program wrote every file in
    it and none was changed since; an empty folder is replaced, too. After an exception the
    temporary folder is removed and `path` is unchanged. The folder gets a list of its files, see
    `written_files`.

    Parameters
    ----------
    path : str or Path
        Folder to write; missing parents are made.
    marker_file : str
        Name of a file by which an earlier run is recognised.
    content_word : str
        Word for the content in messages, such as "run".

    Raises
    ------
    InputError
        If there is anything else at `path`, or a link; this is checked before the temporary folder
        is given, so that no work is lost, and again at the end. If the folder cannot be moved at
        the end, the message names the place where the finished one is kept.
    """
    target = _resolved_parent(Path(path))
    require_replaceable(target, marker_file=marker_file, content_word=content_word)
    target.parent.mkdir(parents=True, exist_ok=True)
    _remove_stale(target)
    process_name = f"{platform.node()}-{os.getpid()}-{secrets.token_hex(4)}"
    temporary = target.with_name(f".{target.name}.{process_name}.partial")
    temporary.mkdir()
    try:
        with naming(target, temporary):
            yield temporary
            list_files(temporary)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise
    try:
        require_replaceable(target, marker_file=marker_file, content_word=content_word)
        _replace_folder(
            temporary, target, backup=target.with_name(f".{target.name}.{process_name}.old")
        )
    except (InputError, OSError) as error:
        backup = target.with_name(f"{target.name}-{process_name}")
        with suppress(OSError):
            temporary = temporary.rename(backup)
        raise InputError(
            f"the finished run cannot be moved to this folder ({error}); it is kept in {temporary}",
            target,
        ) from error


def _resolved_parent(path: Path) -> Path:
    """Resolve all links except one at `path` itself."""
    return path.resolve() if path.name in ("", "..") else path.parent.resolve() / path.name


def _remove_stale(target: Path) -> None:
    """Windows does not tell whether a process with a number runs: nothing is removed there."""
    if os.name != "posix":
        return
    for folder in target.parent.glob(f".{glob.escape(target.name)}.*.partial"):
        pattern = rf".*\.{re.escape(platform.node())}-(\d+)-\w+\.partial"
        match = re.fullmatch(pattern, folder.name)
        if match and not _is_running(int(match[1])):
            shutil.rmtree(folder, ignore_errors=True)


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:  # another user's
        return True
    return True


def require_replaceable(
    target: Path, marker_file: str = RESULT_FILE, content_word: str = "run"
) -> None:
    """Raise an `InputError` if a place for a run folder holds anything but an earlier run; a
    missing or empty folder passes.

    Parameters
    ----------
    target : Path
        Place of the folder.
    marker_file : str
        Name of a file by which an earlier run is recognised.
    content_word : str
        Word for the content in messages, such as "run".

    Raises
    ------
    InputError
        Naming the place: for a link, a file, a mount point, a folder with files but no
        `marker_file`, and a run with a link or a file that this
        program did not write or that was changed since, which is named too.
    """
    require_no_link(target)
    if not target.exists():
        return
    if not target.is_dir():
        raise InputError(
            "this is a file; expected a folder for the run: choose another path", target
        )
    if os.path.ismount(target):
        raise InputError(
            "this is a mount point and cannot be replaced; choose a folder in it", target
        )
    if not any(target.iterdir()):
        return
    if not (target / marker_file).is_file():
        raise InputError(
            f"the folder has files but no {marker_file}, so that it is not an earlier "
            f"{content_word} and is not replaced; choose another folder",
            target,
        )
    require_only_written(target)


def require_no_link(folder: Path) -> None:
    """Raise an `InputError`, naming the link, if `folder` is a link; a missing folder passes."""
    if folder.is_symlink():
        raise InputError(
            f"this is a link to {os.readlink(folder)}, and nothing is written through links; use "
            "the folder itself or another one, or remove the link",
            folder,
        )


def require_only_written(folder: Path) -> None:
    """Raise an `InputError` if a folder contains a link, a file that this program did not write, or
    a file that was changed since.

    Raises
    ------
    InputError
        Naming the folder and the first such file.
    """
    file = next(foreign_files(folder), None)
    if file is None:
        return
    name = file.relative_to(folder).as_posix()
    if file.is_symlink():
        why = f"{name} in this folder is a link"
    elif (folder / LIST_FILE).is_file():
        why = f"{name} in this folder was not written by this program, or was changed since"
    else:
        why = (
            f"this folder has no {LIST_FILE}, which lists what this program wrote, but it contains "
            f"{name}"
        )
    raise InputError(
        f"{why}, so that the folder is not replaced; choose another folder, or move {name} to "
        "another place",
        folder,
    )


def _replace_folder(new: Path, target: Path, backup: Path) -> None:
    if not target.exists():
        new.rename(target)
        return
    target.rename(backup)
    try:
        new.rename(target)
    except OSError:
        backup.rename(target)
        raise
    shutil.rmtree(backup, ignore_errors=True)
