"""Viscoelastic memory: overstress in Prony branches, in the material's frame.

Beside the second Piola–Kirchhoff stress S of the long-term energy, each branch of a point has an
overstress Q,

    dQ/dt + Q/τ = g dS/dt,

which rotates with the body. Between evaluation states at an interval h, with S linear in time,

    Q_k = e Q_{k−1} + c (S_k − S_{k−1}),   e = exp(−h/τ),   c = g (τ/h) (1 − e)

holds exactly. With m_k = e_{k+1} Q_k − c_{k+1} S_k, six numbers for each point and branch,
Q_k = m_{k−1} + c_k S_k. With the sums over branches H = Σ m_{k−1} and s = Σ c_k, the stress of a
step (1 + s) S + H has the energy (1 + s) ψ + ½ H : FᵀF (Simo & Hughes 1998, ch. 10).

The internal variables of all points of a body are one row: part after part, and for each part the
entries xx, yy, zz, xy, xz, yz of all its points. `MemoryLayout` describes this row;
`model.viscoelasticity` advances the memory in time.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ...common.array_types import Array
from ..regions import BodyPart


@dataclass(frozen=True, eq=False)
class MemoryInput:
    """Contribution of the memory to the forces at T states."""

    # (T, width): sum H of the internal variables [Pa], in the order of `MemoryLayout`.
    overstress: Array
    stiffening: Array  # (T, parts): stiffening s of each part; zero for parts without memory
    # (T, k): derivative by each entry of θ of the s of the part to which the entry belongs.
    stiffening_derivatives: Array
    # (T, k, k): second derivatives of s; those by constants of different parts are zero.
    stiffening_second_derivatives: Array
    # (T, width): weights σ of S in second derivatives; None for zero.
    stress_weights: Array | None = None

    def equal_stiffening_rows(self, part: int) -> Iterator[tuple[slice, float]]:
        """Yield slices of consecutive states with equal stiffening s of a part, and s.

        Parameters
        ----------
        part : int
            Index of the part.
        """
        values = self.stiffening[:, part]
        starts = [0, *(np.flatnonzero(np.diff(values)) + 1).tolist(), len(values)]
        for start, stop in itertools.pairwise(starts):
            if stop > start:
                yield slice(start, stop), float(values[start])


@dataclass(frozen=True)
class BranchIndices:
    """Positions of a Prony branch in the arrays of a body."""

    part: int  # index of its part
    points: slice  # columns in the row of the body, (…, width)
    columns: slice  # columns in the row of all branches, (…, all branches)
    # Indices of g and τ in θ.
    share: int
    tau: int


@dataclass(frozen=True, eq=False)
class MemoryLayout:
    """Layout of the internal variables of a body in one row: the parts with memory in turn."""

    parts: tuple[BodyPart, ...]
    first_constants: Sequence[int]  # (parts,): index in θ of the first memory constant of each part
    points_per_element: int  # quadrature points of an element
    constant_count: int  # length of θ

    @cached_property
    def starts(self) -> list[int]:
        """First column of each part in the row, then the length of the row; a part without memory
        has no columns.
        """
        sizes = [6 * self.points_per_element * len(p.cells) if p.prony else 0 for p in self.parts]
        return [0, *np.cumsum(sizes).tolist()]

    @property
    def oscillates(self) -> bool:
        """Whether the evaluations are those of steady oscillations, at quarters of their periods."""
        return any(part.oscillates for part in self.parts)

    @property
    def width(self) -> int:
        """Length of the row of a body."""
        return self.starts[-1]

    def part_columns(self, number: int) -> NDArray[np.int64]:
        """Return the columns (E, q, 6) in the row of the points of a part: the six entries of a
        point are not neighbours, but E·q columns apart.

        Parameters
        ----------
        number : int
            Index of the part, which has memory.
        """
        cells = len(self.parts[number].cells)
        indices = np.arange(cells * self.points_per_element).reshape(
            cells, self.points_per_element, 1
        )
        return self.starts[number] + indices + cells * self.points_per_element * np.arange(6)

    @cached_property
    def branches(self) -> list[BranchIndices]:
        """Branches of all parts, in the order of the parts."""
        branches: list[BranchIndices] = []
        start = 0
        for number, part in enumerate(self.parts):
            points = slice(self.starts[number], self.starts[number + 1])
            for k in range(len(part.prony)):
                columns = slice(start, start + points.stop - points.start)
                first_constant = self.first_constants[number] + 2 * k
                branches.append(
                    BranchIndices(
                        number,
                        points,
                        columns=columns,
                        share=first_constant,
                        tau=first_constant + 1,
                    )
                )
                start = columns.stop
        return branches

    def to_branches(self, values: Array) -> Array:
        """Return values (…, all branches) from values (…, width) for each point: those of a part
        are repeated for each of its branches. A view with a single branch; there must be at least
        one.
        """
        parts = [values[..., branch.points] for branch in self.branches]
        return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=-1)

    def sum_over_branches(self, values: Array) -> Array:
        """Return the sums (…, width) over the branches of each point: the transpose of
        `to_branches`. For a single branch the argument itself is returned.

        Parameters
        ----------
        values : (…, all branches)
        """
        if len(self.branches) == 1:
            return values
        sums = np.zeros((*values.shape[:-1], self.width))
        for branch in self.branches:
            sums[..., branch.points] += values[..., branch.columns]
        return sums

    def repeat_over_points(self, values: Array) -> Array:
        """Return values (…, all branches) from one value for each branch (branches, …).

        With a single branch the result has one column, (…, 1), which broadcasts.
        """
        if len(self.branches) == 1:
            return values[0][..., None]
        sizes = [branch.columns.stop - branch.columns.start for branch in self.branches]
        return np.moveaxis(np.repeat(values, sizes, axis=0), 0, -1)

    def sum_over_points(self, values: Array) -> Array:
        """Return the sums (branches, …) over all entries of values (…, all branches) of each
        branch.
        """
        return np.stack([values[..., branch.columns].sum(axis=-1) for branch in self.branches])

    def relaxed(self, states: int) -> MemoryInput:
        """Return the contribution of a memory that has relaxed, at a number of states: all zero,
        without stress weights.
        """
        count = self.constant_count
        sizes = (self.width,), (len(self.parts),), (count,), (count, count)
        return MemoryInput(*(np.zeros((states, *size)) for size in sizes))
