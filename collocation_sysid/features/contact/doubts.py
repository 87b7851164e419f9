"""Misspecification hypotheses about obstacles that contradict their measured loads.

No simulation is needed: contact without adhesion only pushes, friction is within its cone, and the
load of a body that nothing deforms does not change. In static tests without gravity, where the body
is undeformed until something touches it, a load also needs a contact, and deep contact a load.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from ...common.array_types import Array
from ...judge.source import Source
from ...methods.solution import Solution
from ...recording.experiment import Experiment
from ...recording.obstacle import Obstacle, ObstacleForces
from ...recording.obstacle_solids import Plane
from ...statistics.hypothesis import Hypothesis

# Loads in standard deviations of their noise from which on they are loads.
LOADED = 6.0
# Share of the largest load that calibration and axes may be off.
CALIBRATION = 0.1
# Fewest samples that contradict the description.
FEWEST_SAMPLES = 2
# Distance over the body's diagonal that need not be known.
PLACE = 0.05
# Penetration of the undeformed body, over the motion of the obstacle, up to which it does not
# press.
PRESSING = 0.05
# Motion of an obstacle over the body's diagonal that no static test has.
LARGEST_STROKE = 10.0
# Penetration of a solid from which on a node is inside, over the body's diagonal.
DEEP = 0.01
# Largest share of the nodes that may be inside.
MOST_INSIDE = 0.5
# Most samples at which gaps are computed, evenly spread.
MOST_SAMPLES = 30


def obstacle_hypotheses(experiment: Experiment) -> Iterator[Hypothesis]:
    """Yield hypotheses about the obstacles of an experiment; mostly none."""
    for obstacle in experiment.obstacles:
        strokes = list(_long_stroke(experiment, obstacle))
        yield from strokes
        forces = obstacle.find_measured_forces()
        if forces is None or strokes:
            continue
        yield from _pulling(experiment, obstacle, forces)
        yield from _outside_friction_cone(experiment, obstacle, forces)
        if experiment.is_static and not experiment.actuators:
            yield from _undriven_load(experiment, obstacle, forces)
            if not experiment.gravity_m_s2.any():
                yield from _load_without_contact(experiment, obstacle, forces)


def _diagonal_m(experiment: Experiment) -> float:
    nodes_m = experiment.body.nodes.points_m
    return float(np.linalg.norm(np.ptp(nodes_m, axis=0)))


def _subject(experiment: Experiment, obstacle: Obstacle) -> str:
    return f"obstacle '{obstacle.name}' of '{experiment.name}'"


def _noise_n(experiment: Experiment, forces: ObstacleForces) -> float:
    """Return the force that noise and tare explain [N]."""
    tare = experiment.nuisance.tare or 0.0
    return LOADED * float(np.hypot(1.0, tare)) * forces.sigma_n


def _normal_and_tangential_n(obstacle: Obstacle, forces: ObstacleForces) -> tuple[Array, Array]:
    """Return both (S,) at samples with all components; a plane pushes along its positive normal."""
    shape = obstacle.shape
    if not isinstance(shape, Plane):
        return np.zeros(0), np.zeros(0)
    forces_n = forces.rotate_to_world_n()
    complete = np.isfinite(forces_n).all(axis=1)
    rotations, _ = obstacle.poses.at(forces.t_s[complete])
    normals = rotations @ shape.normal
    normal_n = np.sum(forces_n[complete] * normals, axis=1)
    across_n = forces_n[complete] - normal_n[:, None] * normals
    return normal_n, np.linalg.norm(across_n, axis=1)


def _pulling(
    experiment: Experiment, obstacle: Obstacle, forces: ObstacleForces
) -> Iterator[Hypothesis]:
    """Yield a load of a wrong sign or zero, because the obstacle pulls."""
    limit_n = _noise_n(experiment, forces)
    pushing_n, _ = _normal_and_tangential_n(obstacle, forces)
    if not len(pushing_n):
        pushing_n = _load_along_motion_n(experiment, obstacle, forces)
    if not len(pushing_n):
        return
    largest_n = float(np.abs(pushing_n).max())
    pulls = pushing_n < -max(limit_n, CALIBRATION * largest_n)
    if np.count_nonzero(pulls) < FEWEST_SAMPLES:
        return
    data = {
        "pull_n": -float(pushing_n.min()),
        "samples": int(pulls.sum()),
        "of_samples": len(pushing_n),
    }
    yield Hypothesis(
        "obstacle-pull",
        _subject(experiment, obstacle),
        data=data,
        strength=-float(pushing_n.min()) / limit_n,
    )


def _load_along_motion_n(
    experiment: Experiment, obstacle: Obstacle, forces: ObstacleForces
) -> Array:
    """Return the load (S,) on the body along the axis of the world along which an obstacle moves
    most [N], positive in the direction of this motion, thus if the obstacle pushes.

    S counts the samples with this component; others are left out. Empty if the obstacle does not
    move or also moves back along the axis, or the experiment is not static.
    """
    if not experiment.is_static:
        return np.zeros(0)
    _, shifts_m = obstacle.poses.at(forces.t_s)
    stroke_m = shifts_m[-1] - shifts_m[0]
    axis = int(np.abs(stroke_m).argmax())
    monotonic = np.abs(np.diff(shifts_m[:, axis])).sum() <= 1.01 * np.abs(stroke_m[axis])
    if not stroke_m[axis] or not monotonic:
        return np.zeros(0)
    load_n = np.sign(stroke_m[axis]) * forces.rotate_to_world_n()[:, axis]
    return load_n[np.isfinite(load_n)]


def _outside_friction_cone(
    experiment: Experiment, obstacle: Obstacle, forces: ObstacleForces
) -> Iterator[Hypothesis]:
    if isinstance(obstacle.friction, str):
        return
    normal_n, tangential_n = _normal_and_tangential_n(obstacle, forces)
    if not len(normal_n):
        return
    limit_n = _noise_n(experiment, forces)
    excess_n = tangential_n - obstacle.friction * np.maximum(normal_n, 0.0)
    is_loaded = normal_n > limit_n
    outside = is_loaded & (excess_n > limit_n + CALIBRATION * normal_n)
    if np.count_nonzero(outside) < FEWEST_SAMPLES:
        return
    ratio = float(np.max(tangential_n[outside] / normal_n[outside]))
    data = {"ratio": ratio, "stated": float(obstacle.friction)}
    yield Hypothesis(
        "obstacle-friction",
        _subject(experiment, obstacle),
        data=data,
        strength=float(excess_n.max()) / limit_n,
    )


def _undriven_load(
    experiment: Experiment, obstacle: Obstacle, forces: ObstacleForces
) -> Iterator[Hypothesis]:
    """Yield that an obstacle moves, because its load changes and nothing else does."""
    times_s = forces.t_s
    motions = [part for grasp in experiment.grasps for part in grasp.poses.at(times_s)]
    loads = [experiment.declared_node_forces_n(times_s), experiment.point_mass_at_nodes_kg(times_s)]
    changes = any(np.ptp(each, axis=0).max(initial=0.0) > 1e-9 for each in (*motions, *loads))
    forces_n = forces.forces_n
    measured = np.isfinite(forces_n).all(axis=0)
    change_n = float(np.ptp(forces_n[:, measured], axis=0).max(initial=0.0))
    limit_n = 2 * LOADED * forces.sigma_n
    if not changes and change_n > limit_n:
        yield Hypothesis(
            "obstacle-fixed",
            _subject(experiment, obstacle),
            data={"change_n": change_n},
            strength=change_n / limit_n,
        )


def _long_stroke(experiment: Experiment, obstacle: Obstacle) -> Iterator[Hypothesis]:
    if not experiment.is_static:
        return
    stroke_m = _stroke_m(obstacle, experiment.t_s)
    ratio = stroke_m / _diagonal_m(experiment)
    if ratio > LARGEST_STROKE:
        data = {"stroke_m": stroke_m, "size_m": _diagonal_m(experiment)}
        yield Hypothesis(
            "obstacle-stroke", _subject(experiment, obstacle), data=data, strength=ratio
        )


def _stroke_m(obstacle: Obstacle, times_s: Array) -> float:
    """Return the diagonal of the box of an obstacle's shifts at times (S,) [s], in metres."""
    _, shifts_m = obstacle.poses.at(times_s)
    return float(np.linalg.norm(np.ptp(shifts_m, axis=0)))


