"""Tables of a problem file: keys, types and defaults of the declared classes."""

from __future__ import annotations

from dataclasses import MISSING, fields
from typing import Any, get_args

import pytest
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from collocation_sysid.common.declarations import keys_of
from collocation_sysid.common.field_descriptions import documented
from collocation_sysid.common.schema_tables import Section
from collocation_sysid.fem.spatial_field import Field
from collocation_sysid.model.parameters import PARAMETER_KEYS, Unknown
from collocation_sysid.problem import camera_section, load_schema, recording_schema, schema
from collocation_sysid.problem.problem_options import RolloutOptions, UncertaintyOptions
from collocation_sysid.recording import (
    Depth,
    DepthCamera,
    Experiment,
    Gauge,
    Grasp,
    Markers,
    Obstacle,
    Wrench,
    solid_sections,
)
from collocation_sysid.recording.obstacle_solids import (
    KINDS,
    Capsule,
    Cuboid,
    Cylinder,
    Plane,
    Sphere,
)
from collocation_sysid.statistics.budget.systematic_effects import Assumptions

SECTIONS: dict[type, type[Section]] = {
    Field: schema.FieldSection,
    Wrench: recording_schema.ForceSensorSection,
    Grasp: recording_schema.GraspSection,
    Obstacle: recording_schema.ObstacleSection,
    Markers: recording_schema.MarkersSection,
    Gauge: recording_schema.ReadingSection,
    Depth: camera_section.DepthSection,
    DepthCamera: camera_section.DepthCameraSection,
    Experiment: recording_schema.ExperimentSection,
    **{kind: getattr(load_schema, f"{kind.__name__}Section") for *_, kind in load_schema.LOADS},
    Plane: solid_sections.PlaneSection,
    Sphere: solid_sections.SphereSection,
    Cylinder: solid_sections.SolidCylinderSection,
    Capsule: solid_sections.CapsuleSection,
    Cuboid: solid_sections.CuboidSection,
}
# The nodes of an obstacle are those of its frame, which no file states.
NOT_IN_FILES = {Obstacle: {"nodes"}}
# A file cannot state the positions and velocities of start = "given".
OTHER_FORMS = {(Experiment, "start")}
# Texts that are about the file: what the numbers of the table mean in it.
OTHER_TEXTS = {(Wrench, "symmetry"), (Gauge, "grasp"), (Experiment, "start")}

each_class = pytest.mark.parametrize("kind", SECTIONS, ids=lambda kind: kind.__name__)


def declared_keys(kind: type) -> dict[str, Any]:
    """Keys of a class by the name of the field, without those that no file states."""
    left_out = NOT_IN_FILES.get(kind, set())
    return {name: key for name, key in keys_of(kind) if name not in left_out}


@each_class
def test_a_table_has_the_keys_of_its_class(kind: type):
    for name, key in declared_keys(kind).items():
        if (kind, name) not in OTHER_FORMS:
            stated = SECTIONS[kind].model_fields[key.name]
            declared = FieldInfo.from_annotation(key.form)
            assert stated.annotation == declared.annotation, name
            assert stated.metadata == declared.metadata, name


@each_class
def test_a_key_that_is_left_out_means_the_default_of_the_class(kind: type):
    stated = SECTIONS[kind].model_fields
    declared = {field.name: field for field in fields(kind)}
    for name, key in declared_keys(kind).items():
        default = stated[key.name].default
        field = declared[name]
        if type(None) in get_args(key.form):
            assert default is None, name  # the class has the default
        elif field.default_factory is not MISSING:
            assert default == field.default_factory(), name
        elif field.default is MISSING:
            assert default is PydanticUndefined, name
        else:
            converted = default if key.read is None else key.read(default)
            as_stored = tuple(converted) if isinstance(converted, list) else converted
            assert as_stored == field.default, name


@each_class
def test_a_key_is_described_as_the_field_of_its_class(kind: type):
    described = documented(kind)
    for name, key in declared_keys(kind).items():
        same_name = key.name == name
        if same_name and (kind, name) not in OTHER_TEXTS:
            assert SECTIONS[kind].model_fields[name].description == described.get(name), name


@pytest.mark.parametrize("section", SECTIONS.values(), ids=lambda section: section.__name__)
def test_a_table_states_a_file_or_a_constant(section: type[Section]):
    kind = next(each for each in SECTIONS if SECTIONS[each] is section)
    for _, key in keys_of(kind):
        if key.constant is not None:
            either = f"expected exactly one of {key.constant}, {key.name}"
            nodes = {word: "top" for word in ("nodes", "faces") if word in section.model_fields}
            points = {"points_m": [[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]}
            others = nodes | (points if "points_m" in section.model_fields else {})
            with pytest.raises(ValueError, match=either):
                section.model_validate(others)
            assert section.model_validate(others | {key.name: "table.csv"})


def test_solids_have_the_keys_of_the_table():
    assert set(KINDS) == set(solid_sections.SolidSection.model_fields)
    for name, kind in KINDS.items():
        form = solid_sections.SolidSection.model_fields[name].annotation
        assert get_args(form) == (SECTIONS[kind], type(None))


def test_parameters_have_the_keys_of_unknowns():
    assert set(schema.ParameterSection.model_fields) == set(PARAMETER_KEYS)
    table = schema.ParameterSection.model_fields
    for field in fields(Unknown):
        assert table[field.name].default == field.default
        if field.name != "prior":  # mean and deviation, as a table
            assert table[field.name].description == documented(Unknown)[field.name]


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
