"""A constant that differs from place to place: the logarithm is a mean and modes of a prior.

The prior of the logarithm about its mean has the correlation exp(−r/l) between places r apart, that
of Matérn's family whose smoothness is ½: it is the solution of a stochastic differential equation
on the mesh (Lindgren, Rue & Lindström 2011). With the eigenpairs λ_i, v_i of the mass-weighted
Laplacian, free at the surface,

    ln c(X) = ln c̄ + Σ a_i φ_i(X),   φ_i ∝ v_i / (1/l² + λ_i),   a_i ~ N(0, 1),

scaled so that the prior has the same deviation, the amplitude, everywhere. The v that is the same
everywhere is left out: it is the mean. What finer shapes than these m would add is a share of the
variance that belongs to the interval of every element, see `FieldModes.left_out`.

Of a density, stated as ρ_s, not the logarithm is such a field but ρ / ρ_s: masses are linear in
what is estimated, and it differs little within a material.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Literal

import numpy as np
import scipy.sparse as sp
from annotated_types import MinLen
from scipy.sparse.linalg import eigsh, splu

from ..arrays import Array, Index
from ..checked import AtLeastOne, Positive, Text
from ..errors import InputError
from ..section import ByForm
from ..stated import key, stated
from .constants import DENSITY, YOUNG, Constant, is_modulus, mode
from .elements import ELEMENTS, reference_geometry
from .mesh import TetMesh

# What Young's modulus stands for: the moduli of a material all follow it.
ALL_MODULI = YOUNG.name
# Random signs that tell a trace.
PROBES = 50
# Prior standard deviation of the logarithm of the contrast of two phases: a factor of e.
TWO_PHASE_AMPLITUDE = 1.0
SMOOTH: Literal["smooth"] = "smooth"
TWO_PHASE: Literal["two-phase"] = "two-phase"
Prior = Literal["smooth", "two-phase"]
Lengths = Annotated[Positive | Annotated[tuple[Positive, ...], MinLen(1)], ByForm((int, float))]


@stated
class Field:
    """A stiffness, density or another constant that differs from place to place within a material.

    Parameters
    ----------
    parameter : str
        The constant: of the material or its damping law; young_pa is all moduli of a material;
        density_kg_m3.
    length_m : float or list
        Over which distance it changes: the correlation of places so far apart is 1/e. Of several
        the likeliest is taken.
    modes : int
        How many shapes make up the field; one more costs what one more right-hand side does.
    amplitude : float, optional
        How much it differs: the prior standard deviation of the logarithm, 0.5 by default; of a
        density that over its stated value, 0.3 by default. With prior = "two-phase", the prior
        standard deviation of the logarithm of the contrast, 1 by default.
    prior : {"smooth", "two-phase"}
        "smooth": the logarithm is a normal field. "two-phase": two materials with a boundary
        between them; the parameter contrast is the ratio of inclusions to surroundings.
    """

    length_m: float | tuple[float, ...] = key(Lengths)
    parameter: str = key(Text, default=ALL_MODULI)
    modes: int = key(AtLeastOne, default=40)
    amplitude: float | None = key(Positive | None, default=None)
    prior: Prior = key(Prior, default=SMOOTH)

    @property
    def lengths_m(self) -> tuple[float, ...]:
        """Those to choose from."""
        return self.length_m if isinstance(self.length_m, tuple) else (self.length_m,)

    @property
    def deviation(self) -> float:
        """The amplitude or its default: a density, unlike a logarithm, could fall below zero."""
        if self.prior == TWO_PHASE:
            return self.amplitude or TWO_PHASE_AMPLITUDE
        return self.amplitude or (0.3 if self.parameter == DENSITY.name else 0.5)


@dataclass(frozen=True, eq=False)
class Laplacian:
    """The smoothest shapes of some cells.

    Attributes
    ----------
    values : (m,) λ [1/m²]
    vectors : (m, E) v in the middle of each cell
    matrix : (n, n) with the eigenvalues λ, of the nodes and scaled by the roots of their masses
    basis : (n, m + 1) its eigenvectors, that which is the same everywhere included
    """

    values: Array
    vectors: Array
    matrix: sp.csc_array
    basis: Array

    @classmethod
    def of(cls, mesh: TetMesh, cells: Index, count: int) -> Laplacian:
        """The first of those that are not the same everywhere.

        Raises
        ------
        InputError
            If there are fewer.
        """
        nodes, own = np.unique(mesh.tetrahedra[cells], return_inverse=True)
        size, own = len(nodes), own.reshape(-1, 4)
        if not count + 2 < size:
            raise InputError(f"modes is {count}; expected at most {size - 3}, with {size} nodes")
        geometry = reference_geometry(mesh.points_m[nodes], own, ELEMENTS["tet4"])[:, 0]
        slopes, volumes = geometry[:, :-1].reshape(-1, 4, 3), geometry[:, -1]
        stiffness = volumes[:, None, None] * slopes @ slopes.swapaxes(1, 2)
        places = np.repeat(own, 4, axis=1).ravel(), np.tile(own, 4).ravel()
        mass = np.bincount(own.ravel(), np.repeat(volumes / 4, 4), size)
        root = sp.diags_array(1 / np.sqrt(mass))
        matrix = (root @ sp.csc_array((stiffness.ravel(), places), (size, size)) @ root).tocsc()
        # A little below zero, where it can be factorised. The start makes it repeatable.
        shift, start = -1e-3 * volumes.sum() ** (-2 / 3), np.random.default_rng(0).normal(size=size)
        values, basis = eigsh(matrix, count + 1, sigma=shift, v0=start)
        # A body of several pieces has more than one that is constant on each of them.
        order, alike = np.argsort(values), np.sqrt(mass / mass.sum())
        values, basis = values[order], basis[:, order]
        constant = np.flatnonzero(values < 1e-9 * values[-1])
        turn = np.column_stack([basis[:, constant].T @ alike, np.eye(len(constant))])
        basis[:, constant] = basis[:, constant] @ np.linalg.qr(turn)[0]
        basis *= np.sign(basis[np.abs(basis).argmax(axis=0), np.arange(count + 1)])
        vectors = (root @ basis[:, 1:])[own].mean(axis=1).T
        return cls(np.maximum(values[1:], 0.0), vectors, matrix, basis)

    def weights(self, length_m: float) -> Array:
        """(m,) deviation of the share of each v."""
        return 1 / (1 / length_m**2 + self.values)

    def share(self, length_m: float) -> float:
        """What of the variance these shapes have, of all but that which is the same everywhere."""
        size, own = len(self.basis), (self.weights(length_m) ** 2).sum()
        # The trace of a square is how far random signs are stretched on average.
        signs = np.random.default_rng(0).choice([-1.0, 1.0], size=(size, PROBES))
        finer = signs - self.basis @ (self.basis.T @ signs)
        operator = (self.matrix + sp.eye_array(size) / length_m**2).tocsc()
        return float(own / (own + (splu(operator).solve(finer) ** 2).sum() / PROBES))


@dataclass(frozen=True)
class FieldShapes:
    """What the shapes of a field can show.

    Attributes
    ----------
    modes : int
    length_m, amplitude : float
    share : float
        What of its variance they have; the rest is of finer ones.
    detail_m : float
        Half the shortest wave length.
    """

    modes: int
    length_m: float
    amplitude: float
    share: float
    detail_m: float


@dataclass(frozen=True, eq=False)
class FieldModes:
    """A field as the body evaluates it.

    Attributes
    ----------
    field : Field
    laplacian : Laplacian
    scaled : tuple of int
        Which constants of the material and the damping law follow it; none of a density.
    length_m : float
    volumes_m3 : (E,)
    """

    field: Field
    laplacian: Laplacian
    scaled: tuple[int, ...]
    length_m: float
    volumes_m3: Array

    @classmethod
    def of(cls, field: Field, mesh: TetMesh, cells: Index, law: tuple[Constant, ...]) -> FieldModes:
        """Those of a field of some cells, of constants of material and damping law.

        Raises
        ------
        InputError
            If none of these is the field's.
        """
        names = [constant.name for constant in law]
        moduli = [k for k, name in enumerate(names) if is_modulus(name)]
        scaled = moduli if field.parameter == ALL_MODULI else []
        if field.parameter in names:
            scaled = [names.index(field.parameter)]
        if not scaled and field.parameter != DENSITY.name:
            known = [ALL_MODULI] * bool(moduli) + [*names, DENSITY.name]
            raise InputError(
                f"parameter of a field is {field.parameter!r}; expected one of {', '.join(known)}"
            )
        laplacian = Laplacian.of(mesh, cells, field.modes)
        return cls(field, laplacian, tuple(scaled), field.lengths_m[0], mesh.volumes_m3[cells])

    def logarithms(self, coefficients: Array) -> Array:
        """Return ln c − ln c̄ (E,) in every cell, from the coefficients (k,) of `constants`."""
        return self.shapes @ coefficients

    def slopes(self, coefficients: Array) -> Array:
        """Return the derivatives (E, k) of `logarithms` by the coefficients (k,)."""
        return self.shapes

    def curvature(self, coefficients: Array, weights: Array) -> Array:
        """Return Σ weights · ∂² of `logarithms` by the coefficients, (T, k, k).

        Parameters
        ----------
        coefficients : (k,)
        weights : (T, E) of the cells
        """
        return np.zeros((len(weights), len(coefficients), len(coefficients)))

    @cached_property
    def share(self) -> float:
        """What of the variance these shapes have."""
        return self.laplacian.share(self.length_m)

    @property
    def left_out(self) -> float:
        """Deviation of the logarithm by what finer shapes would add."""
        return self.field.deviation * float(np.sqrt(1 - self.share))

    @cached_property
    def shapes(self) -> Array:
        """φ (E, m) of the cells."""
        weighed = self.laplacian.weights(self.length_m)[:, None] * self.laplacian.vectors
        deviation = self.field.deviation * np.sqrt(self.share)
        return (deviation * weighed / np.linalg.norm(weighed, axis=0)).T

    @property
    def constants(self) -> tuple[Constant, ...]:
        """The a."""
        return tuple(mode(k) for k in range(self.field.modes))

    @property
    def told(self) -> FieldShapes:
        """The same in numbers."""
        detail_m = float(np.pi / np.sqrt(self.laplacian.values[-1]))
        own = self.field.modes, self.length_m, self.field.deviation
        return FieldShapes(*own, self.share, detail_m)

    def split_in_eight(self) -> FieldModes:
        """The same field of a mesh whose cells are cut in eight."""
        vectors = np.repeat(self.laplacian.vectors, 8, axis=1)
        volumes_m3 = np.repeat(self.volumes_m3 / 8, 8)
        whole = replace(self.laplacian, vectors=vectors)
        return replace(self, laplacian=whole, volumes_m3=volumes_m3)

    def at(self, length_m: float) -> FieldModes:
        """The same of another length."""
        return replace(self, length_m=length_m)


@dataclass(frozen=True, eq=False)
class Spread:
    """Sums over cells of what changes with the logarithm of the constant in each cell.

    Attributes
    ----------
    field : FieldModes
    dofs : (E, d) of the nodes of each cell
    size : int
        Number of dofs of all.
    """

    field: FieldModes
    dofs: Index
    size: int

    @cached_property
    def _incidence(self) -> sp.csr_array:
        """(size, E), with the number of each entry."""
        cells, own = self.dofs.shape
        rows, columns = self.dofs.ravel(), np.repeat(np.arange(cells), own)
        numbers = np.arange(1, rows.size + 1)
        return sp.csr_array((numbers, (rows, columns)), shape=(self.size, cells))

    def nodal(self, values: Array, slopes: Array, out: Array) -> None:
        """Write derivatives of nodal values by the coefficients of the field to `out`.

        Parameters
        ----------
        values : (T, E · d) derivatives by the logarithm in each cell
        slopes : (E, k) derivatives of these logarithms by the coefficients
        out : (T, size, k)
        """
        known = self._incidence
        order = known.data - 1
        for value, own in zip(values, out, strict=True):
            matrix = sp.csr_array((value[order], known.indices, known.indptr), known.shape)
            own[:] = matrix @ slopes
