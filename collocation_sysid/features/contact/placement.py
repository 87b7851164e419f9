"""Misspecification hypotheses about the placement of a body: loose parts, and bodies inside
obstacles.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from ...recording.experiment import Experiment
from ...recording.obstacle import Obstacle
from ...recording.obstacle_solids import Plane
from ...statistics.misspecification.misspecification_hypothesis import Hypothesis

# Penetration of a solid from which on a node is inside, over the body's diagonal.
DEEP = 0.01
# Largest share of the nodes that may be inside.
MOST_INSIDE = 0.5


def placement_mistakes(experiment: Experiment) -> Iterator[Hypothesis]:
    """Yield hypotheses about parts of a body that no grasp holds, and about each obstacle that
    contains more than half of it; they need no further test.
    """
    yield from _loose_parts(experiment)
    for obstacle in experiment.obstacles:
        yield from _containing(experiment, obstacle)


def _loose_parts(experiment: Experiment) -> Iterator[Hypothesis]:
    """Yield the hypothesis that the mesh has unconnected parts, some of which no grasp holds;
    nothing if all are held, without grasps, or with tendons.
    """
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
    """Yield the hypothesis that an obstacle contains more than `MOST_INSIDE` of the nodes of the
    undeformed body at the first time.

    If the obstacle is a plane with the whole body behind it, its normal is blamed
    ("obstacle-normal"), else its place ("obstacle-place").
    """
    nodes_m = experiment.rigid_positions(experiment.t_s[:1])[
        0, : len(experiment.body.nodes.points_m)
    ]
    rotations, translations_m = obstacle.poses.at(experiment.t_s[:1])
    gaps_m = obstacle.shape.signed_distances_m((nodes_m - translations_m[0]) @ rotations[0])
    deep_m = DEEP * float(np.linalg.norm(np.ptp(nodes_m, axis=0)))
    share = float((gaps_m < -deep_m).mean())
    if share <= MOST_INSIDE:
        return
    reversible = isinstance(obstacle.shape, Plane) and not (gaps_m > deep_m).any()
    code = "obstacle-normal" if reversible else "obstacle-place"
    data = {"obstacle": obstacle.name, "percent": 100 * share}
    yield Hypothesis(code, f"'{experiment.name}'", data=data, strength=100 * share)
