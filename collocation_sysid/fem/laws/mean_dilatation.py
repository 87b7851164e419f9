"""Kernels of elements that average the dilatation, which do not lock near incompressibility.

The material of such an element is evaluated at F* = eᵐ F with m = ⅓ ln(J̄/J) and J̄ = v/V, the
current volume of the element over its undeformed volume (Nagtegaal, Parks & Rice 1974; Simo, Taylor
& Pister 1985). For ψ_iso(J^−⅓ F) + U(J) the energy is Σ_q V_q ψ_iso + V U(J̄); any other energy has
the same limit under refinement.

A scalar of the element is then Σ_q g(F_q, Ḟ_q, W_q, m_q; θ). The sums s = Σ_q σ(F_q, Ḟ_q, W_q) are
v, its derivative along the velocities, and the derivatives of both along w; m are the same
derivatives of ⅓ ln(J̄/J), and

    m_q = n(s, V) − n(σ_q, V_q),   with n = ⅓ ln(v/V) and its derivatives.

By the chain rule, with α and β any of x and v and with Γ = Σ_q ∂g/∂m, the derivatives of the scalar
are Σ_q of those at fixed s, and

    Γ ∂n/∂s ∂s/∂α                                                           for first derivatives,
    (Σ_q ∂²g/∂α∂m) ∂n/∂s ∂s/∂β + its transpose with α and β exchanged
        + ∂s/∂α [∂n/∂s (Σ_q ∂²g/∂m²) ∂n/∂s + Γ ∂²n/∂s²] ∂s/∂β + Γ ∂n/∂s ∂²s/∂α∂β   for second ones.

So two phases precede the last one, for s and for Γ. The coupled node vectors are ∂s/∂x and
Σ_q ∂²g/∂x∂m. They include the derivatives of s by v: an entry of s that is a rate depends on v as
the entry of which it is the rate depends on x. For a g that is an energy, or its derivative along
v, they include those of g by v, too; for a dissipated power Σ_q ∂²g/∂v∂m is a further vector.

An element resists only the mean dilatation and the 4 · 5 distortions at its points: a single
element does not resist the three conformal motions that preserve its volume. Four elements whose
centroids are not in a plane resist them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca

from ..kernel import (
    By,
    Derivative,
    ElementKernel,
    Outputs,
    Pieces,
    QuadraturePoint,
    from_lower_triangle,
)


def averaging_kernel(name: str, point: QuadraturePoint, outputs: Outputs) -> ElementKernel:
    """Return the kernel of derivatives of scalars that depend on `QuadraturePoint.stretches`.

    Parameters
    ----------
    outputs : dict
        Derivatives that are summed in each output.
    """
    shape = _VolumeSums.from_point(point)
    chains = _scalar_derivatives(shape, outputs)
    order = max(len(term.by) for terms in outputs.values() for term in terms)
    output_pieces: Pieces = {}
    for key, terms in outputs.items():
        summands = [term.select_part(chains[id(term.scalar)].piece(term.by)) for term in terms]
        output_pieces[key] = (terms[0].choose_contraction(), sum(summands[1:], summands[0]))
    slopes: Pieces = {}
    if order:
        slopes = {chain.sum_name("slopes"): ("none", chain.by_stretch) for chain in chains.values()}
    sums = ca.vertcat(shape.volume, shape.volumes)
    previous_phases = [point.make_phase("volumes", shape.volume_pieces(order))]
    coupled = slopes
    if order > 1:
        previous_phases.append(point.make_phase("slopes", shape.with_stretches(slopes), sums=sums))
        sums = ca.vertcat(sums, *(chain.slopes for chain in chains.values()))
        coupled = {
            key: p
            for chain in chains.values()
            for key, p in chain.second_derivative_pieces().items()
        }
    last = point.make_phase(name, shape.with_stretches(output_pieces | coupled), sums=sums)
    return ElementKernel(
        last.pieces,
        tuple(point.fields),
        contractions={key: last.contractions[key] for key in output_pieces},
        previous_phases=tuple(previous_phases),
        coupled={key: last.contractions[key] for key in coupled},
        coupling=_coupling(shape, chains, outputs=outputs, order=order) if order else None,
    )


@dataclass(frozen=True, eq=False)
class _VolumeSums:
    """Volumes that determine the stretch of a point."""

    point: QuadraturePoint
    volume: ca.SX  # symbol of the sum V
    volumes: ca.SX  # symbols of the sums s
    own_volumes: ca.SX  # contribution σ of the point to s

    @classmethod
    def from_point(cls, point: QuadraturePoint) -> _VolumeSums:
        F, *rates = point.gradients.values()
        volumes = point.mesh_volume * ca.det(ca.reshape(F, 3, 3))
        for rate in rates:
            volumes = ca.vertcat(volumes, ca.jtimes(volumes, F, rate))
        return cls(
            point,
            ca.SX.sym("volume"),
            volumes=ca.SX.sym("volumes", len(point.stretches)),
            own_volumes=volumes,
        )

    def stack_stretches(self) -> ca.SX:
        """Return the symbols m of the stretches, as one vector."""
        return ca.vertcat(*self.point.stretches)

    @property
    def count(self) -> int:
        """Number of the sums s."""
        return self.volumes.numel()

    def with_stretches(self, pieces: Pieces) -> Pieces:
        """Replace m by its expression in the sums; symbols of energies first."""
        m = _volume_logarithms(self.volumes, self.volume)
        m -= _volume_logarithms(self.own_volumes, self.point.mesh_volume)
        expanded = self.point.rule.eliminate([piece for _, piece in pieces.values()])
        return {
            key: (how, ca.substitute(piece, self.stack_stretches(), m))
            for (key, (how, _)), piece in zip(pieces.items(), expanded, strict=True)
        }

    def volume_pieces(self, order: int) -> Pieces:
        """Pieces of the first phase: "volume" for V, "volumes" for s, and from order 1 ∂σ/∂x."""
        sums: Pieces = {
            "volume": ("none", self.point.mesh_volume),
            "volumes": ("none", self.own_volumes),
        }
        if order:
            sums["volumes_by_x"] = "nodes", self.volume_derivative("x").T
        return sums

    def volume_derivative(self, field: str) -> ca.SX:
        """Return ∂σ by the gradient of a field."""
        return ca.jacobian(self.own_volumes, self.point.gradients[field])

    def relation_to_x(self, field: str) -> ca.SX:
        """Return the matrix B with ∂s/∂field = B ∂s/∂x."""
        if field == "x":
            return ca.SX.eye(self.count)
        # Every second one is the rate of the one before.
        rates = [ca.SX(ca.sparsify(ca.DM([[0, 0], [1, 0]])))] * (self.count // 2)
        return ca.diagcat(*rates)


@dataclass(frozen=True, eq=False)
class _ScalarDerivatives:
    """Scalar g in the symbols of a point, with the chain rule through the stretches."""

    shape: _VolumeSums
    scalar: ca.SX  # scalar g
    number: int  # index of the scalar, for names of sums
    slopes: ca.SX  # symbols of the sum Γ
    fields: tuple[str, ...]  # fields whose Σ_q ∂²g/∂field∂m are coupled node vectors

    def sum_name(self, name: str) -> str:
        return f"{name}_{self.number}"

    @cached_property
    def by_stretch(self) -> ca.SX:
        """Derivatives ∂g/∂m by the stretches."""
        return self.shape.point.gradient(self.scalar, self.shape.stack_stretches())

    def second_derivative_pieces(self) -> Pieces:
        """Return ∂²g by (m, m), (m, θ), (field, m)."""
        point = self.shape.point
        by_m = point.jacobian(self.by_stretch, self.shape.stack_stretches())
        pieces: Pieces = {
            self.sum_name("second"): ("none", ca.vec(from_lower_triangle(by_m))),
            self.sum_name("slopes_by_theta"): (
                "none",
                ca.vec(point.jacobian(self.by_stretch, point.stack_differentiated_constants())),
            ),
        }
        for field in self.fields:
            slopes = (self._with_stretch(field).T @ self._hessian(field, "x"))[:, 9:]
            pieces[self.sum_name(f"slopes_by_{field}")] = "nodes", slopes
        return pieces

    def piece(self, by: By) -> ca.SX:
        """Derivative of g at fixed s; by two fields with Γ ∂n/∂s ∂²σ/∂α∂β of the point's own σ."""
        shape = self.shape
        point = self.shape.point
        nodal = [field for field in by if field != "theta"]
        if not nodal:
            return point.derivative(self.scalar, by)
        if len(nodal) == 1:
            gradient = point.gradient(self.scalar, point.gradients[nodal[0]])
            gradient += (self._with_stretch(nodal[0])[9:, :]).T @ self.by_stretch
            return (
                gradient
                if len(by) == 1
                else point.jacobian(gradient, point.stack_differentiated_constants())
            )
        alpha, beta = nodal
        weights = ca.SX.sym("weights", shape.count)
        by_s, _ = _logarithm_derivatives(shape.volumes, shape.volume, weights=self.slopes)
        by_own, second_by_own = _logarithm_derivatives(
            shape.own_volumes, point.mesh_volume, weights=self.by_stretch
        )
        second_volumes = ca.jacobian(
            ca.gradient(ca.dot(weights, shape.own_volumes), point.gradients[alpha]),
            point.gradients[beta],
        )
        weight_values = by_s.T @ self.slopes - by_own.T @ self.by_stretch
        return (
            self._with_stretch(alpha).T @ self._hessian(alpha, beta) @ self._with_stretch(beta)
            - shape.volume_derivative(alpha).T @ second_by_own @ shape.volume_derivative(beta)
            + ca.substitute(second_volumes, weights, weight_values)
        )

    def _with_stretch(self, field: str) -> ca.SX:
        """Return ∂(F, m)/∂F at fixed s, or the same for the gradient of another field."""
        by_own, _ = _logarithm_derivatives(
            self.shape.own_volumes, self.shape.point.mesh_volume, weights=self.by_stretch
        )
        return ca.vertcat(ca.SX.eye(9), -by_own @ self.shape.volume_derivative(field))

    def _hessian(self, alpha: str, beta: str) -> ca.SX:
        """Return the second derivatives of g by (gradient, m) of two fields."""
        point = self.shape.point
        first, second = (
            ca.vertcat(point.gradients[field], self.shape.stack_stretches())
            for field in (alpha, beta)
        )
        hessian = point.jacobian(point.gradient(self.scalar, first), second)
        return from_lower_triangle(hessian) if alpha == beta else hessian


