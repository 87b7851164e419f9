"""Findings of a check as tables for the terminal.

`quick_check_tables` shows what is known at once; `full_check_tables` shows the findings that need
simulations.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from ..common.display import Line, Shown, Table, duration, labelled, quantity
from ..fem.laws.constants import symbol_of, unit_of
from ..runs.check import BodyCheck, CheckResult, GraspCheck, QuickCheck, RecordingCheck
from ..runs.check.body import grasp_sentence
from ..runs.cost import MethodCost
from .run_sections import remedy_command

# Natural modes in the table, lowest first.
SHOWN_MODES = 3
# Recordings that have lines of their own; JSON has all.
SHOWN_RECORDINGS = 4


def quick_check_tables(quick_check: QuickCheck, details: bool = False) -> list[Shown]:
    """Return what a quick check finds without a simulation: bodies, also those of specimens without
    a mesh, and measurements.

    Parameters
    ----------
    details : bool
        Whether the quality of the elements and the grasps of each recording are shown, too.
    """
    bodies = [_body_section(body, details) for body in quick_check.bodies]
    tables = [*bodies, _measurements_section(quick_check, details)]
    return [*tables] if details else [_joined(tables)]


def full_check_tables(findings: CheckResult, details: bool = False) -> list[Shown]:
    """Return the findings of a check that need simulations, for the terminal.

    First come the natural modes (left out if all recordings are static), then guess and cost,
    warnings, the number of notes, the command that explains remedies if there is a concern, and the
    conclusion.

    Parameters
    ----------
    details : bool
        Whether notes, other modes, all methods, and the sizes of the program are shown, too.
    """
    warnings = _messages("warning", findings.warnings, "check")
    notes = _messages("note", findings.notes, "") if details else _note_count(findings.notes)
    return [
        *([*_motion_section(findings), _solve_section(findings), ""] if details else []),
        *([] if details else [_solve_brief(findings)]),
        *notes,
        *warnings,
        *remedy_command(findings.concerns),
        _check_verdict(findings),
    ]


def _joined(tables: Sequence[Table]) -> Table:
    return replace(tables[0], title="", rows=tuple(row for each in tables for row in each.rows))


def _messages(kind: str, sentences: Iterable[str], style: str) -> list[Shown]:
    rows = tuple((f"{kind}:", each) for each in sentences)
    return [Table("", (), rows=rows, texts=1, style=style)] if rows else []


def _note_count(notes: Sequence[str]) -> list[Shown]:
    count = "a note" if len(notes) == 1 else f"{len(notes)} notes"
    return [Line(f"{count}: see check --details", "quiet")] if notes else []


def _check_verdict(findings: CheckResult) -> Line:
    if findings.derivative_fault:
        return Line(findings.derivative_fault, "doubtful")
    if findings.omitted and not findings.causes:
        longer = findings.longer_edges
        coarser = f"use edges {longer[0]:.2g} times as long, or " if longer else ""
        return Line(
            f"{'' if findings.concerns else 'No mistake was found. '}Left out, because check would "
            f"take longer than half a minute: {', '.join(findings.omitted)}: {coarser}check --full.",
            "check",
        )
    if findings.causes:
        likeliest = findings.causes[0].message
        sentence = (
            "The derivatives are correct, but the description in the problem file looks wrong: "
            f"{likeliest}"
        )
        return Line(sentence, "doubtful")
    return Line("The problem is valid and its derivatives pass a Taylor test.", "good")


def _point_masses(body: BodyCheck) -> str:
    """Return masses [g] to follow the body's own, with the total if all experiments agree."""
    masses = body.point_masses_kg
    if not masses:
        return ""
    if len(set(masses.values())) == 1 and len(masses) == len(body.experiments):
        added_kg = next(iter(masses.values()))
        total_g = 1e3 * (body.mass_kg + added_kg)
        return f", with point masses of {1e3 * added_kg:.4g} g {total_g:.4g} g"
    stated = ", ".join(f"{1e3 * mass_kg:.4g} g in '{name}'" for name, mass_kg in masses.items())
    return f", and point masses: {stated}"


