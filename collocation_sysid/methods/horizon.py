"""Least-squares problem on the first rows of every experiment, linearised by sweeps.

`Horizon` distributes the work on the experiments to `ExperimentExecutor` and joins the results to
an `Iterate`. It is used by the reduced-space method and by shooting.

The first rows are a share of the motion. A recording may begin and end at rest, where nothing depends
on the stiffness. So a share of a recording is measured by what its instruments see besides a rigid
motion with the grasps: the squares of the changes, in standard deviations, of the residuals of an
undeformed body since the first sample.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ..common.array_types import Array
from ..errors import SimulationError
from ..program.collocation import Collocation
from ..program.experiment_iterate import ExperimentIterate
from ..program.least_squares import SquareRootInformation
from ..program.linear_algebra.factorisation import Choice
from ..program.linear_algebra.lapack import one_blas_thread
from ..program.stopwatch import Stopwatch
from ..program.sweep import Sweep
from .experiment_executors import ExperimentExecutor, LocalExecutor
from .options import FEWEST
from .trajectory_sweeps import (
    Feasibility,
    LinearisedTrajectory,
    SimulationResult,
    SweepReport,
    extrapolate,
    feasibility,
    reassociate,
    simulate_rows,
    sweep,
    sweep_after_step,
    trajectory_positions,
)


@dataclass(frozen=True, eq=False)
class Iterate:
    """Parameters and trajectories with the linearised least-squares problem there."""

    p: Array  # (np,): all parameters (q, φ), see `Collocation.pack`
    trajectories: list[Any]  # sweep of each experiment, stored by the workers
    reports: list[SweepReport]
    # Residuals linearised in a step from p: measurements after the feasibility step, and priors.
    fit: SquareRootInformation
    # (np,): S_0ᵀ r of its residuals r, with the slopes S_0 of the previous iterate.
    previous_slopes_residual: Array

    @cached_property
    def loss(self) -> float:
        """Loss after the feasibility step, priors included."""
        return self.fit.loss(np.zeros(len(self.p)))

    @cached_property
    def feasibility_m(self) -> float:
        """Largest coordinate of the feasibility step [m]."""
        return max(report.feasibility_m for report in self.reports)

    @property
    def is_finite(self) -> bool:
        """Whether the loss and the feasibility step are finite."""
        return bool(np.isfinite(self.loss) and np.isfinite(self.feasibility_m))

    def predicted_loss(self, step: Array) -> float:
        """Return the loss, priors included, of the linearised problem after a step (np,) of the
        parameters.
        """
        return self.fit.loss(step)


class Horizon:
    """The problem on the first rows of every experiment.

    Arguments named `x` are lists with one entry per experiment, stored by the workers, of any kind
    that `trajectory_sweeps.trajectory_positions` accepts.

    Parameters
    ----------
    collocation : Collocation
        Complete problem.
    rows : sequence of int
        Number of grid rows of each experiment.
    prior : float, optional
        Standard deviation of a prior of q around the guess; None for no such prior.
    factorisation : {"auto", "band", "sparse", "supernodal"}
        Factorisation of a time step's matrix.
    workers : ExperimentExecutor, optional
        Where the experiments are processed; by default threads of this process.
    """

    def __init__(
        self,
        collocation: Collocation,
        rows: Sequence[int],
        prior: float | None = None,
        stopwatch: Stopwatch | None = None,
        factorisation: Choice = "auto",
        workers: ExperimentExecutor | None = None,
    ) -> None:
        self.rows = list(rows)
        self.prior = prior
        self.stopwatch = stopwatch or Stopwatch()
        self.workers = workers or LocalExecutor(collocation.threads)
        self.set_collocation(collocation)
        with self.stopwatch.building():
            stopwatches = self._repeat(None)
            factorisations = self._repeat(factorisation)
            self.solvers = self.workers.map_experiments(
                Sweep, self.transcriptions, self.rows, stopwatches, factorisations
            )

    def set_collocation(self, collocation: Collocation) -> None:
        """Use another collocation of the same problem, with measurements associated differently, in
        place; iterates that were evaluated before are unchanged, see `reassociate`.

        `SearchEnded` is raised if the workers are lost.
        """
        self.collocation = collocation
        self.transcriptions = self.workers.store_segments(collocation)

    @one_blas_thread()
    def evaluate(
        self,
        p: Array,
        trajectories: Sequence[Any],
        known_iterate: Iterate | None = None,
        previous: Iterate | None = None,
    ) -> Iterate:
        """Sweep all experiments at parameters p and trajectories x, and return the iterate.

        Without a `previous` iterate its changes (`position_change_m` and the measurements' part of
        `previous_slopes_residual`) are zero. The times of the sweeps are added to the stopwatch, as
        in `evaluate_step` and `reassociate`.

        Parameters
        ----------
        p : (np,) array
            All parameters (q, φ).
        trajectories : sequence
            Trajectories, one per experiment, with the rows of the horizon.
        known_iterate : Iterate, optional
            Iterate of the first rows at the same p and positions, which is continued.
        previous : Iterate, optional
            Iterate from which changes are measured.

        Raises
        ------
        SimulationError
            If a time step is singular or not finite, or a node has no mass.
        SearchEnded
            If the workers are lost.
        """
        known = known_iterate.trajectories if known_iterate else self._repeat(None)
        sweep_results = self.workers.map_experiments(
            sweep,
            self.solvers,
            self.transcriptions,
            self._by_experiment(p),
            trajectories,
            known,
            previous.trajectories if previous else self._repeat(None),
        )
        return self._iterate_from(p, sweep_results)

    @one_blas_thread()
    def evaluate_step(self, p: Array, previous: Iterate, step: Array) -> Iterate:
        """Sweep all experiments after a step of the parameters, and return the new iterate.

        Static experiments are solved for their equilibria first, see
        `trajectory_sweeps.sweep_after_step`.

        Parameters
        ----------
        p : (np,) array
            Parameters after the step, within their bounds.
        previous : Iterate
            Iterate before the step.
        step : (np,) array
            Step of the parameters, along which the positions are extrapolated.

        Raises
        ------
        SimulationError
            If a time step is singular or not finite, or a node has no mass.
        SearchEnded
            If the workers are lost.
        """
        sweep_results = self.workers.map_experiments(
            sweep_after_step,
            self.solvers,
            self.transcriptions,
            self._by_experiment(p),
            previous.trajectories,
            self._by_experiment(step),
        )
        return self._iterate_from(p, sweep_results)

    @one_blas_thread()
    def reassociate(self, p: Array, iterate: Iterate) -> Iterate:
        """Return an iterate at parameters p (np,) with the measurements of the present collocation;
        positions and sensitivities are those of `iterate`, not computed again.

        Its changes since a previous iterate are zero, as in `evaluate`. `SearchEnded` is raised if
        the workers are lost.
        """
        evaluated = self.workers.map_experiments(
            reassociate,
            self.solvers,
            self.transcriptions,
            self._by_experiment(p),
            iterate.trajectories,
        )
        return self._iterate_from(p, evaluated)

    def _iterate_from(self, p: Array, trajectories: list[Any]) -> Iterate:
        """Fit and products are sums over experiments, priors, and the horizon's own prior."""
        reports: list[SweepReport] = self.workers.fetch(
            self.workers.map_experiments(_report, trajectories)
        )
        nq = self.collocation.nq
        places = self.collocation.parameter_indices
        fit = SquareRootInformation.empty(len(p))
        crossed = np.zeros(len(p))
        for report, own in zip(reports, places, strict=True):
            self.stopwatch.add(*report.times_s)
            fit = fit.with_problem(report.fit, own)
            crossed[own] += report.previous_slopes_residual
        prior, prior_slopes = self.collocation.prior_residuals(p)
        priors = [(prior, np.diag(prior_slopes))]
        if self.prior is not None:
            deviation = (p[:nq] - self.collocation.parameters.guess_q) / self.prior
            priors.append((deviation, np.eye(nq, len(p)) / self.prior))
        for values, by in priors:
            fit = fit.with_rows(values, by)
            # The slopes of priors are the same everywhere.
            crossed += by.T @ values
        return Iterate(p, trajectories, reports=reports, fit=fit, previous_slopes_residual=crossed)

    def simulate(
        self, p: Array, trajectories: Sequence[Any] | None = None, guess: Iterate | None = None
    ) -> tuple[list[Any], SimulationError | None]:
        """Simulate all experiments at parameters p, as far as the simulations succeed; their times
        are added to the stopwatch.

        `SearchEnded` is raised if the workers are lost.

        Parameters
        ----------
        p : (np,) array
            All parameters (q, φ).
        trajectories : sequence, optional
            Trajectories of the first rows, which are continued; none by default.
        guess : Iterate, optional
            Iterate near whose positions equilibria are searched first.

        Returns
        -------
        tuple of list of SimulationResult and SimulationError or None
            Trajectories, stored by the workers, and the first failure; None if all are complete.
        """
        known = trajectories or self._repeat(None)
        guesses = guess.trajectories if guess else self._repeat(None)
        results = self.workers.map_experiments(
            simulate_rows, self.solvers, self.transcriptions, self._by_experiment(p), known, guesses
        )
        failures = []
        for failure, spent in self.workers.fetch(
            self.workers.map_experiments(_failure_and_times, results)
        ):
            self.stopwatch.add(*spent)
            failures += [failure] if failure else []
        return results, failures[0] if failures else None

    def extrapolate(self, iterate: Iterate, step: Array) -> list[Any]:
        """Return the positions of each experiment, stored by the workers, after the feasibility
        step of the iterate and a step (np,) of the parameters, to first order.

        `SearchEnded` is raised if the workers are lost.
        """
        return self.workers.map_experiments(
            extrapolate, self.transcriptions, iterate.trajectories, self._by_experiment(step)
        )

    def feasibilities(self, p: Array, trajectories: Sequence[Any]) -> list[Feasibility]:
        """Return how well trajectories, as the workers store them, satisfy the equations of motion at
        parameters p (np,), without a sweep; one for each experiment.

        `SearchEnded` is raised if the workers are lost.
        """
        found = self.workers.map_experiments(
            feasibility, self.transcriptions, self._by_experiment(p), trajectories
        )
        return self.workers.fetch(found)

    def row_counts(self, trajectories: Sequence[Any]) -> list[int]:
        """Return the number of rows of each trajectory.

        `SearchEnded` is raised if the workers are lost.

        Parameters
        ----------
        trajectories : sequence
            One for each experiment, as the workers store them, see `first_rows`.
        """
        return self.workers.fetch(self.workers.map_experiments(_row_count, trajectories))

    def first_rows(self, trajectories: Sequence[Any], counts: Sequence[int]) -> list[Array]:
        """Return the first `counts[i]` rows of each trajectory i, as arrays (counts[i], 3n) [m].

        `SearchEnded` is raised if the workers are lost.

        Parameters
        ----------
        trajectories : sequence
            One for each experiment, as the workers store them: results of sweeps or simulations, or
            arrays of positions.
        counts : sequence of int
            Number of rows for each experiment; a shorter trajectory is returned completely.
        """
        return self.workers.fetch(self.workers.map_experiments(_first_rows, trajectories, counts))

    def _by_experiment(self, p: Array) -> list[Array]:
        """Return the entries (k,) of p (np,), or of a step, that belong to each experiment."""
        return [p[own] for own in self.collocation.parameter_indices]

    def _repeat(self, value: Any) -> list[Any]:
        return [value] * len(self.rows)


