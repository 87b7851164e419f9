"""Simulations of motions with impacts that begin near a known one."""

import numpy as np
import pytest

import collocation_sysid as cs
from collocation_sysid.methods.horizon import Horizon
from collocation_sysid.program.forward.newton_solver import NewtonSolver

EDGE_M = 0.04
TRUTH = {"young_pa": 1e5, "poisson": 0.3, "gamma_r_s": 0.004, "gamma_m_1_s": 0.1}


def falling_block() -> Horizon:
    """A block that falls by 10 mm on a plane, and rebounds."""
    body = cs.Body(cs.box_mesh((EDGE_M,) * 3, (1, 1, 1)), density_kg_m3=1000.0, element="tet10")
    t_s = np.arange(21) / 240
    floor = cs.Obstacle(shape=cs.Plane((0, 0, 1), (0, 0, -0.01)), friction=0.3, name="floor")
    corners_m = body.nodes_m[:8]
    seen = cs.Markers(t_s, np.zeros((len(t_s), 8, 3)), 1e-3, places_m=corners_m)
    fall = cs.Experiment(
        body, t_s, [floor], seen, start="undeformed", air_density_kg_m3="none",
        nuisance=cs.Nuisance.none(),
    )  # fmt: skip
    fall = cs.with_markers(fall, cs.simulate(fall, TRUTH, "bdf2", substeps=8).markers_m)
    unknown = {"young_pa": cs.Unknown(TRUTH["young_pa"])}
    problem = cs.Problem([fall], TRUTH | unknown, scheme="bdf2", substeps=8)
    collocation = problem.collocation()
    return Horizon(collocation, [each.grid_times for each in collocation.transcriptions])


@pytest.mark.long
def test_trials_with_impacts_are_exact_and_take_few_factorisations(monkeypatch):
    horizon = falling_block()
    p = horizon.collocation.guess_p
    first, _ = horizon.simulate(p)
    point = horizon.evaluate(p, first)
    counts = []
    factorise = NewtonSolver.factorise

    def counted(self, *args, **kwargs):
        counts.append(1)
        return factorise(self, *args, **kwargs)

    monkeypatch.setattr(NewtonSolver, "factorise", counted)
    from_start, _ = horizon.simulate(p + 1e-3)
    count = len(counts)
    counts.clear()
    near, failure = horizon.simulate(p + 1e-3, guess=point)
    assert failure is None
    assert len(counts) < 0.3 * count
    assert np.abs(near[0].x - from_start[0].x).max() < 1e-6 * EDGE_M
    # Losses of trials are compared: their motions are more exact than those of a start.
    trial = horizon.evaluate(p + 1e-3, near)
    assert trial.feasibility_m < 1e-2 * point.feasibility_m
