"""A method is a dataclass of its options, checked against the types of its fields.

Many take growing first parts of every recording, solved one after another.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cache
from itertools import pairwise
from typing import Annotated, Any, ClassVar, TypeVar, get_type_hints

from pydantic import AfterValidator, TypeAdapter, ValidationError

from ..checked import Positive, expected
from ..errors import InputError, hint_at

T = TypeVar("T", bound="Options")


@dataclass(frozen=True)
class Options:
    """Base of the methods: a value that is not of its field's type is an `InputError`."""

    name: ClassVar[str]
    # Whether it can only start from parameters with which everything can be simulated.
    needs_whole_start: ClassVar[bool] = False

    def __post_init__(self) -> None:
        for name, adapter in _adapters(type(self)).items():
            found = getattr(self, name)
            try:
                object.__setattr__(self, name, adapter.validate_python(found))
            except ValidationError as error:
                raise _refusal(name, found, error.errors(include_url=False)[0]) from error


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


@cache
def _adapters(kind: type[Options]) -> dict[str, TypeAdapter[Any]]:
    types = get_type_hints(kind, include_extras=True)
    return {field.name: TypeAdapter(types[field.name]) for field in fields(kind)}


def _refusal(name: str, found: Any, fault: Mapping[str, Any]) -> InputError:
    """The error for a value, or for an entry of the table that it is."""
    for part in fault["loc"]:
        if isinstance(found, Mapping) and part in found:
            name, found = f"{name}.{part}", found[part]
    if fault["type"] == "value_error":
        return InputError(str(fault["ctx"]["error"]), None, name)
    choices = re.findall("'(.*?)'", fault["ctx"]["expected"] if "literal" in fault["type"] else "")
    hint = hint_at(str(found), choices)
    return InputError(f"found {found!r}; expected {expected(fault)}{hint}", None, name)


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
