"""Estimates with error bars, in the user's parameters and in the other elastic convention.

The logarithm of a positive parameter is taken as normal (or Student's t); for Poisson's ratio ln
ν/(½ − ν) = ln λ/μ is, so that intervals stay within what is physically possible. A parameter that
may be negative is taken as normal itself. A standard error is reported only where it is meaningful;
otherwise the estimate states a reason. Notes explain what error bars do not show, in sentences that
end with the remedy.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..common.array_types import Array
from ..fem.laws.constants import (
    FIELD_COEFFICIENT,
    INSTANTANEOUS,
    SHARE,
    TAU,
    constant_named,
    is_damping,
    is_limitless,
    is_modulus,
    without_region,
)
from ..model.parameters import Parameter, Parameters
from .linearised import DerivedModuli
from .residuals.autocorrelation import Dependence
from .residuals.noise_level import Noise, NoiseLevel
from .residuals.recording_scatter import RecordingComparison
from .thresholds import NOTEWORTHY

Mask = NDArray[np.bool_]

# Deviation of a logarithm beyond which the data do not determine the parameter.
UNDETERMINED = 100.0
# An interval wider than this factor, or this share of Poisson's (0, ½), identifies nothing.
WIDE_FACTOR = 10.0
# Width of an interval of Poisson's ratio beyond which it identifies nothing.
WIDE_POISSON = 0.4
# A correlation beyond this, for a deviation beyond that, leaves only a combination identified.
CONFOUNDED = 0.98
# Relative deviation that this requires in addition.
CONFOUNDED_DEVIATION = 0.1


@dataclass(frozen=True)
class Estimate:
    """One value with its statistical uncertainty."""

    value: float  # estimate, or the stated value if it was not estimated
    # Standard error due to noise and nuisance parameters. None for what was not estimated, is at a
    # bound, or is not identified by the data.
    statistical_std_error: float | None = None
    # (lower, upper) or None: 95 % interval due to noise and nuisance parameters, within what is
    # physically possible. It may exist, and be wide, where there is no `statistical_std_error`.
    statistical95: tuple[float, float] | None = None
    at_bound: bool = False  # whether the value, or one it follows from, ended at a bound
    reason: str | None = None  # why an estimated value has no `statistical_std_error`


@dataclass(frozen=True)
class IntervalCoordinate:
    """Coordinate in which an interval is symmetric."""

    is_odds: bool  # whether it is ln ν/(½ − ν), for Poisson's ratio; decides before `is_linear`
    is_linear: bool  # whether it is the value itself; if neither, it is the logarithm

    @classmethod
    def for_estimate(cls, name: str, values: Iterable[float], linear: bool) -> IntervalCoordinate:
        """Return the coordinate for an estimate.

        Parameters
        ----------
        name : str
            Name of the parameter or modulus.
        values : iterable of float
            Value and ends of its intervals, the value first; if any is not positive, the coordinate
            is linear.
        linear : bool
            Whether the parameter is its own coordinate; a positive Poisson's ratio has ln ν/(½ − ν)
            nevertheless, unless it is one half.
        """
        value, *ends = values
        lowest = min(value, *ends, np.inf)
        is_ratio = without_region(name) == "poisson"
        is_odds = is_ratio and lowest > 0 and value < 0.5
        return cls(is_odds, linear or lowest <= 0 or is_ratio)

    def derivative(self, value: float) -> float:
        """Return the derivative of the coordinate by the value, at a value within the domain."""
        if self.is_odds:
            return 0.5 / (value * (0.5 - value))
        return 1.0 if self.is_linear else 1 / value

    def from_value(self, value: float) -> float:
        """Return the coordinate of a value; ±infinity at the ends of its domain, NaN
        beyond them.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            if self.is_odds:
                return float(np.log(np.divide(value, 0.5 - value)))
            return value if self.is_linear else float(np.log(value))

    def to_value(self, x: float) -> float:
        """Return the value of a coordinate x: the inverse of `from_value`. Beyond the range of
        floats it is the end of the domain, 0 or infinity; for Poisson's ratio 0 or 0.5.
        """
        with np.errstate(over="ignore"):
            if self.is_odds:
                return float(0.5 / (1 + np.exp(-x)))
            return x if self.is_linear else float(np.exp(x))


