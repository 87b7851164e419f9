"""Likely mistakes in the description of homogeneous specimens.

Mistakes in a table that show without a fit are in `recording.specimen_checks`. The others leave a
plausible curve: true in place of engineering stress, compression with positive signs, percent in
place of ratios, another unit or area, another kind of test, and columns of zeros that were not
measured. All specimens are fitted again with one of them corrected in one table, or in all tables of
one kind of test; the misfit contains the nuisance parameters, so that a wrong area does not explain
all. A correction keeps all measurements, unless the mistake is that one was none.

A law that is too simple, a toe region or hysteresis also decrease the misfit of some correction. A
mistake is therefore named only if its correction leaves noise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from ...common.array_types import Array
from ...common.display import readable_stress
from ...errors import InputError, SimulationError, listed
from ...fem.laws.moduli import engineering_constants
from ...judge.doubt import Correction, Doubt
from ...judge.fit import (
    Candidate,
    TestedFit,
    has_trend,
    least_loss,
    scaled_residuals,
    thinned,
    with_corrected,
)
from ...methods.reduced_space import ReducedSpace
from ...methods.solution import Solution
from ...program.collocation import ExperimentIterate
from ...recording.experiment import Experiment
from ...recording.grasp import Grasp
from ...recording.homogeneous_deformation import DEFORMATIONS, HomogeneousDeformation
from ...recording.specimen import (
    LATERAL_NAME,
    MODULUS_TESTS,
    RELAXED_STRAIN,
    SECOND_STRESS_NAME,
    STRESS_NAME,
    STRESS_UNIT,
    Specimen,
    cell_of_other_test,
)
from ...recording.specimen_checks import is_unloading
from ...recording.specimen_files import initial_modulus_pa, specimen_strains
from ...statistics.hypothesis import Hypothesis
from ...statistics.thresholds import KIND_CHANGE, LIKELIER

# Fewest samples of a specimen whose curve distinguishes hypotheses.
FEWEST_SAMPLES = 4
# Mistakes with which specimens that fit are compared.
OTHER_READINGS = "specimen-true-stress", "specimen-percent", "specimen-kind"
# Samples of each specimen, and most iterations, of the fits that screen the mistakes, and of those
# that compare kinds of test; their tolerance: a misfit is needed, not an estimate.
SCREENING = (8, 15)
COMPARING = (60, 30)
TOLERANCE = 1e-2
# Factors on the stress of a specimen, or their inverses, that correct its area or load, by the mistake.
LOAD_FACTORS = {
    "a diameter that is taken for a radius": 4.0,
    "a round section that is taken for a square one": 4 / np.pi,
    "psi that are taken for kPa": 6.894757,
    "kilograms-force that are taken for newtons": 9.80665,
    "pounds that are taken for newtons": 4.448222,
    "one of two loaded faces that is taken for both": 0.5,
    "a length of the section that is off by ten": 10.0,
    "kPa that are taken for Pa, or MPa for kPa": 1e3,
}
# Largest change of a ratio of initial slopes by nonlinear laws and zeros of the strain.
SLOPE_RANGE = 1.5
# Kinds of test that each kind is confused with, besides that of compression without free sides.
CONFUSED_TESTS = {
    "uniaxial": ("planar", "equibiaxial", "simple-shear"),
    "planar": ("simple-shear", "uniaxial", "equibiaxial"),
    "equibiaxial": ("uniaxial", "planar"),
    "simple-shear": ("planar", "uniaxial"),
    "confined": ("uniaxial",),
}
# Mistakes that all tables of one program or one person may have.
OF_ALL_TABLES = frozenset(
    {"specimen-true-stress", "specimen-compression", "specimen-percent", "specimen-kind"}
)
# Largest strain from which on a table of ratios may be one of percent.
PERCENT_STRAIN = 1.0


def specimen_candidates(fit: TestedFit) -> Iterator[Candidate]:
    """Yield the likely mistakes of all specimens that decrease the misfit of a few samples of each."""
    solution = fit.whole
    originals = [part.transcription.experiment for part in fit.solution.parts]
    if any(each.specimen is None or each.body.memory.oscillates for each in originals):
        return
    few = [thinned(each, SCREENING[0]) for each in originals]
    stated = _refit(solution, few, SCREENING)
    if stated is None:
        return
    slopes_pa = [initial_modulus_pa(each) for each in few]
    tests = [each.specimen.test for each in originals if each.specimen is not None]
    alike = [[k for k, each in enumerate(tests) if each == test] for test in dict.fromkeys(tests)]
    alone = [[index] for index, each in enumerate(few) if len(each.t_s) >= FEWEST_SAMPLES]
    for group in [*alone, *(each for each in alike if len(each) > 1)]:
        first = group[0]
        others_pa = slopes_pa[:first] + slopes_pa[first + 1 :]
        for row in likely_mistakes(few[first], others_pa):
            if len(group) > 1 and row.name not in OF_ALL_TABLES:
                continue
            tried = [row.hypothesis(few[index]) for index in group]
            whole = [row.hypothesis(originals[index]) for index in group]
            if None in tried or None in whole:
                continue
            corrected = with_corrected(few, tuple(each.corrected for each in tried if each))
            refit = _refit(solution, corrected, SCREENING)
            if refit is not None:
                found = [each for each in whole if each is not None]
                yield (
                    _square_sum(refit.parts) / max(_square_sum(stated.parts), 1e-300),
                    replace(
                        found[0],
                        subject=listed([each.subject for each in found]),
                        corrected=tuple(each.corrected for each in found),
                    ),
                )


def likelier_kinds(solution: Solution, deviations: Mapping[str, float | None]) -> list[Hypothesis]:
    """Return the hypothesis, as a list, that specimens which fit are of another kind of test, or have
    true stresses or strains in percent, with which they fit far better, both with the effects of the
    budget; empty unless all recordings are specimens of one kind. A flexible law fits the curve of
    another kind too, with other constants.
    """
    experiments = [part.transcription.experiment for part in solution.parts]
    kinds = {each.specimen.test if each.specimen else "" for each in experiments}
    if len(kinds) != 1 or "" in kinds or max(len(e.t_s) for e in experiments) < FEWEST_SAMPLES:
        return []
    if any(each.body.memory.oscillates for each in experiments) or not solution.status.converged:
        return []
    chosen = [thinned(each, COMPARING[0]) for each in experiments]
    corrections: dict[str, list[Experiment]] = {}
    for each in chosen:
        for row in likely_mistakes(each, ()):
            if row.name in OTHER_READINGS and (hypothesis := row.hypothesis(each)):
                name = row.name.removeprefix("specimen-").replace("-", " ")
                other = hypothesis.data.get("test", name)
                corrections.setdefault(other, []).append(hypothesis.corrected)
    stated = _refit(solution, chosen, COMPARING)
    refits = {
        test: refit
        for test, corrected in corrections.items()
        if len(corrected) == len(chosen) and (refit := _refit(solution, corrected, COMPARING))
    }
    if stated is None or not refits:
        return []
    losses = {test: least_loss(each, deviations) for test, each in refits.items()}
    least, stated_loss = min(losses.values()), least_loss(stated, deviations)
    likely = [
        each for each in sorted(losses, key=losses.__getitem__) if losses[each] <= least + LIKELIER
    ]
    best = refits[likely[0]]
    changes = [abs(np.log(_young_pa(refits[each]) / _young_pa(stated))) for each in likely]
    # The stress in unloading is not that of the law. Where the law is wrong too, correlated residuals
    # remain, and χ² does not tell the kinds apart.
    has_unloading = any(is_unloading(specimen_strains(each)[0]) for each in experiments)
    is_likelier = stated_loss - least >= LIKELIER and max(changes) > KIND_CHANGE
    if not is_likelier or has_unloading or any(map(has_trend, best.parts)):
        return []
    data = {
        "stated": kinds.pop(),
        "young": _young_text(stated),
        "kinds": [f"{each} ({_young_text(refits[each])})" for each in likely],
    }
    of = listed([f"'{each.name}'" for each in experiments])
    strength = float(np.sqrt(stated_loss / least))
    return [Hypothesis("specimen-kind/likelier", of, data=data, strength=strength)]


def _young_pa(solution: Solution) -> float:
    body = solution.parts[0].transcription.body
    theta = body.theta_from_values(solution.parameters)
    return max(float(engineering_constants(*lame)[0]) for lame in body.lame(theta).values())


def _young_text(solution: Solution) -> str:
    young_pa = _young_pa(solution)
    factor, unit = readable_stress([young_pa])
    return f"E = {factor * young_pa:.3g} {unit}"


def _refit(
    solution: Solution, experiments: Sequence[Experiment], effort: tuple[int, int]
) -> Solution | None:
    """Return the fit from a solution's parameters; None on failure."""
    method = ReducedSpace(max_iterations=effort[1], tolerance=TOLERANCE)
    try:
        refit = method(replace(solution.collocation, experiments=tuple(experiments)))
    except (InputError, SimulationError):
        return None
    return refit.unless_interrupted()


