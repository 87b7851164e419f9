"""Linearised fit at its answer: residuals of all samples and their derivatives along the equations
of motion.

The basis of all statistics. Estimated are the shared parameters q and nuisance parameters φ of
single experiments, such as the offset of a marker.

The sensitivities of the trajectory, Z = dx/dp along the equations of motion, follow from the
linearised constraints c_x Z + c_p = 0, solved forward in time by `program.sweep`; p are q and those
φ of an experiment that change its motion, see `Segment.moving`.

The information is factorised. With S the derivatives of all residuals and P those of the priors,
the information is A = SᵀS + PᵀP. With a root L, A⁻¹ = L Lᵀ, and D = S L, DᵀD + LᵀPᵀP L = I: a
covariance B of the score Sᵀe becomes L (LᵀB L) Lᵀ for the parameters, without any further inverse.
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
    """Return the sensitivities dx/dp of each experiment, (N, 3n, m) [m per unit of p].

    Prescribed dofs have zeros, and so has x_0 unless it follows as an equilibrium.

    Raises
    ------
    SimulationError
        If the equations of a step are singular.
    """
    return [
        np.stack(list(Sweep(part.segment).sensitivities(part.x, part.setting)))
        for part in collocation.parts(z)
    ]


@one_blas_thread()
def responses(collocation: Collocation, z: Array) -> list[Response]:
    """Return the changes of the observables of each experiment with its parameters, computed in
    parallel.

    Raises
    ------
    SimulationError
        If the equations of a step are singular.
    """

    def of(part: Part) -> Response:
        segment = part.segment
        grasp_forces = HeldForces.nothing(
            len(part.x), len(segment.sensed_dofs), len(segment.moving)
        )
        rows = Sweep(segment).sensitivities(part.x, part.setting, grasp_forces)
        return part.sensing.read_along(rows, grasp_forces)

    return side_by_side(of, collocation.parts(z), collocation.threads)


def marker_sensitivities(collocation: Collocation, z: Array) -> list[Array]:
    """Return the derivatives d(markers)/dp of each experiment at its samples, (T, 3M, m),
    see `Response`.
    """
    return [response.looked[0] for response in responses(collocation, z)]


Mask = NDArray[np.bool_]

# A parameter within this distance of a bound, in its logarithm, is at it: interior-point methods
# stay inside.
AT_BOUND = 1e-3
# Largest step of parameters at a bound; exactly zero would leave no interval.
NO_STEP = 1e-12


@dataclass(frozen=True, eq=False)
class FitBlock:
    """Residuals of one measurement of an experiment, with derivatives at the answer.

    Markers are the entities of the measurement; a wrench sensor has two, force and torque [N, N m],
    and a custom sensor one for each three numbers.

    Attributes
    ----------
    name : str
        Name of the experiment.
    t_s : (T,) array
        Times of the samples [s], equally spaced unless static.
    marker_names : (M,) tuple of str
        Names of the markers.
    present : (T, M) array of bool
        Samples that are compared.
    residual : (T, M, 3) array
        Residuals (h(x) − ŷ) / σ, zero where missing.
    slope : (T, M, 3, p) array
        Derivatives of the residuals by all p parameters, zero where missing.
    sigma_m : (M,) array
        Stated standard deviations.
    misfit : (T, M, 3) array or None
        Original residuals where Huber's loss has shortened those in `residual`; None if they are
        the same.
    components : (T, M, 3) array of bool or None
        Coordinates that exist; None if all three of a present sample do.
    stated : str
        Key of σ in the problem: "sigma_m" for positions.
    static : bool
        Whether samples are equilibria, which have no frequency.
    relaxed_first : bool
        Whether a memory is assumed relaxed at the first sample.
    places_m : (3M, 3) array or None
        Places of the channels on the undeformed body [m]; None if they have none.
    disturbances : (K, T, M, 3) array or None
        Samples of known errors of the residuals besides their noise, in units of σ.
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
        """Mask (T, M, 3) of the coordinates that exist."""
        if self.components is not None:
            return self.components
        return np.repeat(self.present[..., None], 3, axis=2)

    @property
    def wild(self) -> Mask:
        """Mask (T, M) of the samples beyond Huber's threshold."""
        if self.misfit is None:
            return np.zeros(self.present.shape, dtype=bool)
        return np.linalg.norm(self.misfit, axis=2) > np.linalg.norm(self.residual, axis=2) + 1e-9

    @property
    def weight(self) -> Array:
        """Square root (T, M, 1) of Huber's weights, which residuals and derivatives contain
        already.
        """
        if self.misfit is None:
            return np.ones((*self.present.shape, 1))
        long, short = (np.linalg.norm(r, axis=2) for r in (self.misfit, self.residual))
        share = np.divide(short, long, out=np.ones_like(long), where=long > 0)
        return np.sqrt(share)[..., None]

    @property
    def measurements(self) -> int:
        """Number of scalar measurements that are present."""
        return int(self.seen.sum())

    @cached_property
    def channels(self) -> tuple[Array, Array, Mask]:
        """Residuals (T, 3M), derivatives (T, 3M, p) and presence (T, 3M); column 3 m + axis."""
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
    values : mapping of str to float
        Moduli by name.
    by_q : mapping of str to (shared,) array
        Their derivatives by q.
    """

    values: Mapping[str, float]
    by_q: Mapping[str, Array]

    @classmethod
    def of(cls, constants: Iterable[ThetaMap], q: Array) -> Derived:
        """Compute the moduli of several bodies at q."""
        values: dict[str, float] = {}
        by_q: dict[str, Array] = {}
        for each in constants:
            moduli, slopes = each.derived(q)
            values |= dict(zip(each.derived_names, moduli.tolist(), strict=True))
            by_q |= dict(zip(each.derived_names, slopes, strict=True))
        return cls(values, by_q)


def values_of(collocation: Collocation, q: Array) -> dict[str, float]:
    """Return derived moduli and parameters by name, at q."""
    constants = (segment.constants for segment in collocation.segments)
    return {**Derived.of(constants, q).values, **collocation.parameters.values(q)}


@dataclass(frozen=True, eq=False)
class LinearisedFit:
    """Linearised least-squares problem at its answer.

    Attributes
    ----------
    blocks : tuple of FitBlock
        For each fitted experiment its markers, then its other measurements.
    names : (p,) tuple of str
        Shared parameters q, then φ with their unit in brackets: ``"gravity/offset Tip1 x [m]"``.
    shared : int
        Number of shared parameters.
    prior_residual, prior_slope : (p,) arrays
        Residuals of the priors and their derivatives, in standard deviations; zero without a prior.
    at_bound : (p,) array of bool
        Parameters that ended at a bound.
    derived : Derived
        Moduli that follow from the shared parameters.
    of_phases : (shared, shared) array or None
        Covariance of q due to unknown phases of a two-phase field, in the solver's coordinates;
        None without such a field.
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
        """Number of scalar measurements that are present."""
        return sum(block.measurements for block in self.blocks)

    def disturbed(self, samples: Iterable[Array | None]) -> LinearisedFit:
        """Return the fit with samples of known errors of the residuals for each block; None
        where there are none.
        """
        pairs = zip(self.blocks, samples, strict=True)
        return replace(self, blocks=tuple(replace(b, disturbances=each) for b, each in pairs))

    def after(self, step: Array) -> LinearisedFit:
        """Return the fit after a step (p,) of all parameters, to first order."""
        blocks_after = (replace(b, residual=b.residual + b.slope @ step) for b in self.blocks)
        at_best = self.prior_residual + self.prior_slope * step
        return replace(self, blocks=tuple(blocks_after), prior_residual=at_best)

    @property
    def chi_squared(self) -> float:
        """Sum of squared residuals of all measurements, without priors."""
        return float(sum(np.sum(block.residual**2) for block in self.blocks))


