"""Types with ranges for user input.

Values are checked by pydantic without conversion: TOML distinguishes text, numbers and truth
values, so that "30" or true in place of a number is a mistake.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import pairwise
from typing import Annotated, Any

import numpy as np
from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    ValidatorFunctionWrapHandler,
    WrapValidator,
)

from ..errors import hint_at

# Smallest magnitude of meaningful input; its square is still a nonzero floating-point number.
SMALLEST = 1e-100
# Largest magnitude of meaningful input; its square is still finite.
LARGEST = 1e100


def _of_usual_size(value: float) -> float:
    """Return the value if it is zero or its magnitude lies between `SMALLEST` and `LARGEST`."""
    if value and not SMALLEST <= abs(value) <= LARGEST:
        sizes = f"zero, or a size from {SMALLEST:g} to {LARGEST:g}"
        raise ValueError(f"found {value:g}; expected {sizes}")
    return value


def _python_scalar(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value


def _no_nan(value: float) -> float:
    """Return an infinite value, or one that is zero or of usual size."""
    if math.isnan(value):
        raise ValueError("found nan; expected a number")
    return value if math.isinf(value) else _of_usual_size(value)


def _require_ascending(shares: tuple[float, ...]) -> tuple[float, ...]:
    is_ascending = all(a < b for a, b in pairwise(shares))
    if not is_ascending or shares[-1:] != (1.0,):
        raise ValueError(f"found {list(shares)}; expected numbers above 0 that ascend to 1")
    return shares


def _number_unless_array(value: Any, validated: ValidatorFunctionWrapHandler) -> Any:
    with suppress(ValueError):  # for rows of different lengths
        if np.ndim(value):
            return value
    return validated(value)


def _require_file_name(name: str) -> str:
    r"""Return a name unchanged if it can be part of a file name on every platform: printable, not
    empty, no leading dot, and none of / \ : * ? " < > |; raise `ValueError` otherwise.
    """
    if (
        not name.isprintable()
        or name[:1] in ("", ".")
        or any(mark in name for mark in '/\\:*?"<>|')
    ):
        raise ValueError(
            f"found {name!r}; expected a valid file name: not empty, no leading dot, none of / \\ "
            ': * ? " < > |'
        )
    return name


_Usual = AfterValidator(_of_usual_size)
_Scalar = BeforeValidator(_python_scalar)
Finite = Annotated[float, Field(strict=True, allow_inf_nan=False), _Usual, _Scalar]
Positive = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0), _Usual, _Scalar]
NotNegative = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0), _Usual, _Scalar]
# A number for all samples, or an array with one for each, whose values the class checks.
PositivePerSample = Annotated[Positive, WrapValidator(_number_unless_array)]
AboveOne = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=1), _Usual, _Scalar]
OneOrMore = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=1), _Usual, _Scalar]
Boundless = Annotated[float, Field(strict=True), _Scalar]
Number = Annotated[float, Field(strict=True), AfterValidator(_no_nan), _Scalar]
StrictInteger = Annotated[int, Field(strict=True), _Scalar]
Count = Annotated[int, Field(strict=True, ge=0), _Scalar]
AtLeastOne = Annotated[int, Field(strict=True, ge=1), _Scalar]
# More steps between two samples than any motion needs.
Substeps = Annotated[int, Field(strict=True, ge=1, le=1000), _Scalar]
Flag = Annotated[bool, Field(strict=True), _Scalar]
# Growing first parts of a whole.
Shares = Annotated[tuple[Positive, ...], AfterValidator(_require_ascending)]
Text = Annotated[str, Field(strict=True, min_length=1)]
FileName = Annotated[str, Field(strict=True), AfterValidator(_require_file_name)]

_EXPECTED = {
    "float_type": "a number",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "bool_type": "true or false, without quotes",
    "string_type": "text in quotes",
    "string_too_short": "a text that is not empty",
    "finite_number": "a finite number",
    "greater_than": "a number above {gt:g}",
    "greater_than_equal": "a number of at least {ge:g}",
    "less_than_equal": "a number of at most {le:g}",
    "is_instance_of": "a {class}",
    "callable_type": "a function",
    "dict_type": "a table",
    "mapping_type": "a table",
    "tuple_type": "a list",
}


def expected(fault: Mapping[str, Any]) -> str:
    """Return what was expected in place of an invalid value, for an error message ("expected …").

    Parameters
    ----------
    fault : mapping
        One entry of pydantic's `ValidationError.errors()`. Of the message of a ValueError raised by
        a validator, the part after "expected " is returned ("" if there is none).
    """
    if fault["type"] == "value_error":
        return str(fault["ctx"]["error"]).partition("expected ")[2]
    if fault["type"] in _EXPECTED:
        return _EXPECTED[fault["type"]].format(**fault.get("ctx", {}))
    message = fault["msg"].partition("Input should be ")[2] or fault["msg"]
    # As in problem files.
    return message.replace("False", "false").replace("True", "true")


def expectation(faults: Sequence[Mapping[str, Any]], found: Any) -> str:
    """Return the end of the message about a value that was `found`: "expected …", with a word that
    it resembles.

    Parameters
    ----------
    faults : sequence of mapping
        Entries of pydantic's `ValidationError.errors()`, one for each form that is accepted.
    """
    literals = (fault["ctx"]["expected"] for fault in faults if fault["type"] == "literal_error")
    words = [word for text in literals for word in re.findall("'(.*?)'", text)]
    forms = " or ".join(dict.fromkeys(expected(fault) for fault in faults))
    return f"expected {forms}{hint_at(str(found), words)}"
