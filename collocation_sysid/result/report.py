"""Reports as self-contained HTML pages or Markdown, and reports of studies.

The content of a report is a `TitledParts`: `comparison_report` makes one from a study's folder,
`run_sections.run_report` one from a run folder.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from ..common.display import (
    Items,
    Line,
    Picture,
    Table,
    TitledParts,
    as_html,
    as_markdown,
    escape,
    own_pictures,
)
from ..common.files import damage_refused, read_json
from ..common.serialisation import read

SUMMARY_FILE = "summary.json"
CAPTIONS = {
    "convergence": "Loss and violation of the equations of motion over the time of the solve, "
    "one line per run.",
    "success": "Success rate over the error of the worst initial guess.",
    "basins": "Initial guesses: pairs of guesses relative to the true values, or to the best "
    "estimate.",
    "models": "Prediction error of each model with its standard error, and estimates with their "
    "combined 95 % intervals; red: the chosen model.",
    "tip": "Motion of the tip: measured, and simulated with the best estimate of each method.",
    "sweep": "Estimates with their 95 % intervals over the values of the swept key; crosses: not "
    "converged.",
}


@dataclass(frozen=True)
class StudySummary:
    """Content of ``summary.json`` that the report of a study needs."""

    title: str
    problem: str
    headline: tuple[str, ...]  # sentences with the main results
    runs: tuple[Mapping[str, Any], ...]  # one record for each finished run
    notes: tuple[str, ...]  # sentences that explain the tables
    tables: tuple[Table, ...]  # tables of the results
    failures: tuple[str, ...]  # one sentence for each run that ended without a result


def comparison_report(folder: str | Path) -> TitledParts:
    """Return the report of the folder of a study, which compare-methods, compare-models or sweep
    wrote: headline, notes, tables, runs without a result, and all PNG pictures in the folder,
    except links that lead out of it.

    Parameters
    ----------
    folder : str or Path
        Folder of the study; nothing is written to it.

    Raises
    ------
    InputError
        If the folder has no ``summary.json``, or a damaged one.
    """
    folder = Path(folder)
    content = read_json(
        folder / SUMMARY_FILE, "a folder of compare-methods, compare-models or sweep"
    )
    with damage_refused(folder, SUMMARY_FILE, remedy="repeat the study; finished runs are kept"):
        study = read(StudySummary, content)
        pictures = [Picture(f, CAPTIONS.get(f.stem, f.stem)) for f in own_pictures(folder)]
        ended = {"Runs without a result": [Items(study.failures)] if study.failures else []}
        titled = {**ended, "Pictures": pictures}
        return TitledParts(
            study.title,
            (
                Line(f"{len(study.runs)} runs of {study.problem}", "quiet"),
                TitledParts("", study.headline, style="verdict good"),
                *(Line(note, "quiet") for note in study.notes),
                *study.tables,
                *(TitledParts(title, tuple(each)) for title, each in titled.items() if each),
            ),
            level=1,
        )


def report_text(report: TitledParts, file: Path) -> str:
    """Return the text of a report for a file: Markdown if its name ends in ``.md``, else HTML."""
    return as_markdown([report]) if file.suffix == ".md" else report_html(report)


def report_html(report: TitledParts) -> str:
    """Return a report as the HTML text of one page that contains its pictures.

    Nothing is loaded from a network; pictures are embedded.
    """
    page = files("collocation_sysid.result").joinpath("report.html").read_text("utf-8")
    # A text cannot hold these places, since "<" is escaped.
    page = page.replace("<!--TITLE-->", escape(report.title))
    return page.replace("<!--BODY-->", as_html(report))
