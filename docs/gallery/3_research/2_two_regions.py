"""
A soft finger with a stiff core
===============================

Regions have materials and parameters of their own, named after them.
"""

# sphinx_gallery_thumbnail_path = 'pictures/2_two_regions.png'
import matplotlib.pyplot as plt
import numpy as np

import collocation_sysid as cs

core = cs.Region("core", cs.Box((-1, -1, -1), (0.04, 1, 1)))
body = cs.Body(cs.box_mesh((0.12, 0.03, 0.03), (9, 2, 2)), density_kg_m3=60.0, regions=[core])
t_s = 0.01 * np.arange(80)
poses = np.tile(np.eye(4), (len(t_s), 1, 1))
poses[:, 2, 3] = 0.03 * np.sin(15 * t_s) * np.minimum(1, t_s / 0.2) ** 2
hand = cs.Grasp(cs.Box((-1, -1, -1), (0.001, 1, 1)), poses)
places_m = [(0.12, 0.0, 0.0), (0.12, 0.03, 0.03), (0.08, 0.0, 0.03), (0.04, 0.03, 0.0)]
seen = cs.Markers(t_s, np.zeros((len(t_s), 4, 3)), sigma_m=2e-4, places_m=places_m)
swing = cs.Experiment(body, t_s, [hand], seen, name="swing")
known = {"poisson": 0.3, "core.poisson": 0.3}
damping = {f"{where}{name}": value for where in ("", "core.") for name, value in
           (("gamma_r_s", 0.003), ("gamma_m_1_s", 0.5))}  # fmt: skip
truth = {"young_pa": 2e4, "core.young_pa": 8e4, **known, **damping}
tracks_m = cs.simulate(swing, truth, timestep_s=0.001).markers_m
tracks_m += np.random.default_rng(7).normal(scale=2e-4, size=tracks_m.shape)

# %%
# Both moduli from one recording.
unknown = {"young_pa": cs.Unknown(4e4), "core.young_pa": cs.Unknown(4e4)}
run = cs.run(cs.Problem([cs.with_markers(swing, tracks_m)], {**unknown, **known, **damping}))
print(run.table())
run.plot(field=None, count=3)

# %%
# The intervals, and the truth.
for k, name in enumerate(unknown):
    low, high = run.interval(name)
    assert low < truth[name] < high
    plt.plot([low, high], [k, k], lw=6, color=f"C{k}", label=name)
    plt.plot(truth[name], k, "k|", ms=20)
plt.xscale("log")
plt.yticks([])
plt.xlabel("95 % interval, and the truth [Pa]")
plt.legend()
plt.show()
