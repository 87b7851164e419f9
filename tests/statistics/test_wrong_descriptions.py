"""Wrong descriptions of known kinds are recognised, and correct ones are not accused."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from kit import misdescribed as wrong
from kit.problem_files import both, replace_text, run_command
from kit.problems import GUESS, TRUTH, box, released_cube
from kit.rods import bent, cable, clamped
from twins import BODIES, SOFT, STIFF, twin
from wrong_obstacles import POKING_FAULTS
from wrong_twins import FAULTS, TRACK_FAULTS, Fault, late, reordered

from collocation_sysid.errors import InputError
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.meshes.mesh import TetMesh
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.judge import engine
from collocation_sysid.judge.engine import find_misspecifications
from collocation_sysid.judge.modes import find_misspecifications_by_modes
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.pipeline import run, solve
from collocation_sysid.problem import Problem
from collocation_sysid.program.simulation import simulate, with_markers
from collocation_sysid.recording import Experiment, Grasp, PoseSequence, read_poses
from collocation_sysid.runs.check import misspecification_hypotheses
from collocation_sysid.runs.check.body import check_grasps, grasp_concerns
from collocation_sysid.runs.facts import facts
from collocation_sysid.statistics.assessment import cause_concerns
from collocation_sysid.statistics.plausibility import (
    material_hypothesis,
    size_and_density_hypotheses,
)

BEFORE = [
    "poses in mm",
    "poses in km",
    "markers in mm",
    "markers in km",
    "poses inverted",
    "wxyz as xyzw",
    "xyzw as wxyz",
    "gripper's frame",
    "mesh's frame",
    "cameras' frame",
    "markers exchanged",
]
# These are small beside what an unknown stiffness may do: the fit tells them.
AFTER = ["gravity", "grasp one layer deeper"]


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(3)


def soft(name: str, seed: int = 1) -> Problem:
    return _twin(name, "soft", seed)


@cache
def _twin(name: str, kind: str, seed: int) -> Problem:
    return twin(name, {"soft": SOFT, "stiff": STIFF}[kind], seed)


# Before solving -----------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("name", BODIES)
@pytest.mark.parametrize(("kind", "seed"), [("soft", 1), ("stiff", 0)])
def test_a_right_description_is_not_doubted(name: str, kind: str, seed: int):
    assert misspecification_hypotheses(_twin(name, kind, seed)) == ()


@pytest.mark.long
@pytest.mark.parametrize("name", BODIES)
@pytest.mark.parametrize("fault", BEFORE)
def test_a_wrong_description_is_named_before_solving(name: str, fault: str, rng):
    causes = misspecification_hypotheses(FAULTS[fault](soft(name), rng))
    assert causes, fault
    assert causes[0].cause in FAULTS[fault].causes
    assert causes[0].strength > 2


BODY_IN_GRIPPER = np.array(
    [[1.0, 0.0, 0.0, -0.03], [0.0, 0.0, 1.0, 0.02], [0.0, -1.0, 0.0, 0.12], [0.0, 0.0, 0.0, 1.0]]
)


def gripped(problem: Problem, reading: Callable[[PoseSequence], PoseSequence]):
    """Return the problem with markers without stated places, and with poses that are those of a
    gripper, changed by `reading`, followed by the constant pose of the body in the gripper."""
    (experiment,) = problem.experiments
    (grasp,) = experiment.grasps
    of_gripper = grasp.poses.after(np.linalg.inv(BODY_IN_GRIPPER))
    of_file = PoseSequence(
        of_gripper.t_s, of_gripper.positions_m, quaternions_xyzw=of_gripper.quaternions_xyzw
    )
    poses = reading(of_file).after(BODY_IN_GRIPPER)
    markers = replace(experiment.markers, placement=None, located=None, places_m=None)
    changed = replace(experiment, grasps=[Grasp(grasp.nodes, poses)], markers=markers)
    return replace(problem, experiments=[changed])


@pytest.mark.parametrize(("name", "turn"), [*zip(BODIES, [1, -1], strict=True)])
def test_a_quaternion_order_is_named_behind_a_gripper_and_without_places(name: str, turn: int):
    """Wrong poses place the markers at wrong points of the body, unless their places are stated."""
    wrong = gripped(soft(name), reordered(turn))
    causes = misspecification_hypotheses(wrong)
    assert causes[0].cause == "quaternion-order"
    assert causes[0].strength > 2


@pytest.mark.parametrize(("turn", "order"), [(1, "wxyz"), (-1, "xyzw")])
def test_columns_named_as_advised_are_read(turn: int, order: str, tmp_path: Path):
    causes = misspecification_hypotheses(gripped(soft("block"), reordered(turn)))
    columns = re.findall(r"name their columns (.*?), in this order", causes[0].message)[0]
    values = {"w": 0.8, "x": 0.0, "y": 0.6, "z": 0.0}
    names = ",".join(columns.split(", "))
    path = tmp_path / "poses.csv"
    path.write_text(f"t_s,x_m,y_m,z_m,{names}\n0,0,0,0,{','.join(str(values[k]) for k in order)}\n")
    np.testing.assert_allclose(read_poses(path).quaternions_xyzw, [[0.0, 0.6, 0.0, 0.8]])
    assert f'grasp.quaternion = "{order}" if they are numbered' in causes[0].message


@pytest.mark.parametrize(("name", "seed"), [*zip(BODIES, [1, 2], strict=True)])
def test_poses_of_a_gripper_without_stated_places_are_not_doubted(name: str, seed: int):
    right = gripped(soft(name, seed), lambda poses: poses)
    assert misspecification_hypotheses(right) == ()


@pytest.mark.parametrize("name", BODIES)
@pytest.mark.parametrize("fault", [name for name, each in TRACK_FAULTS.items() if each.causes])
def test_tracks_that_no_grasped_body_has_are_named_before_solving(name: str, fault: str, rng):
    causes = misspecification_hypotheses(TRACK_FAULTS[fault](soft(name), rng))
    assert causes, fault
    assert causes[0].cause in TRACK_FAULTS[fault].causes


def test_the_order_and_signs_of_the_tracks_axes_are_stated(rng):
    exchanged = TRACK_FAULTS["markers: y and z exchanged"](soft("block"), rng)
    assert (
        "fit with (x, z, y) in place of (x, y, z)"
        in misspecification_hypotheses(exchanged)[0].message
    )


@pytest.mark.long
def test_a_body_released_undeformed_in_a_still_grasp_may_swing():
    tracks = simulate(released_cube(20), TRUTH, "newmark").markers_m
    given = Problem([with_markers(released_cube(20), tracks)], GUESS)
    assert misspecification_hypotheses(given) == ()


@pytest.mark.long
def test_an_unstable_simulation_is_doubtful(rng):
    reset = TRACK_FAULTS["simulation reset after NaN"](soft("bar"), rng)
    answer = run(reset)
    assert answer.trust.verdict == "doubtful"


# Obstacles ----------------------------------------------------------------------------------------


def shipped(name: str) -> Problem:
    return Problem.read(Path(__file__).parents[2] / "problems" / name / "problem.toml")


@pytest.mark.parametrize("name", ["laid_block", "poked_block"])
def test_obstacles_that_are_right_are_not_doubted(name: str):
    assert misspecification_hypotheses(shipped(name)) == ()


@pytest.mark.parametrize("zero", ["z", ""])
def test_the_load_of_an_indentation_that_pulls_is_named(zero: str, rng):
    """Whether the tip moves by a displacement or by poses."""
    given = shipped("poked_block")
    right = replace(given, experiments=[with_zero(given.experiments[0], zero)])
    assert misspecification_hypotheses(right) == ()
    wrong = POKING_FAULTS["obstacle: load reversed"](right, rng)
    cause, *_ = misspecification_hypotheses(wrong)
    assert cause.cause == "sign"
    assert cause_concerns([cause])[0].grade == "doubtful"


def with_zero(experiment: Experiment, zero: str) -> Experiment:
    return experiment.with_obstacles([replace(each, zero=zero) for each in experiment.obstacles])


@pytest.mark.long
@pytest.mark.parametrize("name", BODIES)
def test_a_late_clock_comes_with_its_lag_and_sign(name: str, rng):
    for fault, said in (("clock 100 ms late", "late"), ("clock 30 ms early", "early")):
        (first, *_) = misspecification_hypotheses(FAULTS[fault](_twin(name, "stiff", 1), rng))
        assert first.cause == "clock"
        assert f"{said} by about {fault.split()[1]} ms" in first.message


def test_the_sentence_names_size_and_key(rng):
    (first, *_) = misspecification_hypotheses(FAULTS["poses in mm"](soft("block"), rng))
    assert "0.001 times as large" in first.message
    assert 'grasp.length_unit = "mm"' in first.message


# Names that are exchanged ------------------------------------------------------------------------


def test_markers_that_a_fit_puts_at_places_of_each_other_are_named():
    given = soft("block")
    cycle = (0, 1, 2)
    (experiment,) = given.experiments
    order = np.arange(len(experiment.markers.names))
    order[[*cycle]] = [2, 0, 1]
    tracks_m = experiment.markers.positions_m[:, order]
    solution = solve(replace(given, experiments=[with_markers(experiment, tracks_m)]))
    (found,) = find_misspecifications(solution)
    assert found.cause == "markers-exchanged"
    names = np.array(experiment.markers.names)
    pairs = [f"{names[k]} is {names[order[k]]}" for k in cycle]
    assert found.data["names"] == ", ".join(pairs)
    assert not find_misspecifications(solve(given))


@pytest.mark.long
def test_the_search_for_causes_is_bounded_by_the_time_of_the_fit(monkeypatch, rng):
    solution, sweeps = solve(FAULTS["grasp one layer deeper"](soft("block"), rng)), []

    class Counted(ReducedSpace):
        def __call__(self, *given, **options):
            found = super().__call__(*given, **options)
            sweeps.append(found.iterations)
            return found

    monkeypatch.setattr(engine, "ReducedSpace", Counted)
    monkeypatch.setattr(engine, "find_misspecifications_by_modes", lambda *_, **__: ())
    assert find_misspecifications(solution)[0].cause == "grasp-layer"
    assert len(sweeps) > 1
    assert max(sweeps) <= max(15, solution.iterations) + 2  # simulations count when they are done
    assert sum(sweeps) <= max(3 * 15, solution.iterations) + 2


# Sizes and densities ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("edge_m", "density_kg_m3", "expected"),
    [
        (0.1, 30.0, []),
        (60.0, 1100.0, ["length-unit"]),
        (2e-5, 1100.0, ["length-unit"]),
        (0.1, 1.1, ["density"]),
        (0.1, 1.1e6, ["density"]),
        (60.0, 1.1, ["length-unit", "density"]),
    ],
)
def test_odd_sizes_and_densities_are_reported(edge_m, density_kg_m3, expected):
    body = Body(box_mesh((edge_m,) * 3, (1, 1, 1)), density_kg_m3=density_kg_m3)
    assert [oddity.cause for oddity in size_and_density_hypotheses(body)] == expected


def test_an_implausible_size_is_reported_with_its_key():
    generated = box_mesh((60.0,) * 3, (1, 1, 1))
    read = TetMesh(generated.points_m, generated.tetrahedra)
    for mesh, words in (
        (generated, "check its lengths, which"),
        (read, "check object.length_unit, "),
    ):
        (oddity,) = size_and_density_hypotheses(Body(mesh, density_kg_m3=1100.0))
        assert words in oddity.message


def test_a_weighed_body_whose_mesh_is_in_millimetres_has_the_unit_of_the_mesh_as_remedy():
    """Not another density, which would be as implausible."""
    mesh = box_mesh((30.0, 30.0, 120.0), (1, 1, 2))
    read = TetMesh(mesh.points_m, mesh.tetrahedra)
    with pytest.raises(InputError, match=r'rather object\.length_unit, likely "mm"') as caught:
        size_and_density_hypotheses(Body(read, mass_kg=0.1134))
    assert "g/cm³" not in caught.value.message
    with pytest.raises(InputError, match="masses are in kg"):
        size_and_density_hypotheses(Body(box_mesh((0.1, 0.1, 0.1), (1, 1, 1)), mass_kg=1e-9))
    with pytest.raises(InputError, match=r"probably 30 kg/m³, if the value is in g/cm³"):
        size_and_density_hypotheses(Body(box_mesh((0.1, 0.1, 0.1), (1, 1, 1)), density_kg_m3=0.03))


def test_a_metal_as_soft_as_rubber_is_odd():
    theta = {"young_pa": 5e5, "poisson": 0.4, "gamma_r_s": 0.01, "gamma_m_1_s": 0.0}

    def found(density_kg_m3: float, young_pa: float) -> str | None:
        body = Body(box_mesh((0.1,) * 3, (1, 1, 1)), density_kg_m3=density_kg_m3)
        odd = material_hypothesis(body, body.theta_from_values(theta | {"young_pa": young_pa}))
        return odd and odd.message

    assert found(1100.0, 5e5) is None
    assert found(7850.0, 2e11) is None
    assert "if the mass was stated in g" in (found(2e4, 5e5) or "")


@pytest.mark.parametrize(("edge_m", "density_kg_m3"), [(2e3, 1e3), (0.1, 0.03), (0.1, 1e7)])
def test_impossible_sizes_and_densities_are_refused(edge_m, density_kg_m3):
    body = Body(box_mesh((edge_m,) * 3, (1, 1, 1)), density_kg_m3=density_kg_m3)
    with pytest.raises(InputError, match="expected"):
        size_and_density_hypotheses(body)


@pytest.mark.parametrize("fault", ["density in g/cm3", "mass in g", "mesh in mm"])
def test_likely_mistakes_come_first(fault, rng):
    heavy = Body(box_mesh(*BODIES["block"]), density_kg_m3=1000.0)
    given = soft("block")
    silicone = replace(given, experiments=[replace(given.experiments[0], body=heavy)])
    wrong = FAULTS[fault](silicone, rng)
    first = facts(wrong)[0]
    assert first.code.split("/")[1] in FAULTS[fault].causes
    assert any(each in first.message for each in ("expected 10 to", "expected 0.0001"))


# The nodes of a grasp -----------------------------------------------------------------------------


def held_of(points_m: np.ndarray, below_m: float) -> Problem:
    experiment = soft("block").experiments[0]
    mesh = replace_points(experiment.body, points_m)
    nodes = np.flatnonzero(mesh.nodes_m[:, 2] > below_m)
    return replace(experiment, body=mesh, grasps=[Grasp(nodes, experiment.grasps[0].poses)])


def replace_points(body: Body, points_m: np.ndarray) -> Body:
    return Body(type(body.mesh)(points_m, body.mesh.tetrahedra), density_kg_m3=30.0)


def test_a_layer_is_held_for_sure():
    (hold,) = check_grasps(soft("block").experiments[0], 0.03)
    assert (hold.nodes, hold.nearly_grasped, hold.nearly_free) == (9, 0, 0)
    assert hold.share == pytest.approx(9 / 36)
    assert grasp_concerns(hold) == []


def test_nodes_at_the_edge_of_the_box_are_warned_of():
    points_m = np.array(box(*BODIES["block"]).mesh.points_m)
    top = np.flatnonzero(points_m[:, 2] > 0.089)
    points_m[top[:3], 2] -= 6e-4
    missed = held_of(points_m, 0.0895)
    (hold,) = check_grasps(missed, 0.03)
    assert (hold.nodes, hold.nearly_grasped) == (6, 3)
    assert "enlarged by a tenth of an element's edge" in grasp_concerns(hold)[0].message


# After solving ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", BODIES)
def test_a_good_fit_has_no_cause(name: str):
    assert find_misspecifications(solve(soft(name))) == ()


@pytest.mark.long
def test_a_clock_that_is_estimated_is_reported(rng):
    reasons = run(FAULTS["clock 20 ms late"](soft("bar"), rng)).trust.reasons
    assert any("time shift" in said and "ms)" in said for said in reasons), reasons
    # Two standard deviations of the prior contradict nothing.
    within = Fault(late(0.01), ())
    reasons = run(within(soft("bar"), rng)).trust.reasons
    assert not any("time shift" in said for said in reasons), reasons


@pytest.mark.long
@pytest.mark.parametrize("fault", AFTER)
def test_a_wrong_description_is_named_after_solving(fault: str, rng):
    causes = find_misspecifications(solve(FAULTS[fault](soft("bar"), rng)))
    assert causes, fault
    assert causes[0].cause in FAULTS[fault].causes
    assert causes[0].strength > 1.5


# On the command line ------------------------------------------------------------------------------


def test_check_does_not_call_a_doubtful_problem_valid(tiny: Path):
    late = 'start = "equilibrium"\ngravity_m_s2 = [0.0, 0.0, -9.81]\n'
    replace_text('name = "swing"\n', f'name = "swing"\n{late}')(tiny)
    low, mid = "low = [0.0, 0.0, 0.0]", "mid = [0.03, 0.02, 0.03]"
    both(replace_text(low, "LOW"), replace_text(mid, mid.replace("mid", "low")))(tiny)
    replace_text("LOW", low.replace("low", "mid"))(tiny)
    outcome = run_command("check", "problem.toml")
    assert outcome.code == 1
    flat = " ".join(outcome.out.split())
    assert "The problem is valid" not in flat
    assert "looks wrong: 'swing': the names of markers are exchanged" in flat
    assert "grasp 9 nodes, 25% of all" in flat


def test_a_refusal_names_the_likeliest_cause(tiny: Path):
    file = tiny / "swing_motion.csv"
    rows = file.read_text().splitlines()
    moved = [rows[0]]
    for row in rows[1:]:
        cells = row.split(",")
        cells[1:4] = [str(1e3 * (float(x) + 0.5)) for x in cells[1:4]]
        moved.append(",".join(cells))
    file.write_text("\n".join(moved) + "\n")
    tracks = tiny / "swing_markers.csv"
    rows = tracks.read_text().splitlines()
    shifted = [rows[0]]
    for row in rows[1:]:
        t, *cells = row.split(",")
        shifted.append(",".join([t, *(str(float(x) + 0.5) for x in cells)]))
    tracks.write_text("\n".join(shifted) + "\n")
    outcome = run_command("check", "problem.toml")
    assert outcome.code == 2
    said = " ".join(outcome.err.split())
    assert "from the pose of the grasp" in said
    assert "likely 'swing': the poses would fit if they were 0.001 times as large" in said


def test_no_linear_mode_of_a_cable_contradicts_its_description():
    """The right one was said to have the axes of its markers exchanged."""
    (experiment,) = wrong.cable_with_marker_at(0.3).experiments
    constants = {"bending_n_m2": 1e-3, "torsion_n_m2": 3e-4, "axial_n": 200.0}
    constants |= {"gamma_r_s": 2e-3, "gamma_m_1_s": 0.3}
    assert find_misspecifications_by_modes(experiment, constants) == ()


def test_no_section_of_a_rod_is_held_by_chance():
    body = cable(bent())
    held = clamped(body, grasps=[Grasp(np.arange(6), PoseSequence.fixed())])
    (found,) = check_grasps(held, 0.05)
    assert grasp_concerns(found) == []
