"""Error bars of the estimated parameters, from the information of the fit and from its residuals.

With S the slopes of the residuals (h(x) − ŷ)/σ along the equations of motion and P those of the
priors, the estimate errs by A⁻¹ Sᵀe, A = SᵀS + PᵀP, and has the covariance

    C = A⁻¹ (Sᵀ Cov(e) S + PᵀP) A⁻¹,

of which the block of the shared parameters q is reported: nuisance parameters of single
experiments widen it by what they could have explained. For independent errors of the σ given it
is A⁻¹. If the residuals are larger or smaller than σ says, Cov(e) = s² I with their variance s²,
and where markers differ each has its own (see `noise`); intervals are Student's then. If a test
finds the residuals correlated, in time or among markers, Cov(e) is that of `autocorrelation`. The
output names which of them was used.

Places of the markers on the undeformed body, where these were found, have error bars likewise.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..checked import Options
from ..errors import InputError
from ..fem.constants import constant_named, is_damping
from ..model.parameters import Parameters
from ..program.collocation import Collocation, Part
from ..program.lapack import one_blas_thread
from .autocorrelation import Dependence, dependence, error_processes, score_covariance
from .diagnostics import Outlier, set_apart
from .distributions import student_ppf
from .estimates import (
    UNDETERMINED,
    Estimate,
    correlation_notes,
    correlation_of,
    derived_estimates,
    memory_notes,
    parameter_notes,
    relative_slopes,
    scatter_notes,
    size_notes,
    user_estimates,
)
from .linearised import Information, LinearisedFit, information, least_squares, linearised_fit
from .noise import Noise, NoiseLevel, drawn, noise_level, projected
from .pose_noise import with_pose_noise
from .scatter import Scatter, recordings_of, scatter_of, single_fits

Errors = Literal["independent", "autocorrelated"]

# A damping that ended at its bound is not told at all if it may be this many times the usual.
UNINFORMED = 100.0
# With σ given, correlation that widens no error bar by this factor is of no consequence.
CONSEQUENCE = 1.05
# Simulations of the residuals that tell how dependent they may be by chance.
REPLICAS = 39


@dataclass(frozen=True)
class ErrorModel(Options):
    """What is assumed of the measurements' errors.

    Attributes
    ----------
    noise : {"auto", "given", "estimated"}
        Trust sigma_m, or scale it by the residuals; auto where they ask for it.
    errors : {"auto", "independent", "autocorrelated"}
        What to assume of the errors; auto tests the residuals.
    """

    noise: Literal["auto", "given", "estimated"] = "auto"
    errors: Literal["auto", "independent", "autocorrelated"] = "auto"


AUTO = ErrorModel()


@dataclass(frozen=True, eq=False)
class ErrorBasis:
    """What error bars are based on.

    Attributes
    ----------
    noise : {"given", "estimated", "by-marker"}
    errors : {"independent", "autocorrelated"}
    level : NoiseLevel
        How large the residuals of each marker are.
    dependence : Dependence
        The test of the residuals.
    outliers : tuple of Outlier
        Samples that spoil what the residuals tell; `dependence` leaves them out.
    """

    noise: Noise
    errors: Errors
    level: NoiseLevel
    dependence: Dependence
    outliers: tuple[Outlier, ...]


@dataclass(frozen=True, eq=False)
class Uncertainty(ErrorBasis):
    """What the data say, and do not say, about the parameters.

    Attributes
    ----------
    names : (nq,) estimated parameters, in the order of q
    covariance : (nq, nq) of the parameters' logarithms, with nuisance parameters free
        Of a parameter that may be negative, of its deviation over its size.
        NaN in rows and columns of parameters at a bound, which the others' takes for free;
        infinite variance where the data do not determine a parameter.
    correlation : (nq, nq) NaN likewise
    quantiles : (nq,) half widths of the 95 % intervals, in standard deviations
        1.96, or Student's for a variance that was estimated.
    estimates : by name, all parameters of the user but the shares of a field
    derived : by name, the moduli of the other convention
    nuisance : by name, standard deviation of each parameter of a single experiment
        In the unit it is estimated in, that is deviations of its prior; NaN at a bound.
    nuisance_covariance : (k, k) of these, in their order
    chi_squared : float
        Σ ((ŷ − h(x)) / σ)² of the markers, with the σ given.
    degrees_of_freedom : float
        Measurements less parameters; one that a prior determines counts in part.
    notes : tuple of str
        What the user should know.
    scatter : Scatter or None
        What the recordings say one by one, where there are several.
    wider : (nq,)
        By how much intervals are wider because they disagree.
    """

    names: tuple[str, ...]
    covariance: Array
    correlation: Array
    quantiles: Array
    estimates: Mapping[str, Estimate]
    derived: Mapping[str, Estimate]
    nuisance: Mapping[str, float]
    nuisance_covariance: Array
    chi_squared: float
    degrees_of_freedom: float
    notes: tuple[str, ...]
    wider: Array
    scatter: Scatter | None = None

    @property
    def reduced_chi_squared(self) -> float:
        """χ² per degree of freedom: one when the residuals are as large as σ."""
        return self.chi_squared / max(1.0, self.degrees_of_freedom)


def covariance(collocation: Collocation, z: Array, errors: ErrorModel = AUTO) -> Uncertainty:
    """Uncertainty of the parameters at a solution.

    Parameters
    ----------
    collocation : Collocation
    z : (variables,) a point that satisfies the equations of motion, the optimum
    errors : ErrorModel

    Raises
    ------
    InputError
        If the noise is to be estimated from fewer measurements than parameters.
    SimulationError
        Where the equations of motion are singular.
    """
    fit, _ = with_pose_noise(linearised_fit(collocation, z), collocation, z)
    return uncertainty_of(fit, collocation.parameters, z[: collocation.nq], errors)


@one_blas_thread()
def uncertainty_of(
    fit: LinearisedFit, parameters: Parameters, q: Array, errors: ErrorModel = AUTO
) -> Uncertainty:
    """Uncertainty of the parameters from the fit near its answer.

    Parameters
    ----------
    fit : LinearisedFit
    parameters : Parameters
    q : (nq,) the estimated parameters in the solver's coordinates at the answer
    errors : ErrorModel
        The noise "given" trusts the markers' σ, "estimated" scales it by the residuals: then only
        the ratios between markers matter. "auto" tests the residuals: it scales σ where they are
        larger or clearly smaller, for each marker by itself where markers differ. The size of
        correlated errors always follows from the residuals, but with σ given it is at least that.
        Correlated residuals smaller than σ do not lower it: they may be small only where they
        were fitted.

    Raises
    ------
    InputError
        If the noise is to be estimated from fewer measurements than parameters.
    """
    factored = information(fit)
    shared = fit.shared
    freedom = fit.measurements - round(factored.fitted, 9)
    if errors.noise == "estimated" and freedom < 1:
        raise InputError(
            f"the noise cannot be estimated from {fit.measurements} measurements of "
            f"{len(fit.names)} parameters; give sigma_m and use noise = 'given'"
        )
    all_free, quantiles, basis = _error_bars(fit, factored, errors)
    of_all, bounded = _known(all_free, fit, parameters, q)
    scatter = _scatter(fit, parameters, q, errors)
    of_q, quantiles, wider = _widened(of_all[:shared, :shared], quantiles, scatter)
    estimates = user_estimates(parameters, q, of_q, bounded, quantiles)
    longest_s = max((float(np.ptp(block.t_s)) for block in fit.blocks), default=0.0)
    sizes = relative_slopes(parameters, q)
    deviations = np.sqrt(np.diag(of_all)[shared:]).tolist()
    return Uncertainty(
        **vars(basis),
        names=fit.names[:shared],
        covariance=of_q * np.outer(sizes, sizes),
        correlation=correlation_of(of_q),
        quantiles=quantiles,
        estimates=estimates,
        derived=derived_estimates(fit.derived, of_q, bounded, quantiles),
        nuisance=dict(zip(fit.names[shared:], deviations, strict=True)),
        nuisance_covariance=of_all[shared:, shared:],
        chi_squared=fit.chi_squared,
        degrees_of_freedom=freedom,
        notes=(
            *parameter_notes(parameters, estimates),
            *memory_notes(estimates, longest_s),
            *size_notes(errors.noise, basis.noise, basis.level, basis.errors),
            *correlation_notes(errors.errors, basis.errors, basis.dependence),
            *scatter_notes(fit, scatter),
        ),
        scatter=scatter,
        wider=wider,
    )


def _error_bars(
    fit: LinearisedFit, factored: Information, asked: ErrorModel
) -> tuple[Array, Array, ErrorBasis]:
    """Covariance of all parameters, quantiles of the shared ones, and what they are based on."""
    level = noise_level(fit, factored)
    rest, outliers = set_apart(fit)
    seen, dependent = _dependence(rest)
    correlated = asked.errors == "autocorrelated" or (asked.errors == "auto" and dependent)
    kind: Noise = level.kind if asked.noise == "auto" else asked.noise
    if asked.noise == "auto" and correlated and level.pooled < 1:
        kind = "given"
    of_score, freedom = level.score_covariance(kind, factored, fit.shared)
    covariance = factored.fit.covariance(of_score)
    used = "independent"
    if correlated:
        of_score, of_few = _autocorrelated(fit, factored, kind, level)
        persistent = factored.fit.covariance(of_score)
        before, after = (np.diag(each)[: fit.shared] for each in (covariance, persistent))
        widens = (after > CONSEQUENCE**2 * before).any()
        if asked.errors == "autocorrelated" or kind != "given" or widens:
            covariance = persistent
            freedom = of_few
            used = "autocorrelated"
    if fit.of_phases is not None:
        covariance = covariance.copy()
        covariance[: fit.shared, : fit.shared] += fit.of_phases
    return covariance, student_ppf(0.975, freedom), ErrorBasis(kind, used, level, seen, outliers)


def _known(
    covariance: Array, fit: LinearisedFit, parameters: Parameters, q: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Covariance of all parameters as it is told, and which of the shared ones are at a bound.

    It is NaN of those at a bound, and infinite of shared ones that the data do not determine.
    """
    told = covariance.copy()
    shared = fit.shared
    silent = _no_information(parameters, q, np.diag(covariance)[:shared])
    at_bound = fit.at_bound.copy()
    at_bound[:shared] &= ~silent
    told[at_bound] = told[:, at_bound] = np.nan
    of_q = told[:shared, :shared]
    bounded = at_bound[:shared]
    lost = np.flatnonzero((np.diag(of_q) > UNDETERMINED**2) | (silent & fit.at_bound[:shared]))
    of_q[lost] = of_q[:, lost] = np.nan
    of_q[lost, lost] = np.inf
    return told, bounded


