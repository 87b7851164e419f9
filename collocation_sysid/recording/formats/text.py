"""Text files as rows of cells: reading, and turning cells into numbers."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...arrays import Array
from ...errors import InputError, excerpt
from ...files import require_regular
from . import Choose, RawTracks

# Nothing measured is larger, and products of two such numbers are still numbers.
LARGEST = 1e100
_ENCODINGS = ("utf-8-sig", "utf-16", "cp1252")
_CONTROL, _SEPARATOR = re.compile("[\x01-\x08\x0e-\x1f]"), re.compile("[,;\t]")
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+([eE][-+]?\d+)?")
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", re.ASCII)
_POINTED = re.compile(r"[-+]?\d*\.\d+([eE][-+]?\d+)?")


@dataclass(frozen=True, eq=False)
class Row:
    """The stripped cells of one line, which is counted from 1."""

    line: int
    cells: list[str]


@dataclass(frozen=True, eq=False)
class Grid:
    """Rows of equal length below column names."""

    path: Path
    columns: list[str]
    rows: list[Row]
    names_line: int = 1

    @property
    def lines(self) -> list[int]:
        """The line of each row."""
        return [row.line for row in self.rows]


def read_bytes(path: str | Path) -> bytes:
    """Return a file's content.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    require_regular(path)
    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", path) from error


def decode(content: bytes, path: str | Path) -> str:
    """Return the text that a file's content is: UTF-8, or as Windows and its machines write it.

    Raises
    ------
    InputError
        If it is empty, or no text.
    """
    text = next(filter(None, (_decoded(content, encoding) for encoding in _ENCODINGS)), None)
    if text is None and content:
        raise InputError("is not a CSV text file (UTF-8), nor any other format known here", path)
    if not text or not text.strip():
        raise _empty(path)
    return text


def _decoded(content: bytes, encoding: str) -> str | None:
    """The text in an encoding; None where it is none."""
    if encoding == "utf-16" and not content.startswith((b"\xff\xfe", b"\xfe\xff")):
        return None
    try:
        text = content.decode(encoding)
    except UnicodeDecodeError:
        return None
    odd = encoding != "utf-8-sig" and (_CONTROL.search(text) or not _SEPARATOR.search(text))
    return None if "\0" in text or odd else text


def _empty(path: str | Path) -> InputError:
    return InputError("is empty; expected a line of column names, then rows of numbers", path)


def separated_rows(text: str, path: str | Path, separator: str | None = None) -> list[Row]:
    """Rows of a file with this between its cells, or what most lines have; blank ones are skipped.

    Where that is no comma and no number has a point, the commas of numbers are points.
    """
    if separator is None:
        lines = text.splitlines()
        shares = {mark: sum(mark in line for line in lines) / len(lines) for mark in ";\t"}
        separator = next((mark for mark, share in shares.items() if share > 0.5), ",")
    rows = _cells(text, path, separator)
    if separator == "," or any(_POINTED.fullmatch(cell) for row in rows for cell in row.cells):
        return rows
    return [Row(row.line, [_pointed(cell) for cell in row.cells]) for row in rows]


def _pointed(cell: str) -> str:
    return cell.replace(",", ".") if _DECIMAL_COMMA.fullmatch(cell) else cell


def _cells(text: str, path: str | Path, separator: str) -> list[Row]:
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=separator)
    try:
        rows = [Row(reader.line_num, [cell.strip() for cell in cells]) for cells in reader]
    except csv.Error as error:
        raise InputError(f"is not a CSV text file: {error}", path) from error
    rows = [row for row in rows if any(row.cells)]
    if not rows:
        raise _empty(path)
    return rows


def tab_rows(text: str) -> list[Row]:
    """Rows of a tab-separated file; lines without any character are skipped."""
    lines = enumerate(re.split("\r\n|\r|\n", text), start=1)
    return [Row(k, [cell.strip() for cell in line.split("\t")]) for k, line in lines if line]


