"""A new problem: a commented file, and beside it simulated data with which it runs as it is."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

from ..errors import InputError
from ..files import require_possible, whole_file, write_whole

# A folder for each kind, see scripts/make_templates.py.
TEMPLATES = Path(__file__).parent / "templates"


def begin(folder: Path, kind: str | None = None) -> list[Path]:
    """Write problem.toml into a folder, which is made; its name is the title.

    Parameters
    ----------
    folder : Path
    kind : str, optional
        With a simulated recording of this kind; by default the file alone, of a body that swings.

    Returns
    -------
    list of Path
        The problem file, then its data.

    Raises
    ------
    InputError
        Where there is one of these files already, or the folder cannot be made.
    """
    file, template = folder / "problem.toml", TEMPLATES / (kind or "swing")
    require_possible(folder)
    data = sorted(each for each in template.iterdir() if kind and each.name != file.name)
    for each in (file, *(folder / each.name for each in data)):
        if each.exists():
            raise InputError("it is there already; choose another name", each)
    title = json.dumps(folder.resolve().name, ensure_ascii=False)  # quoted as TOML quotes
    text = (template / file.name).read_text(encoding="utf-8")
    write_whole(file, text.replace('title = ""', f"title = {title}", 1))
    for each in data:
        with whole_file(folder / each.name) as draft:
            shutil.copyfile(each, draft)
    return [file, *(folder / each.name for each in data)]
