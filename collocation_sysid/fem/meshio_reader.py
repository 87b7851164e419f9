"""Contents of mesh and point files as meshio reads them, in an isolated process.

On damaged files some readers of meshio do not terminate, or take memory without end. Small .vtu
files, the format that this package writes, are read in this process: the time and memory that their
reader takes are bounded by the size of the file.
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

from ..apart import Failed, ProcessLimits, computed_apart
from ..errors import InputError

# Zlib makes a file at most 1032 times smaller, so this takes up to 200 MB.
SMALL_BYTES = 200_000
# Letters of what meshio prints that are quoted.
LONGEST_REASON = 300

# Everything that meshio reads as arrays, and its names, as JSON, in one of them.
_WORKER = """
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
    """Cells of one type; `dim` is their dimension, and `data` (n, nodes per cell) their nodes."""

    type: str
    dim: int
    data: NDArray[Any]


@dataclass(frozen=True)
class MeshContent:
    """What a file holds, with the names and forms of meshio.

    Attributes
    ----------
    points : (n, k) array
    cells : list of CellBlock
    point_data, field_data, point_sets : mapping of name to array
    cell_data : mapping of name to one array for each block
    cell_sets : mapping of name to one array, or None, for each block
    """

    points: NDArray[Any]
    cells: list[CellBlock]
    point_data: Mapping[str, NDArray[Any]]
    field_data: Mapping[str, NDArray[Any]]
    point_sets: Mapping[str, NDArray[Any]]
    cell_data: Mapping[str, list[NDArray[Any]]]
    cell_sets: Mapping[str, list[NDArray[Any] | None]]


def read_content(path: str | Path) -> MeshContent:
    """Read a mesh or point file; its format is told by its ending.

    Raises
    ------
    InputError
        With the reason, if meshio cannot read it or takes too much time or memory. The path is not
        named.
    """
    if _is_harmless(Path(path)):
        return _read_here(path)
    try:
        absolute = str(Path(path).resolve())
        found = computed_apart(_WORKER, absolute, limits=ProcessLimits.for_file(path))
    except Failed as error:
        raise InputError(str(error)) from error
    head = json.loads(found["head"].tobytes())
    return MeshContent(
        points=found["points"],
        cells=[CellBlock(kind, dim, found[key]) for kind, dim, key in head["cells"]],
        point_data={name: found[key] for name, key in head["point_data"]},
        field_data={name: found[key] for name, key in head["field_data"]},
        point_sets={name: found[key] for name, key in head["point_sets"]},
        cell_data={name: [found[key] for key in keys] for name, keys in head["cell_data"]},
        cell_sets={
            name: [None if key is None else found[key] for key in keys]
            for name, keys in head["cell_sets"]
        },
    )


def _is_harmless(path: Path) -> bool:
    """Whether a file is a small .vtu without what could take more than its size promises."""
    if path.suffix.lower() != ".vtu" or path.stat().st_size > SMALL_BYTES:
        return False
    content = path.read_bytes()
    has_entities = b"<!" in content.replace(b"<!--", b"")
    return b"<VTKFile" in content and b"LZMA" not in content and not has_entities


def _read_here(path: str | Path) -> MeshContent:
    import meshio  # slow to import

    said = io.StringIO()
    try:
        with (
            contextlib.redirect_stdout(said),
            contextlib.redirect_stderr(said),
            warnings.catch_warnings(),
        ):
            warnings.simplefilter("ignore")
            mesh: Any = meshio.read(path)
    except (Exception, SystemExit) as error:
        reason = " ".join(said.getvalue().split()) or f"{type(error).__name__}: {error}"
        raise InputError(reason[:LONGEST_REASON]) from error
    return MeshContent(
        points=np.asarray(mesh.points),
        cells=[CellBlock(block.type, block.dim, block.data) for block in mesh.cells],
        point_data=mesh.point_data,
        field_data=mesh.field_data,
        point_sets=mesh.point_sets,
        cell_data=mesh.cell_data,
        cell_sets=mesh.cell_sets,
    )
