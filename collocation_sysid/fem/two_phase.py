"""Fields of two materials with a sharp boundary: every element belongs to one of two phases.

If the field of a part has `prior = "two-phase"`, a constant c has one value in the surroundings and
another in inclusions, ln c_e = ln c_0 + ln r · h_e, with the contrast r = c_1/c_0, which is a
parameter, and the phase h_e ∈ {0, 1} of element e. Phases are not parameters: solvers keep them
fixed, and `statistics.phase_sampling` determines them with derivatives by `ElementLogarithms`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from ..common.array_types import Array, Index
from ..errors import InputError
from .laws.constants import CONTRAST, DENSITY, Constant, field_coefficient
from .meshes.mesh import TetMesh
from .spatial_field import SMOOTH, Field, FieldModes


@dataclass(frozen=True, eq=False)
class PhaseSamples:
    """Samples of the posterior of the phases."""

    logarithms: Array  # (K, E): logarithm of the constant in every element, relative to its mean
    contrasts: Array  # (K,): logarithm of the contrast
    volumes_m3: Array  # (K,): volume of the inclusions
    names: tuple[str, ...]  # (p,): names of the parameters of `deviations`
    # (p, p): second moments, about the estimates, of the conditional means of these parameters
    # given each sample of the phases, in the solver's coordinates: the part of their covariance due
    # to unknown phases.
    deviations: Array
    misfit: float  # χ² per measurement of the solution, with the given standard deviations
    # χ² per measurement of the smooth field with which the search for the phases started.
    smooth_misfit: float
    # Potential scale reduction of the contrast, see
    # `statistics.phase_sampling.PosteriorDraws.scale_reduction`.
    scale_reduction: float = 1.0
    # Whether the linearised measurements were corrected with simulations of samples.
    is_simulated: bool = True


@dataclass(frozen=True)
class PhaseSummary:
    """Summary of the phases of a two-phase field."""

    # (lower, median, upper): ratio of the inclusion to the surroundings, with the 95 % interval of
    # its statistical error and of the phases.
    contrast: tuple[float, float, float]
    # (lower, median, upper): volume of the inclusion, with the same interval.
    volume_m3: tuple[float, float, float]
    # Standard deviation of the logarithm in an element whose two phases are equally likely.
    deviation: float
    # χ² per measurement of the solution, and of the smooth field before it.
    misfit: float
    smooth_misfit: float
    elements: int  # number of elements of the smaller phase
    # Potential scale reduction of the contrast, about 1 if all chains of samples agree.
    scale_reduction: float = 1.0
    # Whether the linearised measurements were corrected with simulations of samples.
    is_simulated: bool = True


@dataclass(frozen=True, eq=False)
class TwoPhaseModes(FieldModes):
    """Two-phase field of a part; its only coefficient is the contrast r."""

    # (E,): 0 in the surroundings, 1 in inclusions; 0 everywhere until phases are known.
    phase: Array = field(default_factory=lambda: np.zeros(0))
    # Samples of the posterior of the phases; None before there is a solution.
    samples: PhaseSamples | None = None

    @classmethod
    def from_field(
        cls, field: Field, mesh: TetMesh, cells: Index, law: tuple[Constant, ...]
    ) -> TwoPhaseModes:
        """Return the two-phase field of some cells, see `FieldModes.from_field`; all cells are in
        the surroundings at first.

        Raises
        ------
        InputError
            If the field's parameter is not a constant of material or damping law, is a density, or
            has several correlation lengths.
        """
        if field.parameter == DENSITY.name:
            raise InputError(
                f"the field of {DENSITY.name} has prior = 'two-phase'; expected prior = 'smooth', or "
                "regions with densities of their own in place of the field"
            )
        if len(field.lengths_m) > 1:
            raise InputError(
                f"length_m of a two-phase field has {len(field.lengths_m)} values; expected one: "
                "lengths to choose from are for prior = 'smooth'"
            )
        modes = super().from_field(field, mesh, cells=cells, law=law)
        assert isinstance(modes, cls)
        return replace(modes, phase=np.zeros(len(cells)))

    def has_phases(self) -> bool:
        """Return whether any element is in an inclusion; false until phases are known, and also if
        the solution has none.
        """
        return bool(self.phase.any())

    def to_smooth_field(self) -> FieldModes:
        """Return the smooth field of the same cells and correlation length, with the default
        amplitude, with which the search for the phases starts.
        """
        field = replace(self.field, prior=SMOOTH, amplitude=None)
        return FieldModes(
            field,
            self.laplacian,
            scaled_indices=self.scaled_indices,
            length_m=self.length_m,
            volumes_m3=self.volumes_m3,
        )

    @property
    def variance_share(self) -> float:
        """Share of the prior variance that the shapes of the smooth field represent."""
        return self.to_smooth_field().variance_share

    @property
    def shapes(self) -> Array:
        """Derivative (E, 1) of `logarithms` by ln r."""
        return self.phase[:, None]

    @property
    def constants(self) -> tuple[Constant, ...]:
        """Constant of the contrast r."""
        return (CONTRAST,)

    def split_in_eight(self) -> TwoPhaseModes:
        """Return this field on a mesh whose cells are split into eight, each in place of one;
        phases and samples are those of the cell before.
        """
        finer = super().split_in_eight()
        assert isinstance(finer, TwoPhaseModes)
        samples = self.samples
        if samples is not None:
            samples = replace(samples, logarithms=np.repeat(samples.logarithms, 8, axis=1))
        return replace(finer, phase=np.repeat(self.phase, 8), samples=samples)

    def logarithms(self, coefficients: Array) -> Array:
        """Return ln r · h (E,) in every cell, from the contrast r > 0 itself, not its logarithm,
        (1,).
        """
        return np.log(coefficients[0]) * self.phase

    def jacobian(self, coefficients: Array) -> Array:
        """Return the derivatives h/r (E, 1) of `logarithms` by the contrast r, (1,)."""
        return self.phase[:, None] / coefficients[0]

    def weighted_hessian(self, coefficients: Array, weights: Array) -> Array:
        """Return the second derivative (T, 1, 1) of Σ_e weights[t, e] ln c_e by the contrast, the
        only coefficient, for weights (T, E).
        """
        return -(weights @ self.phase)[:, None, None] / coefficients[0] ** 2


@dataclass(frozen=True, eq=False)
class ElementLogarithms(FieldModes):
    """Field with one coefficient per element, relative to given logarithms: for derivatives by each
    one.
    """

    # (E,): logarithm of the constant relative to its mean where all coefficients are zero.
    base: Array = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def relative_to(cls, modes: FieldModes, base: Array) -> ElementLogarithms:
        """Return such a field on the cells of another field, with its parameter and correlation
        length.

        Parameters
        ----------
        modes : FieldModes
            Smooth or two-phase field.
        base : (E,)
            Logarithms of the constant relative to its mean where all coefficients are zero.
        """
        field = replace(modes.field, prior=SMOOTH, modes=len(base))
        volumes_m3 = modes.volumes_m3
        return cls(
            field,
            modes.laplacian,
            scaled_indices=modes.scaled_indices,
            length_m=modes.length_m,
            volumes_m3=volumes_m3,
            base=base,
        )

    @cached_property
    def shapes(self) -> Array:
        """Derivatives of the logarithms by the coefficients: the identity (E, E)."""
        return np.eye(len(self.base))

    @property
    def constants(self) -> tuple[Constant, ...]:
        """Constants of the coefficients, one per element."""
        return tuple(field_coefficient(k) for k in range(len(self.base)))

    def logarithms(self, coefficients: Array) -> Array:
        """Return the base plus the coefficients, (E,)."""
        return self.base + coefficients
