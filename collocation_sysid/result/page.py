"""A run as one web page that needs nothing else: turn the body and play its motion."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from numpy.typing import NDArray

from ..arrays import Array
from ..display import escape
from ..files import write_whole
from .pictures.camera import Camera
from .replay import Replay

# More samples than this are thinned, to keep the page a few megabytes.
MOST_FRAMES = 300
# The colours end at the strain below which this share is: single corners are strained most.
STRAINED = 0.995


@dataclass(frozen=True)
class Colouring:
    """What colours the faces.

    Attributes
    ----------
    name : str
    values : mapping of trajectory ("fitted", "simulated") to (T, F)
    low, high : float
        Where the colours begin and end.
    ends : (str, str)
        What is written there.
    """

    name: str
    values: Mapping[str, Array]
    low: float
    high: float
    ends: tuple[str, str]

    @classmethod
    def strain(cls, replay: Replay) -> Colouring:
        """Largest principal strain."""
        values = {name: surface_strain(replay, x) for name, x in _trajectories(replay).items()}
        shown = np.abs(next(iter(values.values())))
        largest = float(np.nanquantile(shown, STRAINED)) or 1e-6
        return cls("strain", values, 0.0, largest, ("0", f"{100 * largest:.2g} % strain"))

    @classmethod
    def field(cls, name: str, fitted: Array) -> Colouring:
        """A field (T, F) of the fitted body."""
        low, high = float(np.nanmin(fitted)), float(np.nanmax(fitted))
        return cls(name, {"fitted": fitted}, low, high, (f"{low:.3g}", f"{high:.3g} {name}"))


def write_page(
    replay: Replay, file: str | Path, headline: str = "", colouring: Colouring | None = None
) -> Path:
    """Write an experiment, as fitted and as simulated forward, as a stand-alone web page.

    The page draws on a plain canvas, in any browser and without a network. Of long trajectories
    every second, third, … sample is kept.

    Parameters
    ----------
    replay : Replay
        With at least one trajectory.
    file : str or Path
    headline : str
        What was found, in a line.
    colouring : Colouring, optional
        What colours the body, and which trajectories; the strain of all by default.
    """
    template = files("collocation_sysid.result").joinpath("page.html").read_text(encoding="utf-8")
    content = _content(replay, colouring or Colouring.strain(replay))
    texts = {
        "TITLE": escape(replay.name),
        "HEADLINE": escape(headline),
        # Neither </script> nor <!-- may stand in a script.
        "DATA": json.dumps(content).replace("<", "\\u003c"),
    }
    # In one pass, so that a name which looks like a place is not filled in.
    page = re.sub("@(TITLE|HEADLINE|DATA)@", lambda place: texts[place[1]], template)
    write_whole(file, page)
    return Path(file)


def _trajectories(replay: Replay) -> dict[str, Array]:
    named = {"fitted": replay.positions_m, "simulated": replay.rolled_out_positions_m}
    return {name: x for name, x in named.items() if x is not None}


def _content(replay: Replay, colouring: Colouring) -> dict[str, Any]:
    kept = np.arange(0, len(replay.t_s), -(-len(replay.t_s) // MOST_FRAMES))
    outer, nodes = np.unique(replay.surface_nodes, return_inverse=True)
    nodes = nodes.reshape(len(replay.surface), -1)
    positions, values = _trajectories(replay), colouring.values
    shapes = {name: positions[name][kept][:, outer] for name in values}
    first = next(iter(shapes.values()))
    low, high = np.nanmin(first, axis=(0, 1)), np.nanmax(first, axis=(0, 1))
    span = (colouring.high - colouring.low) or 1.0
    shares = {name: (x[kept] - colouring.low) / span for name, x in values.items()}
    shares = {name: np.clip(np.nan_to_num(x), 0.0, 1.0) for name, x in shares.items()}
    there = first[np.isfinite(first).all(axis=(1, 2))]
    return {
        "t_s": replay.t_s[kept].tolist(),
        "nodes": len(outer),
        "markers": replay.measured_m.shape[1],
        "faces": _packed(nodes[:, :3], "<i4"),
        "sides": _packed(nodes[:, 3:], "<i4"),
        "quantity": colouring.name,
        "ends": colouring.ends,
        "shares": {name: _packed(np.rint(255 * x), "u1") for name, x in shares.items()},
        "opening": int(np.nansum(np.abs(next(iter(shares.values()))), axis=1).argmax()),
        "colours": [[round(255 * c) for c in colormaps["cividis"](k / 8)[:3]] for k in range(9)],
        "held": _packed(replay.held[kept][:, outer], "u1"),
        "outlines": "" if replay.obstacles_m is None else _packed(replay.obstacles_m[kept], "<f4"),
        "measured": _packed(replay.measured_m[kept], "<f4"),
        "shapes": {name: _packed(x, "<f4") for name, x in shapes.items()},
        "axes": Camera.facing(there, replay.up).axes.tolist(),
        "centre": ((low + high) / 2).tolist(),
        "size": float(np.linalg.norm(high - low)),
        "body": float(np.ptp(replay.undeformed_m, axis=0).max()),
    }


def surface_strain(replay: Replay, positions_m: Array) -> Array:
    """Largest principal stretch less one (T, F) of the elements below the surface.

    By their corners: of quadratic elements the mean.
    """
    cells = cells_of_faces(replay.tetrahedra, replay.surface)
    corners = replay.tetrahedra[cells]
    undeformed, moved = replay.undeformed_m[corners], positions_m[:, corners]
    edges, moved = undeformed[:, 1:] - undeformed[:, :1], moved[:, :, 1:] - moved[:, :, :1]
    gradient = np.linalg.solve(edges, moved)  # Fᵀ of each
    there = np.isfinite(gradient).all(axis=(2, 3))
    gradient[~there] = np.eye(3)
    stretch = np.linalg.svd(gradient, compute_uv=False)[..., 0]
    return np.where(there, stretch - 1.0, np.nan)


def cells_of_faces(tetrahedra: NDArray[Any], faces: NDArray[Any]) -> NDArray[np.int64]:
    """The tetrahedron (F,) that each boundary triangle is a side of."""
    sides = np.sort(tetrahedra[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]], axis=2)
    known = {tuple(side): k // 4 for k, side in enumerate(sides.reshape(-1, 3).tolist())}
    return np.array([known[tuple(face)] for face in np.sort(faces, axis=1).tolist()])


def _packed(array: NDArray[Any], kind: str) -> str:
    return base64.b64encode(np.ascontiguousarray(array, dtype=kind).tobytes()).decode("ascii")
