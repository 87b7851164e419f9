"""Linearised fit at its answer: residuals of all samples and their derivatives along the equations
of motion.

The basis of all statistics. Estimated are the shared parameters q and nuisance parameters φ of
single experiments, such as the offset of a marker.

The sensitivities of the trajectory, Z = dx/dp along the equations of motion, follow from the
linearised constraints c_x Z + c_p = 0, solved forward in time by `program.sweep`; p are q and those
φ of an experiment that change its motion, see `Transcription.dynamic_parameters`.

The information is factorised. With S the derivatives of all residuals and P those of the priors,
the information is A = SᵀS + PᵀP. With a root L, A⁻¹ = L Lᵀ, and D = S L, DᵀD + LᵀPᵀP L = I: a
covariance B of the score Sᵀe becomes L (LᵀB L) Lᵀ for the parameters, without any further inverse.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, wraps
from typing import NamedTuple, TypeVar
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from ..common.array_types import Array
from ..fem.kernels import map_experiments
from ..model.parameters import ThetaMap
from ..program.collocation import Collocation, ExperimentIterate
from ..program.least_squares import SquareRootInformation
from ..program.linear_algebra.lapack import one_blas_thread
from ..program.measurement_residual import huber_as_weights
from ..program.observable_response import ObservableResponse
from ..program.reactions.forces import GraspForces
from ..program.sweep import Sweep

Owner = TypeVar("Owner")
Result = TypeVar("Result")


def known_at_last(function: Callable[[Owner, Array], Result]) -> Callable[[Owner, Array], Result]:
    """Return a function of an object and an array that computes its result again only for another
    array than the last one of this object: several checks of one answer need the same.

    The object must be compared by identity, and the result must not be changed.
    """
    known: WeakKeyDictionary[Owner, tuple[bytes, Result]] = WeakKeyDictionary()

    @wraps(function)
    def of(owner: Owner, at: Array) -> Result:
        key = at.tobytes()
        last = known.get(owner)
        if last is None or last[0] != key:
            last = known[owner] = key, function(owner, at)
        return last[1]

    return of


@one_blas_thread()
def observable_responses(collocation: Collocation, z: Array) -> list[ObservableResponse]:
    """Return the changes of the observables of each experiment with its parameters, computed in
    parallel.

    Parameters
    ----------
    z : (variables,) array
        Variables that satisfy the equations of motion.

    Raises
    ------
    SimulationError
        If the equations of a step are singular.
    """

    def of(iterate: ExperimentIterate) -> ObservableResponse:
        transcription = iterate.transcription
        grasp_forces = GraspForces.zeros(
            len(iterate.x),
            len(transcription.sensed_dofs),
            columns=len(transcription.dynamic_parameters),
        )
        rows = Sweep(transcription).sensitivities(
            iterate.x, iterate.equations, grasp_forces=grasp_forces
        )
        return ObservableResponse.from_rows(iterate, rows, grasp_forces)

    return map_experiments(of, collocation.iterates(z), threads=collocation.threads)


Mask = NDArray[np.bool_]

# A parameter within this distance of a bound, in its logarithm, is at it: interior-point methods
# stay inside.
AT_BOUND = 1e-3
# Largest step of parameters at a bound; exactly zero would leave no interval.
NO_STEP = 1e-12


class Channels(NamedTuple):
    """Residuals of one measurement, with column 3 m + axis for each axis of marker m."""

    residual: Array  # (T, 3M): residuals in units of σ, zero where missing
    jacobian: Array  # (T, 3M, p): their derivatives by all p parameters
    is_measured: Mask  # (T, 3M) of bool: coordinates that exist


@dataclass(frozen=True, eq=False)
class ResidualBlock:
    """Residuals of one measurement of an experiment, with derivatives at the answer.

    Markers are the entities of the measurement; a sensor of a grasp has two, force and torque [N, N
    m], and a custom sensor one for each three numbers.
    """

    name: str  # name of the experiment
    t_s: Array  # (T,): times of the samples [s], equally spaced unless static
    marker_names: tuple[str, ...]  # (M,) tuple of str: names of the markers
    is_present: Mask  # (T, M) of bool: samples that are compared
    residual: Array  # (T, M, 3): residuals (h(x) − ŷ) / σ, zero where missing
    # (T, M, 3, p): derivatives of the residuals by all p parameters, zero where missing.
    jacobian: Array
    sigma_m: Array  # (M,): stated standard deviations
    # (T, M, 3) or None: original residuals where Huber's loss has shortened those in `residual`;
    # None if they are the same.
    misfit: Array | None = None
    # (T, M, 3) of bool or None: coordinates that exist; None if all three of a present sample do.
    components: Mask | None = None
    sigma_key: str = "sigma_m"  # key of σ in the problem: "sigma_m" for positions
    is_static: bool = False  # whether samples are equilibria, which have no frequency
    is_relaxed_at_start: bool = False  # whether a memory is assumed relaxed at the first sample
    # (3M, 3) or None: places of the channels on the undeformed body [m]; None if they have none.
    places_m: Array | None = None
    # (K, T, M, 3) or None: samples of known errors of the residuals besides their noise, in units
    # of σ.
    disturbances: Array | None = None
    has_noise_floor: bool = False  # see `MeasurementResidual`
    sigma_ratios: Array | float = 1.0  # (T, M, 3) or float: σ of each number over `sigma_m`
    errs_slowly: bool = False  # see `MeasurementResidual`

    @cached_property
    def is_measured(self) -> Mask:
        """Mask (T, M, 3) of the coordinates that exist: `components`, or all three of each present
        sample.
        """
        if self.components is not None:
            return self.components
        return np.repeat(self.is_present[..., None], 3, axis=2)

    @property
    def outliers(self) -> Mask:
        """Mask (T, M) of the samples whose residual Huber's loss has shortened; all
        false without Huber's loss (`misfit` is None).
        """
        if self.misfit is None:
            return np.zeros(self.is_present.shape, dtype=bool)
        return np.linalg.norm(self.misfit, axis=2) > np.linalg.norm(self.residual, axis=2) + 1e-9

    def compute_root_weight(self) -> Array:
        """Return the square root (T, M, 1) of Huber's weights, which residuals and derivatives
        contain already; 1 without Huber's loss.
        """
        if self.misfit is None:
            return np.ones((*self.is_present.shape, 1))
        long, short = (np.linalg.norm(r, axis=2) for r in (self.misfit, self.residual))
        share = np.divide(short, long, out=np.ones_like(long), where=long > 0)
        return np.sqrt(share)[..., None]

    def changed(self, change: Array) -> ResidualBlock:
        """Return the block after a change (T, M, 3) of its residuals, which has Huber's weights."""
        misfit = self.misfit
        if misfit is not None:
            misfit = misfit + change / self.compute_root_weight()
        return replace(self, residual=self.residual + change, misfit=misfit)

    def weighted(self, changes: Array) -> Array:
        """Return changes (T, M, 3, a) of the residuals with Huber's weights; zero where nothing is
        measured.
        """
        return changes * (self.compute_root_weight() * self.is_measured)[..., None]

    def may_be_slow_errors(self) -> bool:
        """Return whether the instrument may err slowly, and the residuals are within its σ."""
        return self.errs_slowly and bool(np.sum(self.residual**2) <= self.measurement_count)

    @property
    def measurement_count(self) -> int:
        """Number of coordinates that exist: of scalar measurements in this block."""
        return int(self.is_measured.sum())

    @cached_property
    def channels(self) -> Channels:
        """Residuals, derivatives and presence with one column for each coordinate of a marker."""
        samples, markers = self.is_present.shape
        return Channels(
            self.residual.reshape(samples, 3 * markers),
            self.jacobian.reshape(samples, 3 * markers, self.jacobian.shape[-1]),
            is_measured=self.is_measured.reshape(samples, 3 * markers),
        )


