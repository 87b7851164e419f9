"""Constants that vary in space: the logarithm is a mean plus shapes with a smooth random prior.

Use `Field` to declare such a constant; `FieldModes` evaluates it. The prior of the logarithm about
its mean has the correlation exp(−r/l) between places at a distance r, which is Matérn's family with
smoothness ½: it is the solution of a stochastic differential equation on the mesh (Lindgren, Rue &
Lindström 2011). With the eigenpairs λ_i, v_i of the mass-weighted Laplacian, free at the surface,

    ln c(X) = ln c̄ + Σ a_i φ_i(X),   φ_i ∝ v_i / (1/l² + λ_i),   a_i ~ N(0, 1),

scaled so that the prior has the same deviation, the amplitude, everywhere. The constant eigenvector
is omitted: it is the mean. Shapes beyond the first m have a share of the variance that is included
in the interval of every element, see `FieldModes.omitted_deviation`.

For a density with the stated value ρ_s the field is ρ / ρ_s instead of the logarithm: masses are
linear in the coefficients, and densities vary little within a material.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated

import numpy as np
import scipy.sparse as sp
from annotated_types import MinLen
from scipy.sparse.linalg import eigsh, splu

from ..common.array_types import Array, Index
from ..common.declarations import declaration, key
from ..common.schema_tables import ByForm
from ..common.validated_types import AtLeastOne, Positive, Text
from ..errors import InputError
from .elements import ELEMENTS, reference_geometry
from .laws.constants import DENSITY, YOUNG, Constant, field_coefficient, is_modulus
from .meshes.mesh import TetMesh

# Parameter of a field of stiffness: all moduli of the material vary with it.
ALL_MODULI = YOUNG.name
# Number of random sign vectors for the estimate of a trace (Hutchinson's estimator).
PROBES = 50
Lengths = Annotated[Positive | Annotated[tuple[Positive, ...], MinLen(1)], ByForm((int, float))]


@declaration
class Field:
    """Stiffness, density or another constant that varies in space within a material.

    Parameters
    ----------
    parameter : str
        Constant that varies: one of the material or of its damping law, young_pa for all moduli of
        a material together, or density_kg_m3.
    length_m : float or list
        Correlation length: two points at this distance have the correlation 1/e. If several lengths
        are given, the most likely one is used.
    modes : int
        Number of shapes of the field. Each shape adds one right-hand side to the linear system of
        every time step.
    amplitude : float, optional
        Prior standard deviation of the logarithm of the constant, 0.5 by default; for a density,
        prior standard deviation of its ratio to the stated density, 0.3 by default.
    """

    length_m: float | tuple[float, ...] = key(Lengths)
    parameter: str = key(Text, default=ALL_MODULI)
    modes: int = key(AtLeastOne, default=40)
    amplitude: float | None = key(Positive | None, default=None)

    @property
    def lengths_m(self) -> tuple[float, ...]:
        """Correlation lengths to choose from [m]; one if `length_m` is a number."""
        return self.length_m if isinstance(self.length_m, tuple) else (self.length_m,)

    @property
    def deviation(self) -> float:
        """Prior standard deviation: the amplitude, or its default for None, which depends on the
        parameter.

        The default of a density is smaller, because a density, unlike a logarithm, could become
        negative.
        """
        return self.amplitude or (0.3 if self.parameter == DENSITY.name else 0.5)


@dataclass(frozen=True, eq=False)
class Laplacian:
    """Lowest eigenpairs of the mass-weighted Laplacian on some cells."""

    values: Array  # (m,): eigenvalues λ [1/m²], without that of the constant eigenvector
    vectors: Array  # (m, E): eigenvectors v at the centre of each cell
    # (n, n): matrix with the eigenvalues λ: Laplacian of the nodes, scaled by the square roots of
    # their masses.
    matrix: sp.csc_array
    basis: Array  # (n, m + 1): eigenvectors of this matrix, including the constant one

    @classmethod
    def from_mesh(cls, mesh: TetMesh, cells: Index, count: int) -> Laplacian:
        """Return the lowest eigenpairs after the constant eigenvector, ascending.

        Signs are such that the entry of largest magnitude at a node is positive. Further
        eigenvalues of a body of several pieces are zero.

        Parameters
        ----------
        cells : (k,) int
            Indices of the cells.
        count : int
            Number m of eigenpairs.

        Raises
        ------
        InputError
            If the cells have fewer than m + 3 nodes.
        """
        nodes, local_nodes = np.unique(mesh.tetrahedra[cells], return_inverse=True)
        size = len(nodes)
        local_nodes = local_nodes.reshape(-1, 4)
        if not count + 2 < size:
            raise InputError(
                f"modes is {count}; expected at most {size - 3}, because the part of the body that has "
                f"the field has {size} nodes"
            )
        geometry = reference_geometry(mesh.points_m[nodes], local_nodes, element=ELEMENTS["tet4"])[
            :, 0
        ]
        slopes = geometry[:, :-1].reshape(-1, 4, 3)
        volumes = geometry[:, -1]
        stiffness = volumes[:, None, None] * slopes @ slopes.swapaxes(1, 2)
        places = (np.repeat(local_nodes, 4, axis=1).ravel(), np.tile(local_nodes, 4).ravel())
        mass = np.bincount(local_nodes.ravel(), np.repeat(volumes / 4, 4), size)
        root = sp.diags_array(1 / np.sqrt(mass))
        matrix = (root @ sp.csc_array((stiffness.ravel(), places), (size, size)) @ root).tocsc()
        # A shift slightly below zero makes the matrix regular; a fixed start makes it repeatable.
        shift = -1e-3 * volumes.sum() ** (-2 / 3)
        start = np.random.default_rng(0).normal(size=size)
        values, basis = eigsh(matrix, count + 1, sigma=shift, v0=start)
        # A body of several pieces has more than one that is constant on each of them.
        order = np.argsort(values)
        constant_vector = np.sqrt(mass / mass.sum())
        values = values[order]
        basis = basis[:, order]
        constant = np.flatnonzero(values < 1e-9 * values[-1])
        combination = np.column_stack(
            [basis[:, constant].T @ constant_vector, np.eye(len(constant))]
        )
        basis[:, constant] = basis[:, constant] @ np.linalg.qr(combination)[0]
        basis *= np.sign(basis[np.abs(basis).argmax(axis=0), np.arange(count + 1)])
        vectors = (root @ basis[:, 1:])[local_nodes].mean(axis=1).T
        return cls(np.maximum(values[1:], 0.0), vectors, matrix=matrix, basis=basis)

    def weights(self, length_m: float) -> Array:
        """Return 1/(1/l² + λ) (m,) for a correlation length l [m]: the prior deviations of the
        coefficients of the eigenvectors, up to a factor.
        """
        return 1 / (1 / length_m**2 + self.values)

    def variance_share(self, length_m: float) -> float:
        """Return the share of a field's prior variance that these eigenvectors represent at a
        correlation length [m]; the constant eigenvector does not count.

        The trace that this needs is estimated with `PROBES` random sign vectors of a fixed seed.
        """
        size = len(self.basis)
        own_variance = (self.weights(length_m) ** 2).sum()
        # The trace of a square is how far random signs are stretched on average.
        signs = np.random.default_rng(0).choice([-1.0, 1.0], size=(size, PROBES))
        finer = signs - self.basis @ (self.basis.T @ signs)
        operator = (self.matrix + sp.eye_array(size) / length_m**2).tocsc()
        return float(
            own_variance / (own_variance + (splu(operator).solve(finer) ** 2).sum() / PROBES)
        )


@dataclass(frozen=True)
class FieldResolution:
    """Resolution of a field by its shapes."""

    modes: int  # number of shapes
    # Correlation length and prior standard deviation.
    length_m: float
    amplitude: float
    # Share of the prior variance that the shapes represent; finer shapes have the rest.
    share: float
    detail_m: float  # half the shortest wavelength


@dataclass(frozen=True, eq=False)
class FieldModes:
    """Shapes of a field, evaluated in every cell of a part."""

    field: Field
    laplacian: Laplacian
    # Indices of the constants of material and damping law that the field multiplies; empty for a
    # density.
    scaled_indices: tuple[int, ...]
    length_m: float  # correlation length in use
    volumes_m3: Array  # (E,): volumes of the cells

    @classmethod
    def from_field(
        cls, field: Field, mesh: TetMesh, cells: Index, law: tuple[Constant, ...]
    ) -> FieldModes:
        """Return the shapes of a field on some cells, with the first of its correlation lengths.

        Parameters
        ----------
        cells : (E,) int
            Indices of the cells.
        law : tuple of Constant
            Constants of the material and of the damping law.

        Raises
        ------
        InputError
            If the field's parameter is not one of these constants, all moduli, or the density, or
            if the cells have too few nodes for its shapes.
        """
        names = [constant.name for constant in law]
        moduli = [k for k, name in enumerate(names) if is_modulus(name)]
        scaled = moduli if field.parameter == ALL_MODULI else []
        if field.parameter in names:
            scaled = [names.index(field.parameter)]
        if not scaled and field.parameter != DENSITY.name:
            known = [ALL_MODULI] * bool(moduli) + [*names, DENSITY.name]
            raise InputError(
                f"parameter of the field is {field.parameter!r}; expected one of {', '.join(known)}"
            )
        laplacian = Laplacian.from_mesh(mesh, cells, count=field.modes)
        return cls(
            field,
            laplacian,
            scaled_indices=tuple(scaled),
            length_m=field.lengths_m[0],
            volumes_m3=mesh.volumes_m3[cells],
        )

    def logarithms(self, coefficients: Array) -> Array:
        """Return ln c − ln c̄ (E,) in every cell, from the coefficients (k,) of `constants`; for a
        density it is ρ/ρ_s − 1 instead, see the module.
        """
        return self.shapes @ coefficients

    @cached_property
    def variance_share(self) -> float:
        """Share of the prior variance that the shapes represent, between 0 and 1."""
        return self.laplacian.variance_share(self.length_m)

    @property
    def omitted_deviation(self) -> float:
        """Standard deviation of the logarithm due to finer shapes, which are omitted."""
        return self.field.deviation * float(np.sqrt(1 - self.variance_share))

    @cached_property
    def shapes(self) -> Array:
        """Shapes φ (E, m), one column for each coefficient, in the cells of the part.

        Σ_i φ_i² is the same in every cell: the squared prior deviation times `variance_share`.
        """
        unscaled = self.laplacian.weights(self.length_m)[:, None] * self.laplacian.vectors
        deviation = self.field.deviation * np.sqrt(self.variance_share)
        return (deviation * unscaled / np.linalg.norm(unscaled, axis=0)).T

    @property
    def constants(self) -> tuple[Constant, ...]:
        """Constants of the coefficients a."""
        return tuple(field_coefficient(k) for k in range(self.field.modes))

    def describe_resolution(self) -> FieldResolution:
        """Return the resolution of the field, for reports."""
        detail_m = float(np.pi / np.sqrt(self.laplacian.values[-1]))
        return FieldResolution(
            modes=self.field.modes,
            length_m=self.length_m,
            amplitude=self.field.deviation,
            share=self.variance_share,
            detail_m=detail_m,
        )

    def on_cells(self, sources: Index, volumes_m3: Array) -> FieldModes:
        """Return this field on other cells, whose shapes have the values of given cells; nothing is
        computed again.

        Parameters
        ----------
        sources : (k,) int
            For each new cell the present one, counted from 0, whose value it has.
        volumes_m3 : (k,)
            Volumes of the new cells.
        """
        vectors = self.laplacian.vectors[:, sources]
        laplacian = replace(self.laplacian, vectors=vectors)
        return replace(self, laplacian=laplacian, volumes_m3=volumes_m3)

    def with_length(self, length_m: float) -> FieldModes:
        """Return this field with another correlation length [m] and the same eigenvectors; it need
        not be one of `Field.lengths_m`.
        """
        return replace(self, length_m=length_m)


@dataclass(frozen=True, eq=False)
class FieldAssembly:
    """Assembly of derivatives by the logarithm of each cell into derivatives by the coefficients."""

    field: FieldModes
    dofs: Index  # (E, d): dofs of the nodes of each cell
    size: int  # number of dofs of the body

    @cached_property
    def _incidence(self) -> sp.csr_array:
        """Sparse matrix (size, E) of the place of `dofs[e, a]` in a row of `assemble_nodal`."""
        cells, dofs_per_cell = self.dofs.shape
        rows = self.dofs.ravel()
        columns = np.repeat(np.arange(cells), dofs_per_cell)
        entry_codes = np.arange(1, rows.size + 1)
        return sp.csr_array((entry_codes, (rows, columns)), shape=(self.size, cells))

    def assemble_nodal(self, values: Array, out: Array) -> None:
        """Write derivatives of nodal values by the coefficients of the field to `out`.

        Parameters
        ----------
        values : (T, E · d)
            Derivatives by the logarithm of each cell.
        out : (T, size, k)
            Result; overwritten.
        """
        incidence = self._incidence
        order = incidence.data - 1
        for value, derivatives in zip(values, out, strict=True):
            matrix = sp.csr_array(
                (value[order], incidence.indices, incidence.indptr), incidence.shape
            )
            derivatives[:] = matrix @ self.field.shapes
