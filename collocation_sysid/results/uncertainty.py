"""Error bars of the estimated parameters, from the curvature of the fit.

With Z = dx/dq along the equations of motion and S = h Z the markers' part of it, the covariance
of q, the logarithms of the estimated parameters, is the Gauss–Newton one,

    C = (Σ Sᵀ W S + priors)⁻¹,   W = 1/σ² of the present samples.

It holds for independent normal errors of the samples. Errors that persist from sample to sample
(drift, a wrong model) make the true uncertainty larger than this.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..nlp.collocation import Collocation
from ..nlp.parameters import ENGINEERING, LAME, Parameters, Theta
from .sensitivity import marker_sensitivities, sensitivities

__all__ = [
    "Estimate",
    "Noise",
    "Uncertainty",
    "covariance",
    "marker_sensitivities",
    "sensitivities",
]

Array = NDArray[np.float64]
Noise = Literal["given", "estimated"]

CI95 = 1.959963984540054
# A parameter this near a bound, in its logarithm, is at it: interior-point methods stay inside.
AT_BOUND = 1e-3
# Deviation of a logarithm beyond which the data do not determine the parameter.
UNDETERMINED = 100.0
# Eigenvalue of the information, in units of its diagonal, that is zero up to rounding; and the
# share in such a direction that does not matter.
SINGULAR = 1e-12
NEGLIGIBLE = 1e-3
# Residuals this many times the given sigma, squared, are worth a warning.
SUSPICIOUS_CHI_SQUARED = 2.0


@dataclass(frozen=True)
class Estimate:
    """One value with its error bar.

    Attributes
    ----------
    value : float
    std_error : float or None
        None for what was not estimated, is at a bound, or is not determined by the data.
    ci95 : (lower, upper) or None
        95 % confidence interval; within what is physically possible.
    at_bound : bool
        The value, or one it follows from, ended at a bound.
    """

    value: float
    std_error: float | None = None
    ci95: tuple[float, float] | None = None
    at_bound: bool = False


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """What the data say, and do not say, about the parameters.

    Attributes
    ----------
    names : (nq,) estimated parameters, in the order of q
    covariance : (nq, nq) of q
        NaN in rows and columns of parameters at a bound, the others' is as if those were fixed;
        infinite variance where the data do not determine a parameter.
    correlation : (nq, nq) NaN likewise
    estimates : by name, all four parameters of the user
    derived : by name, the elastic pair of the other convention
    noise : {"given", "estimated"}
    chi_squared : float
        Σ ((ŷ − h(x)) / σ)² of the markers, with the σ given.
    degrees_of_freedom : int
        Measurements less parameters.
    notes : sequence of str
        What the user should know.
    """

    names: tuple[str, ...]
    covariance: Array
    correlation: Array
    estimates: Mapping[str, Estimate]
    derived: Mapping[str, Estimate]
    noise: Noise
    chi_squared: float
    degrees_of_freedom: int
    notes: tuple[str, ...]

    @property
    def reduced_chi_squared(self) -> float:
        """χ² per degree of freedom: one when the residuals are as large as σ."""
        return self.chi_squared / max(1, self.degrees_of_freedom)


def covariance(
    collocation: Collocation,
    z: Array,
    marker_z: Sequence[Array] | None = None,
    noise: Noise = "given",
) -> Uncertainty:
    """Uncertainty of the parameters at a solution.

    Parameters
    ----------
    collocation : Collocation
    z : (variables,) a point that satisfies the equations of motion, the optimum
    marker_z : sequence of (T, 3M, nq), optional
        `marker_sensitivities`, where they are known already.
    noise : {"given", "estimated"}
        Trust the markers' σ, or scale it by the residuals: σ² χ² / (N − nq). Estimate it when σ
        is not known; only the ratios between markers matter then.

    Raises
    ------
    InputError
        If the noise is to be estimated from fewer measurements than parameters.
    SimulationError
        Where the equations of motion are singular.
    """
    if noise not in get_args(Noise):
        raise InputError(f"noise is {noise!r}; expected one of {', '.join(get_args(Noise))}")
    parameters = collocation.parameters
    q, positions = collocation.unpack(z)
    bounded = _at_bound(parameters, q)
    if marker_z is None:
        marker_z = marker_sensitivities(collocation, z)
    segments = collocation.segments
    chi_squared = sum(s.observation.loss(x) for s, x in zip(segments, positions, strict=True))
    estimated = int((~bounded).sum())
    freedom = collocation.measurements - estimated
    if noise == "estimated" and freedom < 1:
        raise InputError(
            f"the noise cannot be estimated from {collocation.measurements} measurements of "
            f"{estimated} parameters; give sigma_m and use noise = 'given'"
        )
    scale = chi_squared / freedom if noise == "estimated" else 1.0
    _, slopes = parameters.prior(q)
    # (I / s² + P)⁻¹ = s² (I + s² P)⁻¹ also holds for noise estimated as zero.
    information = _information(collocation, marker_z) + scale * np.diag(slopes**2)
    of_q = np.full_like(information, np.nan)
    free = np.ix_(~bounded, ~bounded)
    of_q[free] = _inverse(information[free], scale)
    return Uncertainty(
        names=tuple(item.name for item in parameters.free),
        covariance=of_q,
        correlation=_correlation(of_q),
        estimates=_estimates(parameters, q, of_q, bounded),
        derived=_derived(parameters, q, of_q, bounded),
        noise=noise,
        chi_squared=float(chi_squared),
        degrees_of_freedom=freedom,
        notes=tuple(_notes(parameters, q, of_q, bounded, noise, chi_squared / max(1, freedom))),
    )


def _at_bound(parameters: Parameters, q: Array) -> NDArray[np.bool_]:
    lower, upper = parameters.bounds_q
    return (q - lower < AT_BOUND) | (upper - q < AT_BOUND)


def _information(collocation: Collocation, marker_z: Sequence[Array]) -> Array:
    """Σ Sᵀ W S over the present samples of all experiments."""
    nq = collocation.nq
    total = np.zeros((nq, nq))
    for segment, by_q in zip(collocation.segments, marker_z, strict=True):
        weights = segment.observation.weights
        rows = (by_q * weights[..., None]).reshape(weights.size, nq)
        total += rows.T @ rows
    return total


def _inverse(information: Array, scale: float) -> Array:
    """`scale` times the inverse; infinite variance for what is not determined."""
    if not len(information):
        return information
    units = np.sqrt(np.diag(information))
    units[units == 0] = 1.0
    values, vectors = np.linalg.eigh(information / np.outer(units, units))
    known = values > SINGULAR
    scaled = vectors[:, known] / units[:, None]
    inverse = scale * (scaled / values[known]) @ scaled.T
    lost = (np.abs(vectors[:, ~known]) > NEGLIGIBLE).any(axis=1)
    lost |= np.diag(inverse) > UNDETERMINED**2
    inverse[lost] = inverse[:, lost] = np.nan
    inverse[lost, lost] = np.inf
    return inverse


def _correlation(of_q: Array) -> Array:
    deviation = np.sqrt(np.diag(of_q))
    deviation[~np.isfinite(deviation) | (deviation == 0)] = np.nan
    return of_q / np.outer(deviation, deviation)


def _estimates(
    parameters: Parameters, q: Array, of_q: Array, bounded: NDArray[np.bool_]
) -> dict[str, Estimate]:
    found = {name: Estimate(value) for name, value in parameters.values(q).items()}
    for k, item in enumerate(parameters.free):
        value, relative = float(np.exp(q[k])), float(np.sqrt(of_q[k, k]))
        found[item.name] = _estimate(value, value * relative, relative, bool(bounded[k]))
    return found


def _estimate(value: float, std: float, relative: float, at_bound: bool) -> Estimate:
    """An estimate whose logarithm is normal with deviation `relative`."""
    if not relative <= UNDETERMINED:  # or NaN
        return Estimate(value, at_bound=at_bound)
    spread = float(np.exp(CI95 * relative))
    return Estimate(value, std, (value / spread, value * spread), at_bound)


def _derived(
    parameters: Parameters, q: Array, of_q: Array, bounded: NDArray[np.bool_]
) -> dict[str, Estimate]:
    """(E, ν) if the user works with (λ, μ) and the other way round, by the delta method."""
    theta = parameters.theta(q)
    theta_q, _ = parameters.theta_derivatives(q)
    if parameters.names[:2] == LAME:
        names, gradients = ENGINEERING, _engineering_by_lame(theta) @ theta_q[:2]
    else:
        names, gradients = LAME, theta_q[:2]
    found = {}
    for name, gradient in zip(names, gradients, strict=True):
        value = float(getattr(theta, name))
        used = np.flatnonzero(gradient)
        at_bound = bool(bounded[used].any())
        std = float(np.sqrt(gradient[used] @ of_q[np.ix_(used, used)] @ gradient[used]))
        if not len(used) or at_bound or not np.isfinite(std) or not value > 0:
            found[name] = Estimate(value, at_bound=at_bound)
        elif name == "poisson":
            # ln ν/(½ − ν) = ln λ/μ is taken as normal: the interval stays within (0, ½).
            ratio = _estimate(value / (0.5 - value), 0.0, std / (value * (1 - 2 * value)), False)
            if ratio.ci95 is None:
                found[name] = Estimate(value)
            else:
                low, high = (0.5 * r / (1 + r) for r in ratio.ci95)
                found[name] = Estimate(value, std, (low, high))
        else:
            found[name] = _estimate(value, std, std / value, False)
    return found


def _engineering_by_lame(theta: Theta) -> Array:
    """∂(E, ν)/∂(λ, μ)."""
    first, second = theta.lambda_pa, theta.mu_pa
    young = (second**2, 3 * first**2 + 4 * first * second + 2 * second**2)
    poisson = (second / 2, -first / 2)
    return np.array([young, poisson]) / (first + second) ** 2


def _notes(
    parameters: Parameters,
    q: Array,
    of_q: Array,
    bounded: NDArray[np.bool_],
    noise: Noise,
    reduced: float,
) -> list[str]:
    notes = []
    for k, item in enumerate(parameters.free):
        if bounded[k]:
            side = "lower" if q[k] - parameters.bounds_q[0][k] < AT_BOUND else "upper"
            notes.append(
                f"{item.name} ended at its {side} bound {getattr(item, side):g}: it has no error "
                "bar, and the others' hold only if that is its value; widen the bound or fix it"
            )
        elif not np.isfinite(of_q[k, k]):
            notes.append(
                f"{item.name} is not determined by these data; fix it, give it a prior, or move "
                "the body differently"
            )
    if noise == "given" and reduced > SUSPICIOUS_CHI_SQUARED:
        notes.append(
            f"the residuals are {np.sqrt(reduced):.2g} times as large as sigma_m says: the error "
            "bars are too small by about that much; check sigma_m and the model, or use "
            "noise = 'estimated'"
        )
    return notes
