"""Mesh files, read and written through meshio as plain arrays.

`mesh.TetMesh.read` and `TetMesh.write` use these functions. `read_content` reads in an isolated
process: on damaged files some readers of meshio do not terminate, or allocate memory without limit.
Small .vtu files, the format that this package writes, are read in this process: time and memory of
their reader are bounded by the size of the file.
"""

from __future__ import annotations

import contextlib
import io
import json
import re
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...common.files import require_regular, require_size
from ...common.isolated_process import Failed, ProcessLimits, run_isolated
from ...errors import InputError
from .checks import straightening_notes

METRES_PER_UNIT = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": 0.0254}

_TETRAHEDRA = ("tetra", "tetra10")
_TRIANGLES = ("triangle", "triangle6")
# Files of Gmsh that meshio does not read, by the beginning of a section or by what meshio says.
_GMSH_FAULTS = {
    "parametric": "its nodes have parametric coordinates; expected a file that Gmsh saved with "
    "Mesh.SaveParametric = 0",
    "gmsh:physical": "some of its entities belong to a physical group and others to none; expected a "
    "file that Gmsh saved with Mesh.SaveAll = 0, with a group of each entity, or with "
    "Mesh.MshFileVersion = 2.2",
}
_SOLID_CELLS = ("tetra", "hexahedron", "wedge", "pyramid", "polyhedron")


def length_in_metres(length_unit: str) -> float:
    """Return the length of one "m", "cm", "mm", "um" or "in" in metres.

    Raises
    ------
    InputError
        For an unknown unit.
    """
    if length_unit not in METRES_PER_UNIT:
        known = ", ".join(f'"{unit}"' for unit in METRES_PER_UNIT)
        raise InputError(f"length unit {length_unit!r} is unknown; use one of {known}")
    return METRES_PER_UNIT[length_unit]


