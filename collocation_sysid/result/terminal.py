"""What people see in a terminal: live progress, the summary of a run, the findings of a check."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from rich.console import Console, Group
from rich.text import Text

from ..arrays import Array, root_mean
from ..console import Watched
from ..display import Line, Shown, Table, labelled, on_terminal
from ..errors import listed
from ..fem.constants import GAMMA_R, symbol_of, unit_of, with_unit
from ..methods.solution import Iteration, reading_rms
from ..model.parameters import Parameter
from ..problem import Problem
from ..program.collocation import Part
from ..program.segment import Segment
from ..recording.nuisance import GAUGE, JOINING, PLACE, in_unit_for_people
from ..runs.answer import Answer
from ..runs.check import BodyFinding, Findings, Glance, Recording
from ..runs.check.hold import hold_sentence
from ..runs.forward_simulation import Rollout
from ..statistics.estimates import Estimate
from ..statistics.numerical import Refinement
from ..statistics.scale import relative_sentence
from ..statistics.trust import Concern
from ..statistics.uncertainty import Place
from .export.target import Comparison
from .heartbeat import Heartbeat
from .remedies import remedies_for

SHOWN_ITERATIONS = 12
SHOWN_DIAGNOSES = 2
SHOWN_MODES, SHOWN_RECORDINGS = 3, 4


class Progress(Watched):
    """A live table of iterations on a terminal; elsewhere a line now and then, or all if asked."""

    def __init__(
        self,
        console: Console,
        problem: Problem | None = None,
        verbose: bool = False,
        quiet: bool = False,
    ) -> None:
        super().__init__(console, quiet, live=not verbose)
        self.verbose = verbose
        self._notes = problem.notes if problem else ()
        self._lines: list[Iteration] = []
        self._doing = "finding a start"
        silent = not (console.is_terminal or quiet)
        self._heartbeat = Heartbeat(self._state, self.line) if silent else None

    def __enter__(self) -> Progress:
        for note in self._notes:
            self.line(f"note: {note}")
        super().__enter__()
        if self._heartbeat is not None:
            self._heartbeat.start()
        return self

    def __exit__(self, *error: object) -> None:
        super().__exit__(*error)
        if self._heartbeat is not None:
            self._heartbeat.stop()

    def iteration(self, line: Iteration) -> None:
        """Show an iterate."""
        self._lines.append(line)
        self._told("solving", "  ".join(_cells(line)))

    def say(self, what: str) -> None:
        """Show what is being done now."""
        self._told(what, what)

    def share(self, done: float) -> None:
        """Show the share of a simulation that is done."""
        self._told(f"simulating: {done:.0%}")

    def _told(self, doing: str, line: str = "") -> None:
        self._doing = doing
        if self.verbose and line:
            self.console.print(Text(line), soft_wrap=True)
        table = on_terminal(_iterations(self._lines))
        self.update(Group(table, Text(self._doing, style="dim")))

    def _state(self) -> str:
        done = f", {len(self._lines)} iterations" if self._lines else ""
        return f"{self._doing}{done}"


def _iterations(lines: list[Iteration]) -> Shown:
    if not lines:
        return ""
    heads = ("", "RMS mm", "violation N", *map(symbol_of, lines[-1].parameters), "s")
    return Table("", heads, tuple(map(_cells, lines[-SHOWN_ITERATIONS:])), names=0)


def _cells(line: Iteration) -> tuple[str, ...]:
    values = (f"{value:.4g}" for value in line.parameters.values())
    rms_mm, violation = f"{line.rms_m * 1e3:.4f}", f"{line.violation_n:.1e}"
    return str(line.number), rms_mm, violation, *values, f"{line.time_s:.1f}"


def summary(finished: Answer, folder: Path) -> list[Shown]:
    """The answer of a run on one screen."""
    solution = finished.solution
    parts: list[Shown] = [Line(solution.message, finished.trust.verdict)]
    if not solution.status.converged:
        parts.append("Largest violations of the equations of motion:")
        parts += [f"  {violation}" for violation in solution.largest_violations]
    parts += [*answer(finished), *_damping(finished), *_scale(finished)]
    parts += [*_fit(finished), *_nuisance(finished)]
    parts += [f"note: {note}" for note in (*solution.notes, *finished.all_notes)]
    # What the largest residuals suggest.
    largest = sorted(finished.diagnoses, key=lambda d: -d.rms_m)[:SHOWN_DIAGNOSES]
    parts += [f"residuals: {diagnosis.sentence}" for diagnosis in largest]
    return [*parts, f"written to {folder}"]


def answer(finished: Answer) -> list[Shown]:
    """Verdict, values, intervals and what these hold."""
    trust = finished.trust
    return [
        Line(f"Verdict: {trust.verdict}", f"strong {trust.verdict}"),
        *(Line(f"  {reason}", trust.verdict) for reason in trust.reasons),
        *_how_to(trust.concerns),
        parameter_table(finished),
        *_numerical(finished),
    ]


def _how_to(concerns: Sequence[Concern]) -> list[Shown]:
    """The pages that say how to cure what gives concern."""
    remedies = remedies_for(concerns).values()
    pages = dict.fromkeys(f"docs/howto/{each.page}.md" for each in remedies)
    return [Line(f"what to do: {', '.join(pages)}", "quiet")] if pages else []


def parameter_table(finished: Answer) -> Table:
    """Parameters and derived moduli with their error bars."""
    guesses = {item.name: _guess(item) for item in finished.started_from.items}
    rows = tuple(
        (*_estimate_cells(name, estimate), guesses.get(name, ""))
        for name, estimate in finished.estimates.items()
    )
    return Table("", ("", "value", "±", "95 % interval", "guess"), rows)


def refinement_table(found: Refinement) -> Table:
    """What step and mesh change, and intervals for noise and discretisation."""
    halved = ("half the step", "order", "half the edges", "order")
    rows = tuple(
        (
            with_unit(name),
            *(_change(error.step), _order(error.step_order)),
            *(_change(error.mesh), _order(error.mesh_order)),
            f"{error.extrapolated:.5g}",
            _interval(error.ci95),
        )
        for name, error in found.errors.items()
    )
    return Table("", ("", *halved, "limit", "95 % interval"), rows)


def export_notes(warnings: Sequence[str], limits: Sequence[str]) -> list[Shown]:
    """What to know of an export, a line each."""
    return [*(f"warning: {w}" for w in warnings), *(f"not expressed: {each}" for each in limits)]


def comparison_table(name: str, found: Sequence[Comparison]) -> Table:
    """What a simulator predicts beside what we do."""
    rows = []
    for each in found:
        values = (f"{value:.5g} {each.unit}" for value in (each.theirs, each.ours))
        rows.append((each.what, *values, f"{each.relative:+.2%}", each.remark))
    return Table("", ("", name, "ours", "difference", ""), tuple(rows), names=5)


def _interval(found: tuple[float, float] | None) -> str:
    return "" if found is None else "{:.5g} … {:.5g}".format(*found)


def _change(change: float | None) -> str:
    return "" if change is None else f"{change:+.3g}"


def _order(order: float | None) -> str:
    return "" if order is None else f"{order:.1f}"


def _numerical(finished: Answer) -> list[Shown]:
    """What the intervals hold, and what is known of the numerical error."""
    found, holds = finished.refinement, finished.interval_holds
    if not holds:
        return []
    segments = finished.solution.collocation.segments
    possible = ["step", "mesh"] if any(not s.experiment.static for s in segments) else ["mesh"]
    left = [f"the {kind}" for kind in possible if kind not in holds]
    said = f"intervals cover {listed(f'the {kind}' for kind in holds)}"
    said += f", not {listed(left)}: see refine" if left else ""
    if found is None:
        return [said]
    if found.levels:
        return [said, refinement_table(found)]
    known = ((name, finished.estimates[name]) for name in found.errors)
    moved = [
        f"{symbol_of(name)} {100 * (1 - found.errors[name].extrapolated / each.value):+.2g} %"
        for name, each in known
        if each.value and each.std_error is not None
    ]
    return [said, f"the step moves, to first order: {', '.join(moved)}"]


def _damping(finished: Answer) -> list[str]:
    """The law that γ_r belongs to."""
    parts = [part for body in finished.problem.bodies for part in body.parts]
    laws = dict.fromkeys(part.damping.name for part in parts if GAMMA_R in part.damping.constants)
    said = [law + (", which also brakes rotation" if law == "rayleigh" else "") for law in laws]
    return [f"{GAMMA_R.symbol} is that of damping = {' and '.join(said)}"] if laws else []


def _scale(finished: Answer) -> list[str]:
    """What the moduli rest on, where nothing else sets their scale."""
    said = relative_sentence(finished.problem.experiments, finished.problem.parameters)
    return [] if said is None else [said]


def _guess(item: Parameter) -> str:
    if item.tied is not None:
        return "tied"
    return "fixed" if item.fixed else f"{item.guess:.5g}"


def _estimate_cells(name: str, estimate: Estimate) -> tuple[str, ...]:
    interval = _interval(estimate.ci95)
    if estimate.at_bound:
        interval = "at its bound"
    elif estimate.reason:
        interval = "not determined" if estimate.ci95 is None else "not identifiable"
    spread = "" if estimate.std_error is None else f"{estimate.std_error:.2g}"
    return with_unit(name), f"{estimate.value:.5g}", spread, interval


def _nuisance(finished: Answer) -> list[str]:
    """One line for each experiment that has nuisance parameters, with their priors."""
    collocation, lines = finished.solution.collocation, []
    for part in collocation.parts(finished.solution.z):
        name = part.segment.experiment.name
        said = _places(finished.places[name]) + _of_rows(part, finished)
        if said:
            lines.append(f"also estimated for '{name}': {'; '.join(said)}")
    return lines


def _places(places: Mapping[str, Place]) -> list[str]:
    """How far places are from those given, and how well those not given are known."""
    moved = {
        n: place.moved_m or 0.0 for n, place in places.items() if place.prior_m and place.given
    }
    unknown, said = [place for place in places.values() if not place.given], []
    if moved:
        worst = max(moved, key=moved.__getitem__)
        said.append(
            f"markers sit off their places by up to {_short(1e3 * moved[worst])} mm ({worst}; "
            f"prior {_short(1e3 * places[worst].prior_m)})"
        )
    if unknown:
        count = f"{len(unknown)} marker" + ("s" if len(unknown) > 1 else "")
        errors = [
            float(place.std_error_m.max()) for place in unknown if place.std_error_m is not None
        ]
        known = f", found to ±{_short(1e3 * max(errors))} mm" if len(errors) == len(unknown) else ""
        said.append(f"{count} without a place{known} (prior {_short(1e3 * unknown[0].prior_m)})")
    return said


def _of_rows(part: Part, finished: Answer) -> list[str]:
    """What was found of each row of the table but the places, beside its prior."""
    nuisance, said = part.segment.nuisance, []
    values = part.phi * nuisance.scales
    for row in (*part.segment.experiment.nuisance.rows, GAUGE):
        here = nuisance.places(row).tolist()
        if row == PLACE or not here:
            continue
        groups = [[k] for k in here]
        if row.by == "length":
            numbers = dict.fromkeys(nuisance.entries[k].number for k in here)
            vectors = [nuisance.places(row, of=number).tolist() for number in numbers]
            # Several markers have one each: the longest counts.
            groups = [max(vectors, key=lambda own: float(np.linalg.norm(values[own])))]
        elif row.by == "worst":
            groups = [[max(here, key=lambda k: abs(part.phi[k]))]]
        said += [_told(part, own, values[own], finished) for own in groups]
    return said


def _told(part: Part, own: Sequence[int], values: Array, finished: Answer) -> str:
    """The sentence of a row about a vector, or a number."""
    nuisance, k = part.segment.nuisance, own[0]
    entry, name = nuisance.entries[k], nuisance.names[k]
    known = finished.uncertainty.nuisance if finished.uncertainty else {}
    low, high = (limit[k] for limit in nuisance.limits(part.segment.chart.samples))
    factor, unit = in_unit_for_people(1.0, entry.unit)
    size, error = float(np.linalg.norm(values)), entry.sigma * known.get(name, np.nan)
    told = entry.row.told or "{which} {signed}"
    allowed = low + 1e-3 < part.phi[k] < high - 1e-3
    sentence = told.format(
        size=f"{_short(factor * size)}{unit}",
        signed=f"{_short(factor * float(values[0]))}{unit}",
        number=_short(factor * size),
        unit=unit,
        error="" if np.isnan(error) else f" ± {_short(factor * error)}",
        way="later" if values[0] > 0 else "earlier",
        which=entry.label.rpartition(" [")[0],
        limit="" if allowed else ", the most that is allowed",
        stated=f"{nuisance.timed[entry.number].stated_s:g} s" if entry.row == JOINING else "",
    )
    return f"{sentence} (prior {_short(factor * entry.sigma)})"


def _short(value: float) -> str:
    """Two digits, and no powers of ten for the sizes of bodies."""
    return f"{value:.2g}" if value < 99.5 else f"{value:.0f}"


def _fit(finished: Answer) -> list[str]:
    """How well the markers and the equations are met, and how long that took."""
    solution = finished.solution
    violated = (
        f"equations of motion violated by at most {solution.max_violation_n:.1e} N "
        f"({solution.max_violation_relative:.1e} of the largest force)"
    )
    marked = any(s.experiment.markers.samples for s in solution.collocation.segments)
    markers = (
        f"markers: {solution.rms_m * 1e3:.3f} mm RMS, {finished.noise_rms_m * 1e3:.3f} mm from "
        "noise alone; "
    )
    lines = [f"{markers if marked else ''}{violated}"]
    for segment in solution.collocation.segments:
        found = solution.wrench_rms.get(segment.experiment.name, (None, None))
        if sizes := _wrench_sizes(found):
            lines.append(f"wrench of '{segment.experiment.name}': {sizes}{_sigmas(segment)}")
        read = reading_rms(segment.experiment, solution.readings[segment.experiment.name])
        for gauge in segment.experiment.readings:
            sizes = f"{_short(read[gauge.name])} RMS (sigma {_short(gauge.sigma)})"
            lines.append(f"{gauge.name} of '{segment.experiment.name}': {sizes}")
    for experiment in finished.problem.experiments:
        rollout = finished.rollouts[experiment.name]
        kind = "validation" if experiment.validation else "forward simulation"
        if isinstance(rollout, Rollout):
            tracks = f"{rollout.rms_m * 1e3:.3f} mm RMS, at most {rollout.max_m * 1e3:.2f} mm"
            said = [tracks if experiment.markers.samples else "", _wrench_sizes(rollout.wrench_rms)]
            said += [f"{name} {rms:.2g} RMS" for name, rms in rollout.reading_rms.items()]
            found = "; ".join(each for each in said if each)
        else:
            found = f"failed: {rollout}"
        lines.append(f"{kind} '{experiment.name}': {found}")
    timing = solution.timing
    lines.append(
        f"{solution.iterations} iterations in {timing.total:.1f} s "
        f"(linear algebra {timing.linear_algebra:.1f} s, evaluations {timing.evaluations:.1f} s)"
    )
    return lines


def _wrench_sizes(rms: tuple[float | None, float | None]) -> str:
    """Forces and torques in words, "" where none is measured."""
    sizes = [f"{_short(size)} {unit}" for size, unit in zip(rms, ("N", "N m"), strict=True) if size]
    return f"{', '.join(sizes)} RMS" if sizes else ""


def _sigmas(segment: Segment) -> str:
    """What is stated of the sensors' noise."""
    sigmas: dict[str, list[float]] = {"N": [], "N m": []}
    for sensor in segment.sensors:
        for k in np.flatnonzero(sensor.wrench.measured):
            sigmas["N" if k < 3 else "N m"].append(sensor.wrench.sigmas[k])
    said = [f"{_short(root_mean(np.square(v)))} {unit}" for unit, v in sigmas.items() if v]
    return f" (sigma {', '.join(said)})"


