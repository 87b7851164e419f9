"""Executors for the experiments of a search: threads of this process, or workers of a Dask cluster.

Results for each experiment stay where they were computed, as values in this process or as Dask
futures on a worker, until they are fetched. If a worker is lost, Dask repeats its computations on
another.
"""

from __future__ import annotations

import ctypes
import secrets
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields, replace
from functools import cache, partial
from typing import Any, Protocol, TypeVar
from weakref import WeakKeyDictionary

from ..common.cluster import connected, distributed
from ..common.files import reason
from ..common.installation import package_version
from ..errors import InputError
from ..fem.body import Body
from ..fem.kernels import map_experiments, run_single_threaded
from ..program.association import Association
from ..program.collocation import Collocation
from ..program.transcription import Transcription
from ..recording.experiment import Experiment
from .solution import Status
from .solve_recorder import SearchEnded

T = TypeVar("T")
# How often it is looked whether there are workers at all.
LOOK_EVERY_S = 10
# glibc's M_TRIM_THRESHOLD and M_MMAP_THRESHOLD, and the most that it raises them to by itself.
MALLOC_LIMITS_BYTES = {-1: 64 * 2**20, -3: 32 * 2**20}


class ExperimentExecutor(Protocol):
    """Protocol of executors, which apply functions to experiments.

    Stored values are lists with one entry per experiment, of a type that only the executor knows.
    """

    def store_segments(self, collocation: Collocation) -> list[Any]:
        """Store the transcriptions of the fitted experiments of a problem, and return them as
        stored values, in their order.
        """
        ...

    def map_experiments(self, run: Callable[..., Any], *columns: Sequence[Any]) -> list[Any]:
        """Apply a function to every experiment, and return the results as stored values.

        An exception of the function is raised here or by `fetch`.

        Parameters
        ----------
        run : callable
            Function of one entry of each column.
        columns : sequence
            Arguments, one entry per experiment each; entries may be stored values.
        """
        ...

    def fetch(self, stored: Sequence[Any]) -> list[Any]:
        """Return stored values as values in this process; raise the exception of a function
        that failed.
        """
        ...

    def notes(self) -> list[str]:
        """Return remarks for the user, for example on lost workers; empty if there are none."""
        ...


class LocalExecutor:
    """Executor with threads of this process, see `ExperimentExecutor`.

    Attributes
    ----------
    map_experiments : callable
        `fem.kernels.map_experiments` with these threads: results are the values themselves, and
        an exception of the function is raised.
    """

    def __init__(self, threads: int) -> None:
        self.map_experiments = partial(map_experiments, threads=threads)

    def store_segments(self, collocation: Collocation) -> list[Any]:
        """Return the transcriptions of the fitted experiments themselves, in a new list."""
        return list(collocation.transcriptions)

    def fetch(self, stored: Sequence[Any]) -> list[Any]:
        """Return the stored values themselves, in a new list."""
        return list(stored)

    def notes(self) -> list[str]:
        """Return no remarks: threads cannot be lost."""
        return []


