"""The state an experiment starts from: equilibrium under its loads, undeformed, or given."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from ..arrays import Array
from ..model.contact import Contact
from ..model.forces import Forces
from ..model.viscoelasticity import at_start
from ..recording.experiment import Experiment
from ..recording.obstacle import Obstacle
from .factorisation import NONE
from .lapack import one_blas_thread
from .newton import NewtonFailure, Solver, followed, simulation_error


@one_blas_thread()
def rest_state(
    experiment: Experiment,
    theta: Array,
    time_s: float | None = None,
    start: Array | None = None,
    solver: Solver | None = None,
) -> Array:
    """Static equilibrium (3n,) under gravity and external forces, grasped nodes held.

    Starts from the undeformed shape carried by the grasp, or from `start`; where Newton fails, the
    load is applied and the other grasps are moved in steps, from the shape carried; obstacles come
    from where they just do not touch it. A body with memory has relaxed, or has been loaded for as
    long as the experiment says.

    Raises
    ------
    SimulationError
        If no stable equilibrium is found.
    """
    at_s = float(experiment.t_s[0] if time_s is None else time_s)
    goals_m = experiment.grasped([at_s])[1].ravel()
    forces = Forces.of(experiment, at_s, theta)
    return _at_rest(experiment, forces, goals_m, at_s, start, solver or Solver(experiment))


def _at_rest(
    experiment: Experiment,
    forces: Forces,
    goals_m: Array,
    at_s: float,
    start: Array | None,
    solver: Solver,
) -> Array:
    still, shape = np.zeros((1, len(goals_m))), experiment.rigid_positions([at_s])[0]
    forces = at_start(forces, experiment.loaded_since_s)
    away = _before_contact(forces, shape)

    def solve(x: Array, share: float) -> Array:
        loaded = forces.scaled(share)

        def residual(state: Array) -> Array:
            return loaded.total(state, still)[0]

        def linearise(state: Array) -> tuple[Array, Array, Array]:
            # Nothing moves: there is no skew part.
            at = loaded.linearise(state, still)
            return at.force[0], -at.by_position[0], NONE

        # Grasps that are off are there at the end: the way there may be any.
        goal = goals_m if share == 1 else _on_the_way(experiment, away, at_s, share).ravel()
        return solver.newton(x, residual, linearise, keep_definite=True, goal=goal[solver.held])

    guess = shape.ravel() if start is None and experiment.obstacles else start
    try:
        return followed(solve, away.ravel(), solver.options.halvings, guess)
    except NewtonFailure as failure:
        raise simulation_error(
            solver, failure, at_s, "finding the rest state", static=True
        ) from failure


def _before_contact(forces: Forces, shape: Array) -> Array:
    """A shape (n, 3) with each obstacle drawn back from the point that is deepest in it.

    What a curved obstacle does to points far inside is not stable: it has to be come upon.
    """
    places = shape.copy()
    for term in forces.further:
        if isinstance(term, Contact):
            frame, (depth_m, normal) = term.contact.obstacle.nodes, term.deepest(shape.ravel())
            places[frame] -= max(depth_m, 0.0) * normal
    return places


def _on_the_way(experiment: Experiment, carried: Array, time_s: float, share: float) -> Array:
    """Held nodes (n, 3) when their grasps have come a share of their way from the carried body.

    Each grasp turns about the middle of its nodes, which goes straight: none is squeezed or
    sheared on the way, however far it turns. Obstacles are turned already. Other nodes stay where
    they are carried.
    """
    positions = carried.copy()
    for grasp in experiment.grasps:
        if not grasp.holds(time_s):
            continue
        start, nodes = carried[grasp.nodes], grasp.nodes
        place = np.ix_(nodes, grasp.columns)
        goal = grasp.carry(experiment.body.nodes_m, [time_s])[0]
        if isinstance(grasp, Obstacle):
            positions[nodes] = start + share * (goal - start)
            continue
        turn = grasp.poses.at(time_s)[0][0] @ experiment.rigid_motion(time_s)[0][0].T
        part = Rotation.from_rotvec(share * Rotation.from_matrix(turn).as_rotvec())
        middle, way = start.mean(axis=0), (goal - start).mean(axis=0)
        moved = middle + share * way + part.apply(start - middle)
        positions[place] = moved[:, grasp.columns]
    return positions


@one_blas_thread()
def start_state(
    experiment: Experiment,
    forces: Forces,
    solver: Solver,
    near: Array | None = None,
    goals_m: Array | None = None,
) -> tuple[Array, Array]:
    """x_0 and v_0, each (3n,), after the experiment's start rule.

    Parameters
    ----------
    experiment : Experiment
    forces : Forces
        At the start.
    solver : Solver
    near : (3n,) another x_0, where an equilibrium is looked for first
    goals_m : (3n,) where dofs are held, NaN while free; as the experiment states by default
    """
    velocity = experiment.start_velocities_m_s
    v0 = np.zeros(experiment.body.pattern.size) if velocity is None else np.ravel(velocity).copy()
    if experiment.start == "equilibrium":
        at_s = float(experiment.t_s[0])
        goals_m = experiment.grasped([at_s])[1].ravel() if goals_m is None else goals_m
        return _at_rest(experiment, forces, goals_m, at_s, near, solver), v0
    if experiment.start_positions_m is not None:
        return experiment.start_positions_m.ravel().copy(), v0
    return experiment.rigid_positions(experiment.t_s[:1]).ravel(), v0
