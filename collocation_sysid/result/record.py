"""What a run leaves behind: result.json, arrays, plots and ParaView frames in one folder."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import casadi
import numpy as np

from ..arrays import Array
from ..files import SCHEMA
from ..methods.solution import Solution, pooled_wrench_rms, reading_rms
from ..model.schemes import as_scheme
from ..problem import Problem
from ..recording.experiment import Experiment
from ..runs.answer import Answer
from ..runs.forward_simulation import Rollout
from ..runs.result import (
    FittedExperiment,
    FoundDynamics,
    FoundFit,
    FoundNuisance,
    FoundProfile,
    FoundRollout,
    FoundScan,
    FoundUncertainty,
    FoundValue,
    HistoryLine,
    ProgramSize,
    Provenance,
    RecordingsAgreement,
    Result,
    SimulatedExperiment,
)
from ..statistics.identifiability import verdicts
from ..tree import alike, as_json
from .fields import ElementFields
from .replay import Replay
from .writers import run_folder, write_frames

REFINEMENT_FILE = "refinement.json"


def write_run(finished: Answer, folder: str | Path, frames: bool = True) -> Path:
    """Write the run folder, whole or not at all, and return it.

    ``result.json``, ``problem.toml`` as run where the problem has a file, ``trajectory.npz``,
    pictures, and ``frames/`` with ``trajectory.pvd`` for ParaView. With several experiments the
    arrays' names and the frames' folders have the experiment's name in front.
    """
    solution = finished.solution
    found = result(finished)
    with run_folder(folder) as place:
        origin = finished.problem.origin
        if origin is not None:
            (place / "problem.toml").write_text(origin.text, encoding="utf-8")
        (place / "result.json").write_text(as_json(found) + "\n", encoding="utf-8")
        if finished.refinement is not None and finished.refinement.levels:
            text = as_json(finished.refinement)
            (place / REFINEMENT_FILE).write_text(text + "\n", encoding="utf-8")
        seen = replays(finished)
        np.savez_compressed(place / "trajectory.npz", allow_pickle=False, **_arrays(seen))
        _write_pictures(finished, found, seen, place)
        if frames:
            _write_all_frames(solution, place)
    return Path(folder)


def _write_pictures(finished: Answer, found: Result, seen: Sequence[Replay], place: Path) -> None:
    # matplotlib takes a while to import, and nothing else needs it.
    from .pictures import album, jacobian_sparsity, save_pictures

    solution = finished.solution
    jacobian = jacobian_sparsity(solution.collocation, solution.z)
    save_pictures(place, album(seen, found) | {"jacobian": jacobian})


def _write_all_frames(solution: Solution, place: Path) -> None:
    collocation = solution.collocation
    for part in collocation.parts(solution.z):
        segment, positions = part.segment, part.x.reshape(len(part.x), -1, 3)
        alone = len(collocation.segments) == 1
        here = place if alone else place / segment.experiment.name
        here.mkdir(exist_ok=True)
        body = segment.body
        residual = np.zeros((len(positions), segment.dofs))
        residual[:, segment.free_dofs] = part.residual_n
        write_frames(
            here,
            segment.dynamics.t_s,
            positions,
            body.cells,
            body.element,
            body.nodes_m,
            {"residual_force_n": residual.reshape(positions.shape)},
            fields=ElementFields.of(body, body.theta(solution.parameters)),
            cell_data={"region": body.part_of_cells} if len(body.parts) > 1 else None,
        )


def replays(finished: Answer) -> list[Replay]:
    """The experiments as they are looked at: those fitted, then those for validation."""
    solution = finished.solution
    fitted = {
        segment.experiment.name: (positions[segment.markers.grid_rows], readings)
        for segment, positions, readings in zip(
            solution.collocation.segments, solution.positions_m, solution.readings_m, strict=True
        )
    }
    found = []
    for experiment in sorted(finished.problem.experiments, key=lambda each: each.validation):
        rollout = finished.rollouts[experiment.name]
        rolled_out = None
        if isinstance(rollout, Rollout):
            rolled_out = rollout.trajectory.positions_m, rollout.trajectory.markers_m
        fit = fitted.get(experiment.name)
        if fit is not None or rolled_out is not None:
            motion = finished.motions.get(experiment.name)
            natural = motion and np.array([mode.frequency_hz for mode in motion.modes])
            places_m = _places_m(finished, experiment.name)
            read = _sensed(finished, experiment), _own_readings(finished, experiment)
            found.append(Replay.of(experiment, fit, rolled_out, natural, places_m, *read))
    return found


def _sensed(finished: Answer, experiment: Experiment) -> list[Array]:
    """(S, 19) of each sensor: time, and the wrench as measured, fitted and simulated."""
    sensors = [grasp.wrench for grasp in experiment.grasps if grasp.wrench is not None]
    rollout, fitted = finished.rollouts[experiment.name], finished.solution.wrenches
    found = []
    for k, sensor in enumerate(sensors):
        nothing = np.full_like(sensor.values, np.nan)
        fit = fitted[experiment.name][k] if experiment.name in fitted else nothing
        rolled = rollout.wrenches[k] if isinstance(rollout, Rollout) else nothing
        found.append(np.column_stack([sensor.t_s, sensor.values, fit, rolled]))
    return found


def _own_readings(finished: Answer, experiment: Experiment) -> dict[str, Array]:
    """(S, 1 + 3m) of each reading of one's own: time, as measured, fitted and simulated."""
    rollout, fit = finished.rollouts[experiment.name], finished.solution.readings
    rolled = rollout.readings if isinstance(rollout, Rollout) else {}
    both = fit.get(experiment.name, {}), rolled
    return {
        gauge.name: np.column_stack(
            [
                gauge.times,
                gauge.measured,
                *(each.get(gauge.name, np.full_like(gauge.measured, np.nan)) for each in both),
            ]
        )
        for gauge in experiment.readings
    }


