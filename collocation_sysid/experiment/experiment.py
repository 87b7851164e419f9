"""One recording of a body: its grasps, its markers, and the state it starts from."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from ..errors import InputError
from .arrays import FloatArray, IntArray, read_only_floats
from .clock import STEP_TOLERANCE, sample_interval_s
from .grasp import Grasp, held_nodes
from .markers import Markers

if TYPE_CHECKING:
    from ..fem.body import Body

Start = Literal["equilibrium", "undeformed", "given"]
StartRule = Literal["standard", "paper"]

# Held nodes count as collinear when they deviate from a line by less than this part of its length.
_COLLINEAR = 1e-6


@dataclass(frozen=True, eq=False)
class Experiment:
    """What was done to a body and what was measured.

    Parameters
    ----------
    name : str
        For messages and reports.
    body : Body
        Provides `nodes_m`, `cells` and `element`.
    t_s : (T,) array
        At least three evenly spaced times.
    grasps : tuple of Grasp
        No node in two of them.
    markers : Markers
        Tracks at the times `t_s`, at least one sample present.
    gravity_m_s2 : (3,) array
        Acceleration of gravity.
    start : {"equilibrium", "undeformed", "given"}
        State at the first time: at rest under its loads; undeformed and at rest; or as given.
    start_rule : {"standard", "paper"}
        Inertia of the first step: from the starting velocity, or zero acceleration.
    start_positions_m, start_velocities_m_s : (n, 3) arrays, optional
        The state for "given"; at rest if the velocities are left out.
    validation : bool
        Predicted only, not fitted.
    external_force_n : (n, 3) array, optional
        Constant forces on the nodes besides gravity.

    Raises
    ------
    InputError
        If any of this does not hold, naming the experiment.
    """

    name: str
    body: Body
    t_s: FloatArray
    grasps: tuple[Grasp, ...]
    markers: Markers
    gravity_m_s2: FloatArray
    start: Start = "equilibrium"
    start_rule: StartRule = "standard"
    start_positions_m: FloatArray | None = None
    start_velocities_m_s: FloatArray | None = None
    validation: bool = False
    external_force_n: FloatArray | None = None

    def __post_init__(self) -> None:
        try:
            self._freeze()
            self._check_time()
            self._check_nodes()
            self._check_start()
        except InputError as error:
            raise error.located(where=f"experiment '{self.name}'") from error

    @property
    def timestep_s(self) -> float:
        """Time between samples."""
        return self.duration_s / (len(self.t_s) - 1)

    @property
    def duration_s(self) -> float:
        """Time from the first to the last sample."""
        return float(self.t_s[-1] - self.t_s[0])

    @cached_property
    def held_nodes(self) -> IntArray:
        """Grasped nodes, sorted."""
        return held_nodes(self.grasps)

    @cached_property
    def free_nodes(self) -> IntArray:
        """All other nodes, sorted."""
        return np.setdiff1d(np.arange(len(self.body.nodes_m)), self.held_nodes)

    def held_positions(self, t_s: ArrayLike) -> FloatArray:
        """Return where the grasps carry the held nodes at `t_s` (T,), as (T, held, 3) metres.

        Nodes are in the order of `held_nodes`.
        """
        positions = np.empty((np.size(t_s), len(self.held_nodes), 3))
        for grasp in self.grasps:
            rows = np.searchsorted(self.held_nodes, grasp.nodes)
            positions[:, rows] = grasp.poses.carry(self.body.nodes_m[grasp.nodes], t_s)
        return positions

    def rigid_positions(self, t_s: ArrayLike) -> FloatArray:
        """Return all nodes (T, n, 3) as if the first grasp carried the undeformed body rigidly.

        Without a grasp the body stays where it is undeformed.
        """
        if not self.grasps:
            return np.repeat(self.body.nodes_m[None], np.size(t_s), axis=0)
        return self.grasps[0].poses.carry(self.body.nodes_m, t_s)

    def _freeze(self) -> None:
        n = len(self.body.nodes_m)
        arrays = {
            "t_s": read_only_floats(self.t_s, (None,), "t_s"),
            "gravity_m_s2": read_only_floats(self.gravity_m_s2, (3,), "gravity_m_s2"),
        }
        for field in ("start_positions_m", "start_velocities_m_s", "external_force_n"):
            if getattr(self, field) is not None:
                arrays[field] = read_only_floats(getattr(self, field), (n, 3), field)
        for field, array in arrays.items():
            object.__setattr__(self, field, array)
        object.__setattr__(self, "grasps", tuple(self.grasps))

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
            grasp.poses.at(self.t_s)

    def _check_nodes(self) -> None:
        n = len(self.body.nodes_m)
        if self.held_nodes.size and self.held_nodes[-1] >= n:
            raise InputError(f"a grasp holds node {self.held_nodes[-1]}, but the body has {n}")
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
        given = self.start_positions_m is not None or self.start_velocities_m_s is not None
        if self.start == "given":
            if self.start_positions_m is None:
                raise InputError("start = 'given' needs start_positions_m")
            if self.start_velocities_m_s is None:
                at_rest = read_only_floats(np.zeros_like(self.body.nodes_m), (None, 3), "velocity")
                object.__setattr__(self, "start_velocities_m_s", at_rest)
        elif given:
            raise InputError(f"a starting state is given, but start is '{self.start}'")
        if self.start == "equilibrium" and not _fixes_a_body(self.body.nodes_m[self.held_nodes]):
            raise InputError(
                "start = 'equilibrium' needs at least 3 held nodes that do not lie on one line, "
                "otherwise the body can turn freely and its rest state is not unique; "
                f"{len(self.held_nodes)} nodes are held. Grasp more nodes, or start 'undeformed'"
            )


def _fixes_a_body(points_m: FloatArray) -> bool:
    """Whether holding these points leaves no rigid motion."""
    if len(points_m) < 3:
        return False
    extents = np.linalg.svd(points_m - points_m.mean(axis=0), compute_uv=False)
    return bool(extents[1] > _COLLINEAR * extents[0])