def _body_section(body: BodyCheck, details: bool) -> Table:
    """What is not known of the body's origin is asked."""
    if body.is_homogeneous:
        names = ", ".join(f"'{name}'" for name in body.experiments)
        return labelled("Specimens", {"homogeneous": f"{names}; exact, without a mesh"})
    size = " × ".join(f"{1e3 * x:.4g}" for x in body.size_m)
    low, mean, high = (1e3 * x for x in body.edges_m)
    worst = ", ".join(f"{e.element} ({e.quality:.2f})" for e in body.worst_elements)
    return labelled(
        "Body",
        {
            "object": f"{size} mm, {1e6 * body.volume_m3:.4g} cm³, {1e3 * body.mass_kg:.4g} g"
            + _point_masses(body),
            "mesh": f"{body.nodes:,} nodes, {body.elements:,} {body.element}; edges "
            f"{low:.3g} to {high:.3g} mm (mean {mean:.3g})",
        }
        | (
            {"quality": f"median {body.median_element_quality:.2f}, worst in elements {worst}"}
            if details and worst
            else {}
        )
        | ({"origin": body.open_question} if body.open_question else {})
        | ({"rest shape": _rest_shape(body)} if body.rest_shape == "under_gravity" else {})
        | {
            f"field of {symbol_of(name)}": f"{each.modes} shapes with {each.share:.0%} of the "
            f"prior variance, correlation length {1e3 * each.length_m:.3g} mm; resolved details: "
            f"above {1e3 * each.detail_m:.3g} mm"
            for name, each in body.fields.items()
        },
    )


def _rest_shape(body: BodyCheck) -> str:
    if np.isnan(body.rest_shape_change_m):
        return (
            "the mesh was made under gravity; no stress-free shape was found at the guess: give "
            "stiffer guesses"
        )
    change = f"{1e3 * body.rest_shape_change_m:.3g} mm"
    return (
        f"the mesh was made under gravity; the stress-free shape differs from it by up to {change}"
    )


def _motion_rows(findings: CheckResult) -> dict[str, str]:
    first = next((m.first_mode for m in findings.motions if m.first_mode), None)
    if first is None:
        return {}
    return {
        "first mode": f"{first.frequency_hz:.3g} Hz at the guess, damping ratio "
        f"{first.damping_ratio:.2g}; {first.samples_per_period:.1f} samples and "
        f"{first.steps_per_period:.1f} time steps per period"
    }


def _motion_section(findings: CheckResult) -> list[Shown]:
    if not findings.motions:  # equilibria only
        return []
    motion, *others = findings.motions
    title = f"Modes of '{motion.experiment}' about its {motion.about} (they depend on the guess)"
    heads = (
        "  Hz",
        "samples/period",
        "steps/period",
        "damping",
        "numerical damping",
        "period error",
    )
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
    firsts = [
        f"'{m.experiment}' {m.first_mode.frequency_hz:.3g} Hz" for m in others if m.first_mode
    ]
    firsts = [*firsts[:SHOWN_RECORDINGS], *["…"] * (len(firsts) > SHOWN_RECORDINGS)]
    more = [f"  first modes of the other recordings: {', '.join(firsts)}"] if firsts else []
    return [Table(title, heads, rows=rows, names=0), *more]


def _measurements_section(findings: QuickCheck, details: bool) -> Table:
    """Show `SHOWN_RECORDINGS`; without `details`, each described grasp once."""
    rows = {}
    for recording in findings.recordings[:SHOWN_RECORDINGS]:
        kind = ", validation" if recording.validation else ""
        when = f"{recording.duration_s:.3g} s at {recording.rate_hz:.4g} Hz"
        kind_text = recording.test or ("static" if recording.static else when)
        rows[f"'{recording.experiment}'"] = (
            f"{kind_text}: {recording.frames} × {_marker_summary(recording)}{kind}"
        )
    if len(findings.recordings) > SHOWN_RECORDINGS:
        rows["…"] = f"and {len(findings.recordings) - SHOWN_RECORDINGS} more (all with --json)"
    densities = {r.air_density_kg_m3 for r in findings.recordings if not r.test}
    if densities:
        rows["air"] = ", ".join(map(_air_description, sorted(densities)))
    if details:
        for recording in findings.recordings[:SHOWN_RECORDINGS]:
            rows |= _grasp_rows(recording.experiment, findings.holds)
    else:
        grasps = [*dict.fromkeys(map(grasp_sentence, findings.holds))]
        shown = grasps[:SHOWN_RECORDINGS]
        names = ["grasp"] if len(shown) == 1 else [f"grasp {k + 1}" for k in range(len(shown))]
        rows |= dict(zip(names, shown, strict=True))
        if len(grasps) > len(shown):
            rows["other grasps"] = f"{len(grasps) - len(shown)} (see check --details)"
    return labelled("Measurements", rows)


