"""Check of a time-stepping scheme: `check_scheme`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from collocation_sysid.common.array_types import Array
from collocation_sysid.errors import SimulationError
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.fem.schemes import Scheme, Stencil, as_scheme
from collocation_sysid.program.simulation import simulate
from collocation_sysid.testing.property_check import PropertyCheck
from collocation_sysid.testing.small_problems import (
    DENSITY_KG_M3,
    program_of,
    swung_experiment,
    usual_constants,
)
from kit.checks import observed_order
from kit.program_derivatives import require_derivatives

# Rounding of sums of coefficients.
ROUNDING = 1e-12
# Undamped oscillations: angular frequency times step, up to a fourteenth of a period.
RESOLVED_STEPS = (1e-3, 0.05, 0.2, 0.45)
# Largest growth of an undamped oscillation per step: rounding of double roots.
LARGEST_GROWTH = 1e-7
# The oscillator x″ = −ω² x − 2ζω x′ [rad/s, 1], its duration [s] and numbers of steps: within the
# asymptotic range.
ANGULAR_FREQUENCY_RAD_S = 6.0
DAMPING_RATIO = 0.1
DURATION_S = 1.0
STEP_COUNTS = (100, 200, 400)
# Largest difference of the measured order from the stated one.
ORDER_TOLERANCE = 0.2
# Largest residual of a simulated motion, relative to the largest weight of a node: Newton's
# tolerance.
LARGEST_RESIDUAL = 1e-6


def check_scheme(scheme: str | Scheme) -> None:
    """Check a scheme: coefficients, stability, order, simulated motions, derivatives in programs.

    The stencils reproduce constants, straight lines and parabolas, and those of the first rows
    use no point before the start. An undamped oscillation does not grow. The error of an
    oscillator, computed in plain NumPy from the table, decreases with the stated order. A
    simulated motion of a small body satisfies every row of the table, evaluated in plain NumPy,
    and gradient, Jacobian and Hessian of its program pass a Taylor test. An unknown
    start rule is refused by its name. The scheme can be pickled.

    Parameters
    ----------
    scheme : str or Scheme
        Scheme of your own, or the name of one of the package.

    Raises
    ------
    AssertionError
        For the first property that fails: which one, where, found and expected value.
    InputError
        For an unknown name of a scheme.
    """
    made = as_scheme(scheme)
    check = PropertyCheck(f"scheme {made.name!r}")
    _check_regular(check, made.regular)
    for row, stencil in enumerate(made.start, start=1):
        _check_start(check, stencil, row=row)
    _check_stability(check, made)
    _check_order(check, made)
    _check_simulation(check, made)


def _moment(coefficients: tuple[float, ...], power: int) -> float:
    """Return Σ_i c_i (−i)^power: the stencil's value of (t / Δt)^power."""
    return sum(c * (-float(i)) ** power for i, c in enumerate(coefficients))


def _check_regular(check: PropertyCheck, stencil: Stencil) -> None:
    """Require that the regular stencil reproduces constants, straight lines and parabolas, that its
    weights of forces add to 1, and that it does not use the start velocity.
    """
    expected = {
        "the position ξ of a constant (Σ p)": (_moment(stencil.p, 0), 1.0),
        "the velocity ν of a constant (Σ q)": (_moment(stencil.q, 0), 0.0),
        "the velocity ν of a straight line": (_moment(stencil.q, 1), 1.0),
        "the sum of the weights of forces (Σ w)": (sum(stencil.w), 1.0),
        "the acceleration of a constant (Σ s)": (_moment(stencil.s, 0), 0.0),
        "the acceleration of a straight line": (_moment(stencil.s, 1), 0.0),
        "the acceleration of t²": (_moment(stencil.s, 2), 2.0),
        "the weight r of the start velocity": (stencil.r, 0.0),
    }
    _check_values(check, expected, where="the regular stencil")


def _check_start(check: PropertyCheck, stencil: Stencil, row: int) -> None:
    """Require that the stencil of a first row is consistent and uses no point before the start."""
    expected = {
        "the position ξ of a constant (Σ p)": (_moment(stencil.p, 0), 1.0),
        "the velocity ν of a constant (Σ q)": (_moment(stencil.q, 0), 0.0),
        "the velocity ν of a straight line": (_moment(stencil.q, 1), 1.0),
        "the acceleration of a constant (Σ s)": (_moment(stencil.s, 0), 0.0),
        "the acceleration at constant velocity": (_moment(stencil.s, 1) + stencil.r, 0.0),
    }
    _check_values(check, expected, where=f"the stencil of row {row}")
    points = max(len(stencil.p), len(stencil.q)) + len(stencil.w) - 1
    if max(points, len(stencil.s)) > row + 1:
        check.fail(
            f"the stencil of row {row} uses points before the start",
            f"{max(points, len(stencil.s))} points",
            expected=f"at most {row + 1}",
        )


def _check_values(
    check: PropertyCheck, expected: dict[str, tuple[float, float]], where: str
) -> None:
    """Require that values agree with expected ones to an absolute error of `ROUNDING`."""
    for name, (moment, value) in expected.items():
        if not abs(moment - value) <= ROUNDING:
            check.fail(f"{name} in {where} is wrong", moment, expected=value)


