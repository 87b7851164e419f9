"""Bodies at rest do not determine damping, and messages say so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from kit.problems import GUESS, bar_let_go, hung_cube, measured, nodes_where, released_cube

from collocation_sysid.model.parameters import Parameters
from collocation_sysid.pipeline import run
from collocation_sysid.problem import Problem
from collocation_sysid.program.simulation import with_markers
from collocation_sysid.recording import Experiment, Force, Grasp, PoseSequence
from collocation_sysid.runs.check import check_problem
from collocation_sysid.runs.facts import facts, sentences
from collocation_sysid.statistics.scale_identifiability import is_motionless


def hanging(noise_m: float = 5e-4) -> Experiment:
    """The cube hung still from its top face."""
    moving = hung_cube(8, divisions=(1, 1, 2))
    still = measured(replace(moving, grasps=(Grasp(moving.grasps[0].nodes, PoseSequence.fixed()),)))
    tracks = still.markers.positions_m
    noise = noise_m * np.random.default_rng(0).normal(size=tracks.shape)
    return with_markers(replace(still, name="hanging"), tracks + noise)


def test_only_a_constant_recording_is_motionless():
    assert is_motionless(hanging())
    assert is_motionless(hanging(noise_m=1e-3))
    swaying = measured(released_cube(30))  # by half a millimetre
    assert is_motionless(swaying)
    finely = replace(swaying.markers, sigma_m=1e-4 * np.ones(len(swaying.markers.names)))
    for moving in (hung_cube(8), replace(swaying, markers=finely), bar_let_go(8)):
        assert not is_motionless(measured(moving))
    body = hanging().body
    pull = Force(nodes_where(body, 2, 0.0), [[0, 0, 0], [0, 0, 0.01]], [0.0, 0.08])
    assert not is_motionless(replace(hanging(), forces=(pull,)))


def test_stillness_is_reported_before_solving():
    problem = Problem([hanging()], GUESS)
    (note,) = sentences(facts(problem))
    assert "fix gamma_r_s and gamma_m_1_s" in note
    found = check_problem(problem)
    assert note in found.warnings
    assert note not in found.notes
    assert not facts(Problem([hanging(), measured(hung_cube(8))], GUESS))
    fixed = [replace(i, is_fixed="gamma" in i.name) for i in GUESS.items]
    assert not facts(Problem([hanging()], Parameters(tuple(fixed))))


@pytest.mark.parametrize("guess", [0.02, 1e-5])
def test_a_damping_of_which_nothing_is_known_did_not_end_at_its_bound(guess):
    items = tuple(
        replace(i, guess=guess)
        if i.name == "gamma_r_s"
        else replace(i, is_fixed="mu" not in i.name)
        for i in GUESS.items
    )
    found = run(Problem([hanging()], Parameters(items)))
    estimate = found.estimates["gamma_r_s"]
    assert not estimate.at_bound
    assert estimate.statistical95 is None
    assert estimate.reason == "the data do not determine it"
    assert any(
        n.startswith("gamma_r_s is not determined: no information on damping")
        for n in found.all_notes
    )
    assert not any("ended at its" in said for said in (*found.all_notes, *found.trust.reasons))
    assert found.estimates["mu_pa"].statistical_std_error is not None
