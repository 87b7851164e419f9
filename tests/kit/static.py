"""Static experiments: a quarter of a block between platens, and a block pressed from its ends."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import collocation_sysid as cs
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


LAW = {"young_pa": 2e4, "poisson": 0.45, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
SIZE_M = (0.08, 0.01, 0.06)


def compressed(
    divisions: tuple[int, int, int], size_m: tuple[float, float, float]
) -> cs.Experiment:
    """Return a block that is compressed along x to three tenths, in plane strain, free above."""
    body = cs.Body(cs.box_mesh(size_m, divisions), density_kg_m3=1000.0)
    t_s = np.arange(15.0)
    way_m = np.outer(np.linspace(0, -0.7 * size_m[0], 15), [1.0, 0.0, 0.0])
    ends = cs.PoseSequence(t_s, way_m, np.tile([0.0, 0.0, 0.0, 1.0], (15, 1)))
    fixed = cs.PoseSequence.fixed()

    def face(axis: int, place_m: float) -> np.ndarray:
        return np.flatnonzero(np.abs(body.nodes_m[:, axis] - place_m) < 1e-9)

    # A slender body is clamped at its ends instead of lying on a smooth plane.
    slender = size_m[2] < size_m[0] / 4
    axes = "xz" if slender else "x"
    grasps = [
        cs.Grasp(face(0, 0.0), fixed, axes=axes),
        cs.Grasp(
            face(0, size_m[0]), ends, axes=axes, wrench=cs.Wrench(t_s, np.zeros((15, 3)), 1.0)
        ),
        cs.Grasp(face(1, 0.0), fixed, axes="y"),
        cs.Grasp(face(1, size_m[1]), fixed, axes="y"),
    ]
    if not slender:
        grasps.append(cs.Grasp(face(2, 0.0), fixed, axes="z"))
    return cs.Experiment(
        body, t_s, grasps, kind="static", gravity_m_s2=(0.0, 0.0, 0.0), nuisance=cs.Nuisance.none()
    )
