"""Relaxed assumptions: fits near an answer with one assumption estimated, and the changes of the
estimates.

A relaxed assumption joins the linearised fit as one or several nuisance parameters: its prior has
the deviation of the uncertainty budget, or a multiple of it, and its derivatives are the changes of
the residuals if the assumption is wrong, see `consider_analysis`. `routine_probes` uses this in
every solve, `deep_probes` for a deeper check.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ...common.array_types import Array
from ...fem.laws.constants import is_modulus
from ...program.collocation import Collocation, ExperimentIterate
from ..budget.consider_analysis import ResidualChanges, changes_of_assumptions
from ..budget.systematic_effects import ExperimentAtAnswer
from ..budget.variance_sources import BudgetLine, is_definition
from ..estimates import Estimate
from ..linearised import DerivedModuli, LinearisedFit, gauss_newton_step, least_squares_of_fit
from ..residuals.recording_scatter import TELLING
from ..thresholds import NOISE, PERSISTENT, RETURN, SUFFICIENT
from ..uncertainty import ErrorModel, Uncertainty, uncertainty_from_fit

DRIFT = "stiffness_drift"
MEMORY = "memory_share"
ANISOTROPY = "anisotropy"
# Fewest samples of a static recording in which the load can return.
FEWEST_SAMPLES = 3
Kind = Literal["window", "recording", "assumption"]


@dataclass(frozen=True)
class EstimateChange:
    """Change of an estimate in a refit."""

    # Estimate of the refit, and its standard error.
    value: float
    std_error: float
    change: float  # estimate of the refit less that of the fit of all data
    # `change` over the half widths of the statistical and of the combined interval of the fit; None
    # where there is no such interval.
    of_statistical95: float | None
    of_combined95: float | None


@dataclass(frozen=True)
class Probe:
    """One refit, of a part of the data or with an assumption relaxed."""

    kind: Kind  # what was refitted
    # Name of the window, of the recording, or of the assumption with its component after a space.
    name: str
    # Decrease of χ² of the refitted data, with the stated σ and with priors, from the parameters of
    # the fit of all data to those of the refit.
    chi_squared: float
    # mapping of str to EstimateChange: changes of the estimates that the refit determines.
    moves: Mapping[str, EstimateChange]
    # Estimated error of a relaxed assumption in its unit, and its standard error; None for parts of
    # the data.
    size: float | None = None
    size_error: float | None = None
    # What is significant: for a part of the data the estimates that differ, for an assumption its
    # name.
    sentences: tuple[str, ...] = ()
    routine: bool = False  # whether this is one of the probes of every solve, with one linear step
    # For an assumption the largest change of an estimate, in half widths of the combined interval,
    # see `relevance`; None for parts of the data.
    relevance: float | None = None
    # For an assumption whether the residuals without it are as noise is, or closer to it by
    # `SUFFICIENT` of the way at least; else it is a substitute for something else.
    suffices: bool = True

    def is_beyond(self, limit: float) -> bool:
        """Whether the absolute size of a relaxed assumption exceeds `limit` of its standard errors;
        false if there is no size, or if its error is None or zero.
        """
        if self.size is None or not self.size_error:
            return False
        return abs(self.size) > limit * self.size_error


@dataclass(frozen=True, eq=False)
class SolvedFit:
    """A fit at its answer, with the data that probes need."""

    collocation: Collocation  # the program
    z: Array  # (variables,): the answer
    fit: LinearisedFit
    error_model: ErrorModel  # assumptions about the errors
    # mapping of str to Estimate: estimates with statistical intervals.
    statistical: Mapping[str, Estimate]
    budget: Mapping[str, BudgetLine]  # mapping of str to BudgetLine: uncertainty budgets
    # mapping of str to float or None: standard deviations of all assumptions and nuisance
    # parameters; None if exact.
    deviations: Mapping[str, float | None]
    changes: ResidualChanges  # changes of the residuals by these assumptions, see `probed_changes`

    def uncertainty_of_refit(self, fit: LinearisedFit, p: Array) -> Uncertainty:
        """Return estimates and error bars of another fit at its parameters p (p,), with the error
        model of this one. Derived moduli are those at p.
        """
        q = p[: fit.shared_count]
        constants = (transcription.constants for transcription in self.collocation.transcriptions)
        fit = replace(fit, derived=DerivedModuli.from_bodies(constants, q))
        return uncertainty_from_fit(
            fit, self.collocation.parameters, q=q, error_model=self.error_model
        )

    def changes_of_estimates(self, uncertainty: Uncertainty) -> dict[str, EstimateChange]:
        """Return the changes of the estimates that a refit determines, from those of the joint fit,
        by name; parameters and derived moduli.

        Left out are estimates whose relative standard error in the refit is missing or at least
        `TELLING`.
        """
        changes = {}
        for name, each in {**uncertainty.estimates, **uncertainty.derived}.items():
            error = each.statistical_std_error
            joint = self.statistical[name]
            if error and error < TELLING * abs(each.value):
                change = each.value - joint.value
                combined95 = self.budget[name].combined95 if name in self.budget else None
                of_statistical = _share_of_interval(change, joint.statistical95)
                of_combined = _share_of_interval(change, combined95)
                changes[name] = EstimateChange(
                    each.value,
                    error,
                    change=change,
                    of_statistical95=of_statistical,
                    of_combined95=of_combined,
                )
        return changes

    def read_parameters(self) -> Array:
        """Return all parameters (p,) at the answer."""
        return self.collocation.parameters_from(self.z)


def _share_of_interval(change: float, interval: tuple[float, float] | None) -> float | None:
    return None if interval is None else 2 * change / max(interval[1] - interval[0], 1e-300)


# Columns of assumptions ---------------------------------------------------------------------------


def probed_changes(
    collocation: Collocation,
    z: Array,
    deviations: Mapping[str, float | None],
    changes: ResidualChanges | None = None,
) -> ResidualChanges:
    """Return the changes of the residuals by each assumption that the data can test.

    In a static recording whose load only rises, or only falls, "stiffer at the end" and "stiffer at
    large strain" are the same, so that a wrong material law would look like a drift: there the
    column of the drift is zero. For the same reason that of anisotropy is zero for specimens.

    Parameters
    ----------
    z : (variables,) array
        The answer.
    deviations : mapping of str to float or None
        Standard deviation of each assumption or nuisance parameter; None if exact.
    changes : ResidualChanges, optional
        Result of `changes_of_assumptions` for these deviations, if it is known.

    Returns
    -------
    ResidualChanges
        The arrays of `changes` are not modified.
    """
    known = (
        changes_of_assumptions(collocation, z, deviations=deviations)
        if changes is None
        else changes
    )
    of_drift, of_anisotropy = (
        [k for k, name in enumerate(known.names) if assumption_name(name) == row]
        for row in (DRIFT, ANISOTROPY)
    )
    blocks = iter(known.blocks)
    masked = []
    for part in collocation.iterates(z):
        experiment = part.transcription.experiment
        columns = of_anisotropy if experiment.specimen is not None else []
        if of_drift and experiment.is_static and has_monotonic_load(part, collocation):
            columns = [*columns, *of_drift]
        for _ in part.transcription.residuals:
            change = next(blocks)
            if columns:
                change = change.copy()
                change[..., columns] = 0.0
            masked.append(change)
    return ResidualChanges(known.names, masked)


def has_monotonic_load(iterate: ExperimentIterate, collocation: Collocation) -> bool:
    """Whether the norm of the internal forces of a static recording only grows, or only shrinks, in
    time, but for `RETURN` of its range; true for fewer than `FEWEST_SAMPLES` samples.
    """
    load_n = np.linalg.norm(
        ExperimentAtAnswer(iterate, collocation.parameters).internal_n(), axis=1
    )
    if len(load_n) < FEWEST_SAMPLES:
        return True
    steps = np.diff(load_n)
    slack = RETURN * float(np.ptp(load_n))
    return bool((steps >= -slack).all() or (steps <= slack).all())


def relaxed_probe(fit: SolvedFit, name: str, wide: LinearisedFit, p: Array) -> Probe:
    """Return the optimum of a fit with one assumption relaxed, by one linear step.

    Parameters
    ----------
    name : str
        The assumption with its component.
    wide : LinearisedFit
        Result of `with_relaxed_assumption`, linearised at p.
    p : (p,) array
        All parameters without those of the assumption.

    Returns
    -------
    Probe
        Its size, in the unit of the assumption, is that of the most significant amplitude if there
        are several; its `sentences` are empty.
    """
    first = len(fit.fit.names)
    step = gauss_newton_step(wide)
    after = wide.after_step(step)
    own = step[first:]
    uncertainty = fit.uncertainty_of_refit(after, p + step[:first])
    before = least_squares_of_fit(fit.fit)
    remaining = least_squares_of_fit(after)
    stated = before.loss(np.zeros(first))
    decrease = stated - remaining.loss(np.zeros(len(step)))
    unit = fit.deviations[assumption_name(name)] or 1.0
    errors = np.array([*uncertainty.nuisance.values()][first - wide.shared_count :])
    worst = int(np.argmax(np.nan_to_num(np.abs(own) / errors)))
    probe = Probe(
        "assumption", name, chi_squared=decrease, moves=fit.changes_of_estimates(uncertainty)
    )
    probe = replace(probe, size=float(unit * own[worst]), size_error=float(unit * errors[worst]))
    excess = stated - fit.fit.measurement_count
    suffices = _are_noise(uncertainty) or decrease >= SUFFICIENT * excess
    return replace(probe, relevance=relevance(fit, probe), suffices=suffices)


def _are_noise(uncertainty: Uncertainty) -> bool:
    """Return whether residuals are as small as noise, or not correlated in time."""
    is_small = uncertainty.level.pooled <= NOISE**2
    dependence = uncertainty.dependence
    is_white = np.isfinite(dependence.lag1_deviation) and abs(dependence.lag1) <= PERSISTENT
    return bool(is_small or is_white)


def relevance(fit: SolvedFit, probe: Probe) -> float:
    """Return the largest absolute change of an estimate by a probe, in half widths of its combined
    interval, or of its statistical one without a budget; 0 if there are no such changes.

    Constants that the assumption defines, such as γ_r without memory, do not count. For a drift,
    half of it counts as a change of the moduli too: by so much the stiffness at either
    end of a recording differs from the one that is reported.
    """
    shares = [0.0]
    for name, move in probe.moves.items():
        budget = fit.budget.get(name)
        interval = budget.combined95 if budget else None
        interval = interval or fit.statistical[name].statistical95
        if interval is None or is_definition(assumption_name(probe.name), name):
            continue
        shares.append(abs(_share_of_interval(move.change, interval) or 0.0))
        if probe.name == DRIFT and is_modulus(name):
            half_width = max((interval[1] - interval[0]) / 2, 1e-300)
            shares.append(abs(0.5 * (probe.size or 0.0) * move.value) / half_width)
    return max(shares)


def assumption_name(name: str) -> str:
    """Return the name of an assumption without its component: the part before the first space."""
    return name.partition(" ")[0]
