"""What is assumed about a recording without being estimated, and what it would do if it were wrong.

An assumption is a row of `ASSUMPTIONS`: how far off it may be, and what that changes in the
equations of motion, c = Σ w F − M a, or in the goals of grasped dofs; `considered` finds what that
does to the residuals. What changes only what cameras and clocks say is a nuisance parameter, see
`recording.nuisance`, and has its slopes from there.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, make_dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..checked import Options, Positive
from ..fem.body import Body
from ..fem.constants import GAMMA_R, bare
from ..fem.moduli import engineering
from ..model.dynamics import Dynamics
from ..model.force_term import States
from ..model.parameters import Parameters
from ..program.collocation import Part
from ..program.reaction import forces_on, reactions
from ..recording.nuisance import ROWS
from ..section import ByForm, Section

# Differences by a scale.
SMALL = 1e-4
# Relative standard deviation of the density of the air: weather and room temperature, at the stated
# altitude. At 2000 m the density is 18 % lower, and has to be stated.
AIR_DENSITY_DEVIATION = 0.03
# Relative standard deviation of the added mass and of the drag coefficient of a given body: they
# depend on its shape, on edges, on amplitude and on frequency.
AIR_COEFFICIENT_DEVIATION = 0.4
_AXES = "xyz"


@dataclass(frozen=True, eq=False)
class Effect:
    """What an assumption changes, if it is off by one deviation.

    Attributes
    ----------
    force_n : (N, 3n), optional
        Forces at the evaluations.
    mass_kg : (3n,), optional
        What moves with every dof and is not in `force_n`: its inertia alone.
    stretched : float
        By how much times are longer, of one, as inertia sees it.
    moved_m : (N, g), optional
        The goals of grasped dofs.
    """

    force_n: Array | None = None
    mass_kg: Array | None = None
    stretched: float = 0.0
    moved_m: Array | None = None


@dataclass(frozen=True, eq=False)
class Fitted:
    """One experiment at the answer, as assumptions look at it."""

    part: Part
    parameters: Parameters

    @property
    def body(self) -> Body:
        """What moves."""
        return self.part.segment.body

    @property
    def dynamics(self) -> Dynamics:
        """Its equations of motion."""
        return self.part.setting.dynamics

    @property
    def theta(self) -> Array:
        """(k,)"""
        return self.dynamics.theta

    @property
    def gravity(self) -> Array:
        """(3n,)"""
        return self.dynamics.forces.weight.gravity

    @cached_property
    def own_mass_kg(self) -> Array:
        """(3n,) of the body, without what is tied to it."""
        return self.body.mass_of_dofs(self.theta)

    @cached_property
    def acceleration(self) -> Array:
        """(N, 3n) of the rows."""
        return self.dynamics.acceleration(self.part.x)

    @cached_property
    def states(self) -> tuple[Array, Array]:
        """ξ and ν (N, 3n) at the evaluations."""
        xi, nu = self.dynamics.evaluation_states(self.part.x)
        return self.of_rows(xi), self.of_rows(nu)

    def of_rows(self, evaluated: Array) -> Array:
        """Rows (N, 3n) of those that are evaluated, zero before."""
        return np.concatenate([np.zeros((self.dynamics.first_row, evaluated.shape[1])), evaluated])

    def internal_n(
        self, scale: float = 1.0, slower: float = 1.0, theta: Array | None = None
    ) -> Array:
        """(N, 3n) what the material gives where space, or time, is scaled; without γ_m."""
        still = (self.theta if theta is None else theta).copy()
        still[list(self.body.tied_shares)] = 0.0
        dynamics = self.dynamics.with_theta(still)
        carried = dynamics.forces_along(dynamics.histories(self.part.x)).past
        xi, nu = dynamics.evaluation_states(self.part.x)
        return self.of_rows(
            self.body.force(xi / scale, nu / (scale * slower), still, carried=carried)
        )

    def weight_of(self, mass_kg: Array) -> Array:
        """(N, 3n) what gravity and γ_m do to mass (3n,)."""
        return mass_kg * (self.gravity - self.body.tied_drag(self.theta) * self.states[1])

    @property
    def buoyancy_n(self) -> Array:
        """(N, 3n) buoyancy in the model; zero in a vacuum."""
        lifted = -self.dynamics.mass.displaced_kg * self.gravity
        return np.broadcast_to(lifted, self.part.x.shape)

    @property
    def added_mass_kg(self) -> Array:
        """(3n,) air in the model that moves with the body; zero in a vacuum."""
        return self.dynamics.mass.added_kg

    @cached_property
    def air_drag_n(self) -> Array:
        """(N, 3n) drag of the air in the model; zero in a vacuum and where nothing moves."""
        term = self.dynamics.forces.air_drag
        if term is None:
            return np.zeros_like(self.states[1])
        drag = term.force(States(*self.states, self.theta))
        drag[: self.dynamics.first_row] = 0.0
        return drag

    @cached_property
    def grasp_force_n(self) -> Array:
        """(N, g) what the grasps give the grasped dofs."""
        dofs, x = self.part.setting.held.dofs, self.part.x
        force = forces_on(self.dynamics, x, dofs)
        mass = self.dynamics.mass.kg[:, dofs]
        given = reactions(self.dynamics, mass, force, self.acceleration[:, dofs])
        return np.where(np.isnan(self.part.setting.held.positions_m), 0.0, given)

    @cached_property
    def proportional_s(self) -> Array:
        """(E,) γ_r of elements whose damping is γ_r K(x) v, zero of others."""
        gamma_r_s = np.zeros(len(self.body.cells))
        for part, start in zip(self.body.parts, self.body.starts, strict=False):
            if GAMMA_R in part.damping.constants and part.damping.stress is None:
                gamma_r_s[part.cells] = self.theta[start + part.constants.index(GAMMA_R)]
        return gamma_r_s

    @cached_property
    def young_pa(self) -> float:
        """Of the softest part, at small strain."""
        return min(engineering(*moduli)[0] for moduli in self.body.lame(self.theta).values())


@dataclass(frozen=True)
class Assumption:
    """Something that is taken as it is stated.

    Attributes
    ----------
    name : str
    unit : str
        Of its deviation.
    sigma : float
        The deviation, as a careful laboratory has it.
    said : str
        What it is.
    effect : callable
        Of an experiment at the answer and the number of its axis: what it changes, if it is off by
        one of its unit; None where there is no such thing.
    axes : str
        Names of its components, which are off independently; one without.
    """

    name: str
    unit: str
    sigma: float
    said: str
    effect: Callable[[Fitted, int], Effect | None]
    axes: str = ""

    @property
    def components(self) -> tuple[str, ...]:
        """Names with their axes."""
        return tuple(f"{self.name} {a}" for a in self.axes.split()) or (self.name,)


# What each changes ------------------------------------------------------------------------------


def _size(at: Fitted, _: int) -> Effect:
    """The body is larger by a share: f = s² f(x/s, v/s), its goals about the middle of its grasp.

    From Ψ(x; s) = s³ Ψ(x/s): what is strained is the ratio of lengths.
    """
    larger, smaller = 1 + SMALL, 1 - SMALL
    force = larger**2 * at.internal_n(larger) - smaller**2 * at.internal_n(smaller)
    mass = (0.0 if at.body.has_stated_mass else 3.0) * at.own_mass_kg
    grasping = at.part.segment.grasping
    turns: Array = np.nan_to_num(grasping.poses[0])
    off = grasping.places(at.part.phi)[0] - at.part.segment.nuisance.grasp_pivot_m
    moved = np.einsum("tgj,gj->tg", turns, off)
    air = 3.0 * at.buoyancy_n + 2.0 * at.air_drag_n
    return Effect(
        force / (2 * SMALL) + at.weight_of(mass) + air,
        mass + 3.0 * at.added_mass_kg,
        moved_m=moved,
    )


def _mass(at: Fitted, _: int) -> Effect | None:
    """All of the body is heavier by a share."""
    if any(part.free_density for part in at.body.parts):
        return None
    return Effect(at.weight_of(at.own_mass_kg), at.own_mass_kg)


def _density_gradient(at: Fitted, axis: int) -> Effect:
    """Heavier at one end of the body, lighter at the other, by a share of its density."""
    place = at.body.nodes_m[:, axis]
    middle = np.average(place, weights=at.own_mass_kg[::3])
    mass = at.own_mass_kg * np.repeat((place - middle) / np.abs(place - middle).max(), 3)
    return Effect(at.weight_of(mass), mass)


def _anisotropy(at: Fitted, axis: int) -> Effect:
    """Stiffer along one axis by a share of E: the energy ½ E e² of the strain e along it.

    Damping that is K(x) v has its slope by time.
    """
    body, (xi, nu) = at.body, at.states
    count, points = body.geometry.shape[:2]
    slopes = body.geometry[..., :-1].reshape(count, points, -1, 3)[..., axis]
    weight, force = at.young_pa * body.geometry[..., -1], np.zeros_like(xi)
    gamma = at.proportional_s[:, None, None]
    for x, v, own in zip(xi, nu, force, strict=True):
        stretch, rate = (
            np.einsum("eqa,eaj->eqj", slopes, each.reshape(-1, 3)[body.cells]) for each in (x, v)
        )
        strain = 0.5 * (np.sum(stretch**2, axis=2, keepdims=True) - 1)
        pull = (strain + gamma * np.sum(stretch * rate, axis=2, keepdims=True)) * stretch
        pull = weight[..., None] * (pull + gamma * strain * rate)
        np.subtract.at(own.reshape(-1, 3), body.cells, np.einsum("eqa,eqj->eaj", slopes, pull))
    force[: at.dynamics.first_row] = 0.0
    return Effect(force)


def _drift(at: Fitted, _: int) -> Effect:
    """Stiffer at the end than at the beginning, by a share."""
    t_s = at.dynamics.evaluated_s
    since = (t_s - t_s.mean()) / max(np.ptp(t_s), 1e-300)
    return Effect(at.internal_n() * since[:, None])


def _pace(at: Fitted, _: int) -> Effect | None:
    """All clocks are fast by a share: less time passes than they say."""
    if at.part.segment.experiment.static:
        return None
    slower, faster = at.internal_n(slower=1 + SMALL), at.internal_n(slower=1 - SMALL)
    drag = at.body.tied_drag(at.theta) * at.dynamics.mass.damped_kg * at.states[1]
    air = 2.0 * at.air_drag_n
    return Effect((faster - slower) / (2 * SMALL) - drag + air, stretched=-1.0)


def _poisson(at: Fitted, _: int) -> Effect | None:
    """Poisson's ratio is larger where it is stated, not estimated."""
    items = {item.name: item for item in at.parameters.items}
    stated = {
        name
        for name, item in items.items()
        if bare(name) == "poisson" and (items[item.tied.to] if item.tied else item).fixed
    }
    if not stated:
        return None
    values = at.parameters.values(at.part.q)
    larger, smaller = (
        at.internal_n(theta=at.body.theta({n: v + way * (n in stated) for n, v in values.items()}))
        for way in (SMALL, -SMALL)
    )
    return Effect((larger - smaller) / (2 * SMALL))


