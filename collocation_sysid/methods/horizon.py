"""The NLP on the first rows of every experiment, as the reduced-space method sees it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..arrays import Array, Index
from ..errors import SimulationError
from ..fem.batched import side_by_side
from ..nlp.collocation import Collocation, Part
from ..nlp.factorisation import Choice
from ..nlp.lapack import one_blas_thread
from ..nlp.marching import march_on
from ..nlp.newton import NewtonOptions
from ..nlp.stopwatch import Stopwatch
from ..nlp.tangent import BlockSolver, Tangent
from .robust import huberised
from .start import marched

# Rows are marched to this accuracy of a Newton step over the body's size: Newton's next one is
# part of the first sweep.
MARCHED = NewtonOptions(tolerance=1e-6)
# Of equilibria near known ones. Those that are not found at once are too far for it.
SETTLED = NewtonOptions(tolerance=1e-9, halvings=0)


@dataclass(frozen=True, eq=False)
class Point:
    """Parameters and trajectories, with what one sweep found there.

    Attributes
    ----------
    p : (np,) all parameters, see `Collocation.pack`
    x : list of (rows, 3n), one per experiment
    tangents : list of Tangent
    residual : (M,) r + S_p, markers after the feasibility step, and residuals of the priors
    slope : (M, np) S and the slopes of the priors
    moving : list of positions in p that move each experiment's body
    """

    p: Array
    x: list[Array]
    tangents: list[Tangent]
    residual: Array
    slope: Array
    moving: list[Index]

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
        """Trajectories after a step of the parameters."""
        return [
            x + tangent.step + tangent.by_p @ step[moving]
            for x, tangent, moving in zip(self.x, self.tangents, self.moving, strict=True)
        ]

    def predicted_loss(self, step: Array) -> float:
        """Loss after a step of the parameters, of the linearised problem."""
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
    """

    def __init__(
        self,
        collocation: Collocation,
        rows: Sequence[int],
        prior: float | None = None,
        stopwatch: Stopwatch | None = None,
        factorisation: Choice = "auto",
    ) -> None:
        self.collocation = collocation
        self.rows = list(rows)
        self.prior = prior
        self.stopwatch = stopwatch or Stopwatch()
        with self.stopwatch.building():
            self.solvers = [
                BlockSolver(segment, count, self.stopwatch, factorisation)
                for segment, count in zip(collocation.segments, rows, strict=True)
            ]

    @one_blas_thread()
    def evaluate(self, p: Array, x: list[Array], known: Point | None = None) -> Point:
        """One sweep; a point of the first rows, at the same p and positions, is continued.

        Raises
        ------
        SimulationError
            Where it is singular or not finite.
        """
        parts = self.collocation.parts_at(p, x)

        def swept(k: int) -> Tangent:
            before = known.tangents[k] if known else None
            return self.solvers[k].forward(parts[k].x, parts[k].setting, before)

        threads = self.collocation.threads
        return self.read(p, x, side_by_side(swept, range(len(parts)), threads))

    def settled(self, p: Array, x: list[Array]) -> list[Array]:
        """The same trajectories, those of static experiments in equilibrium where one is near.

        A step along the tangent stretches what is slender and turns far: its loss says little.
        """

        def of(part: Part) -> Array:
            dynamics, near = part.setting.dynamics, part.x
            if not dynamics.static:
                return near
            settled, failure = march_on(
                part.segment.corrected(part.phi),
                dynamics.first_rows(len(near)),
                part.setting.theta,
                options=SETTLED,
                stopwatch=self.stopwatch,
                near=near,
            )
            return settled if failure is None else near

        return side_by_side(of, self.collocation.parts_at(p, x), self.collocation.threads)

    def read(self, p: Array, x: list[Array], tangents: list[Tangent]) -> Point:
        """A point whose tangents are known, with its markers as the collocation reads them."""
        collocation = self.collocation
        nq = collocation.nq
        residuals, slopes = [], []
        for part, tangent in zip(collocation.parts_at(p, x), tangents, strict=True):
            segment, observation = part.segment, part.segment.observation
            residual, here = observation.linearised(
                part.x + tangent.step,
                part.phi,
                observation.at_samples(tangent.by_p, part.phi),
                segment.moving,
                nq,
            )
            sensed = _sensed(part, tangent) if segment.sensors else []
            for values, by in ((residual, here), *sensed):
                residuals.append(values.ravel())
                slopes.append(np.zeros((values.size, len(p))))
                slopes[-1][:, segment.places] = by.reshape(values.size, by.shape[-1])
        if collocation.huber is not None:
            pairs = zip(residuals, slopes, strict=True)
            reweighted = [huberised(r, s, collocation.huber) for r, s in pairs]
            residuals, slopes = map(list, zip(*reweighted, strict=True))
        if self.prior is not None:
            residuals.append((p[:nq] - collocation.parameters.guess_q) / self.prior)
            slopes.append(np.eye(nq, len(p)) / self.prior)
        prior, prior_slopes = collocation.prior(p)
        return Point(
            p,
            x,
            tangents,
            np.concatenate([*residuals, prior]),
            np.concatenate([*slopes, np.diag(prior_slopes)]),
            [segment.places[segment.moving] for segment in collocation.segments],
        )

    def extend(
        self, p: Array, x: list[Array] | None = None, near: list[Array] | None = None
    ) -> tuple[list[Array], SimulationError | None]:
        """Trajectories at p as far as they go, continuing those given; and why they stopped.

        Equilibria are looked for first where those of `near` are.
        """
        return marched(self.collocation, p, x, self.rows, MARCHED, self.stopwatch, near)


def _sensed(part: Part, tangent: Tangent) -> list[tuple[Array, Array]]:
    """Residuals of the sensors after the feasibility step, and their slopes by (q, φ)."""
    dofs = part.segment.sensed_dofs
    moved = np.concatenate([tangent.step[:, dofs, None], tangent.by_p[:, dofs]], axis=2)
    return part.sensing.projected(part.x, tangent.held, moved)
