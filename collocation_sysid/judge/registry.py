"""Registry of the likely mistakes of all features."""

from __future__ import annotations

from ..features.cameras.doubts import CAMERAS
from ..features.contact.doubts import CONTACT
from ..features.image_tracks.doubts import IMAGE_TRACKS
from ..features.specimens.doubts import SPECIMENS
from .source import Source

SOURCES: tuple[Source, ...] = (CONTACT, CAMERAS, IMAGE_TRACKS, SPECIMENS)
