"""An experiment moved to another mesh of its body, by functions that transfer its parts.

`experiment_refinement` and `experiment_coarsening` state these functions for finer and coarser
meshes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from ..common.array_types import Array
from .experiment import Experiment
from .placement import place_markers
from .pressure import Pressure

if TYPE_CHECKING:
    from ..fem.body import Body


def experiment_on_body(
    experiment: Experiment,
    body: Body,
    *,
    move_load: Callable[[Any], Any],
    move_pressure: Callable[[Pressure], Pressure],
    move_state: Callable[[Array], Array],
) -> Experiment:
    """Return the experiment on a body of the same shape with another mesh; obstacles stay.

    Markers are material points: their places on the undeformed body stay, whether they are nodes,
    inside elements or beyond the surface.

    Parameters
    ----------
    experiment : Experiment
        Not modified.
    body : Body
        Body with the other mesh.
    move_load : callable
        ``move_load(load)``: a grasp, point mass or force with its nodes on `body`.
    move_pressure : callable
        ``move_pressure(pressure)``: a pressure with its faces on `body`.
    move_state : callable
        ``move_state(values)``: nodal vectors (n, 3) of the experiment's body at the nodes (m, 3) of
        `body`; called for a given start state only.
    """
    markers = experiment.markers
    placement = place_markers(
        markers.predict_positions(experiment.body.nodes_m),
        body.nodes.points_m,
        body=body,
        attach="embedded",
        max_distance_m=float("inf"),
    )

    def moved_state(values: Array | None) -> Array | None:
        return None if values is None else move_state(values)

    return replace(
        experiment,
        body=body,
        grasps=(*map(move_load, experiment.body_grasps), *experiment.obstacles),
        masses=tuple(map(move_load, experiment.masses)),
        forces=tuple(map(move_load, experiment.forces)),
        pressures=tuple(map(move_pressure, experiment.pressures)),
        markers=replace(markers, placement=placement, places_m=None),
        start_positions_m=moved_state(experiment.start_positions_m),
        start_velocities_m_s=moved_state(experiment.start_velocities_m_s),
    )
