"""Gravity of the wrong sign."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import collocation_sysid as cs
from collocation_sysid.program.simulation import with_markers

TRUTH = {"young_pa": 1e4, "poisson": 0.3, "gamma_r_s": 5e-3, "gamma_m_1_s": 0.3}


def beam(kind: str) -> cs.Experiment:
    """A beam held at one end, which hangs in motion and stands out to the side at rest."""
    body = cs.Body(cs.box_mesh((0.02, 0.02, 0.1), (1, 1, 5)), density_kg_m3=1000.0, element="tet10")
    held = np.flatnonzero(body.nodes_m[:, 2] > 0.0999)
    t_s = np.arange(3.0) if kind == "static" else np.arange(31) * 0.02
    moves = 0.0 if kind == "static" else 0.01 * np.sin(12 * t_s)
    positions_m = np.outer(moves + 0 * t_s, [1.0, 0.5, 0.0])
    poses = cs.PoseSequence(t_s, positions_m, np.tile([0.0, 0.0, 0.0, 1.0], (len(t_s), 1)))
    places_m = np.array([[x, 0.0, z] for x in (0.003, 0.017) for z in (0.0, 0.03, 0.06)])
    markers = cs.Markers(t_s, np.zeros((len(t_s), 6, 3)), 3e-4, places_m=places_m)
    down = (9.81, 0.0, 0.0) if kind == "static" else (0.0, 0.0, -9.81)
    return cs.Experiment(
        body, t_s, [cs.Grasp(held, poses)], markers, kind=kind, gravity_m_s2=down, name="held"
    )


@pytest.mark.parametrize("kind", ["dynamic", "static"])
def test_gravity_of_the_wrong_sign_is_named(kind: str):
    right = beam(kind)
    tracks_m = cs.simulate(right, TRUTH).markers_m
    tracks_m = tracks_m + 3e-4 * np.random.default_rng(1).normal(size=tracks_m.shape)
    seen = with_markers(right, tracks_m)
    wrong = replace(seen, gravity_m_s2=-right.gravity_m_s2)
    unknown = {"young_pa": cs.Unknown(), "gamma_r_s": cs.Unknown(5e-3)}
    unknown = {"young_pa": cs.Unknown()} if kind == "static" else unknown
    run = cs.run(cs.Problem([wrong], TRUTH | unknown))
    assert run.trust.verdict == "doubtful"
    (cause,) = run.causes
    assert cause.cause == "gravity"
    np.testing.assert_allclose(cause.corrected.gravity_m_s2, right.gravity_m_s2)