def _grip(at: Fitted, _: int) -> Effect | None:
    """Grip and what it touches give way like so much more of the body, in its thickness.

    What holds along some axes only is a platen or a plane of symmetry, and no grip.
    """
    held, holding = at.part.setting.held, at.part.segment.experiment.gripping
    gripped = [grasp.dofs for grasp in holding if len(grasp.axes) == len(_AXES)]
    if not gripped:
        return None
    area_m2 = at.body.dof_volume_m3[held.dofs] ** (2 / 3)
    here = np.isin(held.dofs, np.concatenate(gripped))
    moved = np.zeros_like(at.grasp_force_n)
    moved[:, here] = -at.grasp_force_n[:, here] / (at.young_pa * area_m2[here])
    return Effect(moved_m=moved)


def _driven(at: Fitted) -> NDArray[np.bool_]:
    """(g,) grasped dofs that a bench moves."""
    goals = at.part.setting.held.positions_m
    return np.asarray(np.nanmax(goals, axis=0) > np.nanmin(goals, axis=0))


def _machine(at: Fitted, _: int) -> Effect | None:
    """A test bench gives way: the displacement of what it moves is measured behind its frame."""
    experiment, held = at.part.segment.experiment, at.part.setting.held
    if not experiment.static or not (driven := _driven(at)).any():
        return None
    moved = np.zeros_like(at.grasp_force_n)
    for grasp in experiment.grasps:
        for axis in range(3):
            here = np.flatnonzero(np.isin(held.dofs, grasp.dofs) & (held.dofs % 3 == axis))
            if driven[here].any():
                moved[:, here] = -at.grasp_force_n[:, here].sum(axis=1, keepdims=True)
    return Effect(moved_m=moved)