def correlation_from_covariance(covariance: Array) -> Array:
    """Return the correlations (n, n) of a covariance (n, n), which is not modified; NaN in rows and
    columns whose variance is zero or not finite.
    """
    deviation = np.sqrt(np.diag(covariance))
    deviation[~np.isfinite(deviation) | (deviation == 0)] = np.nan
    return covariance / np.outer(deviation, deviation)


def user_estimates(
    parameters: Parameters, q: Array, covariance_q: Array, at_bound: Mask, quantiles: Array
) -> dict[str, Estimate]:
    """Return the estimates of the scalar parameters by name.

    Parameters
    ----------
    parameters : Parameters
        Shared parameters.
    q : (nq,) array
        Estimates in the solver's coordinates.
    covariance_q : (nq, nq) array
        Covariance of q.
    at_bound : (nq,) array of bool
        Whether each is at a bound.
    quantiles : (nq,) array
        Half widths of the 95 % intervals in standard deviations.

    Returns
    -------
    dict of str to Estimate
        In the order of `Parameters.scalars`. Fixed parameters have their value alone; those tied to
        another its estimate times the ratio. An estimate has an interval but no standard error if
        the interval covers the range between its bounds, spans more than `WIDE_FACTOR` (of
        Poisson's ratio `WIDE_POISSON`), or if the correlation with another parameter exceeds
        `CONFOUNDED` at a relative deviation above `CONFOUNDED_DEVIATION`.

    Notes
    -----
    Infinite or NaN variances in `covariance_q` mean that the data do not determine the parameter.
    The argument arrays are not modified.
    """
    estimates = {name: Estimate(value) for name, value in parameters.scalar_values(q).items()}
    partners = np.zeros_like(covariance_q)
    scalars = list(parameters.scalar_coordinates)
    partners[:, scalars] = np.abs(np.nan_to_num(correlation_from_covariance(covariance_q)))[
        :, scalars
    ]
    np.fill_diagonal(partners, 0.0)
    for k in scalars:
        item = parameters.free[k]
        value = item.from_coordinate(float(q[k]))
        if at_bound[k]:
            estimates[item.name] = _estimate_at_bound(value)
            continue
        deviation = float(np.sqrt(covariance_q[k, k]))
        estimate = _parameter_estimate(
            item, value, deviation=deviation, quantile=float(quantiles[k])
        )
        other = int(np.argmax(partners[k]))
        relative = deviation * item.value_derivative(value) / max(abs(value), 1e-300)
        if estimate.statistical_std_error is None or estimate.statistical95 is None:
            pass
        elif estimate.statistical95[0] <= item.lower and estimate.statistical95[1] >= item.upper:
            reason = "its 95 % interval covers the whole range between its bounds"
            estimate = Estimate(value, None, statistical95=estimate.statistical95, reason=reason)
        elif partners[k, other] > CONFOUNDED and relative > CONFOUNDED_DEVIATION:
            reason = (
                f"confounded with {parameters.free[other].name} "
                f"(correlation {correlation_from_covariance(covariance_q)[k, other]:.3f})"
            )
            estimate = Estimate(value, None, statistical95=estimate.statistical95, reason=reason)
        estimates[item.name] = estimate
    for item in parameters.scalars:
        if item.tied is not None:
            estimates[item.name] = _scaled_estimate(estimates[item.tied.to], item.tied.ratio)
    return estimates


