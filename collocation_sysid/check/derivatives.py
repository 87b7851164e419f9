"""Derivatives at the guess against differences, on the first samples of every experiment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..arrays import Array
from ..experiment.experiment import Experiment
from ..experiment.wrench import Wrench
from ..experiment.wrench_files import FEWEST
from ..nlp.collocation import Collocation, carried_over
from ..problem import Problem

# All kinds of rows are among these samples, those of equilibria among fewer; derivatives do not
# depend on how many follow.
SAMPLES, STATIC_SAMPLES = 12, 3
STEP = 1e-5
# With more entries memory and wrenches are not laid out as variables: their slopes are checked.
LAID_OUT = 5e6


def few(experiment: Experiment) -> int:
    """How many first samples have all kinds of rows."""
    return STATIC_SAMPLES if experiment.static else SAMPLES


def shortened(problem: Problem) -> Problem:
    """The same problem with a few first samples of every experiment only."""
    short = tuple(first_samples(e, few(e)) for e in problem.experiments)
    return replace(problem, experiments=short)


def first_samples(experiment: Experiment, samples: int) -> Experiment:
    """The same experiment with its first samples only."""
    markers, here = experiment.markers, slice(samples)
    tracks = markers.positions_m[here]
    if not np.isfinite(tracks).any():
        tracks = np.nan_to_num(tracks)  # at least one sample has to be there
    markers = replace(markers, t_s=markers.t_s[here], positions_m=tracks)
    t_s = experiment.t_s[here]
    fewest = 1 if experiment.static else FEWEST
    grasps = [replace(g, wrench=_begun(g.wrench, t_s, fewest)) for g in experiment.grasps]
    return replace(experiment, t_s=t_s, markers=markers, grasps=grasps)


def _begun(wrench: Wrench | None, t_s: Array, fewest: int) -> Wrench | None:
    """The wrench up to the last of some times, if that leaves enough of it."""
    if wrench is None:
        return None
    here = (wrench.t_s >= t_s[0]) & (wrench.t_s <= t_s[-1])
    if here.sum() < fewest or not wrench.present[here].any():
        return None
    return replace(wrench, t_s=wrench.t_s[here], values=wrench.values[here])


def derivative_errors(collocation: Collocation, z: Array) -> tuple[float, float]:
    """Largest relative deviations of J and H along a random direction at a disturbed start."""
    rng, of_given = np.random.default_rng(0), 0.0
    program = collocation.made_explicit()
    if program.explicit:
        of_given = _gradient_error(collocation, z, rng)
        if collocation.remembers:
            of_given = max(of_given, _slopes_error(collocation, z, rng))
        if sum(program.carried_nonzeros) > LAID_OUT:
            return of_given, 0.0
        collocation, z = program, carried_over(z, collocation, program)
    point = z + 1e-3 * rng.normal(size=len(z))
    direction = rng.normal(size=len(z))
    multipliers = rng.normal(size=collocation.constraints)

    def lagrangian_gradient(at: Array) -> Array:
        return collocation.gradient(at) + collocation.jacobian(at).T @ multipliers

    hessian = collocation.hessian(point, 1.0, multipliers)
    along = collocation.jacobian(point) @ direction
    first = _deviation(collocation.constraint_values, along, point, direction)
    second = _deviation(lagrangian_gradient, hessian @ direction, point, direction)
    return max(first, of_given), second


def _gradient_error(collocation: Collocation, z: Array, rng: np.random.Generator) -> float:
    """That of the objective's gradient, wrenches included."""
    point, direction = z + 1e-3 * rng.normal(size=len(z)), rng.normal(size=len(z))
    exact = np.array([collocation.gradient(point) @ direction])
    return _deviation(lambda at: np.array([collocation.objective(at)]), exact, point, direction)


def _slopes_error(collocation: Collocation, z: Array, rng: np.random.Generator) -> float:
    """That of Jᵀ alone through the memory, which methods use that do not have it as variables."""
    point, direction = z + 1e-3 * rng.normal(size=len(z)), rng.normal(size=len(z))
    multipliers = rng.normal(size=collocation.constraints)
    exact = collocation.pulled_back(point, multipliers) @ direction

    def lagrangian(at: Array) -> Array:
        return np.array([multipliers @ collocation.constraint_values(at)])

    return _deviation(lagrangian, np.array([exact]), point, direction)


def _deviation(function, exact: Array, point: Array, direction: Array) -> float:
    ahead, behind, far_ahead, far_behind = (
        function(point + k * STEP * direction) for k in (1, -1, 2, -2)
    )
    differences = (8 * (ahead - behind) - (far_ahead - far_behind)) / (12 * STEP)
    return float(np.abs(differences - exact).max() / np.abs(exact).max())
