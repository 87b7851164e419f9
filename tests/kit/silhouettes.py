"""A bar that hangs from one end in one photograph, and masks that another program rasterises."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

import collocation_sysid as cs
from kit.depth import looking

TRUTH = {"young_pa": 1e5, "poisson": 0.45, "gamma_r_s": 1e-3, "gamma_m_1_s": 0.1}
SIZE_PX = (640, 480)
MATRIX = [[900.0, 0.0, 320.0], [0.0, 905.0, 240.0], [0.0, 0.0, 1.0]]
POSE = looking(np.array([0.06, -0.35, 0.06]), np.array([0.06, 0.015, -0.01]))
# A photograph of which the pose of the camera is known well, as from a calibration board.
KNOWN = cs.PoseSigma(turn_deg=0.2, shift_m=1e-3)
# Pixels of the polygons for each pixel of the mask, along each axis.
FINER = 8


@cache
def bar() -> cs.Body:
    return cs.Body(cs.box_mesh((0.12, 0.03, 0.02), (4, 1, 1)), density_kg_m3=1070.0)


def camera(**changes: Any) -> cs.Camera:
    arguments: dict[str, Any] = {"pose": POSE, "size_px": SIZE_PX}
    return cs.Camera(MATRIX, [-0.1, 0.02, 1e-3, -5e-4, 0.0], **arguments | changes)


def hanging(readings: Sequence[cs.CustomSensor] = (), **changes: Any) -> cs.Experiment:
    """The bar held at one end, sagging; with a marker at its tip without readings."""
    held = cs.Grasp(np.flatnonzero(bar().nodes_m[:, 0] < 1e-9), cs.PoseSequence.fixed())
    arguments: dict[str, Any] = {"nuisance": cs.Nuisance.none(), "readings": readings}
    if not readings:
        tip = cs.Markers([0.0], np.zeros((1, 1, 3)), 1e-3, places_m=[[0.12, 0.015, 0.01]])
        arguments["markers"] = tip
    return cs.Experiment(bar(), [0.0], [held], name="hung", kind="static", **arguments | changes)


@cache
def hanging_m() -> np.ndarray:
    """Nodes of the bar, sagging."""
    return cs.simulate(hanging(), TRUTH).positions_m[0]


def rasterised(nodes_m: np.ndarray, seen_by: cs.Camera) -> np.ndarray:
    """Mask of a shape, from polygons that Pillow draws finely and averages."""
    own = (nodes_m - seen_by.pose[:3, 3]) @ seen_by.pose[:3, :3]
    corners = FINER * (seen_by.distorted_pixels(own) + 0.5)
    image = Image.new("L", (FINER * SIZE_PX[0], FINER * SIZE_PX[1]))
    draw = ImageDraw.Draw(image)
    for face in bar().mesh.surface:
        draw.polygon([tuple(corner) for corner in corners[face].tolist()], fill=255)
    return np.asarray(image.resize(SIZE_PX, Image.Resampling.BOX)) > 127


@cache
def photograph() -> np.ndarray:
    return rasterised(hanging_m(), camera())


def outlines_of(mask: np.ndarray | None = None, **changes: Any) -> cs.Outlines:
    arguments: dict[str, Any] = {"pose_sigma": KNOWN, "sigma_px": 0.5}
    masks = [photograph() if mask is None else mask]
    return cs.Outlines("front", camera(), [0.0], masks, **arguments | changes)


PROBLEM = """
[object]
mesh = "bar.vtu"
density_kg_m3 = 1070.0
[parameters]
young_pa = { guess = 2e5 }
poisson = 0.45
gamma_r_s = 1e-3
gamma_m_1_s = 0.1
[[experiment]]
name = "hung"
kind = "static"
[experiment.grasp]
nodes = { box_m = [[-1, -1, -1], [1e-6, 1, 1]] }
[[experiment.outlines]]
name = "front"
file = "FILE"
[experiment.outlines.camera]
matrix = MATRIX
distortion = DISTORTION
size_px = [640, 480]
pose = POSE
"""


def folder_with(folder: Path, file: str) -> Path:
    """Write the mesh, and the problem of a photograph whose mask is in a file; return the latter."""
    text = PROBLEM.replace("FILE", file).replace("POSE", str(camera().pose.tolist()))
    text = text.replace("MATRIX", str(np.asarray(camera().matrix).tolist()))
    text = text.replace("DISTORTION", str(camera().distortion.tolist()))
    bar().mesh.write(folder / "bar.vtu")
    (folder / "problem.toml").write_text(text)
    return folder / "problem.toml"
