"""The page about a comparison of methods or a sweep, made from its folder alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ...files import damage_refused, read_json
from .page import number, picture, rendered

SUMMARY_FILE = "summary.json"
MODEL_COLUMNS = {
    "model": "model",
    "chosen": "to use",
    "free": "parameters",
    "status": "status",
    "rms_m": "markers RMS m",
    "delta_aic": "ΔAIC",
    "held_out_rms_m": "held out RMS m",
    "total_s": "time s",
}
# Columns that a person looks for first; the others are in runs.csv.
METHOD_COLUMNS = {
    "method": "method",
    "runs": "runs",
    "successes": "successes",
    "success_rate": "success rate",
    "success_low": "from",
    "success_high": "to",
    "rms_m": "markers RMS m",
    "violation_n": "violation N",
    "rollout_rms_m": "roll-out RMS m",
    "tip_max_m": "roll-out max m",
    "iterations": "iterations",
    "total_s": "time s",
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
        runs = summary["runs"]
        methods = summary.get("methods", [])
        swept = summary.get("swept", [])
        return rendered(
            "comparison.html",
            summary=summary,
            methods=_table(methods, METHOD_COLUMNS),
            runs=_table(
                runs,
                MODEL_COLUMNS
                if summary.get("kind") == "models"
                else {name: name for name in _run_columns(runs, swept)},
            ),
            pictures=[
                {"source": picture(file), "caption": file.stem.replace("_", " ")}
                for file in sorted(folder.glob("*.png"))
                if file.is_file()
            ],
        )


def _run_columns(runs: list[dict[str, Any]], swept: list[str]) -> list[str]:
    wanted = ["method", "start", *swept, "outcome", "status", "success", "rms_m", "iterations"]
    there = dict.fromkeys(name for row in runs for name in row)
    estimates = [name for name in there if name.startswith("error_") or name.endswith("_value")]
    return [name for name in [*wanted, *estimates, "total_s"] if name in there]


def _table(rows: list[dict[str, Any]], columns: dict[str, str]) -> dict[str, Any]:
    """Heads and texts of the columns that any row has."""
    there = [name for name in columns if any(name in row for row in rows)]
    return {
        "heads": [columns[name] for name in there],
        "rows": [[_cell(row.get(name)) for name in there] for row in rows],
    }


def _cell(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return number(value, 4)
    return "–" if value is None else str(value)
