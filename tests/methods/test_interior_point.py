"""The interior-point method: options, solutions, statuses and initial points."""

from __future__ import annotations

import os
import re
import signal
import time
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from kit.lifted import of_branches, swung
from kit.memories import ONE
from kit.problems import (
    EXPERIMENTS_AND_SCHEMES,
    GUESS,
    SMALL_EXPERIMENTS,
    TRUTH,
    as_theta,
    bar_in_two_hands,
    hung_cube,
    measured,
    noisy,
    prescribed_positions,
    relative_errors,
    released_cube,
)
from kit.rods import cable, ends, straight
from kit.wrenches import sensed, wristed_cube
from scipy.spatial.transform import Rotation
from synthetic import Swing

from collocation_sysid.errors import InputError
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.kinds.rod.element import CrossSection
from collocation_sysid.methods.condensed_program import condense
from collocation_sysid.methods.interior_point import IPOPT_STATUS, InteriorPoint
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.methods.solution import Iteration, Solution, Status
from collocation_sysid.methods.starts import initial_point
from collocation_sysid.methods.starts.initial_point import LARGEST_CORRECTION, adjoint_multipliers
from collocation_sysid.methods.starts.initial_trajectories import (
    associated_at_guess,
    initial_variables,
    rigid_trajectory,
)
from collocation_sysid.model.parameters import Parameter, Parameters, Unknown
from collocation_sysid.pipeline import run, solve
from collocation_sysid.problem import Problem
from collocation_sysid.program.collocation import Collocation, convert_variables
from collocation_sysid.program.lifted.collocation import with_lifted_variables
from collocation_sysid.program.simulation import simulate, with_markers
from collocation_sysid.recording import Experiment, Grasp, Markers, Nuisance, PoseSequence
from collocation_sysid.runs.warm_start import WarmStart

PRECISE = InteriorPoint(tolerance=1e-11)
# IPOPT alone, from the simulation at the guess.
ALONE = InteriorPoint(initial="simulation")


@cache
def cube() -> Collocation:
    return Collocation([measured(hung_cube())], GUESS)


@cache
def solved_cube() -> Solution:
    return PRECISE(cube())


# The answer


@pytest.mark.parametrize(("experiment", "scheme"), EXPERIMENTS_AND_SCHEMES)
def test_the_true_parameters_are_recovered(experiment: str, scheme: str):
    made = measured(SMALL_EXPERIMENTS[experiment](), scheme)
    solution = PRECISE(Collocation([made], GUESS, scheme))
    assert solution.status is Status.CONVERGED
    assert np.abs(relative_errors(solution)).max() < 1e-5
    assert solution.rms_m < 1e-9
    assert solution.max_violation_relative < 1e-7


@pytest.mark.long
def test_several_experiments_are_fitted_together():
    names = ("hung-cube", "bar-let-go", "cube-with-nuisance")
    made = [measured(SMALL_EXPERIMENTS[name]()) for name in names]
    solution = PRECISE(Collocation(made, GUESS))
    assert np.abs(relative_errors(solution)).max() < 1e-5


def test_substeps_are_fitted_too():
    made = measured(hung_cube(6), substeps=3)
    solution = PRECISE(Collocation([made], GUESS, substeps=3))
    assert np.abs(relative_errors(solution)).max() < 1e-5


@pytest.mark.parametrize(
    "options", [{"hessian": "gauss-newton"}, {"hessian": "limited-memory"}, {"warm_up": 0.0}]
)
def test_every_hessian_leads_to_the_same_answer(options: dict):
    solution = InteriorPoint(**options, tolerance=1e-10)(cube())
    assert solution.status.converged
    np.testing.assert_allclose(solution.theta, solved_cube().theta, rtol=1e-5)


@pytest.mark.parametrize("make", [hung_cube, released_cube])
def test_explicit_grasps_lead_to_the_same_answer(make):
    made = measured(make())
    answers = [
        PRECISE(Collocation([made], GUESS, has_grasp_constraints=explicit))
        for explicit in (False, True)
    ]
    np.testing.assert_allclose(answers[0].theta, answers[1].theta, rtol=1e-5)
    np.testing.assert_allclose(answers[0].positions_m[0], answers[1].positions_m[0], atol=1e-9)


