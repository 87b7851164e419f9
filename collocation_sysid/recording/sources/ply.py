"""Points of PLY files (polygon file format): the columns of the element `vertex`.

Files whose first element is `vertex` with numbers only, as scanners write them, are read here:
the time and memory that this takes are bounded by the size of the file. Others are read by meshio,
whose isolated process starts anew for each image of a recording.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...common.array_types import Array
from ...errors import InputError
from ...fem.meshes.files import read_content

# More bytes of header than any program writes.
LONGEST_HEADER = 100_000
_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}


def read_columns(path: Path) -> Mapping[str, Array]:
    """Return the (P,) columns of the points by name, among them x, y and z.

    Raises
    ------
    InputError
        If the file is damaged; the path is not always named.
    """
    content = path.read_bytes()
    columns = _plain_columns(content)
    if columns is not None:
        return columns
    if b"end_header" not in content[:LONGEST_HEADER]:
        raise InputError("the file has no line end_header; expected a complete .ply file")
    try:
        mesh = read_content(path)
    except InputError as error:
        raise InputError(
            f"the file cannot be read ({error.message}); expected a valid .ply file", path
        ) from error
    points = np.asarray(mesh.points, dtype=float)
    return {**mesh.point_data, **dict(zip("xyz", points.T, strict=False))}


def _plain_columns(content: bytes) -> Mapping[str, Array] | None:
    """Return columns by name if the first element is `vertex` with numbers only."""
    header, end, body = content[:LONGEST_HEADER].partition(b"end_header\n")
    lines = [line.split() for line in header.decode("ascii", "replace").splitlines()]
    lines = [words for words in lines if words and words[0] not in ("comment", "obj_info")]
    if not end or len(lines) < 3 or lines[0] != ["ply"] or b"\r" in header:
        return None
    _, form, element, *properties = lines
    is_vertex = element[:2] == ["element", "vertex"] and len(element) == 3
    if form[0] != "format" or len(form) < 2 or not is_vertex or not element[2].isdecimal():
        return None
    count = int(element[2])
    fields: list[tuple[str, str]] = []
    for words in properties:
        if words[0] == "element":
            break
        if words[0] != "property" or len(words) != 3 or words[1] not in _TYPES:
            return None
        fields.append((words[2], _TYPES[words[1]]))
    names = [name for name, _ in fields]
    if len({*names}) < len(names) or not {*"xyz"} <= {*names}:
        return None
    body = content[len(header) + len(end) :]
    if form[1] in _ORDERS:
        row = np.dtype([(name, _ORDERS[form[1]] + kind) for name, kind in fields])
        if len(body) < count * row.itemsize:
            _refuse_short(count, len(body) // row.itemsize)
        rows: NDArray = np.frombuffer(body, row, count)
        return {name: rows[name].astype(float) for name in names}
    if form[1] != "ascii":
        return None
    points = body.decode("ascii", "replace").splitlines()[:count]
    if len(points) < count:
        _refuse_short(count, len(points))
    if not count:
        return {name: np.empty(0) for name in names}
    values = np.loadtxt(points, ndmin=2)
    if values.shape != (count, len(names)):
        _refuse_short(count, len(values))
    return dict(zip(names, values.T, strict=True))


def _refuse_short(expected: int, count: int) -> None:
    raise InputError(
        f"the file has {count} points; expected {expected}, as its header states: it may be "
        "truncated"
    )