class DaskExecutor:
    """Executor with the workers of a Dask cluster; each experiment stays on one of them.

    Parameters
    ----------
    client : distributed.Client
        Client of the scheduler.

    Raises
    ------
    InputError
        If there are no workers, or they have another version of the package.
    """

    def __init__(self, client: Any) -> None:
        self.client = client
        self._sent: WeakKeyDictionary[object, Any] = WeakKeyDictionary()
        self._homes: list[str] = []
        self._first = _require_package(client)

    def store_segments(self, collocation: Collocation) -> list[Any]:
        """Return futures of the transcriptions on the workers, which are chosen at the first call;
        each body and experiment is sent only once.

        Raises
        ------
        SearchEnded
            If the scheduler or all workers are lost.
        """
        transcriptions = collocation.transcriptions
        with self._end_search_if_disconnected():
            known = all(transcription.experiment in self._sent for transcription in transcriptions)
            if not known or len(self._homes) != len(transcriptions):
                costs = [transcription.variable_count for transcription in transcriptions]
                self._homes = _assign_workers(costs, self.client.nthreads())
            return [
                self._send_segment(s, home)
                for s, home in zip(transcriptions, self._homes, strict=True)
            ]

    def map_experiments(self, run: Callable[..., Any], *columns: Sequence[Any]) -> list[Any]:
        """Apply a function to every experiment on its worker, and return futures of the results at
        once; `store_segments` must have been called. Exceptions of the function are raised by
        `fetch`.

        Parameters
        ----------
        run : callable
            Function of one entry of each column.
        columns : sequence
            Arguments, one entry per experiment each; entries may be futures.

        Raises
        ------
        SearchEnded
            If the scheduler is lost.
        """
        rows = zip(self._homes, *columns, strict=True)
        with self._end_search_if_disconnected():
            return [self._submit(home, run, *row) for home, *row in rows]

    def fetch(self, stored: Sequence[Any]) -> list[Any]:
        """Return stored values as values in this process, see `ExperimentExecutor`.

        Raises
        ------
        SearchEnded
            If the scheduler or all workers are lost, or an experiment terminates every worker that
            processes it.
        """
        with self._end_search_if_disconnected():
            return [self._result(future) for future in stored]

    def notes(self) -> list[str]:
        """Return a note for the user if workers were lost during the solve, as a list; else
        empty.

        Raises
        ------
        SearchEnded
            If the scheduler is lost.
        """
        with self._end_search_if_disconnected():
            failed_workers = self._first - self.client.nthreads().keys()
        note = f"{len(failed_workers)} of {len(self._first)} workers were lost during the solve: "
        return (
            [f"{note}their recordings were computed again by other workers"]
            if failed_workers
            else []
        )

    def _result(self, future: Any) -> Any:
        """Check every `LOOK_EVERY_S` that workers exist; raise `SearchEnded` otherwise."""
        while True:
            try:
                return future.result(timeout=LOOK_EVERY_S)
            except distributed().TimeoutError:
                _require_workers(self.client.nthreads())
            except UnboundLocalError as lost:  # Dask's `sync` where the future is cancelled
                _require_workers(self.client.nthreads())
                raise distributed().client.CancelledError(future.key) from lost

    @contextmanager
    def _end_search_if_disconnected(self) -> Iterator[None]:
        """Context that raises `SearchEnded` instead of Dask's exceptions if the cluster is lost."""
        dask = distributed()
        try:
            yield
        except dask.scheduler.KilledWorker as error:
            raise _disconnection(
                "One of the recordings terminated every worker that computed it: check the memory of "
                "the workers."
            ) from error
        except (Exception, dask.client.CancelledError) as error:
            is_disconnected = isinstance(error, (OSError, dask.client.CancelledError))
            if isinstance(error, SearchEnded) or (
                self.client.status == "running" and not is_disconnected
            ):
                raise
            raise _disconnection("The scheduler no longer responds.") from error

    def _submit(self, home: str, run: Callable[..., Any], *arguments: Any) -> Any:
        """Return a future on the worker at `home`; Dask may choose another if that is lost."""
        # Keys begin with the function's name, from which Dask estimates the duration of a task.
        key = f"{run.__name__}-{secrets.token_hex(16)}"
        return self.client.submit(
            _run_alone, run, *arguments, key=key, workers=[home], allow_other_workers=True
        )

    def _send_segment(self, transcription: Transcription, home: str) -> Any:
        """Return the future of a transcription; each object is sent only once."""

        def send_once(value: T, make: Callable[[T], Any]) -> Any:
            if value not in self._sent:
                self._sent[value] = make(value)
            return self._sent[value]

        def send_body(body: Body) -> Any:
            return self._submit(home, _identity, body)

        def send_experiment(experiment: Experiment) -> Any:
            return self._submit(
                home, _with_body, _with_fields(experiment), send_once(experiment.body, send_body)
            )

        def send_transcription(complete: Transcription) -> Any:
            sent_experiment = send_once(complete.experiment, send_experiment)
            association = replace(
                complete.association, markers=_with_fields(complete.association.markers)
            )
            rest = {
                name: value
                for name, value in complete.__getstate__().items()
                if name not in ("experiment", "association")
            }
            return self._submit(home, _restore_segment, sent_experiment, association, rest)

        return send_once(transcription, send_transcription)


