"""Kernels: what the quadrature points of an element contribute, as CasADi functions.

Up to the last product with the shape gradients a kernel knows only F, Ḟ and the like, the symbols
of a `QuadraturePoint`: 9 or 9 × 9 numbers whatever the element, its *pieces*. How they meet the
shape gradients is told by a `Contraction`, which an evaluator may do in loops: written out for ten
nodes it is most of the instructions.

Most kernels are one sum over the points. In others a point needs to know of the whole element, such
as its volume. They have earlier `Phase`s, each a sum over the points of its own, and a coupling:
with A (3·nodes, m) holding the node vectors so summed, it adds A C to an output that is contracted
to node vectors, and the lower triangle of A D Aᵀ to one that is a matrix.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import casadi as ca

from .elements import Element
from .rest_point import RestPoint

# What becomes of a piece: nothing; (9, k), conjugate to F, to (3·nodes, k); or a symmetric (9, 9)
# to the lower triangle of (3·nodes, 3·nodes).
Contraction = Literal["none", "nodes", "pairs"]
# Inputs that differ between the points of an element.
OF_POINTS = ("geometry", "carried")


@dataclass(frozen=True, eq=False)
class Phase:
    """One sum over the quadrature points of an element.

    Attributes
    ----------
    pieces : casadi.Function
        Of the fields, geometry, θ, what a point carries if it has a memory and, unless it is the
        first phase, one vector of all outputs of earlier phases that are not contracted; one
        output for each piece.
    contractions : dict of str to Contraction
        For each output.
    """

    pieces: ca.Function
    contractions: dict[str, Contraction]

    @property
    def nodes(self) -> int:
        """Nodes per element."""
        return self.pieces.nnz_in(0) // 3

    @cached_property
    def function(self) -> ca.Function:
        """What one point contributes, contractions written out."""
        sx = self.pieces
        names = sx.name_in()
        inputs = [ca.SX.sym(name, sx.size1_in(k)) for k, name in enumerate(names)]
        gradients = node_gradients(inputs[names.index("geometry")], self.nodes)
        outputs = [
            _contracted(piece, how, gradients)
            for piece, how in zip(sx.call(inputs), self.contractions.values(), strict=True)
        ]
        dense = [ca.densify(ca.vec(output)) for output in outputs]
        return ca.Function(sx.name(), inputs, dense, names, sx.name_out(), {"cse": True})

    def over_points(self, *inputs: Any) -> list[Any]:
        """The sums, each in one column; what differs between points has a column for each."""
        names = self.pieces.name_in()
        own = {k: ca.horzsplit(inputs[k]) for k, name in enumerate(names) if name in OF_POINTS}
        count = len(own[names.index("geometry")])
        points = [
            self.function.call([own[k][p] if k in own else each for k, each in enumerate(inputs)])
            for p in range(count)
        ]
        return [sum(outputs[1:], outputs[0]) for outputs in zip(*points, strict=True)]


@dataclass(frozen=True, eq=False)
class PointKernel:
    """What the quadrature points of an element contribute.

    Attributes
    ----------
    pieces, contractions
        Of the last phase, whose outputs are the kernel's.
    fields : tuple of str
        Names of the inputs that come first, each 3·nodes long.
    earlier : tuple of Phase
    coupled : dict of str to Contraction
        Further outputs of the pieces, which are summed for the coupling alone.
    coupling : casadi.Function, optional
        C or D for each output, sparse, from the vector of all uncontracted sums: those of the
        earlier phases, then of `coupled`.
    """

    pieces: ca.Function
    fields: tuple[str, ...]
    contractions: dict[str, Contraction]
    earlier: tuple[Phase, ...] = ()
    coupled: dict[str, Contraction] = field(default_factory=dict)
    coupling: ca.Function | None = None

    @property
    def carried(self) -> int:
        """How many numbers a point carries from the past."""
        names = self.pieces.name_in()
        return self.pieces.nnz_in(names.index("carried")) if "carried" in names else 0

    @cached_property
    def phases(self) -> tuple[Phase, ...]:
        """All of them, the last one included."""
        return (*self.earlier, Phase(self.pieces, self.contractions | self.coupled))

    @cached_property
    def source(self) -> str:
        """What tells it from others."""
        functions = [phase.pieces for phase in self.phases]
        functions += [self.coupling] if self.coupling else []
        contractions = f"{[phase.contractions for phase in self.phases]}"
        return contractions + " ".join(function.serialize() for function in functions)

    def element_function(self, points: int) -> ca.Function:
        """The sum over an element, of fields, geometry (3·nodes + 1, points), θ and the like."""
        names = self.phases[0].pieces.name_in()
        inputs = [ca.MX.sym(n, self.pieces.size1_in(k)) for k, n in enumerate(names)]
        for place in (k for k, name in enumerate(names) if name in OF_POINTS):
            inputs[place] = ca.MX.sym(names[place], self.pieces.size1_in(place), points)
        size = 3 * self.phases[0].nodes
        sums, vectors = ca.MX(0, 1), ca.MX(size, 0)
        outputs: list[ca.MX] = []
        for phase in self.phases:
            found = phase.over_points(*inputs, *([sums] if sums.numel() else []))
            for key, total in zip(phase.contractions, found, strict=True):
                if key in self.contractions:
                    outputs.append(total)
                elif phase.contractions[key] == "none":
                    sums = ca.vertcat(sums, total)
                else:
                    vectors = ca.horzcat(vectors, ca.reshape(total, size, -1))
        if self.coupling:
            couplings = self.coupling.call([sums])
            hows = self.contractions.values()
            outputs = [
                _coupled(*each, vectors) for each in zip(outputs, couplings, hows, strict=True)
            ]
        return ca.Function(self.pieces.name(), inputs, outputs, names, list(self.contractions))


def node_gradients(geometry: ca.SX, nodes: int) -> ca.SX:
    """(nodes, 3) shape gradients."""
    return ca.reshape(geometry[: 3 * nodes], 3, nodes).T


def mirrored(matrix: ca.SX) -> ca.SX:
    """A matrix that is known to be symmetric, half of which need not be computed."""
    return ca.tril2symm(ca.tril(ca.densify(matrix)))


def _coupled(output: ca.MX, coupling: ca.MX, how: Contraction, vectors: ca.MX) -> ca.MX:
    if how == "none":
        return output
    if how == "nodes":
        return output + ca.vec(vectors @ coupling)
    lower = ca.project(vectors @ coupling @ vectors.T, ca.Sparsity.lower(vectors.shape[0]))
    return output + lower.nz[:]


def _contracted(piece: ca.SX, how: Contraction, gradients: ca.SX) -> ca.SX:
    if how == "none":
        return piece
    nodes = gradients.shape[0]
    half = ca.vertcat(*[_at_node(piece, gradients[a, :]) for a in range(nodes)])
    if how == "nodes":
        return half
    # By symmetry the (3·nodes, 9) just found, read along its rows, has the columns contracted.
    columns = []
    for b in range(nodes):
        rows = half[3 * b : 3 * b + 3, :].T
        blocks = [_at_node(rows, gradients[a, :]) for a in range(b, nodes)]
        whole = ca.vertcat(*blocks)
        columns += [whole[j:, j] for j in range(3)]
    return ca.vertcat(*columns)


def _at_node(stress: ca.SX, gradient: ca.SX) -> ca.SX:
    """Columns of (9, k), conjugate to F, times one node's shape gradient: (3, k)."""
    columns = [ca.reshape(stress[:, k], 3, 3) @ gradient.T for k in range(stress.shape[1])]
    return ca.horzcat(*columns)


