"""
How much of it is the mesh?
===========================

Error bars know the noise. What the mesh and the step do to the answer, ``refine`` measures: it
solves again with half the step and on a mesh twice as fine.
"""

# sphinx_gallery_thumbnail_path = 'pictures/4_finer.png'
import matplotlib.pyplot as plt
import numpy as np

import collocation_sysid as cs

t_s = 0.01 * np.arange(50)
poses = np.tile(np.eye(4), (len(t_s), 1, 1))
poses[:, 2, 3] = 0.03 * np.sin(14 * t_s) * np.minimum(1, t_s / 0.2) ** 2
hand = cs.Grasp(cs.Box((-1, -1, -1), (0.001, 1, 1)), poses)
places_m = [(0.12, 0.0, 0.0), (0.12, 0.04, 0.04), (0.08, 0.0, 0.04), (0.04, 0.04, 0.0)]
known = {"poisson": 0.3, "gamma_r_s": 0.004, "gamma_m_1_s": 0.5}


def bar(divisions: tuple[int, int, int], tracks_m: np.ndarray) -> cs.Experiment:
    """A swung bar of so many cells."""
    body = cs.Body(cs.box_mesh((0.12, 0.04, 0.04), divisions), density_kg_m3=60.0)
    seen = cs.Markers(t_s, tracks_m, sigma_m=2e-4, places_m=places_m)
    return cs.Experiment(body, t_s, [hand], seen, name="swing", nuisance=cs.Nuisance.none())


# %%
# Data from a fine mesh, fitted on a coarse one of linear tetrahedra, which bend too stiffly.
blank = np.zeros((len(t_s), 4, 3))
tracks_m = cs.simulate(
    bar((12, 4, 4), blank), {"young_pa": 2e4, **known}, timestep_s=0.001
).markers_m
tracks_m += np.random.default_rng(10).normal(scale=2e-4, size=tracks_m.shape)
problem = cs.Problem([bar((6, 2, 2), tracks_m)], {"young_pa": cs.Unknown(1e4), **known})
run = cs.refine(cs.run(problem))
print(run.table())
run.plot(count=3)

# %%
# The interval of the noise alone misses the truth by far; the one that holds the discretisation
# does not.
error, noise = run.refinement.errors["young_pa"], run.optimum["young_pa"]
intervals = {"noise": noise.statistical95, "noise, mesh and step": run.interval("young_pa")}
held = {label: low < 2e4 < high for label, (low, high) in intervals.items()}
assert held == {"noise": False, "noise, mesh and step": True}
for k, (label, (low, high)) in enumerate(intervals.items()):
    plt.plot([low, high], [k, k], lw=6, label=label)
plt.axvline(2e4, color="k", ls=":", label="truth")
plt.plot(error.extrapolated, 1, "k|", ms=20, label="extrapolated")
plt.yticks([])
plt.xlabel("95 % interval of E [Pa]")
plt.legend()
plt.show()
