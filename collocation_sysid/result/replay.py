"""One experiment of a run as it is looked at: shapes and markers at its samples.

Pictures, animations and the 3-D view need nothing else, so that they can be made again from the
arrays of a run folder.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import MISSING, dataclass, field, fields
from itertools import count, takewhile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..errors import InputError
from ..fem.constants import bare, symbol_of
from ..fem.elements import EDGES
from ..files import RESULT_FILE, damage_refused, require_own
from ..recording.clock import TIME_TOLERANCE_S
from ..recording.experiment import Experiment
from ..runs.result import Result

ARRAYS_FILE = "trajectory.npz"
# What stands before the number of a wrench, and the names of readings of one's own and of fields.
WRENCH, GROUPS = "wrench_", {"readings": "reading_", "fields": "field_", "seen": "seen_"}
# What stands before the name of a reading whose unit it is.
UNIT = "unit_"
# Of the body, and so the same for all experiments of a run.
OF_BODY = ("undeformed_m", "tetrahedra", "surface", "surface_parts", "surface_nodes", "part_names")
# Kind and axes of each array: n nodes, E elements, F triangles, T samples, M markers, k modes,
# p and o points of lines.
LAYOUT = {
    "undeformed_m": ("f", "n3"),
    "tetrahedra": ("iu", "E4"),
    "surface": ("iu", "F3"),
    "surface_parts": ("iu", "F"),
    "surface_nodes": ("iu", "Fs"),
    "t_s": ("f", "T"),
    "held": ("b", "Tn"),
    "up": ("f", "3"),
    "marker_places_m": ("f", "M3"),
    "given_places_m": ("f", "M3"),
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
}
# A plane is shown so many times as long as the body.
LONGER = 1.4
# Arrays that may hold NaN or infinity, and the largest length, time or frequency of any.
GAPS = LAYOUT.keys() - {"undeformed_m", "t_s", "up", "marker_places_m"}
LARGEST = 1e100


@dataclass(frozen=True, eq=False)
class Replay:
    """Measured, fitted and simulated motion of an experiment; T samples, n nodes, M markers.

    Attributes
    ----------
    name : str
    t_s : (T,)
    undeformed_m : (n, 3)
    tetrahedra : (E, 4) corners of the elements
    surface : (F, 3) boundary triangles, counter-clockwise when seen from outside
    surface_parts : (F,) number of the part of the body that each belongs to
    surface_nodes : (F, 3) or (F, 6) nodes of each triangle, those on its sides besides its corners
    part_names : (P,) str, "" for what no region claims
    held : (T, n) bool, which nodes are grasped along some axis
    up : (3,) unit vector against gravity; z where there is none
    marker_names : (M,) str
    marker_places_m : (M, 3) where the markers sit on the undeformed body, as found
    given_places_m : (M, 3) the places given, NaN where there was none
    measured_m : (T, M, 3) NaN where missing
    positions_m, markers_m : (T, n, 3) and (T, M, 3) as fitted, or None for validation
    rolled_out_positions_m, rolled_out_m : the same of the simulation with the answer, or None
    natural_hz : (k,) natural frequencies with the answer, ascending
    wrenches : sequence of (S, 19)
        Of each sensor of a grasp: time, and six components as measured, as fitted and as rolled
        out, NaN where there are none.
    readings : mapping of name to (S, 1 + 3m)
        The same of readings of one's own, of m numbers each.
    static : bool
        Whether every sample is an equilibrium of its own.
    tendons_m : (p, 3) points of the tendons on the undeformed body, a row of NaN after each
    reading_units : mapping of name to str
        Units of the readings that state one.
    obstacles_m : (T, o, 3) points of the obstacles' outlines, NaN after each line
    fields : mapping of name to (E, 4)
        Constants that differ from place to place: value, the ends of its interval, and its
        deviation over the prior's, NaN where another region is.
    seen : mapping of name to (k, 8)
        Of each depth camera points: when they were seen [s], u, v and depth [m] in the image, how
        far behind the surface [m], NaN of those that do not count, and where in the world [m]. Of
        some samples then when, u and v of outlines of faces, each ended by NaN, and NaN else.
    gaps_m, pressures_pa : (T, F) of the surface as fitted, or simulated, where there are obstacles
    """

    name: str
    t_s: Array
    undeformed_m: Array
    tetrahedra: NDArray[np.integer]
    surface: NDArray[np.integer]
    surface_parts: NDArray[np.integer]
    surface_nodes: NDArray[np.integer]
    part_names: Sequence[str]
    held: NDArray[np.bool_]
    up: Array
    marker_names: Sequence[str]
    marker_places_m: Array
    given_places_m: Array
    measured_m: Array
    positions_m: Array | None = None
    markers_m: Array | None = None
    rolled_out_positions_m: Array | None = None
    rolled_out_m: Array | None = None
    natural_hz: Array | None = None
    wrenches: Sequence[Array] = ()
    static: bool = False
    tendons_m: Array | None = None
    readings: Mapping[str, Array] = field(default_factory=dict)
    obstacles_m: Array | None = None
    gaps_m: Array | None = None
    pressures_pa: Array | None = None
    fields: Mapping[str, Array] = field(default_factory=dict)
    seen: Mapping[str, Array] = field(default_factory=dict)
    reading_units: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        experiment: Experiment,
        fitted: tuple[Array, Array] | None = None,
        rolled_out: tuple[Array, Array] | None = None,
        natural_hz: Array | None = None,
        places_m: Array | None = None,
        wrenches: Sequence[Array] = (),
        readings: Mapping[str, Array] | None = None,
        touched: tuple[Array, Array] | None = None,
    ) -> Replay:
        """Gather an experiment with (positions, markers) as fitted, and as simulated.

        Its markers are at `places_m` (M, 3), where they were estimated; gaps and pressures of its
        surface are `touched`.
        """
        body, markers = experiment.body, experiment.markers
        given_m, nodes_m = markers.observe(body.nodes_m), body.nodes.points_m
        # Frames of obstacles are left out: experiments of a run have one body, but not as many.
        fitted, rolled_out = (
            each and (each[0][:, : len(nodes_m)], each[1]) for each in (fitted, rolled_out)
        )
        return cls(
            experiment.name,
            experiment.t_s,
            nodes_m,
            body.mesh.tetrahedra,
            body.mesh.surface,
            body.part_of_cells[body.mesh.surface_cells],
            nodes_of_faces(body.cells[body.mesh.surface_cells], body.mesh.surface),
            [part.name for part in body.parts],
            np.asarray(experiment.held(experiment.t_s).any(axis=2))[:, : len(nodes_m)],
            experiment.up,
            markers.names,
            given_m if places_m is None else places_m,
            np.where(markers.located[:, None], given_m, np.nan),
            markers.positions_m,
            *(fitted or (None, None)),
            *(rolled_out or (None, None)),
            natural_hz,
            wrenches,
            experiment.static,
            _apart([tendon.points_m for tendon in experiment.tendons]),
            readings or {},
            _outlines(experiment),
            *(touched or (None, None)),
            reading_units={gauge.name: gauge.unit for gauge in experiment.readings if gauge.unit},
        )

    @property
    def shapes_m(self) -> Array | None:
        """(T, n, 3) positions to show where there is room for one: fitted, else simulated."""
        return self.positions_m if self.positions_m is not None else self.rolled_out_positions_m

    def seen_m(self, t: int) -> Array:
        """(P, 3) points that depth cameras saw nearest to sample `t`, within half a step of it."""
        near_s = float(np.diff(self.t_s).max(initial=0.0)) / 2 + TIME_TOLERANCE_S
        found = [np.zeros((0, 3))]
        for rows in self.seen.values():
            points = rows[np.isfinite(rows[:, 4])]
            times = np.unique(points[:, 0])
            apart_s = np.abs(times - self.t_s[t])
            if apart_s.min(initial=np.inf) <= near_s:
                found.append(points[points[:, 0] == times[apart_s.argmin()], 5:])
        return np.concatenate(found)

    @property
    def has_shapes(self) -> bool:
        """Whether there is a sample with all of them."""
        shapes_m = self.shapes_m
        return shapes_m is not None and bool(np.isfinite(shapes_m).all(axis=(1, 2)).any())

    def arrays(self, prefix: str = "") -> dict[str, Array]:
        """Arrays for a file; those of the body without the prefix, and some as single numbers."""
        stored: dict[str, Any] = {key: getattr(self, key) for key in LAYOUT}
        stored |= {
            k: stored[k].astype(np.int32) for k, (kinds, _) in LAYOUT.items() if "i" in kinds
        }
        if self.rolled_out_positions_m is not None:
            stored["rolled_out_positions_m"] = self.rolled_out_positions_m.astype(np.float32)
        stored |= {key: np.array(getattr(self, key)) for key in ("part_names", "marker_names")}
        stored["static"] = np.array(True) if self.static else None
        stored["residuals_m"] = None if self.markers_m is None else self.markers_m - self.measured_m
        stored |= {f"{WRENCH}{k}": values for k, values in enumerate(self.wrenches, start=1)}
        for group, front in GROUPS.items():
            stored |= {f"{front}{name}": values for name, values in getattr(self, group).items()}
        stored |= {f"{UNIT}{n}": np.array(unit) for n, unit in self.reading_units.items()}
        there = {key: value for key, value in stored.items() if value is not None}
        return {key if key in OF_BODY else prefix + key: value for key, value in there.items()}

    @classmethod
    def from_arrays(cls, name: str, arrays: Mapping[str, Any]) -> Replay:
        """Take an experiment out of a run's arrays.

        Raises
        ------
        KeyError
            If an array is missing.
        """
        prefix = f"{name}/" if f"{name}/t_s" in arrays else ""
        own = {key: key if key in OF_BODY else prefix + key for key in LAYOUT}
        needed = {each.name for each in fields(cls) if each.default is MISSING}
        stored: dict[str, Any] = {
            key: arrays[at] if key in needed else arrays.get(at) for key, at in own.items()
        }
        keys = (f"{prefix}{WRENCH}{k}" for k in count(1))
        stored["wrenches"] = [arrays[key] for key in takewhile(arrays.__contains__, keys)]
        for group, front in GROUPS.items():
            said = f"{prefix}{front}"
            stored[group] = {k.removeprefix(said): arrays[k] for k in arrays if k.startswith(said)}
        stored["reading_units"] = {
            name: str(arrays[at])
            for name in stored["readings"]
            if (at := f"{prefix}{UNIT}{name}") in arrays
        }
        stored["static"] = bool(arrays.get(f"{prefix}static", False))
        _require_shapes(stored)
        stored["marker_names"] = [str(marker) for marker in arrays[f"{prefix}marker_names"]]
        stored["part_names"] = [str(part) for part in arrays["part_names"]]
        numbers = stored["surface_parts"]
        if len(stored["marker_names"]) != len(stored["marker_places_m"]):
            raise ValueError(f"{len(stored['marker_names'])} marker_names")
        if numbers.min() < 0 or numbers.max() >= len(stored["part_names"]):
            raise ValueError("surface_parts names parts that are not there")
        return cls(name=name, **stored)


def _outlines(experiment: Experiment) -> Array | None:
    """(T, o, 3) outlines of the obstacles where they are stated; None where there are none."""
    body, found = experiment.body.nodes.points_m, []
    for obstacle in experiment.obstacles:
        low, high = body.min(axis=0), body.max(axis=0)
        size_m = LONGER * float((high - low).max())
        outline = _apart(obstacle.shape.outline((low + high) / 2, size_m))
        assert outline is not None
        turns, shifts = obstacle.poses.at(experiment.t_s)
        found.append(np.einsum("tij,kj->tki", turns, outline) + shifts[:, None])
    return np.concatenate(found, axis=1) if found else None


def _apart(lines_m: Sequence[Array]) -> Array | None:
    """Polylines (P, 3) in one (p, 3), a row of NaN after each; None where there are none."""
    if not lines_m:
        return None
    return np.concatenate([np.vstack([line, np.full(3, np.nan)]) for line in lines_m])


def nodes_of_faces(cells: NDArray[np.integer], faces: NDArray[np.integer]) -> NDArray[np.integer]:
    """Corners of each face (F, 3), and of quadratic cells (F, 10) the nodes on its sides too."""
    if cells.shape[1] != 10:
        return faces
    ends = cells[:, np.array(EDGES)]  # (F, 6, 2)
    on_face = (ends[..., None] == faces[:, None, None]).any(axis=3).all(axis=2)
    return np.hstack([faces, cells[:, 4:][on_face].reshape(len(faces), 3)])


def _require_shapes(arrays: Mapping[str, Any]) -> None:
    """Refuse arrays whose sizes do not go together, or that hold what pictures cannot show."""
    sizes: dict[str, int] = {}
    for key, (kinds, letters) in LAYOUT.items():
        if (array := arrays.get(key)) is None:
            continue
        wanted = [int(x) if x.isdigit() else sizes.get(x) for x in letters]
        here = array.shape
        empty = any(not size for x, size in zip(letters, here, strict=False) if x not in "Mk")
        if array.dtype.kind not in kinds or array.ndim != len(letters) or empty:
            raise ValueError(f"{key} is {array.dtype} of shape {here}")
        if any(size not in (None, found) for size, found in zip(wanted, here, strict=True)):
            raise ValueError(f"{key} has shape {here}, which does not go with the others")
        sizes |= {x: size for x, size in zip(letters, here, strict=True) if not x.isdigit()}
        if kinds == "f" and not (key in GAPS or np.isfinite(array).all()):
            raise ValueError(f"{key} holds numbers that are not finite")
        if kinds == "f" and float(np.nanmax(np.abs(array), initial=0.0)) > LARGEST:
            raise ValueError(f"{key} holds numbers above {LARGEST:g}")
    elements = len(arrays["tetrahedra"])
    fits = {
        "readings": lambda shape: len(shape) == 2 and shape[0] and shape[1] % 3 == 1 < shape[1],
        "fields": lambda shape: shape == (elements, 4),
        "seen": lambda shape: shape[1:] == (8,),
    }
    for group, front in GROUPS.items():
        for name, said in arrays[group].items():
            if said.dtype.kind != "f" or not fits[group](said.shape):
                raise ValueError(f"{front}{name} is {said.dtype} of shape {said.shape}")
    for key in ("tetrahedra", "surface", "surface_nodes"):
        if arrays[key].min() < 0 or arrays[key].max() >= sizes["n"]:
            raise ValueError(f"{key} names nodes that are not there")
    if not (np.diff(arrays["t_s"]) > 0).all() or not np.isclose(np.linalg.norm(arrays["up"]), 1.0):
        raise ValueError("t_s does not increase, or up is no direction")


def read_run(folder: str | Path) -> tuple[Result, list[Replay]]:
    """Read the content of result.json, and all experiments, from a run folder.

    The fitted experiments are first, then those for validation that could be simulated.

    Raises
    ------
    InputError
        If it is not a run folder, or one that is damaged.
    """
    run, result = Path(folder), Result.read(folder)
    rolled = result.rollout.experiments
    predicted = [n for n, r in rolled.items() if not r.fitted and r.failed is None]
    with reading_run(run):
        arrays = read_arrays(run)
        names = [*result.fit.experiments, *predicted]
        return result, [Replay.from_arrays(name, arrays) for name in names]


def headline(result: Result) -> str:
    """Return Young's moduli with their combined uncertainties, and the verdict, in one line."""
    moduli = {symbol_of(n): each for n, each in result.values.items() if bare(n) == "young_pa"}
    said = []
    for name, each in moduli.items():
        deviation = each.combined_std_error
        bar = f" ± {float(format(deviation, '.2g')):g}" if deviation else ""
        said.append(f"{name} = {each.value:.5g}{bar} Pa")
    return "; ".join([*said, f"verdict: {result.trust.verdict}"])


def read_arrays(run: Path) -> dict[str, NDArray[Any]]:
    """The arrays of a run folder.

    Raises
    ------
    InputError
        If there are none.
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


def reading_run(run: Path) -> AbstractContextManager[None]:
    """Within this, whatever the files of a run make go wrong is a refusal of the run."""
    return damage_refused(run, f"{RESULT_FILE} or {ARRAYS_FILE}", "solve the problem again")
