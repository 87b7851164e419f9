"""
Measured silicone between platens
=================================

Cylinders of Ecoflex 00-30, pressed in a testing machine that tells crosshead and load (Dawood et
al. 2026). No camera: the load alone tells the material. The data are fetched by
``python scripts get_phantom_compression``.
"""

# sphinx_gallery_thumbnail_path = 'pictures/measured_cylinders.png'
from pathlib import Path

import matplotlib.pyplot as plt

import collocation_sysid as cs

problems = next(p / "problems" for p in Path.cwd().resolve().parents if (p / "problems").is_dir())
problem = cs.Problem.read(problems / "phantom_compression" / "problem.toml")
run = cs.run(problem, seek_causes=False)
print(run.table())
assert 68e3 < run.derived["young_pa"] < 77e3

# %%
# A quarter of the cylinder between its platens.
run.plot()

# %%
# The runs that were fitted, and the load that the material gives.
fitted = [experiment for experiment in problem.experiments if not experiment.validation]
for experiment in fitted:
    upper = next(grasp for grasp in experiment.grasps if grasp.wrench is not None)
    assert upper.wrench is not None
    down_mm = -1e3 * upper.poses.at(upper.wrench.t_s)[1][:, 2]
    (line,) = plt.plot(down_mm, -upper.wrench.values[:, 2], ".", label=experiment.name)
    (load,) = run.solution.wrenches[experiment.name]
    plt.plot(down_mm, -load[:, 2], color=line.get_color())
plt.xlabel("crosshead [mm]")
plt.ylabel("load on a quarter [N]")
plt.legend()
plt.show()
