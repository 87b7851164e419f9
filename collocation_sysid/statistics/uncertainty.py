"""Error bars of the estimated parameters, from the information of the fit and from its residuals.

With S the derivatives of the residuals (h(x) − ŷ)/σ along the equations of motion and P those of
the priors, the error of the estimate is A⁻¹ Sᵀe, A = SᵀS + PᵀP, with the covariance

    C = A⁻¹ (Sᵀ Cov(e) S + PᵀP) A⁻¹.

The block of the shared parameters q is reported; nuisance parameters of single experiments widen it
by what they could have explained. For independent errors of the stated σ, C is A⁻¹. If the
residuals are larger or smaller than σ, Cov(e) = s² I with their variance s², and where markers
differ each has its own variance (see `noise_level`); intervals are then Student's. If a test finds
the residuals correlated, in time or among markers, Cov(e) is that of `autocorrelation`. The output
states which was used.

Use `pose_noise.uncertainty_at` at a solution, or `uncertainty_from_fit` where the linearised
fit is known. Estimated marker places have error bars too, see `marker_places`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import compress
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from ..common.array_types import Array
from ..common.validated_classes import validated
from ..errors import InputError
from ..fem.laws.constants import constant_named, is_damping
from ..model.parameters import Parameters
from ..program.collocation import ExperimentIterate
from ..program.linear_algebra.lapack import one_blas_thread
from .distributions import normal_isf, student_95
from .estimates import (
    UNDETERMINED,
    Estimate,
    correlation_from_covariance,
    correlation_notes,
    derived_estimates,
    disagreement_notes,
    memory_notes,
    noise_notes,
    parameter_notes,
    relative_derivatives,
    user_estimates,
    without_long_term_moduli,
)
from .linearised import Information, LinearisedFit, factorise_information, least_squares_of_fit
from .residuals.autocorrelation import (
    Dependence,
    analyse_dependence,
    error_processes,
    score_covariance,
)
from .residuals.diagnostics import Outlier, remove_outliers
from .residuals.noise_level import (
    Noise,
    NoiseLevel,
    disturbance_samples,
    estimate_noise_level,
    project_errors,
)
from .residuals.recording_scatter import RecordingComparison, compare_recordings, single_fits

Errors = Literal["independent", "autocorrelated"]

# A damping at its bound has no information if it may be this many times its usual value.
UNINFORMED = 100.0
# With stated σ, correlation that widens error bars by less than this factor is ignored.
CONSEQUENCE = 1.05
# Simulated residuals that show how correlated they are by chance.
REPLICAS = 39


@validated
class ErrorModel:
    """Options: assumptions about the errors of the measurements.

    Attributes
    ----------
    noise : {"auto", "given", "estimated"}
        Use the stated σ ("given"), scale it by the residuals ("estimated"), or decide by a test of
        the residuals ("auto").
    errors : {"auto", "independent", "autocorrelated"}
        Correlation of the errors; "auto" decides by a test of the residuals.
    """

    noise: Literal["auto", "given", "estimated"] = "auto"
    errors: Literal["auto", "independent", "autocorrelated"] = "auto"


AUTO = ErrorModel()


@dataclass(frozen=True, eq=False)
class ErrorBasis:
    """Error model that error bars are based on."""

    # Source of the variance: stated σ, one common factor, or one factor for each marker.
    noise: Noise
    errors: Errors  # correlation of the errors
    level: NoiseLevel  # size of the residuals of each marker
    dependence: Dependence  # tests of the residuals for correlation
    # The same without the measurements whose instruments may err slowly, as trackers of videos do,
    # and whose residuals are within their σ.
    unexplained: Dependence
    # Single samples that dominate the residuals of their marker; `analyse_dependence` leaves them
    # out.
    outliers: tuple[Outlier, ...]


@dataclass(frozen=True, eq=False)
class Uncertainty(ErrorBasis):
    """Statistical uncertainty of the estimated parameters.

    Attributes
    ----------
    names : (nq,) tuple of str
        Estimated parameters, in the order of q.
    covariance : (nq, nq) array
        Covariance of the parameters' logarithms with free nuisance parameters; of a parameter that
        may be negative, of its value over its size. NaN in rows and columns of parameters at a
        bound (the variances of the others treat those as free); infinite variance where the data do
        not determine a parameter.
    complete_covariance : (nq, nq) array
        Finite covariance of the same quantities for normal 95 % intervals: directions without
        information have the standard deviation `UNDETERMINED`, and parameters at a bound are free.
        Differences between recordings are not contained.
    noise_covariance : (p, p) array
        The same of all parameters and effects of the fit in the solver's coordinates.
    correlation : (nq, nq) array
        Correlations; NaN where a variance is not finite.
    quantiles : (nq,) array
        Half widths of the 95 % intervals in standard deviations: 1.96, or Student's for an
        estimated variance.
    estimates : mapping of str to Estimate
        All scalar parameters by name.
    derived : mapping of str to Estimate
        Moduli of the other convention by name.
    nuisance : mapping of str to float
        Standard deviation of each nuisance parameter, in standard deviations of its prior; NaN at a
        bound.
    nuisance_covariance : (k, k) array
        Covariance of these, then of the effects, in their order.
    chi_squared : float
        Σ ((ŷ − h(x)) / σ)² of the measurements, with the stated σ.
    degrees_of_freedom : float
        Measurements less parameters; one that a prior determines counts in part.
    notes : tuple of str
        Notes for the user.
    widening : (nq,) array
        Factor by which intervals are widened because recordings disagree; 1 if they agree.
    scatter : RecordingComparison or None
        Comparison of single recordings; None unless there are several.
    """

    names: tuple[str, ...]
    covariance: Array
    complete_covariance: Array
    noise_covariance: Array
    correlation: Array
    quantiles: Array
    estimates: Mapping[str, Estimate]
    derived: Mapping[str, Estimate]
    nuisance: Mapping[str, float]
    nuisance_covariance: Array
    chi_squared: float
    degrees_of_freedom: float
    notes: tuple[str, ...]
    widening: Array
    scatter: RecordingComparison | None = None

    @property
    def reduced_chi_squared(self) -> float:
        """χ² per degree of freedom, with at least one degree of freedom; 1 if the residuals are as
        large as σ.
        """
        return self.chi_squared / max(1.0, self.degrees_of_freedom)


@one_blas_thread()
def uncertainty_from_fit(
    fit: LinearisedFit, parameters: Parameters, q: Array, error_model: ErrorModel = AUTO
) -> Uncertainty:
    """Return the uncertainty of the parameters from the linearised fit.

    Parameters
    ----------
    q : (nq,) array
        Estimates in the solver's coordinates.
    error_model : ErrorModel
        Assumptions about the errors. With noise "estimated" only the ratios of the stated σ matter.
        With "auto" σ is scaled where residuals are larger or clearly smaller, separately for each
        marker where markers differ. The size of correlated errors always follows from the
        residuals, but with noise "given" it is at least the stated σ. Correlated residuals smaller
        than σ do not lower it, because they may be small only where they were fitted.

    Raises
    ------
    InputError
        If the noise is to be estimated from fewer measurements than parameters.

    Notes
    -----
    If several recordings are fitted, each is also fitted alone, by a Gauss–Newton step and with the
    same assumptions, to compare them.
    """
    factored = factorise_information(fit)
    shared = fit.shared_count
    freedom = fit.measurement_count - round(factored.determined_count, 9)
    if error_model.noise == "estimated" and freedom < 1:
        raise InputError(
            f"the noise cannot be estimated from {fit.measurement_count} measurements, which are not "
            "more than the parameters that they determine; state the standard deviation of the noise "
            "(sigma_m) and noise = 'given'"
        )
    covariance, determined, quantiles, basis = _error_bars(fit, factored, requested=error_model)
    of_effects = factored.fit.root @ factored.fit.root[len(fit.names) - fit.effect_count :].T
    determined = determined - of_effects @ of_effects.T
    of_effects[fit.shared_count :] = 0.0  # nuisance parameters and effects keep the complete one
    covariance = covariance - of_effects @ of_effects.T
    of_all, bounded = _reported_covariance(covariance, fit, parameters=parameters, q=q)
    scatter = _compare_recordings(fit.with_known_effects, parameters, q=q, errors=error_model)
    of_q, widening = _widen_by_scatter(of_all[:shared, :shared], scatter)
    estimates = user_estimates(
        parameters, q, covariance_q=of_q, at_bound=bounded, quantiles=quantiles
    )
    derived = derived_estimates(
        fit.derived,
        of_q,
        at_bound=bounded,
        quantiles=quantiles,
        reasons=[estimates[n].reason if n in estimates else None for n in fit.names[:shared]],
    )
    estimates = without_long_term_moduli(parameters, estimates)
    longest_s = max((float(np.ptp(block.t_s)) for block in fit.blocks), default=0.0)
    sizes = relative_derivatives(parameters, q)
    deviations = np.sqrt(np.diag(of_all)[shared:]).tolist()
    # One factor for all: different ones would widen combinations that are known well.
    factor = np.nanmax(quantiles, initial=normal_isf(0.025)) / normal_isf(0.025)
    open_ways = UNDETERMINED * factored.fit.null_space
    of_noise_alone = factor**2 * determined + open_ways @ open_ways.T
    return Uncertainty(
        **vars(basis),
        names=fit.names[:shared],
        covariance=of_q * np.outer(sizes, sizes),
        complete_covariance=of_noise_alone[:shared, :shared] * np.outer(sizes, sizes),
        noise_covariance=of_noise_alone,
        correlation=correlation_from_covariance(of_q),
        quantiles=quantiles,
        estimates=estimates,
        derived=without_long_term_moduli(parameters, derived),
        nuisance=dict(
            zip(fit.with_known_effects.names[shared:], deviations, strict=False)  # of effects too
        ),
        nuisance_covariance=of_all[shared:, shared:],
        chi_squared=fit.chi_squared,
        degrees_of_freedom=freedom,
        notes=(
            *parameter_notes(parameters, estimates),
            *memory_notes(estimates, longest_s),
            *noise_notes(error_model.noise, basis.noise, level=basis.level, errors=basis.errors),
            *correlation_notes(
                error_model.errors, basis.errors, basis.dependence, unexplained=basis.unexplained
            ),
            *disagreement_notes(parameters, scatter),
        ),
        scatter=scatter,
        widening=widening,
    )


def _error_bars(
    fit: LinearisedFit, factored: Information, requested: ErrorModel
) -> tuple[Array, Array, Array, ErrorBasis]:
    """Choose an error model, and return the covariance (p, p) of all parameters in the solver's
    coordinates, the same in the directions that are determined, finite, the half widths (nq,) of
    the 95 % intervals of shared parameters in standard deviations, and the error model.

    Correlated errors are used if they are requested, or with "auto" if tests find them; with the
    stated σ, and unless requested, only if they widen a standard error by more than `CONSEQUENCE`.
    With noise "auto", correlated residuals that are smaller than σ do not reduce it.
    """
    level = estimate_noise_level(fit, factored)
    without_outliers, outliers = remove_outliers(fit)
    dependence, dependent, unexplained = _dependence(without_outliers)
    correlated = requested.errors == "autocorrelated" or (requested.errors == "auto" and dependent)
    kind: Noise = level.suggest_noise() if requested.noise == "auto" else requested.noise
    if requested.noise == "auto" and correlated and level.pooled < 1:
        kind = "given"
    of_score, freedom = level.score_covariance(kind, factored, shared=fit.shared_count)
    covariance = factored.fit.covariance(of_score)
    used = "independent"
    if correlated:
        of_correlated, few_freedom = _correlated_score_covariance(
            fit, factored, kind=kind, level=level
        )
        persistent = factored.fit.covariance(of_correlated)
        before, after = (np.diag(each)[: fit.shared_count] for each in (covariance, persistent))
        widens = (after > CONSEQUENCE**2 * before).any()
        if requested.errors == "autocorrelated" or kind != "given" or widens:
            covariance = persistent
            freedom = few_freedom
            used = "autocorrelated"
            of_score = of_correlated
    determined = factored.fit.root @ of_score @ factored.fit.root.T
    basis = ErrorBasis(kind, used, level, dependence, unexplained, outliers)
    return covariance, determined, student_95(freedom), basis


def _reported_covariance(
    covariance: Array, fit: LinearisedFit, parameters: Parameters, q: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Return the covariance (p, p) of all parameters as it is reported, and a mask (nq,) of shared
    parameters at a bound.

    Rows and columns of parameters at a bound are NaN; shared parameters that the data do not
    determine have infinite variance.
    """
    reported = covariance.copy()
    shared = fit.shared_count
    uninformed = _has_no_information(parameters, q, variances=np.diag(covariance)[:shared])
    at_bound = fit.at_bound.copy()
    at_bound[:shared] &= ~uninformed
    reported[at_bound] = reported[:, at_bound] = np.nan
    of_q = reported[:shared, :shared]
    bounded = at_bound[:shared]
    undetermined = np.flatnonzero(
        (np.diag(of_q) > UNDETERMINED**2) | (uninformed & fit.at_bound[:shared])
    )
    of_q[undetermined] = of_q[:, undetermined] = np.nan
    of_q[undetermined, undetermined] = np.inf
    return reported, bounded


