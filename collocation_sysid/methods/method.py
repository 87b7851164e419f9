"""What a method is: anything that solves a `Collocation`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from ..arrays import Array
from ..program.collocation import Collocation
from .solution import Iteration, Solution

Watch = Callable[[Iteration], None]


class Method(Protocol):
    """A callable that solves a `Collocation`, as those of `METHODS` are with their options."""

    def __call__(
        self, collocation: Collocation, watch: Watch | None = None, start: Array | None = None
    ) -> Solution:
        """Solve the NLP.

        Parameters
        ----------
        collocation : Collocation
        watch : callable, optional
            Called with every line of the history, an `Iteration`.
        start : (variables,) ndarray, optional
            Initial variables; the method's own choice at the guess by default.

        Returns
        -------
        Solution
            Also when it did not converge or was interrupted (Ctrl-C): then the best iterate.
        """
        ...
