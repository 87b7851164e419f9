"""The state an experiment starts from: equilibrium under its loads, undeformed, or given."""

from __future__ import annotations

import numpy as np

from ..arrays import Array
from ..experiment.experiment import Experiment
from .dynamics import external_force
from .lapack import one_blas_thread
from .memory import start_carried
from .newton import NewtonFailure, Solver, simulation_error


@one_blas_thread()
def rest_state(
    experiment: Experiment,
    theta: Array,
    time_s: float | None = None,
    start: Array | None = None,
    solver: Solver | None = None,
) -> Array:
    """Static equilibrium (3n,) under gravity and external forces, grasped nodes held.

    Starts from the undeformed shape carried by the grasp, or from `start`; where Newton fails
    the load is applied in steps. A body with memory has relaxed, or has been loaded for as long
    as the experiment says.

    Raises
    ------
    SimulationError
        If no stable equilibrium is found.
    """
    solver = solver or Solver(experiment)
    t_s = np.atleast_1d(experiment.t_s[0] if time_s is None else time_s)
    body = experiment.body
    load = external_force(experiment, float(t_s[0]))
    still = np.zeros((1, body.pattern.size))
    carried = start_carried(body, theta, experiment.loaded_since_s)
    x = experiment.rigid_positions(t_s).ravel() if start is None else start.copy()
    x[solver.held] = experiment.grasped(t_s)[1].ravel()[solver.held]

    def solve(x: Array, share: float) -> Array:
        def residual(state: Array) -> Array:
            return body.force(state, still, theta, carried=carried)[0] + share * load

        def linearise(state: Array) -> tuple[Array, Array]:
            forces = body.linearise(state, still, theta, carried=carried)
            return forces.force[0] + share * load, -forces.by_position[0]

        return solver.newton(x, residual, linearise, keep_definite=True)

    reached, increment = 0.0, 1.0
    while reached < 1.0:
        try:
            x = solve(x, min(1.0, reached + increment))
            reached = min(1.0, reached + increment)
        except NewtonFailure as failure:
            increment /= 2
            if increment < 0.5**solver.options.halvings:
                raise simulation_error(
                    solver, failure, float(t_s[0]), "finding the rest state"
                ) from failure
    return x


def start_state(experiment: Experiment, theta: Array, solver: Solver) -> tuple[Array, Array]:
    """x_0 and v_0, each (3n,), after the experiment's start rule."""
    velocity = experiment.start_velocities_m_s
    v0 = np.zeros(experiment.body.pattern.size) if velocity is None else np.ravel(velocity).copy()
    if experiment.start == "equilibrium":
        return rest_state(experiment, theta, solver=solver), v0
    if experiment.start_positions_m is not None:
        return experiment.start_positions_m.ravel().copy(), v0
    return experiment.rigid_positions(experiment.t_s[:1]).ravel(), v0
