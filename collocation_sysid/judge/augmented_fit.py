"""Posterior of a solution: one step from the answer with all effects of the budget."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from ..common.array_types import Array
from ..methods.solution import Solution
from ..problem import Problem
from ..program.collocation import Collocation
from ..statistics.budget.consider_analysis import changed_residuals, changes_of_assumptions
from ..statistics.budget.systematic_effects import ASSUMPTIONS
from ..statistics.linearised import DerivedModuli, LinearisedFit
from .posterior import Effects, Posterior


def is_learnt(collocation: Collocation) -> bool:
    """Return whether the data may correct effects: those of a motion, not of static tests alone."""
    return any(not each.experiment.is_static for each in collocation.transcriptions)


def augmented_fit(
    problem: Problem,
    solution: Solution,
    fit: LinearisedFit,
    discretisation: Mapping[str, Sequence[Array]],
) -> Posterior:
    """Return the posterior of a solution, by one step from it.

    The step leads along directions in which parameters and effects compensate each other, such as a
    softer and a larger body. There the errors of second order cancel too, but only if both are
    linearised at one point: a second linearisation at the new parameters, but without the effects,
    leads away from the truth.

    Parameters
    ----------
    fit : LinearisedFit
        Linearised fit at the solution, with the noise of the poses.
    discretisation : mapping of str to sequence of (T, M, 3, 1) arrays
        Changes of the residuals without the errors of the mesh and of the time step, by name.
    """
    collocation = solution.collocation
    deviations = problem.assumed_deviations
    changes = changes_of_assumptions(collocation, solution.z, deviations)
    means = problem.uncertainty.assumptions.means
    return Posterior.from_fit(
        fit,
        Effects.from_changes(changes, deviations, means, discretisation),
        collocation.parameters,
        solution.q,
        problem.uncertainty,
        is_learnt=is_learnt(collocation),
        derived_at=lambda q: DerivedModuli.from_bodies(
            (t.constants for t in collocation.transcriptions), q
        ),
    )


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