def relative_derivatives(parameters: Parameters, q: Array) -> Array:
    """Return the derivative (nq,) of each free parameter by its q, over the parameter's absolute
    value: 1 for a logarithmic scale; for coefficients of fields the derivative itself.
    """
    values = np.array(
        [
            item.from_coordinate(float(coordinate))
            for item, coordinate in zip(parameters.free, q, strict=True)
        ]
    )
    sizes = np.ones(len(q))
    scalars = list(parameters.scalar_coordinates)
    sizes[scalars] = np.maximum(np.abs(values[scalars]), 1e-300)
    slopes = (
        item.value_derivative(value)
        for item, value in zip(parameters.free, values.tolist(), strict=True)
    )
    return np.fromiter(slopes, dtype=float, count=len(q)) / sizes


# Share of a modulus, or Poisson's ratio over ½, that is rounding.
ROUNDED = 1e-9


def derived_estimates(
    derived: DerivedModuli,
    covariance_q: Array,
    at_bound: Mask,
    quantiles: Array,
    reasons: Sequence[str | None] = (),
) -> dict[str, Estimate]:
    """Return the estimates of the moduli that follow from the parameters, by the delta method.

    Parameters
    ----------
    covariance_q : (nq, nq) array
        Covariance of q.
    at_bound : (nq,) array of bool
        Parameters at a bound; a modulus that depends on one has no interval.
    quantiles : (nq,) array
        Half widths of intervals in standard deviations.
    reasons : sequence of nq str or None, optional
        Why each parameter has no standard error; a modulus that depends on one parameter alone has
        none either.

    Notes
    -----
    A modulus that does not depend on q has its value alone; others are taken as log-normal, or as
    normal if they are not positive, with the largest quantile of the parameters that they depend
    on.
    """
    estimates = {}
    for name, value in derived.values.items():
        gradient = derived.derivatives[name]
        rounding = ROUNDED * (0.5 if without_region(name) == "poisson" else abs(value))
        used = np.flatnonzero(np.abs(gradient) > rounding)
        if abs(value) <= rounding:
            value = 0.0
        if at_bound[used].any():
            estimates[name] = _estimate_at_bound(value)
        elif not len(used):
            estimates[name] = Estimate(value)
        else:
            variance = gradient[used] @ covariance_q[np.ix_(used, used)] @ gradient[used]
            estimate = _derived_estimate(
                name, value, float(np.sqrt(variance)), quantile=float(quantiles[used].max())
            )
            reason = reasons[used[0]] if len(used) == 1 and len(reasons) else None
            if reason and estimate.statistical_std_error is not None:
                estimate = replace(estimate, statistical_std_error=None, reason=reason)
            estimates[name] = estimate
    return estimates


def _derived_estimate(name: str, value: float, deviation: float, quantile: float) -> Estimate:
    if value > 0:
        return _logarithmic_estimate(name, value, deviation=deviation / value, quantile=quantile)
    if not np.isfinite(deviation):
        return Estimate(value, reason="the data do not determine it")
    ends = (value - quantile * deviation, value + quantile * deviation)
    return Estimate(value, deviation, statistical95=ends)


def _parameter_estimate(
    item: Parameter, value: float, deviation: float, quantile: float
) -> Estimate:
    """Return the estimate of a parameter with its interval, symmetric in the parameter's
    coordinate.

    Logarithmic parameters and positive Poisson's ratios are treated by `_logarithmic_estimate`.
    Others have a symmetric interval, cut off at the least value of the constant; with a deviation
    of q above `UNDETERMINED`, or NaN, only a value and a reason.
    """
    if item.scale == "log":
        return _logarithmic_estimate(item.name, value, deviation=deviation, quantile=quantile)
    if without_region(item.name) == "poisson" and value > 0:
        return _logarithmic_estimate(
            item.name, value, deviation=deviation * item.unit / value, quantile=quantile
        )
    if not deviation <= UNDETERMINED:
        return Estimate(value, reason="the data do not determine it")
    spread = deviation * item.unit
    least = constant_named(item.name).at_least
    return Estimate(
        value,
        spread,
        statistical95=(max(least, value - quantile * spread), value + quantile * spread),
    )


