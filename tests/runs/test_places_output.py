"""Estimated marker positions in records, pictures, pages and the terminal."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from kit.problem_files import (
    AT_TRUTH,
    REFERENCES,
    replace_text,
    run_command,
    settings,
    write_problem,
)
from matplotlib.legend import Legend

import collocation_sysid as cs
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.methods.starts.initial_trajectories import initial_variables
from collocation_sysid.result.pictures.meshes import mesh_picture
from collocation_sysid.result.replay import read_run
from collocation_sysid.runs.warm_start import WarmStart
from collocation_sysid.statistics.pose_noise import uncertainty_at
from collocation_sysid.statistics.uncertainty import MarkerPlace, marker_places

PLACES_M = {"low": [0.0, 0.0, 0.0], "mid": [0.03, 0.02, 0.03], "side": [0.06, 0.06, 0.03]}
# One as it is, one 4 mm off, one not given.
GIVEN = "{ low = [0.0, 0.0, 0.0], mid = [0.03, 0.024, 0.03] }"
OPTIONS = settings(
    "experiment.swing.markers.sigma_m=1e-4",
    "experiment.swing.nuisance={ marker_offsets = { prior_m = 0.003 } }",
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny problem with exact data; what was solved is in "run"."""
    place = tmp_path_factory.mktemp("placed")
    file = write_problem(place, {"swing": 24})
    replace_text(REFERENCES, GIVEN)(place)
    command = ("solve", file, "--method", "reduced-space", *OPTIONS)
    outcome = run_command(*command, "--details", "--out", place / "run")
    assert outcome.code == 0, outcome.err
    (place / "printed.txt").write_text(outcome.out)
    return place


@pytest.fixture(scope="module")
def result(folder: Path) -> dict:
    return json.loads((folder / "run" / "result.json").read_text())


def test_the_record_has_places_with_errors_that_hold(result: dict):
    places = result["places"]["swing"]
    assert list(places) == [*PLACES_M]
    for name, truth in PLACES_M.items():
        errors_m = np.array(places[name]["std_error_m"])
        off_m = np.array(places[name]["position_m"]) - truth
        assert (errors_m > 0).all()
        assert (errors_m < 2e-3).all()
        assert (np.abs(off_m) < 3 * errors_m).all()


def test_the_record_states_the_known_values(result: dict):
    places = result["places"]["swing"]
    assert {name: place["is_declared"] for name, place in places.items()} == {
        "low": True, "mid": True, "side": False,
    }  # fmt: skip
    body_m = float(np.linalg.norm([0.06, 0.06, 0.09]))
    priors = [place["prior_m"] for place in places.values()]
    assert priors == pytest.approx([0.003, 0.003, body_m])
    assert not [name for name in result["nuisance"]["swing"] if "place" in name]
    assert "time shift [s]" in result["nuisance"]["swing"]


def test_exact_places_have_no_error(folder: Path):
    exact = settings(
        "experiment.swing.nuisance='none'",
        'experiment.swing.markers.names=["low"]',
        "experiment.swing.markers.reference_m={ low = [0.0, 0.0, 0.0] }",
    )[1::2]
    place = places_at_the_guess(folder, tuple(exact))["low"]
    assert (place.prior_m, place.is_declared) == (0.0, True)
    assert place.std_error_m is not None
    assert not place.std_error_m.any()
    assert place.displacement_m == 0.0


def test_errors_on_the_surface_lie_in_its_face(folder: Path):
    """All faces of the body are square to an axis."""
    places = places_at_the_guess(
        folder, (*OPTIONS[1::2], "experiment.swing.markers.places='surface'")
    )
    for place in places.values():
        assert place.std_error_m is not None
        across = int(place.std_error_m.argmin())
        assert place.std_error_m[across] == pytest.approx(0.0, abs=1e-12)
        assert (np.delete(place.std_error_m, across) > 1e-5).all()


def places_at_the_guess(folder: Path, overrides: tuple[str, ...]) -> dict[str, MarkerPlace]:
    """Places and errors that a solve from the truth would begin with."""
    problem = cs.Problem.read(folder / "problem.toml", [*AT_TRUTH, *overrides])
    collocation = problem.collocation()
    z, _ = initial_variables(collocation)
    (part,) = collocation.iterates(z)
    return marker_places(part, uncertainty_at(collocation, z))