def _report(result: LinearisedTrajectory) -> SweepReport:
    """Return the report of a sweep; workers run this function."""
    return result.report


def _row_count(result: LinearisedTrajectory | SimulationResult | Array) -> int:
    """Return the number of rows of a trajectory; workers run this function."""
    return len(trajectory_positions(result))


def _failure_and_times(
    result: SimulationResult,
) -> tuple[SimulationError | None, tuple[float, float, float]]:
    """Return failure and times [s] of a simulation; workers run this function."""
    return result.failure, result.times_s


def _first_rows(result: LinearisedTrajectory | SimulationResult | Array, count: int) -> Array:
    """Return positions (count, 3n) [m] or fewer; workers run this function."""
    return trajectory_positions(result)[:count]


def motion_shares(collocation: Collocation) -> list[Array]:
    """Return for each experiment the share (N,), up to each grid time, of all motion that its
    instruments see; the share of the grid times where they see none. Every parameter must have a
    guess.
    """
    positions = [
        transcription.experiment.rigid_positions(transcription.dynamics.t_s)
        for transcription in collocation.transcriptions
    ]
    rigid = collocation.iterates_at(
        collocation.guess_p, [each.reshape(len(each), -1) for each in positions]
    )
    return [_motion_share(iterate) for iterate in rigid]


def rows_of_share(motion: Array, share: float) -> int:
    """Return the number of first rows of a grid with a share, from 0 to 1, of the motion, see
    `motion_shares`; at least `FEWEST`, at most all, which are those of the share one.
    """
    rows = len(motion) if share >= 1 else int(np.searchsorted(motion, share)) + 1
    return min(len(motion), max(FEWEST, rows))


def _motion_share(rigid: ExperimentIterate) -> Array:
    transcription = rigid.transcription
    t_s = transcription.dynamics.t_s
    squares = np.zeros(len(t_s))
    for kind, values in zip(transcription.residuals, rigid.observables, strict=True):
        residuals = kind.residuals(values, rigid.phi)
        is_compared = kind.compared_with(len(values))[: len(residuals)]
        first = np.take_along_axis(residuals, is_compared.argmax(axis=0)[None], axis=0)
        changes = np.where(is_compared, np.nan_to_num(residuals - first), 0.0)
        rows = np.searchsorted(t_s, kind.t_s[: len(residuals)]).clip(max=len(t_s) - 1)
        np.add.at(squares, rows, np.sum(changes**2, axis=(1, 2)))
    seen = np.cumsum(squares if squares.any() else np.ones(len(t_s)))
    return seen / seen[-1]
