"""What people see in a terminal: live progress, the summary of a run, the findings of a check."""

from __future__ import annotations

from io import StringIO
from pathlib import Path
from types import TracebackType

import numpy as np
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from .check import BodyFinding, Findings
from .fem.constants import symbol_of, unit_of
from .methods.solution import Iteration
from .nlp.parameters import Parameter
from .problem import Problem
from .rollout import Rollout
from .run import Run
from .statistics.uncertainty import Estimate

WIDE = 200
SHOWN_ITERATIONS = 12
SHOWN_DIAGNOSES = 2
SHOWN_MODES, SHOWN_RECORDINGS = 3, 4


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
    heads = ["", "RMS mm", "violation N", *map(symbol_of, lines[-1].parameters), "s"]
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
        *(f"{value:.4g}" for value in line.parameters.values()),
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
    parts += [parameter_table(finished), *_verdict(finished), *_nuisance(finished)]
    parts += [Text(f"note: {note}") for note in (*solution.notes, *finished.all_notes)]
    parts += _residuals(finished)
    parts.append(Text(f"written to {folder}"))
    return Group(*parts)


def plain_text(shown: RenderableType) -> str:
    """What a terminal would show, without colours and as wide as it needs."""
    file = StringIO()
    Console(file=file, width=WIDE, highlight=False).print(shown)
    return "\n".join(line.rstrip() for line in file.getvalue().splitlines())


def parameter_table(finished: Run) -> Table:
    """Parameters and derived moduli with their error bars."""
    table = Table("", "value", "±", "95 % interval", "guess", box=None, pad_edge=False)
    for column in table.columns[1:]:
        column.justify = "right"
    guesses = {item.name: _guess(item) for item in finished.problem.parameters.items}
    for name, estimate in finished.estimates.items():
        table.add_row(*_estimate_cells(name, estimate), guesses.get(name, ""))
    return table


def _guess(item: Parameter) -> str:
    if item.tied is not None:
        return "tied"
    return "fixed" if item.fixed else f"{item.guess:.5g}"


def _estimate_cells(name: str, estimate: Estimate) -> list[str]:
    symbol, unit = symbol_of(name), unit_of(name)
    interval = "" if estimate.ci95 is None else "{:.5g} … {:.5g}".format(*estimate.ci95)
    if estimate.at_bound:
        interval = "at its bound"
    elif estimate.reason:
        interval = "not determined" if estimate.ci95 is None else "not identifiable"
    spread = "" if estimate.std_error is None else f"{estimate.std_error:.2g}"
    return [f"{symbol} {unit}".strip(), f"{estimate.value:.5g}", spread, interval]


def _nuisance(finished: Run) -> list[Text]:
    """One line for each experiment that has nuisance parameters; offsets by their length."""
    collocation, lines = finished.solution.collocation, []
    for part in collocation.parts(finished.solution.z):
        segment, nuisance, name = part.segment, part.segment.nuisance, part.segment.experiment.name
        values, said = part.phi * nuisance.scales, []
        offsets = values[nuisance.places("offset")].reshape(-1, 3)
        if len(offsets):
            lengths = np.linalg.norm(offsets, axis=1)
            worst = segment.experiment.markers.names[int(lengths.argmax())]
            said.append(
                f"markers sit off their places by up to {1e3 * lengths.max():.2g} mm ({worst})"
            )
        said += [f"{1e3 * values[k]:.2g} ms time shift" for k in nuisance.places("time")]
        for kind, what in (("turn", "turn of the pose"), ("tilt", "tilt of gravity")):
            if len(places := nuisance.places(kind)):
                degrees = np.degrees(np.linalg.norm(values[places]))
                said.append(f"{degrees:.2g}° {what}")
        if len(places := nuisance.places("shift")):
            said.append(f"{1e3 * np.linalg.norm(values[places]):.2g} mm shift of the pose")
        if said:
            lines.append(Text(f"nuisance parameters of '{name}': {', '.join(said)}"))
    return lines


def _residuals(finished: Run) -> list[Text]:
    """What the largest residuals suggest."""
    largest = sorted(finished.diagnoses, key=lambda d: -d.rms_m)[:SHOWN_DIAGNOSES]
    return [Text(f"residuals: {diagnosis.sentence}") for diagnosis in largest]


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
    """The findings of a check on one screen, warnings last."""
    good = findings.derivatives_agree
    verdict = "The problem is valid and the derivatives agree." if good else (
        "The derivatives do not agree with differences at the guess."
    )  # fmt: skip
    return Group(
        *map(_body_section, findings.bodies),
        *_motion_section(findings),
        _measurements_section(findings),
        _solve_section(findings),
        Text(""),
        *_sentences("note", findings.notes, "default"),
        *_sentences("warning", findings.warnings, "yellow"),
        Text(verdict, style="green" if good else "red"),
    )


