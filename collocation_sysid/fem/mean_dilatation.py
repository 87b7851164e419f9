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
Σ_q ∂²g/∂x∂m; those by v are among them, since what of s is a rate along v changes with v as that
which it is the rate of changes with x.

Of an element only the mean dilatation and the 4 · 5 distortions at its points are resisted: alone,
it does not resist the three conformal motions that leave its volume as it is. Four elements whose
centroids are not in a plane do.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca

from .kernel import PointKernel
from .point import By, Pieces, Point, contraction_of, mirrored


def averaging_kernel(
    name: str, point: Point, scalar: ca.SX, derivatives: dict[str, By]
) -> PointKernel:
    """The kernel of derivatives of a scalar that depends on `Point.stretches`."""
    order = max(map(len, derivatives.values()))
    chain = _Chain.of(point, scalar)
    own: Pieces = {key: (contraction_of(by), chain.piece(by)) for key, by in derivatives.items()}
    slopes: Pieces = {"slopes": ("none", chain.by_stretch)} if order else {}
    sums = ca.vertcat(chain.volume, chain.volumes)
    earlier = [point.phase("volumes", chain.first(order))]
    coupled = slopes
    if order > 1:
        earlier.append(point.phase("slopes", chain.at_sums(slopes), sums))
        sums = ca.vertcat(sums, chain.slopes)
        coupled = chain.second()
    last = point.phase(name, chain.at_sums(own | coupled), sums)
    return PointKernel(
        last.pieces,
        tuple(point.fields),
        {key: last.contractions[key] for key in own},
        tuple(earlier),
        {key: last.contractions[key] for key in coupled},
        chain.coupling(derivatives, order) if order else None,
    )


