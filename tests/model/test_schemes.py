"""Time discretisation schemes: coefficients, orders and stability."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from kit.checks import observed_order
from kit.problems import TRUTH, as_theta, box, hung_cube, nodes_where, smooth_poses, vertex_markers

from collocation_sysid.errors import InputError
from collocation_sysid.fem.schemes import SCHEMES, STATIC, as_scheme
from collocation_sysid.program.simulation import simulate
from collocation_sysid.recording import Experiment, Grasp

# Tables; `kit.scheme_check` checks their coefficients


def test_row_zero_is_the_static_problem():
    scheme = as_scheme("midpoint")
    assert scheme.stencil(0) is STATIC
    assert scheme.stencil(1) is scheme.start[0]
    assert scheme.stencil(2) is scheme.stencil(99) is scheme.regular


@pytest.mark.parametrize(("name", "reach"), [("backward-euler", 2), ("midpoint", 2), ("bdf2", 4)])
def test_reach_is_the_oldest_point_in_a_row(name: str, reach: int):
    assert SCHEMES[name].largest_lag == reach


# Looking up


def test_unknown_scheme_lists_those_there_are():
    with pytest.raises(InputError, match=r"no scheme 'rk4'.*backward-euler, midpoint, bdf2"):
        as_scheme("rk4")


def test_unknown_start_rule_lists_those_there_are():
    with pytest.raises(InputError, match=r"no start rule 'soft'.*standard, paper"):
        as_scheme("midpoint", "soft")


@pytest.mark.parametrize("name", ["midpoint", "bdf2"])
def test_the_papers_start_rule_belongs_to_backward_euler(name: str):
    with pytest.raises(
        InputError, match=r"'paper' and scheme .*; expected .* scheme 'backward-euler'"
    ):
        as_scheme(name, "paper")


def test_the_papers_start_rule_drops_the_first_inertia_only():
    paper, standard = (as_scheme("backward-euler", "paper"), as_scheme("backward-euler"))
    assert paper.regular == standard.regular
    assert paper.stencil(1) == replace(standard.stencil(1), s=(0.0, 0.0), r=0.0)


def test_the_papers_first_step_balances_forces_without_inertia():
    experiment = hung_cube(steps=6, start="undeformed", start_rule="paper")
    positions = simulate(experiment, TRUTH, "backward-euler", substeps=1).positions_m
    velocity = (positions[1] - positions[0]) / experiment.timestep_s
    force = experiment.body.force(positions[1], velocity, as_theta(TRUTH)).reshape(-1, 3)
    weight = experiment.body.node_mass[:, None] * experiment.gravity_m_s2
    largest = np.abs(weight).max()
    assert np.abs((force + weight).ravel()[experiment.free_dofs]).max() < 1e-8 * largest


# Measured order

DURATION_S = 0.08
COARSE_STEPS = (20, 40, 80)
FINE_STEPS = 640


def swung_bar(steps: int, start: str) -> Experiment:
    """A bar of 16 nodes; its poses come from their formula at the finest step in use."""
    body = box((0.04, 0.04, 0.12), (1, 1, 3))
    t_s, fine_s = (np.linspace(0, DURATION_S, n + 1) for n in (steps, FINE_STEPS))
    grasp = Grasp(nodes_where(body, 2, 0.0), smooth_poses(fine_s, angular_frequency_rad_s=30.0))
    markers = vertex_markers(body, nodes_where(body, 2, 0.12), t_s)
    gravity = np.array([0.0, 0.0, 9.81])
    return Experiment(body, t_s, [grasp], markers, gravity, start=start)  # type: ignore[arg-type]


@cache
def reference_m(start: str) -> np.ndarray:
    """Newmark's positions at the finest step."""
    bar = swung_bar(COARSE_STEPS[0], start)
    return simulate(bar, TRUTH, timestep_s=DURATION_S / FINE_STEPS).positions_m


def measured_order(start: str, solve: Callable[[Experiment], np.ndarray]) -> float:
    """Log-log slope of the largest error at the coarsest grid's times, against fine Newmark."""
    errors = []
    for steps in COARSE_STEPS:
        positions = solve(swung_bar(steps, start))[:: steps // COARSE_STEPS[0]]
        errors.append(np.abs(positions - reference_m(start)).max())
    return observed_order(DURATION_S / np.array(COARSE_STEPS), np.array(errors))


@pytest.mark.parametrize("start", ["equilibrium", "undeformed"])
@pytest.mark.parametrize("name", SCHEMES)
def test_schemes_converge_with_their_order(name: str, start: str):
    order = measured_order(start, lambda e: simulate(e, TRUTH, name, substeps=1).positions_m)
    assert order == pytest.approx(SCHEMES[name].order, abs=0.15)


@pytest.mark.parametrize("start", ["equilibrium", "undeformed"])
def test_newmark_converges_with_second_order(start: str):
    order = measured_order(start, lambda e: simulate(e, TRUTH, timestep_s=e.timestep_s).positions_m)
    assert order == pytest.approx(2, abs=0.15)


def test_substeps_refine_the_grid_between_samples():
    coarse, fine = swung_bar(20, "equilibrium"), swung_bar(80, "equilibrium")
    refined = simulate(coarse, TRUTH, "midpoint", substeps=4).positions_m
    np.testing.assert_allclose(
        refined, simulate(fine, TRUTH, "midpoint", substeps=1).positions_m[::4], atol=1e-12
    )
