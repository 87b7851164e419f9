"""The fit near its answer: residuals of all samples and their slopes along the motion equations.

Everything the statistics need to know of a fit. Estimated are the shared parameters, q, and
possibly nuisance parameters of single experiments, such as the offset of a marker on the body.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..model.parameters import ThetaMap
from ..program.collocation import Collocation
from ..program.reading import as_weights
from .sensitivity import responses

Mask = NDArray[np.bool_]

# A parameter this near a bound, in its logarithm, is at it: interior-point methods stay inside.
AT_BOUND = 1e-3


@dataclass(frozen=True, eq=False)
class FitBlock:
    """Residuals of an experiment's markers, or of one of its sensors, and slopes at the answer.

    A sensor has two "markers", its force and its torque, in newtons and newton metres.

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
    components : (T, M, 3) bool, optional
        Coordinates that are there, where not all three of a sample need be.
    of_sensor : bool
        Of a sensor, not of markers.
    static : bool
        Whether samples are equilibria, of which no frequency can be told.
    relaxed_first : bool
        Whether a memory counts as relaxed at the first sample.
    """

    name: str
    t_s: Array
    marker_names: tuple[str, ...]
    present: Mask
    residual: Array
    slope: Array
    sigma_m: Array
    misfit: Array | None = None
    components: Mask | None = None
    of_sensor: bool = False
    static: bool = False
    relaxed_first: bool = False

    @cached_property
    def seen(self) -> Mask:
        """(T, M, 3) coordinates that are there."""
        if self.components is not None:
            return self.components
        return np.repeat(self.present[..., None], 3, axis=2)

    @property
    def wild(self) -> Mask:
        """(T, M) samples beyond Huber's threshold."""
        if self.misfit is None:
            return np.zeros(self.present.shape, dtype=bool)
        return np.linalg.norm(self.misfit, axis=2) > np.linalg.norm(self.residual, axis=2) + 1e-9

    @property
    def measurements(self) -> int:
        """Scalar measurements that are present."""
        return int(self.seen.sum())

    @cached_property
    def channels(self) -> tuple[Array, Array, Mask]:
        """Residuals (T, 3M), slopes (T, 3M, p) and presence (T, 3M); column 3 m + axis."""
        samples, markers = self.present.shape
        return (
            self.residual.reshape(samples, 3 * markers),
            self.slope.reshape(samples, 3 * markers, self.slope.shape[-1]),
            self.seen.reshape(samples, 3 * markers),
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
        Of each fitted experiment that of its markers, then those of its sensors.
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
        """Σ residual² of markers and wrenches, without priors."""
        return float(sum(np.sum(block.residual**2) for block in self.blocks))


def linearised_fit(collocation: Collocation, z: Array) -> LinearisedFit:
    """The fit near a solution.

    Parameters
    ----------
    collocation : Collocation
    z : (variables,) a point that satisfies the equations of motion, the optimum

    Raises
    ------
    SimulationError
        Where the equations of motion are singular.
    """
    p, blocks = collocation.parameters_of(z), []
    for part, response in zip(collocation.parts(z), responses(collocation, z), strict=True):
        segment, experiment = part.segment, part.segment.experiment
        relaxed = segment.body.remembers and bool(np.isinf(experiment.loaded_since_s))
        found = part.sensing.linearised(part.x, response)
        for reading, (misfit, by_own) in zip(segment.readings, found, strict=True):
            residual, by_own = as_weights(misfit, by_own, collocation.huber)
            slope = np.zeros((*residual.shape, len(p)))
            slope[..., segment.places] = by_own
            blocks.append(
                FitBlock(
                    name=experiment.name,
                    t_s=reading.t_s,
                    marker_names=reading.names,
                    present=np.asarray(reading.components.any(axis=2)),
                    residual=residual,
                    slope=slope,
                    sigma_m=reading.sigmas,
                    misfit=misfit,
                    components=reading.components,
                    of_sensor=reading is not segment.markers,
                    static=experiment.static,
                    relaxed_first=relaxed,
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