def _square_sum(parts: Sequence[ExperimentIterate]) -> float:
    """Return χ²: the sum of the squares of residuals and nuisance parameters."""
    residuals = (np.nansum(r**2) for part in parts for _, r in scaled_residuals(part))
    return float(sum(residuals) + sum(float(part.phi @ part.phi) for part in parts))


def likely_mistakes(experiment: Experiment, other_slopes_pa: Sequence[float]) -> Iterator[Doubt]:
    """Yield the likely mistakes about a specimen. The name of a row is the code of its hypothesis."""
    yield _mistake("specimen-true-stress", _of_engineering_stress)
    yield _mistake("specimen-compression", _compressed)
    yield _mistake("specimen-percent", _of_ratios)
    for gauge in experiment.readings[1:]:
        yield _mistake("specimen-placeholder", partial(_without_placeholder, name=gauge.name))
    yield from _other_kinds(experiment)
    # Strips from a sheet with fibres differ in their slopes by the angle at which they were cut.
    has_fibres = any(part.axes is not None for part in experiment.body.parts)
    others_pa = () if has_fibres else other_slopes_pa
    ratios = [other / initial_modulus_pa(experiment) for other in others_pa]
    for what, stated in LOAD_FACTORS.items():
        for factor in (stated, 1 / stated):
            if any(1 / SLOPE_RANGE < ratio / factor < SLOPE_RANGE for ratio in ratios):
                yield _mistake("specimen-area", partial(_of_area, what=what, factor=factor))


