"""One experiment's trajectory during a search: sweeps, trials and simulations.

These functions run where the experiment is stored, in this process or on a worker of a cluster. A
`LinearisedTrajectory` is stored there because its size grows with the number of time steps; the
search needs only its `SweepReport`, whose size does not. Parameters p are the (q, φ) of the
experiment alone.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import partial

import numpy as np

from ..common.array_types import Array
from ..errors import SimulationError
from ..program.collocation import ExperimentIterate
from ..program.forward.loss_of_stability import explain_failure
from ..program.forward.newton_linearisation import LaggedStress
from ..program.forward.newton_solver import NewtonOptions
from ..program.forward.scheme_simulation import continue_simulation
from ..program.least_squares import SquareRootInformation
from ..program.measurement_residual import huber_as_least_squares
from ..program.observable_response import ObservableResponse
from ..program.sweep import Sweep, SweepResult
from ..program.transcription import Transcription

# Rows are marched to this accuracy of a Newton step over the body's size: Newton's next one is
# part of the first sweep.
MARCHED = NewtonOptions(tolerance=1e-6)
# Options for trials with impacts, whose losses are compared with others: they repeat to 1e-8, and with
# the tolerance of a start to 4e-3.
COMPARED = NewtonOptions(tolerance=1e-8)
# Of equilibria near known ones. Those that are not found at once are too far for it.
# Their stability is decided by the sweep along them, which factorises the same matrices.
SETTLED = NewtonOptions(tolerance=1e-9, max_halvings=0, checks_stability=False)


@dataclass(frozen=True)
class Feasibility:
    """How well one trajectory satisfies the equations of motion."""

    rows: int  # number of grid rows
    violation_n: float  # largest residual of the equations of motion, |c| [N]


@dataclass(frozen=True, eq=False)
class SweepReport(Feasibility):
    """Result of a sweep that the search needs; its size does not depend on the number of time
    steps.
    """

    fit: SquareRootInformation  # residuals linearised in a step of the k parameters
    # (k,): S_0ᵀ r with the slopes S_0 of the previous trajectory; zeros without one.
    previous_slopes_residual: Array
    feasibility_m: float  # largest coordinate of the feasibility step [m]
    position_change_m: float  # largest change of a coordinate since the previous trajectory [m]
    indefinite_steps: int  # number of time steps whose matrix is not positive definite
    # Times of building, evaluations and linear algebra, as for `Stopwatch.add` [s].
    times_s: tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class LinearisedTrajectory(SweepResult):
    """Result of a sweep with the linearised residuals of the measurements."""

    # (M, k): derivatives S of all M measurement residuals by the parameters, after the feasibility
    # step.
    slope: Array
    report: SweepReport  # result that the search needs

    @classmethod
    def from_sweep(
        cls, result: SweepResult, slope: Array, report: SweepReport
    ) -> LinearisedTrajectory:
        """Return a sweep result with the linearised residuals; arguments as the attributes."""
        swept = {field.name: getattr(result, field.name) for field in fields(SweepResult)}
        return cls(**swept, slope=slope, report=report)

    def __sizeof__(self) -> int:
        """Memory [bytes], from which a scheduler estimates the cost of a transfer."""
        arrays = (self.x, self.step, self.by_p, self.slope)
        return object.__sizeof__(self) + sum(each.nbytes for each in arrays)


@dataclass(frozen=True, eq=False)
class SimulationResult:
    """Simulated trajectory, complete or not."""

    x: Array  # (rows, 3n): positions [m], as far as the simulation succeeded
    failure: SimulationError | None  # reason why the simulation ended early; None if it is complete
    # Times of building, evaluations and linear algebra, as for `Stopwatch.add` [s].
    times_s: tuple[float, float, float]


def trajectory_positions(trajectory: LinearisedTrajectory | SimulationResult | Array) -> Array:
    """Return the positions (rows, 3n) [m] of a sweep result (before its feasibility step) or of a
    simulation; an array of positions is returned as it is.
    """
    return trajectory if isinstance(trajectory, np.ndarray) else trajectory.x


def sweep(
    solver: Sweep,
    transcription: Transcription,
    p: Array,
    trajectory: LinearisedTrajectory | SimulationResult | Array,
    known_sweep: LinearisedTrajectory | None = None,
    previous: LinearisedTrajectory | None = None,
    resultants: Array | None = None,
) -> LinearisedTrajectory:
    """Return the result of one sweep at parameters p and given positions: the feasibility step, the
    sensitivities, and the measurement residuals linearised after that step.

    A sweep solves the linearised equations of motion once, forward in time.

    Parameters
    ----------
    solver : Sweep
        Solver of the experiment's linearised equations of motion; its stopwatch is read and reset.
    p : (k,) array
        Parameters (q, φ) of the experiment.
    trajectory : LinearisedTrajectory, SimulationResult or (rows, 3n) array
        Positions [m], with as many rows as the solver.
    known_sweep : LinearisedTrajectory, optional
        Sweep of the first rows at the same p and positions, which is continued.
    previous : LinearisedTrajectory, optional
        Previous trajectory, from which changes are measured; without one they are zero. Its
        sensitivities are the first guess of solutions that are refined.
    resultants : array, optional
        See `Sweep.forward`.

    Raises
    ------
    SimulationError
        If a time step is singular or not finite, or a node has no mass.
    """
    part = _iterate(transcription, p, x=trajectory_positions(trajectory))
    dynamics = part.equations.dynamics
    if (massless := dynamics.body.mass_problem(dynamics.theta)) is not None:
        raise SimulationError(massless, float(dynamics.t_s[0]))
    return _linearised_trajectory(
        part,
        solver.forward(
            part.x, part.equations, known=known_sweep, similar=previous, resultants=resultants
        ),
        previous=previous,
        times_s=solver.stopwatch.read_and_reset(),
    )


def sweep_after_step(
    solver: Sweep,
    transcription: Transcription,
    p: Array,
    previous: LinearisedTrajectory,
    step: Array,
) -> LinearisedTrajectory:
    """Return the result of one sweep after a step of the parameters to p.

    The positions are those of `previous` after its feasibility step, extrapolated along the
    sensitivities as rotations and strains: a linear extrapolation stretches bodies that rotate, and
    a tension of a thousandth of Young's modulus changes how stiff a slender body is in bending.
    Static experiments are first solved for the equilibrium if one is near.

    Parameters
    ----------
    solver : Sweep
        Solver of the experiment's linearised equations of motion; its stopwatch is read and reset.
    p : (k,) array
        Parameters (q, φ) after the step.
    previous : LinearisedTrajectory
        Trajectory before the step.
    step : (k,) array
        Step of the parameters.

    Raises
    ------
    SimulationError
        If a time step is singular or not finite, or a node has no mass.
    """
    x = extrapolate(transcription, previous, step=step)
    if solver.has_retraction:
        held = solver.dynamics.is_temporarily_prescribed[: len(x)]
        x = np.where(held, x, solver.retraction.of_rows(previous.x, x - previous.x))
    part = _iterate(transcription, p, x=x)
    dynamics = part.equations.dynamics

    sweep_from = partial(sweep, solver, transcription, p, previous=previous)

    def equilibria(options: NewtonOptions) -> Array | None:
        """Return the equilibria near the extrapolated positions; None if one is not found."""
        x, failure = continue_simulation(
            transcription.experiment,
            dynamics.truncated_to(len(part.x)),
            options=options,
            stopwatch=solver.stopwatch,
            approximate_solution=part.x,
        )
        return x if failure is None else None

    if not dynamics.is_static:
        resultants = None
        if not dynamics.body.is_solid:
            dynamics = dynamics.truncated_to(len(part.x))
            stress = LaggedStress(dynamics.forces, dynamics.evaluation_states)
            resultants = stress.after(previous.x, part.x - previous.x) - stress.at(part.x)
        return sweep_from(part.x, resultants=resultants)
    x = equilibria(SETTLED)
    if x is None:
        return sweep_from(part.x)
    result = sweep_from(x)
    if not result.report.indefinite_steps:
        return result
    # Only now is it known that the path left the stable equilibria.
    x = equilibria(replace(SETTLED, checks_stability=True))
    return sweep_from(part.x if x is None else x)


def reassociate(
    solver: Sweep, transcription: Transcription, p: Array, sweep_result: LinearisedTrajectory
) -> LinearisedTrajectory:
    """Return the sweep with its measurements evaluated by another transcription.

    The positions and sensitivities are not computed again. The change of positions and
    `previous_slopes_residual` are zero. The given sweep is not modified.

    Parameters
    ----------
    solver : Sweep
        Solver, for its stopwatch, which is read and reset.
    transcription : Transcription
        Transcription with new marker or camera associations.
    p : (k,) array
        Parameters (q, φ) of the experiment.
    sweep_result : LinearisedTrajectory
        Sweep at p.
    """
    return _linearised_trajectory(
        _iterate(transcription, p, x=sweep_result.x),
        sweep_result,
        previous=None,
        times_s=solver.stopwatch.read_and_reset(),
    )


def extrapolate(
    transcription: Transcription, sweep_result: LinearisedTrajectory, step: Array
) -> Array:
    """Return positions (rows, 3n) [m] after the feasibility step of `sweep_result` and a step (k,)
    of the experiment's parameters, to first order. The sweep is that of the `transcription`; it is
    not modified.
    """
    return (
        sweep_result.x
        + sweep_result.step
        + sweep_result.by_p @ step[transcription.dynamic_parameters]
    )


def simulate_rows(
    solver: Sweep,
    transcription: Transcription,
    p: Array,
    known_rows: LinearisedTrajectory | SimulationResult | Array | None,
    guess: LinearisedTrajectory | None,
) -> SimulationResult:
    """Simulate the rows of the solver at parameters p, as far as the simulation succeeds.

    A failure is part of the result. The stopwatch of the solver is read and reset.

    Parameters
    ----------
    solver : Sweep
        Solver; its number of rows is that of the result.
    p : (k,) array
        Parameters (q, φ) of the experiment.
    known_rows : LinearisedTrajectory, SimulationResult, (m, 3n) array or None
        First rows, which are continued; None for none.
    guess : LinearisedTrajectory or None
        Trajectory at other parameters, near which equilibria are searched first; None for none.
    """
    part = _iterate(
        transcription,
        p,
        x=np.zeros((0, transcription.dof_count))
        if known_rows is None
        else trajectory_positions(known_rows),
    )
    x, failure = continue_simulation(
        transcription.experiment,
        part.equations.dynamics.truncated_to(solver.dynamics.row_count),
        known=part.x if len(part.x) else None,
        options=COMPARED if guess is not None and transcription.experiment.obstacles else MARCHED,
        stopwatch=solver.stopwatch,
        approximate_solution=None if guess is None else guess.x,
    )
    if failure is not None:
        failure = explain_failure(
            transcription.experiment, part.equations.dynamics.theta, error=failure
        )
    return SimulationResult(x, failure, times_s=solver.stopwatch.read_and_reset())


def feasibility(transcription: Transcription, p: Array, x: Array) -> Feasibility:
    """Return how well an array of positions x (rows, 3n) [m] satisfies the equations of motion at the
    experiment's parameters p (k,).
    """
    part = _iterate(transcription, p, x=x)
    return Feasibility(len(x), violation_n=float(np.abs(part.compute_residual_n()).max()))


def _iterate(transcription: Transcription, p: Array, x: Array) -> ExperimentIterate:
    return ExperimentIterate(transcription, p[: transcription.nq], phi=p[transcription.nq :], x=x)


def _linearised_trajectory(
    iterate: ExperimentIterate,
    swept: SweepResult,
    previous: LinearisedTrajectory | None,
    times_s: tuple[float, float, float],
) -> LinearisedTrajectory:
    """Return residuals and slopes after the feasibility step, with Huber's loss."""
    response = ObservableResponse.from_array(
        iterate, swept.by_p, swept.grasp_forces, step=swept.step
    )
    matches = zip(response.linearise(), iterate.transcription.residuals, strict=True)
    residuals_and_slopes = [huber_as_least_squares(*each, kind.huber) for each, kind in matches]
    residual = np.concatenate([values.ravel() for values, _ in residuals_and_slopes])
    slope = np.concatenate(
        [by.reshape(values.size, by.shape[-1]) for values, by in residuals_and_slopes]
    )
    report = SweepReport(
        len(iterate.x),
        swept.violation_n,
        fit=SquareRootInformation.empty(slope.shape[1]).with_rows(residual, slope),
        previous_slopes_residual=np.zeros(slope.shape[1])
        if previous is None
        else previous.slope.T @ residual,
        feasibility_m=float(np.abs(swept.step).max()),
        position_change_m=0.0 if previous is None else float(np.abs(iterate.x - previous.x).max()),
        indefinite_steps=swept.indefinite_count,
        times_s=times_s,
    )
    return LinearisedTrajectory.from_sweep(swept, slope, report)
