"""Command-line arguments of studies: methods and true values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...common.text_files import HAND_WRITTEN_BYTES, parse_toml, read_text
from ...errors import InputError, located, require_among
from ...methods import METHODS, require_method
from ...problem.validation_messages import shortened


def unique_items(text: str) -> tuple[str, ...]:
    """Return the items of text separated by commas, stripped, each once, in their order; empty ones
    are left out, so that the result may be empty.
    """
    return tuple(dict.fromkeys(item.strip() for item in text.split(",") if item.strip()))


def parse_methods(text: str, option: str = "--methods") -> tuple[str, ...]:
    """Return methods from text separated by commas, each once: a name, which options KEY=VALUE of
    the method may follow, such as "penalty inner=levenberg-marquardt".

    Raises
    ------
    InputError
        If there is no name, or for an unknown one, with the most similar known one, or a word that
        is no option; it refers to the command-line `option`.
    """
    methods = unique_items(text)
    if not methods:
        raise InputError(
            f"found no name; expected some of {', '.join(METHODS)}", None, where=option
        )
    for name, *options in map(str.split, methods):
        require_method(name, option)
        for word in options:
            if not all(word.partition("=")):
                raise InputError(
                    f"found {word!r} after {name}; expected options KEY=VALUE, and a comma before "
                    "another method",
                    None,
                    where=option,
                )
    return methods


def read_truth(
    sources: Sequence[str], known_names: Sequence[str], needed: Sequence[str]
) -> dict[str, float]:
    """Return the true values of parameters, by name; empty without sources.

    Parameters
    ----------
    sources : sequence of str
        Each a path of a TOML file, with values at the top level or in a table ``parameters``; or,
        with an equals sign, "name=value" separated by commas. Later ones override earlier ones.
    known_names : sequence of str
        Names of all parameters of the problem.
    needed : sequence of str
        Names of those that are estimated, all of which must have a value if there is a source.

    Raises
    ------
    InputError
        For a file that cannot be read, an unknown name, a value that is no positive number, or a
        missing value of an estimated parameter.
    """
    truth: dict[str, float] = {}
    for item in sources:
        source, table = _truth_table(item)
        for name, value in table.items():
            require_among(name, known_names, source=source, where="--truth")
            truth[name] = _positive_value(name, value, source=source)
    if missing := [name for name in needed if sources and name not in truth]:
        raise InputError(
            f"{', '.join(missing)} missing; expected the true value of every estimated parameter",
            None,
            where="--truth",
        )
    return truth


def _truth_table(item: str) -> tuple[Path | None, Mapping[str, Any]]:
    if "=" in item:
        pairs = [pair.partition("=") for pair in item.split(",") if pair.strip()]
        return None, {name.strip(): value.strip() for name, _, value in pairs}
    path = Path(item)
    with located(where="--truth"):
        what = "a TOML file of true values, or name=value such as mu_pa=300"
        content = parse_toml(read_text(path, what, HAND_WRITTEN_BYTES), path)
    table = content.get("parameters", content)
    if not isinstance(table, Mapping):
        raise InputError(
            "parameters is not a table; expected true values by name", path, where="--truth"
        )
    return path, table


def _positive_value(name: str, value: Any, source: Path | None) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = np.nan
    if not 0 < number < np.inf:
        quoted = value[:60] if isinstance(value, str) else shortened(value)
        raise InputError(
            f"found {name} = {quoted}; expected a positive number", source, where="--truth"
        )
    return number
