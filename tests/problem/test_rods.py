"""Problem files of slender bodies: keys, refusals, and the shipped example."""

from __future__ import annotations

import numpy as np
import pytest

import collocation_sysid as cs
from collocation_sysid.errors import InputError
from collocation_sysid.problem.new import create_problem
from collocation_sysid.recording.writers import write_markers_csv

TRUTH = {"bending_n_m2": 1e-3, "gamma_r_s": 2e-3, "gamma_m_1_s": 0.3}


@pytest.fixture
def problem(tmp_path):
    create_problem(tmp_path / "hose", "cable")
    return tmp_path / "hose" / "problem.toml"


def changed(problem, old: str, new: str):
    text = problem.read_text(encoding="utf-8")
    assert old in text
    problem.write_text(text.replace(old, new), encoding="utf-8")
    return problem


def test_sections_are_at_the_stated_arc_lengths(problem):
    mesh = cs.Problem.read(problem).bodies[0].mesh
    assert isinstance(mesh, cs.RodMesh)
    for s_m in (0.0, 0.05, 0.3, 0.6):
        assert np.abs(mesh.s_m - s_m).min() < 1e-12


def test_a_grasp_holds_the_sections_between_two_arc_lengths(problem):
    experiment = cs.Problem.read(problem).experiments[0]
    mesh = experiment.body.mesh
    held = np.unique(mesh.arc_lengths_m[experiment.grasps[0].nodes])
    assert np.array_equal(held, mesh.s_m[mesh.s_m <= 0.05 + 1e-9])


def test_a_place_may_be_a_little_beyond_the_end_of_a_measured_curve(problem):
    """A curve of 598.7 mm through measured points, and a tip at 600 mm by a ruler."""
    changed(problem, "length_m = 0.6  ", "length_m = 0.5987  ")
    experiment = cs.Problem.read(problem).experiments[0]
    tip_m = experiment.markers.predict_positions(experiment.body.nodes_m)[
        experiment.markers.names.index("tip")
    ]
    assert np.allclose(tip_m, [0.5987, 0, 0])


def test_the_mass_is_that_per_length(problem):
    assert cs.Problem.read(problem).bodies[0].mass_kg == pytest.approx(0.034 * 0.6)


def test_a_centreline_of_points_has_its_arc_length(problem):
    angle = np.linspace(0.0, np.pi, 40)
    rows = [f"{0.2 * np.sin(a):.9f},{0.2 * np.cos(a):.9f}" for a in angle]
    (problem.parent / "arc.csv").write_text("\n".join(["x_m,z_m", *rows, ""]), encoding="utf-8")
    changed(problem, "length_m = 0.6  ", 'centreline = "arc.csv"')
    body = cs.Problem.read(problem).bodies[0]
    assert body.mesh.s_m[-1] == pytest.approx(0.2 * np.pi, rel=1e-6)


@pytest.mark.parametrize("rest_shape", ["straight", "stress_free"])
def test_the_rest_shape_of_a_curved_centreline_is_as_stated(rest_shape, problem):
    angle = np.linspace(0.0, np.pi / 2, 40)
    rows = [f"{0.4 * np.sin(a):.9f},{0.4 * np.cos(a):.9f}" for a in angle]
    (problem.parent / "arc.csv").write_text("\n".join(["x_m,z_m", *rows, ""]), encoding="utf-8")
    changed(problem, "length_m = 0.6  ", 'centreline = "arc.csv"')
    changed(problem, 'rest_shape = "straight"', f'rest_shape = "{rest_shape}"')
    changed(problem, "s_m = { middle = 0.3, tip = 0.6 }", "")
    body = cs.Problem.read(problem).bodies[0]
    constants = TRUTH | {"torsion_n_m2": 3e-4, "axial_n": 200.0}
    energy = body.energy(body.nodes_m, **constants)
    length_m = 0.4 * np.pi / 2
    bent = 0.5 * TRUTH["bending_n_m2"] * length_m / 0.4**2
    assert energy == pytest.approx(bent if rest_shape == "straight" else 0.0, rel=5e-3, abs=1e-12)


def test_natural_curvature_is_unknown_unless_the_rest_shape_or_a_curvature_is_stated(problem):
    stated = cs.Problem.read(problem).parameters
    assert {item.name for item in stated.free} == TRUTH.keys()
    changed(problem, 'rest_shape = "straight"', "")
    unstated = cs.Problem.read(problem).parameters
    bent = {item.name: item.prior for item in unstated.free if item.name not in TRUTH}
    names = {"curvature_1_1_m", "curvature_2_1_m", "twist_1_m"}
    assert bent == dict.fromkeys(names, (0.0, pytest.approx(0.5 / 0.6)))
    changed(problem, "gamma_m_1_s  = {}", "gamma_m_1_s  = {}\ncurvature_1_1_m = {}")
    one = cs.Problem.read(problem).parameters
    assert {item.name for item in one.free} == TRUTH.keys() | {"curvature_1_1_m"}


