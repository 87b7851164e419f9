"""One run: load, solve, verify by simulating forward, and write the run folder."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from importlib.metadata import version
from pathlib import Path
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

from .errors import InputError, SimulationError
from .experiment import Experiment
from .methods import METHODS
from .nlp.collocation import Collocation
from .nlp.simulation import Trajectory, simulate
from .problem import Problem
from .results.plots import save_plots, solution_plots
from .results.solution import Iteration, Solution, Status
from .results.uncertainty import Estimate, Uncertainty, covariance
from .results.writers import run_folder, write_frames

Array = NDArray[np.float64]
Log = Callable[[str], None]

SCHEMA_VERSION = 1


@dataclass(frozen=True, eq=False)
class Rollout:
    """A forward simulation with the answer's parameters, against the measurements.

    Attributes
    ----------
    rms_m, max_m : distance of the markers from their measurements; the tip error is in `max_m`
    trajectory : Trajectory
    """

    rms_m: float
    max_m: float
    trajectory: Trajectory


@dataclass(frozen=True, eq=False)
class Run:
    """A solved problem with its checks.

    Attributes
    ----------
    problem : Problem
    solution : Solution
    rollouts : mapping of experiment name to Rollout, or to the reason why there is none
    uncertainty : Uncertainty or None, where the solve did not converge
    notes : tuple of str
        What went wrong after the solve.
    """

    problem: Problem
    solution: Solution
    rollouts: Mapping[str, Rollout | str]
    uncertainty: Uncertainty | None
    notes: tuple[str, ...] = ()


def build_collocation(problem: Problem) -> Collocation:
    """The NLP of a problem."""
    transcription = problem.file.transcription
    return Collocation(
        problem.experiments,
        problem.parameters,
        transcription.scheme,
        transcription.substeps,
        transcription.explicit_grasps,
    )


def solve(
    problem: Problem,
    method: str | None = None,
    watch: Callable[[Iteration], None] | None = None,
    **options: Any,
) -> Solution:
    """Solve a problem with a method.

    Parameters
    ----------
    problem : Problem
    method : str, optional
        A key of `methods.METHODS`; the problem file's by default.
    watch : callable, optional
        Called with every `Iteration`.
    **options
        Options of the method, in place of those of the problem file.

    Raises
    ------
    InputError
        For an unknown method or option, and when the solver refuses the problem.
    """
    name = method or problem.file.solver.method
    if name not in METHODS:
        raise InputError(f"found {name!r}; expected one of {', '.join(METHODS)}", None, "--method")
    chosen = METHODS[name]
    known = {field.name for field in fields(chosen.options)}
    in_file = problem.file.solver.model_dump(exclude_unset=True, exclude={"method"})
    foreign = sorted(set(in_file) - known)
    if foreign and method is None:
        raise InputError(
            f"method {name!r} has no such option; it has {', '.join(sorted(known))}. "
            "Name the method it belongs to in solver.method",
            problem.path,
            f"solver.{foreign[0]}",
        )
    unknown = sorted(set(options) - known)
    if unknown:
        raise InputError(f"no option {unknown[0]!r}; {name} has {', '.join(sorted(known))}")
    given = {key: value for key, value in in_file.items() if key in known} | options
    try:
        collocation = build_collocation(problem)
        solution = chosen.solve(collocation, chosen.options(**given), watch)
    except InputError as error:
        raise error.located(problem.path) from error
    if solution.status is Status.REFUSED:
        reasons = "; ".join(solution.notes)
        raise InputError(f"{solution.message} {reasons}".strip(), problem.path, "solver")
    return solution


def run(
    problem: Problem,
    method: str | None = None,
    watch: Callable[[Iteration], None] | None = None,
    log: Log | None = None,
) -> Run:
    """Solve a problem, simulate every experiment with the answer, and find the error bars."""
    say = log or (lambda _: None)
    solution = solve(problem, method, watch)
    say("checking the answer by a forward simulation")
    rollouts = {e.name: _roll_out(problem, e, solution) for e in problem.experiments}
    uncertainty, notes = None, ()
    if solution.status.converged and solution.collocation.nq:
        try:
            uncertainty = covariance(solution.collocation, solution.z)
        except SimulationError as error:
            notes = (f"no error bars: {error}",)
    return Run(problem, solution, rollouts, uncertainty, notes)


def _roll_out(problem: Problem, experiment: Experiment, solution: Solution) -> Rollout | str:
    section, transcription = problem.file.rollout, problem.file.transcription
    integrator = "newmark" if section.integrator == "newmark" else transcription.scheme
    try:
        trajectory = simulate(
            experiment,
            solution.theta,
            integrator,
            timestep_s=section.timestep_s,
            substeps=transcription.substeps,
        )
    except SimulationError as error:
        return str(error)
    except KeyboardInterrupt:  # the answer itself is there, and worth writing
        return "interrupted"
    distances = np.linalg.norm(trajectory.markers_m - experiment.markers.positions_m, axis=2)
    present = distances[experiment.markers.present]
    return Rollout(float(np.sqrt(np.mean(present**2))), float(present.max()), trajectory)


# The run folder -----------------------------------------------------------------------------


def write_run(finished: Run, folder: str | Path, frames: bool = True) -> Path:
    """Write the run folder, whole or not at all, and return it.

    ``result.json``, ``problem.toml`` as run, ``trajectory.npz``, PNG plots, and ``frames/`` with
    ``trajectory.pvd`` for ParaView. With several experiments the arrays' names and the frames'
    folders have the experiment's name in front.
    """
    solution = finished.solution
    with run_folder(folder) as place:
        (place / "problem.toml").write_text(finished.problem.text, encoding="utf-8")
        (place / "result.json").write_text(as_json(result(finished)) + "\n", encoding="utf-8")
        np.savez_compressed(place / "trajectory.npz", allow_pickle=False, **_arrays(finished))
        rolled_out = {
            name: rollout.trajectory.markers_m
            for name, rollout in finished.rollouts.items()
            if isinstance(rollout, Rollout)
        }
        save_plots(place, solution_plots(solution, rolled_out))
        if frames:
            _write_all_frames(solution, place)
    return Path(folder)


def _write_all_frames(solution: Solution, place: Path) -> None:
    segments = solution.collocation.segments
    for segment, positions in zip(segments, solution.positions_m, strict=True):
        here = place if len(segments) == 1 else place / segment.experiment.name
        here.mkdir(exist_ok=True)
        body = segment.body
        write_frames(here, segment.dynamics.t_s, positions, body.cells, body.element, body.nodes_m)


def _arrays(finished: Run) -> dict[str, Array]:
    """Arrays of trajectory.npz at the samples of each fitted experiment."""
    solution = finished.solution
    segments = solution.collocation.segments
    arrays = {}
    for segment, positions in zip(segments, solution.positions_m, strict=True):
        experiment = segment.experiment
        prefix = "" if len(segments) == 1 else f"{experiment.name}/"
        at_samples = positions[segment.observation.grid_rows]
        fitted = experiment.markers.observe(at_samples)
        rollout = finished.rollouts[experiment.name]
        arrays |= {
            f"{prefix}t_s": experiment.t_s,
            f"{prefix}positions_m": at_samples,
            f"{prefix}markers_m": fitted,
            f"{prefix}measured_m": experiment.markers.positions_m,
            f"{prefix}residuals_m": fitted - experiment.markers.positions_m,
            f"{prefix}marker_names": np.array(experiment.markers.names),
        }
        if isinstance(rollout, Rollout):
            arrays[f"{prefix}rolled_out_m"] = rollout.trajectory.markers_m
    return arrays


def result(finished: Run) -> dict[str, Any]:
    """The content of result.json."""
    solution, problem = finished.solution, finished.problem
    collocation = solution.collocation
    fitted = {segment.experiment.name for segment in collocation.segments}
    rolled = {n: r for n, r in finished.rollouts.items() if isinstance(r, Rollout) and n in fitted}
    return {
        "schema": SCHEMA_VERSION,
        "status": solution.status.value,
        "converged": solution.status.converged,
        "message": solution.message,
        "method": solution.method,
        "title": problem.file.title,
        "parameters": _parameters(finished),
        "derived": _derived(finished),
        "fit": _fit(solution),
        "dynamics": {
            "max_violation_n": solution.max_violation_n,
            "max_violation_relative": solution.max_violation_relative,
            "largest": [str(violation) for violation in solution.largest_violations],
        },
        "rollout": {
            "rms_m": _pooled_rms(finished, rolled),
            "max_m": max((r.max_m for r in rolled.values()), default=None),
            "experiments": {
                name: {"rms_m": r.rms_m, "max_m": r.max_m, "fitted": name in fitted}
                if isinstance(r, Rollout)
                else {"failed": r, "fitted": name in fitted}
                for name, r in finished.rollouts.items()
            },
        },
        "iterations": solution.iterations,
        "timing_s": {
            field.name: getattr(solution.timing, field.name) for field in fields(solution.timing)
        },
        "problem": {
            "nodes": len(problem.body.nodes_m),
            "elements": len(problem.body.cells),
            "timesteps": sum(segment.grid_rows for segment in collocation.segments),
            "variables": collocation.variables,
            "constraints": collocation.constraints,
            "scheme": collocation.scheme,
        },
        "notes": [
            *problem.notes,
            *solution.notes,
            *finished.notes,
            *_uncertainty_notes(finished),
        ],
        "history": [
            {
                "iteration": line.number,
                "loss": line.loss,
                "rms_m": line.rms_m,
                "violation_n": line.violation_n,
                "theta": list(line.theta),
                "time_s": line.time_s,
            }
            for line in solution.history
        ],
        "provenance": {
            "version": version("collocation-sysid"),
            "casadi": casadi.CasadiMeta.version(),
            "numpy": np.__version__,
            "python": platform.python_version(),
            "platform": platform.platform(),
            "problem_file": str(problem.path),
            "problem_sha256": hashlib.sha256(problem.text.encode()).hexdigest(),
            "mesh_sha256": problem.body.mesh.sha256,
        },
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


def _uncertainty_notes(finished: Run) -> tuple[str, ...]:
    return finished.uncertainty.notes if finished.uncertainty is not None else ()


def _parameters(finished: Run) -> dict[str, Any]:
    parameters = finished.solution.collocation.parameters
    values = finished.solution.parameters
    estimates = finished.uncertainty.estimates if finished.uncertainty is not None else {}
    return {
        item.name: {
            "value": values[item.name],
            "guess": item.guess,
            "fixed": item.fixed,
            **_error_bar(estimates.get(item.name, Estimate(values[item.name]))),
        }
        for item in parameters.items
    }


def _derived(finished: Run) -> dict[str, Any]:
    if finished.uncertainty is None:
        theta = finished.solution.theta
        return {"young_pa": {"value": theta.young_pa}, "poisson": {"value": theta.poisson}}
    return {
        name: {"value": estimate.value, **_error_bar(estimate)}
        for name, estimate in finished.uncertainty.derived.items()
    }


def _error_bar(estimate: Estimate) -> dict[str, Any]:
    return {
        "std_error": estimate.std_error,
        "ci95": None if estimate.ci95 is None else list(estimate.ci95),
        "at_bound": estimate.at_bound,
    }


def _fit(solution: Solution) -> dict[str, Any]:
    experiments = {}
    segments = solution.collocation.segments
    for segment, positions in zip(segments, solution.positions_m, strict=True):
        markers = segment.experiment.markers
        squares = segment.observation.squared_distances_m2(positions)
        experiments[segment.experiment.name] = {
            "rms_m": float(np.sqrt(squares.mean())),
            "samples": markers.samples,
            "missing": int(markers.missing.sum()),
        }
    return {"rms_m": solution.rms_m, "experiments": experiments}


def _pooled_rms(finished: Run, rolled: Mapping[str, Rollout]) -> float | None:
    if not rolled:
        return None
    counts = {e.name: e.markers.samples for e in finished.problem.experiments}
    squares = sum(counts[name] * r.rms_m**2 for name, r in rolled.items())
    return float(np.sqrt(squares / sum(counts[name] for name in rolled)))
