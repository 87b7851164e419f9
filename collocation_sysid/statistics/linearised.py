"""The fit near its answer: residuals of all samples and their slopes along the motion equations.

Everything the statistics need to know of a fit. Estimated are the shared parameters, q, and
possibly nuisance parameters of single experiments, such as the offset of a marker on the body.

How the trajectory follows the parameters, Z = dx/dp with the equations of motion kept, is found
from the linearised constraints c_x Z + c_p = 0, solved forward in time by `program.sweep`; p are
the shared parameters q and those φ of an experiment that move its body, see `Segment.moving`.

The information is factored, in coordinates where the statistics are simple. With S the slopes of
all residuals and P the priors' slopes, the information is A = SᵀS + PᵀP. The root L with A⁻¹ = L Lᵀ
turns S into D = S L, for which DᵀD + LᵀPᵀP L = I: a covariance B of the score Sᵀe becomes L (LᵀB L)
Lᵀ for the parameters, without any further inverse.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..fem.kernels import side_by_side
from ..model.parameters import ThetaMap
from ..program.collocation import Collocation, Part
from ..program.lapack import one_blas_thread
from ..program.least_squares import LeastSquares
from ..program.reaction import HeldForces
from ..program.reading import as_weights
from ..program.sensing import Response
from ..program.sweep import Sweep


def sensitivities(collocation: Collocation, z: Array) -> list[Array]:
    """dx/dp of each experiment, (N, 3n, m) in metres per unit of p.

    Held dofs have zeros, and so has x_0 unless it is found in equilibrium.

    Raises
    ------
    SimulationError
        Where the equations of a step are singular.
    """
    return [
        np.stack(list(Sweep(part.segment).sensitivities(part.x, part.setting)))
        for part in collocation.parts(z)
    ]


@one_blas_thread()
def responses(collocation: Collocation, z: Array) -> list[Response]:
    """The response of each experiment; needs no more memory than the result.

    Raises
    ------
    SimulationError
        Where the equations of a step are singular.
    """

    def of(part: Part) -> Response:
        segment = part.segment
        held = HeldForces.nothing(len(part.x), len(segment.sensed_dofs), len(segment.moving))
        rows = Sweep(segment).sensitivities(part.x, part.setting, held)
        return part.sensing.read_along(rows, held)

    return side_by_side(of, collocation.parts(z), collocation.threads)


def marker_sensitivities(collocation: Collocation, z: Array) -> list[Array]:
    """d(markers)/dp of each experiment at its samples, (T, 3M, m), see `Response`."""
    return [response.looked[0] for response in responses(collocation, z)]


Mask = NDArray[np.bool_]

# A parameter this near a bound, in its logarithm, is at it: interior-point methods stay inside.
AT_BOUND = 1e-3
NO_STEP = 1e-12


@dataclass(frozen=True, eq=False)
class FitBlock:
    """Residuals of one of an experiment's readings, and slopes at the answer.

    A sensor of a wrench has two "markers", its force and its torque, in newtons and newton metres;
    a reading of one's own has one for each three numbers.

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
    stated : str
        What states σ in the problem: "sigma_m" of places.
    static : bool
        Whether samples are equilibria, of which no frequency can be told.
    relaxed_first : bool
        Whether a memory counts as relaxed at the first sample.
    places_m : (3M, 3), optional
        Where channels are on the undeformed body.
    disturbances : (K, T, M, 3), optional
        Samples of what the residuals have besides their noise, in units of σ.
    noise_at_least_stated : bool
        See `Reading`.
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
    stated: str = "sigma_m"
    static: bool = False
    relaxed_first: bool = False
    places_m: Array | None = None
    disturbances: Array | None = None
    noise_at_least_stated: bool = False

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
    def weight(self) -> Array:
        """(T, M, 1) root of Huber's weights, which residuals and slopes have already."""
        if self.misfit is None:
            return np.ones((*self.present.shape, 1))
        long, short = (np.linalg.norm(r, axis=2) for r in (self.misfit, self.residual))
        share = np.divide(short, long, out=np.ones_like(long), where=long > 0)
        return np.sqrt(share)[..., None]

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


def values_of(collocation: Collocation, q: Array) -> dict[str, float]:
    """Moduli that follow from the parameters, and the parameters, by name."""
    constants = (segment.constants for segment in collocation.segments)
    return {**Derived.of(constants, q).values, **collocation.parameters.values(q)}


