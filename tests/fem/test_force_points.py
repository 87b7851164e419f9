"""Vectors and nodal forces of instances at single nodes."""

from __future__ import annotations

import numpy as np
import pytest

from collocation_sysid.fem.force_points import ForcePoints


@pytest.mark.parametrize("chosen", [None, np.array([2, 0])])
def test_single_nodes_agree_with_weighted_ones(chosen: np.ndarray | None) -> None:
    nodes = np.array([[4], [1], [5]])
    alone = ForcePoints.at_nodes(nodes, 7)
    # The same with a second node of no weight.
    weights = np.broadcast_to([[[1.0, 0.0]]], (3, 1, 2))
    weighted = ForcePoints(np.hstack([nodes, nodes + 1]), weights, node_count=7)
    rng = np.random.default_rng(0)
    x = rng.normal(size=(2, 21))
    forces = rng.normal(size=(3, 2, 3 if chosen is None else 2))
    assert alone.vectors(x, chosen).tolist() == weighted.vectors(x, chosen).tolist()
    assert alone.assemble(forces, chosen).tolist() == weighted.assemble(forces, chosen).tolist()


def test_forces_of_two_instances_at_one_node_add_up() -> None:
    points = ForcePoints.at_nodes(np.array([[1], [1]]), 2)
    assert points.assemble(np.ones((3, 1, 2))).tolist() == [[0.0, 0.0, 0.0, 2.0, 2.0, 2.0]]
