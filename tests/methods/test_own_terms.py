"""Own residuals and equality constraints of an identification, in both solvers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import casadi as ca
import pytest
from kit.problems import TRUTH, hung_cube, measured, noisy

import collocation_sysid as cs


def distance(at) -> ca.SX:
    return ca.norm_2(at.position_m[:, 1] - at.position_m[:, 0])


def volume_cm3(at) -> ca.SX:
    """Volume of a tetrahedron of four nodes."""
    first, second, third = (at.position_m[:, k] - at.position_m[:, 0] for k in (1, 2, 3))
    return 1e6 * ca.dot(first, ca.cross(second, third)) / 6


@pytest.mark.parametrize(("function", "sigma"), [(distance, 1e-7), (volume_cm3, 1e-4)])
def test_an_equality_of_the_motion_leads_both_solvers_to_the_same_answer(
    function: Callable, sigma: float
):
    """Markers with noise of 0.1 mm alone miss the constants by more than ten times as much."""
    recorded = measured(hung_cube(10))
    corners = recorded.body.nodes_m[recorded.body.mesh.tetrahedra[0]]
    blank = cs.Gauge("own", function, recorded.t_s, None, sigma, corners)
    (values,) = cs.simulate(
        replace(recorded, readings=(blank,)), TRUTH, "midpoint", substeps=1
    ).custom_sensor_values
    unknown = {name: cs.Unknown(1.5 * TRUTH[name]) for name in ("mu_pa", "gamma_r_s")}
    known = {name: value for name, value in TRUTH.items() if name not in unknown}
    alone = noisy(recorded, 1e-4)
    equal = replace(alone, readings=(replace(blank, values=values),))
    answers = [
        cs.solve(cs.Problem([experiment], known | unknown, substeps=1), method)
        for experiment, method in (
            (alone, cs.ReducedSpace()),
            (equal, cs.ReducedSpace()),
            (equal, cs.InteriorPoint(initial="simulation")),
        )
    ]
    assert all(each.status.converged for each in answers)
    for name in unknown:
        markers, reduced, full = (each.parameters[name] / TRUTH[name] - 1 for each in answers)
        assert abs(markers) > 1e-4
        assert abs(reduced) < 1e-5
        assert abs(full - reduced) < 1e-6
