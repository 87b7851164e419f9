"""The table [solver] of a problem file: keys of every method agree with its options."""

from __future__ import annotations

import json
import tomllib
from dataclasses import fields

import pytest
from kit.problem_files import EXPERIMENT, PROBLEM, run_command

from collocation_sysid.common.field_descriptions import documented
from collocation_sysid.errors import InputError
from collocation_sysid.methods import METHODS
from collocation_sysid.problem.loading import read_problem_file
from collocation_sysid.problem.schema import ProblemFile
from collocation_sysid.problem.solver_schema import SolverSection

each_method = pytest.mark.parametrize("method", METHODS)


def solver_of(tables: str) -> SolverSection:
    content = tomllib.loads(PROBLEM.replace('[solver]\nmethod = "interior-point"', tables))
    return ProblemFile.model_validate(content | tomllib.loads(EXPERIMENT)).solver


@each_method
def test_the_schema_states_the_defaults_of_methods(method: str):
    schema = json.loads(run_command("schema").out)
    table = schema["$defs"]["SolverSection"]["properties"][method]
    defaults = {name: option["default"] for name, option in table["properties"].items()}
    descriptions = {name: option["description"] for name, option in table["properties"].items()}
    kind = METHODS[method]
    expected = {field.name: getattr(kind(), field.name) for field in fields(kind)}
    assert defaults == json.loads(json.dumps(expected))
    assert descriptions == documented(kind)
    assert table["additionalProperties"] is False


def test_every_method_has_a_key():
    keys = {field.alias for field in SolverSection.model_fields.values()}
    assert keys == {None, *METHODS}


def test_only_methods_with_a_table_are_made():
    assert solver_of("").methods == {}


@each_method
def test_with_an_empty_table_a_method_has_its_defaults(method: str):
    assert solver_of(f'[solver."{method}"]').methods == {method: METHODS[method]()}


def test_tables_of_several_methods_stand_side_by_side():
    solver = solver_of(
        """
        [solver]
        method = "penalty"
        [solver.penalty]
        rho = 3.0
        [solver.reduced-space]
        ladder = [0.5, 1]
        [solver."casadi:sqpmethod"]
        casadi = { min_iter = 1 }
        [solver.shooting]
        gradient = "adjoint"
        """
    )
    assert solver.method == "penalty"
    assert solver.methods["penalty"].rho == 3.0
    assert "augmented-lagrangian" not in solver.methods
    assert solver.methods["reduced-space"].ladder == (0.5, 1.0)
    assert solver.methods["casadi:sqpmethod"].casadi == {"min_iter": 1}
    assert solver.methods["shooting"].gradient == "adjoint"


@pytest.mark.parametrize(
    ("override", "message"),
    [
        (
            "solver.tolerance=1e-6",
            "solver: the options of a method have a table of their own: move tolerance to "
            "[solver.interior-point]",
        ),
        (
            "solver={method = 'casadi:sleqp', hessian = 'exact', casadi = {}, rho = 1, inner = ''}",
            'move hessian, casadi to [solver."casadi:sleqp"] and rho, inner to [solver.penalty]',
        ),
        (
            "solver.reduced-space.warm_up=0",
            "solver.reduced-space: found warm_up, which is an option of interior-point; "
            "expected options of reduced-space",
        ),
        (
            "solver.reduced-space.ladde=[1]",
            "'reduced-space' has no option 'ladde'; expected one of toler",
        ),
        ("solver.reduced-space.ladde=[1]", "did you mean 'ladder'?"),
        ("solver.reduced_space.ladder=[1]", "unknown key; did you mean 'reduced-space'?"),
        ("solver.penalty=3", "solver.penalty: found 3; expected a table of options"),
        (
            "solver.penalty.rho_max=1",
            "solver.penalty.rho_max: found 1, which is less than rho = 100; expected",
        ),
        ("solver.penalty.rho_factor=1", "solver.penalty.rho_factor: found 1; expected a number ab"),
    ],
)
def test_unknown_keys_of_a_table_are_refused(tiny, override: str, message: str):
    with pytest.raises(InputError) as refused:
        read_problem_file("problem.toml", [override])
    assert message in str(refused.value)


# The command --------------------------------------------------------------------------------------


def test_the_methods_are_listed_with_a_line_on_each():
    listed = run_command("methods").out
    assert all(method in listed for method in METHODS)
    assert "Interior-point method (IPOPT) for parameters and trajectories together." in listed
    told = json.loads(run_command("methods", "--json").out)
    assert list(told) == list(METHODS)
    assert (
        told["interior-point"]
        == "Interior-point method (IPOPT) for parameters and trajectories together."
    )


@each_method
def test_a_method_lists_its_options(method: str):
    text = run_command("methods", method).out
    told = json.loads(run_command("methods", method, "--json").out)["properties"]
    assert list(told) == [field.name for field in fields(METHODS[method])]
    for name in told:
        assert f"\n{name} " in text


def test_an_option_is_described_with_default_and_choices():
    told = " ".join(run_command("methods", "reduced-space").out.split())
    assert "ladder [0.25, 0.5, 1] list, each a number above 0; Shares of the motion" in told
    assert (
        "hessian gauss-newton gauss-newton, exact; Second derivatives that Gauss–Newton neglects"
        in told
    )
    assert "by more than 10 %" in told
    assert "coarse_start auto auto, false; " in told
    reference = " ".join(run_command("methods", "interior-point").out.split())
    assert "all of them once parameters move by less than `warm_up`" in reference
    assert "under [solver.reduced-space]" in told


def test_an_unknown_method_is_refused():
    outcome = run_command("methods", "interior")
    assert outcome.code == 2
    assert "NAME: found 'interior'" in outcome.err
    assert "did you mean 'interior-point'?" in outcome.err