def linearised_fit(collocation: Collocation, z: Array) -> LinearisedFit:
    """Linearise a fit at a solution.

    Parameters
    ----------
    collocation : Collocation
        The program.
    z : (variables,) array
        The optimum, which satisfies the equations of motion.

    Raises
    ------
    SimulationError
        If the equations of motion are singular.
    """
    p = collocation.parameters_of(z)
    blocks = []
    for part, response in zip(collocation.parts(z), responses(collocation, z), strict=True):
        segment = part.segment
        experiment = part.segment.experiment
        relaxed = segment.body.remembers and bool(np.isinf(experiment.loaded_since_s))
        linearised = part.sensing.linearised(part.x, response)
        for reading, (misfit, by_own) in zip(segment.readings, linearised, strict=True):
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
    """Return the covariance (nq, nq) of q due to unknown phases; None if there is no
    two-phase field.
    """
    names = [item.name for item in collocation.parameters.free]
    covariance: Array | None = None
    for body in dict.fromkeys(segment.body for segment in collocation.segments):
        for samples in body.phase_samples:
            places = [k for k, name in enumerate(samples.names) if name in names]
            own = [names.index(samples.names[k]) for k in places]
            covariance = np.zeros((len(names), len(names))) if covariance is None else covariance
            covariance[np.ix_(own, own)] += samples.deviations[np.ix_(places, places)]
    return covariance


@dataclass(frozen=True, eq=False)
class Information:
    """Information of residuals and priors about all parameters, in the r directions that are
    determined.

    Parameters at a bound are free here: with other noise they would not have ended there, and their
    correlation with the other parameters is part of those parameters' error.

    Attributes
    ----------
    fit : LeastSquares
        Triangle of all rows; its root is L.
    slopes : tuple of (T, 3M, r) arrays
        D = S L of each block; zero where missing.
    prior : (r, r) array
        Lᵀ PᵀP L.
    """

    fit: LeastSquares
    slopes: tuple[Array, ...]
    prior: Array

    @property
    def fitted(self) -> float:
        """Number of parameters that the data determine; one that a prior determines counts
        in part.
        """
        return float(sum(np.sum(slope**2) for slope in self.slopes))


def information(fit: LinearisedFit) -> Information:
    """Factorise the information of a fit."""
    all_rows = least_squares(fit)
    slopes = tuple(block.channels[1] @ all_rows.root for block in fit.blocks)
    prior = all_rows.root * fit.prior_slope[:, None]
    return Information(all_rows, slopes, prior.T @ prior)


def least_squares(fit: LinearisedFit) -> LeastSquares:
    """Return residuals and priors as a least-squares problem in a step of all parameters."""
    of_all = rows_of(fit, range(len(fit.blocks)))
    return of_all.add(fit.prior_residual, np.diag(fit.prior_slope))


def rows_of(fit: LinearisedFit, numbers: Iterable[int]) -> LeastSquares:
    """Return the residuals of some blocks (indices) as a least-squares problem, without priors."""
    problem = LeastSquares.none(len(fit.names))
    for k in numbers:
        residual, slope, _ = fit.blocks[k].channels
        problem = problem.add(residual.ravel(), slope.reshape(residual.size, slope.shape[2]))
    return problem


def best_step(fit: LinearisedFit) -> Array:
    """Return the step (p,) to the least squares of the linearised fit; parameters at a
    bound do not change.
    """
    free = np.where(fit.at_bound, NO_STEP, np.inf)
    return least_squares(fit).best(-free, free)
