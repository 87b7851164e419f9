"""One discrete equation of motion of a small body as a CasADi expression, see `Body.step_function`.

The elements are summed in one expression, which can be differentiated, used in a program of one's own
and written as C code; its length is proportional to their number. The forces of the elements are
those of the kernels that evaluate a body.
"""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca

from .discretisation import Discretisation
from .expressions import force_kernel
from .pattern import dofs_of
from .schemes import Scheme, Stencil

# Force (3n,) at positions and velocities (3n,).
Force = Callable[[ca.SX, ca.SX], ca.SX]


def element_forces(body: Discretisation, x: ca.SX, v: ca.SX, theta: ca.SX) -> ca.SX:
    """Return the sum (3n,) of the forces of all elements of a body without memory, with the mesh as
    stress-free shape, at positions and velocities (3n,) and constants (k,).
    """
    total = ca.SX.zeros(x.numel())
    constants = body.split_theta(theta)
    for number, part in enumerate(body.parts):
        cells, geometry = body.part_elements(part)
        kernel = force_kernel(body.element, body.law(number))
        force = kernel.element_function(geometry.shape[1]).expand()
        own = constants[number][: part.point_constant_count]
        for dofs, points in zip(dofs_of(cells).tolist(), geometry, strict=True):
            total[dofs] += force(x[dofs], v[dofs], ca.DM(points.T), own)
    return total


def step_function(
    force: Force, mass: ca.SX, theta: ca.SX, scheme: Scheme, row: int | None
) -> ca.Function:
    """Return row `row` of the equations of motion, the regular one for None, see
    `Body.step_function`.
    """

    def stencil_before(lag: int) -> Stencil | None:
        """Stencil of the row `lag` rows earlier; None for row 0, which evaluates no force."""
        if row is None:
            return scheme.regular
        return scheme.stencil(row - lag) if row > lag else None

    stencil = scheme.regular if row is None else scheme.stencil(row)
    reach = scheme.largest_lag if row is None else min(row, scheme.largest_lag)
    size = mass.numel()
    names = ["x", *(f"x_{lag}" for lag in range(1, reach + 1))]
    x = [ca.SX.sym(name, size) for name in names]
    v_0, u = ca.SX.sym("v_0", size), ca.SX.sym("u", size)
    step_s = ca.SX.sym("step_s")

    def combine(coefficients: tuple[float, ...], first: int) -> ca.SX:
        terms = [c * x[first + lag] for lag, c in enumerate(coefficients) if c]
        return sum(terms[1:], terms[0]) if terms else ca.SX.zeros(size)

    residual = u - mass * (combine(stencil.s, 0) / step_s**2 + stencil.r * v_0 / step_s)
    for lag, weight in enumerate(stencil.w):
        evaluation = stencil_before(lag)
        if weight and evaluation is not None:
            residual += weight * force(
                combine(evaluation.p, lag), combine(evaluation.q, lag) / step_s
            )
    inputs = [*x, *([v_0] if stencil.r else []), u, theta, step_s]
    names += [*(["v_0"] if stencil.r else []), "u", "theta", "step_s"]
    return ca.Function("step", inputs, [ca.densify(residual)], names, ["c"], {"cse": True})
