"""Commands that show documentation and contents, and that begin a problem."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, ClassVar

import typer
from rich.console import Console, ConsoleOptions, RenderResult
from rich.markdown import CodeBlock, Markdown
from rich.text import Text

from ..common.display import PlainConsole, Shown, Table
from ..common.pages import glossary_terms, page_files, page_text, page_title, search_pages
from ..common.serialisation import as_json as json_text
from ..errors import InputError, hint_at, located
from .command_options import AsJson, command, option
from .common import error_console, print_result, shown_progress


class UnbrokenCode(CodeBlock):
    """A code block of Markdown whose lines are never broken."""

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        for line in str(self.text).rstrip().splitlines():
            yield Text(f"  {line}", style="cyan", no_wrap=True, overflow="ignore")


class TerminalPage(Markdown):
    """Markdown document whose text is wrapped to the terminal and whose code is not."""

    elements: ClassVar = {**Markdown.elements, "fence": UnbrokenCode, "code_block": UnbrokenCode}


commands = typer.Typer()

TYPE_WORDS = {"number": "number", "integer": "whole number", "string": "text", "object": "table"}


class NewProblemKind(StrEnum):
    """Kinds of a new problem's simulated recording."""

    COMPRESSION = "compression"
    SPECIMEN = "specimen"
    TENSION = "tension"
    SWING = "swing"
    VIDEO = "video"
    CABLE = "cable"


@command(commands, "methods", "methods interior-point")
def methods(
    *,
    name: Annotated[str | None, typer.Argument(help="The method whose options are listed.")] = None,
    as_json: AsJson = False,
) -> None:
    """List the methods, or the options of one method: defaults, allowed values and meaning."""
    from ..methods import METHODS, method_options_schema, method_summary, require_method

    if name is not None:
        require_method(name, "NAME")
    if as_json:
        listed = (
            method_options_schema(name)
            if name
            else {each: method_summary(each) for each in METHODS}
        )
        typer.echo(json.dumps(listed, indent=1))
    else:
        parts = _options_table(name) if name else _methods_table()
        print_result(parts)


@commands.command()
def schema() -> None:
    """Print the JSON schema of the problem file, with which editors complete and check keys."""
    from ..problem.editor_schema import schema_text

    typer.echo(schema_text(), nl=False)


@command(
    commands,
    "explain",
    "explain trust",
    "explain budget scheme",
    "explain resample_hz",
    "explain mirrored",
    "explain theory | less",
)
def explain(
    *,
    topics: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="TOPIC",
            help="Topics of the pages to show, keys of the problem file, or words to search for.",
        ),
    ] = None,
) -> None:
    """Show pages of the documentation, keys of the problem file, or words of the output.

    Without a topic, the topics of the pages are listed; with a key or a word, the pages about it.
    Pages are part of the installation; no network is needed. If the output is not a terminal, they
    are printed as Markdown.
    """
    if not topics:
        print_result(
            Table(
                "",
                ("topic", ""),
                rows=tuple((each, page_title(each)) for each in page_files()),
                texts=1,
            )
        )
        return
    console = PlainConsole()
    for topic in [_known_topic(each) for each in topics]:
        if topic not in page_files():
            tables = (_key_table(topic), _word_table(topic), _found_table(topic))
            for table in (each for each in tables if each.rows):
                print_result(table)
        elif console.is_terminal:
            console.print(TerminalPage(page_text(topic), hyperlinks=False), crop=False)
        else:
            typer.echo(page_text(topic))


def _known_topic(topic: str) -> str:
    """Return the topic, or its part before " of ", as in "area_error of stress"."""
    from ..problem.key_descriptions import all_keys, find_keys

    for each in (topic, topic.split(" of ")[0]):
        if each in page_files() or find_keys(each) or _word_table(each).rows:
            return each
    if search_pages(topic):
        return topic
    names = [each.path.rpartition(".")[2] for each in all_keys()]
    known = [*page_files(), *dict.fromkeys(names)]
    raise InputError(
        f"found {topic!r}; expected a topic that `explain` lists, a key of the problem file, or a word "
        f"of the output or of a page{hint_at(topic, known)}",
        where="TOPIC",
    )


def _found_table(text: str) -> Table:
    rows = tuple((f"explain {topic}", *where) for topic, *where in search_pages(text))
    return Table("", ("page", "section", "first line"), rows=rows, names=2, texts=1)


def _key_table(name: str) -> Table:
    from ..problem.key_descriptions import find_keys

    rows = tuple((each.path, each.form, each.default, each.description) for each in find_keys(name))
    heads = ("key", "values", "default", "meaning")
    return Table("", heads, rows=rows, names=3, texts=1)


def _word_table(word: str) -> Table:
    from ..fem.laws.constants import KNOWN, constants_with_symbol, unit_of
    from ..recording.nuisance import nuisances_called
    from ..statistics.budget.systematic_effects import DEVIATIONS, source_label
    from ..statistics.concerns import REMEDIES

    constants = [word] if word in KNOWN else constants_with_symbol(word)
    rows = [
        (name, f"{KNOWN[name].symbol} {unit_of(name)}".strip(), KNOWN[name].meaning)
        for name in constants
    ]
    rows += [
        (row.key or row.name, "nuisance parameter", row.description)
        for row in nuisances_called(word)
    ]
    sources = {
        component: (each.name, each.description)
        for each in DEVIATIONS.values()
        if each.remedy
        for component in (each.name, *each.components)
    }
    sources |= {
        name: (name, "contribution to the uncertainty") for name in REMEDIES if name not in sources
    }
    labels = {source_label(source): about for source, about in sources.items()}
    if about := sources.get(word) or labels.get(word):
        name, meaning = about
        rows.append((name, "uncertainty", f"{meaning}; to reduce it, {REMEDIES[name]}"))
    if not rows and (term := glossary_terms().get(word.lower())):
        meaning, topic = term
        rows.append((word, "", f"{meaning} (explain {topic})"))
    return Table("", ("name", "", "meaning"), rows=tuple(rows), names=2, texts=1)


