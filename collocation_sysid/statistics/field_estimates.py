"""Spatially varying constants: value and interval in every element, and evidence for other priors.

"The logarithm" below is that of the constant or, for a density, the density over the stated one.

With the posterior covariance C of the mode coefficients a and of all other estimates, the logarithm
in an element has the variance gᵀC g + d², where g are the element's modes and the derivatives of
the mean, and d is the standard deviation due to finer modes that are left out. The prior of the
coefficients is N(0, I), so the data alone have the information H = C_a⁻¹ − I about them. With a
prior N(0, D), for another length or amplitude, the data would be more likely, to first order, by

    ln Z(D) − ln Z(I),   ln Z(D) = −½ ln |I + H D| + ½ bᵀ D (I + H D)⁻¹ b,   b = C_a⁻¹ a

(Laplace's approximation, with all other estimates fixed).

The variance is that of fields of the prior. Edges are no such fields: an estimate is a mean of the
true field with the weights R = S (I − C_a) Sᵀ (averaging kernel; Backus and Gilbert 1968) of the
modes S in the elements, and near an edge the true value is that of one of its sides. The intervals
therefore also contain the variance of the estimated field under the positive weights of each
element, which vanishes for a homogeneous body.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..common.array_types import Array, Index
from ..fem.body import Body
from ..fem.laws.moduli import engineering_constants
from ..fem.spatial_field import ALL_MODULI, FieldModes
from ..model.generated_functions import GeneratedFunction
from ..model.parameters import NOTHING, Parameters, ThetaMap
from ..program.collocation import Collocation
from .concerns import Concern
from .estimates import relative_derivatives
from .linearised import factorise_information, linearise_fit
from .uncertainty import Uncertainty

# The data determine an element if its interval is less than this share of the prior's.
LEAST_DETERMINED_SHARE = 0.5
# Log-evidence from which on another amplitude or length is reported.
LIKELIER = 3.0
# Variance over that of the prior above which error bars contain model error, and no evidence is
# computed.
WIDER = 1.1
# Largest number of elements, evenly taken, of which an averaging kernel consists.
KERNEL_ELEMENTS = 1000
# Factors of the amplitude that are tried.
AMPLITUDES = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)


@dataclass(frozen=True, eq=False)
class FieldEstimate:
    """Estimate of a spatially varying constant."""

    name: str  # name of the constant, with its region in front
    modes: FieldModes
    cells: Index  # (k,): indices of the elements
    value: Array  # (k,): constant in each element
    # (k,): standard deviation of its logarithm (of a density: over the stated one); NaN without
    # error bars.
    deviation: Array
    quantile: float  # half width of the 95 % intervals in standard deviations
    coefficients: Array  # (m,): mode coefficients a
    # (f, f): covariance of those that are estimated; fixed and tied ones are left out.
    covariance: Array
    # Stated density that the deviation refers to [kg/m³]; None for other constants.
    declared_density_kg_m3: float | None = None
    # (k,) or None: standard deviation of the estimated field under the averaging kernel of each
    # element, in the unit of `deviation`; None where it is zero.
    smoothing: Array | None = None

    @property
    def statistical95(self) -> tuple[Array, Array]:
        """Lower and upper ends (k,) of the 95 % intervals: symmetric about the value for a density,
        else symmetric in the logarithm. NaN without error bars. They contain `smoothing`.
        """
        smoothing = 0.0 if self.smoothing is None else self.smoothing
        deviation = np.hypot(self.deviation, smoothing)
        if self.declared_density_kg_m3 is not None:
            half_width = self.quantile * deviation * self.declared_density_kg_m3
            return self.value - half_width, self.value + half_width
        factor = np.exp(self.quantile * deviation)
        return self.value / factor, self.value * factor

    @property
    def deviation_over_prior(self) -> Array:
        """Standard deviation (k,) of the logarithm over that of the prior about the mean. NaN
        without error bars.
        """
        return self.deviation / self.modes.field.deviation

    @property
    def is_informed(self) -> NDArray[np.bool_]:
        """Mask (k,) of the elements whose standard deviation is less than `LEAST_DETERMINED_SHARE`
        of the prior's; false without error bars.
        """
        return self.deviation_over_prior < LEAST_DETERMINED_SHARE

    @property
    def identified_mode_count(self) -> int:
        """Number of independent modes whose variance the data at least halve, compared
        with the prior.

        It counts the eigenvalues of `covariance`, of which the prior is the identity, below
        `LEAST_DETERMINED_SHARE`; entries that are NaN count as 1. The number means nothing if the
        covariance is not finite.
        """
        known = np.linalg.eigvalsh(np.nan_to_num(self.covariance, nan=1.0))
        return int((known < LEAST_DETERMINED_SHARE).sum())

    def stack_by_element(self) -> Array:
        """Return the table (k, 4): value, ends of its interval, and its standard deviation over
        that of the prior.
        """
        return np.column_stack([self.value, *self.statistical95, self.deviation_over_prior])

    @cached_property
    def _data_information(self) -> tuple[Array, Array]:
        """H (m, m) and score b (m,) of the data alone, eigenvalues at most 1."""
        values, vectors = np.linalg.eigh((self.covariance + self.covariance.T) / 2)
        # Rounding, or error bars that are wider than the fit's: no less than nothing.
        values = np.clip(values, 1e-12, 1.0)
        alone = vectors * (1 / values - 1) @ vectors.T
        return alone, vectors @ ((vectors.T @ self.coefficients) / values)

    @cached_property
    def _is_wider_than_prior(self) -> bool:
        """Whether misfit widens the covariance beyond the prior: no valid evidence."""
        known = self.covariance
        return not np.isfinite(known).all() or np.linalg.eigvalsh(known)[-1] > WIDER

    def log_evidence_ratio(self, length_m: float | None = None, factor: float = 1.0) -> float:
        """Return ln Z(D) − ln Z(I) for another correlation length [m], or for the amplitude times a
        factor.

        0 where error bars exceed the prior, and where a coefficient is fixed.

        Parameters
        ----------
        length_m : float, optional
            Correlation length; None means the present one.
        factor : float
            Factor of the amplitude.

        Notes
        -----
        Positive values favour the other prior. A length equal to the present one counts as None.
        """
        size = len(self.coefficients)
        if len(self.covariance) < size or self._is_wider_than_prior:
            return 0.0
        prior = factor**2 * np.eye(size)
        if length_m is not None and length_m != self.modes.length_m:
            other = np.linalg.lstsq(
                self.modes.shapes, self.modes.with_length(length_m).shapes, rcond=None
            )
            prior = factor**2 * other[0] @ other[0].T
        return self._log_evidence(prior) - self._log_evidence(np.eye(size))

    def _log_evidence(self, prior: Array) -> float:
        """Return ln Z(D) for a prior covariance D (m, m), up to a constant."""
        alone, score = self._data_information
        both = np.eye(len(alone)) + alone @ prior
        return float(score @ prior @ np.linalg.solve(both, score) - np.linalg.slogdet(both)[1]) / 2

    def list_concerns(self) -> list[Concern]:
        """Return the concerns about the field: values of zero or less in some elements
        ("doubtful"), at which evidence means nothing; or an amplitude or a length that the data
        contradict.

        The amplitude is reported if the best of `AMPLITUDES` is larger than the stated one and its
        log-evidence ratio exceeds `LIKELIER`, the length if that of half the length does.
        """
        amplitude = self.modes.field.deviation
        if below := int((self.value <= 0).sum()):
            counts = {"name": self.name, "below": below, "elements": len(self.value)}
            least = {"least": float(self.value.min()), "stated": amplitude}
            return [Concern("field/negative", "doubtful", data=counts | least)]
        contradicted = dict[str, dict[str, float]]()
        best = max(AMPLITUDES, key=lambda factor: self.log_evidence_ratio(factor=factor))
        if best > 1 and self.log_evidence_ratio(factor=best) > LIKELIER:
            contradicted["amplitude"] = {"stated": amplitude, "likely": best * amplitude}
        if self.log_evidence_ratio(self.modes.length_m / 2) > LIKELIER:
            contradicted["length"] = {
                "stated": self.modes.length_m,
                "likely": self.modes.length_m / 2,
            }
        return [
            Concern(f"field/{what}", data={"name": self.name, **v})
            for what, v in contradicted.items()
        ]


def field_estimates(
    body: Body, parameters: Parameters, q: Array, uncertainty: Uncertainty | Array | None
) -> list[FieldEstimate]:
    """Return the estimates of all fields of a body, one for each part with a field, in the order of
    the parts; empty if there is none.

    Parameters
    ----------
    q : (nq,) array
        Estimates in the solver's coordinates.
    uncertainty : Uncertainty, (nq, nq) array or None
        Error bars, or covariance of q, with a quantile of 1.96; None gives NaN as deviations and
        quantile.

    Notes
    -----
    Parameters with a variance of NaN, such as those at a bound, count as known. The deviation
    contains that of the modes that are left out.
    """
    size = len(q)
    names = [item.name for item in parameters.free]
    covariance = np.full((size, size), np.nan)
    quantile = np.nan
    if isinstance(uncertainty, Uncertainty):
        sizes = relative_derivatives(parameters, q)
        covariance = uncertainty.covariance / np.outer(sizes, sizes)
        quantile = float(np.nanmax(uncertainty.quantiles, initial=0.0))
    elif uncertainty is not None:
        covariance = uncertainty
        quantile = 1.96
    estimates = []
    constants = ThetaMap(parameters, body)
    theta = constants.theta(q)
    by_q = constants.jacobian(q)
    for number, part in enumerate(body.parts):
        if (modes := part.field) is None:
            continue
        coefficients = body.field_slices[number]
        mean, slopes = _mean_logarithm(constants, number, modes=modes).evaluate_with_jacobian(
            q, NOTHING
        )
        local = mean[0] + modes.logarithms(theta[coefficients])
        declared = None
        if part.stress_field is None:
            declared = part.density_kg_m3
        gradient = slopes + modes.shapes @ by_q[coefficients]
        # What is at a bound has no variance: it is taken for known.
        used = np.flatnonzero(gradient.any(axis=0) & ~np.isnan(np.diag(covariance)))
        own = gradient[:, used]
        variance = np.einsum("ei,ij,ej->e", own, covariance[np.ix_(used, used)], own)
        deviation = np.sqrt(variance + modes.omitted_deviation**2)
        free = [names.index(name) for name in [*body.constants][coefficients] if name in names]
        values = np.exp(local) if declared is None else declared * local
        estimate = FieldEstimate(
            name=part.field_name,
            modes=modes,
            cells=part.cells,
            value=values,
            deviation=deviation if uncertainty is not None else np.full_like(deviation, np.nan),
            quantile=quantile,
            coefficients=theta[coefficients],
            covariance=covariance[np.ix_(free, free)],
            declared_density_kg_m3=declared,
        )
        if uncertainty is not None and len(free) == len(modes.shapes.T):
            estimate = replace(estimate, smoothing=_smoothing(estimate))
        estimates.append(estimate)
    return estimates


def _smoothing(estimate: FieldEstimate) -> Array:
    """Return the standard deviation (k,) of the estimated field under the positive weights of the
    averaging kernel of each element.
    """
    shapes = estimate.modes.shapes
    known = np.eye(shapes.shape[1]) - np.nan_to_num(estimate.covariance, nan=1.0)
    others = shapes[:: 1 + len(shapes) // KERNEL_ELEMENTS]
    weights = np.maximum(shapes @ known @ others.T, 0.0)
    weights /= np.maximum(weights.sum(axis=1, keepdims=True), 1e-300)
    field = others @ estimate.coefficients
    mean = weights @ field
    return np.sqrt(np.maximum(weights @ field**2 - mean**2, 0.0))


def field_estimates_at(collocation: Collocation, z: Array) -> dict[str, FieldEstimate]:
    """Return the field estimates of all bodies at a solution by name, with the covariance for
    independent errors of the stated σ.

    Of several bodies with a field of the same name, the first counts.

    Parameters
    ----------
    z : (variables,) array
        Variables at the answer.
    """
    covariance = factorise_information(linearise_fit(collocation, z)).fit.covariance()
    nq = collocation.nq
    estimates = dict[str, FieldEstimate]()
    for body in dict.fromkeys(transcription.body for transcription in collocation.transcriptions):
        known = covariance[:nq, :nq]
        for field in field_estimates(body, collocation.parameters, q=z[:nq], uncertainty=known):
            estimates.setdefault(field.name, field)
    return estimates


def _mean_logarithm(constants: ThetaMap, part_index: int, modes: FieldModes) -> GeneratedFunction:
    """Return ln of the mean of a part's field as a function of q; of a density its ratio."""
    body = constants.body
    part = constants.body.parts[part_index]

    def logarithm(q: ca.SX, _: ca.SX) -> ca.SX:
        own = body.split_theta(constants.expression(q))[part_index]
        if part.stress_field is None:
            return (
                own[(part.law_constant_count + 2 * len(part.prony)) + 1] / part.density_kg_m3
                if part.has_free_density
                else ca.SX(1)
            )
        if modes.field.parameter != ALL_MODULI:
            return ca.log(own[modes.scaled_indices[0]])
        lame = part.material.lame(own[: len(part.material.constants)])
        return ca.log(engineering_constants(lame[0], lame[1])[0])

    return GeneratedFunction(logarithm, len(constants.parameters.free), data_size=0)
