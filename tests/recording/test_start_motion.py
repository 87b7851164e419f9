"""Recordings that begin while the body still swings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from kit.problems import IDEAL, point_markers

import collocation_sysid as cs
from collocation_sysid.kinds.rod.element import CrossSection, rod_mesh
from collocation_sysid.recording.start_motion import start_forces_n
from collocation_sysid.runs.facts import facts, sentences

SIGMA_M = 5e-4
SOLID = {"young_pa": 3e4, "poisson": 0.3, "gamma_r_s": 4e-3, "gamma_m_1_s": 0.5}
CABLE = {
    "bending_n_m2": 2e-3,
    "torsion_n_m2": 2e-3,
    "axial_n": 500.0,
    "gamma_r_s": 1e-2,
    "gamma_m_1_s": 0.0,
}
PRIORS = {"start_acceleration_m_s2": 20.0, "start_velocity_m_s": 2.0}
ESTIMATED = {"rod": ("bending_n_m2", "gamma_r_s"), "solid": ("young_pa", "gamma_r_s")}


def recording(kind: str, first: int = 0, **options) -> cs.Experiment:
    """A body whose gripper moves in the first fifth of a second and again after half a second, from a
    sample on.
    """
    t_s = 0.01 * np.arange(101)
    if kind == "rod":
        mesh = rod_mesh([[0, 0, 0], [0, 0, -0.4]], CrossSection.round(0.004), 9)
        body = cs.Body(mesh, "cable", density_kg_m3=1500.0)
        points_m = np.array([[0, 0, -0.2], [0, 0, -0.3], [0, 0, -0.4]])
        held = np.flatnonzero(body.nodes_m[:, 2] > -0.01)
    else:
        body = cs.Body(cs.box_mesh((0.03, 0.03, 0.24), (1, 1, 6)), density_kg_m3=100.0)
        points_m = np.array([[0, 0, 0.1], [0.03, 0.03, 0.05], [0, 0, 0], [0.03, 0, 0]])
        held = np.flatnonzero(body.nodes_m[:, 2] > 0.239)
    ramps = (np.clip((t_s - begin_s) / 0.2, 0, 1) for begin_s in (0.0, 0.5))
    shift_m = sum(3 * each**2 - 2 * each**3 for each in ramps)
    straight = np.tile([0.0, 0.0, 0.0, 1.0], (len(t_s), 1))
    poses = cs.PoseSequence(t_s, np.outer(shift_m, [0.05, 0.03, 0.0]), straight)
    grasp = cs.Grasp(held, poses)
    markers = point_markers(body, points_m, t_s)
    whole = cs.Experiment(body, t_s, [grasp], markers, name=kind, nuisance=IDEAL)
    exact_m = cs.simulate(whole, CABLE if kind == "rod" else SOLID).markers_m
    tracks = exact_m + SIGMA_M * np.random.default_rng(3).normal(size=exact_m.shape)
    kept = replace(markers, t_s=t_s[first:], positions_m=tracks[first:], sigma_m=SIGMA_M)
    return replace(whole, t_s=t_s[first:], markers=kept, **options)


def solved(kind: str, experiment: cs.Experiment) -> cs.Run:
    constants = dict(CABLE if kind == "rod" else SOLID)
    unknown = {name: cs.Unknown(1.3 * constants[name]) for name in ESTIMATED[kind]}
    exact = cs.UncertaintyOptions(assumptions=cs.Assumptions.exact())
    problem = cs.Problem(
        [experiment], cs.Parameters.from_mapping(constants | unknown), uncertainty=exact
    )
    return cs.run(problem, seek_causes=False)


# Samples from the stop of the gripper to its next motion.
STOPPED = 25


@pytest.mark.parametrize("kind", ESTIMATED)
def test_a_recording_that_begins_in_a_swing_has_the_constants_inside(kind: str):
    moving = recording(kind, STOPPED, start="moving", nuisance=cs.Nuisance.none(**PRIORS))
    run = solved(kind, moving)
    truth = CABLE if kind == "rod" else SOLID
    for name in ESTIMATED[kind]:
        low, high = run.interval(name)
        assert low < truth[name] < high
        assert high - low < 0.4 * truth[name]
    assert run.trust.verdict == "good"
    assert run.rollouts[kind].rms_m < 1.2 * SIGMA_M * np.sqrt(3)


@pytest.mark.parametrize("kind", ESTIMATED)
def test_a_swing_before_the_motion_is_stated_before_any_fit(kind: str):
    constants = CABLE if kind == "rod" else SOLID
    swinging, settled = (
        sentences(facts(cs.Problem([each], cs.Parameters.from_mapping(constants))))
        for each in (recording(kind, STOPPED), recording(kind))
    )
    assert all('start = "moving"' in each for each in swinging)
    assert len(swinging) == 1
    assert not settled


def test_a_body_at_rest_may_be_said_to_move():
    settled = solved("rod", recording("rod"))
    free = solved("rod", recording("rod", start="moving", nuisance=cs.Nuisance.none(**PRIORS)))
    for name in ESTIMATED["rod"]:
        narrow, wide = (np.diff(each.interval(name))[0] for each in (settled, free))
        assert narrow < 1.05 * wide
        assert abs(free.estimates[name].value / settled.estimates[name].value - 1) < 0.05


@pytest.mark.parametrize("steps", [1, 2])
def test_the_impulse_acts_at_the_first_time(steps: int):
    experiment = recording("rod", STOPPED)
    t_s = experiment.t_s[0] + np.r_[0.0, (np.arange(8) + 0.5) * 0.01 / steps]
    forces = start_forces_n(experiment, t_s)
    assert not forces[:6, 1:].any()
    impulse = forces[6:].sum(axis=1) * 0.01 / steps
    moment = np.einsum("itd,t->id", forces[6:], t_s - t_s[0])
    np.testing.assert_allclose(impulse, forces[:6, 0], rtol=1e-9)
    np.testing.assert_allclose(moment, 0.0, atol=1e-12)


def test_a_body_that_nobody_holds_has_no_moving_start():
    with pytest.raises(cs.InputError, match="leave the body no rigid motion"):
        replace(recording("solid"), start="moving", grasps=())
