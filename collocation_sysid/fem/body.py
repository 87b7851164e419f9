"""A deformable body: mesh, material and mass, and its forces and derivatives over all timesteps.

Signs: Ψ(x) elastic energy, f_e = −∂Ψ/∂x, K = ∂²Ψ/∂x² = −∂f_e/∂x, and the internal force

    f(x, v; θ) = f_e(x) − γ_r K(x) v − γ_m M v.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray

from ..arrays import Array
from ..errors import InputError
from .batched import Batch, Evaluator, EvaluatorChoice, available_threads
from .elements import Element, element_named, reference_geometry
from .expressions import KERNELS, energy_kernel
from .materials import Energy, material_named
from .mesh import TetMesh
from .nodes import Nodes
from .pattern import SymmetricPattern, element_destinations
from .selection import Selection

Theta = Sequence[float] | Array


@dataclass(frozen=True, eq=False)
class Linearisation:
    """The internal force and its first derivatives at T states; m = `pattern.entries`.

    Attributes
    ----------
    force : (T, 3n) f(x, v; θ) [N]
    by_position : (T, m) lower triangles of ∂f/∂x = −K − γ_r D_vK [N/m]
    by_velocity : (T, m) lower triangles of ∂f/∂v = −γ_r K − γ_m M [N·s/m]
    by_theta : (T, 3n, 4) ∂f/∂(λ, μ, γ_r, γ_m)
    """

    force: Array
    by_position: Array
    by_velocity: Array
    by_theta: Array


@dataclass(frozen=True, eq=False)
class Curvature:
    """Second derivatives of φ = wᵀ f(x, v; θ) at T states; ∂²φ/∂v² is zero.

    Attributes
    ----------
    position_position, position_velocity : (T, m) lower triangles
    position_theta, velocity_theta : (T, 3n, 4)
    theta_theta : (T, 4, 4)
    theta : (T, 4) first derivative ∂φ/∂θ
    """

    position_position: Array
    position_velocity: Array
    position_theta: Array
    velocity_theta: Array
    theta_theta: Array
    theta: Array


class Body:
    """A tetrahedral finite-element body.

    Parameters
    ----------
    mesh : TetMesh
    material : str or callable, default "neo-hookean"
        A name in `materials.MATERIALS` or an energy function ``(F, λ, μ) -> ψ`` in CasADi SX.
    density_kg_m3, mass_kg : float
        Exactly one of them; the density is uniform.
    element : str, default "tet4"
        A name in `elements.ELEMENTS`. "tet10" puts a node on every edge of the mesh: some eight
        times the unknowns, and far better in bending or when nearly incompressible.
    evaluator : {"auto", "simd", "casadi"}
        How element kernels are evaluated, see `batched`. "auto" takes CasADi's map, with a note,
        for a material that vector code cannot evaluate.
    threads : int, optional
        Threads for evaluations over several timesteps; the available cores by default.

    Attributes
    ----------
    nodes_m : (n, 3) undeformed node positions
        The mesh's nodes, then, for "tet10", the middle of each of `mesh.edges`.
    cells : (E, nodes per element) node numbers
    node_mass : (n,) lumped mass [kg]
    pattern : SymmetricPattern of K

    Raises
    ------
    InputError
        For unknown names, a mass that is not positive, or a material "simd" cannot evaluate.
    """

    def __init__(
        self,
        mesh: TetMesh,
        material: str | Energy = "neo-hookean",
        density_kg_m3: float | None = None,
        element: str = "tet4",
        *,
        mass_kg: float | None = None,
        evaluator: str = "auto",
        threads: int | None = None,
    ) -> None:
        self.mesh = mesh
        self.material: Energy = material_named(material) if isinstance(material, str) else material
        self.element: Element = element_named(element)
        self.nodes = Nodes.of_element(mesh, self.element)
        self.nodes_m: Array = self.nodes.points_m
        self.cells: NDArray[np.int64] = self.nodes.cells
        self.threads = threads or available_threads()
        density = _density(mesh.volume_m3, density_kg_m3, mass_kg)
        shares = density * mesh.volumes_m3[:, None] * self.element.mass_shares
        self.node_mass: Array = np.zeros(len(self.nodes_m))
        np.add.at(self.node_mass, self.cells, shares)
        self.geometry = reference_geometry(self.nodes_m, self.cells, self.element)
        self._evaluators: dict[str, Evaluator] = {}
        self._choice = EvaluatorChoice(evaluator)
        # Derivatives need no operations but those of the energy and the ones every evaluator has.
        self._choice.check(energy_kernel(self.element, self.material).pieces)

    def select(self, selection: Selection) -> NDArray[np.int64]:
        """Return the nodes of a `selection.Selection`, sorted.

        Boxes and balls act on all nodes. Indices and point arrays are of the mesh's nodes; a node
        on an edge is selected when both of the edge's ends are.

        Raises
        ------
        InputError
            If there are none.
        """
        return selection.resolve(self.nodes)

    @property
    def evaluator(self) -> str:
        """How element kernels are evaluated: "simd" or "casadi"."""
        return self._choice.name

    @property
    def notes(self) -> tuple[str, ...]:
        """Why it is not "simd", if the material is to blame."""
        return self._choice.notes

    def make_evaluator(self, batch: Batch) -> Evaluator:
        """Build the evaluator of a batch of this body's material."""
        return self._choice.make(batch)

    @property
    def mass_kg(self) -> float:
        """Total mass."""
        return float(self.node_mass.sum())

    @cached_property
    def dof_mass(self) -> Array:
        """(3n,) lumped mass of every degree of freedom [kg]."""
        return np.repeat(self.node_mass, 3)

    @cached_property
    def pattern(self) -> SymmetricPattern:
        """Sparsity of the stiffness matrix."""
        return SymmetricPattern.of_cells(self.cells, len(self.nodes_m))

    # One state ------------------------------------------------------------------------------

    def energy(self, positions: ArrayLike, lambda_pa: float, mu_pa: float) -> float:
        """Elastic energy Ψ [J] at (n, 3) node positions [m]."""
        x = self._state(positions)
        return float(self._evaluate("energy", [x], (lambda_pa, mu_pa, 0.0))[0, 0])

    def elastic_force(self, positions: ArrayLike, lambda_pa: float, mu_pa: float) -> Array:
        """Elastic force −∂Ψ/∂x, (n, 3) [N], at (n, 3) node positions [m]."""
        x = self._state(positions)
        force = self._evaluate("force", [x, np.zeros_like(x)], (lambda_pa, mu_pa, 0.0))
        return force.reshape(-1, 3)

    def stiffness(self, positions: ArrayLike, lambda_pa: float, mu_pa: float) -> sp.csc_array:
        """Stiffness K = ∂²Ψ/∂x², (3n, 3n) sparse [N/m]; row 3i + j is coordinate j of node i."""
        x = self._state(positions)
        theta = (lambda_pa, mu_pa, 0.0, 0.0)
        return self.pattern.matrix(-self.linearise(x, np.zeros_like(x), theta).by_position[0])

    # Many states ----------------------------------------------------------------------------

    def force(
        self,
        positions: ArrayLike,
        velocities: ArrayLike,
        theta: Theta,
        dof_mass: Array | None = None,
    ) -> Array:
        """Internal force f(x, v; θ), (T, 3n) [N].

        Parameters
        ----------
        positions, velocities : (T, n, 3), (T, 3n) or one state (n, 3)
        theta : (λ [Pa], μ [Pa], γ_r [s], γ_m [1/s])
        dof_mass : (3n,) or (T, 3n), optional
            The M that γ_m damps, where more than the body's own mass moves [kg].
        """
        x, v = self._states(positions, velocities)
        mass = self.dof_mass if dof_mass is None else dof_mass
        return self._evaluate("force", [x, v], theta[:3]) - theta[3] * mass * v

    def linearise(
        self,
        positions: ArrayLike,
        velocities: ArrayLike,
        theta: Theta,
        out: Array | None = None,
        dof_mass: Array | None = None,
    ) -> Linearisation:
        """Internal force and first derivatives at T states, see `Linearisation` and `force`.

        The result's arrays are views of `out` (T, `linearisation_width`) when it is given.
        """
        x, v = self._states(positions, velocities)
        rows = self._evaluate("linearisation", [x, v], theta[:3], out)
        size, entries = self.pattern.size, self.pattern.entries
        force, by_position, by_velocity, by_theta = np.split(
            rows, np.cumsum([size, entries, entries]), axis=1
        )
        mass = self.dof_mass if dof_mass is None else dof_mass
        drag = mass * v
        force -= theta[3] * drag
        by_velocity[:, self.pattern.diagonal] -= theta[3] * mass
        by_theta = by_theta.reshape(len(x), size, 4)
        by_theta[:, :, 3] = -drag
        return Linearisation(force, by_position, by_velocity, by_theta)

    @property
    def linearisation_width(self) -> int:
        """Length of one timestep's row of `linearise`."""
        return 5 * self.pattern.size + 2 * self.pattern.entries

    def curvature(
        self,
        positions: ArrayLike,
        velocities: ArrayLike,
        weights: ArrayLike,
        theta: Theta,
        out: Array | None = None,
        dof_mass: Array | None = None,
    ) -> Curvature:
        """Second derivatives of wᵀ f at T states, see `Curvature`; `weights` like `positions`."""
        x, v, w = self._states(positions, velocities, weights)
        rows = self._evaluate("curvature", [x, v, w], theta[:3], out)
        size, entries = self.pattern.size, self.pattern.entries
        xx, xv, x_theta, v_theta, theta_theta, by_theta = np.split(
            rows, np.cumsum([entries, entries, 4 * size, 4 * size, 16]), axis=1
        )
        x_theta, v_theta = (part.reshape(len(x), size, 4) for part in (x_theta, v_theta))
        v_theta[:, :, 3] = -(self.dof_mass if dof_mass is None else dof_mass) * w
        by_theta[:, 3] = np.einsum("ti,ti->t", v_theta[:, :, 3], v)
        return Curvature(xx, xv, x_theta, v_theta, theta_theta.reshape(len(x), 4, 4), by_theta)

    @property
    def curvature_width(self) -> int:
        """Length of one timestep's row of `curvature`."""
        return 8 * self.pattern.size + 2 * self.pattern.entries + 20

    def volume_ratios(self, positions: ArrayLike) -> Array:
        """J = det F at every quadrature point, (T, E, q); not positive means inverted."""
        x = self._states(positions)[0].reshape(-1, len(self.nodes_m), 3)
        gradients = self.geometry[..., :-1].reshape(len(self.cells), -1, self.element.nodes, 3)
        f = np.einsum("teai,eqaj->ijteq", x[:, self.cells], gradients)
        a, b = f[1], f[2]
        return (
            f[0, 0] * (a[1] * b[2] - a[2] * b[1])
            + f[0, 1] * (a[2] * b[0] - a[0] * b[2])
            + f[0, 2] * (a[0] * b[1] - a[1] * b[0])
        )

    # Assembly -------------------------------------------------------------------------------

    def _states(self, *fields: ArrayLike) -> list[Array]:
        """Every field as (T, 3n); native code relies on their shapes."""
        nodes = len(self.nodes_m)
        arrays = [np.ascontiguousarray(field, dtype=float) for field in fields]
        for array in arrays:
            if array.size % (3 * nodes) or array.size != arrays[0].size:
                raise InputError(
                    f"node fields of shapes {', '.join(str(a.shape) for a in arrays)}; "
                    f"expected ({nodes}, 3) or (T, {nodes}, 3), with the same T in all"
                )
        return [array.reshape(-1, 3 * nodes) for array in arrays]

    def _state(self, positions: ArrayLike) -> Array:
        states = self._states(positions)[0]
        if len(states) != 1:
            raise InputError(
                f"positions hold {len(states)} states; expected one, ({len(self.nodes_m)}, 3)"
            )
        return states

    def _evaluate(
        self, name: str, fields: Sequence[Array], theta: Theta, out: Array | None = None
    ) -> Array:
        if name not in self._evaluators:
            self._evaluators[name] = self.make_evaluator(self._batch(name))
        width = self._width(name)
        shape = (len(fields[0]), width)
        if out is None:
            out = np.empty(shape)
        elif out.shape != shape or out.dtype != float or not out.flags.c_contiguous:
            raise InputError(f"out is {out.dtype} {out.shape}; expected contiguous float64 {shape}")
        values = np.array(theta, dtype=float)
        self._evaluators[name](fields, values, out, self.threads)
        return out

    def _width(self, name: str) -> int:
        return {
            "energy": 1,
            "force": self.pattern.size,
            "linearisation": self.linearisation_width,
            "curvature": self.curvature_width,
        }[name]

    def _batch(self, name: str) -> Batch:
        """Lay a kernel's outputs out in one row: vectors, lower triangles, 4 columns for θ."""
        kernel = KERNELS[name](self.element, self.material)
        vector, lower = element_destinations(self.pattern, self.cells)
        columns = np.arange(3)  # the kernel's λ, μ, γ_r; column 3 is γ_m, which needs no elements
        by_theta = (columns[:, None] + 4 * vector[:, None, :]).reshape(len(self.cells), -1)
        square = np.broadcast_to((columns[:, None] + 4 * columns).ravel(), (len(self.cells), 9))
        whole = np.zeros((len(self.cells), 1), dtype=np.int64)
        places = {
            "energy": (whole, 1),
            "force": (vector, self.pattern.size),
            "by_position": (lower, self.pattern.entries),
            "by_velocity": (lower, self.pattern.entries),
            "by_theta": (by_theta, 4 * self.pattern.size),
            "position_position": (lower, self.pattern.entries),
            "position_velocity": (lower, self.pattern.entries),
            "position_theta": (by_theta, 4 * self.pattern.size),
            "velocity_theta": (by_theta, 4 * self.pattern.size),
            "theta_theta": (square, 16),
            "gradient_theta": (np.broadcast_to(columns, (len(self.cells), 3)), 4),
        }
        used = [places[output] for output in kernel.contractions]
        starts = np.cumsum([0] + [length for _, length in used])
        destinations = np.hstack(
            [place + start for (place, _), start in zip(used, starts[:-1], strict=True)]
        )
        return Batch(kernel, self.cells, self.geometry, destinations, self._width(name))


def _density(volume_m3: float, density_kg_m3: float | None, mass_kg: float | None) -> float:
    if (density_kg_m3 is None) == (mass_kg is None):
        raise InputError("give exactly one of density_kg_m3 and mass_kg")
    density = density_kg_m3 if density_kg_m3 is not None else (mass_kg or 0.0) / volume_m3
    if not density > 0:
        name = "density_kg_m3" if density_kg_m3 is not None else "mass_kg"
        raise InputError(f"{name} must be positive")
    return density
