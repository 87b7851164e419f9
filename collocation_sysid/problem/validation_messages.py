"""Messages for validation errors of pydantic: key, what was found, and what was expected."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from inspect import Parameter, Signature, get_annotations
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_origin

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from ..common.schema_tables import Section
from ..common.validated_types import expectation
from ..errors import InputError, excerpt, hint_at
from .recording_schema import ExperimentSection, registered_tables
from .schema import SPECIMEN_TAG, ProblemFile, with_experiment_defaults
from .specimen_schema import SpecimenSection

Part = str | int
Fault = Mapping[str, Any]


def explain_validation_error(
    error: ValidationError,
    content: dict[str, Any],
    path: Path | None,
    root: type[BaseModel] = ProblemFile,
) -> InputError:
    """Return (not raise) an `InputError` for one fault, with the number of other places with
    faults.

    It is the first unknown key, or else the first fault.

    Parameters
    ----------
    content : dict
        Content that was validated, without [experiment_defaults] inserted.
    path : Path or None
        File, for the message.
    root : type
        Model that the content was validated as.
    """
    faults = error.errors(include_url=False)
    # An unknown key explains the others around it.
    fault = next((f for f in faults if f["type"] == "extra_forbidden"), faults[0])
    message = _fault_message(fault, with_experiment_defaults(content), root=root)
    where = _fault_location(fault, content, root=root)
    others = {_fault_location(other, content, root=root) for other in faults} - {where}
    if others:
        message += f" (and {len(others)} more mistake{'s' if len(others) > 1 else ''})"
    return InputError(message, path, where=where or None)


class _StatedClass(type(BaseModel)):
    """Metaclass of tables of which a user sees the keys, not the interface of pydantic."""

    @property
    def __signature__(cls: Any) -> Signature:
        annotations = get_annotations(cls)
        parameters = [
            Parameter(
                name,
                Parameter.KEYWORD_ONLY,
                default=Parameter.empty
                if field.is_required()
                else field.get_default(call_default_factory=True),
                annotation=annotations.get(name, Parameter.empty),
            )
            for name, field in cls.model_fields.items()
        ]
        return Signature(parameters)

    @__signature__.setter
    def __signature__(cls, value: object) -> None:
        """The signature of pydantic is not used."""

    def __dir__(cls) -> list[str]:
        own = {name for name in super().__dir__() if not name.startswith("_")}
        return sorted(own - set(dir(BaseModel)) - {"of", "model_config"} | set(dir(object)))


class StatedSection(Section, metaclass=_StatedClass):
    """Section that is also stated in Python, by keyword arguments."""

    if not TYPE_CHECKING:  # which then know the keys

        def __init__(self, **stated: Any) -> None:
            try:
                super().__init__(**stated)
            except ValidationError as error:
                raise explain_validation_error(error, stated, None, root=type(self)) from error

    def __dir__(self) -> list[str]:
        return sorted({*dir(type(self)), *type(self).model_fields})


# Tags of the alternatives of a union in the location of a fault.
_TAGS = re.compile(r"<|(function-\w+|literal)\[|constrained-\w+$|(float|int|str|bool)$")


def _fault_key(fault: Fault, root: type[BaseModel]) -> list[Part]:
    """Tags of unions are left out, and final indices of numbers in an array."""
    loc = fault["loc"]
    own = len(loc) - 1 if fault["type"] == "extra_forbidden" else len(loc)  # that is the file's
    parts = [p for k, p in enumerate(loc) if k >= own or not _TAGS.match(str(p))]
    field, part_count = _schema_field(parts, root)
    if field is not None and _table_model(field.annotation) is None:
        while len(parts) > part_count and isinstance(parts[-1], int):
            parts.pop()
    return parts


def _fault_message(fault: Fault, content: dict[str, Any], root: type[BaseModel]) -> str:
    key = _fault_key(fault, root)
    field, _ = _schema_field(key, root)
    description = (field.description if field else None) or ""
    expected = description[:1].lower() + description[1:].rstrip(".").split(";")[0]
    kind = fault["type"]
    model = _table_model(field.annotation) if field else None
    if kind == "extra_forbidden":
        table, _ = _schema_field(key[:-1], root)
        inside = _table_model(table.annotation) if table else None
        if SPECIMEN_TAG in fault["loc"] and inside is not None and len(key) == 3:
            inside = SpecimenSection
        outer, _ = _schema_field(key[:-2], root)
        around = _table_model(outer.annotation) if outer else None
        if around is not None and key[-1] in _fields_by_key(around):
            names = [str(part) for part in key[:-1] if isinstance(part, str)]
            return f"unknown key; it belongs to {names[-2]}, above the table {names[-1]}"
        known = list(_fields_by_key(inside or root))
        hint = hint_at(str(key[-1]), known)
        return f"unknown key{hint or '; expected one of ' + ', '.join(known)}"
    if kind == "value_error":
        error = fault["ctx"]["error"]
        return error.message if isinstance(error, InputError) else str(error)
    in_array = key[-1:] != list(fault["loc"][-1:]) and isinstance(fault["loc"][-1], int)
    if kind == "missing" and not in_array:
        return f"missing; expected {expected or ('a value' if model is None else 'a table')}"
    finding = f"found {shortened(_value_at(key, content) if in_array else fault['input'])}"
    if expected and (in_array or kind in ("tuple_type", "list_type", "too_long", "too_short")):
        return f"{finding}; expected {expected}"
    if kind in ("model_type", "model_attributes_type") and model is not None:
        return (
            f"{finding}; expected a table with some of the keys {', '.join(_fields_by_key(model))}"
        )
    return f"{finding}; {expectation([fault], fault['input'])}"


def _fault_location(fault: Fault, content: dict[str, Any], root: type[BaseModel]) -> str:
    """The value of an `InputError` that a validator raised contains the location."""
    error = (fault.get("ctx") or {}).get("error")
    known = error.where if isinstance(error, InputError) else None
    return known or _written_key(_fault_key(fault, root), content)


def _written_key(key: Sequence[Part], content: dict[str, Any]) -> str:
    """A value from [experiment_defaults] is located there."""
    value: Any = content
    defaults = _item(content, "experiment_defaults")
    if key[:1] == ["experiment"] and len(key) > 2:
        own = _value_at(key[:2], content)
        if isinstance(own, dict) and key[2] not in own and _item(defaults, key[2]) is not None:
            key = ["experiment_defaults", *key[2:]]
    written: list[str] = []
    experiment = ""
    for part in key:
        value = _item(value, part)
        written.append(str(part))
        name = _item(value, "name")
        if len(written) == 2 and written[0] == "experiment" and name and isinstance(name, str):
            experiment = f"experiment {name!r}"
            written = []
    return ": ".join(text for text in (experiment, ".".join(written)) if text)


def _value_at(key: Sequence[Part], content: dict[str, Any]) -> Any:
    """Return the value of a key in the content; None if it does not exist."""
    value: Any = content
    for part in key:
        value = _item(value, part)
    return value


def _item(container: Any, part: Part) -> Any:
    try:
        return container[part]
    except (KeyError, IndexError, TypeError):
        return None


# The schema -----------------------------------------------------------------------------------


def _schema_field(key: Sequence[Part], root: type[BaseModel]) -> tuple[FieldInfo | None, int]:
    """Return the deepest field on the path and the number of parts to it; None and 0 without."""
    model: type[BaseModel] | None = root
    field = None
    part_count = 0
    named = False
    for count, part in enumerate(key, start=1):
        if isinstance(part, int):
            continue
        if field is not None and get_origin(field.annotation) is dict and not named:
            named = True  # a name of the user's, such as a parameter's
            continue
        if field is not None and model is not None and part not in _fields_by_key(model):
            others = table_models(field.annotation)
            model = next((each for each in others if part in _fields_by_key(each)), None)
        if model is None or part not in _fields_by_key(model):
            break
        field = _fields_by_key(model)[part]
        part_count = count
        named = False
        model = _table_model(field.annotation)
    return field, part_count


def _fields_by_key(model: type[BaseModel]) -> dict[str, FieldInfo]:
    fields = {field.alias or name: field for name, field in model.model_fields.items()}
    return fields | registered_tables().model_fields if model is ExperimentSection else fields


def _table_model(annotation: Any) -> type[BaseModel] | None:
    """Return the first model of a field that is a table or a list of tables, or None."""
    return next(iter(table_models(annotation)), None)


def table_models(annotation: Any) -> list[type[BaseModel]]:
    """Return the models in an annotation, from the first to the last: of a field that is a table or
    a list of tables; several if tables differ by kind, none for other fields.
    """
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    arguments = getattr(annotation, "__args__", ())
    return [model for argument in arguments for model in table_models(argument)]


def shortened(value: Any) -> str:
    """Return a value as text of at most 60 characters, booleans as in TOML, others as `repr` shows
    them; "a TYPE too large to show" if Python cannot print it.
    """
    if isinstance(value, bool):
        return str(value).lower()
    try:
        return excerpt(repr(value))
    except (ValueError, RecursionError):  # beyond Python's limits of digits and of nesting
        return f"a {type(value).__name__} too large to show"
