"""Commands that tell what there is, and begin a problem."""

from __future__ import annotations

import json
import shlex
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from ..console import PlainConsole
from ..display import on_terminal
from .common import AsJson, errors, examples

commands = typer.Typer()


class Kind(StrEnum):
    """What a new problem is of."""

    COMPRESSION = "compression"
    TENSION = "tension"
    SWING = "swing"


@commands.command(epilog=examples("methods", "methods interior-point"))
def methods(
    name: Annotated[str | None, typer.Argument(help="Tell this method's options.")] = None,
    as_json: AsJson = False,
) -> None:
    """List the methods, or the options of one: defaults, values, and what they do."""
    from ..method_tables import methods_table, options_table
    from ..methods import METHODS
    from ..methods.described import options_schema, require_method, summary

    if name is not None:
        require_method(name, "NAME")
    if as_json:
        listed = options_schema(name) if name else {each: summary(each) for each in METHODS}
        typer.echo(json.dumps(listed, indent=1, ensure_ascii=False))
    else:
        parts = options_table(name) if name else methods_table()
        PlainConsole().print(on_terminal(parts))


@commands.command()
def schema() -> None:
    """Print the JSON schema of the problem file."""
    from ..problem.schema import ProblemFile

    typer.echo(json.dumps(ProblemFile.model_json_schema(), indent=1))


@commands.command(
    epilog=examples(
        "new my_object", "new silicone --kind compression", "check silicone/problem.toml"
    )
)
def new(
    name: Annotated[str, typer.Argument(help="Name of the new folder.")],
    kind: Annotated[
        Kind | None,
        typer.Option(help="With a simulated recording of this kind, so that it runs as it is."),
    ] = None,
) -> None:
    """Write a commented problem file to start from."""
    from ..beginning import begin
    from ..problem.template import write_template

    file, *data = [write_template(Path(name))] if kind is None else begin(Path(name), kind.value)
    typer.echo(file)
    for each in data:
        typer.echo(each)
    yours = "put your mesh, poses and marker tracks beside it and name them in it"
    example = "it runs as it is, on data simulated here; then put your own in their place"
    errors.print(f"Next: {yours if kind is None else example}.", soft_wrap=True)
    for command in ("check", "solve"):
        errors.print(f"  collocation-sysid {command} {shlex.quote(str(file))}", soft_wrap=True)
