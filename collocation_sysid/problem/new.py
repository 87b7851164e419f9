"""New problem: a commented problem file, with simulated data that make it runnable."""

from __future__ import annotations

import json
from pathlib import Path

from ..common.files import write_new_files
from .editor_schema import SCHEMA_FILE, schema_text, schema_url, with_schema_reference

# A folder for each kind, see scripts/data/make_templates.py.
TEMPLATES = Path(__file__).parent / "templates"
# Comment on settings of a template that are right for its simulated recording only.
SIMULATED_MARK = "for your own recordings"


def create_problem(folder: Path, kind: str | None = None) -> list[Path]:
    """Write problem.toml, and data for it, to a folder, whose name becomes the title.

    The first line of problem.toml names the JSON schema for editors: its address if the project
    publishes it, or else a file schema.json that is written, too.

    Parameters
    ----------
    folder : Path
        Folder; it is created if necessary. Other files in it remain.
    kind : str, optional
        Name of a folder of `TEMPLATES`, whose simulated recording is written too; None writes only
        the file, for a swinging body, without the settings of a simulated recording.

    Returns
    -------
    list of Path
        The problem file, its data files by name, and the schema, if it is written.

    Raises
    ------
    InputError
        If one of these files exists or cannot be written; nothing is written then.
    """
    file = folder / "problem.toml"
    template = TEMPLATES / (kind or "swing")
    data = sorted(each for each in template.iterdir() if kind and each.name != file.name)
    url = schema_url()
    title = json.dumps(folder.resolve().name, ensure_ascii=False)  # quoted as TOML quotes
    text = (template / file.name).read_text(encoding="utf-8")
    if kind is None:
        text = _without_simulated_settings(text)
    text = with_schema_reference(text, url or SCHEMA_FILE)
    contents: dict[Path, str | Path] = {file: text.replace('title = ""', f"title = {title}", 1)}
    contents |= {folder / each.name: each for each in data}
    contents |= {} if url else {folder / SCHEMA_FILE: schema_text()}
    return write_new_files(contents)


def _without_simulated_settings(text: str) -> str:
    """Tables with `SIMULATED_MARK` in a comment hold only for the simulated recording."""
    paragraphs = text.split("\n\n")
    measured = [each for each in paragraphs if SIMULATED_MARK not in each]
    return "\n\n".join(measured).rstrip() + "\n"
