"""The nonlinear program: layout, derivatives, bounds and initial variables."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
from kit.checks import relative_error
from kit.collocation_kinds import ENGINEERING, LAYOUTS, WITH_PRIOR, swung
from kit.problems import (
    GUESS,
    TRUTH,
    as_theta,
    bar_in_two_hands,
    cube_with_nuisance,
    hung_cube,
    measured,
    prescribed_positions,
    some_point,
)

from collocation_sysid.errors import InputError
from collocation_sysid.fem.kernels.combine import combine_with_numpy
from collocation_sysid.fem.laws.moduli import engineering_constants as engineering_moduli
from collocation_sysid.methods.starts.initial_trajectories import initial_variables
from collocation_sysid.model.parameters import Parameter, Parameters
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.program.forward.scheme_simulation import simulate_scheme
from collocation_sysid.program.linear_algebra import block_band
from collocation_sysid.program.simulation import with_markers
from collocation_sysid.recording import Experiment

THETA = as_theta(TRUTH)


def marched(collocation: Collocation, q: np.ndarray | None = None) -> np.ndarray:
    q = collocation.parameters.guess_q if q is None else q
    motions = [
        simulate_scheme(s.experiment, s.dynamics.with_theta(s.constants.theta(q)))
        for s in collocation.transcriptions
    ]
    return collocation.pack(q, motions)


# Feasibility


@pytest.mark.parametrize(("scheme", "start", "explicit_grasps", "substeps"), LAYOUTS)
def test_a_marched_trajectory_satisfies_the_constraints(
    scheme: str, start: str, explicit_grasps: bool, substeps: int
):
    collocation = Collocation([swung(start)], GUESS, scheme, substeps, explicit_grasps)
    z = marched(collocation)
    assert np.abs(collocation.constraint_values(z)).max() < 1e-12
    lower, upper = collocation.bounds()
    assert ((z >= lower) & (z <= upper)).all()
    newtons = np.abs(collocation.residuals_n(z)[0]).max()
    assert newtons < 3e-12 * collocation.largest_force_n(z)


def test_a_marched_trajectory_with_several_grasps_satisfies_the_constraints():
    collocation = Collocation([bar_in_two_hands()], GUESS)
    assert np.abs(collocation.constraint_values(marched(collocation))).max() < 1e-12


def test_the_loss_is_zero_where_the_tracks_came_from():
    collocation = Collocation([measured(hung_cube())], GUESS)
    z = marched(collocation, np.log(THETA))
    assert collocation.objective(z) < 1e-20
    assert collocation.rms_marker_distance_m(z) < 1e-13


# Layout


def test_pack_and_unpack_are_inverse():
    collocation = Collocation([swung(), swung(steps=7)], GUESS, substeps=2)
    z = np.random.default_rng(0).normal(size=collocation.variable_count)
    q, positions = collocation.unpack(z)
    assert q.shape == (4,)
    assert [x.shape for x in positions] == [(11, 36), (15, 36)]
    np.testing.assert_allclose(collocation.pack(q, positions), z, rtol=1e-15)


def test_variables_and_rows_are_in_the_documented_order():
    collocation = Collocation([swung("undeformed"), swung(steps=7)], GUESS)
    z = some_point(collocation)
    q, positions = collocation.unpack(z)
    expected_z, expected_g = [q], []
    for transcription, x in zip(collocation.transcriptions, positions, strict=True):
        residual = transcription.dynamics.with_theta(transcription.constants.theta(q)).residual(x)
        expected_z.append(x.ravel() / transcription.length_m)
        rows = residual[transcription.dynamics.first_row :, transcription.free_dofs]
        expected_g.append(rows.ravel() / transcription.force_n)
    np.testing.assert_allclose(z, np.concatenate(expected_z))
    np.testing.assert_allclose(collocation.constraint_values(z), np.concatenate(expected_g))
    assert [s.dynamics.first_row for s in collocation.transcriptions] == [1, 0]


def test_lengths_are_scaled_by_the_mean_edge():
    transcription = Collocation([swung()], GUESS).transcriptions[0]
    ends = transcription.body.nodes_m[transcription.body.mesh.edges]
    assert transcription.length_m == pytest.approx(
        np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).mean()
    )


def test_gauss_newtons_model_of_wild_samples_is_nowhere_below_their_loss(rng):
    collocation = Collocation([swung()], GUESS, huber=2.0)
    z = some_point(collocation)
    value, slope = collocation.objective(z), collocation.gradient(z)
    hessian = collocation.hessian(z, 1.0, None)
    x = collocation.transcriptions[0].columns
    for length in (1e-4, -1e-2, 1.0):
        step = np.zeros(len(z))
        step[x] = length * rng.normal(size=len(step[x]))
        model = value + slope @ step + step @ (hessian @ step) / 2
        assert collocation.objective(z + step) <= model * (1 + 1e-12)


def test_gauss_newtons_hessian_is_the_exact_one_where_readings_are_met():
    truth = Parameters(tuple(replace(item, guess=TRUTH[item.name]) for item in GUESS.items))
    collocation = Collocation([measured(cube_with_nuisance(4))], truth)
    (start, _), none = (initial_variables(collocation), np.zeros(collocation.constraint_count))
    exact = collocation.hessian(start, 1.0, none).toarray()
    found = collocation.hessian(start, 1.0, None).toarray()
    np.testing.assert_allclose(found, exact, atol=1e-9 * np.abs(exact).max())


def test_values_are_written_into_given_arrays():
    collocation = Collocation([swung(), swung(steps=3)], GUESS)
    z = some_point(collocation)
    y = np.ones(collocation.constraint_count)
    jacobian = np.full(len(collocation.jacobian_structure[1]), np.nan)
    second = np.full(len(collocation.hessian_structure[1]), np.nan)
    assert collocation.jacobian_values(z, jacobian) is jacobian
    assert collocation.hessian_values(z, 1.0, y, second) is second
    np.testing.assert_array_equal(jacobian, collocation.jacobian_values(z))
    np.testing.assert_array_equal(second, collocation.hessian_values(z, 1.0, y))


@pytest.mark.parametrize("make", [swung, bar_in_two_hands])
def test_held_nodes_are_bound_to_the_grasp(make):
    collocation = Collocation([make()], GUESS, substeps=2)
    transcription = collocation.transcriptions[0]
    (lower,), (upper,) = (collocation.unpack(bound)[1] for bound in collocation.bounds())
    held = prescribed_positions(transcription.experiment, transcription.dynamics.t_s)
    np.testing.assert_allclose(
        lower[:, transcription.prescribed_dofs], held, rtol=1e-14, atol=1e-17
    )
    np.testing.assert_array_equal(
        lower[:, transcription.prescribed_dofs], upper[:, transcription.prescribed_dofs]
    )
    assert (lower[:, transcription.free_dofs] == -np.inf).all()
    assert (upper[:, transcription.free_dofs] == np.inf).all()


@pytest.mark.parametrize("start", ["undeformed", "given"])
def test_a_known_start_is_bound_too(start: str):
    collocation = Collocation([swung(start)], GUESS, has_grasp_constraints=True)
    (lower,), (upper,) = (collocation.unpack(bound)[1] for bound in collocation.bounds())
    expected = collocation.transcriptions[0].experiment.start_positions_m
    if expected is None:
        expected = collocation.transcriptions[0].body.nodes_m
    np.testing.assert_allclose(lower[0], np.ravel(expected), rtol=1e-14, atol=1e-17)
    np.testing.assert_array_equal(lower[0], upper[0])
    assert np.isinf(lower[1:]).all()


def test_bounds_of_the_parameters_come_first():
    lower, upper = Collocation([swung()], GUESS).bounds()
    np.testing.assert_allclose(np.exp(lower[:4]), [10, 10, 1e-5, 1e-3])
    np.testing.assert_allclose(np.exp(upper[:4]), [1e5, 1e5, 1, 100])


# Several experiments


def test_experiments_share_nothing_but_the_parameters():
    experiments = [swung(), swung("undeformed", steps=7)]
    both = Collocation(experiments, GUESS)
    z = some_point(both)
    q, positions = both.unpack(z)
    jacobian = both.jacobian(z).toarray()
    by_theta, by_position = [], []
    for experiment, x in zip(experiments, positions, strict=True):
        alone = Collocation([experiment], GUESS)
        block = alone.jacobian(alone.pack(q, [x])).toarray()
        by_theta.append(block[:, :4])
        by_position.append(block[:, 4:])
    expected = np.hstack([np.vstack(by_theta), sp.block_diag(by_position).toarray()])
    np.testing.assert_allclose(jacobian, expected, atol=1e-13 * np.abs(expected).max())


def test_losses_of_experiments_add_up():
    experiments = [swung(), swung("undeformed", steps=7)]
    both = Collocation(experiments, GUESS)
    z = some_point(both)
    q, positions = both.unpack(z)
    total = 0.0
    for experiment, x in zip(experiments, positions, strict=True):
        alone = Collocation([experiment], GUESS)
        total += alone.objective(alone.pack(q, [x])) * alone.measurement_count
    assert both.objective(z) * both.measurement_count == pytest.approx(total)


def test_validation_experiments_are_left_out():
    fitted, held_out = (swung(), replace(swung(steps=7), name="held out", validation=True))
    collocation = Collocation([held_out, fitted], GUESS)
    assert [transcription.experiment for transcription in collocation.transcriptions] == [fitted]
    assert collocation.variable_count == Collocation([fitted], GUESS).variable_count


def test_nothing_to_fit_is_refused():
    with pytest.raises(InputError, match="none is left for the fit"):
        Collocation([replace(swung(), validation=True)], GUESS)
    with pytest.raises(InputError, match="substeps is 0; expected a number of at least 1"):
        Collocation([swung()], GUESS, substeps=0)


# Loss


def test_the_loss_counts_present_samples_only():
    collocation = Collocation([swung()], GUESS)
    z = some_point(collocation)
    transcription, (_, (x,)) = collocation.transcriptions[0], collocation.unpack(z)
    markers = transcription.experiment.markers
    predicted = markers.predict_positions(x.reshape(len(x), -1, 3))
    squares = np.sum((predicted - markers.positions_m) ** 2, axis=2)
    present = np.isfinite(squares)
    assert 0 < present.sum() < present.size
    assert collocation.measurement_count == 3 * present.sum()
    expected = (squares / markers.sigma_m**2)[present].sum() / collocation.measurement_count
    assert collocation.objective(z) == pytest.approx(expected)
    np.testing.assert_allclose(
        transcription.markers.squared_distances_m2(x, np.zeros(0)), squares[present]
    )
    assert collocation.rms_marker_distance_m(z) == pytest.approx(np.sqrt(squares[present].mean()))


def test_a_frame_without_samples_pulls_on_nothing():
    experiment = swung()
    tracks = experiment.markers.positions_m.copy()
    tracks[3] = np.nan
    collocation = Collocation([with_markers(experiment, tracks)], GUESS)
    _, (gradient,) = collocation.unpack(collocation.gradient(some_point(collocation)))
    assert (gradient[3] == 0).all()
    assert (np.abs(gradient[[0, 1, 2, 4, 5]]).max(axis=1) > 0).all()


def test_with_substeps_only_the_rows_at_samples_are_measured():
    collocation = Collocation([swung()], GUESS, substeps=3)
    _, (gradient,) = collocation.unpack(collocation.gradient(some_point(collocation)))
    moved = np.flatnonzero(np.abs(gradient).max(axis=1))
    assert len(moved)
    assert (moved % 3 == 0).all()


def test_a_prior_adds_its_squared_residual():
    with_prior, without = (Collocation([swung()], p) for p in (WITH_PRIOR, GUESS))
    z = some_point(without)
    difference = (with_prior.objective(z) - without.objective(z)) * without.measurement_count
    assert difference == pytest.approx(((z[0] - np.log(300.0)) / 0.2) ** 2)


# Parameters


def test_fixing_parameters_drops_their_columns():
    fixed = Parameters((*GUESS.items[:3], Parameter("gamma_m_1_s", 0.5, is_fixed=True)))
    all_free, reduced = (Collocation([swung()], GUESS), Collocation([swung()], fixed))
    z = some_point(all_free)
    z[3] = np.log(0.5)
    shorter = np.delete(z, 3)
    assert reduced.variable_count == all_free.variable_count - 1
    np.testing.assert_allclose(
        reduced.constraint_values(shorter), all_free.constraint_values(z), atol=1e-14
    )
    expected = np.delete(all_free.jacobian(z).toarray(), 3, axis=1)
    np.testing.assert_allclose(reduced.jacobian(shorter).toarray(), expected, atol=1e-14)


def test_both_elastic_pairs_describe_the_same_constraints():
    lame, engineering = (Collocation([swung()], GUESS), Collocation([swung()], ENGINEERING))
    z = some_point(lame)
    lambda_pa, mu_pa, *damping = lame.parameter_values(z).values()
    q = np.log([*engineering_moduli(lambda_pa, mu_pa), *damping])
    other = engineering.pack(q, lame.unpack(z)[1])
    newtons = lame.residuals_n(z)[0]
    np.testing.assert_allclose(
        engineering.residuals_n(other)[0], newtons, atol=1e-12 * np.abs(newtons).max()
    )


# Reading a point


def test_the_largest_violation_is_named():
    collocation = Collocation([swung(), replace(swung(steps=7), name="second")], GUESS)
    z = marched(collocation)
    q, positions = collocation.unpack(z)
    node = int(collocation.transcriptions[1].experiment.free_dofs[6]) // 3
    positions[1][-1, 3 * node + 1] += 1e-3
    worst = collocation.largest_violations(collocation.pack(q, positions), count=3)
    assert len(worst) == 3
    assert (worst[0].experiment, worst[0].node, worst[0].axis) == ("second", node, "y")
    assert worst[0].time_s == pytest.approx(0.07)
    assert str(worst[0]).startswith(f"second: t = 0.07 s, node {node}, y: -")
    assert str(worst[0]).endswith(" N")
    sizes = [abs(violation.residual_n) for violation in worst]
    assert sizes == sorted(sizes, reverse=True)


# Filling without a compiler


def test_the_numpy_combiner_fills_the_same_values(monkeypatch):
    def values(experiment: Experiment) -> tuple[np.ndarray, np.ndarray]:
        collocation = Collocation([experiment], GUESS, "bdf2")
        z = some_point(collocation)
        y = np.random.default_rng(0).normal(size=collocation.constraint_count)
        return collocation.jacobian_values(z), collocation.hessian_values(z, 1.0, y)

    natively = values(swung())
    monkeypatch.setattr(block_band, "make_combiner", combine_with_numpy)
    for found, expected in zip(values(swung()), natively, strict=True):
        assert relative_error(found, expected) < 1e-14


def test_a_program_with_other_associations_equals_a_new_one(rng):
    """What was cached before is shared only where it does not depend on them."""
    before = Collocation([cube_with_nuisance(5), swung()], GUESS)
    before.hessian(some_point(before, rng), 1.0, None)
    before.jacobian(some_point(before, rng))
    p = before.guess_p + 0.5 * rng.normal(size=before.nq + before.nphi)
    moved, _ = before.follow_estimates(p)
    assert moved is not before
    one, other = (each.transcriptions[0] for each in (before, moved))
    assert one.association is not other.association
    assert one.hessian is other.hessian
    assert one.residuals is not other.residuals
    assert one.local_loss is not other.local_loss
    fresh = replace(moved, substeps=1)
    assert fresh.transcriptions[0].hessian is not other.hessian
    z = some_point(moved, rng)
    multipliers = rng.normal(size=moved.constraint_count)
    np.testing.assert_array_equal(moved.gradient(z), fresh.gradient(z))
    np.testing.assert_array_equal(
        moved.hessian(z, 1.0, multipliers).toarray(), fresh.hessian(z, 1.0, multipliers).toarray()
    )
    np.testing.assert_array_equal(moved.jacobian(z).toarray(), fresh.jacobian(z).toarray())
