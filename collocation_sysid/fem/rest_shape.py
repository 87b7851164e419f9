"""Stress-free shape of a body whose mesh was made while it hung or stood under its own weight.

Use `UnderGravity` to state the conditions of the scan; `InverseEquilibrium` computes the shape. The
mesh Y is then an equilibrium shape. The stress-free positions X of its nodes are the solution of
the inverse equilibrium (Govindjee & Mihalic 1996)

    f(Y; X, θ) + M(θ) g = 0 at free nodes,   X = Y at the nodes that were held,

with the elastic force f = −∂Ψ/∂x, the gravity g in the axes of the mesh, and the masses M of the
mesh: mass is conserved. X depends on the elastic constants and on free densities. By the implicit
function theorem, with the residual r, ∂X/∂θ = −(∂r/∂X)⁻¹ ∂r/∂θ.

The kernels keep Y as the reference configuration of the computation. With G = ∂X/∂Y at a quadrature
point, the deformation gradient of the material is F = (∂x/∂Y) G⁻¹ and the volume of the point V det
G, see `RestPointLayout`. G and its derivatives by θ are data of the points, so that forces and all
their derivatives are those of the complete model in every method.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import casadi as ca
import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike
from scipy.sparse.linalg import splu

from ..common.array_types import Array, Index
from ..common.checked_arrays import float_array
from ..common.validated_classes import validated
from ..errors import InputError, SimulationError
from .laws.materials import Material
from .meshes.mesh import ElementNodes
from .meshes.selection import Selection
from .regions import BodyPart
from .rest_point_layout import RestPointLayout

# Relative step of the differences of ∂X/∂θ that give ∂²X/∂θ²: the cube root of the rounding error.
RELATIVE_DIFFERENCE_STEP = 1e-5
# Largest accepted gravity of a scan [m/s²]: larger values are mistakes of units, such as mm/s².
LARGEST_GRAVITY_M_S2 = 1e4
# Largest relative change of a constant for which Newton's method starts from the latest solution.
LARGEST_EXTRAPOLATION = 0.2


@dataclass(frozen=True)
class InverseOptions:
    """Limits of Newton's method for the inverse equilibrium."""

    # Largest entry of the last Newton step divided by the size of the body. Convergence is
    # quadratic, so the next step would be at the rounding error.
    tolerance: float = 1e-9
    iterations: int = 15  # Newton steps for one share of the weight
    halvings: int = 6  # how often a step is halved, and how often the increment of the weight
    load_steps: int = 25  # attempts with a share of the weight
    # Smallest det G of an admissible iterate; elements are inverted at zero.
    least_volume_ratio: float = 0.02


OPTIONS = InverseOptions()


class RestShapeError(SimulationError):
    """Error: no stress-free shape was found whose equilibrium under gravity is the mesh.

    Parameters
    ----------
    message : str
        What failed and what to change.
    """

    def __init__(self, message: str) -> None:
        super().__init__(message, 0.0)
        self.args = (message,)

    def __str__(self) -> str:
        return self.message

    def __reduce__(self) -> tuple[type[RestShapeError], tuple[str]]:  # type: ignore[override]
        return type(self), (self.message,)


