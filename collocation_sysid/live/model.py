"""What a problem says of a recording that is still being made.

A short still recording of the same body, grasps and markers stands for every recording: its first
rows have the stencils of the start, and its last row those of all later ones.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array, Index
from ..errors import InputError
from ..fem.constants import GAMMA_M, bare
from ..methods.scan import usual_parameters
from ..model.dynamics import StencilRow
from ..model.point_forces import generated
from ..problem import Problem
from ..program.channel import Points
from ..program.collocation import Collocation
from ..program.gauge import NEIGHBOURS as GAUGE_NEIGHBOURS
from ..program.gauge import points_of
from ..program.least_squares import LeastSquares
from ..program.markers import NEIGHBOURS, MarkerReading
from ..program.newton import NewtonOptions, Solver
from ..program.reading import Reading
from ..program.segment import Segment
from ..program.sweep import Sweep
from ..program.wrench import NEIGHBOURS as WRENCH_NEIGHBOURS
from ..program.wrench_channel import GraspWrench
from ..recording.experiment import Experiment
from ..recording.poses import PoseSequence
from ..recording.wrench import Wrench
from .felt import LATE, Poses, Sensor

if TYPE_CHECKING:
    from ..fem.kernels.skyline import Room

# Rows that are linearised at a time, at most.
TOGETHER = 8
# A prior of this standard deviation of the logarithm holds each parameter near its guess: what the
# first frames do not tell stays finite, and of what a recording tells it changes nothing.
WEAK = 2.3
# To what accuracy rows are solved where the way of the grasp has to be taken in parts.
CAREFUL = NewtonOptions(tolerance=1e-6)
# Young's modulus that a search without a guess begins at.
MIDDLE_PA = 1e4
# Readings this near to a row, in rows, are of that row; others lie between some of them.
NEAR = 1e-3


class Around(NamedTuple):
    """The rows that samples of an instrument are read from, as in a recording that goes on.

    neighbours : int
        Rows, where its clock is right.
    off : float
        Rows that its clock may be off.
    first, late : int
        From which row on there is what it looks at, and how many rows later that is known.
    """

    neighbours: int
    off: float = 0.0
    first: int = 0
    late: int = 0

    def rows(self, at: float) -> range:
        """Those of a sample at such a row."""
        begins, ends = (
            max(int(np.floor(at + off + NEAR)) - (self.neighbours - 1) // 2, self.first)
            for off in (-self.off, self.off)
        )
        return range(begins, ends + self.neighbours)


class LiveInstrument(NamedTuple):
    """What frames bring numbers of besides markers.

    reading : Reading
    around : Around
    looked : slice or int
        Places among all that are looked at, or the sensor.
    """

    reading: Reading
    around: Around
    looked: slice | int


@dataclass(frozen=True, eq=False)
class Model:
    """A problem whose recording comes frame by frame.

    Attributes
    ----------
    experiment : Experiment
        The one that is fitted, as the problem has it.
    collocation : Collocation
        Of the still recording.
    """

    experiment: Experiment
    collocation: Collocation

    @classmethod
    def of(cls, problem: Problem) -> Model:
        """The model of a problem.

        Raises
        ------
        InputError
            Where what the problem has cannot be live, in words.
        """
        experiment = _only_experiment(problem)
        collocation = problem.collocation()
        if collocation.parameters.unguessed:
            usual = usual_parameters(collocation.parameters, MIDDLE_PA)
            collocation = replace(collocation, parameters=usual)
        still = replace(collocation, experiments=[_still(experiment, collocation)])
        return cls(experiment, still)

    def at_start(self, poses: Poses) -> Experiment:
        """The experiment that begins with its grasps at these poses."""
        still = self.segment.experiment
        return replace(still, grasps=_held_at(still, poses))

    def placed(self, tracks_m: Array, x: Array) -> Model:
        """The same with unknown places where markers (M, 3) lie on the start x (3n,)."""
        unknown = ~self.segment.experiment.markers.located & np.isfinite(tracks_m).all(axis=1)
        if not unknown.any():
            return self
        places_m = self.segment.places_m(self.segment.guess_phi)
        nodes_m = x.reshape(-1, 3)
        places_m[unknown] = self.segment.chart.at_markers(nodes_m, tracks_m[unknown])
        return replace(self, collocation=self.collocation.placed_at([places_m]))

    @cached_property
    def segment(self) -> Segment:
        """The still recording."""
        return self.collocation.segments[0]

    @cached_property
    def solver(self) -> Sweep:
        """Of its rows."""
        return Sweep(self.segment, self.rows)

    @cached_property
    def newton(self) -> Solver:
        """Of the start, and of rows where the way of the grasp has to be taken in parts."""
        return Solver(self.segment.experiment, CAREFUL)

    @cached_property
    def rows(self) -> int:
        """Rows of the start, and those that are linearised at a time."""
        return 2 * self.segment.dynamics.reach + 2 + TOGETHER

    @cached_property
    def size(self) -> int:
        """Number of parameters p."""
        return self.collocation.nq + self.collocation.nphi

    @property
    def substeps(self) -> int:
        """Rows between samples."""
        return self.collocation.substeps

    @property
    def interval_s(self) -> float:
        """Time between samples."""
        return self.experiment.timestep_s

    @cached_property
    def _drags(self) -> tuple[Index, Array]:
        """Where p has the logarithms of damping by mass, and those of its guesses."""
        free = self.collocation.parameters.free
        places = np.flatnonzero([bare(item.name) == GAMMA_M.name for item in free])
        return places, self.collocation.guess_p[places]

    def flat(self, p: Array) -> Array:
        """What residuals are nearly linear in: of γ_m its value over the guess, else p."""
        (places, guesses), flat = self._drags, p.copy()
        flat[places] = np.exp(p[places] - guesses)
        return flat

    def curved(self, flat: Array) -> Array:
        """The p of what is flat."""
        (places, guesses), p = self._drags, flat.copy()
        p[places] = guesses + np.log(flat[places])
        return p

    def rates(self, flat: Array) -> Array:
        """(P,) of what is flat by p, each by its own."""
        (places, _), rates = self._drags, np.ones(len(flat))
        rates[places] = flat[places]
        return rates

    def stated(self, p: Array) -> LeastSquares:
        """What is known before the first frame, to first order about p."""
        residual, slopes = self.collocation.prior(p)
        nq, flat = self.collocation.nq, self.flat(p)
        away = (p[:nq] - self.collocation.parameters.guess_q) / WEAK
        rows = np.vstack([np.diag(slopes), np.eye(nq, self.size) / WEAK]) / self.rates(flat)
        none = LeastSquares.none(self.size)
        return none.add(np.concatenate([residual, away]), rows, flat)

    @cached_property
    def samples_around(self) -> int:
        """Samples before and after one that its reading needs."""
        return NEIGHBOURS // 2 if len(self.segment.nuisance.of_clock) else 0

    @cached_property
    def markers(self) -> MarkerReading:
        """Reads one sample, in the middle of those around, of markers measured at the origin."""
        around, markers = self.samples_around, self.segment.experiment.markers
        origin = replace(
            markers, t_s=markers.t_s[:1], positions_m=np.zeros((1, len(markers.names), 3))
        )
        rows, segment = np.arange(2 * around + 1), self.segment
        where = rows, segment.nuisance, segment.chart
        return MarkerReading.of(origin, *where, earlier=around)

    @cached_property
    def instruments(self) -> tuple[LiveInstrument, ...]:
        """Readings of one's own, then the sensors of grasps."""
        found, place, step_s = [], len(self.experiment.markers.names), self.segment.dynamics.step_s
        points = iter(self.looked)
        for reading in (*self.segment.gauges, *self.segment.sensors):
            channel, own = reading.channel, reading in self.segment.gauges
            around = Around(GAUGE_NEIGHBOURS)
            if isinstance(channel, GraspWrench):
                looked = [other for other, _ in self.sensors].index(channel)
                around = around._replace(first=int(channel.grid[0]), late=LATE)
                if not own:
                    off = channel.clock_limit_s / step_s
                    around = around._replace(neighbours=WRENCH_NEIGHBOURS, off=off)
            else:
                here = next(points)
                reading, looked = replace(reading, channel=here), slice(place, place + here.each)
                place += here.each
            found.append(LiveInstrument(reading, around, looked))
        return tuple(found)

    @cached_property
    def late(self) -> int:
        """Most rows that these need beside those that markers do."""
        spans = (2 * each.around.off + each.around.late for each in self.instruments)
        return int(np.ceil(max(spans, default=0.0)))

    @cached_property
    def looked(self) -> tuple[Points, ...]:
        """The places that readings of points look at."""
        still = self.segment.experiment
        gauges = [gauge for gauge in still.readings if gauge.grasp is None]
        return tuple(points_of(still, gauge, GAUGE_NEIGHBOURS) for gauge in gauges)

    @cached_property
    def sensors(self) -> tuple[Sensor, ...]:
        """What looks at a grasp, and its index, from 0."""
        channels = [reading.channel for reading in self.segment.readings]
        grasps = [id(grasp) for grasp in self.segment.experiment.grasps]
        feels = (channel for channel in channels if isinstance(channel, GraspWrench))
        return tuple((channel, grasps.index(id(channel.grasp))) for channel in feels)

    @cached_property
    def wrenches(self) -> dict[int, Wrench]:
        """Those that the problem's recording has, by the number of their grasp from 1 on."""
        pairs = enumerate(self.experiment.grasps, 1)
        return {number: grasp.wrench for number, grasp in pairs if grasp.wrench is not None}

    @cached_property
    def moved_grasps(self) -> Index:
        """Indices, from 0, of the grasps whose poses come with the frames; others never move."""
        grasps = self.experiment.grasps
        return np.flatnonzero([len(grasp.poses.t_s) > 1 for grasp in grasps])

    @cached_property
    def first_poses(self) -> Poses:
        """Those of all grasps that the problem's recording begins with."""
        return _first_poses(self.experiment)

    def poses_of(self, moved: Poses) -> Poses:
        """Those of all grasps from those that move."""
        still = list(self.first_poses)
        for number, pose in zip(self.moved_grasps, moved, strict=True):
            still[number] = pose
        return tuple(still)

    @cached_property
    def known_rows(self) -> dict[int, StencilRow]:
        """Rows whose masses are always the same, by number."""
        return {}

    @cached_property
    def room(self) -> Room | None:
        """For the factor of a row; passes take turns."""
        return self.solver.factoriser.room(1 + self.segment.body.unsymmetric)

    @cached_property
    def out(self) -> Array:
        """For rows that are linearised."""
        return np.empty((TOGETHER, self.segment.dynamics.forces.linearisation_width))

    @cached_property
    def size_m(self) -> float:
        """Of the body, across."""
        return float(np.linalg.norm(np.ptp(self.segment.body.nodes_m, axis=0)))

    def carried(self, phi: Array) -> tuple[Array, Array]:
        """H X (g, 3) of the node of each grasped dof, and its slopes (g, 3, m)."""
        return self.segment.grasping.places(phi)

    def goals(self, carried: tuple[Array, Array], poses: Sequence[Poses]) -> tuple[Array, Array]:
        """Where grasped dofs are at K poses, (K, g), and the slopes by the φ that move them."""
        turns = np.array([[turn for turn, _ in each] for each in poses])[:, *self._axes]
        shifts = np.array([[shift for _, shift in each] for each in poses])[:, *self._axes]
        goal = np.einsum("kgj,gj->kg", turns, carried[0]) + shifts
        return goal, np.einsum("kgj,gjm->kgm", turns, carried[1])

    @cached_property
    def _axes(self) -> tuple[Index, Index]:
        """The grasp and the axis of each grasped dof."""
        dofs = self.segment.grasping.dofs
        grasp = np.zeros_like(dofs)
        for k, each in enumerate(self.experiment.grasps):
            grasp[np.searchsorted(dofs, each.dofs)] = k
        return grasp, dofs % 3

    @cached_property
    def stencils(self) -> tuple[Array, Array, Array, Array]:
        """Of all rows the coefficients p, q, w and s of `program.row`, as (rows, rows) matrices."""
        dynamics = self.segment.dynamics.first_rows(self.rows)
        tables, step_s = dynamics.tables, dynamics.step_s
        p, q, w, s = (
            np.sum([np.diag(each[lag:, lag], -lag) for lag in range(each.shape[1])], axis=0)
            for each in (tables.p, tables.q, tables.w, tables.s)
        )
        return p, q / step_s, w, s / step_s**2