def _other_kinds(experiment: Experiment) -> Iterator[Doubt]:
    assert experiment.specimen is not None
    strain, _ = specimen_strains(experiment)
    kinds = CONFUSED_TESTS.get(experiment.specimen.test, ())
    if np.abs(strain).max() <= RELAXED_STRAIN:
        kinds = tuple(test for test in MODULUS_TESTS if test != experiment.specimen.test)
    elif experiment.specimen.test == "uniaxial" and (strain <= 0).all():
        kinds = (*kinds, "confined")
    for test in kinds:
        yield _mistake("specimen-kind", partial(_of_another_kind, test=test))


def _mistake(name: str, corrected: Callable[[Experiment], Correction]) -> Doubt:
    return Doubt(name, "1", lambda at, _: corrected(at))


def _of_engineering_stress(experiment: Experiment) -> Correction:
    """Stresses in unloading are smaller, like engineering in place of true stresses."""
    assert experiment.specimen is not None
    strain, _ = specimen_strains(experiment)
    areas = area_ratios(experiment.specimen, strain)
    if areas is None or not np.ptp(areas) or is_unloading(strain):
        return None
    return _with_stress(experiment, areas), {}


def _of_ratios(experiment: Experiment) -> Correction:
    """Divide strains in percent by 100."""
    deformation = experiment.specimen
    assert deformation is not None
    strain, _ = specimen_strains(experiment)
    if deformation.held or strain.max() <= PERCENT_STRAIN or deformation.test == "volumetric":
        return None
    return _strained(experiment, 0.01), {}


