"""Reduced-space method: the equations of motion determine the trajectory, only parameters are
unknown.

Each iteration is a Gauss–Newton step on the NLP of the interior-point method, with the same
optimum. One factorisation per time step gives the feasibility step p and the sensitivities Z
(`program.sweep`); the step of all variables is (p + Z dq, dq), and dq solves a bounded
least-squares problem in the few parameters,

    min ‖r + S_p + S dq‖² + priors,   |dq| ≤ trust region,

with the measurement residuals r, and S_p and S their changes due to p and Z.

A trial is accepted if the loss of its projected trajectory (r + S_p there) has decreased. Its
infeasibility, measured by the length of p in metres, stays within a funnel: trials outside are
simulated. Static rows of a trial are first solved for the equilibrium if one is near.

This converges if trajectories can be simulated. Horizons of increasing length (by default a
quarter, half and all of the recording) extend the convergence to cases where only the start can be
simulated at the guess. If even one horizon cannot be simulated completely, its first rows are
solved before the others.

Use it by default: it needs the least memory and time. Its search is in `reduced_search`.
"""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np

from ..common.array_types import Array
from ..common.limits import time_limit, unlimited
from ..common.validated_classes import validated
from ..common.validated_types import AtLeastOne, Positive
from ..errors import InputError
from ..fem.kernels import concurrent_count
from ..program.collocation import Collocation
from ..program.linear_algebra.lapack import one_blas_thread
from ..program.sweep import Sweep
from ..recording.measurement_selection import main_measurement
from .experiment_executors import ExperimentExecutor, LocalExecutor
from .loss_curvature import require_second_derivatives
from .reduced_search import ReducedSearch, SearchOptions
from .solution import Solution, Status, Watch
from .solve_recorder import SEARCH_ENDS, Recorder, SearchEnded, misfit_of, status_of_end
from .starts.initial_trajectories import complete_variables, simulate_trajectories
from .trajectory_sweeps import trajectory_positions

# Time limit of a run whose problem states none [s].
UNLIMITED_S = 1e6
# Misfits above this many standard deviations of the markers are worth a note.
MISFIT = 3.0


@validated
class ReducedSpace(SearchOptions):
    """Gauss–Newton method for the parameters; the equations of motion give the trajectories.

    Attributes
    ----------
    coarse_start : {"auto", false}
        "auto": solve a problem with a large body on a coarser mesh first, and one with many samples
        with some of them, and start from there, unless a start is given. The result is that of a
        direct start, to within `coarse_start_tolerance`.
    coarse_start_nodes : int
        Number of nodes above which a body is large.
    coarse_start_tolerance : float
        Tolerance of the search on the given mesh after a coarse start, and of a search with finer
        time steps after the first one, if it is larger than `tolerance`. The default is far below
        the error of any mesh, and saves a sweep or two.
    max_time_s : float
        Time limit of a run [s]: the search ends with the best iterate, and later steps, such as
        error bars, are left out. If none is stated, the search for a start ends after 40 s where
        Poisson's ratio is above 0.499 and the elements are not "tet10-p0".
    """

    name: ClassVar[str] = "reduced-space"

    coarse_start: Literal["auto", False] = "auto"
    coarse_start_nodes: AtLeastOne = 1500
    coarse_start_tolerance: Positive = 1e-6
    max_time_s: Positive = UNLIMITED_S

    @property
    def tolerance_after_coarse(self) -> float:
        """Tolerance of a search from the answer with a coarser mesh or coarser time steps."""
        return max(self.tolerance, self.coarse_start_tolerance)

    @one_blas_thread()
    def __call__(
        self,
        collocation: Collocation,
        watch: Watch | None = None,
        start: Array | None = None,
        workers: ExperimentExecutor | None = None,
    ) -> Solution:
        """Solve the NLP, see `Method`.

        Entries of the history count sweeps, including rejected ones; the first belong to short
        horizons. A search that fails, is interrupted or loses its workers gives the best point so
        far, and `status` says why it ended. Rows that were not simulated are then those of a rigid
        motion with the grasp, and the solution's `initial_multipliers` are zeros; else they are
        None. Exceptions of `watch` are not caught. There is no coarse start, which `solve` adds.
        """
        if self.hessian == "exact":
            require_second_derivatives(collocation)
            if workers is not None:
                raise InputError(
                    "hessian = 'exact' needs all trajectories in one process; expected "
                    "'gauss-newton' with a scheduler"
                )
        workers = workers or LocalExecutor(collocation.threads)
        recorder = Recorder(self.name, collocation, watch=watch)
        search = ReducedSearch(self, recorder, start=start, workers=workers)
        status, message = Status.INTERRUPTED, Status.INTERRUPTED.sentence
        recorder.answer = lambda: _solution_of_search(search, workers, status, message)
        try:
            with time_limit(self.max_time_s):
                found = search.solve_from_start()
                for rows in () if found else search.rungs:
                    is_last = rows is search.rungs[-1]
                    horizon = search.horizon(rows, is_last)
                    search.extend_to(horizon)
                    found = search.minimise(horizon, is_last)
                    if found is Status.ITERATION_LIMIT:
                        break
                    assert search.point is not None  # a solve accepts one
                    if not is_last and search.point.loss > self.largest_loss:
                        found = Status.STALLED
                        break
            status = found or Status.CONVERGED
            message = status.explain(self.name, max_iterations=self.max_iterations)
        except SEARCH_ENDS as end:
            status, message = status_of_end(end)
        with unlimited():
            return recorder.answer()


