"""
When not to trust it
====================

The cameras' clock is 30 ms late, and the problem says that there is one clock for both. The fit
converges all the same; the verdict tells what is wrong with it.
"""

# sphinx_gallery_thumbnail_path = 'pictures/4_late_clock.png'
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

import collocation_sysid as cs

block = cs.Body(cs.box_mesh((0.06, 0.06, 0.18), (1, 1, 3)), density_kg_m3=40.0)
t_s = 0.01 * np.arange(60)
truth = {"young_pa": 1500.0, "poisson": 0.3, "gamma_r_s": 0.004, "gamma_m_1_s": 0.5}


def hand(late_s: float) -> cs.Grasp:
    """The swinging hand, seen by a clock that is late."""
    then_s = np.maximum(t_s - late_s, 0)
    poses = np.tile(np.eye(4), (len(t_s), 1, 1))
    poses[:, 0, 3] = 0.04 * np.sin(14 * then_s) * np.minimum(1, then_s / 0.2) ** 2
    return cs.Grasp(cs.Box((-1, -1, 0.179), (1, 1, 1)), poses)


places_m = [(0.0, 0.0, 0.0), (0.06, 0.0, 0.0), (0.06, 0.06, 0.045), (0.0, 0.06, 0.09)]
seen = cs.Markers(t_s, np.zeros((len(t_s), 4, 3)), sigma_m=1e-3, places_m=places_m)
late = cs.Experiment(block, t_s, [hand(0.03)], seen, name="swing")
tracks_m = cs.simulate(late, truth, timestep_s=0.001).markers_m
tracks_m += np.random.default_rng(3).normal(scale=1e-3, size=tracks_m.shape)

# %%
# The same recording, once with clocks taken as one, once with an unknown shift.
recording = cs.with_markers(replace(late, grasps=(hand(0.0),)), tracks_m)
parameters = {
    "young_pa": cs.Unknown(),
    "poisson": 0.3,
    "gamma_r_s": cs.Unknown(),
    "gamma_m_1_s": cs.Unknown(),
}
simulated = cs.UncertaintyOptions(assumptions=cs.Assumptions.exact())
runs = {}
for label, prior_s in (("one clock", None), ("a clock of their own", 0.05)):
    told = replace(recording, nuisance=replace(recording.nuisance, time_shift_s=prior_s))
    runs[label] = cs.run(cs.Problem([told], parameters, uncertainty=simulated))
    trust = runs[label].trust
    print(label, "->", trust.verdict, *trust.reasons, sep="\n  ")

# %%
# The first answer looks converged, and is doubtful; the second is good.
assert runs["one clock"].trust.verdict == "doubtful"
assert runs["a clock of their own"].trust.verdict == "good"
for label, run in runs.items():
    fitted_m = run.solution.readings_m[0]
    plt.plot(t_s, 1e3 * np.linalg.norm(fitted_m - tracks_m, axis=2).mean(axis=1), label=label)
plt.xlabel("time [s]")
plt.ylabel("markers missed by [mm]")
plt.legend()
plt.show()
