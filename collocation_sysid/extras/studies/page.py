"""Presentation of a study: tables for the terminal and for Markdown, CSV, JSON, and plots."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import exp
from pathlib import Path
from typing import Any

from ...common.display import Items, Line, Shown, Table, TitledParts, as_markdown
from ...common.files import SCHEMA, replaced_file, write_text_file
from ...common.serialisation import as_json
from ...fem.laws.constants import symbol_of, symbol_with_unit, unit_of
from .law_disagreements import is_comparable, law_table
from .model_choice import advice, display_unit, law_disagreements, model_notes, model_rows
from .planning import METHOD_STUDY, MODEL_STUDY, PlannedRun, shortened_keys
from .plots import comparison_plots, model_plots, sweep_plots
from .rows import COLUMNS, NumberColumn, Row, SuccessCriterion, method_rows, parameters_in, run_row
from .run_execution import Record, RunStore

# Resolution of the plots [pixels per inch], for a page.
RESOLUTION_DPI = 150
# Largest number of failures on the terminal; summary.md lists all.
SHOWN_FAILURES = 8
# Headings of tables on pages, by their short form in the terminal.
WORDS = {
    **{column.head: column.words for column in COLUMNS.values()},
    "": "chosen",
    "success": "successes",
    "95 %": "95 % interval of the rate",
    "free": "parameters estimated",
    "fit mm": "markers, RMS [mm]",
    "fit N": "forces, RMS [N]",
    "held out mm": "held out, RMS [mm]",
    "held out N": "held out, RMS [N]",
    "relative to best": "held out, relative to the best",
}
# Units that a short heading may end with.
UNITS = ("Pa", "s", "1/s", "kg/m³")
MEDIANS_NOTE = "Errors, misfits and costs are medians over the runs with a result."


@dataclass(frozen=True, eq=False)
class StudyReport:
    """Results of a study, finished or not."""

    title: str
    kind: str
    planned: tuple[PlannedRun, ...]
    records: Mapping[str, Record]  # mapping of str to Record: records of finished runs by key
    yardstick: SuccessCriterion

    @property
    def rows(self) -> list[Row]:
        """One row for each planned run (`run_row`), or for each model (`model_rows`),
        computed anew at each access.
        """
        if self.kind == MODEL_STUDY:
            return model_rows(self.planned, self.records)
        return [
            run_row(run, self.records.get(run.key), yardstick=self.yardstick)
            for run in self.planned
        ]

    def build_views(self) -> list[Table]:
        """Return the tables for the terminal, each within 80 columns, with short headings: of a
        comparison of methods success, quality and cost; of a comparison of models fit, prediction
        and parameters, and estimates in which equally good laws disagree, if there are any; of a
        sweep estimates, and quality and cost.
        """
        if self.kind == METHOD_STUDY:
            return comparison_views(method_rows(self.rows))
        if self.kind == MODEL_STUDY:
            disagreements = law_disagreements(self.rows)
            return [*model_views(self.rows), *([law_table(disagreements)] if disagreements else [])]
        return sweep_views(self.rows, list(self.planned[0].varied_values))

    def build_headline(self) -> list[str]:
        """Return the result of the study in a few sentences: the advice of a comparison of models,
        one sentence for each method, or of a sweep the number of converged runs and the ranges of
        the estimates.
        """
        if self.kind == MODEL_STUDY:
            return [advice(self.rows)]
        if self.kind == METHOD_STUDY:
            return [_method_sentence(row) for row in method_rows(self.rows)]
        return sweep_sentences(self.rows)

    def build_tables(self) -> list[Table]:
        """Return the tables for pages: those of `views` with headings in words, and for a
        comparison of methods one more table with all its runs.
        """
        views = [
            replace(view, heads=tuple(map(_in_words, view.heads))) for view in self.build_views()
        ]
        return [*views, run_view(self.rows)] if self.kind == METHOD_STUDY else views

    @property
    def failures(self) -> list[str]:
        """One line for each run that has a record without a result: its label, outcome
        and message. Runs without a record do not count.
        """
        return [
            f"{run.make_label()}: {record['outcome']}: {record.get('message', '')}"
            for run in self.planned
            if (record := self.records.get(run.key)) is not None
            and not {"result", "model"} & record.keys()
        ]

    @property
    def notes(self) -> list[str]:
        """Notes that explain the tables, the criterion of success of a comparison of
        methods, and the number of runs without a record, if there are any.
        """
        missing = len(self.planned) - len(self.records)
        notes = [f"{missing} of {len(self.planned)} runs remain to be done."] if missing else []
        if self.kind == MODEL_STUDY:
            return [*model_notes(self.rows), *notes]
        return [
            *((self.yardstick.describe(), MEDIANS_NOTE) if self.kind == METHOD_STUDY else ()),
            *notes,
        ]


def load_report(
    title: str,
    kind: str,
    planned: Sequence[PlannedRun],
    store: RunStore,
    yardstick: SuccessCriterion | None = None,
) -> StudyReport:
    """Return the report of planned runs from their stored records.

    Parameters
    ----------
    title, kind
        See `StudyReport`.
    planned : sequence of PlannedRun
        All runs of the study, at least one; those without a record remain to be done.
    store : RunStore
        Storage of the records.
    yardstick : SuccessCriterion, optional
        Criterion of success; by default convergence alone.
    """
    loaded = {run.key: store.load(run.key) for run in planned}
    records = {key: record for key, record in loaded.items() if record is not None}
    return StudyReport(
        title,
        kind,
        planned=tuple(planned),
        records=records,
        yardstick=yardstick or SuccessCriterion(),
    )


# In the terminal ---------------------------------------------------------------------------------


def study_tables(report: StudyReport, folder: Path) -> list[Shown]:
    """Return what the terminal shows of a study within 80 columns: the advice of a comparison of
    models, tables with an empty line after each, notes, up to `SHOWN_FAILURES` failures and the
    number of others, and the folder.

    Parameters
    ----------
    folder : Path
        Folder to which it was written, for the last line; nothing is written here.
    """
    # What no line of the tables says.
    parts: list[Shown] = [*report.build_headline(), ""] if report.kind == MODEL_STUDY else []
    for table in report.build_views():
        parts += [table, ""]
    failures = report.failures
    parts += [*report.notes, *(Line(each, "doubtful") for each in failures[:SHOWN_FAILURES])]
    if len(failures) > SHOWN_FAILURES:
        more = f"and {len(failures) - SHOWN_FAILURES} more in summary.md"
        parts.append(Line(more, "doubtful"))
    return [*parts, f"written to {folder}"]


def plan_table(planned: Sequence[PlannedRun], finished: Sequence[str]) -> Table:
    """Return a table of the runs of a study with their guesses ("–" if there is none), and which of
    them are finished.

    Parameters
    ----------
    planned : sequence of PlannedRun
        Runs; they are numbered from 1.
    finished : sequence of str
        Keys of the finished runs.
    """
    rows = tuple(
        (
            str(number),
            run.make_label(),
            " ".join("–" if g is None else f"{g:.4g}" for g in run.guess.values()),
            "finished" if run.key in finished else "to do",
        )
        for number, run in enumerate(planned, start=1)
    )
    return Table("", ("", "run", "guess", ""), rows=rows, names=4)


# Files --------------------------------------------------------------------------------------------


def write_report(report: StudyReport, folder: Path) -> None:
    """Write ``runs.csv``, ``summary.json``, ``summary.md`` and the plots (PNG) of a study into a
    folder.

    A comparison of methods has also ``summary.csv``. Earlier files are replaced, but plots that are
    no longer made stay.

    Parameters
    ----------
    folder : Path
        Folder, made if missing.

    Raises
    ------
    InputError
        If a file cannot be written.
    """
    rows = report.rows
    write_text_file(folder / "runs.csv", as_csv(rows))
    if report.kind == METHOD_STUDY:
        write_text_file(folder / "summary.csv", as_csv(method_rows(rows)))
    write_text_file(folder / "summary.json", as_json(report_json(report)) + "\n")
    write_text_file(folder / "summary.md", as_markdown([report_section(report)]))
    if report.kind == MODEL_STUDY:
        figures = model_plots(rows, comparable_names(rows))
    elif report.kind == METHOD_STUDY:
        figures = comparison_plots(rows, report.records, yardstick=report.yardstick)
    else:
        figures = sweep_plots(rows, list(report.planned[0].varied_values))
    for name, figure in figures.items():
        with replaced_file(folder / f"{name}.png") as draft:
            figure.savefig(draft, dpi=RESOLUTION_DPI)


def report_json(report: StudyReport) -> dict[str, Any]:
    """Return the content of summary.json, with tables and dataclasses that `as_json` converts.

    The keys are "schema", "kind", "title", "problem" (path of the first run's file), "runs",
    "headline", "notes", "tables" and "failures"; for a comparison of methods also "truth" (None if
    unknown), "within" and "methods", of models "advice" and "laws", and for a sweep
    "varied_values", the swept keys.
    """
    rows = report.rows
    first = report.planned[0]
    content: dict[str, Any] = {
        "schema": SCHEMA,
        "kind": report.kind,
        "title": report.title,
        "problem": first.problem,
        "runs": rows,
        "headline": report.build_headline(),
        "notes": report.notes,
        "tables": report.build_tables(),
        "failures": report.failures,
    }
    if report.kind == METHOD_STUDY:
        content |= {
            "truth": dict(report.yardstick.truth) or None,
            "within": report.yardstick.within,
            "methods": method_rows(rows),
        }
    elif report.kind == MODEL_STUDY:
        content |= {"advice": advice(rows), "laws": law_disagreements(rows)}
    else:
        content["varied_values"] = list(first.varied_values)
    return content


def as_csv(rows: Sequence[Row]) -> str:
    """Return rows as CSV text, a header and one line for each row; the columns are those of all
    rows, in the order of their first occurrence. Values that a row lacks, and None, are empty;
    other values are written as text by `str`, also lists and mappings. Without rows the text is an
    empty line.
    """
    columns = dict.fromkeys(name for row in rows for name in row)
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def report_section(report: StudyReport) -> TitledParts:
    """Return sentences, notes, tables (`StudyReport.build_views()`) and failures of a study as a
    section with its title, for a paper's appendix or an issue; without failures it has no part on
    them.
    """
    failures = (Items(tuple(report.failures)),) if report.failures else ()
    without = tuple(TitledParts("Runs without a result", (each,)) for each in failures)
    parts = (*report.build_headline(), *report.notes, *report.build_views(), *without)
    return TitledParts(report.title, parts, level=1)


def _in_words(head: str) -> str:
    """Return a heading in words, such as "E [Pa]" for "E Pa"."""
    if head.startswith("Δ") and head.endswith(" %"):
        return f"error of {head[1:-2]} [%]"
    symbol, space, unit = head.partition(" ")
    return WORDS.get(head, f"{symbol} [{unit}]" if space and unit in UNITS else head)


# Views --------------------------------------------------------------------------------------------

Cell = Callable[[Row], str]


def comparison_views(summaries: Sequence[Row]) -> list[Table]:
    """Return three tables, "Success", "Quality" and "Cost", with a line for each method and short
    headings; the column of evaluations is left out if no method counts them.

    Parameters
    ----------
    summaries : sequence of Row
        Rows of `method_rows`, at least one; None is shown as a dash.
    """
    success: dict[str, Cell] = {
        "runs": lambda row: str(row["runs"]),
        "success": lambda row: f"{row['successes']}/{row['runs']}",
        "95 %": lambda row: f"{100 * row['success_low']:.0f}–{100 * row['success_high']:.0f} %",
    }
    success |= _error_cells(summaries)
    quality = ["violation_n", "violation_relative", "rms_m", "rollout_rms_m", "tip_max_m"]
    cost = ["iterations", "evaluations", "build_s", "evaluations_s", "linear_algebra_s", "total_s"]
    if all(row["evaluations"] is None for row in summaries):
        cost.remove("evaluations")
    return [
        _table_view(
            "Success", {"method": _text_cell("method")}, number_columns=success, rows=summaries
        ),
        _table_view(
            "Quality",
            {"method": _text_cell("method")},
            number_columns=_number_cells(*quality),
            rows=summaries,
        ),
        _table_view(
            "Cost",
            {"method": _text_cell("method")},
            number_columns=_number_cells(*cost),
            rows=summaries,
        ),
    ]


def run_view(rows: Sequence[Row]) -> Table:
    """Return the table "Runs" of all runs of a comparison of methods, ordered by start, with
    headings in words.

    Parameters
    ----------
    rows : sequence of Row
        Rows of `run_row`, at least one; None is shown as a dash.
    """
    names = {"start": _text_cell("start"), "method": _text_cell("method")}
    cells: dict[str, Cell] = {
        "ended": _text_cell("status"),
        "succeeded": lambda row: "yes" if row["success"] else "no",
    }
    cells |= _error_cells(rows) | _number_cells("rms_m", "rollout_rms_m", "iterations", "total_s")
    ordered = sorted(rows, key=lambda row: row["start"])
    view = _table_view("Runs", names, number_columns=cells, rows=ordered)
    return replace(view, heads=tuple(map(_in_words, view.heads)))


def _method_sentence(row: Row) -> str:
    """Return how often, how accurately and how fast a method found the solution, in words."""
    low = 100 * row["success_low"]
    high = 100 * row["success_high"]
    sentence = f"{row['method']} succeeded in {row['successes']} of {row['runs']} runs"
    sentence += f" (95 % interval of the rate: {low:.0f} to {high:.0f} %)"
    if row["total_s"] is None:
        return f"{sentence}, and gave no result."
    misfit = f"with a marker error of {1e3 * row['rms_m']:.2g} mm"
    return f"{sentence}, {misfit} and a time of {row['total_s']:.2g} s (medians)."


def sweep_sentences(rows: Sequence[Row]) -> list[str]:
    """Return how many runs converged, and how much each estimate varies between them, in words;
    estimates of fewer than two runs are left out.

    Parameters
    ----------
    rows : sequence of Row
        Rows of `run_row`, at least one.
    """
    converged = [row for row in rows if row["converged"]]
    sentences = [f"{len(converged)} of {len(rows)} runs converged."]
    for name in parameters_in(rows):
        values = [row[f"value_{name}"] for row in converged]
        errors = [e for row in converged if (e := row[f"std_error_{name}"]) is not None]
        if len(values) > 1:
            spread = f"; the largest standard error is {max(errors):.2g}" if errors else ""
            low = f"{min(values):.4g}"
            high = f"{max(values):.4g} {unit_of(name)}".strip()
            sentences.append(f"Their {symbol_of(name)} is from {low} to {high}{spread}.")
    return sentences


def sweep_views(rows: Sequence[Row], varied_keys: Sequence[str]) -> list[Table]:
    """Return tables of estimates and quality, a line for each run with the values of the swept
    keys.

    Parameters
    ----------
    rows : sequence of Row
        Rows of `run_row`, at least one.
    """
    places = {short: _varied_cell(key) for key, short in shortened_keys(varied_keys)}
    estimates: dict[str, Cell] = {}
    for name in parameters_in(rows):
        estimates[symbol_with_unit(name)] = _estimate_cell(name)
    number_columns = _number_cells("rms_m", "rollout_rms_m", "iterations", "total_s")
    quality = {"status": _text_cell("status"), **number_columns}
    return [
        _table_view("Estimates ± standard error", places, number_columns=estimates, rows=rows),
        _table_view("Quality and cost", places, number_columns=quality, rows=rows),
    ]


def model_views(rows: Sequence[Row]) -> list[Table]:
    """Return the tables "Models" (fit and prediction, the chosen model with an arrow),
    "Parameters", and the combined intervals of comparable parameters, if there are any; with
    several held-out recordings the second is "Recordings held out", with the prediction error of
    each.

    Parameters
    ----------
    rows : sequence of Row
        Rows of `model_rows`, at least one; all errors are shown in the unit of the first one, such
        as mm. None is shown as a dash.
    """
    factor, unit = display_unit(rows[0]["unit"])
    number_columns: dict[str, Cell] = {
        "free": _number_cell("free", 1, form="d"),
        f"fit {unit}": _number_cell("rms", factor, form=".3g"),
        "ΔAIC": _number_cell("delta_aic", 1, form=".1f"),
        f"held out {unit}": _number_cell("held_out_rms", factor, form=".3g"),
        "relative to best": lambda row: _ratio_text(row),
        "total s": _number_cell("total_s"),
    }
    moduli: dict[str, Cell] = {}
    names = dict.fromkeys(name for row in rows for name in row["parameters"])
    for name in names:
        moduli[symbol_with_unit(name)] = _bounded_cell(name)
    model = {"": lambda row: "→" if row["chosen"] else "", "model": _text_cell("model")}
    views = [_table_view("Models", model, number_columns=number_columns, rows=rows)]
    test_columns = {
        f"'{n}' {unit}": _number_cell(n, factor, form=".3g", among="predictions")
        for n in dict.fromkeys(n for r in rows for n in r["predictions"])
    }
    if len(test_columns) > 1:
        views.append(
            _table_view(
                "Recordings held out",
                {"model": _text_cell("model")},
                number_columns=test_columns,
                rows=rows,
            )
        )
    views.append(
        _transposed_view("Parameters", {"model": _text_cell("model")}, cells=moduli, rows=rows)
    )
    intervals = {symbol_with_unit(n): _interval_cell(n) for n in comparable_names(rows)}
    if intervals:
        views.append(
            _transposed_view(
                "95 % intervals, each if its model is right",
                {"model": _text_cell("model")},
                cells=intervals,
                rows=rows,
            )
        )
    return views


def _transposed_view(
    title: str, names: Mapping[str, Cell], cells: Mapping[str, Cell], rows: Sequence[Row]
) -> Table:
    """Return a line for each cell and a column for each of few rows."""
    (name,) = names.values()
    lines = tuple((head, *(cell(row) for row in rows)) for head, cell in cells.items())
    return Table(title, ("", *(name(row) for row in rows)), rows=lines)


def _ratio_text(row: Row) -> str:
    """Return the ratio of a model's prediction error to the best one as text, with its standard
    error; "–" if "log_ratio" is None, because not all held-out data were predicted. `row` is one of
    `model_rows`.
    """
    if row["log_ratio"] is None:
        return "–"
    times = exp(row["log_ratio"])
    form = ".2f" if times < 100 else ".2g"
    return f"{times:{form}} ± {times * row['log_ratio_error']:{form}}"


def _table_view(
    title: str, names: Mapping[str, Cell], number_columns: Mapping[str, Cell], rows: Sequence[Row]
) -> Table:
    """Return a table with a line for each row and a column for each cell."""
    columns = {**names, **number_columns}
    cells = tuple(tuple(cell(row) for cell in columns.values()) for row in rows)
    return Table(title, tuple(columns), rows=cells, names=len(names))


def _text_cell(name: str) -> Cell:
    """Return the cell that shows the value under this name by `str`."""
    return lambda row: str(row[name])


def _varied_cell(key: str) -> Cell:
    """Return the cell of the value of a swept key: a function of a row that returns the value as a
    number with five digits, or its text if it is no number. Rows must have the key, with a text.
    """

    def cell(row: Row) -> str:
        """Return the swept value of a row: a number with five digits, other text as it is."""
        try:
            return f"{float(row[key]):.5g}"
        except ValueError:
            return str(row[key])

    return cell


def _number_cell(name: str, factor: float = 1.0, form: str = ".2g", among: str = "") -> Cell:
    """Return the cell of a number: a function of a row that returns the number as text, "–" if it
    is unknown.
    """
    shown = NumberColumn(factor=factor, form=form)
    return lambda row: shown.format(row[among].get(name) if among else row[name])


def _bounded_cell(name: str) -> Cell:
    """Return the cell of the parameter `name`: a function of a row of `model_rows` that returns its
    value as text, followed by "(at lower bound)" or "(at upper bound)" if it ended there; "–" if
    the model has no such parameter.
    """
    number = _number_cell(name, 1, form=".4g", among="parameters")

    def cell(row: Row) -> str:
        """Return the text of the cell in a row."""
        bound = row["at_bound"].get(name)
        return f"{number(row)} (at {bound} bound)" if bound else number(row)

    return cell


def comparable_names(rows: Sequence[Row]) -> list[str]:
    """Return the names of the estimates that mean the same in every model and have an interval in
    one of the rows of `model_rows`, in the order of their parameters.
    """
    names = dict.fromkeys(name for row in rows for name in row["parameters"])
    return [n for n in names if is_comparable(n) and any(n in row["budget"] for row in rows)]


def _interval_cell(name: str) -> Cell:
    """Return the cell of the combined interval of a parameter; "–" if a model has none."""

    def cell(row: Row) -> str:
        line = row["budget"].get(name)
        return "–" if line is None else "{:.3g} … {:.3g}".format(*line["combined95"])

    return cell


def _error_cells(rows: Sequence[Row]) -> dict[str, Cell]:
    """Return by heading, such as "ΔE %", the cell of the relative error [%] of each parameter whose
    true value is known: a function of a row that returns it as text. `rows`, at least one, are
    those of `run_row` or `method_rows`; the first one decides which parameters these are.
    """
    names = parameters_in(rows, "error_")
    return {f"Δ{symbol_of(name)} %": _number_cell(f"error_{name}", 100) for name in names}


def _number_cells(*names: str) -> dict[str, Cell]:
    """Return by short heading the cells of the columns with these names in `COLUMNS`: functions of
    a row that return the number as text, see `_column_cell`.
    """
    return {COLUMNS[name].head: _column_cell(name) for name in names}


def _column_cell(name: str) -> Cell:
    """Return the cell of the column with this name in `COLUMNS`: a function of a row that returns
    the number as text in the column's factor and format, "–" for None.
    """
    return lambda row: COLUMNS[name].format(row[name])


def _estimate_cell(name: str) -> Cell:
    """Return the cell of the estimate of the parameter `name`: a function of a row of `run_row`
    that returns its value, with the combined standard error if that is known, as text; "–" without
    an estimate.
    """

    def cell(row: Row) -> str:
        """Return the estimate of a row as text, with "± " and its standard error if known; "–" for
        no estimate.
        """
        value = row.get(f"value_{name}")
        spread = row.get(f"std_error_{name}")
        if value is None:
            return "–"
        return f"{value:.4g}" if spread is None else f"{value:.4g} ± {float(f'{spread:.1g}'):g}"

    return cell
