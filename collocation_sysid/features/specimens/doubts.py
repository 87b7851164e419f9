"""Misspecification hypotheses for homogeneous specimens: refits with a common mistake corrected.

Mistakes in a table that show without a fit are in `recording.specimen_checks`. The others leave a
plausible curve: true in place of engineering stress, compression with positive signs, percent in
place of ratios, stresses in another unit, another kind of test, and columns of zeros that were not
measured. All specimens are fitted again with one of them corrected; the misfit contains the
nuisance parameters, so that a wrong area does not explain all. A correction keeps all measurements,
unless the mistake is that one was none.

A law that is too simple, a toe region or hysteresis also decrease the misfit of some correction. A
mistake is therefore named only if the corrected description explains the data, see `_is_explained`.

A flexible law also fits the curve of another kind of test, with other constants. If all specimens
are of one kind and fit, the other kinds are therefore compared by their likelihood, see
`_kinds_in_doubt`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from ...common.array_types import Array
from ...common.display import readable_stress
from ...errors import InputError, SimulationError, listed
from ...fem.laws.moduli import engineering_constants
from ...judge.doubt import Correction, Doubt, HypothesisTest
from ...judge.source import Source
from ...methods.reduced_space import ReducedSpace
from ...methods.solution import Solution
from ...program.collocation import ExperimentIterate
from ...program.custom_sensor_residual import CustomSensorResidual
from ...recording.experiment import Experiment
from ...recording.grasp import Grasp
from ...recording.homogeneous_deformation import DEFORMATIONS, HomogeneousDeformation
from ...recording.markers import Markers
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
from ...recording.specimen_files import specimen_strains
from ...statistics.hypothesis import Hypothesis
from ...statistics.thresholds import (
    BETTER,
    CERTAIN,
    DECISIVE,
    FAR_KIND_CHANGE,
    LEAST_KIND_CHANGE,
    LIKELIER,
    LIKELIER_FAR,
    MISFIT,
    NOISE_LEVEL,
    PLAUSIBLE_NUISANCE,
    UNCORRELATED,
    UNIT_LIKE,
    UNLIKELY,
)

# Fewest samples of a specimen whose curve distinguishes hypotheses.
FEWEST_SAMPLES = 4
# Most iterations of one refit, and its tolerance: a misfit is needed, not an estimate.
MOST_ITERATIONS = 15
TOLERANCE = 1e-2
# Samples of each specimen that are refitted.
REFITTED_SAMPLES = 8
# Samples of each specimen, and most iterations, of the fit that decides.
DECIDING_SAMPLES = 60
DECIDING_ITERATIONS = 30
# Units that stresses are confused in: name of the factor that corrects the file.
UNIT_FACTORS = {"kPa": 1e-3, "MPa": 1e3}
# Factors on the stress of a specimen, or their inverses, that correct its area or load, by the mistake.
LOAD_FACTORS = {
    "a diameter that is taken for a radius": 4.0,
    "a round section that is taken for a square one": 4 / np.pi,
    "psi that are taken for kPa": 6.894757,
    "kilograms-force that are taken for newtons": 9.80665,
    "pounds that are taken for newtons": 4.448222,
    "one of two loaded faces that is taken for both": 0.5,
    "a length of the section that is off by ten": 10.0,
}
# Largest change of a ratio of initial slopes by nonlinear laws and zeros of the strain.
SLOPE_RANGE = 1.5
# Causes that show with any law.
EVIDENT = ("specimen-unit", "specimen-placeholder")
# Kinds of test that each kind is confused with, besides that of compression without free sides.
CONFUSED_TESTS = {
    "uniaxial": ("planar", "equibiaxial", "simple-shear"),
    "planar": ("simple-shear", "uniaxial", "equibiaxial"),
    "equibiaxial": ("uniaxial", "planar"),
    "simple-shear": ("planar", "uniaxial"),
    "confined": ("uniaxial",),
}
# Decrease of a modulus with the frequency that is no noise, over its standard deviation.
DECREASE = 6.0
# Largest strain from which on a table of ratios may be one of percent.
PERCENT_STRAIN = 1.0


def find_specimen_misspecifications(solution: Solution) -> list[Hypothesis]:
    """Return hypotheses of what is described wrongly of the specimens of a fit; empty without
    specimens, after a search that did not converge, or if refits fail; where the specimens fit,
    only the kinds of test in doubt.

    The specimens with the largest misfit are tested first; a nearly certain hypothesis (`CERTAIN`)
    about one ends the search, after all those about it, several of which may explain its data. A
    hypothesis is returned only if the corrected description explains the data (`_is_explained`). A
    wrong unit and a column of zeros need no explanation: the initial slopes of the tests, or the
    zeros, show it with any law.

    Parameters
    ----------
    solution : Solution
        The fit. Its recordings without specimens are not refitted.
    """
    fitted = [part for part in solution.parts if part.transcription.experiment.specimen is not None]
    if any(part.transcription.body.memory.oscillates for part in fitted):
        # A table of complex moduli has neither strains nor samples that could be left out.
        return [h for part in fitted for h in exchanged_moduli(part.transcription.experiment)]
    if not fitted or not solution.status.converged:
        return []
    stated_misfit = _misfit(fitted)
    if stated_misfit <= NOISE_LEVEL:
        return _kinds_in_doubt(solution)
    fitted.sort(key=lambda part: -_misfit([part]))
    originals = [part.transcription.experiment for part in fitted]
    experiments = [_thinned(each, most_samples=REFITTED_SAMPLES) for each in originals]

    def misfit_of(corrected: Experiment) -> float | None:
        """Return the misfit of all specimens with one of them corrected; None without a fit."""
        chosen = [corrected if e.name == corrected.name else e for e in experiments]
        refit = _refit(solution, chosen, iterations=MOST_ITERATIONS)
        return None if refit is None else _misfit(refit.parts)

    misfit = misfit_of(experiments[0])
    if misfit is None:
        return []
    hypotheses: list[Hypothesis] = []
    test = HypothesisTest(
        misfit, misfit_of, required_factor=BETTER, smallest_misfit=1.0, noise_level=NOISE_LEVEL
    )
    slopes_pa = [_initial_slope(each) for each in experiments]
    for index, experiment in enumerate(experiments):
        if len(experiment.t_s) < FEWEST_SAMPLES:
            continue
        other_slopes_pa = slopes_pa[:index] + slopes_pa[index + 1 :]
        for hypothesis in test.accepted(_hypotheses(experiment, other_slopes_pa)):
            if hypothesis.cause not in EVIDENT and not _is_explained(
                solution, originals, index=index, tested=hypothesis, stated_misfit=stated_misfit
            ):
                continue
            hypotheses.append(hypothesis)
        if any(each.strength > CERTAIN for each in hypotheses):
            break
    return hypotheses


def exchanged_moduli(experiment: Experiment) -> Iterator[Hypothesis]:
    """Yield the hypothesis that storage and loss modulus of a harmonic test are exchanged, if the
    storage modulus falls with the frequency, which that of no relaxation does, and the loss modulus
    does not.
    """
    if not experiment.body.memory.oscillates:
        return
    amplitude = specimen_strains(experiment)[0][1::2]
    (gauge,) = experiment.readings
    # From the highest frequency to the lowest.
    sigma_pa = gauge.value_sigmas[0] / amplitude
    stress_pa = gauge.measured_values[:, 0]
    of_storage, of_loss = (
        _largest_decrease(modulus_pa[::-1], sigma_pa[::-1])
        for modulus_pa in (stress_pa[1::2] / amplitude, -stress_pa[2::2] / amplitude)
    )
    if of_storage > DECREASE > of_loss:
        of = f"'{experiment.name}'"
        yield Hypothesis("specimen-moduli", of, strength=of_storage)


def _largest_decrease(values: Array, sigmas: Array) -> float:
    """Return the largest decrease of successive values (F,) over their standard deviations."""
    is_known = np.isfinite(values)
    known = values[is_known]
    decrease = np.maximum.accumulate(known) - known
    return float((decrease / sigmas[is_known]).max(initial=0.0))


def _kinds_in_doubt(solution: Solution) -> list[Hypothesis]:
    """Return one hypothesis, as a list, about the kind of test of specimens that fit: that another
    kind is likelier, or that others fit as well; empty if the data exclude all others
    (`LIKELIER`), and unless all recordings are specimens of one kind.
    """
    experiments = [part.transcription.experiment for part in solution.parts]
    kinds = {each.specimen.test if each.specimen else "" for each in experiments}
    if len(kinds) != 1 or "" in kinds or max(len(e.t_s) for e in experiments) < FEWEST_SAMPLES:
        return []
    chosen = [_thinned(each, most_samples=DECIDING_SAMPLES) for each in experiments]
    corrections: dict[str, list[Experiment]] = {}
    for each in chosen:
        for row in _other_kinds(each):
            if hypothesis := row.hypothesis(each):
                corrections.setdefault(hypothesis.data["test"], []).append(hypothesis.corrected)
    stated = _refit(solution, chosen, iterations=DECIDING_ITERATIONS)
    if stated is None:
        return []
    refits = {
        test: refit
        for test, corrected in corrections.items()
        if len(corrected) == len(chosen)
        and (refit := _refit(solution, corrected, iterations=DECIDING_ITERATIONS))
    }
    count = sum(len(row) for part in stated.parts for row in _residuals(part))
    stated_loss = _square_sum(stated.parts)
    loss = {test: _square_sum(each.parts) for test, each in refits.items()}
    unit = max(1.0, min([stated_loss, *loss.values()]) / max(1, count - stated.collocation.nq))
    gains = {test: (stated_loss - value) / unit for test, value in loss.items()}
    best = max(gains.values(), default=-np.inf)
    if best <= -LIKELIER:
        return []
    possible = [test for test in gains if gains[test] > best - LIKELIER]
    possible.sort(key=lambda test: -gains[test])
    data = {
        "stated": kinds.pop(),
        "young": _young_text(stated),
        "kinds": [f"{test} ({_young_text(refits[test])})" for test in possible],
    }
    of = listed([f"'{each.name}'" for each in experiments])
    # Where the law is wrong too, correlated residuals remain, and χ² does not tell the kinds apart.
    is_noise = not any(
        _is_correlated(row) for p in refits[possible[0]].parts for row in _residuals(p)
    )
    freedom = max(1, count - stated.collocation.nq)
    is_unlikely = stated_loss > freedom + UNLIKELY * np.sqrt(2 * freedom)
    change = abs(np.log(_young_pa(refits[possible[0]]) / _young_pa(stated)))
    # The stress in unloading is not that of the law.
    has_unloading = any(is_unloading(specimen_strains(each)[0]) for each in experiments)
    is_likelier = is_noise and (
        (best >= LIKELIER and is_unlikely and change > LEAST_KIND_CHANGE)
        or (best >= LIKELIER_FAR and change > FAR_KIND_CHANGE and not has_unloading)
    )
    code = "specimen-kind/likelier" if is_likelier else "specimen-kind/open"
    return [Hypothesis(code, of, data=data, strength=np.sqrt(stated_loss / min(loss.values())))]


def _young_pa(solution: Solution) -> float:
    body = solution.parts[0].transcription.body
    theta = body.theta_from_values(solution.parameters)
    return max(float(engineering_constants(*lame)[0]) for lame in body.lame(theta).values())


def _young_text(solution: Solution) -> str:
    young_pa = _young_pa(solution)
    factor, unit = readable_stress([young_pa])
    return f"E = {factor * young_pa:.3g} {unit}"


def _refit(
    solution: Solution, experiments: Sequence[Experiment], iterations: int
) -> Solution | None:
    """Return the fit from a solution's parameters; None on failure."""
    method = ReducedSpace(max_iterations=iterations, tolerance=TOLERANCE)
    try:
        refit = method(replace(solution.collocation, experiments=tuple(experiments)))
    except (InputError, SimulationError):
        return None
    return refit.unless_interrupted()


