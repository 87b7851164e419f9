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
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ...common.files import write_text_file
from ...common.serialisation import as_json
from ...common.signal_handling import heed_interrupts, leave
from ...errors import InputError, SimulationError
from ...features.measurements import judged_residuals
from ...methods.solution import Solution
from ...problem import Problem
from ...runs.forward_simulation import ForwardSimulation, simulate_experiments
from ...runs.solving import solve
from .model_choice import fit_record
from .run_execution import ERROR, FINISHED, iteration_file


def main() -> None:
    """Entry point: read the run, execute it, and write its record.

    The run is read from stdin, and the record is written to the file that the first command-line
    argument names. The function does not return: the process ends with code 0.
    """
    heed_interrupts()
    planned = json.loads(sys.stdin.buffer.readline())
    threading.Thread(target=_end_with_study, daemon=True).start()
    out = Path(sys.argv[1])
    record = record_of_run(
        planned, lambda line: write_text_file(iteration_file(out), as_json(asdict(line)))
    )
    write_text_file(out, as_json(record))
    leave(0)


def record_of_run(
    planned: dict[str, Any], watch: Callable[[Any], None] | None = None
) -> dict[str, Any]:
    """Execute a planned run and return its record; errors become part of the record.

    Parameters
    ----------
    planned : dict
        A `PlannedRun` as a dictionary.
    watch : callable, optional
        Called with every `Iteration` of a comparison of methods.

    Returns
    -------
    dict
        "outcome" (`FINISHED` or `ERROR`) and "message". Of a finished run also "model", see
        `fit_record`, if `test_name` is not None (a comparison of models), else "fit", see
        `_answer_of_method`. Of an unexpected error also "traceback".
    """
    try:
        problem = Problem.read(
            planned["problem"], planned["overrides"], allow_code=planned["allow_code"]
        )
        test_name = planned.get("test_name")
        if test_name is not None:
            fit = fit_record(problem, planned["method"], test_name=test_name)
            return {"outcome": FINISHED, "message": fit["status"], "model": fit}
        solution = solve(problem, planned["method"].split()[0], watch=watch)
        fit = _answer_of_method(problem, solution)
        return {"outcome": FINISHED, "message": solution.message, "fit": fit}
    except (InputError, SimulationError) as error:
        return {"outcome": ERROR, "message": str(error)}
    except Exception as error:
        message = f"{type(error).__name__}: {error}"
        return {"outcome": ERROR, "message": message, "traceback": traceback.format_exc()}


def _answer_of_method(problem: Problem, solution: Solution) -> dict[str, Any]:
    """Return numbers of a solution and of the forward simulation with its parameters.

    "violation" has times [s] and the largest residual of the equations of motion then [N], and
    "simulation" times and RMS differences from the measurements in "unit", of the first experiment;
    "forward" is the RMS difference of all. "simulation" is missing if a simulation fails.
    """
    collocation, (first, *_) = solution.collocation, solution.parts
    answer = {
        "status": solution.status.value,
        "converged": solution.status.converged,
        "parameters": solution.parameters,
        "guess": {item.name: item.guess for item in collocation.parameters.free},
        "loss": collocation.objective(solution.z) / collocation.loss_scale,
        "violation_n": solution.max_violation_n,
        "iterations": solution.iterations,
        "total_s": solution.timing.total,
        "violation": (
            first.transcription.dynamics.t_s,
            np.abs(first.compute_residual_n()).max(axis=1, initial=0.0),
        ),
    }
    simulations = simulate_experiments(problem, solution)
    squares: list[np.ndarray] = []
    for part in solution.parts:
        experiment = part.transcription.experiment
        simulated = simulations[experiment.name]
        if not isinstance(simulated, ForwardSimulation):
            return answer
        residuals = judged_residuals(experiment, simulated.trajectory.predicted)
        lengths = np.linalg.norm(residuals.values, axis=2)
        squares.append(lengths[residuals.is_counted] ** 2)
        if part is first:
            means = np.nanmean(np.where(residuals.is_counted, lengths**2, np.nan), axis=1)
            answer |= {"unit": residuals.unit, "simulation": (residuals.t_s, np.sqrt(means))}
    return answer | {"forward": float(np.sqrt(np.concatenate(squares).mean()))}


def _end_with_study() -> None:
    """Wait until stdin is closed, and end the process at once, without any clean-up."""
    os.read(0, 1)  # returns when the other end is closed
    os._exit(1)
