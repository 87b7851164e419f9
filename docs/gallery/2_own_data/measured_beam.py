"""
A measured silicone beam
========================

A beam of Dragon Skin 10, clamped, let go without a load and with 52 and 102 g at its tip (Soft
Robotics Lab, ETH Zurich). One material with a branch of memory fits the three recordings. The data
are fetched by ``python scripts get_srl_beam``.
"""

# sphinx_gallery_thumbnail_path = 'pictures/measured_beam.png'
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import collocation_sysid as cs

problems = next(p / "problems" for p in Path.cwd().resolve().parents if (p / "problems").is_dir())
problem = cs.Problem.read(problems / "srl_beam" / "memory.toml")
run = cs.run(problem, seek_causes=False)
print(run.table())
assert 250e3 < run.parameters["young_pa"] < 275e3

# %%
# The beam as it swings with the largest weight.
run.plot(problem.experiments[-1].name, count=4)

# %%
# Its tip, as measured and as fitted.
for experiment, fitted_m in zip(problem.experiments, run.solution.readings_m, strict=True):
    (line,) = plt.plot(experiment.t_s, 1e3 * fitted_m[:, 0, 2], label=experiment.name)
    seen_m = experiment.markers.positions_m[:, 0, 2]
    plt.plot(experiment.t_s, 1e3 * seen_m, ".", ms=2, color=line.get_color())
    print(experiment.name, f"{1e3 * np.nanstd(fitted_m[:, 0, 2] - seen_m):.2f} mm off")
plt.xlabel("time [s]")
plt.ylabel("height of the tip [mm]")
plt.legend()
plt.show()
