"""One experiment's trajectory during a search: sweeps, trials and simulations.

These functions run where the experiment is stored, in this process or on a worker of a cluster. A
`Swept` is stored there because its size grows with the number of time steps; the search needs only
its `SweepReport`, whose size does not. Parameters p are the (q, φ) of the experiment alone.
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
    """Fit of one trajectory to its measurements.

    Attributes
    ----------
    rows : int
        Number of grid rows.
    violation_n : float
        Largest residual of the equations of motion, |c| [N].
    squares_m2 : float
        Sum of the squared distances between predicted and measured markers [m²].
    samples : int
        Number of these distances.
    """

    rows: int
    violation_n: float
    squares_m2: float
    samples: int

    @classmethod
    def of(cls, part: Part, x: Array, violation_n: float) -> Seen:
        """Return the fit of positions x (rows, 3n) [m] at the parameters of an experiment.

        Parameters
        ----------
        part : Part
            Experiment with its parameters; its positions are not used.
        x : (rows, 3n) array
            Positions at which the markers are evaluated [m].
        violation_n : float
            Largest residual of the equations of motion [N], as the caller knows it.
        """
        squares = part.segment.markers.squared_distances_m2(x, part.phi)
        return cls(len(x), violation_n, float(squares.sum()), len(squares))


@dataclass(frozen=True, eq=False)
class SweepReport:
    """Result of a sweep that the search needs; its size does not depend on the number of time
    steps.

    Attributes
    ----------
    fit : LeastSquares
        Residuals linearised in a step of the k parameters.
    crossed : (k,) array
        S_0ᵀ r with the slopes S_0 of the previous trajectory; zeros without one.
    feasibility_m : float
        Largest coordinate of the feasibility step [m].
    moved_m : float
        Largest change of a coordinate since the previous trajectory [m].
    indefinite : int
        Number of time steps whose matrix is not positive definite.
    seen : Seen
        Fit of the positions after the feasibility step.
    spent : tuple of three floats
        Times for `Stopwatch.add` [s].
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
    """Trajectory with the result of one sweep.

    Attributes
    ----------
    x : (rows, 3n) array
        Positions [m], before the feasibility step.
    tangent : Tangent
        Feasibility step and sensitivities.
    slope : (M, k) array
        Derivatives S of all M measurement residuals by the parameters, after the feasibility step.
    report : SweepReport
        Result that the search needs.
    """

    x: Array
    tangent: Tangent
    slope: Array
    report: SweepReport

    def __sizeof__(self) -> int:
        """Return the memory size in bytes, from which a scheduler estimates the cost of a
        transfer.
        """
        # So that a scheduler knows what moving it would take.
        arrays = (self.x, self.tangent.step, self.tangent.by_p, self.slope)
        return object.__sizeof__(self) + sum(each.nbytes for each in arrays)


@dataclass(frozen=True, eq=False)
class Reached:
    """Simulated trajectory, complete or not.

    Attributes
    ----------
    x : (rows, 3n) array
        Positions [m], as far as the simulation succeeded.
    failure : SimulationError or None
        Reason why the simulation ended early; None if it is complete.
    spent : tuple of three floats
        Times for `Stopwatch.add` [s].
    """

    x: Array
    failure: SimulationError | None
    spent: tuple[float, float, float]


