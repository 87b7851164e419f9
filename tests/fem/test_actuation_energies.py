"""Length and volume as functions of node positions, and the forces of tendons and pressures."""

from __future__ import annotations

from itertools import pairwise

import casadi as ca
import numpy as np
import pytest
from kit.actuation import box_with_cavity, hollow_octant, inflated
from scipy.integrate import solve_bvp

from collocation_sysid.errors import InputError
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.meshes.selection import Ball, Box, Named
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.fem.shape import EnclosedVolume, PolylineLength
from collocation_sysid.recording.pressure import Pressure
from collocation_sysid.recording.tendon import Tendon

NODES = 14


def scalars(rng) -> dict[str, PolylineLength | EnclosedVolume]:
    """A thread of four points, and five faces of each kind, on nodes in disorder."""
    points = np.array([rng.permutation(NODES)[:4] for _ in range(4)])
    flat, curved = (np.array([rng.permutation(NODES)[:k] for _ in range(5)]) for k in (3, 6))
    return {
        "length": PolylineLength(points, rng.random((4, 4)), NODES),
        "flat faces": EnclosedVolume(flat, NODES, rng.random(3)),
        "curved faces": EnclosedVolume(curved, NODES),
    }


@pytest.fixture(params=["length", "flat faces", "curved faces"])
def scalar(request, rng):
    """One of `scalars`."""
    return scalars(rng)[request.param]


@pytest.fixture
def states(rng):
    """Two states, and a direction for each."""
    return rng.standard_normal((2, 3 * NODES)), rng.standard_normal((2, 3 * NODES))


def test_derivatives_are_those_of_the_value(scalar, states):
    (x, w), h = states, 1e-6

    def slope(function):
        return (function(x + h * w) - function(x - h * w)) / (2 * h)

    matrices = [scalar.couplings.matrix(values) for values in scalar.hessian(x)]
    turned = np.stack([m @ each for m, each in zip(matrices, w, strict=True)])
    np.testing.assert_allclose(
        (scalar.gradient(x) * w).sum(axis=1), slope(scalar.evaluate), rtol=1e-7
    )
    np.testing.assert_allclose(turned, slope(scalar.gradient), atol=1e-7)
    np.testing.assert_allclose(scalar.hessian_derivative(x, w), slope(scalar.hessian), atol=1e-7)


def test_second_derivatives_equal_those_of_a_computer_algebra(rng, states):
    x = ca.SX.sym("x", 3, NODES)
    points = np.array([rng.permutation(NODES)[:4] for _ in range(4)])
    weights, faces = (rng.random((4, 4)), np.array([rng.permutation(NODES)[:3] for _ in range(5)]))
    ends = [ca.mtimes(x[:, p.tolist()], w) for p, w in zip(points, weights, strict=True)]
    length = sum(ca.norm_2(b - a) for a, b in pairwise(ends))
    volume = sum(ca.det(x[:, face.tolist()]) / 6 for face in faces)
    for energy, mine in (
        (length, PolylineLength(points, weights, NODES)),
        (volume, EnclosedVolume(faces, NODES)),
    ):
        hessian = ca.Function("h", [x], [ca.hessian(energy, ca.vec(x))[0]])
        expected = hessian(states[0][0].reshape(-1, 3).T).full()
        found = mine.couplings.matrix(mine.hessian(states[0][:1])[0]).toarray()
        np.testing.assert_allclose(found, expected, atol=1e-12)


@pytest.mark.parametrize("element", ["tet4", "tet10"])
def test_a_cavity_encloses_its_volume_and_its_forces_balance(element, rng):
    body = Body(box_with_cavity(), density_kg_m3=1e3, element=element)
    volume = Pressure(Named("wall"), 1e3).on_body(body).require_measure()
    assert volume is not None
    assert not volume.rim.size
    assert volume.evaluate(body.nodes_m.reshape(1, -1))[0] == pytest.approx(1e-6, rel=1e-12)
    bent = body.nodes_m + 1e-3 * rng.standard_normal(body.nodes_m.shape)
    force = volume.gradient(bent.reshape(1, -1)).reshape(-1, 3)
    np.testing.assert_allclose(force.sum(axis=0), 0, atol=1e-17)
    np.testing.assert_allclose(np.cross(bent, force).sum(axis=0), 0, atol=1e-18)


def test_curved_faces_enclose_the_volume_of_a_finer_flat_surface():
    body = Body(box_with_cavity(), density_kg_m3=1e3, element="tet10")
    volume = Pressure(Named("wall"), 1e3).on_body(body).require_measure()
    assert volume is not None
    centre = np.full(3, 0.015)
    away = body.nodes_m - centre
    bulged = centre + away * (1 + (0.01 / np.linalg.norm(away, axis=1).clip(1e-3)) ** 2)[:, None]
    sums = {}
    for cuts in (4, 8, 16):
        points = [(i / cuts, j / cuts) for i in range(cuts + 1) for j in range(cuts + 1 - i)]
        number = {(round(i * cuts), round(j * cuts)): k for k, (i, j) in enumerate(points)}
        small = [
            [number[i, j], number[i + 1, j], number[i, j + 1]]
            for i in range(cuts)
            for j in range(cuts - i)
        ] + [
            [number[i + 1, j], number[i + 1, j + 1], number[i, j + 1]]
            for i in range(cuts)
            for j in range(cuts - i - 1)
        ]
        xi, eta = np.array(points).T
        low = np.column_stack([1 - xi - eta, xi, eta])
        shape = np.hstack([low * (2 * low - 1), 4 * low * np.roll(low, -1, axis=1)])
        corners = np.einsum("pk,fkc->fpc", shape, bulged[volume.faces])[:, np.array(small)]
        sums[cuts] = np.linalg.det(corners).sum() / 6
    coarse, fine = ((4 * sums[2 * n] - sums[n]) / 3 for n in (4, 8))
    limit = (16 * fine - coarse) / 15
    assert volume.evaluate(bulged.reshape(1, -1))[0] == pytest.approx(limit, rel=1e-9)


