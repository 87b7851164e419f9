"""Motion-capture files, one format per module; recognised by what is in them, not by their name."""

from .recognition import read_tracks
from .tracks import Choose, RawTracks

__all__ = ["Choose", "RawTracks", "read_tracks"]
