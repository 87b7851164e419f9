"""Searches that end before their first step."""

from __future__ import annotations

import numpy as np

import collocation_sysid as cs


def test_a_rod_that_buckles_at_the_start_ends_with_the_reason():
    """Straight, between two hands that are nearer together than it is long: nothing is simulated, so
    that no cause is sought.
    """
    mesh = cs.rod_mesh([[0, 0, 0], [0.6, 0, 0]], cs.CrossSection.round(0.006), sections=7)
    body = cs.Body(mesh, "cable", density_kg_m3=1200.0, rest_shape="stress_free")
    t_s = np.linspace(0.0, 0.2, 5)
    still = np.tile(np.eye(4), (5, 1, 1))
    nearer = still.copy()
    nearer[:, 0, 3] = -0.2
    grasps = [cs.Grasp([0, 1, 2], still), cs.Grasp([18, 19, 20], nearer)]
    markers = cs.Markers(t_s, np.full((5, 1, 3), 0.1), 1e-3, places_m=[[0.3, 0.0, 0.0]])
    stated = {"torsion_n_m2": 3e-4, "axial_n": 200.0, "gamma_r_s": 2e-3, "gamma_m_1_s": 0.3}
    held = cs.Experiment(body, t_s, grasps, markers)
    run = cs.run(cs.Problem([held], stated | {"bending_n_m2": cs.Unknown(1e-3)}))
    assert [each.code for each in run.trust.concerns] == ["solve/lost"]
    assert "loses its stability" in run.trust.concerns[0].message
    assert not run.causes
