"""Problems whose description is wrong in one known way.

Each fault is a function of a correct `Problem` and a random generator, which returns the problem with
this error in its description. `FAULTS` states the hypotheses that name each error correctly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from collocation_sysid.fem.body import Body
from collocation_sysid.fem.meshes.mesh import TetMesh
from collocation_sysid.problem import Problem
from collocation_sysid.program.simulation import with_markers
from collocation_sysid.recording import (
    Experiment,
    Grasp,
    Obstacle,
    Plane,
    PoseSequence,
    Wrench,
)

Rng = np.random.Generator
Change = Callable[[Experiment, Rng], Experiment]
JUMP_M = (0.01, 0.03)
SLIP_M = (0.005, 0.02)


@dataclass(frozen=True)
class Fault:
    """Error in a description, and the codes of the hypotheses that name it correctly."""

    change: Change
    causes: tuple[str, ...]

    def __call__(self, problem: Problem, rng: Rng) -> Problem:
        """The problem with this mistake in every experiment."""
        return replace(
            problem,
            experiments=[self.change(e, rng) for e in problem.experiments],
        )


def _with_poses(
    experiment: Experiment, change: Callable[[PoseSequence], PoseSequence]
) -> Experiment:
    grasps = [
        Grasp(g.nodes, change(g.poses), g.from_s, g.until_s)
        for g in experiment.grasps
    ]
    return replace(experiment, grasps=grasps)


def _with_body(
    experiment: Experiment, points_m: np.ndarray, density: float = 1.0
) -> Experiment:
    """With another mesh, on which grasps and markers keep their nodes."""
    old = experiment.body
    density_kg_m3 = density * old.mass_kg / old.mesh.volume_m3
    mesh = TetMesh(points_m, old.mesh.tetrahedra)
    body = Body(
        mesh,
        old.parts[0].material,
        density_kg_m3=density_kg_m3,
        element=old.element.name,
        damping=old.parts[0].damping,
    )
    return replace(experiment, body=body)


# Units ------------------------------------------------------------------------------------------


def poses_times(factor: float) -> Change:
    """Positions of the poses in another unit."""

    def scaled(poses: PoseSequence) -> PoseSequence:
        return replace(poses, positions_m=factor * poses.positions_m)

    return lambda e, rng: _with_poses(e, scaled)


def markers_times(factor: float) -> Change:
    """Return a change that multiplies all marker positions by a factor."""
    return lambda e, rng: with_markers(e, factor * e.markers.positions_m)


def mesh_times(factor: float) -> Change:
    """The mesh, and the places on it, in another unit."""
    return lambda e, rng: _with_body(e, factor * e.body.mesh.points_m)


def density_times(factor: float) -> Change:
    """A density in g/cm³ (0.001), or a mass in g (1000)."""
    return lambda e, rng: _with_body(e, e.body.mesh.points_m, factor)


# Motion -----------------------------------------------------------------------------------------


def inverted(poses: PoseSequence) -> PoseSequence:
    """The inverse of every pose."""
    turns = Rotation.from_quat(np.array(poses.quaternions_xyzw)).inv()
    return replace(
        poses,
        positions_m=-turns.apply(np.array(poses.positions_m)),
        quaternions_xyzw=turns.as_quat(),
    )


def reordered(places: int) -> Callable[[PoseSequence], PoseSequence]:
    """Quaternions read in the other order: by 1, w first taken for x; by −1 the reverse."""

    def change(poses: PoseSequence) -> PoseSequence:
        return replace(
            poses,
            quaternions_xyzw=np.roll(poses.quaternions_xyzw, places, axis=1),
        )

    return change


def late(lag_s: float) -> Change:
    """The markers' clock late by `lag_s`: what they show at t was at t − lag."""

    def change(experiment: Experiment, rng: Rng) -> Experiment:
        end_s = experiment.t_s[-1] - max(lag_s, 0.0)
        begin_s = experiment.t_s[0] - min(lag_s, 0.0)
        slack = 1e-9
        kept = (experiment.t_s >= begin_s - slack) & (
            experiment.t_s <= end_s + slack
        )
        markers = experiment.markers
        tracks = replace(
            markers,
            t_s=markers.t_s[kept],
            positions_m=markers.positions_m[kept],
        )
        shifted = [
            replace(g, poses=replace(g.poses, t_s=g.poses.t_s - lag_s))
            for g in experiment.grasps
        ]
        return replace(
            experiment, t_s=experiment.t_s[kept], grasps=shifted, markers=tracks
        )

    return change


