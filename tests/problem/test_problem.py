"""Problem files: loaded values, defaults and messages."""

from __future__ import annotations

import re
import tomllib
from dataclasses import replace
from pathlib import Path

import casadi as ca
import meshio
import numpy as np
import pytest
from kit.problem_files import (
    GRASP,
    REFERENCES,
    SIZE_M,
    both,
    contents,
    keep_lines,
    remove,
    replace_cell,
    replace_text,
    write,
)
from kit.problems import prescribed_positions
from scipy.spatial.transform import Rotation

from collocation_sysid.errors import InputError
from collocation_sysid.fem.laws.materials import MATERIALS, neo_hookean
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.fem.pattern import dofs_of
from collocation_sysid.problem import Problem
from collocation_sysid.problem.loading import read_problem_file
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.recording import PoseSequence, read_markers, read_poses, write_poses_csv
from collocation_sysid.runs.check import check_problem
from collocation_sysid.runs.derivatives import shortened_problem

POSES, MARKERS = "swing_motion.csv", "swing_markers.csv"
BOX = "{ box_m = [[-1, -1, 0.089], [1, 1, 1]] }"
PROBLEMS = (Path(__file__).parents[2] / "problems").glob("*/*.toml")
SHIPPED = sorted(file for file in PROBLEMS if file.name not in ("limits.toml", "task.toml"))


def load(tiny: Path, *overrides: str, **options):
    return Problem.read(tiny / "problem.toml", overrides, **options)


def text_of(problem: Problem) -> str:
    assert problem.origin is not None
    return problem.origin.text


def experiment_of(tiny: Path, *overrides: str):
    return load(tiny, *overrides).experiments[0]


def top_nodes() -> np.ndarray:
    mesh = box_mesh(SIZE_M, (2, 2, 3))
    return np.flatnonzero(mesh.points_m[:, 2] > SIZE_M[2] - 1e-6)


# Overrides ----------------------------------------------------------------------------------------


def test_overrides_are_written_as_in_toml(tiny):
    overrides = [
        "title=Two words",
        "object.mass_kg=0.01",
        "experiment.0.gravity_m_s2=[0, 0, -1.62]",
        "experiment.swing.start = undeformed",
        'experiment.swing.grasp.nodes.name="top"',
        "parameters.mu_pa={ fixed = 300 }",
        "solver.reduced-space.ladder=[0.5, 1]",
    ]
    replace_text("density_kg_m3 = 30.0", "")(tiny)
    replace_text(BOX, "{}")(tiny)
    file, _ = read_problem_file(tiny / "problem.toml", overrides)
    assert file.title == "Two words"
    assert file.object.mass_kg == 0.01
    assert file.experiment[0].gravity_m_s2 == (0, 0, -1.62)
    assert file.experiment[0].start == "undeformed"
    assert file.parameters["mu_pa"].fixed == 300
    assert file.solver.methods["reduced-space"].ladder == (0.5, 1.0)


def test_the_velocity_of_a_body_that_is_thrown_is_stated_in_the_file(tiny):
    stated = (
        "start = 'undeformed'\nstart_velocity_m_s = [0.1, 0, 2]\nstart_spin_rad_s = [0, 3, 0]\n"
    )
    replace_text('name = "swing"\n', f'name = "swing"\n{stated}')(tiny)
    thrown = experiment_of(tiny)
    np.testing.assert_array_equal(thrown.start_velocity_m_s, [0.1, 0, 2])
    np.testing.assert_array_equal(thrown.start_spin_rad_s, [0, 3, 0])
    assert thrown.initial_velocities_m_s is not None
    assert np.ptp(thrown.initial_velocities_m_s[:, 0]) == pytest.approx(3 * SIZE_M[2])
    with pytest.raises(InputError, match="start_velocity_m_s is given, but start is 'equilibrium'"):
        experiment_of(tiny, "experiment.swing.start=equilibrium")


