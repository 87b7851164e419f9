"""Progress display of a study in the terminal, with the remaining time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Self

from rich.console import Console

from ...common.display import duration
from ...result.solve_progress import SolveProgress
from .planning import PlannedRun
from .run_execution import Record

# Processor time of a run before its search [s]: start of its process, imports and reading.
RUN_START_S = 2.7
# Time of a run with its scan and checks over the expected time of its search: 0.3 to 6 for templates
# of specimens, benches and swings; 10 and 50 for laws whose constants the swing does not determine.
FIT_FACTOR = 4.0
# Factor by which a comparison of models may take less or more time than `expected_study_s`: 0.6 to
# 1.7 were measured for templates of a specimen, a bench and a swing, on a busy machine.
STUDY_FACTOR = 2.0
# Largest slowness of a machine that counts.
LARGEST_SLOWNESS = 5.0


class StudyProgress(SolveProgress):
    """Progress of a study: one updated line on a terminal, else a line per run and from time to
    time.

    Parameters
    ----------
    console : Console
        Terminal.
    remaining : sequence of PlannedRun
        Runs that are not finished yet.
    total : int
        Number of all runs, finished ones included.
    quiet : bool
        Whether to show nothing.
    """

    def __init__(
        self, console: Console, remaining: Sequence[PlannedRun], total: int, quiet: bool = False
    ) -> None:
        self.total = total
        self._skipped = total - len(remaining)
        self._waiting = {run.key: run for run in remaining}
        self._walls: dict[str, list[float]] = {}
        super().__init__(console, quiet=quiet, activity=f"{self._skipped}/{total} runs")

    def __enter__(self) -> Self:
        if self._skipped:
            self.line(f"{self._skipped} of {self.total} runs are finished already")
        super().__enter__()
        self.say(f"{self._skipped}/{self.total} runs")
        if self._live is not None:
            self._live.refresh()  # the first run may take less time than a frame
        return self

    def count_run(self, record: Record, worker_count: int) -> None:
        """Count a finished run and update the display.

        Parameters
        ----------
        record : Record
            Record of one of the remaining runs, which has not been counted yet, with "key" and
            "outcome".
        worker_count : int
            Number of runs that are executed at once.

        Raises
        ------
        KeyError
            If the run is not among the remaining ones.
        """
        run = self._waiting.pop(record["key"])
        if record.get("wall_s") is not None:
            self._walls.setdefault(run.method, []).append(record["wall_s"])
        status = (record.get("result") or record).get("status", record["outcome"])
        count = f"{self.total - len(self._waiting)}/{self.total} runs"
        wall = record.get("wall_s") or 0.0
        self.announce(
            f"{count}: {run.make_label()} {status} in {wall:.1f} s{self._remaining_text(worker_count)}"
        )

    def _remaining_text(self, worker_count: int) -> str:
        """Return "; about … left" with a duration, from the times of finished runs and the number
        of runs at once; empty if no run waits or none has finished.
        """
        remaining_s = remaining_time_s(
            [run.method for run in self._waiting.values()], self._walls, worker_count=worker_count
        )
        return "" if remaining_s is None else f"; about {duration(remaining_s)} left"


def expected_study_s(
    searches_s: Sequence[float | None], count: int, worker_count: int, slowness: float = 1.0
) -> float | None:
    """Return the expected time of a comparison of models before any run [s]; None without the
    expected time of any search.

    Parameters
    ----------
    searches_s : sequence of float or None
        Expected time of the search of each model [s]; None if it is not known.
    count : int
        Number of runs.
    worker_count : int
        Number of runs that are executed at once.
    slowness : float
        Elapsed time over processor time, with which the searches were measured: more than 1 if
        other programs use the processors. Values beyond 1 and `LARGEST_SLOWNESS` do not count.
    """
    start_s = RUN_START_S * min(max(1.0, slowness), LARGEST_SLOWNESS)
    each_s = [start_s + FIT_FACTOR * search for search in searches_s if search is not None]
    return remaining_time_s(count * ["fit"], {"fit": each_s} if each_s else {}, worker_count)


def remaining_time_s(
    waiting: Sequence[str], walls: Mapping[str, Sequence[float]], worker_count: int
) -> float | None:
    """Return the estimated time for the waiting runs [s]; None if no run waits or none has
    finished.

    A run is expected to take the mean time of its method, or of all runs if its method has none.
    The estimate is the sum divided by the number of runs at once, but at least the longest expected
    time.

    Parameters
    ----------
    waiting : sequence of str
        Method of each waiting run.
    walls : mapping of str to sequence of float
        Durations of the finished runs by method [s], at least one for each method that is a key.
    worker_count : int
        Number of runs that are executed at once.
    """
    every = [wall for of_method in walls.values() for wall in of_method]
    if not waiting or not every:
        return None
    overall = sum(every) / len(every)
    means = {method: sum(of_method) / len(of_method) for method, of_method in walls.items()}
    expected = [means.get(method, overall) for method in waiting]
    return max(sum(expected) / worker_count, max(expected))
