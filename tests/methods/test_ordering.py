"""The choice of MUMPS's ordering by its analysis."""

from __future__ import annotations

from pathlib import Path

import pytest
from kit.problems import GUESS, hung_cube, measured

from collocation_sysid.common.isolated_process import Failed
from collocation_sysid.methods import interior_point, nlpsol, ordering
from collocation_sysid.methods.condensed_program import condense
from collocation_sysid.methods.interior_point import InteriorPoint
from collocation_sysid.methods.ordering import METIS, QAMD, cheaper_ordering
from collocation_sysid.problem import Problem
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.program.lifted.collocation import with_lifted_variables

PROBLEMS = Path(__file__).parents[2] / "problems"


# Factorisations with QAMD take 0.7 and 1.4 times those with METIS (docs/howto/optimal_control.md).
@pytest.mark.long
@pytest.mark.parametrize(("name", "expected"), [("foam_cylinder", QAMD), ("table1", METIS)])
def test_the_ordering_with_fewer_operations_is_chosen(name: str, expected: int):
    program = Problem.read(PROBLEMS / name / "problem.toml").collocation()
    assert cheaper_ordering(condense(with_lifted_variables(program))) == expected


def test_the_analysis_sees_one_dof_of_each_node(monkeypatch):
    seen = {}

    def analyse(_: str, **arrays) -> dict:
        seen.update(arrays)
        return {"operations": [2.0, 1.0]}

    monkeypatch.setattr(ordering, "LEAST_ROWS", 0)
    monkeypatch.setattr(ordering, "run_isolated", analyse)
    program = Collocation([measured(hung_cube())], GUESS)
    assert cheaper_ordering(program) == QAMD
    transcription = program.transcriptions[0]
    free = len(transcription.dynamics.t_s) * len(transcription.experiment.free_dofs)
    assert len(seen["indptr"]) - 1 <= program.nq + 2 * free / 3


@pytest.mark.parametrize(
    ("stated", "expected"),
    [({}, QAMD), ({"ipopt": {"mumps_pivot_order": 3}}, 3), ({"linear_solver": "spral"}, None)],
)
def test_a_stated_ordering_is_used(stated: dict, expected: int | None, monkeypatch):
    used = []

    def create(plugin: str, functions, settings):
        used.append(settings.get("ipopt.mumps_pivot_order"))
        return create_solver(plugin, functions, settings)

    create_solver = nlpsol.create_solver
    monkeypatch.setattr(nlpsol, "create_solver", create)
    monkeypatch.setattr(interior_point, "cheaper_ordering", lambda *_: QAMD)
    method = InteriorPoint(initial="simulation", max_iterations=1, **stated)
    method(Collocation([measured(hung_cube())], GUESS))
    assert used == [expected]


def test_the_ordering_of_a_small_program_or_without_an_analysis_is_that_of_metis(monkeypatch):
    def fail(*_, **__):
        raise Failed("killed")

    monkeypatch.setattr(ordering, "run_isolated", fail)
    program = Collocation([measured(hung_cube())], GUESS)
    assert cheaper_ordering(program) == METIS
    monkeypatch.setattr(ordering, "LEAST_ROWS", 0)
    assert cheaper_ordering(program) == METIS