@dataclass(frozen=True, eq=False)
class LinearisedFit:
    """The least-squares problem at its answer.

    Attributes
    ----------
    blocks : tuple of FitBlock
        Of each fitted experiment that of its markers, then those of its other readings.
    names : (p,) the shared parameters first, which are q; then φ, with their unit in
        brackets: ``"gravity/offset Tip1 x [m]"``
    shared : int
        Number of shared parameters.
    prior_residual, prior_slope : (p,) in units of the prior's deviation, zero without a prior
    at_bound : (p,) bool
        Parameters that ended at a bound.
    derived : Derived
        What follows from the shared parameters.
    of_phases : (shared, shared) or None
        Covariance that unknown phases of a two-phase field add to that of the shared parameters,
        in the solver's coordinates; None without such a field.
    """

    blocks: tuple[FitBlock, ...]
    names: tuple[str, ...]
    shared: int
    prior_residual: Array
    prior_slope: Array
    at_bound: Mask
    derived: Derived = field(default_factory=lambda: Derived({}, {}))
    of_phases: Array | None = None

    @property
    def measurements(self) -> int:
        """Scalar measurements that are present."""
        return sum(block.measurements for block in self.blocks)

    def disturbed(self, samples: Iterable[Array | None]) -> LinearisedFit:
        """The same with what is known of each block's residuals besides their noise."""
        pairs = zip(self.blocks, samples, strict=True)
        return replace(self, blocks=tuple(replace(b, disturbances=each) for b, each in pairs))

    def after(self, step: Array) -> LinearisedFit:
        """The same after a step (p,) of all parameters, to first order."""
        moved = (replace(b, residual=b.residual + b.slope @ step) for b in self.blocks)
        at_best = self.prior_residual + self.prior_slope * step
        return replace(self, blocks=tuple(moved), prior_residual=at_best)

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
    p = collocation.parameters_of(z)
    blocks = []
    for part, response in zip(collocation.parts(z), responses(collocation, z), strict=True):
        segment = part.segment
        experiment = part.segment.experiment
        relaxed = segment.body.remembers and bool(np.isinf(experiment.loaded_since_s))
        found = part.sensing.linearised(part.x, response)
        for reading, (misfit, by_own) in zip(segment.readings, found, strict=True):
            residual, by_own = as_weights(misfit, by_own, reading.huber)
            residual, misfit, by_own = map(reading.pooled, (residual, misfit, by_own))
            slope = np.zeros((*residual.shape, len(p)))
            slope[..., segment.places] = by_own
            blocks.append(
                FitBlock(
                    name=experiment.name,
                    t_s=reading.t_s,
                    marker_names=reading.pool.names,
                    present=np.asarray(reading.pool.components.any(axis=2)),
                    residual=residual,
                    slope=slope,
                    sigma_m=reading.pool.sigmas,
                    misfit=misfit,
                    components=reading.pool.components,
                    stated=reading.stated,
                    static=experiment.static,
                    relaxed_first=relaxed,
                    places_m=reading.pool.places_m,
                    noise_at_least_stated=reading.noise_at_least_stated,
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
        of_phases=_covariance_by_phases(collocation),
    )


def _covariance_by_phases(collocation: Collocation) -> Array | None:
    """Return what unknown phases add to the covariance (nq, nq) of q; None if there are none."""
    names = [item.name for item in collocation.parameters.free]
    found: Array | None = None
    for body in dict.fromkeys(segment.body for segment in collocation.segments):
        for samples in body.phase_samples:
            places = [k for k, name in enumerate(samples.names) if name in names]
            own = [names.index(samples.names[k]) for k in places]
            found = np.zeros((len(names), len(names))) if found is None else found
            found[np.ix_(own, own)] += samples.deviations[np.ix_(places, places)]
    return found


@dataclass(frozen=True, eq=False)
class Information:
    """What residuals and priors say of all parameters, by the r directions that are determined.

    Those that ended at a bound are free here like the others: had the noise been another, they
    would not have, and what they can take from the others belongs to these others' error.

    Attributes
    ----------
    fit : LeastSquares
        Its root is L.
    slopes : of each experiment (T, 3M, r), D = S L; zero where missing
    prior : (r, r) Lᵀ PᵀP L
    """

    fit: LeastSquares
    slopes: tuple[Array, ...]
    prior: Array

    @property
    def fitted(self) -> float:
        """Number of parameters the data determine; one that a prior determines counts in part."""
        return float(sum(np.sum(slope**2) for slope in self.slopes))


def information(fit: LinearisedFit) -> Information:
    """Factor the information of a fit."""
    all_rows = least_squares(fit)
    slopes = tuple(block.channels[1] @ all_rows.root for block in fit.blocks)
    prior = all_rows.root * fit.prior_slope[:, None]
    return Information(all_rows, slopes, prior.T @ prior)


def least_squares(fit: LinearisedFit) -> LeastSquares:
    """Residuals and priors by a step of all parameters."""
    of_all = rows_of(fit, range(len(fit.blocks)))
    return of_all.add(fit.prior_residual, np.diag(fit.prior_slope))


def rows_of(fit: LinearisedFit, numbers: Iterable[int]) -> LeastSquares:
    """Residuals of some blocks, without priors."""
    found = LeastSquares.none(len(fit.names))
    for k in numbers:
        residual, slope, _ = fit.blocks[k].channels
        found = found.add(residual.ravel(), slope.reshape(residual.size, slope.shape[2]))
    return found


def best_step(fit: LinearisedFit) -> Array:
    """(p,) step of the parameters to the least squares of what is linearised; at a bound none."""
    free = np.where(fit.at_bound, NO_STEP, np.inf)
    return least_squares(fit).best(-free, free)
