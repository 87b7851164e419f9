"""Stresses of viscoelastic materials compared with closed forms and differences."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from kit.checks import assert_derivative, observed_order, relative_error
from kit.forces import forces_alone
from kit.internal_force_check import full_matrix
from kit.memories import TWO, remembering
from kit.problems import IDEAL, point_markers, times
from scipy.spatial.transform import Rotation

from collocation_sysid.errors import InputError
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.laws.materials import Prony
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.fem.regions import Region
from collocation_sysid.model.viscoelasticity import FadingCoefficients, MemoryHistory, MemoryState
from collocation_sysid.program.simulation import simulate
from collocation_sysid.recording import Experiment, Force, Grasp, PoseSequence

SHARE, TAU_S = 0.5, 0.2
CONSTANTS = {"lambda_pa": 200.0, "mu_pa": 300.0, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
ONE = CONSTANTS | {"prony_1.share": SHARE, "prony_1.tau_s": TAU_S}


def body_of(element: str = "tet10", evaluator: str = "auto", **changes) -> Body:
    mesh = box_mesh((0.1, 0.1, 0.1), (1, 1, 1))
    given: dict[str, Any] = {"prony": ["prony_1"]} | changes
    return Body(mesh, density_kg_m3=30.0, element=element, evaluator=evaluator, **given)


def strained(body: Body, size_m: float = 0.003, states: int = 1) -> np.ndarray:
    """States (T, 3n) that are deformed at random."""
    rng = np.random.default_rng(0)
    return body.nodes_m.ravel() + size_m * rng.standard_normal((states, body.pattern.size))


def total_force(body: Body, x: np.ndarray, theta: np.ndarray, memory: MemoryState) -> np.ndarray:
    return memory.insert_at_same_time(forces_alone(body, theta)).total(x, np.zeros_like(x))[0]


def after(memory: MemoryState, x: np.ndarray, interval_s: float) -> MemoryState:
    return memory.advance(forces_alone(memory.body, memory.theta), x, 0 * x, interval_s)


# Closed forms of the standard linear solid ------------------------------------------------------


@pytest.mark.parametrize("intervals", [1, 7], ids=["one-interval", "many"])
def test_the_force_of_a_held_shape_relaxes_exponentially(intervals: int):
    body, held_s = body_of(), 0.3
    theta, (x,) = body.theta_from_values(ONE), strained(body)
    memory = after(MemoryState.at_start(body, body.nodes_m.ravel(), theta, np.inf), x, 1e-12)
    long_term = body.force(x, 0 * x, theta)[0]
    at_once = total_force(body, x, theta, memory)
    assert relative_error(at_once, (1 + SHARE) * long_term) < 1e-9
    for _ in range(intervals):
        memory = after(memory, x, held_s / intervals)
    expected = (1 + SHARE * np.exp(-held_s / TAU_S)) * long_term
    assert relative_error(total_force(body, x, theta, memory), expected) < 1e-9


def test_a_load_held_for_a_time_has_relaxed_for_that_time():
    body, held_s = body_of(), 0.3
    theta, (x,) = body.theta_from_values(ONE), strained(body)
    expected = (1 + SHARE * np.exp(-held_s / TAU_S)) * body.force(x, 0 * x, theta)[0]
    memory = MemoryState.at_start(body, x, theta, held_s)
    assert relative_error(total_force(body, x, theta, memory), expected) < 1e-12


def test_a_bar_creeps_under_a_constant_load():
    """u = u_∞ (1 − g/(1 + g) exp(−t/τ(1 + g))), far slower than the body's own motion."""
    mesh = box_mesh((0.15, 0.05, 0.05), (3, 1, 1))
    body = Body(mesh, density_kg_m3=1e-4, prony=[Prony("prony_1")])
    end = np.flatnonzero(body.nodes_m[:, 0] > 0.149)
    held = Grasp(np.flatnonzero(body.nodes_m[:, 0] < 1e-9), PoseSequence.fixed())
    t_s = times(80, 0.005)
    experiment = Experiment(
        body,
        t_s,
        [held],
        point_markers(body, body.nodes_m[end[:1]], t_s),
        (0, 0, 0),
        start="undeformed",
        forces=[Force(end, [1e-5, 0.0, 0.0])],
        nuisance=IDEAL,
    )
    moved = simulate(experiment, ONE, "backward-euler", substeps=4).positions_m[:, end[0], 0] - 0.15
    share = 1 - SHARE / (1 + SHARE) * np.exp(-t_s / (TAU_S * (1 + SHARE)))
    # The bar follows from the second step on; its last displacement gives u_∞.
    expected = moved[-1] * share / share[-1]
    assert relative_error(moved[5:], expected[5:]) < 2e-3
    assert moved[5] < 0.8 * moved[-1]