def _widened(of_q: Array, quantiles: Array, scatter: Scatter | None) -> tuple[Array, Array, Array]:
    """Covariance and quantiles, larger where recordings disagree, and by what intervals are so."""
    if scatter is None:
        return of_q, quantiles, np.ones(len(quantiles))
    with np.errstate(invalid="ignore"):
        factors = np.sqrt(scatter.widened(np.diag(of_q)) / np.diag(of_q))
    factors = np.where(scatter.disagreeing, factors, 1.0)
    of_few = np.maximum(quantiles, student_ppf(0.975, np.maximum(scatter.freedom, 1)))
    wide = np.where(scatter.disagreeing, of_few, quantiles)
    return of_q * np.outer(factors, factors), wide, factors * wide / quantiles


def _scatter(
    fit: LinearisedFit, parameters: Parameters, q: Array, errors: ErrorModel
) -> Scatter | None:
    """What recordings say one by one, with error bars of their own."""
    if len(recordings_of(fit)) < 2:
        return None
    known = {}
    sizes = relative_slopes(parameters, q)
    for alone, step in single_fits(fit):
        if alone.measurements <= len(alone.names):
            continue
        found = uncertainty_of(alone, parameters, q, errors)
        independent = least_squares(alone).errors[: fit.shared] ** 2
        variances = np.diag(found.covariance) / sizes**2
        known[alone.blocks[0].name] = step[: fit.shared], variances, independent
    return scatter_of(fit, known) if len(known) > 1 else None