def _load_without_contact(
    experiment: Experiment, obstacle: Obstacle, forces: ObstacleForces
) -> Iterator[Hypothesis]:
    """Loads are far from the undeformed body, or nothing ever presses."""
    spread = np.linspace(0, len(forces.t_s) - 1, min(len(forces.t_s), MOST_SAMPLES))
    samples = np.unique(spread.astype(int))
    forces_n = forces.forces_n[samples]
    load_n = np.sqrt(np.nansum(forces_n**2, axis=1))
    is_measured = np.isfinite(forces_n).any(axis=1)
    gaps_m = _smallest_gaps_m(experiment, obstacle, times_s=forces.t_s[samples])
    limit_n = _noise_n(experiment, forces)
    far_m = PLACE * _diagonal_m(experiment)
    loaded = is_measured & (load_n > limit_n)
    stroke_m = _stroke_m(obstacle, forces.t_s)
    never_presses = bool(-gaps_m.min() < PRESSING * stroke_m)
    cases = {
        "far": (loaded & (gaps_m > far_m), float(gaps_m.max())),
        "deep": (is_measured & ~loaded & (gaps_m < -far_m), -float(gaps_m.min())),
        "never": (loaded & never_presses, stroke_m),
    }
    for which, (contradicts, distance_m) in cases.items():
        needed = 1 if which == "deep" else FEWEST_SAMPLES
        if loaded.any() and np.count_nonzero(contradicts) >= needed:
            yield Hypothesis(
                f"obstacle-load/{which}",
                _subject(experiment, obstacle),
                data={"by_mm": 1e3 * distance_m},
                strength=distance_m / far_m,
            )
            return


