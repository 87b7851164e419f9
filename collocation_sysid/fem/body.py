"""A deformable body: mesh, material and mass, and its forces and derivatives over all timesteps.

Signs: Ψ(x) elastic energy, f_e = −∂Ψ/∂x, K = ∂²Ψ/∂x² = −∂f_e/∂x, and the internal force

    f(x, v; θ) = f_e(x) + f_d(x, v) − γ_m M v,   f_d = −γ_r K(x) v for Rayleigh's damping law.

The slopes of a damping law that is a stress, not a potential, are not symmetric: their skew parts
are arrays of their own, which are empty, (T, 0), where no part of the body has any.

A body is the sum of its parts, one for each region, see `regions`; θ holds the constants of each
part in turn: its material's, its damping law's, those of its memory, its γ_m, and its density where
that is free. What a body with memory brings from the past, see `memory`, is given beside x and v;
without it, it has relaxed.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from itertools import accumulate
from typing import Any, Literal

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike

from ..arrays import Array
from ..errors import InputError
from .air import placed_unit_drag
from .constants import DENSITY, Constant
from .discretisation import Discretisation
from .field import Field, FieldModes
from .materials import Damping, Energy, Material, Prony
from .memory import Past
from .mesh import TetMesh
from .node_force import NodeForce, PlacedForce
from .pattern import Joined, SymmetricPattern
from .regions import BodyPart, Model, Region, Theta, parts_of
from .rest_shape import InverseEquilibrium, RestShapeError, UnderGravity, require_supported
from .selection import Selection
from .stress import Stresses
from .two_phase import PhaseSamples, TwoPhaseModes


@dataclass(frozen=True, eq=False)
class Linearisation:
    """The internal force and its first derivatives at T states; m = `pattern.entries`.

    Attributes
    ----------
    force : (T, 3n) f(x, v; θ) [N]
    by_position : (T, m) lower triangles of ∂f/∂x, its symmetric part; for Rayleigh's damping
        −K − γ_r D_vK [N/m]
    by_velocity : (T, m) lower triangles of ∂f/∂v; for Rayleigh's −γ_r K − γ_m M [N·s/m]
    by_theta : (T, 3n, k) ∂f/∂θ
    by_position_skew : (T, m) lower triangles of the skew part of ∂f/∂x, or (T, 0)
    by_velocity_skew : the same of ∂f/∂v: only forces of users have some, such as gyroscopic ones
    """

    force: Array
    by_position: Array
    by_velocity: Array
    by_theta: Array
    by_position_skew: Array
    by_velocity_skew: Array


@dataclass(frozen=True, eq=False)
class Curvature:
    """Second derivatives of φ = wᵀ f(x, v; θ) + σ·S(x; θ) at T states.

    Attributes
    ----------
    position_position, position_velocity : (T, m) lower triangles, of the symmetric part
    position_theta, velocity_theta : (T, 3n, k)
    theta_theta : (T, k, k)
    theta : (T, k) first derivative ∂φ/∂θ
    position_velocity_skew : (T, m) lower triangles of the skew part of ∂²φ/∂x∂v, or (T, 0)
    velocity_velocity : (T, m) lower triangles, or (T, 0): only forces of users have some
    """

    position_position: Array
    position_velocity: Array
    position_theta: Array
    velocity_theta: Array
    theta_theta: Array
    theta: Array
    position_velocity_skew: Array
    velocity_velocity: Array


class Body(Discretisation):
    """A tetrahedral finite-element body.

    Parameters
    ----------
    mesh : TetMesh
    material : str, Material or callable, default "neo-hookean"
        A name in `materials.MATERIALS`, or an energy function ``(F, **constants) -> ψ`` in CasADi
        SX, see `Material.of`.
    density_kg_m3, mass_kg : float
        Exactly one of them. Regions may have densities of their own; the mass is that of all.
    element : str, default "tet4"
        A name in `elements.ELEMENTS`. "tet10" puts a node on every edge of the mesh: some eight
        times the unknowns, and far better in bending. "tet10-p0" also averages the dilatation over
        each element: right up to a Poisson's ratio of 0.4999.
    damping : str or Damping, default "kelvin-voigt"
        A name in `damping.DAMPINGS`; "rayleigh" is the paper's law.
    regions : sequence of Region
        Parts that differ.
    prony : sequence of str or Prony
        Names of the branches of the material's memory.
    forces : sequence of NodeForce
        Of the user's own, on its nodes, such as the drag of the air.
    field : Field, optional
        A constant that differs from place to place within what no region claims.
    rest_shape : UnderGravity or "stress_free", optional
        How the body was held while its mesh was made: the stress-free shape is then found, see
        `rest_shape`. "stress_free": the mesh is. By default it counts as such, but the budget of
        the intervals includes that it may be a shape under gravity.
    evaluator : {"auto", "simd", "casadi"}
        How element kernels are evaluated, see `batched`. "auto" takes CasADi's map, with a note,
        for a material that vector code cannot evaluate.
    threads : int, optional
        Threads for evaluations over several timesteps; the available cores by default.

    Attributes
    ----------
    parts : tuple of BodyPart
        What no region claims, then the regions.
    constants : dict of name to Constant
        What θ holds, in its order.
    nodes_m : (n, 3) undeformed node positions
        The mesh's nodes, then, for quadratic elements, the middle of each of `mesh.edges`, then
        `frames`.
    frames : (k, 4) nodes of obstacles, see `with_frames`
    cells : (E, nodes per element) node numbers
    node_mass : (n,) lumped mass, of the densities as stated [kg]
    pattern : SymmetricPattern of K

    Raises
    ------
    InputError
        For unknown names, a mass that is not positive, regions that overlap, a material that
        "simd" cannot evaluate, or a scan of a body with memory or a field.
    """

    def __init__(
        self,
        mesh: TetMesh,
        material: str | Energy | Material = "neo-hookean",
        density_kg_m3: float | None = None,
        element: str = "tet4",
        *,
        mass_kg: float | None = None,
        damping: str | Damping = "kelvin-voigt",
        regions: Sequence[Region] = (),
        prony: Sequence[str | Prony] = (),
        forces: Sequence[NodeForce] = (),
        field: Field | None = None,
        rest_shape: UnderGravity | Literal["stress_free"] | None = None,
        evaluator: str = "auto",
        threads: int | None = None,
    ) -> None:
        parts = parts_of(mesh, material, damping, density_kg_m3, mass_kg, regions, prony, field)
        generated: Literal["stress_free"] | None = "stress_free" if mesh.is_generated else None
        self.rest_shape: UnderGravity | Literal["stress_free"] | None = (
            generated if rest_shape is None else rest_shape
        )
        if rest_shape not in (None, "stress_free") and not isinstance(rest_shape, UnderGravity):
            raise InputError(
                f"found {rest_shape!r}; expected 'stress_free' or UnderGravity(nodes, gravity)",
                where="rest_shape",
            )
        if self.scan is not None:
            require_supported(parts)
        super().__init__(parts, tuple(forces), mesh, element, evaluator, threads)
        # (3n,) of each part.
        self._lumped_m3 = [np.repeat(self._lumped(part), 3) for part in self.parts]
        self.has_stated_mass = mass_kg is not None
        self.node_mass: Array = self._weighed([p.density_kg_m3 for p in self.parts])[::3]

    def __repr__(self) -> str:
        materials = ", ".join(f"{p.name or 'body'}: {p.material.name}" for p in self.parts)
        return (
            f"Body({len(self.nodes_m)} nodes, {len(self.cells)} {self.element.name}, "
            f"{self.mass_kg:.4g} kg, {materials})"
        )

    @property
    def scan(self) -> UnderGravity | None:
        """How the body was held while its mesh was made, where that is stated."""
        return self.rest_shape if isinstance(self.rest_shape, UnderGravity) else None

    @cached_property
    def inverse(self) -> InverseEquilibrium | None:
        """Solver of the stress-free shape; none where the mesh is free of stress."""
        return None if self.scan is None else InverseEquilibrium(self)

    def unreachable(self, theta: Theta) -> str | None:
        """Return why there is no stress-free shape at θ and what helps, None where there is one."""
        if self.inverse is None:
            return None
        try:
            self.inverse.shape(theta)
        except RestShapeError as error:
            return error.message
        return None

    def stress_free_geometry(self, theta: Theta) -> Array:
        """Return shape gradients and volumes (E, q, 3·nodes + 1) in the stress-free shape at θ."""
        if self.inverse is None:
            return self.geometry
        return self._geometry_at(self.inverse.shape(theta).positions_m)

    def with_stress_free(self, positions_m: Array) -> Body:
        """Return the same body, free of stress where its nodes are at (n, 3), of the same mass."""
        other = copy(self)
        other.geometry = self._geometry_at(positions_m)
        other.rest_shape = "stress_free"
        for name in ("inverse", "stresses"):
            vars(other).pop(name, None)
        other._evaluators, other._framed = {}, {}
        return other

    def _geometry_at(self, positions_m: Array) -> Array:
        """Shape gradients and volumes where nodes are at (n, 3) instead of where the mesh is."""
        count, points = self.geometry.shape[:2]
        slopes = self.geometry[..., :-1].reshape(count, points, -1, 3)
        G = np.einsum("ean,eqai->eqni", positions_m[self.cells], slopes)
        own = np.einsum("eqai,eqin->eqan", slopes, np.linalg.inv(G)).reshape(count, points, -1)
        volumes = self.geometry[..., -1:] * np.linalg.det(G)[..., None]
        return np.concatenate([own, volumes], axis=2)

    def stress_free_mesh(self, theta: Theta) -> TetMesh:
        """Return the mesh in its stress-free shape at θ (k,), with straight sides.

        Raises
        ------
        RestShapeError
            If there is none whose equilibrium under gravity is the mesh.
        """
        if self.inverse is None:
            return self.mesh
        positions_m = self.inverse.shape(theta).positions_m[: len(self.mesh.points_m)]
        mesh = self.mesh
        return TetMesh(
            positions_m, mesh.tetrahedra, mesh.point_arrays, mesh.cell_arrays, mesh.face_sets
        )

    @property
    def density_places(self) -> list[int]:
        """Where in θ the densities that are free are."""
        pairs = zip(self.parts, self._gamma_places, strict=True)
        return [place + 1 for part, place in pairs if part.free_density]

    def __getstate__(self) -> dict[str, Any]:
        # Kernels are of this process, and what follows from the rest is found anew.
        kept = {n: v for n, v in vars(self).items() if n not in self._following}
        return kept | {"_evaluators": {}, "_framed": {}}

    @property
    def _following(self) -> set[str]:
        """Names of what is kept and follows from the rest."""
        return {n for n in vars(self) if isinstance(getattr(type(self), n, None), cached_property)}

    def _lumped(self, part: BodyPart, shares: ArrayLike = 1.0) -> Array:
        """(n,) lumped volume of a part, or of shares (E,) of its cells."""
        volumes_m3 = self.mesh.volumes_m3[part.cells] * shares
        volume = np.zeros(len(self.nodes_m))
        np.add.at(volume, self.cells[part.cells], volumes_m3[:, None] * self.element.mass_shares)
        return volume

    def with_free_densities(self, parts: Collection[str]) -> Body:
        """The same body, with the densities of the parts of these names among its constants."""
        free = tuple(
            part
            if (part.name in parts) == part.free_density
            else replace(part, free_density=part.name in parts)
            for part in self.parts
        )
        return self if free == self.parts else self.with_parts(free)

    @property
    def lengths_m(self) -> dict[str, float]:
        """Of its fields, by the names of their constants."""
        return {part.field_name: part.field.length_m for part in self.parts if part.field}

    def with_lengths(self, lengths_m: Mapping[str, float]) -> Body:
        """The same body, with fields of other lengths by the names of their constants."""
        fields = (part.field and part.field.at(lengths_m[part.field_name]) for part in self.parts)
        return self.with_parts(
            tuple(replace(part, field=own) for part, own in zip(self.parts, fields, strict=True))
        )

    @property
    def phase_samples(self) -> tuple[PhaseSamples, ...]:
        """Draws of the phases of its two-phase fields, where there is an answer."""
        fields = (part.field for part in self.parts)
        return tuple(
            field.samples
            for field in fields
            if isinstance(field, TwoPhaseModes) and field.samples is not None
        )

    def with_fields(self, fields: Mapping[str, FieldModes]) -> Body:
        """Return the same body with other fields, by the names of their constants.

        Fields that are not named stay.
        """
        return self.with_parts(
            tuple(
                replace(part, field=fields.get(part.field_name, part.field)) for part in self.parts
            )
        )

    def with_parts(self, parts: tuple[BodyPart, ...]) -> Body:
        """The same body, whose parts of the same cells have other constants."""
        other = copy(self)
        for name in self._following - {"pattern", "shape_gradients", "part_of_cells"}:
            vars(other).pop(name, None)
        Model.__init__(other, parts, self.forces, self.frictions)
        other._evaluators, other._framed = {}, {}
        return other

    def with_frames(
        self, count: int, rubs: bool = False, frictions: tuple[Constant, ...] = ()
    ) -> Body:
        """The same body and frames of so many obstacles: four nodes each that no cell has.

        They are at `frame_m`, behind all others. `rubs` is whether slopes of contact have
        a skew part, and `frictions` are the coefficients that are parameters.
        """
        key = count, rubs, frictions
        if key == (len(self.frames), self.rubs, self.frictions):
            return self
        if key not in self._framed:
            other = copy(self)
            for name in self._following - {"part_of_cells", "frame_m"}:
                vars(other).pop(name, None)
            Model.__init__(other, self.parts, self.forces, frictions)
            other.rubs, other._evaluators = rubs, {}
            first, added = len(self.nodes.points_m), np.tile(self.frame_m, (count, 1))
            other.frames = first + np.arange(4 * count).reshape(count, 4)
            other.nodes_m = np.vstack([self.nodes.points_m, added])
            other._lumped_m3 = [
                np.append(each[: 3 * first], np.zeros(added.size)) for each in self._lumped_m3
            ]
            other.node_mass = np.append(self.node_mass[:first], np.zeros(len(added)))
            self._framed[key] = other
        return self._framed[key]

    @cached_property
    def frame_m(self) -> Array:
        """(4, 3) undeformed places of an obstacle's frame: its origin, and ends of its axes."""
        low, high = self.nodes.points_m.min(axis=0), self.nodes.points_m.max(axis=0)
        axes = np.vstack([np.zeros(3), np.eye(3) * (high - low).min() / 4])
        return (low + high) / 2 + axes

    @cached_property
    def stresses(self) -> Stresses:
        """Those of the parts with memory, point by point."""
        return Stresses(self)

    @cached_property
    def elastic_places(self) -> list[int]:
        """Where in θ what stress depends on is: constants of the materials, and fields."""
        found: list[int] = []
        for part, start, modes in zip(self.parts, self.starts, self.mode_places, strict=False):
            found += [*range(start, start + len(part.material.constants))]
            found += [*range(modes.start, modes.stop)] if part.stress_field else []
        return found

    @property
    def mass_kg(self) -> float:
        """Total mass, of the densities as stated."""
        return float(self.node_mass.sum())

    @cached_property
    def mass_slopes(self) -> dict[int, Array]:
        """∂M/∂ρ (3n,) of each density that is free [m³], by its place in θ, and those by the shares
        of the shapes of a density's field [kg].
        """
        return {place: slope for own in self._mass_slopes for place, slope in own.items()}

    @cached_property
    def _mass_slopes(self) -> list[dict[int, Array]]:
        """The same part by part."""
        found: list[dict[int, Array]] = []
        places = zip(self._gamma_places, self.mode_places, strict=True)
        for part, (gamma, modes), volume in zip(self.parts, places, self._lumped_m3, strict=True):
            found.append({gamma + 1: volume} if part.free_density else {})
            if part.field is not None and part.stress_field is None:
                shares = part.density_kg_m3 * part.field.shapes.T
                lumped = (np.repeat(self._lumped(part, share), 3) for share in shares)
                found[-1] |= dict(zip(range(modes.start, modes.stop), lumped, strict=True))
        return found

    def densities(self, theta: Theta) -> list[float]:
        """Of each part [kg/m³]; of a field the mean."""
        return [
            float(theta[place + 1]) if part.free_density else part.density_kg_m3
            for part, place in zip(self.parts, self._gamma_places, strict=True)
        ]

    def mass_of_dofs(self, theta: Theta) -> Array:
        """(3n,) lumped mass of every degree of freedom [kg]."""
        if not self.mass_slopes:
            return self.dof_mass
        return np.sum(self._masses(theta), axis=0)

    def massless(self, theta: Theta) -> str | None:
        """What is wrong, and what helps, where a node's mass is not above zero."""
        if not self.mass_slopes:
            return None
        masses = np.array(self._masses(theta))[:, ::3]
        # Those of obstacles have none.
        total = np.where(self.dof_volume_m3[::3] > 0, masses.sum(axis=0), np.inf)
        node = int(total.argmin())
        if total[node] > 0:
            return None
        part = self.parts[masses[:, node].argmin()]
        density, remedy = part.full_name(DENSITY.name), "give a density above zero"
        if part.field is not None and part.stress_field is None:
            remedy = "lower the amplitude of its field to 0.3 or less, or its field_1, field_2, …"
        return (
            f"{density} is so low near node {node} that its mass is {total[node]:.2g} kg; "
            f"expected masses above zero: {remedy}"
        )

    def _masses(self, theta: Theta) -> list[Array]:
        """(3n,) of each part."""
        found = []
        for part, volume, own in zip(self.parts, self._lumped_m3, self._mass_slopes, strict=True):
            stated = 0.0 if part.free_density else part.density_kg_m3
            found.append(sum((theta[k] * slope for k, slope in own.items()), stated * volume))
        return found

    def _weighed(self, densities: Sequence[float]) -> Array:
        """(3n,) mass of every dof."""
        return np.sum([d * v for d, v in zip(densities, self._lumped_m3, strict=True)], axis=0)

    @cached_property
    def placed_forces(self) -> tuple[PlacedForce, ...]:
        """Those of users, where they are."""
        volume, first, found = self.dof_volume_m3[::3], self.starts[-1], []
        for force in self.forces:
            columns = first + np.arange(len(force.constants))
            first += len(columns)
            chosen = np.arange(len(self.nodes_m)) if force.nodes is None else force.nodes
            chosen = self.select(chosen) if isinstance(chosen, Selection) else np.unique(chosen)
            found.append(PlacedForce.on(force, self.nodes, chosen, volume, columns))
        return tuple(found)

    @cached_property
    def unit_air_drag(self) -> PlacedForce:
        """Drag on the surface in a fluid of density one, see `air`."""
        return placed_unit_drag(self.nodes, self.dof_volume_m3[::3])

    @property
    def dof_volume_m3(self) -> Array:
        """(3n,) lumped volume of every degree of freedom."""
        return np.sum(self._lumped_m3, axis=0)

    @cached_property
    def dof_mass(self) -> Array:
        """(3n,) lumped mass of every degree of freedom, of the densities as stated [kg]."""
        return np.repeat(self.node_mass, 3)

    def joined_with(self, couplings: Sequence[SymmetricPattern]) -> Joined:
        """The mesh graph, other couplings, and those of the forces of users."""
        own = (placed.points.couplings for placed in self.placed_forces)
        return Joined.of((self.pattern, *couplings, *own))

    # One state ------------------------------------------------------------------------------

    def energy(self, positions: ArrayLike, **constants: float) -> float:
        """Elastic energy Ψ [J] at (n, 3) node positions [m].

        The constants are the material's, or moduli in their place: ``young_pa=1e4, poisson=0.3``.
        """
        x = self._state(positions)
        return float(self._evaluate("energy", [x], self.elastic(constants))[0, 0])

    def elastic_force(self, positions: ArrayLike, **constants: float) -> Array:
        """Elastic force −∂Ψ/∂x, (n, 3) [N], at (n, 3) node positions [m]; see `energy`."""
        x = self._state(positions)
        force = self._evaluate("force", [x, np.zeros_like(x)], self.elastic(constants))
        return force.reshape(-1, 3)

    def stiffness(self, positions: ArrayLike, **constants: float) -> sp.csc_array:
        """Stiffness K = ∂²Ψ/∂x², (3n, 3n) sparse [N/m]; row 3i + j is coordinate j of node i.

        See `energy` for the constants.
        """
        x, theta = self._state(positions), self.elastic(constants)
        return self.pattern.matrix(-self.linearise(x, np.zeros_like(x), theta).by_position[0])

    # Many states ----------------------------------------------------------------------------

    def force(
        self,
        positions: ArrayLike,
        velocities: ArrayLike,
        theta: Theta,
        tied_kg: Array | None = None,
        carried: Past | None = None,
    ) -> Array:
        """Internal force f(x, v; θ), (T, 3n) [N].

        Parameters
        ----------
        positions, velocities : (T, n, 3), (T, 3n) or one state (n, 3)
        theta : (k,) in the order of `constants`
        tied_kg : (3n,) or (T, 3n), optional
            What γ_m damps besides the body's own mass.
        carried : Past, optional
            What the states of a body with memory bring from the past; nothing by default.
        """
        x, v = self._states(positions, velocities)
        internal = self._evaluate("force", [x, v], theta, carried=carried)
        return internal - self._drag(theta, tied_kg) * v

    def linearise(
        self,
        positions: ArrayLike,
        velocities: ArrayLike,
        theta: Theta,
        out: Array | None = None,
        tied_kg: Array | None = None,
        carried: Past | None = None,
    ) -> Linearisation:
        """Internal force and first derivatives at T states, see `Linearisation` and `force`.

        They are those at a given H; its own derivatives are the memory's.

        The result's arrays are views of `out` (T, `linearisation_width`) when it is given.
        """
        x, v = self._states(positions, velocities)
        rows = self._evaluate("linearisation", [x, v], theta, out, carried)
        size, entries = self.pattern.size, self.pattern.entries
        width = len(self.constants) * size
        # Slices: `numpy.split` takes as long as the elements of a small body.
        ends = list(accumulate([0, size, entries, entries, width]))
        whole = self._width_without_fields("linearisation")
        force, by_position, by_velocity, by_theta, skew = (
            rows[:, start:stop] for start, stop in zip(ends, [*ends[1:], whole], strict=True)
        )
        drag = self._drag(theta, tied_kg)
        force -= drag * v
        by_velocity[:, self.pattern.diagonal] -= drag
        by_theta = by_theta.reshape(len(x), size, -1)
        for number, own in self._of_fields("linearisation", rows):
            here, spread = self.mode_places[number], self.spreads[number]
            slopes = spread.field.slopes(np.asarray(theta)[here])
            spread.nodal(own["by_theta"], slopes, by_theta[:, :, here])
        for column, slope in self._drag_slopes(theta, tied_kg):
            # A density also changes the stress-free shape of a mesh made under gravity.
            by_theta[:, :, column] += -slope * v
        self._spread_stiffening(by_theta, carried)
        return Linearisation(force, by_position, by_velocity, by_theta, skew, skew[:, :0])

    def _of_fields(self, name: str, rows: Array) -> Iterator[tuple[int, dict[str, Array]]]:
        """Of each part with a field, what its cells add by the logarithm, by output."""
        places = self.of_cells(name)
        for number in self.spreads:
            yield number, {out: rows[:, at] for (of, out), at in places.items() if of == number}

    def _spread_stiffening(self, by_theta: Array, carried: Past | None) -> None:
        """Turn ∂f/∂s (…, k), in the column of a part's first branch, into those by its memory."""
        for first, columns in self._memory_columns:
            if carried is None:
                by_theta[..., columns] = 0.0
            else:
                slopes = carried.slopes[:, None, columns]
                by_theta[..., columns] = by_theta[..., first, None] * slopes

    @cached_property
    def _memory_columns(self) -> list[tuple[int, slice]]:
        """The first and all of the places in θ of each part's branches."""
        firsts = [s + p.of_law for p, s in zip(self.parts, self.starts, strict=False)]
        counts = [2 * len(part.prony) for part in self.parts]
        return [(f, slice(f, f + n)) for f, n in zip(firsts, counts, strict=True) if n]

    def curvature(
        self,
        positions: ArrayLike,
        velocities: ArrayLike,
        weights: ArrayLike,
        theta: Theta,
        out: Array | None = None,
        tied_kg: Array | None = None,
        carried: Past | None = None,
    ) -> Curvature:
        """Second derivatives of wᵀ f + σ·S at T states, see `Curvature`, `Past` and `force`.

        `weights` are like `positions`. H counts as given.
        """
        x, v, w = self._states(positions, velocities, weights)
        if self.remembers:
            carried = carried or self.memory.nothing(len(x))
            own = carried.stress_weights
            own = np.zeros_like(carried.overstress) if own is None else own
            both = replace(carried, overstress=np.hstack([carried.overstress, own]))
            rows = self._evaluate("curvature", [x, v, w], theta, out, both)
        else:
            rows = self._evaluate("curvature", [x, v, w], theta, out)
        size, entries, k = self.pattern.size, self.pattern.entries, len(self.constants)
        xx, xv, x_theta, v_theta, theta_theta, by_theta, skew = np.split(
            rows[:, : self._width_without_fields("curvature")],
            np.cumsum([entries, entries, k * size, k * size, k * k, k]),
            axis=1,
        )
        x_theta, v_theta = (part.reshape(len(x), size, k) for part in (x_theta, v_theta))
        for column, slope in self._drag_slopes(theta, tied_kg):
            drag = -slope * w
            v_theta[:, :, column] += drag
            by_theta[:, column] += np.einsum("ti,ti->t", drag, v)
        theta_theta = theta_theta.reshape(len(x), k, k)
        for number, own in self._of_fields("curvature", rows):
            here, spread = self.mode_places[number], self.spreads[number]
            coefficients = np.asarray(theta)[here]
            slopes = spread.field.slopes(coefficients)
            spread.nodal(own["position_theta"], slopes, x_theta[:, :, here])
            spread.nodal(own["velocity_theta"], slopes, v_theta[:, :, here])
            by_theta[:, here] = own["gradient_theta"] @ slopes
            first, points = self.starts[number], self.parts[number].of_points
            twice = own["theta_theta"].reshape(len(x), len(slopes), -1)
            mixed = np.einsum("tek,em->tkm", twice[:, :, :points], slopes)
            theta_theta[:, first : first + points, here] = mixed
            theta_theta[:, here, first : first + points] = mixed.swapaxes(1, 2)
            bent = twice[:, :, points, None] * slopes
            by_coefficients = spread.field.curvature(coefficients, own["gradient_theta"])
            theta_theta[:, here, here] = slopes.T @ bent + by_coefficients
        for values in (x_theta, v_theta, theta_theta, theta_theta.swapaxes(1, 2)):
            self._spread_stiffening(values, carried)
        if carried is not None:
            for first, columns in self._memory_columns:
                bends = carried.bends[:, columns, columns]
                theta_theta[:, columns, columns] += by_theta[:, first, None, None] * bends
        self._spread_stiffening(by_theta[:, None], carried)
        for gamma, own in zip(self._gamma_places, self._mass_slopes, strict=True):
            for place, slope in own.items():
                mixed = -np.einsum("ti,ti,i->t", w, v, slope)
                theta_theta[:, place, gamma] = theta_theta[:, gamma, place] = mixed
        none = np.zeros((len(x), 0))
        return Curvature(xx, xv, x_theta, v_theta, theta_theta, by_theta, skew, none)

    @cached_property
    def _gamma_places(self) -> list[int]:
        """Place of each part's γ_m in θ; its density follows where it is free."""
        starts = zip(self.parts, self.starts, strict=False)
        return [start + part.of_gamma_m for part, start in starts]

    @cached_property
    def tied_shares(self) -> dict[int, Array]:
        """Place of each part's γ_m in θ, and its share (3n,) in what is tied to a dof."""
        return dict(zip(self._gamma_places, self._tied_shares, strict=True))

    def tied_drag(self, theta: Theta) -> Array:
        """(3n,) γ_m of what is tied to every dof [1/s]."""
        return np.sum([theta[k] * share for k, share in self.tied_shares.items()], axis=0)

    def _damped(self, theta: Theta, tied_kg: Array | None) -> Iterator[tuple[int, Array]]:
        """Place of each part's γ_m in θ, and the mass (3n,) or (T, 3n) that it damps.

        Mass that is tied to a node is damped as the part's own there, by its share as stated.
        """
        for k, damped in enumerate(self._masses(theta)):
            if tied_kg is not None:
                damped = damped + self._tied_shares[k] * tied_kg
            yield self._gamma_places[k], damped

    @cached_property
    def _tied_shares(self) -> list[Array]:
        """(3n,) share of each part in the mass of every dof, as stated."""
        parts = zip(self.parts, self._lumped_m3, strict=True)
        whole_kg = np.where(self.dof_mass == 0, 1.0, self.dof_mass)  # frames have none
        return [part.density_kg_m3 * volume / whole_kg for part, volume in parts]

    def _drag(self, theta: Theta, tied_kg: Array | None) -> Array:
        """(3n,) or (T, 3n) of f = −drag v by mass-proportional damping [N·s/m]."""
        # `numpy.sum` of a list takes longer than the products.
        return reduce(np.add, (theta[k] * mass for k, mass in self._damped(theta, tied_kg)))

    def _drag_slopes(self, theta: Theta, tied_kg: Array | None) -> Iterator[tuple[int, Array]]:
        """Places in θ, and the slopes of that by them."""
        yield from self._damped(theta, tied_kg)
        for gamma, own in zip(self._gamma_places, self._mass_slopes, strict=True):
            yield from ((place, theta[gamma] * slope) for place, slope in own.items())
