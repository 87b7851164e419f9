"""
A measured soft tentacle
========================

A silicone tentacle, 360 mm long, that one tendon at a time bends (TU Delft): eight equilibria, four
markers in each. Tension and weight, both known, tell stiffness and density. The data are fetched by
``python scripts get_soft_tentacle``; it takes some minutes.
"""

# sphinx_gallery_thumbnail_path = 'pictures/measured_tentacle.png'
from pathlib import Path

import matplotlib.pyplot as plt

import collocation_sysid as cs

problems = next(p / "problems" for p in Path.cwd().resolve().parents if (p / "problems").is_dir())
problem = cs.Problem.read(problems / "soft_tentacle" / "problem.toml")
run = cs.run(problem, seek_causes=False)
print(run.table())
assert run.solution.rms_m < 0.01

# %%
# The tentacle at the largest tension of its first tendon.
run.plot(problem.experiments[3].name)

# %%
# The tentacle from the side at the four tensions of the first tendon, its markers as measured, and
# how far the model misses them.
for experiment, positions_m in zip(problem.experiments[:4], run.solution.positions_m, strict=False):
    (tendon,) = experiment.tendons
    _, y_mm, z_mm = 1e3 * positions_m[0].reshape(-1, 3).T
    (dots,) = plt.plot(y_mm, z_mm, ".", ms=2, label=f"{tendon.tension_n[0]:.1f} N")
    _, y_mm, z_mm = 1e3 * experiment.markers.positions_m[0].T
    plt.plot(y_mm, z_mm, "o", mfc="none", color=dots.get_color())
for name, rms_m in run.solution.rms_by_experiment_m.items():
    print(name, f"{1e3 * rms_m:.1f} mm off")
plt.xlabel("y [mm]")
plt.ylabel("z [mm]")
plt.axis("equal")
plt.legend(title="tension")
plt.show()
