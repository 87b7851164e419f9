"""The program as IPOPT gets it: fewer variables and rows, and a Hessian that joins less.

Where the body may be off in its grasps, held dofs follow from φ. Here they are no variables, and
the rows that hold them are none: derivatives go through them to φ, as columns. The optimum is that
of the program given, and so are the multipliers: what balances the Lagrangian's slope by the dofs
held is that of their rows.

An estimated clock reads between samples, so that the loss joins more timesteps than the equations
of motion do. Steps need no such entries: summed over a recording, products of slopes are nearly
the same a little earlier. So the Hessian has Gauss–Newton's as they are at the nearest whole
sample, where a reading has one timestep, and all that residuals curve as it is.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from ..arrays import Array, Index
from ..program.collocation import Collocation
from ..program.segment import Segment
from ..recording.nuisance import TIME


def condensed(whole: Collocation) -> Collocation:
    """The program without what follows from φ; itself where grasps and clocks are known."""
    if not any(s.nuisance.moves_grasps or len(s.nuisance.of_clock) for s in whole.segments):
        return whole
    made = object.__new__(Condensed)  # has been checked
    vars(made).update({f.name: getattr(whole, f.name) for f in fields(whole)}, whole=whole)
    return made


def whole_multipliers(program: Collocation, z: Array, multipliers: Array) -> Array:
    """Those of all rows of the program that was given to `condensed`, at an optimum."""
    if not isinstance(program, Condensed):
        return multipliers
    return program.whole_multipliers(z, 1.0, multipliers)


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Held dofs of one experiment as functions of its φ.

    Attributes
    ----------
    segment : Segment
    variables, rows : (h,) places of the dofs in z, and of the rows that hold them in g
    phi : (k,) places in z of the φ that move the body
    """

    segment: Segment
    variables: Index
    rows: Index
    phi: Index

    @classmethod
    def of(cls, segment: Segment, whole: Collocation) -> LeftOut:
        """Those that have rows."""
        rows = np.flatnonzero(segment.grasp_rows)
        time, place = np.divmod(rows, segment.rows_per_time)
        dofs = (segment.dynamics.first_row + time) * segment.dofs + segment.row_dofs[place]
        moving = segment.local.places[segment.nuisance.moving]
        phi = whole.of_phi.start - whole.nq + moving
        return cls(segment, segment.first.x + dofs, segment.first.row + rows, phi)

    def at(self, phi: Array) -> tuple[Array, Array]:
        """(h,) scaled positions, and their slopes (h, k)."""
        segment, held = self.segment, self.segment.grasping.at(phi)
        time, dof = np.divmod(self.variables - segment.first.x, segment.dofs)
        here = time, np.searchsorted(held.dofs, dof)
        return held.positions_m[here] / segment.length_m, held.by_phi[here] / segment.length_m


@dataclass(frozen=True, eq=False)
class HeldColumns:
    """Some columns of a sparse matrix.

    Attributes
    ----------
    entries : places of theirs among its values
    rows : (r,) the rows that have any, and others
    row, column : of each entry, counted among these
    """

    entries: Index
    rows: Index
    row: Index
    column: Index

    @classmethod
    def of(
        cls, entries: Index, rows: Index, columns: Index, wanted: Index, further: Index
    ) -> HeldColumns:
        """Those wanted, ascending, of all entries in rows and columns; with further rows."""
        here = np.flatnonzero(np.isin(columns, wanted))
        found = np.union1d(rows[here], further)
        places = np.searchsorted(found, rows[here]), np.searchsorted(wanted, columns[here])
        return cls(entries[here], found, *places)

    def times(self, values: Array, slopes: Array) -> Array:
        """(r, k) their product with slopes (h, k)."""
        shape = (len(self.rows), len(slopes))
        return sp.csr_array((values[self.entries], (self.row, self.column)), shape=shape) @ slopes


@dataclass(frozen=True, eq=False)
class Layout:
    """Entries of the smaller matrix, and where its values come from.

    Attributes
    ----------
    structure : column pointers and row indices
    kept : which values of the larger matrix stay
    places : where they are among its own, and then what comes through each experiment's held dofs
    through : the larger matrix's columns of these
    """

    structure: tuple[Index, Index]
    kept: Index
    places: Sequence[Index]
    through: Sequence[HeldColumns]

    @classmethod
    def of(
        cls,
        shape: tuple[int, int],
        kept: Index,
        pairs: Sequence[tuple[Index, Index]],
        through: Sequence[HeldColumns],
    ) -> Layout:
        """The union of the rows and columns given, those kept first."""
        codes = [(column * shape[0] + row).ravel() for row, column in pairs]
        found = np.unique(np.concatenate(codes))
        indptr = np.searchsorted(found, np.arange(shape[1] + 1) * shape[0])
        places = [np.searchsorted(found, each) for each in codes]
        return cls((indptr, found % shape[0]), kept, places, through)


