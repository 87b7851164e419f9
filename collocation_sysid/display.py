"""What is shown, described once as sentences, tables, pictures and sections, and how it looks.

A description is plain data: `tree.as_json` writes it as JSON. Styles are words: good, check,
doubtful, strong, quiet, code.
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
from urllib.parse import quote

from rich.console import Group, RenderableType
from rich.table import Table as RichTable
from rich.text import Text

from .console import PlainConsole
from .errors import printable
from .files import is_own
from .tree import optional

COLOURS = {"good": "green", "check": "yellow", "doubtful": "red", "strong": "bold", "quiet": "dim"}
# What Markdown takes for markup: anywhere in a text, at its beginning, and numbers of a list there.
MARKUP = re.compile(r"[\\`*\[\]|~]|<(?=[A-Za-z/!?])|&(?=#?\w+;)|(?<![^\W_])_|_(?![^\W_])")
MARKUP_AT_START = re.compile(r"^(?:#(?=#*(?:\s|$))|[-+](?=[-\s]|$)|[=>])")
NUMBER_AT_START = re.compile(r"^(\d{1,9})(?=[.)](?:\s|$))")
BACKTICKS = re.compile(r"`+")
# Width of a text that nobody wraps; heads are parted in tables with more columns than `MANY`, and
# longer texts in a cell take more room.
WIDE, MANY, LONG = 200, 5, 24
# Pictures wider than this can be moved sideways on a phone rather than shrunk.
WIDE_PX = 1000


@dataclass(frozen=True)
class Span:
    """A piece of a sentence, with where it leads `to`."""

    text: str
    style: str = ""
    to: str = ""


@dataclass(frozen=True)
class Line:
    """A sentence; `name` is where others may lead to."""

    text: str | tuple[Span, ...]
    style: str = ""
    name: str = ""

    @property
    def spans(self) -> tuple[Span, ...]:
        """Its pieces."""
        return (Span(self.text),) if isinstance(self.text, str) else self.text


@dataclass(frozen=True)
class Items:
    """Sentences one below the other, each by itself."""

    texts: tuple[str, ...]


@dataclass(frozen=True)
class Table:
    """Rows of texts: names to the left, then numbers to the right, then texts that may be long.

    Attributes
    ----------
    title : str
    heads : tuple of str
        Empty where rows speak for themselves.
    rows : tuple of tuple of str
    names, texts : int
        How many of the first, and of the last columns these are.
    faint : tuple of int, rows of less weight
    aside : int
        How many of the last columns only pages have room for.
    """

    title: str
    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    names: int = 1
    texts: int | None = optional()
    faint: tuple[int, ...] | None = optional()
    style: str | None = optional()
    aside: int | None = optional()

    def __post_init__(self) -> None:
        columns = {len(row) for row in self.rows} | ({len(self.heads)} if self.heads else set())
        if len(columns) > 1:
            raise ValueError(f"the table {self.title!r} has rows of another length")

    def is_number(self, column: int) -> bool:
        """Whether a column is one of numbers."""
        columns = len(self.heads) or max(map(len, self.rows), default=0)
        return self.names <= column < columns - (self.texts or 0)


@dataclass(frozen=True)
class Cards:
    """Numbers that matter most, each with what it is and what to say beside it."""

    items: tuple[tuple[str, str, str], ...]


@dataclass(frozen=True)
class Picture:
    """A PNG with a caption."""

    file: Path
    caption: str


@dataclass(frozen=True)
class Listing:
    """A long text, kept as it is."""

    title: str
    text: str


@dataclass(frozen=True)
class Section:
    """Parts that belong together, with a title or a style of their own."""

    title: str
    parts: tuple[Shown, ...]
    level: int = 2
    style: str = ""


Shown = str | Line | Items | Table | Cards | Picture | Listing | Section


def flat(parts: Iterable[Shown]) -> Iterator[Shown]:
    """The parts without the titles of their sections, as a terminal has room for."""
    for part in parts:
        yield from flat(part.parts) if isinstance(part, Section) else (part,)


def own_pictures(folder: Path) -> list[Path]:
    """The PNG of a folder; what links lead to elsewhere is not shown."""
    return sorted(file for file in folder.glob("*.png") if is_own(folder, file))


def short(value: float) -> str:
    """Two digits, and no powers of ten for the sizes of bodies."""
    return f"{value:.2g}" if value < 99.5 else f"{value:.0f}"


def number(value: float | None, digits: int = 5) -> str:
    """A number as people write it; a dash for none."""
    if value is None or not isfinite(value):
        return "–"
    return f"{value:.{digits}g}".replace("e-0", "e-").replace("e+0", "e")


def millimetres(metres: float | None) -> str:
    """A length in millimetres, to the micrometre at most."""
    return "–" if metres is None or not isfinite(metres) else f"{1e3 * metres:.3g} mm"


def duration(time_s: float | None) -> str:
    """A rounded length of time."""
    if time_s is None:
        return "an unknown time"
    for unit, seconds in (("h", 3600), ("min", 60)):
        if time_s >= 2 * seconds:
            return f"{time_s / seconds:.2g} {unit}"
    return f"{time_s:.1g} s" if time_s < 10 else f"{time_s:.0f} s"


def labelled(title: str, rows: dict[str, str]) -> Table:
    """A table of names and what there is to say of each."""
    return Table(title, (), tuple((f"  {name} ", text) for name, text in rows.items()), texts=1)


# Terminal -----------------------------------------------------------------------------------------


def on_terminal(parts: Shown | Iterable[Shown]) -> RenderableType:
    """As rich shows it."""
    if isinstance(parts, Shown):
        return _on_terminal(parts)
    return Group(*map(_on_terminal, parts))


def plain_text(parts: Shown | Iterable[Shown]) -> str:
    """What a terminal would show, without colours and as wide as it needs."""
    file = StringIO()
    PlainConsole(file=file, width=WIDE).print(on_terminal(parts))
    return "\n".join(line.rstrip() for line in file.getvalue().splitlines())


def _on_terminal(part: Shown) -> RenderableType:
    match part:
        case str():
            return Text(part)
        case Line():
            pieces = ((span.text, _colour(span.style)) for span in part.spans)
            return Text.assemble(*pieces, style=_colour(part.style))
        case Items():
            return Text("\n".join(f"- {text}" for text in part.texts))
        case Table():
            return _titled(part.title, _rich_table(part))
        case Cards():
            rows = tuple((what, f"{value} ({beside})") for what, value, beside in part.items)
            return _rich_table(Table("", (), rows, texts=1))
        case Picture():
            return Text(f"{part.caption} {part.file}")
        case Listing():
            return Group(Text(part.title, "bold"), Text(part.text))
        case Section():
            return _titled(part.title, *map(_on_terminal, part.parts))


def _titled(title: str, *parts: RenderableType) -> RenderableType:
    return Group(Text(title, style="bold"), *parts) if title else Group(*parts)


def _colour(style: str) -> str:
    return " ".join(COLOURS.get(word, "") for word in style.split())


def _rich_table(table: Table) -> RichTable:
    # Rows that speak for themselves are nearer to what they say.
    shown = RichTable(box=None, pad_edge=False) if table.heads else RichTable.grid(padding=(0, 1))
    columns = (len(table.heads) or max(map(len, table.rows), default=0)) - (table.aside or 0)
    for place, head in enumerate((table.heads or ("",) * columns)[:columns]):
        number = table.is_number(place)
        if number and columns > MANY:  # names of materials are parted where they have a hyphen
            head = head.replace("-", "-\n")
        elif not number:  # dotted keys may take two lines
            head = head.replace(".", ".\n", 1)
        whole = place == 0 and (table.texts or 0) > (table.aside or 0)
        side = "right" if number else "left"
        shown.add_column(head, justify=side, overflow="fold", no_wrap=whole)
    for row in table.rows:
        shown.add_row(*(Text(cell, style=_colour(table.style or "")) for cell in row[:columns]))
    return shown


# HTML ---------------------------------------------------------------------------------------------


def as_html(part: Shown) -> str:
    """As a browser shows it; text is escaped."""
    match part:
        case str():
            return f"<p>{escape(part)}</p>\n"
        case Line():
            name = f' id="{escape(part.name)}"' if part.name else ""
            return f"<p{name}{_class(part.style)}>{''.join(map(_span, part.spans))}</p>\n"
        case Items():
            lines = (f"<li>{escape(text)}</li>\n" for text in part.texts)
            return f"<ul>\n{''.join(lines)}</ul>\n"
        case Table():
            title = f"<h2>{escape(part.title)}</h2>\n" if part.title else ""
            return f'{title}<div class="scroll"><table>\n{_html_rows(part)}</table></div>\n'
        case Cards():
            cards = (
                f'<div class="card"><span>{escape(what)}</span><b>{escape(value)}</b>'
                f"<span>{escape(beside)}</span></div>\n"
                for what, value, beside in part.items
            )
            return f'<div class="cards">\n{"".join(cards)}</div>\n'
        case Picture():
            content, caption = part.file.read_bytes(), escape(part.caption)
            wide = _class("wide" if int.from_bytes(content[16:20]) > WIDE_PX else "")  # its header
            data = f"data:image/png;base64,{base64.b64encode(content).decode('ascii')}"
            return (
                f'<figure><div class="scroll"><img{wide} src="{data}" alt="{caption}"></div>\n'
                f"<figcaption{wide}>{caption}</figcaption></figure>\n"
            )
        case Listing():
            title, text = escape(part.title), escape(part.text)
            return f"<details><summary>{title}</summary><pre>{text}</pre></details>\n"
        case Section():
            inner = "".join(map(as_html, part.parts))
            if part.style:
                return f"<div{_class(part.style)}>\n{inner}</div>\n"
            return f"<h{part.level}>{escape(part.title)}</h{part.level}>\n{inner}"


def escape(text: str) -> str:
    """Text as HTML holds it, with marks in place of control characters."""
    return escape_html(printable(text)).replace("&#x27;", "&#39;")


def _class(style: str) -> str:
    return f' class="{escape(style)}"' if style else ""


def _span(span: Span) -> str:
    text = escape(span.text)
    if span.to:
        return f'<a href="{escape(span.to)}">{text}</a>'
    if span.style in ("strong", "code"):
        return f"<{span.style}>{text}</{span.style}>"
    return f"<span{_class(span.style)}>{text}</span>" if span.style else text


def _html_rows(table: Table) -> str:
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
        faint = _class("quiet" if number in (table.faint or ()) else "")
        rows.append(f"<tr{faint}>{''.join(cells)}</tr>\n")
    return "".join(rows)


# Markdown -----------------------------------------------------------------------------------------


def as_markdown(parts: Sequence[Shown]) -> str:
    """For a paper's appendix or an issue; pictures are links to their files."""
    return "\n\n".join(filter(None, map(_markdown, parts))) + "\n"


