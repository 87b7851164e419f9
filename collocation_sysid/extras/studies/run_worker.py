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

from ...common.files import write_text_file
from ...common.serialisation import as_json
from ...common.signal_handling import heed_interrupts, leave
from ...errors import InputError, SimulationError
from ...pipeline import run
from ...problem import Problem
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
        `fit_record`, if `test_name` is not None (a comparison of models), else "result". Of an
        unexpected error also "traceback".
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
        }
    except (InputError, SimulationError) as error:
        return {"outcome": ERROR, "message": str(error)}
    except Exception as error:
        message = f"{type(error).__name__}: {error}"
        return {"outcome": ERROR, "message": message, "traceback": traceback.format_exc()}


def _end_with_study() -> None:
    """Wait until stdin is closed, and end the process at once, without any clean-up."""
    os.read(0, 1)  # returns when the other end is closed
    os._exit(1)
