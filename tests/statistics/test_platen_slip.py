"""Faces that may slide on platens: a systematic effect where only loads are measured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from kit.problem_files import run_command
from kit.problems import EDGE_M, IDEAL, box, nodes_where
from kit.static import PRESSED_M, TIMES, block, pressed

from collocation_sysid import (
    Collocation,
    Experiment,
    Grasp,
    PoseSequence,
    Problem,
    Unknown,
    Wrench,
    run,
    simulate,
)
from collocation_sysid.model.parameters import Parameters
from collocation_sysid.problem.options import UncertaintyOptions
from collocation_sysid.program.simulation import with_wrenches
from collocation_sysid.result.run_summary import run_summary
from collocation_sysid.statistics.budget.consider_analysis import changed_residuals
from collocation_sysid.statistics.budget.systematic_effects import ASSUMPTIONS, Assumptions

(SLIP,) = (row for row in ASSUMPTIONS if row.name == "platen_slip")
YOUNG_PA = 8e3
STATED = {"poisson": 0.45, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
SIGMA_N = 1e-3
# Displacement of the upper platen whose response is linear within a percent: strains of 0.1 %.
SMALL_M = np.array([0.0, -5e-5, -1e-4])


def bench(experiment: Experiment) -> Experiment:
    """The experiment with the force of its second grasp instead of markers."""
    lower, upper, *sides = experiment.grasps
    count = len(experiment.t_s)
    sensor = Wrench(experiment.t_s, np.zeros((count, 6)), SIGMA_N, 1e-3)
    upper = replace(upper, wrench=sensor)
    return replace(experiment, markers=None, grasps=(lower, upper, *sides))


def with_loads(fitted: Experiment, truth: Experiment) -> Experiment:
    """The fitted description with the loads that the true one has."""
    (load_n,) = simulate(truth, {"young_pa": YOUNG_PA, **STATED}).wrenches
    loads_n = np.full(load_n.shape, np.nan)
    loads_n[:, 2] = load_n[:, 2]
    return with_wrenches(fitted, [loads_n])


def load_change_n(experiment: Experiment) -> np.ndarray:
    """Change (T,) of the load if the faces slide, to first order [N]."""
    program, z = at_answer(experiment)
    changes = changed_residuals(program, z, [(SLIP, 1.0)])
    return SIGMA_N * changes.blocks[-1][:, 0, 2, 0]


def loads_n(experiment: Experiment) -> np.ndarray:
    """Loads (T,) of a simulation [N]."""
    values = {"young_pa": YOUNG_PA, **STATED}
    return simulate(experiment, values).wrenches[0][:, 2]


def small(platen: str) -> Experiment:
    """A quarter of a block, slightly pressed."""
    return bench(block(platen, t_s=TIMES[:3], z_m=SMALL_M))


def whole(platen: str, further: tuple[Grasp, ...] = ()) -> Experiment:
    """The complete block without planes of symmetry, slightly pressed."""
    body = box()
    ends = [nodes_where(body, 2, height) for height in (0.0, EDGE_M)]
    grasps = [
        Grasp(ends[0], PoseSequence.fixed(), axes=platen),
        Grasp(ends[1], pressed(TIMES[:3], SMALL_M), axes=platen),
        *further,
    ]
    sensor = Wrench(TIMES[:3], np.zeros((3, 6)), SIGMA_N, 1e-3)
    grasps[1] = replace(grasps[1], wrench=sensor)
    return Experiment(
        body, TIMES[:3], grasps, gravity_m_s2=(0.0, 0.0, 0.0), nuisance=IDEAL, kind="static"
    )


def test_the_load_changes_as_between_platens_without_friction():
    change_n = load_change_n(small("xyz"))
    expected_n = loads_n(small("z")) - loads_n(small("xyz"))
    assert np.abs(expected_n[-1]) > 0.05 * np.abs(loads_n(small("z"))[-1])
    np.testing.assert_allclose(change_n[1:], expected_n[1:], rtol=0.02)


def test_a_body_without_planes_of_symmetry_is_not_moved_as_a_whole():
    sticking = whole("xyz")
    corner, beside = (
        np.flatnonzero((sticking.body.nodes_m == np.array(place)).all(axis=1))
        for place in ([0, 0, 0], [EDGE_M, 0, 0])
    )
    # Statically determinate: rigid motions in the plane, and nothing else.
    held = (
        Grasp(corner, PoseSequence.fixed(), axes="xy"),
        Grasp(beside, PoseSequence.fixed(), axes="y"),
    )
    expected_n = loads_n(whole("z", held)) - loads_n(sticking)
    np.testing.assert_allclose(load_change_n(sticking)[1:], expected_n[1:], rtol=0.02)


@pytest.fixture(scope="module")
def sliding_test() -> Experiment:
    """A test between sliding platens down to 60 % of the height, described as sticking."""
    return with_loads(bench(block("xyz")), bench(block("z")))


def solved(experiment: Experiment, **assumptions):
    problem = Problem(
        [experiment],
        {"young_pa": Unknown(5e3), **STATED},
        uncertainty=UncertaintyOptions(assumptions=Assumptions(**assumptions)),
    )
    return run(problem, seek_causes=False)


def test_the_combined_interval_contains_the_modulus_although_the_faces_slid(sliding_test):
    fitted = solved(sliding_test)
    assert fitted.estimates["young_pa"].value < 0.9 * YOUNG_PA
    low, high = fitted.interval("young_pa")
    assert low < YOUNG_PA < high
    assert next(iter(fitted.budget["young_pa"].shares)) == "platen_slip"
    text = str(run_summary(fitted.result))
    assert "; to reduce platen slip, " in text
    assert 'platen_slip = "none"' in text


def test_glued_faces_have_no_entry_in_the_budget(sliding_test):
    fitted = solved(sliding_test, platen_slip="none")
    assert "platen_slip" not in fitted.budget["young_pa"].shares
    low, high = fitted.interval("young_pa")
    assert not low < YOUNG_PA < high


def pulled() -> Experiment:
    return bench(block("xyz", z_m=-PRESSED_M))


def seen_by_markers() -> Experiment:
    measured = bench(block("xyz"))
    return replace(measured, markers=block("xyz").markers)


def between_sliding_platens() -> Experiment:
    return bench(block("z"))


@pytest.mark.parametrize("experiment", [pulled, seen_by_markers, between_sliding_platens])
def test_faces_that_are_pulled_or_slide_or_whose_sides_are_seen_have_no_entry(experiment):
    collocation = Collocation(
        [experiment()], Parameters.from_mapping({"young_pa": Unknown(YOUNG_PA), **STATED})
    )
    x = simulate(collocation.experiments[0], {"young_pa": YOUNG_PA, **STATED}).positions_m
    z = collocation.pack(collocation.guess_p, [x.reshape(len(x), -1)])
    changes = changed_residuals(collocation, z, [(SLIP, 1.0)])
    assert not any(block.any() for block in changes.blocks)


def test_the_problem_file_states_that_faces_are_glued(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run_command("new", "mine", "--kind", "compression").code == 0
    stated = 'uncertainty.assumptions.platen_slip="none"'
    problem = Problem.read("mine/problem.toml", [stated])
    assert problem.uncertainty.assumptions.platen_slip == "none"


def test_sticking_faces_change_the_load_of_sliding_faces_as_in_a_simulation():
    program, z = at_answer(small("z"))
    (stick,) = (row for row in ASSUMPTIONS if row.name == "platen_stick")
    changes = changed_residuals(program, z, [(stick, 1.0)])
    change_n = SIGMA_N * changes.blocks[-1][:, 0, 2, 0]
    expected_n = loads_n(small("xyz")) - loads_n(small("z"))
    np.testing.assert_allclose(change_n[1:], expected_n[1:], rtol=0.02)


def at_answer(experiment: Experiment) -> tuple[Collocation, np.ndarray]:
    values = {"young_pa": YOUNG_PA, **STATED}
    parameters = Parameters.from_mapping(values | {"young_pa": Unknown(YOUNG_PA, 10.0, 1e6)})
    program = Collocation([experiment], parameters)
    x = simulate(experiment, values).positions_m
    return program, program.pack(program.guess_p, [x.reshape(len(x), -1)])
