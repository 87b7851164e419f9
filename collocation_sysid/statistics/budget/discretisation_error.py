"""Discretisation error of the estimates, due to time step and mesh.

In the coordinate in which an interval is symmetric (the logarithm; ln ν/(½ − ν) of Poisson's ratio;
a linear parameter itself) let x be an estimate, and δ its change with half the step, or with half
the edge lengths. An error of order p leaves

    Δ = δ 2^p / (2^p − 1)

in x (Richardson). With two levels p is assumed, 2 as a rule, and the uncertainty of Δ is what lower
orders would leave: half of p for the step, whose order is known; ½ for the mesh, since elements
that are too stiff, and the edge of a grasp, converge slowly at first. On the other side twice δ /
(2^p − 1) is enough. With three levels p is observed, from the ratio of both changes, and 1.25 times
the remaining error of the finest is enough (Roache 1994), unless the changes do not shrink as they
should: then the largest of them is taken. The ends of the 95 % interval are

    x + Δ_step + Δ_mesh ± √(n² + (u_step + u_mesh)²),

n being the half width for the noise and u the uncertainty of each Δ on that side.

A cheaper estimate is a Gauss–Newton step towards a finer simulation with the answer's parameters:
−A⁻¹ Sᵀ d to first order, see `linearised`, d being the change of the residuals with half the step.
The number of steps is chosen by it; d itself, and the same of the mesh (`mesh_error`), are effects
in the posterior.

The number of steps that leaves a small enough error follows from the error with one step a sample,
because an error of order p decreases with the p-th power of their number.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import ceil

import numpy as np

from ...common.array_types import Array
from ...program.least_squares import SquareRootInformation
from ..estimates import Estimate, IntervalCoordinate
from ..linearised import LinearisedFit

# Roache's factor of safety for an observed order.
OBSERVED = 1.25
# Order of the mesh for smooth solutions with linear elements; quadratic ones converge faster.
MESH_ORDER = 2.0
# Lowest order of the mesh, where elements are too stiff or at the edge of a grasp.
LEAST_ORDER = 0.5
# Largest change of an estimate due to the step, in standard errors, where the number of steps is
# chosen.
LITTLE = 0.5
# Change of an estimate over its value that needs no more steps, although many precise samples make it
# larger than that: estimates are corrected for it.
NEGLIGIBLE = 1e-3
# Share of the correction in the variance of an estimate that needs no more steps.
SMALL_SHARE = 0.1
# Largest number of steps per sample that is chosen.
MOST_SUBSTEPS = 8


@dataclass(frozen=True)
class DiscretisationError:
    """Discretisation error of one estimate."""

    # Change of the value with half the step, and with half the edge lengths; None if unknown.
    step: float | None
    mesh: float | None
    # Observed orders; None with two levels, or if the changes did not shrink.
    step_order: float | None
    mesh_order: float | None
    extrapolated: float  # value without discretisation error, by Richardson's extrapolation
    # (lower, upper) or None: 95 % interval due to noise and discretisation; None if that due to
    # noise is unknown.
    interval95: tuple[float, float] | None


def known_kinds(errors: Iterable[DiscretisationError]) -> tuple[str, ...]:
    """Return which discretisation errors are known for at least one estimate: "step", "mesh", both
    in this order, or none.
    """
    known = tuple(errors)
    of_step = any(error.step is not None for error in known)
    of_mesh = any(error.mesh is not None for error in known)
    return (*["step"] * of_step, *["mesh"] * of_mesh)


@dataclass(frozen=True)
class RefinementLevel:
    """One solution on a finer discretisation."""

    refined: str  # what was refined
    halvings: int  # how often it was halved
    # Number of grid times, and of nodes of the bodies.
    timesteps: int
    nodes: int
    iterations: int  # iterations of the solve
    time_s: float  # computing time [s]
    values: Mapping[str, float]  # mapping of str to float: parameters and derived moduli by name


@dataclass(frozen=True, eq=False)
class Refinement:
    """Discretisation errors of all estimates."""

    # mapping of str to DiscretisationError: errors by parameter or derived modulus.
    errors: Mapping[str, DiscretisationError]
    # Refined solutions; empty if the errors were estimated without them.
    levels: tuple[RefinementLevel, ...] = ()

    @property
    def contributions(self) -> tuple[str, ...]:
        """Contributions that its intervals contain: "noise", then "step" and "mesh" if they are
        known for at least one estimate.
        """
        return ("noise", *known_kinds(self.errors.values()))

    def largest_correction(
        self,
        estimates: Mapping[str, Estimate],
        std_errors: Mapping[str, float | None] | None = None,
    ) -> tuple[str, float]:
        """Return the estimate with the largest correction in standard errors, and that ratio; ("",
        0.0) if there is none.

        Parameters
        ----------
        estimates : mapping of str to Estimate
            Estimates before the correction of the discretisation error.
        std_errors : mapping of str to float or None, optional
            Standard errors to compare with; the statistical ones of `estimates` by default.
            Estimates without one are left out.

        Returns
        -------
        (str, float)
            Name, and the absolute correction over the standard error. Of equal ratios the first in
            `errors` counts. An error whose name is missing in `std_errors`, or has None or 0 there,
            is left out.
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

    def suggested_substeps(self, estimates: Mapping[str, Estimate], order: float) -> int:
        """Return the number of steps per sample, from 1 to `MOST_SUBSTEPS`, that makes every
        correction small if the present errors are those of one step per sample.

        Parameters
        ----------
        estimates : mapping of str to Estimate
            Estimates before the correction.

        Notes
        -----
        Small means at most `LITTLE` statistical standard errors, or `NEGLIGIBLE` of the value.
        Without a correction the number is 1.
        """
        many = max(
            (
                abs(estimates[name].value - error.extrapolated)
                / max(LITTLE * spread, NEGLIGIBLE * abs(estimates[name].value))
                for name, error in self.errors.items()
                if (spread := estimates[name].statistical_std_error)
            ),
            default=0.0,
        )
        return max(1, ceil(min(many ** (1 / order), MOST_SUBSTEPS)))


