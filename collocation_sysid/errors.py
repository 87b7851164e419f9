"""The two ways in which a run is refused: bad input, and a simulation that cannot go on."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


def hint_at(name: str, known: Iterable[str]) -> str:
    """What to add to a message about a name cut short or misspelt: the one that was meant."""
    names = [other for other in known if len(other) > 2]  # each of two letters is near another
    longer = [other for other in names if len(name) > 1 and other.startswith(name)]
    close = longer or difflib.get_close_matches(name, names, n=1)
    return f"; did you mean {close[0]!r}?" if close else ""


# Marks in place of what would control a terminal or turn its text around, and of what neither UTF-8
# nor XML can hold.
_MARKS = (
    {code: 0x2400 + code for code in range(0x20) if code not in (0x09, 0x0A)}
    | {0x7F: 0x2421}
    | dict.fromkeys((*range(0x80, 0xA0), *range(0x202A, 0x202F), *range(0x2066, 0x206A)), 0xFFFD)
    | dict.fromkeys((*range(0xD800, 0xE000), 0xFFFE, 0xFFFF), 0xFFFD)
)
# Letters that a message may have, and what it quotes of a file.
LONGEST, LONGEST_EXCERPT = 1500, 60
_ENDLESS_WORD = re.compile(r"(\S{60})\S{340,}")


def printable(text: str) -> str:
    """Text with marks in place of control characters and of what UTF-8 and XML cannot hold."""
    return text.translate(_MARKS)


def excerpt(text: str, longest: int = LONGEST_EXCERPT) -> str:
    """The text, or its beginning where it is long."""
    return text if len(text) <= longest else f"{text[: longest - 1]}…"


def listed(names: Iterable[str]) -> str:
    """Names in a sentence: "a, b and c"."""
    *others, last = [*names] or [""]
    return f"{', '.join(others)} and {last}" if others else last


class InputError(ValueError):
    """Something the user gave cannot be used; the message says what, where and what was expected.

    Parameters
    ----------
    message : str
        What was found, what was expected, and the remedy.
    source : str or Path, optional
        The file it was found in.
    where : str, optional
        The key, line or column in that file.
    """

    def __init__(
        self, message: str, source: str | Path | None = None, where: str | None = None
    ) -> None:
        self.message = message
        self.source = source
        self.where = where
        said = ": ".join(str(part) for part in (source, where, message) if part)
        line = printable(said).replace("\n", "␊")
        super().__init__(excerpt(_ENDLESS_WORD.sub(r"\1…", line), LONGEST))

    def __reduce__(self) -> tuple[type[InputError], tuple[str, str | Path | None, str | None]]:
        return type(self), (self.message, self.source, self.where)

    def located(self, source: str | Path | None = None, where: str | None = None) -> InputError:
        """Return the same error with file and key filled in where they were missing."""
        return InputError(self.message, self.source or source, self.where or where)


def require_among(
    name: str,
    known: Iterable[str],
    source: str | Path | None = None,
    where: str | None = None,
    count: str = "one",
) -> None:
    """Refuse a name that is none of the known ones, of which `count` is expected.

    Raises
    ------
    InputError
        With the one that was probably meant.
    """
    names = list(known)
    if name not in names:
        expected = f"expected {count} of {', '.join(names)}{hint_at(name, names)}"
        raise InputError(f"found {name!r}; {expected}", source, where)


@contextmanager
def located(source: str | Path | None = None, where: str | None = None) -> Iterator[None]:
    """Input errors of what is done within get file and key where they lack them."""
    try:
        yield
    except InputError as error:
        raise error.located(source, where) from error


class SimulationError(RuntimeError):
    """The equations of motion could not be solved.

    Parameters
    ----------
    message : str
        What failed and what to change.
    time_s : float
        Time of the step that failed.
    element : int or None
        The element that is worst deformed there, where one is to blame.
    state_m : (3n,) array, optional
        Positions where a static path ended; None where a time step failed.

    Attributes
    ----------
    lost_stability : LostStability or None
        The mode in which the body lost its stability, if that was why, see
        `program.lost_stability`. It is not kept where an error is handed to another process.
    """

    lost_stability: Any = None

    def __init__(
        self,
        message: str,
        time_s: float,
        element: int | None = None,
        state_m: Any = None,
    ) -> None:
        self.state_m = state_m
        self.message = message
        self.time_s = time_s
        self.element = element
        at = f"t = {time_s:.6g} s" + (f", element {element}" if element is not None else "")
        super().__init__(f"{message} ({at})")

    def __reduce__(self) -> tuple[type[SimulationError], tuple[str, float, int | None, Any]]:
        # Else a process would hand on the text alone, from which the other cannot build it anew.
        return type(self), (self.message, self.time_s, self.element, self.state_m)
