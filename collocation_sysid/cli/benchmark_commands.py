"""Command that compares simulators with measured bodies: benchmark."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..common.display import Table
from ..errors import InputError
from .command_options import OutputOptions, command, option
from .common import error_console, shown_progress

if TYPE_CHECKING:
    from ..extras.benchmark import Score

commands = typer.Typer()

# Factor and name of a readable unit for each SI unit of a score.
READABLE_UNITS = {"m": (1e3, "mm"), "N": (1.0, "N"), "Pa": (1e-3, "kPa")}


@command(
    commands,
    "benchmark",
    "benchmark bodies --write",
    "benchmark bodies --write --body isoprene_rubber",
    "benchmark bodies",
)
def benchmark(
    *,
    folder: Annotated[
        Path | None,
        typer.Argument(
            metavar="FOLDER", help="Benchmark folder; without it, the bodies are listed."
        ),
    ] = None,
    write: Annotated[
        bool, option("Write the bodies into the folder, instead of scoring the predictions in it.")
    ] = False,
    body: Annotated[
        str | None,
        option(
            "Only this body; by default all bodies in the folder are scored, or all bodies whose "
            "data are on this computer are written.",
            "NAME",
        ),
    ] = None,
    output: OutputOptions,
) -> None:
    """List, write or score the bodies of a benchmark of simulators.

    Without FOLDER, the bodies are listed. With --write, the folder gets the mesh, the prescribed
    motion, the constants with combined intervals and the measurements of each body, for users of
    any simulator. Without --write, the predictions that were added to the folder are compared with
    the measurements, beside the simulation of this package and the undeformed body.

    The README.md in the folder states the task, the metric and the format of the predictions.

    The exit code is 0, and 2 if the folder is no benchmark or a prediction is missing or invalid.
    """
    from ..extras.benchmark import score_benchmark

    if folder is None:
        _list_bodies(output, "--write" if write else "--body" if body else None)
    elif write:
        _write_bodies(folder, body, output)
    else:
        with shown_progress("computing the scores", quiet=output.quiet):
            scores = score_benchmark(folder, body)
        tables = [*score_tables(scores), *score_warnings(scores)]
        output.print_result([asdict(each) for each in scores], tables)


def _list_bodies(output: OutputOptions, where: str | None) -> None:
    """Print the bodies; refuse the option `where`, which needs a folder."""
    from ..extras.benchmark import BODIES

    if where is not None:
        raise InputError(
            f"this option needs a folder; expected benchmark FOLDER {where}", None, where=where
        )
    listed: list[dict[str, Any]] = []
    for body in BODIES.values():
        entry = body.catalogue_entry()
        listed.append(
            {
                "body": body.name,
                "specimen": entry["specimen"],
                "is_measured": entry["is_measured"],
                "recordings": body.recordings,
                "is_held_out": body.are_held_out,
                "is_available": body.find_data_folder() is not None,
                "script": body.script,
                "licence": entry["licence"],
            }
        )
    rows = tuple(
        (
            each["body"],
            "measured" if each["is_measured"] else "simulated",
            "held out" if each["is_held_out"] else "fitted",
            "yes" if each["is_available"] else f"scripts {each['script']}",
            each["licence"],
            each["specimen"],
        )
        for each in listed
    )
    heads = ("body", "data", "recording", "available", "licence", "specimen")
    output.print_result(listed, Table("", heads, rows=rows, names=5, texts=1))


def _write_bodies(folder: Path, body: str | None, output: OutputOptions) -> None:
    """Write the benchmark folder, and print its path.

    Bodies that were left out because their data are not on this computer are named on stderr. With
    the option --json, path and names of the bodies written and left out are printed as JSON
    instead.
    """
    from ..extras.benchmark import BODIES, write_benchmark
    from ..extras.benchmark.bodies import chosen_bodies

    chosen = chosen_bodies(body)
    with shown_progress("simulating the bodies", quiet=output.quiet) as progress:
        write_benchmark(chosen, folder, progress=progress.share)
    left_out = [each for each in BODIES.values() if body is None and each not in chosen]
    for each in () if output.as_json else left_out:
        error_console.print(
            f"{each.name} is left out: its data are not on this computer; python scripts {each.script} "
            "fetches them",
            soft_wrap=True,
        )
    report = {
        "folder": str(folder),
        "bodies": [each.name for each in chosen],
        "left_out": [each.name for each in left_out],
    }
    output.print_result(report, str(folder))


def score_tables(scores: Sequence[Score]) -> list[Table]:
    """Return a table of the scores for each recording, in readable units."""
    tables = []
    titles = dict.fromkeys((each.body, each.recording) for each in scores)
    for title in titles:
        own = [each for each in scores if (each.body, each.recording) == title]
        factor, unit = READABLE_UNITS[own[0].unit]
        role = "held out" if own[0].is_held_out else "fitted"
        rows = tuple(
            (
                each.source,
                f"{factor * each.rms:.4g}",
                f"{factor * each.largest:.4g}",
                f"{100 * each.deflection_share:.3g}",
                f"{each.sigmas:.3g}",
                ""
                if each.rms_without_offsets is None
                else f"{factor * each.rms_without_offsets:.4g}",
            )
            for each in own
        )
        heads = (
            "",
            f"RMS {unit}",
            f"largest {unit}",
            "% of deflection" if own[0].unit == "m" else "% of largest load",
            "of noise",
            "without offsets",
        )
        if own[0].rms_without_offsets is None:
            heads = heads[:-1]
            rows = tuple(row[:-1] for row in rows)
        tables.append(Table(f"{title[0]}, {title[1]} ({role})", heads, rows=rows))
    return tables


def score_warnings(scores: Sequence[Score]) -> list[str]:
    """Return a warning for each prediction that is worse than the undeformed body.

    `scores` must contain the score of the undeformed body for every body and recording of a
    prediction; a missing one is a KeyError.
    """
    from ..extras.benchmark.scores import PREDICTION, UNDEFORMED

    trivial = {
        (each.body, each.recording): each.rms for each in scores if each.source == UNDEFORMED
    }
    return [
        f"warning: the prediction of {each.body}, {each.recording}, is worse than the undeformed "
        "body; check units (m, N, Pa), frame, signs and the order of the columns"
        for each in scores
        if each.source == PREDICTION and each.rms > trivial[each.body, each.recording]
    ]