def _scaled_estimate(estimate: Estimate, ratio: float) -> Estimate:
    ends = estimate.statistical95 and sorted(
        (ratio * estimate.statistical95[0], ratio * estimate.statistical95[1])
    )
    return Estimate(
        ratio * estimate.value,
        None
        if estimate.statistical_std_error is None
        else abs(ratio) * estimate.statistical_std_error,
        statistical95=None if not ends else (ends[0], ends[1]),
        at_bound=estimate.at_bound,
        reason=estimate.reason,
    )


def _estimate_at_bound(value: float) -> Estimate:
    return Estimate(
        value, at_bound=True, reason="it ended at a bound, or follows from a parameter that did"
    )


def _logarithmic_estimate(name: str, value: float, deviation: float, quantile: float) -> Estimate:
    """Return the estimate of a positive value from the standard deviation of its logarithm.

    For Poisson's ratio the interval is symmetric in ln ν/(½ − ν). An interval that is too wide
    (`WIDE_FACTOR`, `WIDE_POISSON`) remains, but there is no standard error.
    """
    if not deviation <= UNDETERMINED:  # or NaN
        return Estimate(value, reason="the data do not determine it")
    at = IntervalCoordinate.for_estimate(name, [value], linear=False)
    reach = min(quantile * deviation * value * at.derivative(value), UNDETERMINED)
    low, high = (at.to_value(at.from_value(value) + way * reach) for way in (-1, 1))
    reason = f"its 95 % interval spans more than a factor of {WIDE_FACTOR:g}"
    if at.is_odds:
        reason = "its 95 % interval covers nearly all of (0, 0.5)"
    if high - low > WIDE_POISSON if at.is_odds else high > WIDE_FACTOR * low:
        return Estimate(value, None, statistical95=(low, high), reason=reason)
    return Estimate(value, value * deviation, statistical95=(low, high))


# A relaxation time beyond so many recordings is not seen to end.
LONG = 1.0


def parameter_notes(parameters: Parameters, estimates: Mapping[str, Estimate]) -> list[str]:
    """Return notes on free parameters at a bound, not determined, or not identifiable.

    Notes on bounds and undetermined parameters come first, in the order of the parameters, then
    those of `_unidentifiable_notes`. Parameters without an entry in `estimates` are left out.
    """
    notes = []
    reasons = {}
    for item in (each for each in parameters.free if each.name in estimates):
        name = item.name
        estimate = estimates[item.name]
        if estimate.at_bound:
            nearest = min(
                ("lower", "upper"), key=lambda side: abs(getattr(item, side) - estimate.value)
            )
            notes.append(
                f"{name} ended at its {nearest} bound {getattr(item, nearest):g}: it has no "
                "error bar, and the error bars of the others include its uncertainty; widen "
                "the bound, or fix the parameter if it is known"
            )
        elif estimate.statistical95 is None and limitless_shares(parameters):
            continue  # the verdict tells it
        elif estimate.statistical95 is None:
            damping = is_damping(name)
            by = ": no information on damping in these data" if damping else " by these data"
            notes.append(
                f"{name} is not determined{by}; fix it, give it a prior, or record "
                f"{'a motion' if damping else 'another motion'}"
            )
        elif estimate.statistical_std_error is None:
            reasons[name] = str(estimate.reason)
    return [*notes, *_unidentifiable_notes(reasons)]


def limitless_shares(parameters: Parameters) -> list[str]:
    """Return the names of shares of memory that leave no long-term stiffness, see `is_limitless`."""
    return [
        item.name
        for item in parameters.scalars
        if item.is_fixed and item.guess is not None and is_limitless(item.name, item.guess)
    ]


