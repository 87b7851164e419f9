"""Quadratic tetrahedra with constant pressure, which do not lock near ν = 0.5."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import casadi as ca
import numpy as np
import pytest
import scipy.sparse as sp
import skfem
from kit.checks import observed_order, relative_error
from kit.materials import COMPILED, ELASTIC, elastic, theta_for
from kit.problems import box, nodes_where, point_markers, smooth_poses, times, uneven_box
from kit.scikit_fem import Library
from scipy.sparse.linalg import spsolve
from skfem.helpers import ddot, div, dot, eye, sym_grad

from collocation_sysid.fem.body import Body
from collocation_sysid.fem.meshes.mesh import TetMesh
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.model.parameters import Parameter, Parameters
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.program.simulation import simulate, with_markers
from collocation_sysid.recording import Experiment, Grasp
from collocation_sysid.result.element_fields import ElementFields

P0 = "tet10-p0"


def of_a_user(F, lambda_pa, mu_pa):
    """Stiffer than Neo-Hooke's when sheared, and split like none of the table's."""
    log_j, stretch = ca.log(ca.det(F)), ca.sumsqr(F) - 3
    return 0.5 * lambda_pa * log_j**2 - mu_pa * log_j + mu_pa * (stretch / 2 + stretch**2 / 20)


@cache
def small_body(material: str | Callable = "neo-hookean", evaluator="auto", element=P0) -> Body:
    """Six elements, no two alike."""
    return Body(uneven_box(1), material, 30.0, element, damping="rayleigh", evaluator=evaluator)


def deformed(body: Body, rng: np.random.Generator, states: int = 1) -> np.ndarray:
    return body.nodes_m + rng.uniform(-0.003, 0.003, (states, *body.nodes_m.shape))


# Evaluators -----------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("material", ["neo-hookean", of_a_user])
def test_evaluators_agree(material, rng):
    simd, casadi = (small_body(material, name) for name in ("simd", "casadi"))
    assert simd.evaluator == "simd"
    x, (v, w) = (deformed(simd, rng, 2), rng.standard_normal((2, 2, simd.nodes_m.size)))
    assert simd.energy(x[0], **elastic(simd)) == pytest.approx(
        casadi.energy(x[0], **elastic(casadi)), rel=1e-12
    )
    for method, fields in (
        ("force", (x, v)),
        ("linearise", (x, v)),
        ("second_derivatives", (x, v, w)),
    ):
        found, expected = (
            getattr(each, method)(*fields, theta_for(each)) for each in (simd, casadi)
        )
        for name in getattr(expected, "__dataclass_fields__", [None]):
            pair = (getattr(each, name) if name else each for each in (found, expected))
            assert relative_error(*pair) < 1e-12, name


# The element ----------------------------------------------------------------------------------


@pytest.mark.parametrize("material", COMPILED)
def test_a_uniform_strain_is_felt_as_by_plain_elements(material, rng):
    body, plain = small_body(material), small_body(material, element="tet10")
    x = body.nodes_m @ (np.eye(3) + rng.uniform(-0.15, 0.15, (3, 3))).T
    found, expected = (each.elastic_force(x, **elastic(each)) for each in (body, plain))
    assert relative_error(found, expected) < 1e-12
    found, expected = (each.energy(x, **elastic(each)) for each in (body, plain))
    assert found == pytest.approx(expected, rel=1e-12)


def zero_modes(body: Body) -> int:
    spectrum = np.linalg.eigvalsh(body.stiffness(body.nodes_m, **ELASTIC).toarray())
    resisted = spectrum > 1e-12 * spectrum[-1]
    assert spectrum[resisted][0] > 1e-3 * spectrum[-1]
    return int((~resisted).sum())


def test_only_rigid_motion_is_without_energy(small_mesh):
    assert zero_modes(Body(small_mesh, density_kg_m3=30.0, element=P0)) == 6


def test_a_single_element_lets_three_conformal_motions_pass():
    """Those of ε = (b·x) I, whose mean vanishes: 24 strains but 4 · 5 + 1 that are resisted."""
    one = TetMesh([[0, 0, 0], [0.1, 0, 0], [0.02, 0.1, 0], [0.01, 0.03, 0.1]], [[0, 1, 2, 3]])
    assert zero_modes(Body(one, density_kg_m3=30.0, element=P0)) == 9


def test_the_stiffness_matrix_has_the_pattern_of_plain_elements():
    body, plain = small_body(), small_body(element="tet10")
    np.testing.assert_array_equal(body.pattern.rows, plain.pattern.rows)
    np.testing.assert_array_equal(body.pattern.columns, plain.pattern.columns)


def kinematics(body: Body, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """F (E, q, 3, 3), J (E, q), the volumes V (E, q), and the mean dilatation (E, 1)."""
    gradients = body.geometry[..., :-1].reshape(len(body.cells), 4, 10, 3)
    F = np.einsum("eai,eqaj->eqij", x[body.cells], gradients)
    J, V = np.linalg.det(F), body.geometry[..., -1]
    return F, J, V, ((V * J).sum(1) / V.sum(1))[:, None]


def test_the_energy_is_isochoric_at_points_and_volumetric_in_the_mean(rng):
    """Mooney and Rivlin's, by its two terms."""
    body = small_body("mooney-rivlin")
    x = deformed(body, rng)[0]
    F, J, V, mean = kinematics(body, x)
    assert np.ptp(J / mean) > 0.1
    C = np.swapaxes(F, -1, -2) @ F / J[..., None, None] ** (2 / 3)
    first = np.trace(C, axis1=-2, axis2=-1)
    second = (first**2 - np.trace(C @ C, axis1=-2, axis2=-1)) / 2
    c = elastic(body)
    isochoric = c["c10_pa"] * (first - 3) + c["c01_pa"] * (second - 3)
    volumetric = c["kappa_pa"] / 2 * (mean - 1) ** 2
    assert body.energy(x, **c) == pytest.approx((V * (isochoric + volumetric)).sum(), rel=1e-12)