def test_the_text_as_run_contains_the_overrides(tiny):
    given = (tiny / "problem.toml").read_text()
    assert text_of(load(tiny)) == given
    text = text_of(load(tiny, "parameters.mu_pa.guess=250"))
    assert tomllib.loads(text)["parameters"]["mu_pa"]["guess"] == 250
    write("problem.toml", text)(tiny)
    assert read_problem_file(tiny / "problem.toml")[0].parameters["mu_pa"].guess == 250


def test_a_file_from_a_windows_editor_is_read(tiny):
    text = (tiny / "problem.toml").read_text()
    write("problem.toml", text.replace("\n", "\r\n").encode("utf-8-sig"))(tiny)
    assert load(tiny).title == "A tiny foam bar"


# Body and parameters ------------------------------------------------------------------------------


def test_the_body_has_the_stated_mass(tiny):
    replace_text("density_kg_m3 = 30.0", "mass_kg = 0.02")(tiny)
    assert load(tiny).bodies[0].node_mass.sum() == pytest.approx(0.02)


def test_lengths_of_a_mesh_have_a_unit(tiny):
    mesh = meshio.read(tiny / "body.vtu")
    mesh.points = 1e3 * mesh.points
    mesh.write(tiny / "body.vtu")
    assert load(tiny, "object.length_unit=mm").bodies[0].mesh.volume_m3 == pytest.approx(
        0.06**2 * 0.09
    )


def test_elastic_parameters_may_be_young_and_poisson(tiny):
    young, poisson = 720.0, 0.2
    both(
        replace_text("lambda_pa   = { guess = 400.0,", f"young_pa = {{ guess = {young},"),
        replace_text(
            "mu_pa       = { guess = 200.0, lower = 10.0, upper = 1e5 }",
            f"poisson = {{ fixed = {poisson} }}",
        ),
    )(tiny)
    problem = load(tiny)
    parameters = problem.parameters
    assert problem.bodies[0].theta_from_values(parameters.guesses)[:2] == pytest.approx(
        [200.0, 300.0]
    )
    assert [item.name for item in parameters.free] == ["young_pa", "gamma_r_s", "gamma_m_1_s"]


def test_bounds_and_priors_reach_the_parameters(tiny):
    prior = "parameters.mu_pa.prior={ mean = 250.0, relative = 0.2 }"
    replace_text("{ guess = 0.5, lower = 1e-3, upper = 100.0 }", "{ guess = 0.5 }")(tiny)
    _, mu, _, gamma_m = load(tiny, prior).parameters.items
    assert (mu.guess, mu.lower, mu.upper, mu.prior) == (200.0, 10.0, 1e5, (250.0, 0.2))
    assert gamma_m.lower < 1e-3 < 100 < gamma_m.upper


@pytest.mark.parametrize(
    ("name", "prior", "expected"),
    [
        ("mu_pa", "mean = 250.0, relative = 0.2", 0.2),
        ("mu_pa", "mean = 250.0, deviation = 50.0", 0.2),
        ("poisson", "mean = 0.25, relative = 0.2", 0.05),
        ("poisson", "mean = 0.25, deviation = 0.05", 0.05),
    ],
)
def test_the_deviation_of_a_prior_may_be_relative_or_not(tiny, name, prior, expected):
    replace_text("lambda_pa   = { guess = 400.0, lower = 10.0, upper = 1e5 }",
                 "poisson = { guess = 0.2, lower = 0.1, upper = 0.45 }")(tiny)  # fmt: skip
    items = {
        p.name: p for p in load(tiny, f"parameters.{name}.prior={{ {prior} }}").parameters.items
    }
    assert items[name].prior == pytest.approx((items[name].prior[0], expected))


def test_parameters_may_be_numbers_ties_and_on_a_linear_scale(tiny):
    tie = "parameters.lambda_pa={ tied_to = 'mu_pa', ratio = 2.0 }"
    scale = "parameters.mu_pa={ guess = 200.0, scale = 'linear', typical = 50.0 }"
    parameters = load(tiny, tie, scale, "parameters.gamma_m_1_s=0.7").parameters
    assert [item.name for item in parameters.free] == ["mu_pa", "gamma_r_s"]
    assert parameters.guess_q[0] == pytest.approx(4.0)
    assert parameters.guesses["lambda_pa"] == pytest.approx(400.0)
    assert parameters.guesses["gamma_m_1_s"] == 0.7