def _scalar_derivatives(shape: _VolumeSums, outputs: Outputs) -> dict[int, _ScalarDerivatives]:
    terms = [term for those in outputs.values() for term in those]
    chains: dict[int, _ScalarDerivatives] = {}
    for term in terms:
        if id(term.scalar) not in chains:
            number = len(chains)
            parts = {other.part for other in terms if other.scalar is term.scalar}
            # Where all is symmetric, what is by v is among what is by x.
            fields = ("x",) if parts == {"whole"} else ("x", "v")
            slopes = ca.SX.sym(f"slopes_{number}", shape.count)
            chains[id(term.scalar)] = _ScalarDerivatives(
                shape, term.scalar, number=number, slopes=slopes, fields=fields
            )
    return chains


def _coupling(
    shape: _VolumeSums, chains: dict[int, _ScalarDerivatives], outputs: Outputs, order: int
) -> ca.Function:
    """Return the coupling of each output by the sums over points: C (order 1) or D (order 2)."""
    count = shape.count
    constants = shape.point.stack_differentiated_constants().numel()
    sums = [shape.volume, shape.volumes, *(chain.slopes for chain in chains.values())]
    blocks = {"volumes": slice(0, count)}
    seconds = {}
    by_thetas = {}
    if order > 1:
        for key, chain in chains.items():
            seconds[key] = ca.SX.sym("second", count, count)
            by_thetas[key] = ca.SX.sym("slopes_by_theta", count, constants)
            sums += [ca.vec(seconds[key]), ca.vec(by_thetas[key])]
            for field in chain.fields:
                start = count * len(blocks)
                blocks[chain.sum_name(field)] = slice(start, start + count)
    size = count * len(blocks)
    couplings = []
    for terms in outputs.values():
        total = ca.SX(0, 0)
        if terms[0].choose_contraction() != "none":
            width = constants if "theta" in terms[0].by else 1
            total = ca.SX(size, size if terms[0].choose_contraction() == "pairs" else width)
        for term in terms:
            chain = chains[id(term.scalar)]
            by_s, second_of_logarithm = _logarithm_derivatives(
                shape.volumes, shape.volume, weights=chain.slopes
            )
            if term.choose_contraction() == "nodes":
                relation = shape.relation_to_x(term.by[0])
                slopes = by_thetas[id(term.scalar)] if "theta" in term.by else chain.slopes
                total[:count, :] += (by_s @ relation).T @ slopes
            elif term.choose_contraction() == "pairs":
                second = by_s.T @ seconds[id(term.scalar)] @ by_s + second_of_logarithm
                total += _pair_coupling(
                    shape, chain, blocks=blocks, size=size, term=term, by_s=by_s, second=second
                )
        couplings.append(total)
    return ca.Function("coupling", [ca.vertcat(*sums)], couplings, ["sums"], list(outputs))


