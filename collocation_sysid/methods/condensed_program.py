"""Condensed program for IPOPT: fewer variables and constraints, and a sparser Hessian.

Where the pose of the body in its grasps is estimated, the positions of grasped nodes follow from φ.
`CondensedCollocation` removes these variables and the constraints that prescribe them; derivatives
with respect to them are added to the columns of φ by the chain rule. The optimum is that of the
complete program, and so are the multipliers: those of the removed constraints balance the gradient
with respect to the removed variables.

An estimated clock interpolates between samples, so that the loss couples more time steps than the
equations of motion do. The Hessian omits these entries: summed over a recording, products of slopes
hardly change within a fraction of a sample. It has the Gauss–Newton part at the nearest sample,
where a measurement depends on one time step, and the curvature of the residuals as it is.

Use `condense` before a program is passed to a general NLP solver, and `complete_multipliers`
afterwards.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from ..common.array_types import Array, Index
from ..fem.pattern import unique_codes
from ..program.collocation import Collocation
from ..program.linear_algebra.sparse_assembly import SparseAssembly
from ..program.transcription import Transcription
from ..recording.nuisance import TIME


def condense(complete: Collocation) -> Collocation:
    """Return the program without the grasped positions that follow from φ, and with a sparser
    Hessian; the argument itself if no grasp and no clock is estimated.

    The given program is not modified.
    """
    if not any(
        s.nuisance.affects_grasps or len(s.nuisance.clock_indices) for s in complete.transcriptions
    ):
        return complete
    program = object.__new__(CondensedCollocation)  # has been checked
    vars(program).update(
        {f.name: getattr(complete, f.name) for f in fields(complete)}, complete=complete
    )
    return program


def complete_program(program: Collocation) -> Collocation:
    """Return the program with all variables: that of which a condensed program is made, otherwise
    the argument itself.
    """
    return program.complete if isinstance(program, CondensedCollocation) else program


def complete_multipliers(program: Collocation, z: Array, multipliers: Array) -> Array:
    """Return the multipliers of all constraints of the complete program, at an optimum.

    Parameters
    ----------
    program : Collocation
        Program that was solved; if it is not condensed, `multipliers` are returned.
    z : (variables,) array
        Its variables.
    multipliers : (constraints,) array
        Its multipliers.
    """
    if not isinstance(program, CondensedCollocation):
        return multipliers
    return program.complete_multipliers(z, 1.0, multipliers=multipliers)


@dataclass(frozen=True, eq=False)
class EliminatedDofs:
    """Grasped dofs of one experiment, as functions of its φ."""

    transcription: Transcription  # transcription of the experiment
    variables: Index  # (h,) of int: indices of the dofs in z of the complete program
    rows: Index  # (h,) of int: indices in g of the constraints that prescribe them
    phi: Index  # (k,) of int: indices in z of the φ that move the body in its grasps

    @classmethod
    def from_segment(cls, transcription: Transcription, complete: Collocation) -> EliminatedDofs:
        """Return the grasped dofs of an experiment whose positions follow from φ: those that
        constraints of the `complete` program prescribe, which contains the `transcription`.
        """
        rows = np.flatnonzero(transcription.is_grasp_constraint)
        time, place = np.divmod(rows, transcription.constraints_per_time)
        dofs = (
            transcription.dynamics.first_row + time
        ) * transcription.dof_count + transcription.constrained_dofs[place]
        moving = transcription.nuisance_indices.indices[transcription.nuisance.motion_indices]
        phi = complete.phi_columns.start - complete.nq + moving
        return cls(
            transcription,
            transcription.offsets.variable + dofs,
            rows=transcription.offsets.row + rows,
            phi=phi,
        )

    def evaluate(self, phi: Array) -> tuple[Array, Array]:
        """Return the scaled positions (h,) of the eliminated dofs, and their derivatives (h, k) by
        the k parameters of `self.phi`, from all nuisance parameters `phi` of the experiment.
        """
        transcription = self.transcription
        prescribed = self.transcription.prescribed_motion.evaluate_at(phi)
        time, dof = np.divmod(
            self.variables - transcription.offsets.variable, transcription.dof_count
        )
        indices = time, np.searchsorted(prescribed.dofs, dof)
        return prescribed.positions_m[indices] / transcription.length_m, prescribed.by_phi[
            indices
        ] / transcription.length_m


@dataclass(frozen=True, eq=False)
class EliminatedColumns:
    """Columns of a sparse matrix that belong to eliminated variables."""

    entries: Index  # indices of the columns' entries among the values of the matrix
    # (r,) of int: row indices in which the columns have entries, and further rows; ascending.
    rows: Index
    row: Index  # index in `rows` of each entry
    column: Index  # index among the eliminated columns of each entry

    @classmethod
    def from_entries(
        cls, entries: ColumnEntries, rows: Index, further_rows: Index
    ) -> EliminatedColumns:
        """Return the columns with their entries in numbered rows.

        Parameters
        ----------
        rows : (rows of the matrix,) array of int
            Number of each row of the matrix, −1 for rows that are left out.
        further_rows : array of int
            Numbers of rows that are included even if they have no entries.
        """
        numbers = rows[entries.rows]
        is_included = numbers >= 0
        numbers = numbers[is_included]
        selected_rows = unique_codes([numbers, further_rows])
        return cls(
            entries.positions[is_included],
            selected_rows,
            row=np.searchsorted(selected_rows, numbers),
            column=entries.columns[is_included],
        )

    def times(self, values: Array, slopes: Array) -> Array:
        """Return the product (r, k) of these columns with `slopes` (h, k), from all values of the
        matrix.
        """
        shape = (len(self.rows), len(slopes))
        return sp.csr_array((values[self.entries], (self.row, self.column)), shape=shape) @ slopes


@dataclass(frozen=True, eq=False)
class ColumnEntries:
    """Entries of some columns of a sparse matrix in compressed columns."""

    positions: Index  # (e,) of int: index of each entry among the values of the matrix
    rows: Index  # (e,) of int: row of each entry
    columns: Index  # (e,) of int: index of the column of each entry among the selected ones

    @classmethod
    def select(cls, structure: tuple[Index, Index], selected: Index) -> ColumnEntries:
        """Return the entries of the columns `selected` of a matrix, whose structure is (column
        pointers, row indices).
        """
        indptr, indices = structure
        counts = indptr[selected + 1] - indptr[selected]
        shifts = indptr[selected] - (np.cumsum(counts) - counts)
        positions = np.arange(counts.sum()) + np.repeat(shifts, counts)
        return cls(
            positions, indices[positions], columns=np.repeat(np.arange(len(selected)), counts)
        )

    @classmethod
    def select_symmetric(cls, structure: tuple[Index, Index], selected: Index) -> ColumnEntries:
        """Return the entries of the columns `selected` of a symmetric matrix, ascending, from the
        structure of its upper triangle.

        The entries in the columns come first, then those of the lower triangle, which are entries
        of the upper one in the selected rows.
        """
        indptr, indices = structure
        upper = cls.select(structure, selected)
        is_selected = np.zeros(len(indptr) - 1, dtype=bool)
        is_selected[selected] = True
        positions = np.flatnonzero(is_selected[indices])
        columns = np.searchsorted(indptr, positions, side="right") - 1
        is_below = columns != indices[positions]
        positions = positions[is_below]
        numbers = np.searchsorted(selected, indices[positions])
        return cls(
            np.concatenate([upper.positions, positions]),
            np.concatenate([upper.rows, columns[is_below]]),
            columns=np.concatenate([upper.columns, numbers]),
        )


@dataclass(frozen=True, eq=False)
class CondensedPattern:
    """Sparsity pattern of a condensed matrix, and the origin of its values."""

    # Structure, with the values that remain as initial ones, and the contributions by each
    # experiment's eliminated dofs as groups.
    assembly: SparseAssembly
    # Mask of the complete matrix's values that remain; they keep their order.
    is_remaining: NDArray[np.bool_]
    remaining_count: int  # number of these values
    # Columns of the complete matrix that give the contributions of each experiment.
    eliminated: Sequence[EliminatedColumns]

    @classmethod
    def from_complete(
        cls,
        structure: tuple[Index, Index],
        row_numbers: Index,
        column_numbers: Index,
        is_remaining: NDArray[np.bool_],
        groups: Sequence[tuple[Index, Index]],
        eliminated: Sequence[EliminatedColumns],
    ) -> CondensedPattern:
        """Return the pattern of a matrix without some rows and columns, and with further entries.

        Parameters
        ----------
        structure : (array, array)
            Column pointers and row indices of the complete matrix.
        row_numbers, column_numbers : arrays of int
            Index of each row and of each column of the complete matrix in the condensed one, which
            ascends; −1 for those that are eliminated.
        is_remaining : (entries,) array of bool
            Entries that remain; those of eliminated rows and columns must not.
        groups : sequence of (rows, columns)
            Entries of the condensed matrix by each of `eliminated`.
        eliminated : sequence of EliminatedColumns
            Columns that give contributions.
        """
        indptr, indices = structure
        # Rows and columns keep their order, and so do the entries: nothing is sorted.
        before = np.concatenate([[0], np.cumsum(is_remaining)])[indptr]
        counts = np.diff(before)[column_numbers >= 0]
        remaining_structure = (
            np.concatenate([[0], np.cumsum(counts)]),
            row_numbers[indices[is_remaining]],
        )
        shape = tuple(
            int(np.count_nonzero(numbers >= 0)) for numbers in (row_numbers, column_numbers)
        )
        return cls(
            SparseAssembly.from_groups(remaining_structure, (shape[0], shape[1]), groups=groups),
            is_remaining,
            remaining_count=int(before[-1]),
            eliminated=eliminated,
        )

    def assemble(self, complete: Array, out: Array | None, groups: Sequence[Array]) -> Array:
        """Return the values of the condensed matrix.

        Parameters
        ----------
        complete : array
            Values of the complete matrix.
        out : array or None
            Overwritten with the result and returned if given.
        groups : sequence of arrays
            Contributions of each group of entries, flat.
        """
        values, initial = self.assembly.allocate(out, self.remaining_count)
        np.compress(self.is_remaining, complete, out=initial)
        self.assembly.assemble(values, initial, groups=groups)
        return values

    def positions_of(self, positions: Index) -> Index:
        """Return the positions among the condensed values of those of the complete values at
        `positions` that remain, in their order.
        """
        before = np.cumsum(self.is_remaining)
        kept = positions[self.is_remaining[positions]]
        return self.assembly.positions_of(before[kept] - 1)


class CondensedCollocation(Collocation):
    """Program without the grasped dofs that follow from φ, and with a sparser Hessian.

    It is made by `condense`; its interface is that of `Collocation`.

    Attributes
    ----------
    complete : Collocation
        Complete program.
    """

    complete: Collocation

    @cached_property
    def transcriptions(self) -> tuple[Transcription, ...]:
        return self.complete.transcriptions

    @cached_property
    def eliminated(self) -> tuple[EliminatedDofs, ...]:
        """Eliminated dofs of each experiment whose pose in its grasps is estimated."""
        return tuple(
            EliminatedDofs.from_segment(s, self.complete)
            for s in self.transcriptions
            if s.nuisance.affects_grasps
        )

    @cached_property
    def _remaining(self) -> tuple[Index, Index]:
        """Indices, ascending, of variables and constraints that remain."""
        variables = np.arange(self.complete.variable_count)
        rows = np.arange(self.complete.constraint_count)
        for each in self.eliminated:
            variables[each.variables] = rows[each.rows] = -1
        return variables[variables >= 0], rows[rows >= 0]

    @cached_property
    def _condensed_indices(self) -> tuple[Index, Index]:
        """Their index among those that remain, −1 if eliminated."""
        sizes = self.complete.variable_count, self.complete.constraint_count
        indices = np.full(sizes[0], -1), np.full(sizes[1], -1)
        for number, remaining in zip(indices, self._remaining, strict=True):
            number[remaining] = np.arange(len(remaining))
        return indices

    @property
    def variable_count(self) -> int:
        return len(self._remaining[0])

    @property
    def constraint_count(self) -> int:
        return len(self._remaining[1])

    @property
    def remaining_rows(self) -> Index:
        """Indices of the complete program's constraints that remain."""
        return self._remaining[1]

    @property
    def phi_columns(self) -> slice:
        """Slice of the nuisance parameters φ in z; none of them is eliminated."""
        first = int(self._condensed_indices[0][self.complete.phi_columns.start])
        return slice(first, first + self.nphi)

    @property
    def has_eliminated_histories(self) -> bool:
        return self.complete.has_eliminated_histories

    def pack(self, p: Array, positions: Sequence[Array]) -> Array:
        return self.complete.pack(p, positions)[self._remaining[0]]

    def unpack(self, z: Array) -> tuple[Array, list[Array]]:
        """Return parameters p and the positions (N, 3n) of each experiment [m] from z, those of the
        eliminated dofs included.
        """
        return self.complete.unpack(self.complete_variables(z))

    def bounds(self) -> tuple[Array, Array]:
        lower, upper = self.complete.bounds()
        return lower[self._remaining[0]], upper[self._remaining[0]]

    def complete_variables(self, z: Array) -> Array:
        """Return the variables of the complete program from z, with the eliminated positions at
        their values for the φ in z.
        """
        variables = np.empty(self.complete.variable_count)
        variables[self._remaining[0]] = z
        for each, (positions, _) in zip(self.eliminated, self._prescribed(z), strict=True):
            variables[each.variables] = positions
        return variables

    def complete_multipliers(self, z: Array, loss_weight: float, multipliers: Array) -> Array:
        """Return the multipliers of all constraints of the complete program; those of eliminated
        constraints make the Lagrangian stationary in the eliminated positions, also where z is no
        optimum.

        Parameters
        ----------
        z : (variables,) array
            Condensed variables.
        loss_weight : float
            Weight of the objective in the Lagrangian.
        multipliers : (constraints,) array
            Multipliers of the remaining constraints.
        """
        variables = self.complete_variables(z)
        complete = np.zeros(self.complete.constraint_count)
        complete[self._remaining[1]] = multipliers
        slope = (
            loss_weight * self.complete.gradient(variables)
            + self.complete.jacobian(variables).T @ complete
        )
        for each in self.eliminated:
            complete[each.rows] = -slope[each.variables]
        return complete

    def _prescribed(self, z: Array) -> Iterator[tuple[Array, Array]]:
        """Yield positions and derivatives of eliminated dofs at z."""
        p = self.parameters_from(z)
        return (
            each.evaluate(p[each.transcription.nuisance_indices.indices])
            for each in self.eliminated
        )

    # Values -------------------------------------------------------------------------------------

    def objective(self, z: Array) -> float:
        return self.complete.objective(self.complete_variables(z))

    def gradient(self, z: Array) -> Array:
        """Return ∂objective/∂z (variables,) by the remaining variables, including the dependence
        through the eliminated positions on φ.
        """
        slope = self.complete.gradient(self.complete_variables(z))
        return self.condense_gradient(z, slope)

    def condense_gradient(self, z: Array, complete_gradient: Array) -> Array:
        """Return the gradient (variables,) of a function of the complete variables by the remaining
        ones z, including the dependence through the eliminated positions on φ.

        Parameters
        ----------
        z : (variables,) array
            Variables.
        complete_gradient : (complete variables,) array
            Gradient by the complete variables at z; not modified.
        """
        gradient = complete_gradient.copy()
        for each, (_, by_phi) in zip(self.eliminated, self._prescribed(z), strict=True):
            gradient[each.phi] += by_phi.T @ gradient[each.variables]
        return gradient[self._remaining[0]]

    def constraint_values(self, z: Array) -> Array:
        return self.complete.constraint_values(self.complete_variables(z))[self._remaining[1]]

    # Matrices -----------------------------------------------------------------------------------

    @cached_property
    def _jacobian(self) -> CondensedPattern:
        structure = self.complete.jacobian_structure
        of_variable, of_row = self._condensed_indices
        is_remaining = np.repeat(of_variable >= 0, np.diff(structure[0]))
        is_remaining &= (of_row >= 0)[structure[1]]
        eliminated = []
        groups = []
        for each in self.eliminated:
            columns = EliminatedColumns.from_entries(
                ColumnEntries.select(structure, each.variables),
                of_row,
                further_rows=np.zeros(0, dtype=np.int64),
            )
            eliminated.append(columns)
            groups.append(_products(columns.rows, of_variable[each.phi]))
        return CondensedPattern.from_complete(
            structure,
            row_numbers=of_row,
            column_numbers=of_variable,
            is_remaining=is_remaining,
            groups=groups,
            eliminated=eliminated,
        )

    @property
    def jacobian_structure(self) -> tuple[Index, Index]:
        return self._jacobian.assembly.structure

    def constraints_and_jacobian(self, z: Array, out: Array | None = None) -> tuple[Array, Array]:
        pattern = self._jacobian
        rows, complete_values = self.complete.constraints_and_jacobian(self.complete_variables(z))
        groups = [
            columns.times(complete_values, slopes).ravel()
            for columns, (_, slopes) in zip(pattern.eliminated, self._prescribed(z), strict=True)
        ]
        return rows[self._remaining[1]], pattern.assemble(complete_values, out, groups=groups)

    @cached_property
    def _hessian(self) -> CondensedPattern:
        structure = self.complete.hessian_structure
        numbers, _ = self._condensed_indices
        has_number = numbers >= 0
        is_remaining = ~self._is_loss_coupling(structure)
        is_remaining &= np.repeat(has_number, np.diff(structure[0]))
        is_remaining &= has_number[structure[1]]
        eliminated = []
        groups = []
        every_row = np.arange(self.complete.variable_count)
        for each in self.eliminated:
            columns = EliminatedColumns.from_entries(
                ColumnEntries.select_symmetric(structure, each.variables),
                every_row,
                further_rows=np.concatenate([each.variables, each.phi]),
            )
            eliminated.append(columns)
            rows = numbers[columns.rows]
            first, second = _products(rows[rows >= 0], numbers[each.phi])
            groups.append((np.minimum(first, second), np.maximum(first, second)))
        return CondensedPattern.from_complete(
            structure,
            row_numbers=numbers,
            column_numbers=numbers,
            is_remaining=is_remaining,
            groups=groups,
            eliminated=eliminated,
        )

    def _is_loss_coupling(self, structure: tuple[Index, Index]) -> NDArray[np.bool_]:
        """Mask (entries,) of couplings at times so distant that no equation of motion has both."""
        indptr, rows = structure
        mask = np.zeros(len(rows), dtype=bool)
        for transcription in self.transcriptions:
            first = transcription.columns.start
            # Entries of other columns are not couplings; rows of positions come after those of q.
            entries = slice(indptr[first], indptr[transcription.columns.stop])
            times = np.arange(transcription.variable_count) // transcription.dof_count
            # The first time that an equation of motion contains together with that of the column.
            earliest = times - transcription.dynamics.largest_lag
            first_rows = first + np.maximum(earliest, 0) * transcription.dof_count
            counts = np.diff(indptr[first : transcription.columns.stop + 1])
            own_rows = rows[entries]
            mask[entries] = (own_rows >= first) & (own_rows < np.repeat(first_rows, counts))
        return mask

    @property
    def hessian_structure(self) -> tuple[Index, Index]:
        return self._hessian.assembly.structure

    @cached_property
    def hessian_diagonals(self) -> tuple[Index, Index]:
        of_q, of_x = self.complete.hessian_diagonals
        positions = self._hessian.positions_of(np.concatenate([of_q, of_x]))
        return positions[: len(of_q)], positions[len(of_q) :]

    def hessian_values(
        self, z: Array, loss_weight: float, multipliers: Array | None, out: Array | None = None
    ) -> Array:
        pattern = self._hessian
        numbers, _ = self._condensed_indices
        if multipliers is not None:
            multipliers = self.complete_multipliers(z, loss_weight, multipliers=multipliers)
        complete_values = self._complete_hessian(
            self.complete_variables(z), loss_weight, multipliers=multipliers
        )
        groups = []
        for each, columns, (_, slopes) in zip(
            self.eliminated, pattern.eliminated, self._prescribed(z), strict=True
        ):
            product = columns.times(complete_values, slopes)
            eliminated_rows, phi_rows = (
                np.searchsorted(columns.rows, a) for a in (each.variables, each.phi)
            )
            # An entry of φ by φ comes twice, from either side; one of the diagonal once.
            product[phi_rows] += slopes.T @ product[eliminated_rows] / 2
            product[phi_rows, np.arange(len(phi_rows))] *= 2
            groups.append(product[numbers[columns.rows] >= 0].ravel())
        return pattern.assemble(complete_values, out, groups=groups)

    def _complete_hessian(self, z: Array, loss_weight: float, multipliers: Array | None) -> Array:
        """Return the Hessian with its Gauss–Newton part at clocks rounded to whole samples."""
        # There each residual depends on few positions. The part with the multipliers is that at z.
        nearest = z.copy()
        p = self.complete.parameters_from(z)
        for transcription in self.transcriptions:
            nuisance = transcription.nuisance
            places = transcription.nuisance_indices.indices
            clock_places = nuisance.indices_of_rows(TIME)
            sample = transcription.experiment.timestep_s / nuisance.scales[clock_places]
            samples = np.round(p[places[clock_places]] / sample)
            p[places[nuisance.clock_indices]] = 0
            p[places[clock_places]] = samples * sample
        nearest[self.complete.phi_columns] = p[self.nq :]
        if np.array_equal(nearest, z):
            return self.complete.hessian_values(z, loss_weight, multipliers=multipliers)
        values = self.complete.hessian_values(nearest, loss_weight, multipliers=None)
        if multipliers is not None:
            values += self.complete.hessian_values(z, loss_weight, multipliers=multipliers)
            values -= self.complete.hessian_values(z, loss_weight, multipliers=None)
        return values


def _products(rows: Index, columns: Index) -> tuple[Index, Index]:
    """Return rows and columns (r · c,) of every row in every column, row by row."""
    return np.repeat(rows, len(columns)), np.tile(columns, len(rows))