@validated
@dataclass(frozen=True, eq=False)
class UnderGravity:
    """Conditions of a scan under gravity: the mesh is the equilibrium shape.

    Parameters
    ----------
    nodes : Selection or (k,) node indices
        Nodes that were held, such as those in a clamp or on a table; checked by `grasped_nodes`.
    gravity_m_s2 : (3,) array, default (0, 0, -9.81)
        Gravity in the axes of the mesh; its direction states the pose of the scan. Stored as a
        read-only copy.

    Raises
    ------
    InputError
        If gravity is not three finite numbers, or is zero or larger than 10⁴ m/s².
    """

    nodes: Selection | ArrayLike
    gravity_m_s2: ArrayLike = (0.0, 0.0, -9.81)

    def __post_init__(self) -> None:
        try:
            gravity = float_array(self.gravity_m_s2, "gravity_m_s2", (3,))
        except InputError:
            gravity = np.zeros(0)
        valid = gravity.shape == (3,) and bool(np.isfinite(gravity).all())
        if not valid or not 0 < np.linalg.norm(gravity) <= LARGEST_GRAVITY_M_S2:
            raise InputError(
                f"found {self.gravity_m_s2!r}; expected the gravity of the scan [x, y, z] in the "
                f"axes of the mesh, not zero and at most {LARGEST_GRAVITY_M_S2:g} m/s²; if the "
                'mesh is free of stress, state rest_shape = "stress_free"',
                where="scan.gravity_m_s2",
            )
        gravity.setflags(write=False)
        object.__setattr__(self, "gravity_m_s2", gravity)

    def grasped_nodes(self, nodes: ElementNodes) -> Index:
        """Return the indices of the held nodes, sorted.

        Raises
        ------
        InputError
            If there are none, if a node does not exist, or if the held nodes lie on one line.
        """
        if isinstance(self.nodes, Selection):
            chosen = self.nodes.resolve(nodes)
        else:
            chosen = np.unique(np.asarray(self.nodes, dtype=np.int64))
        count = len(nodes.points_m)
        if not chosen.size or chosen[0] < 0 or chosen[-1] >= count:
            found = f"node indices from {chosen[0]} to {chosen[-1]}" if chosen.size else "no nodes"
            raise InputError(
                f"found {found}; expected the nodes that were held during the scan, with indices "
                f"from 0 to {count - 1}",
                where="scan.nodes",
            )
        points_m = nodes.points_m[chosen]
        spread = np.linalg.svd(points_m - points_m.mean(axis=0), compute_uv=False)
        if len(spread) < 2 or spread[1] <= 1e-9 * max(spread[0], 1e-300):
            raise InputError(
                f"found {chosen.size} nodes on one line, about which the body could turn; expected "
                "all nodes that were held during the scan, three or more",
                where="scan.nodes",
            )
        return chosen


@dataclass(frozen=True, eq=False)
class RestShape:
    """Stress-free positions at one θ, with derivatives."""

    positions_m: Array  # (n, 3): positions X
    by_input: Array  # (k, n, 3): derivatives of X by each input


@lru_cache(32)
def _point_stress(material: Material, averages: bool, slopes: bool) -> ca.Function:
    """Return the function of the Kirchhoff stress per volume of the mesh at a point.

    Inputs: G (9,), column after column; the mean m of det G over the element; the constants (c,) of
    the material. With F = G⁻¹, or F = (det G / m)^⅓ G⁻¹ if the element averages the dilatation, the
    stress is det G · ∂ψ/∂F Fᵀ (9,). If `slopes`, the derivatives by G (9, 9), by m (9,) and by θ
    (9, c) follow.
    """
    gradient = ca.SX.sym("G", 9)
    mean = ca.SX.sym("mean")
    theta = ca.SX.sym("theta", len(material.constants))
    strain = ca.SX.sym("F", 9)
    G = ca.reshape(gradient, 3, 3)
    F = ca.inv_minor(G)
    if averages:
        F = (ca.det(G) / mean) ** (1 / 3) * F
    piola = ca.gradient(material.psi(ca.reshape(strain, 3, 3), theta), strain)
    piola = ca.reshape(ca.substitute(piola, strain, ca.vec(F)), 3, 3)
    stress = ca.vec(ca.det(G) * piola @ F.T)
    outputs = [stress]
    if slopes:
        outputs += [ca.jacobian(stress, each) for each in (gradient, mean, theta)]
    dense = [ca.densify(output) for output in outputs]
    return ca.Function("inverse_stress", [gradient, mean, theta], dense, {"cse": True})


@dataclass(frozen=True, eq=False)
class _PartForces:
    """Elastic forces of the cells of one part at the mesh, with derivatives."""

    dofs: Index  # (E, d): dofs of the cells
    force_n: Array  # (E, d): elastic forces
    # (E, d, d): derivatives by X, with rows of the force; empty without derivatives.
    by_position: Array
    # (E, d, c): derivatives by the constants of the material; empty without derivatives.
    by_theta: Array


