"""Probes of a run as a table of refits with conclusions, and when a deeper check is worthwhile."""

from __future__ import annotations

from collections.abc import Iterator

from ..common.display import Table, TitledParts, predicted_change, short
from ..errors import listed
from ..fem.laws.constants import symbol_of
from ..runs.result_content import Result
from ..statistics.budget.variance_sources import source_label
from ..statistics.probes.relaxed_assumptions import EstimateChange, Probe, assumption_name
from ..statistics.probes.routine import is_possible
from ..statistics.thresholds import SIGNIFICANT_ALONE

# Measures of stiffness, the most important first.
STIFFNESS_NAMES = ("young_pa", "mu_pa", "kappa_pa", "lambda_pa")
# Estimates that have columns in the table.
MAX_ESTIMATES = 4
# Concerns that relaxed assumptions and parts of the data can explain: residuals that are not noise,
# or predictions that miss. A description that is wrong is none: it is to be corrected first.
EXPLICABLE_CONCERNS = (
    "assumption/contradicted",
    "noise/larger",
    "residuals/persist",
    "residuals/recordings",
    "residuals/shared",
    "roll-out/predicted",
    "specimen/law",
    "specimen/branches",
    "specimen/persist",
)
# Topics of a verdict that come first.
FIRST_TO_CORRECT = ("description", "solve")
DEEPER_CHECK_ADVICE = (
    "For a deeper check, run `solve --probe` (in Python `cs.run(problem, probe=True)`): it refits "
    "subsets of the data and relaxes each assumption."
)


def probe_section(result: Result) -> TitledParts:
    """Return the table of all probes with its conclusions; a section without parts if there are no
    probes.
    """
    if not result.probes:
        return TitledParts("Probes", ())
    names = _shown_estimates(result)
    heads = ("refit", "−Δχ²", "size", *map(symbol_of, names))
    rows = [
        (
            source_label(p.name) if p.kind == "assumption" else p.name,
            f"{p.chi_squared:.1f}",
            "" if p.size is None else f"{short(p.size)} ± {short(p.size_error or 0.0)}",
            *(
                _change_with_ratios(p.moves.get(name), result.estimates[name].value)
                for name in names
            ),
        )
        for p in result.probes
    ]
    read = (
        "Changes of the estimates, in parentheses relative to the half widths of the statistical "
        "and of the combined interval. They are first-order estimates, except those of "
        "significant assumptions."
    )
    return TitledParts(
        "Probes", (Table("", heads, rows=tuple(rows), texts=1), read, *_conclusions(result))
    )


def probe_lines(result: Result) -> list[str | Table]:
    """Return the table of the probes, how to read it, and their conclusions, for a terminal.

    After the probes of every solve alone, if none is significant or the verdict is "good" because
    the budget contains their effects, only the conclusions are returned. Empty without probes.
    """
    is_found = any(probe.sentences for probe in result.probes)
    if is_routine(result) and (not is_found or result.trust.verdict == "good"):
        return [*_conclusions(result)] if result.probes else []
    return [each for each in probe_section(result).parts if isinstance(each, (str, Table))]


def _largest_probes(result: Result) -> list[Probe]:
    """Return the most significant probe of each assumption, in their order."""
    largest: dict[str, Probe] = {}
    for probe in result.probes:
        name = assumption_name(probe.name)
        if name not in largest or _ratio(probe) > _ratio(largest[name]):
            largest[name] = probe
    return list(largest.values())


def is_another_effect(result: Result) -> bool:
    """Return whether the assumption that decreases χ² most is relaxed as no body can be: another
    effect, which no probe has, resembles it.
    """
    found = _found_assumptions(result)
    return bool(found) and not is_possible(found[0])


def _found_assumptions(result: Result) -> list[Probe]:
    """Return the significant relaxed assumptions, that which decreases χ² most first."""
    found = [p for p in result.probes if p.sentences and p.kind == "assumption"]
    return sorted(found, key=lambda probe: -probe.chi_squared)


def _ratio(probe: Probe) -> float:
    """Return the absolute size of a relaxed assumption over its standard error; 0 without one."""
    return abs(probe.size or 0.0) / probe.size_error if probe.size_error else 0.0


def is_routine(result: Result) -> bool:
    """Return whether only the probes of every solve were made, not those of a deeper check; true if
    there are no probes.
    """
    return all(probe.routine for probe in result.probes)


def is_deeper_check_worthwhile(result: Result) -> bool:
    """Return whether `solve --probe` may explain the concerns of the verdict.

    It may if the residuals, a prediction or a routine probe contradict the model, a budget exists,
    a deeper check has not been made yet, and nothing else has to be corrected first. A wide
    combined interval does not count, because its budget already says what to measure.
    """
    concerns = result.trust.concerns
    if not result.budget or not is_routine(result):
        return False
    if is_first_to_correct(result):
        return False
    return any(concern.code in EXPLICABLE_CONCERNS for concern in concerns)


