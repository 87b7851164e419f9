"""Numerical error of the estimates: what the step and the mesh do to them.

In the coordinate in which an interval is symmetric (the logarithm; ln ν/(½ − ν) of Poisson's
ratio; a linear parameter itself) let x be an estimate, and δ its change with half the step, or with
half the edge lengths. An error of order p leaves

    Δ = δ 2^p / (2^p − 1)

in x (Richardson). With two levels p is assumed, 2 as a rule, and what Δ may be wrong by is what
lower orders would leave: half of p for the step, whose order is known; ½ for the mesh, since
elements that are too stiff, and the edge of a grasp, converge slowly at first. On the other side
twice δ / (2^p − 1) is enough. With three levels p is observed, from the ratio of both changes, and
1.25 times what is left of the finest is enough (Roache 1994), unless the changes do not shrink as
they should: then the largest of them is taken. The ends of the interval of 95 % are

    x + Δ_step + Δ_mesh ± √(n² + (u_step + u_mesh)²),

n being the half width for the noise and u what each Δ may be wrong by on that side.

Cheaper is a Gauss–Newton step towards a finer simulation with the answer's parameters, d being what
half the step changes of the residuals: −A⁻¹ Sᵀ d, see `linearised`, to first order. That takes the
place of the change with half the step.

From what one step a sample leaves follows how many leave little enough: an error of order p falls
with the p-th power of their number.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import ceil

import numpy as np

from ..arrays import Array
from ..program.least_squares import LeastSquares
from .estimates import Coordinate, Estimate
from .linearised import LinearisedFit

# Roache's factor of safety for an observed order.
OBSERVED = 1.25
# Errors of smooth solutions fall with the square of linear elements' edges, and faster for
# quadratic ones; where elements are too stiff or the body leaves its grasp they do not.
MESH_ORDER = 2.0
LEAST_ORDER = 0.5
# Standard errors that the step may move an estimate where its number is chosen, and how many steps
# a sample are chosen at most.
LITTLE = 0.5
MOST_SUBSTEPS = 8


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
    interval95 : (lower, upper) or None
        95 % interval due to noise and discretisation; None if that due to noise is not known.
    """

    step: float | None
    mesh: float | None
    step_order: float | None
    mesh_order: float | None
    extrapolated: float
    interval95: tuple[float, float] | None


def known_kinds(errors: Iterable[NumericalError]) -> tuple[str, ...]:
    """Return which discretisation errors are known of some estimate: "step", "mesh"."""
    known = tuple(errors)
    of_step = any(error.step is not None for error in known)
    of_mesh = any(error.mesh is not None for error in known)
    return (*["step"] * of_step, *["mesh"] * of_mesh)


@dataclass(frozen=True)
class Level:
    """A finer answer.

    Attributes
    ----------
    halved : {"step", "mesh"}
    times : int
        How often.
    timesteps, nodes : int
        Rows of the grid, and nodes of the bodies.
    iterations : int
    time_s : float
    values : mapping of parameter or derived modulus to value
    """

    halved: str
    times: int
    timesteps: int
    nodes: int
    iterations: int
    time_s: float
    values: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Refinement:
    """What finer discretisations do to the estimates.

    Attributes
    ----------
    errors : mapping of parameter or derived modulus to NumericalError
    levels : tuple of Level
        Empty where the step's error was estimated from a finer simulation, and nothing solved
        again.
    """

    errors: Mapping[str, NumericalError]
    levels: tuple[Level, ...] = ()

    @property
    def holds(self) -> tuple[str, ...]:
        """What its intervals hold: the noise, and of "step" and "mesh" what is known."""
        return ("noise", *known_kinds(self.errors.values()))

    def worst(
        self,
        estimates: Mapping[str, Estimate],
        std_errors: Mapping[str, float | None] | None = None,
    ) -> tuple[str, float]:
        """Return the estimate that is moved by most of its standard errors, and by how many.

        Parameters
        ----------
        estimates : mapping of name to Estimate
            Before the correction of the discretisation error.
        std_errors : mapping of name to float or None, optional
            Standard errors to compare with; the statistical ones of `estimates` by default.
            Estimates without one are left out.
        """
        if std_errors is None:
            std_errors = {name: each.statistical_std_error for name, each in estimates.items()}
        moves = {
            name: abs(estimates[name].value - error.extrapolated) / spread
            for name, error in self.errors.items()
            if (spread := std_errors.get(name))
        }
        # Moduli that move alike differ by rounding: the first is the parameter itself.
        return max(moves.items(), key=lambda each: round(each[1], 6), default=("", 0.0))

    def substeps(self, estimates: Mapping[str, Estimate], order: float) -> int:
        """How many steps keep every move small, if these are of one; not more than the most."""
        many = self.worst(estimates)[1]
        return max(1, ceil(min((many / LITTLE) ** (1 / order), MOST_SUBSTEPS)))


