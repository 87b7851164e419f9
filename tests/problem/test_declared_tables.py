"""Classes with one field for each nuisance parameter or systematic effect."""

from __future__ import annotations

import inspect
import re
from dataclasses import fields
from typing import get_args, get_type_hints

from collocation_sysid import Nuisance
from collocation_sysid.common.field_descriptions import documented
from collocation_sysid.fem.body import Made, MeshOrigin
from collocation_sysid.problem.nuisance_schema import KEYS, NuisanceSection
from collocation_sysid.recording.nuisance import KINDS
from collocation_sysid.statistics.budget.systematic_effects import (
    ASSUMPTIONS,
    Assumptions,
    Deviated,
    KnownDeviation,
)


def as_sentence(text: str) -> str:
    return f"{text[0].upper()}{text[1:]}."


# Nuisance parameters -------------------------------------------------------------------------


def test_nuisance_has_a_field_for_each_kind():
    names = [field.name for field in fields(Nuisance)]
    assert names == [*(row.name for row in KINDS), "scope", "own"]
    standard = Nuisance()
    assert [standard.sigma(row) for row in KINDS] == [row.sigma for row in KINDS]


def test_fields_of_nuisance_are_described_as_the_kinds():
    described = documented(Nuisance)
    for row in KINDS:
        assert described[row.name] == as_sentence(row.description)


def test_the_table_has_a_key_for_each_kind():
    assert list(NuisanceSection.model_fields) == [*KEYS, "own"]


# Systematic effects ---------------------------------------------------------------------------


def test_assumptions_have_a_field_for_each_row():
    defaults = {row.name: row.considered for row in ASSUMPTIONS}
    defaults |= {row.name: row.considered for row in KINDS if row.considered is not None}
    assert [field.name for field in fields(Assumptions)] == list(defaults)
    assert Assumptions().collect_deviations() == defaults


BY_ORIGIN = {row.name for row in ASSUMPTIONS if row.by_origin}
ONE_SIDED = {
    "grip_layer_m",
    "machine_compliance_m_n",
    "marker_mass_kg",
    "memory_share",
    "specimen_sticking",
}


def test_defaults_by_origin_name_ways_of_making_a_body_or_origins_of_its_mesh():
    ways, origins = set(get_args(Made)), set(get_args(MeshOrigin))
    for row in ASSUMPTIONS:
        assert set(row.by_origin) <= ways or set(row.by_origin) <= origins
        assert row.considered not in row.by_origin.values()


def test_only_effects_of_known_sign_have_a_mean():
    forms = get_type_hints(Assumptions, include_extras=True)
    for field in fields(Assumptions):
        known = field.name in ONE_SIDED
        usual = Deviated | None if field.name in BY_ORIGIN else Deviated
        assert forms[field.name] == (KnownDeviation if known else usual)


def test_fields_of_assumptions_are_described_as_the_rows():
    section = inspect.cleandoc(Assumptions.__doc__ or "").partition("Attributes\n----------\n")[2]
    blocks = re.findall(r"^(\w+) : .*\n((?: +.*(?:\n|$))+)", section, re.M)
    described = {name: " ".join(text.split()) for name, text in blocks}
    expected = {row.name: f"{row.description} [{row.unit or 1}]" for row in ASSUMPTIONS}
    expected |= {
        row.name: f"{row.description} [{row.unit}]" for row in KINDS if row.considered is not None
    }
    assert described == {name: as_sentence(text) for name, text in expected.items()}
