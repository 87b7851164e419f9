"""Conversion of an answer to `Result`, the content of ``result.json``."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import casadi
import numpy as np

from ..common.array_types import Array
from ..common.display import short
from ..common.files import SCHEMA
from ..common.installation import package_version
from ..common.serialisation import copy_fields
from ..features.measurements import (
    FitResult,
    FittedExperiment,
    ForwardResult,
    SimulatedExperiment,
    prediction_error,
    stated_sigmas,
)
from ..fem.laws.constants import GAMMA_R, YOUNG
from ..fem.schemes import as_scheme
from ..methods.solution import pooled_wrench_rms
from ..methods.starts.start import ScanSummary
from ..model.contact.summary import friction_summaries
from ..problem import Problem
from ..program.collocation import ExperimentIterate
from ..recording.deviation import in_readable_unit
from ..recording.nuisance import GAUGE, JOINING, PLACE, SPECIMEN_FACTORS, TARE
from ..statistics.combinations import identifiability_sentences
from ..statistics.field_estimates import FieldEstimate
from ..statistics.scale_identifiability import ScaleReference, scale_reference
from ..statistics.uncertainty import MarkerPlace
from .result_content import (
    UNMOVED,
    DynamicsResult,
    FieldResult,
    NuisanceResult,
    ProgramSize,
    Provenance,
    RecordingsAgreement,
    Result,
    UncertaintyResult,
)
from .solved_problem import SolvedProblem

# Relative change of E over the anisotropy along an axis from which on E is the modulus along it.
ALONG = 0.7
# Smallest relative change of E that is reported.
LEAST_CHANGE = 0.01


def build_result(answer: SolvedProblem) -> Result:
    """Return the content of ``result.json`` for an answer.

    Cached properties of the answer that are not known yet, such as the natural modes, are computed
    and stored; nothing else of it changes, and no file is written. The answer must have an entry in
    `rollouts` for every experiment of the problem.
    """
    solution = answer.solution
    problem = answer.problem
    collocation = solution.collocation
    values = answer.estimates
    scale = scale_reference(
        problem.experiments, problem.parameters, deviation=problem.assumed_deviations["mass"]
    )
    return Result(
        schema=SCHEMA,
        status=solution.status.value,
        converged=solution.status.converged,
        message=solution.message,
        missing=answer.omitted_checks,
        trust=answer.trust,
        method=solution.method,
        title=problem.title,
        parameters={item.name: values[item.name] for item in collocation.parameters.components},
        derived={name: values[name] for name in answer.derived},
        basis=tuple(_reference_sentences(answer, scale)),
        budget={name: line.shares for name, line in answer.budget.items()},
        effects=answer.effects,
        joint=answer.joint,
        scale=scale,
        places=answer.places,
        nuisance=_nuisance(answer),
        fields={name: _field_result(field) for name, field in answer.fields.items()},
        uncertainty=_uncertainty_result(answer),
        scan=None if solution.scan is None else copy_fields(ScanSummary, solution.scan),
        fit=_fit_result(answer),
        residuals=answer.diagnoses,
        dynamics=DynamicsResult(
            solution.max_violation_n,
            solution.max_violation_relative,
            largest=tuple(map(str, solution.largest_violations)),
        ),
        rollout=_forward_results(answer),
        iterations=solution.iterations,
        evaluations=solution.evaluations,
        timing_s=solution.timing,
        elapsed_s=answer.elapsed_s,
        problem=ProgramSize(
            sum(len(body.nodes_m) for body in problem.bodies),
            sum(len(body.cells) for body in problem.bodies),
            substeps=collocation.substeps,
            timesteps=sum(transcription.grid_times for transcription in collocation.transcriptions),
            variables=collocation.variable_count,
            constraints=collocation.constraint_count,
            scheme=as_scheme(collocation.scheme).name,
        ),
        notes=tuple(
            note
            for note in dict.fromkeys([*problem.notes, *solution.notes, *answer.all_notes])
            if note not in answer.trust.reasons
        ),
        history=tuple(solution.history),
        provenance=_provenance(problem),
    )


def _provenance(problem: Problem) -> Provenance:
    """Return versions, platform, and the SHA-256 hashes of the problem file and of each mesh.

    Recordings are not hashed. Path and hash of the problem file are None for a problem that was
    made in Python; no file is read.
    """
    origin = problem.origin
    text = None if origin is None else origin.text.encode()
    return Provenance(
        version=package_version(),
        casadi=casadi.CasadiMeta.version(),
        numpy=np.__version__,
        python=platform.python_version(),
        platform=platform.platform(),
        problem_file=None if origin is None else str(origin.path.resolve()),
        problem_sha256=None if text is None else hashlib.sha256(text).hexdigest(),
        mesh_sha256=tuple(body.mesh.sha256 for body in problem.bodies),
    )


def _reference_sentences(answer: SolvedProblem, scale: ScaleReference | None) -> Iterator[str]:
    problem = answer.problem
    parts = [part for each in problem.experiments if not each.is_static for part in each.body.parts]
    laws = dict.fromkeys(part.damping.name for part in parts if GAMMA_R in part.damping.constants)
    law_names = [
        law + (", which also damps rigid rotation" if law == "rayleigh" else "") for law in laws
    ]
    if law_names:
        yield f"{GAMMA_R.symbol} refers to the damping law {' and '.join(law_names)}"
    if scale is not None:
        yield scale.sentence
    tests = [each.specimen for each in problem.experiments if each.specimen is not None]
    if any(test.area_over_length_m or "force" in test.columns for test in tests):
        yield (
            "moduli are inversely proportional to the stated area_m2, of which no fit shows an error (a "
            "round section has 0.785 times the area of a square one of the same width)"
        )
    if sentence := _modulus_axis_sentence(answer):
        yield sentence


def _modulus_axis_sentence(answer: SolvedProblem) -> str:
    """Return a sentence on the axis of the mesh along which Young's modulus is measured, as in
    bending; "" if there is none, or if the deviation of the anisotropy changes E by less than
    `LEAST_CHANGE`.
    """
    known = answer.estimates.get(YOUNG.name)
    anisotropy = answer.problem.assumed_deviations["anisotropy"]
    if answer.posterior is None or not anisotropy or known is None or not known.value:
        return ""
    by_q = answer.posterior.derivatives[YOUNG.name] / known.value / anisotropy
    names, columns = answer.posterior.sources
    by_axis = {
        name.partition(" ")[2]: float(by_q @ way[: len(by_q)])
        for name, way in zip(names, columns.T, strict=True)
        if name.startswith("anisotropy")
    }
    axis = max(by_axis, key=lambda each: by_axis[each], default="")
    if not axis or by_axis[axis] < ALONG or by_axis[axis] * anisotropy < LEAST_CHANGE:
        return ""
    return (
        f"E is mainly the modulus along the {axis} axis of the mesh: if the body is 10 % stiffer "
        f"along it than across it, E is {by_axis[axis]:.0%} of this larger than across it"
    )


def _uncertainty_result(answer: SolvedProblem) -> UncertaintyResult | None:
    known = answer.uncertainty
    if known is None or not known.names:
        return None
    reported = [k for k, name in enumerate(known.names) if name in known.estimates]
    both = np.ix_(reported, reported)
    is_combined = answer.posterior is not None
    return copy_fields(
        UncertaintyResult,
        known,
        names=tuple(known.names[k] for k in reported),
        correlation=known.correlation[both],
        covariance=known.covariance[both],
        quantiles=known.quantiles[reported],
        combined_covariance=answer.covariance()[both] if is_combined else None,
        draw_covariance=answer.draw_covariance if is_combined else None,
        noise_factors=known.level.factors,
        autocorrelation=known.dependence.lag1,
        verdicts=tuple(identifiability_sentences(known, answer.combinations)),
        combinations=answer.combinations,
        directions=answer.principal_directions,
        recordings=_recordings_agreement(answer),
        profiles=answer.profiles,
    )


def _field_result(estimate: FieldEstimate) -> FieldResult:
    """Share and number of modes are None, without evidence, if a deviation is not finite."""
    modes = estimate.modes
    known = bool(np.isfinite(estimate.deviation).all())
    share = float(modes.volumes_m3[estimate.is_informed].sum() / modes.volumes_m3.sum())
    lengths_m = modes.field.lengths_m if known else ()
    return FieldResult(
        modes.describe_resolution(),
        (float(estimate.value.min()), float(estimate.value.max())),
        determined_share=share if known else None,
        identified=estimate.identified_mode_count if known else None,
        likelier={f"{each:g}": estimate.log_evidence_ratio(each) for each in lengths_m},
    )


def _recordings_agreement(answer: SolvedProblem) -> dict[str, RecordingsAgreement] | None:
    if answer.uncertainty is None or (scatter := answer.uncertainty.scatter) is None:
        return None
    q = answer.solution.q
    agreements = {}
    parameters = answer.solution.collocation.parameters
    for k in parameters.scalar_coordinates:
        item = parameters.free[k]
        values = map(item.from_coordinate, (q[k] + scatter.differences[:, k]).tolist())
        agreements[item.name] = RecordingsAgreement(
            dict(zip(scatter.recordings, values, strict=True)),
            dict(zip(scatter.recordings, scatter.deviations[:, k].tolist(), strict=True)),
            chi_squared=float(scatter.chi_squared[k]),
            degrees_of_freedom=int(scatter.degrees_of_freedom[k]),
            disagree=bool(scatter.find_disagreements()[k]),
        )
    return agreements


def _fit_result(answer: SolvedProblem) -> FitResult:
    solution = answer.solution
    experiments = {}
    for part in solution.parts:
        experiment = part.transcription.experiment
        name = experiment.name
        markers = experiment.markers
        friction = ()
        if experiment.obstacles:
            friction = friction_summaries(experiment, part.equations.dynamics, x=part.x)
        errors = prediction_error(experiment, solution.fitted_values[name])
        experiments[name] = FittedExperiment(
            **vars(replace(errors, rms_m=errors.rms_m or 0.0, max_m=None)),
            samples=markers.sample_count,
            missing=int(markers.missing_count.sum()),
            static=experiment.is_static,
            notes=(*_place_sentences(answer.places[name]), *_nuisance_sentences(part, answer)),
            **stated_sigmas(experiment),
            friction=friction or None,
            air_density_kg_m3=experiment.air_density_kg_m3,
            test=experiment.specimen and experiment.specimen.test,
        )
    parts = {
        experiment.name: experiment.symmetry
        for experiment in answer.problem.experiments
        if experiment.symmetry > 1
    }
    force_n, torque_nm = pooled_wrench_rms(solution)
    return FitResult(
        solution.rms_m,
        answer.noise_rms_m,
        experiments,
        wrench_rms_n=force_n,
        wrench_rms_nm=torque_nm,
        symmetry=parts or None,
    )


def _forward_results(answer: SolvedProblem) -> ForwardResult:
    simulated = {}
    fitted = []
    for experiment in answer.problem.experiments:
        rollout = answer.rollouts[experiment.name]
        if isinstance(rollout, str):
            failed = SimulatedExperiment(fitted=not experiment.validation, failed=rollout)
            simulated[experiment.name] = failed
            continue
        simulated[experiment.name] = copy_fields(SimulatedExperiment, rollout)
        if rollout.fitted:
            fitted.append((experiment.markers.sample_count, rollout.rms_m, rollout.max_m))
    if not fitted:
        return ForwardResult(None, None, experiments=simulated)
    counts, rms_m, max_m = np.transpose(fitted)
    total = float(np.sqrt(counts @ rms_m**2 / max(1, counts.sum())))
    return ForwardResult(total, float(max_m.max()), experiments=simulated)


# What was estimated of a recording alone ----------------------------------------------------------


def _nuisance(answer: SolvedProblem) -> dict[str, dict[str, NuisanceResult]]:
    deviations = answer.uncertainty.nuisance if answer.uncertainty is not None else {}
    named: dict[str, dict[str, NuisanceResult]] = {}
    for part in answer.solution.parts:
        here = {
            entry.label: NuisanceResult(
                value, entry.sigma, deviations[name] * entry.sigma if name in deviations else None
            )
            for entry, name, value in part.transcription.nuisance.iterate_values(part.phi)
        }
        if here:
            named[part.transcription.experiment.name] = here
    return named


def _place_sentences(places: Mapping[str, MarkerPlace]) -> Iterator[str]:
    """Yield how far stated places moved, and how accurate unknown ones are."""
    moved = {
        n: place.displacement_m or 0.0
        for n, place in places.items()
        if place.prior_m and place.is_declared
    }
    if moved:
        worst = max(moved, key=moved.__getitem__)
        yield (
            "displacement of markers from their stated positions: up to "
            f"{short(1e3 * moved[worst])} mm ({worst}; prior "
            f"±{short(1e3 * places[worst].prior_m)} mm)"
        )
    if unknown := [place for place in places.values() if not place.is_declared]:
        count = f"{len(unknown)} marker" + ("s" if len(unknown) > 1 else "")
        errors = [float(p.std_error_m.max()) for p in unknown if p.std_error_m is not None]
        known = (
            f", estimated to ±{short(1e3 * max(errors))} mm" if len(errors) == len(unknown) else ""
        )
        yield f"positions of {count}{known} (prior ±{short(1e3 * unknown[0].prior_m)} mm)"


def _nuisance_sentences(part: ExperimentIterate, answer: SolvedProblem) -> Iterator[str]:
    nuisance = part.transcription.nuisance
    values = part.phi * nuisance.scales
    for row in (*part.transcription.experiment.nuisance.kinds, GAUGE, *SPECIMEN_FACTORS.values()):
        here = nuisance.indices_of_rows(row).tolist()
        if row == PLACE or not here:
            continue
        groups = [[k] for k in here]
        if row.by == "length":
            entry_numbers = dict.fromkeys(nuisance.entries[k].number for k in here)
            vectors = [
                nuisance.indices_of_rows(row, component=number).tolist() for number in entry_numbers
            ]
            # Several markers have one each: the longest counts.
            groups = [max(vectors, key=lambda own: float(np.linalg.norm(values[own])))]
        elif row.by == "worst":
            groups = [[max(here, key=lambda k: abs(part.phi[k]))]]
        for own in groups:
            if float(np.linalg.norm(part.phi[own])) > UNMOVED:
                yield _nuisance_sentence(part, own, values=values[own], answer=answer)


def _nuisance_sentence(
    part: ExperimentIterate, components: Sequence[int], values: Array, answer: SolvedProblem
) -> str:
    """Say whether it is at its bound for kinds whose sentence has a place for it."""
    nuisance = part.transcription.nuisance
    k = components[0]
    entry = nuisance.entries[k]
    name = nuisance.names[k]
    known = answer.uncertainty.nuisance if answer.uncertainty else {}
    low, high = (
        limit[k] for limit in nuisance.bounds(part.transcription.association.clock_samples)
    )
    factor, unit = in_readable_unit(1.0, entry.unit_in_label())
    if entry.row == TARE:  # of the sensor, on which the whole specimen acts
        factor *= part.transcription.experiment.symmetry
    size = float(np.linalg.norm(values))
    error = entry.sigma * known.get(name, np.nan)
    allowed = low + 1e-3 < part.phi[k] < high - 1e-3
    sentence = (entry.row.sentence or "{which} {signed}").format(
        size=f"{short(factor * size)}{unit}",
        signed=f"{short(factor * float(values[0]))}{unit}",
        number=short(factor * size),
        unit=unit,
        error="" if np.isnan(error) else f" ± {short(factor * error)}",
        way="later" if values[0] > 0 else "earlier",
        which=entry.label.rpartition(" [")[0],
        limit="" if allowed else ", the largest value allowed",
        stated=f"{nuisance.timed_loads[entry.number].declared_s:g} s"
        if entry.row == JOINING
        else "",
    )
    return f"{sentence} (prior ±{short(factor * entry.sigma)}{unit})"