def test_cleaned_samples_are_noted(tiny):
    mesh = meshio.read(tiny / "body.vtu")
    mesh.points = np.vstack([mesh.points, [9.0, 9.0, 9.0]])
    mesh.cells[0].data[0] = mesh.cells[0].data[0][[0, 1, 3, 2]]
    meshio.Mesh(mesh.points, mesh.cells).write(tiny / "body.vtu")
    notes = " ".join(load(tiny).notes)
    assert "1 of 37 nodes were dropped" in notes
    assert "1 of 72 elements had a negative volume" in notes


def test_a_surface_is_filled_once_and_kept(tiny):
    pytest.importorskip("pytetwild")
    box = box_mesh(SIZE_M, (1, 1, 1))
    meshio.Mesh(1e3 * box.points_m, [("triangle", box.surface)]).write(tiny / "scan.stl")
    surface = 'surface = "scan.stl"\nedge_length_m = 0.03\nlength_unit = "mm"'
    replace_text('mesh = "body.vtu"', surface)(tiny)
    mesh = load(tiny).bodies[0].mesh
    assert mesh.volume_m3 == pytest.approx(0.06**2 * 0.09, rel=0.05)
    assert load(tiny).bodies[0].mesh.sha256 == mesh.sha256


# Grasps -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "selection",
    [
        BOX,
        "{ ball_m = [[0.03, 0.03, 0.19], 0.11] }",
        f"{{ indices = {top_nodes().tolist()} }}",
        '{ name = "top" }',
        '"top"',
        '{ face = "top" }',
    ],
    ids=["box", "ball", "indices", "name", "bare-name", "face"],
)
def test_every_kind_of_selection_finds_its_nodes(tiny, selection):
    replace_text(BOX, selection)(tiny)
    np.testing.assert_array_equal(experiment_of(tiny).prescribed_dofs, dofs_of(top_nodes()))


def test_a_grasp_is_a_table_or_a_list_of_tables(tiny):
    one = experiment_of(tiny).grasps
    replace_text(f"grasp = {GRASP}", f"grasp = [{GRASP}]")(tiny)
    listed = experiment_of(tiny).grasps
    assert len(one) == len(listed) == 1
    np.testing.assert_array_equal(one[0].poses.positions_m, listed[0].poses.positions_m)


def test_a_second_hand_without_poses_does_not_move(tiny):
    second = "{ nodes = { box_m = [[-1, -1, -1], [1, 1, 0.001]] } }"
    replace_text(GRASP, f"[{GRASP}, {second}]")(tiny)
    experiment = experiment_of(tiny)
    assert len(experiment.prescribed_dofs) == 54
    nodes = experiment.grasps[1].nodes
    still = experiment.grasps[1].poses.moved_positions(
        experiment.body.nodes_m[nodes], experiment.t_s
    )
    np.testing.assert_allclose(still - experiment.body.nodes_m[nodes], 0.0, atol=1e-15)


def test_poses_are_interpolated_or_held_as_asked(tiny):
    assert experiment_of(tiny).grasps[0].poses.interpolation == "smooth"
    held = experiment_of(tiny, "experiment.0.grasp.interpolation=hold")
    assert held.grasps[0].poses.interpolation == "hold"


# Markers ------------------------------------------------------------------------------------------


def test_places_of_markers_without_a_reference_start_from_their_first_sample(tiny):
    replace_text(f"reference_m = {REFERENCES}", "")(tiny)
    experiment = experiment_of(tiny)
    markers, nodes_m = experiment.markers, experiment.body.nodes_m
    assert not markers.located.any()
    np.testing.assert_allclose(experiment.place_sigma_m, np.linalg.norm(SIZE_M))
    # The first pose is that of the undeformed body, and this marker is inside.
    np.testing.assert_allclose(
        markers.predict_positions(nodes_m)[1], markers.positions_m[0, 1], atol=1e-9
    )


