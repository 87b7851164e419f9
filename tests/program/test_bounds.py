"""Intervals when one mode determines one damping constant and the other is at its bound."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from kit.problems import IDEAL, box, measured_with, nodes_where, times, vertex_markers

from collocation_sysid.model.parameters import Parameter, Parameters
from collocation_sysid.pipeline import run
from collocation_sysid.problem import Problem, RolloutOptions
from collocation_sysid.program.simulation import with_markers
from collocation_sysid.recording import Experiment, Grasp, PoseSequence

TRUTH = {"lambda_pa": 6e3, "mu_pa": 9e3, "gamma_r_s": 0.004, "gamma_m_1_s": 0.5}
SIGMA_M = 3e-4


def let_go(seed: int) -> Experiment:
    """A bar held at one end and let go undeformed under gravity; its tip is seen."""
    body, t_s = box((0.15, 0.03, 0.03), (3, 1, 1), "tet10"), times(60)
    markers = vertex_markers(body, nodes_where(body, 0, 0.15)[:4], t_s)
    grasp = Grasp(nodes_where(body, 0, 0.0), PoseSequence.fixed())
    bar = Experiment(body, t_s, [grasp], markers, start="undeformed", nuisance=IDEAL, name="bar")
    made = measured_with(bar, TRUTH)
    tracks = made.markers.positions_m
    noise = SIGMA_M * np.random.default_rng(seed).normal(size=tracks.shape)
    seen = with_markers(made, tracks + noise)
    return replace(seen, markers=replace(seen.markers, sigma_m=np.full(4, SIGMA_M)))


@pytest.mark.parametrize("seed", [1, pytest.param(4, marks=pytest.mark.slow)])
def test_a_damping_at_its_bound_does_not_make_the_other_falsely_certain(seed):
    free = (
        Parameter("lambda_pa", TRUTH["lambda_pa"], is_fixed=True),
        Parameter("mu_pa", 9e3, 10.0, 1e6),
        Parameter("gamma_r_s", 0.004, 1e-5, 1.0),
    )
    known = Parameter("gamma_m_1_s", 0.01, is_fixed=True)
    bounded = Parameter("gamma_m_1_s", 0.01, 0.01, 100.0)
    experiment = let_go(seed)
    made = RolloutOptions("scheme")  # by which the tracks are made
    wrong, found = (
        run(Problem([experiment], Parameters((*free, last)), rollout=made)).estimates
        for last in (known, bounded)
    )
    assert found["gamma_m_1_s"].at_bound
    truth = TRUTH["gamma_r_s"]
    low, high = wrong["gamma_r_s"].statistical95 or (0, 0)
    assert high < 1.2 * low
    assert not low < truth < high
    low, high = found["gamma_r_s"].statistical95 or (0, 0)
    assert low < truth < high
    assert high > 2 * low
