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
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..errors import InputError
from ..fem.constants import constant_named, is_damping
from ..nlp.collocation import Collocation
from ..nlp.lapack import one_blas_thread
from ..nlp.parameters import Parameters
from .autocorrelation import Dependence, dependence, error_processes, score_covariance
from .distributions import student_ppf
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
from .memory_notes import memory_notes
from .noise import Extra, Noise, NoiseLevel, drawn, noise_level, projected
from .outliers import Outlier, set_apart
from .pose_noise import pose_noise_draws
from .scatter import Scatter, recordings_of, scatter_of, single_fits
from .sensitivity import marker_sensitivities, sensitivities

__all__ = [
    "Errors",
    "Estimate",
    "Noise",
    "NoiseOption",
    "Uncertainty",
    "covariance",
    "marker_sensitivities",
    "sensitivities",
    "uncertainty_of",
]

NoiseOption = Literal["auto", "given", "estimated"]
Errors = Literal["independent", "autocorrelated"]
ErrorsOption = Literal["auto", "independent", "autocorrelated"]

# A damping that ended at its bound is not told at all if it may be this many times the usual.
UNINFORMED = 100.0
# Residuals this many times sigma, or one over it, are worth a word.
NOTEWORTHY = 1.1
# With σ given, correlation that widens no error bar by this factor is of no consequence.
CONSEQUENCE = 1.05
# Simulations of the residuals that tell how dependent they may be by chance.
REPLICAS = 39


@dataclass(frozen=True, eq=False)
class Uncertainty:
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
    estimates : by name, all parameters of the user
    derived : by name, the moduli of the other convention
    nuisance : by name, standard deviation of each parameter of a single experiment
        In the unit it is estimated in, that is deviations of its prior; NaN at a bound.
    nuisance_covariance : (k, k) of these, in their order
    noise : {"given", "estimated", "by-marker"}
    errors : {"independent", "autocorrelated"}
        What the error bars are based on.
    level : NoiseLevel
        How large the residuals of each marker are.
    dependence : Dependence
        The test of the residuals.
    chi_squared : float
        Σ ((ŷ − h(x)) / σ)² of the markers, with the σ given.
    degrees_of_freedom : float
        Measurements less parameters; one that a prior determines counts in part.
    notes : tuple of str
        What the user should know.
    scatter : Scatter or None
        What the recordings say one by one, where there are several.
    outliers : tuple of Outlier
        Samples that spoil what the residuals tell; `dependence` leaves them out.
    """

    names: tuple[str, ...]
    covariance: Array
    correlation: Array
    quantiles: Array
    estimates: Mapping[str, Estimate]
    derived: Mapping[str, Estimate]
    nuisance: Mapping[str, float]
    nuisance_covariance: Array
    noise: Noise
    errors: Errors
    level: NoiseLevel
    dependence: Dependence
    chi_squared: float
    degrees_of_freedom: float
    notes: tuple[str, ...]
    scatter: Scatter | None = None
    outliers: tuple[Outlier, ...] = ()

    @property
    def reduced_chi_squared(self) -> float:
        """χ² per degree of freedom: one when the residuals are as large as σ."""
        return self.chi_squared / max(1.0, self.degrees_of_freedom)


def covariance(
    collocation: Collocation,
    z: Array,
    noise: NoiseOption = "auto",
    errors: ErrorsOption = "auto",
) -> Uncertainty:
    """Uncertainty of the parameters at a solution.

    Parameters
    ----------
    collocation : Collocation
    z : (variables,) a point that satisfies the equations of motion, the optimum
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
    fit = linearised_fit(collocation, z)
    q, (extra, _) = z[: collocation.nq], pose_noise_draws(collocation, z)
    return uncertainty_of(fit, collocation.parameters, q, noise, errors, extra)


