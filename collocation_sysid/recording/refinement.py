"""The same recording of a body on a finer mesh."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from ..arrays import Array
from ..fem.refinement import refined_nodes
from .experiment import Experiment
from .placement import place_markers

if TYPE_CHECKING:
    from ..fem.body import Body


def refined(experiment: Experiment, finer: Body) -> Experiment:
    """The experiment with the finer body: held and loaded nodes anew, markers where they were.

    Markers are material points: their places on the undeformed body stay, whether they are nodes,
    inside elements or beyond the surface.
    """
    body, markers = experiment.body, experiment.markers

    def anew(load):
        return replace(load, nodes=refined_nodes(load.nodes, load.selection, body, finer))

    placement = place_markers(
        markers.observe(body.nodes_m), finer.nodes.points_m, finer, "embedded", float("inf")
    )
    return replace(
        experiment,
        body=finer,
        grasps=(*map(anew, experiment.gripping), *experiment.obstacles),
        masses=tuple(map(anew, experiment.masses)),
        forces=tuple(map(anew, experiment.forces)),
        pressures=tuple(pressure.refined(body, finer) for pressure in experiment.pressures),
        markers=replace(markers, placement=placement, places_m=None),
        start_positions_m=_interpolated(experiment.start_positions_m, body, finer),
        start_velocities_m_s=_interpolated(experiment.start_velocities_m_s, body, finer),
    )


def _interpolated(state: Array | None, body: Body, finer: Body) -> Array | None:
    """A field (n, 3) of the nodes at those of the finer body, by the shape functions."""
    if state is None:
        return None
    here_m, there_m = finer.nodes.points_m, body.nodes.points_m
    places = place_markers(here_m, there_m, body, "embedded")
    return (places.weights[:, :, None] * state[places.nodes]).sum(axis=1)
