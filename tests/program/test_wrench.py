"""Reaction forces of grasps on the time grid and along the equations of motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from kit.checks import relative_error
from kit.problems import GUESS, TRUTH, as_theta, bar_in_two_hands, bar_let_go, hung_cube, times
from kit.wrench_kinds import pressed
from kit.wrenches import EVERYTHING, felt, fitted, predicted_wrenches, sensing, wristed_cube
from scipy.spatial.transform import Rotation

from collocation_sysid.fem.schemes import SCHEMES
from collocation_sysid.methods.comparison.shooting import simulate_variables
from collocation_sysid.methods.horizon import Horizon
from collocation_sysid.model.parameters import Parameters
from collocation_sysid.model.recursion import RecursionTrajectory
from collocation_sysid.program.collocation import Collocation, ExperimentIterate
from collocation_sysid.program.forward.scheme_simulation import simulate_scheme
from collocation_sysid.program.measurement_residual import neighbouring_times, smooth_weights
from collocation_sysid.program.observables import (
    ObservableDerivatives,
    ObservedMotion,
    ReactionForces,
)
from collocation_sysid.program.reactions.resultant import LOW_PASS
from collocation_sysid.program.simulation import simulate, with_wrenches
from collocation_sysid.program.wrench_residual import WrenchResidual
from collocation_sysid.recording import Experiment, Nuisance, PoseSequence
from collocation_sysid.recording.nuisance import SENSOR_TIME


def at_truth(
    experiment: Experiment, scheme: str = "midpoint", substeps: int = 1
) -> ExperimentIterate:
    collocation = Collocation([experiment], Parameters.from_mapping(TRUTH), scheme, substeps)
    (transcription,) = collocation.transcriptions
    x = simulate_scheme(experiment, transcription.dynamics.with_theta(as_theta(TRUTH)))
    (part,) = collocation.iterates_at(np.zeros(collocation.nphi), [x])
    return part


def total_on_grid(part: ExperimentIterate) -> tuple[np.ndarray, np.ndarray]:
    """Grid times and the wrenches (n, 6) of all grasps together."""
    forced, channels = (
        part.reactions,
        [s.observable for s in part.transcription.residuals_of(WrenchResidual)],
    )
    return channels[0].known_rows, np.sum(
        [c.evaluate_without_tool(forced) for c in channels], axis=0
    )


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("described", [hung_cube, bar_in_two_hands])
def test_all_grasps_together_give_weight_and_rate_of_momentum(
    described: Callable[[int], Experiment], scheme: str
):
    """Newton's third law, of a body that no drag brakes, with the scheme's own stencils."""
    experiment = described(14)
    part = at_truth(sensing(experiment, point_m=(0, 0, 0)), scheme)
    undragged = TRUTH | {"gamma_m_1_s": 0.0}
    theta = as_theta(undragged)
    x = simulate_scheme(experiment, part.transcription.dynamics.with_theta(theta))
    collocation = Collocation(
        [part.transcription.experiment], Parameters.from_mapping(undragged), scheme
    )
    (part,) = collocation.iterates_at(np.zeros(0), [x])
    grid, found = total_on_grid(part)
    dynamics = part.transcription.dynamics
    mass = dynamics.mass.inertia_kg[0, ::3]
    stencil = dynamics.combine(dynamics.tables.s, x) / dynamics.step_s**2
    acceleration = stencil[
        grid
        + part.transcription.residuals_of(WrenchResidual)[0].observable.reaction_grid.delay_steps
    ].reshape(len(grid), -1, 3)
    pull = mass[:, None] * (acceleration - experiment.gravity_m_s2)
    weight_n = 9.81 * mass.sum()
    assert np.abs(found[:, :3] - pull.sum(axis=1)).max() < 1e-9 * weight_n


def test_torques_of_the_midpoint_rule_give_the_rate_of_angular_momentum():
    part = at_truth(sensing(bar_in_two_hands(14), point_m=(0.1, 0.2, -0.1)))
    experiment = part.transcription.experiment
    theta = as_theta(TRUTH | {"gamma_m_1_s": 0.0})
    x = simulate_scheme(experiment, part.transcription.dynamics.with_theta(theta))
    collocation = Collocation([experiment], Parameters.from_mapping(TRUTH | {"gamma_m_1_s": 0.0}))
    (part,) = collocation.iterates_at(np.zeros(0), [x])
    grid, found = total_on_grid(part)
    dynamics, mass = (
        part.transcription.dynamics,
        part.transcription.dynamics.mass.inertia_kg[0, ::3],
    )
    at = x.reshape(len(x), -1, 3)
    second = (at[2:] - 2 * at[1:-1] + at[:-2]) / dynamics.step_s**2
    arm = at[1:-1] - [0.1, 0.2, -0.1]
    pull = mass[:, None] * (second - experiment.gravity_m_s2)
    expected = np.cross(arm, pull).sum(axis=1)
    np.testing.assert_array_equal(grid, np.arange(1, len(x) - 1))
    # Internal forces act in the middle of the intervals, and have no torque there.
    assert relative_error(found[:, 3:], expected) < 1e-2


@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_body_at_rest_is_carried(scheme: str):
    still = hung_cube(8)
    (grasp,) = still.grasps
    at_rest = replace(grasp, poses=replace(grasp.poses, positions_m=0 * grasp.poses.positions_m))
    turns = np.tile([0.0, 0.0, 0.0, 1.0], (len(still.t_s), 1))
    at_rest = replace(at_rest, poses=replace(at_rest.poses, quaternions_xyzw=turns))
    _, found = total_on_grid(at_truth(sensing(replace(still, grasps=[at_rest])), scheme))
    weight_n = 9.81 * still.body.mass_kg
    np.testing.assert_allclose(found[:, :3], np.tile([0, 0, weight_n], (len(found), 1)), atol=1e-9)


def test_the_frame_of_the_grasp_moves_along():
    world = at_truth(wristed_cube())
    moving = at_truth(wristed_cube(frame="grasp"))
    grid, in_world = total_on_grid(world)
    _, in_grasp = total_on_grid(moving)
    turns, shifts = world.transcription.experiment.grasps[0].poses.at(
        world.transcription.dynamics.t_s[grid]
    )
    np.testing.assert_allclose(
        np.einsum("kij,kj->ki", turns, in_grasp[:, :3]), in_world[:, :3], atol=1e-12
    )
    point = world.transcription.residuals_of(WrenchResidual)[0].wrench.point_m
    arm = shifts + turns @ point - point
    about = np.einsum("kij,kj->ki", turns, in_grasp[:, 3:]) + np.cross(arm, in_world[:, :3])
    np.testing.assert_allclose(about, in_world[:, 3:], atol=1e-12)


def test_a_grasp_that_lets_go_has_a_wrench_while_holding():
    part = at_truth(sensing(bar_let_go(12)))
    still, moving = part.transcription.residuals_of(WrenchResidual)
    assert still.observable.known_rows[-1] == 11
    # It holds up to the third grid time; the first two rows are those of the start.
    np.testing.assert_array_equal(moving.observable.known_rows, [1])


def some_p(collocation: Collocation) -> np.ndarray:
    low, high = collocation.parameter_bounds
    phi = np.abs(0.3 * np.random.default_rng(1).standard_normal(collocation.nphi)) + 0.1
    return np.clip(np.concatenate([collocation.parameters.guess_q, phi]), low, high)


def test_rows_that_are_continued_sense_the_same():
    collocation = Collocation([felt(wristed_cube(nuisance=EVERYTHING))], GUESS)
    p = some_p(collocation)
    (x,) = collocation.unpack(simulate_variables(collocation, p))[1]
    part = Horizon(collocation, [8]).evaluate(p, [x[:8]])
    whole = Horizon(collocation, [len(x)])
    continued = whole.evaluate(p, [x], part)
    afresh = whole.evaluate(p, [x])
    ours, theirs = continued.fit, afresh.fit
    np.testing.assert_allclose(ours.residual, theirs.residual, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(ours.jacobian, theirs.jacobian, rtol=1e-9, atol=1e-7)


# At the samples -----------------------------------------------------------------------------------


def test_samples_between_grid_times_are_read_to_the_third_order():
    """A faster sensor sees the wrench between grid times, not that of the nearest one."""
    errors = []
    for refinement in (1, 2, 4):
        steps = 16 * refinement
        cube = hung_cube(steps)
        t_s = times(steps, 0.01 / refinement)
        slow = replace(cube, t_s=t_s, markers=replace(cube.markers, t_s=t_s))
        fine = np.linspace(0.03, 0.13, 87)
        part = at_truth(sensing(slow, fine))
        (read,) = predicted_wrenches(part)
        dense = at_truth(sensing(slow, fine), substeps=8 // refinement)
        (expected,) = predicted_wrenches(dense)
        errors.append(relative_error(read[:, :3], expected[:, :3]))
    assert errors[1] < 0.4 * errors[0]


def test_the_slope_by_the_clock_is_continuous_at_grid_times():
    """Where a sample at a grid time passes to the next grid times."""
    cube = wristed_cube(nuisance=Nuisance(sensor_time_s=0.001))
    (residual,) = at_truth(felt(cube)).transcription.residuals_of(WrenchResidual)
    t_s = residual.observable.t_s
    values = np.sin(60 * t_s[:, None, None] + np.arange(6).reshape(2, 3))
    (clock,) = residual.observable.parameter_indices(SENSOR_TIME)
    assert np.isclose(residual.t_s[:, None], t_s).any(axis=1).sum() > 5

    def at(phi: float) -> tuple[np.ndarray, np.ndarray]:
        own = np.zeros(residual.nuisance.size)
        own[clock] = phi
        slopes = ObservableDerivatives.without_own(np.arange(0), np.zeros((*values.shape, 0)))
        return residual.linearise(values, slopes, phi=own, size=len(own))

    step = 1e-4
    (here, by_phi), (ahead, _), (behind, _) = at(0.0), at(step), at(-step)
    slope = by_phi[..., clock]
    np.testing.assert_allclose((ahead - here) / step, slope, atol=2e-4 * np.abs(slope).max())
    np.testing.assert_allclose((here - behind) / step, slope, atol=2e-4 * np.abs(slope).max())


def test_a_swing_between_grid_times_is_read_to_the_fifth_order():
    at, places = ca.SX.sym("at"), ca.SX.sym("places", 6)
    weights = ca.vertcat(*smooth_weights(at, ca.vertsplit(places)))
    weigh = ca.Function("weights", [at, places], [weights])
    fine = np.linspace(0.1, 0.9, 300)
    errors = []
    for step_s in (0.02, 0.01):
        t_s = np.arange(0, 1 + step_s, step_s)
        times = neighbouring_times(t_s, fine, count=6)
        at_samples = np.array(weigh.map(len(fine))(fine[None], t_s[times].T))
        errors.append(
            np.abs((at_samples.T * np.exp(20j * t_s[times])).sum(axis=1) - np.exp(20j * fine)).max()
        )
    assert errors[0] < 0.4**5 / 250
    assert errors[0] / errors[1] == pytest.approx(2**5, rel=0.05)


def low_passed(signal: np.ndarray, lag_s: float, step_s: float = 0.01) -> RecursionTrajectory:
    data = np.stack([np.arange(len(signal)) == 0, np.full(len(signal), 1 / step_s)])
    return RecursionTrajectory.from_signal(
        LOW_PASS, np.array([lag_s]), data[..., None], signal[None, :, None]
    )


def test_a_low_pass_follows_a_ramp_by_its_time_constant():
    lag_s, ramp = 0.025, 0.01 * np.arange(60)
    lag = ramp - low_passed(ramp, lag_s).states.ravel()
    assert lag[-1] == pytest.approx(lag_s * (1 - np.exp(-ramp[-1] / lag_s)), rel=1e-12)


@pytest.mark.parametrize("lag_s", [0.0, 0.002, 0.05])
def test_the_slope_of_a_low_pass_is_its_derivative(lag_s: float, rng):
    signal, step = rng.normal(size=20), 1e-6
    still = np.zeros((1, len(signal), 1, 1))
    slope = low_passed(signal, lag_s).jacobian_vector_product(still, np.ones((1, 1))).ravel()
    ahead, behind = (low_passed(signal, at).states for at in (lag_s + step, max(0, lag_s - step)))
    expected = (ahead - behind).ravel() / (step + min(step, lag_s))
    np.testing.assert_allclose(slope, expected, rtol=1e-3, atol=0.02)


def test_a_low_pass_passes_constants_and_delays_the_rest(rng):
    signal = rng.normal(size=20)
    np.testing.assert_allclose(low_passed(signal, 0.0).states.ravel(), signal, rtol=1e-14)
    np.testing.assert_allclose(low_passed(np.full(9, 3.0), 0.05).states, 3.0, rtol=1e-14)


# Static experiments and single axes ---------------------------------------------------------------


def test_platen_plate_and_weight_are_in_equilibrium():
    cube = pressed()
    below, above = simulate(cube, TRUTH).wrenches
    weight_n = 9.81 * cube.body.mass_kg
    np.testing.assert_allclose((below + above)[:, 2], weight_n, atol=1e-9)
    # It slides under the platen: nothing is given along x and y.
    np.testing.assert_allclose(above[:, :2], 0.0, atol=1e-12)
    assert (np.diff(above[:, 2]) < 0).all()


def test_a_frame_that_is_carried_along_is_off_as_the_poses_are(rng):
    (transcription,) = fitted(felt(wristed_cube(8, frame="grasp")), GUESS).transcriptions
    (sensor,) = transcription.residuals_of(WrenchResidual)
    grasp, rows, dofs = (
        sensor.observable.grasp,
        transcription.grid_times,
        len(transcription.sensed_dofs),
    )
    poses = grasp.poses
    forced = ReactionForces(rng.normal(size=(rows, dofs)), rng.normal(size=(rows, dofs)))
    motion, phi = (ObservedMotion(np.zeros((rows, transcription.dof_count)), forced), np.zeros(0))
    shift, turn = rng.normal(size=(2, 3))

    def residual(size: float) -> np.ndarray:
        turned = Rotation.from_rotvec(size * turn) * Rotation.from_quat(poses.quaternions_xyzw)
        off = PoseSequence(poses.t_s, poses.positions_m + size * shift, turned.as_quat())
        other = replace(sensor.observable, grasp=replace(grasp, poses=off))
        return sensor.residuals(other.evaluate(motion, phi), phi)

    given = [np.tile(each, (rows, 1, 1)) for each in (shift, turn)]
    carried = np.asarray(sensor.observable.frame_changes(grasp, motion, phi, *given))
    found = sensor.residual_changes(sensor.observable.evaluate(motion, phi), carried, phi)[..., 0]
    assert relative_error(found, (residual(1e-4) - residual(-1e-4)) / 2e-4) < 1e-5


@pytest.mark.parametrize("count", [0, 2])
def test_another_number_of_wrenches_than_sensors_is_refused(count):
    cube = sensing(hung_cube())
    samples = np.ones((len(cube.t_s), 6))
    measured = with_wrenches(cube, [samples]).grasps[0].wrench
    assert measured is not None
    assert (measured.values == 1).all()
    with pytest.raises(ValueError, match="measured forces"):
        with_wrenches(cube, [samples] * count)
