"""Motion of one experiment of a run: measured, fitted and simulated shapes and markers.

Pictures and films need nothing but a `MotionRecord`. It can be read from the arrays of a run folder
(`read_run`), so that they can be drawn again without solving.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import MISSING, dataclass, field, fields
from functools import cached_property
from itertools import takewhile
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.array_types import Array
from ..common.display import rounded, two_digits
from ..common.files import RESULT_FILE, damage_refused, require_own
from ..errors import InputError
from ..fem.elements import EDGES
from ..fem.laws.constants import BENDING, symbol_of, unit_of, without_region
from ..recording.experiment import Experiment
from ..recording.sample_times import TIME_TOLERANCE_S
from ..recording.specimen_files import specimen_strains
from ..runs.result_content import Result

ARRAYS_FILE = "trajectory.npz"
# Prefix of arrays of wrenches, before the number of the sensor, from 1.
WRENCH_PREFIX = "wrench_"
# Prefixes of arrays of the attributes that are mappings, before the name.
GROUP_PREFIXES = {
    "readings": "reading_",
    "fields": "field_",
    "visible_points": "visible_",
    "outlines": "outline_",
}
# Prefixes of the unit of a custom sensor and of the names of its numbers, before its name.
UNIT_PREFIX = "unit_"
COLUMNS_PREFIX = "columns_"
# Arrays of the body, the same for all experiments of a run but specimens, which have their own.
BODY_ARRAYS = (
    "undeformed_m",
    "tetrahedra",
    "surface",
    "surface_parts",
    "surface_nodes",
    "part_names",
)
# Kind and axes of each array: n nodes, E elements, F triangles, T samples, M markers, k modes,
# p and o points of lines.
ARRAY_LAYOUT = {
    "undeformed_m": ("f", "n3"),
    "tetrahedra": ("iu", "E4"),
    "surface": ("iu", "F3"),
    "surface_parts": ("iu", "F"),
    "surface_nodes": ("iu", "Fs"),
    "t_s": ("f", "T"),
    "is_prescribed": ("b", "Tn"),
    "up": ("f", "3"),
    "marker_places_m": ("f", "M3"),
    "declared_places_m": ("f", "M3"),
    "measured_m": ("f", "TM3"),
    "positions_m": ("f", "Tn3"),
    "markers_m": ("f", "TM3"),
    "rolled_out_positions_m": ("f", "Tn3"),
    "rolled_out_m": ("f", "TM3"),
    "natural_hz": ("f", "k"),
    "tendons_m": ("f", "p3"),
    "obstacles_m": ("f", "To3"),
    "gaps_m": ("f", "TF"),
    "pressures_pa": ("f", "TF"),
    "strain": ("f", "T"),
    "travel_m": ("f", "T3"),
}
# Words for the kinds of numbers in `ARRAY_LAYOUT`.
KINDS_TEXT = {"f": "floats", "iu": "whole numbers", "b": "booleans"}
# Part of its way by which a bench may leave the line along which it moves.
LINE_TOLERANCE = 1e-3
# Side of the square that represents a plane, over the body's largest extent.
PLANE_SIZE_RATIO = 1.4
# Arrays that may have NaN or infinity.
ARRAYS_WITH_NAN = ARRAY_LAYOUT.keys() - {"undeformed_m", "t_s", "up", "marker_places_m"}
# Largest magnitude of any number in an array: beyond, squares overflow.
LARGEST_NUMBER = 1e100


def image_key(camera: str) -> str:
    """Return the key of the unit of a camera's image coordinates in `MotionRecord.reading_units`."""
    return f"image of {camera}"


def image_unit(has_matrix: bool) -> str:
    """Return the unit of image coordinates: of a camera with a matrix, and of a point cloud without."""
    return "pixels" if has_matrix else "mm"


