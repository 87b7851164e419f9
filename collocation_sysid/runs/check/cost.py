"""What a solve will cost with each method, and whether this machine has the memory for it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...arrays import Array
from ...errors import InputError, SimulationError
from ...machine import machine_memory_mb
from ...methods.interior_point import InteriorPoint
from ...methods.reduced_space import ReducedSpace, memory_mb
from ...problem import Problem
from ...program.collocation import Collocation
from ...program.factorisation import Choice
from ...program.sweep import Sweep
from ...statistics.concern import Concern
from .derivatives import few, first_samples, shortened

# IPOPT with MUMPS, midpoint, 60 to 170 nodes and 80 to 100 steps.
BYTES = 280.0
# Programs with less variables than this fit anywhere.
SMALL = 50_000


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


# Rows timed, and sweeps that the reduced space mostly takes.
ROWS, SWEEPS = 12, 10
# IPOPT with MUMPS, midpoint, 60 to 170 nodes and 80 to 100 steps on one core: the work of an
# iteration grows with the nonzeros and with the unknowns of a timestep to this power.
ITERATIONS = 10
SECONDS, POWER = 4.5e-10, 1.4
# A method is recommended to those who would wait this long, if it takes this share of the time.
LONG_S, MUCH_QUICKER = 60.0, 0.1


@dataclass(frozen=True)
class Cost:
    """What a method takes, roughly.

    Attributes
    ----------
    method : str
    memory_mb : float
    time_s : float or None
        None where it cannot be told: the equations at the guess cannot be solved.
    """

    method: str
    memory_mb: float
    time_s: float | None


def costs(
    collocation: Collocation, short: Collocation, z: Array, nonzeros: int, factorisation: Choice
) -> tuple[Cost, ...]:
    """Costs by method.

    Parameters
    ----------
    collocation : Collocation
    short : Collocation
        Of the first samples of the same experiments.
    z : (variables,) the start of these
    nonzeros : int
        Of the Jacobian and the Hessian that interior point gets, together.
    factorisation : {"auto", "band", "sparse", "supernodal"}
    """
    width = max(unknowns_of_a_timestep(collocation))
    return (
        Cost(
            "reduced-space", memory_mb(collocation), _sweeps_s(collocation, short, z, factorisation)
        ),
        Cost(
            "interior-point",
            interior_point_mb(nonzeros),
            ITERATIONS * SECONDS * nonzeros * width**POWER,
        ),
    )


def unknowns_of_a_timestep(collocation: Collocation) -> list[int]:
    """What interior point has of each experiment, the overstress of its memory included."""
    return [
        len(segment.free_dofs) + sum(b.own.stop - b.own.start for b in segment.body.memory.branches)
        for segment in collocation.segments
    ]


def cost_notes(chosen: Cost, others: Sequence[Cost]) -> list[str]:
    """Whether another method is far quicker."""
    quickest = min(others, key=lambda cost: cost.time_s or np.inf)
    if chosen.time_s is None or quickest.time_s is None:
        return []
    if chosen.time_s < LONG_S or quickest.time_s > MUCH_QUICKER * chosen.time_s:
        return []
    return [
        f'solver.method = "{quickest.method}" finds the same optimum much sooner than '
        f"{chosen.method}"
    ]


def cost_concerns(chosen: Cost, others: Sequence[Cost]) -> list[Concern]:
    """Whether the chosen method will run out of memory."""
    available = machine_memory_mb()
    if available is None or chosen.memory_mb < available:
        return []
    fitting = [cost for cost in others if cost.memory_mb < available]
    remedy = f'set solver.method = "{fitting[0].method}"' if fitting else "shorten window_s"
    sizes = {"needed_gb": chosen.memory_mb / 1e3, "there_gb": available / 1e3}
    return [Concern("memory/short", data={"method": chosen.method, **sizes, "remedy": remedy})]


def _sweeps_s(
    collocation: Collocation, short: Collocation, z: Array, factorisation: Choice
) -> float | None:
    """Seconds of all sweeps, from one over the first rows of each experiment."""
    total = 0.0
    for segment, part in zip(collocation.segments, short.parts(z), strict=True):
        rows, setting = min(ROWS, len(part.x)), part.setting
        solver = Sweep(part.segment, rows, factorisation=factorisation)
        began = time.perf_counter()
        try:
            solver.forward(part.x[:rows], setting)
        except SimulationError:
            return None
        total += segment.grid_rows / rows * (time.perf_counter() - began)
    return SWEEPS * total