def test_the_positions_satisfy_grasp_and_motion():
    solution = solved_cube()
    transcription = cube().transcriptions[0]
    positions = solution.positions_m[0]
    np.testing.assert_allclose(
        positions.reshape(len(positions), -1)[:, transcription.experiment.prescribed_dofs],
        prescribed_positions(transcription.experiment, transcription.dynamics.t_s),
        atol=1e-9,
    )
    assert solution.multipliers.shape == (cube().constraint_count,)


# The start


def soft_guess() -> Parameters:
    """So soft that no rest state is found."""
    soft = [replace(item, guess=item.guess / 100, lower=1e-3) for item in GUESS.items[:2]]
    return Parameters((*soft, *GUESS.items[2:]))


@pytest.mark.long
def test_a_guess_that_cannot_be_simulated_starts_from_the_rigid_shape():
    collocation = Collocation([measured(hung_cube())], soft_guess())
    start, notes = initial_variables(collocation)
    transcription = collocation.transcriptions[0]
    expected = rigid_trajectory(transcription, as_theta(soft_guess()))
    np.testing.assert_allclose(collocation.unpack(start)[1][0], expected, atol=1e-15)
    assert len(notes) == 1
    assert notes[0].startswith("experiment 'hung cube': the simulation at the guess failed (")
    assert notes[0].endswith(
        "the initial trajectory is the rest shape moving rigidly with the grasp"
    )
    solution = replace(PRECISE, initial="simulation")(collocation)
    *others, certificate = solution.notes
    assert others == notes
    assert certificate.startswith("optimality of the complete program")
    assert solution.status is Status.CONVERGED
    assert np.abs(relative_errors(solution)).max() < 1e-5


def test_a_guess_that_can_be_simulated_starts_on_the_constraints():
    start, notes = initial_variables(cube())
    assert notes == []
    assert np.abs(cube().constraint_values(start)).max() < 1e-12


def test_the_start_shape_is_carried_with_the_grasp():
    transcription = cube().transcriptions[0]
    x = rigid_trajectory(transcription, as_theta(TRUTH)).reshape(transcription.grid_times, -1, 3)
    np.testing.assert_allclose(
        x.reshape(len(x), -1)[:, transcription.experiment.prescribed_dofs],
        prescribed_positions(transcription.experiment, transcription.dynamics.t_s),
        atol=1e-12,
    )
    lengths = np.linalg.norm(x - x[:, :1], axis=2)
    np.testing.assert_allclose(lengths, np.broadcast_to(lengths[0], lengths.shape), atol=1e-12)


def test_a_given_start_is_used():
    again = InteriorPoint()(cube(), start=solved_cube().z)
    assert again.history[0].parameters == solved_cube().parameters
    assert again.history[0].loss == pytest.approx(solved_cube().history[-1].loss, abs=1e-9)
    np.testing.assert_allclose(again.theta, solved_cube().theta, rtol=1e-5)


# The initial point


def note_of(solution: Solution) -> str:
    """The note on the initial point."""
    (note,) = (each for each in solution.notes if each.startswith("initial point: "))
    return note


def test_ipopt_starts_near_the_optimum_with_a_note():
    seen: list[Iteration] = []
    solution = PRECISE(cube(), watch=seen.append)
    assert re.fullmatch(
        r"initial point: \d+ sweeps of reduced space \(converged\); from there the complete program "
        "was given to IPOPT",
        note_of(solution),
    )
    assert solution.iterations <= 4
    coarse = ReducedSpace(tolerance=LARGEST_CORRECTION)(cube())
    assert len(seen) == len(coarse.history) + solution.iterations + 1
    assert list(solution.history) == seen
    numbers = [line.number for line in seen]
    assert numbers == sorted(numbers)
    np.testing.assert_allclose([*seen[0].parameters.values()], as_theta(GUESS))


