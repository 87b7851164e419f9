"""A dask.distributed cluster that is there already, by its scheduler's address."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from importlib.util import find_spec
from typing import Any

from .errors import InputError

CONNECT_WITHIN_S = 15


@contextmanager
def connected(scheduler: Any) -> Iterator[Any]:
    """A client of a scheduler, by its address or as a cluster of this process.

    Raises
    ------
    InputError
        Without dask.distributed, or where no scheduler answers.
    """
    dask = distributed()
    try:
        client = dask.Client(scheduler, timeout=CONNECT_WITHIN_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(
            f"found {scheduler!r}, where no scheduler answers ({error}); expected an "
            "address such as tcp://10.0.0.5:8786",
            None,
            "--scheduler",
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
    """The library.

    Raises
    ------
    InputError
        Without it.
    """
    if find_spec("distributed") is None:
        raise InputError(
            "a scheduler needs dask.distributed: pip install 'collocation-sysid[cluster]', or "
            "leave it out to run on this machine's cores",
            None,
            "--scheduler",
        )
    return import_module("distributed")