@dataclass(frozen=True, eq=False)
class DerivedModuli:
    """Moduli that follow from the estimated parameters."""

    values: Mapping[str, float]  # mapping of str to float: moduli by name
    derivatives: Mapping[str, Array]  # mapping of str to (shared,): their derivatives by q

    @classmethod
    def from_bodies(cls, constants: Iterable[ThetaMap], q: Array) -> DerivedModuli:
        """Compute the moduli of several bodies at q (nq,); of moduli with the same name, those of
        the last body count.

        Parameters
        ----------
        constants : iterable of ThetaMap
            Constants of each body as functions of q.
        q : (nq,) array
            Shared parameters in the solver's coordinates.
        """
        values: dict[str, float] = {}
        by_q: dict[str, Array] = {}
        for each in constants:
            moduli, slopes = each.derived_moduli(q)
            values |= dict(zip(each.derived_names, moduli.tolist(), strict=True))
            by_q |= dict(zip(each.derived_names, slopes, strict=True))
        return cls(values, by_q)


def parameter_values(collocation: Collocation, q: Array) -> dict[str, float]:
    """Return derived moduli, then all parameters (fixed ones too) by name, in SI units, at q (nq,)
    in the solver's coordinates.
    """
    constants = (transcription.constants for transcription in collocation.transcriptions)
    return {**DerivedModuli.from_bodies(constants, q).values, **collocation.parameters.values(q)}


