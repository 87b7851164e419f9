"""Nuisance parameters that recordings share: markers, camera, clamp."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from kit.problem_files import run_command, write_problem
from kit.problems import (
    GUESS,
    IDEAL,
    TRUTH,
    bar_with_nuisance,
    cube_with_nuisance,
    hung_cube,
    noisy,
    point_markers,
)
from kit.sharing import sharing, swung_again
from kit.wrenches import wristed_cube

from collocation_sysid.errors import InputError
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.model.parameters import Parameters
from collocation_sysid.pipeline import solve
from collocation_sysid.problem import Problem
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.program.lifted.collocation import with_lifted_variables
from collocation_sysid.recording import Experiment, Markers, Nuisance
from collocation_sysid.statistics.pose_noise import uncertainty_at

PLACES = {"marker_offset_m": "shared"}
ELASTIC = Parameters(
    tuple(replace(each, is_fixed=each.name.startswith("gamma"), prior=None) for each in GUESS.items)
)


def test_shared_parameters_are_saved():
    cube = cube_with_nuisance(4)
    shared = ("marker_offset_m", "camera_offset_m", "time_shift_s", "pose_turn_rad", "gravity_rad")
    first, second = sharing(cube, "hand_eye_m"), swung_again(cube, "second")
    third = sharing(swung_again(cube, "third"), *shared, "hand_eye_m")
    fourth = replace(bar_with_nuisance(4), nuisance=Nuisance.none(marker_offset_m=0.003))
    collocation = Collocation([first, sharing(second, *shared), fourth, third], GUESS)
    alone = Collocation([cube, second, fourth, swung_again(cube, "third")], GUESS)
    saved = [name for name in collocation.parameter_names if name.startswith("shared: ")]
    assert len(set(collocation.parameter_names)) == len(alone.parameter_names) - len(saved)
    assert collocation.nphi == alone.nphi - len(saved)


def test_tares_are_shared():
    nuisance = Nuisance(tare=10.0, sensor_lag_s=0.003, tool_kg=0.01, tool_m=0.02, gravity_rad=0.03)
    one = wristed_cube(4, nuisance)
    names = ("tare", "sensor_time_s", "sensor_lag_s", "tool_kg", "tool_m", "gravity_rad")
    pair = [sharing(each, *names) for each in (one, swung_again(one, "second"))]
    program = with_lifted_variables(Collocation(pair, GUESS))
    assert len({name for name in program.parameter_names if "tare" in name}) == 6


# Answers


def pieces(experiment: Experiment, *ends: int) -> list[Experiment]:
    """Equilibria of one recording as recordings of their own."""
    found = []
    for first, last in zip((0, *ends[:-1]), ends, strict=True):
        here, t_s = slice(first, last), experiment.t_s[first:last]
        tracks = experiment.markers.positions_m[here]
        markers = Markers(t_s, tracks, experiment.markers.sigma_m, experiment.markers.names)
        name = f"{first} to {last}"
        found.append(replace(experiment, t_s=t_s, markers=markers, name=name))
    return found


def equilibria(count: int) -> Experiment:
    """A cube that is turned to and fro, seen by markers of which nobody knows where they sit."""
    cube = hung_cube(count, kind="static", nuisance=IDEAL)
    places = np.random.default_rng(8).uniform(0.01, 0.09, size=(4, 3))
    seen = noisy(replace(cube, markers=point_markers(cube.body, places, cube.t_s)), 1e-4)
    markers = Markers(cube.t_s, seen.markers.positions_m, 1e-4)
    nuisance = Nuisance.none(gravity_rad=0.03, pose_turn_rad=0.02, pose_shift_m=0.002)
    return replace(seen, markers=markers, nuisance=nuisance)


@pytest.mark.long
@pytest.mark.parametrize("method", ["reduced-space", "interior-point"])
def test_recordings_that_share_all_are_one_recording(method: str):
    """Equilibria do not know of each other: what is cut in two is the same problem."""
    whole = equilibria(4)
    all_of_them = ("marker_offset_m", "gravity_rad", "pose_turn_rad", "pose_shift_m")
    cut = [sharing(piece, *all_of_them) for piece in pieces(whole, 2, 5)]
    one, two = (solve(Problem(each, ELASTIC), method) for each in ([whole], cut))
    assert one.status.converged
    assert two.status.converged
    np.testing.assert_allclose(two.theta, one.theta, rtol=1e-6)
    assert two.collocation.nphi == one.collocation.nphi
    (part,), parts = (each.collocation.iterates(each.z) for each in (one, two))
    for each in parts:
        np.testing.assert_allclose(each.phi, part.phi, atol=1e-5)
    bars = [uncertainty_at(each.collocation, each.z) for each in (one, two)]
    np.testing.assert_allclose(bars[1].covariance, bars[0].covariance, rtol=1e-3, atol=1e-12)


def swings(on_surface: bool) -> tuple[list[Experiment], np.ndarray]:
    """Two swings of one cube with markers that sit elsewhere than said, and where they do."""
    cube = hung_cube(14)
    given = np.array([[0.04, 0.03, 0.0], [0.0, 0.06, 0.03], [0.07, 0.1, 0.02], [0.06, 0.07, 0.0]])
    along = np.array([[1, -1, 0], [0, -1, 1], [-1, 0, 1], [-1, -1, 0]])
    really = given + 0.012 * along
    found = []
    for each in (cube, swung_again(cube, "again")):
        markers = point_markers(cube.body, really, cube.t_s)
        seen = noisy(replace(each, markers=markers), 3e-4, seed=len(found))
        track = seen.markers.positions_m, 3e-4
        markers = Markers(cube.t_s, *track, None, given, None, 0.01, on_surface)
        found.append(replace(each, markers=markers, nuisance=Nuisance(scope=PLACES)))
    return found, really


@pytest.mark.parametrize("on_surface", [pytest.param(False, marks=pytest.mark.long), True])
def test_markers_glued_once_are_found_once(on_surface: bool):
    together, really = swings(on_surface)
    solution = ReducedSpace()(Collocation(together, GUESS))
    assert solution.status.converged
    bars = uncertainty_at(solution.collocation, solution.z)
    errors = np.log(solution.theta / list(TRUTH.values()))
    assert np.abs(errors / np.sqrt(np.diag(bars.covariance))).max() < 3.5
    places = [
        part.transcription.marker_places_m(part.phi)
        for part in solution.collocation.iterates(solution.z)
    ]
    np.testing.assert_array_equal(*places)
    assert np.abs(places[0] - really).max() < 1e-3
    one, two = (
        transcription.association.markers for transcription in solution.collocation.transcriptions
    )
    np.testing.assert_array_equal(one.cells, two.cells)
    np.testing.assert_array_equal(one.axes, two.axes)


def test_places_found_once_leave_the_data_to_the_material():
    whole = equilibria(8)
    shear = Parameters(tuple(replace(p, is_fixed=p.name != "mu_pa") for p in ELASTIC.items))
    shear, spreads = shear.with_guess({"lambda_pa": TRUTH["lambda_pa"]}), []
    for scope in ({}, PLACES):
        cut = [replace(e, nuisance=Nuisance.none(scope=scope)) for e in pieces(whole, 3, 6, 9)]
        solution = ReducedSpace()(Collocation(cut, shear))
        assert solution.status.converged
        bars = uncertainty_at(solution.collocation, solution.z)
        spreads.append(float(np.sqrt(bars.covariance[0, 0])))
        assert abs(np.log(solution.theta[1] / TRUTH["mu_pa"])) < 3 * spreads[-1]
    assert spreads[1] < 0.7 * spreads[0]


def test_methods_agree_where_clamp_and_clock_are_shared():
    """Interior point's held dofs follow from φ that move the grasps of both."""
    words = dict.fromkeys(("hand_eye_rad", "hand_eye_m", "time_shift_s"), "shared")
    nuisance = Nuisance.none(gravity_rad=0.02, time_shift_s=2e-3, scope=words)
    nuisance = replace(nuisance, hand_eye_rad=0.02, hand_eye_m=1e-3)
    cube = hung_cube(6, (1, 1, 2), nuisance=nuisance)
    pair = [noisy(cube, 2e-4), noisy(swung_again(cube, "again"), 2e-4, seed=8)]
    drag = Parameters(tuple(replace(p, is_fixed=p.name == "gamma_m_1_s") for p in GUESS.items))
    first, second = (solve(Problem(pair, drag), m) for m in ("reduced-space", "interior-point"))
    assert second.status.converged
    assert second.collocation.nphi == 2 * 2 + 7
    np.testing.assert_allclose(second.theta, first.theta, rtol=1e-4)
    found = [each.collocation.parameters_from(each.z)[3:] for each in (first, second)]
    np.testing.assert_allclose(found[1], found[0], atol=1e-3)