@pytest.mark.long
def test_a_cable_that_is_bent_by_itself_is_identified_unless_it_is_stated_to_be_straight(problem):
    natural = {"curvature_1_1_m": 0.25, "curvature_2_1_m": -0.2, "twist_1_m": 0.1}
    changed(problem, "sections = 41", "sections = 21")
    changed(problem, 'name = "swing"', 'name = "swing"\nwindow_s = [0.0, 1.5]')
    straight = problem.read_text(encoding="utf-8")
    changed(problem, 'rest_shape = "straight"', "")
    (experiment,) = cs.Problem.read(problem).experiments
    tracks_m = cs.simulate(
        experiment, TRUTH | natural | {"torsion_n_m2": 3e-4, "axial_n": 200.0}
    ).markers_m
    noise_m = np.random.default_rng(2).normal(scale=5e-4, size=tracks_m.shape)
    names = experiment.markers.names
    write_markers_csv(problem.parent / "markers.csv", experiment.t_s, names, tracks_m + noise_m)
    wrench = 'wrench = { file = "wrench.csv", sigma_n = 0.01, sigma_nm = 0.001, frame = "world" }'
    run = cs.run(cs.Problem.read(changed(problem, wrench, "")))
    assert run.trust.verdict == "good"
    for name, true in (TRUTH | natural).items():
        low, high = run.interval(name)
        assert low <= true <= high
    problem.write_text(straight.replace(wrench, ""), encoding="utf-8")
    wrong = cs.run(cs.Problem.read(problem))
    assert any("rest shape" in each.message for each in wrong.trust.concerns)


ENDS = {"curvature_1_1_m": 1.0, "curvature_1_end_1_m": -1.5}


def test_the_end_of_a_natural_curvature_is_as_its_beginning_unless_it_is_stated(problem):
    changed(problem, 'name = "swing"', 'name = "swing"\nwindow_s = [0.0, 0.1]')
    changed(
        problem, "gamma_m_1_s  = {}", "gamma_m_1_s  = {}\ncurvature_1_1_m = {}\ntwist_1_m = 0.2"
    )
    constant = cs.Problem.read(problem)
    changed(problem, "twist_1_m = 0.2", "twist_1_m = 0.2\ncurvature_2_end_1_m = 0.0")
    affine = cs.Problem.read(problem)
    assert {item.name for item in affine.parameters.free} == TRUTH.keys() | {"curvature_1_1_m"}
    ties = {item.name: item.tied.to for item in affine.parameters.components if item.tied}
    assert ties == {"curvature_1_end_1_m": "curvature_1_1_m"}
    (twist,) = (item for item in affine.parameters.components if item.name == "twist_end_1_m")
    assert twist.is_fixed
    assert twist.guess == 0.2
    known = TRUTH | {"torsion_n_m2": 3e-4, "axial_n": 200.0, "curvature_2_1_m": 0.0}
    known |= {"curvature_1_1_m": 1.0, "twist_1_m": 0.2}
    ends = {"curvature_1_end_1_m": 1.0, "curvature_2_end_1_m": 0.0, "twist_end_1_m": 0.2}
    uniform_m = cs.simulate(constant.experiments[0], known).markers_m
    assert (
        np.abs(cs.simulate(affine.experiments[0], known | ends).markers_m - uniform_m).max() < 1e-9
    )


def test_a_region_alone_may_have_a_natural_curvature(problem):
    with_region(problem, "s_m = [0.3, 0.6]")
    changed(problem, "[parameters]", '[parameters]\n"core.curvature_1_1_m" = {}')
    parameters = cs.Problem.read(problem).parameters
    assert {item.name for item in parameters.free} == TRUTH.keys() | {"core.curvature_1_1_m"}


