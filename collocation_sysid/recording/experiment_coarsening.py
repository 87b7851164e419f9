"""An experiment moved to a coarser mesh of its body, as a start for a search on a large body."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from .experiment import Experiment
from .placement import place_markers
from .pressure import Pressure

if TYPE_CHECKING:
    from ..common.array_types import Array, Index
    from ..fem.coarse_body import CoarseBody


def node_sets(experiment: Experiment) -> list[Index]:
    """Return the node sets of the experiment that a coarse mesh must preserve: those of grasps, point
    masses and forces, and the corners of the faces of pressures.
    """
    loads = (
        *experiment.body_grasps,
        *experiment.masses,
        *experiment.forces,
    )
    return [
        *(load.nodes for load in loads),
        *(each.measure.faces[:, :3].ravel() for each in experiment.pressures),
    ]


def coarse_experiment(
    experiment: Experiment, relation: CoarseBody
) -> Experiment:
    """Return the experiment on the coarse body of a relation.

    Grasps and loads act on the corresponding nodes and faces. Markers, the points of tendons and
    those of custom sensors are material points: their places on the undeformed body stay. A given
    start state is that of the corresponding nodes.

    Parameters
    ----------
    experiment : Experiment
        Experiment on `relation.body`, or on that body with frames of obstacles.
    relation : CoarseBody

    Raises
    ------
    InputError
        If the coarse body lacks what the experiment needs, such as a face of a pressure.
    """
    body = experiment.body
    coarse = relation.coarse
    markers = experiment.markers

    def on_coarse_nodes(load):
        """Return a grasp, point mass or force with its nodes on the coarse body."""
        return replace(load, nodes=relation.coarse_nodes(load.nodes))

    placement = place_markers(
        markers.predict_positions(body.nodes_m),
        coarse.nodes.points_m,
        body=coarse,
        attach="embedded",
        max_distance_m=float("inf"),
    )
    return replace(
        experiment,
        body=coarse,
        grasps=(
            *map(on_coarse_nodes, experiment.body_grasps),
            *experiment.obstacles,
        ),
        masses=tuple(map(on_coarse_nodes, experiment.masses)),
        forces=tuple(map(on_coarse_nodes, experiment.forces)),
        pressures=tuple(
            _coarse_pressure(each, relation) for each in experiment.pressures
        ),
        markers=replace(markers, placement=placement, places_m=None),
        start_positions_m=_coarse_state(experiment.start_positions_m, relation),
        start_velocities_m_s=_coarse_state(
            experiment.start_velocities_m_s, relation
        ),
    )


def _coarse_pressure(pressure: Pressure, relation: CoarseBody) -> Pressure:
    """Return the pressure on the coarse body; a selection by name becomes the corresponding faces,
    as the coarse mesh has no arrays and face sets.
    """
    corners = pressure.measure.faces[:, :3]
    return replace(
        pressure, faces=relation.coarse_faces(corners), body_measure=None
    )


def _coarse_state(state: Array | None, relation: CoarseBody) -> Array | None:
    """Return nodal vectors (n, 3) at the nodes of the coarse body, (m, 3); None for None."""
    return None if state is None else relation.coarse_values(state)
