"""Elements that average the dilatation, so that they do not lock near incompressibility.

Their material feels F* = eᵐ F with m = ⅓ ln(J̄/J), J̄ = v/V, the element's current volume over its
undeformed one (Nagtegaal, Parks & Rice 1974; Simo, Taylor & Pister 1985). For ψ_iso(J^−⅓ F) + U(J)
the energy is Σ_q V_q ψ_iso + V U(J̄); for any other it has the same limit under refinement.

A scalar of the element is then Σ_q g(F_q, Ḟ_q, W_q, m_q; θ). Here s = Σ_q σ(F_q, Ḟ_q, W_q) are v,
its derivative along the velocities, and those of both along w; m their likes of ⅓ ln(J̄/J); and

    m_q = n(s, V) − n(σ_q, V_q),   n = ⅓ ln(v/V) and its likes.

By the chain rule, twice, and with α, β any of x and v, the scalar's derivatives are Σ_q of those at
fixed s, and with Γ = Σ_q ∂g/∂m

    Γ ∂n/∂s ∂s/∂α                                                           of the first, and
    (Σ_q ∂²g/∂α∂m) ∂n/∂s ∂s/∂β + its transpose of α and β
        + ∂s/∂α [∂n/∂s (Σ_q ∂²g/∂m²) ∂n/∂s + Γ ∂²n/∂s²] ∂s/∂β + Γ ∂n/∂s ∂²s/∂α∂β   of the second.

So two phases go before the last, for s and for Γ. The node vectors coupled are ∂s/∂x and
Σ_q ∂²g/∂x∂m; those of s by v are among them, since what of s is a rate along v changes with v as
that which it is the rate of changes with x. Of a g that is an energy, or its derivative along v,
those by v are too; of a power that is dissipated Σ_q ∂²g/∂v∂m is another one.

Of an element only the mean dilatation and the 4 · 5 distortions at its points are resisted: alone,
it does not resist the three conformal motions that leave its volume as it is. Four elements whose
centroids are not in a plane do.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca

from .kernel import By, Derivative, Outputs, Pieces, PointKernel, QuadraturePoint, mirrored


def averaging_kernel(name: str, point: QuadraturePoint, outputs: Outputs) -> PointKernel:
    """The kernel of derivatives of scalars that depend on `QuadraturePoint.stretches`."""
    shape = _Shape.of(point)
    chains = _chains(shape, outputs)
    order = max(len(term.by) for terms in outputs.values() for term in terms)
    own: Pieces = {}
    for key, terms in outputs.items():
        found = [term.of(chains[id(term.scalar)].piece(term.by)) for term in terms]
        own[key] = terms[0].contraction, sum(found[1:], found[0])
    slopes: Pieces = {}
    if order:
        slopes = {chain.key("slopes"): ("none", chain.by_stretch) for chain in chains.values()}
    sums = ca.vertcat(shape.volume, shape.volumes)
    earlier = [point.phase("volumes", shape.first(order))]
    coupled = slopes
    if order > 1:
        earlier.append(point.phase("slopes", shape.at_sums(slopes), sums))
        sums = ca.vertcat(sums, *(chain.slopes for chain in chains.values()))
        coupled = {key: p for chain in chains.values() for key, p in chain.second().items()}
    last = point.phase(name, shape.at_sums(own | coupled), sums)
    return PointKernel(
        last.pieces,
        tuple(point.fields),
        {key: last.contractions[key] for key in own},
        tuple(earlier),
        {key: last.contractions[key] for key in coupled},
        _coupling(shape, chains, outputs, order) if order else None,
    )


@dataclass(frozen=True, eq=False)
class _Shape:
    """What stretches a point: V and s as symbols of sums, σ, and n of σ."""

    point: QuadraturePoint
    volume: ca.SX
    volumes: ca.SX
    own_volumes: ca.SX

    @classmethod
    def of(cls, point: QuadraturePoint) -> _Shape:
        F, *rates = point.gradients.values()
        own = point.mesh_volume * ca.det(ca.reshape(F, 3, 3))
        for rate in rates:
            own = ca.vertcat(own, ca.jtimes(own, F, rate))
        return cls(point, ca.SX.sym("volume"), ca.SX.sym("volumes", len(point.stretches)), own)

    @property
    def stretches(self) -> ca.SX:
        """Their symbols m."""
        return ca.vertcat(*self.point.stretches)

    @property
    def count(self) -> int:
        """Number of s."""
        return self.volumes.numel()

    def at_sums(self, pieces: Pieces) -> Pieces:
        """Pieces with m put in."""
        m = _stretches(self.volumes, self.volume)
        m -= _stretches(self.own_volumes, self.point.mesh_volume)
        return {
            key: (how, ca.substitute(piece, self.stretches, m))
            for key, (how, piece) in pieces.items()
        }

    def first(self, order: int) -> Pieces:
        """V, s and, to couple, ∂s/∂x."""
        sums: Pieces = {
            "volume": ("none", self.point.mesh_volume),
            "volumes": ("none", self.own_volumes),
        }
        if order:
            sums["volumes_by_x"] = "nodes", self.own_by("x").T
        return sums

    def own_by(self, field: str) -> ca.SX:
        """∂σ by F or its like."""
        return ca.jacobian(self.own_volumes, self.point.gradients[field])

    def as_by_x(self, field: str) -> ca.SX:
        """∂s/∂field = this ∂s/∂x."""
        if field == "x":
            return ca.SX.eye(self.count)
        # Every second one is the rate of the one before.
        rates = [ca.SX(ca.sparsify(ca.DM([[0, 0], [1, 0]])))] * (self.count // 2)
        return ca.diagcat(*rates)


@dataclass(frozen=True, eq=False)
class _Chain:
    """A scalar g in the symbols of a point, and Γ as a symbol of sums.

    `fields` are those whose Σ_q ∂²g/∂field∂m are coupled.
    """

    shape: _Shape
    scalar: ca.SX
    number: int
    slopes: ca.SX
    fields: tuple[str, ...]

    def key(self, name: str) -> str:
        """The name of a sum that is this scalar's."""
        return f"{name}_{self.number}"

    @cached_property
    def by_stretch(self) -> ca.SX:
        """∂g/∂m."""
        return ca.gradient(self.scalar, self.shape.stretches)

    def second(self) -> Pieces:
        """Σ_q of what couples in second derivatives: ∂²g by (m, m), (m, θ) and (field, m)."""
        by_m = ca.jacobian(self.by_stretch, self.shape.stretches)
        pieces: Pieces = {
            self.key("second"): ("none", ca.vec(mirrored(by_m))),
            self.key("slopes_by_theta"): (
                "none",
                ca.vec(ca.jacobian(self.by_stretch, self.shape.point.varied)),
            ),
        }
        for field in self.fields:
            slopes = (self._lifted(field).T @ self._hessian(field, "x"))[:, 9:]
            pieces[self.key(f"slopes_by_{field}")] = "nodes", slopes
        return pieces

    def piece(self, by: By) -> ca.SX:
        """A derivative at fixed s, and Γ ∂n/∂s ∂²σ/∂α∂β."""
        shape, point = self.shape, self.shape.point
        nodal = [field for field in by if field != "theta"]
        if not nodal:
            return point.derivative(self.scalar, by)
        if len(nodal) == 1:
            gradient = ca.gradient(self.scalar, point.gradients[nodal[0]])
            gradient += (self._lifted(nodal[0])[9:, :]).T @ self.by_stretch
            return gradient if len(by) == 1 else ca.jacobian(gradient, point.varied)
        alpha, beta = nodal
        weights = ca.SX.sym("weights", shape.count)
        by_s, _ = _slopes(shape.volumes, shape.volume, self.slopes)
        by_own, bent_by_own = _slopes(shape.own_volumes, point.mesh_volume, self.by_stretch)
        bent = ca.jacobian(
            ca.gradient(ca.dot(weights, shape.own_volumes), point.gradients[alpha]),
            point.gradients[beta],
        )
        weighed = by_s.T @ self.slopes - by_own.T @ self.by_stretch
        return (
            self._lifted(alpha).T @ self._hessian(alpha, beta) @ self._lifted(beta)
            - shape.own_by(alpha).T @ bent_by_own @ shape.own_by(beta)
            + ca.substitute(bent, weights, weighed)
        )

    def _lifted(self, field: str) -> ca.SX:
        """∂(F, m)/∂F at fixed s, or its like for another field."""
        by_own, _ = _slopes(self.shape.own_volumes, self.shape.point.mesh_volume, self.by_stretch)
        return ca.vertcat(ca.SX.eye(9), -by_own @ self.shape.own_by(field))

    def _hessian(self, alpha: str, beta: str) -> ca.SX:
        """∂²g by (F, m) or its like for another field, twice."""
        gradients = self.shape.point.gradients
        first, second = (ca.vertcat(gradients[f], self.shape.stretches) for f in (alpha, beta))
        found = ca.jacobian(ca.gradient(self.scalar, first), second)
        return mirrored(found) if alpha == beta else found


