"""A run as one web page that needs nothing else: turn the body and play its motion."""

from __future__ import annotations

import base64
import html
import json
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .pictures.camera import Camera
from .replay import Replay

# More samples than this are thinned, to keep the page a few megabytes.
MOST_FRAMES = 300


def write_page(replay: Replay, file: str | Path) -> Path:
    """Write an experiment, as fitted and as rolled out, as a stand-alone web page.

    The page draws on a plain canvas, in any browser and without a network. Of long trajectories
    every second, third, … sample is kept.

    Parameters
    ----------
    replay : Replay
        With at least one trajectory.
    file : str or Path
    """
    template = files("collocation_sysid.output").joinpath("page.html").read_text(encoding="utf-8")
    # What would end the script early cannot be in JSON's strings.
    data = json.dumps(_content(replay)).replace("</", "<\\/")
    page = template.replace("@TITLE@", html.escape(replay.name)).replace("@DATA@", data)
    Path(file).parent.mkdir(parents=True, exist_ok=True)
    Path(file).write_text(page, encoding="utf-8")
    return Path(file)


def _content(replay: Replay) -> dict[str, Any]:
    kept = np.arange(0, len(replay.t_s), -(-len(replay.t_s) // MOST_FRAMES))
    outer, faces = np.unique(replay.surface, return_inverse=True)
    named = {"fitted": replay.positions_m, "rolled out": replay.rolled_out_positions_m}
    shapes = {name: x[kept][:, outer] for name, x in named.items() if x is not None}
    first = next(iter(shapes.values()))
    low, high = first.min(axis=(0, 1)), first.max(axis=(0, 1))
    return {
        "t_s": replay.t_s[kept].tolist(),
        "nodes": len(outer),
        "markers": replay.measured_m.shape[1],
        "faces": _packed(faces, "<i4"),
        "held": _packed(replay.held[kept][:, outer], "u1"),
        "measured": _packed(replay.measured_m[kept], "<f4"),
        "shapes": {name: _packed(x, "<f4") for name, x in shapes.items()},
        "axes": Camera.facing(first, replay.up).axes.tolist(),
        "centre": ((low + high) / 2).tolist(),
        "size": float(np.linalg.norm(high - low)),
    }


def _packed(array: NDArray[Any], kind: str) -> str:
    return base64.b64encode(np.ascontiguousarray(array, dtype=kind).tobytes()).decode("ascii")
