"""
One program, several solvers
============================

Interior point takes all positions as variables, reduced space only the parameters: the same program
with the same optimum. The penalty method lets the equations of motion give way.
"""

# sphinx_gallery_thumbnail_path = 'pictures/5_same_optimum.png'
import matplotlib.pyplot as plt
import numpy as np

import collocation_sysid as cs

body = cs.Body(cs.box_mesh((0.06, 0.06, 0.12), (1, 1, 2)), density_kg_m3=30.0)
t_s = 0.01 * np.arange(30)
poses = np.tile(np.eye(4), (len(t_s), 1, 1))
poses[:, 0, 3] = 0.03 * (1 - np.cos(12 * t_s))
hand = cs.Grasp(cs.Box((-1, -1, 0.119), (1, 1, 1)), poses)
places_m = [(0.0, 0.0, 0.0), (0.06, 0.0, 0.0), (0.0, 0.06, 0.06)]
seen = cs.Markers(t_s, np.zeros((len(t_s), 3, 3)), sigma_m=5e-4, places_m=places_m)
ideal = cs.Nuisance.none()
swing = cs.Experiment(body, t_s, [hand], seen, name="swing", nuisance=ideal)
known = {"poisson": 0.3, "gamma_r_s": 0.006, "gamma_m_1_s": 1.5}
tracks_m = cs.simulate(swing, {"mu_pa": 600.0, **known}, "midpoint").markers_m
tracks_m += np.random.default_rng(9).normal(scale=5e-4, size=tracks_m.shape)
problem = cs.Problem([cs.with_markers(swing, tracks_m)], {"mu_pa": cs.Unknown(300.0), **known})

# %%
# The number of iterations differs, the answer does not.
found = {}
for name, method in (
    ("reduced space", cs.ReducedSpace()),
    ("interior point", cs.InteriorPoint(initial="simulation")),
    ("augmented Lagrangian", cs.AugmentedLagrangian()),
    ("penalty", cs.Penalty(inner="levenberg-marquardt")),
):
    solution = cs.solve(problem, method)
    found[name] = solution
    print(f"{name:21} μ = {solution.parameters['mu_pa']:.4f} Pa, ", end="")
    print(f"equations violated by {solution.max_violation_relative:.1e} of the largest force")
best = found["reduced space"].parameters["mu_pa"]
assert abs(found["interior point"].parameters["mu_pa"] / best - 1) < 1e-5

# %%
for name, solution in found.items():
    losses = [each.loss for each in solution.history]
    plt.semilogy(losses, "o-", ms=3, label=name)
plt.xlabel("iteration")
plt.ylabel("loss")
plt.legend()
plt.show()
