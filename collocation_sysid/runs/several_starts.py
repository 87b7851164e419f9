"""Solves from several stiffnesses of a scan, where there may be local minima.

Points measured by a camera are associated with the nearest part of the surface: a body that is too
soft, with the camera turned to match, can be a local minimum of the loss. So the scan's best
stiffness and those next to it are all followed to convergence, or to a minimum that is already
known, and the solution with the lowest loss counts. Without correspondences that is done where the
first solution needs an error of a pose or clock that nobody makes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ..common.array_types import Array
from ..methods.reduced_space import ReducedSpace
from ..methods.solution import Iteration, Method, Solution, Watch
from ..methods.starts.initial_trajectories import associated_at_guess
from ..methods.starts.stiffness_scan import Scan, Start
from ..program.collocation import Collocation

# Difference of losses below which two solutions are the same minimum with other correspondences:
# in simulated recordings they differ by up to 5.
SAME_LOSS = 10.0
# Relative difference of all parameters below which a search with such a loss is at the same minimum
# and need not continue.
SAME_PARAMETERS = 0.01
# Estimate of an error, in standard deviations of its prior, that makes a solution doubtful.
UNLIKELY = 4.5
Solve = Callable[[Method, Collocation], Solution]


def has_local_minima(collocation: Collocation) -> bool:
    """Return whether a fitted experiment has correspondences, which change during the search and
    can make local minima.
    """
    return any(
        transcription.association.correspondences for transcription in collocation.transcriptions
    )


def robust_loss(solution: Solution) -> float:
    """Return the loss with priors and with that of the measurements that the fit excludes.

    The loss of a solution leaves out points beyond the gate of a camera: compared by it, the
    solution that loses most points would seem the best.
    """
    collocation = solution.collocation
    p, _ = collocation.unpack(solution.z)
    prior, _ = collocation.prior_residuals(p)
    excluded_loss = sum(
        model.excluded_loss
        for part in solution.parts
        for model in part.transcription.main_residuals
    )
    return sum(part.loss for part in solution.parts) + float(prior @ prior) + excluded_loss


class KnownMinimum(Exception):
    """A search has arrived at a minimum that is known."""

    def __init__(self, solution: Solution) -> None:
        super().__init__()
        self.solution = solution


def until_known(method: Method, known: Sequence[Solution]) -> Method:
    """Return a method that raises `KnownMinimum` where a known solution is reached."""

    def solve(
        collocation: Collocation, watch: Watch | None = None, start: Array | None = None
    ) -> Solution:
        def watch_for_known(line: Iteration) -> None:
            """Pass an entry of the history to `watch`, then compare it with the known solutions."""
            if watch is not None:
                watch(line)
            for solution in known:
                if _is_at(line, solution):
                    raise KnownMinimum(solution)

        return method(collocation, watch_for_known, start)

    return solve if known else method


def _is_at(line: Iteration, solution: Solution) -> bool:
    last = solution.history[-1]
    return (
        line.share == 1.0
        and abs(line.loss - last.loss) <= SAME_LOSS
        and all(
            np.isclose(value, last.parameters[name], rtol=SAME_PARAMETERS)
            for name, value in line.parameters.items()
        )
    )


def _is_likely(solution: Solution) -> bool:
    p, _ = solution.collocation.unpack(solution.z)
    return bool((np.abs(p[solution.collocation.nq :]) <= UNLIKELY).all())


def follow_starts(
    solver: Method, start: Start, scan: Scan, solve: Solve
) -> tuple[Start, Solution | None]:
    """Follow the starts of a scan to convergence and return the one with the lowest `robust_loss`.

    Without local minima the first solution counts, unless one of its nuisance parameters is above
    `UNLIKELY`. The best start of the scan, `start`, is returned without a solution if the scan found
    only one start, or no start converges. Exceptions of `solve` are not caught.

    Parameters
    ----------
    solver : Method
        If this is not the reduced-space method, the starts are followed in reduced space, which is
        much faster, and the result has no solution: the solver goes on from the best start.
    start : Start
        With the guesses of the scan's best stiffness.
    solve : callable
        ``solve(method, collocation)``, with renewed correspondences.

    Returns
    -------
    (start, solution)
        The best start, not associated with the body there, with the scan that has it as its best and
        a note on the losses; and the solution from there if the method is reduced space.
    """
    collocation = start.collocation
    if not scan.others:
        return start, None
    is_unique = not has_local_minima(collocation)
    own = getattr(solver, "name", getattr(getattr(solver, "func", None), "name", ""))
    is_own = own == ReducedSpace.name
    if is_unique and not is_own:
        return start, None
    method: Method = solver if is_own else ReducedSpace()
    candidates: list[tuple[float, int, Solution]] = []
    for number in (scan.best, *scan.others):
        started = collocation
        if number != scan.best:
            started = collocation.with_parameters(scan.starts[number])
        if is_unique:  # otherwise the search associates cameras with its first shape itself
            started = associated_at_guess(started)
        try:
            solution = solve(until_known(method, [each for *_, each in candidates]), started)
        except KnownMinimum as known:
            candidates.append((robust_loss(known.solution), number, known.solution))
            continue
        if solution.status.converged:
            candidates.append((robust_loss(solution), number, solution))
        if is_unique and (not candidates or _is_likely(solution)):
            break
    if is_unique and len(candidates) < 2:
        return start, candidates[0][-1] if candidates else solution
    if not candidates:
        return start, None
    loss, best, solution = min(candidates, key=lambda each: each[0])
    losses = ", ".join(
        f"{each:.4g} from E = {scan.young_pa[number]:.3g} Pa" for each, number, _ in candidates
    )
    note = (
        f"{len(candidates)} initial values of the scan were solved to the end, or to a minimum that "
        f"another one had reached, with the losses {losses}"
    )
    if max(each for each, _, _ in candidates) - loss > SAME_LOSS:
        note += ": there are local minima; the lowest one is reported"
    chosen = replace(scan, best=best, parameters=scan.starts[best])
    started = collocation.with_parameters(scan.starts[best])
    chosen_start = replace(start, collocation=started, note=note, scan=chosen)
    return chosen_start, solution if is_own else None
