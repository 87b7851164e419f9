"""Viscoelastic memory along trajectories: derivatives and identification."""

from __future__ import annotations

import numpy as np
import pytest
from kit.checks import directional_derivative, relative_error
from kit.memories import ONE, TWO, guesses, recorded, remembering, truth

from collocation_sysid.errors import InputError
from collocation_sysid.methods.comparison.shooting import Shooting
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.program.collocation import Collocation, ExperimentIterate
from collocation_sysid.program.forward.scheme_simulation import simulate_scheme
from collocation_sysid.program.simulation import simulate
from collocation_sysid.program.sweep import Sweep

KINDS = {
    "relaxed": ("hung-cube", {}),
    "loaded": ("hung-cube", {"loaded_since_s": 0.04}),
    "undeformed": ("released-cube", {}),
    "let-go": ("bar-let-go", {}),
    "off-in-its-grasp": ("bar-with-nuisance", {}),
    "driven": ("driven-bar", {}),
}


@pytest.fixture(
    params=[(kind, "midpoint") for kind in KINDS]
    + [("loaded", "bdf2"), ("undeformed", "backward-euler")],
    ids="-".join,
)
def collocation(request: pytest.FixtureRequest) -> Collocation:
    kind, scheme = request.param
    name, changes = KINDS[kind]
    return Collocation([remembering(name, 5, 2, **changes)], guesses(TWO, 1.1), scheme)


def some_parameters(collocation: Collocation) -> np.ndarray:
    phi = 0.3 * np.random.default_rng(1).standard_normal(collocation.nphi)
    return np.concatenate([collocation.parameters.guess_q, phi])


def marched(collocation: Collocation, p: np.ndarray) -> ExperimentIterate:
    """The experiment simulated at p."""
    (transcription,) = collocation.transcriptions
    (part,) = collocation.iterates_at(p, [np.zeros((0, transcription.dof_count))])
    x = simulate_scheme(transcription.experiment, part.equations.dynamics)
    return ExperimentIterate(transcription, part.q, part.phi, x)


def disturbed(part: ExperimentIterate, size_m: float = 1e-4) -> np.ndarray:
    """Positions that do not satisfy the equations of motion."""
    transcription = part.transcription
    change = np.zeros_like(part.x)
    free = (len(part.x), len(transcription.free_dofs))
    change[:, transcription.free_dofs] = np.random.default_rng(0).standard_normal(free)
    first = transcription.dynamics.first_row
    x = part.x.copy()
    x[first:] += size_m * transcription.dynamics.zero_prescribed_forces(change)[first:]
    return x


def test_marched_trajectories_satisfy_the_equations(collocation: Collocation):
    part = marched(collocation, some_parameters(collocation))
    assert np.abs(part.compute_residual_n()).max() < 1e-12 * part.transcription.force_n


@pytest.mark.long
def test_sensitivities_are_those_of_simulations(collocation: Collocation):
    p = some_parameters(collocation)
    part = marched(collocation, p)
    found = Sweep(part.transcription).forward(part.x, part.equations).by_p
    for k, place in enumerate(part.transcription.dynamic_parameters):
        expected = directional_derivative(
            lambda at: marched(collocation, at).x, p, np.eye(len(p))[place]
        )
        assert relative_error(found[:, :, k], expected) < 1e-6
    rows = Sweep(part.transcription).sensitivities(part.x, part.equations)
    np.testing.assert_array_equal(np.stack(list(rows)), found)


