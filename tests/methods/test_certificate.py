"""Conditions of optimality at solutions of the complete program."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from kit.lifted import of_branches, swung
from kit.memories import ONE
from kit.problems import GUESS, hung_cube, measured, noisy

from collocation_sysid.methods.horizon import Horizon
from collocation_sysid.methods.interior_point import InteriorPoint, certify
from collocation_sysid.methods.solution import Status
from collocation_sysid.model.parameters import Unknown
from collocation_sysid.problem import Problem
from collocation_sysid.program.collocation import Collocation


def certified(collocation: Collocation, method=None):
    solution = (method or InteriorPoint())(collocation)
    return solution, certify(solution.collocation, solution.z, solution.multipliers)


def test_curvatures_of_exact_data_are_the_information_of_the_sweeps():
    """Without residuals the Hessian of the loss is that of Gauss–Newton."""
    solution, certificate = certified(Collocation([measured(hung_cube())], GUESS))
    collocation = solution.collocation
    p, positions = collocation.unpack(solution.z)
    rows = [each.grid_times for each in collocation.transcriptions]
    fit = Horizon(collocation, rows).evaluate(p, positions).fit
    expected = 2 * collocation.loss_scale * np.linalg.eigvalsh(fit.information)
    np.testing.assert_allclose(certificate.curvatures, expected, rtol=1e-5)
    assert certificate.is_strict_minimum
    assert max(certificate.stationarity, certificate.feasibility) < 1e-7
    assert solution.notes[-1] == certificate.sentence
    assert "4 free parameters is positive definite: a strict local minimum" in certificate.sentence


def test_the_hessian_contains_the_curvature_of_noisy_data():
    """The gradient of the loss along the equations of motion has the Hessian as its difference."""
    collocation = Collocation([noisy(hung_cube(8))], GUESS)
    solution, certificate = certified(collocation)
    assert certificate.is_strict_minimum
    step = 1e-4
    collocation = solution.collocation
    p, positions = collocation.unpack(solution.z)
    rows = [each.grid_times for each in collocation.transcriptions]

    def loss_at(change):
        moved = p + change
        horizon = Horizon(collocation, rows)
        x = positions
        for _ in range(6):  # Newton's method on the equations of motion
            iterate = horizon.evaluate(moved, x)
            x = [each.x + each.step for each in iterate.trajectories]
        return collocation.objective(collocation.pack(moved, x))

    hessian = np.zeros((len(p), len(p)))
    for i in range(len(p)):
        for j in range(len(p)):
            a, b = np.eye(len(p))[i] * step, np.eye(len(p))[j] * step
            corners = loss_at(a + b) - loss_at(a - b) - loss_at(b - a) + loss_at(-a - b)
            hessian[i, j] = corners / (4 * step**2)
    is_free = np.abs(solution.q - collocation.parameters.bounds_q[0]) > 1e-6
    assert is_free.tolist() == [True, True, True, False]  # γ_m ends at its bound
    expected = np.linalg.eigvalsh(hessian[np.ix_(is_free, is_free)])
    np.testing.assert_allclose(certificate.curvatures, expected, rtol=1e-3)


def test_lifted_memory_is_part_of_the_hessian():
    made = swung(of_branches(1), ONE, 12)
    unknown = {"mu_pa": Unknown(200.0), "prony_1.share": Unknown(0.3)}
    solution, certificate = certified(Problem([made], ONE | unknown, substeps=1).collocation())
    p, positions = solution.collocation.unpack(solution.z)
    rows = [each.grid_times for each in solution.collocation.transcriptions]
    fit = Horizon(solution.collocation, rows).evaluate(p, positions).fit
    expected = 2 * solution.collocation.loss_scale * np.linalg.eigvalsh(fit.information)
    np.testing.assert_allclose(certificate.curvatures, expected, rtol=1e-4)


@pytest.mark.long
def test_the_limit_of_time_ends_an_iteration_that_does_not_return():
    released = threading.Event()

    def wait(line):
        if line.number:
            released.wait(30)

    collocation = Collocation([measured(hung_cube(8))], GUESS)
    method = InteriorPoint(initial="simulation", max_time_s=0.5)
    solution = method(collocation, wait)
    released.set()
    assert solution.status is Status.TIME_LIMIT
    assert np.isfinite(solution.z).all()
