"""
A material of your own
======================

A material is its energy density, a function of the deformation gradient and of named constants.
Derivatives, compiled kernels and estimates follow from it.
"""

# sphinx_gallery_thumbnail_path = 'pictures/1_own_material.png'
import casadi as ca
import matplotlib.pyplot as plt
import numpy as np

import collocation_sysid as cs


def stiffening(F, *, mu_pa, lambda_pa, hardening):
    """Neo-Hookean, and harder the more it is stretched."""
    excess = ca.trace(F.T @ F) - 3
    log_volume = ca.log(ca.det(F))
    elastic = mu_pa / 2 * excess - mu_pa * log_volume + lambda_pa / 2 * log_volume**2
    return elastic + mu_pa * hardening / 4 * excess**2


body = cs.Body(cs.box_mesh((0.04, 0.04, 0.1), (2, 2, 5)), material=stiffening, density_kg_m3=60.0)
t_s = 0.01 * np.arange(60)
poses = np.tile(np.eye(4), (len(t_s), 1, 1))
poses[:, 2, 3] = 0.05 * np.sin(18 * t_s) * np.minimum(1, t_s / 0.2) ** 2
hand = cs.Grasp(cs.Box((-1, -1, 0.099), (1, 1, 1)), poses)
places_m = [(0.0, 0.0, 0.0), (0.04, 0.04, 0.0), (0.0, 0.04, 0.033), (0.04, 0.0, 0.066)]
seen = cs.Markers(t_s, np.zeros((len(t_s), 4, 3)), sigma_m=2e-4, places_m=places_m)
weight = cs.PointMass(cs.Box((-1, -1, -1), (1, 1, 0.001)), 0.02)
swing = cs.Experiment(body, t_s, [hand], seen, name="swing", masses=[weight])
known = {"lambda_pa": 800.0, "gamma_r_s": 0.004, "gamma_m_1_s": 0.5}
truth = {"mu_pa": 600.0, "hardening": 0.5, **known}
tracks_m = cs.simulate(swing, truth, timestep_s=0.001).markers_m
tracks_m += np.random.default_rng(8).normal(scale=2e-4, size=tracks_m.shape)

# %%
# A weight at the end stretches it far enough that the hardening shows.
unknown = {"mu_pa": cs.Unknown(400.0), "hardening": cs.Unknown(0.1)}
run = cs.run(cs.Problem([cs.with_markers(swing, tracks_m)], {**unknown, **known}))
print(run.table())
low, high = run.interval("hardening")
assert low < truth["hardening"] < high

# %%
# Its energy density, as it was stretched.
run.plot(field="energy_density_j_m3", count=4)

# %%
# The stress of a bar in tension by both constants found, volume kept.
stretch = np.linspace(1, 1.8, 50)
mu, hard = run.parameters["mu_pa"], run.parameters["hardening"]
excess = stretch**2 + 2 / stretch - 3
stress = mu * (stretch - stretch**-2) * (1 + hard * excess)
plt.plot(stretch, stress, label="found")
plt.plot(stretch, mu * (stretch - stretch**-2), ":", label="without the hardening")
plt.xlabel("stretch")
plt.ylabel("nominal stress [Pa]")
plt.legend()
plt.show()
