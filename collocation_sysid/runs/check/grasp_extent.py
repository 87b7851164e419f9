"""Whether the grasped nodes reach as far into the body as the box that selects them.

A box that ends between two layers of nodes holds only the nodes inside. If the fingers end where
the box does, the modelled body is free over a longer part than the real one, and its stiffness is
estimated too high: a cantilever's deflection grows with the third to fourth power of its length.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ...fem.meshes.selection import Box
from ...problem import Problem
from ...recording import Experiment, Grasp
from ...statistics.concerns import Concern

# Distance between the end of the box and the outermost held nodes, as a share of the free length,
# from which it is reported: it changes the stiffness in bending by 1.5 to 2 %.
LARGEST_SHARE = 0.005
# Extent of the held nodes along an axis, as a share of the body's, below which they are one layer,
# which a box with some margin selects on purpose.
LAYER_SHARE = 1e-6


def grasp_gaps(experiment: Experiment, grasp: Grasp) -> Iterator[tuple[str, float, float]]:
    """Yield the gaps of a grasp that exceed `LARGEST_SHARE` of the free length: axis, distance [m] of
    the outermost held nodes from the face of the box, and length [m] of the free part of the body
    beyond these nodes.

    None for grasps that are not selected by a box, that hold some axes only (platens and planes of
    symmetry), or whose nodes are one layer along the axis, and for faces of the box beyond which
    there is no body.
    """
    box = grasp.selection
    if not isinstance(box, Box) or len(grasp.axes) < 3:
        return
    points_m = experiment.body.nodes.points_m
    for k, axis in enumerate("xyz"):
        along_m = points_m[:, k]
        held_m = along_m[grasp.nodes]
        if np.ptp(held_m) <= LAYER_SHARE * np.ptp(along_m):
            continue
        for direction, face_m in ((1, box.high_m[k]), (-1, box.low_m[k])):
            reach_m = (direction * held_m).max()
            free_m = (direction * along_m).max() - reach_m
            gap_m = direction * face_m - reach_m
            if LARGEST_SHARE * free_m < gap_m < free_m:
                yield axis, float(gap_m), float(free_m)


def grasp_extent_concerns(problem: Problem) -> list[Concern]:
    """Return a "check" concern for each gap of a grasp, see `grasp_gaps`.

    Empty if the recordings are declared to be simulated (`Problem.is_declared_simulated`), where the grasp
    of the simulation is usually that of the model.
    """
    if problem.is_declared_simulated:
        return []
    return list(_gap_concerns(problem))


def grasp_extent_notes(problem: Problem) -> list[str]:
    """Return the same sentences as notes for recordings that are declared to be simulated;
    otherwise an empty list.
    """
    if not problem.is_declared_simulated:
        return []
    return [concern.message for concern in _gap_concerns(problem)]


def _gap_concerns(problem: Problem) -> Iterator[Concern]:
    """Yield a concern for each gap of the grasps of the fitted recordings of meshed bodies."""
    for experiment in problem.experiments:
        if experiment.validation or experiment.specimen is not None:
            continue
        for grasp in experiment.body_grasps:
            for axis, gap_m, free_m in grasp_gaps(experiment, grasp):
                yield Concern(
                    "description/grasp-extent",
                    "check",
                    data={
                        "experiment": experiment.name,
                        "axis": axis,
                        "gap_mm": 1e3 * gap_m,
                        "free_mm": 1e3 * free_m,
                        "percent": 100 * gap_m / free_m,
                    },
                )