def test_the_initial_point_is_not_the_answer():
    made = measured(hung_cube())
    tracks_m = made.markers.positions_m
    noise_m = 1e-3 * np.random.default_rng(5).normal(size=tracks_m.shape)
    noisy = Collocation([with_markers(made, tracks_m + noise_m)], GUESS)
    solution = InteriorPoint(max_iterations=1, tolerance=1e-15)(noisy)
    assert solution.status is Status.ITERATION_LIMIT
    assert "--set solver.interior-point.max_iterations=2)" in solution.message
    coarse = ReducedSpace(tolerance=LARGEST_CORRECTION)(noisy)
    assert not np.array_equal(solution.z, coarse.z)


@pytest.mark.long
def test_ipopt_starts_without_a_motion_from_reduced_space():
    collocation = Collocation([measured(hung_cube())], soft_guess())
    solution = PRECISE(collocation)
    assert "found none" in note_of(solution)
    assert any("the rest shape moving rigidly" in note for note in solution.notes)
    assert solution.status is Status.CONVERGED
    assert np.abs(relative_errors(solution)).max() < 1e-5


@pytest.mark.parametrize("end", [signal.SIGINT, None])
def test_the_search_for_the_initial_point_ends_at_once_and_keeps_its_best(
    end: signal.Signals | None,
):
    def interrupt(iteration: Iteration) -> None:
        if iteration.number == 2 and end is not None:
            os.kill(os.getpid(), end)
        if iteration.number == 2 and end is None:
            time.sleep(0.3)

    method = InteriorPoint(max_time_s=1e6 if end else 0.3)
    solution = method(cube(), watch=interrupt)
    assert solution.status is (Status.INTERRUPTED if end else Status.TIME_LIMIT)
    assert solution.method == "interior-point"
    assert solution.iterations == 0
    assert solution.history[-1].number < len(ReducedSpace()(cube()).history)
    assert np.isfinite(solution.rms_m)


@pytest.mark.parametrize("name", ["memory", "places", "wrench"])
def test_initial_multipliers_balance_the_lagrangian(name: str):
    make, truth, _ = UNKNOWN[name]
    given = {k: Unknown(v, 0.1 * v, 10 * v) for k, v in truth.items()}
    collocation = Problem([make()], given, scheme="midpoint").collocation()
    z, _ = initial_variables(collocation)
    program = condense(with_lifted_variables(collocation))
    found = adjoint_multipliers(program, collocation, z)
    assert found is not None
    constraints, bounds = found
    at = convert_variables(z, collocation, program)
    slope = program.gradient(at) + program.jacobian(at).T @ constraints
    lower, upper = program.bounds()
    of_p = np.zeros(program.variable_count, dtype=bool)
    of_p[: program.nq] = of_p[program.phi_columns] = True
    scale = np.abs(program.gradient(at)).max()
    assert np.abs(slope[~of_p & (lower < upper)]).max() < 1e-8 * scale
    distance = np.where(slope > 0, at - lower, upper - at)
    active = (lower < upper) & (np.abs(slope) > distance)
    np.testing.assert_array_equal(bounds, np.where(active, -slope, 0.0))


def test_a_parameter_at_its_bound_needs_no_iteration_from_the_answer():
    """The multiplier of an active bound is part of the initial multipliers."""
    low_pa = 1.5 * TRUTH["mu_pa"]
    stiff = Parameter("mu_pa", 2 * TRUTH["mu_pa"], low_pa, 1e5)
    bounded = Parameters(tuple(stiff if item.name == "mu_pa" else item for item in GUESS.scalars))
    collocation = Collocation([measured(hung_cube())], bounded)
    answer = ReducedSpace()(collocation)
    found = InteriorPoint()(collocation, start=answer.z)
    assert found.status is Status.CONVERGED
    assert found.iterations <= 5
    np.testing.assert_allclose(found.q, answer.q, atol=1e-6)
    assert found.parameters["mu_pa"] == pytest.approx(low_pa, rel=1e-6)


def test_an_answer_that_meets_the_conditions_is_not_factorised():
    answer = ReducedSpace()(cube())
    found = InteriorPoint()(cube(), start=answer.z)
    assert found.status is Status.CONVERGED
    assert found.iterations == 0
    assert found.kkt_residual < 1e-8


