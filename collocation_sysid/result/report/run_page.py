"""The page about one run, made from its folder alone."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import numpy as np

from ...display import Cards, Items, Line, Listing, Picture, Section, Shown, Span, Table
from ...fem.constants import symbol_of, unit_of, with_unit
from ...files import is_own
from ...recording.nuisance import in_unit_for_people
from ...runs.result import Result
from ...statistics.numerical import NumericalError
from ...statistics.trust import Trust
from ...tree import content
from ..remedies import remedies_for
from ..replay import LARGEST, read_arrays, reading_run
from .page import own_pictures

MEANINGS = {
    "good": "nothing speaks against the answer and its error bars",
    "check": "usable after a look at the reasons",
    "doubtful": "something is wrong with the data, the model or the solve",
}
# What tells stiffness first, where there are several.
FOREMOST = ("young_pa", "mu_pa", "kappa_pa", "lambda_pa")
# Largest errors shown, and how far apart in samples they are at least: neighbours tell the same.
WORST, APART = 8, 5

CAPTIONS = {
    "shapes": "The body at times of the recording; orange: measured markers.",
    "mesh": "The mesh, its grasped nodes and the markers' places as found.",
    "tracks": "Measured, fitted and rolled-out markers, the residual below.",
    "wrench": "Wrench of a grasp: measured, fitted and simulated.",
    "reading": "A reading of your own: measured, fitted and simulated.",
    "error": "Distance of the markers from their measurements over time.",
    "spectrum": "Spectrum of the motion against the body's first natural frequencies.",
    "confidence": "95 % confidence ellipses of pairs of parameters, for the noise.",
    "correlation": "Correlation of the estimates.",
    "convergence": "Loss, violation of the dynamics and parameters over the iterations.",
    "scan": "Scan of the stiffness for a start: misfit of the first part of the recordings.",
    "elements": "Size and quality of the elements.",
    "jacobian": "Structure of the constraints' Jacobian.",
}


def run_report(run: str | Path) -> Section:
    """What there is to say of a run folder.

    Raises
    ------
    InputError
        If it is not a run folder, or damaged.
    """
    run = Path(run)
    result = Result.read(run)
    with reading_run(run):
        trust, title, found = result.trust, result.title or "Run", result.uncertainty
        took = f"{result.iterations} iterations, {number(result.timing_s.total, 3)} s"
        parts: list[Shown] = [
            Line(
                (
                    Span(result.status, f"badge {trust.verdict}"),
                    Span(f" {result.method}, {took}"),
                ),
                "quiet",
            ),
            Section("", tuple(_reasons(trust)), style=f"verdict {trust.verdict}"),
            _cards(result),
            *verdict(result),
            *_section("What to do", *_cures(trust)),
            Section("Parameters", tuple(_parameters(result))),
        ]
        if found is not None:
            chi = number(found.reduced_chi_squared, 3)
            said = f"Error bars for {found.errors} errors, noise {found.noise}; reduced χ² {chi}."
            profiles = (profile.sentence for profile in found.profiles.values())
            parts += [Line(said, "quiet"), Items((*found.verdicts, *profiles))]
        parts += [*_places(result), *_nuisance(result)]
        if notes := _notes(result):
            parts.append(Section("Notes", (Items(tuple(notes)),)))
        parts += [
            Section("Residuals", tuple(_residuals(result, run))),
            Section("Pictures", tuple(_pictures(run))),
            Section("Problem and provenance", tuple(_provenance(result, run))),
        ]
        return Section(title, tuple(parts), level=1)


def _section(title: str, *parts: Shown) -> list[Section]:
    return [Section(title, parts)] if parts else []


def _reasons(trust: Trust) -> Iterator[Line]:
    yield Line((Span(f"Verdict: {trust.verdict}", "strong"), Span(f", {MEANINGS[trust.verdict]}.")))
    for concern in trust.concerns:
        cure = Span("what to do", to=f"#cure-{concern.topic}")
        yield Line((Span(f"– {concern.sentence} ("), cure, Span(")")))


def _cures(trust: Trust) -> Iterator[Line]:
    for topic, remedy in remedies_for(trust.concerns).items():
        about, page = Span(f"{remedy.about}.", "strong"), f"docs/howto/{remedy.page}.md"
        more = (Span(f" {remedy.cure} More in the how-to page "), Span(page, "code"), Span("."))
        yield Line((about, *more), name=f"cure-{topic}")


def verdict(result: Result) -> list[str]:
    """The run in a few sentences."""
    said = [result.message]
    if result.converged:
        said += _weakest(result)
    fit, rolled = result.fit, result.rollout
    sentence = f"The fitted markers are {millimetres(fit.rms_m)} off (RMS)"
    if rolled.rms_m is not None:
        sentence += (
            f"; the forward simulation misses by {millimetres(rolled.rms_m)}, at most "
            f"{millimetres(rolled.max_m)}"
        )
    said.append(f"{sentence}.")
    for name, found in rolled.experiments.items():
        if found.failed is not None:
            said.append(f"The forward simulation of '{name}' failed: {found.failed}.")
        elif not found.fitted:
            said.append(f"'{name}' was predicted, not fitted: {millimetres(found.rms_m)} RMS.")
    return said


def _cards(result: Result) -> Cards:
    """The three numbers that matter: stiffness, misfit, and how well the answer repeats it."""
    found = result.values
    name = next((key for key in FOREMOST if key in found), next(iter(found)))
    low, high = found[name].ci95 or (None, None)
    interval = "no error bar" if low is None else f"{number(low, 4)} to {number(high, 4)} (95 %)"
    fit, rolled = result.fit, result.rollout
    stiffness = f"{number(found[name].value, 4)} {unit_of(name)}".strip()
    alone = f"RMS; noise alone leaves {millimetres(fit.noise_rms_m)}"
    most = f"RMS; {millimetres(rolled.max_m)} at most"
    return Cards(
        (
            (symbol_of(name), stiffness, interval),
            ("markers, fitted", millimetres(fit.rms_m), alone),
            ("markers, re-simulated", millimetres(rolled.rms_m), most),
        )
    )


def _notes(result: Result) -> list[str]:
    """Notes that the page does not hold elsewhere."""
    found = result.uncertainty
    said = {*found.verdicts, *(p.sentence for p in found.profiles.values())} if found else ()
    return [note for note in result.notes if note not in said]


def _weakest(result: Result) -> list[str]:
    free = {name: p for name, p in result.parameters.items() if not p.fixed}
    unknown = [symbol_of(name) for name, p in free.items() if p.std_error is None]
    said = [f"No error bar for {', '.join(unknown)}: see the notes."] if unknown else []
    known = {name: p.std_error / p.value for name, p in free.items() if p.std_error}
    if known:
        name = max(known, key=lambda key: known[key])
        how = "weakly" if known[name] > 0.1 else "least well, but well"
        said.append(f"{symbol_of(name)} is {how} identified: ±{number(196 * known[name], 2)} %.")
    return said


def _parameters(result: Result) -> Iterator[Shown]:
    """Values with their intervals, and what is known of the numerical error."""
    rows, values = [], result.values
    for name, found in values.items():
        interval = "–" if found.ci95 is None else " … ".join(number(x, 4) for x in found.ci95)
        reason = "fixed" if found.fixed else found.reason or ""
        numbers = number(found.value, 4), interval, number(found.std_error, 2), number(found.guess)
        rows.append((with_unit(name), *numbers, reason))
    heads = ("", "value", "95 % interval", "±", "guess", "")
    yield Table("", heads, tuple(rows), texts=1, faint=_derived(result, values))
    holds = max((found.ci95_holds for found in values.values()), key=len, default=())
    if holds:
        yield Line(f"Intervals hold: {', '.join(holds)}.", "quiet")
    errors = {n: e for n, each in values.items() if (e := each.numerical_error) is not None}
    if errors and "mesh" in holds:
        said = "What half the step and half the edge lengths change, and where both tend to."
    else:
        said = (
            "What half the step would change, to first order, and where that tends to; refine "
            "measures it, and what the mesh does."
        )
    if errors:
        yield Section("Numerical error", (Line(said, "quiet"), _numerical(result, errors)), 3)


def _numerical(result: Result, errors: Mapping[str, NumericalError]) -> Table:
    measured = any("mesh" in found.ci95_holds for found in result.values.values())
    heads, rows = ("", "step", *["order", "mesh", "order"] * measured, "limit"), []
    for name, error in errors.items():
        mesh = number(error.step_order, 2), number(error.mesh, 3), number(error.mesh_order, 2)
        limit = number(error.extrapolated)
        rows.append((with_unit(name), number(error.step, 3), *(mesh if measured else ()), limit))
    return Table("", heads, tuple(rows), faint=_derived(result, errors))


def _derived(result: Result, names: Iterable[str]) -> tuple[int, ...]:
    """The rows of what follows from parameters."""
    return tuple(k for k, name in enumerate(names) if name in result.derived)


def _places(result: Result) -> Iterator[Section]:
    """By experiment the places of the markers in millimetres."""
    said = (
        "On the undeformed body, in millimetres, each with its standard error. Those that were not "
        "given have a prior as wide as the body."
    )
    for experiment, places in result.places.items():
        rows = []
        for marker, place in places.items():
            errors_m = [None] * 3 if place.std_error_m is None else place.std_error_m
            cells = []
            for x, error in zip(place.position_m, errors_m, strict=True):
                cells += [f"{1e3 * x:.2f}", "–" if error is None else number(1e3 * error, 2)]
            prior = "exact" if place.prior_m == 0 else _size(place.prior_m, "m")
            rows.append((marker, *cells, prior, "" if place.given else "not given"))
        heads = ("", "x", "±", "y", "±", "z", "±", "prior ±", "")
        table = Table("", heads, tuple(rows), texts=1)
        title = f"Places of the markers of '{experiment}'"
        yield from _section(title, Line(said, "quiet"), table)


def _nuisance(result: Result) -> Iterator[Section]:
    """By experiment its other nuisance parameters in units for people."""
    said = "Of this recording alone, estimated beside the parameters with a prior about zero."
    for experiment, named in result.nuisance.items():
        rows = []
        for label, found in named.items():
            words, _, unit = label.rstrip("]").rpartition(" [")
            sizes = (found.value, found.std_error, found.prior)
            rows.append((words, *(_size(each, unit) for each in sizes)))
        table = Table("", ("", "value", "±", "prior ±"), tuple(rows))
        title = f"Nuisance parameters of '{experiment}'"
        yield from _section(title, Line(said, "quiet"), table)


def _residuals(result: Result, run: Path) -> Iterator[Shown]:
    """What each marker's residuals suggest, and the largest errors."""
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
        yield Table("", ("marker", "RMS", "samples", "suggests"), rows, texts=1)
    if worst := _worst_errors(run):
        rows = tuple((w, f"{number(t_s, 4)} s", millimetres(m)) for m, t_s, w in worst)
        yield from ("The largest errors:", Table("", ("marker", "time", "error"), rows))