def check_table(findings: Findings) -> list[Shown]:
    """The findings of a check on one screen, warnings last."""
    return [*glance_table(findings), *closer_table(findings)]


def glance_table(found: Glance | Findings) -> list[Shown]:
    """What a check sees at once."""
    return [*map(_body_section, found.bodies), _measurements_section(found)]


def closer_table(findings: Findings) -> list[Shown]:
    """What follows it, warnings last."""
    said = {"note": (findings.notes, ""), "warning": (findings.warnings, "check")}
    return [
        *_motion_section(findings),
        _solve_section(findings),
        "",
        *(
            Table("", (), tuple((f"{kind}:", each) for each in sentences), texts=1, style=style)
            for kind, (sentences, style) in said.items()
            if sentences
        ),
        *_how_to(findings.concerns),
        _check_verdict(findings),
    ]


def _check_verdict(findings: Findings) -> Line:
    if not findings.derivatives_agree:
        return Line("The derivatives do not agree with differences at the guess.", "doubtful")
    if findings.causes:
        likeliest = findings.causes[0].sentence
        said = f"The derivatives agree, but the description looks wrong: {likeliest}"
        return Line(said, "doubtful")
    return Line("The problem is valid and the derivatives agree.", "good")


def _body_section(body: BodyFinding) -> Table:
    size = " × ".join(f"{1e3 * x:.4g}" for x in body.size_m)
    low, mean, high = (1e3 * x for x in body.edges_m)
    worst = ", ".join(f"{e.element} ({e.quality:.2f})" for e in body.worst_elements)
    return labelled(
        "Body",
        {
            "object": f"{size} mm, {1e6 * body.volume_m3:.4g} cm³, {1e3 * body.mass_kg:.4g} g",
            "mesh": f"{body.nodes:,} nodes, {body.elements:,} {body.element}; edges "
            f"{low:.3g} to {high:.3g} mm (mean {mean:.3g})",
            "quality": f"median {body.median_element_quality:.2f}, worst in elements {worst}",
        },
    )


