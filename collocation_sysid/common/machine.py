"""Memory that this machine, or a container or limit, leaves to this process."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

# Where containers state their limits.
CGROUP_LIMITS = (
    Path("/sys/fs/cgroup/memory.max"),
    Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"),
)


def machine_memory_mb() -> float | None:
    """Return the memory that this process may have [MB]: the least of the machine's, a container's
    and the process's limit; None if none is known.
    """
    return min(_limits_mb(), default=None)


def _limits_mb() -> Iterator[float]:
    """Yield the limits of memory that are known on this system [MB]."""
    with suppress(AttributeError, OSError, ValueError):  # not on every system
        yield os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e6
    for file in CGROUP_LIMITS:
        with suppress(OSError, ValueError):  # "max" is no limit
            yield int(file.read_text()) / 1e6
    with suppress(ImportError, OSError, ValueError):
        import resource

        limit, _ = resource.getrlimit(resource.RLIMIT_AS)
        if limit != resource.RLIM_INFINITY:
            yield limit / 1e6