def _section(title: str, rows: dict[str, str]) -> RenderableType:
    table = Table.grid(padding=(0, 2, 0, 0))
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in rows.items():
        table.add_row(Text(f"  {name}"), Text(value))
    return Group(Text(title, style="bold"), table)


def _sentences(kind: str, sentences: tuple[str, ...], style: str) -> list[RenderableType]:
    table = Table.grid(padding=(0, 1, 0, 0))
    for sentence in sentences:
        table.add_row(Text(f"{kind}:", style=style), Text(sentence, style=style))
    return [table] if sentences else []


def _body_section(body: BodyFinding) -> RenderableType:
    size = " × ".join(f"{1e3 * x:.4g}" for x in body.size_m)
    low, mean, high = (1e3 * x for x in body.edges_m)
    worst = ", ".join(f"{e.element} ({e.quality:.2f})" for e in body.worst_elements)
    return _section(
        "Body",
        {
            "object": f"{size} mm, {1e6 * body.volume_m3:.4g} cm³, {1e3 * body.mass_kg:.4g} g",
            "mesh": f"{body.nodes:,} nodes, {body.elements:,} {body.element}; edges "
            f"{low:.3g} to {high:.3g} mm (mean {mean:.3g})",
            "quality": f"median {body.median_element_quality:.2f}, worst in elements {worst}",
            "guess": ", ".join(
                f"{symbol_of(name)} {value:.4g} {unit_of(name)}".strip()
                for name, value in body.guess.items()
            ),
        },
    )


def _motion_section(findings: Findings) -> list[RenderableType]:
    motion, *others = findings.motions
    title = f"Modes of '{motion.experiment}' about its {motion.about} (they depend on the guess)"
    heads = ("  Hz", "samples/period", "steps/period", "damping", "scheme adds", "period error")
    table = Table(*heads, box=None, pad_edge=False)
    for column in table.columns:
        column.justify = "right"
    for mode in motion.modes[:SHOWN_MODES]:
        table.add_row(
            f"{mode.frequency_hz:.3g}",
            f"{mode.samples_per_period:.1f}",
            f"{mode.steps_per_period:.1f}",
            f"{mode.damping_ratio:.2g}",
            f"{mode.numerical_damping_ratio:.2g}",
            f"{mode.period_error:+.1%}",
        )
    firsts = [f"'{m.experiment}' {m.first.frequency_hz:.3g} Hz" for m in others if m.first]
    more = [Text(f"  first modes elsewhere: {_listed(firsts)}")] if firsts else []
    return [Text(title, style="bold"), table, *more]


def _measurements_section(findings: Findings) -> RenderableType:
    rows = {}
    for recording in findings.recordings[:SHOWN_RECORDINGS]:
        far, lost = recording.farthest, recording.least_seen
        missing = (
            f"{recording.missing} samples missing, most of '{lost.name}' ({lost.missing})"
            if recording.missing
            else "none missing"
        )
        kind = ", validation" if recording.validation else ""
        rows[f"'{recording.experiment}'"] = (
            f"{recording.duration_s:.3g} s at {recording.rate_hz:.4g} Hz: {recording.frames} × "
            f"{len(recording.markers)} markers, {missing}; farthest from the body "
            f"'{far.name}', {round(1e3 * far.distance_m, 2):g} mm{kind}"
        )
    if len(findings.recordings) > SHOWN_RECORDINGS:
        rows["…"] = f"and {len(findings.recordings) - SHOWN_RECORDINGS} more (all with --json)"
    rows["at the guess"] = f"markers are missed by {1e3 * findings.rms_at_guess_m:.3g} mm RMS"
    return _section("Measurements", rows)


def _solve_section(findings: Findings) -> RenderableType:
    rows = {
        "program": f"{findings.variables:,} variables, {findings.constraints:,} constraints, "
        f"{findings.jacobian_nonzeros + findings.hessian_nonzeros:,} nonzeros"
    }
    for cost in findings.costs:
        chosen = ", chosen" if cost.method == findings.method else ""
        rows[cost.method] = f"about {_duration(cost.time_s)} and {_memory(cost.memory_mb)}{chosen}"
    rows["derivatives"] = (
        f"Jacobian and Hessian within {findings.jacobian_error:.0e} and "
        f"{findings.hessian_error:.0e} of differences"
    )
    return _section("Solve", rows)


def _duration(time_s: float | None) -> str:
    if time_s is None:
        return "an unknown time"
    for unit, seconds in (("h", 3600), ("min", 60)):
        if time_s >= 2 * seconds:
            return f"{time_s / seconds:.2g} {unit}"
    return f"{time_s:.1g} s" if time_s < 10 else f"{time_s:.0f} s"


def _memory(memory_mb: float) -> str:
    return f"{memory_mb / 1e3:.2g} GB" if memory_mb >= 1e3 else f"{memory_mb:.0f} MB"


def _listed(items: list[str]) -> str:
    shown = ", ".join(items[:SHOWN_RECORDINGS])
    return shown if len(items) <= SHOWN_RECORDINGS else f"{shown}, …"
