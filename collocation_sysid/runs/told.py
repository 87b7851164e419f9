"""Conversion of an answer to `Result`, the content of ``result.json``."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import version

import casadi
import numpy as np

from ..arrays import Array, root_mean
from ..display import short
from ..fem.constants import GAMMA_R, is_mode
from ..files import SCHEMA
from ..methods.solution import pooled_wrench_rms, reading_rms
from ..model.schemes import as_scheme
from ..problem import Problem
from ..program.collocation import Part
from ..program.depth_comparison import DepthError
from ..program.touches import rubbings
from ..recording.experiment import Experiment
from ..recording.nuisance import GAUGE, JOINING, PLACE, TARE, in_unit_for_people
from ..statistics.fields import FieldEstimate
from ..statistics.identifiability import verdicts
from ..statistics.scale import relative_sentence
from ..statistics.uncertainty import Place
from ..tree import alike
from .answer import Answer
from .forward_simulation import Rollout
from .prediction import CopyError
from .result import (
    FittedExperiment,
    FoundDynamics,
    FoundField,
    FoundFit,
    FoundNuisance,
    FoundProfile,
    FoundRollout,
    FoundScan,
    FoundUncertainty,
    ProgramSize,
    Provenance,
    RecordingsAgreement,
    Result,
    SimulatedExperiment,
)
from .verdict import depth_errors


def result_of(answer: Answer) -> Result:
    """Return the content of ``result.json`` for an answer."""
    solution = answer.solution
    problem = answer.problem
    collocation = solution.collocation
    values = answer.estimates
    return Result(
        schema=SCHEMA,
        status=solution.status.value,
        converged=solution.status.converged,
        message=solution.message,
        missing=answer.missing,
        trust=answer.trust,
        method=solution.method,
        title=problem.title,
        parameters={item.name: values[item.name] for item in answer.started_from.items},
        derived={name: values[name] for name in answer.derived},
        basis=tuple(_basis(problem)),
        budget={name: line.shares for name, line in answer.budget.items()},
        probes=answer.probes,
        places=answer.places,
        nuisance=_nuisance(answer),
        fields={name: _field(field) for name, field in answer.fields.items()},
        uncertainty=_uncertainty(answer),
        scan=None if solution.scan is None else alike(FoundScan, solution.scan),
        fit=_fit(answer),
        residuals=answer.diagnoses,
        dynamics=FoundDynamics(
            solution.max_violation_n,
            solution.max_violation_relative,
            tuple(map(str, solution.largest_violations)),
        ),
        rollout=_simulated(answer),
        iterations=solution.iterations,
        evaluations=solution.evaluations,
        timing_s=solution.timing,
        elapsed_s=answer.elapsed_s,
        problem=ProgramSize(
            sum(len(body.nodes_m) for body in problem.bodies),
            sum(len(body.cells) for body in problem.bodies),
            collocation.substeps,
            sum(segment.grid_rows for segment in collocation.segments),
            collocation.variables,
            collocation.constraints,
            as_scheme(collocation.scheme).name,
        ),
        notes=tuple(dict.fromkeys([*problem.notes, *solution.notes, *answer.all_notes])),
        history=tuple(solution.history),
        provenance=_provenance(problem),
    )


def _provenance(problem: Problem) -> Provenance:
    """Return versions, platform and hashes of the problem's files."""
    origin = problem.origin
    text = None if origin is None else origin.text.encode()
    return Provenance(
        version=version("collocation-sysid"),
        casadi=casadi.CasadiMeta.version(),
        numpy=np.__version__,
        python=platform.python_version(),
        platform=platform.platform(),
        problem_file=None if origin is None else str(origin.path),
        problem_sha256=None if text is None else hashlib.sha256(text).hexdigest(),
        mesh_sha256=tuple(body.mesh.sha256 for body in problem.bodies),
    )


def _basis(problem: Problem) -> Iterator[str]:
    """Yield what the values refer to: the damping law of γ_r, and how moduli are scaled without a
    force.
    """
    parts = [part for body in problem.bodies for part in body.parts]
    laws = dict.fromkeys(part.damping.name for part in parts if GAMMA_R in part.damping.constants)
    law_names = [
        law + (", which also brakes rotation" if law == "rayleigh" else "") for law in laws
    ]
    if law_names:
        yield f"{GAMMA_R.symbol} refers to the damping law {' and '.join(law_names)}"
    if (relative := relative_sentence(problem.experiments, problem.parameters)) is not None:
        yield relative


def _uncertainty(answer: Answer) -> FoundUncertainty | None:
    """Return the statistics behind the error bars; None without error bars.

    Coefficients of fields are left out of the matrices.
    """
    known = answer.uncertainty
    if known is None:
        return None
    reported = [k for k, name in enumerate(known.names) if not is_mode(name)]
    return alike(
        FoundUncertainty,
        known,
        names=tuple(known.names[k] for k in reported),
        correlation=known.correlation[np.ix_(reported, reported)],
        covariance=known.covariance[np.ix_(reported, reported)],
        quantiles=known.quantiles[reported],
        noise_factors=known.level.factors,
        autocorrelation=known.dependence.lag1,
        verdicts=tuple(verdicts(known)),
        recordings=_recordings(answer),
        profiles={
            profile.parameter: alike(
                FoundProfile, profile, rises=profile.losses - profile.losses.min()
            )
            for profile in answer.profiles
        },
    )


