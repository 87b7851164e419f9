"""Differences between a prediction and the measurements of one instrument, in stated σ."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..common.array_types import Array, root_mean


@dataclass(frozen=True)
class InstrumentMisfit:
    """Differences between a prediction and the measurements of one kind, in stated σ."""

    what: str  # what is measured, for people
    sigma_key: str  # key of σ in the problem, for people
    sigmas: float  # root mean square of the differences over σ
    # The same without outliers of depth, see `DepthError`; predictions are judged by it.
    robust_sigmas: float
    count: int  # number of measured values
    size: str = ""  # root mean square in a unit, for people; empty if units differ

    @property
    def size_text(self) -> str:
        """`size`, or without one the multiple of σ in words."""
        return self.size or f"{self.sigmas:.3g} times {self.sigma_key}"


def misfit(what: str, declared_size: str, ratio: Array, size: str = "") -> InstrumentMisfit:
    """Return the misfit of one instrument; its RMS is that of the values that are finite.

    Parameters
    ----------
    what : str
        The instrument, for messages.
    declared_size : str
        Name of its stated σ, for messages.
    ratio : array
        Differences over σ; NaN is ignored.
    size : str
        RMS with its unit, for messages; "" if there is none.
    """
    known = ratio[np.isfinite(ratio)]
    sigmas = root_mean(known**2)
    return InstrumentMisfit(
        what, declared_size, sigmas=sigmas, robust_sigmas=sigmas, count=known.size, size=size
    )