@dataclass(frozen=True, eq=False)
class _Chain:
    """A scalar g in the symbols of a point; V, s and Γ as symbols of sums; σ; and n of σ."""

    point: Point
    scalar: ca.SX
    volume: ca.SX
    volumes: ca.SX
    slopes: ca.SX
    own_volumes: ca.SX

    @classmethod
    def of(cls, point: Point, scalar: ca.SX) -> _Chain:
        count = len(point.stretches)
        F, *rates = point.gradients.values()
        own = point.volume * ca.det(ca.reshape(F, 3, 3))
        for rate in rates:
            own = ca.vertcat(own, ca.jtimes(own, F, rate))
        s, slopes = ca.SX.sym("volumes", count), ca.SX.sym("slopes", count)
        return cls(point, scalar, ca.SX.sym("volume"), s, slopes, own)

    @cached_property
    def by_stretch(self) -> ca.SX:
        """∂g/∂m."""
        return ca.gradient(self.scalar, self._stretches)

    def at_sums(self, pieces: Pieces) -> Pieces:
        """Pieces with m put in."""
        m = _stretches(self.volumes, self.volume)
        m -= _stretches(self.own_volumes, self.point.volume)
        return {
            key: (how, ca.substitute(piece, self._stretches, m))
            for key, (how, piece) in pieces.items()
        }

    def first(self, order: int) -> Pieces:
        """V, s and, to couple, ∂s/∂x."""
        sums: Pieces = {
            "volume": ("none", self.point.volume),
            "volumes": ("none", self.own_volumes),
        }
        if order:
            sums["volumes_by_x"] = "nodes", self._own_by("x").T
        return sums

    def second(self) -> Pieces:
        """Σ_q of what couples in second derivatives besides: ∂²g by (m, m), (m, θ) and (x, m)."""
        by_theta = ca.jacobian(self.by_stretch, self.point.theta)
        by_m = (self._lifted("x").T @ self._hessian("x"))[:, 9:]
        return {
            "second": ("none", ca.vec(self._hessian("x")[9:, 9:])),
            "slopes_by_theta": ("none", ca.vec(by_theta)),
            "slopes_by_x": ("nodes", by_m),
        }

    def piece(self, by: By) -> ca.SX:
        """A derivative at fixed s, and Γ ∂n/∂s ∂²σ/∂α∂β."""
        nodal = [field for field in by if field != "theta"]
        if not nodal:
            return self.point.derivative(self.scalar, by)
        if len(nodal) == 1:
            gradient = ca.gradient(self.scalar, self.point.gradients[nodal[0]])
            gradient += (self._lifted(nodal[0])[9:, :]).T @ self.by_stretch
            return gradient if len(by) == 1 else ca.jacobian(gradient, self.point.theta)
        alpha, beta = nodal
        weights = ca.SX.sym("weights", self.volumes.numel())
        by_s, _ = _slopes(self.volumes, self.volume, self.slopes)
        by_own, bent_by_own = _slopes(self.own_volumes, self.point.volume, self.by_stretch)
        bent = ca.jacobian(
            ca.gradient(ca.dot(weights, self.own_volumes), self.point.gradients[alpha]),
            self.point.gradients[beta],
        )
        weighed = by_s.T @ self.slopes - by_own.T @ self.by_stretch
        return mirrored(
            self._lifted(alpha).T @ self._hessian(beta) @ self._lifted(beta)
            - self._own_by(alpha).T @ bent_by_own @ self._own_by(beta)
            + ca.substitute(bent, weights, weighed)
        )

    def coupling(self, derivatives: dict[str, By], order: int) -> ca.Function:
        """C or D of each derivative; see `kernel`."""
        count, constants = self.volumes.numel(), self.point.theta.numel()
        second = ca.SX.sym("second", count, count)
        by_theta = ca.SX.sym("slopes_by_theta", count, constants)
        sums = [self.volume, self.volumes, self.slopes]
        if order > 1:
            sums += [ca.vec(second), ca.vec(by_theta)]
        by_s, bent = _slopes(self.volumes, self.volume, self.slopes)
        couplings = []
        for by in derivatives.values():
            if contraction_of(by) == "none":
                couplings.append(ca.SX(0, 0))
                continue
            as_x = self._as_by_x(by[-1] if by[-1] != "theta" else by[0])
            by_field = by_s @ as_x
            if contraction_of(by) == "pairs":
                own = (by_s.T @ second @ by_s + bent) @ as_x
                couplings.append(ca.blockcat([[own, by_field.T], [by_field, ca.SX(count, count)]]))
            else:
                slopes = by_theta if len(by) > 1 else self.slopes
                rest = ca.SX(count if order > 1 else 0, slopes.shape[1])
                couplings.append(ca.vertcat(by_field.T @ slopes, rest))
        return ca.Function("coupling", [ca.vertcat(*sums)], couplings, ["sums"], list(derivatives))

    @property
    def _stretches(self) -> ca.SX:
        return ca.vertcat(*self.point.stretches)

    def _own_by(self, field: str) -> ca.SX:
        """∂σ by F or its like."""
        return ca.jacobian(self.own_volumes, self.point.gradients[field])

    def _lifted(self, field: str) -> ca.SX:
        """∂(F, m)/∂F at fixed s, or its like for another field."""
        by_own, _ = _slopes(self.own_volumes, self.point.volume, self.by_stretch)
        return ca.vertcat(ca.SX.eye(9), -by_own @ self._own_by(field))

    def _hessian(self, field: str) -> ca.SX:
        """∂²g by (F, m), and (F, m) or its like for another field."""
        if field == "x":
            return self._hessian_by_x
        rate = self.point.gradients[field]
        return ca.horzcat(
            ca.vertcat(
                self.point.derivative(self.scalar, ("x", field)),
                ca.jacobian(self.by_stretch, rate),
            ),
            self._hessian_by_x[:, 9:],
        )

    @cached_property
    def _hessian_by_x(self) -> ca.SX:
        inputs = ca.vertcat(self.point.gradients["x"], self._stretches)
        return mirrored(ca.jacobian(ca.gradient(self.scalar, inputs), inputs))

    def _as_by_x(self, field: str) -> ca.SX:
        """∂s/∂field = this ∂s/∂x."""
        count = self.volumes.numel()
        if field == "x":
            return ca.SX.eye(count)
        # Every second one is the rate of the one before.
        return ca.diagcat(*[ca.SX(ca.sparsify(ca.DM([[0, 0], [1, 0]])))] * (count // 2))


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