@dataclass(frozen=True)
class _Extrapolation:
    """Extrapolation from the first of several values to their limit, with its uncertainty on both
    sides.
    """

    change: float = 0.0  # limit less the first value
    # Uncertainty below and above the limit.
    below: float = 0.0
    above: float = 0.0
    order: float | None = None  # observed order; None if it was assumed

    @classmethod
    def from_values(cls, x: Sequence[float], order: float, least: float) -> _Extrapolation:
        """Extrapolate values at steps or edge lengths halved repeatedly.

        A single value has no change and no uncertainty. Two values are extrapolated by the
        theoretical order; the uncertainty includes the limit of the lowest order on one side, and
        twice the extrapolated remainder on the other. Three or more are extrapolated by the order
        that the last three show, at most the theoretical one, with 1.25 times the remainder as
        uncertainty on both sides. If they do not converge by order ½ at least, the last value is
        the limit, and the largest change is the uncertainty.

        Parameters
        ----------
        x : (levels,) sequence of float
            Values in the coordinate of the estimate, the coarsest first.
        least : float
            Lowest order that is considered if there are two values.
        """
        changes = np.diff(x)
        if not len(changes):
            return cls()
        last = float(changes[-1])
        if len(changes) == 1:
            remaining = last / (2**order - 1)
            slow_remaining = last / (2**least - 1) - remaining
            sides = sorted((-2 * remaining, slow_remaining))
            return cls(last + remaining, -sides[0], above=sides[1])
        ratio = float(changes[-2] / last) if last else np.inf
        if not ratio > 2**LEAST_ORDER:
            largest = float(np.abs(changes).max())
            return cls(float(changes.sum()), largest, above=largest)
        # No faster than in theory: a change that vanishes by chance promises nothing.
        observed_order = float(np.log2(ratio))
        remaining = last / (2 ** min(observed_order, order) - 1)
        uncertainty = OBSERVED * abs(remaining)
        return cls(
            float(changes.sum()) + remaining, uncertainty, above=uncertainty, order=observed_order
        )


