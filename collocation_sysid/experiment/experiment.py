"""One recording of a body: its grasps, its markers, and the state it starts from."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arrays import Array, Index
from ..errors import InputError
from .arrays import read_only_floats
from .clock import STEP_TOLERANCE, sample_interval_s
from .grasp import Grasp, held_nodes
from .loads import Change, Force, PointMass, ramp
from .markers import Markers
from .nuisance import Nuisance

if TYPE_CHECKING:
    from ..fem.body import Body

Start = Literal["equilibrium", "undeformed", "given"]
StartRule = Literal["standard", "paper"]

EARTH_M_S2 = (0.0, 0.0, -9.81)
AS_IN_A_LABORATORY = Nuisance()

# Held nodes count as collinear when they deviate from a line by less than this part of its length.
_COLLINEAR = 1e-6


@dataclass(frozen=True, eq=False)
class Experiment:
    """What was done to a body and what was measured.

    Parameters
    ----------
    body : Body
        Provides `nodes_m`, `cells` and `element`.
    t_s : (T,) array
        At least three evenly spaced times.
    grasps : sequence of Grasp
        No node in two of them at a time. Selected nodes are looked up on the body, and poses given
        as matrices are those at `t_s`.
    markers : Markers
        Tracks at the times `t_s`, at least one sample present. Those given by their places are put
        on the body, see `place_markers`.
    gravity_m_s2 : (3,) array
        Acceleration of gravity.
    name : str
        For messages and reports; experiments of one problem have different names.
    start : {"equilibrium", "undeformed", "given"}
        State at the first time: at rest under its loads; undeformed and at rest; or as given.
    start_rule : {"standard", "paper"}
        Inertia of the first step: from the starting velocity, or zero acceleration.
    start_positions_m, start_velocities_m_s : (n, 3) arrays, optional
        The state for "given"; at rest if the velocities are left out.
    loaded_since_s : float
        How long the body has been in the shape of its equilibrium since its loads came at once; a
        body with memory has relaxed by default.
    validation : bool
        Predicted only, not fitted.
    masses : sequence of PointMass
        Tied to the body.
    forces : sequence of Force
        On the nodes besides gravity.
    nuisance : Nuisance
        What else is to be estimated about this recording alone: by default what a careful
        laboratory does not know better; `Nuisance.none` for ideal data.

    Raises
    ------
    InputError
        If any of this does not hold, naming the experiment.
    """

    body: Body
    t_s: Array
    grasps: tuple[Grasp, ...]
    markers: Markers
    gravity_m_s2: Array
    name: str
    start: Start
    start_rule: StartRule
    start_positions_m: Array | None
    start_velocities_m_s: Array | None
    loaded_since_s: float
    validation: bool
    masses: tuple[PointMass, ...]
    forces: tuple[Force, ...]
    nuisance: Nuisance

    def __init__(
        self,
        body: Body,
        t_s: ArrayLike,
        grasps: Iterable[Grasp],
        markers: Markers,
        gravity_m_s2: ArrayLike = EARTH_M_S2,
        name: str = "experiment",
        *,
        start: Start = "equilibrium",
        start_rule: StartRule = "standard",
        start_positions_m: ArrayLike | None = None,
        start_velocities_m_s: ArrayLike | None = None,
        loaded_since_s: float = np.inf,
        validation: bool = False,
        masses: Iterable[PointMass] = (),
        forces: Iterable[Force] = (),
        nuisance: Nuisance = AS_IN_A_LABORATORY,
    ) -> None:
        n = len(body.nodes_m)
        try:
            times = read_only_floats(t_s, (None,), "t_s")
            vars(self).update(
                body=body,
                t_s=times,
                grasps=tuple(grasp.on(body, times) for grasp in grasps),
                markers=markers,
                gravity_m_s2=read_only_floats(gravity_m_s2, (3,), "gravity_m_s2"),
                name=name,
                start=start,
                start_rule=start_rule,
                start_positions_m=_state(start_positions_m, n, "start_positions_m"),
                start_velocities_m_s=_state(start_velocities_m_s, n, "start_velocities_m_s"),
                loaded_since_s=float(loaded_since_s),
                validation=validation,
                masses=tuple(mass.on(body) for mass in masses),
                forces=tuple(force.on(body) for force in forces),
                nuisance=nuisance,
            )
            self._check_time()
            vars(self)["markers"] = markers.on(body, self._carried_back)
            self._check_nodes()
            self._check_start()
        except InputError as error:
            raise error.located(where=f"experiment '{name}'") from error

    def __repr__(self) -> str:
        kind = ", validation" if self.validation else ""
        return (
            f"Experiment({self.name!r}: {len(self.t_s)} samples over {self.duration_s:.4g} s, "
            f"grasps: {len(self.grasps)}, {self.markers!r}{kind})"
        )

    @property
    def timestep_s(self) -> float:
        """Time between samples."""
        return self.duration_s / (len(self.t_s) - 1)

    @property
    def duration_s(self) -> float:
        """Time from the first to the last sample."""
        return float(self.t_s[-1] - self.t_s[0])

    @cached_property
    def held_nodes(self) -> Index:
        """Nodes that are grasped throughout, sorted."""
        held, _ = self.grasped(self.t_s)
        return np.flatnonzero(held.all(axis=0))

    @cached_property
    def free_nodes(self) -> Index:
        """All other nodes, sorted; grasps with a time window may hold some for a while."""
        return np.setdiff1d(np.arange(len(self.body.nodes_m)), self.held_nodes)

    def grasped(self, t_s: ArrayLike) -> tuple[NDArray[np.bool_], Array]:
        """Return which nodes are held at the times `t_s` (T,), and where.

        Returns
        -------
        held : (T, n) bool
        positions_m : (T, n, 3)
            NaN where a node is not held.
        """
        times = np.atleast_1d(np.asarray(t_s, dtype=np.float64))
        n = len(self.body.nodes_m)
        held = np.zeros((len(times), n), dtype=bool)
        positions = np.full((len(times), n, 3), np.nan)
        for grasp in self.grasps:
            here = np.flatnonzero(grasp.holds(times))
            held[np.ix_(here, grasp.nodes)] = True
            positions[np.ix_(here, grasp.nodes)] = grasp.carry(self.body.nodes_m, times[here])
        return held, positions

    def held_positions(self, t_s: ArrayLike) -> Array:
        """Return where `held_nodes` are carried at `t_s` (T,), as (T, held, 3) metres."""
        return self.grasped(t_s)[1][:, self.held_nodes]

    def node_mass_kg(self, t_s: ArrayLike) -> Array:
        """Return the mass that moves with each node at `t_s` (T,), (T, n) [kg]."""
        n, times = len(self.body.nodes_m), np.atleast_1d(t_s)
        mass = np.broadcast_to(self.body.node_mass, (len(times), n))
        for point in self.masses:
            mass = mass + np.outer(self.share(point, times), point.at_nodes(n))
        return mass

    def share(self, load: PointMass | Force, t_s: ArrayLike) -> Array:
        """Return how much of a load is there at `t_s` (T,), from 0 to 1.

        It joins and leaves between a sample before and a sample after its times, see `loads.ramp`;
        all is there from the first sample on where it joins by then.
        """
        times = np.atleast_1d(np.asarray(t_s, dtype=np.float64))
        joined, left = (self._changed(load, change, times) for change in get_args(Change))
        return joined - left

    def _changed(self, load: PointMass | Force, change: Change, times: Array) -> Array:
        at_s = getattr(load, change)
        if self.changes(load, change):
            return ramp((times - at_s) / self.timestep_s)
        return np.full(len(times), float(at_s <= self.t_s[0]))

    def changes(self, load: PointMass | Force, change: Change) -> bool:
        """Whether a load joins, or leaves, within the recording."""
        return bool(self.t_s[0] < getattr(load, change) < self.t_s[-1])

    def node_forces_n(self, t_s: ArrayLike) -> Array:
        """Return the forces besides gravity on the nodes at `t_s` (T,), (T, n, 3)."""
        n, times = len(self.body.nodes_m), np.atleast_1d(t_s)
        total = np.broadcast_to(np.zeros(3), (len(times), n, 3))
        for force in self.forces:
            total = total + self.share(force, times)[:, None, None] * force.at_nodes(times, n)
        return total

    def rigid_positions(self, t_s: ArrayLike) -> Array:
        """Return all nodes (T, n, 3) as if a grasp carried the undeformed body rigidly.

        That is the first grasp that holds throughout, else the first. Without a grasp the body
        stays where it is undeformed.
        """
        rotations, translations = self.rigid_motion(t_s)
        return np.einsum("tij,kj->tki", rotations, self.body.nodes_m) + translations[:, None]

    def rigid_motion(self, t_s: ArrayLike) -> tuple[Array, Array]:
        """Rotations (T, 3, 3) and translations (T, 3) [m] of `rigid_positions`."""
        times = np.atleast_1d(np.asarray(t_s, dtype=np.float64))
        if not self.grasps:
            return np.tile(np.eye(3), (len(times), 1, 1)), np.zeros((len(times), 3))
        throughout = [grasp for grasp in self.grasps if grasp.holds(self.t_s).all()]
        poses = (throughout or self.grasps)[0].poses
        if len(poses.t_s) > 1 and not throughout:
            times = np.clip(times, poses.t_s[0], poses.t_s[-1])
        return poses.at(times)

    def _carried_back(self, points_m: Array, t_s: Array) -> Array:
        """Where points (M, 3) seen at `t_s` (M,) sit on the body if it was carried rigidly."""
        rotations, translations = self.rigid_motion(t_s)
        return np.einsum("mji,mj->mi", rotations, points_m - translations)

    @property
    def place_sigma_m(self) -> Array:
        """(M,) standard deviation of each marker's place, zero where it is exact."""
        markers = self.markers
        usual = self.nuisance.marker_offset_m or 0.0
        given = np.full(len(markers.names), usual)
        if markers.places_sigma_m is not None:
            own = markers.places_sigma_m
            given = np.where(np.isfinite(own), own, usual)
        body_m = float(np.linalg.norm(np.ptp(self.body.nodes_m, axis=0)))
        return np.where(markers.located, given, body_m)

    def _check_time(self) -> None:
        if len(self.t_s) < 3:
            raise InputError(
                f"{len(self.t_s)} samples in time; at least 3 are needed: check window_s and the "
                "marker file"
            )
        step_s = sample_interval_s(self.t_s, f"t_s of experiment '{self.name}'")
        measured = self.markers.t_s
        if len(measured) != len(self.t_s) or (
            np.abs(measured - self.t_s).max() > STEP_TOLERANCE * step_s
        ):
            raise InputError(
                "the markers' times differ from t_s; align poses and markers to one grid first"
            )
        if self.markers.samples == 0:
            raise InputError("no marker sample is present; check the marker file and window_s")
        for grasp in self.grasps:
            grasp.poses.at(self.t_s[grasp.holds(self.t_s)])

    def _check_nodes(self) -> None:
        n = len(self.body.nodes_m)
        grasped = held_nodes(self.grasps)
        if grasped.size and grasped[-1] >= n:
            raise InputError(f"a grasp holds node {grasped[-1]}, but the body has {n}")
        for what, loads in (("point mass is tied to", self.masses), ("force is on", self.forces)):
            beyond = [load.nodes[-1] for load in loads if load.nodes[-1] >= n]
            if beyond:
                raise InputError(f"a {what} node {beyond[0]}, but the body has {n}")
        if self.markers.placement.node_count != n:
            raise InputError(
                f"the markers were placed on a body of {self.markers.placement.node_count} nodes, "
                f"but this one has {n}"
            )

    def _check_start(self) -> None:
        for key, choices in (("start", Start), ("start_rule", StartRule)):
            if getattr(self, key) not in get_args(choices):
                expected = ", ".join(get_args(choices))
                raise InputError(f"{key} is {getattr(self, key)!r}; expected one of {expected}")
        if not self.loaded_since_s >= 0:
            raise InputError(
                f"loaded_since_s = {self.loaded_since_s:g}; expected a time of zero or more"
            )
        if np.isfinite(self.loaded_since_s) and self.start != "equilibrium":
            raise InputError(
                f"loaded_since_s is given, but start is '{self.start}'; it says how long a body "
                "that starts in equilibrium has been loaded"
            )
        given = self.start_positions_m is not None or self.start_velocities_m_s is not None
        if self.start == "given":
            if self.start_positions_m is None:
                raise InputError("start = 'given' needs start_positions_m")
            if self.start_velocities_m_s is None:
                n = len(self.body.nodes_m)
                vars(self)["start_velocities_m_s"] = _state(np.zeros((n, 3)), n, "velocity")
        elif given:
            raise InputError(f"a starting state is given, but start is '{self.start}'")
        held = np.flatnonzero(self.grasped(self.t_s[:1])[0][0])
        if self.start == "equilibrium" and not _fixes_a_body(self.body.nodes_m[held]):
            raise InputError(
                "start = 'equilibrium' needs at least 3 held nodes that do not lie on one line, "
                "otherwise the body can turn freely and its rest state is not unique; "
                f"{len(held)} nodes are held then. Grasp more nodes, or start 'undeformed'"
            )


def _state(given: ArrayLike | None, nodes: int, name: str) -> Array | None:
    return None if given is None else read_only_floats(given, (nodes, 3), name)


def _fixes_a_body(points_m: Array) -> bool:
    """Whether holding these points leaves no rigid motion."""
    if len(points_m) < 3:
        return False
    extents = np.linalg.svd(points_m - points_m.mean(axis=0), compute_uv=False)
    return bool(extents[1] > _COLLINEAR * extents[0])
