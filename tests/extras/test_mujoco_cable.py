"""The identified cable as a chain of links in MuJoCo."""

from __future__ import annotations

import pytest

import collocation_sysid as cs
from collocation_sysid.errors import InputError
from collocation_sysid.extras.export import verify_export, write_export
from collocation_sysid.extras.export.identified import IdentifiedBody
from collocation_sysid.problem.new import create_problem

pytest.importorskip("mujoco")


@pytest.fixture(scope="module")
def cable(tmp_path_factory) -> IdentifiedBody:
    folder = tmp_path_factory.mktemp("cable") / "hose"
    create_problem(folder, "cable")
    return IdentifiedBody.from_run(cs.run(cs.Problem.read(folder / "problem.toml")))


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
