"""The page about a comparison of methods or a sweep, made from its folder alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ...files import damage_refused, read_json
from .page import own_pictures, picture, rendered

SUMMARY_FILE = "summary.json"
CAPTIONS = {
    "convergence": "Loss and violated dynamics over the time of the solve, a line for each run.",
    "success": "Share of successes against how far the worst guess of a start is off.",
    "basins": "The starts: pairs of guesses over the truth, or over the best answer.",
    "tip": "The tip as measured, and simulated with the best answer of each method.",
    "sweep": "Estimates with their 95 % intervals against what is swept; crosses did not converge.",
}


def comparison_page(folder: str | Path) -> str:
    """The page of a study's folder.

    Raises
    ------
    InputError
        If it is not such a folder, or damaged.
    """
    folder = Path(folder)
    summary = read_json(folder / SUMMARY_FILE, "a folder of compare or sweep")
    with damage_refused(folder, SUMMARY_FILE, "repeat the study, finished runs are kept"):
        return rendered(
            "comparison.html",
            summary=summary,
            runs=len(summary["runs"]),
            tables=[_checked(table) for table in summary["tables"]],
            pictures=[
                picture(file, CAPTIONS.get(file.stem, file.stem)) for file in own_pictures(folder)
            ],
        )


def _checked(table: dict[str, Any]) -> dict[str, Any]:
    """A table whose rows are texts and as wide as its heads."""
    rows = [[str(cell) for cell in row] for row in table["rows"]]
    if any(len(row) != len(table["heads"]) for row in rows):
        raise ValueError(f"the table {table['title']!r} has rows of another length")
    return {**table, "rows": rows, "names": int(table["names"])}
