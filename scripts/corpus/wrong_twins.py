"""Problems whose description is wrong in one known way.

Each fault is a function of a correct `Problem` and a random generator, which returns the problem
with this error in its description. `FAULTS` states the hypotheses that name each error correctly.
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
from collocation_sysid.recording import Experiment, Grasp, Obstacle, Plane, PoseSequence, Wrench

Rng = np.random.Generator
ExperimentChange = Callable[[Experiment, Rng], Experiment]
# Smallest and largest jump of a pose, and slip of a marker [m]: far above the noise.
JUMP_M = (0.01, 0.03)
SLIP_M = (0.005, 0.02)


@dataclass(frozen=True)
class Fault:
    """Error in a description, and the codes of the hypotheses that name it correctly."""

    change: ExperimentChange  # returns the experiment with the error in its description
    # Codes of the correct hypotheses; empty if no hypothesis names this error.
    causes: tuple[str, ...]

    def __call__(self, problem: Problem, rng: Rng) -> Problem:
        """Return the problem with this error in every experiment."""
        return replace(problem, experiments=[self.change(e, rng) for e in problem.experiments])


def _with_poses(
    experiment: Experiment, change: Callable[[PoseSequence], PoseSequence]
) -> Experiment:
    grasps = [Grasp(g.nodes, change(g.poses), g.from_s, g.until_s) for g in experiment.grasps]
    return replace(experiment, grasps=grasps)


def _with_body(experiment: Experiment, points_m: np.ndarray, density: float = 1.0) -> Experiment:
    """Return the experiment with other positions of the mesh points (n, 3) [m].

    Grasps and markers keep their nodes. The density is multiplied by the factor `density`.
    """
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


# Units --------------------------------------------------------------------------------------------


def poses_times(factor: float) -> ExperimentChange:
    """Return a change that multiplies the positions of all poses by a factor, as of another unit."""

    def scaled(poses: PoseSequence) -> PoseSequence:
        return replace(poses, positions_m=factor * poses.positions_m)

    return lambda e, rng: _with_poses(e, scaled)


def markers_times(factor: float) -> ExperimentChange:
    """Return a change that multiplies all marker positions by a factor."""
    return lambda e, rng: with_markers(e, factor * e.markers.positions_m)


def mesh_times(factor: float) -> ExperimentChange:
    """Return a change that multiplies the mesh by a factor, with all places on it, as of another
    unit.
    """
    return lambda e, rng: _with_body(e, factor * e.body.mesh.points_m)


def density_times(factor: float) -> ExperimentChange:
    """Return a change of the density by a factor: 0.001 for g/cm³, 1000 for a mass in g."""
    return lambda e, rng: _with_body(e, e.body.mesh.points_m, factor)


# Motion -------------------------------------------------------------------------------------------


def inverted(poses: PoseSequence) -> PoseSequence:
    """Return the inverse of every pose."""
    rotations = Rotation.from_quat(np.array(poses.quaternions_xyzw)).inv()
    return replace(
        poses,
        positions_m=-rotations.apply(np.array(poses.positions_m)),
        quaternions_xyzw=rotations.as_quat(),
    )


def reordered(places: int) -> Callable[[PoseSequence], PoseSequence]:
    """Return a change that rotates the components of quaternions: by 1 from wxyz, by −1 the
    reverse.
    """

    def change(poses: PoseSequence) -> PoseSequence:
        return replace(poses, quaternions_xyzw=np.roll(poses.quaternions_xyzw, places, axis=1))

    return change


def late(lag_s: float) -> ExperimentChange:
    """Return a change by which the marker clock is late: positions at t were measured at t −
    `lag_s`.
    """

    def change(experiment: Experiment, rng: Rng) -> Experiment:
        end_s = experiment.t_s[-1] - max(lag_s, 0.0)
        begin_s = experiment.t_s[0] - min(lag_s, 0.0)
        slack = 1e-9
        is_recorded = (experiment.t_s >= begin_s - slack) & (experiment.t_s <= end_s + slack)
        markers = experiment.markers
        tracks = replace(
            markers, t_s=markers.t_s[is_recorded], positions_m=markers.positions_m[is_recorded]
        )
        shifted = [
            replace(g, poses=replace(g.poses, t_s=g.poses.t_s - lag_s)) for g in experiment.grasps
        ]
        return replace(experiment, t_s=experiment.t_s[is_recorded], grasps=shifted, markers=tracks)

    return change


def jumping(experiment: Experiment, rng: Rng) -> Experiment:
    """Return the experiment with poses that are shifted from a random sample on."""
    shift = _direction(rng) * rng.uniform(*JUMP_M)
    from_s = rng.choice(experiment.t_s[len(experiment.t_s) // 4 : -len(experiment.t_s) // 4])

    def change(poses: PoseSequence) -> PoseSequence:
        after = (poses.t_s >= from_s - 1e-9)[:, None]
        return replace(poses, positions_m=poses.positions_m + after * shift)

    return _with_poses(experiment, change)


# Frames -------------------------------------------------------------------------------------------


def _frame(rng: Rng) -> tuple[Rotation, np.ndarray]:
    turn = Rotation.from_rotvec(_direction(rng) * rng.uniform(0.5, 2.0))
    return turn, _direction(rng) * rng.uniform(0.05, 0.2)


def in_grippers_frame(experiment: Experiment, rng: Rng) -> Experiment:
    """Return the experiment with the poses of the gripper's own frame in place of those of the
    mesh.
    """
    turn, shift_m = _frame(rng)

    def change(poses: PoseSequence) -> PoseSequence:
        rotations = Rotation.from_quat(poses.quaternions_xyzw)
        return replace(
            poses,
            positions_m=poses.positions_m + rotations.apply(shift_m),
            quaternions_xyzw=(rotations * turn).as_quat(),
        )

    return _with_poses(experiment, change)


def in_meshs_frame(experiment: Experiment, rng: Rng) -> Experiment:
    """Return the experiment with a rotated and shifted mesh, which the poses do not map to the
    body.
    """
    turn, shift_m = _frame(rng)
    return _with_body(experiment, turn.apply(np.array(experiment.body.mesh.points_m)) + shift_m)


def in_cameras_frame(experiment: Experiment, rng: Rng) -> Experiment:
    """Return the experiment with marker tracks in the frame of the cameras, not of the robot."""
    turn, shift_m = _frame(rng)
    tracks = np.array(experiment.markers.positions_m)
    moved = turn.apply(tracks.reshape(-1, 3)).reshape(tracks.shape) + shift_m
    return with_markers(experiment, moved)


# Markers, gravity, grasp --------------------------------------------------------------------------


def exchanged(experiment: Experiment, rng: Rng) -> Experiment:
    """Return the experiment with the tracks of two markers exchanged."""
    order = np.arange(len(experiment.markers.names))
    pair = rng.choice(order, 2, replace=False)
    order[pair] = order[pair[::-1]]
    return with_markers(experiment, experiment.markers.positions_m[:, order])


def slipping(experiment: Experiment, rng: Rng) -> Experiment:
    """Return the experiment with one marker that slips on the body at a random sample."""
    t_s = experiment.t_s
    markers = experiment.markers
    k = int(rng.integers(len(t_s) // 4, 3 * len(t_s) // 4))
    rotations, _ = experiment.grasps[0].poses.at(t_s)
    tracks = np.array(markers.positions_m)
    slip_m = _direction(rng) * rng.uniform(*SLIP_M)
    tracks[k:, rng.integers(len(markers.names))] += rotations[k:] @ slip_m
    return with_markers(experiment, tracks)


def other_gravity(experiment: Experiment, rng: Rng) -> Experiment:
    """Return the experiment with gravity along another axis, or with the other sign."""
    stated_m_s2 = experiment.gravity_m_s2
    size = np.linalg.norm(stated_m_s2)
    axes = [sign * size * axis for axis in np.eye(3) for sign in (1, -1)]
    others = [axis for axis in axes if not np.allclose(axis, stated_m_s2)]
    return replace(experiment, gravity_m_s2=others[rng.integers(len(others))])


def with_deeper_grasp(experiment: Experiment, rng: Rng) -> Experiment:
    """Return the experiment with grasps of one layer of nodes too many."""
    grasps = []
    for grasp in experiment.grasps:
        is_adjacent = np.isin(experiment.body.cells, grasp.nodes).any(axis=1)
        grasps.append(replace(grasp, nodes=np.unique(experiment.body.cells[is_adjacent])))
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
    "poses inverted": Fault(lambda e, rng: _with_poses(e, inverted), ("poses-inverted",)),
    "wxyz as xyzw": Fault(lambda e, rng: _with_poses(e, reordered(1)), ("quaternion-order",)),
    "xyzw as wxyz": Fault(lambda e, rng: _with_poses(e, reordered(-1)), ("quaternion-order",)),
    "clock 20 ms late": Fault(late(0.02), ("clock",)),
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
    "grasp one layer deeper": Fault(with_deeper_grasp, ("grasp-layer",)),
    "pose jumps": Fault(jumping, ()),
    "marker slips": Fault(slipping, ()),
}


# Tracks and meshes that no grasped body can have --------------------------------------------------


def with_track_axes(order: tuple[int, ...], signs: tuple[int, ...] = (1, 1, 1)) -> ExperimentChange:
    """Return a change that takes the axes of tracks in another order, with signs."""
    return lambda e, rng: with_markers(e, np.array(signs) * e.markers.positions_m[..., list(order)])


def constant(poses: PoseSequence) -> PoseSequence:
    """Return poses that are all equal to the first one."""
    first = slice(0, 1)
    return replace(
        poses,
        positions_m=np.repeat(poses.positions_m[first], len(poses.t_s), axis=0),
        quaternions_xyzw=np.repeat(poses.quaternions_xyzw[first], len(poses.t_s), axis=0),
    )


def restarting(experiment: Experiment, rng: Rng) -> Experiment:
    """Return the experiment with tracks that grow without bound, are NaN, and begin again."""
    tracks = np.array(experiment.markers.positions_m)
    k = int(rng.integers(len(tracks) // 2, 3 * len(tracks) // 4))
    growth = 0.002 * 2.0 ** np.arange(6)
    tracks[k : k + 6] += growth[:, None, None] * np.where(np.arange(6) % 2, 1, -1)[:, None, None]
    tracks[k + 6 : k + 8] = np.nan
    tracks[k + 8 :] = tracks[: len(tracks) - k - 8]
    return with_markers(experiment, tracks)


def torn(experiment: Experiment, rng: Rng) -> Experiment:
    """Return the experiment with a mesh whose lower elements share no nodes with the others."""
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
        experiment.markers, placement=None, located=None, places_m=places_m, attach="embedded"
    )
    return replace(experiment, body=other, markers=markers)


TRACK_FAULTS = {
    "markers: y and z exchanged": Fault(with_track_axes((0, 2, 1)), ("markers-axes",)),
    "markers: mirrored in x": Fault(with_track_axes((0, 1, 2), (-1, 1, 1)), ("markers-axes",)),
    "markers: turned by 90 deg": Fault(
        with_track_axes((1, 0, 2), (-1, 1, 1)), ("markers-axes", "camera-frame")
    ),
    "poses constant": Fault(lambda e, rng: _with_poses(e, constant), ()),
    "simulation reset after NaN": Fault(restarting, ()),
    "mesh in two parts": Fault(torn, ()),
}


# Wrenches -----------------------------------------------------------------------------------------


def wrenches(change: Callable[[Wrench], Wrench]) -> ExperimentChange:
    """Return a change that applies a function to every measured wrench."""

    def changed(experiment: Experiment, rng: Rng) -> Experiment:
        grasps = [
            grasp if grasp.wrench is None else replace(grasp, wrench=change(grasp.wrench))
            for grasp in experiment.grasps
        ]
        return replace(experiment, grasps=grasps)

    return changed


def wrench_times(force: float, torque: float) -> ExperimentChange:
    """Return a change that multiplies the measured forces and torques by factors."""
    factors = np.repeat([force, torque], 3)
    return wrenches(lambda w: replace(w, values=factors * w.values))


def tared(wrench: Wrench) -> Wrench:
    """Return a wrench that was zeroed while the gripper held the body."""
    return replace(wrench, values=wrench.values - np.nanmean(wrench.values[:5], axis=0))


def in_other_frame(wrench: Wrench) -> Wrench:
    """Return the wrench with the other frame stated: world in place of grasp, or the reverse."""
    return replace(wrench, frame="world" if wrench.frame == "grasp" else "grasp")


GRAM_FORCE_N = 9.80665e-3
WRENCH_FAULTS = {
    "wrench: sign": Fault(wrench_times(-1, -1), ("sensor-sign",)),
    "wrench: force alone reversed": Fault(wrench_times(-1, 1), ()),
    "wrench: y and z exchanged": Fault(
        wrenches(lambda w: replace(w, values=w.values[:, [0, 2, 1, 3, 5, 4]])), ("sensor-axes",)
    ),
    "wrench: torques in N mm": Fault(wrench_times(1, 1e3), ("sensor-unit",)),
    "wrench: forces in gram-force": Fault(wrench_times(1 / GRAM_FORCE_N, 1), ("sensor-unit",)),
    "wrench: gain 20 % too large": Fault(wrench_times(1.2, 1.2), ()),
    "wrench: 0.1 s late": Fault(wrenches(lambda w: replace(w, t_s=w.t_s + 0.1)), ()),
    "wrench: other frame": Fault(wrenches(in_other_frame), ()),
    "wrench: point off by 50 mm": Fault(
        wrenches(lambda w: replace(w, point_m=w.point_m + np.array([0.05, 0, 0]))), ()
    ),
    "wrench: tared with the body": Fault(wrenches(tared), ()),
}


# Obstacles ----------------------------------------------------------------------------------------


def obstacles(change: Callable[[Obstacle], Obstacle]) -> ExperimentChange:
    """Return a change that applies a function to every obstacle."""
    return lambda e, rng: e.with_obstacles([change(each) for each in e.obstacles])


def reversed_normal(obstacle: Obstacle) -> Obstacle:
    """Return a plane with its normal reversed, so that the body is on the wrong side."""
    assert isinstance(obstacle.shape, Plane)
    return replace(obstacle, shape=replace(obstacle.shape, normal=-obstacle.shape.normal))
