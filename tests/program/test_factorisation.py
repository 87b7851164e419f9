"""Factorisation of time steps compared with dense and sparse solvers."""

from __future__ import annotations

import threading
from itertools import product

import numpy as np
import pytest
import scipy.sparse as sp
from kit.internal_force_check import full_matrix
from kit.problems import TRUTH, box

from collocation_sysid.errors import InputError
from collocation_sysid.fem.pattern import SymmetricPattern
from collocation_sysid.program.linear_algebra import factorisation
from collocation_sysid.program.linear_algebra.factorisation import NONE, Choice, Factoriser
from collocation_sysid.program.linear_algebra.supernodal import load_mkl

# On a bar the mesh graph is a narrow band; where every node meets every other, it is full.
BAR = box((0.04, 0.04, 0.4), (1, 1, 10))
FULL = SymmetricPattern.from_cells(np.arange(90)[None], 90)
WIDE = SymmetricPattern.from_cells(np.arange(300)[None], 300)
SMALL = SymmetricPattern.from_cells(np.arange(7)[None], 7)
CHOICES: list[tuple[Choice, SymmetricPattern]] = [
    ("band", BAR.pattern),
    ("sparse", BAR.pattern),
    ("auto", FULL),
    ("sparse", FULL),
    ("auto", SMALL),
]
IDS = ["bar-band", "bar-sparse", "full-auto", "full-sparse", "small-auto"]
if load_mkl() is not None:
    CHOICES.extend([("supernodal", each) for each in (BAR.pattern, FULL, SMALL)])
    IDS += ["bar-supernodal", "full-supernodal", "small-supernodal"]


def test_the_bar_is_narrow_and_the_full_matrix_is_not():
    assert Factoriser(BAR.pattern, without_first_nodes(BAR.pattern), "band").skyline
    assert Factoriser(FULL, without_first_nodes(FULL)).skyline is None


def without_first_nodes(pattern: SymmetricPattern) -> np.ndarray:
    return np.arange(12, pattern.size)


def random_values(pattern: SymmetricPattern, shift: float, seed: int = 0) -> np.ndarray:
    """Lower-triangle values of a random symmetric matrix with `shift` on its diagonal."""
    values = np.random.default_rng(seed).normal(size=pattern.entry_count)
    values[pattern.diagonal] += shift
    return values


def kept(pattern: SymmetricPattern, values: np.ndarray, free: np.ndarray) -> np.ndarray:
    return sp.csr_array(pattern.matrix(values)).toarray()[np.ix_(free, free)]


def test_the_band_is_taken_where_cheaper():
    free = without_first_nodes(BAR.pattern)
    assert Factoriser(BAR.pattern, free).is_banded
    # A star: hardly any fill-in, and the widest of bands.
    cells = np.column_stack([np.zeros(1500, int), np.arange(1, 4501).reshape(-1, 3)])
    star = SymmetricPattern.from_cells(cells, 4501)
    factoriser = Factoriser(star, np.arange(star.size))
    assert not factoriser.is_banded
    assert factoriser.estimate_factor_size() < factoriser.half_bandwidth * star.size / 100


@pytest.mark.parametrize("shift", [100.0, 0.5, -100.0])
@pytest.mark.parametrize(("choice", "pattern"), CHOICES, ids=IDS)
def test_factors_solve_for_vectors_and_columns(choice, pattern: SymmetricPattern, shift: float):
    free = without_first_nodes(pattern)
    values = random_values(pattern, shift)
    factor = Factoriser(pattern, free, choice).factorise(values)
    for columns in ((), (0,), (1,), (5,)):
        right = np.random.default_rng(1).normal(size=(len(free), *columns))
        before = right.copy()
        solved = factor.solve(right)
        assert solved.shape == right.shape
        np.testing.assert_array_equal(right, before)
        np.testing.assert_allclose(kept(pattern, values, free) @ solved, right, atol=1e-10)


