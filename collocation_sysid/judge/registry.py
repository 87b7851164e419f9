"""Registry of the likely mistakes of all features."""

from __future__ import annotations

from ..features.cameras.doubts import CAMERAS
from ..features.contact.doubts import CONTACT
from ..features.image_tracks.doubts import IMAGE_TRACKS
from ..features.outlines.doubts import OUTLINES
from ..features.specimens.doubts import SPECIMENS
from ..features.wrenches.doubts import WRENCHES
from .source import Source

SOURCES: tuple[Source, ...] = (WRENCHES, CONTACT, CAMERAS, IMAGE_TRACKS, OUTLINES, SPECIMENS)