def _part_forces(
    cells: Index,
    geometry: Array,
    positions_m: Array,
    constants: Array,
    *,
    material: Material,
    averages: bool,
    slopes: bool,
) -> _PartForces:
    """Return the elastic forces of cells at the mesh, with stress-free positions X (n, 3)."""
    count, points = geometry.shape[:2]
    shape_slopes = geometry[..., :-1].reshape(count, points, -1, 3)
    volumes = geometry[..., -1]
    shares = volumes / volumes.sum(axis=1)[:, None]
    # (E, q, column, row) of G.
    G = np.einsum("ean,eqai->eqin", positions_m[cells], shape_slopes)
    ratios = np.linalg.det(G)
    mean = np.einsum("eq,eq->e", shares, ratios)
    point_gradients = G.reshape(count * points, 9).T
    function = _point_stress(material, averages, slopes=slopes)
    outputs = function(point_gradients, np.repeat(mean, points)[None], constants)
    outputs = [np.array(each) for each in (outputs if slopes else [outputs])]
    stress = outputs[0].T.reshape(count, points, 3, 3)
    size = 3 * cells.shape[1]
    dofs = (3 * cells[:, :, None] + np.arange(3)).reshape(count, size)
    if averages:
        _average_pressure(stress[..., None], shares)
    force = -np.einsum("eq,eqaj,eqji->eai", volumes, shape_slopes, stress).reshape(count, size)
    if not slopes:
        empty = np.zeros((0, size, 0))
        return _PartForces(dofs, force, by_position=empty, by_theta=empty)
    by_G = outputs[1].reshape(9, count, points, 9).transpose(1, 2, 0, 3)
    by_G = by_G.reshape(count, points, 3, 3, 3, 3)
    by_X = np.einsum("eqjilk,eqbl->eqjibk", by_G, shape_slopes, optimize=True)
    by_theta = outputs[3].reshape(9, count, points, -1).transpose(1, 2, 0, 3)
    by_theta = by_theta.reshape(count, points, 3, 3, -1)
    by_X = by_X.reshape(count, points, 3, 3, size)
    if averages:
        weights = shares * ratios
        mean_by_X = np.einsum("eq,eqkl,eqbl->ebk", weights, np.linalg.inv(G), shape_slopes)
        by_mean = outputs[2].T.reshape(count, points, 3, 3)
        by_X = by_X + by_mean[..., None] * mean_by_X.reshape(count, 1, 1, 1, size)
        _average_pressure(by_X, shares)
        _average_pressure(by_theta, shares)
    weighted_slopes = -volumes[..., None, None] * shape_slopes
    matrices = np.einsum("eqaj,eqjim->eaim", weighted_slopes, by_X, optimize=True)
    columns = np.einsum("eqaj,eqjic->eaic", weighted_slopes, by_theta, optimize=True)
    return _PartForces(
        dofs,
        force,
        by_position=matrices.reshape(count, size, size),
        by_theta=columns.reshape(count, size, -1),
    )


def _average_pressure(stress: Array, shares: Array) -> None:
    """Replace the pressure of stresses (E, q, 3, 3, any) by its mean over the cell, in place."""
    pressure = np.einsum("eqiim->eqm", stress) / 3
    change = np.einsum("eq,eqm->em", shares, pressure)[:, None] - pressure
    for axis in range(3):
        stress[:, :, axis, axis] += change


@dataclass(frozen=True, eq=False)
class _AssembledForces:
    force_n: Array  # (3n,)
    by_position: sp.csc_array  # (3n, 3n) sparse: derivatives by X
    by_theta: Array  # (3n, k): derivatives by the inputs


