"""A cube on a plate, pressed by an instrumented platen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from collocation_sysid.recording import Experiment, Grasp, PoseSequence
from kit.problems import EDGE_M, IDEAL, hung_cube, nodes_where, vertex_markers
from kit.wrenches import sensing


def pressed(**changes) -> Experiment:
    """A cube on a plate, pressed by a platen on which it slides, at uneven times."""
    body, t_s = hung_cube().body, np.array([0.0, 1.0, 1.5, 4.0])
    below = Grasp(nodes_where(body, 2, 0.0), PoseSequence.fixed())
    way = np.outer([0.0, 1.0, 2.0, 5.0], [0.0, 0.0, -2e-3])
    poses = PoseSequence(t_s, way, np.tile([0.0, 0.0, 0.0, 1.0], (4, 1)), "linear")
    above = Grasp(nodes_where(body, 2, EDGE_M), poses, axes="z")
    markers = vertex_markers(body, nodes_where(body, 0, 0.0), t_s)
    experiment = Experiment(body, t_s, [below, above], markers, kind="static", nuisance=IDEAL)
    return sensing(replace(experiment, **changes), np.array([0.0, 0.5, 1.5, 3.0, 4.0]))
