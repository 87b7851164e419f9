"""Where the experiments of a search are: in this process, or on the workers of a cluster.

What is done for each experiment stays where it was done, as a value here or as a dask future on a
worker, until it is fetched. Should a worker be lost, dask does again on another what led to it.
"""

from __future__ import annotations

import ctypes
import secrets
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields
from functools import cache
from importlib.metadata import version
from typing import Any, Protocol, TypeVar
from weakref import WeakKeyDictionary

from ..cluster import connected, distributed
from ..errors import InputError
from ..fem.body import Body
from ..fem.kernels import alone, side_by_side
from ..files import reason
from ..program.charts import Chart
from ..program.collocation import Collocation
from ..program.segment import Segment
from ..recording.experiment import Experiment
from .recorder import Ended
from .solution import Status

T = TypeVar("T")
# How often it is looked whether there are workers at all.
LOOK_EVERY_S = 10
# glibc's M_TRIM_THRESHOLD and M_MMAP_THRESHOLD, and the most that it raises them to by itself.
KEPT_BYTES = {-1: 64 * 2**20, -3: 32 * 2**20}


class Workers(Protocol):
    """Who works on the experiments. What is kept is a list, with an entry of each."""

    def hold(self, collocation: Collocation) -> list[Any]:
        """Keep the segments."""
        ...

    def each(self, run: Callable[..., Any], *columns: Sequence[Any]) -> list[Any]:
        """Keep ``run(…)`` of every experiment; entries of columns may be what is kept."""
        ...

    def fetch(self, kept: Sequence[Any]) -> list[Any]:
        """What is kept; raises what it raised."""
        ...

    def notes(self) -> list[str]:
        """What the user should know of them."""
        ...


class Here:
    """Threads of this process, see `side_by_side`."""

    def __init__(self, threads: int) -> None:
        self.threads = threads

    def hold(self, collocation: Collocation) -> list[Any]:
        """See `Workers`."""
        return list(collocation.segments)

    def each(self, run: Callable[..., Any], *columns: Sequence[Any]) -> list[Any]:
        """See `Workers`."""
        return side_by_side(lambda row: run(*row), [*zip(*columns, strict=True)], self.threads)

    def fetch(self, kept: Sequence[Any]) -> list[Any]:
        """See `Workers`."""
        return list(kept)

    def notes(self) -> list[str]:
        """See `Workers`."""
        return []


class OnCluster:
    """Workers of a dask cluster, each experiment on one of them.

    Parameters
    ----------
    client : distributed.Client

    Raises
    ------
    InputError
        If there are no workers, or they have not this version of the package.
    """

    def __init__(self, client: Any) -> None:
        self.client = client
        self._sent: WeakKeyDictionary[object, Any] = WeakKeyDictionary()
        self._homes: list[str] = []
        self._first = _require_package(client)

    def hold(self, collocation: Collocation) -> list[Any]:
        """See `Workers`; bodies and experiments are sent once."""
        segments = collocation.segments
        with self._unless_lost():
            known = all(segment.experiment in self._sent for segment in segments)
            if not known or len(self._homes) != len(segments):
                costs = [segment.variables for segment in segments]
                self._homes = _shared_out(costs, self.client.nthreads())
            return [self._segment(s, home) for s, home in zip(segments, self._homes, strict=True)]

    def each(self, run: Callable[..., Any], *columns: Sequence[Any]) -> list[Any]:
        """See `Workers`."""
        rows = zip(self._homes, *columns, strict=True)
        with self._unless_lost():
            return [self._submit(home, run, *row) for home, *row in rows]

    def fetch(self, kept: Sequence[Any]) -> list[Any]:
        """See `Workers`.

        Raises
        ------
        Ended
            If the scheduler or all workers are gone, or an experiment ends those that it is
            given to.
        """
        with self._unless_lost():
            return [self._result(future) for future in kept]

    def notes(self) -> list[str]:
        """See `Workers`."""
        with self._unless_lost():
            gone = self._first - self.client.nthreads().keys()
        said = f"{len(gone)} of {len(self._first)} workers were lost on the way: "
        return [f"{said}what they had was done again on others"] if gone else []

    def _result(self, future: Any) -> Any:
        while True:
            try:
                return future.result(timeout=LOOK_EVERY_S)
            except distributed().TimeoutError:
                _require_some(self.client.nthreads())

    @contextmanager
    def _unless_lost(self) -> Iterator[None]:
        """End the search where the cluster is gone."""
        dask = distributed()
        try:
            yield
        except dask.scheduler.KilledWorker as error:
            raise _lost("A recording ended every worker that had it: mind their memory.") from error
        except (Exception, dask.client.CancelledError) as error:
            cut = isinstance(error, (OSError, dask.client.CancelledError))
            if isinstance(error, Ended) or (self.client.status == "running" and not cut):
                raise
            raise _lost("Its scheduler answers no more.") from error

    def _submit(self, home: str, run: Callable[..., Any], *arguments: Any) -> Any:
        # By the name of the function dask knows how long such tasks take.
        key = f"{run.__name__}-{secrets.token_hex(16)}"
        return self.client.submit(
            _done, run, *arguments, key=key, workers=[home], allow_other_workers=True
        )

    def _segment(self, segment: Segment, home: str) -> Any:
        def once(thing: T, make: Callable[[T], Any]) -> Any:
            if thing not in self._sent:
                self._sent[thing] = make(thing)
            return self._sent[thing]

        def experiment(given: Experiment) -> Any:
            return self._submit(home, _with_body, _bare(given), once(given.body, body))

        def body(given: Body) -> Any:
            return self._submit(home, _itself, given)

        def whole(given: Segment) -> Any:
            sent, chart = once(given.experiment, experiment), _bare(given.chart)
            rest = {
                n: v for n, v in given.__getstate__().items() if n not in ("experiment", "chart")
            }
            return self._submit(home, _segment_of, sent, chart, rest)

        return once(segment, whole)