def _pair_coupling(
    shape: _VolumeSums,
    chain: _ScalarDerivatives,
    blocks: dict[str, slice],
    size: int,
    term: Derivative,
    by_s: ca.SX,
    second: ca.SX,
) -> ca.SX:
    """Return D of a second derivative by two fields, or of its symmetric or skew part."""
    alpha, beta = term.by
    of_alpha = shape.relation_to_x(alpha)
    of_beta = shape.relation_to_x(beta)
    volume_block = blocks["volumes"]
    coupling = ca.SX(size, size)
    coupling[volume_block, volume_block] = of_alpha.T @ second @ of_beta
    coupling[blocks[chain.sum_name(alpha)], volume_block] = by_s @ of_beta
    if beta in chain.fields:
        coupling[volume_block, blocks[chain.sum_name(beta)]] = of_alpha.T @ by_s.T
    else:
        coupling[volume_block, blocks[chain.sum_name(alpha)]] = of_beta.T @ by_s.T
    if term.part == "whole":
        return coupling
    return (coupling + coupling.T if term.part == "symmetric" else coupling - coupling.T) / 2


def _volume_logarithms(volumes: ca.SX, volume: ca.SX) -> ca.SX:
    """Return n: ⅓ ln(v/V), its derivative along v, and the derivatives of both along w."""
    s = ca.SX.sym("s", volumes.numel())
    n = ca.log(s[0] / volume) / 3
    for known in (1, 2):
        if s.numel() > known:
            n = ca.vertcat(n, ca.jtimes(n, s[:known], s[known : 2 * known]))
    return ca.substitute(n, s, volumes)


def _logarithm_derivatives(volumes: ca.SX, volume: ca.SX, weights: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Return ∂n/∂s and Σ_k weights_k ∂²n_k/∂s² of the function `_volume_logarithms`."""
    s = ca.SX.sym("s", volumes.numel())
    c = ca.SX.sym("c", volumes.numel())
    n = _volume_logarithms(s, volume)
    expressions = [ca.jacobian(n, s), ca.hessian(ca.dot(c, n), s)[0]]
    first, second = ca.substitute(expressions, [s, c], [volumes, weights])
    return first, second
