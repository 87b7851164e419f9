"""Stand-alone web page with the moving body of one experiment.

`write_page` is for readers who have a browser and no other software: the page contains all data,
and its body can be turned and played.
"""

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

from ..common.array_types import Array
from ..common.display import escape
from ..common.files import write_text_file
from .pictures.projection import ParallelCamera
from .replay import MotionRecord

# Largest number of samples on the page, which keeps it a few megabytes.
MAX_PAGE_FRAMES = 300
# Quantile of the strain at which the colour scale ends: strains in single corners are far larger.
STRAIN_QUANTILE = 0.995


@dataclass(frozen=True)
class Colouring:
    """Values that colour the faces of the body, with the limits of the colour scale.

    Attributes
    ----------
    name : str
        Name of the quantity.
    values : mapping of trajectory ("fitted", "simulated") to (T, F)
        Value at T samples on F boundary triangles; only these trajectories are shown.
    low, high : float
        Values at the two ends of the colour scale.
    end_labels : (str, str)
        Labels of the two ends.
    """

    name: str
    values: Mapping[str, Array]
    low: float
    high: float
    end_labels: tuple[str, str]

    @classmethod
    def by_strain(cls, replay: MotionRecord) -> Colouring:
        """Return the colouring of all trajectories of an experiment, of which it must have at least
        one, by the largest principal strain.

        The strain (T, F) is the largest stretch minus one, see `surface_strain`; NaN where a
        position is not finite. The scale reaches from 0 to the quantile `STRAIN_QUANTILE` of the
        absolute strain of the first trajectory, the fitted one if there is one, which must be
        finite somewhere.
        """
        values = {name: surface_strain(replay, x) for name, x in _trajectories(replay).items()}
        shown = np.abs(next(iter(values.values())))
        largest = float(np.nanquantile(shown, STRAIN_QUANTILE)) or 1e-6
        return cls(
            "strain",
            values,
            low=0.0,
            high=largest,
            end_labels=("0", f"{100 * largest:.2g} % strain"),
        )

    @classmethod
    def by_field(cls, name: str, values: Array, trajectory: str = "fitted") -> Colouring:
        """Return the colouring of one trajectory, the only one that is shown, by given values.

        Parameters
        ----------
        name : str
            Name of the quantity, which the label of the upper end contains.
        values : (T, F)
            Value at each sample on each boundary triangle; NaN is ignored for the limits.
        trajectory : {"fitted", "simulated"}
            Trajectory to show, which the experiment must have.
        """
        low = float(np.nanmin(values))
        high = float(np.nanmax(values))
        return cls(
            name,
            {trajectory: values},
            low=low,
            high=high,
            end_labels=(f"{low:.3g}", f"{high:.3g} {name}"),
        )


