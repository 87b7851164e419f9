"""
From files on a disk
====================

A mesh, the gripper's poses and the marker tracks lie in a folder; a problem file of a few lines
says what they are. It is what ``collocation-sysid solve`` takes.
"""

# sphinx_gallery_thumbnail_path = 'pictures/1_problem_file.png'
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import collocation_sysid as cs

folder = Path(tempfile.mkdtemp())
mesh = cs.box_mesh((0.06, 0.06, 0.18), (2, 2, 6))
mesh.write(folder / "block.vtu")  # any format that meshio reads

# %%
# Poses are tables of time, position and quaternion; tracks of time and coordinates. Here they are
# of a simulation.
t_s = 0.01 * np.arange(60)
poses = np.tile(np.eye(4), (len(t_s), 1, 1))
poses[:, 0, 3] = 0.04 * np.sin(14 * t_s) * np.minimum(1, t_s / 0.2) ** 2
turned = np.tile([0.0, 0.0, 0.0, 1.0], (len(t_s), 1))
np.savetxt(
    folder / "poses.csv",
    np.column_stack([t_s, poses[:, :3, 3], turned]),
    delimiter=",",
    header="t_s,x_m,y_m,z_m,qx,qy,qz,qw",
    comments="",
)
body = cs.Body(mesh, density_kg_m3=40.0)
hand = cs.Grasp(cs.Box((-1, -1, 0.179), (1, 1, 1)), poses)
places_m = [(0.0, 0.0, 0.0), (0.06, 0.0, 0.0), (0.06, 0.06, 0.045), (0.0, 0.06, 0.09)]
seen = cs.Markers(t_s, np.zeros((len(t_s), 4, 3)), sigma_m=1e-3, places_m=places_m)
truth = {"young_pa": 1500.0, "poisson": 0.3, "gamma_r_s": 0.004, "gamma_m_1_s": 0.5}
swing = cs.Experiment(body, t_s, [hand], seen)
tracks_m = cs.simulate(swing, truth, timestep_s=0.001).markers_m
tracks_m += np.random.default_rng(5).normal(scale=1e-3, size=tracks_m.shape)
columns = [f"{name}_{axis}" for name in ("tip_1", "tip_2", "low", "middle") for axis in "xyz"]
np.savetxt(
    folder / "markers.csv",
    np.column_stack([t_s, tracks_m.reshape(len(t_s), -1)]),
    delimiter=",",
    header=",".join(["t_s", *columns]),
    comments="",
)

# %%
# The problem file. Units stand in the keys; what is not said has a default, and places that are
# not given are estimated.
(folder / "problem.toml").write_text("""
[object]
mesh = "block.vtu"
density_kg_m3 = 40.0

[parameters]
young_pa = {}
poisson = { fixed = 0.3 }
gamma_r_s = {}
gamma_m_1_s = {}

[[experiment]]
name = "swing"
grasp = { nodes = { box_m = [[-1, -1, 0.179], [1, 1, 1]] }, poses = "poses.csv" }
markers = { file = "markers.csv", sigma_m = 0.001 }
""")
run = cs.run(cs.Problem.read(folder / "problem.toml"))
print(run.table())
low, high = run.interval("young_pa")
assert low < truth["young_pa"] < high

# %%
# ``save`` writes what the command writes: result.json, the trajectory, plots, frames for ParaView.
run.save(folder / "run", frames=False)
print(*sorted(file.name for file in (folder / "run").iterdir()), sep="\n")
run.plot(field="energy_density_j_m3", count=4)

# %%
# A corner of its tip.
plt.plot(t_s, 1e3 * tracks_m[:, 0, 0], ".", label="tip_1, as tracked")
plt.plot(t_s, 1e3 * run.solution.readings_m[0][:, 0, 0], label="as fitted")
plt.xlabel("time [s]")
plt.ylabel("x [mm]")
plt.legend()
plt.show()
