"""Plain description of output (sentences, tables, pictures, sections) and its rendering.

The same description is rendered for terminals, HTML and Markdown. Styles are words, separated by
spaces: good, check, doubtful, strong, quiet, code. A word without a colour in `COLOURS` has no
effect in terminals and is a class in HTML.
"""

from __future__ import annotations

import base64
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from html import escape as escape_html
from io import StringIO
from math import isfinite
from pathlib import Path
from typing import Any, Self
from urllib.parse import quote

from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.live import Live
from rich.segment import Segment
from rich.table import Table as RichTable
from rich.text import Text

from ..errors import printable
from .files import is_own

COLOURS = {"good": "green", "check": "yellow", "doubtful": "red", "strong": "bold", "quiet": "dim"}
# Markup of Markdown: anywhere in a text, at its beginning, and as the number of a list item.
MARKUP = re.compile(r"[\\`*\[\]|~]|<(?=[A-Za-z/!?])|&(?=#?\w+;)|(?<![^\W_])_|_(?![^\W_])")
MARKUP_AT_START = re.compile(r"^(?:#(?=#*(?:\s|$))|[-+](?=[-\s]|$)|[=>])")
NUMBER_AT_START = re.compile(r"^(\d{1,9})(?=[.)](?:\s|$))")
BACKTICKS = re.compile(r"`+")
# Width of plain text [characters]: wide enough that no line is wrapped.
WIDE = 200
# Relative change of an estimate that is too large to be predicted to first order.
LARGEST_CHANGE = 0.5
# Tables with more columns than this break their headings into two lines.
MANY = 5
# Cells with longer texts [characters] get a wider column in HTML.
LONG = 24
# Pictures wider than this can be moved sideways on a phone rather than shrunk.
WIDE_PX = 1000


@dataclass(frozen=True)
class Span:
    """Piece of a sentence; `to` is the target of a link, "" for none."""

    text: str
    style: str = ""
    to: str = ""


@dataclass(frozen=True)
class Line:
    """A sentence; `name` is the anchor to which links may point, "" for none."""

    text: str | tuple[Span, ...]
    style: str = ""
    name: str = ""

    def to_spans(self) -> tuple[Span, ...]:
        """Return the sentence as pieces, each with a style of its own; a text is one piece without
        style.
        """
        return (Span(self.text),) if isinstance(self.text, str) else self.text


@dataclass(frozen=True)
class Table:
    """Table with columns of names (left), of numbers (right aligned) and of long texts (last).

    Attributes
    ----------
    title : str
        Title above the table; "" for none.
    heads : tuple of str
        Column headings; empty for none.
    rows : tuple of tuple of str
        Cells of each row.
    names, texts : int
        Number of name columns at the beginning, and of text columns at the end.
    faint : tuple of int
        Indices of rows that are shown with less emphasis in HTML.
    style : str
        Style of the cells in terminals; "" for none.
    note_column : int
        Number of columns at the end that are omitted in terminals.

    Raises
    ------
    ValueError
        If rows and headings do not have the same length.
    """

    title: str
    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    names: int = 1
    texts: int = 0
    faint: tuple[int, ...] = ()
    style: str = ""
    note_column: int = 0

    def __post_init__(self) -> None:
        columns = {len(row) for row in self.rows} | ({len(self.heads)} if self.heads else set())
        if len(columns) > 1:
            raise ValueError(f"the table {self.title!r} has rows of another length")

    def is_number(self, column: int) -> bool:
        """Return whether the column with this index contains numbers: neither one of the `names`
        nor one of the `texts`.
        """
        columns = len(self.heads) or max(map(len, self.rows), default=0)
        return self.names <= column < columns - self.texts


@dataclass(frozen=True)
class Cards:
    """The most important numbers; each item is (name, value, remark)."""

    items: tuple[tuple[str, str, str], ...]


@dataclass(frozen=True)
class Picture:
    """A PNG with a caption."""

    file: Path
    caption: str


@dataclass(frozen=True)
class Listing:
    """Long preformatted text, such as a file, below a title."""

    title: str
    text: str


