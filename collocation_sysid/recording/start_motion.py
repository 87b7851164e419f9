"""Motion at the first sample, as forces that held the body until then and an impulse that moved it.

Both are mass times two fields along x, y and z, of the distance d from the grasps over its largest
value: d, and 4 d² − 3 d, which is orthogonal to it. Their static deflections and their velocities are
nearly those of the two lowest modes in each direction.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import KDTree

from ..common.array_types import Array

if TYPE_CHECKING:
    from .experiment import Experiment


def start_forces_n(experiment: Experiment, t_s: Array) -> Array:
    """Return nodal forces (12, T, 3n) [N] at times (T,) by the acceleration [m/s²] at the node farthest
    from the grasps, x, y and z of the first field and then of the second, and by its velocity [m/s].

    The impulse is that of two steps of the time discretisation: its sum and its moment about the
    first time are those of an impulse at the first time.

    Parameters
    ----------
    t_s : (T,) array
        Times at which the forces of a scheme are evaluated, ascending; the impulse acts at the first
        two after the first time of the experiment.
    """
    body = experiment.body
    held = np.concatenate([grasp.nodes for grasp in experiment.body_grasps])
    away_m, _ = KDTree(body.nodes_m[held]).query(body.nodes_m)
    since_s = t_s - experiment.t_s[0]
    course = np.zeros((2, len(t_s)))
    course[0] = since_s <= 0
    (later,) = np.nonzero(since_s > 0)
    if len(later) > 1:
        first_s, second_s = since_s[later[:2]]
        course[1, later[:2]] = np.array([second_s, -first_s]) / (second_s - first_s) ** 2
    share = away_m / away_m.max()
    fields_kg = body.node_mass * np.array([share, 4 * share**2 - 3 * share])
    forces = np.einsum("pt,qn,ij->pqitnj", course, fields_kg, np.eye(3))
    return forces.reshape(12, len(t_s), -1)
