"""The fit near its answer: residuals of all samples and their slopes along the motion equations.

Everything the statistics need to know of a fit. Estimated are the shared parameters, q, and
possibly nuisance parameters of single experiments, such as the offset of a marker on the body.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..nlp.collocation import Collocation
from ..nlp.parameters import ThetaMap
from .sensitivity import marker_sensitivities

Mask = NDArray[np.bool_]

# A parameter this near a bound, in its logarithm, is at it: interior-point methods stay inside.
AT_BOUND = 1e-3


@dataclass(frozen=True, eq=False)
class FitBlock:
    """One experiment's residuals and their slopes at the answer.

    Attributes
    ----------
    name : str
        Of the experiment.
    t_s : (T,) sample times, equally spaced unless static
    marker_names : (M,)
    present : (T, M) bool
    residual : (T, M, 3) (h(x) − ŷ) / σ, zero where missing
    slope : (T, M, 3, p) derivative of the residual by all p parameters, zero where missing
    sigma_m : (M,) standard deviations given
    misfit : (T, M, 3), optional
        Residuals as they are, where Huber's loss has shortened those in `residual`.
    static : bool
        Whether samples are equilibria, of which no frequency can be told.
    """

    name: str
    t_s: Array
    marker_names: tuple[str, ...]
    present: Mask
    residual: Array
    slope: Array
    sigma_m: Array
    misfit: Array | None = None
    static: bool = False

    @property
    def wild(self) -> Mask:
        """(T, M) samples beyond Huber's threshold."""
        if self.misfit is None:
            return np.zeros(self.present.shape, dtype=bool)
        return np.linalg.norm(self.misfit, axis=2) > np.linalg.norm(self.residual, axis=2) + 1e-9

    @property
    def measurements(self) -> int:
        """Scalar measurements that are present."""
        return 3 * int(self.present.sum())

    @cached_property
    def channels(self) -> tuple[Array, Array, Mask]:
        """Residuals (T, 3M), slopes (T, 3M, p) and presence (T, 3M); column 3 m + axis."""
        samples, markers = self.present.shape
        return (
            self.residual.reshape(samples, 3 * markers),
            self.slope.reshape(samples, 3 * markers, self.slope.shape[-1]),
            np.repeat(self.present, 3, axis=1),
        )


@dataclass(frozen=True, eq=False)
class Derived:
    """Moduli that follow from the estimated parameters.

    Attributes
    ----------
    values : by name
    by_q : by name, (shared,) derivatives
    """

    values: Mapping[str, float]
    by_q: Mapping[str, Array]

    @classmethod
    def of(cls, constants: Iterable[ThetaMap], q: Array) -> Derived:
        """Those of several bodies."""
        values: dict[str, float] = {}
        by_q: dict[str, Array] = {}
        for each in constants:
            found, slopes = each.derived(q)
            values |= dict(zip(each.derived_names, found.tolist(), strict=True))
            by_q |= dict(zip(each.derived_names, slopes, strict=True))
        return cls(values, by_q)


@dataclass(frozen=True, eq=False)
class LinearisedFit:
    """The least-squares problem at its answer.

    Attributes
    ----------
    blocks : tuple of FitBlock
        One per fitted experiment.
    names : (p,) the shared parameters first, which are q; then φ, with their unit in
        brackets: ``"gravity/offset Tip1 x [m]"``
    shared : int
        Number of shared parameters.
    prior_residual, prior_slope : (p,) in units of the prior's deviation, zero without a prior
    at_bound : (p,) bool
        Parameters that ended at a bound.
    derived : Derived
        What follows from the shared parameters.
    """

    blocks: tuple[FitBlock, ...]
    names: tuple[str, ...]
    shared: int
    prior_residual: Array
    prior_slope: Array
    at_bound: Mask
    derived: Derived = field(default_factory=lambda: Derived({}, {}))

    @property
    def measurements(self) -> int:
        """Scalar measurements that are present."""
        return sum(block.measurements for block in self.blocks)

    @property
    def chi_squared(self) -> float:
        """Σ residual² of the markers, without priors."""
        return float(sum(np.sum(block.residual**2) for block in self.blocks))


def linearised_fit(
    collocation: Collocation, z: Array, marker_z: Sequence[Array] | None = None
) -> LinearisedFit:
    """The fit near a solution.

    Parameters
    ----------
    collocation : Collocation
    z : (variables,) a point that satisfies the equations of motion, the optimum
    marker_z : sequence of (T, 3M, nq), optional
        `marker_sensitivities`, where they are known already.

    Raises
    ------
    SimulationError
        Where the equations of motion are singular.
    """
    p = collocation.parameters_of(z)
    if marker_z is None:
        marker_z = marker_sensitivities(collocation, z)
    blocks = []
    for part, by_p in zip(collocation.parts(z), marker_z, strict=True):
        segment, markers = part.segment, part.segment.experiment.markers
        residual, here = segment.observation.linearised(
            part.x, part.phi, by_p, segment.moving, collocation.nq
        )
        slope = np.zeros((*residual.shape, len(p)))
        slope[..., segment.places] = here
        misfit = residual
        if collocation.huber is not None:
            residual, slope = _reweighted(residual, slope, collocation.huber)
        blocks.append(
            FitBlock(
                name=segment.experiment.name,
                t_s=markers.t_s,
                marker_names=markers.names,
                present=segment.observation.present,
                residual=residual,
                slope=slope,
                sigma_m=markers.sigma_m,
                misfit=misfit,
                static=segment.experiment.static,
            )
        )
    prior_residual, prior_slope = collocation.prior(p)
    lower, upper = collocation.bounds_p
    return LinearisedFit(
        blocks=tuple(blocks),
        names=collocation.names,
        shared=collocation.nq,
        prior_residual=prior_residual,
        prior_slope=prior_slope,
        at_bound=(p - lower < AT_BOUND) | (upper - p < AT_BOUND),
        derived=Derived.of((s.constants for s in collocation.segments), p[: collocation.nq]),
    )


def _reweighted(residual: Array, slope: Array, threshold: float) -> tuple[Array, Array]:
    """Samples beyond Huber's threshold as it sees them.

    Slopes have the weight of the fit's normal equations; residuals end at the threshold, so that a
    few wild samples tell nothing of the others' noise.
    """
    length = np.linalg.norm(residual, axis=2)
    weight = (threshold / np.maximum(length, threshold))[..., None]
    return residual * weight, slope * np.sqrt(weight)[..., None]