def _is_explained(
    solution: Solution,
    experiments: Sequence[Experiment],
    index: int,
    tested: Hypothesis,
    stated_misfit: float,
) -> bool:
    """Residuals below `MISFIT` σ, uncorrelated, plausible nuisances, and `DECISIVE` less χ²."""
    chosen = [_thinned(each, most_samples=DECIDING_SAMPLES) for each in experiments]
    corrected = tested.doubt and tested.doubt.hypothesis(chosen[index])
    if not corrected:
        return False
    chosen[index] = corrected.corrected
    refit = _refit(solution, chosen, iterations=DECIDING_ITERATIONS)
    if refit is None:
        return False
    residuals = [row for part in refit.parts for row in _residuals(part)]
    count = sum(len(row) for row in residuals)
    freedom = max(1, count - refit.collocation.nq)
    squares = sum(float(np.sum(row**2)) for row in residuals)
    phi = np.concatenate([part.phi for part in refit.parts])
    decrease = count * stated_misfit**2 - squares - float(phi @ phi)
    return bool(
        np.sqrt(squares / freedom) <= MISFIT
        and not any(_is_correlated(row) for row in residuals)
        and np.abs(phi).max(initial=0.0) <= PLAUSIBLE_NUISANCE
        and decrease >= DECISIVE
    )


