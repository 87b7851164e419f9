"""Facts of the recordings, which `check` and `solve` state before any search or simulation.

Each fact is a comparison of milliseconds: a function of an experiment in `FACTS`, which raises an
`InputError` if nothing can be solved.

The extent of a grasp: a box that ends between two layers of nodes holds only the nodes inside. If
the fingers end where the box does, the modelled body is free over a longer part than the real one,
and its stiffness is estimated too high: a cantilever's deflection grows with the third to fourth
power of its length.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import product

import numpy as np

from ..common.array_types import Array
from ..errors import InputError, located
from ..features.measurements import lost_samples, titles
from ..fem.meshes.checks import boundary_of, connected_parts
from ..fem.meshes.mesh import TetMesh
from ..fem.meshes.selection import Box, rows_of_faces
from ..kinds.image_tracks.tracks import ImageTracks
from ..problem import Problem
from ..recording.experiment import Experiment
from ..recording.grasp import Grasp, prescribed_nodes
from ..recording.markers import Markers
from ..recording.specimen_files import specimen_strains
from ..statistics.concerns import Concern
from ..statistics.plausibility import copied_measurements, size_and_density_hypotheses
from ..statistics.scale_identifiability import scale_concerns, static_concerns

Fact = Concern | str

# Range of nine tenths of the positions, in σ, from which on a point moves (noise has 3.3), with the
# standard deviation in the first half of the time, in σ, and its fewest samples.
MOVING_SIGMAS = 6.0
LEAST_EARLY_SIGMAS = 1.5
FEWEST_AT_REST = 8
# Share of the largest strain and load up to which they stand still.
LEAST_RISE = 0.02
# Displacement of the grasps over the size of the body up to which images do not show it.
UNSEEN = 1e-4
# Median deviation of steps from the usual one, as a share of it, up to which samples are evenly
# spaced apart from gaps.
EVEN = 0.25
# Distance between the end of the box and the outermost held nodes, as a share of the free length,
# from which it is reported: it changes the stiffness in bending by 1.5 to 2 %.
LARGEST_SHARE = 0.005
# Extent of the held nodes along an axis, as a share of the body's, below which they are one layer,
# which a box with some margin selects on purpose.
LAYER_SHARE = 1e-6


def loose_parts(experiment: Experiment) -> tuple[Fact, ...]:
    """Refuse parts of a mesh that no grasp holds, unless the body is free, or obstacles or tendons may
    hold them.
    """
    body = experiment.body
    if experiment.obstacles or experiment.tendons or not experiment.body_grasps:
        return ()
    label, parts = connected_parts(body.nodes_m, body.cells)
    held = label[prescribed_nodes(experiment.body_grasps)]
    if loose := len(np.setdiff1d(label[np.unique(body.cells)], held)):
        raise InputError(
            f"the mesh {parts}; no grasp of '{experiment.name}' holds {loose} of these "
            "parts: connect them with a part that is held, or remove them from the mesh",
            where="object",
        )
    return ()


def gaps(experiment: Experiment) -> Iterator[Fact]:
    """Note samples of poses and measurements that are missing among evenly spaced ones."""
    if experiment.is_static or experiment.specimen is not None:
        return
    measured = experiment.measurements
    grasps = enumerate(experiment.grasps, start=1)
    times_s = {f"the poses of grasp {k}": grasp.poses.t_s for k, grasp in grasps}
    times_s |= dict(zip(titles(measured), (e.sample_times_s for e in measured), strict=True))
    first_s, last_s = experiment.t_s[[0, -1]]
    for what, t_s in times_s.items():
        steps_s = np.diff(t_s[(t_s >= first_s) & (t_s <= last_s)])
        if len(steps_s) == 0:
            continue
        ratios = steps_s / np.median(steps_s)
        lost = np.rint(ratios).astype(int) - 1
        if lost.max() > 0 and np.median(abs(ratios - 1)) < EVEN:
            yield (
                f"experiment '{experiment.name}': {lost.sum()} samples of {what} are missing; the "
                f"longest gap lasts {steps_s.max():.3g} s"
            )


def motion_at_rest(experiment: Experiment) -> Iterator[Fact]:
    """Points that move while all grasps and obstacles stand still, although the body starts at rest
    and no load drives it: also in the first half of that time, in which they do not move only
    because clocks differ.
    """
    driven = experiment.forces or experiment.tendons or experiment.pressures
    is_changing = driven or np.isfinite(experiment.loaded_since_s)
    if experiment.start != "equilibrium" or experiment.is_static or is_changing:
        return
    size_m = float(np.linalg.norm(np.ptp(experiment.body.mesh.bounds_m, axis=0)))
    for measurement in experiment.measurements:
        is_image = isinstance(measurement, ImageTracks)
        if not is_image and not isinstance(measurement, Markers):
            continue
        sigma = float(np.median(measurement.value_sigmas))
        still_s = _still_until_s(experiment, UNSEEN * size_m if is_image else sigma)
        t_s = measurement.sample_times_s
        tracks = measurement.measured_values.reshape(len(t_s), len(measurement.names), -1)
        moved = []
        for k, name in enumerate(measurement.names):
            track = tracks[:, k]
            known = np.isfinite(track).all(axis=1) & (t_s < still_s)
            early = track[known & (t_s < (t_s[0] + still_s) / 2)]
            if len(early) < FEWEST_AT_REST:
                continue
            noise = np.maximum(sigma, np.median(abs(np.diff(early, axis=0)), axis=0))
            low, high = np.quantile(track[known], [0.05, 0.95], axis=0)
            is_early = early.std(axis=0) > LEAST_EARLY_SIGMAS * noise
            if (is_early & (high - low > MOVING_SIGMAS * noise)).any():
                moved.append((float((high - low).max()), name))
        if moved:
            by, name = max(moved)
            yield Concern(
                "description/not-at-rest",
                data={
                    "point": name,
                    "experiment": experiment.name,
                    "by": f"{by:.2g} px" if is_image else f"{1e3 * by:.2g} mm",
                    "sigmas": by / sigma,
                    "noise": measurement.noise_key,
                    "still_s": still_s - t_s[0],
                },
            )


def late_load(experiment: Experiment) -> tuple[Fact, ...]:
    """Refuse a load of a specimen with memory that rises while the strain stands still at its first
    maximum, by more than noise: stresses relax.
    """
    if experiment.specimen is None or not experiment.body.has_memory:
        return ()
    size = abs(specimen_strains(experiment)[0])
    load_pa = abs(experiment.readings[0].measured_values[:, 0])
    first, last = int(size.argmax()), int(np.nanargmax(load_pa))
    noise_pa = experiment.readings[0].value_sigmas.max()
    is_held = last > first and np.ptp(size[first : last + 1]) < LEAST_RISE * size.max()
    rise_pa = load_pa[last] - load_pa[first]
    if is_held and rise_pa > max(MOVING_SIGMAS * noise_pa, LEAST_RISE * load_pa[last]):
        late_s = experiment.t_s[last] - experiment.t_s[first]
        raise InputError(
            f"experiment '{experiment.name}': the load rises by {rise_pa / load_pa[last]:.0%} of its "
            f"largest value while the strain is held, for {late_s:.3g} s, but stresses relax: correct the "
            "delay of the load, or the times at which the strain was reached"
        )
    return ()


def _still_until_s(experiment: Experiment, limit_m: float) -> float:
    """Return the first time at which a grasp or an obstacle would move a corner of the body by more
    than a limit, or begins or ends to act [s]; the end of the recording if none does.
    """
    t_s = experiment.t_s
    corners_m = np.array(list(product(*experiment.body.mesh.bounds_m.T)))
    has_moved = np.zeros(len(t_s), dtype=bool)
    for grasp in experiment.grasps:
        at_s = np.clip(t_s, *grasp.poses.t_s[[0, -1]])
        places_m: Array = grasp.poses.moved_positions(corners_m, at_s)
        is_active = grasp.is_active(t_s)
        has_moved |= np.linalg.norm(places_m - places_m[0], axis=2).max(axis=1) > limit_m
        has_moved |= is_active != is_active[0]
    return float(t_s[has_moved.argmax()] if has_moved.any() else t_s[-1])


def grasp_gaps(experiment: Experiment, grasp: Grasp) -> Iterator[tuple[str, float, float]]:
    """Yield the gaps of a grasp that exceed `LARGEST_SHARE` of the free length: axis, distance [m] of
    the end of the held part from the face of the box, and length [m] of the free part of the body
    beyond it. The part ends where elements of which all corners are held end, on average.

    None for grasps that are not selected by a box, that hold some axes only (platens and planes of
    symmetry), or whose nodes are one layer along the axis, and for faces of the box beyond which
    there is no body.
    """
    box = grasp.selection
    if not isinstance(box, Box) or len(grasp.axes) < 3:
        return
    points_m = experiment.body.nodes.points_m
    centres_m, areas_m2 = _ends_of_held(experiment.body.mesh, grasp)
    for k, axis in enumerate("xyz"):
        along_m = points_m[:, k]
        held_m = along_m[grasp.nodes]
        if np.ptp(held_m) <= LAYER_SHARE * np.ptp(along_m):
            continue
        for direction, face_m in ((1, box.high_m[k]), (-1, box.low_m[k])):
            facing_m2 = (direction * areas_m2[:, k]).clip(0)
            if facing_m2.any():
                reach_m = direction * np.average(centres_m[:, k], weights=facing_m2)
            else:
                reach_m = (direction * held_m).max()
            free_m = (direction * along_m).max() - reach_m
            gap_m = direction * face_m - reach_m
            if LARGEST_SHARE * free_m < gap_m < free_m:
                yield axis, float(gap_m), float(free_m)


def _ends_of_held(mesh: TetMesh, grasp: Grasp) -> tuple[Array, Array]:
    """Return centres (F, 3) [m] and areas with normals (F, 3) [m²] of the faces between the elements
    of which all corners are held, and others.
    """
    if not mesh.kind.is_solid:
        return np.zeros((0, 3)), np.zeros((0, 3))
    is_held = np.isin(mesh.tetrahedra, grasp.nodes).all(axis=1)
    faces, _ = boundary_of(mesh.tetrahedra[is_held])
    triangles_m = mesh.points_m[faces[rows_of_faces(faces, mesh.surface) < 0]]
    edges_m = np.diff(triangles_m, axis=1)
    return triangles_m.mean(axis=1), np.cross(edges_m[:, 0], edges_m[:, 1]) / 2


def grasp_extent(experiment: Experiment) -> Iterator[Concern]:
    """Yield a concern for each gap of the grasps of a fitted recording of a meshed body, see
    `grasp_gaps`.
    """
    if experiment.validation or experiment.specimen is not None:
        return
    for grasp in experiment.body_grasps:
        for axis, gap_m, free_m in grasp_gaps(experiment, grasp):
            yield Concern(
                "description/grasp-extent",
                data={
                    "experiment": experiment.name,
                    "axis": axis,
                    "gap_mm": 1e3 * gap_m,
                    "free_mm": 1e3 * free_m,
                    "percent": 100 * gap_m / free_m,
                },
            )


FACTS = (loose_parts, late_load, lost_samples, motion_at_rest, gaps)


def facts(problem: Problem) -> list[Fact]:
    """Return the facts about all bodies and recordings of a problem: concerns, and notes as text.

    In recordings that are declared to be simulated the grasp usually is that of the model, so that
    its extent is a note.

    Raises
    ------
    InputError
        For a fact that makes a solve impossible.
    """
    with located(problem.path):
        found = [each for e in problem.experiments for fact in FACTS for each in fact(e)]
        odd = [each for body in problem.bodies for each in size_and_density_hypotheses(body)]
    found += [each.concern("doubtful") for each in odd]
    found += static_concerns(problem.experiments, problem.parameters)
    found += scale_concerns(problem.experiments, problem.parameters)
    found += [each.concern() for each in copied_measurements(problem.experiments)]
    extents = [each for e in problem.experiments for each in grasp_extent(e)]
    return found + (sentences(extents) if problem.is_declared_simulated else extents)


def sentences(known: Iterable[Fact]) -> list[str]:
    """Return facts as text."""
    return [each.message if isinstance(each, Concern) else each for each in known]
