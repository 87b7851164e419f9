"""The collocation NLP: all node positions at all timesteps beside the parameters.

    minimise   L(q, x, φ) = Σ ρ(‖(ŷ − y(x, φ)) / σ‖) + priors(q) + Σ φ²
    subject to c_{e,t,i}(x, θ(q), φ) = 0 for free dofs, x_{e,t,i} = u_t x̄_i for grasped ones.

Variables z, in this order:

=================  =========================================================================
q                  of each estimated parameter, in the order of `Parameters.free`
x_{e,t,i} / ℓ_e    positions: experiment e, grid time t, dof i = 3·node + axis, the last
                   index fastest; ℓ_e is the mean edge length
φ_e                nuisance parameters of experiment e, see `nlp.nuisance`; experiment by
                   experiment, what several share with the first of them, see `nlp.sharing`
=================  =========================================================================

The memory of bodies follows from them, or is among them, see `nlp.explicit`.

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
from ..experiment.experiment import Experiment
from ..fem.body import Linearisation
from .channel import Motion
from .charts import Chart
from .entries import Entries
from .parameters import Parameters
from .schemes import Scheme
from .segment import First, Segment, Weights
from .sensing import Sensing
from .setting import Setting
from .sharing import locals_of, shared_charts


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
class Part:
    """One experiment at a point of the NLP.

    Attributes
    ----------
    segment : Segment
    q : (nq,) shared parameters
    phi : (k,) its nuisance parameters
    x : (N, 3n) positions [m], or its first rows
    brought : (N, …) or None
        What the evaluations bring from the past, where it is given; see `Dynamics`.
    given : mapping
        Of readings, by their numbers, what they look at where that does not follow from x.
    bent : bool
        Whether readings are, or taken as linear in second derivatives.
    """

    segment: Segment
    q: Array
    phi: Array
    x: Array
    brought: Array | None = None
    given: Mapping[int, Array] = field(default_factory=dict)
    bent: bool = True

    @cached_property
    def setting(self) -> Setting:
        """The physical parameters."""
        found = self.segment.setting(self.q, self.phi)
        if self.brought is None:
            return found
        return replace(found, dynamics=replace(found.dynamics, brought=self.brought))

    @cached_property
    def sensing(self) -> Sensing:
        """What is looked at."""
        return Sensing(self.segment, self.setting, self.phi)

    @cached_property
    def motion(self) -> Motion:
        """What channels look at."""
        return self.sensing.motion(self.x)

    @cached_property
    def looked(self) -> list[Array]:
        """Of each reading what it looks at (n, e, 3)."""
        return [
            self.given[k] if k in self.given else reading.channel.values(self.motion, self.phi)
            for k, reading in enumerate(self.segment.readings)
        ]

    @property
    def loss(self) -> float:
        """Of all readings, without priors."""
        pairs = zip(self.segment.readings, self.looked, strict=True)
        return sum(reading.loss(looked, self.phi) for reading, looked in pairs)

    @cached_property
    def loss_slopes(self) -> list[tuple[Array, Array]]:
        """Of each reading ∂loss by what it looks at (n, e, 3), and by its φ (k,)."""
        pairs = zip(self.segment.readings, self.looked, strict=True)
        return [reading.loss_slopes(looked, self.phi) for reading, looked in pairs]

    def gradient(self) -> tuple[Array, Array]:
        """∂loss/∂x (N, 3n) and ∂loss/∂(q, φ) (nq + k,), at what is given."""
        nq, phi = self.segment.nq, self.phi
        by_x, by_p, by_reaction = np.zeros_like(self.x), np.zeros(nq + len(phi)), None
        pairs = zip(self.segment.readings, self.loss_slopes, strict=True)
        for k, (reading, (by_looked, by_phi)) in enumerate(pairs):
            by_p[nq:] += by_phi
            if k not in self.given:
                pulled = reading.channel.pulled(self.motion, phi, by_looked)
                by_x, by_p[nq:] = by_x + pulled.by_x, by_p[nq:] + pulled.by_phi
                if pulled.by_reaction is not None:
                    by_reaction = pulled.by_reaction + (0.0 if by_reaction is None else by_reaction)
        if by_reaction is not None:
            through_x, through_p = self.sensing.pulled(self.x, by_reaction)
            by_x += through_x
            by_p[self.segment.moving] += through_p
        return by_x, by_p

    @cached_property
    def forces(self) -> Linearisation:
        """Those of the evaluations with their slopes, valid until others are formed."""
        rows = self.segment.linearisation_rows
        return self.setting.dynamics.linearise(self.x, self.setting.theta, rows)

    @property
    def residual_n(self) -> Array:
        """(N, free dofs) violation of the equations of motion in newtons."""
        return self.segment.residual_n(self.x, self.setting)


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
        return self.segments[-1].after.x + self.nphi

    @property
    def constraints(self) -> int:
        """Length of g."""
        return self.segments[-1].after.row

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
        parts = self.parts_at(p, positions)
        scaled = [np.ravel(part.x) / part.segment.length_m for part in parts]
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
        return self.parts_at(*self.unpack(z))

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

    def following(self, p: Array) -> tuple[Collocation, Array]:
        """The problem read where the estimates p are, and p in it; itself if they left no chart."""
        found = [s.following(p[s.local.places]) for s in self.segments]
        if all(chart is s.chart for (chart, _), s in zip(found, self.segments, strict=True)):
            return self, p
        return self._read_in([chart for chart, _ in found], p, [phi for _, phi in found])

    def placed(self, p: Array, positions: Sequence[Array]) -> tuple[Collocation, Array]:
        """The problem with unknown places where first samples lie on the first rows of positions.

        That is where a solve starts; p has these places.
        """
        if all(segment.experiment.markers.located.all() for segment in self.segments):
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
        for stale in ("_hessian", "hessian_diagonals"):
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
        return self.pack(lower, lows), self.pack(upper, highs)

    # Objective --------------------------------------------------------------------------------

    def objective(self, z: Array) -> float:
        """L divided by the number of measurements."""
        residuals, _ = self.prior(self.parameters_of(z))
        loss = sum(part.loss for part in self.parts(z))
        return self.loss_scale * float(residuals @ residuals + loss)

    def gradient(self, z: Array) -> Array:
        """∂objective/∂z."""
        return self.gradient_of(self.parts(z), self.parameters_of(z))

    def gradient_of(self, parts: Sequence[Part], p: Array) -> Array:
        """The same where the experiments are."""
        residuals, slopes = self.prior(p)
        by_p, by_x = 2 * residuals * slopes, []
        for part in parts:
            of_x, of_p = part.gradient()
            by_x.append(of_x.ravel() * part.segment.length_m)
            by_p[part.segment.places] += of_p
        return self.loss_scale * np.concatenate([by_p[: self.nq], *by_x, by_p[self.nq :]])

    # Constraints ------------------------------------------------------------------------------

    def constraint_values(self, z: Array) -> Array:
        """g, scaled."""
        return np.concatenate(
            [part.segment.constraint_values(part.x, part.setting) for part in self.parts(z)]
        )

    @property
    def jacobian_structure(self) -> tuple[Index, Index]:
        """Column pointers and row indices of ∂g/∂z by compressed columns."""
        return self._jacobian.structure

    @cached_property
    def _jacobian(self) -> Entries:
        """The columns of q and x, and of each experiment those of its φ."""
        dense = np.arange(self.nq + 1) * self.constraints
        indptr, indices = [dense], [np.tile(np.arange(self.constraints), self.nq)]
        of_phi = []
        for segment in self.segments:
            indptr.append(indptr[-1][-1] + segment.jacobian.indptr[1:])
            indices.append(segment.first.row + segment.jacobian.indices)
            moving = segment.local.places[segment.nuisance.moving] - self.nq
            rows = segment.first.row + np.arange(segment.constraints)
            columns = self.of_phi.start + np.repeat(moving, len(rows))
            of_phi.append((np.tile(rows, len(moving)), columns))
        structure = np.concatenate(indptr), np.concatenate(indices)
        return Entries.of(structure, (self.constraints, self.variables), of_phi)

    def jacobian_values(self, z: Array, out: Array | None = None) -> Array:
        """Values of ∂g/∂z in the order of `jacobian_structure`."""
        return self.constraints_and_jacobian(z, out)[1]

    def constraints_and_jacobian(self, z: Array, out: Array | None = None) -> tuple[Array, Array]:
        """Constraints g and the values of ∂g/∂z, from one evaluation of the elements."""
        return self.linearised(self.parts(z), out)

    def linearised(self, parts: Sequence[Part], out: Array | None = None) -> tuple[Array, Array]:
        """The same where the experiments are, at the memory as it is."""
        count = self.nq * self.constraints + sum(s.jacobian.nnz for s in self.segments)
        values, own = self._jacobian.values(out, count)
        columns = own[: self.nq * self.constraints].reshape(self.nq, self.constraints)
        rows, by_phi = np.empty(self.constraints), []
        used = columns.size
        for part in parts:
            segment = part.segment
            here = own[used : used + segment.jacobian.nnz]
            found, by_p = segment.constraints_and_jacobian(part.x, part.setting, part.forces, here)
            rows[segment.rows], columns[:, segment.rows] = found, by_p[:, : self.nq].T
            by_phi.append(by_p[:, self.nq :].T.ravel())
            used += segment.jacobian.nnz
        self._jacobian.fill(values, own, by_phi)
        return rows, values

    def jacobian(self, z: Array) -> sp.csc_array:
        """∂g/∂z as a sparse matrix; of bodies with memory, at the memory as it is."""
        indptr, indices = self.jacobian_structure
        shape = (self.constraints, self.variables)
        return sp.csc_array((self.jacobian_values(z), indices, indptr), shape=shape)

    @property
    def remembers(self) -> bool:
        """Whether any body has a memory: then ∂g/∂z has more than `jacobian` holds."""
        return any(segment.body.remembers for segment in self.segments)

    def pulled_back(self, z: Array, multipliers: Array) -> Array:
        """(∂g/∂z)ᵀ multipliers, through the memory of bodies too."""
        slope = self.jacobian(z).T @ multipliers
        for part in self.parts(z) if self.remembers else ():
            segment = part.segment
            of_rows = multipliers[segment.rows]
            by_x, by_q = segment.through_memory(part.x, part.setting, of_rows)
            slope[segment.columns] += by_x.ravel()
            slope[: self.nq] += by_q
        return slope

    # Lagrangian -------------------------------------------------------------------------------

    @property
    def hessian_structure(self) -> tuple[Index, Index]:
        """The same of the upper triangle of ∇²_z (w L + yᵀ g)."""
        return self._hessian.structure

    @cached_property
    def _hessian(self) -> Entries:
        """The columns of q, those of x as the motion has them, and what else experiments have."""
        counts, further = np.arange(self.nq + 1), []
        indptr = [counts * (counts + 1) // 2]
        indices = [np.concatenate([np.arange(k) for k in counts])]
        for segment in self.segments:
            indptr.append(indptr[-1][-1] + segment.hessian.indptr[1:])
            shift = np.where(segment.hessian.indices < self.nq, 0, segment.first.x - self.nq)
            indices.append(segment.hessian.indices + shift)
            further += segment.further_entries(self.of_phi.start)
        structure = np.concatenate(indptr), np.concatenate(indices)
        return Entries.of(structure, (self.variables, self.variables), further)

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
        parts, multipliers = self.bending(z, multipliers)
        weights = [segment.weights(multipliers[segment.rows]) for segment in self.segments]
        return self.curved(parts, loss_weight, weights, out)

    def bending(self, z: Array, multipliers: Array | None) -> tuple[list[Part], Array]:
        """The experiments and multipliers of `hessian_values`."""
        bent = multipliers is not None
        parts = [replace(part, bent=bent) for part in self.parts(z)]
        return parts, multipliers if multipliers is not None else np.zeros(self.constraints)

    def curved(
        self,
        parts: Sequence[Part],
        loss_weight: float,
        weights: Sequence[Weights],
        out: Array | None = None,
        memory_weights: Mapping[int, Sequence[Array]] | None = None,
    ) -> Array:
        """The same where the experiments are, at the memory as it is.

        With weights of the memory's equations, by the number of the experiment, see `Segment`.
        """
        used = self.nq * (self.nq + 1) // 2
        count = used + sum(segment.hessian.nnz for segment in self.segments)
        values, own = self._hessian.values(out, count)
        by_q, further = np.zeros((self.nq, self.nq)), list[Array]()
        weight = loss_weight * self.loss_scale
        for number, part in enumerate(parts):
            segment = part.segment
            here = own[used : used + segment.hessian.nnz]
            of_memory = (memory_weights or {}).get(number, ())
            at = part.x, part.phi, part.setting, weights[number], weight
            found, more = segment.hessian_values(*at, here, of_memory, part.bent)
            by_q, further, used = by_q + found, further + more, used + len(here)
        _, slopes = self.parameters.prior(parts[0].q)
        by_q += np.diag(2 * weight * slopes**2)
        rows, columns = np.triu_indices(self.nq)
        order = np.lexsort((rows, columns))
        own[: len(rows)] = by_q[rows[order], columns[order]]
        self._hessian.fill(values, own, further)
        return values

    def hessian_phi(self, number: int) -> Index:
        """Places in the values of the Hessian of an experiment's φ by φ, `np.triu_indices`."""
        return self._hessian.places[4 * number + 3]

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
            total = dynamics.force(part.x, part.setting.theta)
            external = dynamics.evaluated.external_n(part.setting.theta)
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
