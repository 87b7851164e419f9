"""Simulation of a tapered bar by 27-node hexahedra and the generalized-alpha method.

This module is independent of the package and shares no code with it, so that recordings from here
test the whole chain of modelling: element, quadrature, mass matrix and time integration differ. The
material is the neo-Hookean one of docs/theory.md with the Kelvin–Voigt law of damping.

Run as a script it compares sag, frequency and decay of a slender cantilever with beam theory.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.sparse import coo_array, csr_array
from scipy.spatial.transform import Rotation
from script_arguments import make_parser

Array = np.ndarray
# Spectral radius of the generalized-alpha method at high frequencies.
RADIUS = 0.8
# Contraction of Newton's method that is too slow to keep a factorisation.
SLOW = 0.2
MOST_ITERATIONS = 40


def quadratic(xi: Array) -> tuple[Array, Array]:
    """Return the three quadratic shape functions at ξ (k,) in −1 … 1 and their derivatives (k, 3)."""
    values = np.stack([xi * (xi - 1) / 2, 1 - xi**2, xi * (xi + 1) / 2], axis=-1)
    return values, np.stack([xi - 0.5, -2 * xi, xi + 0.5], axis=-1)


def shape_functions(xi: Array) -> tuple[Array, Array]:
    """Return the 27 shape functions at ξ (k, 3) and their derivatives (k, 27, 3)."""
    (a, da), (b, db), (c, dc) = (quadratic(xi[:, axis]) for axis in range(3))

    def product(u, v, w):
        return np.einsum("ki,kj,kl->kijl", u, v, w).reshape(len(xi), 27)

    derivatives = np.stack([product(da, b, c), product(a, db, c), product(a, b, dc)], axis=-1)
    return product(a, b, c), derivatives


def inverse_transpose(f: Array) -> tuple[Array, Array]:
    """Return F⁻ᵀ and ln det F of matrices (..., 3, 3), the latter with two axes of length one."""
    rows = [f[..., i, :] for i in range(3)]
    cofactors = np.stack([np.cross(rows[(i + 1) % 3], rows[(i + 2) % 3]) for i in range(3)], -2)
    j = np.einsum("...k,...k->...", rows[0], cofactors[..., 0, :])[..., None, None]
    return cofactors / j, np.log(j)


class Bar:
    """A bar along z with a rectangular cross-section that shrinks linearly, held at its lower end.

    Lengths are multiplied by `scale`; the held end is at `start_m`. `truth` has young_pa, poisson,
    gamma_r_s, gamma_m_1_s and density_kg_m3; gradients (3,) are relative differences between the
    end and the middle along each axis, `drift` is the relative change of the stiffness in `drift_s`.
    `tolerance` is the largest residual force over the weight of the bar.
    """

    def __init__(
        self,
        length_m: float,
        width_m: Sequence[float],
        truth: Mapping[str, float],
        divisions: tuple[int, int, int],
        *,
        start_m: float = 0.0,
        taper: Sequence[float] = (0.0, 0.0),
        scale: float = 1.0,
        density_gradient: Sequence[float] = (0.0, 0.0, 0.0),
        stiffness_gradient: Sequence[float] = (0.0, 0.0, 0.0),
        drift: float = 0.0,
        drift_s: float = 1.0,
        tolerance: float = 1e-6,
    ) -> None:
        self.truth = truth
        self.tolerance = tolerance
        self.divisions = divisions
        self.drift, self.drift_s = drift, drift_s
        young, poisson = truth["young_pa"], truth["poisson"]
        self.mu = young / 2 / (1 + poisson)
        self.lam = 2 * self.mu * poisson / (1 - 2 * poisson)
        self.damping_s = truth["gamma_r_s"]
        self.damping_1_s = truth["gamma_m_1_s"]
        # Nodes in layers along z; unit coordinates x, y in −1 … 1 and z in 0 … 1.
        nx, ny, nz = divisions
        axes = [np.linspace(-1, 1, 2 * nx + 1), np.linspace(-1, 1, 2 * ny + 1)]
        z = start_m / length_m + (1 - start_m / length_m) * np.linspace(0, 1, 2 * nz + 1)
        grid = np.stack(np.meshgrid(z, *axes, indexing="ij"), axis=-1).reshape(-1, 3)
        self.unit = grid[:, [1, 2, 0]]
        half = 0.5 * np.asarray(width_m) * (1 - self.unit[:, 2:] * np.asarray(taper))
        self.nodes_m = scale * np.column_stack(
            [self.unit[:, :2] * half, length_m * self.unit[:, 2]]
        )
        self.first_z = z[0]
        self.cells = self._cells()
        self._quadrature(np.asarray(density_gradient), np.asarray(stiffness_gradient))
        self.held = np.arange(3 * (2 * nx + 1) * (2 * ny + 1))
        self.free = np.arange(len(self.held), self.nodes_m.size)

    def _cells(self) -> Array:
        nx, ny, nz = self.divisions
        sizes = (2 * nz + 1, 2 * nx + 1, 2 * ny + 1)
        numbers = np.arange(np.prod(sizes)).reshape(sizes)
        cells = [
            numbers[2 * k : 2 * k + 3, 2 * i : 2 * i + 3, 2 * j : 2 * j + 3]
            .transpose(1, 2, 0)
            .ravel()
            for k in range(nz)
            for i in range(nx)
            for j in range(ny)
        ]
        return np.array(cells)

    def _quadrature(self, density_gradient: Array, stiffness_gradient: Array) -> None:
        points, weights = np.polynomial.legendre.leggauss(3)
        xi = np.stack(np.meshgrid(points, points, points, indexing="ij"), axis=-1).reshape(-1, 3)
        weight = np.einsum("i,j,k->ijk", weights, weights, weights).ravel()
        values, derivatives = shape_functions(xi)
        corners = self.nodes_m[self.cells]  # (E, 27, 3)
        jacobian = np.einsum("qad,eac->eqcd", derivatives, corners)
        inverse = np.linalg.inv(jacobian)
        gradient = np.einsum("qad,eqdc->eqac", derivatives, inverse)  # ∂N/∂X (E, Q, 27, 3)
        self.volume = np.linalg.det(jacobian) * weight  # (E, Q)
        count = self.volume.shape
        # F − I of the displacements u (E, 3, 27) is u @ gradient, for all points of an element.
        self.gradient = np.ascontiguousarray(gradient.transpose(0, 2, 1, 3)).reshape(
            count[0], 27, -1
        )
        # The same as a matrix (E, Q, 9, 81) for the tangent, F row-major.
        b = np.zeros((*count, 3, 3, 27, 3))
        for i in range(3):
            b[:, :, i, :, :, i] = gradient.transpose(0, 1, 3, 2)
        self.b = b.reshape(*count, 9, 81)
        self.b_flat = self.b.reshape(count[0], -1, 81)
        places = np.einsum("qa,eac->eqc", values, corners)
        middle = np.einsum("eqc,eq->c", places, self.volume) / self.volume.sum()
        reach = np.abs(self.nodes_m - middle).max(axis=0)
        relative = (places - middle) / reach
        self.stiffness = 1 + relative @ stiffness_gradient
        density = self.truth["density_kg_m3"] * (1 + relative @ density_gradient)
        mass = np.einsum("qa,qb,eq->eab", values, values, density * self.volume)
        dofs = 3 * self.cells[:, :, None] + np.arange(3)
        self.dofs = dofs.reshape(len(self.cells), 81)
        rows = np.repeat(self.dofs, 81, axis=1).ravel()
        columns = np.tile(self.dofs, (1, 81)).ravel()
        size = self.nodes_m.size
        # Places of the entries of element matrices in the lower band of the free dofs.
        self.band = int((rows - columns).max()) + 1
        first = 3 * (2 * self.divisions[0] + 1) * (2 * self.divisions[1] + 1)
        self.in_band = (rows >= columns) & (columns >= first)
        self.band_places = ((rows - columns) * (size - first) + columns - first)[self.in_band]
        self.element_mass = np.einsum("eab,ij->eaibj", mass, np.eye(3)).reshape(len(mass), 81, 81)
        entries = (self.element_mass.ravel(), (rows, columns))
        self.mass = csr_array(coo_array(entries, shape=(size, size)))
        self.mass_kg = float(density.ravel() @ self.volume.ravel())

    def factorise(self, matrices: Array) -> tuple[Array, bool]:
        """Return the Cholesky factor of the free dofs from element matrices (E, 81, 81)."""
        size = len(self.free)
        entries = matrices.ravel()[self.in_band]
        band = np.bincount(self.band_places, entries, minlength=self.band * size)
        return cholesky_banded(band.reshape(self.band, size), lower=True), True

    def interpolation(self, places: Sequence[Sequence[float]]) -> Array:
        """Return the weights (M, n) of the nodes at unit places (x, y in −1 … 1, z in 0 … 1)."""
        weights = np.zeros((len(places), len(self.nodes_m)))
        nx, ny, nz = self.divisions
        for row, (x, y, z) in zip(weights, places, strict=True):
            parameters = np.array(
                [(x + 1) / 2 * nx, (y + 1) / 2 * ny, (z - self.first_z) / (1 - self.first_z) * nz]
            )
            cell = np.clip(parameters.astype(int), 0, np.array(self.divisions) - 1)
            values, _ = shape_functions(2 * (parameters - cell)[None] - 1)
            row[self.cells[(cell[2] * nx + cell[0]) * ny + cell[1]]] = values[0]
        return weights

    def _deformation(self, x: Array) -> Array:
        return self._gradient_of(x.reshape(-1, 3) - self.nodes_m) + np.eye(3)

    def _gradient_of(self, u: Array) -> Array:
        """Return the gradient (E, Q, 3, 3) of a field (n, 3)."""
        values = u[self.cells].transpose(0, 2, 1) @ self.gradient
        return values.reshape(len(values), 3, -1, 3).transpose(0, 2, 1, 3)

    def force(self, x: Array, v: Array, t_s: float) -> Array:
        """Return the internal forces (3n,) of elasticity and Kelvin–Voigt damping [N]."""
        f = self._deformation(x)
        rate = self._gradient_of(v.reshape(-1, 3))
        g, log_j = inverse_transpose(f)
        stretching = rate @ np.swapaxes(g, -1, -2)
        stretching = stretching + np.swapaxes(stretching, -1, -2)
        trace = np.trace(stretching, axis1=-2, axis2=-1)[..., None, None] / 2
        viscous = self.damping_s * (self.mu * stretching + self.lam * trace * np.eye(3))
        stress = self.mu * (f - g) + self.lam * log_j * g + viscous @ g
        stress = stress * (self.factor(t_s) * self.stiffness * self.volume)[..., None, None]
        flat = stress.transpose(0, 2, 1, 3).reshape(len(f), 3, -1)
        nodal = self.gradient @ flat.transpose(0, 2, 1)
        return np.bincount(self.dofs.ravel(), nodal.ravel(), minlength=self.nodes_m.size)

    def factor(self, t_s: float) -> float:
        """Return the factor of the stiffness at a time."""
        return 1 + self.drift * (t_s / self.drift_s - 0.5)

    def tangent(self, x: Array, rate_factor: float) -> Array:
        """Return ∂force/∂x + rate_factor ∂force/∂v of the elements (E, 81, 81), without the change
        of the damping with x.
        """
        f = self._deformation(x)
        g, log_j = inverse_transpose(f)
        eta, zeta = (rate_factor * self.damping_s * c for c in (self.mu, self.lam))
        one = np.eye(3)
        direct = g[..., :, :, None, None] * g[..., None, None, :, :]  # G_iJ G_kL
        crossed = direct.swapaxes(-3, -1)  # G_iL G_kJ
        a = (self.mu - self.lam * log_j[..., None, None] + eta) * crossed
        a += (self.lam + zeta) * direct
        a += self.mu * np.einsum("ik,JL->iJkL", one, one)
        if eta:
            a += eta * np.einsum("ik,...JL->...iJkL", one, np.swapaxes(g, -1, -2) @ g)
        a = a.reshape(*f.shape[:2], 9, 9) * (self.stiffness * self.volume)[..., None, None]
        product = np.matmul(a, self.b).reshape(self.b_flat.shape)
        return np.matmul(self.b_flat.transpose(0, 2, 1), product)

    def equilibrium(self, start: Rotation, place_m: Array, gravity: Array) -> Array:
        """Return the static positions (3n,) [m] of the held bar, by Newton's method in load steps."""
        x = (start.apply(self.nodes_m) + place_m).ravel()
        weight = self.mass @ np.tile(gravity, len(self.nodes_m))
        free, rest = self.free, np.zeros_like(x)
        for share in np.linspace(0.125, 1.0, 8):
            for _ in range(MOST_ITERATIONS):
                residual = (share * weight - self.force(x, rest, 0.0))[free]
                if np.abs(residual).max() < self.tolerance * 9.81 * self.mass_kg:
                    break
                factor = self.factorise(self.factor(0.0) * self.tangent(x, 0.0))
                x[free] += cho_solve_banded(factor, residual)
            else:
                raise RuntimeError("no equilibrium")
        return x

    def simulate(
        self,
        t_s: Array,
        motion: Callable[[Array], tuple[Rotation, Array]],
        gravity: Array,
        weights: Array,
        *,
        push_m_s: Array | None = None,
    ) -> Array:
        """Return the positions (T, M, 3) [m] of points from equilibrium on, at equal time steps.

        `motion` returns rotations and positions of the held end at times, `weights` (M, n) are
        those of `interpolation`, and `push_m_s` (n, 3) are velocities at the start.
        """
        h = float(t_s[1] - t_s[0])
        am, af = (2 * RADIUS - 1) / (RADIUS + 1), RADIUS / (RADIUS + 1)
        gamma, beta = 0.5 - am + af, 0.25 * (1 - am + af) ** 2
        rotations, held_x, held_v, held_a = self._held_motion(t_s, motion)
        x = self.equilibrium(rotations[0], motion(t_s[:1])[1][0], gravity)
        v, a = np.zeros_like(x), np.zeros_like(x)
        if push_m_s is not None:
            v[self.free] = push_m_s.ravel()[self.free]
        weight = self.mass @ np.tile(gravity, len(self.nodes_m))
        free, held = self.free, self.held
        if push_m_s is not None:
            net = weight - self.force(x, v, 0.0) - self.damping_1_s * (self.mass @ v)
            a[free] = cho_solve_banded(self.factorise(self.element_mass), net[free])
        factored: Any = None
        recorded = [weights @ x.reshape(-1, 3)]
        for step in range(1, len(t_s)):
            new_a = a.copy()
            new_a[held] = held_a[step]
            new_x = x + h * v + h**2 * ((0.5 - beta) * a + beta * new_a)
            new_v = v + h * ((1 - gamma) * a + gamma * new_a)
            new_x[held], new_v[held] = held_x[step], held_v[step]
            t_middle = (1 - af) * t_s[step] + af * t_s[step - 1]
            last = np.inf
            for _ in range(MOST_ITERATIONS):
                middle_x = (1 - af) * new_x + af * x
                middle_v = (1 - af) * new_v + af * v
                inertia = self.mass @ ((1 - am) * new_a + am * a + self.damping_1_s * middle_v)
                residual = (weight - inertia - self.force(middle_x, middle_v, t_middle))[free]
                size = np.abs(residual).max() / (9.81 * self.mass_kg)
                if size < self.tolerance:
                    break
                if factored is None or size > SLOW * last:
                    matrix = self.tangent(middle_x, gamma / (beta * h)) * (1 - af)
                    inertial = (1 - am) / (beta * h**2)
                    inertial += (1 - af) * gamma / (beta * h) * self.damping_1_s
                    factor = self.factorise(matrix + inertial * self.element_mass)
                    factored = factor, rotations[step]
                last = size
                factor, frame = factored
                turn = (rotations[step] * frame.inv()).as_matrix()
                dx = cho_solve_banded(factor, (residual.reshape(-1, 3) @ turn).ravel())
                dx = (dx.reshape(-1, 3) @ turn.T).ravel()
                new_x[free] += dx
                new_v[free] += gamma / (beta * h) * dx
                new_a[free] += dx / (beta * h**2)
            else:
                raise RuntimeError(f"no convergence at {t_s[step]:.4g} s")
            x, v, a = new_x, new_v, new_a
            recorded.append(weights @ x.reshape(-1, 3))
        return np.array(recorded)

    def _held_motion(
        self, t_s: Array, motion: Callable[[Array], tuple[Rotation, Array]]
    ) -> tuple[Rotation, Array, Array, Array]:
        """Return rotations, and positions, velocities and accelerations (T, h) of the held dofs."""
        points = self.nodes_m.ravel()[self.held].reshape(-1, 3)
        small_s = 1e-3

        def positions(times: Array) -> Array:
            rotations, places_m = motion(times)
            matrices = rotations.as_matrix()
            return (points @ matrices.transpose(0, 2, 1) + places_m[:, None]).reshape(
                len(times), -1
            )

        before, now, after = (positions(t_s + shift) for shift in (-small_s, 0.0, small_s))
        rotations, _ = motion(t_s)
        speed = (after - before) / (2 * small_s)
        return rotations, now, speed, (after - 2 * now + before) / small_s**2


