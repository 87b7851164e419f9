from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from checks import relative_error
from materials_small import ELASTIC, elastic

from collocation_sysid.errors import InputError
from collocation_sysid.fem import batched
from collocation_sysid.fem.batched import choose_evaluator, jit, make_combiner, simd
from collocation_sysid.fem.batched.combine import combine_natively, combine_with_numpy
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.materials import neo_hookean

VARIABLE = "COLLOCATION_SYSID_EVALUATOR"


@pytest.fixture(autouse=True)
def unset(monkeypatch):
    monkeypatch.delenv(VARIABLE, raising=False)


@pytest.fixture
def without_llvmlite(monkeypatch):
    """Whatever imports llvmlite from here on fails."""
    monkeypatch.setitem(sys.modules, "llvmlite", None)
    for module in ("jit", "simd"):
        monkeypatch.delitem(sys.modules, f"{batched.__name__}.{module}")


def new_body(mesh, material: str | Callable = "neo-hookean", evaluator: str = "auto") -> Body:
    return Body(mesh, material, density_kg_m3=30.0, evaluator=evaluator)


def squeezed(mesh) -> np.ndarray:
    return mesh.points_m * [1.1, 0.95, 0.9]


# Which evaluator ------------------------------------------------------------------------------


def test_vector_code_is_the_default():
    assert choose_evaluator() == "simd"


@pytest.mark.parametrize("name", ["simd", "casadi"])
def test_evaluator_is_forced_by_argument_or_by_environment(small_mesh, name, monkeypatch):
    assert new_body(small_mesh, evaluator=name).evaluator == name
    monkeypatch.setenv(VARIABLE, name)
    assert new_body(small_mesh).evaluator == name


def test_argument_wins_over_environment(small_mesh, monkeypatch):
    monkeypatch.setenv(VARIABLE, "simd")
    assert new_body(small_mesh, evaluator="casadi").evaluator == "casadi"


def test_unknown_evaluator_is_refused(small_mesh, monkeypatch):
    with pytest.raises(InputError, match="no evaluator 'gpu'; available: auto, simd, casadi"):
        new_body(small_mesh, evaluator="gpu")
    monkeypatch.setenv(VARIABLE, "fast")
    with pytest.raises(InputError, match="no evaluator 'fast'"):
        new_body(small_mesh)


def test_everything_works_without_llvmlite(small_mesh, make_body, without_llvmlite):
    body = new_body(small_mesh)
    assert body.evaluator == "casadi"
    x = squeezed(small_mesh)
    expected = make_body("neo-hookean", "casadi").elastic_force(x, **ELASTIC)
    np.testing.assert_array_equal(body.elastic_force(x, **elastic(body)), expected)
    assert make_combiner(random_plan(np.random.default_rng(0))).__qualname__.startswith(
        combine_with_numpy.__name__
    )


def test_forcing_vector_code_without_llvmlite_names_the_remedy(small_mesh, without_llvmlite):
    with pytest.raises(InputError, match="pip install llvmlite, or use 'casadi'"):
        new_body(small_mesh, evaluator="simd")


# Vector code ----------------------------------------------------------------------------------


@pytest.mark.parametrize("lanes", [1, 2, 4, 8])
def test_vectors_of_any_width_give_the_same(small_mesh, make_body, lanes, monkeypatch):
    monkeypatch.setattr(simd, "vector_lanes", lambda: lanes)
    x = squeezed(small_mesh)
    body, reference = new_body(small_mesh, evaluator="simd"), make_body("neo-hookean", "casadi")
    found, expected = (each.elastic_force(x, **elastic(each)) for each in (body, reference))
    assert relative_error(found, expected) < 1e-12
    found, expected = (each.stiffness(x, **elastic(each)).toarray() for each in (body, reference))
    assert relative_error(found, expected) < 1e-12


FUNCTIONS_OF_J = {
    "sqrt": ca.sqrt,
    "fabs": lambda j: ca.fabs(j - 2),
    "exp": ca.exp,
    "log": ca.log,
    "power": lambda j: j**2.7,
    "power of variables": lambda j: j**j,
    "sin": ca.sin,
    "cos": ca.cos,
    "fmin": lambda j: ca.fmin(j, 0.9),
    "fmax": lambda j: ca.fmax(j, 0.9),
    "inverse": lambda j: 1 / j,
    "negative twice": lambda j: -(j + j),
}


@pytest.mark.parametrize("name", FUNCTIONS_OF_J)
def test_functions_an_energy_may_use(small_mesh, name):
    def energy(F, lambda_pa, mu_pa):
        return lambda_pa * FUNCTIONS_OF_J[name](ca.det(F))

    values = [
        new_body(small_mesh, energy, evaluator).energy(squeezed(small_mesh), **ELASTIC)
        for evaluator in ("simd", "casadi")
    ]
    assert values[0] == pytest.approx(values[1], rel=1e-13)


