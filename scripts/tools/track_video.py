"""Track points of a body in a video or in images, and write the table of pixels for image tracks.

Points are corners that are found within a mask in the first image, points that are stated, or the
centres of ArUco or AprilTag markers. Corners and stated points are followed by the pyramidal method
of Lucas and Kanade, forwards and backwards: the likelihood of a sample decreases with the distance
by which the way back misses the point, and a point that misses by more than --lost pixels is lost.
In order that errors of single steps do not add up, the surroundings of each point are then aligned
with the first image by an affine transform (enhanced correlation coefficient).
Needs OpenCV: pip install 'collocation-sysid[video]'.

    python scripts track_video film.mp4 --out front.csv [--mask body.png] [--most 30]
        [--points "tip=612,388;hook=540,401"] [--tags DICT_4X4_50] [--rate-hz 60] [--film seen.mp4]
"""

from __future__ import annotations

import csv
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from script_arguments import make_parser

from collocation_sysid.common.files import in_counting_order

# Window of the method [pixels], levels of its pyramid, and iterations of each level.
WINDOW_PX = 21
LEVELS = 3
ITERATIONS = 40
# Distance of the way back at which the likelihood has fallen to 1/e [pixels].
HALF_TRUST_PX = 0.5
# Quality of corners relative to the best, and their least distance [pixels].
LEAST_QUALITY = 0.02
LEAST_DISTANCE_PX = 12
# Half size of the surroundings that are aligned with the first image [pixels], least correlation of
# an alignment that is used, and its largest distance from the point that is followed [pixels].
HALF_PATCH_PX = 15
LEAST_CORRELATION = 0.85
FARTHEST_PX = 4.0
IMAGE_ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")


class Tracks(NamedTuple):
    """Tracks of points: names (N,), times (S,) [s], pixels (S, N, 2), NaN where missing, and
    likelihood (S, N).
    """

    names: list[str]
    t_s: np.ndarray
    pixels: np.ndarray
    likelihood: np.ndarray


def opencv() -> Any:
    """Return OpenCV; end with the remedy if it is missing."""
    try:
        import cv2
    except ImportError:
        sys.exit("OpenCV is missing; expected pip install 'collocation-sysid[video]'")
    return cv2


def images_of(source: Path, rate_hz: float | None) -> Iterator[tuple[float, np.ndarray]]:
    """Yield time [s] and pixels (rows, columns, 3) of the images of a video or a folder.

    The times of a video are those that it states for each image, because phones record with a
    varying rate; `rate_hz` replaces them, and a folder needs it.
    """
    cv2 = opencv()
    if source.is_dir():
        files = in_counting_order(f for f in source.iterdir() if f.suffix.lower() in IMAGE_ENDINGS)
        if not files or not rate_hz:
            sys.exit(f"{source}: found {len(files)} images; expected images, and --rate-hz")
        for k, file in enumerate(files):
            image = cv2.imread(str(file))
            if image is None:
                sys.exit(f"{file}: this image cannot be read")
            yield k / rate_hz, image
        return
    video = cv2.VideoCapture(str(source))
    if not video.isOpened():
        sys.exit(f"{source}: this video cannot be opened; expected a file that OpenCV can decode")
    number = 0
    while True:
        is_read, image = video.read()
        if not is_read:
            break
        stated_s = 1e-3 * video.get(cv2.CAP_PROP_POS_MSEC)
        yield (number / rate_hz if rate_hz else stated_s), image
        number += 1
    video.release()


def grey(image: np.ndarray) -> np.ndarray:
    """Return an image as grey values."""
    cv2 = opencv()
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)


def corners_of(image: np.ndarray, mask: np.ndarray | None, most: int) -> np.ndarray:
    """Return up to `most` corners (N, 2) of an image within a mask, to a part of a pixel."""
    cv2 = opencv()
    plain = grey(image)
    found = cv2.goodFeaturesToTrack(plain, most, LEAST_QUALITY, LEAST_DISTANCE_PX, mask=mask)
    if found is None:
        return np.zeros((0, 2))
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, ITERATIONS, 1e-3)
    return cv2.cornerSubPix(plain, found, (5, 5), (-1, -1), stop).reshape(-1, 2)