def _provenance(result: Result, run: Path) -> Iterator[Shown]:
    violated, share = result.dynamics.max_violation_n, result.dynamics.max_violation_relative
    said = f"{number(violated, 2)} N ({number(share, 2)} of the largest force)"
    rows = content(result.problem) | {"equations of motion violated by at most": said}
    rows |= content(result.provenance)
    yield Table("", (), tuple((key, str(each)) for key, each in rows.items()), texts=1)
    file = run / "problem.toml"
    if is_own(run, file):
        yield Listing("The problem file as run", file.read_text(encoding="utf-8"))


def _size(value: float | None, unit: str) -> str:
    """A number in the unit that suits it: millimetres, milliseconds or degrees."""
    factor, shown = in_unit_for_people(1.0, unit)
    # No powers of ten for the sizes of bodies.
    digits = 2 if value is None or abs(factor * value) < 99.5 else 4
    return "–" if value is None else f"{number(factor * value, digits)}{shown}"


def number(value: float | None, digits: int = 5) -> str:
    """A number as people write it; a dash for none."""
    if value is None or not math.isfinite(value):
        return "–"
    return f"{value:.{digits}g}".replace("e-0", "e-").replace("e+0", "e")


def millimetres(metres: float | None) -> str:
    """A length in millimetres, to the micrometre at most."""
    return "–" if metres is None or math.isnan(metres) else f"{1e3 * metres:.3g} mm"


