"""The collocation NLP: all node positions at all timesteps beside the parameters.

    minimise   L(q, x, φ) = Σ ρ(‖(ŷ − y(x, φ)) / σ‖) + priors(q) + Σ φ²
    subject to c_{e,t,i}(x, θ(q), φ) = 0 for free dofs, x_{e,t,i} = u_t x̄_i for grasped ones.

Variables z, in this order:

=================  =========================================================================
q                  of each estimated parameter, in the order of `Parameters.free`
x_{e,t,i} / ℓ_e    positions: experiment e, grid time t, dof i = 3·node + axis, the last
                   index fastest; ℓ_e is the mean edge length
φ_e                nuisance parameters of experiment e, see `model.nuisance`; experiment by
                   experiment, what several share with the first of them, see `program.sharing`
=================  =========================================================================

What bodies carry and what grasps give follows from these, or stands behind them with equations
behind all others, see `Collocation.explicit`.

Constraints g, in this order:

=================  =========================================================================
c_{e,t,i} / f_e    equations of motion: experiment e, grid time t from 0 (start in
                   equilibrium) or 1, free dofs i ascending; f_e is the mean of
                   |∂c_t/∂x_t| ℓ_e at the guess
(x − u x̄) / ℓ_e    for dofs grasped for a while only, in place of c at those times; and with
                   explicit grasps for all grasped ones, so that every dof has a row
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
    """Variables of a program as the same one has them that is explicit, or is not."""
    return z if len(z) == to.variables else to.pack(*of.unpack(z))


@dataclass(frozen=True)
class Violation:
    """One unsatisfied equation of motion."""

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
    """Values and derivatives of the collocation NLP of one or several experiments.

    Attributes
    ----------
    experiments : sequence of Experiment
        They share the parameters; those for validation are left out.
    parameters : Parameters
    scheme : str or Scheme, default "midpoint"
    substeps : int, default 1
        Grid steps between samples.
    explicit_grasps : bool, default False
        Grasped nodes as constraint rows instead of bounds.
    huber : float, optional
        Huber's loss beyond this many standard deviations, see `Instrument`.
    charts : mapping of experiment name to Chart
        Where recordings are read, see `charts`; where their markers start by default, and where
        one is not of the experiment's body and places.
    explicit : bool, default False
        Whether what follows row by row are variables with equations of their own, see `carried`:
        the memory of bodies, without which ∂g/∂z would be filled below the diagonal, and measured
        wrenches, without which the loss would be one of all that moves around grasps. Matrices are
        sparse then, and exact; eliminating it all leads back, with the same optimum and the same
        multipliers of the other rows.

    Raises
    ------
    InputError
        If nothing is to be fitted.
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
        """One of each experiment that is fitted."""
        fitted = [each for each in self.experiments if not each.validation]
        options, found = (self.explicit_grasps, self.huber), list[Segment]()
        for experiment, local in zip(fitted, locals_of(fitted, self.nq), strict=True):
            chart = self.charts.get(experiment.name)
            if chart is None or not chart.suits(experiment):
                chart = Chart.of(experiment)
            grid = self.scheme, 1 if experiment.static else self.substeps
            first = found[-1].after if found else First(self.nq, 0)
            here = first, local, chart
            found.append(Segment(experiment, self.parameters, *grid, *options, *here))
        return _read_alike(found, [segment.chart for segment in found])

    @cached_property
    def carried(self) -> tuple[Carried, ...]:
        """What is among the variables behind all others, experiment by experiment."""
        if not self.explicit:
            return ()
        last = self.segments[-1].after
        return carried_by(self.segments, self.of_phi.start, Places(self.of_phi.stop, last.row))

    def made_explicit(self) -> Collocation:
        """The same program with `explicit`; itself where nothing is carried or measured so."""
        feels = any(len(s.sensed_dofs) for s in self.segments)
        presses = any(s.dynamics.forces.pressing for s in self.segments)
        if self.explicit or not (self.remembers or feels or presses):
            return self
        other = replace(self, explicit=True)
        vars(other)["segments"] = self.segments
        return other

    @property
    def nq(self) -> int:
        """Number of the shared parameters q."""
        return len(self.parameters.free)

    @property
    def nphi(self) -> int:
        """Number of the nuisance parameters φ, all together."""
        return int(np.concatenate(self.places).max(initial=self.nq - 1)) + 1 - self.nq

    @property
    def variables(self) -> int:
        """Length of z."""
        return self.of_phi.stop + self.added()

    @property
    def constraints(self) -> int:
        """Length of g."""
        return self.segments[-1].after.row + self.added()

    def added(self, called: str | None = None) -> int:
        """Number of the variables of what is carried, or is called so, and of their equations."""
        return sum(each.count for each in self.carried if called in (None, each.called))

    @property
    def carried_nonzeros(self) -> tuple[int, int]:
        """Entries that Jacobian and Hessian have for what is carried."""
        both = [each.nonzeros for each in self.carried]
        return sum(each for each, _ in both), sum(each for _, each in both)

    @property
    def measurements(self) -> int:
        """Scalar measurements that are present."""
        return sum(
            int(reading.components.sum())
            for segment in self.segments
            for reading in segment.readings
        )

    @property
    def loss_scale(self) -> float:
        """What the objective has the loss multiplied by."""
        return 1.0 / max(1, self.measurements)

    def pack(self, p: Array, positions: Sequence[Array]) -> Array:
        """Variables z from p = (q, φ_1, φ_2, …) and each experiment's positions (N, 3n) [m]."""
        parts = self.parts_at(p, positions) if self.carried else []
        following = [each.following(parts[each.number]) for each in self.carried]
        return np.concatenate([self._packed(p, positions), *following])

    def _packed(self, p: Array, positions: Sequence[Array]) -> Array:
        """Without what is carried."""
        pairs = zip(self.segments, positions, strict=True)
        scaled = [np.ravel(x) / segment.length_m for segment, x in pairs]
        return np.concatenate([p[: self.nq], *scaled, p[self.nq :]])

    def unpack(self, z: Array) -> tuple[Array, list[Array]]:
        """Parameters p and positions, as `pack` takes them."""
        return self.parameters_of(z), [
            z[segment.columns].reshape(segment.grid_rows, segment.dofs) * segment.length_m
            for segment in self.segments
        ]

    def parameters_of(self, z: Array) -> Array:
        """All estimated parameters p = (q, φ_1, φ_2, …)."""
        return np.concatenate([z[: self.nq], z[self.of_phi]])

    @property
    def of_phi(self) -> slice:
        """The nuisance parameters in z."""
        first = self.segments[-1].after.x
        return slice(first, first + self.nphi)

    def parts(self, z: Array) -> list[Part]:
        """Every experiment at z."""
        parts = self.parts_at(*self.unpack(z))
        for each in self.carried:
            parts[each.number] = each.given(parts[each.number], z)
        return parts

    @cached_property
    def places(self) -> list[Index]:
        """Where the (q, φ) of each experiment are in p."""
        return [segment.places for segment in self.segments]

    @property
    def threads(self) -> int:
        """How many its bodies may use."""
        return min(segment.body.threads for segment in self.segments)

    def parts_at(self, p: Array, positions: Sequence[Array]) -> list[Part]:
        """Every experiment at p and positions, or their first rows."""
        return [
            Part(segment, p[: self.nq], p[segment.local.places], x)
            for segment, x in zip(self.segments, positions, strict=True)
        ]

    @property
    def names(self) -> tuple[str, ...]:
        """What each entry of p is: the parameters' names, then the nuisance parameters."""
        found = [item.name for item in self.parameters.free] + [""] * self.nphi
        for segment in self.segments:
            for place, name in zip(segment.local.places, segment.nuisance.names, strict=True):
                found[place] = name
        return tuple(found)

    def prior(self, p: Array) -> tuple[Array, Array]:
        """Residuals of the priors at p, and their slopes; φ counts in its deviations."""
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
            here = segment.local.places - self.nq
            least, most = segment.nuisance.limits(segment.chart.samples)
            low[here], high[here] = np.maximum(low[here], least), np.minimum(high[here], most)
        return np.concatenate([lower, low]), np.concatenate([upper, high])

    # Where recordings are read ----------------------------------------------------------------

    def following(self, p: Array, positions: Sequence[Array] = ()) -> tuple[Collocation, Array]:
        """The problem read where the estimates p are, and p in it; itself if they left no chart.

        Positions are the first rows that depth cameras need, none where there are none.
        """
        rows = positions or [np.zeros((0, segment.dofs)) for segment in self.segments]
        pairs = zip(self.segments, rows, strict=True)
        found = [s.following(p[s.local.places], x) for s, x in pairs]
        if all(chart is s.chart for (chart, _), s in zip(found, self.segments, strict=True)):
            return self, p
        return self._read_in([chart for chart, _ in found], p, [phi for _, phi in found])

    def placed(self, p: Array, positions: Sequence[Array]) -> tuple[Collocation, Array]:
        """The problem with unknown places where first samples lie on the first rows of positions.

        That is where a solve starts; p has these places.
        """
        if not any(segment.rows_to_place for segment in self.segments):
            return self, p
        found = [part.segment.placed(part.phi, part.x) for part in self.parts_at(p, positions)]
        return self._read_in([chart for chart, _ in found], p, [phi for _, phi in found])

    def placed_at(self, places_m: Sequence[Array]) -> Collocation:
        """The problem read about places (M, 3) of each experiment's markers."""
        charts = [s.chart.about(m) for s, m in zip(self.segments, places_m, strict=True)]
        segments = [s.with_chart(c) for s, c in zip(self.segments, charts, strict=True)]
        return self._read_in(charts, self.guess_p, [s.guess_phi for s in segments])[0]

    def _read_in(
        self, charts: Sequence[Chart], p: Array, phis: Sequence[Array]
    ) -> tuple[Collocation, Array]:
        other, moved = copy(self), self._put_together(p[: self.nq], phis)
        segments = _read_alike(self.segments, charts)
        by_name = {s.experiment.name: s.chart for s in segments}
        vars(other).update(charts=by_name, segments=segments)
        for stale in ("_hessian", "hessian_diagonals", "carried"):
            vars(other).pop(stale, None)
        return other, moved

    @property
    def guess_p(self) -> Array:
        """The guess of p; φ is zero, or where the charts are."""
        return self._put_together(self.parameters.guess_q, [s.guess_phi for s in self.segments])

    def _put_together(self, q: Array, phis: Sequence[Array]) -> Array:
        """P of the φ of each experiment; shared ones as the first has them."""
        p = np.concatenate([q, np.zeros(self.nphi)])
        for segment, phi in reversed([*zip(self.segments, phis, strict=True)]):
            p[segment.local.places] = phi
        return p

    @property
    def reach_p(self) -> Array:
        """What a trust region of one allows each entry of p."""
        return self._put_together(np.ones(self.nq), [s.nuisance.reach for s in self.segments])

    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of z; equal for what is given."""
        lower, upper = self.bounds_p
        lows, highs = zip(*(segment.bounds() for segment in self.segments), strict=True)
        least = [np.full(each.count, each.least) for each in self.carried]
        return (
            np.concatenate([self._packed(lower, lows), *least]),
            np.concatenate([self._packed(upper, highs), np.full(self.added(), np.inf)]),
        )

    # Objective --------------------------------------------------------------------------------

    def objective(self, z: Array) -> float:
        """L divided by the number of measurements."""
        residuals, _ = self.prior(self.parameters_of(z))
        loss = sum(part.loss for part in self.parts(z))
        return self.loss_scale * float(residuals @ residuals + loss)

    def gradient(self, z: Array) -> Array:
        """∂objective/∂z."""
        parts = self.parts(z)
        residuals, slopes = self.prior(self.parameters_of(z))
        by_p, by_x = 2 * residuals * slopes, []
        for part in parts:
            of_x, of_p = part.gradient()
            by_x.append(of_x.ravel() * part.segment.length_m)
            by_p[part.segment.places] += of_p
        further = [each.gradient(parts[each.number]) for each in self.carried]
        return self.loss_scale * np.concatenate([by_p[: self.nq], *by_x, by_p[self.nq :], *further])

    # Constraints ------------------------------------------------------------------------------

    def constraint_values(self, z: Array) -> Array:
        """g, scaled."""
        parts = self.parts(z)
        rows = [part.segment.constraint_values(part.x, part.setting, part.along) for part in parts]
        further = [each.values(parts[each.number], z) for each in self.carried]
        return np.concatenate([*rows, *further])

    @property
    def jacobian_structure(self) -> tuple[Index, Index]:
        """Column pointers and row indices of ∂g/∂z by compressed columns."""
        return self._jacobian.structure

    @cached_property
    def _jacobian(self) -> OffBand:
        """The columns of q and x, of each experiment those of its φ, and what is carried."""
        own = self.segments[-1].after.row
        indptr, indices = [np.arange(self.nq + 1) * own], [np.tile(np.arange(own), self.nq)]
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
        """Values of ∂g/∂z in the order of `jacobian_structure`."""
        return self.constraints_and_jacobian(z, out)[1]

    def constraints_and_jacobian(self, z: Array, out: Array | None = None) -> tuple[Array, Array]:
        """Constraints g and the values of ∂g/∂z, from one evaluation of the elements."""
        parts, height = self.parts(z), self.segments[-1].after.row
        count = self.nq * height + sum(s.jacobian.nnz for s in self.segments)
        values, own = self._jacobian.values(out, count)
        columns = own[: self.nq * height].reshape(self.nq, height)
        rows, further, used = np.empty(height), [], columns.size
        for part in parts:
            segment = part.segment
            here = own[used : used + segment.jacobian.nnz]
            found, by_p = segment.constraints_and_jacobian(part.x, part.setting, part.forces, here)
            rows[segment.rows], columns[:, segment.rows] = found, by_p[:, : self.nq].T
            further.append(by_p[:, self.nq :].T.ravel())
            used += segment.jacobian.nnz
        added = [each.jacobian_values(parts[each.number], z) for each in self.carried]
        self._jacobian.fill(values, own, further + [entries for _, entries in added])
        return np.concatenate([rows, *(equations for equations, _ in added)]), values

    def jacobian(self, z: Array) -> sp.csc_array:
        """∂g/∂z as a sparse matrix; of bodies with memory, at the memory as it is."""
        indptr, indices = self.jacobian_structure
        shape = (self.constraints, self.variables)
        return sp.csc_array((self.jacobian_values(z), indices, indptr), shape=shape)

    @property
    def remembers(self) -> bool:
        """Whether something is carried that is not in z: ∂g/∂z has more than `jacobian` holds."""
        return not self.explicit and any(segment.carries for segment in self.segments)

    def pulled_back(self, z: Array, multipliers: Array) -> Array:
        """(∂g/∂z)ᵀ multipliers, through what is carried too."""
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
        """The same of the upper triangle of ∇²_z (w L + yᵀ g)."""
        return self._hessian.structure

    @cached_property
    def _hessian(self) -> OffBand:
        """The columns of q, those of x as the motion has them, and what else experiments have."""
        counts, further = np.arange(self.nq + 1), []
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
        of_q, of_x = np.cumsum(np.arange(1, self.nq + 1)) - 1, []
        used = self.nq * (self.nq + 1) // 2
        for segment in self.segments:
            of_x.append(used + segment.hessian_diagonal)
            used += segment.hessian.nnz
        return of_q, self._hessian.places_of(np.concatenate(of_x))

    def hessian_values(
        self, z: Array, loss_weight: float, multipliers: Array | None, out: Array | None = None
    ) -> Array:
        """Values of ∇²_z (loss_weight · objective + multipliers · g), upper triangle.

        Without multipliers Gauss–Newton's: readings and constraints count as linear. That is
        convex, which the loss itself is not where residuals are large: places and motions multiply.
        """
        bent = multipliers is not None
        parts = [replace(part, bent=bent) for part in self.parts(z)]
        multipliers = np.zeros(self.constraints) if multipliers is None else multipliers
        used = self.nq * (self.nq + 1) // 2
        count = used + sum(segment.hessian.nnz for segment in self.segments)
        values, own = self._hessian.values(out, count)
        by_q, further, weights = np.zeros((self.nq, self.nq)), list[Array](), list[RowWeights]()
        weight = loss_weight * self.loss_scale
        for number, part in enumerate(parts):
            segment = part.segment
            here = own[used : used + segment.hessian.nnz]
            mine = [each for each in self.carried if each.number == number]
            of_rows = sum((each.row_weights(multipliers) for each in mine), start=0.0)
            weights.append(segment.weights(multipliers[segment.rows], of_rows))
            carried = [each.weighed(part, multipliers) for each in mine if each.history is not None]
            at = part.x, part.phi, part.setting, weights[number], weight
            found, more = segment.hessian_values(*at, here, carried, bent)
            by_q, further, used = by_q + found, further + more, used + len(here)
        for each in self.carried:
            at = parts[each.number], z, weight, multipliers, weights[each.number]
            further.append(each.hessian_values(*at))
        _, slopes = self.parameters.prior(parts[0].q)
        by_q += np.diag(2 * weight * slopes**2)
        rows, columns = np.triu_indices(self.nq)
        order = np.lexsort((rows, columns))
        own[: len(rows)] = by_q[rows[order], columns[order]]
        self._hessian.fill(values, own, further)
        return values

    def kkt_residual(self, z: Array, multipliers: Array) -> float:
        """Largest violation of the first-order conditions of the whole NLP, in its scaling.

        Stationarity of objective + multipliers · g in every variable that is not given; a
        parameter at a bound may only push against it. And feasibility.
        """
        rows = self.constraint_values(z)
        slope = self.gradient(z) + self.pulled_back(z, multipliers)
        lower, upper = self.bounds()
        slope[lower == upper] = 0
        near = 1e-6
        for part in (slice(self.nq), self.of_phi):
            at_lower, at_upper = (z - lower)[part] < near, (upper - z)[part] < near
            slope[part][at_lower] = np.minimum(slope[part][at_lower], 0)
            slope[part][at_upper] = np.maximum(slope[part][at_upper], 0)
        return float(max(np.abs(slope).max(initial=0.0), np.abs(rows).max(initial=0.0)))

    def hessian(self, z: Array, loss_weight: float, multipliers: Array | None) -> sp.csc_array:
        """∇²_z (loss_weight · objective + multipliers · g), both triangles, as a sparse matrix."""
        indptr, indices = self.hessian_structure
        values = self.hessian_values(z, loss_weight, multipliers)
        upper = sp.csc_array((values, indices, indptr), shape=(len(z), len(z)))
        return sp.csc_array(upper + sp.triu(upper, 1).T)

    # Reading a point --------------------------------------------------------------------------

    def violations_n(self, z: Array) -> list[Array]:
        """(N, free dofs) residual of the equations of motion of each experiment [N]."""
        return [part.residual_n for part in self.parts(z)]

    def largest_force_n(self, z: Array) -> float:
        """Largest internal or external force on a dof [N], the yardstick of violations."""
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
        """The worst equations of motion in newtons, largest first."""
        found = []
        for part in self.parts(z):
            segment, residual = part.segment, part.residual_n
            flat = np.argsort(-np.abs(residual), axis=None)[:count]
            for t, place in zip(*np.unravel_index(flat, residual.shape), strict=True):
                node, axis = divmod(int(segment.free_dofs[place]), 3)
                found.append(
                    Violation(
                        segment.experiment.name,
                        float(segment.dynamics.t_s[t]),
                        node,
                        "xyz"[axis],
                        float(residual[t, place]),
                    )
                )
        return sorted(found, key=lambda violation: -abs(violation.newtons))[:count]

    def rms_m(self, z: Array) -> float:
        """Root mean square distance of markers from their measurements."""
        squares = samples = 0.0
        for part in self.parts(z):
            found = part.segment.markers.squared_distances_m2(part.x, part.phi)
            squares, samples = squares + float(found.sum()), samples + len(found)
        return float(np.sqrt(squares / max(1.0, samples)))

    def values(self, z: Array) -> dict[str, float]:
        """The parameters of z by the user's names."""
        return self.parameters.values(z[: self.nq])


def _read_alike(segments: Sequence[Segment], charts: Sequence[Chart]) -> tuple[Segment, ...]:
    """The segments read in charts, of which those of shared φ are the same."""
    parts = zip(segments, charts, strict=True)
    same = shared_charts((s.local, s.nuisance, chart) for s, chart in parts)
    return tuple(s.with_chart(chart) for s, chart in zip(segments, same, strict=True))
