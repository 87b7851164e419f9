"""Steps of a search: positions after a change of the parameters."""

import numpy as np

import collocation_sysid as cs
from collocation_sysid.methods.horizon import Horizon
from collocation_sysid.methods.starts.initial_trajectories import simulate_trajectories


def hanging_bar() -> cs.Problem:
    """Return a hanging bar whose top is shaken, and which may be turned in its grasp."""
    bar = cs.Body(
        cs.box_mesh((0.02, 0.02, 0.11), (1, 1, 3)), density_kg_m3=1070.0, element="tet10-p0"
    )
    t_s = np.arange(0.0, 0.5, 0.02)
    shift = 0.02 * np.outer(np.sin(15 * t_s), [1.0, 0.6, 0.3])
    upside_down = np.tile([1.0, 0.0, 0.0, 0.0], (len(t_s), 1))
    held = np.flatnonzero(bar.nodes_m[:, 2] < 1e-9)
    grasp = cs.Grasp(held, cs.PoseSequence(t_s, shift, upside_down))
    places = [(x, 0.02, z) for x in (0.004, 0.015) for z in (0.05, 0.1)]
    markers = cs.Markers(t_s, np.zeros((len(t_s), 4, 3)), 2e-4, places_m=places)
    truth = {"young_pa": 5e5, "poisson": 0.45, "gamma_r_s": 1.1e-3, "gamma_m_1_s": 0.0}
    swing = cs.Experiment(bar, t_s, [grasp], markers)
    motion = cs.simulate(swing, truth, "midpoint", substeps=1)
    return cs.Problem(
        [cs.with_markers(swing, motion.markers_m)], truth | {"young_pa": cs.Unknown(5e5)}
    )


def test_a_step_that_turns_a_body_in_its_grasp_does_not_stretch_it():
    # A linear step by 2° about each axis stretches the bar by 0.2 %, which in tension changes its
    # frequencies, and so the derivatives by all parameters.
    program = hanging_bar().collocation()
    guess = program.guess_p
    horizon = Horizon(program, [each.grid_times for each in program.transcriptions])
    at, failure = simulate_trajectories(program, guess)
    assert failure is None
    start = horizon.evaluate(guess, at)
    turns = [name for name in program.parameter_names if "turn in the grasp" in name]
    nuisance = program.transcriptions[0].nuisance
    sizes = dict(zip(nuisance.names, nuisance.scales, strict=True))
    turned = program.with_values({name: np.deg2rad(2.0) / sizes[name] for name in turns}, guess)
    trial = horizon.evaluate_step(turned, start, step=turned - guess)
    exact, failure = simulate_trajectories(program, turned)
    assert failure is None
    simulated = horizon.evaluate(turned, exact)
    young = np.eye(len(guess))[0]
    slopes = [
        each.predicted_loss(1e-3 * young) - each.predicted_loss(-1e-3 * young)
        for each in (trial, simulated)
    ]
    np.testing.assert_allclose(slopes[0], slopes[1], rtol=0.1)