def test_an_oscillating_strain_has_the_storage_and_loss_modulus():
    """1 + g (ωτ)²/(1 + (ωτ)²), and g ωτ/(1 + (ωτ)²), at small strain."""
    body, omega, step_s = body_of("tet4"), 8.0, 1e-3
    theta, stretch = (body.theta_from_values(ONE), body.nodes_m[:, :1] * [1.0, 0.0, 0.0])
    t_s = step_s * np.arange(4000)
    xi = (body.nodes_m + 1e-5 * np.sin(omega * t_s)[:, None, None] * stretch).reshape(len(t_s), -1)
    history = MemoryHistory.from_states(body, xi, theta, np.full(len(t_s), step_s), np.inf)
    carried = history.past_at(slice(None))
    borne = (1 + carried.stiffening) * history.stress + carried.overstress
    size = history.stress[:, 0].max()
    last = t_s > t_s[-1] - 2 * np.pi / omega
    waves = np.column_stack([np.sin(omega * t_s), np.cos(omega * t_s)])[last]
    found = np.linalg.lstsq(waves, borne[last, 0] / size)[0]
    turn = omega * TAU_S
    expected = [1 + SHARE * turn**2 / (1 + turn**2), SHARE * turn / (1 + turn**2)]
    np.testing.assert_allclose(found, expected, rtol=1e-3)


# What any material must do ----------------------------------------------------------------------


def test_turning_rigidly_turns_the_force_and_changes_no_stress():
    body = body_of(prony=["prony_1", "prony_2"])
    theta, (first, second) = (body.theta_from_values(TWO), strained(body, states=2))
    memory = after(MemoryState.at_start(body, first, theta, 0.05), second, 0.02)
    turn = Rotation.from_rotvec([0.7, -1.1, 2.0]).as_matrix()
    turned = (second.reshape(-1, 3) @ turn.T).ravel()
    np.testing.assert_allclose(
        body.stresses.stress(turned[None], theta)[0], memory.stress, atol=1e-10
    )
    expected = total_force(body, second, theta, memory).reshape(-1, 3) @ turn.T
    found = total_force(body, turned, theta, after(memory, turned, 1e-12))
    assert relative_error(found.reshape(-1, 3), expected) < 1e-9


def test_no_cyclic_deformation_gains_energy(rng):
    body = body_of("tet4", prony=["prony_1", "prony_2"])
    theta, t_s = (body.theta_from_values(TWO | CONSTANTS), np.linspace(0.0, 1.0, 401))
    shapes = 2e-3 * rng.standard_normal((3, body.pattern.size))
    waves = np.stack([np.sin(2 * np.pi * k * t_s) for k in (1, 2, 5)], axis=1)
    x = body.nodes_m.ravel() + waves @ shapes
    xi = np.concatenate([x[:1], (x[1:] + x[:-1]) / 2])
    intervals = np.append(np.diff(np.append(0.0, (t_s[1:] + t_s[:-1]) / 2)), t_s[1])
    history = MemoryHistory.from_states(body, xi, theta, intervals, np.inf)
    force = body.force(xi, np.zeros_like(xi), theta, memory_input=history.past_at(slice(None)))
    work = -np.cumsum(np.sum(force[1:] * np.diff(x, axis=0), axis=1))
    stored = np.array([body.energy(each, lambda_pa=200.0, mu_pa=300.0) for each in x[1:]])
    # Beside the long-term energy there is that of the branches' springs, and what was lost.
    assert (work - stored).min() > -1e-3 * stored.max()
    assert work[-1] > 0.05 * stored.max()


@pytest.mark.parametrize("scheme", ["midpoint", "bdf2"])
def test_schemes_keep_their_order(scheme: str):
    experiment = remembering("hung-cube", 4, 2)
    finest = simulate(experiment, TWO, scheme, substeps=64).positions_m
    substeps = np.array([4, 8, 16])
    errors = [
        np.abs(simulate(experiment, TWO, scheme, substeps=int(k)).positions_m - finest).max()
        for k in substeps
    ]
    assert observed_order(1 / substeps, errors) == pytest.approx(2.0, abs=0.3)


# Derivatives ------------------------------------------------------------------------------------


@pytest.fixture(params=[("tet4", "simd"), ("tet10", "simd"), ("tet4", "casadi")], ids="-".join)
def body(request: pytest.FixtureRequest) -> Body:
    element, evaluator = request.param
    core = Region("core", np.array([0, 3]), material="yeoh", prony=["slow", "fast"])
    return body_of(element, evaluator, regions=[core])


def constants_of(body: Body) -> np.ndarray:
    usual = {"_pa": 300.0, "gamma_r_s": 0.01, "gamma_m_1_s": 0.5, "share": 0.3, "tau_s": 0.1}
    return np.array(
        [next(v for end, v in usual.items() if name.endswith(end)) for name in body.constants]
    )


def test_the_stress_gives_the_elastic_force(body: Body):
    theta, x = constants_of(body), strained(body, states=2)
    found = body.stresses.memory_force(x, body.stresses.stress(x, theta), theta)
    assert relative_error(found, body.force(x, 0 * x, theta)) < 1e-12


