"""An experiment moved to a finer mesh of its body, for estimates of the discretisation error."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from ..common.array_types import Array
from ..fem.meshes.refinement import refine_nodes
from .experiment import Experiment
from .experiment_on_body import experiment_on_body
from .placement import place_markers

if TYPE_CHECKING:
    from ..fem.body import Body


def refined_experiment(experiment: Experiment, finer: Body) -> Experiment:
    """Return the experiment on a finer body, a refinement of its own.

    Selections by boxes and balls are evaluated on the finer mesh; of other selections, and of node
    numbers, the middle of an edge belongs to the finer nodes if both ends do. Markers are material
    points: their places on the undeformed body stay, whether they are nodes, inside elements or
    beyond the surface. A given start state is interpolated.

    Parameters
    ----------
    finer : Body
        Refined body of the same shape.
    """
    body = experiment.body

    def refined_load(load):
        return replace(load, nodes=refine_nodes(load.nodes, load.selection, body=body, finer=finer))

    return experiment_on_body(
        experiment,
        finer,
        move_load=refined_load,
        move_pressure=lambda pressure: pressure.on_refined_body(body, finer),
        move_state=lambda state: _interpolated(state, body, finer=finer),
    )


def _interpolated(state: Array, body: Body, finer: Body) -> Array:
    """Return nodal vectors (n, 3) at the nodes (n', 3) of the finer body."""
    here_m = finer.nodes.points_m
    there_m = body.nodes.points_m
    places = place_markers(here_m, there_m, body=body, attach="embedded")
    return (places.weights[:, :, None] * state[places.nodes]).sum(axis=1)
