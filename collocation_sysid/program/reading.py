"""What is measured of a body: one expression of what is looked at and of φ, compared with data.

A sample reads y(c, φ, data), c being a few vectors of its channel, such as a place on the body at
neighbouring times, and φ its own nuisance parameters. The residual is r = (y − ŷ) / σ, in groups of
three, the loss Σ ρ(‖r‖) over the groups. All derivatives are generated.
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

from ..arrays import Array, Index
from ..model.generated import Generated
from ..model.nuisance import NuisanceMap
from .channel import Entries, Points, Slopes
from .wrench_channel import GraspWrench, Grid

GROUP = 3

# What can be looked at.
Channel = Points | GraspWrench

T = TypeVar("T", float, ca.SX)
Expression = Callable[[ca.SX, ca.SX, ca.SX], ca.SX]


@dataclass(frozen=True, eq=False)
class Instrument:
    """What one sample reads.

    Attributes
    ----------
    expression : callable
        ``expression(c, phi, data) -> y`` in CasADi operations; c is (3, vectors).
    vectors, own, data : int
        Numbers of vectors, of φ and of data.
    measured : int
        Length of y, a multiple of the group.
    huber : float or None
        Huber's loss: ρ(d) = d² up to this many standard deviations, linear beyond; d² without it.
    group : int
        How many numbers of y the loss takes together.
    """

    expression: Expression
    vectors: int
    own: int
    data: int
    measured: int
    huber: float | None = None
    group: int = GROUP

    @cached_property
    def residual(self) -> Generated:
        """R of u = (c, φ), at data, ŷ and 1/σ, which is zero where nothing is measured."""
        return Generated(self._residual, self._inputs, self._data)

    @cached_property
    def loss(self) -> Generated:
        """Σ ρ of the same."""
        return Generated(self._loss, self._inputs, self._data)

    @property
    def is_quadratic(self) -> bool:
        """Whether second derivatives of the loss are always the same."""
        return self.huber is None and self.residual.is_linear

    def curvature(self, u: Array, data: Array, bent: bool = True) -> Array:
        """Second derivatives (k, k, …) of the loss by u.

        Unless readings are bent, they count as linear: Gauss–Newton's, which is convex. Then wild
        samples have the weights ρ'/2d of least squares, which curve no less than ρ does anywhere;
        ρ'' is zero along their residuals, and steps by it would be too long.
        """
        if bent:
            return self.loss.curvature(u, data)
        residual, slopes = self.residual.slopes(u, data)
        weights = np.full(residual.shape, 2.0)
        if self.huber is not None:
            groups = residual.reshape(-1, self.group, *residual.shape[1:])
            lengths = np.linalg.norm(groups, axis=1)
            weights *= np.repeat(self.huber / np.maximum(lengths, self.huber), self.group, axis=0)
        return np.einsum("ai...,a...,aj...->ij...", slopes, weights, slopes, optimize=True)

    @property
    def _inputs(self) -> int:
        return GROUP * self.vectors + self.own

    @property
    def _data(self) -> int:
        return self.data + 2 * self.measured

    def _residual(self, u: ca.SX, data: ca.SX) -> ca.SX:
        ends = [0, self.data, self.data + self.measured, self._data]
        own, measured, weight = ca.vertsplit(data, ends)
        looked, phi = ca.vertsplit(u, [0, GROUP * self.vectors, self._inputs])
        read = self.expression(ca.reshape(looked, GROUP, self.vectors), phi, own)
        return weight * (read - measured)

    def _loss(self, u: ca.SX, data: ca.SX) -> ca.SX:
        return self._rhos(self._residual(u, data), data)

    def _rhos(self, residual: ca.SX, _: ca.SX) -> ca.SX:
        groups = ca.vertsplit(residual, self.group)
        return sum((self._rho(ca.sumsqr(group)) for group in groups), start=ca.SX(0))

    def _rho(self, square: ca.SX) -> ca.SX:
        if self.huber is None:
            return square
        limit = self.huber**2
        beyond = 2 * self.huber * ca.sqrt(ca.fmax(square, limit)) - limit
        return ca.if_else(square > limit, beyond, square)


def as_squares(residual: Array, slope: Array, huber: float | None) -> tuple[Array, Array]:
    """Residuals (…, 3) and slopes (…, 3, p) whose squares sum to Huber's loss, with its gradient.

    With d the length of a group and δ the threshold, ρ = d² up to δ and 2δd − δ² beyond; residuals
    are scaled by √ρ / d and slopes by δ / √ρ there, so that r'ᵀr' = Σρ and S'ᵀr' is half its
    gradient (Huber 1964; reweighting after Triggs et al. 2000, sec. 4.3).
    """
    if huber is None:
        return residual, slope
    length = np.linalg.norm(residual, axis=-1, keepdims=True)
    beyond = np.maximum(length, huber)
    root = np.sqrt(2 * huber * beyond - huber**2)
    shrunk = residual * np.where(length > huber, root / beyond, 1.0)
    return shrunk, slope * np.where(length > huber, huber / root, 1.0)[..., None]


def as_weights(residual: Array, slope: Array, huber: float | None) -> tuple[Array, Array]:
    """The same as Huber's loss sees them at its optimum.

    Slopes have the weight of the fit's normal equations; residuals end at the threshold, so that a
    few wild samples tell nothing of the others' noise.
    """
    if huber is None:
        return residual, slope
    length = np.linalg.norm(residual, axis=-1, keepdims=True)
    weight = huber / np.maximum(length, huber)
    return residual * weight, slope * np.sqrt(weight)[..., None]


class Window(NamedTuple):
    """What samples are read from.

    places : (S, E, v) of vectors among those of the channel, one time after the other
    data : (d, S, E) of the instrument
    """

    places: Index
    data: Array


@dataclass(frozen=True, eq=False)
class Pooled:
    """What of a reading statistics look at, in groups of three.

    Attributes
    ----------
    names, sigmas : (M,)
    components : (S, M, 3) numbers that are there
    places_m : (3M, 3) of these on the undeformed body, where each has one
    """

    names: tuple[str, ...]
    sigmas: Array
    components: NDArray[np.bool_]
    places_m: Array | None = None


@dataclass(frozen=True, eq=False)
class Reading(ABC):
    """Samples (S, E) of an instrument in one experiment, E at a time, of m numbers each.

    Attributes
    ----------
    channel : Channel
        What is looked at; its values c are (n, e, 3), at the first n of its times.
    nuisance : NuisanceMap
    huber : float or None
        See `Instrument`.
    names : (G,) what each group is, G = E m / g
    t_s : (S,)
    sigmas : (G,) standard deviations given
    measured : (S, E, m), NaN where missing
    components : (S, G, g) numbers that are compared
    own : (E, f) positions in φ of what each reads by
    stated : str
        What states σ in a problem.
    has_offsets : bool
        Whether it is off by what nothing else tells, such as its tare: where nothing is fitted yet
        that is allowed for.
    group : int
        How many numbers the loss takes together, g; three, as those of a place.
    has_fixed_windows : bool
        Whether its windows do not depend on φ.
    noise_at_least_stated : bool
        Whether error bars never take its noise for smaller than σ, and its residuals do not tell
        the noise of others: for measurements with rounding errors, which may happen to be small.
    """

    channel: Channel
    nuisance: NuisanceMap
    huber: float | None
    names: tuple[str, ...]
    t_s: Array
    sigmas: Array
    measured: Array
    components: NDArray[np.bool_]
    own: Index

    group: ClassVar[int] = GROUP
    stated: ClassVar[str] = "sigma_m"
    has_offsets: ClassVar[bool] = False
    has_fixed_windows: ClassVar[bool] = True
    noise_at_least_stated: ClassVar[bool] = False

    @property
    def begins_s(self) -> float:
        """From when on what is looked at tells something that is compared, however φ is."""
        return float(self.t_s[self.components.any(axis=(1, 2)).argmax()])

    @cached_property
    def pool(self) -> Pooled:
        """What statistics look at: all there is, but where neighbours are taken together."""
        return Pooled(self.names, self.sigmas, self.components)

    def pooled(self, values: Array) -> Array:
        """(S, M, 3, …) of it, from residuals (S, G, g, …) or their slopes."""
        return values

    @property
    def looked_sigmas(self) -> Array:
        """(3 e,) how well what is looked at is known by a sample; infinite where it is not."""
        return np.repeat(self.sigmas, GROUP)

    @abstractmethod
    def expression(self, looked: ca.SX, phi: ca.SX, data: ca.SX) -> ca.SX:
        """What a sample reads, of vectors (3, v), its φ and the data of its window."""

    @abstractmethod
    def window(self, phi: Array, known: int) -> Window:
        """Of the samples that the first times of the channel may suffice for, the first ones."""

    def windows(self) -> Index:
        """(…, E, v) places that samples may be read from, whatever φ is."""
        return self.window(np.zeros(self.nuisance.size), self.channel.count).places

    def there(self, known: int) -> NDArray[np.bool_]:
        """(S, G, 3) what is compared where so many times of the channel are known."""
        return self.components & self.covered(known)[:, None, None]

    def covered(self, known: int) -> NDArray[np.bool_]:
        """(S,) those of them that these suffice for, however φ is."""
        return np.ones(len(self.t_s), dtype=bool)

    def roughly(self, x: Array, phi: Array) -> Array | None:
        """Residuals of a first guess, where its own say little of bodies that are far off."""
        return None

    # One sample -------------------------------------------------------------------------------

    @cached_property
    def _instruments(self) -> dict[tuple[int, int], Instrument]:
        return {}

    def of_some(self, known_s: Array, t_s: Array, numbers: Array, **changes: Any) -> Self:
        """That of other samples (S, m), of a channel that is known at some times (n,)."""
        measured = np.full((len(t_s), 1, self.measured.shape[2]), np.nan)
        measured[:, 0, : numbers.shape[1]] = numbers
        there = np.isfinite(measured).reshape(len(t_s), -1, GROUP)
        changes |= {"t_s": t_s, "measured": measured, "components": there}
        feels = isinstance(self.channel, GraspWrench)
        when = {"on": Grid.at(known_s)} if feels else {"rows": np.arange(len(known_s))}
        changes["channel"] = replace(self.channel, **when)
        other = replace(self, **changes)
        # Derivatives of the same expression are generated once.
        vars(other)["_instruments"] = self._instruments
        return other

    def instrument(self, vectors: int, data: int) -> Instrument:
        """That of windows of so many vectors and data."""
        if (vectors, data) not in self._instruments:
            sizes = vectors, self.own.shape[1], data, self.measured.shape[2]
            self._instruments[vectors, data] = Instrument(
                self.expression, *sizes, self.huber, self.group
            )
        return self._instruments[vectors, data]

    @cached_property
    def _compared(self) -> tuple[Array, Array]:
        """(m, S, E) ŷ, and 1/σ, zero where nothing is compared."""
        weight = (self.components / self.sigmas[:, None]).reshape(self.measured.shape)
        return np.moveaxis(np.nan_to_num(self.measured), 2, 0), np.moveaxis(weight, 2, 0)

    def _at(self, values: Array, phi: Array) -> tuple[Instrument, Window, Array, Array]:
        """The instrument, the window, u (k, s, E) and the data, of the samples that there are."""
        window = self.window(phi, len(values))
        samples, each, vectors = window.places.shape
        around = values.reshape(-1, GROUP)[window.places].reshape(samples, each, GROUP * vectors)
        own = np.broadcast_to(phi[self.own.T][:, None], (self.own.shape[1], samples, each))
        measured, weight = (part[:, :samples] for part in self._compared)
        there = self.covered(len(values))[:samples, None]
        data = np.concatenate([window.data, measured, weight * there])
        u = np.concatenate([around.transpose(2, 0, 1), own])
        return self.instrument(vectors, len(window.data)), window, u, data

    def _grouped(self, values: Array) -> Array:
        """(s, G, 3) from (m, s, E)."""
        return values.transpose(1, 2, 0).reshape(values.shape[1], len(self.names), self.group)

    # All samples ------------------------------------------------------------------------------

    def predicted(self, values: Array, phi: Array) -> Array:
        """What should be read (s, G, 3), of the first samples as far as these go."""
        instrument, window, u, data = self._at(values, phi)
        own, measured = len(window.data), self.measured.shape[2]
        data[own : own + measured], data[own + measured :] = 0.0, 1.0
        return self._grouped(instrument.residual.value(u, data))

    def residuals(self, values: Array, phi: Array) -> Array:
        """(s, G, 3) of (y − ŷ) / σ, zero where missing."""
        instrument, _, u, data = self._at(values, phi)
        return self._grouped(instrument.residual.value(u, data))

    def linearised(
        self, values: Array, slopes: Slopes, phi: Array, size: int
    ) -> tuple[Array, Array]:
        """The same, and their slopes (s, G, 3, size) by all parameters, of which φ are the last."""
        if not len(values):
            samples = len(self.window(phi, 0).places), len(self.names), self.group
            return np.zeros(samples), np.zeros((*samples, size))
        window, residual, by_u = self._read(values, phi)
        samples, each, vectors = window.places.shape
        by_looked, by_own = by_u[..., : GROUP * vectors], by_u[..., GROUP * vectors :]
        found, first = np.zeros((*by_u.shape[:3], size)), size - len(phi)
        found[..., slopes.columns] = by_looked @ _around(slopes.by, window.places)
        if len(slopes.entities):
            here = slopes.entities
            times = window.places[:, here] // values.shape[1]
            number = np.arange(len(here))[:, None]
            shape = samples, len(here), GROUP * vectors, slopes.own.shape[3]
            around = slopes.own[times, number].reshape(shape)
            _add(found, here, first + slopes.places, by_looked[:, here] @ around)
        if self.own.size:
            _add(found, np.arange(each), first + self.own, by_own)
        shape = samples, len(self.names), self.group
        return residual.reshape(shape), found.reshape(*shape, size)

    def _read(self, values: Array, phi: Array) -> tuple[Window, Array, Array]:
        """The window, residuals (s, E, m) and their slopes (s, E, m, u)."""
        if self._linear is None or len(values) < self.channel.count:
            instrument, window, u, data = self._at(values, phi)
            residual, by_u = instrument.residual.slopes(u, data)
            return window, residual.transpose(1, 2, 0), by_u.transpose(2, 3, 0, 1)
        window, at_zero, by_u = self._linear
        samples, each, vectors = window.places.shape
        around = values.reshape(-1, GROUP)[window.places].reshape(samples, each, GROUP * vectors)
        if self.own.size:
            own = np.broadcast_to(phi[self.own], (samples, *self.own.shape))
            around = np.concatenate([around, own], axis=2)
        return window, at_zero + (by_u @ around[..., None])[..., 0], by_u

    @cached_property
    def _linear(self) -> tuple[Window, Array, Array] | None:
        """The same where all is zero; None where slopes are not always the same."""
        if not self.has_fixed_windows or not self._first.residual.is_linear:
            return None
        nothing = np.zeros((self.channel.count, self.channel.each, GROUP))
        instrument, window, u, data = self._at(nothing, np.zeros(self.nuisance.size))
        residual, by_u = instrument.residual.slopes(u, data)
        by_u = np.ascontiguousarray(by_u.transpose(2, 3, 0, 1))
        return window, np.ascontiguousarray(residual.transpose(1, 2, 0)), by_u

    def changes(self, values: Array, by: Array, phi: Array) -> Array:
        """Changes (s, M, 3, c) of the residuals where what is looked at changes (n, e, 3, c)."""
        size = by.shape[3] + len(phi)
        slopes = Slopes.along(np.arange(by.shape[3]), by)
        return self.pooled(self.linearised(values, slopes, phi, size)[1][..., : by.shape[3]])

    def loss(self, values: Array, phi: Array) -> float:
        """Σ ρ."""
        if not len(values):
            return 0.0
        instrument, _, u, data = self._at(values, phi)
        return float(instrument.loss.value(u, data).sum())

    def loss_slopes(self, values: Array, phi: Array) -> tuple[Array, Array]:
        """∂loss by what is looked at (n, e, 3), and by φ (k,)."""
        by_values, by_phi = np.zeros_like(values), np.zeros(len(phi))
        if not len(values):
            return by_values, by_phi
        instrument, window, u, data = self._at(values, phi)
        by_u, places = instrument.loss.slopes(u, data)[1][0], window.places
        by_looked, by_own = np.split(by_u, [GROUP * places.shape[2]])
        by_looked = by_looked.reshape(places.shape[2], GROUP, *places.shape[:2])
        where, count = np.moveaxis(places, 2, 0).ravel(), values.size // GROUP
        for axis in range(GROUP):
            by_values[..., axis] = np.bincount(
                where, by_looked[:, axis].ravel(), minlength=count
            ).reshape(values.shape[:2])
        np.add.at(by_phi, self.own, by_own.sum(axis=1).T)
        return by_values, by_phi

    # Second derivatives -----------------------------------------------------------------------

    def _gathering(self, places: Index) -> sp.csr_array:
        """∂u/∂(c, φ) of samples (s, E, v): rows by sample, and entry of u."""
        samples, each, vectors = places.shape
        of_looked = GROUP * places[..., None] + np.arange(GROUP)
        first = GROUP * self.channel.count * self.channel.each
        own = np.broadcast_to(first + self.own, (samples, *self.own.shape))
        columns = np.concatenate([of_looked.reshape(samples, each, GROUP * vectors), own], axis=2)
        rows = np.arange(columns.size + 1)
        shape = columns.size, first + self.nuisance.size
        return sp.csr_array((np.ones(columns.size), columns.ravel(), rows), shape=shape)

    @property
    def is_quadratic(self) -> bool:
        """Whether second derivatives of the loss by what is looked at are always the same."""
        return self._first.is_quadratic

    @cached_property
    def _first(self) -> Instrument:
        window = self.window(np.zeros(self.nuisance.size), self.channel.count)
        return self.instrument(window.places.shape[2], len(window.data))

    @cached_property
    def _pattern(self) -> NDArray[np.bool_]:
        """(u, u) which second derivatives a sample may have."""
        return self._first.loss.curvature_pattern

    def hessian_structure(self, slopes: sp.csr_array) -> tuple[Index, Index]:
        """Rows and columns of ∂²loss by some variables, upper triangle, sorted by column.

        Parameters
        ----------
        slopes : the structure of the slopes of (c, φ) by these variables, all ones
        """
        places = self.windows()
        instances = int(np.prod(places.shape[:2]))
        ones = np.broadcast_to(self._pattern.astype(float), (instances, *self._pattern.shape))
        # Positive numbers cannot cancel, so that no entry is lost.
        found = _product(self._gathering(places) @ slopes, ones)
        order = np.lexsort(found[:2])
        return found.rows[order], found.columns[order]

    def hessian(
        self, values: Array, phi: Array, slopes: sp.csr_array, bent: bool = True
    ) -> Entries:
        """The values of these entries, where some are; of readings that are bent, or linear."""
        instrument, window, u, data = self._at(values, phi)
        by_u = np.moveaxis(instrument.curvature(u, data, bent), (0, 1), (2, 3))
        by_u = by_u.reshape(-1, *by_u.shape[2:])
        return _product(self._gathering(window.places) @ slopes, by_u)


def _around(by: Array, places: Index) -> Array:
    """(s, E, 3 v, c) from the vectors' (n, e, 3, c)."""
    times, each, _, count = by.shape
    flat = by.reshape(times * each, GROUP, count)[places]
    return flat.reshape(*places.shape[:2], GROUP * places.shape[2], count)


