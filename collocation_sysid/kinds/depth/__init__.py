"""Depth cameras: concerns about their images, and likely mistakes in their description."""

from __future__ import annotations

from ..kind import Kind, lazy


class DepthCameras(Kind):
    """Depth images and point clouds of the surface."""

    name = "depth"
    declares = "Depth"
    model = lazy("...program.depth.model", "DepthModel")
    messages = lazy(".concerns", "MESSAGES")
    require_valid = lazy(".poses", "require_depth_units")
    concerns = lazy(".concerns", "concerns")
    simulation_concerns = lazy(".concerns", "simulation_concerns")
    notes = lazy(".concerns", "notes")
    described = lazy(".poses", "camera_hypotheses")
    fitted = lazy(".concerns", "fit_hypotheses")


KIND = DepthCameras()