def test_ipopt_continues_a_search_that_reached_its_limit(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(initial_point, "MAX_SWEEPS", 5)
    solution = PRECISE(cube())
    assert "(iteration-limit)" in note_of(solution)
    np.testing.assert_allclose(solution.theta, as_theta(TRUTH), rtol=1e-5)


SOFT = {"lambda_pa": 1300.0, "mu_pa": 870.0, "gamma_r_s": 0.01, "gamma_m_1_s": 0.5}
# Guesses over true values, and bounds.
SOFT_GUESSES = {
    "lambda_pa": (1 / 3, 1.0, 1e6),
    "mu_pa": (1 / 3, 1.0, 1e6),
    "gamma_r_s": (3.6, 1e-5, 1.0),
    "gamma_m_1_s": (3.0, 1e-3, 100.0),
}
SOFT_STEP_S, SOFT_NOISE_M, SOFT_MARKERS = 0.01, 5e-4, 9


@cache
def soft_bar(divisions: tuple[int, int, int] = (4, 1, 1), samples: int = 31) -> Problem:
    """A soft bar whose markers have unknown places; its guesses are wrong by factors of three."""
    body = Body(box_mesh((0.22, 0.035, 0.05), divisions), density_kg_m3=95.0)
    motion = Swing(
        duration_s=(samples - 1) * SOFT_STEP_S,
        amplitude_m=(0.03, 0.04, 0.03),
        amplitude_rad=(0.2, 0.3, 0.3),
        frequency_hz=(1.1, 1.4, 1.7),
        rise_s=0.3,
        start=Rotation.identity(),
    )
    poses = motion.poses(SOFT_STEP_S)
    is_clamped = body.nodes_m[:, 0] < 1e-9
    rng = np.random.default_rng(1)
    marked = np.sort(rng.choice(np.flatnonzero(~is_clamped), SOFT_MARKERS, replace=False))
    no_tracks_m = np.zeros((samples, SOFT_MARKERS, 3))
    markers = Markers(poses.t_s, no_tracks_m, SOFT_NOISE_M, places_m=body.nodes_m[marked])
    grasp = Grasp(np.flatnonzero(is_clamped), poses)
    experiment = Experiment(body, poses.t_s, [grasp], markers, name="soft bar")
    tracks_m = simulate(experiment, SOFT, timestep_s=SOFT_STEP_S / 8).markers_m
    tracks_m = tracks_m + SOFT_NOISE_M * rng.normal(size=tracks_m.shape)
    unplaced_markers = Markers(poses.t_s, tracks_m, SOFT_NOISE_M, markers.names)
    described = replace(experiment, markers=unplaced_markers, nuisance=Nuisance())
    guesses = {
        name: Unknown(SOFT[name] * factor, *bounds)
        for name, (factor, *bounds) in SOFT_GUESSES.items()
    }
    return Problem([described], guesses, scheme="midpoint")


def alone_from_the_guess(problem: Problem) -> Solution:
    """IPOPT from the simulation at the guess, with unknown places where that has them."""
    return ALONE(associated_at_guess(problem.collocation()))


@pytest.mark.long
def test_distant_guesses_lead_to_the_optimum_of_reduced_space():
    problem = soft_bar()
    expected = solve(problem, ReducedSpace(tolerance=1e-9))
    found = solve(problem, InteriorPoint())
    assert found.status is Status.CONVERGED
    assert "sweeps of reduced space" in note_of(found)
    assert found.iterations <= 5
    np.testing.assert_allclose(found.q, expected.q, atol=1e-6)
    assert found.kkt_residual < 1e-7


@pytest.mark.long
def test_a_finer_soft_bar_converges_from_distant_guesses_too():
    problem = soft_bar((5, 2, 2), 41)
    expected = solve(problem, ReducedSpace(tolerance=1e-9))
    found = solve(problem, InteriorPoint())
    assert found.status is Status.CONVERGED
    assert found.iterations <= 5
    np.testing.assert_allclose(found.q, expected.q, atol=1e-6)
    alone = alone_from_the_guess(problem)
    assert alone.status is Status.CONVERGED
    assert alone.iterations <= 25


@pytest.mark.long
def test_rows_of_the_equations_do_not_slow_the_steps_of_ipopt_alone():
    soft = soft_bar()
    wrong = {"mu_pa": 3 * SOFT["mu_pa"]}
    found = alone_from_the_guess(replace(soft, parameters=soft.parameters.with_guess(wrong)))
    assert found.status is Status.CONVERGED
    assert found.iterations <= 14


@pytest.mark.long
def test_from_the_answer_of_reduced_space_five_iterations_suffice(tmp_path):
    problem = soft_bar()
    answer = run(problem, ReducedSpace(), seek_causes=False)
    substeps = answer.solution.collocation.substeps
    folder = answer.save(tmp_path / "answer")
    found = run(problem, InteriorPoint(), start=folder, seek_causes=False).solution
    assert found.status is Status.CONVERGED
    assert found.iterations <= 5
    assert found.collocation.substeps == substeps
    assert found.history[0].misfit == pytest.approx(answer.solution.history[-1].misfit, rel=1e-2)
    again = solve(problem, InteriorPoint(), start=folder)
    found_by = r"initial point: (the given initial values|1 sweep|[2-9] sweeps)\b"
    assert re.match(found_by, note_of(again))


@pytest.mark.long
def test_a_start_with_finer_steps_is_continued_with_finer_steps():
    problem = soft_bar()
    answer = WarmStart.of(ReducedSpace()(replace(problem, substeps=2).collocation()))
    assert answer.substeps == 2
    assert solve(problem, start=answer).collocation.substeps == 2
    assert solve(replace(problem, substeps=1), start=answer).collocation.substeps == 1


# What is unknown by default


def unplaced() -> Experiment:
    """A bar in one hand; nothing is known of its markers but what they show."""
    bar = bar_in_two_hands(16)
    held = replace(bar, grasps=bar.grasps[1:])
    seen = noisy(held).markers
    return replace(held, markers=Markers(seen.t_s, seen.positions_m, seen.sigma_m, seen.names))


def remembering() -> Experiment:
    """A small cube with a memory."""
    made = swung(of_branches(1), ONE, 12)
    tracks = made.markers.positions_m
    noise = 1e-4 * np.random.default_rng(5).normal(size=tracks.shape)
    return with_markers(made, tracks + noise)


UNKNOWN = {
    "places": (unplaced, TRUTH, "gamma_m_1_s"),
    "wrench": (lambda: noisy(sensed(wristed_cube(12)), 1e-4), TRUTH, "gamma_m_1_s"),
    "memory": (remembering, ONE, "prony_1.tau_s"),
}
# IPOPT's line of an iteration, with lg(rg): by how much it shifted the Hessian's diagonal.
ITERATION = r"^ +\d+r?(?: +\S+){5} +(-|-?\d\S+) +\S+ +\S+ +\d+"


@pytest.mark.long
@pytest.mark.parametrize("name", UNKNOWN)
def test_default_unknowns_are_found_without_shifting_the_hessian(name: str, capfd):
    make, truth, known = UNKNOWN[name]
    factors = dict(zip(truth, (2.0, 0.5, 2.0, 0.5, 1.5, 1.5), strict=False))
    given = {k: v if k == known else Unknown(factors[k] * v) for k, v in truth.items()}
    problem = Problem([replace(make(), nuisance=Nuisance())], given, scheme="midpoint")
    expected = solve(problem, ReducedSpace(tolerance=1e-10))
    precise = replace(ALONE, tolerance=1e-10, ipopt={"print_level": 5})
    found = precise(expected.collocation)  # where its markers are read
    shifts = re.findall(ITERATION, capfd.readouterr().out, re.MULTILINE)
    assert found.status.converged
    assert len(shifts) == found.iterations + 1
    assert set(shifts) == {"-"}
    np.testing.assert_allclose(found.q, expected.q, atol=3e-4)


# Ends other than convergence


def test_the_iteration_limit_is_a_status_and_violations_are_listed():
    solution = replace(ALONE, max_iterations=2)(cube())
    assert solution.status is Status.ITERATION_LIMIT
    assert not solution.status.converged
    assert solution.message.endswith("(IPOPT: Maximum_Iterations_Exceeded)")
    worst = solution.largest_violations[0]
    assert worst.experiment == "hung cube"
    assert abs(worst.residual_n) == pytest.approx(solution.max_violation_n)
    assert 1e-8 < solution.max_violation_relative < 1


def test_the_time_limit_is_a_status():
    solution = InteriorPoint(max_time_s=1e-9)(cube())
    assert solution.status is Status.TIME_LIMIT


def test_a_linear_solver_that_is_not_installed_is_a_refusal_with_a_remedy():
    solution = InteriorPoint(linear_solver="ma27")(cube())
    assert solution.status is Status.REFUSED
    assert solution.iterations == 0
    assert "linear_solver = 'ma27' probably needs a library" in solution.notes[-1]
    assert "'mumps'" in solution.notes[-1]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"linear_solver": "lapack"}, '"lapack" is not a valid setting for Option: linear_solver'),
        ({"ipopt": {"toll": 1e-3}}, "solver: IPOPT cannot be set up: No such IPOPT option: toll"),
        ({"ipopt": {"mu_init": -1.0}}, '"-1" is not a valid setting for Option: mu_init'),
        ({"hessian": "bfgs"}, "hessian: found 'bfgs'; expected 'exact', 'gauss-newton' or"),
    ],
)
def test_unknown_options_are_refused(options: dict, message: str, capfd):
    with pytest.raises(InputError) as caught:
        InteriorPoint(**options)(cube())
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")


