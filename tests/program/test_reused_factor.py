"""Factors reused for several time steps: solutions as accurate, with fewer factorisations."""

from __future__ import annotations

import numpy as np
import pytest
from kit.internal_force_check import full_matrix
from kit.problems import (
    GUESS,
    TRUTH,
    as_theta,
    box,
    hung_cube,
    measured,
    noisy,
    with_papers_damping,
)
from scipy.spatial.transform import Rotation

from collocation_sysid import Problem, Unknown, simulate
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.program.forward import newton_solver
from collocation_sysid.program.forward.scheme_simulation import simulate_scheme
from collocation_sysid.program.linear_algebra import factorisation, reused_factor
from collocation_sysid.program.linear_algebra.factorisation import Factoriser
from collocation_sysid.program.linear_algebra.reused_factor import (
    FactorSequence,
    Matrix,
    NodeRotation,
    ReusedFactor,
    best_rotation,
)
from collocation_sysid.program.sweep import Sweep
from collocation_sysid.runs.solving import solve

BODY = box((0.1, 0.1, 0.1), (3, 3, 3))
# Nodes of the lowest layer are held, and one more coordinate of the next node.
FREE = np.arange(3 * 16 + 1, BODY.pattern.size)
AXIS = np.array([0.3, -0.5, 0.8])


@pytest.fixture(autouse=True)
def _forget_analyses():
    factorisation._cached_analysis.cache_clear()
    yield
    factorisation._cached_analysis.cache_clear()


@pytest.fixture
def wide(monkeypatch):
    """All bodies are treated as large ones: in single precision, with factors that are reused."""
    monkeypatch.setattr(factorisation, "NARROW", 0)
    monkeypatch.setattr("collocation_sysid.program.sweep.LEAST_COST_OF_FACTOR", 0.0)
    monkeypatch.setattr(newton_solver, "LEAST_COST_OF_FACTOR", 0.0)


def rotated_points(angle_rad: float) -> np.ndarray:
    return BODY.nodes_m @ Rotation.from_rotvec(angle_rad * AXIS).as_matrix().T


def matrix_at(points_m: np.ndarray, skew: float = 0.0, mass: float = 20.0) -> Matrix:
    """Matrix of a time step at positions of the nodes, with a random skew part of a given size."""
    theta = BODY.theta_from_values(TRUTH)
    at = BODY.linearise(points_m.reshape(-1), np.zeros(points_m.size), theta)
    values = -np.asarray(at.by_position).reshape(-1)
    values = values[: BODY.pattern.entry_count].copy()
    values[BODY.pattern.diagonal] += mass
    parts = np.zeros(0)
    if skew:
        parts = skew * np.random.default_rng(1).normal(size=values.size)
        parts[BODY.pattern.diagonal] = 0.0
    return Matrix(values, parts)


def sequence(accuracy: float = 1e-10) -> FactorSequence:
    return FactorSequence(
        Factoriser(BODY.pattern, FREE, "band"),
        NodeRotation(FREE, len(BODY.nodes_m)),
        accuracy=accuracy,
    )


def dense(matrix: Matrix) -> np.ndarray:
    complete = full_matrix(BODY.pattern, matrix.values, matrix.skew)
    return complete.toarray()[np.ix_(FREE, FREE)]


def test_a_rotation_and_a_translation_are_recovered():
    turn = Rotation.from_rotvec(AXIS)
    moved = turn.apply(np.array(BODY.nodes_m)) + np.arange(3.0)
    assert best_rotation(BODY.nodes_m, moved) == pytest.approx(turn.as_matrix(), abs=1e-12)
    flat = BODY.nodes_m * [1.0, 1.0, 0.0]
    assert np.linalg.det(best_rotation(flat, -flat)) == pytest.approx(1.0)


@pytest.mark.parametrize("first", [48, 49])
def test_free_dofs_rotate_by_node(rng, first: int):
    free = np.arange(first, BODY.pattern.size)
    turn = Rotation.from_rotvec(AXIS).as_matrix()
    columns = rng.normal(size=(len(free), 2))
    complete = np.zeros((BODY.pattern.size, 2))
    complete[free] = columns
    expected = np.kron(np.eye(len(BODY.nodes_m)), turn) @ complete
    rotation = NodeRotation(free, len(BODY.nodes_m))
    assert rotation.apply(turn, columns) == pytest.approx(expected[free])


@pytest.mark.parametrize("skew", [0.0, 0.3])
@pytest.mark.parametrize("transposed", [False, True])
@pytest.mark.parametrize("accuracy", [1e-4, 1e-10])
def test_systems_of_a_rotating_body_are_solved_with_few_factors(
    monkeypatch, rng, skew: float, transposed: bool, accuracy: float
):
    monkeypatch.setattr(factorisation, "NARROW", 0)
    # As for a large body, whose factorisations cost much.
    monkeypatch.setattr(reused_factor, "BAND_COST_PER_ENTRY", 1.0)
    factors = sequence(accuracy)
    guess = None
    for angle_rad in np.linspace(0.0, 0.6, 13):
        points_m = rotated_points(angle_rad)
        matrix = matrix_at(points_m, skew=skew)
        right = rng.normal(size=(len(FREE), 3))
        right[:, 1] = 0.0
        right[:, 2] *= 1e-30
        factor = ReusedFactor(factors, matrix, points_m=points_m)
        complete = dense(matrix)
        expected = np.linalg.solve(complete.T if transposed else complete, right)
        for start in (None, guess):
            solution = factor.solve(right, transposed=transposed, guess=start)
            for k in range(3):
                limit = accuracy * np.abs(expected[:, k]).max()
                assert np.abs(solution - expected)[:, k].max() <= limit
        assert factor.positive_definite
        vector = factor.solve(right[:, 0], transposed=transposed)
        assert vector.shape == (len(FREE),)
        guess = expected
    assert factors.factorisation_count <= 4


