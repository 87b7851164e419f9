"""The change of the equations of motion if an assumption is off by one unit, at the answer.

An effect acts on the equations of motion, c = Σ w F − M a, or on the prescribed displacements;
`consider_analysis` propagates effects to the residuals.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ...common.array_types import Array, Index
from ...fem.body import Body
from ...fem.laws.constants import GAMMA_R, without_region
from ...fem.laws.moduli import engineering_constants
from ...fem.meshes.checks import boundary_of
from ...model.contact.summary import surface_gaps_and_pressures
from ...model.dynamics import Dynamics
from ...model.force_term import States
from ...model.parameters import Parameters
from ...program.collocation import ExperimentIterate
from ...program.reactions.forces import forces_on_dofs, reaction_forces
from ...recording.grasp import free_rigid_motions
from .memory_effect import RELAXATION_TIMES_S, is_distinguishable, memory_forces_n, supports_memory
from .shape_error import standing_nodes, surface_modes, thickness_m

# Differences by a scale.
SMALL = 1e-4
AXES = "xyz"
# Differences by a displacement: its largest entry over the length of an edge.
SMALL_STRAIN = 1e-4


@dataclass(frozen=True, eq=False)
class Effect:
    """Change of the equations of motion if an assumption is off by one unit."""

    # (N, 3n) or None: change of the forces at the evaluations [N]; None means no change.
    force_n: Array | None = None
    # (3n,) or None: change of the inertial masses, whose weight is not in `force_n` [kg]; None
    # means no change.
    mass_kg: Array | None = None
    time_stretch: float = 0.0  # relative change of the times in the inertia
    # (N, g) or None: change of the prescribed positions of the grasped dofs [m]; None means no
    # change.
    displacement_m: Array | None = None
    # (3n,) or None: change of given start positions [m]; None means no change. Equilibria follow
    # the forces.
    start_m: Array | None = None


@dataclass(frozen=True, eq=False)
class ExperimentAtAnswer:
    """One experiment at the answer, as the effects of assumptions need it."""

    iterate: ExperimentIterate
    parameters: Parameters  # shared parameters

    @property
    def body(self) -> Body:
        """Body of the experiment."""
        return self.iterate.transcription.body

    @property
    def dynamics(self) -> Dynamics:
        """Equations of motion at the answer."""
        return self.iterate.equations.dynamics

    @property
    def theta(self) -> Array:
        """Constants θ of the body (k,)."""
        return self.dynamics.theta

    @cached_property
    def own_mass_kg(self) -> Array:
        """Masses (3n,) of the dofs of the body at the answer, without point masses and air [kg]."""
        return self.body.mass_of_dofs(self.theta)

    @cached_property
    def acceleration(self) -> Array:
        """Accelerations (N, 3n) that the scheme assigns to the rows [m/s²]."""
        return self.dynamics.acceleration(self.iterate.x)

    @cached_property
    def states(self) -> tuple[Array, Array]:
        """States ξ [m] and velocities ν [m/s] at the evaluations of the forces, (N, 3n) each,
        padded by zeros before the first evaluation.
        """
        xi, nu = self.dynamics.evaluation_states(self.iterate.x)
        return self.pad_rows(xi), self.pad_rows(nu)

    def pad_rows(self, evaluated: Array) -> Array:
        """Return values (N, 3n) of all rows from those of the evaluations (N − first row, 3n), zero
        before the first; a new array.
        """
        return np.concatenate([np.zeros((self.dynamics.first_row, evaluated.shape[1])), evaluated])

    def internal_n(
        self,
        length_factor: float = 1.0,
        time_factor: float = 1.0,
        theta: Array | None = None,
        body: Body | None = None,
    ) -> Array:
        """Return the material's forces (N, 3n) at scaled lengths or times, without γ_m [N].

        Parameters
        ----------
        length_factor : float
            Factor of lengths: positions and velocities are divided by it.
        time_factor : float
            Factor of times: velocities are divided by it.
        theta : (k,) array, optional
            Constants of the body; those of the answer by default.
        body : Body, optional
            Body with another stress-free shape; that of the experiment by default.

        Notes
        -----
        Damping by γ_r and the memory of the answer's motion are contained; the memory is that at
        unscaled lengths.
        """
        undamped = (self.theta if theta is None else theta).copy()
        undamped[list(self.body.tied_shares)] = 0.0
        dynamics = self.dynamics.with_theta(undamped)
        histories = dynamics.forces_with_histories(dynamics.histories(self.iterate.x)).memory_state
        xi, nu = dynamics.evaluation_states(self.iterate.x)
        evaluated = self.body if body is None else body
        return self.pad_rows(
            evaluated.force(
                xi / length_factor,
                nu / (length_factor * time_factor),
                theta=undamped,
                memory_input=histories,
            )
        )

    @cached_property
    def internal_force_n(self) -> Array:
        """Forces (N, 3n) of the material at the answer with its stress-free shape, without
        γ_m [N].
        """
        return self.internal_n(body=self.stress_free_body)

    @cached_property
    def stress_free_body(self) -> Body:
        """The body with its stress-free shape at the answer, also of a mesh made under gravity."""
        return self.body.with_stress_free(self.stress_free_m)

    @cached_property
    def stress_free_m(self) -> Array:
        """Stress-free positions (n, 3) of the nodes, without nodes of obstacle frames [m]: those of
        the mesh, or those that follow from a mesh made under gravity.
        """
        scan = self.body.inverse_equilibrium
        return self.body.nodes.points_m if scan is None else scan.solve(self.theta).positions_m

    def force_change_by_reference(self, moved_m: Array) -> Array:
        """Return the first-order change (N, 3n) [N] of the material's forces if the stress-free
        positions change by `moved_m` (n, 3) [m], by a difference; zero if nothing moves. Rows of
        obstacle frames are ignored.
        """
        largest = float(np.abs(moved_m).max(initial=0.0))
        if not largest:
            return np.zeros_like(self.iterate.x)
        step = SMALL_STRAIN * self.iterate.transcription.length_m / largest
        own = self.stress_free_m + step * moved_m[: len(self.stress_free_m)]
        other = self.body.with_stress_free(own)
        return (self.internal_n(body=other) - self.internal_force_n) / step

    def force_change_by_scan_weight(self) -> Array:
        """Return the change (N, 3n) [N] of the material's forces per relative change of the weight
        during the scan; zero unless the mesh was made under gravity.
        """
        if self.body.inverse_equilibrium is None:
            return np.zeros_like(self.iterate.x)
        return self.force_change_by_reference(
            self.body.inverse_equilibrium.weight_sensitivity(self.theta)
        )

    @cached_property
    def surface_modes_m(self) -> Array:
        """Modes (modes, n, 3) of an error of the surface along its normal: displacements [m] of the
        nodes if the standard deviation of the error is the thickness of the body.

        Places of the surface that are in contact with an obstacle are known and do not move.
        """
        transcription = self.iterate.transcription
        known = np.zeros(0, dtype=int)
        if transcription.experiment.obstacles:
            gaps_m, _ = surface_gaps_and_pressures(
                transcription.experiment, self.theta, x=self.iterate.x
            )
            nearest = np.fmin.reduce(gaps_m, axis=0)
            is_in_contact = np.nan_to_num(nearest, nan=np.inf) < transcription.length_m
            known = np.unique(self.body.mesh.surface[is_in_contact])
        modes = surface_modes(self.body, known)
        return thickness_m(self.body) * modes

    @cached_property
    def forces_of_memory_n(self) -> dict[float, Array]:
        """Forces (N, 3n) [N] of a branch of memory that the model lacks, with the share one, by the
        relaxation time [s]; without relaxation times that the recording cannot distinguish from
        other effects, and empty if memory cannot be added, see `memory_effect`.
        """
        experiment = self.iterate.transcription.experiment
        if not supports_memory(self.body, experiment.is_static):
            return {}
        distinguishable = [
            tau_s
            for tau_s in RELAXATION_TIMES_S
            if is_distinguishable(tau_s, experiment.timestep_s, experiment.duration_s)
        ]
        forces_n = memory_forces_n(
            self.stress_free_body, self.dynamics, self.iterate.x, relaxation_times_s=distinguishable
        )
        return dict(zip(distinguishable, forces_n, strict=True))

    @cached_property
    def likely_support_dofs(self) -> Index:
        """Dofs (k,) that were probably supported while the mesh was made: those prescribed in the
        recording, without obstacles, or, if these leave rigid motions, all three of each of the
        lowest nodes.
        """
        prescribed = self.iterate.equations.prescribed.dofs
        own = prescribed[prescribed < self.body.nodes.points_m.size]
        points_m = self.body.nodes.points_m
        if len(free_rigid_motions(points_m, _dof_mask(own, len(points_m)))):
            gravity = self.iterate.transcription.experiment.gravity_m_s2
            nodes = standing_nodes(self.body, gravity)
            return (3 * nodes[:, None] + np.arange(3)).ravel()
        return own

    def weight_and_drag(self, mass_kg: Array) -> Array:
        """Return the weight and the mass-proportional damping −γ_m m v at the evaluations (N, 3n)
        [N] of masses (3n,) or (N, 3n) [kg], without air.
        """
        return mass_kg * (
            self.dynamics.forces.weight.gravity
            - self.body.tied_damping_rate(self.theta) * self.states[1]
        )

    @property
    def buoyancy_n(self) -> Array:
        """Buoyancy (N, 3n) in the model [N]; zero in a vacuum."""
        lifted = -self.dynamics.mass.displaced_kg * self.dynamics.forces.weight.gravity
        return np.broadcast_to(lifted, self.iterate.x.shape)

    @cached_property
    def air_drag_n(self) -> Array:
        """Drag of the air (N, 3n) in the model [N]; zero in a vacuum and where nothing moves."""
        term = self.dynamics.forces.air_drag
        if term is None:
            return np.zeros_like(self.states[1])
        drag = term.force(States(*self.states, self.theta))
        drag[: self.dynamics.first_row] = 0.0
        return drag

    @cached_property
    def grasp_force_n(self) -> Array:
        """Reaction forces (N, g) of the grasps on the g prescribed dofs of the body [N]; zero while
        they are not prescribed.
        """
        dofs = self.iterate.equations.prescribed.dofs
        x = self.iterate.x
        force = forces_on_dofs(self.dynamics, x, dofs=dofs)
        mass = self.dynamics.mass.inertia_kg[:, dofs]
        reaction_n = reaction_forces(
            self.dynamics, mass, force=force, acceleration=self.acceleration[:, dofs]
        )
        return np.where(np.isnan(self.iterate.equations.prescribed.positions_m), 0.0, reaction_n)

    @cached_property
    def effect_of_grips(self) -> Effect | None:
        """Effect of grippers that hold the body at one metre outside the faces that they hold; None
        without such faces. The body is longer there before and after they hold it, too.

        A grasp that prescribes some axes only is a platen or a plane of symmetry, not a gripper, and
        measured displacements are those of the body.
        """
        gripped = [
            grasp.nodes
            for grasp in self.iterate.transcription.experiment.body_grasps
            if len(grasp.axes) == len(AXES) and grasp.poses.deformation is None
        ]
        if not gripped:
            return None
        body = self.body
        is_held = np.isin(np.arange(len(body.nodes_m)), np.concatenate(gripped))
        if not body.is_solid:
            outward = body.kind.directions_beyond(body.mesh, is_held[: len(self.stress_free_m)])
            return shape_effect(self, outward) if outward.any() else None
        cells = body.mesh.tetrahedra
        faces, _ = boundary_of(cells[~is_held[cells].all(axis=1)])
        faces = faces[is_held[faces].all(axis=1)]
        a, b, c = np.moveaxis(self.stress_free_m[faces], 1, 0)
        normals = np.zeros_like(body.nodes_m)
        np.add.at(normals, body.nodes.nodes_of_faces(faces), np.cross(b - a, c - a)[:, None])
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        if not length.any():
            return None
        return shape_effect(self, np.divide(normals, length, out=normals, where=length > 0))

    @cached_property
    def proportional_s(self) -> Array:
        """Damping times γ_r (E,) of elements with Rayleigh damping γ_r K(x) v [s], zero of
        others.
        """
        gamma_r_s = np.zeros(len(self.body.cells))
        for part, start in zip(self.body.parts, self.body.starts, strict=False):
            if GAMMA_R in part.damping.constants and part.damping.stress is None:
                gamma_r_s[part.cells] = self.theta[start + part.constants.index(GAMMA_R)]
        return gamma_r_s

    @cached_property
    def young_pa(self) -> float:
        """Young's modulus of the softest part at small strain, at the answer [Pa]."""
        return min(
            engineering_constants(*moduli)[0] for moduli in self.body.lame(self.theta).values()
        )


