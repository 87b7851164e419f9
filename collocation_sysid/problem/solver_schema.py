"""Table [solver] of the problem file: the method, the loss, and a table of options for each
method.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, model_validator
from pydantic_core.core_schema import no_info_plain_validator_function

from ..common.schema_tables import Among, Section
from ..common.validated_types import Positive
from ..errors import InputError
from ..methods import METHODS, method_options_schema, method_summary
from ..methods.comparison.casadi_nlp import PREFIX, Sleqp, SqpMethod, refusal_reason
from ..methods.comparison.penalty import AugmentedLagrangian, Penalty
from ..methods.comparison.shooting import Shooting
from ..methods.interior_point import InteriorPoint
from ..methods.options import MethodOptions, method_from_options
from ..methods.reduced_space import ReducedSpace
from ..methods.solution import Method

OPTIONS = {method: [field.name for field in fields(kind)] for method, kind in METHODS.items()}
DEFAULT = "reduced-space"


def _require_offered(name: Any) -> Any:
    """An unknown name is returned, too; a solver of CasADi that cannot be used is refused."""
    is_plugin = isinstance(name, str) and name.startswith(PREFIX)
    if is_plugin and (reason := refusal_reason(name)) is not None:
        raise ValueError(reason)
    return name


MethodName = Annotated[str, Among(tuple(METHODS)), BeforeValidator(_require_offered)]


@dataclass(frozen=True)
class OptionTable:
    """Annotation of a key whose value is the table of a method's options."""

    kind: type[MethodOptions]  # class of the method

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        """Return the schema by which pydantic converts the table of options to the method, see
        `_method_from_table`; the arguments are not used.
        """
        return no_info_plain_validator_function(partial(_method_from_table, self.kind.name))

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> dict[str, Any]:
        """Return the JSON schema of the method's options for editors; the arguments are
        not used.
        """
        return method_options_schema(self.kind.name)


def _method_key(kind: type[MethodOptions]) -> Any:
    return Field(None, alias=kind.name, description=method_summary(kind.name))


class SolverSection(Section):
    """The method, the loss, and a table of options for each method.

    Attributes
    ----------
    method : str
        Name of the method that solves the nonlinear program.
    huber : float, optional
        Threshold in standard deviations beyond which residuals count linearly, not squared (Huber's
        loss).
    """

    method: MethodName = DEFAULT
    huber: Positive | None = None
    interior_point: Annotated[InteriorPoint | None, OptionTable(InteriorPoint)] = _method_key(
        InteriorPoint
    )
    reduced_space: Annotated[ReducedSpace | None, OptionTable(ReducedSpace)] = _method_key(
        ReducedSpace
    )
    penalty: Annotated[Penalty | None, OptionTable(Penalty)] = _method_key(Penalty)
    augmented_lagrangian: Annotated[
        AugmentedLagrangian | None, OptionTable(AugmentedLagrangian)
    ] = _method_key(AugmentedLagrangian)
    shooting: Annotated[Shooting | None, OptionTable(Shooting)] = _method_key(Shooting)
    casadi_sqpmethod: Annotated[SqpMethod | None, OptionTable(SqpMethod)] = _method_key(SqpMethod)
    casadi_sleqp: Annotated[Sleqp | None, OptionTable(Sleqp)] = _method_key(Sleqp)

    @model_validator(mode="before")
    @classmethod
    def _require_option_tables(cls, table: Any) -> Any:
        """Options of a method outside the method's table are refused."""
        outside = (
            [name for name in table if _methods_with(name)] if isinstance(table, Mapping) else []
        )
        if outside:
            remedy = f"move {_advice_on_tables(outside, table.get('method', DEFAULT))}"
            raise ValueError(f"the options of a method have a table of their own: {remedy}")
        return table

    @property
    def methods(self) -> dict[str, Method]:
        """Methods with a table, by their names in the file."""
        tables = {
            field.alias: getattr(self, name)
            for name, field in type(self).model_fields.items()
            if field.alias is not None
        }
        return {name: method for name, method in tables.items() if method is not None}


def _method_from_table(method: str, table: Any) -> Any:
    where = f"solver.{method}"
    if not isinstance(table, Mapping):
        raise InputError(f"found {table!r}; expected a table of options", None, where=where)
    for name in table:
        owners = _methods_with(name)
        if owners and method not in owners:
            owned = f"found {name}, which is an option of {', '.join(owners)}"
            has = f"expected options of {method}: {', '.join(OPTIONS[method])}"
            raise InputError(f"{owned}; {has}", None, where=where)
    return method_from_options(METHODS[method], table, key=where)


def _methods_with(option: str) -> list[str]:
    return [method for method in METHODS if option in OPTIONS[method]]


def _advice_on_tables(options: Sequence[str], chosen: Any) -> str:
    """Say to which method's table each option belongs, that of `chosen` first."""
    options_by_method: dict[str, list[str]] = {}
    for option in options:
        owners = _methods_with(option)
        options_by_method.setdefault(chosen if chosen in owners else owners[0], []).append(option)
    return " and ".join(
        f"{', '.join(names)} to {table_heading(to)}" for to, names in options_by_method.items()
    )


def table_heading(method: str) -> str:
    """Return the heading of a method's table in the file, with quotes around a name with a
    colon.
    """
    return f'[solver."{method}"]' if ":" in method else f"[solver.{method}]"
