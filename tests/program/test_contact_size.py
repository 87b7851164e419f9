"""The budget entry of the size of a body that touches obstacles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from kit.pokes import DEPTHS_M, FLAT, TRUTH, poked

import collocation_sysid as cs
from collocation_sysid.fem.meshes.mesh import TetMesh
from collocation_sysid.recording import Experiment
from collocation_sysid.statistics.budget.consider_analysis import changed_residuals
from collocation_sysid.statistics.budget.discretisation_error import estimate_changes
from collocation_sysid.statistics.budget.systematic_effects import ASSUMPTIONS
from collocation_sysid.statistics.linearised import linearise_fit

LARGER = 0.01
(BODY_SCALE,) = (row for row in ASSUMPTIONS if row.name == "body_scale")
TOP_M = np.array([0.03, 0.03, 0.03])


def larger(experiment: Experiment, share: float) -> Experiment:
    """Return the experiment with a body that is larger by a share; its top face stays in place."""
    body = experiment.body
    mesh = TetMesh(
        TOP_M + (1 + share) * (body.mesh.points_m - TOP_M), np.array(body.mesh.tetrahedra)
    )
    grown = cs.Body(mesh, density_kg_m3=50.0)
    # Its clamped face moves down as the block grows.
    held, obstacle = experiment.grasps
    return replace(experiment, body=grown, grasps=[held, replace(obstacle, nodes=np.zeros(0, int))])


def solution(experiment: Experiment, forces_n: np.ndarray) -> cs.Solution:
    """Fit E, and the offset of the obstacle, to forces."""
    held, obstacle = experiment.grasps
    assert obstacle.wrench is not None
    read = replace(obstacle, wrench=replace(obstacle.wrench, values=forces_n))
    known = cs.Parameters.from_mapping({**TRUTH, "young_pa": cs.Unknown(TRUTH["young_pa"])})
    return cs.solve(cs.Problem([replace(experiment, grasps=[held, read])], known))


@pytest.mark.parametrize("offset_m", [5e-4, None])
@pytest.mark.parametrize("shape", ["ball", "plate"])
def test_a_larger_body_changes_the_stiffness_as_a_refit_with_a_larger_mesh_does(shape, offset_m):
    stated = poked(place_sigma_m=offset_m, depths_m=0.3 * DEPTHS_M[:8])
    if shape == "plate":
        stated = stated.with_obstacles([replace(stated.obstacles[0], shape=FLAT)])
    forces_n = cs.simulate(stated, TRUTH).wrenches[0][:, :3]
    answer = solution(stated, forces_n)
    fit = linearise_fit(answer.collocation, answer.z)
    effect = changed_residuals(answer.collocation, answer.z, [(BODY_SCALE, LARGER)])
    first_order = float(estimate_changes(fit, effect.blocks)[0, 0])  # of the logarithm of E
    young_pa = [
        solution(larger(stated, way * LARGER), forces_n).parameters["young_pa"] for way in (1, -1)
    ]
    refitted = float(np.log(young_pa[0] / young_pa[1]) / 2)

    assert abs(refitted) < 3 * LARGER
    assert first_order == pytest.approx(refitted, rel=0.2, abs=2e-4)