def _grasp_rows(experiment: str, holds: Iterable[GraspCheck]) -> dict[str, str]:
    """Several grasps are numbered from 1."""
    own = [grasp_sentence(grasp) for grasp in holds if grasp.experiment == experiment]
    if len(own) == 1:
        return {f"grasp of '{experiment}'": own[0]}
    return {f"grasp {k} of '{experiment}'": sentence for k, sentence in enumerate(own, start=1)}


def _air_description(density_kg_m3: float) -> str:
    """Zero is a vacuum."""
    if not density_kg_m3:
        return "none (as in a vacuum)"
    return f"{density_kg_m3:.4g} kg/m³ (buoyancy, added mass and drag)"


def _marker_summary(recording: RecordingCheck) -> str:
    """Name the marker farthest from the body [mm]; without markers the instruments alone."""
    if not recording.markers:
        besides = "" if recording.test else ", no markers"
        return f"{', '.join(recording.instruments)}{besides}"
    besides = "".join(f", {name}" for name in recording.instruments)
    farthest = recording.farthest_marker
    most_missing = recording.most_missing_marker
    missing = (
        f"{recording.missing} samples missing, most of '{most_missing.name}' "
        f"({most_missing.missing})"
        if recording.missing
        else "none missing"
    )
    nearest = "attached at the point of the body nearest to the first sample"
    if recording.unplaced == len(recording.markers):
        place = f"no place stated, each {nearest}"
    else:
        place = (
            f"farthest from the body '{farthest.name}', {round(1e3 * farthest.distance_m, 2):g} mm"
        )
        if recording.unplaced:
            place += f"; {recording.unplaced} without a stated place, {nearest}"
    return f"{len(recording.markers)} markers, {missing}; {place}{besides}"


def _guess_rows(findings: CheckResult) -> dict[str, str]:
    rows = {
        "guess" if len(findings.bodies) == 1 else f"guess of '{body.experiments[0]}'": ", ".join(
            f"{symbol_of(name)} {quantity(value, unit_of(name), digits=3)}"
            for name, value in body.guess.items()
        )
        for body in findings.bodies
    }
    if findings.samples and findings.rms_at_guess_m is not None:
        rows["at the guess"] = (
            "the simulation deviates from the markers by "
            f"{1e3 * findings.rms_at_guess_m:.3g} mm RMS"
        )
    return rows


def _cost_text(cost: MethodCost) -> str:
    memory = (
        f"{max(1.0, cost.memory_mb):.0f} MB"
        if cost.memory_mb < 1e3
        else f"{cost.memory_mb / 1e3:.2g} GB"
    )
    return f"about {duration(cost.time_s)} and {memory}"


def _solve_brief(findings: CheckResult) -> Table:
    rows = _guess_rows(findings) | _motion_rows(findings)
    if findings.combinations:
        best, *others = findings.combinations
        more = f" (and {len(others)} more: see --details)" if others else ""
        rows["determined"] = best.sentence().removeprefix("the data determine ") + more
    for cost in findings.costs:
        if cost.method == findings.method:
            rows["solve"] = f"{_cost_text(cost)} by {cost.method} (rough estimates, without checks)"
            if findings.longer_edges:
                ratio, time_s = findings.longer_edges
                rows["solve"] += f"; edges {ratio:.2g} times as long: about {duration(time_s)}"
    return labelled("", rows)


def _solve_section(findings: CheckResult) -> Table:
    rows = _guess_rows(findings)
    for number, each in enumerate(findings.combinations, start=1):
        which = f" {number}" if len(findings.combinations) > 1 else ""
        rows[f"determined{which}"] = each.statement()
    rows |= {
        "program": f"{findings.variables:,} variables, {findings.constraints:,} constraints, "
        + (
            "nonzeros not counted"
            if findings.jacobian_nonzeros is None or findings.hessian_nonzeros is None
            else f"{findings.jacobian_nonzeros + findings.hessian_nonzeros:,} nonzeros"
        )
    }
    rows |= findings.lifted_texts
    for cost in findings.costs:
        chosen = ", chosen" if cost.method == findings.method else ""
        rows[cost.method] = f"{_cost_text(cost)}{chosen}"
    if findings.costs:
        rows["times"] = (
            f"rough estimates for {findings.timesteps:,} time steps or equilibria, without checks"
        )
    if findings.taylor_rates:
        rows["derivatives"] = "orders of Taylor remainders: " + ", ".join(
            f"{name} {'exact' if rate == np.inf else f'{rate:.2f}'}"
            for name, rate in findings.taylor_rates.items()
        )
    return labelled("Solve", rows)