def test_another_matrix_is_factorised_anew(monkeypatch, rng):
    monkeypatch.setattr(factorisation, "NARROW", 0)
    factors = sequence()
    right = rng.normal(size=(len(FREE), 2))
    points_m = rotated_points(0.0)
    for count, mass in enumerate((20.0, 1e6), 1):
        matrix = matrix_at(points_m, mass=mass)
        solution = ReusedFactor(factors, matrix, points_m=points_m).solve(right)
        assert solution == pytest.approx(np.linalg.solve(dense(matrix), right), rel=1e-8)
        assert factors.factorisation_count == count


def test_an_indefinite_matrix_is_solved_and_recognised(monkeypatch, rng):
    monkeypatch.setattr(factorisation, "NARROW", 0)
    factors = sequence()
    right = rng.normal(size=(len(FREE), 2))
    points_m = rotated_points(0.0)
    for mass, is_definite in ((20.0, True), (-15.0, False), (20.0, True)):
        matrix = matrix_at(points_m, mass=mass)
        assert (np.linalg.eigvalsh(dense(matrix))[0] > 0) == is_definite
        factor = ReusedFactor(factors, matrix, points_m=points_m)
        solution = factor.solve(right)
        expected = np.linalg.solve(dense(matrix), right)
        assert solution == pytest.approx(expected, abs=1e-9 * np.abs(expected).max())
        assert factor.positive_definite == is_definite


def test_a_matrix_that_is_not_finite_is_refused(monkeypatch):
    monkeypatch.setattr(factorisation, "NARROW", 0)
    points_m = rotated_points(0.0)
    matrix = matrix_at(points_m)
    matrix.values[5] = np.nan
    factor = ReusedFactor(sequence(), matrix, points_m=points_m)
    with pytest.raises(np.linalg.LinAlgError, match="not finite"):
        factor.solve(np.ones(len(FREE)))


@pytest.mark.parametrize("damping", ["rayleigh", "kelvin-voigt"])
def test_sweeps_and_simulations_agree_with_a_factor_for_each_step(request, damping: str):
    experiment = hung_cube(16)
    if damping == "rayleigh":
        experiment = with_papers_damping(experiment)
    collocation = Collocation([measured(experiment)], GUESS)
    (transcription,) = collocation.transcriptions
    dynamics = transcription.dynamics.with_theta(as_theta(TRUTH))
    x = simulate_scheme(transcription.experiment, dynamics)
    free = transcription.free_dofs
    disturbance = np.sin(np.arange(x[1:, free].size)).reshape(len(x) - 1, -1)
    x[1:, free] += 1e-4 * disturbance
    (part,) = collocation.iterates(collocation.pack(collocation.guess_p, [x]))
    x = part.x
    gradient = np.cos(np.arange(x.size)).reshape(x.shape)
    direct = Sweep(transcription)
    assert not direct.reuses_factors
    expected = direct.forward(x, part.equations)
    expected_y = direct.backward(x, part.equations, gradient)
    simulated = simulate(experiment, TRUTH)
    factorisation._cached_analysis.cache_clear()
    request.getfixturevalue("wide")
    solver = Sweep(transcription, factorisation="band")
    assert solver.reuses_factors
    for similar in (None, expected):
        result = solver.forward(x, part.equations, similar=similar)
        for name in ("step", "by_p"):
            values = getattr(expected, name)
            assert getattr(result, name) == pytest.approx(values, abs=1e-8 * np.abs(values).max())
        assert result.indefinite_count == expected.indefinite_count
    y = solver.backward(x, part.equations, gradient)
    assert y == pytest.approx(expected_y, abs=1e-8 * np.abs(expected_y).max())
    again = simulate(experiment, TRUTH)
    assert again.positions_m == pytest.approx(simulated.positions_m, abs=1e-11)


def test_the_answer_of_a_large_body_is_the_same(request):
    problem = Problem(
        [noisy(hung_cube(16, divisions=(4, 4, 4)))], {name: Unknown() for name in TRUTH}
    )
    options = {"coarse_start_nodes": 60, "coarse_start_tolerance": 1e-10}
    direct = ReducedSpace(coarse_start=False, tolerance=1e-10)
    expected = solve(problem, direct)
    request.getfixturevalue("wide")
    for method in (direct, ReducedSpace(tolerance=1e-10, **options)):
        solution = solve(problem, method)
        assert solution.status.converged
        assert solution.q == pytest.approx(expected.q, abs=1e-7)
        assert solution.z == pytest.approx(expected.z, abs=1e-7)
