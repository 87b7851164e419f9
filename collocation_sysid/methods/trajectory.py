"""One experiment's trajectory at a point of the search: what is done where its recording is.

It holds what grows with the timesteps and stays where it was made; a `SweepReport` of it, which
does not grow, is all that the search needs to know. Parameters p are the experiment's own (q, φ).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import Array
from ..errors import SimulationError
from ..program.collocation import Part
from ..program.least_squares import LeastSquares
from ..program.marching import march_on
from ..program.newton import NewtonOptions
from ..program.reading import as_squares
from ..program.segment import Segment
from ..program.sweep import Sweep, Tangent
from .start import continued

# Rows are marched to this accuracy of a Newton step over the body's size: Newton's next one is
# part of the first sweep.
MARCHED = NewtonOptions(tolerance=1e-6)
# Of equilibria near known ones. Those that are not found at once are too far for it.
SETTLED = NewtonOptions(tolerance=1e-9, halvings=0)


@dataclass(frozen=True)
class Seen:
    """How a trajectory fits.

    Attributes
    ----------
    rows : int
    violation_n : float
        Largest |c|.
    squares_m2 : float
        Sum of the squared distances between markers and their readings.
    samples : int
        How many these are.
    """

    rows: int
    violation_n: float
    squares_m2: float
    samples: int

    @classmethod
    def of(cls, part: Part, x: Array, violation_n: float) -> Seen:
        """That of a part, with its markers read at x."""
        squares = part.segment.markers.squared_distances_m2(x, part.phi)
        return cls(len(x), violation_n, float(squares.sum()), len(squares))


@dataclass(frozen=True, eq=False)
class SweepReport:
    """What a search needs to know of a trajectory, of a size that does not grow with the timesteps.

    Attributes
    ----------
    fit : LeastSquares
        Residuals by a step of the k parameters.
    crossed : (k,) S_0ᵀ r with the slopes of the trajectory before; zeros where there was none
    feasibility_m : float
        Longest coordinate of the feasibility step.
    moved_m : float
        The same of the way from the trajectory before.
    indefinite : int
        Timesteps whose equations are not positive definite.
    seen : Seen
        Markers read after the feasibility step.
    spent : seconds as `Stopwatch.add` takes them
    """

    fit: LeastSquares
    crossed: Array
    feasibility_m: float
    moved_m: float
    indefinite: int
    seen: Seen
    spent: tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Swept:
    """A trajectory with what one sweep found there.

    Attributes
    ----------
    x : (rows, 3n)
    tangent : Tangent
    slope : (M, k) S, of all readings after the feasibility step
    report : SweepReport
    """

    x: Array
    tangent: Tangent
    slope: Array
    report: SweepReport

    def __sizeof__(self) -> int:
        # So that a scheduler knows what moving it would take.
        held = (self.x, self.tangent.step, self.tangent.by_p, self.slope)
        return object.__sizeof__(self) + sum(each.nbytes for each in held)


@dataclass(frozen=True, eq=False)
class Reached:
    """A trajectory as far as it goes, why it stopped, and the seconds that it took."""

    x: Array
    failure: SimulationError | None
    spent: tuple[float, float, float]


def positions(found: Swept | Reached | Array) -> Array:
    """The positions (rows, 3n) of what was found."""
    return found if isinstance(found, np.ndarray) else found.x


def swept(
    solver: Sweep,
    segment: Segment,
    huber: float | None,
    p: Array,
    start: Swept | Reached | Array,
    known: Swept | None = None,
    before: Swept | None = None,
) -> Swept:
    """One sweep; a known trajectory of the first rows, at the same p and positions, is continued.

    Raises
    ------
    SimulationError
        Where it is singular or not finite, or a node has no mass.
    """
    part = _part(segment, p, positions(start))
    dynamics = part.setting.dynamics
    if (massless := dynamics.body.massless(dynamics.theta)) is not None:
        raise SimulationError(massless, float(dynamics.t_s[0]))
    tangent = solver.forward(part.x, part.setting, known.tangent if known else None)
    return _read(part, huber, tangent, before, solver.stopwatch.taken())


def tried(
    solver: Sweep,
    segment: Segment,
    huber: float | None,
    p: Array,
    before: Swept,
    step: Array,
) -> Swept:
    """One sweep after a step of the parameters to p.

    A static body is brought to equilibrium first, where one is near: a step along the tangent
    stretches what is slender and turns far, and its loss says little.

    Raises
    ------
    SimulationError
        Where it is singular or not finite.
    """
    part = _part(segment, p, moved(segment, before, step))
    dynamics, x = part.setting.dynamics, part.x
    if dynamics.static:
        settled, failure = march_on(
            segment.experiment,
            dynamics.first_rows(len(x)),
            options=SETTLED,
            stopwatch=solver.stopwatch,
            near=x,
        )
        x = settled if failure is None else x
    return swept(solver, segment, huber, p, x, before=before)


def reread(solver: Sweep, segment: Segment, huber: float | None, p: Array, found: Swept) -> Swept:
    """A trajectory whose recording is read elsewhere."""
    return _read(_part(segment, p, found.x), huber, found.tangent, None, solver.stopwatch.taken())


def moved(segment: Segment, found: Swept, step: Array) -> Array:
    """The trajectory after a step of the parameters."""
    return found.x + found.tangent.step + found.tangent.by_p @ step[segment.moving]


def reached(
    solver: Sweep,
    segment: Segment,
    p: Array,
    known: Swept | Reached | Array | None,
    near: Swept | None,
) -> Reached:
    """The solver's rows at p as far as they go, continuing those known."""
    part = _part(segment, p, np.zeros((0, segment.dofs)) if known is None else positions(known))
    beside = None if near is None else near.x
    x, failure = continued(part, solver.dynamics.rows, MARCHED, solver.stopwatch, beside)
    return Reached(x, failure, solver.stopwatch.taken())


def seen(segment: Segment, p: Array, x: Array) -> Seen:
    """How a trajectory fits that was not swept."""
    part = _part(segment, p, x)
    return Seen.of(part, x, float(np.abs(part.residual_n).max()))


def _part(segment: Segment, p: Array, x: Array) -> Part:
    return Part(segment, p[: segment.nq], p[segment.nq :], x)


def _read(
    part: Part,
    huber: float | None,
    tangent: Tangent,
    before: Swept | None,
    spent: tuple[float, float, float],
) -> Swept:
    """Everything after the feasibility step."""
    response = part.sensing.looked_along(tangent.by_p, tangent.held)
    found = part.sensing.linearised(part.x, response, tangent.step)
    both = zip(found, part.segment.readings, strict=True)
    pairs = [as_squares(*each, reading.huber) for each, reading in both]
    residual = np.concatenate([values.ravel() for values, _ in pairs])
    slope = np.concatenate([by.reshape(values.size, by.shape[-1]) for values, by in pairs])
    report = SweepReport(
        fit=LeastSquares.none(slope.shape[1]).add(residual, slope),
        crossed=np.zeros(slope.shape[1]) if before is None else before.slope.T @ residual,
        feasibility_m=float(np.abs(tangent.step).max()),
        moved_m=0.0 if before is None else float(np.abs(part.x - before.x).max()),
        indefinite=tangent.indefinite,
        seen=Seen.of(part, part.x + tangent.step, tangent.violation_n),
        spent=spent,
    )
    return Swept(part.x, tangent, slope, report)
