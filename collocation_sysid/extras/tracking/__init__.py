"""Tracks of points in a video, as the table that image tracks of a problem read.

`video` reads images, `points` finds and follows points, `start_time` compares their motion with that
of the gripper, and `verdict` judges the tracks.
"""

from .points import (
    Tracks,
    corners_of,
    follow,
    require_size,
    stated_points,
    tag_centres,
    write_table,
)
from .start_time import StartTime, start_time
from .verdict import TrackVerdict
from .video import damage_of, images_of, read_image, write_film

__all__ = [
    "StartTime",
    "TrackVerdict",
    "Tracks",
    "corners_of",
    "damage_of",
    "follow",
    "images_of",
    "read_image",
    "require_size",
    "start_time",
    "stated_points",
    "tag_centres",
    "write_film",
    "write_table",
]
