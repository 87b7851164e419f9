"""Error bars of the estimated parameters, from the information of the fit and from its residuals.

With S the slopes of the residuals (h(x) − ŷ)/σ along the equations of motion and P those of the
priors, the estimate errs by A⁻¹ Sᵀe, A = SᵀS + PᵀP, and has the covariance

    C = A⁻¹ (Sᵀ Cov(e) S + PᵀP) A⁻¹,

of which the block of the shared parameters q is reported: nuisance parameters of single
experiments widen it by what they could have explained. For independent errors of the σ given it
is A⁻¹. If σ is to be estimated, Cov(e) = s² I with the residuals' variance s², and intervals are
Student's. If a test finds the residuals correlated, in time or among markers, Cov(e) is that of
`autocorrelation`; the output names which of them was used.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm, t

from ..arrays import Array
from ..errors import InputError
from ..nlp.collocation import Collocation
from ..nlp.lapack import one_blas_thread
from ..nlp.parameters import Parameters
from .autocorrelation import Dependence, dependence, error_processes, score_covariance
from .estimates import (
    UNDETERMINED,
    Estimate,
    correlation_of,
    derived_estimates,
    relative_slopes,
    user_estimates,
)
from .information import Information, information
from .linearised import AT_BOUND, LinearisedFit, linearised_fit
from .sensitivity import marker_sensitivities, sensitivities

__all__ = [
    "Errors",
    "Estimate",
    "Noise",
    "Uncertainty",
    "covariance",
    "marker_sensitivities",
    "sensitivities",
    "uncertainty_of",
]

Noise = Literal["given", "estimated"]
Errors = Literal["independent", "autocorrelated"]
ErrorsOption = Literal["auto", "independent", "autocorrelated"]

# Residuals this many times the given sigma, squared, are worth a warning.
SUSPICIOUS_CHI_SQUARED = 2.0
# With σ given, correlation that widens no error bar by this factor is of no consequence.
CONSEQUENCE = 1.05


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """What the data say, and do not say, about the parameters.

    Attributes
    ----------
    names : (nq,) estimated parameters, in the order of q
    covariance : (nq, nq) of the parameters' logarithms, with nuisance parameters free
        Of a parameter that may be negative, of its deviation over its size.
        NaN in rows and columns of parameters at a bound, the others' is as if those were fixed;
        infinite variance where the data do not determine a parameter.
    correlation : (nq, nq) NaN likewise
    quantiles : (nq,) half widths of the 95 % intervals, in standard deviations
        1.96, or Student's for a variance that was estimated.
    estimates : by name, all parameters of the user
    derived : by name, the moduli of the other convention
    nuisance : by name, standard deviation of each parameter of a single experiment
        In the unit it is estimated in, that is deviations of its prior; NaN at a bound.
    noise : {"given", "estimated"}
    errors : {"independent", "autocorrelated"}
        What the error bars are based on.
    dependence : Dependence
        The test of the residuals.
    chi_squared : float
        Σ ((ŷ − h(x)) / σ)² of the markers, with the σ given.
    degrees_of_freedom : float
        Measurements less parameters; one that a prior determines counts in part.
    notes : tuple of str
        What the user should know.
    """

    names: tuple[str, ...]
    covariance: Array
    correlation: Array
    quantiles: Array
    estimates: Mapping[str, Estimate]
    derived: Mapping[str, Estimate]
    nuisance: Mapping[str, float]
    noise: Noise
    errors: Errors
    dependence: Dependence
    chi_squared: float
    degrees_of_freedom: float
    notes: tuple[str, ...]

    @property
    def reduced_chi_squared(self) -> float:
        """χ² per degree of freedom: one when the residuals are as large as σ."""
        return self.chi_squared / max(1.0, self.degrees_of_freedom)


def covariance(
    collocation: Collocation,
    z: Array,
    marker_z: Sequence[Array] | None = None,
    noise: Noise = "given",
    errors: ErrorsOption = "auto",
) -> Uncertainty:
    """Uncertainty of the parameters at a solution.

    Parameters
    ----------
    collocation : Collocation
    z : (variables,) a point that satisfies the equations of motion, the optimum
    marker_z : sequence of (T, 3M, nq), optional
        `marker_sensitivities`, where they are known already.
    noise, errors
        See `uncertainty_of`.

    Raises
    ------
    InputError
        If the noise is to be estimated from fewer measurements than parameters.
    SimulationError
        Where the equations of motion are singular.
    """
    _check(noise, errors)
    fit = linearised_fit(collocation, z, marker_z)
    return uncertainty_of(fit, collocation.parameters, z[: collocation.nq], noise, errors)


@one_blas_thread()
def uncertainty_of(
    fit: LinearisedFit,
    parameters: Parameters,
    q: Array,
    noise: Noise = "given",
    errors: ErrorsOption = "auto",
) -> Uncertainty:
    """Uncertainty of the parameters from the fit near its answer.

    Parameters
    ----------
    fit : LinearisedFit
    parameters : Parameters
    q : (nq,) the estimated parameters in the solver's coordinates at the answer
    noise : {"given", "estimated"}
        Trust the markers' σ, or scale it by the residuals. Estimate it when σ is not known; only
        the ratios between markers matter then.
    errors : {"auto", "independent", "autocorrelated"}
        What to assume of the errors; "auto" tests the residuals. The size of correlated errors
        always follows from the residuals, but with σ given it is at least that.

    Raises
    ------
    InputError
        If the noise is to be estimated from fewer measurements than parameters.
    """
    _check(noise, errors)
    factored = information(fit)
    freedom = fit.measurements - round(factored.fitted, 9)
    if noise == "estimated" and freedom < 1:
        raise InputError(
            f"the noise cannot be estimated from {fit.measurements} measurements of "
            f"{int((~fit.at_bound).sum())} parameters; give sigma_m and use noise = 'given'"
        )
    reduced = fit.chi_squared / max(1.0, freedom)
    found = dependence(fit, factored)
    of_all, quantiles = _independent(fit, factored, noise, reduced, freedom)
    used: Errors = "independent"
    if errors == "autocorrelated" or (errors == "auto" and found.found):
        correlated = _autocorrelated(fit, factored, noise)
        if errors == "autocorrelated" or noise == "estimated" or _widens(fit, correlated, of_all):
            (of_all, quantiles), used = correlated, "autocorrelated"
    shared = fit.shared
    of_all[fit.at_bound] = of_all[:, fit.at_bound] = np.nan
    of_q, bounded = of_all[:shared, :shared], fit.at_bound[:shared]
    lost = np.flatnonzero(np.diag(of_q) > UNDETERMINED**2)
    of_q[lost] = of_q[:, lost] = np.nan
    of_q[lost, lost] = np.inf
    estimates = user_estimates(parameters, q, of_q, bounded, quantiles)
    sizes = relative_slopes(parameters, q)
    return Uncertainty(
        names=fit.names[:shared],
        covariance=of_q * np.outer(sizes, sizes),
        correlation=correlation_of(of_q),
        quantiles=quantiles,
        estimates=estimates,
        derived=derived_estimates(fit.derived, of_q, bounded, quantiles),
        nuisance=dict(
            zip(fit.names[shared:], np.sqrt(np.diag(of_all)[shared:]).tolist(), strict=True)
        ),
        noise=noise,
        errors=used,
        dependence=found,
        chi_squared=fit.chi_squared,
        degrees_of_freedom=freedom,
        notes=(
            *_parameter_notes(parameters, q, bounded, estimates),
            *_residual_notes(noise, used, found, reduced, forced=errors == "independent"),
        ),
    )


def _check(noise: str, errors: str) -> None:
    for name, value, known in (
        ("noise", noise, get_args(Noise)),
        ("errors", errors, get_args(ErrorsOption)),
    ):
        if value not in known:
            raise InputError(f"{name} is {value!r}; expected one of {', '.join(known)}")


def _independent(
    fit: LinearisedFit, factored: Information, noise: Noise, reduced: float, freedom: float
) -> tuple[Array, Array]:
    """Covariance of all parameters, and the quantiles of the shared ones."""
    identity = np.eye(len(factored.prior))
    if noise == "given":
        return factored.covariance(identity), np.full(fit.shared, norm.ppf(0.975))
    of_score = reduced * (identity - factored.prior) + factored.prior
    return factored.covariance(of_score), np.full(fit.shared, t.ppf(0.975, freedom))


def _autocorrelated(fit: LinearisedFit, factored: Information, noise: Noise) -> tuple[Array, Array]:
    of_score, freedom = score_covariance(factored, error_processes(fit, factored), fit.shared)
    if noise == "given":  # in no direction less than independent errors of the σ given bring
        values, vectors = np.linalg.eigh(of_score)
        of_score = (vectors * np.maximum(values, 1.0)) @ vectors.T
    return factored.covariance(of_score), t.ppf(0.975, freedom)


def _widens(fit: LinearisedFit, correlated: tuple[Array, Array], independent: Array) -> bool:
    before, after = (np.diag(each)[: fit.shared] for each in (independent, correlated[0]))
    return bool((after > CONSEQUENCE**2 * before).any())


def _parameter_notes(
    parameters: Parameters,
    q: Array,
    bounded: NDArray[np.bool_],
    estimates: Mapping[str, Estimate],
) -> list[str]:
    notes = []
    for k, item in enumerate(parameters.free):
        estimate = estimates[item.name]
        if bounded[k]:
            side = "lower" if q[k] - parameters.bounds_q[0][k] < AT_BOUND else "upper"
            notes.append(
                f"{item.name} ended at its {side} bound {getattr(item, side):g}: it has no error "
                "bar, and the others' hold only if that is its value; widen the bound or fix it"
            )
        elif estimate.ci95 is None:
            notes.append(
                f"{item.name} is not determined by these data; fix it, give it a prior, or move "
                "the body differently"
            )
        elif estimate.std_error is None:
            notes.append(
                f"{item.name} is not identifiable from these data: {estimate.reason}; fix it, "
                "give it a prior, or move the body differently"
            )
    return notes


def _residual_notes(
    noise: Noise, errors: Errors, found: Dependence, reduced: float, forced: bool
) -> list[str]:
    large = noise == "given" and reduced > SUSPICIOUS_CHI_SQUARED
    size = f"the residuals are {np.sqrt(reduced):.2g} times as large as sigma_m says"
    if found.in_time:
        pattern = f"persist from sample to sample (autocorrelation {found.lag1:.2f})"
    else:
        pattern = "have parts that markers or axes share"
    correlated = f"{size} and {pattern}" if large else f"the residuals {pattern}"
    if errors == "autocorrelated" and found.found:
        return [
            f"{correlated}: camera noise seldom does, so something is missing in the model or in "
            "the experiment's description. The error bars allow for errors of that kind, not for "
            "a bias they hide"
        ]
    if forced and found.found:
        return [f"{correlated}, but error bars for independent errors were asked for: too small"]
    if large and errors == "autocorrelated":
        return [f"{size}; the error bars follow the residuals. Check sigma_m and the model"]
    if large:
        return [
            f"{size}: the error bars are too small by about that much; check sigma_m and the "
            "model, or use noise = 'estimated'"
        ]
    return []
