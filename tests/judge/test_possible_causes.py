"""Causes that are possible, and that predict: frames, sizes of effects, lengths and weights of rods."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hidden_twins import unplaced
from twins import SOFT, twin
from wrong_twins import with_track_axes

import collocation_sysid as cs
from collocation_sysid.problem.new import TEMPLATES
from collocation_sysid.runs.check import misspecification_hypotheses
from collocation_sysid.statistics.budget.effect_estimates import EffectEstimate, effect_concerns


@pytest.mark.parametrize(("order", "signs"), [((0, 2, 1), (1, -1, 1)), ((1, 0, 2), (-1, 1, 1))])
def test_markers_of_a_turned_world_have_no_wrong_unit(order, signs):
    """Without places, tracks that shrink towards the body would fit anywhere."""
    (correct,) = twin("block", SOFT, 1, samples=40).experiments
    seen = replace(correct, markers=unplaced(correct.markers))
    turned = with_track_axes(order, signs)(seen, np.random.default_rng(0))
    unknown = {name: cs.Unknown() for name in SOFT}
    (cause, *_) = misspecification_hypotheses(cs.Problem([turned], unknown))
    assert cause.code == "markers-axes"
    assert not misspecification_hypotheses(cs.Problem([seen], unknown))


def effect(name, needed, surprise):
    return EffectEstimate(name, 0.0, 0.1, needed, 0.1, surprise, needed=needed)


@pytest.mark.parametrize(
    ("name", "needed"),
    [("buoyancy", 33.0), ("density_gradient x", -1.2), ("grip_layer_m", -7.5e-3)],
)
def test_an_effect_of_impossible_size_is_no_cause(name, needed):
    impossible = effect(name, needed, 6.0)
    (concern,) = effect_concerns([impossible])
    assert (concern.code, concern.grade) == ("effect/impossible", "doubtful")
    (concern,) = effect_concerns([impossible, effect("clock_rate", 0.03, 5.8)])
    assert "need a clock rate" in concern.message
    weak = effect("clock_rate", 0.03, 1.0)
    assert effect_concerns([impossible, weak])[0].code == "effect/impossible"
    instead = EffectEstimate.beyond("grip_turn_rad x", 9.0, suffices=True)
    (concern,) = effect_concerns([impossible], [instead])
    assert "need a grip turn" in concern.message
    insufficient = replace(instead, suffices=False)
    assert effect_concerns([impossible], [insufficient])[0].code == "effect/impossible"


def cable(*changes):
    return cs.Problem.read(TEMPLATES / "cable" / "problem.toml", ["object.sections=21", *changes])


@pytest.mark.long
@pytest.mark.parametrize("factor", [0.97, 1.03])
def test_a_wrong_length_of_a_cable_is_one_length_not_several_places(factor):
    places = f"middle = {0.3 * factor!r}, tip = {0.6 * factor!r}"
    changes = f"object.length_m={0.6 * factor!r}", f"experiment.0.markers.s_m={{ {places} }}"
    run = cs.run(cable(*changes))
    assert run.trust.verdict != "good"
    assert "need a length" in run.trust.reasons[0]


@pytest.mark.long
@pytest.mark.parametrize("mass_kg", [4e-3, 8e-3])
def test_a_forgotten_weight_at_the_end_of_a_cable_is_no_place_of_a_marker(mass_kg):
    problem = cable()
    (stated,) = problem.experiments
    nodes = np.arange(len(stated.body.mesh.points_m) - 3, len(stated.body.mesh.points_m))
    heavier = replace(stated, masses=[cs.PointMass(nodes, mass_kg)])
    truth = {"bending_n_m2": 1e-3, "gamma_r_s": 2e-3, "gamma_m_1_s": 0.3}
    truth |= {"torsion_n_m2": 3e-4, "axial_n": 200.0}
    seen = cs.simulate(heavier, truth)
    noise = np.random.default_rng(0).normal(scale=5e-4, size=seen.markers_m.shape)
    (grasp,) = stated.grasps
    blind = replace(stated, grasps=[replace(grasp, wrench=None)])
    recorded = cs.with_markers(blind, seen.markers_m + noise)
    run = cs.run(replace(problem, experiments=[recorded]))
    assert run.trust.verdict == "doubtful"
    assert "place of" not in run.trust.reasons[0]
