"""External forces and their derivatives, also by inputs."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from kit.checks import assert_derivative
from kit.densities import parameters, with_core
from kit.forces import breath, forces_alone, foundation
from kit.internal_force_check import full_matrix
from kit.problems import GUESS, driven_bar, hung_cube, nodes_where

from collocation_sysid.common.time_dependence import at_times, interpolate_in_time, scale_loads
from collocation_sysid.errors import InputError
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.meshes.selection import Box
from collocation_sysid.fem.node_force import NodeForce
from collocation_sysid.model.force_term import States
from collocation_sysid.model.forces import Forces
from collocation_sysid.model.parameters import Parameters, Unknown
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.program.transcription import Transcription
from collocation_sysid.recording import Experiment, Force, Markers, Nuisance, PointMass

# Of a tendon whose tension grows and a pressure that stays.
BAR = driven_bar()
FROM_S, TO_S, SHARE = np.array([0.02, 0.03]), np.array([0.05, 0.07]), 0.25
ROWS = slice(2, 5)


def tension_n(t_s: np.ndarray) -> np.ndarray:
    return 0.02 + 0.5 * t_s


def joined_cube() -> Experiment:
    """A cube of two densities that a mass and a force join, under gravity that may be tilted."""
    cube = with_core(hung_cube(8))
    tip = nodes_where(cube.body, 2, 0.0)
    return replace(
        cube,
        masses=(PointMass(tip, 0.01, 0.02),),
        forces=(Force(tip, [0.01, 0.02, 0.03], from_s=0.03, until_s=0.06),),
        nuisance=Nuisance.none(joining_s=0.01, gravity_rad=0.03, pose_turn_rad=0.02),
    )


def drag(x, v, at, drag_coefficient):
    """Of air, by the share of the surface."""
    return -0.6 * drag_coefficient * at.area_m2 * ca.sqrt(ca.sumsqr(v) + 1e-4) * v


def cube_in_air() -> Collocation:
    """A hung cube with forces of a user, on all of its nodes and on some."""
    old = hung_cube(8)
    forces = [
        NodeForce.from_law(drag),
        NodeForce.from_law(foundation, nodes=nodes_where(old.body, 2, 0.0)),
    ]
    body = Body(old.body.mesh, density_kg_m3=30.0, forces=forces)
    given = {"drag_coefficient": 1.1, "bed_n_m3": 900.0, "whirl_n_m3": 4e4}
    known = Parameters.from_mapping({name: Unknown(value) for name, value in given.items()})
    return Collocation([replace(old, body=body)], Parameters((*GUESS.items, *known.items)))


def breathed(element: str) -> Collocation:
    """A hung cube with a force of a user on some of its faces."""
    old = hung_cube(8, (1, 1, 2))
    force = NodeForce.from_law(breath, nodes=Box((-1, -1, -1), (1, 1, 0.051)), on="faces")
    body = Body(old.body.mesh, density_kg_m3=30.0, element=element, forces=[force])
    markers = Markers(old.t_s, np.zeros((9, 1, 3)), 1e-3, places_m=[[0.1, 0.1, 0.0]])
    grasp = replace(old.grasps[0], nodes=nodes_where(body, 2, 0.1), selection=None)
    known = Parameters.from_mapping({"breath_pa": Unknown(3.0), "brake_pa_s_m": Unknown(2.0)})
    experiment = replace(old, body=body, grasps=[grasp], markers=markers)
    return Collocation([experiment], Parameters((*GUESS.items, *known.items)))


CASES = {
    "of a user, on faces": lambda: breathed("tet4"),
    "of a user, on quadratic faces": lambda: breathed("tet10"),
    "of a user": cube_in_air,
    "tendon and pressure": lambda: Collocation([BAR], GUESS),
    "of the air": lambda: Collocation(
        [replace(joined_cube(), air_density_kg_m3=20.0)], parameters()
    ),
    "weight and loads": lambda: Collocation([joined_cube()], parameters()),
}


# `check_force` checks the derivatives of forces of a user.
BUILT_IN = [name for name in CASES if not name.startswith("of a user")]


@pytest.fixture(params=CASES)
def transcription(request) -> Transcription:
    return CASES[request.param]().transcriptions[0]


def states(transcription: Transcription, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities at the evaluations of `ROWS`."""
    nodes_m = transcription.body.nodes_m.ravel()
    count = len(range(*ROWS.indices(transcription.grid_times)))
    xi = nodes_m + rng.normal(scale=2e-4, size=(count, len(nodes_m)))
    return xi, 0.1 * rng.normal(size=xi.shape)