def _dof_mask(dofs: Index, nodes: int) -> NDArray[np.bool_]:
    """Return the mask (n, 3) of dofs (k,); dof 3 i + axis belongs to node i."""
    mask = np.zeros(3 * nodes, dtype=bool)
    mask[dofs] = True
    return mask.reshape(nodes, 3)


# What each changes ------------------------------------------------------------------------------


def shape_effect(at: ExperimentAtAnswer, moved_m: Array) -> Effect:
    """Return the effect of stress-free positions that are off by `moved_m` (n, 3) [m], with which the
    grasped nodes move.
    """
    prescribed_motion = at.iterate.transcription.prescribed_motion
    rotations: Array = np.nan_to_num(prescribed_motion.pose_rows[0])
    offsets_m = moved_m.ravel()[
        3 * (at.iterate.equations.prescribed.dofs // 3)[:, None] + np.arange(3)
    ]
    return Effect(
        at.force_change_by_reference(moved_m),
        displacement_m=np.einsum("tgj,gj->tg", rotations, offsets_m),
    )


def stated_names(parameters: Parameters, constant: str) -> set[str]:
    """Return the parameters of a constant, in any region, that are fixed or tied to a fixed one."""
    items = {item.name: item for item in parameters.components}
    return {
        name
        for name, item in items.items()
        if without_region(name) == constant
        and (items[item.tied.to] if item.tied else item).is_fixed
    }


def effect_of_constants(at: ExperimentAtAnswer, units: Mapping[str, float], step: float) -> Effect:
    """Return the effect of constants that are all larger by their units, by central differences."""
    values = at.parameters.values(at.iterate.q)
    larger, smaller = (
        at.internal_n(
            theta=at.body.theta_from_values(
                {name: value + way * units.get(name, 0.0) for name, value in values.items()}
            )
        )
        for way in (step, -step)
    )
    return Effect((larger - smaller) / (2 * step))
