"""Words of column names that contradict a reading are refused, and others that are not understood
are noted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from collocation_sysid.errors import InputError
from collocation_sysid.problem import Problem
from collocation_sysid.recording import read_displacement, read_wrench
from collocation_sysid.recording.specimen_files import SpecimenLayout, read_specimen
from collocation_sysid.recording.time_tables import read_pressure

SPECIMEN = """[object]
material = "neo-hookean"
[parameters]
mu_pa = {}
kappa_pa = 1e9
[[experiment]]
name = "pull"
kind = "specimen"
test = "uniaxial"
file = "table.csv"
"""


@pytest.fixture
def table(tmp_path: Path):
    """Write a table with a header, and rows of as many numbers."""

    def write(header: str, rows: int = 4) -> Path:
        width = header.count(",") + 1
        lines = [",".join([f"{0.1 * k:g}"] * width) for k in range(1, rows + 1)]
        file = tmp_path / "table.csv"
        file.write_text("\n".join([header, *lines]) + "\n", encoding="utf-8")
        return file

    return write


def layout(test: str = "uniaxial", **options) -> SpecimenLayout:
    return SpecimenLayout(**{"test": test, "columns": {}, **options})


@pytest.mark.parametrize(
    ("strain", "words"),
    [
        ("strain (Lagrange) (-)", ["a Green-Lagrange strain", "√(1 + 2 E)"]),
        ("Lagrangian strain (%)", ["a Green-Lagrange strain"]),
        ("Green strain (-)", ["a Green-Lagrange strain"]),
        ("Lagrangedehnung [%]", ["a Green-Lagrange strain"]),
        ("Almansi strain (-)", ["an Almansi strain", "1/√(1 − 2 e)"]),
        ("Hencky strain (-)", ["the logarithm of the stretch"]),
    ],
)
def test_a_strain_of_another_measure_is_refused(table, strain, words):
    file = table(f"Time (s),{strain},Force (N)")
    for columns in ({}, {"strain": strain, "force": "Force (N)"}):
        with pytest.raises(InputError) as caught:
            read_specimen(file, layout(area_m2=1e-5, columns=columns))
        assert all(word in str(caught.value) for word in [*words, "call it stretch"])
    with pytest.raises(InputError, match="holds a"):
        read_displacement(file, length_m=0.1)


@pytest.mark.parametrize(
    ("stress", "is_read"),
    [
        ("first Piola-Kirchhoff stress (kPa)", True),
        ("PK1 stress (kPa)", True),
        ("nominal stress (kPa)", True),
        ("2nd Piola-Kirchhoff stress (kPa)", False),
        ("PK2 stress (kPa)", False),
        ("Kirchhoff stress (kPa)", False),
    ],
)
def test_a_stress_of_another_measure_is_refused(table, stress, is_read):
    file = table(f"strain (-),{stress}")
    if is_read:
        assert read_specimen(file, layout()).notes == ()
        return
    with pytest.raises(InputError, match="another measure of stress; expected an engineering"):
        read_specimen(file, layout())


MODULI = [
    ("time (s),shear modulus G(t) (kPa)", "relaxation", "simple-shear"),
    ("time (s),modulus G(t) (kPa)", "relaxation", "simple-shear"),
    ("time (s),Schubmodul (kPa)", "relaxation", "simple-shear"),
    ("time (s),Young's modulus (kPa)", "relaxation", "uniaxial"),
    ("time (s),tensile modulus (MPa)", "relaxation", "uniaxial"),
    ("Frequency (Hz),Shear storage modulus G' (Pa),Shear loss modulus G'' (Pa)", "harmonic", "simple-shear"),
    ("f (Hz),frequency (Hz),Storage modulus E' (Pa),Loss modulus E'' (Pa)", "harmonic", "uniaxial"),
]  # fmt: skip


@pytest.mark.parametrize(("header", "modulus", "test"), MODULI)
def test_a_modulus_of_another_kind_is_refused(table, header, modulus, test):
    file = table(header)
    assert not any(
        "understood" in note for note in read_specimen(file, layout(test, modulus=modulus)).notes
    )
    other = {"simple-shear": "uniaxial", "uniaxial": "simple-shear"}[test]
    right = f"shear-{modulus}" if test == "simple-shear" else modulus
    with pytest.raises(InputError, match=f'contradicts its reading; expected test = "{right}"'):
        read_specimen(file, layout(other, modulus=modulus))


@pytest.mark.parametrize(
    ("test", "column", "right"),
    [
        ("uniaxial", "shear strain (-)", "simple-shear"),
        ("uniaxial", "volumetric strain (-)", "volumetric"),
        ("uniaxial", "biaxial strain (%)", "equibiaxial"),
        ("simple-shear", "axial strain (-)", "uniaxial"),
        ("simple-shear", "pure shear strain (-)", "planar"),
        ("planar", "simple shear strain (-)", "simple-shear"),
        ("volumetric", "axial strain (-)", "uniaxial"),
    ],
)
def test_a_strain_of_another_test_is_refused(table, test, column, right):
    load = "pressure (kPa)" if test == "volumetric" else "stress (kPa)"
    file = table(f"{column},{load}")
    with pytest.raises(InputError, match=f'expected test = "{right}", or columns = ') as caught:
        read_specimen(file, layout(test))
    assert f'strain = "{column}"' in str(caught.value)
    stated = {"strain": column, load.split(" ")[0]: load}
    (note,) = read_specimen(file, layout(test, columns=stated)).notes
    assert "because columns states so" in note


def test_a_machine_names_forces_after_its_own_direction(table):
    file = table("Time (s),Compressive extension (mm),Tensile load (N)")
    read = read_specimen(file, layout("simple-shear", length_m=0.01, area_m2=1e-4))
    assert set(read.columns) == {"displacement", "force"}


def test_words_that_are_not_understood_are_noted_with_the_column(table, tmp_path):
    table("Time (s),strain (foo) (-),Engineering stress (kPa)")
    (tmp_path / "p.toml").write_text(SPECIMEN + "sigma_pa = 10\n")
    notes = Problem.read(tmp_path / "p.toml").notes
    assert any("words that are not understood: 'foo' in 'strain (foo) (-)'" in n for n in notes)
    table("Time (s),Tensile strain (Video axial) (%),Engineering stress (kPa)")
    notes = Problem.read(tmp_path / "p.toml").notes
    assert not any("not understood" in note for note in notes)


@pytest.mark.parametrize("column", ["Force X (N)", "Load x [N]", "force_x_n"])
def test_a_force_along_another_axis_is_refused(table, column):
    file = table(f"Time (s),Displacement (mm),{column}")
    with pytest.raises(InputError, match=r'states x, which contradicts .* expected axis = "x"'):
        read_wrench(file, axis="z")
    np.testing.assert_allclose(read_wrench(file, axis="x")[1][:, 0], [0.1, 0.2, 0.3, 0.4])


def test_an_absolute_pressure_is_refused(table):
    file = table("Time (s),absolute pressure (kPa)")
    with pytest.raises(InputError, match="states absolute, which contradicts its reading"):
        read_pressure(file)
    notes: list[str] = []
    read_pressure(table("Time (s),line pressure (kPa)"), notes)
    assert "'line'" in notes[0]


def test_what_the_user_names_is_taken_whole(table):
    file = table("λ_UAexp,σ_UAexp")
    columns = {"stretch": "λ_UAexp", "stress": "σ_UAexp (MPa)"}
    read = read_specimen(file, layout(columns=columns))
    np.testing.assert_allclose(read.stress_pa, [1e5, 2e5, 3e5, 4e5])
    with pytest.raises(InputError, match=r'columns.stress = "σ_UAexp \(Pa\)"'):
        read_specimen(file, layout(columns=columns | {"stress": "σ_UAexp"}))


@pytest.mark.parametrize(
    ("header", "stated"),
    [
        ("Time (s),Extensometer strain (mm),Load (N)", 'displacement = "Extensometer strain (mm)"'),
        ("Time (s),Strain (V),Crosshead (mm),Load (N)", 'displacement = "Crosshead (mm)"'),
    ],
)
def test_the_remedy_for_a_unit_states_columns(table, header, stated):
    with pytest.raises(InputError) as caught:
        read_specimen(table(header), layout(area_m2=1e-5))
    assert f"state columns = {{ {stated}" in str(caught.value)


def test_an_empty_column_counts_as_missing(tmp_path):
    file = tmp_path / "table.csv"
    file.write_text("Time (s),Extension (mm),Strain 1 (%),Load (N)\n0,0,,0\n1,1,,2\n")
    read = read_specimen(file, layout(length_m=0.1, area_m2=1e-4))
    np.testing.assert_allclose(read.strain, [0, 0.01])
    assert "column Strain 1 (%) has no values: it is not read" in read.notes
    file.write_text("Time (s),Strain 1 (%),Load (N)\n0,,0\n1,,2\n")
    with pytest.raises(InputError, match=r"column Strain 1 \(%\) has no values"):
        read_specimen(file, layout(area_m2=1e-4))
    with pytest.raises(InputError, match=r"columns.strain is .* which has no values"):
        read_specimen(file, layout(area_m2=1e-4, columns={"strain": "Strain 1 (%)"}))


# What is not used is not validated


WINDOWED = "Time (s),strain (-),stress (kPa)\n0,0,0\n1,0.1,1\n2,0.2,2\n{rest}"


@pytest.mark.parametrize(
    "rest", ["3,0.3,3\n2,0.4,4\n", "3,0.3,3\nbreak,0.4,4\n", "3,broken,\n,,9\n", "3,0.3,\n4,,\n"]
)
def test_rows_outside_the_window_are_not_read(tmp_path, rest):
    file = tmp_path / "table.csv"
    file.write_text(WINDOWED.format(rest=rest))
    for requires_times in (False, True):
        read = read_specimen(file, layout(window_s=(0, 2), requires_times=requires_times))
        np.testing.assert_allclose(read.strain, [0, 0.1, 0.2])
        assert (read.row_count, read.notes) == (5, ())


def test_an_elastic_law_needs_no_order_of_times(tmp_path):
    file = tmp_path / "table.csv"
    file.write_text(WINDOWED.format(rest="1.5,0.3,3\n"))
    read = read_specimen(file, layout())
    np.testing.assert_allclose(read.strain, [0, 0.1, 0.2, 0.3])
    np.testing.assert_allclose(read.t_s, [0, 1, 2, 3])
    assert "times are not in order (line 5: t_s = 1.5 follows 2; time" in read.notes[0]
    with pytest.raises(InputError, match=r"line 5: t_s = 1.5 follows 2"):
        read_specimen(file, layout(requires_times=True))
    file.write_text(WINDOWED.format(rest="0:03,0.3,3\n"))
    assert len(read_specimen(file, layout()).strain) == 4


def test_a_window_needs_times(tmp_path):
    file = tmp_path / "table.csv"
    file.write_text("strain (-),stress (kPa)\n0,0\n0.1,1\n")
    with pytest.raises(InputError, match="expected t_s"):
        read_specimen(file, layout(window_s=(0, 2)))
    file.write_text(WINDOWED.format(rest=""))
    with pytest.raises(InputError, match=r"window_s: found \[7, 9\], which contains no sample"):
        read_specimen(file, layout(window_s=(7, 9)))


def test_a_wrench_of_torques_needs_no_noise_of_forces(tmp_path):
    from collocation_sysid import Wrench

    t_s, values = [0.0, 1.0], np.array([[np.nan] * 5 + [0.1], [np.nan] * 5 + [0.2]])
    wrench = Wrench(t_s, values, sigma_nm=0.01)
    np.testing.assert_allclose(wrench.value_sigmas, [1, 1, 1, 0.01, 0.01, 0.01])
    with pytest.raises(InputError, match="contains forces, but sigma_n is missing"):
        Wrench(t_s, np.nan_to_num(values), sigma_nm=0.01)


@pytest.mark.parametrize(("stated", "is_read"), [("mm", True), ("m", False), ("", True)])
def test_a_sensor_in_another_unit_than_stated_is_refused(tiny, stated, is_read):
    (experiment,) = Problem.read(tiny / "problem.toml").experiments
    rows = [f"{t:.9g},1.0" for t in experiment.t_s]
    (tiny / "height.csv").write_text("\n".join(["t_s,height (mm)", *rows]))
    (tiny / "sensor.py").write_text("def height(at):\n    return at.position_m[2, 0]\n")
    with (tiny / "problem.toml").open("a") as file:
        file.write(
            '\n[[experiment.reading]]\nname = "height"\ncode = "sensor.py"\nfunction = "height"\n'
            f'file = "height.csv"\nsigma = 0.1\nunit = "{stated}"\npoints_m = [[0.0, 0.0, 0.0]]\n'
        )
    if is_read:
        notes = Problem.read(tiny / "problem.toml", allow_code=True).notes
        assert any("is used in its own unit, mm" in note for note in notes) == (not stated)
        return
    with pytest.raises(InputError, match="has the unit mm; expected m: convert its values"):
        Problem.read(tiny / "problem.toml", allow_code=True)


@pytest.mark.parametrize(
    ("column", "listed"),
    [
        *[
            (f"{word} strain (-)", f"'{word.lower()}'")
            for word in ("GL", "LE", "creep", "Biot", "d")
        ],
        *[(f"stress {word} (kPa)", f"'{word}'") for word in ("ratio", "increment", "drop", "area")],
        *[
            (f"force {word} (N)", f"'{word}'")
            for word in ("ratio", "peak", "normalised", "preload")
        ],
        *[(f"{word} (kPa)", f"'{word.lower()}'") for word in ("Eigenspannung", "Fließspannung")],
        ("Bruchdehnung (%)", "'bruchdehnung'"),
        ("contrainte vraie (kPa)", "'vraie'"),
        ("taux de déformation (-)", "'taux' and 'de'"),
        ("stress*2 (kPa)", "'*2'"),
        ("strain^2 (-)", "'^2'"),
        ("1/strain (-)", "'1/'"),
        ("−strain (-)", "'−'"),
        ("stretch - 1 (-)", "'- 1'"),
        ("λ−1 (-)", "'−1'"),
        ("stress 1 - stress 2 (kPa)", "'-'"),
        ("stress_1-stress_2 (kPa)", "'-'"),
        ("|force| (N)", "'|' and '|'"),
    ],
)
def test_each_word_and_sign_of_a_header_is_understood_or_listed(table, column, listed):
    words = ("strain", "dehnung", "déformation", "stretch", "λ")
    is_load = not any(word in column.lower() for word in words)
    file = table(f"strain (-),{column}" if is_load else f"{column},stress (kPa)")
    (note,) = read_specimen(file, layout(length_m=0.1, area_m2=1e-4)).notes
    assert note.startswith(f"words that are not understood: {listed} in '{column}'")


@pytest.mark.parametrize(
    "column", ["strain rate (-)", "true strain (-)", "Dehnrate (-)", "Dehnungsrate (-)"]
)
def test_another_quantity_than_the_strain_is_not_read_as_one(table, column):
    with pytest.raises(InputError, match="column"):
        read_specimen(table(f"{column},engineering stress (kPa)"), layout())


@pytest.mark.parametrize("column", ["E* (kPa)", "secant modulus (kPa)", "strain rate (1)"])
def test_another_quantity_beside_strain_and_stress_is_not_read(table, column):
    read = read_specimen(table(f"strain (-),stress (kPa),{column}"), layout())
    assert set(read.columns) == {"strain", "stress"}


@pytest.mark.parametrize("column", ["stretch ratio", "Dehnung (%)", "Längendehnung (%)"])
def test_usual_words_of_a_header_are_understood(table, column):
    assert not read_specimen(table(f"{column},stress (kPa)"), layout()).notes


@pytest.mark.parametrize("ends", [("xx", "yy"), ("XX", "YY"), ("11", "22"), ("x", "y")])
@pytest.mark.parametrize("kind", ["eng_strain", "Strain", "NOMINAL STRAIN"])
def test_components_of_a_strain_are_no_units(table, kind, ends):
    first, second = (f"{kind}_{end}" for end in ends)
    file = table(f"{first},{second},stress (kPa)")
    with pytest.raises(InputError, match=r"names no unit; .*: state one with its unit") as caught:
        read_specimen(file, layout())
    for column in (first, second):
        assert f'strain = "{column} (1)", stress = "stress (kPa)"' in str(caught.value)
        stated = {"strain": f"{column} (%)", "stress": "stress (kPa)"}
        np.testing.assert_allclose(read_specimen(file, layout(columns=stated)).strain[0], 1e-3)


@pytest.mark.parametrize("word", ["log", "Log", "Hencky", "true", "ln"])
@pytest.mark.parametrize("form", ["strain [{}]", "strain_{}", "phi Y [{}]"])
def test_kinds_of_a_strain_are_no_units(table, form, word):
    column = form.format(word)
    file = table(f"{column},stress (kPa)")
    with pytest.raises(InputError, match="holds a true strain, the logarithm of the stretch"):
        read_specimen(file, layout(columns={"strain": column, "stress": "stress (kPa)"}))


@pytest.mark.parametrize("column", ["VSG_STRAIN_YY", "vsg_strain_xx", "VSG_STRAIN_XX (1)"])
def test_virtual_strain_gauges_of_dice_have_green_lagrange_strains(table, column):
    with pytest.raises(InputError, match="holds a Green-Lagrange strain"):
        read_specimen(table(f"{column},stress (kPa)"), layout())


@pytest.mark.parametrize("column", ["strain_xy (-)", "eng_strain_xy", "Strain XZ (%)"])
def test_shear_strains_are_no_strains_along_the_specimen(table, column):
    read = read_specimen(table(f"strain_yy (-),{column},stress (kPa)"), layout())
    np.testing.assert_allclose(read.strain, [0.1, 0.2, 0.3, 0.4])
    assert not any("understood" in note for note in read.notes)


@pytest.mark.parametrize("column", ["time_second", "Time / min", "elapsed time_h"])
def test_words_that_are_units_stay_units(table, column):
    read = read_specimen(table(f"{column},strain (-),stress (kPa)"), layout())
    assert read.t_s[0] in (0.1, 6.0, 360.0)
