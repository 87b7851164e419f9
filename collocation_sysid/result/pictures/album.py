"""All pictures of a run, by file name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from ...arrays import Array
from ...files import safe_name, whole_file
from ...methods.solution import Iteration
from ...recording.wrench import COMPONENTS, UNITS
from ...runs.result import Result
from ..replay import Replay
from ..style import RESOLUTION_DPI
from .confidence import Confidence, confidence_ellipses, correlation_matrix
from .convergence import convergence
from .elements import elements_picture
from .errors import error_over_time
from .mesh import mesh_picture
from .readings import readings_picture
from .scan import scan_picture
from .shapes import shapes
from .spectrum import spectrum
from .tracks import tracks


def album(
    replays: Sequence[Replay], found: Result, truth: Mapping[str, float] | None = None
) -> dict[str, Figure]:
    """All pictures of a run but that of its Jacobian, by file name.

    Parameters
    ----------
    replays : sequence of Replay
        The experiments; the mesh is drawn with grasps and markers of the first.
    found : Result
    truth : mapping, optional
        See `convergence`.
    """
    history = [Iteration(*vars(line).values()) for line in found.history]
    names = [name for name, item in found.parameters.items() if not item.fixed]
    pictures = {"convergence": convergence(history, names, truth)} if history else {}
    if (scan := found.scan) is not None:
        pictures["scan"] = scan_picture(scan.young_pa, scan.misfit, scan.best)
    confidence = Confidence.of(found)
    if confidence is not None and len(confidence.names) > 1:
        pictures["confidence"] = confidence_ellipses(confidence)
        pictures["correlation"] = correlation_matrix(confidence)
    if replays:
        pictures |= _of_body(replays[0])
    for replay in replays:
        pictures |= _of_experiment(replay)
    return pictures


def _of_body(replay: Replay) -> dict[str, Figure]:
    return {
        "mesh": mesh_picture(
            replay.undeformed_m,
            replay.surface,
            np.asarray(replay.held.any(axis=0)),
            replay.marker_places_m,
            replay.marker_names,
            replay.up,
            replay.surface_parts,
            replay.part_names,
            replay.given_places_m,
            replay.surface_nodes,
            replay.tendons_m,
        ),
        "elements": elements_picture(replay.undeformed_m, replay.tetrahedra),
    }


def _of_experiment(replay: Replay) -> dict[str, Figure]:
    t_s, measured = replay.t_s, replay.measured_m
    fitted, rolled_out = _finite(replay.markers_m), _finite(replay.rolled_out_m)
    pictures, names = dict[str, Figure](), replay.marker_names
    if len(names):
        pictures[f"tracks_{replay.name}"] = tracks(t_s, names, measured, fitted, rolled_out)
        pictures[f"error_{replay.name}"] = error_over_time(t_s, measured, fitted, rolled_out)
    if len(names) and not replay.static:
        spectral = spectrum(t_s, measured, fitted, replay.natural_hz)
        pictures[f"spectrum_{replay.name}"] = spectral
    for k, sensed in enumerate(replay.wrenches, start=1):
        which = "" if len(replay.wrenches) == 1 else f"_{k}"
        pictures[f"wrench_{replay.name}{which}"] = readings_picture(sensed, COMPONENTS, UNITS)
    for name, said in replay.readings.items():
        count = said.shape[1] // 3
        names = [f"{name} {k + 1}" for k in range(count)] if count > 1 else [name]
        pictures[f"reading_{replay.name}_{name}"] = readings_picture(said, names)
    if replay.shapes_m is not None and np.isfinite(replay.shapes_m).all(axis=(1, 2)).any():
        pictures[f"shapes_{replay.name}"] = shapes(
            t_s, replay.shapes_m, replay.surface, replay.held, measured, replay.up,
            surface_nodes=replay.surface_nodes,
        )  # fmt: skip
    return pictures


def _finite(markers_m: Array | None) -> Array | None:
    """Markers with gaps where a method or a simulation went astray."""
    return None if markers_m is None else np.where(np.isfinite(markers_m), markers_m, np.nan)


def save_pictures(folder: str | Path, pictures: Mapping[str, Figure]) -> list[Path]:
    """Write each picture as <name>.png and return the files.

    What a file name cannot hold becomes an underscore.
    """
    files = []
    for name, figure in pictures.items():
        file = Path(folder) / f"{safe_name(name)}.png"
        # Harder compression takes longer than drawing, for a tenth of the size.
        with whole_file(file) as draft:
            figure.savefig(draft, dpi=RESOLUTION_DPI, pil_kwargs={"compress_level": 2})
        files.append(file)
    return files