def without_long_term_moduli(
    parameters: Parameters, estimates: Mapping[str, Estimate]
) -> dict[str, Estimate]:
    """Return estimates in which the long-term moduli of a liquid have no interval: those of the
    region of a share in `limitless_shares`. The instantaneous modulus keeps its own.
    """
    regions = {name.rpartition(".")[0].rpartition(".")[0] for name in limitless_shares(parameters)}
    return {
        name: Estimate(each.value, reason="the stress relaxes to zero")
        if name.rpartition(".")[0] in regions
        and is_modulus(name)
        and without_region(name) != INSTANTANEOUS.name
        and each.statistical95 is not None
        else each
        for name, each in estimates.items()
    }


def _unidentifiable_notes(reasons: Mapping[str, str]) -> list[str]:
    notes = []
    mentioned = set()
    for name, reason in reasons.items():
        because = reason
        other = reason.removeprefix("confounded with ").split(" ")[0]
        which = f"{name} is"
        pronoun = "it"
        if reasons.get(other, "").startswith(f"confounded with {name} "):
            which = f"{name} and {other} are"
            pronoun = "one of them"
            because = reason.replace(other, "each other", 1)
        if other not in mentioned:
            notes.append(
                f"{which} not identifiable from these data: {because}; fix {pronoun}, give it a "
                "prior, or record other deformations"
            )
        mentioned.add(name)
    return notes


def memory_notes(estimates: Mapping[str, Estimate], longest_s: float) -> list[str]:
    """Return notes on memory branches, at most one for each.

    A branch gets a note if its share ended at its bound zero, if the interval of the share contains
    zero, or if its relaxation time exceeds the longest recording.

    Parameters
    ----------
    estimates : mapping of str to Estimate
        All parameters by name, those of branches with their region and branch in front.
    longest_s : float
        Duration of the longest recording [s].
    """
    notes = []
    for name, share in estimates.items():
        if without_region(name) != SHARE.name:
            continue
        branch = name.removesuffix(f".{SHARE.name}")
        tau = estimates.get(f"{branch}.{TAU.name}")
        if share.at_bound and share.value < 1e-6:
            notes.append(
                f"no memory was found: the share of {branch} ended at 0, so that its "
                "relaxation time has no meaning; remove that branch"
            )
        elif share.statistical95 is not None and share.statistical95[0] <= 0:
            notes.append(
                f"the data do not determine whether there is memory: the share of {branch} "
                f"may be 0, and is at most {share.statistical95[1]:.2g} (95 %)"
            )
        elif (share.at_bound or share.statistical95) and tau and tau.value > LONG * longest_s:
            notes.append(
                f"{branch} relaxes within {tau.value:.2g} s, slower than the longest "
                f"recording of {longest_s:.2g} s: its share and the long-term moduli are "
                "extrapolated from the beginning of the relaxation; record for longer"
            )
    return notes


def noise_notes(requested: str, kind: Noise, level: NoiseLevel, errors: str) -> list[str]:
    """Return notes on residuals larger or smaller than the stated σ, and how the error bars account
    for that.

    Parameters
    ----------
    requested : str
        Requested source of the noise, see `ErrorModel`.
    kind : str
        Source that is used, see `ErrorBasis`.
    level : NoiseLevel
        Size of the residuals.
    errors : {"independent", "autocorrelated"}
        Correlation of the errors.

    Returns
    -------
    list of str
        Empty, or one note. Empty if the noise was requested as "estimated", if tests find that the
        residuals agree with σ, or if they differ from it by less than a factor of `NOTEWORTHY`.
    """
    if requested == "estimated" or level.suggest_noise() == "given":
        return []
    factor = float(np.sqrt(level.pooled))
    sigma_key = level.sigma_key
    low, high = (pick(level.factors, key=level.factors.__getitem__) for pick in (min, max))
    if level.is_unequal() and level.factors[high] > NOTEWORTHY**2 * level.factors[low]:
        least = f"{level.factors[low]:.2g} ({low})"
        most = f"{level.factors[high]:.2g} ({high})"
        size = f"between {least} and {most} times as large as expected from {sigma_key}"
    elif factor > NOTEWORTHY:
        size = f"{factor:.2g} times as large as expected from {sigma_key}"
    elif factor < 1 / NOTEWORTHY:
        size = (
            f"only {factor:.2g} times as large as expected from {sigma_key}, which seems "
            f"{1 / factor:.2g} "
        )
        size += "times too large"
    else:
        return []
    if kind != "given" or (factor > 1 and errors == "autocorrelated"):
        so = f"the error bars are computed from the residuals. Check {sigma_key} and the model"
    elif factor > 1:
        so = "the error bars are too small by about that much; check "
        so += f"{sigma_key} and the model, or use noise = 'auto'"
    elif requested == "given":
        so = f"the error bars are computed from {sigma_key}, as requested"
    else:
        so = f"the residuals are not independent, so the error bars are computed from {sigma_key}"
    return [f"the residuals are {size}; {so}"]


