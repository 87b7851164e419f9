"""Equilibria that are not on the stable path to which their loads lead."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from kit.static import LAW, block, compressed

import collocation_sysid as cs
from collocation_sysid.model.dynamics import Dynamics
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.program.forward.initial_equilibrium import equilibrium
from collocation_sysid.program.forward.scheme_simulation import continue_simulation
from collocation_sysid.program.forward.stable_path import find_branch_change
from collocation_sysid.statistics.stability_concerns import branch_concerns

SLENDER_M = (0.12, 0.01, 0.01)
SOFT = {"mu_pa": 1e4, "lambda_pa": 4e4, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}


def collocation_of(experiment: cs.Experiment, values: dict[str, float]) -> Collocation:
    unknown = values | {"gamma_r_s": cs.Unknown(1e-3)}
    return Collocation([experiment], cs.Parameters.from_mapping(unknown), substeps=1)


def dynamics_of(experiment: cs.Experiment, values: dict[str, float]) -> Dynamics:
    theta = experiment.body.theta_from_values(values)
    collocation = collocation_of(experiment, values)
    return collocation.transcriptions[0].dynamics.with_theta(theta)


@cache
def column() -> cs.Experiment:
    """A column between smooth platens in plane strain, whose straight equilibria are homogeneous."""
    lying = compressed((12, 1, 1), SLENDER_M)
    nodes_m = lying.body.nodes_m
    corner = np.flatnonzero((nodes_m[:, 0] < 1e-9) & (nodes_m[:, 2] < 1e-9))
    t_s = np.arange(7.0)
    way_m = np.outer(-0.004 * t_s, [1.0, 0.0, 0.0])
    press = cs.PoseSequence(t_s, way_m, np.tile([0.0, 0.0, 0.0, 1.0], (7, 1)))
    fixed = cs.PoseSequence.fixed()
    left, right, front, back = (grasp.nodes for grasp in lying.grasps[:4])
    grasps = [
        cs.Grasp(left, fixed, axes="x"),
        cs.Grasp(right, press, axes="x", wrench=cs.Wrench(t_s, np.zeros((7, 3)), 1.0)),
        cs.Grasp(front, fixed, axes="y"),
        cs.Grasp(back, fixed, axes="y"),
        cs.Grasp(corner, fixed, axes="z"),
    ]
    return cs.Experiment(
        lying.body,
        t_s,
        grasps,
        kind="static",
        gravity_m_s2=(0.0, 0.0, 0.0),
        nuisance=cs.Nuisance.none(),
    )


@cache
def buckled_m() -> np.ndarray:
    """Equilibria of the column (7, 3n) [m]: straight as long as that is stable, then buckled."""
    straight = column()
    dynamics = dynamics_of(straight, LAW)
    x, failure = continue_simulation(straight, dynamics)
    assert failure is not None
    # A side load leads to the buckled equilibria without one.
    pushed = replace(straight, gravity_m_s2=(0.0, 0.0, -0.5))
    guesses = cs.simulate(pushed, LAW).positions_m.reshape(len(straight.t_s), -1)
    theta = straight.body.theta_from_values(LAW)
    far = [
        equilibrium(straight, theta, float(straight.t_s[k]), start=guesses[k])
        for k in range(len(x), 7)
    ]
    return np.vstack([x, *far])


@pytest.mark.long
def test_equilibria_of_another_branch_are_found_with_the_mode():
    experiment = column()
    dynamics = dynamics_of(experiment, LAW)
    x = buckled_m()
    z_m = x.reshape(len(x), -1, 3)[:, :, 2]
    first = int(np.flatnonzero(np.ptp(z_m, axis=1) > 0.015)[0])
    change = find_branch_change(experiment, dynamics.truncated_to(len(x)), x)
    assert change is not None
    assert change.time_s == experiment.t_s[first]
    assert experiment.t_s[first - 1] <= change.lost_s <= change.time_s
    assert change.loss is not None
    assert "It buckles" in change.describe()
    assert find_branch_change(experiment, dynamics.truncated_to(first), x[:first]) is None


@pytest.mark.long
def test_the_verdict_names_equilibria_of_another_branch():
    x = buckled_m()
    experiment = replace(column(), t_s=column().t_s[: len(x)])
    collocation = collocation_of(experiment, LAW)
    (concern,) = branch_concerns(collocation.iterates(collocation.pack(collocation.guess_p, [x])))
    assert (concern.code, concern.grade) == ("stability/branch", "check")
    assert "not those that its loads lead to" in concern.message
    assert "buckles" in concern.message


@pytest.mark.long
def test_a_smooth_path_with_a_large_bend_is_stable():
    pushed = replace(column(), gravity_m_s2=(0.0, 0.0, -0.5))
    trajectory = cs.simulate(pushed, LAW)
    assert np.ptp(trajectory.positions_m[-1, :, 2]) > 0.06
    assert trajectory.branch_change is None


@pytest.mark.parametrize("samples", [1, 4])
def test_a_block_before_biots_limit_stays_on_its_branch(samples):
    heights_m = np.linspace(0.0, -0.04, samples + 1)[1:]
    experiment = block(t_s=np.arange(float(samples)), z_m=heights_m)
    assert cs.simulate(experiment, SOFT).branch_change is None


@pytest.mark.parametrize("samples", [1, 2])
def test_a_sample_off_the_path_of_its_loads_is_found(samples):
    heights_m = np.linspace(0.0, -0.07, samples + 1)[1:]
    experiment = block(t_s=np.arange(float(samples)), z_m=heights_m)
    positions = cs.simulate(experiment, SOFT).positions_m.reshape(samples, -1)
    dynamics = dynamics_of(experiment, SOFT)
    assert find_branch_change(experiment, dynamics, positions) is None
    other = positions.copy()
    other[-1, dynamics_free(experiment)] *= 1.05
    change = find_branch_change(experiment, dynamics, other)
    assert change is not None
    assert change.time_s == experiment.t_s[-1]


def dynamics_free(experiment: cs.Experiment) -> np.ndarray:
    return np.flatnonzero(~experiment.is_prescribed(experiment.t_s[:1])[0].ravel())
