"""Waiting times of commands at the terminal."""

from __future__ import annotations

import tempfile
from pathlib import Path

from benchmark_waiting import PROBLEM, WaitingTimes, time_command


class Commands:
    """Complete commands with compiled kernels."""

    timeout = 600

    def setup_cache(self) -> dict[str, WaitingTimes]:
        """Run each command once, after a solve that compiles the kernels."""
        with tempfile.TemporaryDirectory() as folder:
            run, cache = (str(Path(folder) / name) for name in ("run", "cache"))
            arguments = ["solve", str(PROBLEM), "--out", run]
            first_solve = time_command(arguments, cache)
            return {
                "first solve": first_solve,
                "solve": time_command(arguments, cache),
                "help": time_command(["--help"], cache),
            }

    def track_first_solve_s(self, times: dict[str, WaitingTimes]) -> float:
        """Return the wall time of the first solve of an installation, kernels included [s]."""
        return times["first solve"].wall_s

    def track_solve_s(self, times: dict[str, WaitingTimes]) -> float:
        """Return the wall time of a solve with compiled kernels [s]."""
        return times["solve"].wall_s

    def track_first_text_of_solve_s(self, times: dict[str, WaitingTimes]) -> float:
        """Return the time to the first text of a solve with compiled kernels [s]."""
        return times["solve"].first_s

    def track_help_processor_s(self, times: dict[str, WaitingTimes]) -> float:
        """Return the processor time of the help text [s]."""
        return times["help"].processor_s
