"""Text of users and of other programs: its size is limited before it is read, and a small text cannot
take much time or memory.
"""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from ..errors import InputError, excerpt
from .files import DAMAGE, reason, require_regular, require_size

# Largest file that is written by hand [bytes].
HAND_WRITTEN_BYTES = 10_000_000
# Levels of tables and lists that a problem file may have: it needs seven.
DEEPEST = 20
# A dotted key of more parts, 100 at least; no part is looked at twice.
_ENDLESS_KEY = re.compile(
    r"""(?<![\w-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){100}"""
)
# What the TOML parser says where people see something simpler.
_PLAINER = {
    "Cannot overwrite a value": "this key is given twice",
    "Illegal character '\\n'": "a text lacks its closing quote",
}


def read_text(path: Path, what: str, most: int | None = None) -> str:
    """Return the text of a file (UTF-8), without a byte order mark; its kind and its size are
    checked before it is read.

    Parameters
    ----------
    what : str
        Kind of file that is expected, for messages.
    most : int, optional
        Largest size, see `require_size`.

    Raises
    ------
    InputError
        If the file does not exist or is not a text file.
    """
    require_regular(path)
    require_size(path, most)
    try:
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise InputError(f"there is no such file; expected {what}", path) from None
    except IsADirectoryError:
        raise InputError(f"this is a folder; expected {what}", path) from None
    except UnicodeDecodeError:
        raise InputError(f"this is not a text file; expected {what}", path) from None
    except (OSError, MemoryError, ValueError) as error:  # the last for a path that has a NUL byte
        raise InputError(f"the file cannot be read ({reason(error)})", path) from error


def parse_json(text: str) -> Any:
    """Return the content of a JSON text.

    Raises
    ------
    ValueError
        If it is not valid, nested too deeply, or beyond the limits of memory or of digits.
    """
    try:
        return json.loads(text)
    except (RecursionError, MemoryError) as error:
        raise ValueError(reason(error)) from error


def parse_yaml(text: str) -> Any:
    """Return the content of a YAML text without tags of objects.

    Raises
    ------
    ValueError
        If it is not valid, nested too deeply, or its aliases stand for more values than the text has
        characters.
    """
    import yaml  # only logs and cameras have such files

    try:
        # libyaml, the loader in C, ends the process at deep nesting with some versions of PyYAML.
        loader = yaml.SafeLoader(text)  # which refuses control characters
        root = loader.get_single_node()
        if _value_count(root, {}) > len(text):
            raise ValueError("aliases stand for more values than the text has characters")
        return None if root is None else loader.construct_document(root)
    except (yaml.YAMLError, *DAMAGE) as error:  # constructors of values raise anything
        raise ValueError(reason(error)) from error


def _value_count(node: Any, known: dict[int, float]) -> float:
    """Return the number of values of a node with its aliases, infinite for one that has itself."""
    if id(node) not in known:
        known[id(node)] = np.inf
        value = getattr(node, "value", None)
        parts = value if isinstance(value, list) else ()
        nodes = (each for part in parts for each in (part if isinstance(part, tuple) else (part,)))
        known[id(node)] = 1 + sum(_value_count(each, known) for each in nodes)
    return known[id(node)]


class _WithoutTypes(ElementTree.TreeBuilder):
    def doctype(self, name: str, *_: Any) -> None:
        raise ValueError(f"found the document type {name}, whose entities could expand")


def parse_xml(text: str) -> ElementTree.Element:
    """Return the root of an XML text without a document type.

    Raises
    ------
    ValueError
        If it is not valid, or has a document type.
    """
    try:
        return ElementTree.fromstring(text, ElementTree.XMLParser(target=_WithoutTypes()))
    except ElementTree.ParseError as error:
        raise ValueError(reason(error)) from error


def parse_toml(text: str, path: Path) -> dict[str, Any]:
    """Return the content of a TOML text; `path` is only for messages.

    Raises
    ------
    InputError
        For invalid syntax, with the line if it is known, for more than `DEEPEST` nested levels,
        keys of 100 or more parts, and integers with too many digits.
    """
    try:
        if _ENDLESS_KEY.search(text) is not None:  # on which the parser would spend minutes
            raise RecursionError
        content = tomllib.loads(text)
        if _nesting_level_count(content) > DEEPEST:
            raise RecursionError
        return content
    except tomllib.TOMLDecodeError as error:
        raise _bad_syntax(str(error), text, path=path) from error
    except (RecursionError, ValueError) as error:  # Python's limits of nesting and of digits
        raise InputError(beyond_limits(error), path) from error


def _nesting_level_count(content: Any) -> int:
    """Return the nested levels, itself included, up to `DEEPEST` + 1."""
    level = [content]
    level_count = 0
    while level and level_count <= DEEPEST:
        tables = [each.values() if isinstance(each, dict) else each for each in level]
        level = [each for table in tables for each in table if isinstance(each, (dict, list))]
        level_count += 1
    return level_count


def beyond_limits(error: Exception) -> str:
    """Return the message for a file beyond the limits of its parser."""
    if isinstance(error, RecursionError):
        return f"tables or lists are nested too deeply; expected at most {DEEPEST} levels"
    return "an integer has too many digits; expected fewer than 4,300"


def _bad_syntax(complaint: str, text: str, path: Path) -> InputError:
    reason, _, place = complaint.rpartition(" (at ")
    reason = _PLAINER.get(reason, reason)
    matched = re.match(r"line (\d+)", place)
    if matched is None:
        return InputError(
            f"the file is not valid TOML: {reason or complaint}, at the end of the file", path
        )
    number = int(matched[1])
    line = excerpt(text.splitlines()[number - 1].strip())
    return InputError(
        f"the file is not valid TOML: {reason} in: {line}", path, where=f"line {number}"
    )
