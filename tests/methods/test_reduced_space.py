"""The reduced-space method: solutions, options, statuses and interruption."""

from __future__ import annotations

import os
import signal
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from kit.problems import (
    EXPERIMENTS_AND_SCHEMES,
    GUESS,
    SMALL_EXPERIMENTS,
    TRUTH,
    as_theta,
    bar_in_two_hands,
    bar_let_go,
    hung_cube,
    measured,
    noisy,
    relative_errors,
    released_cube,
)

import collocation_sysid as cs
from collocation_sysid.errors import SimulationError
from collocation_sysid.methods import reduced_search
from collocation_sysid.methods.horizon import Horizon, Iterate, motion_shares, rows_of_share
from collocation_sysid.methods.interior_point import InteriorPoint
from collocation_sysid.methods.loss_curvature import secant_update, with_curvature
from collocation_sysid.methods.options import SHARES
from collocation_sysid.methods.reduced_search import ReducedSearch
from collocation_sysid.methods.reduced_space import ReducedSpace, memory_mb
from collocation_sysid.methods.solution import Iteration, Solution, Status
from collocation_sysid.methods.starts.initial_trajectories import (
    initial_variables,
    rigid_trajectory,
    simulate_trajectories,
)
from collocation_sysid.model.parameters import Parameters
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.program.least_squares import SquareRootInformation
from collocation_sysid.program.simulation import with_markers

KKT = 1e-8


def with_parameter(name: str, **changes) -> Parameters:
    return Parameters(
        tuple(replace(item, **changes) if item.name == name else item for item in GUESS.items)
    )


PRECISE = ReducedSpace(tolerance=1e-12)


@cache
def cube() -> Collocation:
    return Collocation([measured(hung_cube())], GUESS)


@cache
def solved_cube() -> Solution:
    return ReducedSpace()(cube())


# The answer


@pytest.mark.parametrize(("experiment", "scheme"), EXPERIMENTS_AND_SCHEMES)
def test_the_true_parameters_are_recovered(experiment: str, scheme: str):
    made = measured(SMALL_EXPERIMENTS[experiment](), scheme)
    solution = ReducedSpace()(Collocation([made], GUESS, scheme))
    assert solution.status is Status.CONVERGED
    assert np.abs(relative_errors(solution)).max() < 1e-6
    assert solution.rms_m < 1e-9
    assert solution.kkt_residual < KKT


@pytest.mark.parametrize("make", [hung_cube, released_cube, bar_in_two_hands])
def test_the_answer_with_noise_is_that_of_interior_point(make):
    collocation = Collocation([noisy(make(15))], GUESS)
    solution = PRECISE(collocation)
    reference = InteriorPoint(tolerance=1e-12)(collocation)
    assert solution.status.converged
    assert reference.status.converged
    np.testing.assert_allclose(solution.theta, reference.theta, rtol=1e-6)
    np.testing.assert_allclose(solution.positions_m[0], reference.positions_m[0], atol=1e-8)
    np.testing.assert_allclose(solution.multipliers, reference.multipliers, atol=1e-6)
    assert solution.kkt_residual < KKT


def test_experiments_of_different_lengths_and_grasps_are_fitted_together():
    held_out = replace(measured(hung_cube(5)), name="held out", validation=True)
    made = [measured(hung_cube(9)), measured(bar_in_two_hands(14)), measured(released_cube(8))]
    solution = ReducedSpace()(Collocation([*made, held_out], GUESS))
    assert np.abs(relative_errors(solution)).max() < 1e-6
    assert [len(x) for x in solution.positions_m] == [10, 15, 9]
    assert solution.kkt_residual < KKT


@pytest.mark.parametrize("options", [{"substeps": 3}, {"has_grasp_constraints": True}])
def test_every_layout_is_fitted(options: dict):
    made = measured(hung_cube(8), substeps=options.get("substeps", 1))
    solution = ReducedSpace()(Collocation([made], GUESS, **options))
    assert np.abs(relative_errors(solution)).max() < 1e-6
    assert solution.kkt_residual < KKT


