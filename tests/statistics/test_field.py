"""Spatially varying constants: prior, sensitivities and identification."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import study_field
from kit.checks import assert_derivative
from kit.problems import IDEAL, point_markers, smooth_poses, times
from matplotlib.figure import Figure

import collocation_sysid as cs
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.laws.constants import MU
from collocation_sysid.fem.meshes.refinement import refine_body
from collocation_sysid.fem.spatial_field import FieldModes, FieldResolution, Laplacian
from collocation_sysid.result.pictures.field_intervals import field_picture
from collocation_sysid.result.replay import ARRAY_LAYOUT, GROUP_PREFIXES, read_run
from collocation_sysid.runs.check.body import check_body
from collocation_sysid.runs.forward_simulation import simulate_experiment
from collocation_sysid.runs.result_content import FieldResult
from collocation_sysid.statistics.budget.consider_analysis import changes_of_assumptions
from collocation_sysid.statistics.budget.discretisation_error import estimate_changes
from collocation_sysid.statistics.field_estimates import FieldEstimate, field_estimates
from collocation_sysid.statistics.linearised import linearise_fit
from collocation_sysid.statistics.pose_noise import uncertainty_at

SIZE_M, SIGMA_M, YOUNG_PA = (0.04, 0.04, 0.12), 1e-4, 4e3
KNOWN = {"poisson": 0.3, "gamma_r_s": 5e-3, "gamma_m_1_s": 0.1}


def bar(field: cs.Field | None = None, stiff: np.ndarray | None = None, **changes) -> Body:
    regions = [] if stiff is None else [cs.Region("stiff", stiff)]
    mesh = cs.box_mesh(SIZE_M, changes.pop("divisions", (2, 2, 6)))
    return Body(mesh, density_kg_m3=100.0, field=field, **({"regions": regions} | changes))


def centres(body: Body) -> np.ndarray:
    return body.mesh.points_m[body.mesh.tetrahedra].mean(axis=1)


def swung(body: Body, above_m: float = 0.119, steps: int = 15) -> cs.Experiment:
    """The bar, held above a height, with markers all over its surface."""
    t_s, x = times(steps), body.nodes_m
    outer = np.unique(body.mesh.surface)
    places = x[outer[x[outer, 2] < 0.119]]
    grasp = cs.Grasp(np.flatnonzero(x[:, 2] > above_m), smooth_poses(t_s))
    markers = replace(point_markers(body, places, t_s), sigma_m=np.full(len(places), SIGMA_M))
    return cs.Experiment(body, t_s, [grasp], markers, nuisance=IDEAL)


@cache
def problem(ratio: float = 1.0, above_m: float = 0.119, steps: int = 15, **stated) -> cs.Problem:
    """A bar whose lower half is stiffer, which no description tells."""
    true = bar(stiff=centres(bar())[:, 2] < 0.06)
    values = {**KNOWN, "young_pa": YOUNG_PA, "stiff.young_pa": ratio * YOUNG_PA}
    tracks = cs.simulate(swung(true, above_m, steps), values, "midpoint", substeps=1).markers_m
    noise = SIGMA_M * np.random.default_rng(5).normal(size=tracks.shape)
    field = cs.Field(**({"length_m": 0.05, "modes": 20} | stated))
    seen = cs.with_markers(swung(bar(field), above_m, steps), tracks + noise)
    return cs.Problem([seen], {**KNOWN, "young_pa": cs.Unknown(0.7 * YOUNG_PA)}, substeps=1)


@cache
def found(ratio: float = 1.0, above_m: float = 0.119, **stated) -> FieldEstimate:
    solution = cs.solve(problem(ratio, above_m, **stated))
    assert solution.status.converged
    collocation = solution.collocation
    known = uncertainty_at(collocation, solution.z)
    (field,) = field_estimates(
        collocation.transcriptions[0].body, collocation.parameters, solution.q, known
    )
    return field


def truth(ratio: float) -> np.ndarray:
    return np.log(YOUNG_PA * np.where(centres(bar())[:, 2] < 0.06, ratio, 1.0))


def held_share(field: FieldEstimate, ratio: float) -> float:
    """Of the elements that the data tell, those whose interval holds the truth."""
    low, high = np.log(field.statistical95)
    return float(((low < truth(ratio)) & (truth(ratio) < high))[field.is_informed].mean())


def test_the_prior_falls_off_as_materns_does():
    mesh = cs.box_mesh((1.0, 1.0, 1.0), (12, 12, 12))
    modes = FieldModes.from_field(
        cs.Field(0.15, modes=120), mesh, np.arange(len(mesh.tetrahedra)), (MU,)
    )
    middles = mesh.points_m[mesh.tetrahedra].mean(axis=1)
    away_m = np.linalg.norm(middles - middles[5000], axis=1)
    correlation = modes.shapes @ modes.shapes[5000] / 0.25
    for away in (0.15, 0.2, 0.3, 0.4):
        here = np.abs(away_m - away) < 0.02
        assert correlation[here].mean() == pytest.approx(np.exp(-away / 0.15), abs=0.06)
    variance = (modes.shapes**2).sum(axis=1) + modes.omitted_deviation**2
    np.testing.assert_allclose(variance, 0.25)


def test_shapes_have_their_share_of_all():
    mesh, length_m = cs.box_mesh(SIZE_M, (3, 3, 9)), 0.03
    few = Laplacian.from_mesh(mesh, np.arange(len(mesh.tetrahedra)), 20)
    all_values = np.linalg.eigvalsh(few.matrix.toarray())[1:]
    np.testing.assert_allclose(few.values, all_values[:20], rtol=1e-8)
    weights = (1 / length_m**2 + all_values) ** -2
    assert few.variance_share(length_m) == pytest.approx(
        weights[:20].sum() / weights.sum(), rel=0.01
    )


def test_pieces_that_do_not_touch_have_a_stiffness_each():
    mesh = cs.box_mesh(SIZE_M, (2, 2, 6))
    layer = mesh.points_m[mesh.tetrahedra].mean(axis=1)[:, 2] // 0.02
    apart = np.flatnonzero((layer < 1) | (layer > 4))
    first = Laplacian.from_mesh(mesh, apart, 5).vectors[0]
    lower, upper = (first[part] for part in (layer[apart] < 1, layer[apart] > 4))
    assert np.ptp(lower) < 1e-6 * abs(lower[0])
    assert upper[0] == pytest.approx(-lower[0])


REMEMBERING, AVERAGING = {"prony": ["slow"]}, {"element": "tet10-p0"}
SLOWLY = AVERAGING | {"evaluator": "casadi"}  # whose second derivatives take long to compile


def uneven(kind: dict, rng: np.random.Generator) -> tuple[Body, list[np.ndarray], np.ndarray]:
    """A body, places, velocities and weights of its nodes, and θ with shares at its end."""
    body = bar(cs.Field(0.05, modes=4), divisions=(1, 1, 3), **kind)
    memory = {"slow.share": 0.3, "slow.tau_s": 0.1}
    shares = dict(zip(body.field_coefficient_names, rng.normal(size=4), strict=True))
    x = body.nodes_m + 1e-3 * rng.normal(size=body.nodes_m.shape)
    theta = body.theta_from_values({**KNOWN, **memory, "young_pa": YOUNG_PA, **shares})
    return body, [x, *rng.normal(size=(2, *x.shape))], theta


def share_steps(body: Body) -> np.ndarray:
    return 0.1 * np.isin(np.arange(len(body.constants)), np.r_[body.field_slices[0]])


@pytest.mark.parametrize("kind", [REMEMBERING, AVERAGING, SLOWLY], ids=str)
def test_slopes_by_the_shares_are_those_of_differences(kind: dict, rng):
    body, (x, v, _), theta = uneven(kind, rng)
    by_theta = body.linearise(x, v, theta).by_theta[0]

    def force(at: np.ndarray) -> np.ndarray:
        return body.force(x, v, at)[0]

    assert_derivative(force, lambda d: by_theta @ d, theta, rng, scale=share_steps(body))


@pytest.mark.parametrize("kind", [REMEMBERING, SLOWLY], ids=str)
def test_curvature_by_the_shares_is_that_of_differences(kind: dict, rng):
    body, (x, v, w), theta = uneven(kind, rng)
    by_both = body.second_derivatives(x, v, w, theta).theta_theta[0]

    def slope(at: np.ndarray) -> np.ndarray:
        return body.second_derivatives(x, v, w, at).theta[0]

    assert_derivative(slope, lambda d: by_both @ d, theta, rng, scale=share_steps(body))


def test_a_hidden_stiff_half_is_found():
    field = found(2.0)
    z_m = centres(bar())[:, 2]
    upper, lower = (np.log(field.value[part]).mean() for part in (z_m > 0.08, z_m < 0.04))
    assert np.exp(lower - upper) == pytest.approx(2.0, rel=0.15)
    assert held_share(field, 2.0) >= 0.9
    assert field.is_informed.mean() > 0.9
    assert 5 < field.identified_mode_count <= 20


@pytest.mark.parametrize("method", [cs.InteriorPoint(), cs.Shooting()], ids=type)
def test_other_methods_find_the_same_field(method):
    expected = cs.solve(problem(2.0, steps=3, modes=3))
    solution = cs.solve(problem(2.0, steps=3, modes=3), method)
    assert solution.status.converged
    for name, value in expected.parameters.items():
        assert solution.parameters[name] == pytest.approx(value, rel=1e-4, abs=1e-4)


def test_a_body_of_another_size_moves_a_field_as_its_budget_says():
    larger, shape = 1e-4, bar()
    field = cs.Field(0.05, modes=8)
    clamp_m = shape.nodes_m[shape.nodes_m[:, 2] > 0.119].mean(axis=0)
    true = Body(
        cs.TetMesh(clamp_m + (1 + larger) * (shape.nodes_m - clamp_m), shape.mesh.tetrahedra),
        density_kg_m3=100.0,
    )
    values, free = ({**KNOWN, "young_pa": YOUNG_PA}, {**KNOWN, "young_pa": cs.Unknown(YOUNG_PA)})
    solutions = [
        cs.solve(cs.Problem([cs.with_markers(swung(bar(field)), tracks)], free, substeps=1))
        for body in (shape, true)
        for tracks in [cs.simulate(swung(body), values, "midpoint", substeps=1).markers_m]
    ]
    moved = np.subtract(*(solution.q for solution in reversed(solutions)))
    fitted = solutions[0]
    changes = changes_of_assumptions(fitted.collocation, fitted.z, {"body_scale": larger})
    told = estimate_changes(linearise_fit(fitted.collocation, fitted.z), changes.blocks)
    size = changes.names.index("body_scale")
    assert np.abs(moved).max() > 0.05
    np.testing.assert_allclose(moved, -told[: len(moved), size], atol=0.03 * np.abs(moved).max())


HEAVY, OF_DENSITY = 1.4, cs.Field(0.05, "density_kg_m3", 20, 0.3)


@cache
def weighed() -> tuple[cs.Solution, FieldEstimate]:
    """A bar whose lower half is heavier, of as much mass as is stated, and its field of density."""
    lower = centres(bar())[:, 2] < 0.06
    light = 200.0 / (1 + HEAVY)
    half = cs.Region("half", lower, density_kg_m3=HEAVY * light)
    true = Body(bar().mesh, density_kg_m3=light, regions=[half])
    values = {**KNOWN, "young_pa": YOUNG_PA}
    tracks = cs.simulate(swung(true), values, "midpoint", substeps=1).markers_m
    noise = SIGMA_M * np.random.default_rng(5).normal(size=tracks.shape)
    seen = cs.with_markers(swung(bar(OF_DENSITY)), tracks + noise)
    unknown = {**KNOWN, "young_pa": cs.Unknown(0.7 * YOUNG_PA)}
    solution = cs.solve(cs.Problem([seen], unknown, substeps=1))
    collocation = solution.collocation
    known = uncertainty_at(collocation, solution.z)
    body = collocation.transcriptions[0].body
    (field,) = field_estimates(body, collocation.parameters, solution.q, known)
    return solution, field


def test_a_heavier_half_is_found_beside_the_stiffness():
    solution, field = weighed()
    assert solution.status.converged
    z_m, light = centres(bar())[:, 2], 200.0 / (1 + HEAVY)
    truth = light * np.where(z_m < 0.06, HEAVY, 1.0)
    low, high = field.statistical95
    told = field.is_informed
    assert told.mean() > 0.5
    assert np.mean((low < truth) & (truth < high)) > 0.9
    upper, lower = (field.value[part].mean() for part in (z_m > 0.08, z_m < 0.04))
    assert 1.2 < lower / upper < 1.6
    assert solution.parameters["young_pa"] == pytest.approx(YOUNG_PA, rel=0.1)


def test_a_density_field_has_the_mass_of_its_shapes(rng):
    body = bar(OF_DENSITY)
    shares = rng.normal(size=20)
    values = {
        **KNOWN,
        "young_pa": YOUNG_PA,
        **dict(zip(body.field_coefficient_names, shares, strict=True)),
    }
    mass_kg = body.mass_of_dofs(body.theta_from_values(values))[::3]
    local = 100.0 * (1 + body.parts[0].field.shapes @ shares)
    expected = np.zeros(len(body.nodes_m))
    np.add.at(expected, body.cells, (local * body.mesh.volumes_m3 / 4)[:, None])
    np.testing.assert_allclose(mass_kg, expected, rtol=1e-12)


def too_light(solution: cs.Solution, size: float = 30.0) -> cs.Solution:
    """The same where a shape of the density is so large that nodes have no mass."""
    place = [item.name for item in solution.collocation.parameters.free].index("field_1")
    return replace(solution, z=np.r_[solution.z[:place], size, solution.z[place + 1 :]])


def test_a_simulation_refuses_a_density_that_leaves_a_node_without_mass():
    body = bar(OF_DENSITY)
    values = {**KNOWN, "young_pa": YOUNG_PA}
    with pytest.raises(
        cs.InputError, match=r"because density_kg_m3 is too low near it; .*amplitude"
    ):
        cs.simulate(swung(body), {**values, "field_1": 30.0})


def test_an_answer_with_massless_parts_is_doubtful_with_the_reason():
    solution, field = weighed()
    assert "field/negative" not in [concern.code for concern in field.list_concerns()]
    light = too_light(solution)
    collocation = light.collocation
    (light_field,) = field_estimates(
        collocation.transcriptions[0].body, collocation.parameters, light.q, np.eye(len(light.q))
    )
    (concern,) = light_field.list_concerns()  # nothing else is concluded from such an answer
    assert (concern.code, concern.grade) == ("field/negative", "doubtful")
    assert "density_kg_m3 is zero or negative in" in concern.message
    problem = cs.Problem(collocation.experiments, collocation.parameters, substeps=1)
    said = simulate_experiment(problem, light, problem.experiments[0])
    assert isinstance(said, str)
    assert "expected masses above zero" in said


def test_a_solve_keeps_clear_of_masses_below_zero():
    lower = centres(bar())[:, 2] < 0.06
    heavy = cs.Region("half", lower, density_kg_m3=190.0)
    true = Body(bar().mesh, density_kg_m3=10.0, regions=[heavy])
    values = {**KNOWN, "young_pa": YOUNG_PA}
    tracks = cs.simulate(swung(true, steps=8), values, "midpoint", substeps=1).markers_m
    body = bar(cs.Field(0.03, "density_kg_m3", 12, 0.5))
    seen = cs.with_markers(swung(body, steps=8), tracks)
    solution = cs.solve(cs.Problem([seen], values, substeps=1))
    body = solution.collocation.transcriptions[0].body
    assert body.mass_of_dofs(body.theta_from_values(solution.parameters)).min() > 0


def test_densities_by_the_default_amplitude_have_masses_above_zero(rng):
    body = bar(cs.Field(0.03, "density_kg_m3", 30))
    for _ in range(200):
        shares = dict(zip(body.field_coefficient_names, rng.normal(size=30), strict=True))
        theta = body.theta_from_values({**KNOWN, "young_pa": YOUNG_PA, **shares})
        assert body.mass_of_dofs(theta).min() > 0


def test_an_even_body_is_found_even():
    field = found(1.0)
    assert held_share(field, 1.0) >= 0.95
    assert not field.list_concerns()


def test_undeformed_parts_of_a_field_keep_their_prior():
    field = found(1.0, 0.055)
    above = (bar().nodes_m[bar().cells, 2] > 0.055).all(axis=1)
    assert field.deviation_over_prior[above & (centres(bar())[:, 2] > 0.1)].min() > 0.9
    assert field.deviation_over_prior[~above].max() < 0.5


def test_an_amplitude_that_is_too_small_is_reported():
    codes = [concern.code for concern in found(3.0, amplitude=0.05).list_concerns()]
    assert "field/amplitude" in codes
    assert not found(3.0, amplitude=1.0).list_concerns()


def test_evidence_is_that_of_a_normal_marginal_likelihood(rng):
    body = bar(cs.Field(0.05, modes=6))
    modes, slopes, noise = body.parts[0].field, rng.normal(size=(30, 6)), 0.7
    data = rng.normal(size=30)
    posterior = np.linalg.inv(np.eye(6) + slopes.T @ slopes / noise**2)
    shares = posterior @ slopes.T @ data / noise**2
    many = np.ones(len(modes.shapes))
    field = FieldEstimate("young_pa", modes, np.arange(1), many, many, 1.96, shares, posterior)

    def exact(prior: np.ndarray) -> float:
        total = slopes @ prior @ slopes.T + noise**2 * np.eye(30)
        return -float(data @ np.linalg.solve(total, data) + np.linalg.slogdet(total)[1]) / 2

    beyond = replace(field, covariance=2 * np.eye(6))  # the model misses by more than noise
    assert beyond.log_evidence_ratio(factor=3.0) == 0.0
    for length_m, factor in ((None, 3.0), (0.02, 1.0), (0.1, 0.5)):
        other = modes if length_m is None else modes.with_length(length_m)
        turn = factor * np.linalg.lstsq(modes.shapes, other.shapes, rcond=None)[0]
        expected = exact(turn @ turn.T) - exact(np.eye(6))
        assert field.log_evidence_ratio(length_m, factor) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(
    ("stated", "message"),
    [
        (
            {"parameter": "E"},
            "expected one of young_pa, lambda_pa, mu_pa, gamma_r_s, density_kg_m3",
        ),
        ({"modes": 1000}, "expected at most 60, because the part of the body .* has 63 nodes"),
        ({"length_m": 0.0}, "length_m of a field is 0; expected a number above 0"),
        ({"length_m": []}, "length_m of a field is"),
    ],
)
def test_a_field_that_cannot_be_is_refused(stated: dict, message: str):
    with pytest.raises(cs.InputError, match=message):
        bar(cs.Field(**({"length_m": 0.05} | stated)))


def test_bodies_of_other_meshes_do_not_share_a_field():
    (one,) = problem().experiments
    other = Body(
        cs.box_mesh(SIZE_M, (2, 2, 5)), density_kg_m3=100.0, field=cs.Field(0.05, modes=20)
    )
    second = replace(swung(other), name="second")
    with pytest.raises(cs.InputError, match="two bodies have a field of young_pa"):
        cs.Problem([one, second], {**KNOWN, "young_pa": cs.Unknown(YOUNG_PA)})


def test_a_field_of_nothing_is_refused():
    with pytest.raises(cs.InputError, match="the regions contain every cell"):
        bar(cs.Field(0.05), np.ones(144, dtype=bool))


def test_a_field_is_one_parameter_with_a_slice_of_the_coordinates():
    known = problem(modes=4)
    parameters = known.parameters
    assert len(parameters.items) == len(KNOWN) + 2
    (field,) = parameters.fields
    assert field.name == "field"
    assert [each.name for each in field.components] == ["field_1", "field_2", "field_3", "field_4"]
    assert {each.prior for each in field.components} == {(0.0, 1.0)}
    assert [each.name for each in parameters.free_scalars] == ["young_pa"]
    assert parameters.scalar_coordinates == (0,)
    assert len(parameters.free) == 5
    q = np.linspace(0.1, 0.5, 5)
    assert parameters.scalar_values(q) == KNOWN | {"young_pa": np.exp(0.1)}
    assert parameters.values(q)["field_4"] == 0.5
    without = parameters.without({"field_2", "poisson"})
    assert [each.name for each in without.fields[0].components] == ["field_1", "field_3", "field_4"]
    assert parameters.without(body_coefficients(known)).fields == ()


def body_coefficients(known: cs.Problem) -> tuple[str, ...]:
    (body,) = known.bodies
    return body.field_coefficient_names


def test_a_scalar_is_not_tied_to_a_component_of_a_field():
    (seen,) = problem(modes=4).experiments
    tied = {**KNOWN, "field_1": cs.Unknown(0.1)}
    tied["young_pa"] = cs.Tied("field_1", 2.0)
    with pytest.raises(cs.InputError, match="young_pa: tied to 'field_1', expected a parameter"):
        cs.Problem([seen], tied)


def test_a_stated_coefficient_keeps_its_value_and_has_no_error_bar():
    (seen,) = problem(2.0, modes=4).experiments
    values = {**KNOWN, "field_2": 0.3, "young_pa": cs.Unknown(3e3)}
    run = cs.run(cs.Problem([seen], values, substeps=1), seek_causes=False)
    assert run.solution.status.converged
    assert run.estimates["field_2"].value == 0.3
    assert run.estimates["field_2"].fixed
    field = run.fields["young_pa"]
    assert field.coefficients[1] == 0.3
    assert field.covariance.shape == (3, 3)
    assert (np.diag(field.covariance) > 0).all()
    assert field.log_evidence_ratio(factor=2.0) == 0.0
    assert "field_" not in repr(run)


def test_the_likeliest_of_several_lengths_is_taken():
    several = replace(problem(2.0), experiments=[_of_lengths(0.005, 0.05)])
    run = cs.run(several, seek_causes=False)
    assert run.problem.lengths_m == {"young_pa": 0.05}
    found = run.result.fields["young_pa"]
    assert found.shapes.length_m == 0.05
    assert found.likelier["0.05"] == 0.0 > found.likelier["0.005"]
    said = " ".join(str(run).split())
    assert "length 0.05 m; relative log evidence of the lengths: 0.005 m -" in said


def _of_lengths(*lengths_m: float) -> cs.Experiment:
    (known,) = problem(2.0).experiments
    return replace(known, body=bar(cs.Field(lengths_m, modes=20)))


def test_a_run_folder_has_the_field_in_every_element(tmp_path):
    run = cs.run(problem(2.0), seek_causes=False)
    assert run.trust.verdict == "good" or not any("field" in r for r in run.trust.reasons)
    run.save(tmp_path / "run")
    result, (replay,) = read_run(tmp_path / "run")
    stored, field = replay.fields["young_pa"], run.fields["young_pa"]
    assert result.fields["young_pa"].identified == field.identified_mode_count
    np.testing.assert_array_equal(stored[field.cells, 0], field.value)
    assert (stored[:, 1] < stored[:, 0]).all()
    assert (stored[:, 0] < stored[:, 2]).all()
    frame = (tmp_path / "run" / "frames" / "frame_0000.vtu").read_text()
    assert 'Name="young_pa_over_prior"' in frame
    with np.load(tmp_path / "run" / "trajectory.npz") as arrays:
        documented = documented_arrays()
        for name in arrays.files:
            assert name in documented or f"{name.partition('_')[0]}_NAME" in documented, name
        assert "field_young_pa" in arrays.files
        np.testing.assert_array_equal(arrays["field_young_pa"], stored)
    said = str(run)
    assert "field_1" not in said
    assert "E from " in said
    untold = stored.copy()
    untold[:, 3] = 1.0
    told, pale = (field_picture(replay, "young_pa", values) for values in (stored, untold))
    assert _brightness(pale) > _brightness(told) + 0.1


def documented_arrays() -> set[str]:
    """Names of the arrays of trajectory.npz in the table of docs/howto/field.md."""
    page = (Path(__file__).parents[2] / "docs/howto/field.md").read_text(encoding="utf-8")
    rows = page.partition("## Arrays")[2].partition("\n#")[0].splitlines()
    cells = [row.split("|")[1] for row in rows if row.startswith("| `")]
    return {name for cell in cells for name in re.findall("`([^`]+)`", cell)}


def test_the_documented_arrays_are_those_that_a_run_may_have():
    documented = documented_arrays()
    missing = {*ARRAY_LAYOUT, "residuals_m", "part_names", "marker_names", "static"} - documented
    assert not missing
    fronts = {f"{front}NAME" for front in GROUP_PREFIXES.values()} | {"wrench_K", "columns_NAME"}
    assert fronts <= documented
    assert documented <= {
        *ARRAY_LAYOUT,
        "residuals_m",
        "part_names",
        "marker_names",
        "static",
        *fronts,
    }


def _brightness(figure: Figure) -> float:
    axes = figure.axes[0]
    drawn = [each.get_facecolor() for each in axes.collections]
    return float(np.concatenate(drawn)[:, :3].mean())


def test_a_finer_mesh_has_the_same_field():
    core = cs.Region("core", np.arange(30), field=cs.Field((0.02, 0.04), "mu_pa", 3))
    body = bar(cs.Field(0.05, modes=4), regions=[core])
    body = body.with_field_lengths(body.field_lengths_m | {"core.mu_pa": 0.04})
    finer = refine_body(body)
    assert finer.field_lengths_m == {"young_pa": 0.05, "core.mu_pa": 0.04}
    for coarse, fine in zip(body.parts, finer.parts, strict=True):
        np.testing.assert_array_equal(fine.field.shapes, np.repeat(coarse.field.shapes, 8, axis=0))
    shares = dict.fromkeys(body.field_coefficient_names, 0.3)
    values = {"poisson": 0.3, **shares, "young_pa": YOUNG_PA}
    stretched = np.diag([1.02, 0.99, 1.05])
    energies = [
        each.energy(
            each.nodes_m @ stretched, **{n: v for n, v in values.items() if "gamma" not in n}
        )
        for each in (body, finer)
    ]
    assert energies[1] == pytest.approx(energies[0], rel=1e-12)


def test_a_file_states_fields_of_the_body_and_of_a_region(tiny: Path):
    own = ["length_m=0.1", "modes=3", "parameter=gamma_r_s"]
    core = "[{name = 'core', cells = {box_m = [[-1, -1, -1], [1, 1, 0.05]]}}]"
    stated = [*(f"object.field.{each}" for each in own), f"object.region={core}"]
    inside = ["object.region.core.field.length_m=[0.1, 0.2]", "object.region.core.field.modes=2"]
    read = cs.Problem.read(tiny / "problem.toml", [*stated, *inside])
    assert read.lengths_m == {"gamma_r_s": 0.1, "core.young_pa": 0.1}
    free = [item.name for item in read.parameters.free if "field" in item.name]
    assert free == ["field_1", "field_2", "field_3", "core.field_1", "core.field_2"]
    known = cs.Problem.read(tiny / "problem.toml", [*stated, "parameters.field_2.guess=0.4"])
    shares = [item for item in known.parameters.free if item.name.startswith("field_")]
    assert sorted((share.guess, share.prior) for share in shares) == [(0.0, (0.0, 1.0))] * 2 + [
        (0.4, (0.0, 1.0))
    ]
    assert [item.name for item in read.parameters.fields] == ["field", "core.field"]
    (field,) = known.parameters.fields
    assert [share.guess for share in field.components] == [0.0, 0.4, 0.0]
    wrong = "object.region.core.field.parameter=E"
    with pytest.raises(cs.InputError, match=r"object.region 'core': parameter of the field is 'E'"):
        cs.Problem.read(tiny / "problem.toml", [*stated, *inside, wrong])


@pytest.mark.parametrize(("length_m", "codes"), [(0.05, []), (0.003, ["field/shapes"])])
def test_check_reports_the_fields_that_the_shapes_can_determine(length_m: float, codes: list[str]):
    body = bar(cs.Field(length_m, modes=10))
    seen = check_body(body, body.theta_from_values({**KNOWN, "young_pa": YOUNG_PA}), ("swing",))
    assert [each.code for each in seen.concerns if each.topic == "field"] == codes
    assert seen.fields["young_pa"].modes == 10
    assert "field_1" not in seen.guess


def test_the_line_about_a_field_states_its_smoothing():
    shapes = FieldResolution(modes=40, length_m=0.04, amplitude=0.5, share=0.95, detail_m=0.021)
    line = FieldResult(shapes, (2e4, 7e4), 1.0, 28, {}).sentence("young_pa")
    assert "above 21 mm; values are those of a field smoothed over 40 mm" in line
    assert "a small inclusion with a sharp boundary differs more; the intervals contain" in line


@pytest.mark.long
@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("name", ["stiff ball, twice", "stiff ball, three times"])
def test_intervals_inside_a_stiff_ball_contain_its_stiffness(name, seed):
    """The prior smooths the edge of the ball: without that, 40 to 70 % of them contain it."""
    (twin,) = (each for each in study_field.TWINS if each.name == name)
    answer = study_field.identify(twin, seed)
    inside = study_field.stiff_cells(twin.kind, answer.mesh)
    low, high = np.log(answer.field.statistical95)
    contains = (low < answer.truth) & (answer.truth < high)
    assert contains[inside].mean() > 0.9
    assert np.median(high - low) < 2.0 * 0.6


def test_nothing_is_smoothed_in_a_homogeneous_body():
    field = found()
    assert field.smoothing is not None
    assert field.smoothing.max() < 0.5 * field.deviation.min()
