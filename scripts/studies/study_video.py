"""Young's modulus from rendered videos: rendered by MuJoCo, tracked, and identified without a guess.

A foam bar hangs from a gripper that moves to and fro (`rendered_video`). Each row is a video with
other errors of pose, calibration and clock of the cameras, drawn from the priors that the problem
states. The time is that from the MP4 to the answer with its combined interval. Needs MuJoCo with
EGL, and OpenCV.

    python scripts study_video [--rates 60,30] [--cameras 1,2] [--seeds 5]
"""

from __future__ import annotations

import shutil
import tempfile
import time
from pathlib import Path

import numpy as np
import rendered_video
from make_templates import VIDEO_IMAGES, VIDEO_POINTS, write_poses_csv
from scipy.interpolate import CubicSpline
from script_arguments import make_parser

import collocation_sysid as cs
from collocation_sysid.problem.new import create_problem

NAMES = tuple(rendered_video.EYES_M)
DURATION_S = VIDEO_IMAGES / 60


def film_problem(folder: Path, shape: CubicSpline, rate_hz: float, cameras: int, seed: int) -> Path:
    """Write the problem of videos with a rate in a folder, and return its file."""
    file, *_ = create_problem(folder, "video")
    text = file.read_text(encoding="utf-8")
    before, table = text.split("[[experiment.image_tracks]]")
    table, after = table.split("[transcription]")
    tables = []
    t_s = np.arange(round(DURATION_S * rate_hz)) / rate_hz
    write_poses_csv(folder / "poses.csv", rendered_video.poses(0.01 * np.arange(-3.0, 156.0)))
    for name in NAMES[:cameras]:
        described = rendered_video.film(folder, name, shape, t_s, seed, VIDEO_POINTS)
        own = table.replace("front", name)
        begin = own.index("\npose = ") + 1
        end = own.index("\n", begin)
        pose = f"pose = {rendered_video.pose_text(described.pose)}"
        tables.append(f"[[experiment.image_tracks]]{own[:begin]}{pose}{own[end:]}")
    # Points of different cameras have different names, because each video is tracked alone.
    for name in NAMES[1:cameras]:
        tracks = folder / f"{name}.csv"
        head, _, rows = tracks.read_text().partition("\n")
        columns = [c if c == "t_s" else f"{name}_{c}" for c in head.split(",")]
        tracks.write_text(",".join(columns) + "\n" + rows)
    file.write_text(before + "".join(tables) + "[transcription]" + after, encoding="utf-8")
    return file


def main() -> None:
    """Print a table with one row for each video."""
    parser = make_parser(__doc__)
    parser.add_argument("--rates", default="60,30")
    parser.add_argument("--cameras", default="1,2")
    parser.add_argument("--seeds", default="5")
    options = parser.parse_args()
    shape = rendered_video.motion(rendered_video.surface()[0])
    truth = rendered_video.TRUTH
    print("| video | E over truth | 95 % | γ_r over truth | 95 % | residual [px] | verdict | min |")
    print("|---|---|---|---|---|---|---|---|", flush=True)
    for cameras in map(int, options.cameras.split(",")):
        for rate_hz in map(float, options.rates.split(",")):
            for seed in map(int, options.seeds.split(",")):
                folder = Path(tempfile.mkdtemp())
                file = film_problem(folder, shape, rate_hz, cameras, seed)
                begin_s = time.perf_counter()
                answer = cs.run(cs.Problem.read(file))
                minutes = (time.perf_counter() - begin_s) / 60
                cells = []
                for name in ("young_pa", "gamma_r_s"):
                    low, high = np.array(answer.interval(name)) / truth[name]
                    value = answer.estimates[name].value / truth[name]
                    cells += [f"{value:.3f}", f"{low:.3f} … {high:.3f}"]
                residual = max((answer.result.fit.experiments["swing"].reading_rms or {}).values())
                which = f"{cameras} camera{'s' * (cameras > 1)}, {rate_hz:.0f} Hz, seed {seed}"
                print(
                    f"| {which} | {' | '.join(cells)} | {residual:.2f} | {answer.trust.verdict} | "
                    f"{minutes:.1f} |",
                    flush=True,
                )
                shutil.rmtree(folder)


if __name__ == "__main__":
    main()