@contextmanager
def workers_of(scheduler: str | None) -> Iterator[OnCluster | None]:
    """The workers of the scheduler at an address; None where there is none.

    Raises
    ------
    InputError
        As `connected` and `OnCluster` do.
    """
    if scheduler is None:
        yield None
        return
    with connected(scheduler) as client:
        yield OnCluster(client)


def _shared_out(costs: Sequence[int], threads: dict[str, int]) -> list[str]:
    """The worker of each experiment: the costliest first, each to the thread with least to do."""
    _require_some(threads)
    slots = [(address, k) for address, count in threads.items() for k in range(count)]
    loads, homes = dict.fromkeys(slots, 0), [""] * len(costs)
    for number in sorted(range(len(costs)), key=lambda k: -costs[k]):
        slot = min(loads, key=lambda slot: (loads[slot], slot[1]))
        loads[slot] += costs[number]
        homes[number] = slot[0]
    return homes


def _require_package(client: Any) -> set[str]:
    """The workers; those without this version are refused."""
    ours = version("collocation-sysid")
    try:
        versions = client.run(_version, on_error="return")
    except (Exception, distributed().client.CancelledError) as error:
        raise _refusal(
            f"the scheduler stopped answering while its workers were asked for their versions "
            f"({reason(error)}); start it again"
        ) from error
    if not versions:
        raise _refusal("the scheduler has no workers; start some, as with dask worker ADDRESS")
    for address, theirs in versions.items():
        if theirs != ours:
            raise _refusal(
                f"found {theirs!r} on the worker {address}; expected collocation-sysid {ours}"
            )
    return set(versions)


def _refusal(message: str) -> InputError:
    return InputError(message, None, "--scheduler")


def _require_some(threads: dict[str, int]) -> None:
    if not threads:
        raise _lost("No worker is left.")


def _lost(why: str) -> Ended:
    return Ended(Status.CLUSTER_LOST, f"{Status.CLUSTER_LOST.sentence} {why}")


# On the workers -----------------------------------------------------------------------------------


def _version() -> str:
    return version("collocation-sysid")


def _done(run: Callable[..., T], *arguments: Any) -> T:
    """``run(*arguments)`` on a worker's thread."""
    _keep_freed()
    return alone(run, *arguments)


@cache
def _keep_freed() -> None:
    """Let this process keep the memory of arrays that come and go.

    dask's nannies set MALLOC_TRIM_THRESHOLD_, by which glibc gives every freed array back to the
    system, and never learns not to: a sweep then waits for its pages to come again.
    """
    if mallopt := getattr(ctypes.pythonapi, "mallopt", None):  # glibc's only
        for option, size in KEPT_BYTES.items():
            mallopt(option, size)


def _itself(thing: T) -> T:
    return thing


def _bare(thing: T, body: Body | None = None) -> T:
    """The fields of an experiment or a chart, with another body, or none for the way."""
    stated = {field.name: getattr(thing, field.name) for field in fields(thing)}  # pyright: ignore[reportArgumentType]
    other = object.__new__(type(thing))
    vars(other).update(stated | {"body": body})
    return other


def _with_body(experiment: Experiment, body: Body) -> Experiment:
    return _bare(experiment, body)


def _segment_of(experiment: Experiment, chart: Chart, rest: dict[str, Any]) -> Segment:
    return Segment(experiment, chart=_bare(chart, experiment.body), **rest)