@pytest.mark.long
def test_a_natural_curvature_that_is_affine_is_identified(problem):
    changed(problem, "sections = 41", "sections = 21")
    changed(problem, 'name = "swing"', 'name = "swing"\nwindow_s = [0.0, 1.5]')
    unknown = "".join(f"\n{name} = {{}}" for name in ENDS)
    changed(problem, "gamma_m_1_s  = {}", "gamma_m_1_s  = {}" + unknown)
    (experiment,) = cs.Problem.read(problem).experiments
    zero = dict.fromkeys(
        ["curvature_2_1_m", "curvature_2_end_1_m", "twist_1_m", "twist_end_1_m"], 0.0
    )
    constants = TRUTH | ENDS | zero | {"torsion_n_m2": 3e-4, "axial_n": 200.0}
    tracks_m = cs.simulate(experiment, constants).markers_m
    noise_m = np.random.default_rng(5).normal(scale=5e-4, size=tracks_m.shape)
    names = experiment.markers.names
    write_markers_csv(problem.parent / "markers.csv", experiment.t_s, names, tracks_m + noise_m)
    wrench = 'wrench = { file = "wrench.csv", sigma_n = 0.01, sigma_nm = 0.001, frame = "world" }'
    run = cs.run(cs.Problem.read(changed(problem, wrench, "")))
    assert run.trust.verdict == "good"
    for name, true in (TRUTH | ENDS).items():
        low, high = run.interval(name)
        assert low <= true <= high


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("section = { diameter_m = 0.006 }", "", "section is missing"),
        ("diameter_m = 0.006", "diameter_m = 0.006, inner_m = 0.006", "below the diameter"),
        ("diameter_m = 0.006", "width_m = 0.006", "width_m and height_m"),
        ("length_m = 0.6  ", "box_m = [0.1, 0.1, 0.1]\nedge_length_m = 0.05", "without centreline"),
        ('material = "cable"', 'material = "yeoh"', "'rod' (E and ν) or 'cable'"),
        ('material = "cable"', 'material = "neo-hookean"', "'rod' (E and ν) or 'cable'"),
        (
            "s_m = [0.0, 0.05] }",
            "box_m = [[-1, -0.0005, -1], [0.05, 1, 1]] }",
            "only some nodes of the rod's section at 0 m",
        ),
        ("s_m = [0.0, 0.05] }", 'face = "top" }', "expected whole sections"),
        ('material = "cable"', 'material = "cable"\nelement = "tet10"', "element for a rod"),
        ("tip = 0.6 }", "tip = 0.7 }", "markers.s_m: found the arc length 0.7 m"),
        ("tip = 0.6 }", "top = 0.6 }", "markers.s_m: found 'top'"),
        ("s_m = [0.0, 0.05]", "s_m = [0.0, 0.7]", "grasp.nodes: found [0, 0.7]"),
        ("diameter_m = 0.006", "diameter_m = 6", "object.section.* likely 0.006 m"),
        ("mass_per_length_kg_m = 0.034", "", "expected exactly one of mass_per_length_kg_m"),
        ("diameter_m = 0.006", "diameter_m = 1e-5", "object.sections: found 41, which are"),
        ("sections = 41", "sections = 100000000", "memory"),
        ("length_m = 0.6  ", "length_m = 600.0  ", "likely 0.6, if it was in mm"),
        ("s_m = [0.0, 0.05]", "s_m = [0.05, 0.0]", "the first arc length"),
        ("mass_per_length_kg_m = 0.034", "mass_per_length_kg_m = 0.034\nmass_kg = 1.0", "mass_kg"),
    ],
)
def test_a_wrong_description_is_refused_with_the_expected_one(old, new, message, problem):
    for bracket in "()[]":
        message = message.replace(bracket, "\\" + bracket)
    with pytest.raises(InputError, match=message):
        cs.Problem.read(changed(problem, old, new))


@pytest.mark.parametrize(
    ("rows", "found"),
    [
        (["0,0,0"], "one point"),
        (["0,0,0", "0.3,0,0", "0.3,0,0", "0.6,0,0"], "two equal points"),
        (["0,0,0", "0.6,0,0", "0,0,0"], "a turn of 180° at point 2"),
        (["0,0,0", "0.3,0,0", "1e-4,1e-4,0", "0.6,0,0"], "a turn of 180° at point"),
    ],
)
def test_points_that_are_no_smooth_curve_are_refused(rows, found, problem):
    table = "\n".join(["x_m,y_m,z_m", *rows, ""])
    (problem.parent / "arc.csv").write_text(table, encoding="utf-8")
    with pytest.raises(InputError, match=rf"object\.centreline: found {found}"):
        cs.Problem.read(changed(problem, "length_m = 0.6  ", 'centreline = "arc.csv"'))