def follow(
    images: Iterable[tuple[float, np.ndarray]], names: list[str], start: np.ndarray, lost_px: float
) -> Tracks:
    """Follow points (N, 2) of the first image through all images."""
    cv2 = opencv()
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, ITERATIONS, 1e-4)
    options = {"winSize": (WINDOW_PX, WINDOW_PX), "maxLevel": LEVELS, "criteria": stop}
    times, pixels, likelihood = [], [], []
    before: np.ndarray | None = None
    patches: list[_Patch] = []
    now = start.astype(np.float32)
    alive = np.ones(len(start), dtype=bool)
    for t_s, image in images:
        plain = grey(image)
        trust = np.ones(len(start))
        if before is not None and len(start):
            ahead, found, _ = cv2.calcOpticalFlowPyrLK(before, plain, now[:, None], None, **options)
            back, returned, _ = cv2.calcOpticalFlowPyrLK(plain, before, ahead, None, **options)
            missed = np.linalg.norm(back[:, 0] - now, axis=1)
            height, width = plain.shape
            inside = (ahead[:, 0] >= 0).all(axis=1) & (ahead[:, 0] < [width, height]).all(axis=1)
            alive &= (found[:, 0] == 1) & (returned[:, 0] == 1) & (missed <= lost_px) & inside
            trust = np.exp(-missed / HALF_TRUST_PX)
            now = np.where(alive[:, None], ahead[:, 0], now).astype(np.float32)
            for k in np.flatnonzero(alive):
                now[k] = patches[k].aligned(plain, now[k])
        else:
            patches = [_Patch(plain, point) for point in start]
        times.append(t_s)
        pixels.append(np.where(alive[:, None], now, np.nan))
        likelihood.append(np.where(alive, trust, 0.0))
        before = plain
    return Tracks(names, np.array(times), np.array(pixels), np.array(likelihood))


