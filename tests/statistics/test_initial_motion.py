"""A body that still swings when the recording begins is named, before and after the solve."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import collocation_sysid as cs
from collocation_sysid.judge.initial_motion import initial_motion_hypotheses
from collocation_sysid.recording import Experiment, Force
from collocation_sysid.runs.check import misspecification_hypotheses

TRUTH = {"young_pa": 1.5e3, "poisson": 0.3, "gamma_r_s": 0.004, "gamma_m_1_s": 0.5}
SIGMA_M = 2e-4


def swing(start: str, rests_s: float = 0.15) -> Experiment:
    """A hanging block, whose hand rests at first and then swings."""
    block = cs.Body(cs.box_mesh((0.04, 0.04, 0.16), (1, 1, 3)), density_kg_m3=40.0)
    t_s = 0.01 * np.arange(70)
    then_s = np.maximum(t_s - rests_s, 0)
    poses = np.tile(np.eye(4), (len(t_s), 1, 1))
    poses[:, 0, 3] = 0.04 * np.sin(14 * then_s) * np.minimum(1, then_s / 0.2) ** 2
    hand = cs.Grasp(cs.Box((-1, -1, 0.159), (1, 1, 1)), poses)
    places_m = [(0.0, 0.0, 0.0), (0.04, 0.0, 0.05), (0.0, 0.04, 0.1)]
    empty = np.zeros((len(t_s), len(places_m), 3))
    markers = cs.Markers(t_s, empty, sigma_m=SIGMA_M, places_m=places_m)
    return cs.Experiment(block, t_s, [hand], markers, name="swing", start=start)


@cache
def _tracks_m(start: str, rests_s: float) -> np.ndarray:
    return cs.simulate(swing(start, rests_s), TRUTH).markers_m


def recorded(start: str, seed: int = 0, rests_s: float = 0.15) -> Experiment:
    """A recording of a block that begins so, stated to begin in equilibrium."""
    tracks_m = _tracks_m(start, rests_s)
    noise = np.random.default_rng(seed).normal(size=tracks_m.shape)
    noisy = cs.with_markers(swing(start, rests_s), tracks_m + SIGMA_M * noise)
    return replace(noisy, start="equilibrium")


def test_a_body_that_swings_before_its_grasp_moves_was_not_at_rest():
    problem = cs.Problem([recorded("undeformed")], dict.fromkeys(TRUTH, cs.Unknown()))
    (cause,) = misspecification_hypotheses(problem)
    assert cause.cause == "not-at-rest"
    assert cause.strength > 2
    assert "in which the grasp moves by 0 mm" in cause.message


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("rests_s", [0.15, 0.0])
def test_a_body_at_rest_is_not_suspected(seed: int, rests_s: float):
    right = recorded("equilibrium", seed, rests_s=rests_s)
    assert not [*initial_motion_hypotheses(right)]


@pytest.mark.parametrize("factor", [0.2, 0.5, 3.0])
def test_a_wrong_sigma_is_no_motion(factor: float):
    right = recorded("equilibrium")
    markers = replace(right.markers, sigma_m=factor * right.markers.sigma_m)
    assert not [*initial_motion_hypotheses(replace(right, markers=markers))]


def test_other_starts_and_changing_loads_explain_a_motion():
    swinging = recorded("undeformed")
    assert [*initial_motion_hypotheses(swinging)]
    stated = replace(swinging, start="undeformed")
    assert not [*initial_motion_hypotheses(stated)]
    pull_n = [[0.0, 0.0, 0.0], [0.0, 0.0, 0.01]]
    nodes = [0]
    pulled = replace(swinging, forces=(Force(nodes, pull_n, [0.0, 0.7]),))
    assert not [*initial_motion_hypotheses(pulled)]
    held = replace(swinging, masses=(cs.PointMass(nodes, 0.001),))
    assert [*initial_motion_hypotheses(held)]


def test_one_reflection_is_no_motion():
    right = recorded("equilibrium")
    tracks_m = right.markers.positions_m.copy()
    tracks_m[3, 1] += 0.02
    assert not [*initial_motion_hypotheses(cs.with_markers(right, tracks_m))]


@pytest.mark.long
def test_initial_motion_is_a_reason_of_the_verdict():
    known = {"poisson": 0.3, "gamma_m_1_s": 0.5}
    unknown = {"young_pa": cs.Unknown(), "gamma_r_s": cs.Unknown()}
    run = cs.run(cs.Problem([recorded("undeformed")], known | unknown))
    assert run.trust.verdict == "doubtful"
    codes = [concern.code for concern in run.trust.concerns]
    assert "description/not-at-rest" in codes
