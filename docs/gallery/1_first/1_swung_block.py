"""
What is this block made of?
===========================

A hand swings a foam block, cameras track four points on it. From the hand's poses and the tracks
come Young's modulus and the damping, with error bars.
"""

# sphinx_gallery_thumbnail_path = 'pictures/1_swung_block.png'
import matplotlib.pyplot as plt
import numpy as np

import collocation_sysid as cs

# %%
# A body is a mesh, a material and a mass; the hand holds the nodes at its top.
block = cs.Body(cs.box_mesh((0.06, 0.06, 0.18), (2, 2, 6)), density_kg_m3=40.0)
t_s = 0.01 * np.arange(60)
poses = np.tile(np.eye(4), (len(t_s), 1, 1))
poses[:, 0, 3] = 0.04 * np.sin(14 * t_s) * np.minimum(1, t_s / 0.2) ** 2
hand = cs.Grasp(cs.Box((-1, -1, 0.179), (1, 1, 1)), poses)

# %%
# The recording is simulated here, in steps of 1 ms by another integrator than the fit's, and gets
# the noise of a camera.
truth = {"young_pa": 1500.0, "poisson": 0.3, "gamma_r_s": 0.004, "gamma_m_1_s": 0.5}
places_m = [(0.0, 0.0, 0.0), (0.06, 0.0, 0.0), (0.06, 0.06, 0.045), (0.0, 0.06, 0.09)]
seen = cs.Markers(t_s, np.zeros((len(t_s), 4, 3)), sigma_m=1e-3, places_m=places_m)
swing = cs.Experiment(block, t_s, [hand], seen, name="swing")
clean_m = cs.simulate(swing, truth, timestep_s=0.001).markers_m
noise_m = np.random.default_rng(1).normal(scale=1e-3, size=clean_m.shape)
recording = cs.with_markers(swing, clean_m + noise_m)

# %%
# Poisson's ratio is taken as known; the rest is found, without a guess. Of a simulated recording
# nothing but the noise is uncertain; of a real one leave the last argument out.
unknown = {"young_pa": cs.Unknown(), "gamma_r_s": cs.Unknown(), "gamma_m_1_s": cs.Unknown()}
exact = cs.UncertaintyOptions(assumptions=cs.Assumptions.exact())
run = cs.run(cs.Problem([recording], {"poisson": 0.3, **unknown}, uncertainty=exact))
print(run.table())
low, high = run.interval("young_pa")
assert low < truth["young_pa"] < high
assert run.trust.verdict == "good"

# %%
# The block as it moved, coloured by the stress in it.
run.plot(count=4)

# %%
# How the tip moves, as seen and as the identified block does when it is simulated again.
again_m = run.rollouts["swing"].trajectory.markers_m
plt.plot(t_s, 1e3 * recording.markers.positions_m[:, 0, 0], ".", label="camera")
plt.plot(t_s, 1e3 * again_m[:, 0, 0], label="identified, simulated again")
plt.plot(t_s, 1e3 * poses[:, 0, 3], ":", label="hand")
plt.xlabel("time [s]")
plt.ylabel("x of the tip [mm]")
plt.title(f"E = {run.parameters['young_pa']:.0f} Pa, {low:.0f} to {high:.0f}")
plt.legend()
plt.show()
