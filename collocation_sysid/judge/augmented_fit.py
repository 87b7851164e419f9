"""Posterior of a solution: steps from the answer with all effects of the budget."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ..common.array_types import Array
from ..errors import SimulationError
from ..methods.solution import Solution
from ..methods.starts.initial_trajectories import simulate_trajectories
from ..problem import Problem
from ..program.collocation import Collocation
from ..statistics.budget.consider_analysis import changed_residuals, changes_of_assumptions
from ..statistics.budget.systematic_effects import ASSUMPTIONS
from ..statistics.linearised import DerivedModuli, LinearisedFit, linearise_fit
from .posterior import Effects, Posterior

# Change of a parameter, in its standard deviations, up to which one step suffices.
SHORT = 0.5
# Most steps, each with a simulation and a linearisation.
MOST_STEPS = 4


def is_learnt(collocation: Collocation) -> bool:
    """Return whether the data may correct effects: those of a motion, not of static tests alone."""
    return any(not each.experiment.is_static for each in collocation.transcriptions)


def augmented_fit(
    problem: Problem,
    solution: Solution,
    fit: LinearisedFit,
    discretisation: Mapping[str, Sequence[Array]],
) -> Posterior:
    """Return the posterior of a solution.

    Where a step changes a parameter by more than `SHORT` of its standard deviation, motion and
    residuals are linearised again where it leads, so that the posterior is not one of first order
    in the parameters; it is in the effects. A step whose motion cannot be simulated is the last one.

    Parameters
    ----------
    fit : LinearisedFit
        Linearised fit at the solution, with the noise of the poses.
    discretisation : mapping of str to sequence of (T, M, 3, 1) arrays
        Changes of the residuals without the errors of the mesh and of the time step, by name.
    """
    collocation = solution.collocation
    deviations = problem.assumed_deviations
    means = problem.uncertainty.assumptions.means
    z = solution.z
    lower, upper = collocation.parameter_bounds
    may_be_learnt = is_learnt(collocation)
    for number in range(1, MOST_STEPS + 1):
        p, positions = collocation.parameters_from(z), collocation.unpack(z)[1]
        changes = changes_of_assumptions(collocation, z, deviations)
        posterior = Posterior.from_fit(
            fit,
            Effects.from_changes(changes, deviations, means, discretisation),
            collocation.parameters,
            p[: collocation.nq],
            problem.uncertainty,
            is_learnt=may_be_learnt,
            derived_at=lambda q: DerivedModuli.from_bodies(
                (t.constants for t in collocation.transcriptions), q
            ),
        )
        step = posterior.step[: len(p)]
        errors = np.sqrt(np.diag(posterior.covariance)[: collocation.nq])
        is_long = np.abs(step[: collocation.nq]) > SHORT * errors
        if (
            number == MOST_STEPS
            or not may_be_learnt
            or not (is_long & ~fit.at_bound[: collocation.nq]).any()
        ):
            break
        there = np.clip(p + step, lower, upper)
        moved, failure = simulate_trajectories(collocation, there, guess=positions)
        if failure is not None:
            break
        z = collocation.pack(there, moved)
        try:
            again = linearise_fit(collocation, z)
        except SimulationError:
            break
        fit = again.with_disturbances(block.disturbances for block in fit.blocks)
    return posterior


def suspects(
    solution: Solution, posterior: Posterior, deviations: Mapping[str, float | None]
) -> dict[str, float]:
    """Return the decreases of the loss by effects that the budget does not contain, by name, each with
    its wide prior (`Deviation.wide`) at the answer.
    """
    rows = [(row, row.wide) for row in ASSUMPTIONS if row.wide and deviations.get(row.name) is None]
    changes = changed_residuals(solution.collocation, solution.z, rows)
    sizes: dict[str, float | None] = {row.name: wide for row, wide in rows}
    return posterior.decreases(Effects.from_changes(changes, sizes, {}, {}))