def test_the_fields_are_those_that_the_material_feels(rng):
    body = small_body()
    x = deformed(body, rng)[0]
    _, _, V, mean = kinematics(body, x)
    fields = ElementFields.from_body(body, theta_for(body)).evaluate_at(x)
    np.testing.assert_allclose(fields["det_f"][0], mean[:, 0], rtol=1e-12)
    energy = (fields["energy_density_j_m3"][0] * V.sum(1)).sum()
    assert energy == pytest.approx(body.energy(x, **elastic(body)), rel=1e-12)
    assert (fields["von_mises_pa"] > 0).all()


# Near incompressibility, at small strains -----------------------------------------------------

YOUNG_PA = 1e4
INCOMPRESSIBLE = 0.4999


def lame(poisson: float) -> tuple[float, float]:
    return YOUNG_PA * poisson / ((1 + poisson) * (1 - 2 * poisson)), YOUNG_PA / (2 + 2 * poisson)


def stiffness(body: Body, poisson: float) -> sp.csc_array:
    return body.stiffness(body.nodes_m, young_pa=YOUNG_PA, poisson=poisson)


def deviator(u):
    return sym_grad(u) - eye(div(u) / 3, 3)


def mixed_stiffness(library: Library, poisson: float, pressure: skfem.Element) -> np.ndarray:
    """Stiffness with the pressures condensed: ∫ 2μ dev ε:dev ε + p div u − p²/(2κ)."""
    lambda_pa, mu_pa = lame(poisson)
    pressures = library.basis.with_element(pressure)
    shear = skfem.BilinearForm(lambda u, v, w: 2 * mu_pa * ddot(deviator(u), deviator(v)))
    work = skfem.BilinearForm(lambda u, q, w: div(u) * q).assemble(library.basis, pressures)
    volume = skfem.BilinearForm(lambda p, q, w: p * q).assemble(pressures)
    pressed = np.linalg.solve(volume.toarray(), work.toarray())
    volumetric = (lambda_pa + 2 / 3 * mu_pa) * work.T @ pressed
    whole = shear.assemble(library.basis) + volumetric
    return whole[np.ix_(library.dofs, library.dofs)]


@pytest.mark.parametrize("poisson", [0.0, 0.3, INCOMPRESSIBLE])
@pytest.mark.parametrize("material", ["neo-hookean", "linear"])
def test_stiffness_at_rest_is_that_of_the_mixed_element_of_constant_pressures(
    small_mesh, material, poisson
):
    body = Body(small_mesh, material, 30.0, P0)
    library = Library(small_mesh, skfem.ElementTetP2(), intorder=2)
    expected = mixed_stiffness(library, poisson, skfem.ElementTetP0())
    assert relative_error(stiffness(body, poisson).toarray(), expected) < 1e-11


def sag_m(K: np.ndarray | sp.csc_array, body: Body) -> float:
    """How far the tip of a beam, clamped at x = 0, sinks under its weight."""
    free = np.flatnonzero(np.repeat(body.nodes_m[:, 0] > 1e-9, 3))
    load, u = np.zeros((2, body.nodes_m.size))
    load[2::3] = -9.81 * body.node_mass
    inner = K[np.ix_(free, free)] if isinstance(K, np.ndarray) else K[free][:, free]
    u[free] = (np.linalg.solve if isinstance(K, np.ndarray) else spsolve)(inner, load[free])
    return -u[2::3][nodes_where(body, 0, body.nodes_m[:, 0].max())].mean()


@cache
def beam(element: str, cells_across: int) -> Body:
    m = cells_across
    return Body(box_mesh((0.10, 0.02, 0.02), (3 * m, m, m)), "linear", 30.0, element)


@pytest.mark.parametrize(
    ("poisson", "plain_below", "linear_below"),
    [(0.3, 1.0, 0.65), (0.49, 0.95, 0.25), (INCOMPRESSIBLE, 0.92, 0.08)],
)
def test_a_beam_sags_as_with_taylor_and_hoods_element(poisson, plain_below, linear_below):
    averaging, plain, linear = (beam(name, 2) for name in (P0, "tet10", "tet4"))
    library = Library(plain.mesh, skfem.ElementTetP2(), intorder=4)
    expected = sag_m(mixed_stiffness(library, poisson, skfem.ElementTetP1()), plain)
    found, stiff, locked = (
        sag_m(stiffness(body, poisson), body) / expected for body in (averaging, plain, linear)
    )
    assert found == pytest.approx(1.0, abs=0.09)
    assert stiff < plain_below
    assert locked < linear_below