def discretisation_error(
    name: str,
    estimate: Estimate,
    by_step: Sequence[float],
    by_mesh: Sequence[float],
    step_order: float = 2.0,
    linear: bool = False,
) -> DiscretisationError:
    """Compute the discretisation error from the values with finer steps and meshes.

    Parameters
    ----------
    name : str
        Name of the parameter or derived modulus.
    estimate : Estimate
        The answer with its statistical interval.
    by_step, by_mesh : sequences of float
        Values with the step, or the edge lengths, halved once, twice and so on; may be empty.
    linear : bool
        Whether the parameter is its own coordinate.

    Notes
    -----
    The order of the mesh is `MESH_ORDER`. All values are compared in one coordinate, which is
    linear if any of them is not positive. `step` and `mesh` of the result are the changes of the
    value itself with the first halving.
    """
    known = (estimate.value, *(estimate.statistical95 or ()), *by_step, *by_mesh)
    at = IntervalCoordinate.for_estimate(name, known, linear=linear)
    x = at.from_value(estimate.value)
    step = _Extrapolation.from_values(
        [x, *map(at.from_value, by_step)], step_order, least=step_order / 2
    )
    mesh = _Extrapolation.from_values(
        [x, *map(at.from_value, by_mesh)], MESH_ORDER, least=LEAST_ORDER
    )
    limit = x + step.change + mesh.change
    interval = None
    if estimate.statistical95 is not None:
        low, high = map(at.from_value, estimate.statistical95)
        down = float(np.hypot((high - low) / 2, step.below + mesh.below))
        up = float(np.hypot((high - low) / 2, step.above + mesh.above))
        interval = at.to_value(limit - down), at.to_value(limit + up)
    return DiscretisationError(
        by_step[0] - estimate.value if by_step else None,
        by_mesh[0] - estimate.value if by_mesh else None,
        step_order=step.order,
        mesh_order=mesh.order,
        extrapolated=at.to_value(limit),
        interval95=interval,
    )


def discretisation_errors(
    estimates: Mapping[str, Estimate],
    by_step: Sequence[Mapping[str, float]],
    by_mesh: Sequence[Mapping[str, float]],
    step_order: float,
    linear: Container[str],
) -> dict[str, DiscretisationError]:
    """Return the discretisation errors by name of all estimates whose values differ between the
    levels; others, such as fixed values, are left out.

    Parameters
    ----------
    by_step, by_mesh : sequences of mappings of str to float
        Values by name at each finer level, see `discretisation_error`.
    linear : container of str
        Names of the parameters that are their own coordinates.
    """
    errors = {}
    for name, estimate in estimates.items():
        steps, meshes = ([values[name] for values in level] for level in (by_step, by_mesh))
        if any(value != estimate.value for value in (*steps, *meshes)):
            errors[name] = discretisation_error(
                name,
                estimate,
                by_step=steps,
                by_mesh=meshes,
                step_order=step_order,
                linear=name in linear,
            )
    return errors


def extrapolated(change: Array, order: float) -> Array:
    """Return the change to infinitely small steps or elements from that to half their size."""
    return change * 2**order / (2**order - 1)


def change_in_observations(fit: LinearisedFit, residual_changes: Sequence[Array]) -> Array:
    """Return the change (p,) of all parameters, to first order, if the residuals change; parameters
    at a bound do not change.

    Parameters
    ----------
    residual_changes : sequence of (T, M, 3) arrays
        Changes of the residuals of each block, in units of σ, without Huber's weights.
    """
    return estimate_changes(fit, [each[..., None] for each in residual_changes])[:, 0]


def estimate_changes(fit: LinearisedFit, changes: Sequence[Array]) -> Array:
    """Return the changes (p, a) of all parameters of a fit, to first order, with a changes of the
    residuals; parameters at a bound do not change.

    Parameters
    ----------
    changes : sequence of (T, M, 3, a) arrays
        Changes of the residuals of each block, in units of σ; where nothing is measured they are
        ignored. Huber's weights are applied here.
    """
    free = np.flatnonzero(~fit.at_bound)
    count = changes[0].shape[-1] if changes else 0
    if not free.size:
        return np.zeros((len(fit.names), count))
    problem = SquareRootInformation.empty(len(free)).with_rows(
        np.zeros(len(free)), np.diag(fit.prior_jacobian[free])
    )
    score = np.zeros((len(free), count))
    for block, change in zip(fit.blocks, changes, strict=True):
        slope = block.jacobian[..., free]
        slope = slope.reshape(int(np.prod(slope.shape[:-1])), len(free))
        problem = problem.with_rows(np.zeros(len(slope)), slope)
        score += slope.T @ block.weighted(change).reshape(len(slope), count)
    estimates = np.zeros((len(fit.names), count))
    estimates[free] = -problem.root @ (problem.root.T @ score)
    return estimates
