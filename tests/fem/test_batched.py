"""Compiled kernels compared with CasADi, their cache, and failures of the compiler."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
import scipy.special
from kit.checks import relative_error
from kit.materials import ELASTIC

from collocation_sysid.common.step_counting import listen_to_states
from collocation_sysid.errors import InputError
from collocation_sysid.fem import kernels as batched
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.expressions import ElementKernel
from collocation_sysid.fem.kernels import (
    KernelBatch,
    choose_evaluator,
    instructions,
    jit,
    make_combiner,
    make_evaluator,
    make_instance_evaluator,
    simd,
)
from collocation_sysid.fem.kernels.combine import combine_with_numpy, compile_combiner
from collocation_sysid.fem.laws.materials import MATERIALS, neo_hookean

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


@pytest.fixture
def cache(tmp_path, monkeypatch) -> Path:
    folder = tmp_path / "kernels"
    monkeypatch.setenv("COLLOCATION_SYSID_CACHE", str(folder))
    return folder


def new_body(mesh, material: str | Callable = "neo-hookean", evaluator: str = "auto") -> Body:
    """As in a process of its own."""
    jit.compile_function.cache_clear()
    return Body(mesh, material, 30.0, damping="rayleigh", evaluator=evaluator)


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
    with pytest.raises(InputError, match="is 'gpu'; expected one of auto, simd, casadi"):
        new_body(small_mesh, evaluator="gpu")
    monkeypatch.setenv(VARIABLE, "fast")
    with pytest.raises(InputError, match="is 'fast'; expected one of"):
        new_body(small_mesh)


def test_everything_works_without_llvmlite(small_mesh, make_body, without_llvmlite):
    body = new_body(small_mesh)
    assert body.evaluator == "casadi"
    x = squeezed(small_mesh)
    expected = make_body("neo-hookean", "casadi").elastic_force(x, **ELASTIC)
    np.testing.assert_array_equal(body.elastic_force(x, **ELASTIC), expected)
    assert make_combiner(random_plan(np.random.default_rng(0))).__qualname__.startswith(
        combine_with_numpy.__name__
    )


def test_forcing_vector_code_without_llvmlite_names_the_remedy(small_mesh, without_llvmlite):
    with pytest.raises(InputError, match="pip install llvmlite, or use 'casadi'"):
        new_body(small_mesh, evaluator="simd")


# Vector code ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("lanes", "quickly"), [(1, True), (2, False), (4, True), (8, True), (8, False)]
)
def test_vectors_of_any_width_give_the_same(small_mesh, make_body, lanes, quickly, monkeypatch):
    monkeypatch.setattr(simd, "vector_lanes", lambda: lanes)
    monkeypatch.setattr(simd, "OPTIMISED_FROM_POINTS", 10_000 if quickly else 0)
    x = squeezed(small_mesh)
    body, reference = (new_body(small_mesh, evaluator="simd"), make_body("neo-hookean", "casadi"))
    found, expected = (each.elastic_force(x, **ELASTIC) for each in (body, reference))
    assert relative_error(found, expected) < 1e-12
    found, expected = (each.stiffness(x, **ELASTIC).toarray() for each in (body, reference))
    assert relative_error(found, expected) < 1e-12


def test_code_that_was_compiled_quickly_is_not_taken_for_optimised_code(small_mesh, cache):
    new_body(small_mesh, evaluator="simd").elastic_force(squeezed(small_mesh), **ELASTIC)
    quickly = set(cache.iterdir())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simd, "OPTIMISED_FROM_POINTS", 0)
        new_body(small_mesh, evaluator="simd").elastic_force(squeezed(small_mesh), **ELASTIC)
    assert len(set(cache.iterdir()) - quickly) == len(quickly) > 0


def distance_and_slopes() -> ca.Function:
    point, share = ca.SX.sym("point", 3), ca.SX.sym("share")
    distance = share * ca.sqrt(ca.sumsqr(point) + 1)
    return ca.Function("distance", [point, share], [distance, ca.jacobian(distance, point)])


@pytest.mark.parametrize("count", [1, 7, 32])
def test_any_number_of_instances_gives_the_same_compiled(count):
    rng = np.random.default_rng(0)
    inputs = [rng.normal(size=(3, count)), rng.normal(size=(1, count))]
    compiled = make_instance_evaluator(distance_and_slopes(), compiled=True)(inputs)
    expected = make_instance_evaluator(distance_and_slopes(), compiled=False)(inputs)
    assert [each.shape for each in compiled] == [(1, count), (3, count)]
    for each, other in zip(compiled, expected, strict=True):
        np.testing.assert_allclose(each, other, rtol=1e-14)


def test_instances_without_compiled_code_are_evaluated_by_casadi(broken_compiler, cache):
    inputs = [np.ones((3, 4)), np.ones((1, 4))]
    distance, _ = make_instance_evaluator(distance_and_slopes(), compiled=True)(inputs)
    np.testing.assert_array_equal(distance, np.full((1, 4), 2.0))


FUNCTIONS: dict[str, Callable] = {
    "OP_ADD": lambda x, y: x + y,
    "OP_SUB": lambda x, y: x - y,
    "OP_MUL": lambda x, y: x * y,
    "OP_DIV": lambda x, y: x / y,
    "OP_NEG": lambda x, y: -x,
    "OP_INV": lambda x, y: 1 / x + y,
    "OP_SQ": lambda x, y: x**2,
    "OP_TWICE": lambda x, y: x + x,
    "OP_SQRT": lambda x, y: ca.sqrt(x),
    "OP_EXP": lambda x, y: ca.exp(x),
    "OP_EXPM1": lambda x, y: ca.expm1(x),
    "OP_LOG": lambda x, y: ca.log(x),
    "OP_LOG1P": lambda x, y: ca.log1p(x),
    "OP_POW": lambda x, y: x**y,
    "OP_CONSTPOW": lambda x, y: x**2.7,
    "OP_SIN": lambda x, y: ca.sin(x),
    "OP_COS": lambda x, y: ca.cos(x),
    "OP_TAN": lambda x, y: ca.tan(x),
    "OP_ASIN": lambda x, y: ca.asin(x),
    "OP_ACOS": lambda x, y: ca.acos(x),
    "OP_ATAN": lambda x, y: ca.atan(x),
    "OP_ATAN2": ca.atan2,
    "OP_SINH": lambda x, y: ca.sinh(x),
    "OP_COSH": lambda x, y: ca.cosh(x),
    "OP_TANH": lambda x, y: ca.tanh(x),
    "OP_ASINH": lambda x, y: ca.asinh(x),
    "OP_ACOSH": lambda x, y: ca.acosh(x),
    "OP_ATANH": lambda x, y: ca.atanh(x),
    "OP_ERF": lambda x, y: ca.erf(x),
    "OP_HYPOT": ca.hypot,
    "OP_FABS": lambda x, y: ca.fabs(x),
    "OP_SIGN": lambda x, y: ca.sign(x),
    "OP_COPYSIGN": ca.copysign,
    "OP_FLOOR": lambda x, y: ca.floor(x),
    "OP_CEIL": lambda x, y: ca.ceil(x),
    "OP_FMOD": ca.fmod,
    "OP_REMAINDER": ca.remainder,
    "OP_FMIN": ca.fmin,
    "OP_FMAX": ca.fmax,
    "OP_LT": lambda x, y: x < y,
    "OP_LE": lambda x, y: x <= y,
    "OP_EQ": lambda x, y: x == y,
    "OP_NE": lambda x, y: x != y,
    "OP_NOT": lambda x, y: ca.logic_not(x),
    "OP_AND": ca.logic_and,
    "OP_OR": ca.logic_or,
    "OP_IF_ELSE_ZERO": lambda x, y: ca.if_else(x, y, 0),
}
NUMBERS = [0.0, 1e-9, 0.25, 0.5, 1.0, 1.5, 2.0, 3.7, 40.0, np.inf]
NUMBERS = [np.nan, *NUMBERS, *(-number for number in NUMBERS)]


def kernel_of(function: Callable) -> ElementKernel:
    """A function of two numbers, which are coordinates of one node, as a kernel."""
    x, geometry, theta = (ca.SX.sym("x", 3), ca.SX.sym("geometry", 4), ca.SX.sym("theta", 3))
    value = geometry[3] * function(x[0], x[1])
    names = ["x", "geometry", "theta"]
    pieces = ca.Function("value", [x, geometry, theta], [value], names, ["value"])
    return ElementKernel(pieces, ("x",), {"value": "none"})


def values(kernel: ElementKernel, evaluator: str, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    count = len(x)
    cells = np.arange(count)[:, None]
    geometry = np.broadcast_to([0.0, 0.0, 0.0, 1.0], (count, 1, 4))
    fields = np.stack([x, y, np.zeros(count)], axis=1).reshape(1, -1)
    found = np.empty((1, count))
    batch = KernelBatch(kernel, cells, geometry, cells, count)
    make_evaluator(batch, evaluator)([fields], np.zeros(3), found, 1)
    return found[0]


def both_values(function: Callable, x: np.ndarray, y: np.ndarray) -> list[np.ndarray]:
    return [values(kernel_of(function), evaluator, x, y) for evaluator in ("simd", "casadi")]


@pytest.mark.parametrize("name", FUNCTIONS)
def test_operations_are_those_of_casadi(name):
    pieces = kernel_of(FUNCTIONS[name]).pieces
    assert getattr(ca, name) in [pieces.instruction_id(k) for k in range(pieces.n_instructions())]
    x, y = np.array(list(product(NUMBERS, NUMBERS))).T
    found, expected = both_values(FUNCTIONS[name], x, y)
    np.testing.assert_allclose(found, expected, rtol=1e-13, atol=0)


@pytest.mark.parametrize("name", [*FUNCTIONS, "OP_ERFINV"])
def test_derivatives_need_no_other_operations(name):
    z = ca.SX.sym("z", 2)
    function = FUNCTIONS.get(name, lambda x, y: ca.erfinv(x))
    value = ca.exp(function(z[0], z[1]))
    for _ in range(3):  # as many as a curvature kernel takes
        value = ca.sum1(ca.gradient(value, z))
        instructions.require_supported_operations(ca.Function("derivative", [z], [value]))


def test_every_operation_of_vector_code_is_tested():
    known = {instructions.operation_name(operation) for operation in instructions.OPERATIONS}
    assert known - set(FUNCTIONS) == {"OP_ASSIGN", "OP_ERFINV"}


def test_functions_called_from_vector_code_are_resolved():
    assert set(instructions.LIBRARY.values()) <= set(jit.LIBM)


@pytest.mark.parametrize(
    "function",
    [
        lambda x, y: ca.sin(x) * ca.cos(x),
        lambda x, y: 2**x,
        lambda x, y: 2 ** ca.floor(x),
        lambda x, y: 10**x,
        lambda x, y: x**0.5 + x ** (1 / 3),
    ],
)
def test_calls_that_the_compiler_renames_are_resolved(function):
    x = np.linspace(0, 4, 11)
    np.testing.assert_allclose(*both_values(function, x, x), rtol=1e-13)


def test_branch_that_is_not_taken_is_not_felt():
    x = np.array([-1.0, 0.0, 1.0, 2.0, -3.0, 4.0, 0.0, 5.0, 6.0])
    found, expected = both_values(lambda x, y: ca.if_else(x > 0, ca.log(x), -1), x, x)
    np.testing.assert_allclose(found, expected, rtol=1e-13)
    assert (found[x <= 0] == -1).all()


@pytest.mark.parametrize("count", [1, 2, 3, 8, 9])
def test_an_infinite_energy_of_the_last_element_stays_infinite(count):
    x = np.zeros(count)
    found, expected = both_values(lambda x, y: 1 / x, x, x)
    np.testing.assert_array_equal(found, expected)


def test_inverse_error_function_is_exact():
    x = np.array([-1.5, -1.0, -0.95, -0.7, -0.69, -1e-9, 0.0, 0.3, 0.7, 0.95, 1.0, 2.0, np.nan])
    found = values(kernel_of(lambda x, y: ca.erfinv(x)), "simd", x, x)
    np.testing.assert_allclose(found, scipy.special.erfinv(x), rtol=1e-13)


def branching(F, lambda_pa, mu_pa):
    """Softer in tension than in compression, with most of the functions there are."""
    j, stretch, shear = ca.det(F), ca.trace(F.T @ F) - 3, F[0, 1] + F[1, 0]
    volumetric = ca.if_else(j < 1, j - 1 - ca.log(j), ca.tanh(j - 1) ** 2 / 2)
    limited = ca.erf(stretch) + ca.atan2(stretch, j) + ca.log1p(stretch**2) + ca.erfinv(shear / 4)
    clipped = ca.fmax(stretch, 0.1) ** 3 + ca.fmin(shear, 0.0) ** 2 + ca.hypot(shear, j)
    either = ca.if_else(ca.logic_or(shear > 0.1, stretch < 0), ca.cosh(shear), ca.exp(-stretch))
    return lambda_pa * volumetric + mu_pa * (limited + clipped + either)


@pytest.mark.parametrize("method", ["force", "linearise", "second_derivatives"])
def test_energy_with_branches_is_the_same_by_both_evaluators(small_mesh, method, rng):
    # It is for the evaluators only: an undeformed body has stress.
    material = replace(MATERIALS["neo-hookean"], energy=branching)
    bodies = [new_body(small_mesh, material, evaluator) for evaluator in ("simd", "casadi")]
    x = small_mesh.points_m + 0.004 * rng.standard_normal((3, *small_mesh.points_m.shape))
    ratios = bodies[0].volume_ratios(x)
    assert ratios.min() < 1 < ratios.max()
    v, w = rng.standard_normal((2, *x.shape))
    states, theta = (
        [x, v, w] if method == "second_derivatives" else [x, v],
        (*ELASTIC.values(), 0.01, 0.1),
    )
    found, expected = (getattr(body, method)(*states, theta) for body in bodies)
    for name in getattr(expected, "__dataclass_fields__", [None]):
        pair = (getattr(each, name) if name else each for each in (found, expected))
        assert relative_error(*pair) < 1e-12


# What vector code lacks -----------------------------------------------------------------------


def printing(F, lambda_pa, mu_pa):
    return ca.SX.printme(neo_hookean(F, lambda_pa, mu_pa), 0)


def test_material_that_vector_code_lacks_yields_to_casadi_with_a_note(small_mesh, make_body):
    body = new_body(small_mesh, printing)
    assert body.evaluator == "casadi"
    (note,) = body.notes
    assert "CasADi's map, which is much slower" in note
    assert "no CasADi operation OP_PRINTME" in note
    x = squeezed(small_mesh)
    assert body.energy(x, **ELASTIC) == make_body("neo-hookean", "casadi").energy(x, **ELASTIC)


def test_forced_vector_code_refuses_unsupported_functions_with_the_remedy(small_mesh, monkeypatch):
    refusal = r"operation OP_PRINTME; choose evaluator = 'casadi'"
    with pytest.raises(InputError, match=refusal):
        new_body(small_mesh, printing, "simd")
    monkeypatch.setenv(VARIABLE, "simd")
    with pytest.raises(InputError, match=refusal):
        new_body(small_mesh, printing)


def test_kernel_refuses_functions_without_vector_code():
    x = np.ones(3)
    with pytest.raises(InputError, match="no CasADi operation OP_PRINTME"):
        values(kernel_of(ca.SX.printme), "simd", x, x)


@pytest.mark.parametrize("evaluator", ["simd", "casadi"])
def test_the_requested_evaluator_has_no_note(small_mesh, evaluator):
    assert new_body(small_mesh, evaluator=evaluator).notes == ()
    assert new_body(small_mesh).notes == ()


@pytest.fixture
def broken_compiler(cache, monkeypatch):
    def fail(*_, **__):
        raise RuntimeError("no registers")

    monkeypatch.setattr(jit, "compile_module", fail)


def test_failing_compiler_yields_to_casadi_with_a_note(small_mesh, make_body, broken_compiler):
    body = new_body(small_mesh)
    x = squeezed(small_mesh)
    assert body.energy(x, **ELASTIC) == make_body("neo-hookean", "casadi").energy(x, **ELASTIC)
    assert body.evaluator == "casadi"
    assert "LLVM cannot compile the energy function of the material (no registers)" in body.notes[0]
    combine = make_combiner(random_plan(np.random.default_rng(0)))
    assert combine.__qualname__.startswith(combine_with_numpy.__name__)


def test_failing_compiler_is_an_error_where_vector_code_is_forced(small_mesh, broken_compiler):
    with pytest.raises(InputError, match=r"\(no registers\); choose evaluator = 'casadi'"):
        evaluate(small_mesh)


# Compiled code on disk ------------------------------------------------------------------------


@pytest.fixture
def compiled(monkeypatch) -> list[str]:
    """Grows with every compilation."""
    done = []
    compile_module = jit.compile_module
    monkeypatch.setattr(
        jit,
        "compile_module",
        lambda *args, **more: done.append("") or compile_module(*args, **more),
    )
    return done


def evaluate(mesh) -> float:
    return new_body(mesh, evaluator="simd").energy(squeezed(mesh), **ELASTIC)


def test_compiling_is_reported_as_a_state(small_mesh, cache):
    states = []
    with listen_to_states(lambda describe: states.append(describe())):
        evaluate(small_mesh)
        assert states == ["compiling native code", ""]
        evaluate(small_mesh)  # from the cache
    assert len(states) == 2


def test_compiled_code_is_kept_and_used_again(small_mesh, cache, compiled):
    first = evaluate(small_mesh)
    assert [path.suffix for path in cache.iterdir()] == [".o"]
    assert evaluate(small_mesh) == first
    assert len(compiled) == 1


def test_changed_sources_are_compiled_anew(small_mesh, cache, tmp_path, monkeypatch):
    evaluate(small_mesh)
    sources = shutil.copytree(Path(jit.__file__).parent, tmp_path / "sources")
    with (sources / "erfinv.py").open("a") as file:
        file.write("# changed\n")
    monkeypatch.setattr(jit, "__file__", str(sources / "jit.py"))
    jit._source_digest.cache_clear()
    try:
        evaluate(small_mesh)
    finally:
        jit._source_digest.cache_clear()
    assert len(list(cache.iterdir())) == 2


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
    compile_combiner(plan)(start, stop, a, b, native)
    combine_with_numpy(plan)(start, stop, a, b, reference)
    np.testing.assert_allclose(native, reference, rtol=1e-13, atol=1e-14)
    assert (native == before).all() == (start == stop)