def _beam_check() -> None:
    """Print sag, frequency and decay of a slender cantilever beside those of beam theory."""
    truth = {
        "young_pa": 20e3,
        "poisson": 0.0,
        "gamma_r_s": 2e-3,
        "gamma_m_1_s": 0.5,
        "density_kg_m3": 100.0,
    }
    length, width = 0.12, 0.008
    bar = Bar(length, (width, width), truth, (1, 1, 12), tolerance=1e-11)
    tip = bar.interpolation([[0.0, 0.0, 1.0]])

    def still(t_s: Array) -> tuple[Rotation, Array]:
        return Rotation.from_quat(np.tile([0, 0, 0, 1.0], (len(t_s), 1))), np.zeros((len(t_s), 3))

    gravity = np.array([1e-3, 0.0, 0.0])
    x = bar.equilibrium(Rotation.identity(), np.zeros(3), gravity)
    sag = float((tip @ x.reshape(-1, 3))[0, 0])
    inertia, area = width**4 / 12, width**2
    bending, line_mass = truth["young_pa"] * inertia, truth["density_kg_m3"] * area
    shear = 0.5 * line_mass * 1e-3 * length**2 / (5 / 6 * bar.mu * area)
    print(
        f"sag: {sag:.5g} m, beam theory {line_mass * 1e-3 * length**4 / 8 / bending + shear:.5g} m"
    )
    beta = 1.8751040687 / length
    omega = beta**2 * np.sqrt(bending / line_mass)
    z = beta * bar.nodes_m[:, 2]
    ratio = (np.sinh(1.8751) - np.sin(1.8751)) / (np.cosh(1.8751) + np.cos(1.8751))
    mode = np.cosh(z) - np.cos(z) - ratio * (np.sinh(z) - np.sin(z))
    push = np.zeros((len(z), 3))
    push[:, 0] = 1e-5 * mode
    t_s = 0.0025 * np.arange(1201)
    u = bar.simulate(t_s, still, np.zeros(3), tip, push_m_s=push)[:, 0, 0]
    crossings = np.flatnonzero(np.diff(np.signbit(u)))
    zeros = t_s[crossings] - u[crossings] * 0.0025 / (u[crossings + 1] - u[crossings])
    zeros = zeros[2:]
    found = np.pi * (len(zeros) - 1) / (zeros[-1] - zeros[0])
    extremes = np.flatnonzero(np.diff(np.signbit(np.diff(u)))) + 1
    rate, _ = np.polyfit(t_s[extremes[1:]], np.log(np.abs(u[extremes[1:]])), 1)
    decay = truth["gamma_r_s"] * omega**2 / 2 + truth["gamma_m_1_s"] / 2
    print(f"angular frequency: {found:.5g} rad/s, beam theory {omega:.5g} rad/s")
    print(f"rate of decay: {-rate:.4g} 1/s, beam theory {decay:.4g} 1/s")


if __name__ == "__main__":
    make_parser(__doc__).parse_args()
    _beam_check()
