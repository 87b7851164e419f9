"""Cost of a solve with each method, and whether this machine has enough memory."""

from __future__ import annotations

import timeit
from collections.abc import Sequence, Set
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ..common.array_types import Array
from ..common.limits import machine_memory_mb
from ..errors import InputError, SimulationError
from ..methods.interior_point import InteriorPoint
from ..methods.reduced_space import ReducedSpace, memory_mb
from ..problem import Problem
from ..program.collocation import Collocation
from ..program.lifted.collocation import lifted_nonzeros, with_lifted_variables
from ..program.linear_algebra.factorisation import Choice
from ..program.sweep import Sweep
from ..recording.experiment import Experiment
from ..statistics.concerns import Concern
from .derivatives import shortened_problem

# Memory per nonzero [bytes]: IPOPT with MUMPS, midpoint, 60 to 170 nodes and 80 to 100 steps.
BYTES_PER_NONZERO = 280.0
# Number of variables below which programs fit into any memory.
SMALL_PROGRAM_VARIABLES = 50_000


def require_memory(problem: Problem, collocation: Collocation, method: object) -> None:
    """Raise an `InputError` if a solve needs more memory than this machine has.

    Small programs, other methods than interior point and reduced space, and machines of unknown
    memory pass.

    Parameters
    ----------
    collocation : Collocation
        Program of the problem, with guesses.
    method : Method
        Method that will solve it.

    Raises
    ------
    InputError
        With both numbers and a remedy.
    """
    there_mb = machine_memory_mb()
    if there_mb is None or collocation.variable_count < SMALL_PROGRAM_VARIABLES:
        return
    if isinstance(method, InteriorPoint):
        needed_mb = interior_point_mb(sum(nonzeros(problem, with_lifted_variables(collocation))))
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
            f"{collocation.variable_count:,} variables, but the machine has {there_mb / 1e3:.2g} "
            f"GB; use {remedy}",
            problem.path,
        )


def interior_point_mb(entries: int) -> float:
    """Return the memory of IPOPT [MB] for a number `entries` of nonzeros of Jacobian and Hessian
    together.
    """
    return BYTES_PER_NONZERO * entries / 1e6


def nonzeros(problem: Problem, lifted: Collocation) -> tuple[int, int]:
    """Return the numbers of nonzeros of the Jacobian and of the Hessian's upper triangle of a
    program with lifted variables, extrapolated from a few samples by the number of variables.

    Parameters
    ----------
    problem : Problem
        Problem with all experiments of the program, or examples of them; its parameters may lack
        guesses.
    lifted : Collocation
        Program with lifted variables, as interior point needs it, and with a guess of every
        parameter.
    """
    problem = replace(problem, parameters=lifted.parameters)
    short, longer = (_count_nonzeros(shortened_problem(problem, more)) for more in (0, 1))
    variables = problem.collocation().variable_count
    examined = short + (variables - short[0]) / max(1, longer[0] - short[0]) * (longer - short)
    size = lifted.phi_columns.stop / variables
    jacobian, hessian = np.rint(size * examined[1:]) + lifted_nonzeros(lifted)
    return int(jacobian), int(hessian)


def _count_nonzeros(problem: Problem) -> NDArray[np.int64]:
    """Return the number of variables and nonzeros (3,), without lifting."""
    program = problem.collocation()
    (_, of_jacobian), (_, of_hessian) = program.jacobian_structure, program.hessian_structure
    return np.array([program.variable_count, len(of_jacobian), len(of_hessian)])


# Time steps of the sweep that is timed: enough for a steady time per step.
TIMED_ROWS = 12
# Sweeps that the reduced space mostly takes.
TYPICAL_SWEEPS = 10
# Time of a search in equilibria over that of `TYPICAL_SWEEPS` sweeps, whose equilibria start from
# solved ones: 1.9 and 2.5 with a prescribed platen, 1.6 and 2.0 with an obstacle as platen, 0.9 and
# 2.6 with friction, for quarter cylinders of 11 and 21 samples.
STATIC_FACTOR = 2.2
# The same ratio if a coefficient of friction is estimated, over that without: 1.3 and 3.5 for the
# same cylinders, because the search needs more iterations and restarts.
FRICTION_FACTOR = 3.0
# The same ratio with cameras whose pose and clock are estimated: 4.7 for a filmed finger.
CAMERA_FACTOR = 4.0
# Time until the first sweep [s]: 1.1 and 1.9 for two small bodies.
PREPARATION_S = 1.5
# Iterations that interior point mostly takes.
TYPICAL_ITERATIONS = 10
# Time of an iteration [s] per nonzero and per TIMESTEP_POWER of the unknowns of a step: IPOPT with
# MUMPS, midpoint, 60 to 170 nodes and 80 to 100 steps on one core.
SECONDS_PER_NONZERO = 4.5e-10
# Power of the unknowns of a time step in that time, as measured.
TIMESTEP_POWER = 1.4
# Time of a method [s] above which a quicker one is recommended.
LONG_SOLVE_S = 60.0
# Largest time of the recommended method, as a share of the chosen one's.
LARGEST_TIME_SHARE = 0.1