def grid(path: str | Path, columns: list[str], rows: list[Row], names_line: int = 1) -> Grid:
    """Return rows as wide as their column names; blank columns at the end of all rows are cut.

    Raises
    ------
    InputError
        If there is no row, or one is of another length.
    """
    if not rows:
        raise InputError("has column names but no rows of numbers", path)
    width = len(columns)
    common = len(rows[0].cells)
    if common > width and all(len(r.cells) == common and not any(r.cells[width:]) for r in rows):
        rows = [Row(row.line, row.cells[:width]) for row in rows]
    for row in rows:
        if len(row.cells) != width:
            raise InputError(
                f"{len(row.cells)} cells, but the header has {width} columns",
                path,
                f"line {row.line}",
            )
    return Grid(Path(path), columns, rows, names_line)


def numbers(grid: Grid, columns: Sequence[int], blank_allowed: bool) -> Array:
    """The cells of some columns as (rows, columns); NaN where blank.

    Raises
    ------
    InputError
        If a cell is not a finite number; its line and column are named.
    """
    values = np.empty((len(grid.rows), len(columns)))
    for i, row in enumerate(grid.rows):
        for j, column in enumerate(columns):
            cell = row.cells[column]
            try:
                value = written_number(cell) if cell else math.nan
            except ValueError:
                value = math.inf
            if abs(value) > LARGEST or (math.isnan(value) and not blank_allowed):
                or_blank = " or a blank cell" if blank_allowed else ""
                raise InputError(
                    f"column {grid.columns[column]} holds '{excerpt(cell)}'; expected a "
                    f"number{or_blank}",
                    grid.path,
                    f"line {row.line}",
                )
            values[i, j] = value
    return values


def is_number(cell: str) -> bool:
    """Whether a cell is a plain number."""
    return _NUMBER.fullmatch(cell) is not None


def written_number(text: str) -> float:
    """A number as files write it; a `ValueError` for 1_000 and ١, which are so in Python only."""
    if "_" in text or not text.isascii():
        raise ValueError(f"found {text!r}")
    return float(text)


@dataclass(frozen=True)
class Header:
    """What a file states above its frames.

    Attributes
    ----------
    path : str or Path
    stated : mapping of a key to its text and line
    """

    path: str | Path
    stated: Mapping[str, tuple[str, int]]

    def number(self, key: str) -> float | None:
        """The number that a key states; None where it is blank.

        Raises
        ------
        InputError
            If it is no number above 0.
        """
        text, line = self.stated.get(key, ("", 0))
        if not text:
            return None
        try:
            value = written_number(text)
        except ValueError:
            value = math.nan
        if not 0 < value < math.inf:
            message = f"{key} is '{text}'; expected a number above 0"
            raise InputError(message, self.path, f"line {line}")
        return value

    def compare(self, key: str, count: int, what: str, line: int | None = None) -> None:
        """Raise an `InputError` if it states another count than there is."""
        stated = self.number(key)
        if stated is not None and stated != count:
            raise InputError(
                f"{key} is {stated:g}, but {count} {what} are there; is the file cut short?",
                self.path,
                f"line {line or self.stated[key][1]}",
            )


def framed(
    header: Header,
    counted: str,
    rate: str,
    leading: Sequence[str],
    labels: Sequence[str],
    frames: list[Row],
    choose: Choose,
) -> RawTracks:
    """Tracks of a table of frames: some columns, then x, y and z of each marker.

    Parameters
    ----------
    header : Header
    counted, rate : str
        Keys of the number of frames, and of their rate.
    leading : sequence of str
        Columns before those of the markers.
    labels : sequence of str
    frames : list of Row
    choose : Choose
    """
    chosen = choose(labels)
    titles = [f"{label} {axis}" for label in labels for axis in "XYZ"]
    table = grid(header.path, [*leading, *titles], frames)
    header.compare(counted, len(frames), "frames")
    columns = [len(leading) + 3 * k + axis for k in chosen for axis in range(3)]
    timed = "Time" in leading
    return RawTracks(
        labels=[labels[k] for k in chosen],
        coordinates=numbers(table, columns, blank_allowed=True).reshape(-1, len(chosen), 3),
        t_s=numbers(table, [leading.index("Time")], blank_allowed=False)[:, 0] if timed else None,
        rate_hz=header.number(rate),
        rate_key=rate,
        lines=table.lines,
    )


def listed(names: Iterable[str]) -> str:
    """Names with commas between them."""
    return ", ".join(names)