def test_arc_lengths_of_a_solid_body_are_refused(tmp_path):
    create_problem(tmp_path / "foam", "swing")
    problem = tmp_path / "foam" / "problem.toml"
    changed(
        problem, "nodes = { box_m = [[-1, -1, -0.001], [1, 1, 0.001]] }", "nodes = { s_m = [0, 1] }"
    )
    with pytest.raises(InputError, match="not a rod"):
        cs.Problem.read(problem)
    create_problem(tmp_path / "sponge", "swing")
    problem = with_region(tmp_path / "sponge" / "problem.toml", "s_m = [0, 0.1]")
    with pytest.raises(InputError, match=r"object\.region 'core'.*not a rod"):
        cs.Problem.read(problem)


def with_region(problem, cells: str):
    text = problem.read_text(encoding="utf-8")
    region = f'[[object.region]]\nname = "core"\ncells = {{ {cells} }}\n'
    problem.write_text(text + region, encoding="utf-8")
    return changed(problem, "[parameters]", '[parameters]\n"core.bending_n_m2" = 2e-3')


def test_a_region_between_arc_lengths_is_that_of_its_cell_numbers(problem):
    changed(problem, 'name = "swing"', 'name = "swing"\nwindow_s = [0.0, 0.1]')
    text = problem.read_text(encoding="utf-8")
    stated = cs.Problem.read(with_region(problem, "s_m = [0.05, 0.3]"))
    s_m = stated.bodies[0].mesh.s_m
    first, end = np.searchsorted(s_m, [0.05 - 1e-9, 0.3 - 1e-9])
    problem.write_text(text, encoding="utf-8")
    numbered = cs.Problem.read(with_region(problem, f"indices = {[*range(3 * first, 3 * end)]}"))
    constants = {"core.bending_n_m2": 2e-3, "torsion_n_m2": 3e-4, "axial_n": 200.0}
    tracks_m, others_m = (
        cs.simulate(each.experiments[0], TRUTH | constants).markers_m for each in (stated, numbered)
    )
    assert np.array_equal(tracks_m, others_m)


def test_a_rod_has_sections_where_a_region_ends(problem):
    body = cs.Problem.read(with_region(problem, "s_m = [0.1234, 0.2345]")).bodies[0]
    (core,) = (part for part in body.parts if part.name == "core")
    assert np.allclose(body.mesh.s_m[[core.cells[0], core.cells[-1] + 1]], [0.1234, 0.2345])


def test_a_region_outside_a_rod_is_refused(problem):
    with pytest.raises(InputError, match=r"object\.region 'core'.*\[0\.3, 0\.7\].*0 to 0\.6 m"):
        cs.Problem.read(with_region(problem, "s_m = [0.3, 0.7]"))


@pytest.mark.long
def test_the_example_gives_the_true_constants(problem):
    run = cs.run(cs.Problem.read(problem))
    assert run.trust.verdict == "good"
    for name, true in TRUTH.items():
        low, high = run.interval(name)
        assert low <= true <= high
    assert run.parameters["bending_n_m2"] == pytest.approx(1e-3, rel=0.02)


@pytest.mark.long
@pytest.mark.parametrize("instrument", ["wrench", "markers"])
def test_either_instrument_alone_is_sufficient(instrument, problem):
    if instrument == "wrench":
        text = problem.read_text(encoding="utf-8")
        problem.write_text(text[: text.index("[experiment.markers]")], encoding="utf-8")
    else:
        changed(problem, "wrench = {", "# wrench = {")
    solution = cs.solve(cs.Problem.read(problem))
    assert solution.parameters["bending_n_m2"] == pytest.approx(1e-3, rel=0.02)
    assert solution.parameters["gamma_r_s"] == pytest.approx(2e-3, rel=0.05)


@pytest.mark.long
def test_a_guess_that_is_wrong_by_a_factor_takes_few_sweeps(problem):
    changed(problem, "sections = 41", "sections = 31")
    changed(problem, "bending_n_m2 = {} ", "bending_n_m2 = { guess = 2e-3 } ")
    changed(problem, "gamma_r_s    = {}", "gamma_r_s = { guess = 1e-3 }")
    changed(problem, "gamma_m_1_s  = {}", "gamma_m_1_s = { guess = 0.1 }")
    solution = cs.solve(cs.Problem.read(problem))
    assert solution.status.converged
    assert solution.history[-1].number <= 16
    assert solution.parameters["bending_n_m2"] == pytest.approx(1e-3, rel=0.02)


def test_a_place_that_is_estimated_moves_along_the_centreline(problem):
    changed(problem, "s_m = { middle = 0.3, tip = 0.6 }", "s_m = { tip = 0.6 }")
    collocation = cs.Problem.read(problem).collocation()
    axes = collocation.transcriptions[0].association.markers.axes
    assert axes.shape == (2, 3, 1)
    assert np.allclose(np.abs(axes[0, :, 0]), [1, 0, 0])
