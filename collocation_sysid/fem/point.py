"""One quadrature point in symbols."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import casadi as ca

from .elements import Element
from .kernel import Contraction, Phase, mirrored, node_gradients

# A derivative of a scalar: by none, one or two of x, v and θ, θ last.
By = tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Term:
    """A derivative of a scalar, as a summand of an output.

    Attributes
    ----------
    scalar : SX
        In the symbols of a `Point`.
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
Outputs = dict[str, tuple[Term, ...]]
# For each output its contraction, and its piece in the symbols of a `Point`.
Pieces = dict[str, tuple[Contraction, ca.SX]]


@dataclass(frozen=True, eq=False)
class Point:
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
        What the point brings from the past, see `memory`.
    """

    nodes: int
    fields: dict[str, ca.SX]
    geometry: ca.SX
    theta: ca.SX
    gradients: dict[str, ca.SX]
    stretches: tuple[ca.SX, ...]
    carried: ca.SX

    @classmethod
    def of(cls, element: Element, constants: int, *fields: str, carried: int = 0) -> Point:
        """A point of an element, with θ of so many constants, that carries so many numbers."""
        stretches = 2 ** (len(fields) - 1) if element.mean_dilatation else 0
        return cls(
            element.nodes,
            {name: ca.SX.sym(name, 3 * element.nodes) for name in fields},
            ca.SX.sym("geometry", 3 * element.nodes + 1),
            ca.SX.sym("theta", constants),
            {name: ca.SX.sym(f"gradient_{name}", 9) for name in fields},
            tuple(ca.SX.sym(f"stretch_{k}") for k in range(stretches)),
            ca.SX.sym("carried", carried),
        )

    @property
    def volume(self) -> ca.SX:
        """The point's share of the element's."""
        return self.geometry[3 * self.nodes]

    @property
    def felt(self) -> ca.SX:
        """The deformation gradient that the material feels, (3, 3)."""
        F = ca.reshape(self.gradients["x"], 3, 3)
        return ca.exp(self.stretches[0]) * F if self.stretches else F

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
        inputs = [self.theta if name == "theta" else self.gradients[name] for name in by]
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
