"""Sweeps: forward and backward solutions of the linearised equations of motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from kit.problems import (
    EXPERIMENTS_AND_SCHEMES,
    GUESS,
    SMALL_EXPERIMENTS,
    TRUTH,
    as_theta,
    bar_loaded,
    hung_cube,
    measured,
    released_cube,
    with_papers_damping,
)

from collocation_sysid.errors import SimulationError
from collocation_sysid.fem.schemes import SCHEMES
from collocation_sysid.methods.solution import constraint_multipliers
from collocation_sysid.model.equations_at_parameters import EquationsAtParameters
from collocation_sysid.program import sweep
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.program.forward.scheme_simulation import simulate_scheme
from collocation_sysid.program.linear_algebra import factorisation
from collocation_sysid.program.stopwatch import Stopwatch
from collocation_sysid.program.sweep import Sweep, SweepResult

EXPERIMENTS = SMALL_EXPERIMENTS | {"bar-loaded": bar_loaded}
LAYOUTS = {
    "bounds": {},
    "explicit-grasps": {"has_grasp_constraints": True},
    "substeps": {"substeps": 2},
}


def disturbed(
    collocation: Collocation, size_m: float = 1e-3, seed: int = 0
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Variables near the truth whose free dofs do not satisfy the equations of motion."""
    rng = np.random.default_rng(seed)
    positions = []
    for transcription in collocation.transcriptions:
        x = simulate_scheme(
            transcription.experiment, transcription.dynamics.with_theta(as_theta(TRUTH))
        )
        change = np.zeros_like(x)
        change[:, transcription.free_dofs] = rng.standard_normal(
            (len(x), len(transcription.free_dofs))
        )
        change = transcription.dynamics.zero_prescribed_forces(change)
        x[transcription.dynamics.first_row :] += size_m * change[transcription.dynamics.first_row :]
        positions.append(x)
    return collocation.pack(some_parameters(collocation), positions), positions


def some_parameters(collocation: Collocation) -> np.ndarray:
    """All parameters p: the guess, and nuisance parameters that are not zero."""
    phi = 0.3 * np.random.default_rng(1).standard_normal(collocation.nphi)
    return np.concatenate([collocation.parameters.guess_q, phi])


def only_setting(collocation: Collocation) -> EquationsAtParameters:
    (transcription,) = collocation.transcriptions
    return transcription.equations_at(*np.split(some_parameters(collocation), [collocation.nq]))


def forward(collocation: Collocation, positions: list[np.ndarray]) -> list[SweepResult]:
    parts = collocation.iterates_at(some_parameters(collocation), positions)
    return [Sweep(part.transcription).forward(part.x, part.equations) for part in parts]


@pytest.fixture(
    scope="module",
    params=[(*pair, "bounds") for pair in [*EXPERIMENTS_AND_SCHEMES, ("bar-loaded", "bdf2")]]
    + [("hung-cube", scheme, layout) for scheme in SCHEMES for layout in list(LAYOUTS)[1:]],
    ids="-".join,
)
def collocation(request: pytest.FixtureRequest) -> Collocation:
    name, scheme, layout = request.param
    return Collocation([EXPERIMENTS[name](5)], GUESS, scheme, **LAYOUTS[layout])


def test_the_feasibility_step_solves_the_linearised_constraints(collocation: Collocation):
    z, positions = disturbed(collocation)
    step = [tangent.step for tangent in forward(collocation, positions)]
    values = collocation.constraint_values(z)
    still = np.zeros_like(collocation.guess_p)
    change = collocation.jacobian(z) @ collocation.pack(still, step)
    assert np.abs(values).max() > 1e-4
    np.testing.assert_allclose(change, -values, atol=1e-9 * np.abs(values).max())


def test_multipliers_make_the_lagrangian_stationary_in_the_positions(collocation: Collocation):
    collocation = replace(collocation, experiments=[*map(measured, collocation.experiments)])
    z, _ = disturbed(collocation)
    multipliers = constraint_multipliers(collocation, z)
    gradient = collocation.gradient(z)
    slope = gradient + collocation.jacobian(z).T @ multipliers
    lower, upper = collocation.bounds()
    first = collocation.nq
    free = first + np.flatnonzero((lower < upper)[first : len(z) - collocation.nphi])
    assert np.abs(gradient[free]).max() > 0
    assert np.abs(slope[free]).max() < 1e-9 * np.abs(gradient[free]).max()


def test_backward_is_the_transpose_of_forward(collocation: Collocation, rng):
    """gᵀ p = yᵀ c for y with c_xᵀ y = −g and p = −c_x⁻¹ c."""
    _, (x,) = disturbed(collocation)
    (transcription,) = collocation.transcriptions
    setting = only_setting(collocation)
    goals = (
        setting.prescribed.positions_m
    )  # what is grasped is where it should be: no step of its own
    x[:, setting.prescribed.dofs] = np.where(np.isnan(goals), x[:, setting.prescribed.dofs], goals)
    gradient = rng.standard_normal(x.shape)
    y = Sweep(transcription).backward(x, setting, gradient)
    (found,) = forward(collocation, [x])
    residual, free = transcription.residual_n(x, setting), transcription.free_dofs
    left = np.sum(gradient[:, free] * found.step[:, free])
    assert left == pytest.approx(np.sum(y[:, free] * residual), rel=1e-9)