@command(commands, "log trial.mcap", "log bags/2026-05-04 --json")
def log(
    *,
    log: Annotated[
        Path,
        typer.Argument(
            metavar="LOG", help="A ROS bag, an MCAP file, or the folder of a LeRobot dataset."
        ),
    ],
    as_json: AsJson = False,
) -> None:
    """List the topics in a robot's log, their uses, and how a problem file names them."""
    from ..recording.sources.topics import list_topics

    with shown_progress(f"reading {log}"), located(log):
        listed = list_topics(log)
    if as_json:
        typer.echo(json_text(listed))
        return
    rows = tuple(
        (
            each.name,
            each.type,
            f"{each.messages}",
            f"{each.rate_hz:.3g}" if each.rate_hz else "",
            each.frame,
            each.serves,
        )
        for each in listed
    )
    heads = ("topic", "type", "messages", "Hz", "frame", "use")
    # Several topics of points have their joint address in common.
    addresses = [
        f"  {address}"
        for address in dict.fromkeys(address for each in listed for address in each.write)
    ]
    what = ["", "In place of a file name write:", *addresses] if addresses else []
    print_result([Table("", heads, rows=rows, names=2, texts=2), *what])


@command(
    commands,
    "new my_object",
    "new silicone --kind compression",
    "new rubber --dataset kawabata_1981",
    "check silicone/problem.toml",
)
def new(
    *,
    name: Annotated[str, typer.Argument(help="Name of the new folder.")],
    kind: Annotated[
        NewProblemKind | None,
        option("Add a simulated recording of this kind, so that the problem runs as it is."),
    ] = None,
    dataset: Annotated[
        str | None,
        option(
            "Copy the problem and the data of this dataset instead of the template, for example "
            "kawabata_1981."
        ),
    ] = None,
) -> None:
    """Write a commented problem file as a starting point.

    The folder, new or existing, gets problem.toml and, with either --kind or --dataset, its data.
    If a file of the same name exists, nothing is written, and the exit code is 2. The names of the
    files are printed.
    """
    from ..datasets.files import copy_dataset
    from ..problem.new import create_problem

    folder = Path(name)
    if kind is not None and dataset is not None:
        raise InputError(
            "found --kind and --dataset; expected one of them", None, where="--dataset"
        )
    if dataset is not None:
        file, *data = copy_dataset(dataset, folder)
    else:
        file, *data = create_problem(folder, kind and kind.value)
    typer.echo(file)
    for each in data:
        typer.echo(each)
    yours = (
        "put your mesh, poses and marker tracks into the same folder and write their names "
        "into the problem file"
    )
    example = (
        "the problem runs as it is, with simulated data whose true constants its first lines state; "
        "then replace the data by your own"
    )
    is_empty = kind is None and dataset is None
    if dataset is not None:
        example = "the problem runs as it is; its comments state the source of the data"
    error_console.print(f"Next: {yours if is_empty else example}.", soft_wrap=True)
    for next_ in ("check", "solve"):
        error_console.print(f"  collocation-sysid {next_} {shlex.quote(str(file))}", soft_wrap=True)


def _methods_table() -> Table:
    from ..methods import METHODS, method_summary

    return Table(
        "", ("method", ""), rows=tuple((name, method_summary(name)) for name in METHODS), texts=1
    )


def _options_table(method: str) -> list[Shown]:
    from ..methods import method_options_schema, method_summary
    from ..problem.solver_schema import table_heading

    rows = []
    for name, stated in method_options_schema(method)["properties"].items():
        rows.append(
            (
                name,
                _default_text(stated),
                f"{_allowed_values_text(stated)}\n{stated['description']}",
            )
        )
    table = Table("", ("option", "default", ""), rows=tuple(rows), names=2, texts=1)
    return [
        method_summary(method),
        "",
        f"In the problem file, under {table_heading(method)}:",
        "",
        table,
    ]


def _default_text(option: Mapping[str, Any]) -> str:
    default = option["default"]
    items = default if isinstance(default, tuple) else [default]
    text = ", ".join(f"{item:g}" if isinstance(item, float) else str(item) for item in items)
    return f"[{text}]" if isinstance(default, tuple) else text


def _allowed_values_text(option: Mapping[str, Any]) -> str:
    """Return words such as "number above 0"; for an array about its items."""
    if "enum" in option:
        return ", ".join(
            each if isinstance(each, str) else json.dumps(each) for each in option["enum"]
        )
    if option["type"] == "array":
        return f"list, each a {_allowed_values_text(option['items'])}"
    limits = {"exclusiveMinimum": "above", "minimum": "of at least"}
    ranges = [f" {word} {option[key]:g}" for key, word in limits.items() if key in option]
    return TYPE_WORDS[option["type"]] + "".join(ranges)