def some_inputs(transcription: Transcription, rng: np.random.Generator) -> np.ndarray:
    """U (T, U), shaken."""
    p = np.concatenate(
        [transcription.parameters.guess_q, np.zeros(len(transcription.nuisance.motion_indices))]
    )
    u = transcription.inputs.evaluate_at(p)[0][ROWS]
    return u * (1 + 0.1 * rng.normal(size=u.shape[1]))


def forces_at(transcription: Transcription, u: np.ndarray) -> Forces:
    """The forces at inputs."""
    whole = np.broadcast_to(u[0], (transcription.grid_times, u.shape[1])).copy()
    whole[ROWS] = u
    return at_times(transcription.dynamics.with_inputs(whole).forces, ROWS)


def test_tendon_and_pressure_energies_are_length_and_volume_times_input(rng):
    xi = states(Collocation([BAR], GUESS).transcriptions[0], rng)[0][:2]
    tendon, pressure = BAR.actuators
    expected = -tension_n(FROM_S)[:, None] * tendon.require_measure().gradient(xi)
    expected -= pressure.energy_amplitude_at(FROM_S)[:, None] * pressure.require_measure().gradient(
        xi
    )
    given = States(xi, np.zeros_like(xi), np.zeros(0))
    found = sum(term.force(given) for term in Forces.from_experiment(BAR, FROM_S).external_terms)
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_tendon_loss_and_factor_count_and_a_tendon_only_pulls():
    tendon, pressure = BAR.actuators
    stated = tension_n(FROM_S)
    np.testing.assert_allclose(
        tendon.with_calibration(1.2, 0.003, 0.0).energy_amplitude_at(FROM_S), 1.2 * stated - 0.003
    )
    np.testing.assert_array_equal(
        tendon.with_calibration(1.0, 1.0, 0.0).energy_amplitude_at(FROM_S), 0.0
    )
    in_chamber = -pressure.energy_amplitude_at(FROM_S)
    np.testing.assert_allclose(
        pressure.with_calibration(0.9, 2.0, 0.0).energy_amplitude_at(FROM_S),
        -(0.9 * in_chamber - 2.0),
    )
    assert pressure.with_calibration(1.0, 0.0, np.log(2)).lag_s == pytest.approx(2 * pressure.lag_s)


def test_forces_between_two_times_lie_between_their_values(transcription, rng):
    x, v = states(transcription, rng)
    theta = transcription.constants.theta(transcription.parameters.guess_q)
    here, there = (
        Forces.from_experiment(transcription.experiment, t_s, theta) for t_s in (FROM_S, TO_S)
    )
    ends = [each.total(x[:2], v[:2]) for each in (here, there)]
    for share in (0.0, SHARE, 1.0):
        found = interpolate_in_time(here, there, share=share).total(x[:2], v[:2])
        np.testing.assert_allclose(found, (1 - share) * ends[0] + share * ends[1], atol=1e-12)


def test_a_share_is_one_of_all_that_acts(transcription, rng):
    x, _ = states(transcription, rng)
    theta, still = (
        transcription.constants.theta(transcription.parameters.guess_q),
        np.zeros_like(x[:2]),
    )
    whole = Forces.from_experiment(transcription.experiment, FROM_S, theta)
    internal = transcription.body.force(x[:2], still, theta)
    outer = whole.total(x[:2], still) - internal
    found = scale_loads(whole, SHARE).total(x[:2], still) - internal
    np.testing.assert_allclose(found, SHARE * outer, atol=1e-12)
    assert np.abs(outer).max() > 1e-3