class _Patch:
    """Surroundings of a point (2,) in the first image."""

    def __init__(self, image: np.ndarray, point: np.ndarray) -> None:
        cv2 = opencv()
        size = 2 * HALF_PATCH_PX + 1
        self.patch = cv2.getRectSubPix(image, (size, size), point.astype(np.float32).tolist())
        self.linear = np.eye(2)

    def aligned(self, image: np.ndarray, point: np.ndarray) -> np.ndarray:
        """Return the pixel (2,) near `point` at which the image agrees with the patch up to an
        affine transform; `point` if it does not.
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
            return point
        found = warp[:, :2] @ middle + warp[:, 2] + corner
        if correlation < LEAST_CORRELATION or np.linalg.norm(found - point) > FARTHEST_PX:
            return point
        self.linear = warp[:, :2].astype(float)
        return found


def tag_centres(images: Iterable[tuple[float, np.ndarray]], dictionary: str) -> Tracks:
    """Return the centres of the ArUco or AprilTag markers that each image shows."""
    cv2 = opencv()
    number = getattr(cv2.aruco, dictionary, None)
    if number is None:
        sys.exit(f"found --tags {dictionary}; expected a dictionary of OpenCV, such as DICT_4X4_50")
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(number))
    times: list[float] = []
    seen: list[dict[int, np.ndarray]] = []
    for t_s, image in images:
        corners, numbers, _ = detector.detectMarkers(grey(image))
        times.append(t_s)
        ids = [] if numbers is None else np.ravel(numbers).tolist()
        seen.append({k: _crossing(c[0]) for k, c in zip(ids, corners, strict=True)})
    tags = sorted({tag for each in seen for tag in each})
    none = np.full(2, np.nan)
    pixels = np.array([[each.get(tag, none) for tag in tags] for each in seen])
    pixels = pixels.reshape(len(seen), len(tags), 2)
    trust = np.isfinite(pixels).all(axis=2).astype(float)
    return Tracks([f"tag_{tag}" for tag in tags], np.array(times), pixels, trust)


def _crossing(corners: np.ndarray) -> np.ndarray:
    """Return where the diagonals of a tag cross: the image of its centre, unlike the mean."""
    a, b, c, d = corners.astype(float)
    share = np.linalg.solve(np.column_stack([c - a, b - d]), b - a)
    return a + share[0] * (c - a)


def write_table(tracks: Tracks, file: Path) -> None:
    """Write the pixels as a wide table; missing samples are empty cells."""
    with file.open("w", newline="") as stream:
        writer = csv.writer(stream)
        columns = [f"{name}_{c}" for name in tracks.names for c in ("u", "v", "likelihood")]
        writer.writerow(["t_s", *columns])
        for t_s, pixels, trust in zip(*tracks[1:], strict=True):
            cells: list[str] = []
            for (u, v), likelihood in zip(pixels, trust, strict=True):
                known = np.isfinite(u)
                cells += [f"{u:.4f}", f"{v:.4f}"] if known else ["", ""]
                cells.append(f"{likelihood:.4f}")
            writer.writerow([f"{t_s:.6f}", *cells])


def write_film(source: Path, rate_hz: float | None, tracks: Tracks, file: Path) -> None:
    """Write the video with the tracked points."""
    cv2 = opencv()
    writer = None
    for (_, image), pixels in zip(images_of(source, rate_hz), tracks.pixels, strict=True):
        if writer is None:
            steps = np.diff(tracks.t_s)
            rate = 1 / float(np.median(steps)) if len(steps) else 30.0
            size = (image.shape[1], image.shape[0])
            writer = cv2.VideoWriter(str(file), cv2.VideoWriter_fourcc(*"mp4v"), rate, size)
        for u, v in pixels[np.isfinite(pixels).all(axis=1)]:
            cv2.circle(image, (round(u), round(v)), 5, (0, 0, 255), 2)
        writer.write(image)
    if writer is not None:
        writer.release()


def stated_points(text: str) -> tuple[list[str], np.ndarray]:
    """Return names and pixels (N, 2) of points stated as "tip=612,388;hook=540,401"."""
    names, points = [], []
    for part in filter(None, text.split(";")):
        name, _, pixel = part.partition("=")
        try:
            u, v = map(float, pixel.split(","))
        except ValueError:
            sys.exit(f"found --points {part!r}; expected NAME=U,V")
        names.append(name.strip())
        points.append((u, v))
    return names, np.array(points)


def main(arguments: list[str] | None = None) -> None:
    """Track the points of a video and write their table."""
    parser = make_parser(__doc__)
    parser.add_argument("video", type=Path, help="video, or folder of images")
    parser.add_argument("--out", type=Path, required=True, help="table of tracks, CSV")
    parser.add_argument("--mask", type=Path, help="image that is not black where the body is")
    parser.add_argument("--most", type=int, default=30, help="largest number of corners")
    parser.add_argument("--points", default="", help='stated points, "tip=612,388;hook=540,401"')
    parser.add_argument("--tags", default="", help="dictionary of ArUco or AprilTag markers")
    parser.add_argument("--rate-hz", type=float, help="frame rate; that of the video by default")
    parser.add_argument(
        "--lost", type=float, default=2.0, help="pixels by which the way back may miss a point"
    )
    parser.add_argument("--film", type=Path, help="film with the points drawn into the video")
    options = parser.parse_args(arguments)
    cv2 = opencv()
    if options.tags:
        tracks = tag_centres(images_of(options.video, options.rate_hz), options.tags)
    else:
        names, start = stated_points(options.points)
        if not names:
            _, first = next(images_of(options.video, options.rate_hz), (0.0, None))
            if first is None:
                sys.exit(f"{options.video}: found no image")
            mask = None
            if options.mask is not None:
                mask = cv2.imread(str(options.mask), cv2.IMREAD_GRAYSCALE)
                if mask is None or mask.shape != first.shape[:2]:
                    sys.exit(f"{options.mask}: expected an image of the size of the video")
            start = corners_of(first, mask, options.most)
            names = [f"p{k + 1}" for k in range(len(start))]
        images = images_of(options.video, options.rate_hz)
        tracks = follow(images, names, start, options.lost)
    if not tracks.names or not np.isfinite(tracks.pixels).any():
        sys.exit(f"{options.video}: found no point; expected texture, stated points, or tags")
    write_table(tracks, options.out)
    if options.film is not None:
        write_film(options.video, options.rate_hz, tracks, options.film)
    kept = np.isfinite(tracks.pixels).all(axis=2).mean()
    count = len(tracks.names)
    print(f"{options.out}: {count} points in {len(tracks.t_s)} images, {kept:.0%} of the samples")


if __name__ == "__main__":
    main()
