"""Tables of a problem file: keys, types and defaults of the declared classes."""

from __future__ import annotations

from dataclasses import fields
from typing import Any, get_args

import pytest

from collocation_sysid.common.declarations import keys_of
from collocation_sysid.common.schema_tables import Section
from collocation_sysid.model.parameters import PARAMETER_KEYS
from collocation_sysid.problem import recording_schema, schema
from collocation_sysid.problem.options import RolloutOptions, UncertaintyOptions
from collocation_sysid.recording.obstacle_solids import KINDS, SolidSection
from collocation_sysid.statistics.budget.systematic_effects import Assumptions

LOADS = [
    recording_schema.ForceSection,
    recording_schema.TendonSection,
    recording_schema.PressureSection,
]


@pytest.mark.parametrize("section", LOADS, ids=lambda section: section.__name__)
def test_a_table_states_a_file_or_a_constant(section: type[Section]):
    for _, key in keys_of(section.of):
        if key.constant is not None:
            either = f"expected exactly one of {key.constant}, {key.name}"
            nodes = {word: "top" for word in ("nodes", "faces") if word in section.model_fields}
            points = {"points_m": [[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]}
            others = nodes | (points if "points_m" in section.model_fields else {})
            with pytest.raises(ValueError, match=either):
                section.model_validate(others)
            assert section.model_validate(others | {key.name: "table.csv"})


def test_solids_have_the_keys_of_the_table():
    assert set(KINDS) == set(SolidSection.model_fields)
    for name, kind in KINDS.items():
        form = SolidSection.model_fields[name].annotation
        assert get_args(form)[0].of is kind


def test_parameters_have_the_keys_of_unknowns():
    assert set(schema.ParameterSection.model_fields) == set(PARAMETER_KEYS)


@pytest.mark.parametrize(
    ("section", "options"),
    [
        (schema.RolloutSection, RolloutOptions),
        (schema.UncertaintySection, UncertaintyOptions),
        (schema.AssumptionsSection, Assumptions),
    ],
)
def test_tables_of_options_are_the_options(section: type[Section], options: Any):
    assert list(section.model_fields) == [field.name for field in fields(options)]
    assert options(**section().model_dump()) == options()
    with pytest.raises(ValueError, match="frozen"):
        setattr(section(), next(iter(section.model_fields)), None)
    with pytest.raises(ValueError, match="unknown_key"):
        section.model_validate({"unknown_key": 1})