def test_a_part_of_the_markers_may_have_a_reference(tiny):
    known = experiment_of(tiny).markers
    replace_text("mid = [0.03, 0.02, 0.03], ", "")(tiny)
    experiment = experiment_of(tiny)
    found = experiment.markers
    assert found.names == known.names
    assert found.located.tolist() == [True, False, True]
    assert (experiment.place_sigma_m > 0).tolist() == [False, True, False]
    shape, given = np.random.default_rng(0).normal(size=(36, 3)), [0, 2]
    np.testing.assert_allclose(
        found.predict_positions(shape)[given], known.predict_positions(shape)[given]
    )


def test_a_late_marker_is_placed_by_its_first_sample(tiny):
    replace_text(f"reference_m = {REFERENCES}", "")(tiny)
    for column in (1, 2, 3):
        replace_cell(MARKERS, 2, column, "")(tiny)
    experiment = experiment_of(tiny)
    markers = experiment.markers
    assert markers.missing_count.tolist() == [1, 0, 0]
    start_m = markers.predict_positions(experiment.body.nodes_m)[0]
    (turn,), (shift_m,) = experiment.grasps[0].poses.at(experiment.t_s[1:2])
    back_m = turn.T @ (markers.positions_m[1, 0] - shift_m)
    assert np.linalg.norm(start_m - back_m) < 5e-3


def test_markers_are_chosen_by_name_and_weighted_by_sigma(tiny):
    replace_text(f"reference_m = {REFERENCES}", "")(tiny)
    markers = experiment_of(
        tiny,
        'experiment.0.markers.names=["side", "low"]',
        "experiment.0.markers.sigma_m={ low = 1e-3, side = 2e-3 }",
    ).markers
    assert markers.names == ("side", "low")
    assert markers.sigma_m.tolist() == [2e-3, 1e-3]


def test_lengths_of_a_marker_file_have_a_unit(tiny):
    expected = experiment_of(tiny).markers.positions_m
    head, *rows = (tiny / MARKERS).read_text().splitlines()
    table = np.array([row.split(",") for row in rows], dtype=float) * [1.0, *[1e3] * 9]
    np.savetxt(tiny / MARKERS, table, delimiter=",", header=head, comments="")
    markers = experiment_of(tiny, "experiment.0.markers.length_unit=mm").markers
    np.testing.assert_allclose(markers.positions_m, expected, atol=1e-12)


# Time ---------------------------------------------------------------------------------------------


def test_a_window_that_exceeds_the_recording_is_noted(tiny):
    notes = load(tiny, "experiment.0.window_s=[0.0, 9.0]").notes
    assert any("window_s = [0, 9] exceeds the recording" in note for note in notes)
    notes = load(tiny, "experiment.0.window_s=[0.0, 0.06]").notes
    assert not any("exceeds" in note for note in notes)


def test_a_window_cuts_poses_and_markers(tiny):
    experiment = experiment_of(tiny, "experiment.0.window_s=[0.02, 0.06]")
    np.testing.assert_allclose(experiment.t_s, [0.02, 0.03, 0.04, 0.05, 0.06])
    whole = read_markers(tiny / MARKERS).positions_m
    np.testing.assert_array_equal(experiment.markers.positions_m, whole[2:7])
    np.testing.assert_allclose(experiment.grasps[0].poses.t_s, experiment.t_s)


def test_resampling_puts_everything_on_the_new_rate(tiny):
    problem = load(tiny, "experiment.0.resample_hz=50")
    np.testing.assert_allclose(problem.experiments[0].t_s, [0, 0.02, 0.04, 0.06, 0.08])
    assert problem.notes == ()


def test_the_error_of_resampling_is_noted_beside_the_noise(tiny):
    precise = "experiment.0.markers.sigma_m=1e-6"
    between = load(tiny, "experiment.0.resample_hz=80", precise).notes
    assert any("interpolates the markers between frames" in n for n in between)
    at_frames = load(tiny, "experiment.0.resample_hz=50", precise).notes
    assert not any("between frames" in n for n in at_frames)