@dataclass(frozen=True)
class MethodCost:
    """Approximate memory and time of a method."""

    method: str
    memory_mb: float  # estimated memory [MB]
    time_s: float | None  # none where it is unknown: the equations at the guess cannot be solved


def method_costs(
    collocation: Collocation,
    short: Collocation,
    size: float,
    z: Array,
    nonzeros: int,
    factorisation: Choice,
) -> tuple[MethodCost, ...]:
    """Return the estimated memory [MB] and time [s] of reduced space and of interior point, in this
    order; the time of reduced space is None if the equations at the start cannot be solved.

    Parameters
    ----------
    collocation : Collocation
        Program of the examined recordings.
    short : Collocation
        First samples of the same experiments, in which sweeps are timed.
    size : float
        Size of the program of all recordings over that of `collocation`.
    z : (variables,) array
        Start of `short`.
    nonzeros : int
        Number of nonzeros of the Jacobian and the Hessian of interior point for all recordings.
    factorisation : {"auto", "band", "sparse", "supernodal"}
        Option of reduced space.
    """
    sweeps_s = _estimated_sweeps_s(collocation, short, z, factorisation)
    width = max(  # free dofs and overstresses
        len(each.free_dofs)
        + sum(b.columns.stop - b.columns.start for b in each.body.memory.branches)
        for each in collocation.transcriptions
    )
    return (
        MethodCost(
            "reduced-space",
            size * memory_mb(collocation),
            time_s=None if sweeps_s is None else PREPARATION_S + TYPICAL_SWEEPS * size * sweeps_s,
        ),
        MethodCost(
            "interior-point",
            interior_point_mb(nonzeros),
            time_s=TYPICAL_ITERATIONS * SECONDS_PER_NONZERO * nonzeros * width**TIMESTEP_POWER,
        ),
    )


def cost_notes(chosen: MethodCost, others: Sequence[MethodCost]) -> list[str]:
    """Return a note if the quickest of the other methods takes at most a tenth of the time of the
    chosen one, which takes more than a minute; none if its time, or that of all others, is unknown.

    Parameters
    ----------
    others : sequence of MethodCost
        Costs of at least one method; the chosen one may be among them.
    """
    quickest = min(others, key=lambda cost: cost.time_s or np.inf)
    if (
        chosen.time_s is None
        or quickest.time_s is None
        or chosen.time_s < LONG_SOLVE_S
        or quickest.time_s > LARGEST_TIME_SHARE * chosen.time_s
    ):
        return []
    return [
        f'solver.method = "{quickest.method}" finds the same optimum much faster than '
        f"{chosen.method}"
    ]


def cost_concerns(chosen: MethodCost, others: Sequence[MethodCost]) -> list[Concern]:
    """Return a concern if the chosen method needs at least the memory that this machine has, with
    another method that fits as remedy, or else a shorter recording; none if the machine's memory is
    unknown.

    Parameters
    ----------
    others : sequence of MethodCost
        Costs of all methods; the chosen one may be among them.
    """
    available = machine_memory_mb()
    if available is None or chosen.memory_mb < available:
        return []
    fitting = [cost for cost in others if cost.memory_mb < available]
    remedy = f'set solver.method = "{fitting[0].method}"' if fitting else "shorten window_s"
    sizes = {"needed_gb": chosen.memory_mb / 1e3, "there_gb": available / 1e3}
    return [Concern("memory/short", data={"method": chosen.method, **sizes, "remedy": remedy})]


def _estimated_sweeps_s(
    collocation: Collocation, short: Collocation, z: Array, factorisation: Choice
) -> float | None:
    """Return the time of a sweep over all rows [s], weighted by `search_factor`, from two timed ones."""
    total = 0.0
    free_names = {item.name for item in collocation.parameters.free}
    for transcription, part in zip(collocation.transcriptions, short.iterates(z), strict=True):
        rows = min(TIMED_ROWS, len(part.x))
        solver = Sweep(part.transcription, rows, factorisation=factorisation)
        sweep = partial(solver.forward, part.x[:rows], part.equations)
        try:  # the first one loads what it calls
            took_s = min(timeit.repeat(sweep, repeat=2, number=1))
        except SimulationError:
            return None
        sweep_s = transcription.grid_times / rows * took_s
        factor = search_factor(transcription.experiment, free_names)
        if any(entry.row.of == "images" for entry in transcription.nuisance.entries):
            factor *= CAMERA_FACTOR
        total += factor * sweep_s
    return total


def search_factor(experiment: Experiment, free_names: Set[str]) -> float:
    """Return the time of the search in an experiment over that of `TYPICAL_SWEEPS` sweeps, as
    measured for experiments of its kind.

    Parameters
    ----------
    free_names : set of str
        Names of the estimated parameters, which may be coefficients of friction.
    """
    factor = STATIC_FACTOR if experiment.is_static else 1.0
    if any(each.friction in free_names for each in experiment.obstacles):
        factor *= FRICTION_FACTOR
    return factor
