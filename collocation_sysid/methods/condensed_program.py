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
from ..program.collocation import Collocation
from ..program.transcription import Transcription
from ..recording.nuisance import TIME


def condense(complete: Collocation) -> Collocation:
    """Return the program without the grasped positions that follow from φ, and with a sparser
    Hessian; the argument itself if no grasp and no clock is estimated.

    The given program is not modified.
    """
    if not any(
        s.nuisance.affects_grasps or len(s.nuisance.clock_indices)
        for s in complete.transcriptions
    ):
        return complete
    program = object.__new__(CondensedCollocation)  # has been checked
    vars(program).update(
        {f.name: getattr(complete, f.name) for f in fields(complete)},
        complete=complete,
    )
    return program


def complete_program(program: Collocation) -> Collocation:
    """Return the program with all variables: that of which a condensed program is made, otherwise
    the argument itself.
    """
    return (
        program.complete
        if isinstance(program, CondensedCollocation)
        else program
    )


def complete_multipliers(
    program: Collocation, z: Array, multipliers: Array
) -> Array:
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
    """Grasped dofs of one experiment, as functions of its φ.

    Attributes
    ----------
    segment : Transcription
        Transcription of the experiment.
    variables : (h,) array of int
        Indices of the dofs in z of the complete program.
    rows : (h,) array of int
        Indices in g of the constraints that prescribe them.
    phi : (k,) array of int
        Indices in z of the φ that move the body in its grasps.
    """

    segment: Transcription
    variables: Index
    rows: Index
    phi: Index

    @classmethod
    def from_segment(
        cls, transcription: Transcription, complete: Collocation
    ) -> EliminatedDofs:
        """Return the grasped dofs of an experiment whose positions follow from φ: those that
        constraints of the `complete` program prescribe, which contains the `transcription`.
        """
        rows = np.flatnonzero(transcription.is_grasp_constraint)
        time, place = np.divmod(rows, transcription.constraints_per_time)
        dofs = (
            transcription.dynamics.first_row + time
        ) * transcription.dof_count + transcription.constrained_dofs[place]
        moving = transcription.nuisance_indices.indices[
            transcription.nuisance.motion_indices
        ]
        phi = complete.phi_columns.start - complete.nq + moving
        return cls(
            transcription,
            transcription.offsets.position + dofs,
            rows=transcription.offsets.row + rows,
            phi=phi,
        )

    def evaluate(self, phi: Array) -> tuple[Array, Array]:
        """Return the scaled positions (h,) of the eliminated dofs, and their derivatives (h, k) by
        the k parameters of `self.phi`, from all nuisance parameters `phi` of the experiment.
        """
        segment = self.segment
        prescribed = self.segment.prescribed_motion.evaluate_at(phi)
        time, dof = np.divmod(
            self.variables - segment.offsets.position, segment.dof_count
        )
        indices = time, np.searchsorted(prescribed.dofs, dof)
        return prescribed.positions_m[
            indices
        ] / segment.length_m, prescribed.by_phi[indices] / segment.length_m


@dataclass(frozen=True, eq=False)
class EliminatedColumns:
    """Columns of a sparse matrix that belong to eliminated variables.

    Attributes
    ----------
    entries : array of int
        Indices of the columns' entries among the values of the matrix.
    rows : (r,) array of int
        Row indices in which the columns have entries, and further rows.
    row : array of int
        Index in `rows` of each entry.
    column : array of int
        Index among the eliminated columns of each entry.
    """

    entries: Index
    rows: Index
    row: Index
    column: Index

    @classmethod
    def select(
        cls,
        entries: Index,
        rows: Index,
        columns: Index,
        selected: Index,
        further_rows: Index,
    ) -> EliminatedColumns:
        """Select columns of a matrix.

        Parameters
        ----------
        entries : (e,) array of int
            Index of each entry among the values.
        rows : (e,) array of int
            Row of each entry.
        columns : (e,) array of int
            Column of each entry.
        selected : (h,) array of int
            Columns to select, ascending.
        further_rows : array of int
            Rows that are included even if they have no entries.
        """
        selected_entries = np.flatnonzero(np.isin(columns, selected))
        selected_rows = np.union1d(rows[selected_entries], further_rows)
        return cls(
            entries[selected_entries],
            selected_rows,
            row=np.searchsorted(selected_rows, rows[selected_entries]),
            column=np.searchsorted(selected, columns[selected_entries]),
        )

    def times(self, values: Array, slopes: Array) -> Array:
        """Return the product (r, k) of these columns with `slopes` (h, k), from all values of the
        matrix.
        """
        shape = (len(self.rows), len(slopes))
        return (
            sp.csr_array(
                (values[self.entries], (self.row, self.column)), shape=shape
            )
            @ slopes
        )


