"""Functions of a nonlinear program as CasADi callbacks, and the program for `nlpsol`.

`NlpFunctions` has functions with derivatives by the names of solvers; `CasadiProgram` is the program
itself, which `nlpsol` accepts.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any, Literal, Protocol

import casadi as ca
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from ..common.array_types import Array, Index
from ..errors import InputError
from ..fem.rest_shape import RestShapeError

HessianValues = Callable[[Array, float, Array, Array], object]
Hessian = Literal["gauss-newton", "exact"]

# Functions that solvers of CasADi ask for by names of their own, with their outputs, see
# `NlpFunctions`.
_CACHED: Mapping[str, Mapping[str, tuple[str, ...]]] = {
    "sqpmethod": {
        "nlp_fg": ("f", "g"),
        "nlp_jac_fg": ("f", "grad_f", "g", "jac_g"),
        "nlp_hess_l": ("hess",),
    },
    "sleqp": {
        "nlp_f": ("f",),
        "nlp_g": ("g",),
        "nlp_grad_f": ("f", "grad_f"),
        "nlp_jac_g": ("g", "jac_g"),
        "nlp_grad_l": ("grad_l",),
    },
}


class ExactProgram(Protocol):
    """Nonlinear program with exact sparse derivatives, see `Collocation` for the methods."""

    @property
    def variable_count(self) -> int: ...
    @property
    def constraint_count(self) -> int: ...
    @property
    def jacobian_structure(self) -> tuple[Index, Index]: ...
    @property
    def hessian_structure(self) -> tuple[Index, Index]: ...
    def objective(self, z: Array, /) -> float: ...
    def gradient(self, z: Array, /) -> Array: ...
    def constraint_values(self, z: Array, /) -> Array: ...
    def constraints_and_jacobian(
        self, z: Array, out: Array | None = None, /
    ) -> tuple[Array, Array]: ...
    def jacobian(self, z: Array, /) -> sp.csc_array: ...


class ConvexProgram(ExactProgram, Protocol):
    """Nonlinear program that has a convex approximation of its Hessian, too."""

    def hessian_values(
        self, z: Array, loss_weight: float, multipliers: Array | None, out: Array | None = None
    ) -> Array: ...


def hessian_values(program: ConvexProgram, hessian: Hessian) -> HessianValues:
    """Return the function (z, weight, multipliers, out) that overwrites `out` with the values of
    the upper triangle of the Hessian of weight · f + multipliers · g at z, or of that of
    Gauss–Newton, in the order of `hessian_structure`.
    """

    def values(z: Array, weight: float, multipliers: Array, out: Array) -> None:
        program.hessian_values(z, weight, multipliers if hessian == "exact" else None, out)

    return values


class TimedFunction(ca.Callback):
    """CasADi function whose outputs are written directly to CasADi's memory, with a timer.

    CasADi would print exceptions and continue. Instead they are appended to `errors`, if there is
    such a list, from which `nlpsol.solve` raises them, and all later evaluations fail.

    Attributes
    ----------
    calls : int
        Number of evaluations.
    seconds : float
        Time of the evaluations [s].

    Parameters
    ----------
    inputs : list of Sparsity
        Sparsity of each input.
    outputs : list of Sparsity
        Sparsity of each output.
    evaluate : callable
        Function of the input arrays and the output arrays, which it writes; an output is None if it
        is not requested.
    errors : list, optional
        Exceptions, shared by all functions of a solve.
    jacobian, reverse : callable, optional
        Functions of a name that return the Jacobian, and the reverse directional derivative, as
        CasADi calls them.
    """

    def __init__(
        self,
        name: str,
        inputs: list[ca.Sparsity],
        outputs: list[ca.Sparsity],
        evaluate: Callable[[list[Array], list[Array | None]], None],
        errors: list[BaseException] | None,
        jacobian: Callable[[str], TimedFunction] | None = None,
        reverse: Callable[[str], TimedFunction] | None = None,
    ) -> None:
        ca.Callback.__init__(self)
        self._jacobian = jacobian
        self._reverse = reverse
        self._derivatives: list[TimedFunction] = []  # which CasADi does not keep
        self._inputs = inputs
        self._outputs = outputs
        self._evaluate = evaluate
        self._errors = errors
        self.calls = 0
        self.seconds = 0.0
        self.construct(name)

    def get_n_in(self) -> int:
        return len(self._inputs)

    def get_n_out(self) -> int:
        return len(self._outputs)

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return self._inputs[i]

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        return self._outputs[i]

    def has_jacobian(self) -> bool:
        return self._jacobian is not None

    def get_jacobian(self, name, inames, onames, opts):
        assert self._jacobian is not None
        self._derivatives.append(self._jacobian(name))
        return self._derivatives[-1]

    def has_reverse(self, nadj: int) -> bool:
        return self._reverse is not None and nadj == 1

    def get_reverse(self, nadj, name, inames, onames, opts):
        assert self._reverse is not None
        self._derivatives.append(self._reverse(name))
        return self._derivatives[-1]

    def has_eval_buffer(self) -> bool:
        return True

    def eval_buffer(self, arguments, results) -> int:
        """Evaluate the function and write its outputs to `results`, in place; return 0, or 1 if it
        fails (CasADi's interface).

        Exceptions are stored in `errors` for the caller of the solver instead of being raised,
        except where no stress-free shape exists: that counts as a failed evaluation alone. Once
        `errors` contains one, nothing is evaluated any more. `calls` counts every call, `seconds`
        only adds the time of those that succeed.
        """
        began = time.perf_counter()
        self.calls += 1
        if self._errors:
            return 1
        try:
            self._evaluate(
                [np.frombuffer(a) if a is not None else np.zeros(0) for a in arguments],
                [np.frombuffer(r) if r is not None else None for r in results],
            )
        except RestShapeError:
            # The solver shortens its step, as after a value that is not finite.
            return 1
        except BaseException as error:
            if self._errors is None:
                raise
            self._errors.append(error)
            return 1
        self.seconds += time.perf_counter() - began
        return 0


class LagrangianGradient(TimedFunction):
    """Gradient of the Lagrangian, with a directional derivative for solvers that need
    Hessian products.
    """

    hessian_product: Callable[[list[Array], list[Array | None]], None]

    def has_forward(self, nfwd: int) -> bool:
        """Return whether CasADi may ask for this number of directional derivatives: only one."""
        return nfwd == 1

    def get_forward(self, nfwd, name, inames, onames, opts):
        inputs = [*self._inputs, *self._outputs, *self._inputs]
        self._forward = TimedFunction(
            name, inputs, outputs=self._outputs, evaluate=self.hessian_product, errors=self._errors
        )
        return self._forward


class NlpFunctions:
    """Functions of the NLP as CasADi callbacks.

    Inputs are the variables z and CasADi's parameters p, which are empty, and for functions of the
    Lagrangian w f + yᵀ g also the weight w of the objective and the multipliers y (constraints,).
    Outputs by name:

    =================  =================================================
    f, g               objective and constraints
    grad_f, jac_g      their first derivatives
    grad_l             gradient of the Lagrangian, with its product with H
    triu_hess, hess    Hessian H of the Lagrangian, upper triangle or all
    =================  =================================================

    Parameters
    ----------
    hessian : callable
        Function (z, w, y, values) that writes the upper triangle of H to `values`.
    errors : list, optional
        Exceptions of the callbacks are appended to it; CasADi reports them by default.
    """

    def __init__(
        self,
        collocation: ExactProgram,
        hessian: HessianValues,
        errors: list[BaseException] | None = None,
    ) -> None:
        self.collocation = collocation
        self.errors = errors
        self._upper_values = hessian
        self._functions: list[TimedFunction] = []
        self.nlp = self.function("nlp", "f", "g")

    def sum_seconds(self) -> float:
        """Return the time of all evaluations [s]."""
        return sum(function.seconds for function in self._functions)

    def count_calls(self) -> int:
        """Return the number of evaluations of all functions."""
        return sum(function.calls for function in self._functions)

    def function(self, name: str, *outputs: str) -> TimedFunction:
        """Return a new callback, and keep it for `seconds` and `calls`.

        Its inputs are z and p, and also w and y if an output is of the Lagrangian. For "grad_l"
        alone it is a `LagrangianGradient`, which has a directional derivative; the evaluations of
        that are not part of `seconds` and `calls`.

        Parameters
        ----------
        outputs : str
            Names of its outputs, see the class.
        """

        def evaluate(inputs: list[Array], buffers: list[Array | None]) -> None:
            self.evaluate(outputs, inputs, buffers)

        needs_multipliers = any(output in ("grad_l", "triu_hess", "hess") for output in outputs)
        inputs = self.inputs if needs_multipliers else self.inputs[:2]
        kind = LagrangianGradient if outputs == ("grad_l",) else TimedFunction
        sparsities = [self.sparsity(output) for output in outputs]
        callback = kind(name, inputs, outputs=sparsities, evaluate=evaluate, errors=self.errors)
        if isinstance(callback, LagrangianGradient):
            callback.hessian_product = self._forward
        self._functions.append(callback)
        return callback

    def derivatives(self, plugin: str) -> dict[str, Any]:
        """Return the options of `nlpsol` that give a solver its derivatives, as new functions:
        without them it would derive them from products with seeds.

        Parameters
        ----------
        plugin : {"ipopt", "sqpmethod", "sleqp"}
            CasADi's name of the solver.

        Raises
        ------
        InputError
            For another solver.
        """
        if plugin == "ipopt":
            return {
                "jac_g": self.function("jac_g", "g", "jac_g"),
                "grad_f": self.function("grad_f", "f", "grad_f"),
                "hess_lag": self.function("hess_lag", "triu_hess"),
            }
        if plugin not in _CACHED:
            raise InputError(f"found {plugin!r}; expected one of ipopt, {', '.join(_CACHED)}")
        # Only some of the functions are options, but all are looked up in the cache first.
        return {"cache": {n: self.function(n, *outputs) for n, outputs in _CACHED[plugin].items()}}

    def evaluate(
        self, names: Sequence[str], inputs: list[Array], buffers: Sequence[Array | None]
    ) -> None:
        """Write the outputs called `names` to `buffers`, except those that are None."""
        requests = zip(names, buffers, strict=True)
        outputs = {name: buffer for name, buffer in requests if buffer is not None}
        collocation = self.collocation
        z = inputs[0]
        if "f" in outputs:
            outputs["f"][0] = collocation.objective(z)
        if "grad_f" in outputs:
            outputs["grad_f"][:] = collocation.gradient(z)
        if "jac_g" in outputs:
            rows, _ = collocation.constraints_and_jacobian(z, outputs["jac_g"])
            if "g" in outputs:
                outputs["g"][:] = rows
        elif "g" in outputs:
            outputs["g"][:] = collocation.constraint_values(z)
        if len(inputs) == 2:
            return
        weight, multipliers = self._weights(*inputs[2:])
        if "grad_l" in outputs:
            outputs["grad_l"][:] = weight * collocation.gradient(z)
            outputs["grad_l"] += collocation.jacobian(z).T @ multipliers
        if "triu_hess" in outputs:
            self._upper_values(z, weight, multipliers, outputs["triu_hess"])
        if "hess" in outputs:
            outputs["hess"][:] = self._upper_triangle(z, weight, multipliers=multipliers)[
                self._full[1]
            ]

    def _forward(self, inputs: list[Array], outputs: list[Array | None]) -> None:
        """Write the directional derivative of the Lagrangian's gradient, in place."""
        z, _, weight, multipliers, _, by_z, _, by_weight, by_multipliers = inputs
        (product,) = outputs
        if product is None:
            return
        product[:] = 0
        if len(by_z):
            structure, order = self._full
            rows, columns = structure.get_triplet()
            values = self._upper_triangle(z, *self._weights(weight, multipliers))[order]
            np.add.at(product, rows, values * by_z[columns])
        if by_weight.any():
            product += by_weight * self.collocation.gradient(z)
        if by_multipliers.any():
            product += self.collocation.jacobian(z).T @ by_multipliers

    def _upper_triangle(self, z: Array, weight: float, multipliers: Array) -> Array:
        """Values of the Hessian of weight · f + multipliers · g, a new array."""
        values = np.empty(len(self.collocation.hessian_structure[1]))
        self._upper_values(z, weight, multipliers, values)
        return values

    def _weights(self, weight: Array, multipliers: Array) -> tuple[float, Array]:
        """Return w and y; CasADi leaves arrays empty for zeros."""
        if not len(multipliers):
            multipliers = np.zeros(self.collocation.constraint_count)
        return float(weight[0]) if len(weight) else 0.0, multipliers

    @cached_property
    def inputs(self) -> list[ca.Sparsity]:
        """Sparsity of z, CasADi's empty parameters p, w and y, in this order."""
        dense = ca.Sparsity.dense
        variables = self.collocation.variable_count
        rows = self.collocation.constraint_count
        return [dense(variables, 1), ca.Sparsity(0, 1), dense(1, 1), dense(rows, 1)]

    @cached_property
    def _full(self) -> tuple[ca.Sparsity, NDArray[np.int64]]:
        """Sparsity of the symmetric Hessian, and indices of its entries in the triangle."""
        upper = self.sparsity("triu_hess")
        numbered = ca.DM(upper, np.arange(1.0, upper.nnz() + 1))
        symmetric = ca.triu2symm(numbered)
        return symmetric.sparsity(), np.array(symmetric.nonzeros(), dtype=np.int64) - 1

    def sparsity(self, output: str) -> ca.Sparsity:
        """Return the sparsity of an output, by name; values and gradients are dense columns."""
        variables = self.collocation.variable_count
        rows = self.collocation.constraint_count
        if output == "jac_g":
            return ca.Sparsity(rows, variables, *map(_ints, self.collocation.jacobian_structure))
        if output == "triu_hess":
            structure = self.collocation.hessian_structure
            return ca.Sparsity(variables, variables, *map(_ints, structure))
        if output == "hess":
            return self._full[0]
        return ca.Sparsity.dense({"f": 1, "g": rows}.get(output, variables), 1)


def _ints(values: NDArray[np.int64]) -> list[int]:
    """Return a list of Python integers, as CasADi requires."""
    return values.tolist()


class CasadiProgram(TimedFunction):
    """A nonlinear program as the CasADi function (x, p) → (f, g), for `casadi.nlpsol`:

        nlp = problem.collocation().casadi()
        solver = ca.nlpsol("solver", "ipopt", nlp, nlp.derivatives("ipopt"))
        found = solver(**nlp.arguments)

    Objective f, constraints g = 0 and all derivatives are those of `program`, and x are its
    variables z; p is empty. Solvers for which `derivatives` has no options get the derivatives from
    CasADi, which multiplies these with seeds: right as well, but slower. Keep this object as long as
    the solver: CasADi does not.

    Attributes
    ----------
    program : Collocation
        The program.
    f, g, grad_f, jac_g : casadi.Function
        Functions of (x, p): the objective, the constraints, and their first derivatives.
    hess_l : casadi.Function
        Upper triangle of the Hessian of w f + yᵀ g, a function of (x, p, w, y), or what replaces it.
    arguments : dict of str to array
        Arguments of the solver: x0, lbx, ubx, lbg and ubg. x0 has the guesses of the parameters and
        bodies that move rigidly with their grasps.
    """

    def __init__(self, program: ConvexProgram, hessian: Hessian, **arguments: Array) -> None:
        self.program = program
        self.arguments = arguments | {"lbg": np.zeros(program.constraint_count)}
        self.arguments["ubg"] = self.arguments["lbg"]
        self._functions = functions = NlpFunctions(program, hessian_values(program, hessian))
        self.f, self.g, self.grad_f, self.jac_g = (
            functions.function(name, name) for name in ("f", "g", "grad_f", "jac_g")
        )
        self.hess_l = functions.function("hess_l", "triu_hess")

        def evaluate(inputs: list[Array], buffers: list[Array | None]) -> None:
            functions.evaluate(("f", "g"), inputs, buffers)

        sparsities = [functions.sparsity(output) for output in ("f", "g")]
        super().__init__(
            "nlp",
            functions.inputs[:2],
            sparsities,
            evaluate,
            None,
            jacobian=self._first_derivatives,
            reverse=self._lagrangian_gradient,
        )

    def get_name_in(self, i: int) -> str:
        return ("x", "p")[i]

    def get_name_out(self, i: int) -> str:
        return ("f", "g")[i]

    def derivatives(self, plugin: str) -> dict[str, Any]:
        """Return the options of `nlpsol` that give a solver its derivatives directly, see
        `NlpFunctions.derivatives`.
        """
        return self._functions.derivatives(plugin)

    def _first_derivatives(self, name: str) -> TimedFunction:
        """Derivatives of f and g by x and p, at (x, p, f, g)."""
        functions, count = self._functions, self.program.constraint_count
        by_x = ca.Sparsity.dense(1, self.program.variable_count), functions.sparsity("jac_g")
        outputs = [by_x[0], ca.Sparsity(1, 0), by_x[1], ca.Sparsity(count, 0)]

        def evaluate(inputs: list[Array], buffers: list[Array | None]) -> None:
            functions.evaluate(("grad_f", "jac_g"), inputs[:2], buffers[::2])

        inputs = [*functions.inputs[:2], *self._outputs]
        return TimedFunction(name, inputs, outputs, evaluate, None)

    def _lagrangian_gradient(self, name: str) -> TimedFunction:
        """Gradient of w f + yᵀ g by x and p, at (x, p, f, g, w, y)."""
        functions = self._functions
        inputs = [*functions.inputs[:2], *self._outputs, *functions.inputs[2:]]

        def evaluate(inputs: list[Array], buffers: list[Array | None]) -> None:
            functions.evaluate(("grad_l",), [*inputs[:2], *inputs[4:]], buffers[:1])

        outputs = functions.inputs[:2]
        return TimedFunction(name, inputs, outputs, evaluate, None, jacobian=self._hessian)

    def _hessian(self, name: str) -> TimedFunction:
        """Derivatives of both gradients by x, p, f, g, w and y; that by x is the Hessian."""
        functions = self._functions
        size = self.program.variable_count
        inputs = [*functions.inputs[:2], *self._outputs, *functions.inputs[2:]]
        jacobian = functions.sparsity("jac_g")
        numbered = ca.DM(jacobian, np.arange(1.0, jacobian.nnz() + 1)).T
        order = np.array(numbered.nonzeros(), dtype=np.int64) - 1
        outputs = [ca.Sparsity(size, each.numel()) for each in inputs]
        outputs[0] = functions.sparsity("hess")
        outputs[4:] = [ca.Sparsity.dense(size), numbered.sparsity()]
        outputs += [ca.Sparsity(0, each.numel()) for each in inputs]

        def evaluate(inputs: list[Array], buffers: list[Array | None]) -> None:
            of_lagrangian = [*inputs[:2], *inputs[4:6]]
            values = None if buffers[5] is None else np.empty(len(order))
            names = ("hess", "grad_f", "jac_g")
            functions.evaluate(names, of_lagrangian, (buffers[0], buffers[4], values))
            if buffers[5] is not None and values is not None:
                buffers[5][:] = values[order]

        return TimedFunction(name, [*inputs, *functions.inputs[:2]], outputs, evaluate, None)
