"""Tables: rows of cells below column names, from text files, and numbers from cells.

Messages name lines; readers of files add the path, see `names_file_in_errors`.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import wraps
from itertools import pairwise, zip_longest
from typing import Any, Concatenate, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from ...common.array_types import Array, Index
from ...errors import InputError, excerpt, listed, located
from ..sample_times import first_unordered_time
from .units import UNITS, si_factor

P = ParamSpec("P")
T = TypeVar("T")
# Largest accepted number: no measurement is larger, and products of two such numbers are finite.
LARGEST_NUMBER = 1e100
# Numbers that stand for missing values in files of many programs, if they are larger than all others
# by this factor.
MISSING_CODES = (-999.0, -9999.0, -99999.0, -999999.0, 9999.0, 99999.0, 999999.0)
CODE_RATIO = 10.0
_NOT_MEASURED = ("nan", "na", "n/a", "null", "none", "-", "--", "inf")
# Encodings, and the position of the zero byte of Latin letters in those of two bytes without a mark.
_ENCODINGS = ("utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "cp1252")
_ZERO_BYTES = {"utf-16-le": 1, "utf-16-be": 0}
_CONTROL = re.compile("[\x01-\x08\x0e-\x1f]")
_SEPARATOR = re.compile("[,;\t]")
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+([eE][-+]?\d+)?")
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", re.ASCII)
_POINTED = re.compile(r"[-+]?\d*\.\d+([eE][-+]?\d+)?")
# Marks of thousands: 1.000,5 and 1,000.5, where the decimal sign tells which one it is.
_THOUSANDS = (
    (".", re.compile(r"[-+]?\d{1,3}(\.\d{3})+(?P<decimals>,\d+)?")),
    (",", re.compile(r"[-+]?\d{1,3}(,\d{3})+(?P<decimals>\.\d+)?")),
)
_EMPTY = "the file is empty; expected a line of column names, then rows of numbers"


@dataclass(frozen=True, eq=False)
class Row:
    """The stripped cells of one line, and the line's number, counted from 1."""

    line: int
    cells: list[str]


@dataclass(frozen=True, eq=False)
class Table:
    """Rows of equal length below column names."""

    columns: list[str]
    cells: NDArray  # (rows, columns): texts of a file, or numbers of a log
    lines: Sequence[int]  # line of each row, counted from 1
    names_line: int = 1  # line of the names

    def with_rows(self, rows: Index) -> Table:
        """Return the table of rows, by their indices."""
        return replace(self, cells=self.cells[rows], lines=[self.lines[k] for k in rows.tolist()])

    def numbers_where_possible(self, place: int) -> Array:
        """Return the numbers (rows,) of a column, NaN where a cell is none."""
        cells = self.cells[:, place]
        if cells.dtype != object:
            return np.asarray(cells, dtype=float)
        numbers = np.vectorize(_number_of_cell, otypes=[float])(cells)
        return np.where(np.isfinite(numbers), numbers, np.nan)

    def error_at(self, message: str, row: int | None = None) -> InputError:
        """Return an `InputError` about a row, by its index from 0, or about the column names if
        `row` is None; the error names the line.
        """
        line = self.names_line if row is None else self.lines[row]
        return InputError(message, where=f"line {line}")


def names_file_in_errors(
    read: Callable[Concatenate[Any, P], T],
) -> Callable[Concatenate[Any, P], T]:
    """Decorate a reader whose first argument is a path, so that its `InputError`s name that
    path.
    """

    @wraps(read)
    def reader(path: Any, *args: P.args, **kwargs: P.kwargs) -> T:
        with located(path):
            return read(path, *args, **kwargs)

    return reader


def decode(content: bytes) -> str:
    """Return the text of bytes in UTF-8, UTF-16 or Windows-1252.

    Raises
    ------
    InputError
        If it is empty or blank, or not text.
    """
    text = next(filter(None, (_decoded(content, encoding) for encoding in _ENCODINGS)), None)
    if text is None and content:
        raise InputError(
            "this is not a CSV text file (UTF-8), nor a file of another known format; expected a "
            "table with column names, or a supported export format"
        )
    if not text or not text.strip():
        raise InputError(_EMPTY)
    return text


def _decoded(content: bytes, encoding: str) -> str | None:
    """Return the text of bytes in an encoding; None if it is not text in that encoding."""
    # Encodings that decode anything must also have separators and no control characters.
    if encoding == "utf-16" and not content.startswith((b"\xff\xfe", b"\xfe\xff")):
        return None
    # Latin letters in two bytes without a byte order mark.
    if (place := _ZERO_BYTES.get(encoding)) is not None and (
        len(content) % 2 or 2 * content[place::2].count(0) < 0.9 * len(content)
    ):
        return None
    try:
        text = content.decode(encoding)
    except UnicodeDecodeError:
        return None
    odd = encoding != "utf-8-sig" and (_CONTROL.search(text) or not _SEPARATOR.search(text))
    return None if "\0" in text or odd else text


# Rows ---------------------------------------------------------------------------------------------


