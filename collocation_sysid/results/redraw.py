"""Draw a run's plots again from its files alone."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from matplotlib.figure import Figure

from ..errors import InputError
from ..nlp.parameters import Theta
from .plots import convergence, error_over_time, save_plots, tracks
from .solution import Iteration


def redraw(run: str | Path, folder: str | Path) -> list[Path]:
    """Write the convergence, track and error plots of a run folder into `folder`.

    Raises
    ------
    InputError
        If `run` is not a run folder.
    """
    run, folder = Path(run), Path(folder)
    try:
        result = json.loads((run / "result.json").read_text(encoding="utf-8"))
        with np.load(run / "trajectory.npz") as stored:
            arrays = dict(stored)
        figures = _figures(result, arrays)
    except (FileNotFoundError, NotADirectoryError) as error:
        name = Path(str(error.filename)).name
        raise InputError(f"this is not a run folder: it has no {name}", run) from error
    except (OSError, EOFError, BadZipFile, ValueError, LookupError, TypeError) as error:
        reason = f"{type(error).__name__}: {error}"
        raise InputError(
            f"result.json or trajectory.npz is damaged ({reason}); solve the problem again", run
        ) from error
    folder.mkdir(parents=True, exist_ok=True)
    return save_plots(folder, figures)


def _figures(result: dict[str, Any], arrays: dict[str, np.ndarray]) -> dict[str, Figure]:
    history = [_iteration(line) for line in result["history"]]
    free = [name for name, item in result["parameters"].items() if not item["fixed"]]
    figures = {"convergence": convergence(history, free)} if history else {}
    for name in result["fit"]["experiments"]:
        prefix = f"{name}/" if f"{name}/t_s" in arrays else ""
        t_s, measured = arrays[f"{prefix}t_s"], arrays[f"{prefix}measured_m"]
        fitted = arrays[f"{prefix}markers_m"]
        rolled_out = arrays.get(f"{prefix}rolled_out_m")
        names = [str(marker) for marker in arrays[f"{prefix}marker_names"]]
        figures[f"tracks_{name}"] = tracks(t_s, names, measured, fitted, rolled_out)
        figures[f"error_{name}"] = error_over_time(t_s, measured, fitted, rolled_out)
    return figures


def _iteration(line: dict[str, Any]) -> Iteration:
    return Iteration(
        line["iteration"],
        line["loss"],
        line["rms_m"],
        line["violation_n"],
        Theta(*line["theta"]),
        line["time_s"],
    )
