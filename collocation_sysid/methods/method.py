"""What a method is: a function that solves a `Collocation`, and its options."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

from .solution import Solution


@dataclass(frozen=True)
class Method:
    """A solver and the dataclass of its options."""

    solve: Callable[..., Solution]
    options: type[Any]

    @property
    def option_names(self) -> frozenset[str]:
        """Names of the options."""
        return frozenset(field.name for field in fields(self.options))