@one_blas_thread()
def uncertainty_of(
    fit: LinearisedFit,
    parameters: Parameters,
    q: Array,
    noise: NoiseOption = "auto",
    errors: ErrorsOption = "auto",
    extra: Extra | None = None,
) -> Uncertainty:
    """Uncertainty of the parameters from the fit near its answer.

    Parameters
    ----------
    fit : LinearisedFit
    parameters : Parameters
    q : (nq,) the estimated parameters in the solver's coordinates at the answer
    noise : {"auto", "given", "estimated"}
        "given" trusts the markers' σ, "estimated" scales it by the residuals: then only the ratios
        between markers matter. "auto" tests the residuals: it scales σ where they are larger or
        clearly smaller, for each marker by itself where markers differ.
    errors : {"auto", "independent", "autocorrelated"}
        What to assume of the errors; "auto" tests the residuals. The size of correlated errors
        always follows from the residuals, but with σ given it is at least that. Correlated
        residuals smaller than σ do not lower it: they may be small only where they were fitted.
    extra : sequence of (K, T, M, 3), optional
        Samples of what the residuals have besides their noise, in units of σ, by experiment.

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
            f"{len(fit.names)} parameters; give sigma_m and use noise = 'given'"
        )
    level = noise_level(fit, factored, extra)
    rest, outliers = set_apart(fit)
    found, dependent = _dependence(rest, extra)
    correlated = errors == "autocorrelated" or (errors == "auto" and dependent)
    kind = _kind(noise, level, correlated)
    of_all, quantiles = _independent(fit, factored, kind, level)
    used: Errors = "independent"
    if correlated:
        persistent = _autocorrelated(fit, factored, kind, level)
        if errors == "autocorrelated" or kind != "given" or _widens(fit, persistent, of_all):
            (of_all, quantiles), used = persistent, "autocorrelated"
    shared = fit.shared
    silent = _no_information(parameters, q, np.diag(of_all)[:shared])
    at_bound = fit.at_bound.copy()
    at_bound[:shared] &= ~silent
    of_all[at_bound] = of_all[:, at_bound] = np.nan
    of_q, bounded = of_all[:shared, :shared], at_bound[:shared]
    lost = np.flatnonzero((np.diag(of_q) > UNDETERMINED**2) | (silent & fit.at_bound[:shared]))
    of_q[lost] = of_q[:, lost] = np.nan
    of_q[lost, lost] = np.inf
    scatter = _scatter(fit, parameters, q, noise, errors, extra)
    if scatter is not None:
        with np.errstate(invalid="ignore"):
            factors = np.sqrt(scatter.widened(np.diag(of_q)) / np.diag(of_q))
        factors = np.where(scatter.disagreeing, factors, 1.0)
        of_q *= np.outer(factors, factors)
        of_few = student_ppf(0.975, np.maximum(scatter.freedom, 1))
        quantiles = np.where(scatter.disagreeing, np.maximum(quantiles, of_few), quantiles)
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
        nuisance_covariance=of_all[shared:, shared:],
        noise=kind,
        errors=used,
        level=level,
        dependence=found,
        chi_squared=fit.chi_squared,
        degrees_of_freedom=freedom,
        notes=(
            *_parameter_notes(parameters, q, bounded, estimates),
            *memory_notes(estimates, max((float(np.ptp(b.t_s)) for b in fit.blocks), default=0.0)),
            *_size_notes(noise, kind, level, used),
            *_correlation_notes(used, found, forced=errors == "independent"),
            *_scatter_notes(fit, scatter),
        ),
        scatter=scatter,
        outliers=outliers,
    )


def _scatter(
    fit: LinearisedFit,
    parameters: Parameters,
    q: Array,
    noise: NoiseOption,
    errors: ErrorsOption,
    extra: Extra | None,
) -> Scatter | None:
    """What recordings say one by one, with error bars of their own."""
    if len(recordings_of(fit)) < 2:
        return None
    names, steps, variances = [], [], []
    sizes = relative_slopes(parameters, q)
    for blocks, alone, step in single_fits(fit):
        if alone.measurements <= len(alone.names):
            continue
        own = None if extra is None else [extra[k] for k in blocks]
        found = uncertainty_of(alone, parameters, q, noise, errors, own)
        names.append(alone.blocks[0].name)
        steps.append(step)
        variances.append(np.diag(found.covariance) / sizes**2)
    return scatter_of(names, steps, variances) if len(names) > 1 else None


def _no_information(parameters: Parameters, q: Array, variances: Array) -> NDArray[np.bool_]:
    """(nq,) dampings of which even a hundred times the usual would not show."""
    found = []
    for item, at, variance in zip(parameters.free, q, variances, strict=True):
        usual = constant_named(item.name).usual or 0.0
        deviation = np.sqrt(variance) * item.per_value(item.value(float(at)))
        found.append(is_damping(item.name) and not deviation <= UNINFORMED * usual)
    return np.array(found, dtype=bool)


def _check(noise: str, errors: str) -> None:
    for name, value, known in (
        ("noise", noise, get_args(NoiseOption)),
        ("errors", errors, get_args(ErrorsOption)),
    ):
        if value not in known:
            raise InputError(f"{name} is {value!r}; expected one of {', '.join(known)}")


def _kind(noise: NoiseOption, level: NoiseLevel, correlated: bool) -> Noise:
    """What the size of the errors is taken from."""
    if noise != "auto":
        return noise
    return "given" if correlated and level.pooled < 1 else level.kind


def _independent(
    fit: LinearisedFit, factored: Information, kind: Noise, level: NoiseLevel
) -> tuple[Array, Array]:
    """Covariance of all parameters, and the quantiles of the shared ones."""
    of_score, freedom = level.score_covariance(kind, factored, fit.shared)
    return factored.fit.covariance(of_score), student_ppf(0.975, freedom)


def _dependence(fit: LinearisedFit, extra: Extra | None) -> tuple[Dependence, bool]:
    """How the residuals hang together, and whether more than what is known to add to the noise."""
    factored = information(fit)
    level, found = noise_level(fit, factored, extra), dependence(fit, factored)
    found = replace(found, lag1_deviation=found.lag1_deviation * level.unevenness)
    return found, found.found and not _expected(fit, factored, level, found, extra)


def _expected(
    fit: LinearisedFit,
    factored: Information,
    level: NoiseLevel,
    found: Dependence,
    extra: Extra | None,
) -> bool:
    """Whether what is known to add to the noise makes residuals as dependent as they are."""
    if extra is None or all(each is None for each in extra):
        return False
    added = drawn(fit, extra)
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
    return factored.fit.covariance(of_score), student_ppf(0.975, freedom)


def _widens(fit: LinearisedFit, correlated: tuple[Array, Array], independent: Array) -> bool:
    before, after = (np.diag(each)[: fit.shared] for each in (independent, correlated[0]))
    return bool((after > CONSEQUENCE**2 * before).any())


def _scatter_notes(fit: LinearisedFit, scatter: Scatter | None) -> list[str]:
    if scatter is None:
        return []
    return [
        f"the recordings disagree on {fit.names[k]} (χ² {scatter.chi_squared[k]:.3g} for "
        f"{scatter.freedom[k]} degrees of freedom): model error decides, and its interval holds "
        "what they disagree by"
        for k in np.flatnonzero(scatter.disagreeing).tolist()
    ]


def _parameter_notes(
    parameters: Parameters,
    q: Array,
    bounded: NDArray[np.bool_],
    estimates: Mapping[str, Estimate],
) -> list[str]:
    notes, reasons = [], {}
    for k, item in enumerate(parameters.free):
        estimate = estimates[item.name]
        if bounded[k]:
            side = "lower" if q[k] - parameters.bounds_q[0][k] < AT_BOUND else "upper"
            notes.append(
                f"{item.name} ended at its {side} bound {getattr(item, side):g}: it has no error "
                "bar, and the others' allow for other values of it; widen the bound, or fix it "
                "if it is known"
            )
        elif estimate.ci95 is None and is_damping(item.name):
            notes.append(
                f"{item.name} is not determined: no information on damping in these data; fix it, "
                "give it a prior, or move the body"
            )
        elif estimate.ci95 is None:
            notes.append(
                f"{item.name} is not determined by these data; fix it, give it a prior, or move "
                "the body differently"
            )
        elif estimate.std_error is None:
            reasons[item.name] = str(estimate.reason)
    return [*notes, *_unidentifiable(reasons)]


def _unidentifiable(reasons: Mapping[str, str]) -> list[str]:
    """One sentence a parameter, and one for two that are confounded with each other."""
    notes, told = [], set()
    for name, reason in reasons.items():
        because, other = reason, reason.removeprefix("confounded with ").split(" ")[0]
        which, pronoun = f"{name} is", "it"
        if reasons.get(other, "").startswith(f"confounded with {name} "):
            which, pronoun = f"{name} and {other} are", "one of them"
            because = reason.replace(other, "each other", 1)
        if other not in told:
            notes.append(
                f"{which} not identifiable from these data: {because}; fix {pronoun}, give it a "
                "prior, or move the body differently"
            )
        told.add(name)
    return notes


def _size_notes(noise: NoiseOption, kind: Noise, level: NoiseLevel, errors: Errors) -> list[str]:
    """On residuals larger or smaller than σ as stated."""
    if noise == "estimated" or level.kind == "given":
        return []
    factor = float(np.sqrt(level.pooled))
    low, high = (pick(level.factors, key=level.factors.__getitem__) for pick in (min, max))
    ratio = level.factors[high] / level.factors[low]
    if level.unequal and ratio > NOTEWORTHY**2:
        size = (
            f"the residuals are between {level.factors[low]:.2g} ({low}) and "
            f"{level.factors[high]:.2g} ({high}) times as large as {level.stated} says"
        )
    elif factor > NOTEWORTHY:
        size = f"the residuals are {factor:.2g} times as large as {level.stated} says"
    elif factor < 1 / NOTEWORTHY:
        size = (
            f"the residuals are only {factor:.2g} times as large as {level.stated} says: it seems "
            f"{1 / factor:.2g} times too large"
        )
    else:
        return []
    return [f"{size}; {_consequence(noise, kind, factor, errors, level.stated)}"]


def _consequence(
    noise: NoiseOption, kind: Noise, factor: float, errors: Errors, stated: str
) -> str:
    if kind != "given" or (factor > 1 and errors == "autocorrelated"):
        return f"the error bars follow the residuals. Check {stated} and the model"
    if factor > 1:
        return (
            f"the error bars are too small by about that much; check {stated} and the model, or "
            "use noise = 'auto'"
        )
    if noise == "given":
        return f"the error bars keep to {stated}, as asked for"
    return f"the residuals are not independent, so the error bars keep to {stated}"


def _correlation_notes(errors: Errors, found: Dependence, forced: bool) -> list[str]:
    """On residuals that hang together."""
    if found.in_time:
        pattern = f"persist from sample to sample (autocorrelation {found.lag1:.2f})"
    else:
        pattern = "have parts that markers or axes share"
    if errors == "autocorrelated" and found.found:
        return [
            f"the residuals {pattern}: noise seldom does, so something is missing in the "
            "model or in the experiment's description. The error bars are widened by a model of "
            "autocorrelated errors; a bias is not covered"
        ]
    if forced and found.found:
        return [
            f"the residuals {pattern}, but error bars for independent errors were asked for: too "
            "small"
        ]
    return []
