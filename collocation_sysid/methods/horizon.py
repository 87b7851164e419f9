"""The NLP on the first rows of every experiment, as the reduced-space method sees it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..errors import SimulationError
from ..nlp.collocation import Collocation
from ..nlp.factorisation import Choice
from ..nlp.marching import march_on
from ..nlp.newton import NewtonOptions
from ..nlp.stopwatch import Stopwatch
from ..nlp.tangent import BlockSolver, Tangent
from .robust import huberised

Array = NDArray[np.float64]

# Rows are marched to this accuracy of a Newton step over the body's size: Newton's next one is
# part of the first sweep.
MARCHED = NewtonOptions(tolerance=1e-3)


@dataclass(frozen=True, eq=False)
class Point:
    """Parameters and trajectories, with what one sweep found there.

    Attributes
    ----------
    q : (nq,)
    x : list of (rows, 3n), one per experiment
    tangents : list of Tangent
    residual : (M,) r + S_p, markers after the feasibility step, and residuals of the priors
    slope : (M, nq) S and the slopes of the priors
    """

    q: Array
    x: list[Array]
    tangents: list[Tangent]
    residual: Array
    slope: Array

    @cached_property
    def loss(self) -> float:
        """Loss of the projected trajectory, priors included."""
        return float(self.residual @ self.residual)

    @cached_property
    def feasibility_m(self) -> float:
        """Longest coordinate of the feasibility step."""
        return max(float(np.abs(tangent.step).max()) for tangent in self.tangents)

    @property
    def finite(self) -> bool:
        """Whether loss and feasibility are numbers."""
        return bool(np.isfinite(self.loss) and np.isfinite(self.feasibility_m))

    def moved(self, step: Array) -> list[Array]:
        """Trajectories after the step (p + Z dq, dq)."""
        return [
            x + tangent.step + tangent.by_q @ step
            for x, tangent in zip(self.x, self.tangents, strict=True)
        ]

    def predicted_loss(self, step: Array) -> float:
        """Loss after a step of q, of the linearised problem."""
        linear = self.residual + self.slope @ step
        return float(linear @ linear)


class Horizon:
    """The NLP on the first rows of every experiment.

    Parameters
    ----------
    collocation : Collocation
    rows : sequence of int
        Grid rows of each experiment.
    prior : float, optional
        Standard deviation of a prior that holds q near the guess.
    stopwatch : Stopwatch, optional
    factorisation : {"auto", "band", "sparse"}
    huber : float, optional
        Threshold of Huber's loss, in standard deviations; squared without it.
    """

    def __init__(
        self,
        collocation: Collocation,
        rows: Sequence[int],
        prior: float | None = None,
        stopwatch: Stopwatch | None = None,
        factorisation: Choice = "auto",
        huber: float | None = None,
    ) -> None:
        self.collocation = collocation
        self.huber = huber
        self.rows = list(rows)
        self.prior = prior
        self.stopwatch = stopwatch or Stopwatch()
        with self.stopwatch.building():
            self.solvers = [
                BlockSolver(segment, count, self.stopwatch, factorisation)
                for segment, count in zip(collocation.segments, rows, strict=True)
            ]

    def evaluate(self, q: Array, x: list[Array], known: Point | None = None) -> Point:
        """One sweep; a point of the first rows, at the same q and positions, is continued.

        Raises
        ------
        SimulationError
            Where it is singular or not finite.
        """
        parameters = self.collocation.parameters
        theta = parameters.theta(q)
        theta_q, _ = parameters.theta_derivatives(q)
        tangents, residuals, slopes = [], [], []
        for k, (solver, x_k) in enumerate(zip(self.solvers, x, strict=True)):
            first = known.tangents[k] if known else None
            tangent = solver.forward(x_k, theta, theta_q, first)
            observation = solver.segment.observation
            residual, slope = observation.linearised(x_k, tangent.step, tangent.by_q)
            if self.huber is not None:
                residual, slope = huberised(residual, slope, self.huber)
            tangents.append(tangent)
            residuals.append(residual)
            slopes.append(slope)
        prior, prior_slopes = parameters.prior(q)
        if self.prior is not None:
            residuals.append((q - parameters.guess_q) / self.prior)
            slopes.append(np.eye(len(q)) / self.prior)
        residual = np.concatenate([*residuals, prior])
        return Point(q, x, tangents, residual, np.concatenate([*slopes, np.diag(prior_slopes)]))

    def extend(
        self, q: Array, x: list[Array] | None = None
    ) -> tuple[list[Array], SimulationError | None]:
        """Trajectories at q as far as they go, continuing those given; and why they stopped."""
        theta = self.collocation.parameters.theta(q)
        extended, first_failure = [], None
        for k, solver in enumerate(self.solvers):
            known = x[k] if x is not None and len(x[k]) else None
            rows, failure = march_on(
                solver.segment.experiment,
                solver.dynamics,
                theta,
                known,
                MARCHED,
                stopwatch=self.stopwatch,
            )
            extended.append(rows)
            first_failure = first_failure or failure
        return extended, first_failure
