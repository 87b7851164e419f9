"""A user-defined internal variable that follows a recursion."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
import pytest
from kit.checks import assert_derivative, relative_error
from kit.problems import GUESS, hung_cube

from collocation_sysid.model.recursion import Recursion, RecursionTrajectory
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.program.experiment_iterate import ExperimentIterate
from collocation_sysid.program.lifted.collocation import LiftedCollocation
from collocation_sysid.program.lifted.expression_patterns import ExpressionPattern, PatternIndices
from collocation_sysid.program.lifted.variables import LiftedVariables
from collocation_sysid.program.motion_transcription import Offsets

CORNERS = np.array([[0, 3], [1, 5], [2, 4]])
MODULUS_PA = 1e3


def slow_stretch(before, now, last, modulus_pa, data):
    """How far two nodes are apart, through a low-pass that is longer for soft bodies, and yields.

    It bends by all that it depends on, as an anchor of friction does.
    """
    began, share = data[0], 1 / (1 + MODULUS_PA / modulus_pa)
    now, last = (ca.norm_2(at[3:] - at[:3]) for at in (now, last))
    slid = before + share * (0.7 * now + 0.3 * last - before) + before**2 * now
    return began * now + (1 - began) * slid


STRETCH = Recursion(slow_stretch, 1, 6, 1, 1)


@dataclass(frozen=True, eq=False)
class Stretches(LiftedVariables):
    """That of three pairs of nodes, at all grid times."""

    kind = "stretch"

    @property
    def shape(self) -> tuple[int, int, int]:
        return 1, self.transcription.grid_times, 3

    @property
    def began(self) -> np.ndarray:
        return (np.arange(self.transcription.grid_times) == 0)[None, :, None]

    def evolution(self, part: ExperimentIterate) -> RecursionTrajectory:
        modulus_pa = np.exp(part.q[:1])
        return RecursionTrajectory.from_signal(STRETCH, modulus_pa, self.began, self.looked(part.x))

    def looked(self, x: np.ndarray) -> np.ndarray:
        """(6, N, 3, …) positions of each pair."""
        at = x.reshape(len(x), -1, 3, *x.shape[2:])[:, CORNERS]
        return np.moveaxis(at.reshape(len(x), 3, 6, *x.shape[2:]), 2, 0)

    def consistent_values(self, part: ExperimentIterate) -> np.ndarray:
        return self.evolution(part).states.ravel()

    @cached_property
    def patterns(self) -> tuple[ExpressionPattern, ...]:
        rows = np.arange(self.count).reshape(self.shape)
        columns = np.arange(self.transcription.columns.start, self.transcription.columns.stop)
        at = self.looked(columns.reshape(self.transcription.grid_times, -1))
        recursion = Recursion(
            lambda before, now, last, q, data: slow_stretch(before, now, last, ca.exp(q), data),
            *(1, 6, 1, 1),
        )
        looked = PatternIndices(at, np.full((1, 1, 1), self.transcription.length_m))
        states, of_q = (
            PatternIndices(self.offsets.variable + rows),
            PatternIndices(np.zeros((1, 1, 1), int)),
        )
        numbers = self.began, states, looked, of_q, PatternIndices(rows)
        return (ExpressionPattern.from_recursion(recursion, *numbers),)


@pytest.fixture(scope="module")
def program() -> Collocation:
    plain = Collocation([hung_cube(5)], GUESS)
    last = Offsets(plain.variable_count, plain.constraint_count)
    made = LiftedCollocation([hung_cube(5)], GUESS)
    vars(made)["lifted"] = (Stretches(made.transcriptions[0], 0, made.phi_columns.start, last),)
    return made


def some_positions(program: Collocation, rng: np.random.Generator) -> np.ndarray:
    (transcription,) = program.transcriptions
    rigid = transcription.experiment.rigid_positions(transcription.dynamics.t_s).reshape(
        -1, transcription.dof_count
    )
    return rigid + 1e-3 * rng.normal(size=rigid.shape)


def test_rows_vanish_where_the_variable_follows_from_the_motion(program, rng):
    z = program.pack(program.guess_p, [some_positions(program, rng)])
    (carried,) = program.lifted
    assert (z[carried.columns] > 0.01).all()
    np.testing.assert_allclose(program.constraint_values(z)[carried.rows], 0.0, atol=1e-14)


def test_matrices_of_a_program_contain_the_variable(program, rng):
    z = program.pack(program.guess_p, [some_positions(program, rng)])
    (carried,), y = program.lifted, rng.normal(size=program.constraint_count)
    z[carried.columns] += 0.01 * rng.normal(size=carried.count)
    jacobian, hessian = program.jacobian(z), program.hessian(z, 1.3, y)
    own = jacobian[carried.rows]
    values = program.constraint_values
    assert_derivative(lambda at: values(at)[carried.rows], lambda d: own @ d, z, rng, 1e-7, 0.1, 1)
    for here in (slice(program.nq), program.transcriptions[0].columns, carried.columns):
        scale = np.zeros(len(z))
        scale[here] = 0.1
        assert_derivative(
            lambda at: 1.3 * program.gradient(at) + program.jacobian(at).T @ y,
            lambda d: hessian @ d,
            *(z, rng, 1e-7, scale, 1),
        )
    assert np.abs(hessian[carried.columns][:, : program.nq]).max() > 0


def test_eliminating_columns_are_those_of_the_rows(program, rng):
    """Forward −J_h⁻¹ J_p of the rows, backward their transpose."""
    x = some_positions(program, rng)
    z, (transcription,), (carried,) = (
        program.pack(program.guess_p, [x]),
        program.transcriptions,
        program.lifted,
    )
    rows = program.jacobian(z)[carried.rows].toarray()
    (part,) = program.iterates_at(program.guess_p, [x])
    evolution, moved, by_q = (
        carried.evolution(part),
        rng.normal(size=(*x.shape, 2)),
        rng.normal(size=2),
    )
    change = evolution.jacobian_vector_product(
        carried.looked(moved), np.exp(part.q[:1]) * by_q[None]
    )
    columns = np.vstack([by_q, moved.reshape(-1, 2) / transcription.length_m])
    sides = rows[:, [0, *range(*transcription.columns.indices(len(z)))]] @ columns
    expected = -np.linalg.solve(rows[:, carried.columns], sides)
    assert relative_error(change.reshape(-1, 2), expected) < 1e-12
    weights = rng.normal(size=evolution.states.shape)
    by_looked, by_modulus = evolution.vector_jacobian_product(weights)
    along = np.einsum("ikp,ikpc->c", by_looked, carried.looked(moved))
    along += by_modulus[0] * np.exp(part.q[0]) * by_q
    expected = weights.ravel() @ change.reshape(-1, 2)
    np.testing.assert_allclose(along, expected, rtol=1e-11)


def test_coefficients_of_a_linear_one_are_those_of_all_its_instances(rng):
    def blend(before, now, last, c, data):
        return c[0] * before + data[0] * now - c[1] ** 2 * last

    c, data = ca.SX.sym("c", 2), ca.SX.sym("data", 1)
    found = ca.Function(
        "found", [c, data], [Recursion(blend, 1, 1, 2, 1).linear_coefficients(c, data)]
    )
    np.testing.assert_allclose(found([0.5, 3.0], 2.0).full().ravel(), [0.5, 2.0, -9.0])