def _only_experiment(problem: Problem) -> Experiment:
    fitted = [each for each in problem.experiments if not each.validation]

    if len(fitted) != 1:
        raise InputError(
            f"{len(fitted)} experiments are fitted; live there is one, expected the others to be "
            "left out or for validation",
            problem.path,
            "experiment",
        )
    (experiment,) = fitted
    for found, there, expected in _not_live(experiment):
        if there:
            where, message = f"experiment '{experiment.name}'", f"{found} cannot be live"
            raise InputError(f"{message}; expected {expected}", problem.path, where)
    return experiment


def _not_live(experiment: Experiment) -> Iterator[tuple[str, object, str]]:
    """What live does without, whether this has it, and what is expected instead."""
    body, grasps, nuisance = experiment.body, experiment.grasps, experiment.nuisance
    yield "a static experiment", experiment.static, "a motion"
    given = experiment.start == "given"
    yield "a start that is given", given, "one in equilibrium, or undeformed"
    yield "a material with memory", body.remembers, "one without Prony branches"
    yield "a mesh made under gravity", body.scan is not None, "a stress-free one"
    carry = any(placed.force.carries for placed in body.placed_forces)
    yield "a force that carries something from step to step", carry, "none"
    yield "tensions and pressures, which frames do not bring,", experiment.actuators, "none"
    yield "depth cameras, which frames do not bring,", experiment.depths, "none"
    delayed = experiment.obstacles and nuisance.obstacle_time_s
    yield "an obstacle whose delay is estimated", delayed, "one whose clock is known"
    filtered = nuisance.sensor_lag_s and experiment.wrenches
    yield "a sensor with a low-pass (sensor_lag)", filtered, "one without"
    own = (generated(each.force, each.points.dofs) for each in body.placed_forces)
    timed = any(law.takes(0) for law in own)
    yield "a force that depends on time", timed, "one that does not"
    yield "an experiment without markers", not experiment.markers.names, "markers"
    brief = any(np.isfinite([g.from_s, g.until_s]).any() for g in grasps)
    yield "a grasp that holds for a while only", brief, "grasps throughout"
    zeroed = any(grasp.zero for grasp in grasps)
    yield "a grasp whose zero is estimated", zeroed, "one whose zero is known"
    moves = any(len(grasp.poses.t_s) > 1 for grasp in grasps)
    yield "an experiment whose grasps never move", not moves, "a pose that moves"
    loads = (each(experiment.t_s) for each in (experiment.tied_mass_kg, experiment.node_forces_n))
    changing = not all(np.allclose(each, each[:1]) for each in loads)
    yield "a load that joins, leaves or changes", changing, "loads that are always there"


