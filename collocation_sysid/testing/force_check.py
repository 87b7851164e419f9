"""Check of a custom force on nodes or faces: `check_force`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from ..common.array_types import Array
from ..common.validated_classes import validated
from ..errors import InputError
from ..fem.node_force import CONTEXT_OFFSETS, CONTEXT_SIZE, ForceContext, Law, NodeForce
from ..model.generated_functions import GeneratedFunction
from .property_check import PropertyCheck
from .small_problems import TIMESTEP_S, usual_constants

# Number of random states, and of random velocities for the power at each.
STATES = 3
VELOCITIES = 20
# Random displacements of a point [m] and velocities [m/s] of a hand-held body of 0.1 m.
DISPLACEMENT_M = 2e-3
VELOCITY_M_S = 0.3
# Share of a node in the surface [m²] and volume [m³] of such a body.
AREA_M2 = 2e-4
VOLUME_M3 = 5e-6
# Edge of the triangle of a face [m].
FACE_EDGE_M = 0.03
# Most positive power, relative to the largest product of force and speed, that counts as rounding.
ROUNDING = 1e-9


@validated
def check_force(
    force: Law | NodeForce,
    *,
    constants: Mapping[str, float] | None = None,
    energy: Callable[..., Any] | None = None,
    is_dissipative: bool = False,
    is_zero_at_rest: bool = False,
) -> None:
    """Check a custom force: values, derivatives, energy and dissipation.

    At random states the generated force equals the law called with numbers, its first and second
    derivatives by position, velocity, constants and internal variables are CasADi's automatic
    derivatives of the plain law and agree with central differences.

    Parameters
    ----------
    force : NodeForce or callable
        Force, or its law ``law(x, v, at, **constants)``.
    constants : mapping of name to float, optional
        Values of constants at which to check; by default those of a soft foam, and 1 for
        constants of unknown size.
    energy : callable, optional
        ``energy(x, at, **constants)`` [J] of a force on nodes: the force without velocity is
        −∂energy/∂x.
    is_dissipative : bool
        Whether the part of the force that depends on the velocity never adds energy: (f(x, v) −
        f(x, 0))·v ≤ 0.
    is_zero_at_rest : bool
        Whether the force is zero at the undeformed place of a node that does not move.

    Raises
    ------
    AssertionError
        For the first property that fails: which one, where, found and expected value.
    InputError
        If the law cannot be evaluated, has the wrong shape or is not finite at rest, or if an
        energy is given for a force on faces.

    Notes
    -----
    An `energy` is compared only at random states of a node, with velocity zero. `is_zero_at_rest`
    is checked at the first place, to 1e-9 N.
    """
    made = force if isinstance(force, NodeForce) else NodeForce.from_law(force)
    check = PropertyCheck(f"force {made.name!r}")
    values = usual_constants(made.constants, constants)
    if energy is not None and made.on != "nodes":
        raise InputError(
            f"force {made.name!r} is on faces, where an energy cannot be checked; leave out the energy"
        )
    law = ForceLaw(made, np.array([*values.values()]))
    states = [
        law.random_state(check.rng, place) for place in check.rng.uniform(0.01, 0.1, (STATES, 3))
    ]
    for number, state in enumerate(states):
        where = f"at random state {number}"
        _check_derivatives(check, law, state=state, where=where)
        if energy is not None:
            _check_energy(check, law, state=state, energy=energy, where=where)
        if is_dissipative:
            _check_dissipation(check, law, state=state, where=where)
    if is_zero_at_rest:
        u, data = law.state_at_rest(states[0])
        found = law.evaluate_plain(u, data)[: law.dofs]
        check.require_equal(
            found, np.zeros(law.dofs), statement="the force at rest is not zero", scale=1.0
        )


@dataclass(frozen=True, eq=False)
class ForceLaw:
    """Custom force on one node or triangle, by its plain law and as programs evaluate it.

    Inputs u are stacked (x, v, constants, internal variables); data are the entries of a
    `ForceContext`.

    Notes
    -----
    n dofs are 3 for a force on nodes and 9 for one on faces, corner after corner. u is (n
    positions, n velocities, constants, internal variables of the previous evaluation); the outputs
    are n forces [N], then the internal variables of this evaluation.
    """

    force: NodeForce
    values: Array  # (k,): values of its constants

    @property
    def dofs(self) -> int:
        """Number of dofs of one node (3) or of the three corners of a face (9)."""
        return 3 if self.force.on == "nodes" else 9

    @cached_property
    def generated(self) -> GeneratedFunction:
        """Force as the programs evaluate it, as a function of u and data with generated
        derivatives.
        """
        return GeneratedFunction(
            self.force.expression,
            self.force.input_size(self.dofs),
            data_size=CONTEXT_SIZE,
            is_compiled=self.force.is_compiled,
        )

    def random_state(self, rng: np.random.Generator, place: Array) -> tuple[Array, Array]:
        """Return inputs u and data of a random state near a place (3,) [m], after the start.

        Corners of a face are the place and points at `FACE_EDGE_M` from it along x and y, all
        displaced at random, as are the velocities, the normal and the previous internal variables.
        The state is returned as two (k,) arrays.
        """
        corners = np.zeros((self.dofs // 3, 3))
        corners[1:] = FACE_EDGE_M * np.eye(3)[: self.dofs // 3 - 1]
        x = place + corners + rng.uniform(-DISPLACEMENT_M, DISPLACEMENT_M, corners.shape)
        v = VELOCITY_M_S * rng.standard_normal(self.dofs)
        before = 1e-3 * rng.standard_normal(self.force.internal_variable_count)
        normal = rng.standard_normal(3)
        normal /= np.linalg.norm(normal)
        data = [2.5 * TIMESTEP_S, *place, AREA_M2, VOLUME_M3, *normal, TIMESTEP_S, 0.0]
        return np.concatenate([x.ravel(), v, self.values, before]), np.array(data)

    def state_at_rest(self, state: tuple[Array, Array]) -> tuple[Array, Array]:
        """Return the state (u, data) of an undeformed body at the start (`is_start` is 1), without
        velocity.

        Place and context are those of `state`, which is not modified; previous internal variables
        are zero.
        """
        u = np.zeros_like(state[0])
        data = state[1].copy()
        u[: self.dofs] = np.tile(data[1:4], self.dofs // 3)
        if self.dofs > 3:
            u[3:9] += FACE_EDGE_M * np.eye(3)[:2].ravel()
        u[2 * self.dofs : 2 * self.dofs + len(self.values)] = self.values
        data[-1] = 1.0
        return u, data

    def plain(self, u: Any, data: Any) -> Any:
        """Return forces on node or corners, then the internal variables, by calling the law.

        On a face the law is called with mean position and velocity of the corners and with the
        current area and normal of the triangle; each corner gets a third of the result.

        Parameters
        ----------
        u, data : DM or SX
            Inputs and data, as columns.

        Returns
        -------
        DM or SX, like the arguments
            Column of `dofs` forces [N], then the internal variables of this evaluation.
        """
        dofs = self.dofs
        constants = len(self.values)
        x, v, values, before = ca.vertsplit(u, [0, dofs, 2 * dofs, 2 * dofs + constants, u.numel()])
        at = ForceContext(*ca.vertsplit(data, [*CONTEXT_OFFSETS]))
        if dofs > 3:
            a, b, c = (x[3 * k : 3 * k + 3] for k in range(3))
            area = ca.cross(b - a, c - a) / 2
            at = at._replace(area_m2=ca.norm_2(area), normal=area / ca.norm_2(area))
            x = (a + b + c) / 3
            v = (v[:3] + v[3:6] + v[6:]) / 3
        named = {c.name: values[k] for k, c in enumerate(self.force.constants)}
        if not self.force.internal_variable_count:
            result = [_column(self.force.law(x, v, at, **named))]
        else:
            force, after = self.force.law(x, v, before, at, **named)
            result = [_column(force), _column(after)]
        corners = dofs // 3
        return ca.vertcat(*[result[0] / corners] * corners, *result[1:])

    def evaluate_plain(self, u: Array, data: Array) -> Array:
        """Return the outputs of `plain` at u and data of numbers, as a (k,) array."""
        return np.ravel(ca.evalf(ca.SX(self.plain(ca.DM(u), ca.DM(data)))).full())

    @cached_property
    def automatic(self) -> ca.Function:
        """Function of u, data and weights w: ∂y/∂u and ∂²(wᵀy)/∂u² by automatic differentiation,
        where y is the output of `plain`.
        """
        u = ca.SX.sym("u", self.force.input_size(self.dofs))
        data = ca.SX.sym("data", CONTEXT_SIZE)
        y = self.plain(u, data)
        weights = ca.SX.sym("w", y.numel())
        second, _ = ca.hessian(ca.dot(weights, y), u)
        outputs = [ca.densify(ca.jacobian(y, u)), ca.densify(second)]
        return ca.Function("automatic", [u, data, weights], outputs)


def _column(values: Any) -> Any:
    """Return a list or tuple of expressions as a column; any other value unchanged."""
    return ca.vertcat(*values) if isinstance(values, list | tuple) else values


def _check_derivatives(
    check: PropertyCheck, law: ForceLaw, state: tuple[Array, Array], where: str
) -> None:
    """Compare the generated force with the plain law and with differences."""
    u, data = state
    columns = data[:, None]
    y, jacobian = law.generated.evaluate_with_jacobian(u[:, None], columns)
    weights = check.rng.standard_normal(len(y))
    hessian = law.generated.weighted_hessian(u[:, None], columns, weights[:, None])[..., 0]
    first, second = (each.full() for each in law.automatic.call([u, data, weights]))
    plain = law.evaluate_plain(u, data)
    check.require_equal(y[:, 0], plain, statement=f"the generated force is not the law {where}")
    automatic = "is not the automatic derivative of the law"
    check.require_equal(
        jacobian[..., 0], first, statement=f"the first derivative {automatic} {where}"
    )
    check.require_equal(hessian, second, statement=f"the second derivative {automatic} {where}")
    scale = np.maximum(np.abs(u), DISPLACEMENT_M)
    scale[: law.dofs] = DISPLACEMENT_M
    check.require_derivative(
        lambda at: law.evaluate_plain(at, data),
        jacobian[..., 0],
        point=u,
        statement=f"the derivative of the force by (x, v, constants) is wrong {where}",
        scale=scale,
    )
    check.require_derivative(
        lambda at: weights @ law.generated.evaluate_with_jacobian(at[:, None], columns)[1][..., 0],
        hessian,
        point=u,
        statement=f"the second derivative of the force by (x, v, constants) is wrong {where}",
        scale=scale,
    )


def _check_energy(
    check: PropertyCheck,
    law: ForceLaw,
    state: tuple[Array, Array],
    energy: Callable[..., Any],
    where: str,
) -> None:
    """Require that the force at rest is −∇energy, automatically and by differences."""
    u = state[0].copy()
    u[3:6] = 0.0
    force = law.evaluate_plain(u, state[1])[:3]
    at = ForceContext(*ca.vertsplit(ca.SX(ca.DM(state[1])), [*CONTEXT_OFFSETS]))
    named = {c.name: float(v) for c, v in zip(law.force.constants, law.values, strict=True)}
    x = ca.SX.sym("x", 3)
    gradient = ca.Function("gradient", [x], [ca.gradient(ca.SX(energy(x, at, **named)), x)])
    statement = f"the force is not −∂energy/∂x {where}"
    check.require_equal(force, -gradient(u[:3]).full().ravel(), statement=statement)
    check.require_derivative(
        lambda place: np.ravel(ca.evalf(ca.SX(energy(ca.DM(place), at, **named))).full()),
        -force,
        point=u[:3],
        statement=statement,
        scale=DISPLACEMENT_M,
    )


def _check_dissipation(
    check: PropertyCheck, law: ForceLaw, state: tuple[Array, Array], where: str
) -> None:
    """Require (f(x, v) − f(x, 0))·v ≤ 0 for `VELOCITIES` random velocities."""
    u = state[0].copy()
    velocity = slice(law.dofs, 2 * law.dofs)
    u[velocity] = 0.0
    still = law.evaluate_plain(u, state[1])[: law.dofs]
    powers = []
    largest = 0.0
    for _ in range(VELOCITIES):
        v = VELOCITY_M_S * 10 ** check.rng.uniform(-3, 1) * check.rng.standard_normal(law.dofs)
        u[velocity] = v
        force = law.evaluate_plain(u, state[1])[: law.dofs] - still
        powers.append(float(force @ v))
        largest = max(largest, float(np.linalg.norm(force) * np.linalg.norm(v)))
    if not max(powers) <= ROUNDING * largest:
        check.fail(
            f"it adds energy {where}: the power (f(x, v) − f(x, 0))·v is positive",
            max(powers),
            expected="at most 0 W",
        )
