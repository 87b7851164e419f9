"""Derivatives at the guess against differences, on the first samples of every experiment."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from ...arrays import Array
from ...model.contact import contacts
from ...problem import Problem
from ...program.collocation import Collocation, carried_over
from ...recording.depth import begun
from ...recording.experiment import Experiment
from ...recording.tables import FEWEST
from ...recording.wrench import Wrench

# All kinds of rows are among these samples, those of equilibria among fewer; derivatives do not
# depend on how many follow.
SAMPLES, STATIC_SAMPLES = 12, 3
STEP = 1e-5
# Over the gap in which a pressure rises: steps that leave it say nothing of slopes within.
OF_WIDTH = 1e-3
# Of a thousand points some are where Huber's loss begins to be linear, and differences go across.
WITHOUT_KINK = 1e9
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
    """The same experiment with its first samples only, and more where cameras see later."""
    fewest = 1 if experiment.static else FEWEST
    samples, depths = begun(experiment.depths, experiment.t_s, samples, fewest)
    markers, here = experiment.markers, slice(samples)
    tracks = markers.positions_m[here]
    if not np.isfinite(tracks).any():
        tracks = np.nan_to_num(tracks)  # at least one sample has to be there
    markers = replace(markers, t_s=markers.t_s[here], positions_m=tracks)
    t_s = experiment.t_s[here]
    grasps = [replace(g, wrench=_begun(g.wrench, t_s, fewest)) for g in experiment.grasps]
    return replace(experiment, t_s=t_s, markers=markers, grasps=grasps, depths=depths)


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
    if any(segment.depths for segment in collocation.segments):
        collocation = replace(collocation, huber=WITHOUT_KINK)
    rng, of_slopes, step = np.random.default_rng(0), 0.0, _step(collocation)
    program, plain = collocation.made_explicit(), collocation
    if program.explicit:  # methods use these without memory and wrenches as variables
        of_slopes = _slope_error(plain.objective, plain.gradient, z, rng, step)
        if plain.remembers:
            forces = rng.normal(size=plain.constraints)
            through = partial(plain.pulled_back, multipliers=forces)
            pushed = lambda at: forces @ plain.constraint_values(at)  # noqa: E731
            along = _slope_error(pushed, through, z, rng, step)
            of_slopes = max(of_slopes, along)
        if sum(program.carried_nonzeros) > LAID_OUT:
            return of_slopes, 0.0
        collocation, z = program, carried_over(z, plain, program)
    point = z + 1e-3 * rng.normal(size=len(z))
    direction = rng.normal(size=len(z))
    multipliers = rng.normal(size=collocation.constraints)

    def lagrangian_gradient(at: Array) -> Array:
        return collocation.gradient(at) + collocation.jacobian(at).T @ multipliers

    hessian = collocation.hessian(point, 1.0, multipliers)
    along = collocation.jacobian(point) @ direction
    first = _deviation(collocation.constraint_values, along, point, direction, step)
    second = _deviation(lagrangian_gradient, hessian @ direction, point, direction, step)
    return max(first, of_slopes), second


def _step(collocation: Collocation) -> float:
    """As long as differences may be."""
    touching = (t for s in collocation.segments for t in contacts(s.experiment))
    return min((STEP, *(OF_WIDTH * term.contact.width_m for term in touching)))


def _slope_error(function, gradient, z: Array, rng: np.random.Generator, step: float) -> float:
    """That of a gradient along a random direction."""
    point, direction = z + 1e-3 * rng.normal(size=len(z)), rng.normal(size=len(z))
    return _deviation(function, gradient(point) @ direction, point, direction, step)


def _deviation(function, exact: Array, point: Array, direction: Array, step: float) -> float:
    ahead, behind, far_ahead, far_behind = (
        function(point + k * step * direction) for k in (1, -1, 2, -2)
    )
    differences = (8 * (ahead - behind) - (far_ahead - far_behind)) / (12 * step)
    largest = max(float(np.abs(exact).max()), np.finfo(float).tiny)
    return float(np.abs(differences - exact).max()) / largest
