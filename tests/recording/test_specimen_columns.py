"""Messages on ambiguous columns of material tests: each states complete remedies."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest

import collocation_sysid as cs
from collocation_sysid.recording.sources.columns import name_and_unit
from collocation_sysid.recording.sources.units import si_factor
from collocation_sysid.recording.specimen_files import SpecimenLayout, read_specimen

VIDEO = "Tensile strain (Video axial) (%)"
HEADER = f"Time (s),Displacement (mm),Force (N),{VIDEO}"
ROWS = "0,0,0,0\n1,1,2,4\n2,2,3,8\n"


def message(tmp_path, header, columns=(), **layout):
    """Error of a table with the given header, read with stated columns."""
    path = tmp_path / "pull.csv"
    path.write_text(f"{header}\n{ROWS}")
    with pytest.raises(cs.InputError) as raised:
        read_specimen(path, SpecimenLayout(**of_test(columns), **layout))
    return str(raised.value)


def of_test(columns):
    """Arguments of the layout of a uniaxial test with stated columns."""
    return {"test": "uniaxial", "columns": dict(columns)}


def statements(text):
    """Each statement `columns = { … }` of a message, read as TOML."""
    parts = text.split("columns = {")[1:]
    return [tomllib.loads(f"columns = {{{part.split('}')[0]}}}")["columns"] for part in parts]


def test_strain_beside_displacement_has_a_statement_for_each(tmp_path):
    text = message(tmp_path, HEADER)
    assert statements(text) == [
        {"strain": VIDEO, "force": "Force (N)"},
        {"displacement": "Displacement (mm)", "force": "Force (N)"},
    ]
    assert text.endswith("with length_m and area_m2")
    path = tmp_path / "pull.csv"
    for stated in statements(text):
        layout = SpecimenLayout(**of_test(stated), length_m=0.02, area_m2=4e-6)
        table = read_specimen(path, layout)
        np.testing.assert_allclose(table.stress_pa, [0, 5e5, 7.5e5])


def test_a_strain_named_alone_is_completed_by_the_force(tmp_path):
    text = message(tmp_path, HEADER, {"strain": VIDEO}, area_m2=4e-6)
    assert statements(text) == [{"strain": VIDEO, "force": "Force (N)"}]


def test_two_strains_have_complete_statements(tmp_path):
    header = "Time (s),strain A (%),Force (N),strain B (%)"
    text = message(tmp_path, header, area_m2=4e-6)
    assert statements(text) == [
        {"strain": "strain A (%)", "force": "Force (N)"},
        {"strain": "strain B (%)", "force": "Force (N)"},
    ]


def test_a_stated_time_is_kept(tmp_path):
    header = HEADER.replace("Time", "Uhr")
    text = message(tmp_path, header, {"t": "Uhr (s)", "strain": VIDEO})
    assert statements(text) == [{"strain": VIDEO, "force": "Force (N)", "t": "Uhr (s)"}]


def test_a_load_that_is_not_recognised_is_left_open(tmp_path):
    header = HEADER.replace("Force (N)", "Kanal 3")
    text = message(tmp_path, header, {"strain": VIDEO})
    assert statements(text) == [{"strain": VIDEO, "force": "…"}]


def test_a_load_is_recognised_by_its_unit(tmp_path):
    header = HEADER.replace("Force", "Kanal 3")
    text = message(tmp_path, header, {"strain": VIDEO})
    assert statements(text) == [{"strain": VIDEO, "force": "Kanal 3 (N)"}]
    assert text.endswith("with area_m2")
    text = message(tmp_path, "e_strain_1,a (s),s_mpa,u_mm")
    assert statements(text) == [{"strain": "e_strain_1", "stress": "s_mpa"}]


BIAXIAL = "lambda_1,lambda_2,s_1_mpa,s_2_mpa"


def test_numbered_columns_are_those_of_the_axes(tmp_path):
    path = tmp_path / "wide.csv"
    path.write_text(f"{BIAXIAL}\n1.1,1.2,0.1,0.2\n1.2,1.4,0.15,0.3\n")
    with pytest.raises(cs.InputError) as raised:
        read_specimen(path, SpecimenLayout(test="biaxial", columns={}))
    (stated,) = statements(str(raised.value))
    assert stated == {
        "stretch": "lambda_1",
        "second_stretch": "lambda_2",
        "stress": "s_1_mpa",
        "second_stress": "s_2_mpa",
    }
    table = read_specimen(path, SpecimenLayout(test="biaxial", columns=stated))
    np.testing.assert_allclose(table.second_strain, [0.2, 0.4])
    np.testing.assert_allclose(table.second_stress_pa, [2e5, 3e5])


def test_a_number_behind_a_named_column_is_no_unit(tmp_path):
    path = tmp_path / "pull.csv"
    path.write_text("eps_1,eps_2,s_1\n10,20,0.1\n20,30,0.2\n")
    for column, strains in (("eps_1", [0.1, 0.2]), ("eps_2", [0.2, 0.3])):
        columns = {"strain": f"{column} (%)", "stress": "s_1 (MPa)"}
        table = read_specimen(path, SpecimenLayout(**of_test(columns)))
        np.testing.assert_allclose(table.strain, strains)
        np.testing.assert_allclose(table.stress_pa, [1e5, 2e5])


@pytest.mark.parametrize(
    ("unit", "factor"),
    [
        *(("kgf/cm2", 98066.5), ("kgf/cm^2", 98066.5), ("ksi", 6894757.293), ("psi", 6894.757293)),
        *(("mmHg", 133.322387), ("cmH2O", 98.0665), ("N/m2", 1.0), ("MN/m2", 1e6)),
    ],
)
def test_units_of_stress_of_real_files(unit, factor):
    assert si_factor(unit, "pressure") == pytest.approx(factor, rel=1e-6)


@pytest.mark.parametrize(
    ("unit", "dimension", "factor"),
    [
        *(("gf", "force", 9.80665e-3), ("µN", "force", 1e-6), ("nN", "force", 1e-9)),
        *(("nm", "length", 1e-9), ("µm", "length", 1e-6), ("Nm", "torque", 1.0)),
        *(("cN", "force", 1e-2), ("ozf", "force", 0.278014), ("mil", "length", 2.54e-5)),
        *(("µε", "ratio", 1e-6), ("microstrain", "ratio", 1e-6), ("‰", "ratio", 1e-3)),
        *(
            ("N mm^-2", "pressure", 1e6),
            ("N·mm⁻²", "pressure", 1e6),
            ("Torr", "pressure", 133.32237),
        ),
    ],
)
def test_small_units_of_real_files(unit, dimension, factor):
    assert si_factor(unit, dimension) == pytest.approx(factor, rel=1e-6)


@pytest.mark.parametrize(
    "header", ["Strain %,Stress kPa", "strain/%,stress/kPa", "Strain / %,Stress N/cm²"]
)
def test_units_without_brackets_are_read(tmp_path, header):
    path = tmp_path / "pull.csv"
    path.write_text(f"{header}\n10,2\n20,3\n")
    table = read_specimen(path, SpecimenLayout(test="uniaxial", columns={}))
    np.testing.assert_allclose(table.strain, [0.1, 0.2])
    np.testing.assert_allclose(table.stress_pa, [2e3, 3e3] if "kPa" in header else [2e4, 3e4])


@pytest.mark.parametrize(
    ("header", "strain"), [("ε (%),σ (kPa)", "ε (%)"), ("gamma (-),tau (kPa)", "gamma (-)")]
)
def test_a_strain_of_another_name_is_recognised_by_its_unit(tmp_path, header, strain):
    path = tmp_path / "pull.csv"
    path.write_text(f"{header}\n0.1,2\n0.2,3\n")
    with pytest.raises(cs.InputError) as raised:
        read_specimen(path, SpecimenLayout(**of_test({})))
    (columns,) = statements(str(raised.value))
    assert columns["strain"] == strain


@pytest.mark.parametrize("code", [-9999, 99999])
def test_codes_of_missing_values_are_refused(tmp_path, code):
    path = tmp_path / "pull.csv"
    path.write_text(f"stretch,stress (kPa)\n1.1,2\n1.2,{code}\n1.3,4\n")
    layout = SpecimenLayout(test="uniaxial", columns={})
    with pytest.raises(cs.InputError, match=r"line 3: .* a common code of missing values"):
        read_specimen(path, layout)
    path.write_text("stretch,stress (kPa)\n1.1,2\n1.2,\n1.3,4\n")
    np.testing.assert_allclose(read_specimen(path, layout).stress_pa, [2e3, np.nan, 4e3])


def test_an_unknown_unit_is_to_be_converted_not_renamed(tmp_path):
    path = tmp_path / "pull.csv"
    path.write_text("stretch,stress (furlong)\n1.1,2\n1.2,3\n")
    with pytest.raises(cs.InputError, match="convert its values, then call it stress_pa") as caught:
        read_specimen(path, SpecimenLayout(test="uniaxial", columns={}))
    assert "kgf/cm²" in caught.value.message


@pytest.mark.parametrize("header", ["volume ratio", "volume_ratio", "volume ratio (1)"])
def test_the_volume_ratio_is_read_under_its_documented_name(tmp_path, header):
    path = tmp_path / "swell.csv"
    path.write_text(f"{header},pressure (kPa)\n0.975,1.5\n0.95,2.9\n")
    table = read_specimen(path, SpecimenLayout(test="volumetric", columns={}))
    assert (1 + table.strain) ** 3 == pytest.approx([0.975, 0.95])


@pytest.mark.parametrize(
    "header",
    [
        "stretch,stress difference (MPa)",
        "stretch,von Mises stress (MPa)",
        "stretch,stress std (kPa)",
        "strain rate (1),stress (MPa)",
    ],
)
def test_a_word_that_makes_another_quantity_is_no_stress_or_strain(tmp_path, header):
    path = tmp_path / "pull.csv"
    path.write_text(f"{header}\n1,0\n1.1,2\n1.2,3\n")
    with pytest.raises(cs.InputError) as raised:
        read_specimen(path, SpecimenLayout(**of_test({})))
    text = str(raised.value)
    assert "makes it another quantity" in text
    named = [name for statement in statements(text) for name in statement.values()]
    assert not [name for name in named if "difference" in name or "Mises" in name or "std" in name]


@pytest.mark.parametrize(
    ("header", "modulus"),
    [
        ("stretch,sigma1-sigma2 (kPa)", ""),
        ("stretch,F*lambda/A (kPa)", ""),
        ("f (Hz),G* (kPa),tan delta", "harmonic"),
        ("f (Hz),|E*| (kPa),E'' (kPa)", "harmonic"),
    ],
)
def test_a_computed_quantity_is_no_statement_of_a_column(tmp_path, header, modulus):
    path = tmp_path / "pull.csv"
    width = header.count(",") + 1
    path.write_text("\n".join([header, *(",".join([f"1.{k}"] * width) for k in (1, 2, 3))]) + "\n")
    with pytest.raises(cs.InputError) as raised:
        read_specimen(path, SpecimenLayout(test="uniaxial", columns={}, modulus=modulus))
    (stated, *_) = statements(str(raised.value))
    assert "…" in stated.values()
    assert header.split(",")[1] not in stated.values()


def test_a_column_of_errors_beside_the_stress_is_not_read(tmp_path):
    path = tmp_path / "pull.csv"
    path.write_text("stretch,stress (kPa),stress error (kPa)\n1,0,9\n1.1,2,9\n1.2,3,9\n")
    table = read_specimen(path, SpecimenLayout(**of_test({})))
    np.testing.assert_allclose(table.stress_pa, [0, 2e3, 3e3])


@pytest.mark.parametrize(
    ("column", "factor"),
    [("stress_kgf_cm2", 98066.5), ("stress_n_mm2", 1e6), ("true_stress_kn_m2", 1e3)],
)
def test_units_per_area_are_read_with_underscores(column, factor):
    name, unit = name_and_unit(column)
    assert unit is not None
    assert name == column.split("stress")[0] + "stress"
    assert si_factor(unit, "pressure") == factor


@pytest.mark.parametrize(
    "header", ["true strain (%)", "Hencky strain (-)", "log. strain [%]", "logarithmic strain (1)"]
)
def test_a_logarithmic_strain_is_no_engineering_strain(tmp_path, header):
    text = message(tmp_path, f"{header},a (mm),b (mm),stress (kPa)")
    assert f"column {header} holds a true strain" in text
    assert "then call it stretch" in text


def test_a_cauchy_stress_is_a_true_stress(tmp_path):
    text = message(tmp_path, "strain (-),a (N m),b (N m),Cauchy stress (kPa)")
    assert "holds a true stress" in text
    assert 'stress = "true"' in text


@pytest.mark.parametrize(
    ("header", "layout"),
    [
        ("lambda 1,lambda 2,stress difference (kPa)", {"test": "biaxial-difference"}),
        ("t [min],E(t) [kPa]", {"test": "uniaxial", "modulus": "relaxation"}),
        ("f [Hz],Storage (kPa),tan delta", {"test": "uniaxial", "modulus": "harmonic"}),
        ("f (Hz),E' (kPa),E'' (kPa)", {"test": "uniaxial", "modulus": "harmonic"}),
    ],
)
def test_a_followed_statement_of_columns_is_read(tmp_path, header, layout):
    path = tmp_path / "table.csv"
    width = header.count(",") + 1
    path.write_text("\n".join([header, *(",".join([f"1.{k}"] * width) for k in (1, 2, 3))]) + "\n")
    with pytest.raises(cs.InputError) as raised:
        read_specimen(path, SpecimenLayout(columns={}, **layout))
    stated = statements(str(raised.value))[0]
    assert "makes it another quantity" not in str(raised.value)
    table = read_specimen(path, SpecimenLayout(columns=stated, **layout))
    assert len(table.stress_pa) == 3


def test_differences_of_true_stresses_are_read(tmp_path):
    path = tmp_path / "table.csv"
    path.write_text("stretch,second stretch,difference of true stresses (kPa)\n1.1,1,2\n1.2,1,3\n")
    layout = SpecimenLayout(test="biaxial-difference", columns={})
    assert read_specimen(path, layout).is_incompressible