def _check_stability(check: PropertyCheck, scheme: Scheme) -> None:
    """Require that no solution of the regular rows of an undamped oscillator grows, for ωΔt of
    `RESOLVED_STEPS`: no root of their characteristic polynomial exceeds 1 + `LARGEST_GROWTH`.
    """
    stencil = scheme.regular
    for step in RESOLVED_STEPS:
        force = step**2 * np.convolve(stencil.w, stencil.p)
        width = max(len(force), len(stencil.s))
        coefficients = np.zeros(width)
        coefficients[: len(force)] += force
        coefficients[: len(stencil.s)] += stencil.s
        largest = float(np.abs(np.roots(coefficients)).max(initial=0.0))
        if not largest <= 1 + LARGEST_GROWTH:
            check.fail(
                f"it adds energy: per step, an undamped oscillation with ωΔt = {step:g} grows by",
                largest,
                expected="at most a factor of 1",
            )


@dataclass(frozen=True)
class PlainRows:
    """Rows of a scheme for a force f(ξ, ν) and a mass, as the module `model.schemes` states them."""

    scheme: Scheme
    # ``force(xi, nu)`` → force at a position ξ and a velocity ν of one evaluation.
    force: Callable[[Any, Any], Any]
    mass: float | Array  # mass of each dof
    timestep_s: float  # step Δt [s]
    start_velocity: float | Array

    def residual(self, x: Array, row: int) -> Any:
        """Return c_t of a row, force minus mass times acceleration, at positions x (T, …) from the
        start on.

        Parameters
        ----------
        x : (T, …) array
            Positions at the grid times, at least row + 1 of them; later ones are ignored.
        row : int
            Number of the row, from 1 on; it is the equation for x[row].
        """
        stencil = self.scheme.stencil(row)
        total: Any = 0.0
        for lag, weight in enumerate(stencil.w):
            own = self.scheme.stencil(row - lag)
            xi = sum(c * x[row - lag - i] for i, c in enumerate(own.p))
            nu = sum(c * x[row - lag - i] for i, c in enumerate(own.q)) / self.timestep_s
            total = total + weight * self.force(xi, nu)
        inertia: Any = sum(c * x[row - i] for i, c in enumerate(stencil.s))
        inertia = inertia + stencil.r * self.timestep_s * self.start_velocity
        return total - self.mass * inertia / self.timestep_s**2


def _check_order(check: PropertyCheck, scheme: Scheme) -> None:
    """Require that errors of a damped oscillator decrease with the stated order."""
    omega = ANGULAR_FREQUENCY_RAD_S
    errors = []
    for count in STEP_COUNTS:
        t_s = np.linspace(0, DURATION_S, count + 1)
        rows = PlainRows(
            scheme,
            lambda xi, nu: -(omega**2) * xi - 2 * DAMPING_RATIO * omega * nu,
            mass=1.0,
            timestep_s=DURATION_S / count,
            start_velocity=1.0,
        )
        x = np.zeros(count + 1)
        for row in range(1, count + 1):
            at_zero = rows.residual(x, row)
            x[row] = 1.0
            x[row] = at_zero / (at_zero - rows.residual(x, row))  # a row is affine in x_t
        damped = omega * np.sqrt(1 - DAMPING_RATIO**2)
        exact = np.exp(-DAMPING_RATIO * omega * t_s) * np.sin(damped * t_s) / damped
        errors.append(np.abs(x - exact).max())
    order = observed_order(DURATION_S / np.array(STEP_COUNTS), np.array(errors))
    if not abs(order - scheme.order) <= ORDER_TOLERANCE:
        check.fail(
            "the error of an oscillator has another order than stated", order, expected=scheme.order
        )


def _check_simulation(check: PropertyCheck, scheme: Scheme) -> None:
    """Require that a simulated motion of a small body, swung by a grasp from its undeformed shape,
    satisfies every row of the table at its free dofs; check its program by `require_derivatives`.
    """
    body = Body(box_mesh((0.05, 0.05, 0.1), (1, 1, 2)), density_kg_m3=DENSITY_KG_M3)
    values = usual_constants(tuple(body.constants.values()), None)
    experiment = replace(swung_experiment(body), start="undeformed")
    try:
        x = simulate(experiment, values, scheme, substeps=1).positions_m.reshape(
            -1, 3 * len(body.nodes_m)
        )
    except SimulationError as error:
        check.fail("a small body cannot be simulated", error, expected="a motion")
    theta = np.array([*values.values()])
    weight = np.tile(experiment.gravity_m_s2, len(body.nodes_m)) * body.dof_mass
    rows = PlainRows(
        scheme,
        lambda xi, nu: body.force(xi, nu, theta)[0] + weight,
        mass=body.dof_mass,
        timestep_s=experiment.timestep_s,
        start_velocity=0.0,
    )
    scale = float(np.abs(weight).max())
    for row in range(1, len(x)):
        residual = rows.residual(x, row)[experiment.free_dofs]
        check.require_equal(
            residual,
            np.zeros_like(residual),
            statement=f"a simulated motion does not satisfy row {row} of the table",
            tolerance=LARGEST_RESIDUAL,
            scale=scale,
        )
    made = program_of(experiment, values)
    require_derivatives(check, replace(made, scheme=scheme))