def _smallest_gaps_m(experiment: Experiment, obstacle: Obstacle, times_s: Array) -> Array:
    """Return the smallest gaps (S,) [m] of the rigidly moved surface."""
    body = experiment.body
    triangles = body.mesh.surface
    corners = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1]])
    middles = np.array([[1, 1, 0], [0, 1, 1], [1, 0, 1]]) / 2
    weights = np.vstack([corners, middles, np.full((1, 3), 1 / 3)])
    shapes_m = experiment.rigid_positions(times_s)
    rotations, translations_m = obstacle.poses.at(times_s)
    gaps_m = np.zeros(len(times_s))
    for k, shape_m in enumerate(shapes_m):
        points_m = (weights @ shape_m[triangles]).reshape(-1, 3)
        in_frame_m = (points_m - translations_m[k]) @ rotations[k]
        gaps_m[k] = obstacle.shape.signed_distances_m(in_frame_m).min()
    return gaps_m


def placement_mistakes(experiment: Experiment) -> Iterator[Hypothesis]:
    """Yield hypotheses about parts of a body that no grasp holds, and about planes with the body
    behind them.
    """
    yield from _loose_parts(experiment)
    for obstacle in experiment.obstacles:
        yield from _containing(experiment, obstacle)


def _loose_parts(experiment: Experiment) -> Iterator[Hypothesis]:
    """No grasp holds some of the parts; nothing is known without grasps, or with tendons."""
    cells = experiment.body.cells
    count = len(experiment.body.nodes_m)
    first = np.repeat(cells[:, 0], cells.shape[1] - 1)
    edges = coo_array((np.ones(len(first)), (first, cells[:, 1:].ravel())), shape=(count, count))
    _, labels = connected_components(edges, directed=False)
    parts, sizes = np.unique(labels[np.unique(cells)], return_counts=True)
    grasped_labels = [labels[grasp.nodes] for grasp in experiment.body_grasps]
    loose = (
        ~np.isin(parts, np.concatenate(grasped_labels))
        if grasped_labels
        else np.zeros(len(parts), dtype=bool)
    )
    if loose.any() and not experiment.tendons:
        data = {"parts": len(parts), "loose": int(loose.sum()), "nodes": int(sizes[loose].max())}
        yield Hypothesis("mesh-parts", f"'{experiment.name}'", data=data, strength=float(count))


def _containing(experiment: Experiment, obstacle: Obstacle) -> Iterator[Hypothesis]:
    """Yield the reversed normal of a plane with the whole body behind it."""
    if not isinstance(obstacle.shape, Plane):
        return
    nodes_m = experiment.rigid_positions(experiment.t_s[:1])[
        0, : len(experiment.body.nodes.points_m)
    ]
    rotations, translations_m = obstacle.poses.at(experiment.t_s[:1])
    gaps_m = obstacle.shape.signed_distances_m((nodes_m - translations_m[0]) @ rotations[0])
    deep_m = DEEP * float(np.linalg.norm(np.ptp(nodes_m, axis=0)))
    share = float((gaps_m < -deep_m).mean())
    if share > MOST_INSIDE and not (gaps_m > deep_m).any():
        data = {"obstacle": obstacle.name, "percent": 100 * share}
        of = f"'{experiment.name}'"
        yield Hypothesis("obstacle-normal", of, data=data, strength=100 * share)


def hypotheses(experiment: Experiment) -> tuple[Hypothesis, ...]:
    """Return likely errors in the placement of a body, or else in its obstacles and their loads."""
    return tuple(placement_mistakes(experiment)) or tuple(obstacle_hypotheses(experiment))


def fit_hypotheses(solution: Solution) -> Iterator[Hypothesis]:
    """Yield likely errors in the obstacles of the fitted experiments and their loads."""
    for transcription in solution.collocation.transcriptions:
        yield from obstacle_hypotheses(transcription.experiment)


CONTACT = Source(described=hypotheses, fitted=fit_hypotheses)