def _worst_errors(run: Path) -> list[tuple[float, float, str]]:
    """The largest residuals [m], with time and marker."""
    arrays, found = read_arrays(run), []
    for key in (key for key in arrays if key.rpartition("/")[2] == "residuals_m"):
        prefix = key.removesuffix("residuals_m")
        t_s, markers = arrays[f"{prefix}t_s"], arrays[f"{prefix}marker_names"]
        shape, residuals_m = (len(t_s), len(markers), 3), arrays[key]
        largest = float(np.nanmax(np.abs(residuals_m), initial=0.0))
        if residuals_m.shape != shape or largest > LARGEST:
            raise ValueError(f"{key} does not go with its times and markers")
        errors = np.nan_to_num(np.linalg.norm(residuals_m, axis=2))
        for _ in range(WORST if errors.size else 0):
            t, m = np.unravel_index(int(errors.argmax()), errors.shape)
            if not errors[t, m] > 0:
                break
            found.append((float(errors[t, m]), float(t_s[t]), f"{prefix}{markers[m]}"))
            errors[max(0, t - APART) : t + APART + 1, m] = 0
    return sorted(found, key=lambda each: -each[0])[:WORST]


def _pictures(run: Path) -> Iterator[Picture]:
    """Every PNG of the folder, those known here first."""
    order = list(CAPTIONS)

    def kind(file: Path) -> str:
        return next((k for k in order if file.stem.startswith(k)), "")

    def place(file: Path) -> tuple[int, str]:
        return order.index(kind(file)) if kind(file) else len(order), file.name

    for file in sorted(own_pictures(run), key=place):
        about = file.stem.removeprefix(kind(file)).strip("_")
        caption = CAPTIONS.get(kind(file), file.stem)
        yield Picture(file, f"{about}: {caption}" if about and kind(file) else caption)
