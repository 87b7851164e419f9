"""Measured wrenches as lifted variables: equations and solutions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from kit.lifted import explicit, of_branches
from kit.lifted_wrenches import ALL_UNKNOWN, free_density, weighed
from kit.memories import ONE, guesses
from kit.problems import GUESS, TRUTH, hung_cube
from kit.static import ELASTIC_ONLY, HANGING, block
from kit.wrenches import sensed, sensing, wristed_cube

from collocation_sysid.methods.comparison.casadi_nlp import SqpMethod
from collocation_sysid.methods.comparison.penalty import AugmentedLagrangian, Penalty
from collocation_sysid.methods.interior_point import InteriorPoint
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.methods.solution import Solution
from collocation_sysid.program.collocation import Collocation, convert_variables
from collocation_sysid.program.lifted.collocation import lifted_count
from collocation_sysid.program.simulation import simulate, with_markers, with_wrenches
from collocation_sysid.program.wrench_residual import WrenchResidual
from collocation_sysid.recording import Experiment, Nuisance


def test_the_equations_hold_where_the_wrench_follows_from_the_motion(rng):
    collocation = Collocation([wristed_cube(6, ALL_UNKNOWN, frame="grasp")], GUESS)
    program, p = explicit(collocation), collocation.guess_p
    p[collocation.nq :] = 0.1
    positions = [np.tile(s.body.nodes_m.ravel(), (s.grid_times, 1)) for s in program.transcriptions]
    positions[0] += 1e-3 * rng.normal(size=positions[0].shape)
    z, given = program.pack(p, positions), collocation.pack(p, positions)
    rows = program.constraint_values(z)[collocation.constraint_count :]
    np.testing.assert_allclose(rows, 0.0, atol=1e-13)
    assert program.objective(z) == pytest.approx(collocation.objective(given), rel=1e-12)
    np.testing.assert_allclose(convert_variables(z, program, collocation), given, rtol=1e-14)
    (sensor,) = collocation.transcriptions[0].residuals_of(WrenchResidual)
    of_reactions = 7 * len(sensor.observable.node_dofs)
    assert lifted_count(program, "reaction") == 12 * sensor.observable.count + of_reactions


# What methods find ------------------------------------------------------------------------------


def noisy(experiment: Experiment, seed: int = 0) -> Experiment:
    """The experiment with noise of a tenth of what its sigmas say, so that there is a residual."""
    rng, tracks = np.random.default_rng(seed), experiment.markers.positions_m
    seen = with_markers(experiment, tracks + 1e-4 * rng.normal(size=tracks.shape))
    felt = [grasp.wrench for grasp in experiment.grasps if grasp.wrench is not None]
    values = [w.values + 0.1 * w.value_sigmas * rng.normal(size=w.values.shape) for w in felt]
    return with_wrenches(seen, values)


def pressed() -> Experiment:
    """The block pressed at several heights, with the wrenches of both platens."""
    static = sensing(block("xyz", gravity_m_s2=HANGING))
    found = simulate(static, TRUTH)
    return with_wrenches(with_markers(static, found.markers_m), found.wrenches)


def remembered() -> Experiment:
    """A cube with a memory, in a hand with a sensor."""
    cube = sensing(replace(hung_cube(12, (1, 1, 2)), body=of_branches(1)))
    found = simulate(cube, ONE, "midpoint", substeps=1)
    return with_wrenches(with_markers(cube, found.markers_m), found.wrenches)


TARED = Nuisance.none(tare=10.0, tool_kg=0.01, sensor_lag_s=0.005)
PROBLEMS: dict[str, Callable[[], Collocation]] = {
    "density": lambda: Collocation([weighed(noisy(sensed(wristed_cube(8))))], free_density()),
    "static": lambda: Collocation([noisy(pressed())], ELASTIC_ONLY),
    "memory": lambda: Collocation([noisy(remembered())], guesses(ONE, 1.1)),
    "sensor": lambda: Collocation([noisy(sensed(wristed_cube(8, TARED)))], GUESS),
}


@cache
def problem(name: str) -> tuple[Collocation, Solution]:
    """One of them, and what reduced space finds."""
    collocation = PROBLEMS[name]()
    return collocation, ReducedSpace(tolerance=1e-10)(collocation)


METHODS = [
    *((name, InteriorPoint(tolerance=1e-10), 1e-6) for name in PROBLEMS),
    ("memory", InteriorPoint(hessian="gauss-newton"), 1e-5),
    ("sensor", SqpMethod(), 1e-5),
    ("density", AugmentedLagrangian(tolerance=1e-4), 1e-4),
    ("static", Penalty(inner="levenberg-marquardt", rho=1e6, tolerance=1e-4), 1e-2),
]


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "method", "tolerance"), METHODS, ids=lambda given: getattr(given, "name", str(given))
)
def test_methods_find_the_optimum_of_reduced_space(name: str, method, tolerance: float):
    collocation, expected = problem(name)
    found = method(collocation)
    assert found.status.converged, found.message
    assert found.collocation is collocation
    for parameter, value in expected.parameters.items():
        assert found.parameters[parameter] == pytest.approx(value, rel=tolerance), parameter
    assert found.max_violation_relative < max(1e-6, tolerance)


def test_the_multipliers_are_those_of_the_program_given():
    collocation, expected = problem("sensor")
    found = InteriorPoint(tolerance=1e-10)(collocation)
    assert found.kkt_residual < 1e-7
    scale = np.abs(expected.multipliers).max()
    np.testing.assert_allclose(found.multipliers, expected.multipliers, atol=1e-4 * scale)
