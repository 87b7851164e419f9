"""What the commands share: their options, exit codes, and how they speak."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import typer

from ..console import PlainConsole
from ..display import Shown, on_terminal

errors = PlainConsole(stderr=True)

ProblemPath = Annotated[Path, typer.Argument(metavar="PROBLEM.toml", help="The problem file.")]
Overrides = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="KEY=VALUE", help="Override a key, such as parameters.mu_pa.guess=200."
    ),
]
Out = Annotated[Path | None, typer.Option("--out", metavar="DIR", help="Where to write.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress.")]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="A line per iteration.")]
Workers = Annotated[
    int | None, typer.Option(help="Runs at once; as many as there are cores by default.")
]
Scheduler = Annotated[
    str | None, typer.Option(metavar="ADDRESS", help="A dask.distributed scheduler to run on.")
]
TimeLimit = Annotated[
    float | None,
    typer.Option(metavar="SECONDS", help="A run is ended after this; it counts as a failure."),
]
RunFolder = Annotated[Path, typer.Argument(metavar="RUN", help="A run folder.")]
OneExperiment = Annotated[
    str | None, typer.Option(metavar="NAME", help="Experiment; by default the first.")
]
AllowCode = Annotated[
    bool, typer.Option("--allow-code", help="Run Python files that the problem names.")
]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Only list the runs.")]

EXIT_NOT_CONVERGED, EXIT_BAD_INPUT, EXIT_INTERRUPTED = 1, 2, 130
EXIT_DOUBTFUL = EXIT_NOT_CONVERGED


def examples(*commands: str) -> str:
    """Lines below a command's help, kept as they are."""
    lines = "".join(f"\n  collocation-sysid {command}" for command in commands)
    return f"\b\nExamples:{lines}"


def show(content: Shown | Iterable[Shown]) -> None:
    """Print on stdout: on a terminal wrapped between words, in files with lines kept whole."""
    console = PlainConsole()
    console.print(on_terminal(content), soft_wrap=not console.is_terminal)
