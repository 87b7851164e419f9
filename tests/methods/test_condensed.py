"""The condensed program for IPOPT: derivatives, eliminated variables and solutions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
from kit.checks import assert_derivative
from kit.memories import TWO, guesses, recorded
from kit.problems import GUESS, bar_let_go, hung_cube, noisy, with_markers
from kit.static import HANGING, block
from kit.wrenches import sensing, wristed_cube
from scipy.interpolate import CubicSpline

from collocation_sysid.methods.condensed_program import CondensedCollocation, condense
from collocation_sysid.methods.interior_point import InteriorPoint
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.model.parameters import Parameters
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.program.lifted.collocation import with_lifted_variables
from collocation_sysid.recording import Experiment, Nuisance

DEFAULT, ON_TIME = Nuisance(), Nuisance(time_shift_s=None)


def late_cube(nuisance: Nuisance, samples: float = 0.0, steps: int = 16) -> Experiment:
    """The hung cube, seen so many samples late by markers with noise."""
    cube = noisy(hung_cube(steps, (1, 1, 2)), 1e-4)
    seen = cube.markers
    times = np.arange(len(seen.t_s))
    tracks = CubicSpline(times, seen.positions_m)(times - samples)
    return replace(with_markers(cube, tracks), nuisance=nuisance)


def several() -> list[Experiment]:
    """Two recordings that share how the body is off, and one in which nothing is unknown."""
    shared = replace(ON_TIME, scope={"hand_eye_rad": "shared"})
    first = hung_cube(4, (1, 1, 2), nuisance=shared)
    known = hung_cube(4, (1, 1, 2))
    return [first, replace(known, name="known"), replace(first, name="again")]


CASES: dict[str, Callable[[Nuisance], tuple[list[Experiment], Parameters]]] = {
    "cube": lambda nuisance: ([late_cube(nuisance)], GUESS),
    "let go": lambda nuisance: ([replace(bar_let_go(6), nuisance=nuisance)], GUESS),
    "wrench": lambda nuisance: ([wristed_cube(5, nuisance)], GUESS),
    "memory": lambda nuisance: (
        [sensing(recorded("hung-cube", 4, 2, nuisance=nuisance))],
        guesses(TWO, 1.1),
    ),
    "static": lambda nuisance: (
        [replace(block("xyz", gravity_m_s2=HANGING), nuisance=nuisance)],
        GUESS,
    ),
    "several": lambda _: (several(), GUESS),
}


def made(name: str, nuisance: Nuisance) -> tuple[Collocation, Collocation, CondensedCollocation]:
    """A collocation, all that follows as variables, and without held dofs."""
    collocation = Collocation(*CASES[name](nuisance))
    whole = with_lifted_variables(collocation)
    program = condense(whole)
    assert isinstance(program, CondensedCollocation)
    return collocation, whole, program


def some_point(collocation: Collocation, program: Collocation, rng: np.random.Generator):
    positions = []
    for transcription in collocation.transcriptions:
        rigid = transcription.experiment.rigid_positions(transcription.dynamics.t_s).reshape(
            -1, transcription.dof_count
        )
        positions.append(rigid + 1e-3 * rng.normal(size=rigid.shape))
    p = collocation.guess_p
    p += 0.1 * rng.normal(size=len(p))
    return program.pack(p, positions)


@pytest.mark.parametrize("name", CASES)
def test_derivatives_go_through_the_dofs_that_are_held(name: str, rng):
    collocation, whole, program = made(name, ON_TIME)
    rows = sum(
        s.is_grasp_constraint.sum() for s in whole.transcriptions if s.nuisance.affects_grasps
    )
    assert (
        whole.variable_count - program.variable_count
        == whole.constraint_count - program.constraint_count
        == rows
    )
    z, y = (some_point(collocation, program, rng), rng.normal(size=program.constraint_count))

    def slope(at: np.ndarray) -> np.ndarray:
        return 1.3 * program.gradient(at) + program.jacobian(at).T @ y

    gradient, jacobian, hessian = (
        program.gradient(z),
        program.jacobian(z),
        program.hessian(z, 1.3, y),
    )
    of_phi = np.zeros(len(z))
    of_phi[program.phi_columns] = 0.1
    for scale in (0.1, of_phi):
        options = {"scale": scale, "directions": 1}
        assert_derivative(program.objective, lambda d: gradient @ d, z, rng, **options)
        assert_derivative(program.constraint_values, lambda d: jacobian @ d, z, rng, **options)
        assert_derivative(slope, lambda d: hessian @ d, z, rng, **options)


def times_of_positions(program: Collocation) -> np.ndarray:
    """Grid time of each variable, by experiment; −1 for all that are no positions."""
    times = np.full(program.variable_count, -1)
    for number, transcription in enumerate(program.transcriptions):
        own = np.arange(transcription.variable_count) // transcription.dof_count
        times[transcription.columns] = own + 1_000_000 * number
    return times


@pytest.mark.parametrize("nuisance", [DEFAULT, ON_TIME], ids=["clock", "none"])
@pytest.mark.parametrize("name", CASES)
def test_patterns_are_those_of_the_chain_rule(name: str, nuisance: Nuisance):
    """The chain rule with matrices of ones has the same entries as the patterns of the program."""
    _, whole, program = made(name, nuisance)
    columns, rows = program._remaining
    identity = np.eye(whole.variable_count)[:, columns]
    through = np.zeros_like(identity)
    of_phi = np.zeros((len(columns), len(columns)))
    for each in program.eliminated:
        phi = np.searchsorted(columns, each.phi)
        through[np.ix_(each.variables, phi)] = 1
        of_phi[np.ix_(phi, phi)] = 1
    jacobian = ones(whole.jacobian_structure, whole.constraint_count)
    expected = (sp.csr_array(jacobian) @ sp.csr_array(identity + through))[rows]
    found = ones(program.jacobian_structure, program.constraint_count)
    np.testing.assert_array_equal(found > 0, expected.toarray() > 0)

    upper = ones(whole.hessian_structure, whole.variable_count)
    hessian = upper + upper.T
    times = times_of_positions(whole)
    apart = np.abs(times[:, None] - times)
    lags = [s.dynamics.largest_lag for s in whole.transcriptions]
    assert len(set(lags)) == 1
    is_position = times >= 0
    is_coupled = (apart > lags[0]) & is_position[:, None] & is_position
    chosen = sp.csr_array(identity)
    chain = sp.csr_array(through)
    kept = chosen.T @ sp.csr_array(np.where(is_coupled, 0, hessian)) @ chosen
    mixed = chosen.T @ sp.csr_array(hessian) @ chain
    both = chain.T @ sp.csr_array(hessian) @ chain
    expected = np.triu((kept + mixed + mixed.T + both).toarray() + of_phi)
    found = ones(program.hessian_structure, program.variable_count)
    np.testing.assert_array_equal(found > 0, expected > 0)


def ones(structure: tuple[np.ndarray, np.ndarray], height: int) -> np.ndarray:
    """The dense matrix with a one at each entry of compressed columns."""
    indptr, rows = structure
    dense = np.zeros((height, len(indptr) - 1))
    np.add.at(dense, (rows, np.repeat(np.arange(len(indptr) - 1), np.diff(indptr))), 1)
    assert dense.max() <= 1
    return dense


@pytest.mark.parametrize("name", CASES)
def test_held_dofs_are_those_of_grasps_and_are_balanced_by_multipliers(name: str, rng):
    collocation, whole, program = made(name, ON_TIME)
    z, y = (some_point(collocation, program, rng), rng.normal(size=program.constraint_count))
    at, of_rows = (program.complete_variables(z), program.complete_multipliers(z, 1.0, y))
    rows = np.concatenate([each.rows for each in program.eliminated])
    held = np.concatenate([each.variables for each in program.eliminated])
    np.testing.assert_allclose(whole.constraint_values(at)[rows], 0.0, atol=1e-12)
    np.testing.assert_array_equal(np.delete(at, held), z)
    slope = whole.gradient(at) + whole.jacobian(at).T @ of_rows
    own = program.gradient(z) + program.jacobian(z).T @ y
    np.testing.assert_allclose(slope[held], 0.0, atol=1e-9 * np.abs(own).max())
    np.testing.assert_allclose(np.delete(slope, held), own, atol=1e-9 * np.abs(own).max())


@pytest.mark.parametrize("substeps", [1, 2])
def test_a_clock_adds_no_entry_between_timesteps_that_motion_does_not_join(substeps: int):
    whole = Collocation([late_cube(DEFAULT)], GUESS, substeps=substeps)
    program = condense(whole)
    (transcription,) = whole.transcriptions
    apart = []
    for each, dofs in ((whole, transcription.dof_count), (program, len(transcription.free_dofs))):
        indptr, rows = each.hessian_structure
        columns = np.repeat(np.arange(each.variable_count), np.diff(indptr))
        of_x = (rows >= each.nq) & (columns < each.phi_columns.start)
        first, second = ((index[of_x] - each.nq) // dofs for index in (rows, columns))
        apart.append((second - first).max())
    assert apart[0] == 4 * substeps
    assert apart[1] <= transcription.dynamics.largest_lag


def test_steps_take_slopes_of_the_nearest_sample(rng):
    whole = Collocation([late_cube(DEFAULT)], GUESS)
    program = condense(whole)
    (transcription,) = whole.transcriptions
    z = some_point(whole, program, rng)
    (clock,) = program.phi_columns.start + transcription.nuisance.clock_indices
    sample = (
        transcription.experiment.timestep_s
        / transcription.nuisance.scales[transcription.nuisance.clock_indices[0]]
    )
    found = []
    for samples in (0.4, 0.0, 0.6, 1.0):
        z[clock] = samples * sample
        found.append(program.hessian(z, 1.0, None).toarray())
    np.testing.assert_array_equal(found[0], found[1])
    np.testing.assert_allclose(found[2], found[3], rtol=1e-12)
    assert np.abs(found[1] - found[3]).max() > 1e-3


def test_a_recording_by_a_clock_that_is_late_has_the_optimum_of_reduced_space():
    collocation = Collocation([late_cube(DEFAULT, samples=0.7)], GUESS)
    expected = ReducedSpace(tolerance=1e-10)(collocation)
    found = InteriorPoint(tolerance=1e-10)(expected.collocation)
    assert found.status.converged
    np.testing.assert_allclose(found.q, expected.q, atol=1e-4)
    assert found.kkt_residual < 1e-8
