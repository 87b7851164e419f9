"""Effect of the mesh on the estimates, to first order, without a solve on a finer mesh.

On the mesh with every tetrahedron split into eight, the nodes of the given mesh (with quadratic
elements, its mid nodes too) are corners, and the other nodes are new. With the interpolation I of
the given mesh, the finer mesh moves by I x + e; e is the motion of the new nodes relative to the
given shape functions, and changes slowly compared with their own vibrations. It follows from the
equilibrium of the new nodes, with the derivatives K = −∂F/∂ξ of the forces at I x,

    K_ss e = F_s(I ξ, I ν) − M_s I a,

and the given nodes are subject to a change of force

    Iᵀ(F(I ξ, I ν) − M I a − K e) − (f(ξ, ν) − m a)

compared with the given mesh (static condensation in a hierarchical basis: Zienkiewicz, Gago and
Kelly, Computers & Structures 16, 1983). For nested elements the first part is zero, and the change
is the softening by the new nodes; for elements with mean dilatation it contains the stiffening by
the additional pressures. The equations of motion of the given mesh turn this change of the
forces into a change of the measurements, like that of any systematic effect. No matrix of the finer
mesh is factorised at every time step.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from ...common.array_types import Array, Index
from ...errors import InputError
from ...fem.body import Body
from ...fem.meshes.refinement import refine_body
from ...model.dynamics import Dynamics
from ...model.schemes import Scheme
from ...program.collocation import Collocation
from ...program.linear_algebra.factorisation import NONE, Factoriser
from ...program.linear_algebra.reused_factor import (
    FactorSequence,
    Matrix,
    NodeRotation,
    ReusedFactor,
)
from ...recording.experiment import Experiment
from ...recording.experiment_refinement import refined_experiment
from ..linearised import LinearisedFit
from .consider_analysis import changed_residuals
from .discretisation_error import estimate_changes
from .systematic_effects import Assumption, Effect, ExperimentAtAnswer

# Largest number of nodes of a body whose error of the mesh is estimated in every solve: with more,
# the search starts on a coarser mesh, and a note compares both meshes.
LARGEST_NODE_COUNT = 1500
# Relative accuracy of e: that of an estimate of an error.
ACCURACY = 1e-2
# Weight of the shape function of a node below which it is zero apart from rounding.
NO_WEIGHT = 1e-9


def mesh_change(collocation: Collocation, z: Array, fit: LinearisedFit) -> Array:
    """Return the changes (nq,) of the shared parameters, to first order, on a mesh with every
    tetrahedron split into eight.

    Parameters
    ----------
    collocation : Collocation
    z : (variables,) array
        Variables that satisfy the equations of motion.
    fit : LinearisedFit
        The measurements linearised at z.

    Raises
    ------
    InputError
        If an experiment cannot be transferred to the finer mesh.
    SimulationError, numpy.linalg.LinAlgError
        If the equations are singular.
    """
    changes = changed_residuals(collocation, z, assumptions=[(finer_mesh_row(collocation), 1.0)])
    return estimate_changes(fit, changes.blocks)[: collocation.nq, 0]


def finer_mesh_row(collocation: Collocation) -> Assumption:
    """Return the assumption that the meshes are fine enough: its effect is that of meshes with every
    tetrahedron split into eight.
    """
    bodies = dict.fromkeys(t.body for t in collocation.transcriptions if _has_mesh(t.experiment))
    finer = {id(body): refine_body(body) for body in bodies}
    effect = partial(_effect, scheme=collocation.scheme, finer=finer)
    return Assumption("mesh", "", None, "", remedy="", effect=effect)


def _has_mesh(experiment: Experiment) -> bool:
    """Return whether an experiment is not a homogeneous specimen."""
    return experiment.specimen is None


def _effect(
    at: ExperimentAtAnswer, _: int, scheme: str | Scheme, finer: Mapping[int, Body]
) -> Effect:
    """Return the change of the forces of one experiment by the finer mesh of its body."""
    iterate = at.iterate
    transcription = iterate.transcription
    if at.dynamics.is_temporarily_prescribed.any():
        raise InputError("a grasp takes hold or lets go during the recording")
    if transcription.experiment.obstacles:
        raise InputError("obstacles touch the body")
    fine = refined_experiment(
        transcription.corrected_experiment(iterate.phi), finer[id(transcription.body)]
    )
    dynamics = Dynamics.from_experiment(fine, scheme, transcription.substeps).with_theta(at.theta)
    interpolation = _interpolation(transcription.body, fine.body)
    by_dof = sp.csr_array(sp.kron(interpolation, sp.eye_array(3)))
    held = np.zeros(iterate.x.shape[1], dtype=bool)
    held[transcription.prescribed_dofs] = True
    condensed = _condensed_forces(
        dynamics, iterate.x @ by_dof.T, by_dof, new=_new_dofs(by_dof, held)
    )
    given = _forces_less_inertia(at.dynamics, iterate.x)
    return Effect(force_n=at.pad_rows(condensed - given))


def _forces_less_inertia(dynamics: Dynamics, x: Array) -> Array:
    """Return F − M a (N − first row, 3n) [N] at the evaluations along a motion (N, 3n) [m]."""
    inertia_n = dynamics.rows_to_evaluations(dynamics.mass.inertia_kg * dynamics.acceleration(x))
    return dynamics.force(x) - inertia_n[dynamics.first_row :]


def _condensed_forces(
    dynamics: Dynamics, x: Array, interpolation: sp.csr_array, new: Index
) -> Array:
    """Return Iᵀ(F − M a − K e) (N − first row, 3n) [N] at the evaluations.

    Parameters
    ----------
    dynamics : Dynamics
        Equations of motion on the finer mesh.
    x : (N, 3m) array
        Interpolated positions [m].
    interpolation : (3m, 3n) sparse array
        Matrix I.
    new : (k,) array
        Free dofs of the new nodes.
    """
    unbalanced_n = _forces_less_inertia(dynamics, x)
    xi, nu = dynamics.evaluation_states(x)
    histories = dynamics.histories(x)
    sequence = FactorSequence(
        Factoriser.cached(dynamics.pattern, new),
        NodeRotation(new, dynamics.pattern.size // 3),
        accuracy=ACCURACY,
    )
    relative = np.zeros(dynamics.pattern.size)
    for k in range(len(xi)):
        now = slice(k, k + 1)
        row = dynamics.first_row + k
        forces = dynamics.forces_with_histories(histories, slice(row, row + 1))
        stiffness = -forces.linearise(xi[now], nu[now]).by_position[0]
        system = ReusedFactor(sequence, Matrix(stiffness, NONE), points_m=xi[k].reshape(-1, 3))
        relative[new] = system.solve(unbalanced_n[k, new], guess=relative[new])
        unbalanced_n[k] -= dynamics.pattern.products(stiffness[None], relative[None])[0]
    return unbalanced_n @ interpolation


def _interpolation(body: Body, finer: Body) -> sp.csr_array:
    """Return the matrix (m, n) of the shape functions of a body at the nodes of its refinement;
    nodes of obstacle frames, which come last in both, stay.
    """
    own = len(body.nodes.points_m)
    count = len(finer.nodes.points_m)
    cell_of_node = np.empty(count, dtype=np.int64)
    cell_of_node[finer.cells] = np.arange(len(finer.cells))[:, None]
    parent = cell_of_node // 8
    corners_m = body.mesh.points_m[body.mesh.tetrahedra[parent]]
    edges = (corners_m[:, 1:] - corners_m[:, :1]).transpose(0, 2, 1)
    rest = np.linalg.solve(edges, (finer.nodes.points_m - corners_m[:, 0])[:, :, None])[:, :, 0]
    local = np.column_stack([1.0 - rest.sum(axis=1), rest]).astype(float)
    weights = body.element.shape_functions(local)
    weights[np.abs(weights) < NO_WEIGHT] = 0.0
    nodes = body.cells[parent]
    rows = np.repeat(np.arange(count), nodes.shape[1])
    matrix = sp.csr_array((weights.ravel(), (rows, nodes.ravel())), shape=(count, own))
    matrix.eliminate_zeros()
    frames = len(body.nodes_m) - own
    return sp.csr_array(sp.block_diag([matrix, sp.eye_array(frames)])) if frames else matrix


def _new_dofs(by_dof: sp.csr_array, held: NDArray[np.bool_]) -> Index:
    """Return the free dofs (k,) of the finer mesh that belong to new nodes: they are interpolated
    from several dofs, at least one of which is not `held` (3n,).
    """
    is_new = np.diff(by_dof.indptr) > 1
    return np.flatnonzero(is_new & (abs(by_dof) @ ~held > 0))