@contextmanager
def connect_executor(scheduler: str | None) -> Iterator[DaskExecutor | None]:
    """Context with an executor on the scheduler at an address; None if the address is None.

    Raises
    ------
    InputError
        If the connection fails or the workers do not fit, see `connected` and `DaskExecutor`.
    """
    if scheduler is None:
        yield None
        return
    with connected(scheduler) as client:
        yield DaskExecutor(client)


def _assign_workers(costs: Sequence[int], threads: dict[str, int]) -> list[str]:
    """Return the worker of each experiment: the costliest first, to the least loaded."""
    _require_workers(threads)
    threads_of_workers = [(address, k) for address, count in threads.items() for k in range(count)]
    loads = dict.fromkeys(threads_of_workers, 0)
    homes = [""] * len(costs)
    for number in sorted(range(len(costs)), key=lambda k: -costs[k]):
        slot = min(loads, key=lambda slot: (loads[slot], slot[1]))
        loads[slot] += costs[number]
        homes[number] = slot[0]
    return homes


def _require_package(client: Any) -> set[str]:
    """Return the addresses of the workers, after a check of their versions."""
    own_version = package_version()
    try:
        versions = client.run(package_version, on_error="return")
    except (Exception, distributed().client.CancelledError) as error:
        raise _refusal(
            f"the scheduler stopped answering while its workers were asked for their versions "
            f"({reason(error)}); start it again"
        ) from error
    if not versions:
        raise _refusal("the scheduler has no workers; start some, as with dask worker ADDRESS")
    for address, worker_version in versions.items():
        if worker_version != own_version:
            raise _refusal(
                f"found collocation-sysid {worker_version} on the worker {address}; expected "
                f"{own_version}, the version on this machine: install it there"
            )
    return set(versions)


def _refusal(message: str) -> InputError:
    return InputError(message, None, where="--scheduler")


def _require_workers(threads: dict[str, int]) -> None:
    if not threads:
        raise _disconnection("No worker is left.")


def _disconnection(reason: str) -> SearchEnded:
    return SearchEnded(
        Status.CLUSTER_DISCONNECTED, f"{Status.CLUSTER_DISCONNECTED.sentence} {reason}"
    )


# On the workers -----------------------------------------------------------------------------------


def _run_alone(run: Callable[..., T], *arguments: Any) -> T:
    """Return `run(*arguments)`, computed on a worker's thread without further threads."""
    _retain_freed_memory()
    return run_single_threaded(run, *arguments)


@cache
def _retain_freed_memory() -> None:
    """Let the C library keep freed memory of this process for later arrays."""
    # Dask's nannies set MALLOC_TRIM_THRESHOLD_, so that glibc returns every freed array to the
    # system; each sweep would then wait for new memory pages. No effect with other C libraries.
    if mallopt := getattr(ctypes.pythonapi, "mallopt", None):  # glibc's only
        for option, size in MALLOC_LIMITS_BYTES.items():
            mallopt(option, size)


def _identity(value: T) -> T:
    """Return the argument; workers run it to store an object."""
    return value


def _with_fields(instance: T, body: Body | None = None) -> T:
    """Return a copy with another body, without validation; None removes it for transfer."""
    names = [each.name for each in fields(instance)]  # pyright: ignore[reportArgumentType]
    field_values = {name: getattr(instance, name) for name in names}
    other = object.__new__(type(instance))
    vars(other).update(field_values | {"body": body})
    return other


def _with_body(experiment: Experiment, body: Body) -> Experiment:
    """Return the experiment with its body; workers run this function."""
    return _with_fields(experiment, body)


def _restore_segment(
    experiment: Experiment, association: Association, rest: dict[str, Any]
) -> Transcription:
    """Return a transcription from its parts; workers run this function."""
    markers = _with_fields(association.markers, experiment.body)
    return Transcription(experiment, association=replace(association, markers=markers), **rest)