def _motion_section(findings: Findings) -> list[Shown]:
    if not findings.motions:  # equilibria only
        return []
    motion, *others = findings.motions
    title = f"Modes of '{motion.experiment}' about its {motion.about} (they depend on the guess)"
    heads = ("  Hz", "samples/period", "steps/period", "damping", "scheme adds", "period error")
    rows = tuple(
        (
            f"{mode.frequency_hz:.3g}",
            f"{mode.samples_per_period:.1f}",
            f"{mode.steps_per_period:.1f}",
            f"{mode.damping_ratio:.2g}",
            f"{mode.numerical_damping_ratio:.2g}",
            f"{mode.period_error:+.1%}",
        )
        for mode in motion.modes[:SHOWN_MODES]
    )
    firsts = [f"'{m.experiment}' {m.first.frequency_hz:.3g} Hz" for m in others if m.first]
    more = [f"  first modes elsewhere: {_listed(firsts)}"] if firsts else []
    return [Table(title, heads, rows, names=0), *more]


def _measurements_section(findings: Glance | Findings) -> Table:
    rows = {}
    for recording in findings.recordings[:SHOWN_RECORDINGS]:
        kind = ", validation" if recording.validation else ""
        when = f"{recording.duration_s:.3g} s at {recording.rate_hz:.4g} Hz"
        rows[f"'{recording.experiment}'"] = (
            f"{'static' if recording.static else when}: {recording.frames} × "
            f"{_markers_seen(recording)}{kind}"
        )
    if len(findings.recordings) > SHOWN_RECORDINGS:
        rows["…"] = f"and {len(findings.recordings) - SHOWN_RECORDINGS} more (all with --json)"
    for hold in findings.holds[:SHOWN_RECORDINGS]:
        rows[f"grasp of '{hold.experiment}'"] = hold_sentence(hold)
    return labelled("Measurements", rows)


