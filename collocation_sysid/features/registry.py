"""Registry of the features that contribute to checks, runs and reports."""

from __future__ import annotations

from ..statistics.concerns import declare_messages, declare_topics
from .cameras.feature import CAMERAS
from .contact.feature import CONTACT
from .feature import Feature
from .image_tracks.feature import IMAGE_TRACKS
from .outlines.feature import OUTLINES

FEATURES: tuple[Feature, ...] = (CONTACT, CAMERAS, IMAGE_TRACKS, OUTLINES)
for _feature in FEATURES:
    declare_topics(_feature.topics)
    declare_messages(_feature.messages)