@pytest.mark.parametrize("bound", [{"lower": 350.0}, {"upper": 250.0}])
def test_a_bound_that_excludes_the_truth_is_active_at_the_answer(bound: dict):
    parameters = with_parameter("mu_pa", guess=next(iter(bound.values())), **bound)
    collocation = Collocation([measured(hung_cube())], parameters)
    solution = PRECISE(collocation)
    reference = InteriorPoint(tolerance=1e-11)(collocation)
    assert solution.status is Status.CONVERGED
    assert solution.parameters["mu_pa"] == pytest.approx(next(iter(bound.values())), rel=1e-12)
    np.testing.assert_allclose(solution.theta, reference.theta, rtol=1e-4)
    assert solution.kkt_residual < KKT


def test_a_prior_pulls_as_in_interior_point():
    parameters = with_parameter("lambda_pa", prior=(220.0, 0.01))
    collocation = Collocation([measured(hung_cube())], parameters)
    solution = ReducedSpace()(collocation)
    reference = InteriorPoint(tolerance=1e-12)(collocation)
    np.testing.assert_allclose(solution.theta, reference.theta, rtol=1e-6)
    assert 201 < solution.parameters["lambda_pa"] < 220
    assert solution.kkt_residual < KKT


@pytest.mark.parametrize("factorisation", ["band", "sparse"])
def test_every_factorisation_leads_to_the_same_answer(factorisation):
    solution = ReducedSpace(factorisation=factorisation)(cube())
    np.testing.assert_allclose(solution.theta, solved_cube().theta, rtol=1e-9)


def test_memory_grows_no_faster_than_the_number_of_timesteps():
    short, long = (Collocation([hung_cube(steps)], GUESS) for steps in (49, 199))
    assert memory_mb(short) < memory_mb(long) <= 4 * memory_mb(short)


# The start


@pytest.mark.long
def test_a_guess_that_cannot_be_simulated_is_a_status_with_a_remedy():
    soft = [
        replace(item, guess=guess, lower=1e-4, upper=guess * 1.001)
        for item, guess in zip(GUESS.items[:2], (0.4, 0.15), strict=True)
    ]
    collocation = Collocation([measured(hung_cube())], Parameters((*soft, *GUESS.items[2:])))
    solution = ReducedSpace()(collocation)
    assert solution.status is Status.NOT_SIMULABLE
    for part in ("stiffer or less damped ones", "loses its stability", "t = 0 s, element "):
        assert part in solution.message
    assert np.isfinite(solution.z).all()
    assert solution.rms_m > 0


def test_reduced_space_starts_from_given_variables():
    seen: list[Iteration] = []
    again = ReducedSpace()(cube(), seen.append, solved_cube().z)
    assert again.status is Status.CONVERGED
    assert again.iterations < 3
    assert seen[0].parameters == solved_cube().parameters
    assert seen[0].misfit < 1e-5


@pytest.mark.parametrize("distance", [1e-4, 1e-5, 1e-6])
def test_a_start_near_the_optimum_is_solved_to_the_tolerance(distance: float):
    """The first step tells nothing of the rate of convergence."""
    collocation = Collocation([noisy(hung_cube(), noise_m=2e-3)], GUESS)
    expected = PRECISE(collocation)
    p, _ = expected.collocation.unpack(expected.z)
    near = p + distance * np.array([1, -1, 1, 1])
    positions, failure = simulate_trajectories(collocation, near)
    assert failure is None
    start = collocation.pack(near, positions)
    found = PRECISE(collocation, start=start)
    assert found.status is Status.CONVERGED
    np.testing.assert_allclose(found.q, expected.q, rtol=0, atol=1e-8)


