"""Solves from several stiffnesses of a scan, where correspondences make local minima.

Points of depth cameras belong to whatever of the surface is nearest: a body that is too soft, with
the camera turned to match, can be a local minimum of the loss. So the scan's best stiffness and
those next to it are all followed to the end, and the answer with the lowest loss counts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from ..methods.reduced_space import ReducedSpace
from ..methods.scan import Scan
from ..methods.solution import Method, Solution, Status, Watch
from ..methods.start import placed_at_guess
from ..program.collocation import Collocation

# Losses that differ by less than this are of the same minimum, reached with other correspondences:
# from two starts next to it twins differ by up to 5.
SAME_LOSS = 10.0
Solve = Callable[[Method, Collocation], Solution]


@dataclass(frozen=True, eq=False)
class ScannedStart:
    """Where to begin after several starts of a scan were followed.

    Attributes
    ----------
    collocation : Collocation
        With the parameters of the best start as guess.
    scan : Scan
        The same scan with that start as its best.
    solution : Solution or None
        The answer from there; None where another method than the one asked for found it.
    note : str
        What was compared, for people; empty where there was one start only.
    """

    collocation: Collocation
    scan: Scan
    solution: Solution | None
    note: str


def has_local_minima(collocation: Collocation) -> bool:
    """Return whether measurements are associated anew while parameters are searched for."""
    return any(segment.depths for segment in collocation.segments)


def robust_loss(solution: Solution) -> float:
    """Loss with priors, and with points that are too far from the surface counted as at the gate.

    Points beyond the gate of a depth camera do not count in the loss: without this the answer that
    loses most of them would seem the best.
    """
    collocation = solution.collocation
    p, _ = collocation.unpack(solution.z)
    prior, _ = collocation.prior(p)
    far = sum(reading.loss_of_far_points for part in solution.parts for reading, _ in part.sights)
    return sum(part.loss for part in solution.parts) + float(prior @ prior) + far


def best_start(
    solver: Method, collocation: Collocation, scan: Scan, watch: Watch | None, solve: Solve
) -> ScannedStart:
    """Follow the starts of a scan and return the one with the lowest loss.

    Parameters
    ----------
    solver : Method
        Methods that are not the reduced-space one go on from the best start: the starts are
        followed in reduced space, which takes a fraction of their time.
    collocation : Collocation
        With the guesses of the scan's best stiffness.
    scan : Scan
    watch : callable, optional
        Called with every iteration.
    solve : callable
        Solves a collocation by a method, with its correspondences renewed.
    """
    first = ScannedStart(collocation, scan, None, "")
    if not scan.others or not has_local_minima(collocation):
        return first
    own = getattr(solver, "name", getattr(getattr(solver, "func", None), "name", ""))
    is_own = own == ReducedSpace.name
    method: Method = solver if is_own else ReducedSpace()
    found: list[tuple[float, int, Solution]] = []
    for number in (scan.best, *scan.others):
        begun = placed_at_guess(replace(collocation, parameters=scan.starts[number]))
        solution = solve(method, begun)
        if solution.status is Status.INTERRUPTED:
            return first if not is_own else replace(first, solution=solution)
        if solution.status.converged:
            found.append((robust_loss(solution), number, solution))
    if not found:
        return first
    loss, best, solution = min(found, key=lambda each: each[0])
    said = ", ".join(
        f"{each:.4g} from E = {scan.young_pa[number]:.3g} Pa" for each, number, _ in found
    )
    note = f"{len(found)} starts of the scan were followed to the end, with the losses {said}"
    if max(each for each, _, _ in found) - loss > SAME_LOSS:
        note += ": local minima, of which the lowest counts"
    chosen = replace(scan, best=best, parameters=scan.starts[best])
    begun = replace(collocation, parameters=scan.starts[best])
    return ScannedStart(begun, chosen, solution if is_own else None, note)
