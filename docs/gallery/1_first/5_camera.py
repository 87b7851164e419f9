"""
One camera, no motion capture
=============================

A bar hangs from a hand that swings it, and one ordinary camera films it. Ten points on its skin are
tracked in the film; where they are on the body, nobody has measured. The stated pose of the camera
is wrong by about 1° and 5 mm.

The film is simulated here. ``collocation-sysid new bar --kind video`` writes a problem with a video
that MuJoCo has rendered and ``collocation-sysid track`` has tracked.
"""

# sphinx_gallery_thumbnail_path = 'pictures/5_camera.png'
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import PolyCollection
from scipy.spatial.transform import Rotation

import collocation_sysid as cs

bar = cs.Body(cs.box_mesh((0.03, 0.03, 0.15), (1, 1, 4)), density_kg_m3=1070.0)
t_s = np.arange(48) / 60
truth = {"young_pa": 120e3, "poisson": 0.45, "gamma_r_s": 0.003, "gamma_m_1_s": 0.3}
poses = np.tile(np.eye(4), (len(t_s), 1, 1))
poses[:, 0, 3] = 0.03 * np.sin(11 * t_s) * np.minimum(1, t_s / 0.2) ** 2
hand = cs.Grasp(cs.Box((-1, -1, 0.149), (1, 1, 1)), poses)

# Half a metre in front of the bar, and a little above its middle.
pose = np.eye(4)
pose[:3, :3] = Rotation.from_euler("XZ", [-100, 12], degrees=True).as_matrix()
pose[:3, 3] = np.array([0.015, 0.015, 0.075]) - 0.5 * pose[:3, 2]
camera = cs.Camera([[1000, 0, 640], [0, 1000, 360], [0, 0, 1]], pose=pose, size_px=(1280, 720))

# %%
# The film, simulated: the true camera differs from the stated one, and pixels are noisy.
rng = np.random.default_rng(5)
true_pose = pose.copy()
true_pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(np.deg2rad([0.7, -0.6, 0.9])).as_matrix()
true_pose[:3, 3] += [0.004, -0.005, 0.003]
places_m = [(x, 0.0, z) for z in (0.01, 0.04, 0.07, 0.1, 0.13) for x in (0.006, 0.024)]
names = [f"dot_{k}" for k in range(len(places_m))]
exact = {"pose_sigma": cs.PoseSigma(turn_deg=0, shift_m=0), "clock_sigma_s": 0.0}
film = cs.ImageTracks(
    "phone", replace(camera, pose=true_pose), t_s, None, names, places_m=places_m, **exact
)
filmed = cs.Experiment(bar, t_s, [hand], readings=[film], name="swing")
motion = cs.simulate(filmed, truth, "midpoint", substeps=4)
pixels = motion.custom_sensor_values[0].reshape(len(t_s), -1, 2)
pixels = pixels + rng.normal(scale=0.5, size=pixels.shape)


def draw(axes: plt.Axes, nodes_m: np.ndarray, seen_by: np.ndarray) -> None:
    """Draw the faces of the bar, far ones first, as a camera with a pose sees them."""
    corners = nodes_m[bar.mesh.surface]
    own = (corners - seen_by[:3, 3]) @ seen_by[:3, :3]
    order = np.argsort(-own[..., 2].mean(axis=1))
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    light = abs(normals @ [0.3, -0.8, 0.5]) / np.linalg.norm(normals, axis=1)
    shades = plt.get_cmap("copper")(0.3 + 0.6 * light)
    shown = camera.distorted_pixels(own.reshape(-1, 3)).reshape(-1, 3, 2)
    axes.add_collection(PolyCollection(shown[order], facecolors=shades[order]))
    axes.set(xlim=(440, 840), ylim=(560, 160), aspect="equal")


# %%
# What the user knows: the pixels, the calibration, and the pose to 1° and 5 mm. The places of the
# points, E and the damping have no guess.
tracks = cs.ImageTracks("phone", camera, t_s, pixels, names, sigma_px=0.5)
parameters = {
    "young_pa": cs.Unknown(),
    "poisson": 0.45,
    "gamma_r_s": cs.Unknown(),
    "gamma_m_1_s": 0.3,
}
simulated = cs.UncertaintyOptions(assumptions=cs.Assumptions.exact(), profile=())
recording = replace(filmed, readings=[tracks])
run = cs.run(cs.Problem([recording], parameters, uncertainty=simulated), seek_causes=False)
young = run.estimates["young_pa"]
low, high = young.combined95
print(f"{run.trust.verdict}: E {young.value / 1e3:.1f} kPa, {low / 1e3:.1f} to {high / 1e3:.1f}")
assert abs(young.value / truth["young_pa"] - 1) < 0.01

# %%
# Four images of the film: white dots are the tracked points and their paths, red crosses the fit.
fitted = run.solution.readings["swing"]["phone"].reshape(len(t_s), -1, 2)
frames = (0, 15, 30, 45)
_, axes = plt.subplots(1, 4, figsize=(9, 2.6), sharey=True)
for each, frame in zip(axes, frames, strict=True):
    draw(each, motion.positions_m[frame], true_pose)
    each.plot(*pixels[max(0, frame - 10) : frame + 1].transpose(2, 0, 1), "w-", lw=0.7)
    each.plot(*pixels[frame].T, "w.")
    each.set_title(f"{t_s[frame]:.2f} s")
    each.plot(*fitted[frame].T, "r+", ms=8)
plt.show()
