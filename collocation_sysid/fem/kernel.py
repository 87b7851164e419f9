"""Kernels: contributions of the quadrature points of an element, as CasADi functions.

Before the product with the shape gradients a kernel depends only on F, Ḟ and similar gradients, the
symbols of a `QuadraturePoint`: g or g × g numbers, called its *pieces*, with g = 9 for the
deformation gradient of solids, and g = 3 c for elements whose gradient has c columns. A
`Contraction` states how pieces are multiplied with the shape gradients. Evaluators do this in
loops: written out for ten nodes it would be most of the instructions.

Most kernels are one sum over the points. In others a point depends on quantities of the whole
element, such as its volume. These have earlier `Phase`s, each with its sum over the points, and a
coupling: with the summed node vectors as columns of A (3·nodes, m), it adds A C to an output that
is contracted to node vectors, and the lower triangle of A D Aᵀ to an output that is a matrix.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import casadi as ca

from .chain_rule import ChainRule
from .elements import Element
from .rest_point_layout import RestPointLayout

# Product of a piece with the shape gradients. "none": no product; "nodes": from (g, k), conjugate
# to F, to (3·nodes, k); "pairs": from a symmetric (g, g) to the lower triangle of
# (3·nodes, 3·nodes).
Contraction = Literal["none", "nodes", "pairs"]
# Inputs that differ between the points of an element.
OF_POINTS = ("geometry", "carried")


@dataclass(frozen=True, eq=False)
class Phase:
    """One sum over the quadrature points of an element."""

    # One output for each piece. Inputs are the fields, geometry, θ, the internal variables of the
    # point if it has any, and, except in the first phase, one vector of all uncontracted outputs of
    # earlier phases.
    pieces: ca.Function
    contractions: dict[str, Contraction]  # dict of str to Contraction: contraction of each output

    @property
    def node_count(self) -> int:
        """Number of nodes per element."""
        return self.pieces.nnz_in(0) // 3

    @property
    def gradient_size(self) -> int:
        """Number g of entries of the gradient of a field at a point."""
        sizes = (
            self.pieces.size1_out(k)
            for k, how in enumerate(self.contractions.values())
            if how != "none"
        )
        return next(sizes, 9)

    @cached_property
    def function(self) -> ca.Function:
        """Function of the contribution of one point, with the contractions written out: inputs of
        `pieces`, and each contracted output as a dense column.
        """
        sx = self.pieces
        names = sx.name_in()
        inputs = [ca.SX.sym(name, sx.size1_in(k)) for k, name in enumerate(names)]
        geometry = inputs[names.index("geometry")]
        gradients = node_gradients(geometry, self.node_count, self.gradient_size // 3)
        outputs = [
            _contracted(piece, how, gradients=gradients)
            for piece, how in zip(sx.call(inputs), self.contractions.values(), strict=True)
        ]
        dense = [ca.densify(ca.vec(output)) for output in outputs]
        return ca.Function(sx.name(), inputs, dense, names, sx.name_out(), {"cse": True})

    def sum_over_points(self, *inputs: Any) -> list[Any]:
        """Return the sums over the points of an element, one column for each output.

        Inputs named in `OF_POINTS`, such as the geometry, have one column for each point; the
        others are the same at all points.
        """
        names = self.pieces.name_in()
        point_columns = {
            k: ca.horzsplit(inputs[k]) for k, name in enumerate(names) if name in OF_POINTS
        }
        count = len(point_columns[names.index("geometry")])
        points = [
            self.function.call(
                [
                    point_columns[k][p] if k in point_columns else each
                    for k, each in enumerate(inputs)
                ]
            )
            for p in range(count)
        ]
        return [sum(outputs[1:], outputs[0]) for outputs in zip(*points, strict=True)]


@dataclass(frozen=True, eq=False)
class ElementKernel:
    """Contribution of the quadrature points of an element, summed."""

    pieces: ca.Function  # pieces of the last phase, whose outputs are those of the kernel
    fields: tuple[str, ...]  # names of the first inputs, each 3·nodes long
    contractions: dict[str, Contraction]  # dict of str to Contraction: contraction of each output
    previous_phases: tuple[Phase, ...] = ()  # phases before the last one
    # dict of str to Contraction: further outputs of the last phase, which are summed for the
    # coupling only.
    coupled: dict[str, Contraction] = field(default_factory=dict)
    # C or D for each output, sparse, from the vector of all uncontracted sums: those of the earlier
    # phases, then of `coupled`.
    coupling: ca.Function | None = None

    @property
    def point_data_count(self) -> int:
        """Number of internal variables and other data of a point; 0 if the kernel has no
        such input.
        """
        names = self.pieces.name_in()
        return self.pieces.nnz_in(names.index("carried")) if "carried" in names else 0

    @cached_property
    def phases(self) -> tuple[Phase, ...]:
        """All phases, the last one included."""
        return (*self.previous_phases, Phase(self.pieces, self.contractions | self.coupled))

    @cached_property
    def serialized(self) -> str:
        """Serialised expressions and contractions, which identify the kernel."""
        functions = [phase.pieces for phase in self.phases]
        functions += [self.coupling] if self.coupling else []
        contractions = f"{[phase.contractions for phase in self.phases]}"
        return contractions + " ".join(function.serialize() for function in functions)

    def element_function(self, points: int) -> ca.Function:
        """Return the sum over an element of `points` points as a CasADi function.

        Its inputs are the fields, geometry (3·nodes + 1, points), θ and, if any, data of the
        points.
        """
        names = self.phases[0].pieces.name_in()
        inputs = [ca.MX.sym(n, self.pieces.size1_in(k)) for k, n in enumerate(names)]
        for place in (k for k, name in enumerate(names) if name in OF_POINTS):
            inputs[place] = ca.MX.sym(names[place], self.pieces.size1_in(place), points)
        size = 3 * self.phases[0].node_count
        sums = ca.MX(0, 1)
        vectors = ca.MX(size, 0)
        outputs: list[ca.MX] = []
        for phase in self.phases:
            totals = phase.sum_over_points(*inputs, *([sums] if sums.numel() else []))
            for key, total in zip(phase.contractions, totals, strict=True):
                if key in self.contractions:
                    outputs.append(total)
                elif phase.contractions[key] == "none":
                    sums = ca.vertcat(sums, total)
                else:
                    vectors = ca.horzcat(vectors, ca.reshape(total, size, -1))
        if self.coupling:
            couplings = self.coupling.call([sums])
            contractions = self.contractions.values()
            outputs = [
                _coupled(*each, vectors)
                for each in zip(outputs, couplings, contractions, strict=True)
            ]
        return ca.Function(self.pieces.name(), inputs, outputs, names, list(self.contractions))


def node_gradients(geometry: ca.SX, nodes: int, columns: int) -> ca.SX:
    """Return the shape gradients (nodes, `columns`) from the geometry of a point."""
    return ca.reshape(geometry[: columns * nodes], columns, nodes).T


def from_lower_triangle(matrix: ca.SX) -> ca.SX:
    """Return a matrix that is known to be symmetric from its lower triangle, to save
    computations.
    """
    return ca.tril2symm(ca.tril(ca.densify(matrix)))


def _coupled(output: ca.MX, coupling: ca.MX, how: Contraction, vectors: ca.MX) -> ca.MX:
    if how == "none":
        return output
    if how == "nodes":
        return output + ca.vec(vectors @ coupling)
    lower = ca.project(vectors @ coupling @ vectors.T, ca.Sparsity.lower(vectors.shape[0]))
    return output + lower.nz[:]


def _contracted(piece: ca.SX, how: Contraction, gradients: ca.SX) -> ca.SX:
    """Return a piece multiplied with the shape gradients (nodes, c) by its contraction."""
    if how == "none":
        return piece
    nodes = gradients.shape[0]
    half = ca.vertcat(*[_at_node(piece, gradients[a, :]) for a in range(nodes)])
    if how == "nodes":
        return half
    # By symmetry the (3·nodes, g) just found, read along its rows, has the columns contracted.
    columns = []
    for b in range(nodes):
        rows = half[3 * b : 3 * b + 3, :].T
        blocks = [_at_node(rows, gradients[a, :]) for a in range(b, nodes)]
        column_block = ca.vertcat(*blocks)
        columns += [column_block[j:, j] for j in range(3)]
    return ca.vertcat(*columns)


def _at_node(stress: ca.SX, gradient: ca.SX) -> ca.SX:
    """Return `stress` (g, k), conjugate to F, times the shape gradient (1, c): (3, k)."""
    columns = [ca.reshape(stress[:, k], 3, -1) @ gradient.T for k in range(stress.shape[1])]
    return ca.horzcat(*columns)


# Variables of a derivative of a scalar: none, one or two of "x", "v" and "theta", "theta" last.
By = tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Derivative:
    """Derivative of a scalar, as a summand of an output."""

    scalar: ca.SX  # scalar in the symbols of a `QuadraturePoint`
    by: By  # variables: none, one or two of "x", "v" and "theta", the last one last
    # Part of a second derivative by fields; "whole" requires that it is symmetric.
    part: Literal["whole", "symmetric", "skew"] = "whole"
    # Shorter expression of the derivative by the gradients of the fields, for elements that do not
    # average the dilatation.
    known: ca.SX | None = None

    def choose_contraction(self) -> Contraction:
        """Return the contraction of its piece: as many node indices as variables that are fields."""
        contractions: tuple[Contraction, ...] = ("none", "nodes", "pairs")
        return contractions[len(self.by) - self.by.count("theta")]

    def select_part(self, piece: ca.SX) -> ca.SX:
        """Return the part (symmetric, skew or whole) that `part` states of the piece (g, g) of a
        second derivative by two fields; the pieces of other derivatives are returned unchanged.
        """
        if self.choose_contraction() != "pairs":
            return piece
        if self.part == "whole":
            return from_lower_triangle(piece)
        if self.part == "symmetric":
            return from_lower_triangle((piece + piece.T) / 2)
        # Contracted in pairs, a piece gives the lower triangle of its transpose.
        return (piece.T - piece) / 2


# Derivatives that are summed in each output.
Outputs = dict[str, tuple[Derivative, ...]]
# Contraction and piece, in the symbols of a `QuadraturePoint`, of each output.
Pieces = dict[str, tuple[Contraction, ca.SX]]


@dataclass(frozen=True, eq=False)
class QuadraturePoint:
    """Symbols of one quadrature point."""

    nodes: int  # number of nodes of the element
    fields: dict[str, ca.SX]  # dict of str to SX: node fields (3·nodes,): x and, if needed, v and w
    # See `expressions`.
    geometry: ca.SX
    theta: ca.SX
    # dict of str to SX: gradients of the fields, Σ_a field_a ⊗ ∇N_a stacked column after column
    # (g,): F, Ḟ and W.
    gradients: dict[str, ca.SX]
    # If the element averages the dilatation: the logarithm m of the stretch that does so and, with
    # v, its derivative along v, and with w, those of both along w; see `mean_dilatation`.
    stretches: tuple[ca.SX, ...]
    # Internal variables of the point, see `memory`; with a field, its logarithm comes last.
    point_data: ca.SX
    # Indices in θ of the constants that a field multiplies, see `spatial_field`.
    scaled_indices: tuple[int, ...] = ()
    # Layout of a stress-free shape that is not the mesh, see `rest_shape`: its data are the last
    # ones of `point_data`, and the changes of its inputs the last entries of θ.
    rest: RestPointLayout | None = None
    # Energies that stand as symbols in expressions until `make_phase` replaces them; none by
    # default. Derivatives are taken with `gradient`, `jacobian` and `directional_derivative`.
    rule: ChainRule = field(default_factory=ChainRule)

    @classmethod
    def from_element(
        cls,
        element: Element,
        constants: int,
        *fields: str,
        internal_variable_count: int = 0,
        scaled: tuple[int, ...] = (),
        rest: RestPointLayout | None = None,
    ) -> QuadraturePoint:
        """Return the symbols of a quadrature point of an element.

        Parameters
        ----------
        constants : int
            Length of θ.
        *fields : str
            Node fields: "x", and if needed "v" and "w".
        internal_variable_count : int
            Number of internal variables.
        scaled : tuple of int
            Indices in θ of the constants that a field multiplies.
        rest : RestPointLayout, optional
            Layout of the data of the stress-free shape.
        """
        stretches = 2 ** (len(fields) - 1) if element.mean_dilatation else 0
        return cls(
            element.nodes,
            {name: ca.SX.sym(name, 3 * element.nodes) for name in fields},
            geometry=ca.SX.sym(
                "geometry", element.columns * element.nodes + element.rest_values + 1
            ),
            theta=ca.SX.sym("theta", constants),
            gradients={name: ca.SX.sym(f"gradient_{name}", 3 * element.columns) for name in fields},
            stretches=tuple(ca.SX.sym(f"stretch_{k}") for k in range(stretches)),
            point_data=ca.SX.sym(
                "carried",
                internal_variable_count + bool(scaled) + (rest.value_count if rest else 0),
            ),
            scaled_indices=scaled,
            rest=rest,
        )

    def scale_constants(self) -> ca.SX:
        """Return the constants θ at this point; those that a field scales are multiplied by its
        value.
        """
        constants = ca.SX(self.theta)
        for place in self.scaled_indices:
            constants[place] *= ca.exp(self.point_data[-1])
        return constants

    def stack_differentiated_constants(self) -> ca.SX:
        """Return the variables of derivatives by "theta": θ, and the logarithm of the field."""
        return ca.vertcat(self.theta, self.point_data[-1]) if self.scaled_indices else self.theta

    def select_internal_variables(self) -> ca.SX:
        """Return the internal variables, i.e. the data of the point without the logarithm of the
        field.
        """
        return self.point_data[:-1] if self.scaled_indices else self.point_data

    @property
    def column_count(self) -> int:
        """Number of columns of the gradients."""
        return next(iter(self.gradients.values())).numel() // 3

    @property
    def rest_values(self) -> ca.SX:
        """Values of the rest shape of elements that have some, and the volume; else empty."""
        data = self.geometry[self.column_count * self.nodes :]
        return data if data.numel() > 1 else ca.SX(0, 1)

    @property
    def mesh_volume(self) -> ca.SX:
        """Volume assigned to the point in the mesh [m³]."""
        return self.geometry[-1]

    def compute_volume(self) -> ca.SX:
        """Return the volume assigned to the point in the stress-free shape [m³]."""
        if self.rest is None:
            return self.mesh_volume
        return self.mesh_volume * ca.det(ca.reshape(self._expand_rest_values()[:9], 3, 3))

    def _expand_rest_values(self) -> ca.SX:
        """Return the values of the stress-free shape at this point, see `RestPointLayout`."""
        assert self.rest is not None
        data = self.point_data[self.point_data.numel() - self.rest.value_count :]
        changes = self.theta[self.theta.numel() - self.rest.input_count :]
        return self.rest.expand(data, changes)

    def compute_material_gradient(self) -> ca.SX:
        """Return the gradient (3, c) at which the material is evaluated: that of the deformation.

        It includes the averaged dilatation and the stress-free shape.
        """
        F = ca.reshape(self.gradients["x"], 3, -1)
        stretch = self.stretches[0] if self.stretches else None
        if self.rest is not None:
            values = self._expand_rest_values()
            F = F @ ca.inv_minor(ca.reshape(values[:9], 3, 3))
            if stretch is not None:
                stretch = stretch + values[9] / 3
        return F if stretch is None else ca.exp(stretch) * F

    def stack_strain_symbols(self) -> ca.SX:
        """Return the symbols of an energy that depend on x: F and m."""
        return ca.vertcat(self.gradients["x"], *self.stretches[:1])

    def gradient(self, scalar: ca.SX, by: ca.SX) -> ca.SX:
        """Return the gradient of a scalar by symbols (k,), including that through `rule`."""
        return self.rule.gradient(scalar, by)

    def jacobian(self, expression: ca.SX, by: ca.SX) -> ca.SX:
        """Return the derivative (m, k) of an expression (m,) by symbols (k,), including that
        through `rule`.
        """
        return self.rule.jacobian(expression, by)

    def directional_derivative(self, expression: ca.SX, by: ca.SX, direction: ca.SX) -> ca.SX:
        """Return the derivative of an expression by symbols (k,) along a direction (k,), including
        that through `rule`.
        """
        return self.rule.directional_derivative(expression, by, direction=direction)

    def compute_material_gradient_rate(self) -> ca.SX:
        """Return the derivative of `compute_material_gradient` along v, stacked (g,)."""
        return ca.jtimes(
            ca.vec(self.compute_material_gradient()),
            self.stack_strain_symbols(),
            ca.vertcat(self.gradients["v"], *self.stretches[1:2]),
        )

    def weigh_material_gradient(self) -> ca.SX:
        """Return the derivative of `compute_material_gradient` along w, stacked (g,)."""
        weights = ca.vertcat(self.gradients["w"], *self.stretches[2:3])
        return ca.jtimes(
            ca.vec(self.compute_material_gradient()), self.stack_strain_symbols(), weights
        )

    def weighted_derivative(self, scalar: ca.SX) -> ca.SX:
        """Return the directional derivative of a scalar that depends on x and v: its derivative by
        x along the weights w, at fixed v.
        """
        inputs = ca.vertcat(self.gradients["x"], *self.stretches[:2])
        direction = ca.vertcat(self.gradients["w"], *self.stretches[2:])
        return self.directional_derivative(scalar, inputs, direction=direction)

    def derivative(self, scalar: ca.SX, by: By) -> ca.SX:
        """Return a derivative of a scalar by zero, one or two variables; x, v and w stand for their
        gradients (g,), "theta" for the differentiated constants.

        Averaged stretches and other symbols are constant. The result is the scalar itself, a
        gradient as a column (k,), or the matrix (k, l) of second derivatives by the first and the
        second variable.
        """
        inputs = [
            self.stack_differentiated_constants() if name == "theta" else self.gradients[name]
            for name in by
        ]
        if not inputs:
            return scalar
        if len(inputs) < 2:
            return self.jacobian(scalar, inputs[0]).T
        return self.jacobian(self.gradient(scalar, inputs[0]), inputs[1])

    def make_phase(self, name: str, pieces: Pieces, sums: ca.SX | None = None) -> Phase:
        """Return a phase with these pieces.

        Parameters
        ----------
        name : str
            Name of the CasADi function.
        pieces : dict
            Contraction and piece of each output.
        sums : SX, optional
            Symbols of the sums of earlier phases on which the pieces depend.
        """
        inputs = {**self.fields, "geometry": self.geometry, "theta": self.theta}
        if self.point_data.numel():
            inputs["carried"] = self.point_data
        if sums is not None:
            inputs["sums"] = sums
        shape_gradients = node_gradients(self.geometry, self.nodes, self.column_count)
        gradients = [
            ca.vec(ca.reshape(field, 3, self.nodes) @ shape_gradients)
            for field in self.fields.values()
        ]
        expanded = self.rule.eliminate([piece for _, piece in pieces.values()])
        outputs = ca.substitute(
            [ca.densify(piece) for piece in expanded],
            [ca.vertcat(*self.gradients.values())],
            [ca.vertcat(*gradients)],
        )
        function = ca.Function(
            name, list(inputs.values()), outputs, list(inputs), list(pieces), {"cse": True}
        )
        return Phase(function, {key: how for key, (how, _) in pieces.items()})
