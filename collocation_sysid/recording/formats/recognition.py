"""Which format a file has, told by its content."""

from __future__ import annotations

from pathlib import Path

from . import c3d, motive, plain, qualisys, trc
from .text import decode, read_bytes
from .tracks import Choose, RawTracks

# What the first line begins with.
_TEXT_FORMATS = {
    trc.BEGINNING: trc.read,
    qualisys.BEGINNING: qualisys.read,
    motive.BEGINNING: motive.read,
}


def read_tracks(path: str | Path, choose: Choose) -> RawTracks:
    """Read the markers that `choose` picks from a file of any known format.

    Raises
    ------
    InputError
        Naming the file, and the line where there is one.
    """
    content = read_bytes(path)
    if c3d.recognises(content):
        return c3d.read(path, content, choose)
    text = decode(content, path)
    start = text.lstrip().lstrip('"')
    for beginning, read in _TEXT_FORMATS.items():
        if start.startswith(beginning):
            return read(path, text, choose)
    return plain.read(path, text, choose)