# A derivative of a scalar: by none, one or two of x, v and θ, θ last.
By = tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Derivative:
    """A derivative of a scalar, as a summand of an output.

    Attributes
    ----------
    scalar : SX
        In the symbols of a `QuadraturePoint`.
    by : By
    part : {"whole", "symmetric", "skew"}
        Of a second derivative by fields; one that is taken whole is known to be symmetric.
    known : SX, optional
        The derivative by the fields' gradients, where nothing stretches, in a shorter form than
        differentiation finds.
    """

    scalar: ca.SX
    by: By
    part: Literal["whole", "symmetric", "skew"] = "whole"
    known: ca.SX | None = None

    @property
    def contraction(self) -> Contraction:
        """What becomes of its piece: it has as many node indices as fields."""
        hows: tuple[Contraction, ...] = ("none", "nodes", "pairs")
        return hows[len(self.by) - self.by.count("theta")]

    def of(self, piece: ca.SX) -> ca.SX:
        """What is taken of the (9, 9) piece of a second derivative by fields, any other whole."""
        if self.contraction != "pairs":
            return piece
        if self.part == "whole":
            return mirrored(piece)
        if self.part == "symmetric":
            return mirrored((piece + piece.T) / 2)
        # Contracted in pairs, a piece gives the lower triangle of its transpose.
        return (piece.T - piece) / 2


