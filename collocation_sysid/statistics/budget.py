"""What each estimate's variance comes from: noise, nuisances, step and mesh, and what is assumed.

With A the information of a fit, J its slopes and J_c how its residuals change where an assumption
is off by its deviation, estimates of parameters p follow by S = −(JᵀJ)⁻¹ Jᵀ J_c, and have the
covariance P + S Sᵀ: that of the fit and that of what it assumes (considered parameters: Schmidt,
NASA TN D-1235, 1962; type B evaluation: JCGM 100:2008, 4.3). That one value holds for all
recordings is assumed too; by how much it does not is seen from them, see `scatter`, and where that
decides intervals are Student's with their degrees of freedom (Welch & Satterthwaite: ibid., G.4).
"""

from __future__ import annotations

from collections.abc import Container, Mapping
from dataclasses import dataclass

import numpy as np

from ..arrays import Array
from ..model.parameters import Parameters
from .considered import Changes
from .distributions import student_ppf
from .estimates import Coordinate
from .linearised import LinearisedFit, least_squares
from .numerical import NumericalError, shifts
from .uncertainty import Uncertainty

# Half a 95 % interval of what is normal, in deviations.
NORMAL = 1.96
NOISE, NUISANCES, NUMERICAL = "noise", "nuisance parameters", "step and mesh"
BETWEEN = "between recordings"


@dataclass(frozen=True)
class BudgetLine:
    """One estimate's variance by source.

    Attributes
    ----------
    shares : mapping of source to its share of the variance, largest first; they sum to one
    whole95 : (lower, upper)
        95 % interval that holds all of them.
    """

    shares: Mapping[str, float]
    whole95: tuple[float, float]

    def widened(self, source: str, deviation: float, at: Coordinate) -> BudgetLine:
        """With one more source, of a deviation in a coordinate."""
        low, high = map(at.at, self.whole95)
        known, more = ((high - low) / 2 / NORMAL) ** 2, deviation**2
        shares = {name: share * known / (known + more) for name, share in self.shares.items()}
        shares[source] = more / (known + more)
        ranked = dict(sorted(shares.items(), key=lambda part: -part[1]))
        return BudgetLine(ranked, _whole(at, (low, high), NORMAL * deviation))


@dataclass(frozen=True, eq=False)
class Sources:
    """What moves the estimates of a fit, beside its noise.

    Attributes
    ----------
    names : (a,) of what is assumed, with its components
    moved : (nq, a) how the shared parameters q follow, each off by its deviation
    free, known : (nq, nq) covariances of q for noise as given, with nuisance parameters free, and
        with these known
    by_q : mapping of estimate to (nq,), its derivative
    wider : (nq,) by how much intervals are wider than noise makes them, as recordings disagree
    between : (nq, b) how q follows what parameters differ by between recordings
    freedom : int
        How many recordings tell that, less one.
    """

    names: tuple[str, ...]
    moved: Array
    free: Array
    known: Array
    by_q: Mapping[str, Array]
    wider: Array
    between: Array
    freedom: int = 0

    @classmethod
    def of(
        cls,
        fit: LinearisedFit,
        assumed: Changes,
        parameters: Parameters,
        q: Array,
        uncertainty: Uncertainty,
    ) -> Sources:
        """Those of a fit near its answer q (nq,)."""
        free = np.flatnonzero(~fit.at_bound)
        shared = free[free < fit.shared]
        all_free, known = (np.zeros((fit.shared, fit.shared)) for _ in range(2))
        information = least_squares(fit).information
        for own, here in ((all_free, free), (known, shared)):
            inverse = np.linalg.pinv(information[np.ix_(here, here)], hermitian=True)
            own[np.ix_(shared, shared)] = inverse[: len(shared), : len(shared)]
        moved = shifts(fit, assumed.blocks)[: fit.shared]
        by_q, scatter = _slopes(fit, parameters, q), uncertainty.scatter
        between, freedom = np.zeros((fit.shared, 0)), 0
        if scatter is not None:
            between, freedom = scatter.between[: fit.shared], len(scatter.recordings) - 1
        wider = uncertainty.wider
        return cls(assumed.names, moved, all_free, known, by_q, wider, between, freedom)

    def of_noise(self, by_q: Array) -> tuple[float, float]:
        """Of a variance by noise, the shares if nuisances were known and recordings agreed."""
        widened = self.wider * by_q
        known, whole, all_of_it = (
            float(g @ of_q @ g)
            for g, of_q in ((by_q, self.known), (by_q, self.free), (widened, self.free))
        )
        if not whole > 0:
            return 1.0, 1.0
        agreed = 1.0 if (self.wider == 1).all() else whole / all_of_it
        return float(np.clip(known / whole, 0.0, 1.0)), agreed

    def of_recordings(self, by_q: Array, others: float, told: float) -> float:
        """A variance by what parameters differ by between recordings, beyond what is told of it.

        It is as large as its interval is beside that of all others.
        """
        more = max(0.0, float(np.sum((by_q @ self.between) ** 2)) - told)
        if not more:
            return 0.0
        freedom = self.freedom * ((others + more) / more) ** 2
        return more * float(student_ppf(0.975, freedom) / NORMAL) ** 2

    def of_assumed(self, by_q: Array) -> dict[str, float]:
        """Variances by each assumption, of what has this derivative."""
        variances: dict[str, float] = {}
        for name, way in zip(self.names, by_q @ self.moved, strict=True):
            row = name.partition(" ")[0]
            variances[row] = variances.get(row, 0.0) + float(way) ** 2
        return variances