@pytest.mark.parametrize("shift", [100.0, 0.5, -100.0])
@pytest.mark.parametrize(("choice", "pattern"), CHOICES, ids=IDS)
def test_a_skew_part_is_solved_for_exactly_also_transposed(
    choice, pattern: SymmetricPattern, shift: float
):
    """With a shift of 0.5 rows are exchanged."""
    free = without_first_nodes(pattern)
    values, skew = (random_values(pattern, shift), random_values(pattern, 0.0, seed=3))
    skew[pattern.diagonal] = 0
    symmetric = kept(pattern, values, free)
    matrix = full_matrix(pattern, values, skew).toarray()[np.ix_(free, free)]
    assert not np.allclose(matrix, matrix.T)
    factor = Factoriser(pattern, free, choice).factorise(values, skew)
    for columns, transposed in product(((), (0,), (5,)), (False, True)):
        right = np.random.default_rng(1).normal(size=(len(free), *columns))
        solved = factor.solve(right, transposed)
        assert solved.shape == right.shape
        np.testing.assert_allclose((matrix.T if transposed else matrix) @ solved, right, atol=1e-9)
    if shift == 100.0:
        assert factor.positive_definite == (np.linalg.eigvalsh(symmetric)[0] > 0)


@pytest.mark.parametrize("size", [0.01, 1.0, 1e3, 1e6])
def test_a_skew_part_may_outweigh_the_symmetric_one(size: float):
    """Pivots of a definite matrix are positive whatever its skew part, but they would grow."""
    pattern = BAR.pattern
    free = without_first_nodes(pattern)
    values, skew = (random_values(pattern, 20.0), size * random_values(pattern, 0.0, seed=3))
    skew[pattern.diagonal] = 0
    matrix = full_matrix(pattern, values, skew).toarray()[np.ix_(free, free)]
    right = np.random.default_rng(1).normal(size=(len(free), 2))
    solved = Factoriser(pattern, free, "band").factorise(values, skew).solve(right)
    accurate = np.linalg.solve(matrix, right)
    np.testing.assert_allclose(solved, accurate, atol=1e-12 * np.abs(accurate).max())


@pytest.mark.parametrize("transposed", [False, True], ids=["", "transposed"])
@pytest.mark.parametrize("size", [0.1, 1.0, 100.0], ids=["refined", "slowly", "whole"])
def test_wide_bands_are_solved_with_small_and_large_skew_parts(size: float, transposed: bool):
    free = without_first_nodes(WIDE)
    values, skew = (random_values(WIDE, 100.0), size * random_values(WIDE, 0.0, seed=3))
    skew[WIDE.diagonal] = 0
    matrix = full_matrix(WIDE, values, skew).toarray()[np.ix_(free, free)]
    factoriser = Factoriser(WIDE, free, "band")
    assert factoriser.skyline is None
    factor = factoriser.factorise(values, skew)
    right = np.random.default_rng(1).normal(size=(len(free), 2))
    accurate = np.linalg.solve(matrix.T if transposed else matrix, right)
    solved = factor.solve(right, transposed)
    np.testing.assert_allclose(solved, accurate, atol=1e-10 * np.abs(accurate).max())
    assert factor.positive_definite


@pytest.mark.parametrize("choice", ["band", "sparse"])
@pytest.mark.parametrize("stiffness", [1.0, -1.0])
def test_pivots_of_wide_bands_decide_the_stability_of_sliding(choice, stiffness: float):
    """A pressure that grows along z, and pushes along x by friction: half of that is symmetric."""
    values, skew = np.zeros(WIDE.entry_count), np.zeros(WIDE.entry_count)
    values[WIDE.diagonal] = stiffness
    values[WIDE.diagonal[2::3]] = 1000.0
    pushed = np.flatnonzero((WIDE.rows % 3 == 2) & (WIDE.columns == WIDE.rows - 2))
    values[pushed], skew[pushed] = (250.0, -250.0)  # a force along x, by what z is
    assert len(pushed) == 300
    factor = Factoriser(WIDE, np.arange(WIDE.size), choice).factorise(values, skew)
    assert factor.positive_definite == (stiffness > 0)
    right = np.random.default_rng(3).normal(size=WIDE.size)
    np.testing.assert_allclose(
        full_matrix(WIDE, values, skew) @ factor.solve(right), right, atol=1e-9
    )


@pytest.mark.parametrize(("choice", "shift"), [("sparse", 100.0), ("band", -100.0), ("band", 0.5)])
def test_factors_of_superlu_are_made_on_the_thread_that_frees_them(
    monkeypatch, choice: Choice, shift: float
):
    """SciPy loses their memory otherwise: 20 GB in ten minutes of a search, until the system ended it."""
    threads, splu = set(), factorisation.splu

    def watched(*arguments, **options):
        threads.add(threading.get_ident())
        return splu(*arguments, **options)

    monkeypatch.setattr(factorisation, "splu", watched)
    free = without_first_nodes(WIDE)
    matrices = [random_values(WIDE, 100.0, seed=k) for k in range(3)]
    matrices += [random_values(WIDE, shift, seed=k) for k in range(3, 6)]
    factors = Factoriser(WIDE, free, choice).factorise_each(
        lambda k: (matrices[k], NONE), 6, threads=2
    )
    right = np.ones(len(free))
    for values, factor in zip(matrices, factors, strict=True):
        np.testing.assert_allclose(kept(WIDE, values, free) @ factor.solve(right), right, atol=1e-9)
    assert threads == {threading.get_ident()}