def _markers_seen(recording: Recording) -> str:
    if not recording.markers:
        return f"{', '.join(recording.instruments)}, no markers"
    besides = "".join(f", {name}" for name in recording.instruments)
    far, lost = recording.farthest, recording.least_seen
    missing = (
        f"{recording.missing} samples missing, most of '{lost.name}' ({lost.missing})"
        if recording.missing
        else "none missing"
    )
    return (
        f"{len(recording.markers)} markers, {missing}; farthest from the body "
        f"'{far.name}', {round(1e3 * far.distance_m, 2):g} mm{besides}"
    )


def _solve_section(findings: Findings) -> Table:
    rows = {
        "guess" if len(findings.bodies) == 1 else f"guess of '{body.experiments[0]}'": ", ".join(
            f"{symbol_of(name)} {value:.4g} {unit_of(name)}".strip()
            for name, value in body.guess.items()
        )
        for body in findings.bodies
    }
    if findings.samples and findings.rms_at_guess_m is not None:
        rows["at the guess"] = f"markers are missed by {1e3 * findings.rms_at_guess_m:.3g} mm RMS"
    rows |= {
        "program": f"{findings.variables:,} variables, {findings.constraints:,} constraints, "
        f"{findings.jacobian_nonzeros + findings.hessian_nonzeros:,} nonzeros"
    }
    if findings.overstresses:
        rows["memory"] = (
            f"{findings.overstresses:,} more variables and constraints for interior-point, the "
            "viscoelastic stress of every point, in these nonzeros"
        )
    if findings.wrenches:
        rows["wrenches"] = (
            f"{findings.wrenches:,} more variables and constraints for interior-point, what grasps "
            "with a sensor give, in these nonzeros"
        )
    for cost in findings.costs:
        chosen = ", chosen" if cost.method == findings.method else ""
        rows[cost.method] = f"about {_duration(cost.time_s)} and {_memory(cost.memory_mb)}{chosen}"
    rows["derivatives"] = (
        f"Jacobian and Hessian within {findings.jacobian_error:.0e} and "
        f"{findings.hessian_error:.0e} of differences"
    )
    return labelled("Solve", rows)


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
