"""The catalogue of identified materials: page and JSON file agree, and entries are complete."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import make_catalogue
import numpy as np
import pytest
from catalogue import Catalogue, CatalogueEntry, catalogue_page
from catalogue_sources import SOURCES

from collocation_sysid.fem.body import Body
from collocation_sysid.fem.laws.constants import unit_of
from collocation_sysid.fem.meshes.mesh import TetMesh
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.recording import Experiment, Grasp, Markers
from collocation_sysid.result.replay import MotionRecord

ROOT = Path(__file__).parents[2]
VERDICTS = ("good", "check", "doubtful")
LICENCES = {"MIT", "CC BY 4.0", "GPL-3.0"}
ENTRIES = make_catalogue.read_catalogue().entries


@pytest.fixture(scope="module")
def catalogue() -> Catalogue:
    return make_catalogue.read_catalogue()


def test_the_page_is_that_of_the_json_file(catalogue):
    page = (ROOT / "docs" / "catalogue.md").read_text(encoding="utf-8")
    assert page == catalogue_page(catalogue)
    assert len(ENTRIES) > 8


def test_a_changed_value_changes_the_page(catalogue):
    first = catalogue.entries[0]
    constants = [replace(each, value=1.5 * each.value) for each in first.constants]
    changed = replace(first, constants=tuple(constants))
    assert catalogue_page(replace(catalogue, entries=(changed,))) != catalogue_page(
        replace(catalogue, entries=(first,))
    )


def test_every_problem_of_the_catalogue_has_an_entry_or_a_reason(catalogue):
    listed = [each.name for each in (*catalogue.entries, *catalogue.omitted)]
    assert sorted(listed) == sorted(source.name for source in SOURCES)
    assert all(source.problem_file.is_file() for source in SOURCES)
    assert all(each.reason for each in catalogue.omitted)


@pytest.mark.parametrize("entry", ENTRIES, ids=lambda each: each.name)
def test_an_entry_names_law_unit_interval_source_and_licence(entry: CatalogueEntry):
    assert entry.law
    assert all(entry.law)
    assert len(entry.source) > 5
    assert entry.licence in LICENCES
    assert entry.verdict in VERDICTS
    assert bool(entry.reasons) == (entry.verdict != "good")
    assert entry.recordings
    for constant in entry.constants:
        assert constant.unit == (unit_of(constant.name) or "1")
        if constant.combined95 is None:
            assert constant.is_stated or constant.reason, constant.name
        else:
            low, high = constant.combined95
            assert low <= constant.value <= high
    assert any(each.combined95 is not None for each in entry.constants)
    stretch = entry.stretch
    assert 0 < stretch.minimum <= stretch.low <= stretch.high <= stretch.maximum
    if entry.strain_rate_1_s is not None:
        assert 0 < entry.strain_rate_1_s.high <= entry.strain_rate_1_s.maximum


@pytest.mark.parametrize(
    "entry", [each for each in ENTRIES if not each.is_measured], ids=lambda each: each.name
)
def test_the_intervals_of_a_twin_contain_its_true_constants(entry: CatalogueEntry):
    known = [each for each in entry.constants if each.true_value and each.combined95]
    assert known
    for constant in known:
        low, high = constant.combined95 or (0.0, 0.0)
        assert low < (constant.true_value or 0.0) < high, constant.name


def test_the_licences_are_those_of_the_page_on_licences():
    page = (ROOT / "docs" / "licences.md").read_text(encoding="utf-8")
    for source in SOURCES:
        folder = str(Path(source.problem).parent)
        row = next((line for line in page.splitlines() if f"(`{folder}`)" in line), "")
        if row:
            assert source.licence in row
        else:
            assert source.licence == "MIT"
            assert folder.startswith("collocation_sysid/datasets") or source.twin_script


# Ranges -------------------------------------------------------------------------------------------


def record_of(body: Body, t_s: np.ndarray, positions_m: np.ndarray) -> MotionRecord:
    """A record of a prescribed motion of the nodes."""
    wall = Grasp([0, 1, 2], np.tile(np.eye(4), (len(t_s), 1, 1)))
    tracks_m = positions_m[:, :1]
    markers = Markers(t_s, tracks_m, sigma_m=1e-3, places_m=body.nodes.points_m[:1])
    experiment = Experiment(body, t_s, [wall], markers, name="motion", kind="static")
    return MotionRecord.from_experiment(experiment, (positions_m, tracks_m))


@pytest.mark.parametrize("element", ["tet4", "tet10"])
def test_ranges_of_a_homogeneous_motion(element):
    """A stretch of 1 + t along x and shrinking across, rotated more and more."""
    body = Body(box_mesh((1.0, 2.0, 3.0), (1, 2, 1)), density_kg_m3=1.0, element=element)
    t_s = np.array([0.0, 0.1, 0.2, 0.3])
    gradients = []
    for now_s in t_s:
        cosine = np.cos(5 * now_s)
        sine = np.sin(5 * now_s)
        rotation = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
        gradients.append(rotation @ np.diag([1 + now_s, 1.0, 1 - now_s / 2]))
    positions_m = np.einsum("tij,nj->tni", gradients, body.nodes.points_m)
    records = [record_of(body, t_s, positions_m)]
    stretch = make_catalogue.stretch_range({"motion": body}, records)
    assert (stretch.minimum, stretch.maximum) == pytest.approx((0.85, 1.3))
    assert (stretch.low, stretch.high) == pytest.approx((0.85, 1.3))
    rate = make_catalogue.rate_range({"motion": body}, records)
    # E_xx = ((1 + t)² − 1)/2: its differences over 0.1 s are 1 + t at the middle of each interval.
    assert rate.maximum == pytest.approx(1.25)
    assert rate.minimum == pytest.approx(1.05)


def test_quantiles_are_weighted_by_volume():
    """One of two regions has 1 % of the volume: its stretch is an extreme, not a quantile."""
    mesh = box_mesh((1.0, 1.0, 1.0), (2, 1, 1))
    points_m = mesh.points_m.copy()
    points_m[:, 0] = np.where(np.isclose(points_m[:, 0], 0.5), 0.01, points_m[:, 0])
    body = Body(TetMesh(points_m, mesh.tetrahedra), density_kg_m3=1.0)
    x = points_m[:, 0]
    moved = points_m.copy()
    moved[:, 0] = np.where(x > 0.005, x + 0.005, x)
    record = record_of(body, np.array([0.0]), moved[None])
    stretch = make_catalogue.stretch_range({"motion": body}, [record])
    assert stretch.maximum == pytest.approx(1.5)
    assert stretch.high == pytest.approx(1.0)


def test_positions_of_another_mesh_are_refused():
    body = Body(box_mesh((1.0, 1.0, 1.0), (1, 1, 1)), density_kg_m3=1.0)
    with pytest.raises(ValueError, match="found positions of 3 nodes; expected 8"):
        make_catalogue.deformation_gradients(body, np.zeros((1, 3, 3)))


# Entries ------------------------------------------------------------------------------------------


def test_a_problem_without_its_data_is_omitted_with_the_reason(tmp_path, monkeypatch):
    monkeypatch.setattr(make_catalogue, "RUNS", tmp_path)
    (source,) = (each for each in SOURCES if each.name == "twin_wrist_sensor")
    text = source.problem_file.read_text(encoding="utf-8")
    (tmp_path / "problem.toml").write_text(text, encoding="utf-8")
    moved = replace(source, problem=str(tmp_path / "problem.toml"))
    outcome = make_catalogue.make_entry(moved, reuse=False, time_limit_s=1.0)
    assert isinstance(outcome, make_catalogue.Omission)
    assert outcome.reason.startswith("not read: ")


def test_a_solve_beyond_the_time_limit_is_omitted(tmp_path, monkeypatch):
    monkeypatch.setattr(make_catalogue, "RUNS", tmp_path)
    (source,) = (each for each in SOURCES if each.name == "twin_wrist_sensor")
    outcome = make_catalogue.make_entry(source, reuse=True, time_limit_s=0.01)
    assert isinstance(outcome, make_catalogue.Omission)
    assert "not solved within" in outcome.reason


@pytest.mark.long
def test_an_entry_is_that_of_the_run(tmp_path, monkeypatch):
    monkeypatch.setattr(make_catalogue, "RUNS", tmp_path)
    (source,) = (each for each in SOURCES if each.name == "twin_wrist_sensor")
    entry = make_catalogue.make_entry(source, reuse=True, time_limit_s=600.0)
    assert isinstance(entry, CatalogueEntry)
    result = json.loads((tmp_path / source.name / "result.json").read_text())
    for constant in entry.constants:
        stored = (result["parameters"] | result["derived"])[constant.name]
        assert constant.value == stored["value"]
        assert list(constant.combined95 or ()) == (stored["combined95"] or [])
    assert entry.law == ("neo-hookean",)
    assert entry.damping == ("kelvin-voigt",)
    # A second call reads the run folder; a changed problem file does not.
    assert make_catalogue.make_entry(source, reuse=True, time_limit_s=0.01) == entry