def test_factors_that_live_together_do_not_share_their_memory():
    """Also where memory is given back and taken again."""
    free, right = without_first_nodes(FULL), np.ones(FULL.size - 12)
    for choice in dict(CHOICES):
        factoriser = Factoriser(FULL, free, choice)
        matrices = [random_values(FULL, 100.0, seed) for seed in range(4)]
        factors = [factoriser.factorise(values) for values in matrices[:2]]
        del factors[0]
        factors += [factoriser.factorise(values) for values in matrices[2:]]
        for factor, values in zip(factors, matrices[1:], strict=True):
            solved = factor.solve(right)
            np.testing.assert_allclose(kept(FULL, values, free) @ solved, right, atol=1e-10)


def test_a_solver_that_is_not_installed_is_reported(monkeypatch):
    monkeypatch.setattr(
        "collocation_sysid.program.linear_algebra.supernodal.load_mkl", lambda: None
    )
    with pytest.raises(InputError, match=r"collocation-sysid\[large\]"):
        Factoriser(SMALL, np.arange(7), "supernodal")


def test_a_factor_in_a_room_is_that_of_the_last_matrix_put_there():
    free = without_first_nodes(BAR.pattern)
    factoriser = Factoriser(BAR.pattern, free, "band")
    room, right = factoriser.allocate(sides=2), np.ones(len(free))
    for seed, skewed in enumerate((True, False, True)):
        values = random_values(BAR.pattern, 100.0, seed)
        skew = skewed * random_values(BAR.pattern, 0.0, seed=9)
        skew[BAR.pattern.diagonal] = 0
        solved = factoriser.factorise(values, skew, room).solve(right)
        fresh = factoriser.factorise(values, skew).solve(right)
        np.testing.assert_array_equal(solved, fresh)


@pytest.mark.parametrize("shift", [100.0, 1.0, 0.0, -100.0])
@pytest.mark.parametrize(("choice", "pattern"), CHOICES, ids=IDS)
def test_definiteness_agrees_with_the_eigenvalues(choice, pattern: SymmetricPattern, shift: float):
    free = without_first_nodes(pattern)
    values = random_values(pattern, shift)
    smallest = np.linalg.eigvalsh(kept(pattern, values, free))[0]
    assert Factoriser(pattern, free, choice).factorise(values).positive_definite == (smallest > 0)


def test_a_held_body_at_rest_is_positive_definite_and_its_negative_is_not():
    hung = np.flatnonzero(BAR.nodes_m[:, 2] < 0.39)
    free = (3 * hung[:, None] + np.arange(3)).ravel()
    factoriser = Factoriser(BAR.pattern, free)
    rest = BAR.nodes_m
    theta = (TRUTH["lambda_pa"], TRUTH["mu_pa"], 0.0, 0.0)
    stiffness = -BAR.linearise(rest, np.zeros_like(rest), theta).by_position[0]
    assert factoriser.factorise(stiffness).positive_definite
    assert not factoriser.factorise(-stiffness).positive_definite


def test_one_analysis_serves_many_matrices():
    free = without_first_nodes(FULL)
    factoriser = Factoriser(FULL, free)
    right = np.ones(len(free))
    factors = [factoriser.factorise(random_values(FULL, 100.0, seed)) for seed in range(3)]
    for seed, factor in enumerate(factors):
        matrix = kept(FULL, random_values(FULL, 100.0, seed), free)
        np.testing.assert_allclose(factor.solve(right), np.linalg.solve(matrix, right))


@pytest.mark.parametrize(("choice", "pattern"), CHOICES, ids=IDS)
def test_a_singular_matrix_is_refused(choice, pattern: SymmetricPattern):
    values = random_values(pattern, 100.0)
    values[(pattern.rows == 15) | (pattern.columns == 15)] = 0.0
    with pytest.raises(np.linalg.LinAlgError, match="singular"):
        Factoriser(pattern, without_first_nodes(pattern), choice).factorise(values)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize(("choice", "pattern"), CHOICES, ids=IDS)
