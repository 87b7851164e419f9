"""Misspecification hypotheses for homogeneous specimens: refits with a common mistake corrected.

Mistakes in a table that show without a fit are in `recording.specimen_checks`. The others leave a
plausible curve: true in place of engineering stress, compression with positive signs, percent in
place of ratios, and stresses in another unit. All specimens are fitted again with one of them
corrected; the misfit contains the nuisance parameters, so that a wrong area does not explain all.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from ...common.array_types import Array
from ...errors import InputError, SimulationError
from ...methods.reduced_space import ReducedSpace
from ...methods.solution import Solution
from ...program.collocation import ExperimentIterate
from ...recording.experiment import Experiment
from ...recording.grasp import Grasp
from ...recording.homogeneous_deformation import HomogeneousDeformation
from ...recording.markers import Markers
from ...recording.specimen import LATERAL_NAME, STRESS_UNIT
from ...recording.specimen_files import specimen_strains
from .misspecification_hypothesis import Hypothesis, HypothesisTest

# Root mean square of residuals and nuisance parameters, in standard deviations, up to which there
# is nothing to explain.
NOISE_LEVEL = 1.3
# Factor by which the misfit must decrease.
REQUIRED_FACTOR = 1.5
# Fewest samples of a specimen whose curve distinguishes hypotheses.
FEWEST_SAMPLES = 4
# Most iterations of one refit, and its tolerance: a misfit is needed, not an estimate.
MOST_ITERATIONS = 15
TOLERANCE = 1e-2
# Factor of the misfit from which on no other hypothesis is tested.
CERTAIN = 4.0
# Samples of each specimen that are refitted.
REFITTED_SAMPLES = 8
# Factor between initial slopes from which on a wrong unit is tested.
UNIT_LIKE = 20.0
# Units that stresses are confused in: name of the factor that corrects the file.
UNIT_FACTORS = {"kPa": 1e-3, "MPa": 1e3}
# Largest strain from which on a table of ratios may be one of percent.
PERCENT_STRAIN = 1.0


def find_specimen_misspecifications(solution: Solution) -> list[Hypothesis]:
    """Return hypotheses of what is described wrongly of the specimens of a fit; empty without
    specimens, where they fit, or if refits fail.

    The specimens with the largest misfit are tested first; a nearly certain hypothesis (`CERTAIN`)
    ends the search.

    Parameters
    ----------
    solution : Solution
        The fit. Its recordings without specimens are not refitted.
    """
    fitted = [
        part
        for part in solution.parts
        if part.segment.experiment.specimen is not None
    ]
    if not fitted:
        return []
    if _misfit(fitted) <= NOISE_LEVEL:
        return []
    fitted.sort(key=lambda part: -_misfit([part]))
    experiments = [_thinned(part.segment.experiment) for part in fitted]

    def misfit_of(corrected: Experiment) -> float | None:
        """Return the misfit of all specimens with one of them corrected; None without a fit."""
        chosen = [
            corrected if e.name == corrected.name else e for e in experiments
        ]
        method = ReducedSpace(
            max_iterations=MOST_ITERATIONS, tolerance=TOLERANCE
        )
        try:
            refit = method(
                replace(solution.collocation, experiments=tuple(chosen))
            )
        except (InputError, SimulationError):
            return None
        refit.unless_interrupted()
        return _misfit(refit.parts)

    misfit = misfit_of(experiments[0])
    if misfit is None:
        return []
    hypotheses: list[Hypothesis] = []
    test = HypothesisTest(
        misfit,
        misfit_of,
        required_factor=REQUIRED_FACTOR,
        smallest_misfit=1.0,
        noise_level=NOISE_LEVEL,
    )
    for experiment in experiments:
        if len(experiment.t_s) < FEWEST_SAMPLES:
            continue
        others = [
            _initial_slope(each)
            for each in experiments
            if each is not experiment
        ]
        for hypothesis in test.accepted(_hypotheses(experiment, others)):
            hypotheses.append(hypothesis)
            if hypothesis.strength > CERTAIN:
                return hypotheses
    return hypotheses


def _thinned(experiment: Experiment) -> Experiment:
    """Return a copy of the experiment of a specimen with at most `REFITTED_SAMPLES` of its samples,
    evenly chosen by index, without markers and without sensors that have no value there.
    """
    count = len(experiment.t_s)
    chosen = np.unique(
        np.linspace(0, count - 1, min(count, REFITTED_SAMPLES)).astype(int)
    )
    readings = [
        replace(
            gauge,
            t_s=gauge.sample_times_s[chosen],
            values=gauge.measured_values[chosen],
        )
        for gauge in experiment.readings
        if np.isfinite(gauge.measured_values[chosen]).any()
    ]
    markers = Markers.none(experiment.t_s[chosen])
    return replace(
        experiment,
        t_s=experiment.t_s[chosen],
        readings=readings,
        markers=markers,
    )


def _initial_slope(experiment: Experiment) -> float:
    """Return the median of stress over strain [Pa] among the smaller half of the strains, without
    sign; NaN without a strain.
    """
    strain, _ = specimen_strains(experiment)
    stress_pa = experiment.readings[0].measured_values[:, 0]
    is_known = np.isfinite(stress_pa) & (strain != 0)
    if not is_known.any():
        return np.nan
    order = np.argsort(np.abs(strain[is_known]))[: len(strain) // 2 + 1]
    return float(
        np.median(np.abs(stress_pa[is_known][order] / strain[is_known][order]))
    )


def _misfit(parts: Sequence[ExperimentIterate]) -> float:
    """Return the root of the squares of residuals and nuisance parameters, in standard deviations,
    per measured value; NaN residuals are ignored.
    """
    squares = 0.0
    count = 0
    for part in parts:
        squares += float(np.sum(part.phi**2))
        for sensor in part.segment.custom_sensors:
            predicted = sensor.without_padding(
                sensor.predict_motion(
                    part.motion_for(sensor.observable), part.phi
                )
            )
            residuals = (
                predicted - sensor.sensor.measured_values
            ) / sensor.sensor.sigma
            squares += float(np.nansum(residuals**2))
            count += int(np.isfinite(residuals).sum())
    return float(np.sqrt(squares / max(1, count)))


def _hypotheses(
    experiment: Experiment, other_slopes_pa: Sequence[float]
) -> Iterator[Hypothesis]:
    """Yield each common mistake that is possible for a specimen, untested, with the experiment that
    corrects it.

    Parameters
    ----------
    experiment : Experiment
        Experiment of a specimen.
    other_slopes_pa : sequence of float
        Initial slopes of the stresses of the other specimens, without which a wrong unit cannot be
        detected.
    """
    deformation = experiment.specimen
    assert deformation is not None
    of = f"'{experiment.name}'"
    strain, _ = specimen_strains(experiment)
    areas = area_ratios(deformation, strain)
    if areas is not None and np.ptp(areas):
        yield Hypothesis(
            "specimen-true-stress",
            of,
            data={},
            corrected=_with_stress(experiment, areas),
        )
    is_invertible = (strain >= 0).all() and strain.max() < 1.0
    if (
        deformation.test in ("uniaxial", "equibiaxial", "planar")
        and is_invertible
    ):
        yield Hypothesis(
            "specimen-compression",
            of,
            data={},
            corrected=_compressed(experiment),
        )
    if strain.max() > PERCENT_STRAIN and deformation.test != "volumetric":
        yield Hypothesis(
            "specimen-percent",
            of,
            data={},
            corrected=_strained(experiment, 0.01),
        )
    ratios = [other / _initial_slope(experiment) for other in other_slopes_pa]
    for unit, factor in UNIT_FACTORS.items():
        decades = (
            np.sign(np.log(factor)) * np.log(ratios) if ratios else np.zeros(0)
        )
        if (decades > np.log(UNIT_LIKE)).any():
            corrected = _with_stress(experiment, np.full_like(strain, factor))
            yield Hypothesis(
                "specimen-unit",
                of,
                data={"unit": unit, "factor": factor},
                corrected=corrected,
            )


def area_ratios(
    deformation: HomogeneousDeformation, strain: Array
) -> Array | None:
    """Return the deformed over the undeformed area (T,) of an incompressible specimen at strains
    (T,), 1 / (1 + strain); None for tests other than uniaxial, equibiaxial and planar ones.
    """
    if deformation.test in ("uniaxial", "equibiaxial", "planar"):
        return 1 / (1 + strain)
    return None


def _with_stress(experiment: Experiment, factors: Array) -> Experiment:
    """Return a copy of the experiment with its stresses multiplied by factors (T,); sensors of
    other quantities or with other samples are unchanged.
    """
    readings = [
        replace(gauge, values=gauge.measured_values * factors[:, None])
        if gauge.unit == STRESS_UNIT
        and len(gauge.sample_times_s) == len(factors)
        else gauge
        for gauge in experiment.readings
    ]
    return replace(experiment, readings=readings)


def _strained(experiment: Experiment, factor: float) -> Experiment:
    """Return a copy of the experiment with its prescribed strains multiplied by a factor; measured
    values are unchanged.
    """

    def scaled(grasp: Grasp) -> Grasp:
        """Return a grasp with its positions multiplied by the factor."""
        return replace(
            grasp,
            poses=replace(
                grasp.poses, positions_m=factor * grasp.poses.positions_m
            ),
        )

    return replace(
        experiment, grasps=[scaled(grasp) for grasp in experiment.grasps]
    )


def _compressed(experiment: Experiment) -> Experiment:
    """Return a copy of the experiment with strains and stresses of the opposite sign, without
    measured lateral strains.
    """
    reversed_stress = _with_stress(
        experiment, np.full(len(experiment.t_s), -1.0)
    )
    lateral = [
        gauge
        for gauge in reversed_stress.readings
        if gauge.name != LATERAL_NAME
    ]
    return _strained(replace(reversed_stress, readings=lateral), -1.0)