def write_page(
    replay: MotionRecord, file: str | Path, headline: str = "", colouring: Colouring | None = None
) -> Path:
    """Write the fitted and the simulated motion of an experiment as a stand-alone web page.

    The page draws on a plain canvas, in any browser and without a network. Of more than
    `MAX_PAGE_FRAMES` samples every second, third, … is kept.

    Parameters
    ----------
    replay : MotionRecord
        Experiment with at least one trajectory, finite at one sample at least.
    file : str or Path
        HTML file to write; it is replaced only after the page is complete, and missing parent
        folders are made.
    headline : str
        One line with the main result, below the title.
    colouring : Colouring, optional
        Colours of the body, and the trajectories to show; the strain of all trajectories by
        default.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    template = files("collocation_sysid.result").joinpath("page.html").read_text(encoding="utf-8")
    content = _page_data(replay, colouring or Colouring.by_strain(replay))
    texts = {
        "TITLE": escape(replay.name),
        "HEADLINE": escape(headline),
        # Neither </script> nor <!-- may stand in a script.
        "DATA": json.dumps(content).replace("<", "\\u003c"),
    }
    # In one pass, so that a name which looks like a place is not filled in.
    page = re.sub("@(TITLE|HEADLINE|DATA)@", lambda place: texts[place[1]], template)
    write_text_file(file, page)
    return Path(file)


def _trajectories(replay: MotionRecord) -> dict[str, Array]:
    """Return the node positions (T, n, 3) [m] of the trajectories that exist, by "fitted" and
    "simulated"; empty if there is neither.
    """
    named = {"fitted": replay.positions_m, "simulated": replay.rolled_out_positions_m}
    return {name: x for name, x in named.items() if x is not None}


def _page_data(replay: MotionRecord, colouring: Colouring) -> dict[str, Any]:
    """Return the data of the page for an experiment and its colouring, ready for JSON.

    Of more than `MAX_PAGE_FRAMES` samples every second, third, … is kept. The page shows the
    trajectories of `colouring.values` alone. Faces whose value is NaN have the colour of the lower
    end.
    """
    samples = np.arange(0, len(replay.t_s), -(-len(replay.t_s) // MAX_PAGE_FRAMES))
    surface_nodes, nodes = np.unique(replay.surface_nodes, return_inverse=True)
    nodes = nodes.reshape(len(replay.surface), -1)
    positions = _trajectories(replay)
    values = colouring.values
    shapes = {name: positions[name][samples][:, surface_nodes] for name in values}
    first = next(iter(shapes.values()))
    low = np.nanmin(first, axis=(0, 1))
    high = np.nanmax(first, axis=(0, 1))
    span = (colouring.high - colouring.low) or 1.0
    shares = {name: (x[samples] - colouring.low) / span for name, x in values.items()}
    shares = {name: np.clip(np.nan_to_num(x), 0.0, 1.0) for name, x in shares.items()}
    finite_m = first[np.isfinite(first).all(axis=(1, 2))]
    return {
        "t_s": replay.t_s[samples].tolist(),
        "nodes": len(surface_nodes),
        "markers": replay.measured_m.shape[1],
        "faces": _base64(nodes[:, :3], "<i4"),
        "sides": _base64(nodes[:, 3:], "<i4"),
        "quantity": colouring.name,
        "ends": colouring.end_labels,
        "shares": {name: _base64(np.rint(255 * x), "u1") for name, x in shares.items()},
        "opening": int(np.nansum(np.abs(next(iter(shares.values()))), axis=1).argmax()),
        "colours": [[round(255 * c) for c in colormaps["cividis"](k / 8)[:3]] for k in range(9)],
        "held": _base64(replay.is_prescribed[samples][:, surface_nodes], "u1"),
        "outlines": ""
        if replay.obstacles_m is None
        else _base64(replay.obstacles_m[samples], "<f4"),
        "measured": _base64(replay.measured_m[samples], "<f4"),
        "shapes": {name: _base64(x, "<f4") for name, x in shapes.items()},
        "axes": ParallelCamera.facing_motion(finite_m, replay.up).axes.tolist(),
        "centre": ((low + high) / 2).tolist(),
        "size": float(np.linalg.norm(high - low)),
        "body": float(np.ptp(replay.undeformed_m, axis=0).max()),
    }


def surface_strain(replay: MotionRecord, positions_m: Array) -> Array:
    """Return the largest principal strain (T, F) of the elements below the boundary triangles.

    The strain is the largest stretch minus one. It is computed from the corners of an element,
    which for a quadratic element gives an average. NaN where a position is not finite.

    Parameters
    ----------
    replay : MotionRecord
        Experiment, for mesh and surface.
    positions_m : (T, n, 3)
        Node positions of one of its trajectories.
    """
    cells = cells_below_faces(replay.tetrahedra, replay.surface)
    corners = replay.tetrahedra[cells]
    undeformed = replay.undeformed_m[corners]
    moved = positions_m[:, corners]
    edges = undeformed[:, 1:] - undeformed[:, :1]
    moved = moved[:, :, 1:] - moved[:, :, :1]
    gradient = np.linalg.solve(edges, moved)  # Fᵀ of each
    there = np.isfinite(gradient).all(axis=(2, 3))
    gradient[~there] = np.eye(3)
    stretch = np.linalg.svd(gradient, compute_uv=False)[..., 0]
    return np.where(there, stretch - 1.0, np.nan)


def cells_below_faces(tetrahedra: NDArray[Any], faces: NDArray[Any]) -> NDArray[np.int64]:
    """Return the index (F,) of the tetrahedron that each boundary triangle is a side of.

    Parameters
    ----------
    tetrahedra : (E, 4)
        Corner nodes of the tetrahedra.
    faces : (F, 3)
        Corner nodes of the triangles, in any order.

    Raises
    ------
    KeyError
        If a triangle is no side of any tetrahedron.
    """
    sides = np.sort(tetrahedra[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]], axis=2)
    known = {tuple(side): k // 4 for k, side in enumerate(sides.reshape(-1, 3).tolist())}
    return np.array([known[tuple(face)] for face in np.sort(faces, axis=1).tolist()])


def _base64(array: NDArray[Any], data_type: str) -> str:
    """Return an array, converted to the NumPy data type `data_type` such as "<f4", as base64 text
    of its bytes in row-major order.
    """
    return base64.b64encode(np.ascontiguousarray(array, dtype=data_type).tobytes()).decode("ascii")