def _widen_by_scatter(
    covariance_q: Array, scatter: RecordingComparison | None
) -> tuple[Array, Array]:
    """Return the covariance (nq, nq), and by what the 95 % intervals are wider (nq,), where recordings
    disagree.
    """
    if scatter is None:
        return covariance_q, np.ones(len(covariance_q))
    with np.errstate(invalid="ignore"):
        factors = np.sqrt(scatter.widen(np.diag(covariance_q)) / np.diag(covariance_q))
    factors = np.where(scatter.find_disagreements(), factors, 1.0)
    return covariance_q * np.outer(factors, factors), factors


def _compare_recordings(
    fit: LinearisedFit, parameters: Parameters, q: Array, errors: ErrorModel
) -> RecordingComparison | None:
    """Return the comparison of single recordings with their own error bars; None if fewer than two
    recordings have more measurements than parameters, or all residuals are zero.

    Each recording is evaluated by `uncertainty_from_fit` with the error model `errors`.
    """
    if len({block.name for block in fit.blocks}) < 2 or not fit.chi_squared:
        return None
    known: dict[str, tuple[Array, Array, Array]] = {}
    sizes = relative_derivatives(parameters, q)
    for alone, step in single_fits(fit):
        if alone.measurement_count <= len(alone.names):
            continue
        uncertainty = uncertainty_from_fit(alone, parameters, q=q, error_model=errors)
        independent = least_squares_of_fit(alone).standard_errors[: fit.shared_count] ** 2
        variances = np.diag(uncertainty.covariance) / sizes**2
        known[alone.blocks[0].name] = step[: fit.shared_count], variances, independent
    return compare_recordings(fit, known) if len(known) > 1 else None


