"""Errors in the description of an obstacle, or in its measured load.

Entries of `POKING_FAULTS` are made in a static indentation along z, those of `PLATE_FAULTS` with a
plane.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from wrong_twins import GRAM_FORCE_N, Fault, obstacles, reversed_normal, wrench_times, wrenches

from collocation_sysid.common.array_types import Array
from collocation_sysid.recording import Obstacle, PoseSequence, Sphere, Wrench

MILLIMETRES_PER_METRE = 1e3
# Error of the obstacle's place [m].
MISPLACED_M = 0.005
# Error of the zero of the displacement [m].
STROKE_OFFSET_M = 5e-4
# Index of the sample at which the load was zeroed.
TARED_SAMPLE = 3
# Number of equal parts of the specimen, of which one is modelled by symmetry.
PARTS = 4


def with_ways(change: Callable[[Array], Array]) -> Callable[[Obstacle], Obstacle]:
    """Return the change of the shifts (T, 3) [m] of an obstacle."""

    def changed(obstacle: Obstacle) -> Obstacle:
        poses: PoseSequence = obstacle.poses
        return replace(obstacle, poses=replace(poses, positions_m=change(poses.positions_m)))

    return changed


def with_ball(radius_factor: float = 1.0, shift_m: float = 0.0) -> Callable[[Obstacle], Obstacle]:
    """Return the change of a ball that touches the body from above: its radius, about its lowest
    point, and its height [m].
    """

    def changed(obstacle: Obstacle) -> Obstacle:
        ball = obstacle.shape
        assert isinstance(ball, Sphere)
        radius_m = radius_factor * ball.radius_m
        centre_m = np.array(ball.centre_m)
        centre_m[2] += radius_m - ball.radius_m + shift_m
        return replace(obstacle, shape=Sphere(radius_m, centre_m))

    return changed


def zeroed_in_contact(wrench: Wrench) -> Wrench:
    """Return the load as zeroed while the obstacle pressed on the body."""
    return replace(wrench, values=wrench.values - wrench.values[TARED_SAMPLE])


POKING_FAULTS = {
    "obstacle: load reversed": Fault(wrench_times(-1, -1), ("sign", "obstacle-pull")),
    "obstacle: load in gram-force": Fault(wrench_times(1 / GRAM_FORCE_N, 1), ()),
    "obstacle: load of the whole for a quarter": Fault(wrench_times(PARTS, 1), ()),
    "obstacle: load zeroed in contact": Fault(wrenches(zeroed_in_contact), ("obstacle-pull",)),
    "obstacle: displacement in mm": Fault(
        obstacles(with_ways(lambda ways: MILLIMETRES_PER_METRE * ways)), ()
    ),
    "obstacle: diameter for radius": Fault(obstacles(with_ball(radius_factor=2.0)), ()),
    "obstacle: 5 mm into the body": Fault(obstacles(with_ball(shift_m=-MISPLACED_M)), ()),
    "obstacle: 5 mm away from the body": Fault(obstacles(with_ball(shift_m=MISPLACED_M)), ()),
    "obstacle: stroke begins 0.5 mm late": Fault(
        obstacles(with_ways(lambda ways: ways + STROKE_OFFSET_M * np.eye(3)[2])), ()
    ),
    "obstacle: fixed while it moves": Fault(
        obstacles(with_ways(lambda ways: np.zeros_like(ways))), ()
    ),
    "obstacle: moves along x in place of z": Fault(
        obstacles(with_ways(lambda ways: -ways[:, [2, 1, 0]])), ()
    ),
}
PLATE_FAULTS = {
    "obstacle: normal reversed": Fault(obstacles(reversed_normal), ()),
    "obstacle: friction 0 in place of 0.5": Fault(
        obstacles(lambda each: replace(each, friction=0.0)), ()
    ),
    "obstacle: load of a plate reversed": Fault(wrench_times(-1, -1), ("obstacle-pull", "sign")),
}
