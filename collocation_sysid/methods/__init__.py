"""Methods that solve a `Collocation` and return a `Solution`, by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from ..results.solution import Solution
from .interior_point import InteriorPointOptions
from .interior_point import solve as interior_point
from .reduced_space import ReducedSpaceOptions
from .reduced_space import solve as reduced_space


@dataclass(frozen=True)
class Method:
    """A solver and the dataclass of its options."""

    solve: Callable[..., Solution]
    options: type[Any]


METHODS: dict[str, Method] = {
    "interior-point": Method(interior_point, InteriorPointOptions),
    "reduced-space": Method(reduced_space, ReducedSpaceOptions),
}
