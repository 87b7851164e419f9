"""Construction of methods from options by name, and shares of recordings.

Use `method_from_options` to make a method from a table of the problem file.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any, ClassVar, TypeVar

from ..common.validated_classes import validated
from ..errors import InputError, hint_at


@validated
class MethodOptions:
    """Base class of methods, which are called with a `Collocation`; fields are options.

    Decorate subclasses with `validated`, too.

    Attributes
    ----------
    name : str
        Name of the method, set by the subclass.
    needs_complete_start : bool
        Whether the method can only start from parameters with which everything can be simulated.
    """

    name: ClassVar[str]
    needs_complete_start: ClassVar[bool] = False


T = TypeVar("T", bound=MethodOptions)


def method_from_options(kind: type[T], options: Mapping[str, Any], key: str) -> T:
    """Return a method made from its options.

    Parameters
    ----------
    kind : type
        Class of the method, with a class attribute `name`.
    options : mapping
        Values by option name; options that are missing have their defaults.
    key : str
        Key of the problem file that contains the options, for messages.

    Raises
    ------
    InputError
        For an unknown option, with the most similar known one, or an invalid value.
    """
    known = [field.name for field in fields(kind)]
    for name in options:
        if name not in known:
            has = f"expected one of {', '.join(known)}{hint_at(name, known)}"
            raise InputError(
                f"the method {kind.name!r} has no option {name!r}; {has}", None, where=key
            )
    try:
        return kind(**options)
    except InputError as error:
        raise InputError(error.message, None, where=f"{key}.{error.where}") from error


# Fewest samples, or rows of a grid, of a first part.
FEWEST = 8
# Default shares of the recording that a method solves one after another.
SHARES = (0.25, 0.5, 1.0)