def _has_no_information(parameters: Parameters, q: Array, variances: Array) -> NDArray[np.bool_]:
    """Return the mask (nq,) of damping parameters whose standard deviation exceeds `UNINFORMED`
    times their usual value, or is NaN, from the variances (nq,) of q; false for all other
    parameters.
    """
    uninformed = []
    for item, at, variance in zip(parameters.free, q, variances, strict=True):
        usual = constant_named(item.name).usual or 0.0
        deviation = np.sqrt(variance) * item.value_derivative(item.from_coordinate(float(at)))
        uninformed.append(is_damping(item.name) and not deviation <= UNINFORMED * usual)
    return np.array(uninformed, dtype=bool)


def _dependence(fit: LinearisedFit) -> tuple[Dependence, bool, Dependence]:
    """Return the tests of the residuals for correlation, whether they show more than known
    disturbances, such as noise of the poses, explain, and the tests without residuals that may be
    slow errors of instruments.

    The standard deviation of the autocorrelation is increased if the noise of markers differs.
    """
    factored = factorise_information(fit)
    level = estimate_noise_level(fit, factored)
    tested = analyse_dependence(fit, factored)
    tested = replace(tested, lag1_deviation=tested.lag1_deviation * level.unevenness)
    is_dependent = tested.is_correlated() and not _is_explained(
        fit, factored, level=level, result=tested
    )
    return tested, is_dependent, _unexplained_dependence(fit, factored, tested)


