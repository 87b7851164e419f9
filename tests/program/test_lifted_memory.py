"""Material memory as lifted variables: recursion and solutions."""

from __future__ import annotations

import numpy as np
import pytest
from kit.checks import relative_error
from kit.lifted import REGIONS, explicit, of_branches, of_regions, swung
from kit.memories import ONE, guesses, recorded, truth
from kit.problems import GUESS, hung_cube, with_markers

from collocation_sysid.methods.comparison.casadi_nlp import SqpMethod
from collocation_sysid.methods.comparison.penalty import AugmentedLagrangian, Penalty
from collocation_sysid.methods.interior_point import InteriorPoint
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.methods.solution import Solution
from collocation_sysid.program.collocation import Collocation, convert_variables
from collocation_sysid.program.lifted.collocation import with_lifted_variables


def fitted(branches: int, steps: int, noise_m: float = 0.0) -> Collocation:
    """All parameters of such a body from its swing."""
    experiment = swung(of_branches(branches), truth(branches), steps)
    tracks = experiment.markers.positions_m
    noise = noise_m * np.random.default_rng(0).normal(size=tracks.shape)
    return Collocation([with_markers(experiment, tracks + noise)], guesses(truth(branches), 1.2))


def test_the_recursion_holds_where_the_memory_follows_from_the_motion():
    collocation = fitted(2, 4)
    program = explicit(collocation)
    p = collocation.guess_p
    positions = [np.tile(s.body.nodes_m.ravel(), (s.grid_times, 1)) for s in program.transcriptions]
    positions[0] *= 1 + 0.1 * np.random.default_rng(0).random(positions[0].shape)
    z, given = program.pack(p, positions), collocation.pack(p, positions)
    rows = program.constraint_values(z)
    np.testing.assert_allclose(rows[collocation.constraint_count :], 0.0, atol=1e-14)
    np.testing.assert_allclose(
        rows[: collocation.constraint_count], collocation.constraint_values(given), atol=1e-12
    )
    np.testing.assert_allclose(convert_variables(z, program, collocation), given, rtol=1e-14)
    assert with_lifted_variables(Collocation([hung_cube(3)], GUESS)).variable_count < len(z)


# What methods find ------------------------------------------------------------------------------


def assert_same(found: Solution, expected: Solution, tolerance: float) -> None:
    assert found.status.converged, found.message
    for name, value in expected.parameters.items():
        assert found.parameters[name] == pytest.approx(value, rel=tolerance), name


@pytest.mark.long
@pytest.mark.parametrize(("branches", "noise_m"), [(2, 0.0), (1, 1e-4)])
def test_interior_point_finds_the_optimum_of_reduced_space(branches: int, noise_m: float):
    collocation = fitted(branches, 16, noise_m)
    expected = ReducedSpace(tolerance=1e-10)(collocation)
    found = InteriorPoint(tolerance=1e-10)(collocation)
    assert_same(found, expected, 1e-6)
    assert found.kkt_residual < 1e-9
    assert found.collocation is collocation
    assert relative_error(found.z, expected.z) < 1e-6
    np.testing.assert_allclose(found.multipliers, expected.multipliers, atol=1e-7)
    assert found.max_violation_relative < 1e-8


@pytest.mark.long
def test_regions_with_branches_of_their_own_are_distinguished():
    collocation = Collocation([swung(of_regions(), REGIONS, 16)], guesses(REGIONS, 1.2))
    found = InteriorPoint(tolerance=1e-10)(collocation)
    assert_same(found, ReducedSpace(tolerance=1e-10)(collocation), 1e-6)
    for name, value in REGIONS.items():
        assert found.parameters[name] == pytest.approx(value, rel=1e-5), name


EXACT = InteriorPoint(tolerance=1e-10)
METHODS = [
    ("undeformed", EXACT, 1e-5),
    ("loaded", EXACT, 1e-5),
    ("let-go", EXACT, 1e-5),
    ("relaxed", InteriorPoint(hessian="gauss-newton"), 1e-4),
    ("relaxed", SqpMethod(), 1e-4),
    ("relaxed", AugmentedLagrangian(tolerance=1e-9), 1e-3),
]


@pytest.mark.parametrize(
    ("kind", "method", "tolerance"), METHODS, ids=lambda given: getattr(given, "name", str(given))
)
def test_methods_that_see_the_whole_program_find_the_truth(kind: str, method, tolerance: float):
    if kind == "let-go":
        experiment = recorded("bar-let-go", 8)
    else:
        start = "undeformed" if kind == "undeformed" else "equilibrium"
        changes = {"loaded_since_s": 0.04} if kind == "loaded" else {}
        experiment = swung(of_branches(1), ONE, 10, start=start, **changes)
    found = method(Collocation([experiment], guesses(ONE, 1.2)))
    assert found.status.converged, found.message
    for name, value in ONE.items():
        assert found.parameters[name] == pytest.approx(value, rel=tolerance), name


def test_a_penalty_leaves_little_slack_in_the_memory_too():
    found = Penalty(inner="levenberg-marquardt", rho=1e4)(fitted(1, 10))
    assert found.status.converged, found.message
    assert found.max_violation_relative < 1e-3
