"""Draw the picture of the page on image tracks: the bar of the video template, rendered at rest by
MuJoCo (EGL), with the tracks that the template has.
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from PIL import Image
from scipy.interpolate import CubicSpline
from script_arguments import require_no_arguments

from collocation_sysid.result.figure_style import SKY, VERMILION

ROOT = Path(__file__).parents[2]
TRACKS = ROOT / "collocation_sysid" / "problem" / "templates" / "video" / "front.csv"
# Part of the image that is shown [pixels].
COLUMNS, ROWS = (440, 840), (620, 0)


def main() -> None:
    """Write docs/pictures/tracked_video.png."""
    sys.path.append(str(ROOT / "scripts" / "data"))
    import rendered_video

    rotations, translations = rendered_video.poses(0.01 * np.arange(3.0)).at(np.zeros(1))
    at_rest_m = rendered_video.surface()[0] @ rotations[0].T + translations[0]
    shape = CubicSpline([0.0, 1.0, 2.0], [at_rest_m] * 3)
    pose = rendered_video.looking(np.array(rendered_video.EYES_M["front"]))
    image = next(iter(rendered_video.render(shape, pose, np.zeros(1), 5)))
    table = np.genfromtxt(TRACKS, delimiter=",", skip_header=1)[:, 1:]
    figure = plt.figure(figsize=(2.6, 4.0), dpi=150)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.imshow(image[..., ::-1])
    for u, v in table.reshape(len(table), -1, 3)[..., :2].transpose(1, 2, 0):
        axes.plot(u, v, color=VERMILION, linewidth=0.8)
        axes.plot(u[0], v[0], "o", color=SKY, markersize=3)
    axes.set_axis_off()
    axes.set(xlim=COLUMNS, ylim=ROWS)
    file = ROOT / "docs" / "pictures" / "tracked_video.png"
    figure.savefig(file)
    with Image.open(file) as drawn:
        drawn.convert("RGB").quantize(48).save(file, optimize=True)


if __name__ == "__main__":
    require_no_arguments(__doc__)
    main()