# The terms of each output.
Outputs = dict[str, tuple[Derivative, ...]]
# For each output its contraction, and its piece in the symbols of a `QuadraturePoint`.
Pieces = dict[str, tuple[Contraction, ca.SX]]


@dataclass(frozen=True, eq=False)
class QuadraturePoint:
    """Symbols of one quadrature point.

    Attributes
    ----------
    nodes : int
    fields : dict of str to SX
        (3·nodes,) of x and, where they are needed, v and w.
    geometry, theta : SX
        See `expressions`.
    gradients : dict of str to SX
        Of the fields, Σ_a field_a ⊗ ∇N_a stacked column after column (9): F, Ḟ and W.
    stretches : tuple of SX
        Where the element averages the dilatation, the logarithm m of the stretch that does so and,
        with v, its derivative along v, and with w, those of both along w; see `mean_dilatation`.
    carried : SX
        What the point brings from the past, see `memory`; with a field, the logarithm comes last.
    scaled : tuple of int
        Places in θ of the constants that a field multiplies, see `field`.
    rest : RestPoint, optional
        Layout of the stress-free shape, where that is not the mesh, see `rest_shape`: its numbers
        are the last ones carried, and the changes of its inputs the last entries of θ.
    """

    nodes: int
    fields: dict[str, ca.SX]
    geometry: ca.SX
    theta: ca.SX
    gradients: dict[str, ca.SX]
    stretches: tuple[ca.SX, ...]
    carried: ca.SX
    scaled: tuple[int, ...] = ()
    rest: RestPoint | None = None

    @classmethod
    def of(
        cls,
        element: Element,
        constants: int,
        *fields: str,
        carried: int = 0,
        scaled: tuple[int, ...] = (),
        rest: RestPoint | None = None,
    ) -> QuadraturePoint:
        """A point of an element, with θ of so many constants, that carries so many numbers."""
        stretches = 2 ** (len(fields) - 1) if element.mean_dilatation else 0
        return cls(
            element.nodes,
            {name: ca.SX.sym(name, 3 * element.nodes) for name in fields},
            ca.SX.sym("geometry", 3 * element.nodes + 1),
            ca.SX.sym("theta", constants),
            {name: ca.SX.sym(f"gradient_{name}", 9) for name in fields},
            tuple(ca.SX.sym(f"stretch_{k}") for k in range(stretches)),
            ca.SX.sym("carried", carried + bool(scaled) + (rest.count if rest else 0)),
            scaled,
            rest,
        )

    @property
    def constants(self) -> ca.SX:
        """θ as it is here."""
        here = ca.SX(self.theta)
        for place in self.scaled:
            here[place] *= ca.exp(self.carried[-1])
        return here

    @property
    def varied(self) -> ca.SX:
        """What derivatives by "theta" are by: θ, and the logarithm of the field."""
        return ca.vertcat(self.theta, self.carried[-1]) if self.scaled else self.theta

    @property
    def brought(self) -> ca.SX:
        """What is carried but the logarithm of the field."""
        return self.carried[:-1] if self.scaled else self.carried

    @property
    def mesh_volume(self) -> ca.SX:
        """The point's share of the element's volume in the mesh."""
        return self.geometry[3 * self.nodes]

    @property
    def volume(self) -> ca.SX:
        """The point's share of the element's volume free of stress."""
        if self.rest is None:
            return self.mesh_volume
        return self.mesh_volume * ca.det(ca.reshape(self._rest_values[:9], 3, 3))

    @property
    def _rest_values(self) -> ca.SX:
        """Numbers of the stress-free shape here, see `RestPoint`."""
        assert self.rest is not None
        data = self.carried[self.carried.numel() - self.rest.count :]
        changes = self.theta[self.theta.numel() - self.rest.inputs :]
        return self.rest.expand(data, changes)

    @property
    def felt(self) -> ca.SX:
        """The deformation gradient that the material feels, (3, 3)."""
        F = ca.reshape(self.gradients["x"], 3, 3)
        stretch = self.stretches[0] if self.stretches else None
        if self.rest is not None:
            values = self._rest_values
            F = F @ ca.inv_minor(ca.reshape(values[:9], 3, 3))
            if stretch is not None:
                stretch = stretch + values[9] / 3
        return F if stretch is None else ca.exp(stretch) * F

    @property
    def strain(self) -> ca.SX:
        """What of an energy changes with x: F and m."""
        return ca.vertcat(self.gradients["x"], *self.stretches[:1])

    @property
    def strain_rate(self) -> ca.SX:
        """Its derivative along v."""
        return ca.vertcat(self.gradients["v"], *self.stretches[1:2])

    @property
    def felt_rate(self) -> ca.SX:
        """The derivative along v of the deformation gradient that the material feels, (9,)."""
        return ca.jtimes(ca.vec(self.felt), self.strain, self.strain_rate)

    @property
    def felt_weight(self) -> ca.SX:
        """Its derivative along w."""
        along = ca.vertcat(self.gradients["w"], *self.stretches[2:3])
        return ca.jtimes(ca.vec(self.felt), self.strain, along)

    def along_w(self, scalar: ca.SX) -> ca.SX:
        """Derivative of a scalar of x and v by x, along w."""
        inputs = ca.vertcat(self.gradients["x"], *self.stretches[:2])
        return ca.jtimes(scalar, inputs, ca.vertcat(self.gradients["w"], *self.stretches[2:]))

    def derivative(self, scalar: ca.SX, by: By) -> ca.SX:
        """A derivative of a scalar, by the fields' gradients for the fields."""
        inputs = [self.varied if name == "theta" else self.gradients[name] for name in by]
        if not inputs:
            return scalar
        if len(inputs) < 2:
            return ca.jacobian(scalar, inputs[0]).T
        return ca.jacobian(ca.gradient(scalar, inputs[0]), inputs[1])

    def phase(self, name: str, pieces: Pieces, sums: ca.SX | None = None) -> Phase:
        """A phase of these pieces, which may depend on sums of earlier ones."""
        inputs = {**self.fields, "geometry": self.geometry, "theta": self.theta}
        if self.carried.numel():
            inputs["carried"] = self.carried
        if sums is not None:
            inputs["sums"] = sums
        shape_gradients = node_gradients(self.geometry, self.nodes)
        gradients = [
            ca.vec(ca.reshape(field, 3, self.nodes) @ shape_gradients)
            for field in self.fields.values()
        ]
        outputs = ca.substitute(
            [ca.densify(piece) for _, piece in pieces.values()],
            [ca.vertcat(*self.gradients.values())],
            [ca.vertcat(*gradients)],
        )
        function = ca.Function(
            name, list(inputs.values()), outputs, list(inputs), list(pieces), {"cse": True}
        )
        return Phase(function, {key: how for key, (how, _) in pieces.items()})
