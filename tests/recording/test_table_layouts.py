"""Layouts of tables: results above samples, rows of names, encodings, and tables of two axes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from collocation_sysid.errors import InputError
from collocation_sysid.problem import Problem
from collocation_sysid.recording import read_displacement, read_wrench
from collocation_sysid.recording.specimen_files import SpecimenLayout, read_specimen
from collocation_sysid.result.synthesis import write_data

SAMPLES = "Time,Extension,Load\n(s),(mm),(N)\n" + "".join(
    f'"{0.5 * k}","{0.5 * k}","{2 * k}"\n' for k in range(9)
)
BLUEHILL = """Results Table 1
,Maximum Load,Modulus (Automatic Young's)
,(N),(MPa)
1,"3.56","0.58"
Mean,"3.56","0.58"

Results Table 2

"""
MTI = """Sample 7
Width,Thick,Diam.,Units Code
12.7,3.2,0,1
"""


def layout(**options) -> SpecimenLayout:
    return SpecimenLayout(**{"test": "uniaxial", "columns": {}, "length_m": 0.1, **options})


@pytest.fixture
def written(tmp_path: Path):
    def write(text: str | bytes) -> Path:
        file = tmp_path / "table.csv"
        file.write_bytes(text if isinstance(text, bytes) else text.encode())
        return file

    return write


@pytest.mark.parametrize("above", ["", BLUEHILL, MTI, "Operator,Miller\n\n"])
def test_results_above_the_samples_are_skipped(written, above):
    read = read_specimen(written(above + SAMPLES), layout(area_m2=1e-4))
    np.testing.assert_allclose(read.strain, 0.005 * np.arange(9))
    np.testing.assert_allclose(read.stress_pa, 2e4 * np.arange(9))


def test_tables_of_similar_length_need_the_line_of_the_names(written):
    file = written(SAMPLES + "\n" + SAMPLES.replace("(N)", "(kN)"))
    with pytest.raises(InputError, match=r"tables below the lines 2 and 14.* header_line"):
        read_specimen(file, layout(area_m2=1e-4))
    results = "".join(f"{k},1,2\n" for k in range(5))
    file = written("Specimen,Load (N),Extension (mm)\n" + results + SAMPLES)
    with pytest.raises(InputError, match="header_line"):
        read_specimen(file, layout(area_m2=1e-4))
    for line in (7, 8):  # that of the names, and that of the units below
        read = read_specimen(file, layout(area_m2=1e-4, header_line=line))
        np.testing.assert_allclose(read.stress_pa, 2e4 * np.arange(9))
    np.testing.assert_allclose(
        read_displacement(file, header_line=7).positions_m[:, 2], 5e-4 * np.arange(9)
    )
    np.testing.assert_allclose(read_wrench(file, header_line=7)[1][:, 2], 2 * np.arange(9))


@pytest.mark.parametrize(("line", "found"), [(4, "numbers"), (99, "no text")])
def test_a_wrong_line_of_the_names_is_refused(written, line, found):
    with pytest.raises(InputError, match=f"header_line: line {line} has {found}; expected the row"):
        read_specimen(written(SAMPLES), layout(header_line=line))


def test_a_row_that_is_wrong_begins_no_table(written):
    lines = SAMPLES.splitlines()
    for wrong in ("x,1,2", "?,?", "nan,nan,nan"):
        file = written("\n".join([*lines[:9], wrong, *lines[9:]]) + "\n")
        with pytest.raises(InputError, match="line 10"):
            read_specimen(file, layout(area_m2=1e-4, requires_times=True))


def test_a_row_of_another_table_names_the_line_of_the_names(written):
    text = "sample 1\nWidth,Thick\n12.7,3.2\nTime (s),Extension (mm),Load (N),State\n0,0,0,run\n"
    with pytest.raises(
        InputError, match=r"expected 2, .* in line 2; .* another line as header_line"
    ):
        read_specimen(written(text), layout(area_m2=1e-4))
    read = read_specimen(written(text), layout(area_m2=1e-4, header_line=4))
    assert len(read.strain) == 1


@pytest.mark.parametrize("text", ["0,0,0\n1,1,2\n2,2,3\n", "0.5;1\n1.5;2\n"])
def test_a_file_without_names_is_called_so(written, text):
    file = written(text)
    for read in (lambda: read_specimen(file, layout()), lambda: read_wrench(file)):
        with pytest.raises(InputError, match="line 1: found a row of numbers and no row of column"):
            read()


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be", "utf-8-sig", "cp1252"])
@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_tables_of_machines_have_any_encoding(written, encoding, separator):
    text = SAMPLES.replace("Load", "Prüfkraft").replace(",", separator)
    read = read_specimen(written(text.encode(encoding)), layout(area_m2=1e-4))
    np.testing.assert_allclose(read.stress_pa, 2e4 * np.arange(9))


BIAXIAL = "Time (s),Displacement 1 (mm),Displacement 2 (mm),Force 1 (N),Force 2 (N)"


@pytest.mark.parametrize(
    ("header", "columns"),
    [
        ("t (s),displacement (mm),second displacement (mm),force (N),second force (N)", {}),
        (
            BIAXIAL,
            {
                "displacement": "Displacement 1 (mm)",
                "second_displacement": "Displacement 2 (mm)",
                "force": "Force 1 (N)",
                "second_force": "Force 2 (N)",
            },
        ),
    ],
)
def test_biaxial_machines_have_two_displacements_and_forces(written, header, columns):
    file = written(f"{header}\n0,0,0,0,0\n1,1,2,3,4\n2,2,4,6,8\n")
    read = read_specimen(file, layout(test="biaxial", columns=columns, area_m2=1e-4))
    np.testing.assert_allclose(read.strain, [0, 0.01, 0.02])
    assert read.second_strain is not None
    assert read.second_stress_pa is not None
    np.testing.assert_allclose(read.second_strain, [0, 0.02, 0.04])
    np.testing.assert_allclose(read.stress_pa, [0, 3e4, 6e4])
    np.testing.assert_allclose(read.second_stress_pa, [0, 4e4, 8e4])


def test_two_displacements_and_forces_have_a_complete_statement(written):
    file = written(f"{BIAXIAL}\n0,0,0,0,0\n1,1,2,3,4\n")
    with pytest.raises(InputError) as caught:
        read_specimen(file, layout(test="biaxial"))
    assert (
        'columns = { displacement = "Displacement 1 (mm)", second_displacement = "Displacement 2 '
        '(mm)", force = "Force 1 (N)", second_force = "Force 2 (N)" }'
    ) in str(caught.value)


@pytest.mark.parametrize(
    "header", ["Time (s),Angle (deg),Torque (N mm)", "Zeit (s);Drehwinkel (°);Drehmoment (Nmm)"]
)
def test_angle_and_torque_turn_about_a_point(written, header):
    rows = "0,0,0\n1,30,5\n2,400,9\n".replace(",", ";" if ";" in header else ",")
    file = written(f"{header}\n{rows}")
    poses = read_displacement(file, axis="y", point_m=[0.1, 0.0, 0.2])
    turn = Rotation.from_quat(poses.quaternions_xyzw[1])
    np.testing.assert_allclose(turn.as_rotvec(degrees=True), [0, 30, 0], atol=1e-12)
    np.testing.assert_allclose(
        turn.apply([0.1, 0.7, 0.2]) + poses.positions_m[1], [0.1, 0.7, 0.2], atol=1e-12
    )
    values = read_wrench(file, axis="y")[1]
    np.testing.assert_allclose(values[:, 4], [0, 5e-3, 9e-3])
    assert np.isnan(np.delete(values, 4, axis=1)).all()
    with pytest.raises(InputError, match="found a column of angles, but not point_m"):
        read_displacement(file, axis="y")


TORSION = """[object]
box_m = [0.02, 0.02, 0.04]
edge_length_m = 0.02
density_kg_m3 = 1000.0
[parameters]
young_pa = { guess = 1e5 }
poisson = 0.45
gamma_r_s = 0.0
gamma_m_1_s = 0.0
[[experiment]]
name = "turn"
kind = "static"
gravity_m_s2 = [0, 0, 0]
file = "turn.csv"
[[experiment.grasp]]
nodes = { face = "bottom" }
[[experiment.grasp]]
nodes = { face = "top" }
displacement = { axis = "z", point_m = [0.01, 0.01, 0.0] }
wrench = { axis = "z", sigma_nm = 1e-5 }
"""


def test_a_bench_for_torsion_is_simulated_and_read_back(tmp_path):
    header = "Time (s),Rotation (deg),Torque (N mm)\n"
    (tmp_path / "turn.csv").write_text(header + "".join(f"{k},{10 * k},{k}\n" for k in range(4)))
    (tmp_path / "problem.toml").write_text(TORSION)
    (read,) = Problem.read(tmp_path / "problem.toml").experiments
    wrench = read.grasps[1].wrench
    assert wrench is not None
    np.testing.assert_allclose(wrench.point_m, [0.01, 0.01, 0.0])
    assert wrench.component_names == ("tz",)
    problem = Problem.read(tmp_path / "problem.toml", simulation=True)
    (file,) = write_data(problem, tmp_path / "twin")
    written = read_displacement(file, point_m=[0.01, 0.01, 0.0], timed=False)
    poses = read.grasps[1].poses
    np.testing.assert_allclose(written.quaternions_xyzw, poses.quaternions_xyzw, atol=1e-9)
    np.testing.assert_allclose(written.positions_m, poses.positions_m, atol=1e-9)
    assert (np.diff(read_wrench(file, timed=False)[1][:, 5]) > 0).all()


@pytest.mark.parametrize(
    ("names", "units", "column"),
    [
        ("Strain,Stress", ",kPa", "strain"),
        ("Time,Dehnung,Stress", "s,,kPa", "strain"),
        ("Time,Stress,Stretch,Comment", "(s),(kPa),,", "stretch"),
    ],
)
def test_a_blank_unit_of_a_ratio_is_one(written, names, units, column):
    width = names.count(",") + 1
    rows = [",".join([f"{1 + k / 8:g}"] * width) for k in range(3)]
    file = written("\n".join([names, units, *rows]))
    table = read_specimen(file, layout(length_m=None))
    assert column in table.columns
    np.testing.assert_allclose(table.strain, np.arange(3) / 8 + (column == "strain"))


@pytest.mark.parametrize("load", ["Force", "Stress"])
def test_a_blank_unit_of_a_load_is_refused(written, load):
    file = written(f"Strain,{load}\n%,\n1,2\n2,3\n")
    with pytest.raises(InputError, match=rf"column {load} \(\) names no unit"):
        read_specimen(file, layout(area_m2=1e-4))