@pytest.mark.long
def test_nothing_is_printed(capfd):
    InteriorPoint()(Collocation([measured(hung_cube())], soft_guess()))
    assert capfd.readouterr() == ("", "")


def test_an_interruption_keeps_the_best_iterate():
    def interrupt(iteration: Iteration) -> None:
        if iteration.number == 4:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.5)  # until it is heard, on the main thread

    handler = signal.getsignal(signal.SIGINT)
    solution = ALONE(cube(), watch=interrupt)
    assert signal.getsignal(signal.SIGINT) is handler
    assert solution.status is Status.INTERRUPTED
    assert solution.iterations == 4
    assert len(solution.history) == 5
    best = min(solution.history, key=lambda iteration: iteration.loss)
    assert solution.parameters == best.parameters
    assert sum(part.loss for part in solution.parts) == pytest.approx(best.loss)
    assert solution.max_violation_n == pytest.approx(best.violation_n)


@pytest.mark.parametrize(
    "name",
    ["objective", "gradient", "constraint_values", "constraints_and_jacobian", "hessian_values"],
)
def test_an_error_in_an_evaluation_reaches_the_caller(name: str, monkeypatch, capfd):
    def broken(*_: object, **__: object) -> None:
        raise KeyboardInterrupt(name)

    monkeypatch.setattr(Collocation, name, broken)
    with pytest.raises(KeyboardInterrupt, match=name):
        ALONE(cube())
    assert capfd.readouterr() == ("", "")