def is_first_to_correct(result: Result) -> bool:
    """Return whether the verdict has a reason that is to be corrected before assumptions are relaxed:
    the description, or the search.
    """
    return any(concern.topic in FIRST_TO_CORRECT for concern in result.trust.concerns)


def _shown_estimates(result: Result) -> list[str]:
    known = [n for n, each in result.estimates.items() if each.statistical95]
    first = [name for name in known if name in STIFFNESS_NAMES[:1]]
    return [*first, *(n for n in known if n in result.parameters and n not in first)][
        :MAX_ESTIMATES
    ]


def _change_with_ratios(move: EstimateChange | None, value: float) -> str:
    """Ratios are to the half widths of the statistical and of the combined interval."""
    if move is None:
        return "–"
    shares = ", ".join(
        f"{x:+.1f}" for x in (move.of_statistical95, move.of_combined95) if x is not None
    )
    return f"{_change_text(move, value)} ({shares})"


def _change_text(move: EstimateChange, value: float) -> str:
    if not value:
        return f"{move.change:+.2g}"
    change = move.change / abs(value)
    return predicted_change(change, f"{100 * change:+.2f} %")


def _conclusions(result: Result) -> Iterator[str]:
    """Name windows and recordings first, then the assumption that reduces χ² most."""
    significant = [probe for probe in result.probes if probe.sentences]
    assumptions = _found_assumptions(result)
    is_good = result.trust.verdict == "good"
    relaxed = [p for p in assumptions if is_possible(p) and not is_good]
    for kind in ("window", "recording"):
        disagreeing = [p for p in significant if p.kind == kind]
        if disagreeing:
            changes = (
                f"{p.name}: {listed(_named_change(p, result, name=n) for n in p.sentences)}"
                for p in disagreeing
            )
            yield f"{kind}s disagree significantly ({'; '.join(changes)})"
    if is_another_effect(result):
        less = listed(f"{source_label(p.name)} ({p.chi_squared:.3g})" for p in relaxed)
        yield (
            f"χ² would decrease by {assumptions[0].chi_squared:.3g} with memory of a negative share, "
            "which no material has: this is another effect, not memory"
            + (f"; by less with {less}" if less else "")
        )
    elif relaxed:
        first, *others = relaxed
        alternatives = listed(f"{source_label(p.name)} ({p.chi_squared:.3g})" for p in others)
        names = _shown_estimates(result)
        moved = [_named_change(first, result, name=n) for n in names if n in first.moves][:2]
        size = short(first.size or 0.0)
        error = short(first.size_error or 0.0)
        yield (
            f"the data determine {source_label(first.name)}: with {size} ± {error}, χ² decreases "
            f"by {first.chi_squared:.3g}"
            + (f" and the estimates change by {listed(moved)}" if moved else "")
            + "; measure it, or estimate it"
            + (f" (alternative explanations: {alternatives})" if alternatives else "")
        )
    elif not significant and is_routine(result):
        tested = listed(source_label(probe.name) for probe in _largest_probes(result))
        first = max(result.probes, key=lambda probe: probe.chi_squared)
        # Of independent residuals, the decrease is the square of the ratio.
        why = "not significant because the residuals are not independent"
        if _ratio(first) ** 2 > first.chi_squared / 2:
            why = "explained as well by deviations that the uncertainty budget grants"
        reason = (
            f"; χ² decreases by {first.chi_squared:.3g} with {source_label(first.name)}, which is {why}"
            if first.chi_squared > SIGNIFICANT_ALONE
            else ""
        )
        yield f"tested without a finding: {tested}{reason}"
    elif not significant:
        yield "no subset of the data and no relaxed assumption changes the fit significantly"
    if not is_routine(result):
        yield from _most_important_assumption(result)


def _named_change(probe: Probe, result: Result, name: str) -> str:
    return f"{symbol_of(name)} {_change_text(probe.moves[name], result.estimates[name].value)}"


def _most_important_assumption(result: Result) -> Iterator[str]:
    """Name the largest share in the budget of the first parameter, stiffnesses first."""
    significant = {assumption_name(name) for p in result.probes for name in p.sentences}
    undetermined = {
        assumption_name(p.name) for p in result.probes if p.kind == "assumption"
    } - significant
    for name in (n for n in (*STIFFNESS_NAMES, *result.parameters) if n in result.budget):
        source = next((s for s in result.budget[name] if s in undetermined), None)
        if source is not None:
            share = result.budget[name][source]
            yield (
                f"of the assumptions that the data do not determine, {source_label(source)} "
                f"contributes most: {share:.0%} of the variance of {symbol_of(name)}"
            )
            return