@dataclass(frozen=True)
class TitledParts:
    """Group of parts with a title and optionally a style."""

    title: str  # heading; "" for none. HTML shows it only without a style.
    parts: tuple[Shown, ...]  # content
    level: int = 2  # level of the heading, 1 for the highest
    style: str = ""  # class of the enclosing element in HTML; "" for none


Shown = str | Line | Table | Cards | Picture | Listing | TitledParts


def flattened_parts(parts: Iterable[Shown]) -> Iterator[Shown]:
    """Yield the parts of all sections, also nested ones, without their titles."""
    for part in parts:
        yield from (flattened_parts(part.parts) if isinstance(part, TitledParts) else (part,))


def own_pictures(folder: Path) -> list[Path]:
    """Return the PNG files of a folder, sorted by path; links that lead out of the folder are left
    out.
    """
    return sorted(file for file in folder.glob("*.png") if is_own(folder, file))


def short(value: float) -> str:
    """Return a number with two significant digits; from 99.5 on as a whole number."""
    return f"{value:.2g}" if value < 99.5 else f"{value:.0f}"


def two_digits(deviation: float) -> str:
    """Return a standard deviation with two significant digits, also where the second one is zero."""
    return rounded(deviation, deviation)


def rounded(value: float, deviation: float | None) -> str:
    """Return a value to the place of the second significant digit of its standard deviation.

    Without a positive, finite deviation the value has five significant digits.
    """
    if deviation is None or not isfinite(deviation) or deviation <= 0:
        return f"{value:.5g}"
    place = 1 - int(f"{deviation:.1e}".partition("e")[2])
    if place <= 6:
        return f"{round(value, place) + 0.0:.{max(0, place)}f}"
    if not value:
        return "0"
    digits = int(f"{value:.1e}".partition("e")[2]) + place + 1
    return f"{value:.{min(15, max(1, digits))}g}"


def readable_stress(values_pa: Iterable[float]) -> tuple[float, str]:
    """Return factor and name of the unit in which stresses [Pa] of one table read best: the largest
    is below 10,000 of it.
    """
    largest = max((abs(each) for each in values_pa if isfinite(each)), default=0.0)
    units = ((1.0, "Pa"), (1e-3, "kPa"), (1e-6, "MPa"))
    return next((each for each in units if each[0] * largest < 1e4), (1e-9, "GPa"))


def quantity(value: float, unit: str, digits: int | None = None) -> str:
    """Return a size with its unit, a stress [Pa] in a unit in which it is below 1000; without a unit
    the number alone. `digits` are the significant digits, by default those of `short`.
    """
    factor, shown = readable_stress([10 * value]) if unit == "Pa" else (1.0, unit)
    text = short(factor * value) if digits is None else number(factor * value, digits)
    return f"{text} {shown}".rstrip()


def number(value: float | None, digits: int = 5) -> str:
    """Return a number with at most `digits` significant digits; a dash for None, NaN and infinity.
    Exponents have no leading zero.
    """
    if value is None or not isfinite(value):
        return "–"
    return f"{value:.{digits}g}".replace("e-0", "e-").replace("e+0", "e")


def predicted_change(change: float, text: str) -> str:
    """Return the text of a relative change that is predicted to first order, but "more than half"
    beyond `LARGEST_CHANGE`.
    """
    return text if abs(change) <= LARGEST_CHANGE else "more than half"


def millimetres(metres: float | None) -> str:
    """Return a length [m] in millimetres with three significant digits and its unit; a dash for
    None, NaN and infinity.
    """
    return "–" if metres is None or not isfinite(metres) else f"{1e3 * metres:.3g} mm"


def duration(time_s: float | None) -> str:
    """Return a duration [s] rounded to one or two digits, with the unit h, min (from two of them
    on) or s; "an unknown time" for None.
    """
    if time_s is None:
        return "an unknown time"
    for unit, seconds in (("h", 3600), ("min", 60)):
        if time_s >= 2 * seconds:
            return f"{time_s / seconds:.2g} {unit}"
    return f"{time_s:.1g} s" if time_s < 9.5 else f"{time_s:.0f} s"


def labelled(title: str, rows: dict[str, str]) -> Table:
    """Return a table without headings of two columns, names and texts; names are indented by two
    spaces.
    """
    return Table(
        title, (), rows=tuple((f"  {name} ", text) for name, text in rows.items()), texts=1
    )