def _platen_friction(at: Fitted, _: int) -> Effect | None:
    """Friction against the way that nodes slide along platens, across the axis these are moved on.

    Planes of symmetry have none: nothing presses along their axes.
    """
    experiment, held = at.part.segment.experiment, at.part.setting.held
    if not experiment.static:
        return None
    pressed = {_AXES[k] for k in np.unique(held.dofs[_driven(at)] % 3)}
    platens = [g for g in experiment.grasps if len(g.axes) < 3 and pressed & set(g.axes)]
    force, x = np.zeros_like(at.part.x), at.part.x
    start = at.body.nodes_m.ravel()
    for grasp in platens:
        across = [k for k, name in enumerate(_AXES) if name not in grasp.axes]
        for node in grasp.nodes:
            normal = np.isin(held.dofs, [3 * node + _AXES.index(a) for a in grasp.axes])
            press = np.linalg.norm(at.grasp_force_n[:, normal], axis=1)
            dofs = [3 * node + k for k in across]
            way = x[:, dofs] - start[dofs]
            length = np.linalg.norm(way, axis=1, keepdims=True)
            force[:, dofs] -= press[:, None] * way / np.maximum(length, 1e-9)
    return Effect(force) if platens else None


def _buoyancy(at: Fitted, _: int) -> Effect | None:
    """Return the effect of more buoyancy, as a share of that in the model; None in a vacuum."""
    return Effect(at.buoyancy_n) if at.added_mass_kg.any() else None