def _field(found: FieldEstimate) -> FoundField:
    """Return the summary of a field; its intervals are None if the covariance is not finite."""
    modes = found.modes
    volumes_m3 = found.modes.volumes_m3
    ends = (float(found.value.min()), float(found.value.max()))
    is_determined = found.told
    if not np.isfinite(found.deviation).all():
        return FoundField(modes.told, ends, None, None, {}, found.phases)
    share = float(volumes_m3[is_determined].sum() / volumes_m3.sum())
    likelier = {f"{each:g}": found.likelier(each) for each in modes.field.lengths_m}
    return FoundField(modes.told, ends, share, found.identified, likelier, found.phases)


def _recordings(answer: Answer) -> dict[str, RecordingsAgreement] | None:
    """Return the agreement of the recordings, by parameter; None if it was not evaluated."""
    if answer.uncertainty is None or (scatter := answer.uncertainty.scatter) is None:
        return None
    q = answer.solution.q
    agreements = {}
    for k, item in enumerate(answer.solution.collocation.parameters.free):
        if is_mode(item.name):
            continue
        away = q[k] + scatter.away[:, k]
        values = [item.value(float(x)) if np.isfinite(x) else np.nan for x in away]
        deviations = scatter.deviations[:, k].tolist()
        agreements[item.name] = RecordingsAgreement(
            dict(zip(scatter.recordings, values, strict=True)),
            dict(zip(scatter.recordings, deviations, strict=True)),
            float(scatter.chi_squared[k]),
            int(scatter.freedom[k]),
            bool(scatter.disagreeing[k]),
        )
    return agreements


def _fit(answer: Answer) -> FoundFit:
    """Return the residuals of the fit of each experiment."""
    solution = answer.solution
    experiments = {}
    depths: dict[str, dict[str, DepthError]] = {}
    for (recording, camera), error in depth_errors(solution).items():
        depths.setdefault(recording, {})[camera] = error
    for part in solution.parts:
        experiment = part.segment.experiment
        name = experiment.name
        markers = experiment.markers
        sensors = part.segment.sensors
        wrenches = [sensor.wrench for sensor in sensors]
        sigmas = [
            (wrench.symmetry * wrench.sigmas) ** 2 * np.where(wrench.measured, 1.0, np.nan)
            for wrench in wrenches
        ]
        both = np.array(sigmas).reshape(-1, 2, 3).swapaxes(0, 1)
        experiments[name] = FittedExperiment(
            solution.rms_by_experiment_m[name],
            markers.samples,
            int(markers.missing.sum()),
            experiment.static,
            (*_of_places(answer.places[name]), *_of_rows(part, answer)),
            *solution.wrench_rms.get(name, (None, None)),
            reading_rms(experiment, solution.readings[name]) or None,
            *(root_mean(each[np.isfinite(each)]) or None for each in both),
            reading_sigma={gauge.name: gauge.sigma for gauge in experiment.readings} or None,
            reading_unit=_units(experiment),
            depth=depths.get(name),
            friction=rubbings(experiment, part.setting.dynamics, part.x) or None,
            air_density_kg_m3=experiment.air_density_kg_m3,
        )
    pooled = pooled_wrench_rms(solution)
    parts = {
        experiment.name: experiment.symmetry
        for experiment in answer.problem.experiments
        if experiment.symmetry > 1
    }
    symmetry = parts or None
    return FoundFit(solution.rms_m, answer.noise_rms_m, experiments, *pooled, symmetry=symmetry)


def _simulated(answer: Answer) -> FoundRollout:
    """Return the errors of the forward simulations of all experiments."""
    experiments = {}
    squares = []
    largest = []
    for experiment in answer.problem.experiments:
        experiments[experiment.name] = compared = _compared(answer, experiment)
        if compared.fitted and compared.rms_m is not None and compared.max_m is not None:
            squares.append(experiment.markers.samples * np.array([compared.rms_m**2, 1.0]))
            largest.append(compared.max_m)
    if not largest:
        return FoundRollout(None, None, experiments)
    total, count = np.sum(squares, axis=0)
    return FoundRollout(float(np.sqrt(total / max(1, count))), max(largest), experiments)


def _units(experiment: Experiment) -> dict[str, str] | None:
    """Units of the readings that state one, by name; None where none does."""
    return {gauge.name: gauge.unit for gauge in experiment.readings if gauge.unit} or None


