"""Images of a video or of a folder, by OpenCV (extra `video`)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...common.array_types import Array
from ...common.files import in_counting_order, require_regular
from ...errors import InputError
from ...recording.sources.depth_files import standard_error_silenced

Image = NDArray[np.uint8]

IMAGE_ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
# Rate of a film of a single image [Hz].
SINGLE_RATE_HZ = 30.0


def opencv() -> Any:
    """Return OpenCV; an `InputError` with the remedy if it is missing."""
    try:
        import cv2
    except ImportError as error:
        raise InputError(
            "tracking needs OpenCV: pip install 'collocation-sysid[video]', or tracks of another program"
        ) from error
    return cv2


def images_of(source: Path, rate_hz: float | None) -> Iterator[tuple[float, Image]]:
    """Yield time [s] and pixels (rows, columns, 3) of the images of a video or a folder.

    The times of a video are those that it states for each image, because phones record with a
    varying rate; `rate_hz` replaces them, and a folder needs it.
    """
    cv2 = opencv()
    require_regular(source)
    if source.is_dir():
        files = in_counting_order(f for f in source.iterdir() if f.suffix.lower() in IMAGE_ENDINGS)
        if not files or not rate_hz:
            raise InputError(f"found {len(files)} images; expected images, and --rate-hz", source)
        for k, file in enumerate(files):
            yield k / rate_hz, read_image(file)
        return
    if not source.is_file():
        raise InputError("there is no such file; expected a video or a folder of images", source)
    with standard_error_silenced():
        video = cv2.VideoCapture(str(source))
    try:
        number = 0
        while (read := video.read())[0]:
            stated_s = 1e-3 * video.get(cv2.CAP_PROP_POS_MSEC)
            yield (number / rate_hz if rate_hz else stated_s), read[1]
            number += 1
    finally:
        video.release()
    if not number:
        raise InputError("this has no image; expected a video that OpenCV can decode", source)


def read_image(file: Path, *, is_grey: bool = False) -> Image:
    """Return an image (rows, columns, 3), or its grey values."""
    cv2 = opencv()
    require_regular(file)
    with standard_error_silenced():
        image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE if is_grey else cv2.IMREAD_COLOR)
    if image is None:
        raise InputError("this image cannot be read; expected a .png or .jpg", file)
    return image


def grey(image: Image) -> Image:
    """Return an image as grey values."""
    cv2 = opencv()
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)


def write_film(
    file: Path, images: Iterator[tuple[float, Image]], t_s: Array, pixels: Array
) -> None:
    """Write images with circles around points (S, N, 2), as MP4."""
    cv2 = opencv()
    writer: Any = None
    rate_hz = 1 / float(np.median(np.diff(t_s))) if len(t_s) > 1 else SINGLE_RATE_HZ
    for (_, image), points in zip(images, pixels, strict=True):
        if writer is None:
            size = (image.shape[1], image.shape[0])
            writer = cv2.VideoWriter(str(file), cv2.VideoWriter_fourcc(*"mp4v"), rate_hz, size)
        for u, v in points[np.isfinite(points).all(axis=1)]:
            cv2.circle(image, (round(u), round(v)), 5, (0, 0, 255), 2)
        writer.write(image)
    if writer is not None:
        writer.release()