def _places_m(finished: Answer, experiment: str) -> Array | None:
    """(M, 3) of the markers as estimated; None where that failed."""
    if experiment in finished.places:
        found = [place.position_m for place in finished.places[experiment].values()]
        return np.array(found).reshape(-1, 3)
    rollout = finished.rollouts[experiment]
    if not isinstance(rollout, Rollout):
        return None
    return np.array([*rollout.places_m.values()]).reshape(-1, 3)


def _arrays(seen: Sequence[Replay]) -> dict[str, Array]:
    """Arrays of trajectory.npz at the samples; a lone fitted experiment has no prefix."""
    alone = sum(replay.positions_m is not None for replay in seen) == 1
    arrays = {}
    for replay in seen:
        bare = alone and replay.positions_m is not None
        arrays |= replay.arrays("" if bare else f"{replay.name}/")
    return arrays


def result(finished: Answer) -> Result:
    """The content of result.json."""
    solution, problem = finished.solution, finished.problem
    collocation = solution.collocation
    values = {name: _value(finished, name) for name in finished.estimates}
    return Result(
        schema=SCHEMA,
        status=solution.status.value,
        converged=solution.status.converged,
        message=solution.message,
        missing=finished.missing,
        trust=finished.trust,
        method=solution.method,
        title=problem.title,
        parameters={item.name: values[item.name] for item in finished.started_from.items},
        derived={name: values[name] for name in finished.derived},
        places=finished.places,
        nuisance=_nuisance(finished),
        uncertainty=_uncertainty(finished),
        scan=None if solution.scan is None else alike(FoundScan, solution.scan),
        fit=_fit(finished),
        residuals=finished.diagnoses,
        dynamics=FoundDynamics(
            solution.max_violation_n,
            solution.max_violation_relative,
            tuple(map(str, solution.largest_violations)),
        ),
        rollout=_rollout(finished),
        iterations=solution.iterations,
        evaluations=solution.evaluations,
        timing_s=solution.timing,
        problem=ProgramSize(
            sum(len(body.nodes_m) for body in problem.bodies),
            sum(len(body.cells) for body in problem.bodies),
            collocation.substeps,
            sum(segment.grid_rows for segment in collocation.segments),
            collocation.variables,
            collocation.constraints,
            as_scheme(collocation.scheme).name,
        ),
        notes=tuple(dict.fromkeys([*problem.notes, *solution.notes, *finished.all_notes])),
        history=tuple(HistoryLine(*vars(line).values()) for line in solution.history),
        provenance=_provenance(problem),
    )