def separated_rows(text: str, separator: str | None = None) -> list[Row]:
    """Return the rows of separated text; blank rows are skipped.

    Decimal commas become points if the separator is no comma and no number has a decimal point.
    Marks of thousands are removed if a number has a decimal sign, too.

    Parameters
    ----------
    separator : str, optional
        Separator of cells; by default the semicolon or tab if most lines have one, else the comma.

    Raises
    ------
    InputError
        If it is no CSV text, or has no rows.
    """
    if separator is None:
        lines = text.splitlines()
        shares = {mark: sum(mark in line for line in lines) / len(lines) for mark in ";\t"}
        separator = next((mark for mark, share in shares.items() if share > 0.5), ",")
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=separator)
    try:
        rows = []
        for given in reader:  # blank lines are skipped at once: there may be millions
            if given and any(cells := [cell.strip() for cell in given]):
                rows.append(Row(reader.line_num, cells))
    except csv.Error as error:
        raise InputError(f"this is not a CSV text file: {error}") from error
    if not rows:
        raise InputError(_EMPTY)
    mixed = [cell for row in rows for cell in row.cells if "," in cell and "." in cell]
    for mark, number in _THOUSANDS:
        if any((found := number.fullmatch(cell)) and found["decimals"] for cell in mixed):
            for row in rows:
                row.cells[:] = [
                    cell.replace(mark, "") if number.fullmatch(cell) else cell for cell in row.cells
                ]
    if separator != "," and not any(_POINTED.fullmatch(cell) for row in rows for cell in row.cells):
        for row in rows:
            commas = [_DECIMAL_COMMA.fullmatch(cell) for cell in row.cells]
            row.cells[:] = [
                c.replace(",", ".") if comma else c
                for c, comma in zip(row.cells, commas, strict=True)
            ]
    return rows


def tab_rows(text: str) -> list[Row]:
    """Return the rows of a tab-separated file, with stripped cells; lines without any character are
    skipped.
    """
    lines = enumerate(re.split("\r\n|\r|\n", text), start=1)
    return [Row(k, [cell.strip() for cell in line.split("\t")]) for k, line in lines if line]


def table_of_rows(
    columns: list[str], rows: list[Row], names_line: int = 1, remedy: str = ""
) -> Table:
    """Return a table of rows that are as wide as their column names.

    Blank columns at the end of all rows are cut.

    Parameters
    ----------
    names_line : int
        Line of the column names, counted from 1.
    remedy : str
        Added to the message about a row of another length.

    Raises
    ------
    InputError
        If there is no row, or one is of another length.
    """
    if not rows:
        raise InputError(
            "the file has column names but no rows of numbers; expected at least one row"
        )
    width = len(columns)
    common = len(rows[0].cells)
    if common > width and all(len(r.cells) == common and not any(r.cells[width:]) for r in rows):
        rows = [Row(row.line, row.cells[:width]) for row in rows]
    for row in rows:
        if len(row.cells) != width:
            raise InputError(
                f"the row has {len(row.cells)} cells; expected {width}, as many as the header has "
                f"columns{remedy}",
                where=f"line {row.line}",
            )
    cells = np.array([row.cells for row in rows], dtype=object)
    return Table(columns, cells, [row.line for row in rows], names_line)


def parse_table(text: str, header_line: int | None = None, names_required: bool = True) -> Table:
    """Return a table from text of separated cells with a row of column names.

    Of several tables, the longest is returned. Other lines above the names are skipped; units in a
    row of their own are joined to the names, as in "Load (N)".

    Parameters
    ----------
    header_line : int, optional
        Line of the column names.
    names_required : bool
        Whether a row of numbers in place of the names is refused.

    Raises
    ------
    InputError
        If the text is no such table, has no rows, rows of different lengths, or two long tables.
    """
    rows = separated_rows(text)
    numeric = [_is_numeric(row) for row in rows]
    if header_line is None:
        names = _longest_table(rows, numeric)
    else:
        names = next((k for k, row in enumerate(rows) if row.line == header_line), None)
        if names is None or numeric[names]:
            found = "no text" if names is None else "numbers"
            raise InputError(
                f"line {header_line} has {found}; expected the row of the column names",
                where="header_line",
            )
        units = rows[names + 1].cells if names + 1 < len(rows) else []
        if units and not numeric[names + 1] and all(map(_is_unit, units)):
            names += 1
    if names_required and numeric[names]:
        raise InputError(
            "found a row of numbers and no row of column names above it; expected names with units, "
            'such as "time (s)"',
            where=f"line {rows[names].line}",
        )
    header = rows[names].cells
    if names and not numeric[names] and all(map(_is_unit, header)):
        above = rows[names - 1].cells
        header = [f"{a} ({u.strip('()[]')})" for a, u in zip_longest(above, header, fillvalue="")]
    line = rows[names].line
    remedy = (
        f" in line {line}; specimens and test benches state another line as header_line"
        if line > 1
        else ""
    )
    return table_of_rows(header, rows[names + 1 :], names_line=line, remedy=remedy)


def _is_numeric(row: Row) -> bool:
    """Return whether a row has several cells, of numbers only."""
    return len(row.cells) > 1 and all(is_number(c.replace(",", ".")) for c in row.cells if c)


