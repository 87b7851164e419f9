"""
A block between two platens
===========================

A testing machine presses a rubber block and measures the force; no camera looks. Whether the block
sticks to the platens or slides on them decides what modulus the same force means.
"""

# sphinx_gallery_thumbnail_path = 'pictures/2_test_bench.png'
import matplotlib.pyplot as plt
import numpy as np

import collocation_sysid as cs

quarter = cs.box_mesh((0.02, 0.02, 0.02), (3, 3, 3))  # of a block, between its planes of symmetry
body = cs.Body(quarter, element="tet10", density_kg_m3=1070.0)
down_m = np.linspace(0.0005, 0.004, 6)  # of the crosshead
t_s = np.arange(len(down_m), dtype=float)
still = np.tile(np.eye(4), (len(t_s), 1, 1))
pressed = still.copy()
pressed[:, 2, 3] = -down_m


def bench(axes: str, force_n: np.ndarray) -> cs.Experiment:
    """Platens to which the block sticks, axes "xyz", or on which it slides, "z"."""
    values = np.column_stack([np.full((len(t_s), 2), np.nan), force_n])
    cell = cs.Wrench(t_s, values, sigma_n=0.02)  # of which only the force along z is known
    low, high = (1e-4, 0.0199) if axes == "xyz" else (-1, 1)
    grasps = [
        cs.Grasp(cs.Box((-1, -1, -1), (1, 1, 1e-4)), still, axes=axes),
        cs.Grasp(cs.Box((-1, -1, 0.0199), (1, 1, 1)), pressed, axes=axes, wrench=cell),
        cs.Grasp(cs.Box((-1, -1, low), (1e-4, 1, high)), still, axes="x"),
        cs.Grasp(cs.Box((-1, -1, low), (1, 1e-4, high)), still, axes="y"),
    ]
    weightless = {"gravity_m_s2": (0.0, 0.0, 0.0), "nuisance": cs.Nuisance.none()}
    return cs.Experiment(body, t_s, grasps, name="press", kind="static", **weightless)


# %%
# The forces of a block that sticks, with noise.
known = {"poisson": 0.45, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
(felt,) = cs.simulate(bench("xyz", np.zeros(len(t_s))), {"young_pa": 7e4, **known}).wrenches
force_n = felt[:, 2] + np.random.default_rng(11).normal(scale=0.02, size=len(t_s))

# %%
# Read with sliding platens, the same forces mean a stiffer rubber, and fit less well.
runs = {}
for label, axes in (("sticks", "xyz"), ("slides", "z")):
    unknown = {"young_pa": cs.Unknown(5e4), **known}
    runs[label] = cs.run(cs.Problem([bench(axes, force_n)], unknown))
    print(f"{label}: E = {runs[label].parameters['young_pa']:.0f} Pa, {runs[label].trust.verdict}")
low, high = runs["sticks"].interval("young_pa")
assert low < 7e4 < high
assert runs["slides"].parameters["young_pa"] > 1.1 * runs["sticks"].parameters["young_pa"]

# %%
# The quarter that is computed, pressed further and further.
runs["sticks"].plot(count=3)

# %%
# Its force.
plt.plot(1e3 * down_m, -force_n, "k.", label="measured")
for label, run in runs.items():
    (fitted,) = run.solution.wrenches["press"]
    plt.plot(1e3 * down_m, -fitted[:, 2], label=f"{label}: E = {run.parameters['young_pa']:.0f} Pa")
plt.xlabel("crosshead [mm]")
plt.ylabel("force on a quarter [N]")
plt.legend()
plt.show()
