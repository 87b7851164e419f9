"""Derivatives of expressions that contain expensive functions of a few variables.

Differentiated by the nine components of the deformation gradient, an energy that is an expensive
function of a few invariants is evaluated many times over. A `SymbolicFunction` stands in
expressions as a symbol. Its partial derivatives are symbols too, each evaluated once, and
`ChainRule` differentiates expressions that contain these symbols.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import casadi as ca

# Arguments by which a function is differentiated, counting from 0, ascending: (0, 0, 2) stands for
# ∂³/∂y₀²∂y₂, and () for the function itself.
PartialIndex = tuple[int, ...]


@dataclass(frozen=True, eq=False)
class SymbolicFunction:
    """Scalar function of a few arguments whose partial derivatives are symbols."""

    arguments: ca.SX  # (n,) SX: expressions at which the function is evaluated
    # Returns the partial derivatives with some indices as expressions in the symbols on which the
    # arguments depend.
    evaluate: Callable[[Sequence[PartialIndex]], list[ca.SX]]
    # dict of PartialIndex to SX: symbols created so far; `symbol` adds to it.
    symbols: dict[PartialIndex, ca.SX] = field(default_factory=dict)

    def symbol(self, index: PartialIndex = ()) -> ca.SX:
        """Return the symbol of a partial derivative, in any order of its index; of the function
        itself by default. A new symbol is added to `symbols`.
        """
        key = tuple(sorted(index))
        if key not in self.symbols:
            self.symbols[key] = ca.SX.sym("_".join(map(str, ("partial", *key))))
        return self.symbols[key]

    def indices_in(self, expressions: Sequence[ca.SX]) -> list[PartialIndex]:
        """Return the indices of the partial derivatives that occur in expressions."""
        if not self.symbols:
            return []
        occurring = {each.__hash__() for each in ca.symvar(ca.veccat(*expressions))}
        return [key for key, each in self.symbols.items() if each.__hash__() in occurring]

    def shifted(self, indices: Sequence[PartialIndex], arguments: Sequence[int]) -> ca.SX:
        """Return the symbols (k, a) of the derivatives of k partial derivatives by a of the
        arguments, given by index: entry (i, j) is the derivative of the ith by the jth. New symbols
        are added to `symbols`.
        """
        return ca.vertcat(
            *(ca.horzcat(*(self.symbol((*index, a)) for a in arguments)) for index in indices)
        )


@dataclass(frozen=True, eq=False)
class ChainRule:
    """Derivatives of expressions in which functions stand as symbols."""

    # Functions whose arguments do not contain symbols of one another; empty by default, where all
    # derivatives are CasADi's.
    functions: tuple[SymbolicFunction, ...] = ()

    def jacobian(self, expression: ca.SX, by: ca.SX) -> ca.SX:
        """Return the total derivative (m, k) of an expression (m,) by symbols (k,), including the
        dependence through functions that occur in the expression as symbols.
        """
        total = ca.jacobian(expression, by)
        for function in self.functions:
            indices = function.indices_in([expression])
            slopes = ca.jacobian(function.arguments, by)
            arguments = sorted(set(slopes.sparsity().row()))
            if indices and arguments:
                symbols = ca.vertcat(*map(function.symbol, indices))
                by_argument = ca.jacobian(expression, symbols) @ function.shifted(
                    indices, arguments
                )
                total += by_argument @ slopes[arguments, :]
        return total

    def gradient(self, scalar: ca.SX, by: ca.SX) -> ca.SX:
        """Return the total gradient (k,) of a scalar by symbols (k,)."""
        if not self.functions:
            return ca.gradient(scalar, by)
        return ca.densify(self.jacobian(scalar, by)).T

    def directional_derivative(self, expression: ca.SX, by: ca.SX, direction: ca.SX) -> ca.SX:
        """Return the total derivative (m,) of an expression (m,) by symbols (k,) along a direction
        (k,), including the dependence through functions that occur in the expression as symbols.
        """
        symbols = [by]
        rates = [direction]
        for function in self.functions:
            if indices := function.indices_in([expression]):
                symbols += map(function.symbol, indices)
                rates.append(self._rates(function, indices, by=by, direction=direction))
        return ca.jtimes(expression, ca.vertcat(*symbols), ca.vertcat(*rates))

    def rates(self, by: ca.SX, direction: ca.SX) -> tuple[ca.SX, ca.SX]:
        """Return the symbols (f,) of all functions, without those of partial derivatives, and their
        total derivatives (f,) by symbols `by` (k,) along a direction (k,); both are empty without
        functions.
        """
        symbols = [function.symbol() for function in self.functions]
        rates = [
            self._rates(function, [()], by=by, direction=direction) for function in self.functions
        ]
        return ca.vertcat(ca.SX(0, 1), *symbols), ca.vertcat(ca.SX(0, 1), *rates)

    def _rates(
        self,
        function: SymbolicFunction,
        indices: Sequence[PartialIndex],
        by: ca.SX,
        direction: ca.SX,
    ) -> ca.SX:
        """Return derivatives (i,) of partial derivatives by symbols `by` along `direction` (k,)."""
        argument_rates = ca.jtimes(function.arguments, by, direction)
        arguments = sorted(set(ca.sparsify(argument_rates).sparsity().row()))
        return function.shifted(indices, arguments) @ argument_rates[arguments]

    def eliminate(self, expressions: Sequence[ca.SX]) -> list[ca.SX]:
        """Return the expressions with all symbols of functions and their partial derivatives
        replaced by expressions in the original variables.
        """
        expanded = list(expressions)
        for function in self.functions:
            if indices := function.indices_in(expanded):
                symbols = ca.vertcat(*map(function.symbol, indices))
                values = ca.densify(ca.vertcat(*function.evaluate(indices)))
                expanded = ca.substitute(expanded, [symbols], [values])
        return expanded