def test_function_the_vector_code_lacks_is_refused_with_the_remedy(small_mesh):
    def clipped(F, lambda_pa, mu_pa):
        return ca.if_else(ca.det(F) < 0.1, 0, neo_hookean(F, lambda_pa, mu_pa))

    x = squeezed(small_mesh)
    with pytest.raises(InputError, match=r"operation OP_\w+; choose evaluator='casadi'"):
        new_body(small_mesh, clipped, "simd").energy(x, **ELASTIC)
    assert new_body(small_mesh, clipped, "casadi").energy(x, **ELASTIC) > 0


# Compiled code on disk ------------------------------------------------------------------------


@pytest.fixture
def cache(tmp_path, monkeypatch) -> Path:
    folder = tmp_path / "kernels"
    monkeypatch.setenv("COLLOCATION_SYSID_CACHE", str(folder))
    return folder


@pytest.fixture
def compiled(monkeypatch) -> list[str]:
    """Grows with every compilation."""
    done = []
    compile_module = jit._compile
    monkeypatch.setattr(jit, "_compile", lambda *args: done.append("") or compile_module(*args))
    return done


def evaluate(mesh) -> float:
    return new_body(mesh, evaluator="simd").energy(squeezed(mesh), **ELASTIC)


def test_compiled_code_is_kept_and_used_again(small_mesh, cache, compiled):
    first = evaluate(small_mesh)
    assert [path.suffix for path in cache.iterdir()] == [".o"]
    assert evaluate(small_mesh) == first
    assert len(compiled) == 1


def test_another_material_gets_a_file_of_its_own(small_mesh, cache):
    evaluate(small_mesh)
    new_body(small_mesh, "linear", "simd").energy(squeezed(small_mesh), **ELASTIC)
    assert len(list(cache.iterdir())) == 2


def truncate(content: bytes) -> bytes:
    return content[: len(content) // 2]


def flip_a_bit(content: bytes) -> bytes:
    return content[:-100] + bytes([content[-100] ^ 1]) + content[-99:]


@pytest.mark.parametrize("damage", [truncate, flip_a_bit, bytes.upper, lambda content: b""])
def test_damaged_file_is_compiled_again(small_mesh, cache, compiled, damage):
    first = evaluate(small_mesh)
    (file,) = cache.iterdir()
    good = file.read_bytes()
    file.write_bytes(damage(good))
    assert evaluate(small_mesh) == first
    assert len(compiled) == 2
    assert file.read_bytes() == good


def test_deleted_file_is_compiled_again(small_mesh, cache, compiled):
    first = evaluate(small_mesh)
    for file in cache.iterdir():
        file.unlink()
    assert evaluate(small_mesh) == first
    assert len(compiled) == 2


def test_unusable_cache_folder_costs_only_time(small_mesh, tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("COLLOCATION_SYSID_CACHE", str(tmp_path / "file" / "kernels"))
    assert evaluate(small_mesh) > 0


# Filling sparse values ------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class RandomPlan:
    first_task: np.ndarray
    tasks: np.ndarray
    coefficients: np.ndarray
    targets: np.ndarray
    sources: np.ndarray


COLUMN_BLOCKS, BLOCK_ENTRIES, ROWS, ENTRIES = 6, 40, 5, 30


def random_plan(rng: np.random.Generator) -> RandomPlan:
    """Each column block is written once, entry by entry, and then added to by other tasks."""
    lengths = rng.integers(1, BLOCK_ENTRIES, 8)
    maps = list(zip(np.cumsum([0, *lengths[:-1]]), lengths, strict=True))
    tasks = [
        (block * BLOCK_ENTRIES, *maps[rng.integers(len(maps))], rng.integers(ROWS), min(task, 1))
        for block in range(COLUMN_BLOCKS)
        for task in range(3)
    ]
    coefficients = rng.standard_normal((len(tasks), 2))
    coefficients[::4, 0] = 0.0
    coefficients[1::4] = 0.0
    return RandomPlan(
        first_task=np.arange(0, len(tasks) + 1, 3),
        tasks=np.array(tasks, dtype=np.int64),
        coefficients=coefficients,
        targets=np.concatenate([rng.permutation(BLOCK_ENTRIES)[:n] for n in lengths]).astype("i4"),
        sources=rng.integers(ENTRIES, size=lengths.sum()).astype(np.int32),
    )


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("start", "stop"), [(0, COLUMN_BLOCKS), (2, 4), (3, 3)])
def test_compiled_and_numpy_combinations_are_equal(seed, start, stop):
    rng = np.random.default_rng(seed)
    plan = random_plan(rng)
    shared = rng.standard_normal((ROWS, 2 * ENTRIES + 7))  # as in `Linearisation`, one row of all
    a, b = shared[:, :ENTRIES], shared[:, ENTRIES : 2 * ENTRIES]
    before = rng.standard_normal(COLUMN_BLOCKS * BLOCK_ENTRIES)
    native, reference = before.copy(), before.copy()
    combine_natively(plan)(start, stop, a, b, native)
    combine_with_numpy(plan)(start, stop, a, b, reference)
    np.testing.assert_allclose(native, reference, rtol=1e-13, atol=1e-14)
    assert (native == before).all() == (start == stop)