def positions(found: Swept | Reached | Array) -> Array:
    """Return the positions (rows, 3n) [m] of a sweep result, a simulation, or an array of
    positions.
    """
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
    """Return the result of one sweep at parameters p and given positions.

    Parameters
    ----------
    solver : Sweep
        Solver of the experiment's linearised equations of motion.
    segment : Segment
        Transcription of the experiment.
    huber : float or None
        Not used: each measurement residual has a threshold of its own.
    p : (k,) array
        Parameters (q, φ) of the experiment.
    start : Swept, Reached or (rows, 3n) array
        Positions [m].
    known : Swept, optional
        Sweep of the first rows at the same p and positions, which is continued.
    before : Swept, optional
        Previous trajectory, from which changes are measured.

    Raises
    ------
    SimulationError
        If a time step is singular or not finite, or a node has no mass.
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
    """Return the result of one sweep after a step of the parameters to p.

    The positions are those of `before` extrapolated along the sensitivities. Static experiments are
    first solved for the equilibrium if one is near: a linear extrapolation stretches slender bodies
    that rotate much, so that its loss would be meaningless.

    Parameters
    ----------
    solver : Sweep
        Solver of the experiment's linearised equations of motion.
    segment : Segment
        Transcription of the experiment.
    huber : float or None
        See `swept`.
    p : (k,) array
        Parameters (q, φ) after the step.
    before : Swept
        Trajectory before the step.
    step : (k,) array
        Step of the parameters.

    Raises
    ------
    SimulationError
        If a time step is singular or not finite.
    """
    part = _part(segment, p, moved(segment, before, step))
    dynamics = part.setting.dynamics
    x = part.x
    if dynamics.static:
        equilibria, failure = march_on(
            segment.experiment,
            dynamics.first_rows(len(x)),
            options=SETTLED,
            stopwatch=solver.stopwatch,
            near=x,
        )
        x = equilibria if failure is None else x
    return swept(solver, segment, huber, p, x, before=before)


def reread(solver: Sweep, segment: Segment, huber: float | None, p: Array, found: Swept) -> Swept:
    """Return the sweep with its measurements evaluated by another transcription.

    The positions and sensitivities are not computed again.

    Parameters
    ----------
    solver : Sweep
        Solver, for its stopwatch.
    segment : Segment
        Transcription with new marker or camera associations.
    huber : float or None
        See `swept`.
    p : (k,) array
        Parameters (q, φ) of the experiment.
    found : Swept
        Sweep at p.
    """
    return _read(_part(segment, p, found.x), huber, found.tangent, None, solver.stopwatch.taken())


def moved(segment: Segment, found: Swept, step: Array) -> Array:
    """Return positions (rows, 3n) [m] after the feasibility step and a step (k,) of the
    parameters.
    """
    return found.x + found.tangent.step + found.tangent.by_p @ step[segment.moving]


def reached(
    solver: Sweep,
    segment: Segment,
    p: Array,
    known: Swept | Reached | Array | None,
    near: Swept | None,
) -> Reached:
    """Simulate the rows of the solver at parameters p, as far as the simulation succeeds.

    Parameters
    ----------
    solver : Sweep
        Solver; its number of rows is that of the result.
    segment : Segment
        Transcription of the experiment.
    p : (k,) array
        Parameters (q, φ) of the experiment.
    known : Swept, Reached, (m, 3n) array or None
        First rows, which are continued; None for none.
    near : Swept or None
        Trajectory at other parameters, near which equilibria are searched first.
    """
    part = _part(segment, p, np.zeros((0, segment.dofs)) if known is None else positions(known))
    guess_positions = None if near is None else near.x
    x, failure = continued(part, solver.dynamics.rows, MARCHED, solver.stopwatch, guess_positions)
    return Reached(x, failure, solver.stopwatch.taken())


def seen(segment: Segment, p: Array, x: Array) -> Seen:
    """Return the fit of positions x (rows, 3n) [m] at parameters p, with residuals computed
    from them.
    """
    part = _part(segment, p, x)
    return Seen.of(part, x, float(np.abs(part.residual_n).max()))


def _part(segment: Segment, p: Array, x: Array) -> Part:
    """Return the experiment at parameters p (k,) and positions x (rows, 3n)."""
    return Part(segment, p[: segment.nq], p[segment.nq :], x)


def _read(
    part: Part,
    huber: float | None,
    tangent: Tangent,
    before: Swept | None,
    spent: tuple[float, float, float],
) -> Swept:
    """Return the sweep result: measurement residuals and slopes after the feasibility step.

    Parameters
    ----------
    part : Part
        Experiment at the parameters and positions of the sweep.
    huber : float or None
        See `swept`.
    tangent : Tangent
        Feasibility step and sensitivities.
    before : Swept or None
        Previous trajectory; None for none.
    spent : tuple of three floats
        Times for `Stopwatch.add` [s].
    """
    response = part.sensing.looked_along(tangent.by_p, tangent.held)
    predictions = part.sensing.linearised(part.x, response, tangent.step)
    matches = zip(predictions, part.segment.readings, strict=True)
    residuals_and_slopes = [as_squares(*each, reading.huber) for each, reading in matches]
    residual = np.concatenate([values.ravel() for values, _ in residuals_and_slopes])
    slope = np.concatenate(
        [by.reshape(values.size, by.shape[-1]) for values, by in residuals_and_slopes]
    )
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
