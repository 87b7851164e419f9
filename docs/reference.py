"""Pages made when the documentation is built: the problem file's keys, the command line, and the
notebooks of the tutorial.
"""

from __future__ import annotations

import inspect
import json
import re
from base64 import b64decode
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import typer

from collocation_sysid.cli import app
from collocation_sysid.problem.editor_schema import SCHEMA_FILE, schema_text
from collocation_sysid.problem.nuisance_schema import KEYS
from collocation_sysid.problem.schema import ProblemFile

Schema = Mapping[str, Any]
# Folder of files that are published beside the pages.
PUBLISHED = "published"
NOTEBOOKS = Path(__file__).parents[1] / "scripts" / "notebooks"
KINDS = {
    "string": "text",
    "integer": "whole number",
    "number": "number",
    "boolean": "true or false",
    "object": "table",
}


def write_pages(folder: Path) -> None:
    """Write all pages, and the schema of the problem file, into a folder."""
    published = folder / PUBLISHED
    published.mkdir(parents=True, exist_ok=True)
    (published / SCHEMA_FILE).write_text(schema_text(), encoding="utf-8")
    (folder / "problem_file.md").write_text(problem_file(), encoding="utf-8")
    (folder / "command_line.md").write_text(command_line(), encoding="utf-8")
    for notebook in sorted(NOTEBOOKS.glob("*.ipynb")):
        write_notebook(notebook, folder / "tutorial")


# The tutorial -------------------------------------------------------------------------------------


def write_notebook(notebook: Path, folder: Path) -> None:
    """Write a notebook with its stored outputs as a page, and its pictures beside it."""
    folder.mkdir(exist_ok=True)
    parts = []
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    for number, cell in enumerate(cells):
        text = "".join(cell["source"]).strip()
        if cell["cell_type"] == "markdown":
            text = text.replace(".ipynb)", ".md)").replace(
                "](../../docs/howto)", "](../../index.md)"
            )
            parts.append(text.replace("](../../docs/", "](../../"))
            continue
        if not text.startswith("%"):  # a command of the notebook
            parts.append(_fenced(text, "python"))
        for place, output in enumerate(cell["outputs"]):
            data = output.get("data", {})
            if "image/png" in data:
                name = f"{notebook.stem}_{number}_{place}.png"
                (folder / name).write_bytes(b64decode(data["image/png"]))
                parts.append(f"![]({name})")
            elif said := "".join(output.get("text", data.get("text/plain", ""))).strip("\n"):
                parts.append(_fenced(said, "text"))
    (folder / f"{notebook.stem}.md").write_text("\n\n".join(parts) + "\n", encoding="utf-8")


def _fenced(text: str, language: str) -> str:
    return f"````{language}\n{text}\n````"


# The problem file ---------------------------------------------------------------------------------


def problem_file() -> str:
    """Every table of the problem file with its keys, from the schema that checks it."""
    schema = ProblemFile.model_json_schema()
    parts = [
        "# The problem file's keys",
        "A problem file is in TOML. Values are in SI units; the names of the keys state the unit. "
        "Unknown keys are refused. A key must be stated if its table has neither a default nor "
        "“optional” for it. `collocation-sysid new NAME` writes a commented problem file; "
        "`collocation-sysid schema` prints the keys as a JSON schema for editors.",
        *dict.fromkeys("\n\n".join(t) for t in _tables("", schema, schema["$defs"])),
    ]
    return "\n\n".join(parts) + "\n"


def _tables(name: str, table: Schema, known: Schema, listed: bool = False) -> Iterator[list[str]]:
    """A table of the file and those inside, each a heading, a sentence and its keys."""
    rows, inner = [], []
    required = table.get("required", ())
    for key, entry in table.get("properties", {}).items():
        where = f"{name}.{key}".lstrip(".")
        inner += [(where, each, many) for each, many in _models(entry, known)]
        default = "" if key in required else _default(entry)
        said = " ".join(entry.get("description", "").split())
        rows.append(f"| `{key}` | {_kind(entry, known)} | {default} | {_cell(said)} |")
    title = f"`[[{name}]]`" if listed else f"`[{name}]`"
    if rows:
        head = "| key | value | default | what it is |\n|---|---|---|---|"
        said = [_prose(table.get("description", ""))] if name else []
        keys = f"{head}\n" + "\n".join(rows)
        yield [f"## {title}" if name else "## Top level", *filter(None, said), keys]
    for where, each, many in inner:
        yield from _tables(where, each, known, many)