def _no_information(parameters: Parameters, q: Array, variances: Array) -> NDArray[np.bool_]:
    """(nq,) dampings of which even a hundred times the usual would not show."""
    found = []
    for item, at, variance in zip(parameters.free, q, variances, strict=True):
        usual = constant_named(item.name).usual or 0.0
        deviation = np.sqrt(variance) * item.per_value(item.value(float(at)))
        found.append(is_damping(item.name) and not deviation <= UNINFORMED * usual)
    return np.array(found, dtype=bool)


def _dependence(fit: LinearisedFit) -> tuple[Dependence, bool]:
    """How the residuals hang together, and whether more than what is known to add to the noise."""
    factored = information(fit)
    level = noise_level(fit, factored)
    found = dependence(fit, factored)
    found = replace(found, lag1_deviation=found.lag1_deviation * level.unevenness)
    return found, found.found and not _expected(fit, factored, level, found)


def _expected(
    fit: LinearisedFit, factored: Information, level: NoiseLevel, found: Dependence
) -> bool:
    """Whether what is known to add to the noise makes residuals as dependent as they are."""
    added = drawn(fit)
    if not len(added[0]):
        return False
    rng = np.random.default_rng(0)
    size = np.sqrt(max(1.0, level.pooled))
    errors = [
        (each[:REPLICAS] + size * rng.normal(size=each[:REPLICAS].shape)) * block.seen
        for each, block in zip(added, fit.blocks, strict=True)
    ]
    _, left = projected(factored, errors)
    replicas = [
        dependence(
            replace(
                fit,
                blocks=tuple(
                    replace(block, residual=each[k] * block.seen)
                    for block, each in zip(fit.blocks, left, strict=True)
                ),
            ),
            factored,
        )
        for k in range(len(errors[0]))
    ]
    least, most = (pick(each.lag1 for each in replicas) for pick in (min, max))
    return least <= found.lag1 <= most and found.shared_p >= min(r.shared_p for r in replicas)