def test_held_nodes_have_no_sensitivity():
    collocation = Collocation([released_cube(4)], GUESS)
    _, positions = disturbed(collocation)
    (found,) = forward(collocation, positions)
    held = collocation.transcriptions[0].prescribed_dofs
    for part in (found.step[0], found.by_p[0], found.step[:, held], found.by_p[:, held]):
        assert not part.any()


def test_chunks_do_not_show(monkeypatch: pytest.MonkeyPatch):
    collocation = Collocation([measured(hung_cube(7))], GUESS, "bdf2")
    z, positions = disturbed(collocation)
    (whole,) = forward(collocation, positions)
    multipliers = constraint_multipliers(collocation, z)
    monkeypatch.setattr(sweep, "CHUNK_BYTES", 1)
    (parts,) = forward(collocation, positions)
    np.testing.assert_allclose(parts.step, whole.step, rtol=1e-10, atol=1e-15)
    np.testing.assert_allclose(parts.by_p, whole.by_p, rtol=1e-10, atol=1e-15)
    np.testing.assert_allclose(constraint_multipliers(collocation, z), multipliers, rtol=1e-9)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_the_first_rows_do_not_depend_on_later_rows(scheme: str):
    collocation = Collocation([hung_cube(8)], GUESS, scheme)
    _, (x,) = disturbed(collocation)
    (whole,) = forward(collocation, [x])
    (transcription,) = collocation.transcriptions
    part = Sweep(transcription, rows=5).forward(x[:5], only_setting(collocation))
    np.testing.assert_allclose(part.step, whole.step[:5], rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(part.by_p, whole.by_p[:5], rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("done", [2, 3, 5])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_the_first_rows_can_be_continued(scheme: str, done: int):
    collocation = Collocation([hung_cube(8)], GUESS, scheme)
    _, (x,) = disturbed(collocation)
    (whole,) = forward(collocation, [x])
    (transcription,) = collocation.transcriptions
    setting = only_setting(collocation)
    first = Sweep(transcription, done).forward(x[:done], setting)
    continued = Sweep(transcription).forward(x, setting, first)
    np.testing.assert_allclose(continued.step, whole.step, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(continued.by_p, whole.by_p, rtol=1e-9, atol=1e-15)
    assert continued.violation_n == pytest.approx(whole.violation_n)


def test_rows_one_by_one_are_the_same_sensitivities():
    collocation = Collocation([hung_cube(5)], GUESS)
    _, (x,) = disturbed(collocation)
    (whole,) = forward(collocation, [x])
    rows = Sweep(collocation.transcriptions[0]).sensitivities(x, only_setting(collocation))
    np.testing.assert_allclose(np.stack(list(rows)), whole.by_p, rtol=1e-9, atol=1e-15)


def test_indefinite_blocks_are_counted():
    """Rayleigh's damping makes them so where elements are squashed; the objective law does not."""
    collocation = Collocation([with_papers_damping(hung_cube(6))], GUESS)
    (transcription,) = collocation.transcriptions
    x = np.tile(transcription.body.nodes_m.ravel(), (transcription.grid_times, 1))
    x.reshape(len(x), -1, 3)[3:, :, 2] *= 0.05
    jacobian = collocation.jacobian(collocation.pack(GUESS.guess_q, [x])).toarray()
    count, expected = len(transcription.free_dofs), 0
    for t in range(transcription.grid_times):
        columns = collocation.nq + t * transcription.dof_count + transcription.free_dofs
        block = jacobian[t * count : (t + 1) * count, columns]
        expected += int(np.linalg.eigvalsh(-block)[0] <= 0)
    assert expected > 0
    assert forward(collocation, [x])[0].indefinite_count == expected


def test_states_that_are_not_finite_are_refused_with_their_time():
    collocation = Collocation([hung_cube(5)], GUESS)
    _, (x,) = disturbed(collocation)
    x[3] = np.nan
    with pytest.raises(SimulationError, match=r"'hung cube'.*not finite"):
        forward(collocation, [x])


def test_time_is_accounted_for():
    collocation = Collocation([hung_cube(5)], GUESS)
    _, (x,) = disturbed(collocation)
    stopwatch = Stopwatch()
    solver = Sweep(collocation.transcriptions[0], stopwatch=stopwatch)
    solver.forward(x, only_setting(collocation))
    assert stopwatch.evaluations > 0
    assert stopwatch.linear_algebra > 0


@pytest.mark.parametrize("has_papers_damping", [True, False])
def test_sweeps_in_single_precision_are_as_accurate(monkeypatch, has_papers_damping: bool):
    """As for bodies with wide bands; with Kelvin–Voigt damping matrices have a skew part."""
    experiment = hung_cube(6)
    if has_papers_damping:
        experiment = with_papers_damping(experiment)
    assert experiment.body.is_unsymmetric != has_papers_damping
    collocation = Collocation([measured(experiment)], GUESS)
    (transcription,) = collocation.transcriptions
    z, (x,) = disturbed(collocation)
    part = collocation.iterates(z)[0]
    expected = Sweep(transcription).forward(x, part.equations)
    monkeypatch.setattr(factorisation, "NARROW", 0)
    factorisation._cached_analysis.cache_clear()
    solver = Sweep(transcription, factorisation="band")
    assert solver.has_single_precision
    result = solver.forward(x, part.equations)
    for name in ("step", "by_p"):
        values = getattr(expected, name)
        np.testing.assert_allclose(getattr(result, name), values, atol=1e-8 * np.abs(values).max())
    factorisation._cached_analysis.cache_clear()