def _added_mass(at: Fitted, _: int) -> Effect | None:
    """Return the effect of more added mass, as a share of that in the model; None in a vacuum."""
    if at.part.segment.experiment.static or not at.added_mass_kg.any():
        return None
    return Effect(mass_kg=at.added_mass_kg)


def _air_drag(at: Fitted, _: int) -> Effect | None:
    """Return the effect of more drag, as a share of that in the model; None in a vacuum."""
    return Effect(at.air_drag_n) if at.part.segment.experiment.has_air_drag else None


# fmt: off
ASSUMPTIONS = (
    Assumption("body_scale", "1", 0.01, "size of the mesh", _size),
    Assumption("mass", "1", 0.01, "mass of the body, where it is not estimated", _mass),
    Assumption("density_gradient", "1", 0.05,
        "density at one end of the body over that in its middle", _density_gradient, "x y z"),
    Assumption("anisotropy", "1", 0.05,
        "stiffness along one axis over that across", _anisotropy, "x y z"),
    Assumption("stiffness_drift", "1", 0.02,
        "stiffness at the end over that at the beginning", _drift),
    Assumption("time_scale", "1", 1e-4, "pace of all clocks", _pace),
    Assumption("poisson", "", 0.02, "Poisson's ratio, where it is stated", _poisson),
    Assumption("grip_layer_m", "m", 2e-4,
        "what grip and skin give way, as thickness of the body's own material", _grip),
    Assumption("machine_compliance_m_n", "m/N", 1e-6, "what a test bench gives way", _machine),
    Assumption("platen_friction", "", 0.1,
        "friction of what holds nodes across and lets them slide", _platen_friction),
    Assumption("buoyancy", "1", AIR_DENSITY_DEVIATION,
        "buoyancy over that in the model, by the density of the air", _buoyancy),
    Assumption("added_mass", "1", AIR_COEFFICIENT_DEVIATION,
        "air that moves with the body over that in the model", _added_mass),
    Assumption("air_drag", "1", AIR_COEFFICIENT_DEVIATION,
        "drag of the air over that in the model", _air_drag),
)
# fmt: on