def _compared(answer: Answer, experiment: Experiment) -> SimulatedExperiment:
    """Return the errors of the forward simulation of an experiment."""
    fitted = experiment.name in answer.solution.rms_by_experiment_m
    simulated = answer.rollouts[experiment.name]
    if not isinstance(simulated, Rollout):
        return SimulatedExperiment(fitted, failed=simulated)
    force, torque = simulated.wrench_rms
    return alike(
        SimulatedExperiment,
        simulated,
        fitted=fitted,
        failed=None,
        wrench_rms_n=force,
        wrench_rms_nm=torque,
        reading_rms=simulated.reading_rms or None,
        reading_unit=_units(experiment),
        depth=simulated.depth or None,
        copied=simulated.copied if isinstance(simulated.copied, CopyError) else None,
        not_copied=simulated.copied if isinstance(simulated.copied, str) else None,
    )


# What was estimated of a recording alone ----------------------------------------------------------


def _nuisance(answer: Answer) -> dict[str, dict[str, FoundNuisance]]:
    """Return the nuisance parameters, without the places of markers, by experiment and label."""
    deviations = answer.uncertainty.nuisance if answer.uncertainty is not None else {}
    named: dict[str, dict[str, FoundNuisance]] = {}
    for part in answer.solution.parts:
        for entry, name, value in part.segment.nuisance.valued(part.phi):
            error = deviations[name] * entry.sigma if name in deviations else None
            here = named.setdefault(part.segment.experiment.name, {})
            here[entry.label] = FoundNuisance(value, entry.sigma, error)
    return named


def _of_places(places: Mapping[str, Place]) -> Iterator[str]:
    """Yield sentences on how far places differ from the given ones, and on the accuracy of unknown
    ones.
    """
    moved = {
        n: place.moved_m or 0.0 for n, place in places.items() if place.prior_m and place.given
    }
    if moved:
        worst = max(moved, key=moved.__getitem__)
        yield (
            f"markers sit off their places by up to {short(1e3 * moved[worst])} mm ({worst}; "
            f"prior {short(1e3 * places[worst].prior_m)})"
        )
    if unknown := [place for place in places.values() if not place.given]:
        count = f"{len(unknown)} marker" + ("s" if len(unknown) > 1 else "")
        errors = [float(p.std_error_m.max()) for p in unknown if p.std_error_m is not None]
        known = f", found to ±{short(1e3 * max(errors))} mm" if len(errors) == len(unknown) else ""
        yield f"{count} without a place{known} (prior {short(1e3 * unknown[0].prior_m)})"


def _of_rows(part: Part, answer: Answer) -> Iterator[str]:
    """Yield a sentence on each kind of nuisance parameter but the places, with the estimate and its
    prior.
    """
    nuisance = part.segment.nuisance
    values = part.phi * nuisance.scales
    for row in (*part.segment.experiment.nuisance.rows, GAUGE):
        here = nuisance.places(row).tolist()
        if row == PLACE or not here:
            continue
        groups = [[k] for k in here]
        if row.by == "length":
            numbers = dict.fromkeys(nuisance.entries[k].number for k in here)
            vectors = [nuisance.places(row, of=number).tolist() for number in numbers]
            # Several markers have one each: the longest counts.
            groups = [max(vectors, key=lambda own: float(np.linalg.norm(values[own])))]
        elif row.by == "worst":
            groups = [[max(here, key=lambda k: abs(part.phi[k]))]]
        for own in groups:
            yield _sentence(part, own, values[own], answer)


def _sentence(part: Part, own: Sequence[int], values: Array, answer: Answer) -> str:
    """Return the sentence on a vector, or a number, of nuisance parameters.

    Parameters
    ----------
    part : Part
        Experiment at the solution.
    own : sequence of int
        Indices of its components in φ.
    values : (k,) array
        Their values in the unit of the row.
    answer : Answer
    """
    nuisance = part.segment.nuisance
    k = own[0]
    entry = nuisance.entries[k]
    name = nuisance.names[k]
    known = answer.uncertainty.nuisance if answer.uncertainty else {}
    low, high = (limit[k] for limit in nuisance.limits(part.segment.chart.samples))
    factor, unit = in_unit_for_people(1.0, entry.unit)
    if entry.row == TARE:  # of the sensor, on which the whole specimen acts
        factor *= part.segment.experiment.symmetry
    size = float(np.linalg.norm(values))
    error = entry.sigma * known.get(name, np.nan)
    allowed = low + 1e-3 < part.phi[k] < high - 1e-3
    sentence = (entry.row.told or "{which} {signed}").format(
        size=f"{short(factor * size)}{unit}",
        signed=f"{short(factor * float(values[0]))}{unit}",
        number=short(factor * size),
        unit=unit,
        error="" if np.isnan(error) else f" ± {short(factor * error)}",
        way="later" if values[0] > 0 else "earlier",
        which=entry.label.rpartition(" [")[0],
        limit="" if allowed else ", the most that is allowed",
        stated=f"{nuisance.timed[entry.number].stated_s:g} s" if entry.row == JOINING else "",
    )
    return f"{sentence} (prior {short(factor * entry.sigma)})"
