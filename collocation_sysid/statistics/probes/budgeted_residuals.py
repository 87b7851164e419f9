"""Residuals that remain if the deviations of the uncertainty budget may explain them.

Real bodies deviate from every assumption a little, and with little noise such deviations show in
the residuals. This contradicts nothing as long as the budget grants them: the combined intervals
contain their effect. All assumptions of the budget therefore join the linearised fit at once, each
with the prior of its deviation, and the verdict tests the residuals after one step. Assumptions that
define constants, such as the damping law, do not take part: residuals that need them should name
them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ..budget.consider_analysis import with_relaxed_assumption
from ..budget.systematic_effects import DEVIATIONS
from ..budget.variance_sources import source_label
from ..distributions import chi2_isf, normal_isf
from ..linearised import LinearisedFit, covariance_of_fit, gauss_newton_step
from ..thresholds import GRANTED, RARE
from ..uncertainty import ErrorBasis
from .relaxed_assumptions import SolvedFit, assumption_name
from .routine import prior_widening, significance_limit


@dataclass(frozen=True)
class BudgetedResiduals:
    """Tests of the residuals after the step."""

    basis: ErrorBasis  # size and correlation of the residuals
    largest: str  # name of the assumption with the largest deviation, with its component
    deviations: float  # this deviation in standard deviations of the budget

    def describe(self) -> str:
        """Return a note on the residuals as a sentence without full stop."""
        component = self.largest.partition(" ")[2]
        return (
            "the residuals show deviations from the description that the uncertainty budget grants, "
            f"the largest of {source_label(assumption_name(self.largest))}"
            f"{' ' * bool(component)}{component}: {self.deviations:+.1f} standard deviations"
        )


def budgeted_residuals(solved_fit: SolvedFit, fit: LinearisedFit) -> BudgetedResiduals | None:
    """Return the residuals after one linear step of all parameters and all assumptions of the
    budget; None if the budget is empty, or if the step needs deviations larger than it grants.

    Parameters
    ----------
    solved_fit : SolvedFit
        The fit. Its `changes` belong to its `deviations`.
    fit : LinearisedFit
        Result of `with_budget`.
    """
    first = len(solved_fit.fit.names)
    step = gauss_newton_step(fit)
    own = step[first:]
    count = len(own)
    if not count or not own @ own < chi2_isf(RARE, count):
        return None
    worst = int(np.argmax(np.abs(own)))
    if not abs(own[worst]) < normal_isf(RARE / 2 / count):
        return None
    p = solved_fit.read_parameters() + step[:first]
    basis = solved_fit.uncertainty_of_refit(fit.after_step(step), p)
    largest = fit.names[first + worst].rpartition(" ")[0]
    return BudgetedResiduals(basis, largest, float(own[worst]))


def is_significant_beside_budget(
    solved_fit: SolvedFit, budgeted: Mapping[str, float | None], fit: LinearisedFit, name: str
) -> bool:
    """Return whether a routine probe, by the name of its assumption with component, remains if all
    assumptions of the budget are relaxed, as in `fit`, the result of `with_budget`.

    One that the budget contains remains if its deviation is larger than `GRANTED`; another, like
    memory, if it is significant.
    """
    row = assumption_name(name)
    if budgeted.get(row):
        first = len(solved_fit.fit.names)
        own = [assumption_name(each.rpartition(" ")[0]) == row for each in fit.names[first:]]
        return bool((np.abs(gauss_newton_step(fit)[first:][own]) > GRANTED).any())
    changes = solved_fit.changes
    wide = with_relaxed_assumption(fit, changes, name=name, widening=prior_widening(name))
    errors = np.sqrt(np.diag(covariance_of_fit(wide)))
    ratios = np.abs(gauss_newton_step(wide) / errors)[len(fit.names) :]
    return bool((ratios > significance_limit(changes, name)).any())


def with_budget(solved_fit: SolvedFit, budgeted: Mapping[str, float | None]) -> LinearisedFit:
    """Return the fit with all assumptions of the budget relaxed that change any residual.

    `budgeted` has the standard deviations in the budget; assumptions that are None or missing do
    not take part.
    """
    fit = solved_fit.fit
    changes = solved_fit.changes
    has_effect = np.any([block.any(axis=(0, 1, 2)) for block in changes.blocks], axis=0)
    for name in dict.fromkeys(np.array(changes.names)[has_effect].tolist()):
        row = assumption_name(name)
        if budgeted.get(row) and not DEVIATIONS[row].redefines:
            fit = with_relaxed_assumption(fit, changes, name=name)
    return fit
