"""Time steps in which contact is condensed to the dofs that touch, and what they cost."""

from __future__ import annotations

from unittest.mock import Mock

import numpy as np
import pytest
from kit.problems import EDGE_M, IDEAL, box, vertex_markers

import collocation_sysid as cs
from collocation_sysid.model.contact.force import contact_terms
from collocation_sysid.model.dynamics import Dynamics
from collocation_sysid.program.forward import condensed_steps, newton_solver
from collocation_sysid.program.forward.scheme_simulation import simulate_scheme
from collocation_sysid.program.linear_algebra.factorisation import Factoriser
from collocation_sysid.program.linear_algebra.lapack import solve_band_in_blocks
from collocation_sysid.recording import Cuboid, Experiment, Grasp, Obstacle, Plane, PoseSequence

STEPS = 12
SCHEME = "bdf2"
TRUTH = {"lambda_pa": 2e3, "mu_pa": 3e3, "gamma_r_s": 0.009, "gamma_m_1_s": 1.0}


def pressed_cube(divisions: int, steps: int, friction: float | None) -> Experiment:
    """Return the recording of the cube with a plate of this friction coefficient; None for no
    plate.
    """
    body = cs.Body(cs.box_mesh((EDGE_M,) * 3, (divisions,) * 3), density_kg_m3=30.0, threads=1)
    t_s = 0.01 * np.arange(steps + 1)
    upright = np.tile([0.0, 0.0, 0.0, 1.0], (len(t_s), 1))
    sway_share = 1 - np.cos(10 * t_s)
    foot_poses = PoseSequence(t_s, np.outer(0.004 * sway_share, [1.0, 0.0, 0.0]), upright)
    grasps: list[Grasp] = [Grasp(np.flatnonzero(body.nodes_m[:, 2] < 1e-9), foot_poses)]
    if friction is not None:
        plate_poses = PoseSequence(
            t_s, np.outer(-0.001 - 0.002 * sway_share, [0.0, 0.0, 1.0]), upright
        )
        corners = np.array([(-1.0, -1.0, EDGE_M), (0.6 * EDGE_M, 1.0, 1.0)])
        grasps.append(Obstacle(poses=plate_poses, shape=Cuboid(corners), friction=friction))
    top = np.flatnonzero(body.nodes_m[:, 2] > EDGE_M - 1e-9)
    no_tracks = np.zeros((len(t_s), len(top), 3))
    markers = cs.Markers(t_s, no_tracks, 1e-3, [f"m{k}" for k in top], body.nodes_m[top]).on_body(
        body
    )
    return Experiment(body, t_s, grasps, markers, nuisance=cs.Nuisance.none())


def simulated(experiment: Experiment) -> np.ndarray:
    """Positions (N, 3n) of all rows."""
    dynamics = Dynamics.from_experiment(experiment, SCHEME).with_theta(
        experiment.body.theta_from_values(TRUTH)
    )
    return simulate_scheme(experiment, dynamics)


def residual_n(experiment: Experiment, x: np.ndarray) -> np.ndarray:
    """Largest residual of each row after the first, on free dofs."""
    dynamics = Dynamics.from_experiment(experiment, SCHEME).with_theta(
        experiment.body.theta_from_values(TRUTH)
    )
    free = np.isnan(dynamics.prescribed_m).reshape(len(x), -1)
    return np.abs(np.where(free, dynamics.residual(x), 0.0))[1:].max(axis=1)