def first_and_worst_images(samples: Array) -> list[int]:
    """Return the indices of the first image of tracks with a measured point, and of the one with the
    largest RMS error of the fit, else of the simulation; fewer if they agree or none is compared.

    Parameters
    ----------
    samples : (S, 1 + 3m) array
        Times, and m pixel coordinates as measured, fitted and simulated, see
        `MotionRecord.readings`.
    """
    measured, fitted, simulated = np.split(samples[:, 1:], 3, axis=1)
    model = fitted if np.isfinite(fitted).any() else simulated
    seen = np.flatnonzero(np.isfinite(measured).any(axis=1))
    squares = (model - measured) ** 2
    known = np.isfinite(squares).sum(axis=1)
    errors = np.nansum(squares, axis=1) / np.maximum(known, 1)
    images = [*seen[:1].tolist(), *([int(errors.argmax())] if known.any() else [])]
    return list(dict.fromkeys(images))


@dataclass(frozen=True, eq=False)
class MotionRecord:
    """Measured, fitted and simulated motion of an experiment at T samples of n nodes and M markers."""

    name: str  # name of the experiment
    t_s: Array  # (T,): times of the samples
    undeformed_m: Array  # (n, 3): nodes of the undeformed body
    tetrahedra: NDArray[np.integer]  # (E, 4): corner nodes of the elements
    # (F, 3): boundary triangles, counter-clockwise when seen from outside.
    surface: NDArray[np.integer]
    # (F,): index of the part of the body that each boundary triangle belongs to.
    surface_parts: NDArray[np.integer]
    # (F, 3) or (F, 6): nodes of each boundary triangle; of quadratic elements also those on its
    # sides, behind the corners.
    surface_nodes: NDArray[np.integer]
    part_names: Sequence[str]  # (P,) str: names of the parts; "" for elements outside all regions
    # (T, n) bool: whether a node is grasped; those of planes of symmetry are not.
    is_prescribed: NDArray[np.bool_]
    up: Array  # (3,): unit vector against gravity; z where there is no gravity
    marker_names: Sequence[str]  # (M,) str: names of the markers
    marker_places_m: Array  # (M, 3): estimated places of the markers on the undeformed body
    declared_places_m: Array  # (M, 3): stated places of the markers, NaN where none was stated
    measured_m: Array  # (T, M, 3): measured markers, NaN where missing
    # (T, n, 3) and (T, M, 3), or None: fitted nodes and markers; None for a validation experiment.
    positions_m: Array | None = None
    markers_m: Array | None = None
    # (T, n, 3) and (T, M, 3), or None: nodes and markers of the forward simulation; None if it
    # failed.
    rolled_out_positions_m: Array | None = None
    rolled_out_m: Array | None = None
    # (k,), or None: natural frequencies at the estimate, ascending; None if they are unknown.
    natural_hz: Array | None = None
    # sequence of (S, 19): for each force–torque sensor: time [s], and force and torque [N, N m] as
    # measured, fitted and simulated; NaN where one of these is missing.
    wrenches: Sequence[Array] = ()
    static: bool = False  # whether every sample is an equilibrium of its own
    slender: bool = False  # whether the body is a rod, whose tetrahedra are no elements
    # (p, 3), or None: points of the tendons on the undeformed body, a row of NaN after each tendon.
    tendons_m: Array | None = None
    # mapping of name to (S, 1 + 3m): for each custom sensor: time [s], and its m numbers as
    # measured, fitted and simulated.
    readings: Mapping[str, Array] = field(default_factory=dict)
    # (T, o, 3), or None: points of the obstacles' outlines, NaN after each line.
    obstacles_m: Array | None = None
    # (T, F), or None: gap and pressure of obstacles on the fitted or else simulated surface; None
    # without any.
    gaps_m: Array | None = None
    pressures_pa: Array | None = None
    # mapping of name to (E, 4): for each spatially varying constant: the estimate, the ends of its
    # 95 % interval, and its posterior over its prior standard deviation; NaN in elements of other
    # regions.
    fields: Mapping[str, Array] = field(default_factory=dict)
    # mapping of name to (k, 8): for each camera, rows of its points, with the time [s] in column 0,
    # the distance behind the surface [m] (NaN for points that do not count) in column 4 and the
    # position in the world [m] from column 5, and rows of outlines; `camera_overlays` describes
    # them completely.
    visible_points: Mapping[str, Array] = field(default_factory=dict)
    # mapping of name to (k, 4): for each camera with outlines or tracks, of a few images: time [s],
    # 0 for the edge of the mask and 1 for the fitted contour of the body, and pixel u, v; contours
    # in images of tracks are pieces of lines with NaN after each.
    outlines: Mapping[str, Array] = field(default_factory=dict)
    # mapping of name to str: units of the custom sensors that state one, and of image coordinates,
    # see `image_key`.
    reading_units: Mapping[str, str] = field(default_factory=dict)
    # mapping of name to m str: names of the numbers of each custom sensor.
    reading_columns: Mapping[str, Sequence[str]] = field(default_factory=dict)
    # (T,), or None: strain of a specimen without a mesh; None for other experiments.
    strain: Array | None = None
    # (T, 3), or None: displacement along a line of a test bench whose force is measured; None for
    # other motions.
    travel_m: Array | None = None

    @classmethod
    def from_experiment(
        cls,
        experiment: Experiment,
        fitted: tuple[Array, Array] | None = None,
        simulated: tuple[Array, Array] | None = None,
        natural_hz: Array | None = None,
        places_m: Array | None = None,
        recorded: Mapping[str, Any] = MappingProxyType({}),
    ) -> MotionRecord:
        """Return the motion of an experiment; obstacles' nodes are left out.

        `fields`, `visible_points` and `outlines` stay empty.

        Parameters
        ----------
        experiment : Experiment
            Recording with the measured markers.
        fitted, simulated : ((T, n, 3), (T, M, 3)), optional
            Positions of nodes and markers [m], of the fit and of the forward simulation, whose
            nodes may be followed by those of obstacles; None if there is none.
        natural_hz : (k,), optional
            Natural frequencies [Hz].
        places_m : (M, 3), optional
            Estimated places of the markers; the stated ones by default.
        recorded : mapping of attribute to value, optional
            Further attributes, as the features give them, see `recorded_series`.
        """
        body = experiment.body
        markers = experiment.markers
        declared_m = markers.predict_positions(body.nodes_m)
        nodes_m = body.nodes.points_m
        # Frames of obstacles are left out: experiments of a run have one body, but not as many.
        fitted, simulated = (
            each and (each[0][:, : len(nodes_m)], each[1]) for each in (fitted, simulated)
        )
        return cls(
            experiment.name,
            experiment.t_s,
            nodes_m,
            body.mesh.tetrahedra,
            body.mesh.surface,
            body.part_of_place_cells[body.mesh.surface_cells],
            nodes_of_faces(body.place_cells[body.mesh.surface_cells], body.mesh.surface),
            [part.name for part in body.parts],
            _are_grasped(experiment)[:, : len(nodes_m)],
            experiment.upward_direction,
            markers.names,
            declared_m if places_m is None else places_m,
            np.where(markers.located[:, None], declared_m, np.nan),
            markers.positions_m,
            *(fitted or (None, None)),
            *(simulated or (None, None)),
            natural_hz,
            static=experiment.is_static,
            slender=not body.is_solid,
            tendons_m=_join_polylines([tendon.points_m for tendon in experiment.tendons]),
            obstacles_m=_obstacle_outlines(experiment),
            reading_units={gauge.name: gauge.unit for gauge in experiment.readings if gauge.unit}
            | {
                image_key(camera.name): image_unit(camera.camera.matrix is not None)
                for camera in experiment.depths
            },
            reading_columns={each.name: [*each.columns] for each in experiment.readings},
            strain=specimen_strains(experiment)[0] if experiment.specimen else None,
            travel_m=_bench_travel(experiment),
            **recorded,
        )

    @property
    def shapes_m(self) -> Array | None:
        """Fitted node positions (T, n, 3), else the simulated ones; None if neither exists."""
        return self.positions_m if self.positions_m is not None else self.rolled_out_positions_m

    def camera_points_m(self, sample: int) -> Array:
        """Return the points (P, 3) [m] of all cameras at the time of the sample with index
        `sample`.

        Of each camera, the image nearest in time counts if it is at most half of the largest
        distance between samples away; without one the camera adds no points, and P may be 0.
        Points that do not count are left out.
        """
        tolerance_s = float(np.diff(self.t_s).max(initial=0.0)) / 2 + TIME_TOLERANCE_S
        nearest = [np.zeros((0, 3))]
        for rows in self.visible_points.values():
            points = rows[np.isfinite(rows[:, 4])]
            times = np.unique(points[:, 0])
            differences_s = np.abs(times - self.t_s[sample])
            if differences_s.min(initial=np.inf) <= tolerance_s:
                nearest.append(points[points[:, 0] == times[differences_s.argmin()], 5:])
        return np.concatenate(nearest)

    @cached_property
    def face_outlines(self) -> NDArray[np.integer]:
        """Nodes along the edge of each boundary triangle, (F, 3), or (F, 6) of quadratic elements."""
        if self.surface_nodes.shape[1] == 3:
            return self.surface
        at_m = self.undeformed_m
        middles_m = (at_m[self.surface] + at_m[np.roll(self.surface, -1, axis=1)]) / 2
        on_sides = self.surface_nodes[:, 3:]
        apart_m = np.linalg.norm(at_m[on_sides][:, None] - middles_m[:, :, None], axis=3)
        ordered = np.take_along_axis(on_sides, apart_m.argmin(axis=2), axis=1)
        return np.stack([self.surface, ordered], axis=2).reshape(len(self.surface), 6)

    def has_shapes(self) -> bool:
        """Return whether at least one sample has finite positions of all nodes."""
        shapes_m = self.shapes_m
        return shapes_m is not None and bool(np.isfinite(shapes_m).all(axis=(1, 2)).any())

    def to_arrays(self, prefix: str = "") -> dict[str, Array]:
        """Return the arrays to store in a file, by name; attributes that are None are left out.

        The names begin with `prefix`, except those of the body (`BODY_ARRAYS`), which all
        experiments of a run share except specimens. Simulated positions are rounded to single
        precision. "residuals_m", the fitted minus the measured markers, is added if there is a fit.
        """
        stored: dict[str, Any] = {key: getattr(self, key) for key in ARRAY_LAYOUT}
        stored |= {
            k: stored[k].astype(np.int32) for k, (kinds, _) in ARRAY_LAYOUT.items() if "i" in kinds
        }
        if self.rolled_out_positions_m is not None:
            stored["rolled_out_positions_m"] = self.rolled_out_positions_m.astype(np.float32)
        stored |= {key: np.array(getattr(self, key)) for key in ("part_names", "marker_names")}
        for flag in ("static", "slender"):
            stored[flag] = np.array(True) if getattr(self, flag) else None
        stored["residuals_m"] = None if self.markers_m is None else self.markers_m - self.measured_m
        stored |= {f"{WRENCH_PREFIX}{k}": columns for k, columns in enumerate(self.wrenches, 1)}
        for group, front in GROUP_PREFIXES.items():
            stored |= {f"{front}{name}": values for name, values in getattr(self, group).items()}
        stored |= {f"{UNIT_PREFIX}{n}": np.array(unit) for n, unit in self.reading_units.items()}
        for name, columns in self.reading_columns.items():
            stored[f"{COLUMNS_PREFIX}{name}"] = np.array(columns)
        there = {key: value for key, value in stored.items() if value is not None}
        shared = BODY_ARRAYS if self.strain is None else ()
        return {key if key in shared else prefix + key: value for key, value in there.items()}

    @classmethod
    def from_arrays(cls, name: str, arrays: Mapping[str, Any]) -> MotionRecord:
        """Return the experiment called `name` from the arrays of a run, see
        `MotionRecord.to_arrays`.

        The names of the arrays begin with `name` and a slash, or have no prefix if there is no
        `name`/t_s. Those of the body (`BODY_ARRAYS`), which experiments of a run share, have no
        prefix either, unless the experiment has its own, as a specimen. Other arrays are ignored.

        Raises
        ------
        KeyError
            If a required array is missing.
        ValueError
            If sizes, types or values of the arrays are not consistent.
        """
        prefix = f"{name}/" if f"{name}/t_s" in arrays else ""
        shared = () if f"{prefix}{BODY_ARRAYS[0]}" in arrays else BODY_ARRAYS
        own = {key: key if key in shared else prefix + key for key in ARRAY_LAYOUT}
        needed = {each.name for each in fields(cls) if each.default is MISSING}
        stored: dict[str, Any] = {
            key: arrays[at] if key in needed else arrays.get(at) for key, at in own.items()
        }
        keys = [f"{prefix}{WRENCH_PREFIX}{k}" for k in range(1, len(arrays) + 1)]
        stored["wrenches"] = [arrays[key] for key in takewhile(arrays.__contains__, keys)]
        for group, front in GROUP_PREFIXES.items():
            group_prefix = f"{prefix}{front}"
            stored[group] = {
                k.removeprefix(group_prefix): arrays[k]
                for k in arrays
                if k.startswith(group_prefix)
            }
        stored["reading_units"] = {
            name: str(arrays[at])
            for name in (*stored["readings"], *map(image_key, stored["visible_points"]))
            if (at := f"{prefix}{UNIT_PREFIX}{name}") in arrays
        }
        stored["reading_columns"] = {
            name: [str(column) for column in arrays[at]]
            for name, values in stored["readings"].items()
            if (at := f"{prefix}{COLUMNS_PREFIX}{name}") in arrays
            and 3 * len(arrays[at]) + 1 == values.shape[1]
        }
        for flag in ("static", "slender"):
            stored[flag] = bool(arrays.get(f"{prefix}{flag}", False))
        _require_shapes(stored)
        stored["marker_names"] = [str(marker) for marker in arrays[f"{prefix}marker_names"]]
        names_key = "part_names" if "part_names" in shared else f"{prefix}part_names"
        stored["part_names"] = [str(part) for part in arrays[names_key]]
        parts = stored["surface_parts"]
        if len(stored["marker_names"]) != len(stored["marker_places_m"]):
            raise ValueError(
                f"marker_names has {len(stored['marker_names'])} names for "
                f"{len(stored['marker_places_m'])} markers"
            )
        if parts.min() < 0 or parts.max() >= len(stored["part_names"]):
            raise ValueError(
                f"surface_parts has part numbers {parts.min()} to {parts.max()}; expected 0 to "
                f"{len(stored['part_names']) - 1}, the indices of part_names"
            )
        return cls(name=name, **stored)


