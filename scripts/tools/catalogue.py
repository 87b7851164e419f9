"""Catalogue of identified materials: its entries, and the page that shows them.

`make_catalogue.py` writes the entries as JSON, and the page from the same entries.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite

from collocation_sysid.fem.laws.constants import symbol_of

# Readable units: smallest magnitude, factor from the SI unit, and name; the largest first.
READABLE_UNITS = {
    "Pa": ((1e6, 1e-6, "MPa"), (1e3, 1e-3, "kPa"), (0.0, 1.0, "Pa")),
    "s": ((1.0, 1.0, "s"), (0.0, 1e3, "ms")),
}
INTRODUCTION = """# Catalogue of identified materials

This page lists the materials that the shipped problems identify, from measured data and from
simulated recordings (*twins*). The file [catalogue.json](catalogue.json) has the same entries in SI
units, with all reasons of the verdicts. `scripts/tools/make_catalogue.py` writes both files. Symbols
of constants are explained on the page [materials](howto/material.md).

**Verdict.** With the verdict "doubtful" model and data do not agree, and the constants describe only
the recordings of the entry.

**Range of validity.** The data do not support the constants outside the stated principal stretches
and strain rates (of Green's strain). An entry states the 5 % quantile of the smallest stretch and the
95 % quantile of the largest one over the volume and all samples, and in brackets both extremes; then
the 95 % quantile of the strain rate and its largest value, unless the samples are equilibria.

**Intervals** are combined 95 % intervals ([budget](howto/budget.md)). A constant without an interval
was stated in the problem, or the column "note" gives the reason. **Licences** are those of the
recordings ([licences](licences.md)).
"""


@dataclass(frozen=True)
class QuantileRange:
    """Quantiles and extremes of a quantity over a body and its samples."""

    low: float  # 5 % quantile of the smallest value at each point, and 95 % quantile of the largest
    # 5 % quantile of the smallest value at each point, and 95 % quantile of the largest.
    high: float
    minimum: float
    maximum: float


@dataclass(frozen=True)
class IdentifiedConstant:
    """One constant of a body, as an entry of the catalogue."""

    name: str  # name in problem files, with its unit
    unit: str  # unit of the values; "1" for ratios
    value: float
    # Combined 95 % interval; None if the constant was stated, or has no interval.
    combined95: tuple[float, float] | None
    is_stated: bool  # whether the constant was stated in the problem, not estimated
    # Whether the constant follows from the parameters, such as Young's modulus at small strain.
    is_derived: bool
    reason: str | None  # why an estimated constant has no interval
    true_value: float | None  # value with which a recording was simulated; None for measured data


@dataclass(frozen=True)
class CatalogueEntry:
    """One identified material."""

    # See `CatalogueSource`.
    name: str
    problem: str
    specimen: str
    source: str
    licence: str
    is_measured: bool
    law: tuple[str, ...]  # material law of each region, with the number of memory branches
    damping: tuple[str, ...]  # damping law of each region; empty if every recording is static
    constants: tuple[IdentifiedConstant, ...]  # parameters, then derived moduli
    stretch: QuantileRange  # principal stretches
    # Magnitude of the principal rates of Green's strain [1/s]; None for equilibria without times.
    strain_rate_1_s: QuantileRange | None
    verdict: str  # "good", "check" or "doubtful"
    reasons: tuple[str, ...]  # reasons of the verdict
    recordings: tuple[str, ...]  # names of the fitted recordings
    # Version of the program and checksum of the problem file.
    version: str
    problem_sha256: str


@dataclass(frozen=True)
class Omission:
    """A problem that is missing from the catalogue, with the reason."""

    name: str
    problem: str
    reason: str


@dataclass(frozen=True)
class Catalogue:
    """All entries, and the problems without one."""

    version: str
    entries: tuple[CatalogueEntry, ...]
    omitted: tuple[Omission, ...]


def catalogue_page(catalogue: Catalogue) -> str:
    """Return the page of the catalogue as Markdown."""
    parts = [INTRODUCTION]
    for is_measured, heading in ((True, "Measured materials"), (False, "Twins")):
        entries = [each for each in catalogue.entries if each.is_measured is is_measured]
        if entries:
            parts += [f"## {heading}\n", _overview(entries) + "\n", *map(_section, entries)]
    if catalogue.omitted:
        parts.append("## Problems without an entry\n")
        parts.append(
            "\n".join(f"- `{each.problem}`: {each.reason}" for each in catalogue.omitted) + "\n"
        )
    return "\n".join(parts)


def _overview(entries: Sequence[CatalogueEntry]) -> str:
    """Return a table with one row per entry."""
    rows = []
    for entry in entries:
        moduli = [each for each in entry.constants if each.name.endswith("young_pa")]
        shown = moduli or [each for each in entry.constants if not each.is_stated][:1]
        rows.append(
            {
                "specimen": f"[{entry.specimen}](#{entry.name})",
                "law": ", ".join(entry.law),
                "stiffness": "; ".join(f"{symbol_of(e.name)} {_with_interval(e)}" for e in shown),
                "stretch": f"{entry.stretch.low:.3g} to {entry.stretch.high:.3g}",
                "rate 1/s": _rate(entry.strain_rate_1_s),
                "verdict": entry.verdict,
                "licence": entry.licence,
            }
        )
    heads = ("specimen", "law", "stiffness", "stretch", "rate 1/s", "verdict", "licence")
    return _table(heads, rows)


def _section(entry: CatalogueEntry) -> str:
    """Return the section of an entry: its constants, ranges, verdict and source."""
    has_truth = any(each.true_value is not None for each in entry.constants)
    rows = [_constant_row(each) for each in entry.constants]
    heads = ("constant", "unit", "value", "combined 95 % interval", "true value", "note")
    shown = [head for head in heads if head != "true value" or has_truth]
    stretch = entry.stretch
    lines = [
        f"### {entry.name}\n",
        f"{entry.specimen[0].upper()}{entry.specimen[1:]}. Law: {', '.join(entry.law)}"
        + (f"; damping: {', '.join(entry.damping)}" if entry.damping else "")
        + f". Problem: `{entry.problem}`.\n",
        _table(shown, rows) + "\n",
        f"- Stretch: {stretch.low:.4g} to {stretch.high:.4g} ({stretch.minimum:.4g}, "
        f"{stretch.maximum:.4g}){_rate_words(entry.strain_rate_1_s)}.",
        f"- Verdict: **{entry.verdict}**"
        + "".join(f"; {reason.rpartition(': ')[0] or reason}" for reason in entry.reasons)
        + ".",
        f"- Source: {entry.source}. Licence: {entry.licence}.\n",
    ]
    return "\n".join(lines)


def _constant_row(constant: IdentifiedConstant) -> dict[str, str]:
    """Return the cells of a constant by heading."""
    factor, unit = _readable_unit(constant)
    interval = ""
    if constant.combined95 is not None:
        low, high = (factor * end for end in constant.combined95)
        interval = f"{low:.4g} to {high:.4g}"
    note = "stated" if constant.is_stated else constant.reason or ""
    if constant.is_derived:
        note = f"derived; {note}".removesuffix("; ")
    truth = constant.true_value
    return {
        "constant": symbol_of(constant.name),
        "unit": unit,
        "value": f"{factor * constant.value:.4g}",
        "combined 95 % interval": interval,
        "true value": "" if truth is None else f"{factor * truth:.4g}",
        "note": note,
    }


def _with_interval(constant: IdentifiedConstant) -> str:
    """Return value, interval and unit of a constant in one cell."""
    factor, unit = _readable_unit(constant)
    value = f"{factor * constant.value:.3g}"
    if constant.combined95 is not None:
        low, high = (factor * end for end in constant.combined95)
        value += f" ({low:.3g} to {high:.3g})"
    return f"{value} {unit}".removesuffix(" 1")


def _readable_unit(constant: IdentifiedConstant) -> tuple[float, str]:
    """Return the factor to a readable unit, and the name of that unit."""
    units = READABLE_UNITS.get(constant.unit, ((0.0, 1.0, constant.unit),))
    size = abs(constant.value) if isfinite(constant.value) else 0.0
    return next((factor, name) for smallest, factor, name in units if size >= smallest)


def _rate(rate: QuantileRange | None) -> str:
    """Return the 95 % quantile of a strain rate."""
    return "" if rate is None else f"{rate.high:.2g}"


def _rate_words(rate: QuantileRange | None) -> str:
    """Return the strain rate as the end of a sentence; empty for equilibria without times."""
    return "" if rate is None else f"; strain rate: {rate.high:.3g} 1/s ({rate.maximum:.3g})"


def _table(heads: Sequence[str], rows: Sequence[Mapping[str, str]]) -> str:
    """Return rows, cells by heading, as a Markdown table."""
    lines = [heads, ["---"] * len(heads), *([row[head] for head in heads] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