def _add(slope: Array, entities: Index, columns: Index, values: Array) -> None:
    """Add (s, e, m, k) to columns (e, k) of (s, E, m, size), in place."""
    slope[:, entities[:, None], :, columns] += values.transpose(1, 3, 0, 2)


def _product(slopes: sp.csr_array, blocks: Array) -> Entries:
    """Upper triangle of Sᵀ B S, B having the blocks (instances, u, u) on its diagonal."""
    count = np.arange(len(blocks) + 1)
    middle = sp.bsr_array((blocks, count[:-1], count))
    found = sp.coo_array(sp.triu(slopes.T @ (middle.tocsr() @ slopes), format="coo"))
    rows, columns = (np.asarray(index, dtype=np.int64) for index in found.coords)
    return Entries(rows, columns, np.asarray(found.data, dtype=np.float64))


def times_around(known_s: Array, at_s: Array, count: int) -> Index:
    """(S, count) which of some times (n,) in turn are around others (S,), as evenly as they can."""
    beside = np.searchsorted(known_s, at_s, side="right") - 1
    first = np.clip(beside - (count - 1) // 2, 0, len(known_s) - count)
    return first[:, None] + np.arange(count)


def lagrange_weights(at: T, places: Sequence[T]) -> list[Any]:
    """Weights of samples at some places, numbers or expressions, for the value between them."""
    return [
        math.prod((at - other) / (own - other) for j, other in enumerate(places) if j != i)
        for i, own in enumerate(places)
    ]