# What cannot be shared


def test_words_make_several_groups():
    cube = replace(hung_cube(4), nuisance=Nuisance.none(gravity_rad=0.03))
    words = "shared", "shared left", "shared left", "shared", "shared right"
    made = [
        sharing(replace(cube, name=str(k)), "gravity_rad", word=word)
        for k, word in enumerate(words)
    ]
    collocation = Collocation(made, GUESS)
    places = [
        transcription.nuisance_indices.indices[0] - 4
        for transcription in collocation.transcriptions
    ]
    assert places == [0, 2, 2, 0, 4]
    assert collocation.parameter_names[4] == "shared: tilt of gravity, first [rad]"
    assert collocation.parameter_names[6] == "shared left: tilt of gravity, first [rad]"


OTHERS = {
    "body": (
        PLACES,
        lambda e: replace(hung_cube(4, (1, 1, 2)), nuisance=e.nuisance),
        "another body",
    ),
    "surface": (
        PLACES,
        lambda e: replace(e, markers=replace(e.markers, on_surface=True)),
        "another value of places",
    ),
    "prior": (
        PLACES,
        lambda e: replace(e, nuisance=replace(e.nuisance, marker_offset_m=0.004)),
        r"'hung cube', where the place of m0, x \[m\] has the prior 0.002; expected the same prior",
    ),
    "gravity": (
        {"gravity_rad": "shared"},
        lambda e: replace(e, gravity_m_s2=(0.0, -9.81, 0.0)),
        "which has another gravity",
    ),
    "grasp": (
        {"hand_eye_m": "shared"},
        lambda e: replace(e, grasps=[replace(e.grasps[0], nodes=e.grasps[0].nodes[1:])]),
        "another set of nodes in its grasps",
    ),
}


