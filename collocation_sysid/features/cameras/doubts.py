"""Likely mistakes in the description of depth cameras: poses and units (`poses`)."""

from __future__ import annotations

from collections.abc import Iterator

from ...judge.source import Source
from ...methods.solution import Solution
from ...recording.depth_camera import Depth
from ...statistics.hypothesis import Hypothesis
from .poses import camera_hypotheses


def fit_hypotheses(solution: Solution) -> Iterator[Hypothesis]:
    """Yield likely mistakes of the cameras of a fit."""
    for part in solution.parts:
        yield from camera_hypotheses(part.transcription.experiment)


CAMERAS = Source(Depth, described=camera_hypotheses, fitted=fit_hypotheses)
