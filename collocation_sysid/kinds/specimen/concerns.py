"""Concerns about fits of material tests, in the terms of specimens.

The general concerns name markers, motions and the noise of cameras. For fits of specimens only,
those with another remedy are replaced by concerns of the topic "specimen".
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ...common.array_types import Array
from ...errors import listed
from ...fem.laws.damping_admissibility import STRAIN
from ...recording.experiment import Experiment
from ...recording.specimen import LATERAL_NAME, RELAXED_STRAIN, is_harmonic
from ...recording.specimen_checks import HYSTERESIS, is_unloading
from ...recording.specimen_files import moduli_of, specimen_strains
from ...statistics.concerns import Concern
from .notes import GENERAL_TESTS

# Code of the concern about a specimen by that of the general concern with the same data.
SPECIMEN_CODES: Mapping[str, str] = {
    "noise/larger": "specimen/law",
    "noise/sensor": "specimen/stress",
    "noise/sensors": "specimen/stresses",
    "residuals/persist": "specimen/persist",
    "residuals/outlier": "specimen/outlier",
    "information/none": "specimen/none",
}
# Laws of rubber to compare, in the order of their number of constants.
COMPARED_LAWS = ("neo-hookean", "mooney-rivlin", "yeoh", "gent", "ogden-2")
# Laws to compare for foams, whose volume changes.
FOAM_LAWS = ("neo-hookean", "hyperfoam-1", "hyperfoam-2")
# What to check of strips from a sheet with fibres.
ANGLE = "the angle of the cut (cut_angle_deg) and the direction of the fibres"
# Why no law fits a curve that returns.
UNLOADED = (
    "contain loading and unloading, which no law without memory fits together: state "
    'branch = "loading"'
)
# Percentage of the squared residuals from which on a sample is the cause, whatever the law.
NEARLY_ALL = 75.0
# Largest change of the logarithm of a volume, relative to that of the stretch, in rubber.
LITTLE_DILATATION = 0.1


def as_specimen_concerns(
    concerns: Iterable[Concern], experiments: Sequence[Experiment], has_toe: bool = False
) -> list[Concern]:
    """Return concerns about a fit of specimens alone, replaced by those of `SPECIMEN_CODES`.

    The concern "specimen/law" about residuals larger than sigma comes first, because a law that is
    too simple is the most frequent cause of the others, unless one sample makes nearly all of them;
    in its place "specimen/branches" about tables of moduli, at whose small strain all laws are linear,
    and "noise/larger" at strains below `STRAIN`, where laws hardly differ. Specimens with fibres
    have their largest unknown first: a strip that was cut at another angle is one of them. Beside
    large residuals a disagreement of the recordings says nothing, and constants at default bounds
    follow from a toe.

    Parameters
    ----------
    concerns : iterable of Concern
        Concerns from the residuals, the error bars and the unknowns of the fit.
    has_toe : bool
        Whether the residuals need a toe.
    """
    strains = [specimen_strains(each)[0] for each in experiments]
    keys = ["relative_sigma" if is_harmonic(strain) else "sigma_pa" for strain in strains]
    has_fibres = any(part.axes is not None for each in experiments for part in each.body.parts)
    data: dict[str, object] = {
        "stated": " and ".join(dict.fromkeys(keys)),
        "remedy": "compare laws with compare-models --materials",
    }
    codes = dict(SPECIMEN_CODES)
    explained = {"information/default-bound"} if has_toe else set()
    advice = _law_advice(experiments)
    unloaded = [each.name for each in experiments if _is_unloaded(each)]
    if unloaded:
        advice = f"{listed(unloaded)} {UNLOADED}"
    elif has_fibres:
        advice = f"check {ANGLE}, and compare laws with compare-models --materials"
    if all(np.abs(strain).max() < 2 * RELAXED_STRAIN for strain in strains):
        codes["noise/larger"] = "specimen/branches"
        data["branches"] = max(len(p.prony) for each in experiments for p in each.body.parts)
        data["remedy"] = "add branches of the memory, [[object.prony]]"
    elif all(np.abs(strain).max() < STRAIN for strain in strains):
        codes["noise/larger"] = "noise/larger"
        data["remedy"] = "measure the area and unloaded length"
    replaced = [
        replace(
            concern,
            code=codes.get(concern.code, concern.code),
            data={"advice": advice, **concern.data, **data, **_named(concern.data, experiments)},
        )
        for concern in concerns
    ]
    alone = [
        each
        for each in replaced
        if each.code == codes["residuals/outlier"] and each.data["percent"] > NEARLY_ALL
    ]
    large = [each for each in replaced if each.code == codes["noise/larger"]]
    unknowns = [each for each in replaced if each.code == "specimen/far"]
    unknowns.sort(key=lambda each: -each.data["deviations"])
    first: list[Concern] = []
    if has_fibres:
        first = [
            replace(each, data={**each.data, "advice": f"it hides another error: check {ANGLE}"})
            for each in unknowns
            if each.grade == "doubtful"
        ]
        unknowns = unknowns[len(first) :]
    elif any(each.grade == "doubtful" for each in unknowns):
        large = [replace(each, grade="doubtful") for each in large]
    others = [e for e in replaced if e.code not in (codes["noise/larger"], "specimen/far")]
    if large:
        explained.add("residuals/recordings")
    others = [each for each in others if each.code not in explained]
    others = [each for each in others if each not in alone]
    grave = any(each.grade == "doubtful" for each in large)
    alone = [replace(each, grade="doubtful") if grave else each for each in alone]
    return [*alone, *first, *large, *others, *unknowns]


def _is_unloaded(experiment: Experiment) -> bool:
    """Whether the strain of a law without memory increases and decreases on one side of zero."""
    if experiment.specimen is None or experiment.specimen.test in GENERAL_TESTS:
        return False
    strain, _ = specimen_strains(experiment)
    sides = [np.abs(strain[is_side]) for is_side in (strain > 0, strain < 0) if is_side.any()]
    returns = any(
        not is_unloading(size)
        and np.max(np.maximum.accumulate(size) - size) > HYSTERESIS * np.ptp(size)
        for size in sides
    )
    return returns and not any(part.prony for part in experiment.body.parts)


def _named(data: Mapping[str, Any], experiments: Sequence[Experiment]) -> dict[str, str]:
    """A table of moduli stands in place of its stress."""
    sample = data.get("number", 0) - 1
    names = {"sample": f"sample {sample + 1}"} if sample >= 0 else {}
    for key in ("of", "marker"):
        name, _, sensor = str(data.get(key, "")).partition("/")
        test = next((each for each in experiments if sensor and each.name == name), None)
        if test is None:
            continue
        moduli = moduli_of(test)
        if moduli:
            names[key] = name
        if key == "of" and sample >= 0:
            of_sample = [m for m, each in moduli.items() if np.isfinite(each[sample])]
            names["sample"] = (
                f"the {of_sample[0]} at {_place(test.t_s, sample, moduli)}"
                if of_sample
                else f"sample {sample + 1} (strain {specimen_strains(test)[0][sample]:.4g})"
            )
    return names


def _place(t_s: Array, sample: int, moduli: Mapping[str, Array]) -> str:
    if len(moduli) == 1:
        return f"{t_s[sample]:.4g} s"
    quarter_s = t_s[sample] - t_s[sample - 1]
    return f"{0.25 / quarter_s:.4g} Hz"


def _law_advice(experiments: Sequence[Experiment]) -> str:
    parts = [part for each in experiments for part in each.body.parts]
    laws = list(dict.fromkeys(getattr(p.material, "matrix", p.material).name for p in parts))
    is_foam = any(law.startswith("hyperfoam-") for law in laws)
    is_foam |= any(_changes_volume(each) for each in experiments)
    compared = FOAM_LAWS if is_foam else COMPARED_LAWS
    richer = [law.replace(f"-{n}", f"-{n + 1}") for law in laws for n in (2, 3) if f"-{n}" in law]
    others = [*dict.fromkeys((*laws, *richer, *compared))]
    branches = max(len(part.prony) for part in parts)
    of_memory = f"--prony {branches},{branches + 1} and then " if branches else ""
    return (
        f"the law {listed(laws)} may be too simple for {' and '.join(_ranges(experiments))}. First "
        f"compare laws with collocation-sysid compare-models FILE {of_memory}--materials "
        f"{','.join(others)}"
    )


def _changes_volume(experiment: Experiment) -> bool:
    """Compare the median over the larger half of the strains."""
    if experiment.specimen is None or experiment.specimen.test != "uniaxial":
        return False
    for gauge in experiment.readings:
        if gauge.name != LATERAL_NAME or gauge.values is None:
            continue
        logarithm = np.log1p(specimen_strains(experiment)[0])
        lateral = np.asarray(gauge.values, dtype=float)[:, 0]
        is_large = np.abs(logarithm) >= np.median(np.abs(logarithm))
        is_large &= np.isfinite(lateral) & (logarithm != 0) & (lateral > 0)
        if is_large.any():
            dilatation = 1 + 2 * np.log(lateral[is_large]) / logarithm[is_large]
            return bool(np.abs(np.median(dilatation)) > LITTLE_DILATATION)
    return False


def _ranges(experiments: Sequence[Experiment]) -> Iterator[str]:
    """Yield the range of the stretches, and of the amounts of shear."""
    tests = [each.specimen.test for each in experiments if each.specimen]
    for is_shear, name, offset in ((False, "stretches", 1.0), (True, "amounts of shear", 0.0)):
        values = [
            offset + specimen_strains(each)[0]
            for each, test in zip(experiments, tests, strict=True)
            if (test == "simple-shear") == is_shear
        ]
        if values:
            joined = np.concatenate(values)
            yield f"{name} of {joined.min():.3g} to {joined.max():.3g}"
