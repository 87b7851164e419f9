"""A method is made of its options, by name.

Many take growing first parts of every recording, solved one after another.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from itertools import pairwise
from typing import Annotated, Any, TypeVar

from pydantic import AfterValidator

from ..checked import Options, Positive
from ..errors import InputError, hint_at

T = TypeVar("T", bound="Options")


def built(kind: type[T], given: Mapping[str, Any], where: str) -> T:
    """A method from its options by name.

    Parameters
    ----------
    kind : type
    given : mapping
    where : str
        The key under which the options were given, for messages.

    Raises
    ------
    InputError
        For an unknown option, with the nearest that there is, or a value that it cannot have.
    """
    known = [field.name for field in fields(kind)]
    for name in given:
        if name not in known:
            has = f"it has {', '.join(known)}{hint_at(name, known)}"
            raise InputError(f"{kind.name!r} has no option {name!r}; {has}", None, where)
    try:
        return kind(**given)
    except InputError as error:
        raise InputError(error.message, None, f"{where}.{error.where}") from error


# Fewest samples, or rows of a grid, of a first part.
FEWEST = 8


def part_of(count: int, share: float) -> int:
    """How many of `count` a share is."""
    return min(count, max(FEWEST, round(share * count)))


def _ascending(shares: tuple[float, ...]) -> tuple[float, ...]:
    ascending = all(a < b for a, b in pairwise(shares))
    if not ascending or shares[-1:] != (1.0,):
        raise ValueError(f"found {list(shares)}; expected numbers above 0 that ascend to 1")
    return shares


Shares = Annotated[tuple[Positive, ...], AfterValidator(_ascending)]
SHARES = (0.25, 0.5, 1.0)