def _solution_of_search(
    search: ReducedSearch, workers: ExperimentExecutor, status: Status, message: str
) -> Solution:
    """Rows that were not simulated are those of a rigid motion with the grasp."""
    recorder = search.recorder
    collocation = recorder.collocation
    try:
        trajectories = search.trajectories and workers.fetch(
            workers.map_experiments(trajectory_positions, search.trajectories)
        )
        recorder.notes += workers.notes()
    except SearchEnded as lost:
        status = lost.status
        message = lost.message
        trajectories, _ = simulate_trajectories(collocation, search.p)
    z = complete_variables(collocation, search.p, known_rows=trajectories)
    rows = [transcription.grid_times for transcription in collocation.transcriptions]
    is_complete = trajectories is not None and [len(x) for x in trajectories] == rows
    recorder.notes += _notes(collocation, search.indefinite_steps, z=z, status=status)
    multipliers = None if is_complete else np.zeros(collocation.constraint_count)
    return recorder.solution(
        status,
        message,
        z=z,
        multipliers=multipliers,
        iterations=search.sweeps,
        evaluations=search.sweeps,
    )


def memory_mb(collocation: Collocation) -> float:
    """Return an estimate of the memory of a solve by reduced space [MB]; it increases linearly with
    the number of time steps.
    """
    # Two points with positions, p and Z; positions of the answer and of its gradients.
    columns = 2 * (2 + collocation.nq) + 6
    values = columns * collocation.variable_count
    chunks = sorted(
        Sweep(transcription).estimate_chunk_bytes() for transcription in collocation.transcriptions
    )
    concurrent = concurrent_count(len(chunks), collocation.threads)
    return (8 * values + sum(chunks[-concurrent:])) / 1e6


def _notes(collocation: Collocation, indefinite_steps: int, z: Array, status: Status) -> list[str]:
    """Return notes on time steps with an indefinite matrix, and on large residuals."""
    notes = []
    if indefinite_steps:
        steps = sum(transcription.constraint_times for transcription in collocation.transcriptions)
        notes.append(
            f"the equations of {indefinite_steps} of {steps} time steps are not positive definite "
            "at the solution: the body is near buckling, or the estimated damping is too large"
        )
    if status in (Status.CONVERGED, Status.STALLED):
        misfit = misfit_of(collocation, sum(part.loss for part in collocation.iterates(z)))
        if misfit > MISFIT:
            size = f" ({1e3 * collocation.rms_marker_distance_m(z):.3g} mm rms)"
            measurements, noise_key = main_measurement(
                [transcription.experiment for transcription in collocation.transcriptions]
            )
            are_markers = noise_key == "sigma_m"
            notes.append(
                f"the residuals of the {measurements} are {misfit:.3g} times their standard "
                f"deviations{size if are_markers else ''}: {noise_key}, the model or the "
                "recording may be wrong, or there is a better fit elsewhere; try another guess"
            )
    return notes
