"""Posterior of the phases of a two-phase field, by linearised measurements that are corrected with
simulations.

Residuals are linearised in a power y = (E_e^γ − 1)/γ of the constant in every element, relative to
its mean, at the posterior mean of y (posterior linearisation, García-Fernández et al. 2015): there
elements at the boundary have values between those of both phases, and errors of the change to one
phase and to the other nearly cancel. Some samples are simulated. The exponent γ is that for which
the squared errors of the linearised residuals at these samples are least; between 0, the logarithm,
and 1, it depends on how the elements of a body share a load. The mean of the remaining errors is
added to the residuals, and their covariance to that of the noise (approximation error, Kaipio and
Somersalo 2007; Calvetti et al. 2018).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.optimize import minimize_scalar

from ..common.array_types import Array, Index
from ..errors import SimulationError
from ..methods.starts.initial_trajectories import simulate_trajectories
from ..program.collocation import Collocation
from ..program.measurement_residual import huber_as_weights
from ..statistics.linearised import LinearisedFit, linearise_fit
from ..statistics.phase_sampling import (
    ElementInformation,
    InternalFaces,
    PosteriorDraws,
    SamplerSettings,
    sample_phases,
)

# Exponent γ before samples have been simulated: the middle of its usual range.
FIRST_EXPONENT = 0.5
# Limits of γ: series and parallel connection of elements, and some more.
EXPONENT_LIMITS = (-1.0, 2.0)
# Standard deviation of γ about its first value, for samples that do not determine it.
EXPONENT_DEVIATION = 0.5
# Limit of the logarithm of the contrast, in prior standard deviations: a power may become negative.
LARGEST_DEVIATIONS = 4.0
# Fewest simulated samples from which a covariance of the errors is estimated.
FEWEST_SIMULATED = 4


@dataclass(frozen=True)
class ContrastPrior:
    """Normal prior of the logarithm s of the contrast."""

    mean: float
    deviation: float  # standard deviation; tiny for a given contrast

    def limit(self, logarithms: Array) -> Array:
        """Return logarithms clipped to `LARGEST_DEVIATIONS` from the mean."""
        largest = LARGEST_DEVIATIONS * self.deviation
        return np.clip(logarithms, self.mean - largest, self.mean + largest)


@dataclass(frozen=True, eq=False)
class ApproximationError:
    """Normal error of linearised residuals: r_true ≈ r_linear + mean + roots ε, ε ~ N(0, I)."""

    mean: Array  # (n,): mean error of the n residuals, in units of σ
    roots: Array  # (n, K): square root of the covariance, of rank K

    @classmethod
    def from_errors(cls, errors: Array) -> ApproximationError:
        """Return the model of errors (K, n) of K samples; zero if there are fewer than
        `FEWEST_SIMULATED`.
        """
        count, size = errors.shape
        if count < FEWEST_SIMULATED:
            return cls(np.zeros(size), roots=np.zeros((size, 0)))
        mean = errors.mean(axis=0)
        return cls(mean, roots=(errors - mean).T / np.sqrt(count - 1))


@dataclass(frozen=True, eq=False)
class ElementSurrogate:
    """Residuals linearised in a power of the constant in every element and in all other parameters."""

    collocation: Collocation  # program with the logarithm of each element as a parameter
    p: Array  # (np,): parameters of the expansion point; those of the elements are zero
    positions: Sequence[Array]  # sequence of (N, 3n): trajectories there [m]
    fit: LinearisedFit  # fit linearised there
    columns: Index  # (E,) int: columns of the elements' logarithms in the fit
    base: Array  # (E,): logarithms z₀ relative to the mean at the expansion point
    faces: InternalFaces  # faces between elements of the part
    prior: ContrastPrior  # prior of the logarithm of the contrast
    exponent: float
    errors: ApproximationError  # errors of the linearised residuals

    @classmethod
    def linearise(
        cls,
        collocation: Collocation,
        p: Array,
        *,
        element_names: Sequence[str],
        base: Array,
        faces: InternalFaces,
        prior: ContrastPrior,
        exponent: float = FIRST_EXPONENT,
        guess: Sequence[Array] | None = None,
    ) -> ElementSurrogate:
        """Simulate and linearise a program at parameters p, without errors.

        Parameters
        ----------
        collocation, p, base, faces, prior, exponent
            See the class.
        element_names : sequence of str
            Names of the parameters of the elements, in their order.
        guess : sequence of (N, 3n) array, optional
            Trajectories at similar parameters [m].

        Raises
        ------
        SimulationError
            If the body cannot be simulated at p, or its equations are singular there.
        """
        positions, failure = simulate_trajectories(collocation, p, guess=guess)
        if failure is not None:
            raise failure
        fit = linearise_fit(collocation, collocation.pack(p, positions))
        places = {name: k for k, name in enumerate(fit.names)}
        return cls(
            collocation,
            p,
            positions,
            fit=fit,
            columns=np.array([places[name] for name in element_names]),
            base=base,
            faces=faces,
            prior=prior,
            exponent=exponent,
            errors=ApproximationError.from_errors(np.zeros((0, _size(fit)))),
        )

    @cached_property
    def other_columns(self) -> Index:
        """Columns (p,) of all other parameters in the fit."""
        return np.delete(np.arange(len(self.fit.names)), self.columns)

    @cached_property
    def _normal(self) -> tuple[Array, Array]:
        """Normal matrix (np, np) and score (np,) of the fit without its errors and priors."""
        residual = _residuals(self.fit)
        size = len(self.fit.names)
        normal = np.zeros((size, size))
        for matrix in _matrices(self.fit):
            normal += matrix.T @ matrix
        return normal, _pull_back(self.fit, residual)

    def to_power(self, logarithms: Array) -> Array:
        """Return y = (E^γ − 1)/γ from logarithms of the constant (any shape)."""
        if abs(self.exponent) < 1e-6:
            return logarithms
        return np.expm1(self.exponent * logarithms) / self.exponent

    def to_logarithm(self, powers: Array) -> Array:
        """Return logarithms from powers y (any shape), finite also where no constant has y."""
        if abs(self.exponent) < 1e-6:
            return powers
        positive = np.maximum(self.exponent * powers, np.expm1(-30.0))
        return np.log1p(positive) / self.exponent

    def information(self, temperature: float = 1.0) -> ElementInformation:
        """Return the normal equations by powers y of the elements and all other parameters, with
        the covariance of the errors, and the measurements divided by a temperature T.

        The prior of the contrast is that of its logarithm, linearised at the logarithm of largest
        size at the expansion point, or at the nearest limit of the prior.
        """
        root = np.sqrt(temperature)
        normal, score = self._normal
        errors = self.errors.roots / root
        gram = np.eye(errors.shape[1]) + errors.T @ errors
        mixed = _pull_back(self.fit, errors) / root
        residual = (_residuals(self.fit) + self.errors.mean) / root
        normal = normal / temperature - mixed @ np.linalg.solve(gram, mixed.T)
        score = score + _pull_back(self.fit, self.errors.mean)
        score = score / temperature - mixed @ np.linalg.solve(gram, errors.T @ residual)
        others = self.other_columns
        elements = self.columns
        priors = self.fit.prior_jacobian[others]
        # Derivative of the logarithm by the power at the expansion point.
        slope = np.exp(-self.exponent * self.base)
        largest = self.base[np.argmax(np.abs(self.base))]
        typical = float(self.prior.limit(largest))
        stretch = np.exp(self.exponent * typical)
        return ElementInformation(
            of_p=normal[np.ix_(others, others)] + np.diag(priors**2),
            mixed=slope[:, None] * normal[np.ix_(elements, others)],
            of_z=slope[:, None] * normal[np.ix_(elements, elements)] * slope,
            score_p=score[others] + priors * self.fit.prior_residual[others],
            score_z=slope * score[elements],
            base=self.to_power(self.base),
            deviation=stretch * self.prior.deviation,
            mean=float(self.to_power(np.array(typical)) + stretch * (self.prior.mean - typical)),
        )

    def simulate_errors(self, logarithms: Array, changes: Array) -> SimulatedSamples:
        """Simulate samples, and return the errors of the linearised residuals; samples that cannot
        be simulated are left out.

        Parameters
        ----------
        logarithms : (K, E) array
            Logarithms relative to the mean in each element.
        changes : (K, p) array
            Changes of the other parameters.
        """
        simulated = []
        residuals = []
        for each, change in zip(logarithms, changes, strict=True):
            p = self.p.copy()
            p[self.columns] = each - self.base
            p[self.other_columns] += change
            try:
                residuals.append(exact_residuals(self.collocation, p, guess=self.positions))
            except SimulationError:
                continue
            simulated.append(p)
        count = len(simulated)
        return SimulatedSamples(
            self,
            np.reshape(simulated, (count, len(self.p))),
            residuals=np.reshape(residuals, (count, _size(self.fit))),
        )


@dataclass(frozen=True, eq=False)
class SimulatedSamples:
    """Samples of the posterior with their exact residuals."""

    surrogate: ElementSurrogate  # linearised residuals with which they were drawn
    p: Array  # (K, np): parameters of the samples, in the coordinates of the surrogate's program
    residuals: Array  # (K, n): residuals of the simulations, in units of σ

    @property
    def least_chi_squared(self) -> float:
        """Least χ² of the samples; infinite without samples."""
        return float(min((self.residuals**2).sum(axis=1), default=np.inf))

    def errors(self, exponent: float) -> Array:
        """Return exact less linearised residuals (K, n) with an exponent γ."""
        surrogate = self.surrogate
        base = surrogate.base
        other = replace(surrogate, exponent=exponent)
        steps = self.p - surrogate.p
        logarithms = base + steps[:, surrogate.columns]
        steps[:, surrogate.columns] = np.exp(-exponent * base) * (
            other.to_power(logarithms) - other.to_power(base)
        )
        matrices = _matrices(surrogate.fit)
        changes = np.concatenate([steps @ m.T for m in matrices], axis=1)
        return self.residuals - _residuals(surrogate.fit) - changes

    def corrected_surrogate(self) -> ElementSurrogate:
        """Return the surrogate with the exponent of least squared errors, and with the model of the
        remaining errors; the surrogate itself if too few samples could be simulated.
        """
        if len(self.p) < FEWEST_SIMULATED:
            return self.surrogate

        def loss(exponent: float) -> float:
            """Return the squared errors per sample with a weak prior of the exponent."""
            departure = (exponent - FIRST_EXPONENT) / EXPONENT_DEVIATION
            squares = (self.errors(exponent) ** 2).sum(axis=1)
            return float(squares.mean() + departure**2)

        search = minimize_scalar(
            loss, bounds=EXPONENT_LIMITS, method="bounded", options={"xatol": 0.01}
        )
        exponent = float(search.x)
        return replace(
            self.surrogate,
            exponent=exponent,
            errors=ApproximationError.from_errors(self.errors(exponent)),
        )


@dataclass(frozen=True, eq=False)
class PhasePosterior:
    """Samples of phases and of all parameters of a two-phase problem."""

    surrogate: ElementSurrogate  # linearised residuals from which they were drawn
    draws: PosteriorDraws  # phases and, as `contrasts`, powers u = (r^γ − 1)/γ of the contrast r
    information: ElementInformation  # normal equations of the samples

    @classmethod
    def sample(
        cls,
        surrogate: ElementSurrogate,
        start: Array,
        *,
        settings: SamplerSettings,
        seed: int,
        temperature: float = 1.0,
    ) -> PhasePosterior:
        """Sample the posterior from phases (E,) or (C, E) on, see `sample_phases`."""
        information = surrogate.information(temperature)
        draws = sample_phases(information, surrogate.faces, start, settings=settings, seed=seed)
        return cls(surrogate, draws, information=information)

    @cached_property
    def phases(self) -> Array:
        """Phases (K, E) of all samples."""
        phases = self.draws.phases.reshape(-1, self.draws.phases.shape[2])
        return phases.astype(float)

    @cached_property
    def contrasts(self) -> Array:
        """Logarithms (K,) of the contrast of all samples."""
        return self._limited_logarithms(self.draws.contrasts)

    @property
    def mean_contrasts(self) -> Array:
        """Logarithms (K,) of the contrast at its conditional mean given each sample's phases."""
        return self._limited_logarithms(self.draws.means)

    def _limited_logarithms(self, powers: Array) -> Array:
        """Return logarithms (K,) from powers (k, C) of the contrast, within the limits of its
        prior.
        """
        surrogate = self.surrogate
        return surrogate.prior.limit(surrogate.to_logarithm(powers.ravel()))

    @cached_property
    def mean_changes(self) -> Array:
        """Conditional means (K, p) of the changes of the other parameters given phases and contrast
        of each sample.
        """
        powers = self.surrogate.to_power(self.contrasts)
        return self.information.mean_changes(powers[:, None] * self.phases)

    def draw_changes(self, seed: int) -> Array:
        """Draw changes (K, p) of the other parameters given phases and contrast of each sample."""
        rng = np.random.default_rng(seed)
        values, vectors = np.linalg.eigh(self.information.covariance_p)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        noise = rng.normal(size=self.mean_changes.shape) @ root.T
        return self.mean_changes + noise

    @property
    def mean_logarithms(self) -> Array:
        """Logarithms (E,) of the constant at the mean of its power y, relative to its
        mean.
        """
        powers = self.surrogate.to_power(self.contrasts)
        return self.surrogate.to_logarithm(powers @ self.phases / len(self.phases))

    def select_last_phases(self) -> Array:
        """Return the last phases (C, E) of the chains."""
        return self.draws.phases[-1].astype(float)

    def simulate(self) -> SimulatedSamples:
        """Simulate the last sample of each chain."""
        count = len(self.select_last_phases())
        contrasts = self.contrasts[-count:]
        return self.surrogate.simulate_errors(
            contrasts[:, None] * self.select_last_phases(), changes=self.mean_changes[-count:]
        )


