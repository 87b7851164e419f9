"""Stress-free shapes of meshes that were made under gravity: forces and identification."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from kit.checks import assert_derivative, relative_error
from kit.problem_files import run_command
from kit.rest_shapes import (
    DENSITY_KG_M3,
    SCAN_GRAVITY_M_S2,
    TRUTH,
    as_scanned,
    clamped_nodes,
    hung_mesh,
    measured,
    problem_of,
    recorded,
    straight_bar,
)

import collocation_sysid as cs
from collocation_sysid.errors import InputError
from collocation_sysid.fem.meshes.mesh import TetMesh
from collocation_sysid.fem.meshes.selection import Indices
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.methods.interior_point import InteriorPoint
from collocation_sysid.model.parameters import Unknown
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.program.forward.initial_equilibrium import equilibrium
from collocation_sysid.program.simulation import simulate
from collocation_sysid.result.element_fields import ElementFields
from collocation_sysid.statistics.budget.consider_analysis import changes_of_assumptions
from collocation_sysid.statistics.budget.systematic_effects import Assumptions
from collocation_sysid.statistics.linearised import linearise_fit

SOFT = TRUTH | {"young_pa": 6e4}
ELEMENTS = ["tet4", pytest.param("tet10", marks=pytest.mark.long), "tet10-p0"]
ONE_STEP = {"substeps": 1}


def scanned_body(element: str = "tet4", **changes) -> cs.Body:
    """A straight mesh that was made while the bar was clamped at one end, horizontally."""
    mesh = box_mesh((0.12, 0.03, 0.03), (6, 2, 2) if element == "tet4" else (3, 1, 1))
    settings = {"density_kg_m3": DENSITY_KG_M3, "rest_shape": as_scanned(mesh)} | changes
    return cs.Body(mesh, element=element, **settings)


# The inverse equilibrium -------------------------------------------------------------------------


def test_a_body_with_another_stress_free_shape_shares_no_gradients():
    body = scanned_body()
    assert body.shape_gradients.nnz
    twice = body.with_stress_free(2.0 * body.nodes_m)
    np.testing.assert_allclose(
        2.0 * twice.shape_gradients.toarray(), body.shape_gradients.toarray(), atol=1e-9
    )


@pytest.mark.parametrize("element", ELEMENTS)
def test_the_forward_equilibrium_of_the_stress_free_shape_is_the_mesh(element):
    body = scanned_body(element)
    theta = body.theta_from_values(SOFT)
    stress_free = body.inverse_equilibrium.solve(theta).positions_m
    sag_m = np.abs(stress_free - body.nodes_m).max()
    assert sag_m > 0.01
    held = body.scan_conditions.grasped_nodes(body.nodes)
    np.testing.assert_array_equal(stress_free[held], body.nodes_m[held])
    # From halfway between both, under the weight of the scan.
    start = ((stress_free + body.nodes_m) / 2).ravel()
    found = equilibrium(recorded(body), theta, start=start).reshape(-1, 3)
    assert np.abs(found - body.nodes_m).max() < 1e-9 * 0.12


def test_the_mesh_of_a_simulated_scan_leads_back_to_the_straight_bar():
    mesh = hung_mesh()
    body = cs.Body(mesh, mass_kg=straight_bar().mass_kg, rest_shape=as_scanned(mesh))
    found = body.inverse_equilibrium.solve(body.theta_from_values(TRUTH)).positions_m
    straight_m = straight_bar().nodes_m
    sag_m = np.abs(mesh.points_m - straight_m).max()
    # Mass is distributed as the volume of the mesh is, not as that of the straight bar.
    assert np.abs(found - straight_m).max() < 5e-3 * sag_m


@pytest.mark.parametrize("damping", ["kelvin-voigt", "rayleigh"])
def test_forces_are_those_of_a_body_with_the_stress_free_mesh(damping):
    body = scanned_body(damping=damping)
    values = SOFT | {"gamma_m_1_s": 0.0}
    theta = body.theta_from_values(values)
    other = cs.Body(body.stress_free_mesh(theta), density_kg_m3=DENSITY_KG_M3, damping=damping)
    rng = np.random.default_rng(0)
    x = body.nodes_m + 1e-3 * rng.standard_normal(body.nodes_m.shape)
    v = 0.1 * rng.standard_normal(x.shape)
    assert relative_error(body.force(x, v, theta), other.force(x, v, theta)) < 1e-12
    moduli = {name: SOFT[name] for name in ("young_pa", "poisson")}
    assert body.energy(x, **moduli) == pytest.approx(other.energy(x, **moduli), rel=1e-12)


@pytest.mark.parametrize("element", ELEMENTS)
def test_forces_follow_from_the_energy_and_the_constants(element):
    body, rng = scanned_body(element), np.random.default_rng(0)
    theta = body.theta_from_values(SOFT)
    moduli = {name: SOFT[name] for name in ("young_pa", "poisson")}
    x = body.nodes_m + 1e-4 * rng.standard_normal(body.nodes_m.shape)
    v = 0.1 * rng.standard_normal(x.shape)
    force = body.elastic_force(x, **moduli)
    assert_derivative(
        lambda at: body.energy(at, **moduli), lambda d: -np.sum(force * d), x, rng, 1e-6, 1e-4
    )
    by_theta = body.linearise(x, v, theta).by_theta[0].copy()
    assert_derivative(
        lambda at: body.force(x, v, at)[0], lambda d: by_theta @ d, theta, rng, 1e-7, theta
    )


@pytest.mark.long
def test_the_shape_follows_the_constants_of_every_region_and_a_free_density():
    mesh = box_mesh((0.12, 0.03, 0.03), (6, 2, 2))
    core = cs.Region("core", np.arange(40), density_kg_m3=800.0)
    body = cs.Body(mesh, density_kg_m3=1000.0, regions=[core], rest_shape=as_scanned(mesh))
    body = body.with_free_densities([""])
    values = SOFT | {"core.mu_pa": 1e5, "core.lambda_pa": 2e5, "density_kg_m3": 1000.0}
    theta = body.theta_from_values(values)
    places = body.inverse_equilibrium.places
    assert len(places) == 5
    rng, by_input = (np.random.default_rng(1), body.inverse_equilibrium.solve(theta).by_input)
    x = body.nodes_m + 1e-4 * rng.standard_normal(body.nodes_m.shape)
    v = 0.1 * rng.standard_normal(x.shape)

    def moved(own: np.ndarray) -> np.ndarray:
        other = theta.copy()
        other[places] = own
        return body.inverse_equilibrium.solve(other).positions_m

    own = theta[places]
    assert_derivative(moved, lambda d: np.tensordot(d, by_input, 1), own, rng, 1e-6, own)
    by_theta = body.linearise(x, v, theta).by_theta[0].copy()
    assert_derivative(
        lambda at: body.force(x, v, at)[0], lambda d: by_theta @ d, theta, rng, 1e-6, theta
    )


def test_a_stiff_body_is_as_scanned():
    body = scanned_body()
    rigid = body.theta_from_values(TRUTH | {"young_pa": 1e12})
    sag_m = np.abs(body.inverse_equilibrium.solve(rigid).positions_m - body.nodes_m).max()
    assert sag_m < 1e-8
    other = scanned_body(rest_shape="stress_free")
    x = body.nodes_m + 1e-4 * np.random.default_rng(0).standard_normal(body.nodes_m.shape)
    still = np.zeros_like(x)
    assert relative_error(body.force(x, still, rigid), other.force(x, still, rigid)) < 1e-4


def test_element_fields_refer_to_the_stress_free_shape():
    body = scanned_body()
    theta = body.theta_from_values(SOFT)
    fields = ElementFields.from_body(body, theta)
    stress_free = body.inverse_equilibrium.solve(theta).positions_m
    at_rest = fields.evaluate_at(stress_free[None])
    np.testing.assert_allclose(at_rest["det_f"], 1.0, atol=1e-9)
    assert at_rest["von_mises_pa"].max() < 1e-5 * SOFT["young_pa"]
    assert fields.evaluate_at(body.nodes_m[None])["von_mises_pa"].max() > 1e-2 * SOFT["young_pa"]


# Fits --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def described():
    """A bar that was scanned while hanging, held otherwise and swayed, and described as it was."""
    return measured(as_scanned(hung_mesh()))


def test_slopes_of_a_fit_are_those_of_brute_force_differences(described):
    problem = problem_of(described, **ONE_STEP)
    collocation = Collocation(problem.experiments, problem.parameters)
    values = TRUTH | {"young_pa": 2.5e5}

    def tracks(young_pa: float) -> np.ndarray:
        return simulate(
            described, values | {"young_pa": young_pa}, "midpoint", substeps=1
        ).markers_m

    x = simulate(described, values, "midpoint", substeps=1).positions_m
    q = problem.parameters.with_guess(
        {name: values[name] for name in ("young_pa", "gamma_r_s")}
    ).guess_q
    z = collocation.pack(q, [x.reshape(len(x), -1)])
    slope = linearise_fit(collocation, z).blocks[0].jacobian[..., 0]
    step = 1e-4
    ends = [tracks(values["young_pa"] * np.exp(way)) for way in (step, -step)]
    expected = (ends[0] - ends[1]) / (2 * step) / described.markers.sigma_m[:, None]
    # Residuals are measured less fitted, or the other way round, all alike.
    sign = np.sign(np.sum(slope * expected))
    assert relative_error(sign * slope, expected) < 1e-5


def test_with_the_scan_described_the_interval_contains_the_truth(described):
    run = cs.run(problem_of(described, **ONE_STEP), seek_causes=False)
    estimate = run.estimates["young_pa"]
    low, high = combined(estimate)
    assert low < TRUTH["young_pa"] < high
    assert estimate.optimum == pytest.approx(TRUTH["young_pa"], rel=1e-3)
    # Corrected for an error of the mesh, which the simulated recording does not have.
    assert estimate.value == pytest.approx(TRUTH["young_pa"], rel=0.02)
    assert "rest_shape" not in significant(run)


def test_the_budget_contains_the_error_of_a_scan_in_an_unknown_orientation():
    run = cs.run(problem_of(measured(None, mesh_from="scan"), **ONE_STEP), seek_causes=False)
    estimate = run.estimates["young_pa"]
    # The errors of mesh and time step, which the simulated recording does not have, are left out.
    assert estimate.known_effect is not None
    corrected = estimate.optimum * np.exp(estimate.known_effect)
    without, error = (abs(value / TRUTH["young_pa"] - 1) for value in (estimate.optimum, corrected))
    assert without > 0.3
    assert error < without / 2
    low, high = combined(estimate)
    assert low < TRUTH["young_pa"] < high
    assert run.trust.verdict != "good"
    assert run.budget["young_pa"].shares["rest_shape"] > 0


def test_a_mesh_of_unknown_origin_has_no_rest_shape_in_its_budget():
    run = cs.run(problem_of(measured(None), **ONE_STEP), seek_causes=False)
    assert "rest_shape" not in run.budget["young_pa"].shares


def combined(estimate) -> tuple[float, float]:
    """Return the interval of everything."""
    return estimate.combined95


def significant(run) -> set[str]:
    """Return the sources of E that have a share of its variance."""
    return {name for name, share in run.budget["young_pa"].shares.items() if share > 1e-9}


@pytest.mark.long
@pytest.mark.parametrize("static", [False, True])
def test_interior_point_and_reduced_space_find_the_same_optimum(static):
    steps = 2 if static else 10
    experiment = measured(as_scanned(hung_mesh()), static=static, steps=steps)
    problem = problem_of(experiment, **({} if static else ONE_STEP))
    collocation = Collocation(problem.experiments, problem.parameters)
    answers = [cs.ReducedSpace()(collocation), InteriorPoint()(collocation)]
    values = [collocation.parameter_values(answer.z)["young_pa"] for answer in answers]
    assert values[1] == pytest.approx(values[0], rel=1e-5)
    assert values[0] == pytest.approx(TRUTH["young_pa"], rel=0.01)


def test_forgetting_how_the_shape_depends_on_the_stiffness_leads_elsewhere(described):
    """The stress-free shape of the guess, kept, gives another E: its derivative matters."""
    body = described.body
    frozen = body.stress_free_mesh(body.theta_from_values(TRUTH | {"young_pa": 4e5}))
    kept = cs.Body(frozen, mass_kg=body.mass_kg, rest_shape="stress_free")
    other = measured_on(kept)
    problem = problem_of(other, **ONE_STEP)
    answer = cs.ReducedSpace()(Collocation(problem.experiments, problem.parameters))
    young_pa = answer.collocation.parameter_values(answer.z)["young_pa"]
    assert abs(young_pa / TRUTH["young_pa"] - 1) > 0.03


def measured_on(body: cs.Body) -> cs.Experiment:
    """The recording of the described bar on another body of the same nodes."""
    experiment = measured(as_scanned(hung_mesh()))
    other = recorded(body, np.pi / 2)
    return cs.with_markers(other, experiment.markers.positions_m)


# The budget --------------------------------------------------------------------------------------


def changes_of(experiment: cs.Experiment, **deviations) -> dict[str, np.ndarray]:
    """Changes of markers (T, M, 3) by each assumption at the truth, in deviations of the noise."""
    problem = problem_of(experiment, **ONE_STEP)
    parameters = problem.parameters.with_guess({n: TRUTH[n] for n in ("young_pa", "gamma_r_s")})
    collocation = Collocation([experiment], parameters)
    x = simulate(experiment, TRUTH, "midpoint", substeps=1).positions_m
    z = collocation.pack(parameters.guess_q, [x.reshape(len(x), -1)])
    found = changes_of_assumptions(collocation, z, Assumptions(**deviations).collect_deviations())
    return {name: found.blocks[0][..., k] for k, name in enumerate(found.names)}


def simulated_on(mesh: TetMesh, mass_kg: float) -> np.ndarray:
    body = cs.Body(mesh, mass_kg=mass_kg, rest_shape="stress_free")
    return simulate(recorded(body, np.pi / 2), TRUTH, "midpoint", substeps=1).markers_m


def test_the_row_of_the_rest_shape_is_the_deflection_in_each_pose():
    """Of a stiffer bar, whose deflection is small, it is what a simulation says."""
    bar = straight_bar()
    copy = TetMesh(bar.mesh.points_m, bar.mesh.tetrahedra)
    unstated = cs.Body(copy, mass_kg=bar.mass_kg)
    assert unstated.rest_shape is None
    experiment = recorded(unstated, np.pi / 2)
    found = changes_of(experiment, rest_shape=1.0)
    # A mesh of which X is the stress-free shape where gravity is 1/50 of that of the earth.
    small = 0.02
    scan = cs.UnderGravity(Indices(clamped_nodes(copy)), np.multiply(SCAN_GRAVITY_M_S2, small))
    described = cs.Body(copy, mass_kg=bar.mass_kg, rest_shape=scan)
    ends = [
        simulate(recorded(body, np.pi / 2), TRUTH, "midpoint", substeps=1).markers_m
        for body in (described, unstated)
    ]
    expected = (ends[0] - ends[1]) / small / experiment.markers.sigma_m[:, None]
    # Gravity of the scan points along −z, the row's along +z.
    assert relative_error(-found["rest_shape z"], expected) < 0.05


def test_generated_and_stress_free_meshes_have_no_rest_shape_row():
    bar = straight_bar()
    assert bar.rest_shape == "stress_free"
    copy = TetMesh(bar.mesh.points_m, bar.mesh.tetrahedra)
    stated = cs.Body(copy, mass_kg=bar.mass_kg, rest_shape="stress_free")
    for body in (bar, stated):
        found = changes_of(recorded(body, np.pi / 2), rest_shape=1.0)
        assert not any(found[f"rest_shape {axis}"].any() for axis in "xyz")
        assert found["surface 1"].any()


def test_a_smooth_error_of_the_surface_is_a_body_of_another_shape():
    from collocation_sysid.statistics.budget.shape_error import surface_modes, thickness_m

    bar, share = straight_bar(), 1e-3
    experiment = recorded(bar, np.pi / 2)
    found = changes_of(experiment, surface=1.0)
    none = np.zeros(0, dtype=np.int64)
    moved = share * thickness_m(bar) * surface_modes(bar, none)
    ends = [
        simulated_on(TetMesh(bar.mesh.points_m + off, bar.mesh.tetrahedra), bar.mass_kg)
        for off in (moved[0], 0.0)
    ]
    # Where a marker is on the undeformed body changes too: on the mesh it is a node.
    expected = (ends[0] - ends[1]) / share / experiment.markers.sigma_m[:, None]
    size = np.abs(expected).max()
    assert np.abs(found["surface 1"] - expected).max() < 0.1 * size


def test_modes_of_the_surface_have_unit_deviation_and_the_correlation_length(monkeypatch):
    from collocation_sysid.statistics.budget import shape_error

    bar, none = straight_bar(), np.zeros(0, dtype=np.int64)
    on_surface = np.unique(bar.mesh.surface)

    def share(correlation: float) -> float:
        monkeypatch.setattr(shape_error, "CORRELATION", correlation)
        lengths = np.linalg.norm(shape_error.surface_modes(bar, none), axis=2)[:, on_surface]
        return float(np.mean(np.sum(lengths**2, axis=0)))

    assert 0.9 < share(0.5) <= 1.02
    assert share(0.1) < share(0.5)


# Refusals ----------------------------------------------------------------------------------------


def test_a_body_without_a_stress_free_shape_is_refused_once():
    soft = measured(as_scanned(hung_mesh()))
    with pytest.raises(InputError, match=r"no stress-free shape.*expected.*stiffer guesses"):
        replace_guess(soft, 30.0)


def replace_guess(experiment: cs.Experiment, young_pa: float) -> cs.Problem:
    fixed = {name: TRUTH[name] for name in ("poisson", "gamma_r_s", "gamma_m_1_s")}
    return cs.Problem([experiment], {"young_pa": Unknown(young_pa), **fixed})


def test_memory_fields_and_wrong_scans_are_refused():
    mesh = box_mesh((0.12, 0.03, 0.03), (6, 2, 2))
    scan = as_scanned(mesh)
    with pytest.raises(InputError, match="memory"):
        cs.Body(mesh, density_kg_m3=1e3, prony=["a"], rest_shape=scan)
    with pytest.raises(InputError, match="field of"):
        cs.Body(mesh, density_kg_m3=1e3, field=cs.Field(0.1), rest_shape=scan)
    with pytest.raises(InputError, match="stress_free"):
        cs.Body(mesh, density_kg_m3=1e3, rest_shape="hanging")
    with pytest.raises(InputError, match="not zero"):
        cs.UnderGravity(scan.nodes, (0.0, 0.0, 0.0))
    with pytest.raises(InputError, match="on one line"):
        cs.Body(mesh, density_kg_m3=1e3, rest_shape=replace(scan, nodes=[0, 1]))


def test_a_scan_goes_from_the_file_to_the_body(tmp_path):
    from kit.problem_files import write_problem

    file = write_problem(tmp_path, {"swing": 6})
    text = file.read_text()
    assert cs.Problem.read(file).bodies[0].rest_shape is None
    table = '[object]\nrest_shape = "under_gravity"\n'
    table += 'scan = { nodes = "top", gravity_m_s2 = [0.0, 0.0, -1.0] }\n'
    file.write_text(text.replace("[object]\n", table))
    body = cs.Problem.read(file).bodies[0]
    np.testing.assert_array_equal(body.scan_conditions.gravity_m_s2, (0.0, 0.0, -1.0))
    file.write_text(text.replace("[object]\n", '[object]\nrest_shape = "under_gravity"\n'))
    with pytest.raises(InputError, match="belong together"):
        cs.Problem.read(file)
    result = run_command("check", file)
    assert result.code == 2
    file.write_text(text.replace("[object]\n", '[object]\nrest_shape = "stress_free"\n'))
    assert cs.Problem.read(file).bodies[0].rest_shape == "stress_free"


def test_a_finer_mesh_keeps_stated_values():
    from collocation_sysid.fem.meshes.refinement import refine_body

    body = scanned_body()
    finer = refine_body(body)
    held = finer.scan_conditions.grasped_nodes(finer.nodes)
    assert np.abs(finer.nodes.points_m[held, 0]).max() < 1e-9
    assert len(held) == 25


def test_an_unstated_rest_shape_counts_as_stress_free_unless_the_mesh_is_a_scan():
    usual = Assumptions()
    assert usual.collect_deviations([scanned_body()])["rest_shape"] is None
    box = box_mesh((0.12, 0.03, 0.03), (2, 1, 1))
    mesh = TetMesh(box.points_m, box.tetrahedra)  # not generated from stated lengths
    assert cs.Body(mesh, density_kg_m3=100.0).rest_shape is None
    for origin, stated, deviation in (("scan", None, 0.58), ("cad", "stress_free", None)):
        body = cs.Body(mesh, density_kg_m3=100.0, mesh_from=origin)
        assert body.rest_shape == stated
        assert usual.collect_deviations([body])["rest_shape"] == deviation