def test_material_beyond_vector_code_is_noted(tiny, monkeypatch):
    def printing(F, lambda_pa, mu_pa):
        return ca.SX.printme(neo_hookean(F, lambda_pa, mu_pa), 0)

    material = replace(MATERIALS["neo-hookean"], energy=printing)
    monkeypatch.setitem(MATERIALS, "neo-hookean", material)
    (note,) = load(tiny).notes
    assert "no CasADi operation OP_PRINTME" in note


def test_resampling_above_the_measured_rate_is_noted(tiny):
    problem = load(tiny, "experiment.0.resample_hz=200")
    assert len(problem.experiments[0].t_s) == 17
    interpolated, above = problem.notes
    assert "recorded at 100 Hz, were interpolated (smooth)" in interpolated
    assert "resample_hz is above the markers' own rate" in above


def test_the_window_that_a_message_gives_cuts_a_recording_to_its_poses(tiny):
    keep_lines(POSES, 7)(tiny)
    with pytest.raises(InputError, match=r"run from 0 s to 0\.05 s") as caught:
        load(tiny)
    (window,) = re.findall(r"window_s = (\[.*\])", str(caught.value))
    problem = load(tiny, f"experiment.0.window_s={window}")
    np.testing.assert_allclose(problem.experiments[0].t_s, 0.01 * np.arange(6))
    assert problem.notes == ()


def test_poses_that_lack_one_sample_at_the_end_are_reported(tiny):
    keep_lines(POSES, 9)(tiny)
    (note,) = load(tiny).notes
    assert "the markers were cut to the time of the poses by 0.01 s at the end" in note


def test_a_grasp_that_stands_still_needs_two_poses(tiny):
    rows = (tiny / POSES).read_text().splitlines()
    last = "0.08," + rows[1].partition(",")[2]
    (tiny / POSES).write_text("\n".join([*rows[:2], last]))
    x, _ = load(tiny).experiments[0].grasps[0].poses.at([0.0, 0.04, 0.08])
    np.testing.assert_allclose(x, x[[0, 0, 0]], atol=1e-12)


@pytest.mark.parametrize("interpolation", ["linear", "hold"])
def test_sparse_poses_are_accepted_where_the_interpolation_is_stated(tiny, interpolation):
    slower(tiny, 300.0)
    keep = (tiny / POSES).read_text().splitlines()
    (tiny / POSES).write_text("\n".join([keep[0], keep[1], keep[-1]]))
    with pytest.raises(InputError, match="24 s apart"):
        load(tiny)
    load(tiny, f"experiment.0.grasp.interpolation={interpolation}")


def test_equilibria_may_have_sparse_poses_or_one(tiny):
    slower(tiny, 300.0)
    static = ["experiment.0.kind=static", "parameters.gamma_r_s=0.0", "parameters.gamma_m_1_s=0.0"]
    load(tiny, *static)
    keep_lines(POSES, 2)(tiny)
    load(tiny, *static)


def slower(folder: Path, factor: float) -> None:
    """Stretch the time of the recording and of its poses."""
    for file in (POSES, MARKERS):
        head, *rows = (folder / file).read_text().splitlines()
        cells = [row.partition(",") for row in rows]
        stretched = [f"{factor * float(t):.9g},{rest}" for t, _, rest in cells]
        (folder / file).write_text("\n".join([head, *stretched]) + "\n")


def test_poses_of_another_rate_need_no_resampling(tiny):
    expected = experiment_of(tiny)
    poses = read_poses(tiny / POSES)
    t_s = np.linspace(0.0, 0.08, 12)
    rotations, positions_m = poses.at(t_s)
    slower = PoseSequence(t_s, positions_m, Rotation.from_matrix(rotations).as_quat())
    write_poses_csv(tiny / POSES, slower)
    problem = load(tiny)
    (experiment,) = problem.experiments
    (note,) = problem.notes
    assert "recorded at 137.5 Hz, were interpolated (smooth) at the markers' times, 100 Hz" in note
    np.testing.assert_array_equal(experiment.t_s, expected.t_s)
    np.testing.assert_array_equal(experiment.markers.positions_m, expected.markers.positions_m)
    held = [prescribed_positions(e, e.t_s) for e in (experiment, expected)]
    np.testing.assert_allclose(*held, atol=1e-5)


