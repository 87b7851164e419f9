"""Worker process of one run, which `run_execution` starts.

The run is read as one line of JSON from stdin, and its record is written to the file OUT. The
process ends when its stdin is closed, so that it never outlives the study.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import traceback
from pathlib import Path
from typing import Any

import numpy as np

from ...common.files import write_text_file
from ...common.serialisation import as_json
from ...common.signal_handling import heed_interrupts, leave
from ...errors import InputError, SimulationError
from ...pipeline import Run, run
from ...problem import Problem
from ...recording.grasp import prescribed_nodes
from ...runs.forward_simulation import ForwardSimulation
from .model_choice import fit_record
from .run_execution import ERROR, FINISHED


def main() -> None:
    """Entry point: read the run, execute it, and write its record.

    The run is read from stdin, and the record is written to the file that the first command-line
    argument names. The function does not return: the process ends with code 0.
    """
    heed_interrupts()
    planned = json.loads(sys.stdin.buffer.readline())
    threading.Thread(target=_end_with_study, daemon=True).start()
    write_text_file(Path(sys.argv[1]), as_json(record_of_run(planned)))
    leave(0)


def record_of_run(planned: dict[str, Any]) -> dict[str, Any]:
    """Execute a planned run and return its record; errors become part of the record.

    Parameters
    ----------
    planned : dict
        A `PlannedRun` as a dictionary.

    Returns
    -------
    dict
        "outcome" (`FINISHED` or `ERROR`) and "message". Of a finished run also "model", see
        `fit_record`, if `test_name` is not None (a comparison of models), else "result" and
        "tip_max_m", see `_tip_error_m`. Of an unexpected error also "traceback".
    """
    try:
        problem = Problem.read(
            planned["problem"], planned["overrides"], allow_code=planned["allow_code"]
        )
        test_name = planned.get("test_name")
        if test_name is not None:
            fit = fit_record(problem, planned["method"], test_name=test_name)
            return {"outcome": FINISHED, "message": fit["status"], "model": fit}
        finished = run(problem, planned["method"])
        return {
            "outcome": FINISHED,
            "message": finished.solution.message,
            "result": finished.result,
            "tip_max_m": _tip_error_m(finished),
        }
    except (InputError, SimulationError) as error:
        return {"outcome": ERROR, "message": str(error)}
    except Exception as error:
        message = f"{type(error).__name__}: {error}"
        return {"outcome": ERROR, "message": message, "traceback": traceback.format_exc()}


def _tip_error_m(finished: Run) -> float | None:
    """Return the largest error [m] of the marker farthest from the grasp in a simulation."""
    experiment = finished.solution.collocation.transcriptions[0].experiment
    markers = experiment.markers
    rollout = finished.rollouts[experiment.name]
    if not (markers.names and isinstance(rollout, ForwardSimulation)):
        return None
    nodes_m = experiment.body.nodes_m
    grasped_nodes = prescribed_nodes(experiment.grasps)
    centre = nodes_m[grasped_nodes if len(grasped_nodes) else slice(None)].mean(axis=0)
    tip = int(np.linalg.norm(markers.predict_positions(nodes_m) - centre, axis=1).argmax())
    if not markers.is_complete[:, tip].any():
        return None
    errors_m = rollout.trajectory.markers_m[:, tip] - markers.positions_m[:, tip]
    return float(np.nanmax(np.linalg.norm(errors_m, axis=1)))


def _end_with_study() -> None:
    """Wait until stdin is closed, and end the process at once, without any clean-up."""
    os.read(0, 1)  # returns when the other end is closed
    os._exit(1)
