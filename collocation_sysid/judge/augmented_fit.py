"""Posterior of a solution: one step from the answer with all effects of the budget."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from ..common.array_types import Array
from ..methods.solution import Solution
from ..problem import Problem
from ..program.collocation import Collocation
from ..recording.nuisance import KINDS
from ..statistics.budget.consider_analysis import changes_of_assumptions
from ..statistics.budget.effect_estimates import EffectEstimate
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
    problem: Problem, solution: Solution, posterior: Posterior
) -> tuple[EffectEstimate, ...]:
    """Return the effects beyond the budget of a motion that explain the residuals best, see
    `Posterior.suspected`: those of bodies with their wide priors (`Deviation.wide`), and those of
    instruments that the problem states to be exact with their usual ones.
    """
    if not is_learnt(solution.collocation):
        return ()
    stated = problem.assumed_deviations
    sizes = {row.name: row.wide for row in ASSUMPTIONS}
    sizes |= {row.name: row.considered for row in KINDS}
    sizes |= {name: None for name, deviation in stated.items() if deviation is not None}
    changes = changes_of_assumptions(solution.collocation, solution.z, sizes)
    others = Effects.from_changes(changes, sizes, {}, {})
    return posterior.suspected(others, problem.uncertainty)
