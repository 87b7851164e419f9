"""Fibres beside isotropic materials: closed forms, another library, directions and estimates."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from kit.internal_force_check import check_compiled_forces
from kit.scikit_fem import Library
from scipy.optimize import minimize

import collocation_sysid as cs
from collocation_sysid.errors import InputError
from collocation_sysid.fem.coarse_body import coarsen_body
from collocation_sysid.fem.laws.fibres import FibreLaw, Fibres, reinforced
from collocation_sysid.fem.laws.materials import MATERIALS
from collocation_sysid.fem.meshes.refinement import refine_body
from collocation_sysid.statistics.stability_concerns import is_examined
from collocation_sysid.testing import check_material

MU_PA, FIBRE_PA, EXPONENT = 1e4, 4e4, 0.8
STRETCH = np.linspace(1.0, 1.4, 9)
# Nearly incompressible, as the closed forms are.
MATRIX = {"mu_pa": MU_PA, "kappa_pa": 1e4 * MU_PA, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}


def stresses_pa(test: str, fibres: Fibres, constants: dict, **keys) -> list[np.ndarray]:
    """Stresses of a test at `STRETCH`."""
    blank = np.zeros_like(STRETCH)
    specimen = cs.Specimen(test, STRETCH - 1, blank, 1.0, strain_zero=0.0, area_error=0.0, **keys)
    trajectory = cs.simulate(specimen.experiment(fibres=fibres), MATRIX | constants)
    return [values[:, 0] for values in trajectory.custom_sensor_values]


def fibre_slope(strain, exponent=0.0):
    """∂ψ_f/∂I₄ of fibres with I₄ − 1 = `strain` ≥ 0."""
    return FIBRE_PA / 4 * strain * np.exp(exponent * strain**2)


@pytest.mark.parametrize("law", ["quadratic", "exponential"])
def test_tension_along_fibres_is_that_of_the_closed_form(law):
    fibres = Fibres(direction=[0, 0, 2.0], law=law)
    exponent = EXPONENT if law == "exponential" else 0.0
    constants = {"fibre_pa": FIBRE_PA} | ({"fibre_exponent": EXPONENT} if exponent else {})
    (found,) = stresses_pa("uniaxial", fibres, constants)
    matrix = MU_PA * (STRETCH - STRETCH**-2)
    expected = matrix + 2 * STRETCH * fibre_slope(STRETCH**2 - 1, exponent)
    np.testing.assert_allclose(found, expected, rtol=5e-5, atol=1e-3)


def test_biaxial_tension_with_two_families_is_that_of_holzapfel():
    """P_i = ∂ψ/∂λ_i with I₄ = λ₁² cos²β + λ₂² sin²β (Holzapfel, Gasser & Ogden 2000)."""
    angle, second = 0.6, np.linspace(1.0, 1.2, len(STRETCH))
    fibres = Fibres(direction=[0, 0, 1], normal=[0, 1, 0], families=2, law="exponential")
    constants = {"fibre_pa": FIBRE_PA, "fibre_exponent": EXPONENT, "fibre_angle_rad": angle}
    blank = np.zeros_like(STRETCH)
    found = stresses_pa(
        "biaxial", fibres, constants, second_strain=second - 1, second_stress_pa=blank
    )
    strain = STRETCH**2 * np.cos(angle) ** 2 + second**2 * np.sin(angle) ** 2 - 1
    slope = 2 * fibre_slope(strain, EXPONENT)
    across = (STRETCH * second) ** -2
    for own, stretch, share in zip(
        found, (STRETCH, second), (np.cos(angle) ** 2, np.sin(angle) ** 2), strict=True
    ):
        expected = MU_PA * (stretch - across / stretch) + 2 * stretch * share * slope
        np.testing.assert_allclose(own, expected, rtol=1e-4, atol=1e-2)


def test_dispersed_fibres_in_equibiaxial_tension_have_their_closed_form():
    """e = κ (I₁ − 3) + (1 − 3κ)(I₄ − 1) (Gasser, Ogden & Holzapfel 2006)."""
    scatter = 0.2
    fibres = Fibres(direction=[0, 0, 1], dispersed=True)
    constants = {"fibre_pa": FIBRE_PA, "fibre_dispersion": scatter}
    (found,) = stresses_pa("equibiaxial", fibres, constants)
    strain = scatter * (2 * STRETCH**2 + STRETCH**-4 - 3) + (1 - 3 * scatter) * (STRETCH**2 - 1)
    # ∂e/∂λ along the fibres, with the pressure that keeps the thickness free of stress.
    slope = 2 * (scatter * (STRETCH - STRETCH**-5) + (1 - 3 * scatter) * STRETCH)
    expected = MU_PA * (STRETCH - STRETCH**-5) + fibre_slope(strain) * slope
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-2)


def test_fibres_that_carry_tension_only_are_slack_across_the_tension():
    slack, stiff = (
        stresses_pa(
            "uniaxial", Fibres(direction=[1, 0, 0], tension_only=tension), {"fibre_pa": 4e4}
        )
        for tension in (True, False)
    )
    np.testing.assert_allclose(slack[0][1:], MU_PA * (STRETCH - STRETCH**-2)[1:], rtol=1e-3)
    assert stiff[0][-1] > 1.05 * slack[0][-1]


@pytest.mark.parametrize("angle_deg", [20.0, 45.0, -70.0, 90.0])
def test_a_specimen_cut_at_an_angle_shears_until_its_energy_is_least(angle_deg):
    fibres = Fibres(direction=[0, 0, 1], tension_only=False)
    (found,) = stresses_pa("uniaxial", fibres, {"fibre_pa": FIBRE_PA}, cut_angle_deg=angle_deg)
    angle = np.deg2rad(angle_deg)

    def energy(free, stretch):
        width, shear = free
        F = np.array([[width, 0, 0], [0, 1 / (stretch * width), 0], [shear, 0, stretch]])
        along = F @ [-np.sin(angle), 0.0, np.cos(angle)]
        return MU_PA / 2 * ((F**2).sum() - 3) + FIBRE_PA / 8 * (along @ along - 1) ** 2

    def stress(stretch):
        """∂/∂λ of the least energy: at the free components there."""
        start = [stretch**-0.5, 0.0]
        free = minimize(energy, start, (stretch,), tol=1e-9, method="BFGS").x
        return (energy(free, stretch + 1e-5) - energy(free, stretch - 1e-5)) / 2e-5

    expected = [stress(stretch) for stretch in STRETCH[1:]]
    np.testing.assert_allclose(found[1:], expected, rtol=1e-3)


@pytest.mark.parametrize("element", ["tet4", "tet10"])
def test_energy_and_forces_with_hoops_are_those_of_scikit_fem(small_mesh, rng, element):
    import skfem

    fibres = Fibres(axis=(0, 0, 1), axis_point_m=(-0.05, 0.01, 0.0), tension_only=False)
    body = cs.Body(small_mesh, "neo-hookean", density_kg_m3=30.0, element=element, fibres=fibres)
    quadratic = element == "tet10"
    library = Library(
        small_mesh, skfem.ElementTetP2() if quadratic else None, intorder=2 if quadratic else 1
    )
    centres = small_mesh.centres_m - [-0.05, 0.01, 0.0]
    hoops = np.cross([0, 0, 1], centres)
    hoops = (hoops / np.linalg.norm(hoops, axis=1, keepdims=True)).T[:, :, None]
    lam, mu = 3e4, 1e4

    def strains(w):
        F = np.eye(3)[:, :, None, None] + w["u"].grad
        last = np.moveaxis(F, (0, 1), (-2, -1))
        inverse_transposed = np.moveaxis(np.linalg.inv(last), (-1, -2), (0, 1))
        along = (F * hoops[None]).sum(1)
        return F, inverse_transposed, np.log(np.linalg.det(last)), along

    def density(w):
        F, _, log_j, along = strains(w)
        isotropic = 0.5 * lam * log_j**2 - mu * log_j + 0.5 * mu * ((F**2).sum((0, 1)) - 3)
        return isotropic + FIBRE_PA / 8 * ((along**2).sum(0) - 1) ** 2

    def work(v, w):
        F, inverse_transposed, log_j, along = strains(w)
        stress = mu * (F - inverse_transposed) + lam * log_j * inverse_transposed
        pull = FIBRE_PA / 2 * ((along**2).sum(0) - 1) * along
        return (stress * v.grad).sum((0, 1)) + (pull[:, None] * hoops[None] * v.grad).sum((0, 1))

    positions = body.nodes_m + rng.uniform(-0.003, 0.003, body.nodes_m.shape)
    constants = {"lambda_pa": lam, "mu_pa": mu, "fibre_pa": FIBRE_PA}
    assert body.energy(positions, **constants) == pytest.approx(
        library.scalar(density, positions), rel=1e-11
    )
    theta = body.elastic_theta(constants)
    force = body.force(positions, np.zeros_like(positions), theta).reshape(-1, 3)
    expected = library.vector(work, positions)
    np.testing.assert_allclose(force, -expected, atol=1e-10 * np.abs(expected).max())


@pytest.mark.parametrize(
    ("matrix", "law"),
    [
        ("neo-hookean", FibreLaw()),
        pytest.param("yeoh", FibreLaw(2, True, True, True), marks=pytest.mark.long),
        pytest.param("ogden-1", FibreLaw(2, True, False, True, False), marks=pytest.mark.long),
    ],
)
def test_kernels_agree_with_the_plain_formula(matrix, law):
    material = reinforced(MATERIALS[matrix], law)
    check_material(material)
    check_compiled_forces(material)


def test_a_field_of_directions_equals_regions_with_one_direction_each():
    mesh = cs.box_mesh((0.1, 0.05, 0.05), (4, 2, 2))
    left = mesh.centres_m[:, 0] < 0.05
    directions = np.where(left[:, None], [1.0, 1.0, 0.0], [0.0, 0.0, 3.0])
    named = replace_cell_arrays(mesh, {"grain": directions})
    bodies = [
        cs.Body(named, density_kg_m3=1.0, fibres=Fibres(direction="grain")),
        cs.Body(mesh, density_kg_m3=1.0, fibres=Fibres(direction=directions)),
        cs.Body(
            mesh,
            density_kg_m3=1.0,
            regions=[
                cs.Region("left", left, fibres=Fibres(direction=[1, 1, 0])),
                cs.Region("right", ~left, fibres=Fibres(direction=[0, 0, 1])),
            ],
        ),
    ]
    x = mesh.points_m @ np.array([[1.2, 0.1, 0.0], [0.0, 0.9, 0.2], [0.1, 0.0, 1.1]])
    constants = {"lambda_pa": 2e4, "mu_pa": 1e4, "fibre_pa": 3e4}
    energies = [body.energy(x, **constants) for body in bodies]
    np.testing.assert_allclose(energies, energies[0], rtol=1e-12)
    for other in (refine_body(bodies[0]), coarsen_body(bodies[0], 30, ()).coarse):
        moved = other.nodes_m @ np.linalg.lstsq(mesh.points_m, x)[0]
        assert other.energy(moved, **constants) == pytest.approx(energies[0], rel=0.02)


def replace_cell_arrays(mesh, arrays):
    return type(mesh)(mesh.points_m, mesh.tetrahedra, cell_arrays=arrays)


def test_a_recording_determines_stiffness_and_angle_of_fibres():
    mesh = cs.box_mesh((0.02, 0.01, 0.06), (2, 1, 4))
    fibres = Fibres(direction=[0, 0, 1], normal=[0, 1, 0], tension_only=False)
    body = cs.Body(mesh, density_kg_m3=1000.0, fibres=fibres)
    t_s = np.linspace(0.0, 0.3, 31)
    sway_m = 0.02 * (1 - np.cos(25 * t_s))
    hand = cs.PoseSequence(t_s, np.outer(sway_m, [1, 1, 0]), np.tile([0, 0, 0, 1.0], (31, 1)))
    held = cs.Grasp(np.flatnonzero(mesh.points_m[:, 2] > 0.0599), hand)
    low_m = mesh.points_m[mesh.points_m[:, 2] < 0.031]
    markers = cs.Markers(t_s, np.zeros((31, len(low_m), 3)), 1e-4, places_m=low_m)
    swing = cs.Experiment(
        body, t_s, [held], markers, nuisance=cs.Nuisance.none(), air_density_kg_m3="none"
    )
    truth = {"young_pa": 2e4, "poisson": 0.4, "gamma_r_s": 2e-3, "gamma_m_1_s": 0.1}
    truth |= {"fibre_pa": 3e4, "fibre_angle_rad": 0.3}
    seen = cs.with_markers(swing, cs.simulate(swing, truth, "midpoint", substeps=1).markers_m)
    unknown = {
        "young_pa": cs.Unknown(3e4),
        "fibre_pa": cs.Unknown(1e4),
        "fibre_angle_rad": cs.Unknown(0.1, prior=(0.0, 0.5)),
    }
    found = cs.solve(cs.Problem([seen], truth | unknown)).parameters
    for name in unknown:
        assert found[name] == pytest.approx(truth[name], rel=1e-2)


def test_viscosities_and_stability_are_those_of_the_matrix():
    material = reinforced(MATERIALS["neo-hookean"], FibreLaw(2, True))
    lame = np.asarray(material.lame([2e4, 1e4, 5e4, 0.7])).ravel()
    np.testing.assert_allclose(lame, [2e4, 1e4])
    assert is_examined(material)
    assert replace(material, name="other").matrix is MATERIALS["neo-hookean"]


MESH = cs.box_mesh((0.1, 0.1, 0.1), (1, 1, 1))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Fibres(), "no direction"),
        (lambda: Fibres(direction=[0, 0, 1], axis=(0, 0, 1)), "both"),
        (lambda: Fibres(direction=[0, 0, 1], families=2), "normal"),
        (lambda: Fibres(axis=(0, 0, 1), families=2), "helix"),
        (
            lambda: cs.Body(MESH, density_kg_m3=1.0, fibres=Fibres(direction=[0, 0, 0])),
            "no direction",
        ),
        (
            lambda: cs.Body(MESH, density_kg_m3=1.0, fibres=Fibres(direction="grain")),
            "no cell array",
        ),
        (lambda: cs.Body(MESH, "linear", 1.0, fibres=Fibres(direction=[0, 0, 1])), "not isotropic"),
        (
            lambda: cs.Body(
                MESH, density_kg_m3=1.0, fibres=Fibres(direction=[0, 0, 1], normal=[0, 0, 2])
            ),
            "parallel",
        ),
    ],
)
def test_fibres_without_a_direction_or_an_isotropic_matrix_are_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()


def test_memory_of_fibres_does_not_depend_on_the_axes_of_the_mesh():
    turn = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    t_s = np.linspace(0.0, 0.2, 21)
    truth = {"young_pa": 2e4, "poisson": 0.4, "gamma_r_s": 2e-3, "gamma_m_1_s": 0.1}
    truth |= {"fibre_pa": 5e4, "prony_1.share": 0.5, "prony_1.tau_s": 0.05}
    tracks_m = []
    for axes in (np.eye(3), turn):
        mesh = cs.box_mesh((0.02, 0.01, 0.04), (1, 1, 2))
        mesh = type(mesh)(mesh.points_m @ axes, mesh.tetrahedra)
        fibres = Fibres(direction=np.array([1.0, 0.2, 3.0]) @ axes)
        body = cs.Body(mesh, density_kg_m3=1e3, fibres=fibres, prony=["prony_1"])
        sway_m = np.outer(0.01 * np.sin(30 * t_s), [1.0, 0.5, 0.0]) @ axes
        hand = cs.PoseSequence(t_s, sway_m, np.tile([0, 0, 0, 1.0], (21, 1)))
        held = cs.Grasp(np.flatnonzero(mesh.points_m @ axes.T @ [0, 0, 1.0] > 0.0399), hand)
        markers = cs.Markers(t_s, np.zeros((21, 1, 3)), 1e-4, places_m=mesh.points_m[:1])
        swing = cs.Experiment(
            body,
            t_s,
            [held],
            markers,
            nuisance=cs.Nuisance.none(),
            air_density_kg_m3="none",
            gravity_m_s2=np.array([0.0, 0.0, -9.81]) @ axes,
        )
        tracks_m.append(cs.simulate(swing, truth, "midpoint", substeps=1).markers_m @ axes.T)
    np.testing.assert_allclose(tracks_m[0], tracks_m[1], atol=1e-9)
    assert np.ptp(tracks_m[0], axis=0).max() > 5e-3


PROBLEM = """
[object]
box_m = [0.02, 0.02, 0.06]
edge_length_m = 0.02
density_kg_m3 = 1000.0
fibres = { direction = [0, 0, 1], normal = [0, 1, 0], families = 2, law = "exponential" }

