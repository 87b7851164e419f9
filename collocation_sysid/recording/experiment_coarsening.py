"""An experiment moved to a coarser mesh of its body, as a start for a search on a large body."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from .experiment import Experiment
from .experiment_on_body import experiment_on_body
from .pressure import Pressure

if TYPE_CHECKING:
    from ..common.array_types import Index
    from ..fem.coarse_body import CoarseBody


def node_sets(experiment: Experiment) -> list[Index]:
    """Return the node sets of the experiment that a coarse mesh must preserve: those of grasps,
    point masses and forces, and the corners of the faces of pressures.
    """
    loads = (*experiment.body_grasps, *experiment.masses, *experiment.forces)
    return [
        *(load.nodes for load in loads),
        *(each.require_measure().faces[:, :3].ravel() for each in experiment.pressures),
    ]


def coarse_experiment(experiment: Experiment, relation: CoarseBody) -> Experiment:
    """Return the experiment on the coarse body of a relation.

    Grasps and loads act on the corresponding nodes and faces. Markers, the points of tendons and
    those of custom sensors are material points: their places on the undeformed body stay. A given
    start state is that of the corresponding nodes.

    Parameters
    ----------
    experiment : Experiment
        Experiment on `relation.body`, or on that body with frames of obstacles.

    Raises
    ------
    InputError
        If the coarse body lacks what the experiment needs, such as a face of a pressure.
    """

    def on_coarse_nodes(load):
        return replace(load, nodes=relation.coarse_nodes(load.nodes))

    return experiment_on_body(
        experiment,
        relation.coarse,
        move_load=on_coarse_nodes,
        move_pressure=lambda pressure: _coarse_pressure(pressure, relation),
        move_state=relation.coarse_values,
    )


def _coarse_pressure(pressure: Pressure, relation: CoarseBody) -> Pressure:
    """Return the pressure on the coarse body; named selections become faces."""
    corners = pressure.require_measure().faces[:, :3]
    return replace(pressure, faces=relation.coarse_faces(corners), body_measure=None)
