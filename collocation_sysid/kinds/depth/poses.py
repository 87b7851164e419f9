"""Misspecification of depth cameras: hypotheses about pose, frame and units of a camera that sees
hardly anything of the body.

The surface of the body in its grasps should have measured points nearby. If hardly any of it has,
common mistakes are corrected, first one and then two at a time, to find which would explain that.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial, reduce
from itertools import chain, combinations, product

import numpy as np
from scipy.spatial import KDTree

from ...common.array_types import Array
from ...errors import InputError
from ...program.depth.camera_alignment import thinned
from ...program.depth.surface_correspondences import initial_gate_m
from ...program.depth.visible_surface import VisibleSurface
from ...recording.depth_camera import Depth, points_from_image
from ...recording.experiment import Experiment
from ...statistics.hypothesis import Hypothesis

# Share of the surface with points nearby below which the body is hardly visible.
HARDLY = 0.1
# Share from which on it is well visible.
WELL = 0.5
# Descriptions whose share is smaller than the best by less than this are not distinguishable,
# because the undeformed body is compared with points of the deformed one.
EQUIVALENT_MISFIT = 0.35
# The axes of a camera in frames of other conventions: right, down and ahead in columns.
FRAMES = {
    "x to the right, y up, z backwards": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
    "x to the left, y up, z forward": [[-1, 0, 0], [0, -1, 0], [0, 0, 1]],
    "x forward, y to the left, z up": [[0, 0, 1], [-1, 0, 0], [0, -1, 0]],
    "x to the left, y down, z backwards": [[-1, 0, 0], [0, 1, 0], [0, 0, -1]],
}
EXPECTED = "state the pose of a frame with x to the right, y down, z forward"
# Factor between metres and millimetres, the most frequent wrong unit of a pose.
MILLI = 1e-3
# Smallest visible share of the body that counts, which limits the strength of a hypothesis.
SMALLEST_SHARE = 1e-3
# Largest power of ten of wrong units that are tried.
LARGEST_POWER = 4
# Clouds with fewer points are too small to cover the body, for instance because thinning in the
# wrong unit left few.
COLLAPSED = 50


@dataclass(frozen=True)
class CameraDescription:
    """Pose and units of a camera."""

    carrier: Array  # (4, 4): motion of what carries the camera, to the world
    pose: Array  # (4, 4): motion of the camera's frame on its carrier
    factor: float = 1.0  # factor of the measured points


def _scaled(seeing: CameraDescription, factor: float) -> CameraDescription:
    pose = seeing.pose.copy()
    pose[:3, 3] *= factor
    return replace(seeing, pose=pose)


def _rotated(seeing: CameraDescription, rotation: list[list[int]]) -> CameraDescription:
    pose = seeing.pose.copy()
    pose[:3, :3] = pose[:3, :3] @ np.array(rotation, dtype=float)
    return replace(seeing, pose=pose)


def _with_transposed_rotation(seeing: CameraDescription) -> CameraDescription:
    pose = seeing.pose.copy()
    pose[:3, :3] = pose[:3, :3].T
    return replace(seeing, pose=pose)


def _with_factor(seeing: CameraDescription, factor: float) -> CameraDescription:
    return replace(seeing, factor=factor)


Undo = Callable[[CameraDescription], CameraDescription]
# What may be wrong, as its sentence has it, and how it is undone. Of one kind only one can be so;
# likelier kinds come first.
MISTAKES: tuple[dict[str, Undo], ...] = (
    {
        "camera.pose were inverted (state the transform from the camera's frame to the world)": (
            lambda s: replace(s, pose=np.linalg.inv(s.pose))
        )
    },
    {
        "camera.poses were inverted (state the transforms from the camera's carrier to the "
        "world)": (lambda s: replace(s, carrier=np.linalg.inv(s.carrier)))
    },
    {
        f"camera.pose were of a frame with {axes} ({EXPECTED})": partial(_rotated, rotation=turn)
        for axes, turn in FRAMES.items()
    },
    {
        "its points were in mm (state count_m or length_unit)": (
            lambda s: replace(s, factor=MILLI)
        ),
        "its points were larger by 1000 (state count_m or length_unit)": (
            lambda s: replace(s, factor=1 / MILLI)
        ),
    },
    {
        "camera.pose had a transposed rotation (state its rotation row by row)": (
            _with_transposed_rotation
        )
    },
    {"camera.pose were in mm (state it in m)": partial(_scaled, factor=MILLI)},
)

# Wrong units by other powers of ten than a thousand: looked for alone, as they are rare.
POWERS: dict[str, Undo] = {
    f"its points were {10.0**power:g} times as far away (state count_m or length_unit)": partial(
        _with_factor, factor=10.0**power
    )
    for power in range(-LARGEST_POWER, LARGEST_POWER + 1)
    if abs(power) not in (0, 3)
}


def require_depth_units(experiment: Experiment) -> None:
    """Raise `InputError` if the unit of a depth camera's points is wrong by a power of ten.

    That is the case if hardly any of the body has points nearby, and most of it would have if all
    distances were a power of ten larger or smaller.

    Notes
    -----
    Hardly any is a share below `HARDLY` of the surface facing the camera, most a share of at least
    `WELL` (`HARDLY` for clouds of few points); factors up to 10 to the power `LARGEST_POWER` are
    tried.
    """
    for depth in experiment.depths:
        view = _CameraTrial(experiment, depth)
        if view.visible_share(view.declared) >= HARDLY:
            continue
        factors = [10.0**k for k in range(-LARGEST_POWER, LARGEST_POWER + 1) if k]
        shares = {
            factor: view.visible_share(_with_factor(view.declared, factor)) for factor in factors
        }
        factor = max(factors, key=lambda each: shares[each])
        if shares[factor] < (HARDLY if view.collapsed else WELL):
            continue
        raise InputError(
            f"the points of the depth camera '{depth.name}' of '{experiment.name}' are "
            f"{view.points_m:.3g} m away (median), the body {view.body_m:.3g} m, a factor of "
            f"{1 / factor:g}: their unit is wrong; expected metres: multiply count_m by "
            f"{factor:g} (of integer images such as .png, 0.001 if not stated; an .npz has "
            "its own count_m), give depth_m in metres, or state the length_unit of a point "
            "cloud",
            where="experiment.depth",
        )


def camera_hypotheses(experiment: Experiment) -> Iterator[Hypothesis]:
    """Yield one hypothesis for each depth camera of an experiment that sees less than `HARDLY` of
    the body.

    Its code is "camera/likely", with the mistakes (one, or else two at a time) that explain it in
    the data, or "camera" if none does. The strength is one over the visible share.
    """
    for depth in experiment.depths:
        view = _CameraTrial(experiment, depth)
        here = view.visible_share(view.declared)
        if here >= HARDLY:
            continue
        data = {"percent": 100 * here, "within_mm": 1e3 * view.within_m}
        of = f"'{depth.name}' of '{experiment.name}'"
        code = "camera"
        strength = 1 / max(here, SMALLEST_SHARE)
        if mistakes := view.best_corrections():
            either = "; or if ".join(" and ".join(names) for names in mistakes)
            data = {"mistakes": either}
            code = "camera/likely"
        yield Hypothesis(code, of, data=data, strength=strength)


class _CameraTrial:
    """Test of other descriptions of one camera by the first sample with points."""

    declared: CameraDescription
    within_m: float
    points_m: float
    body_m: float
    collapsed: bool

    def __init__(self, experiment: Experiment, depth: Depth) -> None:
        camera = depth.camera
        self.skin = VisibleSurface.from_body(experiment.body, depth)
        self.pinhole = camera.matrix is not None
        self.shape_m = self.skin.initial_positions_m(experiment, depth)
        points_m = depth.points_m[depth.first_sample_with_points]
        image_m = depth.images_m[depth.first_sample_with_points] if len(depth.images_m) else None
        if len(points_m) < COLLAPSED and image_m is not None:
            points_m = points_from_image(image_m, camera)
        self.tree = KDTree(thinned(points_m))
        self.collapsed = len(points_m) < COLLAPSED
        carrier = np.eye(4)
        if camera.poses is not None:
            rotations, translations = camera.poses.at(
                depth.sample_times_s[[depth.first_sample_with_points]]
            )
            carrier[:3, :3] = rotations[0]
            carrier[:3, 3] = translations[0]
        self.declared = CameraDescription(carrier, camera.pose)
        self.within_m = initial_gate_m(self.shape_m)
        eye_m = (carrier @ camera.pose)[:3, 3]
        self.points_m = float(np.median(np.linalg.norm(points_m, axis=1)))
        self.body_m = float(np.median(np.linalg.norm(self.shape_m - eye_m, axis=1)))

    def visible_share(self, seeing: CameraDescription) -> float:
        """Return the share, from 0 to 1, of the surface facing the camera that has points of the
        first sample with points within `within_m`, for a description of the camera; 0 if nothing
        faces it. For a camera without a matrix the whole visible surface counts as facing.
        """
        motion = seeing.carrier @ seeing.pose
        turn = motion[:3, :3]
        eye_m = motion[:3, 3]
        is_facing = self.skin.is_facing(self.shape_m, eye_m if self.pinhole else None)
        if not is_facing.any():
            return 0.0
        middles_m = self.shape_m[self.skin.plane_triangles[is_facing]].mean(axis=1)
        in_camera = (middles_m - eye_m) @ turn / seeing.factor
        nearest, _ = self.tree.query(in_camera, distance_upper_bound=self.within_m / seeing.factor)
        return float(np.isfinite(nearest).mean())

    def best_corrections(self) -> list[tuple[str, ...]]:
        """All that are about as good are returned: a body may look alike from two sides."""
        for count in (1, 2):
            alone = (POWERS,) if count == 1 else ()
            shares = {
                names: self.visible_share(self._corrected(names))
                for kinds in combinations((*MISTAKES, *alone), count)
                for names in product(*kinds)
            }
            least = max(WELL, max(shares.values()) - EQUIVALENT_MISFIT)
            if well := [names for names in shares if shares[names] >= least]:
                return sorted(well, key=lambda names: -shares[names])
        return []

    def _corrected(self, mistakes: tuple[str, ...]) -> CameraDescription:
        undo = dict(chain.from_iterable(kind.items() for kind in (*MISTAKES, POWERS)))
        return reduce(lambda seeing, name: undo[name](seeing), mistakes, self.declared)
