"""Identification from arrays without files, with user-defined schemes, methods and materials."""

from __future__ import annotations

import json
import sys
from dataclasses import fields, is_dataclass, replace
from functools import cache
from types import SimpleNamespace
from typing import ClassVar

import casadi as ca
import numpy as np
import pytest
from IPython.core.formatters import DisplayFormatter
from kit.problems import EDGE_M, TRUTH, box, hung_cube, measured, noisy, smooth_poses, times
from matplotlib.collections import PolyCollection

import collocation_sysid as cs
from collocation_sysid.common.display import plain_text
from collocation_sysid.common.validated_classes import validated
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.methods.options import MethodOptions
from collocation_sysid.result.element_fields import ElementFields
from collocation_sysid.result.run_summary import run_summary
from collocation_sysid.runs.check import check_problem

UNKNOWN = {
    "lambda_pa": 200.0,
    "mu_pa": cs.Unknown(guess=150.0, lower=10.0, upper=1e5),
    "gamma_r_s": cs.Unknown(guess=0.02),
    "gamma_m_1_s": 1.0,
}
TOP = cs.Box((-1, -1, EDGE_M - 1e-6), (1, 1, 1))


def lifted(t_s: np.ndarray) -> np.ndarray:
    """Poses as matrices (T, 4, 4)."""
    rotations, translations = smooth_poses(t_s).at(t_s)
    poses = np.tile(np.eye(4), (len(t_s), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotations, translations
    return poses


def seen(t_s: np.ndarray, **changes) -> cs.Markers:
    """Two markers that are not measured yet."""
    given = {"sigma_m": 1e-3, "places_m": [(0.0, 0.0, 0.0), (0.07, 0.03, 0.02)], **changes}
    return cs.Markers(t_s, np.zeros((len(t_s), 2, 3)), **given)


def swung(body: cs.Body, **changes) -> cs.Experiment:
    t_s = times(10)
    return cs.Experiment(body, t_s, [cs.Grasp(TOP, lifted(t_s))], seen(t_s), **changes)


@cache
def identified() -> cs.Run:
    return cs.run(cs.Problem([noisy(hung_cube())], UNKNOWN, title="A cube"), seek_causes=False)


# Arrays -------------------------------------------------------------------------------------------


def test_an_experiment_finds_nodes_poses_and_places_on_its_body():
    swing = swung(box())
    (grasp,) = swing.grasps
    np.testing.assert_array_equal(grasp.nodes, np.flatnonzero(box().nodes_m[:, 2] > 0.09))
    np.testing.assert_allclose(grasp.poses.at(swing.t_s)[0], lifted(swing.t_s)[:, :3, :3])
    assert swing.markers.names == ("m1", "m2")
    places = swing.markers.predict_positions(box().nodes_m)
    np.testing.assert_allclose(places, [(0.0, 0.0, 0.0), (0.07, 0.03, 0.02)], atol=1e-12)
    np.testing.assert_array_equal(swing.gravity_m_s2, [0.0, 0.0, -9.81])


def test_loads_are_on_selected_nodes_too():
    low = cs.Ball((0.0, 0.0, 0.0), 0.01)
    swing = swung(box(), masses=[cs.PointMass(low, 0.1)], forces=[cs.Force(low, (0, 0, 1.0))])
    np.testing.assert_array_equal(swing.masses[0].nodes, [0])
    np.testing.assert_array_equal(swing.forces[0].nodes, [0])


def test_an_experiment_can_be_replaced_in_part():
    swing = swung(box())
    assert replace(swing, name="other").markers is swing.markers


def test_markers_without_places_start_where_the_first_samples_are():
    t_s = times(10)
    tracks = np.tile([(0.01, 0.02, 0.0), (0.1, 0.05, 0.03)], (11, 1, 1))
    somewhere = cs.Markers(t_s, tracks, 1e-3)
    swing = cs.Experiment(box(), t_s, [cs.Grasp(TOP, lifted(t_s))], somewhere)
    np.testing.assert_allclose(
        swing.markers.predict_positions(box().nodes_m), tracks[0], atol=1e-12
    )
    assert not swing.markers.located.any()
    assert (swing.place_sigma_m > EDGE_M).all()


def test_markers_have_places_or_a_placement():
    swing = swung(box())
    places, placement = [(0.0, 0.0, 0.0)] * 2, swing.markers.placement
    with pytest.raises(cs.InputError, match=r"places_m and a placement; expected one of them"):
        seen(times(3), places_m=places, placement=placement)


def test_a_marker_far_from_the_body_is_refused():
    t_s = times(10)
    far = seen(t_s, places_m=[(0.0, 0.0, 0.0), (0.5, 0.0, 0.0)])
    with pytest.raises(cs.InputError, match=r"experiment 'experiment': marker 'm2' at .* away"):
        cs.Experiment(box(), t_s, [cs.Grasp(TOP, lifted(t_s))], far)


def test_a_matrix_that_is_no_rigid_motion_is_refused():
    t_s = times(10)
    poses = lifted(t_s)
    poses[4, 0, 0] = 2.0
    with pytest.raises(
        cs.InputError, match=r"matrix 5: the matrix at t_s = 0.04 is not a rotation"
    ):
        cs.Experiment(box(), t_s, [cs.Grasp(TOP, poses)], seen(t_s))


def test_experiments_of_one_problem_have_different_names():
    with pytest.raises(cs.InputError, match=r"two experiments are named 'experiment'"):
        cs.Problem([swung(box()), swung(box())], UNKNOWN)


def test_objects_have_a_readable_representation():
    shown = repr(cs.Problem([hung_cube()], UNKNOWN | {"gamma_m_1_s": 1.0}, title="A cube"))
    assert shown.startswith(
        "Problem('A cube', experiments 'hung cube'; Parameters(lambda_pa = 200,"
    )
    assert "mu_pa from 150 in [10, 100000]" in shown
    assert repr(swung(box())) == (
        "Experiment('experiment': 11 samples over 0.1 s, grasps: 1, Markers(m1, m2: 22 samples))"
    )


def test_options_show_only_what_differs_from_the_defaults():
    assert repr(cs.Nuisance()) == "Nuisance()"
    shown = repr(cs.UncertaintyOptions(numerical=True, assumptions=cs.Assumptions(mass=0.3)))
    assert shown == "UncertaintyOptions(numerical=True, assumptions=Assumptions(mass=0.3))"
    fixed = repr(cs.Grasp([0, 1], cs.PoseSequence.fixed()))
    assert fixed.startswith("Grasp(nodes=array of shape (2,), poses=PoseSequence(t_s=array of")


def test_no_class_shows_many_fields():
    for name in cs.__all__:
        kind = getattr(cs, name)
        if is_dataclass(kind) and hasattr(kind.__repr__, "__wrapped__"):  # that of `dataclass`
            assert sum(field.repr for field in fields(kind)) <= 8, name


# Runs ---------------------------------------------------------------------------------------------


def test_a_run_reports_parameters_with_standard_uncertainties():
    run = identified()
    lower, upper = run.interval("mu_pa")
    assert lower < run.parameters["mu_pa"] < upper
    assert lower < TRUTH["mu_pa"] < upper
    assert 0 < run.std_error("mu_pa") < 50
    assert run.by_mesh["mu_pa"] > 0.05
    assert "mesh" in run.budget["mu_pa"].shares
    assert np.isnan([*run.interval("lambda_pa"), run.std_error("lambda_pa")]).all()  # fixed
    assert np.isfinite([*run.interval("young_pa"), run.std_error("young_pa")]).all()
    assert run.derived["poisson"] == pytest.approx(0.2, abs=0.05)
    assert "μ Pa" in run.table()
    assert f"mu_pa = {run.parameters['mu_pa']:.5g} ±" in repr(run)
    solution = repr(run.solution)
    assert f"mu_pa = {run.solution.parameters['mu_pa']:.5g}" in solution
    assert "iterations" in solution
    assert len(solution) < 300
    with pytest.raises(cs.InputError, match=r"no parameter 'mu'; .* did you mean 'mu_pa'?"):
        run.interval("mu")
    for call in (run.interval, run.std_error, run.nuisance):
        with pytest.raises(cs.InputError, match="name is 5; expected text in quotes"):
            call(5)


def test_intervals_of_a_run_that_has_not_converged_are_nan():
    method = cs.ReducedSpace(max_iterations=1)
    run = cs.run(cs.Problem([noisy(hung_cube())], UNKNOWN), method, seek_causes=False)
    assert not run.solution.status.converged
    low, high = run.interval("mu_pa")
    assert np.isnan([low, high, run.std_error("mu_pa")]).all()


def test_a_printed_run_is_the_summary_of_the_terminal():
    noted = cs.run(
        cs.Problem([noisy(hung_cube())], UNKNOWN, notes=("seen through glass",)), seek_causes=False
    )
    assert str(noted) == plain_text(run_summary(noted.result))
    shown = plain_text(run_summary(noted.result, details=True))
    assert noted.table() in shown
    assert noted.solution.message in shown
    for line in (
        "note: seen through glass",
        "forward simulation 'hung cube': ",
        "residuals: hung cube/",
        "markers: ",
    ):
        assert f"\n{line}" in shown
    assert "written to" not in shown


def test_a_run_becomes_a_data_frame(monkeypatch):
    given = {}
    frame = SimpleNamespace(from_dict=lambda rows, orient: given.update(rows) or orient)
    monkeypatch.setitem(sys.modules, "pandas", SimpleNamespace(DataFrame=frame))
    assert identified().to_frame() == "index"
    numbers = ["std_error", "lower", "upper"]
    combined = [f"combined_{each}" for each in numbers]
    statistical = [f"statistical_{each}" for each in numbers]
    columns = ["value", *combined, *statistical, "verdict", "guess", "unit"]
    assert list(given["mu_pa"]) == columns
    assert given["mu_pa"]["verdict"] == "good"
    assert given["mu_pa"]["combined_lower"] < given["mu_pa"]["statistical_lower"]
    assert (given["mu_pa"]["guess"], given["mu_pa"]["unit"]) == (150.0, "Pa")
    assert np.isnan(given["lambda_pa"]["combined_std_error"])


def test_without_pandas_the_remedy_is_reported(monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(cs.InputError, match=r"pip install pandas"):
        identified().to_frame()


def test_a_run_without_a_file_is_saved_like_any_other(tmp_path):
    folder = identified().save(tmp_path / "run", frames=False)
    result = json.loads((folder / "result.json").read_text())
    assert (result["title"], result["converged"]) == ("A cube", True)
    assert result["provenance"]["problem_file"] is None
    assert not (folder / "problem.toml").exists()


def test_a_notebook_shows_the_body_of_a_run_once():
    shown, _ = DisplayFormatter().format(identified().plot())
    assert shown["image/png"].startswith(b"\x89PNG")
    assert set(shown) == {"image/png", "text/plain"}


@pytest.mark.parametrize("field", ["von_mises_pa", "energy_density_j_m3", "det_f"])
def test_a_drawn_body_is_coloured_by_strain(field):
    run = identified()
    (positions_m,), body = run.solution.positions_m, run.problem.bodies[0]
    felt = ElementFields.from_body(body, body.theta_from_values(run.parameters)).evaluate_at(
        positions_m[[0, -1]]
    )[field]
    (bar,) = run.plot(field=field, count=2).axes[0].child_axes
    low, high = bar.get_ylim()
    outer = felt[:, body.mesh.surface_cells]
    assert high == pytest.approx(outer.max(), rel=1e-6)
    assert low == pytest.approx(outer.min(), rel=1e-6) or low == 0 < outer.min() < high / 5


def test_an_unknown_picture_is_refused_with_the_known_names():
    with pytest.raises(cs.InputError, match=r"'det'; expected .* did you mean 'det_f'\?"):
        identified().plot(field="det")
    with pytest.raises(cs.InputError, match=r"found 'sway'; expected one of hung cube"):
        identified().plot("sway")
    for count in (0, 21):
        with pytest.raises(cs.InputError, match=rf"count is {count}; expected 1 to 20 shapes"):
            identified().plot(count=count)


# Several bodies -----------------------------------------------------------------------------------


@cache
def two_specimens() -> cs.Problem:
    """A soft cube and a bar with a core, which share a material's μ."""
    core = cs.Region("core", cs.Box((0.0, 0.0, 0.0), (0.05, 1.0, 1.0)))
    bar = cs.Body(box_mesh((0.1, 0.05, EDGE_M), (2, 1, 3)), density_kg_m3=40.0, regions=[core])
    truth = {**TRUTH, "core.mu_pa": 500.0}
    shared = {**UNKNOWN, "core.mu_pa": cs.Unknown(guess=300.0)}
    made = []
    for name, body in (("cube", box()), ("bar", bar), ("again", bar)):
        values = {key: truth[key] for key in body.used_names(list(truth))}
        swing = swung(body, name=name, validation=name == "again")
        tracks = cs.simulate(swing, values, "midpoint", substeps=1).markers_m
        made.append(cs.with_markers(swing, tracks))
    return cs.Problem(made, shared, rollout=cs.RolloutOptions("scheme"))


@cache
def two_found() -> cs.Run:
    return cs.run(two_specimens(), seek_causes=False)


def test_two_bodies_share_a_parameter_by_name(tmp_path):
    run = two_found()
    assert run.solution.status.converged
    assert run.solution.parameters["mu_pa"] == pytest.approx(300.0, rel=1e-4)
    assert run.solution.parameters["core.mu_pa"] == pytest.approx(500.0, rel=1e-4)
    assert {name: getattr(found, "rms_m", found) for name, found in run.rollouts.items()} == {
        name: pytest.approx(0.0, abs=1e-6) for name in ("cube", "bar", "again")
    }
    result = json.loads((run.save(tmp_path / "run", frames=False) / "result.json").read_text())
    nodes = [len(body.nodes_m) for body in two_specimens().bodies]
    assert result["problem"]["nodes"] == sum(nodes)
    assert len(result["provenance"]["mesh_sha256"]) == 2


def test_a_body_that_was_only_predicted_is_drawn_with_its_regions():
    axes = two_found().plot("again", field=None, count=2).axes[0]
    assert not axes.child_axes
    skins = [c for c in axes.collections if isinstance(c, PolyCollection)]
    assert len(skins) == 2
    reds_over_blues = {round(r / b, 2) for r, _, b, _ in skins[0].get_facecolor()}
    assert len(reds_over_blues) == 2


def test_a_check_looks_at_every_body():
    findings = check_problem(two_specimens())
    assert not findings.derivative_fault
    assert [body.experiments for body in findings.bodies] == [("cube",), ("bar", "again")]
    whole = two_specimens().collocation()
    assert findings.jacobian_nonzeros == len(whole.jacobian_structure[1])
    assert findings.hessian_nonzeros == len(whole.hessian_structure[1])


# Extensions are objects ---------------------------------------------------------------------------

THETA_RULE = cs.Scheme(
    "theta-0.6",
    order=1,
    regular=cs.Stencil(p=(0.6, 0.4), q=(1.0, -1.0), w=(0.6, 0.4), s=(1.0, -2.0, 1.0)),
    start=(cs.Stencil(p=(0.6, 0.4), q=(1.0, -1.0), w=(0.6,), s=(1.0, -1.0), r=-1.0),),
)


def test_a_scheme_of_a_user_runs(tmp_path):
    cube = hung_cube()
    cube = cs.with_markers(cube, cs.simulate(cube, TRUTH, THETA_RULE, substeps=1).markers_m)
    rollout = cs.RolloutOptions("scheme")
    run = cs.run(cs.Problem([cube], UNKNOWN, scheme=THETA_RULE, rollout=rollout), seek_causes=False)
    assert run.solution.parameters["mu_pa"] == pytest.approx(300.0, rel=1e-4)
    found = run.rollouts["hung cube"]
    assert getattr(found, "rms_m", 1.0) < 1e-6
    result = json.loads((run.save(tmp_path / "run", frames=False) / "result.json").read_text())
    assert result["problem"]["scheme"] == "theta-0.6"


def test_a_function_is_a_method():
    def halving(collocation, watch=None, start=None):
        return replace(cs.ReducedSpace(ladder=(0.5, 1.0))(collocation, watch, start), method="mine")

    problem = cs.Problem([measured(hung_cube())], UNKNOWN, substeps=1)
    for asked in ((problem, halving), (replace(problem, method=halving),)):
        run = cs.run(*asked, seek_causes=False)
        assert run.solution.method == "mine"
        assert run.solution.parameters["mu_pa"] == pytest.approx(300.0, rel=1e-4)
    assert cs.solve(replace(problem, methods={"mine": halving}), "mine").method == "mine"


def test_options_of_a_user_are_a_method():
    @validated
    class Polished(MethodOptions):
        name: ClassVar[str] = "polished"
        tolerance: float = 1e-3

        def __call__(self, collocation, watch=None, start=None):
            rough = cs.ReducedSpace(tolerance=self.tolerance)(collocation, watch, start)
            return replace(cs.InteriorPoint()(collocation, watch, rough.z), method=self.name)

    problem = cs.Problem(
        [measured(hung_cube())], UNKNOWN, substeps=1, method=Polished(tolerance=1e-2)
    )
    run = cs.run(problem, seek_causes=False)
    assert run.solution.method == "polished"
    assert run.solution.parameters["mu_pa"] == pytest.approx(300.0, rel=1e-5)
    assert check_problem(problem).method == "polished"


def test_a_function_is_a_material():
    def fung(F, mu_pa, lambda_pa):
        jacobian = ca.det(F)
        strain = ca.trace(F.T @ F) - 3 - 2 * ca.log(jacobian)
        return mu_pa / 2 * (ca.exp(0.3 * strain) - 1) / 0.3 + lambda_pa / 2 * ca.log(jacobian) ** 2

    body = cs.Body(box_mesh((EDGE_M,) * 3, (1, 1, 2)), material=fung, density_kg_m3=30.0)
    swing = swung(body)
    swing = cs.with_markers(swing, cs.simulate(swing, TRUTH, "midpoint", substeps=1).markers_m)
    run = cs.run(cs.Problem([swing], UNKNOWN), seek_causes=False)
    assert run.solution.parameters["mu_pa"] == pytest.approx(300.0, rel=1e-4)


def test_wrong_options_name_the_choices():
    with pytest.raises(
        cs.InputError, match=r"integrator: found 'newmrk'; .*did you mean 'newmark'"
    ):
        cs.RolloutOptions(integrator="newmrk")  # type: ignore[arg-type]
    with pytest.raises(cs.InputError, match=r"no scheme 'midpont'"):
        cs.Problem([hung_cube()], UNKNOWN, scheme="midpont")
    with pytest.raises(cs.InputError, match=r"method: found 'newton'; expected one of"):
        cs.Problem([hung_cube()], UNKNOWN, method="newton")