def _longest_table(rows: list[Row], numeric: list[bool]) -> int:
    """Return the index of the names of the longest table.

    Names of a further table are a row of texts only above a row of numbers: a row of the table with
    a wrong cell is none. Tables above the longest one are skipped.
    """
    first = max(numeric.index(True) - 1, 0) if True in numeric else 0
    if "t_s" in rows[0].cells:
        return 0
    further = range(first + 1, len(rows) - 1)
    starts = [first, *(k for k in further if numeric[k + 1] and _is_header(rows[k]))]
    counts = [sum(numeric[a:b]) for a, b in pairwise([*starts, len(rows)])]
    best = starts[counts.index(max(counts))]
    rivals = [
        k
        for k, count in zip(starts, counts, strict=True)
        if 2 * count > max(counts) or rows[k].cells == rows[best].cells
    ]
    if len(rivals) > 1:
        lines = [rows[k].line for k in rivals]
        raise InputError(
            f"found tables below the lines {listed(map(str, lines))}, none of which is the longest "
            "by far; expected one table, or header_line, the line of its names, which tables of "
            "specimens and test benches have"
        )
    return best


def _is_header(row: Row) -> bool:
    """Return whether a row has texts and no number."""
    texts = [cell for cell in row.cells if cell and cell.lower() not in _NOT_MEASURED]
    return len(texts) > 1 and not any(is_number(cell.replace(",", ".")) for cell in texts)


def _is_unit(cell: str) -> bool:
    """Return whether a cell may be a unit: blank, in brackets, or known."""
    bare = cell.strip("()[]")
    bracketed = cell in (f"({bare})", f"[{bare}]")
    return not bare or bracketed or any(si_factor(bare, dimension) for dimension in UNITS)


# Cells --------------------------------------------------------------------------------------------


def numeric_cells(grid: Table, columns: Sequence[int], blank_allowed: bool) -> Array:
    """Return the cells of some columns as numbers (rows, columns); NaN where blank.

    Parameters
    ----------
    blank_allowed : bool
        Whether cells may be blank; "nan" counts as blank.

    Raises
    ------
    InputError
        If a cell is not a number up to `LARGEST_NUMBER` in magnitude; its line and column are
        named.
    """
    cells = grid.cells[:, list(columns)]
    values = cells
    if cells.dtype == object:
        values = np.vectorize(_number_of_cell, otypes=[float])(cells)
    is_allowed = (abs(values) <= LARGEST_NUMBER) | (blank_allowed & np.isnan(values))
    if not is_allowed.all():
        i, j = np.argwhere(~is_allowed)[0].tolist()
        expected = "a number or a blank cell" if blank_allowed else "a number"
        name = grid.columns[columns[j]]
        raise grid.error_at(
            f"column {name} holds '{excerpt(str(cells[i, j]))}'; expected {expected}", i
        )
    for j, column in enumerate(columns):
        _require_no_codes(grid, column, values[:, j], blank_allowed)
    return values


def _number_of_cell(cell: str) -> float:
    """Return the number in a cell: NaN if the cell is blank, infinity if it is no number."""
    try:
        return number_from_text(cell) if cell else math.nan
    except ValueError:
        return math.inf


def _require_no_codes(grid: Table, column: int, values: Array, blank_allowed: bool) -> None:
    """Raise an `InputError` if values (rows,) of a column are codes of missing ones."""
    is_code = np.isin(values, MISSING_CODES)
    largest = float(np.nanmax(np.abs(values[~is_code]), initial=0.0))
    is_code &= np.abs(values) > CODE_RATIO * largest
    if is_code.any() and len(values) > 1:
        row = int(is_code.argmax())
        expected = "a blank cell" if blank_allowed else "no row"
        raise grid.error_at(
            f"column {grid.columns[column]} holds {values[row]:g}, a common code of missing "
            f"values, in {is_code.sum()} of {len(values)} rows, and at most {largest:.4g} elsewhere; "
            f"expected {expected} where nothing was measured",
            row,
        )


def times_in_column(grid: Table, column: int, factor: float = 1.0) -> Array:
    """Return the times (rows,) [s] in a column.

    Parameters
    ----------
    factor : float
        Factor from the column's unit to seconds.

    Raises
    ------
    InputError
        If a cell is blank or not a number, or time does not increase; the line is named.
    """
    t_s = factor * numeric_cells(grid, [column], blank_allowed=False)[:, 0]
    if fault := first_unordered_time(t_s):
        raise grid.error_at(fault[1], fault[0])
    return t_s


def is_number(cell: str) -> bool:
    """Return whether a cell is a plain number: digits with a sign, decimal point and exponent; not
    "nan", "inf" or blank.
    """
    return _NUMBER.fullmatch(cell) is not None


def number_from_text(text: str) -> float:
    """Return the number in a text; "nan" and "inf" are accepted.

    Raises
    ------
    ValueError
        If it is no number, or one in a notation of Python only, such as 1_000 or ١.
    """
    if "_" in text or not text.isascii():
        raise ValueError(f"found {text!r}")
    return float(text)
