"""Command-line arguments of studies: methods, true values, and the values of swept keys."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...common.files import require_regular, require_size
from ...errors import InputError, require_among
from ...methods import METHODS, require_method
from ...problem.reading import parse_toml
from ...problem.validation_messages import shortened

# Largest number of runs of a study: more would be a mistake in a list of values.
MOST_RUNS = 10_000
RANGE = "such as 50:5000:log:9 or 0:1:5"


def unique_items(text: str) -> tuple[str, ...]:
    """Return the items of text separated by commas, stripped, each once, in their order; empty ones
    are left out, so that the result may be empty.
    """
    return tuple(dict.fromkeys(item.strip() for item in text.split(",") if item.strip()))


def parse_methods(text: str, option: str = "--methods") -> tuple[str, ...]:
    """Return names of methods from text separated by commas, each once.

    Raises
    ------
    InputError
        If there is no name, or for an unknown one, with the most similar known one; it refers to
        the command-line `option`.
    """
    names = unique_items(text)
    if not names:
        raise InputError(
            f"found no name; expected some of {', '.join(METHODS)}", None, where=option
        )
    for name in names:
        require_method(name, option)
    return names


# The truth ----------------------------------------------------------------------------------------


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
    """Return the file, and its values by name, of a source of true values."""
    if "=" in item:
        pairs = [pair.partition("=") for pair in item.split(",") if pair.strip()]
        return None, {name.strip(): value.strip() for name, _, value in pairs}
    path = Path(item)
    require_regular(path, "--truth")
    require_size(path)
    try:
        content = parse_toml(path.read_text(encoding="utf-8-sig"), path)
    except FileNotFoundError:
        raise InputError(
            "there is no such file; expected a TOML file of true values, or name=value such as "
            "mu_pa=300",
            path,
            where="--truth",
        ) from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"this file cannot be read: {error}", path, where="--truth") from error
    table = content.get("parameters", content)
    if not isinstance(table, Mapping):
        raise InputError(
            "parameters is not a table; expected true values by name", path, where="--truth"
        )
    return path, table


def _positive_value(name: str, value: Any, source: Path | None) -> float:
    """Return a value as a positive, finite float."""
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


# Swept keys ---------------------------------------------------------------------------------------


def parse_varied_keys(texts: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Return the values of each swept key, as text for `--set`.

    Parameters
    ----------
    texts : sequence of str
        "key=a,b,c", "key=first:last:count" or "key=first:last:log:count" (evenly spaced, ends
        included). Commas within brackets, braces and quotes do not separate values.

    Raises
    ------
    InputError
        For a text that cannot be read, which is quoted; for a key that is given twice; without any
        key; and for more than `MOST_RUNS` combinations.
    """
    over: dict[str, tuple[str, ...]] = {}
    for text in texts:
        key, equals, values = (part.strip() for part in text.partition("="))
        if not (equals and key and values):
            raise InputError(
                f"found {text!r}; expected key=values such as parameters.mu_pa.guess="
                "50:5000:log:9 or transcription.substeps=1,2,4",
                None,
                where="--over",
            )
        if key in over:
            raise InputError(
                f"{key} is given twice; put its values in one list", None, where="--over"
            )
        ranged = ":" in values and not values.startswith(('"', "'", "[", "{"))
        over[key] = tuple(_range_values(key, values) if ranged else _split_values(values))
    if not over:
        raise InputError("missing; expected at least one key to sweep over", None, where="--over")
    require_few(math.prod(map(len, over.values())), "--over", noun="runs")
    return over


def require_few(count: int, option: str, noun: str) -> None:
    """Raise `InputError` if `count` exceeds `MOST_RUNS`.

    Parameters
    ----------
    count : int
        Number of runs, or of anything that makes runs.
    option : str
        Command-line option that the message refers to.
    noun : str
        Plural noun for what is counted, for the message.
    """
    if count > MOST_RUNS:
        number = f"{count:,}" if count < 10**15 else "more than 10¹⁵"
        raise InputError(
            f"found {number} {noun}; expected at most {MOST_RUNS:,}: give fewer values",
            None,
            where=option,
        )


def _range_values(key: str, text: str) -> Iterable[str]:
    """Return the values of a range "first:last:count" or "first:last:log:count", ends included,
    evenly spaced, or so in the logarithm, as text with 12 digits.
    """
    first, *middle, count = text.split(":")
    try:
        low = float(first)
        high = float(middle[0])
        number = int(count)
        spacing = middle[1] if len(middle) == 2 else "linear"
        if len(middle) > 2 or number < 1 or not np.isfinite([low, high, high - low]).all():
            raise ValueError
    except (ValueError, IndexError):
        raise InputError(
            f"found {text} for {key}; expected first:last:count or first:last:log:count, {RANGE}",
            None,
            where="--over",
        ) from None
    require_few(number, "--over", noun=f"values of {key}")
    if spacing not in ("log", "lin", "linear"):
        raise InputError(
            f"found the spacing {spacing!r} for {key}; expected log or linear, {RANGE}",
            None,
            where="--over",
        )
    if spacing == "log" and not (low > 0 and high > 0):
        raise InputError(
            f"found {text} for {key}; a logarithmic range needs ends above 0", None, where="--over"
        )
    spaced = np.geomspace if spacing == "log" else np.linspace
    # Without the rounding errors of their computation.
    return [f"{value:.12g}" for value in spaced(low, high, number)]


def _split_values(text: str) -> list[str]:
    """Split at commas outside of brackets, braces and quotes."""
    items = [""]
    open_brackets = 0
    quote = ""
    for letter in text:
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "\"'":
            quote = letter
        open_brackets += (letter in "[{") - (letter in "]}") if not quote else 0
        if letter == "," and not open_brackets and not quote:
            items.append("")
        else:
            items[-1] += letter
    return [item.strip() for item in items if item.strip()]
