"""Draw a run's pictures again from its files alone."""

from __future__ import annotations

from pathlib import Path

from .pictures import album, save_pictures
from .replay import read_run, reading_run


def redraw(run: str | Path, folder: str | Path) -> list[Path]:
    """Write the pictures of a run folder into `folder`, all but that of the Jacobian.

    Raises
    ------
    InputError
        If `run` is not a run folder.
    """
    result, replays = read_run(run)
    with reading_run(Path(run)):
        return save_pictures(folder, album(replays, result))