def matrix_times(forces: Forces, lower: np.ndarray, skew: np.ndarray, ways: np.ndarray):
    """(T, 3n) products with matrices given by symmetric and skew parts."""
    parts = zip(lower, skew, ways, strict=True)
    return np.stack([full_matrix(forces.pattern, a, b) @ way for a, b, way in parts])


@pytest.mark.parametrize("transcription", BUILT_IN, indirect=True)
def test_derivatives_of_forces_agree_with_differences(transcription, rng):
    (xi, nu), u = states(transcription, rng), some_inputs(transcription, rng)
    forces = forces_at(transcription, u)
    at = forces.linearise(xi, nu)
    np.testing.assert_allclose(at.force, forces.total(xi, nu), atol=1e-12)
    none = np.zeros((len(xi), 0))

    def of_inputs(change: np.ndarray) -> np.ndarray:
        other = forces_at(transcription, u * (1 + change))
        return other.total(xi, nu)

    def by_x(way: np.ndarray) -> np.ndarray:
        return matrix_times(forces, at.by_position, at.by_position_skew, way)

    def by_v(way: np.ndarray) -> np.ndarray:
        return matrix_times(forces, at.by_velocity, none, way)

    assert_derivative(lambda x: forces.total(x, nu), by_x, xi, rng, 1e-6, scale=1e-3)
    assert_derivative(lambda v: forces.total(xi, v), by_v, nu, rng, 1e-6)
    by_u = np.einsum("tiu,tu->tiu", at.by_theta, u)
    for one in np.eye(u.shape[1]):
        assert_derivative(of_inputs, lambda d: by_u @ d, np.zeros(len(one)), rng, 1e-6, one)


@pytest.mark.parametrize("transcription", BUILT_IN, indirect=True)
def test_second_derivatives_of_forces_are_those_of_the_slopes(transcription, rng):
    (xi, nu), u = states(transcription, rng), some_inputs(transcription, rng)
    w = rng.normal(size=xi.shape)
    forces = forces_at(transcription, u)
    at = forces.weighted_hessian(xi, nu, w)
    none = np.zeros((len(xi), 0))

    def slopes(x: np.ndarray, v: np.ndarray, change: np.ndarray) -> tuple[np.ndarray, ...]:
        """Of wᵀ F by x, v and u."""
        other = forces_at(transcription, u * (1 + change))
        here = other.linearise(x, v)
        by_x = matrix_times(forces, here.by_position, -here.by_position_skew, w)
        by_v = matrix_times(forces, here.by_velocity, none, w)
        return by_x, by_v, np.einsum("ti,tiu->tu", w, here.by_theta)

    steady = np.zeros(u.shape[1])
    np.testing.assert_allclose(at.theta, slopes(xi, nu, steady)[2], atol=1e-12)

    def twice(way: np.ndarray) -> np.ndarray:
        return matrix_times(forces, at.position_position, none, way)

    assert_derivative(lambda x: slopes(x, nu, steady)[0], twice, xi, rng, 1e-6, scale=1e-3)
    if at.velocity_velocity.size:
        assert_derivative(
            lambda v: slopes(xi, v, steady)[1],
            lambda way: matrix_times(forces, at.velocity_velocity, none, way),
            nu, rng, 1e-6, scale=0.1,
        )  # fmt: skip
    mixed = at.position_velocity, at.position_velocity_skew
    assert_derivative(
        lambda v: slopes(xi, v, steady)[0],
        lambda way: matrix_times(forces, *mixed, way),
        nu, rng, 1e-6, scale=0.1,
    )  # fmt: skip
    found = np.einsum("tiu,tu->tiu", at.position_theta, u)
    rates = np.einsum("tiu,tu->tiu", at.velocity_theta, u)
    both = np.einsum("tiu,tu->tiu", at.theta_theta, u)
    for one in np.eye(len(steady)):
        for k, mixed in enumerate((found, rates, both)):
            if np.abs(mixed @ one).max() > 1e-12:
                of_u = lambda d, k=k: slopes(xi, nu, d)[k]  # noqa: E731
                assert_derivative(of_u, lambda d, m=mixed: m @ d, steady, rng, 1e-6, one)
            else:
                change = slopes(xi, nu, 1e-3 * one)[k] - slopes(xi, nu, steady)[k]
                np.testing.assert_allclose(change, 0.0, atol=1e-10)