def _is_correlated(residuals: Array) -> bool:
    """Return whether consecutive residuals (n,) are more alike than noise."""
    squares = float(np.sum(residuals**2))
    products = float(np.sum(residuals[1:] * residuals[:-1]))
    return products > UNCORRELATED / np.sqrt(max(1, len(residuals))) * squares


def _thinned(experiment: Experiment, most_samples: int) -> Experiment:
    count = len(experiment.t_s)
    chosen = np.unique(np.linspace(0, count - 1, min(count, most_samples)).astype(int))
    readings = [
        replace(
            gauge,
            t_s=gauge.sample_times_s[chosen],
            values=gauge.measured_values[chosen],
            sigma_ratios=None if gauge.sigma_ratios is None else gauge.sigma_ratios[chosen],
        )
        for gauge in experiment.readings
        if np.isfinite(gauge.measured_values[chosen]).any()
    ]
    markers = Markers.none(experiment.t_s[chosen])
    return replace(experiment, t_s=experiment.t_s[chosen], readings=readings, markers=markers)


def _initial_slope(experiment: Experiment) -> float:
    """Return Young's modulus [Pa] by the median |stress / strain| of the smaller strains, or NaN."""
    strain, _ = specimen_strains(experiment)
    stress_pa = experiment.readings[0].measured_values[:, 0]
    is_known = np.isfinite(stress_pa) & (strain != 0)
    if not is_known.any():
        return np.nan
    order = np.argsort(np.abs(strain[is_known]))[: len(strain) // 2 + 1]
    slope = float(np.median(np.abs(stress_pa[is_known][order] / strain[is_known][order])))
    ratio = 1.0 if experiment.specimen is None else experiment.specimen.young_ratio
    return slope / (ratio if np.isfinite(ratio) else 1.0)


def _misfit(parts: Sequence[ExperimentIterate]) -> float:
    count = sum(len(residuals) for part in parts for residuals in _residuals(part))
    return float(np.sqrt(_square_sum(parts) / max(1, count)))


def _square_sum(parts: Sequence[ExperimentIterate]) -> float:
    """Return χ²: the sum of the squares of residuals and nuisance parameters."""
    rows = [row for part in parts for row in (part.phi, *_residuals(part))]
    return sum(float(np.sum(row**2)) for row in rows)


def _residuals(part: ExperimentIterate) -> list[Array]:
    """Return residuals (n,) over σ for each component of each sensor, without NaN."""
    rows: list[Array] = []
    for sensor in part.transcription.residuals_of(CustomSensorResidual):
        motion = part.motion_for(sensor.observable)
        predicted = sensor.numbers(sensor.predict_motion(motion, part.phi))
        residuals = (predicted - sensor.sensor.measured_values) / sensor.sensor.sample_sigmas
        rows += [row[np.isfinite(row)] for row in residuals.T]
    return rows


def _hypotheses(experiment: Experiment, other_slopes_pa: Sequence[float]) -> Iterator[Hypothesis]:
    for row in likely_mistakes(experiment, other_slopes_pa):
        if hypothesis := row.hypothesis(experiment):
            yield hypothesis


def likely_mistakes(experiment: Experiment, other_slopes_pa: Sequence[float]) -> Iterator[Doubt]:
    """Yield the likely mistakes about a specimen. The name of a row is the code of its hypothesis."""
    yield _mistake("specimen-true-stress", _of_engineering_stress)
    for code, is_widening in (("", False), ("/widening", True)):
        yield _mistake(f"specimen-compression{code}", partial(_compressed, is_widening=is_widening))
    yield _mistake("specimen-gap", _of_undeformed_gap)
    yield _mistake("specimen-percent", _of_ratios)
    for gauge in experiment.readings[1:]:
        yield _mistake("specimen-placeholder", partial(_without_placeholder, name=gauge.name))
    yield from _other_kinds(experiment)
    # Strips from a sheet with fibres differ in their slopes by the angle at which they were cut.
    has_fibres = any(part.axes is not None for part in experiment.body.parts)
    others_pa = () if has_fibres else other_slopes_pa
    ratios = [other / _initial_slope(experiment) for other in others_pa]
    for unit, factor in UNIT_FACTORS.items():
        decades = np.sign(np.log(factor)) * np.log(ratios) if ratios else np.zeros(0)
        if (decades > np.log(UNIT_LIKE)).any():
            yield _mistake("specimen-unit", partial(_of_unit, unit=unit))
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
    return Doubt(name, "1", lambda at, _: corrected(at), is_whole=True)


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


def _of_unit(experiment: Experiment, unit: str) -> Correction:
    factor = UNIT_FACTORS[unit]
    other = _with_stress(experiment, np.full(len(experiment.t_s), factor))
    return other, {"unit": unit, "factor": factor}


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


def _of_undeformed_gap(experiment: Experiment) -> Correction:
    """Return shear amounts over the distance before the stretch."""
    deformation = experiment.specimen
    assert deformation is not None
    if not deformation.held:
        return None

    def corrected(grasp: Grasp) -> Grasp:
        if int(grasp.nodes[0]) not in deformation.displaced_nodes():
            return grasp
        shifts_m = grasp.poses.positions_m / [deformation.scale, 1.0, 1.0]
        return replace(grasp, poses=replace(grasp.poses, positions_m=shifts_m))

    return replace(experiment, grasps=[corrected(grasp) for grasp in experiment.grasps]), {}


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
        replace(gauge, values=gauge.measured_values * factors[:, None])
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


def _compressed(experiment: Experiment, is_widening: bool) -> Correction:
    """Reverse lateral strains too, unless they are positive where the specimen becomes wider."""
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
    if is_widening and not is_reversed:
        return None
    readings = [
        replace(gauge, values=2.0 - gauge.measured_values)
        if gauge.name == LATERAL_NAME and is_reversed and not is_widening
        else gauge
        for gauge in reversed_stress.readings
    ]
    return _strained(replace(reversed_stress, readings=readings), -1.0), {}


SPECIMENS = Source(fitted=find_specimen_misspecifications)