def _autocorrelated(
    fit: LinearisedFit, factored: Information, kind: Noise, level: NoiseLevel
) -> tuple[Array, Array]:
    """Covariance of the score of correlated errors, and its degrees of freedom."""
    of_score, freedom = score_covariance(factored, error_processes(fit, factored), fit.shared)
    if kind == "given" or level.extra.any():
        # In no direction less than independent errors of the σ given bring, nor than those found
        # with what is known to add to them: an autoregression may miss that.
        least, _ = level.score_covariance(kind, factored, fit.shared)
        root = np.linalg.cholesky(least + 1e-12 * np.eye(len(least)))
        over = np.linalg.solve(root, np.linalg.solve(root, of_score).T)
        values, vectors = np.linalg.eigh((over + over.T) / 2)
        wide = root @ vectors
        of_score = (wide * np.maximum(values, 1.0)) @ wide.T
    return of_score, freedom


@dataclass(frozen=True, eq=False)
class Place:
    """Where a marker sits.

    Attributes
    ----------
    position_m : (3,) on the undeformed body
    std_error_m : (3,) or None
        Standard error of each coordinate, zero for a place that is exact; None without error bars.
    prior_m : float
        Standard deviation of the prior of each coordinate, zero for a place that is exact.
    given_m : (3,) or None
        The place that was given; None where it was not known.
    """

    position_m: Array
    std_error_m: Array | None
    prior_m: float
    given_m: Array | None
    TOLD: ClassVar = ("given",)

    @property
    def given(self) -> bool:
        """Whether a place was given."""
        return self.given_m is not None

    @property
    def moved_m(self) -> float | None:
        """How far it was found from the place given."""
        given = self.given_m
        return None if given is None else float(np.linalg.norm(self.position_m - given))


def places_of(part: Part, uncertainty: Uncertainty | None = None) -> dict[str, Place]:
    """Places of an experiment's markers at a solution, by name."""
    segment = part.segment
    chart = segment.chart
    markers = segment.experiment.markers
    errors = _std_errors_m(part, uncertainty)
    return {
        name: Place(
            position,
            None if errors is None or not np.isfinite(errors[m]).all() else errors[m],
            float(chart.sigma_m[m]),
            chart.given_m[m] if markers.located[m] else None,
        )
        for m, (name, position) in enumerate(
            zip(markers.names, segment.places_m(part.phi), strict=True)
        )
    }


def _std_errors_m(part: Part, uncertainty: Uncertainty | None) -> Array | None:
    """(M, 3) of the coordinates; on a surface they move together."""
    if uncertainty is None:
        return None
    segment = part.segment
    chart = part.segment.chart
    row = {name: k for k, name in enumerate(uncertainty.nuisance)}
    at = np.array([row[name] for name in segment.nuisance.names], dtype=np.int64)
    errors = np.zeros(chart.points_m.shape)
    for m in chart.estimated:
        here = at[segment.markers.place_places[m]]
        of_phi = uncertainty.nuisance_covariance[np.ix_(here, here)]
        along = chart.sigma_m[m] * chart.axes[m]
        errors[m] = np.sqrt(np.einsum("ik,kl,il->i", along, of_phi, along))
    return errors