def _unexplained_dependence(
    fit: LinearisedFit, factored: Information, dependence: Dependence
) -> Dependence:
    """Return the tests without residuals that may be slow errors of instruments."""
    kept = [not block.may_be_slow_errors() for block in fit.blocks]
    if all(kept):
        return dependence
    if not any(kept):
        return Dependence(0.0, np.inf, shared_p=1.0)
    slopes = tuple(compress(factored.scaled_jacobians, kept))
    rest = replace(fit, blocks=tuple(compress(fit.blocks, kept)))
    return analyse_dependence(rest, replace(factored, scaled_jacobians=slopes))


def _is_explained(
    fit: LinearisedFit, factored: Information, level: NoiseLevel, result: Dependence
) -> bool:
    """Whether known disturbances (such as noise of the poses) explain residuals as correlated as
    those in `result`; false without disturbances.

    `REPLICAS` simulated residuals with disturbances and white noise are tested likewise: the
    autocorrelation has to lie within their range, and correlations among channels must not be more
    significant than in all of them. Correlation in space is ignored.
    """
    added = disturbance_samples(fit)
    if not len(added[0]):
        return False
    rng = np.random.default_rng(0)
    size = np.sqrt(max(1.0, level.pooled))
    errors = [
        (each[:REPLICAS] + size * rng.normal(size=each[:REPLICAS].shape)) * block.is_measured
        for each, block in zip(added, fit.blocks, strict=True)
    ]
    _, residuals = project_errors(factored, errors)
    replicas = [
        analyse_dependence(
            replace(
                fit,
                blocks=tuple(
                    replace(block, residual=each[k] * block.is_measured)
                    for block, each in zip(fit.blocks, residuals, strict=True)
                ),
            ),
            factored,
        )
        for k in range(len(errors[0]))
    ]
    least, most = (pick(each.lag1 for each in replicas) for pick in (min, max))
    return least <= result.lag1 <= most and result.shared_p >= min(r.shared_p for r in replicas)


