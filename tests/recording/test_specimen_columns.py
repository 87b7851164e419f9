"""Messages on ambiguous columns of material tests: each states complete remedies."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest

import collocation_sysid as cs
from collocation_sysid.recording.specimen_files import (
    SpecimenLayout,
    read_specimen,
)

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
    return [
        tomllib.loads(f"columns = {{{part.split('}')[0]}}}")["columns"]
        for part in parts
    ]


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
    assert statements(text) == [
        {"strain": VIDEO, "force": "Force (N)", "t": "Uhr (s)"}
    ]


def test_a_load_that_is_not_recognised_is_left_open(tmp_path):
    header = HEADER.replace("Force", "Kanal 3")
    text = message(tmp_path, header, {"strain": VIDEO})
    assert statements(text) == [{"strain": VIDEO, "force": "…"}]
