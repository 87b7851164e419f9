"""Collocation program: node positions at all grid times and the parameters as unknowns.

    minimise   L(q, x, φ) = Σ ρ(‖(ŷ − y(x, φ)) / σ‖) + priors(q) + Σ φ²
    subject to c_{e,t,i}(x, θ(q), φ) = 0 for free dofs, x_{e,t,i} = u_t x̄_i for grasped ones.

Variables z, in this order:

=================  =========================================================================
q                  estimated parameters, in the order of `Parameters.free`
x_{e,t,i} / ℓ_e    positions: experiment e, grid time t, dof i = 3·node + axis, the last
                   index fastest; ℓ_e is the mean edge length
φ_e                nuisance parameters of experiment e, see `model.nuisance`, experiment by
                   experiment; shared ones are those of the first experiment that has them,
                   see `program.sharing`
=================  =========================================================================

Lifted variables (history variables, reaction forces, wrenches, contact pressures) are eliminated by
default; with `Collocation.explicit` they follow at the end of z, and their equations at the end of
g.

Constraints g, in this order:

=================  =========================================================================
c_{e,t,i} / f_e    equations of motion: experiment e, grid time t from 0 (start in
                   equilibrium) or 1, free dofs i ascending; f_e is the mean of
                   |∂c_t/∂x_t| ℓ_e at the guess
(x − u x̄) / ℓ_e    prescribed displacements, in place of c: of dofs grasped for a part of the
                   time; with `explicit_grasps` of all grasped dofs, so that every dof has a
                   constraint
=================  =========================================================================
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from ..arrays import Array, Index
from ..errors import InputError
from ..model.parameters import Parameters
from ..model.schemes import Scheme
from ..recording.experiment import Experiment
from .carried import Carried, Places
from .charts import Chart
from .entries import OffBand
from .explicit import carried_by
from .part import Part
from .segment import First, RowWeights, Segment
from .sharing import locals_of, shared_charts


def carried_over(z: Array, of: Collocation, to: Collocation) -> Array:
    """Convert the variables z of a program to those of the same program with or without lifted
    variables.

    Parameters
    ----------
    z : (variables,) array
        Variables of the program `of`.
    of : Collocation
        The program that z belongs to.
    to : Collocation
        The same program, with or without lifted variables.

    Returns
    -------
    (to.variables,) array
        Variables; lifted ones follow from positions and parameters.
    """
    return z if len(z) == to.variables else to.pack(*of.unpack(z))


@dataclass(frozen=True)
class Violation:
    """Residual of one equation of motion.

    Attributes
    ----------
    experiment : str
        Name of the experiment.
    time_s : float
        Grid time [s].
    node : int
        Index of the node.
    axis : str
        "x", "y" or "z".
    newtons : float
        Residual [N].
    """

    experiment: str
    time_s: float
    node: int
    axis: str
    newtons: float

    def __str__(self) -> str:
        return (
            f"{self.experiment}: t = {self.time_s:.4g} s, node {self.node}, {self.axis}: "
            f"{self.newtons:+.3g} N"
        )


@dataclass(frozen=True, eq=False)
class Collocation:
    """Values and derivatives of the collocation program of one or several experiments.

    Attributes
    ----------
    experiments : sequence of Experiment
        Experiments with common parameters q; those for validation are left out.
    parameters : Parameters
        Shared parameters.
    scheme : str or Scheme, default "midpoint"
        Time discretisation.
    substeps : int, default 1
        Grid steps between samples; static experiments have one.
    explicit_grasps : bool, default False
        If true, prescribed displacements are constraints instead of bounds.
    huber : float, optional
        Threshold of Huber's loss in standard deviations, see `Instrument`; None means a quadratic
        loss.
    charts : mapping of experiment name to Chart
        Elements, clock samples and correspondences of the measurements. Experiments that are
        missing, or whose chart belongs to another body or other priors, get the chart of the stated
        places.
    explicit : bool, default False
        If true, keep history variables, measured wrenches and contact pressures as variables with
        constraints (lifted variables, see `carried`), so that the exact matrices are sparse. If
        false, they are eliminated. The optimum and the multipliers of the other constraints are the
        same.

    Raises
    ------
    InputError
        If all experiments are for validation, or an option is not positive.
    """

    experiments: Sequence[Experiment]
    parameters: Parameters
    scheme: str | Scheme = "midpoint"
    substeps: int = 1
    explicit_grasps: bool = False
    huber: float | None = None
    charts: Mapping[str, Chart] = field(default_factory=dict)
    explicit: bool = False

    def __post_init__(self) -> None:
        if all(experiment.validation for experiment in self.experiments):
            raise InputError("every experiment is for validation: there is nothing to fit")
        if self.substeps < 1:
            raise InputError(f"substeps = {self.substeps}, expected at least 1")
        if self.huber is not None and not self.huber > 0:
            raise InputError(f"huber = {self.huber:g}, expected a positive number", None, "solver")
        self.parameters.fit({id(s.body): s.body for s in self.segments}.values())

    # Sizes and layout -------------------------------------------------------------------------

    @cached_property
    def segments(self) -> tuple[Segment, ...]:
        """Transcriptions of the experiments that are fitted."""
        fitted = [each for each in self.experiments if not each.validation]
        segments = list[Segment]()
        for experiment, local in zip(fitted, locals_of(fitted, self.nq), strict=True):
            chart = self.charts.get(experiment.name)
            if chart is None or not chart.suits(experiment):
                chart = Chart.of(experiment)
            segments.append(
                Segment(
                    experiment,
                    self.parameters,
                    scheme=self.scheme,
                    substeps=1 if experiment.static else self.substeps,
                    explicit_grasps=self.explicit_grasps,
                    huber=self.huber,
                    first=segments[-1].after if segments else First(self.nq, 0),
                    local=local,
                    chart=chart,
                )
            )
        return _read_alike(segments, [segment.chart for segment in segments])

    @cached_property
    def carried(self) -> tuple[Carried, ...]:
        """Lifted variables, experiment by experiment; empty unless `explicit`."""
        if not self.explicit:
            return ()
        last = self.segments[-1].after
        return carried_by(self.segments, self.of_phi.start, Places(self.of_phi.stop, last.row))

    def made_explicit(self) -> Collocation:
        """Return the program with lifted variables, or self if it has them already or
        nothing can be lifted.
        """
        has_sensors = any(len(s.sensed_dofs) for s in self.segments)
        has_complementarity = any(s.dynamics.forces.pressing for s in self.segments)
        if self.explicit or not (self.remembers or has_sensors or has_complementarity):
            return self
        other = replace(self, explicit=True)
        vars(other)["segments"] = self.segments
        return other

    @property
    def nq(self) -> int:
        """Number of shared parameters q."""
        return len(self.parameters.free)

    @property
    def nphi(self) -> int:
        """Number of nuisance parameters φ of all experiments; shared ones count once."""
        return int(np.concatenate(self.places).max(initial=self.nq - 1)) + 1 - self.nq

    @property
    def variables(self) -> int:
        """Number of variables z."""
        return self.of_phi.stop + self.added()

    @property
    def constraints(self) -> int:
        """Number of constraints g."""
        return self.segments[-1].after.row + self.added()

    def added(self, called: str | None = None) -> int:
        """Return the number of lifted variables, which is also that of their equations.

        Parameters
        ----------
        called : {"memory", "force", "pressure", "wrench"}, optional
            Kind of lifted variables; None means all.
        """
        return sum(each.count for each in self.carried if called in (None, each.called))

    @property
    def carried_nonzeros(self) -> tuple[int, int]:
        """Numbers of entries of lifted variables in the Jacobian and in the Hessian."""
        both = [each.nonzeros for each in self.carried]
        return sum(each for each, _ in both), sum(each for _, each in both)

    @property
    def measurements(self) -> int:
        """Number of scalar measurements that are compared."""
        return sum(
            int(reading.components.sum())
            for segment in self.segments
            for reading in segment.readings
        )

    @property
    def loss_scale(self) -> float:
        """Factor of the loss in the objective: one over the number of measurements."""
        return 1.0 / max(1, self.measurements)

    def pack(self, p: Array, positions: Sequence[Array]) -> Array:
        """Return the variables z.

        Parameters
        ----------
        p : (nq + nphi,) array
            Parameters (q, φ_1, φ_2, …).
        positions : sequence of (N, 3n) arrays
            Positions of each fitted experiment [m].

        Returns
        -------
        (variables,) array
            Scaled variables; lifted ones follow from positions and parameters.
        """
        parts = self.parts_at(p, positions) if self.carried else []
        lifted = [each.following(parts[each.number]) for each in self.carried]
        return np.concatenate([self._packed(p, positions), *lifted])

    def _packed(self, p: Array, positions: Sequence[Array]) -> Array:
        """Return z without lifted variables."""
        pairs = zip(self.segments, positions, strict=True)
        scaled = [np.ravel(x) / segment.length_m for segment, x in pairs]
        return np.concatenate([p[: self.nq], *scaled, p[self.nq :]])

    def unpack(self, z: Array) -> tuple[Array, list[Array]]:
        """Return the parameters p (nq + nphi,) and the positions (N, 3n) of each experiment
        [m] from z.
        """
        return self.parameters_of(z), [
            z[segment.columns].reshape(segment.grid_rows, segment.dofs) * segment.length_m
            for segment in self.segments
        ]

    def parameters_of(self, z: Array) -> Array:
        """Return all estimated parameters p = (q, φ_1, φ_2, …) from z."""
        return np.concatenate([z[: self.nq], z[self.of_phi]])

    @property
    def of_phi(self) -> slice:
        """Slice of the nuisance parameters in z."""
        first = self.segments[-1].after.x
        return slice(first, first + self.nphi)

    def parts(self, z: Array) -> list[Part]:
        """Return every experiment at the variables z, with lifted variables taken from z."""
        parts = self.parts_at(*self.unpack(z))
        for each in self.carried:
            parts[each.number] = each.given(parts[each.number], z)
        return parts

    @cached_property
    def places(self) -> list[Index]:
        """Indices of (q, φ) of each experiment in p."""
        return [segment.places for segment in self.segments]

    @property
    def threads(self) -> int:
        """Number of threads that all bodies may use."""
        return min(segment.body.threads for segment in self.segments)

    def parts_at(self, p: Array, positions: Sequence[Array]) -> list[Part]:
        """Return every experiment at parameters p and positions (N, 3n) [m], or their first rows.

        Lifted quantities follow from positions and parameters.
        """
        return [
            Part(segment, p[: self.nq], p[segment.local.places], x)
            for segment, x in zip(self.segments, positions, strict=True)
        ]

    @property
    def names(self) -> tuple[str, ...]:
        """Name of each entry of p: the parameters' names, then the labels of the nuisance
        parameters.
        """
        found = [item.name for item in self.parameters.free] + [""] * self.nphi
        for segment in self.segments:
            for place, name in zip(segment.local.places, segment.nuisance.names, strict=True):
                found[place] = name
        return tuple(found)

    def prior(self, p: Array) -> tuple[Array, Array]:
        """Return residuals (nq + nphi,) of the priors at p and their derivatives, both in standard
        deviations.

        A parameter without a prior has the residual 0.
        """
        residuals, slopes = self.parameters.prior(p[: self.nq])
        return (
            np.concatenate([residuals, p[self.nq :]]),
            np.concatenate([slopes, np.ones(self.nphi)]),
        )

    @property
    def bounds_p(self) -> tuple[Array, Array]:
        """Lower and upper bounds of p."""
        lower, upper = self.parameters.bounds_q
        low, high = (np.full(self.nphi, bound) for bound in (-np.inf, np.inf))
        for segment in self.segments:
            indices = segment.local.places - self.nq
            least, most = segment.nuisance.limits(segment.chart.samples)
            low[indices] = np.maximum(low[indices], least)
            high[indices] = np.minimum(high[indices], most)
        return np.concatenate([lower, low]), np.concatenate([upper, high])

    # Where recordings are read ----------------------------------------------------------------

    def following(self, p: Array, positions: Sequence[Array] = ()) -> tuple[Collocation, Array]:
        """Update the charts where the estimates p have left them.

        Parameters
        ----------
        p : (nq + nphi,) array
            Parameters.
        positions : sequence of (rows, 3n) arrays
            First rows of each experiment [m], which depth cameras need; empty without depth
            cameras.

        Returns
        -------
        (Collocation, array)
            The program with the new charts, which is self if no chart has changed, and p in it.
        """
        rows = positions or [np.zeros((0, segment.dofs)) for segment in self.segments]
        pairs = zip(self.segments, rows, strict=True)
        updates = [s.following(p[s.local.places], x) for s, x in pairs]
        if all(chart is s.chart for (chart, _), s in zip(updates, self.segments, strict=True)):
            return self, p
        return self._read_in([chart for chart, _ in updates], p, [phi for _, phi in updates])

    def placed(self, p: Array, positions: Sequence[Array]) -> tuple[Collocation, Array]:
        """Initialise unknown marker places and depth cameras before a solve, see `Segment.placed`.

        Parameters
        ----------
        p : (nq + nphi,) array
            Parameters.
        positions : sequence of (rows, 3n) arrays
            First rows of each experiment [m].

        Returns
        -------
        (Collocation, array)
            The program with the new charts, which is self if everything is stated, and p in it.
        """
        if not any(segment.rows_to_place for segment in self.segments):
            return self, p
        updates = [part.segment.placed(part.phi, part.x) for part in self.parts_at(p, positions)]
        return self._read_in([chart for chart, _ in updates], p, [phi for _, phi in updates])

    def placed_at(self, places_m: Sequence[Array]) -> Collocation:
        """Return the program with charts about given marker places, (M, 3) for each
        experiment [m].
        """
        charts = [s.chart.about(m) for s, m in zip(self.segments, places_m, strict=True)]
        segments = [s.with_chart(c) for s, c in zip(self.segments, charts, strict=True)]
        return self._read_in(charts, self.guess_p, [s.guess_phi for s in segments])[0]

    def _read_in(
        self, charts: Sequence[Chart], p: Array, phis: Sequence[Array]
    ) -> tuple[Collocation, Array]:
        """Return the program with other charts, and p with the φ of each experiment in them."""
        other = copy(self)
        updated = self._put_together(p[: self.nq], phis)
        segments = _read_alike(self.segments, charts)
        by_name = {s.experiment.name: s.chart for s in segments}
        vars(other).update(charts=by_name, segments=segments)
        for stale in ("_hessian", "hessian_diagonals", "carried"):
            vars(other).pop(stale, None)
        return other, updated

    @property
    def guess_p(self) -> Array:
        """Guess of p: that of q, and φ at the centres of the charts."""
        return self._put_together(self.parameters.guess_q, [s.guess_phi for s in self.segments])

    def _put_together(self, q: Array, phis: Sequence[Array]) -> Array:
        """Return p from q and the φ of each experiment; shared entries are those of the
        first experiment.
        """
        p = np.concatenate([q, np.zeros(self.nphi)])
        for segment, phi in reversed([*zip(self.segments, phis, strict=True)]):
            p[segment.local.places] = phi
        return p

    @property
    def reach_p(self) -> Array:
        """Scale of p: the change of each entry that a trust region of radius one allows."""
        return self._put_together(np.ones(self.nq), [s.nuisance.reach for s in self.segments])

    def bounds(self) -> tuple[Array, Array]:
        """Return lower and upper bounds of z; equal where a value is prescribed."""
        lower, upper = self.bounds_p
        lows, highs = zip(*(segment.bounds() for segment in self.segments), strict=True)
        least = [np.full(each.count, each.least) for each in self.carried]
        return (
            np.concatenate([self._packed(lower, lows), *least]),
            np.concatenate([self._packed(upper, highs), np.full(self.added(), np.inf)]),
        )

    # Objective --------------------------------------------------------------------------------

    def objective(self, z: Array) -> float:
        """Return the objective: loss and priors, divided by the number of measurements."""
        residuals, _ = self.prior(self.parameters_of(z))
        loss = sum(part.loss for part in self.parts(z))
        return self.loss_scale * float(residuals @ residuals + loss)

    def gradient(self, z: Array) -> Array:
        """Return the gradient of the objective by z."""
        parts = self.parts(z)
        residuals, slopes = self.prior(self.parameters_of(z))
        by_p = 2 * residuals * slopes
        by_x = []
        for part in parts:
            of_x, of_p = part.gradient()
            by_x.append(of_x.ravel() * part.segment.length_m)
            by_p[part.segment.places] += of_p
        further = [each.gradient(parts[each.number]) for each in self.carried]
        return self.loss_scale * np.concatenate([by_p[: self.nq], *by_x, by_p[self.nq :], *further])

    # Constraints ------------------------------------------------------------------------------

    def constraint_values(self, z: Array) -> Array:
        """Return the scaled constraints g."""
        parts = self.parts(z)
        rows = [part.segment.constraint_values(part.x, part.setting, part.along) for part in parts]
        further = [each.values(parts[each.number], z) for each in self.carried]
        return np.concatenate([*rows, *further])

    @property
    def jacobian_structure(self) -> tuple[Index, Index]:
        """Column pointers and row indices of ∂g/∂z in compressed columns."""
        return self._jacobian.structure

    @cached_property
    def _jacobian(self) -> OffBand:
        """Structure of ∂g/∂z: columns of q and x, then those of φ and of the lifted variables."""
        own = self.segments[-1].after.row
        indptr = [np.arange(self.nq + 1) * own]
        indices = [np.tile(np.arange(own), self.nq)]
        of_phi = []
        for segment in self.segments:
            indptr.append(indptr[-1][-1] + segment.jacobian.indptr[1:])
            indices.append(segment.first.row + segment.jacobian.indices)
            moving = segment.local.places[segment.nuisance.moving] - self.nq
            rows = segment.first.row + np.arange(segment.constraints)
            columns = self.of_phi.start + np.repeat(moving, len(rows))
            of_phi.append((np.tile(rows, len(moving)), columns))
        structure = np.concatenate(indptr), np.concatenate(indices)
        further = [each.jacobian_entries() for each in self.carried]
        return OffBand.of(structure, (self.constraints, self.variables), of_phi + further)

    def jacobian_values(self, z: Array, out: Array | None = None) -> Array:
        """Return the values of ∂g/∂z in the order of `jacobian_structure`.

        Parameters
        ----------
        z : (variables,) array
            Variables.
        out : array, optional
            Overwritten with the result and returned.
        """
        return self.constraints_and_jacobian(z, out)[1]

    def constraints_and_jacobian(self, z: Array, out: Array | None = None) -> tuple[Array, Array]:
        """Return constraints g and the values of ∂g/∂z, from one evaluation of the elements.

        Parameters
        ----------
        z : (variables,) array
            Variables.
        out : array, optional
            Overwritten with the values of ∂g/∂z.
        """
        parts = self.parts(z)
        height = self.segments[-1].after.row
        count = self.nq * height + sum(s.jacobian.nnz for s in self.segments)
        values, own = self._jacobian.values(out, count)
        columns = own[: self.nq * height].reshape(self.nq, height)
        rows = np.empty(height)
        further = []
        used = columns.size
        for part in parts:
            segment = part.segment
            here = own[used : used + segment.jacobian.nnz]
            constraints, by_p = segment.constraints_and_jacobian(
                part.x, part.setting, part.forces, here
            )
            rows[segment.rows] = constraints
            columns[:, segment.rows] = by_p[:, : self.nq].T
            further.append(by_p[:, self.nq :].T.ravel())
            used += segment.jacobian.nnz
        added = [each.jacobian_values(parts[each.number], z) for each in self.carried]
        self._jacobian.fill(values, own, further + [entries for _, entries in added])
        return np.concatenate([rows, *(equations for equations, _ in added)]), values

    def jacobian(self, z: Array) -> sp.csc_array:
        """Return ∂g/∂z as a sparse matrix; history variables that are eliminated are
        treated as constant.
        """
        indptr, indices = self.jacobian_structure
        shape = (self.constraints, self.variables)
        return sp.csc_array((self.jacobian_values(z), indices, indptr), shape=shape)

    @property
    def remembers(self) -> bool:
        """Whether history variables are eliminated, so that ∂g/∂z has more entries than
        `jacobian`.
        """
        return not self.explicit and any(segment.carries for segment in self.segments)

    def pulled_back(self, z: Array, multipliers: Array) -> Array:
        """Return the vector–Jacobian product (∂g/∂z)ᵀ multipliers, including eliminated
        history variables.
        """
        slope = self.jacobian(z).T @ multipliers
        for part in self.parts(z) if self.remembers else ():
            segment = part.segment
            weights = segment.weights(multipliers[segment.rows]).forces
            by_x, by_p = segment.pulled_through(part.x, part.setting, weights)
            slope[segment.columns] += segment.length_m * by_x.ravel()
            slope[segment.moving_in(self.of_phi.start)] += by_p
        return slope

    # Lagrangian -------------------------------------------------------------------------------

    @property
    def hessian_structure(self) -> tuple[Index, Index]:
        """Column pointers and row indices of the upper triangle of ∇²_z (w L + yᵀ g), in
        compressed columns.
        """
        return self._hessian.structure

    @cached_property
    def _hessian(self) -> OffBand:
        """Structure of the Hessian: columns of q, those of x from the motion, then all
        other entries.
        """
        counts = np.arange(self.nq + 1)
        further = []
        indptr = [counts * (counts + 1) // 2]
        indices = [np.concatenate([np.arange(k) for k in counts])]
        for segment in self.segments:
            indptr.append(indptr[-1][-1] + segment.hessian.indptr[1:])
            shift = np.where(segment.hessian.indices < self.nq, 0, segment.first.x - self.nq)
            indices.append(segment.hessian.indices + shift)
            further += segment.further_entries(self.of_phi.start)
        further += [each.hessian_entries() for each in self.carried]
        structure = np.concatenate(indptr), np.concatenate(indices)
        return OffBand.of(structure, (self.variables, self.variables), further)

    @cached_property
    def hessian_diagonals(self) -> tuple[Index, Index]:
        """Positions of the diagonal entries of q, and of x, in the values of the Hessian."""
        of_q = np.cumsum(np.arange(1, self.nq + 1)) - 1
        of_x = []
        used = self.nq * (self.nq + 1) // 2
        for segment in self.segments:
            of_x.append(used + segment.hessian_diagonal)
            used += segment.hessian.nnz
        return of_q, self._hessian.places_of(np.concatenate(of_x))

    def hessian_values(
        self, z: Array, loss_weight: float, multipliers: Array | None, out: Array | None = None
    ) -> Array:
        """Return the values of ∇²_z (loss_weight · objective + multipliers · g), upper triangle.

        Parameters
        ----------
        z : (variables,) array
            Variables.
        loss_weight : float
            Factor of the objective.
        multipliers : (constraints,) array or None
            Multipliers of g. None gives the Gauss–Newton matrix, which neglects the curvature of
            constraints and observations and is convex; the exact Hessian of the loss is not where
            residuals are large, because marker places and positions multiply.
        out : array, optional
            Overwritten with the result and returned.
        """
        bent = multipliers is not None
        parts = [replace(part, bent=bent) for part in self.parts(z)]
        multipliers = np.zeros(self.constraints) if multipliers is None else multipliers
        used = self.nq * (self.nq + 1) // 2
        count = used + sum(segment.hessian.nnz for segment in self.segments)
        values, own = self._hessian.values(out, count)
        by_q = np.zeros((self.nq, self.nq))
        further = list[Array]()
        weights = list[RowWeights]()
        weight = loss_weight * self.loss_scale
        for number, part in enumerate(parts):
            segment = part.segment
            here = own[used : used + segment.hessian.nnz]
            mine = [each for each in self.carried if each.number == number]
            of_rows = sum((each.row_weights(multipliers) for each in mine), start=0.0)
            weights.append(segment.weights(multipliers[segment.rows], of_rows))
            lifted_histories = [
                each.weighed(part, multipliers) for each in mine if each.history is not None
            ]
            by_q_own, further_own = segment.hessian_values(
                part.x,
                part.phi,
                part.setting,
                weights=weights[number],
                loss_weight=weight,
                values=here,
                carried=lifted_histories,
                bent=bent,
            )
            by_q = by_q + by_q_own
            further = further + further_own
            used = used + len(here)
        for each in self.carried:
            further.append(
                each.hessian_values(
                    parts[each.number],
                    z,
                    loss_weight=weight,
                    multipliers=multipliers,
                    weights=weights[each.number],
                )
            )
        _, slopes = self.parameters.prior(parts[0].q)
        by_q += np.diag(2 * weight * slopes**2)
        rows, columns = np.triu_indices(self.nq)
        order = np.lexsort((rows, columns))
        own[: len(rows)] = by_q[rows[order], columns[order]]
        self._hessian.fill(values, own, further)
        return values

    def kkt_residual(self, z: Array, multipliers: Array) -> float:
        """Return the largest violation of the first-order optimality conditions, in the scaling of
        the program.

        Stationarity of objective + multipliers · g in every variable that is not prescribed (at a
        bound, the gradient may point outwards), and feasibility.
        """
        rows = self.constraint_values(z)
        slope = self.gradient(z) + self.pulled_back(z, multipliers)
        lower, upper = self.bounds()
        slope[lower == upper] = 0
        tolerance = 1e-6
        for part in (slice(self.nq), self.of_phi):
            at_lower = (z - lower)[part] < tolerance
            at_upper = (upper - z)[part] < tolerance
            slope[part][at_lower] = np.minimum(slope[part][at_lower], 0)
            slope[part][at_upper] = np.maximum(slope[part][at_upper], 0)
        return float(max(np.abs(slope).max(initial=0.0), np.abs(rows).max(initial=0.0)))

    def hessian(self, z: Array, loss_weight: float, multipliers: Array | None) -> sp.csc_array:
        """Return ∇²_z (loss_weight · objective + multipliers · g), both triangles, as a sparse
        matrix.

        `multipliers` is None for the Gauss–Newton matrix, see `hessian_values`.
        """
        indptr, indices = self.hessian_structure
        values = self.hessian_values(z, loss_weight, multipliers)
        upper = sp.csc_array((values, indices, indptr), shape=(len(z), len(z)))
        return sp.csc_array(upper + sp.triu(upper, 1).T)

    # Reading a point --------------------------------------------------------------------------

    def violations_n(self, z: Array) -> list[Array]:
        """Return the residuals of the equations of motion (N, free dofs) of each experiment [N]."""
        return [part.residual_n for part in self.parts(z)]

    def largest_force_n(self, z: Array) -> float:
        """Return the largest internal or external force on a dof [N], as a scale for violations."""
        largest = 0.0
        for part in self.parts(z):
            dynamics = part.setting.dynamics
            total = dynamics.force(part.x, part.along)
            external = dynamics.evaluated.weight.external_n
            for force in (total - external, external):
                # What a grasp bears counts too: where nothing else acts, all other forces vanish.
                largest = max(largest, float(np.abs(force).max()))
        return largest

    def largest_violations(self, z: Array, count: int = 5) -> list[Violation]:
        """Return the `count` largest residuals of the equations of motion, in descending order."""
        violations = []
        for part in self.parts(z):
            segment = part.segment
            residual = part.residual_n
            worst = np.argsort(-np.abs(residual), axis=None)[:count]
            for t, place in zip(*np.unravel_index(worst, residual.shape), strict=True):
                node, axis = divmod(int(segment.free_dofs[place]), 3)
                violations.append(
                    Violation(
                        segment.experiment.name,
                        float(segment.dynamics.t_s[t]),
                        node,
                        "xyz"[axis],
                        float(residual[t, place]),
                    )
                )
        return sorted(violations, key=lambda violation: -abs(violation.newtons))[:count]

    def rms_m(self, z: Array) -> float:
        """Return the root mean square distance of the markers from their measurements [m];
        0 without markers.
        """
        squares = samples = 0.0
        for part in self.parts(z):
            squares_m2 = part.segment.markers.squared_distances_m2(part.x, part.phi)
            squares = squares + float(squares_m2.sum())
            samples = samples + len(squares_m2)
        return float(np.sqrt(squares / max(1.0, samples)))

    def values(self, z: Array) -> dict[str, float]:
        """Return the shared parameters of z by the user's names, in SI units."""
        return self.parameters.values(z[: self.nq])


def _read_alike(segments: Sequence[Segment], charts: Sequence[Chart]) -> tuple[Segment, ...]:
    """Return the segments with the given charts, made equal where nuisance parameters are
    shared.
    """
    parts = zip(segments, charts, strict=True)
    same = shared_charts((s.local, s.nuisance, chart) for s, chart in parts)
    return tuple(s.with_chart(chart) for s, chart in zip(segments, same, strict=True))
