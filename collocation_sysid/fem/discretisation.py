"""Finite-element discretisation of a body: kernels of the laws of its parts over all elements.

`Discretisation` is the base class of `body.Body`. It builds evaluators of the element kernels and
lays their outputs out in one row for each time step; `Body` splits these rows into forces and
derivatives.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike

from ..common.array_types import Array, Index
from ..errors import InputError
from ..kinds.kind import Kind
from .elements import ELEMENTS, Element
from .expressions import KERNELS, PointLaw, energy_kernel
from .kernel import ElementKernel
from .kernels import COMPILING, Evaluator, EvaluatorChoice, KernelBatch, available_threads
from .laws.memory import MemoryInput, MemoryLayout
from .meshes.mesh import TetMesh
from .meshes.selection import Selection
from .node_force import NodeForce
from .pattern import SymmetricPattern, dofs_of, element_destinations, with_ascending_nodes
from .regions import BodyPart, ConstantsModel, Theta
from .rest_shape import InverseEquilibrium
from .spatial_field import FieldAssembly

# Outputs with columns for θ; a field adds derivatives by the logarithm of each cell.
BY_FIELD = {
    "linearisation": ("by_theta",),
    "curvature": ("position_theta", "velocity_theta", "theta_theta", "gradient_theta"),
}
# Kernels of evaluations that have another name.
KERNEL_NAMES = {"element_force": "force"}


class Discretisation(ConstantsModel):
    """Mesh of elements with quadrature points, and evaluators of sums over elements.

    Attributes
    ----------
    nodes_m : (n, 3)
        Undeformed node positions, including obstacle frames [m].
    frames : (k, 4)
        Indices of the nodes of obstacle frames; (0, 4) until `Body.with_frames` adds some.
    has_skew_frame_forces : bool
        Whether derivatives of the forces between the body and its frames have a skew part.
    cells : (E, nodes per element)
        Node indices of each element.
    geometry : (E, q, 3·nodes + 1)
        Shape gradients and volumes, see `elements.reference_geometry`, or `rods.rod_geometry`.

    Raises
    ------
    InputError
        For an unknown evaluator, memory in an element with mean dilatation, constants of
        equal names, or a material that the evaluator "simd" cannot evaluate.
    """

    def __init__(
        self,
        parts: tuple[BodyPart, ...],
        forces: tuple[NodeForce, ...],
        mesh: TetMesh,
        element: Element,
        evaluator: str,
        threads: int | None,
    ) -> None:
        super().__init__(parts, forces)
        self.mesh = mesh
        self.element: Element = element
        if self.has_memory and self.element.mean_dilatation:
            raise InputError(
                f"element '{element.name}' averages the volume change over each element and does not "
                "support materials with memory (prony); expected element 'tet10' or 'tet4', or a "
                "material without prony"
            )
        self.nodes = mesh.nodes_of(self.element)
        self.nodes_m: Array = self.nodes.points_m
        self.frames: Index = np.zeros((0, 4), dtype=np.int64)
        self.has_skew_frame_forces = False
        self._framed: dict[tuple[Any, ...], Any] = {}
        self.cells: Index = self.nodes.cells
        self.threads = threads or available_threads()
        self.geometry = mesh.geometry(self.nodes, self.element, [p.cells for p in parts])
        self.cell_volumes_m3: Array = self.geometry[..., -1].sum(axis=1)
        self._evaluators: dict[str, list[Evaluator]] = {}
        self._choice = EvaluatorChoice(evaluator)
        # Derivatives need no operations but those of the energy and the ones every evaluator has.
        for number in range(len(self.parts)):
            self._choice.check(energy_kernel(self.element, self.law(number)).pieces)

    def select(self, selection: Selection) -> Index:
        """Return the nodes of a `selection.Selection`, sorted.

        Boxes and balls select from all nodes. Indices and point arrays refer to nodes of the mesh;
        a node on an edge is selected if both ends of the edge are.

        Raises
        ------
        InputError
            If no node is selected.
        """
        return selection.resolve(self.nodes)

    @property
    def evaluator(self) -> str:
        """Evaluator of the element kernels: "simd" or "casadi"."""
        return self._choice.name

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences that state why the evaluator is "casadi" although "auto" was chosen; empty if
        the material is not the cause.
        """
        return self._choice.notes

    def make_evaluator(self, batch: KernelBatch) -> Evaluator:
        """Build the evaluator of a batch with the chosen kind of evaluator."""
        return self._choice.make_evaluator(batch)

    @cached_property
    def part_of_cells(self) -> Index:
        """Index of the part to which each cell belongs (E,)."""
        part_indices = np.zeros(len(self.cells), dtype=np.int64)
        for k, part in enumerate(self.parts):
            part_indices[part.cells] = k
        return part_indices

    def law(self, number: int, memory: bool = False) -> PointLaw:
        """Return the law of the quadrature points of a part.

        Parameters
        ----------
        number : int
            Index of the part.
        """
        part = self.parts[number]
        scaled = part.field.scaled_indices if part.field else ()
        rest = self.inverse_equilibrium.layout if self.inverse_equilibrium else None
        return PointLaw(
            part.material, part.damping, has_memory=memory, scaled_indices=scaled, rest=rest
        )

    @cached_property
    def inverse_equilibrium(self) -> InverseEquilibrium | None:
        """Solver of the stress-free shape; None if the mesh is stress-free."""
        return None

    def point_constants(self, number: int, theta: Theta) -> Array:
        """Return the constants (`PointLaw.constant_count`,) of the quadrature points of the part
        with index `number`, at θ (k,); at θ (k, T, 1) those of T bodies (T, any).

        These are the constants of material and damping law, of a part with memory also the first
        constant of its first branch, in whose place the caller sets the stiffening. For a
        stress-free shape that is not the mesh, changes of its inputs follow; they are zero, because
        the shape has been computed at this θ.
        """
        part_constants = np.asarray(self.split_theta(theta)[number], dtype=float)[
            : self.parts[number].point_constant_count
        ]
        if part_constants.ndim > 1:
            return np.ascontiguousarray(part_constants[..., 0].T)
        changes = np.zeros(
            self.inverse_equilibrium.layout.input_count if self.inverse_equilibrium else 0
        )
        return np.concatenate([part_constants, changes])

    def point_data(
        self,
        number: int,
        theta: Theta,
        internal_variables: Array | None = None,
        with_second_derivatives: bool = False,
    ) -> Array | None:
        """Return the data of the quadrature points of a part; None if they have none.

        These are the internal variables (T, any), followed by the logarithms of a field, the same
        at all times: (1, any) without internal variables. For a stress-free shape that is not the
        mesh they are its data (1, any), since such a body has neither memory nor field.

        Parameters
        ----------
        number : int
            Index of the part.
        theta : (k,)
        internal_variables : (T, any), optional
            Internal variables of the points; not used for a stress-free shape that is not the mesh.
        with_second_derivatives : bool
            Whether to include second derivatives of the stress-free shape; zero otherwise.

        Raises
        ------
        RestShapeError
            If the mesh is a shape under gravity and no stress-free shape exists at θ.
        """
        if self.inverse_equilibrium is not None:
            return self.inverse_equilibrium.point_data(theta, with_second_derivatives)[number]
        field = self.parts[number].stress_field
        if field is None:
            return internal_variables
        logs = field.logarithms(np.asarray(theta)[self.field_slices[number]])[None]
        if internal_variables is None:
            return logs
        return np.hstack(
            [internal_variables, np.broadcast_to(logs, (len(internal_variables), logs.shape[1]))]
        )

    @cached_property
    def field_assemblies(self) -> dict[int, FieldAssembly]:
        """Assembly of derivatives by fields, by the index of the part; only of parts whose stress
        depends on a field.
        """
        assemblies = {}
        for number, part in enumerate(self.parts):
            if part.stress_field is not None:
                cells, _ = self.part_elements(part)
                assemblies[number] = FieldAssembly(
                    part.stress_field, dofs_of(cells), size=self.pattern.size
                )
        return assemblies

    def part_elements(self, part: BodyPart) -> tuple[Index, Array]:
        """Return the nodes (E, nodes) and geometry (E, q, 3·nodes + 1) of the elements of a part,
        in the order of its kernels: ascending nodes in each element if its damping law has a
        stress. Shape gradients are by the axes of the fibres of each element, if it has any.
        """
        cells = self.cells[part.cells]
        geometry = self.material_geometry(part)
        if part.damping.stress is None:
            return cells, geometry
        # Ascending nodes make an element's lower triangle part of the global one: in a skew
        # matrix, the other triangle has the opposite sign.
        return with_ascending_nodes(cells, geometry)

    def material_geometry(self, part: BodyPart) -> Array:
        """Return the geometry (E, q, 3·nodes + 1) of the elements of a part with shape gradients by
        the axes of their fibres, R: the deformation gradient is then F R.
        """
        geometry = self.geometry[part.cells]
        if part.axes is None:
            return geometry
        gradients = geometry[..., :-1].reshape(*geometry.shape[:2], -1, 3) @ part.axes[:, None]
        return np.append(gradients.reshape(*geometry.shape[:2], -1), geometry[..., -1:], axis=2)

    def field_output_slices(self, name: str) -> dict[tuple[int, str], slice]:
        """Return the slices of a result row that hold derivatives by the logarithm z of each cell.

        Parameters
        ----------
        name : str
            Name of an evaluation; the result is empty unless `BY_FIELD` has it.

        Returns
        -------
        dict of (int, str) to slice
            By the index of the part and the name of the output, cell after cell. Each cell has one
            number for "gradient_theta" (∂φ/∂z), one for every dof of the cell for the outputs that
            are vectors by θ, and 2 c + 1 for "theta_theta" with the c constants of the points:
            ∂²φ/∂z∂θ (c), ∂²φ/∂z², and ∂²φ/∂θ∂z (c) again.
        """
        start = self._width_without_fields(name)
        slices = {}
        for number, spread in self.field_assemblies.items():
            cells, dofs = spread.dofs.shape
            theta_theta_size = 2 * self.parts[number].point_constant_count + 1
            sizes = {"theta_theta": theta_theta_size, "gradient_theta": 1}
            for output in BY_FIELD.get(name, ()):
                size = cells * sizes.get(output, dofs)
                slices[number, output] = slice(start, start + size)
                start += size
        return slices

    @property
    def has_memory(self) -> bool:
        """Whether any part has a memory."""
        return any(part.prony for part in self.parts)

    @cached_property
    def memory(self) -> MemoryLayout:
        """Layout of the internal variables of the parts with memory; of width zero if there are
        none.
        """
        first_indices = [
            s + p.law_constant_count for p, s in zip(self.parts, self.starts, strict=False)
        ]
        return MemoryLayout(
            self.parts,
            first_indices,
            points_per_element=self.geometry.shape[1],
            constant_count=len(self.constants),
        )

    @cached_property
    def is_unsymmetric(self) -> bool:
        """Whether a derivative of the forces by position or velocity can have a skew part: that of
        a damping law given as a stress, of forces on frames (`has_skew_frame_forces`), or of a
        custom force.
        """
        laws = any(part.damping.stress is not None for part in self.parts)
        return (
            laws
            or self.has_skew_frame_forces
            or any(f.has_skew_stiffness or f.has_skew_damping for f in self.forces)
        )

    @cached_property
    def pattern(self) -> SymmetricPattern:
        """Sparsity pattern of the stiffness matrix."""
        return SymmetricPattern.from_cells(self.cells, len(self.nodes_m))

    @cached_property
    def linearisation_width(self) -> int:
        """Length of one time step's row of `Body.linearise`."""
        return self._width("linearisation")

    @cached_property
    def curvature_width(self) -> int:
        """Length of one time step's row of `Body.second_derivatives`."""
        return self._width("curvature")

    def volume_ratios(self, positions: ArrayLike) -> Array:
        """Return J = det F at every quadrature point (T, E, q), at positions (n, 3) or (T, n, 3)
        [m].

        Elements with J ≤ 0 are inverted. F is relative to the mesh, also where the stress-free
        shape differs.
        """
        nodes = len(self.nodes_m)
        count, points = self.geometry.shape[:2]
        x = self._states(positions)[0].reshape(-1, nodes, 3)
        by_node = np.ascontiguousarray(x.transpose(1, 2, 0)).reshape(nodes, -1)
        slopes = (self.shape_gradients @ by_node).reshape(3, count * points, 3, len(x))
        a, b, c = slopes.transpose(0, 2, 1, 3)
        ratios = (
            a[0] * (b[1] * c[2] - b[2] * c[1])
            + a[1] * (b[2] * c[0] - b[0] * c[2])
            + a[2] * (b[0] * c[1] - b[1] * c[0])
        )
        return ratios.reshape(count, points, -1).transpose(2, 0, 1)

    def volume_stiffness(self, positions: Array, stress_pa: Array) -> Array:
        """Return the lower triangle (m,) of Σ_e σ_e ∂²v_e/∂x² [N/m], with the current volumes v_e of
        the elements at positions (3n,) [m] and stresses σ_e (E,) [Pa] that do not change.
        """
        at_nodes = positions.reshape(-1, 3)[self.cells]
        F = np.einsum("eai,eqaj->eqij", at_nodes, self.gradients, optimize=True)
        a, b, c = np.moveaxis(F, -1, 0)
        adjugate = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=-2)
        ratios = np.einsum("eqi,eqi->eq", a, adjugate[..., 0, :])
        spatial = self.gradients @ adjugate  # times the volume ratio
        weights = stress_pa[:, None] * self.geometry[..., -1] / ratios
        # ∂²v/∂x² of two nodes is the skew matrix of the vector product of their gradients.
        weighted = (spatial * weights[..., None, None]).transpose(3, 0, 2, 1)
        spatial = spatial.transpose(3, 0, 1, 2)
        products = np.stack([weighted[k - 2] @ spatial[k - 1] for k in range(3)], axis=1)
        upper, lower = np.triu_indices(self.element.nodes, 1)
        axial = (products - products.swapaxes(2, 3))[:, :, upper, lower]
        values = np.concatenate([-axial, axial], axis=1).ravel()
        summed = np.bincount(self._entries_of_pairs, values, minlength=self.pattern.entry_count)
        return np.asarray(summed, dtype=float)

    @cached_property
    def _entries_of_pairs(self) -> Index:
        """Positions in `pattern` of the entries of two nodes of each cell: of components (j, k) and
        then (k, j) for each i, where (i, j, k) is an even permutation.
        """
        size = 3 * self.element.nodes
        position = np.zeros((size, size), dtype=np.int64)
        columns, rows = np.triu_indices(size)
        position[columns, rows] = np.arange(len(rows))
        upper, lower = 3 * np.array(np.triu_indices(self.element.nodes, 1))
        j, k = np.array([[1, 2, 0], [2, 0, 1]])[:, :, None]
        of_cell = np.concatenate([position[upper + k, lower + j], position[upper + j, lower + k]])
        return element_destinations(self.pattern, self.cells)[1][:, of_cell].ravel()

    @property
    def kind(self) -> Kind:
        """Record of the kind of the body."""
        return self.mesh.kind

    @property
    def is_solid(self) -> bool:
        """Whether the body is a solid of tetrahedra, see `Kind.is_solid`."""
        return self.kind.is_solid

    @property
    def place_element(self) -> Element:
        """Element that interpolates positions at places on the body: that of the body itself, or
        unless it is a solid the linear tetrahedron.
        """
        return self.element if self.is_solid else ELEMENTS["tet4"]

    @property
    def place_cells(self) -> Index:
        """Nodes (k, any) of the elements that interpolate positions, see `place_element`."""
        return self.cells if self.is_solid else self.mesh.tetrahedra

    @property
    def part_of_place_cells(self) -> Index:
        """Index of the part to which each of `place_cells` belongs."""
        return self.part_of_cells[self.mesh.cell_of_tetrahedra]

    @property
    def gradients(self) -> Array:
        """Derivatives of the shape functions by position (E, q, nodes, 3) [1/m]."""
        nodes, columns = self.element.nodes, self.element.columns
        values = self.geometry[..., : nodes * columns]
        return values.reshape(*values.shape[:2], nodes, columns)[..., :3]

    @cached_property
    def shape_gradients(self) -> sp.csr_array:
        """Derivatives of the shape functions by position [1/m], sparse (3 E q, n): all quadrature
        points for axis x, element by element, then for y, then for z. Frame nodes have empty
        columns.
        """
        count, points = self.geometry.shape[:2]
        values = np.moveaxis(self.gradients, 3, 0)
        columns = np.broadcast_to(self.cells[:, None], values.shape)
        starts = np.arange(0, values.size + 1, self.element.nodes)
        shape = (3 * count * points, len(self.nodes_m))
        return sp.csr_array((values.ravel(), columns.ravel(), starts), shape=shape)

    # Assembly -------------------------------------------------------------------------------

    def _states(self, *fields: ArrayLike) -> list[Array]:
        """Return every node field as (T, 3n), contiguous; native code relies on these shapes."""
        nodes = len(self.nodes_m)
        arrays = [np.ascontiguousarray(field, dtype=float) for field in fields]
        for array in arrays:
            if array.size % (3 * nodes) or array.size != arrays[0].size:
                raise InputError(
                    "arrays with values at nodes have the shapes "
                    f"{', '.join(str(a.shape) for a in arrays)}; expected ({nodes}, 3) or (T, {nodes}, 3), "
                    "with the same number T of times in all"
                )
        return [array.reshape(-1, 3 * nodes) for array in arrays]

    def _state(self, positions: ArrayLike) -> Array:
        states = self._states(positions)[0]
        if len(states) != 1:
            raise InputError(
                f"found positions at {len(states)} times; expected those at one time, an array "
                f"({len(self.nodes_m)}, 3)"
            )
        return states

    def _evaluate(
        self,
        name: str,
        fields: Sequence[Array],
        theta: Theta,
        out: Array | None = None,
        memory_input: MemoryInput | None = None,
        resultants: Array | None = None,
    ) -> Array:
        """Evaluate a kernel on all parts and add up the results (T, width)."""
        if len(theta) != len(self.constants):
            raise InputError(
                f"found {len(theta)} values of constants; expected {len(self.constants)}, in this "
                f"order: {', '.join(self.constants)}"
            )
        with COMPILING:
            if name not in self._evaluators:
                batches = [self._batch(name, k) for k in range(len(self.parts))]
                self._evaluators[name] = [self.make_evaluator(batch) for batch in batches]
        width = self._width(name)
        shape = (len(fields[0]), width)
        if out is None:
            out = np.empty(shape)
        elif out.shape != shape or out.dtype != float or not out.flags.c_contiguous:
            raise InputError(f"out is {out.dtype} {out.shape}; expected contiguous float64 {shape}")
        theta = np.asarray(theta, dtype=float)
        for k, evaluate in enumerate(self._evaluators[name]):
            values = self.point_constants(k, theta)
            if not self.parts[k].prony or name == "energy":
                point_data = self.point_data(
                    k,
                    theta,
                    internal_variables=resultants,
                    with_second_derivatives=name == "curvature",
                )
                evaluate(
                    fields,
                    values,
                    out=out,
                    threads=self.threads,
                    add=k > 0,
                    data_of_points=point_data,
                )
                continue
            past = memory_input or self.memory.relaxed(len(out))
            for rows, values[-1] in past.equal_stiffening_rows(k):
                row_fields = [field[rows] for field in fields]
                point_data = self.point_data(k, theta, internal_variables=past.overstress[rows])
                evaluate(
                    row_fields,
                    values,
                    out=out[rows],
                    threads=self.threads,
                    add=k > 0,
                    data_of_points=point_data,
                )
        return out

    def _width(self, name: str) -> int:
        """Return the length of a result row of a kernel, including derivatives by fields."""
        ends = (place.stop for place in self.field_output_slices(name).values())
        return max(ends, default=self._width_without_fields(name))

    def _width_without_fields(self, name: str) -> int:
        k = len(self.constants)
        size = self.pattern.size
        entries = (2 + self.is_unsymmetric) * self.pattern.entry_count
        return {
            "energy": 1,
            "force": size,
            "element_force": 3 * self.cells.size,
            "linearisation": (1 + k) * size + entries,
            "curvature": 2 * k * size + entries + k * (k + 1),
            "resultants": self.element.stresses * len(self.cells),
            "resultant_stiffness": self.pattern.entry_count,
        }[name]

    def _batch(self, name: str, number: int) -> KernelBatch:
        part = self.parts[number]
        memory = bool(part.prony) and name != "energy"
        kernel = KERNELS[KERNEL_NAMES.get(name, name)](self.element, self.law(number, memory))
        cells, geometry = self.part_elements(part)
        destinations = self._destinations(name, number, cells=cells, kernel=kernel)
        columns = self._data_columns(name, number, points=geometry.shape[1])
        return KernelBatch(
            kernel,
            cells,
            geometry=geometry,
            destinations=destinations,
            width=self._width(name),
            data_columns=columns if columns.shape[-1] else None,
        )

    def _destinations(self, name: str, number: int, cells: Index, kernel: ElementKernel) -> Index:
        """Return the position (E, outputs) in a result row of every output of a kernel."""
        part = self.parts[number]
        vector, lower = element_destinations(self.pattern, cells)
        total = len(self.constants)
        count = len(cells)
        # γ_m and the density come after the constants of the points and need no elements.
        columns = self.starts[number] + np.arange(part.point_constant_count)
        if self.inverse_equilibrium is not None:
            # The inputs of the stress-free shape are entries of θ.
            columns = np.concatenate([columns, self.inverse_equilibrium.places])
        by_theta = (columns[:, None] + total * vector[:, None, :]).reshape(count, -1)
        square = (columns[:, None] + total * columns).ravel()
        # Positions and length of each kind of output.
        energy = np.zeros((count, 1), dtype=np.int64), 1
        nodal = vector, self.pattern.size
        if name == "element_force":
            dofs = 3 * self.element.nodes
            nodal = dofs * part.cells[:, None] + np.arange(dofs), self._width(name)
        matrix = lower, self.pattern.entry_count
        stresses = self.element.stresses
        of_cells = stresses * part.cells[:, None] + np.arange(stresses)
        nodal_by_theta = by_theta, total * self.pattern.size
        theta = np.broadcast_to(columns, (count, len(columns))), total
        theta_theta = np.broadcast_to(square, (count, len(square))), total**2
        places = {
            "energy": energy,
            "force": nodal,
            "by_position": matrix,
            "by_velocity": matrix,
            "by_theta": nodal_by_theta,
            "position_position": matrix,
            "position_velocity": matrix,
            "position_theta": nodal_by_theta,
            "velocity_theta": nodal_by_theta,
            "theta_theta": theta_theta,
            "gradient_theta": theta,
            "by_position_skew": matrix,
            "position_velocity_skew": matrix,
            "resultants": (of_cells, self._width(name)),
        }
        positions: dict[str, Index] = {}
        start = 0
        for output in kernel.contractions:
            place, length = places[output]
            positions[output] = place + start
            start += length
        field_slices = self.field_output_slices(name)
        for (part_index, output), field_slice in field_slices.items():
            if part_index == number:
                own = np.arange(field_slice.start, field_slice.stop)
                positions[output] = _with_field_columns(
                    positions[output],
                    own.reshape(count, -1),
                    output=output,
                    constants=part.point_constant_count,
                )
        return np.hstack(list(positions.values()))

    def _data_columns(self, name: str, number: int, points: int) -> Index:
        """Return the columns (E, q, m) of each point in a row of data; m = 0 without data."""
        if self.inverse_equilibrium is not None:
            return self.inverse_equilibrium.point_data_columns(number)
        part = self.parts[number]
        count = len(part.cells)
        columns = [np.zeros((count, points, 0), dtype=np.int64)]
        if name == "resultant_stiffness":
            of_cell = np.arange(self.element.stresses)
            return (len(of_cell) * part.cells[:, None] + of_cell)[:, None]
        width = 0
        if part.prony and name != "energy":
            own = self.memory.part_columns(number)
            for _ in range(2 if name == "curvature" else 1):
                columns.append(own + width)
                width += self.memory.width
        if part.stress_field is not None:
            logarithms = width + np.arange(count)[:, None, None]
            columns.append(np.broadcast_to(logarithms, (count, points, 1)))
        return np.concatenate(columns, axis=-1)


def _with_field_columns(places: Index, own: Index, output: str, constants: int) -> Index:
    """Return the positions (E, …) of derivatives by θ and by the logarithm of each cell."""
    if output != "theta_theta":
        return np.hstack([places, own])
    count = len(places)
    size = constants + 1
    positions = np.empty((count, size, size), dtype=np.int64)
    positions[:, :-1, :-1] = places.reshape(count, constants, constants)
    positions[:, -1] = own[:, :size]
    positions[:, :-1, -1] = own[:, size:]
    return positions.reshape(count, -1)