def test_a_later_solve_starts_from_the_places_found(folder: Path, result: dict):
    earlier = WarmStart.read(folder / "run")
    problem = earlier.apply_to_problem(cs.Problem.read(folder / "problem.toml", OPTIONS[1::2]))
    collocation = earlier.apply_to_places(problem.collocation())
    (transcription,) = collocation.transcriptions
    found = [place["position_m"] for place in result["places"]["swing"].values()]
    assert transcription.marker_places_m(transcription.guess_phi) == pytest.approx(
        np.array(found), abs=1e-9
    )
    z = earlier.start(collocation).variables
    assert z is not None
    again = cs.solve(problem, "reduced-space", start=folder / "run")
    assert again.status.converged
    assert again.iterations < 4


def test_places_travel_to_another_mesh(folder: Path):
    """Positions on the body are of no mesh: a marker is found in another element."""
    mesh = box_mesh((0.06, 0.06, 0.09), (3, 3, 4))
    cs.TetMesh(mesh.points_m, mesh.tetrahedra).write(folder / "finer.vtu")
    other = settings("object.mesh='finer.vtu'")
    earlier = WarmStart.read(folder / "run")
    problem = earlier.apply_to_problem(
        cs.Problem.read(folder / "problem.toml", [*OPTIONS, *other][1::2])
    )
    (transcription,) = earlier.apply_to_places(problem.collocation()).transcriptions
    places_m = transcription.marker_places_m(transcription.guess_phi)
    for m, name in enumerate(transcription.experiment.markers.names):
        assert places_m[m] == pytest.approx(earlier.places_m["swing"][name], abs=1e-9)
        of_nodes, reading = transcription.markers.observable.shape_functions(
            transcription.guess_phi
        )
        there = reading.weights[m] @ transcription.body.nodes_m[of_nodes[m]]
        assert there == pytest.approx(places_m[m], abs=1e-9)


def test_a_record_without_places_is_no_start(folder: Path, tmp_path: Path, result: dict):
    broken = {**result, "places": {"swing": {"low": {"position_m": [1.0, 2.0]}}}}
    (tmp_path / "result.json").write_text(json.dumps(broken))
    with pytest.raises(cs.InputError, match="damaged"):
        WarmStart.read(tmp_path)


# Shown


def test_the_terminal_shows_marker_places_and_priors(folder: Path):
    said = " ".join((folder / "printed.txt").read_text().split())
    moved = re.search(r"stated positions: up to ([\d.]+) mm \(mid; prior ±3 mm\)", said)
    assert moved is not None
    assert float(moved[1]) == pytest.approx(4.0, abs=0.2)
    assert re.search(r"positions of 1 marker, estimated to ±[\d.]+ mm \(prior ±124 mm\)", said)
    assert re.search(r"tilt of gravity: [\d.e-]+° \(prior ±1°\)", said)
    assert re.search(r"rotation of the body in the gripper: [\d.e-]+° \(prior ±0.5°\)", said)
    assert re.search(r"measured [\d.e-]+ ms (later|earlier) than stated \(prior ±5 ms\)", said)


def test_the_page_has_places_and_nuisance_parameters_in_their_units(folder: Path):
    page = folder / "page.html"
    assert run_command("report", folder / "run", "--to", page).code == 0
    text = page.read_text()
    assert "Positions of the markers of &#39;swing&#39;" in text or "markers of 'swing'" in text
    assert "not given" in text
    assert ">3 mm<" in text
    assert ">5 ms<" in text
    assert ">1°<" in text
    assert "[rad]" not in text.partition("Pictures")[0]


def test_pictures_contain_given_and_estimated_values(folder: Path):
    _, (seen,) = read_run(folder / "run")
    assert np.isnan(seen.declared_places_m).any(axis=1).tolist() == [False, False, True]
    assert seen.marker_places_m[1] == pytest.approx(PLACES_M["mid"], abs=1e-3)
    assert seen.declared_places_m[1] == pytest.approx([0.03, 0.024, 0.03], abs=1e-9)
    assert legend_of(seen.marker_places_m, seen.declared_places_m, seen) >= {
        "position not given", "position given",
    }  # fmt: skip
    same = legend_of(seen.marker_places_m, seen.marker_places_m, seen)
    assert not same & {"position not given", "position given"}


def legend_of(places_m: np.ndarray, given_m: np.ndarray, seen) -> set[str]:
    figure = mesh_picture(replace(seen, marker_places_m=places_m, declared_places_m=given_m))
    keys = [child for child in figure.axes[0].get_children() if isinstance(child, Legend)]
    return {text.get_text() for each in keys for text in each.get_texts()}


def test_a_place_that_was_not_given_has_not_moved():
    place = MarkerPlace(np.zeros(3), None, 0.1, None)
    assert (place.is_declared, place.displacement_m) == (False, None)
