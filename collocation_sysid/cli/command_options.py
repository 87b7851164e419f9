"""Commands made from functions; an option is declared once, as a parameter.

A parameter that is annotated with `option` has its help and its placeholder there. A parameter whose
type is a dataclass stands for one option per field, whose help text is in the section "Attributes" of
the class, as for the options of a method. There, in place of the type, names of the option other
than the field's can be given, such as -v, and the placeholder that help shows for the value, such as
FILE.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Iterator, Mapping
from copy import copy
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import cache, reduce
from operator import or_
from pathlib import Path
from types import UnionType
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import typer
from typer.models import OptionInfo, ParameterInfo

from ..common.display import Shown
from ..common.field_descriptions import attributes
from ..common.files import require_run_folder
from ..common.serialisation import as_json
from ..common.validated_classes import validated
from ..errors import InputError
from .common import print_result, shown_progress

if TYPE_CHECKING:
    from ..problem import Problem  # which takes a second to import

T = TypeVar("T")

ProblemPath = Annotated[Path, typer.Argument(metavar="PROBLEM.toml", help="The problem file.")]
Overrides = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Override a key of the problem file, such as parameters.mu_pa.guess=200.",
    ),
]
AllowCode = Annotated[
    bool,
    typer.Option(
        "--allow-code", help="Allow the Python files named in the problem file to be executed."
    ),
]
OneExperiment = Annotated[
    str | None,
    typer.Option(
        "--experiment", metavar="NAME", help="Name of the experiment; by default the first one."
    ),
]
OneMethod = Annotated[
    str | None,
    typer.Option("--method", help="The method to use instead of that in the problem file."),
]
OutputFolder = Annotated[Path | None, typer.Option("--out", metavar="DIR", help="Output folder.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Do not show progress.")]


def option(help_text: str, placeholder: str | None = None) -> Any:
    """Return the annotation of an option with its help and the placeholder of its value."""
    return typer.Option(help=help_text, metavar=placeholder)


def command(group: typer.Typer, *examples: str) -> Callable[[Callable[..., None]], Any]:
    """Return a decorator that registers a function as a command, and returns the function unchanged.

    The command has the name and the docstring of the function, whose parameters are keyword-only. It
    calls the function with the options of the command line, validated against the annotations of the
    parameters. An option without help in its annotation or in the docstring of its dataclass is a
    KeyError of the decorator.

    Parameters
    ----------
    group : Typer
        Group of commands, to which the command is added.
    *examples : str
        Examples of arguments, shown below the help.
    """

    def registered(function: Callable[..., None]) -> Callable[..., None]:
        kind = _options_of(function)
        parameters = [*_typer_parameters(kind)]

        def called(**values: Any) -> None:
            function(**vars(_options_from_values(kind, values)))

        called.__name__ = function.__name__
        called.__doc__ = function.__doc__
        called.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        called.__annotations__ = {each.name: each.annotation for each in parameters}
        lines = "".join(f"\n  collocation-sysid {each}" for each in examples)
        group.command(epilog=f"\b\nExamples:{lines}")(called)  # kept as they are
        return function

    return registered


def _options_of(function: Callable[..., None]) -> type:
    hints = get_type_hints(function, include_extras=True)
    stated = inspect.signature(function).parameters
    defaults = {n: each.default for n, each in stated.items() if each.default is not each.empty}
    content = {"__annotations__": {name: hints[name] for name in stated}, **defaults}
    return validated(kw_only=True)(type(function.__name__, (), content))


def _typer_parameters(kind: type) -> Iterator[inspect.Parameter]:
    documented = attributes(kind)
    for name, default, hint, marks in _typed_fields(kind):
        if is_dataclass(hint):
            yield from _typer_parameters(hint)  # type: ignore[arg-type]
            continue
        infos = (copy(mark) for mark in marks if isinstance(mark, ParameterInfo))
        info = next(infos, None) or typer.Option()
        if info.help is None:
            written, info.help = documented[name]
            info.metavar = next(
                (w for w in written.split() if w[0].isupper() or w[0].isdigit()), None
            )
            if isinstance(info, OptionInfo):
                info.param_decls = _option_names(name, default, type_text=written)
        elif isinstance(info, OptionInfo) and info.default is ... and not info.param_decls:
            info.param_decls = _option_names(name, default)
        yield inspect.Parameter(
            name,
            inspect.Parameter.KEYWORD_ONLY,
            default=inspect.Parameter.empty if default is MISSING else default,
            annotation=Annotated[hint, info],
        )


def _option_names(field: str, default: Any, type_text: str = "") -> list[str]:
    """Use the long name in `type_text`, or else that of the field with hyphens."""
    option = field.strip("_").replace("_", "-")
    names = [word for word in type_text.split() if word.startswith("-")]
    if not any(word.startswith("--") for word in names):
        names.insert(0, f"--{option}" + (default is True) * f"/--no-{option}")
    return names


def _options_from_values(kind: type[T], values: Mapping[str, Any]) -> T:
    content = {
        name: _options_from_values(hint, values)  # type: ignore[arg-type]
        if is_dataclass(hint)
        else values[name]
        for name, _, hint, _ in _typed_fields(kind)
    }
    try:
        return kind(**content)
    except InputError as error:
        fields_ = {name: default for name, default, _, _ in _typed_fields(kind)}
        if error.where not in fields_:
            raise
        written = attributes(kind).get(error.where, ("", ""))[0]
        names = _option_names(error.where, fields_[error.where], type_text=written)
        raise InputError(error.message, None, where=names[0]) from error


@cache
def _typed_fields(kind: type) -> list[tuple[str, Any, Any, tuple[Any, ...]]]:
    """Return name, default, type and annotations, those of a class before its bases'."""
    hints = get_type_hints(kind, include_extras=True)
    defaults = {field.name: field.default for field in fields(kind)}  # type: ignore[arg-type]
    order = (name for base in kind.__mro__ for name in inspect.get_annotations(base))
    listed = []
    for name in dict.fromkeys(name for name in order if name in defaults):
        annotated = get_origin(hints[name]) is Annotated
        hint, *marks = get_args(hints[name]) if annotated else (hints[name],)
        if get_origin(hint) in (Union, UnionType):  # for instance a type or None
            kinds = (
                get_args(one)[0] if get_origin(one) is Annotated else one for one in get_args(hint)
            )
            hint = reduce(or_, kinds)
        listed.append((name, defaults[name], hint, tuple(marks)))
    return listed