@pytest.mark.parametrize("make", [hung_cube, released_cube, bar_let_go])
@pytest.mark.parametrize("explicit", [False, True])
def test_positions_to_start_from_need_satisfy_neither_dynamics_nor_grasps(make, explicit, rng):
    collocation = Collocation([measured(make())], GUESS, has_grasp_constraints=explicit)
    q, (x,) = collocation.unpack(initial_variables(collocation)[0])
    start = collocation.pack(q + 0.2, [x + 1e-4 * rng.normal(size=x.shape)])
    solution = ReducedSpace()(collocation, start=start)
    assert solution.status is Status.CONVERGED
    assert np.abs(relative_errors(solution)).max() < 1e-6


def test_a_start_whose_positions_lead_nowhere_is_simulated_at_its_parameters():
    seen: list[Iteration] = []
    start = cube().pack(solved_cube().q, [np.zeros((11, 81))])
    solution = ReducedSpace()(cube(), seen.append, start)
    assert solution.status is Status.CONVERGED
    assert seen[0].parameters == pytest.approx(solved_cube().parameters, rel=1e-7)
    np.testing.assert_allclose(solution.theta, solved_cube().theta, rtol=1e-6)


@pytest.mark.long
def test_few_starts_far_away_all_succeed():
    from study_starts import SwungBody, guesses, hanging_cylinder, study

    case = SwungBody(hanging_cylinder(layers=4, steps=24, scheme="midpoint"), TRUTH)
    outcomes = study(case, guesses(8, 10.0, seed=0))
    assert [outcome.number for outcome in outcomes if not outcome.success] == []
    assert np.median([outcome.sweeps for outcome in outcomes]) < 14


# Ends other than convergence


def test_no_progress_is_a_status(monkeypatch: pytest.MonkeyPatch):
    def first_only(self: Horizon, q, before, step, **options):
        if not np.array_equal(q, GUESS.guess_q):
            raise SimulationError("it fails", 0.0)
        return tried(self, q, before, step, **options)

    def not_simulated(self: Horizon, p, x=None, guess=None):
        return simulated(self, p, x) if guess is None else ([], SimulationError("it fails", 0.0))

    tried, simulated = Horizon.evaluate_step, Horizon.simulate
    monkeypatch.setattr(Horizon, "evaluate_step", first_only)
    monkeypatch.setattr(Horizon, "simulate", not_simulated)
    solution = ReducedSpace()(cube())
    assert solution.status is Status.STALLED
    np.testing.assert_allclose(solution.theta, as_theta(GUESS), rtol=1e-12)
    assert solution.max_violation_relative < 1e-3


def test_a_search_ends_at_the_noise_of_its_loss(monkeypatch: pytest.MonkeyPatch):
    collocation = Collocation([noisy(hung_cube(15))], GUESS)
    exact = ReducedSpace()(collocation)
    errors = Horizon(collocation, [exact.positions_m[0].shape[0]]).evaluate(
        *collocation.unpack(exact.z)
    )
    evaluated = Horizon._iterate_from
    rng = np.random.default_rng(1)

    def with_noise(self: Horizon, p, trajectories) -> Iterate:
        point = evaluated(self, p, trajectories)
        row = np.sqrt(2 * rng.random(1))
        return replace(point, fit=point.fit.with_rows(row, np.zeros((1, len(p)))))

    monkeypatch.setattr(Horizon, "_iterate_from", with_noise)
    solution = ReducedSpace()(collocation)
    assert solution.status is Status.CONVERGED
    assert solution.iterations < exact.iterations + 5
    count = collocation.nq
    assert (np.abs(solution.q - exact.q) < errors.fit.standard_errors[:count]).all()
    *_, rejected, feasible = solution.history
    assert feasible.noise == rejected.noise > 0
    assert feasible.violation_n < rejected.violation_n