# Status


def test_every_ipopt_status_has_a_meaning():
    converged = {"Solve_Succeeded", "Solved_To_Acceptable_Level", "Feasible_Point_Found"}
    assert set(IPOPT_STATUS) == converged | {
        "Infeasible_Problem_Detected",
        "Search_Direction_Becomes_Too_Small",
        "Diverging_Iterates",
        "User_Requested_Stop",
        "Maximum_Iterations_Exceeded",
        "Maximum_CpuTime_Exceeded",
        "Maximum_WallTime_Exceeded",
        "Restoration_Failed",
        "Error_In_Step_Computation",
        "Invalid_Number_Detected",
        "Not_Enough_Degrees_Of_Freedom",
        "Invalid_Problem_Definition",
        "Invalid_Option",
        "Insufficient_Memory",
        "Unrecoverable_Exception",
        "NonIpopt_Exception_Thrown",
        "Internal_Error",
    }
    assert all(isinstance(status, Status) for status in IPOPT_STATUS.values())
    assert {name for name, status in IPOPT_STATUS.items() if status.converged} == converged


@pytest.mark.parametrize("status", Status)
def test_every_status_has_a_sentence(status: Status):
    assert status.sentence[0].isupper()
    assert status.sentence.endswith(".")


def test_the_message_contains_the_status_of_ipopt():
    expected = f"{Status.CONVERGED.sentence} (IPOPT: Solve_Succeeded)"
    assert solved_cube().message == expected


