"""Table [solver] of the problem file: the method, the loss, and a table of options for each
method.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import BeforeValidator, Field, create_model, model_validator
from pydantic_core.core_schema import no_info_plain_validator_function

from ..errors import InputError
from ..methods import METHODS, method_options_schema
from ..methods.comparison.casadi_nlp import refusal_reason
from ..methods.method_options import method_from_options
from ..methods.solution import Method
from ..schema_tables import Among, Section
from ..validated_types import Positive

OPTIONS = {method: [field.name for field in fields(kind)] for method, kind in METHODS.items()}
DEFAULT = "reduced-space"


def _require_offered(name: Any) -> Any:
    """Return the name of a method; raise `ValueError` with the reason if CasADi's solver is
    not offered.
    """
    reason = refusal_reason(name) if isinstance(name, str) else None
    if reason is not None:
        raise ValueError(reason)
    return name


MethodName = Annotated[str, Among(tuple(METHODS)), BeforeValidator(_require_offered)]


class MethodSection(Section):
    """The method, the loss, and a table of options for each method.

    Attributes
    ----------
    huber : float, optional
        Threshold in standard deviations beyond which residuals count linearly, not squared (Huber's
        loss).
    """

    method: MethodName = DEFAULT
    huber: Positive | None = None

    @model_validator(mode="before")
    @classmethod
    def _require_option_tables(cls, table: Any) -> Any:
        """Raise `ValueError` if options of a method are outside the method's table."""
        outside = (
            [name for name in table if _methods_with(name)] if isinstance(table, Mapping) else []
        )
        if outside:
            remedy = f"move {_advice_on_tables(outside, table.get('method', DEFAULT))}"
            raise ValueError(f"the options of a method have a table of their own: {remedy}")
        return table

    @property
    def methods(self) -> dict[str, Method]:
        """Methods by name, with the options of their tables."""
        return {name: getattr(self, name) for name in METHODS}


def _method_from_table(method: str, table: Any) -> Any:
    """Return the method called `method` with the options of its table, defaults elsewhere.

    Raises
    ------
    InputError
        If `table` is not a mapping, for options that the method does not have, or invalid values.
    """
    where = f"solver.{method}"
    if not isinstance(table, Mapping):
        raise InputError(f"found {table!r}; expected a table of options", None, where)
    for name in table:
        owners = _methods_with(name)
        if owners and method not in owners:
            owned = f"{name} is an option of {', '.join(owners)}"
            has = f"{method} has {', '.join(OPTIONS[method])}"
            raise InputError(f"{owned}; {has}", None, where)
    return method_from_options(METHODS[method], table, where)


def _methods_with(option: str) -> list[str]:
    """Return the names of the methods that have an option."""
    return [method for method in METHODS if option in OPTIONS[method]]


def _advice_on_tables(options: Sequence[str], chosen: Any) -> str:
    """Return text that says to which method's table each of the options belongs, preferably that of
    `chosen`, the method that the file names.
    """
    options_by_method: dict[str, list[str]] = {}
    for option in options:
        owners = _methods_with(option)
        options_by_method.setdefault(chosen if chosen in owners else owners[0], []).append(option)
    return " and ".join(
        f"{', '.join(names)} to {table_heading(to)}" for to, names in options_by_method.items()
    )


def table_heading(method: str) -> str:
    """Return the heading of a method's table in the file."""
    return f'[solver."{method}"]' if ":" in method else f"[solver.{method}]"


@dataclass(frozen=True)
class _MethodType:
    """Pydantic type of a method's key."""

    method: str

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        return no_info_plain_validator_function(partial(_method_from_table, self.method))

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> dict[str, Any]:
        return method_options_schema(self.method)


def _method_field(method: str) -> tuple[Any, Any]:
    """Return type and default of a method's key."""
    return Annotated[Any, _MethodType(method)], Field(
        default_factory=partial(_method_from_table, method, {})
    )


if TYPE_CHECKING:
    SolverSection = MethodSection
else:
    SolverSection = create_model(
        "SolverSection",
        __base__=MethodSection,
        __doc__=MethodSection.__doc__,
        **{method: _method_field(method) for method in METHODS},
    )