def _correlated_score_covariance(
    fit: LinearisedFit, factored: Information, kind: Noise, level: NoiseLevel
) -> tuple[Array, Array]:
    """Return the covariance (r, r) of the score, and degrees of freedom (shared,)."""
    of_score, freedom = score_covariance(
        factored, error_processes(fit, factored), shared=fit.shared_count
    )
    if kind == "given" or level.known_score_covariance.any():
        # In no direction less than independent errors of the σ given bring, nor than those found
        # with what is known to add to them: an autoregression may miss that.
        least, _ = level.score_covariance(kind, factored, shared=fit.shared_count)
        root = np.linalg.cholesky(least + 1e-12 * np.eye(len(least)))
        over = np.linalg.solve(root, np.linalg.solve(root, of_score).T)
        values, vectors = np.linalg.eigh((over + over.T) / 2)
        wide = root @ vectors
        of_score = (wide * np.maximum(values, 1.0)) @ wide.T
    return of_score, freedom


@dataclass(frozen=True, eq=False)
class MarkerPlace:
    """Place of a marker on the undeformed body."""

    position_m: Array  # (3,): estimated or exact place [m]
    # (3,) or None: standard error of each coordinate [m], zero for an exact place; None without
    # error bars.
    std_error_m: Array | None
    prior_m: float  # prior standard deviation of each coordinate [m], zero for an exact place
    declared_m: Array | None  # (3,) or None: stated place [m]; None if there is none
    SERIALISED_PROPERTIES: ClassVar = ("is_declared",)

    @property
    def is_declared(self) -> bool:
        """Whether a place was stated."""
        return self.declared_m is not None

    @property
    def displacement_m(self) -> float | None:
        """Distance of the estimate from the stated place [m], not negative; None if none was
        stated.
        """
        declared_m = self.declared_m
        return None if declared_m is None else float(np.linalg.norm(self.position_m - declared_m))


def marker_places(
    iterate: ExperimentIterate, uncertainty: Uncertainty | None = None
) -> dict[str, MarkerPlace]:
    """Return the places of an experiment's markers at a solution, by the marker's name; without
    `uncertainty` (None), and where it is not finite, a place has no standard errors.
    """
    transcription = iterate.transcription
    association = transcription.association.markers
    markers = transcription.experiment.markers
    errors = _std_errors_m(iterate, uncertainty)
    return {
        name: MarkerPlace(
            position,
            None if errors is None or not np.isfinite(errors[m]).all() else errors[m],
            prior_m=float(association.sigma_m[m]),
            declared_m=association.prior_places_m[m] if markers.located[m] else None,
        )
        for m, (name, position) in enumerate(
            zip(markers.names, transcription.marker_places_m(iterate.phi), strict=True)
        )
    }


def _std_errors_m(iterate: ExperimentIterate, uncertainty: Uncertainty | None) -> Array | None:
    """Return the standard errors (M, 3) of the coordinates of an experiment's marker places [m],
    along the axes of the body, zero for exact places; None without `uncertainty`.
    """
    if uncertainty is None:
        return None
    transcription = iterate.transcription
    association = transcription.association.markers
    row = {name: k for k, name in enumerate(uncertainty.nuisance)}
    at = np.array([row[name] for name in transcription.nuisance.names], dtype=np.int64)
    errors = np.zeros(association.centre_places_m.shape)
    for m in association.estimated:
        indices = at[transcription.markers.observable.coordinate_parameters[m]]
        of_phi = uncertainty.nuisance_covariance[np.ix_(indices, indices)]
        axes_m = association.sigma_m[m] * association.axes[m]
        errors[m] = np.sqrt(np.einsum("ik,kl,il->i", axes_m, of_phi, axes_m))
    return errors
