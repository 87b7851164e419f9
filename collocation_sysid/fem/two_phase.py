"""Two materials with a sharp boundary: every element is of the surroundings or of an inclusion.

In a part of a body whose field has `prior = "two-phase"` a constant c has one value in the
surroundings and another in inclusions, ln c_e = ln c_0 + ln r · h_e, with the contrast r = c_1/c_0,
which is a parameter, and h_e ∈ {0, 1}, the phase of element e. Phases are no parameters: for a
solver they are given, and `statistics.phases` finds them from derivatives by `ElementLogarithms`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array, Index
from ..errors import InputError
from .constants import CONTRAST, DENSITY, Constant, mode
from .field import SMOOTH, Field, FieldModes
from .mesh import TetMesh


@dataclass(frozen=True, eq=False)
class PhaseSamples:
    """Draws from the posterior of the phases, with what goes with each of them.

    Attributes
    ----------
    logarithms : (K, E) of the constant in every element
    contrasts : (K,) logarithm of the contrast
    volumes_m3 : (K,) of the inclusions
    names : (p,) of parameters
    deviations : (p, p)
        Covariance of the means of these parameters, in the solver's coordinates, given each draw
        of the phases: what not knowing the phases adds to their covariance.
    misfit : float
        χ² per measurement of the answer, with the standard deviations given.
    smooth_misfit : float
        χ² per measurement of the smooth field with which the search for the phases started.
    """

    logarithms: Array
    contrasts: Array
    volumes_m3: Array
    names: tuple[str, ...]
    deviations: Array
    misfit: float
    smooth_misfit: float


@dataclass(frozen=True)
class PhaseFinding:
    """What is found of two phases.

    Attributes
    ----------
    contrast : (lower, median, upper)
        Ratio of the inclusion to the surroundings, with the 95 % interval of its statistical error
        and of the phases.
    volume_m3 : (lower, median, upper) of the inclusion, likewise
    deviation : float
        Standard deviation of the logarithm in an element of which nothing but the two values is
        known: each phase as likely.
    misfit, smooth_misfit : float
        χ² per measurement of the answer, and of the smooth field before it.
    elements : int
        Number of elements of the smaller phase.
    """

    contrast: tuple[float, float, float]
    volume_m3: tuple[float, float, float]
    deviation: float
    misfit: float
    smooth_misfit: float
    elements: int


@dataclass(frozen=True, eq=False)
class TwoPhaseModes(FieldModes):
    """A two-phase field as the body evaluates it; its only coefficient is the contrast r.

    Attributes
    ----------
    phase : (E,)
        0 in the surroundings, 1 in inclusions; 0 everywhere until phases are known.
    samples : PhaseSamples or None
        Draws from the posterior of the phases; None before there is an answer.
    """

    phase: Array = field(default_factory=lambda: np.zeros(0))
    samples: PhaseSamples | None = None

    @classmethod
    def of(
        cls, field: Field, mesh: TetMesh, cells: Index, law: tuple[Constant, ...]
    ) -> TwoPhaseModes:
        """Return the two-phase field of some cells, of constants of material and damping law.

        Raises
        ------
        InputError
            If none of these is the field's, or the field is of a density or has several lengths.
        """
        if field.parameter == DENSITY.name:
            raise InputError(
                f"prior of a field of {DENSITY.name} is 'two-phase'; expected 'smooth', or regions "
                "with densities of their own"
            )
        if len(field.lengths_m) > 1:
            raise InputError(
                f"length_m of a two-phase field has {len(field.lengths_m)} values; expected one: "
                "lengths to choose from are for prior = 'smooth'"
            )
        found = super().of(field, mesh, cells, law)
        assert isinstance(found, cls)
        return replace(found, phase=np.zeros(len(cells)))

    @property
    def has_phases(self) -> bool:
        """Whether phases are known."""
        return bool(self.phase.any())

    @property
    def smooth(self) -> FieldModes:
        """Smooth field with which the search for the phases starts."""
        field = replace(self.field, prior=SMOOTH, amplitude=None)
        return FieldModes(field, self.laplacian, self.scaled, self.length_m, self.volumes_m3)

    @property
    def share(self) -> float:
        """Share of the variance that the smooth field of the start has."""
        return self.smooth.share

    @property
    def shapes(self) -> Array:
        """Derivative (E, 1) of `logarithms` by ln r."""
        return self.phase[:, None]

    @property
    def constants(self) -> tuple[Constant, ...]:
        """The contrast r."""
        return (CONTRAST,)

    def split_in_eight(self) -> TwoPhaseModes:
        """Return the same field of a mesh whose cells are cut in eight."""
        finer = super().split_in_eight()
        assert isinstance(finer, TwoPhaseModes)
        samples = self.samples
        if samples is not None:
            samples = replace(samples, logarithms=np.repeat(samples.logarithms, 8, axis=1))
        return replace(finer, phase=np.repeat(self.phase, 8), samples=samples)

    def logarithms(self, coefficients: Array) -> Array:
        """Return ln r · h (E,) in every cell, from the contrast (1,)."""
        return np.log(coefficients[0]) * self.phase

    def slopes(self, coefficients: Array) -> Array:
        """Return the derivatives (E, 1) of `logarithms` by the contrast."""
        return self.phase[:, None] / coefficients[0]

    def curvature(self, coefficients: Array, weights: Array) -> Array:
        """Return Σ weights (T, E) · ∂² of `logarithms` by the contrast, (T, 1, 1)."""
        return -(weights @ self.phase)[:, None, None] / coefficients[0] ** 2


@dataclass(frozen=True, eq=False)
class ElementLogarithms(FieldModes):
    """A field with one coefficient per element, about given logarithms: for derivatives by each.

    Attributes
    ----------
    base : (E,) logarithm of the constant over its mean in every cell where coefficients are zero
    """

    base: Array = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def about(cls, modes: FieldModes, base: Array) -> ElementLogarithms:
        """Return one for the cells of a field."""
        field = replace(modes.field, prior=SMOOTH, modes=len(base))
        volumes_m3 = modes.volumes_m3
        return cls(field, modes.laplacian, modes.scaled, modes.length_m, volumes_m3, base)

    @cached_property
    def shapes(self) -> Array:
        """Identity (E, E)."""
        return np.eye(len(self.base))

    @property
    def constants(self) -> tuple[Constant, ...]:
        """One coefficient per element."""
        return tuple(mode(k) for k in range(len(self.base)))

    def logarithms(self, coefficients: Array) -> Array:
        """Return the base plus the coefficients, (E,)."""
        return self.base + coefficients


def inclusion(phase: Array) -> NDArray[np.bool_]:
    """Return which elements (E,) are of an inclusion, by phases (E,) between 0 and 1."""
    return phase > 0.5
