"""Command that tracks points in a video."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from ..common.files import replaced_file, require_possible
from ..common.validated_types import AtLeastOne, Positive
from ..errors import InputError
from .command_options import OutputOptions, command, option
from .common import EXIT_NOT_CONVERGED, shown_progress

commands = typer.Typer()

NO_POINT = "found no point; expected texture, --points, or --tags"

RateHz = Annotated[
    Positive | None,
    option("Frame rate of images in a folder; of a video instead of its own.", "HZ"),
]


@command(
    commands,
    "track film.mp4 --out front.csv --mask body.png",
    'track film.mp4 --out front.csv --poses poses.csv --gripper "640,80;700,82"',
    "track film.mp4 --out front.csv --tags DICT_4X4_50",
)
def track(
    *,
    video: Annotated[
        Path, typer.Argument(metavar="VIDEO", help="The video, or a folder of images.")
    ],
    out: Annotated[Path, typer.Option("--out", metavar="FILE.csv", help="Table of tracks.")],
    mask: Annotated[
        Path | None,
        option("Image that is not black where the body is: corners are found there.", "IMAGE"),
    ] = None,
    most: Annotated[AtLeastOne, option("Largest number of corners.", "N")] = 30,
    points: Annotated[
        str, option('Points to follow instead of corners, "tip=612,388;hook=540,401".', "POINTS")
    ] = "",
    tags: Annotated[
        str, option("Find the ArUco or AprilTag markers of this dictionary instead.", "NAME")
    ] = "",
    poses: Annotated[
        Path | None, option("Poses of the gripper, from which start_s is estimated.", "FILE")
    ] = None,
    gripper: Annotated[
        str,
        option(
            'Points on the gripper, or beside it, for start_s, "640,80;700,82"; by default the tracked '
            "points that follow the poses best.",
            "POINTS",
        ),
    ] = "",
    rate_hz: RateHz = None,
    lost_px: Annotated[
        Positive, option("A point is lost if the way back misses it by more pixels.", "PIXELS")
    ] = 2.0,
    film: Annotated[Path | None, option("Film with the points in the video.", "FILE.mp4")] = None,
    output: OutputOptions,
) -> None:
    """Track points of a body in a video, as the table of pixels for image tracks.

    Points are corners of the first image, stated points, or centres of printed markers. The verdict
    says how many points survive, where the others were lost and what helps: points that move by
    more than about 35 pixels per image may be lost. With --poses, the command estimates start_s, the
    time of the first image by the clock of the poses. Needs the extra video (OpenCV).

    The exit code is 1 if no point survives; the table then has the images before.
    """
    from ..extras.tracking import (
        TrackVerdict,
        corners_of,
        damage_of,
        follow,
        images_of,
        read_image,
        require_size,
        start_time,
        stated_points,
        tag_centres,
        write_film,
        write_table,
    )
    from ..recording import read_poses

    if bool(points) + bool(tags) + (mask is not None) > 1:
        raise InputError("found several of --mask, --points and --tags; expected one of them")
    if gripper and poses is None:
        raise InputError("expected --poses, the poses of the gripper, too", where="--gripper")
    if film is not None and film.suffix != ".mp4":
        raise InputError(f"found {str(film)!r}; expected FILE.mp4", where="--film")
    read = [os.path.realpath(file) for file in (video, mask, poses) if file is not None]
    for file, name in ((out, "--out"), (film, "--film")):
        if file is not None and os.path.realpath(file) in read:
            raise InputError(
                f"found {str(file)!r}, which is read; expected another file", where=name
            )
        if file is not None:
            require_possible(file.parent)
    names, start = stated_points(points, "--points")
    gripper_names, gripper_px = stated_points(gripper, "--gripper")
    motion = None if poses is None else read_poses(poses)
    with shown_progress(f"reading {video}", quiet=output.quiet) as progress:

        def images() -> Iterator[tuple[float, Any]]:
            for number, image in enumerate(images_of(video, rate_hz), start=1):
                progress.say(f"image {number}")
                yield image

        _, first = next(images())
        require_size(first, video)
        if not tags and not points:
            within = None if mask is None else read_image(mask, is_grey=True)
            if mask is not None and within is not None and within.shape != first.shape[:2]:
                found = " × ".join(map(str, within.shape[::-1]))
                size = " × ".join(map(str, first.shape[1::-1]))
                raise InputError(f"found {found} pixels; expected those of the video, {size}", mask)
            start = corners_of(first, within, most)
            names = [f"p{k + 1}" for k in range(len(start))]
        if not tags and not len(start):
            raise InputError(NO_POINT, video)
        tracks = (
            tag_centres(images(), tags) if tags else follow(images(), names, start, lost_px=lost_px)
        )
        if not len(tracks.names):
            raise InputError(NO_POINT, video)
        if len(tracks.t_s) < 2:
            raise InputError("found one image; expected several", video)
        progress.say("checking the video")
        damage = damage_of(video)
        moved = tracks if not gripper else follow(images(), gripper_names, gripper_px, lost_px)
        start_s = (
            None
            if motion is None
            else start_time(moved.t_s, moved.pixels, [*moved.names], poses=motion)
        )
        with ExitStack() as stack:
            write_table(tracks, stack.enter_context(replaced_file(out)))
            if film is not None:
                draft = stack.enter_context(replaced_file(film))
                write_film(draft, images(), tracks.t_s, tracks.pixels)
    verdict = TrackVerdict(tracks, start_s, damage)
    answer = {
        "file": str(out),
        "verdict": verdict.verdict,
        "points": len(tracks.names),
        "surviving": verdict.surviving,
        "images": len(tracks.t_s),
        "samples": float(np.isfinite(tracks.pixels).all(axis=2).mean()),
        "lost": [each._asdict() for each in tracks.losses],
        "remedies": verdict.remedies,
        "start": None if start_s is None else start_s._asdict(),
    }
    output.print_result(answer, [*verdict.shown(), f"{out}"])
    if not verdict.surviving:
        raise typer.Exit(EXIT_NOT_CONVERGED)
