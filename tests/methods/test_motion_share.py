"""First parts of recordings by the motion in them, and searches of recordings that begin at rest."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from kit.problems import GUESS, TRUTH, hung_cube, measured, relative_errors

from collocation_sysid import Experiment, PoseSequence, Problem, Unknown, solve
from collocation_sysid.methods.horizon import motion_shares, rows_of_share
from collocation_sysid.methods.options import FEWEST
from collocation_sysid.methods.starts.stiffness_scan import TrialSimulation
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.program.simulation import with_markers
from collocation_sysid.recording import Grasp

REST, MOVED = 30, 20


@cache
def rested(noise_m: float = 0.0) -> Experiment:
    """A hung cube that rests, is swayed, swings out and rests."""
    cube = hung_cube(2 * REST + MOVED)
    t_s = cube.t_s
    share = np.clip((np.arange(len(t_s)) - REST) / MOVED, 0, 1)
    shift_m = np.outer(np.sin(2 * np.pi * share) ** 2, [0.05, 0.03, 0.0])
    turns = np.tile([0.0, 0.0, 0.0, 1.0], (len(t_s), 1))
    grasp = Grasp(cube.grasps[0].nodes, PoseSequence(t_s, shift_m, turns))
    made = measured(replace(cube, grasps=[grasp]))
    tracks_m = made.markers.positions_m
    noise = np.random.default_rng(0).normal(size=tracks_m.shape)
    return with_markers(made, tracks_m + noise_m * noise)


@pytest.mark.parametrize("noise_m", [0.0, 1e-3])
def test_a_share_of_a_recording_is_one_of_its_motion(noise_m: float):
    (motion,) = motion_shares(Collocation([rested(noise_m)], GUESS))
    first, half = rows_of_share(motion, 0.25), rows_of_share(motion, 0.5)
    assert REST < first < half < REST + 1.5 * MOVED
    assert rows_of_share(motion, 1.0) == len(motion)


def test_a_recording_without_motion_is_divided_by_time():
    cube = hung_cube(40)
    still = replace(cube, grasps=[Grasp(cube.grasps[0].nodes, PoseSequence.fixed())])
    (motion,) = motion_shares(Collocation([still], GUESS))
    np.testing.assert_allclose(motion, np.arange(1, 42) / 41)
    assert rows_of_share(motion, 1e-9) == FEWEST


def test_a_scan_sees_the_motion():
    collocation = Collocation([rested()], GUESS)
    (rows,) = TrialSimulation(collocation).rows
    assert rows > REST


@pytest.mark.parametrize("guess", [None, 0.1, 10.0])
def test_a_recording_that_begins_at_rest_is_solved(guess: float | None):
    given = {
        name: Unknown(guess and guess * TRUTH[name]) if name.endswith("pa") else Unknown()
        for name in TRUTH
    }
    solution = solve(Problem([rested()], given, scheme="midpoint", substeps=1))
    assert solution.status.converged
    assert np.abs(relative_errors(solution)).max() < 1e-4
