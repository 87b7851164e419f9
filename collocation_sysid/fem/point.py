"""One quadrature point in symbols."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from .elements import Element
from .kernel import Contraction, Phase, node_gradients

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
    whole_volume : SX
        The element's undeformed volume (1) if it averages the dilatation, otherwise empty (0).
    volumes : tuple of SX
        Likewise its current volume and, with v, that one's derivative along v, and with w, those
        of both along w: one, two or four.
    """

    nodes: int
    fields: dict[str, ca.SX]
    geometry: ca.SX
    theta: ca.SX
    gradients: dict[str, ca.SX]
    whole_volume: ca.SX
    volumes: tuple[ca.SX, ...]

    @classmethod
    def of(cls, element: Element, constants: int, *fields: str) -> Point:
        """A point of an element, with θ of so many constants."""
        count = element.mean_dilatation * 2 ** (len(fields) - 1)
        return cls(
            element.nodes,
            {name: ca.SX.sym(name, 3 * element.nodes) for name in fields},
            ca.SX.sym("geometry", 3 * element.nodes + 1),
            ca.SX.sym("theta", constants),
            {name: ca.SX.sym(f"gradient_{name}", 9) for name in fields},
            ca.SX.sym("whole_volume", int(element.mean_dilatation)),
            tuple(ca.SX.sym(f"volume_{k}") for k in range(count)),
        )

    @property
    def volume(self) -> ca.SX:
        """The point's share of the undeformed volume."""
        return self.geometry[3 * self.nodes]

    @property
    def current_volume(self) -> ca.SX:
        """The point's share of it."""
        return self.volume * ca.det(ca.reshape(self.gradients["x"], 3, 3))

    @property
    def felt(self) -> ca.SX:
        """The deformation gradient that the material feels, (3, 3); see `mean_dilatation`."""
        F = ca.reshape(self.gradients["x"], 3, 3)
        if not self.volumes:
            return F
        mean = self.volumes[0] / self.whole_volume
        return ca.exp(ca.log(mean * self.volume / self.current_volume) / 3) * F

    @property
    def strain(self) -> ca.SX:
        """What of an energy changes with x: F and, if it matters, the element's volume."""
        return ca.vertcat(self.gradients["x"], *self.volumes[:1])

    @property
    def strain_rate(self) -> ca.SX:
        """The derivative of the strain along v."""
        return ca.vertcat(self.gradients["v"], *self.volumes[1:2])

    def along_w(self, scalar: ca.SX) -> ca.SX:
        """Derivative of a scalar of x and v by x, along w."""
        inputs = ca.vertcat(self.gradients["x"], *self.volumes[:2])
        return ca.jtimes(scalar, inputs, ca.vertcat(self.gradients["w"], *self.volumes[2:]))

    def phase(self, name: str, pieces: Pieces, sums: ca.SX | None = None) -> Phase:
        """A phase of these pieces, which may depend on sums of earlier ones."""
        inputs = {**self.fields, "geometry": self.geometry, "theta": self.theta}
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
