"""Images of a video or of a folder, by OpenCV (extra `video`)."""

from __future__ import annotations

import json
import os
import subprocess
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image as PillowImage

from ...common.array_types import Array
from ...common.files import in_counting_order, require_regular
from ...common.installation import python_command
from ...errors import InputError
from ...kinds.outlines.masks import UNREADABLE
from ...recording.sources.depth_files import standard_error_silenced

Image = NDArray[np.uint8]

IMAGE_ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
# Settings of FFmpeg in OpenCV: formats that contain images, no list of other files or addresses; and
# no messages, which its threads print at any time.
FFMPEG = {
    "OPENCV_FFMPEG_CAPTURE_OPTIONS": "format_whitelist;"
    "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpegts,mpeg,asf,gif,yuv4mpegpipe",
    "OPENCV_FFMPEG_LOGLEVEL": "-8",
}
# Decodes a video with the messages of FFmpeg, of which each line begins with `MESSAGE`, and prints a
# list: number of images that the file announces, number that are decoded, announced duration, and
# end of the last image by the times before [s].
MESSAGE = "[OPENCV:FFMPEG:"
_DECODE = """
import json, sys, cv2
video = cv2.VideoCapture(sys.argv[1], cv2.CAP_FFMPEG)
count = video.get(cv2.CAP_PROP_FRAME_COUNT)
duration_s = count / (video.get(cv2.CAP_PROP_FPS) or 1)
times_s = []
while video.grab():
    times_s.append(1e-3 * video.get(cv2.CAP_PROP_POS_MSEC))
steps_s = [b - a for a, b in zip(times_s, times_s[1:])]
end_s = times_s[-1] + 2 * max(steps_s, default=0) if times_s else 0
print(json.dumps([count, len(times_s), duration_s, end_s]))
"""


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
    os.environ |= FFMPEG
    with standard_error_silenced():
        video = cv2.VideoCapture(str(source), cv2.CAP_FFMPEG)
    try:
        number, last_s = 0, -np.inf
        while True:
            is_read, image = video.read()
            if not is_read:
                break
            t_s = number / rate_hz if rate_hz else 1e-3 * video.get(cv2.CAP_PROP_POS_MSEC)
            number += 1
            if not t_s > last_s:
                raise InputError(
                    f"image {number} is at {t_s:.6g} s, not after the one before; expected --rate-hz, "
                    "the frame rate, where a video has no increasing times",
                    source,
                )
            yield t_s, image
            last_s = t_s
    finally:
        video.release()
    if not number:
        raise InputError("this has no image; expected a video that OpenCV can decode", source)


def damage_of(source: Path) -> str:
    """Return a sentence if a video has errors, or fewer images than it announces; else "".

    It is decoded in a process of its own, because FFmpeg conceals errors by similar images and only
    prints them.

    Raises
    ------
    InputError
        If the decoder crashes.
    """
    if source.is_dir():
        return ""
    environment = os.environ | FFMPEG | {"OPENCV_FFMPEG_LOGLEVEL": "16"}
    command = python_command(_DECODE, str(source))
    done = subprocess.run(
        command, env=environment, capture_output=True, text=True, errors="replace", check=False
    )
    lines = done.stdout.splitlines()
    errors = [line.partition("]")[2].strip() for line in lines if line.startswith(MESSAGE)]
    counts = [line for line in lines if line.startswith("[") and not line.startswith(MESSAGE)]
    if done.returncode or not counts:
        raise InputError("decoding this video crashes; expected an undamaged video", source)
    announced, decoded, duration_s, end_s = json.loads(counts[-1])
    if not errors and not (decoded < announced and end_s < duration_s):
        return ""
    reported = f'; the decoder reports {len(errors)} errors, first "{errors[0]}"' if errors else ""
    return (
        f"{decoded:.0f} of {announced:.0f} announced images are decoded{reported}: the video was cut "
        "or damaged, and images may be wrong or missing; record or copy it again"
    )


def read_image(file: Path, *, is_grey: bool = False) -> Image:
    """Return an image (rows, columns, 3), or its grey values."""
    cv2 = opencv()
    require_regular(file)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with PillowImage.open(file) as whole:
                whole.load()  # OpenCV fills what a file lacks
        with standard_error_silenced():
            image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE if is_grey else cv2.IMREAD_COLOR)
    except (*UNREADABLE, cv2.error):  # such as too many pixels
        image = None
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
    rate_hz = 1 / float(np.median(np.diff(t_s)))
    for (_, image), points in zip(images, pixels, strict=True):
        if writer is None:
            size = (image.shape[1], image.shape[0])
            writer = cv2.VideoWriter(str(file), cv2.VideoWriter_fourcc(*"mp4v"), rate_hz, size)
        for u, v in points[np.isfinite(points).all(axis=1)]:
            cv2.circle(image, (round(u), round(v)), 5, (0, 0, 255), 2)
        writer.write(image)
    if writer is not None:
        writer.release()