def _still(experiment: Experiment, collocation: Collocation) -> Experiment:
    """A few samples in which nothing moves."""
    reach = collocation.segments[0].dynamics.reach
    # The rows of the start, and room for a reading.
    count = max(2 * reach + 2 + TOGETHER, NEIGHBOURS, 3)
    t_s = experiment.timestep_s * np.arange(count)
    markers = experiment.markers
    first, _ = markers.first_samples
    tracks = np.tile(np.nan_to_num(first), (count, 1, 1))
    gauges = [
        replace(g, t_s=t_s, values=np.zeros((count, g.measured.shape[1])))
        for g in experiment.readings
    ]
    return replace(
        experiment,
        t_s=t_s,
        grasps=[
            replace(grasp, wrench=grasp.wrench and _still_wrench(grasp.wrench, t_s))
            for grasp in _held_at(experiment, _first_poses(experiment))
        ],
        markers=replace(markers, t_s=t_s, positions_m=tracks),
        readings=gauges,
    )


def _still_wrench(wrench: Wrench, t_s: NDArray) -> Wrench:
    values = np.where(wrench.measured, np.zeros((len(t_s), 1)), np.nan)
    return replace(wrench, t_s=t_s, values=values)


def _first_poses(experiment: Experiment) -> Poses:
    found = (grasp.poses.at(grasp.poses.t_s[:1]) for grasp in experiment.grasps)
    return tuple((turns[0], shifts[0]) for turns, shifts in found)


def _held_at(experiment: Experiment, poses: Poses) -> list:
    found = []
    for grasp, (turn, shift) in zip(experiment.grasps, poses, strict=True):
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = turn, shift
        found.append(replace(grasp, poses=PoseSequence.from_matrices([0.0], matrix[None])))
    return found
