"""What probes say: a table of refits, and in a sentence or two what to make of them."""

from __future__ import annotations

from collections.abc import Iterator

from ..display import Section, Table, short
from ..errors import listed
from ..fem.constants import symbol_of
from ..runs.result import Result
from ..statistics.budget import worded
from ..statistics.probes import Move, Probe

# Estimates in the table, what tells stiffness first.
FOREMOST, SHOWN = ("young_pa", "mu_pa", "kappa_pa", "lambda_pa"), 4
# Topics of a verdict about which parts of the data and freed assumptions say more.
ASKING = ("residuals", "noise", "roll-out", "nuisance")


def probe_section(result: Result) -> Section:
    """The table and its sentences; nothing where no probes were asked for."""
    if not result.probes:
        return Section("Probes", ())
    names = _shown(result)
    heads = ("refit", "−Δχ²", "size", *map(symbol_of, names))
    rows = [
        (
            worded(p.name) if p.kind == "assumption" else p.name,
            f"{p.chi_squared:.1f}",
            "" if p.size is None else f"{short(p.size)} ± {short(p.size_error or 0.0)}",
            *(_moved(p.moves.get(name), result.values[name].value) for name in names),
        )
        for p in result.probes
    ]
    read = (
        "in brackets the changes in half widths of the statistical and of the combined interval; of parts of "
        "the data to first order"
    )
    return Section("Probes", (Table("", heads, tuple(rows), texts=1), read, *_said(result)))


def asks_for_probes(result: Result) -> bool:
    """Whether a verdict, or a budget, is asked to look harder."""
    wide = any(
        each.combined_std_error
        and each.statistical_std_error
        and each.combined_std_error > 2 * each.statistical_std_error
        for each in result.values.values()
    )
    asked = any(concern.topic in ASKING for concern in result.trust.concerns)
    return bool(result.budget) and not result.probes and (asked or wide)


def _shown(result: Result) -> list[str]:
    """The estimates of the table."""
    known = [n for n, each in result.values.items() if each.statistical95]
    first = [name for name in known if name in FOREMOST[:1]]
    return [*first, *(n for n in known if n in result.parameters and n not in first)][:SHOWN]


def _moved(move: Move | None, value: float) -> str:
    if move is None:
        return "–"
    shares = ", ".join(
        f"{x:+.1f}" for x in (move.of_statistical95, move.of_combined95) if x is not None
    )
    return f"{_change(move, value)} ({shares})"


def _change(move: Move, value: float) -> str:
    return f"{100 * move.change / abs(value):+.2f} %" if value else f"{move.change:+.2g}"


def _said(result: Result) -> Iterator[str]:
    """What is told by windows, recordings and assumptions, or that nothing is."""
    told = [probe for probe in result.probes if probe.told]
    freed = sorted((p for p in told if p.kind == "assumption"), key=lambda p: -p.chi_squared)
    for kind in ("window", "recording"):
        apart = [p for p in told if p.kind == kind]
        if apart:
            said = (f"{p.name}: {listed(_goes(p, result, n) for n in p.told)}" for p in apart)
            yield f"{kind}s disagree, beyond chance ({'; '.join(said)})"
    if freed:
        first, names = freed[0], _shown(result)
        moved = [_goes(first, result, n) for n in names if n in first.moves][:2]
        size, error = short(first.size or 0.0), short(first.size_error or 0.0)
        yield (
            f"the data tell {worded(first.name)}: {size} ± {error}, with which χ² falls by "
            f"{first.chi_squared:.3g} and {listed(moved)} follow: measure it, or estimate it"
        )
        if others := [f"{worded(p.name)} ({p.chi_squared:.3g})" for p in freed[1:]]:
            yield f"instead of it also {listed(others)}: one cause may look like another"
    elif not told:
        yield "no part of the data, and no assumption that is freed, fits better than by chance"
    yield from _matters(result)


def _goes(probe: Probe, result: Result, name: str) -> str:
    return f"{symbol_of(name)} {_change(probe.moves[name], result.values[name].value)}"


def _matters(result: Result) -> Iterator[str]:
    """The assumption that the data do not tell and that matters most to what tells stiffness."""
    told = {name.partition(" ")[0] for p in result.probes for name in p.told}
    rows = {p.name.partition(" ")[0] for p in result.probes if p.kind == "assumption"} - told
    for name in (n for n in (*FOREMOST, *result.parameters) if n in result.budget):
        source = next((s for s in result.budget[name] if s in rows), None)
        if source is not None:
            share = result.budget[name][source]
            yield (
                f"of those that the data do not tell {worded(source)} would matter most: "
                f"{share:.0%} of {symbol_of(name)}'s variance"
            )
            return
