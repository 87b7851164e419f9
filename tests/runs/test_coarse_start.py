"""Coarse start, of mesh and samples: same answer, transferred recordings, fallback, interruption."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from kit.problems import (
    TRUTH,
    box,
    driven_bar,
    hung_cube,
    measured,
    nodes_where,
    noisy,
    pressed_cube,
    vertex_markers,
)

from collocation_sysid import Body, Problem, TetMesh, Unknown
from collocation_sysid.common.step_counting import SEARCH, listen_to_activities
from collocation_sysid.errors import InputError
from collocation_sysid.fem.coarse_body import coarsen_body
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.methods.solution import Solution, Status
from collocation_sysid.program.simulation import with_markers
from collocation_sysid.recording import Experiment, Force, Nuisance, PointMass
from collocation_sysid.recording.experiment_coarsening import coarse_experiment, node_sets
from collocation_sysid.runs import smaller_problem
from collocation_sysid.runs.forward_simulation import simulate_experiments
from collocation_sysid.runs.smaller_problem import CoarseStart
from collocation_sysid.runs.solving import solve

DIVISIONS = (5, 5, 5)
NUISANCE = Nuisance.none(time_shift_s=0.003, gravity_rad=0.03, hand_eye_m=0.002, hand_eye_rad=0.02)
COARSE = ReducedSpace(coarse_start_nodes=100)
DIRECT = ReducedSpace(coarse_start=False)


def problem_of(experiment: Experiment) -> Problem:
    """All four parameters without a guess."""
    return Problem([experiment], {name: Unknown() for name in TRUTH})


def pressed_box() -> Experiment:
    """A cube of 125 nodes that a ball and a plate press."""
    pressed = pressed_cube()
    body = box(divisions=(4, 4, 4))
    held = replace(pressed.grasps[0], nodes=nodes_where(body, 2, 0.0), selection=None)
    top = nodes_where(body, 2, 0.1)
    return measured(
        replace(
            pressed,
            body=body,
            grasps=[held, *pressed.obstacles],
            markers=vertex_markers(body, top, pressed.t_s),
        )
    )


def coarse_note(solution: Solution) -> str:
    """The note on the coarse start; "" if there is none."""
    notes = [n for n in solution.notes if n.startswith("coarse start: ")]
    return notes[0] if notes else ""


@pytest.mark.parametrize("has_nuisance", [False, True])
def test_the_answer_is_that_of_the_direct_start(has_nuisance: bool):
    changes = {"nuisance": NUISANCE} if has_nuisance else {}
    experiment = noisy(hung_cube(16, divisions=DIVISIONS, **changes))
    problem = problem_of(experiment)
    direct = solve(problem, replace(DIRECT, tolerance=1e-10))
    coarse = solve(problem, replace(COARSE, tolerance=1e-10))
    assert coarse.status is direct.status is Status.CONVERGED
    for name, value in direct.parameters.items():
        assert coarse.parameters[name] == pytest.approx(value, rel=1e-6), name
    assert coarse.z == pytest.approx(direct.z, abs=1e-6)
    counts = re.findall(r"(\d+) sweeps", coarse_note(coarse))
    assert int(counts[1]) == coarse.iterations < direct.iterations
    assert f"of {6**3} nodes first" in coarse_note(coarse)
    assert not coarse_note(direct)
    errors = [n for n in coarse.notes if n.startswith("estimated error of")]
    assert len(errors) == 1
    assert "not part of the intervals" in errors[0]
    assert all(symbol in errors[0] for symbol in ("λ", "μ", "γ_r", "γ_m"))
    # History and times are those of both solves, iterations only those on the given mesh.
    assert coarse.scan is not None
    assert sum(map(int, counts)) == max(line.number for line in coarse.history)


def test_the_search_on_the_given_mesh_has_a_tolerance_of_its_own():
    problem = problem_of(noisy(hung_cube(10, divisions=DIVISIONS)))
    direct = solve(problem, replace(DIRECT, tolerance=1e-10))
    errors = []
    sweeps = []
    for tolerance in (1e-2, 1e-10):
        method = replace(COARSE, tolerance=1e-10, coarse_start_tolerance=tolerance)
        solution = solve(problem, method)
        assert solution.status is Status.CONVERGED
        errors.append(np.abs(solution.q - direct.q).max())
        sweeps.append(solution.iterations)
    assert errors[1] < 1e-7 < errors[0] < 1e-2
    assert sweeps[0] < sweeps[1]


def test_iterations_are_named_as_those_of_the_coarse_start():
    problem = problem_of(noisy(hung_cube(10, divisions=DIVISIONS)))
    events: list[str] = []
    with listen_to_activities(events.append):
        solve(problem, COARSE, watch=lambda line: events.append("iteration"))
    first = next(event for event in events if event != "iteration")
    assert first.startswith("search on ")
    end = events.index(SEARCH)
    assert "iteration" in events[1:end]
    assert set(events[end + 1 :]) == {"iteration"}


def test_an_interrupted_coarse_start_gives_its_parameters():
    experiment = noisy(hung_cube(10, divisions=DIVISIONS))
    problem = problem_of(experiment)
    seen = []

    def interrupt(line):
        seen.append(line.parameters)
        if len(seen) == 3:
            raise KeyboardInterrupt

    solution = solve(problem, COARSE, watch=interrupt)
    assert solution.status is Status.INTERRUPTED
    assert solution.parameters == pytest.approx(seen[-1])
    assert "interrupted during the search on " in solution.notes[0]
    assert len(solution.history) == 1
    assert solution.positions_m[0].shape[1:] == experiment.body.nodes_m.shape
    grasp = experiment.grasps[0]
    assert solution.positions_m[0][:, grasp.nodes] == pytest.approx(
        grasp.positions_at(experiment.body.nodes_m, experiment.t_s)
    )


def test_an_unsuccessful_coarse_start_is_noted_and_solved_directly():
    problem = problem_of(noisy(hung_cube(10, divisions=DIVISIONS)))
    limit = replace(COARSE, max_iterations=2)
    solution = solve(problem, limit)
    assert solution.status is Status.ITERATION_LIMIT
    assert solution.notes[0].startswith("no smaller problem was solved first: the search on ")
    direct = solve(problem, replace(limit, coarse_start=False))
    assert solution.q == pytest.approx(direct.q)


def test_a_mesh_that_cannot_be_coarser_is_noted():
    problem = problem_of(measured(hung_cube(10, divisions=(1, 1, 2))))
    solution = solve(problem, ReducedSpace(coarse_start_nodes=10))
    assert solution.status is Status.CONVERGED
    assert solution.notes[0].startswith("no smaller problem was solved first: only ")


def test_small_bodies_and_given_starts_have_no_coarse_start():
    problem = problem_of(measured(hung_cube(10)))
    assert CoarseStart.of(problem, ReducedSpace()) is None
    assert CoarseStart.of(problem, replace(COARSE, coarse_start=False)) is None


@pytest.mark.parametrize("value", [True, "on", 1])
def test_other_values_of_the_option_are_refused(value):
    with pytest.raises(
        InputError, match=f"coarse_start: found {value!r}; expected 'auto' or false"
    ):
        ReducedSpace(coarse_start=value)
    with pytest.raises(InputError, match="coarse_start_tolerance: found 0"):
        ReducedSpace(coarse_start_tolerance=0)
    with pytest.raises(InputError, match="coarse_start_nodes: found 0"):
        ReducedSpace(coarse_start_nodes=0)


def test_loads_and_markers_act_on_the_same_places():
    experiment = hung_cube(4, divisions=DIVISIONS)
    body = experiment.body
    tip = nodes_where(body, 2, 0.0)
    markers = vertex_markers(body, tip[:5], experiment.t_s)
    experiment = replace(
        experiment,
        markers=markers,
        masses=[PointMass(tip, 0.01)],
        forces=[Force(nodes_where(body, 0, 0.0), [1.0, 0.0, 0.0])],
    )
    relation = coarsen_body(body, len(body.nodes_m) // 8, node_sets(experiment))
    moved = coarse_experiment(experiment, relation)
    coarse_m = moved.body.nodes_m
    assert len(coarse_m) < len(body.nodes_m) / 3
    assert moved.markers.predict_positions(coarse_m) == pytest.approx(
        markers.predict_positions(body.nodes_m), abs=1e-12
    )
    for mine, its, axis, value_m in (
        (moved.grasps[0], experiment.grasps[0], 2, 0.1),
        (moved.masses[0], experiment.masses[0], 2, 0.0),
        (moved.forces[0], experiment.forces[0], 0, 0.0),
    ):
        assert len(mine.nodes) < len(its.nodes)
        assert (mine.nodes == nodes_where(moved.body, axis, value_m)).all()


def test_cavities_and_tendons_are_transferred():
    coarse_bar = driven_bar(2)
    whole = box_mesh((0.12, 0.06, 0.06), (12, 6, 6))
    inside = (np.abs(whole.centres_m - [0.06, 0.03, 0.03]) < [0.02, 0.01, 0.01]).all(axis=1)
    mesh = TetMesh(whole.points_m, whole.tetrahedra[~inside])
    body = Body(mesh, density_kg_m3=30.0)
    grasp = replace(coarse_bar.grasps[0], nodes=nodes_where(body, 0, 0.0), selection=None)
    experiment = replace(
        coarse_bar,
        body=body,
        grasps=[grasp],
        markers=vertex_markers(body, nodes_where(body, 0, 0.12), coarse_bar.t_s),
        tendons=[replace(t, body_measure=None) for t in coarse_bar.tendons],
        pressures=[replace(p, body_measure=None) for p in coarse_bar.pressures],
    )
    relation = coarsen_body(body, len(body.nodes_m) // 8, node_sets(experiment))
    moved = coarse_experiment(experiment, relation)
    assert len(moved.body.nodes_m) < len(body.nodes_m) / 2
    for mine, its in (
        (moved.tendons[0], experiment.tendons[0]),
        (moved.pressures[0], experiment.pressures[0]),
    ):
        assert mine.require_measure().evaluate(moved.body.nodes_m.reshape(1, -1)) == pytest.approx(
            its.require_measure().evaluate(body.nodes_m.reshape(1, -1)), rel=1e-6
        )


def finely_sampled() -> Problem:
    """A small swung cube with 61 samples, without guesses."""
    return problem_of(noisy(hung_cube(60)))


def test_a_search_with_many_samples_starts_with_a_part(monkeypatch):
    problem = finely_sampled()
    direct = solve(problem, DIRECT)
    assert coarse_note(direct) == ""
    simulated = simulate_experiments(problem, direct)["hung cube"]
    assert simulated.trajectory.steps_per_sample == 4
    monkeypatch.setattr(smaller_problem, "FEWEST_SAMPLES", 12)
    start = CoarseStart.of(problem, ReducedSpace())
    assert start is not None
    (some,) = start.problem.experiments
    (given,) = problem.experiments
    assert 12 <= len(some.t_s) < 16
    assert some.t_s[0] == given.t_s[0]
    solution = solve(problem)
    assert f"solved on {len(some.t_s)} of {len(given.t_s)} samples first" in coarse_note(solution)
    assert solution.status is direct.status is Status.CONVERGED
    assert len(solution.collocation.transcriptions[0].experiment.t_s) == len(given.t_s)
    for name, value in direct.parameters.items():
        assert solution.parameters[name] == pytest.approx(value, rel=1e-5), name
    simulated = simulate_experiments(problem, solution)["hung cube"]
    assert simulated.trajectory.steps_per_sample == 2


def test_all_samples_of_fast_motions_and_of_other_sensors_are_the_start(monkeypatch):
    monkeypatch.setattr(smaller_problem, "FEWEST_SAMPLES", 4)
    (swing,) = finely_sampled().experiments
    ripple_m = 0.02 * np.sin(np.arange(len(swing.t_s)) * np.pi / 2)[:, None, None]
    tracks = with_markers(swing, swing.markers.positions_m + ripple_m)
    assert CoarseStart.of(problem_of(tracks), ReducedSpace()) is None
    assert CoarseStart.of(problem_of(swing), ReducedSpace()) is not None


def test_frames_of_obstacles_are_copied():
    experiment = pressed_box()
    problem = Problem([experiment], TRUTH | {"mu_pa": Unknown(250.0)})
    start = CoarseStart.of(problem, ReducedSpace(coarse_start_nodes=60))
    assert start is not None
    (coarse,) = start.problem.experiments
    assert len(coarse.body.frames) == len(experiment.body.frames) == 2
    undeformed = [
        np.tile(e.body.nodes_m.ravel(), (len(transcription.dynamics.t_s), 1))
        for e, transcription in zip(
            start.problem.experiments, start.problem.collocation().transcriptions, strict=True
        )
    ]
    (positions,) = start.interpolated(undeformed, [len(undeformed[0])])
    given_m = experiment.body.nodes_m
    assert len(coarse.body.nodes_m) < len(given_m)
    assert positions[0] == pytest.approx(given_m.ravel(), abs=1e-12)


@pytest.mark.long
def test_a_coarse_mesh_that_determines_no_modulus_is_no_start():
    """Fifteen nodes cannot be pressed by a ball as the given mesh is."""
    problem = Problem([pressed_box()], TRUTH | {"mu_pa": Unknown(250.0)})
    solution = solve(problem, ReducedSpace(coarse_start_nodes=60))
    direct = solve(problem, DIRECT)
    assert "does not determine μ" in solution.notes[0]
    assert solution.q == pytest.approx(direct.q, abs=1e-8)
