"""
Markers stuck on anywhere
=========================

Nobody measured where the markers sit on the block. Their places on the undeformed body are then
estimated with everything else, and what that costs is in the error bars.
"""

# sphinx_gallery_thumbnail_path = 'pictures/2_places_not_known.png'
import matplotlib.pyplot as plt
import numpy as np

import collocation_sysid as cs

block = cs.Body(cs.box_mesh((0.06, 0.06, 0.18), (2, 2, 6)), density_kg_m3=40.0)
t_s = 0.01 * np.arange(60)
poses = np.tile(np.eye(4), (len(t_s), 1, 1))
poses[:, 0, 3] = 0.04 * np.sin(14 * t_s) * np.minimum(1, t_s / 0.2) ** 2
hand = cs.Grasp(cs.Box((-1, -1, 0.179), (1, 1, 1)), poses)
truth = {"young_pa": 1500.0, "poisson": 0.3, "gamma_r_s": 0.004, "gamma_m_1_s": 0.5}
places_m = np.array([(0.0, 0.02, 0.01), (0.06, 0.03, 0.02), (0.03, 0.06, 0.05), (0.0, 0.03, 0.09)])
blank = np.zeros((len(t_s), 4, 3))
seen = cs.Markers(t_s, blank, sigma_m=1e-3, places_m=places_m)
swing = cs.Experiment(block, t_s, [hand], seen, name="swing")
tracks_m = cs.simulate(swing, truth, timestep_s=0.001).markers_m
tracks_m += np.random.default_rng(2).normal(scale=1e-3, size=tracks_m.shape)

# %%
# One recording, described twice: with the places, and without.
runs = {}
for label, known in (("known", places_m), ("not known", None)):
    markers = cs.Markers(t_s, tracks_m, sigma_m=1e-3, places_m=known)
    recording = cs.Experiment(block, t_s, [hand], markers, name="swing")
    damping = {"gamma_r_s": cs.Unknown(), "gamma_m_1_s": cs.Unknown()}
    parameters = {"young_pa": cs.Unknown(), "poisson": 0.3, **damping}
    runs[label] = cs.run(cs.Problem([recording], parameters))

# %%
# The markers on the block, whose volume changes with its stretch.
runs["not known"].plot(field="det_f", count=4)

# %%
# The places come out to a millimetre, and E is as good as before.
found = runs["not known"].places["swing"].values()
off_mm = [1e3 * np.linalg.norm(p.position_m - q) for p, q in zip(found, places_m, strict=True)]
print("places are off by", np.round(off_mm, 2), "mm")
assert max(off_mm) < 2.0
for k, (label, run) in enumerate(runs.items()):
    low, high = run.interval("young_pa")
    plt.plot([low, high], [k, k], lw=6, label=f"places {label}")
    assert low < truth["young_pa"] < high
plt.axvline(truth["young_pa"], color="k", ls=":", label="truth")
plt.yticks([])
plt.xlabel("95 % interval of E [Pa]")
plt.legend()
plt.show()
