"""The memory that a solve takes, against what there is."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...methods.interior_point import InteriorPoint
from ...methods.reduced_space import ReducedSpace, memory_mb
from ...problem import Problem
from ...program.collocation import Collocation
from .derivatives import few, first_samples, shortened

# IPOPT with MUMPS, midpoint, 60 to 170 nodes and 80 to 100 steps.
BYTES = 280.0
# Programs with less variables than this fit anywhere.
SMALL = 50_000
# Where containers state their limits.
CGROUP_LIMITS = (
    Path("/sys/fs/cgroup/memory.max"),
    Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"),
)


def require_memory(problem: Problem, collocation: Collocation, method: object) -> None:
    """Refuse a solve that this machine's memory cannot hold, before it begins.

    Raises
    ------
    InputError
        With both numbers and a remedy.
    """
    there_mb = machine_memory_mb()
    if there_mb is None or collocation.variables < SMALL:
        return
    if isinstance(method, InteriorPoint):
        needed_mb = interior_point_mb(sum(nonzeros(problem, collocation.made_explicit())))
        fits = memory_mb(collocation) < there_mb
        remedy = 'method = "reduced-space"' if fits else "a coarser mesh or a shorter window_s"
    elif isinstance(method, ReducedSpace):
        needed_mb = memory_mb(collocation)
        remedy = "a coarser mesh, fewer substeps or a shorter window_s"
    else:
        return
    if needed_mb > there_mb:
        raise InputError(
            f"{method.name} would take about {needed_mb / 1e3:.2g} GB for "
            f"{collocation.variables:,} variables, and {there_mb / 1e3:.2g} GB are there; "
            f"take {remedy}",
            problem.path,
        )


def interior_point_mb(entries: int) -> float:
    """What IPOPT takes for so many nonzeros of Jacobian and Hessian."""
    return BYTES * entries / 1e6


def machine_memory_mb() -> float | None:
    """Memory that this process may have: the machine's, or what a container or limit leaves."""
    return min(_limits_mb(), default=None)


def _limits_mb() -> Iterator[float]:
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


def nonzeros(problem: Problem, whole: Collocation) -> tuple[int, int]:
    """Nonzeros of Jacobian and Hessian, without laying them out: each sample adds as many.

    `whole` is the problem's program as interior point has it.
    """
    further = whole.carried_nonzeros
    short = shortened(problem)
    total = least = _counted(short)
    for k, experiment in enumerate(problem.experiments):
        if not experiment.validation:
            parts = list(short.experiments)
            parts[k] = first_samples(experiment, few(experiment) + 1)
            more = _counted(replace(problem, experiments=parts)) - least
            total = total + max(0, len(experiment.t_s) - few(experiment)) * more
    return int(total[0]) + further[0], int(total[1]) + further[1]


def _counted(problem: Problem) -> NDArray[np.int64]:
    collocation = problem.collocation()
    structures = (collocation.jacobian_structure, collocation.hessian_structure)
    return np.array([len(indices) for _, indices in structures])