def _obstacle_outlines(experiment: Experiment) -> Array | None:
    """Return the outlines of all obstacles at each sample (T, o, 3) [m], or None."""
    body = experiment.body.nodes.points_m
    outlines = []
    for obstacle in experiment.obstacles:
        low = body.min(axis=0)
        high = body.max(axis=0)
        size_m = PLANE_SIZE_RATIO * float((high - low).max())
        outline = _join_polylines(obstacle.shape.outline_polylines((low + high) / 2, size_m))
        assert outline is not None
        rotations, shifts = obstacle.poses.at(experiment.t_s)
        outlines.append(np.einsum("tij,kj->tki", rotations, outline) + shifts[:, None])
    return np.concatenate(outlines, axis=1) if outlines else None


def _join_polylines(lines_m: Sequence[Array]) -> Array | None:
    """Return polylines in one array (p, 3), a row of NaN after each; None without."""
    if not lines_m:
        return None
    return np.concatenate([np.vstack([line, np.full(3, np.nan)]) for line in lines_m])


def _are_grasped(experiment: Experiment) -> NDArray[np.bool_]:
    """Return whether each node is in a grasp at each sample (T, n). Fixed grasps along one axis
    without a wrench are left out: planes of symmetry, and supports on which the body slides.
    """
    is_grasped = np.zeros((len(experiment.t_s), len(experiment.body.nodes_m)), dtype=bool)
    for grasp in experiment.grasps:
        is_fixed = not np.ptp(grasp.poses.positions_m, axis=0).any()
        if len(grasp.axes) > 1 or grasp.wrench is not None or not is_fixed:
            is_grasped[np.ix_(grasp.is_active(experiment.t_s), grasp.nodes)] = True
    return is_grasped


