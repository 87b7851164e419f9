"""
Silicone that creeps
====================

A block with memory is swung and held still. A material without memory fits the tracks badly and
finds a modulus between the two that there are; with one branch both come out.
"""

# sphinx_gallery_thumbnail_path = 'pictures/3_memory.png'
import matplotlib.pyplot as plt
import numpy as np

import collocation_sysid as cs

mesh = cs.box_mesh((0.1, 0.03, 0.03), (8, 2, 2))
t_s = 0.01 * np.arange(120)
poses = np.tile(np.eye(4), (len(t_s), 1, 1))
poses[:, 2, 3] = 0.02 * np.sin(np.pi * np.minimum(t_s / 0.4, 1)) ** 2
hand = cs.Grasp(cs.Box((-1, -1, -1), (0.001, 1, 1)), poses)
places_m = [(0.1, 0.0, 0.0), (0.1, 0.03, 0.03), (0.075, 0.0, 0.03), (0.05, 0.03, 0.0)]


def swung(body: cs.Body, tracks_m: np.ndarray) -> cs.Experiment:
    """The recording of a body."""
    seen = cs.Markers(t_s, tracks_m, sigma_m=2e-4, places_m=places_m)
    return cs.Experiment(body, t_s, [hand], seen, name="swing", start="undeformed")


# %%
# The truth relaxes by a quarter within some tenths of a second.
silicone = cs.Body(mesh, density_kg_m3=100.0, prony=["prony_1"])
elastic = {"young_pa": 2e4, "poisson": 0.3, "gamma_r_s": 0.003, "gamma_m_1_s": 0.5}
truth = {**elastic, "prony_1.share": 0.33, "prony_1.tau_s": 0.15}
tracks_m = cs.simulate(
    swung(silicone, np.zeros((len(t_s), 4, 3))), truth, timestep_s=0.001
).markers_m
tracks_m += np.random.default_rng(6).normal(scale=2e-4, size=tracks_m.shape)

# %%
# Both models, from the same recording.
known = {"poisson": 0.3, "gamma_m_1_s": 0.5}
start = {"young_pa": cs.Unknown(1e4), "gamma_r_s": cs.Unknown(), **known}
branch = {"prony_1.share": cs.Unknown(0.1), "prony_1.tau_s": cs.Unknown(0.5)}
plain = cs.Body(mesh, density_kg_m3=100.0)
without = cs.run(cs.Problem([swung(plain, tracks_m)], start))
with_branch = cs.run(cs.Problem([swung(silicone, tracks_m)], {**start, **branch}))
print(without.trust.verdict, *without.trust.reasons, sep="\n  ")
print(with_branch.table())
low, high = with_branch.interval("young_pa")
assert low < 2e4 < high
low, high = with_branch.interval("instantaneous_young_pa")
assert low < 2e4 * 1.33 < high
assert without.trust.verdict != "good"

# %%
# The block with memory.
with_branch.plot(count=3)

# %%
# What each leaves of the tip's height.
for label, run in (("no memory", without), ("one branch", with_branch)):
    missed_m = run.solution.readings_m[0] - tracks_m
    plt.plot(t_s, 1e3 * missed_m[:, 0, 2], label=label)
plt.xlabel("time [s]")
plt.ylabel("tip missed by [mm]")
plt.legend()
plt.show()