@dataclass(frozen=True, kw_only=True)
class ProblemOptions:
    """Options that name a problem file and change its keys."""

    problem: ProblemPath
    set_: Overrides = None
    allow_code: AllowCode = False

    def read_problem(self, quiet: bool = False, simulation: bool = False) -> Problem:
        """Read the problem file with the changes of the command line, and return the problem.

        Progress and notes are shown on stderr unless `quiet`.

        Parameters
        ----------
        simulation : bool
            Whether measurements may be missing.

        Raises
        ------
        InputError
            If a file or a key is not usable.
        """
        from ..problem import Problem

        with shown_progress(f"reading {self.problem}", quiet=quiet) as progress:
            return Problem.read(
                self.problem,
                self.set_ or (),
                allow_code=self.allow_code,
                simulation=simulation,
                say=progress.line,
            )


@dataclass(frozen=True, kw_only=True)
class RunFolderOptions:
    """Options that name a run folder.

    Attributes
    ----------
    run_folder : RUN
        A run folder.
    """

    run_folder: Annotated[Path, typer.Argument()]

    def __post_init__(self) -> None:
        """Raise an `InputError` if the run folder is a file; if it is one in a run folder, the
        message names that folder.
        """
        require_run_folder(self.run_folder)


@validated(kw_only=True)
class OutputOptions:
    """Options for the form of the result and of the progress."""

    as_json: AsJson = False
    quiet: Quiet = False

    def print_result(self, answer: Any, content: Shown | Iterable[Shown]) -> None:
        """Print the result on stdout: `answer` as JSON if requested, or else its tables and lines
        `content`.
        """
        if self.as_json:
            typer.echo(as_json(answer))
        else:
            print_result(content)
