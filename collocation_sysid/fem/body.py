"""Deformable body: mesh, materials and masses, with internal forces and derivatives at many states.

Signs: Ψ(x) is the elastic energy, f_e = −∂Ψ/∂x the elastic force, K = ∂²Ψ/∂x² = −∂f_e/∂x the
stiffness, and the internal force is

    f(x, v; θ) = f_e(x) + f_d(x, v) − γ_m M v,   with f_d = −γ_r K(x) v for Rayleigh's damping law.

For a damping law that is a stress, not a potential, ∂f/∂x is not symmetric. Skew parts are separate
arrays, which are empty, (T, 0), if no part of the body has any.

A body is the sum of its parts, one for each region, see `regions`. The vector θ holds the constants
of each part in turn: those of its material, of its damping law and of its memory, γ_m, and the
density if it is free. The internal variables of a body with memory, see `memory`, are given beside
x and v; without them the memory has relaxed.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from itertools import accumulate
from typing import Any, Literal, cast, get_args

import casadi as ca
import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike

from ..common.array_types import Array
from ..common.validated_classes import validated
from ..common.validated_types import AtLeastOne, Positive
from ..errors import InputError
from .discretisation import Discretisation
from .laws.constants import DENSITY, NATURAL_ENDS, NATURAL_STRAINS, Constant, NaturalCurvature
from .laws.fibres import Fibres
from .laws.materials import DampingLaw, Energy, Material, Prony
from .laws.memory import MemoryInput
from .laws.stress import StressEvaluator
from .meshes.mesh import TetMesh
from .meshes.selection import Selection
from .node_force import LocatedForce, NodeForce, placed_unit_drag
from .pattern import JointPattern, SymmetricPattern
from .regions import BodyPart, ConstantsModel, Region, Theta, parts_from_regions
from .rest_shape import InverseEquilibrium, RestShapeError, UnderGravity, require_supported
from .schemes import Scheme, as_scheme
from .spatial_field import Field
from .step_function import element_forces, step_function


@dataclass(frozen=True, eq=False)
class Linearisation:
    """Forces and their first derivatives at T states; m = `pattern.entries`."""

    force: Array  # (T, 3n): forces f(x, v; θ) [N]
    # (T, m): lower triangles of the symmetric part of ∂f/∂x [N/m]; with Rayleigh damping −K − γ_r
    # D_vK.
    by_position: Array
    # (T, m): lower triangles of the symmetric part of ∂f/∂v [N·s/m]; with Rayleigh damping −γ_r K −
    # γ_m M.
    by_velocity: Array
    # (T, 3n, k): derivatives by the k constants θ (result of `Body`), or by all k inputs u (result
    # of the sum of forces in `model.forces`).
    by_theta: Array
    # (T, m) or (T, 0): lower triangles of the skew part of ∂f/∂x; empty if it is zero.
    by_position_skew: Array
    # (T, m) or (T, 0): lower triangles of the skew part of ∂f/∂v; only external forces have one:
    # custom forces, such as gyroscopic ones, and forces on frames that are averaged over a step.
    by_velocity_skew: Array


@dataclass(frozen=True, eq=False)
class SecondDerivatives:
    """First derivatives by θ and second derivatives of φ = wᵀ f(x, v; θ) + σ·S(x; θ) at T states."""

    # (T, m): lower triangles of the symmetric parts of ∂²φ/∂x² and ∂²φ/∂x∂v.
    position_position: Array
    position_velocity: Array
    # (T, 3n, k): mixed derivatives by positions or velocities and θ.
    position_theta: Array
    velocity_theta: Array
    theta_theta: Array  # (T, k, k): second derivatives by θ
    theta: Array  # (T, k): first derivatives ∂φ/∂θ, which the chain rule needs
    # (T, m) or (T, 0): lower triangles of the skew part of ∂²φ/∂x∂v; empty if it is zero.
    position_velocity_skew: Array
    # (T, m) or (T, 0): lower triangles of ∂²φ/∂v²; only external forces have some.
    velocity_velocity: Array


# How a body was made, and where its mesh comes from.
Made = Literal["cast", "foam", "printed", "tissue"]
MeshOrigin = Literal["cad", "scan"]


def _require_origin(made: object, mesh_from: object, rest_shape: object) -> None:
    for key, word, words in (
        ("made", made, get_args(Made)),
        ("mesh_from", mesh_from, get_args(MeshOrigin)),
    ):
        if word is not None and word not in words:
            raise InputError(f"found {word!r}; expected one of {', '.join(words)}", where=key)
    if mesh_from == "cad" and isinstance(rest_shape, UnderGravity):
        raise InputError(
            "found 'cad' with a rest shape under gravity; expected 'scan', because a drawing is free "
            "of stress",
            where="mesh_from",
        )


def _require_elastic(
    regions: Sequence[Region],
    prony: Sequence[object],
    field: object,
    fibres: object,
    rest_shape: object,
    damping: object,
) -> None:
    """Raise an `InputError` for what a rod does not have."""
    found = {
        "prony": bool(prony) or any(region.prony for region in regions),
        "field": field is not None or any(region.field is not None for region in regions),
        "fibres": fibres is not None or any(region.fibres is not None for region in regions),
        "rest_shape": rest_shape not in (None, "stress_free"),
        "damping": any(
            getattr(law, "name", law) not in (None, "kelvin-voigt", "rayleigh")
            for law in (damping, *(region.damping for region in regions))
        ),
    }
    for key, is_found in found.items():
        if is_found:
            raise InputError(
                "found for a rod; expected an elastic rod with the damping 'kelvin-voigt' or "
                "'rayleigh', whose centreline is its stress-free shape",
                where=key,
            )


class Body(Discretisation):
    """Deformable body of tetrahedral finite elements, or of elements of a rod.

    Parameters
    ----------
    mesh : TetMesh
        Also one of `rod_mesh`, of a slender body.
    material : str, Material or callable, default "neo-hookean"
        Name in `materials.MATERIALS`, or energy function ``(F, **constants) -> ψ`` in CasADi SX,
        see `Material.from_energy`. Of a rod "rod" (the default) or "cable", see `rods`.
    density_kg_m3 : float, optional
        Density of all regions without a density. Give either this or `mass_kg`.
    element : str, default "tet4"
        Name in `elements.ELEMENTS`. "tet10" adds a node on every edge of the mesh: about eight
        times as many unknowns, and much more accurate in bending. "tet10-p0" also averages the
        dilatation over each element: accurate up to a Poisson's ratio of 0.4999.
    mass_kg : float, optional
        Mass of the whole body, regions included.
    damping : str or DampingLaw, default "kelvin-voigt"
        Name in `materials.DAMPINGS`; "rayleigh" is the law of the paper.
    regions : sequence of Region
        Parts with different properties.
    prony : sequence of str or Prony
        Names of the branches of the material's memory.
    forces : sequence of NodeForce
        Custom forces on its nodes or faces.
    field : Field, optional
        Constant that varies in space, outside all regions.
    fibres : Fibres, optional
        Fibres beside the material, outside all regions.
    rest_shape : UnderGravity or "stress_free", optional
        UnderGravity: how the body was held while its mesh was made; the stress-free shape is then
        computed, see `rest_shape`. "stress_free": the mesh is the stress-free shape. None: not
        stated; the mesh counts as stress-free, and the result states how much the estimates would
        change if the mesh had been scanned under gravity. Generated meshes and those of drawings
        (`mesh_from` "cad") are stress-free.
    made : {"cast", "foam", "printed", "tissue"}, optional
        How the body was made: cast in a mould, cut from or moulded as foam, printed, or grown. It
        selects the default deviations of the uncertainty budget.
    mesh_from : {"cad", "scan"}, optional
        Origin of the mesh: the drawing from which the body was made, or a scan of the body. It
        selects defaults of the budget, too; a scan without a stated `rest_shape` counts as made
        in an unknown orientation to gravity.
    material_density_kg_m3 : float, optional
        Known density of the material of a body with `mass_kg`, with which the mass over the volume
        of the mesh is compared.
    natural_curvature : bool or "affine"
        Whether natural curvatures and twist of a rod are constants, or "affine" for those at the
        beginning and at the end of the rod, or of each region.
    evaluator : {"auto", "simd", "casadi"}
        Evaluator of the element kernels, see `kernels`. "auto" uses CasADi's map, with a note, for
        a material that vector code cannot evaluate.
    threads : int, optional
        Number of threads for evaluations at several time steps; the available cores by default.

    Attributes
    ----------
    parts : tuple of BodyPart
        The cells outside all regions, if any, then the regions.
    constants : dict of name to Constant
        Definitions of the entries of θ, in their order.
    nodes_m : (n, 3)
        Undeformed node positions: nodes of the mesh, then, for quadratic elements, the middle of
        each of `mesh.edges`, then `frames`.
    frames : (k, 4)
        Indices of the nodes of obstacle frames, see `with_frames`.
    cells : (E, nodes per element)
        Node indices of each element.
    node_mass : (n,)
        Lumped masses with the stated densities [kg].
    pattern : SymmetricPattern
        Sparsity pattern of K.
    has_declared_mass : bool
        Whether `mass_kg` was given.

    Raises
    ------
    InputError
        For unknown names, a mass that is not positive, regions that overlap, a material that "simd"
        cannot evaluate, or `UnderGravity` with a memory or a field.
    """

    @validated
    def __init__(
        self,
        mesh: TetMesh,
        material: str | Energy | Material = "neo-hookean",
        density_kg_m3: Positive | None = None,
        element: str = "tet4",
        *,
        mass_kg: Positive | None = None,
        damping: str | DampingLaw = "kelvin-voigt",
        regions: Sequence[Region] = (),
        prony: Sequence[str | Prony] = (),
        forces: Sequence[NodeForce] = (),
        field: Field | None = None,
        fibres: Fibres | None = None,
        rest_shape: UnderGravity | Literal["stress_free"] | None = None,
        made: Made | None = None,
        mesh_from: MeshOrigin | None = None,
        material_density_kg_m3: Positive | None = None,
        natural_curvature: NaturalCurvature = False,
        evaluator: str = "auto",
        threads: AtLeastOne | None = None,
    ) -> None:
        kind, material = mesh.element_and_law(element, material, natural_curvature)
        if not mesh.kind.is_solid:
            _require_elastic(regions, prony, field, fibres, rest_shape, damping)
        parts = parts_from_regions(
            mesh,
            material,
            damping=damping,
            density_kg_m3=density_kg_m3,
            mass_kg=mass_kg,
            regions=regions,
            prony=prony,
            field=field,
            fibres=fibres,
        )
        parts = tuple(
            replace(part, cells=np.unique(mesh.cell_of_tetrahedra[part.cells])) for part in parts
        )
        _require_origin(made, mesh_from, rest_shape=rest_shape)
        self.made: Made | None = made
        self.mesh_from: MeshOrigin | None = mesh_from
        self.material_density_kg_m3: float | None = material_density_kg_m3
        if material_density_kg_m3 is not None and mass_kg is None:
            raise InputError(
                "found no mass_kg; expected the weighed mass, which over the volume of the mesh is "
                "compared with this density, or density_kg_m3 instead",
                where="material_density_kg_m3",
            )
        # A rod is generated, but a real cable is seldom straight by itself.
        is_drawn = (mesh.is_generated and mesh.kind.is_solid) or mesh_from == "cad"
        generated: Literal["stress_free"] | None = "stress_free" if is_drawn else None
        self.rest_shape: UnderGravity | Literal["stress_free"] | None = (
            generated if rest_shape is None else rest_shape
        )
        is_known = rest_shape is None or isinstance(rest_shape, str | UnderGravity)
        if not is_known or (isinstance(rest_shape, str) and rest_shape != "stress_free"):
            raise InputError(
                f"found {rest_shape!r}; expected 'stress_free', or for a mesh that was scanned under "
                "its own weight cs.UnderGravity(nodes, gravity_m_s2)",
                where="rest_shape",
            )
        if self.scan_conditions is not None:
            require_supported(parts)
        super().__init__(
            parts, tuple(forces), mesh=mesh, element=kind, evaluator=evaluator, threads=threads
        )
        # Lumped volume of every dof (3n,) for each part.
        self._lumped_m3 = [np.repeat(self._lumped_volume(part), 3) for part in self.parts]
        self.has_declared_mass = mass_kg is not None
        self.node_mass: Array = self._masses_with_densities([p.density_kg_m3 for p in self.parts])[
            ::3
        ]

    def __repr__(self) -> str:
        materials = ", ".join(f"{p.name or 'body'}: {p.material.name}" for p in self.parts)
        return (
            f"Body({len(self.nodes_m)} nodes, {len(self.cells)} {self.element.name}, "
            f"{self.mass_kg:.4g} kg, {materials})"
        )

    @property
    def scan_conditions(self) -> UnderGravity | None:
        """Gravity and held nodes during the scan of the mesh; None if the mesh counts as
        stress-free, also where `rest_shape` was not stated.
        """
        return self.rest_shape if isinstance(self.rest_shape, UnderGravity) else None

    @cached_property
    def inverse_equilibrium(self) -> InverseEquilibrium | None:
        return None if self.scan_conditions is None else InverseEquilibrium(self)

    def rest_shape_failure(self, theta: Theta) -> str | None:
        """Return the message of the `RestShapeError` at θ (k,), with a remedy; None if there is a
        stress-free shape, or if the mesh counts as stress-free.
        """
        if self.inverse_equilibrium is None:
            return None
        try:
            self.inverse_equilibrium.solve(theta)
        except RestShapeError as error:
            return error.message
        return None

    def stress_free_geometry(self, theta: Theta) -> Array:
        """Return shape gradients [1/m] and volumes [m³] (E, q, 3·nodes + 1) of the stress-free
        shape at θ (k,); `geometry` itself if the mesh counts as stress-free.

        Raises
        ------
        RestShapeError
            If no stress-free shape has the mesh as its equilibrium under gravity.
        """
        if self.inverse_equilibrium is None:
            return self.geometry
        return self._geometry_at(self.inverse_equilibrium.solve(theta).positions_m)

    def with_stress_free(self, positions_m: Array) -> Body:
        """Return a copy of this body with the same masses and another stress-free shape.

        The mesh and `nodes_m` stay the computational reference; only `geometry` is that of the new
        shape, and `rest_shape` is "stress_free". Kernels are built again at their first use.

        Parameters
        ----------
        positions_m : (n, 3)
            Stress-free positions of all nodes [m], mid nodes included.
        """
        other = self.with_geometry(self._geometry_at(positions_m))
        other.rest_shape = "stress_free"
        return other

    def with_stiffness_factors(self, factors: Array) -> Body:
        """Return a copy of this body with the same masses, in which the stress of each element is
        multiplied by a factor (E,), with its damping and memory.

        Kernels are built again at their first use.
        """
        geometry = self.geometry.copy()
        geometry[..., -1] *= factors[:, None]
        return self.with_geometry(geometry)

    @cached_property
    def natural_strain_indices(self) -> list[int]:
        """Indices in θ of the natural curvatures and twists."""
        names = {constant.name for constant in NATURAL_STRAINS + NATURAL_ENDS}
        return [k for k, name in enumerate(self.constants) if name.split(".")[-1] in names]

    def partly_straightened(self, share: float) -> Body:
        """Return a rod that is straight at rest with a share of the change of its rest shape from the
        shape of its nodes, in which it has no stress at the share 0; other bodies as they are.
        """
        geometry = self.mesh.partly_straightened(self.cells, self.geometry, share)
        return self if geometry is self.geometry else self.with_geometry(geometry)

    def with_geometry(self, geometry: Array) -> Body:
        """Return a copy of this body with the same masses and another geometry (E, q, 3·nodes + 1)."""
        other = copy(self)
        other.geometry = geometry
        for name in self._list_cached_names() - {"pattern", "part_of_cells"}:
            vars(other).pop(name, None)
        other._evaluators = {}
        other._framed = {}
        return other

    def _geometry_at(self, positions_m: Array) -> Array:
        """Shape gradients and volumes (E, q, 3·nodes + 1) with nodes at other positions (n, 3)."""
        return self.mesh.geometry_at(positions_m, self.cells, self.geometry)

    def stress_free_mesh(self, theta: Theta) -> TetMesh:
        """Return the mesh in its stress-free shape at θ (k,), without mid nodes; `mesh` itself if
        that is stress-free.

        Raises
        ------
        RestShapeError
            If no stress-free shape has the mesh as its equilibrium under gravity.
        """
        if self.inverse_equilibrium is None:
            return self.mesh
        positions_m = self.inverse_equilibrium.solve(theta).positions_m[: len(self.mesh.points_m)]
        mesh = self.mesh
        return TetMesh(
            positions_m,
            mesh.tetrahedra,
            point_arrays=mesh.point_arrays,
            cell_arrays=mesh.cell_arrays,
            face_sets=mesh.face_sets,
        )

    @property
    def density_indices(self) -> list[int]:
        """Indices in θ of the free densities, in the order of the parts; empty if all
        are stated.
        """
        pairs = zip(self.parts, self._gamma_m_indices, strict=True)
        return [place + 1 for part, place in pairs if part.has_free_density]

    def __getstate__(self) -> dict[str, Any]:
        # Kernels belong to this process, and cached properties are computed again.
        state = {n: v for n, v in vars(self).items() if n not in self._list_cached_names()}
        return state | {"_evaluators": {}, "_framed": {}}

    def _list_cached_names(self) -> set[str]:
        return {n for n in vars(self) if isinstance(getattr(type(self), n, None), cached_property)}

    def _lumped_volume(self, part: BodyPart, shares: ArrayLike = 1.0) -> Array:
        """Lumped volume (n,) of a part [m³], in the mesh; zero at nodes outside the part."""
        volumes_m3 = self.cell_volumes_m3[part.cells] * np.asarray(shares)
        volume = np.zeros(len(self.nodes_m))
        np.add.at(volume, self.cells[part.cells], volumes_m3[:, None] * self.element.mass_shares)
        return volume

    def with_free_densities(self, parts: Collection[str]) -> Body:
        """Return a body with the densities of exactly these parts among its constants.

        Parameters
        ----------
        parts : collection of str
            Names of the parts; "" for the cells outside all regions. Densities of all other parts
            have their stated values; names that no part has are ignored.

        Returns
        -------
        Body
            This body itself if the densities of exactly these parts are free already.
        """
        free = tuple(
            part
            if (part.name in parts) == part.has_free_density
            else replace(part, has_free_density=part.name in parts)
            for part in self.parts
        )
        return self if free == self.parts else self.with_parts(free)

    @property
    def field_lengths_m(self) -> dict[str, float]:
        """Correlation lengths [m] of the fields, by the names of their constants; empty
        without fields.
        """
        return {part.field_name: part.field.length_m for part in self.parts if part.field}

    def with_field_lengths(self, lengths_m: Mapping[str, float]) -> Body:
        """Return a copy of this body with other correlation lengths [m] of its fields, by the names
        of the fields' constants (keys of `field_lengths_m`).

        Other names are ignored; a field without a length is a KeyError.
        """
        fields = (
            part.field and part.field.with_length(lengths_m[part.field_name]) for part in self.parts
        )
        return self.with_parts(
            tuple(replace(part, field=own) for part, own in zip(self.parts, fields, strict=True))
        )

    def with_parts(
        self, parts: tuple[BodyPart, ...], forces: tuple[NodeForce, ...] | None = None
    ) -> Body:
        """Return a copy of this body with other parts, in the same number and with the same cells,
        and other custom forces if they are given.

        Friction coefficients stay, and so do stated masses (`node_mass`) and
        obstacle frames; θ and everything that depends on it follow the new parts.
        """
        other = copy(self)
        for name in self._list_cached_names() - {"pattern", "shape_gradients", "part_of_cells"}:
            vars(other).pop(name, None)
        forces = self.forces if forces is None else forces
        ConstantsModel.__init__(other, parts, forces=forces, frictions=self.frictions)
        other._evaluators = {}
        other._framed = {}
        return other

    def with_frames(
        self, count: int, has_skew_frame_forces: bool = False, frictions: tuple[Constant, ...] = ()
    ) -> Body:
        """Return this body with the frames of obstacles: four further nodes each, which no cell
        has.

        The nodes are at `frame_nodes_m`, after all others, and have no mass. Frames and friction
        coefficients that the body already has are replaced, not extended. The result is this body
        itself if nothing changes, and the same object for the same arguments.

        Parameters
        ----------
        count : int
            Number of obstacles; 0 removes all frames.
        has_skew_frame_forces : bool
            Whether derivatives of the forces between the body and the frames have a skew part.
        frictions : tuple of Constant
            Friction coefficients that are parameters; the last entries of θ.
        """
        key = count, has_skew_frame_forces, frictions
        if key == (len(self.frames), self.has_skew_frame_forces, self.frictions):
            return self
        if key not in self._framed:
            other = copy(self)
            for name in self._list_cached_names() - {"part_of_cells", "frame_nodes_m"}:
                vars(other).pop(name, None)
            ConstantsModel.__init__(other, self.parts, forces=self.forces, frictions=frictions)
            other.has_skew_frame_forces = has_skew_frame_forces
            other._evaluators = {}
            first = len(self.nodes.points_m)
            added = np.tile(self.frame_nodes_m, (count, 1))
            other.frames = first + np.arange(4 * count).reshape(count, 4)
            other.nodes_m = np.vstack([self.nodes.points_m, added])
            other._lumped_m3 = [
                np.append(each[: 3 * first], np.zeros(added.size)) for each in self._lumped_m3
            ]
            other.node_mass = np.append(self.node_mass[:first], np.zeros(len(added)))
            self._framed[key] = other
        return self._framed[key]

    @cached_property
    def frame_nodes_m(self) -> Array:
        """Positions (4, 3) of the frame of an obstacle before it moves [m]: its origin in the
        centre of the body's bounding box, and the ends of its axes, a quarter of the box's shortest
        side away.
        """
        low = self.nodes.points_m.min(axis=0)
        high = self.nodes.points_m.max(axis=0)
        axes = np.vstack([np.zeros(3), np.eye(3) * (high - low).min() / 4])
        return (low + high) / 2 + axes

    @cached_property
    def stresses(self) -> StressEvaluator:
        """Stresses at the quadrature points of the parts with memory."""
        return StressEvaluator(self)

    @cached_property
    def elastic_indices(self) -> list[int]:
        """Indices in θ on which the long-term stress depends: constants of the materials, and
        coefficients of fields that scale a constant of the material or the damping law.
        """
        indices: list[int] = []
        for part, start, modes in zip(self.parts, self.starts, self.field_slices, strict=False):
            indices += [*range(start, start + len(part.material.constants))]
            indices += [*range(modes.start, modes.stop)] if part.stress_field else []
        return indices

    @property
    def mass_kg(self) -> float:
        """Total mass with the stated densities [kg], without tied masses; free densities and
        density fields do not change it.
        """
        return float(self.node_mass.sum())

    @cached_property
    def mass_derivatives(self) -> dict[int, Array]:
        """Derivatives of the mass of every dof (3n,), by the index in θ.

        These are ∂M/∂ρ [m³] for free densities, and the derivatives by the coefficients of the
        field of a density [kg].
        """
        return {place: slope for own in self._mass_slopes for place, slope in own.items()}

    @cached_property
    def _mass_slopes(self) -> list[dict[int, Array]]:
        """For each part ∂mass (3n,) by index in θ: [m³] by a density, [kg] by a field."""
        slopes: list[dict[int, Array]] = []
        places = zip(self._gamma_m_indices, self.field_slices, strict=True)
        for part, (gamma, modes), volume in zip(self.parts, places, self._lumped_m3, strict=True):
            slopes.append({gamma + 1: volume} if part.has_free_density else {})
            if part.field is not None and part.stress_field is None:
                shares = part.density_kg_m3 * part.field.shapes.T
                lumped = (np.repeat(self._lumped_volume(part, share), 3) for share in shares)
                slopes[-1] |= dict(zip(range(modes.start, modes.stop), lumped, strict=True))
        return slopes

    def densities(self, theta: Theta) -> list[float]:
        """Return the mean density of each part at θ (k,) [kg/m³]: the entry of θ if it is free,
        else the stated value, which a density field does not change.
        """
        return [
            float(theta[place + 1]) if part.has_free_density else part.density_kg_m3
            for part, place in zip(self.parts, self._gamma_m_indices, strict=True)
        ]

    def mass_of_dofs(self, theta: Theta) -> Array:
        """Return the lumped mass (3n,) of every degree of freedom at θ (k,) [kg], without tied
        masses; zero at nodes of obstacle frames.
        """
        if not self.mass_derivatives:
            return self.dof_mass
        return np.sum(self._part_masses(theta), axis=0)

    def mass_problem(self, theta: Theta) -> str | None:
        """Return a message with a remedy if the mass of a node at θ (k,) is not positive, which
        free densities and density fields can cause; None otherwise.
        """
        if not self.mass_derivatives:
            return None
        masses = np.array(self._part_masses(theta))[:, ::3]
        # Nodes of obstacle frames have no mass.
        total = np.where(self.sum_dof_volumes_m3()[::3] > 0, masses.sum(axis=0), np.inf)
        node = int(total.argmin())
        if total[node] > 0:
            return None
        part = self.parts[masses[:, node].argmin()]
        density = part.full_name(DENSITY.name)
        remedy = "state a larger density"
        if part.field is not None and part.stress_field is None:
            remedy = "lower the amplitude of its field to 0.3 or less, or its field_1, field_2, …"
        return (
            f"node {node} has the mass {total[node]:.2g} kg, because {density} is too low near it; "
            f"expected masses above zero: {remedy}"
        )

    def _part_masses(self, theta: Theta) -> list[Array]:
        """Mass of every dof (3n,) [kg] of each part, without tied masses."""
        masses = []
        for part, volume, slopes in zip(
            self.parts, self._lumped_m3, self._mass_slopes, strict=True
        ):
            density = 0.0 if part.has_free_density else part.density_kg_m3
            masses.append(sum((theta[k] * slope for k, slope in slopes.items()), density * volume))
        return masses

    def _masses_with_densities(self, densities: Sequence[float]) -> Array:
        """Mass of every dof (3n,) [kg] for densities [kg/m³] of the parts, without tied masses."""
        return np.sum([d * v for d, v in zip(densities, self._lumped_m3, strict=True)], axis=0)

    @cached_property
    def placed_forces(self) -> tuple[LocatedForce, ...]:
        """Custom forces on their nodes or faces, in the order of `forces`; a force without `nodes`
        acts on all nodes. Constants of each are the entries of θ after those of the parts.
        """
        volume = self.sum_dof_volumes_m3()[::3]
        first = self.starts[-1]
        placed = []
        for force in self.forces:
            columns = first + np.arange(len(force.constants))
            first += len(columns)
            nodes = np.arange(len(self.nodes_m)) if force.nodes is None else force.nodes
            nodes = self.select(nodes) if isinstance(nodes, Selection) else np.unique(nodes)
            placed.append(
                LocatedForce.on_mesh(
                    force, self.nodes, chosen=nodes, volume_m3=volume, columns=columns
                )
            )
        return tuple(placed)

    @cached_property
    def unit_air_drag(self) -> LocatedForce:
        """Drag on the surface in a fluid of density 1 kg/m³, see `node_force`."""
        return placed_unit_drag(self.nodes, self.sum_dof_volumes_m3()[::3])

    def sum_dof_volumes_m3(self) -> Array:
        """Return the lumped volume (3n,) of every degree of freedom [m³]."""
        return np.sum(self._lumped_m3, axis=0)

    @cached_property
    def dof_mass(self) -> Array:
        """Lumped mass (3n,) of every degree of freedom with the stated densities [kg]."""
        return np.repeat(self.node_mass, 3)

    def joint_pattern_with(self, couplings: Sequence[SymmetricPattern]) -> JointPattern:
        """Return the union of the mesh graph with further couplings of nodes and those of custom
        forces.

        Parameters
        ----------
        couplings : sequence of SymmetricPattern
            Couplings of the same dofs by other forces.
        """
        custom = (placed.points.couplings for placed in self.placed_forces)
        return JointPattern.from_patterns((self.pattern, *couplings, *custom))

    # One state ------------------------------------------------------------------------------

    def energy(self, positions: ArrayLike, **constants: float) -> float:
        """Return the elastic energy Ψ [J] at (n, 3) node positions [m].

        The constants are those of the materials, or moduli in their place: ``young_pa=1e4,
        poisson=0.3``. All others are zero.

        Raises
        ------
        InputError
            If an elastic constant is missing or unknown, or there are several states.
        """
        x = self._state(positions)
        return float(self._evaluate("energy", [x], theta=self.elastic_theta(constants))[0, 0])

    def elastic_force(self, positions: ArrayLike, **constants: float) -> Array:
        """Return the elastic force −∂Ψ/∂x, (n, 3) [N], at (n, 3) node positions [m].

        See `energy` for the constants and errors.
        """
        x = self._state(positions)
        force = self._evaluate("force", [x, np.zeros_like(x)], theta=self.elastic_theta(constants))
        return force.reshape(-1, 3)

    def stiffness(self, positions: ArrayLike, **constants: float) -> sp.csc_array:
        """Return the stiffness K = ∂²Ψ/∂x², sparse (3n, 3n) [N/m], at (n, 3) node positions [m].

        Both triangles are stored. Row 3i + j is coordinate j of node i. See `energy` for the
        constants and errors.
        """
        x = self._state(positions)
        theta = self.elastic_theta(constants)
        return self.pattern.matrix(-self.linearise(x, np.zeros_like(x), theta=theta).by_position[0])

    # One time step --------------------------------------------------------------------------

    @validated
    def step_function(
        self, scheme: str | Scheme = "midpoint", row: AtLeastOne | None = None
    ) -> ca.Function:
        """Return the discrete equation of motion of one time step as a CasADi function (SX), for
        programs of one's own and C code.

        Its inputs are positions x_t, x_{t−1}, … (3n,) [m], from "x", "x_1", … back to the largest
        lag of the scheme, external forces "u" (3n,) [N], constants "theta" (k,) in the order of
        `constants`, and the time step "step_s" [s]. Its output "c" (3n,) [N] is zero for a motion of
        dofs that are not held, and minus the force of the hand for others:

            c_t = Σ_j w_j f(ξ_{t−j}, ν_{t−j}; θ) + u_t − M a_t,

        see `schemes`. External forces include the weight, m g; with forces that change, u_t is
        Σ_j w_j times that of evaluation t − j. The expression sums all elements: use it for bodies
        of up to some hundred.

        Parameters
        ----------
        scheme : str or Scheme
            Time discretisation.
        row : int, optional
            Index of one of the first rows, from 1, whose equation reaches back to x_0 only; those
            that need the velocity at the start have the input "v_0" (3n,) [m/s] before "u". The
            regular equation by default.

        Raises
        ------
        InputError
            For an unknown scheme, or a body with memory, a field, forces of its own or a mesh that
            was scanned under gravity.
        """
        has = {
            "memory (prony)": self.has_memory,
            "a field": any(part.field is not None for part in self.parts),
            "forces of its own": bool(self.forces),
            "a mesh scanned under gravity": self.scan_conditions is not None,
        }
        if unsupported := [name for name, is_there in has.items() if is_there]:
            raise InputError(
                f"the body has {' and '.join(unsupported)}, whose equations of motion are no function "
                "of positions alone; expected a body without"
            )
        theta = ca.SX.sym("theta", len(self.constants))
        masses = [ca.SX(mass) for mass in self._part_masses(cast(Any, theta))]
        damping = sum(
            (
                theta[gamma] * mass
                for gamma, mass in zip(self._gamma_m_indices, masses, strict=True)
            ),
            ca.SX.zeros(self.pattern.size),
        )

        def force(xi: ca.SX, nu: ca.SX) -> ca.SX:
            return element_forces(self, xi, nu, theta) - damping * nu

        total = sum(masses[1:], masses[0])
        return step_function(force, total, theta, as_scheme(scheme), row)

    # Many states ----------------------------------------------------------------------------

    def force(
        self,
        positions: ArrayLike,
        velocities: ArrayLike,
        theta: Theta,
        tied_kg: Array | None = None,
        memory_input: MemoryInput | None = None,
    ) -> Array:
        """Return the internal force f(x, v; θ), (T, 3n) [N]: elastic, viscous and −γ_m M v.

        Weight and custom forces are not included.

        Parameters
        ----------
        positions, velocities : (T, n, 3), (T, 3n) or one state (n, 3)
            Positions [m] and velocities [m/s].
        theta : (k,)
            Constants in the order of `constants`.
        tied_kg : (3n,) or (T, 3n), optional
            Tied masses [kg], which γ_m damps beside the mass of the body; None for no tied mass.
        memory_input : MemoryInput, optional
            Internal variables of a body with memory; None for relaxed memory, without overstress
            and stiffening.

        Raises
        ------
        InputError
            If θ or the node fields have the wrong size.
        RestShapeError
            If the mesh is a shape under gravity and no stress-free shape exists at θ.
        """
        x, v = self._states(positions, velocities)
        internal = self._evaluate("force", [x, v], theta=theta, memory_input=memory_input)
        return internal - self._damping_coefficients(theta, tied_kg) * v

    def mean_stresses(
        self,
        x: Array,
        v: Array,
        theta: Array,
        velocity_slope: float = 0.0,
        memory_input: MemoryInput | None = None,
    ) -> Array:
        """Return the mean stress σ = tr(Cauchy stress)/3 (E,) [Pa] of each element at one state.

        It follows from the forces of the element on its nodes: 3 v σ = −Σ_a f_a · x_a, with its
        current volume v.

        Parameters
        ----------
        x, v : (1, 3n)
            Positions [m] and velocities [m/s].
        theta : (k,)
        velocity_slope : float
            Derivative of the velocities by the positions [1/s]. Rayleigh's forces −γ_r K v then
            count with the stress that their derivative K contains.
        memory_input : MemoryInput, optional
            Internal variables, see `force`.
        """
        forces = self._evaluate("element_force", [x, v], theta, memory_input=memory_input)
        if velocity_slope and (rates := self._rayleigh_rates(theta)).any():
            elastic = self._evaluate(
                "element_force", [x, np.zeros_like(x)], theta, memory_input=memory_input
            )
            shares = np.repeat(velocity_slope * rates, 3 * self.element.nodes)
            forces = forces + shares * elastic
        at_nodes = x.reshape(-1, 3)
        by_node = forces.reshape(len(self.cells), -1, 3)
        virials = np.zeros(len(self.cells))
        for part in self.parts:
            nodes, _ = self.part_elements(part)
            virials[part.cells] = np.einsum("eai,eai->e", by_node[part.cells], at_nodes[nodes])
        volumes = (self.volume_ratios(x)[0] * self.geometry[..., -1]).sum(axis=1)
        return -virials / (3 * volumes)

    def resultants(self, x: Array, v: Array, theta: Theta, velocity_slope: float = 0.0) -> Array:
        """Return the stresses times volume (T, any) [J] of the elements of a rod, see `mean_stresses`.

        Parameters
        ----------
        x, v : (T, 3n)
        """
        stresses = self._evaluate("resultants", [x, v], theta)
        shares = 1 + velocity_slope * self._rayleigh_rates(np.asarray(theta))
        return stresses * np.repeat(shares, stresses.shape[1] // shares.shape[-1], axis=-1)

    def resultant_stiffness(self, x: Array, resultants: Array, theta: Theta) -> Array:
        """Return the lower triangles (T, m) of Σ s ∂²ε/∂x² [N/m] with strains ε of a rod at positions
        x (T, 3n) [m] and their stresses times volume s (T, any) [J], which do not change.
        """
        return self._evaluate("resultant_stiffness", [x], theta, resultants=resultants)

    def _rayleigh_rates(self, theta: Array) -> Array:
        """Return γ_r (E,) [s] of the elements with Rayleigh damping, 0 for others."""
        rates = np.zeros((*theta.shape[1:-1], len(self.cells)))
        for part, values in zip(self.parts, self.split_theta(theta), strict=False):
            if part.damping.name == "rayleigh":
                rates[..., part.cells] = values[len(part.material.constants)]
        return rates

    def linearise(
        self,
        positions: ArrayLike,
        velocities: ArrayLike,
        theta: Theta,
        out: Array | None = None,
        tied_kg: Array | None = None,
        memory_input: MemoryInput | None = None,
    ) -> Linearisation:
        """Return the internal force and its first derivatives at T states, see `force`.

        The internal variables of a memory are constant in the derivatives; `model.viscoelasticity`
        provides derivatives by them.

        Parameters
        ----------
        positions, velocities : (T, n, 3), (T, 3n) or one state (n, 3)
            Positions [m] and velocities [m/s].
        theta : (k,)
            Constants in the order of `constants`.
        out : (T, linearisation_width), optional
            Contiguous memory for the result, overwritten. All returned arrays are views of it, or
            of new memory if None.
        tied_kg : (3n,) or (T, 3n), optional
            Tied masses [kg], which γ_m damps beside the mass of the body; None for no tied mass.
        memory_input : MemoryInput, optional
            Internal variables of a body with memory; None for relaxed memory, where derivatives by
            the constants of the memory are zero.

        Raises
        ------
        InputError
            If θ, the node fields or `out` have the wrong size.
        RestShapeError
            If the mesh is a shape under gravity and no stress-free shape exists at θ.
        """
        x, v = self._states(positions, velocities)
        rows = self._evaluate(
            "linearisation", [x, v], theta=theta, out=out, memory_input=memory_input
        )
        size = self.pattern.size
        entries = self.pattern.entry_count
        width = len(self.constants) * size
        # Slices: `numpy.split` takes as long as the elements of a small body.
        ends = list(accumulate([0, size, entries, entries, width]))
        end = self._width_without_fields("linearisation")
        force, by_position, by_velocity, by_theta, skew = (
            rows[:, start:stop] for start, stop in zip(ends, [*ends[1:], end], strict=True)
        )
        drag = self._damping_coefficients(theta, tied_kg)
        force -= drag * v
        by_velocity[:, self.pattern.diagonal] -= drag
        by_theta = by_theta.reshape(len(x), size, -1)
        for number, outputs in self._field_outputs("linearisation", rows):
            columns = self.field_slices[number]
            spread = self.field_assemblies[number]
            spread.assemble_nodal(outputs["by_theta"], out=by_theta[:, :, columns])
        for column, slope in self._damping_derivatives(theta, tied_kg):
            # A density also changes the stress-free shape of a mesh made under gravity.
            by_theta[:, :, column] += -slope * v
        self._apply_stiffening_chain_rule(by_theta, memory_input)
        return Linearisation(
            force,
            by_position,
            by_velocity=by_velocity,
            by_theta=by_theta,
            by_position_skew=skew,
            by_velocity_skew=skew[:, :0],
        )

    def _field_outputs(self, name: str, rows: Array) -> Iterator[tuple[int, dict[str, Array]]]:
        """Yield the index of each part with a field, and the outputs by the logarithm of each cell."""
        places = self.field_output_slices(name)
        for number in self.field_assemblies:
            yield (number, {out: rows[:, at] for (of, out), at in places.items() if of == number})

    def _apply_stiffening_chain_rule(
        self, by_theta: Array, memory_input: MemoryInput | None
    ) -> None:
        """From derivatives by s of each part to those by its memory constants, in place."""
        for first, columns in self._memory_columns:
            if memory_input is None:
                by_theta[..., columns] = 0.0
            else:
                slopes = memory_input.stiffening_derivatives[:, None, columns]
                by_theta[..., columns] = by_theta[..., first, None] * slopes

    @cached_property
    def _memory_columns(self) -> list[tuple[int, slice]]:
        """For each part with memory: index in θ of its first branch constant, slice of all."""
        firsts = [s + p.law_constant_count for p, s in zip(self.parts, self.starts, strict=False)]
        counts = [2 * len(part.prony) for part in self.parts]
        return [(f, slice(f, f + n)) for f, n in zip(firsts, counts, strict=True) if n]

    def second_derivatives(
        self,
        positions: ArrayLike,
        velocities: ArrayLike,
        weights: ArrayLike,
        theta: Theta,
        out: Array | None = None,
        tied_kg: Array | None = None,
        memory_input: MemoryInput | None = None,
    ) -> SecondDerivatives:
        """Return the second derivatives of φ = wᵀ f + σ·S at T states, see `SecondDerivatives` and
        `force`; ∂²φ/∂v² is empty, (T, 0).

        The internal variables of a memory are constant in the derivatives.

        Parameters
        ----------
        positions, velocities, weights : (T, n, 3), (T, 3n) or one state (n, 3)
            `weights` are the weights w of the forces.
        theta : (k,)
            Constants in the order of `constants`.
        out : (T, curvature_width), optional
            Contiguous memory for the result, overwritten; returned arrays may be views of it.
        tied_kg : (3n,) or (T, 3n), optional
            Tied masses [kg], which γ_m damps beside the mass of the body; None for no tied mass.
        memory_input : MemoryInput, optional
            Internal variables of a body with memory and the weights σ of the stress S. None for
            relaxed memory and σ = 0; without `stress_weights` σ = 0. Ignored if the body has no
            memory.

        Raises
        ------
        InputError
            If θ, the node fields or `out` have the wrong size.
        RestShapeError
            If the mesh is a shape under gravity and no stress-free shape exists at θ.
        """
        x, v, w = self._states(positions, velocities, weights)
        if self.has_memory:
            memory_input = memory_input or self.memory.relaxed(len(x))
        rows = self._evaluate(
            "curvature",
            [x, v, w],
            theta=theta,
            out=out,
            memory_input=_with_weights_appended(memory_input)
            if self.has_memory and memory_input is not None
            else None,
        )
        curvature = self._curvature_views(rows)
        for column, slope in self._damping_derivatives(theta, tied_kg):
            drag = -slope * w
            curvature.velocity_theta[:, :, column] += drag
            curvature.theta[:, column] += np.einsum("ti,ti->t", drag, v)
        self._set_field_curvature(curvature, rows)
        self._apply_stiffening_to_curvature(curvature, memory_input)
        for gamma, mass_slopes in zip(self._gamma_m_indices, self._mass_slopes, strict=True):
            for place, slope in mass_slopes.items():
                mixed = -np.einsum("ti,ti,i->t", w, v, slope)
                curvature.theta_theta[:, place, gamma] = mixed
                curvature.theta_theta[:, gamma, place] = mixed
        return curvature

    def _curvature_views(self, rows: Array) -> SecondDerivatives:
        """Rows (T, width) of the kernel "curvature" as views by meaning, without fields."""
        count = len(rows)
        size = self.pattern.size
        entries = self.pattern.entry_count
        k = len(self.constants)
        xx, xv, x_theta, v_theta, theta_theta, by_theta, skew = np.split(
            rows[:, : self._width_without_fields("curvature")],
            np.cumsum([entries, entries, k * size, k * size, k * k, k]),
            axis=1,
        )
        return SecondDerivatives(
            xx,
            xv,
            position_theta=x_theta.reshape(count, size, k),
            velocity_theta=v_theta.reshape(count, size, k),
            theta_theta=theta_theta.reshape(count, k, k),
            theta=by_theta,
            position_velocity_skew=skew,
            velocity_velocity=np.zeros((count, 0)),
        )

    def _set_field_curvature(self, curvature: SecondDerivatives, rows: Array) -> None:
        """Set derivatives by coefficients of fields from those by the logarithms of cells."""
        for number, outputs in self._field_outputs("curvature", rows):
            columns = self.field_slices[number]
            spread = self.field_assemblies[number]
            slopes = spread.field.shapes
            for output, by_nodes in (
                ("position_theta", curvature.position_theta),
                ("velocity_theta", curvature.velocity_theta),
            ):
                spread.assemble_nodal(outputs[output], out=by_nodes[:, :, columns])
            curvature.theta[:, columns] = outputs["gradient_theta"] @ slopes
            first = self.starts[number]
            count = self.parts[number].point_constant_count
            constants = slice(first, first + count)
            second = outputs["theta_theta"].reshape(len(rows), len(slopes), -1)
            mixed = np.einsum("tek,em->tkm", second[:, :, :count], slopes)
            curvature.theta_theta[:, constants, columns] = mixed
            curvature.theta_theta[:, columns, constants] = mixed.swapaxes(1, 2)
            curvature.theta_theta[:, columns, columns] = slopes.T @ (
                second[:, :, count, None] * slopes
            )

    def _apply_stiffening_to_curvature(
        self, curvature: SecondDerivatives, memory_input: MemoryInput | None
    ) -> None:
        theta_theta = curvature.theta_theta
        for values in (
            curvature.position_theta,
            curvature.velocity_theta,
            theta_theta,
            theta_theta.swapaxes(1, 2),
        ):
            self._apply_stiffening_chain_rule(values, memory_input)
        if memory_input is not None:
            for first, columns in self._memory_columns:
                bends = memory_input.stiffening_second_derivatives[:, columns, columns]
                theta_theta[:, columns, columns] += curvature.theta[:, first, None, None] * bends
        self._apply_stiffening_chain_rule(curvature.theta[:, None], memory_input)

    @cached_property
    def _gamma_m_indices(self) -> list[int]:
        """Index in θ of each part's γ_m; the density follows where it is free."""
        starts = zip(self.parts, self.starts, strict=False)
        return [start + (part.law_constant_count + 2 * len(part.prony)) for part, start in starts]

    @cached_property
    def tied_shares(self) -> dict[int, Array]:
        """Index in θ of each part's γ_m, and the part's fraction (3n,) of the mass at each dof."""
        return dict(zip(self._gamma_m_indices, self._tied_shares, strict=True))

    def tied_damping_rate(self, theta: Theta) -> Array:
        """Return the mass-proportional damping rate γ_m (3n,) of tied masses at every dof [1/s]."""
        return np.sum([theta[k] * share for k, share in self.tied_shares.items()], axis=0)

    def _damped_masses(self, theta: Theta, tied_kg: Array | None) -> Iterator[tuple[int, Array]]:
        """Yield for each part the index in θ of its γ_m and the mass (3n,) or (T, 3n) [kg]."""
        for k, damped in enumerate(self._part_masses(theta)):
            if tied_kg is not None:
                damped = damped + self._tied_shares[k] * tied_kg
            yield self._gamma_m_indices[k], damped

    @cached_property
    def _tied_shares(self) -> list[Array]:
        """Fraction (3n,) of each part in the stated mass at every dof."""
        parts = zip(self.parts, self._lumped_m3, strict=True)
        total_kg = np.where(self.dof_mass == 0, 1.0, self.dof_mass)  # frames have none
        return [part.density_kg_m3 * volume / total_kg for part, volume in parts]

    def _damping_coefficients(self, theta: Theta, tied_kg: Array | None) -> Array:
        """Return Σ γ_m M [N·s/m], (3n,) or, if `tied_kg` is, (T, 3n)."""
        # `numpy.sum` of a list takes longer than the products.
        return reduce(np.add, (theta[k] * mass for k, mass in self._damped_masses(theta, tied_kg)))

    def _damping_derivatives(
        self, theta: Theta, tied_kg: Array | None
    ) -> Iterator[tuple[int, Array]]:
        """Yield index in θ and derivative of Σ γ_m M by it; those of an index add up."""
        yield from self._damped_masses(theta, tied_kg)
        for gamma, own in zip(self._gamma_m_indices, self._mass_slopes, strict=True):
            yield from ((place, theta[gamma] * slope) for place, slope in own.items())


def _with_weights_appended(memory_input: MemoryInput) -> MemoryInput:
    """Return rows (T, 2 width) of H, then of the stress weights σ, zero where not given."""
    weights = memory_input.stress_weights
    if weights is None:
        weights = np.zeros_like(memory_input.overstress)
    return replace(memory_input, overstress=np.hstack([memory_input.overstress, weights]))
