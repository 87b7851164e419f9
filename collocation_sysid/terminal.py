"""What people see in a terminal: live progress, the summary of a run, the findings of a check."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from .check import Findings
from .nlp.parameters import Theta
from .problem import Problem
from .results.solution import Iteration
from .results.uncertainty import Estimate
from .run import Rollout, Run

SHOWN_ITERATIONS = 12
UNITS = {
    "lambda_pa": ("λ", "Pa"),
    "mu_pa": ("μ", "Pa"),
    "young_pa": ("E", "Pa"),
    "poisson": ("ν", ""),
    "gamma_r_s": ("γ_r", "s"),
    "gamma_m_1_s": ("γ_m", "1/s"),
}


class Progress:
    """A live table of iterations on a terminal; plain lines elsewhere, when asked for."""

    def __init__(
        self, console: Console, problem: Problem, verbose: bool = False, quiet: bool = False
    ) -> None:
        self.console = console
        self.verbose = verbose
        self.quiet = quiet
        self._notes = problem.notes
        live = console.is_terminal and not quiet and not verbose
        self._live = Live(console=console, refresh_per_second=8, transient=True) if live else None
        self._lines: list[Iteration] = []
        self._doing = "simulating at the guess"

    def __enter__(self) -> Progress:
        if not self.quiet:
            for note in self._notes:
                self.console.print(Text(f"note: {note}"), soft_wrap=True)
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._live is not None:
            self._live.stop()

    def iteration(self, line: Iteration) -> None:
        """Show an iterate."""
        self._lines.append(line)
        self._doing = "solving"
        if self.verbose:
            self.console.print(Text("  ".join(_cells(line))), soft_wrap=True)
        self._refresh()

    def say(self, what: str) -> None:
        """Show what is being done now."""
        self._doing = what
        if self.verbose:
            self.console.print(Text(what), soft_wrap=True)
        self._refresh()

    def share(self, done: float) -> None:
        """Show the share of a simulation that is done."""
        self._doing = f"simulating: {done:.0%}"
        self._refresh()

    def _refresh(self) -> None:
        if self._live is not None:
            self._live.update(Group(_iterations(self._lines), Text(self._doing, style="dim")))


def _iterations(lines: list[Iteration]) -> RenderableType:
    if not lines:
        return Text("")
    heads = ["", "RMS mm", "violation N", *(UNITS[name][0] for name in Theta._fields), "s"]
    table = Table(*heads, box=None, pad_edge=False)
    for column in table.columns:
        column.justify = "right"
    for line in lines[-SHOWN_ITERATIONS:]:
        table.add_row(*_cells(line))
    return table


def _cells(line: Iteration) -> list[str]:
    return [
        str(line.number),
        f"{line.rms_m * 1e3:.4f}",
        f"{line.violation_n:.1e}",
        *(f"{value:.4g}" for value in line.theta),
        f"{line.time_s:.1f}",
    ]


def summary(finished: Run, folder: Path) -> RenderableType:
    """The answer of a run on one screen."""
    solution = finished.solution
    style = "green" if solution.status.converged else "red"
    parts: list[RenderableType] = [Text(solution.message, style=style)]
    if not solution.status.converged:
        parts.append(Text("Largest violations of the equations of motion:"))
        parts += [Text(f"  {violation}") for violation in solution.largest_violations]
    parts += [_parameter_table(finished), *_verdict(finished)]
    notes = [*solution.notes, *finished.notes]
    if finished.uncertainty is not None:
        notes += finished.uncertainty.notes
    parts += [Text(f"note: {note}") for note in notes]
    parts.append(Text(f"written to {folder}"))
    return Group(*parts)


def _parameter_table(finished: Run) -> Table:
    solution = finished.solution
    parameters = solution.collocation.parameters
    table = Table("", "value", "±", "95 % interval", "guess", box=None, pad_edge=False)
    for column in table.columns[1:]:
        column.justify = "right"
    estimates = dict(finished.uncertainty.estimates) if finished.uncertainty is not None else {}
    for item in parameters.items:
        estimate = estimates.get(item.name, Estimate(solution.parameters[item.name]))
        last = "fixed" if item.fixed else f"{item.guess:.5g}"
        table.add_row(*_estimate_cells(item.name, estimate), last)
    if finished.uncertainty is not None:
        for name, estimate in finished.uncertainty.derived.items():
            table.add_row(*_estimate_cells(name, estimate), "")
    return table


def _estimate_cells(name: str, estimate: Estimate) -> list[str]:
    symbol, unit = UNITS[name]
    interval = "" if estimate.ci95 is None else "{:.5g} … {:.5g}".format(*estimate.ci95)
    if estimate.at_bound:
        interval = "at its bound"
    spread = "" if estimate.std_error is None else f"{estimate.std_error:.2g}"
    return [f"{symbol} {unit}".strip(), f"{estimate.value:.5g}", spread, interval]


def _verdict(finished: Run) -> list[Text]:
    solution = finished.solution
    lines = [
        f"markers: {solution.rms_m * 1e3:.3f} mm RMS; dynamics violated by at most "
        f"{solution.max_violation_n:.1e} N ({solution.max_violation_relative:.1e} of the largest "
        "force)"
    ]
    for experiment in finished.problem.experiments:
        rollout = finished.rollouts[experiment.name]
        kind = "validation" if experiment.validation else "roll-out"
        if isinstance(rollout, Rollout):
            found = f"{rollout.rms_m * 1e3:.3f} mm RMS, at most {rollout.max_m * 1e3:.2f} mm"
        else:
            found = f"failed: {rollout}"
        lines.append(f"{kind} '{experiment.name}': {found}")
    timing = solution.timing
    lines.append(
        f"{solution.iterations} iterations in {timing.total:.1f} s "
        f"(linear algebra {timing.linear_algebra:.1f} s, evaluations {timing.evaluations:.1f} s)"
    )
    return [Text(line) for line in lines]


def check_table(findings: Findings) -> RenderableType:
    """The findings of a check on one screen."""
    table = Table("", "", show_header=False, box=None, pad_edge=False)
    for name, value in findings.as_dict().items():
        if name != "notes":
            table.add_row(name.replace("_", " "), _value(value))
    notes = [Text(f"note: {note}") for note in findings.notes]
    good = findings.derivatives_agree
    verdict = "The problem is valid and the derivatives agree." if good else (
        "The derivatives do not agree with differences at the guess."
    )  # fmt: skip
    return Group(table, *notes, Text(verdict, style="green" if good else "red"))


def _value(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    return f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else str(value)
