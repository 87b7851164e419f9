"""Small expressions of a few numbers, at many instances, with derivatives that nobody writes.

Instances come last: inputs u are (k, …), or (k,) where they are the same of all, data (d, …), and
values (m, …), for any shape … of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..fem.kernels import COMPILING, Instances, make_instances

Expression = Callable[[ca.SX, ca.SX], ca.SX]


@dataclass(frozen=True, eq=False)
class Generated:
    """An expression y(u, data), mapped over its instances.

    Attributes
    ----------
    expression : callable
        ``expression(u, data) -> y`` in CasADi operations, of columns.
    inputs, data : int
        Lengths k of u and d of the data.
    compiled : bool
        Whether it is evaluated at so many instances that compiling it pays.
    """

    expression: Expression
    inputs: int
    data: int
    compiled: bool = False

    def value(self, u: Array, data: Array) -> Array:
        """(m, …)."""
        return self._mapped(self._value, u, data)[0][:, 0]

    def slopes(self, u: Array, data: Array) -> tuple[Array, Array]:
        """The values (m, …), and ∂y/∂u (m, k, …)."""
        value, slopes = self._mapped(self._slopes, u, data)
        return value[:, 0], slopes

    def curvature(self, u: Array, data: Array, weights: Array | None = None) -> Array:
        """∂²/∂u² (k, k, …) of Σ weights · y, for weights (m, …); one by default."""
        weights = (
            np.ones((self._symbols[2].numel(), *data.shape[1:])) if weights is None else weights
        )
        return self._mapped(self._curvature, u, data, weights)[0]

    @cached_property
    def depends(self) -> NDArray[np.bool_]:
        """(k,) whether any y depends on each of u."""
        u, _, y = self._symbols
        found = np.zeros(self.inputs, dtype=bool)
        found[ca.jacobian(y, u).sparsity().get_col()] = True
        return found

    def takes(self, datum: int) -> bool:
        """Whether any y depends on a number of the data."""
        _, data, y = self._symbols
        if datum not in self._taken:
            self._taken[datum] = ca.depends_on(y, data[datum])
        return self._taken[datum]

    @cached_property
    def _taken(self) -> dict[int, bool]:
        return {}

    @cached_property
    def is_linear(self) -> bool:
        """Whether slopes by u are always the same."""
        u, _, y = self._symbols
        return not ca.depends_on(ca.jacobian(y, u), u)

    @cached_property
    def slope_pattern(self) -> NDArray[np.bool_]:
        """(m, k) which slopes there may be."""
        u, _, y = self._symbols
        return np.array(ca.DM(ca.jacobian(y, u).sparsity(), 1.0).full(), dtype=bool)

    @cached_property
    def curvature_pattern(self) -> NDArray[np.bool_]:
        """(k, k) which second derivatives there may be."""
        u, _, y = self._symbols
        second, _ = ca.hessian(ca.sum1(y), u)
        return np.array(ca.DM(second.sparsity(), 1.0).full(), dtype=bool)

    @cached_property
    def _symbols(self) -> tuple[ca.SX, ca.SX, ca.SX]:
        u, data = ca.SX.sym("u", self.inputs), ca.SX.sym("data", self.data)
        return u, data, ca.densify(ca.SX(self.expression(u, data)))

    @cached_property
    def _value(self) -> ca.Function:
        u, data, y = self._symbols
        return ca.Function("value", [u, data], [y])

    @cached_property
    def _slopes(self) -> ca.Function:
        u, data, y = self._symbols
        return ca.Function("slopes", [u, data], [y, ca.densify(ca.jacobian(y, u))], CSE)

    @cached_property
    def _curvature(self) -> ca.Function:
        u, data, y = self._symbols
        weights = ca.SX.sym("weights", y.numel())
        second, _ = ca.hessian(ca.dot(weights, y), u)
        return ca.Function("curvature", [u, data, weights], [ca.densify(second)], CSE)

    def _mapped(self, function: ca.Function, u: Array, *others: Array) -> list[Array]:
        """Outputs (rows, columns, …) of a function."""
        shape = others[0].shape[1:]
        count = int(np.prod(shape))
        if u.ndim == 1:
            u = np.broadcast_to(u.reshape(-1, *(1 for _ in shape)), (len(u), *shape))
        sizes = [function.size_out(k) for k in range(function.n_out())]
        if not count:
            return [np.zeros((*size, *shape)) for size in sizes]
        name = function.name()
        with COMPILING:
            if name not in self._evaluators:
                self._evaluators[name] = make_instances(function, self.compiled)
        found = self._evaluators[name]([x.reshape(len(x), count) for x in (u, *others)])
        pairs = zip(found, sizes, strict=True)
        return [each.reshape(*size[::-1], *shape).swapaxes(0, 1) for each, size in pairs]

    @cached_property
    def _evaluators(self) -> dict[str, Instances]:
        return {}


CSE = {"cse": True}