def test_a_sweep_may_be_continued(collocation: Collocation):
    part = marched(collocation, some_parameters(collocation))
    x, setting = disturbed(part), part.equations
    known = Sweep(part.transcription, 3).forward(x[:3], setting)
    continued = Sweep(part.transcription).forward(x, setting, known)
    whole = Sweep(part.transcription).forward(x, setting)
    np.testing.assert_allclose(continued.by_p, whole.by_p, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(continued.step, whole.step, rtol=1e-12, atol=1e-15)


def test_the_feasibility_step_solves_the_linearised_equations(collocation: Collocation):
    part = marched(collocation, some_parameters(collocation))
    transcription, setting, x = part.transcription, part.equations, disturbed(part)
    step = Sweep(transcription).forward(x, setting).step
    change = directional_derivative(lambda at: transcription.residual_n(at, setting), x, step)
    assert relative_error(change, -transcription.residual_n(x, setting)) < 1e-9


def test_backward_is_the_transpose_of_forward(collocation: Collocation, rng):
    part = marched(collocation, some_parameters(collocation))
    transcription, setting, x = part.transcription, part.equations, disturbed(part)
    gradient = rng.standard_normal(x.shape)
    y = Sweep(transcription).backward(x, setting, gradient)
    step = Sweep(transcription).forward(x, setting).step
    residual = setting.dynamics.residual(x)
    residual[:, transcription.prescribed_dofs] = 0
    residual = setting.dynamics.zero_prescribed_forces(residual)
    expected = float(
        np.sum(gradient[:, transcription.free_dofs] * step[:, transcription.free_dofs])
    )
    assert float(np.sum(y * residual)) == pytest.approx(expected, rel=1e-9)


def test_derivatives_are_pulled_back_through_the_memory(collocation: Collocation, rng):
    part = marched(collocation, some_parameters(collocation))
    p = some_parameters(collocation)
    z = collocation.pack(p, [disturbed(part)])
    multipliers, direction = (
        rng.standard_normal(n) for n in (collocation.constraint_count, len(z))
    )
    expected = directional_derivative(
        lambda at: multipliers @ collocation.constraint_values(at), z, 0.1 * direction
    )
    found = collocation.jacobian_vjp(z, multipliers) @ (0.1 * direction)
    assert found == pytest.approx(float(expected), rel=1e-8)


def test_the_memory_that_made_a_recording_is_found():
    collocation = Collocation([recorded("hung-cube", 40, 2)], guesses(TWO))
    solution = ReducedSpace()(collocation)
    assert solution.status.converged
    for name, value in TWO.items():
        assert solution.parameters[name] == pytest.approx(value, rel=1e-5), name
    assert solution.kkt_residual < 1e-8


def test_shooting_finds_the_same():
    collocation = Collocation([recorded("hung-cube", 20)], guesses(ONE, 1.2))
    solution = Shooting()(collocation)
    for name, value in ONE.items():
        assert solution.parameters[name] == pytest.approx(value, rel=1e-5), name


def test_second_derivatives_along_the_motion_are_refused():
    collocation = Collocation([recorded("hung-cube", 5)], guesses(ONE))
    with pytest.raises(InputError, match="'gauss-newton'"):
        ReducedSpace(hessian="exact")(collocation)


@pytest.mark.parametrize("kind", ["relaxed", "loaded", "undeformed"])
def test_newmark_and_the_schemes_meet_as_the_step_shrinks(kind: str):
    name, changes = KINDS[kind]
    experiment = remembering(name, 6, 2, **changes)
    fine = simulate(experiment, TWO, "midpoint", substeps=16).positions_m
    moved = np.abs(fine - fine[0]).max()
    for integrator, count in (("newmark", 8), ("bdf2", 16)):
        step_s = experiment.timestep_s / count
        found = simulate(experiment, TWO, integrator, timestep_s=step_s, substeps=count)
        assert np.abs(found.positions_m - fine).max() < 8e-3 * moved


def test_a_share_of_zero_is_no_memory():
    experiment = remembering("hung-cube", 6, 2)
    none = TWO | {"prony_1.share": 0.0, "prony_2.share": 0.0}
    forgetful = remembering("hung-cube", 6, 0)
    expected = simulate(forgetful, truth(0), "midpoint", substeps=1).positions_m
    found = simulate(experiment, none, "midpoint", substeps=1).positions_m
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13)