def jumping(experiment: Experiment, rng: Rng) -> Experiment:
    """Poses that are shifted from a sample on."""
    shift = _direction(rng) * rng.uniform(*JUMP_M)
    from_s = rng.choice(
        experiment.t_s[len(experiment.t_s) // 4 : -len(experiment.t_s) // 4]
    )

    def change(poses: PoseSequence) -> PoseSequence:
        after = (poses.t_s >= from_s - 1e-9)[:, None]
        return replace(poses, positions_m=poses.positions_m + after * shift)

    return _with_poses(experiment, change)


# Frames -----------------------------------------------------------------------------------------


def _frame(rng: Rng) -> tuple[Rotation, np.ndarray]:
    turn = Rotation.from_rotvec(_direction(rng) * rng.uniform(0.5, 2.0))
    return turn, _direction(rng) * rng.uniform(0.05, 0.2)


def in_grippers_frame(experiment: Experiment, rng: Rng) -> Experiment:
    """Poses that map the gripper's own frame."""
    turn, shift_m = _frame(rng)

    def change(poses: PoseSequence) -> PoseSequence:
        turns = Rotation.from_quat(poses.quaternions_xyzw)
        return replace(
            poses,
            positions_m=poses.positions_m + turns.apply(shift_m),
            quaternions_xyzw=(turns * turn).as_quat(),
        )

    return _with_poses(experiment, change)


def in_meshs_frame(experiment: Experiment, rng: Rng) -> Experiment:
    """A mesh that lies elsewhere than the poses take it to."""
    turn, shift_m = _frame(rng)
    return _with_body(
        experiment,
        turn.apply(np.array(experiment.body.mesh.points_m)) + shift_m,
    )


def in_cameras_frame(experiment: Experiment, rng: Rng) -> Experiment:
    """Tracks in the cameras' frame, poses in the robot's."""
    turn, shift_m = _frame(rng)
    tracks = np.array(experiment.markers.positions_m)
    moved = turn.apply(tracks.reshape(-1, 3)).reshape(tracks.shape) + shift_m
    return with_markers(experiment, moved)


# Markers, gravity, grasp ------------------------------------------------------------------------


def exchanged(experiment: Experiment, rng: Rng) -> Experiment:
    """Two markers with each other's track."""
    order = np.arange(len(experiment.markers.names))
    pair = rng.choice(order, 2, replace=False)
    order[pair] = order[pair[::-1]]
    return with_markers(experiment, experiment.markers.positions_m[:, order])


def slipping(experiment: Experiment, rng: Rng) -> Experiment:
    """A marker that slips on the body."""
    t_s = experiment.t_s
    markers = experiment.markers
    k = int(rng.integers(len(t_s) // 4, 3 * len(t_s) // 4))
    rotations, _ = experiment.grasps[0].poses.at(t_s)
    tracks = np.array(markers.positions_m)
    slip_m = _direction(rng) * rng.uniform(*SLIP_M)
    tracks[k:, rng.integers(len(markers.names))] += rotations[k:] @ slip_m
    return with_markers(experiment, tracks)


def other_gravity(experiment: Experiment, rng: Rng) -> Experiment:
    """Gravity along another axis, or with the other sign."""
    given = experiment.gravity_m_s2
    size = np.linalg.norm(given)
    axes = [sign * size * axis for axis in np.eye(3) for sign in (1, -1)]
    others = [axis for axis in axes if not np.allclose(axis, given)]
    return replace(experiment, gravity_m_s2=others[rng.integers(len(others))])


def held_deeper(experiment: Experiment, rng: Rng) -> Experiment:
    """A grasp that holds one layer of nodes too many."""
    grasps = []
    for grasp in experiment.grasps:
        touched = np.isin(experiment.body.cells, grasp.nodes).any(axis=1)
        grasps.append(
            replace(grasp, nodes=np.unique(experiment.body.cells[touched]))
        )
    return replace(experiment, grasps=grasps)


def _direction(rng: Rng) -> np.ndarray:
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)


FRAMES = ("gripper-frame", "mesh-frame")
FAULTS = {
    "poses in mm": Fault(poses_times(1e3), ("length-unit",)),
    "poses in km": Fault(poses_times(1e-3), ("length-unit",)),
    "markers in mm": Fault(markers_times(1e3), ("length-unit",)),
    "markers in km": Fault(markers_times(1e-3), ("length-unit",)),
    "mesh in mm": Fault(mesh_times(1e3), ("length-unit",)),
    "mesh in km": Fault(mesh_times(1e-3), ("length-unit",)),
    "poses inverted": Fault(
        lambda e, rng: _with_poses(e, inverted), ("poses-inverted",)
    ),
    "wxyz as xyzw": Fault(
        lambda e, rng: _with_poses(e, reordered(1)), ("quaternion-order",)
    ),
    "xyzw as wxyz": Fault(
        lambda e, rng: _with_poses(e, reordered(-1)), ("quaternion-order",)
    ),
    "clock 10 ms late": Fault(late(0.01), ("clock",)),
    "clock 30 ms late": Fault(late(0.03), ("clock",)),
    "clock 100 ms late": Fault(late(0.1), ("clock",)),
    "clock 30 ms early": Fault(late(-0.03), ("clock",)),
    "gripper's frame": Fault(in_grippers_frame, FRAMES),
    "mesh's frame": Fault(in_meshs_frame, FRAMES),
    "cameras' frame": Fault(in_cameras_frame, ("camera-frame",)),
    "markers exchanged": Fault(exchanged, ("markers-exchanged",)),
    "gravity": Fault(other_gravity, ("gravity",)),
    "density in g/cm3": Fault(density_times(1e-3), ("density",)),
    "mass in g": Fault(density_times(1e3), ("density",)),
    "grasp one layer deeper": Fault(held_deeper, ("grasp-layer",)),
    "pose jumps": Fault(jumping, ("pose-jump",)),
    "marker slips": Fault(slipping, ("marker-slip",)),
}


# Tracks and bodies that no grasped body has ------------------------------------------------------


def with_track_axes(
    order: tuple[int, ...], signs: tuple[int, ...] = (1, 1, 1)
) -> Change:
    """Tracks with their axes exchanged or reversed."""
    return lambda e, rng: with_markers(
        e, np.array(signs) * e.markers.positions_m[..., list(order)]
    )


def constant(poses: PoseSequence) -> PoseSequence:
    """Return poses that are all equal to the first one."""
    first = slice(0, 1)
    return replace(
        poses,
        positions_m=np.repeat(poses.positions_m[first], len(poses.t_s), axis=0),
        quaternions_xyzw=np.repeat(
            poses.quaternions_xyzw[first], len(poses.t_s), axis=0
        ),
    )


def restarting(experiment: Experiment, rng: Rng) -> Experiment:
    """Tracks of a simulation that grows without bound, fails, and is reset to its first state."""
    tracks = np.array(experiment.markers.positions_m)
    k = int(rng.integers(len(tracks) // 2, 3 * len(tracks) // 4))
    growth = 0.002 * 2.0 ** np.arange(6)
    tracks[k : k + 6] += (
        growth[:, None, None] * np.where(np.arange(6) % 2, 1, -1)[:, None, None]
    )
    tracks[k + 6 : k + 8] = np.nan
    tracks[k + 8 :] = tracks[: len(tracks) - k - 8]
    return with_markers(experiment, tracks)


def torn(experiment: Experiment, rng: Rng) -> Experiment:
    """A mesh whose lower elements share no nodes with the others."""
    body = experiment.body
    cells = np.array(experiment.body.mesh.tetrahedra)
    points_m = np.array(body.mesh.points_m)
    heights_m = points_m[cells].mean(axis=1)[:, 2]
    low = heights_m < np.median(heights_m)
    shared = np.intersect1d(cells[low], cells[~low])
    copies = np.arange(len(points_m))
    copies[shared] = len(points_m) + np.arange(len(shared))
    cells[low] = copies[cells[low]]
    mesh = TetMesh(np.vstack([points_m, points_m[shared]]), cells)
    other = Body(
        mesh,
        body.parts[0].material,
        density_kg_m3=body.mass_kg / body.mesh.volume_m3,
        element=body.element.name,
        damping=body.parts[0].damping,
    )
    places_m = experiment.markers.predict_positions(body.nodes_m)
    markers = replace(
        experiment.markers,
        placement=None,
        located=None,
        places_m=places_m,
        attach="embedded",
    )
    return replace(experiment, body=other, markers=markers)


TRACK_FAULTS = {
    "markers: y and z exchanged": Fault(
        with_track_axes((0, 2, 1)), ("markers-axes",)
    ),
    "markers: mirrored in x": Fault(
        with_track_axes((0, 1, 2), (-1, 1, 1)), ("markers-axes",)
    ),
    "markers: turned by 90 deg": Fault(
        with_track_axes((1, 0, 2), (-1, 1, 1)), ("markers-axes", "camera-frame")
    ),
    "poses constant": Fault(
        lambda e, rng: _with_poses(e, constant), ("poses-constant",)
    ),
    "simulation reset after NaN": Fault(restarting, ("markers-jump", "unlike")),
    "mesh in two parts": Fault(torn, ("mesh-parts",)),
}


# Wrenches -----------------------------------------------------------------------------------------


def wrenches(change: Callable[[Wrench], Wrench]) -> Change:
    """Return a change that applies a function to every measured wrench."""

    def changed(experiment: Experiment, rng: Rng) -> Experiment:
        grasps = [
            grasp
            if grasp.wrench is None
            else replace(grasp, wrench=change(grasp.wrench))
            for grasp in experiment.grasps
        ]
        return replace(experiment, grasps=grasps)

    return changed


def wrench_times(force: float, torque: float) -> Change:
    """Return a change that multiplies the measured forces and torques by factors."""
    factors = np.repeat([force, torque], 3)
    return wrenches(lambda w: replace(w, values=factors * w.values))


def tared(wrench: Wrench) -> Wrench:
    """Zeroed with the body in hand."""
    return replace(
        wrench, values=wrench.values - np.nanmean(wrench.values[:5], axis=0)
    )


def in_other_frame(wrench: Wrench) -> Wrench:
    """Stated in the world's axes if in the grasp's, and the reverse."""
    return replace(
        wrench, frame="world" if wrench.frame == "grasp" else "grasp"
    )


GRAM_FORCE_N = 9.80665e-3
WRENCH_FAULTS = {
    "wrench: sign": Fault(wrench_times(-1, -1), ("wrench-sign",)),
    "wrench: force alone reversed": Fault(
        wrench_times(-1, 1), ("wrench-sign",)
    ),
    "wrench: y and z exchanged": Fault(
        wrenches(lambda w: replace(w, values=w.values[:, [0, 2, 1, 3, 5, 4]])),
        ("wrench-axes",),
    ),
    "wrench: torques in N mm": Fault(wrench_times(1, 1e3), ("wrench-unit",)),
    "wrench: forces in gram-force": Fault(
        wrench_times(1 / GRAM_FORCE_N, 1), ("wrench-unit",)
    ),
    "wrench: gain 20 % too large": Fault(
        wrench_times(1.2, 1.2), ("wrench-gain",)
    ),
    "wrench: 0.1 s late": Fault(
        wrenches(lambda w: replace(w, t_s=w.t_s + 0.1)), ("wrench-clock",)
    ),
    "wrench: other frame": Fault(wrenches(in_other_frame), ("wrench-frame",)),
    "wrench: point off by 50 mm": Fault(
        wrenches(
            lambda w: replace(w, point_m=w.point_m + np.array([0.05, 0, 0]))
        ),
        ("wrench-point",),
    ),
    "wrench: tared with the body": Fault(wrenches(tared), ("wrench-tare",)),
}


# Obstacles ----------------------------------------------------------------------------------------


def obstacles(change: Callable[[Obstacle], Obstacle]) -> Change:
    """Return a change that applies a function to every obstacle."""
    return lambda e, rng: e.with_obstacles(
        [change(each) for each in e.obstacles]
    )


def reversed_normal(obstacle: Obstacle) -> Obstacle:
    """A plane on the other side of which the body is."""
    assert isinstance(obstacle.shape, Plane)
    return replace(
        obstacle, shape=replace(obstacle.shape, normal=-obstacle.shape.normal)
    )