def _markdown(part: Shown) -> str:
    match part:
        case str():
            return escape_markdown(part)
        case Line():
            return "".join(map(_markdown_span, part.spans))
        case Items():
            return "\n".join(f"- {escape_markdown(text)}" for text in part.texts)
        case Table():
            columns = range(len(part.heads) or max(map(len, part.rows), default=0))
            heads = part.heads or ("",) * len(columns)
            rule = tuple("---:" if part.is_number(k) else "---" for k in columns)
            head, *rows = (map(escape_markdown, line) for line in (heads, *part.rows))
            table = "\n".join(f"| {' | '.join(line)} |" for line in (head, rule, *rows))
            return f"## {escape_markdown(part.title)}\n\n{table}" if part.title else table
        case Cards():
            cards = (f"{what}: {value} ({beside})" for what, value, beside in part.items)
            return "\n".join(f"- {escape_markdown(card)}" for card in cards)
        case Picture():
            return f"![{escape_markdown(part.caption)}]({quote(part.file.name)})"
        case Listing():
            fence = _longer_than_any("```", part.text)
            return f"{escape_markdown(part.title)}:\n\n{fence}\n{printable(part.text)}\n{fence}"
        case Section():
            heading = f"{'#' * part.level} {escape_markdown(part.title)}"
            title = heading if part.title else ""
            return "\n\n".join(filter(None, (title, *map(_markdown, part.parts))))


