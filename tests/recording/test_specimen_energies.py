"""Pre-stretched shear and differences of true stresses, against derivatives of the strain energy.

The derivatives are numerical, and free stretches minimise the energy: no stress is computed.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

import collocation_sysid as cs
from collocation_sysid.recording.homogeneous_deformation import DEFORMATIONS
from collocation_sysid.recording.specimen_files import SpecimenLayout, read_specimen
from collocation_sysid.recording.specimen_stretches import isochoric_stretches

EXACT = {"strain_zero": 0.0, "area_error": 0.0}
STRAIN = np.array([-0.4, -0.1, 0.05, 0.3, 0.8])
FOAM = {"mu_1_pa": 2e4, "alpha_1": 6.0, "beta_1": 0.3}
OGDEN = {"mu_1_pa": 300.0, "alpha_1": 12.0, "kappa_pa": 1e11}


def energy(law, stretches):
    """Energy density of the laws of this page at principal stretches."""
    stretches = np.asarray(stretches)
    volume = stretches.prod()
    if law == "hyperfoam-1":
        mu, alpha, beta = FOAM.values()
        trace = (stretches**alpha).sum() - 3
        return 2 * mu / alpha**2 * (trace + (volume ** (-alpha * beta) - 1) / beta)
    mu, alpha, _ = OGDEN.values()
    return mu / alpha * ((stretches / np.cbrt(volume)) ** alpha).sum()


def derivative(function, at, step=1e-5):
    return (function(at + step) - function(at - step)) / (2 * step)


def simulated(law, values, test, strain, **keys):
    specimen = cs.Specimen(test, strain, np.zeros_like(strain), sigma_pa=1.0, **keys, **EXACT)
    (read,) = cs.simulate(specimen.experiment(law), values).custom_sensor_values
    return read[:, 0]


@pytest.mark.parametrize(("law", "values"), [("hyperfoam-1", FOAM), ("ogden-1", OGDEN)])
@pytest.mark.parametrize("keys", [{}, {"axial_stretch": 0.8}, {"axial_stretch": 1.2}])
def test_shear_at_a_pre_stretch_has_the_derivative_of_the_energy(law, values, keys):
    axial = keys.get("axial_stretch", 1.0)
    if law == "hyperfoam-1" and keys:
        keys = {**keys, "transverse_stretch": 1.05}
    across = keys.get("transverse_stretch", axial**-0.5)

    def sheared(shear):
        gradient = np.diag([across, across, axial])
        gradient[0, 2] = shear
        return energy(law, np.linalg.svd(gradient, compute_uv=False))

    expected_pa = [derivative(sheared, axial * gamma) for gamma in STRAIN]
    read_pa = simulated(law, values, "simple-shear", STRAIN, **keys)
    np.testing.assert_allclose(read_pa, expected_pa, rtol=1e-6, atol=1e-3)


@pytest.mark.parametrize(("law", "values"), [("hyperfoam-1", FOAM), ("ogden-1", OGDEN)])
def test_the_difference_of_true_stresses_minimises_the_energy(law, values):
    first, second = 1 + STRAIN, 1 - 0.5 * STRAIN

    def least(logarithms):
        """Energy at two stretches, minimised over the third; that keeps the volume in rubber."""
        if law == "ogden-1":
            return energy(law, np.exp([*logarithms, -sum(logarithms)]))
        found = minimize_scalar(
            lambda third: energy(law, np.exp([*logarithms, third])),
            bounds=(-1.5, 1.5), method="bounded", options={"xatol": 1e-12},
        )  # fmt: skip
        return energy(law, np.exp([*logarithms, found["x"]]))

    def drawn(k):
        """Derivative by the logarithm of the first stretch, less that by that of the second."""
        x, y = np.log([first[k], second[k]])
        return derivative(lambda by: least([x + by, y - by]), 0.0, 1e-4)

    expected_pa = [drawn(k) for k in range(len(STRAIN))]
    read_pa = simulated(law, values, "biaxial-difference", STRAIN, second_strain=second - 1)
    np.testing.assert_allclose(read_pa, expected_pa, rtol=3e-5, atol=0.05)


def test_a_stretch_beside_the_strains_belongs_to_simple_shear():
    with pytest.raises(cs.InputError, match="simple-shear"):
        cs.Specimen("uniaxial", STRAIN, STRAIN, sigma_pa=1.0, axial_stretch=0.8)


def test_principal_stretches_contain_the_pre_stretch():
    deformation = DEFORMATIONS["simple-shear"].pre_stretched(0.8, None)
    stretches = isochoric_stretches(deformation, np.zeros(1), None)
    assert np.sort(stretches[0]) == pytest.approx([0.8, 0.8**-0.5, 0.8**-0.5])
    turned = isochoric_stretches(DEFORMATIONS["biaxial-difference"], np.array([1.0]), np.zeros(1))
    assert np.sort(turned[0]) == pytest.approx([0.5, 1.0, 2.0])


@pytest.mark.parametrize("header", ["stress difference", "Cauchy stress difference"])
def test_tables_of_differences_are_read(tmp_path, header):
    file = tmp_path / "jones.csv"
    file.write_text(f"stretch,second stretch,{header} (kPa)\n1.5,1.2,80\n2,1.2,200\n")
    table = read_specimen(file, SpecimenLayout(test="biaxial-difference", columns={}))
    assert table.stress_pa == pytest.approx([8e4, 2e5])
    assert table.is_incompressible
    file.write_text(
        f"stretch,second stretch,lateral stretch,{header} (kPa)\n1.5,1.2,0.5,80\n2,1.2,0.5,200\n"
    )
    table = read_specimen(file, SpecimenLayout(test="biaxial-difference", columns={}))
    assert table.stress_pa == pytest.approx([0.9 * 8e4, 1.2 * 2e5])


def fit(law, specimens, unknown):
    experiments = [each.experiment(law, f"test {k}") for k, each in enumerate(specimens)]
    return cs.run(cs.Problem(experiments, {name: cs.Unknown() for name in unknown} | FIXED))


FIXED = {"kappa_pa": 1e11, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}


@pytest.mark.long
def test_both_kinds_are_fitted_without_a_guess():
    rng = np.random.default_rng(4)
    gamma = np.linspace(0.02, 0.6, 15)
    shear_pa = simulated("ogden-1", OGDEN, "simple-shear", gamma, axial_stretch=0.8)
    stretch, second = np.linspace(1.05, 1.6, 15), np.full(15, 1.1)
    difference_pa = simulated(
        "ogden-1", OGDEN, "biaxial-difference", stretch - 1, second_strain=second - 1
    )
    noise_pa = 10 * rng.normal(size=(2, 15))
    shear = cs.Specimen(
        "simple-shear", gamma, shear_pa + noise_pa[0], sigma_pa=10.0, axial_stretch=0.8
    )
    pull = cs.Specimen(
        "biaxial-difference",
        stretch - 1,
        difference_pa + noise_pa[1],
        sigma_pa=10.0,
        second_strain=second - 1,
    )
    run = fit("ogden-1", [shear, pull], ["mu_1_pa", "alpha_1"])
    assert run.solution.status.converged
    for name, truth in (("mu_1_pa", 300.0), ("alpha_1", 12.0)):
        low, high = run.interval(name)
        assert low < truth < high
    assert len(run.solution.history) < 20
