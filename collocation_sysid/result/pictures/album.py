"""All pictures of a run by file name, after a solve or from the files of its folder."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import chain, count
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from ...common.array_types import Array
from ...common.files import replaced_file, safe_name
from ...common.signal_handling import INTERRUPTS
from ...common.step_counting import StepUnit, complete_steps, counted_phase
from ...recording.measured_wrench import COMPONENTS, UNITS
from ...recording.specimen import is_harmonic, is_relaxation
from ...runs.result_content import Result
from ..figure_style import RESOLUTION_DPI, own_settings
from ..replay import MotionRecord, damaged_run_refused, read_run
from .cameras import camera_pictures, is_of_tracks
from .confidence import (
    Confidence,
    budget_picture,
    combinations_picture,
    confidence_ellipses,
    correlation_matrix,
)
from .field_intervals import field_picture
from .meshes import elements_picture, mesh_picture
from .over_time import marker_errors, marker_tracks, sensor_picture, spectrum_picture
from .search import convergence, scan_picture
from .shapes import obstacle_pictures, shapes_picture
from .stress_strain import force_picture, harmonic_picture, relaxation_picture, strain_picture


@own_settings()
def all_pictures(replays: Sequence[MotionRecord], result: Result) -> dict[str, Figure]:
    """Return all pictures of a run except that of its Jacobian, by file name without ending.

    Pictures without data are left out. A run of specimens alone has those of its measurements over
    strain only.

    Parameters
    ----------
    replays : sequence of MotionRecord
        The experiments, perhaps none. Mesh, elements and spatially varying constants are drawn of
        the first one with a mesh, with its grasps and markers.
    result : Result
        Content of ``result.json`` of the same run.
    """
    drawn = (named for replay in replays for named in experiment_pictures(replay))
    if replays and all(replay.strain is not None for replay in replays):
        return with_unique_names(drawn)
    names = [n for n, item in result.parameters.items() if not item.fixed and n in result.estimates]
    pictures = dict[str, Figure]()
    if result.history:
        pictures["convergence"] = convergence(result.history, names)
    if (scan := result.scan) is not None:
        pictures["scan"] = scan_picture(scan.young_pa, scan.misfit, best=scan.best)
    confidence = Confidence.from_result(result)
    if confidence is not None and len(confidence.names) > 1:
        pictures["confidence"] = confidence_ellipses(confidence)
        pictures["correlation"] = correlation_matrix(confidence)
    known = result.uncertainty
    # Alone, each combination is one of the constants.
    if known is not None and any(len(each.names) > 1 for each in known.directions):
        members = {name for each in known.directions for name in each.names}
        ends = {n: result.parameters[n].combined95 for n in names if n in members}
        alone = {
            name: float(np.sqrt(interval[1] / interval[0]))
            for name, interval in ends.items()
            if interval is not None and interval[0] > 0
        }
        pictures["combinations"] = combinations_picture(alone, known.directions)
    if result.budget:
        pictures["budget"] = budget_picture(result.budget)
    with_mesh = [replay for replay in replays if replay.strain is None]
    if with_mesh:
        body = with_mesh[0]
        pictures["mesh"] = mesh_picture(body)
        if not body.slender:
            pictures["elements"] = elements_picture(body.undeformed_m, body.tetrahedra)
        for name, values in body.fields.items():
            pictures[f"field_{name}"] = field_picture(body, name, values=values)
    return with_unique_names(chain(pictures.items(), drawn))


def with_unique_names(pictures: Iterable[tuple[str, Figure]]) -> dict[str, Figure]:
    """Return pictures by file name without suffix, in which characters that a file name cannot have
    become underscores; "_2", "_3", … is appended to a name that an earlier picture has already.
    """
    named = dict[str, Figure]()
    for text, figure in pictures:
        name = safe_name(text)
        numbered = (f"{name}_{k}" for k in count(2))
        named[next(free for free in chain([name], numbered) if free not in named)] = figure
    return named


def experiment_pictures(replay: MotionRecord) -> Iterator[tuple[str, Figure]]:
    """Yield name and picture of everything that is known of one experiment.

    A name is the kind of picture before the name of the experiment, such as "tracks_swing", and of
    a custom sensor or camera also that one's name; names may repeat. A specimen has only
    pictures of its measurements over strain, named "<measurement>_<experiment>", and one of a table
    of moduli that of its moduli, named "modulus_<experiment>". Infinite positions are drawn as NaN: as gaps.
    """
    t_s = replay.t_s
    measured = replay.measured_m
    fitted = _infinities_as_nan(replay.markers_m)
    rolled_out = _infinities_as_nan(replay.rolled_out_m)
    names = replay.marker_names
    if replay.strain is not None:
        for name, values in replay.readings.items():
            unit = replay.reading_units.get(name, "")
            if is_harmonic(replay.strain) and len(values) == len(replay.strain):
                yield f"modulus_{replay.name}", harmonic_picture(replay.strain, t_s, values)
                continue
            if is_relaxation(replay.strain) and len(values) == len(replay.strain):
                yield f"modulus_{replay.name}", relaxation_picture(replay.strain, t_s, values)
                continue
            picture = strain_picture(
                replay.strain, replay.t_s, samples=values, name=name, unit=unit
            )
            yield f"{name.replace(' ', '_')}_{replay.name}", picture
        return
    if len(names):
        yield (
            f"tracks_{replay.name}",
            marker_tracks(t_s, names, measured_m=measured, fitted_m=fitted, simulated_m=rolled_out),
        )
        yield (
            f"error_{replay.name}",
            marker_errors(t_s, measured, fitted_m=fitted, simulated_m=rolled_out),
        )
    if len(names) and not replay.static:
        yield (
            f"spectrum_{replay.name}",
            spectrum_picture(t_s, measured, fitted_m=fitted, natural_hz=replay.natural_hz),
        )
    for number, columns in enumerate(replay.wrenches, 1):
        which = "" if len(replay.wrenches) == 1 else f"_{number}"
        if replay.travel_m is not None:
            curve = force_picture(replay.travel_m, t_s, columns)
            if curve is not None:
                yield f"force_displacement_{replay.name}{which}", curve
        yield f"wrench_{replay.name}{which}", sensor_picture(columns, COMPONENTS, units=UNITS)
    for name, values in replay.readings.items():
        places = values.shape[1] // 3
        names = [f"{name} {k + 1}" for k in range(places)] if places > 1 else [name]
        names = replay.reading_columns.get(name, names)
        unit = replay.reading_units.get(name)
        units = [unit] * places if unit else []
        is_tracks = is_of_tracks(replay.outlines.get(name))
        kind = "pixels" if is_tracks else "reading"
        yield (f"{kind}_{replay.name}_{name}", sensor_picture(values, names, units=units))
    if replay.visible_points or replay.outlines:
        yield from camera_pictures(replay)
    if replay.has_shapes():
        yield f"shapes_{replay.name}", shapes_picture(replay)
        for name, figure in obstacle_pictures(replay).items():
            yield f"{name}_{replay.name}", figure


def _infinities_as_nan(markers_m: Array | None) -> Array | None:
    """A method that diverged has infinities."""
    return None if markers_m is None else np.where(np.isfinite(markers_m), markers_m, np.nan)


@own_settings()
def save_pictures(
    folder: str | Path, pictures: Mapping[str, Figure], say: Callable[[str], None] | None = None
) -> list[Path]:
    """Write each picture as <name>.png and return the files; existing ones are replaced.

    Parameters
    ----------
    folder : str or Path
        Folder to write into; it is made if missing.
    pictures : mapping of name to Figure
        Characters that a file name cannot have become underscores.
    say : callable, optional
        Called before each picture with a sentence that has its number, counted from 1.

    Raises
    ------
    InputError
        If a picture cannot be written.
    """
    files = []
    with counted_phase(StepUnit.PICTURE, len(pictures)):
        for k, (name, figure) in enumerate(pictures.items(), start=1):
            file = Path(folder) / f"{safe_name(name)}.png"
            if say is not None:
                say(f"drawing picture {k} of {len(pictures)}: {file.name}")
            # Harder compression takes longer than drawing, for a tenth of the size. Libraries may
            # lose an exception that a signal raises within them.
            with INTERRUPTS.deferred(), replaced_file(file) as draft:
                figure.savefig(draft, dpi=RESOLUTION_DPI, pil_kwargs={"compress_level": 2})
            complete_steps(StepUnit.PICTURE)
            files.append(file)
    return files


def redraw_pictures(
    run: str | Path, folder: str | Path, say: Callable[[str], None] | None = None
) -> list[Path]:
    """Write the pictures of a run folder into `folder`, all but that of the Jacobian, and return
    the files.

    Parameters
    ----------
    folder : str or Path
        Folder to write into, made if missing; existing pictures are replaced.
    say : callable, optional
        See `save_pictures`.

    Raises
    ------
    InputError
        If `run` is not a run folder or a damaged one, or a picture cannot be written.
    """
    result, replays = read_run(run)
    with damaged_run_refused(Path(run)):
        return save_pictures(folder, all_pictures(replays, result), say=say)