def without_condensation(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every step fall back to the complete equations."""
    monkeypatch.setattr(condensed_steps, "MAX_ACTIVE_DOFS", -1)


def counted_factorisations(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """A list that grows by one entry with each factorisation."""
    calls: list[int] = []
    factorise = Factoriser.factorise

    def counting(self, *arguments, **options):
        calls.append(1)
        return factorise(self, *arguments, **options)

    monkeypatch.setattr(Factoriser, "factorise", counting)
    return calls


@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_steps_in_contact_take_hardly_more_factorisations_than_without(friction, monkeypatch):
    """After the equilibrium at the start and two steps at most one in three steps."""
    calls = counted_factorisations(monkeypatch)
    simulated(pressed_cube(3, 2, friction))
    at_start = len(calls)
    calls.clear()
    simulated(pressed_cube(3, 2 + STEPS, friction))
    assert len(calls) - at_start <= STEPS // 3


@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_condensed_steps_have_the_solution_of_the_complete_equations(friction, monkeypatch):
    experiment = pressed_cube(3, STEPS, friction)
    x = simulated(experiment)
    assert residual_n(experiment, x).max() < 1e-9
    without_condensation(monkeypatch)
    complete = simulated(experiment)
    np.testing.assert_allclose(x, complete, atol=1e-12)
    # The plate moved the body: there is contact.
    alone = simulated(pressed_cube(3, STEPS, None))
    assert np.abs(x[:, : alone.shape[1]] - alone).max() > 1e-4


def test_dofs_along_axes_without_a_force_are_not_condensed(monkeypatch):
    """A plate without friction presses along one axis, with friction along all three."""
    factorise = condensed_steps.CondensedStiffness.from_matrices
    sizes: list[int] = []

    def counting(compliance, stiffness):
        sizes.append(len(stiffness))
        return factorise(compliance, stiffness)

    monkeypatch.setattr(condensed_steps.CondensedStiffness, "from_matrices", counting)
    largest = []
    for friction in (0.0, 0.3):
        simulated(pressed_cube(3, 2, friction))
        largest.append(max(sizes))
        sizes.clear()
    assert 3 * largest[0] == largest[1]


def test_steps_that_cannot_be_condensed_are_solved_completely(monkeypatch):
    """Here the dofs that touch are too many, or never converge."""
    experiment = pressed_cube(3, 4, 0.3)
    x = simulated(experiment)
    for name, value in (("MAX_ACTIVE_DOFS", 3), ("MAX_LOCAL_ITERATIONS", 0)):
        with monkeypatch.context() as patched:
            patched.setattr(condensed_steps, name, value)
            np.testing.assert_allclose(simulated(experiment), x, atol=1e-12)


def test_contact_that_a_step_makes_and_undoes_is_not_condensed(capfd):
    """A point touches at the end of the step without contact, but not at the end of that with it:
    no dof is left, and LAPACK reports empty matrices.
    """

    def points(*dofs: int) -> Mock:
        found = Mock(dofs=np.array(dofs, dtype=np.int64))
        found.assemble_force.return_value = 2.0 * np.ones(len(dofs))
        found.assemble_stiffness.return_value = np.eye(len(dofs))
        return found

    def at_dofs(dofs):
        each = np.eye(3)[dofs]
        return condensed_steps.ActiveCompliance(dofs, each, np.asfortranarray(each[:, dofs]))

    compliance = Mock(active_dofs=lambda found: found, at_dofs=at_dofs)
    compliance.factor.solve = lambda right: right
    equations = Mock(local_weight=1.0, residual_without_local=np.ones_like)
    equations.active_points.side_effect = [points(), points(1), points()]
    steps = condensed_steps.CondensedSteps(equations, compliance, np.arange(3), 1.0)
    with pytest.raises(condensed_steps.CondensationError):
        steps.step_from(np.zeros(3))
    assert capfd.readouterr() == ("", "")


def between_two_obstacles() -> Experiment:
    """A cube below a plate that comes down and rubs, and beside a smooth bar that comes later."""
    body = box()
    t_s = 0.01 * np.arange(STEPS)
    foot = np.flatnonzero(body.nodes_m[:, 2] < 1e-9)
    top = np.flatnonzero(body.nodes_m[:, 2] > EDGE_M - 1e-9)
    down = np.array([0.0, 0.0, -1.0])
    later_s = np.clip(t_s - 0.03, 0.0, None)
    bar = np.array([(-1.0, -1.0, 0.06), (-0.002, 1.0, 0.09)])
    plate = Obstacle(
        name="plate",
        poses=moved(t_s, np.outer(0.05 * t_s, down)),
        shape=Plane(down, np.array([0.0, 0.0, EDGE_M])),
        friction=0.3,
    )
    side = Obstacle(
        name="bar",
        poses=moved(t_s, np.outer(0.1 * later_s, [1.0, 0.0, 0.0])),
        shape=Cuboid(bar, 0.01),
    )
    return Experiment(
        body,
        t_s,
        [Grasp(foot, PoseSequence.fixed()), plate, side],
        vertex_markers(body, top, t_s),
        nuisance=IDEAL,
    )


def moved(t_s: np.ndarray, way_m: np.ndarray) -> PoseSequence:
    """Poses along a way (T, 3), without rotation."""
    return PoseSequence(t_s, way_m, np.tile([0.0, 0.0, 0.0, 1.0], (len(t_s), 1)))


def test_two_obstacles_touch_at_once(monkeypatch):
    experiment = between_two_obstacles()
    x = simulated(experiment)
    assert residual_n(experiment, x).max() < 1e-9
    for term in contact_terms(experiment):
        y = term.points.vectors(x[-1:])
        assert term.law_of_contact.gaps(y).min() < 0.0
    without_condensation(monkeypatch)
    np.testing.assert_allclose(x, simulated(experiment), atol=1e-11)


def test_stored_columns_of_the_compliance_are_limited(monkeypatch):
    """Those of other dofs are computed anew; more than the limit at once are refused."""
    size = 6
    factor = Mock()
    factor.solve = lambda right: 2.0 * right
    compliance = condensed_steps.Compliance(factor, np.arange(size), dof_count=size)
    monkeypatch.setattr(condensed_steps, "MAX_COLUMN_ENTRIES", 3 * size)
    for dofs in ([0, 1], [1, 2], [3, 4, 5], [0, 5], [0, 4, 5]):
        np.testing.assert_array_equal(
            compliance.columns_at(np.array(dofs)), 2.0 * np.eye(size)[dofs]
        )
    with pytest.raises(condensed_steps.CondensationError):
        compliance.columns_at(np.array([0, 1, 2, 3]))


@pytest.mark.parametrize(
    ("size", "half_bandwidth"), [(5, 0), (9, 8), (200, 30), (200, 64), (200, 130)]
)
def test_a_band_is_solved_in_blocks_as_a_full_matrix(size, half_bandwidth):
    rng = np.random.default_rng(size + half_bandwidth)
    band = np.asfortranarray(rng.normal(size=(half_bandwidth + 1, size)))
    band[0] = 2.0 + half_bandwidth + rng.random(size)
    lower = np.zeros((size, size))
    for k in range(half_bandwidth + 1):
        lower[np.arange(k, size), np.arange(size - k)] = band[k, : size - k]
        # What is stored beyond the end of the matrix does not matter.
        band[k, size - k :] = np.nan
    right = rng.normal(size=(size, 7))
    before = right.copy()
    np.testing.assert_allclose(
        solve_band_in_blocks(band, right),
        np.linalg.solve(lower @ lower.T, right),
        rtol=1e-9,
        atol=1e-12,
    )
    np.testing.assert_array_equal(right, before)


def test_a_simulation_without_contact_does_not_condense(monkeypatch):
    def refuse(*arguments, **options):
        raise AssertionError

    monkeypatch.setattr(newton_solver, "CondensedSteps", refuse)
    simulated(pressed_cube(2, 3, None))