def correlation_notes(
    requested: str, errors: str, dependence: Dependence, *, unexplained: Dependence
) -> list[str]:
    """Return one note, as a list, on correlated residuals and how the error bars account for that;
    else empty.

    Empty if they are not correlated, or if their correlation is explained, so that independent
    errors were used without having been requested.

    Parameters
    ----------
    requested : {"auto", "independent", "autocorrelated"}
        Errors that the user requested.
    errors : {"independent", "autocorrelated"}
        Errors that were used.
    dependence, unexplained : Dependence
        Tests of all residuals, and of those that cannot be slow errors of instruments.
    """
    if not dependence.is_correlated() or (
        errors != "autocorrelated" and requested != "independent"
    ):
        return []
    is_slight = dependence.is_slightly_correlated_in_time()
    pattern = "are correlated between markers or axes"
    if dependence.is_correlated_in_space():
        pattern = "are correlated between neighbouring points of the surface"
    if dependence.is_correlated_in_time():
        degree = "slightly " if is_slight else ""
        pattern = (
            f"are {degree}correlated between consecutive samples "
            f"(autocorrelation {dependence.lag1:.2f})"
        )
    if errors != "autocorrelated":
        return [
            f"the residuals {pattern}, but error bars for independent errors were requested, which "
            "are too small; use errors = 'auto'"
        ]
    lacking = (
        ", unlike the noise of most sensors, so the model or the description of the experiment lacks "
        "an effect"
    )
    if is_slight and not dependence.is_correlated_in_space():
        lacking = (
            ": the model or the description of the experiment may lack a small effect, such as the "
            "mass of markers or the memory of the material"
        )
    if not unexplained.is_correlated():
        lacking = ", as errors of tracked pixels are, and are within sigma"
    return [
        f"the residuals {pattern}{lacking}. The error bars are widened by a model of autocorrelated "
        "errors, but do not cover a bias"
    ]


def disagreement_notes(parameters: Parameters, scatter: RecordingComparison | None) -> list[str]:
    """Return one note for each parameter on which the recordings disagree; empty without a
    comparison (None).
    """
    if scatter is None:
        return []
    names = [
        display_name(item.name, is_scalar=k in parameters.scalar_coordinates)
        for k, item in enumerate(parameters.free)
    ]
    return [
        f"the recordings disagree on {names[k]} (χ² "
        f"{scatter.chi_squared[k]:.3g} for {scatter.degrees_of_freedom[k]} degrees of "
        f"freedom): model errors exceed the noise, and the interval of {names[k]} includes the "
        "disagreement"
        for k in np.flatnonzero(scatter.find_disagreements()).tolist()
    ]


def display_name(name: str, *, is_scalar: bool) -> str:
    """Return the name of an estimated parameter for messages: itself, or for a component of a
    vector a phrase with the name of its kind and its own name.
    """
    return name if is_scalar else f"the {FIELD_COEFFICIENT.name} (share {name})"
