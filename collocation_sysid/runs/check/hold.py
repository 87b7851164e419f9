"""What a grasp holds: how many nodes, how far they extend, and whether its edge cuts elements."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...arrays import Array
from ...recording.experiment import Experiment
from ...recording.grasp import Grasp

# Of the mean edge: nodes this near the held ones' box belong to it or not by chance.
NEAR = 0.1
ROUND_OFF = 1e-6
# Neighbours of the held nodes are no farther from their box than so many edges.
NEIGHBOURING = 1.5


@dataclass(frozen=True)
class Hold:
    """The nodes of one grasp.

    Attributes
    ----------
    experiment : str
    nodes : int
    low_m, high_m : (3,) corners of the box around them, on the undeformed body
    share : float
        Of all nodes.
    nearly_held : int
        Free nodes beside it that are less than a tenth of an edge beyond one of its faces.
    nearly_free : int
        Held nodes less than a tenth of an edge behind a face that the body goes on beyond, and
        not in it.
    axes : str
        Along which it holds.
    """

    experiment: str
    nodes: int
    low_m: tuple[float, ...]
    high_m: tuple[float, ...]
    share: float
    nearly_held: int
    nearly_free: int
    axes: str = "xyz"


def holds_of(experiment: Experiment, mean_edge_m: float) -> tuple[Hold, ...]:
    """One for each grasp."""
    points_m = experiment.body.nodes_m
    return tuple(_hold(experiment.name, points_m, g, mean_edge_m) for g in experiment.grasps)


def _hold(name: str, points_m: Array, grasp: Grasp, mean_edge_m: float) -> Hold:
    nodes = grasp.nodes
    held, free = points_m[nodes], np.delete(points_m, nodes, axis=0)
    low, high = held.min(axis=0), held.max(axis=0)
    outside_m = np.concatenate([low - free, free - high], axis=1)
    beside = outside_m.max(axis=1, initial=-np.inf) < NEIGHBOURING * mean_edge_m
    # Behind faces of the box that the body goes on beyond, as far as the nearest held node.
    inner = (outside_m > 0).any(axis=0)
    depth_m = np.concatenate([held - low, high - held], axis=1)[:, inner]
    least_m, reach_m = ROUND_OFF * mean_edge_m, NEAR * mean_edge_m
    slightly_outside = (outside_m > least_m) & (outside_m < reach_m) & beside[:, None]
    slightly_inside = (depth_m > least_m) & (depth_m < reach_m)
    return Hold(
        name,
        len(nodes),
        tuple(low.tolist()),
        tuple(high.tolist()),
        len(nodes) / len(points_m),
        int(slightly_outside.any(axis=1).sum()),
        int(slightly_inside.any(axis=1).sum()),
        grasp.axes,
    )


def hold_sentence(hold: Hold) -> str:
    """What a grasp holds."""
    size = " × ".join(f"{1e3 * (b - a):.4g}" for a, b in zip(hold.low_m, hold.high_m, strict=True))
    low = ", ".join(f"{1e3 * x:.4g}" for x in hold.low_m)
    along = "" if hold.axes == "xyz" else f", along {' and '.join(hold.axes)} only"
    return f"{hold.nodes} nodes, {hold.share:.0%} of all, in {size} mm from ({low}) mm on{along}"


def hold_warnings(hold: Hold) -> list[str]:
    """Whether it is a matter of chance which nodes are held."""
    if not hold.nearly_held and not hold.nearly_free:
        return []
    return [
        f"the grasp of '{hold.experiment}' cuts through elements: with its box a tenth of an edge "
        f"larger it holds {hold.nearly_held} nodes more than {hold.nodes}, or as much smaller "
        f"{hold.nearly_free} less, and the stiffness found depends on them; move the edge of "
        "grasp.nodes between layers of nodes, or mesh the body with a layer where the fingers end"
    ]
