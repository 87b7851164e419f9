"""Loads that join or leave at a time that is known only within a tolerance."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from kit.problems import GUESS, IDEAL, TRUTH, bar_loaded, box, hung_cube, nodes_where

from collocation_sysid.common.display import plain_text
from collocation_sysid.errors import InputError
from collocation_sysid.fem.schemes import SCHEMES
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.model.nuisance_map import NuisanceMap
from collocation_sysid.pipeline import run, solve
from collocation_sysid.problem import Problem, RolloutOptions, UncertaintyOptions
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.program.simulation import simulate, with_markers
from collocation_sysid.recording import Experiment, Force, Nuisance, PointMass
from collocation_sysid.recording.loads import smooth_ramp
from collocation_sysid.result.run_summary import run_summary
from collocation_sysid.statistics.budget.systematic_effects import Assumptions
from collocation_sysid.statistics.linearised import linearise_fit
from collocation_sysid.statistics.uncertainty import uncertainty_from_fit

TIP = nodes_where(box(), 2, 0.0)
DAMPING = ("gamma_r_s", "gamma_m_1_s")


def loaded(from_s: float, joining_s: float | None = 0.01, steps: int = 24) -> Experiment:
    """A hung cube that a weight joins."""
    nuisance = Nuisance.none(joining_s=joining_s)
    return hung_cube(steps, masses=(PointMass(TIP, 0.01, from_s),), nuisance=nuisance)


def seen(truth_s: float, stated_s: float, joining_s: float | None = 0.01) -> Experiment:
    """What the weight does that joins at one time, of which another is stated."""
    tracks = simulate(loaded(truth_s), TRUTH, "midpoint", substeps=1).markers_m
    return with_markers(loaded(stated_s, joining_s), tracks)


def with_noise(experiment: Experiment, seed: int) -> Experiment:
    tracks, sigma_m = (experiment.markers.positions_m, experiment.markers.sigma_m[:, None])
    noise = np.random.default_rng(seed).normal(size=tracks.shape)
    return with_markers(experiment, tracks + sigma_m * noise)


# What they do


@pytest.mark.parametrize("late", [0.0, 0.17, 0.5, 0.99])
def test_shares_of_nodes_that_join_between_steps_add_up(late: float):
    u = np.arange(-5.0, 6.0) - late
    assert smooth_ramp(u).sum() == pytest.approx(5.5 - late)
    below, above = smooth_ramp(u - 1e-6), smooth_ramp(u + 1e-6)
    hat = np.maximum(0.0, 1 - np.abs(u))
    np.testing.assert_allclose((above - below) / 2e-6, hat, atol=1e-6)


@pytest.mark.parametrize("integrator", ["newmark", *SCHEMES])
def test_markers_that_join_in_free_fall_fall_with_the_body(integrator: str):
    cube = hung_cube(8, start="undeformed", masses=(PointMass(TIP, 0.05, 0.0233),))
    cube = replace(cube, grasps=())
    undamped = {**TRUTH, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
    motion = simulate(cube, undamped, integrator)
    moved = motion.positions_m - cube.body.nodes_m
    assert np.abs(moved).max() > 0.01
    np.testing.assert_allclose(moved, moved[:, :1] + np.zeros_like(moved), atol=1e-10)


def test_a_load_may_leave_again():
    for_a_while = hung_cube(8, masses=(PointMass(TIP, 0.05, 0.02, until_s=0.05),))
    mass = for_a_while.moving_node_mass_kg([0.0, 0.035, 0.07])[:, TIP[0]]
    own = for_a_while.body.node_mass[TIP[0]]
    np.testing.assert_allclose(mass - own, [0.0, 0.05 / len(TIP), 0.0])
    with pytest.raises(InputError, match=r"from 2 s until 1 s; expected from_s < until_s"):
        Force(TIP, [[0.0, 0.0, 1.0]], from_s=2.0, until_s=1.0)


def test_a_load_from_before_the_recording_is_there_from_the_start():
    always, before = (hung_cube(8, masses=(PointMass(TIP, 0.05, t),)) for t in (-np.inf, 0.0))
    t_s = always.t_s
    np.testing.assert_array_equal(always.moving_node_mass_kg(t_s), before.moving_node_mass_kg(t_s))
    assert (
        NuisanceMap.from_experiment(replace(before, nuisance=Nuisance.none(joining_s=0.01))).size
        == 0
    )


def test_the_scheme_keeps_its_order_where_a_mass_joins():
    cube = loaded(0.0634, steps=12)
    fine = simulate(cube, TRUTH, "midpoint", substeps=32).positions_m[-1]
    errors = [
        np.abs(simulate(cube, TRUTH, "midpoint", substeps=n).positions_m[-1] - fine).max()
        for n in (2, 4, 8)
    ]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (orders > 1.7).all()


def test_the_estimated_time_acts_as_a_stated_one():
    bar = bar_loaded(8)
    (transcription,) = Collocation([bar], GUESS).transcriptions
    phi = np.array([0.3, -0.5, 1.3, -0.7, 0.4, 0.9])
    moved, really = (
        transcription.equations_at(GUESS.guess_q, phi).dynamics,
        transcription.corrected_experiment(phi),
    )
    stated = replace(transcription, experiment=replace(really, nuisance=IDEAL)).dynamics
    assert really.masses[0].from_s == pytest.approx(bar.masses[0].from_s + 1.3 * 0.004)
    np.testing.assert_allclose(moved.mass.inertia_kg, stated.mass.inertia_kg, atol=1e-15)
    both = moved.forces, stated.forces
    np.testing.assert_allclose(*(each.mass.inertia_kg for each in both), atol=1e-15)
    np.testing.assert_allclose(*(each.weight.external_n for each in both), atol=1e-15)


# Finding them


@pytest.mark.parametrize("method", ["reduced-space", "interior-point", "shooting"])
def test_the_time_is_found_beside_the_material(method: str):
    cube = seen(0.0634, 0.06)
    precise = replace(cube.markers, sigma_m=np.full(len(cube.markers.names), 1e-5))
    solution = solve(Problem([replace(cube, markers=precise)], GUESS), method)
    assert solution.status.converged
    (part,) = solution.collocation.iterates(solution.z)
    assert 0.01 * part.phi[0] == pytest.approx(0.0034, abs=1e-5)
    np.testing.assert_allclose(solution.theta, list(TRUTH.values()), rtol=1e-3)


def test_errors_of_the_time_have_the_stated_deviation():
    exact, scores = seen(0.0634, 0.06), []
    for seed in range(5):
        collocation = Collocation([with_noise(exact, seed)], GUESS)
        found = ReducedSpace()(collocation)
        fit = linearise_fit(collocation, found.z)
        uncertainty = uncertainty_from_fit(fit, GUESS, found.q)
        (name,) = collocation.transcriptions[0].nuisance.names
        (part,) = collocation.iterates(found.z)
        scores.append((part.phi[0] - 0.34) / uncertainty.nuisance[name])
    # χ² of five, beyond which one in a thousand lies on either side.
    assert 0.21 < np.sum(np.square(scores)) < 20.5


def test_a_time_taken_as_exact_biases_the_damping_with_a_note():
    tracks = [replace(seen(0.0634, 0.0734, j)) for j in (None, 0.01)]
    for k, cube in enumerate(tracks):
        precise = replace(cube.markers, sigma_m=np.full(len(cube.markers.names), 2e-4))
        tracks[k] = with_noise(replace(cube, markers=precise), 1)
    made = RolloutOptions("scheme")  # by which the tracks are made
    exact = UncertaintyOptions(assumptions=Assumptions.exact())
    problems = [Problem([cube], GUESS, rollout=made, uncertainty=exact) for cube in tracks]
    misled, right = (run(problem, seek_causes=False) for problem in problems)
    assert misled.interval("gamma_r_s")[1] < TRUTH["gamma_r_s"]
    assert misled.trust.verdict != "good"
    assert "residuals are not independent noise" in misled.trust.reasons[0]
    for name in DAMPING:
        low, high = right.interval(name)
        assert low < TRUTH[name] < high
    assert not any(
        "residuals are not independent noise" in reason for reason in right.trust.reasons
    )


def test_the_time_is_reported_with_its_error(tmp_path: Path):
    found = run(Problem([with_noise(seen(0.0634, 0.06), 1)], GUESS), seek_causes=False)
    said = " ".join(plain_text(run_summary(found.result, tmp_path, details=True)).split())
    assert re.search(
        r"joining of mass 1 [\d.]+ ± [\d.]+ ms later than 0.06 s \(prior ±10 ms\)", said
    )
    found.save(tmp_path / "run")
    told = json.loads((tmp_path / "run" / "result.json").read_text())["nuisance"]["hung cube"]
    joining = told["joining of mass 1 [s]"]
    assert joining["prior"] == 0.01
    assert abs(joining["value"] - 0.0034) < 4 * joining["std_error"]