def exact_residuals(
    collocation: Collocation, p: Array, guess: Sequence[Array] | None = None
) -> Array:
    """Return the residuals (n,) of all measurements at simulated trajectories, in the order and
    with the weights of `linearise_fit`.

    Parameters
    ----------
    p : (np,) array
        All parameters.
    guess : sequence of (N, 3n) array, optional
        Trajectories at similar parameters [m].

    Raises
    ------
    SimulationError
        If the body cannot be simulated at p.
    """
    positions, failure = simulate_trajectories(collocation, p, guess=guess)
    if failure is not None:
        raise failure
    residuals = []
    for iterate in collocation.iterates(collocation.pack(p, positions)):
        linearised = iterate.linearise_fixed_motion()
        for residual, (values, by_phi) in zip(
            iterate.transcription.residuals, linearised, strict=True
        ):
            weighted, _ = huber_as_weights(values, by_phi, huber=residual.huber)
            residuals.append(residual.pool_values(weighted).ravel())
    return np.concatenate(residuals)


def _size(fit: LinearisedFit) -> int:
    """Return the number of residuals of a fit, with those that are missing, which are zero."""
    return sum(block.residual.size for block in fit.blocks)


def _residuals(fit: LinearisedFit) -> Array:
    """Return all residuals (n,) of a fit."""
    return np.concatenate([block.residual.ravel() for block in fit.blocks])


def _matrices(fit: LinearisedFit) -> list[Array]:
    """Return the Jacobian (n_k, np) of each block of a fit."""
    return [block.jacobian.reshape(block.residual.size, -1) for block in fit.blocks]


def _pull_back(fit: LinearisedFit, values: Array) -> Array:
    """Return the transposed Jacobian times values (n, …) of all residuals: (np, …)."""
    matrices = _matrices(fit)
    ends = np.cumsum([len(matrix) for matrix in matrices])[:-1]
    parts = np.split(values, ends)
    return sum(
        (matrix.T @ part for matrix, part in zip(matrices, parts, strict=True)),
        start=np.zeros((len(fit.names), *values.shape[1:])),
    )