class Condensed(Collocation):
    """A program whose held dofs follow from φ, with a Hessian that joins less.

    Attributes
    ----------
    whole : Collocation
        As it is given.
    """

    whole: Collocation

    @cached_property
    def segments(self) -> tuple[Segment, ...]:
        """One of each experiment that is fitted."""
        return self.whole.segments

    @cached_property
    def left_out(self) -> tuple[LeftOut, ...]:
        """What is neither variable nor row."""
        return tuple(LeftOut.of(s, self.whole) for s in self.segments if s.nuisance.moves_grasps)

    @cached_property
    def _kept(self) -> tuple[Index, Index]:
        """Variables and rows that are left."""
        variables, rows = np.arange(self.whole.variables), np.arange(self.whole.constraints)
        for each in self.left_out:
            variables[each.variables] = rows[each.rows] = -1
        return variables[variables >= 0], rows[rows >= 0]

    @cached_property
    def _numbers(self) -> tuple[Index, Index]:
        """Of each variable and row its place among those left, −1 of the others."""
        sizes = self.whole.variables, self.whole.constraints
        numbers = np.full(sizes[0], -1), np.full(sizes[1], -1)
        for number, kept in zip(numbers, self._kept, strict=True):
            number[kept] = np.arange(len(kept))
        return numbers

    @property
    def variables(self) -> int:
        """Length of z."""
        return len(self._kept[0])

    @property
    def constraints(self) -> int:
        """Length of g."""
        return len(self._kept[1])

    @property
    def kept_rows(self) -> Index:
        """Rows of the program given that are rows here, too."""
        return self._kept[1]

    @property
    def of_phi(self) -> slice:
        """The nuisance parameters in z."""
        first = int(self._numbers[0][self.whole.of_phi.start])
        return slice(first, first + self.nphi)

    @property
    def remembers(self) -> bool:
        """Whether ∂g/∂z has more than `jacobian` holds."""
        return self.whole.remembers

    def pack(self, p: Array, positions: Sequence[Array]) -> Array:
        """Variables z from parameters and positions, held dofs left out."""
        return self.whole.pack(p, positions)[self._kept[0]]

    def unpack(self, z: Array) -> tuple[Array, list[Array]]:
        """Parameters p and positions."""
        return self.whole.unpack(self.whole_variables(z))

    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of z; equal for what is given."""
        lower, upper = self.whole.bounds()
        return lower[self._kept[0]], upper[self._kept[0]]

    def whole_variables(self, z: Array) -> Array:
        """Those of the program given."""
        found = np.empty(self.whole.variables)
        found[self._kept[0]] = z
        for each, (positions, _) in zip(self.left_out, self._held(z), strict=True):
            found[each.variables] = positions
        return found

    def whole_multipliers(self, z: Array, loss_weight: float, multipliers: Array) -> Array:
        """Those of the program given, whose slopes by the held dofs they balance."""
        at, found = self.whole_variables(z), np.zeros(self.whole.constraints)
        found[self._kept[1]] = multipliers
        slope = loss_weight * self.whole.gradient(at) + self.whole.jacobian(at).T @ found
        for each in self.left_out:
            found[each.rows] = -slope[each.variables]
        return found

    def _held(self, z: Array) -> Iterator[tuple[Array, Array]]:
        p = self.parameters_of(z)
        return (each.at(p[each.segment.local.places]) for each in self.left_out)

    # Values -------------------------------------------------------------------------------------

    def objective(self, z: Array) -> float:
        """L divided by the number of measurements."""
        return self.whole.objective(self.whole_variables(z))

    def gradient(self, z: Array) -> Array:
        """∂objective/∂z."""
        slope = self.whole.gradient(self.whole_variables(z))
        for each, (_, by_phi) in zip(self.left_out, self._held(z), strict=True):
            slope[each.phi] += by_phi.T @ slope[each.variables]
        return slope[self._kept[0]]

    def constraint_values(self, z: Array) -> Array:
        """g, scaled."""
        return self.whole.constraint_values(self.whole_variables(z))[self._kept[1]]

    # Matrices -----------------------------------------------------------------------------------

    @cached_property
    def _jacobian(self) -> Layout:
        of_variable, of_row = self._numbers
        rows, columns = _entries(self.whole.jacobian_structure)
        left = np.flatnonzero(of_row[rows] >= 0)
        kept = left[of_variable[columns[left]] >= 0]
        pairs, through = [(of_row[rows[kept]], of_variable[columns[kept]])], []
        for each in self.left_out:
            of_left = of_row[rows[left]], columns[left]
            through.append(HeldColumns.of(left, *of_left, each.variables, np.zeros(0, dtype=int)))
            pairs.append((through[-1].rows[:, None], of_variable[each.phi]))
        return Layout.of((self.constraints, self.variables), kept, pairs, through)

    @property
    def jacobian_structure(self) -> tuple[Index, Index]:
        """Column pointers and row indices of ∂g/∂z by compressed columns."""
        return self._jacobian.structure

    def constraints_and_jacobian(self, z: Array, out: Array | None = None) -> tuple[Array, Array]:
        """Constraints g and the values of ∂g/∂z, from one evaluation of the elements."""
        layout = self._jacobian
        values = np.empty(len(layout.structure[1])) if out is None else out
        values[:] = 0
        rows, whole = self.whole.constraints_and_jacobian(self.whole_variables(z))
        values[layout.places[0]] = whole[layout.kept]
        parts = zip(layout.places[1:], layout.through, self._held(z), strict=True)
        for places, through, (_, slopes) in parts:
            values[places] += through.times(whole, slopes).ravel()
        return rows[self._kept[1]], values

    @cached_property
    def _hessian(self) -> Layout:
        number, _ = self._numbers
        rows, columns = _entries(self.whole.hessian_structure)
        both = (number[rows] >= 0) & (number[columns] >= 0)
        kept = np.flatnonzero(both & ~self._only_read_together(rows, columns))
        pairs, through = [(number[rows[kept]], number[columns[kept]])], []
        # Of the lower triangle too, whose diagonal is that of the upper one.
        below = np.flatnonzero(rows != columns)
        entries = np.concatenate([np.arange(len(rows)), below])
        row = np.concatenate([rows, columns[below]])
        column = np.concatenate([columns, rows[below]])
        for each in self.left_out:
            own = np.concatenate([each.variables, each.phi])
            through.append(HeldColumns.of(entries, row, column, each.variables, own))
            i, j = number[through[-1].rows[:, None]], number[each.phi]
            pairs.append((np.minimum(i, j)[i[:, 0] >= 0], np.maximum(i, j)[i[:, 0] >= 0]))
        size = self.variables
        return Layout.of((size, size), kept, pairs, through)

    def _only_read_together(self, rows: Index, columns: Index) -> NDArray[np.bool_]:
        """Which entries join positions that no equation of motion joins."""
        far = np.zeros(len(rows), dtype=bool)
        for segment in self.segments:
            time = np.full(self.whole.variables, -1)
            time[segment.columns] = np.arange(segment.variables) // segment.dofs
            first, second = time[rows], time[columns]
            apart = np.abs(first - second) > segment.dynamics.reach
            far |= (first >= 0) & (second >= 0) & apart
        return far

    @property
    def hessian_structure(self) -> tuple[Index, Index]:
        """The same of the upper triangle of ∇²_z (w L + yᵀ g)."""
        return self._hessian.structure

    @cached_property
    def hessian_diagonals(self) -> tuple[Index, Index]:
        """Positions of the diagonal entries of q, and of x, in the values of the Hessian."""
        places = np.full(len(self.whole.hessian_structure[1]), -1)
        places[self._hessian.kept] = self._hessian.places[0]
        of_q, of_x = (places[each] for each in self.whole.hessian_diagonals)
        return of_q, of_x[of_x >= 0]

    def hessian_values(
        self, z: Array, loss_weight: float, multipliers: Array | None, out: Array | None = None
    ) -> Array:
        """Values of ∇²_z (loss_weight · objective + multipliers · g), upper triangle."""
        layout, (number, _) = self._hessian, self._numbers
        values = np.empty(len(layout.structure[1])) if out is None else out
        values[:] = 0
        if multipliers is not None:
            multipliers = self.whole_multipliers(z, loss_weight, multipliers)
        whole = self._whole_hessian(self.whole_variables(z), loss_weight, multipliers)
        values[layout.places[0]] = whole[layout.kept]
        parts = zip(self.left_out, layout.places[1:], layout.through, self._held(z), strict=True)
        for each, places, through, (_, slopes) in parts:
            found = through.times(whole, slopes)
            held, phi = (np.searchsorted(through.rows, a) for a in (each.variables, each.phi))
            # An entry of φ by φ comes twice, from either side; one of the diagonal once.
            found[phi] += slopes.T @ found[held] / 2
            found[phi, np.arange(len(phi))] *= 2
            np.add.at(values, places, found[number[through.rows] >= 0].ravel())
        return values

    def _whole_hessian(self, z: Array, loss_weight: float, multipliers: Array | None) -> Array:
        """Of the program given, with Gauss–Newton's product at the nearest sample."""
        nearest, p = z.copy(), self.whole.parameters_of(z)
        for segment in self.segments:
            nuisance, places = segment.nuisance, segment.local.places
            late = nuisance.places(TIME)
            sample = segment.experiment.timestep_s / nuisance.scales[late]
            samples = np.round(p[places[late]] / sample)
            p[places[nuisance.of_clock]] = 0
            p[places[late]] = samples * sample
        nearest[self.whole.of_phi] = p[self.nq :]
        if np.array_equal(nearest, z):
            return self.whole.hessian_values(z, loss_weight, multipliers)
        found = self.whole.hessian_values(nearest, loss_weight, None)
        if multipliers is not None:
            found += self.whole.hessian_values(z, loss_weight, multipliers)
            found -= self.whole.hessian_values(z, loss_weight, None)
        return found


def _entries(structure: tuple[Index, Index]) -> tuple[Index, Index]:
    """Row and column of each entry."""
    indptr, rows = structure
    return rows, np.repeat(np.arange(len(indptr) - 1), np.diff(indptr))
