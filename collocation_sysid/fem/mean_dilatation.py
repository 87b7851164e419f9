"""Elements that average the dilatation, so that they do not lock near incompressibility.

Their material feels F* = (J̄/J)^⅓ F with J̄ = v/V, the element's current volume over its undeformed
one (Nagtegaal, Parks & Rice 1974; Simo, Taylor & Pister 1985); for ψ = ψ_iso(J^−⅓ F) + U(J) the
energy is Σ_q V_q ψ_iso + V U(J̄). A scalar of the element is then Σ_q g(F_q, Ḟ_q, W_q, s; θ), where

    s = Σ_q σ(F_q, Ḟ_q, W_q)

are v, its derivative along the velocities, and those of both along w. With Π = Σ_q ∂g/∂s, the
derivatives by nodal fields α, β are Σ_q ∂g/∂α + Π·∂s/∂α, and

    Σ_q (∂²g/∂α∂β + Π·∂²σ_q/∂α∂β)
        + (Σ_q ∂²g/∂α∂s) ∂s/∂β + ∂s/∂α (Σ_q ∂²g/∂s∂β) + ∂s/∂α (Σ_q ∂²g/∂s²) ∂s/∂β.

So there are two phases before the last: s with ∂s/∂x, then what of g needs s. The node vectors are
A = (∂s/∂x, Σ_q ∂²g/∂x∂s); those by v are among them, as s changes with v only where it holds a
derivative along v, and there like what this is the derivative of.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from .kernel import Phase
from .point import Pieces, Point


@dataclass(frozen=True, eq=False)
class MeanDilatation:
    """What a scalar's derivatives need besides those at fixed s.

    Attributes
    ----------
    point : Point
    scalar : SX
        g.
    order : int
        Of the highest derivative by nodal fields and θ.
    slopes, second, by_theta : SX
        Symbols of Π, Σ_q ∂²g/∂s² and ∂Π/∂θ, of the order that is needed.
    """

    point: Point
    scalar: ca.SX
    order: int
    slopes: ca.SX
    second: ca.SX
    by_theta: ca.SX

    @classmethod
    def of(cls, point: Point, scalar: ca.SX, order: int) -> MeanDilatation:
        """Of a scalar that may depend on `Point.volumes`."""
        count, constants = len(point.volumes), point.theta.numel()
        return cls(
            point,
            scalar,
            order,
            ca.SX.sym("slopes", count * (order > 0)),
            ca.SX.sym("second", *[count * (order > 1)] * 2),
            ca.SX.sym("by_theta", count * (order > 1), constants),
        )

    @property
    def sums(self) -> ca.SX:
        """What the last phase may depend on."""
        later = [ca.vec(symbol) for symbol in (self.slopes, self.second, self.by_theta)]
        return ca.vertcat(self._first_sums, *later)

    @property
    def _first_sums(self) -> ca.SX:
        return ca.vertcat(self.point.whole_volume, *self.point.volumes)

    def phases(self) -> tuple[Phase, ...]:
        """Those before the last."""
        point, F, s = self.point, self.point.gradients["x"], ca.vertcat(*self.point.volumes)
        volumes = self._own_volumes()
        first: Pieces = {"whole_volume": ("none", point.volume), "volumes": ("none", volumes)}
        if not self.order:
            return (point.phase("volumes", first),)
        first["volumes_by_x"] = "nodes", ca.jacobian(volumes, F).T
        slopes = ca.gradient(self.scalar, s)
        second: Pieces = {"slopes": ("none", slopes)}
        if self.order > 1:
            second["second"] = "none", ca.vec(ca.jacobian(slopes, s))
            second["slopes_by_theta"] = "none", ca.vec(ca.jacobian(slopes, point.theta))
            second["slopes_by_x"] = "nodes", ca.jacobian(slopes, F).T
        return point.phase("volumes", first), point.phase("slopes", second, self._first_sums)

    def piece(self, by: tuple[str, ...]) -> ca.SX:
        """Π·∂²σ/∂α∂β."""
        alpha, beta = (self.point.gradients[field] for field in by)
        work = ca.dot(self.slopes, self._own_volumes())
        return ca.jacobian(ca.gradient(work, alpha), beta)

    def coupling(self, by: tuple[str, ...]) -> ca.SX:
        """C or D of a derivative, in the symbols of the sums; see `kernel`."""
        nodal = [field for field in by if field != "theta"]
        if not nodal:
            return ca.SX(0, 0)
        count = self.slopes.numel()
        along = self._as_by_x(nodal[-1])
        if len(nodal) == 2:
            nothing = ca.SX(count, count)
            return ca.blockcat([[self.second @ along, along.T], [along, nothing]])
        slopes = self.slopes if len(by) == 1 else self.by_theta
        return ca.vertcat(along.T @ slopes, ca.SX(count * (self.order > 1), slopes.shape[1]))

    def _own_volumes(self) -> ca.SX:
        """σ."""
        volumes = self.point.current_volume
        for field in list(self.point.fields)[1:]:
            along = ca.jtimes(volumes, self.point.gradients["x"], self.point.gradients[field])
            volumes = ca.vertcat(volumes, along)
        return volumes

    def _as_by_x(self, field: str) -> ca.SX:
        """∂s/∂x to ∂s/∂field, one row for each s."""
        count = self.slopes.numel()
        if field == "x":
            return ca.SX.eye(count)
        rates = range(1, count, 2)
        return ca.SX(
            ca.DM.triplet(list(rates), [k - 1 for k in rates], [1.0] * len(rates), count, count)
        )
