"""Chord steps towards equilibria: the same answers with fewer factorisations, and still stable."""

from types import SimpleNamespace

import numpy as np
import pytest

import collocation_sysid as cs
from collocation_sysid.methods import trajectory_sweeps
from collocation_sysid.methods.trajectory_sweeps import SETTLED
from collocation_sysid.model.dynamics import Dynamics
from collocation_sysid.program.forward import newton_solver
from collocation_sysid.program.forward.newton_solver import (
    NewtonFailure,
    NewtonLinearisation,
    NewtonOptions,
    NewtonSolver,
)
from collocation_sysid.program.forward.scheme_simulation import continue_simulation

EDGE_M = 0.03
DEPTHS_M = np.linspace(0.0, 0.004, 7)
TRUTH = {"lambda_pa": 2e4, "mu_pa": 1e4, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}


def pressed_by_a_rough_plate() -> cs.Experiment:
    """A block that is glued below, and a plate with friction that comes down on it."""
    body = cs.Body(cs.box_mesh((EDGE_M,) * 3, (2, 2, 2)), density_kg_m3=1000.0, element="tet10")
    t_s = np.arange(len(DEPTHS_M), dtype=float)
    up = np.array([0.0, 0.0, 1.0])
    still = np.tile([0.0, 0.0, 0.0, 1.0], (len(t_s), 1))
    down = cs.PoseSequence(t_s, np.outer(-DEPTHS_M, up), still)
    glued = cs.Grasp(np.flatnonzero(body.nodes_m[:, 2] < 1e-9), cs.PoseSequence.fixed())
    plate = cs.Obstacle(
        poses=down,
        shape=cs.Plane(-up, EDGE_M * up),
        friction=0.3,
        slip=1e-6,
        name="plate",
        wrench=cs.Wrench(t_s, np.zeros((len(t_s), 3)), sigma_n=0.01),
    )
    return cs.Experiment(
        body,
        t_s,
        [glued, plate],
        kind="static",
        gravity_m_s2=np.zeros(3),
        nuisance=cs.Nuisance.none(),
    )


def simulated(experiment: cs.Experiment, mu_pa: float, **kwargs):
    """Positions at a shear modulus."""
    values = {**TRUTH, "mu_pa": mu_pa}
    dynamics = Dynamics.from_experiment(experiment, "midpoint").with_theta(
        experiment.body.theta_from_values(values)
    )
    x, failure = continue_simulation(experiment, dynamics, **kwargs)
    assert failure is None
    return x


def counting(monkeypatch) -> list[int]:
    """A list that gets an entry for every factorisation."""
    counts: list[int] = []
    factorise = NewtonSolver.factorise

    def counted(self, *args, **kwargs):
        counts.append(1)
        return factorise(self, *args, **kwargs)

    monkeypatch.setattr(NewtonSolver, "factorise", counted)
    return counts


def test_equilibria_with_friction_are_those_of_newton_steps(monkeypatch):
    experiment = pressed_by_a_rough_plate()
    counts = counting(monkeypatch)
    x = simulated(experiment, 1e4)
    chord_count = len(counts)
    near = simulated(experiment, 1.2e4, options=SETTLED, approximate_solution=x)
    from_scratch = simulated(experiment, 1.2e4)
    # No chord step shrinks so fast.
    monkeypatch.setattr(newton_solver, "SLOWEST_CHORD_RATE", 0.0)
    counts.clear()
    newton = simulated(experiment, 1e4)
    newton_count = len(counts)
    assert np.abs(x - newton).max() < 1e-10 * EDGE_M
    assert np.abs(near - from_scratch).max() < 1e-9 * EDGE_M
    # The plate is pressed, and drags the top sideways on its way.
    assert np.abs(x - x[0]).max() > 0.9 * DEPTHS_M[-1]
    assert chord_count < 0.8 * newton_count


def double_well(solver: NewtonSolver, factor: float):
    """Residual and derivative −k u (u² − h²)/h² of the first free dof, other dofs being springs."""
    free = solver.free
    h_m = 0.1
    middle_m = solver.body.nodes_m.ravel()
    (first,) = np.flatnonzero(
        (solver.pattern.rows == free[0]) & (solver.pattern.columns == free[0])
    )

    def residual(x):
        u = x - middle_m
        force = -u
        own = u[free[0]]
        force[free[0]] = -factor * own * (own**2 - h_m**2) / h_m**2
        return force

    def linearise(x):
        own = (x - middle_m)[free[0]]
        symmetric = np.zeros(len(solver.pattern.rows))
        symmetric[solver.pattern.diagonal] = 1.0
        symmetric[first] = factor * (3 * own**2 - h_m**2) / h_m**2
        return NewtonLinearisation(residual(x), symmetric, skew=np.zeros(0))

    return residual, linearise


@pytest.mark.parametrize("checks_stability", [True, False])
def test_an_unstable_equilibrium_is_found_out_by_its_own_factor(checks_stability):
    """A known factor leads to the middle of two wells; only there is the stiffness negative."""
    experiment = pressed_by_a_rough_plate()
    options = NewtonOptions(checks_stability=checks_stability)
    solver = NewtonSolver(experiment, options)
    residual, linearise = double_well(solver, factor=1.0)
    start = solver.body.nodes_m.ravel().copy()
    # A negative stiffness makes chord steps with this factor grow: they are those of −1.
    definite = linearise(start)
    entries = definite.symmetric.copy()
    entries[entries < 0] = 1.0
    solver.definite_factor = solver.factoriser.factorise(entries)
    if checks_stability:
        with pytest.raises(NewtonFailure, match="positive definite"):
            solver.solve_equilibrium(start, residual, linearise)
    else:
        # It is left to the caller, which the next test shows.
        x = solver.solve_equilibrium(start, residual, linearise)
        assert np.abs(x - start).max() < 1e-12


def test_a_sweep_along_unstable_equilibria_searches_stable_equilibria(monkeypatch):
    sought: list[bool] = []
    swept: list[float] = []

    def continued(experiment, dynamics, options, **kwargs):
        sought.append(options.checks_stability)
        return np.full((1, 3), float(len(sought))), None

    def sweep(solver, transcription, p, trajectory, previous, **options):
        swept.append(float(trajectory[0, 0]))
        unstable = int(len(swept) == 1)
        return SimpleNamespace(report=SimpleNamespace(indefinite_steps=unstable))

    part = SimpleNamespace(
        x=np.zeros((1, 3)),
        equations=SimpleNamespace(
            dynamics=SimpleNamespace(is_static=True, truncated_to=lambda rows: None)
        ),
    )
    module = trajectory_sweeps
    monkeypatch.setattr(module, "continue_simulation", continued)
    monkeypatch.setattr(module, "sweep", sweep)
    monkeypatch.setattr(module, "ExperimentIterate", lambda *args, **kwargs: part)
    monkeypatch.setattr(module, "extrapolate", lambda *args, **kwargs: None)
    nothing = SimpleNamespace(experiment=None, stopwatch=None, nq=0, has_retraction=False)
    result = module.sweep_after_step(
        nothing, nothing, p=np.zeros(1), previous=nothing, step=np.zeros(1)
    )
    assert sought == [False, True]
    assert swept == [1.0, 2.0]
    assert not result.report.indefinite_steps
