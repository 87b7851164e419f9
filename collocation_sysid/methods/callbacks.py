"""CasADi callbacks that evaluate the NLP's functions and observe the iterations of a solver.

Use `NlpFunctions` for functions with derivatives and `IterationMonitor` for the history; `nlpsol`
combines them.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..common.array_types import Array
from ..fem.rest_shape import RestShapeError
from ..program.collocation import Collocation, convert_variables
from .solve_recorder import Recorder

HessianValues = Callable[[Array, float, Array, Array], None]


class TimedFunction(ca.Callback):
    """CasADi function whose outputs are written directly to CasADi's memory, with a timer.

    CasADi would print exceptions and continue. Instead they are appended to `errors`, from which
    `nlpsol.solve` raises them, and all later evaluations fail.

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
    errors : list
        Exceptions, shared by all functions of a solve.
    """

    def __init__(
        self,
        name: str,
        inputs: list[ca.Sparsity],
        outputs: list[ca.Sparsity],
        evaluate: Callable[[list[Array], list[Array | None]], None],
        errors: list[BaseException],
    ) -> None:
        ca.Callback.__init__(self)
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
    errors : list
        Exceptions of the callbacks are appended to it.
    """

    def __init__(
        self, collocation: Collocation, hessian: HessianValues, errors: list[BaseException]
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
            """Evaluate the outputs whose buffers are not None, which are overwritten."""
            requests = zip(outputs, buffers, strict=True)
            self._evaluate(inputs, {output: b for output, b in requests if b is not None})

        needs_multipliers = any(output in ("grad_l", "triu_hess", "hess") for output in outputs)
        inputs = self._inputs if needs_multipliers else self._inputs[:2]
        kind = LagrangianGradient if outputs == ("grad_l",) else TimedFunction
        sparsities = [self._sparsity(output) for output in outputs]
        callback = kind(name, inputs, outputs=sparsities, evaluate=evaluate, errors=self.errors)
        if isinstance(callback, LagrangianGradient):
            callback.hessian_product = self._forward
        self._functions.append(callback)
        return callback

    def _evaluate(self, inputs: list[Array], outputs: dict[str, Array]) -> None:
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
    def _inputs(self) -> list[ca.Sparsity]:
        """Sparsity of z, CasADi's empty parameters p, w and y, in this order."""
        dense = ca.Sparsity.dense
        variables = self.collocation.variable_count
        rows = self.collocation.constraint_count
        return [dense(variables, 1), ca.Sparsity(0, 1), dense(1, 1), dense(rows, 1)]

    @cached_property
    def _full(self) -> tuple[ca.Sparsity, NDArray[np.int64]]:
        """Sparsity of the symmetric Hessian, and indices of its entries in the triangle."""
        upper = self._sparsity("triu_hess")
        numbered = ca.DM(upper, np.arange(1.0, upper.nnz() + 1))
        symmetric = ca.triu2symm(numbered)
        return symmetric.sparsity(), np.array(symmetric.nonzeros(), dtype=np.int64) - 1

    def _sparsity(self, output: str) -> ca.Sparsity:
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


class IterationMonitor(ca.Callback):
    """CasADi callback that is called after each iteration: history, best iterate, and requests to
    stop.

    Attributes
    ----------
    stop : bool
        Set it to true to stop the solver after the iteration.
    best : tuple of two arrays or None
        Variables and multipliers with the least merit (objective plus largest constraint); None
        before the first iteration.
    seconds : float
        Time of the calls [s].
    lines : int
        Number of calls.

    Parameters
    ----------
    recorder : Recorder
        Record of the solve; an entry is added to its history per call.
    program : Collocation
        Program that is solved, which may be condensed or have lifted variables.
    errors : list
        Exceptions; the solver is stopped once it contains one.
    """

    def __init__(
        self, recorder: Recorder, program: Collocation, errors: list[BaseException]
    ) -> None:
        ca.Callback.__init__(self)
        self.recorder = recorder
        self.program = program
        self.errors = errors
        self.stop = False
        self.best: tuple[Array, Array] | None = None
        self.seconds = 0.0
        self.lines = 0
        self._best_merit = np.inf
        self.construct("monitor")

    def get_n_in(self) -> int:
        return ca.nlpsol_n_out()

    def get_n_out(self) -> int:
        return 1

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        program = self.program
        sizes = {
            "x": program.variable_count,
            "f": 1,
            "g": program.constraint_count,
            "lam_x": program.variable_count,
            "lam_g": program.constraint_count,
        }
        return ca.Sparsity.dense(sizes.get(ca.nlpsol_out(i), 0), 1)

    def eval(self, arguments):
        """Record an iteration; return [1] if the solver should stop, else [0] (CasADi's interface).

        It should stop on request, at the limit of time, and after an exception, which is stored in
        `errors` instead of being raised.
        """
        began = time.perf_counter()
        if self.errors:
            return [1]
        try:
            self._record(arguments)
        except BaseException as error:
            self.errors.append(error)
        self.seconds += time.perf_counter() - began
        return [1 if self.stop or self.recorder.is_late() or self.errors else 0]

    def _record(self, arguments) -> None:
        """Add an entry, and store the iterate of least objective plus largest violation."""
        z, value, rows, _, multipliers, *_ = (argument.full().ravel() for argument in arguments)
        # Objective and constraints are both of order one.
        merit = float(value[0] + np.abs(rows).max(initial=0.0))
        if merit < self._best_merit:
            self._best_merit = merit
            self.best = (z, multipliers)
        recorder = self.recorder
        loss = float(value[0]) / self.program.loss_scale
        variables = convert_variables(z, self.program, target=recorder.collocation)
        number = recorder.history[-1].number + 1 if recorder.history else 0
        self.lines += 1
        recorder.add_variables(number, variables, loss=loss)
