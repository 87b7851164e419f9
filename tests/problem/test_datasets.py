"""Datasets by name: their experiments, problem files and copies."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from kit.problem_files import run_command

import collocation_sysid as cs
from collocation_sysid.datasets.files import copy_dataset
from collocation_sysid.recording.homogeneous_deformation import DEFORMATIONS

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("name", cs.datasets.DATASETS)
def test_a_dataset_states_source_licence_and_units_and_has_experiments(name):
    read = getattr(cs.datasets, name)
    for word in ("Source", "MIT", "nits" if "Units" in read.__doc__ else "MPa"):
        assert word in read.__doc__
    experiments = read()
    assert experiments
    problem = cs.datasets.read_problem(name)
    names = {experiment.name for experiment in experiments}
    assert names <= {experiment.name for experiment in problem.experiments}


def test_kawabatas_tables_are_those_of_the_publication():
    uniaxial, equibiaxial, planar, biaxial = cs.datasets.kawabata_1981(
        tests=("uniaxial", "equibiaxial", "planar", "biaxial")
    )
    counts = [len(each.t_s) for each in (uniaxial, equibiaxial, planar, biaxial)]
    assert counts == [18, 16, 18, 65]
    assert uniaxial.specimen is DEFORMATIONS["uniaxial"]
    stress_pa = uniaxial.readings[0].measured_values[:, 0]
    assert stress_pa[0] == pytest.approx(0.0434e6)
    assert np.all(np.diff(stress_pa) > 0)
    assert [gauge.name for gauge in biaxial.readings] == ["stress", "second stress"]
    (small,) = cs.datasets.kawabata_1981(tests=("equibiaxial",), largest_stretch=1.3)
    assert len(small.t_s) < 16


def test_a_stretch_below_all_samples_is_refused_with_the_smallest_one():
    with pytest.raises(cs.InputError, match=r"largest_stretch = 1; expected at least 1\.0"):
        cs.datasets.kawabata_1981(largest_stretch=1.0)


def test_a_law_fits_kawabatas_small_stretches_well():
    tests = cs.datasets.kawabata_1981("mooney-rivlin", largest_stretch=1.3)
    constants = {"c10_pa": cs.Unknown(), "c01_pa": cs.Unknown(), "kappa_pa": 1e12}
    run = cs.run(cs.Problem(tests, {**constants, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}))
    # Rivlin's linear regression of the same stresses for an incompressible solid.
    rows, measured = [], []
    for test in tests:
        strain = test.grasps[3].poses.at(test.t_s)[1][:, 2] / 0.01
        stretch = 1 + strain
        of_test = {
            "uniaxial": np.column_stack([stretch - stretch**-2, 1 - stretch**-3]),
            "equibiaxial": np.column_stack([stretch - stretch**-5, stretch**3 - stretch**-3]),
            "planar": np.column_stack([stretch - stretch**-3] * 2),
        }
        rows.append(2 * of_test[test.name])
        measured.append(test.readings[0].measured_values[:, 0])
        if test.name == "planar":
            rows.append(2 * np.column_stack([1 - stretch**-2, stretch**2 - 1]))
            measured.append(test.readings[1].measured_values[:, 0])
    exact = np.linalg.lstsq(np.vstack(rows), np.concatenate(measured), rcond=None)[0]
    found = [run.parameters["c10_pa"], run.parameters["c01_pa"]]
    assert found == pytest.approx(exact, rel=3e-3)


@pytest.mark.long
def test_the_shipped_law_describes_kawabatas_rubber():
    found = cs.run(cs.datasets.read_problem("kawabata_1981"), seek_causes=False)
    assert found.trust.verdict != "doubtful"
    # Initial slope of the uniaxial stress, from its smallest stretches up to 1.1.
    low, high = found.interval("young_pa")
    assert low < 1.2e6 < high


def test_new_copies_a_dataset_that_can_be_checked(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    outcome = run_command("new", "rubber", "--dataset", "treloar_1944")
    assert (outcome.code, "rubber/problem.toml" in outcome.out) == (0, True)
    problem = cs.Problem.read(tmp_path / "rubber" / "problem.toml")
    assert [each.name for each in problem.experiments] == ["uniaxial"]


def test_a_copy_of_measured_data_has_source_licence_and_schema(tmp_path):
    for name in ("kawabata_1981", "treloar_1944", "diani"):
        file, *others = copy_dataset(name, tmp_path / name)
        names = {each.name for each in others}
        assert {"LICENSE_Hyperelastics.md", "schema.json"} <= names
        text = file.read_text()
        assert text.startswith("#:schema schema.json\n")
        assert "Hyperelastics.jl, Copyright (c) 2022 TRACER Lab at Liberty University, MIT" in text
    assert not (tmp_path / "kawabata_1981" / "calendering.csv").exists()
    with pytest.raises(cs.InputError, match="this file exists already"):
        copy_dataset("diani", tmp_path / "diani")


def test_a_copy_of_a_simulated_recording_names_a_schema_in_its_folder(tmp_path):
    file, *_ = copy_dataset("foam_cylinder", tmp_path)
    assert file.name == "recording.toml"
    for each in (file, tmp_path / "problem.toml"):
        assert each.read_text().startswith("#:schema schema.json\n")
    assert not (tmp_path / "LICENSE_Hyperelastics.md").exists()


@pytest.mark.long
def test_a_wheel_contains_the_datasets_with_their_licence(tmp_path, monkeypatch):
    hatchling = pytest.importorskip("hatchling.build")
    monkeypatch.chdir(ROOT)  # the project that is built
    wheel = tmp_path / hatchling.build_wheel(str(tmp_path))
    installed = tmp_path / "installed"
    zipfile.ZipFile(wheel).extractall(installed)
    program = "from collocation_sysid.cli import main; main()"

    def run(*arguments: str) -> str:
        return subprocess.run(
            [sys.executable, "-c", program, *arguments],
            env=os.environ | {"PYTHONPATH": str(installed)},
            cwd=tmp_path,
            capture_output=True,
            check=False,
            text=True,
            encoding="utf-8",
        ).stdout

    assert "LICENSE_Hyperelastics.md" in run("new", "rubber", "--dataset", "kawabata_1981")
    run("solve", "rubber/problem.toml", "--out", "run", "--no-pictures", "--quiet")
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    assert result["derived"]["young_pa"]["value"] == pytest.approx(1.2e6, rel=0.3)
    for name in cs.datasets.DATASETS:
        run("new", name, "--dataset", name)
        assert (tmp_path / name / cs.datasets.DATASETS[name]).is_file()


def test_an_unknown_dataset_is_refused_with_the_nearest_name():
    with pytest.raises(cs.InputError, match="did you mean 'kawabata_1981'"):
        cs.datasets.read_problem("kawabata")
