"""Description of a run in words and tables: the sections of its report, which the summary in the
terminal shares.

`run_report` describes a run folder completely, with pictures. All sections are made from the
content of ``result.json``.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..common.display import (
    Cards,
    Line,
    Listing,
    Shown,
    Span,
    Table,
    TitledParts,
    flattened_parts,
    millimetres,
    number,
    predicted_change,
    readable_stress,
    rounded,
    two_digits,
)
from ..common.files import is_own
from ..common.pages import explain_command, page_url
from ..common.serialisation import content
from ..errors import listed
from ..features.measurements import SimulatedExperiment
from ..fem.laws.constants import symbol_of, unit_of
from ..judge.posterior import main_sources
from ..recording.deviation import in_readable_unit
from ..runs.result_content import UNMOVED, Elapsed, Result
from ..statistics.assessment import Assessment
from ..statistics.budget.effect_estimates import effect_row
from ..statistics.budget.systematic_effects import source_label
from ..statistics.concerns import Concern, remedy_for, topics_of
from .picture_captions import captioned_pictures
from .replay import LARGEST_NUMBER, damaged_run_refused, read_arrays

VERDICT_MEANINGS = {
    "good": "no reason for doubt about the estimates and their error bars was found",
    "check": "usable after checking the reasons below",
    "doubtful": "something is wrong with the data, the model or the solve",
}
# Number of largest errors shown.
SHOWN_ERRORS = 8
# Samples between two shown errors of a marker: neighbouring errors have the same cause.
ERROR_SPACING_SAMPLES = 5
# Estimates whose main sources of uncertainty are named.
SHOWN_BUDGETS = 3
# Sources named for each of these estimates.
SHOWN_SOURCES = 3
# Sources whose remedy is named where they are the largest: one statement removes them.
SHOWN_REMEDIES = ("platen_slip",)
# Smallest share of a variance that is shown.
SMALLEST_SHOWN_SHARE = 0.01
# Moduli of which the most important is the first.
STIFFNESS_NAMES = ("young_pa", "mu_pa", "kappa_pa", "lambda_pa")
# Beginnings of the codes of reasons that the residuals are no noise of the stated size.
REASONS_OF_RESIDUALS = ("noise/", "residuals/", "specimen/law", "specimen/persist")
# Smallest relative correction of an estimate that is stated.
SMALLEST_CORRECTION = 0.005
# Posterior over prior deviation of an effect from which on the data do not see it.
UNSEEN = 0.95
# Effects that the table has.
MOST_EFFECTS = 12
# Ratio of combined to statistical standard uncertainty beyond which the sources are named.
SYSTEMATIC_RATIO = 1.5


def estimate_sections(result: Result) -> list[Shown]:
    """Return the verdict, the command that explains its remedies if there is a concern, and the
    table of parameters with their intervals, each as a part without title.
    """
    sections = [verdict_section(result.trust), *remedy_command(result.trust.concerns)]
    sections += [parameter_section(result)]
    return [*flattened_parts(sections)]


def run_report(run: str | Path) -> TitledParts:
    """Return the complete report of a run folder, with all PNG pictures in it, see
    `captioned_pictures`; nothing is written.

    Raises
    ------
    InputError
        If it is not a run folder, or a damaged one.
    """
    run = Path(run)
    result = Result.read(run)
    with damaged_run_refused(run):
        verdict = verdict_section(result.trust, linked=True)
        took = f" {result.method}, {result.iterations} iterations"
        badge = Span(result.status, f"badge {result.trust.verdict}")
        pictures = captioned_pictures(run)
        meaning = Line(f"{VERDICT_MEANINGS[result.trust.verdict]}.", "quiet")
        parts: list[Shown] = [
            Line((badge, Span(took)), "quiet"),
            replace(verdict, parts=(verdict.parts[0], meaning, *verdict.parts[1:])),
            _cards(result),
            *flattened_parts([outcome_section(result)]),
            *pictures[:1],
            TitledParts("What to do", (*remedy_lines(result.trust.concerns),)),
            parameter_section(result),
            TitledParts("Error bars", tuple(_error_bars(result))),
            TitledParts("Effects", (effects_table(result),) if result.effects else ()),
            fit_section(result),
            notes_section(result),
            *_marker_place_sections(result),
            *_nuisance_sections(result),
            TitledParts("Residuals", tuple(_residual_tables(result, run))),
            TitledParts("Pictures", tuple(pictures[1:])),
            TitledParts("Problem and provenance", tuple(_provenance_parts(result, run))),
        ]
        shown = (each for each in parts if not isinstance(each, TitledParts) or each.parts)
        return TitledParts(result.title or "Run", tuple(shown), level=1)


# What terminal and page show ----------------------------------------------------------------------


def outcome_section(result: Result) -> TitledParts:
    """Return the message with which the solve ended, in the colour of the verdict, followed by the
    largest violations of the equations of motion if it did not converge; the title is empty.
    """
    parts: list[Shown] = [Line(result.message, result.trust.verdict)]
    if not result.converged:
        parts.append("Largest violations of the equations of motion:")
        parts += [f"  {violation}" for violation in result.dynamics.largest]
    return TitledParts("", tuple(parts))


def verdict_section(
    trust: Assessment, linked: bool = False, max_reasons: int | None = None
) -> TitledParts:
    """Return the verdict in one word as the first line, with a line for each reason; the title is
    empty.

    Parameters
    ----------
    trust : Assessment
        Verdict with its concerns.
    linked : bool
        Whether each reason links to its remedy on the same page.
    max_reasons : int, optional
        The largest number of reasons to list, gravest first; all by default. Further reasons are
        left out without a remark.
    """
    verdict = trust.verdict
    lines = [Line(f"Verdict: {verdict}", f"strong {verdict}")]
    for concern in trust.concerns[:max_reasons]:
        cure = Span(" (what to do)", to=f"#cure-{concern.topic}")
        spans = (Span(f"  {concern.message}"), *[cure] * linked)
        lines.append(Line(spans, verdict))
    return TitledParts("", tuple(lines), style=f"verdict {verdict}")


def remedy_command(concerns: Iterable[Concern]) -> list[Line]:
    """Return the command that explains the remedies of some concerns; empty without concerns."""
    pages = dict.fromkeys(topic.page for topic in topics_of(concerns).values())
    return [Line(f"what to do: {explain_command(*pages)}", "quiet")] if pages else []


def parameter_section(result: Result) -> TitledParts:
    """Return the section "Parameters": the table of all estimates with corrected values, combined
    and statistical uncertainties and guesses, and remarks on it.

    The remarks are on fields, on what the intervals contain, on corrections, on estimates that are
    not determined, and on the largest contributions; each is left out if it does not apply.
    """
    values = result.estimates
    rows = tuple(estimate_row(result, name) for name in values)
    heads = ("", "value", "±", "95 % interval", "± stat", "± syst", "guess", "")
    faint = tuple(range(len(result.parameters), len(values)))
    parts: list[Shown] = [Table("", heads, rows=rows, texts=1, faint=faint, note_column=1)]
    parts += [field.sentence(name) for name, field in result.fields.items()]
    if any(each.combined95 for each in values.values()):
        parts.append(_coverage_sentence(result))
    elif any(each.statistical95 for each in values.values()):
        parts.append(
            "there are no combined intervals, because systematic effects were not evaluated"
        )
    if "mesh" in result.discretisation_kinds:
        parts.append(refinement_table(result))
    elif corrected := [
        f"{symbol_of(name)} {_percent(each.value / each.optimum - 1)}"
        for name, each in values.items()
        if each.optimum and abs(each.value / each.optimum - 1) >= SMALLEST_CORRECTION
    ]:
        parts.append(f"corrected for the effects below: {', '.join(corrected)}")
    parts += [each.statement() for each in result.combinations]
    parts += _undetermined_sentence(result)
    parts += _largest_contributions(result)
    return TitledParts("Parameters", (*parts, *result.basis))


def _percent(change: float) -> str:
    return predicted_change(change, f"{100 * change:+.2g} %")


def stated_as_undetermined(result: Result) -> set[str]:
    """Return the names of the estimates that a reason of the verdict calls undetermined."""
    return {
        name
        for concern in result.trust.concerns
        if concern.code in ("information/none", "specimen/none")
        for name in concern.data.get("names", [concern.data.get("name")])
    }


def _undetermined_sentence(result: Result) -> list[str]:
    """Estimates that a reason of the verdict names are left out."""
    stated = stated_as_undetermined(result)
    sources = []
    for name, limit in result.limits.items():
        if name not in stated and not limit.determined:
            largest = f"{source_label(limit.source)}, {limit.share:.0%}"
            sources.append(f"{symbol_of(name)} (largest contribution: {largest})")
    if not sources:
        return []
    return [f"not determined: {listed(sources)}"]


def _coverage_sentence(result: Result) -> str:
    moving = any(not each.static for each in result.fit.experiments.values())
    meshed = any(each.test is None for each in result.fit.experiments.values())
    kinds = ("step", "mesh") if moving and meshed else ("mesh",) if meshed else ()
    known = set(result.discretisation_kinds)
    names = {source for shares in result.budget.values() for source in shares}
    known |= {kind for kind, name in (("step", "time_step"), ("mesh", "mesh")) if name in names}
    covered = [f"the {kind} error" for kind in kinds if kind in known]
    missing = [f"the {kind} error" for kind in kinds if kind not in known]
    parts = listed(["noise", *covered, "systematic effects"])
    sentence = f"± (standard uncertainty) and intervals combine {parts}"
    return sentence + (f", but not {listed(missing)} (measured by refine)" if missing else "")


def _largest_contributions(result: Result) -> list[str]:
    """Combined uncertainties exceed `SYSTEMATIC_RATIO` times the statistical ones."""
    ratios = {
        name: each.combined_std_error / each.statistical_std_error
        for name, each in result.estimates.items()
        if each.combined_std_error and each.statistical_std_error and name in result.budget
    }
    systematic = {name: ratio for name, ratio in ratios.items() if ratio > SYSTEMATIC_RATIO}
    names_by_sources: dict[str, list[str]] = {}
    remedies = []
    for name in sorted(systematic, key=lambda name: -systematic[name])[:SHOWN_BUDGETS]:
        shares = list(result.budget[name].items())[:SHOWN_SOURCES]
        largest = shares[0][0]
        if largest in SHOWN_REMEDIES and largest not in remedies:
            remedies.append(largest)
        sources = ", ".join(
            f"{source_label(s)} {share:.0%}" for s, share in shares if share > SMALLEST_SHOWN_SHARE
        )
        names_by_sources.setdefault(sources, []).append(symbol_of(name))
    return [
        f"largest contributions to the combined uncertainty of {listed(names)}: {sources}"
        for sources, names in names_by_sources.items()
    ] + [
        f"to reduce the contribution of {source_label(source)}: {remedy_for(source)}"
        for source in remedies
    ]


def budget_table(result: Result) -> Table:
    """Return the table of contributions to the variance of each estimate, in percent; sources with
    less than `SMALLEST_SHOWN_SHARE` of every variance are left out.
    """
    lines = result.budget
    shown = main_sources(lines, SMALLEST_SHOWN_SHARE)
    rows = [
        (source_label(s), *(f"{100 * line.get(s, 0):.0f}" for line in lines.values()))
        for s in shown
    ]
    return Table("", ("% of the variance", *map(symbol_of, lines)), rows=tuple(rows))


def effects_table(result: Result) -> Table:
    """Return the table of the effects of the budget: what is expected of each, what the data say, and
    by how many standard deviations both differ; those that the data do not see are left out, and of
    many the largest are shown.
    """
    rows = []
    for each in sorted(result.effects, key=lambda each: -abs(each.surprise)):
        if each.std_error > UNSEEN * each.deviation and abs(each.surprise) < 1.0:
            continue
        unit = effect_row(each.name).unit
        mean, prior, value, error = (
            in_readable_unit(size, unit)[0]
            for size in (each.mean, each.deviation, each.value, each.std_error)
        )
        rows.append(
            (
                f"{source_label(each.name)} {in_readable_unit(1.0, unit)[1].strip()}".rstrip(),
                f"{mean:.2g} ± {prior:.2g}",
                f"{value:+.2g} ± {error:.2g}",
                f"{each.surprise:+.1f}",
            )
        )
    shown = rows[:MOST_EFFECTS]
    first = f"effect ({len(shown)} of {len(rows)})" if len(shown) < len(rows) else "effect"
    heads = (first, "expected", "with the data", "standard deviations")
    return Table("", heads, rows=tuple(shown))


def estimate_row(result: Result, name: str) -> tuple[str, ...]:
    """Return the eight cells of an estimate: name with unit, value, combined standard uncertainty
    and interval, statistical and systematic standard uncertainty, guess, and a remark.

    All numbers have the place of the second significant digit of the combined uncertainty; unknown
    ones are empty. Instead of an interval the cell is "at its bound"; if the estimate has a
    `reason`, which is the remark, it is "not identifiable", or "not determined" without a
    statistical interval. An interval that is wider than the value is followed by "not determined",
    and the value has no ±. Where a combination with other parameters is determined, it replaces
    these words. Instead of the guess of a fixed or tied parameter the cell is "fixed" or
    "tied".
    """
    each = result.estimates[name]
    factor, unit = _readable_unit(result, name)
    deviation, statistical, systematic = (
        None if size is None else factor * size
        for size in (each.combined_std_error, each.statistical_std_error, each.systematic_std_error)
    )
    place = statistical if deviation is None else deviation
    interval = _interval_text(each.combined95, factor, place)
    is_vague = each.combined95 is not None and not each.is_determined
    if each.at_bound:
        interval = "at its bound"
    elif each.reason:
        interval = "not determined" if each.statistical95 is None else "not identifiable"
    elif is_vague:
        interval = f"not determined ({interval})"
    if (is_vague or each.reason) and not each.at_bound:
        interval = _combination_text(result, name) or interval
    guess = "" if each.guess is None else f"{factor * each.guess:.5g}"
    if each.fixed:
        guess = "tied" if each.tied else "fixed"
    return (
        f"{symbol_of(name)} {unit}".strip(),
        rounded(factor * each.value, place),
        "" if is_vague else _deviation_text(deviation),
        interval,
        _deviation_text(statistical),
        _deviation_text(systematic),
        guess,
        each.reason or "",
    )


def _combination_text(result: Result, name: str) -> str:
    for each in result.combinations:
        if name in each.determined.names and not each.is_lone:
            return f"only {each.determined.label} {each.precision()}".rstrip()
    return ""


def _deviation_text(deviation: float | None) -> str:
    """None is unknown."""
    return "" if deviation is None else two_digits(deviation)


def _readable_unit(result: Result, name: str) -> tuple[float, str]:
    """Return factor and name; all moduli have the same unit."""
    if unit_of(name) != "Pa":
        return 1.0, unit_of(name)
    return readable_stress(
        each.value
        for other, each in result.estimates.items()
        if unit_of(other) == "Pa" and (not each.fixed or other == name)
    )


def refinement_table(result: Result) -> Table | Line:
    """Return the table of measured discretisation errors, a line for each estimate that has one:
    the errors of step and mesh with their observed orders, the corrected value and the combined
    interval.

    Unknown numbers are empty; columns without any number are left out. If no estimate has such an
    error, a sentence is returned that no estimate changed; the result must therefore be that of a
    refinement.
    """
    if not result.numerical_errors:
        return Line(
            "No estimate changes with the step or the mesh: every parameter is fixed or at a bound."
        )
    rows = []
    for name, error in result.numerical_errors.items():
        each = result.estimates[name]
        factor, unit = _readable_unit(result, name)
        deviation = each.combined_std_error and factor * each.combined_std_error
        rows.append(
            (
                f"{symbol_of(name)} {unit}".rstrip(),
                "" if error.step is None else f"{factor * error.step:+.2g}",
                "" if error.step_order is None else f"{error.step_order:.1f}",
                "" if error.mesh is None else f"{factor * error.mesh:+.2g}",
                "" if error.mesh_order is None else f"{error.mesh_order:.1f}",
                rounded(factor * each.value, deviation),
                "" if deviation is None else two_digits(deviation),
                _interval_text(each.combined95, factor, deviation),
            )
        )
    columns = ("", "half the step", "order", "half the edges", "order", "corrected", "±")
    kept = [k for k in range(8) if k == 0 or any(row[k] for row in rows)]
    return Table(
        "",
        tuple((*columns, "95 % interval")[k] for k in kept),
        rows=tuple(tuple(row[k] for k in kept) for row in rows),
    )


def _interval_text(ends: tuple[float, float] | None, factor: float, deviation: float | None) -> str:
    """Return scaled ends to the place of a deviation; "" for None."""
    if ends is None:
        return ""
    low, high = (rounded(factor * end, deviation) for end in ends)
    return f"{low} … {high}"


def fit_section(result: Result) -> TitledParts:
    """Return the section "Fit": misfit of the measurements, violation of the equations of motion,
    errors of each forward simulation, elapsed times, iterations, and notes on nuisance parameters.
    """
    fit = result.fit
    experiments = result.fit.experiments
    marked = any(each.samples for each in experiments.values())
    markers = f"markers: {millimetres_text(fit.rms_m)} mm RMS, "
    markers += f"{millimetres_text(fit.noise_rms_m)} mm expected from noise alone; "
    dynamics = (
        f"equations of motion violated by at most {result.dynamics.max_violation_n:.1e} N "
        f"({result.dynamics.max_violation_relative:.1e} of the largest force)"
    )
    lines = [markers * marked + dynamics]
    for name, each in experiments.items():
        is_symmetric = name in (fit.symmetry or {})
        lines += each.lines(name, is_symmetric)
    for name, each in result.rollout.experiments.items():
        lines += _simulation_lines(name, each)
    for parts in sorted({*(fit.symmetry or {}).values()}):
        names = listed(f"'{name}'" for name, each in (fit.symmetry or {}).items() if each == parts)
        lines.append(
            f"loads of {names} are those of the whole specimen, {parts} times those of the "
            "modelled part"
        )
    lines += [f"time: {_elapsed_text(result.elapsed_s)}", _iterations_text(result)]
    for name, each in experiments.items():
        if each.notes:
            lines.append(f"nuisance parameters of '{name}': {'; '.join(each.notes)}")
    return TitledParts("Fit", tuple(lines))


def _elapsed_text(elapsed: Elapsed) -> str:
    parts = {"search": elapsed.search, "checks": elapsed.checks, "pictures": elapsed.pictures}
    known = (f"{part} {time_s:.1f} s" for part, time_s in parts.items() if time_s is not None)
    return ", ".join(known)


def _iterations_text(result: Result) -> str:
    timing = result.timing_s
    return (
        f"{result.iterations} iterations in {timing.total:.1f} s of the search "
        f"(linear algebra {timing.linear_algebra:.1f} s, evaluations {timing.evaluations:.1f} s)"
    )


def _simulation_lines(name: str, simulated: SimulatedExperiment) -> Iterator[str]:
    """Copied measurements, and nuisance parameters fitted to it, compare with a validation."""
    kind = "forward simulation" if simulated.fitted else "validation"
    if simulated.failed is not None:
        yield f"{kind} '{name}': failed: {simulated.failed}"
        return
    units = simulated.reading_unit
    onsets = _deviations_text(simulated.own_onsets)
    yield (
        f"{kind} '{name}': {simulated.text(units) or 'no measurements to compare with'}"
        + (f", with {onsets} from this recording" if onsets else "")
    )
    if simulated.fitted:
        return
    if simulated.own is not None and simulated.own_deviations:
        largest = max(simulated.own_deviations.items(), key=lambda each: abs(each[1]))
        yield (
            f"  if nuisance parameters are fitted to it: {simulated.own.text(units)}, "
            f"with {_deviations_text(dict([largest]))}"
        )
    if simulated.copied is not None:
        copied = simulated.copied
        yield (
            f"  for comparison, the measurements of '{copied.copied}' as the prediction: "
            f"{copied.error.text(units)}"
        )
    elif simulated.not_copied:
        yield f"  no comparison with measurements of another recording: {simulated.not_copied}"


def _deviations_text(deviations: Mapping[str, float] | None) -> str:
    return listed(
        f"'{name}' at {size:+.2g} standard deviations" for name, size in (deviations or {}).items()
    )


def millimetres_text(metres: float) -> str:
    """Return a length [m] as text in millimetres, without the unit."""
    return f"{1e3 * metres:.3f}"


def notes_section(result: Result) -> TitledParts:
    """Return the notes of a run as a section, without those that the reasons of the verdict and the
    remarks on the parameters state already.
    """
    codes = [concern.code for concern in result.trust.concerns]
    is_judged = any(code.startswith(REASONS_OF_RESIDUALS) for code in codes)
    stated = {each.statement() for each in result.combinations}
    notes = [
        note
        for note in result.notes
        if note not in stated and not (is_judged and note.startswith("the residuals "))
    ]
    return TitledParts("Notes", tuple(f"note: {note}" for note in notes))


# What the page alone has --------------------------------------------------------------------------


def _cards(result: Result) -> Cards:
    values = result.estimates
    fit = result.fit
    simulated = result.rollout
    first = next((key for key in STIFFNESS_NAMES if key in values), next(iter(values)))
    free = (name for name, each in result.parameters.items() if not each.fixed)
    cards = []
    for name in dict.fromkeys((first, *free)):
        interval = values[name].combined95
        factor, unit = _readable_unit(result, name)
        value = f"{number(factor * values[name].value, 4)} {unit}"
        known = "no error bar"
        if interval is not None:
            low, high = (number(factor * end, 4) for end in interval)
            known = f"{low} to {high} (95 %)"
        cards.append((symbol_of(name), value.strip(), known))
    if any(each.samples for each in fit.experiments.values()):
        alone = f"RMS; expected from noise alone: {millimetres(fit.noise_rms_m)}"
        cards.append(("markers, fitted", millimetres(fit.rms_m), alone))
        most = f"RMS; {millimetres(simulated.max_m)} at most"
        cards.append(("markers, forward simulation", millimetres(simulated.rms_m), most))
    elif (uncertainty := result.uncertainty) is not None:
        ratio = number(uncertainty.reduced_chi_squared, 3)
        cards.append(("reduced χ²", ratio, "1 expected from the stated noise"))
    if fit.wrench_rms_n is not None:
        cards.append(("force, fitted", f"{number(fit.wrench_rms_n, 3)} N", "RMS"))
    return Cards(tuple(cards))


def remedy_lines(concerns: Iterable[Concern]) -> Iterator[Line]:
    """Yield a line for each topic of the concerns: meaning, remedy, and documentation."""
    for name, topic in topics_of(concerns).items():
        about = Span(f"{topic.title}.", "strong")
        command = Span(explain_command(topic.page), "code")
        more = [Span(f" {topic.remedy} More: "), command]
        if (url := page_url(topic.page)) is not None:
            more += [Span(", or "), Span("the documentation", to=url)]
        yield Line((about, *more, Span(".")), name=f"cure-{name}")


def _error_bars(result: Result) -> Iterator[Shown]:
    if (known := result.uncertainty) is not None:
        yield (
            f"Error bars for {known.errors} errors, noise level {known.noise}; reduced χ² "
            f"{number(known.reduced_chi_squared, 3)}."
        )
    if result.budget:
        yield budget_table(result)


def _marker_place_sections(result: Result) -> Iterator[TitledParts]:
    explanation = (
        "Positions on the undeformed body in millimetres, each with its standard error. "
        "Positions that were not given have a prior as wide as the body."
    )
    for experiment, places in result.places.items():
        rows = []
        for marker, place in places.items():
            errors_m = [None] * 3 if place.std_error_m is None else place.std_error_m
            cells = []
            for x, error in zip(place.position_m, errors_m, strict=True):
                cells += [f"{1e3 * x:.2f}", "–" if error is None else number(1e3 * error, 2)]
            prior = "exact" if place.prior_m == 0 else _size_text(place.prior_m, "m")
            rows.append((marker, *cells, prior, "" if place.is_declared else "not given"))
        heads = ("", "x", "±", "y", "±", "z", "±", "prior ±", "")
        if rows:
            table = Table("", heads, rows=tuple(rows), texts=1)
            title = f"Positions of the markers of '{experiment}'"
            yield TitledParts(title, (Line(explanation, "quiet"), table))


def _nuisance_sections(result: Result) -> Iterator[TitledParts]:
    explanation = (
        "Estimated for this recording alone, together with the parameters; the prior has a mean "
        "of zero."
    )
    for experiment, named in result.nuisance.items():
        rows = []
        for label, each in named.items():
            words, _, unit = label.rstrip("]").rpartition(" [")
            value = 0.0 if abs(each.value) <= UNMOVED * each.prior else each.value  # rounding
            sizes = (value, each.std_error, each.prior)
            rows.append((words, *(_size_text(size, unit) for size in sizes)))
        table = Table("", ("", "value", "±", "prior ±"), rows=tuple(rows))
        title = f"Nuisance parameters of '{experiment}'"
        is_part = experiment in (result.fit.symmetry or {})
        loads = " Forces are those of the modelled part." if is_part else ""
        yield TitledParts(title, (Line(explanation + loads, "quiet"), table))


def _residual_tables(result: Result, run: Path) -> Iterator[Shown]:
    if result.residuals:
        rows = tuple(
            (
                f"{each.experiment}/{each.marker}",
                millimetres(each.rms_m),
                str(each.samples),
                each.sentence.partition(": ")[2] or each.sentence,
            )
            for each in result.residuals
        )
        yield Table("", ("marker", "RMS", "samples", "diagnosis"), rows=rows, texts=1)
    if worst := _largest_errors(run):
        rows = tuple((w, f"{number(t_s, 4)} s", millimetres(m)) for m, t_s, w in worst)
        yield from ("Largest errors:", Table("", ("marker", "time", "error"), rows=rows))


def _largest_errors(run: Path) -> list[tuple[float, float, str]]:
    """Return the largest marker residuals as (error [m], time [s], marker)."""
    arrays = read_arrays(run)
    worst = []
    for key in (key for key in arrays if key.rpartition("/")[2] == "residuals_m"):
        prefix = key.removesuffix("residuals_m")
        t_s = arrays[f"{prefix}t_s"]
        markers = arrays[f"{prefix}marker_names"]
        shape = (len(t_s), len(markers), 3)
        residuals_m = arrays[key]
        largest = float(np.nanmax(np.abs(residuals_m), initial=0.0))
        if residuals_m.shape != shape:
            raise ValueError(
                f"{key} has the shape {residuals_m.shape}; its times and markers need {shape}"
            )
        if largest > LARGEST_NUMBER:
            raise ValueError(f"{key} contains numbers above {LARGEST_NUMBER:g}")
        errors = np.sqrt(np.nansum(residuals_m**2, axis=2))
        for _ in range(SHOWN_ERRORS if errors.size else 0):
            t, m = np.unravel_index(int(errors.argmax()), errors.shape)
            if not errors[t, m] > 0:
                break
            worst.append((float(errors[t, m]), float(t_s[t]), f"{prefix}{markers[m]}"))
            errors[max(0, t - ERROR_SPACING_SAMPLES) : t + ERROR_SPACING_SAMPLES + 1, m] = 0
    return sorted(worst, key=lambda each: -each[0])[:SHOWN_ERRORS]


def _provenance_parts(result: Result, run: Path) -> Iterator[Shown]:
    """A copy of the problem file that is a link to elsewhere is left out."""
    rows = content(result.problem) | content(result.provenance)
    listed_rows = ((key, each if isinstance(each, list) else [each]) for key, each in rows.items())
    yield Table(
        "", (), rows=tuple((key, ", ".join(map(str, each))) for key, each in listed_rows), texts=1
    )
    file = run / "problem.toml"
    if is_own(run, file):
        yield Listing("The problem file as run", file.read_text(encoding="utf-8"))


def _size_text(value: float | None, unit: str) -> str:
    """Return "1.2 mm" for 0.0012 in "m"; unknown units are kept, and None becomes "–"."""
    factor, shown = in_readable_unit(1.0, unit)
    # No powers of ten for the sizes of bodies.
    digits = 2 if value is None or abs(factor * value) < 99.5 else 4
    return "–" if value is None else f"{number(factor * value, digits)}{shown}"