# Terminal -----------------------------------------------------------------------------------------


def on_terminal(parts: Shown | Iterable[Shown]) -> RenderableType:
    """Return a part, or several below one another, as a rich renderable.

    Text is wrapped between words, and no word is broken. Longer words go beyond the terminal's edge
    where they are printed with ``crop=False``.
    """
    if isinstance(parts, Shown):
        return _on_terminal(parts)
    return Group(*map(_on_terminal, parts))


def plain_text(parts: Shown | Iterable[Shown], width: int = WIDE) -> str:
    """Return parts as plain text without colours, `width` characters wide, without trailing spaces;
    each row of a table is one line.
    """
    file = StringIO()
    # Without these options rich would display the text in a Jupyter notebook, instead of writing
    # it to the file, and FORCE_COLOR would add colours.
    console = PlainConsole(
        file=file, width=width, force_jupyter=False, force_terminal=False, color_system=None
    )
    console.print(on_terminal(parts), crop=False)
    return "\n".join(line.rstrip() for line in file.getvalue().splitlines())


def _on_terminal(part: Shown) -> RenderableType:
    """Return one part as a rich renderable; pictures are shown as caption and path."""
    match part:
        case str():
            return _text(part)
        case Line():
            pieces = ((span.text, _colour(span.style)) for span in part.to_spans())
            return UnbrokenWords(Text.assemble(*pieces, style=_colour(part.style)))
        case Table():
            return _titled(part.title, TerminalTable(part))
        case Cards():
            rows = tuple((what, f"{value} ({note})") for what, value, note in part.items)
            return TerminalTable(Table("", (), rows=rows, texts=1))
        case Picture():
            return _text(f"{part.caption} {part.file}")
        case Listing():
            return Group(_text(part.title, "bold"), _text(part.text))
        case TitledParts():
            return _titled(part.title, *map(_on_terminal, part.parts))


def _titled(title: str, *parts: RenderableType) -> RenderableType:
    return Group(_text(title, "bold"), *parts) if title else Group(*parts)


def _text(text: str, style: str = "") -> UnbrokenWords:
    return UnbrokenWords(Text(text, style=style))


@dataclass(frozen=True)
class UnbrokenWords:
    """Text wrapped between words; a word longer than a line goes beyond the terminal's edge."""

    text: Text

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        for line in self.text.split(allow_blank=True):
            breaks = [0]
            for word in re.finditer(r"\S+", line.plain):
                before = line.plain[breaks[-1] : word.start()]
                with_word = line.plain[breaks[-1] : word.end()]
                if before.strip() and cell_len(with_word) > options.max_width:
                    breaks.append(word.start())
            for piece in line.divide(breaks[1:]):
                piece.rstrip()
                piece.no_wrap = True
                piece.overflow = "ignore"
                yield piece


def _colour(style: str) -> str:
    """Return rich's style for the words of a style; unknown words have none."""
    return " ".join(COLOURS.get(word, "") for word in style.split())


@dataclass(frozen=True)
class TerminalTable:
    """Table for rich: on a terminal, long headings and cells may take several lines; elsewhere each
    heading and row takes one.
    """

    table: Table

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield _rich_table(self.table, parted=console.is_terminal)


def _rich_table(table: Table, *, parted: bool) -> RichTable:
    """Return a table as rich's, without its last `note_column` columns."""
    # Without headings, names are set close to their texts.
    shown = RichTable(box=None, pad_edge=False) if table.heads else RichTable.grid(padding=(0, 1))
    columns = (len(table.heads) or max(map(len, table.rows), default=0)) - table.note_column
    for place, head in enumerate((table.heads or ("",) * columns)[:columns]):
        number = table.is_number(place)
        cells = [row[place] for row in table.rows if place < len(row)]
        if not parted:
            pass
        elif number and columns > MANY:  # names of materials are parted where they have a hyphen
            head = head.replace("-", "-\n")
        elif not number:  # dotted keys may take two lines
            head = head.replace(".", ".\n", 1)
        fills_width = place == 0 and table.texts > table.note_column
        side = "right" if number else "left"
        longest_word = max(map(cell_len, " ".join((head, *cells)).split()), default=0)
        shown.add_column(head, justify=side, min_width=longest_word, no_wrap=fills_width)
    for row in table.rows:
        cells = row[:columns] if parted else (cell.replace("\n", "; ") for cell in row[:columns])
        shown.add_row(*(Text(cell, style=_colour(table.style)) for cell in cells))
    return shown


