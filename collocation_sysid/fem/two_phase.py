"""Two materials with a sharp boundary: a level set of a normal field tells which of them is where.

In a part of a body whose field has `prior = "two-phase"` a constant c has one value in the
surroundings and another in inclusions,

    ln c(X) = ln c_0 + ln r · H(φ(X)),   φ(X) = a_0 + Σ a_i φ_i(X),   H(φ) = ½ (1 + tanh(φ/ε)),

with the contrast r = c_1/c_0 and coefficients a ~ N(0, I). φ has the deviation 1 about a_0 and
smoother shapes than the field of `field`: φ_i ∝ v_i/(1/l² + λ_i)². The step H is known: where φ has
the root mean square of its prior's slopes, H rises from 0.12 to 0.88 over `width_m`. Elements cut
by the boundary have a value between.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..arrays import Array, Index
from ..errors import InputError
from .constants import CONTRAST, DENSITY, Constant, mode
from .field import Field, FieldModes
from .mesh import TetMesh

# Exponent p of the spectrum of φ, (1/l² + λ)⁻ᵖ: a smoothness of 5/2, so that φ has slopes and its
# level sets are surfaces. With p = 1 the boundary would be as rough as the shapes allow.
POWER = 2


@dataclass(frozen=True, eq=False)
class TwoPhaseModes(FieldModes):
    """A two-phase field as the body evaluates it; its coefficients are a_0, …, a_m and r.

    Attributes
    ----------
    width_m : float
        Over which distance the step H rises from 0.12 to 0.88.
    """

    width_m: float = 0.0

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
        # The edge of a regular tetrahedron of the mean volume.
        edge_m = (6 * np.sqrt(2) * float(found.volumes_m3.mean())) ** (1 / 3)
        return replace(found, width_m=field.width_m or edge_m)

    @cached_property
    def share(self) -> float:
        """Share of the shapes in the variance of φ about a_0."""
        return self.laplacian.share(self.length_m, POWER)

    @property
    def left_out(self) -> float:
        """Deviation of φ by shapes that are finer than these."""
        return float(np.sqrt(1 - self.share))

    @cached_property
    def shapes(self) -> Array:
        """φ_0 = 1, φ_1, … (E, m + 1) in the cells."""
        weighed = self.laplacian.weights(self.length_m, POWER)[:, None] * self.laplacian.vectors
        own = np.sqrt(self.share) * weighed / np.linalg.norm(weighed, axis=0)
        return np.column_stack([np.ones(own.shape[1]), own.T])

    @cached_property
    def step(self) -> float:
        """Half the rise ε of φ over the width of the boundary."""
        squares = self.volumes_m3 @ self.shapes[:, 1:] ** 2 / self.volumes_m3.sum()
        return float(np.sqrt(squares @ self.laplacian.values)) * self.width_m / 2

    @property
    def constants(self) -> tuple[Constant, ...]:
        """Constants a_0, …, a_m and r."""
        return (*(mode(k - 1) for k in range(self.field.modes + 1)), CONTRAST)

    def phase(self, coefficients: Array) -> Array:
        """Return H(φ) (E,) in every cell: 0 in the surroundings, 1 in inclusions."""
        return self.step_of(self.shapes @ coefficients[:-1])

    def step_of(self, level: Array) -> Array:
        """Return H at values of φ of any shape."""
        return (1 + np.tanh(level / self.step)) / 2

    def logarithms(self, coefficients: Array) -> Array:
        """Return ln r · H(φ) (E,) in every cell."""
        return np.log(coefficients[-1]) * self.phase(coefficients)

    def slopes(self, coefficients: Array) -> Array:
        """Return the derivatives (E, m + 2) of `logarithms` by a_0, …, a_m and r."""
        contrast = coefficients[-1]
        phase = self.phase(coefficients)
        by_level = np.log(contrast) * self._step_slope(phase)
        return np.column_stack([by_level[:, None] * self.shapes, phase / contrast])

    def curvature(self, coefficients: Array, weights: Array) -> Array:
        """Return Σ weights (T, E) · ∂² of `logarithms` by a_0, …, a_m and r, (T, m + 2, m + 2)."""
        contrast = coefficients[-1]
        phase = self.phase(coefficients)
        slope = self._step_slope(phase)
        bend = np.log(contrast) * 2 * (1 - 2 * phase) / self.step * slope
        found = np.empty((len(weights), len(coefficients), len(coefficients)))
        for weight, own in zip(weights, found, strict=True):
            own[:-1, :-1] = self.shapes.T @ ((weight * bend)[:, None] * self.shapes)
            mixed = self.shapes.T @ (weight * slope) / contrast
            own[:-1, -1] = mixed
            own[-1, :-1] = mixed
            own[-1, -1] = -(weight @ phase) / contrast**2
        return found

    def _step_slope(self, phase: Array) -> Array:
        """Return H'(φ) from H(φ)."""
        return 2 * phase * (1 - phase) / self.step
