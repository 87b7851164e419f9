"""What each estimate's variance comes from: noise, nuisances, step and mesh, and what is assumed.

With A the information of a fit, J its slopes and J_c how its residuals change where an assumption
is off by its deviation, estimates of parameters p follow by S = −(JᵀJ)⁻¹ Jᵀ J_c, and have the
covariance P + S Sᵀ: that of the fit and that of what it assumes (considered parameters: Schmidt,
NASA TN D-1235, 1962; type B evaluation: JCGM 100:2008, 4.3).
"""

from __future__ import annotations

from collections.abc import Container, Mapping
from dataclasses import dataclass

import numpy as np

from ..arrays import Array
from ..model.parameters import Parameters
from .considered import Changes
from .linearised import LinearisedFit, least_squares
from .numerical import Coordinate, NumericalError, shifts
from .uncertainty import Uncertainty

# Half a 95 % interval of what is normal, in deviations.
NORMAL = 1.96
NOISE, NUISANCES, NUMERICAL = "noise", "nuisance parameters", "step and mesh"


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
    """

    names: tuple[str, ...]
    moved: Array
    free: Array
    known: Array
    by_q: Mapping[str, Array]

    @classmethod
    def of(cls, fit: LinearisedFit, assumed: Changes, parameters: Parameters, q: Array) -> Sources:
        """Those of a fit near its answer q (nq,)."""
        free = np.flatnonzero(~fit.at_bound)
        shared = free[free < fit.shared]
        all_free, known = (np.zeros((fit.shared, fit.shared)) for _ in range(2))
        information = least_squares(fit).information
        for own, here in ((all_free, free), (known, shared)):
            inverse = np.linalg.pinv(information[np.ix_(here, here)], hermitian=True)
            own[np.ix_(shared, shared)] = inverse[: len(shared), : len(shared)]
        moved = shifts(fit, assumed.blocks)[: fit.shared]
        return cls(assumed.names, moved, all_free, known, _slopes(fit, parameters, q))

    def of_noise(self, by_q: Array) -> float:
        """Of a variance by noise, the share that there were if nuisances were known."""
        whole = float(by_q @ self.free @ by_q)
        return float(np.clip(by_q @ self.known @ by_q / whole, 0.0, 1.0)) if whole > 0 else 1.0

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
        own = sources.of_noise(by_q)
        parts = {NOISE: noise * own, NUISANCES: noise * (1 - own)}
        parts[NUMERICAL] = max(0.0, ((high - low) / 2 / NORMAL) ** 2 - noise)
        by_assumption = sources.of_assumed(by_q * at.slope(estimate.value))
        total = sum(parts.values()) + sum(by_assumption.values())
        whole = np.hypot((high - low) / 2, NORMAL * np.sqrt(sum(by_assumption.values())))
        middle = (low + high) / 2
        ranked = sorted((parts | by_assumption).items(), key=lambda part: -part[1])
        lines[name] = BudgetLine(
            {source: variance / total for source, variance in ranked if variance > 0},
            (at.value(middle - whole), at.value(middle + whole)),
        )
    return lines


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


def worded(source: str) -> str:
    """A source as people read it."""
    unit = next((u for u in ("_m_n", "_1_m2", "_rad", "_m", "_s") if source.endswith(u)), "")
    return source.removesuffix(unit).replace("_", " ")
