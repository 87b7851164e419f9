"""Uncertainty budget: share of each source in the variance of each estimate.

Sources are noise, nuisance parameters, discretisation, differences between recordings, and
systematic effects. With J the derivatives of a fit's residuals and J_c their changes if an
assumption is off by its standard deviation, the estimates change by C = −(JᵀJ)⁻¹ Jᵀ J_c and have
the covariance P + C Cᵀ, P being that of the fit (considered parameters: Schmidt, NASA TN D-1235,
1962; type B evaluation: JCGM 100:2008, 4.3). Differences of parameters between recordings are
estimated from the recordings, see `recording_scatter`; where they dominate, intervals are Student's
with their degrees of freedom (Welch & Satterthwaite: ibid., G.4).

Rulers are not considered but estimated where the data determine them much better than their prior:
of a body that falls and stops, gravity determines the scale of the cameras. With S their covariance
and s their estimates by one linear step, the estimates change by C s, and have P + C S Cᵀ. This holds
only if no motion is prescribed, which the same cameras may have measured.

A body that lands on a tilted plane turns, which the data show. An error of the mesh resembles a
tilt, so that estimates are not corrected for it. Given the data, they are then off by the mean
square C (S + s sᵀ) Cᵀ, in place of C Cᵀ.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ...common.array_types import Array
from ...fem.laws.constants import without_region
from ...model.parameters import Parameters
from ..distributions import student_95
from ..estimates import Estimate, IntervalCoordinate
from ..linearised import LinearisedFit, covariance_of_fit, gauss_newton_step, least_squares_of_fit
from ..thresholds import DETERMINED, GRANTED
from ..uncertainty import Uncertainty
from .combined_intervals import NORMAL_95, Interval, combine
from .consider_analysis import ResidualChanges, with_relaxed_columns
from .discretisation_error import DiscretisationError, estimate_changes
from .memory_effect import RELAXATION_TIME
from .systematic_effects import ASSUMPTIONS, DEVIATIONS

NOISE = "noise"
NUISANCES = "nuisance parameters"
NUMERICAL = "step and mesh"
MESH = "mesh"
BETWEEN = "between recordings"
# Rows of assumptions whose alternative is reported, by name.
ALTERNATIVES = {row.name: row for row in ASSUMPTIONS if row.alternative}
PROPORTIONAL = {row.name: row.proportional_to for row in ASSUMPTIONS if row.proportional_to}


def is_definition(row: str, estimate: str) -> bool:
    """Return whether an assumption, by its name, defines an estimate: under the alternative the
    constant would be another quantity, see `Deviation.redefines`.
    """
    deviation = DEVIATIONS.get(row)
    return deviation is not None and without_region(estimate) in deviation.redefines


@dataclass(frozen=True)
class BudgetLine:
    """Uncertainty budget of one estimate."""

    value: float  # the estimate, corrected for the discretisation error and known effects
    # mapping of str to float: share of each source in the variance, largest first; they sum to one.
    shares: Mapping[str, float]
    combined95: Interval  # (lower, upper): 95 % interval due to all sources
    combined_std_error: float  # standard uncertainty due to all sources
    # Standard deviation of the systematic effects and of the differences between recordings, in the
    # coordinate of the estimate, see `IntervalCoordinate`.
    systematic: float
    # Correction for known effects in the same coordinate, contained in `value`.
    known_effect: float = 0.0


@dataclass(frozen=True, eq=False)
class VarianceSources:
    """Covariances and sensitivities from which budgets are computed."""

    names: tuple[str, ...]  # (a,) tuple of str: names of the assumptions with their components
    # (nq, a): changes of the shared parameters q if each is off by its standard deviation.
    sensitivities: Array
    # (nq, nq): covariance of q for the stated noise, with free nuisance parameters.
    covariance_free: Array
    # (nq, nq): covariance of q for the stated noise, with known nuisance parameters.
    covariance_known: Array
    derivatives: Mapping[str, Array]  # mapping of str to (nq,): derivatives of each estimate by q
    widening: Array  # (nq,): factor by which intervals are widened because recordings disagree
    # (nq, b): changes of q with the differences of parameters between recordings, in their standard
    # deviations.
    recording_sensitivities: Array
    freedom: int = 0  # degrees of freedom of these deviations: recordings less one
    # mapping of str to float: known effects over their standard deviations, for which estimates are
    # corrected.
    means: Mapping[str, float] = field(default_factory=dict)
    # mapping of str to (nq,): changes of q if an assumption with an alternative
    # (`Deviation.alternative`) is wrong by one unit, by its name with its component.
    alternatives: Mapping[str, Array] = field(default_factory=dict)
    # Estimates and standard errors of the rulers that the data determine, in deviations of the budget.
    rulers: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    shift: Array | float = 0.0  # (nq,) array: changes of q by these estimates

    @classmethod
    def from_fit(
        cls,
        fit: LinearisedFit,
        assumed: ResidualChanges,
        parameters: Parameters,
        q: Array,
        uncertainty: Uncertainty,
        *,
        deviations: Mapping[str, float | None] | None = None,
        evaluated: Mapping[str, float | None] | None = None,
        means: Mapping[str, float] | None = None,
        has_rulers: bool = False,
    ) -> VarianceSources:
        """Compute the sources of a fit.

        Parameters
        ----------
        q : (nq,) array
            Estimates in the solver's coordinates.
        uncertainty : Uncertainty
            Statistical uncertainty of the fit.
        deviations : mapping of str to float or None, optional
            Standard deviations in the budget; assumptions that are None do not contribute. By
            default all of `assumed` contribute.
        evaluated : mapping of str to float or None, optional
            Standard deviations for which `assumed` was computed, without which no alternatives are
            known.
        means : mapping of str to float, optional
            Known effects over their standard deviations; None if there are none.
        has_rulers : bool
            Whether rulers that the data determine are estimated, see `prescribes_no_motion`.

        Notes
        -----
        Rows and columns of parameters at a bound are zero.
        """
        free = np.flatnonzero(~fit.at_bound)
        shared = free[free < fit.shared_count]
        all_free, known = (np.zeros((fit.shared_count, fit.shared_count)) for _ in range(2))
        information = least_squares_of_fit(fit).information
        for own, here in ((all_free, free), (known, shared)):
            inverse = np.linalg.pinv(information[np.ix_(here, here)], hermitian=True)
            own[np.ix_(shared, shared)] = inverse[: len(shared), : len(shared)]
        moved = estimate_changes(fit, assumed.blocks)[: fit.shared_count]
        rows = [name.partition(" ")[0] for name in assumed.names]
        for k, row in enumerate(rows):
            if row in PROPORTIONAL:
                moved[:, k] = rescaled(moved[:, k], parameters, PROPORTIONAL[row])
        units = evaluated or {}
        alternatives = {
            name: moved[:, k] / (units[row] or 1.0)
            for k, (name, row) in enumerate(zip(assumed.names, rows, strict=True))
            if row in units and row in ALTERNATIVES
        }
        known_deviations = deviations or {}
        budgeted = [k for k, row in enumerate(rows) if known_deviations.get(row, 1.0) is not None]
        considered = budgeted if has_rulers else []
        sought = [k for k in considered if DEVIATIONS[rows[k]].is_ruler]
        rulers, values, joint = _determined(fit, assumed, considered, sought)
        has_limited = any(DEVIATIONS[rows[k]].is_limited for k in considered)
        beside_rulers = [k for k in considered if k in sought or DEVIATIONS[rows[k]].is_limited]
        limited, limits, beside = _determined(
            fit, assumed, considered, beside_rulers if has_limited else ()
        )
        shift = moved[:, rulers] @ values
        ruler_errors = np.zeros(0)
        if rulers:
            covariance = covariance_of_fit(joint)[len(fit.names) :, len(fit.names) :]
            ruler_errors = np.sqrt(np.diag(covariance))
            widths, axes = np.linalg.eigh(covariance)
            others = [k for k in budgeted if k not in rulers]
            moved[:, rulers] = moved[:, rulers] @ (axes * np.sqrt(widths)) @ axes.T
            moved[:, others] = estimate_changes(joint, assumed.blocks)[: fit.shared_count, others]
        seen = [place for place, k in enumerate(limited) if k not in rulers]
        if seen:
            first = len(fit.names)
            covariance = covariance_of_fit(beside)[first:, first:][np.ix_(seen, seen)]
            widths, axes = np.linalg.eigh(covariance + np.outer(limits[seen], limits[seen]))
            columns = [limited[place] for place in seen]
            moved[:, columns] = moved[:, columns] @ (axes * np.sqrt(widths)) @ axes.T
        by_q = _estimate_derivatives(fit, parameters, q=q)
        scatter = uncertainty.scatter
        between = np.zeros((fit.shared_count, 0))
        freedom = 0
        if scatter is not None:
            between = scatter.sensitivities[: fit.shared_count]
            freedom = len(scatter.recordings) - 1
        wider = uncertainty.widening
        known_effects = dict(means or {})
        return cls(
            tuple(assumed.names[k] for k in budgeted),
            moved[:, budgeted],
            covariance_free=all_free,
            covariance_known=known,
            derivatives=by_q,
            widening=wider,
            recording_sensitivities=between,
            freedom=freedom,
            means=known_effects,
            alternatives=alternatives,
            rulers={
                assumed.names[k]: (float(value), float(error))
                for k, value, error in zip(rulers, values, ruler_errors, strict=True)
            },
            shift=shift,
        )

    def noise_shares(self, by_q: Array) -> tuple[float, float]:
        """Return shares of the statistical variance of an estimate with the derivative `by_q`
        (nq,).

        Returns
        -------
        (float, float)
            Share that would remain with known nuisance parameters; and share that would remain if
            recordings agreed, 1 if they do. Both are 1 if the variance is 0 or not finite.
        """
        scaled_by_noise = self.widening * by_q
        known, all_free, all_scaled_by_noise = (
            float(g @ of_q @ g)
            for g, of_q in (
                (by_q, self.covariance_known),
                (by_q, self.covariance_free),
                (scaled_by_noise, self.covariance_free),
            )
        )
        if not all_free > 0:
            return 1.0, 1.0
        agreed = 1.0 if (self.widening == 1).all() else all_free / all_scaled_by_noise
        return float(np.clip(known / all_free, 0.0, 1.0)), agreed

    def variance_between_recordings(self, by_q: Array, others: float, counted: float) -> float:
        """Return the variance due to differences of parameters between recordings, beyond what is
        counted already.

        It is enlarged such that a normal interval is as wide as Student's interval of the sum.

        Parameters
        ----------
        by_q : (nq,) array
            Derivatives of the estimate.
        counted : float
            Variance between recordings that is counted already.

        Returns
        -------
        float
            The excess over `counted`, enlarged; 0 if there is none.
        """
        more = max(0.0, float(np.sum((by_q @ self.recording_sensitivities) ** 2)) - counted)
        if not more:
            return 0.0
        freedom = self.freedom * ((others + more) / more) ** 2
        return more * float(student_95(freedom) / NORMAL_95) ** 2

    def combine_covariance(
        self, names: Sequence[str], statistical: Array, sizes: Array, discretisation: Array
    ) -> Array:
        """Return the covariance (nq, nq) due to noise, discretisation and systematic effects in the
        coordinates of a statistical one.

        Parameters
        ----------
        names : sequence of nq str
            Estimated parameters; assumptions that define one do not change it.
        statistical : (nq, nq) array
            Statistical covariance.
        sizes : (nq,) array
            Derivatives of its coordinates by q.
        discretisation : (nq,) array
            Standard deviations of the discretisation error in the same coordinates, with the sign
            of the error: finer steps or meshes change all parameters together.
        """
        defined = [
            [is_definition(source.partition(" ")[0], name) for source in self.names]
            for name in names
        ]
        own = np.where(np.reshape(defined, self.sensitivities.shape), 0.0, self.sensitivities)
        ways = sizes[:, None] * np.hstack([own, self.recording_sensitivities])
        return statistical + ways @ ways.T + np.outer(discretisation, discretisation)

    def known_effect(self, by_q: Array) -> float:
        """Return the change of an estimate with the derivative `by_q` (nq,) by all known effects
        and rulers, to first order; 0 without any. Of an assumption with several components each
        has the effect.
        """
        sizes = [self.means.get(name.partition(" ")[0], 0.0) for name in self.names]
        return float(by_q @ (self.sensitivities @ sizes + self.shift))

    def variances_of_assumptions(self, estimate: str, by_q: Array) -> dict[str, float]:
        """Return the variance by each assumption, its components summed, of an estimate with the
        derivative `by_q` (nq,), by the assumption's name; without those that define the estimate.
        """
        variances: dict[str, float] = {}
        for name, way in zip(self.names, by_q @ self.sensitivities, strict=True):
            row = name.partition(" ")[0]
            if not is_definition(row, estimate):
                variances[row] = variances.get(row, 0.0) + float(way) ** 2
        return variances

    def covers(self, row: str, estimate: str) -> bool:
        """Return whether the interval of an estimate contains the effect of an assumption."""
        counted = any(name.partition(" ")[0] == row for name in self.names)
        return counted and not is_definition(row, estimate)


def _determined(
    fit: LinearisedFit, assumed: ResidualChanges, columns: Sequence[int], sought: Sequence[int]
) -> tuple[list[int], Array, LinearisedFit]:
    """Return those of the sought columns that the data determine, their values (r,) by one linear
    step in the deviations of the budget, and the fit in which they are parameters; the fit itself
    without any, or if a value is larger than the budget grants.

    `columns` are those of the budget: whether one is determined is tested with all of them relaxed.
    """
    nothing: tuple[list[int], Array, LinearisedFit] = [], np.zeros(0), fit
    if not sought:
        return nothing
    first = len(fit.names)
    wide = with_relaxed_columns(fit, assumed, columns)
    errors = dict(zip(columns, np.sqrt(np.diag(covariance_of_fit(wide))[first:]), strict=True))
    known = [k for k in sought if errors[k] < DETERMINED]
    if not known:
        return nothing
    joint = with_relaxed_columns(fit, assumed, known)
    values = gauss_newton_step(joint)[first:]
    return nothing if (np.abs(values) > GRANTED).any() else (known, values, joint)


def rescaled(step: Array, parameters: Parameters, is_proportional: Callable[[str], bool]) -> Array:
    """Return the changes of q (nq,) by other forces that are proportional to a constant, which is
    estimated anew for these forces.

    The linear change −(K − 1) of the logarithm of the constant says that the other forces are K
    times those of the answer. With 1/K of the constant they agree, and only 1/K of what they differ
    in otherwise remains: with a large K, as of viscosities that contain the bulk modulus of a
    nearly incompressible body, the linear changes of the other parameters mean nothing. Forces that
    are smaller than those of the answer, and constants that are fixed, change nothing.

    Parameters
    ----------
    step : (nq,) array
        Linear changes.
    is_proportional : callable
        Whether the forces are proportional to a constant, by name. Of several the largest K counts.
    """
    own = [
        k
        for k, item in enumerate(parameters.free)
        if is_proportional(item.name) and item.scale == "log"
    ]
    ratio = 1.0 - min((float(step[k]) for k in own), default=0.0)
    if ratio <= 1.0:
        return step
    scaled = step / ratio
    scaled[own] = -np.log1p(np.maximum(0.0, -step[own]))
    return scaled


def budget(
    sources: VarianceSources,
    uncertainty: Uncertainty,
    numerical: Mapping[str, DiscretisationError],
    parameters: Parameters,
) -> dict[str, BudgetLine]:
    """Return the uncertainty budget of every estimate that has a statistical interval, by name.

    Parameters
    ----------
    sources : VarianceSources
        Covariances and sensitivities of the fit.
    uncertainty : Uncertainty
        Statistical uncertainty of the fit.
    numerical : mapping of estimate to DiscretisationError
        Discretisation errors; estimates without an entry have none, or an unknown one.
    parameters : Parameters
        The parameters of the problem, with their coordinates and bounds.

    Notes
    -----
    Estimates that do not depend on q, such as fixed ones, are left out.
    """
    lines = {}
    for name, estimate in {**uncertainty.estimates, **uncertainty.derived}.items():
        by_q = sources.derivatives[name]
        if estimate.statistical95 is not None and by_q.any():
            lines[name] = _line(
                name, estimate, sources=sources, error=numerical.get(name), parameters=parameters
            )
    return lines


def _line(
    name: str,
    estimate: Estimate,
    sources: VarianceSources,
    error: DiscretisationError | None,
    parameters: Parameters,
) -> BudgetLine:
    assert estimate.statistical95 is not None
    linear, bounds = parameters.scale_and_bounds(name)
    ends = estimate.statistical95
    if error is not None and error.interval95 is not None:
        ends = error.interval95
    at = IntervalCoordinate.for_estimate(
        name, (estimate.value, *estimate.statistical95, *ends), linear=linear
    )
    noise = _variance(at, estimate.value, ends=estimate.statistical95)
    middle = estimate.value if error is None else error.extrapolated
    by_q = sources.derivatives[name]
    own, agreed = sources.noise_shares(by_q)
    excess = noise * (1 - agreed)
    parts = {NOISE: noise * agreed * own, NUISANCES: noise * agreed * (1 - own)}
    of_mesh = 0.0 if error is None else abs(error.estimated_mesh or 0.0)
    is_mesh = error is not None and of_mesh > abs(error.step or 0.0)
    parts[MESH if is_mesh else NUMERICAL] = max(0.0, _variance(at, middle, ends=ends) - noise)
    by_coordinate = by_q * at.derivative(estimate.value)
    by_assumption = sources.variances_of_assumptions(name, by_coordinate)
    others = sum(parts.values()) + sum(by_assumption.values())
    between = sources.variance_between_recordings(by_coordinate, others, counted=excess)
    systematic = float(np.sqrt(sum(by_assumption.values()) + between))
    variances = parts | {BETWEEN: excess + between} | by_assumption
    total = sum(variances.values())
    known_effect = sources.known_effect(by_coordinate)
    combined = combine(
        name,
        estimate,
        error=error,
        systematic=systematic,
        known_effect=known_effect,
        linear=linear,
        bounds=bounds,
    )
    assert combined.combined95 is not None
    assert combined.combined_std_error is not None
    return BudgetLine(
        combined.value,
        _ranked({source: part / total for source, part in variances.items() if part > 0}),
        combined95=combined.combined95,
        combined_std_error=combined.combined_std_error,
        systematic=systematic,
        known_effect=known_effect,
    )


def _variance(at: IntervalCoordinate, middle: float, ends: Interval) -> float:
    """Return the variance of a 95 % interval, in the coordinate of the interval.

    If both sides are equal, half the interval counts as 1.96 standard deviations; else, as where
    one end is cut off by a bound, it is the mean of the variances of both sides.
    """
    centre = at.from_value(middle)
    low, high = map(at.from_value, ends)
    if np.isclose(centre - low, high - centre, rtol=1e-6):
        return ((high - low) / 2 / NORMAL_95) ** 2
    return float(np.mean([((centre - low) / NORMAL_95) ** 2, ((high - centre) / NORMAL_95) ** 2]))


def _ranked(shares: Mapping[str, float]) -> dict[str, float]:
    return dict(sorted(shares.items(), key=lambda part: -part[1]))


def _estimate_derivatives(fit: LinearisedFit, parameters: Parameters, q: Array) -> dict[str, Array]:
    """Return the derivatives (nq,) of each estimate by q, by name; zero for fixed ones."""
    values = parameters.values(q)
    slopes = {name: np.zeros(len(q)) for name in values}
    for k, item in enumerate(parameters.free):
        slopes[item.name][k] = item.value_derivative(values[item.name])
    for item in parameters.components:
        if item.tied is not None:
            slopes[item.name] = item.tied.ratio * slopes[item.tied.to]
    return slopes | dict(fit.derived.derivatives)


def main_sources(shares: Mapping[str, Mapping[str, float]], minimum_share: float) -> list[str]:
    """Return the sources whose share in the variance of at least one estimate is `minimum_share` or
    more, by their largest share, the largest first.

    Parameters
    ----------
    shares : mapping of str to mapping of str to float
        Shares by estimate and source.
    minimum_share : float
        Smallest share of interest.
    """
    largest: dict[str, float] = {}
    for source, share in (each for line in shares.values() for each in line.items()):
        largest[source] = max(share, largest.get(source, 0.0))
    return sorted((s for s in largest if largest[s] >= minimum_share), key=lambda s: -largest[s])


def source_label(source: str) -> str:
    """Return the name of a source as text for messages: without a unit suffix such as "_rad", with
    spaces for underscores, and with a relaxation time in parentheses.
    """
    unit = next((u for u in ("_m_n", "_1_m2", "_rad", "_m", "_s") if source.endswith(u)), "")
    label = source.removesuffix(unit).replace("_", " ")
    name, _, time = label.partition(f" {RELAXATION_TIME}")
    return f"{name} (τ = {time.removesuffix('s')} s)" if time else label
