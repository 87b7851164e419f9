"""Measurement models: residuals between data and an expression of an observable and nuisance
parameters.

A sample measures y(c, φ, data), where c are a few vectors of its observable (such as the place of a
marker at neighbouring times) and φ its nuisance parameters. The residual is r = (y − ŷ) / σ with
the measurement ŷ, in groups of usually three numbers, and the loss is Σ ρ(‖r‖) over the groups. All
derivatives are generated from the expression. Subclass `MeasurementResidual` for another kind of
sensor.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, NamedTuple, Self, TypeVar

import casadi as ca
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from ..common.array_types import Array, Index
from ..model.generated_functions import GeneratedFunction
from ..model.nuisance_map import NuisanceMap
from ..recording.measurement import Measurement
from .observables import ObservableDerivatives, ObservedMotion, PointPositions, SparseEntries
from .reactions.resultant import ReactionGrid, ReactionResultant

# Numbers of a vector [x, y, z], whose residuals share a weight of Huber's loss.
GROUP = 3

# Observables of measurements.
Observable = PointPositions | ReactionResultant

T = TypeVar("T", float, ca.SX)
Expression = Callable[[ca.SX, ca.SX, ca.SX], ca.SX]


@dataclass(frozen=True, eq=False)
class ResidualExpression:
    """Residual and loss of one sample as generated functions."""

    # ``expression(c, phi, data) -> y`` in CasADi operations; c is (3, vectors).
    expression: Expression
    # Numbers of vectors, of nuisance parameters and of data.
    vector_count: int
    nuisance_count: int
    data_count: int
    measured_count: int  # length of y, a multiple of the group
    # Threshold of Huber's loss in standard deviations: ρ(d) = d² up to it, linear beyond; None
    # means ρ(d) = d².
    huber: float | None = None
    group_size: int = GROUP  # how many numbers of y the loss takes as one vector
    is_compiled: bool = False  # whether to compile the residual to native code

    @cached_property
    def residual(self) -> GeneratedFunction:
        """Residual r (m,) of u = (c, φ), the vectors c one after the other; its data are those of
        the expression, ŷ and 1/σ, and 1/σ is zero where nothing is measured.
        """
        return GeneratedFunction(
            self._residual_expression,
            self._input_count,
            data_size=self._data_count,
            is_compiled=self.is_compiled,
        )

    @cached_property
    def loss(self) -> GeneratedFunction:
        """Loss Σ ρ of the residual, with the same inputs and data."""
        return GeneratedFunction(
            self._loss_expression, self._input_count, data_size=self._data_count
        )

    @property
    def is_quadratic(self) -> bool:
        """Whether the loss is a quadratic function of u: no Huber
        threshold, and y is linear in u.
        """
        return self.huber is None and self.residual.is_linear

    def curvature(self, u: Array, data: Array, has_observation_curvature: bool = True) -> Array:
        """Return second derivatives (k, k, …) of the loss by u.

        Parameters
        ----------
        u : (k, …) array
            Inputs (c, φ) of the samples.
        data : (d + 2 m, …) array
            Data, ŷ and 1/σ of the samples.
        has_observation_curvature : bool
            If true, the exact second derivatives. If false, neglect the curvature of the
            observations: the Gauss–Newton matrix, which is positive semidefinite. Outliers then
            have the weights ρ'/2d of reweighted least squares; this is an upper bound of the
            curvature of ρ, and avoids the zero of ρ'' along their residuals.
        """
        if has_observation_curvature:
            return self.loss.weighted_hessian(u, data)
        residual, slopes = self.residual.evaluate_with_jacobian(u, data)
        weights = np.full(residual.shape, 2.0)
        if self.huber is not None:
            groups = residual.reshape(-1, self.group_size, *residual.shape[1:])
            lengths = np.linalg.norm(groups, axis=1)
            weights *= np.repeat(
                self.huber / np.maximum(lengths, self.huber), self.group_size, axis=0
            )
        return np.einsum("ai...,a...,aj...->ij...", slopes, weights, slopes, optimize=True)

    @property
    def _input_count(self) -> int:
        """Number of inputs u: positions of the vectors and nuisance parameters."""
        return GROUP * self.vector_count + self.nuisance_count

    @property
    def _data_count(self) -> int:
        """Number of data, including the measurements ŷ and the weights 1/σ."""
        return self.data_count + 2 * self.measured_count

    def _residual_expression(self, u: ca.SX, data: ca.SX) -> ca.SX:
        """Return the expression (m,) of the residual (y − ŷ) / σ in u = (c, φ) and the data."""
        ends = [0, self.data_count, self.data_count + self.measured_count, self._data_count]
        own, measured, weight = ca.vertsplit(data, ends)
        vectors, phi = ca.vertsplit(u, [0, GROUP * self.vector_count, self._input_count])
        predicted = self.expression(ca.reshape(vectors, GROUP, self.vector_count), phi, own)
        return weight * (predicted - measured)

    def _loss_expression(self, u: ca.SX, data: ca.SX) -> ca.SX:
        """Return the expression (scalar) of the loss Σ ρ in u and the data."""
        residual = self._residual_expression(u, data)
        groups = ca.vertsplit(residual, self.group_size)
        return sum(
            (self._robust_loss_of_square(ca.sumsqr(group)) for group in groups), start=ca.SX(0)
        )

    def _robust_loss_of_square(self, square: ca.SX) -> ca.SX:
        """Return the expression of ρ from the squared length of a group."""
        if self.huber is None:
            return square
        limit = self.huber**2
        beyond = 2 * self.huber * ca.sqrt(ca.fmax(square, limit)) - limit
        return ca.if_else(square > limit, beyond, square)


def huber_as_least_squares(
    residual: Array, derivatives: Array, huber: float | None
) -> tuple[Array, Array]:
    """Returns
    -------
    ((…, 3) array, (…, 3, p) array)
        Scaled residuals and derivatives; the arguments are not modified.
    """
    if huber is None:
        return residual, derivatives
    length = np.linalg.norm(residual, axis=-1, keepdims=True)
    beyond = np.maximum(length, huber)
    root = np.sqrt(2 * huber * beyond - huber**2)
    shrunk = residual * np.where(length > huber, root / beyond, 1.0)
    return shrunk, derivatives * np.where(length > huber, huber / root, 1.0)[..., None]


def huber_as_weights(
    residual: Array, derivatives: Array, huber: float | None
) -> tuple[Array, Array]:
    """Weight residuals and derivatives as Huber's loss does at its optimum, for statistics.

    Up to the threshold δ both are unchanged. Beyond, with the length d of a group, derivatives are
    multiplied by √(δ/d), the square root of their weight in the normal equations, and residuals by
    δ/d: they are shortened to the threshold, so that a few outliers do not determine the noise of
    the others. Arguments as in `huber_as_least_squares`; without threshold (None) both are returned
    as they are.
    """
    if huber is None:
        return residual, derivatives
    length = np.linalg.norm(residual, axis=-1, keepdims=True)
    weight = huber / np.maximum(length, huber)
    return residual * weight, derivatives * np.sqrt(weight)[..., None]


class RowStencil(NamedTuple):
    """Vectors and data from which the first S samples are computed."""

    # (S, E, v): indices of v vectors among the n e vectors of the observable, time by time: time ·
    # e + point.
    indices: Index
    data: Array  # (d, S, E): data of the expression


@dataclass(frozen=True, eq=False)
class PooledResiduals:
    """Residuals as statistics use them, in M groups of three."""

    names: tuple[str, ...]  # name of each group
    sigmas: Array  # (M,): standard deviations
    is_compared: NDArray[np.bool_]  # (S, M, 3) of bool: true for numbers that are compared
    # (3M, 3) or None: place of each number on the undeformed body [m]; None if they have none.
    places_m: Array | None = None


class SampledMotion(NamedTuple):
    """Motion that is known at the samples of an experiment."""

    t_s: Array  # (T,): times of the samples [s]
    reaction_grid: ReactionGrid  # times at which reaction forces are known
    observed: ObservedMotion  # positions at the samples, and reaction forces


@dataclass(frozen=True, eq=False)
class MeasurementResidual(ABC):
    """Measurement model: S samples of E entities at a time, of m numbers each, in one experiment.

    An entity is what is measured at the same time by the same expression with other nuisance
    parameters, such as one marker.

    Attributes
    ----------
    observable : Observable
        Observable; its values c are (n, e, 3), at the first n of its times.
    nuisance : NuisanceMap
        Nuisance parameters of the experiment.
    huber : float or None
        Threshold of Huber's loss, see `ResidualExpression`; None means a quadratic loss.
    names : (G,) tuple of str
        Name of each group, G = E m / g.
    t_s : (S,) array
        Times of the samples [s].
    sigmas : (G,) array
        Stated standard deviations, in the unit of the measurement.
    measured : (S, E, m) array
        Measurements ŷ, NaN where missing.
    is_compared : (S, G, g) array of bool
        Numbers that are compared: they exist, and the model can predict them.
    own_parameters : (E, f) array
        Indices in φ of the nuisance parameters of each entity.
    sigma_key : str
        Key of σ in a problem file.
    group_size : int
        How many numbers the loss takes as one vector, g; three for a position.
    has_fixed_stencils : bool
        Whether the stencils do not depend on φ.
    has_noise_floor : bool
        Whether error bars never use a noise below σ, and the residuals are not used to estimate the
        noise of other measurements. Set it for measurements with rounding errors, which may happen
        to be small.
    errs_slowly : bool
        Whether errors of the instrument within σ may change slowly from sample to sample, so that
        correlated residuals within σ are no evidence against the model.
    is_compiled : bool
        Whether to compile the expression to native code; worthwhile with many entities.
    """

    observable: Observable
    nuisance: NuisanceMap
    huber: float | None
    names: tuple[str, ...]
    t_s: Array
    sigmas: Array
    measured: Array
    is_compared: NDArray[np.bool_]
    own_parameters: Index

    group_size: ClassVar[int] = GROUP
    sigma_key: ClassVar[str] = "sigma_m"
    has_fixed_stencils: ClassVar[bool] = True
    has_noise_floor: ClassVar[bool] = False
    errs_slowly: ClassVar[bool] = False
    is_compiled: ClassVar[bool] = False

    @property
    @abstractmethod
    def measurement(self) -> Measurement:
        """Measurement of the experiment that is compared."""

    @cached_property
    def pooled_groups(self) -> PooledResiduals:
        """Groups that statistics use: those of the measurement, without places, unless a subclass
        combines neighbours.
        """
        return PooledResiduals(self.names, self.sigmas, is_compared=self.is_compared)

    def pool_values(self, values: Array) -> Array:
        """Return residuals (S, G, g, …), or their derivatives, as values (S, M, 3, …) of the groups
        of `pooled_groups`; the argument itself unless a subclass combines groups.
        """
        return values

    @property
    def observable_sigmas(self) -> Array:
        """Standard deviations (3 e,) of the observable's components as one sample determines them,
        infinite where it does not; here σ of each group for its three components.
        """
        return np.repeat(self.sigmas, GROUP)

    @abstractmethod
    def expression(self, vectors: ca.SX, phi: ca.SX, data: ca.SX) -> ca.SX:
        """Return the prediction y (m,) of one sample as a CasADi expression.

        Parameters
        ----------
        vectors : (3, v) SX
            Vectors of the observable.
        phi : (f,) SX
            Nuisance parameters of the entity.
        data : (d,) SX
            Data of the stencil.
        """

    @abstractmethod
    def stencil(self, phi: Array, known: int) -> RowStencil:
        """Return the stencil of the first samples that can be computed from the first `known` times
        of the observable.

        Parameters
        ----------
        phi : (k,) array
            Nuisance parameters of the experiment.
        known : int
            Number of times of the observable that are known. The stencil ends before the first
            sample that surely needs a later one; `is_covered` excludes further samples.
        """

    def all_stencils(self) -> Index:
        """Return the indices (…, E, v) of vectors that samples may be computed from, for any φ;
        here those of the stencil at φ = 0 and all times.
        """
        return self.stencil(np.zeros(self.nuisance.size), self.observable.count).indices

    def compared_with(self, known: int) -> NDArray[np.bool_]:
        """Return the mask (S, G, g) of the numbers that can be compared if the first `known` times
        of the observable are known.
        """
        return self.is_compared & self.is_covered(known)[:, None, None]

    def is_covered(self, known: int) -> NDArray[np.bool_]:
        """Return the mask (S,) of the samples for which the first `known` times suffice, for any φ;
        here all, since the stencil excludes others.
        """
        return np.ones(len(self.t_s), dtype=bool)

    @property
    def excluded_loss(self) -> float:
        """Loss of measurements that the fit excludes, as far as it is known; 0 for most kinds."""
        return 0.0

    def rough_residuals(self, x: Array, phi: Array) -> Array | None:
        """Return residuals for ranking first guesses, or None if the ordinary residuals are
        suitable, as here.

        Parameters
        ----------
        x : (rows, 3n) array
            First rows of the motion [m].
        phi : (k,) array
            Nuisance parameters.
        """
        return None

    # One sample -------------------------------------------------------------------------------

    @cached_property
    def _expressions(self) -> dict[tuple[int, int], ResidualExpression]:
        """Cache of the generated functions by the numbers of vectors and of data; filled by
        `expression_for`.
        """
        return {}

    def expression_for(self, vectors: int, data: int) -> ResidualExpression:
        """Return the generated functions for stencils with `vectors` vectors and `data` data; they
        are created on the first call and stored.
        """
        if (vectors, data) not in self._expressions:
            self._expressions[vectors, data] = ResidualExpression(
                self.expression,
                vector_count=vectors,
                nuisance_count=self.own_parameters.shape[1],
                data_count=data,
                measured_count=self.measured.shape[2],
                huber=self.huber,
                group_size=self.group_size,
                is_compiled=self.is_compiled,
            )
        return self._expressions[vectors, data]

    @cached_property
    def sigma_ratios(self) -> Array | float:
        """σ of each number over `sigmas`, (S, G, g); 1 if all samples have the same."""
        ratios = self.measurement.sigma_ratios
        if ratios is None:
            return 1.0
        padded = np.ones((len(ratios), len(self.names) * self.group_size))
        padded[:, : ratios.shape[1]] = ratios
        return padded.reshape(len(ratios), len(self.names), self.group_size)

    @cached_property
    def _data_and_weights(self) -> tuple[Array, Array]:
        """Measurements ŷ (m, S, E), zero where missing, and 1/σ (m, S, E), zero where nothing is
        compared.
        """
        scaled = self.is_compared / (self.sigmas[:, None] * self.sigma_ratios)
        weight = scaled.reshape(self.measured.shape)
        return np.moveaxis(np.nan_to_num(self.measured), 2, 0), np.moveaxis(weight, 2, 0)

    def _inputs_at(self, values: Array, phi: Array) -> _SampleInputs:
        """Return the inputs of the first s samples that can be computed from values (n, e, 3) of
        the observable at φ (k,).

        The weights 1/σ among the data are zero for samples that are not covered, see `is_covered`.
        """
        window = self.stencil(phi, len(values))
        samples, each, vectors = window.indices.shape
        neighbouring = values.reshape(-1, GROUP)[window.indices].reshape(
            samples, each, GROUP * vectors
        )
        own = np.broadcast_to(
            phi[self.own_parameters.T][:, None], (self.own_parameters.shape[1], samples, each)
        )
        measured, weight = (part[:, :samples] for part in self._data_and_weights)
        is_covered = self.is_covered(len(values))[:samples, None]
        data = np.concatenate([window.data, measured, weight * is_covered])
        u = np.concatenate([neighbouring.transpose(2, 0, 1), own])
        return _SampleInputs(self.expression_for(vectors, len(window.data)), window, u=u, data=data)

    def _grouped(self, values: Array) -> Array:
        """Return values (m, s, E) as groups (s, G, g)."""
        return values.transpose(1, 2, 0).reshape(values.shape[1], len(self.names), self.group_size)

    # All samples ------------------------------------------------------------------------------

    def predict(self, values: Array, phi: Array) -> Array:
        """Return predictions y (s, G, g) of the s first samples that the values suffice for, also
        where nothing was measured.

        Parameters
        ----------
        values : (n, e, 3) array
            Values of the observable at its first n times.
        phi : (k,) array
            Nuisance parameters.
        """
        inputs = self._inputs_at(values, phi)
        own = len(inputs.stencil.data)
        measured = self.measured.shape[2]
        # With ŷ = 0 and 1/σ = 1, the residual is the prediction.
        inputs.data[own : own + measured] = 0.0
        inputs.data[own + measured :] = 1.0
        residual = inputs.functions.residual
        return self._grouped(residual.evaluate(inputs.u, inputs.data))

    def at_samples(self, t_s: Array, grid: ReactionGrid) -> Self:
        """Return the model for a motion whose positions are known at the times `t_s` (N,) [s], and
        whose reaction forces at those of `grid`, for predictions.
        """
        times = (
            {"reaction_grid": grid}
            if isinstance(self.observable, ReactionResultant)
            else {"rows": np.arange(len(t_s))}
        )
        return replace(self, observable=replace(self.observable, **times))

    def predict_motion(self, motion: ObservedMotion, phi: Array) -> Array:
        """Return predictions (S, G, g) for a motion over all times of the observable, at φ (k,);
        NaN for samples that it does not cover.
        """
        return self.predict(self.observable.evaluate(motion, phi), phi)

    def predict_samples(self, motion: SampledMotion, phi: Array) -> Array:
        """Return predictions (S, G, g) for a motion that is known at the samples, at φ (k,)."""
        at_samples = self.at_samples(motion.t_s, motion.reaction_grid)
        return at_samples.predict_motion(motion.observed, phi)

    def numbers(self, predicted: Array) -> Array:
        """Return predictions (S, G, g) as the numbers (S, m) of the `Measurement`."""
        return predicted.reshape(len(predicted), -1)

    def fitted(self, motion: ObservedMotion, phi: Array) -> Any:
        """Return what a fit predicts: the numbers (S, m) of the measurement, or the comparison of
        its points; the motion is that of all grid times.
        """
        return self.numbers(self.predict_motion(motion, phi))

    def simulated(self, motion: SampledMotion, phi: Array) -> Any:
        """Return what a simulated motion predicts, as `fitted` does."""
        return self.numbers(self.predict_samples(motion, phi))

    def changes(
        self,
        values: Array,
        fitted: SampledMotion,
        simulated: SampledMotion,
        phi: Array,
        share: float,
    ) -> Array:
        """Return the changes (S, M, 3) of the residuals for `share` times the difference between a
        simulated motion and a fit; zero where not predicted.

        Parameters
        ----------
        values : (n, e, 3) array
            Values of the observable in the fit.
        fitted, simulated : SampledMotion
            Both motions at the samples.
        phi : (k,) array
            Nuisance parameters.
        share : float
            Factor of the difference.
        """
        of_fit, of_simulation = (self.predict_samples(each, phi) for each in (fitted, simulated))
        sigmas = self.sigmas[:, None] * self.sigma_ratios
        return share * np.nan_to_num((of_simulation - of_fit) / sigmas)

    def residuals(self, values: Array, phi: Array) -> Array:
        """Return residuals (y − ŷ) / σ (s, G, g) of the samples that the values suffice for, zero
        where nothing is compared; arguments as in `predict`.
        """
        inputs = self._inputs_at(values, phi)
        residual = inputs.functions.residual
        return self._grouped(residual.evaluate(inputs.u, inputs.data))

    def linearise(
        self, values: Array, observable_derivatives: ObservableDerivatives, phi: Array, size: int
    ) -> tuple[Array, Array]:
        """Return residuals (y − ŷ) / σ (s, G, g), zero where nothing is compared, and their
        derivatives (s, G, g, size) by all parameters.

        Samples s are those that the values suffice for; G is the number of `names` and g the
        `group_size`. Huber's loss is not applied. Without values (n = 0) both arrays are zero.

        Parameters
        ----------
        values : (n, e, 3) array
            Values of the observable.
        observable_derivatives : ObservableDerivatives
            Their derivatives.
        phi : (k,) array
            Nuisance parameters; they are the last of all parameters.
        size : int
            Number of all parameters.
        """
        if not len(values):
            none = np.zeros((len(self.stencil(phi, 0).indices), len(self.names), self.group_size))
            return none, np.zeros((*none.shape, size))
        samples_at = self._evaluate(values, phi)
        window = samples_at.stencil
        by_u = samples_at.by_inputs
        samples, each, vectors = window.indices.shape
        by_observables = by_u[..., : GROUP * vectors]
        by_own = by_u[..., GROUP * vectors :]
        derivatives = np.zeros((*by_u.shape[:3], size))
        first = size - len(phi)
        derivatives[..., observable_derivatives.columns] = by_observables @ _gather(
            observable_derivatives.by_common, window.indices
        )
        if len(observable_derivatives.entities):
            entities = observable_derivatives.entities
            times = window.indices[:, entities] // values.shape[1]
            number = np.arange(len(entities))[:, None]
            shape = (
                samples,
                len(entities),
                GROUP * vectors,
                observable_derivatives.by_own.shape[3],
            )
            neighbouring = observable_derivatives.by_own[times, number].reshape(shape)
            _add_columns(
                derivatives,
                entities,
                columns=first + observable_derivatives.own_parameters,
                values=by_observables[:, entities] @ neighbouring,
            )
        if self.own_parameters.size:
            _add_columns(
                derivatives, np.arange(each), columns=first + self.own_parameters, values=by_own
            )
        grouped = samples_at.residuals.reshape(samples, len(self.names), self.group_size)
        return grouped, derivatives.reshape(*grouped.shape, size)

    def _evaluate(self, values: Array, phi: Array) -> _LinearisedSamples:
        """Return the first s samples, linearised in their inputs at values (n, e, 3) of the
        observable and φ (k,).
        """
        linear = self._linear_part
        if linear is None or len(values) < self.observable.count:
            return self._linearise_at(values, phi)
        window = linear.stencil
        by_u = linear.by_inputs
        samples, each, vectors = window.indices.shape
        neighbouring = values.reshape(-1, GROUP)[window.indices].reshape(
            samples, each, GROUP * vectors
        )
        if self.own_parameters.shape[1]:
            own = np.broadcast_to(phi[self.own_parameters], (samples, *self.own_parameters.shape))
            neighbouring = np.concatenate([neighbouring, own], axis=2)
        change = (by_u @ neighbouring[..., None])[..., 0]
        return _LinearisedSamples(window, linear.residuals + change, by_inputs=by_u)

    def _linearise_at(self, values: Array, phi: Array) -> _LinearisedSamples:
        """Return the first s samples linearised by their generated functions, also where these are
        not linear; arguments as in `_evaluate`.
        """
        inputs = self._inputs_at(values, phi)
        residual, by_u = inputs.functions.residual.evaluate_with_jacobian(inputs.u, inputs.data)
        return _LinearisedSamples(
            inputs.stencil, residual.transpose(1, 2, 0), by_inputs=by_u.transpose(2, 3, 0, 1)
        )

    @cached_property
    def _linear_part(self) -> _LinearisedSamples | None:
        """All samples linearised at zero inputs, where derivatives are the same for all inputs;
        None if they are not constant.
        """
        if not self.has_fixed_stencils or not self._full_expression.residual.is_linear:
            return None
        nothing = np.zeros((self.observable.count, self.observable.vector_count, GROUP))
        at_zero = self._linearise_at(nothing, np.zeros(self.nuisance.size))
        return _LinearisedSamples(
            at_zero.stencil,
            np.ascontiguousarray(at_zero.residuals),
            by_inputs=np.ascontiguousarray(at_zero.by_inputs),
        )

    def residual_changes(self, values: Array, by: Array, phi: Array) -> Array:
        """Return the changes (s, M, 3, c) of the pooled residuals at values (n, e, 3) and φ (k,) if
        the observable changes by `by` (n, e, 3, c), to first order and at constant φ.
        """
        size = by.shape[3] + len(phi)
        slopes = ObservableDerivatives.without_own(np.arange(by.shape[3]), by)
        return self.pool_values(
            self.linearise(values, slopes, phi=phi, size=size)[1][..., : by.shape[3]]
        )

    def loss(self, values: Array, phi: Array) -> float:
        """Return the loss Σ ρ of values (n, e, 3) of the observable at φ (k,), over the samples
        that these suffice for; 0 if n = 0.
        """
        if not len(values):
            return 0.0
        inputs = self._inputs_at(values, phi)
        loss = inputs.functions.loss.evaluate(inputs.u, inputs.data)
        return float(loss.sum())

    def loss_gradient(self, values: Array, phi: Array) -> tuple[Array, Array]:
        """Return the gradient of `loss` by the observable's values (n, e, 3) and, at constant
        values, by φ (k,).

        If n = 0, the first is empty and the second zero.

        Parameters
        ----------
        values : (n, e, 3) array
            Values of the observable at its first n times.
        phi : (k,) array
            Nuisance parameters.
        """
        by_values = np.zeros_like(values)
        by_phi = np.zeros(len(phi))
        if not len(values):
            return by_values, by_phi
        inputs = self._inputs_at(values, phi)
        by_u = inputs.functions.loss.evaluate_with_jacobian(inputs.u, inputs.data)[1][0]
        places = inputs.stencil.indices
        by_observables, by_own = np.split(by_u, [GROUP * places.shape[2]])
        by_observables = by_observables.reshape(places.shape[2], GROUP, *places.shape[:2])
        where = np.moveaxis(places, 2, 0).ravel()
        count = values.size // GROUP
        for axis in range(GROUP):
            by_values[..., axis] = np.bincount(
                where, by_observables[:, axis].ravel(), minlength=count
            ).reshape(values.shape[:2])
        np.add.at(by_phi, self.own_parameters, by_own.sum(axis=1).T)
        return by_values, by_phi

    # Second derivatives -----------------------------------------------------------------------

    def _gather_matrix(self, places: Index) -> sp.csr_array:
        """Return ∂u/∂(c, φ), a matrix of zeros and ones, of samples with stencils (s, E, v); rows
        by sample, then by entity, then by input.
        """
        samples, each, vectors = places.shape
        observable_columns = GROUP * places[..., None] + np.arange(GROUP)
        first = GROUP * self.observable.count * self.observable.vector_count
        own = np.broadcast_to(first + self.own_parameters, (samples, *self.own_parameters.shape))
        columns = np.concatenate(
            [observable_columns.reshape(samples, each, GROUP * vectors), own], axis=2
        )
        rows = np.arange(columns.size + 1)
        shape = columns.size, first + self.nuisance.size
        return sp.csr_array((np.ones(columns.size), columns.ravel(), rows), shape=shape)

    @property
    def is_quadratic(self) -> bool:
        """Whether the loss is a quadratic function of the observable and φ, so that its second
        derivatives are constant.
        """
        return self._full_expression.is_quadratic

    @cached_property
    def _full_expression(self) -> ResidualExpression:
        """Generated functions for the stencil of all times of the observable."""
        window = self.stencil(np.zeros(self.nuisance.size), self.observable.count)
        return self.expression_for(window.indices.shape[2], len(window.data))

    @cached_property
    def _curvature_pattern(self) -> NDArray[np.bool_]:
        """Mask (u, u) of the second derivatives that a sample may have."""
        return self._full_expression.loss.hessian_pattern

    def hessian_structure(self, derivatives: sp.csr_array) -> tuple[Index, Index]:
        """Return rows and columns of the possible entries of ∂²loss by some variables, upper
        triangle, sorted by column.

        Parameters
        ----------
        derivatives : sparse array
            Structure of the derivatives of (c, φ) by these variables, all ones.
        """
        places = self.all_stencils()
        instances = int(np.prod(places.shape[:2]))
        ones = np.broadcast_to(
            self._curvature_pattern.astype(float), (instances, *self._curvature_pattern.shape)
        )
        # Positive numbers cannot cancel, so that no entry is lost.
        entries = _congruence(self._gather_matrix(places) @ derivatives, ones)
        order = np.lexsort(entries[:2])
        return entries.rows[order], entries.columns[order]

    def hessian(
        self,
        values: Array,
        phi: Array,
        derivatives: sp.csr_array,
        has_observation_curvature: bool = True,
    ) -> SparseEntries:
        """Return the entries of Sᵀ (∂²loss/∂(c, φ)²) S for the derivatives S of (c, φ) by some
        variables, upper triangle; entries may be missing or repeated.

        The second derivatives of c by the variables are not included, see
        `PointPositions.curvature`.

        Parameters
        ----------
        values : (n, e, 3) array
            Values of the observable.
        phi : (k,) array
            Nuisance parameters.
        derivatives : sparse array
            Derivatives S of (c, φ), in this order, by the variables.
        has_observation_curvature : bool
            If false, neglect the curvature of the observations, see `ResidualExpression.curvature`.
        """
        inputs = self._inputs_at(values, phi)
        curvature = inputs.functions.curvature(
            inputs.u, inputs.data, has_observation_curvature=has_observation_curvature
        )
        by_u = np.moveaxis(curvature, (0, 1), (2, 3))
        by_u = by_u.reshape(-1, *by_u.shape[2:])
        return _congruence(self._gather_matrix(inputs.stencil.indices) @ derivatives, by_u)


@dataclass(frozen=True, eq=False)
class _SampleInputs:
    """Inputs of the generated functions for the first s samples."""

    functions: ResidualExpression  # generated functions for this stencil
    stencil: RowStencil
    u: Array  # (k, s, E): vectors of the observable, then nuisance parameters of the entity
    data: Array  # (d + 2 m, s, E): data of the stencil, measurements ŷ and 1/σ


@dataclass(frozen=True, eq=False)
class _LinearisedSamples:
    """Residuals of the first s samples and their derivatives by the inputs u."""

    stencil: RowStencil
    residuals: Array  # (s, E, m): residuals in standard deviations
    by_inputs: Array  # (s, E, m, u): derivatives


def _gather(by: Array, places: Index) -> Array:
    """Return changes (s, E, 3 v, c) of the stencils' vectors from changes `by` (n, e, 3, c) of the
    observable, for the stencils' indices `places` (s, E, v) into its n e vectors, see `RowStencil`.
    """
    times, each, _, count = by.shape
    rows = by.reshape(times * each, GROUP, count)[places]
    return rows.reshape(*places.shape[:2], GROUP * places.shape[2], count)


def _add_columns(slope: Array, entities: Index, columns: Index, values: Array) -> None:
    """Add values (s, e, m, k) to columns (e, k) of the derivatives (s, E, m, size) of
    entities (e,), in place.
    """
    slope[:, entities[:, None], :, columns] += values.transpose(1, 3, 0, 2)


def _congruence(slopes: sp.csr_array, blocks: Array) -> SparseEntries:
    """Return the upper triangle of Sᵀ B S, B being block-diagonal with the blocks (instances, u,
    u); each entry occurs once.
    """
    count = np.arange(len(blocks) + 1)
    middle = sp.bsr_array((blocks, count[:-1], count))
    upper = sp.coo_array(sp.triu(slopes.T @ (middle.tocsr() @ slopes), format="coo"))
    rows, columns = (np.asarray(index, dtype=np.int64) for index in upper.coords)
    return SparseEntries(rows, columns, values=np.asarray(upper.data, dtype=np.float64))


def neighbouring_times(known_s: Array, at_s: Array, count: int) -> Index:
    """Return the indices (S, count) of consecutive times around each sample, as evenly as possible;
    at the ends of the known times, and beyond them, the first or last ones.

    Parameters
    ----------
    known_s : (n,) array
        Ascending times [s].
    at_s : (S,) array
        Times of the samples [s].
    count : int
        Number of neighbours, at most n. Of an odd number, the middle one is the last time that is
        not after the sample.
    """
    index_before = np.searchsorted(known_s, at_s, side="right") - 1
    first = np.clip(index_before - (count - 1) // 2, 0, len(known_s) - count)
    return first[:, None] + np.arange(count)


def lagrange_weights(position: T, places: Sequence[T]) -> list[Any]:
    """Return the weights of values at some places whose sum is the interpolating polynomial at
    `position` (Lagrange).

    Parameters
    ----------
    position : float or SX
        Place of interpolation; outside of the places it extrapolates.
    places : sequence of float or SX
        Distinct places of the values.

    Returns
    -------
    list of float or SX
        One weight for each place; 1 for a single place.
    """
    return [
        math.prod((position - other) / (own - other) for j, other in enumerate(places) if j != i)
        for i, own in enumerate(places)
    ]


def smooth_weights(position: ca.SX, places: Sequence[ca.SX]) -> list[ca.SX]:
    """Return weights as `lagrange_weights`, of an interpolation whose slope is continuous where
    `neighbouring_times` go on to the next place: in the interval in the middle, the polynomial
    without the last place passes linearly into that without the first.
    """
    if len(places) < 2:
        return lagrange_weights(position, places)
    before, after = places[(len(places) - 1) // 2 :][:2]
    share = ca.fmin(ca.fmax((position - before) / (after - before), 0), 1)
    first = [*lagrange_weights(position, places[:-1]), 0]
    last = [0, *lagrange_weights(position, places[1:])]
    return [(1 - share) * a + share * b for a, b in zip(first, last, strict=True)]
