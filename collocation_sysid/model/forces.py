"""All forces on a body at some times: F(ξ, ν; u) = f(ξ, ν; θ) + Σ terms.

The sum includes the internal forces f of materials and damping laws (see `fem.body`), the weight,
tendons, pressures, obstacles, air drag and custom forces; no other module adds forces. Derivatives
by the state are on the sparsity pattern of all couplings. Columns of derivatives by θ are followed
by those by the other inputs u, in the order of the terms, see `inputs`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import accumulate

import numpy as np
from numpy.typing import ArrayLike

from ..common.array_types import Array, Index
from ..common.time_dependence import PARTS_OVER_TIME, scale_loads
from ..fem.body import Body, Linearisation, SecondDerivatives
from ..fem.laws.memory import MemoryInput
from ..fem.pattern import JointPattern, SymmetricPattern
from ..recording.experiment import Experiment
from .contact.force import contact_terms
from .force_term import AssemblyIndices, ForceTerm, Potential, States
from .local_force import LocalForces
from .point_forces import ComplementarityForce, CustomForce, Pointwise
from .stiffness_change import StiffnessChange
from .weight import DofMasses, Weight


@dataclass(frozen=True, eq=False)
class Forces:
    """Sum of the forces on a body at T times.

    States ξ and ν are (T, 3n) positions [m] and velocities [m/s]; for T = 1 also (3n,).

    Attributes
    ----------
    weight : Weight
        Gravity and loads; also holds body and masses.
    external_terms : tuple of ForceTerm
        All other external forces.
    joint_pattern : JointPattern
        Common sparsity pattern of the mesh graph and the couplings of the further terms.
    theta : (k,)
        Constants θ of the body; NaN where they are not known yet.
    is_static : bool
        Whether the experiment is static. ν is then the displacement since the previous sample, see
        `ForceTerm.uses_increments`.
    memory_state : MemoryInput, optional
        Internal variables of a body with memory at the evaluations; None for no overstress.
    """

    weight: Weight = field(metadata=PARTS_OVER_TIME)
    external_terms: tuple[ForceTerm, ...] = field(metadata=PARTS_OVER_TIME)
    joint_pattern: JointPattern
    theta: Array
    is_static: bool = False
    memory_state: MemoryInput | None = None

    @classmethod
    def from_experiment(
        cls,
        experiment: Experiment,
        t_s: ArrayLike,
        theta: Sequence[float] | Array | None = None,
        step_s: float = 0.0,
    ) -> Forces:
        """Return the forces of an experiment.

        Parameters
        ----------
        t_s : (T,) or float
            Times of the evaluations.
        theta : (k,), optional
            Constants of the body; NaN by default, and with them the masses of parts with free
            densities.
        step_s : float
            Length of the time steps over which the pressures of obstacles are averaged; 0 for the
            pressures at each state.
        """
        times = np.atleast_1d(np.asarray(t_s, dtype=np.float64))
        further: list[ForceTerm] = [
            Potential(actuator.require_measure(), actuator.energy_amplitude_at(times)[:, None])
            for actuator in experiment.actuators
        ]
        if experiment.obstacles:
            further += contact_terms(experiment, step_s)
        if experiment.has_air_drag:
            density = experiment.air_density_kg_m3
            further.append(CustomForce(experiment.body.unit_air_drag, times, factor=density))
        if experiment.stiffness_deviations:
            share = experiment.known_stiffness_change(times)[:, None]
            further.append(StiffnessChange(experiment.body, share, is_static=experiment.is_static))
        further += [CustomForce(placed, times) for placed in experiment.body.placed_forces]
        unknown = np.full(len(experiment.body.constants), np.nan)
        still = experiment.is_static
        forces = cls(
            Weight.from_experiment(experiment, times),
            tuple(further),
            joint_pattern=experiment.build_coupled_graph(),
            theta=unknown,
            is_static=still,
        )
        return forces if theta is None else forces.with_theta(theta)

    def with_theta(self, theta: Sequence[float] | Array) -> Forces:
        """Return these forces for a body with constants θ (k,), which are copied; masses follow the
        free densities.
        """
        known = np.array(theta, dtype=float)
        return replace(self, theta=known, weight=self.weight.with_theta(known))

    def at_share(self, share: float) -> Forces:
        """Return these forces with the loads and natural strains multiplied by a share, and a rod
        straightened by this share.
        """
        body = self.body.partly_straightened(share)
        loaded = scale_loads(replace(self, weight=replace(self.weight, body=body)), share)
        places = self.body.natural_strain_indices
        if not places:
            return loaded
        theta = self.theta.copy()
        theta[places] *= share
        return replace(loaded, theta=theta)

    @property
    def body(self) -> Body:
        """Body on which the forces act."""
        return self.weight.body

    @property
    def mass(self) -> DofMasses:
        """Masses of the dofs that give inertia, weight and mass-proportional damping."""
        return self.weight.mass

    @property
    def pattern(self) -> SymmetricPattern:
        """Sparsity pattern of the derivatives by the state."""
        return self.joint_pattern.pattern

    @cached_property
    def terms(self) -> tuple[ForceTerm, ...]:
        """External forces: the weight first, then the further terms."""
        return (self.weight, *self.external_terms)

    @cached_property
    def _input_offsets(self) -> list[int]:
        """First column of each term's inputs in u, and the length of u."""
        sizes = [term.size for term in self.terms]
        return list(accumulate(sizes, initial=len(self.body.constants)))

    @cached_property
    def mass_derivatives(self) -> dict[int, Array]:
        """Derivatives ∂M/∂u (3n,) of the masses, by the index of each input on which M depends."""
        return self.weight.mass_derivatives(self._input_offsets[0])

    def with_inputs(self, u: Array) -> Forces:
        """Return these forces at inputs u (T, U); self is unchanged.

        The constants θ are copied from the first time. The inputs of each term follow, in the order
        of `terms`; terms may keep views of u.
        """
        forces = self.with_theta(u[0, : self._input_offsets[0]])
        if self._input_offsets[0] == self._input_offsets[-1]:
            return forces
        weight, *further = (
            term.with_inputs(u[:, start:stop])
            for term, start, stop in zip(
                forces.terms, self._input_offsets, self._input_offsets[1:], strict=False
            )
        )
        return replace(forces, weight=weight, external_terms=tuple(further))

    def with_term(self, number: int, term: ForceTerm) -> Forces:
        """Return these forces with one of the further terms replaced; self is unchanged.

        Parameters
        ----------
        number : int
            Index in `external_terms`.
        term : ForceTerm
            New term, with the couplings and the number of inputs of the previous one.
        """
        before = self.external_terms[:number]
        after = self.external_terms[number + 1 :]
        return replace(self, external_terms=(*before, term, *after))

    @property
    def has_local_forces(self) -> bool:
        """Whether any force is local, see `local_forces`."""
        return any(term.is_local for term in self.external_terms)

    def without_local_forces(self) -> Forces:
        """Return these forces without the local ones, see `local_forces`; the sparsity pattern is
        unchanged.
        """
        further = tuple(term for term in self.external_terms if not term.is_local)
        places = [
            indices.entries
            for term, indices in self._terms_with_indices
            if term.couplings and not term.is_local
        ]
        pattern = JointPattern(self.pattern, (self.joint_pattern.places[0], *places))
        return replace(self, external_terms=further, joint_pattern=pattern)

    def local_forces(self) -> LocalForces:
        """Return the local forces in one time step, which solvers of a step treat apart."""
        parts = [
            term.local_force(self.theta, self.pattern)
            for term in self.external_terms
            if term.is_local
        ]
        return LocalForces(parts, self.pattern)

    def only_loads(self) -> Forces:
        """Return these forces without the external terms besides weight and loads; internal forces
        and `memory_state` stay. The sparsity pattern is that of the body alone.
        """
        return replace(
            self, external_terms=(), joint_pattern=JointPattern.from_patterns((self.body.pattern,))
        )

    def total(self, xi: Array, nu: Array) -> Array:
        """Return the sum of all forces F (T, 3n) [N], internal and external, at positions ξ (T, 3n)
        [m] and velocities ν (T, 3n) [m/s].
        """
        states_for = self.states_of_terms(xi, nu)
        total = self.body.force(
            xi,
            states_for(self.weight).nu,
            theta=self.theta,
            tied_kg=self.mass.compact_tied_kg,
            memory_input=self.memory_state,
        )
        for term in self.terms:
            total = total + term.force(states_for(term))
        return total

    def mean_stresses(self, xi: Array, nu: Array, velocity_slope: float = 0.0) -> Array:
        """Return the mean stress (E,) [Pa] of each element at one state ξ, ν, (1, 3n) each, see
        `Body.mean_stresses`.
        """
        return self.body.mean_stresses(
            xi,
            self.states_of_terms(xi, nu)(self.weight).nu,
            theta=self.theta,
            velocity_slope=0.0 if self.is_static else velocity_slope,
            memory_input=self.memory_state,
        )

    def resultants(self, xi: Array, nu: Array, velocity_slope: float = 0.0) -> Array:
        """Return the resultants (T, any) [J] of the elements of a rod at states ξ, ν, (T, 3n) each,
        see `Body.resultants`.
        """
        states = self.states_of_terms(xi, nu)(self.weight)
        slope = 0.0 if self.is_static else velocity_slope
        return self.body.resultants(states.xi, states.nu, self.theta, slope)

    def linearise(self, xi: Array, nu: Array, out: Array | None = None) -> Linearisation:
        """Return the forces and their first derivatives by state and inputs; columns of `by_theta`
        are those of θ, then of the inputs of each term.

        Internal variables of `memory_state` and of the terms are constant. In a static experiment
        `by_velocity` has only the parts of terms with `uses_increments`. Skew parts are empty, (T,
        0), if no force has one.

        Parameters
        ----------
        xi, nu : (T, 3n)
            Positions [m] and velocities [m/s].
        out : (T, linearisation_width), optional
            Memory for the body's part of the result, which holds views of it; overwritten.
        """
        states_for = self.states_of_terms(xi, nu)
        still_nu = states_for(self.weight).nu
        at = self.body.linearise(
            xi,
            still_nu,
            theta=self.theta,
            out=out,
            tied_kg=self.mass.compact_tied_kg,
            memory_input=self.memory_state,
        )
        if self.is_static:
            at.by_velocity[:] = 0.0
        if self._has_external_derivatives():
            spread = self.joint_pattern.expand
            at = Linearisation(
                at.force,
                spread(at.by_position),
                by_velocity=spread(at.by_velocity),
                by_theta=self._with_input_columns(at.by_theta),
                by_position_skew=spread(at.by_position_skew),
                by_velocity_skew=np.zeros(
                    (len(at.force), self.pattern.entry_count * self.has_skew_damping)
                ),
            )
        for term, places in self._terms_with_indices:
            term.add_derivatives(at, places, states=states_for(term))
        return at

    def _has_external_derivatives(self) -> bool:
        """Whether derivatives have more entries or columns than internal forces."""
        more = (
            self._input_offsets[-1] > self._input_offsets[0]
            or self.pattern is not self.body.pattern
        )
        return bool(self.external_terms) or more

    def weighted_hessian(
        self, xi: Array, nu: Array, weights: Array, out: Array | None = None
    ) -> SecondDerivatives:
        """Return the derivatives of weightsᵀ F and of weighted internal variables by state and
        inputs.

        The weighted internal variables are Σ σ · S of a memory with stress weights, and those that
        `Pointwise.variable_weights` weights in forces. In a static experiment derivatives by ν have
        only the parts of terms with `uses_increments`.

        Parameters
        ----------
        xi, nu : (T, 3n)
            Positions [m] and velocities [m/s].
        weights : (T, 3n)
        out : (T, curvature_width), optional
            Memory for the body's part of the result, which holds views of it; overwritten.
        """
        states_for = self.states_of_terms(xi, nu)
        at = self.body.second_derivatives(
            xi,
            states_for(self.weight).nu,
            weights=weights,
            theta=self.theta,
            out=out,
            tied_kg=self.mass.compact_tied_kg,
            memory_input=self.memory_state,
        )
        if self.is_static:
            for by_velocity in (at.position_velocity, at.velocity_theta, at.position_velocity_skew):
                by_velocity[:] = 0.0
        if self._has_external_derivatives():
            spread = self.joint_pattern.expand
            with_columns = self._with_input_columns
            at = SecondDerivatives(
                spread(at.position_position),
                spread(at.position_velocity),
                position_theta=with_columns(at.position_theta),
                velocity_theta=with_columns(at.velocity_theta),
                theta_theta=with_columns(with_columns(at.theta_theta).swapaxes(1, 2)),
                theta=with_columns(at.theta),
                position_velocity_skew=spread(at.position_velocity_skew),
                # Room for the curvature by velocities, where forces may have some.
                velocity_velocity=np.zeros(
                    (len(at.theta), self.pattern.entry_count * self._is_nonlinear_in_velocity)
                ),
            )
        for term, places in self._terms_with_indices:
            states = states_for(term)
            term.add_second_derivatives(
                at, places, states=states, weights=weights.reshape(states.xi.shape)
            )
        return at

    @cached_property
    def has_skew_damping(self) -> bool:
        """Whether derivatives by the velocity have a skew part."""
        return any(term.has_skew_damping for term in self.external_terms)

    @cached_property
    def _is_nonlinear_in_velocity(self) -> bool:
        return any(term.is_nonlinear_in_velocity for term in self.external_terms)

    def states_of_terms(self, xi: Array, nu: Array) -> Callable[[ForceTerm], States]:
        """Return a function that gives each term its states, from positions ξ and velocities ν, (T,
        3n), or (3n,) for T = 1.

        In a static experiment only terms that use displacements since the previous sample
        (`uses_increments`) get ν, all others zero. The states of the weight are also those of the
        body. Arrays of the states are views of ξ and ν, except zeros.
        """
        size = self.body.pattern.size
        moving = States(xi.reshape(-1, size), nu.reshape(-1, size), theta=self.theta)
        resting = replace(moving, nu=np.zeros_like(moving.nu)) if self.is_static else moving
        return lambda term: moving if term.uses_increments else resting

    @cached_property
    def _terms_with_indices(self) -> list[tuple[ForceTerm, AssemblyIndices]]:
        """Every term, the weight first, with its columns and entries in the shared arrays."""
        entries: Iterator[Index] = iter(self.joint_pattern.places[1:])
        nowhere: Index = np.zeros(0, dtype=np.int64)
        return [
            (
                term,
                AssemblyIndices(
                    slice(start, stop), nowhere if term.couplings is None else next(entries)
                ),
            )
            for term, start, stop in zip(
                self.terms, self._input_offsets, self._input_offsets[1:], strict=False
            )
        ]

    def pointwise_term(self, number: int) -> tuple[Pointwise, Index]:
        """Return an external term, and the indices of its constants among all inputs.

        Parameters
        ----------
        number : int
            Index in `external_terms`; the term must be a `Pointwise` (AssertionError otherwise).
        """
        term, places = self._terms_with_indices[1 + number]
        assert isinstance(term, Pointwise)
        return term, term.constant_columns(places)

    @property
    def air_drag(self) -> CustomForce | None:
        """Drag of the air around the body; None in a vacuum or in a static experiment."""
        terms = (
            term
            for term in self.external_terms
            if isinstance(term, CustomForce) and term.is_air_drag
        )
        return next(terms, None)

    @property
    def terms_with_internal_variables(self) -> list[int]:
        """Indices in `external_terms` of the terms with internal variables."""
        return [k for k, term in enumerate(self.external_terms) if term.internal_variable_count]

    @property
    def complementarity_terms(self) -> list[int]:
        """Indices in `external_terms` of the forces of a complementarity condition."""
        further = enumerate(self.external_terms)
        return [
            k
            for k, term in further
            if isinstance(term, ComplementarityForce) and term.is_complementarity
        ]

    def _with_input_columns(self, by_theta: Array) -> Array:
        """Append zero columns for the inputs of the terms to derivatives by θ (…, k)."""
        further = self._input_offsets[-1] - self._input_offsets[0]
        if not further:
            return by_theta
        return np.concatenate([by_theta, np.zeros((*by_theta.shape[:-1], further))], axis=-1)
