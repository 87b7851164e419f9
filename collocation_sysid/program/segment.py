"""One experiment's share of the collocation NLP: its rows, columns, and derivative values.

In scaled quantities: variables x / `length_m`, dynamics rows c / `force_n`, grasp rows
(x − u x̄) / `length_m`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array, Index
from ..fem.body import Body, Curvature, Linearisation
from ..fem.pattern import SymmetricPattern
from ..model.dynamics import Dynamics, StencilRow
from ..model.grasp_constraint import Grasping, Held
from ..model.histories import AnyHistory
from ..model.inputs import Inputs, inputs_of, with_inputs
from ..model.nuisance import NuisanceMap
from ..model.parameters import Parameters, ThetaMap
from ..model.schemes import Scheme
from ..model.setting import Setting
from ..recording.experiment import Experiment
from ..recording.nuisance import TIME
from .block_band import BandBlock, BlockBand, BlockTerm, adding_skew, skew_values
from .charts import Chart
from .depth import DepthReading
from .gauge import GaugeReading, gauge_readings
from .local_loss import LocalLoss
from .markers import MarkerReading
from .motion_rows import MotionRows, ahead
from .outline_reading import OutlineReading
from .reading import Reading
from .sharing import Local
from .view import View
from .wrench import WrenchReading, wrench_readings
from .wrench_channel import Grid, sensed_dofs

T = TypeVar("T", bound=np.generic)
# Of what two stencils (p, q) of an evaluation make of its two matrices.
Factors = Callable[[Array, Array, Array, Array], tuple[Array, Array]]
Weighed = tuple[AnyHistory, Array]

CHARTED = ("markers", "depths", "outlines", "readings", "local_loss", "_loss_scale")


@dataclass(frozen=True)
class First:
    """Where a segment begins: its x in z, and its rows in g."""

    x: int
    row: int


@dataclass(frozen=True, eq=False)
class RowWeights:
    """What each row counts in a Lagrangian.

    Attributes
    ----------
    multipliers : (constraints,) of the scaled rows
    rows : (N, 3n) of c in newtons
    forces : (N, 3n) of the forces at the evaluations
    """

    multipliers: Array
    rows: Array
    forces: Array


@dataclass(frozen=True, eq=False)
class Segment:
    """The variables x_{t,i} and constraints of one experiment.

    Attributes
    ----------
    experiment : Experiment
    parameters : Parameters
        At their guess the constraints are scaled.
    scheme, substeps, huber
        See `Collocation`.
    explicit_grasps : bool
        Grasped nodes get rows of their own instead of bounds. Those that are held only for a
        while always do, and so do all where the body may be off in its grasps.
    first : First
    local : Local
        Where its φ are in p = (q, φ_1, φ_2, …).
    chart : Chart
        Where the recording is read.
    """

    experiment: Experiment
    parameters: Parameters
    scheme: str | Scheme
    substeps: int
    explicit_grasps: bool
    huber: float | None
    first: First
    local: Local
    chart: Chart

    def __getstate__(self) -> dict[str, Any]:
        # What follows from the fields is found anew where it is needed.
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @property
    def body(self) -> Body:
        """What moves."""
        return self.experiment.body

    @property
    def pattern(self) -> SymmetricPattern:
        """Sparsity of the blocks."""
        return self.experiment.pattern

    @cached_property
    def constants(self) -> ThetaMap:
        """The body's constants as functions of q."""
        return ThetaMap(self.parameters, self.body)

    @cached_property
    def dynamics(self) -> Dynamics:
        """The equations of motion with inputs as stated."""
        return with_inputs(Dynamics.of(self.experiment, self.scheme, self.substeps), self.nuisance)

    @cached_property
    def nuisance(self) -> NuisanceMap:
        """The experiment's φ."""
        return NuisanceMap.of(self.experiment, self.local.pivot_m)

    @cached_property
    def markers(self) -> MarkerReading:
        """What its markers read."""
        return MarkerReading.of(
            self.experiment.markers,
            np.arange(len(self.experiment.t_s)) * self.substeps,
            self.nuisance,
            self.chart,
            self.huber,
            from_rest=not self.dynamics.start_velocity_m_s.any(),
        )

    @cached_property
    def sensors(self) -> tuple[WrenchReading, ...]:
        """Of the grasps whose wrench is measured."""
        return wrench_readings(self.experiment, Grid.of(self.dynamics), self.nuisance, self.huber)

    @cached_property
    def gauges(self) -> tuple[GaugeReading, ...]:
        """Those of one's own."""
        grid = Grid.of(self.dynamics)
        return gauge_readings(self.experiment, grid.t_s, grid, self.nuisance, self.huber)

    @cached_property
    def depths(self) -> tuple[DepthReading, ...]:
        """Those of depth cameras."""
        how = self.dynamics.t_s, self.nuisance, self.huber
        seen = zip(self.chart.sightings, self.views, strict=True)
        return tuple(DepthReading.of(replace(each, view=view), *how) for each, view in seen)

    @cached_property
    def outlines(self) -> tuple[OutlineReading, ...]:
        """Those of depth cameras with images, in the order of the cameras."""
        seen = (depth for depth in self.depths if len(depth.sighting.view.depth.images_m))
        return tuple(OutlineReading.from_depth(depth) for depth in seen)

    @cached_property
    def views(self) -> tuple[View, ...]:
        """Of depth cameras."""
        numbers = range(len(self.experiment.depths))
        return tuple(View.of(self.experiment, k, self.nuisance) for k in numbers)

    @cached_property
    def readings(self) -> tuple[Reading, ...]:
        """All that is measured, the markers first."""
        return self.markers, *self.sensors, *self.gauges, *self.depths, *self.outlines

    @cached_property
    def local_loss(self) -> LocalLoss:
        """Second derivatives of the loss by x and φ, where it has few."""
        pairs = ((reading, reading.channel.local) for reading in self.readings)
        local = tuple((reading, points) for reading, points in pairs if points and points.each)
        return LocalLoss(local, self.variables, self.nuisance.size, self.dofs)

    @cached_property
    def sensed_dofs(self) -> Index:
        """Dofs of the nodes of these grasps."""
        return sensed_dofs(self.experiment)

    def with_chart(self, chart: Chart) -> Segment:
        """The same, read elsewhere."""
        other = replace(self, chart=chart)
        # Nothing but how the markers are read depends on the chart.
        kept = {k: v for k, v in vars(self).items() if k not in CHARTED}
        vars(other).update(kept | {"chart": chart})
        return other

    def following(self, phi: Array, x: Array) -> tuple[Chart, Array]:
        """A chart where the estimates are, and φ in it; those given where they have not left.

        Depth cameras look anew at the first rows x (rows, 3n).
        """
        nuisance, places = self.nuisance, self.markers.place_places
        late = phi[nuisance.places(TIME)] * nuisance.scales[nuisance.places(TIME)]
        shift = float(late.sum()) / self.experiment.timestep_s
        chart, of_places = self.chart.following(np.append(phi, 0.0)[places], shift)
        seen = [d.sighting.following(d.shapes(x, phi), phi) for d in self.depths]
        if any(s is not d.sighting for s, d in zip(seen, self.depths, strict=True)):
            chart = replace(chart, sightings=tuple(seen))
        return chart, self._with_places(phi, of_places)

    def placed(self, phi: Array, x: Array) -> tuple[Chart, Array]:
        """The chart, and φ in it, with unknown places on the body's first rows x (rows, 3n).

        Depth cameras are aligned to the first shape that they see.
        """
        phi = phi.copy()
        seen = tuple(depth.aligned(x, phi) for depth in self.depths)
        for each in seen:
            phi[each.view.own] = each.view.phi(each.start)[each.view.own]
        chart, phi = self._marked(phi, x)
        return (replace(chart, sightings=seen) if seen else chart), phi

    def _marked(self, phi: Array, x: Array) -> tuple[Chart, Array]:
        """The same of markers alone."""
        markers, rows = self.experiment.markers, self.markers.grid_rows
        if markers.located.all():
            return self.chart, phi
        points_m, _ = markers.first_samples
        first = rows[markers.present.argmax(axis=0)]
        places_m = self.places_m(phi)
        unknown = ~markers.located & (first < len(x)) & markers.present.any(axis=0)
        for row in np.unique(first[unknown]):
            here = np.flatnonzero(unknown & (first == row))
            places_m[here] = self.chart.at_markers(x[row].reshape(-1, 3), points_m[here])
        if not unknown.any():
            return self.chart, phi
        chart = self.chart.about(places_m)
        return chart, self._with_places(phi, chart.centre)

    @property
    def rows_to_place(self) -> int:
        """First rows of x that `placed` reads; none where all places are known."""
        unknown = ~self.experiment.markers.located
        first = self.experiment.markers.present[:, unknown].argmax(axis=0)
        rows = [int(self.markers.grid_rows[first].max())] if len(first) else []
        return 1 + max(rows + [depth.first_row for depth in self.depths], default=-1)

    @property
    def rows_to_follow(self) -> int:
        """First rows of x that `following` reads."""
        return self.grid_rows if self.depths else 0

    def places_m(self, phi: Array) -> Array:
        """(M, 3) places of the markers on the undeformed body."""
        return self.chart.places_m(np.append(phi, 0.0)[self.markers.place_places])

    @property
    def guess_phi(self) -> Array:
        """(k,) φ in the middle of the chart."""
        phi, late = np.zeros(self.nuisance.size), self.nuisance.places(TIME)
        phi[late] = self.chart.samples * self.experiment.timestep_s / self.nuisance.scales[late]
        for depth in self.depths:
            phi += depth.sighting.view.phi(depth.sighting.start)
        return self._with_places(phi, self.chart.centre)

    def _with_places(self, phi: Array, of_places: Array) -> Array:
        moved, here = phi.copy(), self.chart.estimated
        moved[self.markers.place_places[here]] = of_places[here]
        return moved

    # Sizes and places -------------------------------------------------------------------------

    @property
    def nq(self) -> int:
        """Number of q."""
        return len(self.parameters.free)

    @property
    def dofs(self) -> int:
        """3n."""
        return self.pattern.size

    @cached_property
    def free_dofs(self) -> Index:
        """Dofs that are free at some time."""
        return self.experiment.free_dofs

    @cached_property
    def held_dofs(self) -> Index:
        """Dofs that are held throughout."""
        return self.experiment.held_dofs

    @cached_property
    def row_dofs(self) -> Index:
        """(rows_per_time,) the dof of each row of a grid time."""
        return np.arange(self.dofs) if self.grasps_have_rows else self.free_dofs

    @property
    def grasps_have_rows(self) -> bool:
        """Whether held dofs have rows of their own."""
        return self.explicit_grasps or self.nuisance.moves_grasps

    @property
    def rows_per_time(self) -> int:
        """Constraint rows of a grid time: free dofs, or all dofs with explicit grasps."""
        return len(self.row_dofs)

    @property
    def grid_rows(self) -> int:
        """N, grid times."""
        return self.dynamics.rows

    @property
    def variables(self) -> int:
        """N · 3n."""
        return self.grid_rows * self.dofs

    @property
    def constraint_times(self) -> int:
        """Grid times that have rows."""
        return self.grid_rows - self.dynamics.first_row

    @property
    def constraints(self) -> int:
        """Number of rows."""
        return self.constraint_times * self.rows_per_time

    @property
    def columns(self) -> slice:
        """Its x in z."""
        return slice(self.first.x, self.first.x + self.variables)

    @property
    def rows(self) -> slice:
        """Its constraints in g."""
        return slice(self.first.row, self.first.row + self.constraints)

    @property
    def places(self) -> Index:
        """Its (q, φ) in p."""
        return np.concatenate([np.arange(self.nq), self.local.places])

    @property
    def after(self) -> First:
        """Where the next segment begins."""
        return First(self.columns.stop, self.rows.stop)

    # Grasps and scales ------------------------------------------------------------------------

    @cached_property
    def grasping(self) -> Grasping:
        """Where the grasps are."""
        return Grasping(self.experiment, self.nuisance, self.dynamics.t_s)

    def _goals(self, held: Held) -> Array:
        """(N, 3n) goals of the grasped dofs, NaN elsewhere."""
        goals = np.full((self.grid_rows, self.dofs), np.nan)
        goals[:, held.dofs] = held.positions_m
        return goals

    @cached_property
    def length_m(self) -> float:
        """ℓ, the mean edge."""
        edges = np.diff(self.body.nodes_m[self.body.mesh.edges], axis=1)
        return float(np.linalg.norm(edges, axis=2).mean())

    @cached_property
    def force_n(self) -> float:
        """The mean of |∂c_t/∂x_t| ℓ on the diagonal, at the undeformed shape."""
        theta, at_rest = self.constants.theta(self.parameters.guess_q), self.body.nodes_m
        dynamics, pattern = self.dynamics.with_theta(theta), self.pattern
        at_last = dynamics.forces.rows(slice(dynamics.rows - 1, None))
        forces = at_last.linearise(at_rest, np.zeros_like(at_rest))
        last = StencilRow.of(dynamics, dynamics.rows - 1)
        block = last.block(forces.by_position[0], forces.by_velocity[0], pattern)
        stiffness = np.abs(block[pattern.diagonal[self.free_dofs]]).mean()
        return self.length_m * float(stiffness)

    def start_positions(self) -> Array | None:
        """(3n,) the given x_0, or None when it is found as an equilibrium."""
        experiment = self.experiment
        if experiment.start == "equilibrium":
            return None
        if experiment.start_positions_m is not None:
            return experiment.start_positions_m.ravel()
        return experiment.rigid_positions(self.dynamics.t_s[:1]).ravel()

    def bounds(self) -> tuple[Array, Array]:
        """(N, 3n) lower and upper bounds in metres; equal where a value is given."""
        lower = np.full((self.grid_rows, self.dofs), -np.inf)
        upper = np.full((self.grid_rows, self.dofs), np.inf)
        if not self.grasps_have_rows:
            lower[:, self.held_dofs] = self.dynamics.goals_m[:, self.held_dofs]
            upper[:, self.held_dofs] = lower[:, self.held_dofs]
        start = self.start_positions()
        if start is not None:
            lower[0] = upper[0] = start
        return lower, upper

    # Parameters -------------------------------------------------------------------------------

    @cached_property
    def moving(self) -> Index:
        """Positions in (q, φ) of the parameters that change the motion."""
        return np.concatenate([np.arange(self.nq), self.nq + self.nuisance.moving])

    def moving_in(self, first_phi: int) -> Index:
        """The same in z, where the φ of all experiments begin at `first_phi`."""
        phi = first_phi - self.nq + self.local.places[self.nuisance.moving]
        return np.concatenate([np.arange(self.nq), phi])

    @property
    def carries(self) -> bool:
        """Whether its body or a force on it carries something."""
        return self.body.remembers or bool(self.dynamics.forces.carrying)

    def setting(self, q: Array, phi: Array) -> Setting:
        """The equations of motion at (q, φ)."""
        p = np.concatenate([q, phi[self.nuisance.moving]])
        u, by_p = self.inputs.at(p)
        dynamics, held = self.dynamics.at(u), self.grasping.at(phi)
        if held.moves:
            dynamics = replace(dynamics, goals_m=self._goals(held))
        return Setting(self.inputs, p, self.nq, by_p, dynamics, held)

    @cached_property
    def inputs(self) -> Inputs:
        """What parameters do to the equations of motion."""
        return inputs_of(self.experiment, self.parameters, self.nuisance, self.dynamics.evaluated_s)

    def corrected(self, phi: Array) -> Experiment:
        """The experiment in the body's frame, as φ has gravity, grasps, loads and drives."""
        if not len(self.nuisance.moving):
            return self.experiment
        grasps = self.experiment.grasps
        if self.nuisance.moves_grasps:
            grasps = self.nuisance.with_grasps(grasps, phi)
        off = iter(self.nuisance.drives(phi))
        tendons, pressures = (
            tuple(actuator.off_by(*next(off)) for actuator in actuators)
            for actuators in (self.experiment.tendons, self.experiment.pressures)
        )
        changed = replace(
            self.experiment,
            gravity_m_s2=self.nuisance.gravity(phi),
            grasps=grasps,
            tendons=tendons,
            pressures=pressures,
        )
        return self.nuisance.with_times(changed, phi)

    def grasped(self, x: Array, phi: Array) -> Array:
        """Positions (N, 3n) with the held nodes where their grasps are."""
        goals = self._goals(self.grasping.at(phi))
        return np.where(np.isnan(goals), x, goals)

    # Values ---------------------------------------------------------------------------------

    def constraint_values(
        self, x: Array, setting: Setting, along: Sequence[AnyHistory] = ()
    ) -> Array:
        """(constraints,) scaled rows at x (N, 3n) in metres."""
        return self._rows(x, setting.dynamics.residual(x, along), setting)

    def _rows(self, x: Array, residual: Array, setting: Setting) -> Array:
        rows = residual / self.force_n
        goals = setting.dynamics.goals_m
        grasped = ~np.isnan(goals)
        rows[grasped] = (x[grasped] - goals[grasped]) / self.length_m
        return self.of_rows(rows)

    def of_rows(self, values: NDArray[T]) -> NDArray[T]:
        """(constraints,) what the rows have of (N, 3n)."""
        return values[self.dynamics.first_row :, self.row_dofs].ravel()

    @cached_property
    def grasp_rows(self) -> NDArray[np.bool_]:
        """(constraints,) rows that hold a node instead of moving it."""
        grasped = self.dynamics.taken.copy()
        grasped[:, self.held_dofs] = True
        return self.of_rows(grasped)

    def residual_n(self, x: Array, setting: Setting, along: Sequence[AnyHistory] = ()) -> Array:
        """(N, free dofs) violation of the equations of motion in newtons."""
        residual = setting.dynamics.residual(x, along)
        return self.dynamics.without_taken(residual)[:, self.free_dofs]

    @cached_property
    def motion_rows(self) -> MotionRows:
        """The structure of ∂c/∂x."""
        return MotionRows(self.dynamics, self.row_dofs, self.free_dofs, self.length_m, self.force_n)

    @property
    def jacobian(self) -> BlockBand:
        """Its entries; row numbers count within the segment."""
        return self.motion_rows.band

    def constraints_and_jacobian(
        self, x: Array, setting: Setting, forces: Linearisation, values: Array
    ) -> tuple[Array, Array]:
        """Write ∂c/∂x into `values` (jacobian.nnz,), at the memory as it is.

        Parameters
        ----------
        x : (N, 3n) metres
        setting : Setting
        forces : Linearisation
            Of the evaluations of x.

        Returns
        -------
        rows : (constraints,) c
        by_p : (constraints, len(moving)) ∂c/∂(q, φ), where it is not zero
        """
        dynamics = setting.dynamics
        self.motion_rows.fill(values, forces, dynamics, setting.mass_moves)
        by_p = np.zeros((self.grid_rows, self.dofs, len(self.moving)))
        rows = slice(dynamics.first_row, None)
        by_p[rows] = setting.force_slopes(rows, forces.by_theta)
        by_p = dynamics.combine(dynamics.tables.w, dynamics.without_taken(by_p))
        if setting.mass_moves:
            whole = slice(None)
            by_p -= setting.inertia_slopes(whole, dynamics.acceleration(x), whole)
        by_p /= self.force_n
        dynamics.without_taken(by_p)
        by_p[:, self.held_dofs] = 0
        if setting.held.moves:
            by_p[:, setting.held.dofs, self.nq :] -= setting.held.by_phi / self.length_m
        by_p = by_p[dynamics.first_row :, self.row_dofs]
        rows = self._rows(x, dynamics.assemble_residual(x, forces.force), setting)
        return rows, by_p.reshape(self.constraints, len(self.moving))

    def weights(self, multipliers: Array, of_reactions: Array | float = 0.0) -> RowWeights:
        """Those of multipliers · c, and of rows (N, 3n) where no force counts as taken."""
        dynamics, t = self.dynamics, self.dynamics.tables
        rows = np.zeros((self.grid_rows, self.dofs))
        by_time = multipliers.reshape(self.constraint_times, self.rows_per_time)
        rows[dynamics.first_row :, self.row_dofs] = by_time / self.force_n
        rows[:, self.held_dofs] = 0
        rows = dynamics.without_taken(rows)
        forces = dynamics.without_taken(dynamics.combine_transposed(t.w, rows))
        if isinstance(of_reactions, np.ndarray):
            rows = rows + of_reactions
            forces = forces + dynamics.combine_transposed(t.w, of_reactions)
        return RowWeights(multipliers, rows, forces)

    def pulled_through(self, x: Array, setting: Setting, weights: Array) -> tuple[Array, Array]:
        """Slopes of Σ weights · F through what is carried, by x and by what moves the body.

        Weights are (N, 3n).
        """
        dynamics, by_x, by_p = setting.dynamics, np.zeros_like(x), np.zeros(len(self.moving))
        for history in dynamics.histories(x):
            by_xi, by_nu, own = history.pulled(weights, setting.by_p)
            by_x += dynamics.combine_transposed(dynamics.state_weights, by_xi)
            by_x += dynamics.combine_transposed(dynamics.tables.q, by_nu) / dynamics.step_s
            by_p += own
        return by_x, by_p

    @cached_property
    def linearisation_rows(self) -> Array:
        """Work space of linearisations."""
        # Kept between calls: fresh pages would cost as much as the numbers in them.
        return np.zeros((self.constraint_times, self.dynamics.forces.linearisation_width))

    # Second derivatives -----------------------------------------------------------------------

    @cached_property
    def hessian(self) -> BlockBand:
        """Structure of the upper triangle of the Lagrangian's Hessian in the columns of x.

        The nq rows of q stand above the rows of x.
        """
        blocks = self._hessian_blocks(_of_states)
        return BlockBand(self.dofs, self._hessian_starts, blocks, top=self.nq)

    @cached_property
    def _skew_hessian(self) -> BlockBand:
        """The same, to add what the skew part of ∂²φ/∂x∂v gives."""
        blocks = self._hessian_blocks(lambda p, q, pp, qq: (pp * q - qq * p, 0 * q))
        return adding_skew(self.dofs, self._hessian_starts, blocks, top=self.nq)

    @cached_property
    def _rate_hessian(self) -> BlockBand:
        """The same, to add what ∂²φ/∂v² gives."""
        blocks = self._hessian_blocks(lambda p, q, pp, qq: (q * qq, 0 * q))
        return BlockBand(self.dofs, self._hessian_starts, blocks, self.nq, adds=True)

    @property
    def _hessian_starts(self) -> Index:
        return self.nq + np.arange(self.grid_rows) * self.dofs

    def _hessian_blocks(self, factors: Factors) -> list[BandBlock]:
        """Blocks ∂²φ/∂x_{t−distance}∂x_t where those of ∂²φ/∂x² and ∂²φ/∂x∂v are."""
        rows, columns, source = self.pattern.full
        blocks = []
        for distance in range(self.dynamics.reach + 1):
            if distance > 0 and not self._curvature_terms(distance, _of_states):
                continue
            kept = rows <= columns if distance == 0 else np.ones(len(rows), dtype=bool)
            entries, terms = np.flatnonzero(kept), self._curvature_terms(distance, factors)
            blocks.append(
                BandBlock(-distance, rows[kept], columns[kept], source[kept], terms, entries)
            )
        return blocks

    def _curvature_terms(self, distance: int, factors: Factors) -> list[BlockTerm]:
        """Terms of such a block, from evaluations k = t + i."""
        p, q = self.dynamics.state_weights, self.dynamics.tables.q / self.dynamics.step_s
        terms = []
        for i in range(self.dynamics.reach + 1 - distance):
            pair = factors(p[:, i], q[:, i], p[:, i + distance], q[:, i + distance])
            if any(each.any() for each in pair):
                terms.append(BlockTerm(i, *(ahead(self.length_m**2 * each, i) for each in pair)))
        return terms

    def hessian_values(
        self,
        x: Array,
        phi: Array,
        setting: Setting,
        weights: RowWeights,
        loss_weight: float,
        values: Array,
        carried: Sequence[Weighed] = (),
        bent: bool = True,
    ) -> tuple[Array, list[Array]]:
        """Second derivatives of loss_weight · L + weights · c.

        Parameters
        ----------
        values : (hessian.nnz,) out, of the dynamics in the columns of x
        bent : whether readings are, see `LocalLoss.hessian`
        carried : histories that are given, with what h_k of each counts besides, Σ μ_k h_k

        Returns
        -------
        by_q : (nq, nq) second derivatives by q
        further : list of the values of `further_entries`
        """
        dynamics, band = setting.dynamics, self.hessian
        curvature = self._curvature(x, setting, weights.forces, carried)
        band.fill(
            values, curvature.position_position, curvature.position_velocity, self.body.threads
        )
        if curvature.velocity_velocity.size:
            rates = curvature.velocity_velocity
            self._rate_hessian.fill(values, rates, rates, self.body.threads)
        skew = skew_values(self.pattern, curvature.position_velocity_skew)
        if skew.size:
            self._skew_hessian.fill(values, skew, skew, self.body.threads)
        by_x, twice = setting.curvature(x, curvature, weights.rows)
        of_q = self.length_m * by_x[..., : self.nq]
        values[band.top_positions] = of_q.reshape(band.top_positions.shape)
        by_phi = np.diag(2 * loss_weight * self.local.counted)  # the prior
        of_motion = twice[self.nq :, self.nq :]
        if setting.held.moves:
            of_goals = np.zeros((self.grid_rows, self.dofs))
            by_time = weights.multipliers.reshape(self.constraint_times, self.rows_per_time)
            of_goals[dynamics.first_row :, self.row_dofs] = -by_time / self.length_m
            grasped = ~np.isnan(setting.held.positions_m)
            of_goals = np.where(grasped, of_goals[:, setting.held.dofs], 0.0)
            of_motion = of_motion + self.grasping.curvature(phi, of_goals)
        by_phi[np.ix_(self.nuisance.moving, self.nuisance.moving)] += of_motion
        of_loss = loss_weight * self._loss_scale * self.local_loss.hessian(x, phi, bent)
        of_states = self.length_m * by_x[..., self.by_state].ravel()
        of_pairs = by_phi[np.triu_indices(len(by_phi))]
        further = [of_loss, twice[: self.nq, self.nq :].ravel(), of_states, of_pairs]
        return twice[: self.nq, : self.nq], further

    def _curvature(
        self, x: Array, setting: Setting, weights: Array, carried: Sequence[Weighed]
    ) -> Curvature:
        """That of the forces and what is left at all N evaluations, a given start included."""
        dynamics = setting.dynamics
        forces, (xi, nu) = dynamics.forces, dynamics.evaluated_at(x)
        for history, mu in carried:
            forces = history.weighed(forces, mu)
        curvature = forces.curvature(xi, nu, weights, self._curvature_rows)
        for history, mu in carried:
            history.add_curvature(curvature, mu)
        return curvature

    @cached_property
    def by_state(self) -> Index:
        """Which of (q, φ that move the body) are φ that change forces together with the state."""
        return self.nq + np.flatnonzero(self.inputs.by_state[self.nq :])

    @cached_property
    def _curvature_rows(self) -> Array:
        return np.zeros((self.grid_rows, self.dynamics.forces.curvature_width))

    @property
    def hessian_diagonal(self) -> Index:
        """Positions of the diagonal of x in the values of `hessian`."""
        dofs = np.arange(self.dofs)
        return self.hessian.positions(np.arange(self.grid_rows), 0, dofs, dofs).ravel()

    def further_entries(self, first_phi: int) -> list[tuple[Index, Index]]:
        """Rows and columns in z of what its Hessian has besides `hessian`, upper triangle.

        Those of the loss by x and φ; of the motion by q and φ, and by x and φ; of φ by φ.

        Parameters
        ----------
        first_phi : where in z the φ of all experiments begin
        """
        of_x = self.first.x + np.arange(self.variables)
        of_phi = first_phi - self.nq + self.local.places
        in_z, moving = np.concatenate([of_x, of_phi]), of_phi[self.nuisance.moving]
        states, pairs = moving[self.by_state - self.nq], np.triu_indices(len(of_phi))
        rows, columns = self.local_loss.structure
        found = [
            (in_z[rows], in_z[columns]),
            (np.repeat(np.arange(self.nq), len(moving)), np.tile(moving, self.nq)),
            (np.repeat(of_x, len(states)), np.tile(states, len(of_x))),
            (of_phi[pairs[0]], of_phi[pairs[1]]),
        ]
        # Experiments that share a φ need not have them in the same order.
        return [(np.minimum(*each), np.maximum(*each)) for each in found]

    @cached_property
    def _loss_scale(self) -> Array:
        """Of each entry of the loss, its factor in scaled variables."""
        rows, columns = self.local_loss.structure
        powers = (rows < self.variables).astype(float) + (columns < self.variables)
        return self.length_m**powers


def _of_states(p: Array, q: Array, pp: Array, qq: Array) -> tuple[Array, Array]:
    """Factors of ∂²φ/∂x² and ∂²φ/∂x∂v."""
    return p * pp, p * qq + q * pp
