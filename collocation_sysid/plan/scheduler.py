"""Runs side by side: on this machine's cores, or on a cluster through dask.distributed.

A worker of either kind only starts and watches the run's own process (`process.execute`): a time
limit or a segmentation fault costs that run alone.
"""

from __future__ import annotations

import secrets
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from ..cluster import connected, distributed
from ..errors import InputError
from ..fem.kernels import available_threads
from .process import CRASHED, STOPPED, Record, RunStore, execute
from .study import PlannedRun


@dataclass(frozen=True)
class RunOptions:
    """How the runs of a study are done.

    Attributes
    ----------
    workers : int
        Runs at once; as many as there are cores by default.
    scheduler : ADDRESS
        A dask.distributed scheduler to run on; its workers see the same files.
    time_limit_s : --time-limit SECONDS
        A run is ended after this, loading included; it counts as a failure.
    """

    workers: int | None = None
    scheduler: str | None = None
    time_limit_s: float | None = None

    def __post_init__(self) -> None:
        if self.workers is not None and self.workers < 1:
            raise InputError(f"found {self.workers}; expected 1 or more", None, "--workers")
        if self.workers is not None and self.scheduler is not None:
            raise InputError(
                "the scheduler has workers of its own; leave out one of the two",
                None,
                "--workers and --scheduler",
            )
        if self.time_limit_s is not None and not self.time_limit_s > 0:
            raise InputError(
                f"found {self.time_limit_s:g}; expected a number of seconds above 0",
                None,
                "--time-limit",
            )


@dataclass(frozen=True)
class Pool:
    """Where runs are done.

    Attributes
    ----------
    submit : function of a planned run, gives the future of its record
    slots : int, runs at once
    stop : function that ends the runs that are going on
    """

    submit: Callable[[PlannedRun], Future]
    slots: int
    stop: Callable[[], Any]


def run_all(
    planned: Sequence[PlannedRun],
    store: RunStore,
    limits: RunOptions,
    done: Callable[[Record, int], None] = lambda record, slots: None,
) -> None:
    """Do the runs that are not in the store and put them there, each as soon as it has ended.

    Parameters
    ----------
    planned : sequence of PlannedRun, started in this order
    store : RunStore
    limits : RunOptions
    done : callable
        Called with every new record and the number of runs at once.

    Raises
    ------
    InputError
        If the scheduler cannot be had.
    KeyboardInterrupt
        After the runs that are going on were ended; finished ones are in the store.
    """
    if not planned:
        return
    with (_cluster if limits.scheduler else _threads)(limits) as pool:
        futures = {pool.submit(run): run for run in planned}
        try:
            for future in as_completed(futures):
                record = _record_of(future, futures[future], limits)
                if record["outcome"] != STOPPED:
                    store.save(record)
                    done(record, pool.slots)
        except BaseException:
            for future in futures:
                future.cancel()
            pool.stop()
            raise


def _record_of(future: Future, planned: PlannedRun, limits: RunOptions) -> Record:
    """A run's record, also when the worker that watched it is lost."""
    try:
        return future.result()
    except Exception as error:
        return {
            **planned.as_dict(),
            "outcome": CRASHED,
            "message": f"its worker was lost ({type(error).__name__}: {error})",
            "attempts": 1,
            "time_limit_s": limits.time_limit_s,
            "wall_s": None,
        }


@contextmanager
def _threads(limits: RunOptions) -> Iterator[Pool]:
    """Threads that wait for processes: all that one machine needs."""
    slots, stop = limits.workers or available_threads(), threading.Event()
    with ThreadPoolExecutor(slots) as executor:

        def submit(run: PlannedRun) -> Future:
            return executor.submit(execute, run.as_dict(), limits.time_limit_s, stop.is_set)

        yield Pool(submit, slots, stop.set)


@contextmanager
def _cluster(limits: RunOptions) -> Iterator[Pool]:
    """The workers of a scheduler that is there."""
    flag = f"collocation-sysid-stop-{secrets.token_hex(8)}"
    with connected(limits.scheduler) as client:
        stop = distributed().Event(flag, client=client)
        with client.get_executor(pure=False) as executor:

            def submit(run: PlannedRun) -> Future:
                return executor.submit(_on_worker, run.as_dict(), limits.time_limit_s, flag)

            yield Pool(submit, max(1, sum(client.nthreads().values())), stop.set)


def _on_worker(planned: dict[str, Any], time_limit_s: float | None, flag: str) -> Record:
    return execute(planned, time_limit_s, distributed().Event(flag).is_set)
