"""Where the experiments of a search are: in this process, or on the workers of a cluster.

What is done for each experiment stays where it was done, as a value here or as a dask future on a
worker, until it is fetched. Should a worker be lost, dask does again on another what led to it.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields
from importlib.metadata import version
from typing import Any, Protocol, TypeVar
from weakref import WeakKeyDictionary

from ..cluster import connected, distributed
from ..errors import InputError
from ..fem.body import Body
from ..fem.kernels import alone, side_by_side
from ..program.charts import Chart
from ..program.collocation import Collocation
from ..program.segment import Segment
from ..recording.experiment import Experiment

T = TypeVar("T")
# How often it is looked whether there are workers at all.
LOOK_EVERY_S = 10


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
        _require_package(client)

    def hold(self, collocation: Collocation) -> list[Any]:
        """See `Workers`; bodies and experiments are sent once."""
        segments = collocation.segments
        known = all(segment.experiment in self._sent for segment in segments)
        if not known or len(self._homes) != len(segments):
            costs = [segment.variables for segment in segments]
            self._homes = _shared_out(costs, self.client.nthreads())
        return [self._segment(s, home) for s, home in zip(segments, self._homes, strict=True)]

    def each(self, run: Callable[..., Any], *columns: Sequence[Any]) -> list[Any]:
        """See `Workers`."""
        rows = zip(self._homes, *columns, strict=True)
        return [self._submit(home, run, *row) for home, *row in rows]

    def fetch(self, kept: Sequence[Any]) -> list[Any]:
        """See `Workers`.

        Raises
        ------
        InputError
            If all workers are gone, or an experiment ends those that it is given to.
        """
        dask = distributed()
        lost = dask.scheduler.KilledWorker, dask.client.FutureCancelledError, OSError
        try:
            return [self._result(future, dask.TimeoutError) for future in kept]
        except lost as error:
            said = f"the cluster was lost ({type(error).__name__}: {error})"
            raise _refusal(said) from error

    def _result(self, future: Any, late: type[Exception]) -> Any:
        while True:
            try:
                return future.result(timeout=LOOK_EVERY_S)
            except late:
                if not self.client.nthreads():
                    raise _refusal("the cluster was lost (no worker is left)") from None

    def _submit(self, home: str, run: Callable[..., Any], *arguments: Any) -> Any:
        # By the name of the function dask knows how long such tasks take.
        key = f"{run.__name__}-{secrets.token_hex(16)}"
        return self.client.submit(
            alone, run, *arguments, key=key, workers=[home], allow_other_workers=True
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
    slots = [(address, k) for address, count in threads.items() for k in range(count)]
    if not slots:
        raise _refusal("the scheduler has no workers")
    loads, homes = dict.fromkeys(slots, 0), [""] * len(costs)
    for number in sorted(range(len(costs)), key=lambda k: -costs[k]):
        slot = min(loads, key=lambda slot: (loads[slot], slot[1]))
        loads[slot] += costs[number]
        homes[number] = slot[0]
    return homes


def _require_package(client: Any) -> None:
    """Refuse workers without this version."""
    ours = version("collocation-sysid")
    found = client.run(_version, on_error="return")
    if not found:
        raise _refusal("the scheduler has no workers; start some, as with dask worker ADDRESS")
    for address, theirs in found.items():
        if theirs != ours:
            raise _refusal(
                f"found {theirs!r} on the worker {address}; expected collocation-sysid {ours}"
            )


def _refusal(message: str) -> InputError:
    return InputError(message, None, "--scheduler")


# On the workers -----------------------------------------------------------------------------------


def _version() -> str:
    return version("collocation-sysid")


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
