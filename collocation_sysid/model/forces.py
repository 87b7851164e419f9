"""All forces on a body at some times: F(ξ, ν; u) = f(ξ, ν; θ) + Σ terms.

Use `Forces.of` for an experiment and `Forces.on` for a body alone. The sum includes the internal
forces f of materials and damping laws (see `fem.body`), the weight, tendons, pressures, contact,
air drag and custom forces; no other module adds forces. Derivatives by the state are on the
sparsity pattern of all couplings. Columns of derivatives by θ are followed by those by the other
inputs u, in the order of the terms, see `inputs`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Array, Index
from ..fem.body import Body, Curvature, Linearisation
from ..fem.memory import Past
from ..fem.pattern import Joined, SymmetricPattern
from ..recording.experiment import Experiment
from .contact import Contact, contacts
from .force_term import ForceTerm, Potential, Slots, States
from .point_forces import PointForces, Pointwise, air_drag, point_forces
from .weight import Mass, Weight


@dataclass(frozen=True, eq=False)
class Forces:
    """Sum of the forces on a body at T times.

    States ξ and ν are (T, 3n) positions [m] and velocities [m/s]; for T = 1 also (3n,).

    Attributes
    ----------
    weight : Weight
        Gravity and loads; also holds body and masses.
    further : tuple of ForceTerm
        All other external forces.
    joined : Joined
        Common sparsity pattern of the mesh graph and the couplings of the further terms.
    theta : (k,)
        Constants θ of the body; NaN where they are not known yet.
    still : bool
        Whether the experiment is static. ν is then the displacement since the previous sample, see
        `ForceTerm.slides`.
    past : Past, optional
        Internal variables of a body with memory at the evaluations; None for no overstress.
    """

    weight: Weight
    further: tuple[ForceTerm, ...]
    joined: Joined
    theta: Array
    still: bool = False
    past: Past | None = None

    @classmethod
    def of(
        cls,
        experiment: Experiment,
        t_s: ArrayLike,
        theta: Sequence[float] | Array | None = None,
        step_s: float = 0.0,
    ) -> Forces:
        """Return the forces of an experiment.

        Parameters
        ----------
        experiment : Experiment
        t_s : (T,)
            Times of the evaluations.
        theta : (k,), optional
            Constants of the body; NaN by default.
        step_s : float
            Length of the time steps over which contact pressures are averaged; 0 for the pressures
            at each state.
        """
        times = np.atleast_1d(np.asarray(t_s, dtype=np.float64))
        potentials = tuple(
            Potential(actuator.measure, actuator.amplitude(times)[:, None])
            for actuator in experiment.actuators
        )
        touching = contacts(experiment, step_s)
        further = (
            *potentials,
            *touching,
            *air_drag(experiment, times),
            *point_forces(experiment.body, times),
        )
        unknown = np.full(len(experiment.body.constants), np.nan)
        still = experiment.static
        forces = cls(Weight.of(experiment, times), further, experiment.joined, unknown, still)
        return forces if theta is None else forces.with_theta(theta)

    @classmethod
    def on(cls, body: Body, theta: Sequence[float] | Array) -> Forces:
        """Return the forces on a body without loads, gravity or contact, at one time.

        Custom forces of the body's own are included.
        """
        custom = point_forces(body, np.zeros(1))
        known = np.asarray(theta, dtype=float)
        weight = Weight.none(body).with_theta(known)
        return cls(weight, custom, body.joined_with(()), known)

    def with_theta(self, theta: Sequence[float] | Array) -> Forces:
        """Return these forces for a body with constants θ (k,)."""
        known = np.array(theta, dtype=float)
        return replace(self, theta=known, weight=self.weight.with_theta(known))

    @property
    def body(self) -> Body:
        """Body on which the forces act."""
        return self.weight.body

    @property
    def mass(self) -> Mass:
        """Masses of the dofs that give inertia, weight and mass-proportional damping."""
        return self.weight.mass

    @property
    def pattern(self) -> SymmetricPattern:
        """Sparsity pattern of the derivatives by the state."""
        return self.joined.pattern

    @cached_property
    def terms(self) -> tuple[ForceTerm, ...]:
        """External forces: the weight first, then the further terms."""
        return (self.weight, *self.further)

    @cached_property
    def _ends(self) -> list[int]:
        """First column of each term's inputs in u, and the length of u."""
        sizes = [term.size for term in self.terms]
        return list(accumulate(sizes, initial=len(self.body.constants)))

    @cached_property
    def mass_by_input(self) -> dict[int, Array]:
        """Derivatives ∂M/∂u (3n,) of the masses, by the index of each input on which M depends."""
        return self.weight.mass_by_input(self._ends[0])

    def at(self, u: Array) -> Forces:
        """Return these forces at inputs u (T, U)."""
        forces = self.with_theta(u[0, : self._ends[0]])
        if self._ends[0] == self._ends[-1]:
            return forces
        weight, *further = (
            term.at(u[:, start:stop])
            for term, start, stop in zip(forces.terms, self._ends, self._ends[1:], strict=False)
        )
        return replace(forces, weight=weight, further=tuple(further))

    def rows(self, rows: slice) -> Forces:
        """Return these forces at some of the times."""
        further = tuple(term.rows(rows) for term in self.further)
        return replace(self, weight=self.weight.rows(rows), further=further)

    def scaled(self, share: float) -> Forces:
        """Return these forces with all external ones multiplied by a factor.

        Masses are unchanged.
        """
        further = tuple(term.scaled(share) for term in self.further)
        return replace(self, weight=self.weight.scaled(share), further=further)

    def towards(self, other: Forces, share: float) -> Forces:
        """Return forces with the loads interpolated linearly to those of another time.

        Internal variables, constants and couplings are those of `other`.

        Parameters
        ----------
        other : Forces
            Forces at the other time.
        share : float
            Fraction of the way: 0 for this time, 1 for the other.
        """
        further = tuple(
            term.towards(that, share)
            for term, that in zip(self.further, other.further, strict=True)
        )
        return replace(other, weight=self.weight.towards(other.weight, share), further=further)

    def with_further(self, number: int, term: ForceTerm) -> Forces:
        """Return these forces with one of the further terms replaced.

        Parameters
        ----------
        number : int
            Index in `further`.
        term : ForceTerm
        """
        before = self.further[:number]
        after = self.further[number + 1 :]
        return replace(self, further=(*before, term, *after))

    def without_contact(self) -> tuple[Forces, list[Contact]]:
        """Return these forces without the contacts that have an energy, and the contacts removed.

        The sparsity pattern is unchanged. Contact as complementarity stays.
        """
        touching = [term for term in self.further if isinstance(term, Contact) and not term.relaxed]
        further = tuple(term for term in self.further if term not in touching)
        places = [p.entries for t, p in self._placed if t.couplings and t not in touching]
        pattern = Joined(self.pattern, (self.joined.places[0], *places))
        return replace(self, further=further, joined=pattern), touching

    def undriven(self) -> Forces:
        """Return weight and loads with internal forces, without all further terms."""
        return replace(self, further=(), joined=Joined.of((self.body.pattern,)))

    def total(self, xi: Array, nu: Array) -> Array:
        """Return the sum of all forces F (T, 3n) [N] at positions ξ and velocities ν."""
        states_for = self.states(xi, nu)
        total = self.body.force(
            xi, states_for(self.weight).nu, self.theta, self.mass.tied, self.past
        )
        for term in self.terms:
            total = total + term.force(states_for(term))
        return total

    def linearise(self, xi: Array, nu: Array, out: Array | None = None) -> Linearisation:
        """Return the forces and their first derivatives by state and inputs.

        Internal variables of `past` and of the terms are held fixed.

        Parameters
        ----------
        xi, nu : (T, 3n)
            Positions [m] and velocities [m/s].
        out : (T, linearisation_width), optional
            Memory for the body's part of the result, which holds views of it.
        """
        states_for = self.states(xi, nu)
        still_nu = states_for(self.weight).nu
        at = self.body.linearise(xi, still_nu, self.theta, out, self.mass.tied, self.past)
        if self.still:
            at.by_velocity[:] = 0.0
        if self._is_wider:
            spread = self.joined.spread
            at = Linearisation(
                at.force,
                spread(at.by_position),
                spread(at.by_velocity),
                self._widened(at.by_theta),
                spread(at.by_position_skew),
                np.zeros((len(at.force), self.pattern.entries * self.spins)),
            )
        for term, places in self._placed:
            term.add_slopes(at, places, states_for(term))
        return at

    @property
    def _is_wider(self) -> bool:
        """Whether derivatives have more entries or columns than those of the body's internal
        forces.
        """
        more = self._ends[-1] > self._ends[0] or self.pattern is not self.body.pattern
        return bool(self.further) or more

    @property
    def linearisation_width(self) -> int:
        """Length of one time's row of `out` in `linearise`."""
        return self.body.linearisation_width

    def curvature(
        self, xi: Array, nu: Array, weights: Array, out: Array | None = None
    ) -> Curvature:
        """Return the derivatives of weightsᵀ F and of weighted internal variables by state and
        inputs.

        The weighted internal variables are Σ σ · S of a memory with stress weights, and those that
        `Pointwise.weighed` weights in forces.

        Parameters
        ----------
        xi, nu : (T, 3n)
            Positions [m] and velocities [m/s].
        weights : (T, 3n)
        out : (T, curvature_width), optional
            Memory for the body's part of the result, which holds views of it.
        """
        states_for = self.states(xi, nu)
        at = self.body.curvature(
            xi, states_for(self.weight).nu, weights, self.theta, out, self.mass.tied, self.past
        )
        if self.still:
            for by_velocity in (
                at.position_velocity,
                at.velocity_theta,
                at.position_velocity_skew,
            ):
                by_velocity[:] = 0.0
        if self._is_wider:
            spread = self.joined.spread
            with_columns = self._widened
            at = Curvature(
                spread(at.position_position),
                spread(at.position_velocity),
                with_columns(at.position_theta),
                with_columns(at.velocity_theta),
                with_columns(with_columns(at.theta_theta).swapaxes(1, 2)),
                with_columns(at.theta),
                spread(at.position_velocity_skew),
                # Room for the curvature by velocities, where forces may have some.
                np.zeros((len(at.theta), self.pattern.entries * self._by_velocity)),
            )
        for term, places in self._placed:
            states = states_for(term)
            term.add_curvature(at, places, states, weights.reshape(states.xi.shape))
        return at

    @cached_property
    def spins(self) -> bool:
        """Whether derivatives by the velocity have a skew part."""
        return any(term.spins for term in self.further)

    @cached_property
    def _by_velocity(self) -> bool:
        """Whether derivatives by the velocity of any term depend on the velocity."""
        return any(term.by_velocity for term in self.further)

    @property
    def curvature_width(self) -> int:
        """Length of one time's row of `out` in `curvature`."""
        return self.body.curvature_width

    def states(self, xi: Array, nu: Array) -> Callable[[ForceTerm], States]:
        """Return a function that gives each term its states.

        In a static experiment only terms that use displacements since the previous sample
        (`slides`) get a nonzero ν. The states of the weight are also those of the body.
        """
        size = self.body.pattern.size
        moving = States(xi.reshape(-1, size), nu.reshape(-1, size), self.theta)
        resting = replace(moving, nu=np.zeros_like(moving.nu)) if self.still else moving
        return lambda term: moving if term.slides else resting

    @cached_property
    def _placed(self) -> list[tuple[ForceTerm, Slots]]:
        """Every external term with its columns and entries in the shared arrays."""
        entries: Iterator[Index] = iter(self.joined.places[1:])
        nowhere: Index = np.zeros(0, dtype=np.int64)
        return [
            (
                term,
                Slots(slice(start, stop), nowhere if term.couplings is None else next(entries)),
            )
            for term, start, stop in zip(self.terms, self._ends, self._ends[1:], strict=False)
        ]

    def pointwise(self, number: int) -> tuple[Pointwise, Index]:
        """Return one of the further terms, and the columns of its constants among all inputs.

        Parameters
        ----------
        number : int
            Index in `further`; the term must be a `Pointwise`.
        """
        term, places = self._placed[1 + number]
        assert isinstance(term, Pointwise)
        return term, term.columns(places)

    @property
    def air_drag(self) -> PointForces | None:
        """Drag of the air around the body; None in a vacuum or in a static experiment."""
        terms = (term for term in self.further if isinstance(term, PointForces) and term.of_air)
        return next(terms, None)

    @property
    def carrying(self) -> list[int]:
        """Indices in `further` of the terms with internal variables."""
        return [k for k, term in enumerate(self.further) if term.carries]

    @property
    def pressing(self) -> list[int]:
        """Indices in `further` of the contacts as complementarity."""
        further = enumerate(self.further)
        return [k for k, term in further if isinstance(term, Contact) and term.relaxed]

    def _widened(self, by_theta: Array) -> Array:
        """Return derivatives by θ (…, k) with zero columns appended for the inputs of the terms (…,
        U).
        """
        further = self._ends[-1] - self._ends[0]
        if not further:
            return by_theta
        return np.concatenate([by_theta, np.zeros((*by_theta.shape[:-1], further))], axis=-1)
