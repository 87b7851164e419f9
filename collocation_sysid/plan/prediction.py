"""How well a model predicts what it was not fitted to.

One recording is left out, the others are fitted, and it is simulated with what they found, its own
nuisance parameters fitted. Of a single recording the last third is left out: its samples are taken
away, and the simulation with what the rest tells goes on into it. What is compared are the markers,
and the forces where there are none.
"""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import numpy as np

from ..errors import SimulationError
from ..methods.solution import Solution, pooled_wrench_rms
from ..problem import Problem, RolloutOptions
from ..program.simulation import with_markers
from ..recording.experiment import Experiment
from ..recording.grasp import Grasp
from ..runs.forward_simulation import Rollout, roll_out
from ..runs.solving import solve
from ..statistics.evidence import evidence_of
from ..statistics.linearised import Derived, linearised_fit

# Share of a single recording that is fitted.
FITTED = 2 / 3
# Parts in time of what is held out: longer than most errors persist, and enough to see a scatter.
BLOCKS = 8


def recordings(problem: Problem) -> list[str]:
    """Names of the recordings that are fitted."""
    return [e.name for e in problem.experiments if not e.validation]


def model_record(problem: Problem, method: str, held_out: str) -> dict[str, Any]:
    """Fit a model, to all recordings or to all but what is held out, and tell how well it does.

    Parameters
    ----------
    problem : Problem
    method : str
    held_out : str
        A recording; "" to fit all.
    """
    known, start_s = without(problem, held_out) if held_out else (problem, np.inf)
    solution = solve(known, method)
    record: dict[str, Any] = {
        "status": solution.status.value,
        "converged": solution.status.converged,
        "rms": {"m": solution.rms_m, "N": pooled_wrench_rms(solution)[0]},
        "parameters": solution.parameters | _derived(solution),
        "free": [item.name for item in problem.parameters.free],
        "time_s": solution.timing.total,
    }
    if not solution.status.converged:
        return record
    if not held_out:
        try:
            fit = linearised_fit(solution.collocation, solution.z)
        except SimulationError as error:
            return record | {"converged": False, "status": str(error)}
        return record | {"evidence": asdict(evidence_of(fit))}
    experiment = next(e for e in known.experiments if e.name == held_out)
    # With the scheme that was fitted: what is compared are models, not integrators.
    rollout = roll_out(replace(known, rollout=RolloutOptions("scheme")), experiment, solution)
    if not isinstance(rollout, Rollout):
        return record | {"prediction": None, "failure": rollout}
    whole = next(e for e in problem.experiments if e.name == held_out)
    return record | {"prediction": _missed(whole, rollout, start_s)}


def without(problem: Problem, name: str) -> tuple[Problem, float]:
    """The problem without a recording, or its end, and the time from which it is held out."""
    chosen = next(e for e in problem.experiments if e.name == name)
    if len(recordings(problem)) > 1:
        left, start_s = replace(chosen, validation=True), -np.inf
    else:
        start_s = float(chosen.t_s[0] + FITTED * chosen.duration_s)
        tracks = np.where((chosen.t_s > start_s)[:, None, None], np.nan, chosen.markers.positions_m)
        grasps = tuple(_until(grasp, start_s) for grasp in chosen.grasps)
        left = replace(with_markers(chosen, tracks), grasps=grasps)
    experiments = [left if e is chosen else e for e in problem.experiments]
    return replace(problem, experiments=experiments), start_s


def _until(grasp: Grasp, end_s: float) -> Grasp:
    """The grasp without what its sensor measured later."""
    wrench = grasp.wrench
    if wrench is None:
        return grasp
    values = np.where((wrench.t_s > end_s)[:, None], np.nan, wrench.values)
    return replace(grasp, wrench=replace(wrench, values=values))


def _missed(experiment: Experiment, rollout: Rollout, start_s: float) -> dict[str, Any]:
    """How far held-out samples are from the simulation: RMS, number, and Σ of squares by block.

    Of the markers [m], or of the forces [N] where there are none; `unit` says which.
    """
    markers, unit = experiment.markers, "m"
    t_s, apart = experiment.t_s, rollout.trajectory.markers_m - markers.positions_m
    counted = markers.present
    if not markers.samples:
        sensors = [grasp.wrench for grasp in experiment.grasps if grasp.wrench is not None]
        t_s = np.concatenate([sensor.t_s for sensor in sensors])
        pairs = zip(rollout.wrenches, sensors, strict=True)
        apart = np.concatenate([(read - sensor.values)[:, :3] for read, sensor in pairs])
        order, unit = np.argsort(t_s, kind="stable"), "N"
        t_s, apart = t_s[order], apart[order, None]
        counted = np.asarray(np.isfinite(apart).any(axis=2))
    later = t_s > start_s
    squares = np.where(counted, np.nansum(apart**2, axis=2), 0.0)[later]
    samples = int(counted[later].sum())
    blocks = [float(np.sum(each)) for each in np.array_split(squares, BLOCKS)]
    rms = float(np.sqrt(squares.sum() / samples)) if samples else None
    return {"rms": rms, "unit": unit, "samples": samples, "blocks": blocks}


def _derived(solution: Solution) -> dict[str, float]:
    """Moduli that follow from the parameters."""
    constants = (segment.constants for segment in solution.collocation.segments)
    return dict(Derived.of(constants, solution.q).values)
