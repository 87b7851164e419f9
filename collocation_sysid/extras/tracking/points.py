"""Points of a body in images: corners, stated points, and centres of markers, followed over time.

Corners and stated points are followed by the pyramidal method of Lucas and Kanade, forwards and
backwards: the likelihood of a sample decreases with the distance by which the way back misses the
point, and a point that misses by more than a limit is lost. In order that errors of single steps do
not add up, the surroundings of each point are then aligned with the first image by an affine
transform (enhanced correlation coefficient). A point that the background leads astray is sought where
its neighbours carry it; while its surroundings do not agree, samples are missing.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...common.array_types import Array, Index
from ...errors import InputError
from .video import Image, grey, opencv

# Window of the method [pixels], levels of its pyramid, and iterations of each level.
WINDOW_PX = 21
LEVELS, FEW_LEVELS = 3, 1
ITERATIONS = 40
# Distance of the way back at which the likelihood has fallen to 1/e [pixels].
HALF_TRUST_PX = 0.5
# Quality of corners relative to the best, and their least distance [pixels].
LEAST_QUALITY = 0.02
LEAST_DISTANCE_PX = 12
# Half size of the surroundings that are aligned with the first image [pixels], least correlation of
# an alignment, and its largest distance from the point that is followed [pixels].
HALF_PATCH_PX = 15
LEAST_CORRELATION = 0.85
FARTHEST_PX = 4.0
# Neighbours whose affine motion carries a point: most, with the point itself, fewest, one more than
# determine the motion, and their largest distance, as the body bends [pixels].
MOST_NEIGHBOURS, FEWEST_NEIGHBOURS, REACH_PX = 7, 4, 150.0


class Loss(NamedTuple):
    """Where a point was lost: seen in no image from there on."""

    name: str
    image: int  # number of the first image without it, from 1
    t_s: float
    pixel: tuple[float, float]  # where it was in the image before
    step_px: float  # how far the points moved between the images before
    has_left: bool  # whether its window reached beyond the image


@dataclass(frozen=True, eq=False)
class Tracks:
    """Tracks of points in images."""

    names: Sequence[str]
    t_s: Array  # (S,): time since the first image
    pixels: Array  # (S, N, 2): (u, v); NaN where missing
    likelihood: Array  # (S, N)
    losses: Sequence[Loss] = ()

    @cached_property
    def sigma_px(self) -> float:
        """Standard error of a coordinate: root mean square deviation of the points from the affine
        motion of their neighbours; 0 without neighbours.
        """
        start, squares = self.pixels[0], []
        for shifts in self.pixels[1:] - start:
            known = np.flatnonzero(np.isfinite(shifts).all(axis=1))
            for k in known.tolist():
                near, weights = _neighbours(start, k, known)
                if len(near):
                    errors = shifts[k] - weights @ shifts[near]
                    squares.append(errors**2 / (1 + weights @ weights))
        return float(np.sqrt(np.mean(squares or 0.0)))

    @classmethod
    def of(
        cls, names: Sequence[str], times: Sequence[float], pixels: Array, trust: Array, size: Array
    ) -> Tracks:
        """Return tracks in images of a size (columns, rows) at times (S,) [s], and where points are
        lost that the last image does not have.
        """
        t_s = np.array(times) - times[0]
        is_seen = np.asarray(np.isfinite(pixels).all(axis=2))
        steps_px = np.linalg.norm(np.diff(pixels, axis=0, prepend=pixels[:1]), axis=2)
        losses = []
        for k in np.flatnonzero(~is_seen[-1]):
            last = int(np.flatnonzero(is_seen[:, k])[-1])
            steps = steps_px[last][np.isfinite(steps_px[last])]
            step_px = float(
                max(np.nan_to_num(steps_px[last, k]), np.median(steps) if len(steps) else 0)
            )
            u, v = pixels[last, k].tolist()
            has_left = min(u, v, *(size - 1 - pixels[last, k])) < WINDOW_PX / 2 + step_px
            at_s = float(t_s[last + 1])
            losses.append(Loss(names[int(k)], last + 2, at_s, (u, v), step_px, bool(has_left)))
        return cls(names, t_s, pixels, trust, sorted(losses, key=lambda each: each.image))


def _neighbours(start: Array, k: int, known: Index) -> tuple[Index, Array]:
    """Return known neighbours of the point k, none if they are too few, and weights with which their
    shifts make that of their affine motion at k.
    """
    offsets = (start[known] - start[k]) / REACH_PX
    distances = np.linalg.norm(offsets, axis=1)
    near = [i for i in np.argsort(distances)[:MOST_NEIGHBOURS] if 0 < distances[i] < 1]
    near *= len(near) >= FEWEST_NEIGHBOURS  # else none
    basis = np.column_stack([offsets[near], np.ones(len(near))])
    return known[near], np.linalg.pinv(basis)[2]


def require_size(image: Image, video: Path) -> None:
    """Raise an `InputError` if images are smaller than the window in which points are followed."""
    height, width = image.shape[:2]
    if min(height, width) < WINDOW_PX:
        raise InputError(
            f"found images of {width} × {height} pixels; expected at least {WINDOW_PX} × {WINDOW_PX}",
            video,
        )


def corners_of(image: Image, mask: Image | None, most: int) -> Array:
    """Return up to `most` corners (N, 2) of an image within a mask, to a part of a pixel."""
    cv2 = opencv()
    plain = grey(image)
    found = cv2.goodFeaturesToTrack(
        plain, min(most, plain.size), LEAST_QUALITY, LEAST_DISTANCE_PX, mask=mask
    )
    if found is None:
        return np.zeros((0, 2))
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, ITERATIONS, 1e-3)
    return cv2.cornerSubPix(plain, found, (5, 5), (-1, -1), stop).reshape(-1, 2)


def stated_points(text: str, option: str) -> tuple[list[str], Array]:
    """Return names and pixels (N, 2) of points stated as "tip=612,388;hook=540,401"; points without
    a name have that of the option and their number.
    """
    names, points = [], []
    for k, part in enumerate(filter(None, text.split(";")), start=1):
        name, _, pixel = part.rpartition("=")
        try:
            u, v = map(float, pixel.split(","))
            if not (np.isfinite(u + v) and part.isprintable()):
                raise ValueError
        except ValueError:
            raise InputError(f"found {part!r}; expected NAME=U,V", where=option) from None
        names.append(name.strip() or f"{option.strip('-')}_{k}")
        points.append((u, v))
    if len({*names}) < len(names):
        raise InputError(f"found {text!r}; expected different names", where=option)
    return names, np.array(points).reshape(-1, 2)


def follow(
    images: Iterable[tuple[float, Image]], names: Sequence[str], start: Array, lost_px: float
) -> Tracks:
    """Follow points (N, 2) of the first image through all images."""
    times, pixels, likelihood = [], [], []
    size = np.zeros(2)
    before: Image | None = None
    patches: list[_Patch] = []
    now, step = start.astype(float), np.zeros(start.shape)
    alive = np.ones(len(start), dtype=bool)
    for t_s, image in images:
        plain = grey(image)
        size = np.array(plain.shape[::-1])
        trust, agrees = np.ones(len(start)), alive
        if before is not None and plain.shape != before.shape:
            raise InputError(
                f"image {len(times) + 1} has another size; expected one size of all images"
            )
        if before is not None:
            last, agrees = now.copy(), np.zeros(len(start), dtype=bool)
            searched, alive = alive, agrees.copy()
            # Coarse levels contain the background: first without them, from the step before.
            for guess, levels in ((last + step, FEW_LEVELS), (last, LEVELS)):
                ahead, missed = _searched(before, plain, last, guess, levels)
                inside = ((ahead >= 0) & (ahead < size)).all(axis=1)
                for k in np.flatnonzero(searched & ~agrees & inside & (missed <= lost_px)):
                    place = patches[k].aligned(plain, ahead[k])
                    if place is None and alive[k]:
                        continue
                    now[k] = ahead[k] if place is None else place
                    alive[k], agrees[k] = True, place is not None
                    trust[k] = np.exp(-missed[k] / HALF_TRUST_PX)
            known = np.flatnonzero(agrees)
            for k in np.flatnonzero(~agrees).tolist():
                near, weights = _neighbours(start, k, known)
                carried = start[k] + weights @ (now - start)[near]
                place = patches[k].aligned(plain, carried) if len(near) else None
                if place is not None and place is not carried:  # not compared beyond the image
                    now[k], alive[k], agrees[k], trust[k] = place, True, True, 1.0
            step = now - last
        else:
            if ((start < 0) | (start > size - 1)).any():
                raise InputError(
                    f"a stated point is outside the first image of {size[0]} × {size[1]} pixels"
                )
            patches = [_Patch(plain, point) for point in start]
        times.append(t_s)
        pixels.append(np.where(agrees[:, None], now, np.nan))
        likelihood.append(np.where(agrees, trust, 0.0))
        before = plain
    return Tracks.of(names, times, np.array(pixels), np.array(likelihood), size)


def _searched(
    before: Image, image: Image, now: Array, guess: Array, levels: int
) -> tuple[Array, Array]:
    """Return where points (N, 2) of the image before are, and by how much the way back misses them;
    infinite where none is found.
    """
    cv2 = opencv()
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, ITERATIONS, 1e-4)
    flags, window = cv2.OPTFLOW_USE_INITIAL_FLOW, (WINDOW_PX, WINDOW_PX)
    options = {"winSize": window, "maxLevel": levels, "criteria": stop, "flags": flags}
    points, near = (each[:, None].astype(np.float32) for each in (now, guess))
    ahead, found, _ = cv2.calcOpticalFlowPyrLK(before, image, points, near.copy(), **options)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(
        image, before, ahead, ahead - near + points, **options
    )
    missed = np.where(found & returned, np.linalg.norm(back - points, axis=2), np.inf)
    return ahead[:, 0].astype(float), missed[:, 0]


class _Patch:
    """Surroundings of a point (2,) in the first image."""

    def __init__(self, image: Image, point: Array) -> None:
        cv2 = opencv()
        size = 2 * HALF_PATCH_PX + 1
        self.patch = cv2.getRectSubPix(image, (size, size), point.astype(np.float32).tolist())
        self.linear = np.eye(2)

    def aligned(self, image: Image, point: Array) -> Array | None:
        """Return the pixel (2,) near `point` at which the image agrees with the patch up to an
        affine transform; None if it does not, and `point` if the surroundings are beyond the image.
        """
        cv2 = opencv()
        corner = np.floor(point) - 2 * HALF_PATCH_PX
        (left, top), side = corner.astype(int).tolist(), 4 * HALF_PATCH_PX + 1
        height, width = image.shape
        if left < 0 or top < 0 or left + side > width or top + side > height:
            return point
        middle = np.full(2, float(HALF_PATCH_PX))
        shift = point - corner - self.linear @ middle
        warp = np.column_stack([self.linear, shift]).astype(np.float32)
        stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, ITERATIONS, 1e-4)
        part = image[top : top + side, left : left + side]
        try:
            correlation, warp = cv2.findTransformECC(
                self.patch, part, warp, cv2.MOTION_AFFINE, stop, None, 3
            )
        except cv2.error:  # it does not converge
            return None
        found = warp[:, :2] @ middle + warp[:, 2] + corner
        if correlation < LEAST_CORRELATION or np.linalg.norm(found - point) > FARTHEST_PX:
            return None
        self.linear = warp[:, :2].astype(float)
        return found


def tag_centres(images: Iterable[tuple[float, Image]], dictionary: str) -> Tracks:
    """Return the centres of the ArUco or AprilTag markers that each image shows."""
    cv2 = opencv()
    number = getattr(cv2.aruco, dictionary, None)
    if not dictionary.startswith("DICT_") or number is None:
        raise InputError(
            f"found {dictionary!r}; expected a dictionary of OpenCV, such as DICT_4X4_50",
            where="--tags",
        )
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(number))
    times: list[float] = []
    seen: list[dict[int, Array]] = []
    size = np.zeros(2)
    for t_s, image in images:
        size = np.array(image.shape[1::-1])
        corners, numbers, _ = detector.detectMarkers(grey(image))
        times.append(t_s)
        ids: list[Any] = [] if numbers is None else np.ravel(numbers).tolist()
        seen.append({k: _crossing(c[0]) for k, c in zip(ids, corners, strict=True)})
    tags = sorted({tag for each in seen for tag in each})
    none = np.full(2, np.nan)
    pixels = np.array([[each.get(tag, none) for tag in tags] for each in seen])
    pixels = pixels.reshape(len(seen), len(tags), 2)
    trust = np.isfinite(pixels).all(axis=2).astype(float)
    return Tracks.of([f"tag_{tag}" for tag in tags], times, pixels, trust, size)


def _crossing(corners: Array) -> Array:
    """Return where the diagonals of a tag cross: the image of its centre, unlike the mean."""
    a, b, c, d = corners.astype(float)
    share = np.linalg.solve(np.column_stack([c - a, b - d]), b - a)
    return a + share[0] * (c - a)


def write_table(tracks: Tracks, file: Path) -> None:
    """Write the pixels as a wide table with their standard error; missing samples are empty cells."""
    with file.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        columns = [f"{name}_{c}" for name in tracks.names for c in ("u", "v", "likelihood")]
        writer.writerow(["t_s", *columns, "sigma_px"])
        for t_s, pixels, trust in zip(tracks.t_s, tracks.pixels, tracks.likelihood, strict=True):
            cells: list[str] = []
            for (u, v), likelihood in zip(pixels, trust, strict=True):
                known = np.isfinite(u)
                cells += [f"{u:.4f}", f"{v:.4f}"] if known else ["", ""]
                cells.append(f"{likelihood:.4f}")
            writer.writerow([f"{t_s:.6f}", *cells, f"{tracks.sigma_px:.3f}"])
