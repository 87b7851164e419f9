"""Likely mistakes in the description of depth cameras: poses, times, images and matrices."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ...common.array_types import Array, root_mean
from ...judge.source import SimulatedCheck, Source
from ...methods.solution import Solution
from ...methods.starts.stiffness_scan import typical_constants
from ...problem import Problem
from ...program.collocation import ExperimentIterate
from ...program.depth.comparison import depth_residuals
from ...statistics.hypothesis import Hypothesis, rank
from .images import camera_image_hypotheses
from .poses import camera_hypotheses
from .times import camera_clock_hypotheses

# RMS distance of depth points in standard deviations up to which there is nothing to explain: noise
# along the normal is rarely known better.
LARGEST_NOISE = 1.5
# Most nodes of a body whose equilibria for many stiffnesses take seconds.
NODES = 2000


# Concerns -----------------------------------------------------------------------------------------


def simulated_hypotheses(check: SimulatedCheck) -> tuple[Sequence[Hypothesis], Sequence[str]]:
    """Return likely errors of images, and a note if equilibria of large bodies were left out;
    nothing without cameras, or if another error explains a recording.
    """
    experiments = check.problem.experiments
    has_images = any(each.depths for each in experiments)
    if not has_images or not may_be_images(check.causes):
        return (), ()
    check.report_progress("comparing depth images with equilibria and motion")
    hypotheses = depth_image_hypotheses(
        check.problem, check.parts, most_nodes=None if check.is_full else NODES
    )
    is_omitted = not check.is_full and any(
        each.depths and len(each.body.nodes_m) > NODES for each in experiments
    )
    note = (
        "depth images were not compared with equilibria of many stiffnesses, which takes long for "
        f"more than {NODES} nodes; check --full does it"
    )
    return hypotheses, (note,) * is_omitted


def may_be_images(causes: Sequence[Hypothesis]) -> bool:
    """Return whether depth images may be described wrongly: no other cause explains a
    recording, although a camera may see hardly anything of the body.
    """
    return all(cause.code == "camera" for cause in causes)


def depth_image_hypotheses(
    problem: Problem, parts: Sequence[ExperimentIterate], most_nodes: int | None = NODES
) -> tuple[Hypothesis, ...]:
    """Return likely errors of times, order, orientation and matrices of depth images.

    Parameters
    ----------
    parts : sequence of ExperimentIterate
        Experiments simulated at the guess.
    most_nodes : int or None
        Largest bodies whose equilibria for many stiffnesses are computed; None for any size.
    """
    constants = typical_constants(problem.parameters)
    clocks = (cause for part in parts for cause in camera_clock_hypotheses(part))
    shapes = (
        cause
        for e in problem.experiments
        if most_nodes is None or len(e.body.nodes_m) <= most_nodes
        for cause in camera_image_hypotheses(e, constants)
    )
    return rank((*clocks, *shapes))


def fit_hypotheses(solution: Solution) -> Iterator[Hypothesis]:
    """Yield hypotheses about the cameras of those experiments that do not fit."""
    for part in solution.parts:
        if not any(
            _misses_surface(
                residual.signed_distances_m(observation, part.phi)
                / residual.correspondences.camera.depth.sigma_m
            )
            for residual, observation in depth_residuals(part)
        ):
            continue
        experiment = part.transcription.experiment
        yield from camera_hypotheses(experiment)
        yield from camera_clock_hypotheses(part)
        yield from camera_image_hypotheses(experiment, solution.parameters)


def _misses_surface(distances: Array) -> bool:
    """Whether distances in σ are larger than noise, or none is compared."""
    compared = distances[np.isfinite(distances)]
    return not len(compared) or root_mean(compared**2) > LARGEST_NOISE


CAMERAS = Source(described=camera_hypotheses, simulated=simulated_hypotheses, fitted=fit_hypotheses)
