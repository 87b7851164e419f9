"""Files of a run: frames for ParaView, and a folder that is there whole or not at all."""

from __future__ import annotations

import glob
import os
import platform
import re
import secrets
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape, quoteattr

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError
from ..fem.elements import Element
from ..files import RESULT_FILE, naming
from ..written_files import LIST_FILE, foreign_files, list_files
from .fields import ElementFields

VTK_CELL_TYPES = ("tetra", "tetra10")  # by meshio's names
MAX_FRAMES = 200
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
    """Write an unstructured grid of one cell type as VTK XML with base64 data.

    Parameters
    ----------
    path : str or Path
    points_m : (n, 3)
    cells : (E, nodes per cell) node numbers
    meshio_type : {"tetra", "tetra10"}
    point_data : mapping of name to (n,) or (n, k) numbers
    cell_data : mapping of name to (E,) or (E, k) numbers

    Raises
    ------
    InputError
        For an unknown cell type, or data of another length.
    """
    import meshio  # which takes a while to import

    if meshio_type not in VTK_CELL_TYPES:
        raise InputError(
            f"no cell type {meshio_type!r}; available: {', '.join(VTK_CELL_TYPES)}", path
        )
    points, nodes = np.asarray(points_m, dtype=float), np.asarray(cells, dtype=np.int64)
    at_points = _arrays("point", point_data or {}, len(points), path)
    in_cells = _arrays("cell", cell_data or {}, len(nodes), path)
    by_block: dict[str, Any] = {name: [array] for name, array in in_cells.items()}
    mesh = meshio.Mesh(points, [(meshio_type, nodes)], {**at_points}, by_block)
    meshio.vtu.write(path, mesh, compression="")


def _arrays(
    kind: str, data: Mapping[str, ArrayLike], count: int, path: str | Path
) -> dict[str, NDArray]:
    """Arrays of kinds that the format has, with a row each."""
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
    return {escape(name, {'"': "&quot;"}): array for name, array in arrays.items()}


