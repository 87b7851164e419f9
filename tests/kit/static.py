"""A quarter of a block between platens, in static equilibrium."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from collocation_sysid.model.parameters import Parameters
from collocation_sysid.recording import Experiment, Grasp, PoseSequence
from kit.problems import EDGE_M, GUESS, IDEAL, TRUTH, box, nodes_where, vertex_markers

# Uneven, as test benches' are.
TIMES = np.array([0.0, 1.0, 1.5, 4.0])


PRESSED_M = np.array([0.0, -0.01, -0.02, -0.04])


def pressed(t_s=TIMES, z_m=PRESSED_M) -> PoseSequence:
    """Straight down by these heights."""
    positions = np.outer(z_m, [0.0, 0.0, 1.0])
    return PoseSequence(t_s, positions, np.tile([0.0, 0.0, 0.0, 1.0], (len(t_s), 1)), "linear")


def block(platen: str = "z", t_s=TIMES, z_m=PRESSED_M, **changes) -> Experiment:
    """A quarter of a block between platens, which hold it along `platen`."""
    body = changes.pop("body", box())
    fixed = PoseSequence.fixed()
    sliding = platen == "z"
    sides = [nodes_where(body, axis, 0.0) for axis in range(2)]
    ends = [nodes_where(body, 2, height) for height in (0.0, EDGE_M)]
    if not sliding:
        sides = [np.setdiff1d(side, np.concatenate(ends)) for side in sides]
    grasps = [
        Grasp(ends[0], fixed, axes=platen),
        Grasp(ends[1], pressed(t_s, z_m), axes=platen),
        Grasp(sides[0], fixed, axes="x"),
        Grasp(sides[1], fixed, axes="y"),
    ]
    markers = vertex_markers(body, nodes_where(body, 0, EDGE_M), t_s)
    settings = {"gravity_m_s2": (0.0, 0.0, 0.0), "nuisance": IDEAL, "kind": "static"} | changes
    return Experiment(body, t_s, grasps, markers, name="block", **settings)


ELASTIC_ONLY = Parameters(
    (*GUESS.items[:2], *(replace(i, guess=TRUTH[i.name], is_fixed=True) for i in GUESS.items[2:]))
)


HANGING = (0.0, 0.0, -9.81)
