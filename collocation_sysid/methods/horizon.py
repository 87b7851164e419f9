"""The NLP on the first rows of every experiment, as the reduced-space method sees it."""

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
    """Parameters and trajectories, with what one sweep found there.

    Attributes
    ----------
    p : (np,) all parameters, see `Collocation.pack`
    trajectories : list of Swept, one per experiment, kept where they were found
    reports : list of SweepReport, of the trajectories
    fit : LeastSquares
        By a step from p: of markers after the feasibility step, sensors and priors.
    crossed : (np,) S_0ᵀ r of its residuals, with the slopes S_0 of the point it was tried from
    """

    p: Array
    trajectories: list[Any]
    reports: list[SweepReport]
    fit: LeastSquares
    crossed: Array

    @cached_property
    def loss(self) -> float:
        """Loss of the projected positions, priors included."""
        return self.fit.loss(np.zeros(len(self.p)))

    @cached_property
    def feasibility_m(self) -> float:
        """Longest coordinate of the feasibility step."""
        return max(report.feasibility_m for report in self.reports)

    @cached_property
    def moved_m(self) -> float:
        """Longest coordinate of the way from the point it was tried from."""
        return max(report.moved_m for report in self.reports)

    @property
    def finite(self) -> bool:
        """Whether loss and feasibility are numbers."""
        return bool(np.isfinite(self.loss) and np.isfinite(self.feasibility_m))

    def predicted_loss(self, step: Array) -> float:
        """Loss after a step of the parameters, of the linearised problem."""
        return self.fit.loss(step)


class Horizon:
    """The NLP on the first rows of every experiment.

    Trajectories are kept by the workers: of any kind that `positions` takes.

    Parameters
    ----------
    collocation : Collocation
    rows : sequence of int
        Grid rows of each experiment.
    prior : float, optional
        Standard deviation of a prior that holds q near the guess.
    stopwatch : Stopwatch, optional
    factorisation : {"auto", "band", "sparse", "supernodal"}
    workers : Workers, optional
        Threads of this process by default.
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
            options = self._all(None), self._all(factorisation)
            self.solvers = self.workers.each(Sweep, self.segments, self.rows, *options)

    def read_in(self, collocation: Collocation) -> None:
        """Take the same problem, read elsewhere."""
        self.collocation, self.segments = collocation, self.workers.hold(collocation)

    def evaluate(self, p: Array, x: Sequence[Any], known: Iterate | None = None) -> Iterate:
        """One sweep; a point of the first rows, at the same p and positions, is continued.

        Raises
        ------
        SimulationError
            Where it is singular or not finite.
        """
        trajectories = known.trajectories if known else self._all(None)
        return self._found(p, swept, x, trajectories)

    def tried(self, p: Array, before: Iterate, step: Array) -> Iterate:
        """One sweep after a step from a point, static bodies in equilibrium where that is near.

        Raises
        ------
        SimulationError
            Where it is singular or not finite.
        """
        return self._found(p, tried, before.trajectories, self._own(step))

    def reread(self, p: Array, point: Iterate) -> Iterate:
        """The point as the problem is read now, where its parameters are p."""
        return self._found(p, reread, point.trajectories)

    @one_blas_thread()
    def _found(self, p: Array, run: Callable[..., Swept], *columns: Sequence[Any]) -> Iterate:
        common = self.segments, self._all(self.collocation.huber), self._own(p)
        trajectories = self.workers.each(run, self.solvers, *common, *columns)
        reports: list[SweepReport] = self.workers.fetch(self.workers.each(_report, trajectories))
        nq, places = self.collocation.nq, self.collocation.places
        fit, crossed = LeastSquares.none(len(p)), np.zeros(len(p))
        for report, own in zip(reports, places, strict=True):
            self.stopwatch.add(*report.spent)
            fit = fit.joined(report.fit, own)
            crossed[own] += report.crossed
        prior, prior_slopes = self.collocation.prior(p)
        priors = [(prior, np.diag(prior_slopes))]
        if self.prior is not None:
            off = (p[:nq] - self.collocation.parameters.guess_q) / self.prior
            priors.append((off, np.eye(nq, len(p)) / self.prior))
        for values, by in priors:
            fit = fit.add(values, by)
            # The slopes of priors are the same everywhere.
            crossed += by.T @ values
        return Iterate(p, trajectories, reports, fit, crossed)

    def extend(
        self, p: Array, x: Sequence[Any] | None = None, near: Iterate | None = None
    ) -> tuple[list[Any], SimulationError | None]:
        """Trajectories at p as far as they go, continuing those given; and why they stopped.

        Equilibria are looked for first where those of `near` are.
        """
        known, beside = x or self._all(None), near.trajectories if near else self._all(None)
        common = self.solvers, self.segments, self._own(p)
        found = self.workers.each(reached, *common, known, beside)
        failures = []
        for failure, spent in self.workers.fetch(self.workers.each(_end, found)):
            self.stopwatch.add(*spent)
            failures += [failure] if failure else []
        return found, failures[0] if failures else None

    def moved(self, point: Iterate, step: Array) -> list[Any]:
        """Trajectories after a step of the parameters."""
        return self.workers.each(moved, self.segments, point.trajectories, self._own(step))

    def seen(self, p: Array, x: Sequence[Any]) -> list[Seen]:
        """How trajectories fit that were not swept."""
        found = self.workers.each(seen, self.segments, self._own(p), x)
        return self.workers.fetch(found)

    def lengths(self, x: Sequence[Any]) -> list[int]:
        """Rows of each trajectory."""
        return self.workers.fetch(self.workers.each(_rows, x))

    def first_rows(self, x: Sequence[Any], counts: Sequence[int]) -> list[Array]:
        """So many first rows of each trajectory."""
        return self.workers.fetch(self.workers.each(_first, x, counts))

    def _own(self, p: Array) -> list[Array]:
        """The share of each experiment in what every parameter has an entry of."""
        return [p[own] for own in self.collocation.places]

    def _all(self, value: Any) -> list[Any]:
        """The same for every experiment."""
        return [value] * len(self.rows)


def _report(found: Swept) -> SweepReport:
    return found.report


def _rows(found: Swept | Reached | Array) -> int:
    return len(positions(found))


def _end(found: Reached) -> tuple[SimulationError | None, tuple[float, float, float]]:
    return found.failure, found.spent


def _first(found: Swept | Reached | Array, count: int) -> Array:
    return positions(found)[:count]