def test_poses_of_the_gripper_carry_the_held_body(tiny):
    expected = experiment_of(tiny)
    of_body = np.eye(4)
    of_body[:3, :3] = Rotation.from_quat([0.5, -0.5, 0.5, 0.5]).as_matrix()
    of_body[:3, 3] = 0.02, -0.3, 0.1
    poses = read_poses(tiny / POSES)
    write_poses_csv(tiny / POSES, poses.after(np.linalg.inv(of_body)))  # what the gripper did
    of_gripper = "{ position_m = [0.02, -0.3, 0.1], quaternion_xyzw = [0.5, -0.5, 0.5, 0.5] }"
    found = experiment_of(tiny, f"experiment.0.grasp.gripper_to_body={of_gripper}")
    held = [prescribed_positions(e, e.t_s) for e in (found, expected)]
    np.testing.assert_allclose(*held, atol=1e-9)


def test_poses_may_be_faster_than_markers(tiny):
    poses = read_poses(tiny / POSES)
    every = experiment_of(tiny)
    head, *rows = (tiny / MARKERS).read_text().splitlines()
    write(MARKERS, "\n".join([head, *rows[::2]]))(tiny)
    experiment = experiment_of(tiny)
    np.testing.assert_allclose(experiment.t_s, poses.t_s[::2])
    assert len(experiment.grasps[0].poses.t_s) == len(poses.t_s)
    np.testing.assert_allclose(
        prescribed_positions(experiment, poses.t_s),
        prescribed_positions(every, poses.t_s),
        atol=1e-15,
    )


# Several experiments ------------------------------------------------------------------------------


def test_experiments_for_validation_are_loaded_but_not_fitted(tiny):
    text = (tiny / "problem.toml").read_text()
    added = text[text.index("[[experiment]]") :].replace('"swing"', '"again"')
    write("problem.toml", text + "\n" + added)(tiny)
    problem = load(tiny, "experiment.again.validation=true")
    assert [e.name for e in problem.experiments] == ["swing", "again"]
    collocation = Collocation(problem.experiments, problem.parameters)
    assert [s.experiment.name for s in collocation.transcriptions] == ["swing"]


# Simulation ---------------------------------------------------------------------------------------


def test_before_anything_is_measured_markers_are_sampled_at_the_poses_times(tiny):
    remove(MARKERS)(tiny)
    experiment = load(tiny, simulation=True).experiments[0]
    np.testing.assert_allclose(experiment.t_s, read_poses(tiny / POSES).t_s)
    assert experiment.markers.names == ("low", "mid", "side")
    with pytest.raises(InputError, match=r"swing_markers\.csv does not exist"):
        load(tiny)


def test_loading_writes_nothing(tiny):
    before = contents(tiny)
    load(tiny)
    assert contents(tiny) == before


# The problems that come with the project ----------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_a_shipped_problem_loads_and_its_derivatives_agree(path):
    try:
        problem = Problem.read(path, allow_code=True)
    except InputError as error:
        if "how to get it" not in str(error):
            raise
        pytest.skip(str(error))
    few = replace(problem, experiments=problem.experiments[:2], substeps=1)
    findings = check_problem(shortened_problem(few))
    assert not findings.derivative_fault
    for each in problem.experiments:
        assert (
            each.markers.is_present.any()
            or any(grasp.wrench for grasp in each.grasps)
            or each.depths
        )
    assert all(body.smallest_element_quality > 0.1 for body in findings.bodies)


# What else a recording's table may say ------------------------------------------------------------

