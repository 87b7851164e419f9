"""Number of time steps from sample to sample of motions with impacts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import collocation_sysid as cs
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.recording.impact_steps import MOST_IMPACT_STEPS, impact_steps
from collocation_sysid.statistics.assessment import impact_step_concerns

SIGMA_M = 1e-3
DOWN_M_S = np.array([0.0, 0.0, -1.0])
BODY = cs.Body(cs.box_mesh((0.1, 0.1, 0.1), (1, 1, 1)), density_kg_m3=1000.0)
PLACES_M = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.1], [0.05, 0.1, 0.05]])


def passing(body_m_s=DOWN_M_S, obstacle_m_s=(0.0, 0.0, 0.0), hz=100.0, noise=0.0, **changes):
    """A body and a floor that move at constant speeds; by default 10 mm from sample to sample."""
    t_s = np.arange(20) / hz
    upright = np.tile([0.0, 0.0, 0.0, 1.0], (len(t_s), 1))
    poses = cs.PoseSequence(t_s, np.outer(t_s, obstacle_m_s), upright)
    floor = cs.Obstacle(shape=cs.Plane((0, 0, 1), (0, 0, -1.0)), poses=poses, name="floor")
    tracks_m = PLACES_M + np.outer(t_s, body_m_s)[:, None]
    tracks_m = tracks_m + noise * np.random.default_rng(0).normal(size=tracks_m.shape)
    markers = cs.Markers(t_s, tracks_m, SIGMA_M, places_m=PLACES_M)
    fall = cs.Experiment(BODY, t_s, [floor], markers, start="undeformed", name="fall")
    return replace(fall, **changes)


@pytest.mark.parametrize(("hz", "steps"), [(100.0, 10), (200.0, 5), (2000.0, 1), (10.0, 16)])
def test_the_body_moves_by_the_noise_of_its_markers_in_a_step(hz, steps):
    slower = passing(0.975 * DOWN_M_S, hz=hz)
    assert impact_steps(slower) == steps <= MOST_IMPACT_STEPS


def test_noise_is_no_motion():
    assert impact_steps(passing(0.0 * DOWN_M_S, noise=SIGMA_M)) <= 2
    assert impact_steps(passing(0.0 * DOWN_M_S)) == 1


def test_the_motion_relative_to_the_obstacle_counts():
    assert impact_steps(passing(obstacle_m_s=DOWN_M_S)) == 1
    assert impact_steps(passing(0.0 * DOWN_M_S, -0.975 * DOWN_M_S)) == 10


def test_lost_markers_do_not_count():
    fall = passing(0.975 * DOWN_M_S)
    tracks_m = fall.markers.positions_m.copy()
    tracks_m[5:, 1] = np.nan
    tracks_m[8] = np.nan
    assert impact_steps(replace(fall, markers=replace(fall.markers, positions_m=tracks_m))) == 10


def test_a_problem_uses_the_steps_of_impacts_by_default():
    fall = passing(0.975 * DOWN_M_S)
    law = {"young_pa": cs.Unknown(1e5), "poisson": 0.3, "gamma_r_s": 0.01, "gamma_m_1_s": 0.1}
    assert cs.Problem([fall], law).collocation().substeps == 10
    assert cs.Problem([fall], law, substeps=2).collocation().substeps == 2
    free = replace(fall, grasps=())
    assert cs.Problem([free], law).collocation().substeps == 1


@pytest.mark.long
def test_few_stated_steps_are_a_note_and_the_first_reason_of_a_failed_search():
    fall = passing(0.975 * DOWN_M_S)
    assert impact_step_concerns(fall, 5) == []
    law = {"young_pa": cs.Unknown(1e5), "poisson": 0.3, "gamma_r_s": 0.01, "gamma_m_1_s": 0.1}
    run = cs.run(cs.Problem([fall], law, substeps=2), method=ReducedSpace(max_iterations=1))
    assert run.trust.concerns[0].code == "scheme/impacts"
    assert "or state 10" in run.trust.reasons[0]
    assert run.trust.reasons[0] in run.notes