def _chains(shape: _Shape, outputs: Outputs) -> dict[int, _Chain]:
    """Those of the scalars that have outputs, by their identity."""
    terms = [term for those in outputs.values() for term in those]
    chains: dict[int, _Chain] = {}
    for term in terms:
        if id(term.scalar) not in chains:
            number = len(chains)
            parts = {other.part for other in terms if other.scalar is term.scalar}
            # Where all is symmetric, what is by v is among what is by x.
            fields = ("x",) if parts == {"whole"} else ("x", "v")
            slopes = ca.SX.sym(f"slopes_{number}", shape.count)
            chains[id(term.scalar)] = _Chain(shape, term.scalar, number, slopes, fields)
    return chains


def _coupling(
    shape: _Shape, chains: dict[int, _Chain], outputs: Outputs, order: int
) -> ca.Function:
    """C or D of each output; see `kernel`."""
    count, constants = shape.count, shape.point.varied.numel()
    sums = [shape.volume, shape.volumes, *(chain.slopes for chain in chains.values())]
    blocks, seconds, by_thetas = {"volumes": slice(0, count)}, {}, {}
    if order > 1:
        for key, chain in chains.items():
            seconds[key] = ca.SX.sym("second", count, count)
            by_thetas[key] = ca.SX.sym("slopes_by_theta", count, constants)
            sums += [ca.vec(seconds[key]), ca.vec(by_thetas[key])]
            for field in chain.fields:
                first = count * len(blocks)
                blocks[chain.key(field)] = slice(first, first + count)
    size = count * len(blocks)
    couplings = []
    for terms in outputs.values():
        total = ca.SX(0, 0)
        if terms[0].contraction != "none":
            width = constants if "theta" in terms[0].by else 1
            total = ca.SX(size, size if terms[0].contraction == "pairs" else width)
        for term in terms:
            chain = chains[id(term.scalar)]
            by_s, bent = _slopes(shape.volumes, shape.volume, chain.slopes)
            if term.contraction == "nodes":
                along = shape.as_by_x(term.by[0])
                slopes = by_thetas[id(term.scalar)] if "theta" in term.by else chain.slopes
                total[:count, :] += (by_s @ along).T @ slopes
            elif term.contraction == "pairs":
                second = by_s.T @ seconds[id(term.scalar)] @ by_s + bent
                total += _of_pair(shape, chain, blocks, size, term, by_s, second)
        couplings.append(total)
    return ca.Function("coupling", [ca.vertcat(*sums)], couplings, ["sums"], list(outputs))