@dataclass(frozen=True, eq=False)
class LinearisedFit:
    """Linearised least-squares problem at its answer.

    Attributes
    ----------
    blocks : tuple of ResidualBlock
        For each fitted experiment its markers, then its other measurements.
    names : (p,) tuple of str
        Shared parameters q, then φ with their unit in brackets: ``"gravity/offset Tip1 x [m]"``.
    shared_count : int
        Number of shared parameters.
    prior_residual, prior_jacobian : (p,) arrays
        Residuals of the priors and their derivatives, in standard deviations; zero without a prior.
    at_bound : (p,) array of bool
        Parameters that ended at a bound.
    derived : DerivedModuli
        Moduli that follow from the shared parameters.
    effect_count : int
        Number of effects of the budget among the parameters, the last ones, in standard deviations
        of their priors. Statistical covariances do not contain these priors.
    """

    blocks: tuple[ResidualBlock, ...]
    names: tuple[str, ...]
    shared_count: int
    prior_residual: Array
    prior_jacobian: Array
    at_bound: Mask
    derived: DerivedModuli = field(default_factory=lambda: DerivedModuli({}, {}))
    effect_count: int = 0

    @property
    def measurement_count(self) -> int:
        """Number of scalar measurements of all blocks, without priors."""
        return sum(block.measurement_count for block in self.blocks)

    def with_disturbances(self, samples: Iterable[Array | None]) -> LinearisedFit:
        """Return the fit with samples of known errors of the residuals, which replace those of
        before.

        Parameters
        ----------
        samples : iterable of (K, T, M, 3) array or None
            For each block; None for a block without known errors.
        """
        pairs = zip(self.blocks, samples, strict=True)
        return replace(self, blocks=tuple(replace(b, disturbances=each) for b, each in pairs))

    def after_step(self, step: Array) -> LinearisedFit:
        """Return the fit after a step (p,) of all parameters, to first order: with changed
        residuals of measurements and priors and the same derivatives.

        `derived` and `at_bound` are not changed, nor which residuals are shortened.
        """
        blocks_after = (b.changed(b.jacobian @ step) for b in self.blocks)
        at_best = self.prior_residual + self.prior_jacobian * step
        return replace(self, blocks=tuple(blocks_after), prior_residual=at_best)

    def with_columns(
        self, names: Sequence[str], changes: Sequence[Array], means: Array | None = None
    ) -> LinearisedFit:
        """Return the fit with further parameters, which are its effects.

        Parameters
        ----------
        changes : sequence of (T, M, 3, a) arrays
            Changes of the residuals of each block by the parameters, in σ.
        means : (a,) array, optional
            Means of their priors, of which the standard deviation is 1; without, they have none.
        """
        count = len(names)
        slopes = np.full(count, float(means is not None))
        jacobians = (
            np.concatenate([block.jacobian, block.weighted(change)], axis=3)
            for block, change in zip(self.blocks, changes, strict=True)
        )
        return replace(
            self,
            blocks=tuple(
                replace(b, jacobian=j) for b, j in zip(self.blocks, jacobians, strict=True)
            ),
            names=(*self.names, *names),
            prior_residual=np.append(
                self.prior_residual, np.zeros(count) if means is None else -means
            ),
            prior_jacobian=np.append(self.prior_jacobian, slopes),
            at_bound=np.append(self.at_bound, np.zeros(count, dtype=bool)),
            effect_count=count,
        )

    @property
    def with_known_effects(self) -> LinearisedFit:
        """The fit without the effects among its parameters."""
        if not self.effect_count:
            return self
        return self.only(range(len(self.names) - self.effect_count))

    def only(self, kept: Sequence[int], effect_count: int = 0) -> LinearisedFit:
        """Return the fit of some of its parameters, the others unchanged."""
        own = [*kept]
        blocks = (replace(b, jacobian=b.jacobian[..., own]) for b in self.blocks)
        return replace(
            self,
            blocks=tuple(blocks),
            names=tuple(self.names[k] for k in own),
            prior_residual=self.prior_residual[own],
            prior_jacobian=self.prior_jacobian[own],
            at_bound=self.at_bound[own],
            effect_count=effect_count,
        )

    @property
    def chi_squared(self) -> float:
        """Sum of squared residuals of all measurements, shortened as by Huber's loss,
        without priors.
        """
        return float(sum(np.sum(block.residual**2) for block in self.blocks))


