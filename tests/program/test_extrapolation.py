"""First guesses of time steps by extrapolation of the earlier ones."""

from __future__ import annotations

import numpy as np
import pytest

import collocation_sysid as cs
from collocation_sysid.program.forward.newton_solver import NewtonSolver
from collocation_sysid.program.forward.scheme_simulation import next_value


def test_polynomial_is_continued_exactly() -> None:
    t = np.arange(6.0)[:, None]
    cubic = np.hstack([1 + t, t**2, t**3 - 2 * t])
    assert next_value(cubic[:5]) == pytest.approx(cubic[5], abs=1e-9)


def test_oscillation_from_step_to_step_is_not_extrapolated() -> None:
    values = np.array([[1e-3], [-1e-3]] * 3)
    assert np.abs(next_value(values)) <= 1e-3


def test_one_value_is_repeated() -> None:
    assert next_value(np.array([[2.0, -1.0]])).tolist() == [2.0, -1.0]


@pytest.mark.parametrize("integrator", ["newmark", "bdf2"])
def test_smooth_motion_needs_few_iterations(
    monkeypatch: pytest.MonkeyPatch, integrator: str
) -> None:
    """With the guesses of second order of release 0.4.0 these are 5.8 and 6.0 for each step."""
    count = 0
    step = NewtonSolver.step

    def counted(self: NewtonSolver, *arguments: object) -> np.ndarray:
        nonlocal count
        count += 1
        return step(self, *arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(NewtonSolver, "step", counted)
    t_s = np.arange(101) / 1000
    body = cs.Body(cs.box_mesh((0.03, 0.03, 0.09), (1, 1, 3)), density_kg_m3=1000.0)
    sway_m = np.outer(0.03 * (1 - np.cos(20 * t_s)), [1.0, 0.5, 0.3])
    poses = cs.PoseSequence(t_s, sway_m, np.tile([0.0, 0.0, 0.0, 1.0], (101, 1)))
    grasp = cs.Grasp(np.flatnonzero(body.nodes_m[:, 2] > 0.089), poses)
    markers = cs.Markers(t_s, np.zeros((101, 1, 3)), 1e-4, places_m=[[0.0, 0.0, 0.0]])
    swing = cs.Experiment(body, t_s, [grasp], markers)
    truth = {"young_pa": 2e4, "poisson": 0.4, "gamma_r_s": 5e-3, "gamma_m_1_s": 0.1}
    cs.simulate(swing, truth, integrator, substeps=1)
    assert count < 4.5 * 100
