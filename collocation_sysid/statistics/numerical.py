"""Numerical error of the estimates: what the step and the mesh do to them.

In the coordinate in which an interval is symmetric (the logarithm; ln ν/(½ − ν) of Poisson's
ratio; a linear parameter itself) let x be an estimate, and δ its change with half the step, or with
half the edge lengths. An error of order p leaves

    Δ = δ 2^p / (2^p − 1)

in x (Richardson), of which δ / (2^p − 1) in the finer answer. Three times that is taken for how
wrong Δ may be, as Roache's grid convergence index does for two levels (1994): with p = 2 the
interval then holds what any order from 0.8 upwards leaves. With three levels p is observed, from
the ratio of both changes, and 1.25 times what is left of the finest is enough, unless the changes
do not shrink as they should: then the largest of them is taken. The interval of 95 % is

    x + Δ_step + Δ_mesh ± √(n² + (u_step + u_mesh)²),

n being the half width for the noise and u what the Δ may be wrong by.

Cheaper is a Gauss–Newton step towards a finer simulation with the answer's parameters, d being what
that changes of the residuals: −A⁻¹ Sᵀ d, see `information`, to first order.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ..arrays import Array
from ..fem.constants import bare
from .estimates import Estimate
from .linearised import FitBlock, LinearisedFit

# Roache's factors of safety, for an assumed and for an observed order.
ASSUMED, OBSERVED = 3.0, 1.25
LEAST_ORDER = 0.5


@dataclass(frozen=True)
class NumericalError:
    """What discretisation does to one estimate.

    Attributes
    ----------
    step, mesh : float or None
        Change of the value with half the step, and with half the edge lengths; None if unknown.
    step_order, mesh_order : float or None
        Observed orders; None where there were two levels, or the changes did not shrink.
    extrapolated : float
        The value without discretisation, by Richardson's extrapolation.
    ci95 : (lower, upper) or None
        Interval for noise and discretisation; None where the noise's is not known.
    """

    step: float | None
    mesh: float | None
    step_order: float | None
    mesh_order: float | None
    extrapolated: float
    ci95: tuple[float, float] | None


@dataclass(frozen=True, eq=False)
class Refinement:
    """Estimates at finer discretisations.

    Attributes
    ----------
    errors : mapping of parameter or derived modulus to NumericalError
    levels : tuple of dict
        Of each finer answer what was halved ("step" or "mesh") and how often, grid rows and nodes,
        iterations, seconds, and the values by name.
    """

    errors: Mapping[str, NumericalError]
    levels: tuple[dict[str, Any], ...]

    def as_dict(self) -> dict[str, Any]:
        """For ``refinement.json``."""
        return {
            "errors": {name: asdict(error) for name, error in self.errors.items()},
            "levels": list(self.levels),
        }


@dataclass(frozen=True)
class _Limit:
    """Way from the first of several values to their limit, and how wrong that may be."""

    way: float = 0.0
    doubt: float = 0.0
    order: float | None = None

    @classmethod
    def of(cls, x: Sequence[float], order: float) -> _Limit:
        """Of values at steps or edge lengths halved again and again, or one value alone."""
        changes = np.diff(x)
        if not len(changes):
            return cls()
        last = float(changes[-1])
        if len(changes) == 1:
            left = last / (2**order - 1)
            return cls(last + left, ASSUMED * abs(left))
        ratio = float(changes[-2] / last) if last else np.inf
        if not ratio > 2**LEAST_ORDER:
            return cls(float(changes.sum()), float(np.abs(changes).max()))
        # No faster than in theory: a change that vanishes by chance promises nothing.
        found = float(np.log2(ratio))
        left = last / (2 ** min(found, order) - 1)
        return cls(float(changes.sum()) + left, OBSERVED * abs(left), found)


def numerical_error(
    name: str,
    estimate: Estimate,
    by_step: Sequence[float],
    by_mesh: Sequence[float],
    orders: tuple[float, float] = (2.0, 2.0),
    linear: bool = False,
) -> NumericalError:
    """Numerical error from the values that finer steps and meshes give.

    Parameters
    ----------
    name : str
        Of a parameter or derived modulus.
    estimate : Estimate
        The answer, whose interval is that of the noise.
    by_step, by_mesh : sequences of float
        The values with the step, or the edge lengths, halved once, twice and so on; may be empty.
    orders : (step, mesh) assumed
    linear : bool
        Whether the parameter is its own coordinate.
    """
    at = _Coordinate(name, linear)
    x = at.of(estimate.value)
    step, mesh = (
        _Limit.of([x, *map(at.of, values)], order)
        for values, order in zip((by_step, by_mesh), orders, strict=True)
    )
    limit, interval = x + step.way + mesh.way, None
    if estimate.ci95 is not None:
        low, high = map(at.of, estimate.ci95)
        half = float(np.hypot((high - low) / 2, step.doubt + mesh.doubt))
        interval = at.value(limit - half), at.value(limit + half)
    return NumericalError(
        by_step[0] - estimate.value if by_step else None,
        by_mesh[0] - estimate.value if by_mesh else None,
        step.order,
        mesh.order,
        at.value(limit),
        interval,
    )


@dataclass(frozen=True)
class _Coordinate:
    """In which an estimate's interval is symmetric, see `estimates`."""

    name: str
    linear: bool

    def of(self, value: float) -> float:
        with np.errstate(divide="ignore", invalid="ignore"):
            if bare(self.name) == "poisson":
                return float(np.log(value / (0.5 - value)))
            return value if self.linear else float(np.log(value))

    def value(self, x: float) -> float:
        if bare(self.name) == "poisson":
            return float(0.5 / (1 + np.exp(-x)))
        return x if self.linear else float(np.exp(x))


def changes_towards(fit: LinearisedFit, apart: Sequence[Array]) -> Array:
    """(p,) change of the parameters towards readings that are apart from those fitted.

    Parameters
    ----------
    fit : LinearisedFit
    apart : of each block (T, M, 3), in units of σ
    """
    free = np.flatnonzero(~fit.at_bound)
    rows = [np.diag(fit.prior_slope[free])]
    right = [np.zeros(len(free))]
    for block, way in zip(fit.blocks, apart, strict=True):
        seen = block.present.ravel()
        slope = block.slope[..., free].reshape(len(seen), 3, len(free))
        rows.append(slope[seen].reshape(-1, len(free)))
        right.append((way * _weight(block)).reshape(len(seen), 3)[seen].ravel())
    matrix = np.concatenate(rows)
    units = np.linalg.norm(matrix, axis=0)
    units[units == 0] = 1.0
    change = np.zeros(len(fit.names))
    change[free] = -np.linalg.lstsq(matrix / units, np.concatenate(right))[0] / units
    return change


def _weight(block: FitBlock) -> Array:
    """(T, M, 1) root of Huber's weights, which the slopes have already."""
    if block.misfit is None:
        return np.ones((*block.present.shape, 1))
    long = np.linalg.norm(block.misfit, axis=2)
    short = np.linalg.norm(block.residual, axis=2)
    share = np.divide(short, long, out=np.ones_like(long), where=long > 0)
    return np.sqrt(share)[..., None]