def budget(
    sources: Sources,
    uncertainty: Uncertainty,
    numerical: Mapping[str, NumericalError],
    linear: Container[str] = (),
) -> dict[str, BudgetLine]:
    """The budget of all estimates that have an interval, by name.

    Parameters
    ----------
    sources : Sources
    uncertainty : Uncertainty
    numerical : mapping of estimate to NumericalError, of those that are known
    linear : names of the parameters that are their own coordinates
    """
    lines = {}
    for name, estimate in {**uncertainty.estimates, **uncertainty.derived}.items():
        by_q, error = sources.by_q[name], numerical.get(name)
        if estimate.ci95 is None or not by_q.any():
            continue
        ends = error.ci95 if error is not None and error.ci95 is not None else estimate.ci95
        at = Coordinate.of(name, (estimate.value, *estimate.ci95, *ends), name in linear)
        low, high = map(at.at, estimate.ci95)
        noise = ((high - low) / 2 / NORMAL) ** 2
        low, high = map(at.at, ends)
        own, agreed = sources.of_noise(by_q)
        told = noise * (1 - agreed)
        parts = {NOISE: noise * agreed * own, NUISANCES: noise * agreed * (1 - own)}
        parts[NUMERICAL] = max(0.0, ((high - low) / 2 / NORMAL) ** 2 - noise)
        in_chart = by_q * at.slope(estimate.value)
        by_assumption = sources.of_assumed(in_chart)
        others = sum(parts.values()) + sum(by_assumption.values())
        more = sources.of_recordings(in_chart, others, told)
        parts[BETWEEN] = told + more
        assumed = sum(by_assumption.values()) + more
        total = others + told + more
        ranked = sorted((parts | by_assumption).items(), key=lambda part: -part[1])
        lines[name] = BudgetLine(
            {source: variance / total for source, variance in ranked if variance > 0},
            _whole(at, (low, high), NORMAL * float(np.sqrt(assumed))),
        )
    return lines


def _whole(at: Coordinate, ends: tuple[float, float], reach: float) -> tuple[float, float]:
    """An interval with what is assumed, from its ends and the assumptions' half width.

    Of an effect as large as the estimate itself the first order is true of one chart only: what
    brakes a body adds to a damping, what makes it heavier multiplies its moduli. So it reaches as
    far as in the worse of both, the estimate's coordinate and its value.
    """
    middle, whole = sum(ends) / 2, float(np.hypot((ends[1] - ends[0]) / 2, reach))
    centre, low, high = map(at.value, (middle, *ends))
    below, above = (float(np.hypot(reach / at.slope(centre), end - centre)) for end in (low, high))
    least, most = at.range
    return (
        min(at.value(middle - whole), max(least, centre - below)),
        max(at.value(middle + whole), min(most, centre + above)),
    )


def _slopes(fit: LinearisedFit, parameters: Parameters, q: Array) -> dict[str, Array]:
    """(nq,) derivatives of each estimate by q."""
    values = parameters.values(q)
    slopes = {name: np.zeros(len(q)) for name in values}
    for k, item in enumerate(parameters.free):
        slopes[item.name][k] = item.per_value(values[item.name])
    for item in parameters.items:
        if item.tied is not None:
            slopes[item.name] = item.tied.ratio * slopes[item.tied.to]
    return slopes | dict(fit.derived.by_q)


def largest_first(shares: Mapping[str, Mapping[str, float]], least: float) -> list[str]:
    """The sources that have at least a share of some estimate's variance, the largest first."""
    largest: dict[str, float] = {}
    for source, share in (each for line in shares.values() for each in line.items()):
        largest[source] = max(share, largest.get(source, 0.0))
    return sorted((s for s in largest if largest[s] >= least), key=lambda s: -largest[s])


def worded(source: str) -> str:
    """A source as people read it."""
    unit = next((u for u in ("_m_n", "_1_m2", "_rad", "_m", "_s") if source.endswith(u)), "")
    return source.removesuffix(unit).replace("_", " ")