class InverseEquilibrium:
    """Solver of the inverse equilibrium of a body, with a cache of the latest solutions.

    Parameters
    ----------
    body : Body
        Body with `scan_conditions`. (`body` imports this module, hence no annotation.)

    Attributes
    ----------
    points_m : (n, 3)
        Node positions of the mesh, without those of obstacle frames.
    gravity_m_s2 : (3,)
        Gravity of the scan.
    free : array of int
        Dofs of the nodes that were not held.
    places : (k,)
        Indices in θ of the inputs on which the stress-free shape depends: elastic constants, then
        free densities.

    Raises
    ------
    InputError
        If the held nodes of the scan do not exist or lie on one line.
    """

    def __init__(self, body: Any) -> None:
        self.body = body
        self.points_m: Array = body.nodes.points_m
        self.gravity_m_s2 = np.asarray(body.scan_conditions.gravity_m_s2, dtype=float)
        size = self.points_m.size
        grasped_nodes = body.scan_conditions.grasped_nodes(body.nodes)
        self.free: Index = np.setdiff1d(
            np.arange(size), (3 * grasped_nodes[:, None] + np.arange(3)).ravel()
        )
        self.places: Index = np.array(
            [*body.elastic_indices, *body.density_indices], dtype=np.int64
        )
        self.layout = RestPointLayout(len(self.places), body.element.mean_dilatation)
        self._shapes: dict[bytes, RestShape] = {}
        self._data: dict[tuple[bytes, bool], list[Array]] = {}
        self._size_m = float(np.linalg.norm(np.ptp(self.points_m, axis=0)))

    def solve(self, theta: ArrayLike) -> RestShape:
        """Return the stress-free shape at θ (all constants of the body), with its derivatives by
        the inputs; the latest 16 are cached.

        Newton's method starts from the latest solution if that is near, then from the mesh: where
        several shapes exist, the result can depend on earlier calls.

        Raises
        ------
        RestShapeError
            If there is none near the mesh.
        """
        constants = np.asarray(theta, dtype=float)
        key = constants[self.places].tobytes()
        if key not in self._shapes:
            solution = self._solve(constants)
            while len(self._shapes) >= 16:
                self._shapes.pop(next(iter(self._shapes)), None)
            self._shapes[key] = solution
        return self._shapes[key]

    def second_derivatives(self, theta: ArrayLike) -> Array:
        """Return the second derivatives of X by the pairs of inputs of the layout, (pairs, n, 3).

        They are central differences of ∂X, from two solutions for each input.

        Raises
        ------
        RestShapeError
            If there is no stress-free shape at θ or nearby.
        """
        constants = np.asarray(theta, dtype=float)
        columns = []
        for place in self.places:
            step = RELATIVE_DIFFERENCE_STEP * max(abs(float(constants[place])), 1e-12)
            ends = []
            for offset in (step, -step):
                shifted = constants.copy()
                shifted[place] += offset
                ends.append(self.solve(shifted).by_input)
            columns.append((ends[0] - ends[1]) / (2 * step))
        pairs = [(columns[j][i] + columns[i][j]) / 2 for i, j in self.layout.input_pairs]
        return np.array(pairs).reshape(-1, *self.points_m.shape)

    def point_data(self, theta: ArrayLike, with_second_derivatives: bool = False) -> list[Array]:
        """Return the data of the points of each part of the body, (1, cells · q · count) each, see
        `RestPointLayout`. The latest two results are cached; do not modify them.

        Parameters
        ----------
        theta : (k,)
            All constants of the body.
        with_second_derivatives : bool
            Whether to include second derivatives; they are zero otherwise.

        Raises
        ------
        RestShapeError
            If there is no stress-free shape at θ.
        """
        key = (np.asarray(theta, dtype=float)[self.places].tobytes(), with_second_derivatives)
        if key not in self._data:
            shape = self.solve(theta)
            fields = [shape.positions_m, *shape.by_input]
            if with_second_derivatives:
                fields += [*self.second_derivatives(theta)]
            else:
                fields += [np.zeros_like(self.points_m)] * len(self.layout.input_pairs)
            while len(self._data) >= 2:
                self._data.pop(next(iter(self._data)), None)
            self._data[key] = self._fields_at_points(fields)
        return self._data[key]

    def point_data_columns(self, part: int) -> Index:
        """Return the columns (E, q, `layout.count`) of the data of each point in a row of
        `point_data`, for the part of this index.
        """
        count, points = self._parts[part][1].shape[:2]
        size = self.layout.value_count
        return np.arange(count * points * size).reshape(count, points, size)

    def weight_sensitivity(self, theta: ArrayLike) -> Array:
        """Return the change (n, 3) of X [m] per relative change of gravity, to first order.

        Raises
        ------
        RestShapeError
            If no stress-free shape is found at the constants θ, or its equations are singular.
        """
        constants = np.asarray(theta, dtype=float)
        at = self._assemble_forces(self.solve(constants).positions_m, constants, slopes=True)
        factor = self._factorise(at.by_position)
        if factor is None:
            raise RestShapeError(self._failure_message(constants, 1.0))
        return self._newton_step(factor, self._weight_n(constants))

    def _fields_at_points(self, fields: Sequence[Array]) -> list[Array]:
        """Return G and its derivatives at the points of each part."""
        layout = self.layout
        data = []
        for cells, geometry in self._parts:
            slopes = geometry[..., :-1].reshape(*geometry.shape[:2], -1, 3)
            # (cells, q, columns of G, rows of G): column after column.
            columns = [np.einsum("ean,eqai->eqin", f[cells], slopes) for f in fields]
            values = np.stack([c.reshape(*c.shape[:2], 9) for c in columns], axis=2)
            if layout.averages_dilatation:
                values = np.concatenate([values, self._volume_logarithms(values, geometry)], axis=3)
            data.append(np.ascontiguousarray(values).reshape(1, -1))
        return data

    def _volume_logarithms(self, values: Array, geometry: Array) -> Array:
        """Return ρ of each point with derivatives (E, q, 1 + k + pairs, 1)."""
        layout = self.layout
        shares = geometry[..., -1] / geometry[..., -1].sum(axis=1)[:, None]
        matrices = values.reshape(*values.shape[:3], 3, 3)
        inverse = np.linalg.inv(matrices[:, :, 0])
        ratios = np.linalg.det(matrices[:, :, 0])
        # The determinants d with derivatives: d_i = d tr A_i, d_ij = d (tr A_i tr A_j − tr A_i A_j
        # + tr A_ij), with A = G⁻¹ ∂G.
        relative = np.einsum("eqab,eqkbc->eqkac", inverse, matrices[:, :, 1:])
        traces = np.trace(relative, axis1=3, axis2=4)
        k = layout.input_count
        first = ratios[..., None] * traces[..., :k]
        second = [
            ratios
            * (
                traces[..., i] * traces[..., j]
                - np.einsum("eqab,eqba->eq", relative[:, :, i], relative[:, :, j])
                + traces[..., k + number]
            )
            for number, (i, j) in enumerate(layout.input_pairs)
        ]
        determinants = np.concatenate(
            [ratios[..., None], first, np.stack(second, axis=-1)], axis=-1
        )
        mean = np.broadcast_to(
            np.einsum("eq,eqk->ek", shares, determinants)[:, None], determinants.shape
        )
        return (self._logarithm(determinants) - self._logarithm(mean))[..., None]

    def _logarithm(self, values: Array) -> Array:
        """Return the logarithm of numbers with two derivatives (…, 1 + k + pairs)."""
        k = self.layout.input_count
        logarithm = np.empty_like(values)
        logarithm[..., 0] = np.log(values[..., 0])
        logarithm[..., 1 : k + 1] = values[..., 1 : k + 1] / values[..., :1]
        for number, (i, j) in enumerate(self.layout.input_pairs):
            column = k + 1 + number
            product = logarithm[..., 1 + i] * logarithm[..., 1 + j]
            logarithm[..., column] = values[..., column] / values[..., 0] - product
        return logarithm

    @cached_property
    def _parts(self) -> list[tuple[Index, Array]]:
        """Cells and geometry of each part, with nodes in the order of its kernels."""
        return [self.body.part_elements(part) for part in self.body.parts]

    # Newton's method ------------------------------------------------------------------------

    def _solve(self, theta: Array) -> RestShape:
        """Return the shape at θ, from the latest solution or, if that fails, the mesh."""
        weight = self._weight_n(theta)
        start = self._predict(theta)
        x = None if start is None else self._newton(start, theta, weight_n=weight)
        if x is None:
            x = self._solve_with_load_steps(theta, weight)
        force = self._assemble_forces(x, theta, slopes=True)
        by_theta = force.by_theta
        for column, slope in self.body.mass_derivatives.items():
            place = self.places.tolist().index(column)
            gravity = np.tile(self.gravity_m_s2, len(self.points_m))
            by_theta[:, place] += slope[: self.points_m.size] * gravity
        factor = self._factorise(force.by_position)
        if factor is None:
            raise RestShapeError(self._failure_message(theta, 1.0))
        by_input = np.zeros((len(self.places), self.points_m.size))
        by_input[:, self.free] = -factor.solve(by_theta[self.free]).T
        return RestShape(x, by_input.reshape(-1, *self.points_m.shape))

    def _predict(self, theta: Array) -> Array | None:
        """X (n, 3) [m] at θ to first order from the latest solution; None if too far."""
        if not self._shapes:
            return None
        key, shape = next(reversed(self._shapes.items()))
        known = np.frombuffer(key)
        target = theta[self.places]
        change = target - known
        if (np.abs(change) > LARGEST_EXTRAPOLATION * np.abs(known)).any():
            return None
        predicted = shape.positions_m + np.tensordot(change, shape.by_input, axes=1)
        return predicted if self._is_admissible(predicted) else None

    def _solve_with_load_steps(self, theta: Array, weight_n: Array) -> Array:
        """Return X, solved from the mesh under shares of the weight that grow to one."""
        x = self.points_m.copy()
        share_reached = 0.0
        step = 1.0
        for _ in range(OPTIONS.load_steps):
            share = min(1.0, share_reached + step)
            solution = self._newton(x, theta, weight_n=share * weight_n)
            if solution is None:
                step /= 2
                if step < 0.5**OPTIONS.halvings:
                    break
                continue
            x = solution
            share_reached = share
            if share_reached == 1.0:
                return x
        raise RestShapeError(self._failure_message(theta, share_reached))

    def _weight_n(self, theta: Array) -> Array:
        """Return the weight (3n,) of every dof [N]."""
        mass_kg = self.body.mass_of_dofs(theta)[: self.points_m.size]
        return mass_kg * np.tile(self.gravity_m_s2, len(self.points_m))

    def _newton(self, start: Array, theta: Array, weight_n: Array) -> Array | None:
        """Return X (n, 3) [m] at a weight (3n,) [N], from `start`; None without convergence."""
        x = start.copy()
        for _ in range(OPTIONS.iterations):
            at = self._assemble_forces(x, theta, slopes=True)
            factor = self._factorise(at.by_position)
            if factor is None:
                return None
            step = self._newton_step(factor, at.force_n + weight_n)
            length = float(np.linalg.norm(step))
            if not np.isfinite(length):
                return None
            if np.abs(step).max() <= OPTIONS.tolerance * self._size_m:
                # Quadratic convergence: what this step leaves is at the rounding error.
                last = x + step
                return last if self._is_admissible(last) else None
            share = 1.0
            for _ in range(OPTIONS.halvings):
                trial = x + share * step
                if self._is_admissible(trial):
                    after = self._assemble_forces(trial, theta, slopes=False).force_n
                    next_step = self._newton_step(factor, after + weight_n)
                    if np.linalg.norm(next_step) <= (1 - share / 4) * length:
                        break
                share /= 2
            else:
                return None
            x = trial
        return None

    def _newton_step(self, factor: Any, residual_n: Array) -> Array:
        """Return −(∂r/∂X)⁻¹ r (n, 3) [m], zero at held nodes."""
        step = np.zeros(self.points_m.size)
        step[self.free] = -factor.solve(residual_n[self.free])
        return step.reshape(self.points_m.shape)

    def _factorise(self, by_position: sp.csc_array) -> Any:
        """Return the LU factors of ∂r/∂X at the free dofs; None if it is singular."""
        matrix = sp.csc_array(by_position[self.free][:, self.free])
        try:
            return splu(matrix)
        except RuntimeError:
            return None

    def _is_admissible(self, positions_m: Array) -> bool:
        for cells, geometry in self._parts:
            slopes = geometry[..., :-1].reshape(*geometry.shape[:2], -1, 3)
            gradients = np.einsum("ean,eqai->eqni", positions_m[cells], slopes)
            if np.linalg.det(gradients).min() < OPTIONS.least_volume_ratio:
                return False
        return True

    def _assemble_forces(self, positions_m: Array, theta: Array, slopes: bool) -> _AssembledForces:
        """Elastic forces at stress-free positions X (n, 3); derivatives are 0 unless `slopes`."""
        size = self.points_m.size
        force = np.zeros(size)
        by_theta = np.zeros((size, len(self.places)))
        by_position = sp.csc_array((size, size))
        places = {int(place): number for number, place in enumerate(self.places)}
        body = self.body
        for part, start, (cells, geometry) in zip(
            body.parts, body.starts, self._parts, strict=False
        ):
            elastic = len(part.material.constants)
            part_forces = _part_forces(
                cells,
                geometry,
                positions_m=positions_m,
                constants=theta[start : start + elastic],
                material=part.material,
                averages=body.element.mean_dilatation,
                slopes=slopes,
            )
            dofs = part_forces.dofs
            force += np.bincount(dofs.ravel(), part_forces.force_n.ravel(), size)
            if not slopes:
                continue
            shape = part_forces.by_position.shape
            rows = np.broadcast_to(dofs[:, :, None], shape).ravel()
            columns = np.broadcast_to(dofs[:, None, :], shape).ravel()
            entries = sp.coo_array((part_forces.by_position.ravel(), (rows, columns)), (size, size))
            by_position = by_position + sp.csc_array(entries)
            for number in range(elastic):
                values = part_forces.by_theta[..., number].ravel()
                by_theta[:, places[start + number]] += np.bincount(dofs.ravel(), values, size)
        return _AssembledForces(force, by_position, by_theta=by_theta)

    def _failure_message(self, theta: Array, reached: float) -> str:
        """The fraction `reached` of the weight was solved."""
        moduli = ", ".join(
            f"{name + ': ' if name else ''}λ {lam:.4g} Pa, μ {mu:.4g} Pa"
            for name, (lam, mu) in self.body.lame(theta).items()
        )
        return (
            "found no stress-free shape whose equilibrium under gravity is the mesh, with "
            f"{moduli} and {self.body.mass_of_dofs(theta)[::3].sum():.4g} kg: elements would be "
            f"inverted beyond {reached:.0%} of the weight; expected a body that carries its "
            "weight in the pose of the scan: check gravity_m_s2 and nodes of the scan, the mass, "
            "the unit of the mesh, and give stiffer guesses"
        )


def require_supported(parts: Sequence[BodyPart]) -> None:
    """Raise an `InputError` if the stress-free shape of these parts cannot be computed.

    This is the case for fields, for branches of memory and for fibres.
    """
    for part in parts:
        if part.axes is not None:
            raise InputError(
                "found rest_shape = 'under_gravity' and fibres; expected a material without them, or "
                "rest_shape = 'stress_free'",
                where="rest_shape",
            )
        if part.field is not None:
            raise InputError(
                f"found rest_shape = 'under_gravity' and a field of {part.field_name}; expected "
                "constants that are the same within each region: leave the field out, or state "
                "rest_shape = 'stress_free'",
                where="rest_shape",
            )
        if part.prony:
            raise InputError(
                "found rest_shape = 'under_gravity' and a material with memory (prony); expected "
                "one without: leave the branches out, or state rest_shape = 'stress_free'",
                where="rest_shape",
            )
