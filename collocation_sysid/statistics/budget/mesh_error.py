"""Effect of the mesh on the estimates, to first order, without a solve on a finer mesh.

On the mesh with every tetrahedron split into eight, the nodes of the given mesh (with quadratic
elements, its mid nodes too) are corners, and the other nodes are new. With the interpolation I of
the given mesh, the finer mesh moves by I x + e. With the derivatives K = −∂F/∂ξ of the forces at
I x, its nodes satisfy

    K e = F(I ξ, I ν) − M I a

to first order. In a motion, e is set to zero at the corners of the given mesh: e of the other
nodes changes slowly compared with their own vibrations (static condensation: Guyan, AIAA Journal 3,
1965). In equilibria all free nodes move, and nothing is neglected. The given nodes are subject to a
change of force

    Iᵀ(F(I ξ, I ν) − M I a − K e) − (f(ξ, ν) − m a) + k e_g

compared with the given mesh, with its own derivatives k and the part e_g of e at the given nodes:
this change makes them move by e_g, and changes the forces on held nodes like the finer mesh. The
equations of motion of the given mesh turn it into a change of the measurements, like that of any
systematic effect. No matrix of the finer mesh is factorised at every time step of a motion.

With e zero at the mid nodes of quadratic elements too, their own equations would have to turn the
forces on them into displacements, to first order; they are much too stiff where one nearly
incompressible element is as thick as the body.

Elements with mean dilatation have the pressures of the given mesh in K. Those of I x contain errors
of the interpolated volumes times the bulk modulus, which the equilibrium of the finer mesh does not
have; as geometric stiffness they would make e arbitrary in a nearly incompressible body.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial

import numpy as np
import scipy.sparse as sp

from ...common.array_types import Array, Index
from ...errors import InputError
from ...fem.body import Body
from ...fem.meshes.refinement import refine_body
from ...fem.schemes import Scheme
from ...model.dynamics import Dynamics
from ...model.forces import Forces
from ...program.collocation import Collocation
from ...program.forward.scheme_simulation import simulate_scheme
from ...program.linear_algebra.factorisation import NONE, Factoriser
from ...program.linear_algebra.reused_factor import (
    FactorSequence,
    Matrix,
    NodeRotation,
    ReusedFactor,
)
from ...recording.deviation import Deviation
from ...recording.experiment import Experiment
from ...recording.experiment_refinement import refined_experiment
from ..linearised import known_at_last
from .consider_analysis import changed_residuals
from .effect import SMALL, Effect, ExperimentAtAnswer

# Largest number of nodes of a body whose error of the mesh is estimated in every solve: with more,
# the search starts on a coarser mesh, and a note compares both meshes.
LARGEST_NODE_COUNT = 1500
# Relative accuracy of e: that of an estimate of an error.
ACCURACY = 1e-2
# Weight of the shape function of a node below which it is zero apart from rounding.
NO_WEIGHT = 1e-9


@known_at_last
def mesh_residual_changes(collocation: Collocation, z: Array) -> Sequence[Array]:
    """Return the changes (T, M, 3, 1) of the residuals of each block of a fit, to first order, on a
    mesh with every tetrahedron split into eight.

    Parameters
    ----------
    z : (variables,) array
        Variables that satisfy the equations of motion.

    Raises
    ------
    InputError
        If an experiment cannot be transferred to the finer mesh.
    SimulationError, numpy.linalg.LinAlgError
        If the equations are singular.
    """
    return changed_residuals(collocation, z, [(finer_mesh_row(collocation), 1.0)]).blocks


def finer_mesh_row(collocation: Collocation) -> Deviation:
    """Return the assumption that the meshes are fine enough: its effect is that of meshes with every
    tetrahedron split into eight.
    """
    bodies = dict.fromkeys(t.body for t in collocation.transcriptions if _has_mesh(t.experiment))
    finer = {id(body): refine_body(body) for body in bodies}
    effect = partial(_effect, scheme=collocation.scheme, finer=finer)
    return Deviation("mesh", "", effect=effect)


def _has_mesh(experiment: Experiment) -> bool:
    return experiment.specimen is None


def _effect(
    at: ExperimentAtAnswer, _: int, scheme: str | Scheme, finer: Mapping[int, Body]
) -> Effect:
    iterate = at.iterate
    transcription = iterate.transcription
    body = transcription.body
    if at.dynamics.is_temporarily_prescribed.any():
        raise InputError("a grasp takes hold or lets go during the recording")
    if transcription.experiment.obstacles:
        raise InputError("obstacles touch the body")
    fine = refined_experiment(transcription.corrected_experiment(iterate.phi), finer[id(body)])
    dynamics = Dynamics.from_experiment(fine, scheme, transcription.substeps).with_theta(at.theta)
    if not body.is_solid:
        return _effect_of_simulation(at, fine, dynamics)
    by_dof = sp.csr_array(sp.kron(_interpolation(body, fine.body), sp.eye_array(3)))
    held = np.zeros(iterate.x.shape[1], dtype=bool)
    held[transcription.prescribed_dofs] = True
    given = _given_dofs(by_dof)
    is_corner = np.zeros(dynamics.pattern.size, dtype=bool)
    is_corner[given[: body.mesh.points_m.size]] = True
    is_corner[given[body.nodes.points_m.size :]] = True  # frames
    moving = np.flatnonzero((abs(by_dof) @ ~held > 0) & (at.dynamics.is_static | ~is_corner))
    return Effect(force_n=at.pad_rows(_changes_of_forces(at, dynamics, by_dof, moving, given)))


def _effect_of_simulation(at: ExperimentAtAnswer, fine: Experiment, dynamics: Dynamics) -> Effect:
    """Return the change of the forces that moves the nodes as a body with elements of half the size
    moves, which is simulated: one that hardly stretches cannot be condensed at the given nodes.
    """
    x = at.iterate.x
    finer = simulate_scheme(fine, dynamics).reshape(len(x), -1, 3)
    moved = x.copy().reshape(len(x), -1, 3)
    own = at.body.mesh.places_in_refined
    moved[:, : len(own)] = finer[:, own]
    change = moved.reshape(x.shape) - x
    before = _forces_less_inertia(at.dynamics, x)
    after = _forces_less_inertia(at.dynamics, x + SMALL * change)
    return Effect(force_n=at.pad_rows((before - after) / SMALL))


def _forces_less_inertia(dynamics: Dynamics, x: Array) -> Array:
    """Return F − M a (N − first row, 3n) [N] at the evaluations along a motion (N, 3n) [m]."""
    inertia_n = dynamics.rows_to_evaluations(dynamics.mass.inertia_kg * dynamics.acceleration(x))
    return dynamics.force(x) - inertia_n[dynamics.first_row :]


def _changes_of_forces(
    at: ExperimentAtAnswer,
    dynamics: Dynamics,
    interpolation: sp.csr_array,
    moving: Index,
    given: Index,
) -> Array:
    """Return the changes of force (N − first row, 3n) [N] at the evaluations."""
    x = np.ascontiguousarray(at.iterate.x @ interpolation.T)
    unbalanced_n = _forces_less_inertia(dynamics, x)
    given_n = _forces_less_inertia(at.dynamics, at.iterate.x)
    xi, nu = map(np.ascontiguousarray, dynamics.evaluation_states(x))
    given_xi, given_nu = map(np.ascontiguousarray, at.dynamics.evaluation_states(at.iterate.x))
    sequence = FactorSequence(
        Factoriser.cached(dynamics.pattern, moving),
        NodeRotation(moving, dynamics.pattern.size // 3),
        accuracy=ACCURACY,
    )
    relative = np.zeros((1, dynamics.pattern.size))
    changes_n = unbalanced_n @ interpolation - given_n
    of_rows = zip(
        _forces_by_row(dynamics, x), _forces_by_row(at.dynamics, at.iterate.x), strict=True
    )
    for k, (forces, given_forces) in enumerate(of_rows):
        now = slice(k, k + 1)
        stiffness = -forces.linearise(xi[now], nu[now]).by_position
        if dynamics.body.element.mean_dilatation:
            stress_pa = np.repeat(given_forces.mean_stresses(given_xi[now], given_nu[now]), 8)
            stress_pa -= forces.mean_stresses(xi[now], nu[now])
            lagged = dynamics.body.volume_stiffness(xi[k], stress_pa)
            stiffness += forces.joint_pattern.expand(lagged[None])
        system = ReusedFactor(sequence, Matrix(stiffness[0], NONE), points_m=xi[k].reshape(-1, 3))
        relative[0, moving] = system.solve(unbalanced_n[k, moving], guess=relative[0, moving])
        changes_n[k] -= dynamics.pattern.products(stiffness, relative)[0] @ interpolation
        own = -given_forces.linearise(given_xi[now], given_nu[now]).by_position
        changes_n[k] += at.dynamics.pattern.products(own, relative[:, given])[0]
    return changes_n


def _forces_by_row(dynamics: Dynamics, x: Array) -> Iterator[Forces]:
    """Yield the forces of the evaluations along a motion (N, 3n) [m]."""
    histories = dynamics.histories(x)
    for row in range(dynamics.first_row, len(x)):
        yield dynamics.forces_with_histories(histories, slice(row, row + 1))


def _interpolation(body: Body, finer: Body) -> sp.csr_array:
    """Return the shape functions (m, n) of a body at the nodes of its refinement."""
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


def _given_dofs(by_dof: sp.csr_array) -> Index:
    """Return where the dofs of the given mesh are among those (3m,) of the finer one, (3n,)."""
    is_given = np.diff(by_dof.indptr) == 1
    entries = by_dof.tocoo()
    given = np.empty(int(entries.col.max()) + 1, dtype=np.int64)
    alone = is_given[entries.row]
    given[entries.col[alone]] = entries.row[alone]
    return given
