"""Draw a run's pictures again from its files alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..methods.solution import Iteration
from .pictures import Confidence, album, save_pictures
from .replay import read_run, reading_run


def redraw(run: str | Path, folder: str | Path) -> list[Path]:
    """Write the pictures of a run folder into `folder`, all but that of the Jacobian.

    Raises
    ------
    InputError
        If `run` is not a run folder.
    """
    run, folder = Path(run), Path(folder)
    result, replays = read_run(run)
    with reading_run(run):
        history = [_iteration(line) for line in result["history"]]
        free = [name for name, item in result["parameters"].items() if not item["fixed"]]
        confidence = Confidence.from_result(result)
        pictures = album(replays, history, free, confidence, scan=result.get("scan"))
        return save_pictures(folder, pictures)


def _iteration(line: dict[str, Any]) -> Iteration:
    return Iteration(
        line["iteration"],
        line["loss"],
        line["rms_m"],
        line["violation_n"],
        line["parameters"],
        line["time_s"],
        line.get("share", 1.0),
    )
