"""Contents of mesh and point files as read by meshio, in an isolated process.

Use `read_content`. On damaged files some readers of meshio do not terminate, or allocate memory
without limit. Small .vtu files, the format that this package writes, are read in this process: time
and memory of their reader are bounded by the size of the file.
"""

from __future__ import annotations

import contextlib
import io
import json
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...common.isolated_process import Failed, ProcessLimits, run_isolated
from ...errors import InputError

# Largest file that is read in this process [bytes]. Zlib compresses at most 1032-fold, so that the
# content takes up to 200 MB.
SMALL_BYTES = 200_000
# Largest number of characters of meshio's output that a message quotes.
LONGEST_REASON = 300

# Program of the isolated process. It returns all data as arrays, and their names as JSON in a
# further array.
WORKER = """
import contextlib, io, json, warnings
said = io.StringIO()
try:
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        warnings.simplefilter("ignore")
        import meshio
        mesh = meshio.read(sys.argv[1])
    found = {"points": numpy.asarray(mesh.points, dtype=float)}
    def kept(value):
        array = numpy.asarray(value)
        if array.dtype == object:
            raise ValueError("has rows of different lengths")
        key = f"array_{len(found)}"
        found[key] = array
        return key
    head = {
        "cells": [(block.type, int(block.dim), kept(block.data)) for block in mesh.cells],
        "point_data": [(name, kept(of)) for name, of in mesh.point_data.items()],
        "field_data": [(name, kept(of)) for name, of in mesh.field_data.items()],
        "point_sets": [(name, kept(of)) for name, of in mesh.point_sets.items()],
        "cell_data": [(name, [*map(kept, of)]) for name, of in mesh.cell_data.items()],
        "cell_sets": [
            (name, [None if each is None else kept(each) for each in of])
            for name, of in mesh.cell_sets.items()
        ],
    }
    found["head"] = numpy.frombuffer(json.dumps(head).encode(), dtype="u1")
except (Exception, SystemExit) as error:
    reason = " ".join(said.getvalue().split()) or f"{type(error).__name__}: {error}"
    sys.exit(" ".join(reason.split())[:LONGEST_REASON])
""".replace("LONGEST_REASON", str(LONGEST_REASON))


@dataclass(frozen=True)
class CellBlock:
    """Cells of one type."""

    type: str  # name of the type in meshio
    dim: int  # dimension of the cells
    data: NDArray[Any]  # (n, nodes per cell): node indices


@dataclass(frozen=True)
class MeshContent:
    """Content of a mesh or point file, with the names and forms of meshio."""

    points: NDArray[Any]  # (n, k)
    cells: list[CellBlock]
    point_data: Mapping[str, NDArray[Any]]
    field_data: Mapping[str, NDArray[Any]]
    point_sets: Mapping[str, NDArray[Any]]
    cell_data: Mapping[str, list[NDArray[Any]]]
    cell_sets: Mapping[str, list[NDArray[Any] | None]]


def read_content(path: str | Path) -> MeshContent:
    """Read a mesh or point file, whose format follows from its extension.

    Only small, harmless files are read in this process, all others in a separate one with limits of
    time and memory.

    Raises
    ------
    InputError
        With the reason, without the path, if meshio cannot read the file or exceeds the limits.
    """
    if _is_small_and_safe(Path(path)):
        return _read_in_process(path)
    try:
        absolute = str(Path(path).resolve())
        arrays = run_isolated(WORKER, absolute, limits=ProcessLimits.for_file(path))
    except Failed as error:
        raise InputError(str(error)) from error
    head = json.loads(arrays["head"].tobytes())
    return MeshContent(
        points=arrays["points"],
        cells=[CellBlock(kind, dim, data=arrays[key]) for kind, dim, key in head["cells"]],
        point_data={name: arrays[key] for name, key in head["point_data"]},
        field_data={name: arrays[key] for name, key in head["field_data"]},
        point_sets={name: arrays[key] for name, key in head["point_sets"]},
        cell_data={name: [arrays[key] for key in keys] for name, keys in head["cell_data"]},
        cell_sets={
            name: [None if key is None else arrays[key] for key in keys]
            for name, keys in head["cell_sets"]
        },
    )


def _is_small_and_safe(path: Path) -> bool:
    """Return whether a file is a small .vtu that decoding cannot enlarge."""
    if path.suffix.lower() != ".vtu" or path.stat().st_size > SMALL_BYTES:
        return False
    content = path.read_bytes()
    has_entities = b"<!" in content.replace(b"<!--", b"")
    return b"<VTKFile" in content and b"LZMA" not in content and not has_entities


def _read_in_process(path: str | Path) -> MeshContent:
    import meshio  # slow to import

    captured = io.StringIO()
    try:
        with (
            contextlib.redirect_stdout(captured),
            contextlib.redirect_stderr(captured),
            warnings.catch_warnings(),
        ):
            warnings.simplefilter("ignore")
            mesh: Any = meshio.read(path)
    except (Exception, SystemExit) as error:
        reason = " ".join(captured.getvalue().split()) or f"{type(error).__name__}: {error}"
        raise InputError(reason[:LONGEST_REASON]) from error
    return MeshContent(
        points=np.asarray(mesh.points),
        cells=[CellBlock(block.type, block.dim, data=block.data) for block in mesh.cells],
        point_data=mesh.point_data,
        field_data=mesh.field_data,
        point_sets=mesh.point_sets,
        cell_data=mesh.cell_data,
        cell_sets=mesh.cell_sets,
    )