def _default(entry: Schema) -> str:
    value = entry.get("default")
    return "optional" if value in (None, []) or isinstance(value, dict) else f"`{_toml(value)}`"


def _models(entry: Schema, known: Schema, listed: bool = False) -> Iterator[tuple[Schema, bool]]:
    """Tables that a value may be, and whether there may be several."""
    if "$ref" in entry:
        found = known[entry["$ref"].rpartition("/")[2]]
        if "properties" in found:
            yield found, listed
        return
    if "properties" in entry:
        yield entry, listed
    for each in (*entry.get("anyOf", ()), *entry.get("oneOf", ())):
        yield from _models(each, known, listed)
    if "items" in entry:
        yield from _models(entry["items"], known, True)
    if isinstance(entry.get("additionalProperties"), Mapping):
        yield from _models(entry["additionalProperties"], known)


def _kind(entry: Schema, known: Schema) -> str:
    """What kind of value a key has, in words."""
    if "$ref" in entry:
        found = known[entry["$ref"].rpartition("/")[2]]
        return "table" if "properties" in found else _kind(found, known)
    several = [*entry.get("anyOf", ()), *entry.get("oneOf", ())]
    if several:
        kinds = [_kind(each, known) for each in several if each.get("type") != "null"]
        return " or ".join(dict.fromkeys(kinds))
    if "enum" in entry:
        return ", ".join(f"`{_toml(each)}`" for each in entry["enum"])
    if "const" in entry:
        return f"`{_toml(entry['const'])}`"
    if entry.get("type") == "array":
        inside = entry.get("items")
        return f"list of {_kind(inside, known)}s" if isinstance(inside, Mapping) else "list"
    return KINDS.get(entry.get("type", ""), "value")


def _toml(value: Any) -> str:
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, tuple):
        value = list(value)
    return str(value).lower() if isinstance(value, bool) else str(value)


# The command line ---------------------------------------------------------------------------------


def nuisances() -> str:
    """The table of what may be unknown of a recording, as the page on motion capture has it."""
    lines = ["| key of `[experiment.nuisance]` | meaning | default prior |", "|---|---|---|"]
    for key, rows in KEYS.items():
        said = " ".join(f"{row.description[0].upper()}{row.description[1:]}." for row in rows)
        priors = ", ".join(f"{row.prior_key()} = {row.sigma:.4g}" for row in rows if row.sigma)
        usual = ", ".join(row.usual for row in rows if row.unit != "σ")
        default = f"`{{ {priors} }}` {usual}".strip() if priors else '"none"'
        lines.append(f"| `{key}` | {said} | {default} |")
    return "\n".join(lines)


def command_line() -> str:
    """Every command with its arguments and options, from what `--help` tells."""
    group: Any = typer.main.get_command(app)
    parts = [
        "# The command line",
        "Results are printed on stdout, progress and messages on stderr. Exit codes: 0 converged, "
        "1 not converged or, with `solve --strict`, doubtful, 2 bad input, 130 interrupted by Ctrl-C, "
        "143 by SIGTERM.",
    ]
    for name in sorted(group.list_commands(None)):
        command = group.get_command(None, name)
        parts += [f"## {name}", _prose(command.help or "")]
        head = "| argument or option | default | what it is |\n|---|---|---|"
        rows = [_parameter(each) for each in command.params if not getattr(each, "hidden", False)]
        parts.append(f"{head}\n" + "\n".join(rows))
        examples = re.findall(r"^ *(collocation-sysid .*)$", command.epilog or "", re.MULTILINE)
        if examples:
            parts.append("```sh\n" + "\n".join(examples) + "\n```")
    return "\n\n".join(parts) + "\n"


def _parameter(given: Any) -> str:
    option = given.param_type_name == "option"
    opts = given.opts if option else [given.metavar or given.name.upper()]
    names = ", ".join(f"`{each}`" for each in opts)
    if option and not given.is_flag:
        names += f" {_cell(given.metavar or 'VALUE')}"
    simple = given.default is not None and not callable(given.default) and given.default is not ...
    default = f"`{given.default}`" if simple and not getattr(given, "is_flag", False) else ""
    return f"| {names} | {'required' if given.required else default} | {_cell(given.help or '')} |"


def _prose(text: str) -> str:
    """A docstring's text, without what click reads out of it."""
    return inspect.cleandoc(text).replace("\b", "").strip()


def _cell(text: str) -> str:
    """Text that ends no cell of a table, and opens no tag."""
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;")