def test_inputs_follow_from_parameters_with_their_derivatives(transcription, rng):
    inputs = transcription.inputs
    p = np.concatenate(
        [transcription.parameters.guess_q, np.zeros(len(transcription.nuisance.motion_indices))]
    )
    weights = rng.normal(size=inputs.evaluate_at(p)[0].shape)

    def slopes(p: np.ndarray) -> np.ndarray:
        return inputs.evaluate_at(p)[1]

    by_p, twice = slopes(p), inputs.weighted_hessian(p, weights)
    for one in np.eye(len(p)):
        if by_p.any(axis=(0, 1)) @ one:
            found = lambda d: by_p @ d  # noqa: E731
            assert_derivative(lambda p: inputs.evaluate_at(p)[0], found, p, rng, 1e-6, 0.1 * one)
        weighed = np.einsum("tu,tum->m", weights, slopes(p + 1e-5 * one) - slopes(p - 1e-5 * one))
        np.testing.assert_allclose(weighed / 2e-5, twice @ one, rtol=1e-5, atol=1e-4)


def test_without_any_nothing_is_added():
    body = hung_cube().body
    x = body.nodes_m.ravel()[None]
    theta = np.array([1e3, 1e3, 0.0, 0.0])
    alone = forces_alone(body, theta)
    np.testing.assert_array_equal(alone.total(x, 0 * x), body.force(x, 0 * x, theta))
    assert alone.linearise(x, 0 * x).by_theta.shape[2] == len(theta)


@pytest.mark.parametrize("element", ["tet4", "tet10"])
def test_the_force_of_a_pressure_is_the_gradient_of_the_volume(element, rng):
    """It has no resultant, and its work is what it grows; a tetrahedron of flat faces is exact."""
    mesh = hung_cube(2).body.mesh
    force = NodeForce.from_law(
        lambda x, v, at, inner_pa: inner_pa * at.area_m2 * at.normal, on="faces"
    )
    body = Body(mesh, density_kg_m3=30.0, element=element, forces=[force])
    theta = np.array([1e-9, 1e-9, 0.0, 0.0, 7.0])
    x = body.nodes_m + rng.normal(scale=2e-3, size=body.nodes_m.shape)
    total = forces_alone(body, theta).total(x.reshape(1, -1), np.zeros((1, x.size))).reshape(-1, 3)
    np.testing.assert_allclose(total.sum(axis=0), 0.0, atol=1e-12)
    if element == "tet4":
        grown = np.einsum("ij,ij->", total, x)  # 3 p V, V being of third degree
        assert grown == pytest.approx(21.0 * volumes(x, mesh.tetrahedra).sum(), rel=1e-9)


def test_a_force_on_faces_that_are_not_there_is_refused():
    inside = Box((0.04, 0.04, 0.04), (0.06, 0.06, 0.06))
    force = NodeForce.from_law(breath, nodes=inside, on="faces")
    with pytest.raises(InputError, match="'breath' acts on faces of the surface, but no face"):
        forces_alone(Body(hung_cube(2).body.mesh, density_kg_m3=30.0, forces=[force]), np.zeros(1))
    with pytest.raises(InputError, match="on is 'edges'; expected 'nodes' or 'faces'"):
        NodeForce.from_law(breath, on="edges")  # pyright: ignore[reportArgumentType]


def volumes(points_m: np.ndarray, tetrahedra: np.ndarray) -> np.ndarray:
    a, b, c, d = np.moveaxis(points_m[tetrahedra], 1, 0)
    return np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a) / 6
