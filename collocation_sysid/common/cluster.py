"""Connection to a running dask.distributed cluster."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from importlib.util import find_spec
from typing import Any

from ..errors import InputError

# Longest time for a connection to a scheduler [s]; one that runs answers much faster.
CONNECT_WITHIN_S = 15


@contextmanager
def connected(scheduler: Any) -> Iterator[Any]:
    """Connect to a scheduler and yield the client, which is closed at the end of the block.

    While the block runs, an error of closing is ignored if the block has failed, so that the first
    error is the one reported. From then on messages of `distributed.client` below the level
    "critical" are not logged.

    Parameters
    ----------
    scheduler : str or Cluster
        Address of a scheduler, or a cluster object of this process.

    Raises
    ------
    InputError
        If dask.distributed is not installed, or no scheduler answers within `CONNECT_WITHIN_S`.
    """
    dask = distributed()
    try:
        client = dask.Client(scheduler, timeout=CONNECT_WITHIN_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(
            f"found {scheduler!r}, where no scheduler answers ({error}); expected an "
            "address such as tcp://10.0.0.5:8786",
            None,
            where="--scheduler",
        ) from error
    # What it logs of a scheduler that was lost is said by the one message of the command.
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
    try:
        yield client
    except BaseException:
        with suppress(Exception):  # of a scheduler that was lost, which is not the reason
            client.close()
        raise
    client.close()


def distributed() -> Any:
    """Import and return the module `distributed` of dask.distributed.

    Raises
    ------
    InputError
        If it is not installed.
    """
    if find_spec("distributed") is None:
        raise InputError(
            "a scheduler needs dask.distributed: pip install 'collocation-sysid[cluster]', or "
            "leave it out to run on this machine's cores",
            None,
            where="--scheduler",
        )
    return import_module("distributed")
