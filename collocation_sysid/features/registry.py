"""Registry of the features that contribute to checks, runs and reports."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol, TypeVar

from ..recording.experiment import Experiment
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


class OfKind(Protocol):
    """What belongs to one kind of measurements, of obstacles or of specimens."""

    @property
    def kind(self) -> type: ...


Contribution = TypeVar("Contribution", bound=OfKind)


def present(among: Iterable[Contribution], experiments: Iterable[Experiment]) -> list[Contribution]:
    """Return those whose kind of measurement, obstacle or specimen the experiments have."""
    parts = [each for e in experiments for each in (*e.measurements, *e.obstacles, e.specimen)]
    return [one for one in among if any(isinstance(each, one.kind) for each in parts)]
