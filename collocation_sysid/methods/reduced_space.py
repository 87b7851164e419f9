"""Reduced space: given θ the trajectory is determined, so only θ is searched for.

Each iteration is a Gauss–Newton step on the same NLP as interior point's, with the same optimum.
One factorisation a timestep gives the feasibility step p and the sensitivities Z (`program.sweep`);
the step of all variables is (p + Z dq, dq), and dq solves a bounded least-squares problem in the
few parameters,

    min ‖r + S_p + S dq‖² + priors,   |dq| ≤ trust region,

with r the markers' residuals and S_p, S the markers' parts of p and Z.

A trial is accepted when the loss of its own projected trajectory (r + S_p there) has decreased,
and when its remaining infeasibility, measured by the length of p in metres, is short against
the step. Static rows of a trial are brought to equilibrium first, where that is near.

That converges from where trajectories can be simulated; a ladder of horizons, the
first quarter, half and whole of the recording, widens it to where only the start can be. Where
even a rung cannot be simulated as a whole, the rows that can be are solved first.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ..arrays import Array
from ..errors import InputError
from ..fem.kernels import at_once
from ..program.collocation import Collocation
from ..program.lapack import one_blas_thread
from ..program.sweep import Sweep
from .curvature import require_second_derivatives
from .recorder import Ended, Recorder
from .search import ReducedSearch, SearchOptions
from .solution import Solution, Status, Watch
from .start import completed, marched
from .trajectory import positions
from .workers import Here, Workers

# Misfits above this many standard deviations of the markers are worth a note.
MISFIT = 3.0


@dataclass(frozen=True)
class ReducedSpace(SearchOptions):
    """Gauss–Newton steps of the parameters, with the trajectories that the dynamics give them."""

    name: ClassVar[str] = "reduced-space"

    @one_blas_thread()
    def __call__(
        self,
        collocation: Collocation,
        watch: Watch | None = None,
        start: Array | None = None,
        workers: Workers | None = None,
    ) -> Solution:
        """Solve the NLP, see `Method`; experiments are on the workers given, by default here.

        Lines of the history count sweeps, rejected ones included; the first are those of short
        horizons.
        """
        if self.hessian == "exact":
            require_second_derivatives(collocation)
            if workers is not None:
                raise InputError(
                    "hessian = 'exact' needs every trajectory in one place; expected "
                    "'gauss-newton' with a scheduler"
                )
        workers = workers or Here(collocation.threads)
        recorder = Recorder(self.name, collocation, watch)
        search = ReducedSearch(self, recorder, start, workers)
        status, message = recorder.search(search.run)
        collocation = recorder.collocation
        try:
            found = search.x and workers.fetch(workers.each(positions, search.x))
            recorder.notes += workers.notes()
        except Ended as lost:
            status, message = lost.status, lost.message
            found, _ = marched(collocation, search.p)
        z = completed(collocation, search.p, found)
        rows = [segment.grid_rows for segment in collocation.segments]
        reached = found is not None and [len(x) for x in found] == rows
        recorder.notes += _notes(collocation, search.indefinite, z, status)
        multipliers = None if reached else np.zeros(collocation.constraints)
        return recorder.solution(status, message, z, multipliers, search.sweeps, search.sweeps)


def memory_mb(collocation: Collocation) -> float:
    """Memory that a solve takes, estimated: linear in the number of timesteps."""
    # Two points with positions, p and Z; positions of the answer and of its gradients.
    columns = 2 * (2 + collocation.nq) + 6
    numbers = columns * collocation.variables
    chunks = sorted(Sweep(segment).chunk_bytes for segment in collocation.segments)
    together = at_once(len(chunks), collocation.threads)
    return (8 * numbers + sum(chunks[-together:])) / 1e6


def _measured(collocation: Collocation) -> tuple[str, str]:
    """Return in words what the recordings measure most of, and what states its noise."""
    experiments = [segment.experiment for segment in collocation.segments]
    if any(each.markers.samples for each in experiments):
        return "markers", "sigma_m"
    if any(each.depths for each in experiments):
        return "points of depth cameras", "sigma_m of depth"
    if any(each.wrenches for each in experiments):
        return "wrenches", "sigma_n"
    return "readings", "sigma of the readings"


def _notes(collocation: Collocation, indefinite: int, z: Array, status: Status) -> list[str]:
    notes = []
    if indefinite:
        steps = sum(segment.constraint_times for segment in collocation.segments)
        notes.append(
            f"the equations of {indefinite} of {steps} timesteps are not positive definite "
            "at the answer: the body is near buckling, or damped more than its motion allows"
        )
    if status in (Status.CONVERGED, Status.STALLED):
        squares = sum(part.loss for part in collocation.parts(z))
        misfit = float(np.sqrt(squares / max(1, collocation.measurements)))
        if misfit > MISFIT:
            size = f" ({1e3 * collocation.rms_m(z):.3g} mm rms)"
            what, stated = _measured(collocation)
            marked = stated == "sigma_m"
            notes.append(
                f"the {what} are missed by {misfit:.3g} of their standard deviations"
                f"{size if marked else ''}: {stated}, the model or the recording is off, or a "
                "better fit lies elsewhere; another guess may tell"
            )
    return notes
