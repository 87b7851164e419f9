"""All forces on a body at some times: F(ξ, ν; u) = f(ξ, ν; θ) + Σ terms.

Whatever acts on the body of an experiment joins here, and nothing else adds forces: the internal
ones f of its materials and dampings, see `fem.body`, `weight`, and the `potential` of each tendon
and pressure. Slopes are on the pattern of all couplings; slopes by θ go on with those by the other
inputs u, term by term, see `inputs`.
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
    """The forces on a body at T times.

    States ξ, ν are (T, 3n) positions [m] and velocities [m/s], or one (3n,) where T is one.

    Attributes
    ----------
    weight : Weight
    further : tuple of ForceTerm
    joined : Joined
        The mesh graph, and the couplings of the further terms that have some.
    theta : (k,) constants of the body; NaN where they are not known yet
    still : bool
        Whether nothing moves, and ν is the way since the sample before, see `ForceTerm.slides`.
    past : Past, optional
        What the states of a body with memory bring; nothing by default.
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
        """Those of an experiment at the times `t_s` (T,).

        Contact pressures are means over time steps of `step_s`; where it is 0, those at each state.
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
        found = cls(Weight.of(experiment, times), further, experiment.joined, unknown, still)
        return found if theta is None else found.with_theta(theta)

    @classmethod
    def on(cls, body: Body, theta: Sequence[float] | Array) -> Forces:
        """Those on a body that nothing acts on but what is its own, at one time."""
        own, known = point_forces(body, np.zeros(1)), np.asarray(theta, dtype=float)
        weight = Weight.none(body).with_theta(known)
        return cls(weight, own, body.joined_with(()), known)

    def with_theta(self, theta: Sequence[float] | Array) -> Forces:
        """The same on a body of these constants (k,)."""
        known = np.array(theta, dtype=float)
        return replace(self, theta=known, weight=self.weight.with_theta(known))

    @property
    def body(self) -> Body:
        """What they act on."""
        return self.weight.body

    @property
    def mass(self) -> Mass:
        """What accelerates, what gravity pulls at, and what γ_m damps."""
        return self.weight.mass

    @property
    def pattern(self) -> SymmetricPattern:
        """Of the slopes."""
        return self.joined.pattern

    @cached_property
    def terms(self) -> tuple[ForceTerm, ...]:
        """Beside what is internal."""
        return (self.weight, *self.further)

    @cached_property
    def _ends(self) -> list[int]:
        """Where the inputs of each term begin in u, and where the last end."""
        sizes = [term.size for term in self.terms]
        return list(accumulate(sizes, initial=len(self.body.constants)))

    @cached_property
    def mass_by_input(self) -> dict[int, Array]:
        """∂M/∂u (3n,) of each input, by its place in u, that M depends on."""
        return self.weight.mass_by_input(self._ends[0])

    def at(self, u: Array) -> Forces:
        """The same at inputs (T, U)."""
        found = self.with_theta(u[0, : self._ends[0]])
        if self._ends[0] == self._ends[-1]:
            return found
        weight, *further = (
            term.at(u[:, start:stop])
            for term, start, stop in zip(found.terms, self._ends, self._ends[1:], strict=False)
        )
        return replace(found, weight=weight, further=tuple(further))

    def rows(self, rows: slice) -> Forces:
        """The same at some of the times."""
        further = tuple(term.rows(rows) for term in self.further)
        return replace(self, weight=self.weight.rows(rows), further=further)

    def scaled(self, share: float) -> Forces:
        """The same with a share of what acts, on the same mass."""
        further = tuple(term.scaled(share) for term in self.further)
        return replace(self, weight=self.weight.scaled(share), further=further)

    def towards(self, other: Forces, share: float) -> Forces:
        """With a share of the way to what acts at other times, whose states bring the same."""
        further = tuple(
            term.towards(that, share)
            for term, that in zip(self.further, other.further, strict=True)
        )
        return replace(other, weight=self.weight.towards(other.weight, share), further=further)

    def with_further(self, number: int, term: ForceTerm) -> Forces:
        """The same with another in the place of one of the further terms."""
        further = self.further[:number], self.further[number + 1 :]
        return replace(self, further=(*further[0], term, *further[1]))

    def without_contact(self) -> tuple[Forces, list[Contact]]:
        """The same on the same pattern but for contact by an energy, and that."""
        touching = [term for term in self.further if isinstance(term, Contact) and not term.relaxed]
        further = tuple(term for term in self.further if term not in touching)
        places = [p.entries for t, p in self._placed if t.couplings and t not in touching]
        joined = Joined(self.pattern, (self.joined.places[0], *places))
        return replace(self, further=further, joined=joined), touching

    def undriven(self) -> Forces:
        """Weight and loads alone, without what drives the body or acts by a law of its own."""
        return replace(self, further=(), joined=Joined.of((self.body.pattern,)))

    def total(self, xi: Array, nu: Array) -> Array:
        """F, (T, 3n) [N]."""
        of = self.states(xi, nu)
        found = self.body.force(xi, of(self.weight).nu, self.theta, self.mass.tied, self.past)
        for term in self.terms:
            found = found + term.force(of(term))
        return found

    def linearise(self, xi: Array, nu: Array, out: Array | None = None) -> Linearisation:
        """F and its slopes, at what is brought; views of `out` (T, `linearisation_width`)."""
        of = self.states(xi, nu)
        still_nu = of(self.weight).nu
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
            term.add_slopes(at, places, of(term))
        return at

    @property
    def _is_wider(self) -> bool:
        """Whether there is, or is room for, more than what the body's own forces have."""
        more = self._ends[-1] > self._ends[0] or self.pattern is not self.body.pattern
        return bool(self.further) or more

    @property
    def linearisation_width(self) -> int:
        """Length of one time's row of `linearise`."""
        return self.body.linearisation_width

    def curvature(
        self, xi: Array, nu: Array, weights: Array, out: Array | None = None
    ) -> Curvature:
        """Second derivatives of weightsᵀ F and of what of it is left to others.

        That is Σ σ·S of a memory, and `weighed` of what forces carry; `out` is
        (T, `curvature_width`).
        """
        of = self.states(xi, nu)
        known = self.theta, out, self.mass.tied, self.past
        at = self.body.curvature(xi, of(self.weight).nu, weights, *known)
        if self.still:
            for by_velocity in (
                at.position_velocity,
                at.velocity_theta,
                at.position_velocity_skew,
            ):
                by_velocity[:] = 0.0
        if self._is_wider:
            spread, widened = self.joined.spread, self._widened
            at = Curvature(
                spread(at.position_position),
                spread(at.position_velocity),
                widened(at.position_theta),
                widened(at.velocity_theta),
                widened(widened(at.theta_theta).swapaxes(1, 2)),
                widened(at.theta),
                spread(at.position_velocity_skew),
                # Room for the curvature by velocities, where forces may have some.
                np.zeros((len(at.theta), self.pattern.entries * self._by_velocity)),
            )
        for term, places in self._placed:
            states = of(term)
            term.add_curvature(at, places, states, weights.reshape(states.xi.shape))
        return at

    @cached_property
    def spins(self) -> bool:
        """Whether slopes by velocities have a skew part."""
        return any(term.spins for term in self.further)

    @cached_property
    def _by_velocity(self) -> bool:
        """Whether a term's slopes by velocities change with these."""
        return any(term.by_velocity for term in self.further)

    @property
    def curvature_width(self) -> int:
        """Length of one time's row of `curvature`."""
        return self.body.curvature_width

    def states(self, xi: Array, nu: Array) -> Callable[[ForceTerm], States]:
        """What each term, or the body as weight does, sees of the states."""
        size = self.body.pattern.size
        moving = States(xi.reshape(-1, size), nu.reshape(-1, size), self.theta)
        resting = replace(moving, nu=np.zeros_like(moving.nu)) if self.still else moving
        return lambda term: moving if term.slides else resting

    @cached_property
    def _placed(self) -> list[tuple[ForceTerm, Slots]]:
        """Every term, and where what it adds goes."""
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
        """One of the further terms, which is, and where its inputs are among all."""
        term, places = self._placed[1 + number]
        assert isinstance(term, Pointwise)
        return term, term.columns(places)

    @property
    def air_drag(self) -> PointForces | None:
        """Drag of the air around the body; None in a vacuum and where nothing moves."""
        terms = (term for term in self.further if isinstance(term, PointForces) and term.of_air)
        return next(terms, None)

    @property
    def carrying(self) -> list[int]:
        """Numbers of the further terms that carry something."""
        return [k for k, term in enumerate(self.further) if term.carries]

    @property
    def pressing(self) -> list[int]:
        """Numbers of those that are contact as complementarity."""
        further = enumerate(self.further)
        return [k for k, term in further if isinstance(term, Contact) and term.relaxed]

    def _widened(self, by_theta: Array) -> Array:
        """(…, U) slopes by θ with room for those by the inputs of the terms."""
        further = self._ends[-1] - self._ends[0]
        if not further:
            return by_theta
        return np.concatenate([by_theta, np.zeros((*by_theta.shape[:-1], further))], axis=-1)
