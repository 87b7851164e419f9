"""Waiting times of commands at the terminal."""

from __future__ import annotations

import tempfile
from pathlib import Path

from benchmark_waiting import PROBLEM, Waited, waited


class Commands:
    """Whole commands, with kernels that are compiled already."""

    timeout = 600

    def setup_cache(self) -> dict[str, Waited]:
        """Run each once, after one that compiles."""
        with tempfile.TemporaryDirectory() as place:
            run, cache = (str(Path(place) / name) for name in ("run", "cache"))
            words = ["solve", str(PROBLEM), "--out", run]
            first = waited(words, cache)
            return {
                "first solve": first,
                "solve": waited(words, cache),
                "help": waited(["--help"], cache),
            }

    def track_first_solve_s(self, times: dict[str, Waited]) -> float:
        """Wall time of the first solve of an installation, kernels included [s]."""
        return times["first solve"].wall_s

    def track_solve_s(self, times: dict[str, Waited]) -> float:
        """Wall time of a solve with compiled kernels [s]."""
        return times["solve"].wall_s

    def track_first_text_of_solve_s(self, times: dict[str, Waited]) -> float:
        """Time to the first text of a solve with compiled kernels [s]."""
        return times["solve"].first_s

    def track_help_processor_s(self, times: dict[str, Waited]) -> float:
        """Processor time of the help text [s]."""
        return times["help"].processor_s