def _of_pair(
    shape: _Shape,
    chain: _Chain,
    blocks: dict[str, slice],
    size: int,
    term: Derivative,
    by_s: ca.SX,
    second: ca.SX,
) -> ca.SX:
    """D of a second derivative by two fields, or of its symmetric or skew part."""
    alpha, beta = term.by
    of_alpha, of_beta = shape.as_by_x(alpha), shape.as_by_x(beta)
    here = blocks["volumes"]
    found = ca.SX(size, size)
    found[here, here] = of_alpha.T @ second @ of_beta
    found[blocks[chain.key(alpha)], here] = by_s @ of_beta
    if beta in chain.fields:
        found[here, blocks[chain.key(beta)]] = of_alpha.T @ by_s.T
    else:
        found[here, blocks[chain.key(alpha)]] = of_beta.T @ by_s.T
    if term.part == "whole":
        return found
    return (found + found.T if term.part == "symmetric" else found - found.T) / 2


def _stretches(volumes: ca.SX, volume: ca.SX) -> ca.SX:
    """What n is: ⅓ ln(v/V), its derivative along the velocities, and those of both along w."""
    s = ca.SX.sym("s", volumes.numel())
    n = ca.log(s[0] / volume) / 3
    for known in (1, 2):
        if s.numel() > known:
            n = ca.vertcat(n, ca.jtimes(n, s[:known], s[known : 2 * known]))
    return ca.substitute(n, s, volumes)


def _slopes(volumes: ca.SX, volume: ca.SX, weights: ca.SX) -> tuple[ca.SX, ca.SX]:
    """∂n/∂s, and Σ_k weights_k ∂²n_k/∂s²."""
    s, c = ca.SX.sym("s", volumes.numel()), ca.SX.sym("c", volumes.numel())
    n = _stretches(s, volume)
    found = [ca.jacobian(n, s), ca.hessian(ca.dot(c, n), s)[0]]
    first, second = ca.substitute(found, [s, c], [volumes, weights])
    return first, second
