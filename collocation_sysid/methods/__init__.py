"""Methods that solve a `Collocation`, by name, and what options they have."""

from __future__ import annotations

import inspect
from typing import Any

from pydantic import TypeAdapter

from ..errors import InputError, require_among
from ..stated import documented
from .comparison.casadi_nlp import why_not
from .continuation import STAGES, Continuation

METHODS: dict[str, type] = STAGES | {Continuation.name: Continuation}


def require_method(name: str, option: str) -> None:
    """Refuse the name of a method that there is not, given as an option of the command line."""
    if name not in METHODS:
        if (reason := why_not(name)) is not None:
            raise InputError(reason, None, option)
        require_among(name, METHODS, None, option)


def summary(method: str) -> str:
    """What a method is, in a line."""
    return inspect.cleandoc(METHODS[method].__doc__ or "").splitlines()[0]


def options_schema(method: str) -> dict[str, Any]:
    """JSON schema of a method's options: types, ranges, defaults and descriptions."""
    kind = METHODS[method]
    defaults, descriptions = kind(), documented(kind)
    options = TypeAdapter(kind).json_schema()["properties"]
    for name, option in options.items():
        del option["title"]
        option |= {"default": getattr(defaults, name), "description": descriptions[name]}
    return {
        "type": "object",
        "description": summary(method),
        "properties": options,
        "additionalProperties": False,
    }
