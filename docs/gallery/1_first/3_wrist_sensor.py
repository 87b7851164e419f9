"""
Stiff, or only light?
=====================

Under gravity alone a body twice as stiff and twice as heavy moves the same: only E/ρ is known. A
force sensor in the wrist tells both.
"""

# sphinx_gallery_thumbnail_path = 'pictures/3_wrist_sensor.png'
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

import collocation_sysid as cs

block = cs.Body(cs.box_mesh((0.2, 0.06, 0.06), (8, 2, 2)), density_kg_m3=100.0)
t_s = 0.01 * np.arange(60)
poses = np.tile(np.eye(4), (len(t_s), 1, 1))
poses[:, 2, 3] = 0.04 * np.sin(13 * t_s) * np.minimum(1, t_s / 0.2) ** 2
sensor = cs.Wrench(t_s, np.zeros((len(t_s), 6)), sigma_n=0.05, sigma_nm=0.005)
hand = cs.Grasp(cs.Box((-1, -1, -1), (0.001, 1, 1)), poses, wrench=sensor)
places_m = [(0.2, 0.0, 0.0), (0.2, 0.06, 0.06), (0.15, 0.0, 0.06), (0.1, 0.06, 0.0)]
seen = cs.Markers(t_s, np.zeros((len(t_s), 4, 3)), sigma_m=5e-4, places_m=places_m)
swing = cs.Experiment(block, t_s, [hand], seen, name="swing")

# %%
# Tracks and forces of a simulation, both with noise.
known = {"poisson": 0.3, "gamma_r_s": 0.004, "gamma_m_1_s": 0.5}
truth = {"young_pa": 2e4, **known}
simulated, rng = (cs.simulate(swing, truth, timestep_s=0.001), np.random.default_rng(4))
tracks_m = simulated.markers_m + rng.normal(scale=5e-4, size=simulated.markers_m.shape)
(felt,) = simulated.wrenches
felt = felt + rng.normal(size=felt.shape) * np.repeat([0.05, 0.005], 3)
recording = cs.with_wrenches(cs.with_markers(swing, tracks_m), [felt])
blind = replace(recording, grasps=(replace(recording.grasps[0], wrench=None),))

# %%
# With the sensor E and the density have error bars.
unknown = {"young_pa": cs.Unknown(1e4), **known}
with_sensor = cs.run(cs.Problem([recording], {**unknown, "density_kg_m3": cs.Unknown(50.0)}))
print(with_sensor.table())
with_sensor.plot(count=3)

# %%
# Without the sensor each density taken on trust has a modulus of its own.
for density, colour in ((50.0, "C0"), (100.0, "C1"), (200.0, "C2")):
    without = cs.solve(cs.Problem([blind], {**unknown, "density_kg_m3": density}))
    plt.plot(density, 1e-3 * without.parameters["young_pa"], "o", color=colour)
    assert abs(without.parameters["young_pa"] / density / 200 - 1) < 0.02
plt.plot([0, 220], [0, 220 * 0.2], ":", label="E/ρ as the motion tells it")
for name, value in (("young_pa", 2e4), ("density_kg_m3", 100.0)):
    low, high = with_sensor.interval(name)
    assert low < value < high
plt.errorbar(
    with_sensor.parameters["density_kg_m3"],
    1e-3 * with_sensor.parameters["young_pa"],
    xerr=1.96 * with_sensor.std_error("density_kg_m3"),
    yerr=1.96e-3 * with_sensor.std_error("young_pa"),
    color="k",
    label="with the sensor",
)
plt.xlabel("density [kg/m³]")
plt.ylabel("E [kPa]")
plt.legend()
plt.show()
