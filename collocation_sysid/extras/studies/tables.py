"""Results of a study: tables for the terminal, a Markdown file with one picture, and JSON."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import exp
from pathlib import Path
from typing import Any

from ...common.display import Shown, Table, TitledParts, as_markdown
from ...common.files import SCHEMA, replaced_file, write_text_file
from ...fem.laws.constants import symbol_with_unit
from .model_choice import advice, display_unit, model_notes, model_rows
from .planning import METHOD_STUDY, MODEL_STUDY, PlannedRun
from .plots import method_figure, model_figure
from .rows import Row, SuccessCriterion, error_columns, method_rows, run_row
from .run_execution import TIMEOUT, Record

# Resolution of the picture [pixels per inch], for a page.
RESOLUTION_DPI = 150
NUMBERS_NOTES = (
    "Loss: Σ (residual / σ)². Violation: largest residual of the equations of motion.",
    "Forward: RMS difference between the data and a simulation with the estimates.",
    "Numbers are medians over the runs, of one without an answer those of its last iteration.",
)


@dataclass(frozen=True, eq=False)
class StudyReport:
    """Results of a study, finished or not."""

    title: str
    kind: str
    planned: tuple[PlannedRun, ...]
    yardstick: SuccessCriterion
    # dict of str to Record: records of finished runs by label
    records: dict[str, Record] = field(default_factory=dict)

    @property
    def rows(self) -> list[Row]:
        """One row for each planned run (`run_row`), or for each model (`model_rows`),
        computed anew at each access.
        """
        if self.kind == MODEL_STUDY:
            return model_rows(self.planned, self.records)
        return [
            run_row(run, self.records.get(run.label), yardstick=self.yardstick)
            for run in self.planned
        ]

    def build_parts(self) -> list[Shown]:
        """Return the advice of a comparison of models, the tables, and notes that explain them,
        within 80 columns.
        """
        rows = self.rows
        if self.kind == METHOD_STUDY:
            parts: list[Shown] = [method_table(method_rows(rows)), ""]
        else:
            parts = [advice(rows), ""]
            for table in model_tables(rows):
                parts += [table, ""]
        return [*parts, *self.make_notes(rows)]

    @property
    def failures(self) -> list[str]:
        """One line for each run that has a record without a result, or ended at its time limit: its
        label, outcome and message. Runs without a record do not count.
        """
        return [
            f"{run.label}: {record['outcome']}: {record.get('message', '')}"
            for run in self.planned
            if (record := self.records.get(run.label)) is not None
            and (record["outcome"] == TIMEOUT or not {"fit", "model"} & record.keys())
        ]

    def make_notes(self, rows: Sequence[Row]) -> list[str]:
        """Return notes that explain the tables, the criterion of success of a comparison of
        methods, and the number of runs without a record, if there are any.
        """
        missing = len(self.planned) - len(self.records)
        explained = (
            model_notes(rows)
            if self.kind == MODEL_STUDY
            else (self.yardstick.describe(), *NUMBERS_NOTES)
        )
        remaining = [f"{missing} of {len(self.planned)} runs remain to be done."] if missing else []
        return [*explained, *remaining]

    def as_dict(self) -> dict[str, Any]:
        """Return the results for JSON.

        The keys are "schema", "kind", "title", "problem" (path of the first run's file), "runs",
        "notes" and "failures"; for a comparison of methods also "truth" (None if unknown), "within"
        and "methods", and of models "advice".
        """
        rows = self.rows
        content: dict[str, Any] = {
            "schema": SCHEMA,
            "kind": self.kind,
            "title": self.title,
            "problem": self.planned[0].problem,
            "runs": rows,
            "notes": self.make_notes(rows),
            "failures": self.failures,
        }
        if self.kind == MODEL_STUDY:
            return content | {"advice": advice(rows)}
        return content | {
            "truth": dict(self.yardstick.truth) or None,
            "within": self.yardstick.within,
            "methods": method_rows(rows),
        }

    def write(self, folder: Path) -> None:
        """Write ``summary.md``, and the picture if a run has a result, into a folder, made if
        missing: ``methods.png``, or ``models.png``. Earlier files are replaced.

        Raises
        ------
        InputError
            If a file cannot be written.
        """
        parts = (*self.build_parts(), *self.failures)
        section = TitledParts(self.title, parts, level=1)
        write_text_file(folder / "summary.md", as_markdown([section]))
        if self.kind == MODEL_STUDY:
            name, figure = "models.png", model_figure(self.rows)
        else:
            name, figure = "methods.png", method_figure(self.rows, self.records)
        if figure is not None:
            with replaced_file(folder / name) as draft:
                figure.savefig(draft, dpi=RESOLUTION_DPI)


def plan_table(planned: Sequence[PlannedRun]) -> Table:
    """Return a table of the runs of a study, numbered from 1, with their guesses ("–" if there is
    none).
    """
    rows = tuple(
        (
            str(number),
            run.label,
            " ".join("–" if g is None else f"{g:.4g}" for g in run.guess.values()),
        )
        for number, run in enumerate(planned, start=1)
    )
    return Table("", ("", "run", "guess"), rows=rows, names=3)


Cell = Callable[[Row], str]


def method_table(summaries: Sequence[Row]) -> Table:
    """Return the table "Methods" with a line for each method.

    Parameters
    ----------
    summaries : sequence of Row
        Rows of `method_rows`, at least one; None is shown as a dash. The error is the largest of all
        parameters.
    """
    cells: dict[str, Cell] = {"success": lambda row: f"{row['successes']}/{row['runs']}"}
    if errors := error_columns(summaries):
        cells["error %"] = lambda row: _number_text(
            max((row[name] for name in errors if row[name] is not None), default=None), 100
        )
    factor, unit = display_unit(next((row["unit"] for row in summaries if row["unit"]), ""))
    cells |= {
        "loss": _number_cell("loss"),
        "violation N": _number_cell("violation_n"),
        f"forward {unit}".strip(): _number_cell("forward", factor),
        "iter.": _number_cell("iterations", form=".4g"),
        "s": _number_cell("total_s"),
    }
    return _table("Methods", {"method": lambda row: row["method"]}, cells, summaries)


def model_tables(rows: Sequence[Row]) -> list[Table]:
    """Return the tables "Models" (fit and prediction, the chosen model with an arrow) and
    "Parameters".

    Parameters
    ----------
    rows : sequence of Row
        Rows of `model_rows`, at least one; all errors are shown in the unit of the first one, such
        as mm. None is shown as a dash.
    """
    factor, unit = display_unit(rows[0]["unit"])
    cells: dict[str, Cell] = {
        "free": _number_cell("free", form="d"),
        f"fit {unit}": _number_cell("rms", factor, form=".3g"),
        "ΔAIC": _number_cell("delta_aic", form=".1f"),
        f"held out {unit}": _number_cell("held_out_rms", factor, form=".3g"),
        "relative to best": _ratio_text,
        "total s": _number_cell("total_s"),
    }
    names: dict[str, Cell] = {
        "": lambda row: "→" if row["chosen"] else "",
        "model": lambda row: row["model"],
    }
    parameters = tuple(
        (symbol_with_unit(name), *(_bounded_value(row, name) for row in rows))
        for name in dict.fromkeys(name for row in rows for name in row["parameters"])
    )
    heads = ("", *(row["model"] for row in rows))
    return [_table("Models", names, cells, rows), Table("Parameters", heads, rows=parameters)]


def _ratio_text(row: Row) -> str:
    """Return "–" if not all held-out data were predicted."""
    if row["log_ratio"] is None:
        return "–"
    times = exp(row["log_ratio"])
    form = ".2f" if times < 100 else ".2g"
    return f"{times:{form}} ± {times * row['log_ratio_error']:{form}}"


def _bounded_value(row: Row, name: str) -> str:
    """Return "–" if the model has no such parameter."""
    number = _number_text(row["parameters"].get(name), form=".4g")
    bound = row["at_bound"].get(name)
    return f"{number} (at {bound} bound)" if bound else number


def _table(
    title: str, names: Mapping[str, Cell], numbers: Mapping[str, Cell], rows: Sequence[Row]
) -> Table:
    columns = {**names, **numbers}
    cells = tuple(tuple(cell(row) for cell in columns.values()) for row in rows)
    return Table(title, tuple(columns), rows=cells, names=len(names))


def _number_cell(name: str, factor: float = 1, form: str = ".2g") -> Cell:
    return lambda row: _number_text(row[name], factor, form)


def _number_text(value: float | None, factor: float = 1, form: str = ".2g") -> str:
    """Magnitudes from 100 on are rounded to whole numbers in ".2g"; None is "–"."""
    if value is None:
        return "–"
    value *= factor
    return format(value, ".0f" if form == ".2g" and abs(value) >= 100 else form)
