"""Options of methods: validation, documentation and user-defined methods."""

from __future__ import annotations

from dataclasses import fields, replace

import pytest
from pydantic import TypeAdapter

from collocation_sysid.common.field_descriptions import documented
from collocation_sysid.errors import InputError
from collocation_sysid.methods import METHODS
from collocation_sysid.methods.comparison.penalty import Penalty
from collocation_sysid.methods.options import method_from_options
from collocation_sysid.methods.reduced_space import ReducedSpace

each_method = pytest.mark.parametrize("name", METHODS)


@each_method
def test_every_option_is_documented(name: str):
    described = documented(METHODS[name])
    assert list(described) == [field.name for field in fields(METHODS[name])]
    assert all(text.endswith(".") for text in described.values())


@each_method
def test_every_method_is_known_by_its_name_and_has_a_schema(name: str):
    kind = METHODS[name]
    assert kind().name == name
    assert set(TypeAdapter(kind).json_schema()["properties"]) == set(documented(kind))
    assert TypeAdapter(kind).validate_python({}) == kind()


def test_a_method_is_built_from_a_table():
    method = method_from_options(ReducedSpace, {"ladder": [0.5, 1], "max_iterations": 3}, "solver")
    assert method == ReducedSpace(ladder=(0.5, 1.0), max_iterations=3)


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        (
            "penalty",
            {"rh": 1.0},
            "solver: the method 'penalty' has no option 'rh'; .*did you mean 'rho'?",
        ),
        ("penalty", {"rho": "1"}, "solver.rho: found '1'; expected a number$"),
        ("penalty", {"rho": True}, "solver.rho: found True; expected a number$"),
        ("penalty", {"max_iterations": 1.5}, "solver.max_iterations: .* expected a whole number"),
        ("reduced-space", {"hessian": "exat"}, "'gauss-newton' or 'exact'; did you mean 'exact'"),
        ("reduced-space", {"ladder": [0.5]}, "solver.ladder: found .0.5.; expected numbers above"),
        ("reduced-space", {"ladder": 1.0}, "solver.ladder: found 1.0; expected a list"),
        ("interior-point", {"ipopt": {"sb": True}}, "solver.ipopt.sb: found true; expected text"),
    ],
)
def test_invalid_options_are_refused_by_key(kind: str, options: dict, message: str):
    with pytest.raises(InputError, match=message):
        method_from_options(METHODS[kind], options, "solver")


def test_a_changed_method_is_checked_again():
    with pytest.raises(InputError, match="tolerance: found 0; expected a number above 0"):
        replace(Penalty(), tolerance=0)
