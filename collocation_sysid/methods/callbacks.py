"""The NLP's functions, and its observer, as CasADi callbacks over the shared assembly."""

from __future__ import annotations

import time
from collections.abc import Callable

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..nlp.collocation import Collocation
from ..results.solution import Iteration

Array = NDArray[np.float64]
Watch = Callable[[Iteration], None]
HessianValues = Callable[[Array, float, Array, Array], None]


class TimedFunction(ca.Callback):
    """A CasADi function of (z, …) whose outputs are written straight into CasADi's memory.

    CasADi would print exceptions and go on: they are put in `errors`, for `solve` to raise.
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
        self._inputs, self._outputs, self._evaluate = inputs, outputs, evaluate
        self._errors = errors
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
        began = time.perf_counter()
        try:
            self._evaluate(
                [np.frombuffer(a) if a is not None else np.zeros(0) for a in arguments],
                [np.frombuffer(r) if r is not None else None for r in results],
            )
        except BaseException as error:
            self._errors.append(error)
            return 1
        self.seconds += time.perf_counter() - began
        return 0


class NlpFunctions:
    """The NLP's functions as CasADi callbacks over the shared assembly."""

    def __init__(
        self, collocation: Collocation, hessian: HessianValues, errors: list[BaseException]
    ) -> None:
        self.collocation = collocation
        variables, rows = collocation.variables, collocation.constraints
        z, g = ca.Sparsity.dense(variables, 1), ca.Sparsity.dense(rows, 1)
        p, scalar = ca.Sparsity(0, 1), ca.Sparsity.dense(1, 1)
        jacobian = ca.Sparsity(rows, variables, *map(_ints, collocation.jacobian_structure))
        curvature = ca.Sparsity(variables, variables, *map(_ints, collocation.hessian_structure))

        def nlp(inputs: list[Array], outputs: list[Array | None]) -> None:
            value, values = outputs
            if value is not None:
                value[0] = collocation.objective(inputs[0])
            if values is not None:
                values[:] = collocation.constraint_values(inputs[0])

        def gradient(inputs: list[Array], outputs: list[Array | None]) -> None:
            value, slope = outputs
            if value is not None:
                value[0] = collocation.objective(inputs[0])
            if slope is not None:
                slope[:] = collocation.gradient(inputs[0])

        def jacobian_values(inputs: list[Array], outputs: list[Array | None]) -> None:
            rows, entries = outputs
            if entries is not None:
                values, _ = collocation.constraints_and_jacobian(inputs[0], entries)
                if rows is not None:
                    rows[:] = values
            elif rows is not None:
                rows[:] = collocation.constraint_values(inputs[0])

        def hessian_values(inputs: list[Array], outputs: list[Array | None]) -> None:
            point, _, weight, multipliers = inputs
            (entries,) = outputs
            if entries is not None:
                hessian(point, float(weight[0]), multipliers, entries)

        self.nlp = TimedFunction("nlp", [z, p], [scalar, g], nlp, errors)
        self.gradient = TimedFunction("grad_f", [z, p], [scalar, z], gradient, errors)
        self.jacobian = TimedFunction("jac_g", [z, p], [g, jacobian], jacobian_values, errors)
        inputs = [z, p, scalar, g]
        self.hessian = TimedFunction("hess_lag", inputs, [curvature], hessian_values, errors)

    @property
    def seconds(self) -> float:
        """Time spent evaluating."""
        functions = (self.nlp, self.gradient, self.jacobian, self.hessian)
        return sum(function.seconds for function in functions)


def _ints(values: NDArray[np.int64]) -> list[int]:
    return values.tolist()


class Monitor(ca.Callback):
    """Follows the iterates: history, best point, and the wish to stop."""

    def __init__(
        self,
        collocation: Collocation,
        watch: Watch | None,
        began: float,
        errors: list[BaseException],
    ) -> None:
        ca.Callback.__init__(self)
        self.errors = errors
        self.collocation = collocation
        self.watch = watch
        self.began = began
        self.stop = False
        self.history: list[Iteration] = []
        self.best: tuple[Array, Array] | None = None
        self.seconds = 0.0
        self._best_merit = np.inf
        self.construct("monitor")

    def get_n_in(self) -> int:
        return ca.nlpsol_n_out()

    def get_n_out(self) -> int:
        return 1

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        sizes = {
            "x": self.collocation.variables,
            "f": 1,
            "g": self.collocation.constraints,
            "lam_x": self.collocation.variables,
            "lam_g": self.collocation.constraints,
        }
        return ca.Sparsity.dense(sizes.get(ca.nlpsol_out(i), 0), 1)

    def eval(self, arguments):
        began = time.perf_counter()
        try:
            self._follow(arguments)
        except BaseException as error:
            self.errors.append(error)
        self.seconds += time.perf_counter() - began
        return [1 if self.stop or self.errors else 0]

    def _follow(self, arguments) -> None:
        z, value, rows, _, multipliers, *_ = (argument.full().ravel() for argument in arguments)
        # Objective and constraints are both of order one.
        merit = float(value[0] + np.abs(rows).max(initial=0.0))
        if merit < self._best_merit:
            self._best_merit, self.best = merit, (z, multipliers)
        violation = max(np.abs(r).max(initial=0.0) for r in self.collocation.violations_n(z))
        iteration = Iteration(
            number=len(self.history),
            loss=float(value[0]) / self.collocation.loss_scale,
            rms_m=self.collocation.rms_m(z),
            violation_n=float(violation),
            theta=self.collocation.theta(z),
            time_s=time.perf_counter() - self.began,
        )
        self.history.append(iteration)
        if self.watch is not None:
            self.watch(iteration)
