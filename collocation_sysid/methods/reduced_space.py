"""Reduced space: given θ the trajectory is determined, so only θ is searched for.

Each iteration is a Gauss–Newton step on the same NLP as interior point's, with the same optimum.
One factorisation a timestep gives the feasibility step p and the sensitivities Z (`nlp.tangent`);
the step of all variables is (p + Z dq, dq), and dq solves a bounded least-squares problem in the
few parameters,

    min ‖r + S_p + S dq‖² + priors,   |dq| ≤ trust region,

with r the markers' residuals and S_p, S the markers' parts of p and Z.

A trial is accepted when the loss of its own projected trajectory (r + S_p there) has decreased,
and when its remaining infeasibility, measured by the length of p in metres, is short against
the step. That converges from where trajectories can be simulated; a ladder of horizons, the
first quarter, half and whole of the recording, widens it to where only the start can be. Where
even a rung cannot be simulated as a whole, the rows that can be are solved first.
"""

from __future__ import annotations

import numpy as np

from ..arrays import Array
from ..errors import SimulationError
from ..nlp.collocation import Collocation
from ..nlp.lapack import one_blas_thread
from ..nlp.segment import Segment
from ..nlp.tangent import BlockSolver
from .multipliers import constraint_multipliers
from .search import ReducedSpaceOptions, Search, Watch
from .solution import Solution, Status, Timing

# Misfits above this many standard deviations of the markers are worth a note.
MISFIT = 3.0


@one_blas_thread()
def solve(
    collocation: Collocation,
    options: ReducedSpaceOptions | None = None,
    watch: Watch | None = None,
) -> Solution:
    """Solve the NLP in the reduced space.

    Parameters
    ----------
    collocation : Collocation
    options : ReducedSpaceOptions, optional
    watch : callable, optional
        Called with every accepted `Iteration`; its number counts sweeps, rejected ones included.
        The first iterations are those of short horizons.

    Returns
    -------
    Solution
        With the multipliers of the whole NLP. Also when it did not converge or was interrupted.
    """
    search = Search(collocation, options or ReducedSpaceOptions(), watch)
    why = ""
    try:
        status = search.climb()
    except SimulationError as error:
        status, why = Status.NOT_SIMULABLE, f" {error}."
    except KeyboardInterrupt:
        status = Status.INTERRUPTED
    z, multipliers = _whole(collocation, search)
    search.notes += _notes(collocation, search, z, status)
    return Solution(
        status=status,
        message=f"{status.sentence}{why}",
        method="reduced-space",
        collocation=collocation,
        z=z,
        multipliers=multipliers,
        iterations=search.sweeps,
        history=tuple(search.history),
        timing=Timing.of(search.stopwatch, search.began),
        notes=tuple(search.notes),
        evaluations=search.sweeps,
    )


def memory_mb(collocation: Collocation) -> float:
    """Memory that a solve takes, estimated: linear in the number of timesteps."""
    # Two points with positions, p and Z; positions of the answer and of its gradients.
    columns = 2 * (2 + collocation.nq) + 6
    numbers = columns * collocation.variables
    chunks = [BlockSolver(segment).chunk_bytes for segment in collocation.segments]
    return (8 * numbers + max(chunks)) / 1e6


def _whole(collocation: Collocation, search: Search) -> tuple[Array, Array]:
    """Variables and multipliers of the whole NLP."""
    x = search.x
    whole = [_filled(s, x[k] if x else None) for k, s in enumerate(collocation.segments)]
    q, own = collocation.split(search.p)
    z = collocation.pack(q, whole, own)
    if x and all(len(a) == s.grid_rows for a, s in zip(x, collocation.segments, strict=True)):
        try:
            return z, constraint_multipliers(collocation, z, search.stopwatch)
        except SimulationError:
            pass
    return z, np.zeros(collocation.constraints)


def _filled(segment: Segment, x: Array | None) -> Array:
    """All rows of a trajectory; those not reached are carried rigidly by the grasp."""
    rigid = segment.experiment.rigid_positions(segment.dynamics.t_s).reshape(segment.grid_rows, -1)
    if x is not None:
        rigid[: len(x)] = x
    return rigid


def _notes(collocation: Collocation, search: Search, z: Array, status: Status) -> list[str]:
    notes = []
    if search.indefinite:
        steps = sum(segment.constraint_times for segment in collocation.segments)
        notes.append(
            f"the equations of {search.indefinite} of {steps} timesteps are not positive definite "
            "at the answer: the body is near buckling, or damped more than its motion allows"
        )
    if status in (Status.CONVERGED, Status.STALLED):
        parts = zip(
            collocation.segments,
            collocation.unpack(z)[1],
            collocation.unpack_own(z),
            strict=True,
        )
        squares = sum(segment.observation.loss(x, phi) for segment, x, phi in parts)
        misfit = float(np.sqrt(squares / max(1, collocation.measurements)))
        if misfit > MISFIT:
            notes.append(
                f"the markers are missed by {misfit:.3g} of their standard deviations "
                f"({1e3 * collocation.rms_m(z):.3g} mm rms): sigma_m, the model or the recording "
                "is off, or a better fit lies elsewhere; another guess may tell"
            )
    return notes