@dataclass(frozen=True, eq=False)
class CondensedPattern:
    """Sparsity pattern of a condensed matrix, and the origin of its values.

    Attributes
    ----------
    structure : tuple of two arrays of int
        Column pointers and row indices.
    remaining : array of int
        Indices of the complete matrix's values that remain.
    targets : sequence of arrays of int
        Indices in the condensed values: first of the remaining values, then of the contributions by
        each experiment's eliminated dofs.
    eliminated : sequence of EliminatedColumns
        Columns of the complete matrix that give these contributions.
    """

    structure: tuple[Index, Index]
    remaining: Index
    targets: Sequence[Index]
    eliminated: Sequence[EliminatedColumns]

    @classmethod
    def from_pairs(
        cls,
        shape: tuple[int, int],
        remaining: Index,
        pairs: Sequence[tuple[Index, Index]],
        eliminated: Sequence[EliminatedColumns],
    ) -> CondensedPattern:
        """Return the union of several sets of entries.

        Parameters
        ----------
        shape : (rows, columns)
            Shape of the condensed matrix.
        remaining : array of int
            Indices of the complete matrix's values that remain.
        pairs : sequence of (rows, columns)
            Entries: first those that remain, then those of `eliminated`.
        eliminated : sequence of EliminatedColumns
            Columns that give contributions.
        """
        codes = [(column * shape[0] + row).ravel() for row, column in pairs]
        unique_codes = np.unique(np.concatenate(codes))
        indptr = np.searchsorted(
            unique_codes, np.arange(shape[1] + 1) * shape[0]
        )
        places = [np.searchsorted(unique_codes, each) for each in codes]
        return cls(
            (indptr, unique_codes % shape[0]),
            remaining,
            targets=places,
            eliminated=eliminated,
        )


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
        """Transcriptions of the fitted experiments."""
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
        """Indices in the complete program, ascending, of the variables and of the constraints that
        remain: two int arrays.
        """
        variables = np.arange(self.complete.variable_count)
        rows = np.arange(self.complete.constraint_count)
        for each in self.eliminated:
            variables[each.variables] = rows[each.rows] = -1
        return variables[variables >= 0], rows[rows >= 0]

    @cached_property
    def _condensed_indices(self) -> tuple[Index, Index]:
        """Index of each variable and of each constraint of the complete program among those that
        remain, −1 for those that are eliminated: two arrays of the complete sizes.
        """
        sizes = self.complete.variable_count, self.complete.constraint_count
        indices = np.full(sizes[0], -1), np.full(sizes[1], -1)
        for number, remaining in zip(indices, self._remaining, strict=True):
            number[remaining] = np.arange(len(remaining))
        return indices

    @property
    def variable_count(self) -> int:
        """Number of variables z that remain."""
        return len(self._remaining[0])

    @property
    def constraint_count(self) -> int:
        """Number of constraints g that remain."""
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
        """Whether ∂g/∂z has more entries than `jacobian` contains, because of internal
        variables.
        """
        return self.complete.has_eliminated_histories

    def pack(self, p: Array, positions: Sequence[Array]) -> Array:
        """Return variables z (variables,) from parameters p and positions, without the
        eliminated dofs.
        """
        return self.complete.pack(p, positions)[self._remaining[0]]

    def unpack(self, z: Array) -> tuple[Array, list[Array]]:
        """Return parameters p and the positions (N, 3n) of each experiment [m] from z, those of the
        eliminated dofs included.
        """
        return self.complete.unpack(self.complete_variables(z))

    def bounds(self) -> tuple[Array, Array]:
        """Return lower and upper bounds (variables,) of z; they are equal for known variables."""
        lower, upper = self.complete.bounds()
        return lower[self._remaining[0]], upper[self._remaining[0]]

    def complete_variables(self, z: Array) -> Array:
        """Return the variables of the complete program from z, with the eliminated positions at
        their values for the φ in z.
        """
        variables = np.empty(self.complete.variable_count)
        variables[self._remaining[0]] = z
        for each, (positions, _) in zip(
            self.eliminated, self._prescribed(z), strict=True
        ):
            variables[each.variables] = positions
        return variables

    def complete_multipliers(
        self, z: Array, loss_weight: float, multipliers: Array
    ) -> Array:
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
        """Return an iterator of positions and derivatives of the eliminated dofs of each experiment
        at z, see `EliminatedDofs.evaluate`.
        """
        p = self.parameters_from(z)
        return (
            each.evaluate(p[each.segment.nuisance_indices.indices])
            for each in self.eliminated
        )

    # Values -------------------------------------------------------------------------------------

    def objective(self, z: Array) -> float:
        """Return the loss L in the scaling of the NLP at z."""
        return self.complete.objective(self.complete_variables(z))

    def gradient(self, z: Array) -> Array:
        """Return ∂objective/∂z (variables,) by the remaining variables, including the dependence
        through the eliminated positions on φ.
        """
        slope = self.complete.gradient(self.complete_variables(z))
        for each, (_, by_phi) in zip(
            self.eliminated, self._prescribed(z), strict=True
        ):
            slope[each.phi] += by_phi.T @ slope[each.variables]
        return slope[self._remaining[0]]

    def constraint_values(self, z: Array) -> Array:
        """Return the scaled values (constraints,) of the constraints g that remain, at z
        (variables,).
        """
        return self.complete.constraint_values(self.complete_variables(z))[
            self._remaining[1]
        ]

    # Matrices -----------------------------------------------------------------------------------

    @cached_property
    def _jacobian(self) -> CondensedPattern:
        """Pattern of ∂g/∂z, and how its values follow from those of the complete program."""
        of_variable, of_row = self._condensed_indices
        rows, columns = _entries(self.complete.jacobian_structure)
        remaining = np.flatnonzero(of_row[rows] >= 0)
        of_free_variables = remaining[of_variable[columns[remaining]] >= 0]
        pairs = [
            (
                of_row[rows[of_free_variables]],
                of_variable[columns[of_free_variables]],
            )
        ]
        through = []
        for each in self.eliminated:
            through.append(
                EliminatedColumns.select(
                    remaining,
                    rows=of_row[rows[remaining]],
                    columns=columns[remaining],
                    selected=each.variables,
                    further_rows=np.zeros(0, dtype=int),
                )
            )
            pairs.append((through[-1].rows[:, None], of_variable[each.phi]))
        return CondensedPattern.from_pairs(
            (self.constraint_count, self.variable_count),
            of_free_variables,
            pairs=pairs,
            eliminated=through,
        )

    @property
    def jacobian_structure(self) -> tuple[Index, Index]:
        """Column pointers and row indices of ∂g/∂z, by compressed columns."""
        return self._jacobian.structure

    def constraints_and_jacobian(
        self, z: Array, out: Array | None = None
    ) -> tuple[Array, Array]:
        """Return the constraints g (constraints,) and the values of ∂g/∂z, including the dependence
        through the eliminated positions, from one evaluation of the elements.

        Parameters
        ----------
        z : (variables,) array
            Variables.
        out : array, optional
            Memory for the values of ∂g/∂z; it is overwritten.
        """
        layout = self._jacobian
        values = np.empty(len(layout.structure[1])) if out is None else out
        values[:] = 0
        rows, complete_values = self.complete.constraints_and_jacobian(
            self.complete_variables(z)
        )
        values[layout.targets[0]] = complete_values[layout.remaining]
        parts = zip(
            layout.targets[1:],
            layout.eliminated,
            self._prescribed(z),
            strict=True,
        )
        for places, through, (_, slopes) in parts:
            values[places] += through.times(complete_values, slopes).ravel()
        return rows[self._remaining[1]], values

    @cached_property
    def _hessian(self) -> CondensedPattern:
        """Pattern of the upper triangle of the Hessian, and how its values follow from those of the
        complete program.
        """
        number, _ = self._condensed_indices
        rows, columns = _entries(self.complete.hessian_structure)
        are_remaining = (number[rows] >= 0) & (number[columns] >= 0)
        remaining = np.flatnonzero(
            are_remaining & ~self._is_loss_coupling(rows, columns)
        )
        pairs = [(number[rows[remaining]], number[columns[remaining]])]
        through = []
        # Of the lower triangle too, whose diagonal is that of the upper one.
        below = np.flatnonzero(rows != columns)
        entries = np.concatenate([np.arange(len(rows)), below])
        row = np.concatenate([rows, columns[below]])
        column = np.concatenate([columns, rows[below]])
        for each in self.eliminated:
            own = np.concatenate([each.variables, each.phi])
            through.append(
                EliminatedColumns.select(
                    entries,
                    row,
                    columns=column,
                    selected=each.variables,
                    further_rows=own,
                )
            )
            i = number[through[-1].rows[:, None]]
            j = number[each.phi]
            pairs.append(
                (np.minimum(i, j)[i[:, 0] >= 0], np.maximum(i, j)[i[:, 0] >= 0])
            )
        size = self.variable_count
        return CondensedPattern.from_pairs(
            (size, size), remaining, pairs=pairs, eliminated=through
        )

    def _is_loss_coupling(
        self, rows: Index, columns: Index
    ) -> NDArray[np.bool_]:
        """Return a mask (entries,) of those entries of the complete Hessian, by rows and columns,
        that couple positions at times so distant that no equation of motion contains both.
        """
        mask = np.zeros(len(rows), dtype=bool)
        for segment in self.transcriptions:
            time = np.full(self.complete.variable_count, -1)
            time[segment.columns] = (
                np.arange(segment.variable_count) // segment.dof_count
            )
            first = time[rows]
            second = time[columns]
            are_distant = np.abs(first - second) > segment.dynamics.largest_lag
            mask |= (first >= 0) & (second >= 0) & are_distant
        return mask

    @property
    def hessian_structure(self) -> tuple[Index, Index]:
        """Column pointers and row indices of the upper triangle of ∇²_z (w L + yᵀ g)."""
        return self._hessian.structure

    @cached_property
    def hessian_diagonals(self) -> tuple[Index, Index]:
        """Indices, in the values of the Hessian's upper triangle, of the diagonal entries of q
        (nq,), and of those of the positions that remain.
        """
        places = np.full(len(self.complete.hessian_structure[1]), -1)
        places[self._hessian.remaining] = self._hessian.targets[0]
        of_q, of_x = (places[each] for each in self.complete.hessian_diagonals)
        return of_q, of_x[of_x >= 0]

    def hessian_values(
        self,
        z: Array,
        loss_weight: float,
        multipliers: Array | None,
        out: Array | None = None,
    ) -> Array:
        """Return the values of ∇²_z (loss_weight · objective + multipliers · g), upper triangle.

        Parameters
        ----------
        z : (variables,) array
            Variables.
        loss_weight : float
            Weight of the objective.
        multipliers : (constraints,) array or None
            Multipliers; None gives the Gauss–Newton Hessian of the objective.
        out : array, optional
            Memory for the values; it is overwritten.
        """
        layout = self._hessian
        number, _ = self._condensed_indices
        values = np.empty(len(layout.structure[1])) if out is None else out
        values[:] = 0
        if multipliers is not None:
            multipliers = self.complete_multipliers(
                z, loss_weight, multipliers=multipliers
            )
        complete_values = self._complete_hessian(
            self.complete_variables(z), loss_weight, multipliers=multipliers
        )
        values[layout.targets[0]] = complete_values[layout.remaining]
        parts = zip(
            self.eliminated,
            layout.targets[1:],
            layout.eliminated,
            self._prescribed(z),
            strict=True,
        )
        for each, places, through, (_, slopes) in parts:
            product = through.times(complete_values, slopes)
            eliminated_rows, phi_rows = (
                np.searchsorted(through.rows, a)
                for a in (each.variables, each.phi)
            )
            # An entry of φ by φ comes twice, from either side; one of the diagonal once.
            product[phi_rows] += slopes.T @ product[eliminated_rows] / 2
            product[phi_rows, np.arange(len(phi_rows))] *= 2
            np.add.at(
                values, places, product[number[through.rows] >= 0].ravel()
            )
        return values

    def _complete_hessian(
        self, z: Array, loss_weight: float, multipliers: Array | None
    ) -> Array:
        """Return the values of the complete program's Hessian, with its Gauss–Newton part evaluated
        at clocks rounded to whole samples and no other clock errors.

        There each residual depends on few positions. The part with the multipliers is that at z.

        Parameters
        ----------
        z : (complete variables,) array
            Variables of the complete program; not modified.
        loss_weight : float
            Weight of the objective.
        multipliers : (complete constraints,) array or None
            None for the Gauss–Newton part alone.
        """
        nearest = z.copy()
        p = self.complete.parameters_from(z)
        for segment in self.transcriptions:
            nuisance = segment.nuisance
            places = segment.nuisance_indices.indices
            clock_places = nuisance.indices_of_rows(TIME)
            sample = (
                segment.experiment.timestep_s / nuisance.scales[clock_places]
            )
            samples = np.round(p[places[clock_places]] / sample)
            p[places[nuisance.clock_indices]] = 0
            p[places[clock_places]] = samples * sample
        nearest[self.complete.phi_columns] = p[self.nq :]
        if np.array_equal(nearest, z):
            return self.complete.hessian_values(
                z, loss_weight, multipliers=multipliers
            )
        values = self.complete.hessian_values(
            nearest, loss_weight, multipliers=None
        )
        if multipliers is not None:
            values += self.complete.hessian_values(
                z, loss_weight, multipliers=multipliers
            )
            values -= self.complete.hessian_values(
                z, loss_weight, multipliers=None
            )
        return values


def _entries(structure: tuple[Index, Index]) -> tuple[Index, Index]:
    """Return the row and the column of each entry of a matrix by compressed columns, whose
    structure is (indptr, rows).
    """
    indptr, rows = structure
    return rows, np.repeat(np.arange(len(indptr) - 1), np.diff(indptr))