def test_stresses_change_along_positions_and_constants(body: Body, rng):
    theta, x, stresses = constants_of(body), strained(body), body.stresses
    assert_derivative(
        lambda at: stresses.stress(at, theta),
        lambda v: stresses.stress_jvp(x, v, theta),
        x,
        rng,
        1e-7,
        scale=1e-2,
    )
    assert_derivative(
        lambda at: stresses.stress(x, at),
        lambda v: stresses.stress_theta_derivatives(x, theta, v[:, None])[:, 0],
        theta, rng, 1e-7, scale=0.1 * theta,
    )  # fmt: skip


def test_transposed_derivatives_are_those(body: Body, rng):
    theta, x, stresses = (constants_of(body), strained(body, states=2), body.stresses)
    v, weights = (rng.standard_normal(x.shape), rng.standard_normal((2, stresses.width)))
    pulled = np.sum(stresses.stress_vjp(x, weights, theta) * v)
    assert pulled == pytest.approx(np.sum(weights * stresses.stress_jvp(x, v, theta)), rel=1e-10)
    pushed = np.sum(stresses.memory_force_vjp(x, v, theta) * weights)
    assert pushed == pytest.approx(np.sum(v * stresses.memory_force(x, weights, theta)), rel=1e-10)


def test_forces_at_a_given_memory_are_linearised(body: Body, rng):
    theta, x = constants_of(body), strained(body, states=3)
    v = rng.standard_normal(x.shape)
    stiffening = np.outer([0.1, 0.3, 0.3], np.arange(1.0, 1.0 + len(body.parts)))
    overstress = 30.0 * rng.standard_normal((3, body.stresses.width))
    carried = replace(body.memory.relaxed(3), overstress=overstress, stiffening=stiffening)
    at = body.linearise(x, v, theta, memory_input=carried)
    np.testing.assert_allclose(
        at.force, body.force(x, v, theta, memory_input=carried), rtol=1e-11, atol=1e-12
    )
    slopes = at.by_position, at.by_position_skew
    assert_derivative(
        lambda state: body.force(state, v, theta, memory_input=carried),
        lambda d: np.stack(
            [full_matrix(body.pattern, *both) @ row for *both, row in zip(*slopes, d, strict=True)]
        ),
        x, rng, 1e-7, scale=1e-2,
    )  # fmt: skip


def test_how_fast_a_branch_fades_is_exact_and_differentiated():
    body, until_next_s, loaded_s = body_of(), np.array([1e-4, 0.01, 0.3]), 0.1
    (branch,), theta = body.memory.branches, body.theta_from_values(ONE)
    share, tau_s = theta[branch.share], theta[branch.tau]
    here = FadingCoefficients.from_body(body, theta, until_next_s, loaded_s)
    np.testing.assert_allclose(here.d[0], np.exp(-until_next_s / tau_s))
    np.testing.assert_allclose(here.c[0, 0], share * np.exp(-loaded_s / tau_s))
    c = share * tau_s / until_next_s[1] * -np.expm1(-until_next_s[1] / tau_s)
    np.testing.assert_allclose(here.c[0, 2], c)
    np.testing.assert_allclose(here.a[0, 1], here.d[0, 1] * here.c[0, 1] - c)
    for k, place in enumerate((branch.share, branch.tau)):
        step = 1e-6 * np.eye(len(theta))[place]
        ahead, behind = (
            FadingCoefficients.from_body(body, at, until_next_s, loaded_s)
            for at in (theta + step, theta - step)
        )
        for j, name in enumerate("cda"):
            slope = (getattr(ahead, name) - getattr(behind, name))[0] / 2e-6
            np.testing.assert_allclose(here.by[j, k, 0], slope, rtol=1e-6, atol=1e-9)


# Descriptions -----------------------------------------------------------------------------------


def test_branches_declare_their_constants():
    body = body_of(regions=[Region("core", np.array([0, 1])), Region("tip", [2], prony=["p"])])
    assert [name for name in body.constants if "share" in name or "tau" in name] == [
        "prony_1.share",
        "prony_1.tau_s",
        "core.prony_1.share",
        "core.prony_1.tau_s",
        "tip.p.share",
        "tip.p.tau_s",
    ]
    shared = body.theta_from_values(ONE | {"tip.p.share": 0.1, "tip.p.tau_s": 1.0})
    assert list(shared).count(SHARE) == 2


def test_descriptions_that_make_no_sense_are_refused():
    with pytest.raises(InputError, match="tet10-p0"):
        body_of("tet10-p0")
    with pytest.raises(InputError, match="named 'a'"):
        body_of(prony=["a", "a"])
    with pytest.raises(InputError, match="name is 'a b'"):
        body_of(prony=["a b"])
    with pytest.raises(InputError, match="loaded_since_s"):
        remembering("released-cube", 5, loaded_since_s=1.0)
    with pytest.raises(InputError, match="loaded_since_s is -1"):
        remembering("hung-cube", 5, loaded_since_s=-1.0)
