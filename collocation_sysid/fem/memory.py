"""Materials with memory: overstress in Prony branches, in the material's own frame.

Beside S, the second Piola–Kirchhoff stress of the long-term energy, each branch of a point bears Q,

    dQ/dt + Q/τ = g dS/dt,

which turns with the body. Between evaluation states h apart, S linear in time, exactly

    Q_k = e Q_{k−1} + c (S_k − S_{k−1}),   e = exp(−h/τ),   c = g (τ/h) (1 − e).

So with m_k = e_{k+1} Q_k − c_{k+1} S_k, six numbers of a point and branch, Q_k = m_{k−1} + c_k S_k.
At given H = Σ m_{k−1} and s = Σ c_k, sums over branches, a step's stress (1 + s) S + H has the
energy (1 + s) ψ + ½ H : FᵀF. (Simo & Hughes 1998, ch. 10.)

What all points of a body carry is one row: part after part, and of each the entries xx, yy, zz, xy,
xz, yz of all its points.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from .regions import BodyPart


@dataclass(frozen=True, eq=False)
class Past:
    """What the points of a body bring from the past into T states.

    Attributes
    ----------
    overstress : (T, width) H [Pa]
    stiffening : (T, parts) s of each part
    slopes : (T, k) derivative of its part's s by each of θ
    bends : (T, k, k) second derivatives; those by constants of different parts are zero
    stress_weights : (T, width) σ, optional
        What S counts besides in second derivatives.
    """

    overstress: Array
    stiffening: Array
    slopes: Array
    bends: Array
    stress_weights: Array | None = None

    def runs(self, part: int) -> Iterator[tuple[slice, float]]:
        """Rows that follow one another with the same s of a part, and that."""
        values = self.stiffening[:, part]
        starts = [0, *(np.flatnonzero(np.diff(values)) + 1).tolist(), len(values)]
        for start, stop in itertools.pairwise(starts):
            if stop > start:
                yield slice(start, stop), float(values[start])


@dataclass(frozen=True)
class Branch:
    """A branch as it is computed.

    Attributes
    ----------
    part : int
        Number of its part.
    points : slice
        Of what the body carries.
    own : slice
        Of what all branches carry, one after the other.
    share, tau : int
        Places of g and τ in θ.
    """

    part: int
    points: slice
    own: slice
    share: int
    tau: int


@dataclass(frozen=True, eq=False)
class PointLayout:
    """What the points of a body carry, in one row: the parts with memory in turn.

    Attributes
    ----------
    parts : tuple of BodyPart
    first : (parts,) where the constants of each part's laws of memory begin in θ
    points : int
        Quadrature points of an element.
    constants : int
        Length of θ.
    """

    parts: tuple[BodyPart, ...]
    first: Sequence[int]
    points: int
    constants: int

    @cached_property
    def starts(self) -> list[int]:
        """Where in the row each part begins, and where the last ends."""
        sizes = [6 * self.points * len(p.cells) if p.prony else 0 for p in self.parts]
        return [0, *np.cumsum(sizes).tolist()]

    @property
    def width(self) -> int:
        """Length of the row."""
        return self.starts[-1]

    def of_part(self, number: int) -> NDArray[np.int64]:
        """(E, q, 6) where in the row the points of a part are."""
        cells = len(self.parts[number].cells)
        own = np.arange(cells * self.points).reshape(cells, self.points, 1)
        return self.starts[number] + own + cells * self.points * np.arange(6)

    @cached_property
    def branches(self) -> list[Branch]:
        """Those of all parts."""
        found: list[Branch] = []
        own = 0
        for number, part in enumerate(self.parts):
            points = slice(self.starts[number], self.starts[number + 1])
            for k in range(len(part.prony)):
                here = slice(own, own + points.stop - points.start)
                place = self.first[number] + 2 * k
                found.append(Branch(number, points, here, place, place + 1))
                own = here.stop
        return found

    def borne(self, values: Array) -> Array:
        """(…, all branches) what each branch's points have, of a row (…, width)."""
        parts = [values[..., branch.points] for branch in self.branches]
        return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=-1)

    def summed(self, values: Array) -> Array:
        """(…, width), its transpose: the sum of what branches (…, all branches) have of a point."""
        if len(self.branches) == 1:
            return values
        found = np.zeros((*values.shape[:-1], self.width))
        for branch in self.branches:
            found[..., branch.points] += values[..., branch.own]
        return found

    def spread(self, values: Array) -> Array:
        """Of all that a branch carries (…, all branches) what the branch has (branches, …)."""
        if len(self.branches) == 1:
            return values[0][..., None]
        sizes = [branch.own.stop - branch.own.start for branch in self.branches]
        return np.moveaxis(np.repeat(values, sizes, axis=0), 0, -1)

    def totals(self, values: Array) -> Array:
        """(branches, …) sums over all that a branch carries (…, all branches)."""
        return np.stack([values[..., branch.own].sum(axis=-1) for branch in self.branches])

    def nothing(self, states: int) -> Past:
        """What points that have relaxed bring into some states."""
        count = self.constants
        sizes = (self.width,), (len(self.parts),), (count,), (count, count)
        return Past(*(np.zeros((states, *size)) for size in sizes))


def fading(share: Array, tau_s: Array, spacing_s: float) -> tuple[Array, Array]:
    """E and c of branches over an interval [s] in which S changes evenly."""
    ratio = spacing_s / tau_s
    return np.exp(-ratio), -share * np.expm1(-ratio) / ratio