# HTML ---------------------------------------------------------------------------------------------


def as_html(part: Shown) -> str:
    """Return a part as HTML; text is escaped, and pictures are embedded.

    Raises
    ------
    OSError
        If the file of a picture cannot be read.
    """
    match part:
        case str():
            return f"<p>{escape(part)}</p>\n"
        case Line():
            name = f' id="{escape(part.name)}"' if part.name else ""
            return f"<p{name}{_class(part.style)}>{''.join(map(_span, part.to_spans()))}</p>\n"
        case Table():
            title = f"<h2>{escape(part.title)}</h2>\n" if part.title else ""
            return f'{title}<div class="scroll"><table>\n{_html_rows(part)}</table></div>\n'
        case Cards():
            cards = (
                f'<div class="card"><span>{escape(what)}</span><b>{escape(value)}</b>'
                f"<span>{escape(note)}</span></div>\n"
                for what, value, note in part.items
            )
            return f'<div class="cards">\n{"".join(cards)}</div>\n'
        case Picture():
            content = part.file.read_bytes()
            caption = escape(part.caption)
            wide = _class("wide" if int.from_bytes(content[16:20]) > WIDE_PX else "")  # its header
            data = f"data:image/png;base64,{base64.b64encode(content).decode('ascii')}"
            return (
                f'<figure><div class="scroll"><img{wide} src="{data}" alt="{caption}"></div>\n'
                f"<figcaption{wide}>{caption}</figcaption></figure>\n"
            )
        case Listing():
            title = escape(part.title)
            text = escape(part.text)
            return f"<details><summary>{title}</summary><pre>{text}</pre></details>\n"
        case TitledParts():
            inner = "".join(map(as_html, part.parts))
            if part.style:
                return f"<div{_class(part.style)}>\n{inner}</div>\n"
            return f"<h{part.level}>{escape(part.title)}</h{part.level}>\n{inner}"


def escape(text: str) -> str:
    """Return a text for HTML: markup is escaped, control characters become visible marks."""
    return escape_html(printable(text)).replace("&#x27;", "&#39;")


def _class(style: str) -> str:
    """Return the HTML attribute class=… for a style, with a leading space; "" for no style."""
    return f' class="{escape(style)}"' if style else ""


def _span(span: Span) -> str:
    text = escape(span.text)
    if span.to:
        return f'<a href="{escape(span.to)}">{text}</a>'
    if span.style in ("strong", "code"):
        return f"<{span.style}>{text}</{span.style}>"
    return f"<span{_class(span.style)}>{text}</span>" if span.style else text


def _html_rows(table: Table) -> str:
    """Without headings, the first cell of each row is its heading."""
    head = "".join(
        f"<th{_class('n' if table.is_number(k) else '')}>{escape(each)}</th>"
        for k, each in enumerate(table.heads)
    )
    rows = [f"<tr>{head}</tr>\n"] if head else []
    for number, row in enumerate(table.rows):
        cells = []
        for k, cell in enumerate(row):
            kind = "th" if k == 0 and not head else "td"
            wide = "wide" if len(cell) > LONG and not table.is_number(k) else ""
            style = "n" if table.is_number(k) else wide
            cells.append(f"<{kind}{_class(style)}>{escape(cell)}</{kind}>")
        faint = _class("quiet" if number in table.faint else "")
        rows.append(f"<tr{faint}>{''.join(cells)}</tr>\n")
    return "".join(rows)


# Markdown -----------------------------------------------------------------------------------------


def as_markdown(parts: Sequence[Shown]) -> str:
    """Return parts as Markdown, for a paper's appendix or an issue; pictures are links to their
    file names, and cards are items.
    """
    return "\n\n".join(filter(None, map(_markdown, parts))) + "\n"