def _of_area(experiment: Experiment, what: str, factor: float) -> Correction:
    other = _with_stress(experiment, np.full(len(experiment.t_s), factor))
    return other, {"mistake": what, "factor": factor}


def _of_another_kind(experiment: Experiment, test: str) -> Correction:
    """None if the other test cannot have all numbers."""
    assert experiment.specimen is not None
    if experiment.specimen.held or (
        test == "simple-shear" and "stretch" in experiment.specimen.columns
    ):
        return None
    strain, _ = specimen_strains(experiment)
    values = {gauge.name: gauge.measured_values[:, 0] for gauge in experiment.readings}
    body = experiment.body
    if bool(DEFORMATIONS[test].free) != bool(experiment.specimen.free):
        body = cell_of_other_test(body, test)
    second_pa: Any = values.get(SECOND_STRESS_NAME)
    lateral: Any = values.get(LATERAL_NAME)
    try:
        other = Specimen(
            test,
            strain,
            values[STRESS_NAME],
            sigma_pa=1.0,
            t_s=experiment.t_s,
            second_stress_pa=second_pa,
            lateral_stretch=lateral,
        ).experiment(name=experiment.name, body=body)
    except (InputError, KeyError):
        return None
    made = {gauge.name: gauge for gauge in other.readings}
    readings = [
        replace(
            made[gauge.name],
            sigma=gauge.sigma,
            sigma_ratios=gauge.sigma_ratios,
            unknowns=gauge.unknowns,
        )
        for gauge in experiment.readings
    ]
    return replace(other, readings=readings, nuisance=experiment.nuisance), {"test": test}


def _without_placeholder(experiment: Experiment, name: str) -> Correction:
    (gauge,) = (each for each in experiment.readings if each.name == name)
    values = gauge.measured_values[np.isfinite(gauge.measured_values)]
    if not (values == (1.0 if name == LATERAL_NAME else 0.0)).all():
        return None
    others = [each for each in experiment.readings if each is not gauge]
    quantity = "lateral strain" if name == LATERAL_NAME else name
    return replace(experiment, readings=others), {"quantity": quantity}


def area_ratios(deformation: HomogeneousDeformation, strain: Array) -> Array | None:
    """Return the deformed over the undeformed area (T,) of an incompressible specimen at strains
    (T,), 1 / (1 + strain); None for tests other than uniaxial, equibiaxial and planar ones.
    """
    if deformation.test in ("uniaxial", "equibiaxial", "planar"):
        return 1 / (1 + strain)
    return None


def _with_stress(experiment: Experiment, factors: Array) -> Experiment:
    readings = [
        replace(
            gauge,
            values=gauge.measured_values * factors[:, None],
            sigma=gauge.sample_sigmas * np.abs(factors)[:, None],
            sigma_ratios=None,
        )
        if gauge.unit == STRESS_UNIT and len(gauge.sample_times_s) == len(factors)
        else gauge
        for gauge in experiment.readings
    ]
    return replace(experiment, readings=readings)


def _strained(experiment: Experiment, factor: float) -> Experiment:
    def scaled(grasp: Grasp) -> Grasp:
        return replace(
            grasp, poses=replace(grasp.poses, positions_m=factor * grasp.poses.positions_m)
        )

    return replace(experiment, grasps=[scaled(grasp) for grasp in experiment.grasps])


def _compressed(experiment: Experiment) -> Correction:
    """Reverse lateral strains too."""
    deformation = experiment.specimen
    assert deformation is not None
    strain, _ = specimen_strains(experiment)
    is_invertible = (strain >= 0).all() and strain.max() < 1.0
    if (
        deformation.test not in ("uniaxial", "equibiaxial", "planar")
        or "stretch" in deformation.columns
        or not is_invertible
    ):
        return None
    reversed_stress = _with_stress(experiment, np.full(len(experiment.t_s), -1.0))
    is_reversed = "lateral_strain" in deformation.columns
    readings = [
        replace(gauge, values=2.0 - gauge.measured_values)
        if gauge.name == LATERAL_NAME and is_reversed
        else gauge
        for gauge in reversed_stress.readings
    ]
    return _strained(replace(reversed_stress, readings=readings), -1.0), {}