Arrays = dict[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class TetrahedraContent:
    """Tetrahedra of a mesh file, with the data on them."""

    # (n, 3) float64: all points of the file [m], also those that no tetrahedron has.
    points_m: np.ndarray
    tetrahedra: np.ndarray  # (E, 4): node indices, E > 0, in the order of the file
    # dict of name to (n, ...): point data of the file, and as booleans its point sets and the nodes
    # of its cell sets and physical groups, whatever the dimension of their cells.
    point_arrays: Arrays
    # dict of name to (E, ...): cell data, cell sets and physical groups of the tetrahedra.
    cell_arrays: Arrays
    # dict of name to (k, 3): triangles of the file, by their cell sets and physical groups, and by
    # cell data that are 1 on them and 0 on others.
    face_sets: Arrays
    notes: tuple[str, ...]  # sentences about omitted cells and straightened sides, if any


def read_tetrahedra(path: str | Path, length_unit: str = "m") -> TetrahedraContent:
    """Read the tetrahedra of a file, quadratic ones by their corners; other cells are omitted.

    The mesh is not checked beyond its sides, see `checks`.

    Parameters
    ----------
    path : str or Path
        File whose extension states the format.
    length_unit : {"m", "cm", "mm", "um", "in"}
        Unit of the coordinates in the file.

    Raises
    ------
    InputError
        If the unit is unknown, the file cannot be read, contains no tetrahedra, or their sides are
        strongly curved.
    """
    metres = length_in_metres(length_unit)
    with _read_with_meshio(path) as data:
        return _tetrahedra(data, metres)


def _tetrahedra(data: MeshContent, metres: float) -> TetrahedraContent:
    counts = _cell_counts(data)
    points_m = np.asarray(data.points, dtype=float) * metres
    blocks = [block for block in data.cells if block.type in _TETRAHEDRA and len(block.data)]
    if not blocks:
        filled = (
            "; a closed surface can be filled with tetrahedra: state it as surface, with "
            "edge_length_m, in [object] (in Python TetMesh.from_surface)"
        )
        hint = filled if "triangle" in counts else ""
        raise InputError(
            f"found {_listed(counts)}, but no tetrahedra; expected a mesh of the volume with cells "
            f"of meshio's type tetra or tetra10{hint}"
        )
    notes = _note_omitted_cells(counts)
    quadratic = [block.data for block in blocks if block.type == "tetra10"]
    if quadratic:
        notes += straightening_notes(points_m, np.concatenate(quadratic))
    # Where a cell is in several groups, the sets of a .msh file tell all, its tags only the first.
    groups = {**_physical_groups(data), **_cell_sets(data)}
    nodes = {name: _nodes_of(data, per_block) for name, per_block in groups.items()}
    cell_arrays = {**groups, **data.cell_data}
    return TetrahedraContent(
        points_m,
        np.concatenate([block.data[:, :4] for block in blocks]),
        point_arrays={**nodes, **_point_sets(data), **data.point_data},
        cell_arrays=_of_tetrahedra(data, cell_arrays),
        face_sets=_triangle_sets(data, cell_arrays),
        notes=notes,
    )


def read_triangles(path: str | Path, length_unit: str = "m") -> tuple[np.ndarray, np.ndarray]:
    """Read the vertices (p, 3) in metres and triangles (F, 3) of a surface file.

    Quadrilaterals and polygons are split into triangles, as fans about their first corner; other
    cells are ignored. The surface is not checked.

    Parameters
    ----------
    path : str or Path
        File whose extension states the format.
    length_unit : {"m", "cm", "mm", "um", "in"}
        Unit of the coordinates in the file.

    Raises
    ------
    InputError
        If the unit is unknown, the file cannot be read or contains no triangles.
    """
    metres = length_in_metres(length_unit)
    with _read_with_meshio(path) as data:
        faces = [
            np.asarray(block.data, dtype=np.int64)
            for block in data.cells
            if block.type in ("triangle", "quad", "polygon") and len(block.data)
        ]
        # A face of fewer than three corners, of which there is nothing to join, is a damaged file.
        fans = [
            np.concatenate([face[:, [0, k, k + 1]] for k in range(1, face.shape[1] - 1)])
            for face in faces
        ]
        if not fans:
            raise InputError(
                f"found {_listed(_cell_counts(data))}, but no triangles; expected a surface of "
                "triangles, quadrilaterals or polygons"
            )
        # An OBJ vertex may carry a colour after its coordinates.
        return np.asarray(data.points, dtype=float)[:, :3] * metres, np.concatenate(fans)


def write_tetrahedra(
    path: str | Path,
    points_m: np.ndarray,
    tetrahedra: np.ndarray,
    point_arrays: Mapping[str, np.ndarray] | None = None,
    cell_arrays: Mapping[str, np.ndarray] | None = None,
) -> None:
    """Write a mesh, in metres, to any format that meshio knows by the file's extension; booleans
    become integers.

    Parameters
    ----------
    path : str or Path
        Replaced if it exists.
    points_m : (n, 3)
    tetrahedra : (E, 4) int
    point_arrays, cell_arrays : mapping of name to array, optional
        Values of each point and each tetrahedron; none by default.

    Raises
    ------
    InputError
        If the format is unknown or cannot hold the mesh.
    OSError
        If the file cannot be created.
    """
    import meshio  # slow to import

    point_data: dict[str, Any] = {n: _without_booleans(v) for n, v in (point_arrays or {}).items()}
    cell_data: dict[str, Any] = {n: [_without_booleans(v)] for n, v in (cell_arrays or {}).items()}
    mesh = meshio.Mesh(points_m, [("tetra", tetrahedra)], point_data, cell_data)
    with _as_input_error(path, "written"):
        meshio.write(path, mesh)


def _without_booleans(values: np.ndarray) -> np.ndarray:
    """Return booleans as uint8, because few formats have a boolean type; other arrays unchanged."""
    return values.astype(np.uint8) if values.dtype == bool else values


@contextlib.contextmanager
def _read_with_meshio(path: str | Path) -> Iterator[MeshContent]:
    if not Path(path).is_file():
        raise InputError("there is no such file", path)
    require_regular(path)
    require_size(path)
    try:
        content = read_content(path)
    except InputError as error:
        raise _unreadable_error("read", error.message, path=path) from error
    with _as_input_error(path, "read"):
        yield content


@contextlib.contextmanager
def _as_input_error(path: str | Path, done: str) -> Iterator[None]:
    """Turn a failure on an invalid file into one `InputError`, and print nothing."""
    captured = io.StringIO()
    try:
        with _printing_to(captured):
            yield
    except InputError as error:
        raise error.located(path) from None
    except (Exception, SystemExit) as error:
        if isinstance(error, OSError) and done == "written":  # it tells its file itself
            raise
        raise _unreadable_error(done, _reason(error, captured), path=path) from error


@contextlib.contextmanager
def _printing_to(captured: io.StringIO) -> Iterator[None]:
    """Print into `captured` and ignore warnings."""
    with (
        contextlib.redirect_stdout(captured),
        contextlib.redirect_stderr(captured),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore")
        yield


def _reason(error: BaseException, captured: io.StringIO) -> str:
    """Return what was printed before an error, or the error."""
    return " ".join(captured.getvalue().split()) or f"{type(error).__name__}: {error}"


def _unreadable_error(done: str, reason: str, path: str | Path) -> InputError:
    if missing := re.search(r"No module named '(\w+)'", reason):
        package = missing[1]
        return InputError(
            f"the format {Path(path).suffix} needs the package {package}, which is not installed: "
            f"pip install {package}; or convert the mesh to .vtu",
            path,
        )
    if done == "read" and b"$ParametricNodes" in Path(path).read_bytes():
        reason = "parametric"
    for said, fault in _GMSH_FAULTS.items():
        if said in reason:
            return InputError(fault, path)
    return InputError(
        f"the file cannot be {done} as a mesh ({reason}); formats such as .vtu, .vtk, .msh, .mesh "
        "and .inp are known, recognised by the file's ending",
        path,
    )


def _point_sets(data: MeshContent) -> dict[str, np.ndarray]:
    sets = {}
    for name, nodes in (data.point_sets or {}).items():
        sets[name] = np.zeros(len(data.points), dtype=bool)
        sets[name][np.asarray(nodes, dtype=np.int64)] = True
    return sets


def _cell_sets(data: MeshContent) -> dict[str, list[np.ndarray]]:
    sets = {}
    for name, per_block in (data.cell_sets or {}).items():
        if name == "gmsh:bounding_entities":  # numbers of entities, not of cells
            continue
        sets[name] = [np.zeros(len(block.data), dtype=bool) for block in data.cells]
        for mask, cells in zip(sets[name], per_block, strict=False):
            if cells is not None:
                mask[np.asarray(cells, dtype=np.int64)] = True
    return sets


def _physical_groups(data: MeshContent) -> dict[str, list[np.ndarray]]:
    """Return the physical groups of a .msh file by name, as boolean arrays block by block."""
    tags = [np.asarray(block).ravel() for block in data.cell_data.get("gmsh:physical", ())]
    if not tags:
        return {}
    names = {tuple(map(int, key)): name for name, key in (data.field_data or {}).items()}
    masks: dict[tuple[int, int], list[np.ndarray]] = {}
    for dimension in range(4):
        tags_of_dimension = [
            np.where(b.dim == dimension, t, 0) for b, t in zip(data.cells, tags, strict=True)
        ]
        for tag in np.unique(np.concatenate(tags_of_dimension)):
            if tag > 0:
                masks[int(tag), dimension] = [block == tag for block in tags_of_dimension]
    nameless = Counter(tag for tag, dimension in masks if (tag, dimension) not in names)
    return {
        names.get(key) or _group_name(*key, nameless[key[0]] > 1): m for key, m in masks.items()
    }


def _group_name(tag: int, dimension: int, ambiguous: bool) -> str:
    """Return "physical_3", or "physical_3_surface" if other dimensions have this tag too."""
    kind = ("points", "lines", "surface", "volume")[dimension]
    return f"physical_{tag}_{kind}" if ambiguous else f"physical_{tag}"


def _nodes_of(data: MeshContent, masks: list[np.ndarray]) -> np.ndarray:
    chosen = np.zeros(len(data.points), dtype=bool)
    for block, mask in zip(data.cells, masks, strict=True):
        chosen[np.asarray(block.data)[mask].ravel()] = True
    return chosen


def _of_tetrahedra(data: MeshContent, arrays: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Return the values (E, …) on tetrahedra of arrays given block by block, by name."""
    tetrahedra = [block.type in _TETRAHEDRA and len(block.data) > 0 for block in data.cells]
    selected = {}
    for name, per_block in arrays.items():
        parts = [
            np.asarray(p)
            for p, is_selected in zip(per_block, tetrahedra, strict=True)
            if is_selected
        ]
        values = np.concatenate(parts)
        if values.dtype != bool or values.any():
            selected[name] = values
    return selected


def _triangle_sets(data: MeshContent, arrays: Mapping[str, Any]) -> Arrays:
    """Return the triangles (k, 3) on which arrays of only 0 and 1, by block, are 1."""
    blocks = [k for k, block in enumerate(data.cells) if block.type in _TRIANGLES]
    sets = {}
    for name, per_block in arrays.items():
        masks = [np.asarray(per_block[k]) for k in blocks]
        if masks and all(m.ndim == 1 and np.isin(m, (0, 1)).all() for m in masks):
            chosen = [data.cells[k].data[m == 1, :3] for k, m in zip(blocks, masks, strict=True)]
            if any(map(len, chosen)):
                sets[name] = np.concatenate(chosen)
    return sets


def _cell_counts(data: MeshContent) -> Counter[str]:
    counts: Counter[str] = Counter()
    for block in data.cells:
        counts[block.type] += len(block.data)
    return counts


def _listed(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {name}" for name, count in counts.items()) or "no cells at all"


def _note_omitted_cells(counts: Mapping[str, int]) -> tuple[str, ...]:
    others = {name: count for name, count in counts.items() if name not in _TETRAHEDRA and count}
    if not others:
        return ()
    solid = any(name.startswith(_SOLID_CELLS) for name in others)
    warning = ": this part of the body is missing. Mesh it with tetrahedra" if solid else ""
    return (f"Cells other than tetrahedra were left out ({_listed(others)}){warning}.",)


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
        with _printing_to(captured):
            mesh: Any = meshio.read(path)
    except (Exception, SystemExit) as error:
        raise InputError(_reason(error, captured)[:LONGEST_REASON]) from error
    return MeshContent(
        points=np.asarray(mesh.points),
        cells=[CellBlock(block.type, block.dim, data=block.data) for block in mesh.cells],
        point_data=mesh.point_data,
        field_data=mesh.field_data,
        point_sets=mesh.point_sets,
        cell_data=mesh.cell_data,
        cell_sets=mesh.cell_sets,
    )