def _markdown(part: Shown) -> str:
    match part:
        case str():
            return escape_markdown(part)
        case Line():
            return "".join(map(_markdown_span, part.to_spans()))
        case Table():
            columns = range(len(part.heads) or max(map(len, part.rows), default=0))
            heads = part.heads or ("",) * len(columns)
            rule = tuple("---:" if part.is_number(k) else "---" for k in columns)
            head, *rows = (map(escape_markdown, line) for line in (heads, *part.rows))
            table = "\n".join(f"| {' | '.join(line)} |" for line in (head, rule, *rows))
            return f"## {escape_markdown(part.title)}\n\n{table}" if part.title else table
        case Cards():
            cards = (f"{what}: {value} ({note})" for what, value, note in part.items)
            return "\n".join(f"- {escape_markdown(card)}" for card in cards)
        case Picture():
            return f"![{escape_markdown(part.caption)}]({quote(part.file.name)})"
        case Listing():
            fence = _longer_than_any("```", part.text)
            return f"{escape_markdown(part.title)}:\n\n{fence}\n{printable(part.text)}\n{fence}"
        case TitledParts():
            heading = f"{'#' * part.level} {escape_markdown(part.title)}"
            title = heading if part.title else ""
            return "\n\n".join(filter(None, (title, *map(_markdown, part.parts))))


def escape_markdown(text: str) -> str:
    """Return a text as one line of Markdown that is displayed as it is: no markup, HTML or links;
    white space becomes single spaces.
    """
    line = MARKUP.sub(r"\\\g<0>", " ".join(printable(text).split()))
    return NUMBER_AT_START.sub(r"\1\\", MARKUP_AT_START.sub(r"\\\g<0>", line))


def _markdown_span(span: Span) -> str:
    """Return a piece of a sentence as Markdown; targets of links are omitted."""
    text = span.text.strip()
    if not text or span.style not in ("strong", "code"):
        return _spaced_like(span.text, escape_markdown(text))
    if span.style == "strong":
        return _spaced_like(span.text, f"**{escape_markdown(text)}**")
    fence = _longer_than_any("`", text)
    pad = " " if "`" in text else ""
    code = " ".join(printable(text).split())
    return _spaced_like(span.text, f"{fence}{pad}{code}{pad}{fence}")


def _spaced_like(text: str, shown: str) -> str:
    """Return `shown` with one space where `text` begins and ends with white space."""
    before = " " if text[:1].isspace() else ""
    after = " " if text[-1:].isspace() else ""
    return f"{before}{shown}{after}"


def _longer_than_any(fence: str, text: str) -> str:
    """Return a fence of backticks longer than any in the text, at least `fence`."""
    longest = max(map(len, BACKTICKS.findall(text)), default=0)
    return fence if longest < len(fence) else "`" * (longest + 1)


class PlainConsole(Console):
    """Rich console that shows texts as they are: no markup, no emoji codes, no highlighting, and
    visible marks in place of control characters (`printable`).

    Parameters
    ----------
    **options
        Further options of `rich.console.Console`.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(markup=False, emoji=False, highlight=False, **options)

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        """Yield rich's segments with visible marks in place of control characters; rich's own
        control segments are unchanged.
        """
        for segment in super().render(renderable, options):
            yield (segment if segment.control else segment._replace(text=printable(segment.text)))


class Watched:
    """Progress display: updated in place on a terminal, one line per step elsewhere, none if
    `quiet`.

    Use it as a context manager: in-place updates are displayed within the block and removed at its
    end.

    Attributes
    ----------
    console : Console
        Where it is displayed.
    quiet : bool
        Whether nothing is displayed at all.

    Parameters
    ----------
    live : bool
        If false, do not update in place, also on a terminal.
    """

    def __init__(self, console: Console, quiet: bool = False, live: bool = True) -> None:
        self.console = console
        self.quiet = quiet
        shown = console.is_terminal and live and not quiet
        self._live = Live(console=console, refresh_per_second=8, transient=True) if shown else None

    def __enter__(self) -> Self:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.stop()

    def update(self, shown: RenderableType, line: str = "") -> None:
        """Display `shown` in place; without a live display, print `line` if it is not empty and the
        display is not quiet.
        """
        if self._live is not None:
            self._live.update(shown)
        elif line:
            self.line(line)

    def line(self, text: str) -> None:
        """Print a line that stays, without wrapping; nothing if the display is quiet."""
        if not self.quiet:
            self.console.print(Text(text), soft_wrap=True)
