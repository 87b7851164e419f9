"""Summary of a run for the terminal: what a person acts on, in about sixteen lines."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..common.display import Line, Shown, Table, flattened_parts, number, quantity
from ..errors import listed
from ..features.measurements import SimulatedExperiment
from ..fem.laws.constants import (
    INSTANTANEOUS,
    KAPPA,
    POISSON,
    is_damping,
    symbol_of,
    unit_of,
    without_region,
)
from ..methods.starts.start import NO_GUESS
from ..runs.result_content import Result
from ..statistics.budget.systematic_effects import source_label
from ..statistics.combinations import WIDE, precision_text
from ..statistics.hypothesis import NO_CAUSE
from .run_sections import (
    STIFFNESS_NAMES,
    budget_table,
    effects_table,
    estimate_row,
    estimate_sections,
    fit_section,
    millimetres_text,
    notes_section,
    outcome_section,
    remedy_command,
    stated_as_undetermined,
    verdict_section,
)

# Derived moduli in the summary; others are in the details.
SHOWN_MODULI = ("young_pa", "poisson", INSTANTANEOUS.name)
# Lines of the summary, with those of the folder and the next step, as far as one reason leaves them,
# and most reasons of the verdict, gravest first.
MOST_LINES = 16
SHOWN_REASONS = 5
# Sources of uncertainty in the summary, and the smallest share of a variance that counts.
SHOWN_SOURCES = 3
SMALLEST_SHOWN_SHARE = 0.01


def run_summary(
    result: Result, folder: Path | None = None, details: bool = False, budget: bool = False
) -> list[Shown]:
    """Return verdict with reasons, estimates, what limits them, what they are relative to, and the
    quality of the fit.

    Parameters
    ----------
    result : Result
        Content of ``result.json``.
    folder : Path, optional
        The run folder, which the last line names; no such line by default.
    details : bool
        Whether everything that the report has in words and tables follows: statistical and
        systematic parts, corrections, notes, residuals, and times.
    budget : bool
        Whether to add the complete tables of contributions to each variance and of effects, if there
        is a budget.
    """
    tables = [budget_table(result), effects_table(result)] if budget and result.budget else []
    written = [] if folder is None else [f"written to {folder}"]
    return [*(_details(result) if details else _brief(result)), *tables, *written]


def next_step(result: Result, folder: Path) -> str:
    """Return the command that makes most sense after a solve, with its purpose.

    Parameters
    ----------
    result : Result
        Content of ``result.json``.
    """
    program = "collocation-sysid"
    run = shlex.quote(str(folder))
    refinable = _has_mesh(result) and result.budget and result.provenance.problem_file is not None
    if result.trust.verdict == "good" and refinable and "mesh" not in (result.discretisation_kinds):
        is_estimated = any("mesh" in shares for shares in result.budget.values())
        in_intervals = "contain as an estimate" if is_estimated else "do not contain"
        return (
            f"{program} refine {run} (measures the mesh error, which the intervals {in_intervals})"
        )
    return f"{program} report {run} (everything on one page)"


def _brief(result: Result) -> list[Shown]:
    outcome = [] if result.converged else [*flattened_parts([outcome_section(result)])]
    others = [
        *remedy_command(result.trust.concerns),
        *(Line(note, "quiet") for note in result.notes if note.startswith(NO_CAUSE)),
        *_start(result),
        *_estimates(result),
        *_limit(result),
        *_basis(result),
        *_fit(result),
    ]
    taken = sum(1 + len(e.rows) if isinstance(e, Table) else 1 for e in (*outcome, *others))
    # Beside verdict, further reasons, folder and next step.
    shown = min(SHOWN_REASONS, max(1, MOST_LINES - 4 - taken))
    verdict = flattened_parts([verdict_section(result.trust, max_reasons=shown)])
    return [*outcome, *verdict, *_further_reasons(result, shown), *others]


def _further_reasons(result: Result, shown: int) -> Iterator[Line]:
    if (count := len(result.trust.concerns) - shown) > 0:
        further = "1 further reason" if count == 1 else f"{count} further reasons"
        yield Line(f"  {further}, less grave: in the report, and with --details", "quiet")


def _start(result: Result) -> Iterator[Line]:
    """Yield where the search began if that is not the stated guess."""
    if result.scan is not None and result.scan.reason != NO_GUESS:
        yield Line(f"note: {result.scan.sentence}", "quiet")


def _details(result: Result) -> list[Shown]:
    sections = (
        outcome_section(result),
        *estimate_sections(result),
        fit_section(result),
        notes_section(result),
    )
    ended = [f"residuals: {each.sentence}" for each in result.residuals]
    return [*flattened_parts(sections), *ended]


def _estimates(result: Result) -> Iterator[Shown]:
    values = result.estimates
    shown = [
        name for name in values if name in result.parameters or without_region(name) in SHOWN_MODULI
    ]
    fixed = [name for name in shown if values[name].fixed and not values[name].tied]
    free = [name for name in shown if name not in fixed]
    if KAPPA.name in fixed:  # which alone determines how nearly ν is one half
        free = [name for name in free if name != POISSON.name or name in result.parameters]
    if not _has_mesh(result):
        fixed = [name for name in fixed if not is_damping(name)]
    if free:
        rows = []
        for name in free:
            symbol, value, deviation, interval, statistical, _, guess, _ = estimate_row(
                result, name
            )
            rows.append(
                (symbol, value, deviation, interval or guess * (guess == "tied"), statistical)
            )
        yield Table("", ("", "value", "±", "95 % interval", "± stat"), rows=tuple(rows))
    if fixed:
        stated = (
            f"{symbol_of(name)} {quantity(values[name].value, unit_of(name), digits=5)}"
            for name in fixed
        )
        yield f"fixed: {', '.join(stated)}"
    yield from (field.sentence(name) for name, field in result.fields.items())


def _has_mesh(result: Result) -> bool:
    """Return false for homogeneous specimens alone."""
    return any(each.test is None for each in result.fit.experiments.values())


def _limit(result: Result) -> Iterator[str]:
    """Name what to measure for undetermined estimates, or else for the most important stiffness."""
    if result.combinations:
        best, *others = result.combinations
        more = f" (and {len(others)} more: see --details)" if others else ""
        yield best.statement(most=1) + more
    stated = stated_as_undetermined(result)
    combined = {name for each in result.combinations for name in each.determined.names}
    limits = result.limits
    if not limits:
        return
    shown = [
        name
        for name, limit in limits.items()
        if not (limit.determined or name in stated or name in combined)
        and (name in result.parameters or without_region(name) in SHOWN_MODULI)
    ]
    stiffness = next((name for name in STIFFNESS_NAMES if name in limits), next(iter(limits)))
    name = next(iter(shown), stiffness)
    limit = limits[name]
    sources = [
        f"{source_label(source)} {share:.0%}"
        for source, share in [*result.budget[name].items()][:SHOWN_SOURCES]
        if share > SMALLEST_SHOWN_SHARE
    ]
    subject = f"variance of {symbol_of(name)}: {', '.join(sources)}"
    if shown:
        subject = f"not determined: {listed(map(symbol_of, shown))}; {subject}"
    remedy = f"to reduce {source_label(limit.source)}, {limit.remedy}"
    yield f"{subject}; {remedy}{effect_of_remedy(result, name)}"


def effect_of_remedy(result: Result, name: str) -> str:
    """Return the effect on an estimate of knowing what its largest source stands for; "" unless
    this determines it.
    """
    estimate = result.estimates[name]
    if estimate.is_determined or estimate.combined95 is None or estimate.combined95[0] <= 0:
        return ""
    lower, upper = estimate.combined95
    factor = (upper / lower) ** (0.5 * np.sqrt(max(0.0, 1 - result.limits[name].share)))
    if factor >= WIDE:
        return ""
    return f": {symbol_of(name)} would then be determined {precision_text(factor)}"


def _basis(result: Result) -> list[str]:
    return ["; ".join(result.basis)] if result.basis else []


def _fit(result: Result) -> Iterator[Shown]:
    fitted = result.fit.experiments
    simulated = result.rollout.experiments
    quality = []
    if any(each.samples for each in fitted.values()):
        noise = millimetres_text(result.fit.noise_rms_m)
        quality.append(
            f"markers {millimetres_text(result.fit.rms_m)} mm RMS ({noise} mm expected from noise)"
        )
    if result.uncertainty is not None:
        quality.append(f"reduced χ² {number(result.uncertainty.reduced_chi_squared, 3)}")
    if len(simulated) == 1:
        (name,) = simulated
        errors = replace(fitted[name], rms_m=None).text(fitted[name].reading_unit)
        own = [errors] if errors else []
        prediction = _simulation_text(simulated[name])
        if errors == prediction:  # as of equilibria
            prediction = "the same"
        yield f"fit: {', '.join([*quality, *own])}; forward simulation: {prediction}"
        return
    if quality:
        yield f"fit: {', '.join(quality)}"
    rows = tuple(
        (
            name,
            fitted[name].text(fitted[name].reading_unit) if name in fitted else "validation",
            _simulation_text(each),
        )
        for name, each in simulated.items()
    )
    yield Table("", ("recording", "fit", "forward simulation"), rows=rows, names=3)


def _simulation_text(simulated: SimulatedExperiment) -> str:
    if simulated.failed is not None:
        return f"failed: {simulated.failed}"
    text = simulated.text(simulated.reading_unit) or "no measurements to compare with"
    if simulated.copied is not None:
        copied = simulated.copied.error.text(simulated.reading_unit)
        text += f" (measurements of '{simulated.copied.copied}' as the prediction: {copied})"
    return text
