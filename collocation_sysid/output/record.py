"""What a run leaves behind: result.json, arrays, plots and ParaView frames in one folder."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from importlib.metadata import version
from pathlib import Path
from typing import Any

import casadi
import numpy as np

from ..arrays import Array
from ..experiment.experiment import Experiment
from ..files import SCHEMA
from ..methods.scan import Scan
from ..methods.solution import Solution, pooled_wrench_rms
from ..nlp.schemes import as_scheme
from ..problem import Problem
from ..rollout import Rollout
from ..run import Run
from ..statistics.identifiability import verdicts
from .fields import ElementFields
from .replay import Replay
from .writers import run_folder, write_frames

REFINEMENT_FILE = "refinement.json"


def write_run(finished: Run, folder: str | Path, frames: bool = True) -> Path:
    """Write the run folder, whole or not at all, and return it.

    ``result.json``, ``problem.toml`` as run where the problem has a file, ``trajectory.npz``,
    pictures, and ``frames/`` with ``trajectory.pvd`` for ParaView. With several experiments the
    arrays' names and the frames' folders have the experiment's name in front.
    """
    solution = finished.solution
    with run_folder(folder) as place:
        origin = finished.problem.origin
        if origin is not None:
            (place / "problem.toml").write_text(origin.text, encoding="utf-8")
        (place / "result.json").write_text(as_json(result(finished)) + "\n", encoding="utf-8")
        if finished.refinement is not None and finished.refinement.levels:
            text = as_json(finished.refinement.as_dict())
            (place / REFINEMENT_FILE).write_text(text + "\n", encoding="utf-8")
        seen = replays(finished)
        np.savez_compressed(place / "trajectory.npz", allow_pickle=False, **_arrays(seen))
        _write_pictures(finished, seen, place)
        if frames:
            _write_all_frames(solution, place)
    return Path(folder)


def _write_pictures(finished: Run, seen: Sequence[Replay], place: Path) -> None:
    # matplotlib takes a while to import, and nothing else needs it.
    from .pictures import Confidence, album, jacobian_sparsity, save_pictures

    solution = finished.solution
    free = [item.name for item in solution.collocation.parameters.free]
    found = finished.uncertainty
    confidence = Confidence.of(found) if found is not None else None
    pictures = album(seen, solution.history, free, confidence, scan=_scan(solution.scan))
    pictures["jacobian"] = jacobian_sparsity(solution.collocation, solution.z)
    save_pictures(place, pictures)


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


def replays(finished: Run) -> list[Replay]:
    """The experiments as they are looked at: those fitted, then those for validation."""
    solution = finished.solution
    fitted = {
        segment.experiment.name: (positions[segment.observation.grid_rows], readings)
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
            sensed = _sensed(finished, experiment)
            found.append(Replay.of(experiment, fit, rolled_out, natural, places_m, sensed))
    return found


def _sensed(finished: Run, experiment: Experiment) -> list[Array]:
    """(S, 19) of each sensor: time, and the wrench as measured, fitted and rolled out."""
    sensors = [grasp.wrench for grasp in experiment.grasps if grasp.wrench is not None]
    rollout, fitted = finished.rollouts[experiment.name], finished.solution.wrenches
    found = []
    for k, sensor in enumerate(sensors):
        nothing = np.full_like(sensor.values, np.nan)
        fit = fitted[experiment.name][k] if experiment.name in fitted else nothing
        rolled = rollout.wrenches[k] if isinstance(rollout, Rollout) else nothing
        found.append(np.column_stack([sensor.t_s, sensor.values, fit, rolled]))
    return found


def _places_m(finished: Run, experiment: str) -> Array | None:
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


def result(finished: Run) -> dict[str, Any]:
    """The content of result.json."""
    solution, problem = finished.solution, finished.problem
    collocation = solution.collocation
    fitted = {segment.experiment.name for segment in collocation.segments}
    rolled = {n: r for n, r in finished.rollouts.items() if isinstance(r, Rollout) and n in fitted}
    return {
        "schema": SCHEMA,
        "status": solution.status.value,
        "converged": solution.status.converged,
        "message": solution.message,
        "missing": finished.missing,
        "trust": {"verdict": finished.trust.verdict, "reasons": list(finished.trust.reasons)},
        "method": solution.method,
        "title": problem.title,
        "parameters": _parameters(finished),
        "derived": {name: _with_errors(finished, name) for name in finished.derived},
        "places": _places(finished),
        "nuisance": _nuisance(finished),
        "uncertainty": _uncertainty(finished),
        "scan": _scan(solution.scan),
        "fit": _fit(solution) | {"noise_rms_m": finished.noise_rms_m},
        "residuals": [
            {**asdict(diagnosis), "offset_m": diagnosis.offset_m.tolist()}
            for diagnosis in finished.diagnoses
        ],
        "dynamics": {
            "max_violation_n": solution.max_violation_n,
            "max_violation_relative": solution.max_violation_relative,
            "largest": [str(violation) for violation in solution.largest_violations],
        },
        "rollout": {
            "rms_m": _pooled_rms(finished, rolled),
            "max_m": max((r.max_m for r in rolled.values()), default=None),
            "experiments": {
                name: {
                    "rms_m": r.rms_m,
                    "max_m": r.max_m,
                    "fitted": name in fitted,
                    "nuisance": r.nuisance,
                    "places_m": r.places_m,
                    **_wrench_rms(r.wrench_rms),
                }
                if isinstance(r, Rollout)
                else {"failed": r, "fitted": name in fitted}
                for name, r in finished.rollouts.items()
            },
        },
        "iterations": solution.iterations,
        "evaluations": solution.evaluations,
        "timing_s": {
            field.name: getattr(solution.timing, field.name) for field in fields(solution.timing)
        },
        "problem": {
            "nodes": sum(len(body.nodes_m) for body in problem.bodies),
            "elements": sum(len(body.cells) for body in problem.bodies),
            "substeps": collocation.substeps,
            "timesteps": sum(segment.grid_rows for segment in collocation.segments),
            "variables": collocation.variables,
            "constraints": collocation.constraints,
            "scheme": as_scheme(collocation.scheme).name,
        },
        "notes": list(dict.fromkeys([*problem.notes, *solution.notes, *finished.all_notes])),
        "history": [
            {
                "iteration": line.number,
                "loss": line.loss,
                "rms_m": line.rms_m,
                "violation_n": line.violation_n,
                "parameters": line.parameters,
                "time_s": line.time_s,
                "share": line.share,
            }
            for line in solution.history
        ],
        "provenance": _provenance(problem),
    }


def _provenance(problem: Problem) -> dict[str, Any]:
    origin = problem.origin
    text = None if origin is None else origin.text.encode()
    return {
        "version": version("collocation-sysid"),
        "casadi": casadi.CasadiMeta.version(),
        "numpy": np.__version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "problem_file": None if origin is None else str(origin.path),
        "problem_sha256": None if text is None else hashlib.sha256(text).hexdigest(),
        "mesh_sha256": [body.mesh.sha256 for body in problem.bodies],
    }


def as_json(content: Any) -> str:
    """Text of a result; JSON has no NaN and no infinity, null takes their place."""
    return json.dumps(_finite(content), indent=1, allow_nan=False)


def _finite(content: Any) -> Any:
    if isinstance(content, dict):
        return {key: _finite(value) for key, value in content.items()}
    if isinstance(content, (list, tuple)):
        return [_finite(value) for value in content]
    return None if isinstance(content, float) and not np.isfinite(content) else content


def _parameters(finished: Run) -> dict[str, Any]:
    return {
        item.name: {
            "guess": item.guess,
            "fixed": item.fixed or item.tied is not None,
            **_with_errors(finished, item.name),
        }
        for item in finished.started_from.items
    }


def _with_errors(finished: Run, name: str) -> dict[str, Any]:
    estimate, noise = finished.estimates[name], finished.noise_estimates[name].ci95
    error = None if finished.refinement is None else finished.refinement.errors.get(name)
    return {
        "value": estimate.value,
        "std_error": estimate.std_error,
        "ci95": None if estimate.ci95 is None else list(estimate.ci95),
        "ci95_holds": [] if estimate.ci95 is None else list(finished.interval_holds),
        "ci95_noise": None if noise is None else list(noise),
        "at_bound": estimate.at_bound,
        "reason": estimate.reason,
        "numerical_error": None if error is None else asdict(error),
    }


def _places(finished: Run) -> dict[str, dict[str, dict[str, Any]]]:
    return {
        experiment: {
            name: {
                "position_m": place.position_m.tolist(),
                "std_error_m": None if place.std_error_m is None else place.std_error_m.tolist(),
                "prior_m": place.prior_m,
                "given": place.given,
            }
            for name, place in places.items()
        }
        for experiment, places in finished.places.items()
    }


def _nuisance(finished: Run) -> dict[str, dict[str, Any]]:
    """Nuisance parameters but the places in their units, with the deviation of their prior."""
    deviations = finished.uncertainty.nuisance if finished.uncertainty is not None else {}
    collocation = finished.solution.collocation
    found = {}
    for part in collocation.parts(finished.solution.z):
        for entry, name, value in part.segment.nuisance.valued(part.phi):
            found.setdefault(part.segment.experiment.name, {})[entry.label] = {
                "value": value,
                "prior": entry.sigma,
                "std_error": deviations[name] * entry.sigma if name in deviations else None,
            }
    return found


def _scan(scan: Scan | None) -> dict[str, Any] | None:
    if scan is None:
        return None
    return {
        "reason": scan.reason,
        "young_pa": scan.young_pa.tolist(),
        "misfit": scan.misfit.tolist(),
        "best": scan.best,
        "samples": scan.samples,
        "time_s": scan.time_s,
        "sentence": scan.sentence,
    }


def _uncertainty(finished: Run) -> dict[str, Any] | None:
    found = finished.uncertainty
    if found is None:
        return None
    return {
        "noise": found.noise,
        "errors": found.errors,
        "reduced_chi_squared": found.reduced_chi_squared,
        "noise_factors": found.level.factors,
        "autocorrelation": found.dependence.lag1,
        "names": list(found.names),
        "correlation": found.correlation.tolist(),
        "covariance": found.covariance.tolist(),
        "quantiles": found.quantiles.tolist(),
        "verdicts": list(verdicts(found)),
        "recordings": _recordings(finished),
        "profiles": {
            profile.parameter: {
                "interval": list(profile.interval),
                "values": profile.values.tolist(),
                "rises": (profile.losses - profile.losses.min()).tolist(),
                "threshold": profile.threshold,
                "sentence": profile.sentence,
            }
            for profile in finished.profiles
        },
    }


def _recordings(finished: Run) -> dict[str, Any] | None:
    """What each recording says by itself of the parameters, to first order, and how they agree."""
    found = finished.uncertainty
    if found is None or found.scatter is None:
        return None
    scatter, free = found.scatter, finished.solution.collocation.parameters.free
    q = finished.solution.q
    return {
        item.name: {
            "values": {
                name: item.value(float(q[k] + away)) if np.isfinite(away) else None
                for name, away in zip(scatter.recordings, scatter.away[:, k], strict=True)
            },
            "deviations": dict(
                zip(scatter.recordings, scatter.deviations[:, k].tolist(), strict=True)
            ),
            "chi_squared": float(scatter.chi_squared[k]),
            "degrees_of_freedom": int(scatter.freedom[k]),
            "disagree": bool(scatter.disagreeing[k]),
        }
        for k, item in enumerate(free)
    }


def _fit(solution: Solution) -> dict[str, Any]:
    experiments = {}
    for segment in solution.collocation.segments:
        name, markers = segment.experiment.name, segment.experiment.markers
        experiments[name] = {
            "rms_m": solution.rms_by_experiment_m[name],
            "samples": markers.samples,
            "missing": int(markers.missing.sum()),
        } | _wrench_rms(solution.wrench_rms.get(name))
    return {"rms_m": solution.rms_m, **_wrench_rms(pooled_wrench_rms(solution))} | {
        "experiments": experiments
    }


def _wrench_rms(found: tuple[float | None, float | None] | None) -> dict[str, float]:
    """Those that there are."""
    named = zip(("wrench_rms_n", "wrench_rms_nm"), found or (None, None), strict=True)
    return {name: value for name, value in named if value is not None}


def _pooled_rms(finished: Run, rolled: Mapping[str, Rollout]) -> float | None:
    if not rolled:
        return None
    counts = {e.name: e.markers.samples for e in finished.problem.experiments}
    squares = sum(counts[name] * r.rms_m**2 for name, r in rolled.items())
    return float(np.sqrt(squares / max(1, sum(counts[name] for name in rolled))))
