"""Time of a solve with image tracks of one camera, compared with that with markers at the same points.

A bar of 120 x 30 x 20 mm is swung at one end for 0.9 s. Thirty points are seen in 90 images with 0.5
pixels of noise, or measured with 0.5 mm; their places are known to 1 mm, or unknown. E and γ_r are
estimated. All cases are solved in turn in one process, so that other work on the machine slows all
of them. The output has the smallest processor times of `solve` after a first one that compiles, the
numbers of sweeps, and ratios to the markers with the same knowledge of their places.

    python scripts benchmark_image_tracks [--rounds 3]
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

import collocation_sysid as cs

sys.path.append(str(Path(__file__).parents[1] / "studies"))
from study_image_tracks import DISTORTION, MATRIX, TRUTH, looking, project

BODY = cs.Body(cs.box_mesh((0.12, 0.03, 0.02), (4, 1, 1)), density_kg_m3=1070.0)
T_S = 0.01 * np.arange(90)
EYE_M = np.array([0.06, -0.4, 0.2])
NOISE_PX = 0.5
NOISE_M = 5e-4
# Points on the two sides of the bar that the camera sees.
ALONG_M = np.linspace(0.02, 0.115, 8)
PLACES_M = np.array(
    [(x, 0.0, z) for x in ALONG_M for z in (0.004, 0.016)]
    + [(x, y, 0.02) for x in ALONG_M[1:] for y in (0.006, 0.024)]
)
NAMES = [f"point_{k}" for k in range(len(PLACES_M))]
KINDS = ("markers, known places", "tracks, known places", "markers", "tracks")


def recordings() -> dict[str, cs.Experiment]:
    """Return the recording of each kind."""
    true_m = cs.simulate(recording(positions_m=np.zeros((90, 30, 3))), TRUTH, "midpoint").markers_m
    rng = np.random.default_rng(0)
    noisy_m = true_m + NOISE_M * rng.normal(size=true_m.shape)
    pose = looking(EYE_M)
    pixels = project((true_m - pose[:3, 3]) @ pose[:3, :3], MATRIX)
    pixels += NOISE_PX * rng.normal(size=pixels.shape)
    camera = cs.Camera(MATRIX, DISTORTION, pose, size_px=(1280, 720))
    found = {}
    for kind in KINDS:
        places_m = PLACES_M if "known" in kind else None
        if "markers" in kind:
            found[kind] = recording(noisy_m, places_m=places_m)
            continue
        tracks = cs.ImageTracks(
            "camera", camera, T_S, pixels, NAMES, places_m=places_m, sigma_px=NOISE_PX
        )
        found[kind] = recording(readings=[tracks])
    return found


def recording(
    positions_m: np.ndarray | None = None, places_m: np.ndarray | None = PLACES_M, readings=()
) -> cs.Experiment:
    """Return the swung bar with its measurements."""
    share = 0.5 * (1 - np.cos(np.pi * np.clip(T_S / 0.12, 0, 1)))
    poses = np.tile(np.eye(4), (len(T_S), 1, 1))
    poses[:, 1, 3], poses[:, 2, 3] = 0.015 * share, 0.01 * share
    grasp = cs.Grasp(np.flatnonzero(BODY.nodes_m[:, 0] < 1e-9), poses)
    measured: dict = {"readings": readings}
    if positions_m is not None:
        known = {} if places_m is None else {"places_m": places_m, "places_sigma_m": 1e-3}
        measured["markers"] = cs.Markers(
            T_S, positions_m, NOISE_M, names=NAMES, on_surface=True, **known
        )
    return cs.Experiment(BODY, T_S, [grasp], nuisance=cs.Nuisance.none(), **measured)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--rounds", type=int, default=3)
    rounds = parser.parse_args().rounds
    unknown = {**TRUTH, "young_pa": cs.Unknown(1e5), "gamma_r_s": cs.Unknown(4e-3)}
    problems = {
        kind: cs.Problem([recorded], parameters=unknown) for kind, recorded in recordings().items()
    }
    times_s = {kind: np.inf for kind in KINDS}
    solutions = {}
    for number in range(rounds + 1):
        for kind, problem in problems.items():
            began_s = time.process_time()
            solutions[kind] = cs.solve(problem)
            if number:
                times_s[kind] = min(times_s[kind], time.process_time() - began_s)
    for kind, solution in solutions.items():
        parameters = solution.parameters
        peer = kind.replace("tracks", "markers")
        print(
            f"{kind}: {times_s[kind]:.2f} s, {solution.history[-1].number} sweeps, "
            f"{times_s[kind] / times_s[peer]:.2f} times {peer}, "
            f"{times_s[kind] / times_s[KINDS[0]]:.2f} times {KINDS[0]}; "
            f"E {parameters['young_pa'] / TRUTH['young_pa']:.4f} and "
            f"γ_r {parameters['gamma_r_s'] / TRUTH['gamma_r_s']:.3f} of the truth"
        )


if __name__ == "__main__":
    main()