def nodes_of_faces(cells: NDArray[np.integer], faces: NDArray[np.integer]) -> NDArray[np.integer]:
    """Return the nodes of each boundary face: its corners and, for quadratic cells, those on its
    sides.

    Parameters
    ----------
    cells : (F, 4) or (F, 10)
        Nodes of the cell below each face.
    faces : (F, 3)
        Corner nodes of the faces.

    Returns
    -------
    (F, 3) or (F, 6) array
        The columns of `faces`, and for cells of ten nodes the nodes at the middles of the three
        sides, in the order of the edges of the cell.
    """
    if cells.shape[1] != 10:
        return faces
    ends = cells[:, np.array(EDGES)]  # (F, 6, 2)
    on_face = (ends[..., None] == faces[:, None, None]).any(axis=3).all(axis=2)
    return np.hstack([faces, cells[:, 4:][on_face].reshape(len(faces), 3)])


def _require_shapes(arrays: Mapping[str, Any]) -> None:
    """Optional arrays are None if they are missing; others must not be None."""
    sizes: dict[str, int] = {}
    for key, (kinds, letters) in ARRAY_LAYOUT.items():
        if (array := arrays.get(key)) is None:
            continue
        expected = [int(x) if x.isdigit() else sizes.get(x) for x in letters]
        here = array.shape
        empty = any(not size for x, size in zip(letters, here, strict=False) if x not in "Mk")
        if array.dtype.kind not in kinds or array.ndim != len(letters) or empty:
            raise ValueError(
                f"{key} is {array.dtype} of shape {here}; expected {KINDS_TEXT[kinds]} with "
                f"{len(letters)} axes, none of length 0"
            )
        if any(
            size not in (None, size_here) for size, size_here in zip(expected, here, strict=True)
        ):
            raise ValueError(f"{key} has shape {here}, which does not match the other arrays")
        sizes |= {x: size for x, size in zip(letters, here, strict=True) if not x.isdigit()}
        if kinds == "f" and not (key in ARRAYS_WITH_NAN or np.isfinite(array).all()):
            raise ValueError(f"{key} contains numbers that are not finite")
        if kinds == "f" and float(np.nanmax(np.abs(array), initial=0.0)) > LARGEST_NUMBER:
            raise ValueError(f"{key} contains numbers above {LARGEST_NUMBER:g}")
    elements = len(arrays["tetrahedra"])
    fits = {
        "readings": lambda shape: len(shape) == 2 and shape[0] and shape[1] % 3 == 1 < shape[1],
        "fields": lambda shape: shape == (elements, 4),
        "visible_points": lambda shape: shape[1:] == (8,),
        "outlines": lambda shape: shape[1:] == (4,),
    }
    shape_texts = {
        "readings": "(samples, 1 + 3 k) with k > 0",
        "fields": f"({elements}, 4)",
        "visible_points": "(points, 8)",
        "outlines": "(pixels, 4)",
    }
    for group, front in GROUP_PREFIXES.items():
        for name, array in arrays[group].items():
            if array.dtype.kind != "f" or not fits[group](array.shape):
                raise ValueError(
                    f"{front}{name} is {array.dtype} of shape {array.shape}; expected floats of "
                    f"shape {shape_texts[group]}"
                )
    for key in ("tetrahedra", "surface", "surface_nodes"):
        if arrays[key].min() < 0 or arrays[key].max() >= sizes["n"]:
            raise ValueError(f"{key} contains nodes that do not exist")
    if not (np.diff(arrays["t_s"]) > 0).all() or not np.isclose(np.linalg.norm(arrays["up"]), 1.0):
        raise ValueError("t_s does not increase, or up is not a direction")