def test_compressible_bodies_agree_with_plain_elements_under_refinement():
    sags = [
        [sag_m(stiffness(body, 0.3), body) for body in (beam(P0, m), beam("tet10", m))]
        for m in (1, 2, 3)
    ]
    differences = [abs(averaging / plain - 1) for averaging, plain in sags]
    assert differences[-1] < 0.04
    assert observed_order([1, 1 / 2, 1 / 3], differences) > 2.0


def mean_error(element: str, divisions: int) -> float:
    """Root of the mean squared displacement error, relative, for a solution with a pressure.

    u = a + ∇χ/λ with div a = 0 and Δa = −3k² a, Δχ = −3k² χ keeps λ div u of order one, and needs
    the body force −div σ = 3k² (μ a + (1 + 2μ/λ) ∇χ).
    """
    (lambda_pa, mu_pa), k = lame(INCOMPRESSIBLE), 2.0
    mesh = box_mesh((1.0, 1.0, 1.0), (divisions,) * 3)
    body = Body(mesh, "linear", 1.0, element)

    def parts(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        (sx, sy, sz), (cx, cy, cz) = np.sin(k * x), np.cos(k * x)
        a = np.array([sx * cy * cz, -cx * sy * cz, 0 * sx])
        return a, mu_pa * k * np.array([cx * sy * sz, sx * cy * sz, sx * sy * cz])

    library = Library(mesh, skfem.ElementTetP2(), intorder=4)

    def work(v, w):
        a, gradient = parts(w["x"])
        return 3 * k**2 * dot(mu_pa * a + (1 + 2 * mu_pa / lambda_pa) * gradient, v)

    load = skfem.LinearForm(work).assemble(library.basis)[library.dofs]
    a, gradient = parts(body.nodes_m.T)
    exact = (a + gradient / lambda_pa).T.ravel()
    inside = (np.abs(body.nodes_m - 0.5) < 0.5 - 1e-9).all(axis=1)
    free = np.flatnonzero(np.repeat(inside, 3))
    held = np.flatnonzero(~np.repeat(inside, 3))
    K, u = stiffness(body, INCOMPRESSIBLE), exact.copy()
    u[free] = spsolve(K[free][:, free], load[free] - K[free][:, held] @ exact[held])
    return float(np.sqrt(body.dof_mass @ (u - exact) ** 2 / (body.dof_mass @ exact**2)))


@pytest.mark.long
def test_near_incompressibility_the_displacement_converges_to_second_order():
    divisions = [3, 4, 6]
    errors = [mean_error(P0, n) for n in divisions]
    assert observed_order(1 / np.array(divisions), errors) > 1.6
    assert errors[-1] < 0.05


# Identification -------------------------------------------------------------------------------

TRUTH = {"young_pa": 2000.0, "poisson": 0.499, "gamma_r_s": 0.002, "gamma_m_1_s": 1.0}
GUESS = Parameters(
    (
        Parameter("young_pa", 1400.0, 10.0, 1e6),
        Parameter("poisson", 0.499, 0.0, 0.4999, is_fixed=True),
        Parameter("gamma_r_s", 0.004, 1e-5, 1.0),
        Parameter("gamma_m_1_s", 1.0, 1e-3, 100.0, is_fixed=True),
    )
)


@cache
def bar() -> Experiment:
    """A bar held at one end and moved gently, seen at nodes; noiseless."""
    body, t_s = box((0.15, 0.05, 0.05), (2, 1, 1), P0), times(6)
    gently = smooth_poses(t_s, (0.004, 0.002, -0.003), (0.04, -0.03, 0.06))
    grasp = Grasp(nodes_where(body, 0, 0.0), gently)
    markers = point_markers(body, body.nodes_m[-5:], t_s)
    unseen = Experiment(body, t_s, (grasp,), markers)
    return with_markers(unseen, simulate(unseen, TRUTH, "midpoint", substeps=1).markers_m)


@pytest.mark.long
def test_reduced_space_finds_the_truth():
    found = ReducedSpace()(Collocation([bar()], GUESS)).parameters
    for name, value in TRUTH.items():
        assert found[name] == pytest.approx(value, rel=1e-6)


@pytest.mark.long
def test_reduced_space_with_noise_finds_an_optimum_of_the_whole_program(rng):
    tracks = bar().markers.positions_m
    noisy = with_markers(bar(), tracks + 1e-4 * rng.standard_normal(tracks.shape))
    solution = ReducedSpace()(Collocation([noisy], GUESS))
    assert solution.status.converged
    assert solution.kkt_residual < 1e-8
    assert solution.parameters["young_pa"] != pytest.approx(TRUTH["young_pa"], rel=1e-5)
