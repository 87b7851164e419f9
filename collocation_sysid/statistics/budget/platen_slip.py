"""A specimen's faces on platens if they slide instead of sticking, or stick instead of sliding.

The load of a compression test depends on whether the end faces stick to the platens, and the load
alone does not show which is the case. The displacements of faces that slide instead of sticking are
of first order: those at which the tangential reactions vanish, linearised about the equilibrium with
sticking faces.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from ...common.array_types import Array, Index
from ...model.forces import Forces
from ...program.experiment_iterate import ExperimentIterate
from ...program.forward.initial_equilibrium import static_equations
from ...program.forward.newton_solver import Linearise, NewtonFailure, NewtonSolver, Residual
from ...recording.experiment import FLATNESS, Experiment
from ...recording.grasp import Grasp, free_rigid_modes
from ...recording.measurement_selection import is_load_only

# Numbers of increments from one equilibrium with sticking faces to the next that are tried.
STICKING_INCREMENTS = (1, 4, 16)
# Largest tensile reaction of a face over its largest compressive one for which it may slide: above,
# the face is bonded, since a platen does not pull. Errors of the zero remain below.
LARGEST_TENSION = 0.2


def slip_displacements_m(
    iterate: ExperimentIterate, theta: Array, reactions_n: Array
) -> Array | None:
    """Return the displacements (N, g) [m] of the g prescribed dofs if faces that stick to platens
    slide freely; zero for dofs that remain held.

    Material memory is neglected: the displacements are those of the relaxed material, and so are
    other loads than the grasps.

    Parameters
    ----------
    theta : (k,) array
        Constants of the body.
    reactions_n : (N, g) array
        Reaction forces on the prescribed dofs [N], zero while they are free.

    Returns
    -------
    (N, g) array or None
        None if no face may slide (see `sliding_faces`), if obstacles touch the body, whose
        stiffness these equations lack, or if the linearised equations are singular.
    """
    experiment = iterate.transcription.experiment
    prescribed = iterate.equations.prescribed
    axis = _axis_between_platens(iterate)
    if axis is None:
        return None
    faces = sliding_faces(experiment, prescribed.dofs, reactions_n=reactions_n, axis=axis)
    released = _released_dofs(experiment, faces, axis=axis)
    if not len(released):
        return None
    body = experiment.body
    x = iterate.x
    at = body.linearise(x, np.zeros_like(x), theta=theta)
    kept = np.setdiff1d(prescribed.dofs, released)
    displacements_m = np.zeros_like(reactions_n)
    columns = np.searchsorted(prescribed.dofs, released)
    for row, positions_m in enumerate(x):
        unbalanced_n = np.zeros(positions_m.size)
        unbalanced_n[released] = at.force[row, released]
        try:
            moved_m = _relaxed(
                body.pattern.matrix(-at.by_position[row]),
                unbalanced_n,
                kept=kept,
                positions_m=positions_m,
            )
        except RuntimeError:  # SuperLU: exactly singular
            return None
        displacements_m[row, columns] = moved_m[released]
    return displacements_m


def sticking_change_n(iterate: ExperimentIterate, theta: Array) -> Array | None:
    """Return the change (N, 3n) [N] of the body's forces on the prescribed dofs if faces that slide
    on platens stick to them; zero on other dofs.

    The equilibria with sticking faces are computed, because faces slide far in large compressions.
    Material memory is neglected as in `slip_displacements_m`.

    Parameters
    ----------
    theta : (k,) array
        Constants of the body.

    Returns
    -------
    (N, 3n) array or None
        None if no flat face is pressed and free to slide, if obstacles touch the body, if other
        measurements than loads show the grip, or if there is no such equilibrium.
    """
    experiment = iterate.transcription.experiment
    prescribed = iterate.equations.prescribed
    axis = _axis_between_platens(iterate)
    if axis is None:
        return None
    sliding = [each for each in experiment.body_grasps if tuple(each.axis_indices) == (axis,)]
    dofs = np.setdiff1d(_tangential_dofs(experiment, sliding, axis), prescribed.dofs)
    if not len(dofs):
        return None
    body = experiment.body
    start_m = body.nodes_m.ravel()
    is_held = np.zeros(start_m.size, dtype=bool)
    is_held[prescribed.dofs] = is_held[dofs] = True
    # Faces that hold every node leave no equilibrium to compute.
    solver = None if is_held.all() else NewtonSolver(experiment, prescribed=is_held)
    change_n = np.zeros_like(iterate.x)
    x = start_m
    for row, (time_s, slid_m) in enumerate(zip(experiment.t_s, iterate.x, strict=True)):
        goal_m = slid_m.copy()
        goal_m[dofs] = start_m[dofs]
        if solver is None:
            x = goal_m
        else:
            forces = Forces.from_experiment(experiment, float(time_s), theta=theta)
            equations = static_equations(forces, 1.0, free=solver.free)
            stuck_m = _moved_equilibrium(solver, equations, x, goal_m)
            if stuck_m is None:
                return None
            x = stuck_m
        still = np.zeros((2, x.size))
        stuck_n, slid_n = body.force(np.stack([x, slid_m]), still, theta=theta)
        change_n[row, prescribed.dofs] = (stuck_n - slid_n)[prescribed.dofs]
    return change_n


def _axis_between_platens(iterate: ExperimentIterate) -> int | None:
    """Return the axis along which grips press the body; None where they do not, alone."""
    experiment, prescribed = iterate.transcription.experiment, iterate.equations.prescribed
    if experiment.obstacles or not is_load_only(experiment):
        return None
    return pressed_axis(prescribed.dofs, prescribed.positions_m)


def _moved_equilibrium(
    solver: NewtonSolver, equations: tuple[Residual, Linearise], x: Array, goal_m: Array
) -> Array | None:
    """Equilibrium (3n,) [m] with dofs at `goal_m`, by few increments from x; None without."""
    held = solver.is_prescribed
    for count in STICKING_INCREMENTS:
        state = x
        try:
            for share in np.linspace(0, 1, count + 1)[1:]:
                between_m = x[held] + share * (goal_m - x)[held]
                state = solver.solve_equilibrium(state, *equations, prescribed_m=between_m)
        except NewtonFailure:
            continue
        return state
    return None


def pressed_axis(dofs: Index, positions_m: Array) -> int | None:
    """Return the only axis (0, 1, 2) along which prescribed displacements change; None if they
    change along several axes or none.

    Parameters
    ----------
    dofs : (g,) int array
        Prescribed dofs.
    positions_m : (N, g) array
        Their positions [m]; NaN while a dof is free.
    """
    changing = np.nanmax(positions_m, axis=0) > np.nanmin(positions_m, axis=0)
    axes = np.unique(dofs[changing] % 3)
    return int(axes[0]) if len(axes) == 1 else None


def sliding_faces(
    experiment: Experiment, dofs: Index, reactions_n: Array, axis: int
) -> list[Grasp]:
    """Return the grasps of flat end faces that are pressed and held along all axes, so that it is
    only an assumption that they stick.

    A face that is pulled by more than `LARGEST_TENSION` of its largest compression is bonded.

    Parameters
    ----------
    dofs : (g,) int array
        Prescribed dofs.
    reactions_n : (N, g) array
        Reaction forces on them [N].
    axis : int
        Loading axis, 0 to 2.
    """
    nodes_m = experiment.body.nodes.points_m
    tolerance_m = FLATNESS * float(np.ptp(nodes_m, axis=0).max())
    middle_m = (nodes_m[:, axis].min() + nodes_m[:, axis].max()) / 2
    faces = []
    for grasp in experiment.body_grasps:
        heights_m = nodes_m[grasp.nodes, axis]
        is_measured = grasp.poses.deformation is not None
        if is_measured or len(grasp.axes) < 3 or np.ptp(heights_m) > tolerance_m:
            continue
        normal = np.isin(dofs, 3 * grasp.nodes + axis)
        outward_n = reactions_n[:, normal].sum(axis=1) * np.sign(heights_m.mean() - middle_m)
        compression_n = -outward_n.min()
        if compression_n > 0 and outward_n.max() <= LARGEST_TENSION * compression_n:
            faces.append(grasp)
    return faces


def _released_dofs(experiment: Experiment, faces: list[Grasp], axis: int) -> Index:
    """Return the tangential dofs (s,) of the faces, without those in a plane of symmetry."""
    released = set(_tangential_dofs(experiment, faces, axis))
    for normal, nodes in experiment.planes_of_symmetry:
        if normal != axis:
            released -= set((3 * nodes + normal).tolist())
    return np.array(sorted(released), dtype=np.int64)


def _tangential_dofs(experiment: Experiment, faces: list[Grasp], axis: int) -> list[int]:
    nodes_m = experiment.body.nodes.points_m
    tolerance_m = FLATNESS * float(np.ptp(nodes_m, axis=0).max())
    return [
        int(3 * node + other)
        for face in faces
        if np.ptp(nodes_m[face.nodes, axis]) <= tolerance_m
        for node in face.nodes
        for other in range(3)
        if other != axis
    ]


def _relaxed(stiffness: sp.csc_array, force_n: Array, kept: Index, positions_m: Array) -> Array:
    """Return displacements (3n,) [m] that balance forces to first order, without rigid motions."""
    moving = np.setdiff1d(np.arange(len(force_n)), kept)
    is_kept: NDArray[np.bool_] = np.zeros(len(force_n), dtype=bool)
    is_kept[kept] = True
    _, moved = free_rigid_modes(positions_m.reshape(-1, 3), is_kept.reshape(-1, 3))
    free = moved.reshape(len(force_n), -1)
    modes = (free / np.linalg.norm(free, axis=0)).T[:, moving]
    # Units of the border: a stiffness, so that pivots are comparable.
    scale = float(np.abs(stiffness.diagonal()).mean())
    border = sp.csc_array(scale * modes)
    matrix = sp.block_array(
        [[stiffness[moving][:, moving], border.T], [border, None]], format="csc"
    )
    right = np.concatenate([force_n[moving], np.zeros(len(modes))])
    moved_m = np.zeros(len(force_n))
    moved_m[moving] = splu(matrix).solve(right)[: len(moving)]
    return moved_m