@dataclass(frozen=True)
class _Limit:
    """Way from the first of several values to their limit, and what it may lack on both sides."""

    way: float = 0.0
    below: float = 0.0
    above: float = 0.0
    order: float | None = None

    @classmethod
    def of(cls, x: Sequence[float], order: float, least: float) -> _Limit:
        """Of values at steps or edge lengths halved again and again, or one value alone."""
        changes = np.diff(x)
        if not len(changes):
            return cls()
        last = float(changes[-1])
        if len(changes) == 1:
            left = last / (2**order - 1)
            further = last / (2**least - 1) - left
            sides = sorted((-2 * left, further))
            return cls(last + left, -sides[0], sides[1])
        ratio = float(changes[-2] / last) if last else np.inf
        if not ratio > 2**LEAST_ORDER:
            largest = float(np.abs(changes).max())
            return cls(float(changes.sum()), largest, largest)
        # No faster than in theory: a change that vanishes by chance promises nothing.
        found = float(np.log2(ratio))
        left = last / (2 ** min(found, order) - 1)
        doubt = OBSERVED * abs(left)
        return cls(float(changes.sum()) + left, doubt, doubt, found)


def numerical_error(
    name: str,
    estimate: Estimate,
    by_step: Sequence[float],
    by_mesh: Sequence[float],
    step_order: float = 2.0,
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
    step_order : float
        Of the scheme.
    linear : bool
        Whether the parameter is its own coordinate.
    """
    known = (estimate.value, *(estimate.statistical95 or ()), *by_step, *by_mesh)
    at = Coordinate.of(name, known, linear)
    x = at.at(estimate.value)
    step = _Limit.of([x, *map(at.at, by_step)], step_order, step_order / 2)
    mesh = _Limit.of([x, *map(at.at, by_mesh)], MESH_ORDER, LEAST_ORDER)
    limit = x + step.way + mesh.way
    interval = None
    if estimate.statistical95 is not None:
        low, high = map(at.at, estimate.statistical95)
        down = float(np.hypot((high - low) / 2, step.below + mesh.below))
        up = float(np.hypot((high - low) / 2, step.above + mesh.above))
        interval = at.value(limit - down), at.value(limit + up)
    return NumericalError(
        by_step[0] - estimate.value if by_step else None,
        by_mesh[0] - estimate.value if by_mesh else None,
        step.order,
        mesh.order,
        at.value(limit),
        interval,
    )


def numerical_errors(
    estimates: Mapping[str, Estimate],
    by_step: Sequence[Mapping[str, float]],
    by_mesh: Sequence[Mapping[str, float]],
    step_order: float,
    linear: Container[str],
) -> dict[str, NumericalError]:
    """Those of all estimates that change; what is fixed, or at its bound, stays.

    Parameters
    ----------
    estimates : mapping of name to Estimate
    by_step, by_mesh : sequences of mappings of name to value, see `numerical_error`
    step_order : float
    linear : names of the parameters that are their own coordinates
    """
    found = {}
    for name, estimate in estimates.items():
        steps, meshes = ([values[name] for values in level] for level in (by_step, by_mesh))
        if any(value != estimate.value for value in (*steps, *meshes)):
            found[name] = numerical_error(name, estimate, steps, meshes, step_order, name in linear)
    return found


def changes_towards(fit: LinearisedFit, apart: Sequence[Array]) -> Array:
    """(p,) change of the parameters towards readings that are apart from those fitted.

    Parameters
    ----------
    fit : LinearisedFit
    apart : of each block (T, M, 3), in units of σ
    """
    return shifts(fit, [each[..., None] for each in apart])[:, 0]


def shifts(fit: LinearisedFit, changes: Sequence[Array]) -> Array:
    """(p, a) how the estimates follow changes of the residuals; those at a bound stay.

    Parameters
    ----------
    fit : LinearisedFit
    changes : of each block (T, M, 3, a), in units of σ
    """
    free = np.flatnonzero(~fit.at_bound)
    count = changes[0].shape[-1] if changes else 0
    if not free.size:
        return np.zeros((len(fit.names), count))
    known = LeastSquares.none(len(free)).add(np.zeros(len(free)), np.diag(fit.prior_slope[free]))
    score = np.zeros((len(free), count))
    for block, change in zip(fit.blocks, changes, strict=True):
        slope = block.slope[..., free]
        slope = slope.reshape(int(np.prod(slope.shape[:-1])), len(free))
        known = known.add(np.zeros(len(slope)), slope)
        apart = change * block.weight[..., None] * block.seen[..., None]
        score += slope.T @ apart.reshape(len(slope), count)
    found = np.zeros((len(fit.names), count))
    found[free] = -known.root @ (known.root.T @ score)
    return found