@pytest.mark.parametrize("case", OTHERS)
def test_parameters_of_different_objects_are_not_shared(case: str):
    scope, change, message = OTHERS[case]
    cube = replace(hung_cube(4), nuisance=Nuisance(marker_offset_m=0.002, scope=scope))
    other = replace(change(cube), name="other")
    with pytest.raises(InputError, match=message) as refused:
        Collocation([cube, other], GUESS)
    assert refused.value.where == "experiment 'other'"


@pytest.mark.parametrize(
    ("scope", "message"),
    [
        (
            {"places": "shared"},
            r"scope contains 'places', which is not a nuisance parameter; expected one of marker_offset_m, ",
        ),
        (
            {"tare": "mine"},
            r"the scope of tare is 'mine'; expected \"shared\", or \"shared\" followed",
        ),
    ],
)
def test_an_empty_scope_is_refused(scope, message: str):
    with pytest.raises(InputError, match=message):
        Nuisance(scope=scope)


# Problem files


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    return write_problem(tmp_path_factory.mktemp("two"), {"swing": 6, "bend": 6})


OWN = """[experiment.nuisance]
gravity = {{ scope = "{}" }}
pose = {{ prior_rad = 0.02, scope = "shared" }}
time_shift = "none"
hand_eye = "none"
[experiment.markers]"""


@pytest.fixture
def two(made, tmp_path) -> Path:
    shutil.copytree(made.parent, tmp_path, dirs_exist_ok=True)
    text = (tmp_path / "problem.toml").read_text().replace('nuisance = "none"\n', "")
    text = text.replace('"interior-point"', '"reduced-space"')
    text = text.replace("[experiment.markers]", OWN.format("shared"))
    (tmp_path / "problem.toml").write_text(text)
    return tmp_path


@pytest.mark.long
def test_a_file_shares_parameters_and_its_run_names_both(two: Path):
    done = run_command("solve", two / "problem.toml", "--out", two / "run")
    assert done.code == 0, done.err
    result = json.loads((two / "run" / "result.json").read_text())
    one, other = (result["nuisance"][name] for name in ("swing", "bend"))
    assert one == other
    assert one["turn of the pose, x [rad]"]["prior"] == 0.02
    assert one["turn of the pose, x [rad]"]["std_error"] < 0.02
    places = result["places"]
    assert places["swing"]["low"] != places["bend"]["low"]
    # Its places and the others' values are where a solve of the same file starts from.
    again = run_command("solve", two / "problem.toml", "--start", two / "run", "--out", two / "on")
    assert again.code == 0, again.err
    on = json.loads((two / "on" / "result.json").read_text())
    assert on["iterations"] < result["iterations"]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            OWN.format("shared"),
            OWN.format("mine"),
            "experiment 'bend': nuisance.gravity.scope: found 'mine'; expected \"recording\",",
        ),
        (
            'name = "bend"\n',
            'name = "bend"\ngravity_m_s2 = [0.0, -9.81, 0.0]\n',
            "experiment 'bend': gravity is shared with 'swing', which has another gravity; ",
        ),
        (
            "pose = { prior_rad = 0.02, scope",
            "pose = { scope",
            "nuisance.pose: found no prior_rad and no prior_m; expected one or both",
        ),
    ],
)
def test_a_file_that_shares_unshareable_keys_is_refused(two: Path, old, new, message: str):
    head, _, tail = (two / "problem.toml").read_text().rpartition(old)
    (two / "problem.toml").write_text(head + new + tail)
    done = run_command("solve", two / "problem.toml")
    assert done.code == 2
    assert message in " ".join(done.err.split())
    assert "problem.toml" in done.err
    assert not (two / "runs").exists()
