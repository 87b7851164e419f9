"""What a recording measures: the base class of markers, wrenches, custom sensors and depth cameras.

Comparisons with a motion, copies of other recordings, series over time and texts follow from the
attributes of `Measurement`, so that they are the same for every kind.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import Field
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..common.array_types import Array
from ..common.checked_arrays import float_array, read_only_floats
from ..common.display import quantity
from ..errors import InputError
from .sample_times import TIME_TOLERANCE_S


def root_mean(squares: Array) -> float:
    """Return the square root of the mean of `squares`; 0 for an empty array."""
    return float(np.sqrt(squares.mean())) if squares.size else 0.0


class Measurement:
    """Measurement of one instrument of a recording.

    Attributes
    ----------
    measurement_text, other_text : str
        Plural text of what it measures, and of those of another recording.
    noise_key, sigma_text : str
        Key that states its noise, as in messages on all recordings and on this measurement.
    unit : str
        Unit of its numbers; "" if it is not stated.
    symmetry : int
        Ratio of the reported values to those of the modelled part of the specimen.
    points_name : str
        Plural of its unlabelled points; not used without any.
    precedence : int
        Of several kinds, the one with the smallest number is the main measurement.
    sigma_ratios : (S, m) array or None
        Standard deviation of each number over its `value_sigmas`; None if those hold for all
        samples.
    counts_pixels : bool
        Whether its numbers are pixels from a corner of an image: their sign, unit and zero cannot be
        wrong, and a flipped image shows a mirror image of the body.
    needs_surface : bool
        Whether it observes the surface of the body, which a rod does not have.
    """

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]  # subclasses are dataclasses
    measurement_text: ClassVar[str]
    other_text: ClassVar[str]
    noise_key: ClassVar[str]
    sigma_text: ClassVar[str] = "its sigma"
    unit: str = ""
    symmetry: int = 1
    points_name: ClassVar[str] = "points"
    precedence: ClassVar[int] = 3
    counts_pixels: ClassVar[bool] = False
    needs_surface: ClassVar[bool] = False
    sigma_ratios: Array | None = None

    @property
    @abstractmethod
    def title(self) -> str:
        """Instrument in messages; measurements with the same title are numbered."""

    @property
    def samples_text(self) -> str:
        """Its samples in messages; "" if that is the title."""
        return ""

    @property
    def instrument_text(self) -> str:
        """What it measures, for the list of instruments of a recording; "" if listed apart."""
        return self.title

    @property
    @abstractmethod
    def sample_times_s(self) -> Array:
        """Times (S,) of its samples [s]."""

    @property
    def measured_values(self) -> Array:
        """Measured numbers (S, m), NaN where missing; here none, m = 0, for unlabelled points."""
        return np.zeros((len(self.sample_times_s), 0))

    @property
    def value_sigmas(self) -> Array:
        """Standard deviations (m,) of the noise of its numbers; medians if samples differ."""
        return np.zeros(0)

    @property
    def sample_sigmas(self) -> Array:
        """Standard deviations of the noise of each sample, (S, m), or (1, m) if they are equal."""
        ratios = np.ones((1, 1)) if self.sigma_ratios is None else self.sigma_ratios
        return self.value_sigmas * ratios

    @property
    def identity(self) -> Any:
        """What two recordings must have in common so that one's measurement predicts the other's."""
        return self.title

    def series(self) -> Iterator[tuple[str, Array]]:
        """Yield the name of each series of its values, and these, by which copies are found."""
        columns = np.ascontiguousarray(self.measured_values.T)
        yield from zip(map(str, self.number_names), columns, strict=True)

    def values_of(self, other: Any) -> Array:
        """Return the values (S, m) of a measurement with the same `identity` as a prediction."""
        return other.measured_values

    def vectors(self, values: Array) -> Array:
        """Return numbers (S, m) as K vectors or numbers (S, K, d) by which a prediction is judged."""
        return values[:, None]

    def rms_text(self, difference: Array) -> str:
        """Return the RMS of differences (S, m) from the measured numbers, with its unit; "" if none
        is finite.
        """
        known = difference[np.isfinite(difference)]
        return f"{quantity(root_mean(known**2), self.unit)} RMS" if known.size else ""

    @property
    def number_names(self) -> Sequence[str]:
        """Names (m,) of its numbers."""
        return [f"{self.title} {k + 1}" for k in range(self.measured_values.shape[1])]

    @property
    def presence(self) -> dict[str, NDArray[np.bool_]]:
        """Mask (S,) of the samples in which each number is present, by its name."""
        masks = np.isfinite(self.measured_values).T
        return dict(zip(self.number_names, masks, strict=True))

    def has_samples(self) -> bool:
        """Return whether a number or a point is measured."""
        return bool(np.isfinite(self.measured_values).any() or any(self.point_counts))

    def _ratios_for(self, t_s: ArrayLike) -> Array | None:
        """Return the ratios of σ for as many samples, else None: the usual σ."""
        is_same = self.sigma_ratios is not None and np.size(t_s) == len(self.sigma_ratios)
        return self.sigma_ratios if is_same else None

    # Other samples, and a part of them ---------------------------------------------------------

    def with_samples(self, t_s: ArrayLike, values: ArrayLike) -> Self:
        """Return a copy with other numbers (S, m) at times (S,) [s]; here self, for unlabelled
        points.
        """
        return self

    def with_zeros_at(self, t_s: ArrayLike) -> Self:
        """Return a copy with zeros at the times `t_s` (S,) [s], as placeholders."""
        return self.with_samples(t_s, np.zeros((np.size(t_s), self.measured_values.shape[1])))

    @property
    def point_counts(self) -> Sequence[int]:
        """Numbers of unlabelled points of each sample; empty if the sensor measures none."""
        return ()

    def thinned(self, most: int) -> Self:
        """Return a sensor with at most `most` unlabelled points in each sample; here self."""
        return self

    @property
    def first_useful_s(self) -> float:
        """Time of its first sample that shows the body [s]; here any time, −∞."""
        return -np.inf

    def until_time(self, end_s: float) -> Self | None:
        """Return the sensor for a recording that ends at `end_s` [s], this time included; None if
        it has no measurement then. Here self: later samples are ignored.
        """
        return self

    def within(self, t_s: Array, fewest: int) -> Self | None:
        """Return the sensor with only its samples from the first to the last of the times `t_s` (T,)
        [s]; None if these are fewer than `fewest`, or nothing is measured at them. Here the same as
        `until_time`.
        """
        return self.until_time(t_s[-1] + TIME_TOLERANCE_S)

    def without_later_values(self, end_s: float) -> Self | None:
        """Return the sensor without measurements after `end_s` [s] in a recording that continues;
        None if nothing is measured before. Here NaN in their place, or for unlabelled points the
        same as `until_time`.
        """
        if not self.value_sigmas.size:
            return self.until_time(end_s)
        is_later = (self.sample_times_s > end_s)[:, None]
        values = np.where(is_later, np.nan, self.measured_values)
        if not np.isfinite(values).any():
            return None
        return self.with_samples(self.sample_times_s, values)


def split_sigma(
    sigma: ArrayLike, is_measured: NDArray[np.bool_], name: str
) -> tuple[float, Array | None]:
    """Return the median of standard deviations, and their ratios (S, m) to it, 1 where nothing is
    measured; the ratios are None for one standard deviation of all samples.

    Parameters
    ----------
    sigma : float, (S,) or (S, m) array
        Standard deviations; any value, also NaN, where nothing is measured.
    is_measured : (S, m) array of bool
    name : str
        What they are, for messages.

    Raises
    ------
    InputError
        If the shape differs, or a number is measured whose standard deviation is not above 0.
    """
    if not np.ndim(sigma):
        return float(np.asarray(sigma)), None
    count, numbers = is_measured.shape
    given = float_array(sigma, name, ((count,), (count, 1), (count, numbers)), finite=False)
    each = np.broadcast_to(given.reshape(count, -1), is_measured.shape)
    wrong = is_measured & ~(np.isfinite(each) & (each > 0))
    if wrong.any():
        row, column = np.argwhere(wrong)[0]
        raise InputError(
            f"{name} is {each[row, column]:g} in row {row + 1}; expected more than 0 in every row "
            "with a measured number"
        )
    usual = float(np.median(each[is_measured])) if is_measured.any() else 1.0
    return usual, np.where(is_measured, each / usual, 1.0)


def checked_ratios(ratios: ArrayLike, shape: tuple[int, int], where: str) -> Array:
    """Return the ratios of σ as a read-only array (S, m)."""
    return read_only_floats(ratios, shape, name=f"sigma_ratios of {where}")