def _provenance(problem: Problem) -> Provenance:
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


def _value(finished: Answer, name: str) -> FoundValue:
    estimate = finished.estimates[name]
    item = next((each for each in finished.started_from.items if each.name == name), None)
    errors = {} if finished.refinement is None else finished.refinement.errors
    found = alike(
        FoundValue,
        estimate,
        ci95_holds=() if estimate.ci95 is None else finished.interval_holds,
        ci95_noise=finished.noise_estimates[name].ci95,
        numerical_error=errors.get(name),
        guess=None,
        fixed=None,
    )
    if item is None:
        return found
    guess = np.nan if item.guess is None else item.guess
    return replace(found, guess=guess, fixed=item.fixed or item.tied is not None)


def _nuisance(finished: Answer) -> dict[str, dict[str, FoundNuisance]]:
    """Nuisance parameters but the places."""
    deviations = finished.uncertainty.nuisance if finished.uncertainty is not None else {}
    collocation = finished.solution.collocation
    found: dict[str, dict[str, FoundNuisance]] = {}
    for part in collocation.parts(finished.solution.z):
        for entry, name, value in part.segment.nuisance.valued(part.phi):
            error = deviations[name] * entry.sigma if name in deviations else None
            here = found.setdefault(part.segment.experiment.name, {})
            here[entry.label] = FoundNuisance(value, entry.sigma, error)
    return found


def _uncertainty(finished: Answer) -> FoundUncertainty | None:
    found = finished.uncertainty
    if found is None:
        return None
    return alike(
        FoundUncertainty,
        found,
        noise_factors=found.level.factors,
        autocorrelation=found.dependence.lag1,
        verdicts=tuple(verdicts(found)),
        recordings=_recordings(finished),
        profiles={
            profile.parameter: alike(
                FoundProfile, profile, rises=profile.losses - profile.losses.min()
            )
            for profile in finished.profiles
        },
    )


def _recordings(finished: Answer) -> dict[str, RecordingsAgreement] | None:
    found = finished.uncertainty
    if found is None or found.scatter is None:
        return None
    scatter, q = found.scatter, finished.solution.q
    agreements = {}
    for k, item in enumerate(finished.solution.collocation.parameters.free):
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


def _fit(finished: Answer) -> FoundFit:
    solution, experiments = finished.solution, {}
    for segment in solution.collocation.segments:
        name, markers = segment.experiment.name, segment.experiment.markers
        experiments[name] = FittedExperiment(
            solution.rms_by_experiment_m[name],
            markers.samples,
            int(markers.missing.sum()),
            *solution.wrench_rms.get(name, (None, None)),
            reading_rms(segment.experiment, solution.readings[name]) or None,
        )
    pooled = pooled_wrench_rms(solution)
    return FoundFit(solution.rms_m, finished.noise_rms_m, experiments, *pooled)


def _rollout(finished: Answer) -> FoundRollout:
    fitted = {segment.experiment.name for segment in finished.solution.collocation.segments}
    experiments, squares, counts, largest = {}, 0.0, 0, []
    for experiment in finished.problem.experiments:
        name, count = experiment.name, experiment.markers.samples
        found = finished.rollouts[name]
        if not isinstance(found, Rollout):
            experiments[name] = SimulatedExperiment(name in fitted, failed=found)
            continue
        force, torque = found.wrench_rms
        experiments[name] = alike(
            SimulatedExperiment,
            found,
            fitted=name in fitted,
            failed=None,
            wrench_rms_n=force,
            wrench_rms_nm=torque,
            reading_rms=found.reading_rms or None,
        )
        if name in fitted:
            squares, counts = squares + count * found.rms_m**2, counts + count
            largest.append(found.max_m)
    if not largest:
        return FoundRollout(None, None, experiments)
    return FoundRollout(float(np.sqrt(squares / max(1, counts))), max(largest), experiments)