def test_a_trial_outside_the_funnel_is_simulated(monkeypatch: pytest.MonkeyPatch):
    collocation = Collocation([noisy(hung_cube(15))], GUESS)
    infeasible_m = []
    accepted = ReducedSearch._accept

    def recorded(self: ReducedSearch, point: Iterate) -> Iterate:
        infeasible_m.append(point.feasibility_m / self.edge_m)
        return accepted(self, point)

    monkeypatch.setattr(ReducedSearch, "_accept", recorded)
    monkeypatch.setattr(reduced_search, "POLICY", reduced_search.SearchPolicy(funnel=1e-5))
    solution = ReducedSpace()(collocation)
    assert solution.status is Status.CONVERGED
    assert max(infeasible_m) < 1e-5


def test_rows_that_can_be_simulated_are_solved_first(monkeypatch: pytest.MonkeyPatch):
    """As long as the parameters are those of the guess, the last rows cannot be reached."""

    def short_at_the_guess(self: Horizon, q, x=None):
        (found,), failure = extend(self, q, x)
        if np.array_equal(q, GUESS.guess_q) and len(found.x) > 12:
            return [found.x[:12]], SimulationError("it fails", 0.12)
        return [found], failure

    extend = Horizon.simulate
    monkeypatch.setattr(Horizon, "simulate", short_at_the_guess)
    collocation = Collocation([measured(hung_cube(30))], GUESS)
    solution = ReducedSpace(ladder=(0.5, 1.0))(collocation)
    assert solution.status is Status.CONVERGED
    assert np.abs(relative_errors(solution)).max() < 1e-6


def test_rows_that_stay_out_of_reach_are_a_status(monkeypatch: pytest.MonkeyPatch):
    def short(self: Horizon, q, x=None):
        (found,), _ = extend(self, q, x)
        return [found.x[:12]], SimulationError("it fails", 0.12, 7)

    extend = Horizon.simulate
    monkeypatch.setattr(Horizon, "simulate", short)
    solution = ReducedSpace()(Collocation([measured(hung_cube(30))], GUESS))
    assert solution.status is Status.NOT_SIMULABLE
    assert solution.message.endswith("it fails (t = 0.12 s, element 7).")


def test_the_iteration_limit_is_a_status():
    solution = ReducedSpace(max_iterations=3)(cube())
    assert solution.status is Status.ITERATION_LIMIT
    assert "--set solver.reduced-space.max_iterations=6)" in solution.message
    assert solution.iterations <= 4
    assert solution.parameters == solution.history[-1].parameters


def test_a_search_whose_loss_hardly_decreases_ends_early():
    problem = Collocation([noisy(hung_cube(15))], GUESS)
    complete = ReducedSpace()(problem)
    early = ReducedSpace(least_decrease=1e-2)(problem)
    assert early.status is Status.CONVERGED
    assert early.iterations < complete.iterations
    assert complete.history[-1].loss <= early.history[-1].loss < 1.05 * complete.history[-1].loss


def test_a_part_of_the_recording_with_too_large_a_loss_ends_the_search():
    problem = Collocation([noisy(hung_cube(15))], GUESS)
    complete = ReducedSpace()(problem)
    loss = complete.history[-1].loss
    hopeless = ReducedSpace(largest_loss=1e-3 * loss)(problem)
    assert hopeless.status is Status.STALLED
    assert hopeless.iterations < complete.iterations
    possible = ReducedSpace(largest_loss=loss)(problem)
    assert possible.status is Status.CONVERGED
    np.testing.assert_allclose(possible.q, complete.q, rtol=1e-12)


@pytest.mark.parametrize("number", [2, 5])
def test_an_interruption_keeps_the_best_iterate(number: int):
    def interrupt(iteration: Iteration) -> None:
        if iteration.number >= number:
            os.kill(os.getpid(), signal.SIGINT)

    solution = ReducedSpace()(cube(), watch=interrupt)
    assert solution.status is Status.INTERRUPTED
    assert solution.parameters == solution.history[-1].parameters
    assert np.isfinite(solution.z).all()