def read_run(folder: str | Path) -> tuple[Result, list[MotionRecord]]:
    """Return the result and the motion of all experiments, as stored in a run folder.

    The fitted experiments come first, then those for validation that could be simulated.

    Raises
    ------
    InputError
        If it is not a run folder, or a damaged one.
    """
    run = Path(folder)
    result = Result.read(folder)
    rolled = result.rollout.experiments
    predicted = [n for n, r in rolled.items() if not r.fitted and r.failed is None]
    with damaged_run_refused(run):
        arrays = read_arrays(run)
        names = [*result.fit.experiments, *predicted]
        return result, [MotionRecord.from_arrays(name, arrays) for name in names]


def run_headline(result: Result) -> str:
    """Return Young's moduli and bending stiffnesses of a result, of regions too, each with its
    combined standard uncertainty if known, and the verdict, as one line of text; the verdict alone
    if there are none of them.
    """
    sentences = []
    for name, each in result.estimates.items():
        if without_region(name) not in ("young_pa", BENDING.name):
            continue
        deviation = each.combined_std_error
        bar = f" ± {two_digits(deviation)}" if deviation else ""
        value = rounded(each.value, deviation)
        sentences.append(f"{symbol_of(name)} = {value}{bar} {unit_of(name)}")
    return "; ".join([*sentences, f"verdict: {result.trust.verdict}"])