class KnownEffect(Section):
    """An effect of known sign and size, for which estimates are corrected to first order.

    Attributes
    ----------
    mean : float
        Its size, as measured.
    deviation : float
        Standard deviation of its size.
    """

    mean: Positive
    deviation: Positive


Deviation = Annotated[Literal["none"] | Positive, ByForm(str)]
KnownDeviation = Annotated[KnownEffect | Deviation, ByForm((dict, KnownEffect))]
# Rows that are never negative, of which a mean may be stated: what gives way does not push.
OF_KNOWN_SIGN = ("grip_layer_m", "machine_compliance_m_n")
_SAID = """How far off what is assumed may be: standard deviations, or "none" of what is exact.

Of what is known to be there, such as the compliance of a machine, a table of mean and deviation.
Nuisance parameters of recordings, by their names, count where they are not estimated.

Attributes
----------
"""
_FIELDS = [(row.name, row.sigma, f"{row.said} [{row.unit or 1}]") for row in ASSUMPTIONS]
_FIELDS += [(row.name, row.considered, f"{row.said} [{row.unit}]") for row in ROWS]


class _Stated(Options):
    """What `Assumptions` does with its fields."""

    @classmethod
    def exact(cls) -> Assumptions:
        """Return assumptions of which each is exactly true, as of a simulated recording."""
        exact: dict[str, Literal["none"]] = dict.fromkeys(vars(Assumptions()), "none")
        return Assumptions(**exact)

    @property
    def deviations(self) -> dict[str, float | None]:
        """By name; None of what is known exactly."""
        found: dict[str, float | None] = {}
        for name, stated in vars(self).items():
            known = stated.deviation if isinstance(stated, KnownEffect) else stated
            found[name] = None if known == "none" else known
        return found

    @property
    def means(self) -> dict[str, float]:
        """Sizes of the known effects by name, each over its standard deviation."""
        return {
            name: stated.mean / stated.deviation
            for name, stated in vars(self).items()
            if isinstance(stated, KnownEffect)
        }


if TYPE_CHECKING:

    @dataclass(frozen=True, init=False)
    class Assumptions(_Stated):
        """Made from the tables."""

        def __init__(
            self, **deviations: float | Literal["none"] | KnownEffect | Mapping[str, float]
        ) -> None: ...

else:
    Assumptions = make_dataclass(
        "Assumptions",
        [
            (
                name,
                KnownDeviation if name in OF_KNOWN_SIGN else Deviation,
                field(default=sigma or "none"),
            )
            for name, sigma, _ in _FIELDS
        ],
        bases=(_Stated,),
        frozen=True,
        kw_only=True,
        namespace={
            "__module__": __name__,
            "__doc__": _SAID + "\n".join(f"{name}\n    {said}." for name, _, said in _FIELDS),
        },
    )