def test_rows_not_reached_are_carried_by_the_grasp():
    def interrupt(_: Iteration) -> None:
        raise KeyboardInterrupt

    solution = ReducedSpace()(Collocation([measured(hung_cube(40))], GUESS), watch=interrupt)
    (transcription,) = solution.collocation.transcriptions
    (found,), expected = (solution.positions_m, rigid_trajectory(transcription, as_theta(GUESS)))
    away_m = np.abs(found - expected.reshape(found.shape)).max(axis=(1, 2))
    (motion,) = motion_shares(solution.collocation)
    reached = rows_of_share(motion, SHARES[0])
    assert (away_m[1:reached] > 1e-5).all()
    np.testing.assert_allclose(away_m[reached:], 0, atol=1e-12)


def test_a_misfit_far_above_the_noise_is_noted():
    made = measured(hung_cube())
    shifted = with_markers(made, made.markers.positions_m + np.array([0.01, 0.0, 0.0]))
    solution = ReducedSpace()(Collocation([shifted], GUESS))
    assert "times their standard deviations" in solution.notes[-1]
    assert not solved_cube().notes


# The curvature that Gauss–Newton leaves out


def residuals(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(q - 1)² of every entry, scaled, and their slopes."""
    weights = np.random.default_rng(0).uniform(1, 2, len(q))
    return weights * (q - 1) ** 2 + 1, np.diag(2 * weights * (q - 1))


def point_of(q: np.ndarray, before: Iterate | None = None) -> Iterate:
    """A point that has these."""
    residual, slope = residuals(q)
    crossed = np.zeros(len(q)) if before is None else residuals(before.p)[1].T @ residual
    return Iterate(
        q, [], [], SquareRootInformation.empty(len(q)).with_rows(residual, slope), crossed
    )


def test_the_learned_curvature_explains_the_last_step():
    before = point_of(np.array([2.0, 3.0]))
    after = point_of(np.array([2.1, 3.2]), before)
    b = secant_update(np.zeros((2, 2)), before, after)
    residual, slope = residuals(after.p)
    missing = (slope - residuals(before.p)[1]).T @ residual
    np.testing.assert_allclose(b @ (after.p - before.p), missing)
    np.testing.assert_allclose(b, b.T)


def test_curvature_joins_the_triangle_unless_that_is_indefinite(rng):
    triangle, right = (np.triu(rng.normal(size=(4, 4))) + 3 * np.eye(4), rng.normal(size=4))
    b = rng.normal(size=(4, 4))
    b += b.T
    fit = SquareRootInformation(np.column_stack([triangle, right]))
    joined = with_curvature(fit, b)
    np.testing.assert_allclose(joined.information, triangle.T @ triangle + b, atol=1e-12)
    np.testing.assert_allclose(joined.score, triangle.T @ right, atol=1e-12)
    assert with_curvature(fit, -100 * np.eye(4)) is fit


def test_curvature_that_rounding_makes_indefinite_is_left_out():
    """B is positive semidefinite, and many times the least curvature of SᵀS."""
    rng = np.random.default_rng(0)
    for _ in range(3000):
        triangle = np.triu(rng.normal(size=(4, 4)))
        triangle *= np.logspace(0, -rng.integers(3, 11), 4)[:, None]
        slopes = rng.normal(size=(4, 2))
        curvature = slopes @ slopes.T * 10 ** rng.uniform(0, 4)
        fit = SquareRootInformation(np.column_stack([triangle, np.ones(4)]))
        assert np.isfinite(with_curvature(fit, curvature).jacobian).all()


# History and timing


def test_the_history_contains_the_observed_iterations_and_ends_at_the_answer():
    seen: list[Iteration] = []
    solution = ReducedSpace()(cube(), watch=seen.append)
    assert list(solution.history) == seen
    numbers = [iteration.number for iteration in seen]
    assert numbers == sorted(numbers)
    assert numbers[-1] <= solution.iterations
    np.testing.assert_allclose([*seen[0].parameters.values()], as_theta(GUESS))
    np.testing.assert_allclose([*seen[-1].parameters.values()], solution.theta)
    assert seen[-1].loss == pytest.approx(cube().objective(solution.z) * cube().measurement_count)


def test_nothing_is_printed(capfd):
    ReducedSpace()(cube())
    assert capfd.readouterr() == ("", "")


def falling_block(guesses, noise_m):
    """Problem of a block that falls on a plane, with measured tracks."""
    t_s = np.arange(26) / 120
    body = cs.Body(cs.box_mesh((0.1, 0.1, 0.1), (1, 1, 1)), density_kg_m3=1000.0)
    floor = cs.Obstacle(shape=cs.Plane((0, 0, 1), (0, 0, -0.05)), friction=0.3, name="floor")
    unseen_m = np.zeros((26, len(body.nodes_m), 3))
    fall = cs.Experiment(
        body,
        t_s,
        [floor],
        cs.Markers(t_s, unseen_m, 1e-3, places_m=body.nodes_m),
        start="undeformed",
        air_density_kg_m3="none",
        nuisance=cs.Nuisance.none(),
    )
    truth = {"young_pa": 2e5, "poisson": 0.3, "gamma_r_s": 0.004, "gamma_m_1_s": 0.1}
    tracks_m = cs.simulate(fall, truth, "bdf2", substeps=4).markers_m
    tracks_m = tracks_m + noise_m * np.random.default_rng(1).normal(size=tracks_m.shape)
    unknown = {name: cs.Unknown(guess) for name, guess in guesses.items()}
    return cs.Problem([cs.with_markers(fall, tracks_m)], truth | unknown, scheme="bdf2", substeps=4)


@pytest.mark.long
def test_the_search_for_the_constants_of_a_falling_block_converges():
    guesses = {"young_pa": 1e6, "poisson": 0.4, "gamma_r_s": 0.008}
    found = cs.solve(falling_block(guesses, noise_m=1e-3))
    assert found.status is Status.CONVERGED
    assert found.iterations < 40
    assert abs(np.log10(found.parameters["young_pa"] / 2e5)) < 0.05


@pytest.mark.long
@pytest.mark.parametrize(
    ("guess_pa", "status"), [(2.001e5, Status.CONVERGED), (3e5, Status.STALLED)]
)
def test_ripples_of_the_loss_of_an_impact_end_a_search_near_its_minimum(
    monkeypatch, guess_pa, status
):
    simulate = Horizon.simulate

    def simulate_without_guess(horizon, p, trajectories=None, guess=None):
        """Fail for trials, which have a guess."""
        if guess is not None:
            return [], SimulationError("not simulated", 0.0)
        return simulate(horizon, p, trajectories)

    def fail(*_, **__):
        raise SimulationError("no sweep", 0.0)

    monkeypatch.setattr(Horizon, "simulate", simulate_without_guess)
    monkeypatch.setattr(Horizon, "evaluate_step", fail)
    collocation = falling_block({"young_pa": guess_pa}, noise_m=0.0).collocation()
    assert ReducedSpace(ladder=(1.0,))(collocation).status is status


def test_a_law_with_linear_constants_converges_on_the_toe_of_a_curve():
    # The unit of C20 and C30 is the stiffness over a strain of one, a thousandth of their values.
    strain = np.linspace(0, 0.045, 40)
    stress_pa = 8e5 * strain * np.minimum(strain / 0.012, 1.0) ** 0.8
    stress_pa = stress_pa + 250 * np.random.default_rng(2).normal(size=40)
    press = cs.Specimen("uniaxial", -strain, -stress_pa, 250.0).experiment("yeoh", "press")
    unknown = {name: cs.Unknown() for name in ("c10_pa", "c20_pa", "c30_pa")}
    solution = cs.solve(cs.Problem([press], unknown | {"kappa_pa": 1e9}))
    assert solution.status is Status.CONVERGED
    assert solution.iterations < 60
