"""The two exceptions for users, invalid input and a failed simulation, and helpers for messages."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any


def hint_at(name: str, known: Iterable[str]) -> str:
    """Return "; did you mean 'NAME'?" with the known name that a misspelt or abbreviated name most
    likely means; "" if there is none.

    The shortest known name that begins with `name` is preferred (if `name` has two letters or more),
    then the most similar one (`difflib.get_close_matches`), then the only one of which `name` is a
    word, such as "unit" of "length_unit". Known names of one or two letters are never suggested.
    """
    names = [other for other in known if len(other) > 2]  # each of two letters is near another
    longer = sorted((e for e in names if len(name) > 1 and e.startswith(name)), key=len)
    close = longer or difflib.get_close_matches(name, names, n=1)
    words = [other for other in names if len(name) > 2 and name in other.split("_")]
    close = close or (words if len(words) == 1 else [])
    return f"; did you mean {close[0]!r}?" if close else ""


# Characters without width, such as a byte order mark within a file: a quoted number would look right.
_INVISIBLE = (0xAD, 0x61C, 0x200B, 0x200E, 0x200F, *range(0x2060, 0x2065), 0xFEFF)
# Marks in place of what would control a terminal or turn its text around, and of what neither UTF-8
# nor XML can hold.
_MARKS = (
    {code: 0x2400 + code for code in range(0x20) if code not in (0x09, 0x0A)}
    | {0x7F: 0x2421}
    | dict.fromkeys((*range(0x80, 0xA0), *range(0x202A, 0x202F), *range(0x2066, 0x206A)), 0xFFFD)
    | dict.fromkeys((*range(0xD800, 0xE000), 0xFFFE, 0xFFFF), 0xFFFD)
    | dict.fromkeys((*_INVISIBLE, 0x2028, 0x2029), 0xFFFD)
)
# Longest message [characters]: a screen of text, so that quoted input cannot flood a terminal.
LONGEST = 1500
# Longest quotation of a file in a message [characters]: most of a line of a terminal.
LONGEST_EXCERPT = 60
_ENDLESS_WORD = re.compile(r"(\S{60})\S{340,}")


def printable(text: str) -> str:
    """Return the text with visible marks in place of control characters.

    ASCII control characters except tab and line feed become their symbols (U+2400 + code); further
    controls, bidirectional overrides, invisible characters, surrogates and other characters that XML
    or UTF-8 cannot hold become U+FFFD.
    """
    return text.translate(_MARKS)


def excerpt(text: str, longest: int = LONGEST_EXCERPT) -> str:
    """Return the text, cut to `longest` characters; the last of them is then "…"."""
    return text if len(text) <= longest else f"{text[: longest - 1]}…"


def listed(names: Iterable[str]) -> str:
    """Return names as part of a sentence: "a, b and c"; one name alone, and "" without names."""
    *others, last = [*names] or [""]
    return f"{', '.join(others)} and {last}" if others else last


class InputError(ValueError):
    """Invalid input by the user; the message states what was found, where, and what was expected.

    The text of the exception is "source: where: message", without the parts that are missing. It is
    one line: line feeds become "␊", control characters visible marks (`printable`), words of 400
    characters or more are cut to 60, and the whole to `LONGEST` characters. The attributes
    `message`, `source` and `where` keep the arguments unchanged.

    Parameters
    ----------
    message : str
        What was found, what was expected, and the remedy.
    source : str or Path, optional
        File that contains the input.
    where : str, optional
        Key, line or column in that file.
    """

    def __init__(
        self, message: str, source: str | Path | None = None, where: str | None = None
    ) -> None:
        self.message = message
        self.source = source
        self.where = where
        text = ": ".join(str(part) for part in (source, where, message) if part)
        line = printable(text).replace("\n", "␊")
        super().__init__(excerpt(_ENDLESS_WORD.sub(r"\1…", line), LONGEST))

    def __reduce__(self) -> tuple[type[InputError], tuple[str, str | Path | None, str | None]]:
        return type(self), (self.message, self.source, self.where)

    def located(self, source: str | Path | None = None, where: str | None = None) -> InputError:
        """Return a copy of the error with `source` and `where` filled in where they are missing;
        those that the error has already are kept.
        """
        return InputError(self.message, self.source or source, where=self.where or where)


class ImplausibleMarkersError(InputError):
    """Tracks that cannot belong to the body of an experiment."""

    def __init__(self, message: str, experiment: Any, constants: Mapping[str, float]) -> None:
        super().__init__(message, where="markers")
        # Where the cause is sought, and physical values by name.
        self.experiment = experiment
        self.constants = constants

    def __reduce__(self) -> tuple[type[InputError], tuple[str, None, str]]:
        return InputError, (self.message, None, "markers")


def require_among(
    name: str,
    known: Iterable[str],
    source: str | Path | None = None,
    where: str | None = None,
    count: str = "one",
) -> None:
    """Raise an error unless `name` is one of the known ones.

    Parameters
    ----------
    name : str
        The name to be checked.
    known : iterable of str
        Valid names, in the order in which the message lists them.
    source, where : str or None
        File and key for the message, see `InputError`.
    count : str
        Word for the number of names expected, used in the message alone: "expected one of …".

    Raises
    ------
    InputError
        With the known names, and the most similar one as a suggestion.
    """
    names = list(known)
    if name not in names:
        expected = f"expected {count} of {', '.join(names)}{hint_at(name, names)}"
        raise InputError(f"found {name!r}; {expected}", source, where=where)


@contextmanager
def located(source: str | Path | None = None, where: str | None = None) -> Iterator[None]:
    """Add file and key to `InputError`s raised in the context, where they are missing; other
    exceptions pass unchanged.

    Raises
    ------
    InputError
        In place of the one that was raised, see `InputError.located`.
    """
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
        Index of the most deformed element; None if no element is responsible.
    state_m : (3n,) array, optional
        Positions at which a path of static equilibria ended; None if a time step failed.

    Attributes
    ----------
    stability_loss : StabilityLoss or None
        Mode in which the body lost its stability, see `program.find_stability_loss`; None for other
        causes and for errors that were passed to another process.
    """

    stability_loss: Any = None

    def __init__(
        self, message: str, time_s: float, element: int | None = None, state_m: Any = None
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