def write_pvd(path: str | Path, frames: Sequence[tuple[float, str | Path]]) -> None:
    """Write the list of (t_s, file) that ParaView opens as one animation.

    Files are named relative to the list's own folder.
    """
    folder = Path(path).parent.resolve()
    lines = []
    for t_s, file in frames:
        name = Path(os.path.relpath(Path(file).resolve(), folder)).as_posix()
        lines.append(f'<DataSet timestep="{t_s:.9g}" part="0" file={quoteattr(name)}/>\n')
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
    max_frames: int = MAX_FRAMES,
    fields: ElementFields | None = None,
    cell_data: Mapping[str, ArrayLike] | None = None,
) -> Path:
    """Write a trajectory as frames/frame_0000.vtu, … and trajectory.pvd, and return the latter.

    Every frame has `displacement_m` and `velocity_m_s` at the points, and the `fields` in the
    cells. Of more than `max_frames` samples every second, third, … is written.

    Parameters
    ----------
    folder : str or Path
        Exists.
    t_s : (T,) evenly spaced
    positions_m : (T, n, 3)
    cells : (E, nodes per element)
    element : Element
    undeformed_m : (n, 3)
    point_series : mapping of name to (T, n) or (T, n, k) numbers
    fields : ElementFields, optional
    cell_data : mapping of name to (E,), the same in every frame
    """
    times, positions = np.asarray(t_s, dtype=float), np.asarray(positions_m, dtype=float)
    alone = len(times) == 1
    velocities = np.zeros_like(positions) if alone else np.gradient(positions, times, axis=0)
    series = {name: np.asarray(values) for name, values in (point_series or {}).items()}
    frames = Path(folder) / "frames"
    frames.mkdir(exist_ok=True)
    written = []
    for number, k in enumerate(range(0, len(times), -(-len(times) // max_frames))):
        file = frames / f"frame_{number:04d}.vtu"
        data = {
            "displacement_m": positions[k] - undeformed_m,
            "velocity_m_s": velocities[k],
            **{name: values[k] for name, values in series.items()},
        }
        in_cells = dict(cell_data or {})
        if fields is not None:
            in_cells |= {name: values[0] for name, values in fields.at(positions[k]).items()}
        write_vtu(file, positions[k], cells, element.meshio_type, data, in_cells)
        written.append((float(times[k]), file))
    listing = Path(folder) / FRAMES_FILE
    write_pvd(listing, written)
    return listing


# Folder ---------------------------------------------------------------------------------------


@contextmanager
def run_folder(
    path: str | Path, overwrite: bool = True, mark: str = RESULT_FILE, what: str = "run"
) -> Iterator[Path]:
    """Give a temporary folder beside `path` to write into, and name it `path` at the end.

    An earlier run at `path` is replaced, at the end and whole, if every file in it was written by
    this program and is unchanged. After an exception the temporary folder is removed and `path` is
    as it was. The folder gets a list of its files, see `written_files`.

    Parameters
    ----------
    path : str or Path
    overwrite : bool
        Whether an earlier run may be replaced.
    mark, what : str
        The file by which an earlier one is known, and what messages call it.

    Raises
    ------
    InputError
        If there is anything else at `path`, or a link; at once, so that no work is lost.
    """
    target = _unlinked(Path(path))
    require_replaceable(target, overwrite, mark, what)
    target.parent.mkdir(parents=True, exist_ok=True)
    _remove_stale(target)
    owner = f"{platform.node()}-{os.getpid()}-{secrets.token_hex(4)}"
    temporary = target.with_name(f".{target.name}.{owner}.partial")
    temporary.mkdir()
    try:
        with naming(target, temporary):
            yield temporary
            list_files(temporary)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise
    try:
        require_replaceable(target, overwrite, mark, what)
        _put_in_place(temporary, target, target.with_name(f".{target.name}.{owner}.old"))
    except (InputError, OSError) as error:
        kept = target.with_name(f"{target.name}-{owner}")
        with suppress(OSError):
            temporary = temporary.rename(kept)
        raise InputError(
            f"the finished run cannot be put there ({error}); it is kept in {temporary}", target
        ) from error


def _unlinked(path: Path) -> Path:
    """The absolute path without links in the folders above; the last one is kept."""
    return path.resolve() if path.name in ("", "..") else path.parent.resolve() / path.name


def _remove_stale(target: Path) -> None:
    """Remove what a process of this machine that was killed left beside the run's place.

    Windows tells nothing of other processes by their numbers; there it stays.
    """
    if os.name != "posix":
        return
    for folder in target.parent.glob(f".{glob.escape(target.name)}.*.partial"):
        left = rf".*\.{re.escape(platform.node())}-(\d+)-\w+\.partial"
        match = re.fullmatch(left, folder.name)
        if match and not _runs(int(match[1])):
            shutil.rmtree(folder, ignore_errors=True)


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:  # another user's
        return True
    return True


def require_replaceable(
    target: Path, overwrite: bool = True, mark: str = RESULT_FILE, what: str = "run"
) -> None:
    """Refuse a place for a run folder that holds anything but an earlier run.

    Raises
    ------
    InputError
        Naming the place, and the first link or file there that this program did not write.
    """
    require_no_link(target)
    if not target.exists():
        return
    if not target.is_dir():
        raise InputError("is a file, expected a folder for the run; choose another", target)
    if os.path.ismount(target):
        raise InputError("is a mount point and cannot be replaced; choose a folder in it", target)
    if not any(target.iterdir()):
        return
    if not (target / mark).is_file():
        raise InputError(
            f"the folder has files but no {mark}, so it is not an earlier {what} and is left "
            "alone; choose another folder",
            target,
        )
    if not overwrite:
        raise InputError(
            "the folder holds an earlier run; choose another, or allow it to be overwritten", target
        )
    require_only_written(target)


def require_no_link(folder: Path) -> None:
    """Refuse a link where a folder is to be written.

    Raises
    ------
    InputError
        Naming the link.
    """
    if folder.is_symlink():
        raise InputError(
            f"is a link to {os.readlink(folder)}, and nothing is written through links; give that "
            "folder itself or another, or remove the link",
            folder,
        )


def require_only_written(folder: Path) -> None:
    """Refuse a folder with a file or link that this program did not write, or that was changed.

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
        why = f"{name} in it is a link"
    elif (folder / LIST_FILE).is_file():
        why = f"{name} in it was not written by this program, or was changed since"
    else:
        why = f"it has no {LIST_FILE}, which lists what this program wrote, but has {name}"
    raise InputError(
        f"{why}, so the folder is left alone; choose another, or move that away", folder
    )


def _put_in_place(new: Path, target: Path, aside: Path) -> None:
    if not target.exists():
        new.rename(target)
        return
    target.rename(aside)
    try:
        new.rename(target)
    except OSError:
        aside.rename(target)
        raise
    shutil.rmtree(aside, ignore_errors=True)
