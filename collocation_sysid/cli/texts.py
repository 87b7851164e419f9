"""Commands that tell what there is, and begin a problem."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from .common import AsJson, examples

commands = typer.Typer()


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
        Console(highlight=False).print(options_table(name) if name else methods_table())


@commands.command()
def schema() -> None:
    """Print the JSON schema of the problem file."""
    from ..problem.schema import ProblemFile

    typer.echo(json.dumps(ProblemFile.model_json_schema(), indent=1))


@commands.command(epilog=examples("new my_object", "check my_object/problem.toml"))
def new(name: Annotated[str, typer.Argument(help="Name of the new folder.")]) -> None:
    """Write a commented problem file to start from."""
    from ..problem.template import write_template

    typer.echo(write_template(Path(name)))