def test_numbers_that_are_not_finite_are_refused(choice, pattern: SymmetricPattern, bad: float):
    values = random_values(pattern, 100.0)
    values[-1] = bad
    with pytest.raises(np.linalg.LinAlgError, match="not finite"):
        Factoriser(pattern, without_first_nodes(pattern), choice).factorise(values)


WIDE_CHOICES = ["band"] + ["supernodal"] * (load_mkl() is not None)


@pytest.mark.parametrize("choice", WIDE_CHOICES)
@pytest.mark.parametrize(
    ("columns", "transposed", "skewness"), [(None, False, 0.1), (1, True, 0.0), (5, True, 0.1)]
)
def test_factors_in_single_precision_solve_as_accurately(
    choice, columns: int | None, transposed: bool, skewness: float
):
    free = without_first_nodes(WIDE)
    values = random_values(WIDE, 100.0)
    skew = skewness * random_values(WIDE, 0.0, seed=3)
    skew[WIDE.diagonal] = 0
    matrix = full_matrix(WIDE, values, skew).toarray()[np.ix_(free, free)]
    shape = (len(free),) if columns is None else (len(free), columns)
    right = np.random.default_rng(1).normal(size=shape)
    accurate = np.linalg.solve(matrix.T if transposed else matrix, right)
    factoriser = Factoriser(WIDE, free, choice)
    assert factoriser.has_single_precision
    errors = []
    for accuracy in (1e-10, 1e-2):
        factor = factoriser.factorise(values, skew, is_single=True, accuracy=accuracy)
        assert factor.positive_definite
        solved = factor.solve(right, transposed)
        assert solved.dtype == np.float64
        assert solved.shape == right.shape
        errors.append(np.abs(solved - accurate).max() / np.abs(accurate).max())
    assert errors[0] < 1e-9
    # The rate of the refinement is known from the first factor.
    assert errors[0] < errors[1] < 1e-2


@pytest.mark.parametrize("choice", WIDE_CHOICES)
@pytest.mark.parametrize("is_single", [False, True])
def test_symmetry_is_examined_for_each_matrix(choice, is_single: bool):
    """As under friction, where points stick in one time step and slip in the next."""
    free = without_first_nodes(WIDE)
    values = random_values(WIDE, 100.0)
    skew = 0.1 * random_values(WIDE, 0.0, seed=3)
    skew[WIDE.diagonal] = 0
    right = np.random.default_rng(1).normal(size=len(free))
    factoriser = Factoriser(WIDE, free, choice)
    accuracy = 1e-3
    for size in (1e-12, 1.0):
        factor = factoriser.factorise(values, size * skew, is_single=is_single, accuracy=accuracy)
        matrix = full_matrix(WIDE, values, size * skew).toarray()
        accurate = np.linalg.solve(matrix[np.ix_(free, free)], right)
        error = np.abs(factor.solve(right) - accurate).max()
        assert error < accuracy * np.abs(accurate).max()


@pytest.mark.parametrize("choice", WIDE_CHOICES)
@pytest.mark.parametrize("least", [1e-9, -1e-9])
def test_matrices_beyond_single_precision_are_factorised_in_double(choice, least: float):
    """One eigenvalue is below the rounding of single precision."""
    free = np.arange(WIDE.size)
    vectors = np.linalg.qr(np.random.default_rng(0).normal(size=(WIDE.size, WIDE.size)))[0]
    eigenvalues = np.linspace(1.0, 2.0, WIDE.size)
    eigenvalues[0] = least
    matrix = (vectors * eigenvalues) @ vectors.T
    values = matrix[WIDE.rows, WIDE.columns]
    factor = Factoriser(WIDE, free, choice).factorise(values, is_single=True)
    solution = np.random.default_rng(1).normal(size=WIDE.size)
    np.testing.assert_allclose(factor.solve(matrix @ solution), solution, atol=1e-4)


def test_narrow_bands_keep_double_precision():
    free = without_first_nodes(BAR.pattern)
    factoriser = Factoriser(BAR.pattern, free, "band")
    assert not factoriser.has_single_precision
    values = random_values(BAR.pattern, 100.0)
    right = np.ones(len(free))
    np.testing.assert_array_equal(
        factoriser.factorise(values, is_single=True).solve(right),
        factoriser.factorise(values).solve(right),
    )
