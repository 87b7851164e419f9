"""Initial state of an experiment: equilibrium under its loads, undeformed, or stated."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from ...common.array_types import Array, Index
from ...common.step_counting import report_state
from ...common.time_dependence import at_times
from ...model.forces import Forces
from ...model.viscoelasticity import with_start_memory
from ...recording.experiment import Experiment
from ...recording.obstacle import Obstacle
from ..linear_algebra.factorisation import NONE
from ..linear_algebra.lapack import one_blas_thread
from .load_steps import follow_loads
from .newton_solver import (
    Linearise,
    NewtonFailure,
    NewtonLinearisation,
    NewtonSolver,
    Residual,
    SolutionPath,
    simulation_error,
)

# Distance of prescribed dofs from the carried body, over its size, up to which they are in place.
ON_PLACE = 1e-12


@one_blas_thread()
def equilibrium(
    experiment: Experiment,
    theta: Array,
    time_s: float | None = None,
    start: Array | None = None,
    solver: NewtonSolver | None = None,
) -> Array:
    """Return the static equilibrium (3n,) [m] under gravity and external forces, with grasped dofs
    prescribed.

    Newton's method starts from the undeformed body in its grasps, or from `start`; in a body of
    elements with mean dilatation its steps follow the loads, see `load_steps`. If it fails, load,
    natural strains and relative displacements of the grasps are applied in increments, and
    obstacles approach from where they do not touch the body. A body with memory has relaxed, or has
    been loaded for as long as the experiment states.

    Parameters
    ----------
    theta : (k,) array
        Constants of the body.
    time_s : float, optional
        Time of loads and poses [s]; the first time by default.
    start : (3n,) array, optional
        First guess [m].
    solver : NewtonSolver, optional
        Newton's method with the prescribed dofs of that time; a new one by default.

    Raises
    ------
    SimulationError
        If no stable equilibrium is found.
    """
    at_s = float(experiment.t_s[0] if time_s is None else time_s)
    goals_m = experiment.prescribed_displacements([at_s])[1].ravel()
    forces = Forces.from_experiment(experiment, at_s, theta=theta)
    return _solve_equilibrium(
        experiment,
        forces,
        goals_m=goals_m,
        at_s=at_s,
        start=start,
        solver=solver or NewtonSolver(experiment),
    )


def _solve_equilibrium(
    experiment: Experiment,
    forces: Forces,
    goals_m: Array,
    at_s: float,
    start: Array | None,
    solver: NewtonSolver,
) -> Array:
    shape = experiment.rigid_positions([at_s])[0]
    if forces.body.has_memory:
        forces = with_start_memory(forces, experiment.loaded_since_s)
    separate = _with_separate_obstacles(forces, shape)

    def equations(share: float) -> tuple[Residual, Linearise]:
        return static_equations(forces.at_share(share), share, free=solver.free)

    guess = start
    held = solver.is_prescribed
    displaced_m = np.abs(goals_m[held] - shape.ravel()[held]).max(initial=0.0)
    is_on_place = bool(displaced_m <= ON_PLACE * solver.size_m)
    if start is None and experiment.obstacles:
        guess = shape.ravel()
    elif start is None and experiment.body.element.mean_dilatation and is_on_place:
        guess = follow_loads(solver, forces, shape.ravel(), equations)
    path = SolutionPath(
        separate.ravel(),
        halvings=solver.options.max_halvings,
        guess=guess,
        may_begin_small=is_on_place and solver.options.may_begin_small,
    )
    while path.share < 1.0:
        x, share = path.next_guess()
        residual, linearise = equations(share)
        # Grasps that are off are there at the end: the way there may be any.
        goal = (
            goals_m
            if share == 1
            else partial_displacement(experiment, separate, time_s=at_s, share=share).ravel()
        )
        try:
            solution = solver.solve_equilibrium(
                x, residual, linearise=linearise, prescribed_m=goal[solver.is_prescribed]
            )
        except NewtonFailure as failure:
            if path.shorten():
                continue
            raise simulation_error(
                solver,
                failure,
                time_s=at_s,
                what="the search for the initial equilibrium",
                static=True,
            ) from failure
        path.accept(solution)
    report_state(str)  # nothing to display any more
    return path.x


def static_equations(loaded: Forces, share: float, free: Index) -> tuple[Residual, Linearise]:
    """Return the force balance (3n,) [N] of a body at rest as a function of its positions (3n,)
    [m], and its linearisation, which also reports the state of the search.
    """
    zero_velocity = np.zeros((1, loaded.pattern.size))

    def residual(state: Array) -> Array:
        return loaded.total(state, zero_velocity)[0]

    def linearise(state: Array) -> NewtonLinearisation:
        # Nothing moves: there is no skew part.
        at = loaded.linearise(state, zero_velocity)
        report_state(lambda: _describe_state(share, at.force[0][free]))
        return NewtonLinearisation(at.force[0], -at.by_position[0], skew=NONE)

    return residual, linearise


def _describe_state(share: float, force_n: Array) -> str:
    residual_n = float(np.abs(force_n).max(initial=0.0))
    return f"equilibrium at {share:.1%} of the load, residual {residual_n:.1e} N"


def _with_separate_obstacles(forces: Forces, shape: Array) -> Array:
    """Return a shape (n, 3) [m] with the frame of each obstacle moved out of the body."""
    # Deep inside a curved obstacle, its forces are not stable; it must approach from outside.
    places = shape.copy()
    for term in forces.external_terms:
        places = term.separate_bodies(places, shape)
    return places


def partial_displacement(
    experiment: Experiment, displaced_m: Array, time_s: float, share: float
) -> Array:
    """Return a copy of positions with the grasps that hold moved by a share of their displacement
    from the carried body.

    Each grasp rotates about the middle of its nodes, which moves along a line, so that no grasp is
    squeezed or sheared at large rotations. Obstacles have their final rotation already. Other nodes
    keep their positions.
    """
    positions = displaced_m.copy()
    for grasp in experiment.grasps:
        if not grasp.is_active(time_s):
            continue
        start = displaced_m[grasp.nodes]
        nodes = grasp.nodes
        place = np.ix_(nodes, grasp.axis_indices)
        goal = grasp.positions_at(experiment.body.nodes_m, [time_s])[0]
        if isinstance(grasp, Obstacle):
            positions[nodes] = start + share * (goal - start)
            continue
        turn = grasp.poses.at(time_s)[0][0] @ experiment.rigid_motion(time_s)[0][0].T
        part = Rotation.from_rotvec(share * Rotation.from_matrix(turn).as_rotvec())
        middle = start.mean(axis=0)
        way = (goal - start).mean(axis=0)
        partial_m = middle + share * way + part.apply(start - middle)
        own_m = grasp.poses.deformation_at(experiment.body.nodes_m[nodes], time_s)[0]
        partial_m += share * (own_m - own_m.mean(axis=0))
        positions[place] = partial_m[:, grasp.axis_indices]
    return positions


@one_blas_thread()
def initial_state(
    experiment: Experiment,
    forces: Forces,
    solver: NewtonSolver,
    guess: Array | None = None,
    prescribed_m: Array | None = None,
) -> tuple[Array, Array]:
    """Return initial positions x_0 [m] and velocities v_0 [m/s], each (3n,), by the experiment's
    start rule: an equilibrium, stated positions, or the undeformed body in its grasps. Both are new
    arrays; velocities are zero unless stated. Those of B bodies are (B, 3n).

    Parameters
    ----------
    forces : Forces
        Forces at the start.
    solver : NewtonSolver
        Newton's method with the prescribed dofs of the start.
    guess : (3n,) array, optional
        First guess of an equilibrium [m].
    prescribed_m : (3n,) array, optional
        Prescribed positions of an equilibrium [m], NaN at free dofs; those of the experiment by
        default.

    Raises
    ------
    SimulationError
        If no stable equilibrium is found.
    """
    if forces.theta.ndim > 1:
        each = (at_times(forces, slice(1)).with_theta(theta) for theta in forces.theta[..., 0].T)
        states = [initial_state(experiment, one, solver, guess, prescribed_m) for one in each]
        x, v = map(np.array, zip(*states, strict=True))
        return x, v
    velocity = experiment.initial_velocities_m_s
    v0 = np.zeros(experiment.body.pattern.size) if velocity is None else np.ravel(velocity).copy()
    if experiment.is_balanced_at_start:
        at_s = float(experiment.t_s[0])
        prescribed_m = (
            experiment.prescribed_displacements([at_s])[1].ravel()
            if prescribed_m is None
            else prescribed_m
        )
        return _solve_equilibrium(
            experiment, forces, goals_m=prescribed_m, at_s=at_s, start=guess, solver=solver
        ), v0
    if experiment.start_positions_m is not None:
        return experiment.start_positions_m.ravel().copy(), v0
    return experiment.rigid_positions(experiment.t_s[:1]).ravel(), v0