def escape_markdown(text: str) -> str:
    """Text as one line of Markdown that a reader shows as it is: no markup, HTML or links."""
    line = MARKUP.sub(r"\\\g<0>", " ".join(printable(text).split()))
    return NUMBER_AT_START.sub(r"\1\\", MARKUP_AT_START.sub(r"\\\g<0>", line))


def _markdown_span(span: Span) -> str:
    text = span.text.strip()
    if not text or span.style not in ("strong", "code"):
        return _around(span.text, escape_markdown(text))
    if span.style == "strong":
        return _around(span.text, f"**{escape_markdown(text)}**")
    fence, pad = _longer_than_any("`", text), " " if "`" in text else ""
    code = " ".join(printable(text).split())
    return _around(span.text, f"{fence}{pad}{code}{pad}{fence}")


def _around(text: str, shown: str) -> str:
    """Keep the spaces with which a piece of a sentence begins and ends."""
    before = " " if text[:1].isspace() else ""
    after = " " if text[-1:].isspace() else ""
    return f"{before}{shown}{after}"


def _longer_than_any(fence: str, text: str) -> str:
    """Return a fence of backticks that the text does not have."""
    longest = max(map(len, BACKTICKS.findall(text)), default=0)
    return fence if longest < len(fence) else "`" * (longest + 1)
