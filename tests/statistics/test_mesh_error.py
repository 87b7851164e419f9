"""The estimated effect of the mesh agrees with solves on a finer mesh, and intervals contain it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from kit.problems import measured, pressed_cube

import collocation_sysid as cs
from collocation_sysid.judge.posterior import Effects, Posterior
from collocation_sysid.methods.solve_recorder import initial_variables
from collocation_sysid.program.simulation import with_wrenches
from collocation_sysid.runs import mesh_resolution
from collocation_sysid.runs.mesh_resolution import mesh_changes, mesh_resolution_concerns
from collocation_sysid.runs.numerical_error import finer_mesh
from collocation_sysid.runs.solving import solve
from collocation_sysid.statistics.budget.consider_analysis import ResidualChanges
from collocation_sysid.statistics.budget.discretisation_error import (
    MESH_ORDER,
    estimate_changes,
    extrapolated,
)
from collocation_sysid.statistics.budget.mesh_error import mesh_residual_changes
from collocation_sysid.statistics.linearised import linearise_fit, parameter_values
from collocation_sysid.statistics.uncertainty import ErrorModel

TRUTH = {"young_pa": 15e3, "poisson": 0.33, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
GUESS = TRUTH | {"young_pa": cs.Unknown(14e3), "poisson": cs.Unknown(0.3)}
LENGTH_M = 0.06
NO_TURN = [0, 0, 0, 1.0]


def deformed_block(element: str, prony: Sequence[str] = ()) -> cs.Experiment:
    """A block with two elements across, bent, compressed and twisted between its ends."""
    body = cs.Body(
        cs.box_mesh((0.03, 0.03, LENGTH_M), (2, 2, 3)),
        density_kg_m3=1000.0,
        element=element,
        prony=prony,
    )
    t_s = np.arange(4.0)
    moved_m = np.array([[0, 0, 0], [6e-3, 0, 0], [0, 0, 4e-3], [0, 0, 0]])
    turns = np.array([NO_TURN, NO_TURN, NO_TURN, [0, 0, np.sin(0.1), np.cos(0.1)]])
    still = cs.PoseSequence(t_s, np.zeros((4, 3)), np.tile(NO_TURN, (4, 1)))
    top = cs.Grasp(cs.Box((-1, -1, LENGTH_M - 1e-9), (1, 1, 1)), still)
    wrench = cs.Wrench(t_s, np.zeros((4, 6)), 1e-3, 1e-5)
    bottom = cs.Grasp(
        cs.Box((-1, -1, -1), (1, 1, 1e-9)), cs.PoseSequence(t_s, moved_m, turns), wrench=wrench
    )
    places_m = [[0, 0, 0.02], [0.03, 0, 0.02], [0, 0.03, 0.04], [0.03, 0.03, 0.04]]
    markers = cs.Markers(t_s, np.zeros((4, 4, 3)), 1e-4, places_m=places_m)
    return cs.Experiment(
        body,
        t_s,
        [top, bottom],
        markers,
        kind="static",
        nuisance=cs.Nuisance.none(),
        air_density_kg_m3="none",
    )


@cache
def coarse_problem(element: str, poisson: float = TRUTH["poisson"]) -> cs.Problem:
    """The block with the measurements of a mesh with half the edge lengths; with another Poisson's
    ratio than that of `TRUTH`, it is known.
    """
    constants = GUESS if poisson == TRUTH["poisson"] else GUESS | {"poisson": poisson}
    problem = cs.Problem([deformed_block(element)], constants)
    (fine,) = finer_mesh(problem).experiments
    truth = cs.simulate(fine, TRUTH | {"poisson": poisson})
    (coarse,) = problem.experiments
    measured = with_wrenches(cs.with_markers(coarse, truth.markers_m), truth.wrenches)
    return replace(problem, experiments=[measured])


def mesh_change(solution: cs.Solution) -> np.ndarray:
    """Change of q with half the edge lengths, to first order."""
    fit = linearise_fit(solution.collocation, solution.z)
    changes = mesh_residual_changes(solution.collocation, solution.z)
    return estimate_changes(fit, changes)[: len(solution.q), 0]


def trembling_bar(divisions: Sequence[int]) -> cs.Experiment:
    """A nearly incompressible bar, held at one end by a hand that trembles and then swings."""
    mesh = cs.box_mesh((0.12, 0.03, 0.02), divisions)
    body = cs.Body(mesh, density_kg_m3=1070.0, element="tet10", rest_shape="stress_free")
    t_s = 0.01 * np.arange(31)
    poses = np.tile(np.eye(4), (31, 1, 1))
    poses[:, 2, 3] = 0.01 * np.sin(np.pi * np.clip(t_s - 0.1, 0, 0.15) / 0.15)
    poses[:, :3, 3] += 2e-5 * np.random.default_rng(1).normal(size=(31, 3))
    held = cs.Grasp(cs.Box((-1, -1, -1), (1e-9, 1, 1)), poses)
    places_m = [[0.12, 0.016, 0.008], [0.066, 0.02, 0.02]]
    markers = cs.Markers(t_s, np.zeros((31, 2, 3)), 1e-3, places_m=places_m)
    return cs.Experiment(body, t_s, [held], markers, nuisance=cs.Nuisance.none())


def test_estimated_change_of_a_motion_is_that_of_a_simulation_on_the_finer_mesh():
    constants = {"young_pa": 1.5e5, "poisson": 0.45, "gamma_r_s": 2e-3, "gamma_m_1_s": 0.1}
    coarse, fine = (trembling_bar(divisions) for divisions in ((6, 1, 1), (12, 2, 2)))
    moved_m = [cs.simulate(e, constants, "midpoint", substeps=1).markers_m for e in (coarse, fine)]
    seen = cs.with_markers(coarse, moved_m[0])
    unknown = constants | {"young_pa": cs.Unknown(1.5e5)}
    solution = solve(cs.Problem([seen], unknown, scheme="midpoint", substeps=1))
    (change,) = mesh_residual_changes(solution.collocation, solution.z)
    estimated_m, true_m = 1e-3 * change[..., 0], moved_m[1] - moved_m[0]
    length_m = np.linalg.norm(estimated_m)
    assert np.sum(estimated_m * true_m) > 0.98 * length_m * np.linalg.norm(true_m)
    assert 0.85 < np.linalg.norm(true_m) / length_m < 1.25
    assert np.abs(estimated_m - true_m)[:10].max() < 0.1 * np.abs(true_m).max()


@pytest.mark.long
@pytest.mark.parametrize(("element", "least", "most"), [("tet4", 0.6, 1.0), ("tet10", 0.7, 1.5)])
def test_estimated_change_is_nearly_that_of_a_solve_on_the_finer_mesh(element, least, most):
    solution = solve(coarse_problem(element))
    change = mesh_change(solution)
    before = solution.parameters["young_pa"]
    after = parameter_values(solution.collocation, solution.q + change)["young_pa"]
    assert abs(before / TRUTH["young_pa"] - 1) > 0.04
    assert least < np.log(after / before) / np.log(TRUTH["young_pa"] / before) < most


@pytest.mark.long
@pytest.mark.parametrize("poisson", [0.45, 0.49, 0.4999])
def test_estimated_change_of_a_nearly_incompressible_body_is_as_small_as_the_true_one(poisson):
    solution = solve(coarse_problem("tet10-p0", poisson))
    change = mesh_change(solution)
    before = solution.parameters["young_pa"]
    after = parameter_values(solution.collocation, solution.q + change)["young_pa"]
    needed = np.log(TRUTH["young_pa"] / before)
    assert 0.004 < needed < 0.008
    assert needed < np.log(after / before) < 2 * needed


@pytest.mark.parametrize("size", [0.0, 0.5, 1.0, 1.5])
def test_residuals_of_static_tests_are_judged_with_the_error_of_the_mesh_that_they_show(size):
    """An error of the mesh that is `size` times as large as estimated."""
    collocation = coarse_problem("tet10").collocation()
    z, _ = initial_variables(collocation)
    fit = linearise_fit(collocation, z)
    changes = [extrapolated(c, MESH_ORDER) for c in mesh_residual_changes(collocation, z)]
    rng = np.random.default_rng(0)
    seen = [
        replace(b, residual=(rng.normal(size=b.residual.shape) - size * c[..., 0]) * b.is_measured)
        for b, c in zip(fit.blocks, changes, strict=True)
    ]
    nothing = ResidualChanges((), [each[..., :0] for each in changes])
    effects = Effects.from_changes(nothing, {}, {}, {"mesh": changes})
    found = Posterior.from_fit(
        replace(fit, blocks=tuple(seen)), effects, collocation.parameters, z[: collocation.nq],
        ErrorModel(errors="independent"),
        is_learnt=False,
    )  # fmt: skip
    assert max(np.abs(each).max() for each in changes) > 5.0
    # Two standard deviations of 70 degrees of freedom are 0.34.
    assert 0.66 < found.uncertainty.level.pooled < 1.34
    assert found.considered.means == pytest.approx([2.0])


@pytest.mark.long
@pytest.mark.parametrize("element", ["tet4", "tet10", "tet10-p0"])
def test_the_posterior_is_nearer_to_the_truth_and_contains_the_error_of_the_mesh(element):
    problem = coarse_problem(element)
    solution = solve(problem)
    parameters = solution.collocation.parameters
    fit = linearise_fit(solution.collocation, solution.z)
    changes, by_mesh, note = mesh_changes(problem, solution, fit)
    assert not note
    assert by_mesh is not None
    nothing = ResidualChanges((), [each[..., :0] for each in changes])
    of_mesh = {"mesh": [extrapolated(each, MESH_ORDER) for each in changes]}
    effects = Effects.from_changes(nothing, {}, {}, of_mesh)
    independent = ErrorModel(errors="independent")
    found = Posterior.from_fit(fit, effects, parameters, solution.q, independent)
    (of_row,) = found.effect_estimates
    assert (of_row.name, of_row.mean, of_row.deviation) == ("mesh", 1.0, 0.5)
    for name in ("young_pa", "poisson"):
        optimum, estimate = solution.parameters[name], found.reported(name)
        assert abs(estimate.value - TRUTH[name]) < abs(optimum - TRUTH[name])
        assert estimate.combined95 is not None
        low, high = estimate.combined95
        assert low < TRUTH[name] < high
    shares = found.budget["young_pa"].shares
    assert shares["mesh"] > 0


@pytest.mark.long
def test_a_body_with_memory_has_a_mesh_error():
    experiment = deformed_block("tet4", prony=["prony_1"])
    constants = TRUTH | {"prony_1.share": 0.5, "prony_1.tau_s": 1.0}
    truth = cs.simulate(experiment, constants)
    measured = with_wrenches(cs.with_markers(experiment, truth.markers_m), truth.wrenches)
    problem = cs.Problem([measured], constants | {"young_pa": cs.Unknown(14e3)})
    solution = solve(problem)
    change = mesh_change(solution)
    after = parameter_values(solution.collocation, solution.q + change)["young_pa"]
    assert 1.02 < after / TRUTH["young_pa"] < 1.3  # a finer mesh needs a stiffer material


@pytest.mark.long
def test_recordings_that_are_declared_to_be_simulated_have_no_mesh_error():
    exact = cs.UncertaintyOptions(assumptions=cs.Assumptions.exact())
    problem = replace(coarse_problem("tet10"), uncertainty=exact)
    solution = solve(problem)
    fit = linearise_fit(solution.collocation, solution.z)
    assert mesh_changes(problem, solution, fit) == ((), None, "")


def shaken_bar(element: str) -> cs.Experiment:
    """A bar with two elements across that is swung fast at one end."""
    body = cs.Body(
        cs.box_mesh((0.03, 0.03, 0.09), (2, 2, 4)),
        density_kg_m3=1000.0,
        element=element,
        rest_shape="stress_free",
    )
    t_s = 0.02 * np.arange(16)
    rise = np.clip(t_s / 0.1, 0, 1) ** 2
    moved_m = rise[:, None] * np.sin(np.outer(t_s, [14.0, 11.0, 19.0])) * [0.02, 0.015, 0.01]
    poses = cs.PoseSequence(t_s, moved_m, np.tile(NO_TURN, (16, 1)))
    places_m = [[0, 0, 0], [0.03, 0, 0], [0, 0.03, 0], [0.03, 0.03, 0.045], [0, 0.03, 0.045]]
    markers = cs.Markers(t_s, np.zeros((16, 5, 3)), 1e-4, places_m=places_m)
    held = cs.Grasp(cs.Box((-1, -1, 0.09 - 1e-9), (1, 1, 1)), poses)
    return cs.Experiment(body, t_s, [held], markers, nuisance=cs.Nuisance.none())


@pytest.mark.long
@pytest.mark.parametrize("element", ["tet4", "tet10"])
def test_a_mesh_that_is_too_coarse_is_a_reason_before_effects_of_the_budget(element):
    constants = TRUTH | {"gamma_r_s": 5e-3}
    tracks_m = cs.simulate(shaken_bar("tet10"), constants, "midpoint", substeps=1).markers_m
    tracks_m = tracks_m + np.random.default_rng(0).normal(scale=1e-4, size=tracks_m.shape)
    unknown = constants | {"young_pa": cs.Unknown(14e3), "gamma_r_s": cs.Unknown(4e-3)}
    problem = cs.Problem(
        [cs.with_markers(shaken_bar(element), tracks_m)], unknown, scheme="midpoint", substeps=1
    )
    reasons = cs.run(problem).trust.reasons
    of_mesh = [each for each in reasons if "elements lie across" in each]
    of_effects = [each for each in reasons if each.startswith("the residuals need")]
    if element == "tet10":
        assert not of_mesh
        return
    assert 'set object.element = "tet10"' in of_mesh[0]
    assert not of_effects or reasons.index(of_mesh[0]) < reasons.index(of_effects[0])


def test_a_change_by_more_than_half_is_a_concern():
    experiments = coarse_problem("tet10").experiments
    damping = {name: value for name, value in TRUTH.items() if name.startswith("gamma")}
    problem = cs.Problem(experiments, damping | {"mu_pa": cs.Unknown(100.0), "lambda_pa": 200.0})
    assert mesh_resolution_concerns(problem, None, {"mu_pa": 0.1}) == []
    assert mesh_resolution_concerns(cs.Problem(experiments, {**GUESS}), None, {"mu_pa": 2.0}) == []
    (concern,) = mesh_resolution_concerns(problem, None, {"mu_pa": -0.6})
    assert (concern.code, concern.grade) == ("mesh/error", "check")
    assert "mu_pa would change by more than half" in concern.message
    unknown = cs.Unknown(100.0, scale="linear")  # it may pass through zero
    linear = cs.Problem(experiments, damping | {"mu_pa": unknown, "lambda_pa": 200.0})
    assert mesh_resolution_concerns(linear, None, {"mu_pa": 2.0}) == []


@pytest.mark.long
def test_moduli_that_would_change_sign_are_a_note(monkeypatch):
    problem = coarse_problem("tet10")
    solution = solve(problem)
    fit = linearise_fit(solution.collocation, solution.z)
    large = np.zeros((len(fit.names), 1))
    large[0] = 5.0
    monkeypatch.setattr(mesh_resolution, "estimate_changes", lambda *_: large)
    _, by_mesh, note = mesh_changes(problem, solution, fit)
    assert by_mesh is None
    assert "mu_pa would change by more than half" in note
    assert "`refine`" in note


def test_intervals_in_contact_are_stated_to_contain_no_error_of_the_mesh():
    problem = cs.Problem([measured(pressed_cube(2))], GUESS | {"gamma_r_s": 0.01})
    collocation = problem.collocation()
    z, _ = initial_variables(collocation)
    solution = SimpleNamespace(collocation=collocation, z=z, q=z[: collocation.nq])
    fit = linearise_fit(collocation, z)
    _, by_mesh, note = mesh_changes(problem, solution, fit)
    assert by_mesh is None
    assert note == (
        "the intervals contain no error of the mesh: obstacles touch the body; `refine` measures it"
    )
