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
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..errors import InputError
from .constants import SHARE, TAU, Constant

if TYPE_CHECKING:
    from .body import Body


@dataclass(frozen=True)
class Prony:
    """A branch of the memory: a spring of `share` times the stiffness, behind a dashpot.

    Attributes
    ----------
    name : str
        Stands before the names of its constants: ``prony_1.share``, ``prony_1.tau_s``.
    """

    name: str

    def __post_init__(self) -> None:
        if not self.name or not self.name.replace("_", "").replace("-", "").isalnum():
            raise InputError(
                f"the branch's name is {self.name!r}; expected letters, digits, - and _, which "
                "stand before the names of its parameters"
            )

    @property
    def constants(self) -> tuple[Constant, Constant]:
        """Its share g and its relaxation time τ."""
        share, tau = (replace(c, name=f"{self.name}.{c.name}") for c in (SHARE, TAU))
        return share, tau


def as_branches(given: Sequence[str | Prony]) -> tuple[Prony, ...]:
    """Branches from their names, or themselves.

    Raises
    ------
    InputError
        For a name that cannot be one, or is there twice.
    """
    if isinstance(given, str):
        raise InputError(f"prony is {given!r}; expected a sequence of names")
    branches = tuple(b if isinstance(b, Prony) else Prony(b) for b in given)
    names = [branch.name for branch in branches]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"two branches of a part are named {name!r}; names must differ")
    return branches


@dataclass(frozen=True, eq=False)
class Carried:
    """What the points of a body bring from the past into T states.

    Attributes
    ----------
    overstress : (T, width) H [Pa]
    stiffening : (T, parts) s of each part
    slopes : (T, k) derivative of its part's s by each of θ
    bends : (T, k, k) second derivatives; those by constants of different parts are zero
    """

    overstress: Array
    stiffening: Array
    slopes: Array
    bends: Array

    @classmethod
    def nothing(cls, body: Body, states: int) -> Carried:
        """Of a body that has relaxed."""
        count = len(body.constants)
        sizes = (width(body),), (len(body.parts),), (count,), (count, count)
        return cls(*(np.zeros((states, *size)) for size in sizes))

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


def branches_of(body: Body) -> list[Branch]:
    """All branches of a body."""
    found: list[Branch] = []
    starts, own = _starts(body), 0
    for number, part in enumerate(body.parts):
        first = body.starts[number] + part.of_law
        points = slice(starts[number], starts[number + 1])
        for k in range(len(part.prony)):
            here = slice(own, own + points.stop - points.start)
            found.append(Branch(number, points, here, first + 2 * k, first + 2 * k + 1))
            own = here.stop
    return found


def width(body: Body) -> int:
    """How many numbers the points of a body carry."""
    return _starts(body)[-1]


def point_places(body: Body, number: int) -> NDArray[np.int64]:
    """(E, q, 6) where in that row the points of a part are."""
    cells, points = len(body.parts[number].cells), body.geometry.shape[1]
    own = np.arange(cells * points).reshape(cells, points, 1)
    return _starts(body)[number] + own + cells * points * np.arange(6)


def _starts(body: Body) -> list[int]:
    points = body.geometry.shape[1]
    sizes = [6 * points * len(part.cells) if part.prony else 0 for part in body.parts]
    return [0, *np.cumsum(sizes).tolist()]


@dataclass(frozen=True, eq=False)
class Fading:
    """e and c of a branch over intervals, each with its derivatives by g and τ.

    Attributes
    ----------
    e, c : (N,)
    e_by, c_by : (2, N) by g, by τ
    e_bent, c_bent : (2, 2, N)
    """

    e: Array
    c: Array
    e_by: Array
    c_by: Array
    e_bent: Array
    c_bent: Array

    @classmethod
    def over(cls, share: float, tau_s: float, spacing_s: Array) -> Fading:
        """Over intervals (N,) [s] in which S changes evenly."""
        ratio = spacing_s / tau_s
        e, lost = np.exp(-ratio), -np.expm1(-ratio) / ratio
        none, by_tau = np.zeros_like(e), (lost - e) / tau_s
        e_bent, c_bent = e * ratio * (ratio - 2) / tau_s**2, -share * e * ratio / tau_s**2
        return cls(
            e,
            share * lost,
            np.stack([none, e * ratio / tau_s]),
            np.stack([lost, share * by_tau]),
            np.array([[none, none], [none, e_bent]]),
            np.array([[none, by_tau], [by_tau, c_bent]]),
        )

    @classmethod
    def after(cls, share: float, tau_s: float, held_s: float) -> Fading:
        """Of stress that came at once and was held for a time: Q = c S."""
        # Of what was held forever nothing is left, and e · ratio is no number.
        ratio = np.array([min(held_s / tau_s, 1e3)])
        e = np.exp(-ratio)
        none, by_tau, bent = 0 * e, e * ratio / tau_s, e * ratio * (ratio - 2) / tau_s**2
        return cls(
            e,
            share * e,
            np.stack([none, by_tau]),
            np.stack([e, share * by_tau]),
            np.array([[none, none], [none, bent]]),
            np.array([[none, by_tau], [by_tau, share * bent]]),
        )
