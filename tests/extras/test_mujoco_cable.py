"""The identified cable as a chain of links in MuJoCo."""

from __future__ import annotations

import pytest

import collocation_sysid as cs
from collocation_sysid.common.text_files import parse_toml
from collocation_sysid.errors import InputError
from collocation_sysid.extras.export import verify_export, write_export
from collocation_sysid.extras.export.identified import IdentifiedBody
from collocation_sysid.problem.new import create_problem
from collocation_sysid.recording.writers import write_markers_csv

pytest.importorskip("mujoco")

WINDOW = "window_s = [0.0, 1.0]"
SPIRAL = "curvature_1_1_m = 0.0\ncurvature_1_end_1_m = 2.0\n"


@pytest.fixture(scope="module")
def cable(tmp_path_factory) -> IdentifiedBody:
    folder = tmp_path_factory.mktemp("cable") / "hose"
    create_problem(folder, "cable")
    return IdentifiedBody.from_run(cs.run(cs.Problem.read(folder / "problem.toml")))


@pytest.fixture
def curved(tmp_path) -> IdentifiedBody:
    """A cable whose natural curvature is affine, known, in its equilibrium."""
    create_problem(tmp_path / "hose", "cable")
    path = tmp_path / "hose" / "problem.toml"
    text = path.read_text(encoding="utf-8").replace('name = "swing"', 'name = "swing"\n' + WINDOW)
    text = text.replace("wrench = {", "# wrench = {").replace("sections = 41", "sections = 21")
    path.write_text(text.replace("[parameters]", "[parameters]\n" + SPIRAL), encoding="utf-8")
    (experiment,) = cs.Problem.read(path).experiments
    zero = ["curvature_2_1_m", "curvature_2_end_1_m", "twist_1_m", "twist_end_1_m"]
    constants = dict.fromkeys(zero, 0.0) | parse_toml(SPIRAL, path)
    constants |= {"bending_n_m2": 1e-3, "torsion_n_m2": 3e-4, "axial_n": 200.0}
    constants |= {"gamma_r_s": 2e-3, "gamma_m_1_s": 0.3}
    tracks_m = cs.simulate(experiment, constants).markers_m
    names = experiment.markers.names
    write_markers_csv(path.parent / "markers.csv", experiment.t_s, names, tracks_m)
    return IdentifiedBody.from_run(cs.run(cs.Problem.read(path)))


@pytest.mark.long
def test_the_chain_has_a_natural_curvature_that_is_affine(curved, tmp_path):
    write_export(curved, "mujoco", tmp_path / "chain")
    (compared,) = verify_export(curved, "mujoco", tmp_path / "chain")
    assert abs(compared.relative_difference) < 0.01


@pytest.mark.long
def test_the_tip_of_the_chain_moves_like_that_of_the_cable(cable, tmp_path):
    write_export(cable, "mujoco", tmp_path)
    (compared,) = verify_export(cable, "mujoco", tmp_path)
    assert abs(compared.relative_difference) < 0.01
    share = float(compared.remark.rpartition(", ")[2].rstrip("%")) / 100
    assert share < 0.02


@pytest.mark.long
@pytest.mark.parametrize("target", ["newton", "calculix", "abaqus", "febio"])
def test_a_target_without_cables_refuses_one(target, cable, tmp_path):
    with pytest.raises(InputError, match="no law cable"):
        write_export(cable, target, tmp_path / target)