[[object.region]]
name = "end"
cells = { box_m = [[-1, -1, 0.03], [1, 1, 1]] }
fibres = { axis = [0, 0, 1], axis_point_m = [0.01, 0.01, 0.0], tension_only = false }

[parameters]
young_pa = 2e4
poisson = 0.4
gamma_r_s = 0.002
gamma_m_1_s = 0.1
fibre_pa = { prior = { mean = 3e4, relative = 1.0 } }
fibre_exponent = 1.0
fibre_angle_rad = { guess = 0.3 }
"end.fibre_pa" = { fixed = 1e3 }

[[experiment]]
name = "swing"
grasp = { nodes = { box_m = [[-1, -1, 0.059], [1, 1, 1]] }, poses = "poses.csv" }
markers = { file = "markers.csv", sigma_m = 1e-4, reference_m = { tip = [0, 0, 0] } }
"""


def test_a_problem_file_states_fibres_of_the_body_and_of_a_region(tmp_path):
    (tmp_path / "problem.toml").write_text(PROBLEM)
    header = "t_s,x_m,y_m,z_m,qx,qy,qz,qw\n"
    rows = "".join(f"{t},{0.01 * t},0,0,0,0,0,1\n" for t in (0.0, 0.1, 0.2, 0.3, 0.4))
    (tmp_path / "poses.csv").write_text(header + rows)
    rows = "".join(f"{t},{0.01 * t},0,0\n" for t in (0.0, 0.1, 0.2, 0.3, 0.4))
    (tmp_path / "markers.csv").write_text("t_s,tip_x,tip_y,tip_z\n" + rows)
    problem = cs.Problem.read(tmp_path / "problem.toml")
    (body,) = problem.bodies
    assert [part.material.name for part in body.parts] == ["neo-hookean with fibres"] * 2
    assert "end.fibre_pa" in body.constants
    assert "end.fibre_angle_rad" not in body.constants
    centres = body.mesh.centres_m[body.parts[1].cells] - [0.01, 0.01, 0.0]
    axes = body.parts[1].axes
    assert axes is not None
    hoops = axes[:, :, 0]
    np.testing.assert_allclose(np.sum(hoops * centres, axis=1), 0.0, atol=1e-12)
    np.testing.assert_allclose(hoops[:, 2], 0.0, atol=1e-12)


def test_a_file_of_a_cut_specimen_equals_the_specimen_in_python(tmp_path):
    fibres = Fibres(direction=[0, 0, 1])
    (stress,) = stresses_pa("uniaxial", fibres, {"fibre_pa": FIBRE_PA}, cut_angle_deg=30.0)
    rows = "".join(f"{e},{p}\n" for e, p in zip(STRETCH - 1, stress, strict=True))
    (tmp_path / "pull.csv").write_text("strain (1),stress (Pa)\n" + rows)
    (tmp_path / "problem.toml").write_text(
        "[object]\nfibres = { direction = [0, 0, 1] }\n[parameters]\nmu_pa = 1e4\n"
        'kappa_pa = 1e8\nfibre_pa = { guess = 1e4 }\n[[experiment]]\nname = "pull"\nkind = "specimen"\n'
        'test = "uniaxial"\nfile = "pull.csv"\nsigma_pa = 10.0\ncut_angle_deg = 30.0\n'
        'strain_zero = "none"\narea_error = "none"\n'
    )
    found = cs.solve(cs.Problem.read(tmp_path / "problem.toml")).parameters
    assert found["fibre_pa"] == pytest.approx(FIBRE_PA, rel=1e-3)


@pytest.mark.long
def test_a_pressurised_half_reinforced_bar_determines_matrix_and_fibres():
    size_m, divisions = (0.03, 0.03, 0.07), (3, 3, 7)
    block = cs.box_mesh(size_m, divisions)
    middle = np.abs(block.centres_m - np.array(size_m) / 2) < [0.005, 0.005, 0.025]
    mesh = type(block)(block.points_m, block.tetrahedra[~middle.all(axis=1)])
    inside = np.abs(mesh.points_m - np.array(size_m) / 2) < [0.006, 0.006, 0.026]
    chamber = mesh.surface[inside.all(axis=1)[mesh.surface].all(axis=1)]
    wall = cs.Region("wall", mesh.centres_m[:, 0] < 0.01, fibres=Fibres(direction=[0, 0, 1]))
    body = cs.Body(mesh, density_kg_m3=1070.0, regions=[wall], rest_shape="stress_free")
    t_s = np.arange(5.0)
    held = cs.Grasp(np.flatnonzero(mesh.points_m[:, 2] > 0.0699), cs.PoseSequence.fixed())
    tip_m = mesh.points_m[mesh.points_m[:, 2] < 1e-9][:4]
    markers = cs.Markers(t_s, np.zeros((5, len(tip_m), 3)), 5e-5, places_m=tip_m)
    bent = cs.Experiment(
        body,
        t_s,
        [held],
        markers,
        pressures=[cs.Pressure(chamber, np.linspace(0.0, 4e4, 5), t_s)],
        nuisance=cs.Nuisance.none(),
        air_density_kg_m3="none",
        kind="static",
    )
    truth = {"young_pa": 1e5, "poisson": 0.4, "fibre_pa": 4e5, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
    exact_m = cs.simulate(bent, truth).markers_m
    bend_m, stretch_m = np.abs(exact_m[-1] - exact_m[0]).mean(axis=0)[[0, 2]]
    assert bend_m > 5 * stretch_m  # the wall with fibres does not become longer
    noise_m = 5e-5 * np.random.default_rng(0).normal(size=exact_m.shape)
    seen = cs.with_markers(bent, exact_m + noise_m)
    unknown = {"young_pa": cs.Unknown(7e4), "fibre_pa": cs.Unknown(1e5)}
    found = cs.solve(cs.Problem([seen], truth | unknown))
    assert found.status.converged
    assert found.parameters["young_pa"] == pytest.approx(1e5, rel=0.02)
    assert found.parameters["fibre_pa"] == pytest.approx(4e5, rel=0.1)
