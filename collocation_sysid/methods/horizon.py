"""Least-squares problem on the first rows of every experiment, linearised by sweeps.

`Horizon` distributes the work on the experiments to `Workers` and joins the results to an
`Iterate`. It is used by the reduced-space method and by shooting.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ..arrays import Array
from ..errors import SimulationError
from ..program.collocation import Collocation
from ..program.factorisation import Choice
from ..program.lapack import one_blas_thread
from ..program.least_squares import LeastSquares
from ..program.stopwatch import Stopwatch
from ..program.sweep import Sweep
from .trajectory import (
    Reached,
    Seen,
    SweepReport,
    Swept,
    moved,
    positions,
    reached,
    reread,
    seen,
    swept,
    tried,
)
from .workers import Here, Workers


@dataclass(frozen=True, eq=False)
class Iterate:
    """Parameters and trajectories with the linearised least-squares problem there.

    Attributes
    ----------
    p : (np,) array
        All parameters (q, φ), see `Collocation.pack`.
    trajectories : list of Swept
        Sweep of each experiment, stored by the workers.
    reports : list of SweepReport
        Reports of the sweeps.
    fit : LeastSquares
        Residuals linearised in a step from p: measurements after the feasibility step, and priors.
    crossed : (np,) array
        S_0ᵀ r of its residuals r, with the slopes S_0 of the previous iterate.
    """

    p: Array
    trajectories: list[Any]
    reports: list[SweepReport]
    fit: LeastSquares
    crossed: Array

    @cached_property
    def loss(self) -> float:
        """Loss after the feasibility step, priors included."""
        return self.fit.loss(np.zeros(len(self.p)))

    @cached_property
    def feasibility_m(self) -> float:
        """Largest coordinate of the feasibility step [m]."""
        return max(report.feasibility_m for report in self.reports)

    @cached_property
    def moved_m(self) -> float:
        """Largest change of a coordinate since the previous iterate [m]."""
        return max(report.moved_m for report in self.reports)

    @property
    def finite(self) -> bool:
        """Whether the loss and the feasibility step are finite."""
        return bool(np.isfinite(self.loss) and np.isfinite(self.feasibility_m))

    def predicted_loss(self, step: Array) -> float:
        """Return the loss of the linearised problem after a step (np,) of the parameters."""
        return self.fit.loss(step)


class Horizon:
    """The problem on the first rows of every experiment.

    Arguments named `x` are lists with one entry per experiment, stored by the workers, of any kind
    that `trajectory.positions` accepts.

    Parameters
    ----------
    collocation : Collocation
        Complete problem.
    rows : sequence of int
        Number of grid rows of each experiment.
    prior : float, optional
        Standard deviation of a prior of q around the guess; None for no such prior.
    stopwatch : Stopwatch, optional
        Stopwatch that measures the sweeps.
    factorisation : {"auto", "band", "sparse", "supernodal"}
        Factorisation of a time step's matrix.
    workers : Workers, optional
        Where the experiments are processed; by default threads of this process.
    """

    def __init__(
        self,
        collocation: Collocation,
        rows: Sequence[int],
        prior: float | None = None,
        stopwatch: Stopwatch | None = None,
        factorisation: Choice = "auto",
        workers: Workers | None = None,
    ) -> None:
        self.rows = list(rows)
        self.prior = prior
        self.stopwatch = stopwatch or Stopwatch()
        self.workers = workers or Here(collocation.threads)
        self.read_in(collocation)
        with self.stopwatch.building():
            stopwatches = self._all(None)
            factorisations = self._all(factorisation)
            self.solvers = self.workers.each(
                Sweep, self.segments, self.rows, stopwatches, factorisations
            )

    def read_in(self, collocation: Collocation) -> None:
        """Use another collocation of the same problem, with measurements associated differently."""
        self.collocation = collocation
        self.segments = self.workers.hold(collocation)

    def evaluate(self, p: Array, x: Sequence[Any], known: Iterate | None = None) -> Iterate:
        """Sweep all experiments at parameters p and trajectories x.

        Parameters
        ----------
        p : (np,) array
            All parameters (q, φ).
        x : sequence
            Trajectories, one per experiment.
        known : Iterate, optional
            Iterate of the first rows at the same p and positions, which is continued.

        Raises
        ------
        SimulationError
            If a time step is singular or not finite.
        """
        trajectories = known.trajectories if known else self._all(None)
        return self._found(p, swept, x, trajectories)

    def tried(self, p: Array, before: Iterate, step: Array) -> Iterate:
        """Sweep all experiments after a step of the parameters.

        Static experiments are solved for their equilibria first, see `trajectory.tried`.

        Parameters
        ----------
        p : (np,) array
            Parameters after the step, within their bounds.
        before : Iterate
            Iterate before the step.
        step : (np,) array
            Step of the parameters.

        Raises
        ------
        SimulationError
            If a time step is singular or not finite.
        """
        return self._found(p, tried, before.trajectories, self._own(step))

    def reread(self, p: Array, point: Iterate) -> Iterate:
        """Return an iterate at parameters p (np,) with the measurements of the present
        collocation.
        """
        return self._found(p, reread, point.trajectories)

    @one_blas_thread()
    def _found(self, p: Array, run: Callable[..., Swept], *columns: Sequence[Any]) -> Iterate:
        """Run a function of `trajectory` for every experiment and join the results to an iterate.

        Parameters
        ----------
        p : (np,) array
            All parameters (q, φ).
        run : callable
            Function of (solver, segment, huber, p of the experiment, entries of the columns).
        columns : sequence
            Further arguments, one entry per experiment each.
        """
        thresholds = self._all(self.collocation.huber)
        trajectories = self.workers.each(
            run, self.solvers, self.segments, thresholds, self._own(p), *columns
        )
        reports: list[SweepReport] = self.workers.fetch(self.workers.each(_report, trajectories))
        nq = self.collocation.nq
        places = self.collocation.places
        fit = LeastSquares.none(len(p))
        crossed = np.zeros(len(p))
        for report, own in zip(reports, places, strict=True):
            self.stopwatch.add(*report.spent)
            fit = fit.joined(report.fit, own)
            crossed[own] += report.crossed
        prior, prior_slopes = self.collocation.prior(p)
        priors = [(prior, np.diag(prior_slopes))]
        if self.prior is not None:
            deviation = (p[:nq] - self.collocation.parameters.guess_q) / self.prior
            priors.append((deviation, np.eye(nq, len(p)) / self.prior))
        for values, by in priors:
            fit = fit.add(values, by)
            # The slopes of priors are the same everywhere.
            crossed += by.T @ values
        return Iterate(p, trajectories, reports, fit, crossed)

    def extend(
        self, p: Array, x: Sequence[Any] | None = None, near: Iterate | None = None
    ) -> tuple[list[Any], SimulationError | None]:
        """Simulate all experiments at parameters p, as far as the simulations succeed.

        Parameters
        ----------
        p : (np,) array
            All parameters (q, φ).
        x : sequence, optional
            Trajectories of the first rows, which are continued; none by default.
        near : Iterate, optional
            Iterate near whose positions equilibria are searched first.

        Returns
        -------
        tuple of list of Reached and SimulationError or None
            Trajectories, stored by the workers, and the first failure; None if all are complete.
        """
        known = x or self._all(None)
        guesses = near.trajectories if near else self._all(None)
        results = self.workers.each(
            reached, self.solvers, self.segments, self._own(p), known, guesses
        )
        failures = []
        for failure, spent in self.workers.fetch(self.workers.each(_end, results)):
            self.stopwatch.add(*spent)
            failures += [failure] if failure else []
        return results, failures[0] if failures else None

    def moved(self, point: Iterate, step: Array) -> list[Any]:
        """Return the positions, stored by the workers, after a step (np,) of the parameters."""
        return self.workers.each(moved, self.segments, point.trajectories, self._own(step))

    def seen(self, p: Array, x: Sequence[Any]) -> list[Seen]:
        """Return the fit of trajectories x at parameters p, without a sweep."""
        summaries = self.workers.each(seen, self.segments, self._own(p), x)
        return self.workers.fetch(summaries)

    def lengths(self, x: Sequence[Any]) -> list[int]:
        """Return the number of rows of each trajectory."""
        return self.workers.fetch(self.workers.each(_rows, x))

    def first_rows(self, x: Sequence[Any], counts: Sequence[int]) -> list[Array]:
        """Return the first `counts[i]` rows of each trajectory i, as arrays (counts[i], 3n) [m]."""
        return self.workers.fetch(self.workers.each(_first, x, counts))

    def _own(self, p: Array) -> list[Array]:
        """Return the entries of p (np,) that belong to each experiment."""
        return [p[own] for own in self.collocation.places]

    def _all(self, value: Any) -> list[Any]:
        """Return a list with the same value for every experiment."""
        return [value] * len(self.rows)


def _report(found: Swept) -> SweepReport:
    """Return the report of a sweep; workers run this function."""
    return found.report


def _rows(found: Swept | Reached | Array) -> int:
    """Return the number of rows of a trajectory; workers run this function."""
    return len(positions(found))


def _end(found: Reached) -> tuple[SimulationError | None, tuple[float, float, float]]:
    """Return the failure (None if complete) and the times [s] of a simulation; workers run
    this function.
    """
    return found.failure, found.spent


def _first(found: Swept | Reached | Array, count: int) -> Array:
    """Return the first `count` rows of a trajectory; workers run this function."""
    return positions(found)[:count]
