"""Static experiments: a block between platens, and what belongs to equilibria."""

from __future__ import annotations

import numpy as np
from problems_small import EDGE_M, GUESS, IDEAL, TRUTH, as_theta, box, nodes_where, vertex_markers
from scipy.optimize import brentq

from collocation_sysid.experiment import Experiment, Grasp, PoseSequence
from collocation_sysid.nlp.collocation import Collocation
from collocation_sysid.nlp.rest import rest_state
from collocation_sysid.nlp.simulation import simulate, with_markers

# Uneven, as test benches' are.
TIMES = np.array([0.0, 1.0, 1.5, 4.0])
PRESSED_M = np.array([0.0, -0.01, -0.02, -0.04])


def pressed(t_s=TIMES, z_m=PRESSED_M) -> PoseSequence:
    """Straight down by these heights."""
    positions = np.outer(z_m, [0.0, 0.0, 1.0])
    return PoseSequence(t_s, positions, np.tile([0.0, 0.0, 0.0, 1.0], (len(t_s), 1)), "linear")


def block(platen: str = "z", t_s=TIMES, z_m=PRESSED_M, **changes) -> Experiment:
    """A quarter of a block between platens, which hold it along `platen`."""
    body = changes.pop("body", box())
    fixed = PoseSequence.fixed()
    sliding = platen == "z"
    sides = [nodes_where(body, axis, 0.0) for axis in range(2)]
    ends = [nodes_where(body, 2, height) for height in (0.0, EDGE_M)]
    if not sliding:
        sides = [np.setdiff1d(side, np.concatenate(ends)) for side in sides]
    grasps = [
        Grasp(ends[0], fixed, axes=platen),
        Grasp(ends[1], pressed(t_s, z_m), axes=platen),
        Grasp(sides[0], fixed, axes="x"),
        Grasp(sides[1], fixed, axes="y"),
    ]
    markers = vertex_markers(body, nodes_where(body, 0, EDGE_M), t_s)
    settings = {"gravity_m_s2": (0.0, 0.0, 0.0), "nuisance": IDEAL, "kind": "static"} | changes
    return Experiment(body, t_s, grasps, markers, name="block", **settings)


def lateral(stretch: float, mu: float, lame: float) -> float:
    """The stretch across of a Neo-Hookean bar that is free to contract."""

    def stress(b: float) -> float:
        return mu * (b - 1 / b) + lame * np.log(stretch * b * b) / b

    return float(brentq(stress, 0.5, 2.0, xtol=1e-15, rtol=1e-15))


def test_a_block_between_lubricated_platens_is_the_analytic_uniaxial_solution():
    experiment = block()
    positions = simulate(experiment, TRUTH).positions_m
    for x, z_m in zip(positions, PRESSED_M, strict=True):
        along = 1 + z_m / EDGE_M
        across = lateral(along, TRUTH["mu_pa"], TRUTH["lambda_pa"])
        expected = experiment.body.nodes_m * [across, across, along]
        np.testing.assert_allclose(x, expected, atol=1e-11)


def test_sticking_platens_hold_every_axis_and_let_the_side_bulge():
    experiment = block("xyz")
    positions = simulate(experiment, TRUTH).positions_m
    ends = np.concatenate([g.nodes for g in experiment.grasps[:2]])
    np.testing.assert_allclose(positions[-1, ends, :2], experiment.body.nodes_m[ends, :2])
    middle = np.flatnonzero(np.abs(experiment.body.nodes_m[:, 2] - EDGE_M / 2) < 1e-9)
    assert positions[-1, middle, 0].max() > 1.05 * EDGE_M


def test_each_static_sample_is_the_rest_state_of_its_time():
    experiment = block("xyz", gravity_m_s2=(0.0, 0.0, -9.81))
    positions = simulate(experiment, TRUTH).positions_m
    for x, time_s in zip(positions, TIMES, strict=True):
        rest = rest_state(experiment, as_theta(TRUTH), time_s)
        np.testing.assert_allclose(x.ravel(), rest, atol=1e-10)


def test_static_constraints_vanish_at_the_simulation_alone():
    experiment = block("xyz")
    segment = Collocation([experiment], GUESS.with_guess(TRUTH), substeps=3).segments[0]
    assert segment.grid_rows == len(TIMES)
    x = simulate(experiment, TRUTH).positions_m.reshape(len(TIMES), -1)
    residual = segment.residual_n(x, segment.setting(segment.parameters.guess_q, np.zeros(0)))
    assert np.abs(residual).max() < 1e-9 * segment.force_n
    x[2, experiment.free_dofs] += 1e-3 * EDGE_M
    moved = segment.residual_n(x, segment.setting(segment.parameters.guess_q, np.zeros(0)))
    assert (np.abs(moved).max(axis=1) > 1e-6 * segment.force_n).tolist() == [0, 0, 1, 0]


def test_one_sample_is_enough():
    experiment = block(t_s=np.array([2.0]), z_m=np.array([-0.03]))
    positions = simulate(experiment, TRUTH).positions_m
    np.testing.assert_allclose(positions[0, :, 2], 0.7 * experiment.body.nodes_m[:, 2], atol=1e-11)


def test_a_large_step_of_a_platen_is_taken_in_parts():
    once = block("xyz", t_s=np.array([0.0, 1.0]), z_m=np.array([0.0, -0.05]))
    slowly = block("xyz", t_s=np.arange(11.0), z_m=-0.005 * np.arange(11))
    found, expected = (simulate(e, TRUTH).positions_m[-1] for e in (once, slowly))
    np.testing.assert_allclose(found, expected, atol=1e-10)


def measured(experiment: Experiment, values=TRUTH) -> Experiment:
    return with_markers(experiment, simulate(experiment, values).markers_m)