LOADS = """
[[experiment.mass]]
nodes = { box_m = [[-1, -1, -1], [1, 1, 0.001]] }
mass_kg = 0.002
from_s = 0.03

[[experiment.force]]
nodes = "top"
force_n = [0.0, 0.1, 0.0]

[[experiment.force]]
nodes = { indices = [0] }
file = "push.csv"

[experiment.nuisance]
marker_offsets = { prior_m = 0.003 }
time_shift = { prior_s = 0.01 }
pose = { prior_rad = 0.02 }
gravity = { prior_rad = 0.03 }
hand_eye = "none"
camera_offsets = { prior_m = 0.001 }
"""


@pytest.fixture
def loaded(tiny: Path) -> Path:
    """The tiny problem with loads and nuisance parameters."""
    file = tiny / "problem.toml"
    file.write_text(file.read_text().replace('nuisance = "none"\n', "") + LOADS)
    (tiny / "push.csv").write_text("t_s,fx_n,fy_n,fz_n\n0.0,0,0,0\n0.05,0,0,0.2\n")
    return tiny


def test_masses_and_forces_are_read(loaded):
    experiment = experiment_of(loaded)
    (mass,) = experiment.masses
    assert (mass.mass_kg, mass.from_s, len(mass.nodes)) == (0.002, 0.03, 9)
    assert experiment.moving_node_mass_kg([0.0, 0.04]).sum(axis=1) == pytest.approx(
        [experiment.body.mass_kg, experiment.body.mass_kg + 0.002]
    )
    total = experiment.declared_node_forces_n([0.025]).sum(axis=1)[0]
    np.testing.assert_allclose(total, [0.0, 0.1, 0.1], atol=1e-12)


def test_nuisance_is_read(loaded):
    unknown = experiment_of(loaded).nuisance
    assert (unknown.marker_offset_m, unknown.time_shift_s) == (0.003, 0.01)
    assert (unknown.pose_turn_rad, unknown.pose_shift_m, unknown.gravity_rad) == (0.02, None, 0.03)
    assert (unknown.hand_eye_m, unknown.hand_eye_rad) == (None, None)
    assert unknown.camera_offset_m == 0.001


def test_a_grasp_may_hold_for_a_while(tiny):
    experiment = experiment_of(tiny, "experiment.swing.grasp.until_s=0.02")
    held, _ = experiment.prescribed_displacements([0.0, 0.02, 0.03])
    np.testing.assert_array_equal(held.any(axis=(1, 2)), [True, True, False])
    assert len(experiment.prescribed_dofs) == 0


def test_every_takes_only_some_samples(tiny):
    whole, some = (experiment_of(tiny), experiment_of(tiny, "experiment.swing.every=3"))
    np.testing.assert_allclose(some.t_s, whole.t_s[::3])
    np.testing.assert_array_equal(some.markers.positions_m, whole.markers.positions_m[::3])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("mass_kg = 0.002", "mass_kg = 0"), r"mass.0.mass_kg: found 0; expected a number above 0"),
        (('"top"', '"middle"'), r'force.0.nodes: .*"middle"'),
        (("[0.0, 0.1, 0.0]", "[0.0, 0.1]"), r"force.0.force_n"),
        (('file = "push.csv"', 'file = "pull.csv"'), r"force.1.file: .*pull.csv does not exist"),
        (('file = "push.csv"', ""), r"force.1: .*exactly one of force_n, file"),
        (("{ prior_rad = 0.02 }", "{}"), r"nuisance.pose: .*expected one or both"),
        (("prior_s = 0.01", "prior_ms = 10"), r"nuisance.time_shift.prior_ms"),
    ],
)
def test_loads_and_nuisance_that_are_wrong_name_their_key(loaded, change, message: str):
    replace_text(*change)(loaded)
    with pytest.raises(InputError, match=message):
        load(loaded)


def test_profiles_are_of_estimated_parameters_only(tiny):
    text = (tiny / "problem.toml").read_text() + '\n[uncertainty]\nprofile = ["young_pa"]\n'
    (tiny / "problem.toml").write_text(text)
    with pytest.raises(InputError, match=r"profile: found 'young_pa'; expected estimated par"):
        load(tiny)