@known_at_last
def linearise_fit(collocation: Collocation, z: Array) -> LinearisedFit:
    """Linearise a fit at a solution.

    Residuals and derivatives are weighted as Huber's loss does at the optimum, see
    `huber_as_weights`.

    Parameters
    ----------
    z : (variables,) array
        The optimum, which satisfies the equations of motion.

    Raises
    ------
    SimulationError
        If the equations of motion are singular.

    Notes
    -----
    Residuals of user-defined sensors and of grasps are padded or grouped to three components. The
    fit has no `disturbances`, see `pose_noise.with_pose_noise`.
    """
    p = collocation.parameters_from(z)
    blocks = []
    for response in observable_responses(collocation, z):
        transcription = response.iterate.transcription
        experiment = transcription.experiment
        relaxed = transcription.body.has_memory and bool(np.isinf(experiment.loaded_since_s))
        linearised = response.linearise()
        for kind, (misfit, by_own) in zip(transcription.residuals, linearised, strict=True):
            residual, by_own = huber_as_weights(misfit, by_own, huber=kind.huber)
            residual, misfit, by_own = map(kind.pool_values, (residual, misfit, by_own))
            slope = np.zeros((*residual.shape, len(p)))
            slope[..., transcription.parameter_indices] = by_own
            blocks.append(
                ResidualBlock(
                    name=experiment.name,
                    t_s=kind.t_s,
                    marker_names=kind.pooled_groups.names,
                    is_present=np.asarray(kind.pooled_groups.is_compared.any(axis=2)),
                    residual=residual,
                    jacobian=slope,
                    sigma_m=kind.pooled_groups.sigmas,
                    misfit=misfit,
                    components=kind.pooled_groups.is_compared,
                    sigma_key=kind.sigma_key,
                    is_static=experiment.is_static,
                    is_relaxed_at_start=relaxed,
                    places_m=kind.pooled_groups.places_m,
                    has_noise_floor=kind.has_noise_floor,
                    sigma_ratios=kind.sigma_ratios,
                    errs_slowly=kind.errs_slowly,
                )
            )
    prior_residual, prior_slope = collocation.prior_residuals(p)
    lower, upper = collocation.parameter_bounds
    return LinearisedFit(
        blocks=tuple(blocks),
        names=collocation.parameter_names,
        shared_count=collocation.nq,
        prior_residual=prior_residual,
        prior_jacobian=prior_slope,
        at_bound=(p - lower < AT_BOUND) | (upper - p < AT_BOUND),
        derived=DerivedModuli.from_bodies(
            (s.constants for s in collocation.transcriptions), p[: collocation.nq]
        ),
    )


@dataclass(frozen=True, eq=False)
class Information:
    """Information of residuals and priors about all parameters, in the r directions that are
    determined.

    Parameters at a bound are free here: with other noise they would not have ended there, and their
    correlation with the other parameters is part of those parameters' error.
    """

    fit: SquareRootInformation  # triangle of all rows; its root is L
    # tuple of (T, 3M, r) arrays: D = S L of each block; zero where missing.
    scaled_jacobians: tuple[Array, ...]
    prior: Array  # (r, r): Lᵀ PᵀP L

    @property
    def determined_count(self) -> float:
        """Number of parameters that the data determine, Σ tr DᵀD; one that a prior
        determines counts in part.
        """
        return float(sum(np.sum(slope**2) for slope in self.scaled_jacobians))


def factorise_information(fit: LinearisedFit) -> Information:
    """Return the information of residuals and priors of a fit about all parameters, factorised.

    Directions that neither data nor priors determine are left out. Parameters at a bound are free.
    """
    all_rows = least_squares_of_fit(fit)
    slopes = tuple(block.channels.jacobian @ all_rows.root for block in fit.blocks)
    prior = all_rows.root * fit.prior_jacobian[:, None]
    return Information(all_rows, slopes, prior=prior.T @ prior)


def least_squares_of_fit(fit: LinearisedFit) -> SquareRootInformation:
    """Return residuals and priors as a least-squares problem in a step of all p parameters from the
    answer; bounds are not included.
    """
    of_all = least_squares_of_blocks(fit, range(len(fit.blocks)))
    return of_all.with_rows(fit.prior_residual, np.diag(fit.prior_jacobian))


def least_squares_of_blocks(fit: LinearisedFit, indices: Iterable[int]) -> SquareRootInformation:
    """Return the residuals of some blocks (indices, from 0) as a least-squares problem in a step of
    all p parameters, without priors.
    """
    problem = SquareRootInformation.empty(len(fit.names))
    for k in indices:
        channels = fit.blocks[k].channels
        residual = channels.residual.ravel()
        problem = problem.with_rows(
            residual, channels.jacobian.reshape(residual.size, len(fit.names))
        )
    return problem


def gauss_newton_step(fit: LinearisedFit) -> Array:
    """Return the step (p,) to the least squares of the linearised fit, with priors; parameters at a
    bound do not change (by more than `NO_STEP`), other bounds are ignored.
    """
    free = np.where(fit.at_bound, NO_STEP, np.inf)
    return least_squares_of_fit(fit).minimiser(-free, free)


def remaining_squares(fit: LinearisedFit) -> float:
    """Return χ² of measurements and priors after the step to the least squares."""
    return least_squares_of_fit(fit).loss(gauss_newton_step(fit))
