"""Live estimates of bodies in contact, at rest or with poses that arrive with frames."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Literal

import numpy as np
import pytest
from kit.frames import NO_TIME, frames_of
from kit.problems import nodes_where

import collocation_sysid as cs
from collocation_sysid.extras.live import estimator
from collocation_sysid.extras.live.estimator import LiveEstimator
from collocation_sysid.extras.live.model import model_from_problem

TRUTH = {"young_pa": 1e4, "poisson": 0.3, "gamma_r_s": 0.01, "gamma_m_1_s": 0.3}
UNKNOWN = {"young_pa": cs.Unknown(8e3), "gamma_r_s": cs.Unknown(0.015)}
RUBBING, FRICTION = {"table_friction": 0.4}, {"table_friction": cs.Unknown(0.3)}
EDGE_M, SIGMA_M, SIGMA_N = 0.05, 1e-4, 0.01
UP = np.array([0.0, 0.0, 1.0])


def touching(name: str, nuisance: cs.Nuisance, substeps: int | Literal["auto"] = 1) -> cs.Problem:
    """A block that a gripper presses on a table that rubs and feels, or a ball into it."""
    body = cs.Body(cs.box_mesh((EDGE_M,) * 3, (1, 1, 2)), density_kg_m3=400.0)
    t_s = np.linspace(0.0, 0.24, 16)
    down = np.outer(-0.003 * (1 - np.cos(2 * np.pi * t_s / 0.2)), UP)
    moving = cs.PoseSequence(t_s, down, np.tile((0.0, 0.0, 0.0, 1.0), (16, 1)))
    if name == "table":
        held = cs.Grasp(nodes_where(body, 2, EDGE_M), moving)
        forces = cs.Wrench(t_s, np.zeros((16, 3)), SIGMA_N)
        shape, rubs = cs.Plane(UP, -0.001 * UP), "table_friction"
        touched = cs.Obstacle(shape=shape, name="table", friction=rubs, wrench=forces)
    else:
        held = cs.Grasp(nodes_where(body, 2, 0.0), cs.PoseSequence.fixed())
        ball = cs.Sphere(0.03, np.array([0.02, 0.02, EDGE_M + 0.031]))
        touched = cs.Obstacle(shape=ball, poses=moving, name="ball")
    seen = np.setdiff1d(np.arange(len(body.nodes_m)), held.nodes)
    markers = cs.Markers(t_s, np.zeros((16, len(seen), 3)), SIGMA_M, places_m=body.nodes_m[seen])
    still = cs.Experiment(
        body, t_s, [held, touched], markers, start="undeformed", nuisance=nuisance, name="touching"
    )
    own, sought = ({**RUBBING}, {**FRICTION}) if name == "table" else ({}, {})
    exact, rng = (
        cs.simulate(still, {**TRUTH, **own}, "bdf2", substeps=1),
        np.random.default_rng(0),
    )
    tracks = exact.markers_m + rng.normal(scale=SIGMA_M, size=exact.markers_m.shape)
    seen_there = cs.with_markers(still, tracks)
    if name == "table":
        felt = exact.wrenches[-1][:, :3] + rng.normal(scale=SIGMA_N, size=(16, 3))
        (table,) = seen_there.obstacles
        table = replace(table, wrench=replace(forces, values=felt))
        seen_there = seen_there.with_obstacles([table])
    known = cs.Parameters.from_mapping({**TRUTH, **UNKNOWN, **sought})
    return cs.Problem([seen_there], known, scheme="bdf2", substeps=substeps)


CASES = {
    "table": lambda: touching("table", cs.Nuisance.none(obstacle_offset_m=2e-4)),
    "ball": lambda: touching("ball", cs.Nuisance.none(obstacle_offset_m=2e-4)),
}


@cache
def solved(name: str) -> tuple[cs.Problem, cs.Run]:
    problem = CASES[name]()
    return problem, cs.run(problem, seek_causes=False)


@pytest.mark.long
@pytest.mark.parametrize("name", CASES)
def test_live_contact_ends_where_the_batch_ends(name: str):
    problem, batch = solved(name)
    live = LiveEstimator(problem, NO_TIME)
    live.budget_s = np.inf
    for frame in frames_of(problem, live):
        update = live.process_frame(frame)
    settled = live.finish()
    assert settled is not None
    for parameter in (item.name for item in problem.parameters.free):
        known, last = batch.estimates[parameter], update.estimates[parameter]
        end = settled.estimates[parameter]
        assert abs(last.value - known.value) < 3 * known.statistical_std_error
        assert abs(end.value - known.value) < 1e-3 * known.statistical_std_error
        assert end.statistical_std_error == pytest.approx(known.statistical_std_error, rel=1e-3)


@pytest.mark.long
def test_a_frame_ends_although_each_pass_asks_for_another(monkeypatch):
    monkeypatch.setattr(estimator, "MOST_PASSES", 5)
    problem = touching("table", cs.Nuisance.none(obstacle_offset_m=2e-4), substeps="auto")
    live = LiveEstimator(problem, NO_TIME)
    live.budget_s = np.inf
    for _, frame in zip(range(5), frames_of(problem, live), strict=False):
        update = live.process_frame(frame)
    assert np.isfinite(update.estimates["young_pa"].value)


def test_an_obstacle_whose_delay_is_estimated_is_refused():
    problem = touching("ball", cs.Nuisance.none(obstacle_time_s=1e-3))
    with pytest.raises(
        cs.InputError, match="live estimates do not support an obstacle whose delay is estimated"
    ):
        model_from_problem(problem)