def read_arrays(run: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of a run folder by name.

    Raises
    ------
    InputError
        If the folder has no file of arrays, or this is a link to elsewhere or no regular file.
    ValueError
        If the file is damaged.
    """
    file = run / ARRAYS_FILE
    require_own(file)
    if not file.is_file():
        raise InputError(f"this is not a run folder: it has no {ARRAYS_FILE}", run)
    try:
        with np.load(file) as stored:
            return dict(stored)
    except OSError as error:  # what NumPy says of a file that is none of its own
        raise ValueError(error) from error


def damaged_run_refused(run: Path) -> AbstractContextManager[None]:
    """Return a context that turns errors from damaged files of a run into an `InputError` that
    names the files; an `InputError` itself passes.
    """
    return damage_refused(run, f"{RESULT_FILE} or {ARRAYS_FILE}", remedy="solve the problem again")


def _bench_travel(experiment: Experiment) -> Array | None:
    """Return the displacement (T, 3) [m] of the grasp or obstacle that moves farthest, of the whole
    specimen; None if no force is measured, anything turns, or the displacement is on no line.
    """
    if experiment.specimen or not experiment.wrenches:
        return None
    travels = [np.zeros((len(experiment.t_s), 3))]
    for grasp in experiment.grasps:
        rotations, shifts = grasp.poses.at(experiment.t_s)
        if not np.allclose(rotations, np.eye(3), atol=1e-6):
            return None
        travels.append(shifts / grasp.displacement_scale)
    farthest = max(travels, key=lambda travel: float(np.ptp(travel, axis=0).max()))
    for travel in (farthest, farthest - farthest[0]):
        sizes = np.linalg.svd(travel, compute_uv=False)
        if len(sizes) == 1 or sizes[1] <= LINE_TOLERANCE * sizes[0]:
            return travel if np.ptp(travel, axis=0).max() > 0 else None
    return None