def test_a_tendon_shortens_as_its_body_does():
    body = Body(box_mesh((0.1, 0.01, 0.01), (8, 1, 1)), density_kg_m3=1e3, element="tet10")
    points = [(x, 0.004, 0.003) for x in np.linspace(0, 0.1, 12)]
    length = Tendon(points, 1.0).on_body(body).require_measure()
    assert length is not None
    assert length.evaluate(0.9 * body.nodes_m.reshape(1, -1))[0] == pytest.approx(0.09, rel=1e-12)
    force = -length.gradient(body.nodes_m.reshape(1, -1)).reshape(-1, 3)
    assert force[body.nodes_m[:, 0] < 0.01, 0].sum() == pytest.approx(1.0)
    np.testing.assert_allclose(force.sum(axis=0), 0, atol=1e-14)


INNER, OUTER, E, NU = 0.01, 0.02, 1e5, 0.3
LAMES = {"mu_pa": E / 2 / (1 + NU), "lambda_pa": E * NU / (1 + NU) / (1 - 2 * NU)}


def inner_radius_of_a_sphere(pressure_pa: float) -> float:
    """Of a thick-walled compressible Neo-Hookean sphere: its radial equation, by collocation.

    With s = dr/dR and t = r/R: P_r' + 2 (P_r − P_t) / R = 0, P_r = −p t² inside, 0 outside.
    """
    mu, lam = LAMES.values()

    def radial(s, t):
        return mu * (s - 1 / s) + lam * np.log(s * t * t) / s

    def rhs(R, y):
        (r, s), log = y, np.log(y[1] * (y[0] / R) ** 2)
        t = r / R
        around = mu * (t - 1 / t) + lam * log / t
        by_s = mu * (1 + 1 / s**2) + lam * (1 - log) / s**2
        by_t = 2 * lam / (s * t)
        return np.array([s, (-2 * (radial(s, t) - around) - by_t * (s - t)) / R / by_s])

    def ends(inside, outside):
        t = inside[0] / INNER
        at_wall = radial(inside[1], t) + pressure_pa * t**2
        return np.array([at_wall, radial(outside[1], outside[0] / OUTER)]) / mu

    R = np.linspace(INNER, OUTER, 50)
    found = solve_bvp(rhs, ends, R, np.array([R * 1.05, np.ones_like(R)]), tol=1e-9)
    assert found.success
    return float(found.sol(INNER)[0])


def test_an_inflated_sphere_converges_to_its_radial_solution():
    pressure_pa = 0.4 * LAMES["mu_pa"]
    radius_m, errors = inner_radius_of_a_sphere(pressure_pa), []
    assert radius_m > 1.15 * INNER
    for divisions in (2, 4):
        mesh = hollow_octant(INNER, OUTER, divisions, divisions)
        body = Body(mesh, density_kg_m3=1e3, element="tet10")
        volume = Pressure(Named("wall"), 1.0).on_body(body).require_measure()
        assert volume is not None
        x = inflated(body, volume, pressure_pa, LAMES, steps=2)
        wall = np.flatnonzero(mesh.point_arrays["wall"])
        errors.append(np.linalg.norm(x[wall], axis=1).mean() - radius_m)
    assert np.log2(errors[0] / errors[1]) > 1.6  # sides are straight: second order
    assert abs(errors[1]) < 0.06 * (radius_m - INNER)


def test_faces_of_a_box_or_ball_have_all_corners_inside():
    body = Body(box_with_cavity(), density_kg_m3=1e3)
    for selection in (Ball((0.015,) * 3, 0.009), Box((0.009,) * 3, (0.021,) * 3)):
        volume = Pressure(selection, 1e3).on_body(body).require_measure()
        assert volume is not None
        assert len(volume.faces) == 12


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Tendon([(0, 0, 0)], 1.0), "tendon has 1 points_m; expected at least two"),
        (lambda: Tendon([(0, 0, 0)] * 2, 1.0), "the points 1 and 2 are at the same place"),
        (lambda: Tendon([(0, 0, 0), (1, 0, 0)], -1.0), "tension_n is -1 N in row 1; expected 0"),
        (lambda: Tendon([(0, 0, 0), (1, 0, 0)], [1.0, 2.0]), "2 rows of tension_n of tendon with"),
        (
            lambda: Tendon([(0, 0, 0), (1, 0, 0)], [1.0, 2.0], [1.0, 1.0]),
            "t_s = 1 follows 1; time must increase",
        ),
        (lambda: Pressure([(0, 1, 2, 3)], 1.0), "expected a selection or a \\(F, 3\\) array"),
        (lambda: Pressure(Named("wall"), np.nan), "pressure_pa of pressure"),
    ],
)
def test_invalid_actuators_are_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Tendon([(0, 0, 0), (30, 0, 0)], 1.0), "point 2 at .* is 29.97 m outside the body"),
        (lambda: Pressure([(0, 1, 60)], 1.0), "not all faces are on the boundary"),
        (lambda: Pressure(Named("lumen"), 1.0), 'no group of faces "lumen"; it has "wall"'),
        (lambda: Pressure(Box((-1,) * 3, (1,) * 3), 1.0), "are the outer surface of the body"),
        (lambda: Pressure(Ball((9, 9, 9), 1.0), 1.0), "holds no face of the boundary"),
    ],
)
def test_actuators_that_do_not_fit_the_body_are_refused(make, message):
    with pytest.raises(InputError, match=message):
        make().on_body(Body(box_with_cavity(), density_kg_m3=1e3))