# History and timing


def test_the_history_counts_iterations_and_ends_at_the_answer():
    seen: list[Iteration] = []
    solution = ALONE(cube(), watch=seen.append)
    assert list(solution.history) == seen
    assert [iteration.number for iteration in seen] == list(range(solution.iterations + 1))
    assert (np.diff([iteration.time_s for iteration in seen]) >= 0).all()
    np.testing.assert_allclose([*seen[0].parameters.values()], as_theta(GUESS))
    np.testing.assert_allclose([*seen[-1].parameters.values()], solution.theta)
    loss = cube().objective(solution.z) * cube().measurement_count
    assert seen[-1].loss == pytest.approx(loss)


def swinging_cable(scheme: str, axial_n: float = 200.0) -> Problem:
    """A cable of 11 sections that hangs from a moving hand, from guesses of EI and of damping that are
    half as large again as they should be.
    """
    mesh = straight(0.6, CrossSection.round(0.006), 11, (0, 0, -1))
    body = cable(mesh)
    t_s = np.arange(31) * 0.01
    sway_m = np.outer(0.05 * (1 - np.cos(10 * t_s)), [1, 0.5, 0.2])
    hand = PoseSequence(t_s, sway_m, np.tile([0, 0, 0, 1.0], (31, 1)))
    markers = Markers(t_s, np.zeros((31, 1, 3)), 5e-4, places_m=[mesh.place_m(0.6)])
    grasp = Grasp(ends(body)[0], hand)
    swing = Experiment(
        body, t_s, [grasp], markers, nuisance=Nuisance.none(), air_density_kg_m3="none"
    )
    truth = {"bending_n_m2": 1e-3, "torsion_n_m2": 3e-4, "axial_n": axial_n}
    truth |= {"gamma_r_s": 2e-3, "gamma_m_1_s": 0.3}
    seen = with_markers(swing, simulate(swing, truth, scheme, substeps=1).markers_m)
    unknown = {"bending_n_m2": Unknown(1.5e-3), "gamma_r_s": Unknown(3e-3)}
    return Problem([seen], truth | unknown, substeps=1, scheme=scheme)


@pytest.mark.long
@pytest.mark.parametrize(
    ("initial", "scheme"),
    [("reduced-space", "midpoint"), ("simulation", "midpoint"), ("simulation", "bdf2")],
)
def test_the_constants_of_a_cable_are_those_of_reduced_space(initial, scheme):
    found = solve(swinging_cable(scheme), InteriorPoint(initial=initial))
    assert found.status.converged
    assert found.iterations <= 10 + (initial == "simulation")
    assert found.parameters["bending_n_m2"] == pytest.approx(1e-3, rel=1e-6)
    assert found.parameters["gamma_r_s"] == pytest.approx(2e-3, rel=1e-5)


@pytest.mark.long
def test_the_matrix_of_a_cable_does_not_grow_with_its_stiffness_along_itself():
    matrices = []
    for axial_n in (200.0, 2e6):
        collocation = swinging_cable("bdf2", axial_n).collocation()
        program = with_lifted_variables(collocation)
        (transcription,) = collocation.transcriptions
        still_m = np.tile(transcription.body.nodes_m.ravel(), (transcription.grid_times, 1))
        matrices.append(program.jacobian(program.pack(collocation.guess_p, [still_m])))
    # But for the weights of stresses, which become zero, in their equations.
    assert abs(matrices[1] - matrices[0]).max() < 1e-2
    assert abs(matrices[1]).max() < 1e3
